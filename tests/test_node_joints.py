"""Laws of a node on a limb that moves: joint states bend it, answers say where it was, and a recording repeats them."""

import signal
import time

import numpy as np
import pytest
import rclpy
from sensor_msgs.msg import JointState
from stmpl_msgs.msg import LocalContact, SkinDeformed

from bags.replay import replay, replay_run
from bags.run import Run
from bags.wire import header, layer_from
from stmpl_core import Contact, Simulator
from stmpl_core.layer import layer_id
from stmpl_core.methods import MomentNet
from stmpl_core.posing import posed
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.topics import STREAM
from tests.bus import end, rows, running, start
from tests.node_bus import Bus
from tests.scenes import RADIUS, at, ball, limb
from tests.test_posing import hinged

NODE = """
import sys
from stmpl_ros.node import run
from stmpl_ros.parameters import NodeConfig
from tests.test_node_joints import skin
sys.exit(run(NodeConfig(tissue="paper", rest_after=0.4, fade=0.0, friction="0.4", joint_states="person/joint_states",
                        joints=("elbow=elbow_2",)), sys.argv[1:], build=skin))
"""
HERE = at(0, RADIUS + 0.012 - 1e-3, 0.05)
SLIDES = [at(0, RADIUS + 0.012 - 1.5e-3, z) for z in np.linspace(0.05, 0.054, 12)]


def skin(config: NodeConfig):
    layer = limb(5e-3)
    return layer.with_(rig=hinged(layer))


