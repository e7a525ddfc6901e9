"""SkinNode: answers each newest pose (and wrench) of the tools with the displacement of the skin."""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from stmpl_msgs.msg import ContactMesh, SkinDeformed, SkinDisplacement, SkinTopology
from visualization_msgs.msg import Marker

from bags.messages import layer_id, stamp_ns
from stmpl_core.contact import Contact, ToolMesh
from stmpl_core.errors import StmplError
from stmpl_core.layer import SoftLayer, Tissue
from stmpl_core.simulator import Simulator
from stmpl_core.trust import Displacement
from stmpl_ros.conversions import (
    NANO,
    checked_mesh,
    checked_pose,
    checked_wrench,
    deformed_message,
    displacement_message,
    topology_message,
)
from stmpl_ros.inbox import Inbox, Instant
from stmpl_ros.marker import SkinMarker
from stmpl_ros.parameters import METHODS, NodeConfig
from stmpl_ros.spinning import ros, spin
from stmpl_ros.topics import KEPT, NEWEST, STREAM

SAY_EVERY = 1.0  # s between two lines of the same warning


def layer_of(config: NodeConfig) -> SoftLayer:
    """The soft layer that the settings ask for. Raises InvalidInput."""
    from stmpl_core.body import Body  # takes seconds to import, and who brings a layer does not need it

    tissue = Tissue(config.youngs_modulus, config.poisson_ratio, config.density)
    return Body.anny().part(config.part, edge_length=config.edge_length, thickness=config.thickness, tissue=tissue)


def published(layer: SoftLayer) -> SoftLayer:
    """The layer rounded to float32, as messages carry it: whoever reads them has the very same layer."""
    return layer.with_(vertices=layer.vertices.astype(np.float32), thickness=layer.thickness.astype(np.float32))


def warm_up(simulator: Simulator) -> None:
    """Solves one contact of each kind, so that nothing is left to compile when the first real one comes."""
    corners = 0.01 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    mesh, layer, pose = ToolMesh.of(corners, faces), simulator.layer, np.eye(4)
    vertex = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    push = np.concatenate([-0.01 * layer.normals[vertex], np.zeros(3)])
    for away, wrench in ((0.009, push), (0.012, push), (0.009, None), (0.05, push)):
        pose[:3, 3] = layer.vertices[vertex] + away * layer.normals[vertex]
        simulator.step([Contact("warm up", mesh, pose, wrench)])


