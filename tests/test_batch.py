"""Batch: many scenes give, each, what a simulator gives it alone."""

import pickle
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stmpl_core import Contact, Prony, Simulator, SoftLayer, State, Tissue
from stmpl_core.batch import REFUSED, Batch
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import MomentNet
from stmpl_core.skin import Skin
from tests.scenes import LENGTH, RADIUS, at, ball, limb

TOOLS = (ball(0.012).named("left"), ball(0.009).named("right"))
N = 6


@pytest.fixture(scope="module")
def skin() -> Skin:
    return Skin.of(limb(5e-3, youngs_modulus=5e3), MomentNet())


@pytest.fixture(scope="module")
def relaxing() -> Skin:
    layer = limb(5e-3)
    return Skin.of(layer.with_(tissue=Tissue(5e3).relaxing(Prony((0.2, 0.2), (0.3, 4.0)))), MomentNet())


def poses(n: int = N, seed: int = 0) -> np.ndarray:
    """Two balls in each scene, on either side or side by side, (n, 2, 4, 4)."""
    rng = np.random.default_rng(seed)
    out = np.empty((n, 2, 4, 4))
    for i in range(n):
        x = RADIUS + 0.012 - 1e-3 - 2e-3 * rng.random()
        out[i, 0] = at(x, 0.0, LENGTH / 2 + 0.02 * rng.random())
        out[i, 1] = at(x - 3e-3, 0.0, LENGTH / 2 - 0.015) if i % 2 else at(-x + 3e-3, 0.0, LENGTH / 2)
    return out


def alone(skin: Skin, scenes: np.ndarray) -> np.ndarray:
    simulator = Simulator(skin)
    return np.array([[touch.wrench for touch in simulator.touch([Contact(tool, pose) for tool, pose in
                                                                zip(TOOLS, scene, strict=True)])] for scene in scenes])


@pytest.mark.parametrize("threads", [1, 3])
def test_each_scene_gets_what_it_would_alone(skin: Skin, threads: int) -> None:
    batch = Batch(skin, TOOLS, N, threads=threads)
    found, again = batch.touch(poses()), pickle.loads(pickle.dumps(batch)).touch(poses())
    assert np.array_equal(again.wrenches, found.wrenches)
    assert np.array_equal(found.wrenches, alone(skin, poses()))
    assert (np.linalg.norm(found.wrenches[:, :, :3], axis=2) > 1e-3).all()
    assert found.in_range.all() and (found.statuses == "pressed by pose").all() and not found.fields
    assert (found.force_bounds > 0).all() and (found.depths > 0).all() and found.states is None


def test_quaternions_are_x_y_z_w(skin: Skin) -> None:
    matrices = poses()
    turned = Rotation.from_rotvec(np.random.default_rng(1).normal(size=(N, 3))).as_matrix()
    matrices[:, 0, :3, :3] = turned
    seven = np.concatenate([matrices[:, :, :3, 3], Rotation.from_matrix(
        matrices[:, :, :3, :3].reshape(-1, 3, 3)).as_quat().reshape(N, 2, 4)], axis=2)  # fmt: skip
    batch = Batch(skin, TOOLS, N)
    one, other = batch.touch(matrices).wrenches, batch.touch(seven).wrenches
    assert np.allclose(one, other, rtol=1e-6, atol=1e-9 * np.abs(one).max())


def test_fields_come_for_the_scenes_that_are_asked(skin: Skin) -> None:
    found, simulator = Batch(skin, TOOLS, N).touch(poses(), fields=(1, 4)), Simulator(skin)
    assert sorted(found.fields) == [1, 4]
    for i, field in found.fields.items():
        answer = simulator.step([Contact(tool, pose) for tool, pose in zip(TOOLS, poses()[i], strict=True)])
        assert np.array_equal(field, answer.displacement)


def test_fields_come_for_a_mask_of_scenes(skin: Skin) -> None:
    torch, batch, mask = pytest.importorskip("torch"), Batch(skin, TOOLS, N), np.arange(N) % 3 == 1
    for asked in (mask, mask.tolist(), torch.from_numpy(mask), torch.tensor([1, 4]), np.array([4, 1], np.uint8)):
        assert sorted(batch.touch(poses(), fields=asked).fields) == [1, 4]
    assert not batch.touch(poses(), fields=np.zeros(N, bool)).fields
    for wrong in (None, 2, [[0]], [[0], [1, 2]], mask[:3], [1.0], "0", torch.tensor(1), torch.empty(2, device="meta")):
        with pytest.raises(InvalidInput, match=r"there are 6: a list of numbers of scenes, or a mask"):
            batch.touch(poses(), fields=wrong)


def test_memory_is_each_scenes_own(relaxing: Skin) -> None:
    """Scenes of unequal pasts: one begins anew each time, the others go on."""
    batch, scenes = Batch(relaxing, TOOLS, 3, friction="dry"), poses(3)
    simulator, told = Simulator(relaxing, friction="dry"), [State(), State(), State()]
    states: Sequence[State | None] = [None, None, None]
    for step in range(4):
        scenes[:, :, 2, 3] += 1e-3
        found = batch.touch(scenes, states, 0.02)
        for i in range(3):
            contacts = [Contact(tool, pose) for tool, pose in zip(TOOLS, scenes[i], strict=True)]
            touches, told[i] = simulator.touch(contacts, told[i], 0.02)
            assert np.array_equal(found.wrenches[i], [touch.wrench for touch in touches]), (step, i)
        assert found.states is not None
        states = [None, *found.states[1:]]
        told[0] = State()


def test_skins_may_differ(skin: Skin, relaxing: Skin) -> None:
    found = Batch([skin, relaxing, skin], TOOLS).touch(poses(3), fields=range(3))
    for i, one in enumerate((skin, relaxing, skin)):
        assert np.array_equal(found.wrenches[i], alone(one, poses(3)[i : i + 1])[0])


