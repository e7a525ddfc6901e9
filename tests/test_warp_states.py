"""WarpBatch with a memory: time, friction and balance of energy, step by step what Batch makes of them."""

from typing import Any

import numpy as np
import pytest

from stmpl_core import Membrane, Ply, SoftLayer, Tissue
from stmpl_core.batch import Batch, BatchTouches
from stmpl_core.bones import Bone, to_bone
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import MomentNet
from stmpl_core.skin import Skin
from stmpl_core.state import State
from stmpl_core.tissue import Prony
from tests.scenes import LENGTH, RADIUS, at, ball, limb

wp = pytest.importorskip("warp")
wp.config.quiet = True

from stmpl_core.gpu.warp_batch import STATUSES, WarpBatch, WarpTouches  # noqa: E402

LEFT, RIGHT = ball(0.012).named("left"), ball(0.009).named("right")
SLOW, QUICK = Prony((0.3, 0.1), (0.05, 1.0)), Prony((0.2,), (0.3,))
THICK, LONG, N = 0.02, 0.3, 3
PARTS = ("pose", "wrench", "scalars", "relaxed", "contact", "imprint", "stiffness", "springs", "springs_relaxed")
UNEVEN = (1e-4, 5e-2, 1e-3, 1e-2, 5e-3)  # s


@pytest.fixture(scope="module")
def plain() -> Skin:
    return Skin.of(limb(5e-3).with_(tissue=Tissue(5e3, 0.35, relaxation=SLOW)), MomentNet())


@pytest.fixture(scope="module")
def layered() -> Skin:
    """Oval: see tests/test_warp_batch.py."""
    around = limb(8e-3, 8e-3, THICK, LONG)
    bone = Bone(np.array([0.003, 0, -1]), np.array([0.003, 0, 1]), 0.006)
    tissue = Tissue(3e3, 0.45, relaxation=SLOW, skin=Membrane(1.3e5, 1.2e-3, 11.0, relaxation=QUICK),
                    deeper=(Ply(6e-3, 15e3, 0.45, relaxation=SLOW),))  # fmt: skip
    return Skin.of(to_bone(SoftLayer(around.vertices * [1.07, 0.98, 1], around.faces, 8e-3), [bone]).with_(
        tissue=tissue), MomentNet())  # fmt: skip


def poses(skin: Skin, t: float) -> np.ndarray:
    """Both tools at a time [s]: pressed, drawn along and around, spun, lifted, pressed again, one after the other."""
    surface, middle = (THICK * 1.07, LONG / 2) if skin.layer.stacked else (RADIUS, LENGTH / 2)
    out = np.empty((N, 2, 4, 4))
    for i in range(N):
        deep = (2e-3 + 5e-4 * i) * min(t / 0.1, 1.0) * (-1 if 0.5 < t < 0.6 else 1)
        along, spun = middle + 0.012 * np.sin(8 * max(t - 0.1, 0.0)) + 5e-3 * i, max(t - 0.2, 0.0)
        out[i, 0] = at(surface + 0.012 - deep, 3e-3 * np.sin(6 * t), along)
        out[i, 0, 1:3, 1:3] = [[np.cos(spun), -np.sin(spun)], [np.sin(spun), np.cos(spun)]]
        out[i, 1] = at(surface + 0.009 - (1.5e-3 if 0.3 < t < 0.7 else -2e-3), 0.0, along - 0.02)
    return out


