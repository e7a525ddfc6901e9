"""Break-even: after how many solves a network has paid for its data and training, against the cheapest equal solver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from stmpl_core.methods import MomentNet
from studies.chart.measure import Chart, Point

NETWORK = "MomentNet"
SOLVERS = ("PatchFem", "whole-arm FEM")  # curves that learn nothing
DATA_CORE_HOURS = 1.9  # of `stmpl generate --preset default`: 42,741 samples in 56 minutes of two cores


@dataclass(frozen=True)
class BreakEven:
    """One panel.

    Args:
        scene, ratio: panel, by its scene and its p / E.
        network: point of the network.
        solver: cheapest finite elements with no larger an error; None if none of the chart reach it.
        solves: number of solves after which the network is ahead; infinite if it never is, NaN without a solver.
    """

    scene: str
    ratio: float
    network: Point
    solver: Point | None
    solves: float


def core_hours() -> float:
    """What the shipped network cost: data and training [core hours]."""
    return DATA_CORE_HOURS + float(MomentNet().weights.card["minutes"]) / 60


def break_even(chart: Chart) -> list[BreakEven]:
    """Of every panel in which the network was measured on the layer's own mesh."""
    rows = []
    for network in (p for p in chart.points if p.curve == NETWORK and p.knob == "the layer's own mesh"):
        solvers = [p for p in chart.points if p.curve.startswith(SOLVERS) and not p.failed
                   and (p.scene, p.ratio) == (network.scene, network.ratio) and p.error <= network.error]  # fmt: skip
        solver = min(solvers, key=lambda p: p.seconds, default=None)
        saved = solver.seconds - network.seconds if solver else math.nan
        solves = 3600 * core_hours() / saved if saved > 0 else math.inf if solver else math.nan
        rows.append(BreakEven(network.scene, network.ratio, network, solver, solves))
    return rows


def draw_break_even(rows: list[BreakEven], path: Path) -> Path:
    """Core hours over solves: what the network has cost and what the solvers have, panel by panel."""
    figure = Figure(figsize=(6.4, 3.8), dpi=110, layout="constrained")
    axes, solves, paid = figure.subplots(), np.logspace(2, 8, 60), core_hours()
    axes.plot([], [], color="tab:blue", label="the cheapest FEM of no larger error, by panel")
    axes.plot([], [], color="tab:red", label=f"{NETWORK}, with its data and training ({paid:.1f} core hours)")
    for row in rows:
        if row.solver is None:
            continue
        axes.plot(solves, solves * row.solver.seconds / 3600, color="tab:blue", alpha=0.5, lw=1)
        axes.plot(solves, paid + solves * row.network.seconds / 3600, color="tab:red", alpha=0.5, lw=1)
        if math.isfinite(row.solves):
            axes.plot(row.solves, row.solves * row.solver.seconds / 3600, "ko", ms=4)
    known = [row.solves for row in rows if math.isfinite(row.solves)]
    if known:
        middle = float(np.median(known))
        said = f"median: even after {middle:,.0f} solves, {middle / 6000:.0f} min of a loop at 100 Hz"
        axes.set_title(said, fontsize=9)
    axes.set(xscale="log", yscale="log", xlabel="solves", ylabel="core hours", ylim=(0.02, None))
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path)
    return path
