"""Pages are what they say: commands succeed, links lead somewhere, the reference is up to date, the README is short."""

import re
import runpy
import shlex
import shutil
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from stmpl_core.body import Body
from stmpl_core.methods import METHODS
from stmpl_ros.cli import VERBS, main

ROOT = Path(__file__).parent.parent
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
MOST_WORDS = 700
PYTHON = re.compile(r"^```python\n(.*?)^```", flags=re.M | re.S)


BLOCK = re.compile(r"^( *)```\w*\n(.*?)^\1```", flags=re.M | re.S)
OURS = r"(stmpl (?=[a-z])|python -m (?=benchmarks|studies)|python (?=docs/|examples/))"  # commands
NAMED = re.compile(rf"(?:\w+=\S+ )*(?:\.venv/bin/)?{OURS}(.+)")
STEP = re.compile(r"^( *)```(sh|python)\n(.*?)^\1```", flags=re.M | re.S)


def steps(page: str) -> Iterator[tuple[str, str]]:
    """Kind, sh or python, and text of each command and each block of code of a page, in its order."""
    for indent, kind, block in STEP.findall((ROOT / "docs" / page).read_text()):
        text = re.sub(rf"^{indent}", "", block, flags=re.M)
        yield from [(kind, text)] if kind == "python" else ((kind, line) for line in
                                                            text.replace("\\\n", " ").splitlines())  # fmt: skip


def command(line: str) -> None:
    """Runs a command of a page here: ours, and those that copy; examples and benchmarks have tests of their own."""
    name, *arguments = shlex.split(line, comments=True)
    if name == "cp":
        shutil.copy(ROOT / arguments[0], arguments[1])
    elif name == "python" and arguments[0] == "-m":
        assert (ROOT / f"{arguments[1].replace('.', '/')}.py").is_file(), line
    elif name == "python":
        assert (ROOT / arguments[0]).is_file() and arguments[0].startswith("examples/"), line
    else:
        assert name == "stmpl", line
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 0, line


def walk(page: str, skip: str = "") -> dict[str, Any]:
    """Follows a page in this folder, all but commands with `skip` in them; the names that its code has defined."""
    names: dict[str, Any] = {}
    for kind, text in steps(page):
        if kind == "python":
            exec(compile(text, page, "exec"), names)
        elif not skip or skip not in text:
            command(text)
    return names


def lines_of_the_tutorial() -> list[str]:
    blocks = re.findall(r"^```sh\n(.*?)^```", (ROOT / "docs" / "tutorial.md").read_text(), flags=re.M | re.S)
    return [line for block in blocks for line in block.splitlines()]


