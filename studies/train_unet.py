"""train_unet: the STMPL paper's network on a data set, on one processor, one GPU, or several under torchrun."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from safetensors.torch import save_file
from torch import Tensor, nn

from fem_tools.dataset import Dataset, Subset, data_card
from fem_tools.sampling import Kind, Split
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.pix2pix import Pix2PixUNet
from stmpl_core.methods.unet import MOTION, UNet, UNetCard, seen_in, square_chart
from stmpl_core.metrics import mean_and_deviation, score
from stmpl_core.provenance import commit, machine, versions
from studies.unet_samples import Images, Samples

THREE_BODIES = ("weight_0", "weight_50", "weight_100")  # beta_2 in {2, 0, -2}
BOUND = 0.95  # quantile of held-out errors that becomes the error bound
VERSIONS = ("stmpl", "torch", "numpy", "safetensors")

OnProgress = Callable[[int, int, str], None]  # steps done, steps in all, what to say of it


class UNetTraining(BaseModel):
    """What decides what is learnt. The defaults are the paper's; how long it trained and its seed are not known.

    Args:
        size, width, dropout: numbers of Pix2PixUNet.
        batch: samples a step, over all processes.
        learning_rate: learning rate of Adam.
        total_variation: weight of the mean absolute difference of neighbouring texels [mm], beside the mean square.
        epochs: number of times that every sample is seen.
        seed: seed of weights, order and dropout.
        bodies: bodies that are learnt from: all, or the three of the paper's second set-up.
        kind: kind of load: the paper's rule, unless another is named.
        highest_force: force at a vertex that is drawn as 1 [N]. The paper's 20 N suit its 17 mm mesh and loads that
            tissue of 1 kPa does not carry.
        checkpoint_minutes: time between two checkpoints [min].
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    size: int = 512
    width: int = Field(default=64, ge=1)
    dropout: float = Field(default=0.5, ge=0, lt=1)
    batch: int = Field(default=64, ge=1)
    learning_rate: float = Field(default=1e-4, gt=0)
    total_variation: float = Field(default=0.0, ge=0)
    epochs: int = Field(default=60, ge=1)
    seed: int = 0
    bodies: Literal["all", "three_bodies"] = "all"
    kind: Kind = "nodal"
    highest_force: float = Field(default=20.0, gt=0)
    checkpoint_minutes: float = Field(default=5.0, ge=0)

    @classmethod
    def reduced(cls, **changes: Any) -> Self:
        """What one CPU core trains in half an hour: a quarter of the resolution, a fifth of the width.

        Its forces are drawn for a mesh of 4 mm, where p/E = 0.4 at E = 1 kPa is some 4 mN a vertex: drawn as 20 N they
        are invisible beside the thickness, and it stays at the loss of a network that predicts zero.
        """
        return cls(**({"size": 128, "width": 12, "batch": 16, "learning_rate": 1e-3, "epochs": 16,
                       "highest_force": 1e-3} | changes))  # fmt: skip


@dataclass(frozen=True)
class Group:
    """The processes that train together: this one's number, how many there are, and where it computes."""

    rank: int
    world: int
    device: torch.device


