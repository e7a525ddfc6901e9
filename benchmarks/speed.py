"""What a touch, its local model, a field and a whole step cost: another tree and this one, side by side in one run.

    .venv/bin/python -m benchmarks.speed --against ../before --write    # the table of docs/speed.md; some minutes
    .venv/bin/python -m benchmarks.speed                                # this tree alone

Each tree answers in a process of its own, on one thread. They take turns of a tenth of a second, scene by scene, so
that what else the machine does falls on both. A figure is the processor's time, in the median over all turns, in
brackets the 99th percentile over it. The limit of a row is what its arithmetic alone would take at the peak of one
core, and its memory at the rate of a copy, both as measured here; see `least_work`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
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
AIMS = {  # ms: by pose, by wrench, touch and local model, field, step; what was set as an aim for the paper's arm
    "ball, r 12 mm": (0.25, 0.4, 0.4, None, None), "fingertip, r 8 mm": (0.25, 0.4, 0.4, 0.6, 1.0),
    "capsule, r 8 mm": (0.25, 0.4, 0.4, None, None), "disc, r 20 mm": (0.5, 0.8, 0.9, 1.2, 2.0),
    "letter H, 26 mm": (0.5, 0.8, 0.9, 1.2, 2.0), "two fingertips": (0.5, 0.8, 0.9, None, None),
    "band, 25 mm": (None, None, None, 4.0, 8.0), "hand": (None, None, None, 4.0, 8.0),
}  # fmt: skip
WHAT = ("by pose", "by wrench", "touch and local model", "field", "step")
AROUND = ("band, 25 mm", "hand")  # they hold the limb from all sides: no wrench tells their pose
PAIR = 80 + 45  # operations of a pair: where it is, two tables, two fields; once more for the skin on the tool
NODES, OF_NODE, MOMENTS, STEPS = 160, 110, 40, 14  # nodes that stick: most, operations of a pair; of a moment; products
TOUCH, LIMITS = ("limit of a touch", "limit of a field"), "limits"
DOCS, MARKS = HERE.parents[1] / "docs" / "speed.md", ("<!-- benchmarks.speed -->", "<!-- end -->")
Work = dict[str, list[float]]  # by TOUCH: floating-point operations, and bytes


def least_work(simulator: Any, touches: Any) -> Work:
    """What a touch by pose and its field cannot do without: operations and bytes of each, counted on one instant.

    A touch: four distances for each column under the tool, of 84 products each; the response between each two contact
    nodes; ten products of that matrix; the network at each node. A field: the response of each vertex that is asked
    to each that presses, the network at each, and once more the response for the skin that is laid on the tool; where
    nodes stick, instead the response to each of them, and some products of their matrix. It reads the tables of the
    vertices and writes the answer.
    """
    network = 2 * sum(a.size for a in simulator.toucher.net._network if a.ndim == 2)
    method, many = simulator.method, sum(len(one.pressed.squeeze.nodes.area) for one in touches)
    sticks = method._green is None and method.sticks and many <= NODES
    moved = method.stack if method._green is not None else method.stick if sticks else method.contact
    layers = 2 * sum(a.size for name, a in moved.arrays.items() if name.startswith("w"))
    touch = field = 0.0
    every, near = len(simulator.layer.vertices), simulator.skin.near
    for one in touches:
        nodes, columns = len(one.pressed.squeeze.nodes.area), len(one.pressed.squeeze.vertices)
        touch += 4 * (columns + nodes) * 2 * 84 + nodes**2 / 2 * 2 * 40 + 10 * 2 * nodes**2 + nodes * network
        loaded = np.flatnonzero(one.pressure)
        asked = len(near.asked(loaded).vertices)
        field += asked * ((nodes * OF_NODE + len(loaded) * MOMENTS if sticks else len(loaded) * PAIR) + layers)
        field += nodes**2 / 2 * OF_NODE + STEPS * 2 * (3 * nodes) ** 2 if sticks else 0.0
    return {TOUCH[0]: [touch, 0.0], TOUCH[1]: [field, every * (3 * 8 * 2 + 4 * (10 + 9))]}


def around(name: str, layer: Any) -> tuple[Any, np.ndarray, np.ndarray]:
    """A band pulled tight, or a hand that grasps: tool, pose, and the way along which it slides."""
    import shapely

    from fem_tools.hand import Hand
    from fem_tools.scenes import EDGE, Site, extruded, frame
    from stmpl_core.body import Body

    site = Site(layer)
    vertex = int(np.argmax(site.border_distance))
    axis, normal = site.axis(vertex), layer.normals[vertex]
    if name == "hand":
        pose = frame(layer.vertices[vertex], -normal, np.cross(axis, normal), 0.0)
        return *Hand.of(Body.anny()).grip(layer, pose, 1e-3, [0.0] * 5), axis
    pose = frame(layer.vertices[vertex], axis, normal, 0.0)
    local = (layer.vertices - pose[:3, 3]) @ pose[:3, :3]
    hull = shapely.MultiPoint(local[np.abs(local[:, 2]) <= (25e-3 + EDGE) / 2, :2]).convex_hull
    inside = hull.buffer(-DEPTH * float(np.median(layer.thickness)))
    return extruded(hull.buffer(4e-3).difference(inside), -12.5e-3, 12.5e-3), pose, normal


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
    rows = [(name, arm, tools) for name, tools in paper.items()] + [(name, arm, None) for name in AROUND]
    for part in ("forearm", "thigh"):
        rows.append((f"{part} as measured: ball, r 20 mm", living(Body.anny(), f"left_{part}", edge_length=3e-3),
                     [ball(20)]))  # fmt: skip
    simulators: dict[int, Simulator] = {}
    out: dict[str, dict[str, Callable[[int], object]]] = {}
    for name, layer, tools in rows:
        simulator = simulators.setdefault(id(layer), Simulator(layer, MomentNet()))
        contacts: list[list[Contact]] = []
        if tools is None:
            tool, pose, way = around(name, layer)
            tool = tool.named(name)
            contacts.append([Contact(tool, _along(pose, (0.5e-3 * np.sin(0.07 * n)) * way)) for n in range(90)])
        site = Site(layer)
        pose = site.standing(int(np.argmax(site.border_distance)), 10e-3, 0.4)
        apart = 11e-3 if len(tools or ()) > 1 else 0.0
        for k, tool in enumerate(tools or ()):
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
        out[name] = {
            "by pose": lambda n, s=simulator, c=by_pose: s.touch(c[n % 90]),
            "touch and local model": lambda n, s=simulator, c=by_pose: local_contacts(s.history, s.touch(c[n % 90])),
            "field": lambda n, s=simulator, t=touches: s.answer(t[n % 90]),
            "step": lambda n, s=simulator, c=by_pose: s.step(c[n % 90]),
            LIMITS: lambda n, s=simulator, t=touches: least_work(s, t[0]),
        }
        if tools is not None:
            by_wrench = [[Contact(c.tool, c.pose_body_from_tool, np.concatenate([t.wrench[:3], np.zeros(3)]))
                          for c, t in zip(one, found, strict=True)]
                         for one, found in zip(by_pose, touches, strict=True)]  # fmt: skip
            out[name]["by wrench"] = lambda n, s=simulator, c=by_wrench: s.touch(c[n % 90])
    return out


def _along(pose: np.ndarray, way: np.ndarray) -> np.ndarray:
    moved = pose.copy()
    moved[:3, 3] += way
    return moved


def work() -> None:
    """A worker: says which scenes it has; then for each line on its input times what the line names."""
    every = calls()
    print(json.dumps({name: [what for what in WHAT if what in row] for name, row in every.items()}), flush=True)
    for line in sys.stdin:
        scene, what = json.loads(line)
        call, spent, n = every[scene][what], [], 0
        if what == LIMITS:
            print(json.dumps(call(0)), flush=True)
            continue
        call(0)
        end = time.process_time() + TURN_S
        while time.process_time() < end or n < 3:
            start = time.process_time()
            call(n)
            spent.append(1e3 * (time.process_time() - start))
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

    def turn(self, scene: str, what: str) -> Any:
        """Times of some calls [ms]; of LIMITS its Work."""
        assert self._process.stdin is not None
        print(json.dumps([scene, what]), file=self._process.stdin, flush=True)
        return self._read()

    def end(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def measure(trees: Sequence[Path], rounds: int = ROUNDS
            ) -> tuple[dict[str, dict[str, list[list[float]]]], dict[str, Work]]:  # fmt: skip
    """All times [ms] by scene, quantity and tree, and the least work of each scene in the last."""
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
    work = {scene: workers[-1].turn(scene, LIMITS) for scene in names}
    for worker in workers:
        worker.end()
    return out, work


def table(times: dict[str, dict[str, list[list[float]]]], work: dict[str, Work], flops: float, rate: float
          ) -> list[str]:  # fmt: skip
    """Lines of a table: medians of the old tree and the new, the aim where there is one, p99 over the median; limits.

    Args:
        times: see `measure`.
        work: see `measure`.
        flops: operations a second of the core.
        rate: bytes a second that it copies.
    """
    heads = ["scene", *WHAT, *TOUCH]
    out = ["| " + " | ".join(heads) + " |", "| --- |" + " --- |" * (len(heads) - 1)]
    for scene, row in times.items():
        cells = [scene]
        for k, what in enumerate(WHAT):
            if what not in row:
                cells.append("")
                continue
            old, now, aim = row[what][0], row[what][-1], (AIMS.get(scene) or (None,) * 5)[k]
            p50, p99 = np.percentile(now, (50, 99))
            before = f"{np.median(old):.2f} → " if len(row[what]) > 1 else ""
            cells.append(f"{before}**{p50:.2f}** ({p99 / p50:.1f})" + (f" / {aim:g}" if aim else ""))
        for n, some in work[scene].values():
            cells.append(f"{1e3 * (n / flops + some / rate):.2g}")
        out.append("| " + " | ".join(cells) + " |")
    return out


def peak() -> tuple[float, float]:
    """Operations in float32 a second that one core reaches, and bytes a second that it copies from and to memory."""
    import numba

    @numba.njit(fastmath=True)
    def fused(x: np.ndarray, times: int) -> float:
        b = np.float32(-0.5)
        for _ in range(times):
            for n in range(len(x)):
                v = x[n]
                for _ in range(32):
                    v = v * v + b  # bounded, and no two of these make one
                x[n] = v
        return x.sum()

    def best(call: Callable[[], object]) -> float:
        call()
        spent = []
        for _ in range(20):
            start = time.process_time()
            call()
            spent.append(time.process_time() - start)
        return min(spent)

    x, here, there = np.ones(2048, np.float32), np.ones(1 << 23), np.ones(1 << 23)
    return 2 * 32 * 200 * len(x) / best(lambda: fused(x, 200)), 2 * here.nbytes / best(lambda: np.copyto(there, here))


def write(lines: Sequence[str]) -> None:
    """Puts lines between the marks of docs/speed.md."""
    start, end = MARKS
    text = DOCS.read_text()
    new = re.sub(f"{start}.*?{end}", lambda _: "\n".join([start, *lines, end]), text, flags=re.DOTALL)
    DOCS.write_text(new)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="turns of each tree")
    parser.add_argument("--write", action="store_true", help="choice to put the table into docs/speed.md")
    given = parser.parse_args()
    if given.worker:
        work()
        return
    from stmpl_core.provenance import machine

    trees = [*([given.against.resolve()] if given.against else []), HERE.parents[1]]
    flops, rate = peak()
    times, least = measure(trees, given.rounds)
    before = f", before: {commit(trees[0])}" if given.against else ""
    about = (f"{machine()}, one core: {flops / 1e9:.0f} GFLOP/s in float32, {rate / 1e9:.0f} GB/s; load "
             f"{os.getloadavg()[0]:.1f}{before}.")  # fmt: skip
    lines = [about, "", *table(times, least, flops, rate)]
    print("\n".join(lines))
    if given.write:
        write(lines)


def commit(tree: Path) -> str:
    """The commit of a checkout, short."""
    said = subprocess.run(["git", "-C", tree, "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    return said.stdout.strip() or tree.name


if __name__ == "__main__":
    main()
