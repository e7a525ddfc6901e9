"""Laws of the learned simulator: what is exact by construction, what it was trained to, and what it says of itself."""

import importlib
import pkgutil
from functools import cache
from pathlib import Path
from types import CodeType

import numpy as np
import pytest
import torch
from numba.core.dispatcher import Dispatcher

import fem_tools
import stmpl_core
from fem_tools import PatchFem
from fem_tools.dataset import Dataset
from fem_tools.generate import generate
from fem_tools.sampling import PRESETS
from stmpl_core import Load, SoftLayer
from stmpl_core.errors import InvalidInput, NotPrepared
from stmpl_core.methods import Linear, MomentNet
from stmpl_core.methods.moment_net import invariants, source_fields
from stmpl_core.metrics import score
from stmpl_core.moments import Surroundings
from stmpl_core.networks import INPUTS, POINT, STACK_INPUTS
from stmpl_core.response import REACH
from studies.train_moments import Model, MomentTraining, draw_points, fit, train_moments
from tests import scenes
from tests.scenes import turn

T = 7e-3
SETTINGS = MomentTraining(hidden=8, steps=60, points=32, checkpoint_minutes=0)
pytestmark = pytest.mark.usefixtures("one_thread")


@cache
def limb(nu: float = 0.4, thickness: float = T, scale: float = 1.0) -> SoftLayer:
    """A cylinder: no body, so a shape that nothing was learnt from."""
    return scenes.enlarged(scenes.limb(3.5e-3, thickness, poisson_ratio=nu), scale)


def pad(layer: SoftLayer, ratio: float, radius: float = 0.013, scale: float = 1.0) -> Load:
    return scenes.disc(layer, ratio, scale * np.array([0.04, 0, 0.08]), scale * radius, scale * 6e-3)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "few"
    plan = PRESETS["tiny"].model_copy(update={"discs": 10, "indenters": 0, "hands": 0, "bands": 0, "letters": 0})
    generate(plan, out, workers=2)
    return out


@pytest.fixture(scope="module")
def net() -> MomentNet:
    return MomentNet().prepare(limb())


def test_no_load_moves_nothing(net: MomentNet) -> None:
    answer = net.solve(Load.zero(limb()))
    assert not answer.displacement.any() and answer.trust.ok and answer.trust.error_bound == 0.0


def test_turning_the_scene_turns_the_answer(net: MomentNet) -> None:
    layer = limb()
    rotation = turn((1, 2, 3), 1.1)[:3, :3]
    turned = layer.with_(vertices=layer.vertices @ rotation.T + [0.3, -0.1, 0.2])
    straight = net.solve(pad(layer, 0.8)).displacement
    np.testing.assert_allclose(
        MomentNet().prepare(turned).solve(pad(layer, 0.8)).displacement, straight @ rotation.T, atol=2e-6
    )


def test_stiffness_enters_as_pressure_over_modulus_alone(net: MomentNet) -> None:
    layer = limb().with_(youngs_modulus=37e3)
    stiff = MomentNet().prepare(layer).solve(pad(layer, 0.8)).displacement
    np.testing.assert_allclose(stiff, net.solve(pad(limb(), 0.8)).displacement, atol=1e-9)


def test_a_scene_of_half_the_size_moves_half_as_far(net: MomentNet) -> None:
    small = limb(scale=0.6)
    answer = MomentNet().prepare(small).solve(pad(small, 0.8, scale=0.6))
    np.testing.assert_allclose(answer.displacement, 0.6 * net.solve(pad(limb(), 0.8)).displacement, atol=2e-6)


def test_beyond_its_reach_nothing_moves(net: MomentNet) -> None:
    layer, load = limb(), pad(limb(), 0.8)
    moved = net.solve(load).magnitude > 0
    away = np.linalg.norm(layer.vertices[:, None] - layer.vertices[load.loaded][None], axis=2).min(axis=1)
    assert moved.any() and not moved[away > REACH * T].any()


def test_more_pressure_is_more_depth(net: MomentNet) -> None:
    peaks = [net.solve(pad(limb(), r)).magnitude.max() for r in np.linspace(0.02, 1.5, 60)]
    assert (np.diff(peaks) > 0).all()


