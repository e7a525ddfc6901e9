"""WarmPatchFem: PatchFem from frame to frame, started from the answer before on a patch and a tangent that are kept."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from fem_tools.krylov import bicgstab, dot, multiply, precondition
from fem_tools.mesh import ElementName
from fem_tools.newton import TANGENT_COST, NewtonResult, NewtonSettings, line_search, relative_residual, solve
from fem_tools.patch import Patch, PatchFem
from fem_tools.system import System
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.trust import Displacement, Trust

MAX_STEPS = 6  # Newton and chord steps of a warm frame; then it is solved as PatchFem does
SLOW = 0.3  # share of the residual that a step may leave before the tangent is made anew
NEAR = 1.0  # thicknesses of the load within which the tangent is made anew; strains beyond are small
JUMP = 2.0  # thicknesses from where its patch was meshed for, beyond which a load is solved anew: that is quicker
WARM_SHARE, MESHED_SHARE = 0.4, 0.6  # most of PatchFem's time that a warm frame takes, and one that meshes anew [-]
CHANGED = 0.5  # change of the load over the load, from which a frame is expected to be solved anew [-]
FORCING = (0.05, 0.3)  # least and largest share of a residual that the linear solver may leave of a step's
AIM = 0.3  # share of the tolerance that the linear solver aims at
RESIDUAL_SHARE = 10.0  # largest error over the peak that a residual over the load left, on slides and presses [-]


class WarmPatchFem:
    """Finite elements for loads that change little from one to the next: the first as PatchFem, then a step or two.

    A frame starts from the last answer, carried on along its last change by the share that leaves the least residual,
    in the preconditioner's norm and by the last tangent (Fischer, CMAME 163, 1998, with one direction). The tangent is
    then made anew within a thickness of the load; Newton and chord steps follow until the residual is under
    `tolerance`, each held back by Newton's line search. If they do not get there the load is solved as PatchFem does,
    from the last answer and then from rest; if that fails too, the answer says converged False. The patch is meshed
    anew when the load has moved by more than `slack`; what both patches have is carried over, unless it jumped.

    So an answer depends on those before it, by what `tolerance` leaves. Stability is not tested (PatchFem does).

    In `trust.figures`: "cold", 1 where an answer was solved as PatchFem does, as the first is; "meshed", 1 where the
    patch was made anew.

    Args:
        element: as for PatchFem.
        layers: as for PatchFem.
        reach: least width of the patch beyond the load [largest thicknesses].
        slack: width by which it is meshed wider, so that the load may move [largest thicknesses].
        tolerance: residual over load at which a frame is done, as in NewtonSettings [-].

    Raises:
        InvalidInput: a reach or tolerance that is not positive, or a negative slack.
    """

    def __init__(
        self,
        *,
        element: ElementName | None = None,
        layers: int | None = None,
        reach: float = 5.5,
        slack: float = 0.75,
        tolerance: float = 1e-3,
    ) -> None:
        if not (reach > 0 and slack >= 0 and tolerance > 0):
            raise InvalidInput(
                f"WarmPatchFem(reach={reach}, slack={slack}, tolerance={tolerance}): "
                "reach > 0, slack >= 0 and tolerance > 0 are allowed."
            )
        settings = NewtonSettings(tolerance=tolerance)
        self.fem = PatchFem(
            element=element, layers=layers, reach=reach + slack, settings=settings, check_stability=False
        )
        self.reach, self.slack, self.tolerance = reach, slack, tolerance
        self.name, self.measured_as = "warm_patch_fem", "patch_fem"
        self._layer: SoftLayer | None = None
        self._frame: _Frame | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Keeps the layer and forgets the last answer."""
        self.fem.prepare(layer)
        self._layer, self._frame = layer, None
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`, with the bound of PatchFem and what the residual may leave in its trust.

        Never raises for a load that has no solution: the answer then says converged False, and how far it came.

        Raises:
            NotPrepared: before `prepare`.
            InvalidInput: the load does not fit the layer.
            MeshError: the layer folds on itself near the load (see PatchFem.patch_around).
        """
        layer = prepared(self._layer, self)
        loaded, pressure = load.check(layer).loaded, load.pressure_on(layer)
        self._pressure = pressure
        answer = np.zeros_like(layer.vertices)
        if not len(loaded):
            if self._frame is not None:
                self._frame.let_go()
            return Displacement(answer, Trust(error_bound=0.0, why="no load"), self.name, pressure)
        before, frame = self._frame, self._frame_for(loaded)
        self._frame, meshed = None, before is not frame  # an error below leaves nothing that is half done
        system = frame.press(self.fem, load)
        result = frame.follow(self.tolerance) if frame.warm and not system.conservative else None
        if cold := result is None:
            corners = frame.patch.interpolate(pressure)
            start = frame.u if frame.warm else None
            result = solve(system, start, self.fem.settings, lambda share: self.fem.guess(system, corners, share))
        if result.converged:
            frame.accept(result, anew=cold)
            self._frame = frame
        answer[frame.patch.vertices] = result.u[: len(frame.patch.vertices), 0]
        trust = self.fem.trust(load, frame.patch, system, result)
        figures = {**trust.figures, "cold": float(cold), "meshed": float(meshed)}
        bound = trust.error_bound
        if bound is not None:
            bound += RESIDUAL_SHARE * result.residual * float(np.linalg.norm(answer, axis=1).max())
        return Displacement(answer, replace(trust, error_bound=bound, figures=figures), self.name, pressure)

    def share_of_time(self, load: Load) -> float:
        """Share of PatchFem's time that a load takes after the last one: 1 where it is not near [-]."""
        frame, layer, loaded = self._frame, prepared(self._layer, self), load.loaded
        if frame is None or not frame.warm or not len(loaded):
            return 1.0
        pressure = load.pressure_on(layer)
        away, thickness = frame.patch.farthest(loaded), float(layer.thickness[loaded].max())
        if away > JUMP * thickness or np.abs(pressure - self._pressure).sum() > CHANGED * np.abs(pressure).sum():
            return 1.0
        return WARM_SHARE if away <= frame.width - self.reach * thickness else MESHED_SHARE

    def _frame_for(self, loaded: np.ndarray) -> _Frame:
        """The last frame, or one on a new patch with what that patch shares with the last."""
        layer, last = prepared(self._layer, self), self._frame
        thickness = float(layer.thickness[loaded].max())
        if last is not None and last.patch.farthest(loaded) <= last.width - self.reach * thickness:
            return last
        patch = self.fem.patch_around(loaded)
        near = patch.distance <= (NEAR + self.slack) * thickness
        frame = _Frame.of(patch, System(patch.mesh, layer.tissue, [], patch.fixed), near, self.fem.reach * thickness)
        if last is not None and last.patch.farthest(loaded) <= JUMP * thickness:
            frame.take_over(last)
        return frame


@dataclass(eq=False)
class _Frame:
    """What is kept from one answer to the next, on one patch.

    Args:
        patch: patch.
        width: width of the patch beyond the load that it was meshed for [m].
        system: its equations under the load of this frame.
        near: those of the wedges near the load.
        far: those of the others, without a load.
        columns: numbers of the columns near the load.
        u: last answer, (C, levels, 3) [m].
        warm: flag of a `u` that is an answer.
        change: difference of it from the answer before, (C, 3 m) [m].
        inside: internal forces at `u`, (C, 3 m) [N]; None where they are not known.
        min_j: smallest det F at `u`, where `inside` is known [-].
        beyond: part of the tangent that `far` has, (n_blocks, 3 m, 3 m) [N/m]; None where it is out of date.
        tangent: last tangent, (n_blocks, 3 m, 3 m) [N/m].
        inverse: inverse of each column's own block of it, (C, 3 m, 3 m) [m/N].
    """

    patch: Patch
    width: float
    system: System
    near: System
    far: System
    columns: np.ndarray
    u: np.ndarray
    warm: bool = False
    change: np.ndarray | None = None
    inside: np.ndarray | None = None
    min_j: float = 1.0
    beyond: np.ndarray | None = None
    tangent: np.ndarray = field(init=False)
    inverse: np.ndarray = field(init=False)

    @classmethod
    def of(cls, patch: Patch, system: System, near: np.ndarray, width: float) -> _Frame:
        """A frame at rest; `near`: mask of the patch's vertices near the load, (N,)."""
        chosen = near[patch.mesh.triangles].any(axis=1)
        columns = np.unique(patch.mesh.columns[chosen])
        return cls(patch, width, system, system.part(chosen), system.part(~chosen), columns, system.zeros())

    def take_over(self, last: _Frame) -> None:
        """Carries the last answer over from another patch, if that has as many levels."""
        if last.u.shape[1:] != self.u.shape[1:]:
            return
        _, old, new = np.intersect1d(_names(last.patch), _names(self.patch), assume_unique=True, return_indices=True)
        self.u[new] = last.u[old]
        self.u[self.patch.fixed] = 0.0
        self.warm = True
        if last.change is not None:
            self.change = np.zeros((len(self.u), last.change.shape[1]))
            self.change[new] = last.change[old]
            self.change[self.patch.fixed] = 0.0

    def press(self, fem: PatchFem, load: Load) -> System:
        """The equations under a load."""
        self.system.loads = self.near.loads = [fem.pressing(self.patch, load)]
        return self.system

    def let_go(self) -> None:
        """Back to rest."""
        self.u, self.change, self.inside = self.system.zeros(), None, None

    def accept(self, result: NewtonResult, *, anew: bool) -> None:
        """Takes an answer; `anew`: one that owes nothing to the last."""
        free, u = self.system.free, result.u
        self.change = (u if anew else u - self.u)[:, :free].reshape(len(u), -1)  # at first as if from rest
        self.u, self.warm = u, True
        if anew:
            self.inside = self.beyond = None
            self._make_tangent(u)

    def follow(self, tolerance: float) -> NewtonResult | None:
        """Newton and chord steps from the last answer; None if they do not reach the tolerance."""
        system, mesh, settings, u, linear = self.system, self.system.mesh, NewtonSettings(), self.u, 0
        if self.inside is None:
            r, min_j = system.residual(u, 1.0)
        else:
            r, min_j = self.inside.copy(), self.min_j
            r[:, :3] -= system.external(u, 1.0)
        fresh = self.beyond is None
        if fresh:
            self._make_tangent(u)
        relative, scale = relative_residual(system, self.inverse, r, u, 1.0)
        if self.change is not None and relative > tolerance:
            u, r, min_j = self._ahead(self.change, u, r, min_j)
            relative, scale = relative_residual(system, self.inverse, r, u, 1.0)
        for step in range(MAX_STEPS + 1):
            if relative <= tolerance:
                self.inside, self.min_j = r, min_j
                self.inside[:, :3] += system.external(u, 1.0)
                work = float(self.tangent.size) * (linear + TANGENT_COST)
                return NewtonResult(u, True, relative, min_j, step, linear, 1.0, work, scale)
            if not np.isfinite(relative) or step == MAX_STEPS:
                break
            if not fresh:
                if step > 1:  # what is kept beyond may be what makes it slow
                    self.beyond = None
                self._make_tangent(u)
            forcing = float(np.clip(AIM * tolerance / relative, *FORCING))
            du, n, _ = bicgstab(mesh.indptr, mesh.indices, self.tangent, self.inverse, -r, forcing,
                                settings.linear_iterations)  # fmt: skip
            linear += n
            stepped = line_search(system, u, du, r, self.inverse, 1.0, settings)
            if stepped is None:
                break
            u, r, min_j = stepped
            before = relative
            relative, scale = relative_residual(system, self.inverse, r, u, 1.0)
            fresh = relative <= SLOW * before
        return None

    def _ahead(
        self, change: np.ndarray, u: np.ndarray, r: np.ndarray, min_j: float
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """A share of the last change ahead of `u`, if the residual is smaller there."""
        mesh = self.system.mesh
        along, weighed, now = np.empty_like(r), np.empty_like(r), np.empty_like(r)
        multiply(mesh.indptr, mesh.indices, self.tangent, change, along)
        precondition(self.inverse, along, weighed)
        size = dot(along, weighed)
        if not size > 0:
            return u, r, min_j
        ahead = u.copy()
        share = -dot(r, weighed) / size
        ahead[:, : self.system.free] += share * change.reshape(len(u), self.system.free, 3)
        r_ahead, min_j_ahead = self.system.residual(ahead, 1.0)
        precondition(self.inverse, r, now)
        precondition(self.inverse, r_ahead, weighed)
        if min_j_ahead > NewtonSettings().min_j and dot(r_ahead, weighed) < dot(r, now):
            return ahead, r_ahead, min_j_ahead
        return u, r, min_j

    def _make_tangent(self, u: np.ndarray) -> None:
        """The tangent at `u`: near the load, and beyond where it was not made on this patch."""
        if self.beyond is None:
            self.beyond = self.far.tangent(u, 1.0)
            self.tangent = self.near.tangent(u, 1.0, onto=self.beyond.copy())
            self.inverse = self.system.preconditioner(self.tangent)
        else:
            np.copyto(self.tangent, self.beyond)
            self.near.tangent(u, 1.0, onto=self.tangent)
            self.inverse[self.columns] = self.system.preconditioner(self.tangent, self.columns)


def _names(patch: Patch) -> np.ndarray:
    """Numbers of the columns that are the same in all patches of a layer, (C,): of a vertex, or of an edge's ends."""
    corners = np.arange(len(patch.vertices))
    ends = np.concatenate([np.stack([corners, corners], axis=1), patch.mesh.edges])
    return patch.vertices[ends[:, 0]] * 2**32 + patch.vertices[ends[:, 1]]
