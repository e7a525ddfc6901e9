"""Answering: from an instant to its reaction, sent at once, and to its field; rest, when all tools are silent."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numba
import numpy as np
from rclpy.lifecycle import LifecycleNode

from bags.frame import Stamps
from bags.wire import NANO
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction
from stmpl_core.simulator import Simulator
from stmpl_core.skin import Skin
from stmpl_core.tools import Tools
from stmpl_core.touch import IN_CORE, NO_FORCE, NO_TOUCH, PULLING, WRAPPED, Answer, Touch
from stmpl_ros.bending import Bending
from stmpl_ros.calibration import Calibration
from stmpl_ros.diagnosis import Tally
from stmpl_ros.hearing import Hearing
from stmpl_ros.inbox import Instant
from stmpl_ros.latest import LatestWins
from stmpl_ros.limits import Limits
from stmpl_ros.remembering import ELASTIC, Before, Reaction, Remembering
from stmpl_ros.sending import Sending
from stmpl_ros.settings import Settings

HELD_UP_S, HELD_UP = 0.9, 3  # time for sending an answer [s], and how many in a row that take longer are told
DEAF_S = 0.1  # time for a reaction beyond which the node was held up, so that it is no silence of a sensor
MAX_FIRST_DEPTH_M = 2e-3  # depth in a tool's first answer, beyond which it was not seen coming
WORTH_A_LINE = {
    NO_FORCE: "it touches, but its wrench is zero",
    PULLING: "nothing sticks, so nothing is loaded",
    NO_TOUCH: "it presses, but no skin is within reach along its force",
    WRAPPED: "its wrench does not say how hard it squeezes",
    IN_CORE: "its pose reaches into the rigid core",
}  # log lines of statuses that a person should look at
TURNED = "it touches, and its wrench is a torque without a force, which is not carried"


class Asked(NamedTuple):
    """A reaction whose field is wanted.

    Args:
        instant: instant that it answers.
        reaction: touches, and what they were made from.
        fields: simulator that finds the field.
        epoch: epoch of the node in which it counts.
        seconds: time that the reaction took [s].
        news: sentences that some answer must carry: this one, or a later one if it is overtaken.
        said: further sentences of the node.
        skin: skin where the limb's joints were.
        doubt: why that is not known; empty: it is.
    """

    instant: Instant
    reaction: Reaction
    fields: Simulator
    epoch: int
    seconds: float
    news: tuple[str, ...]
    said: tuple[str, ...]
    skin: Skin
    doubt: str


class Answering:
    """Answers instants: the reaction at once, on the executor's thread; the newest one's field on a thread of its own.

    Neither waits for the other: instants that come while a field is solved have their reaction, and the newest of them
    its field. The last answer fades to rest when no input comes any more. What is solved when the node starts anew
    (rest, another skin, a tool taken away) is of an epoch that is over, and not sent.

    Args:
        node: node whose clock and logger are used.
        settings: settings as they are now.
        hearing: subscriptions and what they heard.
        tally: counts of answers and refusals.
        calibration: service that keeps presses.
        bending: joints of the limb.

    Attributes:
        simulator: simulator of the skin that answers, for reactions.
        sending: publishers of the answers.
        limits: limits that reactions are held against, or None.
        remembering: memory of the tissue.
        last: last field that was sent, its instant, and what it was made from; None: rest, or another skin.
        fading: flag of an answer that fades to rest.
    """

    simulator: Simulator
    sending: Sending
    _fields: Simulator

    def __init__(
        self, node: LifecycleNode, settings: Settings, hearing: Hearing, tally: Tally, calibration: Calibration,
        bending: Bending,
    ) -> None:  # fmt: skip
        self._node, self._settings, self._hearing, self._tally = node, settings, hearing, tally
        self._calibration, self._bending = calibration, bending
        self.limits: Limits | None = None
        self.remembering = Remembering()
        self._field: LatestWins[Asked] | None = None
        self._hurry = threading.Event()
        self._held = 0  # answers in a row that took long to send
        self._sends, self._epoch = threading.RLock(), 0  # held while an answer is sent, or an epoch begins
        self._start_empty()

    # Life

    def move_to(self, skin: Skin, tools: Tools, friction: Friction | Mapping[str, Friction]) -> tuple[Simulator, ...]:
        """Answers on a skin from now on; the simulators of reactions and fields, which share it, but no scratch.

        What was remembered is forgotten, unless it is the same skin, with another friction.
        """
        before = getattr(self, "simulator", None)
        same = before is not None and before.skin is skin
        if not same:
            with self._sends:
                self._epoch, self.last = self._epoch + 1, None
        self.simulator, self._fields = Simulator(skin, tools=tools, friction=friction), Simulator(skin, tools=tools)
        if not (same and self.simulator.remembers):
            self.remembering.forget()
        self._bending.move_to(skin)
        return self.simulator, self._fields

    def open(self) -> None:
        """Starts the thread of the fields."""
        self._hurry.clear()
        self._field = LatestWins(self._solve, lambda why: self._hearing.gate.refuse("answer", why), "field")

    def close(self) -> None:
        """Forgets what was answered, and ends the thread."""
        self._start_empty()
        self._hurry.set()
        if self._field is not None:
            self._field.close()
            self._field = None

    def wake(self) -> None:
        """The thread of the fields goes on at once: how long it rests may have been changed."""
        self._hurry.set()

    def drop(self) -> None:
        """What is being solved is not sent any more."""
        with self._sends:
            self._epoch += 1

    def _start_empty(self) -> None:
        with self._sends:
            self._epoch += 1
            self.last: tuple[Answer, Instant, Before] | None = None
            self._news: dict[str, None] = {}  # in order; no answer carried them yet
        self.remembering.forget()
        self.fading = False
        self._instant: Instant | None = None  # last one that has a reaction; None: at rest
        self._seen: set[str] = set()  # its tools, while input comes

    # The reaction

    def answer(self, instant: Instant) -> bool:
        """Answers an instant; False if that failed, which is told and counted, and the next one is answered."""
        started = time.perf_counter()
        self._bend()
        back = self.remembering.went_back(instant)
        reaction = self._attempted(instant, lambda: self.remembering.reaction(self.simulator, instant))
        if reaction is None:
            return False
        assert self._field is not None
        useless = {one.name: self._useless(instant, one.name) for one in instant.contacts}
        reaction = reaction._replace(touches=[_flagged(touch, useless[touch.name]) for touch in reaction.touches])
        touches = {touch.name: touch for touch in reaction.touches}
        self.sending.reaction(instant, touches)
        self.remembering.keep(reaction, instant)
        seconds = time.perf_counter() - started
        if seconds > DEAF_S:
            self._bending.held_up(seconds)
        said = self._remarks(instant, touches, back)
        doubt, skin = self._bending.doubt, self.simulator.skin
        if doubt:
            self._hearing.gate.say("where the limb is", doubt)
        asked = Asked(instant, reaction, self._fields, self._epoch, seconds, tuple(self._news), said, skin, doubt)
        self._field.put(asked)
        doubts = {name: "; ".join(filter(None, (doubt, why))) for name, why in useless.items()}
        self.sending.models.put(instant, touches, reaction.before, doubts)
        if not any(skin.angles) and not doubt:  # a fit knows the skin at rest
            self._calibration.put(instant, touches)
        if self.limits:
            self.limits.put(reaction.touches)
        self._tally.reacted(seconds, (self._now() - instant.stamp) / NANO)
        if self.fading:
            self._node.get_logger().info("input is back")
        self._instant, self.fading, self._hearing.useless = instant, False, ""
        self._hurry.clear()
        self._seen = set(touches)
        return True

    def _useless(self, instant: Instant, name: str) -> str:
        """What was told of a tool and cannot be used: a wrench, a surface; empty: neither."""
        return "; ".join(filter(None, (instant.refused.get(name), self._hearing.outdated(name))))

    def _bend(self) -> bool:
        """Takes skin and memory to where the joints are now; whether they were elsewhere."""
        newest, before = self._bending.newest, self.simulator.skin
        if newest is None or newest is before or newest.angles == before.angles:
            return False
        self.remembering.state = self.simulator.move_to(newest, self.remembering.state)
        self._hearing.layer = newest.layer
        return True

    def follow(self) -> None:
        """Sends the skin where its joints are, while no tool is there to be answered."""
        if self._instant is None and self._bend():
            self._send(self.simulator.step([]), self._now(), {}, self._elastic, why=self._bending.doubt)

    @property
    def _elastic(self) -> Before:
        """What an answer without tools is made from."""
        return ELASTIC._replace(joints=self.simulator.skin.angles)

    def _attempted[T](self, instant: Instant, do: Callable[[], T]) -> T | None:
        """What `do` returns; None if it failed."""
        try:
            return do()
        except Exception as error:  # the one place where an answer may fail
            tools = ", ".join(contact.name for contact in instant.contacts)
            self._hearing.gate.refuse("answer", f"no answer to {tools}: {_told(error)}")
            return None

    def _remarks(self, instant: Instant, touches: Mapping[str, Touch], back: float) -> tuple[str, ...]:
        """What the node has to say of a reaction beside what the core says; lines for what a person should look at."""
        say, rest_after = self._hearing.gate.say, self._settings.config.rest_after
        said = [f"stamps of tools and wrenches lie up to {instant.skew / 1e6:.1f} ms apart"] if instant.skew else []
        if back:
            self._tell("stamps", f"the stamps went back by {back:.3g} s: no time passed for the tissue")
        for stream in instant.lost:
            said.append(f"no {stream} for {rest_after} s: answered without it")
            say(f"lost {stream}", said[-1])
        for name, touch in touches.items():
            if name not in self._seen and touch.depth > MAX_FIRST_DEPTH_M:
                self._tell(f"start of {name}", f"{name} starts {1e3 * touch.depth:.1f} mm inside the skin")
            if touch.status in WORTH_A_LINE:
                why = TURNED if touch.status == NO_FORCE and touch.missing[3:].any() else WORTH_A_LINE[touch.status]
                say(f"{name} {touch.status}", f"{name}: {touch.status}; {why}")
        return tuple(said)

    def _tell(self, kind: str, sentence: str) -> None:
        """A line, and news for the next answer."""
        self._hearing.gate.say(kind, sentence)
        with self._sends:
            self._news[sentence] = None

    # The field, on its own thread

    def _solve(self, asked: Asked) -> None:
        """Finds and sends the field of a reaction; then the thread rests, where a rate is set and input comes."""
        numba.set_num_threads(1)  # of this thread: a second one stalls for tens of milliseconds where its core is busy
        started, rate = time.perf_counter(), self._settings.config.field_rate
        self._find(asked, started)
        if rate:
            self._hurry.wait(max(0.0, started + 1 / rate - time.perf_counter()))

    def _find(self, asked: Asked, started: float) -> None:
        if asked.epoch != self._epoch:
            return  # over before it was begun; its tool may be gone
        instant, before = asked.instant, asked.reaction.before
        answer = self._attempted(instant, lambda: self._field_of(asked))
        if answer is None:
            return
        seconds = time.perf_counter() - started
        with self._sends:
            if asked.epoch != self._epoch:
                return
            why = "; ".join((*asked.news, *asked.said))
            self._send(answer, instant.stamp, instant.inputs, before, solve_seconds=asked.seconds + seconds, why=why,
                       surfaces=_surfaces(instant))  # fmt: skip
            self.last = answer, instant, before
            for sentence in asked.news:
                self._news.pop(sentence, None)
        self._tally.solved(seconds, (self._now() - instant.stamp) / NANO, answer.trust)

    def _field_of(self, asked: Asked) -> Answer:
        """The answer to touches. Raises InvalidInput if it would not be finite."""
        asked.fields.toucher.tools = self.simulator.tools.copy()  # which the executor may change meanwhile
        asked.fields.move_to(asked.skin)
        answer = asked.fields.answer(asked.reaction.touches, asked.reaction.after)
        if asked.doubt:
            answer = replace(answer, trust=answer.trust.also(asked.doubt, in_range=False))
        if not np.isfinite(answer.displacement).all():
            statuses = {name: touch.status for name, touch in answer.touches.items()}
            raise InvalidInput(f"the displacement would not be finite under {statuses}.")
        return answer

    # Rest

    def fade_if_silent(self) -> None:
        """Sends a share of the last answer, once no tool was heard for a while, and in the end rest."""
        now, config, gate = self._hearing.now(), self._settings.config, self._hearing.gate
        if self._instant is None or self._hearing.inbox.live(now):
            return
        if self._field is not None and not self._field.idle:
            self._hurry.set()
            return  # the last field comes first, without a rest before it
        silent, limit = self._hearing.inbox.silence(now) / NANO, config.rest_after
        left = min(1.0, 1 - (silent - limit) / config.fade) if config.fade else 0.0
        why = f"no pose for {limit} s"
        if self._hearing.useless:
            why = f"{why} that could be used (refused: {self._hearing.useless})"
        self._seen = set()
        self.sending.models.forget()
        if left <= 0 or self.last is None or not self.last[0].displacement.any():
            return self.rest(f"{why}: back at rest")
        answer, instant, before = self.last
        if not self.fading:
            self.fading = True
            self.sending.rest(list(answer.touches), self._now())
            gate.say("fading", f"{why}: the last answer fades to rest within {config.fade} s")
        share = float(np.float32(left))  # as the message carries it
        faded = answer.faded(share, f"{why}: the last answer, faded to {left:.0%}")
        self._send(faded, self._now(), instant.inputs, before, fade=share, surfaces=_surfaces(instant))

    def on_other_skin(self) -> None:
        """Answers the last instant again, on the skin that took over; rest, if its tools are silent or not ready."""
        instant = self._instant
        if instant is None:
            return
        ready = all(one.name in self.simulator.tools for one in instant.contacts)
        if not (ready and self._hearing.inbox.live(self._hearing.now()) and self.answer(instant)):
            self.rest("another skin")

    def on_time_back(self) -> None:
        """Rest, if anything was answered before a simulated clock was set back: that lies in its future."""
        if self._instant is not None:
            self.rest("the simulated clock went back: back at rest")

    def without(self, name: str) -> None:
        """Tells that a tool, which was taken away, exerts nothing; rest, if no tool of the last instant is left."""
        self.drop()
        self.remembering.forget(name)
        self.sending.rest([name], self._now())
        if self._instant is not None and not any(one.name in self._hearing.tools for one in self._instant.contacts):
            self.rest(f"'{name}' was taken away: back at rest")

    def rest(self, why: str) -> None:
        """Sends the skin at rest."""
        tools = [one.name for one in self._instant.contacts] if self._instant else []
        with self._sends:
            self._start_empty()
            self._send(self.simulator.step([]), self._now(), {}, self._elastic, why=why)
        self.sending.rest(tools, self._now())

    def _send(self, answer: Answer, stamp: int, inputs: Stamps, before: Before, **said: Any) -> None:
        with self._sends:
            started = time.monotonic()
            self.sending.answer(answer, stamp, inputs, **before._asdict(), **said)
            self._held = self._held + 1 if time.monotonic() - started > HELD_UP_S else 0
            if self._held >= HELD_UP:
                self._hearing.gate.say("held up", f"{self._held} answers in a row took a second to send. Fast DDS may "
                                       "wait for a listener that was killed, for ever: start this node anew, with "
                                       "FASTDDS_BUILTIN_TRANSPORTS=UDPv4, and a discovery range other than LOCALHOST")
            self._tally.answers = self.sending.sequence
            self._tally.methods[answer.method] += 1

    def _now(self) -> int:
        return self._node.get_clock().now().nanoseconds


def _surfaces(instant: Instant) -> dict[str, str]:
    return {one.name: one.tool.digest for one in instant.contacts}


def _flagged(touch: Touch, why: str) -> Touch:
    """The touch, flagged if there is a reason."""
    return touch.with_(trust=touch.trust.also(why, in_range=False)) if why else touch


def _told(error: Exception) -> str:
    return str(error) or type(error).__name__