@pytest.mark.parametrize(("nu", "ratio", "thickness"), [(0.4, 0.2, 7e-3), (0.4, 1.0, 7e-3), (0.32, 0.6, 5e-3)])
def test_on_a_shape_it_never_saw_it_is_near_fem_and_nearer_than_the_linear_response(
    nu: float, ratio: float, thickness: float
) -> None:
    layer = limb(nu, thickness)
    load = pad(layer, ratio)
    truth = PatchFem(refine=1).prepare(layer).solve(load)
    answer = MomentNet().prepare(layer).solve(load)
    ours = score(answer.displacement, truth.displacement, layer, load)
    linear = score(Linear().prepare(layer).solve(load).displacement, truth.displacement, layer, load)
    assert answer.trust.ok, answer.trust.why
    assert ours.mee_share < 0.01 and ours.much < 0.03 * ours.peak and abs(ours.peak_share) < 0.03
    assert ours.mee < linear.mee and ours.much < linear.much


def test_the_bound_says_how_far_off_it_is(net: MomentNet) -> None:
    layer, inside, loose = limb(), [], []
    fem = PatchFem(refine=1).prepare(layer)
    for ratio, radius in ((0.1, 0.009), (0.3, 0.016), (0.6, 0.012), (0.9, 0.02), (1.3, 0.01)):
        load = pad(layer, ratio, radius)
        answer = net.solve(load)
        worst = np.linalg.norm(answer.displacement - fem.solve(load).displacement, axis=1).max()
        assert answer.trust.error_bound is not None
        inside.append(worst <= answer.trust.error_bound)
        loose.append(answer.trust.error_bound / worst)
    assert sum(inside) >= 4 and np.median(loose) < 8  # it was fitted on arms, whose meshes are less even


@pytest.mark.parametrize(
    ("layer", "ratio", "word"),
    [(limb(), 4.0, "p_over_e"), (limb(0.2), 0.3, "poisson"), (limb(thickness=1e-3), 0.3, "thickness"),
     (limb(), -0.3, "pulls")],
)  # fmt: skip
def test_out_of_range_is_flagged_and_without_a_bound(layer: SoftLayer, ratio: float, word: str) -> None:
    trust = MomentNet().prepare(layer).solve(pad(layer, ratio)).trust
    assert not trust.in_range and word in trust.why and trust.error_bound is None


@pytest.mark.parametrize(("name", "fine"), [("even", True), ("slope", True), ("steep", False), ("step", False),
                                           ("rough", False)])  # fmt: skip
def test_a_thickness_that_changes_faster_than_was_learnt_is_flagged(name: str, fine: bool) -> None:
    even = limb()
    along = even.vertices[:, 2] - 0.08
    rough = np.random.default_rng(0).uniform(5e-3, 10e-3, len(along))
    thickness = {"even": 0 * along + T, "slope": T + 0.05 * along, "steep": np.clip(T + 0.4 * along, 2.5e-3, 0.0124),
                 "step": T + 3e-3 * np.tanh(along / 2e-3), "rough": rough}[name]  # fmt: skip
    layer = SoftLayer(even.vertices, even.faces, thickness)
    trust = MomentNet().prepare(layer).solve(pad(layer, 0.3)).trust
    assert trust.in_range == fine and ("thickness changes" in trust.why) != fine


def odd_loads(layer: SoftLayer) -> dict[str, tuple[Load, bool]]:
    """Loads that no tool presses with, and whether they are within what the network may answer for."""
    rng, centre = np.random.default_rng(0), np.array([0.04, 0, 0.08])
    away = np.linalg.norm(layer.vertices - centre, axis=1)
    modulus, around, nothing = layer.tissue.youngs_modulus, away < 0.02, np.zeros(len(layer.vertices))
    needle, few, checkers, small, ring = (nothing.copy() for _ in range(5))
    needle[away.argmin()] = 1.0
    few[rng.choice(np.flatnonzero(layer.vertices[:, 2] % 0.14 > 0.03), 40, replace=False)] = 0.5
    checkers[around] = 0.6 * (rng.random(around.sum()) < 0.5)
    small[away < 6e-3] = 1.4
    ring[(away > 0.012) & (away < 0.018)] = 0.6
    odd = {"needle": (needle, False), "scattered": (few, False), "checkers": (checkers, True), "small": (small, True),
           "ring": (ring, True)}  # fmt: skip
    return {name: (Load.pressure(modulus * values), fine) for name, (values, fine) in odd.items()}


