"""Laws of a limb whose joints move: what a pose keeps, what turns with it, what it spoils and says so."""

import json
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from benchmarks.living_limbs import ball as ball_of
from benchmarks.posing import JOINT, sites
from benchmarks.posing import arm as arm_of
from fem_tools import IndenterFem, PatchFem, Press
from stmpl_core import Answer, Contact, Membrane, Ply, Simulator, Skin, SoftLayer, State, Tissue
from stmpl_core.batch import Batch
from stmpl_core.body import Body
from stmpl_core.bones import Bone, to_bone
from stmpl_core.errors import InvalidInput
from stmpl_core.green import Green
from stmpl_core.history import History
from stmpl_core.layer import layer_id
from stmpl_core.load import Load
from stmpl_core.methods import Coarse, Linear, MomentNet, Winkler
from stmpl_core.methods import method as method_named
from stmpl_core.methods.base import anew
from stmpl_core.nodes import Nodes
from stmpl_core.posing import posed
from stmpl_core.rig import Joint, Rig
from stmpl_core.sdf import SignedDistance
from stmpl_core.soundness import HOLLOW
from stmpl_core.state import UNKNOWN, Scalars
from stmpl_core.toucher import Toucher
from stmpl_ros.making import MOVED
from tests.scenes import LENGTH, RADIUS, at, ball, limb

MIDDLE = np.array([0.0, 0, LENGTH / 2])
STACK = Tissue(3e3, 0.45, skin=Membrane(2e5, 1.5e-3, 20.0, source="a row"), deeper=(Ply(10e-3, 15e3, name="muscle"),))


def hinged(layer: SoftLayer, width: float = 0.02, axis: tuple[float, float, float] = (0, 1, 0)) -> Rig:
    """Two bones along z with a hinge between them; weights change over `width` [m] on both sides."""
    share = np.clip(0.5 + (layer.vertices[:, 2] - MIDDLE[2]) / (2 * width), 0, 1)
    lower = share**2 * (3 - 2 * share)
    heads = np.array([[0.0, 0, 0], MIDDLE])
    return Rig(("upper", "lower"), (-1, 0), heads, np.stack([1 - lower, lower], 1), (Joint("elbow", "lower", axis),))


def carried_whole(layer: SoftLayer) -> Rig:
    """All of the skin on one bone."""
    weights = np.tile([0.0, 1.0], (len(layer.vertices), 1))
    joint = Joint("shoulder", "arm", (0.3, -0.5, 0.8))
    return Rig(("root", "arm"), (-1, 0), np.array([[0.0, 0, 0], [0.02, 0.01, 0.05]]), weights, (joint,))


def pressed(layer: SoftLayer, vertex: int, depth: float = 2e-3, radius: float = 0.012) -> np.ndarray:
    """Pose of a ball on a skin."""
    place = layer.vertices[vertex] + (radius - depth) * layer.normals[vertex]
    return at(*place)


def near(layer: SoftLayer, place: tuple[float, float, float]) -> int:
    return int(np.linalg.norm(layer.vertices - place, axis=1).argmin())


def off_by(answer: Answer, other: Answer) -> float:
    """Mean difference of motion over the peak, where the other moves by more than a tenth of that [-]."""
    moved = np.linalg.norm(other.displacement, axis=1)
    off = np.linalg.norm(answer.displacement - other.displacement, axis=1)
    return float(off[moved > 0.1 * moved.max()].mean() / moved.max())


def long_limb(edge: float = 5e-3) -> SoftLayer:
    return limb(edge, length=0.24)


@pytest.fixture(scope="module")
def skin() -> Skin:
    layer = limb(4e-3)
    return Skin.of(layer.with_(rig=hinged(layer)), MomentNet())


def test_bent_and_back_at_rest_every_answer_is_what_it_was_to_the_last_bit(skin):
    contact = Contact(ball(), pressed(skin.layer, near(skin.layer, (RADIUS, 0, 0.05))))
    simulator = Simulator(skin)
    before = simulator.step([contact])
    simulator.pose({"elbow": 0.4})
    bent = simulator.step([contact])
    assert bent.displacement.tobytes() != before.displacement.tobytes()
    simulator.pose({})
    after = simulator.step([contact])
    assert after.displacement.tobytes() == before.displacement.tobytes()
    assert after.touches["probe"].wrench.tobytes() == before.touches["probe"].wrench.tobytes()


