"""Laws of tissue that runs to bone: where its columns end, that they do not fold, and that what solves it is exact."""

import numpy as np
import pytest

from bags.provenance import layer_from_bytes, layer_to_bytes
from fem_tools import PatchFem
from stmpl_core import Membrane, Ply, Tissue
from stmpl_core.body import Body
from stmpl_core.bones import Bone, bones_of, to_bone
from stmpl_core.errors import InvalidInput
from stmpl_core.extrusion import fold_ratios
from stmpl_core.layer import layer_id
from stmpl_core.methods import Winkler
from tests.scenes import LENGTH, RADIUS, disc, limb

AXIS = Bone(np.array([0.0, 0, -1]), np.array([0.0, 0, 1]), 0.012)


def test_columns_of_a_round_limb_end_on_its_bone_and_run_along_the_normals():
    layer = to_bone(limb(4e-3), [AXIS])
    np.testing.assert_allclose(np.hypot(*layer.inner_vertices[:, :2].T), 0.012, atol=1e-9)
    np.testing.assert_allclose(layer.thickness, RADIUS - 0.012, rtol=2e-3)


def test_tissue_thinner_than_the_way_to_the_bone_ends_above_it():
    layer = to_bone(limb(4e-3), [AXIS], thickness=6e-3)
    np.testing.assert_allclose(layer.thickness, 6e-3, rtol=1e-9)


@pytest.mark.parametrize("part", ["left_forearm", "left_calf", "left_thigh", "left_arm"])
def test_columns_to_bone_fold_nowhere_on_a_limb_where_normals_fold_on_a_twentieth_and_more(part):
    body = Body.anny()
    layer = to_bone(body.part(part), bones_of(body, part))
    straight = layer.vertices - layer.thickness[:, None] * layer.normals
    assert fold_ratios(layer.vertices, layer.inner_vertices, layer.faces).min() > 0.05
    assert (fold_ratios(layer.vertices, straight, layer.faces) < 0.05).mean() > 0.05
    assert 0.005 < np.median(layer.thickness) < 0.07 and layer.thickness.min() > 0


def test_a_core_straight_below_the_skin_is_a_thickness():
    layer = limb(4e-3)
    other, load = layer.with_(core=layer.inner_vertices), disc(layer, 0.3, (RADIUS, 0, LENGTH / 2), 0.01)
    np.testing.assert_allclose(other.thickness, layer.thickness, rtol=1e-9)
    np.testing.assert_allclose(PatchFem().prepare(other).solve(load).displacement,
                               PatchFem().prepare(layer).solve(load).displacement, atol=1e-12)  # fmt: skip


def test_a_layer_is_packed_with_its_core_and_its_stack():
    tissue = Tissue(3e3, 0.45, skin=Membrane(2e5, 1.5e-3, 20.0, source="a row"),
                    deeper=(Ply(10e-3, 15e3, name="muscle"),))  # fmt: skip
    layer = to_bone(limb(4e-3), [AXIS]).with_(tissue=tissue)
    again = layer_from_bytes(layer_to_bytes(layer))
    assert again.tissue == tissue
    np.testing.assert_array_equal(again.core, layer.core)
    assert layer_id(again) == layer_id(layer) != layer_id(limb(4e-3))


def test_what_cannot_be_is_refused_with_what_is_wrong():
    layer = to_bone(limb(4e-3), [AXIS])
    with pytest.raises(InvalidInput, match="want a core"):
        layer.with_(vertices=layer.vertices + 1e-3)
    with pytest.raises(InvalidInput, match=r"bones of 'torso' are not known.*left_arm"):
        bones_of(Body.anny(), "torso")
    with pytest.raises(InvalidInput, match="core of their own"):
        Winkler().prepare(layer)
    with pytest.raises(InvalidInput, match="one of them"):
        layer.with_(thickness=5e-3, core=layer.core)
