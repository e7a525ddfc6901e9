"""Rays: a column of skin as a ray through a tool's distance field, and the pressure that confines it."""

from __future__ import annotations

import numba
import numpy as np

from stmpl_core.compiling import UNCOUNTED
from stmpl_core.sdf import distance_at, jet_at

WALL = 0.05  # width over which depth rises beside a tool's wall, over the thickness: nothing pops in while it slides
PASSED, MOST_PASSED = 7, 1024  # parts of a column's way between which it is looked how far it is in a tool, or beside
ENTERS, LOOKS_BACK = 12, 0.15  # steps to where a column enters a tool, cosine from which its surface looks back there
LOOKED_AT = 0.2 * WALL  # way over which it is asked whether it does, over the thickness
SURE = 0.2  # how far inside a tool, over the width of a wall, it is clear where a way ends; so far outside: nowhere
LEAST_ASIDE = 0.1  # square of the slope aside from which it is known on which side of a way a tool is
ASLANT, UPRIGHT = 0.35, 0.15  # cosine to its tool's way from which skin goes with one that has sunk under it, and how
# much more until it does so wholly
NOT_SUNK, ANYHOW = np.zeros(3), 8.0  # what is said of a tool that has not sunk under skin; more than that: anyhow, by
UNSAID = np.full(3, ANYHOW + 1)  # a share that rises by 1. What is no longer than LONGEST says a way
LONGEST = 2.0
MAX_COLUMN_STRAIN = 0.9  # strain beyond which no column is squeezed
STEEPEST = 1.5  # slope that a distance field does not exceed on its way to 0 [-]; its spline's is above 1 beside edges
SECANT_START = 3e-3  # distance to the tool, over the thickness, at which the secant rule takes over from sphere tracing
GRAZES = 0.01  # least step along a wall of the tool, likewise
SECANT_TOLERANCE = 4e-4  # largest last step of the secant rule, likewise; the depth is then known far better


@numba.njit(cache=True, inline="always")
def to_tool(pose, x, y, z):
    """Coordinates in the tool's frame of a point of the body's."""
    a, b, c = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    return (pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c, pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c,
            pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c)  # fmt: skip


@numba.njit(cache=True, inline="always")
def ray_from(pose, x, y, z, a, b, c):
    """A point and a unit vector (a, b, c) in the tool's frame, as six numbers."""
    x, y, z = to_tool(pose, x, y, z)
    return (x, y, z, pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c, pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c,
            pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c)  # fmt: skip


@numba.njit(cache=True, inline="always")
def ray_of(pose, points, ways, n):
    """Point n and its unit vector in the tool's frame."""
    return ray_from(pose, points[n, 0], points[n, 1], points[n, 2], ways[n, 0], ways[n, 1], ways[n, 2])


@numba.njit(cache=True, inline="always")
def distance_in_column(grid, ray, s):
    """Signed distance to the tool at depth s along a ray [m]."""
    x, y, z = ray[0] + s * ray[3], ray[1] + s * ray[4], ray[2] + s * ray[5]
    return distance_at(grid[0], grid[1], grid[2], x, y, z)


@numba.njit(cache=True, inline="always")
def wall_in(half, t):
    """Width over which depth rises beside a wall of a tool of this half thickness, in a column t long [m]."""
    return min(WALL * t, half)


