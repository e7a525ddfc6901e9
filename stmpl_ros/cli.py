"""The `stmpl` command: a table of verbs; each verb's module is imported when it is called, and nothing before."""

from __future__ import annotations

import atexit
import errno
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

from stmpl_ros.interrupts import endings, interrupt_in, raise_swallowed_again

TOLD_AFTER_S = 3.0  # time that kernels are compiled, before a verb tells of it [s]
SILENT = ("node", "demo", "record", "info", "recover", "foxglove", "fmu")  # verbs that compile nothing, or tell of it
GRACE = 1.5  # time in which a verb must end after Ctrl-C, SIGTERM or SIGHUP, whatever it is doing [s]
PATIENT = {"record": 30.0}  # time for verbs that have something to save [s]
VERBS = {  # module of each verb's function, and what it does
    "demo": ("stmpl_ros.verbs", "node, a robot that massages and recorder; then the run against FEM, with a report"),
    "sim": ("stmpl_sim.verbs", "a robot massages a limb in a simulator, without ROS"),
    "node": ("stmpl_ros.verbs", "answer contacts with the displacement of the skin"),
    "probe": ("stmpl_ros.verbs", "simulated devices along a script, on the skin of a running node"),
    "robot": ("stmpl_ros.verbs", "a simulated robot that massages the skin of a running node"),
    "links": ("stmpl_ros.verbs", "soft skin for a simulator over ROS: poses of links in, wrenches on links out"),
    "fmu": ("stmpl_sim.verbs", "soft skin as a unit of FMI 3.0 for co-simulation"),
    "view": ("stmpl_ros.verbs", "the skin in the browser: a recording, the running node, or under a tool to drag"),
    "foxglove": ("stmpl_ros.verbs", "the node's topics live in Foxglove, by its websocket"),
    "record": ("stmpl_ros.verbs", "record topics as MCAP, until Ctrl-C"),
    "replay": ("stmpl_ros.verbs", "answer recorded contacts again, or publish them"),
    "compare": ("stmpl_ros.verbs", "judge a recorded run by finite elements, a method or another recording"),
    "info": ("stmpl_ros.verbs", "say what a recording holds, or what a part of the body is made of"),
    "needs": ("stmpl_ros.verbs", "which parts of a tissue matter under a tool, and the smallest model"),
    "recover": ("stmpl_ros.verbs", "bring back what is sound in a recording that was not finished"),
    "generate": ("stmpl_ros.verbs", "make the data that networks learn from"),
    "train": ("studies.verbs", "train a network"),
    "tables": ("studies.verbs", "the paper's tables with every method"),
    "chart": ("studies.verbs", "speed against accuracy of every method"),
    "calibrate": ("studies.verbs", "measure what the ladder chooses by"),
    "stability": ("studies.verbs", "where methods fail"),
    "validate": ("studies.verbs", "the model beside published measurements on people"),
}


def main(arguments: list[str] | None = None) -> None:
    """Runs a verb; exits with its code, or with 1 and one sentence if it refuses."""
    given, number = list(sys.argv[1:] if arguments is None else arguments), 0
    try:
        if arguments is None:
            _end_soon_after_a_signal(PATIENT.get(given[0] if given else "", GRACE))
        code = _run(given)
        if sys.stdout:  # None: `stmpl ... >&-`
            sys.stdout.flush()
    except (KeyboardInterrupt, SystemError, RuntimeError) as error:  # a compiled call tells of one by these
        interrupt = interrupt_in(error)
        if interrupt is None:
            raise
        number = next(iter(interrupt.args), signal.SIGINT)
    except BrokenPipeError:  # `stmpl ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    if number and arguments is None:
        _end(128 + number)
    sys.exit(128 + number if number else code)


def _end(code: int) -> None:
    """Ends the process, once it has done what it is to do as it ends.

    Python does not take itself apart: a thread that an interrupt ended may have left a lock that what is deleted then
    would wait for, when the thread that ends what takes too long is gone.
    """
    for number in endings():
        signal.signal(number, signal.SIG_IGN)
    threads: Any = threading
    threads._shutdown()  # waits for them, as Python itself does first
    atexit._run_exitfuncs()
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _run(given: list[str]) -> int:
    if not given or given[0] in ("-h", "--help"):
        print(usage())
        return 0 if given else 2
    verb, *rest = given
    if verb not in VERBS:
        return _refuse(f"there is no verb '{verb}'. Verbs: {', '.join(VERBS)}.")

    import logging
    from importlib import import_module

    import tyro

    from stmpl_core.errors import StmplError, sentence_of

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    module = import_module(VERBS[verb][0])
    called = getattr(module, verb)
    if verb not in SILENT and not {"-h", "--help"} & set(rest):
        from numba.core.event import register

        from stmpl_core.compiling import Compiling

        register("numba:compile", Compiling(logging.getLogger("stmpl").info, TOLD_AFTER_S))
    if "--ros-args" in rest:
        at = rest.index("--ros-args")
        module.ros_arguments[:], rest = rest[at:], rest[:at]
    try:
        return tyro.cli(called, prog=f"stmpl {verb}", description=_said_of(called), args=rest) or 0
    except (StmplError, ValueError) as error:
        if not isinstance(error, StmplError) and type(error).__name__ != "ValidationError":
            raise
        return _refuse(sentence_of(error))
    except OSError as error:
        if error.filename is None and error.errno != errno.ENOSPC:
            raise
        return _refuse(f"{error.filename or 'the output'}: {error.strerror or error}.")


def _said_of(called: Callable) -> str:
    """What the docstring says before its arguments; each example is a paragraph, else tyro joins their lines."""
    from inspect import getdoc

    about, example, examples = (getdoc(called) or "").partition("\nArgs:")[0].partition("\nExample:")
    return about + example + "\n\n".join(line for line in examples.splitlines() if line)


def _end_soon_after_a_signal(grace: float) -> None:
    """SIGTERM and SIGHUP interrupt as Ctrl-C does; `grace` [s] after any the process ends, if it has not by itself.

    Python's own handlers run between two steps of the main thread; a compiled call may keep it for longer.
    """
    ending = endings()
    for number in ending:
        if number != signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:  # as of `stmpl ... &` in a script
            signal.signal(number, _interrupt)
    raise_swallowed_again()
    told, tell = os.pipe()
    os.set_blocking(tell, False)
    signal.set_wakeup_fd(tell, warn_on_full_buffer=False)

    def watch() -> None:
        while (number := os.read(told, 1)[0]) not in ending:
            continue
        time.sleep(grace)
        os._exit(128 + number)

    threading.Thread(target=watch, name="ending", daemon=True).start()


def _interrupt(number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt(number)


def usage() -> str:
    """The verbs, a line each."""
    lines = [f"  {verb:<10} {said}" for verb, (_, said) in VERBS.items()]
    return "\n".join(["usage: stmpl VERB ...", "", "Real-time soft-tissue contact for robots.", "", *lines, "",
                      "stmpl VERB --help says more, with an example."])  # fmt: skip


def _refuse(why: str) -> int:
    red, end = ("\033[31m", "\033[0m") if sys.stderr.isatty() else ("", "")
    print(f"{red}stmpl: {why}{end}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    main()
