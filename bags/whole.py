"""Whole: how far two answers to the same contacts differ, part by part, as their messages carry them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from bags.frame import Frame
from bags.survey import Moment, Survey
from bags.wire import quaternion_from, rigid
from stmpl_core.touch import Answer, Touch

UNIT = 1e-3  # length that stands for the whole of a force or pressure [m]: a tolerance of 1e-4 mm holds it to 1e-4
MIN_FORCE = 1e-2  # force that a difference of wrenches is relative to at least [N]
MIN_PRESSURE = 1.0  # pressure that a difference of pressures is relative to at least [Pa]
ROUNDING = 1e-12  # difference of a pose that its quaternion makes [m], [-]

Differences = Mapping[str, float]  # by the name of a part; of those that differ


def differences(ours: Answer, theirs: Frame, *, replayed: bool = False) -> Differences:
    """Parts in which an answer is not as a recorded one, and how far off each is, empty where every bit is the same.

    Displacement, depth, pose and the bound on displacement in metres; pressure and wrenches as the share of the largest
    times UNIT, so that one tolerance holds all; what is no number on one side, and status and flags, are off by
    infinity. Methods have flags and bounds of their own: these are held between answers of one method only.
    The sentences are not held.

    Args:
        ours: answer that is judged.
        theirs: recorded answer.
        replayed: truth of the claim that ours is a replay: then the node may have had a reason of its own, which it
            tells in the recorded sentences, to flag what a replay does not.
    """
    if ours.displacement.shape != theirs.displacement.shape:
        return {"skin": math.inf}
    doubted = replayed and bool(set(_sentences(theirs)) - set(_sentences(ours)))
    off = {"displacement": _farthest(ours.displacement.astype(np.float32), theirs.displacement),
           "pressure": _pressures(ours, theirs)}  # fmt: skip
    if ours.method == theirs.method:
        flags = (ours.trust.converged, ours.trust.in_range), (theirs.trust.converged, theirs.trust.in_range)
        off |= {"trust": _flags(*flags, doubted), "bound": _bounds(ours, theirs)}
    if ours.touches.keys() != theirs.touches.keys():
        off["tools"] = math.inf
        return {part: much for part, much in off.items() if much}
    for name, touch in ours.touches.items():
        for part, much in _touches(touch, theirs.touches[name], told=bool(theirs.surfaces.get(name))).items():
            off[part] = max(off.get(part, 0.0), much)
        if ours.method == theirs.method:
            known = theirs.touches[name]
            off["trust"] = max(off["trust"], _flags((touch.trust.in_range,), (known.trust.in_range,), doubted))
            if theirs.surfaces.get(name):
                apart = UNIT * _apart(touch.force_bound, known.force_bound) / max(known.force, MIN_FORCE)
                off["bound on force"] = max(off.get("bound on force", 0.0), apart)
    return {part: much for part, much in off.items() if much}


def listed(off: Iterable[Differences]) -> str:
    """The parts that differ somewhere, as a sentence has them, and how far off the vertices are."""
    off = list(off)
    names = list(dict.fromkeys(part for parts in off for part in parts))
    said = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    worst = max(parts.get("displacement", 0.0) for parts in off)
    return f"{said}, by up to {worst * 1e3:.3g} mm at a vertex" if worst else said


@dataclass(frozen=True)
class Whole:
    """All answers that two recordings have in common, each held to the other in all its parts, as by a replay.

    Args:
        common: number of answers that both hold.
        alone: number of answers that only the judged recording holds, and only the other one.
        unlike: number of those in common of which only one remembers what was before; they are held to nothing.
        off: sequence number of each that differs, and its parts with how far off they are (whole.differences) [m].
        held: truth of the claim that they are held to the tolerance: one method answered both.
    """

    common: int
    alone: tuple[int, int]
    unlike: int
    off: tuple[tuple[int, Differences], ...]
    held: bool

    def past(self, tolerance: float) -> int | None:
        """Sequence number of the first that is past a tolerance [m]; None: none is, or they are not held to it."""
        return next((number for number, parts in self.off if self.held and max(parts.values()) > tolerance), None)

    def told(self, tolerance: float | None) -> str:
        """One sentence."""
        ours, theirs = self.alone
        said = f" {self.common} answers are in both"
        if ours or theirs:
            said += f", {ours} and {theirs} have no counterpart in the other and are not compared"
        if self.unlike:
            said += f", {self.unlike} have a memory in one only and are held to nothing"
        if not self.held:
            return said + "."
        if not self.off:
            return f"{said}; each of the rest is the same bit for bit." if any(self.alone) or self.unlike else (
                f"{said}, each the same bit for bit.")  # fmt: skip
        said += f"; {len(self.off)} differ in {listed(parts for _, parts in self.off)}"
        first = None if tolerance is None else self.past(tolerance)
        return said + ("." if first is None else f"; number {first} is the first past it.")


def in_common(run: Survey, other: Survey, late: int) -> dict[Moment, int]:
    """Answers of both to one stamp: ours, but for the first that are left out, and the number of the other's."""
    theirs = {key: moment.number for key, moment in zip(_keys(other), other.moments, strict=True)}
    ours = list(zip(_keys(run), run.moments, strict=True))[late:]
    return {moment: theirs[key] for key, moment in ours if key in theirs}


