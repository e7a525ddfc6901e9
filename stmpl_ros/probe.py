"""ProbeNode: simulated devices that publish mesh, pose and wrench at a steady rate along a script."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import NamedTuple

import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from stmpl_msgs.msg import ContactMesh, SkinTopology

from bags.wire import layer_from, pose_message, tool_message, wrench_message
from stmpl_core.layer import SoftLayer
from stmpl_ros.parameters import ProbeConfig
from stmpl_ros.scripts import Motion, Script, scripts_for
from stmpl_ros.spinning import TOLD_AFTER_S, ros
from stmpl_ros.topics import KEPT, STREAM

POLL_PERIOD_S = 0.05  # time between two looks while waiting


class Played(NamedTuple):
    """One device and the topics that it publishes on."""

    motion: Motion
    pose: Publisher
    wrench: Publisher


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
        deadline, told = time.monotonic() + self.config.patience, time.monotonic() + TOLD_AFTER_S
        while not self.topology:
            if time.monotonic() > told:
                self.get_logger().info(f"waiting {self.config.patience:g} s at most for skin/topology: is a node "
                                       "active?")  # fmt: skip
                told = deadline + 1
            if stop.is_set() or time.monotonic() > deadline:
                return None
            rclpy.spin_once(self, timeout_sec=POLL_PERIOD_S)
        return layer_from(self.topology)

    def announce(self, script: Script, layer: SoftLayer, stop: threading.Event) -> list[Played] | None:
        """Publishes the meshes of a script's devices; None unless everybody listens to all of them in time."""
        devices = []
        for motion in (Motion(device, layer) for device in script.devices):
            name = motion.device.name
            pose = self.create_publisher(PoseStamped, f"tools/{name}/pose", STREAM)
            wrench = self.create_publisher(WrenchStamped, f"tools/{name}/wrench", STREAM)
            self.mesh.publish(tool_message(motion.tool, self.get_clock().now().nanoseconds))
            devices.append(Played(motion, pose, wrench))
        publishers = [publisher for device in devices for publisher in (device.pose, device.wrench)]
        return devices if self._wait_for_listeners(publishers, stop) else None

    def play(self, script: Script, devices: Sequence[Played], stop: threading.Event) -> bool:
        """Plays a script; True if all of it was sent."""
        assert self.topology
        frame = self.topology.header.frame_id
        self.get_logger().info(f"script '{script.name}': {script.seconds:g} s at {self.config.rate:g} Hz")
        period, count = 1 / self.config.rate, round(script.seconds * self.config.rate)
        started = time.perf_counter()
        for k in range(count):
            moments = [device.motion.at(k * period) for device in devices]
            time.sleep(max(0.0, started + k * period - time.perf_counter()))
            if stop.is_set():
                return False
            stamp = self.get_clock().now().nanoseconds
            for device, (pose, wrench) in zip(devices, moments, strict=True):
                device.wrench.publish(wrench_message(wrench, frame, stamp))
                device.pose.publish(pose_message(pose, frame, stamp))
        return True

    def _wait_for_listeners(self, publishers: Sequence, stop: threading.Event) -> bool:
        deadline = time.monotonic() + self.config.patience
        while any(p.get_subscription_count() < self.config.listeners for p in publishers):
            if stop.is_set():
                return False
            if time.monotonic() > deadline:
                counts = {p.topic_name: p.get_subscription_count() for p in publishers}
                self.get_logger().error(
                    f"nobody listens after {self.config.patience:g} s: {counts}; expected {self.config.listeners} "
                    "each. Is the node running on this ROS_DOMAIN_ID?"
                )
                return False
            rclpy.spin_once(self, timeout_sec=POLL_PERIOD_S)
        return True


def run(config: ProbeConfig, arguments: list[str] | None = None) -> int:
    """Plays the scripts; the exit code says whether all of every script was sent."""
    with ros(arguments) as stop:
        node = ProbeNode(config)
        try:
            layer = node.wait_for_skin(stop)
            if layer is None:
                waited = f"no skin/topology within {config.patience:g} s. Is the node active?"
                node.get_logger().error("interrupted as it waited for skin/topology" if stop.is_set() else waited)
                return 1
            known = scripts_for(layer)
            scripts = [known[name] for name in config.scripts]
            ready = [node.announce(script, layer, stop) for script in scripts]
            turns = zip(scripts, ready, strict=True)
            return 0 if all(devices and node.play(script, devices, stop) for script, devices in turns) else 1
        finally:
            node.destroy_node()
