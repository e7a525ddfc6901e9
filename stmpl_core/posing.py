"""Posing: a skin that was prepared at rest, where its joints take it: what stays is shared, what moves is made anew.

Faces, edges, border, neighbours along the rest skin, thinning and response tables stay; places, normals, areas, frames,
curvature and the core go with the bones. The wide part of a stack's response was made at rest: each vertex's motion
turns with the skin there. So a pose costs milliseconds where a new layer costs seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numba
import numpy as np
from scipy.spatial import KDTree

from stmpl_core.layer import SoftLayer
from stmpl_core.methods.base import anew
from stmpl_core.moments import WIDEST, Surroundings, along_tangents
from stmpl_core.soundness import Bend
from stmpl_core.thinning import CORNERS, LARGEST, interpolation

if TYPE_CHECKING:
    from stmpl_core.skin import Skin

ALIKE = 3e-3  # difference of bone weights, below which skin moves as one
NEAR_ENOUGH = 2.5  # distance to which skin that faces skin is looked for, over the thickness
APART = 6.0  # distance of two places at rest, over the thickness, from which they are no neighbours along the skin
SPACING = 9e-3  # distance of the places at which the change of curvature is found; it is smooth [m]
NEIGHBOURS = 160  # number of neighbours that tell of the curvature at a place
FELT = 2.5  # distance to which a bend changes curvature, over the thickness: it is found from skin so far around
MORE_HOLLOW = 0.05  # fall of the least curvature times the thickness, from which it is a bend that made a hollow
GAUSSIAN = np.exp(-0.5 * np.linspace(0, WIDEST**2, 2001))  # of one thickness, over the square of the distance


class Posing:
    """What a skin needs to be posed, found once.

    Args:
        skin: skin at rest, whose layer hangs on a rig.
    """

    def __init__(self, skin: Skin) -> None:
        layer, near = skin.layer, skin.near
        assert layer.rig is not None
        rig = layer.rig
        self.rest, self.rig = skin, rig
        self._faces = np.ascontiguousarray(layer.faces, dtype=np.int64)
        self._zone = np.flatnonzero(np.ptp(rig.weights[self._faces], axis=1).max(axis=1) > ALIKE)
        self._flat = _flat(layer.vertices, self._faces[self._zone])
        self._bending = self._places = np.empty(0, np.int64)
        self._corners, self._shares = np.empty((0, 1), np.int64), np.empty((0, 1))
        if len(self._zone):
            self._find_places(layer.vertices, near)
        self._start, self._index = near.around(layer.vertices, self._places, NEIGHBOURS)
        self._at_rest = np.zeros((len(self._places), 6))
        still = np.tile(np.eye(3), (len(layer.vertices), 1, 1))
        _curved(layer.vertices, near.frames, near.thickness, still, self._places, self._start, self._index,
                self._at_rest)  # fmt: skip

    def _find_places(self, points: np.ndarray, near: Surroundings) -> None:
        """Places at which a bend is looked at, and which of them tell of each vertex around."""
        moving = KDTree(points[np.unique(self._faces[self._zone])])
        self._bending = np.flatnonzero(moving.query(points)[0] < FELT * near.thickness)
        self._places = near.standing(points, self._bending, SPACING)
        few = min(CORNERS, len(self._places))
        away, corners = KDTree(points[self._places]).query(points[self._bending], few)
        away, self._corners = away.reshape(-1, few), corners.reshape(-1, few)
        shares = np.exp(-((away / SPACING) ** 2))
        self._shares = shares / shares.sum(axis=1, keepdims=True)
        if few == CORNERS:
            found = interpolation(points, near.frames, near.thickness, self._bending, self._places[self._corners])
            good = np.abs(found).sum(axis=1) < LARGEST  # others would be extrapolated
            self._shares[good] = found[good]

    def skin(self, angles: Sequence[float]) -> Skin:
        """The skin under these angles of the rig's joints [rad]; at rest the very one that was prepared."""
        if not any(angles):
            return self.rest
        rest, near, weights = self.rest, self.rest.near, self.rig.weights
        motions = self.rig.motions(angles)
        layer, turns = _moved(rest.layer, self._faces, motions), np.empty((len(weights), 3, 3))
        _turn(weights, np.array([quaternion(one[:3, :3]) for one in motions]), turns)
        frames = np.empty((len(weights), 3, 3))
        _framed(turns, near.frames, layer.normals, frames)
        curvature, now = near.curvature.copy(), np.zeros_like(self._at_rest)
        _curved(layer.vertices, frames, near.thickness, turns, self._places, self._start, self._index, now)
        now -= self._at_rest
        _between(self._bending, self._corners, self._shares, now, near.frames, curvature)
        moved = near.moved(layer, frames, curvature, self._bend(layer, curvature))
        moved.keep(layer)
        green = None
        if rest.green is not None:
            green = rest.green.moved(layer, moved, turns)
            green.keep(layer)
        return rest.at(layer, anew(rest.method).prepare(layer), moved, green, tuple(angles))

    def turn_at(self, vertex: int, angles: Sequence[float]) -> np.ndarray:
        """Rotation of the skin at a vertex under angles of the joints [rad], (3, 3)."""
        quaternions = np.array([quaternion(one[:3, :3]) for one in self.rig.motions(angles)])
        out = np.empty((1, 3, 3))
        _turn(self.rig.weights[vertex : vertex + 1], quaternions, out)
        return out[0]

    def _bend(self, layer: SoftLayer, curvature: np.ndarray) -> Bend:
        """What the bend does to each vertex."""
        count = len(layer.vertices)
        fold, least, most = np.ones(count), np.ones(count), np.ones(count)
        inner = layer.inner_vertices
        _strained(layer.vertices, inner, self._faces, self._zone, self._flat, fold, least, most)
        lowest = _lowest(curvature)
        lowest[lowest > _lowest(self.rest.near.curvature) - MORE_HOLLOW] = np.inf
        gap = np.full(count, np.inf)
        _facing(layer.vertices, layer.normals, self.rest.layer.vertices, self.rest.near.thickness, self._places, gap)
        if len(self._places):
            gap[self._bending] = gap[self._places[self._corners[:, 0]]]
        return Bend(fold, least, most, lowest, gap)


