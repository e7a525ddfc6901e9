"""Draws pictures/time_and_slip.png: forces of strokes and presses, ours beside finite elements.

.venv/bin/python docs/draw_time_and_slip.py
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from tests.test_state_against_fem import FILE, Stroke  # noqa: E402

COLOURS = {"slab-ball8-mu0.3": "tab:blue", "slab-ball8-mu0.6": "tab:orange", "slab-ball8-mu1.0": "tab:green"}
TIMED = {
    "slab-ramp-hold": "ramp and hold",
    "slab-massage": "1 Hz massage",
    "slab-press-lift-press": "press, lift, press",
}


def main() -> None:
    """Draws what the file of tests holds."""
    with np.load(FILE) as file:
        names = [name.removesuffix(".pose") for name in file.files if name.endswith(".pose")]
    timed = [name for name in TIMED if name in names]
    _, axes = plt.subplots(1, 1 + len(timed), figsize=(4.6 * (1 + len(timed)), 3.6), constrained_layout=True)
    one = axes[0]
    for name in (name for name in COLOURS if name in names):
        stroke, colour = Stroke(name), COLOURS[name]
        way, touches = 1e3 * (stroke.pose[:, 0, 3] - stroke.pose[0, 0, 3]), stroke.played(8)
        for k, style in ((0, "-"), (2, "--")):
            one.plot(way, np.abs([touch.wrench[k] for touch in touches]), style, color=colour,
                     label=f"friction {stroke.friction:g}, {'along' if k == 0 else 'normal'}")  # fmt: skip
            one.plot(way, np.abs(stroke.wrench[:, k]), ".", color=colour, ms=4)
    one.set(xlabel="way of the tool / mm", ylabel="force / N", ylim=(0, None),
            title="8 mm ball, 4 mm deep, slid")  # fmt: skip
    one.legend(fontsize=6, ncol=3, loc="lower right", title="lines: ours; dots: finite elements", title_fontsize=6)
    for axis, name in zip(axes[1:], timed, strict=True):
        stroke = Stroke(name)
        axis.plot(stroke.time, [-touch.wrench[2] for touch in stroke.played(8)], "-", color="tab:blue", label="ours")
        elastic = [-stroke.simulator.touch([c])[0].wrench[2] for c in stroke.contacts()]
        axis.plot(stroke.time, elastic, ":", color="tab:grey", label="elastic")
        axis.plot(stroke.time, -stroke.wrench[:, 2], ".", color="k", ms=4, label="finite elements")
        axis.set(xlabel="time / s", title=f"20 mm ball, {TIMED[name]}", ylim=(0, None))
        axis.legend(fontsize=7)
    plt.savefig(HERE / "pictures" / "time_and_slip.png", dpi=110)


if __name__ == "__main__":
    main()
