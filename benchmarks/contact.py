"""Contact against rigid tools solved by finite elements: force, pressure, area and motion; and what a step costs.

    .venv/bin/python -m benchmarks.contact      # prints tables, writes docs/contact.json and docs/pictures/contact.png

The tools are pressed straight into the 3 mm arm. None was trained on: their sizes, places and this skin are new.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.tools import ball, block_letter, cup, fingertip, flat, peanut, roller, star
from fem_tools.indenter import Indentation, IndenterFem
from fem_tools.press import Press
from fem_tools.scenes import Site
from stmpl_core.body import Body
from stmpl_core.contact import Contact
from stmpl_core.layer import SoftLayer, Tissue
from stmpl_core.methods import MomentNet
from stmpl_core.nodes import Nodes
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.tool import Tool
from stmpl_core.touch import Touch
from stmpl_core.toucher import Toucher

DOCS = Path(__file__).parents[1] / "docs"
DEPTHS = (0.06, 0.15, 0.3, 0.45, 0.6)  # thicknesses
THICKNESS = 7e-3  # m
OFF = 1.5e-3  # m that the stated pose is off where the wrench is given
SLOWEST = 300  # steps that are timed


@dataclass(frozen=True)
class Scene:
    """Tools above a place on the arm.

    Args:
        name: name in the tables.
        meshes: shapes of the tools, in their own frames, z up.
        shifts: place of each tool across the limb [m].
        rounding: radius of the edges, in FEM [m].
        place: share of the way along the arm's vertices, sorted by their distance from the border.
    """

    name: str
    meshes: tuple[Tool, ...]
    shifts: tuple[float, ...] = (0.0,)
    rounding: float = 0.0
    place: float = 0.0

    def tools(self, layer: SoftLayer) -> list[Press]:
        """At first touch each."""
        site, tools = Site(layer), []
        order = np.argsort(-site.border_distance)
        vertex = int(order[int(self.place * len(order))])
        pose = site.standing(vertex, 10e-3, 0.4)
        for mesh, shift in zip(self.meshes, self.shifts, strict=True):
            at = pose.copy()
            at[:3, 3] += shift * pose[:3, 0] + 40e-3 * pose[:3, 2]
            tool = Press(SignedDistance.of(mesh, rounding=self.rounding), at, -pose[:3, 2]).touching(layer)
            assert tool is not None
            tools.append(tool)
        return tools


@dataclass(frozen=True)
class Row:
    """One press at one depth, ours against FEM; errors as shares.

    Args:
        name: name of the scene.
        depth: depth of the tools beyond first touch, over the thickness.
        mean_pressure: FEM's mean pressure over E.
        force: FEM's force [N].
        force_error: signed error of the force along the way, by pose.
        linear_error: signed error of the force of the linear layer, without the network.
        pressure_error: L2 error of the pressure, over the L2 norm of FEM's.
        area_error: signed error of the area of the vertices with over 2 % of the highest pressure.
        mee: mean Euclidean error over vertices that FEM moves by more than 1e-6 m, over the peak.
        moving: mean error over vertices that move more than 10 % of the peak.
        contact: mean error over vertices with pressure.
        peak: signed error of the largest displacement.
        entered: depth of the deepest vertex of the whole skin inside a tool, over the thickness.
        by_wrench: error of the depth found from the force, the pose being off, over the thickness; signed.
        within: truth of the claim that the force is within the error that the answer states.
    """

    name: str
    depth: float
    mean_pressure: float
    force: float
    force_error: float
    linear_error: float
    pressure_error: float
    area_error: float
    mee: float
    moving: float
    contact: float
    peak: float
    entered: float
    by_wrench: float
    within: bool


def scenes() -> list[Scene]:
    """The scenes of the table."""
    return [
        Scene("sphere, r 9 mm", (ball(9),)),
        Scene("sphere, r 17 mm", (ball(17),), place=0.03),
        Scene("cylinder lying, r 11 mm", (fingertip(11, 26),), place=0.06),
        Scene("flat punch, r 9 mm", (flat(9, 1.5),), place=0.02),
        Scene("fingertip, r 7 mm", (fingertip(7, 10),), place=0.05),
        Scene("letter H, 26 mm", (block_letter("H", 26),), rounding=1.5e-3, place=0.01),
        Scene("two fingertips", (fingertip(6.5, 8), fingertip(6.5, 8)), shifts=(-11e-3, 11e-3), place=0.04),
        Scene("saddle roller", (roller(8, 12, 30),), place=0.07),
        Scene("peanut", (peanut(7, 18),), place=0.025),
        Scene("star", (star(5, 14, 7),), rounding=1.5e-3, place=0.015),
        Scene("cup's rim", (cup(11, 4),), place=0.035),
    ]


def arm(edge: float = 3e-3) -> SoftLayer:
    """The arm that is pressed: no body of the training data."""
    body = Body.anny(weight=0.4)
    return body.patch("left_arm", edge).layer(body, thickness=THICKNESS, tissue=Tissue(poisson_ratio=0.4))


def contacts(scene: Scene, tools: Sequence[Press], forces: Sequence[float] | None = None) -> list[Contact]:
    """The same tools as Contacts, by pose or with these forces along their ways [N]."""
    out = []
    for k, (mesh, tool) in enumerate(zip(scene.meshes, tools, strict=True)):
        wrench = None if forces is None else np.concatenate([forces[k] * tool.direction, np.zeros(3)])
        out.append(Contact(mesh.named(f"tool {k}"), tool.pose_body_from_tool, wrench))
    return out


def _touched(toucher: Toucher, found: Sequence[Contact], presses: Sequence[Press]) -> list[Touch]:
    """Touches of contacts, by the very fields that FEM presses with."""
    for contact, press in zip(found, presses, strict=True):
        toucher.tools.add(contact.tool, press.field)
    return toucher.touch_all(found)


def row(scene: Scene, simulator: Simulator, toucher: Toucher, truth: Indentation) -> Row:
    """Ours against one answer of FEM."""
    layer, thick = simulator.layer, float(simulator.layer.thickness.mean())
    touches = _touched(toucher, contacts(scene, truth.tools), truth.tools)
    ours = np.sum([touch.pressure for touch in touches if touch.pressure is not None], axis=0)
    area, way = layer.vertex_areas, truth.tools[0].direction
    force = float(sum(touch.wrench[:3] @ tool.direction for touch, tool in zip(touches, truth.tools, strict=True)))
    nodes = Nodes.joined([touch.pressed.squeeze.nodes for touch in touches if touch.pressed])
    v, linear = nodes.at_vertices(toucher.net.look(nodes).pressure, area)
    linear_force = -float(linear @ layer.vertex_area_vectors[v] @ way)
    answer = simulator.step(contacts(scene, truth.tools))
    error = np.linalg.norm(answer.displacement - truth.displacement, axis=1)
    length, skin = np.linalg.norm(truth.displacement, axis=1), layer.vertices + answer.displacement
    peak = float(length.max())
    stated = sum(touch.force_bound for touch in touches)
    forces = [float(w[:3] @ tool.direction) for w, tool in zip(truth.wrenches, truth.tools, strict=True)]
    back = [tool.shifted(-OFF * tool.direction) for tool in truth.tools]
    found = [_touched(toucher, [contact], [tool])[0].moved - OFF
             for contact, tool in zip(contacts(scene, back, forces), truth.tools, strict=True)]  # fmt: skip
    return Row(
        name=scene.name,
        depth=truth.depth / thick,
        mean_pressure=truth.trust.figures["mean_pressure_over_modulus"],
        force=truth.force,
        force_error=force / truth.force - 1,
        linear_error=linear_force * layer.tissue.youngs_modulus / truth.force - 1,
        pressure_error=float(np.sqrt(area @ (ours - truth.pressure) ** 2 / (area @ truth.pressure**2))),
        area_error=_area(ours, area) / _area(truth.pressure, area) - 1,
        mee=float(error[length > 1e-6].mean()) / peak,
        moving=float(error[length > 0.1 * peak].mean()) / peak,
        contact=float(error[truth.pressure > 0.02 * truth.pressure.max()].mean()) / peak,
        peak=float(answer.magnitude.max()) / peak - 1,
        entered=max(0.0, *(-float(t.distance(skin).min()) for t in truth.tools)) / thick,
        by_wrench=float(np.abs(found).max()) / thick,
        within=abs(force - truth.force) <= stated,
    )


def _area(pressure: np.ndarray, area: np.ndarray) -> float:
    return float(area[pressure > 0.02 * pressure.max()].sum())


def timings(simulator: Simulator, toucher: Toucher, scene: Scene, depth: float) -> dict[str, list[float]]:
    """Seconds of a contact step by pose and by wrench, and of a whole step, while the tool slides."""
    tools = [tool.at(depth) for tool in scene.tools(simulator.layer)]
    across = tools[0].sideways(1.0)[1]
    out: dict[str, list[float]] = {"pose": [], "wrench": [], "whole": []}
    force = [float(t.wrench[:3] @ tools[0].direction) for t in _touched(toucher, contacts(scene, tools), tools)]

    def timed(name: str, call: Callable[[], object]) -> None:
        start = time.perf_counter()
        call()
        out[name].append(time.perf_counter() - start)

    for k in range(SLOWEST):
        moved = [tool.shifted(2e-3 * np.sin(0.07 * k) * across) for tool in tools]
        by_pose, by_wrench = contacts(scene, moved), contacts(scene, moved, force)
        for contact, tool in zip([*by_pose, *by_wrench], [*tools, *tools], strict=True):
            toucher.tools.add(contact.tool, tool.field)
            simulator.tools.add(contact.tool, tool.field)
        timed("pose", lambda: toucher.touch_all(by_pose))  # noqa: B023
        timed("wrench", lambda: toucher.touch_all(by_wrench))  # noqa: B023
        if k % 5 == 0:
            timed("whole", lambda: simulator.step(by_pose))  # noqa: B023
    return out


def main() -> None:
    console, layer = Console(width=150), arm()
    simulator, toucher = Simulator(layer, MomentNet()), Toucher(layer)
    fem = IndenterFem().prepare(layer)
    rows: list[Row] = []
    every = scenes()
    for scene in track(every, "pressing by finite elements", console=console):
        tools = scene.tools(layer)
        for truth in fem.path(tools, np.array(DEPTHS) * THICKNESS):
            rows.append(row(scene, simulator, toucher, truth))
    times = {scene.name: timings(simulator, toucher, scene, 0.4 * THICKNESS) for scene in every}
    console.print(_table(rows))
    console.print(_time_table(times))
    kept = {"rows": [asdict(r) for r in rows],
            "ms": {n: {k: _percentiles(v) for k, v in t.items()} for n, t in times.items()}}  # fmt: skip
    (DOCS / "contact.json").write_text(json.dumps(kept, indent=1) + "\n")
    draw(rows, DOCS / "pictures" / "contact.png")


def _percentiles(seconds: Sequence[float]) -> list[float]:
    return [round(1e3 * float(np.percentile(seconds, q)), 3) for q in (50, 99)]


def _table(rows: Sequence[Row]) -> Table:
    table = Table(title="Ours against FEM; errors in %", caption="by pose, but for the last column: by wrench, "
                  f"the pose being {OFF * 1e3:g} mm off")  # fmt: skip
    for name in ("tool", "depth/t", "mean p/E", "force N", "force", "linear", "pressure L2", "area", "MEE", "moving",
                 "contact", "peak", "inside/t", "depth by wrench"):  # fmt: skip
        table.add_column(name, justify="left" if name == "tool" else "right")
    last = ""
    for r in rows:
        table.add_row(r.name if r.name != last else "", f"{r.depth:.2f}", f"{r.mean_pressure:.2f}", f"{r.force:.3f}",
                      f"{100 * r.force_error:+.1f}{'' if r.within else ' !'}", f"{100 * r.linear_error:+.0f}",
                      f"{100 * r.pressure_error:.1f}", f"{100 * r.area_error:+.1f}", f"{100 * r.mee:.2f}",
                      f"{100 * r.moving:.1f}", f"{100 * r.contact:.1f}", f"{100 * r.peak:+.1f}",
                      f"{100 * r.entered:.2f}", f"{100 * r.by_wrench:.1f}")  # fmt: skip
        last = r.name
    mean = [np.mean([abs(getattr(r, k)) for r in rows]) for k in ("force_error", "linear_error", "pressure_error",
            "area_error", "mee", "moving", "contact", "peak", "entered", "by_wrench")]  # fmt: skip
    table.add_section()
    table.add_row("mean of sizes", "", "", "", *(f"{100 * m:.2f}" for m in mean))
    return table


def _time_table(times: dict[str, dict[str, list[float]]]) -> Table:
    table = Table(title="One step in ms, median / 99 %, one thread")
    for name in ("tool", "contact by pose", "contact by wrench", "whole step by pose"):
        table.add_column(name, justify="left" if name == "tool" else "right")
    for name, t in times.items():
        cells = ["{:.2f} / {:.2f}".format(*_percentiles(t[k])) for k in t]
        table.add_row(name, *cells)
    return table


def draw(rows: Sequence[Row], path: Path) -> None:
    """Force error and pressure error over the mean pressure, a line a tool."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.6), constrained_layout=True)
    names = list(dict.fromkeys(r.name for r in rows))
    for name, colour in zip(names, plt.get_cmap("tab20").colors, strict=False):  # type: ignore[attr-defined]
        mine = [r for r in rows if r.name == name]
        x = [r.mean_pressure for r in mine]
        axes[0].plot(x, [100 * r.force_error for r in mine], "o-", color=colour, label=name)
        axes[1].plot(x, [100 * r.pressure_error for r in mine], "o-", color=colour)
        axes[2].plot(x, [100 * r.contact for r in mine], "o-", color=colour)
    axes[0].plot([], [], "x:", color="grey", label="linear")
    for name in names:
        mine = [r for r in rows if r.name == name]
        x = [r.mean_pressure for r in mine]
        axes[0].plot(x, [100 * r.linear_error for r in mine], "x:", color="grey", lw=0.8)
    titles = ("force, signed error [%]", "pressure, L2 error [%]", "motion under the contact [% of the peak]")
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xscale="log", xlabel="mean pressure / E", title=title)
        axis.grid(alpha=0.3)
    axes[0].axhspan(-5, 5, color="tab:green", alpha=0.15)
    axes[1].axhline(10, color="tab:green", alpha=0.5)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
