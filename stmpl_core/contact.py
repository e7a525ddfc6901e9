"""Contact: a tool at one instant: where it is, and what it presses with, as one frozen record."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from stmpl_core.arrays import Transform, Wrench, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.tool import Tool


@dataclass(frozen=True, eq=False)
class Contact:
    """One tool at one instant.

    Args:
        tool: tool that touches.
        pose_body_from_tool: rigid transform, (4, 4), taking tool coordinates to the layer's frame.
        wrench: force [N] and torque about the tool's origin [N m] that the tool exerts *on the body*,
            in the layer's axes, (6,); None when there is no force sensor.
        time: instant [s], on any clock that all contacts share.

    Raises:
        InvalidInput: numbers that are not finite, or a pose that is not rigid.
    """

    tool: Tool
    pose_body_from_tool: Transform
    wrench: Wrench | None = None
    time: float = 0.0

    def __post_init__(self) -> None:
        pose = finite(f"pose of {self.name}", self.pose_body_from_tool, (4, 4)).copy()  # a caller goes on with its own
        rotation = pose[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
            raise InvalidInput(f"pose of {self.name} is not rigid: its rotation part is\n{rotation}.")
        object.__setattr__(self, "pose_body_from_tool", pose)
        if self.wrench is not None:
            object.__setattr__(self, "wrench", finite(f"wrench of {self.name}", self.wrench, (6,)).copy())

    @property
    def name(self) -> str:
        """Name of the tool."""
        return self.tool.name

    def scaled(self, by: float) -> Contact:
        """The same with a wrench so many times as large."""
        assert self.wrench is not None
        out = copy(self)
        object.__setattr__(out, "wrench", by * self.wrench)
        return out
