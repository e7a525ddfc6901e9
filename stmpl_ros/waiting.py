"""Aside: services and actions whose callbacks may wait, on threads of their own, while the node's executor goes on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from threading import Thread
from typing import Any

from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, ShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from stmpl_core.errors import InvalidInput

HANDOVER_S = 10.0  # time in which the node's executor comes to what is handed to it


class Aside:
    """A hidden node beside one, spun by threads of its own, for services and actions whose callbacks wait.

    A service callback has to return its response, and the EventsExecutor of rclpy 7.1.6 takes no coroutines
    (ros2/rclpy#1473). So what waits is called on a thread here; what touches the node it hands back with `by_executor`.

    Args:
        node: node that serves.
        name: name of what is offered.
        offer: function that creates it on the hidden node, under this full name; a remap of `~/NAME` counts.
        threads: number of threads; an action needs a second one to hear of a cancel.
    """

    def __init__(self, node: Node, name: str, offer: Callable[[Node, str], Any], threads: int = 1) -> None:
        self._hidden = Node(
            f"_{node.get_name()}_{name}", namespace=node.get_namespace(), context=node.context,
            use_global_arguments=False, enable_rosout=False, start_parameter_services=False,
        )  # fmt: skip
        self._offered = offer(self._hidden, node.resolve_service_name(f"~/{name}"))
        self._executor = (SingleThreadedExecutor(context=node.context) if threads == 1
                          else MultiThreadedExecutor(threads, context=node.context))  # fmt: skip
        self._executor.add_node(self._hidden)
        self._thread = Thread(target=self._spin, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends it; end what it may wait for first."""
        self._executor.shutdown(timeout_sec=0)
        self._thread.join(HANDOVER_S)
        self._hidden.destroy_node()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException, ShutdownException):
            self._executor.spin()


def by_executor[T](node: Node, do: Callable[..., T], *arguments: Any) -> T:
    """What `do` returns or raises, called by the node's executor. Raises InvalidInput if nobody spins the node."""
    done: Future[T] = Future()

    def act() -> None:
        try:
            done.set_result(do(*arguments))
        except BaseException as error:
            done.set_exception(error)

    if node.executor is None:
        raise InvalidInput("nobody spins the node.")
    node.executor.create_task(act)
    return done.result(HANDOVER_S)
