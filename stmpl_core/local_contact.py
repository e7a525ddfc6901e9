"""LocalContact: a linear model of a contact, which holds between two answers.

A node answers some 100 times a second; a hand feels what changes a thousand times a second. So each answer carries a
LocalContact (reaction, stiffness, how far it holds), and a DeviceLoop beside the device renders it in between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stmpl_core.arrays import Transform, Wrench, finite
from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput
from stmpl_core.touch import Touch
from stmpl_core.toucher import Toucher
from stmpl_core.trust import Trust

STEP = 1e-4  # width of the central differences [m]: far above the skin's finest kinks, far below a contact's depth
AGREEMENT = 0.1  # error of the linear model over the wrench, inside its neighbourhood
SMALLEST = 0.01  # reaction as which smaller ones are judged [N]: a hand does not feel 10 % of it
WIDEST = 2e-3  # largest neighbourhood that is looked for [m]
SHRINK = 0.9  # factor on the radius until the model agrees at the rim
FADE = 0.1  # normal force over the reaction, below which drag and torque fade with it


class Rendered(NamedTuple):
    """Wrench of a local model at a pose, and whether the model holds there."""

    wrench: Wrench
    inside: bool


@dataclass(frozen=True, eq=False)
class LocalContact:
    """The reaction of one contact around a pose, to first order.

    Args:
        pose_body_from_tool: pose at which it was found, (4, 4).
        wrench: force [N] and torque about the tool's origin [N m] that the tool exerts on the body, layer axes, (6,).
        stiffness: d wrench / d twist, (6, 6) [N/m, N/rad; N m/m, N m/rad]; the twist is (translation of the tool's
            origin, rotation vector) in layer axes.
        valid_m: translation up to which the model is within 10 % of the reaction, as seen at its rim [m].
        valid_rad: rotation up to which it is [rad].
        status: status of the touch at the pose.
        trust: trust in the touch at the pose; its figures count the model's touches as `evaluations`.
    """

    pose_body_from_tool: Transform
    wrench: Wrench
    stiffness: np.ndarray
    valid_m: float
    valid_rad: float
    status: str
    trust: Trust

    @property
    def normal(self) -> np.ndarray:
        """Direction in which the tool presses, (3,) [-]; zeros when it does not."""
        size = np.linalg.norm(self.wrench[:3])
        return self.wrench[:3] / size if size > 0 else np.zeros(3)

    def wrench_at(self, pose_body_from_tool: ArrayLike) -> Rendered:
        """Wrench (6,) at another pose, extrapolated and never pulling: no force against `normal`.

        As the normal force falls below a tenth of `wrench`, drag and torque fade with it, so that all end together.

        Raises:
            InvalidInput: a pose that is not finite.
        """
        pose = finite("pose", pose_body_from_tool, (4, 4))
        twist = _twist(self.pose_body_from_tool, pose)
        wrench = self.wrench + self.stiffness @ twist
        normal, size = self.normal, float(np.linalg.norm(self.wrench[:3]))
        pressing = float(normal @ wrench[:3])
        if pressing <= 0:
            wrench = np.zeros(6)
        else:
            fade = min(1.0, pressing / (FADE * size))
            wrench[:3] = pressing * normal + fade * (wrench[:3] - pressing * normal)
            wrench[3:] *= fade
        move, turn = float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))
        return Rendered(wrench, move <= self.valid_m and turn <= self.valid_rad)


def local_contact(toucher: Toucher, contact: Contact, *, step: float = STEP, rotations: bool = True) -> LocalContact:
    """Finds the local model at the contact's pose; a wrench of the contact is not used.

    The stiffness is found by central differences along the normal, two tangents, and about them. What these say of the
    curvature proposes how far the model may hold; then the reaction is found at that rim, six ways, and the rim drawn
    in until all agree. 25 touches when the first rim agrees, 13 without rotations.

    Args:
        toucher: contact law on the layer.
        contact: tool and pose.
        step: width of the differences [m]; rotations move the tool's farthest corner by as much.
        rotations: derivatives by rotations too; a device that feels forces only needs none.
            Without, the stiffness to rotations and valid_rad are 0.

    Raises:
        InvalidInput: a step that is not above 0.
    """
    if not (math.isfinite(step) and step > 0):
        raise InvalidInput(f"step is {step} m; it must be finite and above 0. Try {STEP:g}.")
    probe, field = _Probe(toucher, contact), toucher.tools.field(contact.tool)
    touch, wrench = probe.touch(np.zeros(6))
    frame = _frame(wrench[:3])
    lever = float(np.linalg.norm(np.maximum(*np.abs(field.tool_bounds))))
    allowed = AGREEMENT * max(float(np.linalg.norm(wrench[:3])), SMALLEST)
    stiffness, valid = np.zeros((6, 6)), [0.0, 0.0]
    for block, arm in enumerate((1.0, lever)[: 1 + rotations]):  # translations, then rotations
        axes = np.zeros((3, 6))
        axes[:, 3 * block : 3 * block + 3] = frame.T
        radius, least = WIDEST / arm, step / arm
        if wrench.any():
            columns, bend = probe.differences(wrench, axes, step / arm, lever)
            stiffness[:, 3 * block : 3 * block + 3] = columns @ frame.T
            radius = min(radius, math.sqrt(2 * allowed / bend) if bend > 0 else radius)
        while radius > least:
            off = probe.disagreement(wrench, stiffness, axes, radius, lever)
            if off <= allowed:
                break
            radius *= max(SHRINK * math.sqrt(allowed / off), 0.25)  # what is left out grows like the square
        valid[block] = radius
    trust = replace(touch.trust, figures={**touch.trust.figures, "evaluations": float(probe.count)})
    return LocalContact(contact.pose_body_from_tool, wrench, stiffness, valid[0], valid[1], touch.status, trust)


class _Probe:
    """The contact's reaction at poses around its own."""

    def __init__(self, toucher: Toucher, contact: Contact) -> None:
        self.toucher, self.contact, self.count = toucher, contact, 0

    def touch(self, twist: np.ndarray) -> tuple[Touch, Wrench]:
        """The touch, by pose alone, after a twist (6,), and the wrench that the tool then exerts."""
        self.count += 1
        pose = _moved(self.contact.pose_body_from_tool, twist)
        touch = self.toucher.touch(replace(self.contact, pose_body_from_tool=pose, wrench=None))
        return touch, touch.wrench

    def differences(self, middle: Wrench, axes: np.ndarray, step: float, lever: float) -> tuple[np.ndarray, float]:
        """Derivative of the wrench along each axis, (6, 3), and its largest second derivative, judged as a force."""
        columns, bend = np.empty((6, 3)), 0.0
        for k, axis in enumerate(axes):
            ahead, behind = (self.touch(sign * step * axis)[1] for sign in (1, -1))
            columns[:, k] = (ahead - behind) / (2 * step)
            bend = max(bend, _as_force(ahead - 2 * middle + behind, lever) / step**2)
        return columns, bend

    def disagreement(self, wrench: Wrench, stiffness: np.ndarray, axes: np.ndarray, radius: float,
                     lever: float) -> float:
        """Largest difference between model and reaction at a rim, judged as a force [N]."""
        twists = [sign * radius * axis for axis in axes for sign in (1, -1)]
        return max(_as_force(self.touch(t)[1] - wrench - stiffness @ t, lever) for t in twists)


def _moved(pose: Transform, twist: np.ndarray) -> Transform:
    """The pose after a twist of the tool about its own origin, in layer axes."""
    moved = pose.copy()
    moved[:3, 3] += twist[:3]
    if twist[3:].any():
        moved[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix() @ pose[:3, :3]
    return moved


def _twist(start: Transform, end: Transform) -> np.ndarray:
    """The twist (6,) that takes one pose to the other."""
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    return np.concatenate([end[:3, 3] - start[:3, 3], turn])


def _frame(force: np.ndarray) -> np.ndarray:
    """Orthonormal axes as columns, (3, 3), the first along `force`."""
    if not force.any():
        return np.eye(3)
    first = force / np.linalg.norm(force)
    second = np.cross(first, np.eye(3)[np.abs(first).argmin()])
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _as_force(wrench: np.ndarray, lever: float) -> float:
    """The larger of a wrench's force and of its torque over the tool's reach [N]."""
    return max(float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:])) / lever)
