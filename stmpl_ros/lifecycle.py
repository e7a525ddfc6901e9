"""Lifecycle: a node whose transitions may fail, or be asked for at the wrong time, and that serves on."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from stmpl_ros.events import PolledEvents
from stmpl_ros.interrupts import interrupt_in


def told[N: LifecycleNode](
    transit: Callable[[N, LifecycleState], TransitionCallbackReturn],
) -> Callable[[N, LifecycleState], TransitionCallbackReturn]:
    """A callback of the lifecycle; what fails in it, which rclpy would swallow, is told, and on_error comes next.

    Ctrl-C is no failure, also where a compiled call that it came in tells of it by a SystemError.
    """

    @wraps(transit)
    def wrapped(node: N, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transit(node, state)
        except Exception as error:
            if interrupt := interrupt_in(error):
                raise interrupt from None
            node.get_logger().error(f"{transit.__name__} failed: {type(error).__name__}: {error}")
            return TransitionCallbackReturn.ERROR

    return wrapped


class ServingNode(PolledEvents, LifecycleNode):
    """A lifecycle node that refuses a transition which its state does not know.

    In rclpy 7.1 the exception of such a call of `~/change_state` leaves the executor, and ends the process.
    """

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        service: Any = self._service_change_state
        self._change, service.callback = service.callback, self._on_change_state

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        known = {label: number for number, label, *_ in self._state_machine.available_transitions}
        asked = request.transition
        if asked.label in known or (not asked.label and asked.id in known.values()):
            return self._change(request, response)
        what = f"'{asked.label}'" if asked.label else asked.id
        possible = ", ".join(f"{label} ({number})" for label, number in known.items()) or "none"
        self.get_logger().warning(f"refused: there is no transition {what} from the state "
                                  f"'{self._state_machine.current_state[1]}'; possible are {possible}.")  # fmt: skip
        response.success = False
        return response
