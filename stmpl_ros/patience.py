"""Patience: messages in frames of /tf wait until it says where these stood at their stamp; not for long."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.node import Node

from bags.wire import stamp_ns
from stmpl_ros.frames import Frames
from stmpl_ros.ticks import steady_timer

POLL_S = 4e-3  # time between two looks whether /tf came [s]
MOST = 2_000  # messages of a stream that wait


class _Waits(NamedTuple):
    message: Any
    until: float


class Patience:
    """Hands on messages as soon as their frame is known at their stamp, and refuses them after a while.

    Of messages of one stream that become known together only the newest is handed on. /tf must go on to the stamp of a
    message, since a frame that moves is elsewhere by the next one: a /tf that died leaves nothing known.

    Args:
        node: node whose timer looks.
        frames: frames.
        wait: longest wait [s].
    """

    def __init__(self, node: Node, frames: Frames, wait: Callable[[], float]) -> None:
        self._frames, self._wait = frames, wait
        self._streams: dict[str, tuple[deque[_Waits], Callable[[Any], None], Callable[[str, str], None]]] = {}
        self._timer = steady_timer(node, POLL_S, self._look) if frames.listens else None

    def put(self, stream: str, message: Any, take: Callable[[Any], None], refuse: Callable[[str, str], None]) -> None:
        """Hands a stamped message of a stream on, now or once its frame is known; or refuses it, by kind and reason."""
        if not self._frames.moves(message.header.frame_id):
            return take(message)
        first = deque[_Waits](maxlen=MOST), take, refuse
        waiting = self._streams.setdefault(stream, first)[0]
        waiting.append(_Waits(message, time.monotonic() + self._wait()))
        self._look_at(stream)

    def forget(self, stream: str | None = None) -> None:
        """Drops what waits, of one stream or of all."""
        for one in [stream] if stream else list(self._streams):
            self._streams.pop(one, None)

    def _look(self) -> None:
        for stream in list(self._streams):
            self._look_at(stream)

    def _look_at(self, stream: str) -> None:
        waiting, take, refuse = self._streams[stream]
        for k in range(len(waiting) - 1, -1, -1):  # the newest first
            message = waiting[k].message
            if not self._missing(message):
                for _ in range(k + 1):
                    waiting.popleft()
                return take(message)
        while waiting and waiting[0].until <= time.monotonic():
            message = waiting.popleft().message
            refuse(f"tf of {stream}", f"the {stream} is in frame '{message.header.frame_id}', and /tf did not say "
                   f"within {self._wait():g} s where that was at its stamp: {self._missing(message)}")  # fmt: skip

    def _missing(self, message: Any) -> str:
        return self._frames.missing(message.header.frame_id, stamp_ns(message))
