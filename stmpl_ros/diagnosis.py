"""Diagnosis: what the node tells of itself once a second on /diagnostics."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from stmpl_core.trust import Trust
from stmpl_ros.limits import ADVISORY, Limits

RECENT = 1000  # number of answers whose times are kept


@dataclass
class Tally:
    """Counts between two reports, and since the start.

    Attributes:
        refused, stale: numbers of messages that could not be used, and that were too old.
        last_refusal: reason why the last one was refused.
        last_drop: reason why the last one was dropped, too old or out of order.
        answers: number of answers since the start.
        reactions: number of instants whose reaction was sent since the start.
        methods: number of answers since the last report, by method.
        solve_times: times spent on the fields of recent answers [s].
        latencies: times from the stamp of the pose to the publication of recent answers [s].
        touch_times: times spent on recent reactions [s].
        reaction_latencies: times from the stamp of the pose to the publication of recent reactions [s].
        doubt: that all fields of the last report were out of range, and why the newest was; empty: they were not.
    """

    refused: int = 0
    stale: int = 0
    last_refusal: str = ""
    last_drop: str = ""
    answers: int = 0
    reactions: int = 0
    methods: Counter[str] = field(default_factory=Counter)
    solve_times: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    touch_times: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    reaction_latencies: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    doubt: str = ""
    _trusts: list[Trust] = field(default_factory=list)  # of the fields since the last report
    _reported: tuple[int, int, float] = field(default_factory=lambda: (0, 0, time.monotonic()))

    def reacted(self, seconds: float, latency: float) -> None:
        """Counts a reaction."""
        self.reactions += 1
        self.touch_times.append(seconds)
        self.reaction_latencies.append(latency)

    def solved(self, seconds: float, latency: float, trust: Trust) -> None:
        """Counts a field, on its own thread."""
        self._trusts.append(trust)
        self.solve_times.append(seconds)
        self.latencies.append(latency)

    def values(self) -> dict[str, str]:
        """The figures of a report; the next one counts from here."""
        answers, reactions, since = self._reported
        self._reported = self.answers, self.reactions, time.monotonic()
        passed, methods, self.methods = max(self._reported[2] - since, 1e-9), self.methods, Counter()
        shares = {method: count / methods.total() for method, count in list(methods.items())}
        trusts, self._trusts = self._trusts, []
        doubted = [trust for trust in trusts if not trust.in_range]
        self.doubt = ""
        if len(doubted) == len(trusts) > 1:
            self.doubt = f"all {len(trusts)} answers of the last second are out of range: {doubted[-1].why}"
        return {
            "answers": str(self.answers),
            "rate [Hz]": f"{(self.answers - answers) / passed:.1f}",
            "reaction rate [Hz]": f"{(self.reactions - reactions) / passed:.1f}",
            **_percentiles("touch", self.touch_times),
            **_percentiles("reaction latency", self.reaction_latencies),
            **_percentiles("solve", self.solve_times),
            **_percentiles("latency", self.latencies),
            "out of range": f"{len(doubted)} of {len(trusts)}",
            "methods": ", ".join(f"{method} {share:.0%}" for method, share in shares.items()),
            "dropped, stale": str(self.stale),
            "refused": str(self.refused),
            "last refusal": self.last_refusal,
            "last dropped": self.last_drop,
        }


def _percentiles(what: str, seconds: deque[float]) -> dict[str, str]:
    milliseconds = 1e3 * np.array(list(seconds) or [0.0])
    median, worst = np.percentile(milliseconds, [50, 99])
    return {f"{what} median [ms]": f"{median:.3f}", f"{what} p99 [ms]": f"{worst:.3f}"}


class Counts:
    """What was counted since the last look."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def since(self, **now: int) -> dict[str, int]:
        """How much each count has grown."""
        grown = {name: count - self._last.get(name, 0) for name, count in now.items()}
        self._last = now
        return grown


class Health(NamedTuple):
    """How the node is, by what happened since the last report: what is over is no longer told.

    Args:
        lately: counts since the last report: reactions; and refused, stale, out_of_order, missed.
        refusal: why the last message was refused.
        drop: why the last message was dropped.
        fading: truth of the claim that the last answer fades, as input has stopped.
        live: truth of the claim that a tool is heard.
        doubt: why it is not known where the limb is, or no tool at all; or what an inactive node is at.
        active: truth of the claim that the node answers.
        senders: sentences on who sends for one tool beside another, or for one that cannot be used, is not heard, or
            has stopped to send wrenches; empty: nobody.
        out_of_range: sentence on answers that are all out of range; empty: they are not.
        paused: truth of the claim that the simulated clock stands still.
        building: names of tools whose distance field is being built.
    """

    lately: Mapping[str, int] = MappingProxyType({})
    refusal: str = ""
    fading: bool = False
    live: bool = False
    doubt: str = ""
    active: bool = True
    drop: str = ""
    senders: str = ""
    out_of_range: str = ""
    paused: bool = False
    building: tuple[str, ...] = ()

    @property
    def said(self) -> tuple[bytes, str]:
        """Level and sentence: ERROR: nothing that came could be used; STALE: what should come does not."""
        bad = {name: count for name, count in self.lately.items() if count and name != "reactions"}
        if not self.active:
            return DiagnosticStatus.STALE, "; ".join(filter(None, ("not active: nothing is answered", self.doubt)))
        why = [self.refusal] if "refused" in bad else []
        more = "; ".join(filter(None, (self.doubt or self.out_of_range, self.senders)))
        why += [self.drop] if bad.keys() & {"stale", "out_of_order"} else []
        if bad and not self.lately.get("reactions"):
            return DiagnosticStatus.ERROR, ": ".join(["nothing that came could be used", *why])
        if self.doubt and not bad:
            return DiagnosticStatus.STALE, self.doubt
        if self.fading:
            return DiagnosticStatus.STALE, "input has stopped: the last answer fades"
        if bad:
            told = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in bad.items())
            said = ": ".join([f"of the messages of the last second {told}", *why])
            return DiagnosticStatus.WARN, f"{said.rstrip('.')}; {more}" if more else said
        if more:
            return DiagnosticStatus.WARN, more
        said = "answering" if self.live else "at rest: no tool is heard"
        soon = f"; a distance field is being built for {', '.join(self.building)}" if self.building else ""
        return DiagnosticStatus.OK, f"{said}{'; the simulated clock is paused' if self.paused else ''}{soon}"


def skin_status(node: str, values: Mapping[str, str], health: Health) -> DiagnosticStatus:
    """Status of the answers."""
    level, message = health.said
    return _status(f"{node}: skin", level, message, values)


def limits_status(node: str, limits: Limits) -> DiagnosticStatus:
    """Status of the limits: largest shares since the last report."""
    warn, values = limits.take()
    message = f"at least {limits.warn_at:.0%} of a limit is used" if warn else "within the limits"
    level = DiagnosticStatus.WARN if warn else DiagnosticStatus.OK
    return _status(f"{node}: limits", level, f"{message} ({ADVISORY})", values)


def _status(name: str, level: bytes, message: str, values: Mapping[str, str]) -> DiagnosticStatus:
    told = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id="stmpl", values=told)


def diagnostics(statuses: list[DiagnosticStatus], now) -> DiagnosticArray:
    """The statuses as one message, stamped `now` (builtin_interfaces/Time)."""
    message = DiagnosticArray(status=statuses)
    message.header.stamp = now
    return message
