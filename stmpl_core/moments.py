"""Surroundings: what presses around each vertex of a layer, as the linear response to it and as its moments."""

from __future__ import annotations

import math
from contextlib import nullcontext
from copy import copy
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakKeyDictionary

import numba
import numpy as np

from stmpl_core.layer import SoftLayer
from stmpl_core.neighbours import neighbours
from stmpl_core.response import (
    REACH,
    SCALARS,
    SPREAD,
    SPREADS,
    TENSORS,
    VECTORS,
    WIDTH,
    feel,
    packed,
    response_table,
    sink_between,
    spread_sinking,
)
from stmpl_core.soundness import Soundness
from stmpl_core.thinning import Asked, Thinning

if TYPE_CHECKING:
    from stmpl_core.bend import Bend
    from stmpl_core.nodes import Nodes

FIRST_SPREAD = float(SPREADS[0])
SMOOTH = 1.25  # reach of what a contact node presses with, over the spacing of nodes: even within 4 %
WIDEST = 3.0  # distance over the thickness to which neighbours say how a place is curved


class Felt(NamedTuple):
    """Response and moments of S source fields at N vertices, in lengths of the local thickness and each vertex's frame.

    Args:
        vertices: numbers of the vertices that feel anything, (N,).
        figures: sums, (N, S, WIDTH) float32; the properties name its parts, and directions come last in each.
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


_KEPT: WeakKeyDictionary[SoftLayer, Surroundings] = WeakKeyDictionary()  # entries die with their layers


class Surroundings:
    """A layer's vertices with their frames and their neighbours: made once, then asked for every load.

    Args:
        layer: soft layer at rest. Of a stack, or of columns that run to a core, the median thickness counts.

    Attributes:
        thickness: thickness that distances are counted in, (V,) [m].
        frames: tangent, tangent, outward normal of each vertex, (V, 3, 3) [-].
        curvature: thickness times the skin's curvature in the tangents, xx, xy, yy, (V, 3) [-]; convex is positive.
        slope: gradient of the thickness along the tangents, (V, 2) [-].
        sound: where the layer is as the networks know skin.
        posed: flag of skin that joints took elsewhere.
    """

    def __init__(self, layer: SoftLayer) -> None:
        whole = layer
        if layer.stacked:  # to a stack, and to bone, belongs one flat response
            tissue = layer.typical.tissue
            layer = SoftLayer(layer.vertices, layer.faces, float(np.median(layer.thickness)), tissue=tissue)
        self.frames, self.thickness = _frames(layer.normals), layer.thickness
        points = np.ascontiguousarray(layer.vertices)
        self._thinning = Thinning(layer, self.frames, REACH)
        self.sound = Soundness(layer, below=whole)
        self._frames = self.frames.astype(np.float32)
        self._sites = _sites(points, layer.normals, layer.thickness, layer.vertex_areas)
        stand = self._thinning.levels[1 if layer.stacked else 0]
        start, index = neighbours(stand.rows, 1.2 * WIDEST, stand.edges)
        shape = _shape(stand.of, start, stand.stands[index], points, self.frames, layer.thickness)
        self.curvature, self.slope = shape[:, :3], shape[:, 3:]
        tangents, (xx, xy, yy) = self.frames[:, :2], self.curvature.T
        own = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
        bend, slope = tangents.transpose(0, 2, 1) @ own @ tangents, np.einsum("va,vax->vx", self.slope, tangents)
        self._bent, self.posed = np.concatenate([bend.reshape(-1, 9), slope], axis=1), False
        table = response_table(layer.tissue, float(layer.thickness[0]))
        self._response = np.ascontiguousarray(np.moveaxis(table, 2, 0))
        self._felt(np.zeros((1, 1)), np.zeros(1, np.int64), np.zeros(1, np.int32))  # compiled now

    def asked(self, loaded: np.ndarray) -> Asked:
        """Vertices that must be asked under sources at vertices `loaded` (L,), for all to be known."""
        return self._thinning.asked(loaded)

    def asked_again(self, loaded: np.ndarray) -> Asked:
        """Same as `asked`, but not looked for again if these were the last."""
        return self._thinning.asked_again(loaded)

    def felt(self, sources: np.ndarray, asked: Asked | None = None, *, linear: bool = True) -> Felt:
        """Response and moments, at the vertices that are asked or at all, of source fields (V, S) over E [-].

        Without `linear` the response is zeros: where it is known better, and written by who knows it.
        """
        loaded = np.flatnonzero(sources.any(axis=1)) if asked is None else asked.loaded
        vertices = self._thinning.reached(loaded) if asked is None else asked.vertices
        return Felt(vertices, self._by_groups(sources[loaded], loaded, vertices, linear=linear))

    def of_one(self, vertex: int) -> np.ndarray:
        """Linear response to a unit source at one vertex, (V, 3) [m], computed at every vertex."""
        figures = self._by_groups(np.ones((1, 1)), np.array([vertex]), np.arange(len(self.frames)), moments=False)
        return np.einsum("nj,nji->ni", figures[:, 0, :3] * self.thickness[:, None], self.frames)

    def linear(self, source: np.ndarray) -> np.ndarray:
        """Linear response alone to one source field (V,) [-], (V, 3) [m]."""
        asked = self.asked(np.flatnonzero(source))
        figures = self._by_groups(source[asked.loaded, None], asked.loaded, asked.vertices, moments=False)
        local = figures[:, 0, :3] * self.thickness[asked.vertices, None]
        out = np.zeros((len(self.frames), 3))
        asked.fill(np.einsum("nj,nji->ni", local, self.frames[asked.vertices]), out)
        return out

    def standing(self, points: np.ndarray, among: np.ndarray, spacing: float) -> np.ndarray:
        """Some of `among`, no two of which are nearer along the skin than `spacing` [m], (N,)."""
        return self._thinning.standing(points, among, spacing)

    def spread_on(self, layer: SoftLayer, pressure: np.ndarray, nodes: Nodes) -> np.ndarray:
        """Pressure (V,) that came from contact nodes, spread over the area of each where the mesh is finer."""
        spacing = math.sqrt(float(nodes.area.mean()) / (0.5 * math.sqrt(3.0)))
        return self._thinning.spread(layer.vertices, layer.vertex_areas, pressure, SMOOTH * spacing)

    def around(self, points: np.ndarray, vertices: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Neighbours of some vertices (N,), from which their curvature is found even where a bend brings them nearer.

        Args:
            points: places of all vertices, (V, 3) [m].
            vertices: numbers of the vertices.
            most: number of neighbours of each; of more, these are spread evenly over them.

        Returns:
            start (N + 1,), index: those of vertex n are index[start[n] : start[n + 1]].
        """
        parts = []
        for v, some in zip(vertices, self._thinning.around(vertices), strict=True):
            wide = 1.2 * WIDEST * self.thickness[v]
            some = some[((points[some] - points[v]) ** 2).sum(axis=1) < wide * wide]
            parts.append(some[np.arange(min(most, len(some))) * len(some) // max(min(most, len(some)), 1)])
        index = np.concatenate([*parts, np.empty(0, np.int32)])
        return np.concatenate([[0], np.cumsum([len(some) for some in parts])]).astype(np.int64), index

    def moved(self, layer: SoftLayer, frames: np.ndarray, curvature: np.ndarray, bend: Bend) -> Surroundings:
        """The same skin where joints take it: it has the neighbours of its rest.

        Args:
            layer: layer there.
            frames: tangent, tangent, normal of each vertex there, (V, 3, 3).
            curvature: see Surroundings, there, (V, 3).
            bend: what the joints did to it.
        """
        out = copy(self)
        out.frames, out.curvature, out.sound = frames, curvature, self.sound.at(bend)
        out._thinning = self._thinning.bent()
        out._frames, out._sites = np.empty_like(self._frames), self._sites.copy()
        _move(layer.vertices, layer.vertex_areas, frames, out._frames, out._sites)
        out._bent, out.posed = np.empty((len(frames), 12)), True
        return out

    def bent_at(self, vertices: np.ndarray) -> np.ndarray:
        """Curvature, a (3, 3) tensor, and slope in the layer's axes, (V, 12) [-], right at the vertices that are named.

        Args:
            vertices: numbers of vertices, of any shape; what joints took elsewhere is turned there alone.
        """
        if self.posed:
            _turn_bent(vertices.ravel(), self.frames, self.curvature, self.slope, self._bent)
        return self._bent

    @classmethod
    def of(cls, layer: SoftLayer) -> Surroundings:
        """The surroundings of a layer, made on the first call and kept as long as the layer is."""
        layer = layer.typical
        if layer not in _KEPT:
            _KEPT[layer] = cls(layer)
        return _KEPT[layer]

    def keep(self, layer: SoftLayer) -> None:
        """Lets `of` give these for another layer of the same shape and Poisson's ratio."""
        _KEPT[layer.typical] = self

    def sinking(self, vertices: np.ndarray) -> np.ndarray:
        """Sinking of vertex i under a unit source at vertex j of those given, over t, (N, N) [-]."""
        out = np.zeros((len(vertices), len(vertices)), dtype=np.float32)
        sink_between(vertices, self._sites.take(vertices, axis=1), self._sites, self._frames, self._response[0], out)
        group = self.groups(vertices)
        return np.where(group[:, None] == group, out, np.float32(0)) if group.any() else out

    def spread(self, vertices: np.ndarray, sources: np.ndarray, out: np.ndarray) -> None:
        """Adds vectors (N, 3) at vertices (N,), spread as sinking spreads, to `out` (V, 3)."""
        asked, group, some = self.asked_again(vertices), self.groups(vertices), np.flatnonzero(sources.any(axis=1))
        if not group.any():
            asked.add(self._spread(vertices[some], sources[some], asked.vertices), out)
            return
        by = np.zeros((len(asked.vertices), 3))
        for one in range(group.max() + 1):
            of = some[group[some] == one]
            there = self.reached_among(vertices[of], asked.vertices, alone=False)
            by[there] += self._spread(vertices[of], sources[of], asked.vertices[there])
        asked.add(by, out)

    def _spread(self, vertices: np.ndarray, sources: np.ndarray, there: np.ndarray) -> np.ndarray:
        out, values = np.empty((len(there), 3)), np.ascontiguousarray(sources.T, dtype=np.float32)
        spread_sinking(there, values, self._sites.take(vertices, axis=1), self._sites, self._frames,
                       self._response[0], out)  # fmt: skip
        return out

    @property
    def folded(self) -> bool:
        """Whether the skin comes near itself through the air, as fingers do."""
        return self._thinning.folded

    def groups(self, vertices: np.ndarray) -> np.ndarray:
        """Numbers of groups of vertices (N,), none of which feels another, (N,): all 0 where the skin has no folds."""
        return self._thinning.groups(vertices)

    def reached_among(self, loaded: np.ndarray, vertices: np.ndarray, alone: bool) -> np.ndarray:
        """Places in `vertices` of those that feel a load; of all, where there is no other."""
        if alone:
            return np.arange(len(vertices))
        return np.flatnonzero(np.isin(vertices, self._thinning.reached(loaded)))

    def _by_groups(self, sources: np.ndarray, loaded: np.ndarray, vertices: np.ndarray, linear: bool = True,
                   moments: bool = True) -> np.ndarray:  # fmt: skip
        """As _felt; no vertex feels a load that is near it through the air only."""
        group = self.groups(loaded)
        if not group.any():
            return self._felt(sources, loaded, vertices, linear, moments)
        figures = np.zeros((len(vertices), sources.shape[1], WIDTH), dtype=np.float32)
        for one in range(group.max() + 1):
            of = group == one
            there = self.reached_among(loaded[of], vertices, alone=False)
            figures[there] += self._felt(sources[of], loaded[of], vertices[there], linear, moments)
        return figures

    def _felt(self, sources: np.ndarray, loaded: np.ndarray, vertices: np.ndarray, linear: bool = True,
              moments: bool = True) -> np.ndarray:  # fmt: skip
        figures = np.zeros((len(vertices), sources.shape[1], WIDTH), dtype=np.float32)
        values = np.ascontiguousarray(sources.T, dtype=np.float32)
        with nullcontext() if feel.overloads else packed():
            feel(vertices, values, self._sites.take(loaded, axis=1), self._sites, self._frames,
                 self._response[0], self._response[1], linear, moments, figures)  # fmt: skip
        return figures


def _sites(points: np.ndarray, normals: np.ndarray, thickness: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Points as the kernels take them, see stmpl_core.response.feel, (10, N) float32."""
    half_log = 0.5 * np.log(thickness)
    spread = np.log(SPREAD * np.maximum(area, 1e-300) ** 0.5 / SPREADS[0]) - half_log  # a vertex without faces has none
    rows = [*(points - points.mean(axis=0)).T, thickness**-0.5, area, half_log, spread, *normals.T]
    return np.ascontiguousarray(rows, dtype=np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _move(points, areas, frames, narrow, sites):
    """Writes frames as float32, and what of _sites moves with the skin; the thickness stays."""
    m0 = m1 = m2 = 0.0
    for v in range(len(points)):
        m0, m1, m2 = m0 + points[v, 0], m1 + points[v, 1], m2 + points[v, 2]
    m0, m1, m2 = m0 / len(points), m1 / len(points), m2 / len(points)
    for v in range(len(points)):
        sites[0, v], sites[1, v], sites[2, v] = points[v, 0] - m0, points[v, 1] - m1, points[v, 2] - m2
        sites[4, v] = areas[v]
        sites[6, v] = np.log(SPREAD * np.sqrt(areas[v]) / FIRST_SPREAD) - sites[5, v]
        for x in range(3):
            sites[7 + x, v] = frames[v, 2, x]
            for a in range(3):
                narrow[v, a, x] = frames[v, a, x]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn_bent(vertices, frames, curvature, slope, out):
    """Writes Surroundings.bent_at at vertices."""
    for v in vertices:
        xx, xy, yy = curvature[v, 0], curvature[v, 1], curvature[v, 2]
        for x in range(3):
            a, b = frames[v, 0, x], frames[v, 1, x]
            left, right = a * xx + b * xy, a * xy + b * yy
            for y in range(3):
                out[v, 3 * x + y] = left * frames[v, 0, y] + right * frames[v, 1, y]
            out[v, 9 + x] = slope[v, 0] * a + slope[v, 1] * b


def _frames(normals: np.ndarray) -> np.ndarray:
    """Any two tangents with each normal, right-handed, as rows, (V, 3, 3)."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)  # a vertex without faces has no normal
    return np.stack([first, np.cross(normals, first), normals], axis=1)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def along_tangents(frames, i, j, dx, dy, dz):
    """A way (dx, dy, dz) from vertex i, and vertex j's normal, along the two tangents of i: x, y, u, v."""
    x = frames[i, 0, 0] * dx + frames[i, 0, 1] * dy + frames[i, 0, 2] * dz
    y = frames[i, 1, 0] * dx + frames[i, 1, 1] * dy + frames[i, 1, 2] * dz
    n0, n1, n2 = frames[j, 2, 0], frames[j, 2, 1], frames[j, 2, 2]
    u = frames[i, 0, 0] * n0 + frames[i, 0, 1] * n1 + frames[i, 0, 2] * n2
    v = frames[i, 1, 0] * n0 + frames[i, 1, 1] * n1 + frames[i, 1, 2] * n2
    return x, y, u, v


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _shape(of, start, index, points, frames, thickness):
    """Least-squares curvature (from the normals) and slope of the thickness, over a Gaussian of one thickness.

    of, start, index: neighbours of vertex i are index[start[of[i]] : start[of[i] + 1]].
    """
    out = np.zeros((len(points), 5))
    for i in numba.prange(len(points)):
        xx = xy = yy = 1e-12
        s0 = s1 = s2 = s3 = s4 = s5 = 0.0
        for p in range(start[of[i]], start[of[i] + 1]):
            j = index[p]
            dx, dy, dz = ((points[j, 0] - points[i, 0]) / thickness[i], (points[j, 1] - points[i, 1]) / thickness[i],
                          (points[j, 2] - points[i, 2]) / thickness[i])  # fmt: skip
            r2 = dx * dx + dy * dy + dz * dz
            if r2 > WIDEST * WIDEST:
                continue
            w = np.exp(-0.5 * r2)
            x, y, u, v = along_tangents(frames, i, j, dx, dy, dz)
            h = thickness[j] / thickness[i] - 1
            xx += w * x * x
            xy += w * x * y
            yy += w * y * y
            s0 += w * x * u
            s1 += w * y * u
            s2 += w * x * v
            s3 += w * y * v
            s4 += w * x * h
            s5 += w * y * h
        det = xx * yy - xy * xy + 1e-9
        a, b = (yy * s0 - xy * s1) / det, (xx * s1 - xy * s0) / det
        c, e = (yy * s2 - xy * s3) / det, (xx * s3 - xy * s2) / det
        out[i, 0], out[i, 1], out[i, 2] = a, 0.5 * (b + c), e
        out[i, 3], out[i, 4] = (yy * s4 - xy * s5) / det, (xx * s5 - xy * s4) / det
    return out
