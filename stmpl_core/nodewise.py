"""Nodewise: what forces at contact nodes do to each other and to the skin, on one material, in single precision.

The same sums as in stmpl_core.green, without a coarse part and without places that are softer. With n and s the inward
normals of a point and of a source, m = n + s, d the direction from source to point across m, and g the responses of the
flat layer, a force f moves the point by

    n (g0 f.s - g1 f.d) + d (g1 f.s + along f.d) + (even - along / 2) (f - m f.m / m.m)

Loops over the sources have no branches, so that they run in vector registers; nodes are filled up with some that weigh
nothing, for what is left over runs alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from stmpl_core.response import FAST, SPREAD

SPREADS = np.geomspace(0.004, 1.6, 16)  # widths of a node's force that are tabled, over t
FIRST_LOG, STEP_LOG = float(np.log(SPREADS[0])), float(np.log(SPREADS[1] / SPREADS[0]))
REACH = 8.0  # distance beyond which the flat response is not felt, over t
FINER = 48  # rows of the tables between two spreads
LEAST, PARTS, DOUBLINGS = -20, 8, 26  # columns: squared distance from 2^LEAST on, PARTS to each of its DOUBLINGS
LANES = 16  # nodes are filled up to a multiple of these
TILE = 9 * LANES  # numbers of so many nodes
SETTLED, MOST_STEPS = 1e-5, 60  # motion that stuck nodes may miss, over theirs, and steps within which it is found
NEXT = np.uint64(1)  # no index that may count from the end
ZERO, HALF, ONE, TINY, SAME = (np.float32(x) for x in (0, 0.5, 1, 1e-12, 1e-6))
NEAREST, FARTHEST = np.float32(2.0**LEAST), np.float32(0.9999 * REACH**2)
END = np.float32((0.98 * REACH) ** 2)
PER_AROUND = np.float32(2)  # over the cosine between two normals: from 1 on two places feel all of each other
WIDE = np.float32(2 / np.pi * SPREAD**2)  # square of the distance at which 1 / r ends, over a node's area
MANTISSA = 23 - int(np.log2(PARTS))  # bits of a squared distance below its column's
BELOW, PER_BELOW = np.int32((1 << MANTISSA) - 1), np.float32(2.0**-MANTISSA)
FIRST_COLUMN = np.int32((127 + LEAST) * PARTS)  # of what its other bits say, 127 being the exponent of 1
PER_ROW = np.float32(FINER * 0.5 * np.log(2) / STEP_LOG)  # rows from a node's area to twice of it
FIRST_ROW = np.float32(FINER * (np.log(SPREAD) - FIRST_LOG) / STEP_LOG)  # row of an area of 1 t^2
LAST_ROW = np.float32(FINER * (len(SPREADS) - 1) - 1)
LOG_A, LOG_B = np.float32(0.42086), np.float32(0.15639)  # log2(1 + m) = m + m (1 - m) (A - B m), to 0.001


class Packed(NamedTuple):
    """Responses of a flat layer of one material, as the kernels read them: four numbers of 16 bits at a time.

    Args:
        rows: g0, g1, even - along / 2 and along over `scales`, from the highest bits down, (spread, squared distance).
        scales: what one step of each is worth, (4,) float32.
    """

    rows: np.ndarray
    scales: np.ndarray

    @classmethod
    def of(cls, tables: np.ndarray, rows: float) -> Packed:
        """From tables (4, spread, root of the distance), with so many rows of the root to one."""
        place = (np.arange(FINER * (len(SPREADS) - 1)) + 0.5) / FINER
        low, share = place.astype(int), (place % 1)[:, None]
        column = np.arange(PARTS * DOUBLINGS + 1)
        square = 2.0 ** (LEAST + column // PARTS) * (1 + column % PARTS / PARTS)
        f = np.minimum(rows * square**0.25, tables.shape[2] - 1.001)
        k = f.astype(int)
        fine = tables[:, :, k] + (f - k) * (tables[:, :, k + 1] - tables[:, :, k])
        g0, g1, even, along = fine[:, low] + share * (fine[:, low + 1] - fine[:, low])
        values = np.array([g0, g1, even - 0.5 * along, along])
        scales = np.abs(values).max(axis=(1, 2)) / 32767
        bits = np.rint(values / scales[:, None, None]).astype(np.int64) & 0xFFFF
        return cls(bits[0] << 48 | bits[1] << 32 | bits[2] << 16 | bits[3], scales.astype(np.float32))


def _as_bits(_: Any, number: Any) -> Any:
    """The bits of a float32 as an int32, in a register; numpy's `view` goes through memory."""
    return types.int32(number), lambda context, builder, sig, args: builder.bitcast(args[0], ir.IntType(32))


