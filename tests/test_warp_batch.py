"""WarpBatch on Warp's CPU device, the source that also runs on a GPU: what it answers is Batch's answer."""

from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from stmpl_core import Membrane, Ply, SoftLayer, Tissue, Tool
from stmpl_core.batch import Batch, BatchTouches
from stmpl_core.body import Body
from stmpl_core.bones import Bone, to_bone
from stmpl_core.errors import InvalidInput
from stmpl_core.living import living
from stmpl_core.methods import LimbLinear, MomentNet, Winkler
from stmpl_core.skin import Skin
from tests.scenes import (
    LENGTH,
    RADIUS,
    at,
    ball,
    band,
    box,
    brush,
    capsule,
    limb,
    plate,
    punch,
    tool,
    turn,
    v_block,
    wire,
)
from tests.test_folds import FINGERS, LAYERED

wp = pytest.importorskip("warp")
wp.config.quiet = True

from stmpl_core.gpu.warp_batch import STATUSES, WarpBatch, WarpTouches  # noqa: E402

N, THICK, LONG = 64, 0.02, 0.3  # scenes; radius and length of a limb with layers [m]
LEFT, RIGHT = ball(0.012).named("left"), ball(0.009).named("right")
LUMP = trimesh.creation.icosphere(3, 0.01)
LUMP.vertices = LUMP.vertices * [1, 0.6, 1.5] + 1e-3 * np.sin(900 * LUMP.vertices[:, [1, 2, 0]])


@pytest.fixture(scope="module")
def arm() -> Skin:
    return Skin.of(Body.anny().part("left_arm", edge_length=6e-3), MomentNet(sticks=False))


@pytest.fixture(scope="module")
def cylinder() -> Skin:
    return Skin.of(limb(5e-3, youngs_modulus=5e3, poisson_ratio=0.35), MomentNet(sticks=False))


@pytest.fixture(scope="module")
def layered() -> Skin:
    """Skin, fat and muscle on a bone that lies off the limb's axis."""
    tissue = Tissue(3e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0), deeper=(Ply(6e-3, 15e3, 0.45),))
    bone = Bone(np.array([0.003, 0, -1]), np.array([0.003, 0, 1]), 0.006)
    return Skin.of(to_bone(limb(8e-3, 8e-3, THICK, LONG), [bone]).with_(tissue=tissue), MomentNet())


@pytest.fixture(scope="module")
def oval(layered: Skin) -> Skin:
    """The same, oval: no two normals of it are at right angles to the last bit, beyond which skin feels nothing."""
    layer = layered.layer
    oval = SoftLayer(layer.vertices * [1.07, 0.98, 1], layer.faces, 8e-3)
    bone = Bone(np.array([0.003, 0, -1]), np.array([0.003, 0, 1]), 0.006)
    return Skin.of(to_bone(oval, [bone]).with_(tissue=layer.tissue), MomentNet())


def scattered(skin: Skin, reach: float, n: int = N, deepest: float = 0.8, seed: int = 0) -> np.ndarray:
    """A tool that reaches so far from its origin [m] over an arm: apart, at first touch, pressed; turned anyhow."""
    rng, out = np.random.default_rng(seed), np.tile(np.eye(4), (n, 1, 1, 1))
    layer, inside = skin.layer, np.flatnonzero(skin.near.sound.border > 1.0)
    for i in range(n):
        v = rng.choice(inside)
        depth = layer.thickness[v] * (rng.uniform(0, 0.02) if i % 5 == 0 else rng.uniform(-0.2, deepest))
        out[i, 0, :3, :3] = Rotation.random(random_state=i).as_matrix()
        out[i, 0, :3, 3] = layer.vertices[v] + (reach - depth) * layer.normals[v]
    return out


def pairs(n: int = 6) -> np.ndarray:
    """Two balls in each scene, on either side of a cylinder or side by side, (n, 2, 4, 4)."""
    rng, out = np.random.default_rng(0), np.empty((n, 2, 4, 4))
    for i in range(n):
        x = RADIUS + 0.012 - 1e-3 - 2e-3 * rng.random()
        out[i, 0] = at(x, 0.0, LENGTH / 2 + 0.02 * rng.random())
        out[i, 1] = at(x - 3e-3, 0.0, LENGTH / 2 - 0.015) if i % 2 else at(-x + 3e-3, 0.0, LENGTH / 2)
    return out


