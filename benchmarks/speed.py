"""What a touch, its local model, a field and a whole step cost: another tree and this one, side by side in one run.

    .venv/bin/python -m benchmarks.speed --against ../before      # prints the tables of docs/speed.md; some minutes
    .venv/bin/python -m benchmarks.speed                          # this tree alone

Each tree answers in a process of its own, on one thread. They take turns of a tenth of a second, scene by scene, so
that what else the machine does falls on both. A figure is the median over all turns, in
brackets the 99th percentile over it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve()
ONE = {name: "1" for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
DEPTH = 0.3  # of each tool, over the thickness
TURN_S = 0.1
ROUNDS = 6
AIMS = {  # ms: by pose, by wrench, local model, field, step; what was set as an aim for the paper's arm
    "ball, r 12 mm": (0.25, 0.4, 0.4, None, None), "fingertip, r 8 mm": (0.25, 0.4, 0.4, 0.6, 1.0),
    "capsule, r 8 mm": (0.25, 0.4, 0.4, None, None), "disc, r 20 mm": (0.5, 0.8, 0.9, 1.2, 2.0),
    "letter H, 26 mm": (0.5, 0.8, 0.9, 1.2, 2.0), "two fingertips": (0.5, 0.8, 0.9, None, None),
}  # fmt: skip
WHAT = ("by pose", "by wrench", "local model", "field", "step")
NODES, DISTANCES = 80, 1500  # of a touch: contact nodes, and places at which the tool's distance is asked, about


def calls() -> dict[str, dict[str, Callable[[int], object]]]:
    """By scene and quantity, what is timed; the argument is the number of the call: the tool slides to and fro."""
    from benchmarks.tools import ball, block_letter, fingertip, flat
    from fem_tools.press import Press
    from fem_tools.scenes import Site
    from stmpl_core.body import Body
    from stmpl_core.contact import Contact
    from stmpl_core.living import living
    from stmpl_core.local_contact import local_contacts
    from stmpl_core.methods import MomentNet
    from stmpl_core.sdf import SignedDistance
    from stmpl_core.simulator import Simulator

    arm = Body.anny().part("left_arm", edge_length=3e-3, thickness=7.5e-3)
    paper = {"ball, r 12 mm": [ball(12)], "fingertip, r 8 mm": [fingertip(8, 10)],
             "capsule, r 8 mm": [fingertip(8, 30)], "disc, r 20 mm": [flat(20, 1.5)],
             "letter H, 26 mm": [block_letter("H", 26)],
             "two fingertips": [fingertip(6.5, 8), fingertip(6.5, 8)]}  # fmt: skip
    rows = [(name, arm, tools) for name, tools in paper.items()]
    for part in ("forearm", "thigh"):
        rows.append((f"{part} as measured: ball, r 20 mm", living(Body.anny(), f"left_{part}", edge_length=3e-3),
                     [ball(20)]))  # fmt: skip
    simulators: dict[int, Simulator] = {}
    out: dict[str, dict[str, Callable[[int], object]]] = {}
    for name, layer, tools in rows:
        simulator = simulators.setdefault(id(layer), Simulator(layer, MomentNet()))
        site = Site(layer)
        pose = site.standing(int(np.argmax(site.border_distance)), 10e-3, 0.4)
        apart = 11e-3 if len(tools) > 1 else 0.0
        contacts: list[list[Contact]] = []
        for k, tool in enumerate(tools):
            start = pose.copy()
            start[:3, 3] += (2 * k - 1) * apart * pose[:3, 0] + 40e-3 * pose[:3, 2]
            press = Press(SignedDistance.of(tool, margin=0.03), start, -pose[:3, 2]).touching(layer)
            assert press is not None
            at, across = press.at(DEPTH * float(np.median(layer.thickness))), press.sideways(1.0)[1]
            named = tool.named(f"tool {k}")
            contacts.append([Contact(named, at.shifted(2e-3 * np.sin(0.07 * n) * across).pose_body_from_tool)
                             for n in range(90)])  # fmt: skip
        by_pose = list(zip(*contacts, strict=True))
        touches = [simulator.touch(one) for one in by_pose]
        by_wrench = [[Contact(c.tool, c.pose_body_from_tool, np.concatenate([t.wrench[:3], np.zeros(3)]))
                      for c, t in zip(one, found, strict=True)]
                     for one, found in zip(by_pose, touches, strict=True)]  # fmt: skip
        out[name] = {
            "by pose": lambda n, s=simulator, c=by_pose: s.touch(c[n % 90]),
            "by wrench": lambda n, s=simulator, c=by_wrench: s.touch(c[n % 90]),
            "local model": lambda n, s=simulator, t=touches: local_contacts(s.history, t[n % 90]),
            "field": lambda n, s=simulator, t=touches: s.answer(t[n % 90]),
            "step": lambda n, s=simulator, c=by_pose: s.step(c[n % 90]),
        }
    return out


def work() -> None:
    """A worker: says which scenes it has; then for each line on its input times what the line names."""
    every = calls()
    print(json.dumps({name: list(row) for name, row in every.items()}), flush=True)
    for line in sys.stdin:
        scene, what = json.loads(line)
        call, spent, n = every[scene][what], [], 0
        call(0)
        end = time.perf_counter() + TURN_S
        while time.perf_counter() < end or n < 3:
            start = time.perf_counter()
            call(n)
            spent.append(1e3 * (time.perf_counter() - start))
            n += 1
        print(json.dumps(spent), flush=True)


class Worker:
    """A tree in a process of its own."""

    def __init__(self, tree: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", str(HERE), "--worker"], cwd=tree, text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=os.environ | ONE | {"PYTHONPATH": str(tree)},
        )  # fmt: skip
        self.scenes: dict[str, list[str]] = self._read()

    def _read(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def turn(self, scene: str, what: str) -> list[float]:
        """Times of some calls [ms]."""
        assert self._process.stdin is not None
        print(json.dumps([scene, what]), file=self._process.stdin, flush=True)
        return self._read()

    def end(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def measure(trees: Sequence[Path], rounds: int = ROUNDS) -> dict[str, dict[str, list[list[float]]]]:
    """All times [ms] by scene, quantity and tree."""
    from rich.progress import track

    workers = [Worker(tree) for tree in trees]
    names = workers[-1].scenes
    out = {scene: {what: [[] for _ in trees] for what in row} for scene, row in names.items()}
    for turn in track(range(rounds), "turns"):
        for scene, row in names.items():
            for what in row:
                order = range(len(workers)) if turn % 2 else reversed(range(len(workers)))
                for k in order:
                    out[scene][what][k] += workers[k].turn(scene, what)
    for worker in workers:
        worker.end()
    return out


def table(times: dict[str, dict[str, list[list[float]]]]) -> list[str]:
    """Lines of a table: medians of the old tree and the new, the aim where there is one, p99 over the median."""
    both = len(next(iter(times["ball, r 12 mm"].values()))) > 1
    out = ["| scene | " + " | ".join(WHAT) + " |", "| --- |" + " --- |" * len(WHAT)]
    for scene, row in times.items():
        cells = []
        for k, what in enumerate(WHAT):
            now, aim = row[what][-1], (AIMS.get(scene) or (None,) * 5)[k]
            p50, p99 = np.percentile(now, (50, 99))
            before = f"{np.median(row[what][0]):.2f} → " if both else ""
            cells.append(f"{before}**{p50:.2f}** ({p99 / p50:.1f})" + (f" / {aim:g}" if aim else ""))
        out.append(f"| {scene} | " + " | ".join(cells) + " |")
    return out


def limit() -> str:
    """What the arithmetic of a touch by pose would take at one core's measured peak, as a sentence."""
    import numba

    @numba.njit(fastmath=True)
    def fused(x: np.ndarray, times: int) -> float:
        for _ in range(times):
            for n in range(len(x)):
                x[n] = x[n] * 0.999 + 1e-3
        return x.sum()

    x = np.ones(2048)
    fused(x, 1)
    best = np.inf
    for _ in range(20):
        start = time.perf_counter()
        fused(x, 2000)
        best = min(best, time.perf_counter() - start)
    peak = 2 * 2000 * len(x) / best
    splines, pairs = DISTANCES * 2 * 84, NODES**2 / 2 * 2 * 40  # 64 + 16 + 4 products a spline; 7 tables a pair
    iterations = 15 * 2 * NODES**2
    flops = splines + pairs + iterations
    return (f"A touch by pose takes about {flops / 1e6:.2f} million floating-point operations ({DISTANCES} distances, "
            f"{NODES} nodes): {1e3 * flops / peak:.3f} ms at the {peak / 1e9:.0f} GFLOP/s that this core reached.")


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="turns of each tree")
    given = parser.parse_args()
    if given.worker:
        work()
        return
    trees = [*([given.against.resolve()] if given.against else []), HERE.parents[1]]
    print("\n".join(table(measure(trees, given.rounds))))
    print(f"\n{limit()}")


if __name__ == "__main__":
    main()
