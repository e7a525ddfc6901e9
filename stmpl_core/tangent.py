"""Tangent: how a touch's wrench changes as tools move, from the touch itself: no further touch is asked for.

A contact is an obstacle problem on nodes (stmpl_core.obstacle) with forces f = f(depths). The nodes go along the skin
with the tool, as their lattice does. With g the gradient of the tool's distance where it ends in a node's column along
n, u the velocity of the tool there and v that of the column, its depth s follows from the surface staying a surface,

    ds = g . (u - v) / (g . n)

and with B (6, N) the wrench of a unit force at each node, dW = B df + dB f, plus what the torque's arm changes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.columns import grid_of, pushed, shared_pushes
from stmpl_core.nodes import FACING
from stmpl_core.rays import MAX_COLUMN_STRAIN, depth_in_column, distance_in_column, ray_from, wall_in
from stmpl_core.sdf import distances_and_gradients
from stmpl_core.touch import Pressed, Touch
from stmpl_core.toucher import Toucher, groups_of
from stmpl_core.wrenches import unit_wrenches

LEAST_COSINE = 0.05  # of a column's angle to the tool's normal, below which its depth is taken not to change
SWING = 1e-3  # step in which it is found how ways swing: of a tool's middle over its radius, and of its weight likewise
TINY = 1e-6  # radius that a tool of one node is taken to have [m]


class Tangent(NamedTuple):
    """Derivative of what a touch of elastic skin presses with, friction left out, by the twist of its tool.

    Args:
        stiffness: d wrench / d twist of its tool, (6, 6) [N/m, N/rad; N m/m, N m/rad]; the twist is (translation of
            the tool's origin, rotation vector), in layer axes.
        whole: d of the sum of the sizes of its forces, likewise, (6,) [N/m, N/rad].
        across: d wrench / d twist of each tool that it may feel through the skin, by that tool's name, (6, 6) each.
    """

    stiffness: np.ndarray
    whole: np.ndarray
    across: Mapping[str, np.ndarray]


def tangents(toucher: Toucher, touches: Sequence[Touch]) -> list[Tangent | None]:
    """Tangent of each touch of elastic skin; None where nothing presses.

    Tools that feel each other stay where they are: each one's forces give way as those beside it press. What moving
    those does to it is `across`.

    Args:
        toucher: contact law that found the touches.
        touches: its touches of one instant.
    """
    out: list[Tangent | None] = [None] * len(touches)
    for group in groups_that_press(toucher, touches):
        for k, one in zip(group, _of_group(toucher, [touches[k] for k in group]), strict=True):
            out[k] = one
    return out


def groups_that_press(toucher: Toucher, touches: Sequence[Touch]) -> list[list[int]]:
    """Numbers of the touches that press, in groups, between which none feels another (see `groups_of`)."""
    pressing = sorted((k for k, one in enumerate(touches) if one.pressed is not None and one.force > 0),
                      key=lambda k: touches[k].name)  # fmt: skip
    parts = {k: touches[k].pressed for k in pressing}
    thickest = float(toucher.layer.thickness.max())
    groups = groups_of([parts[k].squeeze.nodes.points for k in pressing], thickest)  # type: ignore[union-attr]
    return [[pressing[n] for n in group] for group in groups]


def _of_group(toucher: Toucher, touches: Sequence[Touch]) -> list[Tangent]:
    """Tangents of tools that may feel each other."""
    layer = toucher.layer
    parts: list[Pressed] = [one.pressed for one in touches if one.pressed is not None]
    every = [one.squeeze.nodes for one in parts]
    ends = np.concatenate([[0], np.cumsum([len(nodes.area) for nodes in every])])
    slices = [slice(a, b) for a, b in pairwise(ends)]
    strain, sinking = np.zeros((2, 6 * len(touches), ends[-1]))
    gone = np.zeros((len(strain), ends[-1], 3))
    moved, swings, rates, skin = [], [], [], (layer.vertices, layer.normals, layer.thickness)
    for k, (touch, one) in enumerate(zip(touches, parts, strict=True)):
        low, high = one.field.tool_bounds
        rows = slice(6 * k, 6 * k + 6)
        strain[rows, slices[k]], sinking[rows, slices[k]], shares, gone[rows, slices[k]], swing, rate = _rates(
            grid_of(one.field), 0.5 * (low + high), touch.pose_body_from_tool, *skin,
            *one.squeeze.nodes[:8], one.squeeze.push)  # fmt: skip
        moved.append(shares)
        swings.append(swing)
        rates.append(rate)
    if layer.stacked:
        _swing(parts, slices, swings, rates, sinking)
    joined = toucher.joined([(one.field, touch.pose_body_from_tool, one.squeeze)
                             for touch, one in zip(touches, parts, strict=True)])  # fmt: skip
    slopes = toucher.net.slopes(joined, strain, sinking, gone, ends)
    unit = layer.tissue.youngs_modulus
    out = []
    for k, (touch, one, nodes) in enumerate(zip(touches, parts, every, strict=True)):
        assert one.forces is not None
        lean = 0.0 if touch.slip is None else touch.slip.lean  # its arm goes along with the contact
        own = np.ascontiguousarray(slopes[:, slices[k]])  # of one tool it is, and compiled code asks which
        turned, whole = _turned(own, one.factor * unit, nodes.area, nodes.corners, nodes.shares,
                                one.forces, moved[k], k, layer.vertices, layer.vertex_area_vectors,
                                layer.vertex_areas, touch.pose_body_from_tool[:3, 3], one.stuck,
                                touch.push - lean)  # fmt: skip
        across = {other.name: turned[m] for m, other in enumerate(touches) if m != k}
        out.append(Tangent(turned[k], whole, across))
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turned(slopes, unit, area, corners, shares, forces, moved, k, vertices, area_vectors, areas, origin, stuck,
            push):  # fmt: skip
    """Tangents of tool k by the twist of each of M tools, (M, 6, 6), and `Tangent.whole`.

    Args:
        slopes, unit: rates of the pressures at its nodes by each twist, (6 M, N), over a modulus [Pa].
        area, corners, shares, forces, moved: see Nodes, Pressed and `_rates`.
        vertices, area_vectors, areas, origin, stuck: see unit_wrenches.
        push: what its torque's arm is of, (3,) [N]: it presses on as its origin moves by v, which takes v x push.
    """
    wrenches = unit_wrenches(vertices, area_vectors, areas, origin, corners, stuck)
    out, whole = np.zeros((len(slopes) // 6, 6, 6)), np.zeros(6)
    for row in range(len(slopes)):
        m, i = divmod(row, 6)
        for n in range(len(area)):
            more = unit * area[n] * slopes[row, n]
            for c in range(3):
                force = more * shares[n, c]
                if m == k:
                    force += forces[n] * moved[i, n, c]
                for x in range(6):
                    out[m, x, i] += force * wrenches[n, c, x]
            if m == k:
                whole[i] += more
    x, y, z = push
    out[k, 3, 1] -= z
    out[k, 3, 2] += y
    out[k, 4, 0] += z
    out[k, 4, 2] -= x
    out[k, 5, 0] -= y
    out[k, 5, 1] += x
    return out, whole


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rates(grid, middle, pose, vertices, normals, thicknesses, points, inward, thickness, area, strain, corners, shares,
           sinking, push):  # fmt: skip
    """What changes at nodes with each of six twists of their tool.

    Args:
        grid, middle: see columns.grid_of, and the middle of the tool's box, in its frame, (3,) [m].
        pose: pose of the tool, (4, 4).
        vertices, normals, thicknesses: of the skin.
        points, inward, thickness, area, strain, corners, shares, sinking: see Nodes.
        push: see Squeeze.

    Returns:
        Rates of strain, (6, N) [1/m, 1/rad]; of the depth, or on a stack of `Nodes.sinking` along a way that does not
        swing, (6, N) [-, m/rad]; of barycentric coordinates, (6, N, 3); of places, (6, N, 3) [-, m/rad]; of the sinking
        as that way turns, (N, 3) [m]; and of the row of columns.pushed, (6, 8).
    """
    many, origin, turn = len(area), pose[:3, 3].copy(), np.ascontiguousarray(pose[:3, :3])
    columns, depth = _columns(grid, pose, points, inward, thickness, area, strain), strain * thickness
    mean, size = np.zeros(3), np.sqrt(_dot(push, push))
    for n in range(many):
        for x in range(3):
            mean[x] += area[n] * depth[n] * inward[n, x]
    way, slanted = push / max(size, 1e-300), size > 0
    places, ends = np.empty(((4 if slanted else 3) * many, 3)), np.empty(many)
    for n in range(many):
        for m in range(3):
            places[m * many + n] = points[n] + columns[m, n] * inward[n]
        if slanted:
            ends[n] = sinking[n] / max(_dot(inward[n], way), 1e-3)
            if sinking[n] > depth[n] * (1 + 1e-9):  # the column leads out of the tool's wall, the way goes on
                ray = ray_from(pose, points[n, 0], points[n, 1], points[n, 2], way[0], way[1], way[2])
                ends[n] = depth_in_column(grid, ray, max(4 * ends[n], thickness[n]), ends[n], 0.0)
            places[3 * many + n] = points[n] + ends[n] * way
    found, out = distances_and_gradients(grid[0], grid[1], grid[2], (places - origin) @ turn)
    distance, gradient = found.reshape(-1, many), (out @ turn.T).reshape(-1, many, 3)
    moved, go, turned, thicker = _carried(vertices, normals, thicknesses, points, inward, thickness, corners, shares,
                                          mean / max(np.sqrt(_dot(mean, mean)), 1e-300), origin,
                                          turn @ middle + origin)  # fmt: skip
    strains, deeper = _deepened(points, inward, thickness, area, strain, columns, distance, gradient, go, turned,
                                thicker, origin, grid[3])  # fmt: skip
    if not slanted:
        return strains, deeper, moved, go, np.zeros((many, 3)), np.zeros((6, 8))
    rates = _pushed_on(points, inward, thickness, area, strain, deeper, go, turned)
    walls = np.array([wall_in(grid[3], t) for t in thickness])
    sunk, swing = _sunk(points, inward, depth, sinking, ends, walls, way, gradient[3], go, turned, deeper, origin)
    return strains, sunk, moved, go, swing, rates


def _swing(parts: Sequence[Pressed], slices: Sequence[slice], swings: Sequence[np.ndarray], rates: Sequence[np.ndarray],
           sinking: np.ndarray) -> None:  # fmt: skip
    """Adds to rates of `Nodes.sinking` (6 K, N) what they change as the ways of K tools swing, by any tool's twists.

    Args:
        parts, slices: what they press, and which nodes are whose.
        swings, rates: see `_rates`.
    """
    rows = np.array([pushed(*one.squeeze.nodes[:5]) for one in parts]) if len(parts) > 1 else None
    for m, rate in enumerate(rates):
        turns = rate[:, None, 1:4] if rows is None else _turns(rows, m, rate)
        for k, one in enumerate(parts):
            push, turn = one.squeeze.push, turns[:, k]
            if square := float(push @ push):
                turn = (turn - np.outer(turn @ push / square, push)) / math.sqrt(square)
                sinking[6 * m : 6 * m + 6, slices[k]] += turn @ swings[k].T


def _turns(rows: np.ndarray, m: int, rate: np.ndarray) -> np.ndarray:
    """Rates of columns.shared_pushes of rows (K, 8) as that of tool m changes at six rates (6, 8), (6, K, 3)."""
    out = np.empty((6, len(rows), 3))
    for i in range(6):
        size, fastest = max(rows[m, 7], TINY), max(float(np.linalg.norm(rate[i, 4:7])), abs(rate[i, 7]))
        step = SWING / max(fastest / size, abs(rate[i, 0]) / rows[m, 0])
        ends = np.stack([rows, rows])
        ends[:, m] += step * np.multiply.outer([1.0, -1.0], rate[i])
        out[i] = (shared_pushes(ends[0]) - shared_pushes(ends[1])) / (2 * step)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pushed_on(points, inward, thickness, area, strain, deeper, go, turned):
    """Rates of the row of columns.pushed, (6, 8), as nodes (N,) get deeper, go and turn, (6, N) and (6, N, 3)."""
    row, out = pushed(points, inward, thickness, area, strain), np.zeros((6, 8))
    for k in range(6):
        spread = 0.0
        for n in range(len(area)):
            weight, more = area[n] * strain[n] * thickness[n], area[n] * deeper[k, n]
            out[k, 0] += more
            for x in range(3):
                away = points[n, x] - row[4 + x]
                out[k, 1 + x] += more * inward[n, x] + weight * turned[k, n, x]
                out[k, 4 + x] += (more * away + weight * go[k, n, x]) / row[0]
                spread += more * away * away + 2 * weight * away * go[k, n, x]
        out[k, 7] = 0.5 * (spread / row[0] - out[k, 0] / row[0] * row[7] ** 2) / max(row[7], 1e-12)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _columns(grid, pose, points, inward, thickness, area, strain):
    """Depths in nodes' columns at which the tool is looked at, (3, N) [m]: where it ends, the skin, inside its wall."""
    out = np.zeros((3, len(area)))
    for n in range(len(area)):
        ray = ray_from(pose, points[n, 0], points[n, 1], points[n, 2], inward[n, 0], inward[n, 1], inward[n, 2])
        t = thickness[n]
        out[0, n] = depth_in_column(grid, ray, t, max(-distance_in_column(grid, ray, 0.0), strain[n] * t), 0.0)
        out[2, n] = max(out[0, n] - wall_in(grid[3], t), 0.0)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carried(vertices, normals, thicknesses, points, inward, thickness, corners, shares, mean, origin, centre):
    """How nodes go with each of six twists: along the skin, as their lattice goes with the tool's middle and its spin.

    Returns:
        moved: rates of their barycentric coordinates, (6, N, 3).
        go, turned: of their places and inward normals, (6, N, 3).
        thicker: of the thickness there, (6, N).
    """
    many = len(points)
    moved, go, turned = np.zeros((6, many, 3)), np.zeros((6, many, 3)), np.zeros((6, many, 3))
    thicker, raw, edge, other, face, one = (np.zeros((6, many)), np.empty(3), np.empty(3), np.empty(3), np.empty(3),
                                            np.empty(3))  # fmt: skip
    turn, arm, here = np.empty(3), centre - origin, np.empty(3)
    for n in range(many):
        a, b, c = corners[n]
        normal = inward[n]
        for x in range(3):
            edge[x], other[x] = vertices[b, x] - vertices[a, x], vertices[c, x] - vertices[a, x]
            here[x] = points[n, x] - centre[x]
            raw[x] = -shares[n, 0] * normals[a, x] - shares[n, 1] * normals[b, x] - shares[n, 2] * normals[c, x]
        _cross(edge, other, face)
        size, root = _dot(face, face), 1 / np.sqrt(_dot(raw, raw))
        way = mean if _dot(mean, normal) > FACING else normal
        for k in range(6):
            goes = go[k, n]
            if k < 3:
                goes[k] = 1.0
            else:
                turn[:] = 0.0
                turn[k - 3] = 1.0
                _cross(turn, arm, goes)
                _cross(way, here, one)
                for x in range(3):
                    goes[x] += way[k - 3] * one[x]
            up = _dot(goes, face) / _dot(way, face)
            for x in range(3):
                goes[x] -= up * way[x]  # it stays on its triangle
            _cross(goes, other, one)
            beta = _dot(one, face) / size
            _cross(edge, goes, one)
            gamma = _dot(one, face) / size
            moved[k, n, 0], moved[k, n, 1], moved[k, n, 2] = -beta - gamma, beta, gamma
            turns = turned[k, n]
            for m in range(3):
                v, share = corners[n, m], moved[k, n, m]
                thicker[k, n] += share * thicknesses[v]
                for x in range(3):
                    turns[x] -= root * share * normals[v, x]
            up = _dot(turns, normal)
            for x in range(3):
                turns[x] -= up * normal[x]
    return moved, go, turned, thicker


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _deepened(points, inward, thickness, area, strain, columns, distance, gradient, go, turned, thicker, origin,
              half):  # fmt: skip
    """Rates of strains and depths at nodes, (6, N) each.

    The depth counts in part at the rim of a tool and beside its walls (stmpl_core.nodes): that part changes too.

    Args:
        columns: see `_columns`; distance (., N) and gradient (., N, 3) are those of the tool there, in body axes.
        go, turned, thicker: see `_carried`.
        half: half thickness of the tool [m].
    """
    many = len(area)
    strains, depths = np.zeros((6, many)), np.zeros((6, many))
    for n in range(many):
        normal, t, deep, wall = inward[n], thickness[n], columns[0, n], wall_in(half, thickness[n])
        along = _dot(gradient[0, n], normal)
        if deep <= 0 or abs(along) < LEAST_COSINE:
            continue
        share, rim, inside = strain[n] * t / deep, 1 - distance[1, n] / wall, -2 * distance[2, n] / wall
        felt = min(max(deep / wall - 1, 0.0), 1.0)
        beside = 1 - (1 - min(max(inside, 0.0), 1.0)) * felt
        told = min(max(rim, 0.0), 1.0) * beside
        known = abs(told - share) < 0.02 and told > 0.02  # else the tool has sunk under this skin: its share is held
        for k in range(6):
            rate = _entered(gradient[0, n], points[n], normal, deep, go[k, n], turned[k, n], k, origin) / along
            more = 0.0
            if known and rim < 1:
                more += _entered(gradient[1, n], points[n], normal, 0.0, go[k, n], turned[k, n], k, origin) / wall / rim
            if known and felt > 0 and inside < 1:
                over = _entered(gradient[2, n], points[n], normal, columns[2, n], go[k, n], turned[k, n], k, origin)
                if inside > 0:
                    more += 2 * felt * (over - rate * _dot(gradient[2, n], normal)) / wall / beside
                if felt < 1:
                    more -= (1 - max(inside, 0.0)) * rate / wall / beside
            if deep < MAX_COLUMN_STRAIN * t:
                depths[k, n] = share * (rate + more * deep)
            strains[k, n] = (depths[k, n] - strain[n] * thicker[k, n]) / t
    return strains, depths


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sunk(points, inward, depth, sinking, ends, walls, way, gradient, go, turned, deeper, origin):
    """Rates of `Nodes.sinking`, (6, N), of depths along one way (3,) for all; and as that turns, (N, 3) [m].

    Args:
        ends: where the tool ends along that way, (N,) [m].
        walls: see rays.wall_in, (N,) [m].
    """
    out, swing, still = deeper.copy(), np.zeros((len(depth), 3)), np.zeros(3)
    for n in range(len(depth)):
        along, cosine, s = _dot(gradient[n], way), _dot(inward[n], way), ends[n]
        more = s * cosine - depth[n]
        if abs(more) <= depth[n] * 1e-9 or abs(along) < LEAST_COSINE or cosine <= 0:
            continue
        share = min(max((sinking[n] - depth[n]) / more, 0.0), 1.0)  # of what it sinks more than its column says
        rises = share < 1 and abs(share - depth[n] / walls[n]) < 0.02
        for k in range(6):
            rate = _entered(gradient[n], points[n], way, s, go[k, n], still, k, origin) / along
            rate = rate * cosine + s * _dot(turned[k, n], way)
            out[k, n] += share * (rate - deeper[k, n]) + (more * deeper[k, n] / walls[n] if rises else 0.0)
        for x in range(3):
            swing[n, x] = share * s * (inward[n, x] - cosine / along * gradient[n, x])
    return out, swing


@numba.njit(cache=True, error_model="numpy", inline="always")
def _entered(gradient, point, normal, s, go, turned, k, origin):
    """Rate of the depth inside a tool of twist k, at s along a column that goes by `go` and turns by `turned`."""
    x, y, z = (point[0] + s * normal[0] - origin[0], point[1] + s * normal[1] - origin[1],
               point[2] + s * normal[2] - origin[2])  # fmt: skip
    g0, g1, g2 = gradient
    rate = -g0 * (go[0] + s * turned[0]) - g1 * (go[1] + s * turned[1]) - g2 * (go[2] + s * turned[2])
    if k < 3:
        return rate + gradient[k]
    if k == 3:
        return rate + y * g2 - z * g1
    return rate + (z * g0 - x * g2 if k == 4 else x * g1 - y * g0)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True, error_model="numpy", inline="always")
def _cross(a, b, out):
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
