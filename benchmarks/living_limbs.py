"""A ball of 40 mm on four parts of a body as measured, skin, fat and muscle: finite elements, and the fast answer.

    .venv/bin/python -m benchmarks.living_limbs     # writes docs/pictures/living_limbs.png; about ten minutes
    .venv/bin/python -m benchmarks.living_limbs --trunk     # 5 N on back, abdomen, neck and shoulder; prints

Finite elements press the ball in along the skin's normal; the answer gets each pose, and then each force. Both on the
same mesh; times on that mesh and on one of 3 mm, on one core: set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
from functools import cache
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import trimesh

from benchmarks.inference import timed
from fem_tools import IndenterFem, PatchFem, Press
from stmpl_core import Contact, SoftLayer, Tool
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "living_limbs.png"
RADIUS = 0.02  # of the ball [m]
PARTS = {"forearm": ("left_forearm", 7e-3), "upper arm": ("left_upper_arm", 8e-3), "thigh": ("left_thigh", 11e-3),
         "back": ("torso", 10e-3)}  # part, edges of the mesh that finite elements get [m]  # fmt: skip
TRUNK = {"back": 6e-3, "left_shoulder": 8e-3, "neck": 8e-3, "abdomen": 14e-3}  # part, edges likewise
TRUNK_REACH = 3.0  # [thicknesses]: the parts themselves reach little further
SITES = {  # of the trunk's: place near a vertex, and the way its skin faces
    "back": ((-0.06, 0.06, 0.33), (-1, 0, 0)), "abdomen": ((0.12, 0.04, 0.17), (1, 0, 0)),
    "neck": ((-0.03, 0.01, 0.54), (-1, 0, 0)), "left_shoulder": ((0.02, 0.24, 0.42), (0, 0.8, 0.6)),
}  # fmt: skip
STRAINS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # depths over the thickness under the ball
FORCES = (5.0, 20.0, 50.0)  # N


class Compared(NamedTuple):
    """One depth: strain, depth [mm], true force, the share of it that pressures along the skin's normals at rest make,
    our force with its bound [N], motion off [% of the peak]: mean where it moves more than a tenth of that, and at the
    worst vertex; in range or why not."""

    strain: float
    depth: float
    truth: float
    kept: float
    force: float
    bound: float
    moves: float
    worst: float
    why: str


@cache
def ball(radius: float, subdivisions: int = 4) -> Tool:
    """A ball about its middle."""
    mesh = trimesh.creation.icosphere(subdivisions, 1e3 * radius)
    return Tool("ball", 1e-3 * np.asarray(mesh.vertices), np.asarray(mesh.faces))


def site(layer: SoftLayer, part: str) -> int:
    """A vertex in the middle of a limb where the tissue is thick; on the back beside the spine, high up."""
    v = layer.vertices
    if part in SITES:
        place, way = (np.array(each) for each in SITES[part])
        return int(np.where(layer.normals @ way > 0.6, np.linalg.norm(v - place, axis=1), 9).argmin())
    if part == "torso":
        wanted = np.array([v[:, 1].mean() + 0.06, v[:, 2].min() + 0.7 * np.ptp(v[:, 2])])
        return int(np.where(layer.normals[:, 0] < -0.6, np.linalg.norm(v[:, 1:] - wanted, axis=1), 9).argmin())
    axis = np.linalg.svd(v - v.mean(axis=0), full_matrices=False)[2][0]
    middle = np.abs((v - v.mean(axis=0)) @ axis) < 0.035
    return int(np.where(middle & (layer.thickness < np.median(layer.thickness) + 8e-3), layer.thickness, 0).argmax())


class Truth(NamedTuple):
    """Finite elements at some depths of a part: strains, (D,); poses of the ball, (D, 4, 4); forces along its way, and
    of their pressures along the skin's normals at rest alone [N], (D,) each; and motion of the skin [m], (D, V, 3)."""

    strains: np.ndarray
    poses: np.ndarray
    forces: np.ndarray
    projected: np.ndarray
    moved: np.ndarray


