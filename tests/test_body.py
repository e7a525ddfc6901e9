"""Laws of bodies: the frame, the parts, the same part in other poses, and layers that do not fold."""

import logging
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stmpl_core import Contact, Simulator, anny_model, limbs
from stmpl_core.body import PARTS, Body, Patch
from stmpl_core.errors import InvalidInput
from stmpl_core.extrusion import fold_ratios, foldfree_thickness
from stmpl_core.layer import SoftLayer
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.trunk import TRUNK
from tests.scenes import at, ball
from tests.test_remesh import smallest_angle, tube

EDGE = 4e-3


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.anny()


@pytest.fixture(scope="module")
def patch(body: Body) -> Patch:
    return body.patch("left_arm", EDGE)


@pytest.fixture(scope="module")
def arm(body: Body, patch: Patch) -> SoftLayer:
    return patch.layer(body)


def folds(layer: SoftLayer) -> np.ndarray:
    return fold_ratios(layer.vertices, layer.inner_vertices, layer.faces)


def test_the_body_stands_upright_looks_forward_and_is_as_tall_as_a_person(body: Body) -> None:
    assert 1.5 < np.ptp(body.vertices[:, 2]) < 1.9
    centre = {part: body.vertices[body.level(part) > 0].mean(axis=0) for part in ("left_arm", "right_arm", "left_calf")}
    assert centre["left_arm"][1] > 0.1 and centre["right_arm"][1] < -0.1
    assert centre["left_calf"][2] < centre["left_arm"][2] - 0.5
    toes = body.weights[:, [k for k, bone in enumerate(body.bones) if bone.startswith("toe")]].sum(axis=1) > 0.5
    assert body.vertices[toes, 0].mean() > centre["left_calf"][0] + 0.1


