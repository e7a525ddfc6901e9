"""Sending: all topics that the node publishes answers on, opened and closed together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.publisher import Publisher
from stmpl_msgs.msg import LocalContact, SkinDeformed, SkinDisplacement, SkinTopology

from bags import wire
from bags.frame import Stamps
from stmpl_core.posing import posed
from stmpl_core.skin import Skin
from stmpl_core.touch import APART, PRESSING, Answer, Touch
from stmpl_ros.cdr import WrenchBytes
from stmpl_ros.gate import Gate
from stmpl_ros.inbox import Instant
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.remembering import Before
from stmpl_ros.show import Show
from stmpl_ros.topics import ANSWERS, NOW, STREAM, managed
from stmpl_ros.workshop import Workshop

LAST_WORD_S = 0.05  # time that listeners get to take a tool's last wrench before its topic closes
Touches = Mapping[str, Touch]  # by tool's name
MODELLED = PRESSING | {APART}  # statuses for which a local model says what the answer says


class Sending:
    """Publishers of the skin at rest and of answers, in every form that somebody listens to.

    Args:
        node: node that publishes.
        config: settings: frame and rates.
        skin: skin that answers are of.
        workshop: process that finds local contacts.
        gate: gate that tells what went wrong.
    """

    def __init__(self, node: LifecycleNode, config: NodeConfig, skin: Skin, workshop: Workshop, gate: Gate) -> None:
        self._node, self._frame, self._skin = node, config.frame, skin
        self._topology = managed(node, SkinTopology, "skin/topology", NOW)
        self._displacement = managed(node, SkinDisplacement, "skin/displacement", ANSWERS)
        self._deformed = managed(node, SkinDeformed, "skin/deformed", STREAM)
        self._wrenches: dict[str, Publisher] = {}
        self._wrench = WrenchBytes(config.frame)
        self.show = Show(node, skin.layer, config.frame, config.marker_rate)
        self.models = Models(node, config.frame, workshop, gate)
        self._sequence = 0

    @property
    def sequence(self) -> int:
        """Number of the next answer."""
        return self._sequence

    def close(self) -> None:
        """Closes all topics."""
        for publisher in (self._topology, self._displacement, self._deformed):
            self._node.destroy_lifecycle_publisher(publisher)
        for name in list(self._wrenches):
            self._close_tool(name)
        self.show.close()

    def open_tool(self, name: str) -> None:
        """Opens the topics of a tool."""
        if name not in self._wrenches:
            self._wrenches[name] = self._node.create_publisher(WrenchStamped, f"tools/{name}/contact_wrench", STREAM)
            self.models.open(name)

    def close_tool(self, name: str) -> None:
        """Closes the topics of a tool, once its last wrench is taken."""
        if name in self._wrenches:
            self._wrenches[name].wait_for_all_acked(Duration(seconds=LAST_WORD_S))
            self._close_tool(name)

    def move_to(self, skin: Skin) -> None:
        """Sends answers of another skin from here on."""
        self._skin = skin
        self.models.drop()
        self.show.move_to(skin.layer)

    def topology(self, stamp: int) -> None:
        """Sends the skin at rest."""
        self._topology.publish(self.topology_message(stamp))

    def topology_message(self, stamp: int) -> Any:
        """The skin at rest, as a SkinTopology."""
        return wire.topology_message(self._skin.layer, self._frame, stamp)

    def answer(self, answer: Answer, stamp: int, inputs: Stamps, **said: Any) -> None:
        """Sends an answer, with what the node has to say of it (see wire.displacement_message)."""
        message = wire.displacement_message(
            answer, layer_id=self._skin.layer_id, body_frame=self._frame, stamp_ns=stamp, sequence=self._sequence,
            inputs=inputs, **said,
        )  # fmt: skip
        self._sequence += 1
        self._displacement.publish(message)
        joints = tuple(message.joints)
        self.show.put(answer, stamp, joints)
        if self._deformed.get_subscription_count():
            self._deformed.publish(wire.deformed_message(message, posed(self._skin.layer, joints).vertices))

    def reaction(self, instant: Instant, touches: Touches) -> None:
        """Sends the tools' wrenches."""
        for name, touch in touches.items():
            self._send_wrench(name, touch.wrench, instant.stamp)

    def rest(self, tools: Sequence[str], stamp: int) -> None:
        """Tells that these tools exert nothing any more."""
        for name in tools:
            self._send_wrench(name, np.zeros(6), stamp)
        self.models.forget()

    def _close_tool(self, name: str) -> None:
        self._node.destroy_publisher(self._wrenches.pop(name))
        self.models.close(name)

    def _send_wrench(self, name: str, wrench: np.ndarray, stamp: int) -> None:
        publisher = self._wrenches.get(name)
        if publisher and publisher.get_subscription_count():
            publisher.publish(self._wrench.of(wrench, stamp))


class Models:
    """`tools/NAME/local_contact`: the newest instant's contacts to first order, while somebody listens.

    Answers do not wait for it. One instant at a time, the newest first.
    """

    def __init__(self, node: LifecycleNode, frame: str, workshop: Workshop, gate: Gate) -> None:
        self._node, self._frame, self._workshop, self._gate = node, frame, workshop, gate
        self._publishers: dict[str, Publisher] = {}
        self._next: tuple[Instant, Touches, Before, Mapping[str, str]] | None = None
        self._busy = False

    def open(self, name: str) -> None:
        """Opens the topic of a tool."""
        self._publishers[name] = self._node.create_publisher(LocalContact, f"tools/{name}/local_contact", STREAM)

    def close(self, name: str) -> None:
        """Closes it."""
        self._node.destroy_publisher(self._publishers.pop(name))

    def drop(self) -> None:
        """Goes on with another skin: the workshop drops what it was asked."""
        self._next, self._busy = None, False

    def put(self, instant: Instant, touches: Touches, before: Before, doubts: Mapping[str, str]) -> None:
        """Takes the newest instant, its touches, what they were made from, and why each tool's is out of range."""
        self._next = instant, touches, before, doubts
        if any(self._heard(one.name) for one in instant.contacts):
            self._workshop.expect_models()
        self._tell()

    def forget(self) -> None:
        """Drops models that wait."""
        self._next = None

    def _tell(self) -> None:
        if self._busy or self._next is None:
            return
        (instant, touches, before, doubts), self._next = self._next, None
        if any(touches[one.name].status in MODELLED and self._heard(one.name) for one in instant.contacts):
            self._busy = True
            self._workshop.models(instant.contacts, before, partial(self._on_models, instant, touches, doubts))

    def _heard(self, tool: str) -> bool:
        return tool in self._publishers and self._publishers[tool].get_subscription_count() > 0

    def _on_models(self, instant: Instant, touches: Touches, doubts: Mapping[str, str], future: Future) -> None:
        self._busy = False
        try:
            for name, model in zip((one.name for one in instant.contacts), future.result(), strict=True):
                status = touches[name].status
                if doubts[name]:
                    model = replace(model, trust=model.trust.also(doubts[name], in_range=False))
                if status in MODELLED and self._heard(name):
                    self._publishers[name].publish(
                        wire.local_contact_message(name, model, status, self._frame, instant.stamp)
                    )
        except Exception as error:  # whatever happened in the other process; the node goes on
            self._workshop.renew(error)
            self._gate.say("model", f"no local contact: {error or type(error).__name__}")
        self._tell()
