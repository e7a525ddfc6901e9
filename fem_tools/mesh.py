"""WedgeMesh: a patch of skin extruded inwards into wedges, with columns of nodes, quadrature and rest gradients.

A *column* is a skin node with all nodes under it. Columns have 2 L + 1 levels (quadratic through the thickness,
L wedges deep), level 0 on the skin, the last one bonded to the core. In plane the elements are linear ("P1xP2",
columns at the vertices) or quadratic ("P2xP2", columns at the vertices and at the middles of the edges). Geometry is
straight-sided.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Literal

import numpy as np
from numba import njit

from fem_tools.neo_hookean import invert
from stmpl_core.arrays import Points
from stmpl_core.errors import MeshError

ElementName = Literal["P1xP2", "P2xP2"]
GRADING = 1.6  # of several wedges through the thickness; halves the error of two equal ones under a sharp-edged load
ELEMENTS: tuple[ElementName, ...] = ("P1xP2", "P2xP2")


@dataclass(frozen=True)
class Reference:
    """Shape functions of one wedge at its quadrature points; node numbers run level-fastest within a column."""

    n_columns: int  # columns a triangle
    shape_value: np.ndarray  # (Q, 3 n_columns)
    shape_gradient: np.ndarray  # (Q, 3 n_columns, 3) with respect to (xi, eta, zeta)
    geometry_value: np.ndarray  # (Q, 3) linear triangle functions
    geometry_gradient: np.ndarray  # (3, 2)
    zeta: np.ndarray  # (Q,) depth within the wedge, 0 outside, 1 inside
    weight: np.ndarray  # (Q,)


@cache
def reference_wedge(element: ElementName, extra: int = 0) -> Reference:
    """Tensor product of scikit-fem's triangle and line elements, with quadrature of `extra` degrees more than needed.

    Two Gauss points a wedge through the thickness: one fewer than full integration, a third cheaper, and half the error
    under a contact's edge, where three points are too stiff in shear.
    """
    from skfem.element import ElementTriP1, ElementTriP2
    from skfem.quadrature import get_quadrature_line, get_quadrature_tri

    plane, degree = (ElementTriP1(), 2) if element == "P1xP2" else (ElementTriP2(), 4)
    xy, w_plane = get_quadrature_tri(degree + extra)
    z, w_depth = get_quadrature_line(3 + extra)
    n, m, q_plane, q_depth = (3 if element == "P1xP2" else 6), 3, xy.shape[1], z.shape[1]
    tri = [plane.lbasis(xy, i) for i in range(n)]
    line = _line_basis(z)
    values, gradient = np.zeros((q_plane, q_depth, n, m)), np.zeros((q_plane, q_depth, n, m, 3))
    for a, (value, slope) in enumerate(tri):
        for level, (depth, depth_slope) in enumerate(line):
            value_, slope_ = np.broadcast_to(value, q_plane), np.broadcast_to(slope, (2, q_plane))
            values[:, :, a, level] = np.outer(value_, depth)
            gradient[:, :, a, level, 0] = np.outer(slope_[0], depth)
            gradient[:, :, a, level, 1] = np.outer(slope_[1], depth)
            gradient[:, :, a, level, 2] = np.outer(value_, depth_slope)
    linear = np.stack([1 - xy[0] - xy[1], xy[0], xy[1]], axis=1)
    return Reference(
        n_columns=n,
        shape_value=values.reshape(q_plane * q_depth, n * m),
        shape_gradient=gradient.reshape(q_plane * q_depth, n * m, 3),
        geometry_value=np.repeat(linear, q_depth, axis=0),
        geometry_gradient=np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]]),
        zeta=np.tile(z[0], q_plane),
        weight=np.outer(w_plane, w_depth).ravel(),
    )


def _line_basis(z: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Quadratic line functions ordered outside, middle, inside (scikit-fem orders ends first)."""
    from skfem.element import ElementLineP2

    element = ElementLineP2()
    values = [element.lbasis(z, i) for i in (0, 2, 1)]
    return [(np.asarray(phi), np.asarray(dphi)[0]) for phi, dphi in values]


@cache
def linear_tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors of the "P1xP2" wedge's shape functions: phi (2, 3), its slope (2, 3), and L (3, 3), a row a point."""
    ref = reference_wedge("P1xP2")
    line = _line_basis(ref.zeta[None, :2])
    phi, slope = np.stack([value for value, _ in line], axis=1), np.stack([rise for _, rise in line], axis=1)
    return phi, slope, np.ascontiguousarray(ref.geometry_value[::2])


