"""Tools that press alike, where one of the two is hard to answer: parts beside each other and the whole, low and tall.

    python -m benchmarks.alike [--parts left_forearm abdomen] [--strains 0.15 0.45 0.75]     # some minutes; prints

A ball, a cylinder and a box are cut in halves and quarters, which press together; rings, tubes, blades, bars, pins and
boxes of 8 to 25 mm press with the same lower face as such of 120 mm, which columns of a limb do not lead past.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import trimesh
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.living_limbs import site
from stmpl_core import Contact, Tool
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.toucher import Toucher

PARTS = ("left_forearm", "left_upper_arm", "left_thigh", "left_calf", "abdomen")
STRAINS = (0.15, 0.3, 0.45, 0.6, 0.75)  # depths over the thickness
EDGE = 8e-3  # of the meshes [m]
HEIGHTS, TALL = (0.008, 0.012, 0.016, 0.025), 0.12  # m
MUCH = 0.1  # difference that is counted


class Pair(NamedTuple):
    """Two tools, or what several do together, that should press alike.

    Args:
        kind: what is compared.
        off: force over that of the tool that is easier to answer, less 1 [-].
        beyond: truth of the claim that the difference is more than the bound on the force.
        in_range: truth of the claim that both are in range.
    """

    kind: str
    off: float
    beyond: bool
    in_range: bool


def standing(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh, its lowest point at 0."""
    return mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])


def cut() -> dict[str, list[list[Tool]]]:
    """Tools whole, in halves and in quarters."""
    wholes = {"ball of 24 mm": trimesh.creation.icosphere(4, 0.012),
              "cylinder of 24 mm": trimesh.creation.cylinder(0.012, 0.1, sections=64),
              "box of 30 x 20 mm": trimesh.creation.box((0.03, 0.02, 0.1))}  # fmt: skip
    out = {}
    for name, whole in wholes.items():
        parts = [[standing(whole)]]
        for axis in np.eye(3)[:2]:
            parts.append([one.slice_plane((0, 0, 0), side * axis, cap=True) for one in parts[-1] for side in (1, -1)])
        out[name] = [[Tool(f"{name.split()[0]}_{len(some)}_{k}", one.vertices, one.faces) for k, one in enumerate(some)]
                     for some in parts]  # fmt: skip
    return out


def faces(height: float) -> dict[str, Tool]:
    """Tools of a height [m], by the shape of their lower face."""
    made = trimesh.creation
    meshes = {"ring": made.annulus(0.008, 0.012, height), "tube": made.annulus(0.005, 0.0065, height),
              "blade": made.box((0.03, 0.002, height)), "bar": made.box((0.03, 0.006, height)),
              "pin": made.cylinder(0.002, height), "box": made.box((0.02, 0.015, height))}  # fmt: skip
    return {name: Tool(f"{name}_{1e3 * height:.0f}", standing(mesh).vertices, mesh.faces)
            for name, mesh in meshes.items()}  # fmt: skip


def pressed(toucher: Toucher, tools: list[Tool], pose: np.ndarray) -> tuple[float, float, bool]:
    """Force of all tools together and its bound [N], and whether all are in range."""
    touches = toucher.touch_all([Contact(tool, pose) for tool in tools])
    force = float(np.linalg.norm(sum(touch.push for touch in touches)))
    return force, sum(touch.force_bound for touch in touches), all(touch.trust.in_range for touch in touches)


def pairs(part: str, strains: tuple[float, ...]) -> Iterator[Pair]:
    """All of them on a part of a body."""
    layer = living(Body.anny(), part, edge_length=EDGE)
    vertex, toucher = site(layer, part), Toucher(layer)
    pose = np.array(trimesh.geometry.align_vectors([0, 0, 1], layer.normals[vertex]))
    tall, low = faces(TALL), {height: faces(height) for height in HEIGHTS}
    scenes = [(whole, [(f"{name} in halves", halves), (f"{name} in quarters", quarters)])
              for name, (whole, halves, quarters) in cut().items()]  # fmt: skip
    scenes += [([tall[name]], [(f"{name} of {1e3 * height:.0f} mm", [low[height][name]]) for height in HEIGHTS])
               for name in tall]  # fmt: skip
    for strain in strains:
        pose[:3, 3] = layer.vertices[vertex] - strain * layer.thickness[vertex] * layer.normals[vertex]
        for easier, others in scenes:
            expected, _, sound = pressed(toucher, easier, pose)
            for kind, harder in others:
                force, bound, sure = pressed(toucher, harder, pose)
                yield Pair(kind, force / expected - 1, abs(force - expected) > bound, sound and sure)


def table(found: list[Pair]) -> Table:
    """Differences by kind, of pairs in range."""
    out = Table("pair", "pairs", "in range", "rms %", f"over {100 * MUCH:.0f} %", "worst %", "beyond its bound")
    for kind in [*dict.fromkeys(one.kind for one in found), "all"]:
        some = [one for one in found if kind in (one.kind, "all")]
        off = np.array([one.off for one in some if one.in_range])
        worst = f"{100 * off[np.abs(off).argmax()]:+.1f}" if len(off) else ""
        out.add_row(kind, str(len(some)), str(len(off)), f"{100 * np.sqrt((off**2).mean()):.1f}" if len(off) else "",
                    str(int((np.abs(off) > MUCH).sum())), worst,
                    str(sum(one.beyond for one in some if one.in_range)))  # fmt: skip
    return out


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", default=PARTS)
    parser.add_argument("--strains", nargs="+", type=float, default=STRAINS)
    options = parser.parse_args()
    found = [pair for part in track(options.parts, "parts") for pair in pairs(part, tuple(options.strains))]
    Console(width=110).print(table(found))


if __name__ == "__main__":
    main()
