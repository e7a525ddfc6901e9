"""Soundness of a layer's mesh, vertex by vertex: what a method needs to know to say how far it may be trusted."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from stmpl_core.layer import SoftLayer


def slope_of_thickness(layer: SoftLayer) -> np.ndarray:
    """Root mean square over the triangles around each vertex of the thickness's gradient along them, (V,) [-]."""
    a, b, c = (layer.vertices[layer.faces[:, k]] for k in range(3))
    s, t, u = (layer.thickness[layer.faces[:, k], None] for k in range(3))
    areas = np.linalg.norm(layer.face_area_vectors, axis=1)
    normals, double = layer.face_area_vectors / areas[:, None], 2 * areas
    turned = s * np.cross(normals, c - b) + t * np.cross(normals, a - c) + u * np.cross(normals, b - a)
    square = ((turned / double[:, None]) ** 2).sum(axis=1) * double
    sums, weights = np.zeros(len(layer.vertices)), np.zeros(len(layer.vertices))
    for corner in range(3):
        np.add.at(sums, layer.faces[:, corner], square)
        np.add.at(weights, layer.faces[:, corner], double)
    return np.sqrt(sums / np.maximum(weights, 1e-300))


def longest_over_width(layer: SoftLayer) -> np.ndarray:
    """Longest of the triangles around each vertex: its longest edge over the width of an even one of its area, (V,)."""
    corners = layer.vertices[layer.faces]
    longest = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
    areas = np.linalg.norm(layer.face_area_vectors, axis=1)
    out = np.zeros(len(layer.vertices))
    for corner in range(3):
        np.maximum.at(out, layer.faces[:, corner], longest * (np.sqrt(3) / 4) / areas)
    return out


def border_distance(layer: SoftLayer) -> np.ndarray:
    """Straight distance of each vertex from the layer's open border, (V,) [m]; infinite if it has none."""
    if not len(layer.border):
        return np.full(len(layer.vertices), np.inf)
    return np.asarray(KDTree(layer.vertices[layer.border]).query(layer.vertices)[0])
