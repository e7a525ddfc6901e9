"""Thinning: far from a load its answer is smooth: fewer vertices are asked there, those between are filled in."""

from __future__ import annotations

from copy import copy
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.layer import SoftLayer
from stmpl_core.neighbours import Edges, neighbours

ZONES, SPACINGS = (2.5,), (0.6,)  # distance from the load at which it begins; least between those asked there; over t
FOLDS, STACK_FOLDS = 5.0, 2.5  # distances through the air from which folds of the skin do not matter, over t
CORNERS = 12  # number of asked vertices from which one between is filled in
STACK_ZONES, STACK_SPACINGS = (0.4, 0.9, 2.5), (0.1, 0.2, 0.4)  # of a stack, which is thicker beside what presses
LARGEST = 2.5  # sum of the weights' sizes, from which a vertex is rather asked itself: it would be extrapolated


class Asked(NamedTuple):
    """The vertices that feel a load.

    Args:
        loaded: numbers of the loaded vertices, (L,).
        vertices: numbers of those that are asked, (N,).
        between: numbers of those that are filled in, (M,).
        corners: places in `vertices` of those that each is filled in from, (M, CORNERS).
        weights: weights of these, (M, CORNERS) [-].
    """

    loaded: np.ndarray
    vertices: np.ndarray
    between: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    def fill(self, values: np.ndarray, out: np.ndarray) -> None:
        """Writes vectors at the asked vertices (N, 3) and what follows for those between to `out` (V, 3)."""
        _fill(values, self.vertices, self.between, self.corners, self.weights, False, out)

    def add(self, values: np.ndarray, out: np.ndarray) -> None:
        """As `fill`, but added to what is there."""
        _fill(values, self.vertices, self.between, self.corners, self.weights, True, out)

    @property
    def stand_for(self) -> np.ndarray:
        """Number of vertices that each asked one stands for, (N,)."""
        return _stand_for(self.corners, self.weights, len(self.vertices))


class Level(NamedTuple):
    """Vertices that stand for those around them, and which of these are near each other along the skin.

    Args:
        stands: their numbers, (R,).
        of: number among them of the one that stands for each vertex, (V,).
        rows: point, normal and thickness of each, (R, 7).
        edges: edges between them.
        start, index: their neighbours, see `neighbours`.
    """

    stands: np.ndarray
    of: np.ndarray
    rows: np.ndarray
    edges: Edges
    start: np.ndarray
    index: np.ndarray

    @classmethod
    def among(cls, rows: np.ndarray, edges: Edges, heads: np.ndarray, reach: float) -> Level:
        """Of vertices with `rows` and `edges` the `heads` that stand for each, (V,), to `reach` thicknesses."""
        stands, of = np.unique(heads, return_inverse=True)
        of = of.astype(np.int32)
        if len(stands) < len(of):
            own = np.repeat(of, np.diff(edges.first))
            edges = Edges.between(np.stack([own, of[edges.beside]], axis=1), len(stands))
        rows = np.ascontiguousarray(rows[stands])
        return cls(stands.astype(np.int32), of, rows, edges, *neighbours(rows, reach, edges))


