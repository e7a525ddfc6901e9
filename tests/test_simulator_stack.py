"""Laws of touches and answers on a limb of skin, fat and muscle, and what finite elements say of both."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from benchmarks.massage_force import CIRCLE, Place, laws
from fem_tools import IndenterFem, PatchFem, Press, RigidFem
from fem_tools.axisymmetric import Flat, Profile
from stmpl_core import Contact, Load, Membrane, Ply, Simulator, SoftLayer, Tissue, Tool
from stmpl_core.body import Body
from stmpl_core.bones import Bone, to_bone
from stmpl_core.contact_net import TURNED_FROM, ContactNet, _among, _shape
from stmpl_core.errors import InvalidInput
from stmpl_core.living import living
from stmpl_core.methods import LimbLinear, MomentNet
from stmpl_core.moments import Surroundings
from stmpl_core.networks import STACK_NODE
from stmpl_core.nodes import Nodes
from stmpl_core.regions import HELD_SKIN, region
from stmpl_core.sdf import SignedDistance
from stmpl_core.state import State
from stmpl_core.stiffness import fit_stiffness
from stmpl_core.toucher import Toucher, soft_depth, tissue_doubt, unlearnt
from stmpl_sim.site import Site
from tests.scenes import at, ball, box, contact_of, limb, placed, plate, punch, tool, turn

RADIUS, LENGTH, BALL = 0.035, 0.3, 0.015
STACK = Tissue(3e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0), deeper=(Ply(6e-3, 15e3, 0.45),))
BESIDE = Bone(np.array([0.006, 0, -1]), np.array([0.006, 0, 1]), 0.012)  # off the limb's axis
LIMB = to_bone(limb(5e-3, 10e-3, RADIUS, LENGTH), [BESIDE]).with_(tissue=STACK)
THICK = RADIUS - 0.006  # of the tissue on the side where it is thicker [m]
HALF = LENGTH / 2


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(LIMB, MomentNet())


def pressed(depth: float, wrench: np.ndarray | None = None):
    return contact_of(ball(BALL), at(-RADIUS - BALL + depth, 0, HALF), wrench)


def push(force: float) -> np.ndarray:
    return np.array([force, 0, 0, 0, 0, 0])


def test_at_the_open_border_force_rises_with_depth_and_its_bound_is_finite():
    """There the limb's coarse mesh takes back more than the flat response gives, and no forces were a solution."""
    layer, vertex = living(Body.anny(), "left_calf", edge_length=6e-3), 2964
    simulator, pose = Simulator(layer, MomentNet()), np.eye(4)
    touches = []
    for depth in np.arange(6e-3, 10.1e-3, 2.5e-4):
        pose[:3, 3] = layer.vertices[vertex] + (0.02 - depth) * layer.normals[vertex]
        touches += simulator.touch([contact_of(ball(0.02), pose.copy())])
    forces = np.array([touch.force for touch in touches])
    assert (forces[1:] > 0.98 * forces[:-1]).all() and 2 * forces[0] < forces[-1] < 20
    assert all(touch.force_bound < 15 * touch.force and not touch.trust.ok for touch in touches)


def test_a_ball_presses_and_moves_as_finite_elements_say_and_no_further_than_the_bounds(simulator):
    field = SignedDistance.of(ball(BALL), margin=0.03)
    start = Press(field, at(-RADIUS - BALL - 5e-3, 0, HALF), np.array([1.0, 0, 0])).touching(LIMB)
    assert start is not None
    depths = [1e-3, 4e-3, 9e-3]
    fem = IndenterFem(PatchFem(element="P1xP2", reach=10, refine=3, layers=1), step=0.15).prepare(LIMB)
    for depth, truth in zip(depths, fem.path([start], depths), strict=True):
        answer = simulator.step([contact_of(ball(BALL), start.at(depth).pose_body_from_tool)])
        touch, moved = answer.touches["probe"], np.linalg.norm(truth.displacement, axis=1)
        force = truth.force  # with what sticking skin carries along itself, which ours leaves to its bound
        off = np.linalg.norm(answer.displacement - truth.displacement, axis=1)
        assert answer.trust.ok, answer.trust.why
        assert touch.force == pytest.approx(force, rel=0.1) and abs(touch.force - force) < touch.force_bound
        assert off[moved > 0.1 * moved.max()].mean() < 0.06 * moved.max()
        assert off.max() < answer.trust.error_bound


