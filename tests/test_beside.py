"""Tools that drag the skin beside each other, and one that touches at several places."""

import numpy as np
import pytest

from stmpl_core import Contact, Simulator, State, Tissue, Tool, Touch
from stmpl_core.dragged import dragged_motion
from stmpl_core.green import Green
from stmpl_core.methods import Winkler
from stmpl_core.nodes import Nodes
from stmpl_core.sideways import NEAR_RADII, NEAR_WAYS, Sideways, beside
from tests.scenes import LENGTH, at, ball, limb, plate, turn
from tests.scenes import RADIUS as LIMB_RADIUS

RADIUS, DEPTH, WAY, SPLIT = 12e-3, 3e-3, 1e-3, 0.024
STICKS = 5.0  # coefficient of friction at which nothing slides here
ONE, OTHER = ball(RADIUS).named("one"), ball(RADIUS).named("other")
PAIR = Tool("pair", np.concatenate([ONE.vertices - [0.03, 0, 0], ONE.vertices + [0.03, 0, 0]]),
            np.concatenate([ONE.faces, ONE.faces + len(ONE.vertices)]))  # fmt: skip


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator(plate(0.15).with_(tissue=Tissue(2e4, 0.4)), Winkler(), friction=STICKS)


def led(simulator: Simulator, steps: list[list[Contact]]) -> tuple[list[Touch], State]:
    touches, state = [], State()
    for contacts in steps:
        touches, state = simulator.touch(contacts, state, 0.01)
    return touches, state


def beside_each_other(simulator: Simulator, tools: str, ways: tuple[float, float], axis: int, many: int = 6,
                      way: float = WAY) -> tuple[list[Touch], State]:  # fmt: skip
    """Two balls, or one of them, pressed in and led along so many times `way`."""
    steps = []
    for k in range(4 + many):
        places = np.array([[-SPLIT / 2, 0, RADIUS - DEPTH * min(1, (k + 1) / 4)]] * 2)
        places[1, 0] += SPLIT
        places[:, axis] += np.array(ways) * way * max(0, k - 3) / many
        contacts = [Contact(tool, at(*place)) for tool, place in zip((ONE, OTHER), places, strict=True)]
        steps.append([one for one in contacts if one.name in tools])
    return led(simulator, steps)


def linear(simulator: Simulator, touches: list[Touch], ways: list[float], axis: int) -> np.ndarray:
    """Force along an axis of each touch whose nodes go a way, in the linear response of all of them [N]."""
    green, parts, pressing, moves = Green.of(simulator.layer), [], [], []
    for touch, way in zip(touches, ways, strict=True):
        assert touch.pressed is not None and touch.pressed.forces is not None
        some = touch.pressed.forces > 0
        parts.append(touch.pressed.squeeze.nodes.some(some))
        pressing.append(touch.pressed.forces[some])
        moves.append(np.tile(way * np.eye(3)[axis], (some.sum(), 1)))
    nodes, ways_of = Nodes.joined(parts), np.concatenate(moves)
    forces = green.rubbed(nodes, green.near.groups(nodes.corners[:, 0]), ways_of, 0 * ways_of, np.concatenate(pressing))
    ends = np.cumsum([len(one) for one in pressing])[:-1]
    return np.array([part[:, axis].sum() for part in np.split(forces, ends)]) * simulator.layer.tissue.youngs_modulus


@pytest.mark.parametrize("axis", [0, 1], ids=["in line", "abreast"])
@pytest.mark.parametrize("ways", [(1.0, 1.0), (1.0, 0.0), (1.0, -1.0)], ids=["both", "one stays", "apart"])
def test_tools_beside_each_other_share_a_drag_as_linear_skin_has_it(
        sim: Simulator, ways: tuple[float, float], axis: int) -> None:  # fmt: skip
    """One alone, 24 mm from another that goes along or stays, on skin 15 mm thick."""
    (alone,), _ = beside_each_other(sim, "one", ways, axis)
    touches, _ = beside_each_other(sim, "one other", ways, axis)
    truth = linear(sim, touches, [WAY * way for way in ways], axis) / linear(sim, [alone], [WAY], axis)
    assert alone.slip is not None
    own = alone.slip.wrench[axis]
    found = np.array([touch.slip.wrench[axis] / own for touch in touches if touch.slip is not None])
    np.testing.assert_allclose(found, truth, atol=0.03)
    if axis == 0:
        assert np.abs(truth - ways).max() > 0.05


def test_skin_between_tools_that_go_the_same_way_goes_no_further_than_they_do(sim: Simulator) -> None:
    touches, _ = beside_each_other(sim, "one other", (1.0, 1.0), 0)
    motions = [dragged_motion(Green.of(sim.layer), touch) for touch in touches]
    assert motions[0] is not None and motions[1] is not None
    assert np.abs((motions[0] + motions[1])[:, 0]).max() < 1.05 * WAY
    assert np.abs(motions[0][:, 0]).max() > 0.8 * WAY


