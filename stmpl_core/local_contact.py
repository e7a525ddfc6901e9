"""LocalContact: a linear model of a contact, which holds between two answers.

A node answers some 100 times a second; a hand feels what changes a thousand times a second. So each answer carries a
LocalContact (reaction, stiffness, how far it holds), and a DeviceLoop beside the device renders it in between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import Transform, Wrench, finite
from stmpl_core.contact import MOST, Contact, rigid
from stmpl_core.errors import InvalidInput
from stmpl_core.footing import in_plane, leaned, patch_of, twist_between
from stmpl_core.history import History
from stmpl_core.layer import MAX_THICKNESS
from stmpl_core.state import Memory, State
from stmpl_core.tangent import Tangent, tangents
from stmpl_core.touch import APART, Pressed, Touch
from stmpl_core.toucher import STIFFENING, Toucher
from stmpl_core.trust import Trust

AGREEMENT = 0.1  # error of the linear model over the wrench, inside its neighbourhood
WIDEST = 2e-3  # largest neighbourhood [m]
SAFETY = 0.8  # of the neighbourhood that a power law of the depth allows: measured rims are at 0.8 to 1.2 of it
LEAST_POWER = 1.1  # power of the depth with which the force grows, below which it is not trusted to be straight
MOST_POWER = 2.5  # and above which not either
DEEPER = 4e-3  # way deeper than the model, or as much as it is deep, beyond which no force grows [m]
LARGEST, HIGHEST = 1e15, 10.0  # number of a model, and power, beyond which it is refused: no contact has such ones
STEEPEST = 1e12  # way that a model follows its power of the depth for, over its own depth
FADE = 0.1  # normal force over the reaction, below which a DeviceLoop lets drag fade with it


class Rendered(NamedTuple):
    """What a local model says of a pose.

    Args:
        wrench: wrench that the tool exerts on the body about its origin, (6,) [N, N m].
        inside: truth of the claim that the model holds there.
        stored: energy that the contact would give back if the tool retreated at once [J].
    """

    wrench: Wrench
    inside: bool
    stored: float = 0.0


class Grip(NamedTuple):
    """Friction of a contact to first order: a patch that sticks as a spring does, up to a cone.

    Args:
        axes: ways along the skin (two tangents, and the lever times the turn about the normal) that a twist of the tool
            amounts to, (3, 6); their transpose takes forces to a wrench about the tool's origin.
        forces: friction along these ways, (3,) [N].
        stiffness: stiffness of the patch that sticks, (3,) [N/m].
        limit: size of the forces at which all slides, over the normal force [-]; mu, raised by ploughing.
    """

    axes: np.ndarray
    forces: np.ndarray
    stiffness: np.ndarray
    limit: float

    @property
    def wrench(self) -> Wrench:
        """Wrench of the friction at the model's pose, (6,) [N, N m]."""
        return self.axes.T @ self.forces

    def carried(self, twist: np.ndarray, pressing: float) -> np.ndarray:
        """Friction along the ways after a twist (6,), never more than the limit of a normal force [N], (3,) [N]."""
        forces = self.forces + self.stiffness * (self.axes @ twist)
        size, most = float(np.linalg.norm(forces)), self.limit * max(pressing, 0.0)
        return forces * (most / size if size > most else 1.0)