class SkinNode(LifecycleNode):
    """Tools announce their mesh on `contact_mesh`; from then on `tools/NAME/pose` and `tools/NAME/wrench` are heard.

    What comes in while an answer is being computed waits as the newest; older ones are never answered. A message that
    cannot be used is refused with a log line, and changes nothing.

    Args:
        config: settings, which ROS parameters override.
        build: makes the layer from the settings; give your own to answer for another skin.
    """

    def __init__(self, config: NodeConfig, build: Callable[[NodeConfig], SoftLayer] = layer_of) -> None:
        super().__init__("stmpl")
        self.config = config.declare_on(self)
        self._build = build
        self.inbox = Inbox(self.config.frame, int(self.config.rest_after * NANO))
        self.active = self.at_rest = False
        self.sequence = self.refused = self.stale = 0
        self.last_refusal = ""
        self.solve_times: deque[float] = deque(maxlen=1000)
        self.reported = (0, time.monotonic())

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Builds the layer, warms the method up, and opens all topics."""
        started = time.monotonic()
        try:
            self.layer = published(self._build(self.config))
            self.simulator = Simulator(self.layer, METHODS[self.config.method]())
            warm_up(self.simulator)
        except StmplError as error:
            self.get_logger().error(f"cannot be configured: {error}")
            return TransitionCallbackReturn.FAILURE
        self.layer_id = layer_id(self.layer)
        self._open_topics()
        gc.collect()
        gc.freeze()  # what is set up now stays: collections at run time need not look at it
        self.get_logger().info(f"configured in {time.monotonic() - started:.1f} s: {self.layer}")
        return super().on_configure(state)

    def _open_topics(self) -> None:
        publisher = self.create_lifecycle_publisher
        self.topology = publisher(SkinTopology, "skin/topology", KEPT)
        self.displacement = publisher(SkinDisplacement, "skin/displacement", STREAM)
        self.deformed = publisher(SkinDeformed, "skin/deformed", STREAM)
        self.marker = publisher(Marker, "skin/marker", 1)
        self.diagnostics = publisher(DiagnosticArray, "/diagnostics", STREAM)
        self.skin_marker: SkinMarker | None = None
        self.latest: tuple[np.ndarray, int] | None = None
        self.create_subscription(ContactMesh, "contact_mesh", self._on_mesh, KEPT)
        self.create_timer(self.config.rest_after / 4, self._rest_if_silent)
        self.create_timer(1 / self.config.marker_rate, self._show)
        self.create_timer(1.0, self._diagnose)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Sends the topology and starts to answer."""
        result = super().on_activate(state)
        self.topology.publish(topology_message(self.layer, self.config.frame, self._now()))
        self.active = True
        self.get_logger().info(f"answering with {self.simulator.method.name} on layer {self.layer_id}")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stops answering; what comes in meanwhile is not kept."""
        self.active = False
        return super().on_deactivate(state)

    # What comes in

    def _on_mesh(self, message: ContactMesh) -> None:
        name = message.header.frame_id
        try:
            mesh = checked_mesh(message)
            self.simulator.prepare_tool(mesh)
            known = name in self.inbox.tools
            self.inbox.put_mesh(name, mesh)
            if not known:
                self._listen_to(name)
        except (StmplError, ValueError) as error:
            self._refuse(f"mesh of '{name}' refused: {error}")

    def _listen_to(self, name: str) -> None:
        self.create_subscription(PoseStamped, f"tools/{name}/pose", partial(self._on_pose, name), NEWEST)
        self.create_subscription(WrenchStamped, f"tools/{name}/wrench", partial(self._on_wrench, name), NEWEST)
        mesh = self.inbox.tools[name].mesh
        self.get_logger().info(f"tool '{name}': {len(mesh.vertices)} vertices, {len(mesh.faces)} faces")

    def _on_pose(self, name: str, message: PoseStamped) -> None:
        if not self.active:
            return
        try:
            pose = checked_pose(message, name, self.config.frame)
        except StmplError as error:
            return self._refuse(str(error))
        if self._fresh(message):
            self.inbox.put_pose(name, pose, stamp_ns(message), time.monotonic_ns())
            self._answer_if_complete()

    def _on_wrench(self, name: str, message: WrenchStamped) -> None:
        if not self.active:
            return
        try:
            checked_wrench(message, name, self.config.frame)
        except StmplError as error:
            return self._refuse(str(error))
        if self._fresh(message):
            self.inbox.put_wrench(name, message, stamp_ns(message), time.monotonic_ns())
            self._answer_if_complete()

    def _fresh(self, message: Any) -> bool:
        age = (self._now() - stamp_ns(message)) / NANO
        if not self.config.max_age or abs(age) <= self.config.max_age:
            return True
        self.stale += 1
        self.get_logger().warning(
            f"a message stamped {age:+.2f} s before now was dropped; allowed is {self.config.max_age} s. Are the "
            "clocks in step, or is this a replay? max_age:=0 accepts any age.",
            throttle_duration_sec=SAY_EVERY,
        )
        return False

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.last_refusal = why
        self.get_logger().warning(f"refused: {why}", throttle_duration_sec=SAY_EVERY)

    # What goes out

    def _answer_if_complete(self) -> None:
        instant = self.inbox.take(time.monotonic_ns())
        if instant is not None:
            self._answer(instant)

    def _answer(self, instant: Instant) -> None:
        started = time.perf_counter()
        try:
            answer = self.simulator.step(instant.contacts)
        except StmplError as error:
            return self._refuse(f"no answer: {error}")
        seconds = time.perf_counter() - started
        why = f"stamps of tools and wrenches lie up to {instant.skew / 1e6:.1f} ms apart" if instant.skew else ""
        self._publish(answer, instant.stamp, seconds, why, instant.inputs)
        self.at_rest = False

    def _rest_if_silent(self) -> None:
        if not self.active or self.at_rest or not self.sequence or self.inbox.live(time.monotonic_ns()):
            return
        why = f"no pose for {self.config.rest_after} s: back at rest"
        self._publish(self.simulator.step([]), self._now(), 0.0, why, {})
        self.at_rest = True

    def _publish(
        self, answer: Displacement, stamp: int, seconds: float, why: str, inputs: dict[str, tuple[int, int]]
    ) -> None:
        message = displacement_message(
            answer,
            layer_id=self.layer_id,
            body_frame=self.config.frame,
            stamp_ns=stamp,
            sequence=self.sequence,
            solve_seconds=seconds,
            inputs=inputs,
        )
        message.why = "; ".join(filter(None, (message.why, why)))
        self.displacement.publish(message)
        self.sequence += 1
        self.solve_times.append(seconds)
        self.latest = answer.displacement, stamp
        if self.deformed.get_subscription_count():
            self.deformed.publish(deformed_message(message, self.layer.vertices))

    def _show(self) -> None:
        if not self.active or not self.latest or not self.marker.get_subscription_count():
            return
        self.skin_marker = self.skin_marker or SkinMarker(self.layer, self.config.frame)
        self.marker.publish(self.skin_marker.frame(*self.latest))
        self.latest = None

    def _diagnose(self) -> None:
        if not self.active:
            return
        answers, since = self.reported
        self.reported = self.sequence, time.monotonic()
        milliseconds = 1e3 * np.array(self.solve_times or [0.0])
        values = {
            "answers": self.sequence,
            "rate [Hz]": f"{(self.sequence - answers) / (self.reported[1] - since):.1f}",
            "solve median [ms]": f"{np.median(milliseconds):.3f}",
            "solve p99 [ms]": f"{np.percentile(milliseconds, 99):.3f}",
            "tools": " ".join(self.inbox.live(time.monotonic_ns())),
            "dropped, out of order": self.inbox.out_of_order,
            "dropped, stale": self.stale,
            "refused": self.refused,
            "last refusal": self.last_refusal,
            "layer_id": self.layer_id,
        }
        bad = bool(self.refused or self.stale or self.inbox.out_of_order)
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if bad else DiagnosticStatus.OK,
            name=f"{self.get_fully_qualified_name()}: skin",
            message="some messages were refused or dropped" if bad else "answering",
            hardware_id="stmpl",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(message)

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds


def run(
    config: NodeConfig,
    arguments: list[str] | None = None,
    build: Callable[[NodeConfig], SoftLayer] = layer_of,
) -> int:
    """Runs the node until SIGINT or SIGTERM; the exit code says whether it could be configured."""
    with ros(arguments) as stop:
        node = SkinNode(config, build)
        executor = EventsExecutor()
        executor.add_node(node)
        try:
            if node.config.autostart and (
                node.trigger_configure() != TransitionCallbackReturn.SUCCESS
                or node.trigger_activate() != TransitionCallbackReturn.SUCCESS
            ):
                return 1
            spin(executor, stop)
        finally:
            executor.shutdown()
            node.destroy_node()
    return 0
