"""Simulator: contacts in, deformed skin out; the node, a replay and a test all call its `step`."""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np

from stmpl_core.conform import Conformed, conform
from stmpl_core.contact import Contact, ToolMesh
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import Method
from stmpl_core.sdf import MARGIN, SignedDistance
from stmpl_core.touch import Touch, Toucher
from stmpl_core.trust import Displacement, Trust

ENTERED = 0.02  # of the thickness: skin further inside a tool than this is said


class Simulator:
    """One layer, one method, any number of tools. The same contacts give the same answer, bit for bit.

    Args:
        layer: the soft layer at rest.
        method: how to solve; it is prepared here, unless
        prepared: it was prepared for this very layer before.

    Attributes:
        toucher: finds what the tools do to the skin.
    """

    def __init__(self, layer: SoftLayer, method: Method, *, prepared: bool = False) -> None:
        self.layer = layer
        self.method = method if prepared else method.prepare(layer)
        self.toucher = Toucher(layer)
        self._fields: WeakKeyDictionary[ToolMesh, SignedDistance] = WeakKeyDictionary()

    def prepare_tool(self, mesh: ToolMesh) -> SignedDistance:
        """The distance field of `mesh`, built on the first call (up to a second), kept as long as the mesh is.

        Raises:
            MeshError: a mesh that cannot be a tool (see SignedDistance.of).
        """
        if mesh not in self._fields:
            self._fields[mesh] = SignedDistance.of(mesh, margin=max(MARGIN, 2 * self.toucher.hole))
        return self._fields[mesh]

    def keep_field(self, mesh: ToolMesh, field: SignedDistance) -> None:
        """Takes a distance field of `mesh` that was built elsewhere, as `prepare_tool` would have built it."""
        self._fields[mesh] = field

    def step(self, contacts: Sequence[Contact]) -> Displacement:
        """The skin's displacement under `contacts`, with what was found of each.

        Raises:
            InvalidInput: two contacts of one name.
            MeshError: a tool's mesh that cannot be used.
        """
        names = [contact.name for contact in contacts]
        if len(set(names)) < len(names):
            raise InvalidInput(f"contacts must have names of their own; got {', '.join(names)}.")

        # Touch: each tool's mesh, pose and wrench become a pressure on the skin.
        fields = [self.prepare_tool(contact.mesh) for contact in contacts]
        touches = self.toucher.touch_all(contacts, fields)

        # Sum: pressures of several tools add.
        pressure = sum((touch.load.values for touch in touches), np.zeros(len(self.layer.vertices)))
        load = Load.contact(pressure)

        # Solve: the method moves the skin, and what is touched lies on its tool; where nothing presses, nothing moves.
        if load.values.any():
            answer = self.method.solve(load)
            fitted = conform(self.toucher.net.near, answer.displacement, touches, fields)
        else:
            answer = Displacement(np.zeros_like(self.layer.vertices), Trust(), self.method.name)
            fitted = Conformed(answer.displacement, 0.0, 0.0)

        # Say what may be believed: what the method says, and what was found of each contact.
        trust = _joined(answer.trust, dict(zip(names, touches, strict=True)), fitted)
        if fitted.entered > ENTERED * float(self.layer.thickness.min()):
            trust = trust.also(f"skin is {fitted.entered * 1e3:.2f} mm inside a tool", in_range=False)
        statuses = {name: touch.status for name, touch in zip(names, touches, strict=True)}
        wrenches = {name: touch.wrench for name, touch in zip(names, touches, strict=True)}
        return Displacement(fitted.displacement, trust, answer.method, load.values, statuses, wrenches)


def _joined(trust: Trust, touches: dict[str, Touch], fitted: Conformed) -> Trust:
    """The method's trust, lowered by that of the contacts; their figures carry their names.

    The method's error bound is for the pressure that it was given. How far that is from what the tools press with is
    not known, so it becomes a figure, and the answer states no bound.
    """
    figures = dict(trust.figures)
    if touches:
        figures |= {"conformed_m": fitted.corrected, "entered_m": fitted.entered}
    if touches and trust.error_bound is not None:
        figures["bound_given_pressure_m"] = trust.error_bound
    for name, touch in touches.items():
        figures |= {f"{name}.{figure}": value for figure, value in touch.trust.figures.items()}
        if touch.trust.why:
            trust = trust.also(touch.trust.why, in_range=touch.trust.in_range, converged=touch.trust.converged)
    return Trust(trust.converged, trust.in_range, None if touches else trust.error_bound, trust.why, figures)
