"""Bond: the heartbeat that lifecycle managers such as nav2's ask for, where the package `bond` is installed."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any
from uuid import uuid4

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from bags.wire import header
from stmpl_ros.ticks import steady_timer

PERIOD_S = 0.1  # time between two beats [s], as nav2's nodes have it
TIMEOUT_S = 4.0  # silence after which a manager is to take the node for dead [s], likewise
BEATS = QoSProfile(depth=5)  # as bondcpp's
LAST_WORD_S = 0.05  # time that a manager gets to hear that the bond is ended [s]


class Bond:
    """One end of a bond: while it is formed, `bond` (bond/msg/Status) says PERIOD_S by PERIOD_S that the node lives.

    The beats come by the node's executor, so one that is stuck is silent. The id is the node's name, as nav2's managers
    have it. What a manager says is not listened to: it calls ~/change_state if it wants something.

    Args:
        node: node that lives.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._instance = node, str(uuid4())
        self._kind: Any = import_module("bond.msg").Status if find_spec("bond") else None
        self._publisher: Publisher | None = None
        self._timer: Any = None

    @property
    def missing(self) -> str:
        """Why there is no bond; empty: there is one."""
        return "" if self._kind else "no bond with a lifecycle manager: the package 'bond' is not installed"

    def form(self) -> None:
        """Begins to beat, where `bond` is installed."""
        if self._kind and self._timer is None:
            self._publisher = self._node.create_publisher(self._kind, "bond", BEATS)
            self._timer = steady_timer(self._node, PERIOD_S, self._beat)
            self._beat()

    def end(self) -> None:
        """Tells that the bond is ended."""
        if self._timer is not None and self._publisher is not None:
            self._node.destroy_timer(self._timer)
            self._beat(active=False)
            self._publisher.wait_for_all_acked(Duration(seconds=LAST_WORD_S))
            self._node.destroy_publisher(self._publisher)
        self._timer = self._publisher = None

    def _beat(self, active: bool = True) -> None:
        assert self._publisher
        stamp = self._node.get_clock().now().nanoseconds
        self._publisher.publish(self._kind(header=header("", stamp), id=self._node.get_name(),
                                           instance_id=self._instance, active=active, heartbeat_timeout=TIMEOUT_S,
                                           heartbeat_period=PERIOD_S))  # fmt: skip
