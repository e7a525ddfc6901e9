"""Nodes: points of the skin under a tool at which contact is solved: a lattice that goes with the tool, not the mesh.

The lattice lies across the contact's mean normal, about its middle, along the tool's own axes. Its spacing follows from
the area that the tool covers, so there are about as many nodes under a fingertip's first touch as under a plate; and
nothing jumps while the tool slides, whatever the triangles below.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.rays import (
    MAX_COLUMN_STRAIN,
    WALL,
    depth_and_share,
    depth_in_column,
    distance_in_column,
    inside_most,
    ray_from,
    to_tool,
)
from stmpl_core.sdf import distance_at

NODES = 80  # number of nodes under a tool, about
WIDEST = 0.45  # largest spacing of nodes, over the thickness
MOST = 1500  # number of nodes that are never exceeded, but for tools around a limb
MOST_LOOKED_AT = 6000  # places of a lattice that are looked at for these
FACING = 0.35  # cosine between a triangle's normal and the chart's, from which it belongs there
ONE_WAY = 0.6  # size of the mean normal from which one chart begins with it
CHARTS = 6  # charts of a tool that closes around a limb
ASKEW = 0.3  # angle between lattice and tool [rad]: no row of a round or square tool's rim comes in all at once
SAMPLES = 200  # points, about, from which the covered area is reckoned


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
    """

    points: np.ndarray
    inward: np.ndarray
    thickness: np.ndarray
    area: np.ndarray
    strain: np.ndarray
    corners: np.ndarray
    shares: np.ndarray
    sinking: np.ndarray = np.empty(0)

    @classmethod
    def none(cls) -> Nodes:
        """No nodes."""
        three, one = np.empty((0, 3)), np.empty(0)
        return cls(three, three, one, one, one, np.empty((0, 3), np.int64), three, one)

    @classmethod
    def joined(cls, parts: list[Nodes]) -> Nodes:
        """Nodes of several tools, one after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True))) if parts else cls.none()

    def at_vertices(self, values: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pressures at the nodes (N,) as pressures at the vertices around them: their numbers, (M,), and values, (M,).

        Args:
            values: pressures at the nodes, (N,).
            areas: areas of all vertices, (V,) [m2].
        """
        return _gathered(self.corners, self.shares, values * self.area, areas)


@numba.njit(cache=True, nogil=True)
def _gathered(corners, shares, forces, areas):
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


def nodes_under(grid: tuple, pose: np.ndarray, centre: np.ndarray, skin: tuple, found: np.ndarray,
                sunk: bool) -> Nodes:  # fmt: skip
    """Nodes under a tool.

    Args:
        grid: coefficients, origin and spacing of the tool's distance field.
        pose: pose_body_from_tool, (4, 4).
        centre: middle of the tool, in the body's frame, (3,) [m].
        skin: points, inward normals, thickness and faces of the layer.
        found: numbers of the triangles that the tool may touch, (F,).
        sunk: truth of the claim that the tool is under skin which it does not reach.
    """
    points, inward, thickness, faces = skin
    return Nodes(*_nodes(grid, pose, centre, points, inward, thickness, faces, found, sunk))


@numba.njit(cache=True, nogil=True)
def _nodes(grid, pose, centre, points, inward, thickness, faces, found, sunk):
    """See nodes_under. The lattice is laid twice: first to see the covered area as it does, not as the triangles do."""
    split = 1
    while split < 8 and len(found) * split**2 < SAMPLES:
        split += 1
    depths, middles, ways, sizes, best, area = _look(
        grid, pose, points, inward, thickness, faces, found, sunk, split
    )
    rows = np.empty((0, 15))
    if area > 0:
        chart, frames = _charts(pose, found, depths, ways, sizes, best)
        for only_look in (True, False):
            seen, rows = _lay(grid, pose, centre, points, inward, thickness, faces, found, sunk, depths, middles,
                              chart, frames, area, only_look)  # fmt: skip
            if only_look:
                area = seen
                if area <= 0:
                    break
    count = len(rows)
    corners = np.empty((count, 3), np.int64)
    for n in range(count):
        for c in range(3):
            corners[n, c] = int(rows[n, 9 + c])
    return (rows[:, 0:3].copy(), rows[:, 3:6].copy(), rows[:, 6].copy(), rows[:, 7].copy(), rows[:, 8].copy(), corners,
            rows[:, 12:15].copy())  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _point(points, faces, f, a, b, c, row):
    """Writes the point at barycentric coordinates of a triangle to row[:3]."""
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    for x in range(3):
        row[x] = a * points[i, x] + b * points[j, x] + c * points[k, x]


