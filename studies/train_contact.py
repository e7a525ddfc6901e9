"""train_contact: ContactNet on rigid tools that finite elements pressed in: from linear to true pressure at nodes."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from fem_tools.dataset import Dataset, Sample, Subset
from fem_tools.rounds import Pressed, learnt, read_all
from fem_tools.sampling import Plan
from stmpl_core.contact_net import MAX_LOG_RATIO, ContactNet
from stmpl_core.errors import InvalidInput
from stmpl_core.networks import NODE, PRESSURE, STACK_NODE, Weights
from studies.flat import flat_rows
from studies.judge_contact import UNEVEN, bound_force
from studies.pressed import STRAIGHT, Rows, pressed, seen, slant_of
from studies.train_moments import Layers, OnProgress, stacked, training_card

FORCE = 1.0  # weight of the force's error beside the pressure's
LEFT_OUT = 3  # parts of the bodies, each left out once, from whose errors the bound on stacks follows
ROUNDER = 0.3  # standard deviations beyond what was met up to which limbs may be curved: force is 1 to 4 % off there
STIFFER = 0.3  # likewise of how much stiffer columns are below: a tensed shoulder's is at the end of what was met
TYPICAL = 0.02  # of force and pressure: errors below count as squares in the loss


class ContactTraining(BaseModel):
    """What decides what is learnt.

    Args:
        hidden: width of each of the three hidden layers.
        steps, batch, learning_rate: numbers of AdamW, the batch in contacts; the rate rises to this and falls in one
            cycle.
        weight_decay: weight decay of AdamW.
        flat: share of each batch that is presses into flat stacks, where the data have them.
        seed: seed of weights and order.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    flat: float = Field(default=0.4, ge=0, lt=1)
    hidden: int = Field(default=32, ge=4)
    steps: int = Field(default=6_000, ge=20)
    batch: int = Field(default=48, ge=4)
    learning_rate: float = Field(default=3e-3, gt=0)
    weight_decay: float = Field(default=1e-2, ge=0)
    seed: int = 0


def tools_of(source: Dataset) -> Subset:
    """The rigid tools of a data set that are learnt from. Raises InvalidInput where there is none."""
    if not len(subset := source.split("train", kind="indenter", sets=("tool",))):
        raise InvalidInput(f"{source.path} holds no rigid tools. Make them with stmpl generate --preset contacts.")
    return subset


class Drawn(NamedTuple):
    """What the network sees of contacts, and the body of each, "" of none, (C,)."""

    rows: Rows
    bodies: np.ndarray

    def of(self, bodies: Collection[str]) -> Rows:
        """Those of some bodies."""
        return self.rows.some(np.flatnonzero(np.isin(self.bodies, list(bodies))))


def draw_rows(samples: Iterable[Sample], count: int, on_progress: OnProgress) -> Drawn:
    """What the network sees of every contact."""
    net, last, bodies = None, None, []
    parts: list[Rows] = []
    for k, one in enumerate(pressed(samples)):
        if slant_of(one.sample) > STRAIGHT:
            continue
        if net is None or last is not one.sample.layer:
            net, last = ContactNet(one.sample.layer), one.sample.layer
        if (rows := seen(one, net)) is not None:
            parts.append(rows)
            bodies.append(one.sample.info["body"])
        on_progress(k + 1, count, "looking at contacts")
    return Drawn(Rows.joined(parts), np.array(bodies))


def draw_flat(plan: Plan, presses: Sequence[Pressed], on_progress: OnProgress) -> Drawn | None:
    """What the network sees of all presses of a plan into flat stacks, by their numbers from 0 on; None of none."""
    parts: list[Rows] = []
    bodies: list[str] = []
    names = [body.name for body in learnt(plan)]
    of = [names[k % len(names)] if k < plan.rounds else "" for k in range(len(presses))]
    order = sorted(range(len(presses)), key=lambda k: repr(presses[k].tissue))  # a stack's tables are made once
    for k, number in enumerate(order):
        parts += flat_rows(presses[number])
        bodies += [of[number]] * (len(parts) - len(bodies))
        on_progress(k + 1, len(presses), "looking at flat stacks")
    return Drawn(Rows.joined(parts), np.array(bodies)) if parts else None