@pytest.mark.parametrize("name", ["needle", "scattered", "checkers", "small", "ring"])
def test_loads_unlike_any_tool_are_flagged_or_within_the_bound(net: MomentNet, name: str) -> None:
    layer = limb()
    load, fine = odd_loads(layer)[name]
    answer = net.solve(load)
    assert answer.trust.in_range == fine, answer.trust.why
    if fine:
        truth = PatchFem(refine=1).prepare(layer).solve(load)
        assert truth.trust.converged and answer.trust.error_bound is not None
        worst = np.linalg.norm(answer.displacement - truth.displacement, axis=1).max()
        assert worst < answer.trust.error_bound < 0.8 * np.linalg.norm(truth.displacement, axis=1).max()


def test_out_of_range_goes_to_the_next_method_which_says_so() -> None:
    layer = limb(0.2)
    load = pad(layer, 0.1)
    answer = MomentNet(fallback=PatchFem()).prepare(layer).solve(load)
    assert answer.method == PatchFem().name and "poisson" in answer.trust.why and answer.trust.converged
    np.testing.assert_allclose(answer.displacement, PatchFem().prepare(layer).solve(load).displacement)


def test_misuse_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotPrepared):
        MomentNet().solve(Load.zero(limb()))
    with pytest.raises(InvalidInput):
        MomentNet().prepare(limb()).solve(Load.pressure(np.zeros(3)))
    with pytest.raises(InvalidInput, match="no "):
        MomentNet(tmp_path / "none.safetensors")
    (tmp_path / "bad.json").write_text("{}")
    (tmp_path / "bad.safetensors").write_bytes(b"not weights")
    with pytest.raises(InvalidInput):
        MomentNet(tmp_path / "bad.safetensors")


def test_no_place_is_unseen_by_how_stiff_its_column_is_below() -> None:
    """Motion learns from bodies only: a tensed abdomen, softer below than most, would be flagged all over."""
    of_stacks, plain = Model(8, STACK_INPUTS), Model(8)
    for model in (of_stacks, plain):
        model.forget_stiffening()
    ends = [(w.arrays["least"], w.arrays["most"], w.arrays["low"]) for w in (of_stacks.weights({}), plain.weights({}))]
    free = np.isinf(ends[0][0])
    assert set(np.flatnonzero(free)) == {STACK_INPUTS.at.stiffening, STACK_INPUTS.at.stiffening + 1}
    assert (free == np.isinf(ends[0][1])).all() and np.isfinite(ends[0][2]).all() and np.isfinite(ends[1]).all()


def test_numba_and_torch_see_the_same_inputs() -> None:
    """Column by column of stmpl_core.networks.INPUTS, for anything that a vertex may feel."""
    torch.manual_seed(0)
    model, rng = Model(4), np.random.default_rng(0)
    parts = {name: rng.normal(size=(200, count)).astype(np.float32) for name, count in POINT.sizes.items()}
    parts["constants"][:] = 0.4, 1.0
    inputs, outside = np.empty((200, INPUTS.size), np.float32), np.zeros(200, np.bool_)
    mixed = model.mix_vectors.detach().numpy(), model.mix_tensors.detach().numpy()
    ends = [np.full(INPUTS.size, value, np.float32) for value in (-1e9, 1e9, -1e9, 1e9, 0.0, 1.0)]
    shape = np.concatenate([parts["curvature"], parts["slope"]], axis=1)
    more = np.empty((200, 0), np.float32)
    figures = parts["figures"].reshape(200, 2, -1)
    all_of = np.arange(200)
    invariants(all_of, figures, all_of, shape, parts["here"], parts["constants"][0], more, *mixed, *ends, inputs,
               outside)  # fmt: skip
    with torch.no_grad():
        want = model._inputs(torch.from_numpy(np.concatenate(POINT.in_order(**parts), axis=1)))[0].numpy()
    assert not outside.any()
    for name, columns in INPUTS.split(inputs).items():
        np.testing.assert_allclose(columns, INPUTS.split(want)[name], rtol=2e-4, atol=2e-5, err_msg=name)


