"""Soft skin for a simulator over ROS: real messages over DDS, and the motion of one process."""

import importlib
import importlib.util
import json
import signal
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry

from bags.wire import header, pose_message, stamp_ns
from stmpl_core.errors import InvalidInput
from stmpl_core.tool import Tool
from stmpl_ros.links import RosWorld, moved_to, points_of, run, tools_of, topic_of
from stmpl_ros.parameters import LinksConfig
from stmpl_ros.topics import STREAM
from stmpl_sim import Poses, Reaction
from tests.bus import Robot, running
from tests.scenes import plate

mujoco = pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
ADAPTER = """
import json, sys
from stmpl_ros.links import run
from stmpl_ros.parameters import LinksConfig
from stmpl_core import Tool
from tests.scenes import plate
import trimesh
config = LinksConfig(body="slab", tools=("bob=-",), about=("slab=0,0,-0.009",), **json.loads(sys.argv[1]))
skin, mesh = plate(0.06, youngs_modulus=20e3), trimesh.creation.icosphere(4, 0.012)
tools = [Tool("bob", mesh.vertices, mesh.faces)]
sys.exit(run(config, sys.argv[2:], build=lambda settings: skin, tools=tools))
"""
MODEL = """
<mujoco><option timestep="1e-3" gravity="0 0 -9.81"/><worldbody>
  <body name="slab"><joint type="slide" axis="0 0 1" stiffness="3000" damping="20"/>
    <geom type="box" size=".03 .03 .001" pos="0 0 -.009" mass="1"/></body>
  <body name="bob" pos="0.004 -.003 .0118"><freejoint/><geom name="ball" type="sphere" size=".012" mass=".3"/></body>
</worldbody><contact><exclude body1="slab" body2="bob"/></contact></mujoco>
"""
STEPS = 120
GAZEBO = {"wrench_type": "entity", "wrenches": "/world/lab/wrench"}


