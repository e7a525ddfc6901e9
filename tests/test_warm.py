"""Laws of finite elements from frame to frame: the answers of PatchFem, sooner, and none that is silently wrong."""

import numpy as np
import pytest

from fem_tools import PatchFem, WarmPatchFem
from fem_tools import warm as warm_module
from stmpl_core import Load, Membrane, Ply
from stmpl_core.errors import InvalidInput, MeshError, NotPrepared
from tests.scenes import THICKNESS, dented, disc, limb

LAYER = limb(4e-3)
MIDDLE = LAYER.vertices[len(LAYER.vertices) // 2]
ALONG = np.array([0, 0, 1e-3])  # m, a frame of a slide
PATHS = {
    "deeper": [disc(LAYER, 0.1 * k, MIDDLE, 0.008) for k in range(1, 8)],
    "slide": [disc(LAYER, 0.5, MIDDLE + k * ALONG, 0.01) for k in range(12)],
    "reverse": [disc(LAYER, 0.5, MIDDLE + k * ALONG, 0.008) for k in (0, 2, 4, 6, 4, 2, 0)],
    "release": [disc(LAYER, ratio, MIDDLE, 0.008) for ratio in (0.5, 0.3, 0.1, 0.0, 0.1)],
}


def off(answer, truth) -> float:
    """Largest distance at any vertex, over the peak [-]."""
    return float(np.linalg.norm(answer.displacement - truth.displacement, axis=1).max() / truth.magnitude.max())


def figures(answers, name) -> list[float]:
    return [answer.trust.figures[name] for answer in answers if name in answer.trust.figures]


@pytest.mark.parametrize("path", PATHS)
def test_every_frame_of_a_path_is_within_a_percent_of_the_converged_answer(path):
    warm, cold = WarmPatchFem().prepare(LAYER), PatchFem(check_stability=False).prepare(LAYER)
    answers = [warm.solve(load) for load in PATHS[path]]
    for load, answer in zip(PATHS[path], answers, strict=True):
        truth = cold.solve(load)
        if not len(load.loaded):
            assert not answer.displacement.any() and answer.trust.ok
            continue
        error = off(answer, truth)
        assert error < 0.01 and answer.trust.ok
        bound, usual = answer.trust.error_bound or 0.0, truth.trust.error_bound or 0.0
        assert usual < bound < 2 * usual and error * truth.magnitude.max() < bound
    assert figures(answers, "cold") == [1.0] + [0.0] * (len(figures(answers, "cold")) - 1), "the first alone is cold"
    assert max(figures(answers, "newton_iterations")[2:]) <= 3


def test_a_slide_meshes_anew_only_where_the_load_leaves_the_patch():
    warm = WarmPatchFem().prepare(LAYER)
    anew = figures([warm.solve(load) for load in PATHS["slide"]], "meshed")
    assert anew[0] == 1.0 and 1 <= sum(anew[1:]) <= 4
    wide = WarmPatchFem(slack=2.0).prepare(LAYER)
    assert sum(figures([wide.solve(load) for load in PATHS["slide"]], "meshed")) == 1.0


def test_a_load_that_stays_is_not_solved_again():
    warm, load = WarmPatchFem().prepare(LAYER), PATHS["slide"][0]
    first, second = warm.solve(load), warm.solve(load)
    assert second.trust.figures["newton_iterations"] == 0
    np.testing.assert_array_equal(first.displacement, second.displacement)


@pytest.mark.parametrize("there", [MIDDLE * [-1, -1, 1], MIDDLE + 24 * ALONG])
def test_a_jump_is_cold_and_as_good(there):
    warm, there = WarmPatchFem().prepare(LAYER), disc(LAYER, 0.5, there, 0.01)
    warm.solve(PATHS["slide"][0])
    answer = warm.solve(there)
    assert answer.trust.figures["cold"] == 1.0
    fresh = WarmPatchFem().prepare(LAYER).solve(there)
    np.testing.assert_array_equal(answer.displacement, fresh.displacement)


def test_where_the_steps_do_not_get_there_it_is_solved_as_patch_fem_does(monkeypatch):
    warm = WarmPatchFem().prepare(LAYER)
    warm.solve(PATHS["slide"][0])
    monkeypatch.setattr(warm_module, "MAX_STEPS", 0)
    answer = warm.solve(PATHS["slide"][6])
    truth = PatchFem(check_stability=False).prepare(LAYER).solve(PATHS["slide"][6])
    assert answer.trust.figures["cold"] == 1.0 and answer.trust.ok and off(answer, truth) < 0.01


def test_a_load_without_a_solution_is_told_of_and_not_started_from():
    warm, load = WarmPatchFem().prepare(LAYER), PATHS["slide"][0]
    before = warm.solve(load)
    pulled = warm.solve(Load.pressure(-20 * load.values))
    assert not pulled.trust.ok and pulled.trust.error_bound is None and "Newton stopped" in pulled.trust.why
    again = warm.solve(load)
    assert again.trust.figures["cold"] == 1.0 and off(again, before) < 1e-9


def test_what_is_tighter_is_nearer_to_the_converged_answer():
    loads = PATHS["deeper"]
    exact = PatchFem(reach=6.25, check_stability=False).prepare(LAYER).solve(loads[-1])
    errors = []
    for tolerance in (1e-2, 1e-3, 1e-5):
        warm = WarmPatchFem(tolerance=tolerance).prepare(LAYER)
        errors.append(off([warm.solve(load) for load in loads][-1], exact))
    assert errors[1] < 3e-3 and errors[2] < 1e-2 * errors[0]


@pytest.mark.parametrize("element", ["P1xP2", "P2xP2"])
def test_a_stack_under_a_skin_slides_alike(element):
    layer = limb(6e-3).with_(skin=Membrane(2e5, 1.5e-3, 20.0), deeper=(Ply(3e-3, 5e3),))
    warm, cold = WarmPatchFem(element=element).prepare(layer), PatchFem(element=element).prepare(layer)
    middle = layer.vertices[len(layer.vertices) // 2]
    loads = [disc(layer, 0.5, middle + k * 4 * ALONG, 0.012) for k in range(3)]
    answers = [warm.solve(load) for load in loads]
    assert figures(answers, "cold") == [1.0, 0.0, 0.0] and sum(figures(answers, "meshed")) > 1
    assert off(answers[-1], cold.solve(loads[-1])) < 0.01


def test_dead_forces_are_solved_as_patch_fem_does():
    warm, load = WarmPatchFem().prepare(LAYER), PATHS["slide"][0]
    dead = Load.nodal(0.4 * load.values * LAYER.vertex_areas)
    answers = [warm.solve(dead), warm.solve(dead.scaled(0.9))]
    assert figures(answers, "cold") == [1.0, 1.0]
    assert off(answers[1], PatchFem(check_stability=False).prepare(LAYER).solve(dead.scaled(0.9))) < 0.01


def test_a_fold_and_a_wrong_load_leave_the_last_answer_in_place():
    layer = dented()
    warm, middle = WarmPatchFem().prepare(layer), layer.vertices[len(layer.vertices) // 2]
    beside = disc(layer, 0.3, layer.vertices[np.linalg.norm(layer.vertices - middle - [0, 0, 0.06], axis=1).argmin()],
                  0.008)  # fmt: skip
    first = warm.solve(beside)
    with pytest.raises(MeshError, match="folds on itself"):
        warm.solve(disc(layer, 0.3, middle, 0.008))
    with pytest.raises(InvalidInput):
        warm.solve(Load.pressure(np.zeros(3)))
    np.testing.assert_array_equal(warm.solve(beside).displacement, first.displacement)


def test_a_load_that_slides_to_the_open_border_is_told_of():
    warm = WarmPatchFem(reach=2.0, slack=2.0).prepare(LAYER)
    start = MIDDLE + [0, 0, LAYER.vertices[:, 2].max() - MIDDLE[2] - 3.6 * THICKNESS]
    trusts = [warm.solve(disc(LAYER, 0.2, start + k * 2 * ALONG, 0.008)).trust for k in range(8)]
    assert trusts[0].in_range and not trusts[-1].in_range and "open border" in trusts[-1].why


def test_settings_that_make_no_sense_are_refused():
    for reach, slack, tolerance in ((0.0, 1.0, 1e-3), (5.0, -1.0, 1e-3), (5.0, 1.0, 0.0)):
        with pytest.raises(InvalidInput, match="are allowed"):
            WarmPatchFem(reach=reach, slack=slack, tolerance=tolerance)
    with pytest.raises(NotPrepared):
        WarmPatchFem().solve(PATHS["slide"][0])
