"""LinkNode: soft skin for a simulator that publishes the poses of its links and takes wrenches on them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import ok
from rclpy.validate_topic_name import validate_topic_name

from bags.wire import NANO, pose_from, stamp_ns, wrench_message
from stmpl_core.arrays import Points, Transform, Wrench
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.tool import Tool
from stmpl_ros.diagnosis import Tally
from stmpl_ros.gate import Gate
from stmpl_ros.making import Build, faded, friction_of, layer_of
from stmpl_ros.parameters import LinksConfig
from stmpl_ros.sending import LAST_WORD_S
from stmpl_ros.settings import checked
from stmpl_ros.spinning import ros, spin
from stmpl_ros.topics import STREAM
from stmpl_sim.protocol import Memory, Poses, Reaction, SoftContact, exchange

POLL_PERIOD_S = 0.05  # time between two looks whether the simulator fell silent
LONGEST_WAIT_S = 2.0  # time that poses may come without a whole instant until that is told


@dataclass
class Link:
    """Newest pose of a link.

    Args:
        pose: pose_world_from_link, (4, 4).
        stamp: its stamp [ns].
        count: number of poses that came.
    """

    pose: Transform
    stamp: int
    count: int = 1


class RosWorld:
    """The World of a simulator over ROS: poses as they came, wrenches as they go out.

    An instant is whole once all links that move have a pose of one stamp. A link that sent one pose when another has
    sent three stands still. Where a link's stamps go back, the simulator began anew: what stood still stays there.

    Args:
        body: name of the link that carries the skin.
        tools: names of the links that may touch.
        send: function that sends the wrench on a link, by its name, world axes, about the link's origin; with the
            link's pose and the stamp [ns].
    """

    def __init__(self, body: str, tools: Iterable[str], send: Callable[[str, Wrench, Transform, int], None]) -> None:
        self.body, self.tools, self._send = body, tuple(tools), send
        self.links: dict[str, Link] = {}
        self._stamp = 0  # of the pose that came last [ns]

    def put(self, name: str, pose: Transform, stamp: int) -> bool:
        """Keeps a pose; True if the instant of its stamp is whole now."""
        known = self.links.get(name)
        if known is not None and stamp < known.stamp:
            self.links = {one: Link(link.pose, stamp - 1) for one, link in self.links.items() if link.count == 1}
            known = self.links.get(name)
        if known is not None and stamp == known.stamp:
            return False
        self._stamp = stamp
        self.links[name] = Link(pose, stamp, known.count + 1 if known else 1)
        most = max(link.count for link in self.links.values())
        moving = {link.stamp for link in self.links.values() if link.count > 1 or most == 2}
        return len(self.links) == 1 + len(self.tools) and moving <= {stamp}

    def poses(self) -> Poses:
        """Places of the newest instant."""
        return Poses(self.links[self.body].pose, {name: self.links[name].pose for name in self.tools})

    def push(self, reaction: Reaction) -> None:
        """Sends the wrenches of the newest instant."""
        for name, wrench in (*reaction.tools.items(), (self.body, reaction.body)):
            self._send(name, wrench, self.links[name].pose, self._stamp)

    def lacks(self) -> str:
        """What keeps an instant from being whole, for people."""
        if unheard := [name for name in (self.body, *self.tools) if name not in self.links]:
            return f"poses come, but none of {', '.join(unheard)}: no wrench is sent"
        if not any(link.stamp for link in self.links.values()):
            return "poses come, but without a stamp (time 0): no wrench is sent. Their sender must say when they hold"
        newest = ", ".join(f"{name} {link.stamp / NANO:.6f} s" for name, link in self.links.items())
        return f"poses come, but not with one stamp: no wrench is sent. The newest are of {newest}"

    def let_go(self) -> None:
        """Sends that nothing pushes any more."""
        for name, link in self.links.items():
            self._send(name, np.zeros(6), link.pose, link.stamp)


class LinkNode(Node):
    """Answers each instant of a simulator with the wrenches of soft skin on one of its links.

    Args:
        config: settings.
        contact: skin and the tools that may touch it, by the names of their links.

    Raises:
        InvalidInput: a package that is needed is not installed.
    """

    def __init__(self, config: LinksConfig, contact: SoftContact) -> None:
        super().__init__("links")
        self.config, self.contact, self.memory = config, contact, Memory()
        self.world = RosWorld(config.body, contact.tools, self._send)
        self.gate = Gate(self, Tally())
        self._last: int | None = None  # stamp of the last instant [ns]
        self._heard, self._idle = time.monotonic(), True
        self._waits: float | None = None  # since when poses come without a whole instant
        self._about = points_of(config.about, (config.body, *contact.tools))
        self._frame, self._frames = "world", set[str]()
        names = (config.body, *contact.tools)
        if config.wrench_type == "entity":
            self._entity = _entity_wrench()
            one = self.create_publisher(self._entity, config.wrenches, STREAM)
            self._sinks: dict[str, Any] = dict.fromkeys(names, one)
        else:
            self._sinks = {name: self.create_publisher(WrenchStamped, topic_of(config.wrenches, name), STREAM)
                                for name in names}  # fmt: skip
        if config.pose_type == "tf":
            self.create_subscription(_tf_message(), "/tf", self._on_tf, STREAM)
        else:
            kind = PoseStamped if config.pose_type == "pose" else Odometry
            for name in names:
                self.create_subscription(kind, topic_of(config.poses, name), partial(self._on_pose, name), STREAM)
        self.create_timer(POLL_PERIOD_S, self._look)

    def _on_pose(self, name: str, message: Any) -> None:
        pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
        self._hear_frame(message.header.frame_id)
        self._put(name, pose, stamp_ns(message))

    def _on_tf(self, message: Any) -> None:
        for one in message.transforms:
            if one.child_frame_id in self._sinks:
                self._hear_frame(one.header.frame_id)
                moved = one.transform
                self._put(one.child_frame_id, _Pose(moved.translation, moved.rotation), stamp_ns(one))

    def _hear_frame(self, frame: str) -> None:
        self._frame = frame or self._frame
        if frame and frame not in self._frames:
            self._frames.add(frame)
            if len(self._frames) > 1:
                self.gate.say(f"frame {frame}", f"poses come in the frames {', '.join(sorted(self._frames))}: each is "
                              "taken as the world's, so they have to be one")  # fmt: skip

    def _put(self, name: str, pose: Any, stamp: int) -> None:
        now = time.monotonic()
        self._waits = self._waits or now
        try:
            if self.world.put(name, pose_from(pose), stamp):
                self._waits = None
                if self._last is not None and stamp < self._last:  # the simulator was reset
                    self.memory, self._last = Memory(), None
                dt = 0.0 if self._last is None else (stamp - self._last) / NANO
                reaction = exchange(self.contact, self.world, self.memory, dt)
                self.memory = reaction.memory
                for touch in reaction.touches.values():
                    if touch.presses and touch.trust.in_range is False:
                        self.gate.say(f"trust of {touch.name}", f"not to be relied upon: {touch.trust.why}")
                self._last, self._heard, self._idle = stamp, now, False
        except StmplError as error:
            self.gate.refuse(f"pose of {name}", str(error))

    def let_go(self) -> None:
        """Sends, unless that was said, that nothing pushes any more: simulators may keep the last wrench."""
        if not self._idle and ok():
            self._idle = True
            self.world.let_go()
            for sink in set(self._sinks.values()):
                sink.wait_for_all_acked(Duration(seconds=LAST_WORD_S))

    def _look(self) -> None:
        now = time.monotonic()
        if now - self._heard > self.config.silence:
            self.let_go()
        if self._waits is not None and now - self._waits > LONGEST_WAIT_S:
            self._waits = None
            self.gate.say("instant", self.world.lacks())

    def _send(self, name: str, wrench: Wrench, pose: Transform, stamp: int) -> None:
        wrench = moved_to(wrench, pose[:3, :3] @ self._about.get(name, np.zeros(3)))
        frame = self._frame
        if self.config.axes == "link":
            wrench, frame = np.concatenate([wrench[:3] @ pose[:3, :3], wrench[3:] @ pose[:3, :3]]), name
        message = wrench_message(wrench, frame, stamp)
        if self.config.wrench_type == "entity":
            message = entity_message(self._entity, name, message)
        self._sinks[name].publish(message)


@dataclass(frozen=True)
class _Pose:
    position: Any
    orientation: Any


def moved_to(wrench: Wrench, shift: np.ndarray) -> Wrench:
    """The same wrench about another point: the moment becomes m - shift x f.

    Args:
        wrench: force [N] and moment [N m], (6,).
        shift: vector to the other point, same axes, (3,) [m].
    """
    return np.concatenate([wrench[:3], wrench[3:] - np.cross(shift, wrench[:3])])


def entity_message(kind: Any, link: str, wrench: Any) -> Any:
    """A WrenchStamped on a link as ros_gz_interfaces/EntityWrench.

    Args:
        kind: class of the message.
        link: name of the link in Gazebo, scoped: model::link.
        wrench: wrench, world axes.
    """
    message = kind(header=wrench.header, wrench=wrench.wrench)
    message.entity.name, message.entity.type = link, type(message.entity).LINK
    return message


def topic_of(pattern: str, link: str) -> str:
    """Topic of a link: its name in place of {link}, with / where simulators scope by ::. Raises InvalidInput."""
    if "{link}" not in pattern:
        raise InvalidInput(f"topic '{pattern}' does not say where the link's name goes, as in 'links/{{link}}/pose'.")
    topic = pattern.replace("{link}", link.replace("::", "/"))
    try:
        validate_topic_name(topic)
    except InvalidTopicNameException as error:
        why = str(error).splitlines()[0].partition(": ")[2].rstrip(":")
        raise InvalidInput(f"'{topic}' cannot be a topic: {why}. Try another --poses or --wrenches, or another "
                           "name of the link.") from error  # fmt: skip
    return topic


def points_of(said: Sequence[str], links: Sequence[str]) -> dict[str, Points]:
    """Points by the name of the link, (3,) [m], from link=x,y,z. Raises InvalidInput."""
    found = {}
    for text in said:
        link, _, point = text.rpartition("=")
        try:
            found[link] = np.array([float(part) for part in point.split(",")]).reshape(3)
        except ValueError:
            raise InvalidInput(f"'{text}' is no link=x,y,z, as in 'tip=0,0,0.02'.") from None
        if not np.isfinite(found[link]).all():
            raise InvalidInput(f"'{text}' is no place: its numbers have to be finite, as in 'tip=0,0,0.02'.")
        if link not in links:
            raise InvalidInput(f"there is no link '{link}'; known are {', '.join(links)}.")
    return found


def tools_of(said: Sequence[str]) -> list[Tool]:
    """Tools from link=file. Raises InvalidInput or MeshError."""
    from stmpl_ros.view.tools import tool_from_bytes

    tools = []
    for text in said:
        link, _, file = text.rpartition("=")
        if not link or not Path(file).is_file():
            raise InvalidInput(f"'{text}' is no link=file of a mesh that is there, as in 'tip=tip.stl'.")
        tools.append(tool_from_bytes(file, Path(file).read_bytes()).named(link))
    return tools


def _entity_wrench() -> Any:
    try:
        from ros_gz_interfaces.msg import EntityWrench  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InvalidInput(f"wrenches of type entity need the package ros_gz_interfaces: {error}.") from error
    return EntityWrench


def _tf_message() -> Any:
    try:
        from tf2_msgs.msg import TFMessage  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InvalidInput(f"poses of type tf need the package tf2_msgs: {error}.") from error
    return TFMessage


def run(config: LinksConfig, arguments: Sequence[str] | None = None, build: Build = layer_of,
        tools: Sequence[Tool] | None = None) -> int:  # fmt: skip
    """Answers a simulator until SIGINT, SIGTERM or SIGHUP.

    Args:
        config: settings.
        arguments: arguments of ROS.
        build: function that makes the layer from a NodeConfig.
        tools: tools by the names of their links; read from the files of the settings unless given.

    Raises:
        InvalidInput: settings that cannot be, a file that cannot be read, or a package that is missing.
    """
    settings = checked(config.model_dump(include={"part", "tissue", "edge_length", "friction", "relaxing"}))
    layer = faded(build(settings), settings)
    contact = SoftContact(layer, tools or tools_of(config.tools), settings.new_method(), damping=config.damping,
                          friction=friction_of(settings))  # fmt: skip
    if config.body in contact.tools:
        raise InvalidInput(f"'{config.body}' carries the skin and is a tool as well; a link cannot touch itself.")
    with ros(list(arguments or ())) as stop:
        node = LinkNode(config, contact)
        node.get_logger().info(f"skin of '{config.body}': {layer}; tools: {', '.join(contact.tools)}")
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        try:
            spin(executor, stop)
        finally:
            node.let_go()
            executor.shutdown()
            node.destroy_node()
    return 0
