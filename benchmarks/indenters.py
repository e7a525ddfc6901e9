"""How deep rigid tools go: force and mean pressure against depth, where each stops, and what bounds them.

    .venv/bin/python -m benchmarks.indenters        # prints tables, writes docs/pictures/indenters.png

Only the ratios of lengths and of p to E matter, so a thin layer stands for a large tool.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks.tools import ball, block_letter, fingertip, flat
from fem_tools.indenter import Indentation, IndenterFem
from fem_tools.patch import QUADRATIC_ABOVE, EdgeLength, Patch, PatchFem
from fem_tools.press import Press
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.base import prepared
from stmpl_core.methods.winkler import column_pressure
from stmpl_core.sdf import SignedDistance
from stmpl_core.tissue import Tissue
from stmpl_core.tool import Tool
from tests.scenes import limb, plate

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "indenters.png"
REQUIRED = 5.0  # mean pressure over E
COLOURS = {"ball": "tab:blue", "flat": "tab:orange", "fingertip": "tab:green", "letter": "tab:red"}
STYLES = ("-", "--", ":")  # as it is, nu 0.45, thin


@dataclass(frozen=True)
class Scene:
    """A tool above a flat layer, or above a limb.

    Args:
        name: name in the tables.
        mesh: function that makes the tool.
        thickness: thickness of the layer [m].
        nu: Poisson's ratio [-].
        rounding: radius of the tool's edges [m].
        edge: edge length of the layer's triangles before refinement [m].
        rim: width of the plate beyond the tool [thicknesses].
        limb: cylinder of 40 mm radius in place of the plate.
    """

    name: str
    mesh: Callable[[], Tool]
    thickness: float = 7.5e-3
    nu: float = 0.4
    rounding: float = 0.0
    edge: float = 4e-3
    rim: float = 3.5
    limb: bool = False

    def built(self, aside: float = 0.0) -> tuple[SoftLayer, Press]:
        """The layer, and the tool above it, `aside` [m] of its middle."""
        mesh, pose = self.mesh(), np.eye(4)
        field = SignedDistance.of(mesh, rounding=self.rounding)
        if self.limb:
            pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
            pose[:3, 3] = 0.045, aside, 0.08
            layer = limb(self.edge, self.thickness, poisson_ratio=self.nu)
            return layer, Press(field, pose, np.array([-1.0, 0, 0]))
        half = float(np.abs(mesh.vertices[:, :2]).max()) + self.rim * self.thickness
        pose[:3, 3] = aside, 0.0, 5e-3
        size = 2 * round(half / self.edge) * self.edge
        layer = plate(size, self.edge, self.thickness, crossed=True, poisson_ratio=self.nu)
        return layer, Press(field, pose, np.array([0, 0, -1.0]))

    def solver(self, *, step: float = 0.04) -> IndenterFem:
        """Linear wedges, two deep, edges down to an eighth of the layer's where the tool is curved."""
        return IndenterFem(PatchFem(element="P1xP2", layers=2, refine=3, reach=3), step=step)


SCENES = (
    Scene("ball 12", lambda: ball(12)),
    Scene("ball 12, thin", lambda: ball(12), thickness=2.5e-3, edge=2e-3),
    Scene("ball 12, nu 0.45", lambda: ball(12), nu=0.45),
    Scene("flat 12", lambda: flat(12, 3), edge=3e-3),
    Scene("flat 12, thin", lambda: flat(12, 3), thickness=2.5e-3, edge=2e-3),
    Scene("flat 12, nu 0.45", lambda: flat(12, 3), nu=0.45, edge=3e-3),
    Scene("flat 12 on a limb", lambda: flat(12, 3), limb=True),
    Scene("fingertip 8", lambda: fingertip(8, 14)),
    Scene("fingertip 8, thin", lambda: fingertip(8, 14), thickness=2.5e-3, edge=2e-3),
    Scene("letter T 35, thin", lambda: block_letter("T", 35), rounding=2e-3, thickness=2.5e-3, edge=2e-3),
)


def columns_carry(scene: Scene, depth: float, points: int = 200) -> float:
    """Mean pressure over E of the columns below the tool at a depth [thicknesses], each confined by itself [-].

    For a ball it is the stored energy of a column over its compression, whatever its radius: its columns are pressed
    to all depths alike.
    """
    _, tool = scene.built()
    low, high = tool.field.tool_bounds
    x, y = (np.linspace(low[k], high[k], points) for k in (0, 1))
    at = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((points, points), low[2])], axis=-1).reshape(-1, 3)
    for _ in range(200):  # up to the tool, by as much as is free
        at[:, 2] += np.maximum(tool.field.distance(at), 0.0)
    deep = depth * scene.thickness - (at[:, 2] - low[2])
    stretch = 1 - deep[deep > 0] / scene.thickness
    tissue = Tissue(poisson_ratio=scene.nu)
    return float(column_pressure(stretch, tissue).mean() / tissue.youngs_modulus)


