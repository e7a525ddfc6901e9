"""Dragged: how the skin around a tool moves when what sticks to the tool is dragged along with it."""

from __future__ import annotations

import numpy as np

from stmpl_core.arrays import Points, VertexVectors
from stmpl_core.green import Green
from stmpl_core.nodes import Nodes
from stmpl_core.touch import Pressed, Touch

MIN_OFFSET = 1e-6  # way of skin along a tool that is not worth an answer [m]


def dragged_motion(green: Green, touch: Touch) -> VertexVectors | None:
    """Motion that comes to the skin where a touch drags what sticks to it along, (V, 3) [m]; None: it does not.

    The part of the contact that presses goes and turns as one where it sticks, and as its friction drags it where it
    slides, in the linear response; it adds to the motion under the same tool pressed straight, where the skin came
    from.

    Args:
        green: response of the layer.
        touch: touch with its friction.
    """
    ways, pressed, slip = ways_along(touch), touch.pressed, touch.slip
    if ways is None or pressed is None or pressed.forces is None or slip is None:
        return None
    nodes, pressing = _holding(pressed), pressed.forces[pressed.forces > 0]
    forces = green.rubbed(nodes, green.near.groups(nodes.corners[:, 0]), ways, pressing, slip.share)
    return green.motion(nodes, forces, dragged=True)


def ways_along(touch: Touch) -> Points | None:
    """Ways by which skin that presses is dragged along and turned, (N, 3) [m]; None: it stays."""
    slip, pressed = touch.slip, touch.pressed
    if slip is None or pressed is None or pressed.forces is None:
        return None
    arms = _holding(pressed).points - slip.middle
    ways = slip.offset + slip.turn * np.cross(touch.push / touch.force, arms)
    return ways if np.abs(ways).max() > MIN_OFFSET else None


def _holding(pressed: Pressed) -> Nodes:
    """The nodes that press."""
    assert pressed.forces is not None
    return pressed.squeeze.nodes.some(pressed.forces > 0)