def sevens(poses: np.ndarray) -> np.ndarray:
    """Matrices (n, K, 4, 4) as places and quaternions, (n, K, 7)."""
    turns = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*poses.shape[:2], 4)
    return np.concatenate([poses[..., :3, 3], turns], axis=2)


def made(skin: Any, tools: Any, n: int | None = None, **more: Any) -> WarpBatch:
    return WarpBatch(skin, tools, n, device="cpu", **more)


def same(found: WarpTouches, expected: BatchTouches, least_served: float = 1.0) -> None:
    """Whether both say the same: to 1e-4 of the peak where served, and nothing where not."""
    served = found.served
    assert served.mean() >= least_served
    forces, wrenches = expected.wrenches[..., :3], found.wrenches.numpy()
    peak = np.linalg.norm(forces, axis=2)[served].max()
    off = wrenches - expected.wrenches
    assert np.abs(off[served, :3]).max() < 1e-4 * peak
    assert np.abs(off[served, 3:]).max() < 1e-4 * peak * 0.01  # times a centimetre
    assert np.isnan(wrenches[~served]).all()
    assert np.allclose(found.depths.numpy()[served], expected.depths[served], rtol=0, atol=1e-8, equal_nan=True)
    bounds = found.force_bounds.numpy() - expected.force_bounds  # they know the power to a hundredth
    assert np.abs(bounds)[served].max() < 1e-3 * peak
    assert np.array_equal(found.in_range.numpy()[served], expected.in_range[served])
    assert np.array_equal(np.array(STATUSES)[found.statuses.numpy()][served], expected.statuses[served])


@pytest.mark.parametrize(
    ("one", "reach"),
    [(ball(0.012), 0.012), (capsule(0.03, 0.008), 0.012), (punch(), 0.012), (box(0.03, 0.02, 1e-3), 0.01),
     (tool(LUMP), 0.009), (brush(), 0.009), (wire(0.008, 1.5e-3), 0.009)],
    ids=["ball", "capsule", "punch", "thin plate", "lump", "brush", "wire"],
)  # fmt: skip
def test_touches_are_those_of_numba(arm: Skin, one: Tool, reach: float) -> None:
    poses = scattered(arm, reach)
    found, expected = made(arm, [one], N).touch(poses), Batch(arm, [one], N).touch(poses)
    assert {"apart", "pressed by pose"} <= set(expected.statuses.ravel())
    same(found, expected, 0.5)
    deep = ~found.served
    assert (np.array(STATUSES)[found.statuses.numpy()][deep] == "too deep").all() and not expected.in_range[deep].any()


@pytest.mark.parametrize("on_layers", [False, True])
def test_a_thin_sheet_that_leans_is_found_between_vertices_here_too(layered: Skin, on_layers: bool) -> None:
    skin = layered if on_layers else Skin.of(limb(16e-3, 0.012, THICK, LONG), MomentNet(sticks=False))
    sheet, poses = box(0.01, 0.006, 3e-4), np.tile(turn((0, 1, 0), np.pi / 2 - 0.8), (4, 1, 1, 1))
    tip = float((sheet.vertices @ poses[0, 0, 0, :3]).min())
    for pose, depth in zip(poses[:, 0], (1e-3, 2e-3, 3e-3, 4e-3), strict=True):
        pose[:3, 3] = THICK - depth - tip, 0.0, LONG / 2
    same(made(skin, [sheet], 4).touch(poses), Batch(skin, [sheet], 4, threads=1).touch(poses))


def test_a_tool_around_the_limb_lies_on_several_charts(cylinder: Skin) -> None:
    poses = at(0.0, 2e-4, LENGTH / 2)[None, None]
    same(made(cylinder, [band()], 1).touch(poses), Batch(cylinder, [band()], 1).touch(poses))


