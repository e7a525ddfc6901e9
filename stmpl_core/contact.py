"""Contact: a tool at one instant: where it is, and what it presses with, as one frozen record."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numba

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
        if not _rigid(rotation):
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


@numba.njit(cache=True, nogil=True)
def _rigid(rotation):
    """Whether a matrix (3, 3) is a rotation, to 1e-4; numpy's own calls take ten times as long."""
    for i in range(3):
        for j in range(3):
            product = -1.0 if i == j else 0.0
            for x in range(3):
                product += rotation[i, x] * rotation[j, x]
            if not abs(product) <= 1e-4:
                return False
    a, b, c = rotation[0], rotation[1], rotation[2]
    det = (a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0])
           + a[2] * (b[0] * c[1] - b[1] * c[0]))  # fmt: skip
    return det >= 0
