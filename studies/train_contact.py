"""train_contact: ContactNet on rigid tools that finite elements pressed in: squeeze of the columns to true pressure."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from fem_tools.dataset import Dataset, Sample, Subset
from fem_tools.press import Press
from fem_tools.sampling import tool_scene
from fem_tools.scenes import Site
from stmpl_core.arrays import Transform
from stmpl_core.columns import Columns, Squeeze
from stmpl_core.contact_net import MAX_LOG_RATIO, ContactNet
from stmpl_core.errors import InvalidInput
from stmpl_core.moments import Surroundings
from stmpl_core.networks import POINT, PRESSURE, Weights
from stmpl_core.sdf import SignedDistance
from studies.train_moments import Model, OnProgress, training_card

COVERED = 0.95  # share of validation contacts whose force the stated bound must reach
MARGIN = 1.3  # on that bound, for tools and limbs unlike the validation data
FORCE = 1.0  # weight of the force's error beside the pressure's
TYPICAL = 0.02  # of force and pressure: errors below count as squares in the loss


class ContactTraining(BaseModel):
    """What decides what is learnt.

    Args:
        hidden: width of each of the three hidden layers.
        steps, batch, learning_rate: numbers of AdamW, the batch in contacts; the rate rises to this and falls in one
            cycle.
        weight_decay: weight decay of AdamW.
        seed: seed of weights and order.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    hidden: int = Field(default=32, ge=4)
    steps: int = Field(default=3_000, ge=10)
    batch: int = Field(default=48, ge=4)
    learning_rate: float = Field(default=3e-3, gt=0)
    weight_decay: float = Field(default=1e-2, ge=0)
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Pressed:
    """One converged contact: where the tool is, how it squeezes, and the true pressure.

    Args:
        sample: sample of the data set.
        field: signed distance of the tool.
        pose: pose of the tool, (4, 4).
        squeeze: squeeze of the columns under it, see stmpl_core.columns.Squeeze.
        true: pressure over E at the squeezed vertices, (N,) [-].
        missed: share of the true force that acts on vertices that are not squeezed [-].
    """

    sample: Sample
    field: SignedDistance
    pose: Transform
    squeeze: Squeeze
    true: np.ndarray
    missed: float


def pressed(subset: Subset) -> Iterator[Pressed]:
    """The contacts of a subset, each with its tool built again where it stood."""
    layer = columns = site = last = None
    for sample in subset:
        if sample.info["set"] != "tool":
            continue
        if sample.layer is not layer:
            layer, columns, site = sample.layer, Columns(sample.layer), Site(sample.layer)
        assert columns is not None and site is not None
        if last is None or last[0] != (sample.info["body"], sample.info["number"]):
            scene = tool_scene(site, sample.info["drawn"])
            assert scene.tool is not None
            way = -scene.pose_body_from_tool[:3, 2]
            field = SignedDistance.of(scene.tool, rounding=scene.rounding)
            tool = Press(field, scene.pose_body_from_tool, way).touching(sample.layer)
            assert tool is not None
            last = (sample.info["body"], sample.info["number"]), tool, site.thickness_under(scene.pose_body_from_tool)
        _, tool, thickness = last
        pose = tool.at(sample.info["ratio"] * thickness).pose_body_from_tool
        squeeze = columns.squeezed(tool.field, pose)
        true = sample.load.values / sample.layer.tissue.youngs_modulus
        force = true * sample.layer.vertex_areas
        there = np.zeros(len(true), dtype=bool)
        there[squeeze.vertices] = True
        missed = float(force[~there].sum() / force.sum())
        yield Pressed(sample, tool.field, pose, squeeze, true[squeeze.vertices], missed)


@dataclass(frozen=True, eq=False)
class Rows:
    """Squeezed vertices of many contacts, one after the other.

    Args:
        rows: inputs of Model, laid out as stmpl_core.networks.POINT, (N, POINT.size) float32.
        prior, true: pressure over E, (N,) float32.
        area: area of the vertex over the sum of its contact's, (N,) float32 [-].
        starts: first row of each contact, and the end, (C + 1,).
    """

    rows: np.ndarray
    prior: np.ndarray
    true: np.ndarray
    area: np.ndarray
    starts: np.ndarray


