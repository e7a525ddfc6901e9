"""What a finite-element answer costs: seconds against error, and scaling.

    .venv/bin/python -m benchmarks.ground_truth        # prints tables, writes docs/pictures/ground_truth_cost.png

Everything runs in one process on one thread and side by side, so that ratios hold on a noisy machine.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from threadpoolctl import threadpool_limits

from fem_tools import PatchFem
from stmpl_core.body import Body
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "ground_truth_cost.png"
COST_TICKS = (0.03, 0.1, 0.3, 1.0)  # s
SITES, RATIOS, RADIUS, EDGE = 2, (0.2, 0.8), 0.012, 0.004  # p / E [-], [m]


def disc_load(layer: SoftLayer, centre: np.ndarray, ratio: float) -> Load:
    """A round pressure with a smooth edge, p/E = `ratio` in its middle."""
    x = np.clip((RADIUS - np.linalg.norm(layer.vertices - centre, axis=1)) / EDGE + 0.5, 0, 1)
    return Load.pressure(ratio * layer.tissue.youngs_modulus * x * x * (3 - 2 * x))


def sites(layer: SoftLayer, n: int) -> np.ndarray:
    """Points well inside the part, (n, 3) [m], the same for every mesh of it."""
    away = np.linalg.norm(layer.vertices[:, None] - layer.vertices[layer.border][None, ::5], axis=2).min(axis=1)
    inside = layer.vertices[away > 0.06]
    order = inside[np.lexsort(np.round(inside, 2).T)]
    return order[np.linspace(0, len(order) - 1, n + 2).astype(int)[1:-1]]


def timed(work: Callable[[], object], repeats: int = 3) -> tuple[float, object]:
    """The shortest of some runs [s of processor time], and what came out; the first run compiles and is not counted."""
    out = work()
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        out = work()
        spent.append(time.process_time() - start)
    return min(spent), out


def accuracy_table(layer: SoftLayer) -> Table:
    """Seconds a sample and errors of several meshes of the same skin, against layers=3, refine=2, reach=8."""
    centres = sites(layer, SITES)
    loads = [disc_load(layer, c, r) for c in centres for r in RATIOS]
    finest = PatchFem(layers=3, refine=2, reach=8, check_stability=False).prepare(layer)
    truths = [finest.solve(load).displacement for load in track(loads, "reference")]
    title = f"PatchFem, {layer.edge_length * 1e3:.1f} mm edges: one core, {len(loads)} loads, p/E {RATIOS}"
    table = Table(title=title)
    for column in ("layers", "refine", "reach", "s a sample", "MEE / peak %", "worst / peak %", "at peak %"):
        table.add_column(column, justify="right")
    for layers, refine, reach in ((1, 0, 4), (1, 0, 6), (2, 0, 6), (2, 1, 6), (2, 1, 8)):
        method = PatchFem(layers=layers, refine=refine, reach=reach).prepare(layer)
        rows = []
        for load, truth in zip(loads, truths, strict=True):
            seconds, answer = timed(lambda m=method, x=load: m.solve(x).displacement, 2)
            size, error = np.linalg.norm(truth, axis=1), np.linalg.norm(answer - truth, axis=1)
            peak = size.argmax()
            rows.append((seconds, error[size > 1e-6].mean() / size[peak], error.max() / size[peak],
                         np.linalg.norm(answer, axis=1).max() / size[peak] - 1))  # fmt: skip
        s, mee, worst, at_peak = np.mean(rows, axis=0)
        table.add_row(str(layers), str(refine), str(reach), f"{s:.3f}", f"{100 * mee:.2f}", f"{100 * worst:.2f}",
                      f"{100 * at_peak:+.2f}")  # fmt: skip
    return table


def scaling_picture(body: Body, path: Path) -> None:
    """Cost against patch size and against mesh width, log-log."""
    _, (left, right) = plt.subplots(1, 2, figsize=(10, 4), constrained_layout=True)
    layer = body.part("left_arm", edge_length=3e-3)
    load = disc_load(layer, sites(layer, 1)[0], 0.5)
    for layers, colour in ((1, "tab:blue"), (2, "tab:orange")):
        reach, cost = (3, 4, 6, 8, 12), []
        for k in reach:
            method = PatchFem(layers=layers, reach=k, check_stability=False).prepare(layer)
            cost.append(timed(lambda m=method: m.solve(load), 2)[0])
        left.loglog(reach, cost, "o-", color=colour, label=f"{layers} wedge{'s' * (layers > 1)} deep")
    left.set(xlabel="reach of the patch [thicknesses]", ylabel="s a sample, one core", title="3 mm edges")
    for layers, colour in ((1, "tab:blue"), (2, "tab:orange")):
        widths, cost = (6e-3, 4.5e-3, 3e-3, 2.2e-3), []
        for width in widths:
            coarse = body.part("left_arm", edge_length=width)
            press = disc_load(coarse, sites(layer, 1)[0], 0.5)
            method = PatchFem(layers=layers, check_stability=False).prepare(coarse)
            cost.append(timed(lambda m=method, x=press: m.solve(x), 2)[0])
        right.loglog(np.array(widths) * 1e3, cost, "o-", color=colour, label=f"{layers} wedge{'s' * (layers > 1)} deep")
    right.set(xlabel="edge length [mm]", title="reach 6")
    for axes, ticks in ((left, (3, 4, 6, 8, 12)), (right, (2, 3, 4, 6))):
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.set_yticks(COST_TICKS, [f"{tick:g}" for tick in COST_TICKS])
        axes.minorticks_off()
        axes.grid(True, alpha=0.3)
        axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    plt.savefig(path, dpi=110)


def main() -> None:
    """Prints the tables and writes the picture."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    threadpool_limits(1)
    plt.switch_backend("agg")
    console, body = Console(), Body.anny()
    layer = body.part("left_arm", edge_length=3e-3)
    console.print(f"{platform.processor() or platform.machine()}, one thread")
    console.print(accuracy_table(layer))
    scaling_picture(body, PICTURE)
    console.print(f"picture: {PICTURE}")


if __name__ == "__main__":
    main()
