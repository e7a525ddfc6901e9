"""train_contact: ContactNet on rigid tools that finite elements pressed in: from linear to true pressure at nodes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from fem_tools.contact_job import INDENTER_REFINE
from fem_tools.dataset import Dataset, Sample, Subset
from fem_tools.press import Press
from fem_tools.sampling import tool_scene
from fem_tools.scenes import Site
from stmpl_core.arrays import Transform
from stmpl_core.columns import Columns
from stmpl_core.contact_net import MAX_LOG_RATIO, ContactNet
from stmpl_core.errors import InvalidInput
from stmpl_core.networks import NODE, PRESSURE, Weights
from stmpl_core.nodes import Nodes
from stmpl_core.sdf import SignedDistance
from studies.train_moments import Layers, OnProgress, training_card

COVERED = 0.95  # share of validation contacts whose force the stated bound must reach
MARGIN = 1.3  # on that bound, for tools and limbs unlike the validation data
FORCE = 1.0  # weight of the force's error beside the pressure's
LEAST_CELLS = 20  # area of a contact over the square of the finite elements' edge, from which they know its pressure
STRAIGHT = 0.36  # largest slant of a tool's way that is learnt from: no pose tells of it [rad]
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
    """One converged contact: where the tool is, the nodes under it, and the true pressure.

    Args:
        sample: sample of the data set.
        field: signed distance of the tool.
        pose: pose of the tool, (4, 4).
        nodes: contact nodes under it.
    """

    sample: Sample
    field: SignedDistance
    pose: Transform
    nodes: Nodes

    @property
    def true(self) -> np.ndarray:
        """True pressure over E at all vertices, (V,) [-]."""
        return self.sample.load.values / self.sample.layer.tissue.youngs_modulus


def pressed(samples: Iterable[Sample]) -> Iterator[Pressed]:
    """Contacts of samples, each with its tool built again where it stood."""
    layer = columns = site = last = None
    for sample in samples:
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
        yield Pressed(sample, tool.field, pose, columns.squeezed(tool.field, pose).nodes)


@dataclass(frozen=True, eq=False)
class Rows:
    """Nodes of many contacts, one after the other, and the vertices that they press on.

    Args:
        rows: inputs, laid out as stmpl_core.networks.NODE, (N, NODE.size) float32.
        prior: pressure over E that the network corrects, (N,) float32.
        fade: share of the correction, (N,) float32.
        area: area of the node, over its contact's scale, (N,) float32.
        corners: rows of `true` of the vertices around the node, (N, 3).
        shares: barycentric coordinates, (N, 3) float32.
        starts: first node of each contact, and the end, (C + 1,).
        true: true pressure over E at the vertices, (M,) float32.
        vertex_area: area of the vertices, over the contact's scale, (M,) float32.
        vertex_starts: first vertex of each contact, and the end, (C + 1,).
    """

    rows: np.ndarray
    prior: np.ndarray
    fade: np.ndarray
    area: np.ndarray
    corners: np.ndarray
    shares: np.ndarray
    starts: np.ndarray
    true: np.ndarray
    vertex_area: np.ndarray
    vertex_starts: np.ndarray

    @property
    def contacts(self) -> int:
        """Number of contacts."""
        return len(self.starts) - 1

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """Contacts of several, in order."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts])
                   for name in ("rows", "prior", "fade", "area", "shares", "true", "vertex_area")}  # fmt: skip
        counts = [np.concatenate([np.diff(getattr(part, name)) for part in parts]) for name in
                  ("starts", "vertex_starts")]  # fmt: skip
        starts, vertex_starts = (np.concatenate([[0], np.cumsum(count)]) for count in counts)
        before = np.cumsum([0] + [len(part.true) for part in parts])
        corners = np.concatenate([part.corners + k for part, k in zip(parts, before, strict=False)])
        return cls(**columns, corners=corners, starts=starts, vertex_starts=vertex_starts)


def seen(one: Pressed, net: ContactNet) -> Rows | None:
    """What the network sees of a contact; None where finite elements were too coarse to know its pressure."""
    layer, nodes = one.sample.layer, one.nodes
    if not len(nodes.area):
        return None
    look = net.look(nodes)
    touching = float(nodes.area[look.pressure > 0].sum())
    if touching < LEAST_CELLS * (layer.edge_length / 2**INDENTER_REFINE) ** 2 or not one.true.any():
        return None
    n = len(nodes.area)
    vertices = np.union1d(nodes.corners, np.flatnonzero(one.true))
    areas = layer.vertex_areas[vertices]
    scale = areas.sum()
    float32 = np.float32
    return Rows(look.inputs, look.pressure.astype(float32),
                look.fade.astype(float32), (nodes.area / scale).astype(float32),
                np.searchsorted(vertices, nodes.corners), nodes.shares.astype(float32), np.array([0, n]),
                one.true[vertices].astype(float32), (areas / scale).astype(float32),
                np.array([0, len(vertices)]))  # fmt: skip


def slant_of(sample: Sample) -> float:
    """Angle between a tool's way and the skin's normal [rad]."""
    return float(np.hypot(*sample.info["drawn"]["slant"]))


