"""Soft skin in simulators: ours, MuJoCo's rigid contact and flex, Newton's soft bodies, beside finite elements.

    pip install "stmpl[sim,peers]"
    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 .venv/bin/python -m benchmarks.peers_sim --out runs/peers_sim

A ball of 15 mm radius on a slab of 10 mm (E = 20 kPa, nu = 0.4): pressed 1 to 5 mm deep, and slid over 30 mm at 3 mm
with a coefficient of friction of 0.3; the second once more without friction, for the energy of a press, a slide and a
release, which an elastic slab gives back. On one core; each simulator with its own timestep. Writes figures.json and
peers_sim.png; what finite elements say is kept in truth.npz. Some 15 minutes on a core of its own; goes on where it was
stopped.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

from benchmarks.slides import field
from fem_tools import IndenterFem, PatchFem
from fem_tools.stroke import Stroke
from stmpl_core.layer import SoftLayer
from stmpl_core.tissue import Tissue
from stmpl_sim.energy import EnergyBook
from studies.peers.led_ball import DEFAULT, FlexRig, Ground, Rig, RigidRig, SkinRig, Solver
from tests.scenes import plate

log = logging.getLogger(__name__)

GROUND = Ground((0.10, 0.07), 10e-3, Tissue(20e3, 0.4), 15e-3, 0.3)
DEPTHS = np.arange(1, 6) * 1e-3  # of the press [m]
SLIDE_DEPTH, SLIDE, SPEED = 3e-3, 30e-3, 0.05  # of the slide [m], its length [m], its speed [m/s]
SINK_S, HOLD_S, LOOK_S = 0.15, 0.15, 0.05  # times to sink, to rest, and of that the last that is looked at [s]
FITTED = 3e-3  # depth at which rigid contact is fitted [m]
OTHERS = replace(GROUND, radius=8e-3), replace(GROUND, mass=10.0)  # what nothing was fitted to, at that depth
DAMPING, IMPRATIO = 0.02, 10.0  # of the rigid contact that is fitted at all depths, so that it slips as it should


class Course(NamedTuple):
    """Where the ball is led, by times (N,) [s], heights of its lowest point under the skin and ways along it [m]."""

    time: np.ndarray
    depth: np.ndarray
    along: np.ndarray

    def at(self, when: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Place of the ball's middle, (3,) [m], and its velocity [m/s]."""
        spots = [np.array([np.interp(t, self.time, self.along), 0.0, radius - np.interp(t, self.time, self.depth)])
                 for t in (when, when + 1e-6)]  # fmt: skip
        return spots[0], (spots[1] - spots[0]) / 1e-6


def press() -> Course:
    """Down in stairs, resting at each depth."""
    time = np.cumsum([0.0, *[SINK_S, HOLD_S] * len(DEPTHS)])
    depth = np.concatenate([[-1e-5], np.repeat(DEPTHS, 2)])
    return Course(time, depth, 0 * depth)


def rest() -> Course:
    """Down to the depth that rigid contact is fitted at, and resting."""
    return Course(np.array([0.0, 0.3, 0.6]), np.array([-1e-5, FITTED, FITTED]), np.zeros(3))


def slide() -> Course:
    """Down, along, and up again."""
    time = np.cumsum([0.0, 0.3, HOLD_S, SLIDE / SPEED, HOLD_S, 0.3, 0.05])
    depth = np.array([-1e-4, *[SLIDE_DEPTH] * 4, -1e-4, -1e-4])
    return Course(time, depth, SLIDE * np.array([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5, 0.5]))


class Trace(NamedTuple):
    """What a rig did, a row a step: time [s], place of the ball (N, 3) [m], force on it (N, 3) [N], processor time [s].

    `radius` is the ball's [m]; `held` the work that the slab holds of what the ball gave it [J], `most` the most of it.
    """

    time: np.ndarray
    place: np.ndarray
    force: np.ndarray
    busy: np.ndarray
    radius: float
    held: float
    most: float

    @property
    def depth(self) -> np.ndarray:
        """Depths of the ball's lowest point [m]."""
        return self.radius - self.place[:, 2]

    def real_time(self) -> float:
        """Simulated time over processor time, while the ball is in the skin [-]."""
        busy = self.depth > 1e-4
        return (self.time[1] - self.time[0]) * busy.sum() / self.busy[busy].sum()