@dataclass(frozen=True, eq=False)
class LocalContact:
    """The reaction of one contact around a pose, to first order.

    Args:
        pose_body_from_tool: pose at which it was found, (4, 4).
        wrench: force [N] and torque about the tool's origin [N m] that the tool exerts on the body, layer axes, (6,).
        stiffness: d wrench / d twist, (6, 6) [N/m, N/rad; N m/m, N m/rad]; the twist is (translation of the tool's
            origin, rotation vector) in layer axes; other tools stay. With friction, as it sticks.
        valid_m: translation up to which the model is within 10 % of the reaction, argued from the force's power of the
            depth and the contact's size [m].
        valid_rad: rotation up to which it is [rad]. Parts of a tool that do not touch yet are not known.
        status: status of the touch at the pose.
        trust: trust in the touch at the pose.
        grip: friction, part of wrench and stiffness; None: none.
        power: power of the depth with which the elastic force grows, from 1; 1: not told, a straight line.
        eased: part of the elastic force that has relaxed [N].
    """

    pose_body_from_tool: Transform
    wrench: Wrench
    stiffness: np.ndarray
    valid_m: float
    valid_rad: float
    status: str
    trust: Trust
    grip: Grip | None = None
    power: float = 1.0
    eased: float = 0.0

    def check(self) -> None:
        """Does nothing if the model can be rendered.

        Raises:
            InvalidInput: numbers that are not finite or beyond LARGEST, a pose that is not rigid, a power outside
                1..HIGHEST, negative `valid_m`, `valid_rad`, `eased` or limit of the friction, or a patch that sticks
                without stiffness.
        """
        rigid("the local model's pose", self.pose_body_from_tool)
        arrays = [("wrench", self.wrench, (6,)), ("stiffness", self.stiffness, (6, 6))]
        ranges = [("valid_m", self.valid_m, 0.0, LARGEST), ("valid_rad", self.valid_rad, 0.0, LARGEST),
                  ("eased", self.eased, 0.0, LARGEST), ("power", self.power, 1.0, HIGHEST)]  # fmt: skip
        if self.grip is not None:
            for name, shape in (("axes", (3, 6)), ("forces", (3,)), ("stiffness", (3,))):
                arrays.append((f"friction's {name}", getattr(self.grip, name), shape))
            ranges.append(("friction's limit", self.grip.limit, 0.0, LARGEST))
            ranges.append(("friction's least stiffness", min(self.grip.stiffness), 1 / LARGEST, LARGEST))
        for name, values, shape in arrays:
            if (size := float(np.abs(finite(f"the local model's {name}", values, shape)).max())) > LARGEST:
                raise InvalidInput(f"the local model's {name} holds {size:g}; at most {LARGEST:g} is accepted.")
        for name, value, least, most in ranges:
            if not least <= value <= most:
                raise InvalidInput(f"the local model's {name} is {value}; it must be from {least:g} to {most:g}.")

    @property
    def renderable(self) -> bool:
        """Whether the model can be rendered; `check` says why not."""
        try:
            self.check()
        except InvalidInput:
            return False
        return True

    @property
    def push(self) -> Wrench:
        """Wrench that the tool presses with, friction left out, (6,) [N, N m]."""
        return self.wrench if self.grip is None else self.wrench - self.grip.wrench

    @property
    def push_stiffness(self) -> np.ndarray:
        """Stiffness of what presses, friction left out, (6, 6)."""
        if self.grip is None:
            return self.stiffness
        return self.stiffness - (self.grip.axes.T * self.grip.stiffness) @ self.grip.axes

    @property
    def normal(self) -> np.ndarray:
        """Direction in which the tool presses, (3,) [-]; zeros when it does not."""
        push = self.push[:3]
        size = np.linalg.norm(push)
        return push / size if size > 0 else np.zeros(3)

    def wrench_at(self, pose_body_from_tool: ArrayLike) -> Rendered:
        """Wrench (6,) at another pose, extrapolated; never pulling, and bounded.

        With g the growth of the normal force N by stiffness and twist, A what has relaxed and m the power,

            N' = max((N + A) (1 + g / (m (N + A)))^m - A, 0),    W' = N' / N (W + K twist - g / N W)

        so that models of one press lie on one curve, however late they come, and all ends together. Sideways the twist
        counts up to the neighbourhood's rim, inwards up to DEEPER; beyond nothing grows. Friction never exceeds its
        cone.

        Raises:
            InvalidInput: a pose that is not finite.
        """
        pose = finite("pose", pose_body_from_tool, (4, 4))
        twist = twist_between(self.pose_body_from_tool, pose)
        move, turn = float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))
        inside = move <= self.valid_m and turn <= self.valid_rad
        push, normal, stiffness = self.push, self.normal, self.push_stiffness
        size = float(np.linalg.norm(push[:3]))
        if size < 1 / MOST:
            return Rendered(np.zeros(6), inside)
        elastic, m = size + self.eased, self.power
        along = float(normal @ stiffness[:3, :3] @ normal)
        depth = min(m * elastic / along, MAX_THICKNESS) if along > 0 else WIDEST
        most = min(max(1.0, DEEPER / depth), STEEPEST)
        base = 1 + min(float(normal @ stiffness[:3] @ twist) / (m * elastic), most)
        free = (self.eased / elastic) ** (1 / m)  # base at which the tool lets go
        if base <= free:
            return Rendered(np.zeros(6), inside)
        pressing = elastic * base**m - self.eased
        stored = elastic * (base ** (m + 1) - free ** (m + 1)) / (m + 1) - self.eased * (base - free)
        stored *= depth
        near = twist.copy()
        near[:3] *= self.valid_m / move if move > self.valid_m else 1.0
        near[3:] *= self.valid_rad / turn if turn > self.valid_rad else 1.0
        turned = stiffness @ near
        turned -= float(normal @ turned[:3]) / size * push
        wrench = pressing / size * (push + turned)
        if self.grip is not None:
            forces = self.grip.carried(twist, pressing)
            wrench += self.grip.axes.T @ forces
            stored += 0.5 * float((forces**2 / self.grip.stiffness).sum())
        return Rendered(wrench, inside, stored)