@pytest.mark.parametrize(("opening", "sound"), [(60, False), (120, False), (150, True)])
def test_a_tool_that_presses_from_several_sides_is_flagged_here_too(cylinder: Skin, opening: float, sound: bool):
    poses = at(RADIUS / np.sin(np.radians(opening / 2)) - 1.5e-3, 0, LENGTH / 2)[None, None]
    found = made(cylinder, [v_block(opening)], 1).touch(poses)
    same(found, Batch(cylinder, [v_block(opening)], 1).touch(poses))
    assert found.in_range.numpy().all() == sound


@pytest.mark.parametrize(("thickness", "sound"), [(8e-3, True), (0.0115, False)])
def test_skin_that_is_round_like_a_ball_is_doubted_here_too(thickness: float, sound: bool) -> None:
    mesh = trimesh.creation.icosphere(4, 0.05)
    skin = Skin.of(SoftLayer(mesh.vertices, mesh.faces, thickness), MomentNet(sticks=False))
    poses = at(0.05 + 0.012 - 0.4 * thickness, 0, 0)[None, None]
    found = made(skin, [LEFT], 1).touch(poses)
    same(found, Batch(skin, [LEFT], 1).touch(poses))
    assert found.in_range.numpy().all() == sound


def test_a_stack_that_is_a_flat_plate_is_doubted_here_too() -> None:
    stack = Tissue(2.5e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0), deeper=(Ply(2e-3, 24e3, 0.45),))
    skin = Skin.of(plate(0.16, 8e-3, 0.025).with_(tissue=stack), MomentNet(sticks=False))
    poses = np.stack([at(0.0, 0.0, 0.012 - depth)[None] for depth in (5e-3, 0.01, 0.015)])
    found, expected = made(skin, [LEFT], 3).touch(poses), Batch(skin, [LEFT], 3, threads=1).touch(poses)
    same(found, expected)
    bounds = expected.force_bounds[:, 0] / np.linalg.norm(expected.wrenches[:, 0, :3], axis=1)
    assert bounds[2] > 1.5 * bounds[0]


@pytest.mark.parametrize("tissue", [
    Tissue(1e3, 0.45, deeper=(Ply(0.012, 80e3, 0.45),)), Tissue(3e3, 0.45, deeper=(Ply(6e-3, 15e3, 0.36),)),
    Tissue(3e3, 0.45, skin=Membrane(1e5, 1.2e-3, 90.0), deeper=(Ply(6e-3, 15e3, 0.45),)),
    Tissue(3e3, 0.42, skin=Membrane(1e5, 1.2e-3, 0.0))],
    ids=["nearly bone", "two ratios", "tight skin", "slack skin"])  # fmt: skip
def test_tissue_that_no_contact_was_learnt_with_is_flagged_here_too(tissue: Tissue) -> None:
    skin, tool = Skin.of(limb(8e-3, 20e-3, THICK, LONG).with_(tissue=tissue), MomentNet()), ball(0.02)
    poses = at(THICK + 0.02 - 9e-3, 0, LONG / 2)[None, None]
    found, expected = made(skin, [tool], 1).touch(poses), Batch(skin, [tool], 1).touch(poses)
    same(found, expected)
    assert not found.in_range.numpy().any()


@pytest.mark.parametrize("one", [ball(0.012), punch(), tool(LUMP)], ids=["ball", "punch", "lump"])
def test_touches_of_layers_are_those_of_numba(layered: Skin, one: Tool) -> None:
    poses = scattered(layered, 0.01, 24, 0.9)
    found, expected = made(layered, [one], 24).touch(poses), Batch(layered, [one], 24).touch(poses)
    assert (expected.statuses == "pressed by pose").sum() > 12 and expected.in_range.any()
    same(found, expected, 0.6)


def test_at_the_open_border_of_layers_the_limb_takes_back_as_little() -> None:
    skin, one = Skin.of(living(Body.anny(), "left_calf", edge_length=6e-3), MomentNet()), ball(0.02)
    poses, vertex = np.tile(np.eye(4), (8, 1, 1, 1)), 2964
    for pose, depth in zip(poses[:, 0], np.linspace(6e-3, 9.5e-3, 8), strict=True):
        pose[:3, 3] = skin.layer.vertices[vertex] + (0.02 - depth) * skin.layer.normals[vertex]
    same(made(skin, [one], 8).touch(poses), Batch(skin, [one], 8).touch(poses))


