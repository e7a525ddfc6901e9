"""SkinNode: answers each newest pose (and wrench) of the tools with the displacement of the skin."""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.exceptions import NameValidationException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from stmpl_msgs.msg import ContactMesh, LocalContact, SkinDeformed, SkinDisplacement, SkinTopology
from visualization_msgs.msg import Marker

from bags.messages import layer_id, stamp_ns
from bags.survey import PRESSING
from stmpl_core.arrays import Transform
from stmpl_core.contact import Contact, ToolMesh
from stmpl_core.errors import StmplError
from stmpl_core.layer import SoftLayer, Tissue
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.touch import APART, IN_CORE, NO_FORCE, NO_TOUCH, PULLING, WRAPPED
from stmpl_core.trust import Displacement
from stmpl_ros.conversions import (
    NANO,
    checked_mesh,
    checked_pose,
    checked_wrench,
    deformed_message,
    displacement_message,
    faded,
    local_contact_message,
    topology_message,
)
from stmpl_ros.inbox import Inbox, Instant
from stmpl_ros.marker import SkinMarker
from stmpl_ros.parameters import METHODS, NodeConfig
from stmpl_ros.spinning import ros, spin
from stmpl_ros.throttle import Throttle
from stmpl_ros.topics import KEPT, NEWEST, STREAM
from stmpl_ros.workshop import Placed, Workshop

