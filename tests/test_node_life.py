"""Laws of the node's life: lifecycle, another node beside it, what is asked of devices, launch files."""

import ast
import multiprocessing
import runpy
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import _threads_wakeups
from dataclasses import replace
from importlib.util import find_spec
from multiprocessing.connection import wait
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import LivelinessPolicy, QoSProfile
from std_srvs.srv import Trigger
from stmpl_msgs.msg import ContactMesh, SkinDisplacement, SkinTopology

from bags.wire import pose_message, stamp_ns, tool_message
from stmpl_core import Tool
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import PAIRS
from stmpl_ros import lifecycle
from stmpl_ros.beside import Beside, Builders
from stmpl_ros.hearing import Hearing
from stmpl_ros.inbox import Instant
from stmpl_ros.node import SkinNode
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.sending import Sending
from stmpl_ros.topics import KEPT, LEASE, STREAM
from tests.bus import PATIENCE, ROOT, end, in_process, rows, running, start
from tests.node_bus import HERE, NODE, PUSH, Bus, skin
from tests.scenes import ball, contact_of

# Lifecycle and QoS


def test_a_node_may_be_cleaned_up_set_up_anew_and_answers_on_what_was_set(bus, hand):
    hand.ask(HERE, PUSH)

    def go(transition: int) -> None:
        assert bus.call(ChangeState, "change_state", transition=Transition(id=transition)).success

    go(Transition.TRANSITION_DEACTIVATE)
    assert not bus.call(Trigger, "reset").success
    go(Transition.TRANSITION_CLEANUP)
    assert bus.set(youngs_modulus=1500.0)[0].successful
    layers = len(bus.got["skin/topology"])
    go(Transition.TRANSITION_CONFIGURE)
    go(Transition.TRANSITION_ACTIVATE)
    topology = bus.wait(lambda: bus.got["skin/topology"][layers:], "the topology")[-1]
    assert topology.youngs_modulus == 1500
    hand.ready()  # its mesh was kept for late listeners
    before = len(bus.got["skin/displacement"])
    answer = hand.ask(HERE, PUSH)
    assert answer.layer_id == topology.layer_id and len(bus.got["skin/displacement"]) == before + 1, "answered once"


class Composed(NamedTuple):
    """A SkinNode in this process beside another node, which moves a tool and hears answers."""

    node: SkinNode
    heard: list[SkinDisplacement]
    press: Callable[[], int]
    announce: Callable[[Tool], None]
    wait: Callable[[Callable[[], object]], None]


@pytest.fixture
def composed():
    """SkinNode is an ordinary node to whoever composes."""
    with in_process(lambda context: SkinNode(NodeConfig(), skin, context=context)) as (node, other, wait):
        heard: list[SkinDisplacement] = []
        other.create_subscription(SkinDisplacement, "skin/displacement", heard.append, STREAM)
        mesh = other.create_publisher(ContactMesh, "contact_mesh", KEPT)
        pose = other.create_publisher(PoseStamped, "tools/finger/pose", STREAM)

        def press() -> int:
            stamp = other.get_clock().now().nanoseconds
            pose.publish(pose_message(HERE, "body", stamp))
            return stamp

        def announce(tool: Tool) -> None:
            mesh.publish(tool_message(tool, 0))

        node.trigger_configure()
        node.trigger_activate()
        announce(ball().named("finger"))
        wait(pose.get_subscription_count)
        yield Composed(node, heard, press, announce, wait)


def test_the_node_runs_beside_another_in_any_executor(composed):
    composed.wait(lambda: composed.press() and composed.heard)
    assert rows(composed.heard[-1]).any()


def test_whatever_fails_inside_an_answer_is_told_and_the_next_instant_is_answered(composed, monkeypatch, capfd):
    simulator, failed = composed.node.answering.simulator, []
    touch = simulator.touch

    def fails_once(contacts):
        if not failed:
            failed.append(contacts[0])
            raise RuntimeError("an accident")
        return touch(contacts)

    monkeypatch.setattr(simulator, "touch", fails_once)
    composed.wait(lambda: composed.press() and failed)
    refused = round(1e9 * failed[0].time)
    assert composed.node.tally.refused == 1
    assert composed.node.tally.last_refusal == "no answer to finger: an accident"
    composed.wait(lambda: composed.press() and composed.heard)
    assert rows(composed.heard[0]).any() and stamp_ns(composed.heard[0]) > refused
    assert composed.node.tally.refused == 1
    assert capfd.readouterr().err.count("refused: no answer to finger: an accident\n") == 1


