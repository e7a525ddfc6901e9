"""Replay: answers the recorded contacts again, offline, and checks the answers against the recorded ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from bags.frame import Frame
from bags.provenance import OTHER_PROCESSOR, allowance
from bags.run import BEGINNING, Run
from bags.whole import Differences, differences, listed
from stmpl_core.errors import BagError
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.base import Method
from stmpl_core.provenance import versions
from stmpl_core.simulator import Simulator
from stmpl_core.state import State
from stmpl_core.touch import STALE, Answer


@dataclass(frozen=True, eq=False)
class Replayed:
    """A recorded answer, and the answer to the same contacts, from the same state, now.

    Args:
        frame: recorded answer.
        answer: answer now.
        after: state after it; None: the recorded answer carries no state, elastic skin.
    """

    frame: Frame
    answer: Answer
    after: State | None = None

    @cached_property
    def off(self) -> Differences:
        """Parts of the answer that are not as recorded, and how far off each is (whole.differences) [m]."""
        return differences(self.answer, self.frame, replayed=True)

    @property
    def identical(self) -> bool:
        """Whether the whole answer is the recorded one bit for bit, as its message carries it."""
        return not self.off

    @property
    def difference(self) -> float:
        """Largest Euclidean difference of the displacement at any vertex [m]; infinite where one is no number."""
        return self.off.get("displacement", 0.0)


@dataclass(frozen=True)
class ReplaySummary:
    """Result of a replay.

    Args:
        method: name of the method that answered now.
        frames: number of frames that were replayed.
        remembering: number of them that carry a state.
        identical: number of them that came out bit for bit as recorded.
        worst: largest difference at any vertex of any frame [m].
        tolerance: largest difference that is allowed [m], as whole.differences tells it; 0: bit for bit.
        reason: sentence that tells why this tolerance.
        differ: parts in which a frame differs, as a sentence has them; empty: none does.
        first_difference: sequence number of the first frame past the tolerance, in any of its parts, or None.
        left_out: number of answers that cannot be repeated, as what they answer was not recorded.
        gap: truth of the claim that one of these came after the beginning: the recording was not just begun late.
        untouched: truth of the claim that there are answers with tools, and none of these was replayed.
        why: sentence that tells why the first of these cannot; empty: all can.
        changed: packages with another version now than when the run was recorded, "numpy 2.4 -> 2.5".
        held: truth of the claim that it is held to the tolerance; not where a method was named, to see how far off.
    """

    method: str
    frames: int
    remembering: int
    identical: int
    worst: float
    tolerance: float
    reason: str
    differ: str
    first_difference: int | None
    left_out: int
    gap: bool
    untouched: bool
    why: str
    changed: tuple[str, ...]
    held: bool = True

    @property
    def passed(self) -> bool:
        """Whether contacts were replayed, none past the tolerance and none left out but at the start; or not held."""
        return not self.held or (self.first_difference is None and not self.gap and not self.untouched)

    def __str__(self) -> str:
        held = "held to nothing, since a method was named"
        if self.held:
            held = f"held to {f'{self.tolerance * 1e3:.3g} mm' if self.tolerance else 'every bit'}, since {self.reason}"
        each = f"{self.method}, {self.remembering} from a state" if self.remembering else self.method
        later = ", not only at its beginning" * self.gap
        lost = f" {self.left_out} more were left out{later}: {self.why}" * bool(self.left_out)
        lost += " No answer with a tool is among those replayed, and the recording has some." * self.untouched
        if self.identical == self.frames:
            return f"{self.frames} frames replayed with {each}, every one bit for bit as recorded; {held}.{lost}"
        off = (f"{self.frames - self.identical} of {self.frames} frames replayed with {each} differ in "
               f"{self.differ}; {held}")  # fmt: skip
        note = f" Changed since: {', '.join(self.changed)}." if self.changed else ""
        within = self.first_difference is None or not self.held
        past = "." if within else f"; number {self.first_difference} is the first past it.{note}"
        return off + past + lost


def replay(run: Path | str | Run, method: Method, *, every: int = 1,
           left_out: Callable[[Frame, BagError], None] | None = None) -> Iterator[Replayed]:  # fmt: skip
    """Yields each recorded answer (or every n-th) with the one that its recorded contacts give now, in the run's order.

    Each is answered on the layer that it was answered on, from the state that it carries: it needs none before it.

    Args:
        run: recording: its folder, its .mcap file, or an opened one.
        method: method that answers.
        every: step from frame to frame; 1 takes each.
        left_out: function that gets each answer to what was not recorded, a tool's surface or pose, with the error;
            None: that is raised.

    Raises:
        BagError: the bag lacks answers, the layer, or a tool's surface or pose.
        InvalidInput: a state of another version.
    """
    run = run if isinstance(run, Run) else Run(run)
    simulator: Simulator | None = None
    for frame in run.frames(range(0, run.answers, every)):
        simulator = _simulator(simulator, run.rest_of(frame), method, frame)
        simulator.move_to(simulator.skin.at_angles(frame.joints))
        try:
            contacts, after = run.contacts(frame), None
        except BagError as error:
            if left_out is None:
                raise
            left_out(frame, error)
            continue
        if frame.state:
            touches, after = simulator.touch(contacts, State.unpack(frame.state, frame.joints), frame.dt)
            answer = simulator.answer(touches)
        else:
            answer = simulator.step(contacts)
        if frame.fade < 1 or any(touch.status == STALE for touch in frame.touches.values()):  # the input had stopped
            answer = answer.faded(frame.fade, "")
        yield Replayed(frame, answer, after)


def _simulator(before: Simulator | None, layer: SoftLayer, method: Method, frame: Frame) -> Simulator:
    """The simulator that a frame was answered by: the one from before, if layer and friction are still the same."""
    friction = {name: one or None for name, one in frame.friction.items()}  # 0: none was told
    if before is None or (before.skin.rest or before.skin).layer is not layer:
        return Simulator(layer, method, friction=friction if frame.state else None)
    if frame.state and any(before.history.friction(name) != one for name, one in frame.friction.items()):
        return Simulator(before.skin, tools=before.tools, friction=friction)
    return before


def replay_run(
    run: Path | str | Run, method: Method, *, every: int = 1, tolerance: float | None = None
) -> ReplaySummary:
    """Replays a run and counts the answers that come out as recorded.

    Args:
        run: recording: its folder, its .mcap file, or an opened one.
        method: method that answers.
        every: step from frame to frame; 1 takes each.
        tolerance: largest difference that is allowed [m]; None: exact where this processor recorded the run,
            provenance.OTHER_PROCESSOR where another did, or where /tf says where its poses are.

    Raises:
        BagError: the bag lacks answers, the layer, or whatever all of them answer.
    """
    run = run if isinstance(run, Run) else Run(run)
    then, now = run.provenance.versions, versions()
    many = remembering = touched = early = 0
    off: list[tuple[int, Differences]] = []  # number and differences of what is not as recorded
    lost: list[tuple[int, BagError]] = []  # log time of what cannot be repeated, and why
    for replayed in replay(run, method, every=every, left_out=lambda one, why: lost.append((one.log_time_ns, why))):
        if replayed.frame.inputs:
            early = early if touched else sum(at - lost[0][0] < BEGINNING for at, _ in lost)
            touched += 1
        many += 1
        remembering += bool(replayed.frame.state)
        if not replayed.identical:
            off.append((replayed.frame.sequence, replayed.off))
    if not many:
        raise lost[0][1] if lost else BagError(f"{run.file} holds no answers, so there is nothing to replay.")
    untouched = not touched and any(frame.inputs for frame in run.frames())
    allowed, reason = allowance(run.provenance.processor, now["processor"])
    if not allowed and (frames := sorted(run.placed_by_tf)):
        allowed, reason = OTHER_PROCESSOR, f"/tf placed its poses ('{"', '".join(frames)}'), and tf2 rounds otherwise"
    if tolerance is not None:
        allowed, reason = tolerance, "this tolerance was asked for"
    first = next((number for number, parts in off if max(parts.values()) > allowed), None)
    worst = max((parts.get("displacement", 0.0) for _, parts in off), default=0.0)
    differ = listed(parts for _, parts in off) if off else ""
    changed = tuple(f"{k} {then[k]} -> {now.get(k, 'none')}" for k in then if now.get(k) != then[k])
    return ReplaySummary(method.name, many, remembering, many - len(off), worst, allowed, reason, differ, first,
                         len(lost), len(lost) > early, untouched, str(lost[0][1]) if lost else "", changed)  # fmt: skip
