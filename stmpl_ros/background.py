"""Background: the workshop beside a node; what it makes comes back by the node's executor, and it is never gone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future

from rclpy.node import Node

from stmpl_core.contact import ToolMesh
from stmpl_core.layer import SoftLayer
from stmpl_core.stiffness import Stiffness
from stmpl_ros.workshop import Placed, Pressed, Workshop

Then = Callable[[Future], None]


def then(node: Node, future: Future, do: Then) -> None:
    """Calls `do` with the future by the executor of `node`, once it is done."""

    def done(future: Future) -> None:
        executor = node.executor
        if executor and not future.cancelled():
            executor.create_task(do, future)

    future.add_done_callback(done)


class Background:
    """A workshop for one layer. A process that died is replaced, and told of the meshes that it should know.

    Args:
        node: whose executor gets what was made.
        layer: that contacts are on.
    """

    def __init__(self, node: Node, layer: SoftLayer) -> None:
        self._node, self._layer = node, layer
        self._workshop = Workshop(layer)
        self._meshes: dict[str, tuple[int, ToolMesh]] = {}
        self._closed = False

    def field(self, tool: str, number: int, mesh: ToolMesh, do: Then) -> None:
        """Has the distance field of a tool's mesh built, for `do`."""
        self._meshes[tool] = number, mesh
        self._then(self._workshop.field(tool, number, mesh), do)

    def models(self, placed: Sequence[Placed], rotations: bool, do: Then) -> None:
        """Has the local model of each contact found, for `do`."""
        self._then(self._workshop.models(placed, rotations), do)

    def stiffness(self, presses: Sequence[Pressed]) -> Future[Stiffness]:
        """How stiff the skin is by these presses: for a thread that waits."""
        fitted = self._workshop.stiffness(presses)
        self._then(fitted, self._renew_if_broken)
        return fitted

    def renew(self, error: BaseException) -> None:
        """Replaces the process, if `error` says that it died."""
        if isinstance(error, BrokenExecutor) and not self._closed:
            self._node.get_logger().error(f"the process that builds distance fields and local models died: {error}")
            self._workshop = Workshop(self._layer)
            for tool, (number, mesh) in self._meshes.items():
                self._workshop.field(tool, number, mesh)

    def _renew_if_broken(self, future: Future) -> None:
        if error := future.exception():
            self.renew(error)

    def close(self) -> None:
        """Ends the process; nothing comes back any more."""
        self._closed = True
        self._workshop.close()

    def _then(self, future: Future, do: Then) -> None:
        then(self._node, future, lambda future: None if self._closed else do(future))