def test_answers_that_take_long_to_send_are_told(composed, monkeypatch, capfd):
    composed.wait(lambda: composed.press() and composed.heard)
    monkeypatch.setattr("stmpl_ros.answering.HELD_UP_S", -1.0)
    composed.wait(lambda: composed.press() and "FASTDDS_BUILTIN_TRANSPORTS=UDPv4" in capfd.readouterr().err)


def refuse(*_: object) -> None:
    raise RuntimeError("an accident")


@pytest.mark.parametrize("where", ["hearing.open", "sending.topology"])
def test_a_transition_that_fails_is_told_and_leaves_a_node_that_is_closed_and_can_be_configured_again(
    composed, monkeypatch, capfd, where
):
    """Configuring fails, or activating."""
    node, (part, method) = composed.node, where.split(".")
    node.trigger_deactivate()
    node.trigger_cleanup()
    closed = {publisher.topic_name for publisher in node.publishers}
    with monkeypatch.context() as broken:
        broken.setattr(Hearing if part == "hearing" else Sending, method, refuse)
        failed = node.trigger_configure() if part == "hearing" else node.trigger_configure() and node.trigger_activate()
    assert failed == TransitionCallbackReturn.ERROR
    assert "failed: RuntimeError: an accident" in capfd.readouterr().err
    assert node._state_machine.current_state[1] == "unconfigured"
    assert not node.active and not node.settings.locked and node.workshop is None
    assert {publisher.topic_name for publisher in node.publishers} == closed
    assert node.trigger_configure() == node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    composed.announce(ball().named("finger"))
    composed.heard.clear()
    composed.wait(lambda: composed.press() and composed.heard and rows(composed.heard[-1]).any())


def test_a_node_that_cannot_even_be_closed_is_finalized(composed, monkeypatch, capfd):
    monkeypatch.setattr(composed.node.answering, "drop", refuse)
    assert composed.node.trigger_deactivate() == TransitionCallbackReturn.ERROR
    said = capfd.readouterr().err
    assert "on_deactivate failed" in said and "on_error failed" in said
    assert composed.node._state_machine.current_state[1] == "finalized"


def test_skins_of_before_are_let_go_by_a_node_that_starts_anew_and_by_one_that_changes(composed):
    """What is set up is frozen for the collector; nothing ever thawed it, and each skin stayed with its cycles."""
    node, layers = composed.node, []
    for stiff in (2000.0, 2100.0, 2200.0):
        layers.append(weakref.ref(node.skin.layer))
        node.trigger_deactivate()
        node.trigger_cleanup()
        node.trigger_configure()
        node.trigger_activate()
        layers.append(weakref.ref(node.skin.layer))
        assert node.set_body(youngs_modulus=stiff) == "taken over"
    alive = [layer for layer in layers[:-1] if layer() is not None]  # the stiffened one is made of the last
    assert len(alive) <= 1  # the executor keeps its last timers, and what they show, until it spins again


class Beat(SimpleNamespace):
    """A stand-in for bond/msg/Status, which is on no package registry."""


def test_an_active_node_beats_for_a_lifecycle_manager_and_tells_when_it_stops(composed, monkeypatch):
    node, beats = composed.node, list[Any]()
    assert ("'bond' is not installed" in node.bond.missing) == (find_spec("bond") is None)
    publisher = SimpleNamespace(publish=beats.append, wait_for_all_acked=lambda _: None)
    monkeypatch.setattr(node.bond, "_kind", Beat)
    monkeypatch.setattr(node, "create_publisher", lambda kind, *_: publisher)
    monkeypatch.setattr(node, "destroy_publisher", lambda one: one is publisher)
    node.trigger_deactivate()
    node.trigger_activate()
    composed.wait(lambda: len(beats) > 3)
    assert {(beat.id, beat.active, beat.heartbeat_timeout) for beat in beats} == {("stmpl", True, 4.0)}
    assert len({beat.instance_id for beat in beats}) == 1
    node.trigger_deactivate()
    count = len(beats)
    assert [beat.active for beat in beats].index(False) == count - 1
    composed.wait(lambda: composed.press() and node.count_publishers("tools/finger/pose"))
    node.trigger_activate()
    assert beats[count].active and beats[count].instance_id == beats[0].instance_id
    node.trigger_deactivate()


