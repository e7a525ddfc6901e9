"""Laws of what a node refuses: whoever asks for what cannot be gets a sentence, and the node serves on."""

import os
import re
from collections import defaultdict

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.context import Context
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from stmpl_msgs.msg import ContactMesh, LocalContact
from stmpl_msgs.srv import SetBody

from bags.wire import header, pose_message, tool_message
from stmpl_core.errors import InvalidInput
from stmpl_ros.domain import DOMAINS
from stmpl_ros.node import SkinNode
from stmpl_ros.parameters import ANY_TIME, CONFIGURING, NodeConfig
from stmpl_ros.settings import Settings
from stmpl_ros.topics import STREAM
from tests.bus import ROOT, end, running, start
from tests.node_bus import HERE, NODE, PUSH, Bus, Hand
from tests.scenes import ball


def change(bus, number: int = 0, label: str = "") -> bool:
    """Whether the node changed its state so."""
    return bus.call(ChangeState, "change_state", transition=Transition(id=number, label=label)).success


def state(bus) -> str:
    return bus.call(GetState, "get_state").current_state.label


@pytest.mark.parametrize(("asked", "said"), [
    ({"number": 1}, "no transition 1 from"), ({"number": 2}, "no transition 2 from"), ({"number": 99}, "99 from"),
    ({}, "no transition 0 from"), ({"number": 4, "label": "cleanup"}, "no transition 'cleanup' from"),
])  # fmt: skip
def test_a_transition_that_the_state_does_not_know_is_refused_and_the_node_answers_on(bus, hand, asked, said):
    before = len(bus.said(said))
    assert not change(bus, **asked)
    line = bus.wait(lambda: bus.said(said)[before:], "the log line")[0]
    assert line.endswith("the state 'active'; possible are deactivate (4), shutdown (7).")
    assert state(bus) == "active"
    assert hand.ask(HERE, PUSH).touches


def test_a_node_whose_configuring_was_refused_may_be_asked_for_anything_and_is_configured_in_the_end(bus, hand):
    assert change(bus, label="deactivate") and change(bus, label="cleanup")
    assert bus.set(thickness=0.05)[0].successful  # more than the limb bears
    assert not change(bus, label="configure") and not change(bus, label="activate")
    assert not change(bus, Transition.TRANSITION_ACTIVATE)
    assert state(bus) == "unconfigured"
    assert bus.set(thickness=0.01)[0].successful
    assert change(bus, Transition.TRANSITION_CONFIGURE) and change(bus, Transition.TRANSITION_ACTIVATE)
    assert hand.ready().ask(HERE, PUSH).touches


@pytest.mark.parametrize(("given", "says"), [
    (["--params-file", "/nope.yaml"], "ROS does not take its arguments: Couldn't parse params file"),
    (["-p", "part"], "ROS does not take its arguments: Couldn't parse parameter override rule: '-p part'"),
    (["-p", "use_sim_time:=1"], "ROS does not take its arguments: Trying to set parameter 'use_sim_time' to '1'"),
    (["garbage", "--"], "ROS does not know what ['garbage'] means after --ros-args"),
])  # fmt: skip
def test_arguments_that_ros_does_not_take_end_a_verb_with_one_sentence(given, says):
    code, said = end(start("-m", "stmpl_ros.cli", "node", "--ros-args", *given))
    assert code == 1 and said.splitlines()[-1].startswith(f"stmpl: {says}")
    assert "/src/" not in said and "Traceback" not in said


def test_a_place_for_ros_log_that_is_not_there_is_named_with_what_says_another():
    here = {name: value for name, value in os.environ.items() if name not in ("HOME", "ROS_LOG_DIR", "ROS_HOME")}
    code, said = end(start("-m", "stmpl_ros.cli", "node", env=here))
    assert code == 1 and said.splitlines()[-1].startswith("stmpl: ROS cannot write its log: ")
    assert said.rstrip().endswith("Set ROS_LOG_DIR, or HOME, to a folder that can be written.")


def test_a_parameter_that_nobody_declared_is_told_once_and_with_it_the_one_that_may_be_meant(bus):
    space, given = Bus("/typos"), ("-p", "bogus:=1", "-p", "fede:=0.5", "-p", "use_sim_time:=false")
    try:
        with running("-c", NODE, "--ros-args", "-r", "__ns:=/typos", *given):
            space.wait(lambda: space.got["skin/topology"], "skin/topology")
            space.wait(lambda: len(space.said("there is no parameter")) > 1, "both log lines")
            assert sorted(space.said("there is no parameter")) == [
                "there is no parameter bogus: it is ignored.",
                "there is no parameter fede: it is ignored. Is fade meant?",
            ]
    finally:
        space.node.destroy_node()


