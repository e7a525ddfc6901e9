"""Tools pressed into limbs of skin, fat and muscle: how far a contact law is off finite elements, in one command.

    .venv/bin/python -m benchmarks.limbs                            # our row and the simpler laws'; some minutes
    .venv/bin/python -m benchmarks.limbs --answers yours.py:answer  # and yours
    .venv/bin/python -m benchmarks.limbs --peer                     # MuJoCo's flex, and all others, under balls alone
    .venv/bin/python -m benchmarks.limbs --export DIR               # the scenes, for any program
    .venv/bin/python -m benchmarks.limbs --kept                     # share of the tools' forces that the scenes keep

benchmarks/limbs.md says what is in benchmarks/limbs_v3.npz. `answer(layer, tool, pose, way)` gets a SoftLayer, a Tool,
its pose (4, 4) in the limb's frame and the unit vector (3,) along which it came there, and returns the force of the
tool on the limb (3,) [N] and the motion of the skin (V, 3) [m], or None for the latter. Forces are compared by size. No
answer is where it fails, is not finite, or presses the other way: it counts as no force and no motion.
"""

from __future__ import annotations

import argparse
import itertools
import json
import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from rich.console import Console
from rich.table import Table

from fem_tools.dataset import Sample
from fem_tools.plies import confined_modulus
from fem_tools.released import Released
from stmpl_core import Contact, SoftLayer, Tool
from stmpl_core.arrays import finite
from stmpl_core.console import steps_bar
from stmpl_core.contact_net import ContactNet
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import MomentNet
from stmpl_core.nodes import Nodes
from stmpl_core.packed import stack_to_text
from stmpl_core.simulator import Simulator
from stmpl_core.touch import Touch
from studies.own import own
from studies.pressed import STRAIGHT, Pressed, force_of, pressed, seen, slant_of

FILE = Path(__file__).with_name("limbs_v3.npz")
LIMBS = {  # rows of scenes: what splits, and how the limbs are called; a network may learn from others of "train"
    "arms and legs": (("test", "val"), ("arm", "leg", "drawn", "bare", "drum", "sheet", "even")),
    "backs": (("test", "val"), ("back",)),
    "a forearm left out": (("held_out",), ("forearm",)),
    "people": (("test", "val"), ("living",)),
    "heavy people": (("test", "val"), ("stout",)),
    "trunks, forearms": (("test", "val"), ("trunk",)),
    "thin places": (("test", "val"), ("thin",)),
    "deep": (("test", "val"), ("deep",)),
}
ELSEWHERE = {  # where the last are
    "heavy people": FILE.with_name("stout_v1.npz"), "trunks, forearms": FILE.with_name("trunk_v1.npz"),
    "thin places": FILE.with_name("thin_v1.npz"), "deep": FILE.with_name("deep_v2.npz"),
}  # fmt: skip
DEPTHS = (0.0, 0.1, 0.3, 0.6, 1.0)  # over the thickness, between which --kept takes means
PEER_AT = (0.2, 0.4)  # depths at which a peer is asked [thicknesses]
PEER, FLEX = "MuJoCo flex, the limb's mesh", "studies/peers/layered_flex.py:ball"
MOVES = 0.1  # motion that counts as such, over the peak
KNOWN = 0.015  # what the finite elements' mesh leaves, over the peak, below which they know motion well
Answer = Callable[[SoftLayer, Tool, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray | None]]


class Off(NamedTuple):
    """How far one answer is off finite elements.

    Args:
        truth: what the finite elements' own mesh is taken to leave of motion, over the true peak [-].
        force: signed error of the force's size over the true one [-].
        moves, worst: mean error where it moves, and the largest at any vertex, over the true peak [-].
        flagged: truth of the claim that the answer says that it is not to be relied upon.
        bound: bound on the force's error that is stated, over the true force [-].
        motion_bound: bound on the motion's error at the worst vertex, over the true peak [-]; not a number: none.
        answered: truth of the claim that there was an answer; none counts as no force and no motion.
    """

    truth: float
    force: float
    moves: float = float("nan")
    worst: float = float("nan")
    flagged: bool = False
    bound: float = float("nan")
    motion_bound: float = float("nan")
    answered: bool = True


