"""A robot's end of the ROS bus, and the processes at its other end. conftest.py gives each test process its own bus."""

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rcl_interfaces.msg import Log
from rclpy.executors import SingleThreadedExecutor
from stmpl_msgs.msg import SkinDisplacement, SkinTopology

from bags.wire import stamp_ns
from stmpl_ros.domain import DOMAINS
from stmpl_ros.topics import KEPT, STREAM

ROOT = Path(__file__).parents[1]
AGAIN = 2_000_000_000  # ns after which an instant without an answer is sent once more: inputs are best effort
PATIENCE = 120.0  # s to wait for anything; only a failing test waits so long


def wait_for(done: Callable[[], Any], what: str, *nodes: rclpy.node.Node, seconds: float = PATIENCE) -> Any:
    """What `done` returns once it is true, with the nodes spinning meanwhile."""
    until = time.monotonic() + seconds
    while not (found := done()):
        assert time.monotonic() < until, f"waited {seconds} s for {what}"
        for node in nodes:
            rclpy.spin_once(node, timeout_sec=0.02 / len(nodes))
    return found


@contextmanager
def in_process(make: Callable[[rclpy.Context], Any]) -> Iterator[tuple[Any, rclpy.node.Node, Callable[..., None]]]:
    """A node in this process, another beside it, and `wait(done, do)`: both spin, and `do` is done, until `done`."""
    context = rclpy.Context()
    context.init(domain_id=int(os.environ["ROS_DOMAIN_ID"]) + DOMAINS)
    executor = SingleThreadedExecutor(context=context)
    node, other = make(context), rclpy.create_node("other", context=context)

    def wait(done: Callable[[], object], do: Callable[[], object] = lambda: None) -> None:
        until = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < until
            do()
            executor.spin_once(timeout_sec=0.005)

    try:
        executor.add_node(node)
        executor.add_node(other)
        yield node, other, wait
    finally:
        executor.shutdown()
        node.destroy_node()
        other.destroy_node()
        context.try_shutdown()
        context.destroy()


def start(*arguments: str, **options: Any) -> subprocess.Popen:
    """A Python process from the repository's root with these arguments."""
    return subprocess.Popen([sys.executable, "-X", "faulthandler", *arguments], stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, text=True, cwd=ROOT, **options)  # fmt: skip


def end(process: subprocess.Popen, number: int | None = None) -> tuple[int, str]:
    """Exit code of a process and what it said, after a signal if one is given; of one that hangs, where it does."""
    if number is not None:
        process.send_signal(number)
    try:
        said, _ = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # faulthandler tells of each thread, whatever holds the interpreter
        said, _ = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    return process.returncode, said


@contextmanager
def running(*arguments: str, number: int = signal.SIGTERM):
    """A Python process that ends cleanly when asked to."""
    process = start(*arguments)
    try:
        yield process
        code, said = end(process, number)
        assert code == (0 if number != signal.SIGKILL else -signal.SIGKILL), said
    finally:
        if process.poll() is None:
            process.kill()
            print(process.communicate()[0])


def rows(answer: SkinDisplacement) -> np.ndarray:
    """The displacement of an answer, (V, 3) [m]."""
    return np.frombuffer(answer.displacement, np.float32).reshape(-1, 3)


def statuses(answer: SkinDisplacement) -> dict[str, str]:
    """The status of each tool of an answer."""
    return {touch.tool: touch.status for touch in answer.touches}


class Robot:
    """A node that hears the skin, and waits."""

    def __init__(self, name: str, space: str = "") -> None:
        self.space, self.got = space, defaultdict(list)
        self.partner: subprocess.Popen | None = None  # process that is waited for; None: nobody looks whether it lives
        self.node = rclpy.create_node(name, namespace=space or "/")
        self.listen(SkinTopology, "skin/topology", KEPT)
        self.listen(SkinDisplacement, "skin/displacement", STREAM)
        self.listen(Log, "/rosout", KEPT)

    def listen(self, kind: type, topic: str, profile: Any, **more: Any) -> Any:
        return self.node.create_subscription(kind, topic, self.got[topic].append, profile, **more)

    def now(self) -> int:
        """The bus's clock [ns]."""
        return self.node.get_clock().now().nanoseconds

    def wait(self, done: Callable[[], Any], what: str) -> Any:
        return wait_for(lambda: done() or self._alone(), what, self.node)

    def _alone(self) -> None:
        if self.partner and (code := self.partner.poll()) is not None:
            raise AssertionError(f"the process ended with {code}: {self.partner.communicate()[0]}")

    def spin(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            rclpy.spin_once(self.node, timeout_sec=0.02)

    def said(self, text: str) -> list[str]:
        """Log lines of the node that hold `text`."""
        return [line.msg for line in self.got["/rosout"] if text in line.msg]

    def still(self) -> None:
        """Waits until the skin is at rest, so that no other tool is waited for."""
        self.wait(lambda: not (said := self.got["skin/displacement"]) or not said[-1].touches, "rest")

    def answers(self, stamp: int) -> list[SkinDisplacement]:
        """Answers to the instant `stamp` [ns]."""
        return [answer for answer in self.got["skin/displacement"] if stamp_ns(answer) == stamp]

    def answer(self, send: Callable[[], int]) -> SkinDisplacement:
        """The answer to an instant, which is sent by `send`, that returns its stamp [ns], until one is answered."""
        stamps: list[int] = []

        def answered() -> list[SkinDisplacement]:
            if not stamps or self.now() - stamps[-1] > AGAIN:
                stamps.append(send())
            return [answer for stamp in stamps for answer in self.answers(stamp)]

        return self.wait(answered, "an answer")[0]
