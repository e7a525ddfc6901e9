"""Snapshot: one instant as the page shows it; Gauge: how deep and how hard each tool presses in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from bags.frame import Frame
from stmpl_core.contact import Contact
from stmpl_core.layer import SoftLayer
from stmpl_core.touch import Answer, Touch
from stmpl_core.toucher import Toucher
from stmpl_core.trust import Displacement

MM, MS = 1e3, 1e3  # millimetres in a metre, milliseconds in a second
NAN = float("nan")


@dataclass(frozen=True)
class Reading:
    """Status, depth of the deepest point [m] (below 0: off the skin; NaN: far) and force [N] of one tool.

    And its friction, where it is told: the kind of slip, and the tangential force [N].
    """

    status: str
    depth: float = NAN
    force: float = 0.0
    slip: str = ""
    along: float = 0.0


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One instant, as the page shows it.

    Args:
        time: time since the run began [s].
        answer: displacement and pressure of the skin, with the trust in them.
        contacts: tools as they stood.
        readings: reading of each tool, by its name.
        solve_seconds: time that the answer took [s].
        latency: time from the contact to the answer [s]; NaN where it is not known.
        reference: answer of finite elements to the same tools, or None.
    """

    time: float
    answer: Answer
    contacts: tuple[Contact, ...] = ()
    readings: Mapping[str, Reading] = field(default_factory=dict)
    solve_seconds: float = NAN
    latency: float = NAN
    reference: Displacement | None = None

    @property
    def force(self) -> float:
        """Force of all tools together [N]."""
        return sum(reading.force for reading in self.readings.values())

    @property
    def depth(self) -> float:
        """Depth of the deepest tool [m]; 0 when none touches."""
        return max((r.depth for r in self.readings.values() if r.depth > 0), default=0.0)

    @property
    def peak(self) -> float:
        """Largest displacement [m]."""
        return float(self.answer.magnitude.max(initial=0.0))

    @property
    def error(self) -> np.ndarray | None:
        """Distance of each vertex from where finite elements put it, (V,) [m], or None."""
        if self.reference is None:
            return None
        return np.linalg.norm(self.answer.displacement - self.reference.displacement, axis=1)

    def judged_by(self, reference: Displacement) -> Snapshot:
        """The same instant with the answer of finite elements."""
        return replace(self, reference=reference)

    def rows(self) -> list[tuple[str, str]]:
        """The figures as a person reads them: name and value with unit."""
        rows = [("reaction force", f"{self.force:.3f} N"), ("depth", f"{self.depth * MM:.2f} mm"),
                ("peak displacement", f"{self.peak * MM:.2f} mm")]  # fmt: skip
        if len(self.readings) > 1:
            rows += [(name, f"{r.force:.3f} N, {max(r.depth, 0.0) * MM:.2f} mm") for name, r in self.readings.items()]
        rows += [(f"friction of {name}", f"{r.along:.3f} N, {r.slip}") for name, r in self.readings.items() if r.slip]
        rows += [("tool", ", ".join(f"{name}: {r.status}" for name, r in self.readings.items()) or "none")]
        rows += [("solved in", f"{self.solve_seconds * MS:.1f} ms")] if np.isfinite(self.solve_seconds) else []
        rows += [("contact to answer", f"{self.latency * MS:.1f} ms")] if np.isfinite(self.latency) else []
        rows += [("method", self.answer.method), ("trust", verdict(self))]
        bound = self.answer.trust.error_bound
        rows += [("error at most", f"{bound * MM:.2f} mm")] if bound is not None else []
        if self.error is not None and self.reference is not None:
            worst, peak = self.error.max(initial=0.0), self.reference.magnitude.max(initial=0.0)
            rows += [("error against FEM", f"at most {worst * MM:.3f} mm of {peak * MM:.2f} mm")]
        return rows + ([("why", self.answer.trust.why)] if self.answer.trust.why else [])


def joints_of(answer: Answer) -> tuple[float, ...]:
    """Angle of each joint of the layer's rig [rad] that an answer was given at; empty: at rest."""
    return answer.joints if isinstance(answer, Frame) else ()


def verdict(snapshot: Snapshot) -> str:
    """Whether the answer may be believed, in three words or so."""
    trust = snapshot.answer.trust
    if not trust.converged:
        return "not converged"
    return "inside the validated range" if trust.in_range else "outside the validated range"


class Gauge:
    """Reads depth and force of tools on a layer, as the simulator finds them."""

    def __init__(self, layer: SoftLayer) -> None:
        self._layer = layer

    @cached_property
    def _toucher(self) -> Toucher:
        """Made where it is asked for: a recording tells its touches, but for old ones."""
        return Toucher(self._layer)

    def read(self, contacts: Sequence[Contact]) -> dict[str, Reading]:
        """The reading of each contact by its name, joints at rest. Raises InvalidInput or MeshError."""
        return {touch.name: _reading(touch) for touch in self._toucher.touch_all(contacts)}


def readings_of(answer: Answer) -> dict[str, Reading]:
    """The reading of each tool that an answer names."""
    return {name: _reading(touch) for name, touch in answer.touches.items()}


def _reading(touch: Touch) -> Reading:
    if touch.slip is None:
        return Reading(touch.status, touch.depth, touch.force)
    along = float(np.linalg.norm(touch.slip.wrench[:3]))
    return Reading(touch.status, touch.depth, touch.force, touch.slip.kind, along)
