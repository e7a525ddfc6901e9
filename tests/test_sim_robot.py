"""A robot in MuJoCo: it keeps its force on skin, on a course along it; scene, film and environment around it."""

import copy
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stmpl_core import Prony, Simulator, SoftLayer, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Winkler
from tests.scenes import LENGTH, RADIUS, limb, plate

pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")


@pytest.fixture(scope="module")
def forearm() -> SoftLayer:
    from stmpl_core.body import Body

    return Body.anny().part("left_forearm", tissue=Tissue(youngs_modulus=20e3))


def test_the_arm_presses_circles_and_lets_go(forearm: SoftLayer, tmp_path: Path) -> None:
    from stmpl_sim.massage import Course, Log, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    site = Site.thickest(forearm)
    course = Course(site.circle(0.012), (5.0,), laps=0.5)
    massage = Massage(build(forearm, site, timestep=2e-3), course, skin=Simulator(forearm, Winkler()))
    log = massage.run()
    for phase in course.phases:
        if phase.name in ("press", "circle"):
            force = log.force[log.during(phase)]
            assert np.abs(force - 5.0).max() < 0.1  # a circle from its first instant on
            assert log.off[log.during(phase)].max() < 5e-4
    assert not log.wrench[-1].any()
    assert abs(log.energy[-1]) < 0.1 * log.energy.max()
    kept = Log.load(log.save(tmp_path / "log.npz"))
    np.testing.assert_array_equal(kept.force, log.force)
    assert kept.phases == log.phases


def test_a_force_is_kept_by_a_light_arm_and_a_heavy_one_on_a_limb_that_gives_way(forearm: SoftLayer) -> None:
    from stmpl_sim.engine import mujoco
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import LIMB, build
    from stmpl_sim.site import Site

    site, simulator, felt = Site.thickest(forearm), Simulator(forearm, Winkler()), []
    course = Course(site.circle(0.012), (4.0, 8.0), laps=0.2)
    for mass in (0.5, 1.0, 2.0):
        scene = build(forearm, site, mount="springs", timestep=4e-3)
        robot = np.arange(1, scene.model.nbody) != scene.model.body(LIMB).id
        for of_bodies in (scene.model.body_mass, scene.model.body_inertia):
            of_bodies[1:][robot] *= mass
        mujoco.mj_setConst(scene.model, mujoco.MjData(scene.model))
        log = Massage(scene, course, skin=simulator).run()
        some = (log.time >= course.phases[2].start) & (log.time < course.phases[-1].start)
        assert np.abs(log.force - log.asked)[some].max() < 0.1  # at every instant, and while one force becomes the next
        felt.append(log.force[some])
    assert np.ptp(felt, axis=0).max() < 0.1


def test_a_course_is_smooth_and_its_rates_are_its_derivatives(forearm: SoftLayer) -> None:
    from stmpl_sim.massage import Course
    from stmpl_sim.site import Site

    circle = Site.thickest(forearm).circle(0.012)
    step, place = 1e-5, circle.at(0.7)
    ahead, behind = circle.at(0.7 + step), circle.at(0.7 - step)
    for value, rate in (("point", "slope"), ("slope", "bend"), ("normal", "tilt")):
        found = (getattr(ahead, value) - getattr(behind, value)) / (2 * step)
        np.testing.assert_allclose(getattr(place, rate), found, atol=1e-6)
    away = np.linalg.norm(forearm.vertices - place.point, axis=1).min()
    assert away < forearm.edge_length
    course = Course(circle, (5.0,), laps=1.0)
    times = np.linspace(0, course.duration, 4001)
    angles = np.array([course.angle(t) for t in times])
    np.testing.assert_allclose(np.gradient(angles[:, 0], times)[1:-1], angles[1:-1, 1], atol=0.02)
    assert angles[-1, 0] == pytest.approx(2 * np.pi) and angles[:, 1].max() == pytest.approx(0.05 / 0.012)
    course = Course(circle, (5.0, 10.0, 2.0), laps=0.1)
    times = np.linspace(course.phases[1].start, course.phases[-1].start, 8001)[:-1]
    forces = np.array([course.force(t) for t in times])
    np.testing.assert_allclose(np.gradient(forces[:, 0], times)[1:-1], forces[1:-1, 1], atol=0.2)
    assert np.abs(np.diff(forces[:, 0])).max() < 0.05 and set(forces[:, 0]) >= {5.0, 10.0, 2.0}


def test_the_thickest_place_of_a_fine_mesh_takes_little_memory() -> None:
    import tracemalloc

    from stmpl_sim.site import Site

    layer = limb(1.5e-3)
    peak = np.array([RADIUS, 0, 0.45 * LENGTH])
    bulge = np.exp(-(np.linalg.norm(layer.vertices - peak, axis=1) ** 2) / (2 * 0.02**2))
    layer = layer.with_(thickness=7.5e-3 * (1 + 0.5 * bulge))
    assert len(layer.vertices) > 20_000
    tracemalloc.start()
    site = Site.thickest(layer)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.linalg.norm(site.point - peak) < 0.012 and most < 200e6  # bytes


