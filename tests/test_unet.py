"""The paper's network: its size, its symmetries, and training that no kill and no second process changes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from fem_tools.dataset import Dataset
from stmpl_core import Load, SoftLayer
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput, NotPrepared
from stmpl_core.methods.pix2pix import Pix2PixUNet
from stmpl_core.methods.unet import MOTION, UNet, UNetCard, seen_in, square_chart
from studies.train_unet import UNetTraining, train_unet
from studies.unet_samples import Images, Samples
from tests.learning_data import small_data

QUICK = UNetTraining(size=32, width=2, batch=4, learning_rate=1e-3, epochs=3, highest_force=5e-3, checkpoint_minutes=0)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_data(tmp_path_factory)


@pytest.fixture(scope="module")
def run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    train_unet(data, out, QUICK)
    return out


@pytest.fixture(scope="module")
def arm() -> SoftLayer:
    return Body.anny(weight=0.5).part("left_arm", edge_length=6e-3)


@pytest.fixture(scope="module")
def drawn(arm: SoftLayer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of random weights with its card: laws that hold for any weights are tested on it."""
    path = tmp_path_factory.mktemp("drawn") / "unet.safetensors"
    torch.manual_seed(7)
    save_file(Pix2PixUNet(64, 4).state_dict(), path)
    card = UNetCard(size=64, width=4, highest_force=5e-3, seen=seen_in([arm], "nodal", 0.4), error_ratio=0.1)
    path.with_suffix(".json").write_text(card.model_dump_json())
    return path


def press(layer: SoftLayer, ratio: float) -> Load:
    """The paper's rule on a disc of 15 mm, at most this p/E."""
    middle = layer.vertices[np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin()]
    covered = np.linalg.norm(layer.vertices - middle, axis=1) < 0.015
    force = ratio * layer.tissue.youngs_modulus * layer.vertex_areas[covered].min()
    return Load.nodal(np.where(covered, force, 0.0))


def test_the_papers_network_has_67_million_parameters() -> None:
    with torch.device("meta"):
        network = Pix2PixUNet(512, 64)
        assert network(torch.zeros(1, 2, 512, 512)).shape == (1, 3, 512, 512)
    assert sum(p.numel() for p in network.parameters()) == 66_992_515


def test_every_texel_of_a_chart_hangs_on_every_other() -> None:
    """One texel at the bottom: the network sees the whole image at once, as pix2pix does."""
    torch.manual_seed(0)
    network = Pix2PixUNet(32, 4).eval()
    images = torch.zeros(1, 2, 32, 32, requires_grad=True)
    network(images + 0.5)[0, 0, 0, 0].backward()
    assert images.grad is not None and (images.grad != 0).float().mean() > 0.95


def test_a_network_that_halves_no_whole_number_of_times_is_refused() -> None:
    with pytest.raises(InvalidInput, match="powers of two"):
        Pix2PixUNet(48)


def test_the_chart_fills_a_square_with_the_part_in_its_middle(arm: SoftLayer) -> None:
    chart = square_chart(arm, 64)
    rows, columns = np.nonzero(chart.mask)
    assert chart.shape == (64, 64)
    assert max(np.ptp(rows), np.ptp(columns)) >= 64 - 2 * 3 - 2
    assert abs(rows.min() + rows.max() - 63) <= 3 and abs(columns.min() + columns.max() - 63) <= 3


def test_zero_load_gives_exactly_zero(arm: SoftLayer, drawn: Path) -> None:
    answer = UNet(drawn).prepare(arm).solve(Load.zero(arm))
    assert not answer.displacement.any() and answer.trust.ok


def test_only_force_over_modulus_matters(arm: SoftLayer, drawn: Path) -> None:
    soft, stiff = arm, arm.with_(youngs_modulus=37e3)
    answers = [UNet(drawn).prepare(layer).solve(press(layer, 0.2)) for layer in (soft, stiff)]
    assert np.abs(answers[0].displacement).max() > 1e-5
    np.testing.assert_allclose(answers[1].displacement, answers[0].displacement, rtol=0, atol=1e-9)
    assert answers[1].trust.error_bound == pytest.approx(answers[0].trust.error_bound)


def test_half_precision_moves_the_skin_as_whole_precision_does(arm: SoftLayer, drawn: Path) -> None:
    load = press(arm, 0.3)
    whole, half = (UNet(drawn, half=half).prepare(arm).solve(load).displacement for half in (False, True))
    assert 0 < np.abs(half - whole).max() < 0.02 * np.abs(whole).max()


