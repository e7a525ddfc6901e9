"""Picture of a chart: a panel a scene and load, a curve a method, the Pareto front, and guides where loops run."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.chart.measure import Chart, Point

WORST = 150.0  # % of the peak; what is farther off has failed
GUIDES = (1.0, 2.0, 10.0, 33.0)  # ms: haptic loop, 500 Hz, 100 Hz, video
STYLE = {  # colour and marker of the curves that are known; others get the next free colour
    "zero": ("0.6", "_"), "Naive": ("tab:brown", "s"), "Winkler": ("tab:olive", "D"), "Linear": ("tab:cyan", "v"),
    "MomentNet": ("tab:red", "o"), "the paper's UNet, reduced": ("tab:purple", "P"),
    "FEM, few steps": ("tab:orange", "^"), "PatchFem, mesh": ("tab:blue", "o"),
    "PatchFem, patch": ("tab:green", "<"), "whole-arm FEM": ("navy", "h"), "Ladder": ("k", "*"),
}  # fmt: skip
SPARE = ("tab:pink", "darkgoldenrod", "teal", "indigo", "crimson", "slategray", "olivedrab", "maroon")


def style_of(chart: Chart) -> dict[str, tuple[str, str]]:
    """Colour and marker of every curve of a chart."""
    names, spare = list(dict.fromkeys(p.curve for p in chart.points)), iter(SPARE * 4)
    return {name: STYLE[name] if name in STYLE else (next(spare), "X") for name in names}


def on_chart(point: Point) -> bool:
    """Whether there is an answer, and one nearer to the truth than WORST."""
    return not point.failed and 100 * point.error < WORST


def limits(chart: Chart) -> tuple[float, float, float, float]:
    """Of both axes: fastest and slowest [ms], least and largest error [%]."""
    good = [p for p in chart.points if not math.isnan(p.seconds) and p.error > 0]
    x, y = [1e3 * p.seconds for p in good], [100 * p.error for p in good]
    return min(x, default=0.1) / 1.6, max(x, default=100) * 1.6, max(min(y, default=0.1) / 1.5, 0.05), WORST


def draw(chart: Chart, path: Path) -> Path:
    """Writes the PNG."""
    scenes, ratios = chart.about["scenes"], chart.about["ratios"]
    figure = Figure(figsize=(3.3 * len(scenes) + 0.5, 3.1 * len(ratios) + 1.6), dpi=110, layout="constrained")
    grid = figure.subplots(len(ratios), len(scenes), sharex=True, sharey=True, squeeze=False)
    styles, box = style_of(chart), limits(chart)
    for row, ratio in enumerate(ratios):
        for column, scene in enumerate(scenes):
            _panel(grid[row, column], chart, scene, ratio, styles, box)
            grid[row, column].set_title(f"{scene}, p = {ratio:g} E", fontsize=9)
            if column == 0:
                grid[row, 0].set_ylabel("error where it moves [% of the peak]", fontsize=8)
            if row == len(ratios) - 1:
                grid[row, column].set_xlabel("time of a solve [ms]", fontsize=8)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncol=min(2 * len(scenes), 6), fontsize=8, frameon=False)
    figure.suptitle("\n".join(textwrap.wrap(caption(chart), 40 * len(scenes))), fontsize=7.5, color="0.3")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def caption(chart: Chart) -> str:
    """What was measured on what."""
    about = chart.about
    made = ", ".join(f"{k} {v}" for k, v in about["versions"].items())
    left_out = f" Not installed: {', '.join(about['missing'])}." if about["missing"] else ""
    return (f"{about['layer']}; {about['machine']}; {made}. Reference: {about['reference']}. Hollow: flagged as out of "
            "range; cross at the edge: no answer, not converged, or farther off than the chart; grey: the Pareto "
            f"front.{left_out}")  # fmt: skip


def _panel(axes: Axes, chart: Chart, scene: str, ratio: float, styles: dict[str, tuple[str, str]],
           box: tuple[float, float, float, float]) -> None:  # fmt: skip
    fastest, slowest, least, largest = box
    axes.set(xscale="log", yscale="log", xlim=(fastest, slowest), ylim=(least, largest))
    for guide in GUIDES:
        axes.axvline(guide, color="0.75", lw=0.7, ls=":")
        axes.text(guide, least * 1.05, f" {guide:g}", fontsize=6, color="0.5", va="bottom")
    front = chart.front(scene, ratio)
    x, y = [1e3 * p.seconds for p in front], [100 * p.error for p in front]
    if front:
        axes.step([x[0], *x, slowest], [largest, *y, y[-1]], where="post", color="0.82", lw=5, zorder=0)
    for name, (colour, marker) in styles.items():
        mine = [p for p in chart.points if (p.curve, p.scene, p.ratio) == (name, scene, ratio)]
        shown = [p for p in mine if on_chart(p)]
        axes.plot([1e3 * p.seconds for p in shown], [100 * p.error for p in shown], color=colour, lw=1, alpha=0.7)
        for flagged in (False, True):
            these = [p for p in shown if p.in_range is not flagged]
            axes.plot([1e3 * p.seconds for p in these], [100 * p.error for p in these], marker, color=colour, ms=4.5,
                      mfc="white" if flagged else colour, ls="none")  # fmt: skip
        failed = [p for p in mine if not on_chart(p)]
        axes.plot([_place(p, slowest) for p in failed], [largest / 1.15] * len(failed), "x", color=colour, ms=6)
        axes.plot([], [], marker=marker, color=colour, ms=5, lw=1, label=name)
    axes.grid(True, which="major", alpha=0.25)
    axes.tick_params(labelsize=7)


def _place(point: Point, slowest: float) -> float:
    return slowest / 1.3 if math.isnan(point.seconds) else 1e3 * point.seconds
