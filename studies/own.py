"""own: what a person wrote, by a name on the command line: module:attribute, file.py:attribute, or file.py alone."""

from __future__ import annotations

import runpy
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from stmpl_core.errors import InvalidInput


def own(name: str, *parts: str) -> Any:
    """The attribute of that name; of a file alone the only class in it that has these parts.

    Args:
        name: name of a module that can be imported from the working folder, or path of a .py file; then, after a
            colon, the attribute.
        parts: names of functions that the class of a file alone must have.

    Raises:
        InvalidInput: no such module, file or attribute, a file with no such class or several, or one that fails.
    """
    place, _, attribute = name.partition(":")
    if not place.endswith(".py"):
        if str(Path.cwd()) not in sys.path:  # where a person keeps a module of one's own
            sys.path.insert(0, str(Path.cwd()))
        try:
            return getattr(import_module(place), attribute)
        except SystemExit as error:
            raise InvalidInput(f"{name} could not be imported: it ends the process (exit {error.code}).") from error
        except (ImportError, AttributeError, ValueError) as error:
            raise InvalidInput(f"{name}: {error}. Give module:attribute, importable from {Path.cwd()}, or "
                               "file.py:attribute.") from error
    try:
        made = runpy.run_path(place, run_name=Path(place).stem)
    except SystemExit as error:
        raise InvalidInput(f"{place} could not be run: it ends the process (exit {error.code}).") from error
    except Exception as error:  # whatever a person's file does when it is run
        raise InvalidInput(f"{place} could not be run: {type(error).__name__}: {error}") from error
    if attribute:
        if attribute not in made:
            raise InvalidInput(f"{place} has no {attribute}.")
        return made[attribute]
    fitting = {key: value for key, value in made.items() if isinstance(value, type)
               and value.__module__ == Path(place).stem and all(callable(getattr(value, part, None)) for part in parts)}
    if not parts:
        raise InvalidInput(f"{place} holds more than one thing. Say which, as in {place}:NAME.")
    if len(fitting) != 1:
        raise InvalidInput(f"{place} has {', '.join(fitting) or 'no class'} with {' and '.join(parts)}. "
                           f"Say which, as in {place}:NAME.")  # fmt: skip
    return next(iter(fitting.values()))
