"""Throttle: lets one log line of each kind through in a while, and tells how many it held back."""

from __future__ import annotations

import math


class Throttle:
    """One line of each kind in `every` seconds.

    Args:
        every: between two lines of one kind [s].
    """

    def __init__(self, every: float) -> None:
        self.every = every
        self._said: dict[str, tuple[float, int]] = {}

    def line(self, kind: str, text: str, now: float) -> str | None:
        """The line to log at `now` [s], or None; it tells how many of its kind were held back before it."""
        last, held = self._said.get(kind, (-math.inf, 0))
        if now - last < self.every:
            self._said[kind] = last, held + 1
            return None
        self._said[kind] = now, 0
        return f"{text} ({held} more like it before)" if held else text
