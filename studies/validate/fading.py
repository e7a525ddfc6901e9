"""Fading: what the laws of a state say of a force that is held, or that goes round a cycle, without a mesh.

Tissue that is pressed in, or pulled along by what is glued to it, has one convolution over its elastic force in a
simulator with a state (`stmpl_core.relaxation`); so these answers are those of a simulator, to rounding.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from stmpl_core.regions import HELD_SKIN
from stmpl_core.relaxation import Series, fades_under, series_of, weights
from stmpl_core.tissue import Prony, Tissue

STEPS = 60  # of a way there, of a stay, of a way back


class Cycles(NamedTuple):
    """Cycles of there, stay and back.

    Args:
        way: way of the tool over its largest, (cycles, 3 STEPS + 1) [-]: ends of steps.
        force: force over that of elastic tissue at the largest way, likewise [-].
    """

    way: np.ndarray
    force: np.ndarray


def series(fades: float) -> Prony:
    """HELD_SKIN with another share that fades in the end [-]."""
    return replace(HELD_SKIN, shares=tuple(fades / sum(HELD_SKIN.shares) * g for g in HELD_SKIN.shares))


def series_under(tissue: Tissue, thickness: float, fades: float, radius: float) -> Series:
    """What fades of the force on a stack, by a contact of a radius [m], whose materials all fade by that share."""
    stack = tissue.relaxing(series(fades)), thickness
    shares, times = series_of(*stack)
    return Series(shares * fades_under(*stack, radius), times)


def cycles(fading: Series, lasts: float, stays: float, many: int, *, slack: bool) -> Cycles:
    """Cycles at an even speed, of a force that grows with the way.

    Args:
        fading: relaxation of the force.
        lasts: time of a way there, or back [s]; 0: at once.
        stays: time between the two [s].
        many: number of cycles.
        slack: whether the tissue only pulls, and is slack where it would push.
    """
    there = np.linspace(0, 1, STEPS + 1)
    way = np.concatenate([there, np.ones(STEPS), there[::-1][1:]])
    dt = np.repeat([lasts / STEPS, stays / STEPS, lasts / STEPS], STEPS)
    relaxed, force, before = np.zeros(len(fading.times)), np.zeros((many, len(way))), 0.0
    kept, gain = np.empty_like(relaxed), np.empty_like(relaxed)
    for n in range(many):
        force[n, 0] = force[n - 1, -1] if n else 0.0
        for k in range(1, len(way)):
            weights(fading.times, dt[k - 1], 0.0, before, relaxed, kept, gain)
            owed, now = fading.balance(kept, gain)
            free = slack and now * way[k] < owed
            before = owed / now if free else way[k]
            force[n, k] = 0.0 if free else now * way[k] - owed
            relaxed = kept + gain * before
    return Cycles(np.tile(way, (many, 1)), force)


def lost_share(found: Cycles) -> float:
    """Share of the force that a stay costs [-]."""
    return float(1 - found.force[0, 2 * STEPS] / found.force[0, STEPS])


def lost_energy(found: Cycles) -> float:
    """Share of the work that a cycle does not give back, of the last one [-]."""
    work = 0.5 * (found.force[-1, 1:] + found.force[-1, :-1]) * np.diff(found.way[-1])
    return float(work.sum() / work[:STEPS].sum())


def last_peak(found: Cycles) -> float:
    """Force at the end of the last way there, over that of the first [-]."""
    return float(found.force[-1, STEPS] / found.force[0, STEPS])


def fading_time(fading: Series) -> float:
    """Time in which all but 1 / e of what fades has faded, of a force that is held [s]."""
    times = np.geomspace(1e-3, 1e3, 2000) * fading.times.max()
    rest = np.exp(-times[:, None] / fading.times) @ (fading.shares / fading.shares.sum())
    return float(np.interp(np.exp(-1.0), rest[::-1], times[::-1]))
