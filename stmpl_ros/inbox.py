"""Inbox: the newest pose and wrench of every tool, and when an instant is complete."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from bags import wire
from bags.frame import Stamps
from stmpl_core.arrays import Transform
from stmpl_core.contact import Contact
from stmpl_core.tools import Tools

RECENT = 1_000_000_000  # time for which a tool that fell silent is told of [ns]
JUST_NOW = 100_000_000  # time on a simulated clock since a message that is sent again while that stands still [ns]
PATIENCE = 3  # number of poses of a tool that may pass a missing partner before the newest of each is taken as it is


@dataclass
class Stream:
    """One topic's newest value, its stamp [ns] and when it came (on the receiver's clock) [ns]."""

    value: Any = None
    stamp: int = 0
    came: int = 0

    def live(self, now: int, rest_after: int) -> bool:
        """Whether something came within the last `rest_after` nanoseconds."""
        return self.value is not None and now - self.came <= rest_after


@dataclass
class Input:
    """Streams of one tool: poses in the body's frame (4, 4), WrenchStamped messages, and why others are refused."""

    pose: Stream = field(default_factory=Stream)
    wrench: Stream = field(default_factory=Stream)
    refused: Stream = field(default_factory=Stream)


@dataclass(frozen=True)
class Instant:
    """Contacts to answer together.

    Args:
        contacts: one contact a live tool.
        stamp: stamp of the newest pose among them [ns].
        skew: time between their stamps [ns].
        inputs: stamps of each tool's pose and wrench [ns]; 0: no wrench.
        lost: streams that fell silent: a pose within the last second, a wrench while its tool still moves.
        refused: why no wrench that comes for a tool can be used, by tool: it is answered by its pose alone.
    """

    contacts: list[Contact]
    stamp: int
    skew: int
    inputs: Stamps
    lost: tuple[str, ...] = ()
    refused: Mapping[str, str] = MappingProxyType({})


