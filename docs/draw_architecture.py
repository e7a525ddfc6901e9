"""Draws docs/pictures/architecture.png: the rooms, what they may import, and three ways through them.

.venv/bin/python docs/draw_architecture.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

PICTURE = Path(__file__).parent / "pictures" / "architecture.png"
INK, GREY = "#2b2b2b", "#8a8a8a"
ROOMS = {  # room: left, bottom, width, colour, what it holds
    "stmpl_ros": (0.0, 10.6, 5.5, "#dbe8f4", "node, probe, recorder, view; the stmpl command"),
    "studies": (5.9, 10.6, 5.5, "#f3e6d8", "training, tables, chart, stability, peers"),
    "bags": (0.0, 8.8, 5.5, "#e2efdf", "wire: messages both ways; write, read, replay, compare"),
    "fem_tools": (5.9, 8.8, 5.5, "#efe2ec", "finite elements; scenes and data for training"),
    "stmpl_core": (0.0, 7.0, 11.4, "#fbf3cf", "limb, tools, touch, methods, simulator; no ROS, no finite elements"),
}  # fmt: skip
HEIGHT = 1.15
IMPORTS = [((2.75, 10.6), (2.75, 9.95)), ((4.8, 10.6), (6.6, 9.95)), ((8.65, 10.6), (8.65, 9.95)),
           ((6.6, 10.6), (4.8, 9.95)), ((2.75, 8.8), (2.75, 8.15)), ((8.65, 8.8), (8.65, 8.15))]  # fmt: skip
WAYS = {  # way: what there is and a note; how it becomes the next, and the room that does it
    "From message to displacement: the node, a robot simulator, a replay, a test": [
        ("messages", "mesh, pose, wrench", "wire", "bags"),
        ("Tools, Contacts", "shape, place, wrench", "Simulator.touch", "stmpl_core"),
        ("Touches", "force, depth, status: fast", "Simulator.answer", "stmpl_core"),
        ("Answer", "displacement, trust", "wire", "bags"),
        ("messages, bag", "the same fields", "", ""),
    ],
    "From recording to verdict: compare": [
        ("bag", "what was sent", "wire", "bags"),
        ("Contacts, Touches", "as they were answered", "RigidFem.press", "fem_tools"),
        ("Displacement", "by finite elements", "score", "stmpl_core"),
        ("Comparison", "verdict, report", "", ""),
    ],
    "From sample to weights: generate, train": [
        ("scenes", "limbs, tools, pressures", "PatchFem, IndenterFem", "fem_tools"),
        ("samples", "Zarr, split by contact", "train", "studies"),
        ("weights", "safetensors and JSON", "prepare", "stmpl_core"),
        ("MomentNet, UNet", "methods like any other", "", ""),
    ],
}
BOX, STEP = 1.65, 2.44


def box(axes: Axes, left: float, bottom: float, width: float, height: float, colour: str) -> None:
    """A rounded box."""
    style = "round,pad=0,rounding_size=0.12"
    axes.add_patch(FancyBboxPatch((left, bottom), width, height, boxstyle=style, fc=colour, ec=INK, lw=0.8))


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str = INK) -> None:
    """An arrow between two points."""
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, lw=1.1, color=colour,
                                   shrinkA=1, shrinkB=1))  # fmt: skip


def draw_rooms(axes: Axes) -> None:
    """The rooms, and an arrow to each that may be imported."""
    axes.text(0, 12.0, "Rooms: an arrow says who may import whom; all may import stmpl_core", size=9.5, weight="bold")
    for name, (left, bottom, width, colour, holds) in ROOMS.items():
        box(axes, left, bottom, width, HEIGHT, colour)
        axes.text(left + width / 2, bottom + 0.76, name, ha="center", va="center", weight="bold", size=12)
        axes.text(left + width / 2, bottom + 0.33, holds, ha="center", va="center", size=8.8)
    for start, end in IMPORTS:
        arrow(axes, start, end, GREY)


def draw_way(axes: Axes, title: str, bottom: float) -> None:
    """One way, as a row of boxes; over each arrow what makes the step, in the colour of its room."""
    axes.text(0, bottom + 1.3, title, size=9.5, weight="bold", va="bottom")
    for k, (what, note, does, room) in enumerate(WAYS[title]):
        left = k * STEP
        box(axes, left, bottom, BOX, 0.62, "white")
        axes.text(left + BOX / 2, bottom + 0.31, what, ha="center", va="center", size=9)
        axes.text(left + BOX / 2, bottom - 0.1, note, ha="center", va="top", size=7.8, color="#555555")
        if does:
            arrow(axes, (left + BOX, bottom + 0.31), (left + STEP, bottom + 0.31))
            axes.text(left + (BOX + STEP) / 2, bottom + 0.78, does, ha="center", va="bottom", size=8,
                      bbox={"fc": ROOMS[room][3], "ec": "none", "pad": 2})  # fmt: skip


def main() -> None:
    """Draws and writes the picture."""
    figure, axes = plt.subplots(figsize=(11, 11.6))
    draw_rooms(axes)
    for title, bottom in zip(WAYS, (4.6, 2.4, 0.2), strict=True):
        draw_way(axes, title, bottom)
    axes.set(xlim=(-0.15, 11.55), ylim=(-0.3, 12.4))
    axes.axis("off")
    figure.tight_layout(pad=0.2)
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main()