def test_force_rises_with_depth_into_the_bone(simulator):
    forces = [simulator.touch([pressed(depth)])[0].force for depth in THICK * np.linspace(0.02, 1.3, 40)]
    assert (np.diff(forces) > 0).all()


def test_the_ball_is_where_the_skin_is(simulator):
    depth = 8e-3
    answer = simulator.step([pressed(depth)])
    deepest = np.linalg.norm(answer.displacement, axis=1).max()
    assert deepest == pytest.approx(depth, rel=0.05)
    assert answer.trust.figures["entered_m"] < 1e-4


@pytest.mark.parametrize("force", [0.2, 1.0, 3.0])
def test_a_force_is_carried_where_the_pose_presses_as_hard(simulator, force):
    (touch,) = simulator.touch([pressed(2e-3, push(force))])
    assert touch.force == pytest.approx(force, rel=0.02)
    by_pose = simulator.touch([contact_of(ball(BALL), touch.pose_body_from_tool)])[0]
    assert by_pose.force == pytest.approx(force, rel=0.03)


def test_what_the_tissue_cannot_carry_is_said(simulator):
    (touch,) = simulator.touch([pressed(5e-3, push(500.0))])
    assert not touch.trust.in_range and "carries" in touch.trust.why and touch.force < 500
    assert touch.depth < THICK


def test_a_thousand_times_stiffer_presses_a_thousand_times_harder_and_moves_alike(simulator):
    skin = Membrane(1.3e8, 1.2e-3, 11.0e3)
    stiff = Simulator(LIMB.with_(tissue=Tissue(3e6, 0.45, skin=skin, deeper=(Ply(6e-3, 15e6, 0.45),))), MomentNet())
    one, other = simulator.step([pressed(4e-3)]), stiff.step([pressed(4e-3)])
    assert other.touches["probe"].force == pytest.approx(1e3 * one.touches["probe"].force, rel=1e-3)
    np.testing.assert_allclose(other.displacement, one.displacement, atol=2e-6)


def test_turning_the_scene_turns_the_answer(simulator):
    scene = turn((0.3, -0.5, 0.8), 1.1, (0.4, -0.2, 0.9))
    core = LIMB.core @ scene[:3, :3].T + scene[:3, 3]
    there = Simulator(LIMB.with_(vertices=placed(LIMB.with_(core=None, thickness=1e-2), scene).vertices, core=core),
                      MomentNet())  # fmt: skip
    here = simulator.step([pressed(4e-3)])
    answer = there.step([contact_of(ball(BALL), scene @ pressed(4e-3).pose_body_from_tool)])
    assert answer.touches["probe"].force == pytest.approx(here.touches["probe"].force, rel=0.01)
    np.testing.assert_allclose(answer.displacement @ scene[:3, :3], here.displacement, atol=2e-4)


def test_no_touch_no_motion_and_two_tools_far_apart_do_not_feel_each_other(simulator):
    assert not simulator.step([contact_of(ball(BALL), at(-0.2, 0, HALF))]).displacement.any()
    one = simulator.step([pressed(4e-3)])
    other = contact_of(punch(8e-3), turn((0, 1, 0), np.pi / 2, (RADIUS + 0.013, 0, HALF + 0.005)), name="other")
    both = simulator.step([pressed(4e-3), other])
    assert both.touches["probe"].force == pytest.approx(one.touches["probe"].force, rel=0.1)


def test_a_pressure_without_a_tool_is_answered_by_the_linear_response():
    load = Load.pressure(np.where(np.linalg.norm(LIMB.vertices - [-RADIUS, 0, HALF], axis=1) < 0.012, 20.0, 0.0))
    answer, linear = MomentNet().prepare(LIMB).solve(load), LimbLinear().prepare(LIMB).solve(load)
    np.testing.assert_array_equal(answer.displacement, linear.displacement)
    assert answer.method == "limb_linear"


def test_one_number_does_not_fit_a_stack(simulator):
    with pytest.raises(InvalidInput, match="knows one soft material"):
        fit_stiffness(simulator.toucher, [pressed(1e-3, push(0.1))])


