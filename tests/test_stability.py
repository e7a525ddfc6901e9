"""The stability suite itself: each law catches the method that is made to break it, and no other law does."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from fem_tools import PatchFem
from stmpl_core import Displacement, Load, SoftLayer
from stmpl_core.chart import UvChart
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Winkler
from stmpl_core.methods.zero import Zero
from stmpl_core.trust import Trust
from studies.own import own
from studies.show import stability_markdown, stability_table
from studies.stability import AXES, LAWS, METHODS, PRESETS, Report, again, maker, stability
from studies.stability.contact_laws import CONTACT_LAWS
from studies.stability.laws import MEANING, least_det_f
from studies.stability.meshes import inserted, limb
from studies.stability.picture import LETTERS, draw
from studies.stability.scene import Mesh
from studies.stability.stroke_laws import STROKE_LAWS
from studies.stability.sweeps import AXIS_LEVELS

QUICK = PRESETS["quick"]
PRESSURES = QUICK.only("pressures")
MEMORY = 0.005  # of an answer, by which each one before it adds


class Faulty(Winkler):
    """Winkler, which holds every law of the quick sweep, with its answers spoilt by `fault(layer, load, u)`."""

    def __init__(self, fault: Callable[[SoftLayer, Load, np.ndarray], np.ndarray], flags: bool = False) -> None:
        super().__init__()
        self.fault, self.flags = fault, flags

    def solve(self, load: Load) -> Displacement:
        answer, layer = super().solve(load), self._layer
        assert layer is not None
        trust = Trust().also("I said so", in_range=False) if self.flags else Trust()
        return Displacement(self.fault(layer, load, answer.displacement), trust, "faulty", answer.pressure)


class Remembering(Winkler):
    """Each answer is larger than the one before."""

    answers = 0

    def solve(self, load: Load) -> Displacement:
        self.answers += 1
        answer = super().solve(load)
        return replace(answer, displacement=(1 + MEMORY * self.answers) * answer.displacement, trust=Trust())


class Swallowing(Winkler):
    """Takes what is not finite for zero, and does not say so."""

    def solve(self, load: Load) -> Displacement:
        return replace(super().solve(Load.pressure(np.nan_to_num(load.values, posinf=0, neginf=0))), trust=Trust())


class Choosy(Winkler):
    """Refuses thin layers."""

    def prepare(self, layer: SoftLayer) -> "Choosy":
        if layer.thickness.max() < 6e-3 and layer.edge_length > 6e-3:
            raise InvalidInput("too thin for me")
        super().prepare(layer)
        return self


class Switching(Winkler):
    """Another method from a threshold on, which answers more; both state a share of the peak as their bound."""

    def __init__(self, bound: float) -> None:
        super().__init__()
        self.bound = bound

    def solve(self, load: Load) -> Displacement:
        answer, layer = super().solve(load), self._layer
        assert layer is not None
        u, name = with_a_threshold(layer, load, answer.displacement), f"above {load.peak_ratio(layer) > 0.500001}"
        return replace(answer, displacement=u, method=name, trust=Trust(error_bound=self.bound * np.abs(u).max()))


class Short(Winkler):
    """Answers three vertices alone."""

    def solve(self, load: Load) -> Displacement:
        return Displacement(np.zeros((3, 3)), Trust(), "short")


class Odd(Winkler):
    """Answers as Winkler does, in another kind: complex or object arrays, words for trust, no Displacement."""

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.kind = kind

    def solve(self, load: Load) -> Any:
        answer = super().solve(load)
        if self.kind in ("complex", "object"):
            return replace(answer, displacement=answer.displacement.astype(self.kind))
        trust = cast(Any, "sure") if self.kind == "trust" else Trust(error_bound=cast(Any, "small"))
        return answer.displacement if self.kind == "array" else replace(answer, trust=trust)


ODD = {"complex": "displacement of complex128", "object": "displacement of object", "trust": "trust of type str",
       "bound": "error bound of type str", "array": "answer of type ndarray"}  # fmt: skip


class Crashing(Winkler):
    """Stumbles over high pressures."""

    def solve(self, load: Load) -> Displacement:
        return super().solve(load) if np.nanmax(load.values) < 900 else {}[load.kind]


def nan(layer, load, u):
    return np.where(np.arange(len(u))[:, None] == 7, np.nan, u)


def creeping(layer, load, u):
    return u + 1e-6 * layer.normals * (not load.values.any())


def saturating(layer, load, u):
    force = load.values * layer.vertex_areas
    return u * min(1.0, 50 * force.sum() / (force @ load.values)) if force.any() else u


def lifting(layer, load, u):
    return -u


def multiplied(layer, load, u):
    return u @ np.zeros((4, 3))  # numpy's ValueError


def too_deep(layer, load, u):
    return 9 * u


def drifting(layer, load, u):
    return u - 0.01 * np.linalg.norm(u, axis=1).max() * layer.normals


def along_x(layer, load, u):
    return u * [1.2, 1.0, 1.0]


def one_side_of_the_seam(layer, load, u):
    across = np.full(len(u), np.inf)
    np.minimum.at(across, layer.faces.ravel(), layer.chart.uv[..., 0].ravel())
    return np.where(across[:, None] < 0.25 * layer.chart.uv[..., 0].max(), 0.8 * u, u)


def in_its_own_units(layer, load, u):
    return u * (layer.thickness[:, None] / 7.5e-3) ** 0.5


def by_vertex_area(layer, load, u):
    return u * np.sqrt(layer.vertex_areas / np.median(layer.vertex_areas))[:, None]


def by_loaded_area(layer, load, u):
    return u * (1 + 3 * layer.vertex_areas[load.loaded].sum() / layer.vertex_areas.sum())


def with_a_threshold(layer, load, u):
    return 1.3 * u if load.peak_ratio(layer) > 0.500001 else u


def faulty(fault, flags: bool = False):
    return lambda: Faulty(fault, flags)


FAULTS = {
    "finite": faulty(nan), "zero": faulty(creeping), "monotone": faulty(saturating),
    "sinks": faulty(lifting), "unfolded": faulty(too_deep), "leak": faulty(drifting),
    "objective": faulty(along_x), "seam": faulty(one_side_of_the_seam),
    "similar": faulty(in_its_own_units), "mesh": faulty(by_vertex_area), "additive": faulty(by_loaded_area),
    "gain": faulty(with_a_threshold), "returns": Remembering, "refuses": Swallowing, "answers": Choosy,
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[Report, object]:
    """All faulty methods, a sound one, Zero, one that flags its fault and one that crashes, in one quick sweep."""
    out = tmp_path_factory.mktemp("stability")
    others = {"sound": Winkler, "nothing": Zero, "honest": faulty(too_deep, flags=True), "crashing": Crashing,
              "short": Short, "multiplied": faulty(multiplied), **{kind: partial(Odd, kind) for kind in ODD},
              "candid": lambda: Switching(0.3), "boastful": lambda: Switching(0.01)}  # fmt: skip
    return stability(FAULTS | others, PRESSURES, out), out


def broken(report: Report, method: str) -> set[str]:
    return {one.law for row in report.rows if row.method == method for one in row.broken}


@pytest.mark.parametrize("law", FAULTS)
def test_a_method_made_to_break_a_law_is_caught_by_exactly_that_law(run, law):
    assert broken(run[0], law) == {law}


def test_every_law_and_every_axis_is_tried():
    assert set(FAULTS) == set(LAWS) - set(CONTACT_LAWS) - set(STROKE_LAWS) | {"answers", "refuses"}
    assert set(MEANING) == set(LAWS) | {"answers", "refuses"} == set(LETTERS)
    assert list(QUICK.levels) == list(AXIS_LEVELS) == list(AXES)


def test_columns_hold_every_law_of_the_quick_sweep(run):
    report = run[0]
    assert not broken(report, "sound")
    assert report.counts("sound")["held"] == sum(map(len, PRESSURES.levels.values()))


def test_two_methods_of_one_that_chooses_agree_within_the_bounds_that_they_state(run):
    assert not broken(run[0], "candid")
    assert broken(run[0], "boastful") == {"gain"}


def test_zero_breaks_only_what_it_must_and_says_so(run):
    report = run[0]
    assert broken(report, "nothing") == {"monotone", "sinks"}
    assert report.counts("nothing")["silent"] == 0 < report.counts("nothing")["flagged"]


def test_a_fault_that_is_flagged_counts_apart_from_a_silent_one(run):
    report = run[0]
    honest, silent = report.counts("honest"), report.counts("unfolded")
    assert broken(report, "honest") == {"unfolded"}
    assert (honest["silent"], silent["flagged"]) == (0, 0)
    assert honest["flagged"] == silent["silent"] > 0


def test_a_refusal_of_a_sound_input_is_flagged_and_a_crash_is_not(run):
    report = run[0]
    refused = [row for row in report.rows if row.method == "answers" and row.broken]
    assert {(row.axis, row.outcome) for row in refused} == {("thickness", "flagged")}
    assert "too thin for me" in refused[0].broken[0].why
    crashed = [row for row in report.rows if row.method == "crashing" and row.outcome == "crashed"]
    assert {row.axis for row in crashed} >= {"pressure", "not finite"}
    assert "KeyError" in crashed[0].broken[0].measured


@pytest.mark.parametrize(
    ("method", "said"), [("short", r"TypeError.*shape \(3, 3\)"), ("multiplied", "ValueError"), *ODD.items()]
)
def test_an_answer_of_another_shape_and_an_error_that_is_none_of_ours_are_crashes_of_that_method_alone(
    run, method, said
):
    """The one ended the sweep, the other counted as a refusal, which is flagged."""
    rows = [row for row in run[0].rows if row.method == method]
    assert {row.outcome for row in rows if row.axis != "not finite"} == {"crashed"}
    assert all(re.search(said, row.broken[0].measured) for row in rows if row.outcome == "crashed")


def test_a_method_that_writes_into_its_layer_crashes_and_the_next_gets_what_it_was(tmp_path):
    class Writes(Zero):
        def prepare(self, layer):
            layer.vertices[:] = layer.thickness[:] = 0
            return super().prepare(layer)

    few = QUICK.only("pressures")
    report, alone = stability({"writes": Writes, "zero": Zero}, few), stability({"zero": Zero}, few)
    assert set(report.counts("writes")) >= {"crashed"} and not report.counts("writes")["held"]
    assert "wrote into its layer's thickness and vertices" in str(report.rows[0])
    assert report.counts("zero") == alone.counts("zero")


def test_the_summary_names_the_range_held_and_the_first_failure(run):
    summary = run[0].summary("crashing", "pressure")
    assert summary == {"held": "0.1 E ... 0.5 E", "failed_at": "1 E", "law": "answers", "outcome": "crashed"}


@pytest.mark.parametrize("law", FAULTS)
def test_a_saved_failure_fails_again_and_holds_with_a_sound_method(run, law):
    row = next(row for row in run[0].rows if row.method == law and row.broken)
    repeated = again(row.file, FAULTS.__getitem__)
    assert (repeated.outcome, [one.law for one in repeated.broken]) == (row.outcome, [law])
    assert repeated.broken[0].measured == row.broken[0].measured
    assert not again(row.file, lambda name: Winkler).broken


def test_a_file_that_is_no_failure_is_refused(tmp_path):
    other = tmp_path / "other.json"
    other.write_text("{}")
    with pytest.raises(InvalidInput, match=r"other.json is no failure that can be run again.*\.npz beside it"):
        again(other, maker)


def test_report_table_and_picture_hold_every_method_and_axis(run):
    report, out = run
    kept = json.loads((out / "report.json").read_text())
    assert len(kept["rows"]) == len(report.rows)
    assert set(kept["summary"]) == set(kept["counts"]) == set(report.methods)
    assert stability_table(report, out).row_count == len(report.axes) + 4
    page = stability_markdown(report)
    assert all(f"| {axis} |" in page for axis in report.axes) and "| crashed |" in page
    assert "silent at 0.1 E: finite" in page
    assert re.search(r"^- crashing: crashed: KeyError\(.*\) \(\d+ times\)", page, re.MULTILINE)
    assert draw(report, out / "stability.png").read_bytes().startswith(b"\x89PNG")


def test_methods_are_found_by_name_and_by_module_and_attribute():
    assert isinstance(maker("tests.test_stability:Choosy")(), Choosy)
    assert maker("zero") is Zero
    for name, said in (("nothing", "Available: zero"), ("tests.test_stability:Nothing", "no attribute"),
                       ("tests.test_stability:QUICK", "no prepare and no solve")):  # fmt: skip
        with pytest.raises(InvalidInput, match=said):
            maker(name)
    assert set(METHODS) >= {"naive", "winkler", "linear", "moment_net", "unet", "fem", "fem_1_step", "ladder"}


YOURS = """
from stmpl_core import Displacement, Trust
from stmpl_core.methods import Linear

