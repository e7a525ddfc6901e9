"""IndenterFem: rigid tools pressed into the soft layer, or led through poses, in node-to-surface contact."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from fem_tools.newton import MAX_WORK
from fem_tools.patch import PatchFem
from fem_tools.press import Press, above_core
from fem_tools.relaxation import Fading
from fem_tools.stroke import Stroke
from fem_tools.tool_contact import Friction
from fem_tools.walk import Indentation, Walk
from stmpl_core.arrays import finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.base import prepared

INDENTER_LAYERS = 2  # wedges through the thickness: one is 5 % off in force and 10 % in pressure, two 0.7 % in both


class IndenterFem:
    """Presses rigid tools into a soft layer, or leads them over it.

    Args:
        fem: solver that meshes the patch; None: two wedges deep, up to three refinements where the tool's
            curvature asks.
        friction: law of friction: "stick" (a touching point stays where it touched, until it is let go), "none", or
            Coulomb's coefficient (fem_tools.tool_contact).
        step: longest step of the tools [thicknesses]; what touches first within a step sticks from its end on, under
            Coulomb's law from its middle.
        fading: stress that a material with a Prony series loses in time: "stress", all of it, or "shear", that of mu.
        max_work: multiplications after which a press or a path stops, whatever it has reached (see NewtonSettings).
    """

    def __init__(self, fem: PatchFem | None = None, *, friction: Friction = "stick", step: float = 0.04,
                 max_work: float = MAX_WORK, fading: Fading = "stress") -> None:  # fmt: skip
        if not (friction in ("stick", "none") or (isinstance(friction, int | float) and 0 <= friction < 10)):
            raise InvalidInput(f'friction is {friction!r}; allowed are "stick", "none" or a coefficient in [0, 10).')
        self.fem = fem or PatchFem(refine=3, layers=INDENTER_LAYERS)
        if not 0 < step <= 0.5:
            raise InvalidInput(f"step is {step} thicknesses; allowed is 0 < step <= 0.5.")
        self.friction: Friction = friction
        if not max_work > 0:
            raise InvalidInput(f"max_work is {max_work}; it must be above 0 multiplications.")
        self.step, self.max_work = step, max_work
        self.fading: Fading = fading
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """See PatchFem.prepare. A tool near a fold of the layer is refused when it is pressed (MeshError)."""
        self.fem.prepare(layer)
        self._layer = layer
        return self

    def path(self, tools: Sequence[Press], depths: Sequence[float] | np.ndarray, *,
             times: Sequence[float] | np.ndarray | None = None) -> Iterator[Indentation]:  # fmt: skip
        """Presses all tools together, and gives an answer at each depth beyond first touch.

        Args:
            tools: tools anywhere along their ways; each is first brought to where it just touches.
            depths: depths beyond first touch, increasing, > 0 [m].
            times: times at the depths, increasing, > 0, counted from first touch [s]; None: no time.

        Yields:
            One Indentation a depth. After a step that fails the last believed one is flagged, and the path ends.

        Raises:
            InvalidInput: no tools, depths or times that do not increase, a tool that never meets the skin, or one whose
                way ends in the core.
        """
        walk = Walk(self, prepared(self._layer, self), tools, finite("depths", depths, (None,)), times)
        for depth in depths:
            answer = walk.to(float(depth))
            yield answer
            if not answer.trust.converged:
                return

    def follow(self, strokes: Sequence[Stroke], *,
               times: Sequence[float] | np.ndarray | None = None) -> Iterator[Indentation]:  # fmt: skip
        """Leads all tools together through their poses, and gives an answer at each.

        Between poses they go in steps of at most `step`, shorter where Newton fails. What sticks, creeps and slips is
        carried along.

        Args:
            strokes: tools, each with as many poses as the others.
            times: times of the poses, increasing [s]; None: no time.

        Yields:
            One Indentation a pose, the first included. After a step that fails the last believed one is flagged, and
            the path ends.

        Raises:
            InvalidInput: no tools, unequal numbers of poses or times, times that do not increase, a first pose in the
                skin, tools that never touch it, or that would be inside the core.
        """
        walk = Walk(self, prepared(self._layer, self), strokes, None, times)
        for place in range(len(strokes[0].poses)):
            answer = walk.to(float(place))
            yield answer
            if not answer.trust.converged:
                return

    def press(self, tools: Sequence[Press], depth: float) -> Indentation:
        """The answer at one depth [m]. See `path`."""
        return list(self.path(tools, [depth]))[-1]

    def press_with(self, tools: Sequence[Press], force: float, *, deepest: float | None = None,
                   tolerance: float = 1e-3) -> Indentation:  # fmt: skip
        """The answer where the tools' forces along their ways sum to `force` [N].

        Args:
            tools: tools, see `path`.
            force: force that is wanted, > 0 [N].
            deepest: depth at which to give up [m]; None: 0.9 of the layer's smallest thickness, or of what lies
                below the tools where the layer has a core.
            tolerance: relative error of the force that is allowed [-].

        Raises:
            InvalidInput: as `path`, or a force that is not above 0.
        """
        layer = prepared(self._layer, self)
        if not (np.isfinite(force) and force > 0):
            raise InvalidInput(f"the force is {force} N; it must be finite and above 0.")
        limit = deepest or 0.9 * self._least_below(layer, tools)
        walk = Walk(self, layer, tools, np.array([limit]))
        below, above = (0.0, 0.0, walk.state), None  # depth, force, state
        while above is None:
            depth = min(below[0] + self.step * walk.thickness, limit)
            if not walk.walk(depth):
                return walk.answer()
            if walk.force() >= force:
                above = (depth, walk.force())
            elif depth >= limit:
                answer = walk.answer()
                why = f"{answer.force:.3g} N at the deepest allowed {limit * 1e3:.2f} mm; {force:.3g} N was asked"
                return replace(answer, trust=answer.trust.also(why, in_range=False))
            else:
                below = (depth, walk.force(), walk.state)
        for _ in range(20):  # regula falsi, always from the state below, so that the path stays the same
            depth = below[0] + (force - below[1]) / (above[1] - below[1]) * (above[0] - below[0])
            walk.state = below[2]
            if not walk.walk(depth) or abs(walk.force() - force) <= tolerance * force:
                break
            above = (depth, walk.force()) if walk.force() > force else above
            below = below if walk.force() > force else (depth, walk.force(), walk.state)
        else:
            walk.stopped = f"the force is {walk.force():.4g} N after 20 trials; {force:.4g} N was asked"
        return walk.answer()

    @staticmethod
    def _least_below(layer: SoftLayer, tools: Sequence[Press]) -> float:
        """Thickness that tools may go through [m]."""
        if layer.core is None:
            return float(layer.thickness.min())
        touching = [there for tool in tools if (there := tool.touching(layer)) is not None]
        return max(float(np.min(above_core(layer, touching)[1])), 1e-6) if touching else float(layer.thickness.min())
