"""BodyAction: `~/set_body` as an action: another skin with progress, which may be cancelled."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event
from typing import Any

from rclpy.action.server import ActionServer, CancelResponse, ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from stmpl_msgs.action import SetBody

from stmpl_core.errors import StmplError
from stmpl_ros.waiting import Aside, by_executor

FEEDBACK_S = 0.5  # time between two words of progress [s]
CANCELLED = "cancelled: the skin from before goes on"
NOT_YET = "counts when the node is configured"  # said of a change to a node that has no skin yet

Done = Callable[[str], None]  # called once, with the reason why another skin does not answer; empty: it does


class BodyAction:
    """Serves the action.

    Args:
        node: node that serves.
        begin: function that begins to make another skin, by the node's executor; raises StmplError.
        abandon: function that gives that up, likewise.
        layer_id: function that says which layer answers.
        active: function that says whether the node answers.
    """

    def __init__(self, node: Node, begin: Callable[[dict[str, Any], Done], str], abandon: Callable[[str], None],
                 layer_id: Callable[[], str], active: Callable[[], bool]) -> None:  # fmt: skip
        self._node, self._begin, self._abandon, self._layer_id, self._active = node, begin, abandon, layer_id, active
        self._aside = Aside(node, "set_body", self._offer, threads=2)

    def close(self) -> None:
        """Ends the action; give up what is being made first."""
        self._aside.close()

    def _offer(self, hidden: Node, name: str) -> ActionServer:
        return ActionServer(hidden, SetBody, name, self._execute, callback_group=ReentrantCallbackGroup(),
                            cancel_callback=lambda request: CancelResponse.ACCEPT)  # fmt: skip

    def _execute(self, goal: ServerGoalHandle) -> SetBody.Result:
        """On a thread of its own, which waits."""
        started, finished, why = time.monotonic(), Event(), list[str]()

        def done(reason: str) -> None:
            why.append(reason)
            finished.set()

        try:
            stage = by_executor(self._node, self._begin, changes_of(goal.request), done)
        except StmplError as error:  # not rejected: ROS says no reason then
            self._node.get_logger().warning(f"set_body refused: {error}")
            goal.abort()
            return SetBody.Result(message=str(error), layer_id=self._layer_id())
        while not finished.wait(FEEDBACK_S):
            goal.publish_feedback(SetBody.Feedback(stage=stage, seconds=time.monotonic() - started))
            if goal.is_cancel_requested:
                by_executor(self._node, self._abandon, CANCELLED)
        if not why[0]:
            goal.succeed()
            said = "the node answers on it" if self._active() else "the node answers on it once it is active"
            said = stage if stage == NOT_YET else said
            return SetBody.Result(success=True, message=said, layer_id=self._layer_id())
        if goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return SetBody.Result(message=why[0], layer_id=self._layer_id())


def changes_of(request: Any) -> dict[str, Any]:
    """What a request asks to change: its fields that are not empty or 0."""
    return {name: getattr(request, name) for name in request.get_fields_and_field_types() if getattr(request, name)}
