"""train_moments: MomentNet on a data set: points drawn from samples, a small network, a bound from held-out ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from fem_tools.dataset import LOADS, Dataset, Sample, data_card
from fem_tools.sampling import Kind
from stmpl_core.contact import Contact
from stmpl_core.contact_net import ContactNet
from stmpl_core.green import Green
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.moment_net import (
    AMPLITUDE,
    SURROUNDED,
    MomentNet,
    of_stack,
    source_fields,
    take_linear,
    unit_of,
)
from stmpl_core.moments import Surroundings
from stmpl_core.networks import (
    DIRECTIONS,
    INPUTS,
    MIXED_TENSORS,
    MIXED_VECTORS,
    MOTION,
    ON_STACK,
    POINT,
    STACK_INPUTS,
    STACK_POINT,
    Layout,
    Weights,
)
from stmpl_core.provenance import commit, machine, versions
from stmpl_core.response import SCALARS, TENSORS, VECTORS, WIDTH
from stmpl_core.stick import stuck_motion
from stmpl_core.toucher import Toucher
from studies.pressed import STRAIGHT, pressed, slant_of

VERSIONS = ("stmpl", "torch", "numpy", "numba", "safetensors")
AGAIN = 500  # steps, in the first half of them, after which the inputs' ranges are taken again: mixing changes them
TYPICAL = 1e-3  # of the peak: errors below count as squares in the loss
COVERED = 0.95  # share of validation answers whose largest error the stated bound must reach
STUCK_FROM = 0.04  # depth over thickness from which finite elements have taken enough steps for skin to stick
MARGIN = 1.3  # on that bound, for limbs and shapes unlike the validation data

OnProgress = Callable[[int, int, str], None]  # done, in all, what to say of it


class MomentTraining(BaseModel):
    """What decides what is learnt.

    Args:
        hidden: width of each of the three hidden layers.
        kinds: kinds of load; rigid tools that stick also pull along the skin, so they have networks of their own.
        stick: choice to learn what is left of the motion where that of skin that sticks is known in the linear response
            (stmpl_core.stick), under the pressure that the contact law says.
        points: vertices drawn of each sample, most from where it moves.
        steps, batch, learning_rate: numbers of Adam, the rate rising to this and falling in one cycle.
        weight_decay: weight decay of AdamW.
        seed: seed of weights, points and order.
        checkpoint_minutes: time between two checkpoints [min].
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    hidden: int = Field(default=96, ge=4)
    kinds: tuple[Kind, ...] = ("pressure", "nodal")
    stick: bool = False
    points: int = Field(default=128, ge=8)
    steps: int = Field(default=40_000, ge=20)
    batch: int = Field(default=2048, ge=8)
    learning_rate: float = Field(default=4e-3, gt=0)
    weight_decay: float = Field(default=1e-5, ge=0)
    seed: int = 0
    checkpoint_minutes: float = Field(default=5.0, ge=0)


@dataclass(frozen=True, eq=False)
class Points:
    """Vertices of samples: what each feels, and how it moves.

    Args:
        rows: figures of each vertex, laid out as POINT, (N, POINT.size) float32.
        motion: displacement over the local thickness in the vertex's frame, (N, 3) float32 [-].
        weight: local thickness over the sample's largest displacement, (N,) float32.
        light: rows of contacts just begun, (M, POINT.size) float32: finite elements do not know them well enough to be
            learnt from, but they are within what a network may be asked; there the linear motion is nearly all.
    """

    rows: np.ndarray
    motion: np.ndarray
    weight: np.ndarray
    light: np.ndarray


