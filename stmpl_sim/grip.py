"""Grip: two fingers on a gantry that squeeze a limb beside the massage, lift it, and lay it down again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction
from stmpl_sim.engine import mujoco
from stmpl_sim.site import Site

FINGERS = ("left_finger", "right_finger")  # names of their geoms, and of the tools
CARRIAGE = "gripper_lift"  # name of the joint that lifts
USUAL_N = 10.0  # force of each finger on a forearm [N]: half as much again as holds it, hinged at the elbow
SURFACE = "glove"  # friction of the fingers on skin, unless somebody says another

PAD_RADIUS, PAD_LENGTH = 0.020, 0.03  # of a finger's pad: a capsule along the limb, its straight part [m]
AWAY = 0.07  # distance of the fingers from the massage, along the limb to its thinner end [m]
BELOW = 0.010  # height of the fingers under the limb's widest part: skin gives way before friction holds [m]
GAP = 0.008  # distance of an open finger from the skin [m]
WIDEST = 0.12  # limb that the fingers reach around [m]
END = 0.02  # piece of a limb that is its end [m]
HALF_SLICE = 4e-3  # half length of the limb's piece whose outline is taken there [m]
FINGER_MASS, ARMATURE = 0.1, 0.4  # of a finger and of its drive [kg]
OPENING = 400.0, 20.0  # spring to where a finger is open, and damping of its drive [N/m], [N s/m]
LIFTING = 2e4, 800.0  # gain of the lift [N/m], and damping of its drive [N s/m]
LIFT_M = 0.03  # way by which the limb is lifted [m]
PHASES = {"grip": 0.7, "lift": 0.7, "hold": 0.5, "lower": 0.7, "open": 0.4}  # and their durations [s]


class Place(NamedTuple):
    """Where a limb is gripped: middle, (3,) world axes [m]; its width there [m]; which way along y from the site."""

    middle: np.ndarray
    width: float
    side: float


def usual_force(part: str) -> float:
    """Force with which a part of the body is gripped unless somebody says another, 0: not at all [N]."""
    return USUAL_N if part.endswith("forearm") else 0.0


def mount_of(mount: str, grip: float) -> Any:
    """Mount of a limb; "auto": on a rest where it is gripped, else fixed. Raises InvalidInput: one cannot be lifted."""
    if mount == "fixed" and grip:
        raise InvalidInput("a limb that is fixed cannot be lifted. Put it on a rest (--mount rest), or do not grip it "
                           "(--grip 0).")  # fmt: skip
    return ("rest" if grip else "fixed") if mount == "auto" else mount


def with_fingers(friction: Friction | Mapping[str, Friction], tool: str) -> dict[str, Friction]:
    """Friction by the tool's name: what was said, and SURFACE for fingers of which nothing was said by name."""
    found: dict[str, Friction] = dict.fromkeys(FINGERS, SURFACE)
    found.update(friction if isinstance(friction, Mapping) else {tool: friction})
    return found


def thin_end(site: Site) -> float:
    """Which end of a limb is thinner, 1 or -1 along site.along: that is gripped, and the other is its hinge."""
    along = (site.layer.vertices - site.point) @ site.along
    across = (site.layer.vertices - site.point) @ np.cross(site.along, site.normal)
    widths = [float(np.ptp(across[sign * along > (sign * along).max() - END])) for sign in (1, -1)]
    return 1.0 if widths[0] <= widths[1] else -1.0


def place_of(site: Site, pose_world_from_limb: np.ndarray) -> Place:
    """Where to grip: AWAY from the site towards the limb's thinner end, somewhat under its widest part.

    Raises:
        InvalidInput: a limb that ends before, or that is too wide.
    """
    points = site.layer.vertices @ pose_world_from_limb[:3, :3].T + pose_world_from_limb[:3, 3]
    origin = pose_world_from_limb[:3, :3] @ site.point + pose_world_from_limb[:3, 3]
    side = thin_end(site)
    there = points[np.abs(points[:, 1] - origin[1] - side * AWAY) < HALF_SLICE]
    if len(there) <= 8:
        raise InvalidInput(f"the limb ends within {1e3 * AWAY:.0f} mm of the massage: there is no room to grip it.")
    low, high = there[there[:, 0].argmin()], there[there[:, 0].argmax()]
    width = float(high[0] - low[0])
    if width > WIDEST:
        raise InvalidInput(f"the limb is {1e3 * width:.0f} mm wide where it would be gripped; the fingers reach around "
                           f"{1e3 * WIDEST:.0f} mm. Take a forearm, or do not grip (--grip 0).")  # fmt: skip
    middle = 0.5 * (low + high)
    return Place(np.array([middle[0], origin[1] + side * AWAY, middle[2] - BELOW]), width, side)


