"""Workshop: a process beside the node's for what takes long, so that no answer waits for distance fields or models."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from typing import NamedTuple

from stmpl_core.arrays import Transform
from stmpl_core.contact import Contact, ToolMesh
from stmpl_core.haptics import LocalContact, local_contact
from stmpl_core.layer import SoftLayer
from stmpl_core.methods import Zero
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator

YIELDS = 5  # nice value: what answers goes first


class Placed(NamedTuple):
    """A tool, the number of its mesh, and where it stands: pose_body_from_tool (4, 4)."""

    tool: str
    mesh: int
    pose: Transform


class Workshop:
    """Builds distance fields and local models, one job after the other.

    A thread would not do: libigl keeps the interpreter's lock for half a second, and a model takes 13 to 25 touches.
    Futures raise concurrent.futures.BrokenExecutor once the process has died; then make a new Workshop.

    Args:
        layer: that contacts are on.
    """

    def __init__(self, layer: SoftLayer) -> None:
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _start, (layer,))
        self._pool.submit(os.getpid)  # starts it now

    def field(self, tool: str, mesh: int, surface: ToolMesh) -> Future[SignedDistance]:
        """The distance field of mesh number `mesh` of a tool, which the process keeps too. May raise MeshError."""
        return self._pool.submit(_field, tool, mesh, surface)

    def models(self, placed: Sequence[Placed], rotations: bool) -> Future[list[LocalContact]]:
        """The local model of each contact, without the others."""
        return self._pool.submit(_models, list(placed), rotations)

    def close(self) -> None:
        """Ends the process; what it was not yet asked to begin is dropped."""
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
