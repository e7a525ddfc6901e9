"""Laws of the node and the recorder as processes of their own, over the real middleware, on a bus of their own."""

import re
import signal

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from stmpl_msgs.msg import ContactMesh, LocalContact, SkinDeformed, SkinDisplacement, SkinTopology
from visualization_msgs.msg import Marker

from bags.frame import Frame
from bags.reader import Bag
from bags.replay import replay_run
from bags.wire import layer_from, local_contact_from, pose_message, stamp_ns, tool_from, tool_message, wrench_message
from stmpl_core import Tool
from stmpl_core.haptics import DeviceLoop
from stmpl_core.layer import layer_id
from stmpl_core.local_contact import local_contact
from stmpl_core.methods import MomentNet
from stmpl_core.touch import BY_POSE, IN_CORE, NO_FORCE, NO_TOUCH, PULLING, STALE, TOUCHING
from stmpl_core.toucher import Toucher
from stmpl_ros.topics import KEPT, STREAM
from tests.bus import Robot, end, rows, start, statuses
from tests.scenes import LENGTH, RADIUS, at, ball, contact_of, scaled

NODE = """
import sys
from stmpl_ros.node import run
from stmpl_ros.parameters import NodeConfig
from tests.scenes import limb
sys.exit(run(NodeConfig(rest_after=0.4, fade=0.6), build=lambda config: limb(4e-3)))
"""
TOUCH = RADIUS + 0.012 - 1e-3  # m from the limb's axis: a ball of 12 mm, 1 mm deep


class Device(Robot):
    """A tool on the bus, and all that comes back."""

    def __init__(self, name: str = "probe", tool: Tool | None = None) -> None:
        super().__init__(f"device_{name}")
        self.name = name
        self.mesh = self.node.create_publisher(ContactMesh, "contact_mesh", KEPT)
        self.pose = self.node.create_publisher(PoseStamped, f"tools/{name}/pose", STREAM)
        self.wrench = self.node.create_publisher(WrenchStamped, f"tools/{name}/wrench", STREAM)
        self.sent = 0
        self.mesh.publish(tool_message((tool or ball()).named(name), self.now()))

    def send(self, distance: float, force: float, *, pose_frame="body", wrench_frame="body") -> int:
        """Pose and wrench of one instant, pushing towards the limb's axis; returns their stamp [ns]."""
        stamp = self.now()
        push = np.array([-force, 0, 0, 0, 0, 0])
        self.wrench.publish(wrench_message(push, wrench_frame, stamp))
        self.pose.publish(pose_message(at(distance, 0, LENGTH / 2), pose_frame, stamp))
        self.sent += 1
        return stamp

    def ask(self, distance: float, force: float, **frames) -> SkinDisplacement:
        """Sends one instant and waits for its answer."""
        return self.answer(lambda: self.send(distance, force, **frames))


@pytest.fixture(scope="module")
def device():
    """One device, once a node answers on a limb."""
    process = start("-c", NODE)
    rclpy.init()
    made = Device()
    made.partner = process
    try:
        made.wait(lambda: made.got["skin/topology"], "skin/topology")
        made.wait(lambda: made.pose.get_subscription_count() and made.wrench.get_subscription_count(), "the node")
        yield made
    finally:
        code, said = end(process, signal.SIGTERM)
        made.node.destroy_node()
        rclpy.shutdown()
    assert code == 0, said


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_node_on_the_arm_ends_cleanly_when_asked_to(device, number):
    process = start("-m", "stmpl_ros.cli", "node", "--edge-length", "0.008", "--ros-args", "-r", "__ns:=/arm")
    try:
        heard = []
        device.node.create_subscription(SkinTopology, "/arm/skin/topology", heard.append, KEPT)
        device.wait(lambda: heard or process.poll() is not None, "/arm/skin/topology")
    finally:
        code, said = end(process, number)
    assert heard and code == 0, said


def test_a_contact_is_answered_where_it_is_with_its_stamp_frame_and_layer(device):
    answer = device.ask(TOUCH, 0.03)
    topology = device.got["skin/topology"][0]
    layer = layer_from(topology)
    assert answer.header.frame_id == topology.header.frame_id == "body"
    assert answer.layer_id == topology.layer_id == layer_id(layer)
    assert statuses(answer) == {"probe": "touching"}
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
    assert statuses(answer) == {"probe": "no force"}


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


