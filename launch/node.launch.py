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
    "part": ("", "part of the body that answers; empty: a forearm"),
    "frame": ("body", "frame_id of the body"),
    "use_sim_time": ("false", "time of /clock"),
    "respawn": ("false", "start the node again when it ends"),
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
        parameters=[
            LaunchConfiguration("params"),
            {name: LaunchConfiguration(name) for name in ("autostart", "part", "frame", "use_sim_time")},
        ],
        respawn=LaunchConfiguration("respawn"),
        output="screen",
    )
    declared = [DeclareLaunchArgument(k, default_value=v, description=text) for k, (v, text) in ARGUMENTS.items()]
    return LaunchDescription([*declared, node])
