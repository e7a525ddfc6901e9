"""What a state costs: processor time of a touch with time and slip over that of an elastic one.

    .venv/bin/python -m benchmarks.cost_of_state        # half a minute

A ball and a box are led along a slab, by pose and by a wrench that also drags. By wrench the stated pose is either just
where elastic skin carries it, so that one trial of the depth does, or off it by a third of the depth. Both kinds of
touch are taken in turn; medians.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from stmpl_core import Contact, Prony, Simulator, State, Tissue, Tool
from stmpl_core.methods import Winkler
from tests.scenes import at, ball, box, plate

SERIES = Prony((0.225, 0.225), (0.5, 5.0))
DEPTHS, STEPS, STEP, DT = (1.5e-3, 3e-3), 150, 1e-5, 1e-3  # [m], [m], [s]
TOOLS = (("ball of 8 mm", ball(8e-3), 8e-3), ("box of 30 mm", box(0.03, 0.03, 0.02), 0.01))  # with its height [m]
KINDS = ("elastic", "relaxing", "friction", "both")


def simulator(kind: str) -> Simulator:
    """A slab of 7.5 mm whose tissue relaxes, or which drags, or both."""
    series = SERIES if kind in ("relaxing", "both") else None
    layer = plate(0.12, 3e-3).with_(tissue=Tissue(2e4, 0.4, relaxation=series))
    return Simulator(layer, Winkler(), friction=0.5 if kind in ("friction", "both") else None)


def ratio(simulator: Simulator, contacts: Sequence[Contact]) -> tuple[float, float]:
    """Median processor time of an elastic touch [s], and of one with a state over it."""
    state, spent = State(), np.empty((len(contacts), 2))
    for k, contact in enumerate(contacts):
        began = time.thread_time()
        simulator.touch([contact])
        between = time.thread_time()
        _, state = simulator.touch([contact], state, DT)
        spent[k] = between - began, time.thread_time() - between
    plain, remembered = np.median(spent[len(contacts) // 5 :], axis=0)
    return float(plain), float(remembered / plain)


def scenes(simulator: Simulator, tool: Tool, height: float, depth: float) -> list[list[Contact]]:
    """By pose, by the wrench of that pose, and by that wrench with a pose that is off."""
    poses = [at(STEP * k, 0, height - depth) for k in range(STEPS)]
    wrench = np.zeros(6)
    wrench[2] = simulator.touch([Contact(tool, poses[0])])[0].wrench[2]
    wrench[0] = 0.2 * abs(wrench[2])
    off = [at(STEP * k, 0, height - 0.67 * depth) for k in range(STEPS)]
    return [[Contact(tool, pose) for pose in poses], [Contact(tool, pose, wrench) for pose in poses],
            [Contact(tool, pose, wrench) for pose in off]]  # fmt: skip


def main() -> None:
    """Prints the table."""
    table = Table("tool", "depth in mm", "tissue", "by pose", "by wrench", "by wrench, pose off",
                  title="processor time with a state over an elastic touch (and that in us)")  # fmt: skip
    for kind in KINDS:
        sim = simulator(kind)
        for name, tool, height in TOOLS:
            for depth in DEPTHS:
                found = [ratio(sim, contacts) for contacts in scenes(sim, tool, height, depth)]
                cells = [f"{many:.2f} ({1e6 * plain:.0f})" for plain, many in found]
                table.add_row(name, f"{1e3 * depth:.1f}", kind, *cells)
    Console().print(table)


if __name__ == "__main__":
    main()
