"""PatchFem: the converged finite-element answer on the patch of skin around a load, with its own error estimates."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from fem_tools.estimates import discretisation_error, error_bound, truncation_error, within
from fem_tools.mesh import ElementName, WedgeMesh, split
from fem_tools.newton import NewtonResult, NewtonSettings, is_positive_definite, solve, work_spent
from fem_tools.plies import confined, largest_poisson_ratio, wedge_ends
from fem_tools.skin_loads import DeadForces, FollowerPressure
from fem_tools.system import SkinLoad, System
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.extrusion import fold_ratios
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.trust import Displacement, Trust

MIN_FOLD = 0.02  # smallest determinant of a wedge at rest, over its mean, that is meshed [-]
FOLDS_FROM = 2.5  # distance of a fold from the load, from which it is cut out, over the thickness under the load
QUADRATIC_ABOVE = 0.42  # Poisson's ratio above which linear in plane locks: its largest error passes 3 % of the peak
TWO_DEEP_ABOVE = 0.49  # Poisson's ratio above which one wedge leaves 2 % of the peak, two leave 0.2 %
REFINED_WITHIN = 1.5  # thicknesses of the load; beyond, the layer's own mesh is fine enough
VALIDATED_RATIO = {"pressure": 2.0, "contact": 2.0, "nodal": 0.4}  # p / E
STIFF_SKIN = 10.0  # kappa, E_s h / (E t), above which a solve starts from rest; at 30 that is ten times as fast [-]
NEAR_BORDER = 2.0  # thicknesses from the open border, nearer to which it is felt

EdgeLength = Callable[[np.ndarray], np.ndarray]  # points of each triangle (T, k, 3) [m] -> longest edge wanted (T,) [m]


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of a layer, meshed: `vertices` of the layer are the first columns of `mesh`."""

    vertices: np.ndarray
    mesh: WedgeMesh
    fixed: np.ndarray  # columns on the cut and on the layer's own border
    distance: np.ndarray  # of each vertex of the patch from the load, along the skin [m]
    to_border: float  # distance of the load from the layer's open border, along the skin [m]; inf: beyond the patch
    near_cut: np.ndarray  # numbers of the patch's vertices that are about a thickness or less from the cut
    splits: tuple[np.ndarray, ...] = ()  # edges whose middles were added by each refinement

    def farthest(self, loaded: np.ndarray) -> float:
        """Largest distance of some vertices from the load that was meshed for [m]; infinite where one is not here."""
        place = np.minimum(np.searchsorted(self.vertices, loaded), len(self.vertices) - 1)
        if not (self.vertices[place] == loaded).all():
            return np.inf
        return float(self.distance[place].max(initial=0.0))

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
        layers: wedges through the thickness, of a stack through its first material, with as many below as
            fem_tools.plies.wedge_ends says; None: two where nu > 0.49, in a stack, or under a skin, one elsewhere.
        refine: number of times that the skin triangles near the load are split in four before meshing.
        reach: width of the patch beyond the load [largest thicknesses]; its rim is held.
        border: condition at the rim: "clamped" (no motion) or "mirror" (no motion across it: a plane of symmetry).
        settings: settings of Newton's method.
        check_stability: test of the final tangent for positive definiteness, on or off (about a fifth of the time).
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
        """Keeps the layer, with its graph of edges and where it folds on itself when it is extruded."""
        self._folded = fold_ratios(layer.vertices, layer.inner_vertices, layer.faces) < MIN_FOLD
        length = np.linalg.norm(layer.vertices[layer.edges[:, 0]] - layer.vertices[layer.edges[:, 1]], axis=1)
        n = len(layer.vertices)
        one_way = csr_matrix((length, layer.edges.T), shape=(n, n))
        self._graph = one_way + one_way.T
        self._layer = layer
        return self

    def element_for(self, layer: SoftLayer) -> ElementName:
        """The element that this layer's Poisson's ratio asks for, unless one was chosen."""
        if self.element is not None:
            return self.element
        return "P2xP2" if largest_poisson_ratio(layer.tissue) > QUADRATIC_ABOVE else "P1xP2"

    def layers_for(self, layer: SoftLayer) -> int:
        """Wedges through the first material that this layer's tissue asks for, unless a number was chosen."""
        deep = largest_poisson_ratio(layer.tissue) > TWO_DEEP_ABOVE or not layer.tissue.single
        return self.layers or (2 if deep else 1)

    def patch_around(self, vertices: np.ndarray, edge_length: EdgeLength | None = None) -> Patch:
        """Meshes everything within `reach` thicknesses of the given vertices of the layer.

        Triangles are split in four up to `refine` times: near the vertices, or where `edge_length` asks for it. Where
        the layer folds on itself, FOLDS_FROM thicknesses away or farther, a hole is left, held at its rim as the
        patch is.

        Raises:
            MeshError: the layer folds on itself nearer than that; the message names the vertices.
        """
        layer = prepared(self._layer, self)
        thickness = float(layer.thickness[vertices].max())
        limit = 1.1 * self.reach * thickness
        distance = dijkstra(self._graph, indices=vertices, min_only=True, limit=limit)
        inside = np.isfinite(distance)
        chosen_faces = _faces_of(layer.faces, inside)
        folded = self._folded[chosen_faces]
        self._refuse_folds(layer.faces[chosen_faces[folded]], distance, thickness)
        faces = layer.faces[chosen_faces[~folded]].astype(np.int64)
        chosen, flat = np.unique(faces, return_inverse=True)
        outer, inner, triangles = layer.vertices[chosen], layer.inner_vertices[chosen], flat.reshape(-1, 3)
        away, splits = distance[chosen], []
        scale = np.ones(len(chosen)) if layer.ply_scale is None else layer.ply_scale[chosen]
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
            outer, inner, away, scale = (np.concatenate([x, x[edges].mean(axis=1)])
                                         for x in (outer, inner, away, scale))  # fmt: skip
            splits.append(edges)
        ends = wedge_ends(layer.tissue, np.linalg.norm(inner - outer, axis=1), self.layers_for(layer), scale)
        mesh = WedgeMesh.of(outer, inner, triangles, self.element_for(layer), ends=ends, ply_scale=scale)
        fixed, own = mesh.border_columns(), np.isin(chosen, layer.border)
        points = layer.vertices[chosen]
        near = within(points, points[fixed[: len(chosen)] & ~own], 1.25 * layer.thickness[chosen])
        to_border = float(distance[chosen[own]].min(initial=np.inf))
        return Patch(chosen, mesh, fixed, distance[chosen], to_border, near, tuple(splits))

    def _refuse_folds(self, folded: np.ndarray, distance: np.ndarray, thickness: float) -> None:
        """Raises MeshError if some of such faces, (k, 3), are near: distances from the load are (V,) [m]."""
        near = min(self.reach, FOLDS_FROM)
        bad = np.unique(folded[distance[folded].min(axis=1) < near * thickness])
        if len(bad):
            raise MeshError(
                f"the layer folds on itself below {len(bad)} vertices within {near:g} thicknesses of the load: "
                f"{', '.join(map(str, bad[:12]))}{', ...' if len(bad) > 12 else ''}. "
                "Press elsewhere, thin the layer there, coarsen the skin, or smooth it."
            )

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`, with min det F, stability and error estimates in its trust.

        Never raises for a load that has no solution: the answer then says converged False, and how far it came.

        Raises:
            MeshError: the layer folds on itself near the load (see patch_around).
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
            MeshError: as `solve`.
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
            yield Displacement(answer, self.trust(load, patch, system, result), self.name, pressure)

    def guess(self, system: System, pressure: np.ndarray, factor: float) -> np.ndarray:
        """Where Newton starts under a share of a pressure at the triangle corners, (N,) [Pa]: every column confined.

        Under a skin much stiffer than the layer it starts from rest: columns that give way one by one would tear it.
        """
        layer = prepared(self._layer, self)
        if layer.tissue.kappa(float(layer.thickness.max())) > STIFF_SKIN:
            return system.zeros()
        return confined_guess(system, factor * pressure)

    def system(self, patch: Patch, load: Load) -> System:
        """The equations of a patch under a load."""
        layer, mesh, loads = prepared(self._layer, self), patch.mesh, [self.pressing(patch, load)]
        if self.border == "clamped":
            return System(mesh, layer.tissue, loads, patch.fixed)
        return System(mesh, layer.tissue, loads, np.zeros_like(patch.fixed), mirror_projectors(mesh))

    def pressing(self, patch: Patch, load: Load) -> SkinLoad:
        """A load on the columns of a patch."""
        layer, mesh = prepared(self._layer, self), patch.mesh
        if load.kind != "nodal":
            return FollowerPressure(mesh, patch.interpolate(load.values))
        forces = load.forces_on(layer)
        if self.refine == 0 and mesh.element == "P1xP2":
            return DeadForces.at_vertices(mesh, forces[patch.vertices])
        # a force on a point has no converged answer: spread it over the vertex's own area
        return DeadForces.of_traction(mesh, patch.interpolate(forces / layer.vertex_areas[:, None]))

    def trust(self, load: Load, patch: Patch, system: System, result: NewtonResult) -> Trust:
        """What may be believed of a result on a patch."""
        layer = prepared(self._layer, self)
        stable = not self.check_stability or is_positive_definite(system, result.u, result.load_factor)
        discretisation, truncation = discretisation_error(system, result.u), truncation_error(patch, result.u)
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
                "work": result.work,
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
            if spent := work_spent(result.work, self.settings.max_work):
                trust = trust.also(spent)
        if not stable:
            trust = trust.also(
                "the final tangent is not positive definite: this equilibrium is unstable", in_range=False
            )
        trust = validated(trust, load, ratio)
        if load.kind == "contact":
            trust = replace(trust, error_bound=None)
            trust = trust.also("how rigid tools pull along the skin is left out (fem_tools.IndenterFem has it)")
        if self.border == "clamped":
            trust = away_from_border(trust, patch, layer, load.loaded)
        return trust if trust.ok else replace(trust, error_bound=None)


def validated(trust: Trust, load: Load, ratio: float) -> Trust:
    """The same trust, lowered where nobody validated such a load; `ratio`: its highest p / E [-]."""
    limit = VALIDATED_RATIO[load.kind]
    if ratio > limit:
        trust = trust.also(f"p/E is {ratio:.2g}; validated up to {limit:g} for {load.kind} loads", in_range=False)
    if (load.values < 0).any():
        trust = trust.also("the load pulls; only pressing was validated", in_range=False)
    return trust


def away_from_border(trust: Trust, patch: Patch, layer: SoftLayer, loaded: np.ndarray) -> Trust:
    """The same trust, lowered where a load on these vertices may be close to the layer's open border."""
    nearest = (patch.to_border - patch.farthest(loaded)) / float(layer.thickness.max())
    if nearest >= NEAR_BORDER:
        return trust
    why = f"the load is {nearest:.1f} thicknesses from the layer's open border, which is held"
    return trust.also(why, in_range=False)


@njit(cache=True)
def _faces_of(faces, inside):
    """Numbers of the faces (F, 3) whose corners are all inside, a mask of the vertices (V,)."""
    out = np.empty(len(faces), dtype=np.int64)
    n = 0
    for k in range(len(faces)):
        if inside[faces[k, 0]] and inside[faces[k, 1]] and inside[faces[k, 2]]:
            out[n] = k
            n += 1
    return out[:n]


def _ahead(before: list[tuple[float, np.ndarray]], pressure: float) -> np.ndarray:
    """The last answers carried on in a straight line to a larger load, (C, levels, 3) [m]."""
    (first, u), (last, v) = ((0.0, np.zeros_like(before[0][1])), *before)[-2:]
    return v + (v - u) * ((pressure - last) / (last - first)) if last != first else v


def confined_guess(system: System, pressure: np.ndarray) -> np.ndarray:
    """Each column compressed as if confined by its own pressure (Winkler), linearly through each material."""
    u = confined(system.mesh, system.tissue, system.mesh.on_columns(pressure))
    u[system.fixed] = 0.0
    return u if system.keep is None else np.einsum("cij,clj->cli", system.keep, u)


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