def off(one: Pressed, force: np.ndarray, motion: np.ndarray | None, flagged: bool = False,
        bound: float = float("nan"), motion_bound: float | None = None) -> Off:  # fmt: skip
    """Compares an answer with a scene; its bound on motion is in [m]."""
    true = float(np.linalg.norm(one.force))
    error = float(np.linalg.norm(force)) / true - 1
    size = np.linalg.norm(one.sample.displacement, axis=1)
    known = one.sample.info["discretisation_m"] / float(size.max())
    if motion is None:
        return Off(known, error, flagged=flagged, bound=bound)
    wrong = np.linalg.norm(motion - one.sample.displacement, axis=1) / size.max()
    return Off(known, error, float(wrong[size > MOVES * size.max()].mean()), float(wrong.max()), flagged, bound,
               float("nan") if motion_bound is None else motion_bound / float(size.max()))


def asked(law: Answer, one: Pressed) -> tuple[np.ndarray, np.ndarray | None]:
    """What a law answers to a scene. Raises InvalidInput: it fails, or that is no answer."""
    layer, info = one.sample.layer, one.sample.info
    where = f"{info['body']}, contact {info['number']} at {info['ratio']:.2g} thicknesses"
    try:
        force, motion = law(layer, one.tool, one.pose, one.way)
        force = finite("the force", force, (3,))
        motion = None if motion is None else finite("the motion", motion, layer.vertices.shape)
    except Exception as error:  # whatever a person's law does
        raise InvalidInput(f"no answer to {where}: {type(error).__name__}: {str(error).rstrip('.')}. Needed is force "
                           f"(3,) [N], motion {layer.vertices.shape} [m] or None.") from error  # fmt: skip
    if force @ one.force < 0:
        raise InvalidInput(f"no answer to {where}: the force points the other way. Needed is that of the tool on the "
                           f"limb, about {np.round(one.force, 2).tolist()} N.")  # fmt: skip
    return force, motion


def met(simulator: Simulator, one: Pressed) -> Touch:
    """Our touch of a scene, which is told the way that the tool came, as a wrench would tell it."""
    (touch,) = simulator.touch([Contact(one.tool, one.pose)])
    return touch if touch.pressed is None else replace(touch, pressed=touch.pressed._replace(way=one.way))


class Laws:
    """The laws that are compared, on one limb."""

    def __init__(self, layer: SoftLayer, others: Mapping[str, Answer]) -> None:
        self.layer, self.others = layer, others
        self.refused: dict[str, list[str]] = defaultdict(list)  # why there was no answer, by law
        self.simulator = Simulator(layer, MomentNet())
        self.net = self.simulator.toucher.net
        self.modulus = np.array([confined_modulus(layer.tissue, float(t)) for t in layer.thickness])

    def unlearnt(self, nodes: Nodes) -> np.ndarray:
        """Pressure at contact nodes without the network, (N,) [Pa]."""
        return self.net.look(nodes).pressure * self.layer.tissue.youngs_modulus

    def columns(self, nodes: Nodes) -> np.ndarray:
        """Pressure at contact nodes if each column is pressed for itself, (N,) [Pa]."""
        return np.einsum("nc,nc->n", self.modulus[nodes.corners], nodes.shares) * nodes.strain

    def answers(self, one: Pressed) -> dict[str, Off]:
        """Each law's answer to a scene, compared."""
        layer, nodes, out = self.layer, one.nodes, {}
        self.simulator.tools.add(one.tool, one.field)
        touch = met(self.simulator, one)
        answer = self.simulator.answer([touch])
        true = float(np.linalg.norm(one.force))
        out["moment_net"] = off(one, touch.wrench[:3], answer.displacement, flagged=not answer.trust.in_range,
                                bound=touch.force_bound / true, motion_bound=answer.trust.error_bound)  # fmt: skip
        if len(nodes.area):
            out["without its network"] = off(one, force_of(layer, nodes, self.unlearnt(nodes)), None)
            out["elastic foundation"] = off(one, force_of(layer, nodes, self.columns(nodes)), None)
        for name, other in self.others.items():
            try:
                out[name] = off(one, *asked(other, one))
            except InvalidInput as error:
                self.refused[name].append(str(error))
                out[name] = off(one, np.zeros(3), np.zeros_like(layer.vertices))._replace(answered=False)
        return out


