"""Answering: from an instant to its answer; what is said of it; and rest, when all tools are silent."""

from __future__ import annotations

import time

import numpy as np
from rclpy.lifecycle import LifecycleNode

from bags.frame import Stamps
from bags.wire import NANO
from stmpl_core.simulator import Simulator
from stmpl_core.touch import IN_CORE, NO_FORCE, NO_TOUCH, PULLING, WRAPPED, Answer
from stmpl_ros.calibration import Calibration
from stmpl_ros.diagnosis import Tally
from stmpl_ros.hearing import Hearing
from stmpl_ros.inbox import Instant
from stmpl_ros.limits import Limits
from stmpl_ros.remembering import ELASTIC, Before, Remembering
from stmpl_ros.sending import Sending
from stmpl_ros.settings import Settings

MAX_FIRST_DEPTH_M = 2e-3  # depth in a tool's first answer, beyond which it was not seen coming
WORTH_A_LINE = {
    NO_FORCE: "it touches, but its wrench is zero",
    PULLING: "nothing sticks, so nothing is loaded",
    NO_TOUCH: "it presses, but no skin is within reach along its force",
    WRAPPED: "its wrench does not say how hard it squeezes",
    IN_CORE: "its pose reaches into the rigid core",
}  # log lines of statuses that a person should look at


