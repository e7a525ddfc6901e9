"""Soundness of a layer's mesh, vertex by vertex: what a method needs to know to say how far it may be trusted."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from stmpl_core.layer import SoftLayer

STEEP = 0.25  # slope of the thickness from triangle to triangle; trained is up to 0.2
STEEP_SHARE = 0.02  # share of what moves or presses that may be so steep
LONG = 2.2  # length of a triangle over its width; trained is up to about 2
LONG_SHARE = 0.05  # share of what moves or presses that may be in such
BORDER = 2.0  # distance of a load from the open border, over t; nearer the worst vertex is 6 to 21 % off
BORDER_SHARE = 0.05  # share of the load that may be nearer


class Soundness:
    """Where a layer is as the networks know skin: neither steep, nor badly meshed, nor at its border.

    Args:
        layer: soft layer at rest.

    Attributes:
        steep, long: masks of vertices, (V,).
        border: distance from the open border, over t, (V,).
    """

    def __init__(self, layer: SoftLayer) -> None:
        self.steep = slope_of_thickness(layer) > STEEP
        self.long = longest_over_width(layer) > LONG
        self.border = border_distance(layer) / layer.thickness

    def of_mesh(self, steep: float, long: float, where: str) -> list[str]:
        """What is wrong with shares of steep and long triangles, as sentences."""
        out = []
        if steep > STEEP_SHARE:
            out.append(f"the thickness changes by more than {STEEP:g} mm a mm at {steep:.0%} of {where}")
        if long > LONG_SHARE:
            out.append(f"triangles are longer than {LONG:g} times their width at {long:.0%} of {where}")
        return out

    def of_load(self, loaded: np.ndarray, force: np.ndarray) -> list[str]:
        """What is wrong with where forces (L,) on vertices (L,) press, as sentences."""
        total = float(force.sum())
        if not total > 0 or float(force[self.border[loaded] < BORDER].sum()) <= BORDER_SHARE * total:
            return []
        nearest = float(self.border[loaded].min())
        return [f"the load comes to {nearest:.1f} thicknesses from the open border; trained is from {BORDER:g} on"]

    def of_contact(self, loaded: np.ndarray, force: np.ndarray) -> list[str]:
        """What is wrong with the skin under a tool that presses with forces (L,) on vertices (L,), as sentences."""
        total = max(float(force.sum()), 1e-300)
        steep, long = (float(force[mask[loaded]].sum()) / total for mask in (self.steep, self.long))
        return [*self.of_mesh(steep, long, "the force"), *self.of_load(loaded, force)]


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
