"""The error family: whatever stmpl refuses derives from StmplError, and says what, measured, allowed, what to try."""


def sentence_of(error: Exception) -> str:
    """What went wrong, in one sentence, without a library's dump of its validation (pydantic's ValidationError)."""
    if not hasattr(error, "errors"):
        return str(error)
    found = [(".".join(map(str, e["loc"])) or "the input", e) for e in error.errors()]  # type: ignore[attr-defined]
    return "; ".join(f"{name} is missing" if e["type"] == "missing" else
                     f"{name} is {e['input']!r:.60}: {e['msg'].removeprefix('Value error, ')}"
                     for name, e in found)  # fmt: skip


class StmplError(Exception):
    """Root of every error that stmpl raises on purpose."""


class InvalidInput(StmplError, ValueError):
    """A value that cannot be worked with: wrong shape, not finite, outside what physics allows."""


class MeshError(InvalidInput):
    """A surface that is empty, inverted, non-manifold, or folds when it is extruded."""


class FrameError(InvalidInput):
    """A pose or message in a frame that is not known."""


def check_millimetres(name: str, value: float, least: float) -> None:
    """Raises InvalidInput for a length above 0 but below `least` [mm], as one that is told in metres is."""
    if 0 < value < least:
        raise InvalidInput(f"{name} is {value:g}, told in millimetres; at least {least:g} is accepted. "
                           "Is it in metres? Scale it by 1e3.")  # fmt: skip


class NotPrepared(StmplError, RuntimeError):
    """A method was asked to solve before it was given a layer."""


class BagError(StmplError):
    """A recording that cannot be read, is truncated, or lacks what is needed to repeat it."""

