"""Calibration: keeps a node's presses, and finds from them how stiff the skin is, when `~/calibrate` asks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future

import numpy as np
from rclpy.node import Node
from stmpl_msgs.srv import Calibrate

from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput
from stmpl_core.stiffness import Stiffness
from stmpl_core.touch import MOVED, TOUCHING, Touch
from stmpl_ros.inbox import Instant
from stmpl_ros.waiting import WaitingService, by_executor
from stmpl_ros.workshop import Workshop

KEPT = 400  # number of presses that are kept
APART = 1e-4  # way of a tool between two presses that are kept [m]
CARRYING = frozenset((TOUCHING, MOVED))  # statuses of a tool whose wrench the skin carries


class Calibration:
    """The service `~/calibrate`, and the presses that it is about.

    Kept are instants at which one tool alone carried a wrench, at most KEPT, each some way from the last; they are in
    the body's frame, so they count on another skin too. The fit is made in the process beside the node.

    Args:
        node: node that serves.
        workshop: function that gives the node's workshop, or None while the node is not configured.
        apply: function that has the node answer with a Young's modulus [Pa] from then on; may raise a StmplError.
    """

    def __init__(self, node: Node, workshop: Callable[[], Workshop | None], apply: Callable[[float], str]) -> None:
        self._node, self._workshop, self._apply = node, workshop, apply
        self.presses: deque[Contact] = deque(maxlen=KEPT)
        self._service = WaitingService(node, Calibrate, "calibrate", self._serve)

    def close(self) -> None:
        """Ends the service."""
        self._service.close()

    def forget(self) -> None:
        """Starts anew."""
        self.presses.clear()

    def put(self, instant: Instant, touches: Mapping[str, Touch]) -> None:
        """Keeps an instant if one tool alone pressed with a wrench, and has moved."""
        pressing = [contact for contact in instant.contacts if touches[contact.name].status in CARRYING]
        if len(pressing) != 1 or sum(touch.wrench.any() for touch in touches.values()) > 1:
            return
        (contact,) = pressing
        last, moved = self.presses[-1] if self.presses else None, np.inf
        if last is not None and last.tool is contact.tool:
            moved = np.abs((contact.pose_body_from_tool - last.pose_body_from_tool)[:3, 3]).max()
        if moved >= APART:
            self.presses.append(contact)

    def _serve(self, request: Calibrate.Request, response: Calibrate.Response) -> Calibrate.Response:
        """On a thread of its own, which waits."""
        try:
            found = by_executor(self._node, self._fit, request.tool).result()
            response = response_of(found)
            if request.apply and response.success:
                response.message += f"; {by_executor(self._node, self._apply, found.youngs_modulus)}"
        except CancelledError:
            response.success, response.message = False, "given up: another skin took over, or the node ends"
        except Exception as error:  # whatever happened in the other process; the service goes on
            response.success, response.message = False, str(error) or type(error).__name__
        return response

    def _fit(self, tool: str) -> Future[Stiffness]:
        if (workshop := self._workshop()) is None:
            raise InvalidInput("the node is not configured, so it has no skin to calibrate.")
        newest = {press.name: press.tool for press in self.presses}  # a tool that changed is another one
        chosen = [press for press in self.presses if press.tool is newest[press.name]]
        return workshop.stiffness([press for press in chosen if tool in ("", press.name)])


def response_of(found: Stiffness) -> Calibrate.Response:
    """What was found, as the service tells it; 0 where nothing was."""
    known = bool(np.isfinite(found.youngs_modulus))
    said = [str(found)] * known + [found.trust.why] * bool(found.trust.why)
    return Calibrate.Response(
        success=found.trust.ok,
        message="; ".join(said),
        youngs_modulus=found.youngs_modulus if known else 0.0,
        relative_error=found.relative_error if known else 0.0,
        offset=found.offset if known else 0.0,
        residual=found.residual if known else 0.0,
        presses=found.presses,
    )
