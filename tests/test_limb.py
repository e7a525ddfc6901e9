"""Laws of a limb's linear response: it is linear, as finite elements say, and flags where it is not."""

import numpy as np
import pytest

from fem_tools import PatchFem
from stmpl_core import Load, Membrane, Ply, SoftLayer, Tissue
from stmpl_core.bones import Bone, to_bone
from stmpl_core.errors import MeshError, NotPrepared
from stmpl_core.methods import LimbLinear, MomentNet
from stmpl_core.moments import Surroundings
from stmpl_core.simulator import Simulator
from tests.scenes import disc, limb, plate, wavy_layer

RADIUS, LENGTH = 0.035, 0.26
STACK = Tissue(3e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0), deeper=(Ply(6e-3, 15e3, 0.45),))
BESIDE = Bone(np.array([0.006, 0, -1]), np.array([0.006, 0, 1]), 0.012)  # off the limb's axis


def tissue_on_bone(tissue: Tissue) -> SoftLayer:
    return to_bone(limb(7e-3, 10e-3, RADIUS, LENGTH), [BESIDE]).with_(tissue=tissue)


@pytest.fixture(scope="module")
def method() -> LimbLinear:
    return LimbLinear().prepare(tissue_on_bone(STACK))


def pressed(layer: SoftLayer, side: float, ratio: float) -> Load:
    return disc(layer, ratio, (side * RADIUS, 0, LENGTH / 2), 0.014)


@pytest.mark.parametrize("side", [1, -1])
def test_it_moves_as_finite_elements_do_on_the_thin_and_on_the_thick_side(method, side):
    layer, load = tissue_on_bone(STACK), pressed(tissue_on_bone(STACK), side, 0.02)
    answer, truth = method.solve(load), PatchFem(reach=30, element="P1xP2", layers=1).prepare(layer).solve(load)
    off, moved = np.linalg.norm(answer.displacement - truth.displacement, axis=1), truth.magnitude
    assert answer.trust.in_range and off.max() < answer.trust.error_bound
    assert off[moved > 0.1 * moved.max()].mean() < 0.04 * moved.max()
    flat = SoftLayer(layer.vertices, layer.faces, float(np.median(layer.thickness)), tissue=STACK)
    alone = Surroundings(flat).linear(load.pressure_on(layer) / STACK.youngs_modulus)
    assert np.linalg.norm(alone - truth.displacement, axis=1).max() > 2 * off.max(), "the limb matters here"


def test_it_is_linear_and_nothing_comes_of_nothing(method):
    one, two = (method.solve(pressed(tissue_on_bone(STACK), 1, ratio)).displacement for ratio in (0.01, 0.02))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-4, atol=1e-9)
    assert not method.solve(Load.pressure(np.zeros(len(one)))).displacement.any()


def test_more_than_a_twentieth_of_the_tissue_is_flagged(method):
    answer = method.solve(pressed(tissue_on_bone(STACK), -1, 3.0))
    assert not answer.trust.in_range and "linear response holds to 5%" in answer.trust.why


def test_tissue_thinner_than_the_coarse_mesh_is_flagged():
    thin = to_bone(limb(7e-3, 5e-3, RADIUS, LENGTH), [Bone(BESIDE.start, BESIDE.end, 0.024)])
    answer = LimbLinear().prepare(thin).solve(pressed(thin, 1, 0.01))
    assert not answer.trust.in_range and "edges of the coarse mesh" in answer.trust.why


def test_it_wants_a_layer():
    with pytest.raises(NotPrepared):
        LimbLinear().solve(Load.pressure(np.zeros(3)))


def test_skin_of_triangles_that_are_not_joined_is_refused() -> None:
    loose = limb(8e-3)
    corners = loose.vertices[loose.faces].reshape(-1, 3)
    with pytest.raises(MeshError, match="not joined"):
        SoftLayer(corners, np.arange(len(corners)).reshape(-1, 3), 8e-3)


def test_layered_skin_that_is_all_border_is_refused() -> None:
    rings = limb(0.02, thickness=16e-3, length=0.017).with_(tissue=STACK)
    assert len(rings.border) == len(rings.vertices)
    with pytest.raises(MeshError, match="every vertex of the skin is on its open border"):
        Simulator(rings, MomentNet())


@pytest.mark.parametrize(("skin", "hollow"), [(limb(8e-3), True), (plate(), False), (wavy_layer(), False)])
def test_an_open_skin_that_faces_its_own_hollow_is_told_of(skin: SoftLayer, hollow: bool, caplog) -> None:
    SoftLayer(skin.vertices, skin.faces, 5e-3)
    assert not caplog.records
    SoftLayer(skin.vertices, skin.faces[:, ::-1], 5e-3)
    assert ["faces the hollow" in record.message for record in caplog.records] == [True] * hollow
