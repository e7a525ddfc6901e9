"""What a state costs: processor time of a touch with time and slip over that of an elastic one.

    .venv/bin/python -m benchmarks.cost_of_state        # two minutes

A ball and a box are led along a slab, and a ball along a forearm as measured, by pose and by a wrench that also drags.
By wrench the stated pose is either just where elastic skin carries it, so that one trial of the depth does, or off it
by a third of the depth. Both kinds of touch are taken in turn, BLOCK of each, so that neither finds in the processor's
caches what the other just did; medians. On the forearm also of whole steps, which answer how the skin moves.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.living_limbs import site
from stmpl_core import Contact, Prony, Simulator, State, Tissue, Tool
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.methods import MomentNet, Winkler
from tests.scenes import at, ball, box, plate

SERIES = Prony((0.225, 0.225), (0.5, 5.0))
BLOCK = 15  # touches of one kind in a row
LIMB_DEPTHS = 4e-3, 9e-3  # m
DEPTHS, STEPS, STEP, DT = (1.5e-3, 3e-3), 150, 1e-5, 1e-3  # [m], [m], [s]
TOOLS = (("ball of 8 mm", ball(8e-3), 8e-3), ("box of 30 mm", box(0.03, 0.03, 0.02), 0.01))  # with its height [m]
KINDS = ("elastic", "relaxing", "friction", "both")


def simulator(kind: str) -> Simulator:
    """A slab of 7.5 mm whose tissue relaxes, or which drags, or both."""
    series = SERIES if kind in ("relaxing", "both") else None
    layer = plate(0.12, 3e-3).with_(tissue=Tissue(2e4, 0.4, relaxation=series))
    return Simulator(layer, Winkler(), friction=0.5 if kind in ("friction", "both") else None)


def limb(kind: str) -> Simulator:
    """A forearm as measured, likewise."""
    layer = living(Body.anny(), "left_forearm", edge_length=7e-3)
    if kind in ("relaxing", "both"):
        layer = layer.with_(tissue=layer.tissue.relaxing(SERIES))
    return Simulator(layer, MomentNet(), friction=0.5 if kind in ("friction", "both") else None)


def ratio(simulator: Simulator, contacts: Sequence[Contact], whole: bool = False) -> tuple[float, float]:
    """Median processor time of an elastic touch [s], and of one with a state over it; whole: of steps."""
    state, spent = State(), ([], [])

    def timed(kind: int, contact: Contact) -> None:
        nonlocal state
        began = time.thread_time()
        if kind:
            touches, state = simulator.touch([contact], state, DT)
        else:
            touches = simulator.touch([contact])
        if whole:
            simulator.answer(touches)
        spent[kind].append(time.thread_time() - began)

    for first in range(0, len(contacts), BLOCK):
        for kind in (0, 1):
            for contact in contacts[first : first + BLOCK]:
                timed(kind, contact)
    plain, remembered = (float(np.median(one[len(contacts) // 5 :])) for one in spent)
    return plain, remembered / plain


def scenes(simulator: Simulator, tool: Tool, height: float, depth: float,
           frame: np.ndarray | None = None) -> list[list[Contact]]:  # fmt: skip
    """By pose, by the wrench of that pose, and by that wrench with a pose that is off; frame: of the way, (4, 4)."""
    frame = np.eye(4) if frame is None else frame
    poses = [frame @ at(STEP * k, 0, height - depth) for k in range(STEPS)]
    wrench = np.zeros(6)
    wrench[:3] = simulator.touch([Contact(tool, poses[0])])[0].wrench[:3]
    wrench[:3] += 0.2 * np.linalg.norm(wrench[:3]) * frame[:3, 0]
    off = [frame @ at(STEP * k, 0, height - 0.67 * depth) for k in range(STEPS)]
    return [[Contact(tool, pose) for pose in poses], [Contact(tool, pose, wrench) for pose in poses],
            [Contact(tool, pose, wrench) for pose in off]]  # fmt: skip


def main() -> None:
    """Prints the table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
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
    table = Table("depth in mm", "tissue", "by pose", "by wrench", "by wrench, pose off", "whole step by pose",
                  title="a ball of 20 mm on a forearm")  # fmt: skip
    for kind in KINDS:
        sim, tool = limb(kind), ball(0.02)
        vertex = site(sim.layer, "left_forearm")
        frame = frame_of(sim.layer.normals[vertex], sim.layer.vertices[vertex])
        for depth in LIMB_DEPTHS:
            by = scenes(sim, tool, 0.02, depth, frame)
            found = [*(ratio(sim, contacts) for contacts in by), ratio(sim, by[0], whole=True)]
            table.add_row(f"{1e3 * depth:.1f}", kind, *(f"{many:.2f} ({1e6 * plain:.0f})" for plain, many in found))
    Console().print(table)


def frame_of(normal: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Frame with its z along a normal (3,), at a point, (4, 4)."""
    frame = np.eye(4)
    frame[:3, :3] = np.stack([*np.linalg.svd(normal[None])[2][1:], normal], axis=1)
    frame[:3, 0] *= np.sign(np.linalg.det(frame[:3, :3]))
    frame[:3, 3] = point
    return frame


if __name__ == "__main__":
    main()