def test_a_pose_leaves_the_methods_inside_of_a_method_where_they_were():
    layer = limb(6e-3)
    skin = Skin.of(layer.with_(rig=hinged(layer)), Coarse(Linear(), 1.5))
    simulator, contact = Simulator(skin), Contact(ball(), pressed(layer, near(layer, (RADIUS, 0, 0.05))))
    before = simulator.step([contact])
    skin.posed({"elbow": 0.6})  # as another thread does
    assert simulator.step([contact]).displacement.tobytes() == before.displacement.tobytes()
    ladder: Any = method_named("ladder")
    assert not {id(rung) for rung in ladder.rungs} & {id(rung) for rung in anew(ladder).rungs}


def test_skin_between_two_bones_turns_as_both_do_also_beyond_half_a_turn(skin):
    """A chain that curls up by 100 degrees and then by 90 more: in between the skin has turned by 145."""
    layer = skin.layer
    share = np.clip(0.5 + (layer.vertices[:, 2] - MIDDLE[2]) / 0.04, 0, 1)
    weights = np.stack([np.zeros_like(share), 1 - share, share], axis=1)
    joints = Joint("first", "middle", (0, 1, 0)), Joint("second", "end", (0, 1, 0))
    rig = Rig(("root", "middle", "end"), (-1, 0, 1), np.array([np.zeros(3), np.zeros(3), MIDDLE]), weights, joints)
    curled = Skin.of(layer.with_(rig=rig), Winkler()).posed({"first": np.deg2rad(100), "second": np.deg2rad(90)})
    half = int(np.abs(share - 0.5).argmin())
    turned = np.rad2deg(np.arccos((np.trace(curled.turn_at(half)) - 1) / 2))
    assert turned == pytest.approx(100 + 90 * share[half], abs=10)