def test_the_page_names_every_parameter_where_it_counts():
    page = (ROOT / "docs/node.md").read_text().split("## Parameters")[1].split("\n## ")[0]
    named = defaultdict[str, set[str]](set)
    for when, names in re.findall(r"^\| ([^|]+?)(?:, or| \(| \|)(?:[^|]*\|)? (`.*) \|$", page, re.M):
        named[when] |= set(re.findall(r"`([a-z_]+)`", names))
    anytime, configuring = NodeConfig.names(ANY_TIME), NodeConfig.names(CONFIGURING)
    assert named["at any time"] == anytime
    assert named["when the node is configured"] == configuring
    assert named["from the start"] == NodeConfig.model_fields.keys() - anytime - configuring


def test_a_part_that_no_body_has_is_refused_before_the_node_is_configured_too():
    context = Context()
    context.init(domain_id=int(os.environ["ROS_DOMAIN_ID"]) + DOMAINS)
    node = SkinNode(NodeConfig(), context=context)
    try:
        refused, taken = (node.set_parameters([Parameter("part", value=part)])[0] for part in ("nose", "right_forearm"))
        assert not refused.successful and refused.reason.startswith("unknown part 'nose'. Available: left_arm")
        assert taken.successful and node.config.part == "right_forearm"
    finally:
        node.destroy_node()
        context.try_shutdown()
        context.destroy()


def test_a_configured_node_takes_what_it_has_already_and_refuses_what_differs_by_name():
    context = Context()
    context.init(domain_id=int(os.environ["ROS_DOMAIN_ID"]) + DOMAINS)
    node = LifecycleNode("configured", context=context)
    try:
        settings = Settings(node, NodeConfig(joints=("left_elbow=elbow_2",)), lambda config: None)
        settings.locked = True
        names = sorted(NodeConfig.names(CONFIGURING) | NodeConfig.names(ANY_TIME))
        dumped = [node.get_parameter(name) for name in names]
        assert all(result.successful for result in node.set_parameters(dumped)), "ros2 param dump and load"
        given = [Parameter("edge_length", value=0.003), Parameter("method", value="unet")]
        reason = node.set_parameters_atomically(given).reason
        assert reason == "a configured node takes no other method as a parameter: clean up first."
    finally:
        node.destroy_node()
        context.try_shutdown()
        context.destroy()


@pytest.mark.parametrize("name", ["1bad", "a//b", "x" * 200])
def test_a_shape_tool_whose_name_no_topic_can_have_is_refused_at_the_start(name):
    context = Context()
    context.init(domain_id=int(os.environ["ROS_DOMAIN_ID"]) + DOMAINS)
    says = f"shape_tools names '{name[:60]}': a tool's name must be a ROS name: letters, digits, _ and /, each part"
    try:
        with pytest.raises(InvalidInput, match=says):
            SkinNode(NodeConfig(shape_tools=("ok", name)), context=context)
    finally:
        context.try_shutdown()
        context.destroy()


def test_who_asks_for_the_body_that_answers_is_told_so_at_once_and_nothing_is_made(bus, hand):
    layers = len(bus.got["skin/topology"])
    for same in ({}, {"thickness": bus.get("thickness")[0]}):
        done = bus.call(SetBody, "set_body", **same)
        assert done.success and done.message == "nothing changes: the node answers on it already"
    bus.spin(0.5)
    assert hand.ask(HERE, PUSH).touches and len(bus.got["skin/topology"]) == layers


def told(bus, do, says: str = "") -> DiagnosticStatus:
    """What /diagnostics tells once it is not well, and says so, while `do` is done again and again."""
    heard: list[DiagnosticStatus] = []
    ear = bus.node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: heard.append(m.status[0]), STREAM)
    level = {DiagnosticStatus.WARN, DiagnosticStatus.ERROR}
    bus.wait(lambda: (do(), bus.spin(0.05), heard and heard[-1].level in level and says in heard[-1].message)[-1],
             f"a level, and {says}")  # fmt: skip
    bus.node.destroy_subscription(ear)
    return heard[-1]


@pytest.mark.parametrize("seconds", [-5.0, 5.0])
def test_stamps_that_are_too_old_or_to_come_are_told_in_the_diagnostics(bus, hand, seconds):
    bus.still()
    hand.send(HERE, frame="nowhere")  # refused, and nothing to do with it
    bus.spin(2.5)
    late = told(bus, lambda: hand.pose.publish(pose_message(HERE, "body", bus.now() + int(seconds * 1e9))))
    assert late.level == DiagnosticStatus.ERROR
    way = "before" if seconds < 0 else "after"
    stamped = re.search(rf"nothing that came could be used: a message stamped ([\d.]+) s {way} now", late.message)
    assert stamped and float(stamped[1]) == pytest.approx(abs(seconds), abs=1.0)
    assert "nowhere" not in late.message and "max_age:=0" in late.message
    assert "max_age:=0" in {one.key: one.value for one in late.values}["last dropped"]


