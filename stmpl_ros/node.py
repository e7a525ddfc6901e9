"""SkinNode: answers each newest pose (and wrench) of the tools with the displacement of the skin."""

from __future__ import annotations

import gc
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, TimeoutError
from contextlib import ExitStack
from functools import partial
from typing import Any

import numba
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from numba.core.event import install_listener
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import get_logger
from std_srvs.srv import Trigger
from stmpl_msgs.srv import GetTopology, SetBody
from threadpoolctl import threadpool_limits

from stmpl_core.compiling import TOLD_EVERY_S, Compiling
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.skin import Skin
from stmpl_core.tool import Tool
from stmpl_core.tools import Tools
from stmpl_core.toucher import margin_on
from stmpl_core.warming import CompiledAhead, warm_up
from stmpl_ros.answering import Answering
from stmpl_ros.bending import Bending
from stmpl_ros.beside import Beside
from stmpl_ros.body_action import NOT_YET, BodyAction, Done, changes_of
from stmpl_ros.bond import Bond
from stmpl_ros.calibration import Calibration
from stmpl_ros.diagnosis import Counts, Health, Tally, diagnostics, limits_status, skin_status
from stmpl_ros.hearing import Hearing
from stmpl_ros.lifecycle import ServingNode, told
from stmpl_ros.limits import Limits
from stmpl_ros.making import (
    Build,
    at_once,
    check,
    check_part,
    compiled,
    friction_of,
    layer_of,
    restiffened,
    skin_of,
)
from stmpl_ros.parameters import PAPER, NodeConfig
from stmpl_ros.sending import Sending
from stmpl_ros.settings import Settings
from stmpl_ros.spinning import POLL_PERIOD_S, interruptible, ros, spin
from stmpl_ros.ticks import steady_timer
from stmpl_ros.topics import STREAM
from stmpl_ros.workshop import Workshop, then

FADE_RATE = 30.0  # rate of the answers while the last one fades [Hz]


def _nobody(why: str) -> None:
    """Nobody is told what became of a skin."""


def _settle() -> None:
    """What is set up now stays: collections at run time need not look at it. What was set up before is let go."""
    gc.unfreeze()
    gc.collect()
    gc.freeze()