def test_a_patch_of_one_thickness_has_its_site_off_its_rim() -> None:
    from stmpl_sim.site import Site

    flat = plate(0.12)
    site = Site.thickest(flat.with_(vertices=flat.vertices * [0.7, 1, 1]))
    assert abs(site.point[0]) < 0.021 + 1e-6
    site.circle(0.012)


def test_a_robot_of_ones_own_is_driven_and_what_it_lacks_is_said(forearm: SoftLayer, tmp_path: Path) -> None:
    """A gantry of three slides as URDF, with no actuator."""
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    site, parts = Site.thickest(forearm), []
    for k, axis in enumerate(("1 0 0", "0 1 0", "0 0 1")):
        parts.append(f'<joint name="j{k}" type="prismatic"><parent link="l{k}"/><child link="l{k + 1}"/>'
                     f'<axis xyz="{axis}"/><origin xyz="0 0 {0.5 * (k == 2)}" rpy="{3.14159265 * (k == 2)} 0 0"/>'
                     '<limit lower="-1" upper="1" effort="200" velocity="1"/></joint>')  # fmt: skip
    inertia = '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="l{k}"><inertial><mass value="1"/>{inertia}</inertial></link>' for k in range(4))
    path = tmp_path / "gantry.urdf"
    path.write_text(f'<robot name="gantry">{links}{"".join(parts)}</robot>')
    scene = build(forearm, site, robot=path, at=(0.3, 0.1, 0.1), timestep=2e-3)
    log = Massage(scene, Course(site.circle(0.005), (5.0,), laps=0), skin=Simulator(forearm, Winkler())).run()
    assert log.force[log.during(log.phases[2])].mean() == pytest.approx(5, abs=0.2)
    if importlib.util.find_spec("gymnasium"):
        from stmpl_sim.env import MassageEnv

        env = MassageEnv(Simulator(forearm, Winkler()), circle=0.005, robot=path, at=(0.3, 0.1, 0.1), timestep=2e-3)
        assert env.reset(seed=0)[0][0] == pytest.approx(1.0, abs=0.1)  # of 10 N
    with pytest.raises(InvalidInput, match=r"no body or site 'gripper'\. Bodies: .*l3"):
        build(forearm, site, robot=path, end="gripper")
    with pytest.raises(InvalidInput, match="does not reach the limb"):
        build(forearm, site, robot=path, at=(3.0, 0, 0))
    far = tmp_path / "millimetres.urdf"
    far.write_text(re.sub(r'xyz="0 0 (0\.\d+)"', r'xyz="0 0 \g<1>e3"', path.read_text()))
    with pytest.raises(InvalidInput, match=r"links are .* m long in all\. Is its file in millimetres"):
        build(forearm, site, robot=far, at=(0.3, 0.1, 0.1))
    with pytest.raises(InvalidInput, match="no robot file"):
        build(forearm, site, robot=tmp_path / "nothing.xml")
    path.write_text("<robot><link>")
    with pytest.raises(InvalidInput, match="MuJoCo cannot read"):
        build(forearm, site, robot=path)


def test_a_file_in_degrees_with_names_and_gears_of_its_own_is_as_another(forearm: SoftLayer, tmp_path: Path) -> None:
    """MJCF counts angles in degrees unless it says otherwise; a rest lets a limb turn up by one radian."""
    from stmpl_sim.scene import HINGE, build
    from stmpl_sim.site import Site

    path, site = tmp_path / "arm.xml", Site.thickest(forearm)
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    file = f"""<mujoco><default><motor gear="50"/><general gear="20"/></default><worldbody>
      <geom name="floor" type="plane" size="1 1 .1" contype="0" conaffinity="0"/>
      <body name="a" pos="0 0 .8">{inertial}<joint name="elbow" type="slide" axis="1 0 0" range="-.4 .8"/>
      <joint name="y" type="slide" axis="0 1 0" range="-1 1"/><joint name="z" type="slide" axis="0 0 1" range="-.6 .6"/>
      <body name="c" quat="0 1 0 0">{inertial}</body></body></worldbody></mujoco>"""
    for degrees in (True, False):
        path.write_text(file if degrees else file.replace("<default>", '<compiler angle="radian"/><default>', 1))
        model = build(forearm, site, robot=path, mount="rest").model
        np.testing.assert_allclose(model.joint(HINGE).range, [0, 1], atol=1e-9)
        np.testing.assert_array_equal(model.actuator_gear[:, 0], 1)
    for name in ("limb", "head", "ball", "wrist"):
        path.write_text(file.replace('name="c"', f'name="{name}"').replace(
            "</body></body>", f'<site name="{name}"/><geom name="{name}" size=".01"/></body></body>'))
        with pytest.raises(InvalidInput, match="a name of the robot's file is one that the scene takes"):
            build(forearm, site, robot=path)
    path.write_text("<mujoco/>")
    with pytest.raises(InvalidInput, match="has no body"):
        build(forearm, site, robot=path)


