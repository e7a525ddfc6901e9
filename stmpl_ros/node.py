"""SkinNode: answers each newest pose (and wrench) of the tools with the displacement of the skin."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from functools import partial
from typing import Any

import numba
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.exceptions import NameValidationException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.logging import get_logger
from shape_msgs.msg import Mesh
from std_srvs.srv import Trigger
from stmpl_msgs.msg import ContactMesh
from stmpl_msgs.srv import SetBody

from bags.messages import stamp_ns
from stmpl_core.contact import ToolMesh
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.sdf import SignedDistance
from stmpl_core.trust import Displacement
from stmpl_ros.adapters import GazeboContacts, contact_mesh_of
from stmpl_ros.background import Background
from stmpl_ros.calibration import Calibration
from stmpl_ros.conversions import NANO, checked_mesh, faded
from stmpl_ros.diagnosis import Tally, diagnostics, limits_status, skin_status
from stmpl_ros.events import Events
from stmpl_ros.frames import Frames, read_frames
from stmpl_ros.gate import Gate
from stmpl_ros.inbox import Inbox, Instant
from stmpl_ros.limits import Limits
from stmpl_ros.outputs import Outputs, Stamps
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.remarks import remarks
from stmpl_ros.reskin import Made, Reskin
from stmpl_ros.settings import Settings
from stmpl_ros.skin import Build, Skin, check, layer_of, maker_of, published, warm_up
from stmpl_ros.spinning import ros, spin
from stmpl_ros.topics import KEPT, NEWEST, STREAM, managed, newest_within

__all__ = ["SkinNode", "layer_of", "published", "run"]

FADE_RATE = 30.0  # Hz of the answers while the last one fades


class SkinNode(LifecycleNode):
    """Tools announce their mesh on `contact_mesh`; from then on `tools/NAME/pose` and `tools/NAME/wrench` are heard.

    What comes in while an answer is being computed waits as the newest; older ones are never answered. A message that
    cannot be used is refused with a log line, and changes nothing. When all tools are silent the last answer fades to
    rest. A mesh counts once its distance field is built, in a process beside this one, as are local contacts and, by
    `~/set_body`, other skins.

    Args:
        config: settings, which ROS parameters override.
        build: makes the layer from the settings; give your own, importable from a module, to answer for another skin.
        node_options: of rclpy's LifecycleNode: namespace, context, parameter_overrides, ...

    Raises:
        InvalidInput: a parameter cannot be, the file of frames cannot be read, or a package that is needed is missing.
    """

    def __init__(self, config: NodeConfig, build: Build = layer_of, **node_options: Any) -> None:
        super().__init__("stmpl", **node_options)
        self.settings = Settings(self, config, self._on_settings)
        self._build = build
        frames = Frames(self.config.frame, read_frames(self.config.frames), self)
        self.gazebo = GazeboContacts(self.config, frames) if self.config.gz_contacts else None
        self.tally = Tally()
        self.gate = Gate(self, lambda: self.config, frames, self.tally)
        self.events = Events(self.gate.say)
        self.active = False
        self.sequence = self.meshes = 0
        self.background: Background | None = None
        self.reskin: Reskin | None = None
        self.calibration = Calibration(self, lambda: self.background, lambda e: self.set_body(youngs_modulus=e))
        self._start_empty()
        self._offer("reset", self.reset)
        self.create_service(SetBody, "~/set_body", self._on_set_body)

    @property
    def config(self) -> NodeConfig:
        """The settings as they are now."""
        return self.settings.config

    def _start_empty(self) -> None:
        self.inbox = Inbox(self.config.frame, int(self.config.rest_after * NANO))
        self.announced: dict[str, tuple[int, ToolMesh]] = {}  # the newest mesh of each tool, in use or not yet
        self.inputs: list[Any] = []  # subscriptions
        self.tools: set[str] = set()  # that are listened to
        self.last: tuple[Displacement, Stamps] | None = None  # answered; None: at rest
        self.fading = False
        self.seen: set[str] = set()  # tools of the last answer
        self.calibration.forget()

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Builds the layer, warms the method up, and opens all topics."""
        started = time.monotonic()
        try:
            self.limits = Limits.read(self.config.limits, self.config.part)
            skin = Skin.of(self.config, self._build)
            self._answer_on(skin, Background(self, skin.layer))
            warm_up(self.simulator)
        except StmplError as error:
            self._end()
            self.get_logger().error(f"cannot be configured: {error}")
            return TransitionCallbackReturn.FAILURE
        self._open_topics()
        self.settings.locked = True
        gc.collect()
        gc.freeze()  # what is set up now stays: collections at run time need not look at it
        self.get_logger().info(f"configured in {time.monotonic() - started:.1f} s: {skin.layer}")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Sends the topology and starts to answer."""
        result = super().on_activate(state)
        self.outputs.send_topology(self._now())
        self.active = True
        self.get_logger().info(f"answering with {self.simulator.method.name} on layer {self.skin.layer_id}")
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stops answering; what comes in meanwhile is not kept."""
        self.active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Closes all topics and forgets skin and tools; parameters that count when configuring can be set again."""
        result = super().on_cleanup(state)
        self._clean_up()
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stops answering, and ends the processes beside this one."""
        self.active = False
        result = super().on_shutdown(state)
        self._clean_up()
        return result

    def destroy_node(self) -> None:
        """Ends the processes beside this one too."""
        self._end()
        self.calibration.close()
        super().destroy_node()

    def _answer_on(self, skin: Skin, background: Background) -> None:
        """From here on the answers are of this skin."""
        self.skin, self.simulator = skin, skin.simulator()
        before, self.background = self.background, background
        if before:
            before.close()

    def _clean_up(self) -> None:
        if self.settings.locked:
            self._close_topics()
        self._end()
        self._start_empty()
        self.settings.locked = False

    def _end(self) -> None:
        for beside in (self.reskin, self.background):
            if beside:
                beside.close()
        self.reskin = self.background = None

    def _open_topics(self) -> None:
        assert self.background
        self.outputs = Outputs(self, self.config, self.skin, self.background, self.gate.say)
        self.diagnostics = managed(self, DiagnosticArray, "/diagnostics", STREAM)
        self._listen(ContactMesh, "contact_mesh", self._on_mesh, KEPT)
        for tool in self.config.shape_tools.split():
            self._listen(Mesh, f"tools/{tool}/mesh", partial(self._on_shape, tool), KEPT)
        if self.gazebo:
            self._listen(self.gazebo.kind, "gz_contacts", partial(self._on_gazebo, self.gazebo), NEWEST)
        self.clocks = [self.create_timer(1 / FADE_RATE, self._fade_if_silent), self.create_timer(1.0, self._diagnose)]

    def _close_topics(self) -> None:
        for timer in self.clocks:
            self.destroy_timer(timer)
        for subscription in self.inputs:
            self.destroy_subscription(subscription)
        self.destroy_lifecycle_publisher(self.diagnostics)
        self.outputs.close()

    def _listen(self, kind: Any, topic: str, callback: Callable, profile: Any) -> None:
        self.inputs.append(self.events.subscribe(self, kind, topic, callback, profile))

    # Settings and services

    def _on_settings(self, config: NodeConfig) -> None:
        self.inbox.rest_after = int(config.rest_after * NANO)
        if self.settings.locked:
            self.outputs.show.set_rate(config.marker_rate)

    def _offer(self, name: str, do: Callable[[], str]) -> None:
        """A std_srvs/Trigger service `~/NAME`: `do` returns what to say, or raises a StmplError."""

        def serve(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.success, response.message = True, do()
            except StmplError as error:
                response.success, response.message = False, str(error)
            return response

        self.create_service(Trigger, f"~/{name}", serve)

    def reset(self) -> str:
        """Forgets what the tools did, and sends the skin at rest. Raises InvalidInput unless active."""
        if not self.active:
            raise InvalidInput("the node is not active, so there is nothing to reset.")
        self.inbox.forget()
        self.calibration.forget()
        self._rest("reset")
        self.fading = False
        return f"at rest; {len(self.inbox.tools)} tools are known"

    def _on_set_body(self, request: SetBody.Request, response: SetBody.Response) -> SetBody.Response:
        fields = ("part", "phenotype", "edge_length", "thickness", "youngs_modulus", "poisson_ratio")
        changes = {name: getattr(request, name) for name in fields if getattr(request, name)}
        try:
            response.success, response.message = True, self.set_body(**changes)
        except StmplError as error:
            response.success, response.message = False, str(error)
        return response

    def set_body(self, **changes: Any) -> str:
        """Has another skin, or this one of another stiffness, take over once it is made. Raises InvalidInput.

        Args:
            changes: fields of NodeConfig.
        """
        config = self.settings.with_(**changes)
        check(config, self._build)
        Limits.read(config.limits, config.part)
        if not self.settings.locked:
            self.settings.take(config)
            return "counts when the node is configured"
        if self.reskin:
            raise InvalidInput("another skin is being made; wait for skin/topology.")
        maker = maker_of(self.skin, config, set(changes), self._build)
        self.reskin = Reskin(self, config, maker, lambda: self.announced, self._on_skin, self._on_no_skin)
        return "being made; skin/topology comes when it takes over"

    def _on_skin(self, made: Made) -> None:
        self.reskin = None
        self._answer_on(made.skin, made.background)
        self.settings.take(made.config)
        self.limits = Limits.read(made.config.limits, made.config.part)
        self.outputs.move_to(made.skin, made.background)
        for name, (number, mesh) in self.announced.items():
            if name in made.fields and made.fields[name][0] == number:
                self.simulator.keep_field(mesh, made.fields[name][2])
            else:
                self.inbox.tools.pop(name, None)
                self._ask_for_field(name, number, mesh)
        gc.collect()
        gc.freeze()
        self.get_logger().info(f"from here on layer {made.skin.layer_id}: {made.skin.layer}")
        if self.active:
            self.outputs.send_topology(self._now())
            if self.last is not None and not self.inbox.live(time.monotonic_ns()):
                self._rest("another skin")

    def _on_no_skin(self, error: BaseException) -> None:
        self.reskin = None
        self.tally.last_refusal = f"set_body: {error}"
        self.get_logger().error(f"no other skin: {error or type(error).__name__}. The one from before goes on.")

    # What comes in

    def _on_shape(self, tool: str, message: Mesh) -> None:
        self._on_mesh(contact_mesh_of(message, tool, self._now()))

    def _on_mesh(self, message: ContactMesh) -> None:
        name = message.header.frame_id
        try:
            mesh = checked_mesh(message)
        except StmplError as error:
            return self.gate.refuse("mesh", f"mesh of '{name}' refused: {error}")
        self.meshes += 1
        self._ask_for_field(name, self.meshes, mesh)

    def _ask_for_field(self, name: str, number: int, mesh: ToolMesh) -> None:
        assert self.background
        self.announced[name] = number, mesh
        self.background.field(name, number, mesh, partial(self._on_field, name, number, mesh))

    def _on_field(self, name: str, number: int, mesh: ToolMesh, field: Future[SignedDistance]) -> None:
        """Takes a tool's mesh into use, its distance field being there."""
        assert self.background
        try:
            built = field.result()
            self.simulator.keep_field(mesh, built)
            if name not in self.tools:
                self._listen_to(name)
            self.inbox.put_mesh(name, mesh, number)
        except (StmplError, NameValidationException, BrokenExecutor) as error:
            if self.announced.get(name, (0,))[0] == number:
                del self.announced[name]
            self.background.renew(error)
            return self.gate.refuse("mesh", f"mesh of '{name}' refused: {error}")
        self.get_logger().info(f"tool '{name}': {len(mesh.vertices)} vertices, {len(mesh.faces)} faces")
        if built.flipped:
            self.gate.say("inside out", f"the mesh of '{name}' came inside out and was turned")
        if not built.watertight:
            self.gate.say("holes", f"the mesh of '{name}' has holes; what is inside it near them is a guess")

    def _listen_to(self, name: str) -> None:
        """Raises NameValidationException for a name that cannot be part of a topic."""
        poses = newest_within(self.config.deadline)
        self._listen(PoseStamped, f"tools/{name}/pose", partial(self._on_pose, name), poses)
        self._listen(WrenchStamped, f"tools/{name}/wrench", partial(self._on_wrench, name), NEWEST)
        self.outputs.open_tool(name)
        self.tools.add(name)

    def _on_pose(self, name: str, message: PoseStamped) -> None:
        pose = self.gate.pose(message, name) if self._hears(name) else None
        if pose is not None:
            self.gate.order("pose", name, self.inbox.put_pose(name, pose, stamp_ns(message), time.monotonic_ns()))
            self._answer_if_complete()

    def _on_wrench(self, name: str, message: WrenchStamped) -> None:
        wrench = self.gate.wrench(message, name) if self._hears(name) else None
        if wrench is not None:
            self.gate.order("wrench", name, self.inbox.put_wrench(name, wrench, stamp_ns(message), time.monotonic_ns()))
            self._answer_if_complete()

    def _on_gazebo(self, gazebo: GazeboContacts, message: Any) -> None:
        try:
            for name, wrench in gazebo.wrenches(message, self.skin.layer, self.inbox.tools):
                self._on_wrench(name, wrench)
        except StmplError as error:
            self.gate.refuse("gz_contacts", str(error))

    def _hears(self, name: str) -> bool:
        return self.active and name in self.inbox.tools

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
            return self.gate.refuse("answer", f"no answer: {error}")
        if not np.isfinite(answer.displacement).all():
            return self.gate.refuse("answer", f"no answer: it would not be finite under {answer.statuses}.")
        seconds = time.perf_counter() - started
        why = remarks(instant, answer, self.seen, self.config.rest_after, self.gate.say)
        self._send(answer, instant.stamp, instant.inputs, seconds=seconds, why=why)
        meshes = {name: self.inbox.tools[name].number for name in answer.statuses}
        self.calibration.put(instant, answer, meshes)
        self.outputs.send_contacts(instant, answer, answer.wrenches, meshes, self.config.local_rotations)
        self.tally.solve_times.append(seconds)
        self.tally.latencies.append((self._now() - instant.stamp) / NANO)
        if self.limits:
            self.limits.put(answer)
        if self.fading:
            self.get_logger().info("input is back")
        self.last, self.fading, self.gate.refused_since = (answer, instant.inputs), False, ""
        self.seen = set(answer.statuses)

    def _fade_if_silent(self) -> None:
        now = time.monotonic_ns()
        if not self.active or self.last is None or self.inbox.live(now):
            return
        answer, inputs = self.last
        silent, limit = self.inbox.silence(now) / NANO, self.config.rest_after
        left = 1 - (silent - limit) / self.config.fade if self.config.fade else 0.0
        why = f"no pose for {limit} s"
        if self.gate.refused_since:
            why = f"{why} that could be used (refused: {self.gate.refused_since})"
        self.seen = set()
        self.outputs.local_contacts.forget()
        if left <= 0 or not answer.displacement.any():
            return self._rest(f"{why}: back at rest")
        if not self.fading:
            self.fading = True
            self.outputs.rest(list(answer.statuses), self._now())
            self.gate.say("fading", f"{why}: the last answer fades to rest within {self.config.fade} s")
        fade = float(np.float32(left))  # as the message carries it
        why = f"{why}: the last answer, faded to {left:.0%}"
        self._send(faded(answer, fade, why), self._now(), inputs, fade=fade)

    def _rest(self, why: str) -> None:
        """Sends the skin at rest."""
        tools = list(self.last[0].statuses) if self.last else []
        self._send(self.simulator.step([]), self._now(), {}, why=why)
        self.outputs.rest(tools, self._now())
        self.last, self.seen = None, set()

    def _send(self, answer: Displacement, stamp: int, inputs: Stamps, **said: Any) -> None:
        self.outputs.send(answer, stamp, self.sequence, inputs, **said)
        self.sequence += 1
        self.tally.answers = self.sequence
        self.tally.methods[answer.method] += 1

    def _diagnose(self) -> None:
        if not self.active:
            return
        values = self.tally.values() | {
            "tools": " ".join(self.inbox.live(time.monotonic_ns())),
            "dropped, out of order": str(self.inbox.out_of_order),
            "deadlines missed": str(self.events.missed_deadlines),
            "lost on the way": str(self.events.lost),
            "layer_id": self.skin.layer_id,
            "another skin": "being made" if self.reskin else "",
            "presses kept": str(len(self.calibration.presses)),
        }
        bad = bool(self.tally.refused or self.tally.stale or self.inbox.out_of_order or self.events.missed_deadlines)
        name = self.get_fully_qualified_name()
        statuses = [skin_status(name, values, bad, self.fading)]
        if self.limits:
            statuses.append(limits_status(name, self.limits))
        self.diagnostics.publish(diagnostics(statuses, self.get_clock().now().to_msg()))

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds


def run(config: NodeConfig, arguments: list[str] | None = None, build: Build = layer_of) -> int:
    """Runs the node until SIGINT or SIGTERM; the exit code says whether it could be configured."""
    with ros(arguments) as stop:
        try:
            node = SkinNode(config, build)
        except InvalidInput as error:
            get_logger("stmpl").error(f"cannot be started: {error}")
            return 1
        executor = EventsExecutor()
        executor.add_node(node)
        try:
            if node.config.autostart and (
                node.trigger_configure() != TransitionCallbackReturn.SUCCESS
                or node.trigger_activate() != TransitionCallbackReturn.SUCCESS
            ):
                return 1
            numba.set_num_threads(1)  # a second one stalls answers for tens of milliseconds where its core is busy
            spin(executor, stop)
        finally:
            executor.shutdown()
            node.destroy_node()
    return 0