def draw_points(data: Dataset, settings: MomentTraining, on_progress: OnProgress, law: Weights | None = None) -> Points:
    """Points of the training split, as many of each sample as the settings say; law: see `as_asked`."""
    rng = np.random.default_rng(settings.seed)
    subsets = [data.split("train", kind=kind) for kind in settings.kinds]
    total, done = sum(map(len, subsets)), 0
    rows = np.empty((total * settings.points, (STACK_POINT if stacked(data) else POINT).size), np.float32)
    motion, weight = np.empty((len(rows), 3), np.float32), np.empty(len(rows), np.float32)
    end, near, last, light = 0, None, None, [np.empty((0, rows.shape[1]), np.float32)]
    for subset in subsets:
        for sample in as_asked(subset, stacked(data), settings.stick, law):
            if near is None or sample.layer is not last:
                near, last = Surroundings.of(sample.layer), sample.layer
            row, moved, scale = _points(near, sample.layer, sample.load, sample.displacement, settings.points, rng)
            done += 1
            if settings.stick and sample.info["ratio"] < STUCK_FROM:
                light.append(row.astype(np.float32))
                continue
            here = slice(end, end := end + len(row))
            rows[here], motion[here], weight[here] = row, moved, scale
            if done % 50 == 0 or done == total:
                on_progress(done, total, "drawing points")
    return Points(rows[:end], motion[:end], weight[:end], np.concatenate(light))


def stacked(data: Dataset) -> bool:
    """Whether a data set is of stacks, or of columns that run to bone."""
    return all(layer.stacked for layer in data.layers.values())


def as_asked(samples: Iterable[Sample], stacks: bool, stick: bool, law: Weights | None) -> Iterable[Sample]:
    """Samples with the load that their network is asked about.

    Args:
        samples: samples of a data set.
        stacks: truth of the claim that they are of stacks.
        stick: see MomentTraining.
        law: network of the contact law that says the pressure where `stick` is chosen; None: the one that ships.
    """
    return stuck(samples) if stacks else laid(samples, law) if stick else samples


def laid(samples: Iterable[Sample], law: Weights | None) -> Iterator[Sample]:
    """Contacts of samples with the pressure and the linear motion that follow from their poses."""
    toucher = None
    for one in pressed(samples):
        layer = one.sample.layer
        if toucher is None or toucher.layer is not layer:
            toucher = Toucher(layer)
            toucher.net = ContactNet(layer, law, toucher.near)
        toucher.tools.add(one.tool, one.field)
        (touch,) = toucher.touch_all([Contact(one.tool, one.pose)])
        if touch.pressed is None or touch.pressure is None or not touch.force > 0:
            continue
        told = replace(touch, pressed=touch.pressed._replace(way=one.way))
        motion = stuck_motion(Green.of(layer), [told])
        yield one.sample._replace(load=Load.contact(touch.pressure / touch.pressed.factor, motion))


def stuck(samples: Iterable[Sample]) -> Iterator[Sample]:
    """Contacts of samples that came straight and not just now, with the motion of what sticks to their tools."""
    for one in pressed(samples):
        if slant_of(one.sample) <= STRAIGHT and one.sample.info["ratio"] >= STUCK_FROM and len(one.nodes.area):
            layer, load = one.sample.layer, one.sample.load
            yield one.sample._replace(load=Load.contact(load.values, stuck_motion(Green.of(layer), [one.touch])))