def posed(layer: SoftLayer, angles: Sequence[float]) -> SoftLayer:
    """A layer where its joints take it, its shape alone; at rest the layer itself.

    Args:
        layer: layer at rest; it must hang on a rig, where an angle is not 0.
        angles: angle of each joint of the rig [rad]; empty: at rest.
    """
    if not any(angles):
        return layer
    assert layer.rig is not None
    return _moved(layer, np.ascontiguousarray(layer.faces, dtype=np.int64), layer.rig.motions(angles))


def _lowest(curvature: np.ndarray) -> np.ndarray:
    """Least curvature at vertices, (V,), of xx, xy, yy there, (V, 3)."""
    xx, xy, yy = curvature.T
    return 0.5 * (xx + yy) - np.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)


def _moved(layer: SoftLayer, faces: np.ndarray, motions: np.ndarray) -> SoftLayer:
    assert layer.rig is not None
    less, vertices, core = motions[:, :3, :] - np.eye(3, 4), np.empty_like(layer.vertices), None
    _go(layer.vertices, layer.rig.weights, less, vertices)
    if layer.core is not None:
        core = np.empty_like(vertices)
        _go(layer.core, layer.rig.weights, less, core)
    return layer.moved(vertices, core, *_areas(vertices, faces))


def quaternion(turn: np.ndarray) -> np.ndarray:
    """Unit quaternion w x y z of a rotation (3, 3), w >= 0; I is (1, 0, 0, 0) exactly. Shepperd's method (1978)."""
    trace = float(np.trace(turn))
    off = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    if trace > 0:
        w = 0.5 * np.sqrt(1 + trace)
        return np.array([w, *(off / (4 * w))])
    i = int(np.argmax(np.diag(turn)))
    j, k = (i + 1) % 3, (i + 2) % 3
    size = 0.5 * np.sqrt(max(1 + turn[i, i] - turn[j, j] - turn[k, k], 0.0))
    out = np.empty(4)
    out[0], out[1 + i] = off[i] / (4 * size), size
    out[1 + j], out[1 + k] = (turn[j, i] + turn[i, j]) / (4 * size), (turn[k, i] + turn[i, k]) / (4 * size)
    return out if out[0] >= 0 else -out


