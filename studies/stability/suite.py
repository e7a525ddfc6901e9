"""The suite: asks each method each trial, judges the answers by the laws, and sums up where each method fails."""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.methods.base import Method
from stmpl_core.provenance import commit, machine, versions
from stmpl_core.trust import Displacement, Trust
from studies.stability import failures
from studies.stability.laws import LAWS, VERDICTS, Answers, Broken
from studies.stability.scene import Make, Mesh, Pressures, Scene
from studies.stability.sweeps import Preset, Stage, trials
from studies.stability.trial import Trial

log = logging.getLogger(__name__)

Outcome = Literal["held", "unfinished", "refused", "flagged", "needless", "silent", "crashed"]
WORST: tuple[Outcome, ...] = ("held", "unfinished", "flagged", "needless", "silent", "crashed")
PATIENCE = 15.0  # s of processor time, for the repetitions of one trial
VERSIONS = ("stmpl", "numpy", "scipy", "numba", "torch")
OnProgress = Callable[[int, int, str], None]  # trials done, in all, and which is next


@dataclass(frozen=True)
class Row:
    """One trial of one method.

    Args:
        outcome: held; flagged: a law broke and the method said not to trust the answer, or refused a sound input;
            needless: sound, but flagged; silent: a law broke and the method said nothing; crashed: an error that is
            none of ours; unfinished: too slow for all repetitions, what there was held.
        broken: laws that broke, and how.
        file: failure that can be run again.
    """

    method: str
    axis: str
    level: str
    outcome: Outcome
    broken: tuple[Broken, ...] = ()
    note: str = ""
    file: str = ""


@dataclass(frozen=True)
class Report:
    """All rows of a run, in the order of the sweep, and what made them."""

    rows: tuple[Row, ...]
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def methods(self) -> list[str]:
        """Names, in the order they were given."""
        return list(dict.fromkeys(row.method for row in self.rows))

    @property
    def axes(self) -> list[str]:
        """Names, in the order of the sweep."""
        return list(dict.fromkeys(row.axis for row in self.rows))

    def cell(self, method: str, axis: str) -> list[Row]:
        """A method's trials along an axis, from easy to hard."""
        return [row for row in self.rows if (row.method, row.axis) == (method, axis)]

    def counts(self, method: str) -> dict[str, int]:
        """How many trials of a method ended how."""
        mine = [row.outcome for row in self.rows if row.method == method]
        return {outcome: mine.count(outcome) for outcome in WORST}

    def summary(self, method: str, axis: str) -> dict[str, str]:
        """The range of an axis that a method held up to its first failure, and that failure; empty where none."""
        cell = self.cell(method, axis)
        first = next((k for k, row in enumerate(cell) if row.broken), len(cell))
        held = [row.level for row in cell[:first]]
        summary = {"held": f"{held[0]} ... {held[-1]}" if len(held) > 1 else "".join(held), "failed_at": "", "law": "",
                   "outcome": ""}  # fmt: skip
        if first < len(cell):
            row = cell[first]
            summary |= {"failed_at": row.level, "law": ", ".join(b.law for b in row.broken), "outcome": row.outcome}
        return summary

    def crashes(self) -> list[str]:
        """What the methods' crashes said, each once, with how often."""
        said = Counter((row.method, b.measured) for row in self.rows if row.outcome == "crashed"
                       for b in row.broken if b.measured.startswith("crashed"))  # fmt: skip
        return [f"{method}: {why:.200} ({many} times)" for (method, why), many in said.most_common()]

    def as_dict(self) -> dict[str, Any]:
        """For JSON: counts, summary of each method and axis, every trial."""
        return {
            "about": dict(self.about),
            "counts": {method: self.counts(method) for method in self.methods},
            "summary": {m: {axis: self.summary(m, axis) for axis in self.axes} for m in self.methods},
            "rows": [asdict(row) for row in self.rows],
        }