def test_tools_on_layers_feel_each_other_where_they_are_near(layered: Skin) -> None:
    poses = np.empty((3, 2, 4, 4))
    for i, away in enumerate((0.0, 0.03, 0.2)):  # on the other side, side by side, far along the limb
        x = -THICK - 0.009 + 4e-3 if away else THICK + 0.009 - 2e-3
        poses[i] = at(-THICK - 0.012 + 3e-3, 0, (LONG - away) / 2), at(x, 0, (LONG + away) / 2)
    pair = made(layered, [LEFT, RIGHT], 3)
    same(pair.touch(poses), Batch(layered, [LEFT, RIGHT], 3, threads=1).touch(poses))
    alone = made(layered, [LEFT], 3).touch(poses[:, :1]).wrenches.numpy()[:, 0, :3]
    beside = pair.touch(poses).wrenches.numpy()[:, 0, :3]
    changes = np.linalg.norm(beside - alone, axis=1) / np.linalg.norm(alone, axis=1)
    assert changes[1] > 1e-3 > 1e-5 > changes[2]  # the solver stops at 3e-6


def test_skin_beyond_a_gap_is_not_felt() -> None:
    skin, tip = Skin.of(FINGERS, MomentNet()), ball(0.008)
    poses = np.stack([at(0.0, 0.02, 0.008 - depth)[None] for depth in (5e-4, 1e-3, 2e-3)])
    assert skin.near.folded
    same(made(skin, [tip], 3).touch(poses), Batch(skin, [tip], 3, threads=1).touch(poses))


def test_fields_do_not_cross_a_gap() -> None:
    skin, tools = Skin.of(FINGERS, MomentNet(sticks=False)), [ball(0.005).named("left"), ball(0.005).named("right")]
    poses = np.stack([[at(-x, 0.02, 0.005 - 1e-3), at(x, y, 0.005 - 1.5e-3)] for x, y in
                      ((0.006, 0.02), (0.004, 0.022), (0.004, 0.062))])  # fmt: skip  # the last is near the root
    moved(made(skin, tools, 3), Batch(skin, tools, 3, threads=1), poses, 3)
    count, off = len(FINGERS.vertices), np.concatenate([poses[:1, :1], at(0.0, 0.0, 0.05)[None, None]], axis=1)
    alone = made(skin, tools, 1).touch(off, fields=[0]).fields.numpy()[0, :count]
    beyond = (FINGERS.vertices[:, 0] > 0) & (FINGERS.vertices[:, 1] < 0.03)
    assert np.linalg.norm(alone, axis=1).max() > 5e-4 and not alone[beyond].any()


def test_tools_side_by_side_feel_each_other(cylinder: Skin) -> None:
    same(made(cylinder, [LEFT, RIGHT], 6).touch(pairs()), Batch(cylinder, [LEFT, RIGHT], 6).touch(pairs()))


def test_skins_may_differ(arm: Skin, cylinder: Skin) -> None:
    poses, skins = np.concatenate([scattered(arm, 0.012, 3), scattered(cylinder, 0.012, 3)]), [arm] * 3 + [cylinder] * 3
    same(made(skins, [LEFT]).touch(poses), Batch(skins, [LEFT]).touch(poses))


def test_quaternions_and_float32_will_do(cylinder: Skin) -> None:
    poses = scattered(cylinder, 0.012)
    batch, expected = made(cylinder, [LEFT], N), Batch(cylinder, [LEFT], N).touch(poses)
    same(batch.touch(sevens(poses)), expected)
    rough = batch.touch(sevens(poses).astype(np.float32))
    peak = np.abs(expected.wrenches).max()
    assert rough.wrenches.dtype == wp.float32
    assert np.abs(rough.wrenches.numpy() - expected.wrenches).max() < 1e-4 * peak
    transforms = wp.array(sevens(poses).astype(np.float32), dtype=wp.transformf, device="cpu")
    assert np.array_equal(batch.touch(transforms).wrenches.numpy(), rough.wrenches.numpy())


