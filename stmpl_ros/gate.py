"""Gate: lets through what can be used of the input, in the body's frame; counts and tells what cannot."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node

from bags.messages import stamp_ns
from stmpl_core.arrays import Transform
from stmpl_core.errors import StmplError
from stmpl_ros.conversions import NANO, checked_pose, checked_wrench
from stmpl_ros.diagnosis import Tally
from stmpl_ros.frames import Frames
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.throttle import Throttle

SAY_EVERY = 1.0  # s between two lines of the same kind


class Gate:
    """Poses and wrenches come back checked, or None.

    Args:
        node: whose clock and logger are used.
        config: gives the settings as they are now.
        frames: where other frames stand.
        tally: counts.

    Attributes:
        refused_since: why something was refused since it was last emptied.
    """

    def __init__(self, node: Node, config: Callable[[], NodeConfig], frames: Frames, tally: Tally) -> None:
        self._node, self._config, self._frames, self._tally = node, config, frames, tally
        self._throttle = Throttle(SAY_EVERY)
        self.refused_since = ""

    def pose(self, message: PoseStamped, tool: str) -> Transform | None:
        """pose_body_from_tool, (4, 4)."""
        try:
            pose_body_from_frame = self._frames.of(message.header.frame_id)
            pose = checked_pose(message, tool, self._config().frame, pose_body_from_frame)
        except StmplError as error:
            return self.refuse(f"pose of {tool}, {type(error).__name__}", str(error))
        return pose if self._fresh(message) else None

    def wrench(self, message: WrenchStamped, tool: str) -> WrenchStamped | None:
        """The wrench in the body's axes or the tool's."""
        try:
            wrench = checked_wrench(self._frames.wrench(message, tool), tool, self._config().frame)
        except StmplError as error:
            return self.refuse(f"wrench of {tool}, {type(error).__name__}", str(error))
        return wrench if self._fresh(message) else None

    def order(self, kind: str, tool: str, taken: bool) -> None:
        """Tells of what came out of order."""
        if not taken:
            self.say(f"order of {kind} of {tool}", f"a {kind} of {tool} was dropped: its stamp is not after the last "
                     "one's. Do two devices send under one name, or was a clock set back?")  # fmt: skip

    def refuse(self, kind: str, why: str) -> None:
        """Counts and tells of what cannot be used."""
        self._tally.refused += 1
        self._tally.last_refusal = self.refused_since = why
        self.say(kind, f"refused: {why}")

    def say(self, kind: str, text: str) -> None:
        """A warning, one of a kind in a while."""
        line = self._throttle.line(kind, text, time.monotonic())
        if line:
            self._node.get_logger().warning(line)

    def _fresh(self, message: Any) -> bool:
        age, allowed = (self._node.get_clock().now().nanoseconds - stamp_ns(message)) / NANO, self._config().max_age
        if not allowed or abs(age) <= allowed:
            return True
        self._tally.stale += 1
        self.say("age", f"a message stamped {age:+.2f} s before now was dropped; allowed is {allowed} s. "
                 "Are the clocks in step, or is this a replay? max_age:=0 accepts any age.")  # fmt: skip
        return False
