"""Forwarder: a node's topics live to Foxglove over its websocket, byte for byte as they came over ROS."""

from __future__ import annotations

import queue
import re
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import foxglove  # pyright: ignore[reportMissingImports]
from foxglove.websocket import ServerListener  # pyright: ignore[reportMissingImports]
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import DurabilityPolicy
from rclpy.subscription import Subscription

from bags.schema import find_schema
from bags.wire import message_class
from stmpl_core.errors import BagError, InvalidInput
from stmpl_ros.events import PolledEvents
from stmpl_ros.recorder import pattern
from stmpl_ros.spinning import ros, spin
from stmpl_ros.topics import as_offered

POLL_PERIOD_S = 0.1  # time between two looks for new topics and new viewers
DEPTH = 10  # messages of a topic that wait for this process
WANTED = r".*/(contact_mesh|skin/\w+|tools/[\w/]+/\w+|wrist/wrench|joint_states)|/(diagnostics|tf|tf_static)"


class Viewers(ServerListener):
    """What viewers ask for, told by threads of the server: channel's number, and one viewer more or fewer."""

    def __init__(self) -> None:
        self.asked: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """A viewer more."""
        self.asked.put((channel.id, 1))

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """A viewer fewer."""
        self.asked.put((channel.id, -1))


class Forwarder(PolledEvents):
    """Offers each topic as a channel, and subscribes to it while somebody looks: most cost the node work only then.

    A further viewer of a latched topic has it subscribed anew, so that what was sent once comes again.

    Args:
        context: context of the server.
        viewers: what viewers ask for.
        wanted: topic names to offer, whole.
    """

    def __init__(self, context: Any, viewers: Viewers, wanted: re.Pattern[str]) -> None:
        super().__init__("foxglove")
        self._server, self._viewers, self._wanted = context, viewers, wanted
        self._topics: dict[str, Any] = {}  # channel of each, None: its type is not installed
        self._channels: dict[int, tuple[Any, type]] = {}
        self._looking: Counter[int] = Counter()
        self._heard: dict[int, Subscription] = {}
        self.create_timer(POLL_PERIOD_S, self._look)

    def _look(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            if topic not in self._topics and self.count_publishers(topic) and self._wanted.fullmatch(topic):
                self._topics[topic] = self._offer(topic, types[0])
        new: set[int] = set()
        while not self._viewers.asked.empty():
            number, more = self._viewers.asked.get()
            self._looking[number] += more
            new |= {number} if more > 0 else set()
        for number in self._channels:
            channel, kind = self._channels[number]
            heard = self._heard.get(number)
            again = number in new and heard is not None and heard.qos_profile.durability != DurabilityPolicy.VOLATILE
            if heard is not None and (again or not self._looking[number]):
                self.destroy_subscription(self._heard.pop(number))
            if self._looking[number] and number not in self._heard:
                self._heard[number] = self._subscribe(channel, kind)

    def _offer(self, topic: str, type_name: str) -> Any:
        try:
            schema, kind = find_schema(type_name), message_class(type_name)
        except BagError as error:
            return self.get_logger().warning(f"{topic} is left out: {error}")
        described = foxglove.Schema(name=schema.name, encoding="ros2msg", data=schema.text.encode())
        channel = foxglove.Channel(topic, schema=described, message_encoding="cdr", context=self._server)
        self._channels[channel.id()] = channel, kind
        return channel

    def _subscribe(self, channel: Any, kind: type) -> Subscription:
        def forward(data: Any) -> None:
            channel.log(bytes(data), log_time=time.time_ns())

        profile = as_offered(self, channel.topic(), DEPTH)
        return self.create_subscription(kind, channel.topic(), forward, profile, raw=True)


def run(host: str, port: int, topics: Sequence[str] = (), arguments: list[str] | None = None) -> int:
    """Serves until SIGINT, SIGTERM or SIGHUP.

    Args:
        host: address to listen at.
        port: port to listen at; 0: one that is free, which is told.
        topics: regular expressions of whole topic names; the node's own and /tf unless given.
        arguments: arguments of ROS.

    Raises:
        InvalidInput: the address is in use, or an expression cannot be read.
    """
    wanted, viewers, context = pattern(topics or [WANTED]), Viewers(), foxglove.Context()
    with ros(arguments) as stop:
        try:
            server = foxglove.start_server(name="stmpl", host=host, port=port, context=context, server_listener=viewers)
        except (RuntimeError, OSError) as error:
            raise InvalidInput(f"cannot listen at {host}:{port}: {error}. Take another --port.") from error
        node, executor = Forwarder(context, viewers, wanted), EventsExecutor()
        executor.add_node(node)
        layout = "stmpl_ros/foxglove/stmpl.json"
        node.get_logger().info(f"open Foxglove, connect to ws://{host}:{server.port}, import {layout}")
        try:
            spin(executor, stop)
        finally:
            executor.shutdown()
            server.stop()
            node.destroy_node()
    return 0