def stability(methods: Mapping[str, Make], preset: Preset, out: Path | None = None, *, patience: float = PATIENCE,
              on_progress: OnProgress | None = None) -> Report:  # fmt: skip
    """Runs a preset on every method.

    Args:
        methods: functions that make a fresh method, by its name (studies.stability.methods.maker).
        preset: preset of the sweeps.
        out: folder for report.json and failures/; nothing is written unless given.
        patience: time for the repetitions of one trial [s of processor time].
        on_progress: function that is called before each trial of each method.

    Raises:
        InvalidInput: no method, or a preset with an axis that does not exist, or whose skin cannot be made.
    """
    if not methods:
        raise InvalidInput("no method is given to try. Try moment_net, or yours as file.py or module:attribute.")
    stage, rows = Stage.of(preset), []
    total, done = len(methods) * sum(map(len, preset.levels.values())), 0
    for trial in trials(stage, preset):
        for name, make in methods.items():
            if on_progress is not None:
                on_progress(done, total, f"{trial.axis} {trial.level}, {name}")
            row = judge(name, make, trial, patience=patience)
            if out is not None and row.broken:
                found = asdict(row)
                row = Row(**{**vars(row), "file": str(failures.save(out / "failures", trial, name, found))})
            rows.append(row)
            done += 1
    about = {"commit": commit(), "machine": machine(), "versions": versions(VERSIONS), "seed": preset.seed,
             "skin": repr(stage.mesh.layer), "body": preset.body}  # fmt: skip
    report = Report(tuple(rows), about)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "report.json").write_text(json.dumps(report.as_dict(), indent=1) + "\n")
    return report


def again(path: str | Path, make: Callable[[str], Make], *, patience: float = PATIENCE) -> Row:
    """Runs a saved failure again with the method that `make` finds under the name it was saved with.

    Raises:
        InvalidInput: no such failure, or no such method.
    """
    trial, name = failures.load(path)
    return judge(name, make(name), trial, patience=patience)


def judge(name: str, make: Make, trial: Trial, *, patience: float = PATIENCE) -> Row:
    """Asks fresh methods for a trial's answers, and judges them by its laws. One that writes into its layer crashed."""
    meshes = [scene.mesh for scene in (trial.scene, trial.twin and trial.twin.scene) if scene is not None]
    before = [{key: values.copy() for key, values in mesh.arrays().items()} for mesh in meshes]
    row = _judge(name, make, trial, patience)
    wrote = {key for mesh, kept in zip(meshes, before, strict=True) for key in _written(mesh, kept)}
    if not wrote:
        return row
    for mesh, kept in zip(meshes, before, strict=True):  # the trials that follow get what it was
        vars(mesh).pop("layer", None)
        for key, values in mesh.arrays().items():
            values[:] = kept[key]
    broken = Broken("answers", f"crashed: it wrote into its layer's {' and '.join(sorted(wrote))}", False)
    return Row(name, trial.axis, trial.level, "crashed", (broken,))


def _written(mesh: Mesh, kept: dict[str, np.ndarray]) -> Iterator[str]:
    """Names of the arrays of a mesh and its layer that are no longer what was kept."""
    layer, now = vars(mesh).get("layer"), list(mesh.arrays().items())
    if layer is not None and mesh.core is None:
        now.append(("thickness", layer.thickness))  # a layer's own copy
    yield from (key for key, values in now if not np.array_equal(values, kept[key], equal_nan=True))


def _judge(name: str, make: Make, trial: Trial, patience: float) -> Row:
    try:
        if "refuses" in trial.laws:
            assert isinstance(trial.scene, Pressures)
            return _refused(name, make().prepare(trial.scene.mesh.layer), trial, trial.scene)
        answers, done = _answers(make, trial, patience)
    except StmplError as error:
        broken = Broken("answers", "refused", True, str(error))
        return Row(name, trial.axis, trial.level, "flagged", (broken,))
    except (Exception, SystemExit) as error:  # a method of others may end itself
        log.debug("%s crashed at %s %s", name, trial.axis, trial.level, exc_info=True)
        broken = Broken("answers", f"crashed: {error!r}", False)
        return Row(name, trial.axis, trial.level, "crashed", (broken,))
    note = "" if done == trial.rounds else f"{done:,} of {trial.rounds:,} rounds in {patience:g} s of processor time"
    row = judged(name, trial, answers)
    return replace(row, note=note, outcome="unfinished" if note and row.outcome == "held" else row.outcome)


