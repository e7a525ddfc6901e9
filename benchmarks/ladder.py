"""What the ladder saves over a recorded run: time and error of every method on its frames, and which the ladder took.

python -m benchmarks.ladder runs/latest [--accuracy-mm 0.2] [--deadline-ms 10]
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from threadpoolctl import threadpool_limits

from bags.reader import Bag
from fem_tools.ladder import default_rungs, ladder
from stmpl_core.load import Load
from stmpl_core.methods import Method
from stmpl_core.provenance import machine
from studies.calibrate import truth

FLOOR = 3e-3  # mm, below which no error is drawn
PICTURE = Path("docs/pictures/ladder.png")


def loads_of(bag: Bag, most: int) -> tuple[np.ndarray, list[Load]]:
    """Times [s] and follower pressures of frames of a run that press, at most so many, evenly spread."""
    pressing = [f for f in bag.frames() if f.pressure is not None and f.pressure.any()]
    picks = [pressing[k] for k in np.unique(np.linspace(0, len(pressing) - 1, most).astype(int))]
    start = pressing[0].stamp_ns
    times = np.array([1e-9 * (f.stamp_ns - start) for f in picks])
    return times, [Load.pressure(f.pressure) for f in picks if f.pressure is not None]


def main() -> None:
    """Prints the table, draws the picture."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("path", type=Path, nargs="?", default=Path("bags/sample"))
    given.add_argument("--accuracy-mm", type=float, default=0.2)
    given.add_argument("--deadline-ms", type=float, default=10.0)
    given.add_argument("--frames", type=int, default=120)
    given.add_argument("--out", type=Path, default=PICTURE)
    options = given.parse_args()
    bag, console = Bag(options.path), Console(width=120)
    layer = bag.layer
    times, loads = loads_of(bag, options.frames)
    wish = {"accuracy": 1e-3 * options.accuracy_mm, "deadline": 1e-3 * options.deadline_ms}
    methods: dict[str, Method] = {rung.name: rung for rung in default_rungs()}
    methods["ladder, no deadline"] = ladder(accuracy=wish["accuracy"])
    methods["ladder"] = ladder(**wish)
    spent = {name: np.zeros(len(loads)) for name in methods}
    off = {name: np.zeros(len(loads)) for name in methods}
    bound = {name: np.full(len(loads), np.nan) for name in methods}
    taken: dict[str, list[str]] = {"ladder": [], "ladder, no deadline": []}
    with threadpool_limits(1):
        judge = truth().prepare(layer)
        true = [judge.solve(load).displacement for load in track(loads, "finite elements", console=console)]
        for name, method in methods.items():
            method.prepare(layer)
            method.solve(loads[len(loads) // 2])
            for k, load in enumerate(loads):
                started = time.perf_counter()
                answer = method.solve(load)
                spent[name][k] = time.perf_counter() - started
                off[name][k] = np.linalg.norm(answer.displacement - true[k], axis=1).max()
                bound[name][k] = answer.trust.error_bound or np.nan
                if name in taken:
                    taken[name].append(answer.method)
    wished = f"{options.accuracy_mm:g} mm at any vertex, {options.deadline_ms:g} ms"
    table = Table(title=f"{options.path}: {len(loads)} frames; wish: {wished}\n{layer}\n{machine()}, one thread",
                  title_justify="left")  # fmt: skip
    for heading in ("method", "ms, median", "ms, p99", "largest error mm, median", "worst", "within the wish",
                    "error within its bound"):  # fmt: skip
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for name in methods:
        said = np.isfinite(bound[name])
        kept = f"{(off[name][said] <= bound[name][said]).mean():.0%} of {said.sum()}" if said.any() else "-"
        table.add_row(name, f"{1e3 * np.median(spent[name]):.2f}", f"{1e3 * np.quantile(spent[name], 0.99):.2f}",
                      f"{1e3 * np.median(off[name]):.3f}", f"{1e3 * off[name].max():.3f}",
                      f"{(off[name] <= wish['accuracy']).mean():.0%}", kept)  # fmt: skip
    console.print(table)
    for name, chosen in taken.items():
        console.print(f"{name}: " + "; ".join(f"{m} {n / len(loads):.0%}" for m, n in Counter(chosen).most_common()))
    draw(times, spent, off, bound, taken, options)
    options.out.with_suffix(".json").write_text(json.dumps({
        name: {"ms": (1e3 * spent[name]).round(3).tolist(), "error_mm": (1e3 * off[name]).round(4).tolist()}
        for name in methods}) + "\n")  # fmt: skip
    console.print(f"picture: {options.out}")


def draw(times: np.ndarray, spent: dict[str, np.ndarray], off: dict[str, np.ndarray], bound: dict[str, np.ndarray],
         taken: dict[str, list[str]], options: argparse.Namespace) -> None:  # fmt: skip
    """Left: all methods over the run; right: error, bound and choice of the ladder in time."""
    plt.switch_backend("agg")
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained", width_ratios=(2, 3))
    colours = {name: f"C{k}" for k, name in enumerate(spent) if name not in taken}
    for name, seconds in spent.items():
        mine = "k" if name in taken else colours[name]
        marker = "*" if name == "ladder" else "P" if name in taken else "o"
        x, y = 1e3 * seconds, 1e3 * off[name]
        (x0, x1, x2), (y0, y1, y2) = np.quantile(x, (0.05, 0.5, 0.99)), np.quantile(y, (0.05, 0.5, 0.95))
        left.errorbar(x1, y1, [[y1 - y0], [y2 - y1]], [[x1 - x0], [x2 - x1]], fmt=marker, color=mine,
                      ms=10 if name in taken else 6, lw=0.8, label=name)  # fmt: skip
    left.axhline(options.accuracy_mm, color="0.6", ls=":")
    left.axvline(options.deadline_ms, color="0.6", ls=":")
    left.set(xscale="log", yscale="log", ylim=(FLOOR, None), xlabel="time of a solve [ms], median and 5-99 %",
             ylabel="largest error at any vertex [mm], median and 5-95 %")  # fmt: skip
    left.legend(fontsize=7, loc="lower left")
    name = "ladder, no deadline"
    for method in dict.fromkeys(taken[name]):
        here = np.array([m == method for m in taken[name]])
        right.plot(times[here], 1e3 * off[name][here], "o", ms=4, color=colours.get(method, "k"), label=method)
    right.plot(times, 1e3 * bound[name], color="0.4", lw=0.8, label="stated bound")
    right.axhline(options.accuracy_mm, color="0.6", ls=":", label="wish")
    right.set(yscale="log", ylim=(FLOOR, None), xlabel="time in the run [s]", ylabel="largest error at any vertex [mm]",
              title="the ladder without a deadline: who answered")  # fmt: skip
    right.legend(fontsize=7, loc="lower center")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=110)


if __name__ == "__main__":
    main()