@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_the_ball_is_turned_as_its_site_or_body_however_that_is_written(
    forearm: SoftLayer, tmp_path: Path, angle: str
) -> None:
    """Also in a frame, of a class of defaults, beside a mesh, and as the file counts angles."""
    from stmpl_sim.engine import mujoco
    from stmpl_sim.scene import BALL, HEAD, build
    from stmpl_sim.site import Site

    path, place = tmp_path / "arm.xml", Site.thickest(forearm)
    some, more = (40, 10) if angle == "degree" else (0.7, 0.2)
    (tmp_path / "part.obj").write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    slides, hinges = ("".join(f'<joint type="{kind}" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
                      for kind in ("slide", "hinge"))  # fmt: skip
    for turn in (f'euler="{some} 0 {more}"', f'axisangle="1 .2 0 {some}"', 'zaxis="0 -.64 .77"', 'quat=".94 .34 0 0"',
                 'xyaxes="1 0 0 0 .77 .64"', 'type="capsule" size=".01" fromto="0 0 0 .01 .03 .05"', 'class="turned"'):
        body = f'<body name="link" {turn}/>' if turn[0] not in "ct" else ""
        path.write_text(f"""<mujoco><compiler angle="{angle}" eulerseq="zyx"/>
          <default><default class="turned"><site euler="{some} 0 {more}"/></default></default>
          <asset><mesh name="part" file="part.obj"/></asset><worldbody>
          <body>{inertial}{slides}<body>{inertial}{hinges}<geom type="mesh" mesh="part" contype="0" conaffinity="0"/>
          <frame pos="0 0 .1" euler="{more} 0 0"><site name="mine" {turn}/>{body}</frame></body></body>
          </worldbody></mujoco>""")
        for end in ("mine", "link") if body else ("mine",):
            model = build(forearm, place, robot=path, end=end).model
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
            its = data.site(end) if end == "mine" else data.body(end)
            assert abs(its.xmat[8]) < 0.99
            np.testing.assert_allclose(data.body(HEAD).xpos, its.xpos, atol=1e-9)
            np.testing.assert_allclose(data.geom(BALL).xmat, its.xmat, atol=1e-9)


def test_a_run_that_diverges_ends_with_a_sentence(forearm: SoftLayer) -> None:
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    site = Site.thickest(forearm)
    massage = Massage(build(forearm, site), Course(site.circle(0.012)), skin=Simulator(forearm, Winkler()))
    massage.controller.torques = lambda *_: np.full(7, np.nan)  # type: ignore[method-assign]
    with pytest.raises(InvalidInput, match="the simulation diverged at 0"):
        massage.run()


def test_a_robot_whose_joints_are_servos_keeps_its_force(forearm: SoftLayer, tmp_path: Path) -> None:
    """A gantry of 30 kg whose servos have limits by default, and damping; one mesh is nowhere."""
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    heavy = '<inertial pos="0 0 0" mass="10" diaginertia=".1 .1 .1"/>'
    moved = "".join(f'<body>{heavy}<joint name="j{k}" type="slide" axis="{axis}" range="-1 1" damping="500"/>'
                    for k, axis in enumerate(("1 0 0", "0 1 0", "0 0 1")))  # fmt: skip
    path = tmp_path / "gantry.xml"
    path.write_text(f"""<mujoco><compiler meshdir="assets" autolimits="true"/>
      <default><position ctrlrange="-6 6" kp="1000"/></default><asset><mesh file="gone.obj"/></asset>
      <worldbody><body pos="0 0 .5">{moved}<geom type="mesh" mesh="gone"/>
      <site name="tool" quat="0 1 0 0"/></body></body></body></body></worldbody>
      <actuator><position joint="j0"/><position joint="j1"/><position joint="j2"/></actuator></mujoco>""")
    site = Site.thickest(forearm)
    scene = build(forearm, site, robot=path, end="tool", timestep=2e-3)
    log = Massage(scene, Course(site.circle(0.012), (5.0,), laps=0.1), skin=Simulator(forearm, Winkler())).run()
    for phase in log.phases[2:4]:
        assert np.abs(log.force[log.during(phase)] - 5.0).max() < 0.2


def arm_of(axes: int, path: Path, geoms: str = 'contype="0" conaffinity="0"') -> Path:
    """A column, upper and lower arm and wrist, turning about z, y, y, y and, of five axes, x."""
    last = '<joint name="j5" axis="1 0 0" range="-1.5 1.5" damping=".2"/>' if axes == 5 else ""
    path.write_text(f"""<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body pos="0 0 .3">
      <joint name="j1" axis="0 0 1" range="-2.5 2.5" damping=".5"/>
      <geom type="cylinder" size=".05 .1" mass="3" {geoms}/><body pos="0 0 .1">
      <joint name="j2" axis="0 1 0" range="-2 2" damping=".5"/>
      <geom type="capsule" fromto="0 0 0 0 0 .35" size=".035" mass="2" {geoms}/><body pos="0 0 .35">
      <joint name="j3" axis="0 1 0" range="-.2 2.7" damping=".5"/>
      <geom name="lower" type="capsule" fromto="0 0 0 0 0 .3" size=".03" mass="1.5" {geoms}/><body pos="0 0 .3">
      <joint name="j4" axis="0 1 0" range="-2.5 2.5" damping=".2"/>
      <geom type="capsule" fromto="0 0 0 0 0 .08" size=".02" mass=".5" {geoms}/><body pos="0 0 .1">{last}
      <geom name="roller" type="capsule" fromto="0 -.03 0 0 .03 0" size=".02" mass=".2" {geoms}/>
      <site name="tcp" pos="0 0 .02"/></body></body></body></body></body></worldbody></mujoco>""")
    return path


@pytest.mark.parametrize("axes", [4, 5])
def test_an_arm_of_few_axes_keeps_its_place_before_it_points(forearm: SoftLayer, tmp_path: Path, axes: int) -> None:
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    site = Site.thickest(forearm)
    scene = build(forearm, site, robot=arm_of(axes, tmp_path / "arm.xml"), end="tcp", timestep=2e-3)
    log = Massage(scene, Course(site.circle(0.012), (5.0,), laps=0.5), skin=Simulator(forearm, Winkler())).run()
    for phase in log.phases[2:4]:
        rows = log.during(phase)
        assert np.abs(log.force[rows] - 5.0).max() < 0.1 and log.off[rows].max() < 3e-4


@pytest.mark.parametrize("what", ["gravity compensated by the motors", "a servo on a tendon", "actuation disabled"])
def test_what_a_file_does_to_the_motors_beside_is_undone(forearm: SoftLayer, tmp_path: Path, what: str) -> None:
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    path = arm_of(5, tmp_path / "arm.xml")
    text, end = path.read_text(), "</mujoco>"
    if what.startswith("gravity"):
        text = text.replace("<joint ", '<joint actuatorgravcomp="true" ').replace("<body ", '<body gravcomp="1" ')
    elif what.startswith("a servo"):
        joints = '<joint joint="j2" coef="1"/><joint joint="j3" coef="-1"/>'
        text = text.replace(end, f'<tendon><fixed name="t">{joints}</fixed></tendon><actuator><position tendon="t" '
                            f'kp="500"/></actuator>{end}')  # fmt: skip
    else:
        text = text.replace(end, f'<option><flag actuation="disable"/></option>{end}')
    path.write_text(text)
    site = Site.thickest(forearm)
    scene = build(forearm, site, robot=path, end="tcp", timestep=2e-3)
    log = Massage(scene, Course(site.circle(0.012), (5.0,), laps=0.1), skin=Simulator(forearm, Winkler())).run()
    for phase in log.phases[2:4]:
        assert np.abs(log.force[log.during(phase)] - 5.0).max() < 0.1


def test_a_file_in_millimetres_or_with_numbers_that_are_none_or_a_weld_that_pulls_is_told(
    forearm: SoftLayer, tmp_path: Path
) -> None:
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    path, site = arm_of(5, tmp_path / "arm.xml"), Site.thickest(forearm)
    text = path.read_text()
    path.write_text(text.replace("</mujoco>", '<equality><weld name="held" body1="hand"/></equality></mujoco>')
                    .replace('<body pos="0 0 .1"><joint name="j5"', '<body name="hand" pos="0 0 .1"><joint name="j5"'))
    (note,) = build(forearm, site, robot=path, end="tcp").notes
    assert note.startswith("equality constraints of the file do not hold at the start (held)")
    path.write_text(text.replace('pos="0 0 .35"', 'pos="0 0 nan"'))
    with pytest.raises(InvalidInput, match=r"nan|finite"):
        build(forearm, site, robot=path, end="tcp")
    long = "".join(f'<body pos="0 0 {z}"><joint type="slide" axis="{axis}" range="-20 20"/><inertial pos="0 0 0" '
                   'mass="1" diaginertia="1 1 1"/>' for z, axis in ((4, "1 0 0"), (4, "0 1 0"), (4, "0 0 1")))
    path.write_text(f'<mujoco><worldbody>{long}<site name="tcp" quat="0 1 0 0"/></body></body></body></worldbody>'
                    '</mujoco>')  # fmt: skip
    note, *_ = build(forearm, site, robot=path, end="tcp").notes
    assert note == "the robot's links are 12 m long in all; is its file in millimetres?"


@pytest.mark.parametrize(("roll", "lean"), [(3.14159, 0.0), (2.8, 19.57), (2.0, None)])
def test_a_tool_of_few_axes_points_as_well_as_its_place_leaves_it(
    forearm: SoftLayer, tmp_path: Path, roll: float, lean: float | None
) -> None:
    """A gantry of three slides, whose end points nearly down or elsewhere; then a hinge turns it down."""
    from stmpl_sim.engine import mujoco
    from stmpl_sim.scene import BALL, build
    from stmpl_sim.site import Site

    path, site = tmp_path / "arm.xml", Site.thickest(forearm)
    slides = "".join(f'<joint type="slide" axis="{axis}" range="-1 1"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    path.write_text(f"""<mujoco><compiler angle="radian"/><worldbody><body name="a" pos="0 0 .5">{slides}
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><body name="b" pos="0 0 .1">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><body name="c" euler="{roll} 0 0"/></body></body>
      </worldbody></mujoco>""")
    if lean is None:
        with pytest.raises(InvalidInput, match=r"pointing down \(at best 65.4 degrees off\)"):
            build(forearm, site, robot=path, end="c", at=(0.3, 0.1, 0.25))
    else:
        scene = build(forearm, site, robot=path, end="c", at=(0.3, 0.1, 0.25))
        data = mujoco.MjData(scene.model)
        data.qpos[:] = scene.qpos
        mujoco.mj_kinematics(scene.model, data)
        np.testing.assert_allclose(data.geom(BALL).xpos, [0.3, 0.1, 0.28], atol=1e-6)
        said = ", 20 degrees off straight down at the start" if lean else ""
        assert scene.notes[0].endswith(f"points as well as that leaves it{said}")
    hinge = '<body name="b" pos="0 0 .1"><joint axis="1 0 0" range="-.3 .6"/>'
    path.write_text(path.read_text().replace('<body name="b" pos="0 0 .1">', hinge))
    if lean == 0:
        return
    scene = build(forearm, site, robot=path, end="c", at=(0.3, 0.1, 0.25))
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.qpos
    mujoco.mj_kinematics(scene.model, data)
    np.testing.assert_allclose(data.geom(BALL).xpos, [0.3, 0.1, 0.28], atol=1e-6)
    off = 0 if lean else np.pi - 2.0 - 0.6  # the hinge stops
    assert np.arccos(min(1.0, -data.geom(BALL).xmat[8])) == pytest.approx(off, abs=1e-5)


def test_what_takes_an_arm_off_its_course_is_said_before_and_after(forearm: SoftLayer, tmp_path: Path) -> None:
    from dataclasses import replace

    from rich.console import Console

    from stmpl_sim.massage import Course, Log, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site
    from stmpl_sim.verbs import figures_of, table

    site = Site.thickest(forearm)
    assert build(forearm, site, gripper=True, mount="rest").notes == ()
    path = arm_of(5, tmp_path / "arm.xml")
    assert build(forearm, site, robot=path, end="tcp").notes == ()
    path.write_text(arm_of(5, path, geoms="").read_text().replace('size=".02" mass=".2"', 'size=".08" mass=".2"'))
    touching = build(forearm, site, robot=path, end="tcp").notes
    assert len(touching) == 1 and "lower and roller" in touching[0]
    scene = build(forearm, site, robot=arm_of(4, path), end="tcp", timestep=4e-3)
    assert len(scene.notes) == 1 and "4 axes" in scene.notes[0]
    log = Massage(scene, Course(site.circle(0.012), (5.0,), laps=0), skin=Simulator(forearm, Winkler())).run()
    log = Log.load(log.save(tmp_path / "log.npz"))
    assert figures_of(log)["notes"] == [*scene.notes]
    notes = figures_of(replace(log, off=log.off + 2e-3, force=log.force - 1.0))["notes"]
    assert "kept 4.00 N of 5 N during 'press'" in notes[0] and "2.0 mm off its course" in notes[1]
    console = Console(record=True, width=300)
    console.print(table(figures_of(log) | {"log": "", "every": 1}))
    assert f"to note: {scene.notes[0]}" in console.export_text()


def test_a_run_that_is_stopped_leaves_its_log(forearm: SoftLayer) -> None:
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    site = Site.thickest(forearm)
    scene = build(forearm, site, timestep=2e-3)
    massage = Massage(scene, Course(site.circle(0.012)), skin=Simulator(forearm, Winkler()))

    def stop(_: Massage, at: float) -> None:
        if at > 0.099:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        massage.run([stop])
    assert massage.log is not None and massage.log.time[-1] == pytest.approx(0.1) and len(massage.log.phases) == 7


def test_a_joint_that_stands_at_its_limit_is_named() -> None:
    import mujoco

    from stmpl_sim.ability import stuck_joints

    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><geom size=".1"/>
      <joint name="turn" range="-2 2"/><joint name="slide" type="slide" range="-.1 .1"/></body></worldbody></mujoco>""")
    limit, free = np.full(10, np.deg2rad(2.0)), np.linspace(-0.05, 0.1, 10)
    (said,) = stuck_joints(model, (0, 1), np.column_stack([limit, free]))
    assert said.startswith("joint turn stood at its limit of 2 degrees for 100% of the run")
    assert not stuck_joints(model, (0, 1), np.column_stack([0.5 * limit, free]))
    assert "slide" in stuck_joints(model, (1,), np.full((4, 2), -0.1))[0]


def test_an_arm_presses_with_its_weight_and_what_its_weakest_motor_gives(forearm: SoftLayer, tmp_path: Path) -> None:
    from stmpl_sim.ability import strength
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import BALL, HEAD_MASS, build
    from stmpl_sim.site import Site

    inertial, site = '<inertial pos="0 0 0" mass="2" diaginertia=".1 .1 .1"/>', Site.thickest(forearm)
    course, path = Course(site.circle(0.012), (5.0, 80.0), laps=0), tmp_path / "lift.xml"
    for limits, most in (('actuatorfrcrange="-50 50"', 50 + 9.81 * (2 + HEAD_MASS)), ("", np.inf)):
        path.write_text(f"""<mujoco><compiler autolimits="true"/><worldbody><body pos=".5 0 .4">{inertial}
          <joint name="up" type="slide" axis="0 0 1" {limits}/><site name="tool" quat="0 1 0 0"/></body></worldbody>
          </mujoco>""")
        scene = build(forearm, site, robot=path, end="tool")
        assert strength(scene.model, scene.joints, scene.qpos, BALL)[0] == pytest.approx(most, rel=1e-6)
        if np.isfinite(most):
            with pytest.raises(InvalidInput, match=r"with 80 N: .* motor of 'up' is at its limit from 72\.6 N on"):
                Massage(scene, course, skin=Simulator(forearm, Winkler()))
        else:
            Massage(scene, course, skin=Simulator(forearm, Winkler()))


def test_meshes_of_a_package_are_found_beside_the_file_or_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture
                                                                   ) -> None:  # fmt: skip
    """Links of a URDF as ROS has them: one mesh lies in its package, one nowhere, one is of a kind that is not read."""
    import trimesh

    from stmpl_sim.robot_file import robot_spec

    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(f'<link name="{name}"><collision><geometry><mesh filename="package://arm/meshes/{name}.{kind}"/>'
                    f"</geometry></collision>{body}</link>"
                    for name, kind in (("here", "stl"), ("gone", "stl"), ("dae", "dae")))  # fmt: skip
    joints = "".join(f'<joint name="{name}" type="continuous"><parent link="here"/><child link="{name}"/></joint>'
                     for name in ("gone", "dae"))  # fmt: skip
    for folder in ("urdf", "meshes"):
        (tmp_path / "arm" / folder).mkdir(parents=True)
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "arm" / "meshes" / "here.stl")
    (tmp_path / "arm" / "meshes" / "dae.dae").write_text("<COLLADA/>")
    path = tmp_path / "arm" / "urdf" / "arm.urdf"
    path.write_text(f'<robot name="arm">{links}{joints}</robot>')
    model = robot_spec(path).compile()
    assert (model.nmesh, model.ngeom, model.njnt) == (1, 1, 2) and model.body("gone").mass[0] == 1
    assert "2 meshes of arm.urdf are not there" in caplog.text
    xacro = tmp_path / "arm.urdf.xacro"
    xacro.write_text("<robot>${arm}</robot")
    with pytest.raises(InvalidInput, match=r"xacro FILE > robot\.urdf"):
        robot_spec(xacro)