def draw_rows(subset: Subset, on_progress: OnProgress) -> Rows:
    """What the network sees of every contact of a subset."""
    near, parts, starts, last = None, [], [0], None
    for k, one in enumerate(pressed(subset)):
        layer, squeeze = one.sample.layer, one.squeeze
        if near is None or last is not layer:
            near, last = Surroundings(layer), layer
        if not len(squeeze.vertices) or not one.true.any():
            continue
        v, n = squeeze.vertices, len(squeeze.vertices)
        sources = np.column_stack([squeeze.pressure, squeeze.strain])
        figures = near.felt_among(v, sources).figures.reshape(n, -1)
        constants = np.broadcast_to([layer.tissue.poisson_ratio, 0.0], (n, 2))
        rows = POINT.in_order(figures=figures, curvature=near.curvature[v], slope=near.slope[v], here=sources,
                              constants=constants)  # fmt: skip
        area = layer.vertex_areas[v]
        parts.append((np.concatenate(rows, axis=1), squeeze.pressure, one.true, area / area.sum()))
        starts.append(starts[-1] + n)
        on_progress(k + 1, len(subset), "looking at contacts")
    rows, prior, true, area = (np.concatenate(p).astype(np.float32) for p in zip(*parts, strict=True))
    return Rows(rows, prior, true, area, np.array(starts))


def loss(model: Model, data: Rows, contacts: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    """Mean loss, relative L2 error of the pressure and relative error of the force of some contacts, each (C,)."""
    ends = [(int(data.starts[c]), int(data.starts[c + 1])) for c in contacts]
    take = np.concatenate([np.arange(a, b) for a, b in ends])
    owner = torch.from_numpy(np.repeat(np.arange(len(contacts)), [b - a for a, b in ends]))
    rows, prior, true, area = (torch.from_numpy(a[take]) for a in (data.rows, data.prior, data.true, data.area))
    out, doubt = model.outputs(rows)
    held = prior * torch.exp(torch.clamp(out[:, PRESSURE.at.log_ratio], -MAX_LOG_RATIO, MAX_LOG_RATIO))

    def total(values: Tensor) -> Tensor:
        return torch.zeros(len(contacts)).index_add_(0, owner, values)

    shape = torch.sqrt(total(area * (held - true) ** 2) / total(area * true**2))
    force = total(area * (held - true)) / total(area * true)
    robust = torch.sqrt(shape**2 + TYPICAL**2) + FORCE * torch.sqrt(force**2 + TYPICAL**2)
    missed = torch.log((held - true).abs().detach() / held.detach() + 1e-3) - doubt
    weight = area * true / total(area * true)[owner]
    doubtful = (weight * torch.maximum(0.9 * missed, -0.1 * missed)).sum() / len(contacts)
    return robust.mean() + 0.02 * doubtful, shape, force


def fit(data: Rows, settings: ContactTraining, on_progress: OnProgress) -> Model:
    """Trains on contacts drawn at random."""
    torch.manual_seed(settings.seed)
    model = Model(settings.hidden, PRESSURE)
    model.normalise(torch.from_numpy(data.rows))
    optimiser = torch.optim.AdamW(model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=settings.steps, pct_start=0.1
    )
    rng, mean = np.random.default_rng(settings.seed), np.zeros(2)
    for step in range(settings.steps):
        value, shape, force = loss(model, data, rng.integers(len(data.starts) - 1, size=settings.batch))
        optimiser.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 0.3)
        optimiser.step()
        schedule.step()
        now = np.array([shape.mean().item(), force.abs().mean().item()])
        mean = now if step == 0 else 0.99 * mean + 0.01 * now
        if (step + 1) % 100 == 0 or step + 1 == settings.steps:
            on_progress(step + 1, settings.steps, f"pressure {mean[0]:.1%}, force {mean[1]:.1%} off")
    return model