def test_a_manager_hears_the_beats(composed):
    """Over the middleware, where the real messages are."""
    status = pytest.importorskip("bond.msg", reason="the package 'bond' is not installed").Status
    beats = list[Any]()
    composed.node.create_subscription(status, "bond", beats.append, STREAM)
    composed.wait(lambda: beats)
    assert beats[0].id == "stmpl" and beats[0].active
    composed.node.trigger_deactivate()
    composed.wait(lambda: not beats[-1].active)


class Held(NamedTuple):
    """Fields that wait: `begun` is set once the thread has taken one up, and none is found until `released` is."""

    begun: threading.Event
    released: threading.Event


@pytest.fixture
def held(composed, monkeypatch) -> Iterator[Held]:
    """Fields wait, once the node has answered."""
    composed.wait(lambda: composed.press() and composed.heard)
    composed.wait(lambda: composed.node.answering._field.idle)
    held, answer = Held(threading.Event(), threading.Event()), composed.node.answering._fields.answer

    def answer_later(*what):
        held.begun.set()
        held.released.wait()
        return answer(*what)

    monkeypatch.setattr(composed.node.answering._fields, "answer", answer_later)
    yield held
    held.released.set()


def test_reactions_do_not_wait_for_a_field_and_the_newest_instant_gets_the_next(composed, held):
    wrenches, topic = [], "tools/finger/contact_wrench"
    before = composed.node.answering._instant.stamp

    def fields() -> list[int]:
        return [stamp_ns(one) for one in composed.heard if one.fade == 1 and one.touches and stamp_ns(one) > before]

    composed.node.create_subscription(WrenchStamped, topic, wrenches.append, STREAM)
    composed.wait(lambda: composed.press() and held.begun.is_set())
    wrenches.clear()
    composed.wait(lambda: composed.press() and len({stamp_ns(one) for one in wrenches}) > 5)
    assert not fields(), "none was found meanwhile"
    assert all(one.wrench.force.x < 0 for one in wrenches)
    composed.wait(lambda: composed.node.hearing.inbox.live(time.monotonic_ns()) == {})  # what was sent is heard
    newest = composed.node.answering._instant.stamp
    held.released.set()
    composed.wait(lambda: newest in fields())
    assert len(fields()) == 2 and fields()[-1] == newest, "the one that was begun, and the newest; none between"
    values = composed.node.tally.values()
    assert int(values["answers"]) < composed.node.tally.reactions


def test_what_is_solved_while_the_node_starts_anew_is_not_sent(composed, held):
    composed.wait(lambda: composed.press() and held.begun.is_set())
    begun = composed.node.answering._instant.stamp
    composed.node.reset()
    composed.wait(lambda: not composed.heard[-1].touches)
    heard = len(composed.heard)
    held.released.set()
    composed.wait(lambda: composed.node.answering._field.idle)
    composed.wait(lambda: composed.press() and len(composed.heard) > heard)
    assert composed.heard[heard].touches and composed.node.tally.refused == 0
    assert all(stamp_ns(one) > begun for one in composed.heard[heard:])


def test_a_field_that_fails_is_told_and_the_reaction_and_the_next_field_are_sent(composed, monkeypatch, capfd):
    composed.wait(lambda: composed.press() and composed.heard)
    composed.wait(lambda: composed.node.answering._field.idle)
    fields, failed = composed.node.answering._fields, []
    answer = fields.answer

    def spoilt_once(*what):
        found = answer(*what)
        if not failed:
            failed.append(what)
            return replace(found, displacement=np.nan * found.displacement)
        return found

    monkeypatch.setattr(fields, "answer", spoilt_once)
    composed.wait(lambda: composed.press() and failed)
    heard, tally = len(composed.heard), composed.node.tally
    reactions = tally.reactions
    composed.wait(lambda: composed.press() and len(composed.heard) > heard and tally.reactions > reactions)
    assert tally.refused == 1
    assert "the displacement would not be finite" in tally.last_refusal
    assert all(np.isfinite(rows(one)).all() for one in composed.heard)


def test_a_skin_that_takes_over_while_the_node_is_inactive_remembers_nothing_of_the_other(composed):
    node = composed.node
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    node.set_body(friction="dry")
    node.trigger_configure()
    node.trigger_activate()
    composed.wait(lambda: composed.press() and node.answering.remembering.state.tools)
    node.trigger_deactivate()
    assert node.set_body(youngs_modulus=1300.0) == "taken over"
    assert not node.answering.remembering.state.tools


