"""Optional packages: one sentence with the pip line where one is missing."""

from __future__ import annotations

from importlib.util import find_spec

from stmpl_core.errors import InvalidInput


def needed(what: str, extra: str, *packages: str) -> None:
    """Checks that optional packages are installed; call it before their import.

    Args:
        what: subject of the sentence, as in "stmpl view".
        extra: name of the extra of stmpl that brings the packages.
        packages: names of the packages, as they are imported.

    Raises:
        InvalidInput: a package is not installed.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise InvalidInput(f"{what} needs {' and '.join(missing)}: pip install 'stmpl[{extra}]'")
