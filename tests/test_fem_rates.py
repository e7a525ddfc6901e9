"""Convergence rates: a large displacement that is known everywhere, and how fast each element comes to it."""

import numpy as np
import pytest

from fem_tools.krylov import conjugate_gradients
from fem_tools.mesh import Reference, WedgeMesh, level_depths, reference_wedge, rest_gradients
from fem_tools.system import System
from stmpl_core.layer import SoftLayer
from stmpl_core.tissue import Tissue
from tests.scenes import plate

SIDE, THICKNESS = 0.03, 7.5e-3
PUSH = np.array([0.12, -0.08, -0.3]) * THICKNESS  # largest motion along x, y, z: 30 % of the layer
RATES = {"P1xP2": (2, 1), "P2xP2": (3, 2)}  # of the error in L2 and in H1


def known(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A motion that vanishes at the core and at the sides, (..., 3) [m], and its gradient du_i / dX_j."""
    x, y, z = (np.pi * points[..., 0] / SIDE, np.pi * points[..., 1] / SIDE, 1 + points[..., 2] / THICKNESS)
    plane, depth = np.sin(x) * np.sin(y), np.sin(1.2 * z)
    slope = np.stack(
        [
            np.pi / SIDE * np.cos(x) * np.sin(y) * depth,
            np.pi / SIDE * np.sin(x) * np.cos(y) * depth,
            1.2 / THICKNESS * plane * np.cos(1.2 * z),
        ],
        axis=-1,
    )
    return PUSH * (plane * depth)[..., None], PUSH[:, None] * slope[..., None, :]


def sheared_plate(n: int) -> SoftLayer:
    """n x n squares cut in triangles, their inner vertices shifted smoothly, so that no two are alike."""
    flat = plate(SIDE, SIDE / n, THICKNESS, crossed=True)
    vertices = flat.vertices + [SIDE / 2, SIDE / 2, 0]
    x, y = np.pi * vertices[:, 0] / SIDE, np.pi * vertices[:, 1] / SIDE
    vertices[:, :2] += 0.06 * SIDE * np.stack([np.sin(x) * np.sin(2 * y), np.sin(2 * x) * np.sin(y)], axis=1)
    return flat.with_(vertices=vertices)


class FineQuadrature:
    """Points, weights and shape functions of a mesh, accurate enough to integrate what is no polynomial."""

    def __init__(self, mesh: WedgeMesh) -> None:
        self.mesh, ref = mesh, reference_wedge(mesh.element, extra=4)
        self.value: np.ndarray = ref.shape_value
        self.gradients, self.volumes = rest_gradients(mesh.outer, mesh.inner, mesh.triangles, ref, mesh.layers)
        self.points = self._points(ref)

    def _points(self, ref: Reference) -> np.ndarray:
        m, ends = self.mesh, level_depths(self.mesh.layers)[::2]
        depth = ends[:-1, None] + np.diff(ends)[:, None] * ref.zeta  # (L, Q)
        outer, inner = (np.einsum("qk,tki->tqi", ref.geometry_value, x[m.triangles]) for x in (m.outer, m.inner))
        points = outer[:, None] + depth[None, :, :, None] * (inner - outer)[:, None]
        return points.reshape(-1, len(ref.weight), 3)

    def local(self, nodal: np.ndarray) -> np.ndarray:
        """Values at the nodes of each wedge, (T L, 3 n, 3), of a nodal field (C, levels, 3)."""
        m = self.mesh
        levels = 2 * np.arange(m.layers)[:, None] + np.arange(3)
        out = nodal[m.columns[:, None, :, None], levels[None, :, None, :]]
        return out.reshape(len(m.triangles) * m.layers, -1, 3)

    def scatter(self, forces: np.ndarray) -> np.ndarray:
        """Adds up forces at the nodes of each wedge, (T L, 3 n, 3), in a nodal field (C, levels, 3)."""
        m, out = self.mesh, np.zeros((self.mesh.n_columns, self.mesh.levels, 3))
        levels = 2 * np.arange(m.layers)[:, None] + np.arange(3)
        at = np.broadcast_arrays(m.columns[:, None, :, None], levels[None, :, None, :])
        np.add.at(out, tuple(x.reshape(-1) for x in at), forces.reshape(-1, 3))
        return out


def driving_forces(fine: FineQuadrature, tissue: Tissue) -> np.ndarray:
    """int P(F) : grad N dV for the known motion, (C, levels, 3) [N].

    By the divergence theorem that is the work of its body force -div P and of its skin traction P N.
    """
    mu, lam = tissue.shear_modulus, tissue.lame_lambda
    F = np.eye(3) + known(fine.points)[1]
    inverse = np.linalg.inv(F).swapaxes(-1, -2)
    P = mu * F + (lam * np.log(np.linalg.det(F)) - mu)[..., None, None] * inverse
    return fine.scatter(np.einsum("eq,eqij,eqaj->eai", fine.volumes, P, fine.gradients, optimize=True))


def errors(element, n: int, layers: int) -> tuple[float, float]:
    """Error of the displacement in L2 and of its gradient in L2, each over the size of what is known [-]."""
    layer = sheared_plate(n)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, element, layers)
    system, fine = System(mesh, layer.tissue, [], mesh.border_columns()), FineQuadrature(mesh)
    drive, (u_known, slope_known) = driving_forces(fine, layer.tissue), known(fine.points)
    u = known(system.rest)[0]
    u[system.fixed] = u[:, -1] = 0.0
    for _ in range(5):
        r = (system.internal(u)[0] - drive)[:, :-1].reshape(len(u), -1)
        r[system.fixed] = 0.0
        data = system.tangent(u, 1.0)
        du = conjugate_gradients(mesh.indptr, mesh.indices, data, system.preconditioner(data), -r, 1e-6, 500)[0]
        u[:, :-1] += du.reshape(len(u), -1, 3)
    assert np.abs(du).max() < 1e-9 * THICKNESS  # Newton is done; what is left is the discretisation
    local = fine.local(u)
    u_found = np.einsum("qa,eai->eqi", fine.value, local, optimize=True)
    slope_found = np.einsum("eai,eqaj->eqij", local, fine.gradients, optimize=True)

    def size(field: np.ndarray) -> float:
        return float(np.sqrt(np.sum(fine.volumes * (field**2).reshape(*fine.volumes.shape, -1).sum(axis=-1))))

    return size(u_found - u_known) / size(u_known), size(slope_found - slope_known) / size(slope_known)


@pytest.mark.parametrize("element", list(RATES))
def test_each_element_converges_at_its_rate(element):
    coarse, fine = (np.array(errors(element, n, layers)) for n, layers in ((6, 2), (12, 4)))
    rates = np.log2(coarse / fine)
    np.testing.assert_array_less(np.array(RATES[element]) - 0.15, rates)
    assert fine[0] < 0.02
