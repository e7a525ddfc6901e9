"""Laws of compiled functions on disk: none outlives what it was made from."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stmpl_core.kernels import STAMP, forget_old, made_from

HELPER = "import numba\nBY = 2\n@numba.njit(cache=True)\ndef helped(x):\n    return BY * x\n"
CALLER = (
    "import numba\nfrom core.helper import helped\n@numba.njit(cache=True)\ndef asked(x):\n    return helped(x) + 1\n"
)
KEPT = "from functools import cache\n@cache\ndef plain():\n    return 2\n"
PLAIN = "def plain():\n    return 1\n"
ASK = (
    "from pathlib import Path\nfrom stmpl_core.kernels import forget_old\nforget_old([Path('core'), Path('more')])\n"
    "from core.caller import asked\nprint(asked(5))"
)


@pytest.fixture
def packages(tmp_path: Path) -> list[Path]:
    core, more = tmp_path / "core", tmp_path / "more"
    for folder in (core, more):
        folder.mkdir()
        (folder / "__init__.py").touch()
    for name, source in (("helper", HELPER), ("caller", CALLER), ("plain", PLAIN)):
        (core / f"{name}.py").write_text(source)
    forget_old([core, more])
    return [core, more]


def kept(packages: list[Path]) -> bool:
    """Whether a compiled function is still there, once the packages were looked at."""
    kernel = packages[1] / "__pycache__" / "one.asked-1.py312.nbi"
    kernel.parent.mkdir(exist_ok=True)
    kernel.touch()
    return not forget_old(packages) and kernel.exists()


@pytest.mark.parametrize("name, source, stays", [
    ("helper", HELPER.replace("BY = 2", "BY = 3"), False), ("helper", HELPER.replace("BY * x", "BY + x"), False),
    ("helper", HELPER.replace("return", '\"\"\"Told.\"\"\"\n    return'), True), ("helper", HELPER + "# said\n", True),
    ("plain", PLAIN.replace("1", "2"), True), ("plain", KEPT, True), ("plain", PLAIN + "MOST = 3\n", False),
    ("plain", "def (", True), ("other", HELPER, False),
])  # fmt: skip
def test_kernels_go_where_what_they_are_made_from_changed_anywhere_and_stay_else(packages, name, source, stays):
    assert kept(packages) and kept(packages)
    (packages[0] / f"{name}.py").write_text(source)
    assert kept(packages) == stays
    assert kept(packages), "what was looked at is known"


def test_a_caller_in_a_file_that_did_not_change_is_compiled_anew(packages):
    """numba alone goes on with the one from before."""
    where = {"cwd": packages[0].parent, "env": os.environ | {"PYTHONPATH": os.pathsep.join([str(Path.cwd()), "."])}}

    def asked() -> str:
        return subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=True, **where).stdout

    assert asked() == asked() == "11\n"
    (packages[0] / "helper.py").write_text(HELPER.replace("BY = 2", "BY = 30"))
    assert asked() == "151\n"


def test_a_broken_stamp_is_none_and_a_folder_that_cannot_be_written_is_left(packages):
    stamp = packages[0] / "__pycache__" / STAMP
    for broken in ("{", "[1]", '{"a": 1}', '{"a": [1, 2]}', '{"a": [1, [], 3]}'):
        stamp.write_text(broken)
        assert not kept(packages) and kept(packages)
    assert made_from(b"def (") == ""
