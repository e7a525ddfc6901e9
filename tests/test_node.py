"""Laws of the node as a robot team meets it: parameters and services."""

import time

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.srv import DescribeParameters
from rclpy.action.client import ActionClient
from ruamel.yaml import YAML
from std_srvs.srv import Trigger
from stmpl_msgs.action import SetBody as SetBodyAction
from stmpl_msgs.srv import Calibrate, GetTopology, SetBody

from bags.wire import layer_from, pose_message, tool_message
from stmpl_core import Simulator, State
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import layer_id
from stmpl_core.methods import Winkler
from stmpl_core.skin import published
from stmpl_core.touch import BY_POSE, MOVED, STALE, TOUCHING
from stmpl_core.toucher import Toucher
from stmpl_core.trust import Trust
from stmpl_ros.calibration import EVERY
from stmpl_ros.diagnosis import Counts, Health, Tally
from stmpl_ros.making import restiffened, skin_of
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.settings import _told, checked
from tests.bus import ROOT, rows, statuses
from tests.node_bus import HERE, PUSH, skin
from tests.scenes import LENGTH, RADIUS, at, ball, contact_of

# Parameters


def test_the_yaml_holds_every_parameter_with_its_default():
    read = YAML(typ="safe").load((ROOT / "config/stmpl.yaml").read_text())["/**"]["ros__parameters"]
    assert read == {name: _told(value) for name, value in NodeConfig()}, "a list of nothing is one of an empty text"
    assert checked(read) == NodeConfig()


def test_names_come_as_a_list_or_as_one_text(bus):
    assert bus.get("shape_tools", "gz_contacts") == ["shaped", [""]], "as it was set"
    assert checked({"tf_tools": "a=b c=d"}).tf_frames == checked({"tf_tools": ["a=b", "", "c=d"]}).tf_frames
    with pytest.raises(InvalidInput, match="'finger' is no tool=frame"):
        checked({"tf_tools": ["finger"]})
    arguments = NodeConfig(tf_tools=("a=b",)).ros_arguments()
    assert 'tf_tools:=["a=b"]' in arguments and 'shape_tools:=[""]' in arguments


@pytest.mark.parametrize("given", [{"tf_tools": "limb=tool0"}, {"shape_tools": "limb"}, {"gz_contacts": "limb=a::b"}])
def test_no_tool_is_named_as_the_bodys_frame(given):
    with pytest.raises(InvalidInput, match="'limb' is the body's own frame; a tool needs another name"):
        checked({"frame": "limb"} | given)
    assert checked(given)


def test_a_parameter_says_its_unit_its_range_and_when_it_counts(bus):
    asked = ["edge_length", "max_age", "frame", "method"]
    edge, age, frame, method = bus.call(DescribeParameters, "describe_parameters", names=asked).descriptors
    assert "[m]" in edge.description and "configured" in edge.description and edge.additional_constraints == "above 0"
    assert (edge.floating_point_range[0].from_value, edge.floating_point_range[0].to_value) == (0, 0.05)
    assert "at once" in age.description and not age.read_only
    assert frame.read_only and "moment_net" in method.additional_constraints


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rest_after": 0.0}, "rest_after"),
        ({"marker_rate": -1.0}, "range"),
        ({"max_age": "old"}, "type"),
        ({"frame": "world"}, "read-only"),
        ({"youngs_modulus": 2e3}, "set_body"),
        ({"friction": "oiled"}, "a configured node takes no other friction as a parameter: call ~/set_body"),
        ({"method": "linear"}, "a configured node takes no other method as a parameter: clean up first"),
    ],
)
def test_a_parameter_that_cannot_be_taken_is_refused_and_told_why(bus, change, says):
    (result,) = bus.set(**change)
    assert not result.successful and says in result.reason


def test_a_running_node_honours_what_may_be_set_at_any_time(bus, hand):
    hand.ask(HERE, PUSH)
    old = bus.now() - 5 * 10**9
    assert bus.set(max_age=0.0, fade=0.0)[0].successful
    hand.ask(HERE, PUSH)
    bus.still()
    assert not [a for a in bus.got["skin/displacement"][-2:] if STALE in statuses(a).values()], "fade 0 rests at once"
    hand.pose.publish(pose_message(HERE, "body", old))
    bus.wait(lambda: bus.answers(old), "the answer to an old pose")
    assert bus.set(max_age=1.0, fade=0.6)[0].successful
    assert bus.get("max_age", "fade") == [1.0, 0.6]


