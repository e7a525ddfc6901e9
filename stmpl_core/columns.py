"""Columns: which columns of skin a tool squeezes, and how deep it is in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from functools import cached_property
from itertools import permutations
from typing import Any, NamedTuple

import numba
import numpy as np

from stmpl_core.arrays import Points, Transform, inverted
from stmpl_core.compiling import UNCOUNTED
from stmpl_core.layer import SoftLayer
from stmpl_core.nodes import (
    Nodes,
    ball_around,
    between_corners,
    column_between,
    met_between,
    nodes_under,
    strains_beside,
)
from stmpl_core.rays import (
    ANYHOW,
    ASLANT,
    NOT_SUNK,
    UNSAID,
    WALL,
    depth_and_share,
    depth_in_column,
    distance_in_column,
    inside_most,
    led_in,
    ray_from,
    ray_of,
    sure_of,
    swept,
    to_tool,
    wall_in,
    way_of,
)
from stmpl_core.sdf import THICK, SignedDistance
from stmpl_core.soundness import too_long
from stmpl_core.touch import MIN_ONE_WAY_SHARE

LEAST_UNDER, ALL_UNDER = 0.05, 0.3  # how much further inside a tool a column gets below its skin than there, or nearer
# to it than there and at its core, over the width of a wall, where the tool begins to sink under skin, and where it has
BLOCK = 32  # columns that are looked at together
FINEST = 0.02  # size of the parts of a long triangle at which the search for a tool in it ends, over the thickness
AS_ONE = 1.8, 2.3  # distance of two tools' middles over the sum of their radii of gyration, up to which they press as
# parts of one, and from which each its own way: quarters of a ball that share a side are up to 1.7 apart
SHEET, LEAST_MISSED = 0.5, 0.35  # thickness of a tool over its second longest side, and an edge over that, from which
# vertices' columns may miss that it leans under skin
BETWEEN, MOST_BETWEEN = 1.5, 5  # parts of half an edge of which one is as long as a third of that side; at most
HOLE_RADIUS = 0.6  # farthest point of a triangle from its corners, over the edge length (equilateral: 0.577)


class Squeeze(NamedTuple):
    """Columns under a tool at its pose.

    Args:
        vertices: numbers of the vertices whose triangles it touches, (N,).
        depth: depth of the tool under the vertex itself, 0 where it is not covered, (N,) [m].
        rests: share from 0, not covered, to 1, WALL of the thickness inside the tool's walls and its skin, (N,) [-].
        nodes: contact nodes.
        top: see nodes_under, (3,).
        push: sum of its nodes' inward normals by area and depth, also of tools beside with which it presses as one: its
            skin goes that way; 0 where they have no one way, and of one material, (3,) [m3].
    """

    vertices: np.ndarray
    depth: np.ndarray
    rests: np.ndarray
    nodes: Nodes
    top: np.ndarray = NOT_SUNK
    push: np.ndarray = np.zeros(3)


NO_SQUEEZE = Squeeze(np.empty(0, np.int64), np.empty(0), np.empty(0), Nodes.none())


class Clearance(NamedTuple):
    """Distance of a tool from columns.

    Args:
        vertices: numbers of the columns' vertices, (N,).
        least: signed distance along each column (N,) [m]; inf where the tool comes through the core.
        skin: signed distance at its skin, (N,) [m].
        nearest: smallest of `least` [m]; inf where there is none.
    """

    vertices: np.ndarray
    least: np.ndarray
    skin: np.ndarray
    nearest: float


class Columns:
    """The columns of a layer, skin to core, with their triangles around them.

    Args:
        layer: soft layer at rest.

    Attributes:
        long: numbers of triangles that are too long for a tool between their corners to be found; none of a good mesh.
    """

    def __init__(self, layer: SoftLayer) -> None:
        self.layer, self.long = layer, too_long(layer)
        self.points, self.inward = layer.vertices, np.ascontiguousarray(-layer.normals)
        self.faces = np.ascontiguousarray(layer.faces, dtype=np.int64)
        corners = self.faces.ravel()
        self._around = np.argsort(corners, kind="stable") // 3  # faces around each vertex
        self._start = np.searchsorted(np.sort(corners), np.arange(len(self.points) + 1))
        self._slot = np.full(len(self.points), -1)
        self._thickest = float(layer.thickness.max())
        self._tree = True  # a tree of boxes pays for itself only where the skin stays
        self._order = _along_a_curve(self.points)
        self._blocks = _balls(self.points, layer.thickness, self._order)

    def moved(self, layer: SoftLayer) -> Columns:
        """The same columns where joints take the skin."""
        out = copy(self)
        out.__dict__.pop("_skin", None)
        out.layer, out.points, out.inward = layer, layer.vertices, np.ascontiguousarray(-layer.normals)
        out._tree = False
        out._blocks = _balls(out.points, layer.thickness, self._order)
        return out

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
        """Broad phase: numbers of the vertices whose columns, skin to core, pass the tool's box.

        Args:
            field: distance field of the tool.
            pose: pose_body_from_tool, (4, 4).
            reach: width by which the box is larger than the tool [m].
            many: choice to ask FCL's tree first. That takes 6 us for a tool that is apart, where looking at each vertex
                of an arm takes 14, and 60 us for one that touches: it pays where many tools are, most of them apart.
        """
        low, high = field.tool_bounds
        if many and self._tree:
            import fcl

            at = fcl.Transform(pose[:3, :3], middle_of(field, pose))
            box = fcl.CollisionObject(fcl.Box(*(high - low + 2 * reach)), at)
            if not fcl.collide(self._skin, box):
                return np.empty(0, np.int64)
        skin = self.points, self.inward, self.layer.thickness
        return _through_box(*skin, self._order, self._blocks, pose, low, high, reach)

    def nearest(self, points: Points) -> np.ndarray:
        """Numbers of the vertices nearest to points (N, 3) [m], (N,)."""
        return _nearest(points, self.points, self._order, self._blocks)

    def between(self, field: SignedDistance, pose: Transform, reach: float) -> float:
        """Length of a triangle that is too long, and that a tool meets or is within `reach` of [m]; 0 if there is none.

        Args:
            field, pose: distance field of the tool and pose_body_from_tool, (4, 4).
            reach: see above [m].
        """
        if not len(self.long):
            return 0.0
        finest = FINEST * float(self.layer.thickness.min())
        return met_between(grid_of(field), pose, self.points, self.faces[self.long], reach, finest)

    def squeezed(self, field: SignedDistance, pose: Transform) -> Squeeze:
        """Squeeze of the columns by a tool at its pose."""
        near = self.near(field, pose, self.layer.edge_length)
        return self.squeeze(field, pose, self.clearance(field, pose, near, self.layer.edge_length))

    def clearance(self, field: SignedDistance, pose: Transform, near: np.ndarray, far: float) -> Clearance:
        """Distance of the tool from columns; those further than `far` [m] are only known to be so."""
        return Clearance(near, *clearances(grid_of(field), pose, self.points, self.inward, self.layer.thickness, near,
                                           far))  # fmt: skip

    def squeeze(self, field: SignedDistance, pose: Transform, clearance: Clearance) -> Squeeze:
        """Columns that the tool covers."""
        hole = HOLE_RADIUS * self.layer.edge_length
        if not clearance.nearest < hole:
            return NO_SQUEEZE
        vertices, depth, rests, top, push, *nodes = _squeezed(
            grid_of(field), pose, middle_of(field, pose), self.points, self.inward, self.layer.thickness, self.faces,
            self._start, self._around, self._slot, *clearance[:3], hole, self.layer.stacked, self._order, self._blocks,
            *field.tool_bounds)  # fmt: skip
        return Squeeze(vertices, depth, rests, Nodes(*nodes), top, push)

    def as_one(self, tools: Sequence[tuple[SignedDistance, Transform, Squeeze]]) -> list[Squeeze]:
        """Squeezes of tools that feel each other: those side by side press as parts of one.

        No strain is rounded off where another goes on, and on a stack skin goes one way under them.

        Args:
            tools: distance field, pose_body_from_tool and squeeze of each, all with nodes.
        """
        strains = [squeeze.nodes.strain for *_, squeeze in tools]
        balls = [ball_around(squeeze.nodes.points) for *_, squeeze in tools]
        for k, m in permutations(range(len(tools)), 2):
            if math.dist(balls[k][0], balls[m][0]) > balls[k][1] + balls[m][1] + self._thickest:
                continue
            (field, pose, squeeze), (other, other_pose, _) = tools[k], tools[m]
            between = inverted(other_pose) @ pose
            strains[k] = strains_beside(grid_of(field), pose, grid_of(other), between, *squeeze.nodes[:3], strains[k],
                                        squeeze.top)  # fmt: skip
        out = [squeeze._replace(nodes=squeeze.nodes._replace(strain=strain))
               for (*_, squeeze), strain in zip(tools, strains, strict=True)]  # fmt: skip
        if self.layer.stacked:
            pushes = shared_pushes(np.array([pushed(*squeeze.nodes[:5]) for squeeze in out]))
            for k, ((field, pose, before), push) in enumerate(zip(tools, pushes, strict=True)):
                nodes = out[k].nodes
                if not (np.array_equal(push, before.push) and np.array_equal(nodes.strain, before.nodes.strain)):
                    sinking = _sinking(grid_of(field), pose, *nodes[:5], way_of(before.top)[0], push)
                    out[k] = out[k]._replace(nodes=nodes._replace(sinking=sinking), push=push)
        return out


def middle_of(field: SignedDistance, pose: Transform) -> np.ndarray:
    """Middle of a tool's box, in the body's frame, (3,) [m]."""
    low, high = field.tool_bounds
    return pose[:3, :3] @ ((low + high) / 2) + pose[:3, 3]


def shifted(pose: Transform, by: np.ndarray) -> Transform:
    """The pose, moved by a vector of the body's frame, (3,) [m]."""
    out = pose.copy()
    out[:3, 3] += by
    return out


