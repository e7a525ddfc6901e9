"""Laws of what strokes tell: friction and relaxation that a simulator or finite elements had come back."""

from dataclasses import replace

import numpy as np
import pytest

from stmpl_core import Contact, Prony, Simulator, SoftLayer, State, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.history import History
from stmpl_core.methods import MomentNet, Winkler
from stmpl_core.strokes import _unlike, fit_friction, fit_relaxation
from stmpl_core.tissue import Membrane, Ply
from stmpl_core.toucher import Toucher
from tests.scenes import at, ball, plate
from tests.test_state_against_fem import Stroke

RADIUS, DEPTH = 8e-3, 3e-3
BALL = ball(RADIUS)
SERIES = Prony((0.2, 0.15), (0.5, 5.0))


def measured(poses: np.ndarray, times: np.ndarray, friction: float | None, series: Prony | None = None, *,
             noise: float = 0.02, lag: float = 0.0, layer: SoftLayer | None = None) -> list[Contact]:  # fmt: skip
    """What a robot reports of a ball at positions (N, 3) [m], as our own simulator feels it, with noise on the forces.

    Args:
        noise: standard deviation of the forces over the largest.
        lag: way by which the reported positions are too high [m].
        layer: skin; None: a slab of one material, which relaxes as the series says.
    """
    layer = layer or plate(0.09).with_(tissue=Tissue(2e4, 0.4, relaxation=series))
    simulator = Simulator(layer, MomentNet() if layer.tissue.skin else Winkler(), friction=friction)
    state, out, random = State(), [], np.random.default_rng(0)
    for k, place in enumerate(poses):
        (touch,), state = simulator.touch([Contact(BALL, at(*place))], state, times[k] - times[k - 1] if k else 0.0)
        out.append(Contact(BALL, at(*(place + [0, 0, lag])), touch.wrench, time=times[k]))
    size = noise * max(np.linalg.norm(one.wrench[:3]) for one in out)
    return [replace(one, wrench=one.wrench + np.append(size * random.normal(size=3), np.zeros(3))) for one in out]


def wiped(length: float, back: bool, depth: float = DEPTH) -> tuple[np.ndarray, np.ndarray]:
    """Positions and times of a ball that comes down, and is led along x, and back."""
    down = np.linspace(-1e-4, depth, 10)
    along = np.arange(0, length, 2e-4)
    along = np.concatenate([0 * down, along, along[::-1] if back else along[:0]])
    deep = np.concatenate([down, np.full(len(along) - 10, depth)])
    return np.column_stack([along, 0 * along + 3e-4, RADIUS - deep]), 0.01 * np.arange(len(along))