def compared(found: WarpTouches, expected: BatchTouches, most: dict[str, float]) -> None:
    """Writes how far both are apart, over the largest of each kind, where it is more than before."""
    off = {"status": float((np.array(STATUSES)[found.statuses.numpy()] != expected.statuses).any()),
           "range": float((found.in_range.numpy() != expected.in_range).any())}  # fmt: skip
    peak = max(float(np.abs(expected.wrenches[..., :3]).max()), 1e-2)
    wrenches = np.abs(found.wrenches.numpy() - expected.wrenches)
    off |= {"force": wrenches[..., :3].max() / peak, "torque": wrenches[..., 3:].max() / (0.01 * peak),
            "bound": np.abs(found.force_bounds.numpy() - expected.force_bounds).max() / peak}  # fmt: skip
    for mine, theirs in zip(found.states.to_states(), expected.states or [], strict=True):
        assert mine.tools.keys() == theirs.tools.keys()
        for name, memory in mine.tools.items():
            for part in PARTS:
                there, other = (np.asarray(getattr(one, part)) for one in (memory, theirs.tools[name]))
                least = 1e-3 if part == "scalars" else 1e-2
                apart = np.abs(there - other)
                scale = np.maximum(np.abs(other) if part == "scalars" else np.abs(other).max(initial=0), least)
                off[part] = max(off.get(part, 0.0), float((apart / scale).max(initial=0)))
    for name, one in off.items():
        most[name] = max(most.get(name, 0.0), float(one))


def played(skin: Skin, friction: Any, steps: int = 40) -> dict[str, float]:
    batch, plain = WarpBatch(skin, [LEFT, RIGHT], N, friction=friction, device="cpu"), \
        Batch(skin, [LEFT, RIGHT], N, friction=friction, threads=1)  # fmt: skip
    states, theirs, t, most = batch.at_rest(), [None] * N, 0.0, {}
    for step in range(steps):
        dt = UNEVEN[step % len(UNEVEN)]
        t += dt
        found, expected = batch.touch(poses(skin, t), states, dt), plain.touch(poses(skin, t), theirs, dt)
        states, theirs = found.states, expected.states
        compared(found, expected, most)
        if step == steps // 2:  # to the one that is not on a GPU, and back
            states = batch.states(states.to_states())
    return most


@pytest.mark.parametrize("friction", [None, 0.4, {"left": "oiled", "right": "dry"}], ids=["sticks", "dry", "by tool"])
def test_one_material_remembers_as_in_batch(plain: Skin, friction: Any) -> None:
    most = played(plain, friction)
    assert not most.pop("status") and not most.pop("range")
    assert max(most.values()) < 1e-5, most  # found: 2e-7, where springs are held


@pytest.mark.parametrize("friction", [None, 0.3])
def test_layers_remember_as_in_batch(layered: Skin, friction: Any) -> None:
    most = played(layered, friction)
    assert not most.pop("status") and not most.pop("range")
    assert max(most.values()) < 1e-4, most  # found: 5e-6, the linear problem's tolerance


def test_elastic_skin_is_rubbed_too(layered: Skin) -> None:
    tissue = Tissue(3e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0), deeper=(Ply(6e-3, 15e3, 0.45),))
    skin = Skin.of(layered.layer.with_(tissue=tissue), MomentNet())
    most = played(skin, "dry", 20)
    assert not most.pop("status") and not most.pop("range")
    assert max(most.values()) < 1e-4, most


def test_skins_that_relax_otherwise_go_into_one_batch(plain: Skin) -> None:
    other = Skin.of(limb(5e-3).with_(tissue=Tissue(5e3, 0.35, relaxation=QUICK)), MomentNet())
    skins = [plain, other, plain]
    batch = WarpBatch(skins, [LEFT, RIGHT], friction=0.4, device="cpu")
    expected = Batch(skins, [LEFT, RIGHT], friction=0.4, threads=1)
    states, theirs, most = batch.at_rest(), [None] * N, {}
    for step in range(12):
        where = poses(plain, 0.02 * step)
        found, told = batch.touch(where, states, 0.02), expected.touch(where, theirs, 0.02)
        states, theirs = found.states, told.states
        compared(found, told, most)
    assert not most.pop("status") and not most.pop("range")
    assert max(most.values()) < 1e-5, most