def played(make: Callable[[Ground], Rig], course: Course, ground: Ground = GROUND) -> Trace:
    """Leads the ball along a course."""
    rig, rows, book, pose = make(ground), [], EnergyBook(), np.eye(4)
    for k in range(int(course.time[-1] / rig.timestep)):
        goal, begun = course.at(k * rig.timestep, ground.radius), time.process_time()
        place, force = rig.step(*goal)
        busy = time.process_time() - begun
        pose = pose.copy()
        pose[:3, 3] = place
        book.add(pose, np.concatenate([force, np.zeros(3)]))
        rows.append((k * rig.timestep, place, force, busy))
    columns = (np.array(column) for column in zip(*rows, strict=True))
    return Trace(*columns, radius=ground.radius, held=book.held, most=book.most)


class Truth(NamedTuple):
    """What finite elements say: force at depths of a press, along and into a slide by the way, and on OTHERS [N]."""

    depth: np.ndarray
    force: np.ndarray
    way: np.ndarray
    along: np.ndarray
    normal: np.ndarray
    others: np.ndarray

    def at(self, depth: np.ndarray) -> np.ndarray:
        """Force at depths of a press [N]."""
        return PchipInterpolator(np.append(0.0, self.depth), np.append(0.0, self.force))(depth)


def truth(path: Path) -> Truth:
    """From a file, or computed and kept there."""
    if path.exists():
        with np.load(path) as kept:
            return Truth(*(kept[name] for name in Truth._fields))
    layer = skin(5e-3)
    fem = PatchFem(element="P1xP2", layers=2, refine=3, reach=4, check_stability=False)
    solver = IndenterFem(fem, friction=GROUND.friction, step=0.1).prepare(layer)

    def wrenches(depth: np.ndarray, along: np.ndarray, radius: float = GROUND.radius) -> np.ndarray:
        poses = np.tile(np.eye(4), (len(depth), 1, 1))
        poses[:, :3, 3] = np.stack([along, 0 * along, radius - depth], axis=1)
        found = []
        for answer in solver.follow([Stroke(field(radius), poses, np.array([0.0, 0.0, -1.0]))]):
            log.info("finite elements %d/%d: %s", len(found) + 1, len(poses), answer.trust.why or "ok")
            found.append(-answer.wrenches[0][:3])
        return np.array(found)

    depth = np.concatenate([[-1e-5], np.arange(1, 11) * 0.5e-3])
    pressed = wrenches(depth, 0 * depth)[1:, 2]
    way = np.arange(1, 31) * 1e-3
    slid = wrenches(np.concatenate([[-1e-5], DEPTHS[:3], np.full(len(way), SLIDE_DEPTH)]),
                    np.concatenate([np.zeros(4), way]) - SLIDE / 2)[4:]  # fmt: skip
    small = wrenches(depth[:7], 0 * depth[:7], OTHERS[0].radius)[-1, 2]
    others = np.array([small, pressed[5]])
    found = Truth(depth[1:], pressed, way - SLIDE / 2, -slid[:, 0], slid[:, 2], others)
    np.savez_compressed(path, **found._asdict())
    return found


@cache
def skin(edge: float) -> SoftLayer:
    """The slab's skin, its triangles' legs so long [m]."""
    size = round(0.16 / edge) * edge
    tissue = GROUND.tissue
    return plate(size, edge, GROUND.thickness, crossed=True, youngs_modulus=tissue.youngs_modulus,
                 poisson_ratio=tissue.poisson_ratio)  # fmt: skip


def fitted(truth: Truth, all_depths: bool) -> tuple[Solver, float]:
    """solref and solimp, and impratio, of a rigid contact with the true force at one depth, or nearly at all.

    At rest the force is m d^2 k r / ((1 - d) dmax^2) at the penetration r, with the mass m, the stiffness k of solref
    and the impedance d of solimp, which rises to dmax (MuJoCo's documentation, Computation, "Reference"); here
    evenly, from dmin.
    """

    def force(depth: np.ndarray, k: float, low: float, high: float, width: float) -> np.ndarray:
        d = low + (high - low) * np.clip(depth / width, 0, 1)
        return GROUND.mass * d**2 * k * depth / high**2 / (1 - d)

    def off(x: np.ndarray) -> np.ndarray:
        return force(DEPTHS, *np.exp(x)) / truth.at(DEPTHS) - 1

    if not all_depths:
        k = float(truth.at(np.array(FITTED)) / force(np.array(FITTED), 1.0, 0.9, 0.95, 1e-3))
        return (f"{-k} {-2 * k**0.5}", DEFAULT[1]), 1.0
    lowest, highest = np.log([1.0, 1e-3, 1e-2, 5.1e-3]), np.log([1e5, 0.5, 0.9, 0.05])
    k, low, high, width = np.exp(least_squares(off, np.log([100.0, 0.05, 0.3, 8e-3]), bounds=(lowest, highest)).x)
    return (f"{-k} {-2 * DAMPING * k**0.5}", f"{low} {high} {width} 0.5 1"), IMPRATIO


