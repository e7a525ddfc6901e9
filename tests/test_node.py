"""Laws of the node as a robot team meets it: parameters, services, other frames, outputs, lifecycle, QoS, launch."""

import ast
import importlib.util
import os
import runpy
import signal
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import rclpy
import trimesh
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, PoseStamped, Vector3, WrenchStamped
from geometry_msgs.msg import Wrench as WrenchMessage
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import LivelinessPolicy, QoSProfile
from ruamel.yaml import YAML
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh, MeshTriangle
from std_srvs.srv import Trigger
from stmpl_msgs.msg import ContactMesh, LocalContact, SkinDisplacement, SkinTopology
from stmpl_msgs.srv import Calibrate, SetBody

from bags.reader import Bag
from bags.replay import replay_run
from bags.wire import header, layer_from, pose_message, pose_of_tool, stamp_ns, tool_message, wrench_message
from stmpl_core import Simulator, Tool
from stmpl_core.errors import FrameError, InvalidInput
from stmpl_core.layer import layer_id
from stmpl_core.methods import MomentNet
from stmpl_core.skin import published
from stmpl_core.touch import BY_POSE, MOVED, STALE, TOUCHING
from stmpl_core.toucher import Toucher
from stmpl_core.trust import Displacement, Trust
from stmpl_ros.frames import Frames, read_frames
from stmpl_ros.gazebo import GazeboContacts, gazebo_wrench
from stmpl_ros.limits import Limits
from stmpl_ros.making import restiffened, skin_of
from stmpl_ros.node import SkinNode
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.settings import checked
from stmpl_ros.show import FIELDS, SkinCloud
from stmpl_ros.topics import KEPT, LEASE, STREAM
from tests.bus import PATIENCE, ROOT, Robot, end, rows, running, start, statuses
from tests.conftest import BUSES
from tests.scenes import LENGTH, RADIUS, at, ball, contact_of, limb

TOUCH = RADIUS + 0.012 - 1e-3  # m from the limb's axis: a ball of 12 mm, 1 mm deep
NODE = """
import sys
from stmpl_ros.node import run
from stmpl_ros.parameters import NodeConfig
from tests.test_node import skin
sys.exit(run(NodeConfig(rest_after=0.4, fade=0.6), sys.argv[1:], build=skin))
"""


def skin(config: NodeConfig):
    """A limb of the settings' thickness and stiffness; `thickness` 0.05 m is more than it bears."""
    if config.thickness > 0.04:
        raise InvalidInput("thicker than the limb")
    return limb(4e-3, config.thickness).with_(youngs_modulus=config.youngs_modulus)


