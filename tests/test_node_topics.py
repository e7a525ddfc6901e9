"""Laws of the node's topics: poses in other frames, tools that come and go, Gazebo's contacts, what is sent."""

import importlib.util
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, Vector3, WrenchStamped
from geometry_msgs.msg import Wrench as WrenchMessage
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh, MeshTriangle
from stmpl_msgs.msg import ContactMesh, LocalContact, SkinDisplacement
from stmpl_msgs.srv import SetBody

from bags.reader import Bag
from bags.replay import replay_run
from bags.wire import header, layer_from, pose_message, pose_of_tool, stamp_ns, tool_message, wrench_message
from stmpl_core import Tool
from stmpl_core.errors import FrameError, InvalidInput
from stmpl_core.methods import MomentNet
from stmpl_core.touch import BY_POSE, TOUCHING
from stmpl_core.trust import Displacement, Trust
from stmpl_ros.frames import Frames, read_frames
from stmpl_ros.gazebo import GazeboContacts, gazebo_wrench
from stmpl_ros.limits import Limits
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.settings import checked
from stmpl_ros.show import FIELDS, SkinCloud
from stmpl_ros.topics import KEPT, STREAM
from tests.bus import ROOT, rows, running, statuses
from tests.node_bus import HERE, NODE, PUSH, TABLE, TOUCH, Bus, Hand, stamp_of
from tests.scenes import LENGTH, RADIUS, at, ball, limb

# Input


def test_poses_and_wrenches_in_a_listed_frame_count_as_in_the_bodys(bus, hand):
    own = hand.ask(HERE, PUSH)
    turn = TABLE[:3, :3].T
    in_table = np.concatenate([turn @ PUSH[:3], turn @ PUSH[3:]])
    answer = hand.ask(np.linalg.inv(TABLE) @ HERE, in_table, frame="table")
    assert answer.header.frame_id == "body" and statuses(answer) == {"probe": TOUCHING}
    np.testing.assert_allclose(rows(answer), rows(own), atol=1e-7)


@pytest.mark.parametrize(("wrench", "frame", "says"), [
    (PUSH, "sensor", "the wrench of probe is in frame 'sensor'"), (PUSH * np.nan, "body", "finite"),
])  # fmt: skip
def test_an_answer_by_the_pose_alone_is_flagged_while_wrenches_come_that_cannot_be_used(bus, hand, wrench, frame, says):
    assert hand.ask(HERE, PUSH).touches[0].in_range

    def answer(wrench, frame: str):
        hand.wrench.publish(wrench_message(wrench, frame, bus.now()))
        bus.spin(0.05)
        return hand.ask(HERE)

    said = "the wrenches of probe are refused: "
    bus.wait(lambda: said in answer(wrench, frame).why, said)
    flagged = answer(wrench, frame)
    assert says in flagged.why and not flagged.in_range and not flagged.touches[0].in_range
    assert statuses(flagged) == {"probe": BY_POSE}
    sound = hand.ask(HERE, PUSH)
    assert sound.in_range and said not in sound.why and statuses(sound) == {"probe": TOUCHING}


def test_a_recording_of_another_frame_and_of_two_skins_is_replayed_bit_for_bit(bus, tmp_path):
    hand, table = bus.tool("recorded").ready(), np.linalg.inv(TABLE)
    bus.still()
    command = ["record", "--path", str(tmp_path / "run"), "--frames", str(bus.folder / "frames.yaml")]
    with running("-m", "stmpl_ros.cli", *command, "--ros-args", "-r", "__ns:=/robot", number=signal.SIGINT):
        for topic in ("skin/displacement", "skin/topology", "tools/recorded/wrench", "tools/recorded/pose"):
            bus.wait(lambda topic=topic: bus.node.count_subscribers(f"/robot/{topic}") > 1, f"recording {topic}")
        senders = hand.pose, hand.wrench
        bus.wait(lambda: min(one.get_subscription_count() for one in senders) > 1, "the recorder")
        bus.spin(0.3)  # the recorder may still be about to hear of the senders
        for depth in (0.5e-3, 1e-3, 2e-3):
            pose = table @ at(RADIUS + 0.012 - depth, 0, LENGTH / 2)
            last = hand.ask(pose, np.array([0.03, 0, 0, 0, 0, 0]), frame="table")
        layers = len(bus.got["skin/topology"])
        assert bus.call(SetBody, "set_body", youngs_modulus=1.7e3).success
        bus.wait(lambda: bus.got["skin/topology"][layers:], "the other skin")
        of_other = lambda: [one for one in bus.got["skin/displacement"] if one.layer_id != last.layer_id]  # noqa: E731
        again = bus.wait(of_other, "the last instant on the other skin")[0]
        assert statuses(again) in (statuses(last), {}), "{}: it fell silent meanwhile"
        bus.still()  # what fades is of the other skin too
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
                                  "t: 3", "{", "t: {position: [1, 2, .nan]}",
                                  "t: {position: [0, 0, 250]}"])  # fmt: skip