def judged(name: str, trial: Trial, answers: Answers) -> Row:
    """How answers end by the trial's laws."""
    broken = []
    for law in trial.laws:
        if (found := LAWS[law](trial, answers)) is not None:
            broken.append(found)
            if law == "finite":  # the other laws have nothing to measure
                break
    return Row(name, trial.axis, trial.level, _outcome(broken) if broken else "held", tuple(broken))


def checked(scene: Scene, answers: list[Displacement]) -> list[Displacement]:
    """Answers that laws can be judged on. Raises TypeError: of another shape or kind."""
    for answer in answers:
        _check(answer, scene)
    return answers


def _check(answer: object, scene: Scene) -> None:
    if not isinstance(answer, Displacement):
        raise TypeError(f"an answer of type {type(answer).__name__}; a Displacement is asked for")
    if not isinstance(answer.trust, Trust):
        raise TypeError(f"a trust of type {type(answer.trust).__name__}; a Trust is asked for")
    if not isinstance(bound := answer.trust.error_bound, float | int | np.floating | np.integer | None):
        raise TypeError(f"an error bound of type {type(bound).__name__}; metres or None are asked for")
    found, asked = answer.displacement, scene.mesh.vertices.shape
    if not isinstance(found, np.ndarray) or not np.issubdtype(found.dtype, np.floating):
        kind = found.dtype if isinstance(found, np.ndarray) else type(found).__name__
        raise TypeError(f"a displacement of {kind}; an array of real floating numbers is asked for")
    if found.shape != asked:
        raise TypeError(f"a displacement of shape {found.shape}; {asked} is asked for")


def _refused(name: str, method: Method, trial: Trial, scene: Pressures) -> Row:
    """Whether loads that are not finite are refused with an error that says so, or answered and flagged."""
    broken: list[Broken] = []
    outcome: Outcome = "held"
    for load in scene.loads():
        try:
            _check(answer := method.solve(load), scene)
        except StmplError:
            continue
        except (Exception, SystemExit) as error:  # a method of others may end itself
            broken.append(Broken("refuses", f"crashed: {error!r}", False))
            outcome = "crashed"
            continue
        bad = int((~np.isfinite(answer.displacement)).any(axis=1).sum())
        if not answer.trust.ok:
            if bad:
                broken.append(Broken("refuses", f"answered, {bad} vertices not finite", True, answer.trust.why))
                outcome = _worse(outcome, "flagged")
            continue
        broken.append(Broken("refuses", f"answered without a word, {bad} vertices not finite", False))
        outcome = _worse(outcome, "silent")
    return Row(name, trial.axis, trial.level, outcome, tuple(broken))


def _outcome(broken: list[Broken]) -> Outcome:
    if any(not one.flagged for one in broken):
        return "silent"
    return "needless" if all(one.law in VERDICTS for one in broken) else "flagged"


def _worse(one: Outcome, other: Outcome) -> Outcome:
    return one if WORST.index(one) > WORST.index(other) else other


def _answers(make: Make, trial: Trial, patience: float) -> tuple[Answers, int]:
    """The answers to the last round, and how many rounds there were."""
    scene, done = [], 0
    ask = trial.scene.prepared(make)
    until = time.process_time() + patience
    while done < trial.rounds and (done == 0 or time.process_time() < until):
        scene = checked(trial.scene, ask())
        done += 1
    last = trial.scene.last
    fresh = checked(last, last.prepared(make)())[-1] if "returns" in trial.laws else None
    return Answers(scene, _twin(make, trial), fresh), done


def _twin(make: Make, trial: Trial) -> list[Displacement]:
    if trial.twin is None:
        return []
    try:
        assert trial.twin.scene.mesh.layer
    except InvalidInput:
        if trial.twin.may_refuse:
            return []
        raise
    return checked(trial.twin.scene, trial.twin.scene.prepared(make)())
