"""Workshop: processes beside the node's for what takes long, so that no answer waits for fields, models or fits."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from typing import Any

import numpy as np
from rclpy.node import Node

from stmpl_core.contact import Contact
from stmpl_core.layer import SoftLayer
from stmpl_core.local_contact import LocalContact, local_contact
from stmpl_core.sdf import SignedDistance
from stmpl_core.stiffness import Stiffness, fit_stiffness
from stmpl_core.tool import Tool
from stmpl_core.toucher import Toucher, margin_on

YIELDS = 5  # nice value: what answers goes first
FITTED = 60  # presses, evenly from the lightest to the hardest: a fit takes about 25 touches of each
BUILDERS = min(os.cpu_count() or 1, 4)  # processes that build distance fields, started as they are needed

Then = Callable[[Future], None]


class Workshop:
    """Builds distance fields side by side; finds local models and fits stiffness in one process that knows the layer.

    A thread would not do: libigl keeps the interpreter's lock for half a second, and a model takes 13 to 25 touches.
    What is made comes back by the node's executor. A process that died is replaced.

    Args:
        node: node whose executor gets what was made.
        layer: layer that contacts are on.
    """

    def __init__(self, node: Node, layer: SoftLayer) -> None:
        self._node, self._layer, self._closed = node, layer, False
        self._fit: Future[Stiffness] | None = None
        self._start()

    def _start(self) -> None:
        self._builders = _pool(BUILDERS)
        self._models = _pool(1, _know, self._layer)
        self._pid = self._models.submit(os.getpid)  # starts it now

    def field(self, tool: Tool, do: Then) -> None:
        """Has the distance field of a tool built, for `do`. The future may raise MeshError."""
        self._then(self._builders.submit(_field, tool, margin_on(self._layer)), do)

    def models(self, contacts: Sequence[Contact], rotations: bool, do: Then) -> None:
        """Has the local model of each contact found, without the others, for `do`."""
        self._then(self._models.submit(_local_contacts, list(contacts), rotations), do)

    def stiffness(self, presses: Sequence[Contact]) -> Future[Stiffness]:
        """How stiff the skin is by these presses: for a thread that waits."""
        self._fit = self._models.submit(_stiffness, list(presses))
        self._then(self._fit, lambda future: self.renew(future.exception()))
        return self._fit

    def renew(self, error: BaseException | None) -> None:
        """Replaces the processes, if `error` says that one died."""
        if isinstance(error, BrokenExecutor) and not self._closed:
            self._node.get_logger().error(f"a process that builds distance fields or local models died: {error}")
            self._end()
            self._start()

    def close(self) -> None:
        """Ends the processes; nothing comes back any more."""
        self._closed = True
        self._end()

    def _end(self) -> None:
        """What was not begun is dropped, and a fit, which takes seconds, is broken off."""
        if self._fit and not self._fit.done() and self._pid.done() and not self._pid.exception():
            os.kill(self._pid.result(), signal.SIGTERM)
        for pool in (self._builders, self._models):
            pool.shutdown(wait=False, cancel_futures=True)

    def _then(self, future: Future, do: Then) -> None:
        then(self._node, future, lambda done: None if self._closed else do(done))


class Beside[T]:
    """One job in a process of its own, so that nobody waits for it, and it can be given up at any moment.

    Args:
        do: function of a module, called there with `arguments`.

    Attributes:
        result: raises what `do` raises, or BrokenExecutor if the process died.
    """

    def __init__(self, do: Callable[..., T], *arguments: Any) -> None:
        self._pool = _pool(1)
        self._pid = self._pool.submit(os.getpid)
        self.result: Future[T] = self._pool.submit(do, *arguments)

    def close(self) -> None:
        """Ends the process, whether the job is done or not."""
        if self._pid.done() and not self.result.done():
            os.kill(self._pid.result(), signal.SIGTERM)
        self._pool.shutdown(wait=False, cancel_futures=True)


def then(node: Node, future: Future, do: Then) -> None:
    """Calls `do` with the future by the executor of `node`, once it is done."""

    def done(future: Future) -> None:
        executor = node.executor
        if executor and not future.cancelled():
            executor.create_task(do, future)

    future.add_done_callback(done)


# In the processes

_toucher: Toucher


def _pool(workers: int, start: Callable | None = None, *arguments: Any) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), stand_beside, (start, *arguments))


def stand_beside(start: Callable | None = None, *arguments: Any) -> None:
    """What a process beside the node does first: it ends with the node, and yields to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the node, which ends this process
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


def _know(layer: SoftLayer) -> None:
    import numba

    global _toucher
    numba.set_num_threads(1)  # what answers goes first
    _toucher = Toucher(layer)


def _field(tool: Tool, margin: float) -> SignedDistance:
    return SignedDistance.of(tool, margin=margin)


def _local_contacts(contacts: list[Contact], rotations: bool) -> list[LocalContact]:
    return [local_contact(_toucher, contact, rotations=rotations) for contact in contacts]


def _stiffness(presses: list[Contact]) -> Stiffness:
    presses.sort(key=lambda one: 0.0 if one.wrench is None else float(np.linalg.norm(one.wrench[:3])))
    chosen = np.unique(np.linspace(0, len(presses) - 1, FITTED).astype(int)) if presses else []
    return fit_stiffness(_toucher, [presses[k] for k in chosen])