def _points(near: Surroundings, layer: SoftLayer, load: Load, displacement: np.ndarray, count: int,
            rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    unit = unit_of(Green.of(layer)) if layer.stacked else layer.tissue
    sources = source_fields(load.pressure_on(layer), unit, load.loaded)
    felt = near.felt(sources)
    if load.motion is not None:
        take_linear(felt.figures, near, felt.vertices, load.motion)
    surrounded = np.flatnonzero(np.abs(felt.scalars[:, 1]).sum(axis=1) > SURROUNDED)  # nothing is learnt elsewhere
    v, length = felt.vertices[surrounded], np.linalg.norm(displacement, axis=1)
    peak = float(length.max())
    likely = np.where(length[v] > 1e-6, 1.0, 0.02) + 3 * (length[v] > 0.1 * peak) + 2 * (sources[v, 0] > 0)
    chosen = rng.choice(len(v), min(count, len(v)), replace=False, p=likely / likely.sum())
    v = v[chosen]
    figures = felt.figures[surrounded[chosen]].reshape(len(v), -1)
    constants = np.broadcast_to([layer.tissue.poisson_ratio, load.kind == "nodal"], (len(v), 2))
    rows = POINT.in_order(figures=figures, curvature=near.curvature[v], slope=near.slope[v], here=sources[v],
                          constants=constants)  # fmt: skip
    if layer.stacked and load.motion is not None:
        rows.append(of_stack(Green.of(layer), v, float(np.linalg.norm(load.motion, axis=1).max())))
    local = np.einsum("nij,nj->ni", near.frames[v], displacement[v]) / near.thickness[v, None]
    return np.concatenate(rows, axis=1), local, near.thickness[v] / peak


class Layers(nn.Module):
    """The layers of a network, which keep their inputs within what they were trained on.

    Args:
        hidden: width of each hidden layer.
        reads: layout of the inputs.
        says: layout of what the last layer says.
    """

    def __init__(self, hidden: int, reads: Layout, says: Layout) -> None:
        super().__init__()
        ends = (reads.size, hidden), (hidden, hidden), (hidden, hidden), (hidden, says.size)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in ends)
        nn.init.zeros_(self.layers[-1].weight)  # type: ignore[arg-type]
        nn.init.zeros_(self.layers[-1].bias)  # type: ignore[arg-type]
        for name, value in (("low", -1.0), ("high", 1.0), ("mean", 0.0), ("scale", 1.0)):
            self.register_buffer(name, torch.full((reads.size,), value))

    def take_range(self, inputs: Tensor) -> None:
        """Takes the range and the spread of each input from examples (N, inputs)."""
        with torch.no_grad():
            self.low, self.high = _range(inputs)
            self.mean, self.scale = inputs.mean(dim=0), 1 / (inputs.std(dim=0) + 1e-6)

    def think(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """The last layer, (N, outputs), and its last column once more, learnt without bending the others."""
        h = (torch.minimum(torch.maximum(inputs, self.low), self.high) - self.mean) * self.scale
        for layer in self.layers[:-1]:  # type: ignore[index]
            h = layer(h)
            h = h * (0.5 + 0.5 * h / (1 + h.abs()))
        last: Any = self.layers[-1]
        return last(h), last.weight[-1] @ h.detach().T + last.bias[-1]

    def weights(self, card: dict[str, Any]) -> Weights:
        """What the method loads."""
        own = [name for name, _ in self.named_parameters() if not name.startswith("layers")]
        own += [name for name, _ in self.named_buffers(remove_duplicate=False)]
        arrays = {name: getattr(self, name).detach().numpy().copy() for name in own}
        for k, layer in enumerate(self.layers, start=1):
            arrays[f"w{k}"] = np.ascontiguousarray(layer.weight.detach().numpy().T)  # type: ignore[union-attr]
            arrays[f"b{k}"] = layer.bias.detach().numpy().copy()  # type: ignore[union-attr]
        return Weights(arrays, card)


def _range(inputs: Tensor) -> tuple[Tensor, Tensor]:
    low, high = inputs.amin(dim=0), inputs.amax(dim=0)
    return low - 0.02 * (high - low), high + 0.02 * (high - low)


class Model(Layers):
    """The network of stmpl_core.methods.moment_net, in torch: the same inputs, with gradients.

    Args:
        hidden: width of each hidden layer.
        reads: INPUTS or STACK_INPUTS.
    """

    def __init__(self, hidden: int, reads: Layout = INPUTS) -> None:
        super().__init__(hidden, reads, MOTION)
        self.known = STACK_POINT if reads is STACK_INPUTS else POINT
        self.mix_vectors = nn.Parameter(torch.randn(MIXED_VECTORS, DIRECTIONS) / DIRECTIONS**0.5)
        self.mix_tensors = nn.Parameter(torch.randn(MIXED_TENSORS, 2 * TENSORS) / (2 * TENSORS) ** 0.5)
        self.register_buffer("least", self.low.clone())
        self.register_buffer("most", self.high.clone())

    def normalise(self, rows: Tensor) -> None:
        """Takes the inputs' ranges and spreads from points (N, POINT.size)."""
        with torch.no_grad():
            self.take_range(self._inputs(rows)[0])
            self.least, self.most = self.low, self.high

    def take_seen(self, rows: Tensor) -> None:
        """Takes the inputs' ranges from points (N, POINT.size) again, as the training now mixes them."""
        with torch.no_grad():
            self.least, self.most = _range(torch.cat([self._inputs(some)[0] for some in rows.split(100_000)]))
            self.low, self.high = self.least, self.most

    def forget_stiffening(self) -> None:
        """Takes no place for one that training did not see by how stiff the column is below: few stacks were learnt."""
        if self.known is STACK_POINT:
            self.least, self.most = self.least.clone(), self.most.clone()
            for end, free in ((self.least, -torch.inf), (self.most, torch.inf)):
                STACK_INPUTS.split(end[None])["stiffening"][:] = free

    def _inputs(self, rows: Tensor) -> tuple[Tensor, ...]:
        known = self.known.split(rows)
        fields = known["figures"].view(-1, 2, WIDTH)
        xx, xy, yy = known["curvature"].T
        slope, here, constants = known["slope"], known["here"], known["constants"]
        a, b = 3 + SCALARS, 3 + SCALARS + 2 * VECTORS
        scalars = fields[:, :, 3:a]
        g = scalars[:, 1].abs().sum(dim=1, keepdim=True).clamp_min(1e-9)
        vectors = fields[:, :, a:b].unflatten(2, (2, VECTORS)).transpose(2, 3).flatten(1, 2)
        vectors = torch.cat([vectors, fields[:, :, :2]], dim=1) / g[:, :, None]
        tensors = fields[:, :, b : b + 2 * TENSORS].unflatten(2, (2, TENSORS)).transpose(2, 3).flatten(1, 2)
        tensors = tensors / g[:, :, None]
        v = torch.einsum("nci,dc->ndi", vectors, self.mix_vectors)
        t = torch.einsum("nci,dc->ndi", tensors, self.mix_tensors)
        iv, it = torch.triu_indices(MIXED_VECTORS, MIXED_VECTORS), torch.triu_indices(MIXED_TENSORS, MIXED_TENSORS)
        products = torch.einsum("nai,nbi->nab", v, v)[:, iv[0], iv[1]]
        tensor_products = torch.einsum("nai,nbi->nab", t, t)[:, it[0], it[1]]
        bent = torch.stack([(xx - yy) / 2, xy], dim=1)
        turned, curved = _act(t, v[:, :MIXED_TENSORS]), _act(bent[:, None], v)
        inputs = INPUTS.in_order(
            scalars=scalars.flatten(1) / g,
            linear_normal=fields[:, :, 2] / g,
            here=here / g,
            log_here=torch.log(here.abs() + 0.02),
            log_g=torch.log(g + 1e-4),
            g=g,
            root_g=torch.sqrt(g),
            field_difference=scalars[:, 0] - scalars[:, 1],
            vector_products=products,
            tensor_products=tensor_products,
            tensor_along_vector=(turned * v[:, :MIXED_TENSORS]).sum(-1),
            tensor_along_curvature=torch.einsum("ni,nci->nc", bent, t),
            curvature_along_vector=(curved * v).sum(-1),
            slope_along_vector=torch.einsum("ni,nci->nc", slope, v),
            mean_curvature=((xx + yy) / 2)[:, None],
            squared_bend=(bent**2).sum(1, keepdim=True),
            constants=constants,
            volumetric=1 / (1.02 - 2 * constants[:, :1]),
            squared_slope=(slope**2).sum(1, keepdim=True),
        )
        inputs += [known[name] for name in ON_STACK if name in known]
        return torch.cat(inputs, dim=1), g, vectors, turned, curved, slope, fields[:, 1, :3]

    def forward(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Motion over thickness in the vertex's frame (N, 3), and log of the error to expect of it over g (N,)."""
        inputs, g, vectors, turned, curved, slope, prior = self._inputs(rows)
        out, doubt = self.think(inputs)
        say = MOTION.split(out)
        coefficients = torch.cat([say["directions"], say["turned"], say["curved"]], dim=1)[:, :, None]
        directions = torch.cat([vectors, turned, curved], dim=1)
        along = (coefficients * directions).sum(dim=1) + say["slope"] * slope
        a = AMPLITUDE * g / (1 + g)
        log_error = doubt + torch.log(a[:, 0].detach())
        return prior + a * torch.cat([along, say["normal"]], dim=1), log_error


def _act(tensors: Tensor, vectors: Tensor) -> Tensor:
    """Traceless tensors (..., 2) as (cos 2a, sin 2a) times vectors (..., 2)."""
    x, y = vectors[..., 0], vectors[..., 1]
    return torch.stack([tensors[..., 0] * x + tensors[..., 1] * y, tensors[..., 1] * x - tensors[..., 0] * y], dim=-1)


def fit(points: Points, settings: MomentTraining, out: Path, on_progress: OnProgress) -> Model:
    """Trains on points; a checkpoint in `out` lets a run that was stopped go on, to the same weights."""
    torch.manual_seed(settings.seed)
    model = Model(settings.hidden, STACK_INPUTS if points.rows.shape[1] == STACK_POINT.size else INPUTS)
    rows, motion, weight = (torch.from_numpy(a) for a in (points.rows, points.motion, points.weight))
    some = torch.randperm(len(rows))[:1_000_000]
    model.normalise(rows[some])
    optimiser = torch.optim.AdamW(model.parameters(), lr=settings.learning_rate,
                                  weight_decay=settings.weight_decay)  # fmt: skip
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=settings.steps, pct_start=0.1
    )
    checkpoint, first, mean = out / "moment_net.checkpoint", 0, 0.0
    if checkpoint.is_file():
        kept = torch.load(checkpoint, weights_only=True)
        if kept["settings"] == settings.model_dump_json() and kept["points"] == list(rows.shape):
            model.load_state_dict(kept["model"])
            optimiser.load_state_dict(kept["optimiser"])
            schedule.load_state_dict(kept["schedule"])
            first, mean = kept["step"], kept["mean"]
    saved = time.monotonic()
    for step in range(first, settings.steps):
        if step % AGAIN == 0 and step <= settings.steps // 2:
            model.take_seen(rows[some[:100_000]])
        draw = torch.Generator().manual_seed((settings.seed << 32) + step)
        k = torch.randint(len(rows), (settings.batch,), generator=draw)
        moved, log_error = model(rows[k])
        error = (moved - motion[k]).norm(dim=1)
        loss = torch.sqrt((error * weight[k]) ** 2 + TYPICAL**2).mean()
        missed = torch.log(error.detach() + 1e-6) - log_error
        optimiser.zero_grad()
        (loss + 0.01 * torch.maximum(0.9 * missed, -0.1 * missed).mean()).backward()
        nn.utils.clip_grad_norm_(model.parameters(), 0.1)
        optimiser.step()
        schedule.step()
        mean = loss.item() if step == 0 else 0.99 * mean + 0.01 * loss.item()
        if (step + 1) % 100 == 0 or step + 1 == settings.steps:
            on_progress(step + 1, settings.steps, f"error {mean:.2%} of the peak")
        if time.monotonic() - saved > 60 * settings.checkpoint_minutes:
            state = {"settings": settings.model_dump_json(), "points": list(rows.shape), "step": step + 1, "mean": mean,
                     "model": model.state_dict(), "optimiser": optimiser.state_dict(),
                     "schedule": schedule.state_dict()}  # fmt: skip
            torch.save(state, checkpoint.with_suffix(".tmp"))
            checkpoint.with_suffix(".tmp").replace(checkpoint)
            saved = time.monotonic()
    low, high = model.low, model.high
    model.take_seen(torch.cat([rows, torch.from_numpy(points.light)]))
    model.low, model.high = low, high
    model.forget_stiffening()
    return model


def train_moments(
    data: str | Path,
    out: str | Path,
    settings: MomentTraining | None = None,
    *,
    name: str = "moment_net",
    law: Weights | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Trains a MomentNet on a data set, and writes out/`name`.safetensors with its card `name`.json.

    Args:
        data: folder of a finished data set (stmpl generate).
        out: folder; what it holds of the same run is used again.
        settings: settings of the training; None: the defaults.
        name: name of the files.
        law: see `as_asked`.
        on_progress: function that is called often.

    Returns:
        The card.

    Raises:
        InvalidInput: no finished data set.
    """
    settings, said = settings or MomentTraining(), on_progress or (lambda *_: None)
    source, out = Dataset.open(data), Path(out)
    out.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    points = draw_points(source, settings, said, law)
    model = fit(points, settings, out, said)
    card = training_card(data, source, settings, model, _ranges(source, settings), points=len(points.rows))
    card["minutes"] = round((time.monotonic() - started) / 60, 1)
    weights = model.weights(card)
    card["bound"] = calibrate(source, weights, settings, said, law)
    weights.save(out / f"{name}.safetensors")
    (out / "moment_net.checkpoint").unlink(missing_ok=True)
    return card


def training_card(data: str | Path, source: Dataset, settings: BaseModel, model: Layers, ranges: dict[str, list[float]],
                  **counts: int) -> dict[str, Any]:  # fmt: skip
    """What made a network: the card beside its weights, but for its bound and the minutes that it took.

    Args:
        data: folder of the data set.
        source: data set.
        settings: settings of the training.
        model: trained network.
        ranges: smallest and largest of what was trained on, by name.
        counts: numbers of what was trained on, by name.
    """
    return {
        "format": 1,
        "data": data_card(data, source.manifest),
        "settings": settings.model_dump(mode="json"),
        "parameters": sum(p.numel() for p in model.parameters()),
        **counts,
        "ranges": ranges,
        "bound": {"factor": 1.0},
        "commit": commit(),
        "versions": versions(VERSIONS),
        "machine": f"{machine()}; {torch.get_num_threads()} threads",
    }


def _ranges(data: Dataset, settings: MomentTraining) -> dict[str, list[float]]:
    """What was trained on, smallest and largest."""
    trained = {name: layer for name, layer in data.layers.items() if len(data.split("train", bodies=[name]))}
    t = np.concatenate([layer.thickness for layer in trained.values()])
    nu = [layer.tissue.poisson_ratio for layer in trained.values()]
    edges = [layer.edge_length / Surroundings.of(layer).thickness for layer in trained.values()]
    out = {
        "poisson_ratio": [min(nu), max(nu)],
        "thickness_mm": [1e3 * float(t.min()), 1e3 * float(t.max())],
        "edge_over_thickness": [float(min(e.min() for e in edges)), float(max(e.max() for e in edges))],
    }
    for kind, load in LOADS.items():
        subset = data.split("train", kind=kind)
        highest = 0.0
        for sample in (subset[k] for k in range(len(subset))):
            layer, ratio = sample.layer, sample.load.peak_ratio(sample.layer)
            if layer.stacked:
                ratio *= layer.tissue.youngs_modulus / unit_of(Green.of(layer)).youngs_modulus
            highest = max(highest, ratio)
        out[f"p_over_e_{load}"] = [0.0, round(highest, 4) if kind in settings.kinds else 0.0]
    return out


def calibrate(data: Dataset, weights: Weights, settings: MomentTraining, on_progress: OnProgress,
              law: Weights | None = None, limit: int = 800) -> dict[str, float]:  # fmt: skip
    """The factor on the network's own expectation that covers the largest error of validation answers with a margin.

    Answers that the method itself flags are left out. Returns the factor, how many answers, and the median of bound
    over error.
    """
    subsets = [data.split("val", kind=kind) for kind in settings.kinds]
    method, layer, ratios = MomentNet(weights, contact=weights, stick=weights, stack=weights), None, []
    total = sum(map(len, subsets))
    for subset in subsets:
        some = (subset[k] for k in range(0, len(subset), max(1, total // limit)))
        for sample in as_asked(some, stacked(data), settings.stick, law):
            if settings.stick and sample.info["ratio"] < STUCK_FROM:
                continue
            if sample.layer is not layer:
                layer = sample.layer
                method.prepare(layer)
            answer = method.solve(sample.load)
            if answer.trust.in_range:
                worst = float(np.linalg.norm(answer.displacement - sample.displacement, axis=1).max())
                ratios.append(worst / max(answer.trust.figures["expected_error_m"], 1e-9))
        on_progress(len(ratios), max(1, min(total, limit)), "calibrating the bound")
    if not ratios:
        return {"factor": float("inf"), "answers": 0, "median_bound_over_error": float("nan")}
    factor = MARGIN * float(np.quantile(ratios, COVERED))
    looseness = float(np.median(factor / np.array(ratios)))
    return {"factor": factor, "answers": len(ratios), "median_bound_over_error": looseness}