def test_settings_that_cannot_be_are_refused_with_what_is_wrong():
    with pytest.raises(InvalidInput, match=r"edge_length is 3.0: .*0.05"):
        checked({"edge_length": 3.0})
    with pytest.raises(InvalidInput, match="'wheight' is no phenotype; known are gender"):
        checked({"phenotype": "wheight=0.3"})
    assert checked({"phenotype": "weight=0.7 muscle=0.3"}).phenotype_values == {"weight": 0.7, "muscle": 0.3}


# Services


def test_reset_brings_the_skin_to_rest_and_forgets_the_last_wrench(bus, hand):
    hand.ask(HERE, PUSH)
    before = len(bus.got["skin/displacement"])
    answer = bus.call(Trigger, "reset")
    assert answer.success and "at rest" in answer.message
    rest = bus.wait(lambda: bus.got["skin/displacement"][before:], "the skin at rest")[0]
    assert not rows(rest).any() and not rest.touches and "reset" in rest.why
    again = hand.ask(HERE)
    assert statuses(again) == {"probe": BY_POSE}, "the wrench from before the reset is forgotten"


@pytest.mark.parametrize(
    ("change", "says"),
    [({"thickness": -1.0}, "thickness"), ({"poisson_ratio": 0.6}, "poisson_ratio"), ({"phenotype": "x=1"}, "known are"),
     ({"edge_length": float("nan")}, "edge_length"), ({"part": "right_arm"}, "region")],
)  # fmt: skip
def test_a_body_that_cannot_be_is_refused_and_the_node_goes_on(bus, hand, change, says):
    answer = bus.call(SetBody, "set_body", **change)
    assert not answer.success and says in answer.message
    assert statuses(hand.ask(HERE, PUSH)) == {"probe": TOUCHING}


@pytest.fixture
def another(bus):
    """Asks for another body by the action: the goal's handle, its result when it is done, and what was said of it."""
    client, said = ActionClient(bus.node, SetBodyAction, "stmpl/set_body"), []
    bus.wait(client.server_is_ready, "the action")

    def ask(**change):
        goal = SetBodyAction.Goal(**change)
        asked = client.send_goal_async(goal, feedback_callback=lambda m: said.append(m.feedback))
        bus.wait(asked.done, "the goal to be accepted")
        return asked.result(), asked.result().get_result_async(), said

    yield ask
    client.destroy()


def test_a_body_by_the_action_is_told_of_until_it_answers(bus, hand, another):
    hand.ask(HERE, PUSH)
    _, done, said = another(thickness=6.5e-3)
    bus.wait(done.done, "the other body")
    result = done.result()
    assert result.status == GoalStatus.STATUS_SUCCEEDED and result.result.success
    assert said and "being made" in said[0].stage and said[-1].seconds >= said[0].seconds > 0
    assert hand.ask(HERE, PUSH).layer_id == result.result.layer_id
    _, done, _ = another(youngs_modulus=1234.0)  # at hand at once
    bus.wait(done.done, "the other stiffness")
    assert done.result().result.success and bus.get("youngs_modulus", "thickness") == [1234.0, 6.5e-3]


def test_a_body_by_the_action_may_be_cancelled_and_one_that_cannot_be_is_told(bus, hand, another):
    before = hand.ask(HERE, PUSH).layer_id
    goal, done, _ = another(thickness=8.5e-3)
    bus.wait(goal.cancel_goal_async().done, "the cancel")
    bus.wait(done.done, "the end of it")
    assert done.result().status == GoalStatus.STATUS_CANCELED and "cancelled" in done.result().result.message
    assert hand.ask(HERE, PUSH).layer_id == before
    _, done, _ = another(thickness=-1.0)
    bus.wait(done.done, "the refusal")
    assert done.result().status == GoalStatus.STATUS_ABORTED and "thickness" in done.result().result.message
    assert done.result().result.layer_id == before, "the layer that answers is told of a refusal too"
    _, done, _ = another(thickness=0.05)  # only making it shows that it cannot be
    bus.wait(done.done, "the refusal")
    assert done.result().status == GoalStatus.STATUS_ABORTED and "thicker" in done.result().result.message
    assert hand.ask(HERE, PUSH).layer_id == before


def test_the_topology_may_be_asked_for(bus):
    answer = bus.call(GetTopology, "get_topology")
    newest = bus.got["skin/topology"][-1]
    assert answer.success and answer.topology.layer_id == newest.layer_id
    assert answer.topology.vertices == newest.vertices and answer.topology.triangles == newest.triangles