class SkinNode(ServingNode):
    """ROS 2 lifecycle node that answers contacts: it hears (Hearing), answers (Answering) and sends (Sending).

    What comes in while an answer is being computed waits as the newest; older ones are never answered. When all tools
    are silent the last answer fades to rest. Distance fields, local contacts and other skins are made in processes
    beside this one (Workshop).

    Args:
        config: settings, which ROS parameters override.
        build: function that makes the layer from the settings, importable from a module.
        node_options: options of rclpy's LifecycleNode: namespace, context, parameter_overrides, ...

    Raises:
        InvalidInput: a parameter cannot be, the file of frames cannot be read, or a package that is needed is missing.
    """

    def __init__(self, config: NodeConfig, build: Build = layer_of, **node_options: Any) -> None:
        super().__init__("stmpl", **node_options)
        self.settings = Settings(self, config, self._on_settings, lambda config: check_part(config, build))
        self._build = build
        self.tally, self._counts = Tally(), Counts()
        self.workshop: Workshop | None = None
        self._making: Beside[Skin | None] | None = None
        self._twin = ""  # what the other node is that was told of
        self._done: Done = _nobody  # told what became of the skin that is being made
        self._open = ExitStack()  # what was opened when the node was configured
        self.bond = Bond(self)
        self.hearing = Hearing(self, lambda: self.config, Tools(), self.tally)  # raises before threads are started
        self.calibration = Calibration(self, lambda: self.workshop, self.set_body)
        self.bending = Bending(self, self.hearing, lambda: self.config)
        self.answering = Answering(self, self.settings, self.hearing, self.tally, self.calibration, self.bending)
        self.hearing.on_tool, self.hearing.on_instant = self._on_tool, self.answering.answer
        self.hearing.on_removed, self.hearing.on_time_back = self._on_removed, self.answering.on_time_back
        self._offer("reset", self.reset)
        self.create_service(SetBody, "~/set_body", self._on_set_body)
        self.create_service(GetTopology, "~/get_topology", self._on_get_topology)
        self._action = BodyAction(self, lambda changes, done: self.set_body(done, **changes), self._abandon,
                                  lambda: self.skin.layer_id if self.settings.locked else "",
                                  lambda: self.active)  # fmt: skip
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        self._diagnosing = steady_timer(self, 1.0, self._diagnose)

    @property
    def config(self) -> NodeConfig:
        """The settings as they are now."""
        return self.settings.config

    @property
    def active(self) -> bool:
        """Whether the node answers."""
        return self.hearing.active

    @property
    def sending(self) -> Sending:
        """Publishers of the answers."""
        return self.answering.sending

    # Lifecycle

    @told
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Builds the skin, warms the method up, and opens all topics."""
        started = time.monotonic()
        try:
            check(self.config, self._build)
            self.answering.limits = Limits.read(self.config.limits, self.config.limb)
            self.workshop = Workshop(self)  # its builders start while the skin is made
            remembers = self.config.relaxing or friction_of(self.config) is not None
            with (CompiledAhead(self.config.tissue != PAPER, remembers, self._tell_progress) as ahead,
                  install_listener("numba:compile", Compiling(self._tell_progress))):  # fmt: skip
                for simulator in self._answer_on(self._make_skin(), self.config):
                    warm_up(simulator, ahead)
        except StmplError as error:
            self._end()
            self.get_logger().error(f"cannot be configured: {error}")
            return TransitionCallbackReturn.FAILURE
        self.answering.sending = Sending(self, self.config, self.skin, self.workshop, self.hearing.gate)
        self._open.callback(self.sending.close)
        self.answering.open()
        for part in (self.hearing, self.bending):
            self._open.callback(part.close)
            part.open()
        self._open.callback(self.destroy_timer, steady_timer(self, 1 / FADE_RATE, self._fade))
        self.settings.take(self.config.model_copy(update={"part": self.config.limb}))  # another tissue keeps it
        self.settings.locked = True
        _settle()
        self.get_logger().info(f"configured in {time.monotonic() - started:.1f} s: {self.skin.layer}")
        if self.bond.missing:
            self.get_logger().info(self.bond.missing)
        return super().on_configure(state)

    @told
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Sends the topology and starts to answer."""
        result = super().on_activate(state)
        self.sending.topology(self._now())
        self.hearing.active = True
        self._diagnosing.reset()  # overdue after configuring, it would look twice at once, before a mesh can be heard
        self.bond.form()
        self.get_logger().info(f"answering with {self.skin.method.name} on layer {self.skin.layer_id}")
        return result

    @told
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stops answering; what comes in meanwhile is not kept."""
        self._stop()
        return super().on_deactivate(state)

    @told
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Closes all topics and forgets skin and tools; parameters that count when configuring can be set again."""
        result = super().on_cleanup(state)
        self._clean_up()
        return result

    @told
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stops answering, and ends the processes beside this one."""
        self._stop()
        result = super().on_shutdown(state)
        self._clean_up()
        return result

    @told
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a callback that failed: stops, and closes whatever is open, so that the node can be configured anew."""
        self._stop()
        self._clean_up()
        self.get_logger().error("everything is closed after that error; the node may be configured anew")
        return super().on_error(state)

    def destroy_node(self) -> None:
        """Ends the processes beside this one too."""
        self.bond.end()
        self.answering.close()
        self._end()
        self.calibration.close()
        self._action.close()
        super().destroy_node()

    def _make_skin(self) -> Skin:
        """At once where that is quick, else in a process beside this one: Ctrl-C is heard meanwhile."""
        if at_once(self.config, self._build):
            return skin_of(self.config, self._build)
        self._tell_progress(f"making {self.config.limb}; this may take a minute, the first time some")
        making, started, told = Beside(skin_of, self.config, self._build), time.monotonic(), 0
        try:
            while True:
                passed = time.monotonic() - started
                if passed >= (told + 1) * TOLD_EVERY_S:
                    told = int(passed / TOLD_EVERY_S)
                    self._tell_progress(f"making {self.config.limb} for {passed:.0f} s")
                try:
                    return making.result.result(POLL_PERIOD_S)
                except TimeoutError:
                    continue
                except BrokenExecutor as error:
                    raise InvalidInput(f"the process that makes the skin died: {error}") from error
        finally:
            making.close()

    def _answer_on(self, skin: Skin, config: NodeConfig) -> tuple[Simulator, ...]:
        """From here on the answers are of this skin, with the friction of these settings; its simulators."""
        assert self.workshop
        tools, friction = self.hearing.tools, friction_of(config)
        if tools.margin != margin_on(skin.layer):  # fields of another width are built anew
            self.hearing.inbox.tools = again = Tools(margin_on(skin.layer))
        else:
            again = tools
        self.skin, self.hearing.layer = skin, skin.layer
        simulators = self.answering.move_to(skin, again, friction)
        self.workshop.move_to(skin.layer, friction)
        for tool in [*tools, *tools.waiting()] if again is not tools else ():
            again.announce(tool)
            self._on_tool(tool)
        return simulators

    def _stop(self) -> None:
        self.bond.end()
        self.hearing.active = False
        self.answering.drop()

    def _clean_up(self) -> None:
        self.settings.locked = False
        self.answering.close()
        self._end()
        self.calibration.forget()
        try:
            self._open.close()  # last: all are closed, then raises what one of them raised
        finally:
            _settle()

    def _end(self) -> None:
        for beside in (self._making, self.workshop):
            if beside:
                beside.close()
        self._making = self.workshop = None
        self._finish("given up: the node is cleaned up, or ends")

    # Settings and services

    def _on_settings(self, config: NodeConfig) -> None:
        self.hearing.inbox.rest_after = int(config.rest_after * 1e9)
        if self.settings.locked:
            self.sending.show.set_rate(config.marker_rate)
            self.answering.wake()

    def _offer(self, name: str, do: Callable[[], str]) -> None:
        """A std_srvs/Trigger service `~/NAME`: `do` returns what to say, or raises a StmplError."""
        self.create_service(Trigger, f"~/{name}", lambda request, response: _served(response, do))

    def reset(self) -> str:
        """Forgets what the tools did, and sends the skin at rest. Raises InvalidInput unless active."""
        if not self.active:
            raise InvalidInput("the node is not active, so there is nothing to reset.")
        self.hearing.forget()
        self.calibration.forget()
        self.answering.rest("reset")
        return f"at rest; {len(self.hearing.tools)} tools are known"

    def _on_set_body(self, request: SetBody.Request, response: SetBody.Response) -> SetBody.Response:
        return _served(response, lambda: self.set_body(**changes_of(request)))

    def _on_get_topology(self, request: GetTopology.Request, response: GetTopology.Response) -> GetTopology.Response:
        response.success = self.active
        if self.active:
            response.topology = self.sending.topology_message(self._now())
        else:
            response.message = "the node is not active, so it has no skin."
        return response

    def set_body(self, done: Done = _nobody, /, **changes: Any) -> str:
        """Changes to another skin, or another stiffness, once it is made. Raises InvalidInput.

        Args:
            done: function that is told what became of it, once.
            changes: fields of NodeConfig.
        """
        config = self.settings.with_(**changes)
        check(config, self._build, set(changes))
        Limits.read(config.limits, config.limb)
        if not self.settings.locked:
            self.settings.take(config)
            done("")
            return NOT_YET
        if self._making:
            raise InvalidInput("another skin is being made; wait for skin/topology.")
        if config == self.config:
            done("")
            return "nothing changes: the node answers on it already"
        stiffer = restiffened(self.skin, config, set(changes))
        begins = friction_of(config) is not None and not self.answering.simulator.remembers
        if stiffer and not begins:
            self._take_over(stiffer, config)
            done("")
            return "taken over"
        self._done = done
        self._making = making = Beside(compiled, stiffer, config, self._build)
        then(self, making.result, partial(self._on_skin, making, stiffer, config))
        return "being made; skin/topology comes when it takes over"

    def _on_skin(self, making: Beside[Skin | None], stiffer: Skin | None, config: NodeConfig,
                 future: Future[Skin | None]) -> None:  # fmt: skip
        if self._making is not making:
            return  # given up meanwhile
        making.close()
        self._making = None
        try:
            skin = future.result() or stiffer
            assert skin
            self._take_over(skin, config)
            self._finish("")
        except Exception as error:  # whatever happened in the other process; the node goes on
            self._finish(str(error) or type(error).__name__)
            self.tally.last_refusal = f"set_body: {error}"
            self.get_logger().error(f"no other skin, the one from before goes on: {error or type(error).__name__}")

    def _abandon(self, why: str) -> None:
        """Gives the skin up that is being made."""
        if self._making is not None:
            self._making.close()
            self._making = None
            self._finish(why)

    def _finish(self, why: str) -> None:
        done, self._done = self._done, _nobody
        done(why)

    def _take_over(self, skin: Skin, config: NodeConfig) -> None:
        same = skin is self.skin
        self._answer_on(skin, config)
        self.settings.take(config)
        self.answering.limits = Limits.read(config.limits, config.limb)
        self.sending.move_to(skin)
        gc.collect()
        gc.freeze()  # without a thaw, which would take 0.1 s of the answers
        if same:
            self.get_logger().info(f"from here on friction is {config.friction or 'none'}")
            if self.active:
                self.sending.topology(self._now())  # the same once more: who asked waits for it
            return
        self.get_logger().info(f"from here on layer {skin.layer_id}: {skin.layer}")
        if self.active:
            self.sending.topology(self._now())
            self.answering.on_other_skin()

    # Tools and clocks

    def _on_tool(self, tool: Tool) -> None:
        assert self.workshop
        self.workshop.field(tool, partial(self._on_field, tool))

    def _on_field(self, tool: Tool, future: Future[SignedDistance]) -> None:
        try:
            if self.hearing.take(tool, future.result()):
                self.answering.drop()  # a field that is being found may lie on the surface from before
                self.answering.remembering.forget(tool.name)  # another surface never touched
                self.sending.open_tool(tool.name)
                self.get_logger().info(f"tool '{tool.name}': {len(tool.vertices)} vertices, {len(tool.faces)} faces")
        except Exception as error:  # whatever happened in the other process; the node goes on
            self.hearing.refuse(tool, error)
            if self.workshop:
                self.workshop.renew(error)

    def _on_removed(self, name: str) -> None:
        self.answering.without(name)
        self.sending.close_tool(name)

    def _fade(self) -> None:
        if self.active:
            self.answering.fade_if_silent()
            self.answering.follow()

    def _diagnose(self) -> None:
        name = self.get_fully_qualified_name()
        clock = self.hearing.look()
        if not self.active:
            return self._tell_health([skin_status(name, {}, Health(active=False))])
        inbox, events = self.hearing.inbox, self.hearing.events
        stopped = [f"no wrench of {name} for {self.config.rest_after} s: answered without it"
                   for name in inbox.dumb(self.hearing.now())]  # fmt: skip
        live, lost = inbox.live(self.hearing.now()), self.hearing.lost_frames()
        values = self.tally.values() | {
            "tools": " ".join(live),
            "dropped, out of order": str(inbox.out_of_order),
            "deadlines missed": str(events.missed_deadlines),
            "lost on the way": str(events.lost),
            "layer_id": self.skin.layer_id,
            "another skin": "being made" if self._making else "",
            "presses kept": str(len(self.calibration.presses)),
        }
        if self.config.joint_states:
            values["joints"] = self.bending.doubt or " ".join(f"{x:.4f}" for x in self.answering.simulator.skin.angles)
        told = self.bending.doubt or self.tally.doubt  # where all answers are of a surface from before, it says so
        outdated = [one for one in self.hearing.look_for_outdated() if one not in told]
        senders = "; ".join(filter(None, (clock, lost if live else "", self._look_for_twins(),
                                          self.hearing.look_at_clock(), *stopped, *outdated, self.hearing.unheard(),
                                          self.hearing.look_for_strangers(), self.hearing.rivals())))  # fmt: skip
        lately = self._counts.since(reactions=self.tally.reactions, refused=self.tally.refused, stale=self.tally.stale,
                                    out_of_order=inbox.out_of_order, missed=events.missed_deadlines)  # fmt: skip
        health = Health(lately, self.tally.last_refusal, self.answering.fading, bool(live),
                        self.bending.doubt or ("" if live else lost), drop=self.tally.last_drop, senders=senders,
                        out_of_range=self.tally.doubt, paused=self.hearing.now.paused,
                        building=tuple(tool.name for tool in self.hearing.tools.waiting()))  # fmt: skip
        statuses = [skin_status(name, values, health)]
        if self.answering.limits:
            statuses.append(limits_status(name, self.answering.limits))
        self._tell_health(statuses)

    def _tell_progress(self, said: str) -> None:
        """Tells of what takes long, in the log and on /diagnostics: no timer runs while the node configures."""
        self.get_logger().info(said)
        self._tell_health([skin_status(self.get_fully_qualified_name(), {}, Health(active=False, doubt=said))])

    def _tell_health(self, statuses: list[DiagnosticStatus]) -> None:
        self.diagnostics.publish(diagnostics(statuses, self.get_clock().now().to_msg()))

    def _look_for_twins(self) -> str:
        """Sentence on other nodes that answer on the same topic, or bear the same name; empty: there are none.

        A line tells of them once as they come.
        """
        topic, me = "skin/displacement", (self.get_name(), self.get_namespace())
        named = sum(one == me for one in self.get_node_names_and_namespaces()) - 1
        before, self._twin = self._twin, "that answers" if self.count_publishers(topic) > 1 else ""
        self._twin = "of the same name" if named > 0 else self._twin
        if not self._twin:
            return ""
        said = (f"there is another node {self._twin} on {self.resolve_topic_name(topic)}: listeners get the answers of "
                "both. Give each a namespace: --ros-args -r __ns:=/left")  # fmt: skip
        if self._twin != before:
            self.hearing.gate.say(f"twin {self._twin}", said)
        return said

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds


