"""Columns: how far a tool squeezes the columns of skin under it, sampled between the vertices, gathered at them."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numba
import numpy as np

from stmpl_core.arrays import Points, Transform
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance, distance_at

HOLE_RADIUS = 0.6  # farthest point of a triangle from its corners, over the edge length (equilateral: 0.577)
MAX_COLUMN_STRAIN = 0.9  # strain beyond which no column is squeezed
WALL_BLEND_M = 4e-4  # width over which the squeeze rises beside a tool's wall: no sample pops in while the tool slides
SECANT_START_M = 2e-5  # distance to the tool at which the secant rule takes over from sphere tracing
SECANT_TOLERANCE_M = 3e-6  # largest last step of the secant rule; the depth is then known far better


class Squeeze(NamedTuple):
    """Squeeze of columns by a tool at its pose, each column by itself.

    Args:
        vertices: numbers of the vertices that carry any of it, (N,).
        pressure: Winkler's pressure over E, averaged with each vertex's hat function, (N,) [-].
        strain: strain of the columns times confined modulus over E, averaged likewise, (N,) [-].
        depth: depth of the tool under the vertex itself, 0 where it is not covered, (N,) [m].
        rests: share from 0, not covered, to 1, WALL_BLEND_M inside the tool's walls and its skin, (N,) [-].
    """

    vertices: np.ndarray
    pressure: np.ndarray
    strain: np.ndarray
    depth: np.ndarray
    rests: np.ndarray


NO_SQUEEZE = Squeeze(np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty(0), np.empty(0))


class Clearance(NamedTuple):
    """Distance of a tool from columns.

    Args:
        vertices: numbers of the columns' vertices, (N,).
        least: signed distance along each column (N,) [m]; inf where the tool comes through the core.
        skin: signed distance at its skin, (N,) [m].
    """

    vertices: np.ndarray
    least: np.ndarray
    skin: np.ndarray


class Columns:
    """The columns of a layer, skin to core, with their triangles around them.

    Args:
        layer: soft layer at rest.
    """

    def __init__(self, layer: SoftLayer) -> None:
        self.layer = layer
        self.points, self.inward = layer.vertices, np.ascontiguousarray(-layer.normals)
        self.faces = np.ascontiguousarray(layer.faces, dtype=np.int64)
        corners = self.faces.ravel()
        self._around = np.argsort(corners, kind="stable") // 3  # faces around each vertex
        self._start = np.searchsorted(np.sort(corners), np.arange(len(self.points) + 1))
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        self._face_areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        self._slot = np.full(len(self.points), -1)
        tissue = layer.tissue
        self._moduli = np.array([tissue.shear_modulus, tissue.lame_lambda]) / tissue.youngs_modulus

    @cached_property
    def _skin(self) -> Any:
        """The skin as FCL knows it: a tree of boxes."""
        import fcl

        model = fcl.BVHModel()
        model.beginModel(len(self.points), len(self.faces))
        model.addSubModel(self.points, self.faces)
        model.endModel()
        return fcl.CollisionObject(model)

    def near(self, field: SignedDistance, pose: Transform, reach: float, *, many: bool = False) -> np.ndarray:
        """Broad phase: numbers of the vertices in the tool's box.

        Args:
            field: distance field of the tool.
            pose: pose_body_from_tool, (4, 4).
            reach: width by which the box is larger than the tool [m].
            many: choice to ask FCL's tree first. That takes 6 us for a tool that is apart, where looking at each vertex
                of an arm takes 14, and 60 us for one that touches: it pays where many tools are, most of them apart.
        """
        low, high = field.tool_bounds
        centre = pose[:3, :3] @ ((low + high) / 2) + pose[:3, 3]
        if many:
            import fcl

            box = fcl.CollisionObject(fcl.Box(*(high - low + 2 * reach)), fcl.Transform(pose[:3, :3], centre))
            if not fcl.collide(self._skin, box):
                return np.empty(0, np.int64)
        return _inside_box(self.points, pose, low - reach, high + reach, centre)

    def squeezed(self, field: SignedDistance, pose: Transform) -> Squeeze:
        """Squeeze of the columns by a tool at its pose."""
        near = self.near(field, pose, float(self.layer.thickness.max()) + self.layer.edge_length)
        return self.squeeze(field, pose, self.clearance(field, pose, near, self.layer.edge_length))

    def clearance(self, field: SignedDistance, pose: Transform, near: np.ndarray, far: float) -> Clearance:
        """Distance of the tool from columns; those further than `far` [m] are only known to be so."""
        least, skin = _clearances(_grid(field), pose, self.points, self.inward, self.layer.thickness, near, far)
        return Clearance(near, least, skin)

    def squeeze(self, field: SignedDistance, pose: Transform, clearance: Clearance) -> Squeeze:
        """Squeeze of the columns that the tool comes near to."""
        near, least, above = clearance
        covered = near[least < HOLE_RADIUS * self.layer.edge_length]
        if not len(covered):
            return NO_SQUEEZE
        buried = min(max(float(np.minimum(-least, above).max()) / WALL_BLEND_M, 0.0), 1.0)
        skin = self.points, self.inward, self.layer.thickness, self.faces, self._start, self._around, self._face_areas
        vertices, sums, depth, rests = _squeeze(_grid(field), pose, *skin, covered, buried, self._slot, self._moduli)
        sums /= self.layer.vertex_areas[vertices, None]
        return Squeeze(vertices, sums[:, 0], sums[:, 1], depth, rests)

    def deeper(self, columns: np.ndarray, weight: np.ndarray, depth: np.ndarray, gain: np.ndarray, times: float,
               most: float) -> float:  # fmt: skip
        """Further depth at which columns together press `times` as hard, each by itself [m].

        Args:
            columns: numbers of the columns' vertices, (N,).
            weight: weights of their pressures in the sum, (N,).
            depth: depth of the tool in each now, (N,) [m]; below 0: the tool is that far away.
            gain: depth that each gains over what is returned, (N,) [-].
            times: factor on the force, > 0.
            most: largest answer [m]; the least is its negative.
        """
        return _deeper(self._moduli, self.layer.thickness[columns], weight, depth, gain, times, most)


def depth_along(field: SignedDistance, pose: Transform, points: Points, way: Points, guess: np.ndarray) -> np.ndarray:
    """Way of points (N, 3) along unit vectors (N, 3) out of a tool, (N,) [m], from a guess > 0."""
    return _depths_along(_grid(field), pose, points, np.ascontiguousarray(way), guess)


def _grid(field: SignedDistance) -> tuple[np.ndarray, np.ndarray, float]:
    return field.coefficients, field.origin, field.spacing


def _middles(split: int) -> np.ndarray:
    """Barycentric coordinates of the middles of the split^2 parts of a triangle, (split^2, 3)."""
    out = []
    for i in range(split):
        for j in range(split - i):
            out.append((i + 1 / 3, j + 1 / 3))
            if i + j < split - 1:
                out.append((i + 2 / 3, j + 2 / 3))
    ab = np.array(out) / split
    return np.column_stack([ab, 1 - ab.sum(axis=1)])


_SAMPLES = _middles(3)


@numba.njit(cache=True, inline="always")
def _to_tool(pose, x, y, z):
    """Coordinates in the tool's frame of a point of the body's."""
    a, b, c = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    return (pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c, pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c,
            pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c)  # fmt: skip


@numba.njit(cache=True)
def _inside_box(points, pose, low, high, centre):
    """Numbers of the points that lie in a box of the tool's frame, whose centre is given in the body's."""
    found, n, radius = np.empty(len(points), np.int64), 0, 0.0
    for x in range(3):
        radius += 0.25 * (high[x] - low[x]) ** 2
    for v in range(len(points)):
        a, b, c = points[v, 0] - centre[0], points[v, 1] - centre[1], points[v, 2] - centre[2]
        if a * a + b * b + c * c <= radius:
            x, y, z = _to_tool(pose, points[v, 0], points[v, 1], points[v, 2])
            if low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]:
                found[n] = v
                n += 1
    return found[:n].copy()


@numba.njit(cache=True, inline="always")
def _ray(pose, points, ways, n):
    """Point n and its unit vector in the tool's frame, as six numbers: a view of an array would cost as much again."""
    x, y, z = _to_tool(pose, points[n, 0], points[n, 1], points[n, 2])
    a, b, c = ways[n, 0], ways[n, 1], ways[n, 2]
    return (x, y, z, pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c, pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c,
            pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c)  # fmt: skip