def test_frames_drawn_in_software_show_the_nearer_of_two_triangles() -> None:
    from stmpl_sim.film import HEIGHT, WIDTH, draw

    square = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    corners = np.stack([square, 0.3 * square + [0, 0, 0.5]])
    picture = draw(corners, np.array([[1.0, 0, 0], [0, 1, 0]]), np.tile([0.0, 0, 1], (2, 1)), np.array([0.0, 0, 3]),
                   np.eye(3), 60.0)  # fmt: skip
    middle, rim = picture[HEIGHT // 2, WIDTH // 2], picture[HEIGHT // 2 + 60, WIDTH // 2]
    assert middle[1] > 100 and middle[0] == 0
    assert rim[0] > 100 and rim[1] == 0


def test_a_film_shows_where_the_skin_is_pressed(forearm: SoftLayer, tmp_path: Path) -> None:
    from PIL import Image

    from stmpl_sim.engine import mujoco
    from stmpl_sim.film import HEIGHT, STRIP, Shot, film
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    scene = build(forearm, site := Site.thickest(forearm))
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    limb = np.eye(4)
    limb[:3, :3], limb[:3, 3] = data.body("limb").xmat.reshape(3, 3), data.body("limb").xpos
    there = forearm.vertices @ limb[:3, :3].T + limb[:3, 3]
    pressure = 2e4 * (np.linalg.norm(forearm.vertices - site.point, axis=1) < 0.012)
    shots = [Shot(data, there, limb, np.zeros(len(there)), one, "") for one in (0 * pressure, pressure, None)]
    made = film(scene.model, forearm, shots, tmp_path / "film.png", most=0.01, rate=5.0, backend="software")
    assert made.colour_pa == 20e3
    with Image.open(made.path) as frames:
        pictures = []
        for k in range(3):
            frames.seek(k)
            pictures.append(np.asarray(frames.convert("RGB"), dtype=float)[:HEIGHT + STRIP])
    changed = np.abs(pictures[1] - pictures[0]).max(axis=2) > 60
    assert len(changed) == HEIGHT + STRIP and not changed[:HEIGHT].any() and 100 < changed.sum() < 10_000
    np.testing.assert_array_equal(pictures[0], pictures[2])


def test_the_environment_passes_gymnasiums_own_check_and_its_script_solves_it(forearm: SoftLayer) -> None:
    gymnasium = pytest.importorskip("gymnasium", reason="pip install 'stmpl[sim]'")
    from gymnasium.utils.env_checker import check_env

    from stmpl_sim.env import MassageEnv, Scripted

    env, policy = MassageEnv(forearm, laps=0.3), Scripted()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(3))
    check_env(env, skip_render_check=True)
    with pytest.raises(InvalidInput, match="action holds 1 values that are not finite"):
        env.step(np.array([np.nan, 0.0, 0.0]))
    observation, _ = env.reset(seed=3)
    rewards, done, failed = [], False, False
    while not (done or failed):
        observation, reward, failed, done, _ = env.step(policy.act(observation))
        rewards.append(reward)
    assert done and np.mean(rewards[20:]) > 0.6
    still = []
    observation, _ = env.reset(seed=3)
    for _ in rewards:
        still.append(env.step(np.array([-1.0, 0, 0]))[1])
    assert np.mean(still[20:]) < 0.3  # who does nothing is not paid
    with pytest.raises(InvalidInput, match="neither copied nor pickled"):
        copy.deepcopy(env)
    with pytest.raises(InvalidInput, match="render_mode"):
        MassageEnv(forearm, render_mode="human")
    with pytest.raises(InvalidInput, match="its own friction"):
        MassageEnv(Simulator(forearm, Winkler()), relaxing=True)
    for odd in (0.0, -1e-3, 3e-3, 0.03, np.nan):  # an action is held for 20 ms, no more and no less
        with pytest.raises(InvalidInput, match="timestep"):
            MassageEnv(forearm, timestep=odd)
    with pytest.raises(InvalidInput, match="circle is 0 m"):
        MassageEnv(forearm, circle=0.0)
    for name in ("circle", "laps", "timestep"):
        with pytest.raises(InvalidInput, match=f"{name} is 'a'; a finite number"):
            MassageEnv(forearm, **{name: "a"})
    with pytest.raises(InvalidInput, match="laps 0; both must be above 0"):
        MassageEnv(forearm, laps=0)
    for name in ("moving", "relaxing"):
        with pytest.raises(InvalidInput, match=f"{name} is 'no'; True or False"):
            MassageEnv(forearm, **{name: "no"})
    with pytest.raises(InvalidInput, match="proportional is nan"):
        Scripted(proportional=np.nan)


