"""judge_contact: how far ContactNet and MomentNet are off under rigid tools, and the bounds that follow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fem_tools.dataset import Dataset, Sample, Subset
from stmpl_core.contact import Contact
from stmpl_core.contact_net import ContactNet
from stmpl_core.methods import MomentNet
from stmpl_core.networks import Weights
from stmpl_core.simulator import Simulator
from studies.pressed import STRAIGHT, pressed, seen, slant_of

COVERED = 0.95  # share of validation contacts whose force and motion the stated bounds must reach
MARGIN = 1.3  # on these bounds, for tools and limbs unlike the validation data
FEWEST = 30  # contacts from which a bound is known
LEAST_ERROR = 2e-3  # relative error of a force below which one is as good as another


def calibrate(subset: Subset, weights: Weights) -> dict[str, float]:
    """Bound on the error of a contact's force, over the force, from the network's own doubt: see fit_bound.

    Besides, the errors of these contacts.
    """
    scores = score((sample for sample in subset if slant_of(sample) <= STRAIGHT), weights)
    found = fit_bound(np.maximum(np.abs(scores.force), LEAST_ERROR), scores.doubt, scores.tool)
    if len(scores.force):
        found |= {"force_mean": float(np.abs(scores.force).mean()), "pressure_l2_mean": float(scores.pressure.mean())}
    return found


def bound_motion(data: str | Path, out: str | Path) -> dict[str, float]:
    """Adds to the card of out/moment_net_contact what `calibrate_motion` says on the validation split, and returns it.

    Raises:
        InvalidInput: no finished data set, or weights that are missing.
    """
    moments = Weights.load(Path(out) / "moment_net_contact.safetensors")
    pressures = Weights.load(Path(out) / "contact_net.safetensors", "pressure")
    found = calibrate_motion(Dataset.open(data).split("val", kind="indenter", sets=("tool",)), moments, pressures)
    replace(moments, card={**moments.card, "contact_bound": found}).save(Path(out) / "moment_net_contact.safetensors")
    return found


def calibrate_motion(subset: Iterable[Sample], moments: Weights, pressures: Weights) -> dict[str, float]:
    """How far the motion under a tool is off, from how far its force may be: worst = peak scale doubt^power [m].

    The power is fitted; the scale covers COVERED of the contacts with kinds of tools that the fit did not see, and a
    margin. Answers that are flagged are left out.

    Args:
        subset: contacts that no network was trained on.
        moments: network that says the motion.
        pressures: network that says what tools press with.

    Returns:
        Scale, power, how many contacts, and the median of bound over error.
    """
    rows, simulator, last = [], None, None
    for one in pressed(sample for sample in subset if slant_of(sample) <= STRAIGHT):
        if simulator is None or last is not one.sample.layer:
            last = one.sample.layer
            simulator = Simulator(last, MomentNet(contact=moments))
            simulator.toucher.net = ContactNet(last, pressures, simulator.toucher.near)
        simulator.tools.add(one.tool, one.field)
        answer = simulator.step([Contact(one.tool, one.pose)])
        touch = answer.touches[one.tool.name]
        if answer.trust.in_range and touch.force > 0:
            worst = float(np.linalg.norm(answer.displacement - one.sample.displacement, axis=1).max())
            rows.append((worst / float(answer.magnitude.max()), touch.force_bound / touch.force,
                         one.sample.info["drawn"]["tool"]))  # fmt: skip
    errors, doubts, kinds = (np.array(column) for column in list(zip(*rows, strict=True)) or [()] * 3)
    return fit_bound(errors, doubts, kinds)


def fit_bound(errors: np.ndarray, doubts: np.ndarray, kinds: np.ndarray) -> dict[str, float]:
    """Scale and power of a bound scale doubt^power on errors, all (N,), that holds for kinds that it was not fitted to.

    Returns:
        Scale, power, how many contacts, and the median of bound over error.
    """
    if len(errors) < FEWEST or len(np.unique(kinds)) < 2:
        return {"scale": float("inf"), "power": 0.0, "contacts": len(errors), "median_bound_over_error": float("nan")}
    log_error, terms = np.log(errors), np.column_stack([np.ones(len(errors)), np.log(doubts)])
    missed = np.empty(len(errors))
    for kind in np.unique(kinds):
        here = kinds == kind
        missed[here] = log_error[here] - terms[here] @ np.linalg.lstsq(terms[~here], log_error[~here], rcond=None)[0]
    offset, power = np.linalg.lstsq(terms, log_error, rcond=None)[0]
    scale = MARGIN * float(np.exp(offset + np.quantile(missed, COVERED)))
    return {
        "scale": scale,
        "power": float(power),
        "contacts": len(errors),
        "median_bound_over_error": float(np.median(scale * doubts**power / errors)),
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
