"""EnergyBook: the work that a tool does on the skin, step by step, and what of it comes back."""

from __future__ import annotations

import math

import numpy as np

from stmpl_core.arrays import Transform, Wrench


class EnergyBook:
    """Books the work of a contact's wrench along the tool's motion against the limb.

    A step exchanges F . (v + v') dt / 2 with a body that is integrated semi-implicitly, and moves it by v' dt: so the
    work of a wrench is booked over the mean of the motions before and after it. The sum is exact for the simulation,
    not only as the step goes to 0: what the skin gave out beyond what it took, the robot has.

    Attributes:
        held: work done on the skin so far [J].
        most: largest of that so far, what the skin has stored [J].
        lowest: lowest of that so far; below 0 the contact gave out what nobody put in [J].
    """

    def __init__(self) -> None:
        self.held = self.most = self.lowest = 0.0
        self._pose: Transform | None = None
        self._wrench = np.zeros(6)

    def add(self, pose_body_from_tool: Transform, wrench: Wrench) -> float:
        """Books one step; returns the work done on the skin so far [J].

        Args:
            pose_body_from_tool: pose of the tool, layer axes, (4, 4).
            wrench: wrench on the tool about its origin, layer axes, (6,).
        """
        if self._pose is not None:
            moved = pose_body_from_tool[:3, 3] - self._pose[:3, 3]
            turned = _turned(pose_body_from_tool[:3, :3] @ self._pose[:3, :3].T)
            mean = 0.5 * (self._wrench + wrench)  # this motion follows the last wrench and comes before this one
            self.held -= float(mean[:3] @ moved + mean[3:] @ turned)
        self._pose, self._wrench = pose_body_from_tool, wrench
        self.most, self.lowest = max(self.most, self.held), min(self.lowest, self.held)
        return self.held

    @property
    def gained(self) -> float:
        """Energy that came out and was not put in, over what was stored, after everything was let go [-]."""
        return -self.held / self.most if self.most > 0 else 0.0


def _turned(turn: np.ndarray) -> np.ndarray:
    """Rotation vector of a rotation by less than half a turn, (3,) [rad]."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = turn.tolist()
    axis = np.array([zy - yz, xz - zx, yx - xy])  # 2 sin(angle) along the axis
    size = float(np.linalg.norm(axis))
    angle = math.atan2(size, xx + yy + zz - 1)
    return axis * (angle / size if size > 1e-12 else 0.5)
