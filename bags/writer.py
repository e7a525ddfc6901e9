"""BagWriter: MCAP that rosbag2 accepts, on disk in whole chunks about once a second."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap import records
from mcap.records import Channel
from mcap.writer import CompressionType, Writer
from ruamel.yaml import YAML, YAMLError

from bags.schema import find_schema
from stmpl_core.errors import BagError

log = logging.getLogger(__name__)

ROS_DISTRO = "jazzy"
FILE = "run_0.mcap"  # file in a recording's folder; ros2 bag reindex takes only names that end in a number
FOREVER = 2147483647.0  # duration that is written for infinity or more [s]
INFORMATION = "rosbag2_bagfile_information"  # what metadata.yaml holds
METADATA_VERSION = 9  # version of rosbag2's metadata.yaml in Jazzy
CHUNK_BYTES = 8 << 20  # size at which a chunk is closed [bytes], if chunk_seconds have not passed before


def qos_yaml(
    *, depth: int = 10, reliable: bool = True, transient_local: bool = False, liveliness: str = "automatic",
    lease: float = 0.0,
) -> str:  # fmt: skip
    """One QoS profile as rosbag2 keeps it in `offered_qos_profiles`; everything else at its default.

    Args:
        depth: number of messages that are kept for late or slow listeners.
        reliable: reliable delivery; else best effort.
        transient_local: durability for listeners who come late.
        liveliness: policy by which a sender tells that it is there, as rosbag2 writes it.
        lease: time after which a silent sender is told to be gone [s]; 0: never.
    """
    forever = {"sec": 9223372036, "nsec": 854775807}
    whole, part = divmod(round(lease * 1e9), 10**9)
    return _yaml([{
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if transient_local else "volatile",
        "deadline": forever,
        "lifespan": forever,
        "liveliness": liveliness,
        "liveliness_lease_duration": {"sec": whole, "nsec": part} if lease else forever,
        "avoid_ros_namespace_conventions": False,
    }])  # fmt: skip


@dataclass(frozen=True)
class Offered:
    """Part of a QoS profile that matters here; the names are those of `qos_yaml`."""

    depth: int = 10
    reliable: bool = True
    transient_local: bool = False
    lease: float = 0.0


def offered(yaml: str) -> Offered:
    """The first profile of a topic's `offered_qos_profiles`, ours or rosbag2's; the default if it cannot be read."""
    try:
        told = YAML(typ="safe").load(yaml)[0]
        depth, lease = int(told["depth"]), told.get("liveliness_lease_duration") or {}
        seconds = int(lease.get("sec", 0)) + 1e-9 * int(lease.get("nsec", 0))
    except (YAMLError, TypeError, KeyError, IndexError, ValueError, AttributeError):
        return Offered()
    # rosbag2 before Jazzy wrote the numbers of rmw's enumerations
    return Offered(depth or 10, told.get("reliability") not in ("best_effort", 2),
                   told.get("durability") in ("transient_local", 1), seconds if seconds < FOREVER else 0.0)  # fmt: skip


@dataclass
class _Topic:
    name: str
    type_name: str
    type_hash: str
    qos: str
    encoding: str = "cdr"
    messages: int = 0


class BagWriter:
    """Writes one recording; use it as a context manager, or call `close`.

    What has been flushed survives a SIGKILL; `bags.recover` brings it back. Call `flush` when no message comes for
    a while, because time is looked at only when one is written. Not thread-safe: one thread writes.

    Args:
        path: path of a folder, which gets FILE, or of the .mcap file; metadata.yaml goes beside it.
        chunk_seconds: wall-clock time after which a chunk is closed and handed to the operating system.
        source: recording that this one is a copy of, to be copied again if the disk refuses; None: it is none.

    Raises:
        BagError: a file that exists, or cannot be written.
    """

    def __init__(self, path: Path | str, *, chunk_seconds: float = 1.0, source: Path | None = None) -> None:
        path = Path(path)
        self.path = path if path.suffix == ".mcap" else path / FILE
        self._chunk_seconds, self._source = chunk_seconds, source
        self._topics: dict[int, _Topic] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._times: tuple[int, int] | None = None
        self.safe_messages = 0  # how many survive a SIGKILL
        self._messages = self._safe_bytes = 0
        self._error: BagError | None = None
        self._closed = False
        self._metadata, self._made = self.path.with_name("metadata.yaml"), list[Path]()
        fresh = not self.path.parent.exists()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path, "xb", buffering=1 << 20)
        except FileExistsError as error:
            if not self.path.parent.is_dir():
                raise BagError(f"{self.path.parent} is a file, not a folder. Record into a folder.") from error
            raise BagError(f"{self.path} exists already. Record into another folder, or remove it.") from error
        except OSError as error:
            raise BagError(f"{self.path} cannot be written: {error.strerror}.") from error
        self._made += [self.path.parent, self.path] if fresh else [self.path]
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD,
                              enable_data_crcs=True)  # fmt: skip
        self._guard(lambda: self._writer.start(profile="ros2"))
        self._flushed_at = time.monotonic()

    def add_channel(self, topic: str, type_name: str, qos_yaml: str = "") -> int:
        """Announces `topic` of message type `pkg/msg/T`, and returns the number to write its messages with.

        Raises:
            BagError: the message type is not installed, or writing failed.
        """
        schema = find_schema(type_name)
        metadata = {"offered_qos_profiles": qos_yaml, "topic_type_hash": schema.type_hash}
        announced = _Topic(topic, schema.name, schema.type_hash, qos_yaml)
        return self._add_channel(announced, "ros2msg", schema.text.encode(), metadata)

    def copy_channel(self, channel: Channel, schema: records.Schema | None) -> int:
        """Announces a channel of another bag as it is described there, its type installed here or not."""
        told = channel.metadata
        topic = _Topic(channel.topic, schema.name if schema else "", told.get("topic_type_hash", ""),
                       told.get("offered_qos_profiles", ""), channel.message_encoding)  # fmt: skip
        return self._add_channel(topic, schema.encoding if schema else "", schema.data if schema else b"", told)

    def _add_channel(self, topic: _Topic, encoding: str, text: bytes, metadata: Mapping[str, str]) -> int:
        key = topic.type_name, encoding, text
        if topic.type_name and key not in self._schemas:
            self._schemas[key] = self._guard(lambda: self._writer.register_schema(*key))
        described = topic.name, topic.encoding, self._schemas.get(key, 0), dict(metadata)
        channel_id = self._guard(lambda: self._writer.register_channel(*described))
        self._topics[channel_id] = topic
        return channel_id

    def write(self, channel_id: int, cdr_bytes: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Adds one serialised message, with the times at which it was received and published [ns].

        Raises:
            BagError: unknown channel, or the disk refused; the message says what is safe.
        """
        topic = self._topics.get(channel_id)
        if topic is None:
            raise BagError(f"no channel {channel_id}; known are {sorted(self._topics)}. Call add_channel first.")
        times = (log_time_ns, publish_time_ns)
        self._guard(lambda: self._writer.add_message(channel_id, times[0], cdr_bytes, times[1], topic.messages))
        topic.messages += 1
        self._messages += 1
        first, last = self._times or (log_time_ns, log_time_ns)
        self._times = (min(first, log_time_ns), max(last, log_time_ns))
        if time.monotonic() - self._flushed_at >= self._chunk_seconds:
            self.flush()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Adds a named table of strings, and flushes. Raises BagError."""
        self._guard(lambda: self._writer.add_metadata(name, dict(values)))
        self.flush()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Adds a file to the bag, and flushes. Raises BagError."""
        now = time.time_ns()
        self._guard(lambda: self._writer.add_attachment(now, now, name, media_type, data))
        self.flush()

    def flush(self) -> None:
        """Closes the chunk in progress and hands it to the operating system: it survives a SIGKILL from here on."""
        self._guard(self._writer.flush)
        self.safe_messages, self._safe_bytes = self._messages, self._file.tell()
        self._flushed_at = time.monotonic()

    def close(self) -> None:
        """Finishes the file and writes metadata.yaml. Does nothing when closed already. Raises BagError."""
        if self._closed:
            return
        try:
            self._guard(self._finish)
        finally:
            self._closed = True
            self._drop_file()

    def discard(self) -> None:
        """Closes and removes what was made."""
        self._closed = True
        self._drop_file()
        for made in reversed(self._made):
            with suppress(OSError):  # a folder in which somebody has put something since stays
                made.rmdir() if made.is_dir() else made.unlink()

    def _finish(self) -> None:
        information = self._information()
        self._writer.add_metadata("rosbag2", {"ROS_DISTRO": ROS_DISTRO, "serialized_metadata": _yaml(information)})
        self._writer.finish()
        self._file.flush()
        if self._metadata.exists() and self.path.name not in _files_of(self._metadata):
            log.warning("%s is another recording's and stays; %s is whole without one", self._metadata, self.path)
            return
        self._made.append(self._metadata)
        self._metadata.write_text(_yaml({INFORMATION: information}))

    def _information(self) -> dict[str, Any]:
        first, last = self._times or (0, 0)
        span = {
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": self._messages,
        }
        topics = [{"topic_metadata": _topic_metadata(t), "message_count": t.messages} for t in self._topics.values()]
        return {
            "version": METADATA_VERSION,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.path.name],
            "files": [{"path": self.path.name, **span}],
            "custom_data": None,
            "ros_distro": ROS_DISTRO,
        }

    def _guard(self, act: Any) -> Any:
        """Runs `act`; after the first error of the disk every call fails with the same sentence."""
        if self._error:
            raise self._error
        if self._closed:
            raise BagError(f"{self.path} is closed; nothing more can be written to it.")
        try:
            return act()
        except OSError as error:
            self._error = BagError(f"writing {self.path} failed: {error.strerror}. {self._left}")
            log.error("%s", self._error)
            raise self._error from error

    @property
    def _left(self) -> str:
        """What a disk that refused has left, and what to do."""
        if self._source:
            return (f"{self._source} is as it was. Make room, then bring it back with: stmpl recover {self._source} "
                    f"--target {self.path}")  # fmt: skip
        if not self.safe_messages:
            return f"None of {self._messages} messages is safe on disk. Make room, and record into another folder."
        return (f"Safe on disk are the first {self.safe_messages} of {self._messages} messages "
                f"({self._safe_bytes / 1e6:.1f} MB, whole chunks). Make room, then bring them back with: "
                f"stmpl recover {self.path}")  # fmt: skip

    def _drop_file(self) -> None:
        """Closes the file; what a failed disk did not take is thrown away."""
        with suppress(OSError):
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._error and error:
            self._closed = True
            self._drop_file()
        else:
            self.close()


def _topic_metadata(topic: _Topic) -> dict[str, Any]:
    try:
        qos = YAML(typ="safe").load(topic.qos) or []
    except YAMLError:
        qos = []
    return {
        "name": topic.name,
        "type": topic.type_name,
        "serialization_format": topic.encoding,
        "offered_qos_profiles": qos,
        "type_description_hash": topic.type_hash,
    }


def _files_of(metadata: Path) -> list[str]:
    """The files of the recording that a metadata.yaml describes; none if it describes none."""
    try:
        return list(YAML(typ="safe").load(metadata.read_text())[INFORMATION]["relative_file_paths"])
    except (YAMLError, OSError, UnicodeDecodeError, TypeError, KeyError):
        return []


def _yaml(value: Any) -> str:
    stream = BytesIO()
    writer = YAML(typ="safe")
    writer.default_flow_style = False
    writer.representer.ignore_aliases = lambda *_: True  # yaml-cpp readers are happier without anchors
    writer.dump(value, stream)
    return stream.getvalue().decode()
