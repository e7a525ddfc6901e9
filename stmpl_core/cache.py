"""Cache: arrays that took long to make, as files in the user's cache folder. Nothing fails for want of them."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

BROKEN = (OSError, ValueError, KeyError, EOFError, NotImplementedError, RuntimeError, MemoryError, zipfile.BadZipFile,
          zlib.error)  # fmt: skip


def folder() -> Path:
    """STMPL_CACHE_DIR, or `stmpl` in the user's own cache folder; one that cannot be, for a user without a home."""
    own = os.environ.get("STMPL_CACHE_DIR")
    if own:
        return Path(own)
    cache = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(cache) if cache else Path.home() / ".cache") / "stmpl"
    except RuntimeError:
        return Path(os.devnull) / "stmpl"


def read(name: str) -> dict[str, np.ndarray] | None:
    """The arrays that were written under a name, exact; None where there are none, or none that are sound."""
    path = folder() / f"{name}.npz"
    with suppress(*BROKEN), np.load(path, allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
        with suppress(OSError):
            os.utime(path)  # what was used last is dropped last
        return arrays
    return None


def write(name: str, arrays: Mapping[str, Any], *, packed: bool = False) -> None:
    """Keeps arrays under a name; a reader finds all of them or none. A folder that cannot be written to stays as it is.

    Args:
        name: name of the file, without its ending.
        arrays: arrays by name.
        packed: compression: a tenth of the size where many are zero, and ten times as slow.
    """
    path = folder() / f"{name}.npz"
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=path.parent, prefix=f"{name}.", suffix=".tmp", delete=False) as file:
            beside = Path(file.name)
            try:
                (np.savez_compressed if packed else np.savez)(file, **arrays)
                file.flush()
                beside.replace(path)
            finally:
                beside.unlink(missing_ok=True)


def trim(kind: str, most: float) -> None:
    """Drops the files whose names begin with `kind` that were used longest ago, until `most` bytes are left."""
    with suppress(OSError):
        files = sorted(((one.stat(), one) for one in folder().glob(f"{kind}*")), key=lambda pair: -pair[0].st_mtime)
        sizes = np.cumsum([state.st_size for state, _ in files])
        for _, path in files[int(np.searchsorted(sizes, most, side="right")) :]:
            path.unlink(missing_ok=True)
