"""What an arm is able to do where it starts: its axes, and links that touch each other."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from stmpl_sim.engine import mujoco

AXES = 5  # of a place and a direction to point in; to spin about it is of no use to a ball
MOST_NAMED = 4  # pairs of links that are named
log = logging.getLogger(__name__)


def start_notes(model: Any, joints: tuple[int, ...], qpos: np.ndarray) -> tuple[str, ...]:
    """What will take a tool off its course or its direction, one sentence each; each is a warning of the log, too.

    Args:
        model: MuJoCo model.
        joints: numbers of the arm's joints.
        qpos: start, (nq,).
    """
    found = []
    if len(joints) < AXES:
        found.append(f"the robot has {len(joints)} axes; a place and a direction need {AXES}: the tool keeps its "
                     "place, and points as well as that leaves it")  # fmt: skip
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    pairs = dict.fromkeys(f"{_name(model, one.geom1)} and {_name(model, one.geom2)}"
                          for one in data.contact if one.exclude == 0)  # fmt: skip
    if pairs:
        named = ", ".join([*pairs][:MOST_NAMED]) + (", ..." if len(pairs) > MOST_NAMED else "")
        found.append(f"links touch each other at the start ({named}), which pushes the tool off its course; set "
                     "contype and conaffinity of these geoms to 0")  # fmt: skip
    for note in found:
        log.warning("%s.", note)
    return tuple(found)


def _name(model: Any, geom: int) -> str:
    return model.geom(geom).name or f"a geom of {model.body(model.geom_bodyid[geom]).name or 'a body without a name'}"
