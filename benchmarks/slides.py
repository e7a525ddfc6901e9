"""What finite elements say of strokes: pressed, slid, turned, held and lifted tools, as curves for whoever fits a law.

    .venv/bin/python -m benchmarks.slides --out runs/slides                # all scenes, minutes each on one core
    .venv/bin/python -m benchmarks.slides --out runs/slides slab-ball8-mu0.6

Writes NAME.npz for each scene: `about` (JSON: what was done, and the tissue), the layer's arrays (stmpl_core.packed),
and for each pose `time`, `pose`, `wrench` and `friction` (on the body, about the tool's origin), `depth`, `peak` (the
largest motion), `slipping`, `faces_entered`, `ok`; `displacement` and `pressure` at the poses `at`.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.living_limbs import ball, site
from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.stroke import Stroke
from fem_tools.tool_contact import Friction
from fem_tools.walk import Indentation
from stmpl_core import SoftLayer, Tissue
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.packed import pack
from stmpl_core.sdf import SignedDistance
from stmpl_core.tissue import Membrane, Ply, Prony
from tests.scenes import at, limb, plate, turn

log = logging.getLogger(__name__)

RELAXATION = Prony((0.225, 0.225), (0.5, 5.0), "45 % in equal parts, for trials")
SLAB = Tissue(5e3, 0.45)
STACK = Tissue(3e3, 0.45, skin=Membrane(2e5, 1.5e-3, 15.0), deeper=(Ply(8e-3, 15e3, 0.45),))
BACK = Tissue(2.5e3, 0.45, skin=Membrane(130e3, 2.5e-3, 11.4), deeper=(Ply(6e-3, 31e3, 0.45),))  # as measured there
LEARNT_NU = 0.4  # Poisson's ratio that contacts were learnt with, as far as 0.42
SPEEDS = 5e-4, 5e-3, 0.05, 0.3  # of presses [m/s]
TUBE = 0.045  # radius of the tube [m]
FULL = 12  # fields that a file holds, about

Path3 = tuple[np.ndarray, np.ndarray | None]  # poses (N, 4, 4), times (N,) [s] or None


@dataclass(frozen=True)
class Ground:
    """A layer and a place on it to press: origin on the skin, x along the stroke, z outwards (4, 4), in its frame."""

    layer: SoftLayer
    frame: np.ndarray
    fem: PatchFem


@cache
def slab(thickness: float, stacked: bool, fading: bool, nu: float = SLAB.poisson_ratio) -> Ground:
    """A flat slab of one material with a Poisson's ratio, or of skin, fat and muscle."""
    tissue = STACK if stacked else replace(SLAB, poisson_ratio=nu)
    layer = plate(0.168, 6e-3, thickness, crossed=True).with_(tissue=faded(tissue) if fading else tissue)
    fem = PatchFem(element="P1xP2", layers=1 if stacked else 2, refine=3, reach=5, check_stability=False)
    return Ground(layer, np.eye(4), fem)


@cache
def flat_stack(tissue: Tissue, thickness: float, size: float, refine: int) -> Ground:
    """A flat square of skin, fat and muscle, for slides that take a minute."""
    fem = PatchFem(element="P1xP2", layers=1, refine=refine, reach=4, check_stability=False)
    return Ground(plate(size, 6e-3, thickness, crossed=True).with_(tissue=tissue), np.eye(4), fem)


@cache
def forearm(fading: bool, around: bool = False) -> Ground:
    """A forearm as measured, down to its bones; the stroke goes along it, or around it."""
    layer = living(Body.anny(), "left_forearm", edge_length=7e-3)
    layer = layer.with_(tissue=faded(layer.tissue)) if fading else layer
    vertex = site(layer, "left_forearm")
    v, z = layer.vertices, layer.normals[vertex]
    axis = np.linalg.svd(v - v.mean(axis=0), full_matrices=False)[2][0]
    x = axis - (axis @ z) * z
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    x, y = (np.cross(z, x), -x) if around else (x, np.cross(z, x))
    frame[:3, :3], frame[:3, 3] = np.stack([x, y, z], axis=1), v[vertex]
    return Ground(layer, frame, PatchFem(element="P1xP2", layers=1, refine=3, reach=9, check_stability=False))


