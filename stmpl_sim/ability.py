"""What an arm is able to do where it starts: its axes, links that touch each other, how hard it can press."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from stmpl_sim.engine import mujoco

AXES = 5  # of a place and a direction to point in; to spin about it is of no use to a ball
LEANS = 1.0  # angle off straight down from which it is said [degrees]
AT_LIMIT = 0.01  # of a joint's range, within which it is at a limit
MOST_AT_LIMIT = 0.5  # part of a run at one, from which it is said
MOST_NAMED = 4  # pairs of links that are named
LONGEST = 10.0  # length of a robot's links beyond which its file is taken to be in millimetres [m]
PULLED = 1e-3  # violation of an equality constraint from which it is said [m, rad]
log = logging.getLogger(__name__)


def start_notes(model: Any, joints: tuple[int, ...], qpos: np.ndarray, tool: str) -> tuple[str, ...]:
    """What will take a tool off its course or its direction, one sentence each; each is a warning of the log, too.

    Args:
        model: MuJoCo model.
        joints: numbers of the arm's joints.
        qpos: start, (nq,).
        tool: name of the geom whose z axis is to point down.
    """
    data, found = mujoco.MjData(model), []
    if (long := length_of(model, tool)) > LONGEST:
        found.append(f"the robot's links are {long:.3g} m long in all; is its file in millimetres?")
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    if len(joints) < AXES:
        lean = np.rad2deg(np.arccos(np.clip(-data.geom_xmat[model.geom(tool).id, 8], -1, 1)))
        off = f", {lean:.0f} degrees off straight down at the start" if lean > LEANS else ""
        found.append(f"the robot has {len(joints)} axes; a place and a direction need {AXES}: the tool keeps its "
                     f"place, and points as well as that leaves it{off}")  # fmt: skip
    pairs = dict.fromkeys(f"{_name(model, one.geom1)} and {_name(model, one.geom2)}"
                          for one in data.contact if one.exclude == 0)  # fmt: skip
    if pairs:
        named = ", ".join([*pairs][:MOST_NAMED]) + (", ..." if len(pairs) > MOST_NAMED else "")
        found.append(f"links touch each other at the start ({named}), which pushes the tool off its course; set "
                     "contype and conaffinity of these geoms to 0")  # fmt: skip
    pulled = dict.fromkeys(model.equality(int(data.efc_id[row])).name or f"number {data.efc_id[row]}"
                           for row in range(data.nefc) if data.efc_type[row] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
                           and abs(data.efc_pos[row]) > PULLED)  # fmt: skip
    if pulled:
        found.append(f"equality constraints of the file do not hold at the start ({', '.join([*pulled][:MOST_NAMED])}) "
                     "and pull on what they join; delete them, or let them hold there")  # fmt: skip
    for note in found:
        log.warning("%s.", note)
    return tuple(found)


def length_of(model: Any, tool: str) -> float:
    """Length of the links from the base to a geom's body, in all [m]."""
    body, long = model.geom_bodyid[model.geom(tool).id], 0.0
    while body:
        long, body = long + float(np.linalg.norm(model.body_pos[body])), model.body_parentid[body]
    return long


def stuck_joints(model: Any, joints: tuple[int, ...], qpos: np.ndarray) -> tuple[str, ...]:
    """Which joints of an arm stood at a limit for most of a run, one sentence each.

    Args:
        model: MuJoCo model.
        joints: numbers of the arm's joints.
        qpos: poses of all, (N, nq).
    """
    found = []
    for joint in joints:
        low, high = model.jnt_range[joint]
        if model.jnt_limited[joint] and high > low:
            at, near = qpos[:, model.jnt_qposadr[joint]], AT_LIMIT * (high - low)
            for limit, share in ((low, np.mean(at < low + near)), (high, np.mean(at > high - near))):
                if share > MOST_AT_LIMIT:
                    by = f"{limit:.3g} m" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else \
                        f"{np.rad2deg(limit):.3g} degrees"  # fmt: skip
                    found.append(f"joint {model.joint(joint).name} stood at its limit of {by} for {share:.0%} of the "
                                 "run (MJCF takes degrees unless its compiler says angle=\"radian\")")  # fmt: skip
    return tuple(found)


def strength(model: Any, joints: tuple[int, ...], qpos: np.ndarray, tool: str) -> tuple[float, str]:
    """Largest force that an arm presses down with [N], and the joint whose motor is at its limit then.

    Args:
        model: MuJoCo model.
        joints: numbers of the arm's joints.
        qpos: pose of all, at rest, (nq,).
        tool: name of the geom that presses.
    """
    data, jacobian = mujoco.MjData(model), np.zeros((3, model.nv))
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    mujoco.mj_jacGeom(model, data, jacobian, None, model.geom(tool).id)
    most, weakest = np.inf, ""
    for joint in joints:
        dof = model.jnt_dofadr[joint]
        if not model.jnt_actfrclimited[joint]:
            continue
        (low, high), arm = model.jnt_actfrcrange[joint], -jacobian[2, dof]
        holds = data.qfrc_bias[dof] - data.qfrc_passive[dof]
        if not low <= holds <= high:  # not even itself
            force = 0.0
        elif abs(arm) < 1e-6:
            continue
        else:
            force = float((high if arm > 0 else low) - holds) / arm
        if force < most:
            most, weakest = force, model.joint(joint).name
    return most, weakest


def _name(model: Any, geom: int) -> str:
    return model.geom(geom).name or f"a geom of {model.body(model.geom_bodyid[geom]).name or 'a body without a name'}"
