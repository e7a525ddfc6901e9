"""TetFem: the paper's own path, linear tetrahedra under dead nodal forces, for comparison with what converges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from scipy.sparse import csr_matrix

from fem_tools.patch import Patch, PatchFem
from fem_tools.skin_loads import DeadForces, FollowerPressure
from fem_tools.system import System, diagonal_blocks
from stmpl_core.arrays import Points
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.extras import needed
from stmpl_core.layer import SoftLayer, single
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.tissue import Tissue

Mesher = Literal["split", "tetgen"]


@dataclass(frozen=True, eq=False)
class TetMesh:
    """Linear tetrahedra between skin and core; to the solver every node is a column with one level. See `TetMesh.of`.

    Attributes:
        points: nodes at rest, those of the skin first, (N, 3) [m].
        tets: positively oriented, (M, 4).
        triangles: triangles of the skin, (T, 3).
        core: mask of the nodes that are bonded, (N,).
        gradients: gradients of the shape functions at rest, (M, 4, 3) [1/m].
        volumes: volumes of the tetrahedra, (M,) [m3].
        indptr, indices: block rows of the tangent, one block a pair of nodes that share a tetrahedron.
        blocks: number of the block of each pair of a skin triangle's nodes, (T, 3, 3).
        to_nodes, to_blocks: sparse sums over the tetrahedra's corners and pairs of corners.
    """

    points: Points
    tets: np.ndarray
    triangles: np.ndarray
    core: np.ndarray
    gradients: np.ndarray
    volumes: np.ndarray
    indptr: np.ndarray
    indices: np.ndarray
    blocks: np.ndarray
    to_nodes: csr_matrix
    to_blocks: csr_matrix
    element: str = "P1xP2"  # its skin triangles are linear, as those of these wedges are

    @classmethod
    def of(cls, points: Points, tets: np.ndarray, triangles: np.ndarray, core: np.ndarray) -> TetMesh:
        """Prepares a mesh for the solver; tetrahedra are turned to be positive.

        Raises:
            MeshError: a tetrahedron has no volume.
        """
        n, edges = len(points), points[tets[:, 1:]] - points[tets[:, :1]]
        determinant = np.linalg.det(edges)
        if not (np.abs(determinant) > 1e-9 * np.abs(determinant).max()).all():
            worst = int(np.abs(determinant).argmin())
            raise MeshError(f"tetrahedron {worst} has no volume ({abs(determinant[worst]) / 6:.1e} m3).")
        tets = np.where((determinant < 0)[:, None], tets[:, [0, 2, 1, 3]], tets)
        inverse = np.linalg.inv(points[tets[:, 1:]] - points[tets[:, :1]])  # rows of edges, so columns are gradients
        gradients = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2).swapaxes(1, 2)
        keys, number = np.unique(tets[:, :, None] * n + tets[:, None, :], return_inverse=True)
        pairs = triangles[:, :, None] * n + triangles[:, None, :]
        return cls(
            points,
            tets,
            triangles,
            core,
            gradients,
            np.abs(determinant) / 6,
            np.searchsorted(keys // n, np.arange(n + 1)),
            keys % n,
            np.searchsorted(keys, pairs),
            _sums(tets.ravel(), n),
            _sums(number.ravel(), len(keys)),
        )

    @property
    def columns(self) -> np.ndarray:
        """The skin triangles, by the name under which loads ask for them."""
        return self.triangles

    @property
    def n_columns(self) -> int:
        """Number of nodes."""
        return len(self.points)

    @property
    def outer(self) -> Points:
        """All nodes, by the name under which loads ask for the skin's."""
        return self.points

    def boundary_faces(self) -> np.ndarray:
        """Faces of one tetrahedron only, each with its nodes in ascending order, (N, 3)."""
        all_faces = self.tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3)
        faces, count = np.unique(np.sort(all_faces, axis=1), axis=0, return_counts=True)
        return faces[count == 1]

    def column_ends(self) -> tuple[Points, Points]:
        """All nodes, twice: a column of one level ends where it starts."""
        return self.points, self.points