class Person:
    """The limb's sensor."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.sender = bus.node.create_publisher(JointState, "person/joint_states", STREAM)

    def bend(self, angle: float, name: str = "elbow_2") -> None:
        message = JointState(header=header("", self.bus.now()), name=["wrist", name], position=[0.3, angle])
        self.sender.publish(message)


@pytest.fixture(scope="module")
def bus(tmp_path_factory):
    rclpy.init()
    made = Bus("/robot")
    made.folder = tmp_path_factory.mktemp("joints")
    try:
        with running("-c", NODE, "--ros-args", "-r", "__ns:=/robot") as made.partner:
            made.wait(lambda: made.got["skin/topology"], "skin/topology")
            yield made
    finally:
        made.node.destroy_node()
        rclpy.shutdown()


@pytest.fixture(scope="module")
def person(bus) -> Person:
    made = Person(bus)
    bus.wait(made.sender.get_subscription_count, "the node to listen to joints")
    return made


def at_angle(bus: Bus, person: Person, hand, angle: float, pose: np.ndarray = HERE):
    """An answer at this angle."""
    until = time.monotonic() + 60
    while True:
        person.bend(angle)
        bus.spin(0.1)
        answer = hand.ask(pose)
        if list(answer.joints) == [angle]:
            return answer
        assert time.monotonic() < until, f"answers are at {list(answer.joints)}, not at {angle}"


def test_joint_states_bend_the_limb_and_an_answer_says_where_it_was(bus, person):
    hand, deformed = bus.tool("probe").ready(), []
    bus.node.create_subscription(SkinDeformed, "skin/deformed", deformed.append, STREAM)
    at_angle(bus, person, hand, 0.25)
    bus.wait(lambda: deformed, "skin/deformed")
    answer = at_angle(bus, person, hand, 0.5)
    topology = bus.got["skin/topology"][-1]
    layer = layer_from(topology)
    assert answer.layer_id == topology.layer_id == layer_id(layer) and layer.rig is not None
    simulator = Simulator(layer, MomentNet())
    simulator.pose({"elbow": 0.5})
    ours = simulator.step([Contact(ball().named("probe"), HERE)])
    np.testing.assert_allclose(rows(answer), ours.displacement, atol=2e-6)
    bus.wait(lambda: deformed[-1].header.stamp == answer.header.stamp, "its skin")
    moved = np.frombuffer(deformed[-1].vertices, np.float32).reshape(-1, 3)
    np.testing.assert_allclose(moved, posed(layer, (0.5,)).vertices + rows(answer), atol=1e-6)


def test_what_no_joint_can_be_is_refused_and_the_limb_stays(bus, person):
    hand = bus.tool("probe").ready()
    at_angle(bus, person, hand, 0.2)
    for angle, sentence in ((float("nan"), "joint elbow_2 is nan rad; it must be finite"),
                            (60.0, "elbow is 60 rad; it goes from -3.14 to 3.14 rad. Is it in degrees?")):  # fmt: skip
        before = len(bus.said(sentence))
        bus.wait(lambda angle=angle, sentence=sentence, before=before: person.bend(angle) or bus.spin(0.05)
                 or len(bus.said(sentence)) > before, sentence)  # fmt: skip
        assert list(hand.ask(HERE).joints) == [0.2]


def test_joint_states_that_are_all_refused_are_no_silence(bus, person):
    hand = bus.tool("probe").ready()
    at_angle(bus, person, hand, 0.2)
    said = "no joint states that could be used (refused: joint elbow_2 is nan rad; it must be finite"

    def refused():
        person.bend(float("nan"))
        bus.spin(0.1)
        answer = hand.ask(HERE)
        return answer if said in answer.why else None

    answer = bus.wait(refused, said)
    assert not answer.in_range and list(answer.joints) == [0.2]
    assert at_angle(bus, person, hand, 0.2).in_range


def test_a_sensor_that_falls_silent_is_said_and_flagged_and_comes_back(bus, person):
    hand = bus.tool("probe").ready()
    models, heard = bus.got["tools/probe/local_contact"], bus.listen(LocalContact, "tools/probe/local_contact", STREAM)
    assert "joint states" not in at_angle(bus, person, hand, 0.1).why
    bus.spin(1.2)
    answer = hand.ask(HERE)
    bus.wait(lambda: (hand.ask(HERE), models and not models[-1].in_range)[1], "a model that says so, too")
    assert "the limb is taken to be where it was" in answer.why and not answer.in_range
    assert list(answer.joints) == [0.1] and bus.said("the limb is taken to be where it was")
    others = "s (there: wrist, knee; see the parameter joints): the limb is taken"
    bus.wait(lambda: (person.bend(0.3, "knee"), bus.spin(0.1), others in hand.ask(HERE).why)[2], others)
    assert "joint states" not in at_angle(bus, person, hand, 0.15).why
    bus.wait(lambda: (at_angle(bus, person, hand, 0.15), models[-1].in_range)[1], "a model that is trusted again")
    bus.node.destroy_subscription(heard)


def test_without_a_tool_the_skin_follows_its_joints(bus, person):
    bus.still()
    before = len(bus.got["skin/displacement"])
    person.bend(0.3)
    bus.wait(lambda: any(list(one.joints) == [0.3] for one in bus.got["skin/displacement"][before:]), "the skin")


def test_a_recording_of_a_moving_limb_is_repeated_bit_for_bit(bus, person):
    folder = bus.folder / "run"
    recorder = start("-m", "stmpl_ros.cli", "record", "--path", str(folder), "--ros-args", "-r", "__ns:=/robot")
    try:
        bus.wait(lambda: person.sender.get_subscription_count() == 2, "the recorder")
        hand = bus.tool("probe").ready()
        bus.wait(lambda: hand.pose.get_subscription_count() == 2, "the recorder")
        bus.spin(1.0)
        for k, pose in enumerate(SLIDES):
            person.bend(0.03 * k)
            bus.spin(0.05)
            hand.ask(pose)  # waits for its answer, however busy the machine is
            bus.spin(0.1)
        bus.spin(0.5)
    finally:
        code, said = end(recorder, signal.SIGINT)
    assert code == 0, said
    run = Run(folder)
    frames = [frame for frame in run.frames() if frame.touches]
    assert len({frame.joints for frame in frames}) > 3 and any(frame.state for frame in frames)
    summary = replay_run(run, MomentNet())
    assert summary.passed and summary.identical == summary.frames, str(summary)
    pairs = [one for one in replay(run, MomentNet()) if one.frame.touches]
    assert all(np.isfinite(one.answer.displacement).all() for one in pairs)
    assert any("/joint_states" in topic for topic in run.topics)
