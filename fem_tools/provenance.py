"""Where figures come from: data, commit, versions and machine, for the JSON beside weights and tables."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


def data_card(path: str | Path, manifest: dict[str, Any]) -> dict[str, Any]:
    """A data set's preset, seed, size and the SHA-256 of its manifest."""
    digest = hashlib.sha256((Path(path) / "manifest.json").read_bytes()).hexdigest()
    plan = manifest["plan"]
    return {"preset": plan["preset"], "seed": plan["seed"], "samples": manifest["samples"], "manifest_sha256": digest}


def commit() -> str:
    """The commit of this code, with "+changes" if files differ from it; empty outside a repository."""
    with suppress(OSError, subprocess.SubprocessError):
        here = Path(__file__).resolve().parent
        found = [subprocess.run(["git", *command], cwd=here, capture_output=True, text=True, check=True).stdout.strip()
                 for command in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])]  # fmt: skip
        return found[0] + ("+changes" if found[1] else "")
    return ""


def versions(names: Iterable[str]) -> dict[str, str]:
    """Of these packages, those that are installed, and of Python."""
    found = {"python": platform.python_version()}
    for name in names:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def machine() -> str:
    """The processor and how many of it, by its own name where the system tells it."""
    name = platform.processor() or platform.machine()
    with suppress(OSError):
        if found := re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text()):
            name = found[1].strip()
    return f"{name}, {os.cpu_count()} cores"
