"""Layered limbs: time of an answer against its error: ours, simpler models, finite elements, a peer; the same presses.

    .venv/bin/python -m benchmarks.layered_chart --out runs/layered     # half an hour; goes on from what lies there

The scenes are those of a row of benchmarks.limbs; the truth is what benchmarks/limbs_v3.npz says: finite elements of
linear wedges, refined three times where a tool's curvature asks, pressed in through up to eight depths. Error of the
force: of its size, mean over scenes; of the motion: mean where the skin moves more than a tenth of the peak, of that.

Time is of one core (set OMP_NUM_THREADS=1), of the processor, so that what else runs counts little: of our laws and
the simpler ones touch and motion of the whole skin, warm, the median of several; of finite elements from rest to that
depth, their mesh included. Fields of tools and what a limb's skin prepares are made before. "One layer" has the same
bones and the one modulus that is least off the forces of these very scenes: no other does better. MuJoCo's flex is
asked of balls alone, a depth each; its stack is studies.peers.layered_flex.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.limbs import FILE, LIMBS, Laws, met, off
from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.released import Released
from fem_tools.sampling import Plan
from stmpl_core import SoftLayer, Tissue
from stmpl_core.green import Green
from stmpl_core.methods import Coarse, MomentNet
from stmpl_core.methods.coarse import interpolation
from stmpl_core.simulator import Simulator
from studies.peers import installed
from studies.pressed import STRAIGHT, Pressed, force_of, pressed, seen, slant_of

log = logging.getLogger(__name__)

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "layered_chart.png"
COARSER = 1.5  # mesh width of ours that is asked for, over the layer's own; a limb of few triangles gets less
REFINED = {1: "refined once", 2: "refined twice", 3: "the truth's own"}  # where a tool's curvature asks
PEER_AT = (0.3, 0.4)  # depths at which the peer is asked, of balls alone [thicknesses]
PEER_STEPS, PEER_STEP = 20, 0.02  # steps in which its ball goes in, and how long each is [s]
REPEATS = 7
TRUTH_OFF, LEAST = 1.7, 0.1  # what the truth's force is off itself (docs/ground_truth.md), error that is drawn [%]
ONE_LAYER, OURS, FEM, PEER = "one layer, its best modulus", "stmpl", "finite elements", "MuJoCo flex, two balls alone"
Found = Iterator[tuple[np.ndarray, np.ndarray, float] | None]  # force [N], motion [m], time [s], by depth; None: none
Solver = Callable[[Sequence[Pressed]], Found]  # all depths of a contact, the least first


class Row(NamedTuple):
    """One answer: name of its curve and its knob, scene, force over the true one, error of the motion [-], time [s]."""

    curve: str
    setting: str
    scene: str
    force: float
    moves: float
    took: float


class Point(NamedTuple):
    """A setting over its scenes: their number, errors of force (mean, 90 %) and motion [%], median time [ms]."""

    curve: str
    setting: str
    scenes: int
    force: float
    most: float
    motion: float
    took: float


def warm(answer: Callable[[Pressed], tuple[np.ndarray, np.ndarray]], every: Sequence[Pressed]) -> Found:
    """A law at each depth, with the median of its times."""
    for one in every:
        force, motion = answer(one)
        took = []
        for _ in range(REPEATS):
            began = time.process_time()
            answer(one)
            took.append(time.process_time() - began)
        yield force, motion, float(np.median(took))


def ours(layer: SoftLayer, coarser: float = 1.0) -> Solver:
    """Our law, on the layer's mesh or a coarser one, whose motion is carried back."""
    on, carry = layer, None
    if coarser > 1:
        on = Coarse(MomentNet(), coarser).prepare(layer).coarse
        carry = interpolation(on, layer)
    simulator = Simulator(on, MomentNet())

    def answer(one: Pressed) -> tuple[np.ndarray, np.ndarray]:
        touch = met(simulator, one)
        moved = simulator.answer([touch]).displacement
        return touch.wrench[:3], moved if carry is None else carry @ moved

    return lambda every: warm(answer, every)


def alone(layer: SoftLayer) -> SoftLayer:
    """The layer of one material, of which force goes as its modulus, down to the same bones."""
    tissue = layer.tissue
    return layer.with_(tissue=Tissue(tissue.youngs_modulus, tissue.poisson_ratio), ply_scale=None)


def simpler(layer: SoftLayer, columns: bool) -> Solver:
    """The linear response, or columns each for itself; their motion is that of the same pressures."""
    laws = Laws(layer, {})
    under, green, modulus = laws.simulator.toucher.columns, Green.of(layer), layer.tissue.youngs_modulus

    def answer(one: Pressed) -> tuple[np.ndarray, np.ndarray]:
        squeeze = under.squeezed(one.field, one.pose)
        nodes = squeeze.nodes
        pressure = laws.columns(nodes) if columns else laws.unlearnt(nodes)
        force = force_of(layer, nodes, pressure)
        if not columns:
            return force, green.motion(nodes, (pressure * nodes.area / modulus)[:, None] * nodes.inward)
        motion = np.zeros_like(layer.vertices)
        motion[squeeze.vertices] = -squeeze.depth[:, None] * layer.normals[squeeze.vertices]
        return force, motion

    return lambda every: warm(answer, every)