class Bus(Robot):
    """A robot's side: a tool that it moves, what it hears, and what it asks."""

    def __init__(self, space: str = "") -> None:
        super().__init__("robot", space)
        self.folder = Path()
        self.mesh = self.node.create_publisher(ContactMesh, "contact_mesh", KEPT)

    def call(self, kind, name: str, **fields):
        """The answer of a service of the node."""
        client = self.node.create_client(kind, f"stmpl/{name}")
        self.wait(client.service_is_ready, name)
        future = client.call_async(kind.Request(**fields))
        self.wait(future.done, f"an answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def set(self, **values) -> list:
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        return self.call(SetParameters, "set_parameters", parameters=parameters).results

    def get(self, *names: str) -> list:
        return [parameter_value_to_python(v) for v in self.call(GetParameters, "get_parameters", names=names).values]

    def tool(self, name: str) -> "Hand":
        return Hand(self, name)


class Hand:
    """A tool on the bus."""

    def __init__(self, bus: Bus, name: str, announce: bool = True) -> None:
        self.bus, self.name = bus, name
        self.pose = bus.node.create_publisher(PoseStamped, f"tools/{name}/pose", STREAM)
        self.wrench = bus.node.create_publisher(WrenchStamped, f"tools/{name}/wrench", STREAM)
        if announce:
            bus.mesh.publish(tool_message(ball().named(name), bus.now()))

    def take_away(self) -> None:
        """Announces a surface without triangles."""
        self.bus.mesh.publish(ContactMesh(header=header(self.name, self.bus.now())))

    def ready(self) -> "Hand":
        self.bus.wait(lambda: self.pose.get_subscription_count() and self.wrench.get_subscription_count(), "the node")
        return self

    def send(self, pose: np.ndarray, wrench: np.ndarray | None = None, frame: str = "body") -> int:
        stamp = self.bus.now()
        if wrench is not None:
            self.wrench.publish(wrench_message(wrench, frame, stamp))
        self.pose.publish(pose_message(pose, frame, stamp))
        return stamp

    def press(self, depth: float = 1e-3) -> int:
        return self.send(at(RADIUS + 0.012 - depth, 0, LENGTH / 2))

    def ask(self, *pose_and_wrench, frame: str = "body") -> SkinDisplacement:
        """Sends one instant and waits for its answer."""
        return self.bus.answer(self.send(*pose_and_wrench, frame=frame))


HERE = at(TOUCH, 0, LENGTH / 2)
PUSH = np.array([-0.03, 0, 0, 0, 0, 0])
TABLE = np.array([[-1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]])  # pose_body_from_table


def stamp_of(stamp_ns: int) -> Time:
    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


@pytest.fixture(scope="module")
def bus(tmp_path_factory):
    """A node on a limb in a namespace, with limits, frames, and a tool that announces itself as shape_msgs/Mesh."""
    folder = tmp_path_factory.mktemp("node")
    (folder / "limits.yaml").write_text("regions:\n  left_arm: {pressure_kpa: 0.05, force_n: 100, source: this test}\n")
    (folder / "frames.yaml").write_text("table: {position: [0, 0, 0.1], orientation: [0, 0, 1, 0]}\n")
    files = [f"{name}:={folder}/{name}.yaml" for name in ("limits", "frames")]
    given = [part for one in (*files, "shape_tools:=shaped") for part in ("-p", one)]
    rclpy.init()
    made = Bus("/robot")
    made.folder = folder
    try:
        with running("-c", NODE, "--ros-args", "-r", "__ns:=/robot", *given):
            made.wait(lambda: made.got["skin/topology"], "skin/topology")
            yield made
    finally:
        made.node.destroy_node()
        rclpy.shutdown()


@pytest.fixture(scope="module")
def hand(bus):
    return bus.tool("probe").ready()


# Parameters


def test_the_yaml_holds_every_parameter_with_its_default():
    read = YAML(typ="safe").load((ROOT / "config/stmpl.yaml").read_text())["/**"]["ros__parameters"]
    assert read == NodeConfig().model_dump(mode="json")
    assert {name: type(value) for name, value in read.items()} == {n: type(v) for n, v in NodeConfig()}


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
    bus.answer(old)
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
    assert not nobody.success and "0 of 0" in nobody.message
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


def test_a_body_that_cannot_be_made_is_told_and_the_one_from_before_goes_on(bus, hand):
    before = hand.ask(HERE, PUSH).layer_id
    lines = len(bus.said("no other skin"))
    assert bus.call(SetBody, "set_body", thickness=0.05).success, "only making it shows that it cannot be"
    bus.wait(lambda: len(bus.said("no other skin")) > lines, "the log line")
    assert "thicker than the limb" in bus.said("no other skin")[-1]
    assert hand.ask(HERE, PUSH).layer_id == before
    assert bus.get("thickness") != [0.05]


# Input


def test_poses_and_wrenches_in_a_listed_frame_count_as_in_the_bodys(bus, hand):
    own = hand.ask(HERE, PUSH)
    turn = TABLE[:3, :3].T
    in_table = np.concatenate([turn @ PUSH[:3], turn @ PUSH[3:]])
    answer = hand.ask(np.linalg.inv(TABLE) @ HERE, in_table, frame="table")
    assert answer.header.frame_id == "body" and statuses(answer) == {"probe": TOUCHING}
    np.testing.assert_allclose(rows(answer), rows(own), atol=1e-7)


def test_a_recording_of_another_frame_and_of_two_skins_is_replayed_bit_for_bit(bus, tmp_path):
    hand, table = bus.tool("recorded").ready(), np.linalg.inv(TABLE)
    bus.still()
    command = ["record", "--path", str(tmp_path / "run"), "--frames", str(bus.folder / "frames.yaml")]
    with running("-m", "stmpl_ros.cli", *command, "--ros-args", "-r", "__ns:=/robot", number=signal.SIGINT):
        for topic in ("skin/displacement", "skin/topology", "tools/recorded/wrench", "tools/recorded/pose"):
            bus.wait(lambda topic=topic: bus.node.count_subscribers(f"/robot/{topic}") > 1, f"recording {topic}")
        for depth in (0.5e-3, 1e-3, 2e-3):
            hand.ask(table @ at(RADIUS + 0.012 - depth, 0, LENGTH / 2), np.array([0.03, 0, 0, 0, 0, 0]), frame="table")
        layers = len(bus.got["skin/topology"])
        assert bus.call(SetBody, "set_body", youngs_modulus=1.7e3).success
        bus.wait(lambda: bus.got["skin/topology"][layers:], "the other skin")
        heard = "/robot/tools/recorded/local_contact"
        assert not bus.node.count_subscribers(heard), "to listen costs the node work"
        bus.listen(LocalContact, "tools/recorded/local_contact", STREAM)
        bus.wait(lambda: bus.node.count_subscribers(heard) == 2, "recording what a device hears")
        hand.ask(table @ HERE, np.array([0.05, 0, 0, 0, 0, 0]), frame="table")
        bus.wait(lambda: bus.got["tools/recorded/local_contact"], "a local contact")
        bus.still()
        bus.spin(0.3)
    bag = Bag(tmp_path / "run")
    before, after = (layer.tissue.youngs_modulus for layer in bag.layers.values())
    assert before != after == 1.7e3
    assert bag.topics[heard].messages >= 1
    summary = replay_run(tmp_path / "run", MomentNet())
    assert summary.identical == summary.frames >= 4, str(summary)


@pytest.mark.parametrize("text", ["[1, 2]", "t: {position: [1, 2]}", "t: {orientation: [0, 0, 0, 2]}", "t: {pos: 1}",
                                  "t: 3", "{", "t: {position: [1, 2, .nan]}"])  # fmt: skip
def test_a_file_of_frames_that_cannot_be_read_is_refused(tmp_path, text):
    (tmp_path / "frames.yaml").write_text(text)
    with pytest.raises(InvalidInput, match=r"frames\.yaml"):
        read_frames(str(tmp_path / "frames.yaml"))


def test_the_example_of_frames_is_read_and_unknown_frames_stay_unknown():
    frames = Frames("body", read_frames(str(ROOT / "config/frames.yaml")))
    assert frames["table"].shape == (4, 4) and "nowhere" not in frames
    with pytest.raises(FrameError, match="in frame 'nowhere'"):
        pose_of_tool(pose_message(np.eye(4), "nowhere", 0), "probe", "body", frames)


def test_a_tool_may_announce_itself_as_a_shape(bus, hand):
    shape, mesh = Mesh(), ball()
    shape.vertices = [Point(x=x, y=y, z=z) for x, y, z in mesh.vertices.tolist()]
    shape.triangles = [MeshTriangle(vertex_indices=np.array(face, np.uint32)) for face in mesh.faces]
    bus.still()
    publisher = bus.node.create_publisher(Mesh, "tools/shaped/mesh", KEPT)
    publisher.publish(shape)
    shaped = Hand(bus, "shaped", announce=False).ready().ask(HERE)
    bus.still()
    assert list(statuses(shaped)) == ["shaped"]
    np.testing.assert_array_equal(rows(shaped), rows(hand.ask(HERE)))


def test_a_tool_is_taken_away_and_the_others_go_on(bus):
    left, right = (bus.tool(name).ready() for name in ("left", "right"))
    bus.listen(WrenchStamped, "tools/left/contact_wrench", STREAM)
    wrenches = bus.got["tools/left/contact_wrench"]
    bus.still()
    there = at(-TOUCH, 0, LENGTH / 2)

    def both() -> SkinDisplacement | None:
        """The answer to an instant of both tools, once the left one's wrench is heard too."""
        stamp = left.send(HERE)
        right.pose.publish(pose_message(there, "body", stamp))
        bus.spin(0.05)
        answers = [answer for answer in bus.answers(stamp) if len(answer.touches) == 2]
        return answers[0] if answers and wrenches else None

    assert statuses(bus.wait(both, "an answer to both")) == {"left": BY_POSE, "right": BY_POSE}
    assert wrenches[-1].wrench.force.x < 0
    left.take_away()

    def gone() -> bool:
        right.send(there)
        bus.spin(0.02)
        return not any(count for count in (left.pose.get_subscription_count(), left.wrench.get_subscription_count(),
                                           bus.node.count_publishers("tools/left/contact_wrench"),
                                           bus.node.count_publishers("tools/left/local_contact")))  # fmt: skip

    bus.wait(gone, "the topics of the tool to close")
    assert wrenches[-1].wrench.force.x == 0, "who listened is told that it exerts nothing any more"
    bus.wait(lambda: bus.said("'left' is taken away"), "the log line")
    alone = right.ask(there)
    assert statuses(alone) == {"right": BY_POSE} and rows(alone).any()
    right.take_away()
    rest = bus.wait(lambda: not (last := bus.got["skin/displacement"][-1]).touches and last, "rest")
    assert not rows(rest).any() and rest.why == "'right' was taken away: back at rest"
    bus.spin(1.0)
    assert bus.got["skin/displacement"][-1] is rest, "rest is said once"

    bus.mesh.publish(tool_message(ball().named("left"), bus.now()))  # it may come back
    assert statuses(left.ready().ask(HERE)) == {"left": BY_POSE}
    left.take_away()
    bus.still()
    bus.spin(2.5)
    assert not bus.said("no surface of 'left'"), "who takes a tool away may go on sending where it is"


def test_a_tool_that_is_taken_away_while_its_field_is_built_is_not_taken_into_use(bus):
    sphere = trimesh.creation.icosphere(5, 0.03)
    bus.mesh.publish(tool_message(Tool("early", sphere.vertices, sphere.faces), bus.now()))
    early = Hand(bus, "early", announce=False)
    early.take_away()
    bus.wait(lambda: bus.said("'early' is taken away"), "the log line")
    bus.tool("later").ready()
    bus.spin(2.0)
    assert not early.pose.get_subscription_count() and not bus.said("tool 'early': ")


def test_poses_of_a_tool_that_nobody_announced_are_told_of_once(bus):
    ghost, until = Hand(bus, "ghost", announce=False), time.monotonic() + 5.0
    bus.wait(lambda: bus.said("no surface of 'ghost'"), "the log line")
    while time.monotonic() < until:
        ghost.press()
        bus.spin(0.05)
    (line,) = bus.said("no surface of 'ghost'")
    assert line.startswith("/robot/tools/ghost/pose: poses come") and "they are not heard" in line
    assert not ghost.pose.get_subscription_count()
    assert not bus.said("no surface of 'probe'"), "a tool that was announced is none"


def xyz(vector) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip("xyz", vector, strict=True)))