def _keys(run: Survey) -> Iterator[tuple[int, int, int]]:
    """Clock, stamp, and how often that stamp was answered before: again on a skin that has changed, say."""
    seen: Counter[tuple[int, int]] = Counter()
    for moment in run.moments:
        told = moment.clock, moment.stamp_ns
        yield *told, seen[told]
        seen[told] += 1


def whole(run: Survey, other: Survey, common: Mapping[Moment, int], late: int) -> Whole:
    """All answers in common, held to each other where one method gave both."""
    held, unlike, off = run.method == other.method, 0, []
    alone = len(run.moments) - late - len(common), len(other.moments) - len(common)
    pairs = zip(run.bag.frames(one.number for one in common), other.bag.frames(common.values()), strict=True)
    for frame, answer in pairs if held else ():
        if bool(frame.state) != bool(answer.state):
            unlike += 1
        elif parts := differences(frame, answer):
            off.append((frame.sequence, parts))
    return Whole(len(common), alone, unlike, tuple(off), held)


def _sentences(answer: Answer) -> list[str]:
    return [one for one in answer.trust.why.split("; ") if one]


def _touches(ours: Touch, theirs: Touch, *, told: bool) -> dict[str, float]:
    """How far two touches differ; `told`: the recorded one is of today's form, which tells all of it."""
    off = {"status": 0.0 if ours.status == theirs.status else math.inf}
    if np.isnan(theirs.wrench).all():  # recordings from before stmpl_msgs/Touch
        return off
    off |= {"wrench": _forces(ours.wrench, theirs.wrench, theirs.wrench), "depth": _apart(ours.depth, theirs.depth)}
    if told:
        stands = ours.pose_body_from_tool
        stands = rigid(stands[:3, 3].tolist(), quaternion_from(stands[:3, :3]))
        moved = _farthest(stands, theirs.pose_body_from_tool)
        off |= {"pose": moved if moved > ROUNDING else 0.0,
                "missing wrench": _forces(ours.missing, theirs.missing, theirs.wrench + theirs.missing),
                "slip": _slips(ours, theirs), "passive": UNIT * _apart(ours.passive, theirs.passive)}  # fmt: skip
    return off


def _slips(ours: Touch, theirs: Touch) -> float:
    one, other = ours.slip, theirs.slip
    if one is None or other is None:
        return 0.0 if one is other else math.inf
    return max(_forces(one.wrench, other.wrench, theirs.wrench), UNIT * _apart(one.share, other.share))


def _pressures(ours: Answer, theirs: Answer) -> float:
    if ours.pressure is None or theirs.pressure is None:
        return 0.0 if ours.pressure is theirs.pressure else math.inf
    largest = max(float(np.abs(theirs.pressure).max(initial=0.0)), MIN_PRESSURE)
    return UNIT * _farthest(ours.pressure.astype(np.float32)[:, None], theirs.pressure[:, None]) / largest


def _forces(ours: np.ndarray, theirs: np.ndarray, scale: np.ndarray) -> float:
    return UNIT * _farthest(ours, theirs) / max(float(np.abs(scale).max()), MIN_FORCE)


def _flags(ours: tuple[bool, ...], theirs: tuple[bool, ...], doubted: bool) -> float:
    same = all(one == other or (doubted and one) for one, other in zip(ours, theirs, strict=True))
    return 0.0 if same else math.inf


def _bounds(ours: Answer, theirs: Answer) -> float:
    one, other = ours.trust.error_bound, theirs.trust.error_bound
    if other is None:  # not told
        return 0.0
    return math.inf if one is None else _apart(float(np.float32(one)), float(np.float32(other)))


def _apart(one: float, other: float) -> float:
    """How far two numbers are apart: 0 where neither is one, infinite where one of them is not."""
    return _farthest(np.array([one]), np.array([other]))


def _farthest(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Largest Euclidean difference of any row; 0 where all is the same, infinite where one of them is no number."""
    if np.array_equal(ours, theirs, equal_nan=True):
        return 0.0
    largest = float(np.linalg.norm(np.atleast_2d(ours - theirs), axis=1).max(initial=0.0))
    return largest if np.isfinite(largest) and largest else math.inf
