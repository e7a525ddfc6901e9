"""The maps of time and slip: how far an answer without a state is off, over what a tool does.

    .venv/bin/python -m benchmarks.needs_of_state        # writes docs/pictures/needs_of_state.png; ten seconds

Each place is one stroke of a ball (`stmpl_core.stroke`), as `stmpl needs` plays it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.progress import track

from stmpl_core.needs import stroke_of
from stmpl_core.regions import HELD_SKIN, region
from stmpl_core.relaxation import fades_under, series_of
from stmpl_core.stack import ball
from stmpl_core.stroke import played, without_time

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "needs_of_state.png"
PART, RADIUS, FORCE = "forearm", 20e-3, 2.0  # of the ball [m], [N]
SPEEDS, STAYS = np.geomspace(5e-5, 0.5, 25), np.geomspace(0.03, 300, 25)  # [m/s], [s]
FRICTIONS, WAYS = np.geomspace(0.03, 1.5, 21), np.geomspace(0.01, 3, 25)  # [-], over the radius of the contact
TIMES, SLIPS = (0, 2, 5, 10, 15, 20, 30, 40), (0, 2, 5, 10, 20, 30, 50, 80, 120)  # levels [%]


def maps() -> tuple[np.ndarray, np.ndarray]:
    """Force and motion without time, (2, STAYS, SPEEDS), and without slip, (2, FRICTIONS, WAYS) [%]."""
    part = region(PART)
    eases = part.tissue.relaxing(HELD_SKIN), part.thickness
    series, pressed = series_of(*eases), ball(part.tissue, part.thickness, RADIUS, force=FORCE)
    still = stroke_of(part.tissue, part.thickness, pressed, np.inf, 0.0, 0.0)
    still = still._replace(fades=fades_under(*eases, still.radius))

    def late(speed: float, stays: float) -> tuple[float, float]:
        return without_time([still._replace(speed=speed, stays=stays)], series, 0.0)[:2]

    def stuck(way: float, friction: float) -> tuple[float, float]:
        course = played(still._replace(way=way * still.radius), series, friction)
        return course.drag.max() / course.force.max(), course.offset.max() / still.depth

    time = [[late(v, stays) for v in SPEEDS] for stays in track(STAYS)]
    slip = [[stuck(way, mu) for way in WAYS] for mu in track(FRICTIONS)]
    time, slip = (100 * np.moveaxis(np.array(each), -1, 0) for each in (time, slip))
    return time, slip


def draw(time: np.ndarray, slip: np.ndarray, path: Path) -> None:
    """Draws time beside slip, force above motion."""
    figure, axes = plt.subplots(2, 2, figsize=(10.5, 8), layout="constrained")
    what = (("force, elastic instead of relaxing", "skin left behind by the lifted tool, of the depth"),
            ("friction, over the normal force", "way of skin that is dragged along, over the depth"))  # fmt: skip
    scenes = (
        (1e3 * SPEEDS, STAYS, time, TIMES, "speed of press and lift [mm/s]", "time that it stays pressed in [s]"),
        (WAYS, FRICTIONS, slip, SLIPS, "way along the skin / radius of the contact", "coefficient of friction"),
    )
    for column, (x, y, found, levels, along, up) in enumerate(scenes):
        for row in range(2):
            axis = axes[row, column]
            shown = axis.contourf(x, y, found[row], levels, cmap="YlOrRd", extend="max")
            axis.contour(x, y, found[row], [10], colors="k", linewidths=1.6)
            axis.set(xscale="log", yscale="log", xlabel=along, ylabel=up)
            axis.set_title(f"without {('time', 'slip')[column]}: {what[column][row]}", fontsize=10)
            figure.colorbar(shown, ax=axis, label="[%]")
    for row in range(2):
        axes[row, 1].set_yticks([0.03, 0.1, 0.2, 0.5, 1], ["0.03", "0.1", "0.2", "0.5", "1"])
    figure.suptitle(f"A ball of {RADIUS * 1e3:g} mm on the {PART} under {FORCE:g} N: how far an answer without a state "
                    "is off; black: 10 %")  # fmt: skip
    figure.savefig(path, dpi=110)


def main() -> None:
    """Computes and draws the maps."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--picture", type=Path, default=PICTURE)
    draw(*maps(), given.parse_args().picture)


if __name__ == "__main__":
    main()
