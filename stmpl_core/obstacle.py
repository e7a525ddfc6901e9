"""Obstacle: the pressure with which a bonded linear layer holds a rigid tool off, and where: contact finds its area.

At contact nodes the tool asks for depths d. With the layer's linear response G from forces q to depths,

    q >= 0,    G q >= d,    q (G q - d) = 0

(Signorini's problem). Solved by conjugate gradients on the nodes that press: Polonsky & Keer, Wear 231, 206-219, 1999.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numba
import numpy as np
from scipy.special import j0

from stmpl_core.response import of_one

REACH = 8.0  # distance beyond which nodes do not feel each other, over t
STEPS = 64  # rows of the layer's table a thickness
NEAR = 4.0  # distance to which rings see, over t
RING_AT = np.array([0.0, 0.5, 1.1, 1.9])  # radii of the rings, over t
RING_WIDTH = np.array([0.3, 0.3, 0.4, 0.6])  # their widths, likewise
RINGS = len(RING_AT)
OWN = 3.921  # of an even pressure on a lattice of triangles: sum of 1 / r with this / sqrt(area) for the node itself
TOLERANCE = 3e-6  # largest change of the forces of one iteration, over the largest, at which it ends
MAX_ITERATIONS = 1000  # most took 30; three tools that cross on one material took 250 to 600
FARTHEST = 1e3  # force of a node over what it needs alone, beyond which there is no solution: no layer responds so
NONE, NEXT = np.uint64(0), np.uint64(1)
LEAST_RISE, TINY = 1e-3, 1e-12  # stands against a rise across nodes in a row, over the square of their spread; and [m2]
ONE_THREAD = 2**18  # multiplications up to which OpenBLAS takes one thread, and so always sums in the same order
POWER_TOLERANCE = 1e-4  # square of the residual over the first, at which the power is known


class Response(NamedTuple):
    """What a unit force does to a layer with E = t = 1, and how much of it a ring around a node sees.

    Args:
        half_space: factor (1 - nu^2) / pi on the response of the half-space.
        rows: over the distance in thicknesses: what the layer's response is more; weight of each ring; weight of the
            first moment, over the distance.
    """

    half_space: float
    rows: np.ndarray


@cache
def response(poisson_ratio: float) -> Response:
    """Tables for a flat bonded layer (see stmpl_core.response for its compliance A(k), and the sources).

    The half-space takes the singular part, 2 (1 - nu^2) / k, so that nodes may be as close together as they like; the
    rest of A falls with exp(-2 k).
    """
    nu, k = poisson_ratio, np.linspace(0, 14, 2801)[1:]
    sink, _ = of_one(nu, k)
    radius = np.arange(int(REACH * STEPS) + 2) / STEPS
    weight = (sink - 2 * (1 - nu * nu) / k) * k * (k[1] - k[0]) / (2 * np.pi)
    layer = j0(np.outer(radius, k)) @ weight - (1 - nu * nu) * (k[1] - k[0]) / (2 * np.pi)  # the half step at k = 0
    half_space = (1 - nu * nu) / np.pi
    fade = np.clip((REACH - radius) / 1.5, 0, 1)
    whole = half_space / np.maximum(radius, 1.0)
    layer = np.where(radius > 1, (layer + whole) * fade * fade * (3 - 2 * fade) - whole, layer)
    rings = np.exp(-0.5 * ((radius[:, None] - RING_AT) / RING_WIDTH) ** 2)
    fade = np.clip(NEAR - radius, 0, 1)
    rings *= (fade * fade * (3 - 2 * fade))[:, None]
    rings /= (2 * np.pi * radius[:, None] * rings).sum(axis=0) / STEPS
    along = rings[:, 1] * np.minimum(radius / 0.35, 1.0) / np.maximum(radius, 1 / STEPS)
    return Response(half_space, np.column_stack([layer, rings, along]))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pairs(points, inward, thickness, area, group, mean, half_space, rows):
    """Depth over `mean` of each node under a force E mean^2 at each, and its weights in rings, (N, N) and (., N, N).

    All of it is symmetric.

    Args:
        points, inward: nodes on the skin at rest and unit vectors into it, (N, 3) [m], [-].
        thickness: thickness of the layer there, (N,) [m].
        area: area that each stands for, (N,) [m2].
        group: numbers of groups of nodes that do not feel each other, (N,).
        mean: unit of length [m].
        half_space, rows: tables of a Response.
    """
    count, width, by = len(points), rows.shape[1] - 1, columns_of(points, inward)
    out, rings = np.empty((count, count)), np.empty((width, count, count), np.float32)
    roots, own = 1 / np.sqrt(thickness), np.sqrt(area) / OWN
    away, place, per = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        _apart(by, group, NONE, i, away)
        for j in range(i + 1):
            per[j] = roots[i] * roots[j]
            place[j] = min(away[j] * per[j] * STEPS, REACH * STEPS)
            away[j] = half_space / max(away[j], 0.5 * (own[i] + own[j]))
        _read(rows[:, 0], place, per, out[i], NONE, i)
        for j in range(i + 1):
            out[i, j] = mean * (away[j] + out[i, j]) if place[j] < REACH * STEPS else 0.0
            per[j] *= per[j]
        for m in range(width):
            _read(rows[:, m + 1], place, per, rings[m, i], NONE, i)
    _mirror(out)
    for m in range(width):
        _mirror(rings[m])
    return out, rings


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rings_of(points, inward, thickness, group, rows):
    """The weights in rings that `pairs` gives for nodes on a layer of one thickness [m], (., N, N)."""
    count, scale, by = len(points), STEPS / thickness, columns_of(points, inward)
    rings = np.zeros((rows.shape[1] - 1, count, count), np.float32)
    away, per = np.empty(count), np.full(count, 1 / (thickness * thickness))
    for i in range(count):
        first = np.uint64(0)
        while group[first] != group[i]:  # before it there are none that it feels
            first += NEXT
        _apart(by, group, first, i, away)
        for j in range(first, np.uint64(i + 1)):
            away[j] = min(away[j] * scale, REACH * STEPS)
        for m in range(len(rings)):
            _read(rows[:, m + 1], away, per, rings[m, i], first, i)
    for m in range(len(rings)):
        _mirror(rings[m])
    return rings


@numba.njit(cache=True, nogil=True, error_model="numpy")
def columns_of(points, inward):
    """Places and normals of nodes, one below the other, (6, N): loops over nodes then run in vector registers."""
    by = np.empty((6, len(points)))
    for n in range(len(points)):
        for x in range(3):
            by[x, n], by[3 + x, n] = points[n, x], inward[n, x]
    return by


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _apart(by, group, first, i, out):
    """Writes how far node i is from those from a first one up to it [m]; inf from one that it does not face, or of
    another group."""
    p0, p1, p2, n0, n1, n2, its = by[0, i], by[1, i], by[2, i], by[3, i], by[4, i], by[5, i], group[i]
    for j in range(first, np.uint64(i + 1)):
        facing = n0 * by[3, j] + n1 * by[4, j] + n2 * by[5, j]
        x, y, z = p0 - by[0, j], p1 - by[1, j], p2 - by[2, j]
        out[j] = np.sqrt(x * x + y * y + z * z) if (facing > 0) & (its == group[j]) else np.inf


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _read(table, place, per, out, first, i):
    """Writes per times a table's value at places, for the nodes from a first one up to i."""
    for j in range(first, np.uint64(i + 1)):
        whole = np.int32(place[j])
        f, k = place[j] - whole, np.uint64(whole)  # no index that may count from the end
        out[j] = per[j] * ((1 - f) * table[k] + f * table[k + NEXT])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mirror(matrix):
    """Writes the upper triangle from the lower one."""
    for i in range(len(matrix)):
        for j in range(i):
            matrix[j, i] = matrix[i, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def moments_of(rings, points, thickness, area, pressure, strain):
    """What nodes see around them, of K cases at once: so the rings are read once.

    Args:
        rings: weights of nodes in rings, see `pairs`.
        points: nodes on the skin at rest, (N, 3) [m].
        thickness: thickness of the layer there, (N,) [m].
        area: area that each stands for, (N,) [m2].
        pressure, strain: pressure over E, and depth over the thickness, (K, N) [-].

    Returns:
        moments: of pressure and strain on the rings, (K, N, 2, RINGS) [-].
        vectors: their first moments, in the body's axes, (K, N, 2, 3) [-].
    """
    width, count = rings.shape[:2]
    wide = 8 * len(pressure)
    sources, scale, centre = np.empty((count, wide), np.float32), thickness.mean(), points[0].copy()
    for j in range(count):
        for c in range(wide // 4):
            value = area[j] / scale**2 * (pressure[c // 2, j] if c % 2 == 0 else strain[c // 2, j])
            sources[j, 4 * c] = value
            for x in range(3):
                sources[j, 4 * c + 1 + x] = value * (points[j, x] - centre[x]) / scale
    flat, sums = rings.reshape(width * count, count), np.empty((width * count, wide), np.float32)
    block = max(1, ONE_THREAD // (wide * count))
    for start in range(0, width * count, block):
        sums[start : start + block] = np.dot(flat[start : start + block], sources)
    sums = sums.reshape(width, count, wide)
    moments, vectors = np.empty((len(pressure), count, 2, width - 1)), np.empty((len(pressure), count, 2, 3))
    for i in range(count):
        for c in range(wide // 4):
            for m in range(width - 1):
                moments[c // 2, i, c % 2, m] = sums[m, i, 4 * c] * scale**2
            for x in range(3):
                here = (points[i, x] - centre[x]) / scale
                around = sums[width - 1, i, 4 * c + 1 + x] - here * sums[width - 1, i, 4 * c]
                vectors[c // 2, i, c % 2, x] = around * scale**3 / thickness[i]
    return moments, vectors


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve(matrix, depth):
    """Forces (N,) >= 0 with matrix @ forces >= depth, and equal where they are above 0; and what they lack of that.

    A matrix that is not positive, as that of a tool around half of a small limb, has none: what was found is large, and
    not to be trusted. How far depths are missed at most, over the deepest, is told of what was found.
    """
    count, most = len(depth), 0.0
    force, gap, way, along = np.zeros(count), -depth, np.zeros(count), np.empty(count)
    for i in range(count):
        if depth[i] > 0:
            force[i] = 0.3 * depth[i] / matrix[i, i]
            most = max(most, FARTHEST * depth[i] / matrix[i, i])
    _add_times(matrix, force, gap)
    before, restart, beside, needs = 1.0, True, np.empty(count), np.empty(count)
    for _ in range(MAX_ITERATIONS):
        square = 0.0
        for i in range(count):
            if force[i] > 0:
                square += gap[i] * gap[i]
        if square == 0:
            break
        for i in range(count):
            way[i] = 0.0 if force[i] <= 0 else gap[i] + (0.0 if restart else square / before * way[i])
        before = square
        up = down = 0.0
        along[:] = 0.0
        _add_times(matrix, way, along)
        for i in range(count):
            up += gap[i] * way[i]
            down += along[i] * way[i]
        if down <= 0:
            break
        step = up / down
        for i in range(count):
            needs[i] = -gap[i] if force[i] <= 0 and gap[i] < 0 else 0.0
        restart, change, largest = False, 0.0, 0.0
        for i in range(count):
            straight = now = force[i] - step * way[i]
            if force[i] > 0:
                now = max(now, 0.0)
            elif needs[i] > 0:  # the skin would be inside the tool: it presses after all, and not alone
                among = 0.0
                for j in range(count):
                    if needs[j] > 0:
                        among += max(matrix[i, j], 0.0)
                now, restart = needs[i] / among, True
            change, largest = max(change, abs(now - force[i])), max(largest, now)
            force[i], beside[i] = now, now - straight
            gap[i] -= step * along[i]
        _add_times(matrix, beside, gap)  # few left the straight way: the gap follows without another whole product
        if change <= TOLERANCE * largest or largest > most:
            break
    missed = deepest = 0.0
    for i in range(count):
        miss = abs(gap[i]) if force[i] > 0 else max(-gap[i], 0.0)
        missed = max(missed, miss if miss < np.inf else np.inf)
        deepest = max(deepest, depth[i])
        missed = np.inf if force[i] > most else missed
    return force, missed / max(deepest, 1e-300)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rates_of(matrix, force, depth_rates):
    """Rates of forces (K, N) that `solve` gives, as the depths change (K, N): of the nodes that press, no other."""
    some = np.flatnonzero(force > 0)
    inner, right = np.empty((len(some), len(some))), np.empty((len(some), len(depth_rates)))
    for a in range(len(some)):
        for b in range(len(some)):
            inner[a, b] = matrix[some[a], some[b]]
        for k in range(len(depth_rates)):
            right[a, k] = depth_rates[k, some[a]]
    found, out = np.linalg.solve(inner, right), np.zeros_like(depth_rates)
    for a in range(len(some)):
        for k in range(len(depth_rates)):
            out[k, some[a]] = found[a, k]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def nearer(matrix, force, points, inward, gone, ends):
    """Rates (K, N) of how far nodes are sunk by the forces of other tools, as the tools go along the skin.

    What one tool sinks beside itself is taken to rise evenly over where another presses; where that goes, the first
    feels as much of it, over all its nodes alike (Betti).

    Args:
        matrix, force: see `solve`.
        points, inward: places of the nodes and their inward normals, (N, 3).
        gone: rates of the places, (K, N, 3).
        ends: where the nodes of each of M tools begin, and N, (M + 1,).
    """
    out, many = np.zeros(gone.shape[:2]), len(ends) - 1
    for m in range(many if many > 1 else 0):
        here = np.arange(ends[m], ends[m + 1])
        pressed, way, middle = force[here].sum(), np.zeros(3), np.zeros(3)
        if not pressed > 0:
            continue
        for i in here:
            for x in range(3):
                way[x] += force[i] / pressed * inward[i, x]
                middle[x] += force[i] / pressed * points[i, x]
        for other in range(many):
            there = np.arange(ends[other], ends[other + 1])
            if other == m or not force[there].sum() > 0:
                continue
            square, slope = np.zeros((3, 3)), np.zeros(3)
            for i in here:
                sunk = 0.0
                for j in there:
                    sunk += matrix[i, j] * force[j]
                for x in range(3):
                    a = points[i, x] - middle[x]
                    slope[x] += force[i] * sunk * a
                    for y in range(3):
                        square[x, y] += force[i] * a * (points[i, y] - middle[y])
            wide = np.trace(square) + TINY
            for x in range(3):
                square[x, x] += LEAST_RISE * wide  # of nodes in a row, or of one, no rise across is known
                for y in range(3):
                    square[x, y] += wide * way[x] * way[y]
            rise = np.linalg.solve(square, slope)
            for k in range(len(gone)):
                work = 0.0
                for i in here:
                    more = 0.0
                    for x in range(3):
                        more += gone[k, i, x] * rise[x]
                    out[k, i] += more
                    work += force[i] * more
                for j in there:  # what moves one tool's forces in the other's field moves the other's in that one's
                    out[k, j] += work / force[there].sum()
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_times(matrix, vector, out):
    """Adds a symmetric matrix (N, N) times a vector to out, in one order whatever the processor's width."""
    for j in range(len(vector)):
        if vector[j] != 0.0:
            for i in range(len(out)):
                out[i] += matrix[j, i] * vector[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def powers_of(matrix, force, depth, of, many):
    """The slope of the force of each node's tool over the depth, times depth over force, (N,): conjugate gradients on
    what presses.

    Args:
        matrix, force: response, and forces that it needs, (N, N) and (N,).
        depth: depths of the nodes, (N,).
        of, many: number of the tool of each node, (N,), and of tools.
    """
    count = len(force)
    found, left = np.zeros(count), (force > 0).astype(np.float64)
    way, along = left.copy(), np.empty(count)
    square = start = left.sum()
    for _ in range(MAX_ITERATIONS):
        if square <= POWER_TOLERANCE * start:
            break
        along[:] = 0.0
        _add_times(matrix, way, along)
        down = 0.0
        for i in range(count):
            along[i] = along[i] if force[i] > 0 else 0.0
            down += along[i] * way[i]
        step, before, square = square / down, square, 0.0
        for i in range(count):
            found[i] += step * way[i]
            left[i] -= step * along[i]
            square += left[i] * left[i]
        for i in range(count):
            way[i] = left[i] + square / before * way[i]
    told = np.zeros((many, 3))
    for i in range(count):
        told[of[i], 0] = max(told[of[i], 0], depth[i])
        told[of[i], 1] += found[i]
        told[of[i], 2] += force[i]
    for i in range(count):
        deepest, rises, whole = told[of[i]]
        found[i] = deepest * rises / max(whole, 1e-300)
    return found
