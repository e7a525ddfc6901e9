"""Hearing: what comes in: tools, poses and wrenches; checked here, kept as the newest, handed on as instants."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible
from shape_msgs.msg import Mesh
from stmpl_msgs.msg import ContactMesh

from bags import wire
from stmpl_core.errors import FrameError, InvalidInput, StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance
from stmpl_core.tool import Tool
from stmpl_core.tools import Tools
from stmpl_ros.cdr import Read, read_pose, read_wrench
from stmpl_ros.diagnosis import Tally
from stmpl_ros.events import Events
from stmpl_ros.followed import Followed
from stmpl_ros.frames import Frames, read_frames
from stmpl_ros.gate import Gate
from stmpl_ros.gazebo import GazeboContacts
from stmpl_ros.inbox import Inbox, Instant
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.patience import Patience
from stmpl_ros.ticks import Ticks
from stmpl_ros.topics import KEPT, NEWEST, newest_within

ROS_NAME = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
MAX_NAME = 200  # letters of namespace and tool: a topic of ROS has 247, of which '/tools/' and '/contact_wrench' are 22


class Hearing:
    """Tools announce their surface on `contact_mesh`; from then on `tools/NAME/pose` and `tools/NAME/wrench` are heard.

    A message that cannot be used is refused with a line, and changes nothing. A surface counts once its distance field
    is built. A surface without triangles takes its tool away.

    Args:
        node: node that subscribes.
        config: settings as they are now.
        tools: tools in use.
        tally: counts of messages.

    Attributes:
        on_tool: callback with a tool whose field is to be built.
        on_removed: callback with the name of a tool that was taken away.
        on_instant: callback with every complete instant.
        on_time_back: callback for a simulated clock that was set back, once all is forgotten.
        backs: number of times that a simulated clock was set back since the last look at it.
        useless: why the last pose that could not be used could not, since it was last emptied.

    Raises:
        InvalidInput: a name in shape_tools that no tool can have.
    """

    def __init__(self, node: Node, config: Callable[[], NodeConfig], tools: Tools, tally: Tally) -> None:
        self._node, self._config = node, config
        self._check_shape_tools()
        self.gate = Gate(node, tally)
        self.events = Events(self.gate.say)
        self.now = Ticks(node)
        self.frames = Frames(config().frame, read_frames(config().frames, config().frame), node)
        self._patience = Patience(node, self.frames, lambda: config().tf_wait)
        self.gazebo = GazeboContacts(config(), self.frames) if config().gz_contacts else None
        self.inbox = Inbox(tools, config().frame, int(config().rest_after * wire.NANO), self.frames.at)
        self._followed = Followed(node, self.frames, config, self.now, self._say_lost, self._on_followed)
        self.now.on_back = self._on_time_back
        self.active, self.backs = False, 0
        self.layer: SoftLayer | None = None
        self.on_tool: Callable[[Tool], None] = lambda tool: None
        self.on_removed: Callable[[str], None] = lambda name: None
        self.on_instant: Callable[[Instant], None] = lambda instant: None
        self.on_time_back: Callable[[], None] = lambda: None
        self.useless = ""
        self._topics: list[Any] = []
        self._listened: dict[str, list[Any]] = {}  # subscriptions of each tool
        self._unknown: dict[str, str] = {}  # topics of poses at the last look, by tool, whose surface is not known
        self._strangers: set[str] = set()  # tools that were told of
        self._away: set[str] = set()  # tools that were taken away
        self._refused: dict[str, str] = {}  # why the newest surface of a tool cannot be used, in brackets
        self._standing: dict[str, str] = {}  # digest of the surface that such a tool is answered with

    def _check_shape_tools(self) -> None:
        for name in self._config().shape_tools:
            try:
                self._check(name)
            except InvalidInput as error:
                raise InvalidInput(f"shape_tools names '{name:.60}': {error}") from error

    @property
    def tools(self) -> Tools:
        """Tools in use."""
        return self.inbox.tools

    def open(self) -> None:
        """Listens for tools."""
        self._topics.append(self._listen(ContactMesh, "contact_mesh", self._on_mesh, KEPT))
        for name in self._config().shape_tools:
            self._topics.append(self._listen(Mesh, f"tools/{name}/mesh", partial(self._on_shape, name), KEPT))
        if self.gazebo:
            self._topics.append(self._listen(self.gazebo.kind, "gz_contacts", self._on_gazebo, NEWEST))

    def close(self) -> None:
        """Closes all topics, and forgets all tools."""
        for name in list(self._listened):
            self._stop_listening(name)
        self.inbox.tools = Tools(self.tools.margin)
        for subscription in self._topics:
            self._node.destroy_subscription(subscription)
        self._topics.clear()
        self._refused.clear()
        self._followed.close()
        self.forget()

    def forget(self) -> None:
        """Forgets every pose and wrench."""
        self._patience.forget()
        self._followed.forget()
        self.inbox.forget()

    def take(self, tool: Tool, field: SignedDistance) -> bool:
        """Takes a tool into use, its distance field being there; False if it is not wanted any more."""
        if not self.tools.expected(tool):
            return False
        if tool.name not in self._listened:
            self._listen_to(tool.name)
        self.tools.add(tool, field)
        if self._standing.get(tool.name) != tool.digest:  # else its field was built anew for another skin
            self._refused.pop(tool.name, None)
        for sentence in tool.mendings:
            self.gate.say(f"mended {tool.name} {sentence}", f"the mesh of '{tool.name}' was mended: {sentence}")
        if field.flipped:
            self.gate.say(f"inside out {tool.name}", f"the mesh of '{tool.name}' came inside out and was turned")
        if not field.watertight:
            self.gate.say(f"holes {tool.name}",
                          f"the mesh of '{tool.name}' has holes; what is inside it near them is a guess")
        return True

    def refuse(self, tool: Tool, error: BaseException) -> None:
        """Gives an announced tool up; the one of its name from before, if there is one, stays."""
        self.tools.withdraw(tool)
        self._refuse_mesh(tool.name, error)

    def _refuse_mesh(self, name: str, error: BaseException) -> None:
        why = f"mesh of '{name:.60}' refused: {error}"
        self._refused[name], self._standing[name] = f" ({why})", self.tools[name].digest if name in self.tools else ""
        self.gate.refuse(f"mesh of {name}", why)

    def outdated(self, name: str) -> str:
        """Sentence on a tool in use whose newest surface cannot be used; empty: it is the newest."""
        why = self._refused.get(name, "")
        return f"{name} is answered with its surface from before{why}" if why and name in self.tools else ""

    def look_for_outdated(self) -> list[str]:
        """The same of all tools that have one."""
        return list(filter(None, map(self.outdated, sorted(self._refused))))

    def look_for_strangers(self) -> str:
        """Which tools' poses are sent in vain, since their surface is not known, from the second look on; empty: none.

        Of each a line tells once.
        """
        before, self._unknown = self._unknown, {}
        tools = self._node.get_namespace().rstrip("/") + "/tools/"
        for topic, _ in self._node.get_topic_names_and_types():
            name = topic.removeprefix(tools).removesuffix("/pose")
            if topic == f"{tools}{name}/pose" and not self._knows(name) and self._node.count_publishers(topic):
                self._unknown[name] = topic
        said = {name: f"{self._unknown[name]} has a sender, but no surface of '{name}' that can be used is on "
                      f"contact_mesh: its poses are not heard{self._refused.get(name, '')}"
                for name in sorted(self._unknown.keys() & before.keys() - self._away)}  # fmt: skip
        for name in said.keys() - self._strangers:
            self._strangers.add(name)
            self.gate.say(f"stranger {name}", said[name])
        return "; ".join(said.values())

    def lost_frames(self) -> str:
        """Which tools that are frames of /tf it does not place any more, or never did; empty: none."""
        return "; ".join(self._followed.lost().values())

    def _say_lost(self, kind: str, why: str) -> None:
        if self.active:
            self.gate.say(kind, why)

    def rivals(self) -> str:
        """Who sends poses of one tool beside another; empty: no tool has two senders."""
        for name in self._listened:
            topic = self._node.resolve_topic_name(f"tools/{name}/pose")
            senders = [f"{one.node_namespace.rstrip('/')}/{one.node_name}"
                       for one in self._node.get_publishers_info_by_topic(topic)]  # fmt: skip
            if len(senders) > 1:
                return f"{topic} has {len(senders)} senders, {', '.join(sorted(senders))}; only one can be the tool"
        return ""

    def unheard(self) -> str:
        """Who sends to this node and is not heard, for it does not offer what is asked for; empty: nobody."""
        said = []
        for one in self._node.subscriptions:
            for sender in self._node.get_publishers_info_by_topic(one.topic_name):
                fits, why = qos_check_compatible(sender.qos_profile, one.qos_profile)
                if fits == QoSCompatibility.ERROR:
                    name = f"{sender.node_namespace.rstrip('/')}/{sender.node_name}"
                    why = "; ".join(part.removeprefix("ERROR: ") for part in why.strip(";").split(";"))
                    said.append(f"{one.topic_name}: {name} is not heard: {why}")
        return "; ".join(said)

    def _knows(self, name: str) -> bool:
        """Whether a tool is in use, or its field is being built."""
        return name in self.tools or any(tool.name == name for tool in self.tools.waiting())

    def _listen(self, kind: Any, topic: str, callback: Callable, profile: Any, *, raw: bool = False) -> Any:
        return self.events.subscribe(self._node, kind, topic, callback, profile, raw=raw)

    def _read(self, read: Read, data: bytes, what: str, take: Callable[[Any], None],
              refuse: Callable[[str, str], None]) -> None:  # fmt: skip
        """Hands on the message in these bytes."""
        try:
            message = read(data)
        except StmplError as error:
            return refuse(f"{what}, {type(error).__name__}", f"{what}: {error}")
        take(message)

    def _listen_to(self, name: str) -> None:
        def wrench(data: bytes) -> None:
            self._read(read_wrench, data, f"wrench of {name}", partial(self._on_wrench, name),
                       partial(self._refuse_wrench, name))  # fmt: skip

        def pose(data: bytes) -> None:
            self._read(read_pose, data, f"pose of {name}", partial(self._on_pose, name), self._refuse_pose)

        self._listened[name] = [self._listen(WrenchStamped, f"tools/{name}/wrench", wrench, NEWEST, raw=True)]
        if not self._followed.follow(name):
            poses = newest_within(self._config().deadline)
            self._listened[name].append(self._listen(PoseStamped, f"tools/{name}/pose", pose, poses, raw=True))

    def _stop_listening(self, name: str) -> None:
        for subscription in self._listened.pop(name, []):
            self._node.destroy_subscription(subscription)
        self._followed.leave(name)
        for stream in ("pose", "wrench"):
            self._patience.forget(f"{stream} of {name}")
        self.inbox.forget(name)

    def _on_shape(self, name: str, message: Mesh) -> None:
        self._announce(name, len(message.triangles), lambda: wire.tool_from_shape(message, name))

    def _on_mesh(self, message: ContactMesh) -> None:
        self._announce(message.header.frame_id, len(message.triangles), lambda: wire.tool_from(message))

    def _announce(self, name: str, triangles: int, read: Callable[[], Tool]) -> None:
        if not triangles:
            return self._take_away(name)
        self._away.discard(name)
        try:
            if name == self._config().frame:
                raise FrameError(f"'{name}' is the body's own frame, in whose axes its wrenches would be read; "
                                 "give the tool another name.")  # fmt: skip
            if name:
                self._check(name)
            tool = read()
        except StmplError as error:
            return self._refuse_mesh(name, error)
        if self.tools.known(tool):  # sent once more, for who came late: what it touched is not forgotten
            self._refused.pop(name, None)
        else:
            self.tools.announce(tool)
            self.on_tool(tool)

    def _check(self, name: str) -> None:
        """Raises InvalidInput for the name of a tool that no topics can have."""
        if not (ROS_NAME.fullmatch(name) and len(self._node.get_namespace() + name) <= MAX_NAME):
            raise InvalidInput("a tool's name must be a ROS name: letters, digits, _ and /, each part beginning "
                               f"with a letter or _, at most {MAX_NAME} letters with the namespace.")  # fmt: skip

    def _take_away(self, name: str) -> None:
        self._away.add(name)  # who takes a tool away may go on sending where it is
        self._refused.pop(name, None)
        if self._knows(name):
            self._stop_listening(name)
            self.tools.remove(name)
            self._node.get_logger().info(f"tool '{name}' is taken away")
            self.on_removed(name)

    def _on_pose(self, name: str, message: PoseStamped) -> None:
        if self._fresh_pose(name, message):
            self._patience.put(f"pose of {name}", message, partial(self._take_pose, name), self._refuse_pose)

    def _on_followed(self, name: str, message: PoseStamped) -> None:
        """A pose that /tf told."""
        if self._fresh_pose(name, message):
            self._take_pose(name, message)

    def _fresh_pose(self, name: str, message: PoseStamped) -> bool:
        if not self._hears(name):
            return False
        if not self.gate.fresh(wire.stamp_ns(message), self._config().max_age):
            self.useless = self.gate.dropped
            return False
        return True

    def _refuse_pose(self, kind: str, why: str) -> None:
        self.gate.refuse(kind, why)
        self.useless = why

    def _take_pose(self, name: str, message: PoseStamped) -> None:
        stamp = wire.stamp_ns(message)
        try:
            pose = wire.pose_of_tool(message, name, self._config().frame, self.frames.at(stamp))
        except StmplError as error:
            return self._refuse_pose(f"pose of {name}, {type(error).__name__}", str(error))
        if not self._stands("pose", name, stamp):
            self._go_on("pose", name, self.inbox.put_pose(name, pose, stamp, self.now()))

    def _on_wrench(self, name: str, message: WrenchStamped) -> None:
        if not self._hears(name):
            return
        if not self.gate.fresh(wire.stamp_ns(message), self._config().max_age):
            return self.inbox.refuse_wrench(name, self.gate.dropped, self.now())
        if message.header.frame_id == name:  # a tool's own frame is where its pose says, whatever /tf knows
            return self._take_wrench(name, message)
        self._patience.put(f"wrench of {name}", message, partial(self._take_wrench, name),
                           partial(self._refuse_wrench, name))  # fmt: skip

    def _refuse_wrench(self, name: str, kind: str, why: str) -> None:
        self.gate.refuse(kind, why)
        self.inbox.refuse_wrench(name, why, self.now())

    def _take_wrench(self, name: str, message: WrenchStamped) -> None:
        stamp = wire.stamp_ns(message)
        try:
            wire.wrench_from(message, body_frame=self._config().frame, tool=name, frames=self.frames.at(stamp),
                             pose_body_from_tool=np.eye(4))  # fmt: skip
        except StmplError as error:
            return self._refuse_wrench(name, f"wrench of {name}, {type(error).__name__}", str(error))
        if not self._stands("wrench", name, stamp):
            self._go_on("wrench", name, self.inbox.put_wrench(name, message, stamp, self.now()))

    def _stands(self, kind: str, name: str, stamp: int) -> bool:
        """Whether a message says no more than the last one: a simulation that is paused sends under one stamp."""
        return self.now.simulated and self.inbox.repeats(kind, name, stamp, self.now())

    def _on_time_back(self) -> None:
        """A simulation that begins anew: what it and its /tf said lies in its future."""
        self.backs += 1
        self.gate.say("clock", "the simulated clock went back: poses, wrenches and /tf from before are forgotten")
        self.frames.forget()
        self.forget()
        self.on_time_back()

    def look_at_clock(self) -> str:
        """Sentence on a simulated clock that was set back more than once since the last look; empty: it was not."""
        backs, self.backs = self.backs, 0
        return (f"the simulated clock went back {backs} times, and what was before is forgotten each time: do two "
                "simulations send /clock?") * (backs > 1)  # fmt: skip

    def look(self) -> str:
        """Looks at the clock by which silence counts; sentence on a simulated one that is gone; empty: it is not."""
        self.now.look(self.gate.stamp)
        self.gate.clock = self.now.doubt
        return self.now.doubt

    def _on_gazebo(self, message: Any) -> None:
        assert self.gazebo and self.layer
        try:
            for name, wrench in self.gazebo.wrenches(message, self.layer, self.inbox):
                self._on_wrench(name, wrench)
        except StmplError as error:
            self.gate.refuse("gz_contacts", str(error))

    def _hears(self, name: str) -> bool:
        return self.active and name in self.tools

    def _go_on(self, kind: str, tool: str, kept: bool) -> None:
        if not kept:
            self.gate.drop(f"order of {kind} of {tool}", f"a {kind} of {tool} was dropped: its stamp is not after the "
                           "last one's. Do two devices send under one name, or was a clock set back?")  # fmt: skip
        try:
            instant = self.inbox.take(self.now())
        except StmplError as error:  # a frame that /tf has forgotten since
            return self.gate.refuse(f"instant, {type(error).__name__}", str(error))
        if instant is not None:
            self.on_instant(instant)
