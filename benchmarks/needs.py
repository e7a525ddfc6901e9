"""The map of needs: how far the best single layer without a skin is from a layer under one.

    .venv/bin/python -m benchmarks.needs        # writes docs/pictures/needs.png; half a minute

Each place is one fit of (E, t) to tools of half, once and twice the size: force and motion, the worst of the three.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.progress import track

from stmpl_core import Membrane, Tissue
from stmpl_core.regions import region
from stmpl_core.stack import Misfit, effective, nearest, plies

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "needs.png"
MODULUS, THICKNESS, NU, SHEET = 3e3, 0.02, 0.45, 1e-4  # any: only ratios count [Pa], [m], [-], [m]
SIZES = np.geomspace(0.1, 4, 21)  # radius of the contact over thickness of the layer
KAPPAS, PULLS = np.geomspace(0.03, 30, 21), np.geomspace(0.003, 1, 21)
SPREAD = (0.5, 1.0, 2.0)  # sizes of tools that one fit serves, over the middle one
SLIGHT = 1e-3  # kappa of a skin that only pulls
LEVELS = (0, 2, 5, 10, 15, 20, 30, 40, 60)  # %
MARKED = {"forearm": (6, 6), "back": (6, -3), "thigh": (-6, -3), "abdomen": (2, 7)}  # offset of a name [points]
CONTACT = 12e-3  # radius of a contact as a fingertip or a 20 mm ball makes it, where regions are marked [m]


def misfit(kappa: float, pull: float, size: float) -> Misfit:
    """What the best bare layer misses of one under a skin, for contacts around `size` thicknesses."""
    stiffness, tension = (each * MODULUS * THICKNESS for each in (kappa, pull))
    tissue = Tissue(MODULUS, NU, skin=Membrane(stiffness / SHEET, SHEET, tension))
    return nearest(plies(tissue, THICKNESS), tissue.skin, None, [size * THICKNESS * s for s in SPREAD]).misfit


def maps() -> list[np.ndarray]:
    """Force and motion [%], (2, skins, sizes) each: over kappa without a tension, over T / (E t) with a slight skin."""
    over = [[(kappa, 0.0) for kappa in KAPPAS], [(SLIGHT, pull) for pull in PULLS]]
    cells = [[[misfit(*skin, size) for size in SIZES] for skin in track(skins)] for skins in over]
    return [100 * np.moveaxis(np.array(each), -1, 0) for each in cells]


def draw(found: list[np.ndarray], path: Path) -> None:
    """Draws force above motion, kappa beside tension, with regions of the body by their effective layer."""
    figure, axes = plt.subplots(2, 2, figsize=(10.5, 8), layout="constrained", sharex=True)
    layers = {name: effective(region(name).tissue, region(name).thickness) for name in MARKED}
    shown = None
    for row, what in enumerate(("force", "motion")):
        for column, (skins, label) in enumerate(((KAPPAS, r"$\kappa = E_s h / (E t)$"), (PULLS, r"$T / (E t)$"))):
            axis = axes[row, column]
            shown = axis.contourf(SIZES, skins, found[column][row], LEVELS, cmap="YlOrRd", extend="max")
            line = axis.contour(SIZES, skins, found[column][row], [10], colors="k", linewidths=1.6)
            axis.clabel(line, fmt="10 %%", fontsize=9)
            for name, layer in layers.items():
                at = CONTACT / layer.thickness, (layer.kappa, layer.pull)[column]
                axis.plot(*at, "o", color="navy", ms=5, mec="white")
                side = "left" if MARKED[name][0] > 0 else "right"
                axis.annotate(name, at, MARKED[name], textcoords="offset points", ha=side, fontsize=9, color="navy")
            axis.set(xscale="log", yscale="log", ylabel=label)
            axis.set_title(f"{what}, {('skin that only stretches', 'skin that only pulls')[column]}", fontsize=11)
            axis.set_xticks([0.1, 0.2, 0.5, 1, 2, 4], ["0.1", "0.2", "0.5", "1", "2", "4"])
            axis.minorticks_off()
            if row:
                axis.set_xlabel("radius of the contact / thickness of the layer")
    figure.colorbar(shown, ax=axes, label="error of the best single layer without a skin [%]", shrink=0.8)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Computes and draws the map."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--picture", type=Path, default=PICTURE)
    draw(maps(), given.parse_args().picture)


if __name__ == "__main__":
    main()