def test_arrays_of_torch_are_shared_not_copied(cylinder: Skin) -> None:
    torch = pytest.importorskip("torch")
    poses = torch.from_numpy(scattered(cylinder, 0.012)).requires_grad_()
    out, batch = torch.empty((N, 1, 6), dtype=torch.float64), made(cylinder, [LEFT], N)
    assert batch._array("poses", poses).ptr == poses.data_ptr()
    found = batch.touch(poses, out=out)
    assert found.wrenches.ptr == out.data_ptr() == wp.to_torch(found.wrenches).data_ptr()
    assert torch.equal(out, torch.from_numpy(batch.touch(poses.detach().numpy()).wrenches.numpy()))


def moved(batch: WarpBatch, expected: Batch, poses: np.ndarray, least: int, off: float = 1e-4) -> np.ndarray:
    """Fields of all scenes, held to 1e-4 of each peak where there is one; NaN where there is none."""
    n = len(poses)
    found, other = batch.touch(poses, fields=range(n)), expected.touch(poses, fields=range(n))
    motion, served, moving = found.fields.numpy(), found.served.all(axis=1), 0
    assert found.fields.dtype == found.wrenches.dtype
    assert np.isnan(motion[~served]).all()
    for i in np.flatnonzero(served).tolist():
        there = other.fields[i]
        peak = np.linalg.norm(there, axis=1).max()
        assert np.linalg.norm(motion[i, : len(there)] - there, axis=1).max() <= off * peak
        assert not motion[i, len(there) :].any()
        moving += peak > 1e-4
    assert moving >= least
    return motion


@pytest.mark.parametrize(
    ("one", "reach", "deepest"), [(ball(0.012), 0.012, 0.8), (punch(), 0.012, 0.5), (tool(LUMP), 0.009, 0.6)],
    ids=["ball", "punch", "lump"],
)  # fmt: skip
def test_fields_are_those_of_numba(arm: Skin, one: Tool, reach: float, deepest: float) -> None:
    poses = scattered(arm, reach, 10, deepest)
    moved(made(arm, [one], 10), Batch(arm, [one], 10, threads=1), poses, 4)


def test_fields_of_several_tools_and_of_one_around_a_limb(cylinder: Skin) -> None:
    moved(made(cylinder, [LEFT, RIGHT], 6), Batch(cylinder, [LEFT, RIGHT], 6, threads=1), pairs(), 6)
    around = at(0.0, 2e-4, LENGTH / 2)[None, None]
    moved(made(cylinder, [band()], 1), Batch(cylinder, [band()], 1, threads=1), around, 1)


def test_fields_under_tools_that_overlap_are_the_same_in_any_order(cylinder: Skin) -> None:
    tools = [box(0.02, 0.02, 0.02), box(0.02, 0.02, 0.02).named("other")]
    poses = np.stack([[at(0.05 - first, 0, 0.08), at(0.05 - second, 0.002, 0.092)]
                      for first, second in ((3e-3, 1.5e-3), (1e-3, 3e-3), (2e-3, 2e-3))])  # fmt: skip
    motion = moved(made(cylinder, tools, 3), Batch(cylinder, tools, 3, threads=1), poses, 3)
    turned = made(cylinder, tools[::-1], 3).touch(poses[:, ::-1], fields=range(3)).fields.numpy()
    np.testing.assert_allclose(turned, motion, atol=1e-9)


def test_fields_of_skins_that_differ(arm: Skin, cylinder: Skin) -> None:
    poses = np.concatenate([scattered(arm, 0.012, 4), scattered(cylinder, 0.012, 4)])
    skins = [arm] * 4 + [cylinder] * 4
    moved(made(skins, [LEFT]), Batch(skins, [LEFT], threads=1), poses, 3)


@pytest.mark.parametrize(
    ("one", "reach", "deepest"), [(ball(0.012), 0.012, 0.6), (capsule(0.03, 0.008), 0.012, 0.5), (punch(), 0.012, 0.3)],
    ids=["ball", "capsule", "punch"],
)  # fmt: skip
def test_fields_of_layers_are_those_of_numba(oval: Skin, one: Tool, reach: float, deepest: float) -> None:
    poses = scattered(oval, reach, 10, deepest)
    moved(made(oval, [one], 10), Batch(oval, [one], 10, threads=1), poses, 5, 1e-5)