def elements(layer: SoftLayer, reach: float, refine: int, step: float) -> Solver:
    """Finite elements as the truth's, coarser or not, led through all its depths, for what sticks goes by the way."""
    fem = PatchFem(element="P1xP2", layers=1, refine=refine, reach=reach)
    solver = IndenterFem(fem, step=step).prepare(layer)

    def found(every: Sequence[Pressed]) -> Found:
        press = Press(every[0].field, every[0].pose, every[0].way).touching(layer)
        assert press is not None
        depths = [float((one.pose - press.pose_body_from_tool)[:3, 3] @ press.direction) for one in every]
        began = time.process_time()
        answers = solver.path([press], depths)
        for _ in depths:
            answer = next(answers, None)
            took = time.process_time() - began
            known = answer is not None and answer.trust.converged
            yield (pressing(layer, answer.traction), answer.displacement, took) if answer and known else None

    return found


def pressing(layer: SoftLayer, traction: np.ndarray) -> np.ndarray:
    """Force (3,) [N] that contact tractions (V, 3) [Pa] press with: along what is across the skin, without drag."""
    across = np.minimum(0.0, np.einsum("vi,vi->v", traction, layer.normals)) @ layer.vertex_area_vectors
    return (layer.vertex_areas @ traction) @ across / (across @ across) * across


def flex(layer: SoftLayer, refine: int) -> Solver:
    """MuJoCo's flex under balls."""
    from studies.peers.layered_flex import LayeredFlex

    def found(every: Sequence[Pressed]) -> Found:
        for one in every:
            info = one.sample.info
            if info["drawn"]["tool"] != "sphere" or not PEER_AT[0] < info["ratio"] < PEER_AT[1]:
                yield None
                continue
            radius = float(np.linalg.norm(one.tool.vertices, axis=1).max())
            peer = LayeredFlex(layer, one.sample.load.loaded, radius, refine=refine, timestep=PEER_STEP)
            touching = Press(one.field, one.pose, one.way).touching(layer)
            assert touching is not None
            share = np.linspace(0, 1, PEER_STEPS + 1)[1:, None]
            start, end = touching.pose_body_from_tool[:3, 3], one.pose[:3, 3]
            began = time.process_time()
            held = peer.press(start + share * (end - start))
            log.info("flex: %s, min det F %.2f, %.2f mm in the ball", held.rests, held.min_j, 1e3 * held.entered)
            yield pressing(layer, held.traction), held.displacement, time.process_time() - began

    return found


def solvers(plan: Plan, body: str, layer: SoftLayer) -> Iterator[tuple[str, str, Callable[[], Solver]]]:
    """Curve, setting, and what prepares the solver."""
    yield "elastic foundation", "", lambda: simpler(layer, columns=True)
    yield "ours without its network", "", lambda: simpler(layer, columns=False)
    yield ONE_LAYER, "", lambda: ours(alone(layer))
    yield OURS, "the limb's mesh", lambda: ours(layer)
    yield OURS, "a coarser mesh", lambda: ours(layer, COARSER)
    reach, step = plan.body(body).reach, plan.indenter_step
    for refine, name in REFINED.items():
        yield FEM, name, lambda r=refine: elements(layer, reach, r, step)
    if "mujoco_flex" in installed():
        for refine, name in enumerate(("the limb's mesh", "refined once")):
            yield PEER, name, lambda r=refine: flex(layer, r)


def measured(released: Released, kind: str, path: Path) -> list[Row]:
    """All answers to scenes of a kind; each contact is kept in a file as soon as it is done."""
    kept: dict[str, list] = json.loads(path.read_text()) if path.exists() else {}
    splits, names = LIMBS[kind]
    samples = [one for split in splits for one in released.samples(split)
               if slant_of(one) <= STRAIGHT and one.info["body"].startswith(names)]  # fmt: skip
    contacts = [list(group) for _, group in
                groupby(pressed(samples), lambda one: (one.sample.info["body"], one.sample.info["number"]))]
    nets = cache(lambda body: Simulator(released.layers[body], MomentNet()).toucher.net)
    for body, mine in groupby(contacts, lambda every: every[0].sample.info["body"]):
        several = list(mine)
        for curve, setting, make in solvers(released.plan, body, released.layers[body]):
            solver = None
            for every in several:
                key = f"{kind}, {body}, {every[0].sample.info['number']}: {curve}, {setting}"
                if key in kept:
                    continue
                solver, rows = solver or make(), []
                for one, found in zip(every, solver(every), strict=True):
                    if found is not None and seen(one, nets(body)) is not None:
                        wrong = off(one, *found[:2])
                        scene = f"{body} {one.sample.info['number']} at {one.sample.info['ratio']:.2f} t"
                        rows.append(Row(curve, setting, scene, 1 + wrong.force, wrong.moves, found[2]))
                log.info("%s: %s", key, " ".join(f"{100 * (r.force - 1):+.1f}/{100 * r.moves:.1f} % {r.took:.2g} s;"
                                                 for r in rows))  # fmt: skip
                kept[key] = rows
                path.write_text(json.dumps(kept, indent=1))
    return [Row(*row) for key, rows in kept.items() if key.startswith(f"{kind}, ") for row in rows]