def test_a_pose_tends_to_the_rest(skin):
    vertex = near(skin.layer, (RADIUS, 0, MIDDLE[2]))
    contact = Contact(ball(), pressed(skin.layer, vertex))
    rest, bent = Simulator(skin).step([contact]), Simulator(skin.posed({"elbow": 1e-7})).step([contact])
    assert np.abs(bent.displacement - rest.displacement).max() < 1e-3 * np.abs(rest.displacement).max()
    np.testing.assert_allclose(bent.touches["probe"].wrench, rest.touches["probe"].wrench, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("name", [name for name in MOVED if name != "moment_net"])
def test_every_method_that_a_node_takes_along_turns_with_the_bones(name):
    """A limb that one bone carries whole: what it answers is what it answered at rest, turned."""
    layer = limb(6e-3)
    whole = layer.with_(rig=carried_whole(layer))
    simulator = Simulator(Skin.of(whole, method_named(name)))
    simulator.pose({"shoulder": 0.7})
    turn = simulator.skin.turn_at(0)
    shift = simulator.layer.vertices[0] - turn @ layer.vertices[0]
    pressure = np.where(np.linalg.norm(layer.vertices - [RADIUS, 0, 0.05], axis=1) < 0.01, 100.0, 0.0)
    there, here = (one.solve(Load.pressure(pressure)).displacement
                   for one in (simulator.skin.method, method_named(name).prepare(layer)))  # fmt: skip
    np.testing.assert_allclose(simulator.layer.vertices, layer.vertices @ turn.T + shift, atol=1e-9)
    np.testing.assert_allclose(there, here @ turn.T, atol=1e-4 * max(np.abs(here).max(), 1e-12))


@pytest.mark.parametrize("tissue", [Tissue(), STACK], ids=["one material", "stack to the bone"])
def test_when_all_bones_move_as_one_the_answer_turns_with_them(tissue):
    layer = limb(5e-3).with_(tissue=tissue)
    if not tissue.single:
        layer = to_bone(layer, [Bone(np.array([0.0, 0, -1]), np.array([0.0, 0, 1]), 0.012)])
    rig = carried_whole(layer)
    skin = Skin.of(layer.with_(rig=rig), MomentNet())
    motion = rig.motions((0.9,))[1]
    pose = pressed(layer, near(layer, (RADIUS, 0, 0.08)))
    rest = Simulator(skin).step([Contact(ball(), pose)])
    moved = Simulator(skin.posed({"shoulder": 0.9}))
    answer = moved.step([Contact(ball(), motion @ pose)])
    np.testing.assert_allclose(moved.layer.vertices, layer.vertices @ motion[:3, :3].T + motion[:3, 3], atol=1e-12)
    peak = np.abs(rest.displacement).max()
    np.testing.assert_allclose(answer.displacement, rest.displacement @ motion[:3, :3].T, atol=2e-3 * peak)
    force = rest.touches["probe"].wrench[:3]
    np.testing.assert_allclose(answer.touches["probe"].wrench[:3], motion[:3, :3] @ force,
                               atol=1e-3 * np.linalg.norm(force))  # fmt: skip
    assert answer.trust.in_range == rest.trust.in_range


@pytest.mark.parametrize("place", [(RADIUS, 0, 0.04), (-RADIUS, 0, 0.12)])
def test_beside_a_bend_a_posed_skin_answers_as_one_made_afresh(place):
    layer = long_limb()
    moved = Simulator(Skin.of(layer.with_(rig=hinged(layer, 0.03)), MomentNet()).posed({"elbow": 0.6}))
    here = moved.layer
    afresh = Simulator(SoftLayer(here.vertices, here.faces, here.thickness, tissue=here.tissue), MomentNet())
    contact = Contact(ball(), pressed(here, near(layer, place)))
    posed, fresh = moved.step([contact]), afresh.step([contact])
    assert off_by(posed, fresh) < 0.01
    assert posed.touches["probe"].force == pytest.approx(fresh.touches["probe"].force, rel=0.01)


def test_a_stack_beside_a_bend_answers_as_one_made_afresh():
    layer = to_bone(long_limb().with_(tissue=STACK), [Bone(np.array([0.0, 0, -1]), np.array([0.0, 0, 1]), 0.012)])
    moved = Simulator(Skin.of(layer.with_(rig=hinged(layer, 0.03)), MomentNet()).posed({"elbow": 0.5}))
    here = moved.layer
    assert here.core is not None and np.linalg.norm(here.core - layer.core, axis=1).max() > 0.02
    afresh = Simulator(SoftLayer(here.vertices, here.faces, core=here.core, tissue=here.tissue), MomentNet())
    contact = Contact(ball(0.02), pressed(here, near(layer, (RADIUS, 0, 0.045)), 5e-3, 0.02))
    posed, fresh = moved.step([contact]), afresh.step([contact])
    assert off_by(posed, fresh) < 0.02
    assert posed.touches["probe"].force == pytest.approx(fresh.touches["probe"].force, rel=0.03)


def test_the_inside_of_a_bend_is_flagged_and_says_why_and_what_is_far_from_it_is_not(skin):
    layer = long_limb()
    moved = Simulator(Skin.of(layer.with_(rig=hinged(layer)), MomentNet()).posed({"elbow": 1.0}))
    inside = near(layer, (RADIUS, 0, 0.08))  # it turns about +y, so what is above goes towards +x
    answer = moved.step([Contact(ball(), pressed(moved.layer, inside))])
    assert not answer.trust.in_range and "the limb is bent so that" in answer.trust.why
    far = moved.step([Contact(ball(), pressed(moved.layer, near(layer, (0, RADIUS, 0.03))))])
    assert "bent" not in far.trust.why


@pytest.fixture(scope="module")
def arm() -> Skin:
    body = Body.anny()
    layer = body.part("left_arm", edge_length=6e-3)
    return Skin.of(layer.with_(rig=Rig.of(body, "left_arm", layer)), Winkler())


def test_what_was_hollow_at_rest_is_not_laid_to_a_bend(arm):
    xx, xy, yy = arm.near.curvature.T
    hollow = np.flatnonzero(0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy) < HOLLOW)
    assert len(hollow) > 20
    bend = arm.posed({"left_elbow": 1e-6}).near.sound.bend
    assert bend is not None and bend.of_force(hollow, np.ones(len(hollow))) == []


