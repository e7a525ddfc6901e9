"""LatestWins: a thread that works on the newest of what it is given and drops what it had not begun."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from stmpl_core.errors import StmplError

log = logging.getLogger(__name__)


class LatestWins[T]:
    """One thread, at most one item waiting.

    Args:
        work: function that is called with each item, in this thread only.
        refuse: function that gets what `work` raised; the thread goes on, and what is no StmplError is logged too.
        name: name of the thread.
    """

    def __init__(self, work: Callable[[T], None], refuse: Callable[[str], None], name: str) -> None:
        self._work, self._refuse = work, refuse
        self._waiting: list[T] = []
        self._changed, self._closed = threading.Condition(), False
        self._busy = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> None:
        """Gives the thread something newer to do; never waits."""
        with self._changed:
            self._waiting = [item]
            self._changed.notify_all()

    @property
    def idle(self) -> bool:
        """Whether there is nothing left to do."""
        with self._changed:
            return not self._waiting and not self._busy

    def wait(self, timeout: float) -> bool:
        """Waits until there is nothing left to do; False if that takes longer than `timeout` [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._waiting and not self._busy, timeout)

    def close(self) -> None:
        """Ends the thread after what it is doing."""
        with self._changed:
            self._closed, self._waiting = True, []
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                item, self._busy = self._waiting.pop(), True
            try:
                self._work(item)
            except StmplError as error:
                self._refuse(str(error))
            except Exception as error:
                log.exception("%s failed", self._thread.name)
                self._refuse(f"{type(error).__name__}: {error}")