def gazebo_contact(first: str, second: str, points, forces_on_engines_first) -> SimpleNamespace:
    """ros_gz_interfaces/Contact as gz-sim fills it, as plain values."""
    wrenches = [SimpleNamespace(body_1_wrench=SimpleNamespace(force=xyz(f))) for f in forces_on_engines_first]
    return SimpleNamespace(collision1=SimpleNamespace(name=first), collision2=SimpleNamespace(name=second),
                           positions=[xyz(point) for point in points], wrenches=wrenches)  # fmt: skip


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("sides", [("robot::tip::collision", "person::arm"), ("person::arm", "robot::tip::collision")])
def test_gazebos_contacts_sum_to_what_the_tool_exerts_on_the_body_in_any_order(order, sides):
    layer, origin = limb(4e-3), np.array([RADIUS + 0.012, 0, LENGTH / 2])
    points = np.array([[RADIUS, 0.002, LENGTH / 2], [RADIUS, -0.001, LENGTH / 2 + 0.003]])
    forces = np.array([[-0.2, 0.01, 0], [-0.3, 0, 0.05]])  # on the body, in its axes
    world_from_body = np.linalg.inv(TABLE)
    there, turned = points @ world_from_body[:3, :3].T + world_from_body[:3, 3], forces @ world_from_body[:3, :3].T
    contacts = [gazebo_contact(sides[0], sides[1], there, order * turned),
                gazebo_contact("robot::tip::collision", "table::top::c", points, forces),
                gazebo_contact("robot::elbow::collision", "person::arm", points, forces)]  # fmt: skip
    wrench = gazebo_wrench(contacts, "tip::collision", "person", TABLE, layer, origin)
    assert wrench is not None
    np.testing.assert_allclose(wrench[:3], forces.sum(axis=0), atol=1e-12)
    np.testing.assert_allclose(wrench[3:], np.cross(points - origin, forces).sum(axis=0), atol=1e-12)
    assert gazebo_wrench(contacts, "robot::thumb", "person", TABLE, layer, origin) is None
    silent = gazebo_contact(sides[0], sides[1], there, [])
    with pytest.raises(InvalidInput, match="0 forces for 2 points"):
        gazebo_wrench([silent], "robot", "person", TABLE, layer, origin)


