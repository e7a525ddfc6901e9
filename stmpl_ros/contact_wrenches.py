"""ContactWrenches: what each tool exerts on the body according to the model, at full rate while somebody listens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher

from stmpl_core.arrays import Wrench
from stmpl_ros.conversions import wrench_message
from stmpl_ros.topics import STREAM


class ContactWrenches:
    """`tools/NAME/contact_wrench` of every tool, in the body's axes, about the tool's origin.

    It is what the tool exerts on the body, as on `tools/NAME/wrench`: of a tool without a force sensor what its pose
    presses with, of one with a sensor the part of the measured wrench that the skin carries.

    Args:
        node: that publishes.
        frame: of the body.
    """

    def __init__(self, node: Node, frame: str) -> None:
        self._node, self._frame = node, frame
        self._publishers: dict[str, Publisher] = {}

    def open(self, tool: str) -> None:
        """Opens the topic of a tool."""
        self._publishers[tool] = self._node.create_publisher(WrenchStamped, f"tools/{tool}/contact_wrench", STREAM)

    def close(self) -> None:
        """Closes all topics."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
        self._publishers.clear()

    def send(self, wrenches: Mapping[str, Wrench], stamp_ns: int) -> None:
        """Publishes those that somebody listens to."""
        for tool, wrench in wrenches.items():
            publisher = self._publishers.get(tool)
            if publisher and publisher.get_subscription_count():
                publisher.publish(wrench_message(wrench, self._frame, stamp_ns))

    def rest(self, tools: Sequence[str], stamp_ns: int) -> None:
        """Publishes that these tools exert nothing any more."""
        self.send({tool: np.zeros(6) for tool in tools}, stamp_ns)
