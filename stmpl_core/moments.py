"""Surroundings: what presses around each vertex of a layer, as the linear response to it and as its moments."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy.special import j0, j1

from stmpl_core.layer import SoftLayer

REACH = 6.0  # thicknesses to which a vertex feels a load; the linear response there is below 0.05 % of its peak
NEAR = 4.0  # thicknesses to which moments are taken
STEPS = 48  # table rows a thickness
SPREADS = np.geomspace(0.04, 1.6, 14)  # widths of a load of one vertex that the linear response is tabled for, over t
LEVELS_PER_LOG = 1 / np.log(SPREADS[1] / SPREADS[0])
RINGS = np.array([0.0, 0.35, 0.7, 1.1, 1.6, 2.2, 2.9, 3.6])  # radii of the moments' rings, over t
WIDTHS = np.array([0.3, 0.3, 0.35, 0.45, 0.55, 0.65, 0.7, 0.6])  # of the rings
SCALARS, VECTORS, TENSORS = 8, 6, 4  # rings of each order; vectors and tensors leave out the innermost
WIDTH = 32  # figures of one source field at one vertex, the last of them unused
SPREAD = 0.408  # of the Gaussian with the mean 1 / r of a linear hat: its deviation over the root of the vertex area


class Felt(NamedTuple):
    """What N vertices feel of S source fields, in lengths of the local thickness and in the vertex's own frame.

    Args:
        vertices: numbers of the vertices that feel anything, (N,).
        figures: (N, S, WIDTH) float32; the properties name its parts, and directions come last in each.
    """

    vertices: np.ndarray
    figures: np.ndarray

    @property
    def linear(self) -> np.ndarray:
        """Linear response along both tangents and the normal, (N, S, 3) [-]."""
        return self.figures[:, :, :3]

    @property
    def scalars(self) -> np.ndarray:
        """Moments of order 0, (N, S, SCALARS) [-]."""
        return self.figures[:, :, 3 : 3 + SCALARS]

    @property
    def vectors(self) -> np.ndarray:
        """Moments of order 1 along both tangents, (N, S, 2, VECTORS) [-]."""
        first = 3 + SCALARS
        return self.figures[:, :, first : first + 2 * VECTORS].reshape(*self.figures.shape[:2], 2, VECTORS)

    @property
    def tensors(self) -> np.ndarray:
        """Traceless moments of order 2, of cos 2a and of sin 2a, (N, S, 2, TENSORS) [-]."""
        first = 3 + SCALARS + 2 * VECTORS
        return self.figures[:, :, first : first + 2 * TENSORS].reshape(*self.figures.shape[:2], 2, TENSORS)


class Surroundings:
    """A layer's vertices with their frames and their neighbours: made once, then asked for every load.

    Args:
        layer: the soft layer at rest.

    Attributes:
        frames: tangent, tangent, outward normal of each vertex, (V, 3, 3) [-].
        curvature: thickness times the skin's curvature in the tangents, xx, xy, yy, (V, 3) [-]; convex is positive.
        slope: gradient of the thickness along the tangents, (V, 2) [-].
    """

    def __init__(self, layer: SoftLayer) -> None:
        self.layer = layer
        self.frames = _frames(layer.normals)
        points = np.ascontiguousarray(layer.vertices)
        self.start, self.index = _neighbours(points, layer.normals, layer.thickness, REACH)
        self._frames = self.frames.astype(np.float32)
        level = np.log(SPREAD * layer.vertex_areas**0.5 / SPREADS[0]), 0.5 * np.log(layer.thickness)
        rows = [*(points - points.mean(axis=0)).T, layer.thickness**-0.5, layer.vertex_areas, level[0], level[1]]
        self._sites = np.stack([*rows, np.zeros(len(points))], axis=1).astype(np.float32)
        shape = _shape(self.start, self.index, points, self.frames, layer.thickness)
        self.curvature, self.slope = shape[:, :3], shape[:, 3:]
        self._response = response_table(layer.tissue.poisson_ratio)
        self._rings = ring_table()

    def felt(self, sources: np.ndarray) -> Felt:
        """What the vertices feel of source fields (V, S) [-], in units of Young's modulus."""
        values = np.ascontiguousarray(sources, dtype=np.float32)
        loaded = np.flatnonzero(values.any(axis=1)).astype(np.int32)
        vertices, slots = _reached(self.start, self.index, loaded, len(values))
        figures = np.zeros((len(vertices), values.shape[1], WIDTH), dtype=np.float32)
        _feel(vertices, self.start, self.index, slots, values[loaded], self._sites[loaded], self._sites, self._frames,
              self._response, self._rings, figures)  # fmt: skip
        return Felt(vertices, figures)

    def linear(self, source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The linear response alone to one field (V,) [-]: the vertices that feel it (N,), and (N, 3) as in Felt."""
        values = np.ascontiguousarray(source, dtype=np.float32)
        loaded = np.flatnonzero(values).astype(np.int32)
        vertices, slots = _reached(self.start, self.index, loaded, len(values))
        out = np.empty((len(vertices), 3), dtype=np.float32)
        _respond(vertices, self.start, self.index, slots, values[loaded], self._sites[loaded], self._sites,
                 self._frames, self._response, out)  # fmt: skip
        return vertices, out


def response_table(poisson_ratio: float) -> np.ndarray:
    """Response of a flat bonded layer to a unit normal force on its surface, E = 1, t = 1, (spread, radius, 2).

    The force is spread as a Gaussian of standard deviation SPREADS. Columns: sinking, and motion away from the force.
    With K = k t, a pressure cos(k x) sinks the surface by A cos(k x) and moves it along by B sin(k x):

        mu k A = (1 - nu) ((3 - 4 nu) sinh 2K - 2K) / D,    mu k B = (K^2 - (1 - 2 nu)(3 - 4 nu) sinh^2 K) / D
        D = (3 - 4 nu) cosh 2K + 2 K^2 + 5 - 12 nu + 8 nu^2

    (plane strain by an Airy function, as in Johnson, "Contact Mechanics", 1985, chapter 5), and a force spreads as
    Hankel transforms of order 0 and 1 of these. What the cut at REACH takes of the whole sinking is given back near
    the force, so that a wide pressure sinks the layer by exactly p t / M.
    """
    nu, mu = poisson_ratio, 1 / (2 * (1 + poisson_ratio))
    radius = np.arange(int(REACH * STEPS) + 2) / STEPS
    table = np.empty((len(SPREADS), len(radius), 2))
    k = np.linspace(0, 6 / SPREADS[0], 4001)[1:]
    e = np.exp(-2 * k)  # the transforms are divided by exp(2 K) / 2, so that nothing overflows
    scale = mu * k * ((3 - 4 * nu) * (1 + e * e) + 2 * e * (2 * k * k + 5 - 12 * nu + 8 * nu * nu))
    sink = (1 - nu) * ((3 - 4 * nu) * (1 - e * e) - 4 * k * e) / scale
    along = (2 * e * k * k - (1 - 2 * nu) * (3 - 4 * nu) * 0.5 * (1 - e) ** 2) / scale
    phase = np.outer(k, radius)
    weight = np.exp(-0.5 * (k * SPREADS[:, None]) ** 2) * k * (k[1] - k[0]) / (2 * np.pi)
    table[:, :, 0], table[:, :, 1] = (weight * sink) @ j0(phase), (weight * along) @ j1(phase)
    fade = np.clip(REACH - radius, 0, 1)
    table *= (fade * fade * (3 - 2 * fade))[:, None]
    ring = 2 * np.pi * radius / STEPS
    lost = (1 + nu) * (1 - 2 * nu) / (1 - nu) - table[:, :, 0] @ ring
    table[:, :, 0] += lost[:, None] * fade * np.exp(-radius) / ((fade * np.exp(-radius)) @ ring)
    return table.astype(np.float32)


def ring_table() -> np.ndarray:
    """Weights of the rings of all orders over the radius, (radius, SCALARS + VECTORS + TENSORS)."""
    radius = np.arange(int(NEAR * STEPS) + 2) / STEPS
    rings = np.exp(-0.5 * ((radius[:, None] - RINGS) / WIDTHS) ** 2)
    fade = np.clip((NEAR - radius) / 0.8, 0, 1)
    rings *= (fade * fade * (3 - 2 * fade))[:, None]
    rings /= (2 * np.pi * radius[:, None] * rings).sum(axis=0) / STEPS
    start = np.minimum(radius / 0.35, 1.0)[:, None]  # directions are not defined at the middle
    return np.concatenate([rings, start * rings[:, 1 : 1 + VECTORS], start**2 * rings[:, 1 : 1 + TENSORS]],
                          axis=1).astype(np.float32)  # fmt: skip


def _frames(normals: np.ndarray) -> np.ndarray:
    """Any two tangents with each normal, right-handed, as rows, (V, 3, 3)."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=1)


def _neighbours(points: np.ndarray, normals: np.ndarray, thickness: np.ndarray, reach: float) -> tuple:
    """Pairs within `reach` thicknesses (the geometric mean of both) with normals less than 90 degrees apart.

    Returns:
        start (V + 1,), index: the neighbours of vertex v, itself among them, are index[start[v] : start[v + 1]].
    """
    cell = reach * float(thickness.max())
    low = points.min(axis=0)
    place = ((points - low) / cell).astype(np.int64)
    shape = place.max(axis=0) + 1
    key = (place[:, 0] * shape[1] + place[:, 1]) * shape[2] + place[:, 2]
    order = np.argsort(key, kind="stable")
    first = np.searchsorted(key[order], np.arange(shape.prod() + 1))
    count = np.zeros(len(points) + 1, dtype=np.int64)
    empty = np.empty(0, dtype=np.int32)
    _pairs(points, normals, thickness, reach, place, shape, order, first, count, empty)
    start = np.cumsum(count)
    index = np.empty(start[-1], dtype=np.int32)
    _pairs(points, normals, thickness, reach, place, shape, order, first, start, index)
    return start, index


@numba.njit(cache=True, parallel=True)
def _pairs(points, normals, thickness, reach, place, shape, order, first, start, index):
    """Counts the neighbours of vertex i into start[i + 1], or where `index` has room writes them from start[i] on."""
    for i in numba.prange(len(points)):
        n = 0
        for a in range(max(place[i, 0] - 1, 0), min(place[i, 0] + 2, shape[0])):
            for b in range(max(place[i, 1] - 1, 0), min(place[i, 1] + 2, shape[1])):
                for c in range(max(place[i, 2] - 1, 0), min(place[i, 2] + 2, shape[2])):
                    k = (a * shape[1] + b) * shape[2] + c
                    for m in range(first[k], first[k + 1]):
                        j = order[m]
                        away = 0.0
                        facing = 0.0
                        for x in range(3):
                            away += (points[i, x] - points[j, x]) ** 2
                            facing += normals[i, x] * normals[j, x]
                        if facing > 0 and away < reach * reach * thickness[i] * thickness[j]:
                            if len(index):
                                index[start[i] + n] = j
                            n += 1
        if not len(index):
            start[i + 1] = n


@numba.njit(cache=True, parallel=True)
def _shape(start, index, points, frames, thickness):
    """Least-squares curvature (from the normals) and slope of the thickness, over a Gaussian of one thickness."""
    out = np.zeros((len(points), 5))
    for i in numba.prange(len(points)):
        xx = xy = yy = 1e-12
        s = np.zeros(6)
        for p in range(start[i], start[i + 1]):
            j = index[p]
            d = (points[j] - points[i]) / thickness[i]
            r2 = (d * d).sum()
            if r2 > 9.0:
                continue
            w = np.exp(-0.5 * r2)
            x, y = (frames[i, 0] * d).sum(), (frames[i, 1] * d).sum()
            u, v = (frames[i, 0] * frames[j, 2]).sum(), (frames[i, 1] * frames[j, 2]).sum()
            h = thickness[j] / thickness[i] - 1
            xx += w * x * x
            xy += w * x * y
            yy += w * y * y
            s[0] += w * x * u
            s[1] += w * y * u
            s[2] += w * x * v
            s[3] += w * y * v
            s[4] += w * x * h
            s[5] += w * y * h
        det = xx * yy - xy * xy + 1e-9
        a, b = (yy * s[0] - xy * s[1]) / det, (xx * s[1] - xy * s[0]) / det
        c, e = (yy * s[2] - xy * s[3]) / det, (xx * s[3] - xy * s[2]) / det
        out[i, 0], out[i, 1], out[i, 2] = a, 0.5 * (b + c), e
        out[i, 3], out[i, 4] = (yy * s[4] - xy * s[5]) / det, (xx * s[5] - xy * s[4]) / det
    return out


@numba.njit(cache=True)
def _reached(start, index, loaded, count):
    """Vertices with a loaded neighbour, in order; and of each vertex its place among the loaded, or -1."""
    mark = np.zeros(count, dtype=np.bool_)
    slots = np.full(count, -1, dtype=np.int32)
    for k in range(len(loaded)):
        slots[loaded[k]] = k
        for p in range(start[loaded[k]], start[loaded[k] + 1]):
            mark[index[p]] = True
    return np.flatnonzero(mark).astype(np.int32), slots


FAST = {"contract", "reassoc", "nsz", "arcp"}


@numba.njit(inline="always", fastmath=FAST)
def _pair(site, frame, source):
    """Distance and direction of a source in a vertex's tangents, over their thickness; its area; how to scale it."""
    inverse = site[3] * source[3]
    dx, dy, dz = source[0] - site[0], source[1] - site[1], source[2] - site[2]
    x = (frame[0, 0] * dx + frame[0, 1] * dy + frame[0, 2] * dz) * inverse
    y = (frame[1, 0] * dx + frame[1, 1] * dy + frame[1, 2] * dz) * inverse
    z = (frame[2, 0] * dx + frame[2, 1] * dy + frame[2, 2] * dz) * inverse
    flat = x * x + y * y
    r = np.sqrt(flat + z * z)
    flat = np.float32(1) / np.sqrt(flat) if flat > np.float32(0) else np.float32(0)
    cell = source[4] * inverse * inverse
    return r, x * flat, y * flat, cell, cell * site[3] / source[3]


@numba.njit(inline="always", fastmath=FAST)
def _respond_at(response, r, site, source):
    """Sinking and motion away under a unit force at r thicknesses, from the table."""
    one = np.float32(1)
    f = r * np.float32(STEPS)
    k = int(f)
    f -= np.float32(k)
    h = (source[5] - source[6] - site[6]) * np.float32(LEVELS_PER_LOG)
    h = min(max(h, np.float32(0)), np.float32(len(SPREADS) - 1.001))
    g = int(h)
    h -= np.float32(g)
    a0, a1, b0, b1 = (one - h) * (one - f), (one - h) * f, h * (one - f), h * f
    sink = a0 * response[g, k, 0] + a1 * response[g, k + 1, 0]
    sink += b0 * response[g + 1, k, 0] + b1 * response[g + 1, k + 1, 0]
    away = a0 * response[g, k, 1] + a1 * response[g, k + 1, 1]
    away += b0 * response[g + 1, k, 1] + b1 * response[g + 1, k + 1, 1]
    return sink, away


@numba.njit(cache=True, parallel=True, fastmath=FAST)
def _respond(vertices, start, index, slots, values, sources, sites, frames, response, out):
    """See Surroundings.linear; values and sources are those of the loaded vertices, `out` is (N, 3)."""
    for n in numba.prange(len(vertices)):
        i = vertices[n]
        site, frame = sites[i], frames[i]
        u = v = w = np.float32(0)
        for p in range(start[i], start[i + 1]):
            slot = slots[index[p]]
            if slot < 0:
                continue
            r, c, d, _, scale = _pair(site, frame, sources[slot])
            if r < REACH:
                sink, away = _respond_at(response, r, site, sources[slot])
                scale *= values[slot]
                u -= scale * away * c
                v -= scale * away * d
                w -= scale * sink
        out[n, 0], out[n, 1], out[n, 2] = u, v, w


@numba.njit(cache=True, parallel=True, fastmath=FAST)
def _feel(vertices, start, index, slots, values, sources, sites, frames, response, rings, out):
    """See Surroundings.felt; values and sources are those of the loaded vertices, `out` is (N, S, WIDTH)."""
    fields = values.shape[1]
    for n in numba.prange(len(vertices)):
        i = vertices[n]
        acc = np.zeros((fields, WIDTH), dtype=np.float32)
        row = np.zeros(WIDTH, dtype=np.float32)
        frame, site = frames[i], sites[i]
        for p in range(start[i], start[i + 1]):
            slot = slots[index[p]]
            if slot < 0:
                continue
            r, c, d, cell, scale = _pair(site, frame, sources[slot])
            if r >= REACH:
                continue
            sink, away = _respond_at(response, r, site, sources[slot])
            row[0], row[1], row[2] = -away * c * scale, -away * d * scale, -sink * scale
            if r >= NEAR:
                for s in range(fields):
                    for m in range(3):
                        acc[s, m] += values[slot, s] * row[m]
                continue
            f = r * np.float32(STEPS)
            k = int(f)
            f -= np.float32(k)
            f1, f0 = f * cell, (np.float32(1) - f) * cell
            for m in range(SCALARS):
                row[3 + m] = f0 * rings[k, m] + f1 * rings[k + 1, m]
            for m in range(VECTORS):
                w = f0 * rings[k, SCALARS + m] + f1 * rings[k + 1, SCALARS + m]
                row[3 + SCALARS + m] = w * c
                row[3 + SCALARS + VECTORS + m] = w * d
            c2, d2 = c * c - d * d, (c + c) * d
            for m in range(TENSORS):
                w = f0 * rings[k, SCALARS + VECTORS + m] + f1 * rings[k + 1, SCALARS + VECTORS + m]
                row[3 + SCALARS + 2 * VECTORS + m] = w * c2
                row[3 + SCALARS + 2 * VECTORS + TENSORS + m] = w * d2
            for s in range(fields):
                v = values[slot, s]
                for m in range(WIDTH):
                    acc[s, m] += v * row[m]
        out[n] = acc
