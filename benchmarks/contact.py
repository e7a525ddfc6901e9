"""Contact against rigid tools solved by finite elements: force, pressure, area and motion; and what a step costs.

    .venv/bin/python -m benchmarks.contact      # prints tables, draws docs/pictures/contact.png
    .venv/bin/python -m benchmarks.contact --tools egg hook --finer    # these alone, elements half as long

The tools are pressed straight into the 3 mm arm. None was trained on: their sizes, places and this skin are new, and
twenty are of kinds that no training contact had. What finite elements answered comes with this file (tools_v1.npz; of
FINE tools with elements half as long, which their tips and arms want); `--again` asks them again, keeps it in
data/contact_truth, and writes tools_v1.npz anew.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.strange_tools import strange_tools
from benchmarks.tools import ball, block_letter, fingertip, flat
from fem_tools.indenter import IndenterFem
from fem_tools.patch import PatchFem
from fem_tools.press import Press
from fem_tools.released import write_arrays
from fem_tools.scenes import Site
from stmpl_core.body import Body
from stmpl_core.contact import Contact
from stmpl_core.layer import SoftLayer
from stmpl_core.methods import MomentNet
from stmpl_core.nodes import Nodes
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.tissue import Tissue
from stmpl_core.tool import Tool
from stmpl_core.touch import Touch
from stmpl_core.toucher import Toucher

DOCS = Path(__file__).parents[1] / "docs"
KEPT = Path(__file__).parents[1] / "data" / "contact_truth"
RELEASED = Path(__file__).with_name("tools_v1.npz")
STEPS = 1000  # numbers from 0 to the peak with which a motion is released
DEPTHS = (0.03, 0.1, 0.25, 0.45, 0.7)  # thicknesses
THICKNESS = 7e-3  # m
OFF = 1.5e-3  # m that the stated pose is off where the wrench is given
FINE = ("cone", "star", "brush")
SHARP = {"star": 1.5e-3}  # m, radius to which edges are rounded
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
        strange: truth of the claim that no network was trained on tools of this kind.
    """

    name: str
    meshes: tuple[Tool, ...]
    shifts: tuple[float, ...] = (0.0,)
    rounding: float = 0.0
    place: float = 0.0
    strange: bool = False

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
class Truth:
    """One answer of FEM: tools, depth [m], forces on the skin (T, 3) [N], pressure (V,) [Pa], motion (V, 3) [m]."""

    tools: list[Press]
    depth: float
    forces: np.ndarray
    pressure: np.ndarray
    displacement: np.ndarray

    @property
    def force(self) -> float:
        """Force along the tools' ways [N]."""
        return float(sum(f @ tool.direction for f, tool in zip(self.forces, self.tools, strict=True)))


@dataclass(frozen=True)
class Row:
    """One press at one depth, ours against FEM; errors as shares.

    Args:
        name: name of the scene.
        strange: truth of the claim that no network was trained on tools of this kind.
        depth: depth of the tools beyond first touch, over the thickness.
        mean_pressure: FEM's mean pressure over E, weighted by itself.
        force: FEM's force [N].
        force_error: signed error of the force along the way, by pose.
        linear_error: signed error of the force of the linear layer, without the network.
        pressure_error: L2 error of the pressure, over the L2 norm of FEM's.
        mee: mean Euclidean error over vertices that FEM moves by more than 1e-6 m, over the peak.
        moving: mean error over vertices that move more than 10 % of the peak.
        told: moving, where a wrench tells FEM's force and way.
        worst: largest error at a vertex, over the peak.
        peak: signed error of the largest displacement.
        entered: depth of the deepest vertex of the whole skin inside a tool, over the thickness.
        by_wrench: error of the depth found from the force, the pose being off, over the thickness; signed.
        in_range: truth of the claim that the answer is not flagged.
        force_bound, motion_bound: bounds that the answer states, over FEM's force and peak; not a number: none.
    """

    name: str
    strange: bool
    depth: float
    mean_pressure: float
    force: float
    force_error: float
    linear_error: float
    pressure_error: float
    mee: float
    moving: float
    told: float
    worst: float
    peak: float
    entered: float
    by_wrench: float
    in_range: bool
    force_bound: float
    motion_bound: float


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
        *(Scene(name, (tool,), rounding=SHARP.get(name, 0.0), place=0.004 * k, strange=True)
          for k, (name, tool) in enumerate(strange_tools().items())),
    ]  # fmt: skip