def solved(part: str, edge: float, strains: tuple[float, ...] = STRAINS, reach: float = 9) -> Truth:
    """Finite elements within a reach [thicknesses], at those strains that they get to."""
    layer = living(Body.anny(), part, edge_length=edge)
    vertex = site(layer, part)
    normal, thickness = layer.normals[vertex], float(layer.thickness[vertex])
    pose = np.eye(4)
    pose[:3, 3] = layer.vertices[vertex] + (RADIUS + 0.01) * normal
    start = Press(SignedDistance.of(ball(RADIUS), margin=0.04), pose, -normal).touching(layer)
    assert start is not None
    fem = IndenterFem(PatchFem(element="P1xP2", reach=reach, refine=3, layers=1), step=0.1).prepare(layer)
    depths, rows = [strain * thickness for strain in strains], []
    for strain, depth, truth in zip(strains, depths, fem.path([start], depths), strict=True):
        if not truth.trust.ok:
            break
        projected = -(truth.pressure @ layer.vertex_area_vectors) @ start.direction
        rows.append((strain, start.at(depth).pose_body_from_tool, truth.force, projected, truth.displacement))
    return Truth(*(np.array(column) for column in zip(*rows, strict=True)))


def compare(part: str, edge: float, truths: Truth) -> list[Compared]:
    """The answer beside finite elements."""
    layer = living(Body.anny(), part, edge_length=edge)
    thickness = float(layer.thickness[site(layer, part)])
    simulator, out = Simulator(layer, MomentNet()), []
    for strain, pose, force, projected, displacement in zip(*truths, strict=True):
        answer = simulator.step([Contact(ball(RADIUS), pose)])
        touch, moved = answer.touches["ball"], np.linalg.norm(displacement, axis=1)
        off = 100 * np.linalg.norm(answer.displacement - displacement, axis=1) / moved.max()
        where_it_moves = float(off[moved > 0.1 * moved.max()].mean())
        out.append(Compared(float(strain), 1e3 * strain * thickness, float(force), float(projected / force),
                            touch.force, touch.force_bound, where_it_moves, float(off.max()),
                            answer.trust.why))  # fmt: skip
    return out


def kept(folder: Path | None, part: str, edge: float) -> Truth:
    """Finite elements of a part, read from a folder where they are there, else solved, and kept there."""
    if folder is None:
        return solved(part, edge)
    if not (file := folder / f"{part}.npz").exists():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(file, **solved(part, edge)._asdict())
    with np.load(file) as read:
        return Truth(**{name: read[name] for name in Truth._fields})


def trunk(part: str, edge: float, force: float = 5.0) -> None:
    """Prints what a ball does that is pressed with a force, and finite elements at the depth that it comes to."""
    layer = living(Body.anny(), part, edge_length=edge)
    vertex, simulator = site(layer, part), Simulator(layer, MomentNet())
    normal, thickness, pose = layer.normals[vertex], float(layer.thickness[vertex]), np.eye(4)
    pose[:3, 3] = layer.vertices[vertex] + (RADIUS - 0.2 * thickness) * normal
    wrench = np.concatenate([-force * normal, np.zeros(3)])
    touch = simulator.touch([Contact(ball(RADIUS), pose, wrench)])[0]  # where the force is carried
    answer = simulator.step([Contact(ball(RADIUS), touch.pose_body_from_tool, wrench)])
    touch = answer.touches["ball"]
    print(f"{part}: {1e3 * thickness:.0f} mm thick, {force:g} N: {1e3 * touch.depth:.1f} mm deep, "
          f"{answer.trust.why or 'unflagged'}")  # fmt: skip
    (row,) = compare(part, edge, solved(part, edge, (touch.depth / thickness,), reach=TRUNK_REACH))
    print(f"    at that depth finite elements {row.truth:.2f} N, ours {row.force:.2f} +- {row.bound:.2f} N "
          f"({100 * (row.force / row.truth - 1):+.1f} %); motion off {row.moves:.1f} %, worst {row.worst:.1f} % "
          f"of the peak {row.why}")  # fmt: skip


