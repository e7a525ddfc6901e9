"""LimbLinear: how a limb gives way to a small pressure: flat tissue's closed form, and the limb's own coarse elements.

Where tissue is no longer thin beside a limb's radius it flows and sways round the bone, which no flat layer knows; but
that is smooth. So with G the response of a flat stack of one thickness, K the limb's linear stiffness on a coarse mesh
of its skin, C the interpolation from there and R the way there (forces keep their sum),

    u = G p + C (K^-1 - G_coarse) R p

the sharp part is the closed form's, the wide part the finite elements'.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from fem_tools.mesh import WedgeMesh
from fem_tools.plies import wedge_ends
from fem_tools.system import System
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.methods.coarse import handed_over, interpolation
from stmpl_core.moments import Surroundings
from stmpl_core.trust import Displacement, Trust

VERTICES = 900  # vertices of the coarse skin, about: its operator has 3 times their square numbers
FINEST = 1.1  # edges of the coarse mesh over the layer's own, below which the layer's own is taken
MAX_SINK = 0.05  # largest motion over the median thickness up to which the linear response is validated
THIN = 1.0  # thickness under a load over the coarse edges, below which those are too wide
THIN_SHARE = 0.1  # share of the load's force that may press on thinner tissue
BOUND_SHARE = 0.12  # bound of the error over the peak of the answer; 4 to 11 % were found on five limbs
HAT = np.array([[2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [1.0, 1.0, 2.0]]) / 12  # forces of linear pressures on a triangle


class LimbLinear:
    """Linear response of a whole limb: any stack, under a skin or not, on any core. Milliseconds an answer.

    Args:
        vertices: vertices of the coarse skin, about.
    """

    name = "limb_linear"

    def __init__(self, vertices: int = VERTICES) -> None:
        self.vertices = vertices
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Meshes the skin coarsely and solves it for a pressure at each of its vertices (10 to 30 s for a limb).

        Raises:
            InvalidInput, MeshError: the skin cannot be meshed so coarsely.
        """
        coarse, carry = self._coarse(layer)
        thickness = float(np.median(layer.thickness))
        wide, narrow = _compliance(coarse), _flat(coarse, thickness)
        for vertex in range(len(coarse.vertices)):
            wide[:, vertex] -= narrow.of_one(vertex).ravel()
        self._near = narrow if coarse is layer else _flat(layer, thickness)
        self._wide, self._carry, self._hand = wide, carry, handed_over(carry, layer.vertex_areas)
        self._layer, self._thickness, self._edge = layer, thickness, coarse.edge_length
        return self

    def _coarse(self, layer: SoftLayer) -> tuple[SoftLayer, sp.csr_matrix]:
        edge = float(np.sqrt(layer.vertex_areas.sum() / (self.vertices * np.sqrt(3) / 2)))
        if edge < FINEST * layer.edge_length:
            return layer, sp.csr_matrix(sp.eye(len(layer.vertices)))
        from stmpl_core.remesh import remesh

        mesh = remesh(layer.vertices, layer.faces, edge)
        coarse = SoftLayer(mesh.vertices, mesh.faces, core=mesh.transfer @ layer.inner_vertices, tissue=layer.tissue)
        return coarse, interpolation(coarse, layer)

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`; nodal forces act as the equivalent pressure.

        Raises:
            NotPrepared: a call before `prepare`.
            InvalidInput: the load does not fit the layer.
        """
        layer = prepared(self._layer, self)
        pressure = load.check(layer).pressure_on(layer)
        source = pressure / layer.tissue.youngs_modulus
        wide = self._wide @ (self._hand @ source).astype(np.float32)
        displacement = self._near.linear(source) + self._carry @ wide.reshape(-1, 3)
        return Displacement(displacement, self._trust(layer, displacement, pressure), self.name, pressure)

    def _trust(self, layer: SoftLayer, displacement: np.ndarray, pressure: np.ndarray) -> Trust:
        peak = float(np.linalg.norm(displacement, axis=1).max())
        trust = Trust(error_bound=BOUND_SHARE * peak, figures={"sink": peak / self._thickness})
        if peak > MAX_SINK * self._thickness:
            trust = trust.also(f"the skin moves by {peak / self._thickness:.0%} of the tissue's thickness, the linear "
                               f"response holds to {MAX_SINK:.0%}", in_range=False)  # fmt: skip
        loaded = np.flatnonzero(pressure)
        force = np.abs(pressure[loaded]) * layer.vertex_areas[loaded]
        thin = float(force @ (layer.thickness[loaded] < THIN * self._edge)) / max(float(force.sum()), 1e-300)
        if thin > THIN_SHARE:
            trust = trust.also(f"{thin:.0%} of the force is where the tissue is thinner than the edges of the coarse "
                               f"mesh, {1e3 * self._edge:.2g} mm", in_range=False)  # fmt: skip
        for why in self._near.sound.of_load(loaded, force):
            trust = trust.also(why, in_range=False)
        return trust


def _flat(layer: SoftLayer, thickness: float) -> Surroundings:
    """The flat response of the layer's stack, at one thickness [m], laid on its skin."""
    return Surroundings(SoftLayer(layer.vertices, layer.faces, thickness, tissue=layer.tissue))


def _compliance(layer: SoftLayer) -> np.ndarray:
    """Motion of every vertex under a pressure E at each, its edges held, (3 V, V) [m]."""
    ends = wedge_ends(layer.tissue, np.linalg.norm(layer.inner_vertices - layer.vertices, axis=1), 1)
    faces = layer.faces.astype(np.int64)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, faces, "P1xP2", ends=ends)
    system = System(mesh, layer.tissue, [], mesh.border_columns())
    blocks: Any = system.tangent(system.zeros(), 1.0)
    count, width = len(layer.vertices), blocks.shape[1]
    free = np.repeat(~system.fixed, width)
    stiffness = sp.bsr_matrix((blocks, mesh.indices, mesh.indptr), shape=(count * width,) * 2).tocsc()[free][:, free]
    forces = -np.einsum("ij,fx->fxij", HAT, layer.face_area_vectors)  # on corner i by a pressure at corner j
    rows = faces[:, None, :, None] * width + np.arange(3)[None, :, None, None]
    columns = np.broadcast_to(faces[:, None, None, :], forces.shape)
    loads = sp.csc_matrix((forces.ravel(), (np.broadcast_to(rows, forces.shape).ravel(), columns.ravel())),
                          shape=(count * width, count))[free]  # fmt: skip
    factors = splu(sp.csc_matrix(stiffness), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                   options={"SymmetricMode": True})  # fmt: skip
    at_skin = np.flatnonzero(np.arange(count * width) % width < 3)
    place = np.full(count * width, -1)
    place[free] = np.arange(free.sum())
    kept = place[at_skin] >= 0
    out = np.zeros((3 * count, count), np.float32)
    for first in range(0, count, 64):
        some = slice(first, min(first + 64, count))
        out[kept, some] = factors.solve(loads[:, some].toarray())[place[at_skin][kept]] * layer.tissue.youngs_modulus
    return out
