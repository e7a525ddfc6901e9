"""What finite elements refuse and where they stop: folds within a patch, and a limit of work."""

import numpy as np
import pytest

from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.few_steps import FewSteps
from fem_tools.indenter import Walk
from fem_tools.newton import MAX_WORK, NewtonSettings
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.methods import Winkler
from stmpl_core.sdf import SignedDistance
from tests import scenes
from tests.scenes import at, dented, disc, limb


@pytest.mark.parametrize("method", [PatchFem(), FewSteps(2, Winkler()), IndenterFem(PatchFem())])
def test_a_fold_refuses_the_patches_that_hold_it_and_no_others(method):
    layer, sound = dented(), limb(4e-3, length=0.24)
    middle = layer.vertices[len(layer.vertices) // 2]
    beside = sound.vertices[np.linalg.norm(sound.vertices - middle - [0, 0, 0.06], axis=1).argmin()]

    def motion(layer, centre):
        if isinstance(method, IndenterFem):
            field = SignedDistance.of(scenes.ball(0.01))
            tool = Press(field, at(*(1.5 * centre[:2]), centre[2]), -centre * [1, 1, 0])
            return method.prepare(layer).press([tool], 1e-3).displacement
        return method.prepare(layer).solve(disc(layer, 0.3, centre, 0.008)).displacement

    np.testing.assert_allclose(motion(layer, beside), motion(sound, beside), atol=1e-9)
    with pytest.raises(MeshError, match=r"folds on itself below \d+ vertices within 2.5 thicknesses of the load"):
        motion(layer, middle)


def test_a_fold_that_the_load_hardly_feels_is_left_out():
    """Far enough the fold is a hole, whose rim is held; the answer is the sound limb's but for the error it states."""
    layer, sound = dented(), limb(4e-3, length=0.24)
    middle = layer.vertices[len(layer.vertices) // 2]
    beside = sound.vertices[np.linalg.norm(sound.vertices - middle - [0, 0, 0.04], axis=1).argmin()]
    with_hole, whole = (PatchFem().prepare(each).solve(disc(each, 0.3, beside, 0.008)) for each in (layer, sound))
    peak = np.linalg.norm(whole.displacement, axis=1).max()
    away = np.linalg.norm(layer.vertices - middle, axis=1)
    cut_off = with_hole.trust.figures["truncation_m"]
    assert with_hole.trust.ok and cut_off < 0.02 * peak
    assert not with_hole.displacement[away < 3e-3].any() and whole.displacement[away < 3e-3].any()
    np.testing.assert_allclose(with_hole.displacement, whole.displacement, atol=cut_off)


def test_no_solve_goes_on_without_a_limit_of_work():
    layer = limb(5e-3)
    load = disc(layer, 0.8, layer.vertices[len(layer.vertices) // 2], 0.012)
    free = PatchFem(reach=3).prepare(layer).solve(load)
    work = free.trust.figures["work"]
    assert free.trust.ok and 0 < work < MAX_WORK
    enough = PatchFem(reach=3, settings=NewtonSettings(max_work=1.01 * work)).prepare(layer).solve(load)
    np.testing.assert_array_equal(enough.displacement, free.displacement)
    for share in (0.01, 0.5):
        short = PatchFem(reach=3, settings=NewtonSettings(max_work=share * work)).prepare(layer).solve(load).trust
        assert not short.converged and short.error_bound is None
        assert "limit of work" in short.why and "Try" in short.why
        assert short.figures["work"] < share * work + 0.4 * work, "it overshoots by a Newton step at most"
    with pytest.raises(InvalidInput, match="max_work"):
        NewtonSettings(max_work=0)


def test_no_press_goes_on_without_a_limit_of_work():
    layer = limb(5e-3)
    tool = Press(SignedDistance.of(scenes.ball()), at(0.08, 0, 0.08), np.array([-1.0, 0, 0]))
    free, depths = IndenterFem(PatchFem(reach=3)).prepare(layer), [5e-4, 3e-3]
    walk = Walk(free, layer, [tool], np.array(depths))
    assert walk.walk(depths[0])
    short = IndenterFem(PatchFem(reach=3), max_work=1.5 * walk.work).prepare(layer)
    first, last = short.path([tool], depths)
    assert first.trust.converged and not last.trust.converged and "limit of work" in last.trust.why
    assert depths[0] <= last.depth < depths[1]
    np.testing.assert_array_equal(first.displacement, next(free.path([tool], depths)).displacement)
    with pytest.raises(InvalidInput, match="max_work"):
        IndenterFem(max_work=float("nan"))
