"""Laws of the bound on the motion under tools."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from fem_tools.indenter import IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from stmpl_core import Contact, Prony, State, Tissue, Tool, Touch
from stmpl_core.bounds import beside_walls, motion_bound
from stmpl_core.methods import MomentNet
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.touch import Answer
from tests.scenes import LENGTH, RADIUS, at, ball, limb, plate, press, punch

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


def test_fine_skin_beside_a_wall_may_be_off_by_half_its_motion() -> None:
    """Beside pads on edges of 2 mm finite elements find it up to 0.27 of the peak off, where 0.16 was stated."""
    fine = Simulator(plate(0.06, 2e-3, 7.5e-3), MomentNet())
    pad = trimesh.creation.cylinder(8e-3, 0.01, sections=64)
    middle = 0.5 * (fine.layer.vertices.min(axis=0) + fine.layer.vertices.max(axis=0))
    beside = []
    for tool, lowest in ((Tool("pad", pad.vertices, pad.faces), 5e-3), (BALL, 12e-3)):
        answer = fine.step([Contact(tool, at(middle[0], middle[1], lowest - 1e-3))])
        beside.append(beside_walls(fine.layer, list(answer.touches.values()), answer.displacement))
        assert answer.trust.ok and answer.trust.error_bound is not None and answer.trust.error_bound >= beside[-1]
    assert beside[0] > 0.2 * 1e-3 and beside[1] == 0


def test_nothing_that_presses_errs_by_nothing(sim: Simulator) -> None:
    assert pressed(sim, -5e-3).trust.error_bound == 0.0


def test_an_answer_out_of_range_states_none(sim: Simulator) -> None:
    answer = pressed(sim, 9e-3)
    assert not answer.trust.in_range and answer.trust.error_bound is None


def test_a_wrench_that_drags_widens_it(sim: Simulator) -> None:
    straight, slanted = (pressed(sim, 2e-3, (-0.06, drag, 0)).trust for drag in (0.0, 0.012))
    assert straight.error_bound is not None and slanted.error_bound is not None
    assert slanted.error_bound > straight.error_bound + 5e-4


def followed(sim: Simulator, poses: list[np.ndarray], dt: float = 0.1) -> list[Touch]:
    touches, state = [], State()
    for pose in poses:
        touches, state = sim.touch([Contact(BALL, pose)], state, dt)
    return touches


def test_skin_that_is_not_back_yet_may_be_elsewhere() -> None:
    """Finite elements are up to 0.6 mm off where skin has come back from 6 mm to between 1 and 3."""
    tissue = Tissue(LIMB.tissue.youngs_modulus, LIMB.tissue.poisson_ratio, relaxation=Prony((0.45,), (0.5,)))
    relaxing = Simulator(LIMB.with_(tissue=tissue), MomentNet())
    down, away = at(RADIUS + 0.012 - 3e-3, 0, MIDDLE), at(RADIUS + 0.02, 0, MIDDLE)
    answer = relaxing.answer(followed(relaxing, 20 * [down] + [away]))
    peak = float(answer.magnitude.max())
    assert peak > 1e-3 and answer.trust.in_range and answer.trust.error_bound is not None
    assert 0.3 * peak < answer.trust.error_bound < peak
    rest = followed(relaxing, 20 * [down] + 40 * [away], 1.0)
    assert relaxing.answer(rest).trust.error_bound == 0.0


def test_a_groove_alone_may_be_off_by_itself() -> None:
    assert motion_bound(None, [], [], 2e-3, 1e-3) == 1e-3


def test_skin_that_is_dragged_along_widens_it() -> None:
    rubbed, smooth = (Simulator(LIMB, MomentNet(), friction=mu) for mu in (0.6, None))
    poses = [at(RADIUS + 0.012 - 2e-3, 0, MIDDLE + 1e-4 * k) for k in range(20)]
    touches = followed(rubbed, poses, 0.01)
    slip = touches[0].slip
    assert slip is not None and np.linalg.norm(slip.offset) > 5e-4
    dragged, straight = (one.answer(touch).trust.error_bound
                         for one, touch in ((rubbed, touches), (smooth, followed(smooth, poses, 0.01))))  # fmt: skip
    assert dragged is not None and straight is not None
    assert dragged - straight > 0.9 * float(slip.offset @ slip.offset) / touches[0].depth


def test_skin_turns_with_a_tool_that_spins_in_place() -> None:
    """Nothing jumps where the way along the skin is next to none."""
    sim = Simulator(LIMB, MomentNet(), friction=0.6)
    poses = [at(RADIUS + 0.012 - 2e-3, 0, MIDDLE) for _ in range(10)]
    for k, pose in enumerate(poses):
        pose[:3, :3] = Rotation.from_rotvec([-0.02 * k, 0, 0]).as_matrix() @ pose[:3, :3]
    (touch,) = followed(sim, poses, 0.01)
    assert touch.slip is not None
    still, near = (sim.answer([replace(touch, slip=touch.slip._replace(offset=np.array([0, 0, by])))])
                   for by in (0.0, 2e-6))  # fmt: skip
    straight = sim.answer([replace(touch, slip=None)])
    turned = np.linalg.norm(still.displacement - straight.displacement, axis=1)
    assert turned.max() > 2e-4
    assert np.abs(still.displacement - near.displacement).max() < 2e-5
    assert still.trust.error_bound is not None and straight.trust.error_bound is not None
    assert still.trust.error_bound > straight.trust.error_bound


class Silent(MomentNet):
    """A method that says nothing of contacts."""

    contact_bound = stick_bound = None


def test_a_method_that_knows_none_states_none() -> None:
    answer = pressed(Simulator(LIMB, Silent()), 2e-3)
    assert answer.trust.in_range and answer.trust.error_bound is None


@pytest.mark.parametrize("share, flagged", [(0.01, (False, False)), (0.05, (True, False)), (0.1, (True, True))])
def test_motion_that_is_held_back_is_flagged_or_in_the_bound(monkeypatch, share, flagged) -> None:
    """Of a method without a bound from 0.02 of the peak on, of one with a bound from 0.08."""
    answers = [pressed(Simulator(LIMB, method), 2e-3) for method in (Silent(), MomentNet())]
    peak = answers[1].magnitude.max()
    monkeypatch.setattr("stmpl_core.simulator._within", lambda moved, _: (moved, peak, share * peak))
    held = [pressed(Simulator(LIMB, method), 2e-3) for method in (Silent(), MomentNet())]
    assert tuple("held back" in one.trust.why for one in held) == flagged
    assert tuple(not one.trust.in_range for one in held) == flagged
    if not flagged[1]:
        assert held[1].trust.error_bound == pytest.approx(answers[1].trust.error_bound + share * peak)
