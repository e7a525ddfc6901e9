"""Loads on the skin columns of a patch: a pressure that follows the skin, and forces that keep their direction."""

from __future__ import annotations

import numpy as np

from fem_tools import neo_hookean as nh
from fem_tools.mesh import WedgeMesh, reference_skin


class FollowerPressure:
    """A pressure at the triangle corners, (N,) [Pa], along the deformed normal."""

    conservative = False

    def __init__(self, mesh: WedgeMesh, pressure: np.ndarray) -> None:
        self.mesh, self.corners = mesh, pressure[mesh.triangles]
        self.reference = reference_skin(mesh.element)

    def potential(self, skin: np.ndarray, factor: float) -> float:
        """A follower pressure with an edge has none."""
        return float("nan")

    def add_forces(self, skin: np.ndarray, factor: float, forces: np.ndarray) -> None:
        """See SkinLoad."""
        r = self.reference
        nh.follower_forces(skin, self.mesh.columns, factor * self.corners, r.value, r.slope, r.linear, r.weight, forces)

    def add_tangent(
        self, skin: np.ndarray, factor: float, data: np.ndarray, *, symmetric: bool, convex: float = 0.0
    ) -> None:
        """See SkinLoad."""
        r, m = self.reference, self.mesh
        pressure = factor * self.corners
        nh.follower_tangent(skin, m.columns, m.blocks, pressure, r.value, r.slope, r.linear, r.weight, symmetric, data)


class DeadForces:
    """Forces on the skin columns that keep their direction, (C, 3) [N]."""

    conservative = True

    def __init__(self, forces: np.ndarray) -> None:
        self.forces = forces

    def add_forces(self, skin: np.ndarray, factor: float, forces: np.ndarray) -> None:
        """See SkinLoad."""
        forces += factor * self.forces

    def add_tangent(
        self, skin: np.ndarray, factor: float, data: np.ndarray, *, symmetric: bool, convex: float = 0.0
    ) -> None:
        """Dead forces have no stiffness."""

    def potential(self, skin: np.ndarray, factor: float) -> float:
        """See SkinLoad."""
        return -factor * float(np.vdot(self.forces, skin))

    @classmethod
    def at_vertices(cls, mesh: WedgeMesh, forces: np.ndarray) -> DeadForces:
        """Concentrated at the triangle corners, (N, 3) [N]: the paper's rule on its own mesh."""
        return cls(np.concatenate([forces, np.zeros((mesh.n_columns - len(forces), 3))]))

    @classmethod
    def of_traction(cls, mesh: WedgeMesh, traction: np.ndarray) -> DeadForces:
        """Of a traction, linear between the triangle corners, (N, 3) [Pa]: int N_a T dA."""
        r, skin = reference_skin(mesh.element), mesh.column_ends()[0]
        a, b, c = (mesh.outer[mesh.triangles[:, k]] for k in range(3))
        double = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        mass = np.einsum("q,qa,qk->ak", r.weight, r.value, r.linear)
        parts = np.einsum("t,ak,tki->tai", double, mass, traction[mesh.triangles])
        forces = np.zeros_like(skin)
        np.add.at(forces, mesh.columns, parts)
        return cls(forces)
