"""What a trial's laws are judged on, and what they find."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import wraps

from stmpl_core.trust import Displacement
from studies.stability.trial import Trial


@dataclass(frozen=True)
class Broken:
    """A law that an answer broke; `flagged`: the method itself says not to trust that answer."""

    law: str
    measured: str
    flagged: bool
    why: str = ""  # what the method said of the answer


@dataclass(frozen=True, eq=False)
class Answers:
    """What a method answered to a trial: to its scene, to its twin, and a fresh method's answer to the last load."""

    scene: list[Displacement]
    twin: list[Displacement]
    fresh: Displacement | None = None


Law = Callable[[Trial, Answers], Broken | None]
Found = Iterator[Broken]


def broken(law: str, measured: str, *answers: Displacement) -> Broken:
    """What breaks a law; flagged if one of the answers is."""
    flagged = [answer for answer in answers if not answer.trust.ok]
    return Broken(law, measured, bool(flagged), flagged[0].trust.why if flagged else "")


def worst(law: Callable[[Trial, Answers], Found]) -> Law:
    """A law of what it finds: of all that is broken what is not flagged counts, else the first."""

    @wraps(law)
    def judged(trial: Trial, answers: Answers) -> Broken | None:
        found = list(law(trial, answers))
        return next((one for one in found if not one.flagged), found[0] if found else None)

    return judged