def test_gazebos_contacts_answer_as_the_wrench_that_they_sum_to(bus, tmp_path):
    gz, std = pytest.importorskip("ros_gz_interfaces.msg"), pytest.importorskip("std_msgs.msg")
    (tmp_path / "frames.yaml").write_text("world: {position: [0, 0, 0.1], orientation: [0, 0, 1, 0]}\n")
    given = ["gz_contacts:=finger=robot::tip", "gz_body:=person", f"frames:={tmp_path}/frames.yaml"]
    robot = Bus("/gazebo")
    with running("-c", NODE, "--ros-args", "-r", "__ns:=/gazebo", *(part for one in given for part in ("-p", one))):
        robot.wait(lambda: robot.got["skin/topology"], "skin/topology")
        hand = robot.tool("finger").ready()
        by_wrench = hand.ask(HERE, PUSH)
        robot.still()
        publisher = robot.node.create_publisher(gz.Contacts, "gz_contacts", STREAM)
        robot.wait(publisher.get_subscription_count, "the node")
        hand.press()  # Gazebo's forces are about the origin of a tool whose pose is known
        stamp, world_from_body = robot.now(), np.linalg.inv(TABLE)
        point = Vector3(**dict(zip("xyz", (world_from_body @ [RADIUS, 0, LENGTH / 2, 1])[:3], strict=True)))
        pushed, pushing = (Vector3(x=sign * PUSH[0]) for sign in (-1, 1))  # the world is turned by half a turn
        forces = gz.JointWrench(body_1_wrench=WrenchMessage(force=pushed), body_2_wrench=WrenchMessage(force=pushing))
        sides = (gz.Entity(name="person::arm::c", type=gz.Entity.COLLISION), gz.Entity(name="robot::tip::c"))
        contact = gz.Contact(collision1=sides[0], collision2=sides[1], positions=[point], wrenches=[forces])
        publisher.publish(gz.Contacts(header=std.Header(stamp=stamp_of(stamp)), contacts=[contact]))
        hand.pose.publish(pose_message(HERE, "body", stamp))
        found = robot.wait(lambda: robot.answers(stamp), "the answer")
        assert statuses(found[0]) == {"finger": TOUCHING} and rows(found[0]).tobytes() == rows(by_wrench).tobytes()
    robot.node.destroy_node()


