"""PatchFem: the converged finite-element answer on the patch of skin around a load, with its own error estimates."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from fem_tools import neo_hookean as nh
from fem_tools.mesh import ElementName, WedgeMesh, level_depths, reference_skin, split
from fem_tools.newton import NewtonResult, NewtonSettings, System, is_positive_definite, solve
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.extrusion import fold_ratios
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.methods.winkler import column_stretch
from stmpl_core.trust import Displacement, Trust

MIN_FOLD = 0.05  # smallest determinant of a wedge at rest, over its mean, that is meshed [-]
QUADRATIC_ABOVE = 0.42  # Poisson's ratio above which linear in plane locks: its largest error passes 3 % of the peak
TWO_DEEP_ABOVE = 0.49  # Poisson's ratio above which one wedge leaves 2 % of the peak, two leave 0.2 %
REFINED_WITHIN = 1.5  # thicknesses of the load; beyond, the layer's own mesh is fine enough
# The stated bound: shares of the estimates and of the peak, fitted on discs of radius 5-18 mm with edges of 3-6 mm on
# arms, p / E 0.1-1.5, reach 3-7, one wedge of P1xP2 against two or three of P2xP2 at half the width: it covers the
# largest error in all 27 cases, and is 2.0 times that error in the middle (docs/ground_truth.md).
DISCRETISATION_SHARE, TRUNCATION_SHARE = 0.5, 0.6
PEAK_SHARE = 0.025  # one wedge through the thickness leaves this share; as much again at p = E, as its square
VALIDATED_RATIO = {"pressure": 2.0, "contact": 2.0, "nodal": 0.4}  # p / E
NEAR_BORDER = 2.0  # thicknesses from the open border, nearer to which it is felt


EdgeLength = Callable[[np.ndarray], np.ndarray]  # points of each triangle (T, k, 3) [m] -> longest edge wanted (T,) [m]


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


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of a layer, meshed: `vertices` of the layer are the first columns of `mesh`."""

    vertices: np.ndarray
    mesh: WedgeMesh
    fixed: np.ndarray  # columns on the cut and on the layer's own border
    distance: np.ndarray  # of each vertex of the patch from the load, along the skin [m]
    splits: tuple[np.ndarray, ...] = ()  # edges whose middles were added by each refinement

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Forces at the corners of the refined triangles, handed to the layer's vertices; their sum is kept."""
        for edges in reversed(self.splits):
            values, middles = values[: -len(edges)].copy(), values[-len(edges) :]
            np.add.at(values, edges.ravel(), np.repeat(middles / 2, 2, axis=0))
        return values

    def interpolate(self, values: np.ndarray) -> np.ndarray:
        """Values at the layer's vertices, linearly on the corners of the patch's refined triangles."""
        values = values[self.vertices]
        for edges in self.splits:
            values = np.concatenate([values, values[edges].mean(axis=1)])
        return values


