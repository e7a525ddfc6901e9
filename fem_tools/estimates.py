"""Estimates of what an answer of finite elements leaves: the mesh width, the cut, the depth of a wedge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from fem_tools.system import System

if TYPE_CHECKING:
    from fem_tools.patch import Patch

# The stated bound: shares of the estimates and of the peak, fitted on hard-edged and smooth loads of 5-18 mm on limbs,
# p / E 0.03-1.5, nu 0.3-0.49, reach 3-6, against a quarter of the mesh width, two wedges deep. How often it holds, and
# how tight it is: docs/ground_truth.md.
DISCRETISATION_SHARE, TRUNCATION_SHARE = 0.95, 0.35
PEAK_SHARE = 0.025  # one wedge through the thickness leaves this share; as much again at p = E, as its square


def error_bound(discretisation: float, truncation: float, u: np.ndarray, layers: int, ratio: float) -> float:
    """The largest error to expect at any vertex [m].

    Args:
        discretisation: estimate of what the mesh width leaves [m].
        truncation: estimate of what the held rim changes [m].
        u: displacement of the nodes, (C, levels, 3) [m].
        layers: number of wedges through the thickness.
        ratio: largest p / E [-].
    """
    peak = float(np.linalg.norm(u[:, 0], axis=1).max(initial=0.0))
    depth = PEAK_SHARE * peak * (1 / layers**2 + ratio**2)
    return DISCRETISATION_SHARE * discretisation + TRUNCATION_SHARE * truncation + depth


def truncation_error(patch: Patch, u: np.ndarray) -> float:
    """Estimate of what the held rim of the patch changes [m]: the motion one thickness inside the cut.

    Zero where the patch is the whole layer.
    """
    return float(np.linalg.norm(u[patch.near_cut, 0], axis=1).max(initial=0.0))


@njit(cache=True)
def within(points, of, width):
    """Numbers of points (N, 3) that are nearer than their own width (N,) to some others (M, 3) [m]."""
    near = np.zeros(len(points), dtype=np.bool_)
    for k in range(len(points)):
        for n in range(len(of)):
            x, y, z = points[k, 0] - of[n, 0], points[k, 1] - of[n, 1], points[k, 2] - of[n, 2]
            if x * x + y * y + z * z < width[k] * width[k]:
                near[k] = True
                break
    return np.flatnonzero(near)


def discretisation_error(system: System, u: np.ndarray) -> float:
    """Estimate of the largest error of the skin's displacement that the mesh width leaves [m].

    The middle of each edge is where a linear interpolation is worst: by Hermite's cubic through the recovered nodal
    slopes it is off by |(g_b - g_a) . e| / 8 (Zienkiewicz & Zhu's recovery, IJNME 24, 1987, on the skin).
    """
    return float(_worst_bend(system.rest[:, 0], system.mesh.triangles, u[:, 0]))


@njit(cache=True)
def _worst_bend(skin, triangles, value):
    """discretisation_error of values (C, 3) at the nodes `skin` (C, 3) of triangles (T, 3)."""
    nodal, area = np.zeros((len(skin), 9)), np.zeros(len(skin))
    ab, ac, across = np.empty(3), np.empty(3), np.empty(3)
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        for i in range(3):
            ab[i], ac[i] = skin[b, i] - skin[a, i], skin[c, i] - skin[a, i]
        n0, n1, n2 = ab[1] * ac[2] - ab[2] * ac[1], ab[2] * ac[0] - ab[0] * ac[2], ab[0] * ac[1] - ab[1] * ac[0]
        double = (n0 * n0 + n1 * n1 + n2 * n2) ** 0.5
        area[a], area[b], area[c] = area[a] + double, area[b] + double, area[c] + double
        for i in range(3):
            # the slope along the skin, times the double area: du x normal, of (u_b - u_a) ac - (u_c - u_a) ab
            rise, run = (value[b, i] - value[a, i]) / double, (value[c, i] - value[a, i]) / double
            for j in range(3):
                across[j] = rise * ac[j] - run * ab[j]
            s0 = across[1] * n2 - across[2] * n1
            s1 = across[2] * n0 - across[0] * n2
            s2 = across[0] * n1 - across[1] * n0
            for v in (a, b, c):
                nodal[v, 3 * i] += s0
                nodal[v, 3 * i + 1] += s1
                nodal[v, 3 * i + 2] += s2
    for v in range(len(skin)):
        if area[v] > 0.0:
            for i in range(9):
                nodal[v, i] /= area[v]
    worst = 0.0
    for t in range(len(triangles)):
        for k in range(3):
            a, b, size = triangles[t, k], triangles[t, (k + 1) % 3], 0.0
            for i in range(3):
                bend = 0.0
                for j in range(3):
                    bend += (nodal[b, 3 * i + j] - nodal[a, 3 * i + j]) * (skin[b, j] - skin[a, j])
                size += bend * bend
            worst = max(worst, size)
    return worst**0.5 / 8
