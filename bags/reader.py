"""Bag: reads a recording from its start with bounded memory, finished or not, and gives back core types."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from rosbags.typesys.store import Typestore

from bags.frame import Frame
from bags.moving import TF, TF_STATIC
from bags.provenance import LAYER, RECORD, Provenance, layer_from_bytes, provenance_from
from bags.records import Damage, End, Place, Record, bag_file, read_places, summary, walk, walk_places
from bags.schema import typestore_of
from bags.wire import frame_from, layer_from, tool_from
from stmpl_core.errors import BagError, StmplError
from stmpl_core.layer import SoftLayer, layer_id
from stmpl_core.posing import posed
from stmpl_core.tool import Tool

log = logging.getLogger(__name__)

DISPLACEMENT, TOPOLOGY, MESH = "skin/displacement", "skin/topology", "contact_mesh"
TYPES = {
    DISPLACEMENT: "stmpl_msgs/msg/SkinDisplacement",
    TOPOLOGY: "stmpl_msgs/msg/SkinTopology",
    MESH: "stmpl_msgs/msg/ContactMesh",
    TF: "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
}  # of the topics that are read, by their endings
TOOL_TYPES = {"pose": "geometry_msgs/msg/PoseStamped", "wrench": "geometry_msgs/msg/WrenchStamped"}  # a tool's
_OF_ROBOT = re.compile(r"(?:(.*)/)?(?:skin/\w+|contact_mesh)")  # topics of a robot's run
_TOOLS = re.compile(r"(?:^|/)(?=tools/)")  # where a namespace may end
_OF_TOOL = re.compile(r"(?:(.*)/)?tools/(.+)/(pose|wrench|mesh|contact_wrench|local_contact)")  # NAME may hold "/"


class Recorded(NamedTuple):
    """One message of a bag: topic, decoded message, and when it was received [ns]."""

    topic: str
    message: Any
    log_time_ns: int


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


def _together(one: Topic, other: Topic) -> Topic:
    """Two channels of one topic, as a file that was merged of several has them."""
    if not (one.messages and other.messages):
        return one if one.messages else other
    return one._replace(messages=one.messages + other.messages, first_ns=min(one.first_ns, other.first_ns),
                        last_ns=max(one.last_ns, other.last_ns))  # fmt: skip


class Bag:
    """A recording, given by its folder or its .mcap file, looked over once.

    Of the large messages (skins, tools' surfaces, answers) only the places are kept; they are read when asked for.
    A file whose writer was killed is read as far as it is sound; `damage` says what is not, and the log too.

    Args:
        path: path of a folder, or of the .mcap file.
        namespace: namespace of the one robot that is meant, "/left"; "": all topics.

    Raises:
        BagError: a file that is missing or no MCAP file, or a namespace that is not in it.
    """

    def __init__(self, path: Path | str, namespace: str = "") -> None:
        self.file = bag_file(path)
        self.namespace = namespace and "/" + namespace.strip("/")
        self.finished = False
        self.damage: list[Damage] = []
        self.topics: dict[str, Topic] = {}
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        index = summary(self.file)
        self.expected = index.messages  # that the writer counted, or None
        self._schemas, self._channels = dict(index.schemas), dict(index.channels)
        self._spaces: dict[str, str | None] = {}  # namespaces of the topics that were asked for, by all channels so far
        self._stores: dict[int, Typestore] = {}
        self._places: dict[str, list[Place]] = {}  # of the large messages, by topic
        self._received: dict[Place, int] = {}  # log times of the answers [ns]
        self._layers: dict[str, SoftLayer] = {}  # that were read so far
        self._posed: tuple[str, tuple[float, ...], SoftLayer] | None = None  # the last that was asked for, bent
        self._layers_read: dict[str, int] = {}  # number of messages, by topic
        self._look_over()

    @property
    def namespaces(self) -> list[str]:
        """Namespaces of the robots in the file, whether asked for or not; "/" where a robot has none."""
        found = (self._namespace_of(one.topic) for one in self._channels.values() if not self._odd_type(one))
        return sorted({namespace for namespace in found if namespace is not None})

    def messages(self, wanted: Callable[[str], bool] | None = None) -> Iterator[Recorded]:
        """Yields the decoded messages in the order of the file, of those topics that `wanted` accepts.

        Raises:
            BagError: a schema is missing or cannot be parsed.
        """
        for topic, record in self._walk(wanted or (lambda _: True)):
            yield Recorded(topic, self.decode(record), record.log_time)

    def raw(self, wanted: Callable[[str], bool]) -> Iterator[Raw]:
        """Yields the messages of the topics that `wanted` accepts in the order of the file, undecoded."""
        for topic, record in self._walk(wanted):
            yield Raw(topic, record.data, record.log_time)

    def decode(self, record: Message) -> Any:
        """The message that a record carries. Raises BagError if its schema is lost or does not fit."""
        channel = self._channels[record.channel_id]
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            raise BagError(f"the schema of {channel.topic} is lost, so it cannot be decoded.")
        encodings = (channel.message_encoding, schema.encoding)
        if encodings != ("cdr", "ros2msg"):
            raise BagError(f"{channel.topic} is encoded as {' with '.join(encodings)}; only cdr with ros2msg is read.")
        if schema.id not in self._stores:
            self._stores[schema.id] = typestore_of([(schema.name, schema.data.decode(errors="replace"))])
        try:
            return self._stores[schema.id].deserialize_cdr(record.data, schema.name)
        except Exception as error:
            raise BagError(f"a message on {channel.topic} is no {schema.name}: {error}.") from error

    def read[T](self, record: Message, how: Callable[..., T], *more: Any) -> T:
        """What `how` makes of the message that a record carries, and of `more`. Raises BagError as `decode`."""
        message = self.decode(record)
        with fields_of(self._channels[record.channel_id].topic):
            return how(message, *more)

    def described(self, topic: str) -> tuple[str, str]:
        """Type hash and offered QoS profiles (YAML) of a topic; empty where the bag does not say. Raises KeyError."""
        told = {channel.topic: channel.metadata for channel in self._channels.values()}[topic]
        return told.get("topic_type_hash", ""), told.get("offered_qos_profiles", "")

    def find_topic(self, ending: str) -> str:
        """The one topic whose name ends with `ending`, whatever its namespace. Raises BagError."""
        names = {one.topic for one in self._channels.values() if self._is_meant(one.topic) and not self._odd_type(one)}
        found = [name for name in names if ends(name, ending)]
        if len(found) > 1:
            spaces = sorted(name.removesuffix(ending).rstrip("/") or "/" for name in found)
            raise BagError(f"{self.file} holds {len(found)} robots, of the namespaces {', '.join(spaces)}. "
                           "Name one of them with --namespace.")  # fmt: skip
        if not found:
            have = ", ".join(sorted(names)) or "none"
            raise BagError(f"{self.file} has no topic {ending}; one is needed. Topics: {have}.")
        return found[0]

    @property
    def answers(self) -> int:
        """Number of recorded answers. Raises BagError if there is no such topic."""
        return len(self._places.get(self.find_topic(DISPLACEMENT), ()))

    def frames(self, numbers: Iterable[int] | None = None) -> Iterator[Frame]:
        """Yields recorded answers by their numbers, from 0, in the order in which they were received; all unless given.

        Raises:
            BagError: there is no topic of answers.
        """
        places = self._places.get(self.find_topic(DISPLACEMENT), [])
        wanted = places if numbers is None else [places[number] for number in numbers]
        for record in read_places(self.file, wanted):
            yield self.read(record, frame_from, record.log_time)

    def layer_of(self, frame: Frame) -> SoftLayer:
        """The layer that `frame` answers for, where its joints took it. Raises BagError if the bag does not hold it."""
        rest = self.rest_of(frame)
        if not any(frame.joints):
            return rest
        if self._posed is None or self._posed[:2] != (frame.layer_id, frame.joints):
            self._posed = frame.layer_id, frame.joints, posed(rest, frame.joints)
        return self._posed[2]

    def rest_of(self, frame: Frame) -> SoftLayer:
        """The layer that `frame` answers for, its joints at rest.

        Raises:
            BagError: the bag does not hold it, or the answer's angles are not those of its joints.
        """
        if frame.layer_id not in self.layers:
            raise BagError(f"answer {frame.sequence} is for layer {frame.layer_id}, the bag holds "
                           f"{', '.join(self.layers)}. Was skin/topology recorded?")  # fmt: skip
        rest, angles = self.layers[frame.layer_id], frame.joints
        if any(angles) and (rest.rig is None or len(rest.rig.joints) != len(angles) or not np.isfinite(angles).all()):
            raise BagError(f"answer {frame.sequence} has joints at {', '.join(map(str, angles))} rad; its layer has "
                           f"{', '.join(rest.rig.names) if rest.rig else 'no joints'}.")  # fmt: skip
        return rest

    @cached_property
    def provenance(self) -> Provenance:
        """Origin of the run; empty if the bag does not tell it."""
        return provenance_from(self.metadata.get(RECORD, {}))

    @cached_property
    def method(self) -> str:
        """Name of the method that answered, by the provenance, else by the first answer; empty if neither says."""
        return self.provenance.method or next((frame.method for frame in self.frames()), "")

    @cached_property
    def layers(self) -> dict[str, SoftLayer]:
        """The layers of the run by their names: an attached one, exact, then those that SkinTopology describes.

        There is more than one if the run spans `~/set_body` or `~/calibrate`.

        Raises:
            BagError: the bag has none, or those of several robots.
        """
        found = self.known_layers()
        topic = None if found and not self._told(TOPOLOGY) else self.find_topic(TOPOLOGY)
        if not found:
            raise BagError(f"{self.file} holds no message on {topic}, so the skin is not known.")
        return found

    def known_layers(self) -> dict[str, SoftLayer]:
        """The layers of all robots by their names, as far as the file was looked over; none if it holds none."""
        if LAYER in self.attachments and LAYER not in self._layers_read:
            layer, self._layers_read[LAYER] = layer_from_bytes(self.attachments[LAYER]), 1
            self._layers = {layer_id(layer): layer} | {k: v for k, v in self._layers.items() if k != layer_id(layer)}
        for topic in self._told(TOPOLOGY):
            places, read = self._places[topic], self._layers_read.get(topic, 0)
            self._layers_read[topic] = len(places)
            for record in read_places(self.file, places[read:]):
                name = self.read(record, lambda topology: topology.layer_id)
                if name not in self._layers:
                    self._layers[name] = self.read(record, layer_from)
        return self._layers

    @property
    def layer(self) -> SoftLayer:
        """The first layer of the run. Raises BagError."""
        return next(iter(self.layers.values()))

    @cached_property
    def body_frame(self) -> str:
        """Frame id of the body, from SkinTopology. Raises BagError."""
        topic = self.find_topic(TOPOLOGY)
        for record in read_places(self.file, self._places.get(topic, [])[:1]):
            return self.read(record, lambda topology: topology.header.frame_id)
        raise BagError(f"{self.file} holds no message on {topic}, so the body's frame is not known.")

    @property
    def layer_id(self) -> str:
        """Name of the first layer. Raises BagError."""
        return next(iter(self.layers))

    @property
    def tools(self) -> dict[str, Tool]:
        """The tools by their names; the last surface of one that was changed. What a node refuses is left out."""
        return {tool.name: tool for tool in self._surfaces}

    def surface(self, name: str, digest: str) -> Tool | None:
        """A tool with a surface of that name (Tool.digest), its last one if that is empty; None: it is not there."""
        some = [tool for tool in self._surfaces if tool.name == name and digest in ("", tool.digest)]
        return some[-1] if some else None

    @cached_property
    def _surfaces(self) -> list[Tool]:
        """All surfaces that tools had, in the order in which they had them last."""
        places = sorted(place for topic in self._told(MESH) for place in self._places[topic])
        found: dict[tuple[Any, ...], Tool] = {}
        for record in read_places(self.file, places):
            name, *arrays = self.read(record, lambda one: (one.header.frame_id, one.vertices, one.triangles))
            if not len(arrays[1]):
                continue
            same = name, *(np.asarray(one).tobytes() for one in arrays)
            try:
                found[same] = found.pop(same, None) or self.read(record, tool_from)
            except StmplError as error:
                log.warning("%s: a surface of '%s' is left out: %s", self.file, name, error)
        return list(found.values())

    def see(self, topic: str, record: Message, place: Place) -> None:
        """Called for each message while the file is looked over; keeps the places of the large ones."""
        if ends(topic, DISPLACEMENT) or ends(topic, TOPOLOGY) or ends(topic, MESH):
            self._places.setdefault(topic, []).append(place)
        if ends(topic, DISPLACEMENT):
            self._received[place] = record.log_time

    def _told(self, ending: str) -> list[str]:
        """Topics with messages whose names end with `ending`."""
        return [topic for topic in self._places if ends(topic, ending)]

    def _is_meant(self, topic: str) -> bool:
        """The topic is of the robot that is meant, or of none."""
        if not self.namespace:
            return True
        around = [name for name in self.namespaces if name != "/" and topic.startswith(name + "/")]
        return (self._namespace_of(topic) or max(around, key=len, default=None)) in (None, self.namespace)

    def _namespace_of(self, topic: str) -> str | None:
        """Namespace of the robot that a topic is of, "/" for none; None if the topic is of no robot's run.

        A namespace may hold "tools", and so may a tool's name: a tool is of the robot of whose skin there is a topic.
        """
        if topic not in self._spaces:
            found = _OF_TOOL.fullmatch(topic) or _OF_ROBOT.fullmatch(topic)
            space = found and (found[1] or "/")
            if found and found.re is _OF_TOOL:
                ways = {topic[: at.start()] or "/" for at in _TOOLS.finditer(topic)}
                space = max(ways & self._robots(), key=len, default=space)
            self._spaces[topic] = space
        return self._spaces[topic]

    def _robots(self) -> set[str]:
        """Namespaces of the robots of whose skin, or of whose tools' surfaces, there is a topic."""
        others = [one.topic for one in self._channels.values() if not self._odd_type(one)]
        found = [_OF_ROBOT.fullmatch(topic) for topic in others if not _OF_TOOL.fullmatch(topic)]
        return {one[1] or "/" for one in found if one}

    def _odd_type(self, channel: Channel) -> str:
        """Type of a topic of a run that carries another one than it has to; empty: the right one, or it is lost."""
        schema, expected = self._schemas.get(channel.schema_id), type_of(channel.topic)
        return schema.name if schema and expected and schema.name != expected else ""

    def _walk(self, wanted: Callable[[str], bool]) -> Iterator[tuple[str, Message]]:
        topics = {number: channel.topic for number, channel in self._channels.items()
                  if channel.topic in self.topics and wanted(channel.topic)}  # fmt: skip
        for record in walk(self.file):
            if isinstance(record, Message) and record.channel_id in topics:
                yield topics[record.channel_id], record

    def _look_over(self) -> None:
        spans: dict[int, list[int]] = {}
        early: list[Place] = []  # messages before the description of their channel, where the first one was lost
        for place, record in walk_places(self.file):
            if isinstance(record, Message):
                span = spans.setdefault(record.channel_id, [0, record.log_time, record.log_time])
                span[0] += 1
                span[1], span[2] = min(span[1], record.log_time), max(span[2], record.log_time)
                if not self._show(record, place):
                    early.append(place)
            else:
                self._take(record)
        for place, record in zip(early, read_places(self.file, early), strict=True):
            self._show(record, place)
        for topic in self._told(DISPLACEMENT):  # a file may hold them in any order
            self._places[topic].sort(key=self._received.__getitem__)
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema_id)
            if self._is_meant(channel.topic):
                topic = Topic(channel.topic, schema.name if schema else "?", *spans.get(number, (0, 0, 0)))
                before = self.topics.get(topic.name)
                self.topics[topic.name] = topic if before is None else _together(before, topic)
        if self.namespace and self.namespace not in self.namespaces:
            raise BagError(f"{self.file} holds no robot of the namespace {self.namespace}; "
                           f"there: {', '.join(self.namespaces) or 'none'}.")  # fmt: skip
        self._warn()

    def _show(self, record: Message, place: Place) -> bool:
        """Lets `see` have a message that is meant; False if its topic is not known (yet)."""
        channel = self._channels.get(record.channel_id)
        if channel and self._is_meant(channel.topic) and not self._odd_type(channel):
            self.see(channel.topic, record, place)
        return channel is not None

    def _take(self, record: Record) -> None:
        match record:
            case Schema():
                self._schemas[record.id] = record
            case Channel():
                self._channels[record.id] = record
                self._spaces.clear()
            case Attachment():
                self.attachments[record.name] = record.data
            case Metadata():
                self.metadata[record.name] = record.metadata
            case Damage():
                self.damage.append(record)
            case End():
                self.finished = True

    def _warn(self) -> None:
        for damage in self.damage:
            log.warning("%s: %s", self.file, damage)
        for channel in self._channels.values():
            if (kind := self._odd_type(channel)) and self._is_meant(channel.topic):
                log.warning("%s: %s is left out: it carries %s, and a run's carries %s", self.file, channel.topic, kind,
                            type_of(channel.topic))  # fmt: skip
        if not self.finished:
            log.warning("%s was not finished by its writer; at most its last chunk is missing", self.file)


@cache
def tool_kind(topic: str) -> str:
    """"pose" or "wrench" if the topic is a tool's: .../tools/NAME/pose; empty: it is not."""
    found = _OF_TOOL.fullmatch(topic)
    return found[3] if found and found[3] in TOOL_TYPES else ""


@cache
def type_of(topic: str) -> str:
    """Type that a topic of a run has to have to be read; empty: any."""
    kind = tool_kind(topic)
    return TOOL_TYPES[kind] if kind else next((TYPES[e] for e in TYPES if ends(topic, e)), "")


@contextmanager
def fields_of(topic: str) -> Iterator[None]:
    """While inside, a message without a field, which the file defines otherwise than it is read, is a BagError."""
    try:
        yield
    except AttributeError as error:
        if (kind := getattr(error.obj, "__msgtype__", None)) is None:
            raise
        raise BagError(f"a message on {topic} cannot be read: the file defines {kind} without a field "
                       f"'{error.name}'.") from error  # fmt: skip


def ends(topic: str, ending: str) -> bool:
    """The topic is `ending`, in whatever namespace."""
    return topic == ending or topic.endswith("/" + ending)
