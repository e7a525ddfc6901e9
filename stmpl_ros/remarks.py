"""Remarks: what the node has to say of an answer beside what the core says."""

from __future__ import annotations

from collections.abc import Callable, Set

from stmpl_core.touch import IN_CORE, NO_FORCE, NO_TOUCH, PULLING, WRAPPED
from stmpl_core.trust import Displacement
from stmpl_ros.inbox import Instant

UNSEEN = 2e-3  # m: a tool that is deeper in its first answer was not seen coming
WORTH_A_LINE = {
    NO_FORCE: "it touches, but its wrench is zero",
    PULLING: "nothing sticks, so nothing is loaded",
    NO_TOUCH: "it presses, but no skin is within reach along its force",
    WRAPPED: "its wrench does not say how hard it squeezes",
    IN_CORE: "its pose reaches into the rigid core",
}  # log lines of statuses that a person should look at


def remarks(
    instant: Instant, answer: Displacement, seen: Set[str], rest_after: float, say: Callable[[str, str], None]
) -> str:
    """For the answer's `why`; `say` is told what a person should look at.

    Args:
        instant: that was answered.
        answer: to it.
        seen: tools of the answer before.
        rest_after: what a stream is silent for before it is lost [s].
        say: is told a kind, and a line.
    """
    said = [f"stamps of tools and wrenches lie up to {instant.skew / 1e6:.1f} ms apart"] if instant.skew else []
    for stream in instant.lost:
        said.append(f"no {stream} for {rest_after} s: answered without it")
        say(f"lost {stream}", said[-1])
    for tool, status in answer.statuses.items():
        depth = answer.trust.figures.get(f"{tool}.depth_m", 0.0)
        if tool not in seen and depth > UNSEEN:
            said.append(f"{tool} starts {1e3 * depth:.1f} mm inside the skin")
            say(f"start of {tool}", said[-1])
        if status in WORTH_A_LINE:
            say(f"{tool} {status}", f"{tool}: {status}; {WORTH_A_LINE[status]}")
    return "; ".join(said)
