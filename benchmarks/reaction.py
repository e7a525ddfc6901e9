"""How soon a node says what a tool feels: contact wrench and field beside a sender, this tree and another in one run.

python -m benchmarks.reaction [--against ../before] [--bare] [--rate 1000] [--seconds 8]

`bare` is a node that does nothing but answer poses with wrenches: the limit that rclpy and the middleware set.
Messages go by UDP, as the verbs send, or with --shared by shared memory.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from stmpl_msgs.msg import ContactMesh, SkinDisplacement, SkinTopology

from bags.wire import NANO, layer_from, pose_message, tool_message, wrench_message
from benchmarks import bus
from benchmarks.node import wait
from stmpl_core.provenance import machine
from stmpl_ros.scripts import Motion, scripts_for
from stmpl_ros.spinning import spin
from stmpl_ros.topics import KEPT, NEWEST, STREAM

SCENES = {"paper": ["--tissue", "paper"], "forearm": [], "dry": ["--friction", "dry", "--relaxing"]}
BARE = "bare"
HERE = Path(__file__).resolve().parents[1]


@dataclass
class Figures:
    """What came back while poses were sent at one rate.

    Args:
        sent: instants a second [Hz].
        wrenches, fields: contact wrenches and answers a second [Hz].
        wrench_p50_ms, wrench_p99_ms: time from a pose's stamp to its contact wrench's arrival [ms].
        period_p50_ms, period_p99_ms: time between two contact wrenches [ms].
        field_p50_ms, field_p99_ms: time from a pose's stamp to its answer's arrival [ms].
        cores, own_cores: processor time of the node, and of sender and listener, a second [-].
    """

    sent: float
    wrenches: float
    wrench_p50_ms: float
    wrench_p99_ms: float
    period_p50_ms: float
    period_p99_ms: float
    fields: float
    field_p50_ms: float
    field_p99_ms: float
    cores: float
    own_cores: float

    def __str__(self) -> str:
        return (
            f"wrench {self.wrenches:5.0f} of {self.sent:.0f} Hz, latency p50 {self.wrench_p50_ms:6.2f} p99 "
            f"{self.wrench_p99_ms:6.2f} ms, period p50 {self.period_p50_ms:6.2f} p99 {self.period_p99_ms:6.2f} ms;  "
            f"field {self.fields:5.0f} Hz, p50 {self.field_p50_ms:6.2f} p99 {self.field_p99_ms:6.2f} ms;  "
            f"cores {self.cores:.2f} + {self.own_cores:.2f}"
        )


class Robot(Node):
    """A device that presses along a script in one namespace, and notes when what came back: (arrival, stamp) [ns]."""

    def __init__(self, space: str) -> None:
        super().__init__("bench", namespace=space)
        self.topologies: list[SkinTopology] = []
        self.wrenches: list[tuple[int, int]] = []
        self.fields: list[tuple[int, int]] = []
        self.mesh = self.create_publisher(ContactMesh, "contact_mesh", KEPT)
        self.pose = self.create_publisher(PoseStamped, "tools/probe/pose", NEWEST)
        self.wrench = self.create_publisher(WrenchStamped, "tools/probe/wrench", NEWEST)
        self.create_subscription(SkinTopology, "skin/topology", self.topologies.append, KEPT)
        self.create_subscription(SkinDisplacement, "skin/displacement", self._note(self.fields), STREAM, raw=True)
        topic = "tools/probe/contact_wrench"
        self.create_subscription(WrenchStamped, topic, self._note(self.wrenches), STREAM, raw=True)

    def _note(self, into: list[tuple[int, int]]):
        def note(data: bytes) -> None:
            second, nano = struct.unpack_from("<iI", data, 4)  # of the header's stamp, after the encoding
            into.append((self.now(), second * NANO + nano))

        return note

    def now(self) -> int:
        """The bus's clock [ns]."""
        return self.get_clock().now().nanoseconds

    def play(self, moments: list[tuple[PoseStamped, WrenchStamped]], rate: float, seconds: float, force: bool) -> float:
        """Sends the moments over and over; the number of instants a second that it managed."""
        started, count, k = time.perf_counter(), round(seconds * rate), 0
        while k < count:
            pose, wrench = moments[k % len(moments)]
            stamp = pose.header.stamp
            stamp.sec, stamp.nanosec = divmod(self.now(), NANO)
            if force:
                wrench.header.stamp = stamp
                self.wrench.publish(wrench)
            self.pose.publish(pose)
            k += 1
            time.sleep(max(0.0, started + k / rate - time.perf_counter()))
        return count / (time.perf_counter() - started)

    def measure(self, moments: list, rate: float, seconds: float, force: bool, node: int) -> Figures:
        """One rate; node: number of its process."""
        self.play(moments, rate, 1.5, force)
        self.wrenches.clear(), self.fields.clear()
        before = processor_time(node), processor_time(os.getpid())
        sent = self.play(moments, rate, seconds, force)
        took = processor_time(node) - before[0], processor_time(os.getpid()) - before[1]
        wrenches, fields = (np.array(list(one) or [(0, 0)], dtype=np.int64) for one in (self.wrenches, self.fields))
        late, later = (1e-6 * (one[:, 0] - one[:, 1]) for one in (wrenches, fields))
        period = 1e-6 * np.diff(wrenches[:, 0])
        pairs = [*np.percentile(late, [50, 99]), *np.percentile(period, [50, 99])]
        return Figures(sent, len(late) / seconds, *map(float, pairs), len(self.fields) / seconds,
                       *map(float, np.percentile(later, [50, 99])), cores=took[0] / seconds,
                       own_cores=took[1] / seconds)  # fmt: skip


