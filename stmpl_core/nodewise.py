"""Nodewise: what forces at contact nodes do to each other and to the skin, on one material, in single precision.

The same sums as in stmpl_core.green, without a coarse part and without places that are softer. With n and s the inward
normals of a point and of a source, m their mean, d the direction from source to point across m, and g the responses
of the flat layer, a force f moves the point by

    n (g0 f.s - g1 f.d) + d (g1 f.s + along f.d) + (even - along / 2) (f - m f.m)

Loops over the sources have no branches, so that they run in vector registers.
"""

from __future__ import annotations

import numba
import numpy as np

from stmpl_core.response import FAST, SPREAD

FINER = 48  # rows of the tables between two of their spreads
SETTLED, MOST_STEPS = 1e-5, 60  # motion that stuck nodes may miss, over theirs, and steps within which it is found
AREAS = 33  # logarithms of the widths of a tool's nodes
NEXT = np.uint64(1)  # no index that may count from the end
ZERO, HALF, ONE, TINY, SAME = (np.float32(x) for x in (0, 0.5, 1, 1e-12, 1e-6))
REACH, TABLE_ROWS = 8.0, 64  # of the tables, see stmpl_core.green
ROWS, FARTHEST = np.float32(TABLE_ROWS), np.float32(np.sqrt(0.9999 * REACH) * TABLE_ROWS)
END = np.float32(0.98 * REACH)
PER_AROUND = np.float32(2)  # over the cosine between two normals: from 1 on two places feel all of each other
WIDE = np.float32(2 / np.pi * SPREAD**2)  # square of the distance at which 1 / r ends, over a node's area


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def blocks(by, group, logs, least, steps, rows):
    """Motion of each node under a force E at each, (3 N, 3 N) float32 [1/m], symmetric.

    Args:
        by: of each node: place, inward normal, root of the thickness, half its logarithm in rows of spread, area,
            (9, N) float32.
        group: numbers of groups of nodes that do not feel each other, (N,).
        logs: rows of spread of AREAS areas, of spreads in metres.
        least, steps: first of these areas, and AREAS - 1 over their range.
        rows: tables by spread and root of the distance, (S, 4, R) float32.
    """
    count, wide, flat = by.shape[1], rows.shape[2], rows.ravel()
    one, out = np.empty((9, count), np.float32), np.empty((3 * count, 3 * count), np.float32)
    top, areas_top = np.float32(len(rows) / FINER - 0.001), np.float32(AREAS - 1.001)
    for i in range(count):
        p0, p1, p2, n0, n1, n2 = by[0, i], by[1, i], by[2, i], by[3, i], by[4, i], by[5, i]
        root, own, area = by[6, i], by[7, i], by[8, i]
        for j in range(i + 1):
            d0, d1, d2, s0, s1, s2 = p0 - by[0, j], p1 - by[1, j], p2 - by[2, j], by[3, j], by[4, j], by[5, j]
            t, mean = root * by[6, j], HALF * (area + by[8, j])
            a = min((mean - least) * steps, areas_top)
            m = np.uint64(a)
            h = logs[m] + (a - np.float32(m)) * (logs[m + NEXT] - logs[m]) - own - by[7, j]
            at = np.int32(np.float32(FINER) * min(max(h, ZERO), top))
            square = d0 * d0 + d1 * d1 + d2 * d2
            r = np.sqrt(square) / t
            facing = min(max(PER_AROUND * (n0 * s0 + n1 * s1 + n2 * s2), ZERO), ONE)
            per = facing * facing * (np.float32(3) - facing - facing) / np.sqrt(square + mean * WIDE)
            per = per if r < END else ZERO
            f = min(np.sqrt(r) * ROWS, FARTHEST)
            k = np.int32(f)
            f, q = f - np.float32(k), np.uint64(4 * wide * at + k)
            b, c, d = q + np.uint64(wide), q + np.uint64(2 * wide), q + np.uint64(3 * wide)
            g0, g1 = flat[q] + f * (flat[q + NEXT] - flat[q]), flat[b] + f * (flat[b + NEXT] - flat[b])
            even, along = flat[c] + f * (flat[c + NEXT] - flat[c]), flat[d] + f * (flat[d + NEXT] - flat[d])
            g0, g1, along, rest = per * g0, per * g1, per * along, per * (even - HALF * along)
            m0, m1, m2 = n0 + s0, n1 + s1, n2 + s2
            length = ONE / np.sqrt(max(m0 * m0 + m1 * m1 + m2 * m2, TINY))
            m0, m1, m2 = m0 * length, m1 * length, m2 * length
            up = d0 * m0 + d1 * m1 + d2 * m2
            d0, d1, d2 = d0 - up * m0, d1 - up * m1, d2 - up * m2
            length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            length = ONE / length if length > SAME * t else ZERO
            d0, d1, d2 = d0 * length, d1 * length, d2 * length
            a0, a1, a2 = g0 * s0 - g1 * d0, g0 * s1 - g1 * d1, g0 * s2 - g1 * d2
            b0, b1, b2 = g1 * s0 + along * d0, g1 * s1 + along * d1, g1 * s2 + along * d2
            one[0, j], one[1, j] = n0 * a0 + d0 * b0 + rest * (ONE - m0 * m0), n0 * a1 + d0 * b1 - rest * m0 * m1
            one[2, j], one[3, j] = n0 * a2 + d0 * b2 - rest * m0 * m2, n1 * a0 + d1 * b0 - rest * m1 * m0
            one[4, j], one[5, j] = n1 * a1 + d1 * b1 + rest * (ONE - m1 * m1), n1 * a2 + d1 * b2 - rest * m1 * m2
            one[6, j], one[7, j] = n2 * a0 + d2 * b0 - rest * m2 * m0, n2 * a1 + d2 * b1 - rest * m2 * m1
            one[8, j] = n2 * a2 + d2 * b2 + rest * (ONE - m2 * m2)
        for j in range(i + 1):
            for x in range(3):
                for y in range(3):
                    value = one[3 * x + y, j] if group[i] == group[j] else ZERO
                    out[3 * i + x, 3 * j + y] = out[3 * j + y, 3 * i + x] = value
    return out


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def approached(held, gone, guess):
    """Forces (3 N,) under which nodes go where they have gone, (3 N,), by conjugate gradients from a guess.

    The condition of `blocks` is about 15: fourteen steps take a motion to 1e-5 of its peak.
    """
    count = len(gone)
    out, left, way, image = guess.copy(), gone.copy(), np.empty(count, np.float32), np.empty(count, np.float32)
    per, size, whole = np.empty(count, np.float32), ZERO, ZERO
    _multiply(held, out, image)
    for n in range(count):
        per[n] = ONE / held[n, n]
        left[n] -= image[n]
        way[n] = per[n] * left[n]
        size += left[n] * way[n]
        whole += gone[n] * per[n] * gone[n]
    enough = np.float32(SETTLED**2) * whole
    for _ in range(MOST_STEPS):
        if size <= enough:
            break
        _multiply(held, way, image)
        along, now = ZERO, ZERO
        for n in range(count):
            along += way[n] * image[n]
        share = size / along
        for n in range(count):
            out[n] += share * way[n]
            left[n] -= share * image[n]
            now += left[n] * per[n] * left[n]
        for n in range(count):
            way[n] = per[n] * left[n] + now / size * way[n]
        size = now
    return out


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _multiply(matrix, vector, out):
    """out = matrix times vector: BLAS would sum in another order on more threads."""
    for n in range(len(vector)):
        total = ZERO
        for m in range(len(vector)):
            total += matrix[n, m] * vector[m]
        out[n] = total


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_motion(out, there, points, inward, roots, by, forces, rows):
    """Adds to rows `there` of out (M, 3) float32 [m] the motion of points under forces over E at nodes (3, N) [m2].

    Args:
        out: motion of the points.
        there: numbers of the points that feel the nodes.
        points, inward, roots: points, unit vectors into the skin, (M, 3) float32, root of the thickness there, (M,).
        by: of each node: place, inward normal, root of the thickness, row of its spread, area over the thickness
            squared, (9, N) float32.
        forces: forces (3, N) float32.
        rows: see `blocks`.
    """
    count, wide, flat = by.shape[1], rows.shape[2], rows.ravel()
    first, top = np.empty(count, np.int32), np.float32(len(rows) / FINER - 0.001)
    for j in range(count):
        first[j] = 4 * wide * int(np.float32(FINER) * min(max(by[7, j], ZERO), top))
    for n in range(len(there)):
        i = there[n]
        p0, p1, p2, n0, n1, n2 = points[i, 0], points[i, 1], points[i, 2], inward[i, 0], inward[i, 1], inward[i, 2]
        root, u, v, w = roots[i], ZERO, ZERO, ZERO
        for j in range(count):
            d0, d1, d2, s0, s1, s2 = p0 - by[0, j], p1 - by[1, j], p2 - by[2, j], by[3, j], by[4, j], by[5, j]
            f0, f1, f2, t = forces[0, j], forces[1, j], forces[2, j], root * by[6, j]
            r = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2) / t
            facing = min(max(PER_AROUND * (n0 * s0 + n1 * s1 + n2 * s2), ZERO), ONE)
            per = facing * facing * (np.float32(3) - facing - facing) / (np.sqrt(r * r + by[8, j] * WIDE) * t)
            per = per if r < END else ZERO
            f = min(np.sqrt(r) * ROWS, FARTHEST)
            k = np.int32(f)
            f, q = f - np.float32(k), np.uint64(first[j] + k)
            b, c, d = q + np.uint64(wide), q + np.uint64(2 * wide), q + np.uint64(3 * wide)
            g0, g1 = flat[q] + f * (flat[q + NEXT] - flat[q]), flat[b] + f * (flat[b + NEXT] - flat[b])
            even, along = flat[c] + f * (flat[c + NEXT] - flat[c]), flat[d] + f * (flat[d + NEXT] - flat[d])
            m0, m1, m2 = n0 + s0, n1 + s1, n2 + s2
            length = ONE / np.sqrt(max(m0 * m0 + m1 * m1 + m2 * m2, TINY))
            m0, m1, m2 = m0 * length, m1 * length, m2 * length
            up = d0 * m0 + d1 * m1 + d2 * m2
            d0, d1, d2 = d0 - up * m0, d1 - up * m1, d2 - up * m2
            length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            length = ONE / length if length > SAME * t else ZERO
            d0, d1, d2 = d0 * length, d1 * length, d2 * length
            down, radial, over = f0 * s0 + f1 * s1 + f2 * s2, f0 * d0 + f1 * d1 + f2 * d2, f0 * m0 + f1 * m1 + f2 * m2
            sink, away = per * (g0 * down - g1 * radial), per * (g1 * down + along * radial)
            rest = per * (even - HALF * along)
            u += sink * n0 + away * d0 + rest * (f0 - over * m0)
            v += sink * n1 + away * d1 + rest * (f1 - over * m1)
            w += sink * n2 + away * d2 + rest * (f2 - over * m2)
        out[i, 0] += u
        out[i, 1] += v
        out[i, 2] += w