def press(scene: Scene, depths: np.ndarray, *, step: float = 0.04, aside: float = 0.0) -> list[Indentation]:
    """Answers at depths [thicknesses], down to the first that is not believed, which is the last."""
    layer, tool = scene.built(aside)
    answers = []
    for answer in scene.solver(step=step).prepare(layer).path([tool], depths * scene.thickness):
        answers.append(answer)
        if not answer.trust.ok:
            break
    return answers


class FinerFem(PatchFem):
    """Half the edges that are asked for, and at most a quarter of a thickness below the tool."""

    def patch_around(self, vertices: np.ndarray, edge_length: EdgeLength | None = None) -> Patch:
        """See PatchFem."""
        layer = prepared(self._layer, self)
        thickness = float(layer.thickness[vertices].min())
        middle, size = layer.vertices[vertices].mean(axis=0), np.ptp(layer.vertices[vertices], axis=0).max()

        def finer(points: np.ndarray) -> np.ndarray:
            near = np.linalg.norm(points - middle, axis=2).min(axis=1) < 0.5 * size + thickness
            wanted = np.inf if edge_length is None else 0.5 * edge_length(points)
            return np.minimum(wanted, np.where(near, 0.25, 0.8) * thickness)

        return super().patch_around(vertices, finer)


BALL_8 = Scene("ball 8, 5 mm", lambda: ball(8), thickness=5e-3, rim=7.5)
BALL_12 = Scene("ball 12, 7.5 mm", lambda: ball(12), rim=7.5)
FINGERTIP = Scene("fingertip 8, 7.5 mm", lambda: fingertip(8, 14), rim=7.5)
FLAT_8 = Scene("flat 8, 5 mm", lambda: flat(8, 2.5), thickness=5e-3, rim=7.5)
FITTED = (
    (BALL_8, 3),
    (BALL_8, 6),
    (BALL_12, 3),
    (BALL_12, 5),
    (Scene("ball 12, 10 mm", lambda: ball(12), thickness=10e-3, rim=7.5), 3),
    (FINGERTIP, 3),
    (FINGERTIP, 5),
    (FLAT_8, 3),
    (FLAT_8, 6),
    (Scene("flat 12, 7.5 mm", lambda: flat(12, 3), rim=7.5), 3),
)  # with the reach of the patch
HELD_OUT = (
    (Scene("ball 10, 6 mm", lambda: ball(10), thickness=6e-3, rim=7.5), 4),
    (Scene("fingertip 6, 9 mm", lambda: fingertip(6, 10), thickness=9e-3, rim=7.5), 6),
    (Scene("flat 10, 8 mm, limb", lambda: flat(10, 3), thickness=8e-3, limb=True), 4),
    (Scene("ball 15, 5 mm, limb", lambda: ball(15), thickness=5e-3, limb=True), 6),
)
CASE_DEPTHS = np.array([0.25, 0.45, 0.65])


def errors(
    scene: Scene, solver: IndenterFem, reference: IndenterFem, depths: np.ndarray = CASE_DEPTHS
) -> list[tuple[float, float, float, float]]:
    """At depths [thicknesses]: largest error, the bound stated for it, the peak [m], and the force's error [-]."""
    layer, tool = scene.built()
    ours, truths = (list(x.prepare(layer).path([tool], depths * scene.thickness)) for x in (solver, reference))
    rows = []
    for answer, truth in zip(ours, truths, strict=True):
        error = float(np.linalg.norm(answer.displacement - truth.displacement, axis=1).max())
        peak = float(np.linalg.norm(truth.displacement, axis=1).max())
        rows.append((error, answer.trust.error_bound or np.inf, peak, answer.force / truth.force - 1))
    return rows


def bound_table(cases: tuple[tuple[Scene, int], ...], title: str) -> Table:
    """The stated bound beside the largest error, for one wedge deep, against two deep on half the edges."""
    table = Table(title=title)
    for column in ("tool", "reach", "depth, % of t", "error [mm]", "error / peak %", "bound / error", "force"):
        table.add_column(column, justify="right")
    for scene, reach in track(cases, title):
        reference = FinerFem(refine=4, layers=2, reach=reach + 2, check_stability=False)
        rows = errors(scene, IndenterFem(PatchFem(refine=3, reach=reach)), IndenterFem(reference))
        for depth, (error, bound, peak, force) in zip(CASE_DEPTHS, rows, strict=True):
            table.add_row(scene.name, str(reach), f"{100 * depth:.0f}", f"{1e3 * error:.3f}",
                          f"{100 * error / peak:.1f}", f"{bound / error:.2f}",
                          f"{100 * force:+.1f} %")  # fmt: skip
    return table


DEPTHS = np.r_[0.1:0.65:0.1, 0.7:0.97:0.04]  # thicknesses


