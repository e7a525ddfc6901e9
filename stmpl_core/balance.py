"""Balance: a contact that would give more energy than was put into it is weakened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from stmpl_core.contact import Contact
from stmpl_core.state import Memory
from stmpl_core.touch import Pressed, Touch

GIVEN_BACK = 0.7  # share of what an elastic contact gives back that must be covered by what was put in
KEPT = 1.5  # work beyond what elastic skin could hold that is forgotten: what was lost before pays for nothing now
WEAKEST = 1e-12  # factor on a wrench that has nothing left to give: by 0 nobody could divide to find how it is pressed


class Asked(NamedTuple):
    """What a step knows of a tool before the contact law is asked.

    Args:
        contact: what the law is asked.
        stated: what was stated.
        before: memory of the step before.
        known: whether that memory is of this tool's way until now.
        twist: its way, (6,) [m, rad].
        gone: way of the contact over the skin, over its radius [-].
        kept: what has relaxed, less what follows from this step's force (see relaxation.weights), (P,) [N].
        gain: what follows, over that force, (P,) [-].
        owed, now: numbers a [N] and b [-] such that after the step a force at rest of S_e is b S_e - a.
        moved: way along its force at which the tool pressed before, where the law is asked for creeping skin [m].
    """

    contact: Contact
    stated: Contact
    before: Memory
    known: bool
    twist: np.ndarray
    gone: float
    kept: np.ndarray
    gain: np.ndarray
    owed: float
    now: float
    moved: float | None


class Law(NamedTuple):
    """What a tool does before the balance of energy.

    Args:
        touch: touch with the forces of relaxed skin and friction.
        memory: what is remembered, less work.
        stored: energy that the contact could give back [J].
        whole: energy that it could hold [J].
    """

    touch: Touch
    memory: Memory
    stored: float
    whole: float


def balanced(asked: Sequence[Asked], laws: Sequence[Law]) -> tuple[list[Touch], dict[str, Memory]]:
    """The touches, weakened where a contact would give more than was put in, and the memories with their balance.

    Memories share no array with touches, which whoever is handed them may write to.

    Work put in is the trapezoid of the wrench over the tool's way. Tools that feel each other pass energy on, so one is
    weakened only where all together lack it.
    """
    works = []
    for one, law in zip(asked, laws, strict=True):
        new = not one.known or one.stated.wrench is not None
        work = one.before.scalars.work + 0.5 * float((one.before.wrench + law.memory.wrench) @ one.twist)
        work = max(work, law.stored) if new else work
        works.append(work)
    all_stored = sum(law.stored for law in laws)
    together = sum(works) / (GIVEN_BACK * all_stored) if all_stored > 0 else 1.0
    touches, memories = [], {}
    for one, law, work in zip(asked, laws, works, strict=True):
        touch, memory, passive = law.touch, law.memory, 1.0
        if law.stored > 0:
            passive = min(1.0, max(work / (GIVEN_BACK * law.stored), together if len(laws) > 1 else 0.0, WEAKEST))
            if passive < 1:
                at_rest = one.before.scalars.work + 0.5 * float(one.before.wrench @ one.twist)
                given = 0.5 * float(memory.wrench @ one.twist)
                if len(laws) == 1 and at_rest + passive * given < 0 and given < 0:
                    passive = -at_rest / given
                passive = max(passive, WEAKEST)
                work = at_rest + passive * given
                touch = _weakened(touch, passive)
                memory = memory._replace(wrench=touch.wrench)
        work = min(work if law.stored > 0 else max(work, 0.0), KEPT * law.whole)
        memories[touch.name] = memory._replace(
            scalars=memory.scalars._replace(work=work, passive=passive), pose=memory.pose.copy(),
            wrench=memory.wrench.copy(), contact=memory.contact.copy(), imprint=memory.imprint.copy())  # fmt: skip
        touches.append(touch)
    return touches, memories


def _weakened(touch: Touch, by: float) -> Touch:
    slip = touch.slip and touch.slip._replace(wrench=touch.slip.wrench * by, lean=touch.slip.lean * by)
    return replace(touch, **scaled(touch, by, 0.0), slip=slip, passive=by)


def scaled(touch: Touch, by: float, doubt: float) -> dict[str, Any]:
    """What changes of a touch with other pressures on skin that is moved as before, by name.

    Args:
        touch: touch that presses.
        by: factor on the pressures [-].
        doubt: error of the force that comes in [N].
    """
    if by == 1.0 and not doubt:
        return {}
    assert touch.pressure is not None and touch.pressed is not None
    forces = touch.pressed.forces
    pressed: Pressed = touch.pressed._replace(factor=touch.pressed.factor * by,
                                              forces=None if forces is None else forces * by)  # fmt: skip
    return {"wrench": touch.wrench * by, "pressure": touch.pressure * by, "pressed": pressed,
            "force_bound": touch.force_bound * by + doubt}  # fmt: skip