def test_fields_of_layers_under_several_tools(oval: Skin) -> None:
    """Side by side, on other sides of the limb, and one on the other, where which of the two holds a place is open."""
    one = scattered(oval, 0.012, 9, 0.4, seed=2)
    other = scattered(oval, 0.012, 9, 0.4, seed=3)
    other[:3], other[6:] = one[:3], one[6:]
    other[:3, :, 2, 3] += 0.014
    other[6:, :, 0, 3] += 2e-4
    skins, tools, poses = oval, [LEFT, LEFT.named("again")], np.concatenate([one, other], axis=1)
    batch, expected = made(skins, tools, 9), Batch(skins, tools, 9, threads=1)
    motion = moved(batch, expected, poses, 6, 1e-3)
    assert np.isfinite(motion).all()
    moved(made(skins, tools, 6), Batch(skins, tools, 6, threads=1), poses[:6], 4, 1e-5)


def test_fields_of_layers_do_not_cross_a_gap() -> None:
    skin, tools = Skin.of(LAYERED, MomentNet()), [ball(4e-3).named("left"), ball(4e-3)]
    poses = np.stack([[at(-x, 0.02, 3e-3), at(x, y, 0.03 if far else 3.2e-3)] for x, y, far in
                      ((0.004, 0.02, False), (0.003, 0.03, True), (0.004, 0.062, False))])  # fmt: skip
    motion = moved(made(skin, tools, 3), Batch(skin, tools, 3, threads=1), poses, 3, 1e-5)
    beyond = (FINGERS.vertices[:, 0] > 0) & (FINGERS.vertices[:, 1] < 0.03)
    assert np.abs(motion[1, ~beyond]).max() > 5e-4 > 1e3 * np.abs(motion[1, beyond]).max()


def test_neither_part_nor_lane_nor_room_changes_fields_of_layers(oval: Skin, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = scattered(oval, 0.012, 6, 0.5, seed=4)
    batch = made(oval, [LEFT], 6)
    whole = batch.touch(poses, fields=range(6)).fields.numpy()
    assert np.array_equal(batch.touch(poses, fields=[4, 1]).fields.numpy(), whole[[4, 1]])
    assert batch._fields is not None
    room = batch.room.bytes_of(1) + batch._fields._room.bytes_of()
    assert np.array_equal(made(oval, [LEFT], 6, memory=room).touch(poses, fields=range(6)).fields.numpy(), whole)
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)  # blocks of five threads, which wait as on a GPU
    many = made(oval, [LEFT], 6, lanes=5).touch(poses, fields=range(6)).fields.numpy()
    assert np.abs(many - whole).max() < 1e-6 * np.abs(whole).max()


def test_fields_come_for_the_scenes_that_are_asked(cylinder: Skin, monkeypatch: pytest.MonkeyPatch) -> None:
    poses, batch = pairs(), made(cylinder, [LEFT, RIGHT], 6)
    whole = batch.touch(poses, fields=range(6)).fields.numpy()
    assert batch.touch(poses).fields is None
    assert np.array_equal(batch.touch(poses, fields=[4, 1]).fields.numpy(), whole[[4, 1]])
    mask = np.arange(6) == 3
    assert np.array_equal(batch.touch(poses, fields=mask).fields.numpy(), whole[mask])
    batch.touch(poses, fields=[0])
    assert batch._fields is not None
    room = batch.room.bytes_of(2)
    few = made(cylinder, [LEFT, RIGHT], 6, memory=max(room, batch._fields._room.bytes_of()) + room)
    assert np.array_equal(few.touch(poses, fields=range(6)).fields.numpy(), whole)
    with monkeypatch.context() as patch:
        patch.setattr(wp.config, "enable_cpu_blocks", True)  # blocks of five threads, which wait as on a GPU
        many = made(cylinder, [LEFT, RIGHT], 6, lanes=5).touch(poses, fields=range(6)).fields.numpy()
    assert np.abs(many - whole).max() < 1e-6 * np.abs(whole).max()
    poses[2, 1, 0, 3] = np.nan
    spoilt = batch.touch(poses, fields=range(6)).fields.numpy()
    assert np.isnan(spoilt[2]).all() and np.array_equal(spoilt[[0, 1, 3, 4, 5]], whole[[0, 1, 3, 4, 5]])


