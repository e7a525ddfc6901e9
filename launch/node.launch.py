"""The node: ros2 launch stmpl_ros node.launch.py [namespace:=/robot] [params:=my.yaml] [autostart:=false]"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = {
    "namespace": ("", "of node and topics"),
    "params": (
        PathJoinSubstitution([FindPackageShare("stmpl_ros"), "config", "stmpl.yaml"]), "YAML file of parameters"
    ),
    "respawn": ("false", "start the node again when it ends"),
    "log_level": ("info", "of the node"),
}  # fmt: skip
PARAMETERS = {  # empty: as the file of parameters says
    "autostart": "configure and activate without being asked",
    "part": "part of the body that answers",
    "frame": "frame_id of the body",
    "use_sim_time": "time of /clock",
}


def node(context):
    """The node with its parameters. It is a lifecycle node; with autostart it goes to active by itself."""
    values = {name: LaunchConfiguration(name) for name in PARAMETERS}
    return [LifecycleNode(
        package="stmpl_ros",
        executable="stmpl",
        arguments=["node", "--ros-args", "--log-level", LaunchConfiguration("log_level")],
        name="stmpl",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("params"),
            {name: value for name, value in values.items() if value.perform(context)},
        ],
        respawn=LaunchConfiguration("respawn"),
        output="screen",
    )]  # fmt: skip


def generate_launch_description() -> LaunchDescription:
    """The node, with arguments that win over the file of parameters where they are given."""
    arguments = ARGUMENTS | {name: ("", f"{text}; empty: as params says") for name, text in PARAMETERS.items()}
    declared = [DeclareLaunchArgument(k, default_value=v, description=text) for k, (v, text) in arguments.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=node)])