def add_gripper(spec: Any, place: Place) -> None:
    """Adds the gantry, its fingers open, to a MjSpec: slides, motors, shapes that collide with nothing."""
    off = {"contype": 0, "conaffinity": 0}
    steel, dark = [0.55, 0.58, 0.62, 1], [0.25, 0.27, 0.30, 1]
    reach, top = 0.5 * place.width + GAP + PAD_RADIUS, 0.11
    box, capsule = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    carriage = spec.worldbody.add_body(name="gripper", pos=place.middle, gravcomp=1.0)
    _own(carriage.add_joint(name=CARRIAGE, type=slide, axis=[0, 0, 1])).damping = np.resize(LIFTING[1], 3)
    carriage.add_geom(type=box, size=[reach + 0.03, 0.012, 0.012], pos=[0, 0, top], mass=1.0, rgba=dark, **off)
    half = 0.5 * (place.middle[2] + top + LIFT_M)
    spec.worldbody.add_geom(type=box, size=[0.008, 0.008, half], rgba=steel, mass=0.0, **off,
                            pos=[place.middle[0] - reach - 0.04, place.middle[1], half])  # fmt: skip
    for name, way in zip(FINGERS, (1.0, -1.0), strict=True):  # the left one closes to the right
        finger = carriage.add_body(name=name, pos=[-way * reach, 0, 0], gravcomp=1.0)
        joint = _own(finger.add_joint(name=name, type=slide, axis=[way, 0, 0]))
        joint.damping, joint.armature = np.resize(OPENING[1], 3), ARMATURE
        half = 0.5 * PAD_LENGTH
        finger.add_geom(name=name, type=capsule, fromto=[0, -half, 0, 0, half, 0], size=[PAD_RADIUS, 0, 0],
                        mass=FINGER_MASS, rgba=[0.16, 0.38, 0.54, 1], **off)  # fmt: skip
        finger.add_geom(type=capsule, fromto=[0, 0, 0, 0, 0, top], size=[0.006, 0, 0], mass=0.0, rgba=steel, **off)
    for name in (*FINGERS, CARRIAGE):
        motor = spec.add_actuator(name=name, target=name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.set_to_motor()


def _own(joint: Any) -> Any:
    """A joint without what a robot's defaults say of its own."""
    joint.stiffness = joint.damping = np.zeros(3)
    joint.springref = joint.armature = joint.frictionloss = 0.0
    joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    return joint


class Gripper:
    """Drives the fingers by force, and the lift along its course.

    Args:
        model: MuJoCo model with a gripper.
        force: force that each finger is to squeeze with [N].

    Attributes:
        joints: numbers of the joints: both fingers, and the lift.
    """

    def __init__(self, model: Any, force: float) -> None:
        self.force = force
        self._motors = [model.actuator(name).id for name in (*FINGERS, CARRIAGE)]
        self.joints = [int(model.joint(name).id) for name in (*FINGERS, CARRIAGE)]
        self._places = model.jnt_qposadr[self.joints]

    def command(self, data: Any, phase: str, share: float) -> None:
        """Writes the motors' forces into `data.ctrl`.

        Args:
            data: MuJoCo data.
            phase: name of the phase of the course; one that is not of PHASES leaves the fingers open.
            share: share of the phase that has passed [-].
        """
        q = data.qpos[self._places]
        closed = {"grip": smooth(share), "lift": 1.0, "hold": 1.0, "lower": 1.0, "open": 1 - smooth(2 * share)}
        squeeze = closed.get(phase, 0.0)
        data.ctrl[self._motors[:2]] = squeeze * self.force - (1 - squeeze) * OPENING[0] * q[:2]
        height, rate = lifted(phase, share)
        data.ctrl[self._motors[2]] = LIFTING[0] * (height - q[2]) + LIFTING[1] * rate


def lifted(phase: str, share: float) -> tuple[float, float]:
    """Height that the limb is to be lifted by [m], and its rate [m/s]."""
    if phase == "hold":
        return LIFT_M, 0.0
    if phase not in ("lift", "lower"):
        return 0.0, 0.0
    rate = LIFT_M * 6 * share * (1 - share) / PHASES[phase]
    return (LIFT_M * smooth(share), rate) if phase == "lift" else (LIFT_M * smooth(1 - share), -rate)


def smooth(share: float) -> float:
    """From 0 to 1, at rest at both."""
    share = min(max(share, 0.0), 1.0)
    return share * share * (3 - 2 * share)
