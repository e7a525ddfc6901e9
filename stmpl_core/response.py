"""Response: what a source at one vertex does at another, as tables over their distance and kernels that sum them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

import numba
import numpy as np
from scipy.special import j0, j1

from stmpl_core.tissue import Tissue

REACH = 8.0  # distance to which a vertex feels a load, over t; the linear response there is below 0.01 % of its peak
NEAR = 4.0  # distance to which moments are taken, over t
STEPS = 48  # rows of the response table a thickness
FINER = 2  # rows of the rings' table over those; the nearest is taken
SPREADS = np.geomspace(0.04, 1.6, 14)  # widths of a load of one vertex that the linear response is tabled for, over t
RINGS = np.array([0.0, 0.35, 0.7, 1.1, 1.6, 2.2, 2.9, 3.6])  # radii of the moments' rings, over t
WIDTHS = np.array([0.3, 0.3, 0.35, 0.45, 0.55, 0.65, 0.7, 0.6])  # widths of the rings, over t
SCALARS, VECTORS, TENSORS = 8, 6, 4  # rings of each order; vectors and tensors leave out the innermost
WIDTH = 32  # figures of one source field at one vertex, the last of them unused
SPREAD = 0.408  # deviation over the root of the vertex area of the Gaussian with the mean 1 / r of a linear hat


@lru_cache(maxsize=32)
def response_table(tissue: Tissue, thickness: float = 1.0) -> np.ndarray:
    """Response of a flat bonded layer to a unit normal force on its surface, E = 1, t = 1, (spread, radius, 2).

    Args:
        tissue: what the layer is made of.
        thickness: its thickness [m]; only a stack's response depends on it.

    The force is spread as a Gaussian of standard deviation SPREADS. Columns: sinking, and motion away from the force.
    With K = k t, a pressure cos(k x) sinks the surface by A cos(k x) and moves it along by B sin(k x):

        mu k A = (1 - nu) ((3 - 4 nu) sinh 2K - 2K) / D,    mu k B = (K^2 - (1 - 2 nu)(3 - 4 nu) sinh^2 K) / D
        D = (3 - 4 nu) cosh 2K + 2 K^2 + 5 - 12 nu + 8 nu^2

    (plane strain by an Airy function, as in Johnson, "Contact Mechanics", 1985, chapter 5; of a stack those of
    stmpl_core.stack), and a force spreads as Hankel transforms of order 0 and 1 of these. What the cut at REACH takes
    of the whole sinking of one material is given back near the force, so that a wide pressure sinks the layer by
    exactly p t / M.
    """
    radius = np.arange(int(REACH * STEPS) + 2) / STEPS
    table = np.empty((len(SPREADS), len(radius), 2))
    k = np.linspace(0, 6 / SPREADS[0], 4001)[1:]
    sink, along = of_one(tissue.poisson_ratio, k) if tissue.single else _of_stack(tissue, thickness, k)
    phase = np.outer(k, radius)
    weight = np.exp(-0.5 * (k * SPREADS[:, None]) ** 2) * k * (k[1] - k[0]) / (2 * np.pi)
    table[:, :, 0], table[:, :, 1] = (weight * sink) @ j0(phase), (weight * along) @ j1(phase)
    fade = np.clip((REACH - radius) / 1.5, 0, 1)
    table *= (fade * fade * (3 - 2 * fade))[:, None]
    if not tissue.single:
        return table.astype(np.float32)
    nu, ring = tissue.poisson_ratio, 2 * np.pi * radius / STEPS
    lost = (1 + nu) * (1 - 2 * nu) / (1 - nu) - table[:, :, 0] @ ring
    table[:, :, 0] += lost[:, None] * fade * np.exp(-radius) / ((fade * np.exp(-radius)) @ ring)
    return table.astype(np.float32)


def of_one(nu: float, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B of one material at wave numbers k [1/t], (K,) each [t/E]; see `response_table`."""
    mu = 1 / (2 * (1 + nu))
    e = np.exp(-2 * k)  # the transforms are divided by exp(2 K) / 2, so that nothing overflows
    scale = mu * k * ((3 - 4 * nu) * (1 + e * e) + 2 * e * (2 * k * k + 5 - 12 * nu + 8 * nu * nu))
    sink = (1 - nu) * ((3 - 4 * nu) * (1 - e * e) - 4 * k * e) / scale
    return sink, (2 * e * k * k - (1 - 2 * nu) * (3 - 4 * nu) * 0.5 * (1 - e) ** 2) / scale


