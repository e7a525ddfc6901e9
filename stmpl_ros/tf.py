"""TF of a simulated robot: its links, its tools and the limb, for whoever draws them by frames."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import TransformStamped

from bags.wire import header, pose_message
from stmpl_core.arrays import Transform

if TYPE_CHECKING:
    from stmpl_sim.massage import Massage

WORLD = "world"  # frame that all others hang on


def tf_type() -> Any:
    """The message of /tf; None where tf2_msgs is not installed, which is on no package registry but comes with ROS."""
    return import_module("tf2_msgs.msg").TFMessage if find_spec("tf2_msgs") else None


def transforms(massage: Massage, limb: str, stamp_ns: int) -> list[TransformStamped]:
    """Where links, tools and limb are, each in the frame of what it hangs on, at the instant of the last step.

    Frames: `world`; each body by its name, in its parent's frame; the limb as `limb`, its axes those of the skin; a
    tool that is a geom by its name, in its body's frame.

    Args:
        massage: massage after a step.
        limb: frame_id of the limb.
        stamp_ns: time stamp [ns].
    """
    model, data = massage.scene.model, massage.data
    carrier = massage.skin.body
    poses = {body: _pose(data.xpos[body], data.xmat[body]) for body in range(model.nbody)}
    poses[0] = np.eye(4)
    names = {body: model.body(body).name or f"body_{body}" for body in poses} | {0: WORLD, carrier: limb}
    found = []
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        inner = poses[body] @ massage.skin.contact.pose_body_from_layer if body == carrier else poses[body]
        found.append(_transform(names[parent], names[body], poses[parent], inner, stamp_ns))
    for name in massage.scene.tools:
        if name not in names.values():
            geom = model.geom(name).id
            body = int(model.geom_bodyid[geom])
            at = _pose(data.geom_xpos[geom], data.geom_xmat[geom])
            found.append(_transform(names[body], name, poses[body], at, stamp_ns))
    return found


def _transform(parent: str, child: str, outer: Transform, inner: Transform, stamp_ns: int) -> TransformStamped:
    pose = pose_message(np.linalg.inv(outer) @ inner, parent, stamp_ns).pose
    message = TransformStamped(header=header(parent, stamp_ns), child_frame_id=child)
    message.transform.translation.x, message.transform.translation.y = pose.position.x, pose.position.y
    message.transform.translation.z = pose.position.z
    message.transform.rotation = pose.orientation
    return message


def _pose(position: np.ndarray, turn: np.ndarray) -> Transform:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), position
    return pose