def grid_of(field: SignedDistance) -> tuple[np.ndarray, np.ndarray, float, float]:
    """What kernels take of a distance field: coefficients, origin, spacing and half thickness."""
    return field.coefficients, field.origin, field.spacing, field.half_thickness


@numba.njit(cache=True, inline="always")
def _parts_between(half, low, high, edge_length):
    """Parts of half an edge between which a tool is looked for under skin: 0 of one that no vertices' columns miss.

    A thin sheet that leans, and that is no wider than a few edges, sinks under skin between them.

    Args:
        half: half of its thickness [m]; no more than THICK is known.
        low, high: corners of its box, (3,) [m].
        edge_length: mean edge length of the skin [m].
    """
    x, y, z = high[0] - low[0], high[1] - low[1], high[2] - low[2]
    wide = max(min(x, y), min(max(x, y), z))
    if half >= THICK or 2 * half > SHEET * wide or edge_length < LEAST_MISSED * wide:
        return 0
    return min(int(np.ceil(BETWEEN * edge_length / max(wide, 1e-12))), MOST_BETWEEN)


def _along_a_curve(points: Points) -> np.ndarray:
    """Numbers of points (N, 3), those near each other in space mostly near each other in order: Morton's, (N,)."""
    cells = (1023 * (points - points.min(axis=0)) / max(float(np.ptp(points, axis=0).max()), 1e-12)).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


