"""Nodes: points of the skin under a tool at which contact is solved: a lattice that goes with the tool, not the mesh.

The lattice lies across the contact's mean normal, about its middle, along the tool's own axes. Its spacing follows from
the area that the tool covers, so there are about as many nodes under a fingertip's first touch as under a plate; and
nothing jumps while the tool slides, whatever the triangles below.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.compiling import UNCOUNTED
from stmpl_core.rays import (
    ASLANT,
    MAX_COLUMN_STRAIN,
    STEEPEST,
    SURE,
    UPRIGHT,
    WALL,
    depth_and_share,
    depth_in_column,
    distance_in_column,
    inside_most,
    led_in,
    ray_from,
    sunk_under,
    swept,
    to_tool,
    wall_in,
    way_of,
)
from stmpl_core.sdf import distance_at, jet_at

NODES = 80  # number of nodes under a tool, about
WIDEST = 0.45  # largest spacing of nodes, over the thickness
MOST = 1500  # number of nodes that are never exceeded, but for tools around a limb
MOST_LOOKED_AT = 6000  # places of a lattice that are looked at for these
FACING = 0.35  # cosine between a triangle's normal and the chart's, from which it belongs there
ONE_WAY = 0.6  # size of the mean normal from which one chart begins with it
CHARTS = 6  # charts of a tool that closes around a limb
ASKEW = 0.3  # angle between lattice and tool [rad]: no row of a round or square tool's rim comes in all at once
BESIDE = 0.6  # farthest that a part of a triangle reaches from its middle, over its side
SAMPLES = 200  # points, about, from which the covered area is reckoned
LEAST_PART = 5e-3  # side of a part of a triangle down to which a tip is looked for, over the thickness
BLEND = 0.1  # part of the way from a spacing that sees the area to the next, over which one gives way to the other


class Nodes(NamedTuple):
    """Contact nodes of a tool at a pose.

    Args:
        points: places on the skin at rest, (N, 3) [m].
        inward: unit vectors into the skin, (N, 3).
        thickness: thickness of the layer, (N,) [m].
        area: area of skin that each stands for, (N,) [m2].
        strain: depth of the tool in the column over the thickness, (N,) [-].
        corners: numbers of the vertices around it, (N, 3).
        shares: barycentric coordinates among them, (N, 3) [-].
        sinking: depth by which the skin there sinks along its normal if it goes with the tool, all of it one way, (N,)
            [m]; empty where only depths in columns are known.
        beside: strains of the columns by each of K tools that feel each other, below 0 by the node's own, (N, K) [-];
            empty of one tool.
    """

    points: np.ndarray
    inward: np.ndarray
    thickness: np.ndarray
    area: np.ndarray
    strain: np.ndarray
    corners: np.ndarray
    shares: np.ndarray
    sinking: np.ndarray = np.empty(0)
    beside: np.ndarray = np.empty((0, 0))

    @property
    def depths(self) -> np.ndarray:
        """Depth by which the skin sinks, in its column where no other is known, (N,) [m]."""
        return self.sinking if len(self.sinking) else self.strain * self.thickness

    @classmethod
    def none(cls) -> Nodes:
        """No nodes."""
        three, one = np.empty((0, 3)), np.empty(0)
        return cls(three, three, one, one, one, np.empty((0, 3), np.int64), three, one)

    @classmethod
    def joined(cls, parts: list[Nodes]) -> Nodes:
        """Nodes of several tools, one after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True))) if parts else cls.none()

    def some(self, which: np.ndarray) -> Nodes:
        """Those of these numbers, or where a mask (N,) says so."""
        return Nodes(*(values[which] if len(values) else values for values in self))

    def at_vertices(self, values: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pressures at the nodes (N,) as pressures at the vertices around them: their numbers, (M,), and values, (M,).

        Args:
            values: pressures at the nodes, (N,).
            areas: areas of all vertices, (V,) [m2].
        """
        return gathered(self.corners, self.shares, values * self.area, areas)


@numba.njit(cache=True, nogil=True)
def gathered(corners, shares, forces, areas):
    """Numbers of the vertices that forces at nodes press on, and pressures there."""
    some = np.unique(corners)
    sums, count = np.zeros(len(some)), 0
    for n in range(len(corners)):
        for c in range(3):
            sums[np.searchsorted(some, corners[n, c])] += forces[n] * shares[n, c]
    for k in range(len(some)):
        if sums[k] > 0:
            some[count], sums[count] = some[k], sums[k] / areas[some[k]]
            count += 1
    return some[:count].copy(), sums[:count].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def nodes_under(grid, pose, centre, points, inward, thickness, faces, found, top):
    """Nodes under a tool, all but their sinking. The lattice is laid twice: at first to see the area as it does.

    That has a spacing of a few steps only, so that it stays as it is while the tool moves; from one step to the next
    the area goes over from what one sees to what the other does.

    Args:
        grid: coefficients, origin and spacing of the tool's distance field.
        pose: pose_body_from_tool, (4, 4).
        centre: middle of the tool, in the body's frame, (3,) [m].
        points, inward, thickness, faces: points, inward normals, thickness and faces of the layer.
        found: numbers of the triangles that the tool may touch, (F,).
        top: against the way of a tool that is under skin which it does not reach, see rays.sunk_under; else NOT_SUNK.
    """
    split = 1
    while split < 8 and len(found) * split**2 < SAMPLES:
        split += 1
    rows, least = np.empty((0, 15)), np.inf
    for f in found:
        least = min(least, LEAST_PART * thickness[faces[f, 0]])
    while len(found):
        depths, middles, ways, sizes, edges, best, area, thick = _look(
            grid, pose, points, inward, thickness, faces, found, top, split
        )
        if area > 0:
            rows = _laid(grid, pose, centre, points, inward, thickness, faces, found, top, split, thick, depths,
                         middles, edges, *_charts(pose, found, depths, ways, sizes, best), area)  # fmt: skip
        if len(rows) or edges.max() < least:
            break
        split, met = 2 * split, np.empty(len(found), np.bool_)
        for m in range(len(found)):  # a tip may be between the places that were looked at
            met[m] = met_between(grid, pose, points, faces[found[m : m + 1]], 0.0, least) > 0
        found = found[met]
    count = len(rows)
    corners = np.empty((count, 3), np.int64)
    for n in range(count):
        for c in range(3):
            corners[n, c] = int(rows[n, 9 + c])
    return (rows[:, 0:3].copy(), rows[:, 3:6].copy(), rows[:, 6].copy(), rows[:, 7].copy(), rows[:, 8].copy(), corners,
            rows[:, 12:15].copy())  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def _met(grid, pose, parts, reach, finest):
    """See met_between: of the triangle in the first row; parts: room for 64 parts, their corners, (64, 9) [m]."""
    whole, count = 0.0, 1
    while count > 0:
        part = parts[count - 1]
        x, y, z = part[0] + part[3] + part[6], part[1] + part[4] + part[7], part[2] + part[5] + part[8]
        x, y, z = x / 3, y / 3, z / 3
        d, size, long, at = _distance(grid, pose, x, y, z), 0.0, 0.0, 0
        for c in range(3):
            a, b = 3 * c, 3 * ((c + 1) % 3)
            size = max(size, (part[a] - x) ** 2 + (part[a + 1] - y) ** 2 + (part[a + 2] - z) ** 2)
            edge = (part[b] - part[a]) ** 2 + (part[b + 1] - part[a + 1]) ** 2 + (part[b + 2] - part[a + 2]) ** 2
            if edge > long:
                long, at = edge, c
        size, whole = np.sqrt(size), max(whole, np.sqrt(long))
        if d < reach:
            return whole
        count -= 1
        if size < finest or d - STEEPEST * size > reach:
            continue
        a, b, other = 3 * at, 3 * ((at + 1) % 3), parts[count + 1]
        for x in range(9):
            other[x] = part[x]
        for x in range(3):
            other[b + x] = 0.5 * (part[a + x] + part[b + x])
            part[a + x] = other[b + x]
        count += 2
    return 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def met_between(grid, pose, points, faces, reach, finest):
    """Length of one of triangles (F, 3) that a tool meets or is within `reach` of [m]; 0 if there is none.

    They are halved, down to a size [m], where the distance says too little.
    """
    parts = np.empty((64, 9))
    for f in range(len(faces)):
        for c in range(3):
            for x in range(3):
                parts[0, 3 * c + x] = points[faces[f, c], x]
        long = _met(grid, pose, parts, reach, finest)
        if long > 0:
            return long
    return 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _laid(grid, pose, centre, points, inward, thickness, faces, found, top, split, thick, depths, middles, edges,
          chart, frames, area):  # fmt: skip
    """Rows of a lattice, see `_lay`, for an area that is covered by what was looked at [m2]."""
    scene = (grid, pose, centre, points, inward, thickness, faces, found, top, split, thick, depths, middles, edges,
             chart, frames)  # fmt: skip
    unit = NODES * thick * thick
    step = np.floor(np.log2(area / unit))
    seen, _ = _lay(*scene, area, _cell(step, thick), True)
    if not seen > 0:
        return np.empty((0, 15))
    beyond = np.log2(seen / unit) - step
    if not BLEND <= beyond <= 1 - BLEND:
        other = step + 1 if beyond > 0.5 else step - 1
        also, _ = _lay(*scene, area, _cell(other, thick), True)
        fine, coarse = (seen, also) if other > step else (also, seen)
        if fine > 0:
            share = (np.log2(fine / unit) - max(step, other)) / BLEND + 0.5
            seen = fine + min(max(share, 0.0), 1.0) * (coarse - fine)
    return _lay(*scene, seen, seen / NODES, False)[1]


@numba.njit(cache=True, inline="always")
def _cell(step, thick):
    """Area of a place of the lattice that sees the area, by its step [m2]."""
    return 0.5 * thick * thick * 2.0**step


@numba.njit(cache=True, inline="always")
def between_corners(values, i, j, k, a, b, c):
    """Vector at barycentric coordinates a, b, c of the triangle of vertices i, j, k, three numbers."""
    return (a * values[i, 0] + b * values[j, 0] + c * values[k, 0],
            a * values[i, 1] + b * values[j, 1] + c * values[k, 1],
            a * values[i, 2] + b * values[j, 2] + c * values[k, 2])  # fmt: skip


@numba.njit(cache=True, inline="always")
def column_between(inward, thickness, i, j, k, a, b, c):
    """Unit inward normal and thickness at barycentric coordinates of the triangle of these vertices, four numbers."""
    x, y, z = between_corners(inward, i, j, k, a, b, c)
    length = 1 / np.sqrt(max(x * x + y * y + z * z, 1e-300))
    return x * length, y * length, z * length, a * thickness[i] + b * thickness[j] + c * thickness[k]


@numba.njit(forceinline=True, cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def _strain_under(grid, ray, t, top):
    """How far the tool squeezes a column, over its thickness; rising from 0 beside the tool's walls."""
    wall = wall_in(grid[3], t)
    deep, share = depth_and_share(grid, ray, t, top)
    strain = share * min(deep / t, MAX_COLUMN_STRAIN)
    if deep > wall:
        inside = min(max(-2 * distance_in_column(grid, ray, deep - wall) / wall, 0.0), 1.0)
        strain *= 1 - (1 - inside) * min(deep / wall - 1, 1.0)
    if share < 1 and top.any():
        sunk, most, _ = swept(grid, ray, t, top)
        strain += max(most - share, 0.0) * min(sunk / t, MAX_COLUMN_STRAIN)
    return strain


@numba.njit(cache=True, nogil=True)
def strains_under(grid, pose, points, inward, thickness, top):
    """How far a tool squeezes the columns of nodes, whosever they are, over their thickness, (N,) [-]."""
    out = np.empty(len(points))
    for n in range(len(out)):
        ray = ray_from(pose, points[n, 0], points[n, 1], points[n, 2], inward[n, 0], inward[n, 1], inward[n, 2])
        out[n] = _strain_under(grid, ray, thickness[n], top)
    return out


@numba.njit(cache=True, nogil=True)
def ball_around(points):
    """Middle of points (N, 3), and the distance of the farthest from it [m]."""
    middle, square = np.zeros(3), 0.0
    for n in range(len(points)):
        for x in range(3):
            middle[x] += points[n, x] / len(points)
    for n in range(len(points)):
        a, b, c = points[n, 0] - middle[0], points[n, 1] - middle[1], points[n, 2] - middle[2]
        square = max(square, a * a + b * b + c * c)
    return middle, np.sqrt(square)


@numba.njit(cache=True, inline="always")
def _there(between, x, y, z):
    """A point of a tool's frame in that of another, by the pose of the former in the latter, (4, 4)."""
    return (between[0, 0] * x + between[0, 1] * y + between[0, 2] * z + between[0, 3],
            between[1, 0] * x + between[1, 1] * y + between[1, 2] * z + between[1, 3],
            between[2, 0] * x + between[2, 1] * y + between[2, 2] * z + between[2, 3])  # fmt: skip


@numba.njit(cache=True, inline="always")
def _ended(grid, ray, other, between, s, wall):
    """Share to which a tool has ended at s along a ray, from 0: it has not, or another is beyond its wall, to 1."""
    x, y, z = ray[0] + s * ray[3], ray[1] + s * ray[4], ray[2] + s * ray[5]
    own, a, b, c = jet_at(grid[0], grid[1], grid[2], x, y, z)
    if own <= -0.5 * wall:
        return 0.0
    far = 0.5 * wall - min(own, 0.0)
    x, y, z = _there(between, x + far * a, y + far * b, z + far * c)
    gap = max(own, 0.0) + max(distance_at(other[0], other[1], other[2], x, y, z) + 0.5 * wall, 0.0)
    return min(2 * gap / wall, 1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def strains_beside(grid, pose, other, between, points, inward, thickness, strain, top):
    """Strains of a tool's nodes, (N,) [-]: nothing is rounded off at a wall where another tool goes on.

    Args:
        grid, pose, top: the tool, see `nodes_under`.
        other, between: distance field of the other one, and the tool's pose in its frame, (4, 4).
        points, inward, thickness, strain: see Nodes.
    """
    out, (size, a, b, c) = strain.copy(), way_of(top)
    for n in range(len(out)):
        t, wall, now = thickness[n], wall_in(grid[3], thickness[n]), 0.0
        ray = ray_from(pose, points[n, 0], points[n, 1], points[n, 2], inward[n, 0], inward[n, 1], inward[n, 2])
        x, y, z = _there(between, ray[0], ray[1], ray[2])
        if distance_at(other[0], other[1], other[2], x, y, z) > STEEPEST * t:
            continue
        deep, share = depth_and_share(grid, ray, t, top)
        if deep > wall:
            ended = _ended(grid, ray, other, between, deep - wall, wall)
            now = share * min(deep / t, MAX_COLUMN_STRAIN) * (1 - ended * min(deep / wall - 1, 1.0))
        cosine = a * ray[3] + b * ray[4] + c * ray[5]
        if share < 1 and cosine > ASLANT:  # where a tool that has sunk has come through the skin: see rays.swept
            way = ray[0], ray[1], ray[2], a, b, c
            inside, where = inside_most(grid, way, t, -distance_in_column(grid, way, 0.0), -wall)
            most = size * (1 - _ended(grid, way, other, between, where, wall)) * min((cosine - ASLANT) / UPRIGHT, 1.0)
            if most > share:
                ends = way if inside > SURE * wall else led_in(grid, way, where, inside, wall)
                now += (most - share) * min(depth_in_column(grid, ends, t, 0.0, 0.0) * cosine / t, MAX_COLUMN_STRAIN)
        out[n] = max(out[n], now)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look(grid, pose, points, inward, thickness, faces, found, top, split):
    """How deep the tool is at parts of the triangles.

    Returns:
        depths: of the middles of the parts of each triangle, (F, P) [m]; far above a sunk tool only that it is so.
        middles: these places, (F, P, 3) [m].
        ways: inward normals of the triangles, (F, 3).
        sizes: areas of the parts, (F,) [m2].
        edges: their sides, (F,) [m].
        best: place in `found` of the deepest.
        area: area that is covered [m2]; a small share of what is near, where the tool touches between the middles.
        thick: thickness there [m].
    """
    many, parts = len(found), split * split
    depths, middles, ways = np.empty((many, parts)), np.empty((many, parts, 3)), np.empty((many, 3))
    sizes, edges, shares = np.empty(many), np.empty(many), np.empty((parts, 2))
    for p in range(split):
        for r in range(split - p):
            for flip in range(2 if r < split - p - 1 else 1):
                q = _part(p, r, flip, split)
                shares[q, 0], shares[q, 1] = (p + (1 + flip) / 3) / split, (r + (1 + flip) / 3) / split
    best, area, thick = _look_at(grid, pose, points, inward, thickness, faces, found, top, top.any(), shares, depths,
                                 middles, ways, sizes, edges)  # fmt: skip
    return depths, middles, ways, sizes, edges, best, area, thick


@numba.njit(cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def _look_at(grid, pose, points, inward, thickness, faces, found, top, sunk, shares, depths, middles, ways,
             sizes, edges):  # fmt: skip
    """Writes what `_look` gives, and returns the last three; shares: barycentric coordinates of the parts, (P, 2)."""
    many, parts, deepest, best = len(found), len(shares), -np.inf, 0
    for m in range(many):
        f = found[m]
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
        bx, by, bz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
        cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        size = np.sqrt(cx * cx + cy * cy + cz * cz)
        ways[m, 0], ways[m, 1], ways[m, 2] = -cx / size, -cy / size, -cz / size
        sizes[m], edges[m] = 0.5 * size / parts, np.sqrt((ax * ax + ay * ay + az * az) / parts)
        for q in range(parts):
            a, b = shares[q, 0], shares[q, 1]
            x, y, z = between_corners(points, i, j, k, a, b, 1 - a - b)
            depth = -_distance(grid, pose, x, y, z)
            if sunk:
                n0, n1, n2, t = column_between(inward, thickness, i, j, k, a, b, 1 - a - b)
                least = -BESIDE * edges[m] - WALL * t
                depth = _inside(grid, ray_from(pose, x, y, z, n0, n1, n2), t, depth, least, top)
            depths[m, q], middles[m, q, 0], middles[m, q, 1], middles[m, q, 2] = depth, x, y, z
            if depth > deepest:
                deepest, best = depth, m
    area = thick = 0.0
    for m in range(many):
        blur = 0.5 * np.sqrt(sizes[m])
        blur = min(blur, 0.5 * deepest) if deepest > 0 else blur
        for q in range(parts):
            part = min(max(0.5 + depths[m, q] / blur, 0.0), 1.0) * sizes[m]
            area += part
            thick += part * thickness[faces[found[m], 0]]
    return best, area if deepest > 0 else 0.05 * area, thick / max(area, 1e-300)


@numba.njit(cache=True, inline="always")
def _part(p, r, flip, split):
    """Number of the part of a triangle at steps p and r to its first two corners; flip 1: beyond its diagonal."""
    return p * (2 * split - p) + 2 * r + flip


@numba.njit(cache=True, inline="always")
def _distance(grid, pose, x, y, z):
    """Distance of a point of the body's frame to the tool [m]."""
    x, y, z = to_tool(pose, x, y, z)
    return distance_at(grid[0], grid[1], grid[2], x, y, z)


@numba.njit(forceinline=True, cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def _inside(grid, ray, t, depth, least, top):
    """How far the column gets into a tool that has sunk under skin which it does not reach, or just does [m].

    Args:
        ray, t: column, and its thickness.
        depth: depth of its skin in the tool [m].
        least: depth up to which the answer does not matter.
        top: see rays.sunk_under.
    """
    beyond = min(1 - depth / (WALL * t), 1.0)
    if beyond <= 0:
        return depth
    most, _ = inside_most(grid, ray, max(depth_in_column(grid, ray, t, 0.0, 0.5 * t), 0.5 * t), depth, least)
    sunk = (most - depth) * sunk_under(grid, ray, t, top) if most > depth else 0.0
    misses, (size, a, b, c) = min(1 - 2 * most / (WALL * t), 1.0), way_of(top)
    if misses > 0 and size > 0 and a * ray[3] + b * ray[4] + c * ray[5] > ASLANT:
        along, _ = inside_most(grid, (ray[0], ray[1], ray[2], a, b, c), t, depth, max(least, depth + sunk))
        sunk = max(sunk, misses * size * (along - depth))
    return depth + beyond * sunk


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _charts(pose, found, depths, ways, sizes, best):
    """The side of the limb that each triangle is on, (F,), and axes across each: first, second, inward, (C, 3, 3).

    The first side faces the mean normal of what is covered, unless the tool closes around the limb.
    """
    many, parts = depths.shape
    deepest, mean, total = depths[best].max(), np.zeros(3), 0.0
    for m in range(many):
        for q in range(parts):
            weight = sizes[m] * max(depths[m, q] + 0.05 * abs(deepest), 0.0)
            total += weight
            for x in range(3):
                mean[x] += weight * ways[m, x]
    length = np.sqrt((mean * mean).sum())
    chart, frames = np.full(many, -1), np.zeros((CHARTS, 3, 3))
    way = mean / length if length > ONE_WAY * total else ways[best].copy()
    for c in range(CHARTS):
        first = np.empty(3)
        for axis in range(2):  # along the tool's first axis, or its second where that is steep
            along = pose[0, axis] * way[0] + pose[1, axis] * way[1] + pose[2, axis] * way[2]
            for x in range(3):
                first[x] = pose[x, axis] - along * way[x]
            if along * along < 0.9:
                break
        first /= np.sqrt((first * first).sum())
        cross = np.array([way[1] * first[2] - way[2] * first[1], way[2] * first[0] - way[0] * first[2],
                          way[0] * first[1] - way[1] * first[0]])  # fmt: skip
        frames[c, 1] = np.cos(ASKEW) * cross - np.sin(ASKEW) * first
        frames[c, 0] = np.cos(ASKEW) * first + np.sin(ASKEW) * cross
        frames[c, 2] = way
        rest, highest = -1, 0.0
        for m in range(many):
            if chart[m] < 0:
                if ways[m, 0] * way[0] + ways[m, 1] * way[1] + ways[m, 2] * way[2] >= FACING:
                    chart[m] = c
                elif depths[m].max() > highest:
                    rest, highest = m, depths[m].max()
        if rest < 0:
            return chart, frames[: c + 1]
        way = ways[rest].copy()
    return chart, frames


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lay(grid, pose, centre, points, inward, thickness, faces, found, top, split, thick, depths, middles, edges,
         chart, frames, area, cell, only_look):  # fmt: skip
    """Lays a lattice about the tool's middle on each side, for a covered area and that of one of its places [m2].

    Returns:
        area: area that is covered, as the lattice sees it [m2]; it does not depend on the triangles.
        rows: rows of Nodes: point, inward, thickness, area, strain, corners, shares, (N, 15), unless only to look.
    """
    out, count, sum_area, deepest, sunk = np.empty((128, 15)), np.int64(0), 0.0, depths.max(), top.any()
    least = max(min(cell, 0.5 * np.sqrt(3.0) * (WIDEST * thick) ** 2), area / MOST)
    for side in range(len(frames)):
        first, second, way = frames[side, 0], frames[side, 1], frames[side, 2]

        near = np.zeros(len(found), np.bool_)
        reach = np.array([np.inf, np.inf, -np.inf, -np.inf])
        _reach(first, second, centre, thick, depths, middles, edges, chart, side, sunk, near, reach)
        if reach[2] < reach[0]:
            continue
        cell = max(least, (reach[2] - reach[0]) * (reach[3] - reach[1]) / MOST_LOOKED_AT)
        spacing = np.sqrt(cell / (0.5 * np.sqrt(3.0)))
        rise = 0.5 * np.sqrt(3.0) * spacing
        start = np.array([0.31 * spacing, 0.17 * spacing])  # off the middle, for the same reason as ASKEW
        blur = 0.5 * spacing if deepest <= 0 else min(0.5 * spacing, 0.5 * deepest)
        for x in range(4):
            reach[x] -= start[x % 2]
        low, high = int(np.floor(reach[1] / rise)), int(np.ceil(reach[3] / rise))
        left, right = int(np.floor(reach[0] / spacing)) - 1, int(np.ceil(reach[2] / spacing)) + 1
        taken = np.zeros((high - low + 1, right - left + 1), np.bool_)

        m, uv = np.int64(0), np.empty((3, 2))
        while m < len(found):
            m, count, sum_area = _on_triangles(
                grid, pose, centre, points, inward, thickness, faces, found, top, sunk, split, depths, middles, first,
                second, way, start, spacing, rise, blur, cell, near, low, high, left, right, only_look, uv, taken, m,
                out, count, sum_area)  # fmt: skip
            if count == len(out):
                longer = np.empty((2 * count, 15))
                longer[:count] = out
                out = longer
    return sum_area, out[:count].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def _reach(first, second, centre, thick, depths, middles, edges, chart, side, sunk, near, reach):
    """Writes which triangles of a side the lattice must reach, and its rectangle: lowest u, v and highest, (4,) [m]."""
    for m in range(len(near)):
        edge = edges[m]
        if chart[m] != side:
            continue
        for q in range(depths.shape[1]):
            if sunk or depths[m, q] > -BESIDE * edge - WALL * thick:
                near[m] = True
                u = v = 0.0
                for x in range(3):
                    u += first[x] * (middles[m, q, x] - centre[x])
                    v += second[x] * (middles[m, q, x] - centre[x])
                reach[0], reach[1] = min(reach[0], u - edge), min(reach[1], v - edge)
                reach[2], reach[3] = max(reach[2], u + edge), max(reach[3], v + edge)


@numba.njit(cache=True, nogil=True, error_model="numpy", **UNCOUNTED)
def _on_triangles(grid, pose, centre, points, inward, thickness, faces, found, top, sunk, split, depths, middles, first,
                  second, way, start, spacing, rise, blur, cell, near, low, high, left, right, only_look, uv, taken,
                  begin, out, count, sum_area):  # fmt: skip
    """Which triangle each point of a lattice lies on, from one on; see `_lay`.

    Returns:
        m: triangle from which it is to go on, once there is room in `out`.
        count, sum_area: rows that are written, and area that is covered [m2].
    """
    for m in range(begin, len(found)):
        if not near[m]:
            continue
        f0, f1, f2 = faces[found[m], 0], faces[found[m], 1], faces[found[m], 2]
        border = 0.5 * blur if only_look else WALL * max(thickness[f0], thickness[f1], thickness[f2])
        for c in range(3):
            uv[c, 0], uv[c, 1] = -start[0], -start[1]
            for x in range(3):
                uv[c, 0] += first[x] * (points[faces[found[m], c], x] - centre[x])
                uv[c, 1] += second[x] * (points[faces[found[m], c], x] - centre[x])
        bx, by, cx, cy = uv[1, 0] - uv[0, 0], uv[1, 1] - uv[0, 1], uv[2, 0] - uv[0, 0], uv[2, 1] - uv[0, 1]
        double = bx * cy - cx * by
        from_row = max(low, int(np.ceil((uv[0, 1] + min(0.0, by, cy)) / rise - 1e-9)))
        to_row = min(high, int(np.floor((uv[0, 1] + max(0.0, by, cy)) / rise + 1e-9)))
        left_end, right_end = uv[0, 0] + min(0.0, bx, cx), uv[0, 0] + max(0.0, bx, cx)
        for j in range(from_row, to_row + 1):
            shift, v = 0.5 * (j & 1), j * rise
            from_one = max(left, int(np.ceil(left_end / spacing - shift - 1e-9)))
            to_one = min(right, int(np.floor(right_end / spacing - shift + 1e-9)))
            for i in range(from_one, to_one + 1):
                if taken[j - low, i - left]:
                    continue
                u = (i + shift) * spacing
                b = ((u - uv[0, 0]) * cy - cx * (v - uv[0, 1])) / double
                c = (bx * (v - uv[0, 1]) - (u - uv[0, 0]) * by) / double
                a = 1 - b - c
                if a < -1e-9 or b < -1e-9 or c < -1e-9:
                    continue
                taken[j - low, i - left] = True
                x, y, z = between_corners(points, f0, f1, f2, a, b, c)

                share = -1.0
                if not sunk:  # what is known of the middle of its part may say enough
                    p = min(max(int(a * split), 0), split - 1)
                    o = min(max(int(b * split), 0), split - 1 - p)
                    flip = 1 if o < split - 1 - p and a * split - p + b * split - o > 1 else 0
                    q = _part(p, o, flip, split)
                    away = STEEPEST * np.sqrt((x - middles[m, q, 0]) ** 2 + (y - middles[m, q, 1]) ** 2
                                              + (z - middles[m, q, 2]) ** 2)  # fmt: skip
                    if depths[m, q] + away < -border:
                        continue
                    if depths[m, q] - away > border:
                        share = 1.0
                if only_look and share < 0:
                    depth = -_distance(grid, pose, x, y, z)
                    if sunk:
                        n0, n1, n2, t = column_between(inward, thickness, f0, f1, f2, a, b, c)
                        depth = _inside(grid, ray_from(pose, x, y, z, n0, n1, n2), t, depth, -border, top)
                    share = min(max(0.5 + depth / blur, 0.0), 1.0)
                    if share <= 0:
                        continue
                n0, n1, n2, t = column_between(inward, thickness, f0, f1, f2, a, b, c)
                part = cell / max(n0 * way[0] + n1 * way[1] + n2 * way[2], FACING)
                if only_look:
                    sum_area += share * part
                    continue
                strain = _strain_under(grid, ray_from(pose, x, y, z, n0, n1, n2), t, top)
                if strain <= 0:
                    continue
                row = out[count]
                row[0], row[1], row[2], row[3], row[4], row[5], row[6] = x, y, z, n0, n1, n2, t
                row[7], row[8], row[9], row[10], row[11] = part, strain, f0, f1, f2
                row[12], row[13], row[14] = a, b, c
                count += 1
                if count == len(out):
                    return m, count, sum_area
    return len(found), count, sum_area
