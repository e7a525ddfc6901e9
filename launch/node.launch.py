"""The node: ros2 launch stmpl_ros node.launch.py [namespace:=/robot] [params:=my.yaml] [autostart:=false]"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = {
    "namespace": ("", "of node and topics"),
    "params": (
        PathJoinSubstitution([FindPackageShare("stmpl_ros"), "config", "stmpl.yaml"]), "YAML file of parameters"
    ),
    "autostart": ("true", "configure and activate without being asked"),
    "log_level": ("info", "of the node"),
}  # fmt: skip


def generate_launch_description() -> LaunchDescription:
    """The node with its parameters. It is a lifecycle node; with autostart it goes to active by itself."""
    node = LifecycleNode(
        package="stmpl_ros",
        executable="stmpl",
        arguments=["node", "--ros-args", "--log-level", LaunchConfiguration("log_level")],
        name="stmpl",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params"), {"autostart": LaunchConfiguration("autostart")}],
        output="screen",
    )
    declared = [DeclareLaunchArgument(k, default_value=v, description=text) for k, (v, text) in ARGUMENTS.items()]
    return LaunchDescription([*declared, node])