def _sums(rows: np.ndarray, n: int) -> csr_matrix:
    return csr_matrix((np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=(n, len(rows)))


def split_wedges(outer: Points, inner: Points, triangles: np.ndarray, layers: int, ends: np.ndarray | None = None
                 ) -> TetMesh:  # fmt: skip
    """Wedges cut in three tetrahedra each, alike on both sides of every face, at depths `ends`, or evenly.

    The corners of each triangle are taken in the order of their numbers, so that every face's diagonal starts at its
    lower number (Dompierre et al., "How to subdivide pyramids, prisms and hexahedra into tetrahedra", 1999).
    """
    n, (a, b, c) = len(outer), np.sort(triangles, axis=1).T
    depth = (np.linspace(0, 1, layers + 1)[:, None] if ends is None else ends.T)[:, :, None]
    points = (outer * (1 - depth) + inner * depth).reshape(-1, 3)
    tets = []
    for level in range(layers):
        (a0, b0, c0), (a1, b1, c1) = ([x + k * n for x in (a, b, c)] for k in (level, level + 1))
        tets += [np.stack(t, axis=1) for t in ((a0, b0, c0, c1), (a0, b0, b1, c1), (a0, a1, b1, c1))]
    return TetMesh.of(points, np.vstack(tets), triangles, np.arange(len(points)) >= layers * n)


def tetgen_mesh(outer: Points, inner: Points, triangles: np.ndarray) -> TetMesh:
    """The closed layer meshed by TetGen (Si, ACM TOMS 41, 2015), its surface kept.

    Raises:
        InvalidInput: the package `tetgen` is not there.
        MeshError: TetGen refuses the surface, for instance because it cuts itself.
    """
    needed('mesher="tetgen"', "tetgen", "tetgen")  # by its name only: its licence is the AGPL
    import tetgen

    n, points = len(outer), np.vstack([outer, inner])
    directed = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, first, count = np.unique(np.sort(directed, axis=1), axis=0, return_index=True, return_counts=True)
    a, b = directed[first[count == 1]].T
    rim = np.vstack([np.stack([b, a, a + n], axis=1), np.stack([b, a + n, b + n], axis=1)])
    surface = np.vstack([triangles, triangles[:, ::-1] + n, rim])
    try:
        nodes, tets = tetgen.TetGen(points * 1e3, surface).tetrahedralize(order=1, minratio=1.5, nobisect=True)[:2]
    except RuntimeError as error:
        raise MeshError(f"TetGen refuses the layer's surface: {error}. Thin the layer, or remesh the skin.") from error
    nodes = np.asarray(nodes) / 1e3
    if len(nodes) < 2 * n or np.abs(nodes[: 2 * n] - points).max() > 1e-9:
        raise MeshError("TetGen moved or merged vertices of the layer. Remesh the skin.")
    core = (np.arange(len(nodes)) >= n) & (np.arange(len(nodes)) < 2 * n)
    return TetMesh.of(nodes, np.asarray(tets, dtype=np.int64), triangles, core)


class TetSystem(System):
    """Residual and tangent of linear tetrahedra; the deformation gradient is uniform in each.

    Same energy and arguments as System; `fixed` and `keep` are over all nodes of the mesh, and u is (N, 1, 3).
    """

    def __init__(self, mesh: TetMesh, tissue: Tissue, loads: Any, fixed: np.ndarray, keep: Any = None) -> None:
        self.mesh: Any = mesh
        self.tissue, self.loads, self.fixed, self.keep = tissue, loads, fixed | mesh.core, keep
        self.mu, self.lam = tissue.shear_modulus, tissue.lame_lambda
        self.rest, self.free = mesh.points[:, None], 1
        self.diagonal = diagonal_blocks(mesh.indptr, mesh.indices)

    def zeros(self) -> np.ndarray:
        """No displacement, (N, 1, 3)."""
        return np.zeros_like(self.rest)

    def _deformation(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        F = np.eye(3) + np.einsum("mai,maj->mij", u[self.mesh.tets, 0], self.mesh.gradients)
        return F, np.linalg.det(F)

    def energy(self, u: np.ndarray, factor: float) -> float:
        """See System."""
        F, J = self._deformation(u)
        if not J.min() > 0:
            return np.inf
        log_j = np.log(J)
        psi = 0.5 * self.mu * ((F**2).sum(axis=(1, 2)) - 3) - self.mu * log_j + 0.5 * self.lam * log_j**2
        skin = self.rest[:, 0] + u[:, 0]
        return float(self.mesh.volumes @ psi) + sum(load.potential(skin, factor) for load in self.loads)

    def internal(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """Internal forces (N, 1, 3) [N] and the smallest det F."""
        F, J = self._deformation(u)
        if not J.min() > 0:
            return np.zeros_like(u), float(J.min())
        cofactor = np.linalg.inv(F).swapaxes(1, 2)
        P = self.mu * F + (self.lam * np.log(J) - self.mu)[:, None, None] * cofactor
        forces = np.einsum("m,mij,maj->mai", self.mesh.volumes, P, self.mesh.gradients)
        return (self.mesh.to_nodes @ forces.reshape(-1, 3))[:, None], float(J.min())

    def tangent(self, u: np.ndarray, factor: float, *, symmetric: bool = False, convex: float = 0.0) -> np.ndarray:
        """Blocks of the tangent, (n_blocks, 3, 3) [N/m]; see neo_hookean for the equation, and for `convex`."""
        mesh, (F, J) = self.mesh, self._deformation(u)
        g = np.einsum("mji,maj->mai", np.linalg.inv(F), mesh.gradients)
        cross = (self.mu - self.lam * np.log(np.maximum(J, 1e-300)))[:, None, None, None, None]
        outer = g[:, :, None, :, None] * g[:, None, :, None, :]  # (M, a, b, i, j) = g_a,i g_b,j
        skew = 0.5 * convex * np.maximum(cross, 0.0)
        stiff = (cross - skew) * outer.swapaxes(3, 4) + self.lam * outer
        stiff += skew * np.einsum("mak,mbk->mab", g, g)[..., None, None] * np.eye(3)
        stiff += self.mu * np.einsum("mak,mbk->mab", mesh.gradients, mesh.gradients)[..., None, None] * np.eye(3)
        stiff *= mesh.volumes[:, None, None, None, None]
        data = (mesh.to_blocks @ stiff.reshape(-1, 9)).reshape(-1, 3, 3)
        skin = self.rest[:, 0] + u[:, 0]
        for load in self.loads:
            load.add_tangent(skin, factor, data, symmetric=symmetric, convex=convex)
        return data


class TetFem(PatchFem):
    """Linear tetrahedra, as the paper's truth: a mesh that locks, under loads that do not converge with it.

    `Load.nodal` with the same force at each vertex of a contact, F / |V|, is the paper's rule; a pressure follows the
    skin. Its trust says what PatchFem's says.

    Args:
        mesher: "split" (wedges, three tetrahedra each) or "tetgen" (the optional extra "paper").
        layers: wedges through the thickness before they are split; TetGen chooses its own.
        others: arguments of PatchFem.
    """

    def __init__(self, *, mesher: Mesher = "split", layers: int = 2, **others: Any) -> None:
        if mesher not in ("split", "tetgen"):
            raise InvalidInput(f'mesher is {mesher!r}; allowed are "split" and "tetgen".')
        super().__init__(element="P1xP2", layers=layers, **others)
        if self.border != "clamped":
            raise InvalidInput('border is "mirror"; TetFem holds the rim of its patch, so only "clamped" is allowed.')
        self.mesher: Mesher = mesher
        self.name = "tet_fem"

    def prepare(self, layer: SoftLayer) -> Self:
        """See PatchFem.prepare. Raises InvalidInput for a skin or a stack."""
        single(layer, "TetFem", straight=False)
        return super().prepare(layer)

    def tets(self, patch: Patch) -> TetMesh:
        """The tetrahedra of a patch."""
        mesh = patch.mesh
        if self.mesher == "tetgen":
            return tetgen_mesh(mesh.outer, mesh.inner, mesh.triangles)
        return split_wedges(mesh.outer, mesh.inner, mesh.triangles, mesh.layers)

    def system(self, patch: Patch, load: Load) -> TetSystem:
        """The equations of a patch under a load."""
        layer = prepared(self._layer, self)
        mesh: Any = self.tets(patch)
        if load.kind != "nodal":
            pressing = FollowerPressure(mesh, patch.interpolate(load.values))
        elif self.refine == 0:
            pressing = DeadForces.at_vertices(mesh, load.forces_on(layer)[patch.vertices])
        else:
            traction = load.forces_on(layer) / layer.vertex_areas[:, None]
            pressing = DeadForces.of_traction(mesh, patch.interpolate(traction))
        return TetSystem(mesh, layer.tissue, [pressing], self.held(patch, mesh))

    def guess(self, system: System, pressure: np.ndarray, factor: float) -> np.ndarray:
        """From rest: the nodes that TetGen adds stand in no column."""
        return system.zeros()

    def held(self, patch: Patch, mesh: TetMesh) -> np.ndarray:
        """Mask of the nodes on the patch's rim, those of its faces that are neither skin nor core, (N,)."""
        faces = mesh.boundary_faces()
        skin = np.zeros(mesh.n_columns, dtype=bool)
        skin[np.unique(mesh.triangles)] = True
        held = np.zeros(mesh.n_columns, dtype=bool)
        held[faces[~skin[faces].all(axis=1) & ~mesh.core[faces].all(axis=1)]] = True
        held[: len(patch.fixed)] |= patch.fixed
        return held
