"""Laws of the node and the recorder as processes of their own, over the real middleware, on a bus of their own."""

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict

import numpy as np
import pytest

os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from stmpl_msgs.msg import ContactMesh, SkinDeformed, SkinDisplacement, SkinTopology
from visualization_msgs.msg import Marker

from bags.messages import layer_from, layer_id, stamp_ns
from bags.reader import Bag
from stmpl_ros.conversions import mesh_message, pose_message, wrench_message
from stmpl_ros.topics import KEPT, STREAM
from tests.touch_scenes import LENGTH, RADIUS, at, ball

PATIENCE = 60.0  # s to wait for anything; only a failing test waits so long
NODE = """
import sys
from stmpl_ros.node import run
from stmpl_ros.parameters import NodeConfig
from tests.touch_scenes import limb
sys.exit(run(NodeConfig(rest_after=0.4), build=lambda config: limb(4e-3)))
"""
TOUCH = RADIUS + 0.012 - 1e-3  # m from the limb's axis: a ball of 12 mm, 1 mm deep


def start(*arguments: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def end(process: subprocess.Popen, number: int) -> tuple[int, str]:
    """Ends a process by a signal; its exit code and what it said."""
    process.send_signal(number)
    try:
        said, _ = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    return process.returncode, said


class Device:
    """A tool on the bus, and all that comes back."""

    def __init__(self, name: str = "probe") -> None:
        self.name, self.got = name, defaultdict(list)
        self.node = rclpy.create_node(f"device_{name}")
        self.mesh = self.node.create_publisher(ContactMesh, "contact_mesh", KEPT)
        self.pose = self.node.create_publisher(PoseStamped, f"tools/{name}/pose", STREAM)
        self.wrench = self.node.create_publisher(WrenchStamped, f"tools/{name}/wrench", STREAM)
        self.listen(SkinTopology, "skin/topology", KEPT)
        self.listen(SkinDisplacement, "skin/displacement", STREAM)
        self.mesh.publish(mesh_message(name, ball(), self.now()))

    def listen(self, kind, topic, profile):
        return self.node.create_subscription(kind, topic, self.got[topic].append, profile)

    def now(self) -> int:
        return self.node.get_clock().now().nanoseconds

    def wait(self, done, what: str):
        until = time.monotonic() + PATIENCE
        while not (found := done()):
            assert time.monotonic() < until, f"waited {PATIENCE} s for {what}"
            rclpy.spin_once(self.node, timeout_sec=0.02)
        return found

    def spin(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            rclpy.spin_once(self.node, timeout_sec=0.02)

    def send(self, distance: float, force: float, *, pose_frame="body", wrench_frame="body") -> int:
        """Pose and wrench of one instant, pushing towards the limb's axis; returns their stamp [ns]."""
        stamp = self.now()
        push = np.array([-force, 0, 0, 0, 0, 0])
        self.wrench.publish(wrench_message(push, wrench_frame, stamp))
        self.pose.publish(pose_message(at(distance, 0, LENGTH / 2), pose_frame, stamp))
        return stamp

    def answers(self, stamp: int) -> list[SkinDisplacement]:
        return [answer for answer in self.got["skin/displacement"] if stamp_ns(answer) == stamp]

    def ask(self, distance: float, force: float, **frames) -> SkinDisplacement:
        """Sends one instant and waits for its answer."""
        stamp = self.send(distance, force, **frames)
        return self.wait(lambda: self.answers(stamp), f"the answer to {stamp}")[0]


@pytest.fixture(scope="module")
def device():
    """One device, once a node answers on a limb."""
    process = start("-c", NODE)
    rclpy.init()
    made = Device()
    try:
        made.wait(lambda: made.got["skin/topology"], "skin/topology")
        made.wait(lambda: made.pose.get_subscription_count() and made.wrench.get_subscription_count(), "the node")
        yield made
    finally:
        code, said = end(process, signal.SIGTERM)
        made.node.destroy_node()
        rclpy.shutdown()
    assert code == 0, said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_node_on_the_arm_ends_cleanly_when_asked_to(device, number):
    process = start("-m", "stmpl_ros.cli", "node", "--edge-length", "0.008", "--ros-args", "-r", "__ns:=/arm")
    try:
        heard = []
        device.node.create_subscription(SkinTopology, "/arm/skin/topology", heard.append, KEPT)
        device.wait(lambda: heard, "/arm/skin/topology")
    finally:
        code, said = end(process, number)
    assert code == 0, said


def rows(answer: SkinDisplacement) -> np.ndarray:
    return np.frombuffer(answer.displacement, np.float32).reshape(-1, 3)


def test_a_contact_is_answered_where_it_is_with_its_stamp_frame_and_layer(device):
    answer = device.ask(TOUCH, 0.03)
    topology = device.got["skin/topology"][0]
    layer = layer_from(topology)
    assert answer.header.frame_id == topology.header.frame_id == "body"
    assert answer.layer_id == topology.layer_id == layer_id(layer)
    assert list(answer.tools) == ["probe"] and list(answer.statuses) == ["touching"]
    moved = np.linalg.norm(rows(answer), axis=1)
    deepest = layer.vertices[moved.argmax()]
    assert 1e-4 < moved.max() < 7.5e-3
    assert np.linalg.norm(deepest - [RADIUS, 0, LENGTH / 2]) < 5e-3
    assert rows(answer)[moved.argmax(), 0] < 0, "pressed skin moves inwards"


def test_the_pressure_of_an_answer_carries_the_force(device):
    answer = device.ask(TOUCH, 0.03)
    layer = layer_from(device.got["skin/topology"][0])
    total = -(np.frombuffer(answer.pressure, np.float32) @ layer.vertex_area_vectors)
    np.testing.assert_allclose(total, [-0.03, 0, 0], atol=1e-3 * 0.03 + 3e-4)


def test_zero_wrench_gives_exactly_zero(device):
    answer = device.ask(TOUCH, 0.0)
    assert not rows(answer).any() and not np.frombuffer(answer.pressure, np.float32).any()
    assert list(answer.statuses) == ["no force"]


def test_a_wrench_in_the_tools_axes_counts_as_the_same_wrench(device):
    np.testing.assert_array_equal(rows(device.ask(TOUCH, 0.02)), rows(device.ask(TOUCH, 0.02, wrench_frame="probe")))


@pytest.mark.parametrize(
    ("distance", "frame"), [(float("nan"), "body"), (TOUCH, "map"), (TOUCH, ""), (TOUCH * 1e3, "body")]
)
def test_a_message_that_cannot_be_used_gets_no_answer_and_the_node_stays_up(device, distance, frame):
    bad = device.send(distance, 0.02, pose_frame=frame)
    good = device.ask(TOUCH, 0.02)
    assert not device.answers(bad)
    assert rows(good).any() and np.isfinite(rows(good)).all()


def test_refusals_are_counted_and_told_in_the_diagnostics(device):
    device.listen(DiagnosticArray, "/diagnostics", STREAM)
    device.send(TOUCH, 0.02, pose_frame="map")

    def told():
        values = [{v.key: v.value for v in m.status[0].values} for m in device.got["/diagnostics"]]
        return [v for v in values if "'map'" in v["last refusal"] and int(v["refused"]) > 0]

    device.wait(told, "diagnostics that tell of the refusal")


def test_each_instant_is_answered_once_and_in_order(device):
    device.ask(TOUCH, 0.02)
    before = len(device.got["skin/displacement"])
    stamps = [stamp_ns(device.ask(TOUCH, 0.001 * k)) for k in range(1, 31)]
    answers = device.got["skin/displacement"][before:]
    assert [stamp_ns(answer) for answer in answers] == stamps
    assert np.all(np.diff([answer.sequence for answer in answers]) == 1)


def test_an_older_stamp_than_the_last_gets_no_answer(device):
    last = device.ask(TOUCH, 0.02)
    old = stamp_ns(last) - 10_000_000
    device.wrench.publish(wrench_message(np.zeros(6), "body", old))
    device.pose.publish(pose_message(at(TOUCH, 0, LENGTH / 2), "body", old))
    device.ask(TOUCH, 0.02)
    assert not device.answers(old)


def test_when_the_input_stops_the_skin_goes_to_rest_and_says_why(device):
    device.ask(TOUCH, 0.03)
    before = len(device.got["skin/displacement"])
    device.wait(lambda: len(device.got["skin/displacement"]) > before, "the answer at rest")
    rest = device.got["skin/displacement"][-1]
    assert not rows(rest).any() and "back at rest" in rest.why and not rest.tools
    device.spin(0.6)
    assert len(device.got["skin/displacement"]) == before + 1, "rest is said once"


def test_deformed_skin_is_rest_plus_displacement_and_sent_only_to_listeners(device):
    layer = layer_from(device.got["skin/topology"][0])
    ears = [device.listen(SkinDeformed, "skin/deformed", STREAM), device.listen(Marker, "skin/marker", 1)]

    def heard():
        device.send(TOUCH, 0.03)
        device.spin(0.05)
        return device.got["skin/deformed"] and device.got["skin/marker"]

    device.wait(heard, "skin/deformed and skin/marker")
    deformed = device.got["skin/deformed"][-1]
    answer = device.wait(lambda: device.answers(stamp_ns(deformed)), "its answer")[0]
    expected = layer.vertices + rows(answer)
    np.testing.assert_allclose(np.frombuffer(deformed.vertices, np.float32).reshape(-1, 3), expected, atol=1e-7)
    assert len(device.got["skin/marker"][-1].points) == 3 * len(layer.faces)
    for ear in ears:
        device.node.destroy_subscription(ear)


def test_every_message_of_a_run_is_recorded(device, tmp_path):
    recorder = start("-m", "stmpl_ros.cli", "record", "--path", str(tmp_path / "run"))
    try:
        streams = (device.pose, device.wrench)
        device.wait(lambda: all(s.get_subscription_count() == 2 for s in streams), "the recorder")
        device.wait(lambda: device.node.count_subscribers("skin/displacement") == 2, "the recorder")
        device.spin(0.5)
        stamps = [stamp_ns(device.ask(TOUCH, 0.001 * k)) for k in range(50)]
    finally:
        code, said = end(recorder, signal.SIGINT)
    assert code == 0, said
    bag = Bag(tmp_path / "run")
    assert bag.finished and not bag.damage
    assert bag.topics["/tools/probe/pose"].messages == bag.topics["/tools/probe/wrench"].messages == 50
    assert [frame.stamp_ns for frame in bag.frames() if frame.tools] == stamps
    assert bag.layer_id == device.got["skin/topology"][0].layer_id