def test_gazebos_contacts_are_refused_where_their_package_is_not_installed():
    if importlib.util.find_spec("ros_gz_interfaces"):
        pytest.skip("it is installed")
    config = NodeConfig(gz_contacts="finger=robot::tip::collision")
    with pytest.raises(InvalidInput, match="needs the package ros_gz_interfaces"):
        GazeboContacts(config, Frames("body", {}))
    with pytest.raises(InvalidInput, match="is no tool=collision"):
        checked({"gz_contacts": "finger"})


def test_a_device_that_leaves_is_told_of(bus, hand):
    bus.still()
    tool = bus.tool("guest").ready()
    tool.ask(HERE)
    bus.node.destroy_publisher(tool.pose)
    bus.node.destroy_publisher(tool.wrench)
    bus.wait(lambda: bus.said("tools/guest/pose: the sender is gone"), "the log line")
    bus.still()


# Output


def test_the_contact_wrench_is_what_the_pressure_of_the_answer_sums_to(bus, hand):
    ear = bus.listen(WrenchStamped, "tools/probe/contact_wrench", STREAM)
    heard = bus.got["tools/probe/contact_wrench"]

    def both():
        stamp = hand.send(HERE)
        bus.spin(0.05)
        answers = bus.answers(stamp)
        wrenches = [w for w in heard if stamp_ns(w) == stamp]
        return (answers[0], wrenches[0]) if answers and wrenches else None

    answer, wrench = bus.wait(both, "a contact wrench")
    layer = layer_from(bus.got["skin/topology"][-1])
    force = -(np.frombuffer(answer.pressure, np.float32) @ layer.vertex_area_vectors)
    f = wrench.wrench.force
    assert wrench.header.frame_id == "body" and f.x < 0, "the tool pushes the skin inwards"
    np.testing.assert_allclose([f.x, f.y, f.z], force, atol=0.02 * np.linalg.norm(force))
    bus.wait(lambda: heard[-1].wrench.force.x == 0, "nothing presses any more")
    bus.node.destroy_subscription(ear)