def test_scenes_begin_anew_and_one_that_is_refused_stays_as_it_was(plain: Skin) -> None:
    batch = WarpBatch(plain, [LEFT, RIGHT], N, friction=0.4, device="cpu")
    first = batch.touch(poses(plain, 0.1), batch.at_rest(), 0.1).states
    where = poses(plain, 0.2)
    where[1, 0, 0, 3] = np.nan
    found = batch.touch(where, first.reset([2]), 0.1)
    assert (found.statuses.numpy()[1] == STATUSES.index("refused")).all() and not found.in_range.numpy()[1].any()
    assert found.states.to_states()[1].pack() == first.to_states()[1].pack()
    alone = batch.touch(where, batch.at_rest(), 0.1)
    assert np.array_equal(found.wrenches.numpy()[2], alone.wrenches.numpy()[2])
    assert not np.array_equal(found.wrenches.numpy()[0], alone.wrenches.numpy()[0])
    assert first.to_states()[2].pack() != first.reset(np.array([False, False, True])).to_states()[2].pack()
    again = batch.touch(where, first.reset([2]), 0.1)
    assert again.wrenches.numpy().tobytes() == found.wrenches.numpy().tobytes()


def two(left: float, right: float) -> np.ndarray:
    """Both tools at depths [m], far from each other, in all scenes, (N, 2, 4, 4)."""
    place = [at(RADIUS + 0.012 - left, 0.0, LENGTH / 2), at(RADIUS + 0.009 - right, 0.0, LENGTH / 2 - 0.04)]
    return np.tile(np.array(place), (N, 1, 1, 1))


def test_a_scene_that_missed_a_step_is_out_of_range_until_it_forgets(plain: Skin) -> None:
    batch, off = WarpBatch(plain, [LEFT, RIGHT], N, device="cpu"), two(-2e-3, -2e-3)
    begun = batch.touch(two(2e-3, 2e-3), batch.at_rest(), 0.1)
    where = two(2e-3, 2e-3)
    where[1, 1], where[2, 1, 0, 3] = two(2e-3, 8e-3)[0, 1], np.nan
    missed = batch.touch(where, begun.states, 0.5)
    assert [STATUSES[k] for k in missed.statuses.numpy()[:, 1]] == ["pressed by pose", "too deep", "refused"]
    after = batch.touch(two(2e-3, 2e-3), missed.states, 0.1)
    assert after.in_range.numpy().tolist() == [[True] * 2, [False] * 2, [True] * 2]
    assert batch.touch(two(2e-3, 2e-3), missed.states.reset([1]), 0.1).in_range.numpy().all()
    told = missed.states.to_states()  # a Batch knows, too
    expected = Batch(plain, [LEFT, RIGHT], N, threads=1).touch(two(2e-3, 2e-3), told, 0.1)
    assert expected.in_range.tolist() == after.in_range.numpy().tolist()
    soon = batch.touch(off, after.states, 0.1)
    assert not soon.in_range.numpy()[1].any()
    late = batch.touch(off, soon.states, 100.0)
    assert late.in_range.numpy().all() and not late.states.missed.any()
    assert batch.touch(two(2e-3, 2e-3), late.states, 0.1).in_range.numpy().all()


def test_what_drags_is_out_of_range_until_it_lets_go_and_elastic_skin_never(plain: Skin) -> None:
    skin = Skin.of(limb(5e-3).with_(tissue=Tissue(5e3, 0.35)), MomentNet())
    for friction, flagged in ((None, False), ({"left": 0.4}, True)):
        batch = WarpBatch(skin, [LEFT, RIGHT], N, friction=friction, device="cpu")
        states = batch.touch(two(2e-3, 2e-3), batch.at_rest(), 0.1).states
        states = batch.touch(two(2e-3, 8e-3), states, 0.1).states
        for _ in range(2):
            found = batch.touch(two(2e-3, 2e-3), states, 10.0)
            states = found.states
            assert (found.in_range.numpy() != flagged).all()
        assert batch.touch(two(-2e-3, 2e-3), states, 0.1).in_range.numpy().all()


