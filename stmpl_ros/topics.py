"""How topics are delivered; docs/node.md says which topic takes which, and why."""

from typing import Any, cast

from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode
from rclpy.lifecycle.publisher import LifecyclePublisher
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

LEASE = 1.0  # silence on the bus after which a node is told to be gone, to listeners who ask for that [s]

KEPT = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # a robot's meshes, for late listeners too
NOW = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # the skin: late listeners get it
STREAM = QoSProfile(depth=10)
ANSWERS = QoSProfile(
    depth=100, liveliness=LivelinessPolicy.AUTOMATIC, liveliness_lease_duration=Duration(seconds=LEASE)
)  # a stream whose sender is told to be gone; a recorder may be held up for a second and lose nothing
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # inputs: overwritten while busy
SHOWN = QoSProfile(depth=1)  # pictures: the newest is enough


def newest_within(deadline: float) -> QoSProfile:
    """NEWEST, from senders only who offer at least this deadline [s]; 0: from any."""
    if not deadline:
        return NEWEST
    return QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT, deadline=Duration(seconds=deadline))


def as_offered(node: Node, topic: str, depth: int) -> QoSProfile:
    """A profile for who takes a topic as all of its present senders offer it; `depth` messages wait."""
    offered = [info.qos_profile for info in node.get_publishers_info_by_topic(topic)]
    reliable = all(one.reliability == ReliabilityPolicy.RELIABLE for one in offered)
    kept = all(one.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in offered)
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
    )


def managed(node: LifecycleNode, kind: Any, topic: str, profile: QoSProfile) -> LifecyclePublisher:
    """A publisher that is silent while the node is not active (rclpy's own annotation says less)."""
    return cast(LifecyclePublisher, node.create_lifecycle_publisher(kind, topic, profile))
