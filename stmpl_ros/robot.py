"""RobotNode: a simulated robot that massages the skin of a running node, and says over ROS what a real one would."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from stmpl_msgs.msg import ContactMesh, SkinTopology

from bags.wire import NANO, header, layer_from, pose_message, tool_message, wrench_message
from stmpl_core.errors import StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.outputs import writable_folder
from stmpl_ros.parameters import RobotConfig
from stmpl_ros.spinning import TOLD_AFTER_S, interruptible, ros
from stmpl_ros.tf import tf_type, transforms
from stmpl_ros.topics import KEPT, STREAM

if TYPE_CHECKING:
    from stmpl_sim.massage import Log, Massage
    from stmpl_sim.scene import Scene

TOOL = "ball"  # name of the massage's tool on the bus; the fingers of a gripper have those of stmpl_sim.grip
LOG = "robot.npz"  # file of what the robot did, in the folder that it is given
POLL_PERIOD_S = 0.05  # time between two looks while waiting
CATCH_UP_S = 0.05  # simulated time that a robot behind real time makes up for


class Stopped(StmplError):
    """The robot was asked to stop."""


class RobotNode(Node):
    """Publishes meshes, poses, the wrist's wrench, joints and frames of a simulated robot, and the simulated clock.

    The simulator owns physics and contact: its skin is the node's, by skin/topology, and its force follows from the
    pose. The tool's pose goes out alone, so that the node answers the same contact; what the wrist measures goes out
    on `wrist/wrench`, or, if it is told, also on tools/ball/wrench, where it corrects the pose.

    Args:
        config: settings.
    """

    def __init__(self, config: RobotConfig) -> None:
        super().__init__("robot")
        self.config = config
        self.topology: SkinTopology | None = None
        self.create_subscription(SkinTopology, "skin/topology", self._on_topology, KEPT)
        self._mesh = self.create_publisher(ContactMesh, "contact_mesh", KEPT)
        self._clock = self.create_publisher(Clock, "/clock", QoSProfile(depth=1))
        self._poses = {name: self.create_publisher(PoseStamped, f"tools/{name}/pose", STREAM)
                       for name in tools_of(config)}  # fmt: skip
        self._wrench = self.create_publisher(WrenchStamped, f"tools/{TOOL}/wrench", STREAM) if config.told else None
        self._wrist = self.create_publisher(WrenchStamped, "wrist/wrench", STREAM)
        self._joints = self.create_publisher(JointState, "joint_states", STREAM)
        self._tf_type = tf_type()
        self._frames = self.create_publisher(self._tf_type, "/tf", STREAM) if self._tf_type else None
        if not self._frames:
            self.get_logger().info("/tf is not sent: tf2_msgs, which comes with ROS, is not installed")

    def _on_topology(self, message: SkinTopology) -> None:
        self.topology = message

    def wait_for_skin(self, stop: threading.Event) -> SoftLayer | None:
        """The layer that the node answers on; None if out of patience. Raises Stopped."""
        self._wait(lambda: self.topology is not None, stop, "skin/topology: is a node active?")
        return layer_from(self.topology) if self.topology else None

    def wait_for_listeners(self, stop: threading.Event) -> bool:
        """Whether as many listen to each tool's poses as there should be, in time. Raises Stopped."""
        return self._wait(lambda: all(one.get_subscription_count() >= self.config.listeners
                                      for one in self._poses.values()), stop)  # fmt: skip

    def _wait(self, done: Any, stop: threading.Event, what: str = "") -> bool:
        deadline, told = time.monotonic() + self.config.patience, time.monotonic() + TOLD_AFTER_S
        while not done():
            if what and time.monotonic() > told:
                self.get_logger().info(f"waiting {self.config.patience:g} s at most for {what}")
                told = deadline + 1
            _go_on(stop)
            if time.monotonic() > deadline:
                return False
            rclpy.spin_once(self, timeout_sec=POLL_PERIOD_S)
        return True

    def announce(self, massage: Massage) -> None:
        """Publishes the surfaces of the robot's tools, and the clock before its start."""
        self.started = time.time_ns()  # simulated time starts at the real one, and runs by itself
        self.tell_time(0.0)
        for tool in massage.skin.contact.tools.values():
            self._mesh.publish(tool_message(tool, self.started))

    def tell_time(self, at: float) -> int:
        """Publishes the simulated clock; returns its stamp [ns].

        Args:
            at: time since the start [s].
        """
        stamp = self.started + round(at * NANO)
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(stamp, NANO)
        self._clock.publish(message)
        return stamp

    def tell(self, massage: Massage, wrist: Any, at: float) -> None:
        """Publishes what a robot knows at an instant.

        Args:
            massage: massage after a step.
            wrist: stmpl_sim.wrist.Wrist of its scene.
            at: time of the step [s].
        """
        assert self.topology and massage.skin.reaction
        stamp, frame = self.tell_time(at), self.topology.header.frame_id
        turn = massage.limb_pose()[:3, :3]
        measured = wrist.wrench(massage.data)
        wrench = wrench_message(np.concatenate([turn.T @ measured[:3], turn.T @ measured[3:]]), frame, stamp)
        self._wrist.publish(wrench)
        if self._wrench:
            self._wrench.publish(wrench)
        for name, poses in self._poses.items():
            poses.publish(pose_message(massage.skin.reaction.memory.at[name], frame, stamp))
        self._joints.publish(joint_state(massage, stamp))
        if self._frames:
            self._frames.publish(self._tf_type(transforms=transforms(massage, frame, stamp)))


