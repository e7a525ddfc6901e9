"""Picture: model over measured of every row, with both spreads, named; and model against measured, both in one unit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from studies.validate.judge import Judged
from studies.validate.report import met

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NEAR = 0.2  # decades between points whose numbers would overlap
KINDS = {"N/m": ("stiffness [N/mm]", 1e-3), "Pa": ("modulus [kPa]", 1e-3), "N": ("force [N]", 1.0),
         "-": ("ratio or share", 1.0), "s": ("time [s]", 1.0)}  # fmt: skip
COLOURS = {"yes": "tab:green", "no": "tab:red", "not judged": "tab:blue"}  # by how a verdict begins
MARKERS = {"N/m": "o", "Pa": "s", "N": "^", "-": "D", "s": "v"}


def draw(judged: Sequence[Judged], path: Path) -> Path:
    """Writes the PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 0.36 * len(judged) + 2.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.0))
    _against(left, judged)
    _named(right, judged)
    inside, of = met(judged)
    blue = "; blue: a parameter was fitted on it" if of < len(judged) else ""
    figure.suptitle(f"The model beside published measurements on people: {inside} of {of} rows meet{blue}")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def _colour(one: Judged) -> str:
    return next(colour for begins, colour in reversed(COLOURS.items()) if one.verdict.startswith(begins))


def _against(axes: Axes, judged: Sequence[Judged]) -> None:
    """Model against measured on logarithmic axes, numbered as on the right."""
    ends, points = [], []
    for number, one in enumerate(judged, 1):
        factor = KINDS[one.row.measured.unit][1]
        x, y = ([factor * q.value, factor * q.low, factor * q.high] for q in (one.row.measured, one.model))
        ends += x + y
        axes.errorbar(x[0], y[0], xerr=[[x[0] - x[1]], [x[2] - x[0]]], yerr=[[y[0] - y[1]], [y[2] - y[0]]],
                      fmt=MARKERS[one.row.measured.unit], color=_colour(one), ms=5, lw=1)  # fmt: skip
        points.append((x[0], y[2], number))
    for group in _groups(points):
        x, y = np.exp(np.mean(np.log([point[0] for point in group]))), max(point[1] for point in group)
        label = _listed(sorted(point[2] for point in group))
        axes.annotate(label, (x, y), xytext=(0, 3), textcoords="offset points", fontsize=8, ha="center")
    box = min(ends) / 1.6, max(ends) * 1.6
    axes.plot(box, box, color="0.5", lw=0.8)
    axes.set(xscale="log", yscale="log", xlim=box, ylim=box, xlabel="measured", ylabel="model")
    axes.grid(which="major", color="0.9", lw=0.6)
    for unit, (name, _) in KINDS.items():
        if any(one.row.measured.unit == unit for one in judged):
            axes.plot([], [], MARKERS[unit], color="0.4", label=name)
    axes.legend(loc="upper left", fontsize=9, frameon=False)


def _groups(points: list[tuple[float, float, int]]) -> list[list[tuple[float, float, int]]]:
    """Points that lie too near to each other to be numbered one by one; each is x, y and number."""
    groups: list[list[tuple[float, float, int]]] = []
    for x, y, number in sorted(points):
        near = (g for g in groups if max(abs(np.log10(x / g[-1][0])), abs(np.log10(y / g[-1][1]))) < NEAR)
        group = next(near, None)
        if group is None:
            groups.append([(x, y, number)])
        else:
            group.append((x, y, number))
    return groups


def _listed(numbers: list[int]) -> str:
    """Numbers with commas, or first and last of a run of three or more."""
    run = len(numbers) > 2 and numbers[-1] - numbers[0] == len(numbers) - 1
    return f"{numbers[0]}-{numbers[-1]}" if run else ", ".join(map(str, numbers))


def _named(axes: Axes, judged: Sequence[Judged]) -> None:
    """A line a row: both intervals over the measured middle."""
    for k, one in enumerate(judged):
        middle = one.row.measured.value
        for shift, quantity, colour in ((0.17, one.row.measured, "0.35"), (-0.17, one.model, _colour(one))):
            low, value, high = (x / middle for x in (quantity.low, quantity.value, quantity.high))
            axes.plot([low, high], [k - shift] * 2, color=colour, lw=2.5, solid_capstyle="butt")
            axes.plot(value, k - shift, MARKERS[quantity.unit], color=colour, ms=5)
    names = [f"{one.row.name}  {number}" for number, one in enumerate(judged, 1)]
    axes.set(xscale="log", xlabel="over the measured middle (grey: measured)")
    axes.set_yticks(np.arange(len(judged)), names, fontsize=9)
    axes.set_ylim(len(judged) - 0.4, -0.6)
    axes.axvline(1, color="0.5", lw=0.8)
    axes.grid(axis="x", which="major", color="0.9", lw=0.6)
