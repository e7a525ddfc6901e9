"""The straightforward way, for comparison: scikit-fem's own assembly of P2 tetrahedra, full Newton, a direct solver."""

from __future__ import annotations

import numpy as np
from skfem import Basis, BilinearForm, ElementTetP2, ElementVector, FacetBasis, LinearForm, MeshTet, condense, solve
from skfem.helpers import ddot, grad, inv, mul, transpose

from fem_tools.patch import Patch
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load


def tetrahedra(triangles: np.ndarray, n: int) -> np.ndarray:
    """Three tetrahedra a prism between vertices k and k + n; they conform, each face being cut at its least number."""
    low = np.sort(triangles, axis=1)
    a, b, c = low.T
    return np.concatenate([np.stack(t, axis=1) for t in (
        (a, b, c, c + n), (a, b, b + n, c + n), (a, a + n, b + n, c + n))])  # fmt: skip


def solve_with_scikit_fem(layer: SoftLayer, patch: Patch, load: Load, steps: int = 1) -> tuple[np.ndarray, int]:
    """Displacement of the patch's vertices (N, 3) [m] under a follower pressure, and the number of unknowns."""
    mesh, n = patch.mesh, len(patch.mesh.outer)
    points = np.ascontiguousarray(np.vstack([mesh.outer, mesh.inner]).T)
    tets = MeshTet(points, np.ascontiguousarray(tetrahedra(mesh.triangles, n).T))
    basis = Basis(tets, ElementVector(ElementTetP2()), intorder=4)
    skin_facets = np.flatnonzero((tets.facets < n).all(axis=0))
    skin = FacetBasis(tets, ElementVector(ElementTetP2()), facets=skin_facets, intorder=4)
    at_vertices = np.concatenate([patch.interpolate(load.values), np.zeros(n)])
    pressure = _linear_on(skin, at_vertices)
    rim = np.flatnonzero(patch.fixed[:n])
    held_vertices = np.concatenate([np.arange(n, 2 * n), rim])
    held_edges = np.isin(tets.edges, held_vertices).all(axis=0)
    dofs = np.concatenate([basis.nodal_dofs[:, held_vertices].ravel(), basis.edge_dofs[:, held_edges].ravel()])
    mu, lam = layer.tissue.shear_modulus, layer.tissue.lame_lambda
    u = basis.zeros()
    for step in range(1, steps + 1):
        for _ in range(12):
            matrix, vector = _assemble(basis, skin, u, mu, lam, pressure * step / steps)
            du = solve(*condense(matrix, -vector, D=dofs))
            u = u + du
            if np.abs(du).max() < 1e-8:
                break
    return u[basis.nodal_dofs[:, : len(patch.vertices)]].T, basis.N


def _linear_on(skin: FacetBasis, values: np.ndarray) -> np.ndarray:
    from skfem import ElementTetP1

    return np.asarray(skin.with_element(ElementTetP1()).interpolate(values))


def _assemble(basis: Basis, skin: FacetBasis, u: np.ndarray, mu: float, lam: float, pressure: np.ndarray):
    @BilinearForm
    def stiffness(du, v, w):
        F_inv = inv(grad(w["u"]) + _identity(w["u"]))
        turned = mul(F_inv, mul(grad(du), F_inv))
        J = _det(grad(w["u"]) + _identity(w["u"]))
        return (mu * ddot(grad(du), grad(v)) + (mu - lam * np.log(J)) * ddot(transpose(turned), grad(v))
                + lam * ddot(transpose(F_inv), grad(du)) * ddot(transpose(F_inv), grad(v)))  # fmt: skip

    @LinearForm
    def forces(v, w):
        F = grad(w["u"]) + _identity(w["u"])
        P = mu * (F - transpose(inv(F))) + lam * np.log(_det(F)) * transpose(inv(F))
        return ddot(P, grad(v))

    @LinearForm
    def pressing(v, w):
        F = grad(w["u"]) + _identity(w["u"])
        normal = np.einsum("ij...,j...->i...", transpose(inv(F)), w.n) * _det(F)
        return w["p"] * (normal * v).sum(axis=0)

    @BilinearForm
    def pressing_stiffness(du, v, w):
        F = grad(w["u"]) + _identity(w["u"])
        F_inv, J = inv(F), _det(F)
        n = np.einsum("ij...,j...->i...", transpose(F_inv), w.n)
        trace = ddot(transpose(F_inv), grad(du))
        turned = np.einsum("ij...,j...->i...", transpose(mul(F_inv, grad(du))), n)
        return w["p"] * J * ((trace * n - turned) * v).sum(axis=0)

    inside, outside = basis.interpolate(u), skin.interpolate(u)
    return (stiffness.assemble(basis, u=inside) + pressing_stiffness.assemble(skin, u=outside, p=pressure),
            forces.assemble(basis, u=inside) + pressing.assemble(skin, u=outside, p=pressure))  # fmt: skip


def _identity(u) -> np.ndarray:
    return np.eye(3)[:, :, None, None] * np.ones(grad(u).shape[2:])


def _det(F: np.ndarray) -> np.ndarray:
    return np.einsum("i...,i...->...", F[0], np.cross(F[1], F[2], axis=0))