@dataclass(frozen=True)
class Row:
    """What one rig came to.

    Args:
        curve: name of the simulator, with its material.
        setting: its knob.
        errors: errors of the force at DEPTHS, signed [-].
        along: error of the force along the slide [-].
        ripple: force into the skin along the slide, peak to peak, over its mean [-].
        others: errors of the force at 3 mm with a ball of 8 mm, and with 10 kg behind the ball [-].
        taken: energy of press, slide and release that did not come back, over the most that was held [-]; below 0:
            what came out and was not put in.
        real_time: simulated time over processor time in contact [-].
        timestep: timestep [s].
    """

    curve: str
    setting: str
    errors: tuple[float, ...]
    along: float
    ripple: float
    others: tuple[float, ...]
    taken: float
    real_time: float
    timestep: float

    @property
    def error(self) -> float:
        """Mean size of the errors at all depths [-]."""
        return float(np.abs(self.errors).mean())


def judged(curve: str, setting: str, make: Callable[[Ground], Rig], truth: Truth) -> Row:
    """Plays all courses."""
    pressed, errors = played(make, press()), []
    for end in (np.arange(len(DEPTHS)) + 1) * (SINK_S + HOLD_S):
        still = (pressed.time > end - LOOK_S) & (pressed.time <= end - 1e-9)
        errors.append(float((pressed.force[still, 2] / truth.at(pressed.depth[still])).mean() - 1))
    others = []
    for ground, true in zip(OTHERS, truth.others, strict=True):
        trace = played(make, rest(), ground)
        still = trace.time > trace.time[-1] - LOOK_S
        given = true * truth.at(trace.depth[still]) / truth.at(np.array(FITTED))  # the servo gives way a little
        others.append(float((trace.force[still, 2] / given).mean() - 1))
    slid = played(make, slide())
    middle = (np.abs(slid.place[:, 0]) < SLIDE / 3) & (slid.depth > 0.9 * SLIDE_DEPTH)
    force, there = slid.force[middle], np.abs(truth.way) < SLIDE / 3
    given = truth.along[there].mean() * truth.at(slid.depth[middle]).mean() / truth.at(np.array(SLIDE_DEPTH))
    smooth = played(make, slide(), replace(GROUND, friction=0.0))
    row = Row(curve, setting, tuple(errors), float(-force[:, 0].mean() / given - 1),
              float(np.ptp(force[:, 2]) / force[:, 2].mean()), tuple(others), smooth.held / smooth.most,
              float(slid.real_time()), float(slid.time[1]))  # fmt: skip
    log.info("%s", row)
    return row


def rigs(truth: Truth, quick: bool) -> Iterator[tuple[str, str, Callable[[Ground], Rig]]]:
    """Curve, setting, and what makes the rig."""
    for timestep in (2e-3, 1e-3):
        yield ("stmpl, SoftBody", f"triangles of 4 mm, {1 / timestep:g} Hz",
               lambda g, t=timestep: SkinRig(g, skin(4e-3), t))  # fmt: skip
    for all_depths, name in ((False, f"at {1e3 * FITTED:g} mm"), (True, "at all depths")):
        solver, impratio = fitted(truth, all_depths)
        settings = [f"{float(x):.3g}" for x in " ".join(solver).split()]
        setting = f"solref {' '.join(settings[:2])}, solimp {' '.join(settings[2:])}"
        yield (f"MuJoCo, rigid contact fitted {name}", setting,
               lambda g, s=solver, i=impratio: RigidRig(g, s, i))  # fmt: skip
    yield "MuJoCo flex, all defaults", "2 layers", lambda g: FlexRig(g, 2, "stvk", solver=DEFAULT)
    for layers in (1, 2) if quick else (1, 2, 3):
        yield "MuJoCo flex, StVK", f"{layers} layers", lambda g, n=layers: FlexRig(g, n, "stvk")
        yield "MuJoCo flex, SNH", f"{layers} layers", lambda g, n=layers: FlexRig(g, n, "snh")
    yield "MuJoCo flex, StVK, quadratic cells", "1 cell", lambda g: FlexRig(g, 2, "stvk", "quadratic")
    if find_spec("newton") is not None:
        from studies.peers.led_ball_newton import NewtonRig

        for layers in (1, 2):
            yield "Newton VBD", f"{layers} layers", lambda g, n=layers: NewtonRig(g, n)


