"""What the built wheel says and holds: it must install elsewhere, beside messages from a wheel of their own."""

import os
import shutil
import subprocess
import sys
import zipfile
from email import message_from_string
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("stmpl_core", "fem_tools", "bags", "stmpl_sim", "stmpl_ros", "studies")
ASKED_FOR_BY_NAME = {"smplx", "tetgen", "felupe"}  # not for commerce, AGPL, GPL


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    pytest.importorskip("setuptools", minversion="70")
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for room in ROOMS:
        shutil.copytree(ROOT / room, source / room, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("setup.py", "setup.cfg", "pyproject.toml"):
        shutil.copy(ROOT / file, source)
    code = f"from setuptools.build_meta import build_wheel; build_wheel({str(out)!r})"
    elsewhere = {name: value for name, value in os.environ.items() if name != "ROS_DISTRO"}
    subprocess.run([sys.executable, "-c", code], cwd=source, env=elsewhere, check=True, capture_output=True)
    return zipfile.ZipFile(next(out.glob("*.whl")))


@pytest.fixture(scope="module")
def requirements(wheel: zipfile.ZipFile) -> list[str]:
    metadata = next(name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return message_from_string(wheel.read(metadata).decode()).get_all("Requires-Dist", [])


def test_no_requirement_names_a_file_and_the_messages_are_an_ordinary_one(requirements: list[str]) -> None:
    assert not [line for line in requirements if "file:" in line or "@" in line]
    assert [line for line in requirements if line.startswith("stmpl-msgs==")]


def test_base_and_dev_bring_nothing_that_must_be_asked_for_by_name_and_base_no_torch(requirements: list[str]) -> None:
    base = {line.split(">=")[0].split("==")[0].split("[")[0] for line in requirements if "extra ==" not in line}
    dev = {line.split(">=")[0].split("==")[0] for line in requirements if 'extra == "dev"' in line}
    assert dev and not (base | dev) & ASKED_FOR_BY_NAME
    assert not base & {"torch", "anny", "roma", "zarr", "viser", "distributed", "shapely", "mujoco", "gymnasium"}


def test_settings_limbs_weights_and_layouts_are_inside(wheel: zipfile.ZipFile) -> None:
    held = set(wheel.namelist())
    for folder, pattern in (("stmpl_ros/config", "*.yaml"), ("stmpl_core/limbs", "*.npz"), ("stmpl_core/weights", "*"),
                            ("stmpl_ros/foxglove", "*.json"), ("stmpl_sim/models", "*.xml")):  # fmt: skip
        wanted = {f"{folder}/{path.name}" for path in (ROOT / folder).glob(pattern) if path.is_file()}
        assert wanted and wanted <= held
    assert (ROOT / "config").resolve() == ROOT / "stmpl_ros/config"


def test_a_missing_extra_is_one_sentence_with_the_pip_line(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        "import importlib.util as u; real = u.find_spec\n"
        "u.find_spec = lambda name, *a: None if name in ('viser', 'torch', 'zarr') else real(name, *a)\n"
    )
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")])
    for verb, line in (("view", "pip install 'stmpl[view]'"), ("train", "pip install 'stmpl[learn]'")):
        ended = subprocess.run([sys.executable, "-m", "stmpl_ros.cli", verb], cwd=tmp_path, capture_output=True,
                               text=True, env=os.environ | {"PYTHONPATH": path})  # fmt: skip
        assert ended.returncode == 1
        assert ended.stderr.startswith(f"stmpl: stmpl {verb} needs ") and ended.stderr.strip().endswith(line)
        assert len(ended.stderr.splitlines()) == 1
