"""A limb whose hinge belongs to the simulator: its skin goes along, each side of it feels its own touches."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stmpl_core import Contact, Simulator, Skin
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Winkler
from stmpl_sim import Memory, Poses, SoftBody, SoftContact
from tests.scenes import RADIUS, at, ball, limb, plate
from tests.test_posing import MIDDLE, hinged

mujoco = pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")

BALL = 0.012  # m
XML = """
<mujoco><option timestep="1e-3" gravity="0 0 0"/><worldbody>
  <body name="upper"><geom name="humerus" type="capsule" fromto="0 0 .01 0 0 .07" size=".01" mass="1"/>
    <body name="lower" pos="0 0 {z}">
      <joint name="hinge" type="{kind}" axis="0 1 0" damping=".02"/>
      <geom name="ulna" type="capsule" fromto="0 0 .01 0 0 .07" size=".01" mass=".5"/></body></body>
  <body name="bob" mocap="true" pos="{at}"><geom name="ball" type="sphere" size=".012"/></body>
</worldbody><contact><exclude body1="upper" body2="bob"/><exclude body1="lower" body2="bob"/></contact></mujoco>"""


@pytest.fixture(scope="module")
def skin() -> Skin:
    layer = limb(4e-3, youngs_modulus=20e3)
    return Skin.of(layer.with_(rig=hinged(layer)), Winkler())


def made(skin: Skin, place: np.ndarray, kind: str = "hinge", joints: dict[str, str] | None = None) -> tuple[Any, ...]:
    """Model, data and skin, with a ball of 12 mm there."""
    text = XML.format(z=MIDDLE[2], kind=kind, at=" ".join(f"{x:.9g}" for x in place))
    model = mujoco.MjModel.from_xml_string(text)
    return model, mujoco.MjData(model), SoftBody(model, skin, body="upper", tools=["ball"],
                                                 joints=joints or {"elbow": "hinge"})  # fmt: skip


def on_the_lower_part(skin: Skin, angle: float, depth: float = 2e-3) -> np.ndarray:
    """Place of the ball on the skin that goes with the hinge, (3,) [m]."""
    assert skin.layer.rig is not None
    motion = skin.layer.rig.motions((angle,))[1]
    return motion[:3, :3] @ [RADIUS + BALL - depth, 0, 0.13] + motion[:3, 3]


def test_touches_of_skin_that_is_elsewhere_now_move_nothing_and_say_so(skin: Skin) -> None:
    place = on_the_lower_part(skin, 0.3)
    simulator = Simulator(skin.posed({"elbow": 0.3}))
    touches = simulator.touch([Contact(ball(), at(*place))])
    assert simulator.answer(touches).displacement.any()
    simulator.pose({"elbow": 0.1})
    with pytest.raises(InvalidInput, match="joints have moved"):
        simulator.answer(touches)
    with pytest.raises(InvalidInput, match="vertices"):
        Simulator(plate(), Winkler()).answer(touches)


def test_the_wrench_is_that_of_the_bent_skin_and_the_hinges_body_feels_it(skin: Skin) -> None:
    place = on_the_lower_part(skin, 0.3)
    model, data, soft = made(skin, place)
    data.qpos[0] = 0.3
    touch = soft.apply(data)["ball"]
    truth = Simulator(skin.posed({"elbow": 0.3})).touch([Contact(soft.contact.tools["ball"], at(*place))])[0]
    assert truth.force > 0.1
    np.testing.assert_allclose(touch.wrench, truth.wrench, atol=1e-6 * truth.force)
    bodies = {name: data.xfrc_applied[model.body(name).id] for name in ("upper", "lower", "bob")}
    np.testing.assert_allclose(sum(bodies.values())[:3], 0, atol=1e-9)
    np.testing.assert_allclose(bodies["lower"][:3], truth.wrench[:3], atol=1e-3 * truth.force)


def test_who_presses_beyond_the_hinge_turns_it_away_and_the_balance_of_angular_momentum_holds(skin: Skin) -> None:
    place = on_the_lower_part(skin, 0.0)
    model, data, soft = made(skin, place)
    for _ in range(400):
        mujoco.mj_step1(model, data)
        soft.apply(data)
        mujoco.mj_step2(model, data)
    assert data.qpos[0] < -0.005  # the ball is on the side of +x: it pushes what is above the hinge towards -x
    assert soft.simulator.skin.angles == () or abs(soft.simulator.skin.angles[0] - data.qpos[0]) < 0.021
    moment = np.zeros(3)
    for body in range(model.nbody):
        force, torque = np.split(data.xfrc_applied[body], 2)
        moment += torque + np.cross(data.xipos[body], force)
    np.testing.assert_allclose(moment, 0, atol=1e-9)


def beside_the_hinge(skin: Skin, angle: float, depth: float) -> np.ndarray:
    """Place of the ball on the skin that goes half with the hinge, where a bend stretches it, (3,) [m]."""
    bent = skin.posed({"elbow": angle}).layer
    vertex = int(np.linalg.norm(skin.layer.vertices - [RADIUS, 0, MIDDLE[2] + 4e-3], axis=1).argmin())
    return bent.vertices[vertex] + (BALL - depth) * bent.normals[vertex]


@pytest.mark.parametrize("depth", [0.5e-3, 2e-3])
def test_between_two_poses_a_touch_beside_the_hinge_is_that_of_the_posed_skin(skin: Skin, depth: float) -> None:
    """The skin goes as it does there, not as the bone that it mostly goes with: no force jumps as it is posed again."""
    _, data, soft = made(skin, on_the_lower_part(skin, 0.0))
    tool, forces, off = soft.contact.tools["ball"], [], []
    for k in range(41):
        angle = -0.0025 * k
        data.qpos[0], data.mocap_pos[0], data.time = angle, beside_the_hinge(skin, angle, depth), 1e-3 * k
        touch = soft.apply(data)["ball"]
        truth = Simulator(skin.posed({"elbow": angle})).touch([Contact(tool, at(*data.mocap_pos[0]))])[0]
        forces.append(touch.force)
        off.append(touch.force / truth.force - 1)
        assert touch.trust.in_range
    assert np.abs(off).max() < 0.02
    assert np.abs(np.diff(forces)).max() < 0.02 * np.mean(forces)


def test_a_hinge_that_turns_to_and_fro_over_a_tool_gets_nothing_out_of_the_skin(skin: Skin) -> None:
    model, data, soft = made(skin, beside_the_hinge(skin, 0.0, 2e-3))
    torque, angles, steps = [], 0.1 * np.sin(np.linspace(0, 2.5 * np.pi, 201)), np.zeros(1)
    for k, angle in enumerate(angles):
        data.qpos[0], data.time = angle, 1e-3 * k
        soft.apply(data)
        mujoco.mj_fwdPosition(model, data)
        steps[:] = 0.0
        for body in range(model.nbody):
            force, turn = np.split(data.xfrc_applied[body], 2)
            mujoco.mj_applyFT(model, data, force, turn, data.xipos[body], body, steps)
        torque.append(float(steps[0]))
    work = 0.5 * np.add(torque[1:], torque[:-1]) * np.diff(angles)
    round_once = slice(40, 200)  # from one end of the way to the same end
    assert np.abs(work[round_once]).sum() > 1e-4
    assert abs(work[round_once].sum()) < 0.01 * np.abs(work[round_once]).sum() / 2


def test_two_skins_of_one_simulator_stand_each_where_its_own_hinge_is(skin: Skin) -> None:
    places = [on_the_lower_part(skin, angle) for angle in (0.3, 0.0)]
    model, first, one = made(skin, places[0])
    other, second = SoftBody(model, one.simulator, body="upper", tools=["ball"], joints={"elbow": "hinge"}), \
        mujoco.MjData(model)  # fmt: skip
    first.qpos[0], second.mocap_pos[0] = 0.3, places[1]
    told = [one.apply(first)["ball"], other.apply(second)["ball"]]
    for step in (1, 2):
        first.time = second.time = 1e-3 * step
        for soft, data, before in ((one, first, told[0]), (other, second, told[1])):
            np.testing.assert_allclose(soft.apply(data)["ball"].wrench, before.wrench, rtol=1e-9)
    vertices = [soft.skin_points(data) for soft, data in ((one, first), (other, second), (one, first))]
    assert np.abs(vertices[0] - vertices[1]).max() > 0.01
    np.testing.assert_array_equal(vertices[0], vertices[2])


def test_a_bend_goes_on_from_its_memory_as_it_went_on_then(skin: Skin) -> None:
    def run(soft: SoftBody, data: Any, steps: range) -> list[np.ndarray]:
        out = []
        for k in steps:
            angle = 0.012 * k
            data.qpos[0], data.mocap_pos[0], data.time = angle, beside_the_hinge(skin, angle, 2e-3), 1e-3 * k
            soft.apply(data)
            out.append(data.xfrc_applied.copy())
        return out

    model, data, soft = made(skin, on_the_lower_part(skin, 0.0))
    run(soft, data, range(4))
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION)
    state, memory = np.empty(size), soft.memory
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    went_on = run(soft, data, range(4, 10))
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    soft.memory = memory
    np.testing.assert_array_equal(run(soft, data, range(4, 10)), went_on)


def test_another_skin_goes_on_from_the_memory_where_the_end_of_a_step_is_taken(skin: Skin) -> None:
    """The body that gives way, the hinge's, is that under the last touch."""
    model, first, soft = made(skin, on_the_lower_part(skin, 0.0))
    pair = [(SoftBody(model, skin, body="upper", tools=["ball"], joints={"elbow": "hinge"}, implicit=True), data)
            for data in (first, mujoco.MjData(model))]  # fmt: skip
    soft.reset(first)
    for k in range(4):
        for n, (one, data) in enumerate(pair):
            data.mocap_pos[0], data.time = on_the_lower_part(skin, 0.0, 2e-3 + 2e-4 * k), 1e-3 * k
            if n == 0 or k == 3:
                one.apply(data)
        if k == 2:
            pair[1][0].memory = pair[0][0].memory
    assert first.xfrc_applied.any()
    np.testing.assert_array_equal(pair[1][1].xfrc_applied, first.xfrc_applied)