@cache
def tube() -> Ground:
    """A tube of one material, TUBE round and 12 mm thick; the stroke goes around it."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]], [TUBE, 0, 0.11]
    return Ground(limb(6e-3, 12e-3, TUBE, 0.22, youngs_modulus=2e4, poisson_ratio=0.4), frame,
                  PatchFem(element="P1xP2", layers=2, refine=3, reach=5, check_stability=False))  # fmt: skip


def faded(tissue: Tissue) -> Tissue:
    """The tissue, each material with the series of the trials."""
    skin = replace(tissue.skin, relaxation=RELAXATION) if tissue.skin else None
    deeper = tuple(replace(ply, relaxation=RELAXATION) for ply in tissue.deeper)
    return replace(tissue, relaxation=RELAXATION, skin=skin, deeper=deeper)


@cache
def field(radius: float) -> SignedDistance:
    return SignedDistance.of(ball(radius), margin=0.03)


def heights(ground: Ground, radius: float, along: np.ndarray) -> np.ndarray:
    """Height of the ball's middle where it first touches, at ways along the stroke, (N,) [m]; smooth along it."""
    origin, axes = ground.frame[:3, 3], ground.frame[:3, :3]
    places, found = np.linspace(along.min() - 2e-3, along.max() + 2e-3, 13), []
    for place in places:
        pose = np.eye(4)
        pose[:3, 3] = origin + axes @ [place, 0.0, radius + 0.01]
        touching = Press(field(radius), pose, -axes[:, 2]).touching(ground.layer)
        assert touching is not None, place
        found.append((touching.pose_body_from_tool[:3, 3] - origin) @ axes[:, 2])
    return np.polyval(np.polyfit(places, found, 4), along)


def led(ground: Ground, radius: float, along: np.ndarray, depth: np.ndarray, turned: np.ndarray | None = None):
    """Poses of a ball at ways along the stroke and depths below first touch, (N,) [m], turned about z [rad]."""
    poses = np.tile(np.eye(4), (len(along), 1, 1))
    local = np.stack([along, 0 * along, heights(ground, radius, along) - depth], axis=1)
    poses[:, :3, 3] = ground.frame[:3, 3] + local @ ground.frame[:3, :3].T
    if turned is not None:
        poses[:, :3, :3] = Rotation.from_rotvec(turned[:, None] * ground.frame[:3, 2]).as_matrix()
    return poses


def slide(ground: Ground, radius: float, depth: float, length: float, step: float = 1e-3, back: float = 0.0) -> Path3:
    """Pressed in, slid by a length, and back by another [m]."""
    down = np.linspace(-1e-5, depth, 5)
    way = np.concatenate([np.arange(step, length + step / 2, step), length - np.arange(step, back + step / 2, step)])
    along = np.concatenate([0 * down, way]) - length / 2
    return led(ground, radius, along, np.concatenate([down, np.full(len(way), depth)])), None


def led_around(radius: float, depth: float, length: float, step: float) -> Path3:
    """Pressed into the tube, and led around it by a length along its skin [m]."""
    angles = np.concatenate([np.zeros(6), np.arange(step, length + step / 2, step) / TUBE])
    depths = np.append(np.linspace(-1e-5, depth, 6), np.full(len(angles) - 6, depth))
    poses = [turn((0, 0, 1), a) @ at(TUBE + radius - d, 0, 0.11) for a, d in zip(angles, depths, strict=True)]
    return np.array(poses), None