def test_outputs_and_precision_are_those_of_the_poses(plain: Skin) -> None:
    torch = pytest.importorskip("torch")
    batch = WarpBatch(plain, [LEFT, RIGHT], N, friction=0.4, device="cpu")
    out = torch.empty((N, 2, 6), dtype=torch.float32)
    where = torch.from_numpy(poses(plain, 0.1).astype(np.float32))
    begun = batch.touch(where, batch.at_rest(), 0.01).states
    for done in (torch.tensor([False, True, False]), wp.array([False, True, False], dtype=wp.bool, device="cpu")):
        assert begun.reset(done).to_states()[1].pack() == begun.reset([1]).to_states()[1].pack()
    found = batch.touch(where, batch.at_rest(), 0.01, out=out)
    exact = batch.touch(poses(plain, 0.1), batch.at_rest(), 0.01)
    assert found.wrenches.ptr == out.data_ptr() and found.depths.dtype is found.force_bounds.dtype is wp.float32
    assert np.abs(out.numpy() - exact.wrenches.numpy()).max() < 1e-3 * np.abs(exact.wrenches.numpy()).max()


def test_states_of_another_batch_are_refused(plain: Skin) -> None:
    batch, where = WarpBatch(plain, [LEFT, RIGHT], N, device="cpu"), poses(plain, 0.1)
    softer = Skin.of(limb(5e-3).with_(tissue=Tissue(4e3, 0.35, relaxation=SLOW)), MomentNet())
    longer = Skin.of(limb(5e-3, length=0.2).with_(tissue=plain.layer.tissue), MomentNet())
    others = {"skins": WarpBatch([plain, longer, plain], [LEFT, RIGHT], device="cpu"),
              "tissue": WarpBatch([plain, softer, plain], [LEFT, RIGHT], device="cpu"),
              "tools": WarpBatch(plain, [RIGHT, LEFT], N, device="cpu")}  # fmt: skip
    for what, other in others.items():
        with pytest.raises(InvalidInput, match=f"another batch do not fit: its {what} are other"):
            batch.touch(where, other.at_rest(), 0.01)
    told = others["skins"].touch(where, others["skins"].at_rest(), 0.1).states
    with pytest.raises(InvalidInput, match="state 1 is of skin of another shape"):
        batch.states(told.to_states())
    with pytest.raises(InvalidInput, match="Of a WarpBatch"):
        Batch(plain, [LEFT, RIGHT], N, threads=1).touch(where, batch.at_rest(), 0.01)  # type: ignore[arg-type]
    alike = WarpBatch(plain, [LEFT, RIGHT], N, device="cpu")
    assert batch.touch(where, alike.at_rest(), 0.01).in_range.numpy().all()


def test_what_does_not_fit_is_said(plain: Skin) -> None:
    batch, where = WarpBatch(plain, [LEFT], N, device="cpu"), poses(plain, 0.1)[:, :1]
    rest = batch.at_rest()
    with pytest.raises(InvalidInput, match="fields of skin with a memory"):
        batch.touch(where, rest, 0.01, fields=[0])
    with pytest.raises(InvalidInput, match="states are"):
        batch.touch(where, [State()] * N, 0.01)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="do not fit"):
        batch.touch(where, WarpBatch(plain, [LEFT, RIGHT], N, device="cpu").at_rest(), 0.01)
    with pytest.raises(InvalidInput, match="2 states do not fit 3 scenes"):
        batch.states([None, None])
    for wrong in (0, None, "a", [[0]], [0.0], [True], -1):
        with pytest.raises(InvalidInput, match="scenes to reset"):
            rest.reset(wrong)
    with pytest.raises(InvalidInput, match="dt is"):
        batch.touch(where, rest, -1.0)
    with pytest.raises(InvalidInput, match="scenes to reset"):
        rest.reset([3])
    with pytest.raises(InvalidInput, match="friction is told of"):
        WarpBatch(plain, [LEFT], N, friction={"right": 0.3}, device="cpu")
    other = Batch(Skin.of(limb(5e-3).with_(tissue=Tissue(5e3, 0.35, relaxation=QUICK)), MomentNet()), [LEFT], 1)
    told = other.touch(where[:1], [None], 0.01).states or []
    with pytest.raises(InvalidInput, match="1 times of relaxation; its has 2"):
        batch.states([*told, None, None])
