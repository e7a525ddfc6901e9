"""Gate: counts and tells what of the input cannot be used, each kind of line once in a while."""

from __future__ import annotations

import math
import time
from typing import NamedTuple

from rclpy.node import Node

from bags.wire import NANO
from stmpl_ros.diagnosis import Tally

SAY_EVERY = 1.0  # time between two lines of the same kind [s]
OFTEN, RARELY = 5, 30.0  # lines of a kind in a row, after which they come this much apart [s]
ASKS = ". Are the clocks in step, or is this a replay?"
QUIET = 5.0  # time without a reason for a line, after which its kind is new again [s]


class _Said(NamedTuple):
    """Lines of a kind: when the last one was and when there was reason for one [s], how many were held back since it,
    and how many came in a row."""

    last: float = -math.inf
    asked: float = -math.inf
    held: int = 0
    row: int = 0


class Gate:
    """Check of each message: what is refused is counted and told.

    Args:
        node: node whose clock and logger are used.
        tally: counts of messages.

    Attributes:
        stamp: stamp of the last message that was looked at [ns].
        clock: what is wrong with the clock that ages are told by; empty: nothing.
    """

    def __init__(self, node: Node, tally: Tally) -> None:
        self._node, self._tally = node, tally
        self.stamp, self.clock = 0, ""
        self._said: dict[str, _Said] = {}  # by kind

    def fresh(self, stamp: int, max_age: float) -> bool:
        """Whether what is stamped [ns] is at most `max_age` [s] old; 0 takes any."""
        self.stamp, now = stamp, self._node.get_clock().now().nanoseconds
        age = (now - stamp) / NANO
        if not max_age or abs(age) <= max_age:
            return True
        self._tally.stale += 1
        if not now:
            self.drop("age", "a message was dropped, for there is no time yet: use_sim_time is set, and nothing was "
                      "heard on /clock")  # fmt: skip
            return False
        if not stamp:
            self.drop("age", "a message without a stamp was dropped: its header says the time 0. Its sender must say "
                      "when it holds; max_age:=0 accepts any age.")  # fmt: skip
            return False
        self.drop("age", f"a message stamped {abs(age):.2f} s {'before' if age > 0 else 'after'} now was dropped; "
                  f"allowed is {max_age} s{f': {self.clock}.' if self.clock else ASKS} max_age:=0 accepts any age.")
        return False

    @property
    def dropped(self) -> str:
        """Reason why the last message that came too late or out of order was dropped."""
        return self._tally.last_drop

    def refuse(self, kind: str, why: str) -> None:
        """Counts and tells of what cannot be used."""
        self._tally.refused += 1
        self._tally.last_refusal = why
        self.say(kind, f"refused: {why}")

    def drop(self, kind: str, why: str) -> None:
        """Tells of what came too late, or out of order."""
        self._tally.last_drop = why
        self.say(kind, why)

    def say(self, kind: str, text: str) -> None:
        """A warning, one of a kind in SAY_EVERY seconds, in RARELY once it goes on; it tells how many it held back."""
        now, said = time.monotonic(), self._said.get(kind, _Said())
        row = said.row if now - said.asked < QUIET else 0
        if now - said.last < (SAY_EVERY if row < OFTEN else RARELY):
            self._said[kind] = _Said(said.last, now, said.held + 1, row)
            return
        self._said[kind] = _Said(now, now, 0, row + 1)
        self._node.get_logger().warning(f"{text} ({said.held} more of its kind before)" if said.held else text)
