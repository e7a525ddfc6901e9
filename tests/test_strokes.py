"""Laws of tools that are led through poses: they slide, creep, spin and lift, and give no energy."""

from itertools import pairwise

import numpy as np
import pytest

from fem_tools import IndenterFem, PatchFem, Press, tool_contact
from fem_tools.stroke import Stroke
from fem_tools.tool_contact import PressLoad
from stmpl_core import Ply, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.sdf import SignedDistance
from stmpl_core.tissue import Prony
from tests import scenes
from tests.scenes import at, plate, turn

RADIUS, DEPTH = 8e-3, 3e-3
LAYER = plate(0.06, 5e-3, 12e-3, crossed=True, poisson_ratio=0.45)


@pytest.fixture(scope="module")
def ball() -> SignedDistance:
    return SignedDistance.of(scenes.ball(RADIUS, 4), spacing=0.000347121012399023)


def solver(mu, step: float = 0.1) -> IndenterFem:
    fem = PatchFem(element="P1xP2", layers=1, refine=2, reach=2, check_stability=False)
    return IndenterFem(fem, friction=mu, step=step).prepare(LAYER)


def poses(*ways) -> np.ndarray:
    """Poses of a ball whose lowest point goes through these (x, y, depth) [m]."""
    return np.array([at(x, y, RADIUS - depth) for x, y, depth in ways])


PRESSED = [(0, 0, 0), (0, 0, DEPTH / 2), (0, 0, DEPTH)]


def slid(ball, mu, direction, length: float, count: int) -> list:
    x, y = np.array(direction) / np.linalg.norm(direction)
    way = [(x * s, y * s, DEPTH) for s in np.linspace(0, length, count + 1)[1:]]
    return list(solver(mu).follow([Stroke(ball, poses(*PRESSED, *way))]))


def test_a_stroke_straight_down_is_a_press(ball):
    depths = [1e-3, 2e-3, 3e-3]
    press = list(solver("stick").path([Press(ball, at(0, 0, RADIUS), np.array([0, 0, -1.0]))], depths))
    stroke = list(solver("stick").follow([Stroke(ball, poses(*((0, 0, d) for d in (0.0, *depths))))]))[1:]
    for one, other in zip(press, stroke, strict=True):
        assert other.force == pytest.approx(one.force, rel=0.01)
        assert other.depth == pytest.approx(one.depth, abs=2e-5)


@pytest.mark.parametrize("mu, low, high", [(0.3, 0.33, 0.42), (0.6, 0.7, 0.86)])
def test_a_ball_that_slides_comes_to_an_even_drag_of_friction_and_ploughing(ball, mu, low, high):
    """0.386 and 0.79 of the normal force were found on another mesh, with other steps."""
    answers = slid(ball, mu, (1, 0), 9e-3 if mu > 0.5 else 5e-3, 9 if mu > 0.5 else 5)
    ratios = [answer.wrenches[0][0] / -answer.wrenches[0][2] for answer in answers[-3:]]
    assert all(answer.trust.converged for answer in answers)
    assert low < ratios[-1] < high and np.ptp(ratios) < 0.05 * ratios[-1]
    last = answers[-1]
    assert last.trust.figures["slipping"] > 0.95
    assert last.trust.figures["faces_entered_m"] < 0.01 * 12e-3
    rubbed = np.linalg.norm(last.frictions[0][:3])
    touched = (np.linalg.norm(last.traction, axis=1) * LAYER.vertex_areas).sum()
    assert rubbed < mu * touched


def test_a_ball_slides_alike_in_any_direction(ball):
    along, across = (slid(ball, 0.3, way, 5e-3, 3)[-1].wrenches[0] for way in ((1, 0), (1, 2)))
    way = np.array([1, 2]) / 5**0.5
    assert across[:2] @ way == pytest.approx(along[0], rel=0.03)
    assert abs(across[0] * way[1] - across[1] * way[0]) < 0.03 * along[0]


