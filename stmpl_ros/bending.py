"""Bending: the limb's joints as a sensor tells them, and the skin there, made on a thread of its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numba
from rclpy.node import Node
from sensor_msgs.msg import JointState

from bags import wire
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.skin import Skin
from stmpl_ros.hearing import Hearing
from stmpl_ros.latest import LatestWins
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.topics import NEWEST

SILENT_S = 1.0  # silence of the joints' sensor after which answers are flagged [s]


class Bending:
    """Listens to joint states, and has the newest one's skin ready for whoever answers next.

    A message that cannot be used is refused with a line, and the limb stays where it was.

    Args:
        node: node that subscribes.
        hearing: what tells and counts, and says whether the node is active.
        config: settings as they are now.

    Attributes:
        newest: skin at the newest angles; None: no skin yet.
    """

    def __init__(self, node: Node, hearing: Hearing, config: Callable[[], NodeConfig]) -> None:
        self._node, self._hearing, self._config = node, hearing, config
        self.newest: Skin | None = None
        self._rest: Skin | None = None
        self._told: dict[str, float] = {}  # newest angle of each joint [rad]
        self._stamp, self._came = 0, 0.0  # of the newest message [ns], and when it came [s]
        self._others = ""  # joints that messages told of instead
        self._subscription: Any = None
        self._thread: LatestWins[tuple[Skin, tuple[float, ...]]] | None = None

    def move_to(self, rest: Skin) -> None:
        """Goes on with another skin; it is at rest until its newest angles are made."""
        self._rest = self.newest = rest
        rig = rest.layer.rig
        if rig is not None and self._thread is not None and self._told.keys() <= set(rig.names):
            self._thread.put((rest, rig.angles(self._told)))

    def open(self) -> None:
        """Starts to listen, if the settings name a topic."""
        topic = self._config().joint_states
        if topic:
            self._thread = LatestWins(self._make, lambda why: self._hearing.gate.refuse("joints", why), "joints")
            self._subscription = self._hearing.events.subscribe(self._node, JointState, topic, self._on_joints, NEWEST)

    def close(self) -> None:
        """Stops listening, and forgets all."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        if self._thread is not None:
            self._thread.close()
        self._subscription = self._thread = self._rest = self.newest = None
        self._told, self._stamp, self._came = {}, 0, 0.0

    @property
    def doubt(self) -> str:
        """Why it is not known where the limb is; empty: it is known."""
        if self._thread is None:
            return ""
        if not self._came:
            others = f" (there: {self._others}; see the parameter joints)" if self._others else ""
            return (f"no joint states of the limb on {self._config().joint_states} yet{others}: it is taken to be at "
                    "rest")  # fmt: skip
        silent = time.monotonic() - self._came
        return f"no joint states for {silent:.0f} s: the limb is taken to be where it was" if silent > SILENT_S else ""

    def _on_joints(self, message: JointState) -> None:
        gate, stamp = self._hearing.gate, wire.stamp_ns(message)
        if not self._hearing.active or self._rest is None or self._thread is None:
            return None
        try:
            rig = self._rest.layer.rig
            if rig is None:
                raise InvalidInput("joint states come, but this skin has no joints.")
            names = {name: self._config().joint_names.get(name, name) for name in rig.names}
            heard = wire.joints_from(message, names)
            if not heard:  # of another limb, or of a robot
                self._others = ", ".join(message.name) or "none"
                return None
            told = self._told | heard
            angles = rig.angles(told)
        except StmplError as error:
            return gate.refuse("joints", str(error))
        if not gate.fresh(message, self._config().max_age):
            return None
        if self._came and stamp <= self._stamp and time.monotonic() - self._came < SILENT_S:
            return gate.say("order of joints", "joint states were dropped: their stamp is not after the last one's")
        self._told, self._stamp, self._came = told, stamp, time.monotonic()
        return self._thread.put((self._rest, angles))

    def _make(self, item: tuple[Skin, tuple[float, ...]]) -> None:
        """On its own thread."""
        numba.set_num_threads(1)
        rest, angles = item
        if self.newest is not None and self.newest.angles == angles and rest is self._rest:
            return
        skin = rest.at_angles(angles)
        if rest is self._rest:
            self.newest = skin