def test_when_the_input_stops_the_last_answer_fades_to_rest_says_why_and_comes_back(device):
    last = device.ask(TOUCH, 0.03)
    before = len(device.got["skin/displacement"])
    device.wait(lambda: not device.got["skin/displacement"][-1].touches, "the answer at rest")
    *fading, rest = device.got["skin/displacement"][before:]
    assert not rows(rest).any() and "back at rest" in rest.why and rest.fade == 1
    shares = np.array([answer.fade for answer in fading])
    assert len(shares) > 3 and (np.diff(shares) < 0).all() and 0 < shares[-1] < 0.3 < 0.7 < shares[0] <= 1
    for answer in fading:
        assert statuses(answer) == {"probe": STALE} and not answer.in_range
        assert "no pose for 0.4 s" in answer.why and answer.touches[0].pose_stamp == last.touches[0].pose_stamp
        np.testing.assert_allclose(rows(answer), answer.fade * rows(last), rtol=1e-6, atol=1e-12)
    assert len(device.said("fades to rest within 0.6 s")) >= 1
    device.spin(0.6)
    assert device.got["skin/displacement"][-1] is rest, "rest is said once"
    np.testing.assert_array_equal(rows(device.ask(TOUCH, 0.03)), rows(last))


def test_while_only_unusable_input_comes_the_fading_answers_tell_of_it(device):
    device.ask(TOUCH, 0.03)
    before, lines, sent = len(device.got["skin/displacement"]), len(device.said("refused: pose of probe holds")), []

    def told():
        sent.append(device.send(float("nan"), 0.02))
        later = device.got["skin/displacement"][before:]
        return [answer for answer in later if STALE in statuses(answer).values() and "finite" in answer.why]

    device.wait(told, "a stale answer that tells of the refusals")
    device.wait(lambda: len(device.said("refused: pose of probe holds")) > lines, "the log line")
    assert len(device.said("refused: pose of probe holds")) - lines < len(sent) / 2, "one line of a kind in a second"
    assert statuses(device.ask(TOUCH, 0.02)) == {"probe": TOUCHING}


@pytest.mark.parametrize(
    ("distance", "force", "status", "says"),
    [
        (TOUCH, -0.02, PULLING, "nothing sticks"),
        (TOUCH + 0.02, 0.02, NO_TOUCH, "no skin is within reach"),
        (TOUCH, 0.0, NO_FORCE, "wrench is zero"),
    ],
)
def test_what_is_wrong_with_a_contact_is_its_status_and_one_line(device, distance, force, status, says):
    before = len(device.said(says))
    for _ in range(5):
        assert statuses(device.ask(distance, force)) == {"probe": status}
    device.wait(lambda: len(device.said(says)) > before, "the log line")
    assert len(device.said(says)) <= before + 2, "five answers within a second or two are one or two lines"


@pytest.fixture
def another(device):
    """Makes more tools, without a force sensor: `another(name, tool)`."""
    made = []

    def make(name: str, tool: Tool) -> Device:
        device.still()
        made.append(Device(name, tool))
        return made[-1]

    yield make
    for one in made:
        one.still()
        one.node.destroy_node()


def posed(tool: Device, distance: float) -> SkinDisplacement:
    """The first answer to a pose without a wrench, sent anew until the node's side has found the tool's."""
    tool.wait(lambda: tool.pose.get_subscription_count(), "the node")

    def send() -> int:
        stamp = tool.now()
        tool.pose.publish(pose_message(at(distance, 0, LENGTH / 2), "body", stamp))
        return stamp

    return tool.answer(send)


def test_a_tool_that_starts_inside_the_core_is_told_of(device, another):
    tool = another("finger", ball())
    answer = posed(tool, TOUCH - 8e-3)
    assert statuses(answer) == {"finger": IN_CORE} and not answer.in_range
    assert re.search(r"finger starts [78]\.\d mm inside the skin", answer.why)
    device.wait(lambda: device.said("mm inside the skin") and device.said(f"finger: {IN_CORE}"), "the log lines")


def test_a_mesh_that_is_inside_out_is_turned_and_told_of(device, another):
    good = ball()
    right = posed(another("right", good), TOUCH)
    wrong = posed(another("wrong", Tool("wrong", good.vertices, good.faces[:, ::-1])), TOUCH)
    assert (statuses(right), statuses(wrong)) == ({"right": BY_POSE}, {"wrong": BY_POSE}) and rows(right).any()
    np.testing.assert_array_equal(rows(wrong), rows(right))
    device.wait(lambda: device.said("'wrong' came inside out"), "the log line")


def test_a_mesh_with_a_hole_is_told_of(device, another):
    whole = ball()
    answer = posed(another("open", Tool("open", whole.vertices, whole.faces[:-4])), TOUCH)
    assert "holes" in answer.why
    device.wait(lambda: device.said("'open' has holes"), "the log line")


@pytest.mark.parametrize(
    ("name", "scale", "says"),
    [("mm", 1e3, "millimetres"), ("no tool!", 1.0, "must be a ROS name"), ("dust", 1e-3, "metres")]
)
def test_a_mesh_that_cannot_be_used_is_refused_and_the_node_stays_up(device, name, scale, says):
    device.spin(1.1)  # one line of a kind in a second
    device.mesh.publish(tool_message(scaled(ball(), scale).named(name), device.now()))
    device.wait(lambda: [line for line in device.said(f"'{name}' refused") if says in line], "the refusal")
    assert statuses(device.ask(TOUCH, 0.02)) == {"probe": TOUCHING}


