"""What peers cost and how far off they are: one smooth disc on the arm, at a small, a middling and a large pressure.

    .venv/bin/python -m studies.peers.compare            # prints one table for each pressure, a few minutes
    .venv/bin/python -m studies.peers.compare felupe 0.3 # only this peer beside ours, only at this p / E
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from fem_tools.patch import PatchFem
from stmpl_core.arrays import VertexVectors
from stmpl_core.body import Body
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods import Method
from studies.peers import installed, peer
from studies.tets import TetFem

EDGE_LENGTH, RADIUS, EDGE = 6e-3, 12e-3, 4e-3  # m
RATIOS = (0.05, 0.3, 1.0)  # p / E
STILL = {"timestep": 0.1, "damping": 0.0}  # long implicit steps: Newton's method in disguise
VARIANTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("mujoco_flex", {}),
    ("mujoco_flex", STILL),
    ("mujoco_flex", {"material": "snh"}),
    ("mujoco_flex", {"material": "snh", **STILL}),
    ("mujoco_flex", {"material": "snh", "layers": 1, **STILL}),
    ("mujoco_flex", {"material": "snh", "layers": 4, **STILL}),
    ("mujoco_flex", {"material": "snh", "layers": 3, "refine": 1, **STILL}),
    ("newton_vbd", {}),
    ("newton_vbd", {"iterations": 20}),
    ("newton_vbd", {"timestep": 0.02, "iterations": 50, "damping": 0.0}),
    ("newton_vbd", {"layers": 1}),
    ("newton_vbd", {"layers": 3, "refine": 1, "iterations": 20}),
    ("felupe", {"layers": 1}),
    ("felupe", {}),
    ("felupe", {"solver": "pypardiso"}),
    ("felupe", {"reach": 3.0}),
    ("felupe", {"layers": 4}),
    ("felupe", {"element": "hex20", "layers": 1, "solver": "pypardiso"}),
)
OURS: tuple[tuple[str, Method], ...] = (
    ("PatchFem()", PatchFem()), ("PatchFem(refine=1)", PatchFem(refine=1)), ("TetFem(layers=2)", TetFem(layers=2)),
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One method under one load: seconds, errors in % of the peak, and what it said of itself."""

    name: str
    first: float  # to set up and solve a tenth of the load
    seconds: float
    mean: float
    at_peak: float
    said: str


def measure(name: str, method: Method, layer: SoftLayer, load: Load, truth: VertexVectors) -> Row:
    """A warm solve, set up by a smaller load on the same vertices; the quickest of three, unless it is slow."""
    start = time.process_time()
    method.prepare(layer).solve(load.scaled(0.1))
    first, seconds, answer = time.process_time() - start, [], None
    while not seconds or (len(seconds) < 3 and sum(seconds) < 2):
        start = time.process_time()
        answer = method.solve(load)
        seconds.append(time.process_time() - start)
    assert answer is not None
    size, off = np.linalg.norm(truth, axis=1), np.linalg.norm(answer.displacement - truth, axis=1)
    peak = int(size.argmax())
    scale = 100 / size[peak]
    moved = float(np.linalg.norm(answer.displacement[peak]))
    mean = scale * float(off[size > 0.1 * size[peak]].mean())
    return Row(name, first, min(seconds), mean, scale * moved - 100, answer.trust.why or "ok")


def main() -> None:
    """Prints the tables."""
    threadpool_limits(1)
    console, wanted = Console(width=170), sys.argv[1] if len(sys.argv) > 1 else ""
    layer = Body.anny().part("left_arm", edge_length=EDGE_LENGTH)
    away = np.linalg.norm(layer.vertices[:, None] - layer.vertices[layer.border][None, ::5], axis=2).min(axis=1)
    x = np.clip((RADIUS - np.linalg.norm(layer.vertices - layer.vertices[away.argmax()], axis=1)) / EDGE + 0.5, 0, 1)
    shape = x * x * (3 - 2 * x)
    for ratio in [float(word) for word in sys.argv[2:]] or RATIOS:
        load = Load.pressure(ratio * layer.tissue.youngs_modulus * shape)
        truth = PatchFem(refine=2, layers=2).prepare(layer).solve(load).displacement
        peak = 1e3 * np.linalg.norm(truth, axis=1).max()
        title = f"p/E {ratio:g}, peak {peak:.3f} mm; errors against PatchFem(refine=2, layers=2)"
        table = Table("method", "first s", "s", "mean error %", "at the peak %", "says", title=title)
        rows = [measure(name, method, layer, load, truth) for name, method in OURS]
        for name, knobs in VARIANTS:
            if name in installed() and name.startswith(wanted) and find_spec(knobs.get("solver", "numpy")):
                words = f"{name}({', '.join(f'{k}={v}' for k, v in knobs.items())})"
                rows.append(measure(words, peer(name)(**knobs), layer, load, truth))
        for row in rows:
            figures = f"{row.first:.2f}", f"{row.seconds:.3f}", f"{row.mean:.2f}", f"{row.at_peak:+.2f}"
            table.add_row(row.name, *figures, row.said)
        console.print(table)


if __name__ == "__main__":
    main()
