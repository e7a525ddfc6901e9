"""A limb that moves: how long a pose takes beside a running contact loop, and how far off a bent limb's answers are.

    .venv/bin/python -m benchmarks.posing           # time; set OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1
    .venv/bin/python -m benchmarks.posing --against OTHER   # the same beside another checkout's, by turns
    .venv/bin/python -m benchmarks.posing --fem     # against finite elements on the bent skin; about ten minutes
    .venv/bin/python -m benchmarks.posing --fem --living     # the same of skin, fat and muscle down to the bones
    .venv/bin/python -m benchmarks.posing --fem --living --bends 30 --places 20     # at places drawn near the fold

Errors of force, and of motion as its mean where the truth moves more than a tenth of its peak and at the worst vertex,
in % of the peak; beside them those of a layer that is made afresh from the bent skin, which takes seconds. "beyond its
bound": the posed skin's force or motion is further off than it says.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.living_limbs import ball
from fem_tools import IndenterFem, PatchFem, Press
from stmpl_core import Contact, Simulator, Skin, SoftLayer, State
from stmpl_core.body import Body
from stmpl_core.errors import StmplError
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.rig import Rig
from stmpl_core.sdf import SignedDistance
from stmpl_core.touch import Answer

PART, JOINT = "left_arm", "left_elbow"
RADIUS, SUBDIVISIONS = 0.012, 3  # of the ball [m], and of its mesh
DEEP = 0.25  # depth of the ball over the thickness
BENDS = (0, 30, 60, 90)  # degrees
STRAIGHT = 20.0  # slant of a ball's way from which it is told [degrees]
JOINT_RATE, LOOP_RATE, SECONDS = 60.0, 200.0, 5.0  # of the timed loop [Hz], [s]
ALONE = 200  # poses that are timed with nothing between them
TURNS = 3  # runs of each checkout, by turns
NEAR_FOLD = 0.06  # distance of drawn places from the inside of the elbow [m]
ROOT = Path(__file__).parents[1]


def arm(edge: float = 3e-3, stack: bool = False) -> tuple[SoftLayer, Rig]:
    """The average body's left arm, of one material or as measured, and its rig."""
    body = Body.anny()
    layer = living(body, PART, edge_length=edge) if stack else body.part(PART, edge_length=edge)
    rig = Rig.of(body, PART, layer)
    return layer.with_(rig=rig), rig


def sites(layer: SoftLayer, rig: Rig) -> dict[str, int]:
    """Vertices of the arm at rest, by name."""
    shoulder, elbow = rig.heads
    upper = (elbow - shoulder) / np.linalg.norm(elbow - shoulder)
    hand = layer.vertices[rig.weights[:, 1] > 0.99].mean(axis=0) - elbow
    lower = hand / np.linalg.norm(hand)
    inside = (lower - upper) / np.linalg.norm(lower - upper)
    places = {
        "biceps": (elbow - 0.13 * upper, inside - inside @ upper * upper),
        "triceps": (elbow - 0.13 * upper, -inside + inside @ upper * upper),
        "forearm": (elbow + 0.11 * lower, inside - inside @ lower * lower),
        "inside of the elbow": (elbow, inside),
        "5 cm above the elbow, inside": (elbow - 0.05 * upper, inside - inside @ upper * upper),
        "outside of the elbow": (elbow, -inside),
    }
    found = {}
    for name, (place, way) in places.items():
        way = way / np.linalg.norm(way)
        away = layer.vertices - place
        ahead = away @ way
        found[name] = int(np.where(ahead > 0, np.linalg.norm(away - ahead[:, None] * way, axis=1), np.inf).argmin())
    return found


def drawn(layer: SoftLayer, rig: Rig, count: int) -> dict[str, int]:
    """Vertices drawn from those near the inside of the elbow, by name; the same ones each time."""
    fold = layer.vertices[sites(layer, rig)["inside of the elbow"]]
    near = np.flatnonzero(np.linalg.norm(layer.vertices - fold, axis=1) < NEAR_FOLD)
    return {f"place {k + 1}": int(vertex) for k, vertex in
            enumerate(np.random.default_rng(0).choice(near, count, replace=False))}  # fmt: skip