def held(lasts: float, ramp: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Positions and times of a ball that comes down and stays."""
    down, stays = np.linspace(-1e-4, DEPTH, 10), np.linspace(0, lasts, 60)[1:]
    times = np.concatenate([np.linspace(0, ramp, 10), ramp + stays])
    return np.array([[3e-4, 2e-4, RADIUS - d] for d in np.concatenate([down, np.full(59, DEPTH)])]), times


@pytest.fixture(scope="module")
def toucher() -> Toucher:
    return Toucher(plate(0.09).with_(tissue=Tissue(2e4, 0.4)))


@pytest.mark.parametrize("mu", [0.15, 0.4, 1.0])
def test_friction_of_a_stroke_comes_back(toucher: Toucher, mu: float) -> None:
    found = fit_friction(toucher, measured(*wiped(0.02, back=True), mu))
    assert found.trust.ok, found.trust.why
    assert found.both_ways and found.friction == pytest.approx(mu, rel=0.08)
    assert abs(found.friction - mu) < 2 * found.error < 0.4 * mu


@pytest.mark.parametrize("mu", [0.3, 0.8])
def test_friction_on_taut_skin_comes_back(mu: float) -> None:
    """Where a tool is wrapped in skin the force along it is up to half more than mu of that into it."""
    tissue = Tissue(2.5e3, 0.45, skin=Membrane(1.3e5, 2.5e-3, 11.4), deeper=(Ply(6e-3, 3.1e4, 0.45),))
    layer = plate(0.09, 3e-3, 18e-3).with_(tissue=tissue)
    found = fit_friction(Toucher(layer), measured(*wiped(0.04, back=True, depth=5e-3), mu, layer=layer))
    assert found.trust.ok, found.trust.why
    assert found.friction == pytest.approx(mu, rel=0.06)


@pytest.mark.parametrize("mu", [0.3, 0.6, 1.0])
def test_friction_of_finite_elements_comes_back(mu: float) -> None:
    stroke = Stroke(f"slab-ball8-mu{mu}")
    contacts = [Contact(stroke.tool, pose, wrench) for pose, wrench in zip(stroke.pose, stroke.wrench, strict=True)]
    found = fit_friction(stroke.simulator.toucher, contacts)
    assert found.trust.ok, found.trust.why
    assert not found.both_ways
    assert abs(found.friction - mu) < 2 * found.error < 0.6 * mu


def test_a_stroke_that_sticks_or_is_short_tells_no_friction(toucher: Toucher) -> None:
    for contacts in (measured(*wiped(1e-3, back=True), 1.0), measured(*wiped(4e-4, back=False), 0.4)):
        found = fit_friction(toucher, contacts)
        assert not found.trust.ok and np.isnan(found.friction)
        assert "mm are needed" in found.trust.why or "instants" in found.trust.why
    still = [measured(*wiped(0.02, back=True), 0.4)[10]] * 30
    assert "stood still" in fit_friction(toucher, still).trust.why


def test_a_force_the_wrong_way_round_is_no_friction(toucher: Toucher) -> None:
    turned = [replace(one, wrench=np.zeros(6) if one.wrench is None else one.wrench * [-1, -1, 1, 1, 1, 1])
              for one in measured(*wiped(0.02, True), 0.4)]  # fmt: skip
    found = fit_friction(toucher, turned)
    assert not found.trust.ok and "against the tool's way" in found.trust.why


def test_what_never_pressed_is_told_so_and_what_has_too_few_instants(toucher: Toucher) -> None:
    """They were told to stroke further, and to hold."""
    stroke, press = measured(*wiped(0.02, True), 0.4), measured(*held(5.0), None, SERIES)
    for fit, contacts in ((fit_friction, stroke), (fit_relaxation, press)):
        pulled = [replace(one, wrench=np.zeros(6) if one.wrench is None else -one.wrench) for one in contacts]
        in_mm = [replace(one, pose_body_from_tool=at(*(1e3 * one.pose_body_from_tool[:3, 3]))) for one in contacts]
        for given in (pulled, in_mm):
            found = fit(toucher, given)
            assert not found.trust.ok and "no force points into the skin where the poses touch" in found.trust.why
    few = fit_friction(toucher, stroke[:110:12])
    assert not few.trust.ok and few.trust.why.endswith("Tell more instants of the stroke")


def test_a_stroke_in_millinewtons_is_asked_for_its_unit(toucher: Toucher) -> None:
    """It was told to stroke further."""
    stroke = [replace(one, wrench=1e3 * np.asarray(one.wrench)) for one in measured(*wiped(1e-3, back=True), 0.4)]
    found = fit_friction(toucher, stroke)
    assert not found.trust.ok and found.trust.why.endswith("are wrenches in newtons, and poses in metres?")


def test_instants_whose_poses_are_off_the_skin_divide_by_nothing(toucher: Toucher) -> None:
    tool, wrench = ball(), np.array([0, 0, -1.0, 0, 0, 0])
    both = [Contact(tool, at(0, 0, 0.012 - depth), wrench) for depth in (3e-3, -3e-3)]
    with np.errstate(all="raise"):
        _unlike(toucher, both)


def test_a_stroke_whose_poses_tremble_is_not_told_to_tell_more(toucher: Toucher) -> None:
    rng, stroke = np.random.default_rng(0), measured(*wiped(0.02, True), 0.4)
    trembling = [replace(one, pose_body_from_tool=at(*rng.normal(0, 3e-4, 3)) @ one.pose_body_from_tool)
                 for one in stroke]  # fmt: skip
    found = fit_friction(toucher, trembling)
    assert not found.trust.ok and found.trust.why.endswith("Smooth its poses: they tremble"), found.trust.why


def test_a_tool_that_slides_freely_has_no_friction_to_be_found(toucher: Toucher) -> None:
    """It was told that its force points the wrong way."""
    for friction, noise in ((None, 0.0), (0.0, 0.02)):
        found = fit_friction(toucher, measured(*wiped(0.02, back=True), friction, noise=noise))
        assert not found.trust.ok and "no friction was found" in found.trust.why, (found, found.trust.why)
    assert "mu = 0.00 +-" in str(replace(found, friction=-1e-4))


def test_little_friction_one_way_is_not_told_from_a_tilt(toucher: Toucher) -> None:
    found = fit_friction(toucher, measured(*wiped(0.02, back=False), 0.1))
    assert not found.trust.ok and "there and back" in found.trust.why


def test_relaxation_of_a_press_comes_back_whatever_the_stiffness(toucher: Toucher) -> None:
    given = measured(*held(10.0), None, SERIES)
    for skin in (toucher, Toucher(toucher.layer.with_(youngs_modulus=5e3))):
        found = fit_relaxation(skin, given, Prony((0.4, 0.3), (0.5, 5.0)))
        assert found.trust.ok, found.trust.why
        assert found.share == pytest.approx(0.35, abs=0.03) and abs(found.share - 0.35) < 2 * found.error < 0.2
        assert found.relaxation is not None
        np.testing.assert_allclose(found.relaxation.shares, SERIES.shares, atol=0.03)
    none = fit_relaxation(toucher, measured(*held(10.0), None), SERIES)
    assert none.trust.ok and abs(none.share) < 0.03


def test_relaxation_of_finite_elements_comes_back() -> None:
    stroke = Stroke("slab-ramp-hold")
    contacts = [Contact(stroke.tool, pose, wrench, time=time)
                for pose, wrench, time in zip(stroke.pose, stroke.wrench, stroke.time, strict=True)]  # fmt: skip
    found = fit_relaxation(stroke.simulator.toucher, contacts)
    assert found.trust.ok, found.trust.why
    assert found.share == pytest.approx(0.45, abs=0.03) and abs(found.share - 0.45) < 2 * found.error < 0.2


def test_a_short_hold_or_a_slide_tells_no_relaxation(toucher: Toucher) -> None:
    short = fit_relaxation(toucher, measured(*held(0.3), None, SERIES), SERIES)
    assert not short.trust.ok and "hold longer" in short.trust.why
    moving = fit_relaxation(toucher, measured(*wiped(0.02, False), 0.3, SERIES)[9:], SERIES)
    assert not moving.trust.ok and "Press, and hold" in moving.trust.why


@pytest.mark.parametrize("unit", [1e-3, 1e-2, 1e3])
def test_a_press_whose_times_are_not_in_seconds_tells_no_relaxation(toucher: Toucher, unit: float) -> None:
    """It was told that 1816 % of the force fade, or 93 %, where 35 % do."""
    given = [replace(one, time=unit * one.time) for one in measured(*held(10.0), None, SERIES)]
    found = fit_relaxation(toucher, given, SERIES)
    assert not found.trust.ok and np.isnan(found.share) and found.relaxation is None
    assert "are the times in seconds?" in found.trust.why and "0.5 and 5 s" in found.trust.why, found.trust.why


def test_what_tells_nothing_by_its_kind_is_refused(toucher: Toucher) -> None:
    bare = [Contact(BALL, at(0, 0, RADIUS - DEPTH))]
    both = [Contact(one, at(0, 0, RADIUS - DEPTH), np.array([0, 0, -1.0, 0, 0, 0])) for one in (BALL, BALL.named("b"))]
    for fit in (fit_friction, fit_relaxation):
        for wrong in (bare, both):
            with pytest.raises(InvalidInput):
                fit(toucher, wrong)
    with pytest.raises(InvalidInput, match="go forward"):
        fit_relaxation(toucher, both[:1] * 10)
    with pytest.raises(InvalidInput, match="go back"):
        fit_friction(toucher, measured(*wiped(0.02, True), 0.4)[::-1])


def test_a_recording_that_begins_in_mid_hold_tells_no_relaxation(toucher: Toucher) -> None:
    press = measured(*held(10.0), None, SERIES)
    found = fit_relaxation(toucher, press[12:], SERIES)
    assert not found.trust.ok and np.isnan(found.share) and "Begin before the tool touches" in found.trust.why


@pytest.mark.parametrize("radius, depth", [(4e-3, 2e-3), (25e-3, 6e-3)])
def test_a_stack_tells_the_series_of_its_materials_under_tips_and_palms(radius: float, depth: float) -> None:
    skin = Membrane(2e5, 1.5e-3, 15.0)
    layer = plate(0.15, 5e-3, 0.025).with_(tissue=Tissue(3e3, 0.4, skin=skin, deeper=(Ply(8e-3, 15e3, 0.4),)))
    history, state, press = History(Toucher(layer.with_(tissue=layer.tissue.relaxing(SERIES)))), State(), []
    for place, time, before in zip(*held(10.0), [0.0, *held(10.0)[1]], strict=False):
        pose = at(*place[:2], radius - depth * (RADIUS - place[2]) / DEPTH)
        (touch,), state = history.step([Contact(ball(radius), pose)], state, time - before)
        press.append(Contact(ball(radius), pose, touch.wrench, time=time))
    found = fit_relaxation(Toucher(layer), press, SERIES)
    assert found.trust.ok and found.relaxation is not None, found.trust.why
    np.testing.assert_allclose(found.relaxation.shares, SERIES.shares, rtol=0.02)


def test_poses_that_tremble_tell_friction_as_well(toucher: Toucher) -> None:
    random = np.random.default_rng(1)
    strokes = [replace(one, pose_body_from_tool=one.pose_body_from_tool + np.pad(
        np.column_stack([np.zeros((3, 3)), 2e-5 * random.normal(size=3)]), ((0, 1), (0, 0))))
        for one in measured(*wiped(0.02, True), 0.45)]  # fmt: skip
    found = fit_friction(toucher, strokes)
    assert found.trust.ok and abs(found.friction - 0.45) < 2 * found.error < 0.2, found.trust.why
