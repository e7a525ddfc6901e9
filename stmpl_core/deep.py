"""Deep: tools that reach the core, or are inside the limb: where they are drawn back to, to be answered for."""

from __future__ import annotations

from functools import cached_property

import numba
import numpy as np

from stmpl_core.arrays import Transform
from stmpl_core.columns import Columns, Squeeze, grid_of, middle_of, shifted
from stmpl_core.layer import SoftLayer
from stmpl_core.rays import UNSAID, depth_and_share, distance_in_column, ray_of, wall_in
from stmpl_core.sdf import SignedDistance

DEEPEST = 0.9  # depth over thickness beyond which a tool is answered for where it is drawn back to that
LOOKED_AT, FIRST = 64, 8  # points of a tool that are looked at; so many first, to see whether any is inside
FACING = 0.3  # cosine to the mean of the skin's normals from which a column says which way is out
BELOW = 3.0  # way beyond the core of an open sheet to which a tool is looked for, over the thickness
FAR = 2.0  # way that a tool is drawn back, over the thickness, from which it is looked for again
EVEN, MOST_EVEN = 0.2, 41  # steps of that, over the thickness, and one more than there are
ACCURACY = 1e-4  # of the way that a tool is drawn back, over the thickness


def where_inside(layer: SoftLayer) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of where a tool's middle may be inside a limb, (3,) each [m].

    It goes on all around by BELOW of the thickness, for the sake of an open sheet: below that a tool is not apart.
    """
    both, more = np.concatenate([layer.vertices, layer.inner_vertices]), BELOW * float(layer.thickness.max())
    return both.min(axis=0) - more, both.max(axis=0) + more


class Deep:
    """Tells whether tools are inside a limb, and draws them back to where DEEPEST of the layer is left to them.

    Args:
        columns: columns of the layer.
    """

    def __init__(self, columns: Columns) -> None:
        self.columns, self.layer = columns, columns.layer

    @cached_property
    def _looked(self) -> tuple[np.ndarray, np.ndarray]:
        return where_inside(self.layer)

    @cached_property
    def _edge(self) -> np.ndarray:
        """Mask of the vertices on the open border, (V,)."""
        edge = np.zeros(len(self.columns.points), dtype=bool)
        edge[self.layer.border] = True
        return edge

    def strain(self, squeeze: Squeeze) -> float:
        """Largest depth over the thickness, of vertices and nodes [-]."""
        return _most(squeeze.depth, self.layer.thickness, squeeze.vertices, squeeze.nodes.strain)

    def inside(self, field: SignedDistance, pose: Transform, points: np.ndarray) -> bool:
        """Whether most of a tool's points (N, 3) [m], in its frame, are under the skin.

        The limb goes on where it is cut off: what is nearest to its open border is not inside.
        """
        centre, (low, high) = middle_of(field, pose), self._looked
        if (centre < low).any() or (centre > high).any():
            return False
        return all(self._under(points[:: max(1, len(points) // many)] @ pose[:3, :3].T + pose[:3, 3]) > share
                   for many, share in ((FIRST, 0.0), (LOOKED_AT, 0.5)))  # fmt: skip

    def _under(self, points: np.ndarray) -> float:
        """Share of points (N, 3) [m] of the body's frame that are under the skin [-]."""
        columns = self.columns
        return _under(points, columns.nearest(points), columns.points, columns.inward, self._edge)

    def drawn_back(
        self, field: SignedDistance, pose: Transform, points: np.ndarray, squeeze: Squeeze
    ) -> tuple[Transform, Squeeze, float]:
        """Pose and squeeze where a tool with these points is drawn back to along the skin's normal, and the way [m].

        A tool that closes around the limb cannot be drawn back: it stays. Ways are tried twice as far each; in a crease
        the room between two folds may lie between two of these, so a way that is far is looked for again in even steps.
        """
        out = self._out(field, pose, squeeze)
        if out is None:
            return pose, squeeze, 0.0
        thickness = float(self.layer.thickness.max())
        low, high = 0.0, 0.1 * thickness
        while self.beyond(field, shifted(pose, high * out), points) and high < 1e3 * thickness:
            low, high = high, 2 * high
        if high > FAR * thickness:
            for way in EVEN * thickness * np.arange(1, MOST_EVEN):
                if way < low and not self.beyond(field, shifted(pose, way * out), points):
                    low, high = way - EVEN * thickness, way
                    break
        some = self._which_may_be(field, shifted(pose, 0.5 * (low + high) * out), 0.5 * (high - low))
        while high - low > ACCURACY * thickness:
            way = 0.5 * (low + high)
            deeper = self.beyond(field, shifted(pose, way * out), points, some)
            low, high = (way, high) if deeper else (low, way)
        at = shifted(pose, high * out)
        return at, self.columns.squeezed(field, at), high

    def beyond(self, field: SignedDistance, pose: Transform, points: np.ndarray,
               some: np.ndarray | None = None) -> bool:  # fmt: skip
        """Whether a tool squeezes a column beyond DEEPEST; of one that squeezes none, whether it is inside.

        Most columns are told by a distance or two; all is squeezed only where these do not say. Nodes never say: their
        strain ends at MAX_COLUMN_STRAIN.

        Args:
            field: distance field of the tool.
            pose: pose_body_from_tool, (4, 4).
            points: points of the tool, in its frame, (N, 3) [m].
            some: numbers of all columns that may be squeezed so far; None: found here.
        """
        some = self._which_may_be(field, pose, 0.0) if some is None else some
        said = _said(grid_of(field), pose, self.columns.points, self.columns.inward, self.layer.thickness, some)
        if said >= 0:
            return said > 0
        found = self.columns.squeezed(field, pose)
        return self.strain(found) > DEEPEST if len(found.nodes.area) else self.inside(field, pose, points)

    def _which_may_be(self, field: SignedDistance, pose: Transform, moved: float) -> np.ndarray:
        """Numbers of all columns that a tool at its pose, or moved from it that far [m], may squeeze beyond DEEPEST."""
        columns = self.columns
        near = columns.near(field, pose, self.layer.edge_length + moved)
        return _reached(grid_of(field), pose, columns.points, columns.inward, self.layer.thickness, near, moved)

    def _out(self, field: SignedDistance, pose: Transform, squeeze: Squeeze) -> np.ndarray | None:
        """The mean normal of the skin over the tool, (3,); None where there is no such direction."""
        v = squeeze.vertices[squeeze.depth > 0]
        if not len(v):
            return -self.columns.inward[int(self.columns.nearest(middle_of(field, pose)[None])[0])]
        vectors = self.layer.vertex_area_vectors[v]
        mean = vectors.sum(axis=0)
        size = float(np.linalg.norm(mean))
        return mean / size if size > FACING * float(self.layer.vertex_areas[v].sum()) else None


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _under(points, nearest, skin, inward, edge):
    """Share of points (N, 3) that are further in than the vertices that are nearest to them, (N,), off the border."""
    many = 0
    for n in range(len(points)):
        v, into = nearest[n], 0.0
        for x in range(3):
            into += (points[n, x] - skin[v, x]) * inward[v, x]
        many += into > 0 and not edge[v]
    return many / max(len(points), 1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _most(depth, thickness, vertices, strain):
    """See Deep.strain; numpy's own calls take three times as long."""
    most = 0.0
    for n in range(len(depth)):
        most = max(most, depth[n] / thickness[vertices[n]])
    for n in range(len(strain)):
        most = max(most, strain[n])
    return most


@numba.njit(cache=True, nogil=True)
def _reached(grid, pose, points, inward, thickness, near, moved):
    """Those of `near` whose last tenth the tool may reach; half of it more is for what distances are off by."""
    out, count = np.empty(len(near), np.int64), 0
    for v in near:
        t, ray = thickness[v], ray_of(pose, points, inward, v)
        if distance_in_column(grid, ray, 0.5 * (1 + DEEPEST) * t) <= (1 - DEEPEST) * t + moved:
            out[count] = v
            count += 1
    return out[:count]


@numba.njit(cache=True, nogil=True)
def _said(grid, pose, points, inward, thickness, some):
    """What columns say without their neighbours: 1, one is squeezed beyond DEEPEST; 0, some, and none so far; or -1."""
    touched, unsure, top = False, False, UNSAID.copy()
    for n in range(len(some)):
        v = some[n]
        t, ray = thickness[v], ray_of(pose, points, inward, v)
        above = distance_in_column(grid, ray, 0.0)
        deep, share = depth_and_share(grid, ray, t, top)
        touched = touched or (share == 1 and deep > 0)
        if share * deep / t <= DEEPEST:
            continue
        if min(max(1 - above / wall_in(grid[3], t), 0.0), 1.0) * deep / t <= DEEPEST:  # skin out of its reach
            unsure = True
            continue
        if deep == t and distance_in_column(grid, ray, t + 1e-5) < distance_in_column(grid, ray, t):
            unsure = True  # the tool comes through the core: it counts where its neighbours do
            continue
        return 1
    return 0 if touched and not unsure else -1
