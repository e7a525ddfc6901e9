"""Ticks: the clock by which silence counts: of the simulation while there is one, else of the wall."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time_source import USE_SIM_TIME_NAME
from rclpy.timer import Timer

CLOCK = "/clock"
AHEAD_NS = 250_000_000  # time by which stamps lie after a clock that stands still, from which on it is not paused [ns]


def steady_timer(node: Node, period: float, do: Callable[[], None]) -> Timer:
    """A timer [s] that a simulation can neither stop nor slow."""
    return node.create_timer(period, do, clock=Clock(clock_type=ClockType.STEADY_TIME))


class Ticks:
    """Nanoseconds that go on by the simulated clock, so that a slow simulation is not silent, and a paused one neither.

    A simulation that is gone (nobody sends /clock, or stamps go on without it) leaves the wall's clock to count. The
    count itself never jumps.

    Args:
        node: node whose clock it is.

    Attributes:
        simulated: truth of the claim that the simulated clock counts, at the last look.
        paused: truth of the claim that it stood still between the last two looks, and stamps with it.
        doubt: sentence on a clock that is waited for and is gone, or stands still while stamps go on; empty: none.
        on_back: callback for a simulated clock that was set back.
    """

    def __init__(self, node: Node) -> None:
        self._node, self.simulated, self.paused, self._ahead, self._last = node, False, False, 0, 0
        self.doubt, self._stale = "", False
        self._looked = self._stamp = 0  # simulated time, and the newest message's stamp, at the last look [ns]
        self.on_back: Callable[[], None] = lambda: None
        threshold = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        self._jumps = node.get_clock().create_jump_callback(threshold, post_callback=self._back)

    def __call__(self) -> int:
        """Now [ns]."""
        self._last = self._source() + self._ahead
        return self._last

    def look(self, stamp: int = 0) -> None:
        """Looks whether a simulation is there, and goes on.

        Args:
            stamp: stamp of the newest message [ns].
        """
        asked = bool(self._node.get_parameter_or(USE_SIM_TIME_NAME).value)
        there = asked and self._node.count_publishers(CLOCK) > 0
        before, self._looked = self._looked, self._node.get_clock().now().nanoseconds
        stands, goes_on = self._looked == before, stamp != self._stamp and stamp - self._looked > AHEAD_NS
        self._stamp, self._stale = stamp, there and stands and (goes_on or self._stale)
        self.doubt = self._gone(there) if self._stale or asked > there else ""
        if (simulated := there and not self._stale) != self.simulated:
            now = self()
            self.simulated = simulated
            self._ahead = now - self._source()
        self.paused = simulated and stands

    def _gone(self, there: bool) -> str:
        since = f"stands still at {self._looked / 1e9:.2f} s" if self._looked else "says no time"
        return (f"use_sim_time is set and {CLOCK} {since}, {'while stamps go on' if there else 'and nobody sends it'}; "
                "silence counts by the wall's clock")  # fmt: skip

    def _source(self) -> int:
        return self._node.get_clock().now().nanoseconds if self.simulated else time.monotonic_ns()

    def _back(self, _: object) -> None:
        if self.simulated:
            self._ahead = self._last - self._source()
        self.on_back()
