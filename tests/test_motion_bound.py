"""Laws of the bound on the motion under tools."""

import numpy as np
import pytest

from fem_tools.indenter import IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from stmpl_core import Tool
from stmpl_core.methods import MomentNet
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.touch import Answer
from tests.scenes import LENGTH, RADIUS, at, ball, limb, press, punch

LIMB, BALL = limb(4e-3), ball(subdivisions=4)
MIDDLE = LENGTH / 2


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator(LIMB, MomentNet())


def pressed(sim: Simulator, depth: float, force: tuple[float, float, float] | None = None) -> Answer:
    return sim.step([press(BALL, at(RADIUS + 0.012 - depth, 0, MIDDLE), force)])


@pytest.mark.parametrize("tool", [BALL, punch()], ids=["ball", "punch"])
def test_it_covers_finite_elements_and_is_no_larger_than_the_motion(sim: Simulator, tool: Tool) -> None:
    """On a limb that nothing was learnt from."""
    field = SignedDistance.of(tool)
    above = Press(field, at(RADIUS + 0.03, 0, MIDDLE), np.array([-1.0, 0, 0]))
    solver = IndenterFem(PatchFem(refine=1, layers=1, reach=4), step=0.1).prepare(LIMB)
    for truth in solver.path([above], np.array([1e-3, 3e-3])):
        contact = press(tool, truth.tools[0].pose_body_from_tool, None)
        sim.tools.add(contact.tool, field)
        answer = sim.step([contact])
        worst = float(np.linalg.norm(answer.displacement - truth.displacement, axis=1).max())
        bound = answer.trust.error_bound
        assert answer.trust.ok and bound is not None
        assert worst < bound < 0.7 * float(answer.magnitude.max())


def test_nothing_that_presses_errs_by_nothing(sim: Simulator) -> None:
    assert pressed(sim, -5e-3).trust.error_bound == 0.0


def test_an_answer_out_of_range_states_none(sim: Simulator) -> None:
    answer = pressed(sim, 9e-3)
    assert not answer.trust.in_range and answer.trust.error_bound is None


def test_a_wrench_that_drags_widens_it(sim: Simulator) -> None:
    straight, slanted = (pressed(sim, 2e-3, (-0.06, drag, 0)).trust for drag in (0.0, 0.012))
    assert straight.error_bound is not None and slanted.error_bound is not None
    assert slanted.error_bound > straight.error_bound + 5e-4


class Silent(MomentNet):
    """A method that says nothing of contacts."""

    contact_bound = None


def test_a_method_that_knows_none_states_none() -> None:
    answer = pressed(Simulator(LIMB, Silent()), 2e-3)
    assert answer.trust.in_range and answer.trust.error_bound is None
