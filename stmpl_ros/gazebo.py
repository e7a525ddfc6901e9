"""GazeboContacts: the wrenches of tools from ros_gz_interfaces/Contacts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bags.wire import stamp_ns, wrench_message
from stmpl_core.arrays import Points, Transform, Wrench
from stmpl_core.errors import FrameError, InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_ros.frames import Frames
from stmpl_ros.inbox import Inbox
from stmpl_ros.parameters import NodeConfig

WORLD = "world"  # frame of contacts that name none: gz-sim states them in the simulated world's

class GazeboContacts:
    """The wrenches that tools exert on the body, from ros_gz_interfaces/Contacts.

    Args:
        config: settings, which say which collision is which tool's, and what the body's are called.
        frames: frames, the simulated world's among them.

    Attributes:
        kind: class of the message.

    Raises:
        InvalidInput: ros_gz_interfaces is not installed.
    """

    def __init__(self, config: NodeConfig, frames: Frames) -> None:
        try:
            from ros_gz_interfaces.msg import Contacts  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise InvalidInput(f"gz_contacts needs the package ros_gz_interfaces: {error}.") from error
        self.kind: Any = Contacts
        self._collisions, self._body, self._frames = config.gz_collisions, config.gz_body, frames

    def wrenches(self, message: Any, layer: SoftLayer, inbox: Inbox) -> Iterator[tuple[str, Any]]:
        """Each tool that touches the body and whose pose is known, with the WrenchStamped that it exerts.

        Raises:
            FrameError: a simulated world that stands nobody knows where.
            InvalidInput: points without forces.
        """
        frame, frames = message.header.frame_id or WORLD, self._frames.at(stamp_ns(message))
        if frame not in frames:
            raise FrameError(f"contacts are in frame '{frame}'; list it in the file of the parameter `frames`.")
        for tool, collision in self._collisions.items():
            if (pose := inbox.pose_of(tool)) is not None:
                at = frames[frame], layer, pose[:3, 3]
                wrench = gazebo_wrench(message.contacts, collision, self._body, *at)
                if wrench is not None:
                    yield tool, wrench_message(wrench, self._frames.body, stamp_ns(message))


def gazebo_wrench(
    contacts: Any, collision: str, body: str, pose_body_from_world: Transform, layer: SoftLayer, origin: np.ndarray
) -> Wrench | None:
    """Wrench of the tool with this collision on the body, about `origin` (3,) [m]; None if it touches nothing of it.

    gz-sim (Physics::UpdateCollisions) gives every contact point its position and, as body_1_wrench and body_2_wrench,
    the opposite forces on both bodies, in the world's frame, without torque. Which of them is the first is the physics
    engine's order, not that of collision1 and collision2, and their names are left empty: so the sign is taken from
    what a contact can only do, which is press the skin in.

    Raises:
        InvalidInput: points without forces.
    """
    total, touches = np.zeros(6), False
    for contact in contacts:
        names = contact.collision1.name, contact.collision2.name
        ours = [is_named(name, collision) for name in names]
        other = names[ours[0]]
        if not any(ours) or (body and not is_named(other, body)):
            continue
        if len(contact.wrenches) != len(contact.positions):
            told = f"{len(contact.wrenches)} forces for {len(contact.positions)} points"
            raise InvalidInput(f"Gazebo states {told} where {collision} touches {other}: its physics engine has to "
                               "report them, as DART does.")  # fmt: skip
        turn, shift = pose_body_from_world[:3, :3], pose_body_from_world[:3, 3]
        points = _rows(contact.positions) @ turn.T + shift
        forces = _rows([one.body_1_wrench.force for one in contact.wrenches]) @ turn.T
        if (forces * _inward(layer, points)).sum() < 0:
            forces = -forces
        total += np.concatenate([forces.sum(axis=0), np.cross(points - origin, forces).sum(axis=0)])
        touches = True
    return total if touches else None


def is_named(scoped: str, name: str) -> bool:
    """Whether a name such as model::link::collision is `name`, is in it, or ends with it."""
    return scoped == name or scoped.startswith(f"{name}::") or scoped.endswith(f"::{name}")


def _rows(vectors: Any) -> Points:
    return np.array([(v.x, v.y, v.z) for v in vectors], dtype=np.float64).reshape(-1, 3)


def _inward(layer: SoftLayer, points: Points) -> Points:
    """The inward normal at the vertex that is nearest to each point, (N, 3)."""
    nearest = [int(((layer.vertices - point) ** 2).sum(axis=1).argmin()) for point in points]
    return -layer.normals[nearest]