def table(rows: list[Row]) -> Table:
    """The rows for people."""
    shown = Table(title="against IndenterFem [%]; real time on one core")
    for heading in ("simulator", "setting", *(f"{1e3 * d:g} mm" for d in DEPTHS), "8 mm ball", "10 kg", "slide, along",
                    "ripple", "energy not given back", "step [ms]", "real time"):  # fmt: skip
        shown.add_column(heading, justify="left" if heading in ("simulator", "setting") else "right")
    for row in rows:
        shown.add_row(row.curve, row.setting, *(f"{100 * e:+.0f}" for e in (*row.errors, *row.others, row.along)),
                      f"{100 * row.ripple:.1f}", f"{100 * row.taken:+.1f}", f"{1e3 * row.timestep:.2g}",
                      f"{row.real_time:.2g}")  # fmt: skip
    return shown


def draw(rows: list[Row], path: Path) -> None:
    """Error of the force over the real-time factor, a curve a simulator, in the manner of the speed chart."""
    colours = ("tab:red", "0.55", "0.2", "tab:brown", "tab:olive", "tab:blue", "tab:cyan", "tab:green")
    figure = Figure(figsize=(9, 4.2), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2)
    left.axvline(1.0, color="0.8", lw=1)
    left.text(1.03, 101, "real time", fontsize=7, color="0.5", va="bottom")
    for name, colour in zip(dict.fromkeys(row.curve for row in rows), colours, strict=False):
        mine = [row for row in rows if row.curve == name]
        left.plot([r.real_time for r in mine], [100 * r.error for r in mine], "o-", color=colour, ms=5, lw=1,
                  label=name)  # fmt: skip
        right.plot(1e3 * DEPTHS, 100 * np.array(mine[-1].errors), "o-", color=colour, ms=4, lw=1)
    left.set(xscale="log", yscale="log", xlabel="real-time factor on one core, sliding",
             ylabel="error of the force, mean of 1 to 5 mm [%]", title="a curve: finer and finer")  # fmt: skip
    right.axhline(0, color="0.8", lw=1)
    right.set(xlabel="depth [mm] of a 10 mm layer", ylabel="error of the force [%]", title="the finest of each")
    right.set_yscale("symlog", linthresh=10)
    right.set_yticks([-100, -50, -20, -10, -5, 0, 5, 10, 20, 50, 100, 200])
    right.yaxis.set_major_formatter("{x:g}")
    for axes in (left, right):
        axes.grid(True, which="major", alpha=0.25)
    figure.legend(loc="outside lower center", ncol=3, fontsize=8, frameon=False)
    figure.savefig(path)


def main() -> None:
    """Measures, prints, draws."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--out", type=Path, default=Path("runs/peers_sim"), help="folder of the files")
    options.add_argument("--quick", action="store_true", help="coarse settings only")
    given = options.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    given.out.mkdir(parents=True, exist_ok=True)
    true, kept = truth(given.out / "truth.npz"), given.out / "figures.json"
    rows = [Row(**row) for row in json.loads(kept.read_text())] if kept.exists() else []
    log.info("finite elements: %s N at %s mm", np.round(true.at(DEPTHS), 3), 1e3 * DEPTHS)
    for curve, setting, make in rigs(true, given.quick):
        if any((row.curve, row.setting) == (curve, setting) for row in rows):
            continue
        if curve.startswith("stmpl"):
            played(make, slide())  # compiled once
        rows.append(judged(curve, setting, make, true))
        kept.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    order = [(curve, setting) for curve, setting, _ in rigs(true, given.quick)]
    rows = sorted((row for row in rows if (row.curve, row.setting) in order),
                  key=lambda row: order.index((row.curve, row.setting)))  # fmt: skip
    Console(width=200).print(table(rows))
    draw(rows, given.out / "peers_sim.png")


if __name__ == "__main__":
    main()
