"""Wake: the groove that a tool leaves behind where it slid over skin that relaxes, as places along its way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np

from stmpl_core.arrays import Points, Transform, VertexVectors
from stmpl_core.relaxation import decay_of_free, depth_left, weights

if TYPE_CHECKING:
    from stmpl_core.layer import SoftLayer
    from stmpl_core.sdf import SignedDistance

PLACES = 16  # places that are remembered; the shallowest gives way to a new one
SPACING = 0.4  # way between two of them, over the radius of the contact
SAME = 0.1  # way over that radius within which a tool that presses harder deepens a place
HARDER = 1e-6  # how much harder, relative, that is: far above rounding
FORGOTTEN = 0.02  # depth of a place over that of the press, below which it is forgotten


class Groove(NamedTuple):
    """A place of a tool's way where the skin is not back yet.

    Args:
        pose: pose of the tool when it pressed there, (4, 4).
        depth: depth to which the skin has come back [m].
        share: the same over the depth of the press [-].
    """

    pose: Transform
    depth: float
    share: float


_FROM = 16  # first column of the middle
_POSE, _MIDDLE, _NORMAL = slice(0, _FROM), slice(_FROM, _FROM + 3), slice(_FROM + 3, 22)
_NOW, _FORCE, _DEPTH, _POWER, _STRAIN = 22, 23, 24, 25, 26  # force at rest now and of the press; see Pass
_LET_DEPTH, _LET_FORCE, FIXED = 27, 28, 29  # depth and force at rest where the tool went off, 0 under it; D_i follow


@numba.njit(cache=True, error_model="numpy")
def _depth(row, shares):
    """How deep the skin is at a place, or would stay if it were let go now [m]; 0 where there is none.

    Skin that was let go comes back as its force does, through one shape.
    """
    if not row[_FORCE] > 0:
        return 0.0
    force = 0.0
    for i in range(len(shares)):
        force += shares[i] * row[FIXED + i]
    if row[_LET_DEPTH] > 0:
        return row[_LET_DEPTH] * min(max(force / row[_LET_FORCE], 0.0), 1.0)
    return row[_DEPTH] * depth_left(min(max(force / row[_FORCE], 0.0), 1.0), row[_POWER], row[_STRAIN])


@numba.njit(cache=True, error_model="numpy")
def _depths(trail, shares):
    """`_depth` of each place, (PLACES,) [m]."""
    out = np.empty(len(trail))
    for k in range(len(trail)):
        out[k] = _depth(trail[k], shares)
    return out


@numba.njit(cache=True, error_model="numpy")
def _aged(trail, shares, times, dt, away, stays, force):
    """Lets places grow older: each is held with an elastic force [N] for the first part of the step, then comes back.

    Args:
        away: how far each is from the tool, (PLACES,) [m], infinite where there is none, as where one is forgotten.
        stays: share of the step for which it is held, (PLACES,) [-].
    """
    terms = len(times)
    kept, gain, free, whole = np.empty(terms), np.empty(terms), np.empty(terms), np.empty((0, 0))
    for k in range(len(trail)):
        row = trail[k]
        if not row[_FORCE] > 0:
            continue
        if stays[k] > 0:
            weights(times, stays[k] * dt, 0.0, row[_NOW], row[FIXED:], kept, gain)
            row[_NOW], row[_LET_DEPTH] = force, 0.0
            for i in range(terms):
                row[FIXED + i] = kept[i] + gain[i] * force
        if stays[k] < 1:
            if row[_LET_DEPTH] == 0:
                row[_LET_DEPTH], row[_LET_FORCE] = _depth(row, shares), 0.0
                for i in range(terms):
                    row[_LET_FORCE] += shares[i] * row[FIXED + i]
            if stays[k] == 0 and not len(whole):
                whole = decay_of_free(shares, times, dt)
            back = whole if stays[k] == 0 else decay_of_free(shares, times, (1 - stays[k]) * dt)
            row[_NOW], free[:] = 0.0, row[FIXED:]
            for i in range(terms):
                row[FIXED + i] = 0.0
                for j in range(terms):
                    row[FIXED + i] += back[i, j] * free[j]
                row[_NOW] += shares[i] * row[FIXED + i]
            if _depth(row, shares) < FORGOTTEN * row[_DEPTH] and row[_NOW] < row[_FORCE]:
                row[:], away[k] = 0.0, np.inf


@numba.njit(cache=True, error_model="numpy")
def _share_of_way(came, middle, place, far):
    """Share of the way from `came` to `middle` (3,) at which a tool is `far` from a place it leaves; 1: not yet."""
    a = b = 0.0
    c = -far * far
    for x in range(3):
        way, off = middle[x] - came[x], came[x] - place[x]
        a, b, c = a + way * way, b + way * off, c + off * off
    return min((np.sqrt(b * b - a * c) - b) / a, 1.0) if c < 0 and a > 0 else 1.0


@numba.njit(cache=True, error_model="numpy")
def let_age(trail, shares, times, dt):
    """Lets the skin at the places come back by itself for a step; see `pressed_on`."""
    _aged(trail, shares, times, dt, np.full(len(trail), np.inf), np.zeros(len(trail)), 0.0)


@numba.njit(cache=True, error_model="numpy")
def pressed_on(trail, shares, times, dt, pose, middle, normal, relaxed, force, depth, power, strain, radius, came):
    """Writes the places as they are after a step in which the tool presses: those under it are held as deep as it is,
    the others come back by themselves.

    They lie SPACING apart on its way, wherever its steps end. A place is skin of its own, so it relaxes without the
    fresh skin of `stmpl_core.relaxation`.

    Args:
        trail: places before, written.
        shares, times: series of the relaxation, (P,) each.
        dt: time of the step [s].
        pose: pose of the tool, (4, 4).
        middle: middle of its contact on the skin at rest, (3,) [m].
        normal: mean inward normal there, (3,).
        relaxed: elastic force that has relaxed in each time, (P,) [N].
        force: elastic force at rest (stmpl_core.relaxation) [N].
        depth: depth of the contact [m].
        power: power of the depth with which the elastic force grows [-].
        strain: 1 less the stretch of the column under it [-].
        radius: radius of the contact [m].
        came: middle of its contact before the step, or where it is now, if it did not press, (3,) [m].
    """
    away, stays = np.full(len(trail), np.inf), np.ones(len(trail))
    for k in range(len(trail)):
        if trail[k, _FORCE] > 0:
            place = trail[k, _FROM : _FROM + 3]
            away[k] = np.sqrt(np.sum((place - middle) ** 2))
            if away[k] >= radius:
                part = _share_of_way(came, middle, place, radius)
                stays[k] = part if part < 1 else 0.0
    _aged(trail, shares, times, dt, away, stays, force)
    place = np.argmin(away)
    if not away[place] > SPACING * radius:
        if not (away[place] < SAME * radius and force > trail[place, _FORCE] * (1 + HARDER)):
            return
        row = trail[place]  # one that is pressed deeper stays where it is, however slowly the tool goes on
        row[:_FROM] = pose.ravel()
        row[_NOW], row[_FORCE], row[_DEPTH], row[_POWER], row[_STRAIN] = force, force, depth, power, strain
        row[_LET_DEPTH] = row[_LET_FORCE] = 0.0
        return
    for _ in range(PLACES):
        share = 1.0
        if away[place] < np.inf:
            share = _share_of_way(came, middle, trail[place, _FROM : _FROM + 3], SPACING * radius)
        depths = _depths(trail, shares)
        depths[trail[:, _FORCE] == 0] = -1.0
        place = np.argmin(depths)
        row, back = trail[place], (1 - share) * (came - middle)
        row[:] = 0.0
        row[:_FROM] = pose.ravel()
        for x in range(3):
            row[4 * x + 3] += back[x]
        row[_FROM : _FROM + 3], row[_FROM + 3 : _NOW] = middle + back, normal
        row[_NOW], row[_FORCE], row[_DEPTH], row[_POWER], row[_STRAIN] = force, force, depth, power, strain
        row[FIXED:] = relaxed
        away[place] = np.sqrt(np.sum(back**2))
        if not away[place] > SPACING * radius:
            break


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


class Wake(NamedTuple):
    """What a tool left behind: its places and the shares of the series, as they are after a step."""

    trail: np.ndarray
    shares: np.ndarray

    def grooves(self) -> tuple[Groove, ...]:
        """The places where the skin is not back yet, as poses of the tool."""
        depths = _depths(self.trail, self.shares)
        some = np.flatnonzero(depths > FORGOTTEN * self.trail[:, _DEPTH])
        return tuple(Groove(row[_POSE].reshape(4, 4), depth, depth / row[_DEPTH])
                     for row, depth in zip(self.trail[some], depths[some].tolist(), strict=True))  # fmt: skip


def sunk(layer: SoftLayer, field: SignedDistance, left: Sequence[Groove], displacement: VertexVectors) -> VertexVectors:
    """The displacement with the skin in grooves as deep as they are: straight in, by a share of what the tool pressed.

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
        pressed = groove.share * -field.distance(local[some])
        wanted[some] = np.maximum(wanted[some], np.minimum(pressed, groove.depth))
    inward = -layer.normals[near]
    missing = wanted - np.einsum("ni,ni->n", displacement[near], inward)
    some = np.flatnonzero((wanted > 0) & (missing > 0))
    out = displacement.copy()
    out[near[some]] += missing[some, None] * inward[some]
    return out