class Careful:
    name = "careful"

    def prepare(self, layer):
        self.inner = Linear().prepare(layer)
        return self

    def solve(self, load):
        return Displacement(0.9 * self.inner.solve(load).displacement, Trust(in_range=False, why="a guess"), self.name)
"""


def test_a_method_in_a_file_of_ones_own_is_the_class_in_it_or_the_one_that_is_named(tmp_path, monkeypatch):
    """Word for word what docs/stability.md shows."""
    page = (Path(__file__).parents[1] / "docs" / "stability.md").read_text()
    (shown,) = re.findall(r"```python\n(.*?)```", page, re.S)
    assert "".join(shown.split()) == "".join(YOURS.split())
    file = tmp_path / "yours.py"
    file.write_text(YOURS)
    for name in (str(file), f"{file}:Careful"):
        assert maker(name)().name == "careful"
    monkeypatch.chdir(tmp_path)
    report = stability({"yours.py": maker("yours.py")}, QUICK.only("pressures"), tmp_path)
    counts = report.counts("yours.py")
    assert counts["held"] > 10 and not counts["crashed"] and not counts["silent"]
    for text, said in ((YOURS + "class Other(Careful):\n    pass\n", "has Careful, Other with prepare and solve. Say "
                        "which"), ("x = 1\n", "has no class with prepare and solve"),
                       ("import nothing_of_the_kind\n", "could not be run: ModuleNotFoundError"),
                       ("import sys\nsys.exit(5)\n", r"it ends the process \(exit 5\)")):  # fmt: skip
        file.write_text(text)
        with pytest.raises(InvalidInput, match=said):
            maker(str(file))
    (tmp_path / "ending.py").write_text("raise SystemExit(5)")
    with pytest.raises(InvalidInput, match=r"it ends the process \(exit 5\)"):
        maker("ending:Careful")
    file.write_text(YOURS)
    file.write_text(YOURS.replace("def prepare", "def __init__(self, needed):\n        pass\n\n    def prepare"))
    with pytest.raises(InvalidInput, match=r"called without arguments, and fails: TypeError: .*'needed'"):
        maker(str(file))
    file.write_text(YOURS)
    for name, parts, said in ((f"{file}:Nothing", (), "has no Nothing"), (str(file), (), "Say which, as in")):
        with pytest.raises(InvalidInput, match=said):
            own(name, *parts)


def test_det_f_is_the_stretch_of_columns_that_are_pressed_evenly():
    """On a flat face all columns shorten alike: det F is one minus depth over thickness; past the core it is < 0."""
    layer = SoftLayer(np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0.0]]), [[0, 1, 2]], 5e-3)
    for depth in (1e-3, 6e-3):
        u = np.tile([0, 0, -depth], (3, 1))
        assert least_det_f(layer, u) == pytest.approx(1 - depth / 5e-3, rel=1e-12)


def test_finite_elements_hold_det_f_where_their_own_is_positive():
    """J of straight columns stays positive for a converged answer at p = E, as J of its elements does."""
    mesh = limb(7e-3, 0.04, 0.16, 7.5e-3)
    x = np.clip((0.012 - np.linalg.norm(mesh.vertices - mesh.vertices[len(mesh.vertices) // 2], axis=1)) / 6e-3, 0, 1)
    answer = PatchFem(reach=3, check_stability=False).prepare(mesh.layer).solve(Load.pressure(1e3 * x))
    assert answer.trust.converged
    assert 0 < least_det_f(mesh.layer, answer.displacement) < 1
    assert answer.trust.figures["min_j"] > 0


def test_the_limb_is_its_own_mirror_image_at_its_seam():
    mesh = limb(7e-3, 0.04, 0.16, 7.5e-3)
    layer = mesh.layer
    seam = mesh.vertices[layer.chart.seam_vertices]
    assert len(seam) and (seam[:, 0] > 0).all() and np.abs(seam[:, 1]).max() <= 0.5 * 7e-3
    mirrored = layer.vertices * [1, -1, 1]
    away = np.linalg.norm(mirrored[:, None] - layer.vertices[None], axis=2)
    assert away.min(axis=1).max() < 1e-12
    partner = away.argmin(axis=1)
    here = {tuple(sorted(face)) for face in layer.faces.tolist()}
    assert {tuple(sorted(face)) for face in partner[layer.faces].tolist()} == here


def test_inserted_vertices_keep_the_skin_and_its_chart():
    mesh = limb(7e-3, 0.04, 0.16, 7.5e-3)
    finer = inserted(mesh, np.arange(0, 200, 2), (0.45, 0.45, 0.1))
    assert len(finer.faces) == len(mesh.faces) + 200
    assert finer.layer.vertex_areas.sum() == pytest.approx(mesh.layer.vertex_areas.sum(), rel=1e-12)
    assert isinstance(Mesh.of(finer.layer).layer.chart, UvChart)
    assert len(finer.layer.border) == len(mesh.layer.border)


def test_the_verb_sweeps_and_runs_a_failure_again(tmp_path, capsys):
    from stmpl_ros.cli import main

    def said(*arguments: str) -> tuple[int, dict]:
        with pytest.raises(SystemExit) as ended:
            main(["stability", *arguments, "--json"])
        return int(ended.value.code or 0), json.loads(capsys.readouterr().out)

    code, report = said("--preset", "quick", "--only", "pressures", "--methods", "zero", "--out",
                        str(tmp_path))  # fmt: skip
    assert code == 0 and (tmp_path / "stability.png").exists()
    failed = next(row for row in report["rows"] if row["broken"])
    code, row = said("--again", failed["file"])
    assert code == 1
    assert row["broken"][0]["law"] == failed["broken"][0]["law"] == "monotone"


def test_a_sweep_of_no_method_is_refused():
    with pytest.raises(InvalidInput, match="no method is given"):
        stability({}, PRESETS["quick"])
