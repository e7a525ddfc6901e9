"""Run: a recording of contacts and their answers, with the contacts as they stood at any answer."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from mcap.records import Message

from bags.frame import Frame
from bags.moving import TF, TF_STATIC, FramesAt, MovingFrames
from bags.reader import DISPLACEMENT, TYPES, Bag, ends, tool_kind
from bags.records import Place
from bags.wire import contact_from, frame_from, stamp_ns
from stmpl_core.contact import Contact
from stmpl_core.errors import BagError, FrameError

NANO = 1e-9  # seconds in a nanosecond


class Run(Bag):
    """A bag whose poses and wrenches are kept by tool and stamp: a few hundred bytes each, whatever the answers weigh.

    Args:
        path: path of a folder, or of the .mcap file.
        namespace: namespace of the one robot that is meant, "/left"; "": there is but one.
        on_answer: function that gets each answer while the file is looked over, in its order.

    Attributes:
        received: time at which the last contact message of a stamp was received [ns], by the stamp.
        pose_stamps: stamps of all poses.
        placed_by_tf: frames of poses and wrenches that /tf placed, as far as contacts were asked for.

    Raises:
        BagError: a file that `Bag` refuses, or several robots and no namespace.
    """

    def __init__(
        self, path: Path | str, namespace: str = "", *, on_answer: Callable[[Self, Frame], None] | None = None
    ) -> None:
        self.received: dict[int, int] = {}
        self.pose_stamps: set[int] = set()
        self._sent: dict[str, dict[int, Message]] = {}  # by topic, then stamp
        self.placed_by_tf: set[str] = set()
        self._on_answer, self._answering = on_answer, ""
        super().__init__(path, namespace)

    def see(self, topic: str, record: Message, place: Place) -> None:
        """Keeps poses and wrenches, and hands on the answers."""
        super().see(topic, record, place)
        if kind := tool_kind(topic):
            message = self.decode(record)
            stamp = stamp_ns(message)
            self._sent.setdefault(topic, {})[stamp] = record
            self.received[stamp] = max(self.received.get(stamp, 0), record.log_time)
            if kind == "pose":
                self.pose_stamps.add(stamp)
        elif ends(topic, DISPLACEMENT):
            if topic != self._answering:
                self._answering = self.find_topic(DISPLACEMENT)
            if self._on_answer:
                self._on_answer(self, frame_from(self.decode(record), record.log_time))

    def contacts(self, frame: Frame) -> list[Contact]:
        """The contacts that `frame` answers: of each of its tools the pose and the wrench that it names.

        Raises:
            BagError: a pose, a wrench or a mesh that it answers is not in the bag, or its /tf does not cover it.
        """
        return [self._contact(tool, frame.surfaces.get(tool, ""), *stamps) for tool, stamps in frame.inputs.items()]

    def _contact(self, tool: str, surface: str, posed: int, pushed: int) -> Contact:
        known, pose, wrench = self.surface(tool, surface), self._told_at(tool, "pose", posed), None
        lacks = ["mesh"] * (known is None) + ["pose"] * (pose is None)
        if pushed and (wrench := self._told_at(tool, "wrench", pushed)) is None:
            lacks.append("wrench")
        if known is None or lacks:
            raise BagError(f"an answer to tool {tool} at {posed * NANO:.3f} s cannot be repeated: "
                           f"the bag has no {' and no '.join(lacks)} for it.")
        try:
            return contact_from(known, pose, wrench, body_frame=self.body_frame, frames=self._frames_at(posed),
                                wrench_frames=self._frames_at(pushed))  # fmt: skip
        except FrameError as error:
            raise BagError(f"an answer to tool {tool} at {posed * NANO:.3f} s cannot be repeated offline: {error}. A "
                           "recording carries what came on /tf while stmpl record ran, and the table of its --frames; "
                           "stmpl replay --publish sends the poses to a node.") from error  # fmt: skip

    @cached_property
    def moving(self) -> MovingFrames:
        """Frames of the recorded /tf, read when they are first asked for."""
        found = MovingFrames()
        told = {TF, TF_STATIC} & {topic.name for topic in self.topics.values() if topic.type_name == TYPES[TF]}
        for topic, message, _ in self.messages(told.__contains__):
            found.hear(message, still=topic == TF_STATIC)
        return found

    def _frames_at(self, stamp: int) -> FramesAt:
        return FramesAt(self.body_frame, self.provenance.frames, lambda frame: self._moved(frame, stamp))

    def _moved(self, frame: str, stamp: int) -> Any:
        self.placed_by_tf.add(frame)
        return self.moving.place(self.body_frame, frame, stamp)

    def _told_at(self, tool: str, kind: str, stamp: int) -> Any | None:
        topic = self._answering.removesuffix(DISPLACEMENT) + f"tools/{tool}/{kind}"
        record = self._sent.get(topic, {}).get(stamp)
        return None if record is None else self.decode(record)
