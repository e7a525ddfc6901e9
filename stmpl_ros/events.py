"""Events: what the middleware tells of the input: devices that come and go, deadlines missed, messages lost."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_policy_name_from_kind
from rclpy.subscription import Subscription


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