class PatchFem:
    """Finite elements on the smallest patch that the load needs.

    Args:
        element: "P1xP2", "P2xP2", or None: quadratic in plane where nu > 0.42, linear elsewhere.
        layers: wedges through the thickness; None: two where nu > 0.49, one elsewhere.
        refine: how often the skin triangles near the load are split in four before meshing.
        reach: how far the patch extends beyond the load, in largest thicknesses; its rim is held.
        border: what holds the rim: "clamped" (no motion) or "mirror" (no motion across it: a plane of symmetry).
        settings: where Newton stops.
        check_stability: also test the final tangent for positive definiteness (about a fifth of the time).
    """

    def __init__(
        self,
        *,
        element: ElementName | None = None,
        layers: int | None = None,
        refine: int = 0,
        reach: float = 6.0,
        border: Literal["clamped", "mirror"] = "clamped",
        settings: NewtonSettings | None = None,
        check_stability: bool = True,
    ) -> None:
        if (layers is not None and layers < 1) or refine < 0 or not reach > 0:
            raise InvalidInput(
                f"PatchFem(layers={layers}, refine={refine}, reach={reach}): "
                "layers >= 1, refine >= 0 and reach > 0 are allowed."
            )
        self.element: ElementName | None = element
        self.layers, self.refine, self.reach, self.border = layers, refine, reach, border
        self.settings = settings or NewtonSettings()
        self.check_stability = check_stability
        self.name = "patch_fem"
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Checks that the layer can be meshed.

        Raises:
            MeshError: it folds on itself when it is extruded; the message names the vertices.
        """
        folded = fold_ratios(layer.vertices, layer.inner_vertices, layer.faces) < MIN_FOLD
        if folded.any():
            bad = np.unique(layer.faces[folded])
            raise MeshError(
                f"the layer folds on itself below {len(bad)} vertices: {', '.join(map(str, bad[:12]))}"
                f"{', ...' if len(bad) > 12 else ''}. Thin it there, coarsen the skin, or smooth it."
            )
        length = np.linalg.norm(layer.vertices[layer.edges[:, 0]] - layer.vertices[layer.edges[:, 1]], axis=1)
        n = len(layer.vertices)
        self._graph = csr_matrix((length, layer.edges.T), shape=(n, n))
        self._layer = layer
        return self

    def element_for(self, layer: SoftLayer) -> ElementName:
        """The element that this layer's Poisson's ratio asks for, unless one was chosen."""
        if self.element is not None:
            return self.element
        return "P2xP2" if layer.tissue.poisson_ratio > QUADRATIC_ABOVE else "P1xP2"

    def layers_for(self, layer: SoftLayer) -> int:
        """Wedges through the thickness that this layer's Poisson's ratio asks for, unless a number was chosen."""
        return self.layers or (2 if layer.tissue.poisson_ratio > TWO_DEEP_ABOVE else 1)

    def patch_around(self, vertices: np.ndarray, edge_length: EdgeLength | None = None) -> Patch:
        """Meshes everything within `reach` thicknesses of the given vertices of the layer.

        Triangles are split in four up to `refine` times: near the vertices, or where `edge_length` asks for it.
        """
        layer = prepared(self._layer, self)
        thickness = float(layer.thickness[vertices].max())
        distance = dijkstra(
            self._graph, directed=False, indices=vertices, min_only=True, limit=1.1 * self.reach * thickness
        )
        inside = np.isfinite(distance)
        faces = layer.faces[inside[layer.faces].all(axis=1)].astype(np.int64)
        chosen, flat = np.unique(faces, return_inverse=True)
        outer, inner, triangles = layer.vertices[chosen], layer.inner_vertices[chosen], flat.reshape(-1, 3)
        away, splits = distance[chosen], []
        for _ in range(self.refine):
            if edge_length is None:
                marked = away[triangles].min(axis=1) <= REFINED_WITHIN * thickness
            else:
                corners = outer[triangles]
                longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
                marked = longest > edge_length(np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1))
            triangles, edges = split(triangles, len(outer), marked)
            if not len(edges):
                break
            outer, inner, away = (np.concatenate([x, x[edges].mean(axis=1)]) for x in (outer, inner, away))
            splits.append(edges)
        mesh = WedgeMesh.of(outer, inner, triangles, self.element_for(layer), self.layers_for(layer))
        return Patch(chosen, mesh, mesh.border_columns(), distance[chosen], tuple(splits))

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`, with min det F, stability and error estimates in its trust.

        Never raises for a load that has no solution: the answer then says converged False, and how far it came.
        """
        layer = prepared(self._layer, self)
        load.check(layer)
        if not len(load.loaded):
            zero = np.zeros_like(layer.vertices)
            return Displacement(zero, Trust(error_bound=0.0, why="no load"), self.name, load.values.copy())
        return next(self.solve_many([load]))

    def solve_many(self, loads: Sequence[Load]) -> Iterator[Displacement]:
        """Answers to several loads that press on the same vertices, in the order given, each as `solve` gives it.

        One patch serves them all, and each starts from the answers before it: loads that grow are solved fastest.

        Raises:
            InvalidInput: a load that does not fit the layer, or that presses on other vertices than the first.
        """
        layer, before = prepared(self._layer, self), []
        patch = self.patch_around(loads[0].check(layer).loaded)
        for load in loads:
            if not np.array_equal(load.check(layer).loaded, loads[0].loaded):
                raise InvalidInput("solve_many wants loads on the same vertices; call solve for each of these instead.")
            system = self.system(patch, load)
            pressure = load.pressure_on(layer)
            corners = patch.interpolate(pressure)
            guess = functools.partial(self.guess, system, corners)
            start = None if not before else _ahead(before, float(np.abs(pressure).max()))
            result = solve(system, start, settings=self.settings, guess=guess)
            if result.converged:
                before = [*before[-1:], (float(np.abs(pressure).max()), result.u)]
            answer = np.zeros_like(layer.vertices)
            answer[patch.vertices] = result.u[: len(patch.vertices), 0]
            yield Displacement(answer, self._trust(load, patch, system, result), self.name, pressure)

    def guess(self, system: System, pressure: np.ndarray, factor: float) -> np.ndarray:
        """Where Newton starts under a share of a pressure at the triangle corners, (N,) [Pa]: every column confined."""
        return confined_guess(system, factor * pressure)

    def system(self, patch: Patch, load: Load) -> System:
        """The equations of a patch under a load."""
        layer, mesh = prepared(self._layer, self), patch.mesh
        if load.kind != "nodal":
            pressing = FollowerPressure(mesh, patch.interpolate(load.values))
        else:
            forces = load.forces_on(layer)
            if self.refine == 0 and mesh.element == "P1xP2":
                pressing = DeadForces.at_vertices(mesh, forces[patch.vertices])
            else:  # a force on a point has no converged answer: spread it over the vertex's own area
                pressing = DeadForces.of_traction(mesh, patch.interpolate(forces / layer.vertex_areas[:, None]))
        if self.border == "clamped":
            return System(mesh, layer.tissue, [pressing], patch.fixed)
        return System(mesh, layer.tissue, [pressing], np.zeros_like(patch.fixed), mirror_projectors(mesh))

    def _trust(self, load: Load, patch: Patch, system: System, result: NewtonResult) -> Trust:
        layer = prepared(self._layer, self)
        stable = not self.check_stability or is_positive_definite(system, result.u, result.load_factor)
        discretisation, truncation = discretisation_error(system, result.u), truncation_error(patch, result.u, layer)
        ratio = load.peak_ratio(layer)
        trust = Trust(
            error_bound=error_bound(discretisation, truncation, result.u, patch.mesh.layers, ratio),
            figures={
                "min_j": result.min_j,
                "positive_definite": float(stable),
                "residual": result.residual,
                "load_factor": result.load_factor,
                "newton_iterations": result.iterations,
                "linear_iterations": result.linear_iterations,
                "discretisation_m": discretisation,
                "truncation_m": truncation,
                "pressure_over_modulus": ratio,
                "columns": patch.mesh.n_columns,
            },
        )
        if not result.converged:
            trust = trust.also(
                f"Newton stopped at {result.load_factor:.0%} of the load (p/E {ratio:.2g}): "
                "the displacement is that of the last load that converged",
                converged=False,
                in_range=False,
            )
        if not stable:
            trust = trust.also(
                "the final tangent is not positive definite: this equilibrium is unstable", in_range=False
            )
        trust = validated(trust, load, ratio)
        if load.kind == "contact":
            trust = replace(trust, error_bound=None)
            trust = trust.also("how rigid tools pull along the skin is left out (fem_tools.IndenterFem has it)")
        if self.border == "clamped":
            trust = away_from_border(trust, patch, layer)
        return trust if trust.ok else replace(trust, error_bound=None)