def test_between_two_poses_of_the_skin_it_goes_along_with_its_bone(skin: Skin) -> None:
    model, data, soft = made(skin, on_the_lower_part(skin, 0.3))
    data.qpos[0] = 0.3
    first = soft.apply(data)["ball"]
    posed = soft.simulator.skin
    data.qpos[0], data.mocap_pos[0] = 0.305, on_the_lower_part(skin, 0.305)
    data.time = 1e-3
    again = soft.apply(data)["ball"]
    assert soft.simulator.skin is posed
    assert again.force == pytest.approx(first.force, rel=1e-3)  # the ball did not turn along
    tool = soft.contact.tools["ball"]
    truth = Simulator(skin.posed({"elbow": 0.305})).touch([Contact(tool, at(*data.mocap_pos[0]))])[0]
    np.testing.assert_allclose(-data.xfrc_applied[model.body("bob").id][:3], truth.wrench[:3], atol=2e-3 * truth.force)
    data.qpos[0], data.mocap_pos[0] = 0.33, on_the_lower_part(skin, 0.33)
    data.time = 2e-3
    assert soft.apply(data)["ball"].force == pytest.approx(first.force, rel=1e-3)
    assert soft.simulator.skin.angles == (0.33,)


def test_a_hinge_beyond_the_limits_of_its_skin_is_flagged(skin: Skin) -> None:
    rig = skin.layer.rig
    assert rig is not None
    narrow = replace(rig, joints=(replace(rig.joints[0], low=-0.1, high=0.3),))
    limited = Skin.of(skin.layer.with_(rig=narrow), Winkler())
    _, data, soft = made(limited, on_the_lower_part(skin, 0.3))
    for angle, said in ((0.31, False), (0.5, True)):
        data.qpos[0] = angle
        touch = soft.apply(data)["ball"]
        assert touch.presses and ("elbow is at 0.5 rad, its skin goes from -0.1 to 0.3" in touch.trust.why) == said
        assert soft.answer().trust.in_range is False or not said