def test_poses_of_a_tool_whose_mesh_was_refused_are_told_in_the_diagnostics(bus, hand):
    torn = ContactMesh(header=header("torn", bus.now()), vertices=[0.0] * 4, triangles=[0, 1, 2])
    Hand(bus, "nobody", announce=False).take_away()
    bus.mesh.publish(torn)
    bus.wait(lambda: bus.said("mesh of 'torn' refused"), "the log line")
    assert not bus.said("'nobody'"), "who is not known is taken away already"
    bus.still()
    bus.spin(1.5)
    sender = Hand(bus, "torn", announce=False)
    level = told(bus, lambda: sender.send(HERE), "no surface of 'torn' that can be used").level
    assert level == DiagnosticStatus.WARN
    assert "(mesh of 'torn' refused: " in told(bus, lambda: sender.send(HERE)).message
    for one in (sender.pose, sender.wrench):
        bus.node.destroy_publisher(one)


def test_a_tool_whose_newest_surface_is_refused_is_answered_with_the_one_before_and_flagged(bus, hand):
    models: list[LocalContact] = []
    ear = bus.node.create_subscription(LocalContact, "tools/probe/local_contact", models.append, STREAM)
    bus.wait(lambda: hand.ask(HERE, PUSH).touches[0].in_range and models and models[-1].in_range, "a model in range")
    bus.mesh.publish(ContactMesh(header=header("probe", bus.now()), vertices=[0.0] * 4, triangles=[0, 1, 2]))
    bus.wait(lambda: bus.said("mesh of 'probe' refused"), "the log line")
    answer, says = hand.ask(HERE, PUSH), "probe is answered with its surface from before (mesh of 'probe' refused: "
    assert says in answer.why and not answer.in_range and not answer.touches[0].in_range
    assert told(bus, lambda: hand.send(HERE, PUSH), says).level == DiagnosticStatus.WARN
    all_of_them = told(bus, lambda: hand.send(HERE, PUSH), "answers of the last second are out of range")
    assert all_of_them.message.count(says) == 1
    bus.wait(lambda: not models[-1].in_range, "the model to be flagged as the answer is")
    bus.node.destroy_subscription(ear)
    skins = len(bus.got["skin/topology"])
    assert bus.call(SetBody, "set_body", thickness=5e-3).success  # fields of another margin
    bus.wait(lambda: hand.press() or bus.got["skin/topology"][skins:], "the other skin")
    assert says in bus.wait(lambda: hand.ask(HERE, PUSH), "an answer").why
    bus.mesh.publish(tool_message(ball().named("probe"), bus.now()))
    bus.wait(lambda: hand.ask(HERE, PUSH).in_range, "the good one to be trusted again")


def test_a_fade_blames_the_poses_that_could_not_be_used_and_nothing_else(bus, hand):
    def faded() -> str:
        before = len(bus.got["skin/displacement"])
        bus.wait(lambda: [one for one in bus.got["skin/displacement"][before:] if "no pose for" in one.why], "a fade")
        return bus.got["skin/displacement"][-1].why

    hand.ask(HERE, PUSH)
    hand.send(HERE, np.full(6, np.nan))
    assert "refused" not in faded(), "a wrench is no pose"
    hand.ask(HERE, PUSH)
    hand.pose.publish(pose_message(HERE, "body", bus.now() - 5 * 10**9))
    assert "no pose for 0.4 s that could be used (refused: a message stamped" in faded()
    hand.ask(HERE, PUSH)
    hand.send(HERE, frame="nowhere")
    assert "no pose for 0.4 s that could be used (refused: the pose of probe is in frame 'nowhere'" in faded()


def test_two_senders_of_one_tool_are_told_in_the_diagnostics_by_their_names(bus, hand):
    other = rclpy.create_node("impostor", namespace="/robot")
    try:
        other.create_publisher(PoseStamped, "tools/probe/pose", STREAM)
        both = told(bus, lambda: hand.send(HERE), "2 senders")
        assert both.level == DiagnosticStatus.WARN
        senders = "/robot/tools/probe/pose has 2 senders, /robot/impostor, /robot/robot; only one can be the tool"
        assert both.message.endswith(senders)
    finally:
        other.destroy_node()


def test_a_force_sensor_that_died_is_told_in_the_diagnostics_while_its_poses_are_answered(bus, hand):
    assert hand.ask(HERE, PUSH).touches[0].in_range
    dead = told(bus, lambda: hand.send(HERE), "no wrench of probe for 0.4 s: answered without it")
    assert dead.level == DiagnosticStatus.WARN and hand.ask(HERE).touches[0].in_range


def test_who_is_not_heard_for_what_it_offers_is_told_in_the_diagnostics_until_it_is_gone(bus, hand):
    unheard = "/robot/contact_mesh: /robot/hasty is not heard: Volatile publisher and transient local subscription"
    other = rclpy.create_node("hasty", namespace="/robot")
    try:
        other.create_publisher(ContactMesh, "contact_mesh", STREAM)
        assert told(bus, lambda: hand.send(HERE), unheard).level == DiagnosticStatus.WARN
    finally:
        other.destroy_node()
    heard: list[DiagnosticStatus] = []
    ear = bus.node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: heard.append(m.status[0]), STREAM)
    bus.wait(lambda: heard and unheard not in heard[-1].message, "word that it is gone")
    bus.node.destroy_subscription(ear)