def train_unet(
    data: str | Path, out: str | Path, settings: UNetTraining, *, on_progress: OnProgress | None = None
) -> dict[str, Any]:
    """Trains the paper's network, or goes on where an earlier run with these settings was stopped.

    Writes unet.safetensors (half precision) and its card unet.json into the folder `out`; until then, a checkpoint.
    Under torchrun each batch is shared among the processes, which learn what one process would (dropout aside).

    Args:
        data: folder of a finished data set, see `stmpl generate`.
        out: folder.
        settings: settings of the training.
        on_progress: function that is called after each sample that is read and each step, in the first process.

    Returns:
        The card, as a dictionary.

    Raises:
        InvalidInput: no data of that kind, layers with different charts, a batch that the processes cannot share, or
            `out` holds a run with other settings or data.
    """
    out, tell = Path(out), on_progress or (lambda *_: None)
    dataset = Dataset.open(data)
    origin = {"settings": settings.model_dump(mode="json"), "data": data_card(data, dataset.manifest)}
    if kept := _finished(out, origin):
        return kept
    with _group(settings) as group:
        if group.rank:
            tell = lambda *_: None  # noqa: E731
        started = time.monotonic()
        layers = _layers_of(dataset, settings)
        chart = square_chart(next(iter(layers.values())), settings.size)
        train, val = (Samples(_subset(dataset, settings, split), layers,
                              lambda done, every, split=split: tell(done, every, f"reading {split}"))
                      for split in ("train", "val"))  # fmt: skip
        learner = _Learner(settings, group, Images(chart, group.device), train, val)
        curve = learner.run(out / "checkpoint.pt", origin, tell)
        if group.rank:
            return {}
        seen = seen_in(list(layers.values()), settings.kind, train.peak_ratio)
        about = origin | {
            "parameters": sum(p.numel() for p in learner.network.parameters()),
            "training_samples": len(train),
            "curve": curve,
            "commit": commit(),
            "versions": versions(VERSIONS),
            "machine": _machine(group),
            "minutes_of_last_run": round((time.monotonic() - started) / 60, 1),
        }
        card = UNetCard(size=settings.size, width=settings.width, highest_force=settings.highest_force, seen=seen,
                        about=about)  # fmt: skip
        card = _write(out, learner.network, card, _subset(dataset, settings, "val"), tell)
        (out / "checkpoint.pt").unlink()
        return card.model_dump(mode="json")