def test_fields_are_written_to_arrays_of_torch_and_warp(cylinder: Skin) -> None:
    torch, batch = pytest.importorskip("torch"), made(cylinder, [LEFT, RIGHT], 6)
    poses, count = torch.from_numpy(sevens(pairs())), len(cylinder.layer.vertices)
    ours, theirs = wp.empty((2, count, 3), dtype=wp.float32, device="cpu"), torch.zeros((2, count, 3))
    assert batch.touch(poses, fields=[0, 1], fields_out=ours).fields is ours
    found = batch.touch(poses, fields=[0, 1], fields_out=theirs)
    assert found.fields.ptr == theirs.data_ptr() == wp.to_torch(found.fields).data_ptr()
    assert theirs.abs().max() > 1e-4 and np.array_equal(theirs.numpy(), ours.numpy())
    given = wp.array(sevens(pairs()), dtype=wp.float64, device="cpu")
    assert batch._array("poses", given) is given


def test_fields_that_are_not_served_are_refused(cylinder: Skin, layered: Skin) -> None:
    poses, batch = pairs(2), made(cylinder, [LEFT, RIGHT], 2)
    with pytest.raises(InvalidInput, match="there are 2"):
        batch.touch(poses, fields=[2])
    with pytest.raises(InvalidInput, match="fields_out has shape"):
        batch.touch(poses, fields=[0], fields_out=wp.empty((1, 5, 3), dtype=wp.float64, device="cpu"))
    for method in (Winkler(), MomentNet()):
        with pytest.raises(InvalidInput, match=r"from one MomentNet\(sticks=False\)"):
            made(Skin.of(cylinder.layer, method), [LEFT, RIGHT], 2).touch(poses, fields=[0])
    with pytest.raises(InvalidInput, match=r"from one MomentNet\(\) without a fallback; the skins have limb_linear"):
        made(Skin.of(layered.layer, LimbLinear()), [LEFT, RIGHT], 2).touch(poses, fields=[0])


def test_a_scene_that_is_refused_spoils_no_other(cylinder: Skin) -> None:
    scenes, batch = pairs(), made(cylinder, [LEFT, RIGHT], 6)
    whole = batch.touch(scenes).wrenches.numpy()
    scenes[2, 1, 0, 3], scenes[4, 0, 1, 1] = np.nan, np.inf
    scenes[3, 0, :3, :3] *= 2
    found, others = batch.touch(scenes), [0, 1, 5]
    assert np.array_equal(found.wrenches.numpy()[others], whole[others])
    assert not found.wrenches.numpy()[2:5].any() and not found.in_range.numpy()[2:5].any()
    assert not found.served[2:5].any() and found.served[others].all()
    assert (found.statuses.numpy()[2:5] == STATUSES.index("refused")).all()
    assert not batch.touch(np.zeros((6, 2, 7))).served.any()  # quaternions of nothing
    scenes = np.swapaxes(pairs(), -2, -1)  # told by columns
    scenes[1], scenes[2] = pairs()[1], pairs()[2]
    scenes[2, 0, 3, 3] = 2.0
    assert batch.touch(scenes).served.all(axis=1).tolist() == [False, True] + 4 * [False]


def test_neither_run_nor_part_nor_lane_changes_a_bit(cylinder: Skin) -> None:
    poses, batch = scattered(cylinder, 0.012), made(cylinder, [LEFT], N)
    whole = batch.touch(poses).wrenches.numpy()
    assert np.array_equal(batch.touch(poses).wrenches.numpy(), whole)
    few = made(cylinder, [LEFT], N, memory=5 * batch.room.bytes_of(1))
    assert np.array_equal(few.touch(poses).wrenches.numpy(), whole)
    many = made(cylinder, [LEFT], N, lanes=7)
    assert np.array_equal(many.touch(poses).wrenches.numpy(), whole)


def test_a_tool_that_is_far_is_flagged_here_too(cylinder: Skin) -> None:
    poses = np.stack([at(x, 0.0, 0.0)[None] for x in (1.0, 50.0, 1e12)])
    found, expected = made(cylinder, [LEFT], 3).touch(poses), Batch(cylinder, [LEFT], 3).touch(poses)
    assert found.in_range.numpy()[:, 0].tolist() == expected.in_range[:, 0].tolist() == [True, False, False]


