"""Replay: answers the recorded contacts again, offline, and checks the answers against the recorded ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bags.frame import Frame
from bags.provenance import versions
from bags.reader import Bag, ContactLog
from stmpl_core.methods.base import Method
from stmpl_core.simulator import Simulator
from stmpl_core.touch import Answer


@dataclass(frozen=True, eq=False)
class Replayed:
    """A recorded answer and the one that the same contacts give now."""

    frame: Frame
    answer: Answer

    @property
    def identical(self) -> bool:
        """The displacement is the recorded one bit for bit, as float32."""
        return self.answer.displacement.astype(np.float32).tobytes() == self.frame.displacement.tobytes()

    @property
    def difference(self) -> float:
        """Largest Euclidean difference at any vertex [m]."""
        off = self.answer.displacement.astype(np.float32) - self.frame.displacement
        return float(np.linalg.norm(off, axis=1).max(initial=0.0))


@dataclass(frozen=True)
class ReplaySummary:
    """How a replay went.

    Args:
        method: that answered now.
        frames: that were replayed.
        identical: how many came out bit for bit as recorded.
        worst: largest difference at any vertex of any frame [m].
        first_difference: sequence number of the first frame that differs, or None.
        changed: what is another version now than when the run was recorded, "numpy 2.4 -> 2.5".
    """

    method: str
    frames: int
    identical: int
    worst: float
    first_difference: int | None
    changed: tuple[str, ...]

    def __str__(self) -> str:
        if self.identical == self.frames:
            return f"{self.frames} frames replayed with {self.method}, every one bit for bit as recorded."
        note = f" Changed since: {', '.join(self.changed)}." if self.changed else ""
        return (f"{self.frames - self.identical} of {self.frames} frames replayed with {self.method} differ, the first "
                f"is number {self.first_difference}, by up to {self.worst * 1e3:.3g} mm.{note}")


def replay(path: Path | str, method: Method, *, every: int = 1) -> Iterator[Replayed]:
    """Yields each recorded answer (or every n-th) with the one that its recorded contacts give now, in the run's order.

    Each is answered on the layer that it was answered on.

    Raises:
        BagError: the bag lacks answers, the layer, or a tool's mesh or pose.
    """
    bag = Bag(path)
    contacts = ContactLog(bag)
    simulator: Simulator | None = None
    for number, frame in enumerate(bag.frames()):
        if number % every == 0:
            layer = bag.layer_of(frame)
            if simulator is None or simulator.layer is not layer:
                simulator = Simulator(layer, method)
            answer = simulator.step(contacts.at(frame))
            if frame.fade < 1:  # the input had stopped: a share of the last answer was sent
                answer = replace(answer, displacement=frame.fade * answer.displacement)
            yield Replayed(frame, answer)


def replay_run(path: Path | str, method: Method, *, every: int = 1) -> ReplaySummary:
    """Replays a run and counts the answers that come out bit for bit as recorded. Raises BagError."""
    frames = identical = 0
    worst, first = 0.0, None
    for replayed in replay(path, method, every=every):
        frames += 1
        identical += replayed.identical
        if not replayed.identical:
            worst = max(worst, replayed.difference)
            first = replayed.frame.sequence if first is None else first
    then, now = Bag(path).provenance.versions, versions()
    changed = tuple(f"{k} {then[k]} -> {now.get(k, 'none')}" for k in then if now.get(k) != then[k])
    return ReplaySummary(method.name, frames, identical, worst, first, changed)
