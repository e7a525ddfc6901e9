"""calibrate: how far off and how slow each method is, scene by scene: the measured chart that a Ladder chooses by."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy.sparse as sp
from scipy.optimize import nnls

from fem_tools.dataset import Dataset
from fem_tools.hand import Hand
from fem_tools.ladder import default_rungs
from fem_tools.patch import QUADRATIC_ABOVE, PatchFem
from fem_tools.sampling import ATTEMPTS, BodyPlan, ContactId, Plan, SetName, draw, layers
from fem_tools.scenes import Scene, Site, UnusableContact, ellipse
from stmpl_core.body import Body
from stmpl_core.errors import MeshError, StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods import Method
from stmpl_core.methods.ladder import RANGED, SHIPPED, Known, Measured, SceneFigures, SceneReader
from stmpl_core.provenance import commit, machine, versions
from stmpl_core.tissue import Tissue

COVERED = 0.95  # share of answers that must lie within the bound, on a body or under a shape that the fit has not seen
MARGIN = 1.25  # on that bound, for shapes unlike those of the fit
RIDGE = 1e-2
LEAST = 25  # trials that a fit needs
FEWEST = 100  # trials that a fit to what a method trusts needs; else all of its trials are taken
SLOWEST = 0.95  # quantile of the time over the fitted one
HIGHEST = 1.5  # p / E
LOWEST = 0.015  # of that
EDGES = ("", ", smoothed", ", hard")  # of contacts, one each: as drawn, smoothed, all or nothing
PASSES = 3  # of smoothing, each over a vertex and its neighbours
REPEATS = 3
TIMED = ((3e-3, "left_arm", 0.4), (4e-3, "left_arm", 0.4), (6e-3, "left_forearm", 0.4), (5e-3, "left_forearm", 0.45))
FIT: tuple[SetName, ...] = ("disc", "ellipse", "seam", "field")
UNSEEN = ("hand", "band", "letter", "ring", "star")
OUTLINES = ("ring", "star")
WIDTH = (8e-3, 20e-3)  # m, radii of rings and stars
Use = Literal["fit", "test", "shapes", "limbs"]  # contacts of the fit's kinds, new ones, new shapes, new limbs

BODIES = (
    BodyPlan(name="arm_3", weight=0.5, thickness=7.5e-3, edge_length=3e-3),
    BodyPlan(name="thin_4", weight=0.1, thickness=5e-3, poisson_ratio=0.35, edge_length=4e-3),
    BodyPlan(name="varying_4", weight=0.75, thickness=(3e-3, 12.5e-3), edge_length=4e-3),
    BodyPlan(name="thick_5", weight=0.9, thickness=10e-3, poisson_ratio=0.42, edge_length=5e-3),
    BodyPlan(name="light_35", weight=0.3, thickness=7.5e-3, poisson_ratio=0.3, edge_length=3.5e-3),
    BodyPlan(name="nu_49", weight=0.25, thickness=(4e-3, 10e-3), poisson_ratio=0.49, edge_length=5e-3),
    BodyPlan(name="calf_4", weight=0.4, thickness=8e-3, edge_length=4e-3, part="left_calf", held_out=True),
    BodyPlan(name="thigh_4", weight=0.7, thickness=(3e-3, 12.5e-3), poisson_ratio=0.37, edge_length=4e-3,
             part="right_thigh", held_out=True),
    BodyPlan(name="torso_5", weight=0.5, thickness=9e-3, poisson_ratio=0.33, edge_length=5e-3, part="torso",
             held_out=True),
    BodyPlan(name="forearm_47", weight=0.5, thickness=6.5e-3, poisson_ratio=0.47, edge_length=4e-3,
             part="right_forearm", held_out=True),
)  # fmt: skip
SCENES = {"fit": 6, "test": 3, "shapes": 3}  # contacts of each set on each body

OnProgress = Callable[[int, int, str], None]


def truth(nu: float = 0.4) -> PatchFem:
    """What the methods are judged by: triangles split in four twice (once if they are quadratic), two wedges deep."""
    return PatchFem(refine=1 if nu > QUADRATIC_ABOVE else 2, layers=2, check_stability=False)


@dataclass(frozen=True)
class Trial:
    """One method under one load.

    Args:
        body, use, set, kind: names of where the load comes from.
        method: name of the method.
        scene: figures of the scene.
        unit: thickness under the load times the strain of its columns [m].
        error: largest, at any vertex [m].
        peak: largest true displacement [m].
        much: mean error where the truth moves more than a tenth of the peak [m].
        seconds: median of some solves.
        ok: trust of the answer in itself.
        bound: bound that the answer states [m], or NaN.
    """

    body: str
    use: Use
    set: str
    kind: str
    method: str
    scene: SceneFigures
    unit: float
    error: float
    peak: float
    much: float
    seconds: float
    ok: bool
    bound: float


def trials_on(plan: Plan, body: BodyPlan, layer: SoftLayer, rungs: Sequence[Method], hand: Hand,
              scenes: Mapping[str, int]) -> Iterator[list[Trial]]:  # fmt: skip
    """Trials of every method on one body, one load after the other; what refuses the layer is left out."""
    site, reader = Site(layer), SceneReader(layer)
    judge, smooth = truth(layer.tissue.poisson_ratio).prepare(layer), _smoothing(layer)
    ready = _prepared(rungs, layer)
    parts: list[Any] = []  # use, set, number
    uses: tuple[tuple[Use, int], ...] = (("fit", 0), ("test", 100))
    for use, first in uses:
        name = "limbs" if body.held_out else use
        parts += [(name, kind, first + k) for kind in FIT for k in range(scenes[use])]
    other = "limbs" if body.held_out else "shapes"
    parts += [(other, kind, k) for kind in UNSEEN for k in range(scenes["shapes"])]
    for use, kind, number in parts:
        contact = ContactId(body.name, kind, number)
        rng = contact.rng(plan.seed)
        try:
            scene = _outlined(site, kind, rng) if kind in OUTLINES else draw(plan, contact, site, hand, rng)[0]
        except UnusableContact:
            continue
        edge = str(rng.choice(EDGES))
        footprint = {"": scene.footprint, ", smoothed": smooth @ scene.footprint, ", hard": 1.0 * scene.covered}[edge]
        ratio = HIGHEST * float(np.exp(rng.uniform(np.log(LOWEST), 0)))
        load = Load.pressure(ratio * layer.tissue.youngs_modulus * footprint / footprint.max())
        try:
            true = judge.solve(load)
        except MeshError:  # the patch holds a fold
            continue
        if true.trust.converged:
            yield list(_tried(ready, reader, load, true.displacement, (body.name, use, kind + edge)))


def _outlined(site: Site, kind: str, rng: np.random.Generator) -> Scene:
    """A ring or a star, pressed flat onto the skin. Raises UnusableContact."""
    import shapely

    radius, turn, area = float(rng.uniform(*WIDTH)), float(rng.uniform(0, 2 * np.pi)), site.layer.vertex_areas
    angle = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    reach = radius * np.where(np.arange(10) % 2, 0.5, 1.0)
    outline: Any = shapely.Polygon(np.column_stack([reach * np.cos(angle), reach * np.sin(angle)]))
    if kind == "ring":
        outline = ellipse(radius, radius).difference(ellipse(0.55 * radius, 0.55 * radius))
    for vertex in rng.choice(len(area), ATTEMPTS, p=area / area.sum()):
        try:
            return site.press_flat(int(vertex), outline, turn)
        except UnusableContact:
            continue
    raise UnusableContact(f"no {kind} of {1e3 * radius:.0f} mm fitted in {ATTEMPTS} attempts")


def trials_of_data(path: Path, rungs: Sequence[Method], count: int) -> Iterator[list[Trial]]:
    """Trials under what rigid tools press with: converged contacts of a data set of the preset "contacts"."""
    data = Dataset.open(path)
    for split, use in (("val", "fit"), ("test", "test"), ("held_out", "limbs")):
        for name, layer in data.layers.items():
            subset = data.split(split, kind="indenter", sets=("tool",), bodies=[name])  # type: ignore[arg-type]
            if not len(subset):
                continue
            reader, ready = SceneReader(layer), _prepared(rungs, layer)
            for k in np.linspace(0, len(subset) - 1, min(count, len(subset))).astype(int):
                sample = subset[int(k)]
                load = Load.contact(sample.load.values)
                where = (name, use, str(sample.info["drawn"]["tool"]))
                yield list(_tried(ready, reader, load, sample.displacement, where))


def _smoothing(layer: SoftLayer) -> sp.csr_matrix:
    """Means over each vertex and its neighbours, PASSES times over, (V, V)."""
    n, (a, b) = len(layer.vertices), layer.edges.T
    ones = np.ones(len(a))
    near = sp.csr_matrix((ones, (a, b)), shape=(n, n))
    near = near + near.T + sp.identity(n)
    mean = sp.diags(1 / np.asarray(near.sum(axis=1)).ravel()) @ near
    return sp.csr_matrix(mean**PASSES)


def _prepared(rungs: Sequence[Method], layer: SoftLayer) -> list[Method]:
    ready = []
    for rung in rungs:
        try:
            ready.append(rung.prepare(layer))
        except StmplError:
            continue
    return ready


def _tried(ready: Sequence[Method], reader: SceneReader, load: Load, true: np.ndarray,
           where: tuple[str, Any, str]) -> Iterator[Trial]:  # fmt: skip
    scene = reader.figures(load)
    if scene is None:
        return
    moved = np.linalg.norm(true, axis=1)
    much = moved > 0.1 * moved.max()
    for method in ready:
        spent = []
        for _ in range(REPEATS):
            started = time.perf_counter()
            answer = method.solve(load)
            spent.append(time.perf_counter() - started)
            if spent[-1] > 0.05:
                break
        error = np.linalg.norm(answer.displacement - true, axis=1)
        yield Trial(*where, load.kind, method.name, scene, reader.unit(scene),
                    float(error.max()), float(moved.max()), float(error[much].mean()), float(np.median(spent)),
                    answer.trust.ok, answer.trust.error_bound or float("nan"))  # fmt: skip


def gather(folder: Path, rungs: Sequence[Method] | None = None, *, scenes: Mapping[str, int] | None = None,
           bodies: Sequence[BodyPlan] = BODIES, contacts: Path | None = None, seed: int = 0,
           on_progress: OnProgress | None = None) -> list[Trial]:  # fmt: skip
    """All trials, body by body; a body whose trials lie in `folder` already is not run again.

    Args:
        folder: folder of the trials.
        rungs: methods, the default ones unless given.
        scenes: contacts of each set on each body, by use.
        bodies: limbs.
        contacts: data set of the preset "contacts", for what rigid tools press with; None: those are left out.
        seed: seed of the scenes.
    """
    plan = Plan(preset="calibrate", bodies=tuple(bodies), seed=seed)
    said, counts = on_progress or (lambda *_: None), scenes or SCENES
    everything = layers(plan)
    hand = Hand.of(Body.anny())
    folder.mkdir(parents=True, exist_ok=True)
    out: list[Trial] = []

    def kept(name: str, made: Callable[[], Iterator[list[Trial]]], total: int) -> None:
        file = folder / f"{name}.json"
        if not file.is_file():
            rows = []
            for k, trials in enumerate(made()):
                rows += trials
                said(k + 1, total, name)
            file.write_text(json.dumps([asdict(row) for row in rows]))
        out.extend(Trial(**{**row, "scene": SceneFigures(**row["scene"])}) for row in json.loads(file.read_text()))

    for body in bodies:
        use = rungs or default_rungs()
        total = (counts["fit"] + counts["test"]) * len(FIT) + counts["shapes"] * len(UNSEEN)
        kept(body.name, lambda b=body, r=use: trials_on(plan, b, everything[b.name], r, hand, counts), total)
    if contacts is not None:
        kept("contacts", lambda: trials_of_data(contacts, rungs or default_rungs(), 30), 30 * 18)
    return out


def times(rungs: Sequence[Method] | None = None, *, on_progress: OnProgress | None = None) -> Measured:
    """How long each method takes on this machine, one thread: a minute. The errors are those of the shipped chart."""
    said, use = on_progress or (lambda *_: None), rungs or default_rungs()
    chart, spent, scenes = Measured.load(SHIPPED), {rung.name: [] for rung in use}, []
    for k, (edge, part, nu) in enumerate(TIMED):
        layer = Body.anny().part(part, edge_length=edge, tissue=Tissue(poisson_ratio=nu))
        site, reader, rng = Site(layer), SceneReader(layer), np.random.default_rng(k)
        for rung in use:
            rung.prepare(layer)
        for j, radius in enumerate((0.006, 0.009, 0.013, 0.018, 0.024)):
            footprint = _disc(site, radius, rng)
            for ratio in (0.1, 0.7):
                load = Load.pressure(ratio * layer.tissue.youngs_modulus * footprint)
                scenes.append(reader.figures(load))
                for rung in use:
                    spent[rung.name].append(_median_time(rung, load))
            said(5 * k + j + 1, 5 * len(TIMED), f"{1e3 * edge:g} mm, disc of {1e3 * radius:g} mm")
    methods = {}
    for name, taken in spent.items():
        seconds, slow = _times(np.array([s.for_time() for s in scenes]), np.array(taken))
        methods[name] = replace(chart.methods[name], seconds=seconds, slow=slow)
    return Measured(methods, chart.ranges, {"machine": f"{machine()}, one thread", "commit": commit()})


def _disc(site: Site, radius: float, rng: np.random.Generator) -> np.ndarray:
    for vertex in rng.permutation(len(site.layer.vertices)):
        try:
            return site.press_flat(int(vertex), ellipse(radius, radius), 0.0).footprint
        except UnusableContact:
            continue
    raise UnusableContact(f"a disc of {1e3 * radius:g} mm fits nowhere")


def _median_time(method: Method, load: Load) -> float:
    method.solve(load)
    spent: list[float] = []
    while len(spent) < REPEATS or (sum(spent) < 0.05 and len(spent) < 50):
        started = time.perf_counter()
        method.solve(load)
        spent.append(time.perf_counter() - started)
    return float(np.median(spent))


def fit(trials: Sequence[Trial]) -> Measured:
    """The chart of these trials: errors from those meant for fitting, times from all.

    The factor on the error is such that COVERED of the answers on a body, and under a shape, are within the bound when
    the others were fitted: what is stated has to hold on limbs, meshes, tissues and shapes that were not measured.
    """
    methods: dict[str, Known] = {}
    for name in dict.fromkeys(t.method for t in trials):
        mine = [t for t in trials if t.method == name]
        before, after = {}, {}
        for kind in dict.fromkeys(t.kind for t in mine):
            learnt = [t for t in mine if t.kind == kind and t.use == "fit"]
            trusted = [t for t in learnt if t.ok]
            learnt = trusted if len(trusted) >= FEWEST else learnt
            if len(learnt) < LEAST:
                continue
            before[kind] = _law(learnt, np.array([t.scene.for_error() for t in learnt]))
            stating = [t for t in learnt if t.bound > 0]
            if len(stating) >= LEAST:
                rows = [np.append(t.scene.for_error(), np.log(t.bound / t.unit)) for t in stating]
                after[kind] = _law(stating, np.array(rows))
        terms, spent = np.array([t.scene.for_time() for t in mine]), np.array([t.seconds for t in mine])
        seconds, slow = _times(terms, spent)
        methods[name] = Known({k: c for k, (c, _) in before.items()}, {k: f for k, (_, f) in before.items()}, seconds,
                              slow, {k: c for k, (c, _) in after.items()}, {k: f for k, (_, f) in after.items()})
    ranges = {
        kind: {name: _range([getattr(t.scene, name) for t in trials if t.kind == kind and t.use == "fit"])
               for name in RANGED}
        for kind in dict.fromkeys(t.kind for t in trials)
    }  # fmt: skip
    about = {"machine": f"{machine()}, one thread", "commit": commit(), "trials": len(trials),
             "versions": versions(("numpy", "numba", "scipy")),
             "bodies": sorted({t.body for t in trials if t.use == "fit"})}  # fmt: skip
    return Measured(methods, ranges, about)


def _law(trials: Sequence[Trial], terms: np.ndarray) -> tuple[list[float], float]:
    """Coefficients of the logarithm of the error, and the factor that covers it on bodies and shapes left out."""
    value = np.log([t.error / t.unit for t in trials])
    law = _ridge(terms, value)
    missed = value - terms @ law
    for names in ([t.body for t in trials], [t.set for t in trials]):
        for name in set(names) if len(set(names)) > 1 else ():
            out = np.array([other == name for other in names])
            missed[out] = np.maximum(missed[out], value[out] - terms[out] @ _ridge(terms[~out], value[~out]))
    return law.tolist(), MARGIN * float(np.exp(np.quantile(missed, COVERED)))


def _times(terms: np.ndarray, spent: np.ndarray) -> tuple[list[float], float]:
    """Coefficients of the time, none negative, and how much longer one solve in twenty takes."""
    seconds = nnls(terms / spent[:, None], np.ones(len(spent)))[0]
    return seconds.tolist(), float(np.quantile(spent / (terms @ seconds), SLOWEST))


def _ridge(terms: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Least squares with a small penalty on all but the constant, so that terms that never vary stay at zero."""
    middle, mean = terms[:, 1:].mean(axis=0), value.mean()
    x = terms[:, 1:] - middle
    slopes = np.linalg.solve(x.T @ x + RIDGE * len(x) * np.eye(x.shape[1]), x.T @ (value - mean))
    return np.concatenate([[mean - middle @ slopes], slopes])


