"""Posing: a skin that was prepared at rest, where its joints take it: what stays is shared, what moves is made anew.

Faces, edges, border, neighbours along the rest skin, thinning and response tables stay; places, normals, areas, frames,
curvature and the core go with the bones. The wide part of a stack's response was made at rest: each vertex's motion
turns with the skin there. So a pose costs milliseconds where a new layer costs seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING

import numba
import numpy as np
from scipy.spatial import KDTree

from stmpl_core.arrays import Points
from stmpl_core.bend import Bend, Zone
from stmpl_core.green import Green
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.base import anew
from stmpl_core.moments import WIDEST, Surroundings
from stmpl_core.thinning import CORNERS, LARGEST, interpolation

if TYPE_CHECKING:
    from stmpl_core.skin import Skin

ALIKE = 3e-3  # difference of bone weights, below which skin moves as one
SPACING = 9e-3  # distance of the places at which the change of curvature is found; it is smooth [m]
NEIGHBOURS = 160  # number of neighbours that tell of the curvature at a place
FELT = 2.5  # distance to which a bend changes curvature, over the thickness: it is found from skin so far around
GAUSSIAN = np.exp(-0.5 * np.linspace(0, WIDEST**2, 2001))  # of one thickness, over the square of the distance


class Posing:
    """What a skin needs to be posed, found once.

    Args:
        skin: skin at rest, whose layer hangs on a rig.
    """

    def __init__(self, skin: Skin) -> None:
        layer, near = skin.layer, skin.near
        assert layer.rig is not None
        rig, faces = layer.rig, layer.faces
        self.rest, self.rig = skin, rig
        zone = faces[np.ptp(rig.weights[faces], axis=1).max(axis=1) > ALIKE]
        self._bending = self._places = np.empty(0, np.int64)
        self._corners, self._shares = np.empty((0, 1), np.int32), np.empty((0, 1))
        if len(zone):
            self._find_places(layer.vertices, zone, near)
        self._zone = Zone.of(skin, zone, self._places, self._bending, self._corners[:, 0])
        self._start, self._index = near.around(layer.vertices, self._places, NEIGHBOURS)
        still = np.tile(np.eye(3), (len(self._places), 1, 1))
        self._at_rest = self._curved(layer, near.frames, still)
        self._tangents = np.ascontiguousarray(near.frames[:, 0])

    def _find_places(self, points: np.ndarray, zone: np.ndarray, near: Surroundings) -> None:
        """Places at which a bend is looked at, and which of them tell of each vertex around."""
        moving = KDTree(points[np.unique(zone)])
        self._bending = np.flatnonzero(moving.query(points)[0] < FELT * near.thickness)
        self._places = near.standing(points, self._bending, SPACING)
        few = min(CORNERS, len(self._places))
        away, corners = KDTree(points[self._places]).query(points[self._bending], few)
        away, self._corners = away.reshape(-1, few), corners.reshape(-1, few).astype(np.int32)
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
        layer, quaternions = _moved(rest.layer, motions), _quaternions(motions)
        frames = np.empty((len(weights), 3, 3))
        _framed(weights, quaternions, self._tangents, layer.normals, frames)
        change = self._curved(layer, frames, _turns(weights[self._places], quaternions)) - self._at_rest
        curvature = near.curvature.copy()
        _between(self._bending, self._corners, self._shares, change, near.frames, curvature)
        moved = near.moved(layer, frames, curvature, Bend(self._zone, layer, curvature))
        moved.keep(layer)
        keep_green(rest, layer, moved, angles)
        green = Green.of(layer) if rest.green or Green.kept(rest.layer) else None  # of one material, when it is wanted
        stacks = green if rest.green is not None else None
        return rest.at(layer, anew(rest.method).prepare(layer), moved, stacks, tuple(angles))

    def turn_at(self, vertex: int, angles: Sequence[float]) -> np.ndarray:
        """Rotation of the skin at a vertex under angles of the joints [rad], (3, 3)."""
        return _turns(self.rig.weights[vertex : vertex + 1], _quaternions(self.rig.motions(angles)))[0]

    def _curved(self, layer: SoftLayer, frames: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """Curvature at the places of a skin, turned back to rest, (P, 6); turns: rotation of each from rest."""
        out = np.empty((len(self._places), 6))
        _curved(layer.vertices, layer.normals, frames, self.rest.near.thickness, turns, self._places, self._start,
                self._index, out)  # fmt: skip
        return out


def keep_green(rest: Skin, layer: SoftLayer, near: Surroundings, angles: Sequence[float]) -> None:
    """Lets Green.of give the rest skin's own response for a layer that is this skin posed, made when it is wanted.

    Args:
        rest: skin at rest.
        layer, near: layer where its joints took it, and its neighbours.
        angles: angle of each joint of the rig there [rad].
    """
    there, rig = copy(layer.typical), rest.layer.rig
    assert rig is not None

    def make() -> Green:
        turns = _turns(rig.weights, _quaternions(rig.motions(angles)))
        return (rest.green or Green.of(rest.layer)).moved(there, near, turns)

    Green.keep_for(layer, make)


def posed(layer: SoftLayer, angles: Sequence[float]) -> SoftLayer:
    """A layer where its joints take it, its shape alone; at rest the layer itself.

    Args:
        layer: layer at rest; it must hang on a rig, where an angle is not 0.
        angles: angle of each joint of the rig [rad]; empty: at rest.
    """
    if not any(angles):
        return layer
    assert layer.rig is not None
    return _moved(layer, layer.rig.motions(angles))


def _moved(layer: SoftLayer, motions: np.ndarray) -> SoftLayer:
    assert layer.rig is not None
    weights = layer.rig.weights
    vertices = blended(layer.vertices, weights, motions)
    core = None if layer.core is None else blended(layer.core, weights, motions)
    return layer.moved(vertices, core, *_areas(vertices, layer.faces))


def blended(points: Points, weights: np.ndarray, motions: np.ndarray) -> Points:
    """Points (N, 3) after the mean of motions of bones (B, 4, 4) by weights (N, B): linear blend skinning, (N, 3)."""
    out = np.empty_like(points)
    _go(points, weights, motions[:, :3, :] - np.eye(3, 4), out)
    return out


def _quaternions(motions: np.ndarray) -> np.ndarray:
    """Quaternions of motions (B, 4, 4), (B, 4)."""
    return np.array([quaternion(one[:3, :3]) for one in motions])


def _turns(weights: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    """Mean rotation of the bones by weights (N, B), (N, 3, 3)."""
    out = np.empty((len(weights), 3, 3))
    _turn(weights, quaternions, out)
    return out


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


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _mean(weights, v, quaternions):
    """Mean quaternion of the bones at a vertex; q and -q are one rotation."""
    w = x = y = z = 0.0
    for b in range(weights.shape[1]):
        share, q0, q1 = weights[v, b], quaternions[b, 0], quaternions[b, 1]
        q2, q3 = quaternions[b, 2], quaternions[b, 3]
        if w * q0 + x * q1 + y * q2 + z * q3 < 0:
            share = -share
        w, x, y, z = w + share * q0, x + share * q1, y + share * q2, z + share * q3
    root = 1 / np.sqrt(w * w + x * x + y * y + z * z)
    return w * root, x * root, y * root, z * root


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn(weights, quaternions, out):
    """See _turns."""
    for v in range(len(weights)):
        w, x, y, z = _mean(weights, v, quaternions)
        out[v, 0, 0], out[v, 0, 1], out[v, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        out[v, 1, 0], out[v, 1, 1], out[v, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        out[v, 2, 0], out[v, 2, 1], out[v, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _areas(points, faces):
    """Area vectors (V, 3), areas (V,) and normals (V, 3) of vertices."""
    vectors, areas, normals = np.zeros_like(points), np.zeros(len(points)), np.empty_like(points)
    for f in range(len(faces)):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        u0, u1, u2, v0, v1, v2 = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
        n0, n1, n2 = 0.5 * (u1 * v2 - u2 * v1), 0.5 * (u2 * v0 - u0 * v2), 0.5 * (u0 * v1 - u1 * v0)
        area, n0, n1, n2 = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2) / 3, n0 / 3, n1 / 3, n2 / 3
        for k in range(3):
            v = faces[f, k]
            areas[v] += area
            vectors[v, 0] += n0
            vectors[v, 1] += n1
            vectors[v, 2] += n2
    for v in range(len(points)):
        length = np.sqrt(vectors[v, 0] ** 2 + vectors[v, 1] ** 2 + vectors[v, 2] ** 2)
        root = 1 / length if length > 0 else 1.0
        for x in range(3):
            normals[v, x] = vectors[v, x] * root
    return vectors, areas, normals


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _framed(weights, quaternions, tangents, normals, out):
    """Frames of skin with these normals, (V, 3, 3); their first tangents are those at rest, (V, 3), turned with it."""
    for v in range(len(weights)):
        w, x, y, z = _mean(weights, v, quaternions)
        n0, n1, n2 = normals[v, 0], normals[v, 1], normals[v, 2]
        a, b, c = tangents[v, 0], tangents[v, 1], tangents[v, 2]
        t0 = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c
        t1 = 2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c
        t2 = 2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c
        along = t0 * n0 + t1 * n1 + t2 * n2
        t0, t1, t2 = t0 - along * n0, t1 - along * n1, t2 - along * n2
        root = 1 / np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
        t0, t1, t2 = root * t0, root * t1, root * t2
        out[v, 0, 0], out[v, 0, 1], out[v, 0, 2] = t0, t1, t2
        out[v, 1, 0], out[v, 1, 1], out[v, 1, 2] = n1 * t2 - n2 * t1, n2 * t0 - n0 * t2, n0 * t1 - n1 * t0
        out[v, 2, 0], out[v, 2, 1], out[v, 2, 2] = n0, n1, n2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _curved(points, normals, frames, thickness, turns, places, start, index, out):
    """Curvature at places as stmpl_core.moments finds it, turned back to rest: xx, xy, xz, yy, yz, zz, (P, 6).

    Args:
        turns: rotation of each place from rest, (P, 3, 3).
        start, index: neighbours, see Surroundings.around.
    """
    most = 0
    for m in range(len(places)):
        most = max(most, start[m + 1] - start[m])
    rows = np.empty((6, most))
    for m in range(len(places)):
        i, many = places[m], start[m + 1] - start[m]
        t, p, e, f = thickness[i], points[i], frames[i, 0], frames[i, 1]
        for n in range(many):
            j = index[start[m] + n]
            for x in range(3):
                rows[x, n], rows[3 + x, n] = points[j, x], normals[j, x]
        for n in range(many):  # one loop without branches runs in vector registers
            dx, dy, dz = (rows[0, n] - p[0]) / t, (rows[1, n] - p[1]) / t, (rows[2, n] - p[2]) / t
            n0, n1, n2 = rows[3, n], rows[4, n], rows[5, n]
            rows[0, n] = dx * dx + dy * dy + dz * dz
            rows[1, n], rows[2, n] = e[0] * dx + e[1] * dy + e[2] * dz, f[0] * dx + f[1] * dy + f[2] * dz
            rows[3, n], rows[4, n] = e[0] * n0 + e[1] * n1 + e[2] * n2, f[0] * n0 + f[1] * n1 + f[2] * n2
        xx = xy = yy = 1e-12
        s0 = s1 = s2 = s3 = 0.0
        for n in range(many):
            r2, x, y, u, v = rows[0, n], rows[1, n], rows[2, n], rows[3, n], rows[4, n]
            if r2 > WIDEST * WIDEST:
                continue
            w = GAUSSIAN[int(r2 * (len(GAUSSIAN) - 1) / (WIDEST * WIDEST))]
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
                e0 += turns[m, z, x] * frames[i, 0, z]
                f0 += turns[m, z, x] * frames[i, 1, z]
            for y in range(x, 3):
                e1 = f1 = 0.0
                for z in range(3):
                    e1 += turns[m, z, y] * frames[i, 0, z]
                    f1 += turns[m, z, y] * frames[i, 1, z]
                out[m, k] = e0 * (a * e1 + b * f1) + f0 * (b * e1 + c * f1)
                k += 1


@numba.njit(cache=True, nogil=True)
def _between(vertices, corners, shares, change, frames, out):
    """Adds the change of curvature at places to that of the vertices around, in their frames at rest."""
    for m in range(len(vertices)):
        v = vertices[m]
        k0 = k1 = k2 = k3 = k4 = k5 = 0.0
        for p in range(corners.shape[1]):
            share, k = shares[m, p], change[corners[m, p]]
            k0, k1, k2 = k0 + share * k[0], k1 + share * k[1], k2 + share * k[2]
            k3, k4, k5 = k3 + share * k[3], k4 + share * k[4], k5 + share * k[5]
        for q in range(3):
            a, b = 0 if q < 2 else 1, 0 if q < 1 else 1
            e, f = frames[v, a], frames[v, b]
            out[v, q] += (e[0] * (k0 * f[0] + k1 * f[1] + k2 * f[2])
                          + e[1] * (k1 * f[0] + k3 * f[1] + k4 * f[2])
                          + e[2] * (k2 * f[0] + k4 * f[1] + k5 * f[2]))  # fmt: skip