def times(part: str, edge: float) -> None:
    """Prints times on a mesh of such edges [m], by pose and by wrench."""
    layer = living(Body.anny(), part, edge_length=edge)
    simulator, vertex, tool = Simulator(layer, MomentNet()), site(layer, part), ball(RADIUS)
    normal, thickness = layer.normals[vertex], float(layer.thickness[vertex])
    print(f"  {len(layer.vertices)} vertices at {1e3 * edge:.0f} mm, {1e3 * thickness:.0f} mm thick: ms, median (p99)")
    for strain in (0.1, 0.4, 0.7):
        pose = np.eye(4)
        pose[:3, 3] = layer.vertices[vertex] + (RADIUS - strain * thickness) * normal
        contact = Contact(tool, pose)
        touches = simulator.touch([contact])
        touch = timed(lambda c=contact: simulator.touch([c]), 1.5)
        whole = timed(lambda c=contact: simulator.step([c]), 3)
        print(f"    pose at {strain:.1f} t, {touches[0].force:5.2f} N: reaction {touch[0]:.1f} ({touch[1]:.1f}), "
              f"whole {whole[0]:.1f} ({whole[1]:.1f})")  # fmt: skip
    for force in FORCES:
        pose = np.eye(4)
        pose[:3, 3] = layer.vertices[vertex] + (RADIUS - 0.3 * thickness) * normal
        contact = Contact(tool, pose, np.concatenate([-force * normal, np.zeros(3)]))
        answer = simulator.step([contact])
        touch = timed(lambda c=contact: simulator.touch([c]), 1.5)
        whole = timed(lambda c=contact: simulator.step([c]), 3)
        print(f"    wrench of {force:2.0f} N: {answer.touches['ball'].depth / thickness:.2f} t, reaction "
              f"{touch[0]:.1f} ({touch[1]:.1f}), whole {whole[0]:.1f} ({whole[1]:.1f}) {answer.trust.why}")  # fmt: skip


def draw(found: dict[str, list[Compared]], path: Path) -> None:
    """Force over depth of each part, and the error of force and motion over depth over thickness."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    for name, rows in found.items():
        strain, depth, truth, _, force, bound, moves, _, _ = (np.array(x) for x in zip(*rows, strict=True))
        (line,) = left.plot(depth, force, label=name)
        left.fill_between(depth, np.maximum(force - bound, 0), force + bound, color=line.get_color(), alpha=0.15, lw=0)
        left.plot(depth, truth, "o", color=line.get_color(), ms=5)
        middle.plot(strain, 100 * (force / truth - 1), "o-", color=line.get_color(), ms=4)
        right.plot(strain, moves, "o-", color=line.get_color(), ms=4)
    left.set(xlabel="depth [mm]", ylabel="force [N]", title="answer and bound; dots: finite elements")
    left.legend()
    middle.axhspan(-5, 5, color="0.93")
    middle.set(xlabel="depth over thickness", ylabel="force off [%]", title="force")
    right.axhspan(0, 3, color="0.93")
    right.set(xlabel="depth over thickness", ylabel="motion off [% of the peak]", ylim=(0, None),
              title="motion, mean where it moves")  # fmt: skip
    figure.savefig(path, dpi=110)


def main() -> None:
    """Presses, prints, draws."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--times-only", action="store_true", help="no finite elements")
    options.add_argument("--keep", type=Path, help="folder that keeps finite elements, or has them from before")
    options.add_argument("--out", type=Path, default=PICTURE, help="picture")
    options.add_argument("--trunk", nargs="*", choices=TRUNK, help="parts of the trunk instead, at 5 N; all of them")
    given, found = options.parse_args(), {}
    if given.trunk is not None:
        for part in given.trunk or TRUNK:
            trunk(part, TRUNK[part])
        return
    for name, (part, edge) in PARTS.items():
        print(name)
        if not given.times_only:
            found[name] = compare(part, edge, kept(given.keep, part, edge))
            print("    strain  depth   FEM  by normals   ours    bound  off     moves  worst   in range?")
            for row in found[name]:
                off = 100 * (row.force / row.truth - 1)
                print(f"    {row.strain:5.2f} {row.depth:6.1f} mm {row.truth:6.2f} {100 * row.kept:6.1f} %     "
                      f"{row.force:7.2f} {row.bound:7.2f} {off:+6.1f} % "
                      f"{row.moves:5.1f} {row.worst:6.1f} %  {row.why}")  # fmt: skip
        for wide in (edge, 3e-3):
            times(part, wide)
    if found:
        draw(found, given.out)
        print(f"{given.out} is drawn")


if __name__ == "__main__":
    main()