def test_the_script_holds_ten_newtons_on_the_back_of_a_person_who_breathes_sways_and_turns() -> None:
    pytest.importorskip("gymnasium", reason="pip install 'stmpl[sim]'")
    from stmpl_core.body import Body
    from stmpl_core.living import living
    from stmpl_sim.env import SWAY_M, MassageEnv, Scripted

    back = living(Body.anny(), "back", edge_length=8e-3)
    env, policy = MassageEnv(back, laps=0.3, timestep=4e-3, friction="oiled", relaxing=True), Scripted()
    observation, _ = env.reset(seed=3)
    rest, done, failed, told, moved = env.massage.limb_pose(), False, False, [], 0.0
    while not (done or failed):
        observation, reward, failed, done, info = env.step(policy.act(observation))
        told.append((info["force_N"], reward, info["off_course_m"], info["in_range"]))
        there = env.massage.limb_pose() @ np.linalg.inv(rest) @ [*env.massage.data.geom("ball").xpos, 1]
        moved = max(moved, np.linalg.norm(there[:2] - env.massage.data.geom("ball").xpos[:2]))
    force, rewards, off, in_range = np.array(told).T
    assert moved > SWAY_M and done
    assert force.mean() == pytest.approx(10.0, abs=0.3) and np.abs(force - 10.0).max() < 3
    assert rewards.mean() > 0.8 and off.max() < 3e-3 and in_range.mean() > 0.9