def test_a_scene_that_is_refused_spoils_no_other(skin: Skin) -> None:
    scenes = poses()
    scenes[2, 1, 0, 3] = np.nan
    scenes[3, 0, :3, :3] *= 2
    found, expected = Batch(skin, TOOLS, N).touch(scenes, fields=range(N)), alone(skin, poses())
    for i in range(N):
        if i in (2, 3):
            assert not found.wrenches[i].any() and not found.in_range[i].any()
            assert (found.statuses[i] == REFUSED).all()
            assert found.fields[i].shape == (len(skin.layer.vertices), 3) and np.isnan(found.fields[i]).all()
            assert "pose of" in found.why[i, 0]
        else:
            assert np.array_equal(found.wrenches[i], expected[i])
    seven = np.zeros((N, 2, 7))  # quaternions of nothing
    refused = Batch(skin, TOOLS, N).touch(seven)
    assert (refused.statuses == REFUSED).all() and "is not rigid" in refused.why[0, 0]


def test_arrays_of_torch_are_shared_not_copied(skin: Skin) -> None:
    torch = pytest.importorskip("torch")
    given, out = torch.from_numpy(poses()), torch.empty((N, 2, 6), dtype=torch.float32)
    batch = Batch(skin, TOOLS, N)
    found = batch.touch(given, out=out)
    assert np.shares_memory(found.wrenches, out.numpy())
    assert np.allclose(out.numpy(), alone(skin, poses()), rtol=1e-6)


@pytest.mark.parametrize("tools", [["ball"], {"ball": TOOLS[0]}, 5, None])
def test_tools_that_are_none_are_said(skin: Skin, tools) -> None:
    with pytest.raises(InvalidInput, match="a list of Tool is needed"):
        Batch(skin, tools, 1)


def test_threads_fields_and_tensors_of_another_kind_are_said(skin: Skin) -> None:
    torch = pytest.importorskip("torch")
    for threads in ("a", 2.5):
        with pytest.raises(InvalidInput, match=r"threads is .*; a whole number"):
            Batch(skin, TOOLS, N, threads=threads)  # type: ignore[arg-type]
    batch, learnt = Batch(skin, TOOLS, N), torch.from_numpy(poses()).requires_grad_()
    with pytest.raises(InvalidInput, match="a list of numbers of scenes"):
        batch.touch(poses(), fields=3)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"poses are no array of numbers.*detach"):
        batch.touch(learnt)
    with pytest.raises(InvalidInput, match=r"out takes no numbers.*detach"):
        batch.touch(poses(), out=torch.zeros((N, 2, 6)).requires_grad_())


def test_poses_and_states_of_another_kind_are_said(skin: Skin) -> None:
    batch, contact = Batch(skin, TOOLS, N), Contact(TOOLS[0], np.eye(4))
    for wrong in ("x", poses().astype(complex)):
        with pytest.raises(InvalidInput, match="poses are no array of numbers"):
            batch.touch(wrong)
    with pytest.raises(InvalidInput, match="a list of one State or None for each scene"):
        batch.touch(poses(), State(), 0.01)  # type: ignore[arg-type]
    assert "a State is needed" in batch.touch(poses(), [1] * N, 0.01).why[0, 0]  # type: ignore[list-item]
    for state in (1, {}):
        with pytest.raises(InvalidInput, match="a State is needed"):
            Simulator(skin).touch([contact], state, 0.01)  # type: ignore[call-overload]
    with pytest.raises(InvalidInput, match="complex"):
        Contact(TOOLS[0], np.eye(4, dtype=complex))


def test_what_does_not_fit_is_said(skin: Skin) -> None:
    batch = Batch(skin, TOOLS, N)
    with pytest.raises(InvalidInput, match=r"\(6, 2, 7\)"):
        batch.touch(np.zeros((N, 7)))
    with pytest.raises(InvalidInput, match="2 states do not fit 6"):
        batch.touch(poses(), [None, None])
    with pytest.raises(InvalidInput, match="there are 6"):
        batch.touch(poses(), fields=[9])
    with pytest.raises(InvalidInput, match="out has shape"):
        batch.touch(poses(), out=np.zeros((N, 2, 3)))
    with pytest.raises(InvalidInput, match="out has shape"):
        batch.touch(poses(), out=np.zeros((N, 2, 6)).tolist())
    with pytest.raises(InvalidInput, match="share a place"):
        batch.touch(poses(), out=np.lib.stride_tricks.as_strided(np.zeros((1, 2, 6)), (N, 2, 6), (0, 48, 8)))
    with pytest.raises(InvalidInput, match="array of int64"):
        batch.touch(poses(), out=np.zeros((N, 2, 6), int))
    with pytest.raises(InvalidInput, match="dt is"):
        batch.touch(poses(), [None] * N, -1.0)
    with pytest.raises(InvalidInput, match="do not fit 3"):
        Batch([skin, skin], TOOLS, 3)
    with pytest.raises(InvalidInput, match="n is 0; a whole number"):
        Batch(skin, TOOLS, 0)
    with pytest.raises(InvalidInput, match="n is True"):
        Batch(skin, TOOLS, True)
    with pytest.raises(InvalidInput, match="name of its own"):
        Batch(skin, (TOOLS[0], TOOLS[0]), 3)
    with pytest.raises(InvalidInput, match="threads"):
        Batch(skin, TOOLS, 3, threads=0)


def test_a_layer_that_no_one_prepared_is_no_skin(skin: Skin) -> None:
    layer: SoftLayer = skin.layer
    with pytest.raises(InvalidInput, match="Skin"):
        Batch(layer, TOOLS, 3)  # type: ignore[arg-type]
