"""The node and a robot that massages it: ros2 launch stmpl_ros demo.launch.py [device:=probe] [scripts:=press]"""

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.actions import Node

from launch import LaunchDescription

ARGUMENTS = {
    "namespace": ("", "of nodes and topics"),
    "scripts": ("press", "of the probe: press or squeeze"),
    "rate": ("125", "of poses and wrenches [Hz]"),
    "patience": ("600", "time that the device waits for the node [s]; its first start compiles for minutes"),
}
DEVICE = "what presses: a 7-axis arm in MuJoCo, which takes the extra sim, or simulated devices"


def ended(event, context):
    """Ends all once one process ended; with an error if that one failed, which makes ros2 launch return 1."""
    if context.is_shutdown:
        return None
    if event.returncode:
        raise RuntimeError(f"{event.process_name} ended with {event.returncode}; its lines say why")
    return EmitEvent(event=Shutdown(reason=f"{event.process_name} is done"))


def parts(context):
    """The node, on the robot's clock if that presses, and what presses it."""
    device, namespace = LaunchConfiguration("device").perform(context), LaunchConfiguration("namespace")
    given = {"namespace": namespace} | ({"use_sim_time": "true"} if device == "robot" else {})
    flags = ["rate", "patience", *(["scripts"] if device == "probe" else [])]
    return [
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(PathJoinSubstitution([ThisLaunchFileDir(), "node.launch.py"])),
            launch_arguments=given.items(),
        ),
        Node(
            package="stmpl_ros",
            executable="stmpl",
            arguments=[device, *(part for flag in flags for part in (f"--{flag}", LaunchConfiguration(flag)))],
            namespace=namespace,
            output="screen",
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Ends once the robot or the devices are done. The arguments of node.launch.py are taken too."""
    declared = [DeclareLaunchArgument(k, default_value=v, description=text) for k, (v, text) in ARGUMENTS.items()]
    device = DeclareLaunchArgument("device", default_value="robot", choices=["robot", "probe"], description=DEVICE)
    ends = RegisterEventHandler(OnProcessExit(on_exit=ended))
    return LaunchDescription([*declared, device, ends, OpaqueFunction(function=parts)])
