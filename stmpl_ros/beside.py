"""Processes beside the node's: they end with it, yield to it, and import no ROS."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from stmpl_core.pool import YIELDS, Pool
from stmpl_core.sdf import SignedDistance
from stmpl_core.tool import Tool

BUILDERS = min(os.cpu_count() or 1, 4)  # processes that build distance fields, started as they are needed


class Beside[T]:
    """One job in a process of its own, so that nobody waits for it, and it can be given up at any moment.

    Args:
        do: function of a module, called there with `arguments`.

    Attributes:
        result: raises what `do` raises, or BrokenExecutor if the process died.
    """

    def __init__(self, do: Callable[..., T], *arguments: Any) -> None:
        self._pool = Pool(1, yields=YIELDS)
        self.result: Future[T] = self._pool.submit(do, *arguments)

    def close(self) -> None:
        """Ends the process, whether the job is done or not."""
        self._pool.end()


class Builders:
    """Processes that build distance fields side by side; the first starts at once."""

    def __init__(self) -> None:
        self._pool = Pool(BUILDERS, _ready_to_build, yields=YIELDS)
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


def _ready_to_build() -> None:
    import igl  # noqa: F401
    from scipy import ndimage  # noqa: F401


def _field(tool: Tool, margin: float) -> SignedDistance:
    return SignedDistance.of(tool, margin=margin)