class _Learner:
    """The network, its optimiser, and the loop."""

    def __init__(self, settings: UNetTraining, group: Group, images: Images, train: Samples, val: Samples) -> None:
        self.settings, self.group, self.images, self.train, self.val = settings, group, images, train, val
        self.batch = min(settings.batch, len(train) // group.world * group.world)
        if not self.batch or self.batch % group.world:
            raise InvalidInput(f"{group.world} processes cannot share batches of {self.batch} samples evenly. "
                               "Choose a batch that is a multiple of the processes.")  # fmt: skip
        torch.manual_seed(settings.seed)
        network = Pix2PixUNet(settings.size, settings.width, dropout=settings.dropout)
        self.network = network.to(group.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.parallel = nn.parallel.DistributedDataParallel(self.network) if group.world > 1 else self.network
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=settings.learning_rate)
        self.half = group.device.type == "cuda"
        self.scaler = torch.amp.GradScaler(group.device.type, enabled=self.half)

    def run(self, checkpoint: Path, origin: dict[str, Any], tell: OnProgress) -> list[dict[str, float]]:
        """All steps that are left; returns the losses of each epoch."""
        step, sums, curve = self._resume(checkpoint, origin)
        every = len(self.train) // self.batch
        steps, saved = every * self.settings.epochs, time.monotonic()
        while step < steps:
            epoch, place = divmod(step, every)
            sums += self._step(step, self._rows(epoch, place))
            step += 1
            if place == every - 1:
                curve.append({"train": self._mean(sums) / every, "val": self._validate()})
                sums = torch.zeros_like(sums)
            if self.group.rank == 0 and (time.monotonic() - saved) / 60 >= self.settings.checkpoint_minutes:
                self._save(checkpoint, origin, step, sums, curve)
                saved = time.monotonic()
            last = f", loss {curve[-1]['train']:.3g} mm2, held out {curve[-1]['val']:.3g} mm2" if curve else ""
            tell(step, steps, f"epoch {epoch + 1}/{self.settings.epochs}{last}")
        if self.group.rank == 0:
            self._save(checkpoint, origin, step, sums, curve)
        return curve

    def loss(self, answer: Tensor, target: Tensor) -> Tensor:
        """Mean square over the texels on the chart [mm2]; with a weight, plus the total variation over them [mm].

        In mm2, because the squares of images in which 30 mm are 1 have gradients as small as Adam's epsilon.
        """
        mask = self.images.mask
        answer, target = 1e3 * MOTION * answer, 1e3 * MOTION * target
        error = (((answer - target) * mask) ** 2).sum() / (len(answer) * 3 * mask.sum())
        if not self.settings.total_variation:
            return error
        down, right = mask[1:] & mask[:-1], mask[:, 1:] & mask[:, :-1]
        variation = (answer.diff(dim=2).abs() * down).sum() + (answer.diff(dim=3).abs() * right).sum()
        return error + self.settings.total_variation * variation / (len(answer) * 3 * (down.sum() + right.sum()))

    def _rows(self, epoch: int, place: int) -> Tensor:
        """This process's share of the batch at that place of an epoch; the few that fill no batch wait for the next."""
        generator = torch.Generator().manual_seed(_mixed(self.settings.seed, epoch))
        order = torch.randperm(len(self.train), generator=generator)
        return order[place * self.batch : (place + 1) * self.batch][self.group.rank :: self.group.world]

    def _step(self, step: int, rows: Tensor) -> Tensor:
        """One step of Adam; its loss. Its random numbers are its own, so that a resumed run repeats them."""
        torch.manual_seed(_mixed(self.settings.seed, step, self.group.rank))
        self.parallel.train()
        self.optimiser.zero_grad(set_to_none=True)
        inputs, targets = self.train.batch(rows, self.images, self.settings.highest_force)
        with torch.autocast(self.group.device.type, enabled=self.half, dtype=torch.float16):
            answer = self.parallel(inputs.contiguous(memory_format=torch.channels_last))
        loss = self.loss(answer.float(), targets)
        self.scaler.scale(loss).backward()
        self.scaler.step(self.optimiser)
        self.scaler.update()
        return loss.detach()

    @torch.inference_mode()
    def _validate(self) -> float:
        """The loss over the held-out contacts, without dropout."""
        if not len(self.val):
            return math.nan
        self.network.eval()
        total = torch.zeros((), device=self.group.device)
        for rows in torch.arange(self.group.rank, len(self.val), self.group.world).split(self.batch):
            inputs, targets = self.val.batch(rows, self.images, self.settings.highest_force)
            total += self.loss(self.network(inputs).float(), targets) * len(rows)
        return self._mean(total) * self.group.world / len(self.val)

    def _mean(self, value: Tensor) -> float:
        """Over the processes."""
        if self.group.world > 1:
            value = value.clone()
            torch.distributed.all_reduce(value)
        return float(value) / self.group.world

    def _save(self, path: Path, origin: dict[str, Any], step: int, sums: Tensor, curve: list[Any]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        state = {"origin": json.dumps(origin), "step": step, "sums": sums, "curve": curve,
                 "network": self.network.state_dict(), "optimiser": self.optimiser.state_dict(),
                 "scaler": self.scaler.state_dict()}  # fmt: skip
        beside = path.with_suffix(".tmp")
        torch.save(state, beside)
        beside.replace(path)

    def _resume(self, path: Path, origin: dict[str, Any]) -> tuple[int, Tensor, list[dict[str, float]]]:
        if not path.is_file():
            return 0, torch.zeros((), device=self.group.device), []
        state = torch.load(path, map_location=self.group.device, weights_only=True)
        _same(path, json.loads(state["origin"]), origin)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.scaler.load_state_dict(state["scaler"])
        return state["step"], state["sums"], state["curve"]


def _layers_of(dataset: Dataset, settings: UNetTraining) -> dict[str, SoftLayer]:
    """The layers that are trained on; one chart must serve them all."""
    subset = _subset(dataset, settings, "train")
    names = dict.fromkeys(subset.info(k)["body"] for k in range(len(subset)))
    if not names:
        raise InvalidInput(f"the data set holds no training samples of kind {settings.kind}.")
    layers = {name: dataset.layers[name] for name in names}
    first = next(iter(layers.values()))
    square_chart(first, settings.size)
    for name, layer in layers.items():
        if layer.faces.shape != first.faces.shape or not np.array_equal(layer.chart.uv, first.chart.uv):
            raise InvalidInput(f"body {name} has another chart than {next(iter(layers))}: an image network learns one "
                               "part of the body at a time.")  # fmt: skip
    return layers


def _subset(dataset: Dataset, settings: UNetTraining, split: Split) -> Subset:
    bodies = THREE_BODIES if settings.bodies == "three_bodies" else None
    return dataset.split(split, kind=settings.kind, bodies=bodies)


def _write(out: Path, network: nn.Module, card: UNetCard, val: Subset, tell: OnProgress) -> UNetCard:
    """Weights and card; the figures are of the weights as they were written."""
    weights = {name: tensor.detach().cpu().half().contiguous() for name, tensor in network.state_dict().items()}
    save_file(weights, out / "unet.safetensors.tmp")
    (out / "unet.safetensors.tmp").replace(out / "unet.safetensors")
    path = out / "unet.json"
    path.write_text(card.model_dump_json())
    figures, ratio = _figures(UNet(out / "unet.safetensors"), val, tell)
    card = card.model_copy(update={"error_ratio": ratio, "about": card.about | {"figures_on_val": figures}})
    path.write_text(json.dumps(card.model_dump(mode="json"), indent=1))
    return card


def _figures(method: UNet, val: Subset, tell: OnProgress) -> tuple[dict[str, float], float | None]:
    """Mean scores on held-out contacts, and the quantile of the largest error over (p / E) t."""
    scores, ratios, body = [], [], ""
    for k, (layer, load, truth, info) in enumerate(val):
        if info["body"] != body:
            method.prepare(layer)
            body = info["body"]
        answer = method.solve(load).displacement
        scores.append(score(answer, truth, layer, load))
        scale = load.peak_ratio(layer) * float(layer.thickness[load.loaded].max())
        ratios.append(float(np.linalg.norm(answer - truth, axis=1).max()) / scale)
        tell(k + 1, len(val), "scoring held-out contacts")
    if not scores:
        return {}, None
    return mean_and_deviation(scores)[0].row(), float(np.quantile(ratios, BOUND))


def _finished(out: Path, origin: dict[str, Any]) -> dict[str, Any] | None:
    """The card of a run that is done, or None. Raises InvalidInput if it is another run's."""
    path = out / "unet.json"
    if not path.is_file() or (out / "checkpoint.pt").is_file():
        return None
    card = json.loads(path.read_text())
    _same(path, {name: card["about"].get(name) for name in origin}, origin)
    return card


def _same(path: Path, kept: dict[str, Any], wanted: dict[str, Any]) -> None:
    differs = [f"{name} {was.get(name)} instead of {value.get(name)}"
               for part in wanted for was, value in [(kept.get(part) or {}, wanted[part])]
               for name in value if was.get(name) != value.get(name)]  # fmt: skip
    if differs:
        raise InvalidInput(f"{path} is of another run: {', '.join(differs)}. Choose another folder, or remove it.")


@contextmanager
def _group(settings: UNetTraining) -> Iterator[Group]:
    """Joins the processes that torchrun started; alone where it did not."""
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    cuda = torch.cuda.is_available()
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if cuda else torch.device("cpu")
    if settings.batch % world:
        raise InvalidInput(f"a batch of {settings.batch} cannot be shared evenly among {world} processes.")
    if cuda:
        torch.cuda.set_device(device)
    if world == 1:
        yield Group(rank, world, device)
        return
    torch.distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        yield Group(rank, world, device)
    finally:
        torch.distributed.destroy_process_group()


def _machine(group: Group) -> str:
    if group.device.type == "cuda":
        return f"{group.world} x {torch.cuda.get_device_name(group.device)}"
    return f"{machine()}, {group.world} x {torch.get_num_threads()} threads"


def _mixed(*numbers: int) -> int:
    """One seed from several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))