def test_skin_that_is_inside_other_skin_is_flagged(arm):
    posed = arm.posed({"left_elbow": 1.8})
    points, normals, t = posed.layer.vertices, posed.layer.normals, float(np.median(arm.layer.thickness))
    a, b = KDTree(points).query_pairs(1.5 * t, output_type="ndarray").T
    far = np.linalg.norm(arm.layer.vertices[a] - arm.layer.vertices[b], axis=1) > 6 * t
    through = np.einsum("px,px->p", normals[a], points[b] - points[a]) < 0
    inside = np.unique(a[far & through & (np.einsum("px,px->p", normals[a], normals[b]) < 0)])
    bend = posed.near.sound.bend
    assert len(inside) > 50 and bend is not None
    told = [bool(bend.of_force(inside[k : k + 1], np.ones(1))) for k in range(len(inside))]
    assert np.mean(told) > 0.9


def test_skin_that_comes_near_through_the_air_feels_nothing():
    body = Body.anny()
    layer = body.part("left_arm", edge_length=6e-3)
    rig = Rig.of(body, "left_arm", layer)
    skin = Skin.of(layer.with_(rig=rig), MomentNet())
    moved = Simulator(skin.posed({"left_elbow": 1.3}))  # from 1.5 rad on the ball lies on both parts
    upper, lower = (np.flatnonzero(rig.weights[:, k] > 0.9) for k in (0, 1))
    gaps = np.linalg.norm(moved.layer.vertices[upper][:, None] - moved.layer.vertices[lower], axis=2)
    a, b = np.unravel_index(gaps.argmin(), gaps.shape)
    assert gaps.min() < 0.05 < 0.1 < np.linalg.norm(layer.vertices[upper[a]] - layer.vertices[lower[b]])
    answer = moved.step([Contact(ball(), pressed(moved.layer, int(upper[a])))])
    assert np.abs(answer.displacement).max() > 1e-3
    assert np.abs(answer.displacement[lower]).max() < 1e-3 * np.abs(answer.displacement).max()


@pytest.mark.slow
def test_a_slant_into_a_fold_is_seen_where_a_wrench_or_a_state_tells_of_it_and_no_error_where_the_tool_is_smooth():
    """Inside an elbow bent by 30 degrees a ball meets the forearm's wall at 65 degrees: its pose does not say so."""
    layer, rig = arm_of(6e-3, stack=True)
    skin, tool = Skin.of(layer, MomentNet()).posed({JOINT: np.deg2rad(30)}), ball_of(0.02, 3)
    here, vertex = skin.layer, sites(layer, rig)["inside of the elbow"]
    again = SoftLayer(here.vertices, here.faces, core=here.core, tissue=here.tissue, ply_scale=here.ply_scale)
    inward, travel = -here.normals[vertex], 0.25 * float(here.thickness[vertex])
    start = Press(SignedDistance.of(tool, margin=0.03), at(*(here.vertices[vertex] - 0.03 * inward)), inward)
    touching = start.touching(again)
    assert touching is not None
    mesh = PatchFem(element="P1xP2", reach=3.0, refine=2, layers=1)
    smooth, stuck = (IndenterFem(mesh, friction=law, step=0.1).prepare(again).press([touching], travel).displacement
                     for law in ("none", "stick"))  # fmt: skip
    pose = touching.at(travel).pose_body_from_tool
    told_nothing = Simulator(skin).step([Contact(tool, pose)])
    touch = told_nothing.touches["ball"]
    assert touch.push @ inward < 0.5 * touch.force and told_nothing.trust.ok
    assert worst(told_nothing, smooth) < told_nothing.trust.error_bound < worst(told_nothing, stuck)
    wrench = np.concatenate([touch.force * inward, np.zeros(3)])
    by_force = Simulator(skin).step([Contact(tool, pose, wrench)])
    assert not by_force.trust.ok and "also drags" in by_force.trust.why
    rough, state = Simulator(skin, friction=3.0), State()
    for way in np.linspace(-0.02, 1, 40) * travel:
        touches, state = rough.touch([Contact(tool, touching.at(way).pose_body_from_tool)], state, 0.02)
    by_state = rough.answer(touches)
    assert worst(by_state, stuck) < 0.5 * worst(told_nothing, stuck)
    assert by_state.trust.error_bound is None or by_state.trust.error_bound > worst(by_state, stuck)


