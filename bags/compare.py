"""Compare: a sample of a run's frames against a reference solver, another method, or another bag."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

from bags.frame import Frame
from bags.provenance import allowance
from bags.run import BEGINNING, Run
from bags.survey import Moment, Survey, survey
from bags.whole import Whole, in_common, whole
from stmpl_core.contact import Contact
from stmpl_core.errors import BagError, InvalidInput, StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import Method
from stmpl_core.metrics import Score, mean_and_deviation, score
from stmpl_core.pool import Pool, one_thread_each
from stmpl_core.touch import Answer
from stmpl_core.trust import Displacement

log = logging.getLogger(__name__)

PEAKS = {"peak mm": "largest displacement of the reference (peak) mm", "at peak mm": "error at the peak mm",
         "at peak %": "error at the peak, of the peak's displacement %"}  # fmt: skip

Side = Callable[[Frame], Displacement]  # how one side of a comparison answers a frame


class Presser(Protocol):
    """A method that judges an answer by pressing its tools in once more (fem_tools.RigidFem)."""

    name: str

    def prepare(self, layer: SoftLayer) -> Self:
        """Keeps the layer."""
        ...

    def press(self, contacts: Sequence[Contact], answer: Answer) -> Displacement:
        """Displacement under these contacts, which `answer` answers."""
        ...


@dataclass(frozen=True, eq=False)
class FramePair:
    """Answers of both sides to one frame: under the same pressure, or with the same tools where they press.

    Args:
        number: place of the frame in the run, from 0.
        frame: recorded frame.
        layer: layer that both sides answer for.
        time: time since the first answer [s].
        load: force that presses on the skin in all [N].
        contacts: tools as they stood.
        ours: answer that is judged.
        reference: answer that it is judged by.
        score: score of ours against the reference.
        alike: whether both remember what was before (friction, relaxation), or neither does; else their difference is
            no error.
    """

    number: int
    frame: Frame
    layer: SoftLayer
    time: float
    load: float
    contacts: tuple[Contact, ...]
    ours: Displacement
    reference: Displacement
    score: Score
    alike: bool = True

    @property
    def judged(self) -> bool:
        """Whether the reference converged: only then it judges."""
        return self.reference.trust.converged


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of a run against a reference.

    Args:
        run: survey of the run: timeline, rate, latency, losses.
        method, reference: names of the two sides.
        pairs: sampled frames, in the order of time.
        failed: sampled frames that the reference could not solve, with its reason, by sequence number.
        tolerance: allowed mean error under the contact, in the worst frame [m]; None: no verdict is asked for.
        reason: sentence that tells why this tolerance, where nobody gave one.
        left_out: number of answers at the start that answer what was not recorded; none of them is sampled.
        whole: all answers in common with the recording that judges; None: a method does.
    """

    run: Survey
    method: str
    reference: str
    pairs: tuple[FramePair, ...]
    failed: dict[int, str]
    tolerance: float | None
    reason: str = ""
    left_out: int = 0
    whole: Whole | None = None

    @property
    def judged(self) -> tuple[FramePair, ...]:
        """The pairs whose reference converged."""
        return tuple(pair for pair in self.pairs if pair.judged)

    @property
    def heaviest(self) -> FramePair:
        """The pair under the largest load. Raises BagError if there is none."""
        if not self.pairs:
            raise BagError(f"{self.reference} solved none of {len(self.failed)} sampled frames.")
        return max(self.judged or self.pairs, key=lambda pair: pair.load)

    @property
    def most_tools(self) -> FramePair | None:
        """The heaviest pair with two tools or more on the skin, or None."""
        several = [pair for pair in self.pairs if sum(touch.presses for touch in pair.frame.touches.values()) > 1]
        return max(several, key=lambda pair: pair.load, default=None)

    @property
    def worst_under_contact(self) -> float:
        """Largest mean error under the contact of any judged frame [m]; NaN if no frame could be judged.

        Of frames that are alike, where there are any.
        """
        alike = [pair for pair in self.judged if pair.alike] or self.judged
        return max((pair.score.contact for pair in alike), default=float("nan"))

    @property
    def unlike(self) -> int:
        """Number of judged frames in which one side remembers what was before, and the other does not."""
        return sum(not pair.alike for pair in self.judged)

    @property
    def passed(self) -> bool:
        """Whether every sampled frame was judged and none, nor any of `whole`, is over the tolerance (if any)."""
        if self.failed or len(self.judged) < len(self.pairs) or not self.pairs:
            return False
        if self.tolerance is None:
            return True
        if self.whole and self.whole.past(self.tolerance) is not None:
            return False
        return self.unlike < len(self.judged) and self.worst_under_contact <= self.tolerance

    @property
    def verdict(self) -> str:
        """One sentence: what was compared, measured and allowed."""
        skipped = len(self.failed) + len(self.pairs) - len(self.judged)
        digits = 3 if self.tolerance is None or self.tolerance > 1e-6 else 7
        sentence = (f"{self.method} against {self.reference} on {len(self.judged)} frames: at most "
                    f"{self.worst_under_contact * 1e3:.{digits}f} mm on average under the contact")
        if self.tolerance is not None:
            why = f" ({self.reason})" if self.reason else ""
            sentence += f", allowed {self.tolerance * 1e3:.4g} mm{why}: {'passed' if self.passed else 'failed'}"
        if self.unlike:
            sentence += (f"; in {self.unlike} of them only one side has friction and relaxation, so their difference "
                         "is no error, and they are held to no tolerance")  # fmt: skip
        sentence += f"; {skipped} frames could not be judged." if skipped else "."
        late = f" The first {self.left_out} answers were left out: the bag has no contacts for them."
        return sentence + late * bool(self.left_out) + (self.whole.told(self.tolerance) if self.whole else "")