def _range(values: Sequence[float]) -> list[float]:
    return [float(min(values)), float(max(values))]


@dataclass(frozen=True)
class Coverage:
    """How the stated bounds did on loads that were not fitted.

    Args:
        method, use, kind: names of the answers that are counted.
        answers: number of answers that the method itself trusts, inside the range that was measured.
        covered: share of them whose error lies within the bound [-].
        tight: median of bound over error [-].
        error: median largest error over the peak [-].
        seconds: median [s].
    """

    method: str
    use: str
    kind: str
    answers: int
    covered: float
    tight: float
    error: float
    seconds: float


def coverage(trials: Sequence[Trial], chart: Measured) -> list[Coverage]:
    """Of every method, use and kind of load."""
    rows = []
    for name, known in chart.methods.items():
        for kind in known.error:
            for use in ("test", "shapes", "limbs"):
                mine = [t for t in trials if t.method == name and t.kind == kind and t.use == use and t.ok]
                mine = [t for t in mine if not chart.outside(t.scene, kind)]
                if not mine:
                    continue
                bound = np.array([known.bound(t.scene, kind, t.unit, t.bound) for t in mine])
                error = np.array([t.error for t in mine])
                rows.append(Coverage(name, use, kind, len(mine), float((error <= bound).mean()),
                                     float(np.median(bound / error)), float(np.median(error / [t.peak for t in mine])),
                                     float(np.median([t.seconds for t in mine]))))  # fmt: skip
    return rows
