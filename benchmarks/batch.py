"""Touches and fields a second, many scenes at once: Simulator in a loop, Batch, WarpBatch, side by side in one run.

    OMP_NUM_THREADS=1 .venv/bin/python -m benchmarks.batch              # the tables of docs/speed.md; two minutes
    OMP_NUM_THREADS=1 .venv/bin/python -m benchmarks.batch --profile    # and where Batch spends its time on one thread

One ball in each scene. All take turns of a fraction of a second, so that what else the machine does falls on each. A
figure is the median over the turns: scenes a second as the clock has it; a second of the processor's time, which other
work on the machine takes none of; and that over the loop of Simulator, turn by turn.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from stmpl_core import Contact, Simulator
from stmpl_core.batch import Batch
from stmpl_core.errors import StmplError
from stmpl_core.methods import MomentNet
from stmpl_core.skin import Skin
from stmpl_core.state import State
from stmpl_core.tool import Tool

AIM = 2500  # touches a second of one core
DEPTH = 0.3  # of each tool, over the thickness
ROUNDS, TURN_S = 12, 0.2
N, ON_GPU = {"touches": 256, "steps": 256, "fields": 32}, 4096  # scenes; of a GPU, which few do not fill
STEP, FRICTION = 2e-3, "oiled"  # of a step: a touch with a memory [s], and what rubs
NO_CUDA = "not measured: no CUDA device"
Row = tuple[Callable[[], object], int] | str  # call that answers all scenes, and how many; or why there is none
Rates = dict[str, list[tuple[float, float]]]  # scenes a second of the clock and of the processor in each round, by name


def skins() -> dict[str, Skin]:
    """The paper's arm, of one material, and a living forearm: skin, fat and muscle on bone."""
    from stmpl_core.body import Body
    from stmpl_core.living import living

    layers = {"one material (the paper's arm)": Body.anny().part("left_arm", edge_length=3e-3, thickness=7.5e-3),
              "layers (a forearm as measured)": living(Body.anny(), "left_forearm", edge_length=3e-3)}  # fmt: skip
    return {name: Skin.of(layer, MomentNet()) for name, layer in layers.items()}


def scattered(skin: Skin, n: int) -> np.ndarray:
    """Poses of a ball of 12 mm that presses here and there, (n, 1, 4, 4)."""
    from fem_tools.scenes import Site

    layer, site, rng = skin.layer, Site(skin.layer), np.random.default_rng(0)
    inner = np.flatnonzero(site.border_distance > 0.5 * site.border_distance.max())
    poses = np.tile(np.eye(4), (n, 1, 1, 1))
    for k, v in enumerate(rng.choice(inner, n)):
        poses[k, 0] = site.standing(int(v), 10e-3, 0.0)
        poses[k, 0, :3, 3] -= DEPTH * layer.thickness[v] * poses[k, 0, :3, 2]
    return poses


def rows(skin: Skin, tool: Tool, what: str) -> dict[str, Row]:
    """Who answers a batch of scenes, by name."""
    n, cores, fields, steps = N[what], len(os.sched_getaffinity(0)), what == "fields", what == "steps"
    poses, wanted, friction = scattered(skin, n), range(n) if fields else (), FRICTION if steps else None
    simulator = Simulator(skin, friction=friction)

    def loop() -> None:
        for pose in poses[:, 0]:
            if steps:
                simulator.touch([Contact(tool, pose)], State(), STEP)
                continue
            touches = simulator.touch([Contact(tool, pose)])
            if fields:
                simulator.answer(touches)

    out: dict[str, Row] = {f"Simulator.{'step' if fields else 'touch'} in a loop": (loop, n)}
    begins = [None] * n if steps else None
    for threads in dict.fromkeys((1, cores)):
        batch = Batch(skin, [tool], n, threads=threads, friction=friction)
        name = f"Batch, {threads} thread{'s' * (threads > 1)}"
        out[name] = (lambda batch=batch: batch.touch(poses, begins, STEP, fields=wanted)), n
    if fields and not skin.layer.stacked:
        skin = Skin.of(skin.layer, MomentNet(sticks=False))
    many = np.resize(poses, (ON_GPU, *poses.shape[1:]))
    return out | {
        "WarpBatch, cpu": _on_device(skin, tool, poses, wanted, friction, "cpu"),
        f"WarpBatch, cuda, {ON_GPU:,} scenes": _on_device(skin, tool, many, range(ON_GPU) if fields else (), friction,
                                                         "cuda"),
    }