def validated(trust: Trust, load: Load, ratio: float) -> Trust:
    """The same trust, lowered where nobody validated such a load; `ratio`: its highest p / E [-]."""
    limit = VALIDATED_RATIO[load.kind]
    if ratio > limit:
        trust = trust.also(f"p/E is {ratio:.2g}; validated up to {limit:g} for {load.kind} loads", in_range=False)
    if (load.values < 0).any():
        trust = trust.also("the load pulls; only pressing was validated", in_range=False)
    return trust


def away_from_border(trust: Trust, patch: Patch, layer: SoftLayer) -> Trust:
    """The same trust, lowered where the load is close to the layer's open border."""
    rim = patch.distance[np.isin(patch.vertices, layer.border)]
    nearest = float(rim.min(initial=np.inf)) / float(layer.thickness.max())
    if nearest >= NEAR_BORDER:
        return trust
    why = f"the load is {nearest:.1f} thicknesses from the layer's open border, which is held"
    return trust.also(why, in_range=False)


def _ahead(before: list[tuple[float, np.ndarray]], pressure: float) -> np.ndarray:
    """The last answers carried on in a straight line to a larger load, (C, levels, 3) [m]."""
    (first, u), (last, v) = ((0.0, np.zeros_like(before[0][1])), *before)[-2:]
    return v + (v - u) * ((pressure - last) / (last - first)) if last != first else v


