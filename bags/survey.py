"""Survey: one pass over a run that gives its timeline, rate, latency and losses, without keeping its answers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bags.frame import Frame
from bags.reader import Bag, ContactLog
from stmpl_core.arrays import PerVertex
from stmpl_core.errors import BagError

NANO = 1e-9  # seconds in a nanosecond


@dataclass(frozen=True)
class Moment:
    """One answer of a run, without its arrays.

    Args:
        sequence: number of the answer.
        stamp_ns: of the newest pose that it answers [ns].
        time: since the first answer's stamp [s].
        load: that presses on the skin in all, sum of pressure times area [N]; NaN where the pressure is not known.
        peak: largest displacement [m].
        pressing: number of tools that load the skin.
        converged, in_range: the answer's own flags.
        solve_seconds: that the node spent on it [s].
        latency: from the last contact message that it answers to itself, by the recorder's clock [s]; NaN: unknown.
    """

    sequence: int
    stamp_ns: int
    time: float
    load: float
    peak: float
    pressing: int
    converged: bool
    in_range: bool
    solve_seconds: float
    latency: float


@dataclass(frozen=True)
class Timing:
    """Rate, latency and losses of a run.

    Args:
        answers: recorded displacement messages.
        instants: distinct stamps of contact messages, from the first answered one to the last.
        skipped: of these, how many were never answered because a newer one came first (latest wins).
        lost: answers that were sent but are not in the bag: gaps in their sequence numbers.
        answer_rate, instant_rate: per second [1/s].
        latencies: of every answer [s], NaN where unknown.
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

    bag: Bag
    contacts: ContactLog
    method: str
    moments: tuple[Moment, ...]
    timing: Timing


def survey(path: Path | str) -> Survey:
    """Looks over a run. Raises BagError if it holds no answers or no skin."""
    bag = Bag(path)
    contacts = ContactLog(bag)
    moments: list[Moment] = []
    first, method = 0, ""
    for frame in bag.frames():
        area = bag.layer_of(frame).vertex_areas
        first, method = first or frame.stamp_ns, method or frame.method
        moments.append(_moment(frame, (frame.stamp_ns - first) * NANO, area, _latency(frame, contacts)))
    if not moments:
        raise BagError(f"{bag.file} holds no answers. Did the node see the tool's mesh, pose and wrench?")
    return Survey(bag, contacts, method, tuple(moments), _timing(moments, contacts))


def _moment(frame: Frame, time: float, area: PerVertex, latency: float) -> Moment:
    load = float("nan") if frame.pressure is None else float(frame.pressure.astype(np.float64) @ area)
    return Moment(
        sequence=frame.sequence,
        stamp_ns=frame.stamp_ns,
        time=time,
        load=load,
        peak=frame.peak,
        pressing=sum(touch.presses for touch in frame.touches.values()),
        converged=frame.trust.converged,
        in_range=frame.trust.in_range,
        solve_seconds=frame.solve_seconds,
        latency=latency,
    )


def _latency(frame: Frame, contacts: ContactLog) -> float:
    received = contacts.received.get(frame.stamp_ns)
    return float("nan") if received is None else (frame.log_time_ns - received) * NANO


def _timing(moments: list[Moment], contacts: ContactLog) -> Timing:
    stamps = [moment.stamp_ns for moment in moments]
    first, last = min(stamps), max(stamps)
    instants = {stamp for stamp in contacts.pose_stamps if first <= stamp <= last}
    jumps = np.diff([moment.sequence for moment in moments])
    lost = int((jumps[jumps > 0] - 1).sum())  # a step back is a node that was started again
    seconds = (last - first) * NANO
    rate = 1 / seconds if seconds > 0 else float("nan")
    return Timing(
        answers=len(moments),
        instants=len(instants),
        skipped=max(len(instants - set(stamps)) - lost, 0),  # a lost answer did answer its instant
        lost=lost,
        answer_rate=(len(moments) - 1) * rate,
        instant_rate=(len(instants) - 1) * rate,
        latencies=np.array([moment.latency for moment in moments]),
    )