def test_another_tissue_keeps_the_part_that_answers_where_none_was_asked_for(composed):
    node = composed.node
    assert node.settings.with_(tissue="paper").limb == node.config.limb == "left_forearm"
    node.trigger_deactivate()
    node.trigger_cleanup()
    node.settings.take(NodeConfig(tissue="paper"))
    node.trigger_configure()
    assert node.settings.with_(tissue="relaxed").limb == node.config.limb == "left_arm"


def test_another_stiffness_keeps_the_processes_that_build_fields_and_what_they_are_at(composed):
    node = composed.node
    composed.wait(lambda: "finger" in node.hearing.tools)
    before = set(multiprocessing.active_children())
    composed.announce(ball(0.008).named("thumb"))
    composed.wait(node.hearing.tools.waiting)
    for stiffness in (1300.0, 1400.0, 1500.0, 1600.0):
        assert node.set_body(youngs_modulus=stiffness) == "taken over"
    composed.wait(lambda: "thumb" in node.hearing.tools)
    assert before <= set(multiprocessing.active_children())
    assert len(multiprocessing.active_children()) <= len(before) + 1, "one more for the field beside the first"


def test_friction_that_an_elastic_node_takes_over_is_compiled_beside_it(composed):
    """Its first answer may take half a minute elsewhere, not here."""
    node, skin = composed.node, composed.node.skin
    assert not node.answering.simulator.remembers
    assert node.set_body(friction="dry").startswith("being made")
    composed.wait(lambda: composed.press() and node.answering.simulator.remembers)
    assert node.config.friction == "dry" and node.skin is skin
    composed.wait(lambda: composed.press() and node.answering.remembering.state.tools)


def test_another_friction_is_taken_over_at_once_and_what_is_remembered_stays(composed):
    node = composed.node
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    node.set_body(relaxing="true", friction="none")
    node.trigger_configure()
    node.trigger_activate()
    remembering = node.answering.remembering
    composed.wait(lambda: composed.press() and remembering.state.tools)
    before, skin = remembering.state, node.skin
    assert node.set_body(friction="dry") == "taken over"
    assert node.skin is skin and node.config.friction == "dry"
    (name,) = before.tools
    assert remembering.state.tools[name].scalars.largest == before.tools[name].scalars.largest > 0
    assert node.answering.simulator.history.friction(name) == PAIRS["dry"].friction
    with pytest.raises(InvalidInput, match="friction"):
        node.set_body(friction="wet")
    with pytest.raises(InvalidInput, match="relaxing"):
        node.set_body(relaxing="perhaps")


def test_a_rare_field_does_not_hold_up_what_fades(composed):
    """At a field in a thousand seconds the thread of the fields would rest until then."""
    node, answering = composed.node, composed.node.answering
    node.set_parameters([Parameter("field_rate", value=1e-3)])
    composed.wait(lambda: composed.press() and answering.last is not None)
    composed.wait(lambda: composed.press() and not answering._field.idle)
    newest = answering._instant.stamp
    composed.wait(lambda: answering.fading)
    assert answering.last is not None and answering.last[1].stamp >= newest, "the last field comes first"
    composed.wait(lambda: answering._instant is None)


def test_a_simulated_clock_that_is_set_back_brings_rest_and_no_answer_is_ever_amplified(composed, monkeypatch):
    node, answering = composed.node, composed.node.answering
    composed.wait(lambda: composed.press() and composed.heard)
    composed.wait(lambda: answering.fading)
    with monkeypatch.context() as patch:
        patch.setattr(node.hearing.inbox, "silence", lambda now: 0)
        count = len(composed.heard)
        composed.wait(lambda: len(composed.heard) > count + 3)
    assert all(0 < one.fade <= 1 for one in composed.heard)
    node.hearing.now.on_back()
    composed.wait(lambda: "went back" in composed.heard[-1].why or composed.heard[-1].fade > 1)
    assert composed.heard[-1].why == "the simulated clock went back: back at rest"
    assert not composed.heard[-1].touches and not rows(composed.heard[-1]).any() and answering._instant is None