def test_a_ball_pushed_a_little_sticks_and_pushed_back_has_given_no_energy(ball):
    way = [*PRESSED, *((s * 1e-3, 0, DEPTH) for s in (1, 2, 3, 2, 1, 0)), *PRESSED[1::-1]]
    stroke = Stroke(ball, poses(*way))
    answers = list(solver(0.6).follow([stroke]))
    assert all(answer.trust.converged for answer in answers)
    assert answers[3].trust.figures["slipping"] < 0.35
    forces = np.array([answer.wrenches[0][:3] for answer in answers])
    moved = np.diff(stroke.poses[:, :3, 3], axis=0)
    work = ((forces[1:] + forces[:-1]) / 2 * moved).sum(axis=1)
    assert work.sum() > 0.02 * np.abs(work).sum()
    assert np.linalg.norm(forces[-1]) < 1e-4 * np.linalg.norm(forces[2])


@pytest.mark.slow
def test_a_ball_pushed_lightly_sideways_creeps_as_cattaneo_and_mindlin_say():
    """F = mu N (1 - (1 - k s / (1.5 mu N))^1.5), k = 8 G a / (2 - nu) (Johnson, "Contact Mechanics", sec. 7.2-7.3).

    A layer 28 times as thick as the contact is wide; a is Hertz's of the force. Wedges end at the depths of materials,
    so equal ones make the mesh fine where the stress is.
    """
    nu, mu, radius, depth, modulus = 0.45, 0.5, 8e-3, 0.25e-3, 1e3
    plies = tuple(Ply(z, modulus, nu) for z in (0.8e-3, 2.5e-3, 7e-3))
    thick = plate(0.072, 6e-3, 0.04, crossed=True).with_(tissue=Tissue(modulus, nu, deeper=plies))
    field = SignedDistance.of(scenes.ball(radius, 5), spacing=0.3e-3)
    fem = PatchFem(element="P1xP2", layers=1, refine=5, reach=0.8, check_stability=False)
    slid = [0.06e-3, 0.12e-3, 0.2e-3]
    way = np.array([at(x, 0, radius - depth * (z > 0)) for x, z in [(0, 0), (0, 1), *((x, 1) for x in slid)]])
    answers = list(IndenterFem(fem, friction=mu, step=0.01).prepare(thick).follow([Stroke(field, way)]))
    for x, answer in zip(slid, answers[2:], strict=True):
        along, normal = answer.wrenches[0][0], -answer.wrenches[0][2]
        wide = (0.75 * normal * radius * (1 - nu**2) / modulus) ** (1 / 3)
        stiff = 8 * modulus / (2 * (1 + nu)) * wide / (2 - nu)
        expected = mu * normal * (1 - max(0.0, 1 - stiff * x / (1.5 * mu * normal)) ** 1.5)
        assert along == pytest.approx(expected, abs=0.03 * mu * normal)
    assert answers[1].force == pytest.approx(4 / 3 * modulus / (1 - nu**2) * radius**0.5 * depth**1.5, rel=0.1)


def test_a_ball_that_spins_bears_the_torque_of_full_slip(ball):
    """The integral of mu p r over the contact, less than mu times force times its radius."""
    mu = 0.3
    spun = np.array([turn((0, 0, 1), angle, (0, 0, RADIUS - DEPTH)) for angle in (0.3, 0.7, 1.1)])
    answers = list(solver(mu).follow([Stroke(ball, np.concatenate([poses(*PRESSED), spun]))]))
    last = answers[-1]
    assert last.trust.converged and last.trust.figures["slipping"] > 0.95
    arm = np.linalg.norm((LAYER.vertices + last.displacement)[:, :2], axis=1)
    normal = np.maximum(-last.traction[:, 2], 0) * LAYER.vertex_areas
    assert last.wrenches[0][5] == pytest.approx(mu * float(arm @ normal), rel=0.2)
    assert np.abs(last.wrenches[0][[0, 1]]).max() < 0.02 * last.force


