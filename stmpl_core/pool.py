"""Pool: processes that end with the one that started them, and that Ctrl-C does not reach."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from types import TracebackType
from typing import Any

YIELDS = 5  # nice value of processes beside one that answers, which goes first
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class _Deaf(SpawnProcess):
    """A process that Ctrl-C and a closed terminal do not reach: its imports take a second, so it starts with them
    blocked, and ends with who started it."""

    def start(self) -> None:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Spawning(SpawnContext):
    Process = _Deaf


class Pool(ProcessPoolExecutor):
    """Processes that call `start` with `arguments` first. As a context manager it ends them at once where that is left
    by an error or an interrupt.

    Args:
        workers: largest number of processes.
        yields: nice value: what has a lower one goes first.
    """

    def __init__(self, workers: int, start: Callable | None = None, *arguments: Any, yields: int = 0) -> None:
        super().__init__(workers, _Spawning(), _stand_beside, (yields, start, *arguments))

    @property
    def broken(self) -> bool:
        """Whether a process died."""
        return bool(self._broken)

    def end(self) -> None:
        """Ends the processes, whatever they are at, also while they import; what is not done is dropped."""
        if self._processes is not None:  # None: ended before
            queue: Any = self._result_queue
            queue._writer.close()  # else the pool's thread waits for ever for the rest of a result that was cut off
            for process in list(self._processes.values()):
                process.terminate()
        # waits for what ends at once: a pool's thread that still ends trips over an interpreter that ends too
        self.shutdown(wait=True, cancel_futures=True)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:  # fmt: skip
        if error is None:
            self.shutdown(wait=True)
        else:
            self.end()


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes that are started meanwhile take one thread for linear algebra and kernels."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _stand_beside(yields: int, start: Callable | None = None, *arguments: Any) -> None:
    """What a process does first: it ends with who started it, and yields to it."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_the_first, daemon=True).start()
    os.nice(yields)
    if start:
        start(*arguments)


def _end_with_the_first() -> None:
    first = multiprocessing.parent_process()
    assert first
    first.join()
    os._exit(0)
