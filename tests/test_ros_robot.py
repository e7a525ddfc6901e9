"""The simulated robot over real DDS: what it says is one world, and the node answers the contact that it feels."""

import signal
import threading
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from bags.wire import pose_from, stamp_ns
from stmpl_core.touch import BY_POSE
from stmpl_ros.parameters import RobotConfig
from stmpl_ros.robot import RobotNode, Stopped, made
from tests.bus import end, running, start
from tests.node_bus import NODE, Bus

mujoco = pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
TOPICS = {"tools/ball/pose": PoseStamped, "wrist/wrench": WrenchStamped, "joint_states": JointState, "/clock": Clock}


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """All that a massage with 5 N said and was answered, by topic and stamp [ns]; and the robot's own log."""
    import rclpy

    rclpy.init()
    folder, bus = tmp_path_factory.mktemp("robot"), Bus("/massage")
    own = "--ros-args -r __ns:=/massage".split()
    soft = "-p use_sim_time:=true -p youngs_modulus:=20000.0".split()
    try:
        with running("-c", NODE, *own, *soft) as node:
            bus.partner = node
            for topic, kind in TOPICS.items():
                bus.listen(kind, topic, 1000)
            flags = f"--force 5 --laps 0.1 --physics 250 --rate 50 --listeners 2 --linger 1.5 --out {folder}".split()
            bus.partner = robot = start("-m", "stmpl_ros.cli", "robot", *flags, *own)
            bus.wait(lambda: robot.poll() is not None or bus.got["/clock"], "the clock")
            while robot.poll() is None:
                bus.spin(0.1)
            code, said = end(robot)
            assert code == 0, said
            bus.partner = node
            bus.still()
    finally:
        bus.node.destroy_node()
        rclpy.shutdown()
    by_stamp = {
        topic: {stamp_ns(one): one for one in bus.got[topic]} for topic in [*TOPICS][:3] + ["skin/displacement"]
    }
    return by_stamp, bus.got, np.load(folder / "robot.npz")


def vector(v: Any) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def test_the_node_answers_the_contact_that_the_robot_feels(heard) -> None:
    by_stamp, got, log = heard
    start_ns = min(by_stamp["tools/ball/pose"])
    answers = {at: one for at, one in by_stamp["skin/displacement"].items() if one.touches and one.fade == 1}
    assert len(answers) > 0.5 * len(by_stamp["tools/ball/pose"])
    pressed = 0
    for at, answer in answers.items():
        row = round((at - start_ns) * 1e-9 * 250)
        limb, touch = log["limb"][row], answer.touches[0]
        felt = limb[:3, :3].T @ log["wrench"][row, :3]
        np.testing.assert_allclose(vector(touch.wrench.force), -felt, atol=2e-3)
        pressed += touch.status == BY_POSE
    assert pressed > 0.3 * len(answers)
    assert not np.frombuffer(got["skin/displacement"][-1].displacement, np.float32).any()  # its clock went on: at rest


def test_the_wrist_measures_what_presses_but_for_the_heads_own_motion(heard) -> None:
    by_stamp, _, log = heard
    start_ns = min(by_stamp["tools/ball/pose"])
    phases = {str(one["name"]): (float(one["start"]), float(one["duration"])) for one in log["phases"]}
    still, (begins, lasts) = [], phases["press"]
    for at, wrench in by_stamp["wrist/wrench"].items():
        time = (at - start_ns) * 1e-9
        row = round(time * 250)
        felt = log["limb"][row][:3, :3].T @ log["wrench"][row, :3]
        off = vector(wrench.wrench.force) + felt
        if begins + 0.6 < time < begins + lasts:
            still.append(np.linalg.norm(off))
    assert len(still) > 10 and max(still) < 0.02  # N


