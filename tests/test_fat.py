"""Laws of fat and skin that follow a person and a place, and of materials that begin as deep as a vertex says."""

from dataclasses import replace

import numpy as np
import pytest

from bags.wire import layer_from, topology_message
from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.plies import wedge_ends, wedge_materials
from stmpl_core import Load, Membrane, Ply, Simulator, SoftLayer, Tissue
from stmpl_core.body import Body, Physique, mass_index
from stmpl_core.errors import InvalidInput
from stmpl_core.fat import SITES, fat_factor, fat_map, for_person, unmeasured
from stmpl_core.layer import layer_id
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.packed import pack, unpack
from stmpl_core.regions import REGIONS, region
from stmpl_core.sdf import SignedDistance
from stmpl_core.skin import published
from tests.scenes import at, ball, contact_of
from tests.test_remesh import tube
from tests.test_simulator_stack import BALL, HALF, LIMB, RADIUS

COARSE = 8e-3  # m
WOMAN, MAN, HEAVY, LIGHT = (Physique(bmi, 24.0, female) for bmi, female in ((24, 1), (24, 0), (34, 0.5), (19, 0.5)))


@pytest.mark.parametrize("name", REGIONS)
def test_a_heavier_person_and_a_woman_have_thicker_fat(name):
    assert fat_factor(name, LIGHT) < 1 < fat_factor(name, HEAVY) and fat_factor(name, MAN) < 1 < fat_factor(name, WOMAN)
    assert for_person(region(name), None) == region(name)
    low, high = (for_person(region(name), one).fat_thickness for one in (LIGHT, HEAVY))
    assert low.low < low.value < high.value < high.high


@pytest.mark.parametrize(
    "name, per_ten, sexes",
    [("upper_arm", 0.4, 0.5), ("abdomen", 4 / 13.9, 5.1 / 13.9), ("thigh", 4 / 10.4, 5.1 / 10.4)],
)
def test_weight_and_sex_matter_as_much_as_in_388_others(name, per_ten, sexes):
    """Gibney et al. (2010): 4 mm a 10 kg/m2, 5.1 mm between the sexes; twice that is another population."""
    ten = fat_factor(name, Physique(34, 24, 0.5)) - 1
    assert 0.5 * per_ten < ten < 2 * per_ten
    assert 0.5 * sexes < fat_factor(name, WOMAN) / fat_factor(name, MAN) - 1 < 3 * sexes


def test_a_child_and_a_mass_index_that_nobody_had_are_told_of():
    assert not any(unmeasured(one) for one in (None, WOMAN, MAN, HEAVY, LIGHT, Physique(17, 19, 0.5, 1.8)))
    assert "1.23 m tall" in unmeasured(Physique(15.6, 19.4, 0.5, 1.23))
    for heavy in (16.0, 46.0):
        assert f"of {heavy} kg/m2" in unmeasured(Physique(heavy, 24, 1, 1.7))


def test_the_log_tells_of_a_child_whose_limb_is_made(caplog):
    adult = Body.anny()
    living(adult, "left_forearm", edge_length=COARSE)
    assert "measured" not in caplog.text
    child = replace(adult, vertices=0.6 * adult.vertices, physique=Physique(19.4, 19.4, 0.5, 0.98))
    living(child, "left_forearm", edge_length=COARSE)
    assert "of left_forearm may be wrong: the person is 0.98 m tall" in caplog.text


def test_sites_are_ordered_as_measured():
    """More behind the upper arm than before it, more on the palm's side than behind the forearm, most on the thigh."""
    assert SITES["upper_arm"][1].ratio < 0.6 < 1.5 < SITES["forearm"][1].ratio and SITES["calf"][1].ratio < 0.7
    thick = {name: max(site.front.value, site.back.value) for name, (_, site) in SITES.items()}
    assert thick["thigh"] > thick["upper_arm"] > thick["calf"] > thick["forearm"]
    assert region("abdomen").fat_thickness.value > region("thigh").fat_thickness.value > \
        region("calf").fat_thickness.value > region("forearm").fat_thickness.value  # fmt: skip


def test_fat_lies_behind_the_upper_arm_and_on_the_palms_side_of_the_forearm():
    body = Body.anny()
    arm = body.part("left_upper_arm", edge_length=COARSE).vertices
    middle = np.abs(arm[:, 2] - arm[:, 2].mean()) < 0.03
    fat = fat_map(body, "left_upper_arm", arm)
    assert fat is not None
    front, behind = (fat[middle & (side * (arm[:, 0] - arm[middle, 0].mean()) > 0.03)] for side in (1, -1))
    assert behind.mean() > 1.7 * front.mean() and fat.max() == pytest.approx(10.8e-3, rel=0.05)
    for part in ("left_forearm", "right_forearm"):
        skin = body.part(part, edge_length=COARSE)
        fat = fat_map(body, part, skin.vertices)
        assert fat is not None
        wrist = skin.vertices[:, 2] < np.percentile(skin.vertices[:, 2], 30)
        palm, other = (fat[wrist & (way * skin.normals[:, 2] > 0.6)] for way in (-1, 1))  # palms face down
        assert palm.mean() > 1.2 * other.mean()
    left, right = (fat_map(body, f"{side}_arm", points * [1, sign, 1])
                   for side, sign in (("left", 1), ("right", -1)) for points in [arm])  # fmt: skip
    assert left is not None and right is not None
    np.testing.assert_allclose(left, right, rtol=0.02)
    assert fat_map(body, "torso", arm) is None