def compare_run(
    run: Path | str | Survey,
    reference: Method | Presser,
    *,
    frames: int = 12,
    method: Method | None = None,
    tolerance: float | None = None,
    tool: str = "",
    on_frame: Callable[[int, int], None] | None = None,
    workers: int = 1,
) -> Comparison:
    """Solves a sample of a run's frames by `reference`.

    A Method gets the very pressure that the run's answer had, and judges what was made of it: give a method too, since
    recorded answers also lie on their tools. A Presser gets the tools, and judges recorded answers whole; it presses
    elastic skin, so answers with friction or relaxation are not alike.

    The sample holds the frame under the largest load, the heaviest one with two tools on the skin, and others evenly
    over the loaded part of the run. Answers before the first whose contacts were recorded are left out.

    Args:
        run: recording: its folder, its .mcap file, or what a survey of it gave.
        reference: method that judges; it is prepared here.
        frames: number of frames to sample, >= 1.
        method: method that is judged under the same pressures; None judges the recorded answers.
        tolerance: allowed mean error under the contact in the worst frame [m].
        tool: name of the tool that alone is on the skin in a frame that is taken; empty: any tools.
        on_frame: callback with (done, total) before each frame, for a progress bar.
        workers: number of processes that the reference solves frames in, each with memory of its own; from 2 on it
            is pickled, and a script that asks for it must be one that can be imported (`if __name__ == "__main__"`).

    Raises:
        BagError: the run holds no answers, no loaded frame, or no pressures.
    """
    run = run if isinstance(run, Survey) else survey(run)
    judged = (lambda frame: frame) if method is None else _judge(method, run.bag, presses=False)
    names = (run.method if method is None else method.name, reference.name)
    elastic = (lambda frame: _elastic(frame, run.bag.layer_of(frame))) if method is None else (lambda frame: True)
    late = _left_out(run)
    picks = sample([moment for moment in run.moments[late:] if not tool or moment.tools == (tool,)], frames)
    workers = min(workers, len(picks))
    judge = _judge(reference, run.bag, hasattr(reference, "press"))
    with _ahead(run.bag, reference, picks, workers, judge) if workers > 1 else nullcontext(judge) as judge:
        return _compare(run, picks, names, judged, judge, tolerance, on_frame, late, alike=elastic)


