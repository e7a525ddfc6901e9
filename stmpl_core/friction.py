"""Friction: coefficients between skin and tools, from the literature, by pair of surfaces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stmpl_core.arrays import check_kind, is_number
from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import FRICTION

MOST = 5.0  # largest coefficient of friction that is accepted [-]; skin that is moist sticks with 1 to 3
LEAST = 1e-3  # least that acts: no tool slides as freely, and where none is told the skin sticks

Surface = Literal["typical", "dry", "moist", "oiled", "glove"]


@dataclass(frozen=True)
class Pair:
    """Two surfaces that rub.

    Args:
        friction: coefficient mu [-].
        range: spread of what was measured [-].
        source: where the numbers come from; "assumed" where nobody is quoted.
    """

    friction: float
    range: tuple[float, float]
    source: str


_VEIJGEN = "Veijgen et al., Tribol Lett 49 (2013) 251: 450 measurements, median static 0.52, dynamic 0.36"
_DERLER = "Derler & Gerhardt, Tribol Lett 45 (2012) 1: review; dry about 0.5, moist above 1, falling with pressure"
_ZHANG = "0.61 +- 0.21 on untreated skin at six places of ten people (Zhang & Mak, Prosthet Orthot Int 23 (1999) 135)"
PAIRS: dict[Surface, Pair] = {
    "typical": Pair(FRICTION, (0.36, 0.52), _VEIJGEN),
    "dry": Pair(0.5, (0.2, 0.7), _DERLER),
    "moist": Pair(1.2, (0.7, 2.0), _DERLER),
    "oiled": Pair(0.1, (0.05, 0.2), "assumed: a lubricated contact; no measurement is quoted for oil on skin"),
    "glove": Pair(0.61, (0.4, 0.82), f"rubber in place of gloves: silicone rubber, {_ZHANG}"),
}

Friction = float | str | None


def coefficient(friction: Friction) -> float:
    """Coefficient of friction mu of a number, of the name of a pair, or of None, which is 0: none is told.

    A number below LEAST is answered as that: a tool that slides freely is not one of which nothing is told.

    Raises:
        InvalidInput: a name that is not known, or a number that is not from 0 to MOST.
    """
    if friction is None:
        return 0.0
    if isinstance(friction, str):
        if friction not in PAIRS:
            raise InvalidInput(f"there is no friction '{friction}'. Available: {', '.join(PAIRS)}, or a number.")
        return PAIRS[friction].friction
    if not is_number(friction):
        raise InvalidInput(f"friction is {friction!r}; a number, the name of a pair, or these by tool are accepted.")
    if not (np.isfinite(friction) and 0 <= friction <= MOST):
        raise InvalidInput(f"friction is {friction:g}; a coefficient from 0 to {MOST:g} is accepted.")
    return max(float(friction), LEAST)


def coefficients(friction: Friction | Mapping[str, Friction]) -> tuple[float, dict[str, float]]:
    """The coefficient of all tools, and those by tool's name that differ. Raises what `coefficient` raises."""
    if isinstance(friction, Mapping):
        for name in friction:
            check_kind("the name of a tool that friction is told of", name, str)
        return 0.0, {name: coefficient(one) for name, one in friction.items()}
    return coefficient(friction), {}


def check_tools(friction: Friction | Mapping[str, Friction], names: Iterable[str]) -> None:
    """Raises InvalidInput where friction is told of a tool that is not among the names."""
    if isinstance(friction, Mapping) and (strange := set(friction) - set(names)):
        raise InvalidInput(f"friction is told of {', '.join(sorted(map(str, strange)))}, which is no tool; these are: "
                           f"{', '.join(names)}.")  # fmt: skip


def friction_from(text: str) -> Friction | dict[str, Friction]:
    """What a person writes of friction: a number, a pair's name, or either by tool: "ball: oiled, letter: 0.3".

    Args:
        text: what is said; empty or "none": none is told, and the skin sticks to the tool.

    Raises:
        InvalidInput: what is none of these, a name that is not known, or a number that is not from 0 to MOST.
    """
    if ":" not in text:
        return _one(text)
    found: dict[str, Friction] = {}
    for part in text.split(","):
        tool, colon, said = (piece.strip() for piece in part.partition(":"))
        if not (tool and colon and said) or tool in found:
            raise InvalidInput(f"'{text}' does not say the friction of each tool once, as in 'ball: oiled, "
                               "letter: 0.3' does.")  # fmt: skip
        found[tool] = _one(said)
    return found


def _one(text: str) -> Friction:
    said = text.strip()
    if said in ("", "none"):
        return None
    try:
        friction: Friction = float(said)
    except ValueError:
        friction = said
    coefficient(friction)
    return friction
