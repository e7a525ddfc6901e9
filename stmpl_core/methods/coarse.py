"""Coarse: any method on a coarser mesh of the same skin, its answer carried back to the layer's vertices."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import igl
import numpy as np
import scipy.sparse as sp

from stmpl_core.arrays import Points
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import Method, prepared
from stmpl_core.trust import Displacement

if TYPE_CHECKING:
    from stmpl_core.body import Body

MIN_COARSENING = 1.2  # coarsening that saves more than it costs [-]


class Coarse:
    """Solves on a mesh `coarsening` times as wide; the work of most methods falls as the fourth power of that.

    Forces are handed over so that their sum is kept, displacements are interpolated linearly; that flattens the peak by
    about h^2 / 8 of its curvature, which no bound of the method inside knows of: none is stated.

    Args:
        method: method that answers; not yet prepared.
        coarsening: edge length of the coarser mesh over that of the layer's own.

    Raises:
        InvalidInput: a coarsening below MIN_COARSENING.
    """

    def __init__(self, method: Method, coarsening: float) -> None:
        if not coarsening >= MIN_COARSENING:
            raise InvalidInput(f"coarsening is {coarsening}; from {MIN_COARSENING} on it saves more than it costs.")
        self.method, self.coarsening = method, coarsening
        self.name = f"{method.name}, {coarsening:g} x coarser"
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Meshes the skin anew (seconds) and prepares the method on it.

        Raises:
            InvalidInput, MeshError: the skin cannot be meshed so coarsely.
        """
        from stmpl_core.remesh import remesh

        mesh = remesh(layer.vertices, layer.faces, self.coarsening * layer.edge_length)
        below = {name: mesh.transfer @ values for name, values in layer.below.items()}
        self.coarse = SoftLayer(mesh.vertices, mesh.faces, **below, tissue=layer.tissue)
        self.method.prepare(self.coarse)
        self._carry = interpolation(self.coarse, layer)
        self._forces = self._carry.T.tocsr()
        self._pressures = handed_over(self._carry, layer.vertex_areas)
        self._layer = layer
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`.

        Raises:
            NotPrepared: a call before `prepare`.
            InvalidInput: the load does not fit the layer.
        """
        layer = prepared(self._layer, self)
        load.check(layer)
        handed = self._forces if load.kind == "nodal" else self._pressures
        answer = self.method.solve(Load(load.kind, handed @ load.values))
        trust = answer.trust if not len(load.loaded) else replace(answer.trust, error_bound=None)
        return Displacement(self._carry @ answer.displacement, trust, self.name, load.pressure_on(layer))


def interpolation(coarse: SoftLayer, fine: SoftLayer) -> sp.csr_matrix:
    """Linear interpolation from the vertices of one mesh of a skin to those of another, (V_fine, V_coarse)."""
    corners, weights = nearest_corners(coarse, fine.vertices)
    rows = np.repeat(np.arange(len(corners)), 3)
    return sp.csr_matrix((weights.ravel(), (rows, corners.ravel())), shape=(len(corners), len(coarse.vertices)))


def nearest_corners(layer: SoftLayer | Body, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Vertices around the nearest place of a skin to each of the points (N, 3), and barycentric coordinates, (N, 3)."""
    library: Any = igl
    _, face, nearest = library.point_mesh_squared_distance(points, layer.vertices, layer.faces.astype(np.int64))
    corners = layer.faces[face].astype(np.int64)
    a, b, c = (np.ascontiguousarray(layer.vertices[corners[:, k]]) for k in range(3))
    weights = np.clip(library.barycentric_coordinates(np.ascontiguousarray(nearest), a, b, c), 0.0, 1.0)
    return corners, weights / weights.sum(axis=1, keepdims=True)


def handed_over(carry: sp.csr_matrix, areas: np.ndarray) -> sp.csr_matrix:
    """What makes pressures on the fine mesh pressures on the coarse one, whose forces have the same sum, (C, V).

    Args:
        carry: interpolation from the coarse to the fine mesh, (V, C).
        areas: areas of the fine mesh's vertices, (V,) [m2].
    """
    gathered = np.asarray(carry.T @ areas)
    return sp.csr_matrix(sp.diags(1 / np.maximum(gathered, 1e-12)) @ carry.T.tocsr() @ sp.diags(areas))
