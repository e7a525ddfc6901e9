"""What the skin can be coloured by: values per vertex, colour scale, and the colour bar beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from matplotlib.colors import Colormap, ListedColormap, to_hex

from bags.pictures import DIFFERENCE, SKIN
from stmpl_core.arrays import PerVertex
from stmpl_ros.view.snapshot import Snapshot

STOPS = 256  # colours of a scale
MOVED = 0.02  # displacement over the peak, below which trust is drawn as at rest
STATES = ("at rest", "inside the validated range", "outside it", "not converged")
TRUSTED = ListedColormap(["#f2e4da", "#5aa469", "#e9a03b", "#b3261e"])


@dataclass(frozen=True, eq=False)
class Field:
    """A quantity by which the skin can be coloured.

    Args:
        name: name on the page.
        unit: unit of the numbers on the colour bar.
        factor: factor from SI to that unit.
        least: smallest end of the scale, in that unit.
        colours: colours from 0 to the end of the scale.
        values: function of a snapshot that gives each vertex's value, (V,) in SI units, or None if it has none.
        absent: sentence for a person then.
        states: names of the colours, where they stand for states and not for numbers.
    """

    name: str
    unit: str
    factor: float
    least: float
    colours: Colormap
    values: Callable[[Snapshot], PerVertex | None]
    absent: str = ""
    states: tuple[str, ...] = ()

    @cached_property
    def palette(self) -> np.ndarray:
        """The scale as (STOPS, 4) uint8, decoded from sRGB (IEC 61966-2-1)."""
        s = np.asarray(self.colours(np.linspace(0, 1, STOPS)))
        s[:, :3] = np.where(s[:, :3] <= 0.04045, s[:, :3] / 12.92, ((s[:, :3] + 0.055) / 1.055) ** 2.4)
        return np.round(255 * s).astype(np.uint8)

    def top(self, snapshot: Snapshot) -> float:
        """End of the scale that suits a snapshot, in the field's unit: 1, 2 or 5 times a power of ten."""
        values = self.values(snapshot)
        if self.states:
            return len(self.states) - 1.0
        return self.least if values is None else max(round_up(float(values.max(initial=0.0)) * self.factor), self.least)

    def paint(self, snapshot: Snapshot, top: float) -> np.ndarray:
        """Colours of the vertices on a scale from 0 to `top`, (V, 4) uint8, linear as glTF wants them."""
        values = self.values(snapshot)
        if values is None:
            values = np.zeros(len(snapshot.answer.displacement))
        steps = np.clip(values * (self.factor * (STOPS - 1) / top), 0, STOPS - 1)
        return self.palette[steps.astype(np.int64)]

    def bar(self, top: float) -> str:
        """The colour bar with its numbers, or the names of the states, as HTML."""
        if self.states:
            marks = [
                f'<div><span style="display:inline-block;width:1em;height:1em;margin-right:.5em;vertical-align:-.15em;'
                f'border:1px solid #999;background:{to_hex(self.colours(k))}"></span>{state}</div>'
                for k, state in enumerate(self.states)
            ]
            return f'<div style="padding:.2em .8em;font-size:.85em">{"".join(marks)}</div>'
        stops = ", ".join(to_hex(self.colours(share)) for share in np.linspace(0, 1, 9))
        numbers = "".join(f"<span>{share * top:.3g}</span>" for share in (0, 0.25, 0.5, 0.75, 1))
        return (
            f'<div style="padding:.2em .8em;font-size:.85em">{self.name} [{self.unit}]'
            f'<div style="height:1em;border:1px solid #999;background:linear-gradient(to right, {stops})"></div>'
            f'<div style="display:flex;justify-content:space-between">{numbers}</div></div>'
        )


def round_up(value: float) -> float:
    """The least of 1, 2, 5 times a power of ten that is not below `value`; 0 for 0."""
    if value <= 0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next((m * power for m in (1, 2, 5) if m * power >= value * (1 - 1e-9)), 10 * power))


def _trust(snapshot: Snapshot) -> PerVertex:
    """State of each vertex, (V,): at rest, or that of the answer as a whole."""
    trust, moved = snapshot.answer.trust, snapshot.answer.magnitude
    state = 3 if not trust.converged else 1 if trust.in_range else 2
    return np.where(moved > MOVED * max(moved.max(initial=0.0), 1e-9), state, 0).astype(np.float64)


FIELDS = {field.name: field for field in (
    Field("displacement", "mm", 1e3, 0.1, SKIN, lambda snapshot: snapshot.answer.magnitude),
    Field("pressure", "kPa", 1e-3, 0.01, SKIN, lambda snapshot: snapshot.answer.pressure,
          "This answer does not say the pressure that it was solved for."),
    Field("error against FEM", "mm", 1e3, 0.01, DIFFERENCE, lambda snapshot: snapshot.error,
          "FEM has not solved this instant. Press **FEM of this instant**."),
    Field("trust", "", 1.0, 3.0, TRUSTED, _trust, states=STATES),
)}  # fmt: skip
