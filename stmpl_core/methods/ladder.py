"""Ladder: for each load the cheapest method that is expected to be accurate enough in the time that there is."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

import numba
import numpy as np

from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import Method, prepared
from stmpl_core.methods.winkler import column_stretch
from stmpl_core.text_file import text_of
from stmpl_core.trust import Displacement, Trust

log = logging.getLogger(__name__)

SHIPPED = Path(__file__).parent.parent / "weights" / "ladder.json"
MOVING_RADIUS = 6.0  # distance around a load within which the skin moves, over t
LINEAR = 0.01  # strain below which the response is linear, and the error a share of it that no longer changes
PACE = 0.2  # weight of the newest solve in the mean slowness of the machine
LOCKS = 0.42  # Poisson's ratio above which finite elements turn to quadratic ones (fem_tools.patch.QUADRATIC_ABOVE)
RANGE_FACTOR = 1.1  # factor beyond the measured range of a scene's figure that is not yet called outside


@dataclass(frozen=True)
class SceneFigures:
    """Figures of a scene that decide error and time of a method.

    Args:
        strain: strain of a confined column under the highest pressure [-].
        nu: Poisson's ratio [-].
        width: length of the mesh's edges over the thickness under the load [-].
        slope: slope of the thickness along the skin, largest under the load [-].
        outline: total variation of the pressure over the force, times that thickness; 2 t / R for a disc [-].
        jump: largest difference of pressure across an edge of the mesh, over the highest pressure [-].
        ratio: highest p / E [-].
        pressed: number of vertices that carry load.
        moved: number of vertices within MOVING_RADIUS thicknesses of the load, were it a disc on a plane.
    """

    strain: float
    nu: float
    width: float
    slope: float
    outline: float
    jump: float
    ratio: float
    pressed: float
    moved: float

    def for_error(self) -> np.ndarray:
        """Terms of the logarithm of the error, (10,).

        How wide the parts of a contact are counts, which its outline says, not how wide they are together: a hand errs
        as five fingers do. 1 - 2 nu is what remains of the compressibility.
        """
        s, w, o = np.log(max(self.strain, LINEAR)), np.log(self.width), np.log(self.outline)
        return np.array([1.0, s, s * s, o, o * o, s * o, w, self.jump, np.log(1 - 2 * self.nu),
                         self.slope])  # fmt: skip

    def for_time(self) -> np.ndarray:
        """Terms of the time of a solve, each growing with the work of some method, (5,)."""
        quadratic = self.moved if self.nu > LOCKS else 0.0
        return np.array([1.0, self.moved, self.moved * self.ratio, self.pressed * self.moved, quadratic])


RANGED = ("strain", "nu", "width", "slope", "outline", "jump")  # figures whose measured range counts
EASY = ("strain", "slope", "jump")  # figures among these whose small values are no extrapolation


class SceneReader:
    """Reads SceneFigures off loads on one layer, in some tens of microseconds."""

    def __init__(self, layer: SoftLayer) -> None:
        self.layer = layer
        ends = np.concatenate([layer.edges, layer.edges[:, ::-1]])
        ends = ends[np.argsort(ends[:, 0], kind="stable")]
        self._to = np.ascontiguousarray(ends[:, 1])
        self._length = np.linalg.norm(layer.vertices[ends[:, 0]] - layer.vertices[ends[:, 1]], axis=1)
        self._first = np.searchsorted(ends[:, 0], np.arange(len(layer.vertices) + 1))
        squared = 2 / 3**0.5 * layer.vertex_areas  # of the edges of an even mesh [m2]
        self._across = np.pi / 4 * np.sqrt(squared / 3)  # dual length of each edge, over the mean of |cos| [m]

    def unit(self, scene: SceneFigures) -> float:
        """Thickness under the load times the strain of its columns [m]: errors are measured in it."""
        return self.layer.edge_length / scene.width * scene.strain

    def figures(self, load: Load) -> SceneFigures | None:
        """Figures of a load that fits the layer; None if nothing presses."""
        layer, loaded = self.layer, load.loaded
        if not len(loaded):
            return None
        area, pressure = layer.vertex_areas[loaded], np.abs(load.pressure_on(layer))
        here = pressure[loaded]
        force, highest = float(area @ here), float(here.max())
        t = float((area * here) @ layer.thickness[loaded]) / force
        strain = float(1 - column_stretch(np.array([highest]), layer.tissue)[0])
        patch = np.pi * ((float(area.sum()) / np.pi) ** 0.5 + MOVING_RADIUS * t) ** 2
        variation, jump, slope = _steps(loaded, pressure, layer.thickness, self._first, self._to, self._length,
                                        self._across)  # fmt: skip
        return SceneFigures(
            strain=strain, nu=layer.tissue.poisson_ratio, width=layer.edge_length / t, slope=slope,
            outline=max(variation * t / force, 1e-3), jump=jump / highest, ratio=highest / layer.tissue.youngs_modulus,
            pressed=float(len(loaded)), moved=min(patch * len(area) / float(area.sum()), float(len(layer.vertices))),
        )  # fmt: skip


@numba.njit(cache=True)
def _steps(loaded, pressure, thickness, first, to, length, across):
    """Total variation of the pressure [N/m], its largest step across an edge [Pa], the thickness' largest slope [-]."""
    variation = jump = slope = 0.0
    for v in loaded:
        for k in range(first[v], first[v + 1]):
            w = to[k]
            step = abs(pressure[v] - pressure[w])
            variation += step * across[v] * (0.5 if pressure[w] > 0.0 else 1.0)
            jump = max(jump, step)
            slope = max(slope, abs(thickness[v] - thickness[w]) / length[k])
    return variation, jump, slope


