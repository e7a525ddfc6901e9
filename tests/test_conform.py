"""Laws of conform: skin that is touched lies on its tool, none is inside, and the rest comes along as a layer would."""

from itertools import pairwise, permutations

import numpy as np
import pytest

from stmpl_core import Contact, Tool
from stmpl_core.conform import SMOOTHING_SHARE, _correct, conform, laid_on
from stmpl_core.methods import Linear, MomentNet, Winkler
from stmpl_core.methods.base import Method
from stmpl_core.moments import Surroundings
from stmpl_core.simulator import MAX_ENTERED_SHARE, Simulator
from stmpl_core.toucher import Toucher
from tests.scenes import LENGTH, RADIUS, STACK, at, ball, box, capsule, limb, placed, plate, press, punch, turn

LIMB = limb(4e-3)
THICKNESS = float(LIMB.thickness[0])
BALL, PUNCH, TIP = ball(), punch(), capsule(0.02, 0.008)
MIDDLE, LYING = LENGTH / 2, turn((0, 1, 0), np.pi / 2)
SCENES = {
    "ball": [press(BALL, at(RADIUS + 0.009, 0.001, MIDDLE), None)],
    "ball by force": [press(BALL, at(RADIUS + 0.011, 0.001, MIDDLE), (-0.2, 0.03, 0.02))],
    "deep ball": [press(BALL, at(RADIUS + 0.0075, 0.001, MIDDLE), None)],
    "punch": [press(PUNCH, at(RADIUS + 0.013, 0, MIDDLE) @ LYING, None)],
    "tilted punch": [press(PUNCH, at(RADIUS + 0.014, 0, MIDDLE) @ turn((0, 1, 0), np.pi / 2 + 0.15), None)],
    "fingertip along the limb": [press(TIP, at(RADIUS + 0.006, 0, MIDDLE), (-0.3, 0, 0))],
    "two fingers": [press(BALL, at(RADIUS + 0.01, 0, MIDDLE - 0.012), None, "one"),
                    press(BALL, at(RADIUS + 0.0095, 0, MIDDLE + 0.014), (-0.1, 0, 0), "two")],
}  # fmt: skip


@pytest.fixture(scope="module", params=[Winkler, Linear, MomentNet])
def sim(request: pytest.FixtureRequest) -> Simulator:
    method: Method = request.param()
    return Simulator(LIMB, method)


@pytest.fixture(scope="module")
def toucher() -> Toucher:
    return Toucher(LIMB)


@pytest.fixture(scope="module")
def near() -> Surroundings:
    return Surroundings.of(LIMB)