@pytest.mark.parametrize("device", ["nope", "meta", None])
def test_a_device_that_there_is_not_is_said(drawn: Path, device: str) -> None:
    with pytest.raises(InvalidInput, match="torch has no device"):
        UNet(drawn, device=device)


def test_what_needs_a_gpu_is_refused_without_one(drawn: Path) -> None:
    with pytest.raises(InvalidInput, match="graph of CUDA was asked for on cpu"):
        UNet(drawn, graph=True)
    if not torch.cuda.is_available():
        with pytest.raises(InvalidInput, match="sees no CUDA device"):
            UNet(drawn, device="cuda", graph=True)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_recorded_graph_answers_each_load_as_its_kernels_do(arm: SoftLayer, drawn: Path) -> None:
    one, other = (UNet(drawn, device="cuda", half=True, graph=graph).prepare(arm) for graph in (False, True))
    for ratio in (0.1, 0.3):
        load = press(arm, ratio)
        true = one.solve(load).displacement
        assert np.abs(other.solve(load).displacement - true).max() < 1e-3 * np.abs(true).max()


def test_a_pressure_acts_as_its_nodal_forces(arm: SoftLayer, drawn: Path) -> None:
    method, nodal = UNet(drawn).prepare(arm), press(arm, 0.2)
    force = np.linalg.norm(arm.vertex_area_vectors, axis=1)
    answer = method.solve(Load.pressure(nodal.values / force))
    np.testing.assert_allclose(answer.displacement, method.solve(nodal).displacement, atol=1e-12)
    assert answer.trust.error_bound is None and "kind" in answer.trust.why


def test_outside_what_it_has_seen_it_says_so(arm: SoftLayer, drawn: Path) -> None:
    assert UNet(drawn).prepare(arm).solve(press(arm, 0.35)).trust.error_bound == pytest.approx(0.1 * 0.35 * 7.5e-3)
    thigh = Body.anny(weight=0.5).part("left_thigh", edge_length=6e-3)
    fine = Body.anny(weight=0.5).part("left_arm", edge_length=4e-3)
    for layer, ratio, why in ((arm, 0.6, "p/E is 0.6"), (arm.with_(thickness=12e-3), 0.2, "12 mm thick"),
                              (arm.with_(poisson_ratio=0.45), 0.2, "nu is 0.45"), (thigh, 0.2, "another part"),
                              (fine, 0.2, "edges are 4"), (arm, -0.2, "pulls")):  # fmt: skip
        trust = UNet(drawn).prepare(layer).solve(press(layer, ratio)).trust
        assert not trust.in_range and why in trust.why and trust.error_bound is None


def test_without_a_chart_or_a_layer_it_says_what_to_do(arm: SoftLayer, drawn: Path) -> None:
    with pytest.raises(InvalidInput, match=r"UvChart\(vertices, faces, uv\)"):
        UNet(drawn).prepare(arm.with_(chart=None))
    with pytest.raises(NotPrepared, match="prepare"):
        UNet(drawn).solve(Load.zero(arm))


def test_weights_without_a_card_or_with_anothers_are_refused(drawn: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="Train one"):
        UNet(tmp_path / "none.safetensors")
    path = tmp_path / "unet.safetensors"
    path.write_bytes(drawn.read_bytes())
    card = json.loads(drawn.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(card | {"width": 8}))
    with pytest.raises(InvalidInput, match="do not make a network"):
        UNet(path)
    path.write_bytes(b"\x80\x04")  # a pickle is no safetensors file
    with pytest.raises(InvalidInput, match="do not make a network"):
        UNet(path)


def test_importing_the_methods_imports_no_torch() -> None:
    code = "import sys, stmpl_core.methods.unet; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_images_on_a_device_are_the_charts_own(arm: SoftLayer) -> None:
    chart = square_chart(arm, 64)
    values = np.random.default_rng(0).normal(size=(2, len(arm.vertices), 3)).astype(np.float32)
    images = Images(chart, torch.device("cpu")).of(torch.from_numpy(values)).numpy()
    for image, value in zip(images, values, strict=True):
        np.testing.assert_allclose(image.transpose(1, 2, 0), chart.to_texels(value), atol=1e-5)


