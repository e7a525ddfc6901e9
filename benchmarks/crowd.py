"""A crowd of listeners to the node, each a process that comes, hears, and goes or is killed; for benchmarks.soak."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import threading
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.signals import SignalHandlerOptions
from stmpl_msgs.msg import SkinDisplacement, SkinTopology
from stmpl_msgs.srv import GetTopology

from stmpl_ros.topics import ANSWERS, NOW

ENDINGS = CLEAN, KILLED, EARLY = "went cleanly", "were killed", "were killed early"
EARLY_S = 3.0  # longest life of a listener that is killed early [s]
PATIENCE = 60.0  # time in which a listener is to have heard something [s]
HUNG_S = 2 * PATIENCE  # life of a listener after which it hangs, and is killed [s]
PRELOADED = [__name__, "bags.wire", "stmpl_ros.scripts"]  # what a process would import each time anew


@dataclass
class Listener:
    """What became of one listener; times are since its process began [s], None: never.

    Args:
        ending: way in which it ended.
        here: whether its process began.
        discovered: time at which it knew who sends the topology.
        topology: time at which the latched topology came.
        asked: time at which `~/get_topology` gave it, which is asked only if the latched one did not come.
        answer: time at which the first answer came.
        answers: number of answers.
        gaps: number of answers that are missing between the first and the last.
        hung: whether it did not end, and was killed for it: Fast DDS 2.14.5 may go round for ever in the listener's own
            `take` of a message that it cannot read (eProsima/Fast-DDS issue 6500).
    """

    ending: str
    here: bool = False
    discovered: float | None = None
    topology: float | None = None
    asked: float | None = None
    answer: float | None = None
    answers: int = 0
    gaps: int = 0
    hung: bool = False


def listen(pipe: Connection, domain: int, ending: str, stay: float, late: float) -> None:
    """A listener, in a process of its own: tells over the pipe when it heard what, and ends.

    Args:
        pipe: pipe to who started it.
        domain: number of the bus.
        ending: way in which it ends.
        stay: time that it stays once it heard all [s].
        late: time without the topology after which it asks the service [s].
    """
    began, numbers, heard = time.monotonic(), [], set()
    pipe.send(("here", True))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO, domain_id=domain)
    node = rclpy.create_node(f"listener_{os.getpid()}")

    def tell(what: str) -> None:
        if what not in heard:
            heard.add(what)
            pipe.send((what, time.monotonic() - began))

    def on_answer(message: SkinDisplacement) -> None:
        tell("answer")
        numbers.append(message.sequence)

    found = SubscriptionEventCallbacks(matched=lambda event: tell("discovered") if event.current_count else None)
    node.create_subscription(SkinTopology, "skin/topology", lambda _: tell("topology"), NOW, event_callbacks=found)
    node.create_subscription(SkinDisplacement, "skin/displacement", on_answer, ANSWERS)
    client, asked, until = node.create_client(GetTopology, "stmpl/get_topology"), None, began + PATIENCE
    while time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.05)
        if asked is None and "topology" not in heard and time.monotonic() > began + late and client.service_is_ready():
            asked = client.call_async(GetTopology.Request())
        if asked is not None and asked.done() and asked.result().success:
            tell("asked")
        if numbers and heard & {"topology", "asked"}:
            until = min(until, time.monotonic() + stay)
    pipe.send(("answers", len(numbers)))
    pipe.send(("gaps", numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0))
    if ending == KILLED:
        os.kill(os.getpid(), signal.SIGKILL)
    node.destroy_node()
    rclpy.shutdown()


class Crowd:
    """Listeners that come one after another, a few at once.

    Args:
        domain: number of the bus.
        count: number of listeners.
        seconds: time over which they come [s].
        at_once: largest number of them at once.
        stay: longest time that one stays once it heard all [s].
        late: time without the topology after which one asks the service [s].

    Attributes:
        all: listeners, in the order of coming.
    """

    def __init__(self, domain: int, count: int, seconds: float, at_once: int, stay: float, late: float) -> None:
        self._domain, self._count, self._seconds, self._at_once = domain, count, seconds, at_once
        self._stay, self._late, self._dice = stay, late, random.Random(0)
        self._from = multiprocessing.get_context("forkserver")
        self._from.set_forkserver_preload(PRELOADED)
        self._here: list[tuple[Listener, multiprocessing.process.BaseProcess, Connection, float]] = []
        self.all: list[Listener] = []

    def run(self, ended: threading.Event) -> None:
        """Until all came and went, or `ended`."""
        began = time.monotonic()
        while (len(self.all) < self._count or self._here) and not ended.wait(0.02):
            due = began + self._seconds * len(self.all) / self._count
            if len(self.all) < self._count and len(self._here) < self._at_once and time.monotonic() >= due:
                self._start()
            self._here = [one for one in self._here if self._look(*one)]
        for _, process, *_ in self._here:
            process.kill()

    def _start(self) -> None:
        one = Listener(ENDINGS[len(self.all) % len(ENDINGS)])
        near, far = self._from.Pipe()
        stay = self._dice.uniform(0.0, self._stay)
        process = self._from.Process(target=listen, args=(far, self._domain, one.ending, stay, self._late), daemon=True)
        process.start()
        far.close()
        if one.ending == EARLY and near.poll(PATIENCE):
            threading.Timer(self._dice.uniform(0.0, EARLY_S), process.kill).start()
        self.all.append(one)
        self._here.append((one, process, near, time.monotonic()))

    @staticmethod
    def _look(one: Listener, process: multiprocessing.process.BaseProcess, pipe: Connection, began: float) -> bool:
        """Takes what a listener told; False once it is gone."""
        if not one.hung and time.monotonic() - began > HUNG_S:
            one.hung = True
            process.kill()
        alive = process.is_alive()
        try:
            while pipe.poll():
                setattr(one, *pipe.recv())
        except (EOFError, OSError):  # it ended, perhaps within a word
            alive = False
        if not alive:
            process.join()
            pipe.close()
        return alive
