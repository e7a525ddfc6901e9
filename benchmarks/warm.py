"""Finite elements from frame to frame: WarmPatchFem beside PatchFem on paths of loads, in one run.

python -m benchmarks.warm [--edge-mm 3] [--repeats 3]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks.ground_truth import sites
from fem_tools import PatchFem, WarmPatchFem
from fem_tools.ladder import ladder
from fem_tools.scenes import EDGE, Site, smoothstep
from stmpl_core.body import Body
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import Method
from stmpl_core.provenance import machine
from stmpl_core.trust import Displacement

TOOLS = {"fingertip, 12 mm": 6e-3, "disc, 20 mm": 10e-3, "disc, 40 mm": 20e-3}  # radius [m]
STEP = 1e-3  # m, of a slide, a frame
RATIO, PRESS = 0.5, 0.1  # p / E of a slide; more of it a frame where it presses deeper, 0.05 thicknesses
WISH = 1e-5  # m, accuracy that is asked of a ladder: finite elements alone promise it
JUDGED = 6  # frames from one that is compared with finer elements, two deep, to the next


def paths(layer: SoftLayer, radius: float) -> dict[str, list[Load]]:
    """Loads of each path."""
    here, _, there = sites(layer, 3)
    nearest = int(np.linalg.norm(layer.vertices - here, axis=1).argmin())
    along = STEP * Site(layer).axis(nearest)

    def load(centre: np.ndarray, ratio: float = RATIO) -> Load:
        k = int(np.linalg.norm(layer.vertices - centre, axis=1).argmin())
        normal = layer.normals[k]
        centre = centre + (layer.vertices[k] - centre) @ normal * normal
        away = np.linalg.norm(layer.vertices - centre, axis=1)
        weight = smoothstep((radius - away) / EDGE + 0.5)
        return Load.pressure(ratio * layer.tissue.youngs_modulus * weight)

    return {
        "presses deeper": [load(here, PRESS * k) for k in range(1, 13)],
        "slides": [load(here + k * along) for k in range(24)],
        "slides and turns back": [load(here + k * along) for k in (*range(6), *range(4, -1, -1))],
        "jumps": [load(centre) for centre in (here, here + along, there, there + along, there + 20 * along)],
    }


def run(method: Method, layer: SoftLayer, loads: list[Load], repeats: int) -> tuple[np.ndarray, list[Displacement]]:
    """The shortest processor time of each frame over some runs [s], and the answers."""
    spent, answers = np.full(len(loads), np.inf), []
    for _ in range(repeats):
        method.prepare(layer)
        answers = []
        for k, load in enumerate(loads):
            started = time.process_time()
            answers.append(method.solve(load))
            spent[k] = min(spent[k], time.process_time() - started)
    return spent, answers


def main() -> None:
    """Prints the table."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--edge-mm", type=float, default=3.0)
    given.add_argument("--repeats", type=int, default=3)
    options = given.parse_args()
    layer = Body.anny().part("left_arm", edge_length=1e-3 * options.edge_mm)
    title = f"{layer}\n{machine()}, one thread; shortest of {options.repeats} runs of each frame; ms, in the middle"
    table = Table(title=title, title_justify="left")
    columns = ("PatchFem", "first frame", "warm", "over PatchFem", "slowest", "a ladder with it", "meshed anew",
               "off PatchFem, % of peak", "bound over error")  # fmt: skip
    for column in ("load", "path", *columns):
        table.add_column(column, justify="left" if column in ("load", "path") else "right")
    with threadpool_limits(1):
        cold, warm = PatchFem(check_stability=False), WarmPatchFem()
        finer = PatchFem(refine=1, layers=2, reach=8, check_stability=False).prepare(layer)
        for tool, radius in TOOLS.items():
            for path, loads in paths(layer, radius).items():
                usual, truth = run(cold, layer, loads, options.repeats)
                spent, answers = run(warm, layer, loads, options.repeats)
                climbed, _ = run(ladder(accuracy=WISH, warm=True), layer, loads, options.repeats)
                slack = [(answers[k].trust.error_bound or 0.0) / largest(answers[k], finer.solve(loads[k]))
                         for k in range(2, len(loads), JUDGED)]  # fmt: skip
                table.add_row(tool, path, *row(1e3 * usual, truth, 1e3 * spent, 1e3 * climbed, answers),
                              f"{min(slack):.1f}")  # fmt: skip
    Console(width=180).print(table)


def row(usual: np.ndarray, truth: list[Displacement], spent: np.ndarray, climbed: np.ndarray,
        answers: list[Displacement]) -> list[str]:  # fmt: skip
    """The figures of one path; times in ms."""
    cold = np.array([a.trust.figures["cold"] > 0 for a in answers])
    anew = np.array([a.trust.figures["meshed"] > 0 for a in answers]) & ~cold
    kept = ~cold & ~anew
    peak = np.array([t.magnitude.max() for t in truth])
    off = np.array([largest(answer, true) for answer, true in zip(answers, truth, strict=True)])
    return [f"{np.median(usual):.1f}", f"{spent[0]:.1f}", f"{np.median(spent[kept]):.1f}",
            f"{np.median(spent[kept] / usual[kept]):.2f}", f"{spent[kept].max():.1f}",
            f"{np.median(climbed[kept]):.1f}",
            f"{np.median(spent[anew]):.1f}, {anew.sum()} of {len(spent)}" if anew.any() else "-",
            f"{100 * (off / peak).max():.2f}"]  # fmt: skip


def largest(answer: Displacement, true: Displacement) -> float:
    """The largest distance of an answer from another [m]."""
    return float(np.linalg.norm(answer.displacement - true.displacement, axis=1).max())


if __name__ == "__main__":
    main()