def test_each_kind_of_layer_has_its_own_network():
    assert ContactNet(LIMB).network == "stack_contact_net"
    assert ContactNet(SoftLayer(LIMB.vertices, LIMB.faces, 5e-3)).network == "contact_net"


def test_layers_that_are_alike_answer_as_one():
    whole = limb(3e-3, 5e-3, RADIUS, 0.16)
    cut = whole.with_(deeper=(Ply(2e-3, whole.tissue.youngs_modulus, whole.tissue.poisson_ratio),))
    assert cut.tissue.single and not whole.with_(deeper=(Ply(2e-3, 2e3, 0.4),)).tissue.single
    press = contact_of(ball(BALL), at(RADIUS + BALL - 1.5e-3, 0, 0.08))
    one, other = (Simulator(layer, MomentNet()).step([press]) for layer in (whole, cut))
    assert one.touches["probe"].force > 0
    fades = [Simulator(layer.with_(tissue=layer.tissue.relaxing(HELD_SKIN)), MomentNet()) for layer in (whole, cut)]
    (_, state), (_, other_state) = (simulator.touch([press], State(), 1.0) for simulator in fades)
    (late,), (also_late,) = fades[0].touch([press], state, 30.0)[0], fades[1].touch([press], other_state, 30.0)[0]
    assert 0 < late.force < one.touches["probe"].force and late.force == also_late.force
    np.testing.assert_array_equal(one.displacement, other.displacement)
    np.testing.assert_array_equal(one.touches["probe"].wrench, other.touches["probe"].wrench)


def test_a_skin_from_another_process_is_ready_at_once(simulator):
    skin = pickle.loads(pickle.dumps(simulator.skin))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fem_tools.limb.coarse_response", None)  # would be called if anything were made again
        again = Simulator(skin)
    here, there = simulator.step([pressed(4e-3)]), again.step([pressed(4e-3)])
    np.testing.assert_array_equal(there.displacement, here.displacement)


