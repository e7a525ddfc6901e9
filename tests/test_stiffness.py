"""Laws of calibration: the stiffness that finite elements were given comes back from their presses, or is refused."""

from __future__ import annotations

import numpy as np
import pytest

from fem_tools.indenter import IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from stmpl_core import Contact, Simulator, SoftLayer
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Winkler
from stmpl_core.sdf import SignedDistance
from stmpl_core.stiffness import fit_stiffness
from stmpl_core.strokes import fit_friction, fit_relaxation
from stmpl_core.toucher import Toucher
from tests.scenes import LENGTH, RADIUS, at, ball, contact_of, limb, press

HIDDEN = 3.7e3  # Pa
LAYER, BALL = limb(4e-3), ball(subdivisions=4)
FIELD = SignedDistance.of(BALL)
DEPTHS = np.array([0.5e-3, 1e-3, 1.5e-3, 2e-3, 3e-3, 4e-3])


@pytest.fixture(scope="module")
def toucher() -> Toucher:
    return toucher_on(LAYER)  # of 1 kPa


def toucher_on(layer: SoftLayer) -> Toucher:
    """With the very field that finite elements press with."""
    toucher = Toucher(layer)
    toucher.tools.add(BALL, FIELD)
    return toucher


@pytest.fixture(scope="module")
def pressed() -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses and wrenches of a ball that finite elements press into a limb of the hidden stiffness."""
    solver = IndenterFem(PatchFem(refine=1, layers=1, reach=4), step=0.1).prepare(LAYER.with_(youngs_modulus=HIDDEN))
    tool = Press(FIELD, at(RADIUS + 0.02, 0, LENGTH / 2), np.array([-1.0, 0, 0]))
    return [(a.tools[0].pose_body_from_tool, np.array(a.wrenches[0])) for a in solver.path([tool], DEPTHS)]


def pushed(pose: np.ndarray, force: tuple[float, float, float]) -> Contact:
    return press(BALL, pose, force)


def presses(pressed, *, back: float = 0.0, noise: float = 0.0, times: int = 1) -> list[Contact]:
    """The presses as a robot reports them whose poses stand `back` [m] too far off, with noise on its forces."""
    generator, out = np.random.default_rng(0), []
    for pose, wrench in pressed * times:
        told = at(back, 0, 0) @ pose
        out.append(contact_of(BALL, told, wrench * (1 + noise * generator.normal())))
    return out


@pytest.mark.parametrize("back", [0.0, 1e-3, -1.5e-3])
def test_stiffness_and_offset_that_finite_elements_were_given_come_back(toucher, pressed, back):
    found = fit_stiffness(toucher, presses(pressed, back=back))
    assert found.trust.ok, found.trust.why
    assert found.youngs_modulus == pytest.approx(HIDDEN, rel=0.06)
    assert abs(found.youngs_modulus / HIDDEN - 1) < found.relative_error < 0.2
    assert found.offset == pytest.approx(back, abs=1e-4)
    assert found.depths == pytest.approx((DEPTHS[0], DEPTHS[-1]), abs=3e-4)
    assert found.presses == len(DEPTHS) and found.residual < 0.03


def test_noise_and_a_few_wrong_forces_change_little(toucher, pressed):
    noisy = presses(pressed, back=1e-3, noise=0.05, times=8)
    wrong = presses([(pose, 3 * wrench) for pose, wrench in pressed], back=1e-3)
    spoiled = [wrong[k % 6] if k % 12 == 5 else one for k, one in enumerate(noisy)]
    for given in (noisy, spoiled):
        found = fit_stiffness(toucher, given)
        assert found.trust.ok, found.trust.why
        assert found.youngs_modulus == pytest.approx(HIDDEN, rel=0.1)
        assert found.offset == pytest.approx(1e-3, abs=2e-4)


@pytest.mark.parametrize("wrong, ok", [(0, True), (2, True), (5, False)])
def test_presses_that_fit_to_no_stiffness_of_the_others_are_told_and_many_of_them_refused(toucher, pressed, wrong, ok):
    """Five of twelve with ten times the force were a residual of 3 %, and nothing said."""
    given = presses(pressed, times=2)
    several = presses([(pose, 10 * wrench) for pose, wrench in pressed], times=2)
    odd = np.random.default_rng(1).permutation(12)[:wrong]
    found = fit_stiffness(toucher, [several[k] if k in odd else one for k, one in enumerate(given)])
    assert found.trust.ok == ok and found.presses == 12
    assert (f"{wrong} of 12 presses do not fit" in found.trust.why) == bool(wrong)


def test_the_answer_does_not_depend_on_the_stiffness_that_was_taken_before(toucher, pressed):
    given = presses(pressed, back=1e-3)
    found, again = fit_stiffness(toucher, given), fit_stiffness(toucher_on(LAYER.with_(youngs_modulus=5e4)), given)
    assert again.youngs_modulus == pytest.approx(found.youngs_modulus, rel=1e-3)
    assert again.relative_error == pytest.approx(found.relative_error, rel=0.01)


def test_a_fit_takes_a_simulator_and_says_what_it_cannot_take(toucher, pressed):
    some, simulator = presses(pressed), Simulator(toucher.layer, Winkler())
    assert str(fit_stiffness(simulator, some)) == str(fit_stiffness(toucher, some))
    for fit in (fit_stiffness, fit_friction, fit_relaxation):
        with pytest.raises(InvalidInput, match="a Toucher or a Simulator is needed"):
            fit(None, some)  # type: ignore[arg-type]
        with pytest.raises(InvalidInput, match="a list of Contact"):
            fit(simulator, None)  # type: ignore[arg-type]


def test_too_few_presses_are_refused(toucher, pressed):
    found = fit_stiffness(toucher, presses(pressed)[:4])
    assert not found.trust.ok and "4 of 4 instants pressed" in found.trust.why and np.isnan(found.youngs_modulus)
    idle = [pushed(pose, (0, 0, 0)) for pose, _ in pressed * 3]
    assert "0 of 18 instants pressed with a force" in fit_stiffness(toucher, idle).trust.why
    with pytest.raises(InvalidInput, match="has no wrench"):
        fit_stiffness(toucher, [contact_of(BALL, at(1, 0, 0))])


def test_presses_of_one_depth_do_not_tell_stiffness_from_offset(toucher, pressed):
    for few in (pressed[4:5], pressed[3:5]):
        found = fit_stiffness(toucher, presses(few, times=10, noise=0.01))
        assert not found.trust.ok and "do not tell the stiffness from an offset" in found.trust.why


def test_forces_that_no_stiffness_explains_are_refused(toucher, pressed):
    upside_down = [(pose, wrench) for (pose, _), (_, wrench) in zip(pressed, reversed(pressed), strict=True)]
    found = fit_stiffness(toucher, presses(upside_down, times=3))
    assert not found.trust.ok and "check frames, wrench and thickness" in found.trust.why


def test_wrenches_in_another_unit_are_no_soft_tissue(toucher, pressed):
    for factor in (1e3, 1e-3):  # mN, kN
        found = fit_stiffness(toucher, presses([(pose, factor * wrench) for pose, wrench in pressed], times=2))
        assert not found.trust.ok and "are wrenches in newtons" in found.trust.why


def test_poses_further_off_than_calibration_may_leave_are_told(toucher, pressed):
    found = fit_stiffness(toucher, presses(pressed, back=5e-3, times=2))
    assert not found.trust.ok and "3 mm along their push or more" in found.trust.why
    pulling = fit_stiffness(toucher, presses([(pose, -wrench) for pose, wrench in pressed]))
    assert not pulling.trust.ok and "no force points into the skin" in pulling.trust.why


def test_presses_that_drag_or_go_deeper_than_validated_do_not_count(toucher, pressed):
    dragging = [pushed(pose, (wrench[0], 0, 0.6 * wrench[0])) for pose, wrench in pressed]
    mixed = fit_stiffness(toucher, presses(pressed) + dragging)
    assert mixed.trust.ok and mixed.youngs_modulus == pytest.approx(HIDDEN, rel=0.06)
    assert mixed.presses < 2 * len(pressed)
    deep = [pushed(at(RADIUS + 0.012 - depth, 0, LENGTH / 2), (-2e3 * depth, 0, 0)) for depth in
            (5.6e-3, 5.8e-3, 6e-3, 6.2e-3, 6.4e-3, 6.6e-3)]  # fmt: skip
    assert not fit_stiffness(toucher, deep).trust.ok
