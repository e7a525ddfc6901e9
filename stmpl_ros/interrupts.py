"""Interrupts: the signals that end a process, and where one comes in a call that tells of it by an error of its own."""

from __future__ import annotations

import signal


def endings() -> tuple[signal.Signals, ...]:
    """SIGINT, SIGTERM, and the SIGHUP of a terminal that was closed; not that where it is ignored (nohup)."""
    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    return signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hangs_up else ())


def interrupt_in(error: BaseException) -> KeyboardInterrupt | None:
    """The KeyboardInterrupt that an error tells of, as a compiled call or a compiler does; None: of none."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause
