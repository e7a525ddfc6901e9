"""What a contact costs over ROS: from the pose's message to the displacement's, at several rates; a soak with memory.

python -m benchmarks.node [--rates 100 200 500] [--seconds 10]
python -m benchmarks.node --minutes 30 --rates 200 --picture docs/pictures/soak.png
python -m benchmarks.node --joints --rates 250 500    # the tool rides on a forearm whose elbow bends, 60 times a second
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from stmpl_msgs.msg import ContactMesh, LocalContact, SkinDisplacement, SkinTopology
from stmpl_msgs.srv import SetBody

from bags.wire import header, layer_from, pose_message, stamp_ns, tool_message, wrench_message
from benchmarks import bus
from stmpl_core.layer import SoftLayer
from stmpl_core.provenance import machine
from stmpl_ros.scripts import PRESS, Motion
from stmpl_ros.spinning import spin
from stmpl_ros.topics import KEPT, STREAM

PATIENCE = 300.0  # s for the node to start
PAGE = os.sysconf("SC_PAGE_SIZE")
WINDOW = 10.0  # s that a point of the soak's picture stands for
JOINT_RATE, BEND, TURNS = 60.0, 0.4, 1.0  # rate of joint states [Hz], half of the elbow's way [rad], its speed [rad/s]


@dataclass
class Figures:
    """What was measured at one rate.

    Args:
        rate: rate of poses, each with a wrench of the same stamp [Hz].
        seconds: time that it took [s].
        instants: sent.
        answered: number of them that were answered.
        p50_ms, p99_ms, worst_ms: times from the pose's stamp to the answer's arrival [ms].
        solve_p50_ms, solve_p99_ms: times that the node states for itself [ms].
        models: local contacts that came.
        wrenches: contact wrenches that came, where joints move.
        wrench_p50_ms, wrench_p99_ms, wrench_worst_ms: times from the pose's stamp to the wrench's arrival [ms].
        poses: number of joint angles that the answers were given at.
    """

    rate: float
    seconds: float
    instants: int
    answered: int
    p50_ms: float
    p99_ms: float
    worst_ms: float
    solve_p50_ms: float
    solve_p99_ms: float
    models: int
    wrenches: int = 0
    wrench_p50_ms: float = float("nan")
    wrench_p99_ms: float = float("nan")
    wrench_worst_ms: float = float("nan")
    poses: int = 0

    def __str__(self) -> str:
        bent = (f"  wrenches {self.wrenches}, p50 {self.wrench_p50_ms:6.2f}  p99 {self.wrench_p99_ms:6.2f}  worst "
                f"{self.wrench_worst_ms:7.2f} ms, at {self.poses} angles") if self.wrenches else ""  # fmt: skip
        lost = self.instants - self.answered
        return (
            f"{self.rate:5.0f} Hz  {self.instants:7} instants, {lost:5} unanswered ({lost / self.instants:7.2%})"
            f"  latency p50 {self.p50_ms:6.2f}  p99 {self.p99_ms:6.2f}  worst {self.worst_ms:7.2f} ms"
            f"  solve p50 {self.solve_p50_ms:5.2f}  p99 {self.solve_p99_ms:5.2f} ms  local models {self.models}{bent}"
        )


@dataclass
class Heard:
    """What came back since it was last emptied: (arrival, latency, solve time) of each answer [s]."""

    answers: deque[tuple[float, float, float]] = field(default_factory=deque)
    models: int = 0
    wrenches: deque[float] = field(default_factory=deque)  # latency [s]
    angles: set[float] = field(default_factory=set)


class Robot(Node):
    """A device that presses along a script, and listens."""

    def __init__(self, models: bool, joints: bool) -> None:
        super().__init__("bench")
        self.joints = joints
        self.topologies: list[SkinTopology] = []
        self.heard = Heard()
        self.sent: set[int] = set()
        self.moments: dict[float, list] = {}
        self.mesh = self.create_publisher(ContactMesh, "contact_mesh", KEPT)
        self.pose = self.create_publisher(PoseStamped, "tools/probe/pose", STREAM)
        self.wrench = self.create_publisher(WrenchStamped, "tools/probe/wrench", STREAM)
        self.body = self.create_client(SetBody, "stmpl/set_body")
        self.create_subscription(SkinTopology, "skin/topology", self.topologies.append, KEPT)
        self.create_subscription(SkinDisplacement, "skin/displacement", self._on_answer, STREAM)
        if models:
            self.create_subscription(LocalContact, "tools/probe/local_contact", self._on_model, STREAM)
        if joints:
            self.states = self.create_publisher(JointState, "joint_states", STREAM)
            self.create_subscription(WrenchStamped, "tools/probe/contact_wrench", self._on_wrench, STREAM)

    def _on_answer(self, message: SkinDisplacement) -> None:
        stamp = stamp_ns(message)
        if stamp in self.sent:
            self.sent.discard(stamp)
            latency = 1e-9 * (self.get_clock().now().nanoseconds - stamp)
            self.heard.answers.append((time.monotonic(), latency, message.solve_seconds))
            self.heard.angles |= set(message.joints)

    def _on_wrench(self, message: WrenchStamped) -> None:
        self.heard.wrenches.append(1e-9 * (self.get_clock().now().nanoseconds - stamp_ns(message)))

    def _on_model(self, message: LocalContact) -> None:
        self.heard.models += 1

    def play(self, layer: SoftLayer, frame: str, rate: float, seconds: float) -> int:
        """Sends the script over and over, with its moments made before; the number of instants sent.

        Where joints move, the tool rides on the last bone.
        """
        if rate not in self.moments:
            motion = Motion(PRESS.devices[0], layer)
            self.moments[rate] = [motion.at(k / rate) for k in range(round(PRESS.seconds * rate))]
        moments = self.moments[rate]
        started, count, bent, motion = time.perf_counter(), round(seconds * rate), -1, np.eye(4)
        for k in range(count):
            pose, wrench = moments[k % len(moments)]
            time.sleep(max(0.0, started + k / rate - time.perf_counter()))
            stamp = self.get_clock().now().nanoseconds
            if self.joints and int(k / rate * JOINT_RATE) > bent:
                assert layer.rig is not None
                bent, angle = int(k / rate * JOINT_RATE), BEND * (1 - np.cos(TURNS * k / rate))
                motion = layer.rig.motions((angle,))[-1]
                self.states.publish(JointState(header=header("", stamp), name=list(layer.rig.names), position=[angle]))
            if self.joints:
                pose, wrench = motion @ pose, (motion[:3, :3] @ wrench.reshape(2, 3, 1)).ravel()
            self.sent.add(stamp)
            self.wrench.publish(wrench_message(wrench, frame, stamp))
            self.pose.publish(pose_message(pose, frame, stamp))
        return count


def wait(done, what: str) -> None:
    """Until `done()`."""
    until = time.monotonic() + PATIENCE
    while not done():
        if time.monotonic() > until:
            raise SystemExit(f"waited {PATIENCE:g} s for {what}")
        time.sleep(0.05)


def measure(robot: Robot, layer: SoftLayer, frame: str, rate: float, seconds: float) -> Figures:
    """One rate."""
    robot.heard, robot.sent = Heard(), set()
    started = time.perf_counter()
    instants = robot.play(layer, frame, rate, seconds)
    time.sleep(0.5)
    latency, solve = np.array([(a, s) for _, a, s in robot.heard.answers]).T * 1e3
    p50, p99, worst = map(float, np.percentile(latency, [50, 99, 100]))
    solve_p50, solve_p99 = map(float, np.percentile(solve, [50, 99]))
    seconds, heard = time.perf_counter() - started, robot.heard
    quick, late, latest = map(float, np.percentile(1e3 * np.array(heard.wrenches or [np.nan]), [50, 99, 100]))
    return Figures(rate, seconds, instants, len(latency), p50, p99, worst, solve_p50, solve_p99, heard.models,
                   len(heard.wrenches), quick, late, latest, len(heard.angles))  # fmt: skip


def memory(pid: int) -> dict[str, float]:
    """Resident memory of the node and of the processes beside it [MB]."""
    pids = {"node": pid}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        tracker = "resource_tracker" in Path(f"/proc/{child}/cmdline").read_text()
        pids["resource tracker" if tracker else "workshop"] = int(child)
    return {name: 1e-6 * PAGE * int(Path(f"/proc/{p}/statm").read_text().split()[1]) for name, p in pids.items()}


def soak(robot: Robot, layer: SoftLayer, frame: str, rate: float, minutes: float, pid: int, picture: Path) -> dict:
    """`rate` for `minutes`, with memory and latency over time, drawn and told."""
    rows: list[dict] = []
    robot.heard, robot.sent = Heard(), set()
    ended = threading.Event()

    def watch() -> None:
        started = time.monotonic()
        while not ended.wait(WINDOW):
            heard, robot.heard = robot.heard, Heard()
            latency = 1e3 * np.array([a for _, a, _ in heard.answers] or [np.nan])
            row = {"minute": (time.monotonic() - started) / 60, "answers": len(heard.answers), "models": heard.models,
                   "p50_ms": float(np.median(latency)), "p99_ms": float(np.percentile(latency, 99)),
                   "memory_mb": memory(pid)}  # fmt: skip
            rows.append(row)
            print(f"{row['minute']:6.2f} min  {row['answers']:6} answers  p50 {row['p50_ms']:6.2f}  "
                  f"p99 {row['p99_ms']:6.2f} ms  " + "  ".join(f"{k} {v:.1f} MB" for k, v in row["memory_mb"].items()),
                  flush=True)  # fmt: skip

    watching = threading.Thread(target=watch)
    watching.start()
    instants = robot.play(layer, frame, rate, 60 * minutes)
    time.sleep(0.5)
    ended.set()
    watching.join()
    answered = instants - len(robot.sent)
    warm = [row for row in rows if row["minute"] >= min(2.0, minutes / 4)] or rows
    growth = {name: float(np.polyfit([row["minute"] for row in warm], [row["memory_mb"][name] for row in warm], 1)[0])
              for name in warm[0]["memory_mb"]} if len(warm) > 1 else {}  # fmt: skip
    draw(rows, rate, picture)
    return {"rate": rate, "minutes": minutes, "instants": instants, "answered": answered,
            "growth_mb_per_minute": growth, "rows": rows}  # fmt: skip


def draw(rows: list[dict], rate: float, picture: Path) -> None:
    """Memory and latency over time."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    minutes = [row["minute"] for row in rows]
    figure, (top, bottom) = pyplot.subplots(2, 1, sharex=True, figsize=(8, 5), layout="constrained")
    for name in rows[0]["memory_mb"]:
        top.plot(minutes, [row["memory_mb"].get(name, np.nan) for row in rows], ".-", label=name)
    top.set(ylabel="resident memory [MB]", ylim=(0, None))
    top.legend(frameon=False)
    for share in ("p50", "p99"):
        bottom.plot(minutes, [row[f"{share}_ms"] for row in rows], ".-", label=share)
    bottom.set(xlabel="time [min]", ylabel="pose to displacement [ms]", yscale="log")
    bottom.legend(frameon=False)
    figure.suptitle(f"The node under {rate:g} contacts a second; a point each {WINDOW:g} s")
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=110)


