"""One scene by every model of it: what a term of the model is worth, and what it costs, by us and by finite elements.

    .venv/bin/python -m benchmarks.models --out runs/models             # an hour, most of it finite elements
    .venv/bin/python -m benchmarks.models --out runs/models --ours      # beside the finite elements that lie there

A ball of 40 mm is pressed 8 mm into a forearm as measured, held for a second, led along it by 24 mm at 50 mm/s with a
coefficient of friction of 0.6, and held again; all its tissue relaxes. The truth is the richest model in finite
elements: skin, fat and muscle that relax, on bones, and Coulomb friction. Others leave something out. "One layer" and
"skin on one layer" go down to the same bones, with the modulus that holds the ball as the whole stack does at first.

Errors are root mean squares along the stroke: of the force, of its largest; of the motion where the skin moves more
than a tenth of the peak, of that. Time is of one step: contact and motion of the whole skin, on one core (set
OMP_NUM_THREADS=1); of finite elements a pose of the stroke. These may stop on the way; what they say until then counts.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import brentq

from benchmarks import slides
from benchmarks.beside_slides import BETWEEN, MOVES, between
from benchmarks.living_limbs import ball, site
from stmpl_core import Contact, Simulator, SoftLayer, State
from stmpl_core.living import held_skin
from stmpl_core.methods import MomentNet
from stmpl_core.stack import ball as pressed
from stmpl_core.tissue import Tissue

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "models.png"
RADIUS, DEPTH, LENGTH, SPEED, MU = 0.02, 8e-3, 24e-3, 0.05, 0.6  # ball [m], its stroke [m, m, m/s], friction [-]
RUNGS = ("one layer", "skin on one layer", "skin, fat, muscle")
MARKERS = {(False, False): "o", (True, False): "^", (False, True): "s", (True, True): "D"}  # of time and slip
LEAST = 0.3  # error at which the truth is drawn [%]


@dataclass(frozen=True)
class Model:
    """What a model of the scene has.

    Args:
        rung: 0: one layer; 1: a skin on one layer; 2: skin, fat and muscle on bones.
        time: whether the tissue relaxes.
        slip: whether the tool slides where it pulls more than friction holds.
    """

    rung: int
    time: bool
    slip: bool

    @property
    def name(self) -> str:
        """How people call it."""
        more = [word for word, has in (("time", self.time), ("slip", self.slip)) if has]
        return " + ".join([RUNGS[self.rung], *more])

    def layer(self) -> SoftLayer:
        """The forearm as this model has it."""
        layer = forearm(self.rung)
        return held_skin(layer) if self.time else layer


OURS = [Model(rung, time, slip) for rung in (0, 1, 2) for time, slip in
        ((False, False), (True, False), (False, True), (True, True))]  # fmt: skip
THEIRS = [Model(2, True, True), Model(1, True, True), Model(0, True, True), Model(2, False, True)]


@cache
def forearm(rung: int) -> SoftLayer:
    """A forearm as measured, or one material of such a modulus that it presses back as hard under the ball at first."""
    measured = slides.forearm(False).layer
    if rung == 2:
        return measured
    tissue, here = measured.tissue, float(measured.thickness[site(measured, "left_forearm")])
    skin = tissue.skin if rung else None
    small = 0.1 * DEPTH
    wanted = pressed(tissue, here, RADIUS, depth=small).force

    def one(modulus: float) -> Tissue:
        return Tissue(modulus, tissue.poisson_ratio, skin=skin)

    modulus: Any = brentq(lambda e: pressed(one(e), here, RADIUS, depth=small).force - wanted, 100.0, 1e6)
    return measured.with_(tissue=one(modulus), ply_scale=None)


def scene(model: Model) -> slides.Scene:
    """The stroke by finite elements."""
    measured = slides.forearm(False)  # whose place and way it is, by whichever model

    def ground() -> slides.Ground:
        return slides.Ground(model.layer(), measured.frame, measured.fem)

    return slides.Scene(ground, RADIUS, lambda _: slides.stroked(measured, RADIUS, DEPTH, LENGTH, SPEED),
                        MU if model.slip else "stick", 0.15)  # fmt: skip


class Off(NamedTuple):
    """How far a model is off the truth along the stroke, and what it takes.

    Args:
        who: "ours" or "finite elements".
        model: model.
        force, motion: root mean squares [%].
        took: time of a step [ms].
        flagged: share of the steps that say that they are not to be relied upon [-].
    """

    who: str
    model: Model
    force: float
    motion: float
    took: float
    flagged: float = 0.0


def off(wrench: np.ndarray, moved: np.ndarray, truth: dict[str, np.ndarray]) -> tuple[float, float]:
    """Root mean squares of the error of force and motion [%]: wrenches (N, 6), motion at the truth's `at` (K, V, 3)."""
    count = min(len(wrench), len(truth["wrench"]))
    wrong = np.linalg.norm(wrench[:count, :3] - truth["wrench"][:count, :3], axis=1)
    force = np.sqrt((wrong**2).mean()) / np.linalg.norm(truth["wrench"][:, :3], axis=1).max()
    size = np.linalg.norm(truth["displacement"], axis=2)
    moves = size[: len(moved)] > MOVES * size.max()
    away = np.linalg.norm(moved - truth["displacement"][: len(moved)], axis=2)[moves]
    return 100 * float(force), 100 * float(np.sqrt((away**2).mean()) / size.max())