def test_a_hinge_that_turns_about_another_axis_than_the_rigs_is_said(skin: Skin, caplog: Any) -> None:
    rig, place = skin.layer.rig, on_the_lower_part(skin, 0.0)
    assert rig is not None
    made(skin, place)
    assert not caplog.messages
    for changed in (replace(rig.joints[0], axis=(0.0, -1.0, 0.0)), replace(rig.joints[0], axis=(0.0, 1.0, 0.3))):
        made(Skin.of(skin.layer.with_(rig=replace(rig, joints=(changed,))), Winkler()), place)
    lower = replace(rig, heads=rig.heads + [[0, 0, 0], [0, 0, 0.03]])
    made(Skin.of(skin.layer.with_(rig=lower), Winkler()), place)
    said = ["180 degrees and 0 mm off", "17 degrees and 0 mm off", "0 degrees and 30 mm off"]
    assert len(caplog.messages) == 3
    assert all(one in message for one, message in zip(said, caplog.messages, strict=True))


def test_joints_that_are_none_are_refused(skin: Skin) -> None:
    place = on_the_lower_part(skin, 0.0)
    with pytest.raises(InvalidInput, match=r"unknown joint: knee. Available: elbow"):
        made(skin, place, joints={"knee": "hinge"})
    with pytest.raises(InvalidInput, match=r"no joint 'elbow'. Joints: hinge"):
        made(skin, place, joints={"elbow": "elbow"})
    with pytest.raises(InvalidInput, match="is no hinge"):
        made(skin, place, kind="slide")
    with pytest.raises(InvalidInput, match="this layer has no joints"):
        made(Skin.of(limb(4e-3), Winkler()), place)
    _, data, soft = made(skin, place)
    data.qpos[0] = np.nan
    with pytest.raises(InvalidInput, match=r"elbow is nan rad. Has the simulation diverged"):
        soft.apply(data)