class Thinning:
    """Vertices in reach of each other by how far they are apart, and which of them stand for those around them.

    What is further apart than the first zone is known of those alone that stand for others: on skin that is meshed
    finely for its thickness, pairs of all vertices would be very many.

    Args:
        layer: soft layer at rest.
        frames: two tangents and the normal of each vertex, (V, 3, 3).
        reach: distance to which a load is felt, over t.

    Attributes:
        folded: flag of a skin that comes near itself through the air, as fingers do.
    """

    def __init__(self, layer: SoftLayer, frames: np.ndarray, reach: float) -> None:
        zones, spacings, folds = (
            (STACK_ZONES, STACK_SPACINGS, STACK_FOLDS) if layer.stacked else (ZONES, SPACINGS, FOLDS)
        )
        points, thickness, count = np.ascontiguousarray(layer.vertices), layer.thickness, len(layer.vertices)
        rows, farther = np.column_stack([points, layer.normals, thickness]), reach
        if not layer.stacked:  # whose coarse response has no end; so that no pair in reach is left out
            farther += 2 * sum(spacings)
        reaches = [*zones, farther]
        near = level = Level.among(rows, Edges.of(layer.faces, count), np.arange(count), reaches[0])
        self.levels, self._reach, self._farther = [near], reach, farther
        self._last: tuple[Asked, ...] = ()
        self._grouped: tuple[np.ndarray, np.ndarray] | None = None
        self._stands = np.zeros((len(zones) + 1, count), dtype=np.bool_)
        self._corners = np.zeros((len(zones) + 1, count, CORNERS), dtype=np.int32)
        self._weights = np.zeros((len(zones) + 1, count, CORNERS), dtype=np.float32)
        self._stands[0] = True
        for zone, spacing in enumerate(spacings, start=1):
            stands = _thinned(near.start, near.index, self._stands[zone - 1], points, spacing * thickness)
            heads = _heads(near.start, near.index, *near.edges, stands, points)
            level = Level.among(rows, near.edges, heads, reaches[zone])
            self.levels.append(level)
            corners = _nearest(level.of, level.start, level.index, level.stands, points)
            some = np.flatnonzero((heads != np.arange(count)) & (corners[:, -1] >= 0))
            weights = interpolation(points, frames, thickness, some, corners[some])
            good = np.abs(weights).sum(axis=1) < LARGEST
            some = some[good]
            self._stands[zone] = True
            self._stands[zone, some] = False
            self._corners[zone, some], self._weights[zone, some] = corners[some], weights[good]

        self._members = None if layer.stacked else (
            np.searchsorted(np.sort(level.of), np.arange(len(level.stands) + 1)), np.argsort(level.of)
        )
        self.folded = _folded(level.start, level.index, level.rows, folds)

    def groups(self, vertices: np.ndarray) -> np.ndarray:
        """Numbers of groups of vertices (N,), none of which feels another, (N,): all 0 where the skin has no folds."""
        if not self.folded or len(vertices) < 2:
            return np.zeros(len(vertices), np.int64)
        last = self._grouped
        if last is None or not np.array_equal(last[0], vertices):
            far = self.levels[-1]
            found = _together(far.start, far.index, far.of[vertices], far.rows, self._farther)
            last = self._grouped = vertices, found
        return last[1]

    def bent(self) -> Thinning:
        """The same neighbours, of a skin that joints have bent: it may come near itself through the air."""
        out = copy(self)
        out.folded, out._grouped = True, None
        return out

    def standing(self, points: np.ndarray, among: np.ndarray, spacing: float) -> np.ndarray:
        """Some of vertices `among`, no two of which are nearer along the skin than `spacing` [m], (N,)."""
        rows, mask = self.levels[0].rows.copy(), np.zeros(len(points), np.bool_)
        rows[:, 6], mask[among] = 1.0, True
        start, index = neighbours(rows, spacing, self.levels[0].edges)
        return np.flatnonzero(_thinned(start, index, mask, points, np.full(len(points), spacing)))

    def spread(self, points: np.ndarray, areas: np.ndarray, values: np.ndarray, reach: float) -> np.ndarray:
        """Values (V,) on areas (V,) [m2], each spread along the skin as far as `reach` [m]; their integral stays."""
        return _spread(*self.levels[0].edges, points, areas, values, reach)

    def around(self, vertices: np.ndarray) -> list[np.ndarray]:
        """Neighbours of some vertices."""
        start, index = neighbours(self.levels[0].rows, self._reach, self.levels[0].edges, vertices)
        return [index[a:b] for a, b in pairwise(start)]

    def reached(self, loaded: np.ndarray) -> np.ndarray:
        """All vertices with a loaded one in reach, in order."""
        return np.flatnonzero(self._zones(loaded)).astype(np.int32)

    def asked(self, loaded: np.ndarray) -> Asked:
        """Vertices that are asked under a load on vertices (L,), and how the others are filled in."""
        return Asked(loaded, *_asked(self._zones(loaded), self._stands, self._corners, self._weights))

    def _zones(self, loaded: np.ndarray) -> np.ndarray:
        """0 where no loaded vertex is in reach, else 1 for the outermost zone up to Z for the innermost, (V,)."""
        near = self.levels[0]
        mark, rim = np.zeros(len(near.of), np.uint8), _rim(*near.edges, loaded)
        for zone, level in enumerate(reversed(self.levels), start=1):
            if zone == 1 and self._members is not None:
                _mark_in_reach(level.start, level.index, level.of, *self._members, near.rows, self._reach, rim, mark)
            else:
                _mark(level.start, level.index, level.of, rim, zone, mark)
        mark[loaded] = len(self.levels)
        return mark

    def asked_again(self, loaded: np.ndarray) -> Asked:
        """Same as `asked`, but not done again if these were the last, or those before: an answer asks for two."""
        last = self._last
        known = [one for one in last if np.array_equal(one.loaded, loaded)]
        first = known[0] if known else self.asked(loaded)
        self._last = first, *[one for one in last if one is not first][:1]
        return first


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _folded(start, index, rows, reach):
    """Whether any two are within `reach` thicknesses of each other through the air, but not along the skin."""
    near = np.full(len(rows), -1)
    for i in range(len(rows)):
        for p in range(start[i], start[i + 1]):
            near[index[p]] = i
        for j in range(len(rows)):
            if near[j] == i:
                continue
            away = facing = 0.0
            for x in range(3):
                away += (rows[i, x] - rows[j, x]) ** 2
                facing += rows[i, 3 + x] * rows[j, 3 + x]
            if facing > 0 and away < reach**2 * rows[i, 6] * rows[j, 6]:
                return True
    return False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _together(start, index, vertices, rows, reach):
    """Numbers of groups of `vertices`, within each of which each is a neighbour of another; one may come twice.

    rows, reach: point, normal and thickness of each vertex, and the reach of a neighbour, as `neighbours` has them.
    """
    some = np.unique(vertices)
    place, group, queue = np.full(len(rows), -1), np.full(len(some), -1), np.empty(len(some), np.int64)
    for n in range(len(some)):
        place[some[n]] = n
    groups, left = 0, len(some)
    for n in range(len(some)):
        if group[n] >= 0:
            continue
        queue[0], group[n], many, ends = n, groups, 0, 1
        left -= 1
        while many < ends and left:
            i = some[queue[many]]
            many += 1
            if not _may_reach(rows, reach, i, some, group):
                continue
            for p in range(start[i], start[i + 1]):
                m = place[index[p]]
                if m >= 0 and group[m] < 0:
                    group[m] = groups
                    queue[ends] = m
                    ends += 1
                    left -= 1
        groups += 1
    out = np.empty(len(vertices), np.int64)
    for n in range(len(vertices)):
        out[n] = group[place[vertices[n]]]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _may_reach(rows, reach, i, some, group):
    """Whether a vertex that is of no group yet may be a neighbour of vertex i: their list is long to go through."""
    for m in range(len(some)):
        j = some[m]
        if group[m] < 0 and rows[i, 3] * rows[j, 3] + rows[i, 4] * rows[j, 4] + rows[i, 5] * rows[j, 5] > 0:
            x, y, z = rows[j, 0] - rows[i, 0], rows[j, 1] - rows[i, 1], rows[j, 2] - rows[i, 2]
            if x * x + y * y + z * z < reach**2 * rows[i, 6] * rows[j, 6]:
                return True
    return False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _thinned(start, index, among, points, apart):
    """Marks vertices of `among` no two of which are nearer than `apart` (V,), as many as come in order."""
    kept, free = np.zeros(len(points), np.bool_), among.copy()
    for v in range(len(points)):
        if not free[v]:
            continue
        kept[v] = True
        for p in range(start[v], start[v + 1]):
            away = 0.0
            for x in range(3):
                away += (points[v, x] - points[index[p], x]) ** 2
            if away < apart[v] ** 2:
                free[index[p]] = False
    return kept


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _heads(start, index, first, beside, stands, points):
    """Number of the nearest neighbour of each vertex that stands, (V,); where there is none, that of one beside it."""
    count = len(points)
    out, queue, ends = np.full(count, -1), np.empty(count, np.int64), 0
    for v in range(count):
        least = np.inf
        for p in range(start[v], start[v + 1]):
            j = index[p]
            if stands[j]:
                x, y, z = points[v, 0] - points[j, 0], points[v, 1] - points[j, 1], points[v, 2] - points[j, 2]
                away = x * x + y * y + z * z
                if away < least:
                    least, out[v] = away, j
        if out[v] >= 0:
            queue[ends] = v
            ends += 1
    many = 0
    while many < ends:
        v = queue[many]
        many += 1
        for p in range(first[v], first[v + 1]):
            j = beside[p]
            if out[j] < 0:
                out[j] = out[v]
                queue[ends] = j
                ends += 1
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _nearest(of, start, index, stands, points):
    """The nearest CORNERS that stand for others, neighbours of a vertex's own, (V, CORNERS); -1 where there are fewer.

    of, start, index, stands: see Level.
    """
    count = len(points)
    out, far = np.full((count, CORNERS), -1, np.int32), np.empty(CORNERS)
    for v in range(count):
        n = 0
        for p in range(start[of[v]], start[of[v] + 1]):
            j, away = stands[index[p]], 0.0
            for x in range(3):
                away += (points[v, x] - points[j, x]) ** 2
            if n == CORNERS and away >= far[-1]:
                continue
            k = min(n, CORNERS - 1)
            while k > 0 and far[k - 1] > away:
                far[k], out[v, k] = far[k - 1], out[v, k - 1]
                k -= 1
            far[k], out[v, k] = away, j
            n = min(n + 1, CORNERS)
    return out