def compare(edge: float, stack: bool, bends: tuple[int, ...], reach: float, places: int = 0) -> None:
    """Prints answers on a bent arm beside finite elements, at named places or so many drawn ones."""
    layer, rig = arm(edge, stack)
    chosen = drawn(layer, rig, places) if places else sites(layer, rig)
    radius = 0.02 if stack else RADIUS
    skin, tool = Skin.of(layer, MomentNet()), ball(radius, SUBDIVISIONS)
    print(f"{len(layer.vertices)} vertices of {1e3 * edge:g} mm; ball of {1e3 * radius:g} mm, {DEEP:g} t deep")
    print("bend  place                         force N: FEM  posed     afresh    moves (worst) %: posed  afresh")
    for bend in bends:
        simulator = Simulator(skin.posed({JOINT: np.deg2rad(bend)}))
        here = simulator.layer
        depth = {"core": here.core} if here.core is not None else {"thickness": here.thickness}
        again = SoftLayer(here.vertices, here.faces, **depth, tissue=here.tissue, ply_scale=here.ply_scale)
        try:
            afresh = Simulator(again, MomentNet())
        except StmplError as error:
            afresh = None
            print(f"{bend:4d}  afresh: {error}")
        fem = IndenterFem(PatchFem(element="P1xP2", reach=reach, refine=2, layers=1), step=0.1).prepare(again)
        kept: list[tuple[float, float]] = []
        for name, vertex in chosen.items():
            normal, thickness = here.normals[vertex], float(here.thickness[vertex])
            pose = np.eye(4)
            pose[:3, 3] = here.vertices[vertex] + (radius + 0.01) * normal
            try:
                start = Press(SignedDistance.of(tool, margin=0.03), pose, -normal).touching(again)
                if start is None:
                    print(f"{bend:4d}  {name:30} the ball is in other skin before it meets this", flush=True)
                    continue
                truth = fem.press([start], DEEP * thickness)
                at = start.at(DEEP * thickness).pose_body_from_tool
                moved = np.linalg.norm(truth.displacement, axis=1)
                across = -(truth.pressure @ again.vertex_area_vectors)
                true = float(again.vertex_areas @ truth.traction @ across / np.linalg.norm(across))
                words, ours = "", []
                for one in [simulator, afresh]:
                    if one is None:
                        continue
                    answer = one.step([Contact(tool, at)])
                    off = 100 * np.linalg.norm(answer.displacement - truth.displacement, axis=1) / moved.max()
                    force = 100 * (answer.touches["ball"].force / true - 1)
                    ours.append((force, off[moved > 0.1 * moved.max()].mean(), off.max()))
                    if one is simulator and answer.trust.ok:
                        kept.append((abs(force), off.max()))
                    if one is simulator:
                        words = beyond(answer, true, 0.01 * off.max() * moved.max()) + answer.trust.why
                        words += slanted(answer.touches["ball"].push, -normal)
                forces = "".join(f"{force:+8.1f} %" for force, _, _ in ours)
                motions = "  ".join(f"{moves:5.1f} ({worst:4.1f})" for _, moves, worst in ours)
                bad = "" if truth.trust.ok else f" FEM: {truth.trust.why}"
                print(f"{bend:4d}  {name:30} {true:8.3f} {forces}     {motions}  {words}{bad}", flush=True)
            except StmplError as error:
                print(f"{bend:4d}  {name:30} {error}", flush=True)
        if kept:
            force, worst = np.max(kept, axis=0)
            print(f"{bend:4d}  not flagged: {len(kept)} of {len(chosen)}; force at most {force:.0f} % off, "
                  f"a vertex {worst:.0f} %")  # fmt: skip


def beyond(answer: Answer, force: float, off: float) -> str:
    """Which of an answer's bounds does not cover the true force [N], or by how far its motion is off [m]."""
    touch, bound = answer.touches["ball"], answer.trust.error_bound
    outside = {"force": not abs(touch.force - force) <= touch.force_bound, "motion": bound is not None and off > bound}
    return "".join(f"{what} beyond its bound; " for what, is_off in outside.items() if is_off)


def slanted(push: np.ndarray, way: np.ndarray) -> str:
    """By how much a ball's way (3,) slants to the skin that it meets, in words; no pose tells of it."""
    slant = np.rad2deg(np.arccos(np.clip(push @ way / max(float(np.linalg.norm(push)), 1e-300), -1, 1)))
    return f"; came at a slant of {slant:.0f} degrees" if slant > STRAIGHT else ""