@numba.njit(forceinline=True, cache=True, error_model="numpy", **UNCOUNTED)
def depth_in_column(grid, ray, t, guess, least):
    """How deep along a ray, from the skin inwards, the tool ends [m]; 0 if it is not met.

    From a guess above WALL of the thickness by the secant rule. Where that goes astray, as along a wall of the tool, or
    without such a guess: from the core by sphere tracing, then the secant rule. Where the depth is not above `least`,
    any up to that is told.
    """
    if guess > WALL * t:
        s, d = guess, distance_in_column(grid, ray, guess)
        last_s, last_d = s + 1.0, d + 1.0
        for _ in range(6):
            slope = (d - last_d) / (s - last_s)
            if slope < 0.3:
                break
            last_s, last_d = s, d
            s -= d / slope
            if abs(s - last_s) < SECANT_TOLERANCE * t:
                if s > 0:
                    return min(s, t)
                break
            d = distance_in_column(grid, ray, s)
    s, d = t, distance_in_column(grid, ray, t)
    if d <= 0:
        return t
    last_s, last_d = s + 1.0, d + 1.0
    for _ in range(40):
        if s - d > 0 and d > SECANT_START * t:
            last_s, last_d = s, d
            s -= d
            if s <= least:
                return least
        else:
            slope = (d - last_d) / (s - last_s)
            if slope > 0.2 or d * last_d < 0:
                following = s - d / slope
            else:  # along a wall
                following = s - (max(d, GRAZES * t) if d > 0 else d)
            last_s, last_d = s, d
            s = following
        if s <= 0:
            return 0.0
        if abs(s - last_s) < SECANT_TOLERANCE * t:
            return min(s, t)
        d = distance_in_column(grid, ray, s)
    return min(s, t)


@numba.njit(forceinline=True, cache=True, error_model="numpy", **UNCOUNTED)
def inside_most(grid, ray, deep, most, least):
    """How far inside the tool a ray gets at most on its way to a depth [m], below 0: passes beside it; and where [m].

    It is looked as often as a plate of the tool's half thickness wants.

    Args:
        most: how far inside it begins [m].
        least: value up to which the answer does not matter [m].
    """
    at, there, where = 0.0, most, 0.0
    step = max(min(0.5 * grid[3], deep / PASSED), deep / MOST_PASSED)
    for k in range(1, MOST_PASSED + 1):
        s = min(k * step, deep)
        if there + STEEPEST * (s - at) > max(most, least):
            at, there = s, -distance_in_column(grid, ray, s)
            if there > most:
                most, where = there, s
        if not s < deep:
            break
    return most, where


@numba.njit(forceinline=True, cache=True, error_model="numpy", **UNCOUNTED)
def sure_of(grid, ray, deep, wall):
    """How clear it is that a ray leads through the tool to a depth [m], from -1, it passes beside it, to 1.

    Args:
        wall: see `wall_in`.

    Returns:
        how clear; and how far it is inside, and where, see `inside_most`.
    """
    where, inside = 0.0, -distance_in_column(grid, ray, 0.0)
    if inside < SURE * wall:
        inside, where = inside_most(grid, ray, deep, inside, -SURE * wall)
    return min(max(inside / (SURE * wall), -1.0), 1.0), inside, where


@numba.njit(cache=True, error_model="numpy", **UNCOUNTED)
def led_in(grid, ray, at, inside, wall):
    """A ray that passes the tool, or leads through its edge, moved aside until it is clear that it leads through it.

    Args:
        at, inside: where it is most inside, and how far [m]: see `inside_most`.
        wall: see `wall_in`.
    """
    x, y, z = ray[0] + at * ray[3], ray[1] + at * ray[4], ray[2] + at * ray[5]
    _, a, b, c = jet_at(grid[0], grid[1], grid[2], x, y, z)
    straight = a * ray[3] + b * ray[4] + c * ray[5]
    a, b, c = a - straight * ray[3], b - straight * ray[4], c - straight * ray[5]
    aside = max(SURE * wall - inside, 0.0) / max(a * a + b * b + c * c, LEAST_ASIDE)
    return ray[0] - aside * a, ray[1] - aside * b, ray[2] - aside * c, ray[3], ray[4], ray[5]


@numba.njit(cache=True, inline="always")
def way_of(top):
    """Share to which a tool has sunk under skin along a way that is known, and that way, a unit vector in its frame.

    Args:
        top: see `sunk_under`; the share of NOT_SUNK and of UNSAID is 0.
    """
    size = np.sqrt(top[0] * top[0] + top[1] * top[1] + top[2] * top[2])
    size = size if size < LONGEST else 0.0
    over = 1 / size if size > 0 else 0.0
    return size, -top[0] * over, -top[1] * over, -top[2] * over


