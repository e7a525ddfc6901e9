"""Contact: a tool at one instant: where it is, and what it presses with, as one frozen record."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import Transform, Wrench, check_kind, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.tool import Tool

MOST = 1e100  # largest number of a pose or a wrench that is counted, and the least one's inverse: squares are, too


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
        InvalidInput: numbers that are not finite or beyond MOST, or a pose that is not rigid.
    """

    tool: Tool
    pose_body_from_tool: Transform
    wrench: Wrench | None = None
    time: float = 0.0

    def __post_init__(self) -> None:
        check_kind("the tool of a contact", self.tool, Tool)
        pose = rigid(f"pose of {self.name}", self.pose_body_from_tool).copy()  # a caller goes on with its own
        object.__setattr__(self, "pose_body_from_tool", pose)
        if self.wrench is not None:
            wrench = counted(f"wrench of {self.name}", self.wrench, (6,)).copy()
            wrench[np.abs(wrench) < 1 / MOST] = 0.0
            object.__setattr__(self, "wrench", wrench)

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


def rigid(what: str, pose: ArrayLike) -> Transform:
    """A pose as an array (4, 4), if it is one.

    Raises:
        InvalidInput: numbers that are not finite or beyond MOST, or a pose that is not rigid.
    """
    if type(pose) is np.ndarray and pose.dtype == np.float64 and pose.shape == (4, 4) and pose.flags.c_contiguous \
            and _rigid(pose):  # fmt: skip
        return pose
    array = counted(what, pose, (4, 4))
    if not _rigid(array):
        raise InvalidInput(f"{what} is not rigid: it is {np.round(array, 6).tolist()}.")
    return array


def counted(what: str, values: ArrayLike, shape: tuple[int, ...], most: float = MOST) -> np.ndarray:
    """Numbers as an array of a shape. Raises InvalidInput where one is not finite, or beyond the most."""
    array = finite(what, values, shape)
    if _beyond(array.ravel(), most):
        raise InvalidInput(f"{what} holds a number beyond {most:g}.")
    return array


@numba.njit(cache=True, nogil=True)
def _beyond(values, most):
    """Whether one of the numbers is beyond the most; as `_rigid`, far sooner done than by numpy's own calls."""
    for value in values:
        if abs(value) > most:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _rigid(pose):
    """Whether a matrix (4, 4) turns and moves, to 1e-4; numpy's own calls take ten times as long."""
    for x in range(4):
        if not abs(pose[3, x] - (1.0 if x == 3 else 0.0)) <= 1e-4 or not abs(pose[x, 3]) <= MOST:
            return False
    for i in range(3):
        for j in range(3):
            product = -1.0 if i == j else 0.0
            for x in range(3):
                product += pose[i, x] * pose[j, x]
            if not abs(product) <= 1e-4:
                return False
    a, b, c = pose[0], pose[1], pose[2]
    det = (a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0])
           + a[2] * (b[0] * c[1] - b[1] * c[0]))  # fmt: skip
    return det >= 0