def test_a_cloud_holds_the_moved_skin_its_displacement_and_its_pressure():
    layer, rng = limb(8e-3), np.random.default_rng(1)
    move, pressure = rng.normal(0, 1e-3, layer.vertices.shape), rng.uniform(0, 900, len(layer.vertices))
    answer = Displacement(move, Trust(), "any", pressure)
    cloud = SkinCloud(layer, "body").frame(answer, 5)
    values = np.frombuffer(cloud.data, np.float32).reshape(cloud.width, -1)
    assert [f.name for f in cloud.fields] == list(FIELDS) and cloud.row_step == len(cloud.data) == 20 * cloud.width
    np.testing.assert_allclose(values[:, :3], layer.vertices + move, atol=1e-7)
    np.testing.assert_allclose(values[:, 3], 1e3 * answer.magnitude, rtol=1e-5)
    np.testing.assert_allclose(values[:, 4], 1e-3 * pressure, rtol=1e-5)


def test_the_cloud_comes_while_somebody_looks(bus, hand):
    ear = bus.listen(PointCloud2, "skin/points", 1)

    def heard():
        hand.press()
        bus.spin(0.05)
        return bus.got["skin/points"]

    cloud = bus.wait(heard, "skin/points")[-1]
    assert cloud.header.frame_id == "body" and cloud.width == len(layer_from(bus.got["skin/topology"][-1]).vertices)
    bus.node.destroy_subscription(ear)


def test_the_diagnostics_tell_how_much_of_a_limit_is_used(bus, hand):
    ear = bus.listen(DiagnosticArray, "/diagnostics", STREAM)

    def told():
        hand.send(HERE, PUSH)
        bus.spin(0.02)
        found = [s for m in bus.got["/diagnostics"] for s in m.status if s.name == "/robot/stmpl: limits"]
        return [s for s in found if s.level == DiagnosticStatus.WARN]

    status = bus.wait(told, "a warning")[-1]
    values = {v.key: v.value for v in status.values}
    assert "not a safety function" in status.message and values["source"] == "this test"
    assert float(values["share of the pressure limit [%]"]) > 80
    assert float(values["share of the force limit [%]"]) == pytest.approx(0.03, rel=0.2)
    bus.node.destroy_subscription(ear)


def test_every_limit_that_ships_names_its_source_and_covers_every_part():
    from stmpl_core.body import PARTS

    path = str(ROOT / "config/limits.yaml")
    for part in PARTS:
        limits = Limits.read(path, part)
        assert limits and limits.limit.source
    strict = {side: Limits.read(path, side).limit for side in ("left_arm", "left_upper_arm", "left_forearm")}
    for figure in ("pressure_kpa", "force_n"):
        parts = [getattr(strict[part], figure) for part in ("left_upper_arm", "left_forearm")]
        assert getattr(strict["left_arm"], figure) == min(parts)