def change_body(robot: Robot, layer: SoftLayer, frame: str, rate: float) -> str:
    """How long answers pause when another skin takes over."""
    robot.heard, robot.sent, known = Heard(), set(), len(robot.topologies)
    asked = time.monotonic()
    robot.body.call_async(SetBody.Request(youngs_modulus=1100.0))
    while len(robot.topologies) == known and time.monotonic() < asked + PATIENCE:
        robot.play(layer, frame, rate, 1.0)
    took = time.monotonic() - asked
    robot.play(layer, frame, rate, 1.0)
    came = np.array([at for at, _, _ in robot.heard.answers])
    return f"another skin took {took:.1f} s; the longest pause of the answers was {1e3 * np.diff(came).max():.0f} ms"


def main() -> None:
    """Prints figures; with --minutes draws a soak."""
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--rates", type=float, nargs="+", default=[100.0, 200.0, 500.0], help="of poses [Hz]")
    given.add_argument("--seconds", type=float, default=10.0, help="at each rate")
    given.add_argument("--minutes", type=float, default=0.0, help="soak at the first rate instead")
    given.add_argument("--shared", action="store_true", help="send by shared memory, not by UDP")
    given.add_argument("--models", action="store_true", help="listen to local contacts as well")
    given.add_argument("--joints", action="store_true", help="bend the elbow beside it; the contact wrench counts")
    given.add_argument("--change-body", action="store_true", help="time ~/set_body as well")
    given.add_argument("--picture", type=Path, default=Path("docs/pictures/soak.png"), help="of the soak")
    given.add_argument("--out", type=Path, default=None, help="JSON file for the figures")
    given.add_argument("--node", nargs="*", default=["tissue=paper"],
                       help="flags of stmpl node, as in tissue=paper edge-length=0.004")
    options = given.parse_args()
    _bus = bus.take_own(options.shared)  # until the end
    flags = [part for one in options.node for part in ("--" + one.split("=")[0], one.split("=")[1])]
    flags += ["--joint-states", "joint_states"] * options.joints
    print(f"{machine()}; load {os.getloadavg()[0]:.1f} before the run", flush=True)
    node = subprocess.Popen([sys.executable, "-m", "stmpl_ros.cli", "node", *flags], stdout=subprocess.DEVNULL,
                            stderr=subprocess.DEVNULL)  # fmt: skip
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))
    robot, executor, stop = Robot(options.models, options.joints), EventsExecutor(), threading.Event()
    executor.add_node(robot)
    listening = threading.Thread(target=spin, args=(executor, stop))
    listening.start()
    try:
        wait(lambda: robot.topologies or node.poll() is not None, "skin/topology")
        topology = robot.topologies[0]
        layer, frame = layer_from(topology), topology.header.frame_id
        print(f"{layer}", flush=True)
        robot.mesh.publish(tool_message(Motion(PRESS.devices[0], layer).tool, 0))
        wait(lambda: robot.pose.get_subscription_count() and robot.wrench.get_subscription_count(), "the node")
        if options.joints:
            wait(robot.states.get_subscription_count, "the node to listen to joints")
        robot.play(layer, frame, 100.0, 2.0)
        figures: dict = {"machine": machine(), "layer": str(layer)}
        if options.minutes:
            figures["soak"] = soak(robot, layer, frame, options.rates[0], options.minutes, node.pid, options.picture)
            print(json.dumps({k: v for k, v in figures["soak"].items() if k != "rows"}, indent=2))
        else:
            figures["rates"] = []
            for rate in options.rates:
                one = measure(robot, layer, frame, rate, options.seconds)
                figures["rates"].append(asdict(one))
                print(f"{one}; load {os.getloadavg()[0]:.1f}", flush=True)
        if options.change_body:
            print(change_body(robot, layer, frame, options.rates[0]))
        if options.out:
            options.out.write_text(json.dumps(figures, indent=2) + "\n")
    finally:
        stop.set()
        listening.join()
        executor.shutdown()
        node.send_signal(signal.SIGINT)
        node.wait(60)
        rclpy.shutdown()


if __name__ == "__main__":
    main()
