"""Recorder: writes the topics of a run, as they come over the wire, into an MCAP file."""

from __future__ import annotations

import json
import logging
import queue
import re
import struct
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.utilities import ok

from bags.moving import TF, TF_STATIC
from bags.provenance import write_provenance
from bags.reader import type_of
from bags.schema import find_schema
from bags.wire import message_class
from bags.writer import BagWriter, qos_yaml
from stmpl_core.errors import BagError, InvalidInput
from stmpl_core.text_file import text_of
from stmpl_ros.frames import read_frames
from stmpl_ros.parameters import RecordConfig
from stmpl_ros.spinning import ros, spin
from stmpl_ros.topics import as_offered

log = logging.getLogger(__name__)

WANTED = re.compile(
    r"(contact_mesh|skin/topology|skin/displacement|tools/[\w/]+/(pose|wrench)|wrist/wrench|joint_states)$"
    r"|^/(diagnostics|tf|tf_static)$"
)
NEEDED = {"answers": re.compile(r"skin/displacement$"), "contacts": re.compile(r"tools/[\w/]+/pose$")}  # for a replay
EVERYBODYS = ("/diagnostics", TF, TF_STATIC)  # topics of no namespace that belong to a run
PLACED = re.compile(r".*/(?:skin/topology|tools/.+/(?:pose|wrench))")  # their frame_id says where things are
IF_HEARD = re.compile(r"tools/[\w/]+/local_contact$")  # recorded only once a device listens: it costs the node work
FOREVER = 1e9  # lease of a sender that never tells that it is there, at least [s]
POLL_PERIOD_S = 0.1  # time between two looks for new topics
DEPTH = 1000  # messages of a topic that the middleware keeps while this process is busy
MAX_QUEUED_MESSAGES = 4000  # messages that may wait for the disk; later ones are counted as lost
SILENCE_S = 10.0  # time after which what is missing for a replay is told of, once [s]
DRAIN_S = 0.5  # time in which messages still on their way are taken, after being asked to stop

Item = tuple[str, str, str, bytes, int]  # topic, type, quality of service, serialised message, when it came [ns]


class RecorderNode(Node):
    """Subscribes to every topic of a run as soon as it is announced, and hands the bytes to a thread that writes.

    Nothing is decoded. A topic whose type is not installed is named in the log and left out.

    Args:
        stop: event that is set when the disk refuses.
        wanted: topic names to record, whole; None: the run's own topics that lie in this node's namespace.
    """

    def __init__(self, stop: threading.Event, wanted: re.Pattern[str] | None = None) -> None:
        super().__init__("recorder")
        self._space = self.get_namespace()
        self._stop, self._wanted = stop, wanted
        self.received = self.lost = 0
        self.error: BagError | None = None
        self._channels: dict[str, int] = {}
        self._placed: set[tuple[str, str]] = set()  # topics and the frames that they came in
        self._queue: queue.SimpleQueue[Item | None] = queue.SimpleQueue()
        self._known: dict[str, Sequence[str]] = {}  # types of topics that were refused, none of those that are recorded
        self.create_timer(POLL_PERIOD_S, self._look)
        self._waiting = self.create_timer(SILENCE_S, self._tell_of_silence)

    def write_to(self, writer: BagWriter) -> None:
        """Begins to write what comes."""
        self.writer = writer
        self._thread = threading.Thread(target=self._write, name="writer")
        self._thread.start()

    def _look(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            if self._known.get(topic) not in ((), types) and self.count_publishers(topic) and self._is_wanted(topic):
                try:
                    self._subscribe(topic, types)
                    self._known[topic] = ()
                except BagError as error:
                    self._known[topic] = types
                    self.get_logger().error(f"{topic} is not recorded: {error}")

    def _tell_of_silence(self) -> None:
        self._waiting.cancel()
        if missing := self.missing():
            self.get_logger().warning(f"so far {missing}")

    def missing(self) -> str:
        """What did not come, in a sentence: anything at all, or what a replay of the run's own topics needs."""
        lacks = [what for what, topic in NEEDED.items() if not any(map(topic.search, list(self._channels)))]
        if self._wanted:
            return "" if self._channels else "nothing was heard on --topics: is ROS_DOMAIN_ID the sender's?"
        said = (f"no {' and no '.join(lacks)} were heard in namespace {self._space}, so this cannot be replayed: are "
                "ROS_DOMAIN_ID and the namespace (--ros-args -r __ns:=/left) the node's?")  # fmt: skip
        return said * bool(lacks)

    def _is_wanted(self, topic: str) -> bool:
        if self._wanted:
            return bool(self._wanted.fullmatch(topic))
        own = self._space.rstrip("/") + "/"
        run = WANTED.search(topic) or (IF_HEARD.search(topic) and self.count_subscribers(topic))
        return bool(run) and (topic.startswith(own) or topic in EVERYBODYS)

    def _subscribe(self, topic: str, types: Sequence[str]) -> None:
        expected = type_of(topic)
        type_name = expected if expected in types else types[0]
        if type_name != expected and expected and not self._wanted:
            raise BagError(f"it carries {type_name}, and a run's carries {expected}. --topics records any type.")
        find_schema(type_name)  # raises BagError here, not in the thread that writes
        profile = as_offered(self, topic, DEPTH)
        reliable = profile.reliability == ReliabilityPolicy.RELIABLE
        kept = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        offered = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
        leases = [o.liveliness_lease_duration.nanoseconds * 1e-9 for o in offered]
        lease = max((one for one in leases if one < FOREVER), default=0.0)
        depth = max((o.depth for o in offered), default=10) or 10
        qos = qos_yaml(depth=depth, reliable=reliable, transient_local=kept, lease=lease)
        placed = PLACED.fullmatch(topic) is not None and type_name == expected

        def keep(data: Any) -> None:
            if self._queue.qsize() > MAX_QUEUED_MESSAGES:
                return self._count_lost(1, f"the disk is {MAX_QUEUED_MESSAGES} messages behind")
            self.received += 1
            if placed:
                self._placed.add((topic, frame_of(data)))
            self._queue.put((topic, type_name, qos, data, time.time_ns()))

        self.create_subscription(
            message_class(type_name),
            topic,
            keep,
            profile,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_lost),
        )
        self.get_logger().info(f"recording {topic} ({type_name})")

    def foreign(self, frames: Mapping[str, Any]) -> Iterator[str]:
        """What a replay cannot place, a sentence each: poses and wrenches in frames of a /tf that was not recorded."""
        if {TF, TF_STATIC} & self._channels.keys():
            return
        topology = {topic.removesuffix("skin/topology"): frame for topic, frame in self._placed
                    if topic.endswith("skin/topology")}  # fmt: skip
        for topic, frame in sorted(self._placed):
            if topic.endswith("skin/topology"):
                continue
            space = max((one for one in topology if topic.startswith(f"{one}tools/")), key=len, default="/")
            body, tool = topology.get(space), topic.removeprefix(f"{space}tools/").rpartition("/")[0]
            if frame and body is not None and frame not in (body, tool, *frames):
                yield (f"{topic} came in frame '{frame}', which is neither '{body}' nor in --frames, and no /tf was "
                       "recorded: these contacts are not replayed offline, only to a node that hears /tf (stmpl replay "
                       "--publish)")  # fmt: skip

    def _on_lost(self, status: Any) -> None:
        self._count_lost(status.total_count_change, "lost on the way")

    def _count_lost(self, count: int, why: str) -> None:
        self.lost += count
        self.get_logger().error(f"{self.lost} messages lost so far; the last: {why}", throttle_duration_sec=1.0)

    def _write(self) -> None:
        try:
            while (item := self._next()) is not None:
                topic, type_name, qos, data, received = item
                if topic not in self._channels:
                    self._channels[topic] = self.writer.add_channel(topic, type_name, qos)
                self.writer.write(self._channels[topic], data, received, received)
        except BagError as error:
            self.error = error
            self._stop.set()

    def _next(self) -> Item | None:
        while True:
            try:
                return self._queue.get(timeout=1.0)
            except queue.Empty:
                self.writer.flush()

    def finish(self) -> None:
        """Waits until all that was received is written."""
        self._queue.put(None)
        self._thread.join()


