"""Laws of tools that go too deep: the core is hard, and motion has a bound."""

import numpy as np
import pytest
import trimesh

from stmpl_core import Rig, Simulator, Skin, Tissue, Tool
from stmpl_core.batch import Batch
from stmpl_core.body import Body
from stmpl_core.columns import NO_SQUEEZE
from stmpl_core.contact_net import NOTHING
from stmpl_core.deep import DEEPEST
from stmpl_core.methods import MomentNet, Winkler
from stmpl_core.touch import APART, IN_CORE, NO_FORCE
from stmpl_core.toucher import _Placed
from tests.scenes import LENGTH, RADIUS, STACK, at, ball, box, capsule, limb, plate, press, punch, touch_of, turn

LIMB = limb(4e-3)
LIMBS = {"paper": LIMB, "layered": limb(6e-3, 0.02, 0.05, LENGTH).with_(tissue=STACK)}
BALLS = {"paper": (ball(), 0.012), "layered": (ball(0.02), 0.02)}
LYING = turn((0, 1, 0), np.pi / 2)
TOOLS = {"ball": (ball(), 0.012), "small ball": (ball(0.004), 0.004), "slab": (box(0.004, 0.03, 0.03), 0.002),
         "capsule": (capsule(0.02, 0.008), 0.008)}  # fmt: skip


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator(LIMB, MomentNet())


@pytest.fixture(scope="module")
def touched() -> dict[str, Simulator]:
    return {kind: Simulator(layer, MomentNet()) for kind, layer in LIMBS.items()}


def pressed(sim: Simulator, tool: Tool, half: float, depth: float, side: float = 1.0):
    return sim.step([press(tool, at(side * (RADIUS + half - depth), 0, LENGTH / 2), None)])


@pytest.mark.parametrize("name", TOOLS)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_force_rises_with_depth_for_ever(sim: Simulator, name: str, side: float) -> None:
    """To the limb's axis: through the layer, the core, and where the whole tool is inside."""
    tool, half = TOOLS[name]
    depths = np.concatenate([np.linspace(5e-4, 9e-3, 35), np.linspace(0.01, RADIUS - 0.004, 12)])
    touches = [touch_of(pressed(sim, tool, half, d, side)) for d in depths]
    forces = np.array([touch.force for touch in touches])
    assert (np.diff(forces) > 0).all()
    assert all(touch.status == IN_CORE and not touch.trust.in_range for touch in touches[-12:])
    assert all(side * touch.wrench[0] < 0 for touch in touches)


@pytest.mark.parametrize("name", TOOLS)
def test_no_vertex_moves_further_than_the_layer_is_thick(sim: Simulator, name: str) -> None:
    tool, half = TOOLS[name]
    for depth in (5e-3, 7e-3, 9e-3, 0.02, 0.03):
        assert pressed(sim, tool, half, depth).magnitude.max() <= LIMB.thickness.max()


def test_force_has_no_step_where_the_tool_begins_to_be_drawn_back(sim: Simulator) -> None:
    tool, half = TOOLS["ball"]
    forces = [touch_of(pressed(sim, tool, half, d)).force for d in np.arange(6.2e-3, 8.2e-3, 2e-5)]
    assert np.diff(np.log(forces)).max() < 0.03


@pytest.mark.parametrize("force", [1e-3, 0.1, 1.0, 1e6])
def test_a_wrench_brings_a_tool_out_of_the_core(sim: Simulator, force: float) -> None:
    """The stated pose is a first guess, however bad."""
    tool, half = TOOLS["ball"]
    deep = [touch_of(sim.step([press(tool, at(RADIUS + half - d, 0, LENGTH / 2), (-force, 0, 0))]))
            for d in (2e-3, 9e-3, 0.024)]  # fmt: skip
    for one in deep[1:]:
        assert one.force == pytest.approx(deep[0].force, rel=0.02)
        assert one.depth == pytest.approx(deep[0].depth, rel=0.05)