def _served(response: Any, do: Callable[[], str]) -> Any:
    try:
        response.success, response.message = True, do()
    except StmplError as error:
        response.success, response.message = False, str(error)
    return response


def run(config: NodeConfig, arguments: list[str] | None = None, build: Build = layer_of) -> int:
    """Runs the node until SIGINT, SIGTERM or SIGHUP; the exit code says whether it could be configured."""
    threadpool_limits(1, user_api="blas")  # where a core is busy, OpenBLAS' second thread stalls answers for 0.1 s
    with ros(arguments) as stop:
        try:
            node = SkinNode(config, build)
        except InvalidInput as error:
            get_logger("stmpl").error(f"cannot be started: {error}")
            return 1
        executor = EventsExecutor()
        executor.add_node(node)
        try:
            with interruptible(stop):
                if node.config.autostart:
                    if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                        return 1
                    # set: by an interrupt that came while something was deleted, where Python goes on
                    if not stop.is_set() and node.trigger_activate() != TransitionCallbackReturn.SUCCESS:
                        return 1
            numba.set_num_threads(1)  # a second one stalls answers for tens of milliseconds where its core is busy
            spin(executor, stop)
        finally:
            executor.shutdown()
            node.destroy_node()
            for beside in multiprocessing.active_children():
                beside.terminate()  # else Python waits for what they are at
    return 0
