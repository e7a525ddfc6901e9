"""Failures on disk: an .npz with the input, which several methods may share, and a .json for each method."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from stmpl_core.errors import InvalidInput
from studies.stability.trial import Trial


def save(folder: Path, trial: Trial, method: str, found: dict[str, Any]) -> Path:
    """Writes a trial and what was found in it; returns the .json that `load` reads."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = _plain(f"{trial.axis} {trial.level}")
    arrays = folder / f"{stem}.npz"
    if not arrays.exists():
        np.savez_compressed(arrays, **trial.arrays())  # type: ignore[arg-type]
    place, of, name = method.partition(":")
    from_anywhere = f"{Path(place).resolve()}{of}{name}" if place.endswith(".py") else method
    card = {"method": from_anywhere, "arrays": arrays.name, "trial": trial.card(), "found": found}
    path = folder / f"{stem}.{_plain(method)}.json"
    path.write_text(json.dumps(card, indent=1) + "\n")
    return path


def load(path: str | Path) -> tuple[Trial, str]:
    """The trial and the method's name.

    Raises:
        InvalidInput: it is no failure that `save` wrote, or its arrays are gone.
    """
    path = Path(path)
    try:
        card = json.loads(path.read_text())
        with np.load(path.with_name(card["arrays"]), allow_pickle=False) as arrays:
            return Trial.restored(card["trial"], dict(arrays)), card["method"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInput(f"{path} is no failure that can be run again: {error!r}. Give a .json from the folder "
                           "failures/ of a stability run, with its .npz beside it.") from error  # fmt: skip


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "_", text.replace("°", "deg")).strip("_")
