"""Site: a place on a skin where a robot works, and a circle around it along the skin."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from stmpl_core.arrays import check_count, check_kind
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.soundness import border_distance

SMOOTH_M = 12e-3  # width over which normals are averaged [m]: what a tool of that size feels as one surface
MIDDLE = 0.2  # half width of the middle part of a limb, over its length
HARMONICS = 6  # of a circle's course along the skin: what is finer is the mesh
SAMPLES = 240  # points of a circle that are laid on the skin


@dataclass(frozen=True, eq=False)
class Site:
    """A place on the skin.

    Args:
        layer: skin.
        vertex: number of the vertex in its middle.

    Raises:
        InvalidInput: a vertex that the skin does not have.
    """

    layer: SoftLayer
    vertex: int

    def __post_init__(self) -> None:
        check_kind("layer", self.layer, SoftLayer)
        check_count("the vertex", self.vertex, 0, len(self.layer.vertices) - 1)

    @classmethod
    def thickest(cls, layer: SoftLayer) -> Site:
        """The vertex in the middle part of the limb whose tissue is thickest, averaged over its surroundings.

        The middle part is that along its length, and farther from an open border than half as far as any vertex there.

        Raises:
            InvalidInput: no vertex is there.
        """
        v, room = layer.vertices, border_distance(layer)
        along = (v - v.mean(axis=0)) @ _long_axis(layer)
        some = np.flatnonzero(np.abs(along) < MIDDLE * np.ptp(along))
        if not len(some):
            raise InvalidInput("no vertex is in the middle part of the limb. Mesh it more finely (stmpl_core.remesh), "
                               "or name a vertex: Site(layer, 0).")  # fmt: skip
        some = some[room[some] >= 0.5 * room[some].max()]
        tree, thickness = KDTree(v[some]), layer.thickness[some]
        thick = np.array([thickness[tree.query_ball_point(one, 2 * SMOOTH_M)].mean() for one in v[some]])
        return cls(layer, int(some[(thick / thick.max() - np.abs(along[some]) / np.ptp(along)).argmax()]))

    @cached_property
    def point(self) -> np.ndarray:
        """Position, layer axes, (3,) [m]."""
        return self.layer.vertices[self.vertex]

    @cached_property
    def normal(self) -> np.ndarray:
        """Outward unit normal, averaged around, (3,) [-]."""
        return self.normal_at(self.point)

    @cached_property
    def along(self) -> np.ndarray:
        """Unit vector along the limb, square to the normal, (3,) [-]."""
        axis = _long_axis(self.layer)
        axis = axis - (axis @ self.normal) * self.normal
        return axis / np.linalg.norm(axis)

    def normal_at(self, point: np.ndarray) -> np.ndarray:
        """Outward unit normal around a point on the skin, averaged by area and nearness, (3,) [-]."""
        away = np.linalg.norm(self.layer.vertices - point, axis=1)
        sum_ = np.exp(-0.5 * (away / SMOOTH_M) ** 2) @ self.layer.vertex_area_vectors
        return sum_ / np.linalg.norm(sum_)

    def on_skin(self, across: float, along: float) -> np.ndarray:
        """Point of the skin over a place in the site's tangent plane [m], (3,). Raises InvalidInput: no skin there."""
        axes = np.cross(self.along, self.normal), self.along
        start = self.point + across * axes[0] + along * axes[1] + 0.05 * self.normal
        corners = self.layer.vertices[self.layer.faces]
        hits = _hits(corners, start, -self.normal)
        if not len(hits):
            raise InvalidInput(f"there is no skin {1e3 * np.hypot(across, along):.0f} mm beside the site. "
                               "Take a smaller circle, or another site.")  # fmt: skip
        return start - float(hits.min()) * self.normal

    def circle(self, radius: float) -> Circle:
        """A circle around the site, laid on the skin. Raises InvalidInput: no radius, or it leaves the skin."""
        if not radius > 0:
            raise InvalidInput(f"the circle is {radius:g} m; a radius above 0 is needed. Without circles: --laps 0.")
        angle = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
        points = np.array([self.on_skin(radius * np.cos(a), radius * np.sin(a)) for a in angle])
        normals = np.array([self.normal_at(p) for p in points])
        both = np.fft.rfft(np.concatenate([points, normals], axis=1), axis=0) / SAMPLES
        return Circle(self, radius, both[: HARMONICS + 1])


class Place(NamedTuple):
    """A place on a circle, layer axes, (3,) each.

    Args:
        point: point [m].
        slope: derivative of the point by the angle [m/rad].
        bend: second derivative of the point [m/rad2].
        normal: outward unit normal [-].
        tilt: derivative of the normal by the angle [1/rad].
        curl: second derivative of the normal [1/rad2].
    """

    point: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    normal: np.ndarray
    tilt: np.ndarray
    curl: np.ndarray


@dataclass(frozen=True, eq=False)
class Circle:
    """A closed course along the skin, smooth.

    Args:
        site: place around which it goes.
        radius: radius in the tangent plane [m].
        harmonics: Fourier coefficients of points and normals over the angle, (HARMONICS + 1, 6).
    """

    site: Site
    radius: float
    harmonics: np.ndarray

    @cached_property
    def _derived(self) -> tuple[np.ndarray, np.ndarray]:
        """Orders k, (HARMONICS + 1,), and of points and normals and of their first two derivatives by the angle the
        coefficients of cos(k angle), then of sin, (2 HARMONICS + 2, 18).
        """
        k = np.arange(len(self.harmonics), dtype=float)[:, None]
        twice = np.where(k == 0, 1.0, 2.0) * self.harmonics
        every = np.concatenate([twice * (1j * k) ** order for order in range(3)], axis=1)
        return k[:, 0], np.concatenate([every.real, -every.imag])

    def at(self, angle: float) -> Place:
        """What lies at an angle [rad]."""
        k, derived = self._derived
        turned = angle * k
        values, rates, bends = (np.concatenate([np.cos(turned), np.sin(turned)]) @ derived).reshape(3, 6)
        size = math.sqrt(values[3:] @ values[3:])
        normal = values[3:] / size
        shrink = rates[3:] @ normal / size
        tilt = rates[3:] / size - shrink * normal
        curl = bends[3:] / size - 2 * shrink * tilt
        return Place(values[:3], rates[:3], bends[:3], normal, tilt, curl - (curl @ normal) * normal)


def _long_axis(layer: SoftLayer) -> np.ndarray:
    return np.linalg.svd(layer.vertices - layer.vertices.mean(axis=0), full_matrices=False)[2][0]


def _hits(corners: np.ndarray, start: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Distances along a ray at which it meets triangles (F, 3, 3), (N,) [m] (Moeller and Trumbore 1997)."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(way, e2)
    det = np.einsum("ij,ij->i", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = start - a
        u = np.einsum("ij,ij->i", s, p) / det
        q = np.cross(s, e1)
        v, t = (q @ way) / det, np.einsum("ij,ij->i", q, e2) / det
        return t[(np.abs(det) > 1e-18) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)]
