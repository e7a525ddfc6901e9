"""Followed: tools that are frames of /tf; where these stand is told as a pose, which a recording then holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node

from bags.wire import header
from stmpl_core.errors import InvalidInput
from stmpl_ros.frames import Frames
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.ticks import steady_timer
from stmpl_ros.topics import STREAM


class Followed:
    """Looks where the frames of tools stand, at a rate; hands each new place on as a PoseStamped in the body's frame.

    The same message is sent on tools/NAME/pose, so that what is recorded there repeats the answers.

    Args:
        node: node that looks.
        frames: frames.
        config: settings, which name the frame of each such tool.
        on_pose: callback with a tool's name and its pose.

    Raises:
        InvalidInput: frames are named, and tf2_ros is not installed.
    """

    def __init__(self, node: Node, frames: Frames, config: NodeConfig,
                 on_pose: Callable[[str, PoseStamped], None]) -> None:  # fmt: skip
        self._node, self._frames, self._on_pose = node, frames, on_pose
        self._named, self._publishers, self._newest = config.tf_frames, dict[str, Any](), dict[str, int]()
        if self._named and not frames.listens:
            raise InvalidInput("tf_tools needs the package tf2_ros, which comes with ROS and is not installed here.")
        self._timer = steady_timer(node, 1 / config.tf_rate, self._look) if self._named else None

    def follow(self, tool: str) -> bool:
        """Begins to follow a tool; False if the settings name no frame for it."""
        if tool in self._named:
            self._publishers[tool] = self._node.create_publisher(PoseStamped, f"tools/{tool}/pose", STREAM)
        return tool in self._named

    def leave(self, tool: str) -> None:
        """Follows a tool no more."""
        self._newest.pop(tool, None)
        if (publisher := self._publishers.pop(tool, None)) is not None:
            self._node.destroy_publisher(publisher)

    def forget(self) -> None:
        """Forgets the stamps of what was told."""
        self._newest.clear()

    def close(self) -> None:
        """Follows none any more."""
        for tool in list(self._publishers):
            self.leave(tool)

    def _look(self) -> None:
        for tool, publisher in self._publishers.items():
            frame = self._named[tool]
            stamp = self._frames.newest(frame)
            if stamp == 0:  # it never moves: it is there now
                stamp = self._node.get_clock().now().nanoseconds
            if stamp is None or stamp <= self._newest.get(tool, 0):
                continue
            try:
                place = self._frames.place(frame, stamp)
            except KeyError:  # a frame between was first told of after that, as where /tf has just begun
                continue
            message = PoseStamped(header=header(self._frames.body, stamp), pose=place)
            self._newest[tool] = stamp
            publisher.publish(message)
            self._on_pose(tool, message)