class Simulator(Robot):
    """A simulator that says where its links are, and waits for the wrenches of that instant."""

    def __init__(self, space: str, pose_type: str = "pose", wrench_type: str = "wrench", axes: str = "world",
                 **_: Any) -> None:  # fmt: skip
        super().__init__("simulator", space)
        self.axes, self.wrenches = axes, {}
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.data = mujoco.MjData(self.model)
        self.kind = {"pose": PoseStamped, "odometry": Odometry}[pose_type]
        self.poses = {n: self.node.create_publisher(self.kind, f"links/{n}/pose", STREAM) for n in ("slab", "bob")}
        if wrench_type == "entity":
            kind = importlib.import_module("ros_gz_interfaces.msg").EntityWrench
            self.node.create_subscription(kind, "/world/lab/wrench", lambda m: self.keep(m.entity.name, m), STREAM)
        else:
            for name in self.poses:
                self.node.create_subscription(WrenchStamped, f"links/{name}/wrench",
                                              lambda m, name=name: self.keep(name, m), STREAM)  # fmt: skip

    def keep(self, name: str, message: Any) -> None:
        self.wrenches[name, stamp_ns(message)] = message

    def pose(self, name: str) -> np.ndarray:
        out, body = np.eye(4), self.data.body(name)
        out[:3, :3], out[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return out

    def step(self, number: int) -> None:
        stamp = 1_000_000_000 + number * 1_000_000
        mujoco.mj_step1(self.model, self.data)
        for name, publisher in self.poses.items():
            message = pose_message(self.pose(name), "lab", stamp)
            if self.kind is Odometry:
                wrapped = Odometry(header=header("lab", stamp), child_frame_id=name)
                wrapped.pose.pose = message.pose
                message = wrapped
            publisher.publish(message)
        self.wait(lambda: all((name, stamp) in self.wrenches for name in self.poses), f"the wrenches of step {number}")
        for name in self.poses:
            message = self.wrenches[name, stamp]
            f, t = message.wrench.force, message.wrench.torque
            wrench = np.array([[f.x, f.y, f.z], [t.x, t.y, t.z]])
            if self.axes == "link":
                assert message.header.frame_id == name
                wrench = wrench @ self.pose(name)[:3, :3].T
            else:
                assert message.header.frame_id == "lab"
            self.data.body(name).xfrc_applied[:] = wrench.ravel()
        mujoco.mj_step2(self.model, self.data)


@cache
def in_one_process(relaxing: bool) -> np.ndarray:
    """Configurations of the same scene in one process, a row a step."""
    from stmpl_core.living import held_skin
    from stmpl_core.methods import MomentNet
    from stmpl_sim import SoftBody

    model = mujoco.MjModel.from_xml_string(MODEL)
    data, layer = mujoco.MjData(model), plate(0.06, youngs_modulus=20e3)
    skin = SoftBody(model, held_skin(layer) if relaxing else layer, body="slab", tools=["ball"], method=MomentNet())
    rows = []
    for _ in range(STEPS):
        mujoco.mj_step1(model, data)
        skin.apply(data)
        mujoco.mj_step2(model, data)
        rows.append(data.qpos.copy())
    return np.array(rows)


@pytest.fixture(scope="module")
def context() -> Any:
    import rclpy

    rclpy.init()
    yield
    rclpy.shutdown()


@pytest.mark.parametrize("settings", [{}, {"pose_type": "odometry", "axes": "link"}, {"relaxing": True}, GAZEBO],
                         ids=["poses", "odometry-link-axes", "relaxing", "gazebo"])  # fmt: skip
def test_a_simulator_over_ros_moves_as_one_in_the_same_process(context, settings) -> None:
    if settings is GAZEBO:
        pytest.importorskip("ros_gz_interfaces.msg")
    space = f"/links_{len(settings)}_{settings.get('axes', 'world')}"
    simulator, rows = Simulator(space, **settings), []
    with running("-c", ADAPTER, json.dumps(settings), "--ros-args", "-r", f"__ns:={space}") as adapter:
        simulator.partner = adapter
        simulator.wait(lambda: all(one.get_subscription_count() for one in simulator.poses.values()), "the adapter")
        for number in range(STEPS):
            simulator.step(number)
            rows.append(simulator.data.qpos.copy())
        last = max(stamp for _, stamp in simulator.wrenches)
        pressed = simulator.wrenches["bob", last]
        simulator.wait(lambda: simulator.wrenches["bob", last] is not pressed, "that nothing pushes, after silence")
        assert not simulator.wrenches["bob", last].wrench.force.z
    simulator.node.destroy_node()
    alone = in_one_process("relaxing" in settings)
    assert pressed.wrench.force.z != 0 and abs(alone[-1][0]) > 1e-3  # it pressed, and the slab gave way
    np.testing.assert_allclose(rows, alone, atol=1e-9)
    assert np.abs(in_one_process(True) - in_one_process(False)).max() > 1e-6


def test_an_instant_is_whole_once_all_that_moves_has_one_stamp() -> None:
    sent: list[tuple[str, int]] = []
    world = RosWorld("arm", ["left", "right"], lambda name, wrench, pose, stamp: sent.append((name, stamp)))
    pose = np.eye(4)
    assert [world.put(name, pose, 1) for name in ("arm", "left", "right")] == [False, False, True]
    assert [world.put(name, pose, 2) for name in ("left", "right")] == [False, False]  # does the arm move?
    assert [world.put(name, pose, 3) for name in ("left", "right")] == [False, True]  # it stands still
    assert not world.put("left", pose, 4)
    assert world.put("right", pose, 4)
    assert not world.put("right", pose, 4)  # said again
    assert list(world.poses().tools) == ["left", "right"]
    nothing = np.zeros(6)
    world.push(Reaction({"left": nothing, "right": nothing}, nothing, {}, None))  # type: ignore[arg-type]
    assert sent == [("left", 4), ("right", 4), ("arm", 4)]
    assert isinstance(world.poses(), Poses)


def test_a_simulator_that_begins_anew_keeps_what_stands_still() -> None:
    sent: list[int] = []
    world = RosWorld("arm", ["tip"], lambda name, wrench, pose, stamp: sent.append(stamp))
    there, pose, nothing = np.eye(4), np.eye(4), np.zeros(6)
    there[:3, 3] = 1.0
    assert [world.put("arm", there, 900)] + [world.put("tip", pose, stamp) for stamp in (7, 8, 9)] == [
        False, True, False, True]  # fmt: skip
    world.push(Reaction({"tip": nothing}, nothing, {}, None))  # type: ignore[arg-type]
    assert sent == [9, 9], "the stamp of the instant, not that of what stands still"
    assert [world.put("tip", pose, stamp) for stamp in (3, 4, 5)] == [True, False, True]
    np.testing.assert_array_equal(world.poses().body, there)
    assert not world.put("arm", pose, 4), "a link that moves late is no reset"
    assert world.links["tip"].stamp == 5


def test_what_keeps_an_instant_from_being_whole_is_said() -> None:
    world = RosWorld("arm", ["tip"], lambda *_: None)
    world.put("tip", np.eye(4), 1_000_000_000)
    assert world.lacks() == "poses come, but none of arm: no wrench is sent"
    world.put("arm", np.eye(4), 1_500_000_000)
    assert "not with one stamp" in world.lacks() and "tip 1.000000 s, arm 1.500000 s" in world.lacks()


def test_who_ends_the_adapter_lets_go(context) -> None:
    simulator = Simulator("/links_end")
    with running("-c", ADAPTER, json.dumps({"silence": 600.0}), "--ros-args", "-r", "__ns:=/links_end",
                 number=signal.SIGINT) as adapter:  # fmt: skip
        simulator.partner = adapter
        simulator.wait(lambda: all(one.get_subscription_count() for one in simulator.poses.values()), "the adapter")
        for number in range(5):
            simulator.step(number)
        last = max(stamp for _, stamp in simulator.wrenches)
        pressed = simulator.wrenches["bob", last]
        assert pressed.wrench.force.z > 0
    simulator.partner = None
    simulator.wait(lambda: simulator.wrenches["bob", last] is not pressed, "that nothing pushes")
    assert not simulator.wrenches["bob", last].wrench.force.z and not simulator.wrenches["slab", last].wrench.force.z
    simulator.node.destroy_node()


def test_a_wrench_about_another_point_does_the_same_work() -> None:
    random = np.random.default_rng(0)
    wrench, shift, twist = random.normal(size=6), random.normal(size=3), random.normal(size=6)
    there = np.concatenate([twist[:3] + np.cross(twist[3:], shift), twist[3:]])  # velocity of the other point
    assert moved_to(wrench, shift) @ there == pytest.approx(wrench @ twist)


def test_what_cannot_be_is_one_sentence(tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.icosphere(2, 0.012).export(tmp_path / "tip.stl")
    (tip,) = tools_of([f"hand::tip={tmp_path / 'tip.stl'}"])
    assert tip.name == "hand::tip" and np.ptp(tip.vertices[:, 0]) == pytest.approx(0.024, rel=1e-3)
    assert topic_of("links/{link}/pose", "hand::tip") == "links/hand/tip/pose"
    with pytest.raises(InvalidInput, match=r"does not say where the link's name goes"):
        topic_of("/pose", "tip")
    with pytest.raises(InvalidInput, match=r"'tip' is no link=file"):
        tools_of(["tip"])
    (tmp_path / "tip.md").write_text("# no mesh")
    with pytest.raises(InvalidInput, match=r"tip.md' is no mesh: .* Try STL, OBJ"):
        tools_of([f"tip={tmp_path / 'tip.md'}"])
    (tmp_path / "none.stl").write_text("solid none\nendsolid none\n")
    with pytest.raises(InvalidInput, match=r"none.stl' is no mesh: "):
        tools_of([f"tip={tmp_path / 'none.stl'}"])
    with pytest.raises(InvalidInput, match=r"'tip=1,2' is no link=x,y,z"):
        points_of(["tip=1,2"], ["tip"])
    with pytest.raises(InvalidInput, match=r"no link 'toe'; known are arm, tip"):
        points_of(["toe=0,0,1"], ["arm", "tip"])
    with pytest.raises(InvalidInput, match=r"'tip=nan,0,0' is no place"):
        points_of(["tip=nan,0,0"], ["arm", "tip"])
    with pytest.raises(InvalidInput, match=r"'links/left arm/pose' cannot be a topic: .* Try another"):
        topic_of("links/{link}/pose", "left arm")
    ball = Tool("arm", tip.vertices, tip.faces)
    with pytest.raises(InvalidInput, match=r"'arm' carries the skin and is a tool as well"):
        run(LinksConfig(body="arm", tools=("arm=-",)), build=lambda settings: plate(0.06), tools=[ball])


def test_links_of_gazebo_need_its_package() -> None:
    from stmpl_ros.links import _entity_wrench

    if importlib.util.find_spec("ros_gz_interfaces"):
        pytest.skip("it is installed")
    with pytest.raises(InvalidInput, match="need the package ros_gz_interfaces"):
        _entity_wrench()