def test_what_is_beside_or_around_the_limb_is_not_inside(sim: Simulator) -> None:
    ring = Tool("ring", *_ring(RADIUS + 0.01, 0.004))
    cases = [press(ring, at(0, 0, LENGTH / 2), None), press(punch(), at(0, 0, LENGTH + 0.03), None),
             press(ball(), at(RADIUS + 0.013, 0, LENGTH / 2), None)]  # fmt: skip
    for contact in cases:
        assert touch_of(sim.step([contact])).status == APART
    inside = press(ball(), at(0, 0, LENGTH / 2), (0, 0, 0))
    assert touch_of(sim.step([inside])).status == NO_FORCE


def test_a_tool_under_a_flat_layer_is_in_its_core() -> None:
    layer, radius = plate(0.09), 0.004
    sim, t = Simulator(layer, Winkler()), float(layer.thickness.max())
    touches = [touch_of(sim.step([press(ball(radius), at(0, 0, radius - depth * t), None)]))
               for depth in (0.9, 1.1, 1.5, 1.9, 2.4)]  # fmt: skip
    assert all(touch.status == IN_CORE and not touch.trust.in_range for touch in touches[1:])
    assert (np.diff([touch.force for touch in touches]) > 0).all()
    beside = touch_of(sim.step([press(ball(radius), at(0.06, 0, -t), None)]))
    assert beside.status == APART


def test_a_torque_without_a_force_is_told_of() -> None:
    from dataclasses import replace

    contact = replace(press(ball(), at(RADIUS + 0.01, 0, LENGTH / 2), (0, 0, 0)), wrench=np.array([0, 0, 0, 0, 0, 0.1]))
    touch = touch_of(Simulator(LIMB, Winkler()).step([contact]))
    assert touch.status == NO_FORCE and not touch.trust.in_range and "torque without a force" in touch.trust.why


def _ring(radius: float, thick: float) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.torus(1e3 * radius, 1e3 * thick, 64, 24)
    return 1e-3 * np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize("name", TOOLS)
def test_columns_alone_say_what_all_that_is_squeezed_says(sim: Simulator, name: str) -> None:
    tool, half = TOOLS[name]
    field, deep = sim.tools.field(tool), sim.history.toucher.deep
    said = []
    for depth in np.linspace(4e-3, 0.012, 17):
        pose = at(RADIUS + half - depth, 0, LENGTH / 2)
        squeeze = deep.columns.squeezed(field, pose)
        beyond = deep.strain(squeeze) > DEEPEST if len(squeeze.nodes.area) else deep.inside(field, pose, tool.vertices)
        said.append(deep.beyond(field, pose, tool.vertices))
        assert said[-1] == beyond, f"{1e3 * depth:.1f} mm"
    assert any(said) and not all(said)


@pytest.mark.parametrize(("depth", "mass", "integral", "steps"), [
    (0.86, 1.0, 0.0, 700), (0.9, 3.0, 0.0, 700), (1.05, 1.0, 0.0, 700), (1.2, 2.0, 2.0, 3000)])  # fmt: skip
@pytest.mark.parametrize("kind", LIMBS)
def test_a_force_controller_settles_on_the_barrier(touched: dict[str, Simulator], kind: str, depth: float, mass: float,
                                                   integral: float, steps: int) -> None:  # fmt: skip
    """1 kHz, semi-implicit Euler: mass [kg] and damper, half of the error fed back, and its integral [1/s] or none.

    The damper knows the stiffness at the force that is asked for; a limit cycle would stay.
    """
    sim, t, dt = touched[kind], LIMBS[kind].thickness.max(), 1e-3
    tool, half = BALLS[kind]
    front = LIMBS[kind].vertices[:, 0].max() + half

    def force(way: float) -> float:
        return sim.touch([press(tool, at(front - way, 0, LENGTH / 2), None)])[0].force

    wanted, way, speed, total, found = force(depth * t), 0.8 * t, 0.0, 0.0, []
    stiffness = (force((depth + 0.01) * t) - force((depth - 0.01) * t)) / (0.02 * t)
    damping = 2 * np.sqrt(1.5 * mass * stiffness)
    for _ in range(steps):
        found.append(force(way))
        error = wanted - found[-1]
        total += integral * dt * error
        speed += dt / mass * (1.5 * error + total - damping * speed)
        way += dt * speed
    off = np.abs(np.array(found) / wanted - 1)
    assert off[-100:].max() < 0.01 and np.ptp(off[-50:]) < 1e-3


