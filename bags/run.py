"""Run: a recording of contacts and their answers, with the contacts as they stood at any answer."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from mcap.records import Message

from bags.frame import Frame
from bags.moving import TF, TF_STATIC, FramesAt, MovingFrames
from bags.reader import DISPLACEMENT, TYPES, Bag, ends, fields_of, tool_kind
from bags.records import Place
from bags.wire import contact_from, frame_from, stamp_ns
from stmpl_core.contact import Contact
from stmpl_core.errors import BagError, FrameError, InvalidInput

NANO = 1e-9  # seconds in a nanosecond
LATE = 500_000_000  # time after an answer until which a recorder may receive what it answers [ns]
BEGINNING = 2_000_000_000  # time in which a recorder comes to hear of everything that goes on as it begins [ns]


class Run(Bag):
    """A bag whose poses and wrenches are kept by tool and stamp: a few hundred bytes each, whatever the answers weigh.

    Args:
        path: path of a folder, or of the .mcap file.
        namespace: namespace of the one robot that is meant, "/left"; "": there is but one.
        on_answer: function that gets each answer while the file is looked over, in its order.

    Attributes:
        received: times at which contact messages of a stamp were received [ns], by the stamp.
        pose_stamps: stamps of all poses, and how often each came: more than once where the clock was set back.
        placed_by_tf: frames of poses and wrenches that /tf placed, as far as contacts were asked for.

    Raises:
        BagError: a file that `Bag` refuses, or several robots and no namespace.
    """

    def __init__(
        self, path: Path | str, namespace: str = "", *, on_answer: Callable[[Self, Frame], None] | None = None
    ) -> None:
        self.received: dict[int, list[int]] = {}
        self.pose_stamps: dict[int, int] = {}
        self._sent: dict[str, dict[int, list[Message]]] = {}  # by topic, then stamp, which comes again after a reset
        self._stamps: dict[str, int] = {}  # last of each topic
        self.placed_by_tf: set[str] = set()
        self._on_answer, self._answering = on_answer, ""
        super().__init__(path, namespace)

    def see(self, topic: str, record: Message, place: Place) -> None:
        """Keeps poses and wrenches, and hands on the answers."""
        super().see(topic, record, place)
        if kind := tool_kind(topic):
            stamp = self.read(record, stamp_ns)
            self.received.setdefault(stamp, []).append(record.log_time)
            if self._stamps.get(topic) != stamp:  # a node, too, takes the first of those that follow under one stamp
                self._stamps[topic] = stamp
                told = self._sent.setdefault(topic, {}).setdefault(stamp, [])
                told.append(record)
                if kind == "pose":
                    self.pose_stamps[stamp] = max(self.pose_stamps.get(stamp, 0), len(told))
        elif ends(topic, DISPLACEMENT):
            if topic != self._answering:
                self._answering = self.find_topic(DISPLACEMENT)
            if self._on_answer:
                self._on_answer(self, self.read(record, frame_from, record.log_time))

    def contacts(self, frame: Frame) -> list[Contact]:
        """The contacts that `frame` answers: of each of its tools the pose and the wrench that it names.

        Where a stamp came again, since the clock was set back, it is the last one that was received before the answer.

        Raises:
            BagError: a pose, a wrench or a mesh that it answers is not in the bag, or its /tf does not cover it.
        """
        return [self._contact(tool, frame.surfaces.get(tool, ""), *stamps, frame.log_time_ns)
                for tool, stamps in frame.inputs.items()]  # fmt: skip

    def _contact(self, tool: str, surface: str, posed: int, pushed: int, by: int) -> Contact:
        known, pose, wrench = self.surface(tool, surface), self._told_at(tool, "pose", posed, by), None
        lacks = ["mesh"] * (known is None) + ["pose"] * (pose is None)
        if pushed and (wrench := self._told_at(tool, "wrench", pushed, by)) is None:
            lacks.append("wrench")
        if known is None or lacks:
            raise BagError(f"an answer to tool {tool} at {posed * NANO:.3f} s cannot be repeated: "
                           f"the bag has no {' and no '.join(lacks)} for it.")
        try:
            with fields_of(f"tools/{tool}"):
                return contact_from(known, pose, wrench, body_frame=self.body_frame, frames=self._frames_at(posed, by),
                                    wrench_frames=self._frames_at(pushed, by))  # fmt: skip
        except FrameError as error:
            raise BagError(f"an answer to tool {tool} at {posed * NANO:.3f} s cannot be repeated offline: {error}. A "
                           "recording carries what came on /tf while stmpl record ran, and the table of its --frames; "
                           "stmpl replay --publish sends the poses to a node.") from error  # fmt: skip
        except InvalidInput as error:  # a message that no node would take
            raise BagError(f"an answer to tool {tool} at {posed * NANO:.3f} s cannot be repeated: {error}") from error

    @cached_property
    def moving(self) -> MovingFrames:
        """Frames of the recorded /tf, read when they are first asked for."""
        found = MovingFrames()
        told = {TF, TF_STATIC} & {topic.name for topic in self.topics.values() if topic.type_name == TYPES[TF]}
        for topic, message, received in self.messages(told.__contains__):
            found.hear(message, still=topic == TF_STATIC, received=received)
        return found

    def _frames_at(self, stamp: int, by: int) -> FramesAt:
        return FramesAt(self.body_frame, self.provenance.frames, lambda frame: self._moved(frame, stamp, by))

    def _moved(self, frame: str, stamp: int, by: int) -> Any:
        self.placed_by_tf.add(frame)
        return self.moving.place(self.body_frame, frame, stamp, by)

    def _told_at(self, tool: str, kind: str, stamp: int, by: int) -> Any | None:
        """What a tool's topic told under a stamp, the last time before it was answered (`by`, log time [ns])."""
        ending = f"tools/{tool}/{kind}"
        topic = self._answering.removesuffix(DISPLACEMENT) + ending
        if topic not in self._sent:  # answers were remapped
            topic = next((name for name in self._sent if ends(name, ending)), topic)
        told = sorted(self._sent.get(topic, {}).get(stamp, ()), key=lambda record: record.log_time)
        before = [record for record in told if record.log_time <= by]
        found = before[-1:] or [record for record in told[:1] if record.log_time <= by + LATE]
        return self.decode(found[0]) if found else None