@numba.njit(cache=True, nogil=True)
def _balls(points, thickness, order):
    """Middle and radius of a ball around each BLOCK columns in order, (B, 4) [m]."""
    many = (len(order) + BLOCK - 1) // BLOCK
    out = np.zeros((many, 4))
    for b in range(many):
        some = order[b * BLOCK : (b + 1) * BLOCK]
        for v in some:
            for x in range(3):
                out[b, x] += points[v, x] / len(some)
        for v in some:
            square = 0.0
            for x in range(3):
                square += (points[v, x] - out[b, x]) ** 2
            out[b, 3] = max(out[b, 3], np.sqrt(square) + thickness[v])
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _through_box(points, inward, thickness, order, blocks, pose, low, high, reach):
    """Numbers of the columns, rising, that pass a box of the tool's frame that is made larger by a reach [m].

    inward: unit vectors along the columns, (V, 3); or one for all, (1, 3).
    """
    found, n, radius, centre = np.empty(len(points), np.int64), 0, 0.0, pose[:3, 3].copy()
    low, high = low - reach, high + reach
    for x in range(3):
        radius += 0.25 * (high[x] - low[x]) ** 2
        for y in range(3):
            centre[x] += pose[x, y] * 0.5 * (low[y] + high[y])
    radius = np.sqrt(radius)
    for block in range(len(blocks)):
        a, b, c = blocks[block, 0] - centre[0], blocks[block, 1] - centre[1], blocks[block, 2] - centre[2]
        if a * a + b * b + c * c > (radius + blocks[block, 3]) ** 2:
            continue
        for v in order[block * BLOCK : (block + 1) * BLOCK]:
            a, b, c, t = points[v, 0] - centre[0], points[v, 1] - centre[1], points[v, 2] - centre[2], thickness[v]
            if a * a + b * b + c * c > (radius + t) ** 2:
                continue
            x, y, z = to_tool(pose, points[v, 0], points[v, 1], points[v, 2])
            if max(low[0] - x, x - high[0], low[1] - y, y - high[1], low[2] - z, z - high[2]) > t:
                continue
            w = min(v, len(inward) - 1)
            ray, begin, end = ray_from(pose, points[v, 0], points[v, 1], points[v, 2], inward[w, 0], inward[w, 1],
                                       inward[w, 2]), 0.0, t  # fmt: skip
            for x in range(3):  # the part of the column between two sides of the box
                start, way = (ray[0], ray[3]) if x == 0 else (ray[1], ray[4]) if x == 1 else (ray[2], ray[5])
                if abs(way) < 1e-12:
                    end = end if low[x] <= start <= high[x] else -1.0
                    continue
                first, last = (low[x] - start) / way, (high[x] - start) / way
                begin, end = max(begin, min(first, last)), min(end, max(first, last))
            if begin <= end:
                found[n] = v
                n += 1
    return np.sort(found[:n])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _nearest(points, skin, order, blocks):
    """See Columns.nearest: block by block, but for those that lie farther off than a vertex that was met."""
    out = np.zeros(len(points), np.int64)
    for n in range(len(points)):
        p0, p1, p2, least, first = points[n, 0], points[n, 1], points[n, 2], np.inf, 0
        for b in range(len(blocks)):
            x, y, z = blocks[b, 0] - p0, blocks[b, 1] - p1, blocks[b, 2] - p2
            if x * x + y * y + z * z < least:
                least, first = x * x + y * y + z * z, b
        far = np.inf
        for k in range(len(blocks) + 1):
            b = k - 1 if k else first  # of all blocks the nearest one says most
            x, y, z = blocks[b, 0] - p0, blocks[b, 1] - p1, blocks[b, 2] - p2
            if x * x + y * y + z * z > (far + blocks[b, 3]) ** 2:
                continue
            for v in order[b * BLOCK : (b + 1) * BLOCK]:
                x, y, z = skin[v, 0] - p0, skin[v, 1] - p1, skin[v, 2] - p2
                away = np.sqrt(x * x + y * y + z * z)
                if away < far:
                    far, out[n] = away, v
    return out


