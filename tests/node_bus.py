"""A node on a limb as a process, and the robot that moves tools at its other end."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from stmpl_msgs.msg import ContactMesh, SkinDisplacement

from bags.wire import header, pose_message, tool_message, wrench_message
from stmpl_core.errors import InvalidInput
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.topics import KEPT, STREAM
from tests.bus import AGAIN, Robot, running
from tests.scenes import LENGTH, RADIUS, at, ball, limb

TOUCH = RADIUS + 0.012 - 1e-3  # m from the limb's axis: a ball of 12 mm, 1 mm deep
NODE = """
import sys
from stmpl_ros.node import run
from stmpl_ros.parameters import NodeConfig
from tests.node_bus import skin
sys.exit(run(NodeConfig(tissue="paper", rest_after=0.4, fade=0.6), sys.argv[1:], build=skin))
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
        """The answer of a service of the node; what may be asked twice is, every AGAIN.

        A client may know a service before that knows whom to answer: the answer is lost (ros2/rmw_fastrtps#418).
        """
        client = self.node.create_client(kind, f"stmpl/{name}")
        self.wait(client.service_is_ready, name)
        futures, begun = [client.call_async(kind.Request(**fields))], time.monotonic()

        def answered() -> list:
            if name.endswith("_parameters") and time.monotonic() - begun > len(futures) * AGAIN / 1e9:
                futures.append(client.call_async(kind.Request(**fields)))
            return [future for future in futures if future.done()]

        (future, *_) = self.wait(answered, f"an answer of {name}")
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
        self.bus.spin(0.3)  # the node may still be about to hear of the sender
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
        return self.bus.answer(lambda: self.send(*pose_and_wrench, frame=frame))


HERE = at(TOUCH, 0, LENGTH / 2)
PUSH = np.array([-0.03, 0, 0, 0, 0, 0])
TABLE = np.array([[-1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]])  # pose_body_from_table


def stamp_of(stamp_ns: int) -> Time:
    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def a_node(folder: Path) -> Iterator[Bus]:
    """A node on a limb in a namespace, with limits, frames, and a tool that announces itself as shape_msgs/Mesh."""
    (folder / "limits.yaml").write_text("regions:\n  left_arm: {pressure_kpa: 0.05, force_n: 100, source: this test}\n")
    (folder / "frames.yaml").write_text("table: {position: [0, 0, 0.1], orientation: [0, 0, 1, 0]}\n")
    files = [f"{name}:={folder}/{name}.yaml" for name in ("limits", "frames")]
    given = [part for one in (*files, "shape_tools:=shaped") for part in ("-p", one)]
    rclpy.init()
    made = Bus("/robot")
    made.folder = folder
    try:
        with running("-c", NODE, "--ros-args", "-r", "__ns:=/robot", *given) as made.partner:
            made.wait(lambda: made.got["skin/topology"], "skin/topology")
            yield made
    finally:
        made.node.destroy_node()
        rclpy.shutdown()