def best(shares: np.ndarray) -> float:
    """Factor on forces over the true ones, (N,), that leaves the least mean error: one of those that set one right."""
    return float(min(1 / shares, key=lambda factor: np.abs(factor * shares - 1).mean()))


def shared(rows: Sequence[Row]) -> list[Row]:
    """The rows of scenes that every setting has an answer to."""
    settings = {row[:2] for row in rows}
    known = [{row.scene for row in rows if row[:2] == setting} for setting in settings]
    return [row for row in rows if row.scene in set.intersection(*known)]


def points(rows: Sequence[Row]) -> Iterator[Point]:
    """The rows, a setting after another."""
    for curve, setting in dict.fromkeys(row[:2] for row in rows):
        mine = [row for row in rows if row[:2] == (curve, setting)]
        shares = np.array([row.force for row in mine])
        for body in {row.scene.split()[0] for row in mine} if curve == ONE_LAYER else ():
            here = [row.scene.startswith(f"{body} ") for row in mine]
            shares[here] *= best(shares[here])
        wrong = 100 * np.abs(shares - 1)
        yield Point(curve, setting, len(mine), float(wrong.mean()), float(np.quantile(wrong, 0.9)),
                    100 * float(np.mean([row.moves for row in mine])),
                    1e3 * float(np.median([row.took for row in mine])))  # fmt: skip


def table(every: Sequence[Point]) -> Iterator[str]:
    """The points, in Markdown."""
    yield "| model | setting | scenes | force off, mean | 90 % | motion off | an answer |"
    yield "| --- | --- | ---: | ---: | ---: | ---: | ---: |"
    for one in every:
        yield (f"| {one.curve} | {one.setting} | {one.scenes} | {one.force:.2g} % | {one.most:.2g} % | "
               f"{one.motion:.2g} % | {one.took:.3g} ms |")  # fmt: skip


def draw(every: Sequence[Point], path: Path) -> None:
    """Error of the force, and of the motion, over the time of an answer; hollow: the truth's own setting again."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 5), layout="constrained", sharex=True)
    for axis, what in zip(axes, ("force", "motion"), strict=True):
        for k, curve in enumerate(dict.fromkeys(one.curve for one in every)):
            mine = sorted((one for one in every if one.curve == curve), key=lambda one: one.took)
            took, off_by = [one.took for one in mine], [max(getattr(one, what), LEAST) for one in mine]
            marker = "^" if curve == PEER else "o"
            axis.plot(took, off_by, "-", color=f"C{k}", lw=1, alpha=0.5)
            for one, x, y in zip(mine, took, off_by, strict=True):
                again = one.setting == REFINED[max(REFINED)]
                axis.plot(x, y, marker, color=f"C{k}", mfc="none" if again else f"C{k}", ms=9, mew=1.6)
            axes[1].plot([], [], marker, color=f"C{k}", label=curve if axis is axes[1] else None)
        axis.set(xscale="log", yscale="log", xlabel="time of an answer, one core [ms]", ylabel="off [%]", title=what,
                 ylim=(0.8 * LEAST, None))  # fmt: skip
        axis.grid(alpha=0.3, which="both")
    axes[0].axhspan(LEAST / 2, TRUTH_OFF, color="0.9", zorder=0, label="no more than the truth itself is off")
    axes[1].plot([], [], "o", color="0.4", mfc="none", label="the truth's own setting again")
    for axis in axes:
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measures, prints, draws."""
    plt.switch_backend("agg")
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--out", type=Path, required=True, help="folder of what was found")
    options.add_argument("--limbs", choices=list(LIMBS), default="a forearm left out", help="row of benchmarks.limbs")
    options.add_argument("--picture", type=Path, default=PICTURE, help="picture")
    given = options.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    logging.getLogger("stmpl_core").setLevel(logging.ERROR)
    given.out.mkdir(parents=True, exist_ok=True)
    rows = measured(Released(FILE), given.limbs, given.out / "answers.json")
    found = list(points(rows))
    print("\n".join(table(found)))
    print("\nWhat all answer:\n", *table(list(points(shared(rows)))), sep="\n")
    draw(found, given.picture)


if __name__ == "__main__":
    main()
