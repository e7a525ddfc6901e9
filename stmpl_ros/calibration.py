"""Calibration: keeps what a node's tools did, and finds stiffness, friction or relaxation of it for `~/calibrate`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np
from rclpy.node import Node
from stmpl_msgs.srv import Calibrate

from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput
from stmpl_core.stiffness import WRONG_WAY, Stiffness
from stmpl_core.strokes import Fading, Rubbing
from stmpl_core.touch import MOVED, PULLING, TOUCHING, Touch
from stmpl_ros.inbox import Instant
from stmpl_ros.waiting import Aside, by_executor
from stmpl_ros.workshop import Workshop

KEPT = 400  # number of presses that are kept
APART = 1e-4  # way of a tool between two presses that are kept [m]
KEPT_INSTANTS = 6000  # number of instants of strokes that are kept
EVERY = 0.0095  # least time between two of them [s]: of what comes at 100 Hz, all
GAP = 0.5  # time from which two of them are of different presses [s]
CARRYING = frozenset((TOUCHING, MOVED))  # statuses of a tool whose wrench the skin carries


class Calibration:
    """The service `~/calibrate`, and the presses that it is about.

    Kept are instants at which one tool alone carried a wrench: at most KEPT for the stiffness, each some way from the
    last, and KEPT_INSTANTS for friction and relaxation, each some time from the last. They are in the body's frame, so
    they count on another skin too. The fit is made in the process beside the node.

    Args:
        node: node that serves.
        workshop: function that gives the node's workshop, or None while the node is not configured.
        apply: function that has the node answer with fields of NodeConfig from then on; may raise a StmplError.
    """

    def __init__(self, node: Node, workshop: Callable[[], Workshop | None], apply: Callable[..., str]) -> None:
        self._node, self._workshop, self._apply = node, workshop, apply
        self.presses: deque[Contact] = deque(maxlen=KEPT)
        self.strokes: deque[Contact] = deque(maxlen=KEPT_INSTANTS)  # with their times
        self.pulled: set[str] = set()  # tools that a wrench drew off the skin
        self._service = Aside(node, "calibrate",
                              lambda hidden, name: hidden.create_service(Calibrate, name, self._serve))  # fmt: skip

    def close(self) -> None:
        """Ends the service."""
        self._service.close()

    def forget(self) -> None:
        """Starts anew."""
        self.presses.clear()
        self.strokes.clear()
        self.pulled.clear()

    def put(self, instant: Instant, touches: Mapping[str, Touch]) -> None:
        """Keeps an instant if one tool alone pressed with a wrench, and has moved."""
        self.pulled |= {name for name, touch in touches.items() if touch.status == PULLING}
        pressing = [contact for contact in instant.contacts if touches[contact.name].status in CARRYING]
        if len(pressing) != 1 or sum(touch.wrench.any() for touch in touches.values()) > 1:
            return
        (contact,) = pressing
        time = instant.stamp * 1e-9
        if not (self.strokes and 0 <= time - self.strokes[-1].time < EVERY):
            self.strokes.append(replace(contact, time=time))
        last, moved = self.presses[-1] if self.presses else None, np.inf
        if last is not None and last.tool.digest == contact.tool.digest:
            moved = np.abs((contact.pose_body_from_tool - last.pose_body_from_tool)[:3, 3]).max()
        if moved >= APART:
            self.presses.append(contact)

    def _serve(self, request: Calibrate.Request, response: Calibrate.Response) -> Calibrate.Response:
        """On a thread of its own, which waits."""
        try:
            if request.apply and request.what == "relaxation":
                raise InvalidInput("relaxation is not applied: the node's `relaxing` is held skin's. Write the series "
                                   "to a file of stmpl needs, and set tissue to that.")  # fmt: skip
            found = by_executor(self._node, self._fit, request.what, request.tool).result()
            response = response_of(found)
            if request.apply and response.success:
                said = by_executor(self._node, lambda: self._apply(**_settings_of(found)))
                response.message += f"; {said}"
        except CancelledError:
            response.success, response.message = False, "given up: another skin took over, or the node ends"
        except Exception as error:  # whatever happened in the other process; the service goes on
            response.success, response.message = False, str(error) or type(error).__name__
        return response

    def _fit(self, what: str, tool: str) -> Future[Any]:
        if (workshop := self._workshop()) is None:
            raise InvalidInput("the node is not configured, so it has no skin to calibrate.")
        if what not in ("", "stiffness", "friction", "relaxation"):
            raise InvalidInput(f"there is no '{what}' to calibrate. Available: stiffness, friction, relaxation.")
        pressed = {one.name for one in (*self.strokes, *self.presses)}  # each forgets by its own measure
        if any(tool in ("", name) for name in self.pulled) and not any(tool in ("", name) for name in pressed):
            raise InvalidInput(WRONG_WAY)
        if tool and tool not in pressed:
            raise InvalidInput(f"'{tool}' has not pressed with a wrench of its own since the last ~/reset; "
                               f"{', '.join(sorted(pressed)) or 'no tool'} has.")  # fmt: skip
        if what in ("friction", "relaxation"):
            strokes = strokes_of(tool, self.strokes)
            return workshop.friction(strokes) if what == "friction" else workshop.relaxation(_longest(strokes))
        newest = {press.name: press.tool.digest for press in self.presses}  # a tool that changed is another one
        chosen = [press for press in self.presses if press.tool.digest == newest[press.name]]
        return workshop.stiffness([press for press in chosen if tool in ("", press.name)])


def strokes_of(tool: str, kept: Iterable[Contact]) -> list[Contact]:
    """The instants of a tool, empty: of the last one, as it is since it changed last; in order of time."""
    chosen = [(one, (one.name, one.tool.digest)) for one in kept if tool in ("", one.name)]
    return sorted((one for one, of in chosen if of == chosen[-1][1]), key=lambda one: one.time)


def _longest(strokes: list[Contact]) -> list[Contact]:
    """The press that lasts longest: instants without a gap."""
    times = [one.time for one in strokes]
    part = np.cumsum(np.diff(times, prepend=times[:1]) > GAP) if times else np.empty(0)
    presses = [[one for one, _ in some] for _, some in groupby(zip(strokes, part, strict=True), key=lambda one: one[1])]
    return max(presses, key=lambda press: press[-1].time - press[0].time, default=[])


def _settings_of(found: Stiffness | Rubbing) -> dict[str, Any]:
    """The node's settings that say what was found."""
    if isinstance(found, Rubbing):
        return {"friction": f"{found.friction:.3g}"}
    return {"youngs_modulus": found.youngs_modulus}


def response_of(found: Stiffness | Rubbing | Fading) -> Calibrate.Response:
    """What was found, as the service tells it; 0 where nothing was."""
    if not isinstance(found, Stiffness):
        value = found.friction if isinstance(found, Rubbing) else found.share
        said = [str(found)] * bool(np.isfinite(value)) + [found.trust.why] * bool(found.trust.why)
        if isinstance(found, Fading) and found.relaxation is not None:
            shares = ", ".join(f"{share:.3g} in {time:g} s" for share, time in
                               zip(found.relaxation.shares, found.relaxation.times, strict=True))  # fmt: skip
            said.append(f"of the materials' stress {shares}")
        both = (value, found.error) if np.isfinite(value) else (0.0, 0.0)
        names = ("friction", "friction_error") if isinstance(found, Rubbing) else ("fading", "fading_error")
        many = found.instants if isinstance(found, Rubbing) else 0
        return Calibrate.Response(success=found.trust.ok, message="; ".join(said), presses=many,
                                  **dict(zip(names, both, strict=True)))  # fmt: skip
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