def train_contact(
    data: str | Path,
    out: str | Path,
    settings: ContactTraining | None = None,
    *,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Trains a ContactNet on a data set of the preset "contacts", and writes out/contact_net.safetensors and .json.

    Returns:
        The card.

    Raises:
        InvalidInput: no finished data set, or one without tools.
    """
    settings, said = settings or ContactTraining(), on_progress or (lambda *_: None)
    source, out, started = Dataset.open(data), Path(out), time.monotonic()
    subset = source.split("train", kind="indenter", sets=("tool",))
    if not len(subset):
        raise InvalidInput(f"{data} holds no rigid tools. Make them with stmpl generate --preset contacts.")
    rows = draw_rows(subset, said)
    model = fit(rows, settings, said)
    counts = {"contacts": len(rows.starts) - 1, "rows": len(rows.rows)}
    card = training_card(data, source, settings, model, _ranges(source, subset), **counts)
    card["minutes"] = round((time.monotonic() - started) / 60, 1)
    weights = model.weights(card)
    card["bound"] = calibrate(source.split("val", kind="indenter", sets=("tool",)), weights)
    weights.save(out / "contact_net.safetensors")
    return card


def calibrate(subset: Subset, weights: Weights) -> dict[str, float]:
    """The factor on the network's own doubt that covers the error of a contact's force with a margin.

    Returns the factor, how many contacts, the median of bound over error, and the errors of these contacts.
    """
    scores = score(subset, weights)
    if not len(scores.force):
        return {"factor": float("inf"), "contacts": 0, "median_bound_over_error": float("nan")}
    ratio = np.abs(scores.force) / np.maximum(scores.doubt, 1e-9)
    factor = MARGIN * float(np.quantile(ratio, COVERED))
    return {
        "factor": factor,
        "contacts": len(ratio),
        "median_bound_over_error": float(np.median(factor / ratio)),
        "force_mean": float(np.abs(scores.force).mean()),
        "pressure_l2_mean": float(scores.pressure.mean()),
    }


@dataclass(frozen=True, eq=False)
class Scores:
    """How a network does on contacts, each array (C,) [-].

    Args:
        pressure: area-weighted L2 error over the L2 norm of the true pressure, all vertices.
        force: signed error of the force over the true one.
        doubt: error of the force that the network expects without calibration, over the true force.
        winkler: signed error of the force of columns alone.
        depth: depth over the thickness.
        mean: true mean pressure over E, weighted by itself.
        tool: kind of the tool.
    """

    pressure: np.ndarray
    force: np.ndarray
    doubt: np.ndarray
    winkler: np.ndarray
    depth: np.ndarray
    mean: np.ndarray
    tool: np.ndarray


def score(subset: Subset, weights: Weights) -> Scores:
    """Scores of a network on the contacts of a subset."""
    net, rows, last = None, [], None
    for one in pressed(subset):
        layer, squeeze = one.sample.layer, one.squeeze
        if net is None or last is not layer:
            net, last = ContactNet(layer, weights), layer
        held = net.hold(squeeze.vertices, squeeze.pressure, squeeze.strain)
        area, true = layer.vertex_areas, one.sample.load.values / layer.tissue.youngs_modulus
        ours = np.zeros_like(true)
        ours[squeeze.vertices] = held.pressure
        here = area[squeeze.vertices]
        force = float(area @ true)
        error = float(np.sqrt(area @ (ours - true) ** 2 / (area @ true**2)))
        forces = (float(area @ ours), float(here @ held.doubt), float(here @ squeeze.pressure))
        about = (one.sample.info["ratio"], float(area @ true**2) / force, one.sample.info["drawn"]["tool"])
        rows.append((error, forces[0] / force - 1, forces[1] / force, forces[2] / force - 1, *about))
    columns = list(zip(*rows, strict=True)) or [()] * 7
    return Scores(*(np.array(c) for c in columns))


def _ranges(data: Dataset, subset: Subset) -> dict[str, list[float]]:
    trained = [layer for name, layer in data.layers.items() if len(data.split("train", bodies=[name]))]
    t = np.concatenate([layer.thickness for layer in trained])
    nu = [layer.tissue.poisson_ratio for layer in trained]
    infos = [subset.info(k) for k in range(len(subset))]
    highest = max(subset[k].load.peak_ratio(subset[k].layer) for k in range(0, len(subset), max(1, len(subset) // 400)))
    return {
        "poisson_ratio": [min(nu), max(nu)],
        "thickness_mm": [1e3 * float(t.min()), 1e3 * float(t.max())],
        "depth_over_thickness": [0.0, max(info["ratio"] for info in infos)],
        "p_over_e": [0.0, round(highest, 4)],
    }
