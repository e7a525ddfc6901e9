"""LocalContacts: tells the newest answer's contacts to first order, while somebody listens, one answer at a time."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from functools import partial

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from stmpl_msgs.msg import LocalContact

from bags.survey import PRESSING
from stmpl_core.arrays import Transform
from stmpl_core.contact import Contact
from stmpl_core.errors import StmplError
from stmpl_core.touch import APART, IN_CORE
from stmpl_core.trust import Displacement
from stmpl_ros.background import Background
from stmpl_ros.conversions import local_contact_message
from stmpl_ros.inbox import Instant
from stmpl_ros.topics import STREAM
from stmpl_ros.workshop import Placed

MODELLED = PRESSING | {IN_CORE, APART}  # statuses of which a local model says what the answer says


class LocalContacts:
    """`tools/NAME/local_contact` of every tool. Answers do not wait for it.

    Args:
        node: that publishes.
        frame: of the body.
        background: where models are found.
        say: is told of what went wrong: a kind, and a line.
    """

    def __init__(self, node: Node, frame: str, background: Background, say: Callable[[str, str], None]) -> None:
        self._node, self._frame, self._background, self._say = node, frame, background, say
        self._publishers: dict[str, Publisher] = {}
        self._next: tuple[Instant, dict[str, int], Displacement, bool] | None = None
        self._busy = False

    def open(self, tool: str) -> None:
        """Opens the topic of a tool."""
        self._publishers[tool] = self._node.create_publisher(LocalContact, f"tools/{tool}/local_contact", STREAM)

    def close(self) -> None:
        """Closes all topics."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
        self._publishers.clear()
        self.forget()

    def move_to(self, background: Background) -> None:
        """Goes on with another layer's background; what the old one was asked is dropped."""
        self._background, self._next, self._busy = background, None, False

    def put(self, instant: Instant, meshes: dict[str, int], answer: Displacement, rotations: bool) -> None:
        """Takes the newest answer, with the number of each tool's mesh."""
        self._next = instant, meshes, answer, rotations
        self._tell()

    def forget(self) -> None:
        """What waits is not told any more."""
        self._next = None

    def _tell(self) -> None:
        if self._busy or self._next is None:
            return
        instant, meshes, answer, rotations = self._next
        self._next = None
        placed = [
            Placed(contact.name, meshes[contact.name], answered_pose(contact, answer))
            for contact in instant.contacts
            if answer.statuses[contact.name] in MODELLED and self._heard(contact.name)
        ]
        if placed:
            self._busy = True
            self._background.models(placed, rotations, partial(self._on_models, instant.stamp, placed, answer))

    def _heard(self, tool: str) -> bool:
        return tool in self._publishers and self._publishers[tool].get_subscription_count() > 0

    def _on_models(self, stamp: int, placed: list[Placed], answer: Displacement, future: Future) -> None:
        self._busy = False
        try:
            for tool, model in zip((one.tool for one in placed), future.result(), strict=True):
                message = local_contact_message(tool, model, answer.statuses[tool], self._frame, stamp)
                if tool in self._publishers:
                    self._publishers[tool].publish(message)
        except (StmplError, BrokenExecutor) as error:
            self._background.renew(error)
            self._say("model", f"no local contact: {error}")
        self._tell()


def answered_pose(contact: Contact, answer: Displacement) -> Transform:
    """Where the answer has the tool: moved along its push from the stated pose, if it has a wrench."""
    pose = contact.pose_body_from_tool.copy()
    if contact.wrench is not None and contact.wrench[:3].any():
        push = contact.wrench[:3] / np.linalg.norm(contact.wrench[:3])
        pose[:3, 3] += answer.trust.figures[f"{contact.name}.moved_m"] * push
    return pose