@numba.njit(cache=True, nogil=True)
def _column(inward, thickness, faces, f, a, b, c, row):
    """Writes unit inward normal and thickness at barycentric coordinates of a triangle to row[3:7]."""
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    length = 0.0
    for x in range(3):
        row[3 + x] = a * inward[i, x] + b * inward[j, x] + c * inward[k, x]
        length += row[3 + x] * row[3 + x]
    length = 1 / np.sqrt(max(length, 1e-300))
    for x in range(3):
        row[3 + x] *= length
    row[6] = a * thickness[i] + b * thickness[j] + c * thickness[k]


@numba.njit(cache=True, nogil=True)
def _strain_under(grid, pose, row, sunk):
    """How far the tool squeezes the column at row[:7], over its thickness; rising from 0 beside the tool's walls."""
    ray, t = ray_from(pose, row[0], row[1], row[2], row[3], row[4], row[5]), row[6]
    wall = WALL * t
    deep, share = depth_and_share(grid, ray, t, sunk)
    if deep <= 0:
        return 0.0
    inside = -distance_in_column(grid, ray, deep - wall)
    share *= min(max(2 * inside / wall, 0.0), 1.0) if deep > wall else 1.0
    return share * min(deep / t, MAX_COLUMN_STRAIN)


@numba.njit(cache=True, nogil=True)
def _look(grid, pose, points, inward, thickness, faces, found, sunk, split):
    """How deep the tool is at parts of the triangles.

    Returns:
        depths: of the middles of the parts of each triangle, (F, P) [m].
        middles: these places, (F, P, 3) [m].
        ways: inward normals of the triangles, (F, 3).
        sizes: areas of the parts, (F,) [m2].
        best: place in `found` of the deepest.
        area: area that is covered [m2]; a small share of what is near, where the tool touches between the middles.
    """
    many, parts, row = len(found), split * split, np.empty(15)
    depths, middles, ways = np.empty((many, parts)), np.empty((many, parts, 3)), np.empty((many, 3))
    sizes, deepest, best = np.empty(many), -np.inf, 0
    for m in range(many):
        f = found[m]
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
        bx, by, bz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
        cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        size = np.sqrt(cx * cx + cy * cy + cz * cz)
        ways[m, 0], ways[m, 1], ways[m, 2] = -cx / size, -cy / size, -cz / size
        sizes[m] = 0.5 * size / parts
        q = 0
        for p in range(split):
            for r in range(split - p):
                for flip in range(2):
                    if flip == 1 and r == split - p - 1:
                        continue
                    a, b = (p + (1 + flip) / 3) / split, (r + (1 + flip) / 3) / split
                    _point(points, faces, f, a, b, 1 - a - b, row)
                    if sunk:
                        _column(inward, thickness, faces, f, a, b, 1 - a - b, row)
                    depths[m, q] = _depth_at(grid, pose, row, sunk)
                    for x in range(3):
                        middles[m, q, x] = row[x]
                    if depths[m, q] > deepest:
                        deepest, best = depths[m, q], m
                    q += 1
    area = 0.0
    for m in range(many):
        blur = 0.5 * np.sqrt(sizes[m])
        blur = min(blur, 0.5 * deepest) if deepest > 0 else blur
        for q in range(parts):
            area += min(max(0.5 + depths[m, q] / blur, 0.0), 1.0) * sizes[m]
    return depths, middles, ways, sizes, best, area if deepest > 0 else 0.05 * area


