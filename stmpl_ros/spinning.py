"""Starting and stopping a ROS process: SIGINT, SIGTERM and SIGHUP end it cleanly, from any of its threads."""

from __future__ import annotations

import os
import re
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.time_source import TimeSource
from rclpy.utilities import ok, try_shutdown

from stmpl_core.errors import InvalidInput
from stmpl_ros.interrupts import endings

CLOCK_TOLD_S = 30.0  # time between two lines on a clock that cannot be [s]
TOLD_AFTER_S = 5.0  # time that a node is waited for, before that is told
POLL_PERIOD_S = 0.1  # time between two looks of a spinning process whether it is to stop
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"  # variable by which a person chooses another: DEFAULT
NO_LOG = "failed to initialize logging: "  # how RCLError begins where there is no place for its files
UDP = "UDPv4?sockets_size=4MB"  # an answer overflows the usual 212 kB of a socket; what is lost is sent again, late


@contextmanager
def ros(arguments: list[str] | None = None) -> Iterator[threading.Event]:
    """ROS while inside; yields an event that signals set which end a process. rclpy's own handlers stay out of the way.

    A KeyboardInterrupt that comes out of it once that is set ends it without a word: a signal can come just where
    `interruptible` is being left.

    Messages go by UDP unless a person chose otherwise: by the shared memory of Fast DDS 2.14 a listener that is killed,
    or starved for a second, can leave its sender waiting for a lock of its own for ever (docs/laboratory/node.md).

    Raises:
        InvalidInput: arguments that ROS does not take, a file of parameters that it cannot read, a parameter of every
            node (use_sim_time) that is of another kind, or no folder for its log.
    """
    os.environ.setdefault(TRANSPORTS, UDP)
    stop = threading.Event()

    def ask(_signal: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, ask) for number in endings()}
    try:
        with _clock_above_zero():
            _init(arguments)
            yield stop
    except KeyboardInterrupt:
        if not stop.is_set():
            raise
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:  # of rclpy's own: use_sim_time
        raise InvalidInput(f"ROS does not take its arguments: {error}.") from error
    finally:
        try_shutdown()
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _clock_above_zero() -> Iterator[None]:
    """While inside, a time below 0 on /clock is passed over with a line; rclpy 7.1 raises ValueError as it spins."""
    take = TimeSource.clock_callback

    def taken(self: TimeSource, msg: Any) -> None:
        node = self._get_node()
        if msg.clock.sec >= 0:
            take(self, msg)
        elif node is not None:
            node.get_logger().warning(f"a time of {msg.clock.sec} s on /clock is passed over; it must be 0 or more.",
                                      throttle_duration_sec=CLOCK_TOLD_S)  # fmt: skip

    TimeSource.clock_callback = taken
    try:
        yield
    finally:
        TimeSource.clock_callback = take


def _init(arguments: list[str] | None) -> None:
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except UnknownROSArgsError as error:
        raise InvalidInput(f"ROS does not know what {error} means after --ros-args; it takes -p name:=value, "
                           "-r from:=to and --params-file FILE.") from error  # fmt: skip
    except RCLError as error:
        why = re.sub(r", at \S+:\d+|\s*\n\s*", "", str(error)).removeprefix("failed to initialize rcl: ")
        if why.startswith(NO_LOG):
            raise InvalidInput(f"ROS cannot write its log: {why.removeprefix(NO_LOG).rstrip('.')}. "
                               "Set ROS_LOG_DIR, or HOME, to a folder that can be written.") from error  # fmt: skip
        raise InvalidInput(f"ROS does not take its arguments: {why.rstrip('.')}.") from error


@contextmanager
def interruptible(stop: threading.Event) -> Iterator[None]:
    """While inside, signals that end a process raise KeyboardInterrupt, so that what takes long ends."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        stop.set()
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in endings()}
    try:
        yield
    except KeyboardInterrupt:
        if not stop.is_set():
            raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def spin(executor: Executor, stop: threading.Event) -> None:
    """Runs callbacks until `stop` is set or ROS shuts down.

    One call of the executor runs many callbacks: leaving and entering it for each takes as long as rclpy's share of a
    small one. Python's handlers of signals run between two callbacks, or two polls.
    """
    polls = [Future()]

    def end() -> None:
        stop.wait()
        polls[0].set_result(None)  # else an executor that always has something to do would not come back

    threading.Thread(target=end, name="stop", daemon=True).start()
    try:
        while not stop.is_set() and ok():
            polls[0] = Future()
            if not stop.is_set():  # between the two the thread may have ended the last poll
                executor.spin_until_future_complete(polls[0], timeout_sec=POLL_PERIOD_S)
    except ExternalShutdownException:
        pass
