"""Tools of many shapes that are dragged or turned while they press, beside finite elements on flat layers.

    .venv/bin/python -m benchmarks.dragged              # all, some ten minutes on one core
    .venv/bin/python -m benchmarks.dragged ring pair    # those whose names begin so

Each tool is pressed in straight, led by 3 mm and back (or turned by 0.15 rad and back, or slid by 12 mm), and asked at
the same poses. Drags and torques are off by the largest difference at any of these, in % of the largest of finite
elements. These are refined three times where a rim is round as narrowly as 1.5 mm: it catches on wider elements.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.slides import BACK
from benchmarks.tools import ball, fingertip, flat
from fem_tools import IndenterFem, PatchFem
from fem_tools.stroke import Stroke
from stmpl_core import Contact, Simulator, SoftLayer, State, Tissue, Tool
from stmpl_core.methods import MomentNet
from stmpl_core.sdf import SignedDistance
from tests.scenes import at, plate, turn

THERE_AND_BACK = np.array([0.2, 0.5, 1.0, 2.0, 3.0, 2.0, 1.0, 0.0]) / 3.0
LED, TURNED, SLID = 3e-3, 0.15, 12e-3  # [m], [rad], [m]
NARROW = 1.5  # radius of a rim that wants finer elements [mm]


@dataclass(frozen=True)
class Scene:
    """A tool on a flat layer.

    Args:
        name: what presses.
        tool: its surface.
        ground: "one material" or "back".
        depth: depth [mm].
        friction: coefficient of friction.
        way: "along", "across", "turned" or "slid".
        refine: how often the finite elements' patch is refined.
    """

    name: str
    tool: Tool
    ground: str
    depth: float
    friction: float
    way: str
    refine: int = 2

    @property
    def row(self) -> int:
        """Which number of a wrench is judged."""
        return {"along": 0, "slid": 0, "across": 1, "turned": 5}[self.way]

    def poses(self) -> np.ndarray:
        """From just above the skin, (N, 4, 4)."""
        depth = 1e-3 * self.depth
        down = [at(0, 0, 1e-5), *(at(0, 0, -depth * k / 4) for k in (1, 2, 3, 4))]
        if self.way == "turned":
            return np.array([*down, *(at(0, 0, -depth) @ turn((0, 0, 1), TURNED * x) for x in THERE_AND_BACK)])
        if self.way == "slid":
            return np.array([*(at(-SLID / 2, 0, 0) @ pose for pose in down),
                             *(at(SLID * (x - 0.5), 0, -depth) for x in np.arange(1, 13) / 12)])  # fmt: skip
        x, y = (1.0, 0.0) if self.way == "along" else (0.0, 1.0)
        return np.array([*down, *(at(LED * x * s, LED * y * s, -depth) for s in THERE_AND_BACK)])


def torus(middle: float, thick: float) -> Tool:
    """A ring of round wire [mm] that lies on z = 0."""
    mesh = trimesh.creation.torus(1e-3 * middle, 1e-3 * thick, major_sections=96, minor_sections=32)
    mesh.apply_translation([0, 0, 1e-3 * thick])
    return Tool("ring", mesh.vertices, mesh.faces)


def pair(radius: float, apart: float) -> Tool:
    """Two balls [mm] that are one tool, on z = 0."""
    both = [ball(radius), ball(radius)]
    shift = np.array([5e-4 * apart, 0, 0])
    return Tool("pair", np.concatenate([both[0].vertices - shift, both[1].vertices + shift]),
                np.concatenate([both[0].faces, both[1].faces + len(both[0].vertices)]))  # fmt: skip


@cache
def layer(ground: str) -> tuple[SoftLayer, int]:
    """A flat layer that is wide enough for its skin, and the elements over its thickness."""
    if ground == "back":  # skin, fat and muscle as measured there
        return plate(0.3, 6e-3, 18e-3, crossed=True).with_(tissue=BACK), 1
    return plate(0.18, 6e-3, 15e-3, crossed=True).with_(tissue=Tissue(5e3, 0.4)), 2


def scenes() -> Iterator[Scene]:
    """All scenes."""
    for ground, depth in (("one material", 3.0), ("back", 4.0)):
        yield Scene("ball, 12 mm", ball(12), ground, depth, 0.8, "along")
        for friction, way in ((0.5, "along"), (0.8, "along"), (0.8, "turned")):
            yield Scene("pad, 12 mm, rim 4 mm", flat(12, 4), ground, depth, friction, way)
        for way in ("along", "across", "turned"):
            yield Scene("capsule, 12 mm, 64 mm long", fingertip(12, 52), ground, depth, 0.8, way)
        for way in ("along", "turned"):
            yield Scene("ring, 16 mm, of 4 mm wire", torus(16, 4), ground, depth, 0.8, way)
        for way in ("along", "turned"):
            yield Scene("pair of balls of 12 mm, 60 mm apart", pair(12, 60), ground, depth, 0.8, way)
    for friction in (0.3, 0.8):
        yield Scene("pad, 12 mm, rim 1.5 mm", flat(12, NARROW), "one material", 3.0, friction, "slid", 3)
        yield Scene("pad, 20 mm, rim 4 mm", flat(20, 4), "one material", 3.0, friction, "slid")
        yield Scene("pad, 20 mm, rim 4 mm", flat(20, 4), "back", 2.0, friction, "slid")


def main() -> None:
    """Prints a table."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("names", nargs="*", help="beginnings of names of scenes; all unless given")
    names = options.parse_args().names
    table = Table(title="Dragged beside finite elements; N, of turns N mm; the force into the skin at last [N]")
    for head in ("tool", "ground", "depth [mm]", "mu", "way", "largest", "ours off", "force", "ours"):
        table.add_column(head)
    console = Console(width=140)
    for scene in track([one for one in scenes() if not names or one.name.startswith(tuple(names))], console=console):
        where, layers = layer(scene.ground)
        poses = scene.poses()
        fem = PatchFem(element="P1xP2", layers=layers, refine=scene.refine, reach=8 if scene.ground == "back" else 4,
                       check_stability=False)  # fmt: skip
        solver = IndenterFem(fem, friction=scene.friction, step=0.1).prepare(where)
        stroke = Stroke(SignedDistance.of(scene.tool, margin=0.03), poses, np.array([0.0, 0.0, -1.0]))
        truth = np.array([answer.wrenches[0] for answer in solver.follow([stroke])])
        simulator, state, ours = Simulator(where, MomentNet(), friction=scene.friction), State(), [np.zeros(6)]
        for pose in poses[1 : len(truth)]:
            (touch,), state = simulator.touch([Contact(scene.tool, pose)], state, 0.1)
            ours.append(touch.wrench)
        unit, what = 1e3 if scene.way == "turned" else 1.0, scene.row
        most = np.abs(truth[5:, what]).max()
        off = np.abs(np.array(ours)[5:, what] - truth[5:, what]).max() / most
        stopped = "" if len(truth) == len(poses) else f", to pose {len(truth)} of {len(poses)}"
        row = (scene.name, scene.ground, f"{scene.depth:g}", f"{scene.friction:g}", scene.way + stopped,
               f"{unit * most:.3g}", f"{off:.0%}", f"{-truth[-1, 2]:.3f}", f"{-ours[-1][2]:.3f}")  # fmt: skip
        console.print(" | ".join(row))
        table.add_row(*row)
    console.print(table)


if __name__ == "__main__":
    main()
