"""Jointed: a limb whose joints are hinges of a MuJoCo model: which body carries what, and where the skin is in between.

To pose a skin takes milliseconds, a step of physics less. So the skin is posed again where a hinge is POSE_STEP away;
in between the skin around a tool goes rigidly, as its nearest point goes and as its neighbours turn.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from stmpl_core.arrays import Points, Transform, inverted
from stmpl_core.carrying import motion_at
from stmpl_core.errors import InvalidInput
from stmpl_core.posing import blended
from stmpl_core.rig import Rig
from stmpl_core.skin import Skin
from stmpl_core.touch import Touch
from stmpl_sim.engine import mujoco

log = logging.getLogger(__name__)

POSE_STEP = 0.01  # angle between a hinge and what the skin is posed at, beyond which it is posed again [rad]
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

    def angles(self, data: Any) -> tuple[float, ...]:
        """Angle of each joint in `data` [rad], within the rig's limits. Raises InvalidInput: one is not finite."""
        out = []
        for joint in self.rig.joints:
            angle = float(data.qpos[self._places[joint.name]]) if joint.name in self._places else 0.0
            if not np.isfinite(angle):
                raise InvalidInput(f"joint {joint.name} is {angle} rad. Has the simulation diverged? Try a shorter "
                                   "timestep.")  # fmt: skip
            out.append(min(max(angle, joint.low), joint.high))
        return tuple(out)

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

    def following(self, posed: tuple[float, ...], now: tuple[float, ...]) -> tuple[float, ...] | None:
        """Angles to pose the skin at next, where those that it is posed at (none: at rest) will not do for now [rad].

        As far ahead as the skin lagged behind: so what it is off in between has no sign, and no work comes of it.
        """
        way = np.subtract(now, posed or 0.0)
        most = np.abs(way).max()
        if not most > POSE_STEP:
            return None
        low, high = zip(*((joint.low, joint.high) for joint in self.rig.joints), strict=True)
        return tuple(np.clip(now + way, low, high).tolist()) if most < 2 * POSE_STEP else now

    def back(self, skin: Skin, place: np.ndarray, now: tuple[float, ...]) -> Transform:
        """Rigid motion of the skin around a place, from the angles now to those that it is posed at, (4, 4).

        Args:
            skin: skin as it is posed.
            place: place near it, (3,) [m], layer axes.
            now: angles of the joints [rad].
        """
        if now == skin.angles:
            return np.eye(4)
        rest, motions = (skin.rest or skin).layer.vertices, self.rig.motions(now)

        def moved(some: np.ndarray) -> Points:
            return blended(rest[some], self.rig.weights[some], motions)

        return inverted(motion_at(skin.layer, moved, place))
