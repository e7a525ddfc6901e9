"""Compiling: how kernels are, and who waits for it, which the first time takes minutes, is told."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from numba.core.event import Event, Listener

# Options of kernels that do not allocate, and are called for each column: no references of arrays are counted, which
# the caller holds. The counts are atomic, and took more than half of the time of loops around distances.
UNCOUNTED: dict[str, Any] = {"_nrt": False}
TOLD_EVERY_S = 10.0  # time between two words on how far what takes long has come [s]


class Compiling(Listener):
    """Tells of kernels as they are compiled, the first one and then once in a while; those from disk are none.

    Args:
        tell: function that gets a sentence.
        after: time since the first of them before which nothing is told [s].
    """

    def __init__(self, tell: Callable[[str], None], after: float = 0.0) -> None:
        self._tell, self._many, self._told, self._first, self._after = tell, 0, 0.0, 0.0, after

    def on_start(self, event: Event) -> None:
        """Before one is compiled."""
        now, self._many = time.monotonic(), self._many + 1
        self._first = self._first or now
        if now - self._told >= TOLD_EVERY_S and now - self._first >= self._after:
            self._told = now
            self._tell(f"compiling kernels, number {self._many}; the first time takes minutes, then they are on disk")

    def on_end(self, event: Event) -> None:
        """After it."""