@numba.njit(cache=True, inline="always")
def _at(grid, ray, s):
    """Signed distance to the tool at depth s along a ray [m]."""
    return distance_at(grid[0], grid[1], grid[2], ray[0] + s * ray[3], ray[1] + s * ray[4], ray[2] + s * ray[5])


@numba.njit(cache=True)
def _clearances(grid, pose, points, inward, thickness, near, far):
    """Least signed distance along each column [m], by sphere tracing from the skin to the core; and that at the skin.

    A column whose core end lies inside the tool counts only if the tool comes from outside: where the distance still
    rises along the inward normal there.
    """
    out, skin = np.full(len(near), np.inf), np.empty(len(near))
    for n in range(len(near)):
        v = near[n]
        t, ray = thickness[v], _ray(pose, points, inward, v)
        skin[n] = d = _at(grid, ray, 0.0)
        if d > t + far:
            out[n] = d - t  # the rest of the column cannot be nearer
            continue
        least, s = d, 0.0
        while s < t:
            s = min(s + max(abs(d), t / 16), t)
            d = _at(grid, ray, s)
            least = min(least, d)
        if d <= 0 and _at(grid, ray, t + 1e-5) < d:
            least = np.inf
        out[n] = least
    return out, skin


@numba.njit(cache=True)
def _meet(grid, ray, t, guess):
    """How deep along a ray, from the skin inwards, the tool ends [m]; 0 if it is not met.

    From a guess above WALL_BLEND_M by the secant rule. Where that goes astray, as along a wall of the tool, or without
    such a guess: from the core by sphere tracing, then the secant rule.
    """
    if guess > WALL_BLEND_M:
        s, d = guess, _at(grid, ray, guess)
        last_s, last_d = s + 1.0, d + 1.0
        for _ in range(6):
            slope = (d - last_d) / (s - last_s)
            if slope < 0.3:
                break
            last_s, last_d = s, d
            s -= d / slope
            if abs(s - last_s) < SECANT_TOLERANCE_M and s > 0:
                return min(s, t)
            d = _at(grid, ray, s)
    s, d = t, _at(grid, ray, t)
    if d <= 0:
        return t
    last_s, last_d = s + 1.0, d + 1.0
    for _ in range(40):
        if s - d > 0 and d > SECANT_START_M:
            last_s, last_d = s, d
            s -= d
        else:
            slope = (d - last_d) / (s - last_s)
            following = s - d / slope if slope > 0.2 else s - d
            last_s, last_d = s, d
            s = following
        if s <= 0:
            return 0.0
        if abs(s - last_s) < SECANT_TOLERANCE_M:
            return min(s, t)
        d = _at(grid, ray, s)
    return min(s, t)