MANY = """
import gymnasium
from stmpl_core import Tissue
from stmpl_core.body import Body
from stmpl_sim.env import register

if __name__ == "__main__":
    register()
    flesh = Body.anny().part("left_forearm", edge_length=6e-3, tissue=Tissue(youngs_modulus=20e3))
    many = gymnasium.make_vec("stmpl/Massage-v0", num_envs=2, HOW, laps=0.1, timestep=4e-3, layer=flesh,
                              relaxing=True)
    print(many.reset(seed=[5, 6])[0][:, 0].round(1), many.step(many.action_space.sample())[1].shape)
    many.close()
"""


def test_many_environments_run_in_processes_of_their_own(tmp_path: Path) -> None:
    """In a program of its own, as docs/learning.md has it; forked ones ended where their skin was prepared."""
    pytest.importorskip("gymnasium", reason="pip install 'stmpl[sim]'")
    root, way = Path(__file__).parent.parent, 'vectorization_mode="async", vector_kwargs={"context": "spawn"}'
    assert way in (root / "docs/learning.md").read_text()
    (tmp_path / "many.py").write_text(MANY.replace("HOW", way))
    ran = subprocess.run([sys.executable, tmp_path / "many.py"], cwd=root, env=os.environ | {"PYTHONPATH": str(root)},
                         capture_output=True, text=True, timeout=300)  # fmt: skip
    assert ran.returncode == 0 and "[1. 1.] (2,)" in ran.stdout, ran.stderr


