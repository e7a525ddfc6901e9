"""Player: publishes a recording's messages again, byte for byte, with the original timing or as fast as possible."""

from __future__ import annotations

import logging
import re
import threading
import time
from pathlib import Path

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from bags.reader import Bag, Raw
from bags.schema import find_schema
from bags.wire import message_class
from bags.writer import Offered, offered
from stmpl_core.errors import BagError, InvalidInput
from stmpl_ros.recorder import pattern
from stmpl_ros.spinning import ros

log = logging.getLogger(__name__)

DISCOVERY_S = 1.0  # time that listeners get to find the topics before the first message
LISTENER_S = 5.0  # wait for the first listener [s]
DEPTH = 1000  # messages of a stream that wait for slow reliable listeners
LAST_MESSAGES_S = 5.0  # time that reliable listeners get to take the last messages


class PlayerNode(Node):
    """One publisher for every topic of a bag that `wanted` accepts, with the quality of service it was recorded with.

    Raises:
        BagError: a run without any topic left: not wanted, of a type that is not installed, or that has changed since.
    """

    def __init__(self, bag: Bag, wanted: re.Pattern[str]) -> None:
        super().__init__("player")
        self.targets: dict[str, Publisher] = {}
        self.sent = 0
        refused = []
        for topic in bag.topics.values():
            if topic.messages and wanted.fullmatch(topic.name):
                try:
                    self._open(topic.name, topic.type_name, *bag.described(topic.name))
                except BagError as error:
                    refused.append(f"{topic.name}: {error}")
        for why in refused:
            self.get_logger().warning(f"not replayed: {why}")
        if not self.targets:
            raise BagError(f"{bag.file} has nothing to publish on {wanted.pattern}. Topics: {', '.join(bag.topics)}.")

    def _open(self, topic: str, type_name: str, type_hash: str, qos: str) -> None:
        installed = find_schema(type_name).type_hash
        if type_hash and installed != type_hash:
            raise BagError(f"{type_name} is {installed} here but was {type_hash} when this was recorded.")
        self.targets[topic] = self.create_publisher(message_class(type_name), topic, profile(offered(qos)))

    def play(self, bag: Bag, speed: float, stop: threading.Event) -> bool:
        """Publishes everything in the order of the file; False if it was asked to stop before the end."""
        until = time.perf_counter() + LISTENER_S
        while not any(p.get_subscription_count() for p in self.targets.values()) and time.perf_counter() < until:
            if stop.wait(0.05):
                return False
        stop.wait(DISCOVERY_S)
        started, first = time.perf_counter(), None
        for raw in bag.raw(self.targets.__contains__):
            first = raw.log_time_ns if first is None else first
            late = time.perf_counter() - started
            if speed:
                stop.wait(max(0.0, (raw.log_time_ns - first) * 1e-9 / speed - late))
            if stop.is_set():
                return False
            self._send(raw)
        for publisher in self.targets.values():
            publisher.wait_for_all_acked(Duration(seconds=LAST_MESSAGES_S))
        return True

    def _send(self, raw: Raw) -> None:
        self.targets[raw.topic].publish(raw.data)
        self.sent += 1


def profile(offer: Offered) -> QoSProfile:
    """The quality of service that a topic was recorded with; a stream gets a deeper queue, for speed."""
    return QoSProfile(
        depth=offer.depth if offer.transient_local else max(offer.depth, DEPTH),
        reliability=ReliabilityPolicy.RELIABLE if offer.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if offer.transient_local else DurabilityPolicy.VOLATILE,
        liveliness_lease_duration=Duration(seconds=offer.lease),  # 0: never
    )


def run(
    path: Path, speed: float, topics: tuple[str, ...], arguments: list[str] | None = None, *, namespace: str = ""
) -> int:
    """Publishes a recording until its end, SIGINT, SIGTERM or SIGHUP; 0 if all of it was sent.

    Args:
        path: folder or .mcap file of a run.
        speed: factor on the recorded pace; 1 as recorded, 2 twice as fast, 0 as fast as possible.
        topics: regular expressions of whole topic names; all topics if there are none.
        arguments: arguments of ROS.
        namespace: namespace of the one robot whose topics are published, "/left"; "": all.

    Raises:
        BagError: a run with nothing to publish.
        InvalidInput: a speed below 0, or an expression that cannot be read.
    """
    if not 0 <= speed < float("inf"):
        raise InvalidInput(f"a speed of {speed} cannot be played; 1 is as recorded, 0 as fast as possible.")
    wanted, bag = pattern(topics or (".*",)), Bag(path, namespace)
    with ros(arguments) as stop:
        node = PlayerNode(bag, wanted)
        try:
            finished = node.play(bag, speed, stop)
            node.get_logger().info(f"{node.sent} messages published on {len(node.targets)} topics")
        finally:
            node.destroy_node()
    return 0 if finished else 1