@numba.njit(cache=True, nogil=True)
def clearances(grid, pose, points, inward, thickness, near, far):
    """Least signed distance along each column [m], by sphere tracing from the skin to the core; and that at the skin.

    A column whose core end lies inside the tool counts only if the tool comes from outside: where the distance still
    rises along the inward normal there.
    """
    out, skin = np.empty(len(near)), np.empty(len(near))
    return out, skin, _clear(grid, pose, points, inward, thickness, near, far, out, skin)


@numba.njit(cache=True, nogil=True, **UNCOUNTED)
def _clear(grid, pose, points, inward, thickness, near, far, out, skin):
    """Writes what `clearances` gives, and returns the least of it [m]."""
    nearest = np.inf
    for n in range(len(near)):
        v = near[n]
        out[n], skin[n] = _along_column(grid, ray_of(pose, points, inward, v), thickness[v], far)
        nearest = min(nearest, out[n])
    return nearest


@numba.njit(forceinline=True, cache=True, **UNCOUNTED)
def _along_column(grid, ray, t, far):
    """Least signed distance along a column, and that at its skin [m]: see `clearances`."""
    above = d = distance_in_column(grid, ray, 0.0)
    if d > t + far:
        return d - t, above  # the rest of the column cannot be nearer
    least, s = d, 0.0
    while s < t:
        step = max(abs(d), d - least, min(t / 16, grid[3]))  # on the way out of the tool nothing nearer comes soon
        s = min(s + step, t)
        d = distance_in_column(grid, ray, s)
        least = min(least, d)
    if d <= 0 and distance_in_column(grid, ray, t + 1e-5) < d:
        least = np.inf
    return least, above


