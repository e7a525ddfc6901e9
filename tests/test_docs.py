"""The tutorial runs as it is written, and no page links to a file that is not there."""

import re
from pathlib import Path

import pytest

from stmpl_ros.cli import main

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    """The page's blocks in this language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.M | re.S)


def test_the_tutorials_python_runs() -> None:
    names: dict = {}
    for k, block in enumerate(blocks(ROOT / "docs" / "tutorial.md", "python")):
        exec(compile(block, f"tutorial.md, block {k + 1}", "exec"), names)
    assert names["answer"].trust.ok and names["loop"]


@pytest.mark.parametrize("line", [
    line for block in blocks(ROOT / "docs" / "tutorial.md", "sh") for line in block.splitlines()])  # fmt: skip
def test_the_tutorials_commands_succeed(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    command, *arguments = line.split()
    assert command == "stmpl"
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"