def draw_rows(samples: Iterable[Sample], count: int, on_progress: OnProgress) -> Rows:
    """What the network sees of every contact."""
    net, last, parts = None, None, []
    for k, one in enumerate(pressed(samples)):
        if slant_of(one.sample) > STRAIGHT:
            continue
        if net is None or last is not one.sample.layer:
            net, last = ContactNet(one.sample.layer), one.sample.layer
        if (rows := seen(one, net)) is not None:
            parts.append(rows)
        on_progress(k + 1, count, "looking at contacts")
    return Rows.joined(parts)


def loss(model: Layers, data: Rows, contacts: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    """Mean loss, relative L2 error of the pressure and relative error of the force of some contacts, each (C,)."""
    spans = [(int(data.starts[c]), int(data.starts[c + 1])) for c in contacts]
    vertex_spans = [(int(data.vertex_starts[c]), int(data.vertex_starts[c + 1])) for c in contacts]
    take = np.concatenate([np.arange(*span) for span in spans])
    take_vertices = np.concatenate([np.arange(*span) for span in vertex_spans])
    owner = torch.from_numpy(np.repeat(np.arange(len(contacts)), [b - a for a, b in vertex_spans]))
    before = np.cumsum([0] + [b - a for a, b in vertex_spans])[:-1] - [a for a, _ in vertex_spans]
    corners = data.corners[take] + np.repeat(before, [b - a for a, b in spans])[:, None]
    rows, prior, fade, node_area, shares = (torch.from_numpy(x[take]) for x in
                                            (data.rows, data.prior, data.fade, data.area, data.shares))  # fmt: skip
    true, area = torch.from_numpy(data.true[take_vertices]), torch.from_numpy(data.vertex_area[take_vertices])
    out, doubt = model.think(rows)
    at_nodes = prior * torch.exp(fade * torch.clamp(out[:, PRESSURE.at.log_ratio], -MAX_LOG_RATIO, MAX_LOG_RATIO))

    def gathered(values: Tensor) -> Tensor:
        parts = ((values * node_area)[:, None] * shares).ravel()
        return torch.zeros(len(take_vertices)).index_add_(0, torch.from_numpy(corners).ravel(), parts) / area

    def total(values: Tensor) -> Tensor:
        return torch.zeros(len(contacts)).index_add_(0, owner, values)

    held = gathered(at_nodes)
    shape = torch.sqrt(total(area * (held - true) ** 2) / total(area * true**2))
    force = total(area * (held - true)) / total(area * true)
    robust = torch.sqrt(shape**2 + TYPICAL**2) + FORCE * torch.sqrt(force**2 + TYPICAL**2)
    expected = gathered(at_nodes.detach() * torch.exp(doubt))
    missed = torch.log((held - true).abs().detach() + 1e-3 * held.detach() + 1e-9) - torch.log(expected + 1e-9)
    weight = area * true / total(area * true)[owner]
    doubtful = (weight * torch.maximum(0.9 * missed, -0.1 * missed)).sum() / len(contacts)
    return robust.mean() + 0.02 * doubtful, shape, force


def fit(data: Rows, settings: ContactTraining, on_progress: OnProgress) -> Layers:
    """Trains on contacts drawn at random."""
    torch.manual_seed(settings.seed)
    model = Layers(settings.hidden, NODE, PRESSURE)
    model.take_range(torch.from_numpy(data.rows))
    optimiser = torch.optim.AdamW(model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=settings.steps, pct_start=0.1
    )
    rng, mean = np.random.default_rng(settings.seed), np.zeros(2)
    for step in range(settings.steps):
        value, shape, force = loss(model, data, rng.integers(data.contacts, size=settings.batch))
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
    rows = draw_rows(subset, len(subset), said)
    model = fit(rows, settings, said)
    counts = {"contacts": rows.contacts, "rows": len(rows.rows)}
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
    scores = score((sample for sample in subset if slant_of(sample) <= STRAIGHT), weights)
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
        linear: signed error of the force without the network.
        depth: depth over the thickness.
        mean: true mean pressure over E, weighted by itself.
        tool: kind of the tool.
        slant: angle between its way and the skin's normal [rad].
    """

    pressure: np.ndarray
    force: np.ndarray
    doubt: np.ndarray
    linear: np.ndarray
    depth: np.ndarray
    mean: np.ndarray
    tool: np.ndarray
    slant: np.ndarray


def score(samples: Iterable[Sample], weights: Weights) -> Scores:
    """Scores of a network on contacts."""
    net, rows, last = None, [], None
    for one in pressed(samples):
        layer, nodes = one.sample.layer, one.nodes
        if net is None or last is not layer:
            net, last = ContactNet(layer, weights), layer
        if seen(one, net) is None:
            continue
        held, true, area, ours = net.hold(nodes), one.true, layer.vertex_areas, np.zeros(len(one.true))
        vertices, ours_there = nodes.at_vertices(held.pressure, area)
        ours[vertices] = ours_there
        force = float(area @ true)
        error = float(np.sqrt(area @ (ours - true) ** 2 / (area @ true**2)))
        forces = (float(area @ ours), float(nodes.area @ held.doubt), float(nodes.area @ net.look(nodes).pressure))
        info = one.sample.info
        about = (info["ratio"], float(area @ true**2) / force, info["drawn"]["tool"], slant_of(one.sample))
        rows.append((error, forces[0] / force - 1, forces[1] / force, forces[2] / force - 1, *about))
    columns = list(zip(*rows, strict=True)) or [()] * 8
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