def test_in_a_crease_a_tool_is_drawn_back_between_the_folds_not_through_the_limb() -> None:
    """A hair's breadth aside it was drawn back 26 cm along the arm, and pressed with 300 N in place of 15."""
    body = Body.anny()
    arm = body.part("left_arm", edge_length=7e-3)
    arm = arm.with_(rig=Rig.of(body, "left_arm", arm))
    skin = Skin.of(arm, Winkler())
    elbow, head = arm.rig.joints[0].name, arm.rig.heads[1]
    half, near = skin.posed({elbow: 0.5}).layer, np.flatnonzero(np.linalg.norm(arm.vertices - head, axis=1) < 0.06)
    inside = near[np.argmin(half.vertex_areas[near] / arm.vertex_areas[near])]
    there = skin.posed({elbow: 0.6}).layer
    place = there.vertices[inside] + 0.01275 * there.normals[inside]
    bent, rng, forces = Simulator(skin.posed({elbow: 1.02})), np.random.default_rng(0), []
    for _ in range(14):
        touch = bent.touch([press(ball(0.015), at(*(place + rng.normal(0, 3e-4, 3))), None)])[0]
        assert touch.status == IN_CORE and not touch.trust.in_range and touch.depth < 0.03
        forces.append(touch.force)
    assert max(forces) < 1.2 * min(forces)


def test_a_rim_at_the_core_is_told_of_where_the_rest_is_not_deep() -> None:
    """Tissue of 8 mm that thins to 4: the tool is drawn back for the one, and is not that deep in the mean."""
    layer = plate(0.12, 3e-3)
    thickness = 8e-3 - 4e-3 * np.clip((layer.vertices[:, 0] - 4e-3) / 6e-3, 0, 1)
    uneven = Simulator(layer.with_(thickness=thickness, tissue=Tissue(2e4, 0.4)), Winkler())
    for depth, told in ((3.4e-3, False), (3.7e-3, True)):
        (touch,) = uneven.touch([press(box(0.03, 0.02, 0.02), at(0, 0, 0.01 - depth), None)])
        assert touch.pressed is not None
        assert touch.pressed.factor == 1
        assert ("a part of the skin below it to over 90%" in touch.trust.why) == told


@pytest.mark.parametrize("tool", [ball(), box(0.02, 0.02, 0.01)], ids=["ball", "box"])
def test_a_tool_below_an_open_sheet_is_not_apart(tool: Tool) -> None:
    simulator, high = Simulator(plate(0.12, 3.5e-3, 0.01), MomentNet()), float(tool.vertices[:, 2].max())
    for top in (2e-3, 8e-3, 0.012, 0.015, 0.02):
        (touch,) = simulator.touch([press(tool, at(1e-3, 1.3e-3, -top - high), None)])
        assert touch.status == IN_CORE and not touch.trust.in_range, top
        assert touch.force > 0
    for aside in ((0.08, -0.02), (0.0, high + 1e-3)):  # beside the sheet and over it
        assert simulator.touch([press(tool, at(aside[0], 0, aside[1]), None)])[0].status == APART


def cone(half_angle: float, high: float = 0.03) -> trimesh.Trimesh:
    """A cone that stands on its tip at the origin [m]."""
    mesh = trimesh.creation.cone(1e3 * high * np.tan(np.radians(half_angle)), 1e3 * high, sections=64)
    return trimesh.Trimesh(1e-3 * mesh.vertices * [1, 1, -1] + [0, 0, high], mesh.faces[:, ::-1], process=False)