def spin(ground: Ground, radius: float, depth: float, angle: float) -> Path3:
    """Pressed in, and turned about the normal by an angle and back [rad]."""
    down, turn = np.linspace(-1e-5, depth, 5), np.concatenate([np.linspace(0, 1, 13)[1:], np.linspace(1, 0.5, 7)[1:]])
    turned = np.concatenate([0 * down, angle * turn])
    return led(ground, radius, 0 * turned, np.concatenate([down, np.full(len(turn), depth)]), turned), None


def timed(
    ground: Ground, radius: float, times: np.ndarray, depth: np.ndarray, along: np.ndarray | None = None
) -> Path3:
    """At these depths, and ways along the stroke, at these times, from just above the skin on."""
    depth = np.maximum(depth, -2e-3)
    depth[0] = min(depth[0], -1e-5)
    return led(ground, radius, 0 * times if along is None else along, depth), times


def ramp_hold(ground: Ground, radius: float, depth: float, speed: float) -> Path3:
    """Pressed in at a speed [m/s], and held for 15 s."""
    ramp = depth / speed * np.linspace(0, 1, 9)
    hold = ramp[-1] + np.geomspace(0.02, 15.0, 22)
    times = np.concatenate([ramp, hold])
    return timed(ground, radius, times, np.minimum(speed * times, depth))


def massage(ground: Ground, radius: float, depth: float, cycles: int = 3) -> Path3:
    """Up and down at 1 Hz, from 2 mm above the skin."""
    times = np.arange(24 * cycles + 1) / 24
    return timed(ground, radius, times, -2e-3 + (depth + 2e-3) * (1 - np.cos(2 * np.pi * times)) / 2)


def press_lift_press(ground: Ground, radius: float, depth: float, speed: float) -> Path3:
    """Pressed in at a speed [m/s], held for 2 s, lifted in the same time, away for 1 s, pressed again, held for 3 s."""
    ramp = depth / speed
    knots = np.cumsum([0.0, ramp, 2.0, ramp, 1.0, ramp, 3.0])
    marks = [
        np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots, knots[1:], (8, 10, 8, 5, 8, 12), strict=False)
    ]
    times = np.concatenate([*marks, knots[-1:]])
    return timed(ground, radius, times, np.interp(times, knots, [0, depth, depth, -1.5e-3, -1.5e-3, depth, depth]))


def stroked(ground: Ground, radius: float, depth: float, length: float, speed: float) -> Path3:
    """Pressed in 0.3 s, held for 1 s, slid at a speed [m/s], held for 2 s."""
    slid = length / speed
    knots = np.cumsum([0.0, 0.3, 1.0, slid, 2.0])
    times = np.concatenate([np.linspace(0, 0.3, 6), np.linspace(0.3, 1.3, 5)[1:],
                            1.3 + slid * np.linspace(0, 1, round(length / 1e-3) + 1)[1:],
                            1.3 + slid + np.geomspace(0.05, 2.0, 8)])  # fmt: skip
    along = np.interp(times, knots, [0, 0, 0, length, length]) - length / 2
    return timed(ground, radius, times, np.interp(times, knots, [0, depth, depth, depth, depth]), along)


@dataclass(frozen=True)
class Scene:
    """A ball led over a ground.

    Args:
        ground: layer and place.
        radius: radius of the ball [m].
        path: poses and times.
        friction: law of friction.
        step: longest step [thicknesses].
    """

    ground: Callable[[], Ground]
    radius: float
    path: Callable[[Ground], Path3]
    friction: Friction
    step: float = 0.07


