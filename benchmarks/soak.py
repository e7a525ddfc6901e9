"""Listeners that come, hear the node and go, or are killed, while a tool presses: what each got, what the node kept.

python -m benchmarks.soak [--minutes 2] [--listeners 200]
python -m benchmarks.soak --minutes 60 --listeners 4000 --out soak.json

Each listener is a process that subscribes to the latched topology and to the answers. A third of them goes cleanly, a
third is killed (SIGKILL) once it heard, a third at any moment of its first seconds, so while it is being discovered.
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
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from stmpl_msgs.msg import ContactMesh, SkinTopology

from bags.wire import layer_from, pose_message, tool_message
from benchmarks.crowd import EARLY, ENDINGS, Crowd, Listener
from stmpl_core.provenance import machine
from stmpl_ros.domain import claim
from stmpl_ros.scripts import PRESS, Motion
from stmpl_ros.spinning import TRANSPORTS, UDP, spin
from stmpl_ros.topics import KEPT, NOW, STREAM

START = 300.0  # time for the node to start [s]
WINDOW_S = 5.0  # time between two readings of the node [s]
LEASE_S = 25.0  # time after which the middleware has given up who was killed, with some to spare [s]
GROWTH_MB = 10.0  # growth of the node's memory over the second half of a run that is told as a leak [MB]


@dataclass(frozen=True)
class Reading:
    """The node at one time.

    Args:
        seconds: time since the first reading [s].
        memory_mb: resident memory of the node [MB].
        threads: number of its threads.
        files: number of its open file descriptors.
        shared: number of the middleware's files in /dev/shm, of all processes.
        wrench_hz: rate of the contact wrenches since the reading before [Hz].
        listeners: number of listeners that came.
    """

    seconds: float
    memory_mb: float
    threads: int
    files: int
    shared: int
    wrench_hz: float
    listeners: int


class Presser(Node):
    """A device that presses along a script, and counts the contact wrenches that come back."""

    def __init__(self) -> None:
        super().__init__("soak")
        self.topologies: list[SkinTopology] = []
        self.wrenches = 0
        self.mesh = self.create_publisher(ContactMesh, "contact_mesh", KEPT)
        self.pose = self.create_publisher(PoseStamped, "tools/probe/pose", STREAM)
        self.create_subscription(SkinTopology, "skin/topology", self.topologies.append, NOW)
        self.create_subscription(WrenchStamped, "tools/probe/contact_wrench", self._count, STREAM)

    def _count(self, message: WrenchStamped) -> None:
        self.wrenches += 1

    def press(self, rate: float, ended: threading.Event) -> None:
        """Sends the script over and over [Hz], until `ended`."""
        topology = self.topologies[0]
        motion = Motion(PRESS.devices[0], layer_from(topology))
        self.mesh.publish(tool_message(motion.tool, 0))
        poses = [motion.at(k / rate)[0] for k in range(round(PRESS.seconds * rate))]
        started, k = time.perf_counter(), 0
        while not ended.wait(max(0.0, started + k / rate - time.perf_counter())):
            stamp = self.get_clock().now().nanoseconds
            self.pose.publish(pose_message(poses[k % len(poses)], topology.header.frame_id, stamp))
            k += 1


class Watch:
    """Readings of the node, one each WINDOW_S."""

    def __init__(self, pid: int, presser: Presser, crowd: Crowd) -> None:
        self._of, self._presser, self._crowd = Path(f"/proc/{pid}"), presser, crowd
        self._last = self._began = time.monotonic()
        self._wrenches = presser.wrenches
        self.readings: list[Reading] = []

    def look(self) -> None:
        """Takes and prints one."""
        now, wrenches = time.monotonic(), self._presser.wrenches
        rate = (wrenches - self._wrenches) / max(now - self._last, 1e-3)
        self._last, self._wrenches = now, wrenches
        memory = 1e-6 * os.sysconf("SC_PAGE_SIZE") * int((self._of / "statm").read_text().split()[1])
        counts = [len(list((self._of / what).iterdir())) for what in ("task", "fd")]
        shared = sum(1 for _ in Path("/dev/shm").glob("*fastrtps*"))
        self.readings.append(Reading(now - self._began, memory, *counts, shared, rate, len(self._crowd.all)))
        print(f"{now - self._began:7.0f} s  {memory:7.1f} MB  {counts[0]:3} threads  {counts[1]:3} files  "
              f"{shared:4} in /dev/shm  {rate:6.1f} wrenches/s  {len(self._crowd.all):5} listeners",
              flush=True)  # fmt: skip


def told(crowd: list[Listener]) -> list[str]:
    """What the listeners got, a line for each way of ending."""
    lines = []
    for ending in ENDINGS:
        these = [one for one in crowd if one.ending == ending]
        latched = [one.topology for one in these if one.topology is not None]
        p50, worst = np.percentile(latched, [50, 100]) if latched else (np.nan, np.nan)
        lines.append(f"{len(these):5} {ending:17}: latched topology {len(latched)}, after {p50:.2f} s (p50), "
                     f"{worst:.2f} s (worst), by the service {sum(one.asked is not None for one in these)}, "
                     f"answers {sum(one.answer is not None for one in these)}, "
                     f"answers missing in between {sum(one.gaps for one in these)}")  # fmt: skip
    lines.append(f"{sum(one.hung for one in crowd):5} hung by themselves")
    return lines


def verdict(crowd: list[Listener], readings: list[Reading]) -> dict[str, str]:
    """What was lost, and what leaks, each in a sentence; none where all is well.

    The listeners that were killed early are not held to have heard anything, nor are those that hung by themselves.
    """
    lived = [one for one in crowd if one.ending != EARLY and not one.hung]
    found = Counter({
        "of {} listeners did not get the latched topology": sum(one.topology is None for one in lived),
        "of {} listeners got no topology at all": sum(one.topology is None and one.asked is None for one in lived),
        "of {} listeners heard no answer": sum(one.answer is None for one in lived),
        "answers are missing between the first and the last of {} listeners": sum(one.gaps for one in lived),
    })  # fmt: skip
    said = {what: f"{count} {what.format(len(lived))}" for what, count in found.items() if count}
    first, last = readings[0], readings[-1]
    for name in ("threads", "files"):
        more = getattr(last, name) - getattr(first, name)
        if more > 0:
            said[name] = f"{more} more {name} at the end than at the start"
    half = [one.memory_mb for one in readings[len(readings) // 2 :]]
    if half[-1] - half[0] > GROWTH_MB:
        said["memory"] = f"the node grew by {half[-1] - half[0]:.1f} MB over the second half"
    if not all(one.wrench_hz for one in readings[1:]):
        said["wrenches"] = "no contact wrench came for a while"
    return said


def main() -> None:
    """Prints what every listener got, and the node over time; exits with 1 if anything was lost or leaks."""
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--minutes", type=float, default=2.0, help="time over which listeners come [min]")
    given.add_argument("--listeners", type=int, default=200, help="number of them")
    given.add_argument("--at-once", type=int, default=4, help="largest number of them at once")
    given.add_argument("--stay", type=float, default=2.0, help="longest time that one stays once it heard all [s]")
    given.add_argument("--late", type=float, default=5.0, help="time after which one asks ~/get_topology [s]")
    given.add_argument("--rate", type=float, default=100.0, help="rate of the poses [Hz]")
    given.add_argument("--settle", type=float, default=LEASE_S, help="time before the last reading [s]")
    given.add_argument("--shared-memory", action="store_true",
                       help="the node sends by shared memory too, as Fast DDS does unless told otherwise")
    given.add_argument("--domain", type=int, help="number of the bus (default: one of its own)")
    given.add_argument("--out", type=Path, default=None, help="JSON file for listeners, readings and verdict")
    given.add_argument("--node", nargs=argparse.REMAINDER, default=["-m", "stmpl_ros.cli", "node"],
                       help="arguments of Python that start the node; the last of all")  # fmt: skip
    options = given.parse_args()
    if options.domain is None:
        options.domain, _bus = claim()  # until the end
    os.environ.update(ROS_DOMAIN_ID=str(options.domain), ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET")
    print(f"{machine()}; load {os.getloadavg()[0]:.1f} before the run", flush=True)
    node = subprocess.Popen([sys.executable, *options.node], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                            env=os.environ | {TRANSPORTS: "DEFAULT" if options.shared_memory else UDP})  # fmt: skip
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))
    presser, executor, ended = Presser(), EventsExecutor(), threading.Event()
    crowd = Crowd(options.domain, options.listeners, 60 * options.minutes, options.at_once, options.stay, options.late)
    executor.add_node(presser)
    threads = [threading.Thread(target=spin, args=(executor, ended))]
    threads[0].start()

    def until(done, what: str) -> None:
        limit = time.monotonic() + START
        while not done():
            if time.monotonic() > limit or node.poll() is not None:
                raise SystemExit(f"waited for {what} in vain")
            time.sleep(0.05)

    try:
        until(lambda: presser.topologies, "skin/topology")
        threads.append(threading.Thread(target=presser.press, args=(options.rate, ended)))
        threads[1].start()
        until(lambda: presser.wrenches > 2 * options.rate, "contact wrenches")
        watch, coming = Watch(node.pid, presser, crowd), threading.Thread(target=crowd.run, args=(ended,))
        watch.look()
        threads.append(coming)
        coming.start()
        while coming.is_alive():
            coming.join(WINDOW_S)
            watch.look()
        ended.wait(options.settle)
        watch.look()
        found = verdict(crowd.all, watch.readings)
        print("\n".join(told(crowd.all)), "; ".join(found.values()) or "nothing lost, nothing leaks", sep="\n")
        if options.out:
            rows = {"listeners": list(map(asdict, crowd.all)), "readings": list(map(asdict, watch.readings))}
            options.out.write_text(json.dumps(rows | {"machine": machine(), "verdict": found}, indent=1) + "\n")
    finally:
        ended.set()
        for thread in threads:
            thread.join()
        executor.shutdown()
        node.send_signal(signal.SIGINT)
        node.wait(60)
        rclpy.shutdown()
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