def test_the_body_mass_index_of_the_model_is_a_persons_and_grows_with_its_weight():
    body = Body.anny()
    assert 17 < mass_index(body.vertices, body.faces) < 25
    pytest.importorskip("anny")
    heavy, woman = Body.anny(weight=1.0), Body.anny(gender=1.0)
    assert heavy.physique and woman.physique and heavy.physique.heavier > 1 and woman.physique.female == 1
    bent = Body.anny(weight=1.0, pose={"lowerarm01.L": [0, -0.6, 0]})
    assert bent.physique == heavy.physique


def test_a_heavy_womans_arm_has_more_fat_than_a_light_mans():
    pytest.importorskip("anny")
    woman, man = (living(Body.anny(weight=w, gender=w), "left_upper_arm", edge_length=COARSE) for w in (1.0, 0.0))
    fat = [one.tissue.deeper[0].depth * one.ply_scale for one in (woman, man) if one.ply_scale is not None]
    assert np.median(fat[0]) > 1.8 * np.median(fat[1]) and 2e-3 < fat[1].min() < fat[0].max() < 25e-3  # m; MULTIS
    trunk = [living(Body.anny(weight=w, gender=w), "torso", edge_length=2e-2).tissue for w in (1.0, 0.0)]
    assert trunk[0].deeper[0].depth > 1.5 * trunk[1].deeper[0].depth


STACK = Tissue(3e3, 0.4, skin=Membrane(1e5, 1e-3, 5.0), deeper=(Ply(5e-3, 3e4, 0.4),))


def stacked(scale) -> SoftLayer:
    vertices, faces, _ = tube(30, 24)
    return SoftLayer(vertices, faces, 15e-3, tissue=STACK, ply_scale=np.full(len(vertices), 1.0) * scale)


def test_a_factor_everywhere_is_a_stack_of_other_depths():
    doubled = stacked(2.0)
    other = doubled.with_(ply_scale=None, deeper=(Ply(10e-3, 3e4, 0.4),))
    near = np.linalg.norm(doubled.vertices - doubled.vertices[400], axis=1)
    load = Load.pressure(600 * np.exp(-((near / 8e-3) ** 2)))
    one, two = (PatchFem().prepare(layer).solve(load).displacement for layer in (doubled, other))
    np.testing.assert_allclose(one, two, atol=1e-9)
    plain = PatchFem().prepare(stacked(1.0)).solve(load).displacement
    assert np.abs(one).max() > 1.1 * np.abs(plain).max()


def test_every_wedge_is_made_of_what_lies_at_its_depth():
    length, scale = np.full(3, 15e-3), np.array([0.5, 1.0, 4.0])
    ends = wedge_ends(STACK, length, 1, scale)
    np.testing.assert_allclose(ends[:2, 1] * length[:2], [2.5e-3, 5e-3])
    assert ends[2, 1] > 0.98  # fat to the core
    layer = stacked(np.linspace(0.5, 1.5, len(stacked(1.0).vertices)))
    patch = PatchFem(layers=1).prepare(layer).patch_around(np.array([400]))
    soft, stiff = np.unique(wedge_materials(patch.mesh, layer.tissue)[0])
    assert stiff == pytest.approx(10 * soft)


def test_a_factor_travels_with_the_layer():
    layer = published(stacked(np.linspace(0.5, 1.5, len(stacked(1.0).vertices))))
    for back in (unpack(pack(layer)), layer_from(topology_message(layer, "body", 0)), layer.with_(thickness=15e-3)):
        np.testing.assert_array_equal(back.ply_scale, layer.ply_scale)
        assert layer_id(back) == layer_id(layer)
    assert layer_id(stacked(1.2)) != layer_id(stacked(1.0))
    with pytest.raises(InvalidInput, match="ply_scale is -1"):
        stacked(-1.0)


def test_the_fast_answer_feels_where_the_fat_is_thin():
    """Finite elements and the answer on a limb with half the fat on one side; the even limb is far from both."""
    thin = 1 + 0.5 * LIMB.vertices[:, 0] / RADIUS  # half of it where the ball presses, at -x
    depth, truth, fast = 5e-3, [], []
    for layer in (LIMB.with_(ply_scale=thin), LIMB):
        field = SignedDistance.of(ball(BALL), margin=0.03)
        start = Press(field, at(-RADIUS - BALL - 5e-3, 0, HALF), np.array([1.0, 0, 0])).touching(layer)
        assert start is not None
        fem = IndenterFem(PatchFem(element="P1xP2", reach=10, refine=3, layers=1), step=0.15).prepare(layer)
        (pressed,) = fem.path([start], [depth])
        truth.append(pressed.force)
        contact = contact_of(ball(BALL), start.at(depth).pose_body_from_tool)
        fast.append(Simulator(layer, MomentNet()).touch([contact])[0].force)
    assert truth[0] > 1.15 * truth[1]
    assert fast == pytest.approx(truth, rel=0.15)
    assert fast[0] / fast[1] - 1 > 0.75 * (truth[0] / truth[1] - 1), "more than the half that the coarse elements see"
