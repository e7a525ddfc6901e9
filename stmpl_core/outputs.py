"""Outputs: where a verb writes once its work is done is looked at before, so that no work is for nothing."""

from __future__ import annotations

import errno
import os
from pathlib import Path


def writable_folder(folder: Path) -> Path:
    """The folder, made if it is not there. Raises OSError: it is none, or cannot be written to."""
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))
    return folder


def writable_file(file: Path) -> Path:
    """The path of a file in a folder that is made if it is not there. Raises OSError: it cannot be written."""
    if file.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(file))
    writable_folder(file.parent)
    return file