def processor_time(pid: int) -> float:
    """Processor time that a process took so far [s]."""
    stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")


def node_of(tree: Path, space: str, flags: list[str]) -> subprocess.Popen:
    """A node of a tree, in a namespace; the bare one in that of its name."""
    path = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
    what = ["benchmarks.echo"] if space == f"/{BARE}" else ["stmpl_ros.cli", "node", *flags]
    return subprocess.Popen([sys.executable, "-m", *what, "--ros-args", "-r", f"__ns:={space}"], cwd=tree,
                            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                            env=os.environ | {"PYTHONPATH": path})  # fmt: skip


def moments_of(robot: Robot, rate: float) -> list[tuple[PoseStamped, WrenchStamped]]:
    """The script's messages on the skin that the robot heard of."""
    topology = robot.topologies[0]
    layer = layer_from(topology)
    frame, script = topology.header.frame_id, Motion(scripts_for(layer)["press"].devices[0], layer)
    robot.mesh.publish(tool_message(script.tool, 0))
    wait(robot.pose.get_subscription_count, "the node")
    time.sleep(1.0)
    told = [script.at(k / rate) for k in range(round(8 * rate))]
    return [(pose_message(pose, frame, 0), wrench_message(wrench, frame, 0)) for pose, wrench in told]


def main() -> None:
    """Prints figures."""
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--against", type=Path, default=None, help="checkout of another version, measured in turn")
    given.add_argument("--bare", action="store_true", help="measure a node that does nothing as well")
    given.add_argument("--shared", action="store_true", help="send by shared memory, not by UDP")
    given.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    given.add_argument("--rate", type=float, default=1000.0, help="of poses [Hz]")
    given.add_argument("--seconds", type=float, default=8.0, help="of each measurement")
    given.add_argument("--turns", type=int, default=2, help="measurements of each, in turn")
    given.add_argument("--field-rate", type=float, default=0.0, help="largest rate of fields of a further node [Hz]")
    given.add_argument("--force", action="store_true", help="send a wrench with each pose")
    given.add_argument("--flags", nargs="*", default=[], help="further flags of the nodes, as in edge-length=0.004")
    given.add_argument("--out", type=Path, default=None, help="JSON file for the figures")
    options = given.parse_args()
    _bus = bus.take_own(options.shared)  # until the end
    trees = {"old": options.against.resolve()} if options.against else {}
    nodes = {name: (tree, []) for name, tree in trees.items()} | {"new": (HERE, [])}
    if options.field_rate:
        nodes["paced"] = HERE, ["--field-rate", str(options.field_rate)]
    if options.bare:
        nodes[BARE] = HERE, []
    more = [part for one in options.flags for part in ("--" + one.split("=")[0], one.split("=")[1])]
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))
    print(f"{machine()}; load {os.getloadavg()[0]:.1f} before the run; {'wrenches' if options.force else 'poses'}")
    found: dict[str, dict[str, list[dict]]] = {}
    for scene in options.scenes:
        found[scene] = run(scene, nodes, SCENES[scene] + more, options)
    if options.out:
        options.out.write_text(json.dumps({"machine": machine(), "figures": found}, indent=2) + "\n")
    rclpy.shutdown()


def run(scene: str, kinds: dict[str, tuple[Path, list[str]]], flags: list[str],
        options: argparse.Namespace) -> dict[str, list[dict]]:  # fmt: skip
    """One scene, with the nodes (tree and flags, by name) in turn."""
    nodes = {name: node_of(tree, f"/{name}", flags + own) for name, (tree, own) in kinds.items()}
    robots = {name: Robot(f"/{name}") for name in kinds}
    executor, stop = EventsExecutor(), threading.Event()
    for robot in robots.values():
        executor.add_node(robot)
    listening = threading.Thread(target=spin, args=(executor, stop))
    listening.start()
    figures: dict[str, list[dict]] = {name: [] for name in kinds}
    try:
        moments = {}
        for name, robot in robots.items():
            if name == BARE:
                moments[name] = next(iter(moments.values()))
                continue
            wait(lambda one=robot, node=nodes[name]: one.topologies or node.poll() is not None, "skin/topology")
            moments[name] = moments_of(robot, options.rate)
        print(f"{scene}: {layer_from(next(iter(robots.values())).topologies[0])}", flush=True)
        for _ in range(options.turns):
            for name, robot in robots.items():
                one = robot.measure(moments[name], options.rate, options.seconds, options.force, nodes[name].pid)
                figures[name].append(asdict(one))
                print(f"  {name}: {one}", flush=True)
                time.sleep(2.0)  # until it is at rest
    finally:
        stop.set()
        listening.join()
        executor.shutdown()
        for robot in robots.values():
            robot.destroy_node()
        for node in nodes.values():
            node.send_signal(signal.SIGINT)
            node.wait(60)
    return figures


if __name__ == "__main__":
    main()
