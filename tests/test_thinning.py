"""Laws of thinning: who is asked, what is filled in, and that answers are those of asking everybody."""

import numpy as np
import pytest

from benchmarks.tools import ball, block_letter, flat
from stmpl_core import Contact, Load, Simulator, SoftLayer, Tool
from stmpl_core.methods import Linear, MomentNet
from stmpl_core.moments import Surroundings
from stmpl_core.response import REACH
from stmpl_core.thinning import SPACINGS, ZONES, Asked, Thinning
from tests import scenes

T = 7e-3


def arm(h: float = 3e-3, t: float = T) -> SoftLayer:
    return scenes.limb(h, t)


def pressed(layer: SoftLayer, radius: float = 8e-3) -> Load:
    return scenes.disc(layer, 0.5, (0.04, 0, 0.08), radius, 3e-3)


def everybody(thinning: Thinning, loaded: np.ndarray) -> Asked:
    none = np.empty(0, np.int32)
    return Asked(loaded, thinning.reached(loaded), none, none.reshape(0, 1), np.empty((0, 1), np.float32))


@pytest.fixture(scope="module")
def layer() -> SoftLayer:
    return arm()


@pytest.fixture(scope="module")
def asked(layer: SoftLayer) -> Asked:
    return Surroundings.of(layer).asked(np.flatnonzero(pressed(layer).values))


def test_every_vertex_in_reach_is_asked_or_filled_in_once(layer: SoftLayer, asked: Asked) -> None:
    loaded = np.flatnonzero(pressed(layer).values)
    reached = Thinning(layer, Surroundings.of(layer).frames, REACH).reached(loaded)
    assert not np.intersect1d(asked.vertices, asked.between).size
    assert np.isin(reached, np.union1d(asked.vertices, asked.between)).all()
    assert np.isin(asked.between, reached).all()
    apart = np.linalg.norm(layer.vertices[reached][:, None] - layer.vertices[loaded], axis=2).min(axis=1)
    assert apart.max() < REACH * T + 1e-9


def test_zones_are_those_of_the_nearest_loaded_vertex_though_only_the_rim_is_looked_at(layer: SoftLayer) -> None:
    thinning, loaded = Thinning(layer, Surroundings.of(layer).frames, REACH), np.flatnonzero(pressed(layer).values)
    alone = np.max([thinning._zones(loaded[k : k + 1]) for k in range(len(loaded))], axis=0)
    assert len(loaded) > 20
    assert (thinning._zones(loaded) != alone).sum() <= 0.002 * (alone > 0).sum()


def test_near_the_load_all_are_asked_and_far_from_it_few(layer: SoftLayer, asked: Asked) -> None:
    loaded = layer.vertices[np.flatnonzero(pressed(layer).values)]
    apart = np.linalg.norm(layer.vertices[asked.between][:, None] - loaded, axis=2).min(axis=1)
    assert apart.min() >= ZONES[0] * T
    assert len(asked.vertices) < 0.45 * (len(asked.vertices) + len(asked.between))


def test_on_a_skin_as_coarse_as_the_thinning_all_are_asked() -> None:
    coarse = arm(8e-3)
    assert SPACINGS[0] * T < 5e-3
    assert not len(Surroundings.of(coarse).asked(np.flatnonzero(pressed(coarse, 12e-3).values)).between)


def test_what_is_linear_in_space_is_filled_in_as_it_is(layer: SoftLayer, asked: Asked) -> None:
    """Exact in the tangent plane; out of it by as much as the skin curves away between the corners."""
    np.testing.assert_allclose(asked.weights.sum(axis=1), 1, atol=1e-4)
    out = np.full_like(layer.vertices, np.nan)
    asked.fill(layer.vertices[asked.vertices], out)
    normals = layer.normals[asked.between]
    off = out[asked.between] - layer.vertices[asked.between]
    across = np.abs(np.einsum("ni,ni->n", off, normals))
    along = np.linalg.norm(off - np.einsum("ni,ni->n", off, normals)[:, None] * normals, axis=1)
    assert along.max() < 1e-6 and across.max() < 0.02 * T
    assert np.isnan(out).any(axis=1).sum() == len(out) - len(asked.vertices) - len(asked.between)


def test_each_stands_for_as_many_as_there_are(asked: Asked) -> None:
    assert asked.stand_for.sum() == pytest.approx(len(asked.vertices) + len(asked.between), rel=1e-5)


@pytest.mark.parametrize("t", [6e-3, 7e-3, 12e-3])
@pytest.mark.parametrize("method", [Linear, MomentNet])
def test_answers_are_those_of_asking_everybody(method: type, t: float, monkeypatch: pytest.MonkeyPatch) -> None:
    layer = arm(t=t)
    solver, load = method().prepare(layer), pressed(layer)
    thinned = solver.solve(load).displacement
    monkeypatch.setattr(Thinning, "asked", everybody)
    monkeypatch.setattr(Thinning, "asked_again", everybody)
    whole = solver.solve(load).displacement
    error, peak = np.linalg.norm(thinned - whole, axis=1), np.linalg.norm(whole, axis=1).max()
    assert 0 < error.max() < 0.01 * peak and error.mean() < 5e-4 * peak


@pytest.mark.parametrize("tool", [ball(12), flat(9, 1.5), block_letter("H", 26)], ids=["ball", "punch", "letter"])
def test_under_rigid_tools_thinning_costs_little(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the motion, which lies on the tool; on average over the vertices that feel it, and at the worst one."""
    simulator, pose = Simulator(arm(), MomentNet()), scenes.turn((0, 1, 0), np.pi / 2)
    pose[:3, 3] = 0.04 - 0.3 * T, 0, 0.08
    thinned = simulator.step([Contact(tool, pose)]).displacement
    monkeypatch.setattr(Thinning, "asked", everybody)
    monkeypatch.setattr(Thinning, "asked_again", everybody)
    whole = simulator.step([Contact(tool, pose)]).displacement
    error, size = np.linalg.norm(thinned - whole, axis=1), np.linalg.norm(whole, axis=1)
    assert 0 < error.max() < 0.01 * size.max() and error[size > 1e-3 * size.max()].mean() < 5e-4 * size.max()


def test_no_load_asks_nobody(layer: SoftLayer) -> None:
    asked = Surroundings.of(layer).asked(np.empty(0, np.int64))
    assert not len(asked.vertices) and not len(asked.between)