SAY_EVERY = 1.0  # s between two lines of the same kind
FADE_RATE = 30.0  # Hz of the answers while the last one fades
UNSEEN = 2e-3  # m: a tool that is deeper in its first answer was not seen coming
MODELLED = PRESSING | {IN_CORE, APART}  # statuses of which a local model says what the answer says
WORTH_A_LINE = {
    NO_FORCE: "it touches, but its wrench is zero",
    PULLING: "nothing sticks, so nothing is loaded",
    NO_TOUCH: "it presses, but no skin is within reach along its force",
    WRAPPED: "its wrench does not say how hard it squeezes",
    IN_CORE: "its pose reaches into the rigid core",
}  # log lines of statuses that a person should look at


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
    cannot be used is refused with a log line, and changes nothing. When all tools are silent the last answer fades to
    rest. A mesh counts once its distance field is built, in a process beside this one, as are local contacts.

    Args:
        config: settings, which ROS parameters override.
        build: makes the layer from the settings; give your own to answer for another skin.
    """

    def __init__(self, config: NodeConfig, build: Callable[[NodeConfig], SoftLayer] = layer_of) -> None:
        super().__init__("stmpl")
        self.config = config.declare_on(self)
        self._build = build
        self.inbox = Inbox(self.config.frame, int(self.config.rest_after * NANO))
        self.active = self.closing = False
        self.sequence = self.refused = self.stale = self.meshes = 0
        self.last_refusal = self.refused_since = ""
        self.throttle = Throttle(SAY_EVERY)
        self.last: tuple[Displacement, dict[str, tuple[int, int]]] | None = None  # answered; None: at rest
        self.fading = False
        self.seen: set[str] = set()  # tools of the last answer
        self.workshop: Workshop | None = None
        self.models: dict[str, Publisher] = {}
        self.to_model: tuple[Instant, Displacement] | None = None
        self.modelling = False
        self.solve_times: deque[float] = deque(maxlen=1000)
        self.reported = (0, time.monotonic())

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Builds the layer, warms the method up, and opens all topics."""
        started = time.monotonic()
        try:
            self.layer = published(self._build(self.config))
            self.workshop = Workshop(self.layer)
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
        self.create_timer(1 / FADE_RATE, self._fade_if_silent)
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
        except StmplError as error:
            return self._refuse("mesh", f"mesh of '{name}' refused: {error}")
        self.meshes += 1
        assert self.workshop
        self._then(self.workshop.field(name, self.meshes, mesh), partial(self._on_field, name, self.meshes, mesh))

    def _on_field(self, name: str, number: int, mesh: ToolMesh, field: Future[SignedDistance]) -> None:
        """Takes a tool's mesh into use, its distance field being there."""
        try:
            built = field.result()
            self.simulator.keep_field(mesh, built)
            if name not in self.inbox.tools:
                self._listen_to(name)
            self.inbox.put_mesh(name, mesh, number)
        except (StmplError, NameValidationException, BrokenExecutor) as error:
            self._renew(error)
            return self._refuse("mesh", f"mesh of '{name}' refused: {error}")
        self.get_logger().info(f"tool '{name}': {len(mesh.vertices)} vertices, {len(mesh.faces)} faces")
        if built.flipped:
            self._say("inside out", f"the mesh of '{name}' came inside out and was turned")
        if not built.watertight:
            self._say("holes", f"the mesh of '{name}' has holes; what is inside it near them is a guess")

    def _listen_to(self, name: str) -> None:
        """Raises NameValidationException for a name that cannot be part of a topic."""
        self.create_subscription(PoseStamped, f"tools/{name}/pose", partial(self._on_pose, name), NEWEST)
        self.create_subscription(WrenchStamped, f"tools/{name}/wrench", partial(self._on_wrench, name), NEWEST)
        self.models[name] = self.create_publisher(LocalContact, f"tools/{name}/local_contact", STREAM)

    def _on_pose(self, name: str, message: PoseStamped) -> None:
        if not self.active:
            return
        try:
            pose = checked_pose(message, name, self.config.frame)
        except StmplError as error:
            return self._refuse(f"pose of {name}, {type(error).__name__}", str(error))
        if self._fresh(message):
            self._order("pose", name, self.inbox.put_pose(name, pose, stamp_ns(message), time.monotonic_ns()))
            self._answer_if_complete()

    def _on_wrench(self, name: str, message: WrenchStamped) -> None:
        if not self.active:
            return
        try:
            checked_wrench(message, name, self.config.frame)
        except StmplError as error:
            return self._refuse(f"wrench of {name}, {type(error).__name__}", str(error))
        if self._fresh(message):
            self._order("wrench", name, self.inbox.put_wrench(name, message, stamp_ns(message), time.monotonic_ns()))
            self._answer_if_complete()

    def _order(self, kind: str, name: str, taken: bool) -> None:
        if not taken:
            self._say(f"order of {kind} of {name}", f"a {kind} of {name} was dropped: its stamp is not after the last "
                      "one's. Do two devices send under one name, or was a clock set back?")  # fmt: skip

    def _fresh(self, message: Any) -> bool:
        age = (self._now() - stamp_ns(message)) / NANO
        if not self.config.max_age or abs(age) <= self.config.max_age:
            return True
        self.stale += 1
        self._say("age", f"a message stamped {age:+.2f} s before now was dropped; allowed is {self.config.max_age} s. "
                  "Are the clocks in step, or is this a replay? max_age:=0 accepts any age.")  # fmt: skip
        return False

    def _refuse(self, kind: str, why: str) -> None:
        self.refused += 1
        self.last_refusal = self.refused_since = why
        self._say(kind, f"refused: {why}")

    def _say(self, kind: str, text: str) -> None:
        line = self.throttle.line(kind, text, time.monotonic())
        if line:
            self.get_logger().warning(line)

    # The process beside this one

    def _then(self, future: Future, do: Callable[[Future], None]) -> None:
        """Calls `do` with the future by the executor, once it is done."""

        def done(future: Future) -> None:
            executor = self.executor
            if executor and not self.closing and not future.cancelled():
                executor.create_task(do, future)

        future.add_done_callback(done)

    def _renew(self, error: BaseException) -> None:
        """A new process if the old one died; it is given the meshes that are known."""
        if isinstance(error, BrokenExecutor):
            self.get_logger().error(f"the process that builds distance fields and local models died: {error}")
            self.workshop = Workshop(self.layer)
            for name, tool in self.inbox.tools.items():
                self.workshop.field(name, tool.number, tool.mesh)

    def _model_next(self) -> None:
        """Has the newest answer's contacts told to first order, one answer at a time."""
        if self.modelling or self.to_model is None:
            return
        instant, answer = self.to_model
        self.to_model = None
        placed = [
            Placed(contact.name, self.inbox.tools[contact.name].number, _answered_pose(contact, answer))
            for contact in instant.contacts
            if answer.statuses[contact.name] in MODELLED and self.models[contact.name].get_subscription_count()
        ]
        if placed and self.workshop:
            self.modelling = True
            future = self.workshop.models(placed, self.config.local_rotations)
            self._then(future, partial(self._on_models, instant.stamp, placed, answer))

    def _on_models(self, stamp: int, placed: list[Placed], answer: Displacement, future: Future) -> None:
        self.modelling = False
        try:
            for tool, model in zip((one.tool for one in placed), future.result(), strict=True):
                status = answer.statuses[tool]
                message = local_contact_message(tool, model, status, self.config.frame, stamp)
                self.models[tool].publish(message)
        except (StmplError, BrokenExecutor) as error:
            self._renew(error)
            self._say("model", f"no local contact: {error}")
        self._model_next()

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
            return self._refuse("answer", f"no answer: {error}")
        if not np.isfinite(answer.displacement).all():
            return self._refuse("answer", f"no answer: it would not be finite under {answer.statuses}.")
        seconds = time.perf_counter() - started
        self._publish(answer, instant.stamp, seconds, self._remarks(instant, answer), instant.inputs)
        if self.fading:
            self.get_logger().info("input is back")
        self.last, self.fading, self.refused_since = (answer, instant.inputs), False, ""
        self.seen = set(answer.statuses)
        self.to_model = instant, answer
        self._model_next()

    def _remarks(self, instant: Instant, answer: Displacement) -> str:
        """What is to be said of an answer beside what the core says; logs what a person should look at."""
        remarks = [f"stamps of tools and wrenches lie up to {instant.skew / 1e6:.1f} ms apart"] if instant.skew else []
        for stream in instant.lost:
            remarks.append(f"no {stream} for {self.config.rest_after} s: answered without it")
            self._say(f"lost {stream}", remarks[-1])
        for tool, status in answer.statuses.items():
            depth = answer.trust.figures.get(f"{tool}.depth_m", 0.0)
            if tool not in self.seen and depth > UNSEEN:
                remarks.append(f"{tool} starts {1e3 * depth:.1f} mm inside the skin")
                self._say(f"start of {tool}", remarks[-1])
            if status in WORTH_A_LINE:
                self._say(f"{tool} {status}", f"{tool}: {status}; {WORTH_A_LINE[status]}")
        return "; ".join(remarks)

    def _fade_if_silent(self) -> None:
        now = time.monotonic_ns()
        if not self.active or self.last is None or self.inbox.live(now):
            return
        answer, inputs = self.last
        silent, limit = self.inbox.silence(now) / NANO, self.config.rest_after
        left = 1 - (silent - limit) / self.config.fade if self.config.fade else 0.0
        why = f"no pose for {limit} s"
        if self.refused_since:
            why = f"{why} that could be used (refused: {self.refused_since})"
        self.seen, self.to_model = set(), None
        if left <= 0 or not answer.displacement.any():
            self._publish(self.simulator.step([]), self._now(), 0.0, f"{why}: back at rest", {})
            self.last = None
            return
        if not self.fading:
            self.fading = True
            self._say("fading", f"{why}: the last answer fades to rest within {self.config.fade} s")
        fade = float(np.float32(left))  # as the message carries it
        why = f"{why}: the last answer, faded to {left:.0%}"
        self._publish(faded(answer, fade, why), self._now(), 0.0, "", inputs, fade)

    def _publish(
        self, answer: Displacement, stamp: int, seconds: float, why: str, inputs: dict[str, tuple[int, int]],
        fade: float = 1.0,
    ) -> None:  # fmt: skip
        message = displacement_message(
            answer,
            layer_id=self.layer_id,
            body_frame=self.config.frame,
            stamp_ns=stamp,
            sequence=self.sequence,
            solve_seconds=seconds,
            inputs=inputs,
            fade=fade,
        )
        message.why = "; ".join(filter(None, (message.why, why)))
        self.displacement.publish(message)
        self.sequence += 1
        if seconds:
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
        bad = bool(self.refused or self.stale or self.inbox.out_of_order or self.fading)
        message = "answering" if not bad else "some messages were refused or dropped"
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if bad else DiagnosticStatus.OK,
            name=f"{self.get_fully_qualified_name()}: skin",
            message="input has stopped: the last answer fades, or is at rest" if self.fading else message,
            hardware_id="stmpl",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        sent = DiagnosticArray(status=[status])
        sent.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(sent)

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds

    def destroy_node(self) -> None:
        """Ends the process beside this one too."""
        self.closing = True
        if self.workshop:
            self.workshop.close()
        super().destroy_node()


def _answered_pose(contact: Contact, answer: Displacement) -> Transform:
    """Where the answer has the tool: moved along its push from the stated pose, if it has a wrench."""
    pose = contact.pose_body_from_tool.copy()
    if contact.wrench is not None and contact.wrench[:3].any():
        push = contact.wrench[:3] / np.linalg.norm(contact.wrench[:3])
        pose[:3, 3] += answer.trust.figures[f"{contact.name}.moved_m"] * push
    return pose


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