_bits: Any = intrinsic(_as_bits)


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _row(area):
    """Row of a node's area over t^2."""
    bits = _bits(area)
    m = np.float32(np.int32(bits & np.int32(0x7FFFFF))) * np.float32(2.0**-23)
    log2 = np.float32(np.int32(bits >> np.int32(23))) - np.float32(127) + m + m * (ONE - m) * (LOG_A - LOG_B * m)
    return np.int32(min(max(PER_ROW * log2 + FIRST_ROW, ZERO), LAST_ROW))


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _column(square):
    """Squared distance over t^2 that is felt, its column, and what is left, in columns."""
    near = min(max(square, NEAREST), FARTHEST)
    bits = _bits(near)
    column = np.int32(bits >> np.int32(MANTISSA)) - FIRST_COLUMN
    return near, column, np.float32(np.int32(bits & BELOW)) * PER_BELOW


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _read(near, f, one, other, cosine, width, per_t, scales):
    """What a point feels of a force: g0, g1, even - along / 2 and along [1/m]. No arrays, or loops run alone.

    Args:
        near, f: see `_column`.
        one, other: numbers of its column and the next one, in the node's row.
        cosine: between the normals.
        width: WIDE times the node's area over t^2.
        per_t: 1 / t [1/m].
        scales: four of them, see Packed.
    """
    facing = min(max(PER_AROUND * cosine, ZERO), ONE)
    per = facing * facing * (np.float32(3) - facing - facing) * per_t / np.sqrt(near + width)
    per = per if near < END else ZERO
    a, b = np.float32(np.int16(one >> 48)), np.float32(np.int16(other >> 48))
    g0 = per * scales[0] * (a + f * (b - a))
    a, b = np.float32(np.int16(one >> 32)), np.float32(np.int16(other >> 32))
    g1 = per * scales[1] * (a + f * (b - a))
    a, b = np.float32(np.int16(one >> 16)), np.float32(np.int16(other >> 16))
    rest = per * scales[2] * (a + f * (b - a))
    a, b = np.float32(np.int16(one)), np.float32(np.int16(other))
    return g0, g1, rest, per * scales[3] * (a + f * (b - a))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def by_node(points, inward, thickness, area, origin):
    """Nodes as the kernels take them: place, inward normal, 1 / sqrt(t), area, filled up to LANES, (8, M) float32."""
    count = len(area)
    out = np.zeros((8, LANES * ((count + LANES - 1) // LANES)), np.float32)
    for n in range(out.shape[1]):
        m = min(n, count - 1)
        for x in range(3):
            out[x, n], out[3 + x, n] = points[m, x] - origin[x], inward[m, x]
        out[6, n], out[7, n] = 1 / np.sqrt(thickness[m]), area[m]
    return out


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def blocks(by, group, flat, scales):
    """Motion of each node under a force E at each, (N, 9, M) float32 [1/m]: by node, direction, node.

    In tiles, whose numbers lie at known places from each other, and with `flat` read apart: so that the compiler sees
    that what is written is not what is read, and uses vector registers.

    Args:
        by: nodes in T tiles, see `by_node`.
        group: numbers of groups of nodes that do not feel each other, (N,).
        flat, scales: those of Packed, the rows one after the other.
    """
    count, tiles, wide = len(group), by.shape[1] // LANES, PARTS * DOUBLINGS + 1
    c = scales[0], scales[1], scales[2], scales[3]
    every, out, o = _tiled(by, group), np.empty((count, 9, by.shape[1]), np.float32), np.empty(TILE, np.float32)
    left, place, read = np.empty(2 * LANES, np.float32), np.empty(LANES, np.int64), np.empty(2 * LANES, np.int64)
    for k in range(count * tiles):
        i, tile = k // tiles, k % tiles
        p0, p1, p2, n0, n1, n2 = by[0, i], by[1, i], by[2, i], by[3, i], by[4, i], by[5, i]
        root, area, own = by[6, i], by[7, i], np.float32(group[i])
        t = every[tile * TILE : (tile + 1) * TILE]
        for j in range(LANES):
            d0, d1, d2, per_t = p0 - t[j], p1 - t[LANES + j], p2 - t[2 * LANES + j], root * t[6 * LANES + j]
            left[j], column, left[LANES + j] = _column((d0 * d0 + d1 * d1 + d2 * d2) * per_t * per_t)
            place[j] = wide * _row(HALF * (area + t[7 * LANES + j]) * per_t * per_t) + column
        for j in range(LANES):
            at = np.uint64(place[j])
            read[j], read[LANES + j] = flat[at], flat[at + NEXT]
        for j in range(LANES):
            d0, d1, d2, per_t = p0 - t[j], p1 - t[LANES + j], p2 - t[2 * LANES + j], root * t[6 * LANES + j]
            s0, s1, s2 = t[3 * LANES + j], t[4 * LANES + j], t[5 * LANES + j]
            width = HALF * (area + t[7 * LANES + j]) * per_t * per_t * WIDE
            per_t = per_t if t[8 * LANES + j] == own else ZERO
            g0, g1, rest, along = _read(left[j], left[LANES + j], read[j], read[LANES + j],
                                        n0 * s0 + n1 * s1 + n2 * s2, width, per_t, c)  # fmt: skip
            m0, m1, m2 = n0 + s0, n1 + s1, n2 + s2
            per = ONE / max(m0 * m0 + m1 * m1 + m2 * m2, TINY)
            up = (d0 * m0 + d1 * m1 + d2 * m2) * per
            d0, d1, d2, per = d0 - up * m0, d1 - up * m1, d2 - up * m2, rest * per
            square = d0 * d0 + d1 * d1 + d2 * d2
            length = ONE / np.sqrt(max(square, TINY * TINY))
            length = length if square > TINY * TINY else ZERO
            d0, d1, d2 = d0 * length, d1 * length, d2 * length
            a0, a1, a2 = g0 * s0 - g1 * d0, g0 * s1 - g1 * d1, g0 * s2 - g1 * d2
            b0, b1, b2 = g1 * s0 + along * d0, g1 * s1 + along * d1, g1 * s2 + along * d2
            o[j] = n0 * a0 + d0 * b0 + rest - per * m0 * m0
            o[LANES + j] = n0 * a1 + d0 * b1 - per * m0 * m1
            o[2 * LANES + j] = n0 * a2 + d0 * b2 - per * m0 * m2
            o[3 * LANES + j] = n1 * a0 + d1 * b0 - per * m1 * m0
            o[4 * LANES + j] = n1 * a1 + d1 * b1 + rest - per * m1 * m1
            o[5 * LANES + j] = n1 * a2 + d1 * b2 - per * m1 * m2
            o[6 * LANES + j] = n2 * a0 + d2 * b0 - per * m2 * m0
            o[7 * LANES + j] = n2 * a1 + d2 * b1 - per * m2 * m1
            o[8 * LANES + j] = n2 * a2 + d2 * b2 + rest - per * m2 * m2
        for x in range(9):
            row = out[i, x, tile * LANES : (tile + 1) * LANES]
            for j in range(LANES):
                row[j] = o[x * LANES + j]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _tiled(by, group):
    """Nodes (8, M) and their groups in tiles, (T TILE,): what fills them up is of no group."""
    tiles = by.shape[1] // LANES
    out = np.empty(tiles * TILE, np.float32)
    for k in range(tiles):
        for j in range(LANES):
            n = k * LANES + j
            for c in range(8):
                out[k * TILE + c * LANES + j] = by[c, n]
            out[k * TILE + 8 * LANES + j] = group[n] if n < len(group) else -1
    return out


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def approached(held, gone, guess):
    """Forces (N, 3) float32 under which nodes go where they have gone, (N, 3), by conjugate gradients from a guess.

    The condition of `blocks` is about 15: fourteen steps take a motion to 1e-5 of its peak.
    """
    count, many = held.shape[0], held.shape[2]
    out, left, per = np.zeros((3, many), np.float32), np.zeros((3, many), np.float32), np.zeros((3, many), np.float32)
    way, image = np.empty((3, many), np.float32), np.zeros((3, many), np.float32)
    for n in range(count):
        for x in range(3):
            out[x, n], left[x, n], per[x, n] = guess[n, x], gone[n, x], ONE / held[n, 4 * x, n]
    _multiply(held, out, image)
    size, whole = ZERO, ZERO
    for x in range(3):
        for n in range(many):
            whole += left[x, n] * per[x, n] * left[x, n]
            left[x, n] -= image[x, n]
            way[x, n] = per[x, n] * left[x, n]
            size += left[x, n] * way[x, n]
    enough = np.float32(SETTLED**2) * (whole if whole > ZERO else size)  # nodes may have gone nowhere at all
    for _ in range(MOST_STEPS):
        if size <= enough:
            break
        _multiply(held, way, image)
        along, now = ZERO, ZERO
        for x in range(3):
            for n in range(many):
                along += way[x, n] * image[x, n]
        share = size / along
        for x in range(3):
            for n in range(many):
                out[x, n] += share * way[x, n]
                left[x, n] -= share * image[x, n]
                now += left[x, n] * per[x, n] * left[x, n]
        for x in range(3):
            for n in range(many):
                way[x, n] = per[x, n] * left[x, n] + now / size * way[x, n]
        size = now
    return out[:, :count].T.copy()


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _multiply(held, vector, out):
    """out (3, M) = `blocks` times vector (3, M): BLAS would sum in another order on more threads."""
    for n in range(held.shape[0]):
        a, b, c = ZERO, ZERO, ZERO
        for m in range(held.shape[2]):
            x, y, z = vector[0, m], vector[1, m], vector[2, m]
            a += held[n, 0, m] * x + held[n, 1, m] * y + held[n, 2, m] * z
            b += held[n, 3, m] * x + held[n, 4, m] * y + held[n, 5, m] * z
            c += held[n, 6, m] * x + held[n, 7, m] * y + held[n, 8, m] * z
        out[0, n], out[1, n], out[2, n] = a, b, c


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_motion(out, there, points, inward, roots, by, forces, flat, scales):
    """Adds to rows `there` of out (M, 3) float32 [m] the motion of points under forces over E at nodes (N, 3) [m2].

    Args:
        out: motion of the points.
        there: numbers of the points that feel the nodes.
        points, inward, roots: points, unit vectors into the skin, (M, 3) float32, 1 / sqrt(t) there, (M,).
        by: nodes, see `by_node`.
        forces: forces (N, 3).
        flat, scales: see `blocks`.
    """
    count, wide = by.shape[1], PARTS * DOUBLINGS + 1
    first, width, f = np.empty(count, np.int32), np.empty(count, np.float32), np.zeros((3, count), np.float32)
    c = scales[0], scales[1], scales[2], scales[3]
    for j in range(count):
        over = by[7, j] * by[6, j] ** 4
        first[j], width[j] = wide * _row(np.float32(over)), over * WIDE
    for j in range(len(forces)):
        for x in range(3):
            f[x, j] = forces[j, x]
    for n in range(len(there)):
        i = there[n]
        p0, p1, p2, n0, n1, n2 = points[i, 0], points[i, 1], points[i, 2], inward[i, 0], inward[i, 1], inward[i, 2]
        root, u, v, w, down_n = roots[i], ZERO, ZERO, ZERO, ZERO
        for j in range(count):
            d0, d1, d2, s0, s1, s2 = p0 - by[0, j], p1 - by[1, j], p2 - by[2, j], by[3, j], by[4, j], by[5, j]
            f0, f1, f2, per_t = f[0, j], f[1, j], f[2, j], root * by[6, j]
            far, cosine = d0 * d0 + d1 * d1 + d2 * d2, n0 * s0 + n1 * s1 + n2 * s2
            near, column, part = _column(far * per_t * per_t)
            at = np.uint64(first[j] + column)
            g0, g1, rest, along = _read(near, part, flat[at], flat[at + NEXT], cosine, width[j], per_t, c)
            # The direction across m, and the force along m, in dot products.
            down, across = f0 * s0 + f1 * s1 + f2 * s2, f0 * d0 + f1 * d1 + f2 * d2
            over, up = f0 * n0 + f1 * n1 + f2 * n2 + down, d0 * n0 + d1 * n1 + d2 * n2 + (d0 * s0 + d1 * s1 + d2 * s2)
            per = HALF / max(ONE + cosine, TINY)
            beside = far - up * up * per
            length = ONE / np.sqrt(max(beside, TINY * TINY))
            length = length if beside > SAME * far else ZERO
            radial = (across - up * per * over) * length
            away = (g1 * down + along * radial) * length
            both = (away * up + rest * over) * per
            down_n += g0 * down - g1 * radial - both
            u += away * d0 + rest * f0 - both * s0
            v += away * d1 + rest * f1 - both * s1
            w += away * d2 + rest * f2 - both * s2
        out[i, 0] += u + down_n * n0
        out[i, 1] += v + down_n * n1
        out[i, 2] += w + down_n * n2
