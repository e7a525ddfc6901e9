"""Deep: tools that reach the core, or are inside the limb: where they are drawn back to, to be answered for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from stmpl_core.arrays import Transform
from stmpl_core.columns import Columns, Squeeze, middle_of, shifted
from stmpl_core.sdf import SignedDistance

DEEPEST = 0.9  # depth over thickness beyond which a tool is answered for where it is drawn back to that
LOOKED_AT, FIRST = 64, 8  # points of a tool that are looked at; so many first, to see whether any is inside
FACING = 0.3  # cosine to the mean of the skin's normals from which a column says which way is out
ACCURACY = 1e-4  # of the way that a tool is drawn back, over the thickness


class Deep:
    """Tells whether tools are inside a limb, and draws them back to where DEEPEST of the layer is left to them.

    Args:
        columns: columns of the layer.
    """

    def __init__(self, columns: Columns) -> None:
        self.columns, self.layer = columns, columns.layer
        self._tree: KDTree | None = None

    @cached_property
    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the skin, (3,) each [m]."""
        return self.columns.points.min(axis=0), self.columns.points.max(axis=0)

    @cached_property
    def _edge(self) -> np.ndarray:
        """Mask of the vertices on the open border, (V,)."""
        edge = np.zeros(len(self.columns.points), dtype=bool)
        edge[self.layer.border] = True
        return edge

    def strain(self, squeeze: Squeeze) -> float:
        """Largest depth over the thickness, of vertices and nodes [-]."""
        at_vertices = squeeze.depth / self.layer.thickness[squeeze.vertices]
        return max(float(at_vertices.max(initial=0.0)), float(squeeze.nodes.strain.max(initial=0.0)))

    def inside(self, field: SignedDistance, pose: Transform, points: np.ndarray) -> bool:
        """Whether most of a tool's points (N, 3) [m], in its frame, are under the skin.

        The limb goes on where it is cut off: what is nearest to its open border is not inside.
        """
        centre, (low, high) = middle_of(field, pose), self._box
        if (centre < low).any() or (centre > high).any():
            return False
        return any(self._under(points[:: max(1, len(points) // FIRST)] @ pose[:3, :3].T + pose[:3, 3])) and \
            bool(self._under(points[:: max(1, len(points) // LOOKED_AT)] @ pose[:3, :3].T + pose[:3, 3]).mean() > 0.5)

    def _under(self, points: np.ndarray) -> np.ndarray:
        """Mask of the points (N, 3) [m] of the body's frame that are under the skin, (N,)."""
        nearest = self._nearest(points)
        under = np.einsum("nx,nx->n", points - self.columns.points[nearest], self.columns.inward[nearest]) > 0
        return under & ~self._edge[nearest]

    def drawn_back(
        self, field: SignedDistance, pose: Transform, points: np.ndarray, squeeze: Squeeze
    ) -> tuple[Transform, Squeeze, float]:
        """Pose and squeeze where a tool with these points is drawn back to along the skin's normal, and the way [m].

        A tool that closes around the limb cannot be drawn back: it stays.
        """
        out = self._out(field, pose, squeeze)
        if out is None:
            return pose, squeeze, 0.0
        thickness = float(self.layer.thickness.max())

        def there(way: float) -> float:
            at = shifted(pose, way * out)
            found = self.columns.squeezed(field, at)
            return self.strain(found) if len(found.nodes.area) else float(self.inside(field, at, points))

        low, high = 0.0, 0.1 * thickness
        while there(high) > DEEPEST and high < 1e3 * thickness:
            low, high = high, 2 * high
        way = _root(lambda x: there(x) - DEEPEST, low, high, ACCURACY * thickness)
        at = shifted(pose, way * out)
        return at, self.columns.squeezed(field, at), way

    def _nearest(self, points: np.ndarray) -> np.ndarray:
        if self._tree is None:
            self._tree = KDTree(self.columns.points)
        return np.asarray(self._tree.query(points)[1])

    def _out(self, field: SignedDistance, pose: Transform, squeeze: Squeeze) -> np.ndarray | None:
        """The mean normal of the skin over the tool, (3,); None where there is no such direction."""
        v = squeeze.vertices[squeeze.depth > 0]
        if not len(v):
            return -self.columns.inward[int(self._nearest(middle_of(field, pose)[None])[0])]
        vectors = self.layer.vertex_area_vectors[v]
        mean = vectors.sum(axis=0)
        size = float(np.linalg.norm(mean))
        return mean / size if size > FACING * float(self.layer.vertex_areas[v].sum()) else None


def _root(value: Callable[[float], float], low: float, high: float, accuracy: float) -> float:
    """Where a falling function is 0 between two places, by bisection."""
    while high - low > accuracy:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if value(middle) > 0 else (low, middle)
    return high