def truths(scene: Scene, layer: SoftLayer, fem: IndenterFem | None = None, folder: Path | None = None) -> list[Truth]:
    """What FEM answers to a scene, as far as it may be believed: as released, or as a folder keeps it from before."""
    name, tools = scene.name.replace(" ", "_"), scene.tools(layer)
    if folder is None:
        with np.load(RELEASED) as file:
            depths, forces, pressures, units, moved = (
                file[f"{name}/{column}"] for column in ("depth", "forces", "pressure", "unit", "moved"))  # fmt: skip
        return [Truth([tool.at(depth) for tool in tools], depth, force, pressure.astype(float), unit * motion)
                for depth, force, pressure, unit, motion in zip(depths, forces, pressures, units, moved, strict=True)]
    path = folder / f"{name}.npz"
    assert fem is not None
    if not path.is_file():
        answers = [one for one in fem.path(tools, np.array(DEPTHS) * THICKNESS) if one.trust.ok]
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, **{name: np.array([getattr(one, name) for one in answers])
                                     for name in ("depth", "pressure", "displacement")},
                            forces=np.array([[w[:3] for w in one.wrenches] for one in answers]))  # fmt: skip
    with np.load(path) as kept:
        columns = [kept[name] for name in ("depth", "forces", "pressure", "displacement")]
    return [Truth([tool.at(depth) for tool in tools], depth, *rest) for depth, *rest in zip(*columns, strict=True)]


def release(every: Sequence[tuple[Scene, list[Truth]]]) -> None:
    """Writes what FEM answered, rounded to a thousandth of each peak, for `truths`."""
    arrays: dict[str, np.ndarray] = {}
    for scene, some in every:
        units = np.array([float(np.abs(one.displacement).max()) / STEPS for one in some])
        moved = [np.round(one.displacement / unit) for one, unit in zip(some, units, strict=True)]
        columns = {
            "depth": np.array([one.depth for one in some]),
            "forces": np.array([one.forces for one in some]),
            "pressure": np.array([one.pressure for one in some], np.float16),
            "unit": units,
            "moved": np.array(moved, np.int16),
        }
        arrays |= {f"{scene.name.replace(' ', '_')}/{column}": values for column, values in columns.items()}
    write_arrays(RELEASED, arrays)


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


def row(scene: Scene, simulator: Simulator, truth: Truth) -> Row:
    """Ours against one answer of FEM."""
    layer, toucher, thick = simulator.layer, simulator.toucher, float(simulator.layer.thickness.mean())
    by_pose = contacts(scene, truth.tools)
    _touched(toucher, by_pose, truth.tools)
    answer = simulator.step(by_pose)
    touches, ours = list(answer.touches.values()), answer.pressure
    assert ours is not None
    area, way = layer.vertex_areas, truth.tools[0].direction
    force = float(sum(touch.wrench[:3] @ tool.direction for touch, tool in zip(touches, truth.tools, strict=True)))
    nodes = Nodes.joined([touch.pressed.squeeze.nodes for touch in touches if touch.pressed])
    v, linear = nodes.at_vertices(toucher.net.look(nodes).pressure, area)
    linear_force = -float(linear @ layer.vertex_area_vectors[v] @ way)
    error = np.linalg.norm(answer.displacement - truth.displacement, axis=1)
    length, skin = np.linalg.norm(truth.displacement, axis=1), layer.vertices + answer.displacement
    peak, bound = float(length.max()), answer.trust.error_bound
    forces = [float(f @ tool.direction) for f, tool in zip(truth.forces, truth.tools, strict=True)]
    by_force = contacts(scene, truth.tools, forces)
    _touched(toucher, by_force, truth.tools)
    told = np.linalg.norm(simulator.step(by_force).displacement - truth.displacement, axis=1)
    back = [tool.shifted(-OFF * tool.direction) for tool in truth.tools]
    found = [_touched(toucher, [contact], [tool])[0].moved - OFF
             for contact, tool in zip(contacts(scene, back, forces), truth.tools, strict=True)]  # fmt: skip
    modulus = layer.tissue.youngs_modulus
    return Row(
        name=scene.name,
        strange=scene.strange,
        depth=truth.depth / thick,
        mean_pressure=float(area @ truth.pressure**2 / (area @ truth.pressure)) / modulus,
        force=truth.force,
        force_error=force / truth.force - 1,
        linear_error=linear_force * modulus / truth.force - 1,
        pressure_error=float(np.sqrt(area @ (ours - truth.pressure) ** 2 / (area @ truth.pressure**2))),
        mee=float(error[length > 1e-6].mean()) / peak,
        moving=float(error[length > 0.1 * peak].mean()) / peak,
        told=float(told[length > 0.1 * peak].mean()) / peak,
        worst=float(error.max()) / peak,
        peak=float(answer.magnitude.max()) / peak - 1,
        entered=max(0.0, *(-float(t.distance(skin).min()) for t in truth.tools)) / thick,
        by_wrench=float(np.abs(found).max()) / thick,
        in_range=answer.trust.in_range,
        force_bound=sum(touch.force_bound for touch in touches) / truth.force,
        motion_bound=float("nan") if bound is None else bound / peak,
    )


