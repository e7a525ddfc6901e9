"""Dragged: how the skin around a tool moves when what sticks to the tool is dragged along with it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stmpl_core.arrays import VertexVectors
from stmpl_core.green import Green, add_motion, tables
from stmpl_core.layer import SoftLayer
from stmpl_core.moments import Surroundings
from stmpl_core.nodes import Nodes
from stmpl_core.touch import Touch

MIN_OFFSET = 1e-6  # way of skin along a tool that is not worth an answer [m]


class Flat(NamedTuple):
    """Response of a layer of one material to forces along it, as if it were flat.

    Args:
        layer: soft layer at rest.
        near: neighbours of its vertices.
        thickness: thickness of the flat layer [m].
        tables: see stmpl_core.green.tables.
    """

    layer: SoftLayer
    near: Surroundings
    thickness: float
    tables: np.ndarray

    @classmethod
    def of(cls, layer: SoftLayer, near: Surroundings) -> Flat:
        """The response of a layer, made in a second."""
        thickness = float(np.median(layer.thickness))
        return cls(layer, near, thickness, tables(layer.tissue, thickness))

    def stuck(self, nodes: Nodes, group: np.ndarray, gone: np.ndarray) -> np.ndarray:
        """See Green.stuck: here an even traction, as large as moves the nodes by as much on the average."""
        forces, there = nodes.area[:, None] * gone, np.zeros_like(gone)
        add_motion(there, np.arange(len(gone)), nodes.points, nodes.inward, nodes.points, nodes.inward, nodes.area,
                   forces, self.thickness, self.tables)  # fmt: skip
        return forces * float(np.sum(there * gone) / max(np.sum(there * there), 1e-300))

    def motion(self, nodes: Nodes, forces: np.ndarray) -> VertexVectors:
        """See Green.motion."""
        layer, out = self.layer, np.zeros_like(self.layer.vertices)
        asked = self.near.asked(np.unique(nodes.corners))
        by = np.zeros((len(asked.vertices), 3))
        there = self.near.reached_among(np.unique(nodes.corners), asked.vertices, alone=True)
        add_motion(by, there, layer.vertices[asked.vertices], -layer.normals[asked.vertices], nodes.points,
                   nodes.inward, nodes.area, forces, self.thickness, self.tables)  # fmt: skip
        asked.fill(by, out)
        return out


def dragged_motion(green: Green | Flat, touch: Touch) -> VertexVectors | None:
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
