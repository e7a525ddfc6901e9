"""A node that answers each pose with a wrench of zero: what rclpy and the middleware leave of a millisecond.

python -m benchmarks.echo --ros-args -r __ns:=/bare
"""

from __future__ import annotations

import sys

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node

from bags.wire import wrench_message
from stmpl_ros.spinning import ros, spin
from stmpl_ros.topics import NEWEST, STREAM


class Echo(Node):
    """Takes the poses of `probe`, and sends its contact wrench, as a SkinNode does and with nothing in between."""

    def __init__(self) -> None:
        super().__init__("echo")
        self._message = wrench_message(np.zeros(6), "body", 0)
        self._wrench = self.create_publisher(WrenchStamped, "tools/probe/contact_wrench", STREAM)
        self.create_subscription(PoseStamped, "tools/probe/pose", self._on_pose, NEWEST)

    def _on_pose(self, pose: PoseStamped) -> None:
        self._message.header.stamp = pose.header.stamp
        self._wrench.publish(self._message)


def main() -> None:
    """Until SIGINT."""
    with ros(sys.argv[1:]) as stop:
        executor = EventsExecutor()
        executor.add_node(Echo())
        spin(executor, stop)


if __name__ == "__main__":
    main()