@numba.njit(cache=True)
def _deeper(moduli, thickness, weight, depth, gain, times, most):
    """See Columns.deeper; by bisection, until a hundredth of a percent of the range is left."""
    wanted = times * _together(moduli, thickness, weight, depth, gain, 0.0)
    low, high = (0.0, most) if times > 1 else (-most, 0.0)
    for _ in range(14):
        middle = 0.5 * (low + high)
        if _together(moduli, thickness, weight, depth, gain, middle) < wanted:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@numba.njit(cache=True)
def _together(moduli, thickness, weight, depth, gain, by):
    """Weighted sum of the pressures of columns that are squeezed `by` more."""
    total = 0.0
    for n in range(len(depth)):
        strain = min((depth[n] + by * gain[n]) / thickness[n], MAX_COLUMN_STRAIN)
        if strain > 0:
            total += weight[n] * _column_pressure(moduli, strain)
    return total


@numba.njit(cache=True, inline="always")
def _column_pressure(moduli, strain):
    """Pressure of a confined Neo-Hookean column, over E [-]."""
    stretch = 1 - strain
    return -(moduli[0] * (stretch - 1 / stretch) + moduli[1] * np.log(stretch) / stretch)


@numba.njit(cache=True)
def _depths_along(grid, pose, points, way, guess):
    out = np.empty(len(points))
    for n in range(len(points)):
        out[n] = _meet(grid, _ray(pose, points, way, n), 4 * guess[n], guess[n])
    return out