@dataclass(frozen=True)
class SkinReference:
    """In-plane shape functions on the skin, exact for a linear pressure on a deformed face."""

    value: np.ndarray  # (Q, n)
    slope: np.ndarray  # (Q, n, 2)
    linear: np.ndarray  # (Q, 3)
    weight: np.ndarray  # (Q,)


@cache
def reference_skin(element: ElementName, degree: int | None = None) -> SkinReference:
    """Quadrature of a degree; None: 2 (linear in plane) or 5 (quadratic), for the follower load."""
    from skfem.element import ElementTriP1, ElementTriP2
    from skfem.quadrature import get_quadrature_tri

    plane, enough, n = (ElementTriP1(), 2, 3) if element == "P1xP2" else (ElementTriP2(), 5, 6)
    xy, weight = get_quadrature_tri(degree or enough)
    basis = [plane.lbasis(xy, i) for i in range(n)]
    return SkinReference(
        value=np.stack([np.broadcast_to(phi, len(weight)) for phi, _ in basis], axis=1),
        slope=np.stack([np.broadcast_to(dphi, (2, len(weight))).T for _, dphi in basis], axis=1),
        linear=np.stack([1 - xy[0] - xy[1], xy[0], xy[1]], axis=1),
        weight=weight,
    )


@dataclass(frozen=True, eq=False)
class WedgeMesh:
    """A meshed patch, ready for the kernels. Made by `WedgeMesh.of`.

    Attributes:
        element: "P1xP2" or "P2xP2".
        layers: wedges through the thickness.
        outer, inner: end points of the columns at the triangle corners, (N, 3) [m].
        ends: depths at which the wedges end, as shares of the columns at the corners, (N, L + 1), or of all of them,
            (1, L + 1) [-].
        triangles: corners of each triangle, (T, 3), numbers of `outer`.
        columns: columns of each triangle, (T, n).
        edges: edges whose middles carry the columns N, N + 1, ... (quadratic only), (E, 2).
        n_columns: number of columns.
        natural: gradients of xi, eta and zeta at rest, (T L, Q, 3, 3) [1/m].
        volumes: quadrature weight times det, (T L, Q) [m3].
        indptr, indices: block rows of the tangent, one block a pair of columns that share a triangle.
        blocks: number of the block of each pair of columns of a triangle, (T, n, n).
        ply_scale: factor on the depths at which materials begin below each corner, (N,) [-]; None: 1.
    """

    element: ElementName
    layers: int
    outer: Points
    inner: Points
    ends: np.ndarray
    triangles: np.ndarray
    columns: np.ndarray
    edges: np.ndarray
    n_columns: int
    natural: np.ndarray
    volumes: np.ndarray
    indptr: np.ndarray
    indices: np.ndarray
    blocks: np.ndarray
    ply_scale: np.ndarray | None = None

    @classmethod
    def of(
        cls, outer: Points, inner: Points, triangles: np.ndarray, element: ElementName = "P1xP2", layers: int = 1,
        ends: np.ndarray | None = None, ply_scale: np.ndarray | None = None,
    ) -> WedgeMesh:  # fmt: skip
        """Meshes the space between two copies of a triangulation.

        Args:
            outer, inner: end points of the columns, (N, 3) each [m].
            triangles: corners of the triangles, (T, 3).
            element: element in plane and through the thickness.
            layers: wedges through the thickness, if `ends` is None.
            ends: see WedgeMesh; None: those of `level_depths`, the same in all columns.
            ply_scale: see WedgeMesh.

        Raises:
            MeshError: a wedge is folded at rest (its map has a determinant that is not positive).
        """
        columns, edges, n_columns = _columns(triangles, len(outer), element)
        ends = level_depths(layers)[None, ::2] if ends is None else ends
        layers = ends.shape[1] - 1
        natural, volumes = _rest(outer, inner, triangles, reference_wedge(element), layers, ends)
        if len(bad := folding(triangles, volumes, layers)):
            raise MeshError(f"the layer folds on itself below {len(bad)} vertices of the patch: {_some(bad)}.")
        indptr, indices, blocks = _block_pattern(columns, n_columns)
        return cls(
            element,
            layers,
            outer,
            inner,
            ends,
            triangles,
            columns,
            edges,
            n_columns,
            natural,
            volumes,
            indptr,
            indices,
            blocks,
            ply_scale,
        )

    @cached_property
    def gradients(self) -> np.ndarray:
        """Gradients of the shape functions at rest, (T L, Q, 3 n, 3) [1/m]; made where asked for."""
        return reference_wedge(self.element).shape_gradient @ self.natural

    @property
    def levels(self) -> int:
        """Levels of nodes in a column, the bonded one included."""
        return 2 * self.layers + 1

    def part(self, chosen: np.ndarray) -> WedgeMesh:
        """The wedges below some triangles, a mask (T,), with all columns and blocks numbered as they are."""
        wedges = np.repeat(chosen, self.layers)
        return replace(
            self, triangles=self.triangles[chosen], columns=self.columns[chosen], blocks=self.blocks[chosen],
            natural=self.natural[wedges], volumes=self.volumes[wedges],
        )  # fmt: skip

    def column_ends(self) -> tuple[Points, Points]:
        """Outer and inner end of every column, each (n_columns, 3) [m]."""
        if not len(self.edges):
            return self.outer, self.inner
        return (
            np.vstack([self.outer, self.outer[self.edges].mean(axis=1)]),
            np.vstack([self.inner, self.inner[self.edges].mean(axis=1)]),
        )

    def rest_positions(self) -> np.ndarray:
        """Rest position of every node, (n_columns, levels, 3) [m]."""
        if len(self.ends) == 1:
            (outer, inner), depth = self.column_ends(), self.depths()[:, :, None]
            return outer[:, None] * (1 - depth) + inner[:, None] * depth
        depth = _with_middles(self.ends)[:, :, None]
        return self.on_columns(self.outer[:, None] * (1 - depth) + self.inner[:, None] * depth)

    def depths(self) -> np.ndarray:
        """Depth of each level of nodes, 0 at the skin, 1 at the core, (n_columns, levels) or (1, levels) [-]."""
        depth = _with_middles(self.ends)
        return depth if len(depth) == 1 else self.on_columns(depth)

    def on_columns(self, corner_values: np.ndarray) -> np.ndarray:
        """Extends values at the triangle corners, (N, ...), linearly to all columns."""
        if not len(self.edges):
            return corner_values
        return np.concatenate([corner_values, corner_values[self.edges].mean(axis=1)])

    def to_corners(self, column_forces: np.ndarray) -> np.ndarray:
        """Hands forces on all columns to the triangle corners, keeping their sum: (n_columns, ...) to (N, ...)."""
        corners = column_forces[: len(self.outer)].copy()
        np.add.at(corners, self.edges.ravel(), np.repeat(column_forces[len(self.outer) :] / 2, 2, axis=0))
        return corners

    def border_columns(self) -> np.ndarray:
        """Mask of the columns on the patch's border, (n_columns,)."""
        pairs, n = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), len(self.outer)
        unique, count = np.unique(pairs[:, 0] * n + pairs[:, 1], return_counts=True)
        mask = np.zeros(self.n_columns, dtype=bool)
        mask[unique[count == 1] // n] = mask[unique[count == 1] % n] = True
        if len(self.edges):
            mask[len(self.outer) :] = count == 1  # unique edges are in the order of self.edges
        return mask


def level_depths(layers: int) -> np.ndarray:
    """Depth of each level of nodes, 0 at the skin, 1 at the core; the wedges grow with depth as shear fades."""
    return _with_middles(np.linspace(0, 1, layers + 1)[None] ** GRADING)[0]


def _with_middles(ends: np.ndarray) -> np.ndarray:
    """Depths of all levels, (N, 2 L + 1), of those at which wedges end, (N, L + 1)."""
    return np.sort(np.concatenate([ends, (ends[:, 1:] + ends[:, :-1]) / 2], axis=1), axis=1)


def split(triangles: np.ndarray, n_vertices: int, marked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Splits the marked triangles in four, their neighbours as conformity asks (red-green; Bank et al. 1983).

    Args:
        triangles: corners of the triangles, (T, 3).
        n_vertices: number of vertices before; the new ones are numbered from here.
        marked: mask of the triangles to split, (T,).

    Returns:
        The new triangles, and the edges whose middles are the new vertices, (N, 2).
    """
    columns, edges, _ = _columns(triangles, n_vertices, "P2xP2")
    sides = columns[:, 3:] - n_vertices  # edges ab, bc, ca
    cut = np.zeros(len(edges), dtype=bool)
    cut[sides[marked]] = True
    while (partly := cut[sides].sum(axis=1) == 2).any():
        cut[sides[partly]] = True
    number = np.where(cut, n_vertices + np.cumsum(cut) - 1, -1)
    (a, b, c), (ab, bc, ca) = triangles.T, number[sides].T
    count = cut[sides].sum(axis=1)
    red, out = count == 3, [triangles[count == 0]]
    for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)):
        out.append(np.stack(corners, axis=1)[red])
    for p, q, r, pq in ((a, b, c, ab), (b, c, a, bc), (c, a, b, ca)):
        green = (count == 1) & (pq >= 0)
        out += [np.stack((p, pq, r), axis=1)[green], np.stack((pq, q, r), axis=1)[green]]
    return np.vstack(out), edges[cut]


def _columns(triangles: np.ndarray, n: int, element: ElementName) -> tuple[np.ndarray, np.ndarray, int]:
    if element == "P1xP2":
        return np.ascontiguousarray(triangles, dtype=np.int64), np.zeros((0, 2), dtype=np.int64), n
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1)
    edges, number = np.unique(pairs, axis=0, return_inverse=True)
    columns = np.hstack([triangles, n + number.reshape(-1, 3)])
    return np.ascontiguousarray(columns, dtype=np.int64), edges.astype(np.int64), n + len(edges)


def folding(triangles: np.ndarray, volumes: np.ndarray, layers: int) -> np.ndarray:
    """Numbers of the vertices around wedges that fold at rest, by their integration weights (T L, Q)."""
    return np.unique(triangles[np.flatnonzero((volumes <= 0).any(axis=1)) // layers])


def rest_gradients(
    outer: Points, inner: Points, triangles: np.ndarray, ref: Reference, layers: int, ends: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Shape gradients (T L, Q, 3 n, 3) [1/m] and integration weights (T L, Q) [m3] at rest; weight 0 if singular.

    `ends`: see WedgeMesh; None: those of `level_depths`.
    """
    natural, volumes = _rest(outer, inner, triangles, ref, layers, ends)
    return ref.shape_gradient @ natural, volumes


def _rest(
    outer: Points, inner: Points, triangles: np.ndarray, ref: Reference, layers: int, ends: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """WedgeMesh.natural and the integration weights."""
    shape = (len(triangles) * layers, len(ref.weight))
    natural, volumes = np.empty((*shape, 3, 3)), np.empty(shape)
    ends = level_depths(layers)[None, ::2] if ends is None else ends
    ends = np.ascontiguousarray(np.broadcast_to(ends, (len(outer), layers + 1)))
    _fill_rest(outer, inner, triangles, ends, ref.geometry_value, ref.geometry_gradient, ref.zeta, ref.weight,
               natural, volumes)  # fmt: skip
    return natural, volumes


@njit(cache=True)
def _fill_rest(outer, inner, triangles, ends, value, plane, zeta, weight, natural, volumes):
    layers, jacobian = ends.shape[1] - 1, np.empty((3, 3))
    for t in range(len(triangles)):
        for layer in range(layers):
            e = t * layers + layer
            for q in range(len(weight)):
                for i in range(3):  # dX_i / d(xi, eta, zeta)
                    jacobian[i] = 0.0
                    for a in range(3):
                        c = triangles[t, a]
                        near, far = ends[c, layer], ends[c, layer + 1]
                        depth = near + (far - near) * zeta[q]
                        along = inner[c, i] - outer[c, i]
                        x = outer[c, i] + depth * along
                        jacobian[i, 0] += x * plane[a, 0]
                        jacobian[i, 1] += x * plane[a, 1]
                        jacobian[i, 2] += (far - near) * along * value[q, a]
                # (xi, eta) run counter-clockwise seen from outside and zeta inwards: left-handed, so minus det
                volumes[e, q] = -invert(jacobian, natural[e, q]) * weight[q]


def _block_pattern(columns: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compressed block rows of the column graph, and the block number of each pair of a triangle's columns."""
    width = columns.shape[1]
    rows, cols = np.repeat(columns, width, axis=1).ravel(), np.tile(columns, (1, width)).ravel()
    keys, number = np.unique(rows * n + cols, return_inverse=True)
    indptr = np.searchsorted(keys // n, np.arange(n + 1))
    return indptr.astype(np.int64), (keys % n).astype(np.int64), number.reshape(-1, width, width).astype(np.int64)


def _some(numbers: np.ndarray, most: int = 8) -> str:
    return ", ".join(map(str, numbers[:most])) + (", ..." if len(numbers) > most else "")