def test_a_rate_that_was_rare_is_another_one_at_once(composed):
    """At 1 mHz the thread of the fields rests, and the display waits, for a thousand seconds."""
    node, answering = composed.node, composed.node.answering
    node.set_parameters([Parameter("field_rate", value=1e-3), Parameter("marker_rate", value=1e-3)])
    composed.wait(lambda: composed.press() and answering.last is not None)
    composed.wait(lambda: composed.press() and not answering._field.idle)
    composed.wait(lambda: node.sending.show._timer.time_until_next_call() > 10**11)
    solved = answering.last[1].stamp
    node.set_parameters([Parameter("field_rate", value=0.0), Parameter("marker_rate", value=15.0)])
    composed.wait(lambda: composed.press() and answering.last is not None and answering.last[1].stamp > solved)
    assert node.sending.show._timer.time_until_next_call() < 10**8


@pytest.mark.parametrize(("name", "least"), [("marker_rate", 1e-3), ("field_rate", 1e-3), ("rest_after", 1e-2),
                                             ("max_age", 1e-3)])  # fmt: skip
def test_a_setting_too_small_to_mean_anything_is_refused(composed, name, least):
    (refused,) = composed.node.set_parameters([Parameter(name, value=1e-300)])
    assert not refused.successful and f"{least:g}" in refused.reason
    assert composed.node.set_parameters([Parameter(name, value=least)])[0].successful


def test_a_field_whose_time_is_over_before_it_is_begun_is_not_begun(composed, held, monkeypatch):
    answering, asked = composed.node.answering, []
    composed.wait(lambda: composed.press() and held.begun.is_set())
    begun = answering._instant
    composed.wait(lambda: composed.press() and answering._instant is not begun)  # one more waits
    composed.wait(lambda: composed.node.hearing.inbox.live(time.monotonic_ns()) == {})  # what was sent is heard
    monkeypatch.setattr(answering._fields, "answer", asked.append)
    composed.node.reset()
    held.released.set()
    composed.wait(lambda: answering._field.idle)
    assert not asked and composed.node.tally.refused == 0


def test_another_surface_of_a_tool_ends_the_field_on_the_one_from_before(composed, held):
    composed.wait(lambda: composed.press() and held.begun.is_set())
    begun = composed.node.answering._instant.stamp
    known = composed.node.hearing.tools["finger"]
    composed.announce(ball(0.008).named("finger"))
    composed.wait(lambda: composed.node.hearing.tools["finger"] is not known)
    held.released.set()
    composed.wait(lambda: composed.node.answering._field.idle)
    answered = composed.press()
    composed.wait(lambda: stamp_ns(composed.heard[-1]) >= answered or not composed.press())
    assert begun not in [stamp_ns(one) for one in composed.heard]


def test_two_nodes_on_one_topic_tell_of_each_other_and_of_one_of_their_name():
    twins, command = Bus("/twins"), ("-c", NODE, "--ros-args", "-r", "__ns:=/twins")

    def told(twin: str) -> set[str]:
        where = f"there is another node {twin} on /twins/skin/displacement: listeners get the answers of both"
        return {line.name for line in twins.got["/rosout"] if line.msg.startswith(where) and "__ns:=" in line.msg}

    def warned() -> bool:
        return any(one.status[0].level == DiagnosticStatus.WARN and "there is another node" in one.status[0].message
                   for one in twins.got["/diagnostics"])  # fmt: skip

    namesake = None
    twins.listen(DiagnosticArray, "/diagnostics", STREAM)
    try:
        with running(*command):
            twins.wait(lambda: twins.got["skin/topology"], "skin/topology")
            twins.spin(2.5)
            assert not told("that answers") | told("of the same name") and not warned(), "one alone is no twin"
            with running(*command, "-r", "__node:=other"):
                twins.wait(lambda: told("that answers") == {"twins.stmpl", "twins.other"}, "both log lines")
                twins.wait(warned, "a warning on /diagnostics")
            namesake = rclpy.create_node("stmpl", namespace="/twins")
            twins.wait(lambda: "twins.stmpl" in told("of the same name"), "word of the namesake")
    finally:
        if namesake:
            namesake.destroy_node()
        twins.node.destroy_node()