def test_a_row_that_does_not_fit_its_layout_is_refused() -> None:
    with pytest.raises(InvalidInput, match="layout"):
        POINT.in_order(figures=np.zeros((3, 2)))


def test_the_method_computes_what_was_trained() -> None:
    """The same network in torch and in the compiled kernels, with random weights."""
    torch.manual_seed(1)
    model = Model(16)
    torch.nn.init.normal_(model.layers[-1].weight, std=0.1)  # type: ignore[arg-type]
    layer = limb()
    load = pad(layer, 0.7)
    near, sources = Surroundings(layer), source_fields(load.values, layer.tissue, load.loaded)
    felt = near.felt(sources)
    v = felt.vertices
    constants = np.tile([layer.tissue.poisson_ratio, 0.0], (len(v), 1))
    rows = POINT.in_order(figures=felt.figures.reshape(len(v), -1), curvature=near.curvature[v], slope=near.slope[v],
                          here=sources[v], constants=constants)  # fmt: skip
    points = torch.tensor(np.concatenate(rows, axis=1), dtype=torch.float32)
    model.normalise(points)
    with torch.no_grad():
        local = model(points)[0].numpy()
    answer = MomentNet(model.weights(MomentNet().weights.card)).prepare(layer).solve(load)
    want = np.einsum("nj,nji->ni", local * T, near.frames[v])
    np.testing.assert_allclose(answer.displacement[v], want, atol=2e-3 * np.abs(want).max())


def test_training_learns_and_goes_on_where_it_stopped(data: Path, tmp_path: Path) -> None:
    points = draw_points(Dataset.open(data), SETTINGS, lambda *_: None)
    for name in ("whole", "cut"):
        (tmp_path / name).mkdir()
    whole = fit(points, SETTINGS, tmp_path / "whole", lambda *_: None)
    original = torch.save
    saves = 0

    def save_and_stop(state: dict, path: Path) -> None:
        nonlocal saves
        original(state, path)
        saves += 1
        if saves == SETTINGS.steps // 2:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "save", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            fit(points, SETTINGS, tmp_path / "cut", lambda *_: None)
    resumed = fit(points, SETTINGS, tmp_path / "cut", lambda *_: None)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], value, msg=name)


def test_a_trained_network_comes_with_a_card_that_says_what_made_it(data: Path, tmp_path: Path) -> None:
    card = train_moments(data, tmp_path, SETTINGS)
    method = MomentNet(tmp_path / "moment_net.safetensors")
    assert method.weights.card == card and card["data"]["preset"] == "tiny" and card["settings"]["seed"] == 0
    assert {"commit", "machine", "versions", "ranges", "bound", "parameters"} <= set(card)
    sample = Dataset.open(data).split("test", kind="pressure")[0]
    assert method.prepare(sample.layer).solve(sample.load).displacement.any()


def test_what_training_saw_is_not_outside_however_it_mixed_its_inputs(data: Path, tmp_path: Path) -> None:
    """Mixing is learnt, so the inputs' ranges change: they are taken again, or all would be outside in the end."""
    settings = SETTINGS.model_copy(update={"steps": 600, "learning_rate": 2e-2, "checkpoint_minutes": 1e3})
    points = draw_points(Dataset.open(data), settings, lambda *_: None)
    rows = torch.from_numpy(points.rows)
    model = fit(points, settings, tmp_path, lambda *_: None)
    with torch.no_grad():
        inputs = model._inputs(rows)[0]
        outside = ((inputs < model.least) | (inputs > model.most)).any(dim=1)
        clamped = ((inputs < model.low) | (inputs > model.high)).any(dim=1)
    assert not outside.any() and clamped.float().mean() < 0.05


def test_no_function_is_compiled_under_a_name_that_another_one_has():
    """numba keeps compiled code by file, name and line: the parallel twin of a function was loaded in its stead."""
    kept: dict[CodeType, list[str]] = {}
    for package in (stmpl_core, fem_tools):
        for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            for name, one in vars(importlib.import_module(found.name)).items():
                if isinstance(one, Dispatcher) and one.__module__ == found.name:
                    kept.setdefault(one.py_func.__code__, []).append(f"{found.name}.{name}")
    assert len(kept) > 50
    assert not [names for names in kept.values() if len(names) > 1]
