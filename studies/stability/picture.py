"""The picture of a stability run: one square a trial, coloured by how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from studies.stability.laws import MEANING
from studies.stability.suite import Report, Row

COLOURS = {"held": "#8fc98f", "unfinished": "#d5e8d5", "flagged": "#f2c14e",
           "needless": "#8fb8de", "silent": "#d1495b", "crashed": "#3b1c32"}
SAID = {
    "held": "all laws held", "unfinished": "held, too slow for all rounds", "flagged": "law broken, answer flagged",
    "needless": "flagged without need",
    "silent": "law broken, method silent", "crashed": "crashed",
}  # fmt: skip
LETTERS = {
    "answers": "r", "refuses": "n", "finite": "f", "zero": "0", "monotone": "p", "unfolded": "J", "leak": "l",
    "seam": "e", "objective": "o", "similar": "s", "mesh": "m", "returns": "h", "additive": "a", "gain": "g",
    "bounded": "b", "rises": "d", "touches": "i", "presses": "F", "carries": "w", "still": "t", "steady": "P",
    "smooth": "k", "ripple": "~", "outside": "q", "covers": "±", "needless": "x", "verdict": "v", "agrees": "E",
    "gives": "W", "caps": "µ", "alike": "2", "masing": "M", "between": "G", "free": "u",
    "lasts": "L", "sinks": "S", "ends": "Q",
}  # fmt: skip


MOST_ACROSS = 8  # squares of a line; longer axes go on in the next
NARROW = 3  # methods up to which nothing is broken into lines


def draw(report: Report, path: str | Path) -> Path:
    """Draws a row an axis, a column a method; in it a square a level from easy to hard, line by line. Writes a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    methods, axes = report.methods, report.axes
    trials = {axis: len(report.cell(methods[0], axis)) for axis in axes}
    across = max(trials.values()) if len(methods) <= NARROW else min(MOST_ACROSS, max(trials.values()))
    lines = np.array([-(-trials[axis] // across) for axis in axes])
    first = np.append(0, np.cumsum(lines))
    column = across + 1.2
    figure = Figure(figsize=(2.6 + 0.125 * column * len(methods), 1.9 + 0.34 * first[-1]), layout="constrained")
    plot = figure.subplots()
    for m, method in enumerate(methods):
        for axis, top in zip(axes, first, strict=False):
            for k, row in enumerate(report.cell(method, axis)):
                _square(plot, m * column + k % across, top + k // across, row)
        counts = report.counts(method)
        plot.text(m * column + across / 2, -0.75, method, ha="center", va="bottom", fontsize=10, weight="bold")
        plot.text(m * column + across / 2, first[-1] - 0.1, f"{counts['flagged']} flagged\n"
                  f"{counts['silent']} silent"
                  + "".join(f"\n{counts[o]} {o}" for o in ("needless", "crashed") if counts[o]),
                  ha="center", va="top", fontsize=8)  # fmt: skip
    for axis, top in zip(axes, first, strict=False):
        cell = report.cell(methods[0], axis)
        span = cell[0].level if len(cell) == 1 else f"{cell[0].level} … {cell[-1].level}"
        plot.text(-0.8, top, f"{axis}  ", ha="right", va="bottom", fontsize=9)
        plot.text(-0.8, top, f"{span}  ", ha="right", va="top", fontsize=7, color="0.35")
    plot.set(xlim=(-1, column * len(methods)), ylim=(first[-1] + 0.9, -1.6))
    plot.set_axis_off()
    _legend(figure, report)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(str(path))
    return path


def _square(plot: Any, x: float, y: float, row: Row) -> None:
    from matplotlib.patches import Rectangle

    plot.add_patch(Rectangle((x, y - 0.4), 0.92, 0.8, color=COLOURS[row.outcome], lw=0))
    if row.broken:
        dark = row.outcome in ("silent", "crashed")
        worst = next((b for b in row.broken if not b.flagged), row.broken[0])
        plot.text(x + 0.46, y, LETTERS[worst.law], ha="center", va="center", fontsize=6.5,
                  color="white" if dark else "black")  # fmt: skip


def _legend(figure: Any, report: Report) -> None:
    from matplotlib.patches import Patch

    outcomes = [name for name in COLOURS if any(row.outcome == name for row in report.rows)]
    figure.legend(handles=[Patch(color=COLOURS[name], label=SAID[name]) for name in outcomes],
                  loc="outside upper center", ncols=len(outcomes), frameon=False, fontsize=9)  # fmt: skip
    laws = {b.law for row in report.rows for b in row.broken}
    told = [f"{letter}: {MEANING[law]}" for law, letter in LETTERS.items() if law in laws]
    third = -(-len(told) // 3)
    lines = ["      ".join(told[k : k + third]) for k in range(0, len(told), third or 1)]
    figure.supxlabel("\n".join(["the law that broke", *lines]) if told else "", fontsize=8, color="0.25")