class Inbox:
    """Keeps the newest of everything and hands out instants.

    An instant is complete when the newest pose and wrench of every live tool carry one stamp. Devices whose clocks
    never agree would then never be answered: after `PATIENCE` poses a tool without a complete instant, every pose is
    answered with the newest of the rest, until an instant is complete again.

    Args:
        tools: tools in use; others are not listened to.
        body_frame: frame that poses are in.
        frames: pose_body_from_frame of other frames that wrenches may be in, by the stamp [ns].
        rest_after: silence after which a stream is no longer live [ns].
    """

    def __init__(
        self, tools: Tools, body_frame: str, rest_after: int,
        frames: Callable[[int], wire.FixedFrames] = lambda stamp: wire.NO_FRAMES,
    ) -> None:  # fmt: skip
        self.tools, self.body_frame, self.frames, self.rest_after = tools, body_frame, frames, rest_after
        self.inputs: dict[str, Input] = {}
        self.out_of_order = 0
        self.waiting: set[str] = set()  # tools whose newest pose was not handed out yet
        self.missed = 0

    def forget(self, name: str | None = None) -> None:
        """Forgets every pose and wrench, or those of one tool."""
        for one in [name] if name else list(self.inputs):
            self.inputs.pop(one, None)
            self.waiting.discard(one)
        self.missed = 0

    def pose_of(self, name: str) -> Transform | None:
        """The newest pose of a tool, if there is one."""
        return self.inputs[name].pose.value if name in self.inputs else None

    def repeats(self, kind: str, name: str, stamp: int, now: int) -> bool:
        """Whether this is the stamp of the newest pose or wrench (`kind`) of a tool, which came just now."""
        stream = getattr(self.inputs.get(name, Input()), kind)
        return stream.stamp == stamp and stream.live(now, JUST_NOW)

    def put_pose(self, name: str, pose: Transform, stamp: int, now: int) -> bool:
        """Keeps a pose; False if it was dropped as repeated or out of order."""
        if not self._put(self.inputs.setdefault(name, Input()).pose, pose, stamp, now):
            return False
        self.missed += name in self.waiting
        self.waiting.add(name)
        return True

    def put_wrench(self, name: str, wrench: Any, stamp: int, now: int) -> bool:
        """Keeps a WrenchStamped; False if it was dropped as repeated or out of order."""
        return self._put(self.inputs.setdefault(name, Input()).wrench, wrench, stamp, now)

    def refuse_wrench(self, name: str, why: str, now: int) -> None:
        """Keeps why a wrench cannot be used, until one can, or none comes."""
        self.inputs.setdefault(name, Input()).refused = Stream(why, came=now)

    def _put(self, stream: Stream, value: Any, stamp: int, now: int) -> bool:
        # after a silence an older stamp is a clock that was set back; the same one is no news, however late it comes
        repeated = stream.value is not None and stamp == stream.stamp
        if repeated or (stamp < stream.stamp and stream.live(now, self.rest_after)):
            self.out_of_order += 1
            return False
        stream.value, stream.stamp, stream.came = value, stamp, now
        return True

    def live(self, now: int) -> dict[str, Input]:
        """The inputs of the tools whose pose came lately."""
        return {name: one for name, one in self.inputs.items()
                if name in self.tools and one.pose.live(now, self.rest_after)}  # fmt: skip

    def silence(self, now: int) -> int:
        """Time since the newest pose of any tool came [ns]."""
        return now - max((one.pose.came for one in self.inputs.values()), default=now)

    def dumb(self, now: int) -> list[str]:
        """The tools whose wrenches have stopped, while their poses go on."""
        return self._dumb(self.live(now), now)

    def _lost(self, live: dict[str, Input], now: int) -> tuple[str, ...]:
        silent = {name: one for name, one in self.inputs.items() if one.pose.value is not None and name not in live}
        poses = [f"pose of {name}" for name, one in silent.items() if now - one.pose.came <= self.rest_after + RECENT]
        return *poses, *(f"wrench of {name}" for name in self._dumb(live, now))

    def _dumb(self, live: dict[str, Input], now: int) -> list[str]:
        return [name for name, one in live.items() if one.wrench.value is not None
                and not (one.wrench.live(now, self.rest_after) or one.refused.live(now, self.rest_after))]  # fmt: skip

    def _refused(self, live: dict[str, Input], now: int) -> dict[str, str]:
        return {name: f"the wrenches of {name} are refused: {one.refused.value}" for name, one in live.items()
                if one.refused.live(now, self.rest_after) and not one.wrench.live(now, self.rest_after)}  # fmt: skip

    def take(self, now: int) -> Instant | None:
        """Instant to answer now, each once; None while there is nothing new or something is to come."""
        live = self.live(now)
        if not self.waiting & live.keys():
            return None
        poses = [one.pose.stamp for one in live.values()]
        stamps = poses + [one.wrench.stamp for one in live.values() if one.wrench.live(now, self.rest_after)]
        skew = max(stamps) - min(stamps)
        if skew and self.missed < PATIENCE * len(live):
            return None
        self.missed = self.missed if skew else 0
        self.waiting.clear()
        inputs = {
            name: (one.pose.stamp, one.wrench.stamp if one.wrench.live(now, self.rest_after) else 0)
            for name, one in live.items()
        }
        contacts = [self._contact(name, one, now) for name, one in live.items()]
        return Instant(contacts, max(poses), skew, inputs, self._lost(live, now), self._refused(live, now))

    def _contact(self, name: str, one: Input, now: int) -> Contact:
        tool, pose, time = self.tools[name], one.pose.value, one.pose.stamp / wire.NANO
        if not one.wrench.live(now, self.rest_after):
            return Contact(tool, pose, time=time)
        wrench = wire.wrench_from(one.wrench.value, body_frame=self.body_frame, tool=name, pose_body_from_tool=pose,
                                  frames=self.frames(one.wrench.stamp))  # fmt: skip
        return Contact(tool, pose, wrench, time)