def compare_bags(
    run: Path | str | Survey, other: Path | str | Survey, *, frames: int = 12, tolerance: float | None = None
) -> Comparison:
    """Compares the answers of two bags at the same stamps.

    Args:
        run: recording that is judged.
        other: recording that judges.
        frames: number of frames to sample, >= 1.
        tolerance: allowed mean error under the contact in the worst frame [m]; of two recordings of one method the
            allowed difference of all answers in common, in every part (whole.differences), too. Unless given, these
            are held to each other exactly where one processor made both, else to OTHER_PROCESSOR; two methods are not.

    Raises:
        BagError: different skins, or no stamp in common.
    """
    run, other = (one if isinstance(one, Survey) else survey(one) for one in (run, other))
    late = _left_out(run)
    common = in_common(run, other, late)
    if not common:
        raise BagError(f"{run.bag.file} and {other.bag.file} answer no common stamp. Compare a run with its replay.")
    picks = sample(list(common), frames)
    ours = run.bag.frames(moment.number for moment in picks)
    answers: dict[tuple[int, int], Frame] = {}  # by stamp and log time of ours
    for frame, answer in zip(ours, other.bag.frames(common[moment] for moment in picks), strict=True):
        answers[_key(frame)] = answer
        moved = len(answer.displacement)
        if moved != len(frame.displacement):
            raise BagError(f"{run.bag.file} moves {len(frame.displacement)} vertices, {other.bag.file} {moved}; "
                           "answers can be compared on one skin only.")  # fmt: skip
    names, reason = (run.method, f"{other.method} of {other.bag.file.parent.name}"), ""
    if tolerance is None and run.method == other.method:
        tolerance, reason = allowance(other.bag.provenance.processor, run.bag.provenance.processor)
    compared = _compare(
        run, picks, names, lambda frame: frame, lambda frame: answers[_key(frame)], tolerance, None, late, reason,
        alike=lambda frame: bool(frame.state) == bool(answers[_key(frame)].state),
    )  # fmt: skip
    return replace(compared, whole=whole(run, other, common, late))


def _key(frame: Frame) -> tuple[int, int]:
    return frame.stamp_ns, frame.log_time_ns


def sample(moments: Sequence[Moment], frames: int) -> list[Moment]:
    """A sample of the loaded moments, in order.

    Always there are the largest load and, if any, the largest load under two or more tools.

    Raises:
        InvalidInput: frames below 1.
        BagError: nothing was pressed in the whole run.
    """
    if frames < 1:
        raise InvalidInput(f"frames is {frames}; at least 1 is compared.")
    loaded = [moment for moment in moments if moment.load > 0]
    if not loaded:
        raise BagError(f"nothing pressed on the skin in any of {len(moments)} answers, so there is nothing to compare.")
    chosen = {max(loaded, key=lambda moment: moment.load)}
    several = [moment for moment in loaded if len(moment.tools) > 1]
    if several:
        chosen.add(max(several, key=lambda moment: moment.load))
    rest = [moment for moment in loaded if moment not in chosen]
    more = min(max(frames - len(chosen), 0), len(rest))
    chosen |= {rest[int((k + 0.5) * len(rest) / more)] for k in range(more)}
    return sorted(chosen, key=lambda moment: moment.number)


def headline(comparison: Comparison) -> list[tuple[str, str]]:
    """Rows of a comparison's table: name of a figure, and its value with unit."""
    timing, moments = comparison.run.timing, comparison.run.moments
    largest = max((moment.load for moment in moments if moment.load >= 0), default=float("nan"))
    rows = [
        ("method", comparison.method),
        ("reference", comparison.reference),
        ("contact instants", f"{timing.instants} at {timing.instant_rate:.1f} Hz"),
        ("answers", f"{timing.answers} at {timing.answer_rate:.1f} Hz"),
        ("rate kept", f"{100 * timing.kept:.2f} % ({timing.skipped} instants without an answer: newer ones "
         "came first, or the node was not active)"),
        ("answers lost", f"{timing.lost}"),
        ("latency, median", f"{1e3 * timing.latency(50):.2f} ms"),
        ("latency, 99 %", f"{1e3 * timing.latency(99):.2f} ms"),
        ("largest load on the skin", f"{largest:.3f} N"),
        ("frames compared", f"{len(comparison.judged)} of {len(comparison.pairs) + len(comparison.failed)} sampled"),
    ]
    if not comparison.judged:
        return rows
    mean, deviation = mean_and_deviation([pair.score for pair in comparison.judged])
    pairs = zip(mean.row().items(), deviation.row().values(), strict=True)
    return rows + [_figure_row(PEAKS.get(name, name), value, spread) for (name, value), spread in pairs]


def _figure_row(name: str, value: float, spread: float) -> tuple[str, str]:
    label, unit = name.rsplit(" ", 1)
    digits = 1 if unit == "%" else 4
    return (label, f"{value:.{digits}f} ± {spread:.{digits}f} {unit}")