def worst(answer: Answer, truth: np.ndarray) -> float:
    """Largest error of motion at any vertex [m]."""
    return float(np.linalg.norm(answer.displacement - truth, axis=1).max())


def test_a_tool_that_rides_on_the_limb_does_not_slide_and_one_that_stays_in_space_does():
    layer = long_limb()
    skin, tool = Skin.of(layer.with_(rig=hinged(layer)), MomentNet()), ball()
    vertex, forces = near(layer, (0, RADIUS, 0.20)), {}
    for rides in (True, False):
        simulator, state = Simulator(skin, friction=0.4), State()
        start = pressed(layer, vertex)
        for angle in np.linspace(0, 0.06, 7):
            state = simulator.pose({"elbow": float(angle)}, state)
            pose = skin.layer.rig.motions((float(angle),))[1] @ start if rides else start
            touches, state = simulator.touch([Contact(tool, pose)], state, 0.02)
        assert touches[0].slip is not None
        forces[rides] = np.linalg.norm(touches[0].slip.wrench[:3]), touches[0].force
    assert forces[True][0] < 0.02 * forces[True][1]
    assert forces[False][0] > 0.3 * forces[False][1]


def test_how_deep_materials_begin_is_taken_into_the_tissue_of_skin_that_is_bent_into_folds():
    layer = long_limb()
    layer = layer.with_(tissue=Tissue(4e3, 0.45, deeper=(Ply(6e-3, 15e3, 0.45),)), rig=hinged(layer),
                        ply_scale=np.full(len(layer.vertices), 0.5))  # fmt: skip
    bent = posed(layer, (2.0,))
    assert bent.typical is bent.typical and bent.typical.tissue.deeper[0].depth == 3e-3
    np.testing.assert_array_equal(bent.typical.vertices, bent.vertices)
    np.testing.assert_array_equal(bent.typical.ply_scale, 1.0)


def test_a_tool_that_rides_above_the_limb_touches_it_without_friction():
    """Nor does it matter whether it ever touched before."""
    layer = long_limb()
    skin, tool, state = Skin.of(layer.with_(rig=hinged(layer)), MomentNet()), ball(), State()
    simulator, vertex = Simulator(skin, friction=0.4), near(layer, (0, RADIUS, 0.20))
    for angle, depth in ((0.0, -1e-3), (0.05, -1e-3), (0.05, 2e-3)):
        state = simulator.pose({"elbow": angle}, state)
        pose = skin.layer.rig.motions((angle,))[1] @ pressed(layer, vertex, depth)
        touches, state = simulator.touch([Contact(tool, pose)], state, 0.05)
    assert touches[0].slip is not None and touches[0].force > 0
    assert np.linalg.norm(touches[0].slip.wrench[:3]) < 0.02 * touches[0].force


def test_the_same_way_over_a_moving_skin_is_the_same_to_the_last_bit(skin):
    def run() -> bytes:
        simulator, state, tool = Simulator(skin, friction=0.4), State(), ball()
        for k in range(5):
            state = simulator.pose({"elbow": 0.05 * k}, state)
            pose = pressed(simulator.layer, near(skin.layer, (RADIUS, 0, 0.05)), 1e-3 + 3e-4 * k)
            touches, state = simulator.touch([Contact(tool, pose)], state, 0.01)
        return state.pack() + simulator.answer(touches).displacement.tobytes()

    assert run() == run()