def seen_by(toucher: Toucher, tool: Tool, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Signed distance of points to a placed tool [m]."""
    return toucher.tools.field(tool).distance((points - pose[:3, 3]) @ pose[:3, :3])


@pytest.mark.parametrize("name", SCENES)
def test_no_vertex_is_inside_a_tool_whatever_the_method(sim: Simulator, toucher: Toucher, name: str) -> None:
    contacts = SCENES[name]
    answer = sim.step(contacts)
    moved = LIMB.vertices + answer.displacement
    for contact, touch in zip(contacts, toucher.touch_all(contacts), strict=True):
        away = seen_by(toucher, contact.tool, touch.pose_body_from_tool, moved)
        assert away.min() > -MAX_ENTERED_SHARE * THICKNESS, f"{-1e3 * away.min():.2f} mm inside {contact.name}"
        assert touch.pressed and touch.pressure is not None
        v, depth = touch.pressed.squeeze.vertices, touch.pressed.squeeze.depth
        bears = v[(depth > 0) & (touch.pressure[v] > 0.3 * touch.pressure.max())]
        assert len(bears) > 5
        np.testing.assert_allclose(away[bears], 0, atol=MAX_ENTERED_SHARE * THICKNESS)
    figures = answer.trust.figures
    assert figures["entered_m"] <= MAX_ENTERED_SHARE * THICKNESS and "inside a tool" not in answer.trust.why
    assert np.isfinite(answer.displacement).all() and answer.magnitude.max() < 2 * THICKNESS


def test_vertices_under_a_flat_punch_lie_on_it(sim: Simulator) -> None:
    pose = SCENES["punch"][0].pose_body_from_tool
    moved = LIMB.vertices + sim.step(SCENES["punch"]).displacement
    in_tool = (moved - pose[:3, 3]) @ pose[:3, :3]
    under = (np.linalg.norm(in_tool[:, :2], axis=1) < 0.006) & (moved[:, 0] > 0)
    assert under.sum() >= 6
    np.testing.assert_allclose(np.abs(in_tool[under, 2]), 0.015, atol=1e-5)


def test_skin_under_a_ball_by_pose_has_come_along_with_it(sim: Simulator) -> None:
    """The skin sticks: the vertex under the middle of the ball goes straight in, by the ball's depth."""
    vertex = int(np.linalg.norm(LIMB.vertices - [RADIUS, 0, MIDDLE], axis=1).argmin())
    middle = LIMB.vertices[vertex] + (0.012 - 2e-3) * LIMB.normals[vertex]
    answer = sim.step([press(BALL, at(*middle), None)])
    np.testing.assert_allclose(answer.displacement[vertex], -2e-3 * LIMB.normals[vertex], atol=1e-4)


def test_without_a_load_nothing_is_moved(near: Surroundings, toucher: Toucher) -> None:
    apart = press(BALL, at(RADIUS + 0.02, 0, MIDDLE), None)
    some = np.random.default_rng(0).normal(scale=1e-3, size=LIMB.vertices.shape)
    fitted = conform(LIMB, near, some, [toucher.touch(apart)])
    assert fitted.displacement.tobytes() == some.tobytes()
    assert fitted.corrected == fitted.entered == 0


def _fitted(near: Surroundings, toucher: Toucher, contact: Contact, answer: np.ndarray) -> tuple[np.ndarray, float]:
    fitted = conform(toucher.layer, near, answer, [toucher.touch(contact)])
    return fitted.displacement, fitted.corrected


@pytest.mark.parametrize("name", ["ball", "ball by force", "punch"])
def test_an_answer_that_fits_is_left_as_it_is(near: Surroundings, toucher: Toucher, name: str) -> None:
    contact = SCENES[name][0]
    still = np.zeros_like(LIMB.vertices)
    once, first = _fitted(near, toucher, contact, still)
    twice, second = _fitted(near, toucher, contact, once)
    assert not still.any()
    assert first > 1e-3 and second < 0.05 * first
    assert np.abs(twice - once).max() < 0.05 * first


def test_the_correction_ends_with_the_layers_response_and_turns_with_the_scene(toucher: Toucher) -> None:
    contact, scene = SCENES["ball"][0], turn((0.3, -0.5, 0.8), 1.1, (0.4, -0.2, 0.9))
    here, _ = _fitted(Surroundings.of(LIMB), toucher, contact, np.zeros_like(LIMB.vertices))
    away = np.linalg.norm(LIMB.vertices - [RADIUS, 0, MIDDLE], axis=1)
    assert np.linalg.norm(here[away > 8 * THICKNESS], axis=1).max() < 2e-5
    turned = placed(LIMB, scene)
    other = press(BALL, scene @ contact.pose_body_from_tool, None)
    there, _ = _fitted(Surroundings.of(turned), Toucher(turned), other, np.zeros_like(LIMB.vertices))
    np.testing.assert_allclose(there, here @ scene[:3, :3].T, atol=5e-6)


@pytest.mark.parametrize(
    "mesh, pose", [(BALL, at(RADIUS + 0.0095, 0, MIDDLE)), (PUNCH, SCENES["punch"][0].pose_body_from_tool)]
)
def test_skin_moves_continuously_while_a_tool_slides(sim: Simulator, mesh: Tool, pose: np.ndarray) -> None:
    """No vertex jumps where it comes under the tool: a quarter of the slide, about a quarter of the motion."""

    def furthest(step: float) -> float:
        slides = [at(0, 0, s) @ pose for s in np.arange(0, 1.5e-3, step)]
        moved = [sim.step([press(mesh, one, None)]).displacement for one in slides]
        return max(float(np.linalg.norm(b - a, axis=1).max()) for a, b in pairwise(moved))

    coarse, fine = furthest(2.5e-5), furthest(6.25e-6)
    assert fine < 0.4 * coarse


def test_the_same_step_gives_the_same_answer(sim: Simulator) -> None:
    first = sim.step(SCENES["two fingers"]).displacement
    sim.step(SCENES["punch"])
    assert sim.step(SCENES["two fingers"]).displacement.tobytes() == first.tobytes()


STEPS = [(box(0.02, 0.02, 0.012), at(0.012 * k, 0.003 * k, 0.006 - depth))
         for k, depth in enumerate((5e-3, 2e-3, 3e-3))]  # fmt: skip
CROSS = [(box(0.04, 0.008, 0.012), at(0, 0, 0)), (box(0.008, 0.04, 0.012), at(0, 0, 2e-3))]
BALLS = [(BALL, at(5e-4, 0, 0.006)), (ball(0.01), at(0.012, 0, 0.006))]


@pytest.mark.parametrize("method", [Linear, MomentNet])
@pytest.mark.parametrize("tools", [STEPS[:2], STEPS, CROSS, BALLS], ids=["two", "three", "cross", "balls"])
def test_neither_order_nor_names_of_tools_that_overlap_matter(method: type, tools: list) -> None:
    """Skin lies on the tool that takes it furthest, and is outside all of them."""
    sim = Simulator(plate(0.1, 3e-3, 0.01), method())
    contacts = [press(*one, None, name) for one, name in zip(tools, "abc", strict=False)]
    first, *others = [sim.step(some) for some in permutations(contacts)]
    assert first.trust.figures["entered_m"] <= MAX_ENTERED_SHARE * 0.01
    assert first.magnitude.max() > 4e-3
    for other in others:
        np.testing.assert_allclose(other.displacement, first.displacement, atol=1e-9)
    for names in permutations("abc"[: len(tools)]):  # of equal forces some are summed in another order
        renamed = sim.step([press(*one, None, name) for one, name in zip(tools, names, strict=True)])
        np.testing.assert_allclose(renamed.displacement, first.displacement, atol=1e-6)


def test_skin_that_two_tools_touch_lies_on_them_continuously_while_one_passes_the_other() -> None:
    toucher = Toucher(plate(0.1, 3e-3, 0.01))
    still = np.zeros_like(toucher.layer.vertices)

    def furthest(step: float) -> float:
        moved, stays = [], press(*STEPS[0], None, "stays")
        for depth in np.arange(3.5e-3, 6.5e-3, step):
            other = press(box(0.02, 0.02, 0.012), at(0.012, 0.003, 0.006 - depth), None)
            moved.append(laid_on(toucher.layer, still, toucher.touch_all([stays, other])).displacement)
        return max(float(np.linalg.norm(b - a, axis=1).max()) for a, b in pairwise(moved))

    assert furthest(2.5e-5) < 0.4 * furthest(1e-4)


@pytest.mark.parametrize("many", [4, 40, 300])
def test_a_correction_solves_its_equations_as_a_factor_does(near: Surroundings, many: int) -> None:
    rng = np.random.default_rng(0)
    under = np.sort(np.linalg.norm(LIMB.vertices - LIMB.vertices[500], axis=1).argsort()[:many])
    sinking, weight = near.sinking(under), rng.choice([0.0, 0.01, 0.4, 1.0], many)
    wanted, moved, sources = rng.normal(size=(many, 3)), np.zeros((many, 3)), np.zeros((many, 3))
    act = np.flatnonzero(weight)
    ridge = SMOOTHING_SHARE * np.diag(sinking).mean() / weight[act] ** 2
    true = np.zeros((many, 3))
    true[act] = np.linalg.solve(sinking[np.ix_(act, act)] + np.diag(ridge), wanted[act])
    assert _correct(sinking, wanted, weight, moved, sources)
    assert np.linalg.norm(sources - true) < 1e-3 * np.linalg.norm(true)
    assert np.linalg.norm(moved - sinking @ true) < 1e-3 * np.linalg.norm(sinking @ true)
    assert not _correct(sinking, wanted, np.zeros(many), moved, sources)


@pytest.mark.parametrize("stacked", [False, True])
def test_no_vertex_jumps_beside_a_rim_as_it_comes_on_to_a_tool_or_off_it(stacked: bool) -> None:
    """Tilted tools go 0.6 mm any way; where skin moves most in a step, that is looked at down to 2 nm."""
    rng, layer = np.random.default_rng(11), limb(4e-3, 0.0125, 0.045)
    sim = Simulator(layer.with_(tissue=STACK) if stacked else layer, MomentNet())
    tools, jumps = [box(0.02, 0.012, 0.02), punch(0.012, 0.006), punch(0.008)], []
    for k in range(15):
        mesh, pose = tools[k % 3], turn((0, 1, 0), np.pi / 2) @ turn(tuple(rng.normal(size=3)), rng.uniform(0, 0.35))
        lowest = float((mesh.vertices @ pose[:3, :3].T)[:, 0].min())
        pose[:3, 3] = 0.045 - rng.uniform(0.03, 0.5) * 0.0125 - lowest, *rng.uniform(-2e-3, 2e-3, 2) + [0, MIDDLE]
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)

        def moved(s: float, mesh=mesh, pose=pose, way=way) -> np.ndarray:
            return sim.step([press(mesh, at(*(s * way)) @ pose, None)]).displacement

        found = [(s, moved(s)) for s in np.linspace(0, 6e-4, 13)]
        (low, a), (high, b) = max(pairwise(found), key=lambda two: np.abs(two[1][1] - two[0][1]).max())
        while high - low > 2e-9:
            middle = 0.5 * (low + high)
            there = moved(middle)
            if np.abs(there - a).max() > np.abs(b - there).max():
                high, b = middle, there
            else:
                low, a = middle, there
        jumps.append(np.linalg.norm(b - a, axis=1).max() / np.linalg.norm(a, axis=1).max())
    assert max(jumps) < 0.2 and np.mean(jumps) < 0.02, np.round(jumps, 3)