class Answering:
    """Answers instants, and fades the last answer to rest when no input comes any more.

    Args:
        node: node whose clock and logger are used.
        settings: settings as they are now.
        hearing: subscriptions and what they heard.
        tally: counts of answers and refusals.
        calibration: service that keeps presses.

    Attributes:
        simulator: simulator of the skin that answers.
        sending: publishers of the answers.
        limits: limits that answers are held against, or None.
        remembering: memory of the tissue.
        fading: flag of an answer that fades to rest.
    """

    simulator: Simulator
    sending: Sending

    def __init__(
        self, node: LifecycleNode, settings: Settings, hearing: Hearing, tally: Tally, calibration: Calibration
    ) -> None:
        self._node, self._settings, self._hearing, self._tally = node, settings, hearing, tally
        self._calibration = calibration
        self.limits: Limits | None = None
        self.remembering = Remembering()
        self.start_empty()

    def start_empty(self) -> None:
        """Forgets what was answered."""
        self.last: tuple[Answer, Instant, Before] | None = None  # None: at rest
        self.remembering.forget()
        self.fading = False
        self._seen: set[str] = set()  # tools of the last answer

    def answer(self, instant: Instant) -> None:
        """Answers an instant. Whatever goes wrong is told and counted, and the next one is answered."""
        gate, config = self._hearing.gate, self._settings.config
        started = time.perf_counter()
        try:
            back = self.remembering.went_back(instant)
            reaction = self.remembering.reaction(self.simulator, instant)
            answer = self.simulator.answer(reaction.touches)
        except Exception as error:  # the one place where an answer may fail
            tools = ", ".join(contact.name for contact in instant.contacts)
            return gate.refuse("answer", f"no answer to {tools}: {_told(error)}")
        if not np.isfinite(answer.displacement).all():
            statuses = {name: touch.status for name, touch in answer.touches.items()}
            return gate.refuse("answer", f"no answer: it would not be finite under {statuses}.")
        self.remembering.keep(reaction, instant)
        seconds = time.perf_counter() - started
        why = self._remarks(instant, answer, back)
        self._send(answer, instant.stamp, instant.inputs, reaction.before, solve_seconds=seconds, why=why)
        self.sending.contacts(instant, answer, config.local_rotations)
        self._calibration.put(instant, answer)
        self._tally.solve_times.append(seconds)
        self._tally.latencies.append((self._now() - instant.stamp) / NANO)
        if self.limits:
            self.limits.put(answer)
        if self.fading:
            self._node.get_logger().info("input is back")
        self.last, self.fading, gate.refused_since = (answer, instant, reaction.before), False, ""
        self._seen = set(answer.touches)

    def fade_if_silent(self) -> None:
        """Sends a share of the last answer, once no tool was heard for a while, and in the end rest."""
        now, config, gate = time.monotonic_ns(), self._settings.config, self._hearing.gate
        if self.last is None or self._hearing.inbox.live(now):
            return
        answer, instant, before = self.last
        silent, limit = self._hearing.inbox.silence(now) / NANO, config.rest_after
        left = 1 - (silent - limit) / config.fade if config.fade else 0.0
        why = f"no pose for {limit} s"
        if gate.refused_since:
            why = f"{why} that could be used (refused: {gate.refused_since})"
        self._seen = set()
        self.sending.models.forget()
        if left <= 0 or not answer.displacement.any():
            return self.rest(f"{why}: back at rest")
        if not self.fading:
            self.fading = True
            self.sending.rest(list(answer.touches), self._now())
            gate.say("fading", f"{why}: the last answer fades to rest within {config.fade} s")
        share = float(np.float32(left))  # as the message carries it
        faded = answer.faded(share, f"{why}: the last answer, faded to {left:.0%}")
        self._send(faded, self._now(), instant.inputs, before, fade=share)

    def on_other_skin(self) -> None:
        """Answers the last instant again, on the skin that took over; rest, if its tools are silent or not ready."""
        if self.last is None:
            return
        before, instant, _ = self.last
        self.remembering.forget()
        if self._hearing.inbox.live(time.monotonic_ns()) and all(one.name in self.simulator.tools
                                                                 for one in instant.contacts):  # fmt: skip
            self.answer(instant)
        if self.last[0] is before:
            self.rest("another skin")

    def without(self, name: str) -> None:
        """Tells that a tool, which was taken away, exerts nothing; rest, if no tool of the last answer is left."""
        self.remembering.forget(name)
        self.sending.rest([name], self._now())
        if self.last is not None and not any(tool in self._hearing.tools for tool in self.last[0].touches):
            self.rest(f"'{name}' was taken away: back at rest")

    def rest(self, why: str) -> None:
        """Sends the skin at rest."""
        tools = list(self.last[0].touches) if self.last else []
        self._send(self.simulator.step([]), self._now(), {}, ELASTIC, why=why)
        self.sending.rest(tools, self._now())
        self.start_empty()

    def _send(self, answer: Answer, stamp: int, inputs: Stamps, before: Before, **said: float | str) -> None:
        self.sending.answer(answer, stamp, inputs, **before._asdict(), **said)
        self._tally.answers = self.sending.sequence
        self._tally.methods[answer.method] += 1

    def _remarks(self, instant: Instant, answer: Answer, back: float) -> str:
        """What the node has to say of an answer beside what the core says; lines for what a person should look at."""
        say, rest_after = self._hearing.gate.say, self._settings.config.rest_after
        said = [f"stamps of tools and wrenches lie up to {instant.skew / 1e6:.1f} ms apart"] if instant.skew else []
        if back:
            said.append(f"the stamps went back by {back:.3g} s: no time passed for the tissue")
            say("stamps", said[-1])
        for stream in instant.lost:
            said.append(f"no {stream} for {rest_after} s: answered without it")
            say(f"lost {stream}", said[-1])
        for name, touch in answer.touches.items():
            if name not in self._seen and touch.depth > MAX_FIRST_DEPTH_M:
                said.append(f"{name} starts {1e3 * touch.depth:.1f} mm inside the skin")
                say(f"start of {name}", said[-1])
            if touch.status in WORTH_A_LINE:
                say(f"{name} {touch.status}", f"{name}: {touch.status}; {WORTH_A_LINE[touch.status]}")
        return "; ".join(said)

    def _now(self) -> int:
        return self._node.get_clock().now().nanoseconds


def _told(error: Exception) -> str:
    return str(error) or type(error).__name__
