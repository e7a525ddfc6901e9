"""Stroke: a ball that is pressed in, stays, is led along the skin and lifted, by the laws that a state follows.

It takes the kernels of `stmpl_core.history` (what relaxes, springs of friction, fresh skin under a tool that slides)
with a force that grows as a power of the depth in place of the contact law: milliseconds, without a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from stmpl_core.relaxation import Series, let_go, weights
from stmpl_core.sideways import Patch
from stmpl_core.slip import SPRINGS, drag, ploughing

STEPS = 80  # of each part of a stroke
STAYS = 30  # steps in which a tool stays
LEVER = 2 / 3  # mean distance of an even pressure from the middle, over the radius
SOFTEST = 0.05  # least share of the moduli that a fit tries


class Stroke(NamedTuple):
    """What a ball does, and what is under it.

    Args:
        force: force of elastic skin at the greatest depth [N].
        power: power of the depth with which it grows [-].
        depth: greatest depth [m].
        radius: radius of the contact there [m].
        patch: stiffness of that contact to what sticks to it.
        speed: speed of pressing, of the way along the skin and of lifting [m/s]; infinite: no time goes by.
        stays: time that the ball stays when it is pressed in [s].
        way: way along the skin after that [m].
        fades: how much more fades under a contact as wide than the series says (relaxation.faded) [-].
        aside: share of a drag that relaxes in each time of the series (relaxation.shares_aside), (P,) [-]; None: as
            much as of the force.
    """

    force: float
    power: float
    depth: float
    radius: float
    patch: Patch
    speed: float = np.inf
    stays: float = 0.0
    way: float = 0.0
    fades: float = 1.0
    aside: np.ndarray | None = None


class Course(NamedTuple):
    """A stroke, instant by instant, from the first touch to where the ball left, (N,) each.

    Args:
        depth: depth of the ball [m].
        elastic: force of elastic skin at that depth [N].
        force: force that the skin presses back with [N]; 0: the skin has not come back yet, and is free.
        drag: force of friction along the skin [N].
        offset: way by which the skin goes along with the ball [m].
    """

    depth: np.ndarray
    elastic: np.ndarray
    force: np.ndarray
    drag: np.ndarray
    offset: np.ndarray


class Missed(NamedTuple):
    """What an elastic tissue misses of strokes with time.

    Args:
        force: largest difference of the force over a stroke, over its largest [-].
        lag: largest depth at which skin is left behind by the ball, over the greatest depth [-].
        share: share of the moduli of the elastic tissue that misses least force [-].
        fitted: what that one misses of the force [-].
    """

    force: float
    lag: float
    share: float
    fitted: float


def played(stroke: Stroke, series: Series, friction: float) -> Course:
    """A stroke on skin that relaxes by a series, with a coefficient of friction [-], 0: none."""
    down, along = np.linspace(0, 1, STEPS + 1), stroke.way * np.linspace(0, 1, STEPS + 1)[1:] ** 2 * (stroke.way > 0)
    stays, along = (STAYS if stroke.stays > 0 else 0), along if stroke.way > 0 else along[:0]
    depth = stroke.depth * np.concatenate([down, np.ones(stays + len(along)), down[::-1][1:]])
    steps = np.concatenate([[0.0], np.diff(depth)])
    way = np.concatenate([np.zeros(STEPS + 1 + stays), np.diff(along, prepend=0.0), np.zeros(STEPS)])
    dt = np.hypot(steps, way) / stroke.speed
    dt[STEPS + 1 : STEPS + 1 + stays] = stroke.stays / max(stays, 1)
    elastic = stroke.force * (depth / stroke.depth) ** stroke.power
    force, tangential, offset = np.zeros_like(depth), np.zeros_like(depth), np.zeros_like(depth)

    terms, share, before, stiff = len(series.times), 1.0, 0.0, np.zeros(3)
    relaxed, kept, gain = np.zeros(terms), np.empty(terms), np.empty(terms)
    springs, faded = np.zeros((SPRINGS, 3)), np.zeros((terms, SPRINGS, 3))
    for k in range(1, len(depth)):
        weights(series.times, dt[k], share * way[k] / stroke.radius, stroke.fades * before, relaxed, kept, gain)
        gain *= stroke.fades
        owed, now = series.balance(kept, gain)
        pressing = now * elastic[k] > owed
        if pressing:
            before, relaxed = elastic[k], kept + gain * elastic[k]
        else:
            relaxed, _ = let_go(*series, dt[k], share * way[k] / stroke.radius, 1.0, before, elastic[k],
                                relaxed)
            before = float(series.shares @ relaxed)
            springs[:], faded[:], stiff = 0.0, 0.0, np.zeros(3)
            continue
        force[k] = now * elastic[k] - owed
        if friction > 0:
            springs, faded, carried, share, stiff = _dragged(stroke, series, friction, force[k], depth[k], dt[k],
                                                             way[k], springs, faded, stiff)  # fmt: skip
            tangential[k], offset[k] = np.hypot(*carried[:2]), abs(springs[:, 0].sum()) / stiff[0]
    return Course(depth, elastic, force, tangential, offset)


def pulled(stroke: Stroke, friction: float, share: float) -> tuple[float, float]:
    """Force of friction over the normal force [-] and way of the skin [m] where a share of that force pulls along."""
    wanted = np.array([share * stroke.force, 0.0, 0.0])
    nothing, stroke = Series(np.empty(0), np.empty(0)), stroke._replace(aside=None)
    springs, _, carried, _, stiff = _dragged(stroke, nothing, friction, stroke.force, stroke.depth, 0.0, 0.0,
                                             np.zeros((SPRINGS, 3)), np.zeros((0, SPRINGS, 3)), np.zeros(3),
                                             wanted)  # fmt: skip
    return float(carried[0]) / stroke.force, float(springs[:, 0].sum() / stiff[0])


def without_time(strokes: Sequence[Stroke], series: Series, friction: float) -> Missed:
    """What one elastic tissue misses of all strokes, with all its moduli or a share of them."""
    courses = [played(stroke, series, friction) for stroke in strokes]

    def off(share: float) -> float:
        return max(float(np.abs(share * one.elastic - one.force).max() / one.force.max()) for one in courses)

    found = minimize_scalar(off, bounds=(SOFTEST, 1.0), method="bounded", options={"xatol": 1e-4})
    lag = 0.0
    for one in courses:
        gone = np.flatnonzero((one.force <= 0) & (np.arange(len(one.force)) > one.force.argmax()))
        lag = max(lag, _free(one, int(gone[0])) / float(one.depth.max()))
    return Missed(off(1.0), lag, float(found.x), float(found.fun))


def _free(course: Course, k: int) -> float:
    """Depth at which the skin is left [m], where that is before instant k: the force goes on straight to 0."""
    (d2, d1), (f2, f1) = course.depth[k - 2 : k], course.force[k - 2 : k]
    if not (course.depth[k] > 0 and f2 > f1):
        return float(course.depth[k])
    return float(np.clip(d1 + f1 * (d1 - d2) / (f2 - f1), course.depth[k], d1))


def _dragged(stroke: Stroke, series: Series, friction: float, force: float, depth: float, dt: float, way: float,
             springs: np.ndarray, faded: np.ndarray, before: np.ndarray, wanted: np.ndarray | None = None,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray]:  # fmt: skip
    """One step of friction: springs, what of them relaxed, force (3,), share that slides, stiffness (3,)."""
    size = (depth / stroke.depth) ** 0.5  # of the contact, over that at the greatest depth
    radius, along, turn = stroke.radius * size, stroke.patch.along * size, stroke.patch.turn * size**3
    stiffer, cap = ploughing(depth, radius, force, along, stroke.patch.bare * size, friction)
    pulled = stroke.patch.secant(friction * force / size) * size
    stiffness = stiffer * np.array([pulled, pulled, turn / (LEVER * radius) ** 2])
    shares = series.shares if stroke.aside is None else stroke.aside
    springs, faded, carried, share, _ = drag(springs, faded, shares, series.times, dt, 0.0, stiffness, before, cap,
                                             np.array([way, 0.0, 0.0]), np.zeros(3) if wanted is None else wanted,
                                             wanted is not None)  # fmt: skip
    return springs, faded, carried, share, stiffness