def test_joints_and_pose_are_of_one_instant(heard) -> None:
    from stmpl_core.layer import SoftLayer
    from stmpl_ros.robot import massage_of
    from stmpl_sim.scene import BALL
    from tests.scenes import limb

    by_stamp, _, log = heard
    layer: SoftLayer = limb(4e-3).with_(youngs_modulus=20e3)
    scene = massage_of(RobotConfig(), layer).scene
    data = mujoco.MjData(scene.model)
    for at, message in list(by_stamp["joint_states"].items())[::20]:
        assert list(message.name) == [scene.model.joint(j).name for j in scene.joints]
        for name, position in zip(message.name, message.position, strict=True):
            data.joint(name).qpos[0] = position
        mujoco.mj_kinematics(scene.model, data)
        pose = pose_from(by_stamp["tools/ball/pose"][at].pose)
        world = log["limb"][0] @ pose
        np.testing.assert_allclose(data.geom(BALL).xpos, world[:3, 3], atol=1e-6)


def test_frames_hang_together_from_the_world_to_every_tool() -> None:
    from stmpl_ros.tf import WORLD, transforms
    from stmpl_sim.massage import Course, Massage
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site
    from tests.scenes import limb

    layer = limb(6e-3, radius=0.03).with_(youngs_modulus=20e3)
    site = Site.thickest(layer)
    scene = build(layer, site, mount="rest", gripper=True)
    massage = Massage(scene, Course(site.circle(0.012), (5.0,), grip=10.0))
    found = {one.child_frame_id: one for one in transforms(massage, "left_arm", 5)}
    assert len(found) == len(set(found)) and set(scene.tools) <= set(found)

    def placed(frame: str) -> np.ndarray:
        one, pose = found[frame], np.eye(4)
        turn, way = one.transform.rotation, one.transform.translation
        mujoco_turn = np.empty(9)
        mujoco.mju_quat2Mat(mujoco_turn, np.array([turn.w, turn.x, turn.y, turn.z]))
        pose[:3, :3], pose[:3, 3] = mujoco_turn.reshape(3, 3), vector(way)
        return pose if one.header.frame_id == WORLD else placed(one.header.frame_id) @ pose

    for name in scene.tools:
        np.testing.assert_allclose(placed(name)[:3, 3], massage.data.geom(name).xpos, atol=1e-9)
    np.testing.assert_allclose(placed("left_arm"), massage.limb_pose(), atol=1e-9)


def test_the_clock_runs_with_the_stamps(heard) -> None:
    by_stamp, got, _ = heard
    times = np.array([one.clock.sec * 1_000_000_000 + one.clock.nanosec for one in got["/clock"]])
    assert (np.diff(times) >= 0).all()
    assert set(by_stamp["tools/ball/pose"]) <= set(times.tolist()) | {times[0]}


def test_a_robot_whom_nobody_hears_says_so() -> None:
    process = start("-m", "stmpl_ros.cli", "robot", "--patience", "0.5", "--ros-args", "-r", "__ns:=/alone")
    code, said = end(process)
    assert code == 1 and "no skin/topology within 0.5 s" in said


def test_ctrl_c_ends_a_robot_that_waits_or_gets_ready() -> None:
    import rclpy

    stop, before = threading.Event(), signal.getsignal(signal.SIGINT)

    def endless(*_: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("it went on")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stmpl_ros.robot.massage_of", endless)
        with pytest.raises(Stopped):
            made(RobotConfig(), None, stop)  # type: ignore[arg-type]
    assert stop.is_set() and signal.getsignal(signal.SIGINT) is before
    rclpy.init()
    try:
        node = RobotNode(RobotConfig(patience=100.0))
        for wait in (node.wait_for_skin, node.wait_for_listeners):
            with pytest.raises(Stopped):
                wait(stop)
        node.destroy_node()
    finally:
        rclpy.shutdown()


def test_a_recorder_takes_what_a_robot_says() -> None:
    from stmpl_ros.recorder import WANTED

    for topic in ("/tools/ball/pose", "/tools/panda/tool0/wrench", "/wrist/wrench", "/left/joint_states",
                  "/contact_mesh"):  # fmt: skip
        assert WANTED.search(topic), topic
    assert not WANTED.search("/clock")  # the stamps of the poses tell its time
