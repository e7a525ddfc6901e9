"""Survey: a run's timeline, rate, latency and losses, from one walk over its file, without keeping its answers."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bags.frame import Frame
from bags.run import NANO, Run
from stmpl_core.errors import BagError
from stmpl_core.layer import SoftLayer


@dataclass(frozen=True)
class Moment:
    """One answer of a run, without its arrays.

    Args:
        number: place of the answer in the run by its log time, from 0, by which Bag.frames reads it.
        sequence: number that the node gave the answer; it starts again where a node was started again.
        clock: number of times that the stamps had gone back before it: the clock was set back.
        stamp_ns: stamp of the newest pose that it answers [ns].
        time: time since the first answer's stamp [s].
        load: force on the skin in all, sum of pressure times area [N]; NaN where the pressure is not known.
        peak: largest displacement [m].
        tools: names of the tools that load the skin.
        converged, in_range, why: flags of the answer, and its reason for them.
        solve_seconds: time that the node spent on it [s].
        latency: time from its last contact message to itself, by the recorder's clock [s]; NaN: unknown.
    """

    number: int
    sequence: int
    clock: int
    stamp_ns: int
    time: float
    load: float
    peak: float
    tools: tuple[str, ...]
    converged: bool
    in_range: bool
    why: str
    solve_seconds: float
    latency: float


@dataclass(frozen=True)
class Timing:
    """Rate, latency and losses of a run.

    Args:
        answers: number of recorded answers.
        instants: number of distinct stamps of poses under one clock, from the first answered one to the last.
        skipped: number of these that were never answered because a newer one came first (latest wins).
        lost: number of answers that were sent but are not in the bag: gaps in their sequence numbers.
        answer_rate, instant_rate: answers and instants a second [1/s].
        latencies: latency of every answer [s], NaN where unknown.
    """

    answers: int
    instants: int
    skipped: int
    lost: int
    answer_rate: float
    instant_rate: float
    latencies: np.ndarray

    @property
    def kept(self) -> float:
        """Share of the contact instants that were answered [-]."""
        return 1 - self.skipped / self.instants if self.instants else 1.0

    def latency(self, percent: float) -> float:
        """Percentile of the latency [s]; NaN where none is known."""
        known = self.latencies[np.isfinite(self.latencies)]
        return float(np.percentile(known, percent)) if len(known) else float("nan")


@dataclass(frozen=True, eq=False)
class Survey:
    """A run, looked over once; `method` answered its first frame."""

    bag: Run
    method: str
    moments: tuple[Moment, ...]
    timing: Timing


@dataclass(frozen=True, eq=False)
class _Note:
    """What is known of an answer when it is met: not yet its latency, nor its load where its layer comes later."""

    moment: Moment
    method: str
    log_time_ns: int
    layer_id: str
    layer: SoftLayer | None  # layer that the load was summed over


def survey(path: Path | str, namespace: str = "") -> Survey:
    """Looks over a run.

    Args:
        path: path of a folder, or of the .mcap file.
        namespace: namespace of the one robot that is meant, "/left"; "": there is but one.

    Raises:
        BagError: a run without answers or skin, or several robots and no namespace.
    """
    notes: list[_Note] = []

    def note(run: Run, frame: Frame) -> None:
        layer = run.known_layers().get(frame.layer_id)
        notes.append(_Note(_moment(frame, layer), frame.method, frame.log_time_ns, frame.layer_id, layer))

    run = Run(path, namespace, on_answer=note)
    if not run.answers:
        raise BagError(f"{run.file} holds no answers. Did the node see the tool's mesh, pose and wrench?")
    notes.sort(key=lambda one: one.log_time_ns)  # as Bag.frames has them, in whatever order the file does
    _number(notes)
    late = [k for k, one in enumerate(notes) if one.layer is None or one.layer is not run.layers[one.layer_id]]
    for number, frame in zip(late, run.frames(late), strict=True):  # their layer, or the exact one, came after them
        moment = replace(notes[number].moment, load=_load(frame, run.layer_of(frame)))
        notes[number] = replace(notes[number], moment=moment)
    moments = [replace(one.moment, latency=_latency(one, run)) for one in notes]
    return Survey(run, notes[0].method, tuple(moments), _timing(moments, run))


def _number(notes: list[_Note]) -> None:
    """Tells each answer its place, clock and time, by those before it."""
    clock, first, last = 0, notes[0].moment.stamp_ns, 0
    for number, one in enumerate(notes):
        stamp = one.moment.stamp_ns
        clock, last = clock + (stamp < last), stamp
        moment = replace(one.moment, number=number, clock=clock, time=(stamp - first) * NANO)
        notes[number] = replace(one, moment=moment)


def _moment(frame: Frame, layer: SoftLayer | None) -> Moment:
    """What an answer tells of itself: not yet its place among the others."""
    return Moment(
        number=0,
        sequence=frame.sequence,
        clock=0,
        stamp_ns=frame.stamp_ns,
        time=0.0,
        load=float("nan") if layer is None else _load(frame, layer),
        peak=frame.peak,
        tools=tuple(name for name, touch in frame.touches.items() if touch.presses),
        converged=frame.trust.converged,
        in_range=frame.trust.in_range,
        why=frame.trust.why,
        solve_seconds=frame.solve_seconds,
        latency=float("nan"),
    )


def _load(frame: Frame, layer: SoftLayer) -> float:
    """What presses on the skin in all [N], summed without BLAS, whose threads cost more than the sum itself."""
    return float("nan") if frame.pressure is None else float(np.sum(frame.pressure * layer.vertex_areas))


def _latency(note: _Note, run: Run) -> float:
    received = run.received.get(note.moment.stamp_ns, ())
    before = [one for one in received if one <= note.log_time_ns] or received
    return (note.log_time_ns - max(before)) * NANO if before else float("nan")


def _timing(moments: list[Moment], run: Run) -> Timing:
    stamps = [moment.stamp_ns for moment in moments]
    first, last = min(stamps), max(stamps)
    came = {stamp: times for stamp, times in run.pose_stamps.items() if first <= stamp <= last}
    answered = Counter(stamp for _, stamp in {(moment.clock, moment.stamp_ns) for moment in moments})
    instants = sum(came.values())
    jumps = np.diff([moment.sequence for moment in moments])
    lost = int((jumps[jumps > 0] - 1).sum())  # a step back is a node that was started again
    steps = np.diff(stamps)
    seconds = float(steps[steps > 0].sum()) * NANO  # of all clocks
    rate = 1 / seconds if seconds > 0 else float("nan")
    return Timing(
        answers=len(moments),
        instants=instants,
        skipped=max((Counter(came) - answered).total() - lost, 0),  # a lost answer did answer its instant
        lost=lost,
        answer_rate=(len(moments) - 1) * rate,
        instant_rate=(instants - 1) * rate,
        latencies=np.array([moment.latency for moment in moments]),
    )