@dataclass(frozen=True)
class Way:
    """How a tool went: depths [thicknesses], forces [N], mean pressures over E [-], faces' depth [thicknesses].

    All but the last were sound; `why` says what the last was not, and is empty where it was sound too.
    """

    scene: Scene
    depth: np.ndarray
    force: np.ndarray
    mean: np.ndarray
    entered: np.ndarray
    why: str

    @classmethod
    def of(cls, scene: Scene, answers: list[Indentation]) -> Way:
        """What answers of one press say."""
        figures = [answer.trust.figures for answer in answers]
        return cls(
            scene,
            np.array([answer.depth for answer in answers]) / scene.thickness,
            np.array([answer.force for answer in answers]),
            np.array([f["mean_pressure_over_modulus"] for f in figures]),
            np.array([f["faces_entered_m"] for f in figures]) / scene.thickness,
            answers[-1].trust.why,
        )

    def sound(self) -> int:
        """How many answers were sound."""
        return len(self.depth) - bool(self.why)

    def depth_at(self, mean: float) -> float:
        """Depth [thicknesses] at which the mean pressure over E passes `mean`; nan where it never does."""
        n = self.sound()
        return float(np.interp(mean, self.mean[:n], self.depth[:n], right=np.nan))


def ways_table(ways: list[Way]) -> Table:
    """How far each tool went, beside what confined columns would carry."""
    table = Table(title="rigid tools, mean pressure over E")
    for column in ("tool", "columns at 70 %", "mean at 70 %", "5 E at % of t", "sound to % of t", "mean there",
                   "faces in, % of t"):  # fmt: skip
        table.add_column(column, justify="right")
    for way in ways:
        n, at = way.sound(), way.depth_at(REQUIRED)
        bound = "-" if way.scene.limb else f"{columns_carry(way.scene, 0.7):.1f}"
        table.add_row(way.scene.name, bound, f"{np.interp(0.7, way.depth[:n], way.mean[:n]):.1f}",
                      "-" if np.isnan(at) else f"{100 * at:.0f}", f"{100 * way.depth[n - 1]:.0f}",
                      f"{way.mean[n - 1]:.1f}", f"{100 * way.entered[:n].max():.2f}")  # fmt: skip
    return table


def starts_table(ways: list[Way]) -> Table:
    """The force where the mean is 5 E: with half the steps, and from another place on the mesh."""
    table = Table(title=f"the same answer from other starts, at a mean pressure of {REQUIRED:g} E")
    for column in ("tool", "depth, % of t", "force [N]", "steps of 0.02 t", "0.7 mm aside"):
        table.add_column(column, justify="right")
    for way in ways:
        if np.isnan(depth := way.depth_at(REQUIRED)):
            continue
        here, fine, aside = (
            press(way.scene, np.array([depth]), **kind)[-1] for kind in ({}, {"step": 0.02}, {"aside": 0.7e-3})
        )
        table.add_row(way.scene.name, f"{100 * depth:.0f}", f"{here.force:.3f}",
                      *(f"{100 * (x.force / here.force - 1):+.2f} %" for x in (fine, aside)))  # fmt: skip
    return table


def picture(ways: list[Way], path: Path) -> None:
    """Force against depth for each tool, and the mean pressure beside what the issue asks."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), constrained_layout=True)
    for way in ways:
        n, style = way.sound(), STYLES[(way.scene.nu > QUADRATIC_ABOVE) + 2 * (way.scene.thickness < 5e-3)]
        colour = COLOURS[way.scene.name.split()[0]] if not way.scene.limb else "tab:grey"
        modulus, area = Tissue().youngs_modulus, way.scene.thickness**2
        left.semilogy(100 * way.depth[:n], way.force[:n] / (modulus * area), style, color=colour, label=way.scene.name)
        right.semilogy(100 * way.depth[:n], way.mean[:n], style, color=colour)
        for axes, value in ((left, way.force / (modulus * area)), (right, way.mean)):
            axes.plot(100 * way.depth[n - 1], value[n - 1], "x" if way.why else "o", color=colour)
    right.axhline(REQUIRED, color="black", lw=0.8)
    right.axvline(70, color="black", lw=0.8)
    left.set(
        xlabel="depth [% of the thickness]", ylabel="force / (E t²)", title="x: where it stops, o: not driven deeper"
    )
    right.set(xlabel="depth [% of the thickness]", ylabel="mean pressure / E", title="lines: 5 E, 70 %")
    for axes in (left, right):
        axes.grid(True, which="both", alpha=0.25)
    figure.legend(*left.get_legend_handles_labels(), loc="outside right center", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    plt.savefig(path, dpi=110)


def main() -> None:
    """Prints the tables and writes the picture."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    threadpool_limits(1)
    plt.switch_backend("agg")
    console = Console()
    ways = [Way.of(scene, press(scene, DEPTHS)) for scene in track(SCENES, "presses")]
    console.print(ways_table(ways))
    for way in ways:
        if way.why:
            console.print(f"{way.scene.name}, {100 * way.depth[-1]:.1f} %: {way.why}")
    picture(ways, PICTURE)
    console.print(starts_table(ways))
    console.print(bound_table(FITTED, "the stated bound where it was fitted"))
    console.print(bound_table(HELD_OUT, "the stated bound on cases held out"))
    console.print(f"picture: {PICTURE}")


if __name__ == "__main__":
    main()