def test_a_remapped_topic_is_heard_and_a_killed_node_is_told_by_its_liveliness(bus):
    gone: list[int] = []
    ask = QoSProfile(depth=10, liveliness=LivelinessPolicy.AUTOMATIC,
                     liveliness_lease_duration=Duration(seconds=2 * LEASE))  # fmt: skip
    told = SubscriptionEventCallbacks(liveliness=lambda event: gone.append(event.alive_count))
    remaps = ["-r", "__ns:=/other", "-r", "skin/topology:=/arm_skin", "--params-file", "config/stmpl.yaml",
              "-p", "edge_length:=0.01"]  # fmt: skip
    ear = bus.listen(SkinTopology, "/arm_skin", KEPT)
    listening = bus.listen(SkinDisplacement, "/other/skin/displacement", ask, event_callbacks=told)
    with running("-c", NODE, "--ros-args", *remaps, number=signal.SIGKILL):
        bus.wait(lambda: bus.got["/arm_skin"], "the topology under its other name")
        bus.wait(lambda: gone and gone[-1] == 1, "a live node")
    bus.wait(lambda: gone[-1] == 0, "the event that it is gone")
    for subscription in (ear, listening):
        bus.node.destroy_subscription(subscription)


def test_whatever_fails_beside_the_node_is_told_and_the_tool_from_before_goes_on(composed, capfd):
    node, failed = composed.node, Future()
    failed.set_exception(RuntimeError("an accident"))
    composed.wait(lambda: composed.press() and composed.heard)
    before, again = node.hearing.tools["finger"], ball().named("finger")
    node.hearing.tools.announce(again)
    node._on_field(again, failed)
    node.sending.models._on_models(Instant([contact_of(before, HERE)], 0, 0, {}), {}, {}, failed)
    said = capfd.readouterr().err
    assert "refused: mesh of 'finger' refused: an accident\n" in said and "no local contact: an accident\n" in said
    assert node.hearing.tools["finger"] is before and not node.hearing.tools.waiting()
    count = len(composed.heard)
    composed.wait(lambda: composed.press() and len(composed.heard) > count)
    assert rows(composed.heard[-1]).any()


@pytest.mark.parametrize("given", ["edge_length:=3.0", "edge_length:=fine", "limits:=/nowhere.yaml"])
def test_a_node_with_settings_that_cannot_be_ends_with_one_line(given):
    code, said = end(start("-c", NODE, "--ros-args", "-p", given))
    assert code == 1
    assert given.split(":=")[0] in said and "Traceback" not in said


def test_the_bus_knows_no_parameter_that_is_not_declared(bus):
    result = bus.call(SetParameters, "set_parameters", parameters=[ParameterMessage(name="no_such")]).results
    assert not result[0].successful


# What is asked of devices, and launch files


def test_a_device_that_offers_no_deadline_is_told_why_it_is_not_heard_and_one_that_misses_its_own_is_told_of(bus):
    """A node of its own, which asks for poses at least every 0.2 s."""
    strict = Bus("/strict")
    offering = QoSProfile(depth=10, deadline=Duration(seconds=0.1))
    try:
        with running("-c", NODE, "--ros-args", "-r", "__ns:=/strict", "-p", "deadline:=0.2"):
            strict.wait(lambda: strict.got["skin/topology"], "skin/topology")
            hand = strict.tool("probe")
            strict.wait(lambda: strict.said("tools/probe/pose: a sender is not heard"), "the log line")
            assert "DEADLINE" in strict.said("a sender is not heard")[-1]
            strict.listen(DiagnosticArray, "/diagnostics", STREAM)
            why = "/strict/tools/probe/pose: /strict/robot is not heard: Subscription deadline is less"
            strict.wait(lambda: any(why in one.status[0].message for one in strict.got["/diagnostics"]), why)
            strict.node.destroy_publisher(hand.pose)
            hand.pose = strict.node.create_publisher(PoseStamped, "tools/probe/pose", offering)
            hand.ready()

            def answered() -> list[SkinDisplacement]:  # the node may still be about to hear of the sender
                stamp = hand.send(HERE)
                strict.spin(0.05)
                return strict.answers(stamp)

            strict.wait(answered, "an answer")
            strict.wait(lambda: strict.said("tools/probe/pose: the sender missed its deadline"), "the log line")
    finally:
        strict.node.destroy_node()