def test_bone_weights_sum_to_one_and_faces_look_outward(body: Body) -> None:
    assert np.abs(body.weights.sum(axis=1) - 1).max() < 1e-9
    corners = body.vertices[body.faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert 0.03 < volume < 0.12  # m3: a person's


def test_the_arm_is_even_in_range_of_the_asked_edge_and_close_to_the_model(arm: SoftLayer, patch: Patch) -> None:
    lengths = np.linalg.norm(np.diff(arm.vertices[arm.edges], axis=1)[:, 0], axis=1) / EDGE
    assert np.median(lengths) == pytest.approx(1, abs=0.05)
    assert 0.6 < np.percentile(lengths, 5) and np.percentile(lengths, 95) < 1.5
    assert smallest_angle(patch.mesh) > 15
    inner = np.setdiff1d(np.arange(len(arm.vertices)), arm.border)
    smallest, low, high, largest = np.percentile(arm.vertex_areas[inner], [0, 0.1, 99.9, 100])
    assert high / low < 6 and largest / smallest < 15
    assert patch.mesh.distance.mean() < 0.5e-3 and patch.mesh.distance.max() < 3e-3
    assert arm.vertex_areas.sum() == pytest.approx(0.1128, rel=0.01)  # m2


def test_the_arm_has_two_ends_and_is_one_piece(arm: SoftLayer) -> None:
    edges = len(arm.edges)
    assert len(arm.vertices) - edges + len(arm.faces) == 0  # Euler characteristic of a tube
    assert np.einsum("ij,ij->i", arm.normals, arm.vertex_area_vectors).min() > 0


def test_a_thickness_that_most_of_a_limb_does_not_bear_is_refused_with_one_that_it_does(body: Body) -> None:
    with pytest.raises(InvalidInput, match=r"a layer 90.0 mm thick would fold: 100% of this skin .* Try 1\d\.\d mm"):
        body.part("left_forearm", edge_length=7.5e-3, thickness=0.09)
    assert body.part("left_forearm", edge_length=7.5e-3, thickness=0.018).thickness.max() == 0.018


@pytest.mark.parametrize("thickness", [5e-3, 7.5e-3, 10e-3, 12.5e-3])
def test_no_layer_folds(body: Body, patch: Patch, thickness: float) -> None:
    layer = patch.layer(body, thickness=thickness)
    assert folds(layer).min() >= 0.15
    assert layer.thickness.max() == thickness and layer.thickness.min() > 0.5 * min(thickness, 10e-3)


def test_thinning_says_where_and_touches_nothing_else(arm: SoftLayer, caplog: pytest.LogCaptureFixture) -> None:
    thick = arm.with_(thickness=12.5e-3)
    assert folds(thick).min() < 0
    with caplog.at_level(logging.WARNING):
        thinned = foldfree_thickness(thick)
    assert "thinned at" in caplog.text and "mm" in caplog.text
    assert (thinned < 12.5e-3).mean() < 0.1
    assert np.array_equal(foldfree_thickness(arm.with_(thickness=3e-3)), np.full(len(arm.vertices), 3e-3))


def test_a_flat_layer_never_folds_and_a_tube_folds_at_its_radius() -> None:
    vertices, faces, _ = tube(60, 40)
    assert folds(SoftLayer(vertices, faces, 0.03)).min() > 0.1
    assert folds(SoftLayer(vertices, faces, 0.045)).min() < 0


def test_the_chart_fits_the_arm_and_both_sides_of_its_seam_agree(arm: SoftLayer) -> None:
    chart = arm.chart
    assert chart.mask.mean() > 0.5 and max(chart.shape) == 512
    smooth = np.sin(20 * arm.vertices)
    image = chart.to_texels(smooth)
    error = np.abs(chart.to_vertices(image) - smooth).max(axis=1)
    assert np.percentile(error, 99.9) < 0.01 and error.max() < 0.05  # the worst are needles in UV, at the elbow
    assert len(chart.seam_vertices) > 50 and np.median(chart.seam_gap(image)) < 1e-3
    assert 0.5 < chart.mm_per_texel[1] < 2 and chart.mm_per_texel[2] < 5


@pytest.mark.parametrize("part", ["left_arm", "right_forearm"])
def test_a_shipped_limb_is_the_one_that_the_remesher_makes(body: Body, part: str) -> None:
    made = body.patch(part, limbs.EDGE_LENGTH).layer(body, thickness=12.5e-3)
    shipped = body.part(part, thickness=12.5e-3)
    if len(made.vertices) == len(shipped.vertices):
        assert np.array_equal(made.faces, shipped.faces)
        assert np.allclose(made.vertices, shipped.vertices, rtol=0, atol=1e-9)
        assert np.allclose(made.thickness, shipped.thickness, rtol=0, atol=1e-9)
        assert np.allclose(made.chart.uv, shipped.chart.uv, rtol=0, atol=1e-9)
    else:  # on another processor MMG may split an edge less or more
        assert len(made.vertices) == pytest.approx(len(shipped.vertices), rel=0.01)
        assert made.vertex_areas.sum() == pytest.approx(shipped.vertex_areas.sum(), rel=1e-3)


def test_the_shipped_body_is_annys_average(body: Body) -> None:
    pytest.importorskip("anny")
    vertices, faces, uv, weights, bones = anny_model.build({}, {})
    assert np.allclose(vertices, body.vertices, rtol=0, atol=1e-9)
    same = (faces == body.faces).all(axis=1)  # quads with two equal diagonals are split by the last bit
    assert same.mean() > 0.98 and np.array_equal(np.unique(faces), np.unique(body.faces))
    assert body.uv is not None and np.array_equal(uv[same], body.uv[same])
    assert np.allclose(weights, body.weights, rtol=0, atol=1e-12) and bones == body.bones
    assert Body.anny(weight=0.5, age=0.5) is body


def test_every_limb_ships_and_packing_is_exact(
    body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert {path.stem for path in limbs.FOLDER.glob("*.npz")} == {limbs.BODY, *PARTS}
    assert body.parts == (*PARTS, *TRUNK)
    mesh = limbs.part("left_forearm", limbs.EDGE_LENGTH)
    assert mesh is not None and limbs.part("left_forearm", 4e-3) is None
    limbs.write_part(tmp_path, "left_forearm", mesh)
    monkeypatch.setattr(limbs, "FOLDER", tmp_path)
    again = limbs.part("left_forearm", limbs.EDGE_LENGTH)
    assert again is not None and all(map(np.array_equal, mesh, again))
    assert 5700 < len(mesh[0]) < 5900 and (np.unique(mesh[1]) == np.arange(len(mesh[0]))).all()


def test_a_shipped_limb_needs_neither_remesher_nor_anny() -> None:
    code = ("import sys; sys.modules.update(dict.fromkeys(['anny', 'torch', 'mmgpy', 'igl', 'roma']))\n"
            "from stmpl_core.body import Body; print(len(Body.anny().part('left_arm').vertices))")
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(said.stdout) > 14000


def test_without_anny_another_body_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stmpl_core.extras.find_spec", lambda package: None)
    with pytest.raises(InvalidInput, match=r"needs anny and roma and torch: pip install 'stmpl\[bodies\]'"):
        Body.anny(weight=0.7)


def test_another_pose_keeps_the_mesh_and_bends_the_arm(patch: Patch, arm: SoftLayer) -> None:
    pytest.importorskip("anny")
    bent = patch.layer(Body.anny(pose={"lowerarm01.L": [0, -0.6, 0]}))
    assert np.array_equal(bent.faces, arm.faces)
    assert np.allclose(bent.chart.uv, arm.chart.uv)
    moved = np.linalg.norm(bent.vertices - arm.vertices, axis=1)
    hand, shoulder = np.argsort(arm.vertices[:, 2])[[0, -1]]
    assert moved[hand] > 0.05 and moved[shoulder] < 1e-3
    assert bent.vertex_areas.sum() == pytest.approx(arm.vertex_areas.sum(), rel=0.03)


def test_turning_the_arm_turns_the_part_about_the_asked_axis(body: Body) -> None:
    pytest.importorskip("anny")
    turned = Body.anny(pose={"root": [0, 0, np.pi / 2]})
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shift = turned.vertices - body.vertices @ quarter.T
    assert np.ptp(shift, axis=0).max() < 1e-6


def test_weight_makes_the_arm_thicker(patch: Patch) -> None:
    pytest.importorskip("anny")
    light, heavy = (patch.layer(Body.anny(weight=w)).vertex_areas.sum() for w in (0.0, 1.0))
    assert heavy > 1.1 * light


def test_a_body_read_from_the_disk_is_the_one_that_was_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("anny")
    monkeypatch.setenv("STMPL_CACHE_DIR", str(tmp_path))
    built = Body.anny(muscle=0.8)
    assert len(list(tmp_path.glob("*.npz"))) == 1
    monkeypatch.setattr(anny_model, "_model", lambda: pytest.fail("built anew"))
    kept = Body.anny(muscle=0.8)
    for name in ("vertices", "faces", "uv", "weights", "bones"):
        assert np.array_equal(getattr(built, name), getattr(kept, name))
    next(tmp_path.iterdir()).write_bytes(b"broken")
    with pytest.raises(pytest.fail.Exception, match="built anew"):
        Body.anny(muscle=0.8)


def test_other_parts_are_limbs_too(body: Body) -> None:
    calf = body.part("left_calf", edge_length=6e-3)
    assert calf.border.size and calf.chart is not None
    assert calf.vertices[:, 2].max() < body.vertices[:, 2].min() + 0.7


def test_what_is_unknown_is_refused_and_what_exists_is_listed(body: Body) -> None:
    with pytest.raises(InvalidInput, match=r"unknown part 'left_wing'. Available: left_arm, .*torso"):
        body.part("left_wing")
    with pytest.raises(InvalidInput, match=r"unknown phenotype: mass. Available: .*weight"):
        Body.anny(mass=0.5)
    with pytest.raises(InvalidInput, match=r"unknown bone: elbow. Available: .*lowerarm01.L"):
        Body.anny(pose={"elbow": [0, 0, 1]})
    with pytest.raises(InvalidInput, match=r"weight is 80; allowed is a number from 0 to 1"):
        Body.anny(weight=80)
    with pytest.raises(InvalidInput, match="not finite"):
        Body.anny(pose={"lowerarm01.L": [0, np.nan, 1]})


def smpl_file(folder: Path) -> Path:
    """A made-up SMPL model with the file layout of the real one: a ball whose +x side is the left arm."""
    rings, around = 82, 84  # 6,890 vertices, as smplx wants
    z, turn = np.meshgrid(np.linspace(-0.999, 0.999, rings), np.arange(around) * 2 * np.pi / around, indexing="ij")
    vertices = np.column_stack([(np.sqrt(1 - z**2) * f).ravel() for f in (np.cos(turn), np.sin(turn))] + [z.ravel()])
    vertices = np.concatenate([0.8 * vertices, np.zeros((2, 3))])
    grid = np.arange(rings * around).reshape(rings, around)
    a, b, c, d = grid[:-1], np.roll(grid, -1, 1)[:-1], np.roll(grid, -1, 1)[1:], grid[1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    weights = np.zeros((6890, 24))
    weights[:, 16] = np.clip(0.5 + 5 * (vertices[:, 0] - 0.5), 0, 1)  # left_shoulder
    weights[:, 0] = 1 - weights[:, 16]
    regressor = np.zeros((24, 6890))
    regressor[:, ::7] = 1 / len(range(0, 6890, 7))
    parents = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
    shape = np.zeros((6890, 3, 10))
    shape[:, :, 0] = 0.1 * vertices  # the first coefficient scales the ball
    model = {"v_template": vertices, "f": faces.astype(np.uint32), "weights": weights, "J_regressor": regressor,
             "kintree_table": np.stack([parents, np.arange(24)]), "shapedirs": shape,
             "posedirs": np.zeros((6890, 3, 207))}
    path = folder / "SMPL_NEUTRAL.pkl"
    path.write_bytes(pickle.dumps(model))
    return path


def test_a_model_file_in_smpls_layout_becomes_a_body_in_our_frame(tmp_path: Path) -> None:
    pytest.importorskip("smplx", reason="smplx has a licence of its own: pip install stmpl[smpl]")
    path = smpl_file(tmp_path)
    body, larger = Body.smpl(path), Body.smpl(path, betas=[1.0])
    assert body.bones[16] == "left_shoulder" and "left_arm" in body.parts and body.uv is None
    assert np.abs(larger.vertices - 1.1 * body.vertices).max() < 1e-5
    arm = body.part("left_arm", edge_length=0.02, thickness=0.02)
    assert arm.vertices[:, 1].min() == pytest.approx(0.5, abs=0.02)  # SMPL's +x is our +y, and it is cut at one half
    assert arm.chart is None
    raised = Body.smpl(path, pose=np.eye(69)[15 * 3 + 2] * np.pi / 2)  # the left shoulder, about SMPL's +z
    assert raised.vertices[:, 2].max() > body.vertices[:, 2].max() - 0.01


def test_a_missing_or_unreadable_smpl_file_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("smplx", reason="smplx has a licence of its own: pip install stmpl[smpl]")
    with pytest.raises(InvalidInput, match="there is no SMPL model at"):
        Body.smpl(tmp_path / "SMPL_NEUTRAL.pkl")
    (tmp_path / "SMPL_NEUTRAL.pkl").write_bytes(b"not a pickle")
    with pytest.raises(InvalidInput, match="smplx cannot make a smpl body of"):
        Body.smpl(tmp_path / "SMPL_NEUTRAL.pkl")
    with pytest.raises(InvalidInput, match="available: smpl, smplh, smplx"):
        Body.smpl(tmp_path / "SMPL_NEUTRAL.pkl", model_type="star")


PICKED = {"back": (-0.09, 0.06, 0.33), "shoulder": (0.02, 0.24, 0.42), "abdomen": (0.13, 0.04, 0.17)}


@pytest.mark.parametrize("place", PICKED.values(), ids=PICKED)
def test_a_picked_place_is_answered_as_on_a_wider_piece_of_the_same_body(body, place):
    narrow, wide = (body.around(place, radius, edge_length=EDGE) for radius in (0.07, 0.1))
    vertex = int(np.linalg.norm(narrow.vertices - place, axis=1).argmin())
    for layer, radius in ((narrow, 0.07), (wide, 0.1)):
        assert 0.8 * np.pi * radius**2 < layer.vertex_areas.sum() < 1.05 * np.pi * radius**2
    pose = at(*(narrow.vertices[vertex] + 0.010 * narrow.normals[vertex]))  # a ball of 12 mm, 2 mm deep
    one, other = (Simulator(layer, MomentNet()).step([Contact(ball(), pose)]) for layer in (narrow, wide))
    assert one.touches["probe"].force == pytest.approx(other.touches["probe"].force, rel=0.02)
    assert np.abs(one.displacement).max() == pytest.approx(np.abs(other.displacement).max(), rel=0.08)
    assert one.trust.in_range


def test_a_place_that_is_none_is_refused(body):
    with pytest.raises(InvalidInput, match=r"mm from the skin; allowed are 30 mm"):
        body.around((0.0, 0.0, 2.0))
    with pytest.raises(InvalidInput, match="is no picked part, as in"):
        body.part("around:1,2")
    with pytest.raises(InvalidInput, match="at least two edges"):
        body.around((0.13, 0.04, 0.17), 1e-3)
    with pytest.raises(InvalidInput, match=r"radius is 80 m.*at most 1 m.*millimetres"):
        body.around((0.13, 0.04, 0.17), 80)
    with pytest.raises(InvalidInput, match="radius is 'wide'; a finite number"):
        body.around((0.13, 0.04, 0.17), "wide")
    for ask in (body.part, lambda part: living(body, part)):  # between the vertices, which are further apart
        with pytest.raises(InvalidInput, match=r"no vertex of the body is within the radius of 'around:.*Try a larger"):
            ask("around:-0.09,0.06,0.33,0.005")
