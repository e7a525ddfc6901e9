"""Processes beside the node's: they end with it, yield to it, and import no ROS."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from stmpl_core.sdf import SignedDistance
from stmpl_core.tool import Tool

YIELDS = 5  # nice value: what answers goes first
BUILDERS = min(os.cpu_count() or 1, 4)  # processes that build distance fields, started as they are needed


class Beside[T]:
    """One job in a process of its own, so that nobody waits for it, and it can be given up at any moment.

    Args:
        do: function of a module, called there with `arguments`.

    Attributes:
        result: raises what `do` raises, or BrokenExecutor if the process died.
    """

    def __init__(self, do: Callable[..., T], *arguments: Any) -> None:
        self._pool = Pool(1)
        self.result: Future[T] = self._pool.submit(do, *arguments)

    def close(self) -> None:
        """Ends the process, whether the job is done or not."""
        self._pool.end()


class Builders:
    """Processes that build distance fields side by side; the first starts at once."""

    def __init__(self) -> None:
        self._pool = Pool(BUILDERS, _ready_to_build)
        self._pool.submit(os.getpid)

    @property
    def broken(self) -> bool:
        """Whether a process died."""
        return self._pool.broken

    def field(self, tool: Tool, margin: float) -> Future[SignedDistance]:
        """The distance field of a tool, `margin` [m] wide. May raise MeshError."""
        return self._pool.submit(_field, tool, margin)

    def close(self) -> None:
        """Ends the processes; what they build is dropped."""
        self._pool.end()


class _Deaf(SpawnProcess):
    """A process that Ctrl-C and a closed terminal do not reach: its imports take a second, so it starts with them
    blocked, and ends with the node."""

    def start(self) -> None:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Spawning(SpawnContext):
    Process = _Deaf


class Pool(ProcessPoolExecutor):
    """Processes that call `start` with `arguments` first.

    Args:
        workers: largest number of processes.
    """

    def __init__(self, workers: int, start: Callable | None = None, *arguments: Any) -> None:
        super().__init__(workers, _Spawning(), stand_beside, (start, *arguments))

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


def stand_beside(start: Callable | None = None, *arguments: Any) -> None:
    """What a process beside the node does first: it ends with the node, and yields to it."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_the_node, daemon=True).start()
    os.nice(YIELDS)
    if start:
        start(*arguments)


def _end_with_the_node() -> None:
    node = multiprocessing.parent_process()
    assert node
    node.join()
    os._exit(0)


def _ready_to_build() -> None:
    import igl  # noqa: F401
    from scipy import ndimage  # noqa: F401


def _field(tool: Tool, margin: float) -> SignedDistance:
    return SignedDistance.of(tool, margin=margin)