def test_a_skin_that_relaxes_comes_back_where_its_joints_took_it(skin):
    """What remembers a press goes with the limb: its imprint lies on the skin, not where the skin was."""
    from stmpl_core.living import held_skin

    layer = held_skin(long_limb())
    relaxing, tool = Skin.of(layer.with_(rig=hinged(layer)), MomentNet()), ball()
    assert relaxing.layer.rig is not None
    simulator, state = Simulator(relaxing), State()
    pose = pressed(layer, near(layer, (0, RADIUS, 0.20)), 3e-3)
    for _ in range(3):
        _, state = simulator.touch([Contact(tool, pose)], state, 1.0)
    away = pose.copy()
    away[1, 3] += 0.05
    _, state = simulator.touch([Contact(tool, away)], state, 0.01)
    stayed, _ = simulator.touch([Contact(tool, away)], state, 0.2)
    left = simulator.answer(stayed).displacement
    motion = relaxing.layer.rig.motions((0.5,))[1]
    went, _ = simulator.touch([Contact(tool, motion @ away)], simulator.pose({"elbow": 0.5}, state), 0.2)
    moved = simulator.answer(went).displacement
    assert np.abs(left).max() > 2e-4
    np.testing.assert_allclose(moved, left @ motion[:3, :3].T, atol=1e-3 * np.abs(left).max())


def test_a_skin_is_named_by_its_rest_and_its_rig_wherever_its_joints_are(skin):
    names = {skin.layer_id, skin.posed({"elbow": 0.3}).layer_id}
    assert len(names) == 1 and layer_id(skin.layer.with_(rig=None)) not in names
    assert names != {Skin.of(skin.layer.with_(rig=hinged(skin.layer, 0.03)), Winkler()).layer_id}


def test_a_rig_comes_back_from_its_text_as_it_was(skin):
    again = Rig.from_text(skin.layer.rig.to_text(), skin.layer.rig.weights.astype(np.float32))
    assert again.digest == skin.layer.rig.digest and again.joints == skin.layer.rig.joints
    assert again.weights.tobytes() == skin.layer.rig.weights.tobytes()


def test_what_cannot_be_is_refused_with_what_is_wrong(skin):
    layer, rig = skin.layer, skin.layer.rig
    with pytest.raises(InvalidInput, match=r"unknown joint: knee. Available: elbow"):
        skin.posed({"knee": 0.1})
    with pytest.raises(InvalidInput, match="elbow is nan rad; it must be finite"):
        skin.posed({"elbow": float("nan")})
    with pytest.raises(InvalidInput, match=r"elbow is 45 rad; it goes from -3.14 to 3.14 rad. Is it in degrees"):
        skin.posed({"elbow": 45.0})
    for vertex in (10**9, -1, 0.5):
        with pytest.raises(InvalidInput, match="the vertex is"):
            skin.turn_at(vertex)
    with pytest.raises(InvalidInput, match="rig is 'elbow'; Rig or None"):
        layer.with_(rig="elbow")
    with pytest.raises(InvalidInput, match="this skin has no joints"):
        Simulator(layer.with_(rig=None), Winkler()).pose({"elbow": 0.1})
    with pytest.raises(InvalidInput, match="weights of 1 vertices, the skin has"):
        layer.with_(rig=replace(rig, weights=np.array([[0.5, 0.5]])))
    with pytest.raises(InvalidInput, match="its rest, must be within"):
        Joint("elbow", "lower", (0, 1, 0), 0.1, 1.0)
    with pytest.raises(InvalidInput, match="an earlier one of each other"):
        replace(rig, parents=(-1, 1))
    with pytest.raises(InvalidInput, match=r"torso.* has no joints that are known. Known: left_arm"):
        Rig.of(Body.anny(), "torso", layer)
    with pytest.raises(InvalidInput, match="from the skin of this body"):
        Rig.of(Body.anny(), "left_arm", layer)
    with pytest.raises(InvalidInput, match="this is another skin"):
        Simulator(skin).move_to(Skin.of(layer.with_(rig=rig), Winkler()))