def loss(model: Layers, data: Rows, contacts: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    """Mean loss, relative L2 error of the pressure and relative error of the force of some contacts, each (C,).

    The pressure's shape is judged at the true force: of one that cannot be known least squares would make less force.
    """
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
    much = total(area * held) / total(area * true)
    off, force = held / torch.clamp(much, min=1e-3)[owner] - true, much - 1
    robust = torch.sqrt(total(area * off**2) / total(area * true**2) + TYPICAL**2)
    robust = robust + FORCE * torch.sqrt(force**2 + TYPICAL**2)
    expected = gathered(at_nodes.detach() * torch.exp(doubt))
    missed = torch.log((held - true).abs().detach() + 1e-3 * held.detach() + 1e-9) - torch.log(expected + 1e-9)
    weight = area * true / total(area * true)[owner]
    doubtful = (weight * torch.maximum(0.9 * missed, -0.1 * missed)).sum() / len(contacts)
    return robust.mean() + 0.02 * doubtful, shape, force


def fit(data: Rows, settings: ContactTraining, on_progress: OnProgress, flat: Rows | None = None) -> Layers:
    """Trains on contacts drawn at random, and on presses into flat stacks, a share of each batch."""
    torch.manual_seed(settings.seed)
    known, count = data.contacts, settings.batch
    of_flat = 0 if flat is None else round(settings.flat * count)
    if flat is not None:
        data = Rows.joined([data, flat])
    model = Layers(settings.hidden, STACK_NODE if data.rows.shape[1] == STACK_NODE.size else NODE, PRESSURE)
    model.take_range(torch.from_numpy(data.rows))
    if data.rows.shape[1] == STACK_NODE.size:
        at = STACK_NODE.at.curvature
        model.high[at] += ROUNDER / model.scale[at]
        low, high, scale = (STACK_NODE.split(x[None])["stiffening"] for x in (model.low, model.high, model.scale))
        low -= STIFFER / scale
        high += STIFFER / scale
    optimiser = torch.optim.AdamW(model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, settings.learning_rate, total_steps=settings.steps, pct_start=0.1
    )
    rng, mean = np.random.default_rng(settings.seed), np.zeros(2)
    for step in range(settings.steps):
        some = rng.integers(known, size=count - of_flat)
        if of_flat:
            some = np.concatenate([some, rng.integers(known, data.contacts, size=of_flat)])
        value, shape, force = loss(model, data, some)
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
    name: str = "contact_net",
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Trains a ContactNet on a data set of the preset "contacts" or "tissue", and writes its weights into `out`.

    They are `name`.safetensors, and the card `name`.json beside.

    Returns:
        The card.

    Raises:
        InvalidInput: no finished data set, or one without tools.
    """
    settings, said = settings or ContactTraining(), on_progress or (lambda *_: None)
    source, out, started = Dataset.open(data), Path(out), time.monotonic()
    subset = tools_of(source)
    drawn = draw_rows(subset, len(subset), said)
    flat = draw_flat(Plan.model_validate(source.manifest["plan"]), read_all(data), said)
    rows = drawn.rows
    model = fit(rows, settings, said, None if flat is None else flat.rows)
    counts = {"contacts": rows.contacts, "rows": len(rows.rows)} | ({"flat": flat.rows.contacts} if flat else {})
    card = training_card(data, source, settings, model, _ranges(source, subset), **counts)
    card["minutes"] = round((time.monotonic() - started) / 60, 1)
    weights = model.weights(card)
    if stacked(source):  # a stack's own network knows it better than one that never met it
        card["bound"] = bound_force(_left_out(source, drawn, flat, settings, card, said), uneven=UNEVEN)
    else:
        card["bound"] = bound_force([(source.split("val", kind="indenter", sets=("tool",)), weights)])
    weights.save(out / f"{name}.safetensors")
    return card


def _left_out(source: Dataset, drawn: Drawn, flat: Drawn | None, settings: ContactTraining, card: dict[str, Any],
              on_progress: OnProgress) -> Iterator[tuple[Subset, Weights]]:  # fmt: skip
    """Bodies in LEFT_OUT parts, each part's training contacts with a network that met none of its bodies."""
    bodies = np.random.default_rng(settings.seed).permutation(np.unique(drawn.bodies))
    for part in range(LEFT_OUT):
        out = [str(name) for name in bodies[part::LEFT_OUT]]
        known = [str(name) for name in bodies if name not in out]
        model = fit(drawn.of(known), settings, on_progress, None if flat is None else flat.of([*known, ""]))
        yield source.split("train", kind="indenter", sets=("tool",), bodies=out), model.weights(card)


def _ranges(data: Dataset, subset: Subset) -> dict[str, list[float]]:
    trained = [layer for name, layer in data.layers.items() if len(data.split("train", bodies=[name]))]
    t = np.concatenate([layer.thickness for layer in trained])
    nu = [layer.tissue.poisson_ratio for layer in trained]
    infos = [subset.info(k) for k in range(len(subset))]
    unit = cache(lambda name: ContactNet(data.layers[name]).unit)
    highest = max(float(one.load.values.max()) / unit(one.info["body"]) for one in subset)
    return {
        "poisson_ratio": [min(nu), max(nu)],
        "thickness_mm": [1e3 * float(t.min()), 1e3 * float(t.max())],
        "depth_over_thickness": [0.0, max(info["ratio"] for info in infos)],
        "p_over_e": [0.0, round(highest, 4)],
    }
