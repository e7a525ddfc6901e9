"""Wake: the groove that a tool leaves behind where it slid over skin that relaxes, as places along its way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stmpl_core.arrays import Points, Transform, VertexVectors
from stmpl_core.columns import shifted
from stmpl_core.relaxation import Series, free_decay, weights

if TYPE_CHECKING:
    from stmpl_core.layer import SoftLayer
    from stmpl_core.sdf import SignedDistance

PLACES = 16  # places that are remembered; the shallowest gives way to a new one
SPACING = 0.4  # way between two of them, over the radius of the contact
SAME = 0.1  # way over that radius within which a tool that presses harder deepens a place
FORGOTTEN = 0.02  # depth of a place over that of the press, below which it is forgotten


class Pass(NamedTuple):
    """A tool as it presses on its way.

    Args:
        pose: its pose, (4, 4).
        middle: middle of its contact on the skin at rest, (3,) [m].
        normal: mean inward normal there, (3,).
        relaxed: elastic force that has relaxed in each time, (P,) [N].
        force: elastic force [N].
        depth: depth of the contact [m].
        power: power of the depth with which the force grows [-].
        radius: radius of the contact [m].
    """

    pose: Transform
    middle: np.ndarray
    normal: np.ndarray
    relaxed: np.ndarray
    force: float
    depth: float
    power: float
    radius: float


class Groove(NamedTuple):
    """Pose at which a tool would lie in the groove that it left, (4, 4), and how deep that is there [m]."""

    pose: Transform
    depth: float


_POSE, _MIDDLE, _NORMAL = slice(0, 16), slice(16, 19), slice(19, 22)
_NOW, _FORCE, _DEPTH, _POWER, _RADIUS, FIXED = 22, 23, 24, 25, 26, 27  # columns; what has relaxed follows


def untouched(terms: int) -> np.ndarray:
    """No places yet, of skin with so many times of relaxation: (PLACES, FIXED + P), none where nothing relaxes."""
    return np.zeros((PLACES if terms else 0, FIXED + terms))


def _depths(trail: np.ndarray, series: Series) -> np.ndarray:
    """How deep the skin would stay at each place if it were let go now [m]; 0 where there is none."""
    some = trail[:, _FORCE] > 0
    share = np.divide(trail[:, FIXED:] @ series.shares, trail[:, _FORCE], out=np.zeros(len(trail)), where=some)
    return trail[:, _DEPTH] * np.clip(share, 0, 1) ** (1 / np.where(some, trail[:, _POWER], 1.0))


def after(trail: np.ndarray, series: Series, dt: float, now: Pass | None) -> np.ndarray:
    """The places after a step: those under the tool are held as deep as it is, the others come back by themselves.

    A place is skin of its own, so it relaxes without the fresh skin of `stmpl_core.relaxation`.

    Args:
        trail: places before.
        series: relaxation of the layer's force.
        dt: time of the step [s].
        now: the tool, if it presses.
    """
    if not len(trail) or (now is None and not trail[:, _FORCE].any()):
        return trail
    trail, n = trail.copy(), len(series.times)
    away = np.full(len(trail), np.inf) if now is None else np.linalg.norm(trail[:, _MIDDLE] - now.middle, axis=1)
    away[trail[:, _FORCE] == 0] = np.inf
    back = free_decay(series, dt)
    for k in np.flatnonzero(trail[:, _FORCE] > 0):
        row = trail[k]
        if now is not None and away[k] < now.radius:
            kept, gain = np.empty(n), np.empty(n)
            weights(series.times, dt, 0.0, row[_NOW], row[FIXED:], kept, gain)
            row[_NOW], row[FIXED:] = now.force, kept + gain * now.force
        else:
            row[FIXED:] = back @ row[FIXED:]
            row[_NOW] = series.shares @ row[FIXED:]
    depths = _depths(trail, series)
    trail[(depths < FORGOTTEN * trail[:, _DEPTH]) & (trail[:, _NOW] < trail[:, _FORCE])] = 0.0
    if now is None:
        return trail
    new = away.min() > SPACING * now.radius
    row = trail[int(np.argmin(np.where(trail[:, _FORCE] > 0, depths, -1.0) if new else away))]
    if new or (away.min() < SAME * now.radius and now.force > row[_FORCE]):
        row[_POSE], row[_MIDDLE], row[_NORMAL] = now.pose.ravel(), now.middle, now.normal
        row[_NOW:FIXED] = now.force, now.force, now.depth, now.power, now.radius
    if new:
        row[FIXED:] = now.relaxed
    return trail


def carried_trail(trail: np.ndarray, motion_at: Callable[[np.ndarray], Transform]) -> np.ndarray:
    """The places where the skin took them, by its motion (4, 4) near a place (3,) [m]."""
    if not trail.any():
        return trail
    trail = trail.copy()
    for k in np.flatnonzero(trail[:, _FORCE] > 0):
        row = trail[k]
        motion = motion_at(row[_MIDDLE])
        row[_POSE] = (motion @ row[_POSE].reshape(4, 4)).ravel()
        row[_MIDDLE], row[_NORMAL] = motion[:3, :3] @ row[_MIDDLE] + motion[:3, 3], motion[:3, :3] @ row[_NORMAL]
    return trail


def grooves(trail: np.ndarray, series: Series) -> tuple[Groove, ...]:
    """The places, as poses of the tool."""
    out = []
    for row, depth in zip(trail, _depths(trail, series), strict=True):
        if depth > FORGOTTEN * row[_DEPTH]:
            pose = shifted(row[_POSE].reshape(4, 4), (depth - row[_DEPTH]) * row[_NORMAL])
            out.append(Groove(pose, float(depth)))
    return tuple(out)


def sunk(layer: SoftLayer, field: SignedDistance, left: Sequence[Groove], displacement: VertexVectors) -> VertexVectors:
    """The displacement with the skin in grooves as deep as they are: straight in, onto the tool as it would lie there.

    Args:
        layer: layer at rest.
        field: distance field of the tool.
        left: its grooves.
        displacement: displacement without them, (V, 3) [m].
    """
    low, high = field.tool_bounds
    reach = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    places: Points = np.array([one.pose[:3, 3] for one in left])
    box = np.all((layer.vertices > places.min(axis=0) - reach) & (layer.vertices < places.max(axis=0) + reach), axis=1)
    near = np.flatnonzero(box)
    wanted = np.zeros(len(near))
    for groove in left:
        local = (layer.vertices[near] - groove.pose[:3, 3]) @ groove.pose[:3, :3]
        some = np.flatnonzero(np.all((local > low) & (local < high), axis=1))
        wanted[some] = np.maximum(wanted[some], np.minimum(-field.distance(local[some]), groove.depth))
    inward = -layer.normals[near]
    missing = wanted - np.einsum("ni,ni->n", displacement[near], inward)
    some = np.flatnonzero((wanted > 0) & (missing > 0))
    out = displacement.copy()
    out[near[some]] += missing[some, None] * inward[some]
    return out