def test_limits_that_cannot_be_read_are_refused(tmp_path):
    path = tmp_path / "limits.yaml"
    path.write_text("regions: {left_arm: {pressure_kpa: -1, force_n: 3, source: x}}")
    with pytest.raises(InvalidInput, match=r"left_arm.pressure_kpa"):
        Limits.read(str(path), "left_arm")
    with pytest.raises(InvalidInput, match="no region 'head'; it has"):
        Limits.read(str(ROOT / "config/limits.yaml"), "head")
    assert Limits.read("", "left_arm") is None


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
    wait: Callable[[Callable[[], object]], None]


@pytest.fixture
def composed():
    """SkinNode is an ordinary node to whoever composes."""
    context = rclpy.Context()
    context.init(domain_id=int(os.environ["ROS_DOMAIN_ID"]) + BUSES)
    executor = SingleThreadedExecutor(context=context)
    node = SkinNode(NodeConfig(), skin, context=context)
    other = rclpy.create_node("other", context=context)
    heard: list[SkinDisplacement] = []
    other.create_subscription(SkinDisplacement, "skin/displacement", heard.append, STREAM)
    mesh = other.create_publisher(ContactMesh, "contact_mesh", KEPT)
    pose = other.create_publisher(PoseStamped, "tools/finger/pose", STREAM)

    def press() -> int:
        stamp = other.get_clock().now().nanoseconds
        pose.publish(pose_message(HERE, "body", stamp))
        return stamp

    def wait(done: Callable[[], object]) -> None:
        until = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < until
            executor.spin_once(timeout_sec=0.02)

    try:
        executor.add_node(node)
        executor.add_node(other)
        node.trigger_configure()
        node.trigger_activate()
        mesh.publish(tool_message(ball().named("finger"), 0))
        wait(pose.get_subscription_count)
        yield Composed(node, heard, press, wait)
    finally:
        executor.shutdown()
        node.destroy_node()
        other.destroy_node()
        context.try_shutdown()
        context.destroy()


def test_the_node_runs_beside_another_in_any_executor(composed):
    composed.wait(lambda: composed.press() and composed.heard)
    assert rows(composed.heard[-1]).any()


def test_whatever_fails_inside_an_answer_is_told_and_the_next_instant_is_answered(composed, monkeypatch, capfd):
    simulator, failed = composed.node.answering.simulator, []
    step = simulator.step

    def fails_once(contacts):
        if not failed:
            failed.append(contacts[0])
            raise RuntimeError("an accident")
        return step(contacts)

    monkeypatch.setattr(simulator, "step", fails_once)
    composed.wait(lambda: composed.press() and failed)
    refused = round(1e9 * failed[0].time)
    assert composed.node.tally.refused == 1
    assert composed.node.tally.last_refusal == "no answer to finger: an accident"
    composed.wait(lambda: composed.press() and composed.heard)
    assert rows(composed.heard[0]).any() and stamp_ns(composed.heard[0]) > refused
    assert composed.node.tally.refused == 1
    assert capfd.readouterr().err.count("refused: no answer to finger: an accident\n") == 1


def test_two_nodes_on_one_topic_tell_of_each_other_and_of_one_of_their_name():
    twins, command = Bus("/twins"), ("-c", NODE, "--ros-args", "-r", "__ns:=/twins")

    def told(twin: str) -> set[str]:
        where = f"there is another node {twin} on /twins/skin/displacement: listeners get the answers of both"
        return {line.name for line in twins.got["/rosout"] if line.msg.startswith(where) and "__ns:=" in line.msg}

    namesake = None
    try:
        with running(*command):
            twins.wait(lambda: twins.got["skin/topology"], "skin/topology")
            twins.spin(2.5)
            assert not told("that answers") | told("of the same name"), "one alone is no twin"
            with running(*command, "-r", "__node:=other"):
                twins.wait(lambda: told("that answers") == {"twins.stmpl", "twins.other"}, "both log lines")
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
    node.sending.models._on_models(0, [contact_of(before, HERE)], composed.heard[0], failed)
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
            strict.node.destroy_publisher(hand.pose)
            hand.pose = strict.node.create_publisher(PoseStamped, "tools/probe/pose", offering)
            hand.ready().ask(HERE)
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