def test_health_tells_what_is_so_now_and_not_what_was():
    counts = Counts()
    assert counts.since(reactions=5, refused=2)["refused"] == 2
    later = counts.since(reactions=9, refused=2)
    assert later == {"reactions": 4, "refused": 0}
    assert Health(later, live=True).said == (DiagnosticStatus.OK, "answering")
    assert Health({"reactions": 4, "refused": 1}).said[0] == DiagnosticStatus.WARN
    level, said = Health({"reactions": 0, "refused": 1}, "no frame").said
    assert level == DiagnosticStatus.ERROR and said.endswith("no frame")
    assert Health(fading=True).said[0] == DiagnosticStatus.STALE == Health(active=False).said[0]
    assert Health(doubt="no joints").said == (DiagnosticStatus.STALE, "no joints")
    level, said = Health({"reactions": 4, "refused": 3}, "nan", doubt="no joints").said
    assert level == DiagnosticStatus.WARN and said.endswith("3 refused: nan; no joints")
    assert Health().said == (DiagnosticStatus.OK, "at rest: no tool is heard")
    doubted, sound = Trust(in_range=False, why="pulls"), Trust()
    for trusts, told in (((doubted, sound), "1 of 2"), ((doubted,), "1 of 1"), ((doubted, doubted), "2 of 2")):
        tally = Tally()
        for trust in trusts:
            tally.solved(0.1, 0.1, trust)
        assert tally.values()["out of range"] == told and bool(tally.doubt) == (told == "2 of 2")
    said = Health(live=True, out_of_range=tally.doubt).said
    assert said == (DiagnosticStatus.WARN, "all 2 answers of the last second are out of range: pulls")
    assert Health(live=True, paused=True).said == (DiagnosticStatus.OK, "answering; the simulated clock is paused")
    soon = "at rest: no tool is heard; a distance field is being built for big"
    assert Health(building=("big",)).said == (DiagnosticStatus.OK, soon)


def test_another_body_takes_over_while_the_node_goes_on_answering(bus, hand):
    hand.ask(HERE, PUSH)
    layers, before = len(bus.got["skin/topology"]), len(bus.got["skin/displacement"])
    answer = bus.call(SetBody, "set_body", youngs_modulus=2e3, thickness=6e-3)
    assert answer.success, answer.message
    refused = bus.call(SetBody, "set_body", youngs_modulus=3e3)
    assert not refused.success and "being made" in refused.message

    def taken_over():
        hand.press()
        bus.spin(0.02)
        return bus.got["skin/topology"][layers:]

    topology = bus.wait(taken_over, "the other skin")[0]
    layer = layer_from(topology)
    assert layer.tissue.youngs_modulus == 2e3 and layer.thickness.max() == pytest.approx(6e-3)
    assert topology.layer_id == layer_id(layer) != bus.got["skin/topology"][0].layer_id
    meanwhile = [a for a in bus.got["skin/displacement"][before:] if a.layer_id != topology.layer_id]
    assert len(meanwhile) > 10, "the old skin answered until the new one took over"
    assert not [a for a in meanwhile if not a.touches], "nothing went to rest meanwhile"
    assert hand.ask(HERE, PUSH).layer_id == topology.layer_id
    assert bus.get("youngs_modulus", "thickness") == [2e3, 6e-3]


def test_another_stiffness_alone_is_at_hand_at_once_and_answers_as_one_that_was_made():
    config = NodeConfig(thickness=7e-3)
    given, contact = skin_of(config, skin), contact_of(ball(), HERE, PUSH)
    Simulator(given).step([contact])  # what the old one was asked leaves no trace
    harder = config.model_copy(update={"youngs_modulus": 3e3})
    quick, made = restiffened(given, harder, {"youngs_modulus"}), skin_of(harder, skin)
    assert quick is not None and quick.layer_id == made.layer_id != given.layer_id
    assert Simulator(quick).step([contact]).displacement.tobytes() == (
        Simulator(made).step([contact]).displacement.tobytes()
    )
    assert restiffened(given, harder, {"youngs_modulus", "thickness"}) is None
    assert restiffened(given, harder.model_copy(update={"method": "fem"}), {"youngs_modulus"}) is None