def test_the_tangent_of_friction_is_the_derivative_of_its_forces(ball, monkeypatch):
    """Slipping and sticking columns at once."""
    monkeypatch.setattr(tool_contact, "SLIP_KEPT", 0.0)
    tool = Press(ball, at(0, 0, RADIUS - DEPTH), np.array([0, 0, -1.0]))
    rng = np.random.default_rng(0)
    skin = rng.uniform(-2e-3, 2e-3, (30, 3)) - [0, 0, 1.5e-3]
    area, n = np.full(30, 1e-6), np.arange(30)
    limit = np.where(n % 2, 5.0, 1e9)
    anchor = tool.to_tool(skin + rng.normal(size=(30, 3)) * 1e-4)
    load = PressLoad(tool, area, n, n, (1e7, 1e6), np.full(30, 10.0), anchor, limit)
    assert 0 < load.slipping(skin) < 1
    data, step, eps = np.zeros((30, 3, 3)), rng.normal(size=(30, 3)), 1e-9
    load.add_tangent(skin, 1.0, data, symmetric=False)
    difference = (load.nodal_forces(skin + eps * step) - load.nodal_forces(skin - eps * step)) / (2 * eps)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", data, step), -difference, atol=1e-5 * np.abs(difference).max())


def test_a_held_ball_relaxes_and_a_lifted_one_lets_go(ball):
    """A stack whose materials fade alike: held, its force fades as the series; lifted at once, nothing pulls."""
    series = Prony((0.225, 0.225), (0.5, 5.0))
    tissue = Tissue(3e3, 0.4, relaxation=series, deeper=(Ply(5e-3, 9e3, 0.4, relaxation=series),))
    fem = IndenterFem(PatchFem(element="P1xP2", layers=1, refine=1, reach=2, check_stability=False), step=0.1)
    held = [0.01, 0.3, 1.0, 5.0, 20.0]
    way = [(0, 0, 0.0), *[(0, 0, DEPTH)] * len(held), (0, 0, 0.5 * DEPTH), (0, 0, -1e-3)]
    times = [0.0, *held, held[-1] + 0.01, held[-1] + 0.02]
    answers = list(fem.prepare(LAYER.with_(tissue=tissue)).follow([Stroke(ball, poses(*way))], times=times))
    forces = np.array([answer.force for answer in answers])
    assert [answer.time for answer in answers] == times
    after = np.array(held) - 0.005
    np.testing.assert_allclose(forces[2:6] / forces[1], series.left(after[1:]) / series.left(after[0]), rtol=0.01)
    assert forces[-2] < 0.3 * forces[-3] and forces[-1] == pytest.approx(0, abs=1e-6)
    peaks = [np.linalg.norm(answer.displacement, axis=1).max() for answer in answers]
    assert peaks[-1] > 0.05 * peaks[-3]  # the skin lags


def test_paths_that_make_no_sense_are_refused_with_their_reason(ball):
    fem = solver(0.3)
    with pytest.raises(InvalidInput, match="begin outside"):
        list(fem.follow([Stroke(ball, poses((0, 0, 1e-3), (0, 0, 2e-3)))]))
    with pytest.raises(InvalidInput, match="never touch"):
        list(fem.follow([Stroke(ball, poses((0, 0, -2e-3), (1e-3, 0, -2e-3)))]))
    with pytest.raises(InvalidInput, match="core"):
        list(fem.follow([Stroke(ball, poses((0, 0, 0), (0, 0, 13e-3)))]))
    with pytest.raises(InvalidInput, match="increase"):
        list(fem.follow([Stroke(ball, poses(*PRESSED))], times=[0, 1, 1]))
    with pytest.raises(InvalidInput, match="as many as the others"):
        list(fem.follow([Stroke(ball, poses(*PRESSED)), Stroke(ball, poses(*PRESSED[:2]))]))
    with pytest.raises(InvalidInput, match="not rigid"):
        Stroke(ball, 2 * poses(*PRESSED))


def test_a_stroke_goes_straight_and_turns_evenly_between_its_poses(ball):
    ends = np.array([at(0, 0, 0.02), turn((0, 0, 1), 1.0, (0.01, 0, 0.02))])
    stroke = Stroke(ball, ends)
    np.testing.assert_allclose(stroke.pose(0.3), turn((0, 0, 1), 0.3, (0.003, 0, 0.02)), atol=1e-12)
    np.testing.assert_array_equal(stroke.pose(1.0), ends[1])
    ways = [press.pose_body_from_tool[0, 3] for press in stroke.sampled(1e-3)]
    assert max(b - a for a, b in pairwise(ways)) <= 1e-3