def handled(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same with a handle that overlaps it."""
    handle = trimesh.creation.cylinder(0.01, 0.04, sections=32)
    return trimesh.util.concatenate([mesh, handle.apply_translation([0, 0, 0.045])])


def soup(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same of triangles that share no vertex."""
    return trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False)


@pytest.mark.parametrize("made", [cone(10), cone(15), cone(25), soup(cone(20)), handled(cone(20))],
                         ids=["10", "15", "25", "soup", "handle"])  # fmt: skip
def test_a_tip_between_columns_that_reaches_the_core_is_told_of(made: trimesh.Trimesh) -> None:
    """Columns around it are 37 to 84 % deep; a tip that ends in the tissue is none. On the CPU and by Warp."""
    layer, tool = plate(0.12, 3e-3), Tool("probe", np.asarray(made.vertices), np.asarray(made.faces))
    sim = Simulator(layer, MomentNet())
    poses = [at(1.1e-3, 0.7e-3, -share * float(layer.thickness[0])) for share in (0.7, 1.05)]
    bounds = []
    for pose, sound in zip(poses, (True, False), strict=True):
        (touch,) = sim.touch([press(tool, pose, None)])
        assert ("a corner of probe" in touch.trust.why) != sound
        assert sound or not touch.trust.in_range
        bounds.append(touch.force_bound / touch.force)
    assert bounds[1] > 1.3 * bounds[0]
    pytest.importorskip("warp")
    from stmpl_core.gpu.warp_batch import WarpBatch

    skin = Skin.of(layer, MomentNet())
    ours, there = (batch.touch(np.array(poses)[:, None]) for batch in
                   (Batch(skin, [tool], 2), WarpBatch(skin, [tool], 2, device="cpu")))  # fmt: skip
    assert not np.asarray(there.in_range)[1].any() and np.asarray(there.in_range)[0] == ours.in_range[0]
    served = np.asarray(there.wrenches)[:, 0, :3].any(axis=1)
    np.testing.assert_allclose(np.asarray(there.force_bounds)[served], ours.force_bounds[served], rtol=1e-3)


def test_a_corner_on_the_other_side_of_the_limb_is_not_in_its_core() -> None:
    """Of a clamp whose other jaw is a millimetre off the skin there."""
    layer = limb(5e-3, 0.03, RADIUS, LENGTH).with_(tissue=STACK)
    sim, bounds = Simulator(layer, MomentNet()), []
    jaw = trimesh.creation.box([4e-3, 0.02, 0.02]).apply_translation([-2 * RADIUS - 0.02 + 0.45 * 0.03 - 3e-3, 0, 0])
    round_ = trimesh.creation.icosphere(4, 0.02)
    for mesh in (round_, trimesh.util.concatenate([round_, jaw])):
        tool = Tool("probe", np.asarray(mesh.vertices), np.asarray(mesh.faces))
        (touch,) = sim.touch([press(tool, at(RADIUS + 0.02 - 0.45 * 0.03, 0, LENGTH / 2), None)])
        assert touch.trust.in_range
        bounds.append(touch.force_bound)
    assert bounds[1] == pytest.approx(bounds[0], rel=0.1)


def test_what_is_inside_the_core_and_presses_nothing_has_no_bound(sim: Simulator) -> None:
    contact = press(ball(), at(0, 0, LENGTH / 2), None)
    field = sim.tools.field(contact.tool)
    for status, unknown in ((IN_CORE, True), (APART, False)):
        placed = _Placed(contact, field, status, contact.pose_body_from_tool, 0.01, 0.0, NO_SQUEEZE, None)
        touch = sim.toucher._answer(placed, NOTHING, None, True, False)
        assert touch.force == 0 and np.isnan(touch.force_bound) == unknown
