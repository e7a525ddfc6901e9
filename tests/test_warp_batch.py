"""WarpBatch on Warp's CPU device, the source that also runs on a GPU: what it answers is Batch's answer."""

from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from stmpl_core import Tool
from stmpl_core.batch import Batch, BatchTouches
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import MomentNet
from stmpl_core.skin import Skin
from tests.scenes import LENGTH, RADIUS, at, ball, band, box, capsule, limb, punch, tool

wp = pytest.importorskip("warp")
wp.config.quiet = True

from stmpl_core.gpu.warp_batch import STATUSES, WarpBatch, WarpTouches  # noqa: E402

N = 64
LEFT, RIGHT = ball(0.012).named("left"), ball(0.009).named("right")
LUMP = trimesh.creation.icosphere(3, 0.01)
LUMP.vertices = LUMP.vertices * [1, 0.6, 1.5] + 1e-3 * np.sin(900 * LUMP.vertices[:, [1, 2, 0]])


@pytest.fixture(scope="module")
def arm() -> Skin:
    return Skin.of(Body.anny().part("left_arm", edge_length=6e-3), MomentNet())


@pytest.fixture(scope="module")
def cylinder() -> Skin:
    return Skin.of(limb(5e-3, youngs_modulus=5e3, poisson_ratio=0.35), MomentNet())


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
    assert np.abs(found.force_bounds.numpy() - expected.force_bounds)[served].max() < 1e-4 * peak
    assert np.array_equal(found.in_range.numpy()[served], expected.in_range[served])
    assert np.array_equal(np.array(STATUSES)[found.statuses.numpy()][served], expected.statuses[served])


@pytest.mark.parametrize(
    ("one", "reach"),
    [(ball(0.012), 0.012), (capsule(0.03, 0.008), 0.012), (punch(), 0.012), (box(0.03, 0.02, 1e-3), 0.01),
     (tool(LUMP), 0.009)],
    ids=["ball", "capsule", "punch", "thin plate", "lump"],
)  # fmt: skip
def test_touches_are_those_of_numba(arm: Skin, one: Tool, reach: float) -> None:
    poses = scattered(arm, reach)
    found, expected = made(arm, [one], N).touch(poses), Batch(arm, [one], N).touch(poses)
    assert {"apart", "pressed by pose"} <= set(expected.statuses.ravel())
    same(found, expected, 0.5)
    deep = ~found.served
    assert (np.array(STATUSES)[found.statuses.numpy()][deep] == "too deep").all() and not expected.in_range[deep].any()


def test_a_tool_around_the_limb_lies_on_several_charts(cylinder: Skin) -> None:
    poses = at(0.0, 2e-4, LENGTH / 2)[None, None]
    same(made(cylinder, [band()], 1).touch(poses), Batch(cylinder, [band()], 1).touch(poses))


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


def test_neither_run_nor_part_nor_lane_changes_a_bit(cylinder: Skin) -> None:
    poses, batch = scattered(cylinder, 0.012), made(cylinder, [LEFT], N)
    whole = batch.touch(poses).wrenches.numpy()
    assert np.array_equal(batch.touch(poses).wrenches.numpy(), whole)
    few = made(cylinder, [LEFT], N, memory=5 * batch.room.bytes_of(1))
    assert np.array_equal(few.touch(poses).wrenches.numpy(), whole)
    many = made(cylinder, [LEFT], N, lanes=7)  # only what a lattice covers is added lane by lane
    assert np.abs(many.touch(poses).wrenches.numpy() - whole).max() < 1e-12 * np.abs(whole).max()


def test_a_tool_without_room_is_told(cylinder: Skin) -> None:
    found = made(cylinder, [LEFT], 1, nodes=32).touch(at(RADIUS + 0.01, 0.0, LENGTH / 2)[None, None])
    assert STATUSES[found.statuses.numpy()[0, 0]] == "no room" and np.isnan(found.wrenches.numpy()).all()
    assert not found.in_range.numpy().any()


def test_what_is_not_served_is_refused_when_it_is_made(cylinder: Skin) -> None:
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
    with pytest.raises(InvalidInput, match="out has shape"):
        batch.touch(np.zeros((2, 1, 7)), out=torch.zeros((2, 1, 6)))
    with pytest.raises(InvalidInput, match="out is numpy's"):
        batch.touch(np.zeros((2, 1, 7)), out=np.zeros((2, 1, 6)))