def test_a_file_of_frames_that_cannot_be_read_is_refused(tmp_path, text):
    (tmp_path / "frames.yaml").write_text(text)
    with pytest.raises(InvalidInput, match=r"frames\.yaml"):
        read_frames(str(tmp_path / "frames.yaml"))


def test_a_file_of_frames_does_not_place_the_bodys_own(tmp_path):
    (tmp_path / "frames.yaml").write_text("limb: {position: [0, 0, 0.1]}\n")
    assert read_frames(str(tmp_path / "frames.yaml"), "body")
    with pytest.raises(InvalidInput, match="places 'limb', which is the body's own frame"):
        read_frames(str(tmp_path / "frames.yaml"), "limb")


def test_the_example_of_frames_is_read_and_unknown_frames_stay_unknown():
    frames = Frames("body", read_frames(str(ROOT / "config/frames.yaml")))
    assert frames.at(0)["table"].shape == (4, 4) and "nowhere" not in frames.at(0)
    with pytest.raises(FrameError, match="in frame 'nowhere'"):
        pose_of_tool(pose_message(np.eye(4), "nowhere", 0), "probe", "body", frames.at(0))


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
    sphere = trimesh.creation.icosphere(5, 0.03).apply_scale([1, 1, 1.2])  # no ball: its field takes a while
    bus.mesh.publish(tool_message(Tool("early", sphere.vertices, sphere.faces), bus.now()))
    early = Hand(bus, "early", announce=False)
    early.take_away()
    bus.wait(lambda: bus.said("'early' is taken away"), "the log line")
    bus.tool("later").ready()
    bus.spin(2.0)
    assert not early.pose.get_subscription_count() and not bus.said("tool 'early': ")


def test_a_tool_named_as_the_bodys_frame_is_refused(bus):
    Hand(bus, "body")
    (line,) = bus.wait(lambda: bus.said("mesh of 'body' refused"), "the log line")
    assert "'body' is the body's own frame" in line and "give the tool another name" in line


@pytest.mark.parametrize("name", ["ball-1", "9ball", "a b", "ball/", "/ball", "a//b", "héllo", "{node}", 300 * "x"])
def test_a_tool_whose_name_no_topic_can_have_is_refused_in_one_sentence(bus, name):
    bus.mesh.publish(tool_message(ball().named(name), bus.now()))
    (line,) = bus.wait(lambda: bus.said(f"mesh of '{name[:60]}' refused"), "the log line")
    assert "a tool's name must be a ROS name: letters, digits, _ and /" in line
    assert len(line) < 250 and "\n" not in line and "^" not in line


def test_each_tool_whose_mesh_is_refused_is_told_of_however_soon_they_come(bus):
    for name in ("flat", "broken"):
        bus.mesh.publish(ContactMesh(header=header(name, bus.now()), vertices=[0.0] * 4, triangles=[0, 1, 2]))
    for name in ("flat", "broken"):
        bus.wait(lambda name=name: bus.said(f"mesh of '{name}' refused"), f"the log line of {name}")


def test_poses_of_a_tool_that_nobody_announced_are_told_of_once(bus):
    ghost, until = Hand(bus, "ghost/tip", announce=False), time.monotonic() + 5.0
    bus.wait(lambda: bus.said("no surface of 'ghost/tip'"), "the log line")
    while time.monotonic() < until:
        ghost.press()
        bus.spin(0.05)
    (line,) = bus.said("no surface of 'ghost/tip'")
    assert line.startswith("/robot/tools/ghost/tip/pose has a sender") and "its poses are not heard" in line
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
    config = NodeConfig(gz_contacts=("finger=robot::tip::collision",))
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
        warned = [(s, {v.key: v.value for v in s.values}) for s in found if s.level == DiagnosticStatus.WARN]
        share = "share of the force limit [%]"  # of the push, not of what the test before left on its way
        return [(s, v) for s, v in warned if float(v[share]) == pytest.approx(0.03, rel=0.2)]

    status, values = bus.wait(told, "a warning that has the push's force")[-1]
    assert "not a safety function" in status.message and values["source"] == "this test"
    assert float(values["share of the pressure limit [%]"]) > 80
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
    for text, why in (("regions: [1", "expected ',' or ']'"), ("some words", "no table of limits"), ("", "no table")):
        path.write_text(text)
        with pytest.raises(InvalidInput, match=rf"^limits file .*{why}.* It holds regions: {{PART: ") as told:
            Limits.read(str(path), "left_arm")
        assert "\n" not in str(told.value)
    assert Limits.read("", "left_arm") is None