def test_the_weights_of_an_arm_are_spread_so_that_its_inside_does_not_fold_at_sixty_degrees():
    from stmpl_core.extrusion import fold_ratios
    from stmpl_core.rig import _weights_on

    body = Body.anny()
    layer = body.part("left_arm")
    rig = Rig.of(body, "left_arm", layer)
    raw = replace(rig, weights=_weights_on(body, layer, ["left_upper_arm", "left_forearm"]))
    folded = []
    for one in (raw, rig):
        moved = Skin.of(layer.with_(rig=one), Winkler()).posed({"left_elbow": np.pi / 3}).layer
        folded.append(int((fold_ratios(moved.vertices, moved.inner_vertices, moved.faces) <= 0).sum()))
    assert folded[0] > 100 and folded[1] == 0


def held(simulator: Simulator, vertex: int, joints: dict[str, float]) -> tuple[np.ndarray, State]:
    """Pose of a ball that pressed for three steps with the joints there, and the state then."""
    simulator.pose(joints)
    pose, state = pressed(simulator.layer, vertex), State()
    for _ in range(3):
        _, state = simulator.touch([Contact(ball(), pose)], state, 0.02)
    return pose, state


def test_a_state_that_was_told_at_another_bend_goes_along_though_nobody_took_it(skin):
    """Pressed at rest, bent, and gone on with: the tool rode on the skin, so nothing slid."""
    vertex, simulator = near(skin.layer, (0, RADIUS, 0.12)), Simulator(skin, friction=0.4)
    pose, state = held(simulator, vertex, {})
    contact = Contact(ball(), skin.layer.rig.motions((0.7,))[1] @ pose)
    taken = simulator.pose({"elbow": 0.7}, state)
    told, same = (simulator.touch([contact], one, 0.02) for one in (taken, state))
    assert same[1].pack() == told[1].pack() and same[0][0].wrench.tobytes() == told[0][0].wrench.tobytes()
    (touch,), _ = same
    assert touch.slip is not None and np.linalg.norm(touch.slip.wrench[:3]) < 0.02 * touch.force
    assert (state.joints, taken.joints, same[1].joints) == ((), (0.7,), (0.7,))
    for elsewhere in (0.7, 0.2):  # wherever the skin is now, it is taken from where it was told
        simulator.pose({"elbow": 0.5})
        straight = Simulator(skin).pose({"elbow": elsewhere}, state)
        assert simulator.pose({"elbow": elsewhere}, state).pack() == straight.pack()
    with pytest.raises(InvalidInput, match=r"the skin's joints are at \(0.2,\) rad, the state was told at \(\)"):
        simulator.history.step([contact], state, 0.02)


def test_a_state_comes_back_with_the_joints_that_it_was_told_at(skin):
    simulator = Simulator(skin, friction=0.4)
    pose, state = held(simulator, near(skin.layer, (0, RADIUS, 0.12)), {"elbow": 0.3})
    again = State.unpack(state.pack())
    assert again.joints == (0.3,) and again.pack() == state.pack()
    assert state.without("another").joints == (0.3,)
    head, _, numbers = state.pack().partition(b"\n")
    last = 16 + 6 + len(Scalars._fields)
    told, fewer = json.loads(head), np.delete(np.frombuffer(numbers), slice(last - UNKNOWN[3], last))
    third = json.dumps({"version": 3, "terms": told["terms"], "tools": told["tools"]}).encode() + b"\n"
    third += fewer.tobytes()
    read, defaults = State.unpack(third, joints=(0.3,)), list(Scalars._field_defaults.items())[-UNKNOWN[3] :]
    meant = {name: one.with_(scalars=one.scalars._replace(**dict(defaults))) for name, one in state.tools.items()}
    assert read.pack() == replace(state, tools=meant).pack() != state.pack()
    with pytest.raises(InvalidInput, match="does not say where its joints were"):
        simulator.touch([Contact(ball(), pose)], State.unpack(third), 0.02)
    still = Simulator(skin.layer.with_(rig=None), skin.method.__class__(), friction=0.4)
    assert still.touch([Contact(ball(), pose)], State.unpack(third), 0.02)[1].joints == ()


def test_a_state_of_other_joints_is_refused(skin):
    simulator = Simulator(skin, friction=0.4)
    pose, state = held(simulator, near(skin.layer, (0, RADIUS, 0.12)), {"elbow": 0.3})
    with pytest.raises(InvalidInput, match="told at 2 joints; this skin has elbow"):
        simulator.touch([Contact(ball(), pose)], replace(state, joints=(0.1, 0.2)), 0.02)
    still = Simulator(skin.layer.with_(rig=None), Winkler(), friction=0.4)
    with pytest.raises(InvalidInput, match="told at 1 joint; this skin has none"):
        still.touch([Contact(ball(), pose)], state, 0.02)


