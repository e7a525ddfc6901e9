"""PatchPeer: what all peers share: the patch around the load, meshed once for each set of loaded vertices."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from fem_tools.patch import Patch, PatchFem
from fem_tools.skin_loads import DeadForces, FollowerPressure
from stmpl_core.arrays import VertexVectors
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer, single
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.tissue import Tissue
from stmpl_core.trust import Displacement, Trust
from studies.tets import TetMesh, split_wedges


@dataclass(frozen=True, eq=False)
class TetPatch:
    """The patch around a load as linear tetrahedra; level k of the nodes is [k N, (k + 1) N), level 0 the skin.

    Attributes:
        patch: patch of the layer, whose vertices are its first.
        tets: wedges cut in three.
        held: nodes on the core and on the patch's rim, (N,).
    """

    patch: Patch
    tets: TetMesh
    held: np.ndarray

    @classmethod
    def of(cls, patch: Patch, layers: int) -> TetPatch:
        """Cuts the wedges under the patch's triangles."""
        mesh = patch.mesh
        tets = split_wedges(mesh.outer, mesh.inner, mesh.triangles, layers)
        return cls(patch, tets, tets.core | np.tile(patch.fixed, layers + 1))

    def smallest_det(self, points: np.ndarray) -> float:
        """Smallest det F of the tetrahedra with their nodes at `points`, (N, 3) [m]."""
        corners = points[self.tets.tets]
        volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
        return float((volumes / self.tets.volumes).min())


@dataclass(frozen=True, eq=False)
class SkinForces:
    """What a load presses with on the nodes of the skin.

    Attributes:
        load: load on the layer, for what its kind asks.
        pressure: pressure at the corners of the patch's triangles, (N,) [Pa].
        pressing: load on the patch, as PatchFem has it.
    """

    load: Load
    pressure: np.ndarray
    pressing: FollowerPressure | DeadForces

    @classmethod
    def of(cls, load: Load, layer: SoftLayer, patch: Patch) -> SkinForces:
        """The load on a patch with linear triangles: a pressure follows the skin, nodal forces are dead."""
        pressure = patch.interpolate(load.pressure_on(layer))
        if load.kind != "nodal":
            return cls(load, pressure, FollowerPressure(patch.mesh, pressure))
        traction = load.forces_on(layer) / layer.vertex_areas[:, None]
        return cls(load, pressure, DeadForces.of_traction(patch.mesh, patch.interpolate(traction)))

    def at(self, skin: np.ndarray) -> VertexVectors:
        """Forces on the nodes of the skin when they are at `skin`, (N, 3) [m], as (N, 3) [N]."""
        forces = np.zeros_like(skin)
        self.pressing.add_forces(skin, 1.0, forces)
        return forces


@dataclass(frozen=True, eq=False)
class Found:
    """What a peer came to: skin displacements, (N, 3) [m], and what it says of itself."""

    skin: VertexVectors
    converged: bool
    residual: float  # forces that are left over, over what the load presses with [-]
    min_j: float
    figures: dict[str, float]
    why: str = ""


class PatchPeer(ABC):
    """A simulator on the patch of skin around the load, set up once for each set of loaded vertices.

    The set-up (mesh, model, compilation) is kept while loads press on the same vertices, so that a solve costs what the
    simulator itself costs; PatchFem, beside it, makes its mesh anew in every solve.

    Args:
        layers: elements through the thickness.
        refine: number of times that the skin triangles near the load are split in four.
        reach: width of the patch beyond the load [largest thicknesses]; its rim is held.
    """

    name: str = "peer"

    def __init__(self, *, layers: int, refine: int, reach: float) -> None:
        if layers < 1:
            raise InvalidInput(f"{type(self).__name__}(layers={layers}): at least 1 is needed.")
        self.layers, self.refine, self.reach = layers, refine, reach
        self._mesher = PatchFem(element="P1xP2", refine=refine, reach=reach)
        self._layer: SoftLayer | None = None
        self._kept: tuple[bytes, Patch, Any] | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """See PatchFem.prepare. Raises InvalidInput for a skin or a stack."""
        single(layer, type(self).__name__, straight=False)
        self._mesher.prepare(layer)
        self._layer, self._kept = layer, None
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`, from rest; its trust says what the peer's own residual is."""
        layer = prepared(self._layer, self)
        load.check(layer)
        if not len(load.loaded):
            return Displacement(np.zeros_like(layer.vertices), Trust(why="no load"), self.name, load.values.copy())
        key = load.loaded.tobytes()
        if self._kept is None or self._kept[0] != key:
            patch = self._mesher.patch_around(load.loaded)
            self._kept = (key, patch, self._set_up(patch, layer.tissue))
        _, patch, model = self._kept
        found = self._run(model, SkinForces.of(load, layer, patch))
        answer = np.zeros_like(layer.vertices)
        if np.isfinite(found.skin).all():
            answer[patch.vertices] = found.skin[: len(patch.vertices)]
        else:
            found = replace(found, converged=False, why="blew up: no displacement is given")
        return Displacement(answer, _trust(found, load.peak_ratio(layer)), self.name, load.pressure_on(layer))

    @abstractmethod
    def _set_up(self, patch: Patch, tissue: Tissue) -> Any:
        """What the peer keeps of a patch."""

    @abstractmethod
    def _run(self, model: Any, forces: SkinForces) -> Found:
        """The equilibrium, from rest."""


def _trust(found: Found, ratio: float) -> Trust:
    figures = {"residual": found.residual, "min_j": found.min_j, "pressure_over_modulus": ratio} | found.figures
    trust = Trust(figures=figures, why=found.why)
    if not found.converged:
        left = f": {found.residual:.1%} of the load is not balanced" if np.isfinite(found.residual) else ""
        trust = trust.also(f"not in equilibrium{left}", converged=False)
    if found.min_j <= 0:
        trust = trust.also(f"an element is turned inside out (det F {found.min_j:.2g})", in_range=False)
    return trust