def confined_guess(system: System, pressure: np.ndarray) -> np.ndarray:
    """Each column compressed as if confined by its own pressure (Winkler), linearly through the depth."""
    stretch = column_stretch(system.mesh.on_columns(pressure), system.tissue)
    outer, inner = system.mesh.column_ends()
    depth = level_depths(system.mesh.layers)[None, :, None]
    u = (1 - stretch)[:, None, None] * (inner - outer)[:, None] * (1 - depth)
    u[system.fixed] = 0.0
    return u if system.keep is None else np.einsum("cij,clj->cli", system.keep, u)


def error_bound(discretisation: float, truncation: float, u: np.ndarray, layers: int, ratio: float) -> float:
    """The largest error to expect at any vertex [m].

    Args:
        discretisation, truncation: their estimates [m].
        u: (C, levels, 3) [m].
        layers: wedges through the thickness.
        ratio: largest p / E [-].
    """
    peak = float(np.linalg.norm(u[:, 0], axis=1).max(initial=0.0))
    depth = PEAK_SHARE * peak * (1 / layers**2 + ratio**2)
    return DISCRETISATION_SHARE * discretisation + TRUNCATION_SHARE * truncation + depth


def truncation_error(patch: Patch, u: np.ndarray, layer: SoftLayer) -> float:
    """Estimate of what the held rim of the patch changes [m]: the motion one thickness inside the cut.

    Zero where the patch is the whole layer.
    """
    n = len(patch.vertices)
    own = np.isin(patch.vertices, layer.border)
    cut = patch.vertices[patch.fixed[:n] & ~own]
    if not len(cut):
        return 0.0
    points = layer.vertices[patch.vertices]
    gap = KDTree(layer.vertices[cut]).query(points)[0]
    near = gap < 1.25 * layer.thickness.max()
    return float(np.linalg.norm(u[:n, 0][near], axis=1).max(initial=0.0))


def discretisation_error(system: System, u: np.ndarray) -> float:
    """Estimate of the largest error of the skin's displacement that the mesh width leaves [m].

    The middle of each edge is where a linear interpolation is worst: by Hermite's cubic through the recovered nodal
    slopes it is off by |(g_b - g_a) . e| / 8 (Zienkiewicz & Zhu's recovery, IJNME 24, 1987, on the skin).
    """
    mesh, skin = system.mesh, system.rest[:, 0]
    corners, value = mesh.triangles, u[:, 0]
    a, b, c = (skin[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    double = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / double
    slopes = (
        sum(
            value[corners[:, k]][:, :, None] * np.cross(normal, edge)[:, None, :]
            for k, edge in enumerate((c - b, a - c, b - a))
        )
        / double[:, :, None]
    )  # (T, 3, 3) du_i / dx_j
    nodal, area = np.zeros((len(skin), 3, 3)), np.zeros(len(skin))
    for k in range(3):
        np.add.at(nodal, corners[:, k], slopes * double[:, :, None])
        np.add.at(area, corners[:, k], double[:, 0])
    nodal /= np.maximum(area, 1e-300)[:, None, None]
    edges = np.unique(np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    along = skin[edges[:, 1]] - skin[edges[:, 0]]
    bend = np.einsum("eij,ej->ei", nodal[edges[:, 1]] - nodal[edges[:, 0]], along) / 8
    return float(np.linalg.norm(bend, axis=1).max(initial=0.0))


def mirror_projectors(mesh: WedgeMesh) -> np.ndarray:
    """Projectors that keep each rim column in the planes of symmetry through its rim edges, (C, 3, 3)."""
    skin, keep = mesh.column_ends()[0], np.tile(np.eye(3), (mesh.n_columns, 1, 1))
    directed = mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, first, count = np.unique(np.sort(directed, axis=1), axis=0, return_index=True, return_counts=True)
    for k in first[count == 1]:
        start, end = directed[k]
        a, b, c = skin[mesh.triangles[k // 3]]
        across = np.cross(skin[end] - skin[start], np.cross(b - a, c - a))
        at = [start, end]
        if len(mesh.edges):
            at.append(mesh.columns[k // 3, 3 + k % 3])
        for column in at:
            v = keep[column] @ (across / np.linalg.norm(across))
            if (size := np.linalg.norm(v)) > 0.3:  # a corner has two planes
                keep[column] -= np.outer(v, v) / size**2
    return keep
