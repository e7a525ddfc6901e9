"""Laws of what verbs print: an example is a line, a rate is one, and nothing is said of what nobody named."""

import os
import signal
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bags.provenance import Provenance
from bags.reader import Topic
from stmpl_ros.cli import main
from stmpl_ros.tables import bag_table, provenance_sentence


@pytest.mark.parametrize("verb", ["demo", "node", "record", "replay", "info", "needs"])
def test_each_example_of_a_verb_has_a_line_of_its_own(verb: str) -> None:
    with pytest.raises(SystemExit), redirect_stdout(StringIO()) as printed:
        main([verb, "--help"])
    lines = [line for line in printed.getvalue().splitlines() if f": stmpl {verb}" in line and "usage" not in line]
    assert len(lines) > 1 and lines[0].startswith("Example: ")
    assert all(line.count(": stmpl") == 1 for line in lines)


def test_a_topic_of_few_messages_or_of_one_moment_has_no_rate() -> None:
    def rate(messages: int, seconds: float) -> str:
        bag: Any = SimpleNamespace(file="run.mcap", namespaces=[""], finished=True, damage=[])
        bag.topics = {"/a": Topic("/a", "a/msg/B", messages, 0, int(seconds * 1e9))}
        return next(iter(bag_table(bag).columns[4].cells))  # type: ignore[arg-type]

    assert rate(101, 10.0) == "10.0"
    assert rate(2, 9e-6) == rate(50, 9e-6) == rate(2, 8.0) == rate(1, 0.0) == ""


def test_what_made_a_recording_is_told_as_far_as_it_is_named() -> None:
    assert provenance_sentence(Provenance()) == ""
    assert provenance_sentence(Provenance(versions={"stmpl": "1"})) == "made by stmpl 1"
    assert provenance_sentence(Provenance("fem", "torso", {}, {"stmpl": "1"})) == (
        "method: fem; body: torso; made by stmpl 1")  # fmt: skip


def test_ctrl_c_ends_a_verb_without_a_word_from_its_first_step_on(monkeypatch, capsys) -> None:
    def interrupted(grace: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("stmpl_ros.cli._end_soon_after_a_signal", interrupted)
    monkeypatch.setattr("stmpl_ros.cli._end", sys.exit)  # which ends this process, too
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130 and capsys.readouterr() == ("", "")


@pytest.mark.parametrize(("verb", "work"), [
    (["validate"], "studies.validate.judge"), (["tables"], "studies.evaluate.evaluate"),
    (["train"], "studies.train.train"), (["calibrate"], "studies.calibrate.times"),
    (["calibrate", "--errors"], "studies.calibrate.gather"),
    (["stability"], "studies.stability.stability"), (["stability", "--fuzz", "9"], "studies.stability.fuzz.fuzz"),
    (["stability", "--critical-load"], "studies.critical_load.critical_loads"), (["sim"], "stmpl_sim.verbs.limb"),
    (["needs"], "stmpl_ros.scene.SceneConfig.needs"),
])  # fmt: skip
def test_a_place_that_cannot_be_written_to_is_refused_before_work(verb, work, tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(work, lambda *given, **named: pytest.fail("it worked first"))
    with pytest.raises(SystemExit) as ended:
        main([*verb, "--out", str(tmp_path / "file" / "x")])
    assert ended.value.code == 1 and capsys.readouterr().err.startswith(f"stmpl: {tmp_path / 'file'}")


def test_data_by_no_worker_are_refused_before_anything_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["generate", "--preset", "tiny", "--workers", "0", "--out", str(tmp_path / "data")])
    assert ended.value.code == 1 and not (tmp_path / "data").exists()
    assert capsys.readouterr().err.endswith("--workers 0 makes nothing; give 1 or more.\n")


SWALLOWED = """
import os, signal, time
from stmpl_ros import cli, interrupts
class Left:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
cli._end_soon_after_a_signal(60.0)
try:
    Left()
    time.sleep(60)
except KeyboardInterrupt as interrupt:
    print(interrupt, repr(interrupts.interrupt_in(RuntimeError("no compiled object yet"))))
"""


def test_an_interrupt_that_python_swallows_is_raised_a_moment_later_and_known_to_what_fails_by_it() -> None:
    ended = subprocess.run([sys.executable, "-c", SWALLOWED], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "15 KeyboardInterrupt(15)\n", "")


@pytest.mark.parametrize(("name", "ignored", "said"), [("stmpl", False, 0), ("stmpl", True, 0), ("mine.py", False, 1)])
def test_ctrl_c_while_the_command_is_imported_ends_it_without_a_word(name, ignored, said, tmp_path: Path) -> None:
    """Who imports stmpl hears Ctrl-C as ever; where a shell has it ignored, it stays so."""
    (tmp_path / name).write_text("import os, signal, stmpl_ros\nos.kill(os.getpid(), signal.SIGINT)\n")
    ended = subprocess.run(
        [sys.executable, tmp_path / name], capture_output=True, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.SIG_DFL),
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
    )  # fmt: skip
    assert ended.returncode == (0 if ignored else -signal.SIGINT) and ended.stderr.count("Traceback") == said


def test_the_command_hears_ctrl_c_by_itself_once_it_runs(tmp_path: Path) -> None:
    (tmp_path / "stmpl").write_text("import os, signal, sys\nfrom stmpl_ros import cli\n"
                                    "cli._run = lambda given: os.kill(os.getpid(), signal.SIGINT)\ncli.main()\n")
    ended = subprocess.run([sys.executable, tmp_path / "stmpl", "info"], capture_output=True, text=True,
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
                           env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])})  # fmt: skip
    assert (ended.returncode, ended.stdout + ended.stderr) == (130, "")


LOCKED = """
import atexit, gc, os, signal, sys, threading, weakref
from stmpl_ros import cli
lock = threading.Lock()
class Pool:
    pass
pool = Pool()
pool.itself, last = pool, weakref.ref(pool, lambda _: lock.acquire())
gc.disable()
del pool
atexit.register(print, "told")
def run(given):
    lock.acquire()  # as a pool's thread that an interrupt ended
    os.kill(os.getpid(), signal.SIGTERM)
cli._run = run
cli.main()
"""


def test_what_an_interrupt_ends_waits_for_no_lock_that_nobody_gives_back(tmp_path: Path) -> None:
    """Python's own end did, for ever: `stmpl generate`, two of 14 times."""
    (tmp_path / "stmpl").write_text(LOCKED)
    ended = subprocess.run([sys.executable, tmp_path / "stmpl", "info"], capture_output=True, text=True, timeout=60,
                           env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])})  # fmt: skip
    assert (ended.returncode, ended.stdout, ended.stderr) == (143, "told\n", "")
