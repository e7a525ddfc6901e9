"""Where a layer folds when its skin is pushed inwards along its normals, and a thickness that does not fold."""

from __future__ import annotations

import logging

import numpy as np

from stmpl_core.arrays import Faces, PerVertex, Points
from stmpl_core.layer import SoftLayer

log = logging.getLogger(__name__)

THINNING_FACTOR = 0.95  # factor on the thickness under a folding face, each pass
MAX_THICKNESS_SLOPE = 0.3  # slope of the thickness along the skin [m/m]; a step would fold the layer by itself
MIN_THICKNESS_SHARE = 0.1  # thinnest over asked thickness; what folds there is a fold of the skin itself
FEW = 1e-3  # share of the skin up to which nobody is warned: a crease of ears, toes, or between the legs
PASSES = 80  # passes of thinning at most


def fold_ratios(vertices: Points, inner: Points, faces: Faces) -> np.ndarray:
    """Smallest determinant of each prism's map, over the mean of its size, (F,) [-].

    The prism between a face and its inward copy is mapped soundly where this is above 0; a right prism has 1. The
    determinant at depth s is (e1 x e2)(s) . (x_outer - x_inner); it is quadratic in s and linear over the face, and is
    looked at in the three corners at s = 0, 1/2, 1.
    """
    out, into = vertices[faces], inner[faces]
    dets = []
    for depth in (0.0, 0.5, 1.0):
        at = (1 - depth) * out + depth * into
        area = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
        dets.append(np.einsum("fi,fki->fk", area, out - into))
    table = np.concatenate(dets, axis=1)
    return table.min(axis=1) / np.abs(table).mean(axis=1)


def foldfree_thickness(layer: SoftLayer, *, least: float = 0.15) -> PerVertex:
    """The layer's thickness, thinned where the skin curves more tightly than the layer is thick, (V,) [m].

    Thins the vertices under prisms whose fold ratio is below `least`, and lets the thickness grow back along the skin
    with a slope of at most 0.3. Logs where it changed anything, and which folds of the skin itself are left: a warning
    above a thousandth of the skin.
    """
    thickness = layer.thickness.copy()
    edges = layer.edges
    reach = MAX_THICKNESS_SLOPE * np.linalg.norm(layer.vertices[edges[:, 0]] - layer.vertices[edges[:, 1]], axis=1)
    hopeless = _ratios(layer, MIN_THICKNESS_SHARE * thickness) < least
    for _ in range(PASSES):
        bad = np.unique(layer.faces[(_ratios(layer, thickness) < least) & ~hopeless])
        if not len(bad):
            break
        thickness[bad] *= THINNING_FACTOR
        _limit_slope(thickness, edges, reach)
    _report(layer, thickness, least)
    return thickness


def _ratios(layer: SoftLayer, thickness: PerVertex) -> np.ndarray:
    return fold_ratios(layer.vertices, layer.vertices - thickness[:, None] * layer.normals, layer.faces)


def _limit_slope(thickness: PerVertex, edges: np.ndarray, reach: np.ndarray) -> None:
    """Lowers the thickness until no edge is steeper than MAX_THICKNESS_SLOPE."""
    a, b = edges.T
    while True:
        before = thickness.copy()
        np.minimum.at(thickness, a, before[b] + reach)
        np.minimum.at(thickness, b, before[a] + reach)
        if np.allclose(before, thickness, rtol=0, atol=1e-7):
            return


def _report(layer: SoftLayer, thickness: PerVertex, least: float) -> None:
    thinned = np.flatnonzero(thickness < layer.thickness - 1e-6)
    left = _ratios(layer, thickness) < least
    if len(thinned):
        thinnest, share = int(thickness.argmin()), layer.vertex_areas[thinned].sum() / layer.vertex_areas.sum()
        log.log(
            logging.WARNING if share > FEW else logging.INFO,
            "the skin curves more tightly than the layer is thick: thinned at %d of %d vertices (%.1f %% of the area), "
            "most at vertex %d, %.1f -> %.1f mm",
            len(thinned), len(thickness), 100 * share, thinnest, layer.thickness[thinnest] * 1e3,
            thickness[thinnest] * 1e3,
        )
    if left.any():
        log.log(logging.WARNING if left.mean() > FEW else logging.INFO,
                "the skin itself is folded at %d faces, the first is face %d: no thickness suits them there",
                int(left.sum()), int(left.argmax()))