@numba.njit(forceinline=True, cache=True, **UNCOUNTED)
def _further_in(grid, ray, t, least, above, under):
    """How much further inside a tool a column gets below its skin, or nearer to it, than there; and `under` [m]."""
    under = max(under, -least - max(-above, 0.0))
    if above - least > under:  # of a thin tool between two vertices these know that it leans under skin
        under = max(under, min(above, distance_in_column(grid, ray, t)) - least)
    return under


@numba.njit(cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def _under_between(grid, pose, points, inward, thickness, faces, start, around, covered, parts, under, enough):
    """See `_further_in`, of columns between covered vertices too, each in the triangles around the nearest of these.

    Args:
        parts: see `_parts_between`.
        under, enough: what is known, and what ends the search [m].
    """
    for v in covered:
        for p in range(start[v], start[v + 1]):
            f, at = around[p], 0
            for k in range(3):
                if faces[f, k] == v:
                    at = k
            j, k = faces[f, (at + 1) % 3], faces[f, (at + 2) % 3]
            for q in range(parts * parts):
                b, c = (q // parts + 0.5) / (2 * parts), (q % parts + 0.5) / (2 * parts)
                if max(b, c) > 1 - b - c:
                    continue
                x, y, z = between_corners(points, v, j, k, 1 - b - c, b, c)
                n0, n1, n2, t = column_between(inward, thickness, v, j, k, 1 - b - c, b, c)
                ray = ray_from(pose, x, y, z, n0, n1, n2)
                least, above = _along_column(grid, ray, t, 0.0)
                if above <= t and least < np.inf:  # of one that is farther, its distance at the core is not known
                    under = _further_in(grid, ray, t, least, above, under)
                if under >= enough:
                    return under
    return under


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _squeezed(grid, pose, centre, points, inward, thickness, faces, start, around, slot, near, least, above, hole,
              stacked, order, blocks, low, high):  # fmt: skip
    """Parts of a Squeeze: vertices, depth, rests, top, and those of its nodes; their sinking only of a stack.

    Args:
        centre: middle of the tool, in the body's frame, (3,) [m].
        near, least, above: what a Clearance knows.
        hole: distance from which a tool is beside a column [m].
        order, blocks, low, high: see _through_box.
    """
    covered, under, wall = near[least < hole], -np.inf, 0.0
    for n in range(len(near)):
        if least[n] < hole:
            v = near[n]
            wall += WALL * thickness[v] / len(covered)
            under = _further_in(grid, ray_of(pose, points, inward, v), thickness[v], least[n], above[n], under)
    parts = _parts_between(grid[3], low, high, hole / HOLE_RADIUS)
    if parts > 0:
        under = _under_between(grid, pose, points, inward, thickness, faces, start, around, covered, parts, under,
                               ALL_UNDER * wall)  # fmt: skip
    top = NOT_SUNK.copy()
    if under > LEAST_UNDER * wall:  # a layer that is thin beside the limb has no columns that lead so far aside
        top = _top(pose, inward, near, least, above, hole) if stacked else UNSAID.copy()
        share = min((under / wall - LEAST_UNDER) / (ALL_UNDER - LEAST_UNDER), 1.0)
        if top[0] > ANYHOW:
            top = top - (1 - share)
        else:
            covered = _with_swept(grid, pose, points, inward, thickness, order, blocks, low, high, hole, top, covered)
            top = share * top
    found, vertices, depth, rests = _cover(grid, pose, points, inward, thickness, faces, start, around, slot, covered,
                                           top)  # fmt: skip
    nodes = nodes_under(grid, pose, centre, points, inward, thickness, faces, found, top)
    sinking, push = np.empty(0), np.zeros(3)
    if stacked:
        places, ways, heights, areas, strains = nodes[:5]
        push = _one_way(ways, areas * (strains * heights))
        sinking = _sinking(grid, pose, places, ways, heights, areas, strains, way_of(top)[0], push)
    return (vertices, depth, rests, top, push) + nodes + (sinking,)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _top(pose, inward, near, least, above, hole):
    """Against the mean inward normal of columns that a tool meets, in its frame, (3,); UNSAID if they have no one way.

    They count by how deep it is in them, and the less the farther their skin is beside it: nothing jumps as it comes to
    the skin of a vertex, of which a thin tool meets now one and now none.
    """
    weights, out = np.empty(len(near)), np.zeros(3)
    for n in range(len(near)):
        weights[n] = max(hole - least[n], 0.0) * np.exp(-max(above[n], 0.0) / hole)
    way = _one_way(inward[near], weights)
    if not way.any():
        return UNSAID.copy()
    size = np.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    for x in range(3):
        for y in range(3):
            out[x] -= pose[y, x] * (way[y] / size)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _with_swept(grid, pose, points, inward, thickness, order, blocks, low, high, hole, top, covered):
    """Numbers of covered columns, rising, and of those that a tool that has sunk meets along its way, against `top`."""
    way = np.empty((1, 3))
    for x in range(3):
        way[0, x] = -(pose[x, 0] * top[0] + pose[x, 1] * top[1] + pose[x, 2] * top[2])
    near = _through_box(points, way, thickness, order, blocks, pose, low, high, hole)
    out, count = np.empty(len(near) + len(covered), np.int64), len(covered)
    out[:count] = covered
    for v in near:
        cosine = inward[v, 0] * way[0, 0] + inward[v, 1] * way[0, 1] + inward[v, 2] * way[0, 2]
        at = np.searchsorted(covered, v)
        if cosine <= ASLANT or (at < len(covered) and covered[at] == v):
            continue
        ray = ray_from(pose, points[v, 0], points[v, 1], points[v, 2], way[0, 0], way[0, 1], way[0, 2])
        if -inside_most(grid, ray, thickness[v], -distance_in_column(grid, ray, 0.0), -hole)[0] < hole:
            out[count] = v
            count += 1
    return np.sort(out[:count])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _one_way(inward, weights):
    """Sum of unit vectors (N, 3) by weights (N,), (3,); 0 where they have no one way."""
    way, whole = np.zeros(3), 0.0
    for n in range(len(weights)):
        whole += weights[n]
        for x in range(3):
            way[x] += weights[n] * inward[n, x]
    size = np.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    return way if size > MIN_ONE_WAY_SHARE * whole else np.zeros(3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pushed(points, inward, thickness, area, strain):
    """A row of `shared_pushes`, (8,) [m3, m], from what Nodes are told."""
    out, square = np.zeros(8), 0.0
    for n in range(len(area)):
        weight = area[n] * (strain[n] * thickness[n])
        out[0] += weight
        for x in range(3):
            out[1 + x] += weight * inward[n, x]
            out[4 + x] += weight * points[n, x]
    for x in range(3):
        out[4 + x] /= max(out[0], 1e-300)
    for n in range(len(area)):
        for x in range(3):
            square += area[n] * (strain[n] * thickness[n]) * (points[n, x] - out[4 + x]) ** 2
    out[7] = np.sqrt(square / max(out[0], 1e-300))
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shared_pushes(rows):
    """Sums of inward normals of K tools and of those beside with which they press as one, (K, 3) [m3]: Squeeze.push.

    Each of the parts of a tool would press its own way: those of a ball, deep in a thigh, a little to its middle, and
    with skin that lies beside it. What is part of one with a third tool is so with each other, unless they face apart.

    Args:
        rows: of each tool's nodes the sum of area times depth, of their inward normals likewise, and by that their
            middle and the root of the mean square of the distance from it, (K, 8) [m3, m].
    """
    many, out = len(rows), np.zeros((len(rows), 3))
    shares = np.zeros((many, many))
    for k in range(many):
        for m in range(many):
            a, b, square = rows[k], rows[m], 0.0
            for x in range(3):
                square += (a[4 + x] - b[4 + x]) ** 2
            share = (AS_ONE[1] - np.sqrt(square) / max(a[7] + b[7], 1e-12)) / (AS_ONE[1] - AS_ONE[0])
            share = min(max(share, 0.0), 1.0) if min(a[0], b[0]) > 0 else 0.0
            shares[k, m] = share * share * (3 - 2 * share)
    for third in range(many):
        for k in range(many):
            for m in range(many):
                shares[k, m] = max(shares[k, m], min(shares[k, third], shares[third, m]))
    for k in range(many):
        way, whole = rows[k, 1:4].copy(), rows[k, 0]
        for m in range(many):
            facing = 0.0
            for x in range(3):
                facing += 2 * rows[k, 1 + x] * rows[m, 1 + x] / max(rows[k, 0] * rows[m, 0], 1e-300)
            share = shares[k, m] * min(max(facing, 0.0), 1.0) if m != k else 0.0
            whole += share * rows[m, 0]
            for x in range(3):
                way[x] += share * rows[m, 1 + x]
        if np.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]) > MIN_ONE_WAY_SHARE * whole:
            out[k] = way
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sinking(grid, pose, points, inward, thickness, area, strain, sunk, push):
    """Depth by which skin sinks along its normal if it goes with the tool along a way, (N,) [m]: see Squeeze.push.

    On a limb that is no wider than its contact, columns along the normals meet the tool at a slant, and too deep. Those
    that lead out of its wall leave it too early: skin that is inside it sinks to where it ends along that way.
    Where that way just passes the tool, or grazes it, skin sinks as far as beside it, where one surely leads through.
    """
    depth = strain * thickness
    if not push.any():
        return depth
    way = push / np.sqrt(push[0] * push[0] + push[1] * push[1] + push[2] * push[2])
    for n in range(len(depth)):
        cosine = inward[n, 0] * way[0] + inward[n, 1] * way[1] + inward[n, 2] * way[2]
        guess = max(depth[n] * cosine, 1e-9)
        ray = ray_from(pose, points[n, 0], points[n, 1], points[n, 2], way[0], way[1], way[2])
        wall = wall_in(grid[3], thickness[n])
        sure, inside, where = sure_of(grid, ray, guess, wall)
        if sure < 1 and sunk > 0:  # a tool beside whose wall little counts is deeper than that
            guess = max(guess, thickness[n])
            sure, inside, where = sure_of(grid, ray, guess, wall)
        if sure <= -1:
            depth[n] = 0.0
            continue
        ends = ray if sure == 1 else led_in(grid, ray, where, inside, wall)
        more = depth_in_column(grid, ends, max(4 * guess, thickness[n]), guess, 0.0) * cosine - depth[n]
        if more > 0:  # as far as its skin is inside the tool, and not at once
            begins = max(1 - distance_in_column(grid, ray, 0.0) / wall, sunk * (1 + inside / wall))
            more *= max(sure, 0.0) * min(max(begins, 0.0), depth[n] / wall, 1.0)
        depth[n] = (1 + min(sure, 0.0)) * (depth[n] + more)
    return depth


@numba.njit(cache=True, nogil=True)
def _cover(grid, pose, points, inward, thickness, faces, start, around, slot, covered, top):
    """Triangles around covered vertices, their vertices in order, and of these depth and rests: see Squeeze.

    At the border the depth falls to 0 beside a wall of the tool, and where a tool has sunk under skin that it
    does not reach, within half of that inside it.
    """
    room, many, count, vertices = 0, 0, 0, np.empty(len(slot), np.int64)
    for v in covered:
        if start[v + 1] > start[v]:
            room += start[v + 1] - start[v]
            vertices[count], slot[v] = v, count
            count += 1
    found, inner = np.empty(room, np.int64), count
    for n in range(inner):
        for p in range(start[vertices[n]], start[vertices[n] + 1]):
            f, first = around[p], True
            for k in range(3):
                first = first and not 0 <= slot[faces[f, k]] < n  # else it came with another corner
            if not first:
                continue
            found[many] = f
            many += 1
            for k in range(3):
                w = faces[f, k]
                if slot[w] < 0:
                    slot[w] = count
                    vertices[count] = w
                    count += 1
    found = np.sort(found[:many])
    vertices = np.sort(vertices[:count])
    depth, rests = np.empty(count), np.zeros(count)
    for n in range(count):
        v = vertices[n]
        slot[v] = -1
        wall, ray = wall_in(grid[3], thickness[v]), ray_of(pose, points, inward, v)
        deep, share = depth_and_share(grid, ray, thickness[v], top)
        depth[n] = share * deep
        if depth[n] > 0:
            inside = -distance_in_column(grid, ray, depth[n] - wall)
            rests[n] = min(max(2 * inside / wall, 0.0), 1.0) * min(depth[n] / wall, 1.0)
        if share < 1 and top.any():
            sunk, most, lies = swept(grid, ray, thickness[v], top)
            depth[n] += max(most - share, 0.0) * sunk
            rests[n] = max(rests[n], lies * min(depth[n] / wall, 1.0))
    return found, vertices, depth, rests
