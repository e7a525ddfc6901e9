"""Estimates of what an answer of finite elements leaves: the mesh width, the cut, the depth of a wedge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from fem_tools.system import System
from stmpl_core.layer import SoftLayer

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


def truncation_error(patch: Patch, u: np.ndarray, layer: SoftLayer) -> float:
    """Estimate of what the held rim of the patch changes [m]: the motion one thickness inside the cut.

    Zero where the patch is the whole layer.
    """
    n = len(patch.vertices)
    own = np.isin(patch.vertices, layer.border)
    cut = patch.vertices[patch.fixed[:n] & ~own]
    if not len(cut):
        return 0.0
    points = layer.vertices[patch.vertices]
    gap = KDTree(layer.vertices[cut]).query(points)[0]
    near = gap < 1.25 * layer.thickness.max()
    return float(np.linalg.norm(u[:n, 0][near], axis=1).max(initial=0.0))


def discretisation_error(system: System, u: np.ndarray) -> float:
    """Estimate of the largest error of the skin's displacement that the mesh width leaves [m].

    The middle of each edge is where a linear interpolation is worst: by Hermite's cubic through the recovered nodal
    slopes it is off by |(g_b - g_a) . e| / 8 (Zienkiewicz & Zhu's recovery, IJNME 24, 1987, on the skin).
    """
    mesh, skin = system.mesh, system.rest[:, 0]
    corners, value = mesh.triangles, u[:, 0]
    a, b, c = (skin[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    double = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / double
    slopes = (
        sum(
            value[corners[:, k]][:, :, None] * np.cross(normal, edge)[:, None, :]
            for k, edge in enumerate((c - b, a - c, b - a))
        )
        / double[:, :, None]
    )  # (T, 3, 3) du_i / dx_j
    nodal, area = np.zeros((len(skin), 3, 3)), np.zeros(len(skin))
    for k in range(3):
        np.add.at(nodal, corners[:, k], slopes * double[:, :, None])
        np.add.at(area, corners[:, k], double[:, 0])
    nodal /= np.maximum(area, 1e-300)[:, None, None]
    edges = np.unique(np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    along = skin[edges[:, 1]] - skin[edges[:, 0]]
    bend = np.einsum("eij,ej->ei", nodal[edges[:, 1]] - nodal[edges[:, 0]], along) / 8
    return float(np.linalg.norm(bend, axis=1).max(initial=0.0))
