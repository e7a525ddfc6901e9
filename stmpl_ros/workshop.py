"""Workshop: a process beside the node's for what takes long, so that no answer waits for fields, models or fits."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.arrays import Transform, Wrench
from stmpl_core.contact import Contact, ToolMesh
from stmpl_core.haptics import LocalContact, local_contact
from stmpl_core.layer import SoftLayer
from stmpl_core.methods import Zero
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.stiffness import Press, Stiffness, fit_stiffness

YIELDS = 5  # nice value: what answers goes first
FITTED = 60  # presses, evenly from the lightest to the hardest: a fit takes about 25 touches of each


class Placed(NamedTuple):
    """A tool, the number of its mesh, and where it stands: pose_body_from_tool (4, 4)."""

    tool: str
    mesh: int
    pose: Transform


class Pressed(NamedTuple):
    """A tool that pressed, and the wrench about its origin, in the body's axes (6,) [N, N m]."""

    placed: Placed
    wrench: Wrench


class Workshop:
    """Builds distance fields and local models, and fits stiffness, one job after the other.

    A thread would not do: libigl keeps the interpreter's lock for half a second, and a model takes 13 to 25 touches.
    Futures raise concurrent.futures.BrokenExecutor once the process has died; then make a new Workshop.

    Args:
        layer: that contacts are on.
    """

    def __init__(self, layer: SoftLayer) -> None:
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _start, (layer,))
        self._pid = self._pool.submit(os.getpid)  # starts it now
        self._fit: Future[Stiffness] | None = None

    def field(self, tool: str, mesh: int, surface: ToolMesh) -> Future[SignedDistance]:
        """The distance field of mesh number `mesh` of a tool, which the process keeps too. May raise MeshError."""
        return self._pool.submit(_field, tool, mesh, surface)

    def models(self, placed: Sequence[Placed], rotations: bool) -> Future[list[LocalContact]]:
        """The local model of each contact, without the others."""
        return self._pool.submit(_models, list(placed), rotations)

    def stiffness(self, presses: Sequence[Pressed]) -> Future[Stiffness]:
        """How stiff the skin is by these presses."""
        self._fit = self._pool.submit(_stiffness, list(presses))
        return self._fit

    def close(self) -> None:
        """Ends the process; what it has not begun is dropped, and a fit, which takes seconds, is broken off."""
        if self._fit and not self._fit.done() and self._pid.done():
            os.kill(self._pid.result(), signal.SIGTERM)
        self._pool.shutdown(wait=True, cancel_futures=True)


# In the process

_simulator: Simulator
_meshes: dict[str, dict[int, ToolMesh]] = {}


def stand_beside() -> None:
    """What a process beside the node does first: it ends with the node, and yields to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the node, which ends this process
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_the_node, daemon=True).start()
    os.nice(YIELDS)


def _start(layer: SoftLayer) -> None:
    global _simulator
    stand_beside()
    numba.set_num_threads(1)  # what answers goes first
    _simulator = Simulator(layer, Zero())


def _end_with_the_node() -> None:
    node = multiprocessing.parent_process()
    assert node
    node.join()
    os._exit(0)


def _field(tool: str, mesh: int, surface: ToolMesh) -> SignedDistance:
    field = _simulator.prepare_tool(surface)
    _meshes.setdefault(tool, {})[mesh] = surface
    return field


def _models(placed: list[Placed], rotations: bool) -> list[LocalContact]:
    models = []
    for tool, mesh, pose in placed:
        known = _meshes[tool]
        for older in [number for number in known if number < mesh]:
            del known[older]
        contact, field = Contact(tool, known[mesh], pose), _simulator.prepare_tool(known[mesh])
        models.append(local_contact(_simulator.toucher, contact, field, rotations=rotations))
    return models


def _stiffness(pressed: list[Pressed]) -> Stiffness:
    pressed = [one for one in pressed if one.placed.mesh in _meshes.get(one.placed.tool, {})]  # others are forgotten
    pressed.sort(key=lambda one: float(np.linalg.norm(one.wrench[:3])))
    chosen = [pressed[k] for k in np.unique(np.linspace(0, len(pressed) - 1, FITTED).astype(int))] if pressed else []
    presses = []
    for (tool, mesh, pose), wrench in chosen:
        surface = _meshes[tool][mesh]
        presses.append(Press(Contact(tool, surface, pose, wrench), _simulator.prepare_tool(surface)))
    return fit_stiffness(_simulator.toucher, presses)
