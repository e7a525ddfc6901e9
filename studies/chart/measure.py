"""measure: every step of every curve on every scene, its time and its error against one converged reference."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from fem_tools.hand import Hand
from fem_tools.patch import PatchFem
from fem_tools.scenes import Scene, Site, UnusableContact, ellipse, letter
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.extras import needed
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods import Method
from stmpl_core.metrics import score
from stmpl_core.provenance import commit, machine, versions
from studies.chart.curves import CURVES, Curve

OnProgress = Callable[[int, int, str], None]
SCENES = ("disc", "letter", "band", "grasp", "disc on the seam")
OFF_SEAM = 6.0  # thicknesses that the other scenes keep from the seam, where the limb is wide enough
LONG = 4.0  # s of a first solve from which it is not repeated
PATIENCE = 5.0  # s of a solve from which dearer steps of its curve are left out on that scene
VERSIONS = ("stmpl", "numpy", "numba", "scipy", "torch", "mujoco", "felupe", "warp-lang", "newton")


@dataclass(frozen=True)
class Preset:
    """How much is measured.

    Args:
        edge_length: edge length of the skin [m].
        part: part of the body.
        ratios: highest p / E of each row of panels.
        scenes: names out of SCENES.
        seconds: spent on timing each fast point.
    """

    edge_length: float = 3e-3
    part: str = "left_arm"
    ratios: tuple[float, ...] = (0.1, 0.6)
    scenes: tuple[str, ...] = SCENES
    seconds: float = 0.4


PRESETS = {
    "default": Preset(),
    "quick": Preset(6e-3, "left_forearm", (0.6,), ("disc", "letter"), 0.1),
}  # fmt: skip


@dataclass(frozen=True)
class Point:
    """One step of one curve on one scene; errors as shares of the largest true displacement.

    Args:
        curve, knob: method, and value of its knob.
        scene, ratio: load, and its highest p / E [-].
        seconds, slow: median and 99th percentile of a solve [s]; the latter NaN for fewer than 100 solves.
        error: mean over the vertices that move more than a tenth of the peak [-].
        contact: mean under the load [-].
        peak: signed error at the peak [-].
        far: largest answer beyond 8 thicknesses [-].
        mee: mean error, as the paper has it, over all that moves [-].
        largest: largest error at any vertex [-].
        converged, in_range: flags of the answer itself.
        why: words of the answer itself, or of the error that ended it.
        failed: there is no answer, or one that did not converge.
    """

    curve: str
    knob: str
    scene: str
    ratio: float
    seconds: float = math.nan
    slow: float = math.nan
    error: float = math.nan
    contact: float = math.nan
    peak: float = math.nan
    far: float = math.nan
    mee: float = math.nan
    largest: float = math.nan
    converged: bool = False
    in_range: bool = False
    why: str = ""
    failed: bool = True


@dataclass(frozen=True)
class Chart:
    """All points, and what they were measured on."""

    points: tuple[Point, ...]
    about: dict[str, Any] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """As JSON; NaN as null."""
        rows = [{k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(p).items()}
                for p in self.points]  # fmt: skip
        path.write_text(json.dumps({"about": self.about, "points": rows}, indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> Self:
        """What `save` wrote. Raises InvalidInput: no such file, or something else in it."""
        try:
            found = json.loads(path.read_text())
            rows: list[dict[str, Any]] = [{k: math.nan if v is None else v for k, v in row.items()}
                                          for row in found["points"]]  # fmt: skip
            return cls(tuple(Point(**row) for row in rows), found["about"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidInput(f"{path} holds no chart: {error}.") from error

    def front(self, scene: str, ratio: float) -> list[Point]:
        """Points of one panel than which none is both faster and more accurate, fastest first."""
        here = [p for p in self.points if p.scene == scene and p.ratio == ratio and not p.failed and p.curve != "zero"]
        front: list[Point] = []
        for point in sorted(here, key=lambda p: (p.seconds, p.error)):
            if not front or point.error < front[-1].error:
                front.append(point)
        return front


def contact(name: str, layer: SoftLayer, seed: int = 0) -> Scene:
    """The tool of a scene, on the first of some drawn vertices where it can stand.

    Raises:
        UnusableContact: it can stand nowhere.
    """
    site, rng = Site(layer), np.random.default_rng(seed)
    seam = layer.chart.seam_vertices
    away = np.linalg.norm(layer.vertices[:, None] - layer.vertices[seam][None], axis=2).min(axis=1)
    on_seam = name == "disc on the seam"
    order = rng.permutation(seam if on_seam else np.flatnonzero(away > OFF_SEAM * np.median(layer.thickness)))
    for vertex in map(int, order):
        try:
            if name == "letter":
                return site.press_flat(vertex, letter("R", 0.028), 0.3)
            if name == "band":
                return site.strap(vertex, 0.025, 0.1)
            if name == "grasp":
                return site.grasp(vertex, Hand.of(Body.anny()), 0.1, 2e-3, np.zeros(5))
            return site.press_flat(vertex, ellipse(0.012, 0.012), 0.0)
        except UnusableContact as error:
            last = error
    raise UnusableContact(f"{name} fits nowhere: {last}")


def measure(preset: Preset, curves: Sequence[Curve] = CURVES, *, reference: PatchFem | None = None,
            parts: Path | None = None, on_progress: OnProgress | None = None) -> Chart:  # fmt: skip
    """Runs everything on one thread.

    Args:
        preset: scenes and layer.
        curves: methods; those whose packages are not installed are left out, and named in `about`.
        reference: method that judges; quadratic wedges at half the mesh width, two deep, unless given.
        parts: folder for what is done; a run that was stopped goes on from there. Empty it when a method has changed.
        on_progress: function that is called after each point.
    """
    needed("the chart", "studies", "threadpoolctl")
    from threadpoolctl import threadpool_limits

    said = on_progress or (lambda *_: None)
    layer = Body.anny().part(preset.part, edge_length=preset.edge_length)
    judge = reference or PatchFem(element="P2xP2", refine=1, layers=2, reach=7, check_stability=False)
    judge.prepare(layer)
    missing = [f"{c.name} (no {c.extra})" for c in curves if not c.installed]
    curves = [c for c in curves if c.installed]
    total = len(preset.scenes) * (1 + sum(len(c.steps) for c in curves))
    points: list[Point] = []
    with threadpool_limits(1):
        truths = {}
        for k, name in enumerate(preset.scenes):
            said(k, total, f"reference of {name}")
            footprint = contact(name, layer).footprint * layer.tissue.youngs_modulus
            loads = [Load.pressure(ratio * footprint) for ratio in preset.ratios]
            truths[name] = list(zip(preset.ratios, loads, _truths(judge, loads, parts, name), strict=True))
        done = len(preset.scenes)
        for curve in curves:
            file = parts / f"{curve.name}.json" if parts else None
            if file and file.is_file():
                points += Chart.load(file).points
                done += len(curve.steps) * len(truths)
                continue
            first = len(points)
            for knob, make in curve.steps:
                method: Method | StmplError
                try:
                    method = make().prepare(layer)
                except StmplError as error:
                    method = error
                for name, cases in truths.items():
                    ready = False
                    for ratio, load, truth in cases:
                        what = (curve.name, knob, name, ratio)
                        slow = max((p.seconds for p in points if (p.curve, p.scene, p.ratio) ==
                                    (curve.name, name, ratio)), default=0.0)  # fmt: skip
                        if isinstance(method, StmplError):
                            points.append(Point(*what, why=f"{method}"))
                        elif slow > PATIENCE:
                            points.append(Point(*what, why=f"left out: a cheaper step took {slow:.0f} s"))
                        else:
                            ready = ready or _set_up(method, load)
                            points.append(_point(what, method, load, truth, layer, preset, curve.fast))
                    done += 1
                    said(done, total, f"{curve.name}, {knob}: {name}")
            if file:
                Chart(tuple(points[first:])).save(file)
    about = {
        "machine": f"{machine()}, one thread", "versions": versions(VERSIONS), "commit": commit(),
        "layer": repr(layer), "scenes": list(preset.scenes), "ratios": list(preset.ratios), "missing": missing,
        "reference": "P2xP2, half the mesh width, two wedges deep" if reference is None else judge.name,
    }  # fmt: skip
    return Chart(tuple(points), about)


def _truths(judge: PatchFem, loads: Sequence[Load], parts: Path | None, name: str) -> list[np.ndarray]:
    file = parts / f"{name}.npy" if parts else None
    if file and file.is_file():
        return list(np.load(file))
    found = [answer.displacement for answer in judge.solve_many(loads)]
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        np.save(file, np.array(found))
    return found


def _set_up(method: Method, load: Load) -> bool:
    """Solves once without counting: what compiles and what is kept for a scene is paid once. True."""
    with suppress(Exception):  # told where it is counted
        method.solve(load)
    return True


def _point(what: tuple[str, str, str, float], method: Method, load: Load, truth: np.ndarray, layer: SoftLayer,
           preset: Preset, fast: bool) -> Point:  # fmt: skip
    started = time.perf_counter()
    try:
        answer = method.solve(load)
    except Exception as error:  # a peer raises what it likes
        return Point(*what, why=f"{error}" if isinstance(error, StmplError) else f"{type(error).__name__}: {error}")
    first, spent = time.perf_counter() - started, []
    while not spent or (sum(spent) < preset.seconds and len(spent) < 400) or (len(spent) < 3 and not fast):
        if first > LONG:
            spent = [first]
            break
        started = time.perf_counter()
        answer = method.solve(load)
        spent.append(time.perf_counter() - started)
        if spent[-1] > LONG / 4:
            break
    if not np.isfinite(answer.displacement).all():
        return Point(*what, why="the answer is not finite")
    result = score(answer.displacement, truth, layer, load)
    largest = float(np.linalg.norm(answer.displacement - truth, axis=1).max())
    peak = result.peak
    return Point(
        *what, float(np.median(spent)), float(np.quantile(spent, 0.99)) if len(spent) >= 100 else math.nan,
        result.much / peak, result.contact / peak, result.peak_share, result.leak / peak, result.mee_share,
        largest / peak, answer.trust.converged, answer.trust.in_range, answer.trust.why, not answer.trust.converged,
    )  # fmt: skip
