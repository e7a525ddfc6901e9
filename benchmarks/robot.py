"""A robot on soft skin in MuJoCo, contact at every step: force kept, energy of press, slide and release, speed.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 .venv/bin/python -m benchmarks.robot       # prints a table; some minutes

The 7-axis arm presses a ball of 20 mm radius on the left forearm, circles at 50 mm/s, and lets go. Steps and
real-time factors are of processor time, so they hold on a busy machine, too, as far as its caches are not shared; the
contact's time is the median by the clock.
"""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table

from stmpl_sim.massage import Course, Massage
from stmpl_sim.scene import build
from stmpl_sim.site import Site
from stmpl_sim.verbs import figures_of, limb

RADIUS, CIRCLE = 0.02, 0.012  # of the ball, of the circles [m]


def main() -> None:
    """Measures each tissue at each rate, and prints a row for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--force", type=float, default=5.0, help="force to press with [N]")
    parser.add_argument("--laps", type=float, default=1.0, help="laps of the circle")
    parser.add_argument("--rates", type=float, nargs="+", default=[1000.0, 500.0], help="rates of physics [Hz]")
    given = parser.parse_args()
    table = Table(title=f"{given.force:g} N, {given.laps:g} laps at 50 mm/s")
    for heading in ("tissue", "limb", "rate [Hz]", "pressing [N]", "circling [N]", "worst [N]", "first peak [N]",
                    "given out [% of stored]", "contact [ms]", "step [ms]", "real time"):  # fmt: skip
        table.add_column(heading)
    for tissue, mount in (("single", "fixed"), ("relaxed", "fixed"), ("relaxed", "springs")):
        layer = limb("left_forearm", tissue)
        site = Site.thickest(layer)
        course, ready = Course(site.circle(CIRCLE), (given.force,), laps=given.laps), None
        for rate in given.rates if mount == "fixed" else given.rates[:1]:
            run = Massage(build(layer, site, mount=mount, radius=RADIUS, timestep=1 / rate), course, skin=ready)
            ready = run.skin.simulator
            run.warm_up()
            log = run.run()
            kept = figures_of(log)
            press, circle = kept["phases"]
            busy = log.force > 0.1
            both = (f"{p['mean_N']:.2f} ± {p['deviation_N']:.2f}" for p in (press, circle))
            table.add_row(tissue, mount, f"{rate:g}", *both,
                          f"{circle['worst_N']:.2f}", f"{log.force[log.time < course.phases[2].start].max():.1f}",
                          f"{100 * kept['given_out_of_stored']:+.1f}", f"{1e3 * kept['touch_s']:.2f}",
                          f"{1e3 * float(np.median(log.cpu_s[busy])):.2f}",
                          f"{kept['real_time_factor_of_processor_time']:.2f}")  # fmt: skip
    Console(width=170).print(table)


if __name__ == "__main__":
    main()