def local_contact(toucher: Toucher, contact: Contact) -> LocalContact:
    """Finds the local model of one contact alone at its pose; a wrench of the contact is not used.

    Args:
        toucher: contact law on the layer.
        contact: tool and pose.
    """
    touch = toucher.touch(replace(contact, wrench=None))
    return _model(toucher, touch, tangents(toucher, [touch])[0], None)


def local_contacts(history: History, touches: Sequence[Touch], state: State | None = None) -> list[LocalContact]:
    """Local models of touches, from what the touches know: no further touch is asked for.

    With a state the models are those of the instant: elastic skin presses harder at once, what has relaxed stays
    relaxed, and what sticks is as stiff as the patch, whatever of it creeps.

    Args:
        history: history of the simulator that found the touches, `simulator.history`.
        touches: touches of one instant, by pose or by wrench; the models are about the poses that are answered for.
        state: state that came with the touches; None: elastic touches without friction.
    """
    memories, toucher = {} if state is None else state.tools, history.toucher
    return [_model(toucher, touch, tangent, memories.get(touch.name))
            for touch, tangent in zip(touches, tangents(toucher, touches), strict=True)]  # fmt: skip


def _model(toucher: Toucher, touch: Touch, tangent: Tangent | None, memory: Memory | None) -> LocalContact:
    """The model of a touch."""
    pressed = touch.pressed
    if tangent is None or pressed is None or pressed.forces is None:
        reach = 0.0 if touch.status != APART else WIDEST if not touch.depth < 0 else min(WIDEST, -touch.depth)
        tool = toucher.tools.field(toucher.tools[touch.name]).tool_bounds if touch.name in toucher.tools else None
        lever = float("inf") if tool is None else float(np.linalg.norm(np.maximum(*np.abs(tool))))
        return LocalContact(touch.pose_body_from_tool, touch.wrench, np.zeros((6, 6)), reach, reach / lever,
                            touch.status, touch.trust)  # fmt: skip
    push = touch.wrench if touch.slip is None else touch.wrench - touch.slip.wrench
    normal, nodes = push[:3] / touch.force, pressed.squeeze.nodes
    stiffness, drawn, eased, along = tangent.stiffness, pressed.factor, 0.0, np.append(normal, np.zeros(3))
    whole = float(pressed.forces.sum())
    contact = patch_of(nodes.points, nodes.area, nodes.thickness, nodes.depths, pressed.forces, normal)
    if memory is not None and memory.scalars.pressing > 0:  # W = W_e - lambda A, and A stays
        now = memory.scalars
        grown = touch.passive * (1.0 if touch.slip is None else touch.slip.grown)
        by = min(whole / (now.elastic * now.stretch * grown), 1.0)
        stiffness = stiffness + (1 / by - 1) * np.outer(push / whole, tangent.whole)
        eased = (1 / by - 1) * touch.force
        stiffness = stiffness + (1 / by - 1) / (now.stretch * contact[3]) * np.outer(push, along)
        drawn /= by * grown
    lacks = (touch.force + eased) / touch.depth - float(normal @ stiffness[:3, :3] @ normal) if touch.depth > 0 else 0.0
    if lacks > 0:  # a sliver of contact in another tool's dent: what came from nothing rises by no less than that
        stiffness = stiffness + lacks * np.outer(push / touch.force, along)
    if drawn > 1 + 1e-9:  # the tool was drawn back along the normal to where it is answered for: see Toucher
        rise = push / drawn * STIFFENING / float(toucher.layer.thickness.max())
        stiffness = stiffness + np.outer(rise - stiffness @ along, along)
    steep = float(normal @ stiffness[:3, :3] @ normal) * touch.depth  # power of the depth times force
    valid = _neighbourhood(touch, pressed, max(steep / touch.force, pressed.power, LEAST_POWER), *contact[:2])
    power = 1.0 if drawn > 1 + 1e-9 else min(max(steep / (touch.force + eased), 1.0), MOST_POWER)
    grip = None
    if touch.slip is not None and memory is not None:
        grip = _grip(touch, memory, contact[2])
        stiffness = stiffness + (grip.axes.T * grip.stiffness) @ grip.axes
        flat, arm = np.eye(3) - np.outer(normal, normal), memory.contact[0] - touch.pose_body_from_tool[:3, 3]
        ways = np.hstack([flat, np.cross(arm, flat)])
        sticks = (1 - touch.slip.share) * touch.force  # what sticks takes the way that it faces along
        stiffness = stiffness + ways.T @ (sticks * toucher.curvature(nodes, pressed.forces)) @ ways
    return LocalContact(touch.pose_body_from_tool, touch.wrench, stiffness, *valid, touch.status, touch.trust, grip,
                        power, eased)  # fmt: skip