def timings(simulator: Simulator, scene: Scene, depth: float) -> dict[str, list[float]]:
    """Seconds of a contact step by pose and by wrench, and of a whole step, while the tool slides."""
    tools, toucher = [tool.at(depth) for tool in scene.tools(simulator.layer)], simulator.toucher
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
            simulator.tools.add(contact.tool, tool.field)
        timed("pose", lambda: toucher.touch_all(by_pose))  # noqa: B023
        timed("wrench", lambda: toucher.touch_all(by_wrench))  # noqa: B023
        if k % 5 == 0:
            timed("whole", lambda: simulator.step(by_pose))  # noqa: B023
    return out


def main() -> None:
    """All tools with tables and picture, or some with the table of these."""
    every = scenes()
    given = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    given.add_argument("--tools", nargs="+", choices=[one.name for one in every], help="tools that are pressed; all")
    given.add_argument("--finer", action="store_true", help="finite elements half as long")
    given.add_argument("--again", action="store_true", help="ask finite elements again")
    given.add_argument("--by-vertices", action="store_true", help="ours without nodes that stick")
    options = given.parse_args()
    console, layer = Console(width=165), arm()
    simulator = Simulator(layer, MomentNet(sticks=not options.by_vertices))
    some = [one for one in every if not options.tools or one.name in options.tools]

    @cache
    def solver(fine: bool) -> IndenterFem:
        return IndenterFem(PatchFem(refine=4, layers=2) if fine else None).prepare(layer)

    asked = []
    for scene in track(some, "finite elements", console=console):
        if options.finer or options.again:
            fine = options.finer or scene.name in FINE
            asked.append((scene, truths(scene, layer, solver(fine), KEPT / "finer" if fine else KEPT)))
        else:
            asked.append((scene, truths(scene, layer)))
    rows = [row(scene, simulator, truth) for scene, answers in asked for truth in answers]
    if options.tools or options.finer or options.by_vertices:
        console.print(_table(rows))
        console.print(_summary(rows))
        return
    if options.again:
        release(asked)
    times = {scene.name: timings(simulator, scene, 0.4 * THICKNESS) for scene in every if not scene.strange}
    console.print(_table(rows))
    console.print(_summary(rows))
    console.print(_time_table(times))
    draw(rows, DOCS / "pictures" / "contact.png")


def _percentiles(seconds: Sequence[float]) -> list[float]:
    return [round(1e3 * float(np.percentile(seconds, q)), 3) for q in (50, 99)]


