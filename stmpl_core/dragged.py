"""Dragged: how the skin around a tool moves when what sticks to the tool is dragged along with it."""

from __future__ import annotations

import numpy as np

from stmpl_core.arrays import VertexVectors
from stmpl_core.green import Green
from stmpl_core.nodes import Nodes
from stmpl_core.touch import Touch

MIN_OFFSET = 1e-6  # way of skin along a tool that is not worth an answer [m]


def dragged_motion(green: Green, touch: Touch) -> VertexVectors | None:
    """Motion that comes to the skin where a touch drags what sticks to it along, (V, 3) [m]; None: it does not.

    The part of the contact that presses goes and turns as one, in the linear response; it adds to the motion under the
    same tool pressed straight, where the skin came from.

    Args:
        green: response of the layer.
        touch: touch with its friction.
    """
    slip, pressed = touch.slip, touch.pressed
    if slip is None or pressed is None or pressed.forces is None or np.linalg.norm(slip.offset) <= MIN_OFFSET:
        return None
    holds = np.flatnonzero(pressed.forces > 0)
    nodes = Nodes(*(values[holds] for values in pressed.squeeze.nodes if len(values)))
    normal = touch.push / touch.force
    gone = slip.offset + slip.turn * np.cross(normal, nodes.points - slip.middle)
    return green.motion(nodes, green.stuck(nodes, green.near.groups(nodes.corners[:, 0]), gone))
