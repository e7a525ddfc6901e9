"""Laws of the launch files, run as `ros2 launch` runs them; where `launch` is not installed these tests are skipped."""

import os
import runpy
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from lifecycle_msgs.srv import GetState

from tests.bus import ROOT, end, start
from tests.node_bus import Bus

pytest.importorskip("launch_ros.actions", reason="launch_ros is not installed", exc_type=ImportError)
pytestmark = pytest.mark.slow

SERVICE = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
file, *given = sys.argv[1:]
arguments = [tuple(one.split(":=", 1)) for one in given]
included = IncludeLaunchDescription(PythonLaunchDescriptionSource(file), launch_arguments=arguments)
service = LaunchService()
service.include_launch_description(LaunchDescription([included]))
sys.exit(service.run())
"""  # what ros2 launch does with a file
COMMAND = f"""#!{sys.executable}
from stmpl_ros.cli import main

if __name__ == "__main__":
    main()
"""
PARAMETERS = """
/**:
  ros__parameters: {tissue: paper, part: right_forearm, edge_length: 0.01, frame: patient}
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A prefix as colcon installs one: what setup.py names, and the command."""
    prefix, given, patch = tmp_path_factory.mktemp("install"), {}, pytest.MonkeyPatch()
    with patch.context() as setting:
        setting.setenv("ROS_DISTRO", "jazzy")
        setting.setattr("setuptools.setup", lambda **arguments: given.update(arguments))
        setting.chdir(ROOT)
        runpy.run_path("setup.py")
    for folder, files in given["data_files"]:
        (prefix / folder).mkdir(parents=True, exist_ok=True)
        for file in files:
            shutil.copy(ROOT / file, prefix / folder)
    command = prefix / "lib/stmpl_ros/stmpl"
    command.parent.mkdir(parents=True)
    command.write_text(COMMAND)
    command.chmod(0o755)
    (prefix / "mine.yaml").write_text(PARAMETERS)
    return prefix


def launched(prefix: Path, file: str, *given: str):
    """A launch file as a process."""
    places = os.pathsep.join([str(prefix), os.environ.get("AMENT_PREFIX_PATH", sys.prefix)])
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    where = os.environ | {"AMENT_PREFIX_PATH": places, "PYTHONPATH": paths, "ROS_LOG_DIR": str(prefix / "log")}
    arguments = [str(prefix / "share/stmpl_ros/launch" / file), f"params:={prefix / 'mine.yaml'}", *given]
    return start("-c", SERVICE, *arguments, env=where)


@pytest.fixture
def robot() -> Iterator[Bus]:
    rclpy.init()
    made = Bus("/launched")
    yield made
    made.node.destroy_node()
    rclpy.shutdown()


def test_what_is_given_wins_over_the_file_of_parameters_and_the_rest_is_as_it_says(installed, robot):
    robot.partner = launched(installed, "node.launch.py", "namespace:=/launched", "frame:=person")
    topology = robot.wait(lambda: robot.got["skin/topology"], "the topology")[0]
    assert topology.header.frame_id == "person"
    assert robot.get("part", "edge_length", "use_sim_time") == ["right_forearm", 0.01, False]
    code, said = end(robot.partner, signal.SIGINT)
    assert code == 0 and "process has finished cleanly" in said, said


def test_a_node_that_is_not_to_start_by_itself_waits_to_be_configured(installed, robot):
    robot.partner = launched(installed, "node.launch.py", "namespace:=/launched", "autostart:=false")
    assert robot.call(GetState, "get_state").current_state.label == "unconfigured"
    code, said = end(robot.partner, signal.SIGINT)
    assert code == 0 and "process has finished cleanly" in said, said


@pytest.mark.parametrize("device", ["probe", "robot"])
def test_the_demo_ends_by_itself_once_its_device_has_pressed(installed, robot, device):
    if device == "robot":
        pytest.importorskip("mujoco")
    robot.partner = launched(installed, "demo.launch.py", "namespace:=/launched", "rate:=50", f"device:={device}")
    robot.wait(lambda: any(answer.touches for answer in robot.got["skin/displacement"]), "an answer to the device")
    code, said = end(robot.partner)
    assert code == 0 and said.count("process has finished cleanly") == 2, said


def test_a_demo_whose_node_cannot_start_fails_at_once(installed):
    code, said = end(launched(installed, "demo.launch.py", "part:=nose", "device:=probe"))
    assert code == 1 and "stmpl-1 ended with 1" in said and "nose" in said, said