def named(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Kind (stmpl, a module or a file) and words of each of our commands that a page names."""
    text = page.read_text().replace("\\\n", " ")
    rest = BLOCK.sub("", text)
    lines = [line for _, block in BLOCK.findall(text) for line in block.splitlines()]
    lines += re.findall(r"^    (.+)$", rest, flags=re.M) + re.findall(r"`([^`]+)`", rest)
    for line in lines:
        if told := NAMED.match(" ".join(line.split())):
            yield told[1].strip(), shlex.split(told[2].removesuffix("&"), comments=True)


@cache
def help_of(verb: str) -> str:
    """What `stmpl VERB --help` prints."""
    with pytest.raises(SystemExit), redirect_stdout(StringIO()) as printed:
        main([verb, "--help"])
    return printed.getvalue()


NOW = [page for page in PAGES if page.name != "CHANGELOG.md"] + [ROOT / "benchmarks" / "limbs.md"]


@pytest.mark.parametrize("page", NOW, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_name_commands_with_options_that_exist(page: Path) -> None:
    for kind, (name, *arguments) in named(page):
        file = ROOT / (f"{name.replace('.', '/')}.py" if kind.endswith("-m") else name)
        if kind != "stmpl" and not file.is_file():
            file = file.with_suffix("") / "__main__.py"
        known = help_of(name) if kind == "stmpl" else file.read_text()
        asked = arguments[: arguments.index("--ros-args")] if "--ros-args" in arguments else arguments
        for option in (word for word in asked if word.startswith("--")):
            flag = option.split("=")[0]
            assert re.search(rf"{re.escape(flag)}\b", known), f"{page.name}: {kind} {name} has no {flag}"


@pytest.mark.parametrize("line", lines_of_the_tutorial())
def test_the_tutorials_commands_succeed(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    command, *arguments = line.split()
    assert command == "stmpl"
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_every_page_is_on_the_map() -> None:
    chart = (ROOT / "docs" / "README.md").read_text()
    missing = [page.name for page in (ROOT / "docs").glob("*.md") if f"({page.name})" not in chart]
    assert missing == ["README.md"]


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().split()) < MOST_WORDS


def test_the_readmes_python_runs() -> None:
    code = PYTHON.findall((ROOT / "README.md").read_text())[0]
    layer = Body.anny().part("left_forearm")
    middle = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    ball, pose = trimesh.creation.icosphere(subdivisions=2, radius=0.012), np.eye(4)
    pose[:3, 3] = layer.vertices[middle] + 0.010 * layer.normals[middle]  # 2 mm deep
    names = {"tool_vertices": ball.vertices, "tool_faces": ball.faces, "pose_body_from_tool": pose}
    exec(compile(code, "README.md", "exec"), names)
    assert names["touches"][0].force > 0 and names["answer"].magnitude.max() > 1e-3


def test_the_simulators_pages_python_runs() -> None:
    """All of it, one block after the other, as somebody reads it."""
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    names: dict[str, Any] = {}
    for code in PYTHON.findall((ROOT / "docs" / "simulators.md").read_text()):
        exec(compile(code, "simulators.md", "exec"), names)
    assert names["touches"]["ball"].force == pytest.approx(3, rel=0.05)
    assert names["log"].force[names["circling"]].mean() == pytest.approx(5, abs=0.3)
    world = names["world"]
    assert world.force == pytest.approx(world.stiffness * (world.height - world.rest), rel=0.02)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_name_files_and_verbs_that_exist(page: Path) -> None:
    text = page.read_text()
    for verb in re.findall(r"(?:`|bin/|^    )stmpl ([a-z]+)", text, flags=re.M):
        assert verb in VERBS, f"{page.name} names the verb {verb}"
    for method in re.findall(r"--(?:node\.)?method[ =]([a-z_]+)", text):
        assert method in METHODS, f"{page.name} names the method {method}"
    for file in re.findall(r"`((?:stmpl_core|stmpl_ros|fem_tools|bags|studies|msg_defs|examples|docs)/[\w./]+)`", text):
        assert (ROOT / file).exists(), f"{page.name} names {file}"


@pytest.mark.ros  # the node is among the names
def test_the_reference_is_up_to_date() -> None:
    pytest.importorskip("gymnasium", reason="pip install 'stmpl[sim]'")
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    made = runpy.run_path(str(ROOT / "docs" / "make_api.py"))
    gone = [name for heading in made["PUBLIC"] for name in made["names"](heading) if made["find"](*name) is None]
    assert not gone, f"docs/make_api.py promises what does not exist: {gone}"
    assert made["PAGE"].read_text() == made["page"](), "run .venv/bin/python docs/make_api.py"


def test_the_python_of_time_and_slip_runs() -> None:
    code, names = PYTHON.findall((ROOT / "docs" / "time_and_slip.md").read_text())[0], {}
    exec(compile(code, "time_and_slip.md", "exec"), names)
    assert names["touch"].slip.kind == "slide" and names["kept"]


def test_the_python_of_a_limb_that_moves_runs() -> None:
    code, names = PYTHON.findall((ROOT / "docs" / "moving.md").read_text())[0], {}
    exec(compile(code, "moving.md", "exec"), names)
    assert names["touches"][0].force > 0.005 and names["simulator"].skin.angles == (0.5,)
    assert names["touches"][0].slip.share < 1  # it rides on the skin


@pytest.mark.ros  # its settings are the node's
def test_the_steps_of_a_massage_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the demo, which test_ros_demo runs: its flags are read, and the sample stands for what it leaves."""
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    pytest.importorskip("anny", reason="pip install 'stmpl[bodies]'")
    from stmpl_ros import demo

    asked = []
    monkeypatch.setattr(demo, "run", lambda config: asked.append(config) or 0)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "latest").symlink_to(ROOT / "bags" / "sample")
    names = walk("massage.md")
    (config,) = asked
    assert config.robot.robot == Path("robot.xml") and config.node.phenotype_values == {"weight": 0.7}
    assert names["log"].force[names["circling"]].mean() == pytest.approx(5, abs=0.25)
    for run in ("sim", "heavier"):
        with np.load(tmp_path / "runs" / run / "log.npz") as log:
            assert np.nanmedian(log["force"][log["asked"] > 4.9]) == pytest.approx(5, abs=0.25)


def test_the_steps_to_a_policy_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")
    pytest.importorskip("gymnasium", reason="pip install 'stmpl[sim]'")
    pytest.importorskip("warp", reason="pip install 'stmpl[gpu]'")
    monkeypatch.chdir(tmp_path)
    names = walk("learning.md")
    off = np.abs(np.linalg.norm(names["same"], axis=1) - names["force"])
    assert names["served"].mean() > 0.9 and off[names["served"]].max() < 1e-4 * names["force"].max()
    assert names["touched"].in_range.mean() > 0.7 and names["touched"].why
    assert names["found"].wrench[:3] @ names["push"] == pytest.approx(5, rel=0.02)
    assert names["learnt"][0] > names["script"][0] - 0.02 > 0.8


@pytest.mark.ros
def test_the_steps_of_a_haptics_lab_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The node is a process beside this one, as on the page."""
    rclpy = pytest.importorskip("rclpy")
    from tests.bus import running

    monkeypatch.chdir(tmp_path)
    (line,) = [text for kind, text in steps("haptics_lab.md") if kind == "sh" and text.endswith("&")]
    name, *arguments = shlex.split(line.removesuffix("&"))
    assert name == "stmpl"
    try:
        with running("-m", "stmpl_ros.cli", *arguments):
            names = walk("haptics_lab.md", skip="&")
    finally:
        if rclpy.ok():
            rclpy.shutdown()
    assert names["held"] == pytest.approx(1.18, rel=0.05) and names["given_out"] > -1e-4
    assert len(names["heard"]) > 1 and names["device"].force @ names["out"] > 0.5
    assert names["model"].grip.limit > 0.3 and np.linalg.norm(names["wrench"][:3]) > 0.5