def test_while_the_mesh_of_a_tool_is_being_prepared_others_are_answered(device, another):
    import trimesh

    sphere = trimesh.creation.icosphere(6, 0.03).apply_scale([1, 1, 1.2])  # 82,000 triangles of what is no ball
    big, before = another("big", Tool("big", sphere.vertices, sphere.faces)), len(device.got["skin/displacement"])

    def ready():
        device.send(TOUCH, 0.02)
        device.spin(0.02)
        return big.pose.get_subscription_count()

    device.wait(ready, "the node to listen to the new tool")
    meanwhile = device.got["skin/displacement"][before:]
    assert sum(statuses(answer) == {"probe": TOUCHING} for answer in meanwhile) >= 10


def test_a_local_contact_says_what_the_answer_says_and_how_it_changes(device):
    heard: list[LocalContact] = []
    ear = device.node.create_subscription(LocalContact, "tools/probe/local_contact", heard.append, STREAM)

    def models():
        stamp = device.send(TOUCH, 0.03)
        device.spin(0.02)
        asked.append(stamp)
        return [model for model in heard if stamp_ns(model) in asked and device.answers(stamp_ns(model))]

    asked: list[int] = []
    message = device.wait(models, "a local contact")[-1]
    device.node.destroy_subscription(ear)
    answer = device.answers(stamp_ns(message))[0]
    layer = layer_from(device.got["skin/topology"][0])
    model = local_contact_from(message)
    assert (message.name, message.status, message.header.frame_id) == ("probe", TOUCHING, "body")
    force = -(np.frombuffer(answer.pressure, np.float32) @ layer.vertex_area_vectors)
    np.testing.assert_allclose(model.wrench[:3], force, atol=0.01 * np.linalg.norm(force))
    assert model.power > 1 and model.grip is None

    # the node's is the model that anybody finds there; by wrench the last bit of the way was reckoned
    own = local_contact(Toucher(layer), contact_of(ball_as_sent(), model.pose_body_from_tool))
    np.testing.assert_allclose(model.wrench, own.wrench, atol=2e-3 * np.linalg.norm(own.wrench[:3]))
    np.testing.assert_allclose(model.stiffness, own.stiffness, atol=0.05 * np.abs(own.stiffness).max())
    assert model.valid_m == pytest.approx(own.valid_m, rel=0.05) and model.valid_rad > 0
    assert model.normal @ model.stiffness[:3, :3] @ model.normal > 0

    # a device renders it
    loop, place = DeviceLoop(), model.pose_body_from_tool[:3, 3]
    loop.update(model)
    felt = [loop.step(place + 2e-4 * model.normal, np.zeros(3), 1e-3).copy() for _ in range(60)][-1]
    assert felt @ model.normal < -0.5 * np.linalg.norm(model.wrench[:3])


def ball_as_sent() -> Tool:
    return tool_from(tool_message(ball(), 0))


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


def stale(frame: Frame) -> bool:
    return any(touch.status == STALE for touch in frame.touches.values())


def test_every_message_of_a_run_is_recorded(device, tmp_path):
    recorder = start("-m", "stmpl_ros.cli", "record", "--path", str(tmp_path / "run"))
    try:
        streams = (device.pose, device.wrench)
        device.wait(lambda: all(s.get_subscription_count() == 2 for s in streams), "the recorder")
        device.wait(lambda: device.node.count_subscribers("skin/displacement") == 2, "the recorder")
        device.spin(0.5)
        before = device.sent
        stamps = [stamp_ns(device.ask(TOUCH, 0.001 * k)) for k in range(50)]
        sent = device.sent - before  # more than 50 where the node, busy, took none of an instant
        device.wait(lambda: not device.got["skin/displacement"][-1].touches, "the answer at rest")
        device.spin(0.5)
    finally:
        code, said = end(recorder, signal.SIGINT)
    assert code == 0, said
    bag = Bag(tmp_path / "run")
    assert bag.finished and not bag.damage
    assert bag.topics["/tools/probe/pose"].messages == bag.topics["/tools/probe/wrench"].messages == sent >= 50
    fresh = [frame for frame in bag.frames() if frame.touches and not stale(frame)]
    assert [frame.stamp_ns for frame in fresh if frame.stamp_ns in stamps] == stamps
    replayed = replay_run(tmp_path / "run", MomentNet())
    assert replayed.frames > len(fresh) + 3, "while the last answer faded, answers went on"
    assert replayed.identical == replayed.frames, str(replayed)
    assert bag.layer_id == device.got["skin/topology"][0].layer_id
