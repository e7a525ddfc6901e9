"""How much network a scene needs: error against the number of weights, and against the width of the skin's mesh.

python -m benchmarks.learned --data data/default [--steps 8000] [--out docs/pictures/learned.png]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from fem_tools import PatchFem
from fem_tools.dataset import Dataset, data_card
from fem_tools.scenes import Site, UnusableContact, ellipse, letter
from stmpl_core import Load
from stmpl_core.body import Body
from stmpl_core.methods import Linear, Method, MomentNet
from stmpl_core.metrics import Score, mean_and_deviation, score
from stmpl_core.networks import shipped
from stmpl_core.provenance import machine
from studies.train_moments import MomentTraining, draw_points, fit

HIDDEN = (4, 8, 16, 32, 64, 128)
EDGES = (2.5e-3, 3e-3, 4e-3, 5e-3, 6e-3)  # m, of the skin's mesh
SPLITS = {"test": "held-out contacts", "ood": "hands, bands, letters", "held_out": "calf and thigh"}


def judged(data: Dataset, method: Method, split: str, count: int) -> Score:
    """Mean score over about `count` samples of a split, under follower pressure."""
    subset = data.split(split, kind="pressure")  # type: ignore[arg-type]
    layer, scores = None, []
    for k in np.linspace(0, len(subset) - 1, min(count, len(subset))).astype(int):
        sample = subset[int(k)]
        if sample.layer is not layer:
            layer = sample.layer
            method.prepare(layer)
        scores.append(score(method.solve(sample.load).displacement, sample.displacement, layer, sample.load))
    return mean_and_deviation(scores)[0]


def by_weights(data: Path, steps: int, count: int, work: Path) -> dict[str, list[dict]]:
    """Networks of several widths, trained alike, on each split; the linear response as width 0."""
    source = Dataset.open(data)
    points = draw_points(source, MomentTraining(points=64), lambda *_: None)
    card = shipped("moment_net").card
    rows: dict[str, list[dict]] = {split: [] for split in SPLITS}
    for hidden in (0, *HIDDEN):
        start = time.perf_counter()
        if hidden:
            folder = work / f"hidden_{hidden}"
            folder.mkdir(parents=True, exist_ok=True)
            model = fit(points, MomentTraining(hidden=hidden, steps=steps), folder, lambda *_: None)
            method: Method = MomentNet(model.weights(dict(card)))
            weights = sum(p.numel() for p in model.parameters())
        else:
            method, weights = Linear(), 0
        minutes = (time.perf_counter() - start) / 60
        for split in SPLITS:
            s = judged(source, method, split, count)
            rows[split].append({"weights": weights, "mee": s.mee_share, "much": s.much / s.peak, "minutes": minutes})
            print(f"{weights:7} weights, {split:9} MEE {s.mee_share:7.2%}, where it moves {s.much / s.peak:7.2%}, "
                  f"peak {s.peak_share:+7.2%} ({minutes:.1f} min)", flush=True)  # fmt: skip
    return rows


def by_edge(net: MomentNet, ratio: float = 0.6) -> dict[str, list[dict]]:
    """The same contacts on ever coarser skins against FEM on that skin, split until its triangles are about 1.5 mm."""
    rows: dict[str, list[dict]] = {"disc, 12 mm": [], "letter, 30 mm": []}
    outlines = {"disc, 12 mm": ellipse(0.012, 0.012), "letter, 30 mm": letter("K", 0.03)}
    where = Body.anny().part("left_arm", edge_length=EDGES[0])
    anchor = where.vertices[int(np.argmin(np.linalg.norm(where.vertices - where.vertices.mean(axis=0), axis=1)))]
    for edge in EDGES:
        layer = Body.anny().part("left_arm", edge_length=edge, thickness=7.5e-3)
        fem = PatchFem(refine=max(1, round(np.log2(edge / 1.5e-3)))).prepare(layer)
        net.prepare(layer)
        site, order = Site(layer), np.linalg.norm(layer.vertices - anchor, axis=1).argsort()
        for name, outline in outlines.items():
            shares = []
            for vertex in order[::60][:6]:
                try:
                    footprint = site.press_flat(int(vertex), outline, 0.3).footprint
                except UnusableContact:
                    continue
                load = Load.pressure(ratio * layer.tissue.youngs_modulus * footprint)
                truth = fem.solve(load)
                s = score(net.solve(load).displacement, truth.displacement, layer, load)
                shares.append((s.mee_share, s.much / s.peak, abs(s.peak_share)))
            mee, much, peak = np.mean(shares, axis=0)
            rows[name].append({"edge": edge, "mee": mee, "much": much, "peak": peak, "contacts": len(shares)})
            print(f"edges {edge * 1e3:.1f} mm, {name}: MEE {mee:.2%}, where it moves {much:.2%}, peak {peak:.2%} "
                  f"({len(shares)} contacts)", flush=True)  # fmt: skip
    return rows


def draw(weights: dict, edges: dict, note: str, out: Path) -> None:
    """Two panels: error against weights, and against mesh width."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for k, (split, rows) in enumerate(weights.items()):
        x = [max(row["weights"], 100) for row in rows]
        left.loglog(x, [100 * row["much"] for row in rows], "o-", color=f"C{k}", label=SPLITS[split])
        left.loglog(x, [100 * row["mee"] for row in rows], "o:", color=f"C{k}", mfc="white")
    left.set_xlabel("weights (leftmost: none, the linear response)")
    left.set_ylabel("error [% of the largest displacement]")
    left.set_title("How many weights", fontsize=10)
    left.legend(fontsize=8, title="solid: where it moves > 10 % of the peak\ndotted: MEE", title_fontsize=8)
    for k, (name, rows) in enumerate(edges.items()):
        x = [1e3 * row["edge"] for row in rows]
        right.plot(x, [100 * row["much"] for row in rows], "o-", color=f"C{k}", label=name)
        right.plot(x, [100 * row["mee"] for row in rows], "o:", color=f"C{k}", mfc="white")
    right.set_ylim(bottom=0)
    right.set_xlabel("edges of the skin's mesh [mm] (trained on 4 mm)")
    right.set_title("How fine a skin", fontsize=10)
    right.legend(fontsize=8)
    for axis in (left, right):
        axis.grid(alpha=0.3, which="both")
    figure.suptitle(note, fontsize=8)
    figure.savefig(out, dpi=110)


def main() -> None:
    """Trains, measures, draws."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--data", type=Path, default=Path("data/default"))
    given.add_argument("--steps", type=int, default=8000, help="of each training")
    given.add_argument("--count", type=int, default=150, help="samples a split")
    given.add_argument("--work", type=Path, default=Path("runs/learned"))
    given.add_argument("--out", type=Path, default=Path("docs/pictures/learned.png"))
    options = given.parse_args()
    weights = by_weights(options.data, options.steps, options.count, options.work)
    edges = by_edge(MomentNet())
    manifest = Dataset.open(options.data).manifest
    card = data_card(options.data, manifest)
    note = f"follower pressure; data {card['preset']}, {options.steps} steps each; {machine()}"
    options.work.mkdir(parents=True, exist_ok=True)
    (options.work / "learned.json").write_text(json.dumps({"weights": weights, "edges": edges, "note": note}, indent=1))
    draw(weights, edges, note, options.out)
    print(options.out)


if __name__ == "__main__":
    main()
