"""FelupeHex: FElupe's hexahedra, Newton-Raphson and direct solver; the only peer with our very energy."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

import felupe as fem
import numpy as np
from scipy.sparse import csr_matrix, vstack
from scipy.sparse.linalg import MatrixRankWarning, spsolve

from fem_tools.mesh import level_depths
from fem_tools.patch import Patch
from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import Tissue
from studies.peers.patch_peer import Found, PatchPeer, SkinForces

MM, KPA = 1e-3, 1e3  # its own units, so that forces are in mN: its test of convergence adds 1e-3 to the force
Element = Literal["hex8", "hex20", "hex27"]
Solver = Literal["scipy", "pypardiso"]
MAX_CUTBACKS = 5  # halvings of an increment that Newton's method fails at, as FElupe's CutbackPlugin does
FAILURES = (fem.NewtonConvergenceError, ArithmeticError, np.linalg.LinAlgError, RuntimeError)
REGIONS = {
    "hex8": (fem.RegionHexahedron, fem.RegionHexahedronBoundary),
    "hex20": (fem.RegionQuadraticHexahedron, fem.RegionQuadraticHexahedronBoundary),
    "hex27": (fem.RegionTriQuadraticHexahedron, fem.RegionTriQuadraticHexahedronBoundary),
}


@dataclass(frozen=True, eq=False)
class _Model:
    field: Any
    skin: Any  # the same on the skin's faces
    solid: Any
    free: Any
    held: Any
    on_plane: csr_matrix  # from the corners of the triangles to the nodes of one level
    to_nodes: np.ndarray  # (nodes of an element, 8) the trilinear functions there


class FelupeHex(PatchPeer):
    """FElupe: each skin triangle is cut in three quadrilaterals, which are extruded inwards into hexahedra.

    Set up as FElupe's documentation does (felupe.readthedocs.io, SolidBodyPressure and newtonraphson): SolidBody with
    NeoHookeCompressible(mu, lmbda), whose energy is ours; SolidBodyPressure on the skin, which follows it; its
    newtonraphson, the load applied in equal increments, and halved ones where it fails.

    Args:
        element: "hex8" (FElupe's plain choice), "hex20" or "hex27".
        layers, refine, reach: mesh, see PatchPeer; `layers` hexahedra through the thickness, thinner near the skin.
        increments: number of increments of the load; one that fails is halved.
        tolerance: tolerance of newtonraphson, relative to the forces on held nodes [-].
        max_iterations: most iterations of newtonraphson in each increment.
        solver: "scipy", FElupe's default (SuperLU), or "pypardiso", which its documentation recommends for speed
            (pip install pypardiso; brings Intel's MKL).
    """

    name = "felupe"

    def __init__(
        self,
        *,
        element: Element = "hex8",
        layers: int = 2,
        refine: int = 0,
        reach: float = 6.0,
        increments: int = 1,
        tolerance: float = 1e-3,
        max_iterations: int = 16,
        solver: Solver = "scipy",
    ) -> None:
        super().__init__(layers=layers, refine=refine, reach=reach)
        if element not in REGIONS:
            raise InvalidInput(f"element is {element!r}; allowed are {', '.join(REGIONS)}.")
        if increments < 1 or max_iterations < 1 or not tolerance > 0:
            raise InvalidInput(f"increments {increments}, max_iterations {max_iterations} and tolerance {tolerance} "
                               "must all be above 0.")  # fmt: skip
        if solver not in ("scipy", "pypardiso"):
            raise InvalidInput(f'solver is {solver!r}; allowed are "scipy" and "pypardiso".')
        self.element: Element = element
        self.solver: Solver = solver
        self.increments, self.tolerance, self.max_iterations = increments, tolerance, max_iterations

    def _set_up(self, patch: Patch, tissue: Tissue) -> _Model:
        outer, inner = patch.mesh.outer / MM, patch.mesh.inner / MM
        quads, on_plane, rim = quadrilaterals(patch.mesh.triangles, len(outer), patch.fixed)
        n, levels = len(rim), self.layers + 1
        depth = level_depths(self.layers)[::2, None, None]
        points = ((on_plane @ outer) * (1 - depth) + (on_plane @ inner) * depth).reshape(-1, 3)
        cells = [np.hstack([quads + (k + 1) * n, quads + k * n]) for k in range(self.layers)]
        mesh = fem.Mesh(points, np.vstack(cells), "hexahedron")
        if self.element != "hex8":
            mesh = mesh.add_midpoints_edges()
        if self.element == "hex27":
            mesh = mesh.add_midpoints_faces().add_midpoints_volumes()
        solid_region, skin_region = REGIONS[self.element]
        region = solid_region(mesh)
        to_nodes = np.array([fem.Hexahedron().function(place) for place in region.element.points])
        level = np.repeat(np.arange(levels), n)
        held = at_nodes(mesh, to_nodes, np.tile(rim, levels) | (level == self.layers)) > 1 - 1e-9
        on_skin = at_nodes(mesh, to_nodes, level == 0) > 1 - 1e-9
        field = fem.FieldContainer([fem.Field(region, dim=3)])
        skin = fem.FieldContainer([fem.Field(skin_region(mesh, only_surface=True, mask=on_skin), dim=3)])
        solid = fem.SolidBody(fem.NeoHookeCompressible(tissue.shear_modulus / KPA, tissue.lame_lambda / KPA), field)
        dof0, dof1 = fem.dof.partition(field, {"held": fem.Boundary(field[0], mask=held)})
        return _Model(field, skin, solid, dof1, dof0, on_plane, to_nodes)

    def _run(self, model: _Model, forces: SkinForces) -> Found:
        if forces.load.kind == "nodal":
            raise InvalidInput("FelupeHex takes pressures only; give Load.pressure(load.pressure_on(layer)).")
        field, mesh = model.field, model.field.region.mesh
        on_skin = model.on_plane @ (forces.pressure / KPA)
        nodal = at_nodes(mesh, model.to_nodes, np.concatenate([on_skin, np.zeros(self.layers * len(on_skin))]))
        on_nodes: Any = nodal[:, None]
        pressure = fem.Field(model.skin.region, dim=1, values=on_nodes).interpolate()[0]
        values, residual, iterations, why = np.zeros_like(field[0].values), 0.0, 0, ""
        done, step = 0.0, 1 / self.increments
        while done < 1 - 1e-9:
            field[0].values = values.copy()
            reached = min(done + step, 1.0)
            try:
                result = self._newton(model, pressure * reached)
            except FAILURES as error:
                step /= 2
                if step < 0.5**MAX_CUTBACKS / self.increments:
                    residual, why = np.inf, f"stopped at {done:.0%} of the load: {str(error).strip()}"
                    break
                continue
            done, values, residual = reached, result.x[0].values.copy(), float(result.fnorms[-1])
            iterations += int(result.iterations)
        field[0].values = values
        return Found(
            skin=values[: len(forces.pressure)] * MM,
            converged=np.isfinite(residual),
            residual=residual,
            min_j=float(np.linalg.det(np.moveaxis(field.extract()[0], (0, 1), (-2, -1))).min()),
            figures={"newton_iterations": float(iterations), "load_factor": done, "nodes": float(mesh.npoints)},
            why=why,
        )

    def _newton(self, model: _Model, pressure: np.ndarray) -> Any:
        items = [model.solid, fem.SolidBodyPressure(model.skin, pressure=pressure)]
        with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):  # det F < 0: cut back
            warnings.simplefilter("ignore", MatrixRankWarning)
            return fem.newtonraphson(
                items=items, x0=model.field, dof0=model.held, dof1=model.free, tol=self.tolerance,
                maxiter=self.max_iterations, solver=linear_solver(self.solver), verbose=0,
            )  # fmt: skip


def linear_solver(name: Solver) -> Any:
    """The function that solves one sparse linear system. Raises InvalidInput if its package is not installed."""
    if name == "scipy":
        return spsolve
    try:
        return import_module("pypardiso").spsolve
    except ImportError as error:
        raise InvalidInput(f'no pypardiso ({error}): pip install pypardiso, or use solver="scipy".') from error


def quadrilaterals(triangles: np.ndarray, n: int, rim: np.ndarray) -> tuple[np.ndarray, csr_matrix, np.ndarray]:
    """Cuts each triangle in three at its centroid and the middles of its edges.

    Args:
        triangles: corners of the triangles, (T, 3).
        n: number of vertices that they name.
        rim: mask of the vertices that are held, (n,).

    Returns:
        The quadrilaterals (3 T, 4), turning as the triangles do; the matrix that takes values at the vertices to their
        nodes, the vertices first, (N, n); and the mask of the nodes on the rim, (N,).
    """
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, number, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    middle = n + number.reshape(-1, 3)  # of edges ab, bc, ca
    centre = n + len(edges) + np.arange(len(triangles))
    quads = [np.stack([triangles[:, k], middle[:, k], centre, middle[:, k - 1]], axis=1) for k in range(3)]
    means = [_means(np.arange(n)[:, None], n), _means(edges, n), _means(triangles, n)]
    on_border = (count == 1) & rim[edges].all(axis=1)
    return np.vstack(quads), csr_matrix(vstack(means)), np.r_[rim, on_border, np.zeros(len(triangles), bool)]


def _means(groups: np.ndarray, n: int) -> csr_matrix:
    rows, width = np.repeat(np.arange(len(groups)), groups.shape[1]), groups.shape[1]
    return csr_matrix((np.full(groups.size, 1 / width), (rows, groups.ravel())), shape=(len(groups), n))


def at_nodes(mesh: Any, to_nodes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Values at the corners of the hexahedra, (C,), carried trilinearly to all nodes of the mesh, (N,)."""
    values = np.zeros(mesh.npoints)
    values[mesh.cells] = corners.astype(float)[mesh.cells[:, :8]] @ to_nodes.T
    return values