@numba.njit(cache=True, nogil=True)
def _go(points, weights, less, out):
    """Points (N, 3) after the weighted mean of the bones' motions; `less`: motions less the identity, (B, 3, 4)."""
    for v in range(len(points)):
        for x in range(3):
            out[v, x] = points[v, x]
            for b in range(weights.shape[1]):
                w = weights[v, b]
                if w > 0:
                    out[v, x] += w * (less[b, x, 0] * points[v, 0] + less[b, x, 1] * points[v, 1]
                                      + less[b, x, 2] * points[v, 2] + less[b, x, 3])  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn(weights, quaternions, out):
    """Mean rotation of the bones at each vertex, (V, 3, 3), by their quaternions; q and -q are one rotation."""
    for v in range(len(weights)):
        w = x = y = z = 0.0
        for b in range(weights.shape[1]):
            share, q = weights[v, b], quaternions[b]
            if w * q[0] + x * q[1] + y * q[2] + z * q[3] < 0:
                share = -share
            w, x, y, z = w + share * q[0], x + share * q[1], y + share * q[2], z + share * q[3]
        root = 1 / np.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w * root, x * root, y * root, z * root
        out[v, 0, 0], out[v, 0, 1], out[v, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        out[v, 1, 0], out[v, 1, 1], out[v, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        out[v, 2, 0], out[v, 2, 1], out[v, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _areas(points, faces):
    """Area vectors of faces (F, 3); area vectors (V, 3), areas (V,) and normals (V, 3) of vertices."""
    of_faces, vectors = np.empty((len(faces), 3)), np.zeros_like(points)
    areas, normals = np.zeros(len(points)), np.empty_like(points)
    for f in range(len(faces)):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        u0, u1, u2, v0, v1, v2 = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
        n0, n1, n2 = 0.5 * (u1 * v2 - u2 * v1), 0.5 * (u2 * v0 - u0 * v2), 0.5 * (u0 * v1 - u1 * v0)
        of_faces[f, 0], of_faces[f, 1], of_faces[f, 2] = n0, n1, n2
        area = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) / 3
        for k in range(3):
            v = faces[f, k]
            areas[v] += area
            vectors[v, 0] += n0 / 3
            vectors[v, 1] += n1 / 3
            vectors[v, 2] += n2 / 3
    for v in range(len(points)):
        length = np.sqrt(vectors[v, 0] ** 2 + vectors[v, 1] ** 2 + vectors[v, 2] ** 2)
        root = 1 / length if length > 0 else 1.0
        for x in range(3):
            normals[v, x] = vectors[v, x] * root
    return of_faces, vectors, areas, normals


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _framed(turns, frames, normals, out):
    """Frames at rest turned with the skin, their normals those of the skin, (V, 3, 3)."""
    for v in range(len(turns)):
        n0, n1, n2 = normals[v, 0], normals[v, 1], normals[v, 2]
        a, b, c = frames[v, 0, 0], frames[v, 0, 1], frames[v, 0, 2]
        t0 = turns[v, 0, 0] * a + turns[v, 0, 1] * b + turns[v, 0, 2] * c
        t1 = turns[v, 1, 0] * a + turns[v, 1, 1] * b + turns[v, 1, 2] * c
        t2 = turns[v, 2, 0] * a + turns[v, 2, 1] * b + turns[v, 2, 2] * c
        along = t0 * n0 + t1 * n1 + t2 * n2
        t0, t1, t2 = t0 - along * n0, t1 - along * n1, t2 - along * n2
        root = 1 / np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
        t0, t1, t2 = root * t0, root * t1, root * t2
        out[v, 0, 0], out[v, 0, 1], out[v, 0, 2] = t0, t1, t2
        out[v, 1, 0], out[v, 1, 1], out[v, 1, 2] = n1 * t2 - n2 * t1, n2 * t0 - n0 * t2, n0 * t1 - n1 * t0
        out[v, 2, 0], out[v, 2, 1], out[v, 2, 2] = n0, n1, n2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _curved(points, frames, thickness, turns, places, start, index, out):
    """Curvature at places as stmpl_core.moments finds it, turned back to rest: xx, xy, xz, yy, yz, zz, (P, 6)."""
    for m in range(len(places)):
        i = places[m]
        t = thickness[i]
        xx = xy = yy = 1e-12
        s0 = s1 = s2 = s3 = 0.0
        for p in range(start[m], start[m + 1]):
            j = index[p]
            dx, dy, dz = ((points[j, 0] - points[i, 0]) / t, (points[j, 1] - points[i, 1]) / t,
                          (points[j, 2] - points[i, 2]) / t)  # fmt: skip
            r2 = dx * dx + dy * dy + dz * dz
            if r2 > WIDEST * WIDEST:
                continue
            w = GAUSSIAN[int(r2 * (len(GAUSSIAN) - 1) / (WIDEST * WIDEST))]
            x, y, u, v = along_tangents(frames, i, j, dx, dy, dz)
            xx += w * x * x
            xy += w * x * y
            yy += w * y * y
            s0 += w * x * u
            s1 += w * y * u
            s2 += w * x * v
            s3 += w * y * v
        det = xx * yy - xy * xy + 1e-9
        a, b = (yy * s0 - xy * s1) / det, 0.5 * ((xx * s1 - xy * s0) / det + (yy * s2 - xy * s3) / det)
        c = (xx * s3 - xy * s2) / det
        k = 0
        for x in range(3):
            e0 = f0 = 0.0
            for z in range(3):
                e0 += turns[i, z, x] * frames[i, 0, z]
                f0 += turns[i, z, x] * frames[i, 1, z]
            for y in range(x, 3):
                e1 = f1 = 0.0
                for z in range(3):
                    e1 += turns[i, z, y] * frames[i, 0, z]
                    f1 += turns[i, z, y] * frames[i, 1, z]
                out[m, k] = e0 * (a * e1 + b * f1) + f0 * (b * e1 + c * f1)
                k += 1


@numba.njit(cache=True, nogil=True)
def _between(vertices, corners, shares, change, frames, out):
    """Adds the change of curvature at places to that of the vertices around, in their frames at rest."""
    k = np.empty(6)
    for m in range(len(vertices)):
        v = vertices[m]
        k[:] = 0.0
        for p in range(corners.shape[1]):
            for x in range(6):
                k[x] += shares[m, p] * change[corners[m, p], x]
        for q in range(3):
            a, b = 0 if q < 2 else 1, 0 if q < 1 else 1
            e, f = frames[v, a], frames[v, b]
            out[v, q] += (e[0] * (k[0] * f[0] + k[1] * f[1] + k[2] * f[2])
                          + e[1] * (k[1] * f[0] + k[3] * f[1] + k[4] * f[2])
                          + e[2] * (k[2] * f[0] + k[4] * f[1] + k[5] * f[2]))  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _flat(points, faces):
    """Inverse of the two edges of each triangle in its own plane, (F, 2, 2) [1/m], upper right."""
    out = np.zeros((len(faces), 2, 2))
    for f in range(len(faces)):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        uu = uv = vv = 0.0
        for x in range(3):
            u, v = b[x] - a[x], c[x] - a[x]
            uu, uv, vv = uu + u * u, uv + u * v, vv + v * v
        length = np.sqrt(uu)
        shift, height = uv / length, np.sqrt(max(vv - uv * uv / uu, 1e-300))
        out[f, 0, 0], out[f, 0, 1], out[f, 1, 1] = 1 / length, -shift / (length * height), 1 / height
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _strained(points, inner, faces, zone, flat, fold, least, most):
    """Least fold ratio (stmpl_core.extrusion), least and largest stretch of the zone's triangles at each vertex."""
    e = np.empty((2, 3))
    for m in range(len(zone)):
        f = zone[m]
        uu = uv = vv = 0.0
        for x in range(3):
            u = (points[faces[f, 1], x] - points[faces[f, 0], x])
            v = (points[faces[f, 2], x] - points[faces[f, 0], x])
            along, across = u * flat[m, 0, 0], u * flat[m, 0, 1] + v * flat[m, 1, 1]
            uu, uv, vv = uu + along * along, uv + along * across, vv + across * across
        middle, off = 0.5 * (uu + vv), np.sqrt((0.5 * (uu - vv)) ** 2 + uv * uv)
        low, high = np.sqrt(max(middle - off, 0.0)), np.sqrt(middle + off)
        smallest, size = np.inf, 0.0
        for d in range(3):
            s = 0.5 * d
            for k in range(2):
                for x in range(3):
                    e[k, x] = ((1 - s) * (points[faces[f, k + 1], x] - points[faces[f, 0], x])
                               + s * (inner[faces[f, k + 1], x] - inner[faces[f, 0], x]))  # fmt: skip
            n0, n1, n2 = (e[0, 1] * e[1, 2] - e[0, 2] * e[1, 1], e[0, 2] * e[1, 0] - e[0, 0] * e[1, 2],
                          e[0, 0] * e[1, 1] - e[0, 1] * e[1, 0])  # fmt: skip
            for k in range(3):
                v = faces[f, k]
                det = (n0 * (points[v, 0] - inner[v, 0]) + n1 * (points[v, 1] - inner[v, 1])
                       + n2 * (points[v, 2] - inner[v, 2]))  # fmt: skip
                smallest = min(smallest, det)
                size += abs(det) / 9
        for k in range(3):
            v = faces[f, k]
            fold[v] = min(fold[v], smallest / size)
            least[v], most[v] = min(least[v], low), max(most[v], high)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _facing(points, normals, rest, thickness, places, gap):
    """Distance over the thickness to skin that faces a vertex of `places` and is far at rest; 0: inside of it."""
    for a in range(len(places)):
        i = places[a]
        for b in range(a):
            j = places[b]
            t = 0.5 * (thickness[i] + thickness[j])
            away = facing = before = 0.0
            for x in range(3):
                away += (points[i, x] - points[j, x]) ** 2
            if away >= (NEAR_ENOUGH * t) ** 2:
                continue
            ahead = back = 0.0
            for x in range(3):
                facing += normals[i, x] * normals[j, x]
                before += (rest[i, x] - rest[j, x]) ** 2
                ahead += normals[i, x] * (points[j, x] - points[i, x])
                back += normals[j, x] * (points[i, x] - points[j, x])
            if facing < 0 and before > (APART * t) ** 2:
                near = np.sqrt(away) / t if ahead > 0 and back > 0 else 0.0
                gap[i], gap[j] = min(gap[i], near), min(gap[j], near)