def test_no_time_is_lost_where_joints_move_between_two_steps_that_ask(skin: Skin) -> None:
    tool = ball(BALL)
    contact, memory = SoftContact(skin, [tool], every=100), Memory()
    poses = Poses(np.eye(4), {tool.name: at(*on_the_lower_part(skin, 0.0))})
    for k in range(4):
        memory = contact.step(poses, memory, 1e-3 * (k > 0)).memory
    assert memory.asked is not None and memory.asked.steps == 3 and memory.waited == pytest.approx(3e-3)
    memory = contact.pose({"elbow": 0.05}, memory)
    assert memory.asked is None and memory.waited == pytest.approx(3e-3)
    memory = contact.step(poses, memory, 1e-3).memory
    assert memory.asked is not None and memory.asked.steps == 0 and memory.waited == 0


def test_a_tool_that_is_nowhere_is_said_and_one_that_is_far_is_flagged(skin: Skin) -> None:
    _, data, soft = made(skin, on_the_lower_part(skin, 0.0))
    for place, why in ((np.nan, "the pose of ball .* Has the simulation diverged"), (np.inf, "Has the simulation")):
        data.mocap_pos[0] = place
        with pytest.raises(InvalidInput, match=why):
            soft.apply(data)
    data.mocap_pos[0] = (1e3, 0, 0)
    for _ in range(2):
        touch = soft.apply(data)["ball"]
        assert not touch.trust.in_range and "is its pose in millimetres" in touch.trust.why