def _on_device(skin: Skin, tool: Tool, poses: np.ndarray, wanted: Iterable[int], friction: str | None,
               device: str) -> Row:  # fmt: skip
    """WarpBatch on a device of Warp's; on a GPU the poses lie there already, and what it says stays there.

    With friction its scenes remember: on the CPU's cores.
    """
    try:
        import warp as wp

        from stmpl_core.gpu.warp_batch import WarpBatch

        wp.config.quiet = True
        if device == "cuda" and not wp.is_cuda_available():
            return NO_CUDA
        batch = WarpBatch(skin, [tool], len(poses), friction=friction, device=device)
        begins = batch.at_rest() if friction else None
        there = wp.array(np.ascontiguousarray(poses), dtype=wp.float64, device=device)
        batch.touch(there, begins, STEP, fields=wanted)
    except (ImportError, StmplError) as error:
        return f"not measured: {error}"

    def call() -> None:
        batch.touch(there, begins, STEP, fields=wanted)
        wp.synchronize_device(batch.device)

    return call, len(poses)


def rates(of: dict[str, Row], rounds: int = ROUNDS) -> Rates:
    """What each gets done."""
    calls = {name: row for name, row in of.items() if not isinstance(row, str)}
    out: Rates = {name: [] for name in calls}
    for call, _ in calls.values():
        call()
    for turn in range(rounds):
        for name in calls if turn % 2 else reversed(calls):
            call, n = calls[name]
            start, busy, done = time.perf_counter(), time.process_time(), 0
            while not done or time.perf_counter() - start < TURN_S:
                call()
                done += n
            out[name].append((done / (time.perf_counter() - start), done / (time.process_time() - busy)))
    return out


def table(of: dict[str, Row], found: Rates, what: str) -> list[str]:
    """Lines of a table."""
    first = np.array(next(iter(found.values())))
    lines = [f"| | {what} a second | ... of a core's time | over the loop |", "| --- | --- | --- | --- |"]
    for name, row in of.items():
        if isinstance(row, str):
            lines.append(f"| {name} | {row} | | |")
            continue
        at = 0 if "cuda" in name else 1  # a GPU is not measured by what its host does
        clock, core = np.median(found[name], axis=0)
        times = np.median(np.array(found[name])[:, at] / first[:, at])
        lines.append(f"| {name} | {clock:,.0f} | {f'{core:,.0f}' if at else ''} | {times:.2f} |")
    return lines


def profile(skin: Skin, tool: Tool) -> list[str]:
    """Where Batch on one thread spends its time, share by share, and a core's rate without the interpreter's part."""
    import cProfile
    import pstats

    poses = scattered(skin, N["touches"])
    batch, watch = Batch(skin, [tool], len(poses), threads=1), cProfile.Profile()
    batch.touch(poses)
    watch.enable()
    for _ in range(4):
        batch.touch(poses)
    watch.disable()
    found: dict[tuple[str, int, str], tuple[int, int, float, float]] = pstats.Stats(watch).stats  # type: ignore
    total = sum(own for _, _, own, _, *_ in found.values())
    ordered = sorted(((own / total, many, Path(place[0]).name, place[2])
                      for place, (many, _, own, *_) in found.items()), reverse=True)  # fmt: skip
    return [f"  {share:5.1%}  {many / (4 * len(poses)):5.1f} calls a touch  {file}:{name}"
            for share, many, file, name in ordered[:24]]  # fmt: skip


def main() -> None:
    """Measures and prints."""
    from benchmarks.tools import ball

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--profile", action="store_true", help="choice to say where Batch spends its time")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="turns of each")
    given, tool = parser.parse_args(), ball(12)
    for name, skin in skins().items():
        for what, n in N.items():
            of = rows(skin, tool, what)
            found = rates(of, given.rounds)
            aim = f"; the aim is {AIM:,} a core" if what == "touches" else ""
            print(f"\n{name}: {what}, {n} scenes, load {os.getloadavg()[0]:.1f}{aim}:\n\n" +
                  "\n".join(table(of, found, what)), flush=True)  # fmt: skip
        if given.profile:
            print("\n".join(profile(skin, tool)), flush=True)


if __name__ == "__main__":
    main()
