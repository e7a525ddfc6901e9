"""Interrupts: the signals that end a process, also where one comes in what swallows it, or tells of it otherwise."""

from __future__ import annotations

import signal
import sys
import threading
from contextlib import suppress
from typing import Any

AGAIN_S = 0.02  # time after which an interrupt that was swallowed is raised once more [s]
_swallowed: list[KeyboardInterrupt] = []


def endings() -> tuple[signal.Signals, ...]:
    """SIGINT, SIGTERM, and the SIGHUP of a terminal that was closed; not that where it is ignored (nohup)."""
    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    return signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hangs_up else ())


def interrupt_in(error: BaseException) -> KeyboardInterrupt | None:
    """The KeyboardInterrupt that an error tells of, as a compiled call or a compiler does, or that was swallowed before
    it; None: of none."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause or next(iter(_swallowed), None)


def raise_swallowed_again() -> None:
    """From here on an interrupt that Python cannot raise where it comes (as something is deleted, in a callback of a
    compiled library) is not printed with a traceback, but raised a moment later, where the process is then."""
    before, main = sys.unraisablehook, threading.main_thread().ident

    def heed(said: Any) -> None:
        if not issubclass(said.exc_type, KeyboardInterrupt):
            return before(said)
        number = next(iter(said.exc_value.args), signal.SIGINT) if said.exc_value else signal.SIGINT
        _swallowed.append(KeyboardInterrupt(number))
        with suppress(RuntimeError):  # Python ends already
            threading.Timer(AGAIN_S, signal.pthread_kill, (main, number)).start()  # which wakes what sleeps, too

    sys.unraisablehook = heed
