"""Laws of what verbs print: an example is a line, a rate is one, and nothing is said of what nobody named."""

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