@numba.njit(cache=True, nogil=True)
def _depth_at(grid, pose, row, sunk):
    """Depth of the skin at row[:3] in the tool [m], or where the tool has sunk under it, of its column, row[3:7]."""
    x, y, z = to_tool(pose, row[0], row[1], row[2])
    depth = -distance_at(grid[0], grid[1], grid[2], x, y, z)
    if sunk and depth < 0:
        ray = ray_from(pose, row[0], row[1], row[2], row[3], row[4], row[5])
        return max(depth, inside_most(grid, ray, max(depth_in_column(grid, ray, row[6], 0.0), 0.5 * row[6])))
    return depth


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def _lay(grid, pose, centre, points, inward, thickness, faces, found, sunk, depths, middles, chart, frames, area,
         only_look):  # fmt: skip
    """Lays a lattice about the tool's middle on each side, for a covered area [m2].

    Returns:
        area: area that is covered, as the lattice sees it [m2]; it does not depend on the triangles.
        rows: rows of Nodes: point, inward, thickness, area, strain, corners, shares, (N, 15), unless only to look.
    """
    out, count, row, sum_area, deepest = np.empty((128, 15)), 0, np.empty(15), 0.0, depths.max()
    thick = 0.0
    for m in range(len(found)):
        thick += thickness[faces[found[m], 0]] / len(found)
    cell = area / NODES
    if only_look:  # a spacing of a few steps only, so that the lattice stays as it is while the tool moves
        cell = 0.5 * thick * thick * 2.0 ** np.floor(np.log2(cell / (thick * thick)))
    least = max(min(cell, 0.5 * np.sqrt(3.0) * (WIDEST * thick) ** 2), area / MOST)
    for side in range(len(frames)):
        first, second, way = frames[side, 0], frames[side, 1], frames[side, 2]

        # How far the lattice must reach.
        near = np.zeros(len(found), np.bool_)
        reach = np.array([np.inf, np.inf, -np.inf, -np.inf])
        for m in range(len(found)):
            f, edge = found[m], 0.0
            if chart[m] != side:
                continue
            for x in range(3):
                edge += (points[faces[f, 0], x] - points[faces[f, 1], x]) ** 2
            edge = np.sqrt(edge / depths.shape[1])
            for q in range(depths.shape[1]):
                if depths[m, q] > -0.6 * edge - WALL * thick:  # a part may reach that far beyond its middle
                    near[m] = True
                    u = v = 0.0
                    for x in range(3):
                        u += first[x] * (middles[m, q, x] - centre[x])
                        v += second[x] * (middles[m, q, x] - centre[x])
                    reach[0], reach[1] = min(reach[0], u - edge), min(reach[1], v - edge)
                    reach[2], reach[3] = max(reach[2], u + edge), max(reach[3], v + edge)
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

        # Which triangle each point of it lies on.
        uv = np.empty((3, 2))
        for m in range(len(found)):
            if not near[m]:
                continue
            f = found[m]
            for c in range(3):
                uv[c, 0], uv[c, 1] = -start[0], -start[1]
                for x in range(3):
                    uv[c, 0] += first[x] * (points[faces[f, c], x] - centre[x])
                    uv[c, 1] += second[x] * (points[faces[f, c], x] - centre[x])
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
                    _point(points, faces, f, a, b, c, row)
                    if sunk or not only_look:
                        _column(inward, thickness, faces, f, a, b, c, row)
                    if only_look:
                        share = min(max(0.5 + _depth_at(grid, pose, row, sunk) / blur, 0.0), 1.0)
                        if share > 0:
                            if not sunk:  # else it is there already
                                _column(inward, thickness, faces, f, a, b, c, row)
                            sum_area += share * cell / max(row[3] * way[0] + row[4] * way[1] + row[5] * way[2], FACING)
                        continue
                    row[7] = cell / max(row[3] * way[0] + row[4] * way[1] + row[5] * way[2], FACING)
                    row[8] = _strain_under(grid, pose, row, sunk)
                    if row[8] <= 0:
                        continue
                    row[9], row[10], row[11] = faces[f, 0], faces[f, 1], faces[f, 2]
                    row[12], row[13], row[14] = a, b, c
                    if count == len(out):
                        longer = np.empty((2 * count, 15))
                        longer[:count] = out
                        out = longer
                    out[count] = row
                    count += 1
    return sum_area, out[:count].copy()