def interpolation(points: np.ndarray, frames: np.ndarray, thickness: np.ndarray, some: np.ndarray,
                   corners: np.ndarray) -> np.ndarray:  # fmt: skip
    """Weights of the corners (M, CORNERS) for vertices `some` (M,), in their tangent planes.

    Cubic splines through scattered points, exact for what is linear: Fornberg & Flyer, "A Primer on Radial Basis
    Functions with Applications to the Geosciences", 2015, chapter 5.
    """
    away = (points[corners] - points[some][:, None]) / thickness[some][:, None, None]
    flat = np.einsum("nkx,nax->nka", away, frames[some][:, :2])
    size = CORNERS + 3
    left, right = np.zeros((len(some), size, size)), np.zeros((len(some), size))
    x, y = (flat[:, :, None, a] - flat[:, None, :, a] for a in range(2))  # norm of pairs takes twice as long
    left[:, :CORNERS, :CORNERS] = np.sqrt(x * x + y * y) ** 3
    left[:, :CORNERS, CORNERS], left[:, CORNERS, :CORNERS] = 1.0, 1.0
    left[:, :CORNERS, CORNERS + 1 :], left[:, CORNERS + 1 :, :CORNERS] = flat, np.swapaxes(flat, 1, 2)
    left += 1e-9 * np.eye(size)
    right[:, :CORNERS], right[:, CORNERS] = np.linalg.norm(flat, axis=-1) ** 3, 1.0
    return np.linalg.solve(left, right[..., None])[:, :CORNERS, 0].astype(np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spread(first, beside, points, areas, values, reach):
    """Each value among the vertices that edges lead to within its reach, by (1 - (d / reach)^2)^2 of the distance."""
    out, seen, square = np.zeros(len(values)), np.full(len(values), -1), reach * reach
    queue, weight = np.empty(len(values), np.int64), np.empty(len(values))
    for i in np.flatnonzero(values):
        queue[0], seen[i], weight[0], many, ends, total = i, i, 1.0, 0, 1, areas[i]
        while many < ends:
            k = queue[many]
            many += 1
            for p in range(first[k], first[k + 1]):
                j = beside[p]
                if seen[j] == i:
                    continue
                seen[j] = i
                x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
                near = 1 - (x * x + y * y + z * z) / square
                if near > 0:
                    queue[ends], weight[ends] = j, near * near
                    total += areas[j] * near * near
                    ends += 1
        share = values[i] * areas[i] / total
        for k in range(ends):
            out[queue[k]] += share * weight[k]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rim(first, beside, loaded):
    """Those loaded vertices that lie beside others: who is outside is nearest to these."""
    inside, rim, many = np.zeros(len(first) - 1, np.bool_), np.empty(len(loaded), np.int64), 0
    for j in loaded:
        inside[j] = True
    for j in loaded:
        for p in range(first[j], first[j + 1]):
            if not inside[beside[p]]:
                rim[many] = j
                many += 1
                break
    return rim[:many]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mark(start, index, of, rim, zone, mark):
    """Writes `zone` where what stands for a vertex is a neighbour of what stands for one of the rim."""
    near, done = np.zeros(len(start) - 1, np.bool_), np.zeros(len(start) - 1, np.bool_)
    for j in rim:
        if not done[of[j]]:
            done[of[j]] = True
            for p in range(start[of[j]], start[of[j] + 1]):
                near[np.uint32(index[p])] = True  # unsigned: no index that may count from the end
    for v in range(len(of)):
        if near[of[v]]:
            mark[v] = zone


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mark_in_reach(start, index, of, first, member, rows, reach, rim, mark):
    """Writes 1 at each vertex in reach of one of the rim, if what stands for one is a neighbour of the other's.

    first, member: the vertices for which each stands; rows: point, normal and thickness of each vertex.
    """
    left, square = first[1:] - first[:-1], reach * reach
    for j in rim:
        for p in range(start[of[j]], start[of[j] + 1]):
            n = np.uint32(index[p])
            if left[n] == 0:
                continue
            for q in range(first[n], first[n + 1]):
                v = member[q]
                if mark[v] == 1 or rows[v, 3] * rows[j, 3] + rows[v, 4] * rows[j, 4] + rows[v, 5] * rows[j, 5] <= 0:
                    continue
                x, y, z = rows[v, 0] - rows[j, 0], rows[v, 1] - rows[j, 1], rows[v, 2] - rows[j, 2]
                if x * x + y * y + z * z < square * rows[v, 6] * rows[j, 6]:
                    mark[v] = 1
                    left[n] -= 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _asked(marks, stands, corners, weights):
    """All of Asked but for the loaded vertices."""
    last, room = len(stands), np.count_nonzero(marks)
    place, between = np.zeros(len(marks), np.int32), np.empty(room, np.int32)
    at, by = np.empty((room, CORNERS), np.int32), np.empty((room, CORNERS), np.float32)
    many = 0
    for v in range(len(marks)):
        if marks[v] == 0:
            continue
        z = last - marks[v]
        if stands[z, v]:
            place[v] = 1
            continue
        between[many] = v
        for k in range(CORNERS):
            at[many, k] = c = np.uint32(corners[z, v, k])
            place[c] = 1
        many += 1
    vertices, asked = np.empty(np.count_nonzero(place), np.int32), 0
    for v in range(len(marks)):
        if place[v]:
            vertices[asked] = v
            asked += 1
            place[v] = asked  # one more than its number
    count = 0
    for n in range(many):
        v = between[n]
        if place[v]:  # asked after all
            continue
        z = last - marks[v]
        between[count] = v
        for k in range(CORNERS):
            at[count, k], by[count, k] = place[np.uint32(at[n, k])] - 1, weights[z, v, k]
        count += 1
    return vertices, between[:count], at[:count], by[:count]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _stand_for(corners, weights, count):
    """See Asked.stand_for."""
    out = np.ones(count)
    for n in range(len(corners)):
        for k in range(corners.shape[1]):
            out[np.uint32(corners[n, k])] += weights[n, k]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill(values, vertices, between, corners, weights, add, out):
    """See Asked.fill, and Asked.add."""
    for n in range(len(vertices)):
        for x in range(3):
            out[vertices[n], x] = out[vertices[n], x] + values[n, x] if add else values[n, x]
    for n in range(len(between)):
        x = y = z = 0.0
        for k in range(corners.shape[1]):
            c, weight = np.uint32(corners[n, k]), weights[n, k]
            x += weight * values[c, 0]
            y += weight * values[c, 1]
            z += weight * values[c, 2]
        v = between[n]
        if add:
            x, y, z = x + out[v, 0], y + out[v, 1], z + out[v, 2]
        out[v, 0], out[v, 1], out[v, 2] = x, y, z