def test_an_episode_begins_on_skin_that_remembers_the_press(forearm: SoftLayer) -> None:
    pytest.importorskip("gymnasium", reason="pip install 'stmpl[sim]'")
    from stmpl_sim.env import MassageEnv, Scripted

    slow = forearm.with_(tissue=Tissue(20e3, relaxation=Prony((0.3, 0.3), (0.1, 1.0))))
    env, policy = MassageEnv(Simulator(slow, Winkler()), laps=0.1, timestep=4e-3), Scripted()
    for _ in range(2):
        observation, _ = env.reset(seed=1)
        assert observation[0] == pytest.approx(1.0, abs=0.05)  # 10 N, not those of skin that was never pressed
        for _ in range(10):
            observation, *_ = env.step(policy.act(observation))


def test_the_verb_prints_figures_and_leaves_log_and_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from stmpl_ros.cli import main

    flags = "sim --tissue single --force 5 --laps 0 --rate 250 --film software --json --out".split()
    with pytest.raises(SystemExit) as ended:
        main([*flags, str(tmp_path)])
    assert ended.value.code == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["phases"][0]["mean_N"] == pytest.approx(5.0, abs=0.05) and figures["frames_by"] == "software"
    assert len(np.load(tmp_path / "log.npz")["force"]) == 1750
    assert figures["grip"]["mean_N"] == pytest.approx(10.0, abs=0.5) and figures["grip"]["lifted_m"] > 5e-3
    assert Path(figures["film"]).stat().st_size > 10_000
    for wrong, why in ((["--rate", "5"], "allowed is 50 to 20000"), (["--speed", "0.05"], "Is it in metres?"),
                       (["--force", "-1"], "above 0 N"), (["--circle", "0"], "a radius above 0 is needed"),
                       (["--radius", "0"], "ball's radius is 0 m"), (["--force", "5000"], "cannot press with 5000 N"),
                       (["--robot", "nothing.urdf"], "no robot file"),
                       (["--phenotype", "weight=80"], "not from 0 to 1"),
                       (["--phenotype", "size=1"], "no phenotype; known are gender")):  # fmt: skip
        with pytest.raises(SystemExit) as ended:
            main([*flags, str(tmp_path), *wrong])
        assert ended.value.code == 1 and why in capsys.readouterr().err


