"""Soundness of a layer's mesh, vertex by vertex: what a method needs to know to say how far it may be trusted."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, NamedTuple, Self

import numba
import numpy as np
import scipy.sparse as sp
from scipy.spatial import KDTree

from stmpl_core.layer import SoftLayer
from stmpl_core.seams import edge_table

if TYPE_CHECKING:
    from stmpl_core.bend import Bend

STEEP = 0.25  # slope of the thickness from triangle to triangle; trained is up to 0.2
STEEP_SHARE = 0.02  # share of what moves or presses that may be so steep
LONG = 2.2  # length of a triangle over its width; trained is up to about 2
LONG_SHARE = 0.3  # share of what moves or presses that may be in such: to there 0.6 % of force, 3 % of the peak
COARSE = 2.0, 2.5  # longest edge over thickness, and over the median edge, from which a tool may press between corners
BORDER = 2.0  # distance of a load from the open border, over t; nearer the worst vertex is 6 to 21 % off
STACK_BORDER = 1.2  # the same on stacks, whose coarse response knows the border: to there they are no worse than inside
BORDER_SHARE = 0.05  # share of the load that may be nearer
FOLD = 0.15  # fold ratio of prisms under bent skin, below which they are none that the networks know
STRETCH = (0.8, 1.25)  # stretch of bent skin over rest, outside of which thickness and mesh are not what they were
HOLLOW = -0.25  # curvature times thickness of bent skin, below which it is more hollow than the networks know
FACING = 1.5  # distance to skin that faces it, over t, below which a tool touches both
CROSSED = 0.9  # distance of a column's end from the nearest skin, over its length, below which it crosses others
CROSSED_SHARE = 0.05  # share of the force that may be on such
BONY_SHARE = 0.2  # share of the force that may be where bone is nearer than the layer knows
BENT_SHARE = 0.05  # share of the load that may be on skin that a bend spoils


class Bent(NamedTuple):
    """What joints did to N vertices of a skin; as at rest where a vertex goes with one bone alone.

    Args:
        fold: least fold ratio of the prisms around it (stmpl_core.extrusion), (N,) [-].
        least, most: least and largest stretch of the triangles around it, (N,) [-].
        curvature: least curvature of the skin times the thickness, (N,) [-]; below 0: concave; infinite where it is no
            more hollow than at rest.
        gap: distance over the thickness to skin that faces it through the air and did not at rest, (N,) [-]; 0 where
            they are inside each other.
    """

    fold: np.ndarray
    least: np.ndarray
    most: np.ndarray
    curvature: np.ndarray
    gap: np.ndarray

    @property
    def spoilt(self) -> np.ndarray:
        """Mask of the vertices where an answer is not to be believed, (N,)."""
        stretched = (self.least < STRETCH[0]) | (self.most > STRETCH[1])
        return (self.fold < FOLD) | stretched | (self.curvature < HOLLOW) | (self.gap < FACING)

    def of_force(self, force: np.ndarray) -> list[str]:
        """What a bend spoils under forces (N,) on these vertices, as sentences."""
        total, out = max(float(force.sum()), 1e-300), []
        fold, least, most, curvature, gap = self
        for bad, sentence in (
            (fold < FOLD, f"its tissue folds (ratio {fold.min():.2g}, sound is from {FOLD:g} on)"),
            ((least < STRETCH[0]) | (most > STRETCH[1]), f"its skin is {least.min():.2g} to {most.max():.2g} times as "
             f"long as at rest, sound is {STRETCH[0]:g} to {STRETCH[1]:g}"),
            (curvature < HOLLOW, f"its skin is hollow (curvature times thickness {curvature.min():.2g}, sound is from "
             f"{HOLLOW:g} on)"),
            (gap < FACING, f"its skin faces other skin, {gap.min():.2g} thicknesses away"),
        ):  # fmt: skip
            share = float(force[bad].sum()) / total
            if share > BENT_SHARE:
                out.append(f"the limb is bent so that under {share:.0%} of the force {sentence}")
        return out


class Soundness:
    """Where a layer is as the networks know skin: neither steep, nor badly meshed, nor at its border.

    Args:
        layer: soft layer at rest, as methods count its thickness.
        below: the same skin with what is below it as it is, if that is another.

    Attributes:
        steep, long, bony, crossed: masks of vertices, (V,).
        border: distance from the open border, over t, (V,).
        facets: how far the flat triangles around a vertex lie off the smooth skin that they stand for, (V,) [m].
        least_border: least such distance of a load that is sound [-].
        bend: what joints did to it; None: it is at rest.
    """

    bend: Bend | None = None

    def __init__(self, layer: SoftLayer, below: SoftLayer | None = None) -> None:
        below = below or layer
        self.steep = slope_of_thickness(layer) > STEEP
        self.long = longest_over_width(layer) > LONG
        self.border = border_distance(layer) / layer.thickness
        self.facets = np.abs(below_curved(layer)) + roughness(layer)
        self.least_border = STACK_BORDER if layer.stacked else BORDER
        self._near = self.border < self.least_border
        self.crossed = crossed_columns(below)
        self.bony = np.zeros(len(self.steep), bool) if below.bony is None else below.bony

    def at(self, bend: Bend) -> Self:
        """The same of a skin that joints have bent."""
        out = copy(self)
        out.bend = bend
        return out

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
        bent = self.bend.of_force(loaded, force) if self.bend is not None and total > 0 else []
        if not total > 0 or float(force[self.border[loaded] < self.least_border].sum()) <= BORDER_SHARE * total:
            return bent
        nearest = float(self.border[loaded].min())
        far = f"the load comes to {nearest:.1f} thicknesses from the open border; sound from {self.least_border:g} on"
        return [far, *bent]

    def of_contact(self, loaded: np.ndarray, force: np.ndarray) -> list[str]:
        """What is wrong with the skin under a tool that presses with forces (L,) on vertices (L,), as sentences."""
        steep, long, near, bony, crossed = _shares(loaded, force, self.steep, self.long, self._near, self.bony,
                                                   self.crossed)  # fmt: skip
        told = self.of_mesh(steep, long, "the force")
        if bony > BONY_SHARE:
            told.append(f"{bony:.0%} of the force is over a kneecap, a shin or the tip of an elbow, where people have "
                        "bone right under the skin: far too soft here")  # fmt: skip
        if crossed > CROSSED_SHARE:
            told.append(f"under {crossed:.0%} of the force the layer is thicker than half of the limb")
        return told if self.bend is None and near <= BORDER_SHARE else [*told, *self.of_load(loaded, force)]


@numba.njit(cache=True, nogil=True)
def _shares(loaded, force, *masks):
    """Shares of forces (L,) on vertices (L,) that are on masks (V,) of all vertices."""
    total, out = 1e-300, np.zeros(len(masks))
    for n in range(len(loaded)):
        total += force[n]
        for m in range(len(masks)):
            out[m] += force[n] if masks[m][loaded[n]] else 0.0
    return out / total


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


def crossed_columns(layer: SoftLayer) -> np.ndarray:
    """Mask of the columns that end nearer to other skin than to their own: they are longer than the limb is deep, (V,).

    Only of layers that end along their normals: where bones end them, many lie nearer to one side.
    """
    if layer.core is not None:
        return np.zeros(len(layer.vertices), bool)
    away = KDTree(layer.vertices).query(layer.inner_vertices)[0]
    return np.asarray(away < CROSSED * layer.thickness)


def longest_over_width(layer: SoftLayer) -> np.ndarray:
    """Longest of the triangles around each vertex: its longest edge over the width of an even one of its area, (V,)."""
    _, length = _lengths(layer)
    out = np.zeros(len(layer.vertices))
    for corner in range(3):
        np.maximum.at(out, layer.faces[:, corner], length)
    return out


def too_long(layer: SoftLayer) -> np.ndarray:
    """Numbers of the triangles so long, for layer and mesh, that a tool may press unseen between their corners."""
    longest, length = _lengths(layer)
    uneven = (length > LONG) | (longest > COARSE[1] * layer.edge_length)
    return np.flatnonzero(uneven & (longest > COARSE[0] * layer.thickness[layer.faces].max(axis=1)))


def _lengths(layer: SoftLayer) -> tuple[np.ndarray, np.ndarray]:
    """Longest edge of each triangle, (F,) [m], and that over the width of an even one of its area, (F,)."""
    corners = layer.vertices[layer.faces]
    square = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
    return np.sqrt(square), square * (np.sqrt(3) / 4) / np.linalg.norm(layer.face_area_vectors, axis=1)


def below_curved(layer: SoftLayer) -> np.ndarray:
    """Mean way from the flat triangles around each vertex out to a curved skin through their corners, (V,) [m].

    Of a height that is quadratic over a triangle the mean is the sum of e K e / 24 over its edges e, with the curvature
    K along them from the normals at their ends. Below 0 where the skin is hollow; 0 at a vertex without triangles.
    """
    along, turned = (np.roll(each[layer.faces], -1, axis=1) - each[layer.faces]
                     for each in (layer.vertices, layer.normals))  # fmt: skip
    areas = np.linalg.norm(layer.face_area_vectors, axis=1)
    below = areas * np.einsum("fkx,fkx->f", along, turned) / 24
    weights, sums = (np.bincount(layer.faces.ravel(), np.repeat(each, 3), len(layer.vertices))
                     for each in (areas, below))  # fmt: skip
    return sums / np.maximum(weights, 1e-300)


def roughness(layer: SoftLayer) -> np.ndarray:
    """How far each vertex lies off its neighbours beyond what they do off theirs, along its normal, (V,) [m].

    Smooth skin, however curved, has next to none; that of a scan with noise is its noise. None at the border.
    """
    one, other = edge_table(layer.faces)[0].T
    linked = sp.csr_matrix((np.ones(2 * len(one)), (np.r_[one, other], np.r_[other, one])), (len(layer.vertices),) * 2)
    mean = sp.diags(1 / np.maximum(np.asarray(linked.sum(axis=1)).ravel(), 1.0)) @ linked
    off = np.einsum("vx,vx->v", mean @ layer.vertices - layer.vertices, layer.normals)
    out = np.abs(off - mean @ off)
    out[layer.border] = 0.0
    return out


def border_distance(layer: SoftLayer) -> np.ndarray:
    """Straight distance of each vertex from the layer's open border, (V,) [m]; infinite if it has none."""
    if not len(layer.border):
        return np.full(len(layer.vertices), np.inf)
    return np.asarray(KDTree(layer.vertices[layer.border]).query(layer.vertices)[0])