@pytest.mark.parametrize("path", sorted((ROOT / "launch").glob("*.py")), ids=lambda path: path.name)
def test_a_launch_file_imports_only_launch_and_names_verbs_and_flags_that_exist(path):
    """It is read, not run: `launch` is found on ROS machines only."""
    tree = ast.parse(path.read_text())
    imported = {str(node.module).split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported <= {"launch", "launch_ros"}
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
    said = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    verb = next(word for word in said if word in ("node", "probe"))
    flags = {word for word in said if word.startswith("--")} - {"--ros-args", "--log-level"}
    code, told = end(start("-m", "stmpl_ros.cli", verb, "--help"))
    assert code == 0 and all(flag in told for flag in flags)


def test_everything_that_colcon_installs_is_there(monkeypatch):
    given = {}
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    monkeypatch.setattr("setuptools.setup", lambda **arguments: given.update(arguments))
    monkeypatch.chdir(ROOT)
    runpy.run_path("setup.py")
    installed = {folder: {Path(file).resolve() for file in files} for folder, files in given["data_files"]}
    for folder in ("launch", "config"):
        assert installed[f"share/stmpl_ros/{folder}"] == {path.resolve() for path in (ROOT / folder).iterdir()}
    assert all(file.is_file() for files in installed.values() for file in files)


LEAVING = """
import os, signal, sys
from stmpl_ros.spinning import interruptible, ros
with ros() as stop:
    inside = interruptible(stop)
    inside.__enter__()
    os.kill(os.getpid(), getattr(signal, sys.argv[1]))
"""


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_ends_a_process_cleanly_just_where_it_stops_being_interruptible_too(number):
    code, said = end(start("-c", LEAVING, number))
    assert (code, said) == (0, "")


HANGING_UP = """
import os, signal
from stmpl_ros import cli
from stmpl_ros.spinning import interruptible, ros
cli._end_soon_after_a_signal(0.0)
with ros() as stop, interruptible(stop):
    os.kill(os.getpid(), signal.SIGHUP)
    print("goes on")
"""


def test_a_closed_terminal_ends_no_process_that_ignores_it():
    ignores = start("-c", HANGING_UP, preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))  # as nohup does
    assert end(ignores) == (0, "goes on\n")


DELETING = """
import os, signal, sys
from stmpl_ros.node import run
from stmpl_ros.parameters import NodeConfig
from tests.node_bus import skin

class Left:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)

def build(config):
    Left()
    return skin(config)

sys.exit(run(NodeConfig(tissue="paper"), build=build))
"""


def test_ctrl_c_ends_a_node_that_configures_also_where_python_swallows_it():
    code, said = end(start("-c", DELETING))
    assert code == 0 and "Exception ignored in" in said and "answering with" not in said


def test_ctrl_c_in_a_compiled_call_is_no_transition_that_failed():
    def on_configure(node, state):
        raise SystemError("a call returned a result with an exception set") from KeyboardInterrupt()

    with pytest.raises(KeyboardInterrupt):
        lifecycle.told(on_configure)(None, None)  # type: ignore[arg-type]


CTRL_C = """
import os, signal, time
from stmpl_ros.beside import Beside
signal.signal(signal.SIGINT, lambda *_: None)  # as a node that takes its time to end
one = Beside(os.getpid)
while not one.result.done():
    os.killpg(0, signal.SIGINT)
    time.sleep(0.05)
assert one.result.result() != os.getpid()
one.close()
"""


def test_ctrl_c_does_not_reach_a_process_beside_the_node_that_still_imports():
    ended = subprocess.run([sys.executable, "-c", CTRL_C], start_new_session=True, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_process_beside_the_node_ends_also_while_it_imports_or_hands_its_result_over():
    """A result cut off midway left the pool's thread, and with it the node, waiting for ever."""
    before = set(multiprocessing.active_children())
    builders = Builders()
    (importing,) = set(multiprocessing.active_children()) - before
    builders.close()
    assert not any(thread.is_alive() for thread in _threads_wakeups), "a thread that ends beside Python trips over it"
    importing.join(PATIENCE)
    assert importing.exitcode == -signal.SIGTERM
    asleep = Beside(time.sleep, 3600)
    asleep.close()
    assert asleep.result.exception() or asleep.result.cancelled()
    large = Beside(bytes, 2 * 10**8)
    wait([large._pool._result_queue._reader], PATIENCE)
    large.close()
    assert set(multiprocessing.active_children()) <= before


def test_a_verb_whose_output_nobody_wants_ends_well():
    ended = subprocess.run(["sh", "-c", 'exec "$0" -m stmpl_ros.cli --help >&-', sys.executable], capture_output=True)
    assert (ended.returncode, ended.stderr) == (0, b"")