def _compare(
    run: Survey,
    picks: list[Moment],
    names: tuple[str, str],
    ours: Side,
    reference: Side,
    tolerance: float | None,
    on_frame: Callable[[int, int], None] | None,
    left_out: int,
    reason: str = "",
    *,
    alike: Callable[[Frame], bool],
) -> Comparison:
    pairs: list[FramePair] = []
    failed: dict[int, str] = {}
    frames = run.bag.frames(moment.number for moment in picks)
    for done, (moment, frame) in enumerate(zip(picks, frames, strict=True)):
        if on_frame:
            on_frame(done, len(picks))
        try:
            pairs.append(_pair(run, moment, frame, ours(frame), reference(frame), alike(frame)))
        except StmplError as error:
            log.warning("frame %d cannot be compared: %s", frame.sequence, error)
            failed[frame.sequence] = str(error)
    return Comparison(run, *names, tuple(pairs), failed, tolerance, reason, left_out)


def _left_out(run: Survey) -> int:
    """Number of answers of the beginning before the first whose contacts were recorded; 0 where no answer's were."""
    first: int | None = None
    for number, frame in enumerate(run.bag.frames()):
        first = frame.log_time_ns if first is None else first
        try:
            run.bag.contacts(frame)
        except BagError:
            if frame.log_time_ns - first < BEGINNING:
                continue
        return number
    return 0


def _elastic(frame: Frame, layer: SoftLayer) -> bool:
    """Whether the answer is that of elastic skin without friction: nothing that it remembers counts."""
    rubs = any(touch.presses and frame.friction.get(name) for name, touch in frame.touches.items())
    return not frame.state or not (layer.tissue.relaxes or rubs)


def _pair(run: Survey, moment: Moment, frame: Frame, ours: Displacement, reference: Displacement,
          alike: bool) -> FramePair:  # fmt: skip
    layer = run.bag.layer_of(frame)
    figures = score(ours.displacement, reference.displacement, layer, _load(frame))
    contacts = tuple(run.bag.contacts(frame))
    return FramePair(moment.number, frame, layer, moment.time, moment.load, contacts, ours, reference, figures,
                     alike)  # fmt: skip


def _judge(side: Any, bag: Run, presses: bool) -> Side:
    """How a Method answers a frame, or a Presser; it is prepared again only where the layer changes."""
    layer: SoftLayer | None = None

    def answer(frame: Frame) -> Displacement:
        nonlocal side, layer
        load = _load(frame)
        if layer is not bag.layer_of(frame):
            layer = bag.layer_of(frame)
            side = side.prepare(layer)
        if not presses:
            return side.solve(load)
        return side.press([one for one in bag.contacts(frame) if frame.touches[one.name].presses], frame)

    return answer


@contextmanager
def _ahead(bag: Run, reference: Method | Presser, picks: Sequence[Moment], workers: int, alone: Side) -> Iterator[Side]:
    """The same by processes that each take the next of some frames; if one dies, the rest is solved `alone`, here."""
    numbers = [moment.number for moment in picks]
    with one_thread_each(), Pool(workers, _take, bag.file, bag.namespace, reference) as pool:
        solved = [pool.submit(_solved, number) for number in numbers]
        found = {_key(frame): one for frame, one in zip(bag.frames(numbers), solved, strict=True)}

        def answer(frame: Frame) -> Displacement:
            try:
                return found[_key(frame)].result()
            except BrokenProcessPool:
                log.warning("a process died, perhaps for want of memory; this frame is solved without it")
                return alone(frame)

        yield answer


_taken: list[tuple[Run, Side]] = []  # of a process of `_ahead`


def _take(file: Path, namespace: str, reference: Method | Presser) -> None:
    bag = Run(file, namespace)
    _taken.append((bag, _judge(reference, bag, hasattr(reference, "press"))))


def _solved(number: int) -> Displacement:
    bag, judge = _taken[0]
    return judge(next(iter(bag.frames([number]))))


def _load(frame: Frame) -> Load:
    if frame.pressure is None:
        raise BagError(f"answer {frame.sequence} does not say the pressure that it was solved for. "
                       "Replay the run first, and compare the replay.")
    return Load.contact(frame.pressure)

