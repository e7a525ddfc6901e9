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
    "patience": ("600", "time that the devices wait for the node [s]; its first start compiles for minutes"),
}


def ended(event, context):
    """Ends all once one process ended; with an error if that one failed, which makes ros2 launch return 1."""
    if context.is_shutdown:
        return None
    if event.returncode:
        raise RuntimeError(f"{event.process_name} ended with {event.returncode}; its lines say why")
    return EmitEvent(event=Shutdown(reason=f"{event.process_name} is done"))


def generate_launch_description() -> LaunchDescription:
    """Ends once the devices are done. The arguments of node.launch.py are taken too."""
    namespace = LaunchConfiguration("namespace")
    node = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([ThisLaunchFileDir(), "node.launch.py"])),
        launch_arguments={"namespace": namespace}.items(),
    )
    probe = Node(
        package="stmpl_ros",
        executable="stmpl",
        arguments=["probe", "--patience", LaunchConfiguration("patience"), "--scripts", LaunchConfiguration("scripts"),
                   "--rate", LaunchConfiguration("rate")],
        namespace=namespace,
        output="screen",
    )  # fmt: skip
    declared = [DeclareLaunchArgument(k, default_value=v, description=text) for k, (v, text) in ARGUMENTS.items()]
    return LaunchDescription([*declared, RegisterEventHandler(OnProcessExit(on_exit=ended)), node, probe])
