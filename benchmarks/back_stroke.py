"""A stroke of 100 mm along the back at 50 mm/s and 10 N, oiled and dry: a film and a table.

    .venv/bin/python -m benchmarks.back_stroke --out runs/back     # half an hour or more of one core
    .venv/bin/python -m benchmarks.back_stroke --out runs/back oiled    # one of the two
    .venv/bin/python -m benchmarks.back_stroke --out runs/back --draw   # from what lies there

A ball of 40 mm is pressed beside the spine with 10 N in 0.5 s and led down for 2 s; skin, fat and muscle as
measured, each with the relaxation of held skin. Ours goes first: at each instant the depth is sought at which it says
10 N. Finite elements then go through the same poses at the same times.
"""

from __future__ import annotations

import argparse
import logging
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.tri import Triangulation

from benchmarks.living_limbs import SITES
from benchmarks.slides import Ground, ball, field
from fem_tools import IndenterFem, PatchFem
from fem_tools.stroke import Stroke
from stmpl_core import Contact, Simulator, State, Touch
from stmpl_core.body import Body
from stmpl_core.friction import coefficient
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.regions import HELD_SKIN
from stmpl_sim.film import save

log = logging.getLogger(__name__)

EDGE = 5e-3  # edges of the mesh [m]
RADIUS, FORCE, LENGTH, SPEED, RAMP = 0.02, 10.0, 0.1, 0.05, 0.5  # m, N, m, m/s, s
SETTLED = 0.4  # time of sliding from which it counts as steady [s]
STEP = 2e-3  # way between two poses of finite elements [m]
BETWEEN = 4  # steps of ours between two of them
FRICTIONS = ("dry", "oiled")
MAX_WORK = 1e12  # multiplications of finite elements for one stroke
MOVES = 0.1  # motion over its peak from which skin counts as moving
FILM_RATE = 15.0  # Hz; in a film a second of the stroke takes 1.7


def back() -> Ground:
    """The back, and the place in the middle of the stroke, which goes down."""
    layer = living(Body.anny(), "back", edge_length=EDGE)
    layer = layer.with_(tissue=layer.tissue.relaxing(HELD_SKIN))
    vertex = int(np.argmin(np.linalg.norm(layer.vertices - SITES["back"][0], axis=1)))
    z = layer.normals[vertex]
    x = np.array([0.0, 0.0, -1.0]) + z[2] * z
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), layer.vertices[vertex]
    fem = PatchFem(element="P1xP2", layers=1, refine=1, reach=4, check_stability=False)
    return Ground(layer, frame, fem)


def instants() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [s], ways along the stroke [m] and forces that are wanted [N], one for each pose of finite elements."""
    down, way = np.linspace(0, RAMP, 9), np.arange(STEP, LENGTH + STEP / 2, STEP)
    times = np.concatenate([down, RAMP + way / SPEED])
    along = np.concatenate([0 * down, way]) - LENGTH / 2
    return times, along, FORCE * np.minimum(times / RAMP, 1.0)


def ours(ground: Ground, friction: str, poses: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The stroke as ours plays it, each pose at the depth at which the skin presses with the force that is wanted.

    Args:
        ground: the back.
        friction: name of the pair of surfaces.
        poses: poses to play instead, (N, 4, 4).
    """
    simulator, tool = Simulator(ground.layer, MomentNet(), friction=friction), ball(RADIUS)
    instant, spent, rows = np.stack(instants(), axis=1), [], []
    state, slope = State(), -1e3
    height = _first_touch(simulator, ground, instant[0, 1])

    def touched(pose: np.ndarray, dt: float) -> tuple[Touch, State]:
        began = time.perf_counter()
        (touch,), after = simulator.touch([Contact(tool, pose)], state, dt)
        spent.append(time.perf_counter() - began)
        return touch, after

    for k in range(BETWEEN * (len(instant) - 1) + 1):
        place, part = divmod(k, BETWEEN)
        now = (1 - part / BETWEEN) * instant[place] + part / BETWEEN * instant[min(place + 1, len(instant) - 1)]
        dt = float(instant[place - (part == 0) + 1, 0] - instant[place - (part == 0), 0]) / BETWEEN if k else 0.0
        if poses is not None:
            pose = poses[place] if part == 0 else poses[place] + part / BETWEEN * (poses[place + 1] - poses[place])
            touch, after = touched(pose, dt)
        else:
            pose, last = _pose(ground, now[1], height), None
            for _ in range(12 if k else 1):
                touch, after = touched(pose, dt)
                missing = touch.force - now[2]
                if abs(missing) < 2e-3 * FORCE:
                    break
                if last is not None and abs(height - last[0]) > 1e-9:
                    slope = min((missing - last[1]) / (height - last[0]), -100.0)
                last = height, missing
                height -= float(np.clip(missing / slope, -1e-3, 1e-3))
                pose = _pose(ground, now[1], height)
        state = after
        if part == 0:
            answer = simulator.answer([touch])
            rub = np.zeros(6) if touch.slip is None else touch.slip.wrench
            log.info("%s %.2f s: %.2f of %.2f N, %.2f mm deep, friction %.2f N, %s", friction, now[0], touch.force,
                     now[2], 1e3 * touch.depth, np.linalg.norm(rub[:3]), answer.trust.why or "in range")  # fmt: skip
            bound = answer.trust.error_bound
            rows.append((touch.pose_body_from_tool, touch.wrench, rub, answer.displacement, touch.depth,
                         answer.trust.in_range, np.nan if bound is None else bound, touch.force_bound))  # fmt: skip
    names = ("pose", "wrench", "friction", "displacement", "depth", "in_range", "bound", "force_bound")
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True)) | {
        "time": instant[:, 0], "touch_seconds": np.array(spent)}  # fmt: skip