def times(stack: bool) -> None:
    """Prints what a pose costs, alone and beside contacts."""
    layer, rig = arm(stack=stack)
    skin, tool, now = Skin.of(layer, MomentNet()), ball(RADIUS, SUBDIVISIONS), time.perf_counter
    place, cpu = sites(layer, rig)["forearm"], time.thread_time
    skin.posed({JOINT: 0.1})
    simulator, state = Simulator(skin, friction=0.3), State()
    alone, posed, touched, fields, late, last = [], [], [], [], [], -1.0
    for step in range(ALONE):
        before = cpu()
        simulator.pose({JOINT: 0.5 + 0.5 * np.sin(step / JOINT_RATE)})
        alone.append(cpu() - before)
    start = now()
    for step in range(int(SECONDS * LOOP_RATE)):
        t = step / LOOP_RATE
        while now() - start < t:
            pass
        if t - last >= 1 / JOINT_RATE - 1e-9:
            last, before = t, cpu()
            state = simulator.pose({JOINT: 0.5 + 0.5 * np.sin(t)}, state)
            posed.append(cpu() - before)
        here, pose = simulator.layer, np.eye(4)
        slide = 0.01 * np.sin(3 * t) * simulator.skin.near.frames[place, 0]
        pose[:3, 3] = here.vertices[place] + slide + (RADIUS - DEEP * here.thickness[place]) * here.normals[place]
        before = cpu()
        touches, state = simulator.touch([Contact(tool, pose)], state, 1 / LOOP_RATE)
        touched.append(cpu() - before)
        if step % 2 == 0:
            before = cpu()
            simulator.answer(touches)
            fields.append(cpu() - before)
        late.append(now() - start - t)
    print(f"{len(layer.vertices)} vertices; {JOINT_RATE:g} Hz of joints, {LOOP_RATE:g} Hz of touches with friction and "
          f"{LOOP_RATE / 2:g} Hz of fields for {SECONDS:g} s, one thread. Processor time [ms], last row wall: median, "
          "p99, largest")  # fmt: skip
    rows = {"pose, nothing between": alone, "pose": posed, "reaction": touched, "field": fields}
    for name, some in (rows | {"end of step, late by": late}).items():
        print(f"  {name:34} {1e3 * np.median(some):6.2f} {1e3 * np.quantile(some, 0.99):6.2f} {1e3 * max(some):6.2f}")


def side_by_side(other: Path, stack: bool) -> None:
    """Prints what this and another checkout take, by turns, and the ratio: median over the turns of the medians."""
    found: dict[str, tuple[list[float], list[float]]] = {}
    for _ in range(TURNS):
        for number, root in enumerate((other.resolve(), ROOT)):
            print(f"load {os.getloadavg()[0]:.1f}; {root}", flush=True)
            said = subprocess.run([sys.executable, "-m", "benchmarks.posing", *["--living"][: int(stack)]], cwd=root,
                                  env=os.environ | {"PYTHONPATH": str(root)}, check=True, capture_output=True,
                                  text=True).stdout  # fmt: skip
            for name, median in re.findall(r"^  (\S.*?) {2,}(\d+\.\d+)", said, re.MULTILINE):
                found.setdefault(name, ([], []))[number].append(float(median))
    print("processor time [ms], median of the turns' medians: other, this, this over other")
    for name, (before, after) in found.items():
        if before and after and not name.startswith("end of step"):
            print(f"  {name:34} {np.median(before):6.2f} {np.median(after):6.2f} "
                  f"{np.median(np.divide(after, before)):6.2f}")  # fmt: skip


def main() -> None:
    """Times, or compares."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--fem", action="store_true", help="errors against finite elements instead of times")
    options.add_argument("--living", action="store_true", help="skin, fat and muscle down to the bones")
    options.add_argument("--bends", type=int, nargs="+", default=BENDS, help="angles of the elbow from rest [degrees]")
    options.add_argument("--places", type=int, default=0, help="number of places near the fold instead of named ones")
    options.add_argument("--against", type=Path, help="another checkout, to be timed by turns with this one")
    given = options.parse_args()
    if given.against:
        side_by_side(given.against, given.living)
    elif given.fem:
        edge, reach = (6e-3, 3.0) if given.living else (4e-3, 4.0)
        compare(edge, given.living, tuple(given.bends), reach, given.places)
    else:
        times(given.living)


if __name__ == "__main__":
    main()