def _scenes() -> Iterator[tuple[str, Scene]]:
    def flat(stacked: bool = False, fading: bool = False, thickness: float = 15e-3):
        return lambda: slab(thickness, stacked, fading)

    for mu in (0.6, 0.3, 1.0):
        yield f"slab-ball8-mu{mu}", Scene(flat(), 8e-3, lambda g: slide(g, 8e-3, 4e-3, 24e-3), mu)
    for mu in (0.1, 1.5):
        yield f"slab-ball8-mu{mu}", Scene(flat(), 8e-3, lambda g: slide(g, 8e-3, 4e-3, 30e-3), mu)
    for mu in (0.6, 0.3, 1.0):
        yield f"forearm-ball20-mu{mu}", Scene(lambda: forearm(False), 0.02,
                                              lambda g: slide(g, 0.02, 9e-3, 30e-3, 1.5e-3), mu, 0.15)  # fmt: skip
    for mu in (0.3, 0.6):
        yield (
            f"forearm-ball20-around-mu{mu}",
            Scene(lambda: forearm(False, around=True), 0.02, lambda g: slide(g, 0.02, 9e-3, 18e-3, 1.5e-3), mu, 0.15),
        )
    yield (
        "forearm-ball20-back-mu0.3",
        Scene(lambda: forearm(False), 0.02, lambda g: slide(g, 0.02, 9e-3, 9e-3, 1.5e-3, back=9e-3), 0.3, 0.15),
    )
    for mu in (0.5, 0.9, 1.2):
        yield f"tube-ball12-mu{mu}", Scene(tube, 0.012, lambda g: led_around(0.012, 4.8e-3, 21e-3, 7e-4), mu)
    yield "slab-ramp-hold", Scene(flat(fading=True), 0.02, lambda g: ramp_hold(g, 0.02, 6e-3, 0.02), "stick")
    yield "slab-massage", Scene(flat(fading=True), 0.02, lambda g: massage(g, 0.02, 6e-3), "stick")
    yield (
        "slab-press-lift-press",
        Scene(flat(fading=True), 0.02, lambda g: press_lift_press(g, 0.02, 6e-3, 0.02), "stick"),
    )
    for speed in SPEEDS:
        for name, path in (("ramp-hold", ramp_hold), ("press-lift-press", press_lift_press)):
            yield f"slab-{name}-{1e3 * speed:g}", Scene(lambda: slab(15e-3, False, True, LEARNT_NU), 0.02, partial(
                path, radius=0.02, depth=6e-3, speed=speed), "stick")  # fmt: skip
    yield "slab-ball8-spin-mu0.6", Scene(flat(), 8e-3, lambda g: spin(g, 8e-3, 4e-3, np.pi / 3), 0.6)
    yield "stack-ball20-mu0.6", Scene(flat(True, thickness=25e-3), 0.02, lambda g: slide(g, 0.02, 6e-3, 24e-3), 0.6)
    yield "slab-ball8-back-mu0.6", Scene(flat(), 8e-3, lambda g: slide(g, 8e-3, 4e-3, 10e-3, back=10e-3), 0.6)
    yield "flat-back-ball20-mu0.8", Scene(lambda: flat_stack(BACK, 18e-3, 0.15, 2), 0.02,
                                          lambda g: slide(g, 0.02, 7e-3, 24e-3, 1.5e-3), 0.8, 0.12)  # fmt: skip
    yield "flat-back-ball8-mu0.5", Scene(lambda: flat_stack(BACK, 18e-3, 0.12, 3), 8e-3,
                                         lambda g: slide(g, 8e-3, 7e-3, 12e-3), 0.5, 0.12)  # fmt: skip
    yield "stack-ball20-deep-mu0.6", Scene(lambda: flat_stack(STACK, 25e-3, 0.15, 2), 0.02,
                                           lambda g: slide(g, 0.02, 9e-3, 24e-3, 1.5e-3), 0.6, 0.12)  # fmt: skip
    for mu in (0.6, 0.3, 1.0):
        yield f"slab-ball20-mu{mu}", Scene(flat(), 0.02, lambda g: slide(g, 0.02, 5e-3, 24e-3), mu)
    yield "forearm-massage", Scene(lambda: forearm(True), 0.02, lambda g: massage(g, 0.02, 9e-3, 2), "stick", 0.15)
    yield (
        "forearm-ramp-hold",
        Scene(lambda: forearm(True), 0.02, lambda g: ramp_hold(g, 0.02, 9e-3, 0.02), "stick", 0.15),
    )
    yield "forearm-press-lift-press", Scene(lambda: forearm(True), 0.02,
                                            lambda g: press_lift_press(g, 0.02, 9e-3, 0.03), "stick", 0.15)  # fmt: skip
    yield "slab-stroke-mu0.6", Scene(flat(fading=True), 8e-3, lambda g: stroked(g, 8e-3, 4e-3, 15e-3, 0.03), 0.6)