def _pose(ground: Ground, along: float, height: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = ground.frame[:3, 3] + ground.frame[:3, :3] @ [along, 0.0, height]
    return pose


def _first_touch(simulator: Simulator, ground: Ground, along: float) -> float:
    """Height of the ball's middle just above the skin [m]."""
    low, high = 0.0, RADIUS + 0.05
    for _ in range(30):
        middle = (low + high) / 2
        presses = simulator.touch([Contact(ball(RADIUS), _pose(ground, along, middle))])[0].presses
        low, high = (middle, high) if presses else (low, middle)
    return high + 5e-5


def finite_elements(ground: Ground, friction: str, played: dict[str, np.ndarray], path: Path) -> None:
    """The same poses and times by finite elements; written to a file while they are under way."""
    solver = IndenterFem(ground.fem, friction=coefficient(friction), step=0.05, max_work=MAX_WORK).prepare(ground.layer)
    stroke = Stroke(field(RADIUS), played["pose"], -ground.frame[:3, 2])
    rows, began = [], time.process_time()
    for answer in solver.follow([stroke], times=played["time"]):
        figures = answer.trust.figures
        rows.append((answer.wrenches[0], answer.frictions[0], answer.displacement, figures["slipping"],
                     figures["faces_entered_m"], answer.trust.ok))  # fmt: skip
        seconds = time.process_time() - began
        force = np.round(ground.frame[:3, :3].T @ answer.wrenches[0][:3], 3)
        log.info("%s FEM %d/%d: %.0f s, %s columns, F %s N, slipping %.2f, %s", friction, len(rows),
                 len(played["pose"]), seconds, figures["columns"], force, figures["slipping"],
                 answer.trust.why or "ok")  # fmt: skip
        names = ("wrench", "friction", "displacement", "slipping", "faces_entered", "ok")
        if len(rows) % 10 == 0 or len(rows) == len(played["pose"]) or not answer.trust.converged:
            np.savez_compressed(path, allow_pickle=False, seconds=seconds, columns=figures["columns"],
                                **dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True)))  # fmt: skip



def read(out: Path, friction: str) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Ours and finite elements, which may have stopped earlier."""
    mine, theirs = (dict(np.load(out / f"{friction}-{who}.npz")) for who in ("ours", "fem"))
    return mine, theirs


def forces(ground: Ground, played: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The whole force into the back and along it at each pose, (N,) [N].

    What of it is friction is not compared: by finite elements that holds what sticking skin carries along itself.
    """
    force = played["wrench"][:, :3] @ ground.frame[:3, :3]
    return -force[:, 2], np.linalg.norm(force[:, :2], axis=1)