def test_a_tool_without_room_is_told(cylinder: Skin) -> None:
    found = made(cylinder, [LEFT], 1, nodes=32).touch(at(RADIUS + 0.01, 0.0, LENGTH / 2)[None, None])
    assert STATUSES[found.statuses.numpy()[0, 0]] == "no room" and np.isnan(found.wrenches.numpy()).all()
    assert not found.in_range.numpy().any()


def test_room_grows_where_a_tool_needs_more_nodes(cylinder: Skin) -> None:
    poses, batch = scattered(cylinder, 0.012, 9), made(cylinder, [LEFT], 9)
    whole, memory = batch.touch(poses).wrenches.numpy(), batch.room.bytes_of(1)
    assert batch._make_room(32) and batch.room.nodes == 32
    assert np.array_equal(batch.touch(poses).wrenches.numpy(), whole, equal_nan=True) and batch.room.nodes > 64
    tight = made(cylinder, [LEFT], 9, memory=memory)
    assert tight._make_room(32) and tight._part > 1  # and in smaller parts, as soon as it grows
    assert np.array_equal(tight.touch(poses).wrenches.numpy(), whole, equal_nan=True) and tight._part == 1


def test_what_is_not_served_is_refused_when_it_is_made(cylinder: Skin, layered: Skin) -> None:
    with pytest.raises(InvalidInput, match="do not go into one"):
        made([cylinder, layered], [LEFT])
    with pytest.raises(InvalidInput, match="no device 'cuda:7'"):
        WarpBatch(cylinder, [LEFT], 2, device="cuda:7")
    with pytest.raises(InvalidInput, match="prepared skins"):
        made(cylinder.layer, [LEFT], 2)
    with pytest.raises(InvalidInput, match="do not fit 3"):
        made([cylinder, cylinder], [LEFT], 3)
    with pytest.raises(InvalidInput, match="name of its own"):
        made(cylinder, [LEFT, LEFT], 3)
    with pytest.raises(InvalidInput, match="scratch space"):
        made(cylinder, [LEFT], 3, memory=1000)


def test_what_does_not_fit_is_said(cylinder: Skin) -> None:
    torch, batch = pytest.importorskip("torch"), made(cylinder, [LEFT], 2)
    with pytest.raises(InvalidInput, match=r"\(2, 1, 7\)"):
        batch.touch(np.zeros((2, 7)))
    with pytest.raises(InvalidInput, match="float32 or float64"):
        batch.touch(torch.zeros((2, 1, 7), dtype=torch.int32))
    with pytest.raises(InvalidInput, match="they are complex"):
        batch.touch(np.zeros((2, 1, 7), complex))
    with pytest.raises(InvalidInput, match="poses are no array of numbers"):
        batch.touch("abc")
    with pytest.raises(InvalidInput, match=r"scenes \[1.5\]; there are 2"):
        batch.touch(np.zeros((2, 1, 7)), fields=[1.5])
    with pytest.raises(InvalidInput, match="out has shape"):
        batch.touch(np.zeros((2, 1, 7)), out=torch.zeros((2, 1, 6)))
    with pytest.raises(InvalidInput, match="share a place"):
        batch.touch(np.zeros((2, 1, 7)), out=torch.zeros((1, 1, 6), dtype=torch.float64).expand(2, 1, 6))
    for wrong in (torch.empty((2, 1, 7), device="meta"), torch.zeros((2, 1, 7)).to_sparse()):
        with pytest.raises(InvalidInput, match="poses is a tensor that Warp cannot take"):
            batch.touch(wrong)
    with pytest.raises(InvalidInput, match="there are 2: a list of numbers of scenes, or a mask"):
        batch.touch(np.zeros((2, 1, 7)), fields=[True])
    for nodes in (0, "a"):
        with pytest.raises(InvalidInput, match=r"nodes is .*; a whole number"):
            made(cylinder, [LEFT], 2, nodes=nodes)
    with pytest.raises(InvalidInput, match="out is numpy's"):
        batch.touch(np.zeros((2, 1, 7)), out=np.zeros((2, 1, 6)))
