"""Jointed: a limb whose joints are hinges of a MuJoCo model: which body carries what, and where the skin is in between.

To pose a skin takes milliseconds, a step of physics less. So the skin is posed again where a hinge has turned by
POSE_STEP; in between it goes rigidly with the bone that a tool is nearest to, which is exact but around the joint.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from stmpl_core.arrays import Transform, inverted
from stmpl_core.errors import InvalidInput
from stmpl_core.rig import Rig
from stmpl_core.touch import Touch
from stmpl_sim.engine import mujoco

log = logging.getLogger(__name__)

POSE_STEP = 0.02  # turn of a hinge after which the skin is posed again [rad]
MAX_TURNED, MAX_AWAY_M = 10.0, 0.01  # angle [degrees] and distance of a hinge's axis from the rig's, not worth a word
BEYOND = 0.02  # angle beyond a joint's limits that is not worth a word: springs that stop a hinge give way [rad]


class Jointed:
    """The hinges of a model that move a limb.

    Args:
        model: MuJoCo model.
        rig: rig of the limb's layer.
        joints: name of the model's hinge by the rig's joint; at its position 0 the limb is at rest.
        root: number of the body that carries the rig's root.

    Attributes:
        bodies: number of the body of each bone.

    Raises:
        InvalidInput: joints that the rig or the model does not have, or that are no hinges.
    """

    def __init__(self, model: Any, rig: Rig | None, joints: Mapping[str, str], root: int) -> None:
        if rig is None:
            raise InvalidInput("this layer has no joints. Try layer.with_(rig=Rig.of(body, part, layer)).")
        unknown = sorted(set(joints) - set(rig.names))
        if unknown:
            raise InvalidInput(f"unknown joint: {', '.join(unknown)}. Available: {', '.join(rig.names)}.")
        names = [model.joint(k).name for k in range(model.njnt)]
        self.rig, self.bodies = rig, [root] * len(rig.bones)
        self._places: dict[str, int] = {}
        self._hinges: dict[str, int] = {}
        for n, parent in enumerate(rig.parents):
            self.bodies[n] = root if parent < 0 else self.bodies[parent]
            for joint in rig.joints:
                if joint.bone != rig.bones[n] or joint.name not in joints:
                    continue
                if joints[joint.name] not in names:
                    raise InvalidInput(f"the model has no joint '{joints[joint.name]}'. Joints: "
                                       f"{', '.join(filter(None, names)) or 'none with a name'}.")  # fmt: skip
                hinge = names.index(joints[joint.name])
                if model.jnt_type[hinge] != mujoco.mjtJoint.mjJNT_HINGE:
                    raise InvalidInput(f"joint '{joints[joint.name]}' is no hinge; only hinges move a limb.")
                self._places[joint.name] = int(model.jnt_qposadr[hinge])
                self.bodies[n] = int(model.jnt_bodyid[hinge])
                self._hinges[joint.name] = hinge

    def compare(self, model: Any, pose_body_from_layer: Transform) -> None:
        """Warns of hinges that are not where the rig has them: skin and body would part as they turn."""
        data, root = mujoco.MjData(model), self.bodies[0]
        for place in self._places.values():
            data.qpos[place] = 0.0
        mujoco.mj_kinematics(model, data)
        turn = data.xmat[root].reshape(3, 3) @ pose_body_from_layer[:3, :3]
        origin = data.xpos[root] + data.xmat[root].reshape(3, 3) @ pose_body_from_layer[:3, 3]
        heads = dict(zip(self.rig.bones, self.rig.heads, strict=True))
        for joint in self.rig.joints:
            if joint.name not in self._hinges:
                continue
            hinge, axis = self._hinges[joint.name], np.array(joint.axis)
            turned = np.degrees(np.arccos(np.clip(turn.T @ data.xaxis[hinge] @ axis, -1, 1)))
            away = np.linalg.norm(np.cross(turn.T @ (data.xanchor[hinge] - origin) - heads[joint.bone], axis))
            if turned > MAX_TURNED or away > MAX_AWAY_M:
                log.warning("the model's hinge of %s is %.0f degrees and %.0f mm off the rig's: skin and body part as "
                            "it turns. Has it the rig's axis, in the layer's axes, and sign?",
                            joint.name, turned, 1e3 * away)  # fmt: skip

    def angles(self, data: Any) -> dict[str, float]:
        """Angle of each joint in `data` [rad], within the rig's limits. Raises InvalidInput: one is not finite."""
        out = {}
        for joint in self.rig.joints:
            angle = float(data.qpos[self._places[joint.name]]) if joint.name in self._places else 0.0
            if not np.isfinite(angle):
                raise InvalidInput(f"joint {joint.name} is {angle} rad. Has the simulation diverged? Try a shorter "
                                   "timestep.")  # fmt: skip
            out[joint.name] = min(max(angle, joint.low), joint.high)
        return out

    def beyond(self, data: Any) -> str:
        """What of the hinges' angles the skin does not follow; empty: nothing."""
        out = []
        for joint in self.rig.joints:
            angle = float(data.qpos[self._places[joint.name]]) if joint.name in self._places else 0.0
            if not joint.low - BEYOND <= angle <= joint.high + BEYOND:
                out.append(f"{joint.name} is at {angle:.3g} rad, its skin goes from {joint.low:.3g} to "
                           f"{joint.high:.3g} rad")  # fmt: skip
        return "; ".join(out)

    def on(self, touch: Touch) -> np.ndarray:
        """Share of a touch that each bone carries, by the weights of the skin under it, (B,) [-]."""
        assert touch.pressure is not None
        shares = touch.pressure @ self.rig.weights
        return shares / shares.sum()

    def back(self, place: np.ndarray, vertices: np.ndarray, posed: Mapping[str, float],
             now: Mapping[str, float]) -> Transform:  # fmt: skip
        """Rigid motion of the bone nearest to a place, from the angles now to those that the skin is posed at, (4, 4).

        Args:
            place: place near the skin, (3,) [m], layer axes.
            vertices: vertices of the posed skin, (V, 3) [m].
            posed, now: angles by joint [rad].
        """
        if posed == now:
            return np.eye(4)
        bone = int(self.rig.weights[int(((vertices - place) ** 2).sum(axis=1).argmin())].argmax())
        start, end = (self.rig.motions(self.rig.angles(one))[bone] for one in (now, posed))
        return end @ inverted(start)