@numba.njit(cache=True)
def _squeeze(grid, pose, points, inward, thickness, faces, start, around, face_areas, covered, buried, slot, moduli):
    """See Columns.squeeze: vertices in order, pressure and strain times their areas (N, 2), depth (N,), rests (N,).

    A triangle with all corners covered has a good guess of every depth; at the border the depth falls to 0 over
    WALL_BLEND_M beside a wall of the tool. Unless the tool is buried, columns whose skin is outside it are free.
    """
    mu, lam = moduli[0], moduli[1]
    room = 0
    for v in covered:
        room += start[v + 1] - start[v]
    found, vertices, many, count = np.empty(room, np.int64), np.empty(3 * room, np.int64), 0, 0
    for v in covered:
        for p in range(start[v], start[v + 1]):
            f = around[p]
            for k in range(3):
                w = faces[f, k]
                if slot[w] < 0:
                    slot[w] = count
                    vertices[count] = w
                    count += 1
            found[many] = f
            many += 1
    found = np.unique(found[:many])
    vertices = np.sort(vertices[:count])
    depth, rests, sums = np.empty(count), np.zeros(count), np.zeros((count, 2))
    for n in range(count):
        v = vertices[n]
        slot[v] = n
        ray = _ray(pose, points, inward, v)
        guess = -_at(grid, ray, 0.0)
        share = 1.0 if guess >= 0 else max(buried, 1 + guess / WALL_BLEND_M)
        guess = 0.0 if buried > 0 else guess
        depth[n] = 0.0 if share <= 0 else share * _meet(grid, ray, thickness[v], guess)
        if depth[n] > 0:
            inside = -_at(grid, ray, depth[n] - WALL_BLEND_M)
            rests[n] = min(max(2 * inside / WALL_BLEND_M, 0.0), 1.0) * min(depth[n] / WALL_BLEND_M, 1.0)
    point, down = np.empty((1, 3)), np.empty((1, 3))
    for f in found:
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        di, dj, dk = depth[slot[i]], depth[slot[j]], depth[slot[k]]
        border = min(rests[slot[i]], rests[slot[j]], rests[slot[k]]) < 1 or max(di, dj, dk) > 3 * min(di, dj, dk)
        weight = face_areas[f] / len(_SAMPLES)
        for q in range(len(_SAMPLES)):
            a, b, c = _SAMPLES[q, 0], _SAMPLES[q, 1], _SAMPLES[q, 2]
            length = 0.0
            for x in range(3):
                point[0, x] = a * points[i, x] + b * points[j, x] + c * points[k, x]
                down[0, x] = a * inward[i, x] + b * inward[j, x] + c * inward[k, x]
                length += down[0, x] * down[0, x]
            length = 1 / np.sqrt(length)
            for x in range(3):
                down[0, x] *= length
            ray = _ray(pose, point, down, 0)
            t = a * thickness[i] + b * thickness[j] + c * thickness[k]
            guess, share = a * di + b * dj + c * dk, 1.0
            if border or buried > 0:
                guess = -_at(grid, ray, 0.0)
                share = 1.0 if guess >= 0 else max(buried, 1 + guess / WALL_BLEND_M)
                if share <= 0:
                    continue
                guess = 0.0 if buried > 0 else guess
            deep = _meet(grid, ray, t, guess)
            if border and deep > 0:
                inside = -_at(grid, ray, deep - WALL_BLEND_M)
                deep *= min(max(2 * inside / WALL_BLEND_M, 0.0), 1.0)
            deep *= share
            if deep <= 0:
                continue
            strain = min(deep / t, MAX_COLUMN_STRAIN)
            pressure = _column_pressure(moduli, strain)
            strain *= lam + 2 * mu
            for corner, part in ((i, a), (j, b), (k, c)):
                n = slot[corner]
                sums[n, 0] += weight * part * pressure
                sums[n, 1] += weight * part * strain
    for v in vertices:
        slot[v] = -1
    carry = np.flatnonzero(sums[:, 0] > 0)
    return vertices[carry], sums[carry], depth[carry], rests[carry]
