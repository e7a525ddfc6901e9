"""Interrupts: Ctrl-C and SIGTERM where they come in a call that tells of them by an error of its own."""

from __future__ import annotations


def interrupt_in(error: BaseException) -> KeyboardInterrupt | None:
    """The KeyboardInterrupt that an error tells of, as a compiled call or a compiler does; None: of none."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause
