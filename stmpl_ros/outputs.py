"""Outputs: all topics that the node publishes answers on, opened and closed together."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rclpy.lifecycle import LifecycleNode
from stmpl_msgs.msg import SkinDeformed, SkinDisplacement, SkinTopology

from stmpl_core.arrays import Wrench
from stmpl_core.trust import Displacement
from stmpl_ros.background import Background
from stmpl_ros.contact_wrenches import ContactWrenches
from stmpl_ros.conversions import deformed_message, displacement_message, topology_message
from stmpl_ros.inbox import Instant
from stmpl_ros.local_contacts import LocalContacts
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.show import Show
from stmpl_ros.skin import Skin
from stmpl_ros.topics import ANSWERS, NOW, STREAM, managed

Stamps = dict[str, tuple[int, int]]  # of each tool's pose and wrench [ns]


class Outputs:
    """What goes out: the skin at rest, answers, and what is made of them for those who listen.

    Args:
        node: that publishes.
        config: frame and rates.
        skin: that answers are of.
        background: finds local contacts.
        say: is told of what went wrong: a kind, and a line.
    """

    def __init__(
        self, node: LifecycleNode, config: NodeConfig, skin: Skin, background: Background,
        say: Callable[[str, str], None],
    ) -> None:  # fmt: skip
        self._node, self._frame, self._skin = node, config.frame, skin
        self._topology = managed(node, SkinTopology, "skin/topology", NOW)
        self._displacement = managed(node, SkinDisplacement, "skin/displacement", ANSWERS)
        self._deformed = managed(node, SkinDeformed, "skin/deformed", STREAM)
        self.show = Show(node, skin.layer, config.frame, config.marker_rate)
        self._wrenches = ContactWrenches(node, config.frame)
        self.local_contacts = LocalContacts(node, config.frame, background, say)

    def close(self) -> None:
        """Closes all topics."""
        for publisher in (self._topology, self._displacement, self._deformed):
            self._node.destroy_lifecycle_publisher(publisher)
        for output in (self.show, self._wrenches, self.local_contacts):
            output.close()

    def open_tool(self, name: str) -> None:
        """Opens the topics of a tool."""
        self.local_contacts.open(name)
        self._wrenches.open(name)

    def move_to(self, skin: Skin, background: Background) -> None:
        """Answers are of another skin from here on."""
        self._skin = skin
        self.local_contacts.move_to(background)
        self.show.move_to(skin.layer)

    def send_topology(self, stamp: int) -> None:
        """The skin at rest."""
        self._topology.publish(topology_message(self._skin.layer, self._frame, stamp))

    def send(
        self, answer: Displacement, stamp: int, sequence: int, inputs: Stamps, *, seconds: float = 0.0, why: str = "",
        fade: float = 1.0,
    ) -> None:  # fmt: skip
        """An answer, with what the node has to say of it, to all who listen."""
        message = displacement_message(
            answer,
            layer_id=self._skin.layer_id,
            body_frame=self._frame,
            stamp_ns=stamp,
            sequence=sequence,
            solve_seconds=seconds,
            inputs=inputs,
            fade=fade,
        )
        message.why = "; ".join(filter(None, (message.why, why)))
        self._displacement.publish(message)
        self.show.put(answer, stamp)
        if self._deformed.get_subscription_count():
            self._deformed.publish(deformed_message(message, self._skin.layer.vertices))

    def send_contacts(
        self, instant: Instant, answer: Displacement, wrenches: Mapping[str, Wrench], meshes: dict[str, int],
        rotations: bool,
    ) -> None:  # fmt: skip
        """What the tools exert, and, once it is found, how that changes; `meshes`: the number of each tool's."""
        self._wrenches.send(wrenches, instant.stamp)
        self.local_contacts.put(instant, meshes, answer, rotations)

    def rest(self, tools: list[str], stamp: int) -> None:
        """These tools exert nothing any more."""
        self._wrenches.rest(tools, stamp)
        self.local_contacts.forget()
