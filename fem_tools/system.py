"""System: the equations of one patch under its loads: energy, residual, tangent, and a preconditioner by columns."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Protocol, Self

import numpy as np
from numba import njit

from fem_tools import linear_wedges
from fem_tools import neo_hookean as nh
from fem_tools.membrane import SkinMembrane
from fem_tools.mesh import WedgeMesh, linear_tables
from fem_tools.plies import wedge_materials
from fem_tools.relaxation import Fading, Relaxing
from stmpl_core.tissue import Tissue


class SkinLoad(Protocol):
    """Something that presses on the skin; `factor` in [0, 1] is the share of it that acts (load continuation).

    `conservative`: its forces are minus the gradient of `potential`, which then steers the line search.
    """

    conservative: bool

    def potential(self, skin: np.ndarray, factor: float) -> float:
        """Its potential energy [J]; only asked where `conservative`."""
        ...

    def add_forces(self, skin: np.ndarray, factor: float, forces: np.ndarray) -> None:
        """Adds its forces on the skin columns, (C, 3) [N], at the deformed positions `skin` (C, 3) [m]."""
        ...

    def add_tangent(
        self, skin: np.ndarray, factor: float, data: np.ndarray, *, symmetric: bool, convex: float = 0.0
    ) -> None:
        """Adds its stiffness, -d forces / d skin, to the skin level of the tangent's blocks.

        `symmetric`: only the symmetric part; `convex`: the share, 0 to 1, of what may be negative that is left out.
        """
        ...


class System:
    """Residual, tangent and constraints of one patch under some loads.

    Args:
        mesh: wedges.
        tissue: materials of the wedges, and the skin's membrane.
        loads: loads on the skin.
        fixed: mask of the columns that do not move at all, (C,).
        keep: projectors on the motions that each column may make, (C, 3, 3); None: all, but for the fixed ones.
    """

    least = 0.0  # least load that a residual is measured by [sqrt(J)]: skin that is let go bears none

    def __init__(
        self,
        mesh: WedgeMesh,
        tissue: Tissue,
        loads: Sequence[SkinLoad],
        fixed: np.ndarray,
        keep: np.ndarray | None = None,
    ) -> None:
        self.mesh, self.tissue = mesh, tissue
        self.loads: Sequence[SkinLoad] = loads
        self.mu, self.lam = wedge_materials(mesh, tissue)
        self.membrane = SkinMembrane(mesh, tissue.skin) if tissue.skin else None
        self.relaxing: Relaxing | None = None
        self.rest = mesh.rest_positions()
        self.fixed = fixed
        self.keep = keep
        self.free = mesh.levels - 1
        self.diagonal = diagonal_blocks(mesh.indptr, mesh.indices)  # block of each column with itself

    def part(self, chosen: np.ndarray) -> Self:
        """The same without the loads, of the wedges below some triangles alone, a mask (T,)."""
        part, wedges = copy.copy(self), np.repeat(chosen, self.mesh.layers)
        part.mesh, part.mu, part.lam, part.loads = self.mesh.part(chosen), self.mu[wedges], self.lam[wedges], []
        part.membrane = SkinMembrane(part.mesh, self.tissue.skin) if self.tissue.skin else None
        return part

    def zeros(self) -> np.ndarray:
        """No displacement, (C, levels, 3)."""
        return np.zeros((self.mesh.n_columns, self.mesh.levels, 3))

    def relax(self, fading: Fading = "stress") -> Relaxing:
        """Lets stress fade with time as the tissue's series say; see fem_tools.relaxation."""
        self.relaxing = Relaxing(self.mesh, self.tissue, (self.mu, self.lam), self.membrane, fading)
        return self.relaxing

    @property
    def conservative(self) -> bool:
        """Whether all loads are: then the tangent is symmetric and an equilibrium is a minimum of the energy."""
        return all(load.conservative for load in self.loads)

    def _moduli(self) -> tuple[np.ndarray, np.ndarray]:
        """mu and lambda of the wedges as they act now, (T L,) each [Pa]."""
        return (self.relaxing.body.mu, self.relaxing.body.lam) if self.relaxing else (self.mu, self.lam)

    def energy(self, u: np.ndarray, factor: float) -> float:
        """Stored energy plus the loads' potential [J]; infinite where an element is folded."""
        m, skin = self.mesh, self.rest[:, 0] + u[:, 0]
        stored = nh.strain_energy(u, m.columns, m.layers, m.gradients, m.volumes, *self._moduli())
        stored += self.membrane.energy(u[:, 0]) if self.membrane else 0.0
        stored += self.relaxing.energy(u) if self.relaxing else 0.0
        return stored + sum(load.potential(skin, factor) for load in self.loads)

    def internal(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """Internal forces (C, levels, 3) [N] and the smallest det F, or 0 where a face of a membrane has no area."""
        m, forces = self.mesh, np.zeros_like(u)
        if m.element == "P1xP2":
            smallest = linear_wedges.internal_forces(
                u, m.columns, m.layers, m.natural, m.volumes, *self._moduli(), *linear_tables(), forces
            )
        else:
            smallest = nh.internal_forces(u, m.columns, m.layers, m.gradients, m.volumes, *self._moduli(), forces)
        if self.relaxing:
            self.relaxing.add_forces(u, forces)
        if self.membrane:
            of_skin, grown = self.membrane.forces(u[:, 0])
            forces[:, 0] += of_skin
            smallest = smallest if grown > 0 else 0.0
        return forces, smallest

    def external(self, u: np.ndarray, factor: float) -> np.ndarray:
        """Forces of the loads on the skin, (C, 3) [N]."""
        skin = self.rest[:, 0] + u[:, 0]
        forces = np.zeros_like(skin)
        for load in self.loads:
            load.add_forces(skin, factor, forces)
        return forces

    def residual(self, u: np.ndarray, factor: float) -> tuple[np.ndarray, float]:
        """Internal minus external forces of the free levels, (C, 3 m) [N], and the smallest det F."""
        forces, smallest = self.internal(u)
        forces[:, 0] -= self.external(u, factor)
        return forces[:, : self.free].reshape(len(u), -1), smallest

    def tangent(
        self, u: np.ndarray, factor: float, *, symmetric: bool = False, convex: float = 0.0,
        onto: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Blocks of the tangent (or of its symmetric, or of a positive part), (n_blocks, 3 m, 3 m) [N/m].

        `onto`: blocks that it is added to, which are returned.
        """
        m, width = self.mesh, 3 * self.free
        data = np.zeros((len(m.indices), width, width)) if onto is None else onto
        if m.element == "P1xP2":
            linear_wedges.tangent(
                u, m.columns, m.blocks, m.layers, m.natural, m.volumes, *self._moduli(), *linear_tables(), convex, data
            )
        else:
            nh.tangent(u, m.columns, m.blocks, m.layers, m.gradients, m.volumes, *self._moduli(), convex, data)
        if self.relaxing:
            self.relaxing.add_tangent(data, convex)
        if self.membrane:
            self.membrane.add_tangent(u[:, 0], data, convex=convex)
        skin = self.rest[:, 0] + u[:, 0]
        for load in self.loads:
            load.add_tangent(skin, factor, data, symmetric=symmetric, convex=convex)
        return data

    def preconditioner(self, data: np.ndarray, columns: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Inverse of each column's own block, (C, 3 m, 3 m); zero where constrained, which is what constrains CG.

        `columns`: those that are asked for.
        """
        diagonal = data[self.diagonal[columns]]
        if self.keep is None:
            inverse = _inverse_spd(diagonal)
        else:
            project = np.einsum("mn,cij->cminj", np.eye(self.free), self.keep[columns]).reshape(diagonal.shape)
            rest = np.eye(diagonal.shape[1]) - project
            scale = np.trace(diagonal, axis1=1, axis2=2)[:, None, None]
            inverse = project @ _inverse_spd(project @ diagonal @ project + rest * scale) @ project
        inverse[self.fixed[columns]] = 0.0
        return inverse


def _inverse_spd(blocks: np.ndarray) -> np.ndarray:
    """Inverse of symmetric blocks; where one is not positive definite its eigenvalues are taken positive."""
    inverse = np.empty_like(blocks)
    if _eliminate(blocks, inverse):
        return inverse
    values, vectors = np.linalg.eigh(blocks)
    values = np.maximum(np.abs(values), 1e-3 * np.abs(values).max(axis=1, keepdims=True))
    return np.einsum("cij,cj,ckj->cik", vectors, 1 / values, vectors)


@njit(cache=True)
def _eliminate(blocks, inverse):
    """Writes the inverses of blocks (C, n, n) by Gauss and Jordan; False if a pivot is not positive."""
    n = blocks.shape[1]
    for c in range(len(blocks)):
        a = inverse[c]
        a[:] = blocks[c]
        for p in range(n):
            if not a[p, p] > 0.0:
                return False
            s = 1.0 / a[p, p]
            a[p, p] = 1.0
            for j in range(n):
                a[p, j] *= s
            for i in range(n):
                if i != p:
                    f = a[i, p]
                    a[i, p] = 0.0
                    for j in range(n):
                        a[i, j] -= f * a[p, j]
    return True


@njit(cache=True)
def diagonal_blocks(indptr, indices):
    out = np.empty(len(indptr) - 1, dtype=np.int64)
    for c in range(len(out)):
        for k in range(indptr[c], indptr[c + 1]):
            if indices[k] == c:
                out[c] = k
    return out