def tools_of(config: RobotConfig) -> tuple[str, ...]:
    """Names of the tools on the bus."""
    if not config.grip:
        return (TOOL,)
    from stmpl_sim.grip import FINGERS

    return TOOL, *FINGERS


def joint_state(massage: Massage, stamp_ns: int) -> JointState:
    """The joints of robot and gripper after a step: positions at its instant, and the efforts that were asked for."""
    model, data, scene = massage.scene.model, massage.data, massage.scene
    joints = [*scene.joints, *(massage.gripper.joints if massage.gripper else ())]
    places, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    message = JointState(header=header("", stamp_ns), name=[model.joint(j).name for j in joints])
    message.position = (data.qpos[places] - model.opt.timestep * data.qvel[dofs]).tolist()
    message.velocity = data.qvel[dofs].tolist()
    message.effort = data.qfrc_actuator[dofs].tolist()
    return message


class Pace:
    """Real time: sleeps where the simulation is ahead of it. One that is behind makes up for CATCH_UP_S at most."""

    def __init__(self) -> None:
        self._zero = time.monotonic()

    def wait(self, at: float) -> None:
        """Waits until simulated time `at` [s] has come."""
        ahead = self._zero + at - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        elif ahead < -CATCH_UP_S:
            self._zero -= ahead + CATCH_UP_S


def scene_of(config: RobotConfig, layer: SoftLayer) -> Scene:
    """The robot in front of a limb. Raises InvalidInput."""
    from stmpl_sim.grip import mount_of
    from stmpl_sim.scene import build
    from stmpl_sim.site import Site

    grip = config.grip or 0.0
    return build(layer, Site.thickest(layer), robot=config.robot, end=config.end or None, at=config.at,
                 mount=mount_of(config.mount, grip), radius=1e-3 * config.radius, timestep=1 / config.physics,
                 gripper=grip > 0)  # fmt: skip


def massage_of(config: RobotConfig, layer: SoftLayer) -> Massage:
    """The robot on a layer, ready to start. Raises InvalidInput."""
    from stmpl_core.friction import friction_from
    from stmpl_sim.massage import Course, Massage

    scene = scene_of(config, layer)
    course = Course(scene.site.circle(1e-3 * config.circle), config.force, 1e-3 * config.speed, config.laps,
                    config.grip or 0.0)  # fmt: skip
    return Massage(scene, course, friction=friction_from(config.friction), every=config.every)


def made(config: RobotConfig, layer: SoftLayer, stop: threading.Event) -> Massage:
    """The robot on a layer with nothing left to compile, which may take a minute. Raises InvalidInput or Stopped."""
    with interruptible(stop):
        massage = massage_of(config, layer)
        massage.warm_up()
        return massage
    raise Stopped("asked to stop")


def run(config: RobotConfig, arguments: Sequence[str] | None = None) -> int:
    """Massages once; the exit code says whether all of the course was done. Raises InvalidInput: no such robot."""
    from stmpl_sim.scene import check_robot

    check_robot(config.robot, config.end or None)  # before it waits for a node
    if config.out:
        writable_folder(config.out)
    with ros(list(arguments or ())) as stop:
        node = RobotNode(config)
        try:
            layer = node.wait_for_skin(stop)
            if layer is None:
                node.get_logger().error(f"no skin/topology within {config.patience:g} s. Is the node active?")
                return 1
            massage = made(config, layer, stop)
            node.announce(massage)
            if not node.wait_for_listeners(stop):
                node.get_logger().error(
                    f"nobody listens to tools/{TOOL}/pose after {config.patience:g} s; {config.listeners} should. Is "
                    "the node running on this ROS_DOMAIN_ID, and does the simulated clock suit it (use_sim_time:=true)?"
                )
                return 1
            log = _massage(node, massage, stop)
            if config.out:
                save(log, config.out)
            return 0
        except Stopped:
            return 1
        finally:
            node.destroy_node()


def _go_on(stop: threading.Event) -> None:
    if stop.is_set():
        raise Stopped("asked to stop")


def _massage(node: RobotNode, massage: Massage, stop: threading.Event) -> Log:
    """Follows the course at real time at most, and goes on telling the time for a while."""
    from stmpl_sim.wrist import Wrist

    config, dt = node.config, float(massage.scene.model.opt.timestep)
    every, wrist, pace = max(1, round(1 / (config.rate * dt))), Wrist(massage.scene), Pace()
    told = ""
    node.get_logger().info(f"massage: {massage.course.duration:.1f} s, physics at {1 / dt:g} Hz, "
                           f"poses at {1 / (every * dt):g} Hz")  # fmt: skip

    def see(run: Massage, at: float) -> None:
        nonlocal told
        _go_on(stop)
        if round(at / dt) % every == 0:
            node.tell(run, wrist, at)
            pace.wait(at)
            phase = run.course.phase(at)
            if told != f"{phase.name}, {phase.force:g} N":
                told = f"{phase.name}, {phase.force:g} N"
                node.get_logger().info(told)

    log = massage.run([see])
    for k in range(round(config.linger * config.rate)):
        at = massage.course.duration + k / config.rate
        if stop.is_set():
            break
        node.tell_time(at)
        pace.wait(at)
    return log


def save(log: Log, folder: Path) -> Path:
    """Writes the log into a folder as LOG."""
    return log.save(folder / LOG)
