"""Laws of tissue that runs to bone: where its columns end, that they do not fold, and that what solves it is exact."""

import numpy as np
import pytest

from bags.provenance import layer_from_bytes, layer_to_bytes
from bags.wire import layer_from, topology_message
from fem_tools import PatchFem
from stmpl_core import Membrane, Ply, Tissue
from stmpl_core.body import Body
from stmpl_core.bones import Bone, bones_of, to_bone
from stmpl_core.errors import InvalidInput
from stmpl_core.extrusion import fold_ratios
from stmpl_core.layer import layer_id
from stmpl_core.living import living
from stmpl_core.methods import MomentNet, Winkler
from stmpl_core.moments import Surroundings
from stmpl_core.packed import pack, unpack
from stmpl_core.simulator import Simulator
from tests.scenes import LENGTH, RADIUS, ball, contact_of, disc, limb

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
    out = layer.vertices + 5e-3 * layer.normals
    with pytest.raises(InvalidInput, match=r"core lies outside of the skin under 1e\+02 % of it, first at vertex 0"):
        layer.with_(core=out)


@pytest.mark.parametrize(("part", "bony", "soft"), [
    ("left_leg", [(0.088, 0.134, -0.386), (0.048, 0.121, -0.55)], [(0.1, 0.1, -0.2), (-0.06, 0.15, -0.52)]),
    ("right_leg", [(0.088, -0.134, -0.386), (0.048, -0.121, -0.55)], [(0.1, -0.1, -0.2), (-0.06, -0.15, -0.52)]),
    ("left_arm", [(-0.013, 0.34, 0.235)], [(0.05, 0.3, 0.25), (0.1, 0.4, 0.2)]),
])  # fmt: skip
def test_kneecap_shin_and_tip_of_the_elbow_are_told_of_and_flesh_is_not(part, bony, soft):
    """Forty millimetres of tissue over a kneecap, seventeen over the tip of an elbow, are not people's."""
    layer = living(Body.anny(), part, edge_length=8e-3)
    sound = Surroundings.of(layer).sound

    def told(place) -> bool:
        distance = np.linalg.norm(layer.vertices - place, axis=1)
        near = np.flatnonzero(distance < distance.min() + 0.012)
        return any("right under the skin" in why for why in sound.of_contact(near, np.ones(len(near))))

    assert [told(place) for place in bony + soft] == [True] * len(bony) + [False] * len(soft)
    assert 0.01 < layer.bony.mean() < 0.12


def test_a_press_on_a_shin_is_flagged_and_one_on_the_calf_is_not():
    layer = living(Body.anny(), "left_calf", edge_length=8e-3)
    simulator = Simulator(layer, MomentNet())
    for place, sound in (((0.048, 0.121, -0.55), False), ((-0.06, 0.15, -0.52), True)):
        v = int(np.linalg.norm(layer.vertices - place, axis=1).argmin())
        pose = np.eye(4)
        pose[:3, 3] = layer.vertices[v] + (0.012 - 0.1 * layer.thickness[v]) * layer.normals[v]
        (touch,) = simulator.touch([contact_of(ball(0.012), pose)])
        assert touch.trust.in_range == sound and ("right under the skin" in touch.trust.why) != sound


def test_what_is_bony_travels_with_the_layer():
    layer = living(Body.anny(), "left_calf", edge_length=12e-3)
    for back in (unpack(pack(layer)), layer_from(topology_message(layer, "body", 0)), layer.with_(density=1.0)):
        np.testing.assert_array_equal(back.bony, layer.bony)
    assert layer_id(unpack(pack(layer))) == layer_id(layer) != layer_id(layer.with_(bony=None))
    with pytest.raises(InvalidInput, match="bony has shape"):
        layer.with_(bony=[True])