def frame_of(data: bytes) -> str:
    """frame_id of a serialised message that begins with its header; empty where the message is cut."""
    if len(data) < 16:
        return ""
    (length,) = struct.unpack_from("<I" if data[1] else ">I", data, 12)
    return data[16 : 15 + length].decode(errors="replace")


def pattern(topics: Sequence[str]) -> re.Pattern[str]:
    """One expression that matches what any of `topics` matches. Raises InvalidInput."""
    try:
        return re.compile("|".join(f"(?:{topic})" for topic in topics))
    except re.error as error:
        raise InvalidInput(f"topics {' '.join(topics)} are no regular expressions: {error}.") from error


def _made_by(path: Path) -> dict[str, Any]:
    """What a run was configured with, of a JSON file. Raises InvalidInput."""
    try:
        read = json.loads(text_of(path))
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidInput(f"run file {path}: {error}.") from error
    node = read.get("node", {}) if isinstance(read, dict) else None
    if not isinstance(node, dict) or not all(isinstance(node.get(key, ""), str) for key in ("method", "part")):
        raise InvalidInput(f"run file {path} holds no table of settings. Needed is {{\"node\": {{...}}}}.")
    return read


def run(config: RecordConfig, arguments: list[str] | None = None, topics: Sequence[str] = ()) -> int:
    """Records until SIGINT, SIGTERM or SIGHUP; the exit code says whether anything came, and everything is on disk.

    Args:
        config: folder and files of the recording.
        arguments: arguments of ROS.
        topics: regular expressions of whole topic names to record instead of the run's own topics.

    Raises:
        BagError: a file that exists, or the disk refused; the message says what is safe.
        InvalidInput: an expression or a file of frames that cannot be read.
    """
    wanted = pattern(topics) if topics else None
    made_by = _made_by(config.run) if config.run else {}
    frames = read_frames(str(config.frames or made_by.get("node", {}).get("frames", "")))
    with ros(arguments) as stop, ExitStack() as opened:
        node = RecorderNode(stop, wanted)  # before the file: what ROS refuses leaves none behind
        opened.callback(node.destroy_node)
        writer = opened.enter_context(BagWriter(config.path))
        write_provenance(
            writer,
            None,
            method=made_by.get("node", {}).get("method", ""),
            body=made_by.get("node", {}).get("part", ""),
            config=made_by,
            frames=frames,
        )
        node.write_to(writer)
        executor = EventsExecutor()
        executor.add_node(node)
        try:
            spin(executor, stop)
            until = time.monotonic() + DRAIN_S
            while time.monotonic() < until and ok():
                executor.spin_once(timeout_sec=0.05)
        finally:
            executor.shutdown()
            node.finish()
        if node.error:
            raise node.error
        for sentence in node.foreign(frames):
            log.warning(sentence)
        if missing := node.missing():
            log.warning(missing)
        writer.add_metadata("recorder", {"received": str(node.received), "lost": str(node.lost)})
    log.info("%d messages recorded, %d lost", node.received, node.lost)
    return 0 if node.received else 1