def off(mine: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Largest motion by finite elements [m], and how far ours is off over it: mean where skin moves, at the worst."""
    moved = np.linalg.norm(theirs["displacement"], axis=2)
    wrong = np.linalg.norm(mine["displacement"][: len(moved)] - theirs["displacement"], axis=2)
    peak = np.maximum(moved.max(axis=1), 1e-9)
    mean = [w[m > MOVES * p].mean() if p > 1e-4 else 0.0 for w, m, p in zip(wrong, moved, peak, strict=True)]
    return peak, np.array(mean) / peak, wrong.max(axis=1) / peak


def table(ground: Ground, out: Path) -> str:
    """Ours beside finite elements while the ball is pressed in and while it slides, as Markdown."""
    there = [friction for friction in FRICTIONS if (out / f"{friction}-fem.npz").exists()]
    rows = ["| ours / finite elements | force into the back [N] | force along it [N] | largest motion [mm] | motion "
            "off: mean where it moves / worst [% of the largest] | in range | time a step |",
            "| --- " * 7 + "|"]  # fmt: skip
    for friction in there:
        mine, theirs = read(out, friction)
        played = len(theirs["wrench"])
        mine = {name: x[:played] for name, x in mine.items()}
        (push, rub), (true_push, true_rub) = forces(ground, mine), forces(ground, theirs)
        peak, mean, worst = off(mine, theirs)
        slides = mine["time"] > RAMP + SETTLED
        for name, when in (("pressed in", np.isclose(mine["time"], RAMP)), ("slides", slides)):
            if when.any():
                rows.append(
                    f"| {friction}, {name} | {push[when].mean():.1f} / {true_push[when].mean():.1f} | "
                    f"{rub[when].mean():.2f} / {true_rub[when].mean():.2f} | {1e3 * peak[when].mean():.1f} | "
                    f"{100 * mean[when].mean():.0f} / {100 * worst[when].max():.0f} | "
                    f"{mine['in_range'][when].mean():.0%} | {1e3 * np.median(mine['touch_seconds']):.1f} ms / "
                    f"{theirs['seconds'] / len(true_push):.0f} s |"
                )
    return "\n".join(rows)


def film(ground: Ground, out: Path) -> Path:
    """Skin of both from above, coloured by how far it moved, over force against time; one frame a pose."""
    local = (ground.layer.vertices - ground.frame[:3, 3]) @ ground.frame[:3, :3]
    near = (np.abs(local[:, 0]) < 0.09) & (np.abs(local[:, 1]) < 0.045)
    faces = ground.layer.faces[near[ground.layer.faces].all(axis=1)]
    every = [(name, *read(out, name)) for name in FRICTIONS]
    count, frames = max(len(theirs["wrench"]) for _, _, theirs in every), []
    most = max(1e3 * off(mine, theirs)[0].max() for _, mine, theirs in every)
    for k in range(count):
        figure, axes = plt.subplots(3, 2, figsize=(8.4, 6.6), dpi=72, layout="constrained", height_ratios=(1, 1, 1.1))
        for row, (name, mine, theirs) in zip(axes, every, strict=False):
            for axis, who, played in zip(row, ("ours", "finite elements"), (mine, theirs), strict=True):
                axis.set(title=f"{name}: {who}", aspect="equal", xticks=[], yticks=[], xlim=(-88, 88), ylim=(-42, 42))
                if k >= len(played["displacement"]):
                    axis.text(0, 0, f"{who} went no further", ha="center")
                    continue
                moved = local + played["displacement"][k] @ ground.frame[:3, :3]
                size = 1e3 * np.linalg.norm(played["displacement"][k], axis=1)
                mesh = Triangulation(1e3 * moved[:, 0], 1e3 * moved[:, 1], faces)
                skin = axis.tripcolor(mesh, size, shading="gouraud", cmap="inferno_r", vmin=0, vmax=most)
                axis.triplot(mesh, color="k", lw=0.15, alpha=0.4)
                at = 1e3 * (mine["pose"][k, :3, 3] - ground.frame[:3, 3]) @ ground.frame[:3, :3]
                axis.plot(at[0], at[1], "+", color="tab:cyan", ms=9)
            figure.colorbar(skin, ax=row[1], label="motion [mm]")
        for axis, (name, mine, theirs) in zip(axes[2], every, strict=True):
            both = zip(forces(ground, mine), forces(ground, theirs), strict=True)
            for (force, true), colour, label in zip(both, ("tab:blue", "tab:orange"), ("into the back", "along it"),
                                                    strict=True):  # fmt: skip
                axis.plot(mine["time"], force, "-", color=colour, label=label)
                axis.plot(mine["time"][: len(true[: k + 1])], true[: k + 1], ".", color=colour, ms=4)
            axis.axvline(mine["time"][k], color="0.7", lw=0.8)
            axis.set(xlabel="time [s]", ylabel="force [N]", ylim=(0, 17), title=f"{name}: lines ours, dots FEM")
            axis.legend(fontsize=7, loc="upper left")
        figure.canvas.draw()
        frames.append(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
        plt.close(figure)
    return save(frames, out / "back_stroke.webp", FILM_RATE)


def main() -> None:
    """Plays, prints, draws."""
    plt.switch_backend("agg")
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("frictions", nargs="*", help=f"those to play, of {', '.join(FRICTIONS)}; all unless given")
    options.add_argument("--out", type=Path, required=True, help="folder of the runs and the film")
    options.add_argument("--ours", action="store_true", help="only ours again, at the poses that lie there")
    options.add_argument("--draw", action="store_true", help="only table and film, of what lies there")
    given = options.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    given.out.mkdir(parents=True, exist_ok=True)
    ground = back()
    for friction in () if given.draw else given.frictions or FRICTIONS:
        mine = given.out / f"{friction}-ours.npz"
        played = ours(ground, friction, np.load(mine)["pose"] if given.ours else None)
        np.savez_compressed(mine, allow_pickle=False, **played)
        if not given.ours:
            finite_elements(ground, friction, played, given.out / f"{friction}-fem.npz")
    log.info("%s", table(ground, given.out))
    if all((given.out / f"{friction}-fem.npz").exists() for friction in FRICTIONS):
        log.info("%s is drawn", film(ground, given.out))


if __name__ == "__main__":
    main()