def _of_stack(tissue: Tissue, thickness: float, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from stmpl_core.stack import compliance  # its fits load scipy's optimisers

    return compliance(tissue, thickness, k)


def ring_table() -> np.ndarray:
    """Weights of the rings of all orders over the radius, (radius, SCALARS + VECTORS + TENSORS)."""
    radius = np.arange(int(NEAR * STEPS * FINER) + 2) / (STEPS * FINER)
    rings = np.exp(-0.5 * ((radius[:, None] - RINGS) / WIDTHS) ** 2)
    fade = np.clip((NEAR - radius) / 0.8, 0, 1)
    rings *= (fade * fade * (3 - 2 * fade))[:, None]
    rings /= (2 * np.pi * radius[:, None] * rings).sum(axis=0) / (STEPS * FINER)
    start = np.minimum(radius / 0.35, 1.0)[:, None]  # directions are not defined at the middle
    return np.concatenate([rings, start * rings[:, 1 : 1 + VECTORS], start**2 * rings[:, 1 : 1 + TENSORS]],
                          axis=1).astype(np.float32)  # fmt: skip


FAST = {"contract", "reassoc", "nsz", "arcp"}
CHUNK = 64  # vertices that one thread takes at a time
_RINGS = np.zeros((int(NEAR * STEPS * FINER) + 2, 24), dtype=np.float32)  # constant to the compiler: nobody writes it
_RINGS[:, :SCALARS] = ring_table()[:, :SCALARS]
_RINGS[:, 8 : 8 + VECTORS] = ring_table()[:, SCALARS : SCALARS + VECTORS]
_RINGS[:, 16 : 16 + TENSORS] = ring_table()[:, SCALARS + VECTORS :]


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=FAST, error_model="numpy")
def feel(vertices, values, sources, sites, frames, sink, away, linear, moments, out):
    """See Surroundings.felt; values (S, K) and sources (10, K) are those of the loaded vertices, `out` (N, S, WIDTH).

    Linear and moments say what of it is wanted; the rest of `out` stays.

    Rows of sites and sources: x, y, z, t^-1/2, area, log(t) / 2, the same of the spread, normal. Loops over the
    sources have no branches, so that they run in vector registers.
    """
    (fields, many), down, along = values.shape, sink.ravel(), away.ravel()
    for chunk in numba.prange((len(vertices) + CHUNK - 1) // CHUNK):
        felt, cell = np.empty((7, many), dtype=np.float32), np.empty(many, dtype=np.uint32)
        sums = np.empty((fields, 5, 8), dtype=np.float32)
        for n in range(CHUNK * chunk, min(CHUNK * (chunk + 1), len(vertices))):
            _gather(vertices[n], sources, sites, frames, np.int32(sink.shape[1]), felt, cell)
            for s in range(0, fields if linear else 0, 2):
                _respond(values, s, min(s + 1, fields - 1), felt, cell, down, along, sink.shape[1], out[n])
            if moments:
                _take_moments(values, felt, sums, out[n])


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _gather(i, sources, sites, frames, width, felt, cell):
    """Where each source is for vertex i, to `felt`: distance in table rows, its direction, area, place in the tables.

    The area, over the local thickness squared, and the scale of the response are 0 of sources that are out of reach.
    """
    one, far = np.float32(1), np.float32(REACH * REACH)
    root, log_t, per_log = sites[3, i], sites[5, i], np.float32(1 / np.log(SPREADS[1] / SPREADS[0]))
    top = np.float32(len(SPREADS) - 1.001)
    px, py, pz = sites[0, i], sites[1, i], sites[2, i]
    a0, a1, a2 = frames[i, 0, 0], frames[i, 0, 1], frames[i, 0, 2]
    b0, b1, b2 = frames[i, 1, 0], frames[i, 1, 1], frames[i, 1, 2]
    c0, c1, c2 = frames[i, 2, 0], frames[i, 2, 1], frames[i, 2, 2]
    for q in range(sources.shape[1]):
        dx, dy, dz, inverse = sources[0, q] - px, sources[1, q] - py, sources[2, q] - pz, root * sources[3, q]
        facing = c0 * sources[7, q] + c1 * sources[8, q] + c2 * sources[9, q]
        square = (dx * dx + dy * dy + dz * dz) * inverse * inverse
        x, y = (a0 * dx + a1 * dy + a2 * dz) * inverse, (b0 * dx + b1 * dy + b2 * dz) * inverse
        flat = one / np.sqrt(x * x + y * y + np.float32(1e-12))
        area = sources[4, q] * inverse * inverse
        area = area if facing > 0 and square < far else np.float32(0)
        f = np.sqrt(min(square, far)) * np.float32(STEPS)
        h = min(max((sources[6, q] - log_t) * per_log, np.float32(0)), top)
        k, g = np.int32(f), np.int32(h)
        felt[0, q], felt[1, q], felt[2, q], felt[3, q] = f, x * flat, y * flat, area
        felt[4, q], felt[5, q], felt[6, q] = f - np.float32(k), h - np.float32(g), area * root / sources[3, q]
        cell[q] = g * width + k


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _respond(values, s, s2, felt, cell, down, along, width, out):
    """Writes the linear response to two source fields; it stores nothing on the way, so that it runs in registers."""
    one, following, below = np.float32(1), np.uint64(1), np.uint64(width)
    u = v = w = u2 = v2 = w2 = np.float32(0)
    for q in range(values.shape[1]):
        k, rest, h = np.uint64(cell[q]), felt[4, q], felt[5, q]
        p2, p3 = h * (one - rest), h * rest
        p0, p1 = one - rest - p2, rest - p3
        low, high = p0 * down[k] + p1 * down[k + following], p2 * down[k + below] + p3 * down[k + below + following]
        near, far = p0 * along[k] + p1 * along[k + following], p2 * along[k + below] + p3 * along[k + below + following]
        sinks, goes = felt[6, q] * (low + high), felt[6, q] * (near + far)
        x, y, value, value2 = goes * felt[1, q], goes * felt[2, q], values[s, q], values[s2, q]
        u, v, w = u - value * x, v - value * y, w - value * sinks
        u2, v2, w2 = u2 - value2 * x, v2 - value2 * y, w2 - value2 * sinks
    out[s, 0], out[s, 1], out[s, 2] = u, v, w
    out[s2, 0], out[s2, 1], out[s2, 2] = u2, v2, w2


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _take_moments(values, felt, sums, out):
    """Sums over the near sources of rings times 1, cos a, sin a, cos 2a, sin 2a; loops of eight fill one register."""
    end = np.float32(NEAR * STEPS)
    sums[:] = 0
    for q in range(values.shape[1]):
        if felt[0, q] >= end or felt[3, q] == 0:
            continue
        k, c, d = int(felt[0, q] * np.float32(FINER) + np.float32(0.5)), felt[1, q], felt[2, q]
        c2, d2 = c * c - d * d, (c + c) * d
        for s in range(len(out)):
            v = values[s, q] * felt[3, q]
            for m in range(8):
                sums[s, 0, m] += v * _RINGS[k, m]
            x, y = v * c, v * d
            for m in range(8):
                sums[s, 1, m] += x * _RINGS[k, 8 + m]
            for m in range(8):
                sums[s, 2, m] += y * _RINGS[k, 8 + m]
            x, y = v * c2, v * d2
            for m in range(8):
                sums[s, 3, m] += x * _RINGS[k, 16 + m]
            for m in range(8):
                sums[s, 4, m] += y * _RINGS[k, 16 + m]
    for s in range(len(out)):
        for m in range(SCALARS):
            out[s, 3 + m] = sums[s, 0, m]
        for m in range(VECTORS):
            out[s, 3 + SCALARS + m] = sums[s, 1, m]
            out[s, 3 + SCALARS + VECTORS + m] = sums[s, 2, m]
        for m in range(TENSORS):
            out[s, 3 + SCALARS + 2 * VECTORS + m] = sums[s, 3, m]
            out[s, 3 + SCALARS + 2 * VECTORS + TENSORS + m] = sums[s, 4, m]


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _places(i, sources, sites, frames, width, felt, cell):
    """Where each source is for vertex i in the table of sinking, and its scale, to `felt`; as _gather."""
    far = np.float32(REACH * REACH)
    root, log_t, per_log = sites[3, i], sites[5, i], np.float32(1 / np.log(SPREADS[1] / SPREADS[0]))
    top = np.float32(len(SPREADS) - 1.001)
    px, py, pz = sites[0, i], sites[1, i], sites[2, i]
    c0, c1, c2 = frames[i, 2, 0], frames[i, 2, 1], frames[i, 2, 2]
    for q in range(sources.shape[1]):
        dx, dy, dz, inverse = sources[0, q] - px, sources[1, q] - py, sources[2, q] - pz, root * sources[3, q]
        facing = c0 * sources[7, q] + c1 * sources[8, q] + c2 * sources[9, q]
        square = (dx * dx + dy * dy + dz * dz) * inverse * inverse
        scale = sources[4, q] * inverse * root * root
        f = np.sqrt(min(square, far)) * np.float32(STEPS)
        h = min(max((sources[6, q] - log_t) * per_log, np.float32(0)), top)
        k, g = np.int32(f), np.int32(h)
        felt[0, q] = scale if facing > 0 and square < far else np.float32(0)
        felt[1, q], felt[2, q], cell[q] = f - np.float32(k), h - np.float32(g), g * width + k


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _sinks(felt, cell, q, down, width):
    """How far a vertex sinks under a unit of source q, in thicknesses."""
    one, following, below = np.float32(1), np.uint64(1), np.uint64(width)
    k, rest, h = np.uint64(cell[q]), felt[1, q], felt[2, q]
    low = (one - rest) * down[k] + rest * down[k + following]
    high = (one - rest) * down[k + below] + rest * down[k + below + following]
    return felt[0, q] * ((one - h) * low + h * high)


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def sink_between(vertices, sources, sites, frames, sink, out):
    """See Surroundings.sinking."""
    felt, cell = np.empty((3, len(vertices)), np.float32), np.empty(len(vertices), np.uint32)
    down, width = sink.ravel(), sink.shape[1]
    for n in range(len(vertices)):
        _places(vertices[n], sources, sites, frames, np.int32(width), felt, cell)
        for q in range(len(vertices)):
            out[n, q] = _sinks(felt, cell, q, down, width)


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def spread_sinking(vertices, values, sources, sites, frames, sink, out):
    """See Surroundings.spread; values (3, N), out (M, 3)."""
    many = values.shape[1]
    felt, cell = np.empty((3, many), np.float32), np.empty(many, np.uint32)
    down, width = sink.ravel(), sink.shape[1]
    for n in range(len(vertices)):
        _places(vertices[n], sources, sites, frames, np.int32(width), felt, cell)
        u = v = w = np.float32(0)
        for q in range(many):  # it stores nothing, so that it runs in vector registers
            sinks = _sinks(felt, cell, q, down, width)
            u += values[0, q] * sinks
            v += values[1, q] * sinks
            w += values[2, q] * sinks
        out[n, 0], out[n, 1], out[n, 2] = u, v, w


@contextmanager
def packed() -> Iterator[None]:
    """While a kernel compiles: lets LLVM pack short loops into vector registers, which numba leaves off."""
    before = numba.config.SLP_VECTORIZE  # type: ignore[attr-defined]
    numba.config.SLP_VECTORIZE = 1  # type: ignore[attr-defined]
    try:
        yield
    finally:
        numba.config.SLP_VECTORIZE = before  # type: ignore[attr-defined]