@numba.njit(forceinline=True, cache=True, error_model="numpy", **UNCOUNTED)
def sunk_under(grid, ray, t, top):
    """Share to which a tool has sunk under a column's skin, from 0, it comes to the column from beside, to 1.

    Where the column enters the tool, or passes it within WALL of the thickness, its surface looks back along the way
    that the tool went: the column comes from above. On a thick, round limb columns around a deep tool lead into its
    lower half.

    Args:
        top: against the way that a tool went, in its frame, (3,), as long as the share to which it has sunk at all;
            UNSAID: any column that it is under; NOT_SUNK.
    """
    whole, x, y, z = way_of(top)
    if whole == 0:
        return min(max(top[0] - ANYHOW, 0.0), 1.0)
    s, d = 0.0, distance_in_column(grid, ray, 0.0)
    at, near = s, d
    for _ in range(ENTERS):
        if d < SECANT_START * t:
            break
        s += d
        if s >= t:
            break
        d = distance_in_column(grid, ray, s)
        if d < near:
            at, near = s, d
    enters = 1 - max(near - SECANT_START * t, 0.0) / (WALL * t)
    if enters <= 0:
        return 0.0
    back = LOOKED_AT * t
    rise = distance_at(grid[0], grid[1], grid[2], ray[0] + at * ray[3] - back * x, ray[1] + at * ray[4] - back * y,
                       ray[2] + at * ray[5] - back * z) - near  # fmt: skip
    return whole * enters * min(max(rise / (LOOKS_BACK * back), 0.0), 1.0)


@numba.njit(forceinline=True, cache=True, error_model="numpy", **UNCOUNTED)
def depth_and_share(grid, ray, t, top):
    """How deep the tool is in a column [m], and the share of that which counts: rising from 0 at its skin over a wall.

    Where the tool has sunk under skin that it does not reach, a column counts as far as it is inside the tool.
    """
    wall, guess = wall_in(grid[3], t), -distance_in_column(grid, ray, 0.0)
    share, sunk = min(max(1 + guess / wall, 0.0), 1.0), top.any()
    if share <= 0 and not sunk:
        return 0.0, 0.0
    deep = depth_in_column(grid, ray, t, guess, 0.0)
    if deep == 0 and guess > 0:
        deep = guess  # the skin is no deeper in the tool than distances are off by
    if share < 1 and sunk and deep > 0:
        within = min(2 * inside_most(grid, ray, deep, guess, 0.5 * share * wall)[0] / wall, 1.0)
        if within > share:
            share += (within - share) * sunk_under(grid, ray, t, top)
    return deep, share


@numba.njit(cache=True, error_model="numpy", **UNCOUNTED)
def swept(grid, ray, t, top):
    """Where a tool that has sunk under skin has come through it, though the skin's column leads past the tool.

    Skin goes with a tool along the tool's way. A limb's columns lead a little aside: past the back of a tool that is
    less high than it is deep, where they would leave a taller one by its wall.

    Args:
        top: see `sunk_under`.

    Returns:
        depth by which the skin sinks along its normal [m]; the share of that which counts; and how much of it lies on
        the tool: less beside a wall that the way just passes.
    """
    size, a, b, c = way_of(top)
    cosine = a * ray[3] + b * ray[4] + c * ray[5]
    if size == 0 or cosine <= ASLANT:
        return 0.0, 0.0, 0.0
    way = ray[0], ray[1], ray[2], a, b, c
    wall, d = wall_in(grid[3], t), distance_in_column(grid, ray, 0.0)
    inside, _ = inside_most(grid, way, t, -d, 0.0)
    if inside <= 0:
        return 0.0, 0.0, 0.0
    share = size * min(2 * inside / wall, 1.0) * min((cosine - ASLANT) / UPRIGHT, 1.0)
    deep = depth_in_column(grid, way, t, 0.0, 0.0)
    lies = min(max(-2 * distance_in_column(grid, way, deep - wall) / wall, 0.0), 1.0) if deep > wall else 1.0
    return deep * cosine, share, share * lies


@numba.njit(forceinline=True, cache=True, error_model="numpy")
def column_pressure(moduli, strain):
    """Pressure of confined Neo-Hookean columns, over E [-]; moduli: mu and lambda over E."""
    stretch = 1 - strain
    return -(moduli[0] * (stretch - 1 / stretch) + moduli[1] * np.log(stretch) / stretch)