@dataclass(frozen=True)
class Known:
    """Measured error and time of one method.

    Args:
        error: coefficients of SceneFigures.for_error for log(error / (thickness strain)), by kind of load.
        factor: factor on that error, so that 95 % of answers are within it, by kind of load.
        after, after_factor: coefficients and factor with one more term, the logarithm of the bound that the method
            itself states (over thickness times strain): what to expect once it has answered. Empty if it states none.
        seconds: coefficients of SceneFigures.for_time [s].
        slow: factor on that time that one solve in twenty exceeds.
    """

    error: Mapping[str, Sequence[float]]
    factor: Mapping[str, float]
    seconds: Sequence[float]
    slow: float
    after: Mapping[str, Sequence[float]] = field(default_factory=dict)
    after_factor: Mapping[str, float] = field(default_factory=dict)

    def bound(self, scene: SceneFigures, kind: str, unit: float, stated: float | None = None) -> float:
        """Bound on the error of 95 % of answers [m]; `stated`: the method's own bound, once it has answered [m]."""
        terms = scene.for_error()
        if kind in self.after and stated is not None and stated > 0:
            terms = np.append(terms, np.log(stated / unit))
            return unit * self.after_factor[kind] * float(np.exp(terms @ np.asarray(self.after[kind])))
        return unit * self.factor[kind] * float(np.exp(terms @ np.asarray(self.error[kind])))


@dataclass(frozen=True)
class Measured:
    """Measured errors and times of all methods, by which a Ladder chooses.

    Args:
        methods: figures by the name of the method, in the order in which they were measured.
        ranges: lowest and highest of each figure in RANGED, by kind of load.
        about: machine, commit, and the way in which it was made.
    """

    methods: Mapping[str, Known]
    ranges: Mapping[str, Mapping[str, Sequence[float]]]
    about: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a file that `save` wrote. Raises InvalidInput if there is no such file or it holds something else."""
        try:
            found = json.loads(text_of(path))
            return cls({name: Known(**known) for name, known in found["methods"].items()},
                       found["ranges"], found["about"])  # fmt: skip
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidInput(f"{path} holds no measured chart: {error}. Make one with stmpl calibrate.") from error

    def save(self, path: str | Path) -> None:
        """Writes it as JSON."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(json.dumps(asdict(self), indent=1) + "\n")

    def outside(self, scene: SceneFigures, kind: str) -> str:
        """Sentence on how a scene lies outside the measured range; empty if it does not."""
        out = []
        for name, (low, high) in self.ranges.get(kind, {}).items():
            value = getattr(scene, name)
            least, most = (low, high) if name == "nu" else (low / RANGE_FACTOR, high * RANGE_FACTOR)
            if not (0 if name in EASY else least - 1e-9) <= value <= most + 1e-9:
                out.append(f"{name} is {value:.3g}, measured is {low:.3g} to {high:.3g}")
        return "; ".join(out)

    def timed_by(self, other: Measured) -> Measured:
        """The same errors with the times of another machine, where it has them in the same terms."""
        if any(len(known.seconds) != len(other.methods[n].seconds)
               for n, known in self.methods.items() if n in other.methods):  # fmt: skip
            log.warning("times that an older version measured are not used. Measure them again: stmpl calibrate.")
        methods = {
            name: replace(known, seconds=other.methods[name].seconds, slow=other.methods[name].slow)
            if name in other.methods and len(other.methods[name].seconds) == len(known.seconds) else known
            for name, known in self.methods.items()
        }  # fmt: skip
        return replace(self, methods=methods, about={**self.about, "times": dict(other.about)})


