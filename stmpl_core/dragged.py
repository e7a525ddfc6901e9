"""Dragged: how the skin around a tool moves when what sticks to the tool is dragged along with it."""

from __future__ import annotations

import numpy as np

from stmpl_core.arrays import Points, VertexVectors
from stmpl_core.green import Green
from stmpl_core.nodes import Nodes
from stmpl_core.touch import Pressed, Slip, Touch

MIN_OFFSET = 1e-6  # way of skin along a tool that is not worth an answer [m]


def dragged_motion(green: Green, touch: Touch) -> VertexVectors | None:
    """Motion that comes to the skin where a touch drags what sticks to it along, (V, 3) [m]; None: it does not.

    What presses goes and turns as one by the part of the way that is of skin that sticks, and as its friction drags it
    by the part that is of skin that slides, in the linear response; both add to the motion under the same tool pressed
    straight, where the skin came from.

    Args:
        green: response of the layer.
        touch: touch with its friction.
    """
    slip, pressed = touch.slip, touch.pressed
    if slip is None or pressed is None or pressed.forces is None:
        return None
    nodes, pressing = _holding(pressed), pressed.forces[pressed.forces > 0]
    ways, slides = (_ways(touch, slip, nodes, *part) for part in
                    ((slip.offset, slip.turn), (slip.slid_offset, slip.slid_turn)))  # fmt: skip
    sticks: Points | None = ways - slides
    if np.abs(sticks).max() <= MIN_OFFSET:
        if np.abs(ways).max() <= MIN_OFFSET:
            return None
        sticks, slides = None, ways
    forces = green.rubbed(nodes, green.near.groups(nodes.corners[:, 0]), sticks, slides, pressing)
    return green.motion(nodes, forces, dragged=True)


def ways_along(touch: Touch) -> Points | None:
    """Ways by which skin that presses is dragged along and turned, (N, 3) [m]; None: it stays."""
    slip, pressed = touch.slip, touch.pressed
    if slip is None or pressed is None or pressed.forces is None:
        return None
    ways = _ways(touch, slip, _holding(pressed), slip.offset, slip.turn)
    return ways if np.abs(ways).max() > MIN_OFFSET else None


def _ways(touch: Touch, slip: Slip, nodes: Nodes, offset: np.ndarray, turn: float) -> Points:
    """Ways of nodes that go by an offset and turn about the contact's middle, (N, 3) [m]."""
    return offset + turn * np.cross(touch.push / touch.force, nodes.points - slip.middle)


def _holding(pressed: Pressed) -> Nodes:
    """The nodes that press."""
    assert pressed.forces is not None
    return pressed.squeeze.nodes.some(pressed.forces > 0)