def test_an_arm_starts_where_its_joints_have_room(forearm: SoftLayer, tmp_path: Path) -> None:
    """Two slides carry the ball sideways: the aim leaves one free, and it goes off its limit."""
    from stmpl_sim.scene import ROOM, build
    from stmpl_sim.site import Site

    path = tmp_path / "arm.xml"
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    path.write_text(f"""<mujoco><worldbody>
      <body name="a" pos="0 0 .8">{inertial}<joint name="far" type="slide" axis="1 0 0" range="-.4 .6"/>
      <body name="b">{inertial}<joint name="x" type="slide" axis="1 0 0" range="-.02 .8"/>
      <joint name="y" type="slide" axis="0 1 0" range="-1 1"/><joint name="z" type="slide" axis="0 0 1" range="-.6 .6"/>
      <body name="c" quat="0 1 0 0">{inertial}</body></body></body>
      </worldbody><keyframe><key qpos=".5 0 0 0"/></keyframe></mujoco>""")
    scene = build(forearm, Site.thickest(forearm), robot=path, end="c")
    low, high = scene.model.jnt_range[list(scene.joints)].T
    room = np.minimum(scene.qpos[:4] - low, high - scene.qpos[:4]) / (high - low)
    assert room.min() >= ROOM and scene.qpos[1] > 0.05  # the key's place would leave 2 cm of 82


def test_a_site_or_a_timestep_that_is_none_is_refused(forearm: SoftLayer) -> None:
    from stmpl_sim.massage import Course
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    for vertex in (-1, len(forearm.vertices), 0.5):
        with pytest.raises(InvalidInput, match=r"the vertex is .*; a whole number"):
            Site(forearm, vertex)  # type: ignore[arg-type]
    coarse = trimesh.creation.box((0.2, 0.1, 0.1))
    with pytest.raises(InvalidInput, match="no vertex is in the middle part"):
        Site.thickest(SoftLayer(coarse.vertices, coarse.faces, 0.01))
    for timestep in (0.0, -1e-3, np.nan, 10.0, "1 ms"):
        with pytest.raises(InvalidInput, match="timestep is"):
            build(forearm, Site(forearm, 0), timestep=timestep)  # type: ignore[arg-type]
    circle = Site.thickest(forearm).circle(0.01)
    for given, says in (({"forces": (np.inf,)}, "above 0 N"), ({"speed": 1000.0}, "Is it in mm/s"),
                        ({"forces": 5.0}, "forces is 5.0; tuple or list"), ({"grip": "firm"}, "grip is 'firm'"),
                        ({"laps": None}, "laps is None"), ({"forces": ("5",)}, "forces are"),
                        ({"grip": -1.0}, "the grip is -1")):  # fmt: skip
        with pytest.raises(InvalidInput, match=says):
            Course(circle, **given)  # type: ignore[arg-type]