SCENES: dict[str, Scene] = dict(_scenes())


def played(name: str, scene: Scene, out: Path) -> None:
    """Plays a scene and writes its file, also while it is under way."""
    began, ground = time.process_time(), scene.ground()
    poses, times = scene.path(ground)
    solver = IndenterFem(ground.fem, friction=scene.friction, step=scene.step).prepare(ground.layer)
    stroke = Stroke(field(scene.radius), poses, -ground.frame[:3, 2])
    answers: list[Indentation] = []
    for answer in solver.follow([stroke], times=times):
        answers.append(answer)
        force = ground.frame[:3, :3].T @ answer.wrenches[0][:3]
        figures = answer.trust.figures
        log.info("%s %d/%d: %.0f s, F %s N, slipping %.2f, faces %.4f of the depth, %s", name, len(answers), len(poses),
                 time.process_time() - began, np.round(force, 4), figures["slipping"],
                 figures["faces_entered_over_depth"], answer.trust.why or "ok")  # fmt: skip
        if len(answers) % 10 == 0 or len(answers) == len(poses) or not answer.trust.converged:
            write(out / f"{name}.npz", scene, ground, poses, answers, time.process_time() - began)


def write(path: Path, scene: Scene, ground: Ground, poses: np.ndarray, answers: list[Indentation], took: float) -> None:
    """One file of a scene, as far as it was played."""
    at = np.unique(np.linspace(0, len(answers) - 1, FULL).round().astype(int))
    figures = [answer.trust.figures for answer in answers]
    about = {"radius": scene.radius, "friction": scene.friction, "step": scene.step, "poses": len(poses),
             "played": len(answers), "columns": figures[0]["columns"], "seconds": took,
             "why": answers[-1].trust.why}  # fmt: skip
    np.savez_compressed(
        path,
        allow_pickle=False,
        about=np.array(json.dumps(about)),
        frame=ground.frame,
        pose=poses[: len(answers)],
        time=np.array([answer.time for answer in answers]),
        wrench=np.array([answer.wrenches[0] for answer in answers]),
        friction=np.array([answer.frictions[0] for answer in answers]),
        depth=np.array([answer.depth for answer in answers]),
        peak=np.array([np.linalg.norm(answer.displacement, axis=1).max() for answer in answers]),
        slipping=np.array([one["slipping"] for one in figures]),
        faces_entered=np.array([one["faces_entered_m"] for one in figures]),
        min_j=np.array([one["min_j"] for one in figures]),
        ok=np.array([answer.trust.ok for answer in answers]),
        at=at,
        displacement=np.array([answers[k].displacement for k in at], dtype=np.float32),
        pressure=np.array([answers[k].pressure for k in at], dtype=np.float32),
        **pack(ground.layer),
    )


def main() -> None:
    """Plays the scenes that are named, or all."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("scenes", nargs="*", help=f"names of scenes; all: {', '.join(SCENES)}")
    options.add_argument("--out", type=Path, required=True, help="folder of the files")
    given = options.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    given.out.mkdir(parents=True, exist_ok=True)
    if unknown := set(given.scenes) - set(SCENES):
        options.error(f"no scene is called {', '.join(sorted(unknown))}; there are {', '.join(SCENES)}")
    for name in given.scenes or SCENES:
        played(name, SCENES[name], given.out)


if __name__ == "__main__":
    main()