def test_what_tools_take_along_does_not_depend_on_the_steps(sim: Simulator) -> None:
    one, few = (beside_each_other(sim, "one other", (1.0, 0.0), 0, many)[0] for many in (1, 12))
    for touch, other in zip(one, few, strict=True):
        assert touch.slip is not None and other.slip is not None
        np.testing.assert_allclose(touch.slip.wrench, other.slip.wrench, atol=2e-3 * np.abs(one[0].wrench).max())
        np.testing.assert_allclose(touch.slip.taken, other.slip.taken, atol=1e-6)


def test_a_tool_that_lifts_gives_back_what_it_took_from_one_beside_it(sim: Simulator) -> None:
    _, state = beside_each_other(sim, "one other", (1.0, 0.0), 0)
    stays, lifted = Contact(OTHER, at(SPLIT / 2, 0, RADIUS - DEPTH)), Contact(ONE, at(-SPLIT / 2 + WAY, 0, 2 * RADIUS))
    for contacts in ([stays, lifted], [stays]):  # taken up, or taken away
        (touch, *_), _ = sim.touch(contacts, state, 0.01)
        assert touch.slip is not None
        assert np.abs(touch.slip.wrench[:2]).max() < 2e-3 * touch.force and not touch.slip.taken.any()


def test_sticking_tools_beside_each_other_give_no_energy(sim: Simulator) -> None:
    """Both pressed in, led by up to half a millimetre to and fro, apart from each other, and lifted."""
    rng = np.random.default_rng(4)
    knots = np.concatenate([rng.uniform([-5e-4, -5e-4, 2e-3], [5e-4, 5e-4, 4e-3], (2, 12, 3))], axis=0)
    paths = np.array([[np.interp(np.linspace(0, 13, 130), np.arange(14), [end, *knots[k, :, x], end])
                       for x, end in enumerate((0.0, 0.0, -1e-3))] for k in range(2)])  # fmt: skip
    work, most, before, state = 0.0, 0.0, None, State()
    for way in paths.transpose(2, 0, 1):
        places = way * [1, 1, -1] + [[-SPLIT / 2, 0, RADIUS], [SPLIT / 2, 0, RADIUS]]
        contacts = [Contact(tool, at(*place)) for tool, place in zip((ONE, OTHER), places, strict=True)]
        touches, state = sim.touch(contacts, state, 0.01)
        forces = np.array([touch.wrench[:3] for touch in touches])
        if before is not None:
            work += 0.5 * np.vdot(forces + before[0], places - before[1])
            most = max(most, work)
        before = forces, places
    assert -0.005 * most < work < 0.05 * most


@pytest.mark.parametrize("axis", [0, 1], ids=["in line", "abreast"])
def test_what_tools_take_along_gives_no_energy_where_skin_is_uneven(axis: int) -> None:
    """One goes, the other goes, one back, the other back, never lifted: either way round costs alike."""
    layer = plate(0.12, 4e-3).with_(tissue=Tissue(2e4, 0.4))
    layer = layer.with_(thickness=np.clip(12e-3 + 0.1 * layer.vertices[:, 0], 6e-3, 18e-3))
    simulator, corners = Simulator(layer, Winkler(), friction=STICKS), [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]
    works, moved = [], 0.0
    for round_ in (corners, corners[::-1]):
        _, state = beside_each_other(simulator, "one other", (0.0, 0.0), axis, 1)
        before, work = None, 0.0
        for a, b in zip(2 * round_[:-1], 2 * round_[1:], strict=True):
            for k in range(12):
                places = np.array([[-SPLIT / 2, 0, RADIUS - DEPTH], [SPLIT / 2, 0, RADIUS - DEPTH]])
                places[:, axis] += WAY * (np.array(a) + (np.array(b) - a) * (k + 1) / 12)
                touches, state = simulator.touch([Contact(tool, at(*place)) for tool, place in
                                                  zip((ONE, OTHER), places, strict=True)], state, 0.01)  # fmt: skip
                forces = np.array([touch.wrench[:3] for touch in touches])
                if before is not None:
                    done = 0.5 * np.vdot(forces + before[0], places - before[1])
                    work, moved = work + done, moved + abs(done)
                before = forces, places
        works.append(work)
    assert abs(works[0] - works[1]) < 1.5e-3 * moved and min(works) > -1e-3 * moved


def test_a_tool_that_comes_to_skin_that_went_along_knows_it_at_once(sim: Simulator) -> None:
    _, state = beside_each_other(sim, "one", (1.0, 0.0), 0)
    here = [Contact(ONE, at(WAY - SPLIT / 2, 0, RADIUS - DEPTH)), Contact(OTHER, at(SPLIT / 2, 0, RADIUS - DEPTH))]
    (_, first), state = sim.touch(here, state, 0.01)
    (_, second), _ = sim.touch(here, state, 0.01)
    assert first.slip is not None and second.slip is not None and first.slip.taken[0] > 0.02 * WAY
    np.testing.assert_allclose(first.slip.taken, second.slip.taken, atol=1e-7)
    assert np.abs(first.slip.wrench).max() < 0.02 * first.force


