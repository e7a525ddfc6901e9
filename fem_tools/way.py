"""Way: where tools are along a press or a stroke, how long its steps are, and the patch that it asks for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from fem_tools.press import MAX_FACES_ENTERED, Press, above_core, edge_for_curvature, edge_for_first_contact
from fem_tools.stroke import Stroke, checked_strokes, gap_at_rest
from stmpl_core.arrays import finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer

SPREAD = 0.15  # way that skin is pushed aside before it is touched [thicknesses]
SPREAD_OVER_DEPTH = 0.5  # the same over the depth, at most [-]
DRAGGED = 2.0  # way that skin is dragged along before it slips, over mu and the depth; 1.4 by Mindlin's law at nu 0.45
STRETCHED = 1.5  # by how much friction stretches what trails behind, over mu squared: faces grow by as much [-]
SAMPLES = 48  # places of a stroke at which it says how fine the mesh shall be, at most
SMALLEST_STEP = 1 / 8, 1 / 64  # share of its step that a press, and a stroke, goes down to where Newton fails


class Way(Protocol):
    """Tools along a way; `place` says where: the depth of a press [m], or the number of a stroke's pose.

    Attributes:
        footprint: numbers of the layer's vertices that the tools cover somewhere.
        thickness: smallest thickness of the layer there [m].
        deepest: how deep the tools go [m].
        allowed: depth of faces in a tool that an answer may have [m].
        smallest: share of a step below which it is not halved [-].
        timed: whether its places have times.
    """

    footprint: np.ndarray
    thickness: float
    deepest: float
    allowed: float
    smallest: float
    timed: bool

    def tools(self, place: float) -> list[Press]:
        """The tools at a place."""
        ...

    def next(self, place: float, target: float, step: float) -> float:
        """The place after a step of at most `step` [m] towards a target."""
        ...

    def time(self, place: float) -> float:
        """The time at a place [s]; 0 where the way has none."""
        ...

    def depth(self, place: float) -> float:
        """How deep the tools are in the skin at rest [m]."""
        ...

    def edge_length(self, points: np.ndarray) -> np.ndarray:
        """See fem_tools.patch.EdgeLength."""
        ...


class PressWay:
    """Tools that go along their directions together, from where each first touches: a Way; a place is the depth [m].

    Args:
        layer: soft layer.
        tools: tools anywhere along their ways.
        depths: depths that will be asked for, increasing, > 0 [m].
        times: times at those depths, increasing, > 0 [s]; the way begins at 0. None: no time.

    Raises:
        InvalidInput: no tools, depths or times that do not increase, a tool that never meets the skin, or one whose way
            ends in the core.
    """

    def __init__(self, layer: SoftLayer, tools: Sequence[Press], depths: np.ndarray,
                 times: Sequence[float] | np.ndarray | None = None) -> None:  # fmt: skip
        if not len(tools):
            raise InvalidInput("there is no tool to press with.")
        if not len(depths) or depths[0] <= 0 or (np.diff(depths) <= 0).any():
            raise InvalidInput(f"depths must be above 0 and increase; got {depths}.")
        self._times, self.timed = None, times is not None
        if times is not None:
            self._times = np.concatenate([[0.0], increasing(times, len(depths))])
            if not self._times[1] > 0:
                raise InvalidInput(f"the first depth has the time {self._times[1]:g} s; it must be above 0.")
        self._depths = np.concatenate([[0.0], depths])
        self._tools: list[Press] = []
        for number, tool in enumerate(tools):
            if (touching := tool.touching(layer)) is None:
                raise InvalidInput(f"tool {number} never meets the skin along its way {tool.direction}.")
            self._tools.append(touching)
        self.deepest = deepest = float(depths[-1])
        self.footprint, clearances = above_core(layer, self.tools(deepest))
        for number, clear in enumerate(clearances):
            if clear <= 0:
                thin = float(layer.thickness[self.footprint].min())
                raise InvalidInput(
                    f"tool {number} would be {-clear * 1e3:.2f} mm inside the core at {deepest * 1e3:.2f} mm; "
                    f"the layer is {thin * 1e3:.2f} mm thick there. Press less deep.")  # fmt: skip
        self.thickness = float(layer.thickness[self.footprint].min())
        self.allowed = MAX_FACES_ENTERED * self.thickness
        self.smallest = SMALLEST_STEP[0]

    def tools(self, place: float) -> list[Press]:
        """See Way."""
        return [tool.at(place) for tool in self._tools]

    def next(self, place: float, target: float, step: float) -> float:
        """See Way."""
        return place + float(np.clip(target - place, -step, step))

    def time(self, place: float) -> float:
        """See Way."""
        return 0.0 if self._times is None else float(np.interp(place, self._depths, self._times))

    def depth(self, place: float) -> float:
        """See Way."""
        return place

    def edge_length(self, points: np.ndarray) -> np.ndarray:
        """See fem_tools.patch.EdgeLength."""
        shallow, deep = float(self._depths[1]), [self.deepest * share for share in np.linspace(0.15, 1, 6)]
        wanted = [
            edge_for_curvature(tool.at(depth).shifted(aside), points, self.thickness)
            for tool in self._tools
            for depth in deep
            for aside in tool.sideways(SPREAD * self.thickness)
        ]
        wanted += [edge_for_first_contact(tool.at(shallow), points, shallow) for tool in self._tools]
        return np.min(wanted, axis=0)


class StrokeWay:
    """Tools that go through poses together: a Way; a place is the number of a pose, or lies between two.

    The patch is one for the whole path: everything that the tools sweep is meshed as fine as they ask, and what they
    drag along too.

    Args:
        layer: soft layer.
        strokes: tools with as many poses each.
        times: times of the poses, increasing [s]; None: no time.
        friction: Coulomb's coefficient, by which skin is dragged [-].

    Raises:
        InvalidInput: see `checked_strokes`; times that do not increase, tools that never touch the skin, or that would
            be inside the core.
    """

    def __init__(self, layer: SoftLayer, strokes: Sequence[Stroke], times: Sequence[float] | np.ndarray | None = None,
                 friction: float = 0.0) -> None:  # fmt: skip
        count = checked_strokes(strokes, layer)
        self._strokes, self._layer = list(strokes), layer
        self._times, self.timed = None if times is None else increasing(times, count), times is not None
        self._lengths = np.max([stroke.lengths() for stroke in strokes], axis=0)
        spacing = max(float(self._lengths.sum()) / SAMPLES, 1e-6)
        self._samples = [press for stroke in strokes for press in stroke.sampled(spacing)]
        deep = [-gap_at_rest(press, layer) for press in self._samples]
        self.deepest = max(deep)
        if not self.deepest > 0:
            raise InvalidInput(f"the tools never touch the skin on their path: they pass {-1e3 * self.deepest:.2f} mm "
                               "above it.")  # fmt: skip
        inside = [press for press, depth in zip(self._samples, deep, strict=True) if depth > 0]
        covered, clearances = zip(*(above_core(layer, [press]) for press in inside), strict=True)
        if (clear := min(c for (c,) in clearances)) <= 0:
            raise InvalidInput(f"a tool would be {-clear * 1e3:.2f} mm inside the core on its path. Press less deep.")
        self.footprint = np.unique(np.concatenate(covered))
        self.thickness = float(layer.thickness[self.footprint].min())
        self.allowed = MAX_FACES_ENTERED * self.thickness
        self.smallest = SMALLEST_STEP[1]
        self._fine = min(self.deepest, self.thickness) / (1 + STRETCHED * min(friction, 1.5) ** 2)
        self._drag = min(DRAGGED * min(friction, 1.5) * self.deepest, self.thickness)

    def tools(self, place: float) -> list[Press]:
        """See Way."""
        return [stroke.at(place) for stroke in self._strokes]

    def next(self, place: float, target: float, step: float) -> float:
        """See Way; never beyond the next pose."""
        k = int(np.floor(place + 1e-9))
        end = min(float(k + 1), target)
        many = np.ceil((end - place) * self._lengths[k] / step - 1e-6)
        return end if many <= 1 else place + (end - place) / many

    def time(self, place: float) -> float:
        """See Way."""
        return 0.0 if self._times is None else float(np.interp(place, np.arange(len(self._times)), self._times))

    def depth(self, place: float) -> float:
        """See Way."""
        return max(0.0, *(-gap_at_rest(tool, self._layer) for tool in self.tools(place)))

    def edge_length(self, points: np.ndarray) -> np.ndarray:
        """See fem_tools.patch.EdgeLength."""
        wanted = np.full(len(points), np.inf)
        for stroke in self._strokes:
            presses = stroke.sampled(max(float(self._lengths.sum()) / SAMPLES, 1e-6))
            for before, press in zip([presses[0], *presses[:-1]], presses, strict=True):
                way = (press.pose_body_from_tool - before.pose_body_from_tool)[:3, 3]
                way -= (way @ press.direction) * press.direction
                length = float(np.linalg.norm(way))
                shifts = list(press.sideways(min(SPREAD * self.thickness, SPREAD_OVER_DEPTH * self.deepest)))
                if length > 0:
                    shifts += [-share * self._drag * way / length for share in (0.5, 1.0)]
                for aside in shifts:
                    wanted = np.minimum(wanted, edge_for_curvature(press.shifted(aside), points, self._fine))
        return wanted


def increasing(times: Sequence[float] | np.ndarray, count: int) -> np.ndarray:
    """Times as an array, (count,) [s].

    Raises:
        InvalidInput: another number of times, or some that do not increase.
    """
    array = finite("times", times, (None,))
    if len(array) != count:
        raise InvalidInput(f"there are {len(array)} times for {count} places; each needs one.")
    if (np.diff(array) <= 0).any():
        raise InvalidInput("times must increase along a path.")
    return array
