"""Events: what the middleware tells of topics: devices that come and go, deadlines missed, messages lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from rclpy.event_handler import EventHandler, SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_policy_name_from_kind
from rclpy.subscription import Subscription
from rclpy.waitable import Waitable

from stmpl_ros.ticks import steady_timer

LOOK_S = 0.1  # time between two looks at what happened [s]
NEWS = ("total_count_change", "current_count_change", "alive_count_change", "not_alive_count_change")


class PolledEvents(Node):
    """A node that looks for the events of its topics by a timer, so that topics can be closed while it spins.

    An event that waits in rclpy's EventsExecutor (7.1) while its topic is closed ends the process by a segmentation
    fault: what the executor held for it is let go without Python's lock (github.com/ros2/rclpy/issues/1644). So it
    hears of no event.
    """

    def __init__(self, name: str, **node_options: Any) -> None:
        super().__init__(name, **node_options)
        steady_timer(self, LOOK_S, self._look_for_events)

    @property
    def waitables(self) -> Iterator[Waitable]:
        """What the executor waits for beside topics, services and timers."""
        return (one for one in super().waitables if not isinstance(one, EventHandler))

    def _look_for_events(self) -> None:
        events = [one for one in super().waitables if isinstance(one, EventHandler)]
        for one in reversed(events):  # who came and went is last with rclpy; who is gone misses no deadline
            one._ready_to_take_data = True
            event = one.take_data()
            if any(getattr(event, name, 0) for name in NEWS):
                one.callback(event)


class Events:
    """Counts events of the middleware, and says what a person should know.

    Args:
        say: function that gets a kind, and a line.
    """

    def __init__(self, say: Callable[[str, str], None]) -> None:
        self._say = say
        self._senders: dict[str, int] = {}
        self.missed_deadlines = self.lost = 0
        self.supported = True

    def subscribe(self, node: Node, kind: Any, topic: str, callback: Callable, profile: QoSProfile, *,
                  raw: bool = False) -> Subscription:  # fmt: skip
        """A subscription whose events are told, as far as the middleware knows them; raw: the callback gets bytes."""
        told = SubscriptionEventCallbacks(
            deadline=partial(self._on_deadline, topic) if profile.deadline.nanoseconds else None,
            matched=partial(self._on_matched, topic),
            message_lost=self._on_lost,
            incompatible_qos=partial(self._on_incompatible, topic),
        )
        try:
            return node.create_subscription(kind, topic, callback, profile, event_callbacks=told, raw=raw)
        except UnsupportedEventTypeError:
            self.supported = False
            return node.create_subscription(kind, topic, callback, profile, raw=raw)

    def _on_deadline(self, topic: str, event: Any) -> None:
        self.missed_deadlines += event.total_count_change
        if event.total_count_change and self._senders.get(topic):
            self._say(f"deadline of {topic}", f"{topic}: the sender missed its deadline")

    def _on_matched(self, topic: str, event: Any) -> None:
        # A sender that was there before the subscription may have matched before anybody listened for it.
        before = self._senders[topic] if topic in self._senders else event.total_count - event.current_count
        self._senders[topic] = event.current_count
        if before and not event.current_count:
            self._say(f"senders of {topic}", f"{topic}: the sender is gone")
        if before <= 1 < event.current_count and topic.startswith("tools/"):
            self._say(f"senders of {topic}", f"{topic}: {event.current_count} senders; only one can be the tool")

    def _on_lost(self, event: Any) -> None:
        self.lost += event.total_count_change

    def _on_incompatible(self, topic: str, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        self._say(f"quality of {topic}", f"{topic}: a sender is not heard, for it does not offer the {policy} that is "
                  "asked for; see the QoS table in docs/node.md")  # fmt: skip