def test_tools_at_one_place_do_not_ask_who_came_first(sim: Simulator) -> None:
    found = {}
    for order in (1, -1):
        steps = [[Contact(tool, at(0, WAY * max(0, k - 3) / 5, RADIUS - DEPTH * min(1, (k + 1) / 4)))
                  for tool in (ONE, OTHER)[::order]] for k in range(9)]  # fmt: skip
        for touch in led(sim, steps)[0]:
            assert touch.slip is not None
            found[touch.name, order] = touch.slip.wrench[1]
    for name in ("one", "other"):
        assert found[name, 1] == pytest.approx(found[name, -1], rel=0.03)


def test_a_limb_takes_skin_along_further_than_flat_skin_does() -> None:
    """A tube turns about its bone as a whole: two balls abreast around it, beside what one does in the motion."""
    simulator, n = Simulator(limb(thickness=0.02), Winkler(), friction=STICKS), 4
    there = [LENGTH / 2 - SPLIT / 2, LENGTH / 2 + SPLIT / 2]

    def led_around(tools: list[Tool]) -> list[Touch]:
        steps = []
        for k in range(4 + n):
            up, way = LIMB_RADIUS + RADIUS - DEPTH * min(1, (k + 1) / 4), WAY * max(0, k - 3) / n
            steps.append([Contact(tool, at(-up, way if tool is ONE else 0.0, z))
                          for tool, z in zip((ONE, OTHER), there, strict=True) if tool in tools])  # fmt: skip
        return led(simulator, steps)[0]

    one, other = led_around([ONE, OTHER])
    assert one.slip is not None and other.slip is not None
    motion, layer = dragged_motion(Green.of(simulator.layer), one), simulator.layer
    assert motion is not None
    near = np.linalg.norm(layer.vertices - [-LIMB_RADIUS, 0, there[1]], axis=1) < 4e-3
    assert other.slip.taken[1] == pytest.approx(motion[near, 1].mean(), rel=0.25)
    assert other.slip.wrench[1] < -0.05 * one.slip.wrench[1]


@pytest.mark.parametrize("about", [0.0, 0.03], ids=["its middle", "one of them"])
def test_a_tool_that_touches_at_two_places_turns_as_two_tools_do(sim: Simulator, about: float) -> None:
    """Two balls 60 mm apart that turn by 0.01 rad; their torque was a fourteenth of that, as of one round contact."""
    one, two = [], []
    for k in range(6):
        z, angle = RADIUS - DEPTH * min(1, (k + 1) / 5), 0.01 * (k == 5)
        pose = turn((0, 0, 1), angle, (about, 0, z)) @ at(-about, 0, 0)
        one.append([Contact(PAIR, pose)])
        two.append([Contact(ONE, pose @ at(-0.03, 0, 0)), Contact(OTHER, pose @ at(0.03, 0, 0))])
    ((touch,), _), (touches, _) = led(sim, one), led(sim, two)
    middle = one[-1][0].pose_body_from_tool[:3, 3]
    torque = sum(each.wrench[5] + np.cross(contact.pose_body_from_tool[:3, 3] - middle, each.wrench[:3])[2]
                 for each, contact in zip(touches, two[-1], strict=True))  # fmt: skip
    assert touch.wrench[5] == pytest.approx(torque, rel=0.15)
    drag = sum(each.wrench[:2] for each in touches)
    np.testing.assert_allclose(touch.wrench[:2], drag, atol=touch.force_bound)
    np.testing.assert_allclose(touch.wrench[:2], drag, atol=0.15 * np.abs(drag).max() + 1e-3)


def test_patches_beside_each_other_pull_as_on_a_half_space_where_the_layer_is_thick() -> None:
    """Cerruti: at a distance r a force F moves skin by F / (2 pi G r) along the line and (1 - nu) times that across."""
    modulus, nu, thickness = 2e4, 0.4, 1.0
    table, shear = beside(Tissue(modulus, nu), thickness), modulus / (2 * (1 + nu))
    far = int(np.searchsorted(NEAR_WAYS, 4 * NEAR_RADII[0]))
    for x, share in enumerate((1.0, 1 - nu)):
        exact = share / (2 * np.pi * shear * NEAR_WAYS[far] * thickness)
        assert table[0, far, x] / (modulus * thickness) == pytest.approx(exact, rel=0.15)


def test_a_patch_beside_none_moves_as_the_stiffness_of_one_says() -> None:
    layer = plate(0.09).with_(tissue=Tissue(2e4, 0.4))
    table, thickness = beside(layer.tissue, 15e-3), 15e-3
    for k in (2, 4, 6):
        radius = NEAR_RADII[k] * thickness
        stiff = Sideways(layer.with_(thickness=np.full(len(layer.vertices), thickness))).at(radius, thickness).along
        assert table[k, 0, 0] / (2e4 * thickness) * stiff == pytest.approx(1.0, rel=0.1)