@dataclass(frozen=True)
class _Expected:
    rung: int
    error: float  # 95 % quantile of the error [m]
    seconds: float  # 95 % quantile of the time [s]


@runtime_checkable
class FromFrames(Protocol):
    """A method that starts from its last answer, and so is quicker where the load is near the last one.

    Attributes:
        measured_as: name of the method whose measured error and time it has where it starts anew.
    """

    measured_as: str

    def share_of_time(self, load: Load) -> float:
        """Share of that time that this load takes, by what it answered last [-]."""
        ...


def _measured_as(rung: Method) -> str:
    return rung.measured_as if isinstance(rung, FromFrames) else rung.name


class Ladder:
    """Hands each load to the cheapest of several methods that is expected to meet the accuracy in time.

    What is expected comes from a measured chart: error and time of each method as functions of the scene (how hard, how
    wide, how thick, how fine a mesh), and from how busy the machine just was. Where an answer says that it is not to be
    believed, or is not as good as wished, the next better method is asked, if there is time. Every answer names the
    method that gave it, says why it was chosen, and carries a bound that 95 % of such answers kept, by the chart and
    by what the method states of itself. Where nothing meets the wish, the best that fits is given and flagged.

    Outside what the chart was measured on its errors mean nothing: the most accurate method that time allows answers,
    those that say of themselves that they are in range before those that do not. The answer is flagged.

    `left_out` says which methods do not answer on this layer, and why; every answer names them.

    Args:
        rungs: methods, not yet prepared, the most accurate last; those that the chart does not know are left out.
        measured: chart of their times and errors.
        accuracy: largest error wanted at any vertex [m].
        deadline: time for each solve [s]; None: as long as it needs.

    Raises:
        InvalidInput: an accuracy or deadline that is not positive, or no rung that the chart knows.
    """

    name = "ladder"

    def __init__(self, rungs: Sequence[Method], measured: Measured, *, accuracy: float = 1e-4,
                 deadline: float | None = None) -> None:  # fmt: skip
        if not accuracy > 0 or (deadline is not None and not deadline > 0):
            raise InvalidInput(f"Ladder(accuracy={accuracy}, deadline={deadline}): both must be positive, m and s.")
        self.rungs = [rung for rung in rungs if _measured_as(rung) in measured.methods]
        if not self.rungs:
            raise InvalidInput("none of the methods was measured. stmpl calibrate --errors measures them.")
        self.measured, self.accuracy, self.deadline = measured, accuracy, deadline
        self._unknown = {rung.name: "the chart does not know it" for rung in rungs if rung not in self.rungs}
        self.left_out: dict[str, str] = dict(self._unknown)
        known = self._known = [measured.methods[_measured_as(rung)] for rung in self.rungs]
        self._seconds = np.array([k.seconds for k in known])
        self._slow = np.array([k.slow for k in known])
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """Prepares every method; those that refuse the layer are left out.

        Raises:
            InvalidInput: all of them refuse it.
        """
        self._ready, refused = np.ones(len(self.rungs), dtype=bool), {}
        for k, rung in enumerate(self.rungs):
            try:
                if layer.stacked and "moment_net" in rung.name:
                    raise InvalidInput("its bound was measured on one material, its other network's was not")
                rung.prepare(layer)
            except StmplError as error:
                self._ready[k], refused[rung.name] = False, f"it refuses the layer: {error}"
        self.left_out = self._unknown | refused
        for name, why in self.left_out.items():
            log.warning("the ladder does without %s: %s", name, why)
        if not self._ready.any():
            raise InvalidInput(f"no method takes this layer. {' '.join(f'{n}: {why}' for n, why in refused.items())}")
        self._reader = SceneReader(layer)
        self._pace = np.ones(len(self.rungs))
        self._layer = layer
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load` by the method that was chosen; `method` names it, `trust.why` says why.

        Raises:
            NotPrepared: a call before `prepare`.
            InvalidInput: the load does not fit the layer.
        """
        layer, started = prepared(self._layer, self), time.perf_counter()
        scene = self._reader.figures(load.check(layer))
        if scene is None:
            zero = np.zeros_like(layer.vertices)
            return Displacement(zero, Trust(error_bound=0.0), self.name, load.pressure_on(layer))
        options, outside = self._expected(scene, load)
        if not options:
            raise InvalidInput(f"no method was measured under loads of the kind {load.kind!r}.")
        tried: list[tuple[_Expected, Displacement]] = []
        refused: dict[str, StmplError] = {}
        while True:
            left = None if self.deadline is None else self.deadline - (time.perf_counter() - started)
            choice = self._choose(options, left, first=not tried, outside=bool(outside))
            if choice is None:
                break
            options = [o for o in options if o.rung != choice.rung]
            known = self._known[choice.rung]
            try:
                answer = self._ask(choice, load, scene)
            except StmplError as error:
                refused[self.rungs[choice.rung].name] = error
                continue
            if not outside:
                options = [o for o in options if o.error < choice.error]
            bound = known.bound(scene, load.kind, self._reader.unit(scene), answer.trust.error_bound)
            choice = replace(choice, error=bound)
            tried.append((choice, answer))
            if answer.trust.ok and (outside or choice.error <= self.accuracy):
                break
        if not tried:
            raise next(iter(refused.values()))
        sound = [pair for pair in tried if pair[1].trust.ok] or tried
        choice, answer = sound[0] if outside else min(sound, key=lambda pair: pair[0].error)
        return self._told(choice, answer, outside, len(tried), [*self.left_out, *refused])

    def _expected(self, scene: SceneFigures, load: Load) -> tuple[list[_Expected], str]:
        """What to expect of each method that was measured under such loads, and how the scene is outside of that."""
        unit, kind = self._reader.unit(scene), load.kind
        shares = [rung.share_of_time(load) if isinstance(rung, FromFrames) else 1.0 for rung in self.rungs]
        self._shares = np.array(shares)
        seconds = self._seconds @ scene.for_time() * self._slow * self._shares
        if self.deadline is not None:  # without one, the same loads get the same answers on every run
            seconds = seconds * self._pace
        options = []
        for k, known in enumerate(self._known):
            if self._ready[k] and kind in known.error:
                options.append(_Expected(k, known.bound(scene, kind, unit), float(seconds[k])))
        return options, self.measured.outside(scene, kind)

    def _choose(self, options: list[_Expected], left: float | None, *, first: bool, outside: bool) -> _Expected | None:
        """The cheapest that is accurate enough in the time left; else the most accurate in time; else the fastest.

        `outside` of the chart the most accurate is the highest rung.
        """
        in_time = [o for o in options if left is None or o.seconds <= left]
        if outside and in_time:
            return max(in_time, key=lambda o: o.rung)
        good = [o for o in in_time if o.error <= self.accuracy]
        if good:
            return min(good, key=lambda o: o.seconds)
        if in_time:
            return min(in_time, key=lambda o: o.error)
        return min(options, key=lambda o: o.seconds) if first and options else None

    def _ask(self, choice: _Expected, load: Load, scene: SceneFigures) -> Displacement:
        started = time.perf_counter()
        answer = self.rungs[choice.rung].solve(load)
        spent, k = time.perf_counter() - started, choice.rung
        usual = float(self._seconds[k] @ scene.for_time()) * self._slow[k] * self._shares[k]
        self._pace[k] = max(1.0, (1 - PACE) * self._pace[k] + PACE * spent / max(usual, 1e-6))
        return answer

    def _told(self, choice: _Expected, answer: Displacement, outside: str, tries: int,
              without: list[str]) -> Displacement:  # fmt: skip
        """The answer with the ladder's own bound and reasons; `without`: names of the methods that cannot answer."""
        wish = f"{1e3 * self.accuracy:.2g} mm" + ("" if self.deadline is None else f" in {1e3 * self.deadline:.3g} ms")
        chosen = f"chosen for {wish}: "
        chosen += "the most accurate in time" if outside else f"at most {1e3 * choice.error:.2g} mm"
        chosen += f", in {1e3 * choice.seconds:.2g} ms expected"
        if without:
            chosen += f", without {' and '.join(without)}, which cannot serve here"
        own = answer.trust
        figures = {**own.figures, "expected_s": choice.seconds, "tries": float(tries)}
        trust = Trust(own.converged, own.in_range, choice.error, "; ".join(filter(None, (own.why, chosen))), figures)
        if choice.error > self.accuracy and not outside:
            trust = trust.also("nothing meets the wish, this is the best that fits", in_range=False)
        if self.deadline is not None and choice.seconds > self.deadline:
            trust = trust.also("nothing is fast enough, this is the fastest", in_range=False)
        if outside:
            trust = trust.also(f"outside what the chart was measured on: {outside}", in_range=False)
        if outside or not own.ok:
            trust = replace(trust, error_bound=None)
        return Displacement(answer.displacement, trust, answer.method, answer.pressure)