def compare(released: Released, splits: Sequence[str], names: tuple[str, ...], others: Mapping[str, Answer],
            balls: bool = False) -> tuple[dict[str, list[Off]], dict[str, list[str]]]:  # fmt: skip
    """All laws on the scenes of some splits on limbs of such names, where finite elements know the pressure.

    Also why some have no answer, by name.

    Args:
        released: contacts.
        splits: splits of which scenes count.
        names: beginnings of the limbs' names.
        others: laws that are compared too, by name.
        balls: choice of balls alone, in the middle of their depths.
    """
    found: dict[str, list[Off]] = defaultdict(list)
    refused: dict[str, list[str]] = defaultdict(list)
    laws, last = None, None
    with steps_bar("scenes") as show:
        show(0, 1, "reading")
        samples = [one for split in splits for one in released.samples(split)
                   if slant_of(one) <= STRAIGHT and one.info["body"].startswith(names)]  # fmt: skip
        if balls:
            samples = [one for one in samples if one.info["drawn"].get("tool") == "sphere"
                       and PEER_AT[0] < one.info["ratio"] < PEER_AT[1]]  # fmt: skip
        for k, one in enumerate(pressed(samples)):
            if laws is None or last is not one.sample.layer:
                laws, last = Laws(one.sample.layer, others), one.sample.layer
                laws.refused = refused
            if seen(one, laws.net) is not None:
                for name, result in laws.answers(one).items():
                    found[name].append(result)
            show(k + 1, len(samples), one.sample.info["body"])
    return found, refused


def table(title: str, found: dict[str, list[Off]]) -> Table:
    """The rows, in per cent; of a law that did not answer all scenes a second one, of those that it did; of one that
    knows motion another, of scenes whose truth is well known."""
    out = Table(title=title)
    for heading in ("law", "scenes", "force: mean", "90 %", "worst", "where it moves", "worst vertex", "flagged",
                    "force in its bound", "motion"):  # fmt: skip
        out.add_column(heading, justify="left" if heading == "law" else "right")
    rows = []
    for name, every in found.items():
        some = [one for one in every if one.answered]
        if all(np.isnan(one.worst) for one in some):  # a law of forces alone
            every = [one._replace(moves=float("nan"), worst=float("nan")) for one in every]
        rows.append((name, every, f"{len(some)} of {len(every)}" if len(some) < len(every) else str(len(every))))
        if 0 < len(some) < len(every):
            rows.append((f"{name}, where it answers", some, str(len(some))))
        known = [one for one in some if one.truth < KNOWN and not np.isnan(one.moves)]
        if 0 < len(known) < len(some):
            rows.append((f"{name}, truth to {100 * KNOWN:g} %", known, str(len(known))))
    for name, every, count in rows:
        by_name = zip(Off._fields, np.array(every, dtype=float).T, strict=True)
        columns = {key: np.asarray(values) for key, values in by_name}
        force = np.abs(columns["force"])

        def shown(values: np.ndarray, how: Callable[[np.ndarray], float] = np.mean) -> str:
            return "" if np.isnan(values).all() else f"{100 * float(how(values)):.1f} %"

        out.add_row(name, count, shown(force), shown(force, lambda v: float(np.quantile(v, 0.9))),
                    shown(force, np.max), shown(columns["moves"]), shown(columns["worst"]), shown(columns["flagged"]),
                    *(shown((wrong <= bound)[~np.isnan(bound)]) if not np.isnan(bound).all() else ""
                      for wrong, bound in ((force, columns["bound"]), (columns["worst"], columns["motion_bound"]))))
    return out


