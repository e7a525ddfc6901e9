"""Winding: how often a closed surface goes round each node of a grid, exactly."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def winding_numbers(corners, origin, spacing, shape):
    """Winding numbers of a closed surface at nodes (I, J, K) of a grid: 0 outside, 1 inside, 2 where two bodies are.

    Along each line of nodes they change by one where it goes through a face. Whether it does is told by how its point
    lies to each edge, which both faces of an edge reckon alike (Sunday 2001, "Inclusion of a point in a polygon"):
    whatever rounding does, a line leaves a closed surface as often as it enters.

    Args:
        corners: corners of the faces, wound outwards, (F, 3, 3) [m].
        origin: position of node (0, 0, 0), (3,) [m].
        spacing: edge of the grid's cells [m].
        shape: nodes each way, (3,); those of the last axis end outside the surface.
    """
    out = np.zeros((shape[0], shape[1], shape[2]), np.int16)
    x, y, z = np.empty(3), np.empty(3), np.empty(3)
    for face in range(len(corners)):
        for n in range(3):
            x[n] = (corners[face, n, 0] - origin[0]) / spacing
            y[n] = (corners[face, n, 1] - origin[1]) / spacing
            z[n] = (corners[face, n, 2] - origin[2]) / spacing
        for j in range(max(int(np.ceil(y.min())), 0), min(int(np.floor(y.max())) + 1, shape[1])):
            for i in range(max(int(np.ceil(x.min())), 0), min(int(np.floor(x.max())) + 1, shape[0])):
                turns = _passes(x[0], y[0], x[1], y[1], i, j)
                turns += _passes(x[1], y[1], x[2], y[2], i, j) + _passes(x[2], y[2], x[0], y[0], i, j)
                if turns != 0:
                    k = int(np.ceil(min(max(_height(x, y, z, i, j), z.min()), z.max())))
                    if k < shape[2]:
                        out[i, j, max(k, 0)] -= turns
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(1, shape[2]):
                out[i, j, k] += out[i, j, k - 1]
    return out


@numba.njit(cache=True, inline="always")
def _passes(ax, ay, bx, by, i, j):
    """1 where the edge from a to b passes the point (i, j) on its right upwards, -1 downwards, else 0.

    The edge is taken from its lower end, so that it says the same of a point both ways.
    """
    if (ay > j) == (by > j):
        return 0
    way = 1 if ay < by else -1
    if way < 0:
        ax, ay, bx, by = bx, by, ax, ay
    return way if (bx - ax) * (j - ay) - (by - ay) * (i - ax) > 0 else 0


@numba.njit(cache=True, inline="always")
def _height(x, y, z, i, j):
    """Height at which the line over (i, j) meets the plane of a face."""
    ux, uy, uz = x[1] - x[0], y[1] - y[0], z[1] - z[0]
    vx, vy, vz = x[2] - x[0], y[2] - y[0], z[2] - z[0]
    area = ux * vy - uy * vx
    if area == 0.0:
        return z[0]
    s, t = ((i - x[0]) * vy - (j - y[0]) * vx) / area, (ux * (j - y[0]) - uy * (i - x[0])) / area
    return z[0] + s * uz + t * vz
