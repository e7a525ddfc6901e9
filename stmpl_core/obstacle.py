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
MAX_ITERATIONS = 200
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
    count, width = len(points), rows.shape[1] - 1
    out, rings = np.zeros((count, count)), np.zeros((width, count, count), np.float32)
    roots = 1 / np.sqrt(thickness)
    own = np.sqrt(area) / OWN
    for i in range(count):
        for j in range(i + 1):
            facing = inward[i, 0] * inward[j, 0] + inward[i, 1] * inward[j, 1] + inward[i, 2] * inward[j, 2]
            x, y, z = (points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2])
            per = roots[i] * roots[j]
            r = np.sqrt(x * x + y * y + z * z)
            f = r * per * STEPS
            if facing <= 0 or f >= REACH * STEPS or group[i] != group[j]:
                continue
            k = int(f)
            f -= k
            value = half_space / max(r, 0.5 * (own[i] + own[j])) + per * ((1 - f) * rows[k, 0] + f * rows[k + 1, 0])
            out[i, j] = out[j, i] = mean * value
            if k < NEAR * STEPS:
                _weigh(rings, i, j, per * per, rows, k, f)
    return out, rings


@numba.njit(cache=True, nogil=True, error_model="numpy")
def rings_of(points, inward, thickness, group, rows):
    """The weights in rings that `pairs` gives for nodes on a layer of one thickness [m], (., N, N)."""
    count, scale = len(points), STEPS / thickness
    rings = np.zeros((rows.shape[1] - 1, count, count), np.float32)
    for i in range(count):
        for j in range(i + 1):
            facing = inward[i, 0] * inward[j, 0] + inward[i, 1] * inward[j, 1] + inward[i, 2] * inward[j, 2]
            x, y, z = (points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2])
            f = np.sqrt(x * x + y * y + z * z) * scale
            if facing > 0 and f < NEAR * STEPS and group[i] == group[j]:
                k = int(f)
                _weigh(rings, i, j, 1 / (thickness * thickness), rows, k, f - k)
    return rings


@numba.njit(cache=True, error_model="numpy", inline="always")
def _weigh(rings, i, j, per, rows, k, f):
    """Writes the weights of a pair of nodes at place k and fraction f of the table's rows."""
    for m in range(len(rings)):
        weight = per * ((1 - f) * rows[k, m + 1] + f * rows[k + 1, m + 1])
        rings[m, i, j] = rings[m, j, i] = weight


@numba.njit(cache=True, nogil=True, error_model="numpy")
def moments_of(rings, points, thickness, area, pressure, strain):
    """What nodes see around them.

    Args:
        rings: weights of nodes in rings, see `pairs`.
        points: nodes on the skin at rest, (N, 3) [m].
        thickness: thickness of the layer there, (N,) [m].
        area: area that each stands for, (N,) [m2].
        pressure, strain: pressure over E, and depth over the thickness, (N,) [-].

    Returns:
        moments: of pressure and strain on the rings, (N, 2, RINGS) [-].
        vectors: their first moments, in the body's axes, (N, 2, 3) [-].
    """
    width, count = rings.shape[:2]
    sources, scale, centre = np.empty((count, 8), np.float32), thickness.mean(), points[0].copy()
    for j in range(count):
        for s in range(2):
            value = area[j] / scale**2 * (pressure[j] if s == 0 else strain[j])
            sources[j, 4 * s] = value
            for x in range(3):
                sources[j, 4 * s + 1 + x] = value * (points[j, x] - centre[x]) / scale
    flat, sums = rings.reshape(width * count, count), np.empty((width * count, 8), np.float32)
    block = max(1, ONE_THREAD // (8 * count))
    for start in range(0, width * count, block):
        sums[start : start + block] = np.dot(flat[start : start + block], sources)
    sums = sums.reshape(width, count, 8)
    moments, vectors = np.empty((count, 2, width - 1)), np.empty((count, 2, 3))
    for i in range(count):
        for s in range(2):
            for m in range(width - 1):
                moments[i, s, m] = sums[m, i, 4 * s] * scale**2
            for x in range(3):
                here = (points[i, x] - centre[x]) / scale
                around = sums[width - 1, i, 4 * s + 1 + x] - here * sums[width - 1, i, 4 * s]
                vectors[i, s, x] = around * scale**3 / thickness[i]
    return moments, vectors


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve(matrix, depth):
    """Forces (N,) >= 0 with matrix @ forces >= depth, and equal where they are above 0."""
    count = len(depth)
    force, gap, way, along = np.zeros(count), np.empty(count), np.zeros(count), np.empty(count)
    for i in range(count):
        if depth[i] > 0:
            force[i] = 0.3 * depth[i] / matrix[i, i]
    before, restart = 1.0, True
    for _ in range(MAX_ITERATIONS):
        square = 0.0
        _times(matrix, force, gap)
        for i in range(count):
            gap[i] -= depth[i]
            if force[i] > 0:
                square += gap[i] * gap[i]
        if square == 0:
            break
        for i in range(count):
            way[i] = 0.0 if force[i] <= 0 else gap[i] + (0.0 if restart else square / before * way[i])
        before = square
        up = down = 0.0
        _times(matrix, way, along)
        for i in range(count):
            up += gap[i] * way[i]
            down += along[i] * way[i]
        if down <= 0:
            break
        step = up / down
        restart, change, largest = False, 0.0, 0.0
        for i in range(count):
            now = force[i]
            if now > 0:
                now = max(now - step * way[i], 0.0)
            elif gap[i] < 0:
                now = -gap[i] / matrix[i, i]  # the skin would be inside the tool: it presses after all
                restart = True
            change, largest = max(change, abs(now - force[i])), max(largest, now)
            force[i] = now
        if change <= TOLERANCE * largest:
            break
    return force


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
def _times(matrix, vector, out):
    """out = a symmetric matrix (N, N) times a vector, summed in one order whatever the processor's width."""
    out[:] = 0.0
    for j in range(len(vector)):
        if vector[j] != 0.0:
            for i in range(len(out)):
                out[i] += matrix[j, i] * vector[j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def power_of(matrix, force, depth):
    """The slope of the whole force over the depth, times depth over force: conjugate gradients on what presses."""
    count = len(force)
    found, left = np.zeros(count), (force > 0).astype(np.float64)
    way, along = left.copy(), np.empty(count)
    square = start = left.sum()
    for _ in range(MAX_ITERATIONS):
        if square <= POWER_TOLERANCE * start:
            break
        _times(matrix, way, along)
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
    return depth * found.sum() / max(force.sum(), 1e-300)
