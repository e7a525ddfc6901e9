"""The node and simulated devices that press it: ros2 launch stmpl_ros demo.launch.py [scripts:=press] [rate:=125]"""

from launch.actions import DeclareLaunchArgument, EmitEvent, IncludeLaunchDescription, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.actions import Node

from launch import LaunchDescription

ARGUMENTS = {
    "namespace": ("", "of nodes and topics"),
    "scripts": ("press", "press or squeeze"),
    "rate": ("125", "of poses and wrenches [Hz]"),
}


def generate_launch_description() -> LaunchDescription:
    """Ends once the devices are done."""
    namespace = LaunchConfiguration("namespace")
    node = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([ThisLaunchFileDir(), "node.launch.py"])),
        launch_arguments={"namespace": namespace}.items(),
    )
    probe = Node(
        package="stmpl_ros",
        executable="stmpl",
        arguments=["probe", "--patience", "180", "--scripts", LaunchConfiguration("scripts"),
                   "--rate", LaunchConfiguration("rate")],
        namespace=namespace,
        output="screen",
    )  # fmt: skip
    done = RegisterEventHandler(OnProcessExit(target_action=probe, on_exit=[EmitEvent(event=Shutdown())]))
    declared = [DeclareLaunchArgument(k, default_value=v, description=text) for k, (v, text) in ARGUMENTS.items()]
    return LaunchDescription([*declared, node, probe, done])
