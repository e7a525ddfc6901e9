"""Wrenches: force and torque of what presses on the skin, as the tool feels it.

Pressures are across the skin at rest. Skin that sticks to a tool which comes straight is pushed along the tool's way,
so it carries something along itself too: where the skin's normal stands at an angle a to the way, a force f across it
belongs to one of f / cos a along the way, f sin^2 a / cos a more there than f itself has. Where the tool is round the
force turns on, the way that its surface faces. Under balls, discs and capsules on limbs finite elements say that 1 to
13 % of the force is carried so, and with MORE the whole is right to 1.3 %.
"""

from __future__ import annotations

import numba
import numpy as np

LEAST_COSINE = 0.5  # of that angle
MORE = 1.25  # what skin carries along itself, over that: 1 to 1.4 under most tools
ONE_WAY = 0.5  # net force over the sum of the sizes of its parts, from which it is one way, to ...
ALL_ONE_WAY = 0.75  # ... which it is


@numba.njit(cache=True, inline="always", error_model="numpy")
def along(area_vector, way):
    """Force along a way (3,) that skin carries along itself, for a pressure [m2]; its area vector points out."""
    area = np.sqrt(area_vector[0] ** 2 + area_vector[1] ** 2 + area_vector[2] ** 2)
    cosine = -(area_vector[0] * way[0] + area_vector[1] * way[1] + area_vector[2] * way[2]) / max(area, 1e-300)
    return MORE * area * max(1 - cosine * cosine, 0.0) / max(cosine, LEAST_COSINE) if cosine > 0 else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def wrench_of(pressure, vertices, points, area_vectors, origin, sticks):
    """Wrench about a point, (6,), of pressures (N,) at vertices (N,) [N, N m].

    Args:
        pressure, vertices: pressures, (N,) [Pa], and numbers of the vertices that they are at, (N,).
        points, area_vectors: of all vertices, (V, 3) [m], [m2].
        origin: point about which torque is told, (3,) [m].
        sticks: whether what sticking skin carries along itself belongs to it.

    Returns:
        wrench: force and torque, (6,).
        stuck: way of what sticking skin carries along itself, (3,), its length the factor on `along` of each vertex.
        carried: size of that, which is part of the force [N].
    """
    out, way, arm, total, carried = np.zeros(6), np.zeros(3), np.empty(3), 0.0, 0.0
    for n in range(len(vertices)):
        v, square = vertices[n], 0.0
        for x in range(3):
            way[x] -= pressure[n] * area_vectors[v, x]
            square += area_vectors[v, x] ** 2
        total += pressure[n] * np.sqrt(square)
    size = np.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    share = min(max((size / max(total, 1e-300) - ONE_WAY) / (ALL_ONE_WAY - ONE_WAY), 0.0), 1.0) if sticks else 0.0
    for x in range(3):
        way[x] /= max(size, 1e-300)
    f = np.empty(3)
    for n in range(len(vertices)):
        v = vertices[n]
        more = share * pressure[n] * along(area_vectors[v], way) if share > 0 else 0.0
        carried += more
        for x in range(3):
            f[x] = -pressure[n] * area_vectors[v, x] + more * way[x]
            arm[x] = points[v, x] - origin[x]
            out[x] += f[x]
        out[3] += arm[1] * f[2] - arm[2] * f[1]
        out[4] += arm[2] * f[0] - arm[0] * f[2]
        out[5] += arm[0] * f[1] - arm[1] * f[0]
    for x in range(3):
        way[x] *= share
    return out, way, carried


@numba.njit(cache=True, error_model="numpy")
def unit_wrenches(points, area_vectors, areas, origin, corners, stuck):
    """Wrench about the origin of a unit force across the skin at each corner of each node, (N, 3, 6).

    Args:
        points, area_vectors, areas: of all vertices.
        origin: point about which torque is told, (3,) [m].
        corners: numbers of the vertices around nodes, (N, 3).
        stuck: that of `wrench_of`, (3,).
    """
    out, arm, f, way = np.empty((len(corners), 3, 6)), np.empty(3), np.empty(3), np.zeros(3)
    share = np.sqrt(stuck[0] ** 2 + stuck[1] ** 2 + stuck[2] ** 2)
    if share > 0:
        way = stuck / share
    for n in range(len(corners)):
        for c in range(3):
            v = corners[n, c]
            more = share * along(area_vectors[v], way) if share > 0 else 0.0
            for x in range(3):
                f[x] = (more * way[x] - area_vectors[v, x]) / areas[v]
                arm[x] = points[v, x] - origin[x]
                out[n, c, x] = f[x]
            out[n, c, 3] = arm[1] * f[2] - arm[2] * f[1]
            out[n, c, 4] = arm[2] * f[0] - arm[0] * f[2]
            out[n, c, 5] = arm[0] * f[1] - arm[1] * f[0]
    return out