def export(samples: Iterable[Sample], folder: Path, splits: Sequence[str]) -> int:
    """Writes what a solver needs of each scene, and what finite elements found; the number of scenes.

    Files: each limb's skin and the bone below it as PLY [m] with vertices in one order, each tool as STL [m], how each
    vertex moves as .npy, (V, 3) [m], and scenes.json, which names them and has the tissues, poses and forces.

    Args:
        samples: contacts.
        folder: folder for them.
        splits: splits of which straight scenes are judged by the table, where finite elements know the pressure.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scenes: list[dict[str, Any]] = []
    limbs: dict[str, dict[str, Any]] = {}
    net = last = None
    for one in pressed(samples):
        info, layer = one.sample.info, one.sample.layer
        limb, scene = info["body"], f"{info['body']}-{info['number']:02d}"
        if net is None or last is not layer:
            net, last = ContactNet(layer), layer
        if limb not in limbs:
            limbs[limb] = {"skin": f"{limb}-skin.ply", "bone": f"{limb}-bone.ply",
                           "tissue": json.loads(stack_to_text(layer.tissue, layer.ply_scale))}  # fmt: skip
            trimesh.Trimesh(layer.vertices, layer.faces, process=False).export(folder / limbs[limb]["skin"])
            trimesh.Trimesh(layer.inner_vertices, layer.faces, process=False).export(folder / limbs[limb]["bone"])
        tool, motion = f"{scene}-tool.stl", f"{scene}-{len(scenes):04d}-motion.npy"
        if not (folder / tool).exists():
            trimesh.Trimesh(one.tool.vertices, one.tool.faces, process=False).export(folder / tool)
        np.save(folder / motion, one.sample.displacement.astype(np.float32))
        judged = info["split"] in splits and slant_of(one.sample) <= STRAIGHT and seen(one, net) is not None
        scenes.append({"limb": limb, "tool": tool, "split": info["split"], "judged": judged,
                       "depth_over_thickness": info["ratio"], "pose_limb_from_tool": one.pose.tolist(),
                       "way": one.way.tolist(), "force_on_limb_N": one.force.tolist(), "motion_of_skin_m": motion,
                       "fem_error_m": info["discretisation_m"]})  # fmt: skip
    (folder / "scenes.json").write_text(json.dumps({"limbs": limbs, "scenes": scenes}, indent=1) + "\n")
    return len(scenes)


def kept(title: str, samples: Iterable[Sample]) -> Table:
    """Share of the tools' forces that pressures along the skin's normals at rest make, by depth (Pressed.kept)."""
    shares = [(one.sample.info["ratio"], one.kept) for one in pressed(samples) if one.true.any()]
    ratio, share = np.array(shares).T
    out = Table(title=f"{title}: share of the tools' forces that is kept")
    for heading in ("depth over thickness", "scenes", "mean", "tenth below", "least"):
        out.add_column(heading, justify="right")
    for low, high in itertools.pairwise(DEPTHS):
        if (some := (ratio >= low) & (ratio < high)).any():
            figures = share[some].mean(), np.quantile(share[some], 0.1), share[some].min()
            out.add_row(f"{low:g} to {high:g}", str(some.sum()), *(f"{100 * one:.1f} %" for one in figures))
    return out


def main() -> None:
    """Prints a table for each kind of limb, or writes the scenes."""
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--limbs", nargs="+", choices=list(LIMBS), default=list(LIMBS))
    given.add_argument("--answers", default="", help="file.py:function of a law of yours")
    given.add_argument("--peer", action="store_true", help="MuJoCo's flex under balls instead (extra peers)")
    given.add_argument("--kept", action="store_true", help="what the scenes keep of the tools' forces instead; no law")
    given.add_argument("--export", type=Path, default=None, help="folder to which the scenes are written instead")
    given.add_argument("--file", type=Path, default=None, help="released contacts; those of this folder unless given")
    options = given.parse_args()
    logging.disable(logging.WARNING)
    try:
        _answer(options)
    except (InvalidInput, OSError) as error:
        given.error(str(error))
    finally:
        logging.disable(logging.NOTSET)


def _answer(options: argparse.Namespace) -> None:
    read = cache(Released)

    def released(kind: str) -> Released:
        return read(options.file or ELSEWHERE.get(kind, FILE))

    if options.export:
        many = 0
        for kind in options.limbs:
            splits, names = LIMBS[kind]
            some = (one for one in released(kind).samples() if one.info["body"].startswith(names))
            many += export(some, options.export / kind.replace(",", "").replace(" ", "_"), splits)
        print(f"{many} scenes in {options.export}")
        return
    laws = {PEER: str(FILE.parents[1] / FLEX)} if options.peer else {"yours": options.answers}
    others = {name: own(law) for name, law in laws.items() if law}
    if not all(map(callable, others.values())):
        raise InvalidInput(f"{options.answers} is no function. Needed is answer(layer, tool, pose, way).")
    for kind in options.limbs if options.kept else ():
        splits, names = LIMBS[kind]
        samples = [one for one in released(kind).samples() if one.info["split"] in splits and slant_of(one) <= STRAIGHT
                   and one.info["body"].startswith(names)]  # fmt: skip
        Console(width=130).print(kept(kind, samples))
    for kind in () if options.kept else options.limbs:
        splits, names = LIMBS[kind]
        found, refused = compare(released(kind), splits, names, others, balls=options.peer)
        Console(width=150).print(table(kind, found))
        for name, why in refused.items():
            print(f"{name}, {len(why)} scenes without an answer, which count as no force and no motion; first: "
                  f"{why[0]}")  # fmt: skip


if __name__ == "__main__":
    main()
