"""Inbox: the newest mesh, pose and wrench of every tool, and when an instant is complete."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from bags.messages import wrench_from
from stmpl_core.arrays import Transform
from stmpl_core.contact import Contact, ToolMesh

RECENT = 1_000_000_000  # ns for which a tool that fell silent is spoken of
PATIENCE = 3  # poses of a tool that may pass a missing partner before the newest of each is taken as it is


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
class Tool:
    """What is known of one tool."""

    mesh: ToolMesh
    number: int = 0  # of the mesh
    pose: Stream = field(default_factory=Stream)
    wrench: Stream = field(default_factory=Stream)


@dataclass(frozen=True)
class Instant:
    """Contacts to answer together.

    Args:
        contacts: one a live tool.
        stamp: of the newest pose among them [ns].
        skew: how far their stamps lie apart [ns].
        inputs: stamps of each tool's pose and wrench [ns]; 0: no wrench.
        lost: streams that fell silent: a pose within the last second, a wrench while its tool still moves.
    """

    contacts: list[Contact]
    stamp: int
    skew: int
    inputs: dict[str, tuple[int, int]]
    lost: tuple[str, ...] = ()


class Inbox:
    """Keeps the newest of everything and hands out instants.

    An instant is complete when the newest pose and wrench of every live tool carry one stamp. Devices whose clocks
    never agree would then never be answered: after `PATIENCE` poses a tool without a complete instant, every pose is
    answered with the newest of the rest, until an instant is complete again.

    Args:
        body_frame: frame that poses are in.
        rest_after: a stream that is silent for longer than this is no longer live [ns].
    """

    def __init__(self, body_frame: str, rest_after: int) -> None:
        self.body_frame = body_frame
        self.rest_after = rest_after
        self.tools: dict[str, Tool] = {}
        self.out_of_order = 0
        self.waiting: set[str] = set()  # tools whose newest pose was not handed out yet
        self.missed = 0

    def put_mesh(self, name: str, mesh: ToolMesh, number: int = 0) -> None:
        """Keeps the mesh of a tool, new or changed, under a number of the caller's."""
        if name in self.tools:
            self.tools[name].mesh, self.tools[name].number = mesh, number
        else:
            self.tools[name] = Tool(mesh, number)

    def forget(self) -> None:
        """Forgets every pose and wrench; the meshes stay."""
        for tool in self.tools.values():
            tool.pose, tool.wrench = Stream(), Stream()
        self.waiting.clear()
        self.missed = 0

    def put_pose(self, name: str, pose: Transform, stamp: int, now: int) -> bool:
        """Keeps a pose; False if it was dropped as repeated or out of order."""
        if not self._put(self.tools[name].pose, pose, stamp, now):
            return False
        self.missed += name in self.waiting
        self.waiting.add(name)
        return True

    def put_wrench(self, name: str, wrench: Any, stamp: int, now: int) -> bool:
        """Keeps a WrenchStamped; False if it was dropped as repeated or out of order."""
        return self._put(self.tools[name].wrench, wrench, stamp, now)

    def _put(self, stream: Stream, value: Any, stamp: int, now: int) -> bool:
        if stream.live(now, self.rest_after) and stamp <= stream.stamp:
            self.out_of_order += 1
            return False
        stream.value, stream.stamp, stream.came = value, stamp, now
        return True

    def live(self, now: int) -> dict[str, Tool]:
        """The tools whose pose came lately."""
        return {name: tool for name, tool in self.tools.items() if tool.pose.live(now, self.rest_after)}

    def silence(self, now: int) -> int:
        """Time since the newest pose of any tool came [ns]."""
        return now - max((tool.pose.came for tool in self.tools.values()), default=now)

    def _lost(self, live: dict[str, Tool], now: int) -> tuple[str, ...]:
        silent = {name: tool for name, tool in self.tools.items() if tool.pose.value is not None and name not in live}
        poses = [f"pose of {name}" for name, tool in silent.items() if now - tool.pose.came <= self.rest_after + RECENT]
        dumb = {name: tool.wrench for name, tool in live.items() if tool.wrench.value is not None}
        return *poses, *(f"wrench of {name}" for name, s in dumb.items() if not s.live(now, self.rest_after))

    def take(self, now: int) -> Instant | None:
        """What is to be answered now, each instant once; None while there is nothing new or something is to come."""
        live = self.live(now)
        if not self.waiting & live.keys():
            return None
        poses = [tool.pose.stamp for tool in live.values()]
        stamps = poses + [tool.wrench.stamp for tool in live.values() if tool.wrench.live(now, self.rest_after)]
        skew = max(stamps) - min(stamps)
        if skew and self.missed < PATIENCE * len(live):
            return None
        self.missed = self.missed if skew else 0
        self.waiting.clear()
        inputs = {
            name: (tool.pose.stamp, tool.wrench.stamp if tool.wrench.live(now, self.rest_after) else 0)
            for name, tool in live.items()
        }
        contacts = [self._contact(name, tool, now) for name, tool in live.items()]
        return Instant(contacts, max(poses), skew, inputs, self._lost(live, now))

    def _contact(self, name: str, tool: Tool, now: int) -> Contact:
        pose = tool.pose.value
        if not tool.wrench.live(now, self.rest_after):
            return Contact(name, tool.mesh, pose)
        wrench = wrench_from(tool.wrench.value, body_frame=self.body_frame, tool=name, pose_body_from_tool=pose)
        return Contact(name, tool.mesh, pose, wrench)