def _neighbourhood(touch: Touch, pressed: Pressed, power: float, middle: np.ndarray, radius: float
                   ) -> tuple[float, float]:  # fmt: skip
    """How far a model holds [m] and [rad].

    Along the normal F = c d^m leaves out m (m - 1) (x / d)^2 / 2 of F. Sideways the depth changes by x^2 d / a^2 at
    most, a ball's on a plane being half of that, so m (x / a)^2 / 2 is left out. A turn moves the contact's rim so, and
    a tip far ahead of the origin: that of a tool as round as its contact, a^2 / d, only by what is beyond its centre.
    """
    deep = SAFETY * touch.depth * (2 * AGREEMENT / (power * (power - 1))) ** 0.5
    reach = min(deep, radius * (2 * AGREEMENT / power) ** 0.5, WIDEST)
    assert pressed.forces is not None
    far = _arms(pressed.squeeze.nodes.points, pressed.forces, middle, touch.pose_body_from_tool[:3, 3], touch.push,
                radius**2 / max(touch.depth, 1e-9))  # fmt: skip
    return reach, reach / far


@numba.njit(cache=True, error_model="numpy")
def _arms(points, forces, middle, origin, push, rounded):
    """How far the rim of a contact is from its middle, and that from the axis of the push through the origin [m].

    And by how much more than the radius to which its tool is rounded it is ahead of the origin along the push.
    """
    rim = off = along = square = 0.0
    for n in range(len(points)):
        if forces[n] > 0:
            rim = max(rim, np.sum((points[n] - middle) ** 2))
    for x in range(3):
        off += (middle[x] - origin[x]) ** 2
        along += (middle[x] - origin[x]) * push[x]
        square += push[x] ** 2
    ahead = max(along / np.sqrt(square) - rounded, 0.0)
    return np.sqrt(rim) + np.sqrt(max(off - along * along / square, 0.0)) + ahead


def _grip(touch: Touch, memory: Memory, lever: float) -> Grip:
    """Friction of a touch."""
    assert touch.slip is not None
    contact = leaned(memory.contact, touch.slip.lean / math.sqrt(touch.force**2 - touch.slip.lean @ touch.slip.lean))
    middle, normal, first = contact
    arm, second = middle - touch.pose_body_from_tool[:3, 3], np.cross(normal, first)
    axes = np.array([[*first, *np.cross(arm, first)], [*second, *np.cross(arm, second)], [0, 0, 0, *(lever * normal)]])
    forces = in_plane(touch.slip.wrench, contact, touch.pose_body_from_tool[:3, 3].copy(), lever)
    return Grip(axes, forces, memory.stiffness, memory.scalars.limit / touch.force)
