"""judge_contact: how far ContactNet and MomentNet are off under rigid tools, and the bounds that follow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import lsq_linear

from fem_tools.dataset import Dataset, Sample
from stmpl_core.bounds import deepest
from stmpl_core.contact import Contact
from stmpl_core.contact_net import ContactNet
from stmpl_core.methods import MomentNet, Zero
from stmpl_core.networks import NETWORKS, Weights
from stmpl_core.simulator import Simulator
from stmpl_core.toucher import STUCK
from studies.pressed import STRAIGHT, pressed, seen, slant_of

COVERED = 0.95  # share of contacts of kinds left out, whose force and motion the stated bounds must reach
STACK_MARGIN = 1.2  # on the bound of motion on stacks; without, it covers 96 % of validation, 91 % of no training
FEWEST = 30  # contacts from which a bound is known
UNEVEN = 1.2  # doubt of a force on a stack per |log| of the thickness there over the limb's median
LEAST_ERROR = 2e-3  # relative error of a force below which one is as good as another


@dataclass(frozen=True, eq=False)
class Scores:
    """How networks do on contacts, each array (C,) [-].

    Args:
        force: signed error of the force over the true one.
        pressure: area-weighted L2 error over the L2 norm of the true pressure, all vertices.
        motion: largest error at a vertex over the largest displacement that is answered.
        stated: bound on the force that is stated, over the force, without what skin carries along itself.
        linear: signed error of the force without the network.
        kind: kind of the tool; on stacks the body, as each has a stack of its own.
        slant: angle between its way and the skin's normal that the answer does not know of [rad].
        deep: depth of the tool over the thickness, where it is deepest.
        held, trusted: truth of the claim that the touch, and that the whole answer is not flagged.
    """

    force: np.ndarray
    pressure: np.ndarray
    motion: np.ndarray
    stated: np.ndarray
    linear: np.ndarray
    kind: np.ndarray
    slant: np.ndarray
    deep: np.ndarray
    held: np.ndarray
    trusted: np.ndarray


def score(samples: Iterable[Sample], pressures: Weights, moments: Weights | None = None, *,
          stick: bool = False, reaction_only: bool = False) -> Scores:  # fmt: skip
    """Scores on the contacts of samples that came straight, and whose pressure finite elements know.

    Args:
        samples: samples of the data.
        pressures: network that says what tools press with.
        moments: network that says what that moves; None: the one that comes with the package.
        stick: truth of the claim that it is for skin that sticks to its tools node by node.
        reaction_only: choice to leave the motion out; its errors are NaN then, and touches decide what is trusted.
    """
    simulator, rows, last = None, [], None
    for one in pressed(sample for sample in samples if slant_of(sample) <= STRAIGHT):
        layer, true, area = one.sample.layer, one.true, one.sample.layer.vertex_areas
        if simulator is None or last is not layer:
            tools = {"stick" if stick else "contact": moments, "stack": moments, "sticks": stick}
            method = Zero() if reaction_only else MomentNet(**tools)
            simulator, last = Simulator(layer, method), layer
            simulator.toucher.net = ContactNet(layer, pressures, simulator.toucher.near)
        if seen(one, simulator.toucher.net) is None:
            continue
        simulator.tools.add(one.tool, one.field)
        (touch,) = simulator.touch([Contact(one.tool, one.pose)])
        pressure = touch.pressure
        if pressure is None or not touch.force > 0:
            continue
        motion, trusted, slant = float("nan"), touch.trust.in_range, slant_of(one.sample)
        if layer.stacked and touch.pressed is not None:  # told which way it came, as by a wrench
            touch, slant = replace(touch, pressed=touch.pressed._replace(way=one.way)), 0.0
        if not reaction_only:
            answer = simulator.answer([touch])
            off = np.linalg.norm(answer.displacement - one.sample.displacement, axis=1)
            motion, trusted = float(off.max() / answer.magnitude.max()), answer.trust.in_range
        kind = one.sample.info["body"] if layer.stacked else one.sample.info["drawn"]["tool"]
        ours, nodes, force = pressure / layer.tissue.youngs_modulus, one.nodes, float(area @ true)
        rows.append((
            float(area @ ours) / force - 1,
            float(np.sqrt(area @ (ours - true) ** 2 / (area @ true**2))),
            motion,
            touch.force_bound / touch.force - (STUCK * touch.pressed.along if touch.pressed else 0.0),
            float(nodes.area @ simulator.toucher.net.look(nodes).pressure) / force - 1,
            kind, slant, deepest(touch), touch.trust.in_range, trusted,
        ))  # fmt: skip
    columns = list(zip(*rows, strict=True)) or [()] * 10
    return Scores(*(np.array(c) for c in columns[:-2]), *(np.array(c, dtype=bool) for c in columns[-2:]))


def bound_force(parts: Iterable[tuple[Iterable[Sample], Weights]], **more: float) -> dict[str, float]:
    """Bound on the error of a contact's force, over the force, from the network's own doubt: see fit_bound.

    Touches that are flagged are left out. Besides, the mean errors of the others.

    Args:
        parts: samples, and the network that is judged on them.
        more: what else the doubt is made of: uneven, on stacks.
    """
    bare = {"scale": 1.0, "power": 1.0, **more}
    every = [score(samples, replace(one, card={**one.card, "bound": bare}), reaction_only=True)
             for samples, one in parts]  # fmt: skip
    columns = (np.concatenate([getattr(one, name) for one in every])
               for name in ("force", "pressure", "stated", "kind", "held"))  # fmt: skip
    force, pressure, stated, kind, held = columns
    force = np.abs(force)
    found = fit_bound(np.maximum(force, LEAST_ERROR)[held], stated[held], kind[held])
    found |= more
    if held.any():
        found |= {"force_mean": float(force[held].mean()), "pressure_l2_mean": float(pressure[held].mean())}
    return found


def bound_motion(data: str | Path, out: str | Path, motion: str = "moment_net_contact",
                 pressure: str = "contact_net") -> dict[str, float]:  # fmt: skip
    """How far the motion under a tool that came straight is off, from how far its force may be: see fit_bound.

    Written to the card of out/`motion`, and returned. Answers of the validation split that are flagged are left out.

    Args:
        data: folder of the data set.
        out: folder of the weights.
        motion, pressure: names of both networks.

    Raises:
        InvalidInput: no finished data set, or weights that are missing.
    """
    path = Path(out) / f"{motion}.safetensors"
    moments = Weights.load(path, NETWORKS[motion].kind)
    pressures = Weights.load(Path(out) / f"{pressure}.safetensors", NETWORKS[pressure].kind)
    scores = score(Dataset.open(data).split("val", kind="indenter", sets=("tool",)), pressures, moments,
                   stick=motion == "moment_net_stick")  # fmt: skip
    some = scores.trusted
    every = (scores.motion, scores.stated, scores.kind, scores.slant, scores.deep)
    found = fit_bound(*(column[some] for column in every))
    if NETWORKS[motion].kind == "stack_motion":  # validation is of the stacks that were learnt; others are further off
        found |= {name: STACK_MARGIN * found[name] for name in ("scale", "median_bound_over_error")}
    replace(moments, card={**moments.card, "contact_bound": found}).save(path)
    return found


def fit_bound(errors: np.ndarray, doubts: np.ndarray, kinds: np.ndarray, besides: np.ndarray | None = None,
              deep: np.ndarray | None = None) -> dict[str, float]:  # fmt: skip
    """Scale and powers of a bound scale doubt^power deep^depth_power on errors, for kinds that it was not fitted to.

    Args:
        errors, doubts, kinds: of N contacts.
        besides: something else that makes errors larger, exponentially, and is 0 where the bound shall hold, (N,).
        deep: depths over the thickness, (N,); None: the bound does not read them.

    Returns:
        Scale, powers, how many contacts, and the median of bound over error without what is besides.
    """
    if len(errors) < FEWEST or len(np.unique(kinds)) < 2:
        return {"scale": float("inf"), "power": 0.0, "contacts": len(errors), "median_bound_over_error": float("nan")}
    columns = [np.ones(len(errors)), np.log(doubts)] + ([] if deep is None else [np.log(deep)])
    stated = len(columns)
    log_error, terms = np.log(errors), np.column_stack(columns + ([] if besides is None else [besides]))

    def fitted(which: np.ndarray) -> np.ndarray:  # powers are not below 0
        lowest = np.where((np.arange(terms.shape[1]) > 0) & (np.arange(terms.shape[1]) < stated), 0.0, -np.inf)
        return np.asarray(lsq_linear(terms[which], log_error[which], (lowest, np.inf), method="bvls").x)

    missed = np.empty(len(errors))
    for kind in np.unique(kinds):
        here = kinds == kind
        missed[here] = log_error[here] - terms[here] @ fitted(~here)
    found = fitted(np.ones(len(errors), dtype=bool))
    found[0] += np.quantile(missed, COVERED)
    without = log_error - terms[:, stated:] @ found[stated:]
    return {
        "scale": float(np.exp(found[0])),
        "power": float(found[1]),
        **({} if deep is None else {"depth_power": float(found[2])}),
        "contacts": len(errors),
        "median_bound_over_error": float(np.exp(np.median(terms[:, :stated] @ found[:stated] - without))),
    }
