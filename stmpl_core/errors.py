"""The error family: whatever stmpl refuses derives from StmplError, and says what, measured, allowed, what to try."""

from typing import Any


class StmplError(Exception):
    """Root of every error that stmpl raises on purpose."""


class InvalidInput(StmplError, ValueError):
    """A value that cannot be worked with: wrong shape, not finite, outside what physics allows."""


class MeshError(InvalidInput):
    """A surface that is empty, inverted, non-manifold, or folds when it is extruded."""


class FrameError(InvalidInput):
    """A pose or message in a frame that is not known."""


class NotPrepared(StmplError, RuntimeError):
    """A method was asked to solve before it was given a layer."""


class BagError(StmplError):
    """A recording that cannot be read, is truncated, or lacks what is needed to repeat it."""


def misfits(error: Any) -> str:
    """What a pydantic ValidationError found, in one line: each field, its value and what is allowed."""
    found = [(".".join(map(str, e["loc"])) or "it", e) for e in error.errors()]
    return "; ".join(f"{name} is missing" if e["type"] == "missing" else f"{name} is {e['input']!r:.60}: {e['msg']}"
                     for name, e in found)  # fmt: skip