def test_a_mesh_finer_than_the_contact_nodes_moves_as_a_coarser_one() -> None:
    """Forces of nodes 3 mm apart on vertices 1.7 mm apart are spread; as they come they were 20 % of the peak off."""
    edge = 2 * np.pi * RADIUS / 44
    length, moved = 26 * edge * 3**0.5 / 2, []
    tool, pose = ball(0.02), at(-RADIUS - 0.02 + 0.6 * 0.016, 0, length / 2)
    for finer in (1, 3):
        layer = limb(edge / finer, 0.016, RADIUS, length).with_(tissue=STACK)
        answer = Simulator(layer, MomentNet()).step([contact_of(tool, pose)])
        assert answer.trust.in_range, answer.trust.why
        moved.append((layer, answer.displacement, answer.touches["probe"].force))
    (coarse, some, force), (fine, other, its) = moved
    away, same = cKDTree(fine.vertices).query(coarse.vertices)
    alike = away < 1e-6
    assert alike.sum() > 500 and its == pytest.approx(force, rel=0.03)
    size = np.linalg.norm(some, axis=1)
    off = np.linalg.norm(some - other[same], axis=1)[alike] / size.max()
    assert off.max() < 0.06 and off[size[alike] > 0.1 * size.max()].mean() < 0.02
    near, values = Surroundings.of(fine), np.zeros(len(fine.vertices))
    values[len(values) // 2] = 1e3
    spread = near.spread_on(fine, values, Nodes.none()._replace(area=np.full(4, 8e-6)))
    assert spread @ fine.vertex_areas == pytest.approx(values @ fine.vertex_areas) and spread.max() < 300


@pytest.mark.parametrize("depth", [0.15, 0.35])
def test_skin_under_a_small_tool_on_thick_tissue_and_a_fine_mesh_goes_no_further_than_the_tool(depth):
    simulator = Simulator(limb(4e-3, 0.045, 0.06, LENGTH).with_(tissue=STACK), MomentNet())
    contact = contact_of(ball(8e-3), at(-0.06 - 8e-3 + depth * 0.045, 0, HALF))
    answer = simulator.step([contact])
    deep = answer.touches["probe"].depth
    assert 0.95 * deep < answer.magnitude.max() < 1.1 * deep


@pytest.mark.parametrize("modulus, depth, sound", [
    (3e5, 3.3e-3, True), (3e5, 5e-3, False), (1e5, 5e-3, True), (1e5, 8.5e-3, False), (6e4, 8.5e-3, True),
])  # fmt: skip
def test_soft_tissue_over_what_is_nearly_bone_is_flagged_where_it_is_nearly_pressed_through(modulus, depth, sound):
    """Finite elements on fat of 6 mm over 300 kPa: force 9 % too large at 3.75 mm, 18 % at 5.25."""
    tissue = Tissue(3e3, 0.45, skin=STACK.skin, deeper=(Ply(6e-3, modulus, 0.45),))
    simulator = Simulator(limb(5e-3, 0.015, 0.04, LENGTH).with_(tissue=tissue), MomentNet())
    (touch,) = simulator.touch([contact_of(ball(BALL), at(-0.04 - BALL + depth, 0, HALF))])
    assert ("times as stiff" in touch.trust.why) != sound
    assert touch.trust.in_range == sound, touch.trust.why


def test_six_tools_side_by_side_on_thick_tissue_press_the_more_the_deeper() -> None:
    """Nodes that came to press together overshot together: 4.8 N were told between 1.8 and 2.0, trusted."""
    simulator = Simulator(living(Body.anny(), "abdomen", edge_length=8e-3), MomentNet())
    site, forces = Site.thickest(simulator.layer), []
    x, y, z = site.along, np.cross(site.normal, site.along), site.normal
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, y, z])
    cylinder = trimesh.creation.cylinder(radius=0.007, height=0.02, sections=32)
    punches = [tool(cylinder, name=f"punch {k}") for k in range(6)]
    for depth in np.arange(4.5e-3, 7e-3, 2.5e-4):
        contacts = []
        for k, one in enumerate(punches):
            pose[:3, 3] = site.point + 0.02 * ((k % 3 - 1) * x + (k // 3 - 1) * y) + (0.01 - depth) * z
            contacts.append(Contact(one, pose.copy()))
        forces.append(sum(touch.force for touch in simulator.touch(contacts)))
    rises = np.diff(forces)
    assert rises.min() > 0 and rises.max() < 1.4 * rises.min()


@pytest.mark.parametrize("depth", [1e-4, 2e-4, 4e-4])
def test_the_bound_of_a_first_touch_on_a_coarse_mesh_covers_what_its_facets_miss(depth: float) -> None:
    """They lie 0.1 mm below the round skin that they stand for: 0.3 mN were told with 0.3 for 2.9."""
    coarse, fine = (Simulator(limb(edge, 0.02, 0.045, 0.2).with_(tissue=STACK), MomentNet()) for edge in (6e-3, 2e-3))
    for angle in (0.0, 0.033, 0.066):
        away = 0.045 + 0.012 - depth
        contact = contact_of(ball(0.012, 4), at(away * np.cos(angle), away * np.sin(angle), 0.1003))
        (one,), (other,) = coarse.touch([contact]), fine.touch([contact])
        assert not one.force or abs(one.force - other.force) < one.force_bound


@pytest.mark.parametrize("stiffer", [30.0, 1000.0])
def test_bare_soft_tissue_over_what_is_nearly_bone_presses_as_on_bone_or_is_flagged(stiffer):
    """It was up to 46 % too stiff at 0.6 of the soft tissue, where 13 were stated."""
    soft, small = 10e-3, ball(6e-3)
    even, stack = Tissue(3e3, 0.45), Tissue(3e3, 0.45, deeper=(Ply(soft, 3e3 * stiffer, 0.45),))
    over, on = (Simulator(limb(4e-3, thickness, 0.045, 0.2).with_(tissue=tissue), MomentNet())
                for thickness, tissue in ((soft, even), (0.03, stack)))  # fmt: skip
    flagged = []
    for depth in (0.1, 0.2, 0.3, 0.45, 0.6):
        contact = contact_of(small, at(0.045 + 6e-3 - depth * soft, 0, 0.1))
        (true,), (found,) = over.touch([contact]), on.touch([contact])
        flagged.append(not found.trust.in_range)
        assert flagged[-1] or abs(found.force - true.force) < found.force_bound
    assert flagged == [False, False, True, True, True]


@pytest.mark.parametrize("stiffer", [5.0, 24.0])
def test_bare_soft_tissue_over_what_is_some_times_as_stiff_is_flagged_too(stiffer):
    """Finite elements, a ball of 6 mm 4 mm deep in 10 mm on a plate: 16 and 30 % too stiff, 13 stated."""
    tissue = Tissue(4e3, 0.45, deeper=(Ply(10e-3, 4e3 * stiffer, 0.45),))
    simulator = Simulator(limb(4e-3, 0.02, 0.06, 0.2).with_(tissue=tissue), MomentNet())
    (touch,) = simulator.touch([contact_of(ball(6e-3), at(0.06 + 6e-3 - 4e-3, 0, 0.1))])
    assert not touch.trust.in_range and "times as stiff" in touch.trust.why


def tube_of(first: float, deeper: float) -> SoftLayer:
    """A round limb of fat and muscle with these Poisson's ratios."""
    tissue = Tissue(3e3, first, skin=Membrane(1.3e5, 1.5e-3, 8.0), deeper=(Ply(8e-3, 12e3, deeper),))
    return limb(6e-3, 0.03, 0.045, LENGTH).with_(tissue=tissue)


@pytest.mark.parametrize("first, deeper, truth",
                         [(0.45, 0.40, 7.00), (0.45, 0.48, 7.61), (0.45, 0.30, 6.69), (0.42, 0.495, 7.63)])  # fmt: skip
def test_a_deeper_material_of_another_poissons_ratio_presses_as_finite_elements_say(first, deeper, truth):
    """Finite elements on such a tube, a ball of 20 mm at half of the thickness; columns of .42, .495 said 23 N."""
    simulator = Simulator(tube_of(first, deeper), MomentNet())
    (touch,) = simulator.touch([contact_of(ball(0.02), at(-0.045 - 0.02 + 0.015, 0, HALF))])
    assert abs(touch.force - truth) < 0.14 * truth and abs(touch.force - truth) < touch.force_bound
    assert bool(touch.trust.in_range) == (deeper == 0.40), touch.trust.why
    assert ("Poisson's ratio" in touch.trust.why) == (deeper != 0.40)


@pytest.mark.parametrize("tension, sound", [(0.0, False), (20.0, True), (50.0, True), (70.0, True), (100.0, False)])
def test_force_under_slack_and_tight_skin_is_within_its_bound_or_flagged(tension: float, sound: bool) -> None:
    """Beside finite elements round a limb of 45 mm, half of the thickness deep: 10 % too small at 20 N/m, 15 at 70.

    So taut beside its own stiffness, T / (E_s h) = 0.27 and 0.9, is no region's skin (0.07 at most, 0.12 relaxed).
    """
    thickness, radius = 25e-3, 45e-3
    layer = limb(5e-3, thickness, radius, 0.18).with_(tissue=Tissue(3e3, 0.45, skin=Membrane(5e4, 1.5e-3, tension)))
    depths, tool, simulator = [0.1 * thickness, 0.5 * thickness], ball(20e-3, 4), Simulator(layer, MomentNet())
    start = Press(SignedDistance.of(tool, margin=0.03), at(radius + 20e-3, 0, 0.09), np.array([-1.0, 0, 0]))
    fem = IndenterFem(PatchFem(element="P1xP2", reach=3, check_stability=False), step=0.1).prepare(layer)
    for depth, truth in zip(depths, fem.path([start.touching(layer)], depths), strict=True):
        (touch,) = simulator.touch([contact_of(tool, at(radius + 20e-3 - depth, 0, 0.09))])
        assert touch.trust.in_range == sound and ("tension" in touch.trust.why) != sound
        assert abs(touch.force - truth.force) < touch.force_bound or not sound


@pytest.mark.parametrize("kappa, pull, sound", [(8.0, 1.3, False), (15.0, 1.3, True), (20.0, 1.6, False)])
def test_tension_beyond_e_t_is_in_range_as_limbs_were_learnt_with_it(kappa: float, pull: float, sound: bool) -> None:
    tissue = Tissue(3e3, 0.45, skin=Membrane(kappa * 75 / 1.5e-3, 1.5e-3, pull * 75))
    layer = limb(12e-3, 25e-3, 45e-3, 0.18).with_(tissue=tissue)
    assert any("tension" in why for why in unlearnt(layer, 0.3, 0.49)) != sound


@pytest.mark.parametrize("tension, sound", [(0.6, False), (4.0, True)])
def test_skin_with_next_to_no_tension_is_flagged(tension: float, sound: bool) -> None:
    """The force on a ball falls as the tension rises to 4 N/m, which no skin does: by a sixth from 0.6 on."""
    skin = Membrane(2e5, 1.5e-3, tension)
    tissue = Tissue(3e3, 0.45, skin=skin, deeper=(Ply(10e-3, 15e3, 0.45),))
    layer = limb(6e-3, 25e-3, 45e-3, LENGTH).with_(tissue=tissue)
    assert any("next to no tension" in why for why in unlearnt(layer, 0.3, 0.49)) != sound


def of_ratio(ratio: float) -> Tissue:
    """A forearm's tissue with one Poisson's ratio of its materials."""
    tissue = region("forearm").tissue
    deeper = tuple(replace(one, poisson_ratio=ratio) for one in tissue.deeper)
    return replace(tissue, poisson_ratio=ratio, deeper=deeper)


def over(stiff: float, depth: float, soft: float) -> Tissue:
    """A forearm's skin over so deep a material over a softer one [Pa, m]."""
    return Tissue(stiff, 0.45, skin=region("forearm").tissue.skin, deeper=(Ply(depth, soft, 0.45),))


@pytest.mark.slow
@pytest.mark.parametrize("tissue, sound, least", [(of_ratio(0.35), True, 0.9), (over(12e3, 10e-3, 4e3), False, 0.8),
                                                  (over(20e3, 8e-3, 2e3), False, 0.9)])  # fmt: skip
def test_the_bound_covers_tissue_that_few_contacts_were_learnt_with(tissue: Tissue, sound: bool, least: float) -> None:
    """Finite elements press 10 % harder than the first, 9 and 29 % less than the others, about."""
    layer = limb(5e-3, 25e-3, 45e-3, 0.16).with_(tissue=tissue)
    contact = contact_of(ball(20e-3, 4), at(45e-3 + 20e-3 - 10e-3, 0, 0.08))
    answer = Simulator(layer, MomentNet()).step([contact])
    (touch,), truth = answer.touches.values(), RigidFem().prepare(layer).press([contact], answer)
    assert touch.trust.in_range == sound and ("over a much softer one" in touch.trust.why) != sound
    off = abs(touch.force - truth.trust.figures["probe.normal_n"])
    assert least * touch.force_bound / tissue_doubt(layer) < off < touch.force_bound


BARE = Tissue(4e3, 0.45, deeper=(Ply(6e-3, 15e3, 0.45),))


@pytest.mark.parametrize("tissue, beyond, sound", [(BARE, 18e-3, True), (BARE, 9e-3, False), (BARE, 6e-3, False),
                                                   (over(4e3, 6e-3, 15e3), 9e-3, True),
                                                   (over(4e3, 6e-3, 15e3), 4e-3, False)])  # fmt: skip
def test_tissue_thicker_than_in_the_median_is_within_its_bound_and_flagged_where_it_matters(tissue, beyond, sound):
    """A ball on 18 mm that are less from four thicknesses on, where finite elements of an even slab feel nothing."""
    skin, thick = plate(0.24, 6e-3, 18e-3), 18e-3
    far = np.clip((np.linalg.norm(skin.vertices[:, :2], axis=1) - 72e-3) / 12e-3, 0, 1)
    layer = skin.with_(tissue=tissue, thickness=thick * (beyond / thick) ** far)
    depths = [0.1 * thick, 0.3 * thick]
    truths = Flat(tissue, thick).press(Profile((0.0, 0.0), (0.0, 0.0), 15e-3), depths)
    simulator = Simulator(layer, MomentNet())
    for depth, truth in zip(depths, truths, strict=True):
        (touch,) = simulator.touch([contact_of(ball(15e-3, 4), at(0, 0, 15e-3 - depth))])
        assert touch.trust.in_range == sound and ("in the median of this skin" in touch.trust.why) != sound
        assert abs(touch.force - truth.force) < touch.force_bound
        assert not sound or touch.force_bound < 0.2 * touch.force


def test_how_deep_materials_begin_may_be_told_by_the_tissue_or_by_the_skin():
    skin, told = plate(0.12, 6e-3, 18e-3), []
    for depth, scale in ((9e-3, None), (4.5e-3, 2.0), (22.5e-3, 0.4)):
        scales = None if scale is None else np.full(len(skin.vertices), scale)
        layer = skin.with_(tissue=over(4e3, depth, 80e3), ply_scale=scales)
        assert layer.typical.tissue == over(4e3, 9e-3, 80e3) and layer.typical is layer.typical
        assert layer.typical.typical is layer.typical and Surroundings.of(layer) is Surroundings.of(layer.typical)
        answer = Simulator(layer, MomentNet()).step([contact_of(ball(15e-3), at(0, 0, 10e-3))])
        touch = answer.touches["probe"]
        told.append([touch.force, touch.force_bound, *answer.displacement.ravel()])
    np.testing.assert_allclose(told, told[:1] * 3, rtol=1e-6, atol=1e-9)


def test_a_material_that_would_begin_below_the_bone_is_not_told_of():
    skin = region("forearm").tissue.skin
    layer = plate(0.12, 6e-3, 18e-3).with_(tissue=Tissue(4e3, 0.45, skin=skin))
    deeper = [layer.with_(deeper=(Ply(30e-3, 4e5, nu),)) for nu in (0.45, 0.2)]
    assert [unlearnt(one, 0.35, 0.46) for one in (layer, *deeper)] == [[]] * 3
    assert soft_depth(deeper[0]) == np.inf > soft_depth(layer.with_(deeper=(Ply(10e-3, 4e5, 0.45),)))
    assert tissue_doubt(layer) == tissue_doubt(deeper[1])


@pytest.mark.parametrize("mesh", [box(0.03, 0.03, 0.03), box(0.06, 0.04, 0.03), punch(12e-3)],
                         ids=["box", "plate", "disc"])  # fmt: skip
def test_a_flat_tool_carries_the_least_force(mesh: Tool) -> None:
    """At the first of its trials nothing presses yet, which is no tool that closes around the limb."""
    simulator = Simulator(plate(0.16, 6e-3, 18e-3).with_(tissue=over(4e3, 6e-3, 15e3)), MomentNet())
    depths = []
    for force in (0.002, 0.01, 0.05):
        wrench = np.array([0, 0, -force, 0, 0, 0])
        (touch,) = simulator.touch([contact_of(mesh, at(0, 0, 15e-3 - 2e-4), wrench)])
        assert touch.trust.in_range and touch.force == pytest.approx(force)
        depths.append(touch.depth)
    assert 0 < depths[0] < depths[1] < depths[2] < 2e-4


def test_a_force_that_is_too_small_to_be_placed_is_not_laid_to_other_tools_where_there_are_none(simulator) -> None:
    (touch,) = simulator.touch([pressed(2e-3, push(1e-8))])
    assert not touch.trust.in_range and "did not settle" in touch.trust.why and "other tools" not in touch.trust.why
    assert touch.force == pytest.approx(1e-8)


def test_how_far_tissue_is_from_what_was_learnt() -> None:
    def doubt(tissue: Tissue, thickness: float = 25e-3) -> float:
        return tissue_doubt(limb(12e-3, thickness, 45e-3).with_(tissue=tissue))

    def told(tissue: Tissue, thickness: float) -> bool:
        return any("over a much softer" in one for one in unlearnt(limb(12e-3, thickness, 0.13).with_(tissue=tissue),
                                                                   0.35, 0.46))  # fmt: skip

    assert doubt(of_ratio(0.45)) == doubt(of_ratio(0.46)) == doubt(Tissue(1e3, 0.3)) == 1
    assert 1 < doubt(of_ratio(0.43)) < doubt(of_ratio(0.40)) < doubt(of_ratio(0.35)) < 2
    assert doubt(over(4e3, 8e-3, 4e3)) == 1 < doubt(over(6e3, 8e-3, 4e3)) < doubt(over(12e3, 8e-3, 4e3))
    assert doubt(over(12e3, 30e-3, 4e3)) == 1, "what lies below the bone is none"
    assert doubt(Tissue(3e3, 0.45, skin=Membrane(100.0, 1e-6, 1e-3))) < 1.001, "a skin that is hardly there"
    for tone in ("relaxed", "tensed"):
        belly = region("abdomen", tone)
        assert 1.1 < doubt(belly.tissue, belly.thickness) < 1.4 and not told(belly.tissue, belly.thickness)
    assert told(over(20e3, 8e-3, 2e3), 25e-3) and not told(over(6e3, 8e-3, 4e3), 25e-3)


@pytest.mark.parametrize("force", [0.3, 3.0, 10.0, 100.0])
def test_few_trials_find_where_a_tool_that_is_stated_at_the_skin_presses(force, simulator, monkeypatch) -> None:
    toucher, tried = simulator.toucher, []
    hold = toucher.net.hold
    monkeypatch.setattr(toucher.net, "hold", lambda nodes: tried.append(nodes) or hold(nodes))
    (touch,) = simulator.touch([pressed(0.0, push(force))])
    assert len(tried) <= 4
    if force < 100:
        assert touch.force == pytest.approx(force, rel=1e-5) and touch.trust.ok
        assert ("calibration" in touch.trust.why) == (force > 3)
    else:
        assert toucher.deep.strain(touch.pressed.squeeze) == pytest.approx(0.85, abs=0.02)
        assert "carries" in touch.trust.why and touch.force < 100


def test_a_place_whose_fat_ends_deeper_hardens_as_tissue_of_such_fat():
    tissue = Tissue(3e3, 0.45, skin=STACK.skin, deeper=(Ply(12e-3, 15e3, 0.45),))
    there = limb(6e-3, 0.03, 0.045, LENGTH).with_(tissue=tissue)
    scaled = there.with_(tissue=Tissue(3e3, 0.45, skin=STACK.skin, deeper=(Ply(8e-3, 15e3, 0.45),)),
                         ply_scale=np.full(len(there.vertices), 1.5))  # fmt: skip
    contact, read = contact_of(ball(0.02), at(-0.045 - 0.02 + 0.018, 0, HALF)), []
    for one in (there, scaled):
        toucher = Toucher(one)
        nodes = toucher.columns.squeezed(toucher.tools.field(contact.tool), contact.pose_body_from_tool).nodes
        read.append(toucher.net.look(nodes).inputs[:, STACK_NODE.at.hardening])
    assert read[0].max() > 0.5
    np.testing.assert_allclose(read[1], read[0], atol=2e-3)


def test_a_node_knows_how_skin_turns_and_tissue_thins_where_its_own_side_is_pressed():
    """What presses on the other side of a finger says nothing, nor what is far along the limb."""
    angle, uneven, t, y = 0.3, 0.2, 0.01, 0.004
    turns = np.array([0.0, angle, -angle, np.pi, 0.0])
    inward = np.stack([-np.cos(turns), -np.sin(turns), np.zeros(5)], axis=1)
    points = np.array([[0, 0, 0], [0, y, 0], [0, -y, 0], [-2 * y, 0, 0], [0, 0, 3.1 * t]])
    thickness = t * np.exp([0.0, uneven, -uneven, 1.0, 1.0])
    forces = np.array([0.0, 2.0, 2.0, 5.0, 5.0])
    out = _shape(*_among(points, inward, thickness, np.zeros(5, np.int64), t, forces), forces)
    assert np.exp(out[0, 0]) == pytest.approx(1 - np.cos(angle) + TURNED_FROM)
    assert out[0, 1] == pytest.approx(uneven)
    assert np.exp(out[3:, 0]) == pytest.approx(TURNED_FROM) and out[3:, 1] == pytest.approx(0)  # alone on its side
    alone = _shape(*_among(points[:1], inward[:1], thickness[:1], np.zeros(1, np.int64), t, np.zeros(1)), np.zeros(1))
    assert np.exp(alone[0, 0]) == pytest.approx(TURNED_FROM) and alone[0, 1] == 0  # nothing presses


def test_round_the_circle_of_the_demo_a_ball_presses_as_finite_elements_say():
    """IndenterFem, as the demo has it: where skin turns under the ball 6 to 10 % too much was said, elsewhere less."""
    simulator = Simulator(living(Body.anny(), "left_forearm"), MomentNet())
    circle = Site.thickest(simulator.layer).circle(CIRCLE)
    for angle, truths in ((0, (1.0389, 2.8507)), (90, (0.9631, 2.6388)), (180, (1.0014, 2.7328)),
                          (270, (0.9847, 2.7145))):  # fmt: skip
        place = Place(simulator, circle, angle)
        for share, truth in zip((0.2, 0.35), truths, strict=True):
            _, force = laws(simulator, place, share * place.thickness)
            assert force == pytest.approx(truth, rel=0.06)