def test_training_draws_what_solving_draws(data: Path, run: Path) -> None:
    """The input of a batch is the input that UNet makes of the same sample; the target gives the truth back."""
    dataset, method = Dataset.open(data), UNet(run / "unet.safetensors")
    subset = dataset.split("train", kind="nodal", bodies=["weight_25"])
    samples = Samples(subset, {"weight_25": dataset.layers["weight_25"]}, lambda *_: None)
    chart = square_chart(dataset.layers["weight_25"], QUICK.size)
    inputs, targets = samples.batch(torch.arange(2), Images(chart, torch.device("cpu")), QUICK.highest_force)
    layer, load, truth, _ = subset[1]
    method.prepare(layer).solve(load)
    np.testing.assert_allclose(inputs[1].numpy(), method._images, atol=1e-3)
    target = MOTION * targets[1].numpy().transpose(1, 2, 0)
    np.testing.assert_allclose(target, chart.to_texels(truth), atol=1e-3 * np.abs(truth).max())


def test_loss_falls_and_the_card_tells_what_was_learnt(data: Path, run: Path) -> None:
    card = UNetCard.model_validate_json((run / "unet.json").read_text())
    curve = [epoch["train"] for epoch in card.about["curve"]]
    assert len(curve) == QUICK.epochs and curve[-1] < curve[0]
    dataset = Dataset.open(data)
    ratios = [s.load.peak_ratio(s.layer) for s in dataset.split("train", kind="nodal")]
    assert card.seen.peak_ratio == pytest.approx(max(ratios)) and card.about["training_samples"] == len(ratios)
    assert card.seen.thickness == (6.25e-3, 7.5e-3) and card.error_ratio is not None
    assert card.about["settings"] == QUICK.model_dump(mode="json") and not (run / "checkpoint.pt").exists()


def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(data: Path, run: Path, tmp_path: Path) -> None:
    class Stopped(Exception):
        pass

    def stop(done: int, every: int, what: str) -> None:
        if what.startswith("epoch 2") and done == every // 2:
            raise Stopped

    with pytest.raises(Stopped):
        train_unet(data, tmp_path, QUICK, on_progress=stop)
    steps = []
    card = train_unet(data, tmp_path, QUICK, on_progress=lambda done, _, what: steps.append((done, what)))
    trained = [done for done, what in steps if what.startswith("epoch")]
    assert trained[0] > 1 and len(trained) < trained[-1]
    through = json.loads((run / "unet.json").read_text())["about"]["curve"]
    for stopped, whole in zip(card["about"]["curve"], through, strict=True):  # convolutions round as memory lies
        assert stopped["train"] == pytest.approx(whole["train"], rel=0.15)
    assert train_unet(data, tmp_path, QUICK) == card  # done already: nothing to do
    with pytest.raises(InvalidInput, match="seed 0 instead of 1"):
        train_unet(data, tmp_path, QUICK.model_copy(update={"seed": 1}))


@pytest.mark.slow
def test_two_processes_learn_what_one_learns(data: Path, tmp_path: Path) -> None:
    settings = QUICK.model_copy(update={"dropout": 0.0, "epochs": 2})
    train_unet(data, tmp_path / "one", settings)
    program = tmp_path / "train.py"
    program.write_text("from studies.train_unet import UNetTraining, train_unet\n"
                       f"settings = UNetTraining.model_validate_json({settings.model_dump_json()!r})\n"
                       f"train_unet({str(data)!r}, {str(tmp_path / 'two')!r}, settings)\n")  # fmt: skip
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", str(program)]
    done = subprocess.run(command, capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1"})  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    # Not weight by weight: Adam takes a whole step along a gradient of nothing, whichever sign rounding gives it.
    curves = [json.loads((tmp_path / x / "unet.json").read_text())["about"]["curve"] for x in ("one", "two")]
    for one, two in zip(*curves, strict=True):
        assert two["train"] == pytest.approx(one["train"], rel=0.1)
        assert two["val"] == pytest.approx(one["val"], rel=0.15)


def test_batches_that_cannot_be_shared_and_data_that_are_not_there_are_refused(data: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no training samples of kind indenter"):
        train_unet(data, tmp_path, QUICK.model_copy(update={"kind": "indenter"}))
    with pytest.raises(InvalidInput, match="unknown body 'weight_0'"):
        train_unet(data, tmp_path, QUICK.model_copy(update={"bodies": "three_bodies"}))
