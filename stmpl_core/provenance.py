"""Where figures come from: commit, versions, weights and processor, for recordings and for JSON beside weights."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGES = ("stmpl", "numpy", "scipy", "numba", "torch", "anny", "mcap", "rosbags")
WIDTHS = (("avx512f", 512), ("avx2", 256), ("sse2", 128), ("neon", 128))  # bits of a vector, by what tells of them


def versions(names: Iterable[str] | None = None) -> dict[str, str]:
    """Versions of Python and of these packages, as far as they are installed.

    Args:
        names: packages to look for; None: all that decide an answer's last bit, with the processor and the SHA-256 of
            the networks' weights.
    """
    found = {"python": platform.python_version()}
    if names is None:
        found |= {"machine": platform.machine(), "processor": processor()}
    for name in PACKAGES if names is None else names:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    for weights in sorted((HERE / "weights").glob("*.safetensors")) if names is None else ():
        found[f"weights/{weights.stem}"] = hashlib.sha256(weights.read_bytes()).hexdigest()[:16]
    return found


@cache
def processor() -> str:
    """The processor of this machine: vendor, model, code name and vector width as the compiler sees them.

    Two machines that may differ in the last bit of an answer have different ones.
    """
    from llvmlite import binding  # what numba compiles for

    features = binding.get_host_cpu_features()
    width = next((f"{bits} bit" for name, bits in WIDTHS if features.get(name)), "")
    compiled_for = os.environ.get("NUMBA_CPU_NAME") or binding.get_host_cpu_name()
    return ", ".join(filter(None, (_told("vendor_id"), _model(), compiled_for, width)))


def machine() -> str:
    """The processor's model and how many cores it has."""
    return f"{_model()}, {os.cpu_count()} cores"


def commit() -> str:
    """The commit of this code, with "+changes" if files differ from it; empty outside a repository."""
    with suppress(OSError, subprocess.SubprocessError):
        found = [subprocess.run(["git", *command], cwd=HERE, capture_output=True, text=True, check=True).stdout.strip()
                 for command in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])]  # fmt: skip
        return found[0] + ("+changes" if found[1] else "")
    return ""


def _model() -> str:
    return _told("model name") or platform.processor() or platform.machine()


def _told(what: str) -> str:
    """What Linux says of the first processor; empty elsewhere."""
    with suppress(OSError):
        if found := re.search(rf"^{what}\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return found[1].strip()
    return ""
