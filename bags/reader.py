"""Bag: reads a recording from its start with bounded memory, finished or not, and gives back core types."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from rosbags.typesys.store import Typestore

from bags.frame import Frame
from bags.provenance import LAYER, RECORD, Provenance, layer_from_bytes, provenance_from
from bags.records import Damage, End, bag_file, summary, walk
from bags.schema import typestore_of
from bags.wire import contact_from, frame_from, layer_from, stamp_ns, tool_from
from stmpl_core.contact import Contact
from stmpl_core.errors import BagError, FrameError
from stmpl_core.layer import SoftLayer, layer_id
from stmpl_core.tool import Tool

log = logging.getLogger(__name__)

DISPLACEMENT, TOPOLOGY, MESH = "skin/displacement", "skin/topology", "contact_mesh"


class Recorded(NamedTuple):
    """One message of a bag: topic, decoded message, and when it was received and published [ns]."""

    topic: str
    message: Any
    log_time_ns: int
    publish_time_ns: int


class Raw(NamedTuple):
    """One message of a bag as it came over the wire, and when it was received [ns]."""

    topic: str
    data: bytes
    log_time_ns: int


class Topic(NamedTuple):
    """One topic of a bag, with the number of its messages and the span of their log times [ns]."""

    name: str
    type_name: str
    messages: int
    first_ns: int
    last_ns: int


class Bag:
    """A recording, given by its folder or its .mcap file.

    A file whose writer was killed is read as far as it is sound; `damage` says what is not, and the log too.

    Raises:
        BagError: no such file, or no MCAP file.
    """

    def __init__(self, path: Path | str) -> None:
        self.file = bag_file(path)
        self.finished = False
        self.damage: list[Damage] = []
        self.topics: dict[str, Topic] = {}
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        index = summary(self.file)
        self.expected = index.messages  # that the writer counted, or None
        self._schemas, self._channels = dict(index.schemas), dict(index.channels)
        self._stores: dict[int, Typestore] = {}
        self._survey()

    def messages(self, wanted: Callable[[str], bool] | None = None) -> Iterator[Recorded]:
        """Yields the decoded messages in the order of the file, of those topics that `wanted` accepts.

        Raises:
            BagError: a schema is missing or cannot be parsed.
        """
        for record in walk(self.file):
            if isinstance(record, Message) and (channel := self._channels.get(record.channel_id)):
                if wanted is None or wanted(channel.topic):
                    decoded = self._decode(channel, record.data)
                    yield Recorded(channel.topic, decoded, record.log_time, record.publish_time)

    def raw(self, wanted: Callable[[str], bool]) -> Iterator[Raw]:
        """Yields the messages of the topics that `wanted` accepts in the order of the file, undecoded."""
        for record in walk(self.file):
            if isinstance(record, Message) and (channel := self._channels.get(record.channel_id)):
                if wanted(channel.topic):
                    yield Raw(channel.topic, record.data, record.log_time)

    def described(self, topic: str) -> tuple[str, str]:
        """Type hash and offered QoS profiles (YAML) of a topic; empty where the bag does not say. Raises KeyError."""
        told = {channel.topic: channel.metadata for channel in self._channels.values()}[topic]
        return told.get("topic_type_hash", ""), told.get("offered_qos_profiles", "")

    def find_topic(self, ending: str) -> str:
        """The one topic whose name ends with `ending`, whatever its namespace. Raises BagError."""
        found = [t for t in self.topics if _ends(t, ending)]
        if len(found) != 1:
            have = ", ".join(sorted(self.topics)) or "none"
            raise BagError(f"{self.file} has {len(found)} topics {ending}; one is needed. Topics: {have}.")
        return found[0]

    def frames(self) -> Iterator[Frame]:
        """Yields the recorded answers in the order of the file. Raises BagError if there is no such topic."""
        topic = self.find_topic(DISPLACEMENT)
        for recorded in self.messages(lambda name: name == topic):
            yield frame_from(recorded.message, recorded.log_time_ns)

    def layer_of(self, frame: Frame) -> SoftLayer:
        """The layer that `frame` answers for. Raises BagError if the bag does not hold it."""
        if frame.layer_id not in self.layers:
            raise BagError(f"answer {frame.sequence} is for layer {frame.layer_id}, the bag holds "
                           f"{', '.join(self.layers)}. Was skin/topology recorded?")  # fmt: skip
        return self.layers[frame.layer_id]

    @cached_property
    def provenance(self) -> Provenance:
        """What made the run; empty if the bag does not say."""
        return provenance_from(self.metadata.get(RECORD, {}))

    @cached_property
    def layers(self) -> dict[str, SoftLayer]:
        """The layers of the run by their names: an attached one, exact, then those that SkinTopology describes.

        There is more than one if the run spans `~/set_body` or `~/calibrate`.

        Raises:
            BagError: the bag has none.
        """
        found = {}
        if LAYER in self.attachments:
            layer = layer_from_bytes(self.attachments[LAYER])
            found[layer_id(layer)] = layer
            if not any(_ends(topic, TOPOLOGY) for topic in self.topics):
                return found
        for topology in self._topologies:
            if topology.layer_id not in found:
                found[topology.layer_id] = layer_from(topology)
        return found

    @property
    def has_layers(self) -> bool:
        """Whether the bag says what skin it is of."""
        told = [topic for topic in self.topics.values() if _ends(topic.name, TOPOLOGY) and topic.messages]
        return LAYER in self.attachments or len(told) == 1

    @property
    def layer(self) -> SoftLayer:
        """The first layer of the run. Raises BagError."""
        return next(iter(self.layers.values()))

    @cached_property
    def body_frame(self) -> str:
        """Frame id of the body, from SkinTopology. Raises BagError."""
        return self._topologies[0].header.frame_id

    @property
    def layer_id(self) -> str:
        """Name of the first layer. Raises BagError."""
        return next(iter(self.layers))

    @cached_property
    def tools(self) -> dict[str, Tool]:
        """The tools by their names."""
        topics = [t for t in self.topics if _ends(t, MESH)]
        found = self.messages(lambda name: name in topics)
        return {tool.name: tool for tool in (tool_from(r.message) for r in found if len(r.message.triangles))}

    @cached_property
    def _topologies(self) -> list[Any]:
        topic = self.find_topic(TOPOLOGY)
        found = [recorded.message for recorded in self.messages(lambda name: name == topic)]
        if not found:
            raise BagError(f"{self.file} holds no message on {topic}, so the skin is not known.")
        return found

    def _decode(self, channel: Channel, data: bytes) -> Any:
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            raise BagError(f"the schema of {channel.topic} is lost, so it cannot be decoded.")
        encodings = (channel.message_encoding, schema.encoding)
        if encodings != ("cdr", "ros2msg"):
            raise BagError(f"{channel.topic} is encoded as {' with '.join(encodings)}; only cdr with ros2msg is read.")
        if schema.id not in self._stores:
            self._stores[schema.id] = typestore_of([(schema.name, schema.data.decode(errors="replace"))])
        try:
            return self._stores[schema.id].deserialize_cdr(data, schema.name)
        except Exception as error:
            raise BagError(f"a message on {channel.topic} is no {schema.name}: {error}.") from error

    def _survey(self) -> None:
        spans: dict[int, list[int]] = {}
        for record in walk(self.file):
            match record:
                case Message():
                    span = spans.setdefault(record.channel_id, [0, record.log_time, record.log_time])
                    span[0] += 1
                    span[1], span[2] = min(span[1], record.log_time), max(span[2], record.log_time)
                case Schema():
                    self._schemas[record.id] = record
                case Channel():
                    self._channels[record.id] = record
                case Attachment():
                    self.attachments[record.name] = record.data
                case Metadata():
                    self.metadata[record.name] = record.metadata
                case Damage():
                    self.damage.append(record)
                case End():
                    self.finished = True
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            self.topics[channel.topic] = Topic(channel.topic, schema.name if schema else "?",
                                               *spans.get(number, (0, 0, 0)))  # fmt: skip
        self._warn()

    def _warn(self) -> None:
        for damage in self.damage:
            log.warning("%s: %s", self.file, damage)
        if not self.finished:
            log.warning("%s was not finished by its writer; at most its last chunk is missing", self.file)


class ContactLog:
    """Poses and wrenches of every tool by stamp: the contacts as they stood at any answered stamp.

    Memory grows with the number of poses (a few hundred bytes each), not with their meshes or answers.
    """

    def __init__(self, bag: Bag) -> None:
        self.received: dict[int, int] = {}  # stamp -> when the last contact message of that stamp was received [ns]
        self.pose_stamps: set[int] = set()
        self._bag = bag
        self._poses: dict[str, dict[int, Any]] = {}
        self._wrenches: dict[str, dict[int, Any]] = {}
        for recorded in bag.messages(lambda name: tool_topic(name) is not None):
            tool, kind = tool_topic(recorded.topic) or ("", "")
            stamp = stamp_ns(recorded.message)
            (self._poses if kind == "pose" else self._wrenches).setdefault(tool, {})[stamp] = recorded.message
            self.received[stamp] = max(self.received.get(stamp, 0), recorded.log_time_ns)
            if kind == "pose":
                self.pose_stamps.add(stamp)

    def at(self, frame: Frame) -> list[Contact]:
        """The contacts that `frame` answers: of each of its tools the pose and the wrench that it names.

        Raises:
            BagError: a pose, a wrench or a mesh that it answers is not in the bag.
        """
        return [self._contact(tool, *stamps) for tool, stamps in frame.inputs.items()]

    def _contact(self, tool: str, posed: int, pushed: int) -> Contact:
        known, pose = self._bag.tools.get(tool), self._poses.get(tool, {}).get(posed)
        wrench = self._wrenches.get(tool, {}).get(pushed)
        lacks = ["mesh"] * (known is None) + ["pose"] * (pose is None) + ["wrench"] * (pushed != 0 and wrench is None)
        if known is None or lacks:
            raise BagError(f"an answer to tool {tool} at {posed / 1e9:.3f} s cannot be repeated: "
                           f"the bag has no {' and no '.join(lacks)} for it.")
        frames = self._bag.provenance.frames
        try:
            return contact_from(known, pose, wrench, body_frame=self._bag.body_frame, frames=frames)
        except FrameError as error:
            raise BagError(f"{error} The recording carries the frames of stmpl record --frames, and none that "
                           "move (/tf).") from error  # fmt: skip


def tool_topic(topic: str) -> tuple[str, str] | None:
    """(tool, "pose" or "wrench") if the topic is of a tool: .../tools/NAME/pose."""
    parts = topic.split("/")
    if len(parts) >= 3 and parts[-3] == "tools" and parts[-1] in ("pose", "wrench"):
        return parts[-2], parts[-1]
    return None


def _ends(topic: str, ending: str) -> bool:
    return topic == ending or topic.endswith("/" + ending)
