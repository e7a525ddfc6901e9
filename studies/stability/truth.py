"""Truth: what finite elements say of a few contacts, kept beside this file.

`python -m studies.stability.truth` makes it anew, in minutes on one core: IndenterFem presses every scene with a patch
that is as fine as the tool asks for.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stmpl_core.errors import InvalidInput
from stmpl_core.tissue import Tissue
from stmpl_core.tool import Tool
from studies.stability import shapes
from studies.stability.contacts import Contacts, Placed, Truth
from studies.stability.meshes import limb, saddle
from studies.stability.scene import Mesh

FILE = Path(__file__).with_suffix(".npz")
EDGE, THICKNESS, RADIUS, LENGTH = 4e-3, 7.5e-3, 0.04, 0.16  # m
DEPTHS = (0.15 * THICKNESS, 0.4 * THICKNESS)  # m, along the tools' ways
HIGH = LENGTH / 2
FILLET = 2e-3  # m; no mesh follows a sharp edge


class Way(NamedTuple):
    """A tool, where it starts outside the skin (4, 4), and which way it goes (3,)."""

    tool: Tool
    pose: np.ndarray
    direction: np.ndarray


class Pressed(NamedTuple):
    """A scene that finite elements press.

    Args:
        mesh: mesh of the skin.
        ways: tools and their ways.
        by_wrench: flag of contacts that are given the force which finite elements find, not the pose alone.
        at_border: flag of a scene near the open border, which finite elements hold, and doubt for it.
    """

    mesh: Mesh
    ways: tuple[Way, ...]
    by_wrench: bool = False
    at_border: bool = False


@cache
def skin(poisson_ratio: float = 0.4) -> Mesh:
    """The round limb that is pressed."""
    made = limb(EDGE, RADIUS, LENGTH, THICKNESS)
    return Mesh(made.vertices, made.faces, made.thickness, Tissue(poisson_ratio=poisson_ratio), made.uv)


def from_x(tool: Tool, half: float, z: float = HIGH, turn: np.ndarray | None = None) -> Way:
    """A tool that comes to the limb along -x."""
    pose = np.eye(4)
    pose[:3, 3] = RADIUS + half + 1e-3, 0, z
    if turn is not None:
        pose[:3, :3] = turn
    return Way(tool, pose, np.array([-1.0, 0, 0]))


def border(level: float) -> Pressed:
    """A ball so many thicknesses from the open border."""
    return Pressed(skin(), (from_x(shapes.ball(0.012), 0.012, level * THICKNESS),), at_border=True)


def slant(level: float) -> Pressed:
    """A ball whose way makes this angle with the normal [degrees]."""
    angle, way = np.radians(level), from_x(shapes.ball(0.012), 0.012)
    return Pressed(skin(), (way._replace(direction=np.array([-np.cos(angle), 0, np.sin(angle)])),), True)


def kind(level: float) -> Pressed:
    """Ball, capsule, two flat punches with rounded edges, two balls, a ring on a saddle."""
    if level == 5:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
        pose[:3, 3] = 0, 0, 0.03 + 0.006 + 1e-3
        ring = Way(shapes.ring(0.03, 0.006), pose, np.array([0, 0, -1.0]))
        return Pressed(saddle(EDGE, LENGTH, 0.05, THICKNESS), (ring,))
    flat = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    balls = tuple(from_x(shapes.ball(0.008, name), 0.008, HIGH + side) for name, side in (("a", -0.012), ("b", 0.012)))
    ways = [(from_x(shapes.ball(0.012), 0.012),), (from_x(shapes.capsule(0.008, 0.02), 0.008),),
            (from_x(shapes.punch(0.008, 0.02, fillet=FILLET), 0.01, turn=flat),),
            (from_x(shapes.punch(0.015, 0.02, fillet=FILLET), 0.01, turn=flat),), balls]
    return Pressed(skin(), ways[int(level)])


def poisson_ratio(level: float) -> Pressed:
    """A ball at this Poisson's ratio."""
    return Pressed(skin(level), (from_x(shapes.ball(0.012), 0.012),))


SCENES: dict[str, tuple[Callable[[float], Pressed], tuple[float, ...]]] = {
    "border": (border, (4, 2, 1, 0.5, 0)), "slant": (slant, (0, 15, 30, 45)), "kind": (kind, (0, 1, 2, 3, 4, 5)),
    "nu of contact": (poisson_ratio, (0.3, 0.4, 0.45, 0.49)),
}  # fmt: skip


def truth(axis: str, level: float) -> Contacts:
    """The contacts of a scene, at the poses where finite elements brought the tools, and what they found there.

    Raises:
        InvalidInput: the file has no such scene, or one of another mesh.
    """
    scene, key = SCENES[axis][0](level), f"{axis} {level:g}"
    with np.load(FILE) as kept:
        if f"{key}/poses" not in kept or kept[f"{key}/motion"].shape[1] != len(scene.mesh.vertices):
            raise InvalidInput(f"{FILE.name} has no scene '{key}' of this mesh. Try python -m studies.stability.truth.")
        poses, wrenches, motion = (kept[f"{key}/{part}"] for part in ("poses", "wrenches", "motion"))
    instants = tuple(
        tuple(Placed(way.tool, pose, wrench if scene.by_wrench else None)
              for way, pose, wrench in zip(scene.ways, *at, strict=True))
        for at in zip(poses, wrenches, strict=True)
    )  # fmt: skip
    return Contacts(scene.mesh, instants, truth=Truth(wrenches[..., :3], motion.astype(float)))


def solved(scene: Pressed) -> dict[str, np.ndarray]:
    """Poses (K, T, 4, 4), wrenches (K, T, 6) and motion (K, V, 3) at DEPTHS, by finite elements.

    Raises:
        InvalidInput: a walk that stopped before, or an answer that is not to be trusted.
    """
    from fem_tools.indenter import IndenterFem
    from fem_tools.patch import PatchFem
    from fem_tools.press import Press
    from stmpl_core.sdf import SignedDistance

    solver = IndenterFem(PatchFem(refine=3, layers=2), step=0.1).prepare(scene.mesh.layer)
    presses = [Press(SignedDistance.of(way.tool), way.pose, way.direction) for way in scene.ways]
    answers = list(solver.path(presses, DEPTHS))
    if len(answers) < len(DEPTHS) or not all(a.trust.ok or scene.at_border for a in answers):
        raise InvalidInput(f"finite elements doubt it: {answers[-1].trust.why}. Try shorter steps or a finer patch.")
    return {
        "poses": np.array([[tool.pose_body_from_tool for tool in a.tools] for a in answers]),
        "wrenches": np.array([a.wrenches for a in answers]),
        "motion": np.array([a.displacement for a in answers], dtype=np.float32),
    }


def make(file: Path = FILE) -> None:
    """Solves every scene and writes the file."""
    kept: dict[str, np.ndarray] = {}
    for axis, (scene, levels) in SCENES.items():
        for level in levels:
            found = solved(scene(level))
            kept |= {f"{axis} {level:g}/{part}": values for part, values in found.items()}
            forces = np.linalg.norm(found["wrenches"][..., :3], axis=-1)
            sys.stdout.write(f"{axis} {level:g}: {forces.round(5).tolist()} N\n")
            sys.stdout.flush()
    np.savez_compressed(file, **kept)  # type: ignore[arg-type]


if __name__ == "__main__":
    make()
