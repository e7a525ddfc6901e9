"""Text of a person's file, however it is named: what is no file, or is without end, is not waited for."""

from __future__ import annotations

import errno
from pathlib import Path

MOST = 4 << 20  # size that is read at most [bytes]; settings and tissues have a few thousand


def text_of(path: str | Path) -> str:
    """The text of a file, in UTF-8.

    Raises:
        OSError: no such file, one that is no regular file (a device or a pipe never ends), or one larger than MOST.
        UnicodeDecodeError: a file of something else.
    """
    path = Path(path)
    if "\0" in str(path) or (path.exists() and not path.is_file()):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    with path.open("rb") as file:
        read = file.read(MOST + 1)
    if len(read) > MOST:
        raise OSError(errno.EFBIG, f"it is larger than {MOST >> 20} MB", str(path))
    return read.decode()