def ours(model: Model, truth: dict[str, np.ndarray]) -> Off:
    """Our answer along the stroke, by a model."""
    simulator = Simulator(model.layer(), MomentNet(), friction=MU if model.slip else None)
    tool, poses, times = ball(RADIUS), truth["pose"], truth["time"]
    state, wrenches, moved, took, flags = State(), [], [], [], []
    remembers = model.time or model.slip
    for k, pose in enumerate(poses):
        for part in range(1, BETWEEN + 1) if k and remembers else (1,):
            there = between(poses[k - 1], pose, part / BETWEEN) if k and remembers else pose
            dt = (times[k] - times[k - 1]) / BETWEEN if k else 0.0
            began = time.perf_counter()
            touches, state = simulator.touch([Contact(tool, there)], state, dt) if remembers else \
                (simulator.touch([Contact(tool, there)]), state)  # fmt: skip
            touched = time.perf_counter() - began
        wrenches.append(touches[0].wrench)
        began = time.perf_counter()
        answer = simulator.answer(touches)
        took.append(touched + time.perf_counter() - began)
        flags.append(not answer.trust.in_range)
        if k in truth["at"]:
            moved.append(answer.displacement)
    return Off("ours", model, *off(np.array(wrenches), np.array(moved), truth), 1e3 * float(np.median(took)),
               float(np.mean(flags)))  # fmt: skip


def theirs(model: Model, folder: Path, truth: dict[str, np.ndarray]) -> Off:
    """Finite elements of a model, from where they lie."""
    found = read(folder, model)
    about = json.loads(str(found["about"]))
    both = np.intersect1d(found["at"], truth["at"])  # the poses at which both files have the motion
    moved = found["displacement"][np.isin(found["at"], both)]
    same = truth | {"displacement": truth["displacement"][np.isin(truth["at"], both)]}
    return Off("finite elements", model, *off(found["wrench"], moved, same),
               1e3 * about["seconds"] / about["played"])  # fmt: skip


def read(folder: Path, model: Model) -> dict[str, np.ndarray]:
    """What finite elements wrote of a model, as far as they converged."""
    with np.load(folder / f"{model.name}.npz") as file:
        kept = dict(file)
    many = int(kept["ok"].sum())
    known = kept["at"] < many
    along = {name: kept[name][:many] for name in ("pose", "time", "wrench")}
    return kept | along | {name: kept[name][known] for name in ("at", "displacement")}


def draw(rows: list[Off], path: Path) -> None:
    """Error of the force, and of the motion, over the time of a step."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 5), layout="constrained", sharex=True)
    for axis, what in zip(axes, ("force", "motion"), strict=True):
        for row in rows:
            colour, fem = f"C{row.model.rung}", row.who != "ours"
            axis.plot(row.took, max(getattr(row, what), LEAST), MARKERS[row.model.time, row.model.slip], color=colour,
                      mfc="none" if fem else colour, ms=11, mew=1.6)  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel="time of a step [ms]", ylabel="off [%]", title=what)
        axis.grid(alpha=0.3, which="both")
    for rung in range(len(RUNGS)):
        axes[1].plot([], [], "o", color=f"C{rung}", label=RUNGS[rung])
    for (slow, slips), marker in MARKERS.items():
        axes[1].plot([], [], marker, color="0.4", label=" + ".join([*["time"] * slow, *["slip"] * slips]) or "neither")
    axes[1].plot([], [], "o", color="0.4", mfc="none", label="finite elements; the truth, 0 %, at the bottom")
    axes[1].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def table(rows: list[Off]) -> Iterator[str]:
    """The rows, in Markdown."""
    yield "| who | model | force off | motion off | a step | flagged |"
    yield "| --- | --- | ---: | ---: | ---: | ---: |"
    for row in rows:
        yield (f"| {row.who} | {row.model.name} | {row.force:.1f} % | {row.motion:.1f} % | {row.took:.3g} ms | "
               f"{100 * row.flagged:.0f} % |")  # fmt: skip


def main() -> None:
    """Solves, compares, prints, draws."""
    plt.switch_backend("agg")
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--out", type=Path, required=True, help="folder of the finite elements")
    options.add_argument("--ours", action="store_true", help="no finite elements but those that lie there")
    options.add_argument("--picture", type=Path, default=PICTURE, help="picture")
    given = options.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    given.out.mkdir(parents=True, exist_ok=True)
    for model in () if given.ours else THEIRS:
        if not (given.out / f"{model.name}.npz").exists():
            slides.played(model.name, scene(model), given.out)
    truth = read(given.out, THEIRS[0])
    rows = [ours(model, truth) for model in OURS]
    rows += [theirs(model, given.out, truth) for model in THEIRS if (given.out / f"{model.name}.npz").exists()]
    print("\n".join(table(rows)))
    draw(rows, given.picture)


if __name__ == "__main__":
    main()
