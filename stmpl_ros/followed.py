"""Followed: tools that are frames of /tf; where these stand is told as a pose, which a recording then holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node

from bags.wire import NANO, header
from stmpl_core.errors import InvalidInput
from stmpl_ros.frames import Frames
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.ticks import steady_timer
from stmpl_ros.topics import STREAM

START_NS = 500_000_000  # time between two places of a frame of which none came yet, for all that is known [ns]
SLOWEST_NS = 2_000_000_000  # the most that is taken for it: after a long silence the next is told no later [ns]


class _Heard(NamedTuple):
    """When /tf last had a new place of a tool, or began to be asked, and the time between that and the one before."""

    at: int
    every: int


class Followed:
    """Looks where the frames of tools stand, at a rate; hands each new place on as a PoseStamped in the body's frame.

    The same message is sent on tools/NAME/pose, so that what is recorded there repeats the answers. A line tells of a
    frame for which /tf has no new place for `tf_wait`, or for twice as long as the last one took to come.

    Args:
        node: node that looks.
        frames: frames.
        config: settings as they are now, which name the frame of each such tool.
        now: clock by which silence counts [ns].
        say: callback for a line, by its kind.
        on_pose: callback with a tool's name and its pose.

    Raises:
        InvalidInput: frames are named, and tf2_ros is not installed.
    """

    def __init__(self, node: Node, frames: Frames, config: Callable[[], NodeConfig], now: Callable[[], int],
                 say: Callable[[str, str], None], on_pose: Callable[[str, PoseStamped], None]) -> None:  # fmt: skip
        self._node, self._frames, self._config, self._on_pose = node, frames, config, on_pose
        self._now, self._say, self._named = now, say, config().tf_frames
        self._publishers, self._newest = dict[str, Any](), dict[str, int]()
        self._heard = dict[str, _Heard]()
        if self._named and not frames.listens:
            raise InvalidInput("tf_tools needs the package tf2_ros, which comes with ROS and is not installed here.")
        self._timer = steady_timer(node, 1 / config().tf_rate, self._look) if self._named else None

    def follow(self, tool: str) -> bool:
        """Begins to follow a tool; False if the settings name no frame for it."""
        if tool in self._named:
            self._heard[tool] = _Heard(self._now(), START_NS)
            self._publishers[tool] = self._node.create_publisher(PoseStamped, f"tools/{tool}/pose", STREAM)
        return tool in self._named

    def leave(self, tool: str) -> None:
        """Follows a tool no more."""
        self._newest.pop(tool, None)
        self._heard.pop(tool, None)
        if (publisher := self._publishers.pop(tool, None)) is not None:
            self._node.destroy_publisher(publisher)

    def forget(self) -> None:
        """Forgets the stamps of what was told."""
        self._newest.clear()
        self._heard = dict.fromkeys(self._publishers, _Heard(self._now(), START_NS))

    def close(self) -> None:
        """Follows none any more."""
        for tool in list(self._publishers):
            self.leave(tool)

    def lost(self) -> dict[str, str]:
        """Sentences on tools for which /tf has had no new place for long, by tool."""
        now, wait, said = self._now(), self._config().tf_wait * NANO, dict[str, str]()
        for tool, heard in self._heard.items():
            if now - heard.at > max(wait, 2 * heard.every):
                stamp, frame = self._node.get_clock().now().nanoseconds, self._named[tool]
                said[tool] = (f"/tf has not said for {(now - heard.at) / NANO:.1f} s where frame '{frame}' is, which "
                              f"is {tool}: {self._frames.missing(frame, stamp)}")  # fmt: skip
        return said

    def _look(self) -> None:
        self._take_new()
        for tool, why in self.lost().items():
            self._say(f"tf of {tool}", why)

    def _take_new(self) -> None:
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
            self._newest[tool], now = stamp, self._now()
            self._heard[tool] = _Heard(now, min(now - self._heard[tool].at, SLOWEST_NS))
            publisher.publish(message)
            self._on_pose(tool, message)
