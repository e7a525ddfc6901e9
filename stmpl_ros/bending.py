"""Bending: the limb's joints as a sensor tells them, and the skin there, made on a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

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

SILENT_S = 1.0  # silence of a joint's sensor after which answers are flagged [s]


class _Heard(NamedTuple):
    """What was heard of a joint: its angle [rad], the stamp of that [ns], and when it came, see Bending._now [s]."""

    angle: float
    stamp: int
    came: float


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
        self._heard: dict[str, _Heard] = {}  # by joint of the limb
        self._held = 0.0  # time in which the node could not listen [s]
        self._stands = 0.0  # when the angles came that the newest skin stands at [s]; 0: none yet
        self._others = "", 0.0  # joints that a message told of instead, and when it came [s]
        self._refused = "", 0.0  # why the last message that could not be used could not, and when it came [s]
        self._lock = threading.Lock()  # held while the newest skin is changed
        self._subscription: Any = None
        self._thread: LatestWins[tuple[Skin, tuple[float, ...], float]] | None = None

    def move_to(self, rest: Skin) -> None:
        """Goes on with another skin; it is at rest until its newest angles are made."""
        with self._lock:
            self._rest = self.newest = rest
            self._stands, rig = 0.0, rest.layer.rig
        self._heard = {name: one for name, one in self._heard.items() if rig is not None and name in rig.names}
        if rig is not None and self._thread is not None and self._heard:
            try:
                self._put(rest, rig.angles({name: one.angle for name, one in self._heard.items()}))
            except InvalidInput as error:  # beyond this limb's limits
                self._heard = {}
                self._hearing.gate.refuse("joints", str(error))

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
        self._heard, self._stands, self._others, self._refused = {}, 0.0, ("", 0.0), ("", 0.0)

    def held_up(self, seconds: float) -> None:
        """Takes time in which the node could not listen [s] out of the silence of its sensors."""
        self._held += seconds

    def _now(self) -> float:
        """Time in which the node could listen [s]."""
        return time.monotonic() - self._held

    @property
    def doubt(self) -> str:
        """Why it is not known where the limb is; empty: it is known."""
        if self._thread is None:
            return ""
        rig, now = None if self._rest is None else self._rest.layer.rig, self._now()
        names, heard = () if rig is None else rig.names, dict(self._heard)
        unheard = [name for name in names if name not in heard]
        if unheard or not heard:
            whose = ", ".join(unheard) if heard else "the limb"
            topic, there = self._config().joint_states, _there(self._others[0])
            return f"no joint states of {whose} on {topic} yet{self._useless}{there}: it is taken to be at rest"
        silent = {name: now - one.came for name, one in heard.items() if now - one.came > SILENT_S}
        if silent:
            whose = "" if len(silent) == len(heard) else f" of {', '.join(silent)}"
            others, came = self._others
            there = _there(others if now - came < SILENT_S else "")
            return (f"no joint states{whose}{self._useless} for {max(silent.values()):.0f} s{there}: the limb is taken "
                    "to be where it was")  # fmt: skip
        if not self._stands:
            return "the skin is not bent as the joint states say yet: it is taken to be at rest"
        behind = max(one.came for one in heard.values()) - self._stands
        if behind > SILENT_S:
            return f"the skin was not bent for {behind:.0f} s: the limb is taken to be where it was"
        return ""

    @property
    def _useless(self) -> str:
        """What is said of messages that come and cannot be used; empty: none come."""
        why, came = self._refused
        return f" that could be used (refused: {why})" if why and self._now() - came < SILENT_S else ""

    def _on_joints(self, message: JointState) -> None:
        gate, stamp, now = self._hearing.gate, wire.stamp_ns(message), self._now()
        if not self._hearing.active or self._rest is None or self._thread is None:
            return None
        try:
            rig = self._rest.layer.rig
            if rig is None:
                raise InvalidInput("joint states come, but this skin has no joints.")
            names = {name: self._config().joint_names.get(name, name) for name in rig.names}
            told = wire.joints_from(message, names)
            if not told:  # of another limb, or of a robot
                self._others = ", ".join(message.name) or "none", now
                return None
            heard = self._heard | {name: _Heard(angle, stamp, now) for name, angle in told.items()}
            angles = rig.angles({name: one.angle for name, one in heard.items()})
        except StmplError as error:
            self._refused = str(error), now
            return gate.refuse("joints", str(error))
        if not gate.fresh(stamp, self._config().max_age):
            self._refused = gate.dropped, now
            return None
        if any(self._is_over(self._heard[name], stamp, now) for name in told if name in self._heard):
            return gate.say("order of joints", "joint states were dropped: their stamp is not after the last one's")
        self._heard = heard
        return self._put(self._rest, angles)

    def _is_over(self, last: _Heard, stamp: int, now: float) -> bool:
        """Whether a stamp [ns] is not after the last one's: after a silence an older one is a clock that was set back.

        The same one is no news, however late it comes, unless a simulation is there: while paused it sends no other,
        and while it runs `max_age` tells what is old.
        """
        if stamp == last.stamp and not self._hearing.now.simulated:
            return True
        return stamp <= last.stamp and now - last.came < SILENT_S

    def _put(self, rest: Skin, angles: tuple[float, ...]) -> None:
        assert self._thread is not None
        self._thread.put((rest, angles, max(one.came for one in self._heard.values())))

    def _make(self, item: tuple[Skin, tuple[float, ...], float]) -> None:
        """On its own thread."""
        numba.set_num_threads(1)
        rest, angles, came = item
        newest = self.newest
        if newest is None or rest is not self._rest:
            return
        skin = newest if newest.angles == angles else rest.at_angles(angles)
        with self._lock:  # else a skin that takes over just now would be overwritten
            if rest is self._rest:
                self.newest, self._stands = skin, came


def _there(others: str) -> str:
    """What is said of joints that messages tell of instead."""
    return f" (there: {others}; see the parameter joints)" if others else ""