def test_what_a_round_limb_of_one_material_gives_goes_along_and_is_not_found_again():
    """Coarse elements take seconds: they are those of the skin at rest, of any stiffness, turned where it is bent."""
    layer = limb(5e-3)
    simulator = Simulator(layer.with_(rig=hinged(layer)), MomentNet(), friction=0.4)
    rest = simulator.skin
    made = Green.of(rest.layer).drag
    bent = rest.at_angles([0.3])
    assert made is not None and Green.of(bent.layer).drag is made
    assert Green.of(rest.stiffened(MomentNet(), youngs_modulus=5e3, density=1e3).layer).drag is made
    vertex = int(np.abs(bent.layer.vertices - rest.layer.vertices).max(axis=1).argmax())
    nodes = Nodes.none()._replace(corners=np.full((1, 3), vertex), shares=np.array([[1.0, 0, 0]]))
    here, there = (Green.of(one.layer).give(nodes, np.ones(1)) for one in (rest, bent))
    turn = bent.turn_at(vertex)
    np.testing.assert_allclose(there, turn @ here @ turn.T, atol=1e-6 * np.abs(here).max())
    assert np.abs(here).max() > 0 and np.abs(there - here).max() > 0.05 * np.abs(here).max()


def told(simulator: Simulator, vertex: int) -> tuple[np.ndarray, ...]:
    """Wrench and motion under a ball that is drawn over a skin, with a state, and under one that is just there."""
    layer, state, touches = simulator.layer, State(), []
    for way in (0.0, 1e-3):
        pose = pressed(layer, vertex)
        pose[:3, 3] += way * np.cross(layer.normals[vertex], [0.6, 0, 0.8])
        touches, state = simulator.touch([Contact(ball(), pose)], state, 0.02)
    alone = simulator.touch([Contact(ball(), pressed(layer, vertex, 3e-3))])
    return touches[0].wrench, simulator.answer(touches).displacement, alone[0].wrench


@pytest.mark.parametrize("tissue", [Tissue(), STACK], ids=["one material", "stack to the bone"])
def test_what_was_done_with_a_skin_before_does_not_tell_on_it_where_it_is_bent(tissue):
    layer = limb(7e-3).with_(tissue=tissue)
    if not tissue.single:
        layer = to_bone(layer, [Bone(np.array([0.0, 0, -1]), np.array([0.0, 0, 1]), 0.012)])
    skin = Skin.of(layer.with_(rig=hinged(layer)), MomentNet())
    vertex, first = near(layer, (RADIUS, 0, MIDDLE[2])), skin.posed({"elbow": -0.4})
    elsewhere = pickle.loads(pickle.dumps(first))
    before = told(Simulator(first, friction=0.4), vertex)
    told(Simulator(skin, friction=0.4), vertex)
    stays = Simulator(skin, friction=0.4)
    stays.pose({"elbow": 0.2})
    stays.pose({"elbow": -0.4})
    again = [Simulator(one, friction=0.4) for one in (first, skin.posed({"elbow": -0.4}), elsewhere)]
    for other in (*again, stays):
        for one, two in zip(before, told(other, vertex), strict=True):
            np.testing.assert_array_equal(one, two)
    contact = Contact(ball(), pressed(first.layer, vertex))
    batch = Batch([skin.posed({"elbow": -0.4})], [contact.tool], friction=0.4)
    scene = batch.touch(contact.pose_body_from_tool[None, None], [None], 0.02)
    np.testing.assert_array_equal(scene.wrenches[0, 0], stays.touch([contact], State(), 0.02)[0][0].wrench)
    history = History(Toucher(layer), 0.4)
    bent = history.moved(history.toucher.moved(first)).sideways
    assert bent.at(8e-3, 0.02) == Simulator(skin, friction=0.4).history.sideways.at(8e-3, 0.02)
