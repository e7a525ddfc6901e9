"""FewSteps: finite elements cut off after some Newton steps, started from a cheaper method's answer."""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np

from fem_tools.newton import NewtonSettings, System, newton
from fem_tools.patch import (
    Patch,
    PatchFem,
    away_from_border,
    discretisation_error,
    error_bound,
    truncation_error,
    validated,
)
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods import Method, MomentNet
from stmpl_core.methods.base import prepared
from stmpl_core.trust import Displacement, Trust

FORCING = 0.01  # of the linear solver: a step that is solved loosely is worse than the network that it starts from
SETTLED = 3  # passes that let the inside of each column follow its skin before the first step
DAMPING = 0.7  # of these
CLOSE = 0.1  # residual over load below which the answer counts as converged: it is then within 3 % where it moves
LOST = 0.5  # residual over load from which what was started from is the better answer
KEPT = 1.0  # thicknesses that a load may move before the patch is meshed anew


class FewSteps:
    """A few full Newton steps of PatchFem on the layer's own mesh: one, from the network, leaves a third of its error.

    The patch is kept while the load stays within a thickness of where it was meshed for.

    Args:
        steps: number of Newton steps.
        start: method whose answer is started from; fem_tools.WarmPatchFem starts from the answer before.
        reach: width of the patch beyond the load [thicknesses].

    Raises:
        InvalidInput: fewer than one step.
    """

    def __init__(self, steps: int, start: Method, *, reach: float = 5.0) -> None:
        if steps < 1:
            raise InvalidInput(f"steps is {steps}; at least 1 is needed.")
        self.steps, self.start = steps, start
        self.fem = PatchFem(reach=reach, check_stability=False)
        self.settings = NewtonSettings(max_iterations=steps, forcing=FORCING)
        self.name = f"fem, {steps} step{'s' * (steps > 1)} from {start.name}"
        self._layer: SoftLayer | None = None
        self._patch: Patch | None = None

    @classmethod
    def from_network(cls, steps: int = 1) -> Self:
        """Started from MomentNet."""
        return cls(steps, MomentNet())

    def prepare(self, layer: SoftLayer) -> Self:
        """Prepares the finite elements and the method that is started from."""
        self.fem.prepare(layer)
        self.start.prepare(layer)
        self._layer, self._patch = layer, None
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`; not converged while the residual is above CLOSE.

        The bound is PatchFem's, and as much of the peak as is not in balance.

        Raises:
            NotPrepared: before `prepare`.
            InvalidInput: the load does not fit the layer.
        """
        layer = prepared(self._layer, self)
        pressure = load.check(layer).pressure_on(layer)
        if not len(load.loaded):
            zero = np.zeros_like(layer.vertices)
            return Displacement(zero, Trust(error_bound=0.0, why="no load"), self.name, pressure)
        patch = self._patch_for(load.loaded)
        system = self.fem.system(patch, load)
        before = self.start.solve(load)
        result = newton(system, self._start(patch, system, before), 1.0, self.settings)
        answer = np.zeros_like(layer.vertices)
        answer[patch.vertices] = result.u[: len(patch.vertices), 0]
        if not result.residual < LOST:
            answer = before.displacement
        ratio = load.peak_ratio(layer)
        discretisation, truncation = discretisation_error(system, result.u), truncation_error(patch, result.u)
        bound = error_bound(discretisation, truncation, result.u, patch.mesh.layers, ratio)
        bound += result.residual * float(np.linalg.norm(result.u[:, 0], axis=1).max())
        figures = {"residual": result.residual, "min_j": result.min_j, "peak_ratio": ratio}
        trust = Trust(error_bound=bound if load.kind != "contact" else None, figures=figures)
        if result.residual > CLOSE:
            why = f"after {result.iterations} Newton steps {result.residual:.0%} of the load is not in balance"
            trust = trust.also(why, converged=False)
        trust = away_from_border(validated(trust, load, ratio), patch, layer, load.loaded)
        return Displacement(answer, trust if trust.ok else replace(trust, error_bound=None), self.name, pressure)

    def _patch_for(self, loaded: np.ndarray) -> Patch:
        layer = prepared(self._layer, self)
        if self._patch is None or self._patch.farthest(loaded) > KEPT * layer.thickness[loaded].max():
            self._patch = self.fem.patch_around(loaded)
        return self._patch

    def _start(self, patch: Patch, system: System, before: Displacement) -> np.ndarray:
        """Where Newton starts, (C, levels, 3) [m]."""
        mesh = patch.mesh
        skin = before.displacement[patch.vertices]
        depth = mesh.depths()[:, :, None]
        u = mesh.on_columns(skin)[:, None] * (1 - depth)
        u[system.fixed] = 0.0
        return settled(system, u)


def settled(system: System, u: np.ndarray) -> np.ndarray:
    """The same skin, the levels below it in balance: block Jacobi on each column's own stiffness, damped."""
    u = u.copy()
    inner = None
    for _ in range(SETTLED):
        residual, least = system.residual(u, 1.0)
        if not least > 0:  # folded: Newton will start from rest
            return u
        if inner is None:
            blocks = system.tangent(u, 1.0)[system.diagonal][:, 3:, 3:]
            inner = np.linalg.inv(blocks)
        change = -DAMPING * np.einsum("cij,cj->ci", inner, residual[:, 3:]).reshape(len(u), -1, 3)
        change[system.fixed] = 0.0
        u[:, 1 : 1 + change.shape[1]] += change
    return u