def _table(rows: Sequence[Row]) -> Table:
    """A line a tool, its depths side by side."""
    table = Table(title=f"Ours against FEM at {', '.join(f'{d:g}' for d in DEPTHS)} t; errors in %",
                  caption=f"* flagged; the last column: by wrench, the pose being {OFF * 1e3:g} mm off")  # fmt: skip
    for name in ("tool", "force", "linear", "pressure L2", "moving", "way told", "worst",
                 "depth by wrench/t"):  # fmt: skip
        table.add_column(name, justify="left" if name == "tool" else "right")
    for name in dict.fromkeys(r.name for r in rows):
        mine = [r for r in rows if r.name == name]
        table.add_row(name, " ".join(f"{100 * r.force_error:+.1f}{'' if r.in_range else '*'}" for r in mine),
                      *(" ".join(f"{100 * getattr(r, k):{form}}" for r in mine)
                        for k, form in (("linear_error", "+.0f"), ("pressure_error", ".0f"), ("moving", ".1f"),
                                        ("told", ".1f"), ("worst", ".0f"), ("by_wrench", ".1f"))))  # fmt: skip
    return table


def _summary(rows: Sequence[Row]) -> Table:
    """Means and worst of known kinds and of strange ones, of all answers and of those that are not flagged."""
    table = Table(title="Means / worst, in %; what bounds cover, and their median over the error")
    for name in ("tools", "answers", "flagged", "force", "pressure L2", "moving", "way told", "worst vertex",
                 "force bound", "motion bound"):  # fmt: skip
        table.add_column(name, justify="left" if name == "tools" else "right")
    for strange in (False, True):
        for in_range in (False, True):
            some = [r for r in rows if r.strange == strange and (r.in_range or not in_range)]
            if not some:
                continue
            flagged = np.mean([not r.in_range for r in some])
            cells = [np.abs([getattr(r, k) for r in some])
                     for k in ("force_error", "pressure_error", "moving", "told", "worst")]  # fmt: skip
            bounds = [np.array([getattr(r, k) for r in some if np.isfinite(getattr(r, k))])
                      for k in ("force_bound", "motion_bound")]  # fmt: skip
            errors = [np.array([abs(getattr(r, of)) for r in some if np.isfinite(getattr(r, k))])
                      for k, of in (("force_bound", "force_error"), ("motion_bound", "worst"))]  # fmt: skip
            table.add_row(("strange" if strange else "known") + (", not flagged" if in_range else ""), str(len(some)),
                          f"{flagged:.0%}", *(f"{100 * c.mean():.1f} / {100 * c.max():.1f}" for c in cells),
                          *(f"{np.mean(e <= b):.0%}, {np.median(b / e):.1f}x" if len(b) else "none"
                            for b, e in zip(bounds, errors, strict=True)))  # fmt: skip
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
    """Errors over the depth, a line a tool: known kinds in blue, strange ones in orange; flagged answers hollow."""
    figure, axes = plt.subplots(1, 4, figsize=(15, 4.4), constrained_layout=True)
    columns = {"force_error": "force, signed error [%]", "pressure_error": "pressure, L2 error [%]",
               "moving": "mean error where it moves [% of the peak]",
               "worst": "error of the worst vertex [% of the peak]"}  # fmt: skip
    for axis, (column, title) in zip(axes, columns.items(), strict=True):
        for name in dict.fromkeys(r.name for r in rows):
            mine = [r for r in rows if r.name == name]
            colour = "tab:orange" if mine[0].strange else "tab:blue"
            depth, value = np.array([(r.depth, 100 * getattr(r, column)) for r in mine]).T
            trusted = np.array([r.in_range for r in mine])
            axis.plot(depth, value, "-", color=colour, lw=0.8, alpha=0.6)
            axis.plot(depth[trusted], value[trusted], "o", color=colour, ms=4)
            axis.plot(depth[~trusted], value[~trusted], "o", color=colour, ms=4, mfc="white")
        axis.set(xlabel="depth / thickness", title=title)
        axis.grid(alpha=0.3)
    axes[0].set_ylim(-16, 16)
    axes[0].axhspan(-3, 3, color="tab:green", alpha=0.15)
    for colour, label in (("tab:blue", "kinds that were trained on"), ("tab:orange", "kinds that were not")):
        axes[1].plot([], [], "o-", color=colour, label=label)
    axes[1].plot([], [], "o", color="grey", mfc="white", label="flagged")
    axes[1].legend(fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
