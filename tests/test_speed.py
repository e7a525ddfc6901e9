"""Laws of benchmarks.speed: its table says old, new, aim and limit of each scene, and has its place in the docs."""

from pathlib import Path

import pytest

from benchmarks import speed

pytestmark = pytest.mark.unit
TIMES = {"fingertip, r 8 mm": {what: [[2.0] * 9, [1.0] * 9] for what in speed.WHAT},
         "band, 25 mm": {"field": [[8.0, 8.0], [4.0, 4.0]]}}  # fmt: skip
WORK = {scene: {speed.TOUCH[0]: [1e6, 0.0], speed.TOUCH[1]: [1e6, 2e6]} for scene in TIMES}


def test_a_row_says_old_and_new_aim_and_limit() -> None:
    _, _, finger, band = speed.table(TIMES, WORK, flops=1e9, rate=1e9)
    assert "2.00 → **1.00** (1.0) / 0.6" in finger and finger.endswith("| 1 | 3 |")
    assert band == "| band, 25 mm |  |  |  | 8.00 → **4.00** (1.0) / 4 |  | 1 | 3 |"


def test_the_table_goes_between_its_marks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    page, before = tmp_path / "speed.md", speed.DOCS.read_text()
    page.write_text(before)
    monkeypatch.setattr(speed, "DOCS", page)
    speed.write(["one", "two"])
    start, end = speed.MARKS
    assert f"{start}\none\ntwo\n{end}" in page.read_text()
    assert page.read_text().split(end)[1] == before.split(end)[1]