def test_calibrate_finds_the_stiffness_and_the_offset_that_the_robots_presses_had(bus):
    hidden, back = 4.2e3, 0.8e-3
    layer = skin(NodeConfig(**dict(zip(asked := ("thickness",), bus.get(*asked), strict=True)), youngs_modulus=hidden))
    toucher, tool = Toucher(published(layer)), ball().named("finger")
    hand = bus.tool("finger").ready()
    bus.still()
    bus.call(Trigger, "reset")
    few = bus.call(Calibrate, "calibrate")
    assert not few.success and "0 of 0 instants pressed" in few.message and few.presses == 0
    for depth in np.linspace(0.4e-3, 3e-3, 24):
        pose = at(RADIUS + 0.012 - depth, 0, LENGTH / 2)
        wrench = toucher.touch(contact_of(tool, pose, name="finger")).wrench
        assert statuses(hand.ask(at(back, 0, 0) @ pose, wrench))["finger"] in (TOUCHING, MOVED)
    nobody = bus.call(Calibrate, "calibrate", tool="nobody")
    assert not nobody.success and "'nobody' has not pressed" in nobody.message and "finger has" in nobody.message
    before, layers = len(bus.got["skin/displacement"]), len(bus.got["skin/topology"])

    def press_on() -> None:
        hand.send(at(back, 0, 0) @ HERE, PUSH)

    timer = bus.node.create_timer(0.05, press_on)
    found = bus.call(Calibrate, "calibrate", tool="finger", apply=True)
    assert found.success, found.message
    assert found.youngs_modulus == pytest.approx(hidden, rel=0.05) and found.relative_error < 0.25
    assert found.offset == pytest.approx(back, abs=1e-4) and found.residual < 0.05 and found.presses > 15
    topology = bus.wait(lambda: bus.got["skin/topology"][layers:], "the skin of that stiffness")[0]
    assert topology.youngs_modulus == pytest.approx(found.youngs_modulus) == bus.get("youngs_modulus")[0]
    bus.node.destroy_timer(timer)
    assert len(bus.got["skin/displacement"]) > before + 5, "answers went on meanwhile"
    bus.still()


def test_calibrate_finds_the_friction_that_the_robots_strokes_had(bus):
    """The law of friction is that of the strokes, so only noise and what the service makes of it are tried here."""
    layer = skin(NodeConfig(**dict(zip(asked := ("thickness", "youngs_modulus"), bus.get(*asked), strict=True))))
    robot, tool, state = Simulator(published(layer), Winkler(), friction=0.4), ball().named("finger"), State()
    hand = bus.tool("finger").ready()
    bus.still()
    bus.call(Trigger, "reset")
    along = np.concatenate([np.zeros(6), np.arange(1, 45), np.arange(43, -1, -1)]) * 4e-4
    for depth, z in zip(np.minimum(np.arange(len(along)) / 5, 1) * 2.5e-3 + 1e-4, along, strict=True):
        pose = at(RADIUS + 0.012 - depth, 0, LENGTH / 2 + z)
        (touch,), state = robot.touch([contact_of(tool, pose, name="finger")], state, 0.02)
        assert statuses(hand.ask(pose, touch.wrench))["finger"] in (TOUCHING, MOVED)
        time.sleep(EVERY)  # instants that come sooner are not kept
        if z == along.max():  # where it turns
            bus.mesh.publish(tool_message(tool, bus.now()))  # its own surface once more, for who came late
            bus.spin(1.0)
    found = bus.call(Calibrate, "calibrate", tool="finger", what="friction")
    assert found.success, found.message
    assert found.friction == pytest.approx(0.4, rel=0.12) and abs(found.friction - 0.4) < 2 * found.friction_error
    assert found.presses >= 8 and found.fading == 0 and "there and back" in found.message
    moved = bus.call(Calibrate, "calibrate", tool="finger", what="relaxation")
    assert not moved.success and "hold" in moved.message
    for what, apply, says in (("colour", False, "Available"), ("relaxation", True, "not applied")):
        refused = bus.call(Calibrate, "calibrate", what=what, apply=apply)
        assert not refused.success and says in refused.message
    bus.still()


def test_a_body_that_cannot_be_made_is_told_and_the_one_from_before_goes_on(bus, hand):
    before = hand.ask(HERE, PUSH).layer_id
    lines = len(bus.said("no other skin"))
    assert bus.call(SetBody, "set_body", thickness=0.05).success, "only making it shows that it cannot be"
    bus.wait(lambda: len(bus.said("no other skin")) > lines, "the log line")
    assert "thicker than the limb" in bus.said("no other skin")[-1]
    assert hand.ask(HERE, PUSH).layer_id == before
    assert bus.get("thickness") != [0.05]
