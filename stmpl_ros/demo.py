"""The main job on one machine: node, robot or devices, and recorder as processes; then the run against FEM."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from pydantic import BaseModel
from rich.console import Console
from rich.status import Status

from bags.compare import Comparison
from bags.provenance import versions
from bags.replay import ReplaySummary, replay_run
from bags.report import write_report
from bags.run import NANO
from bags.writer import FILE
from fem_tools import RigidFem
from stmpl_core.errors import StmplError
from stmpl_core.extras import needed
from stmpl_core.friction import friction_from
from stmpl_core.methods import method as method_named
from stmpl_core.pool import Pool
from stmpl_ros.domain import claim
from stmpl_ros.massage_report import filmed, front, massaged, rows
from stmpl_ros.parameters import DemoConfig
from stmpl_ros.robot import TOOL
from stmpl_ros.tables import compare_with_progress, comparison_table

log = logging.getLogger(__name__)

LONGEST = 600.0  # time until the devices must be done [s]: a first start compiles kernels
TO_STOP = 20.0  # time that a process gets to end after SIGINT [s]
POLL_PERIOD_S = 0.1  # time between two looks at the processes
LEAST_RATE = 100.0  # rate at which contacts must have come [Hz]
LEAST_KEPT = 0.5  # share of the contacts that must have been answered: the newest wins, so a busy machine answers fewer
REPLAY_EVERY = 10  # step between the answers that are replayed


class DemoError(StmplError):
    """A part of the demo did not start, did not end, or left something out."""


def run(config: DemoConfig) -> int:
    """Runs all of it; 0 only if everything is there and sane. Raises DemoError with what is not."""
    if config.device == "robot":
        needed("stmpl demo", "sim", "mujoco")
        from stmpl_sim.scene import check_robot

        check_robot(config.robot.robot, config.robot.end or None)
        config = gripping(config)
    console = Console()
    folder = config.runs / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder.mkdir(parents=True)
    made_by = config.model_dump(mode="json") | {"versions": versions()}
    (folder / "config.json").write_text(json.dumps(made_by, indent=2) + "\n")
    console.print(f"run folder: {folder}")
    play(config, folder, console)
    _point_latest_at(folder)

    with Pool(1) as beside:
        filming = beside.submit(filmed, folder, config.robot) if config.device == "robot" else None
        replay = _replay(folder, config.node.method, console)
        # The frames of the grip take finite elements a minute each, and friction, which they lack: not compared.
        comparison = compare_with_progress(folder, RigidFem(), config.frames, tool=TOOL if filming else "")
        done = massaged(folder, comparison, filming.result()) if filming else None
    report = write_report(comparison, folder / "report.html", replay=replay,
                          front=front(done, config.node.limb) if done else "")  # fmt: skip
    console.print(comparison_table(comparison))
    for name, value in rows(done) if done else ():
        console.print(f"{name}: {value}", soft_wrap=True)
    console.print(str(replay))
    console.print(f"report: {report.resolve()}", soft_wrap=True)
    missing = [*complaints(folder, comparison, replay), *(done.complaints() if done else ())]
    for complaint in missing:
        console.print(f"[red]not as it should be:[/red] {complaint}")
    for remark in done.remarks() if done else ():
        console.print(f"to note: {remark}", soft_wrap=True)
    return int(bool(missing))


def gripping(config: DemoConfig) -> DemoConfig:
    """The settings, with the force that the limb is gripped with, and friction of all tools told alike to both."""
    from stmpl_sim.grip import usual_force, with_fingers

    grip = usual_force(config.node.limb) if config.robot.grip is None else config.robot.grip
    friction = config.node.friction or config.robot.friction
    if grip:
        by_tool = with_fingers(friction_from(friction), TOOL)
        friction = ", ".join(f"{name}: {'none' if one is None else one}" for name, one in by_tool.items())
    robot = config.robot.model_copy(update={"grip": grip, "friction": friction})
    return config.model_copy(update={"robot": robot, "node": config.node.model_copy(update={"friction": friction})})


def _replay(folder: Path, method: str, console: Console) -> ReplaySummary:
    with console.status("replaying the run"):
        return replay_run(folder, method_named(method), every=REPLAY_EVERY)


def play(config: DemoConfig, folder: Path, console: Console) -> None:
    """Starts the three processes, waits until the devices are done, and stops the others.

    Raises: DemoError, DomainError.
    """
    domain, held = claim()
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(domain),  # a bus of its own, on this machine only
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONUNBUFFERED": "1",
    }
    record = ["--path", str(folder), "--run", str(folder / "config.json")]
    settled = config.node.rest_after + config.node.fade + 0.5
    flags = flags_of(config.probe)
    if config.device == "robot":
        flags = flags_of(config.robot.model_copy(update={"out": folder, "linger": settled}))
    node_arguments = config.node.ros_arguments() + (["-p", "use_sim_time:=true"] if config.device == "robot" else [])
    with (
        held,
        _process("record", record, folder, environment) as recorder,
        _process("node", node_arguments, folder, environment) as node,
        _process(config.device, flags, folder, environment) as device,
    ):
        with console.status("starting") as status:
            _wait(device, config.device, {"node": node, "record": recorder}, folder, status)
        # the node says that the skin is at rest again once nothing has come for a while; a robot waits for that itself
        time.sleep(settled if config.device == "probe" else 0.5)
        _stop(recorder, "record", folder)
        _stop(node, "node", folder)


def complaints(folder: Path, comparison: Comparison, replay: ReplaySummary) -> Iterator[str]:
    """What of a run is missing or not sane, one sentence each."""
    for name in (FILE, "metadata.yaml", "report.html", "config.json"):
        path = folder / name
        if not path.is_file() or not path.stat().st_size:
            yield f"{path} is missing or empty"
    timing = comparison.run.timing
    first = min(moment.sequence for moment in comparison.run.moments)
    if first or timing.lost:
        yield f"{first + timing.lost} answers are not in the recording"
    stamps = comparison.run.bag.pose_stamps
    rate = (len(stamps) - 1) / max((max(stamps) - min(stamps)) * NANO, NANO)
    if not rate >= 0.95 * LEAST_RATE:
        yield f"contacts came at {rate:.0f} Hz; at least {LEAST_RATE:g} Hz was asked for"
    if timing.kept < LEAST_KEPT:
        yield f"{100 * timing.kept:.0f} % of the contacts were answered; at least {100 * LEAST_KEPT:g} % should be"
    if not replay.passed:
        yield str(replay)
    if not comparison.passed:
        yield comparison.verdict
    if max(moment.peak for moment in comparison.run.moments) <= 0:
        yield "nothing moved"


def flags_of(config: BaseModel) -> list[str]:
    """The flags of a verb whose settings these are."""
    flags = []
    for name, value in config.model_dump(mode="json").items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            flags.append(f"--{flag}" if value else f"--no-{flag}")
        elif value is not None and value != "":
            flags += [f"--{flag}", *map(str, value if isinstance(value, list) else [value])]
    return flags


@contextmanager
def _process(verb: str, arguments: list[str], folder: Path, environment: dict[str, str]) -> Iterator[subprocess.Popen]:
    """A verb as a process that logs into the run's folder; ended if it is still there at the end."""
    command = [sys.executable, "-m", "stmpl_ros.cli", verb, *arguments]
    with open(folder / f"{verb}.log", "wb") as out:
        process = subprocess.Popen(command, env=environment, stdout=out, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(0.4)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait(
    device: subprocess.Popen, verb: str, others: dict[str, subprocess.Popen], folder: Path, status: Status
) -> None:
    deadline = time.monotonic() + LONGEST
    while device.poll() is None:
        for name, process in others.items():
            if process.poll() is not None:
                raise DemoError(f"{name} ended early with code {process.returncode}:\n{_tail(folder, name)}")
        if time.monotonic() > deadline:
            raise DemoError(f"the devices were not done after {LONGEST:g} s:\n{_tail(folder, verb)}")
        status.update(_tail(folder, verb, lines=1) or _tail(folder, "node", lines=1) or "starting")
        time.sleep(POLL_PERIOD_S)
    if device.returncode:
        raise DemoError(f"{verb} ended with code {device.returncode}:\n{_tail(folder, verb)}")


def _stop(process: subprocess.Popen, name: str, folder: Path) -> None:
    process.send_signal(signal.SIGINT)
    try:
        code = process.wait(TO_STOP)
    except subprocess.TimeoutExpired as error:
        raise DemoError(f"{name} did not end within {TO_STOP:g} s of SIGINT:\n{_tail(folder, name)}") from error
    if code:
        raise DemoError(f"{name} ended with code {code}:\n{_tail(folder, name)}")


def _tail(folder: Path, name: str, lines: int = 15) -> str:
    return "\n".join((folder / f"{name}.log").read_text(errors="replace").splitlines()[-lines:])


def _point_latest_at(folder: Path) -> None:
    latest = folder.parent / "latest"
    latest.unlink(missing_ok=True)
    latest.symlink_to(folder.name)
