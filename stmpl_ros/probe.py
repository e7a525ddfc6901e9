"""ProbeNode: simulated devices that publish mesh, pose and wrench at a steady rate along a script."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from stmpl_msgs.msg import ContactMesh, SkinTopology

from bags.messages import layer_from
from stmpl_core.layer import SoftLayer
from stmpl_ros.conversions import mesh_message, pose_message, wrench_message
from stmpl_ros.parameters import ProbeConfig
from stmpl_ros.scripts import SCRIPTS, Motion, Script
from stmpl_ros.spinning import ros
from stmpl_ros.topics import KEPT, STREAM

LOOK = 0.05  # s between two looks while waiting


class ProbeNode(Node):
    """Publishes what a device with a force sensor would: pose and wrench of one instant carry one stamp."""

    def __init__(self, config: ProbeConfig) -> None:
        super().__init__("probe")
        self.config = config
        self.topology: SkinTopology | None = None
        self.create_subscription(SkinTopology, "skin/topology", self._on_topology, KEPT)
        self.mesh = self.create_publisher(ContactMesh, "contact_mesh", KEPT)

    def _on_topology(self, message: SkinTopology) -> None:
        self.topology = message

    def wait_for_skin(self, stop: threading.Event) -> SoftLayer | None:
        """The layer that the node answers on; None if asked to stop or out of patience."""
        deadline = time.monotonic() + self.config.patience
        while not self.topology:
            if stop.is_set() or time.monotonic() > deadline:
                return None
            rclpy.spin_once(self, timeout_sec=LOOK)
        return layer_from(self.topology)

    def play(self, script: Script, layer: SoftLayer, stop: threading.Event) -> int:
        """Plays a script on the skin once everybody listens; returns how many instants were sent."""
        assert self.topology
        frame = self.topology.header.frame_id
        motions = [Motion(device, layer) for device in script.devices]
        topics = []
        for motion in motions:
            name = motion.device.name
            pose = self.create_publisher(PoseStamped, f"tools/{name}/pose", STREAM)
            wrench = self.create_publisher(WrenchStamped, f"tools/{name}/wrench", STREAM)
            topics.append((wrench, pose))
            self.mesh.publish(mesh_message(name, motion.mesh, self.get_clock().now().nanoseconds))
        if not self._wait_for_listeners([p for pair in topics for p in pair], stop):
            return 0
        self.get_logger().info(f"script '{script.name}': {script.seconds:g} s at {self.config.rate:g} Hz")
        period, count = 1 / self.config.rate, round(script.seconds * self.config.rate)
        started = time.perf_counter()
        for k in range(count):
            moments = [motion.at(k * period) for motion in motions]
            time.sleep(max(0.0, started + k * period - time.perf_counter()))
            if stop.is_set():
                return k
            stamp = self.get_clock().now().nanoseconds
            for (wrench_topic, pose_topic), (pose, wrench) in zip(topics, moments, strict=True):
                wrench_topic.publish(wrench_message(wrench, frame, stamp))
                pose_topic.publish(pose_message(pose, frame, stamp))
        return count

    def _wait_for_listeners(self, publishers: Sequence, stop: threading.Event) -> bool:
        deadline = time.monotonic() + self.config.patience
        while any(p.get_subscription_count() < self.config.listeners for p in publishers):
            if stop.is_set():
                return False
            if time.monotonic() > deadline:
                counts = {p.topic_name: p.get_subscription_count() for p in publishers}
                self.get_logger().error(
                    f"nobody listens after {self.config.patience:g} s: {counts}; expected {self.config.listeners} each. "
                    "Is the node running on this ROS_DOMAIN_ID?"
                )
                return False
            rclpy.spin_once(self, timeout_sec=LOOK)
        return True


def run(config: ProbeConfig, arguments: list[str] | None = None) -> int:
    """Plays the scripts; the exit code says whether all of every script was sent."""
    with ros(arguments) as stop:
        node = ProbeNode(config)
        try:
            layer = node.wait_for_skin(stop)
            if layer is None:
                node.get_logger().error(f"no skin/topology within {config.patience:g} s. Is the node running and active?")
                return 1
            return int(any(node.play(SCRIPTS[name], layer, stop) == 0 for name in config.scripts))
        finally:
            node.destroy_node()
