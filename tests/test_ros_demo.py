"""The demo: its settings reach the processes that it starts, and a massage is recorded, replayed, judged and shown."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tyro
from pydantic import BaseModel

from stmpl_ros.demo import flags_of
from stmpl_ros.parameters import ProbeConfig, RobotConfig
from tests.bus import ROOT


@pytest.mark.parametrize("config", [
    ProbeConfig(scripts=("squeeze",), rate=50.0, listeners=2),
    RobotConfig(),
    RobotConfig(force=(2.0, 7.5), told=True, out=Path("x"), at=(0.4, -0.1, 0.2), robot=Path("a.urdf"), end="tool0"),
])  # fmt: skip
def test_flags_say_what_a_configuration_holds(config: BaseModel) -> None:
    flags = flags_of(config)
    assert tyro.cli(type(config), args=flags) == config


@pytest.mark.parametrize(("flags", "why"), [
    (["--robot", "nothing.xml"], "no robot file nothing.xml"), (["--end", "hand"], "no body or site 'hand'"),
])  # fmt: skip
def test_a_robot_that_is_not_there_is_said_before_anything_starts(
    flags: list[str], why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    from stmpl_ros.cli import main

    for place in ("stmpl_ros.demo.play", "stmpl_ros.robot.RobotNode"):
        monkeypatch.setattr(place, lambda *_: pytest.fail("it started"))
    (flag, value), runs = flags, ["--runs", str(tmp_path)]
    for command in (["demo", f"--robot.{flag[2:]}", value, *runs], ["robot", flag, value]):
        with pytest.raises(SystemExit) as ended:
            main(command)
        assert ended.value.code == 1 and why in " ".join(capsys.readouterr().err.split())
    assert not [*tmp_path.iterdir()]


def test_a_force_is_held_to_finite_elements_of_the_same_skin_only() -> None:
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    from stmpl_ros.massage_report import Massaged, Solved, rows
    from stmpl_sim.massage import Log, Phase

    time, still = np.arange(0, 2, 0.01), np.zeros(200)
    log = Log(time, still + 5.0, still + 5.0, still + 0.01, np.zeros((200, 6)), np.tile(np.eye(4), (200, 1, 1)),
              np.tile(np.eye(4), (200, 1, 1)), np.zeros((200, 7)), still + 1.0, still + 4e-3, still == 0,
              *(np.zeros((200, 0)),) * 3, *(still,) * 4, (Phase("press", 0.0, 2.0, 5.0),))  # fmt: skip
    none = (still[:0], still[:0])
    for alike in (True, False):
        solved = (Solved(1.0, 5.8, 5.0, 1.3, alike), Solved(1.5, 5.0, 4.0, 0.1, alike))  # the first states its error
        done = Massaged(log, none, none, none, solved, 1.0, 100.0, None)  # type: ignore[arg-type]
        remarks, figures = list(done.remarks()), dict(rows(done))
        assert ("-13.8 % off finite elements" in remarks[0]) == alike
        assert ("2 compared frames is not held to finite elements" in remarks[0]) != alike
        assert any("-20.0 % off finite elements" in one for one in done.complaints()) == alike
        assert ("force off finite elements" in figures) == alike
        assert "4.0 mm off its course" in remarks[1] and figures["off course"].startswith("at most 4.00 mm")


@pytest.mark.slow
def test_a_massage_over_ros_is_recorded_replayed_judged_and_shown(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    from stmpl_ros.cli import main

    flags = "--node.edge-length 0.0075 --robot.laps 0.2 --robot.physics 250 --frames 1 --runs".split()
    command = [sys.executable, "-m", "stmpl_ros.cli", "demo", *flags, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "every one bit for bit as recorded" in " ".join(done.stdout.split())
    folder = tmp_path / "latest"
    page = (folder / "report.html").read_text()
    first = page.index("<h1>A robot massages a left forearm with 10 N</h1>")
    assert first < page.index("data:image/webp;base64") < page.index("moment_net against rigid_fem")
    assert (folder / "film.webp").stat().st_size > 20_000 and (folder / "robot.npz").is_file()
    for row in ("force off finite elements", "energy stored in the skin", "poses over ROS"):
        assert row in page
    with pytest.raises(SystemExit) as ended:
        main(["info", str(folder), "--json"])
    assert ended.value.code == 0
