"""Bend: what joints did to skin, found at the vertices that somebody asks for: what nobody presses costs nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np

from stmpl_core.layer import SoftLayer
from stmpl_core.soundness import Bent

if TYPE_CHECKING:
    from stmpl_core.skin import Skin

NEAR_ENOUGH = 2.5  # distance to which skin that faces skin is looked for, over the thickness
APART = 6.0  # distance of two places at rest, over the thickness, from which they are no neighbours along the skin
MORE_HOLLOW = 0.05  # fall of the least curvature times the thickness, from which it is a bend that made a hollow


class Zone(NamedTuple):
    """Skin that a bend may spoil, as it is at rest; found once.

    Args:
        faces: triangles that do not move as one, (F, 3).
        flat: inverse of the two edges of each in its own plane, (F, 2, 2) [1/m], upper right.
        start, around: those of vertex v are around[start[v] : start[v + 1]].
        places: vertices at which a bend is looked at, (P,).
        told_by: number of the place that tells of each vertex; -1: none, (V,).
        lowest: least curvature times the thickness, (V,) [-].
        points: places of the vertices, (V, 3) [m].
        thickness: thickness that distances are counted in, (V,) [m].
    """

    faces: np.ndarray
    flat: np.ndarray
    start: np.ndarray
    around: np.ndarray
    places: np.ndarray
    told_by: np.ndarray
    lowest: np.ndarray
    points: np.ndarray
    thickness: np.ndarray

    @classmethod
    def of(cls, skin: Skin, faces: np.ndarray, places: np.ndarray, bending: np.ndarray, teller: np.ndarray) -> Zone:
        """The zone of a skin at rest; teller: number of the place that tells of each vertex of `bending`."""
        points, near, corners = skin.layer.vertices, skin.near, faces.ravel()
        told_by = np.full(len(points), -1, np.int32)
        told_by[bending] = teller
        start = np.searchsorted(np.sort(corners), np.arange(len(points) + 1))
        around = np.argsort(corners, kind="stable") // 3
        return cls(faces, _flat(points, faces), start, around, places, told_by, _lowest(near.curvature), points,
                   near.thickness)  # fmt: skip


class Bend:
    """What joints did to a skin.

    Args:
        zone: what they may spoil.
        layer: layer where they took it.
        curvature: curvature times the thickness there, see Surroundings, (V, 3) [-].
    """

    def __init__(self, zone: Zone, layer: SoftLayer, curvature: np.ndarray) -> None:
        self._zone, self._curvature = zone, curvature
        self._points, self._normals = layer.vertices, layer.normals
        self._core, self._thickness = layer.core, layer.thickness

    def at(self, vertices: np.ndarray) -> Bent:
        """What they did at some vertices (N,)."""
        zone, fold, least, most = self._zone, *np.ones((3, len(vertices)))
        core = self._points if self._core is None else self._core
        _strained(vertices, self._points, self._normals, self._thickness, core, self._core is not None, zone.faces,
                  zone.start, zone.around, zone.flat, fold, least, most)  # fmt: skip
        lowest = _lowest(self._curvature[vertices])
        lowest[lowest > zone.lowest[vertices] - MORE_HOLLOW] = np.inf
        gap = np.full(len(vertices), np.inf)
        _facing(zone.told_by[vertices], self._points, self._normals, zone.points, zone.thickness, zone.places, gap)
        return Bent(fold, least, most, lowest, gap)

    @property
    def spoilt(self) -> np.ndarray:
        """Mask of the vertices where an answer is not to be believed, (V,)."""
        return self.at(np.arange(len(self._points))).spoilt

    def of_force(self, loaded: np.ndarray, force: np.ndarray) -> list[str]:
        """What a bend spoils under forces (L,) on vertices (L,), as sentences."""
        return self.at(loaded).of_force(force) if (self._zone.told_by[loaded] >= 0).any() else []


def _lowest(curvature: np.ndarray) -> np.ndarray:
    """Least curvature at vertices, (N,), of xx, xy, yy there, (N, 3)."""
    xx, xy, yy = curvature.T
    return 0.5 * (xx + yy) - np.sqrt((0.5 * (xx - yy)) ** 2 + xy**2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _flat(points, faces):
    """See Zone."""
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
def _strained(vertices, points, normals, thickness, core, cored, faces, start, around, flat, fold, least, most):
    """Least fold ratio (stmpl_core.extrusion), least and largest stretch of the zone's triangles at vertices.

    Args:
        core: ends of the columns, where `cored`; else these are straight below.
    """
    e, outer, inner = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(vertices)):
        for f in around[start[vertices[n]] : start[vertices[n] + 1]]:
            for k in range(3):
                v = faces[f, k]
                for x in range(3):
                    outer[k, x] = points[v, x]
                    inner[k, x] = core[v, x] if cored else points[v, x] - thickness[v] * normals[v, x]
            uu = uv = vv = 0.0
            for x in range(3):
                u, v = outer[1, x] - outer[0, x], outer[2, x] - outer[0, x]
                along, across = u * flat[f, 0, 0], u * flat[f, 0, 1] + v * flat[f, 1, 1]
                uu, uv, vv = uu + along * along, uv + along * across, vv + across * across
            middle, off = 0.5 * (uu + vv), np.sqrt((0.5 * (uu - vv)) ** 2 + uv * uv)
            smallest, size = np.inf, 0.0
            for d in range(3):
                s = 0.5 * d
                for k in range(2):
                    for x in range(3):
                        e[k, x] = (1 - s) * (outer[k + 1, x] - outer[0, x]) + s * (inner[k + 1, x] - inner[0, x])
                n0, n1, n2 = (e[0, 1] * e[1, 2] - e[0, 2] * e[1, 1], e[0, 2] * e[1, 0] - e[0, 0] * e[1, 2],
                              e[0, 0] * e[1, 1] - e[0, 1] * e[1, 0])  # fmt: skip
                for k in range(3):
                    det = (n0 * (outer[k, 0] - inner[k, 0]) + n1 * (outer[k, 1] - inner[k, 1])
                           + n2 * (outer[k, 2] - inner[k, 2]))  # fmt: skip
                    smallest = min(smallest, det)
                    size += abs(det) / 9
            fold[n] = min(fold[n], smallest / size)
            least[n], most[n] = min(least[n], np.sqrt(max(middle - off, 0.0))), max(most[n], np.sqrt(middle + off))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _facing(told_by, points, normals, rest, thickness, places, gap):
    """Distance over the thickness to skin that faces the place that tells of a vertex, far at rest; 0: inside of it."""
    found = np.full(len(places), -1.0)
    for n in range(len(told_by)):
        a = told_by[n]
        if a < 0:
            continue
        if found[a] < 0:
            found[a] = np.inf
            i = places[a]
            for b in range(len(places)):
                j = places[b]
                t = 0.5 * (thickness[i] + thickness[j])
                away = facing = before = ahead = back = 0.0
                for x in range(3):
                    away += (points[i, x] - points[j, x]) ** 2
                if away >= (NEAR_ENOUGH * t) ** 2:
                    continue
                for x in range(3):
                    facing += normals[i, x] * normals[j, x]
                    before += (rest[i, x] - rest[j, x]) ** 2
                    ahead += normals[i, x] * (points[j, x] - points[i, x])
                    back += normals[j, x] * (points[i, x] - points[j, x])
                if facing < 0 and before > (APART * t) ** 2:
                    found[a] = min(found[a], np.sqrt(away) / t if ahead > 0 and back > 0 else 0.0)
        gap[n] = found[a]
