"""The stability suite's contacts: each law catches the simulator that is made to break it, and so does the fuzz."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from stmpl_core import Answer, Contact, Simulator, SoftLayer
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import MomentNet, Winkler
from stmpl_core.touch import APART, NO_TOUCH, Touch
from stmpl_core.trust import Trust
from studies.stability import PRESETS, Report, again, judge, stability
from studies.stability.contact_axes import CONTACT_AXES, CONTACT_LEVELS, QUICK_CONTACTS
from studies.stability.contact_laws import CONTACT_LAWS
from studies.stability.fuzz import TOOLS, fuzz, random_mesh, random_tool, random_trial
from studies.stability.layered_axes import TRIALS
from studies.stability.picture import draw
from studies.stability.shapes import ball, box, capsule, punch, ring
from studies.stability.sweeps import Stage, trials
from studies.stability.trial import Trial
from studies.stability.truth import FILE, SCENES, truth

QUICK = PRESETS["quick"]
LAYERED = ("first touch", "0.65 t", "1e+20 N", "slide, capsule", "by force, 0.5 t", "edges of 0.6 t", "x 0.5", "90°")
Fault = Callable[[Answer, Sequence[Contact], SoftLayer], Answer]


class Faulty(Simulator):
    """A simulator that trusts all that it says, spoilt by `fault(answer, contacts, layer)`."""

    fault: Fault

    def step(self, contacts: Sequence[Contact]) -> Answer:
        answer = super().step(contacts)
        answer = replace(changed(answer, lambda touch: {"trust": Trust()}), trust=Trust())
        return self.fault(answer, contacts, self.layer)


@dataclass
class Brings:
    """A method that brings its own simulator."""

    fault: Fault

    def simulator(self, layer: SoftLayer) -> Faulty:
        made = Faulty(layer, Winkler())
        made.fault = self.fault
        return made


def changed(answer: Answer, change: Callable[[Touch], dict]) -> Answer:
    """An answer with each of its touches changed."""
    return replace(answer, touches={name: replace(t, **change(t)) for name, t in answer.touches.items()})


def stronger(answer: Answer, by: float) -> Answer:
    return changed(answer, lambda touch: {"wrench": by * touch.wrench})


def moved(answer: Answer, displacement: np.ndarray) -> Answer:
    return replace(answer, displacement=displacement)


def nothing(answer, contacts, layer):
    return answer


def nan(answer, contacts, layer):
    return moved(answer, np.where(np.arange(len(layer.vertices))[:, None] == 7, np.nan, answer.displacement))


def too_far(answer, contacts, layer):
    return moved(answer, 40 * answer.displacement)


def softening(answer, contacts, layer):
    return changed(answer, lambda touch: {"wrench": touch.wrench / (1 + (touch.depth / 1e-3) ** 4)})


def lost(answer, contacts, layer):
    return changed(answer, lambda touch: {"status": APART, "wrench": 0 * touch.wrench})


def not_found(answer, contacts, layer):
    return changed(answer, lambda touch: {"status": NO_TOUCH, "wrench": 0 * touch.wrench})


def weak(answer, contacts, layer):
    return stronger(answer, 0.9)


def through_air(answer, contacts, layer):
    return moved(answer, answer.displacement + 1e-5 * (layer.vertices[:, :1] > 0))


def popping(answer, contacts, layer):
    back = np.eye(4)
    back[2, 3] = 1e-3 * (contacts[0].wrench is not None)
    return changed(answer, lambda touch: {"pose_body_from_tool": back @ touch.pose_body_from_tool})


def jumping(answer, contacts, layer):
    return moved(answer, answer.displacement * (1 + 0.02 * (contacts[0].pose_body_from_tool[2, 3] > 0.08005)))


def rippling(answer, contacts, layer):
    return stronger(answer, 1 + 0.007 * np.sin(2e3 * contacts[0].pose_body_from_tool[2, 3]))


def trembling(answer, contacts, layer):
    return moved(answer, (1 + 0.016 * np.sin(2e3 * contacts[0].pose_body_from_tool[2, 3])) * answer.displacement)


def shallow(answer, contacts, layer):
    return moved(answer, 0.5 * answer.displacement)


def unsure(answer, contacts, layer):
    return replace(changed(answer, lambda touch: {"trust": Trust(in_range=False)}), trust=Trust(in_range=False))


def unsure_of_thin(answer, contacts, layer):
    return unsure(answer, contacts, layer) if layer.thickness[0] < 5e-3 else answer


def in_its_own_units(answer, contacts, layer):
    return stronger(answer, (layer.thickness[0] / 7.5e-3) ** 0.5)


def along_x(answer, contacts, layer):
    return changed(answer, lambda touch: {"wrench": touch.wrench * [1.2, 1, 1, 1, 1, 1]})


def by_mesh(answer, contacts, layer):
    return stronger(answer, 1.3 if layer.vertex_areas.min() < 0.3 * np.median(layer.vertex_areas) else 1.0)


class Growing:
    """Each answer is larger than the one before."""

    count = 0

    def __call__(self, answer, contacts, layer):
        self.count += 1
        return moved(answer, (1 + 1e-3 * self.count) * answer.displacement)


FAULTS: dict[str, tuple[str, Callable[[], Fault]]] = {  # the axis on which it shows, and what breaks the law
    "finite": ("torque", lambda: nan), "bounded": ("kind", lambda: too_far), "rises": ("depth", lambda: softening),
    "touches": ("depth", lambda: lost), "presses": ("first touch", lambda: not_found),
    "carries": ("overload", lambda: weak), "still": ("through air", lambda: through_air),
    "steady": ("pop", lambda: popping), "smooth": ("creep", lambda: jumping), "ripple": ("slide", lambda: rippling),
    "outside": ("depth", lambda: shallow), "covers": ("kind", lambda: shallow), "needless": ("massage", lambda: unsure),
    "verdict": ("scale of contact", lambda: unsure_of_thin), "agrees": ("fit", lambda: unsure),
    "similar": ("scale of contact", lambda: in_its_own_units), "objective": ("turn of contact", lambda: along_x),
    "mesh": ("area jump of contact", lambda: by_mesh), "returns": ("cycles of contact", Growing),
}  # fmt: skip
WITH = {"touches": {"presses"}, "bounded": {"covers"}}  # what breaks with a law
LEVELS = QUICK_CONTACTS | {"depth": (0.3,), "torque": (0.0,)}


@pytest.fixture(scope="module")
def made() -> dict[str, list[Trial]]:
    """The quick trials of each axis."""
    stage = Stage.of(replace(QUICK, levels={}))
    preset = replace(QUICK, levels={axis: LEVELS[axis] for axis in CONTACT_AXES})
    found = list(trials(stage, preset))
    return {axis: [trial for trial in found if trial.axis == axis] for axis in CONTACT_AXES}


def broken(fault: Callable[[], Fault], some: Sequence[Trial]) -> set[str]:
    rows = [judge("one", lambda: Brings(fault()), trial) for trial in some]
    assert not any(row.outcome == "crashed" for row in rows), rows
    return {one.law for row in rows for one in row.broken}


@pytest.mark.parametrize("law", FAULTS)
def test_a_simulator_made_to_break_a_law_is_caught_by_that_law(made, law):
    axis, fault = FAULTS[law]
    assert broken(fault, made[axis]) == {law} | WITH.get(law, set())


def test_a_sound_simulator_is_not_caught(made):
    for axis in {axis for axis, _ in FAULTS.values()}:
        assert not broken(lambda: nothing, made[axis]), axis


def test_every_law_of_contacts_is_broken_here_and_every_axis_has_levels():
    assert set(FAULTS) >= set(CONTACT_LAWS)
    assert list(CONTACT_AXES) == list(CONTACT_LEVELS) == list(QUICK_CONTACTS)


def test_a_peak_that_ripples_under_a_steady_force_is_caught(made):
    assert broken(lambda: trembling, made["slide"]) == {"ripple"}


def test_flags_without_need_count_apart(tmp_path):
    report = stability({"unsure": lambda: Brings(unsure)}, some("massage", "fit"), tmp_path)
    assert report.counts("unsure")["needless"] == len(report.rows) == 2
    assert draw(report, tmp_path / "stability.png").read_bytes().startswith(b"\x89PNG")


def test_a_torque_without_a_word_is_silent(made):
    """One of two torques that are dropped is flagged: the other counts."""

    def half_said(answer, contacts, layer):
        return answer if contacts[0].wrench[:3].any() else unsure(answer, contacts, layer)

    stage = Stage.of(replace(QUICK, levels={}))
    trial = CONTACT_AXES["torque"](stage, 1.0)
    assert judge("one", lambda: Brings(half_said), trial).outcome == "silent"
    assert judge("one", lambda: Brings(unsure), trial).outcome == "flagged"


@pytest.mark.parametrize("axis", ["pop", "kind", "through air", "turn of contact"])
def test_a_saved_failure_of_a_contact_fails_again_and_holds_with_a_sound_simulator(tmp_path, axis):
    fault = {"kind": shallow, "pop": popping, "through air": through_air, "turn of contact": along_x}[axis]
    (row,) = stability({"faulty": lambda: Brings(fault)}, some(axis), tmp_path).rows
    repeated = again(row.file, lambda name: lambda: Brings(fault))
    assert row.broken and repeated.broken == row.broken
    assert not again(row.file, lambda name: lambda: Brings(nothing)).broken


def some(*axes: str):
    return replace(QUICK, levels={axis: LEVELS[axis] for axis in axes})


def test_truth_is_of_the_scenes_that_are_pressed():
    for axis, (_, levels) in SCENES.items():
        assert set(CONTACT_LEVELS[axis]) == set(levels)
        for level in levels:
            found = truth(axis, level)
            assert len(found.instants) == len(found.truth.forces) == 2
            assert np.linalg.norm(found.truth.displacement, axis=2).max() < found.mesh.thickness.max()
    with pytest.raises(InvalidInput, match=rf"{FILE.name} has no scene 'slant 60'"):
        truth("slant", 60)


def test_no_answer_to_a_rigid_tool_is_silent_or_flagged_in_vain(tmp_path):
    """The whole sweep of contacts, with the method that the node answers by; a minute."""
    preset = PRESETS["default"].only("contacts")
    levels = {**preset.levels, "part as measured": preset.levels["part as measured"][::2]}  # each is a skin to prepare
    report = stability({"moment_net": MomentNet}, replace(preset, levels=levels), tmp_path)
    counts = report.counts("moment_net")
    assert counts["silent"] == counts["needless"] == counts["crashed"] == 0, list(tmp_path.glob("failures/*"))
    thin = [row for row in report.rows if row.axis == "tips" and row.outcome == "flagged"]  # meant to be, if too thin
    assert len(report.rows) > 135 and counts["flagged"] - len(thin) <= 20 and len(thin) <= 3
    of_layers = {row.level: row.outcome for row in report.rows if row.axis == "skin, fat, muscle"}
    assert {told: of_layers[told] for told in LAYERED} == {
        told: "flagged" if told == "1e+20 N" else "held" for told in LAYERED}  # fmt: skip


@pytest.mark.parametrize("told", LAYERED)
def test_one_material_is_not_mistaken_for_skin_fat_and_muscle(told):
    (trial,) = [trial for trial in (make() for make in TRIALS) if trial.level == told]
    refused = judge("winkler", Winkler, trial)
    assert refused.outcome == "flagged" and refused.broken[0].measured == "refused"


def test_tools_of_the_suite_are_closed_and_turned_outwards():
    for tool in (ball(0.01), capsule(0.004, 0.02), punch(0.01, 0.02), ring(0.03, 0.005), box(0.01, 0.02, 0.03)):
        v, f = tool.vertices, tool.faces
        assert not tool.mendings
        assert np.einsum("ij,ij->", v[f[:, 0]], np.cross(v[f[:, 1]], v[f[:, 2]])) > 0


def test_the_fuzz_finds_what_is_wrong_and_nothing_else(tmp_path):
    count, seen = 60, []
    sound = fuzz("sound", Winkler, count, 3)
    wrong = fuzz("wrong", lambda: Brings(too_far), count, 3, tmp_path, on_progress=lambda *said: seen.append(said))
    assert sound.contacts == wrong.contacts == count == len(seen)
    assert "silent bounded" not in sound.broken
    assert wrong.broken["silent bounded"] > 5
    file = next(f for f in wrong.files if json.loads(Path(f).read_text())["found"]["broken"][0]["law"] == "bounded")
    assert again(file, lambda name: lambda: Brings(too_far)).outcome == "silent"
    assert "bounded" not in {b.law for b in again(file, lambda name: Winkler).broken}


def test_the_fuzz_tells_a_crash_from_a_refusal():
    def crashes(answer, contacts, layer):
        return {}[layer]

    found = fuzz("crashing", lambda: Brings(crashes), 40, 3)
    assert found.outcomes["crashed"] > 10 and found.outcomes.get("refused", 0) < 40


def test_random_skins_span_sizes_and_materials():
    meshes = [random_mesh(np.random.default_rng(seed)) for seed in range(60)]
    sizes = np.log10([np.ptp(mesh.vertices, axis=0).max() for mesh in meshes])
    moduli = np.log10([mesh.tissue.youngs_modulus for mesh in meshes])
    assert np.ptp(sizes) > 4 and np.ptp(moduli) > 8
    assert len({len(mesh.vertices) for mesh in meshes}) > 20


def test_tools_of_the_thinnest_skins_are_tools():
    rng = np.random.default_rng([0, 0])
    mesh = random_mesh(rng)
    assert mesh.thickness.max() < 1e-5
    assert all(np.ptp(random_tool(rng, mesh, "tool").vertices, axis=0).min() >= 2e-4 for _ in range(20))


def test_the_verb_fuzzes(tmp_path, capsys):
    from stmpl_ros.cli import main

    with pytest.raises(SystemExit) as ended:
        main(["stability", "--fuzz", "20", "--seed", "3", "--methods", "zero", "--out", str(tmp_path), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["zero"]["contacts"] == 20
    assert bool(ended.value.code) == any(told["zero"]["outcomes"].get(bad, 0) for bad in ("silent", "crashed"))


def test_the_verb_fuzzes_a_method_of_ones_own_wherever_its_file_is(tmp_path, capsys):
    from stmpl_ros.cli import main

    yours, out = tmp_path / "yours.py", tmp_path / "out"
    yours.write_text("from stmpl_core.methods import Winkler\n\n\nclass Own(Winkler):\n    name = 'own'\n")
    with pytest.raises(SystemExit):
        main(["stability", "--fuzz", "3", "--seed", "3", "--methods", str(yours), "--out", str(out), "--json"])
    assert json.loads((out / "yours" / "fuzz.json").read_text())["contacts"] == 3
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["stability", "--fuzz", "-3"])
    assert ended.value.code == 1 and "--fuzz is -3" in capsys.readouterr().err


def test_what_is_flagged_hides_nothing_that_is_not():
    """Of two answers that break a law the one that is not flagged counts."""

    def spoilt(answer, contacts, layer):
        light = contacts[0].pose_body_from_tool[0, 3] > 0.0508
        return (unsure if light else nothing)(stronger(answer, 1 + (layer.thickness[0] < 5e-3)), contacts, layer)

    (row,) = stability({"spoilt": lambda: Brings(spoilt)}, some("scale of contact")).rows
    assert row.outcome == "silent" and next(one.law for one in row.broken) == "similar"


def test_the_report_names_contacts(tmp_path):
    report: Report = stability({"sound": lambda: Brings(nothing)}, some("depth", "first touch"), tmp_path)
    assert report.axes == ["depth", "first touch"]


def test_where_the_linear_problem_has_no_solution_forces_and_motion_are_numbers() -> None:
    """A large tool in a small limb, by 344 nodes whose response is not positive: forces grew to 1e30 N."""
    rng = np.random.default_rng([330, 1000])
    mesh = random_mesh(rng)
    tools = [random_tool(rng, mesh, f"tool {k}") for k in range(TOOLS)]
    trial = [random_trial(rng, mesh, tools) for _ in range(431)][-1]
    simulator = Simulator(mesh.layer, MomentNet())
    (instant,) = trial.scene.instants
    answer = simulator.step([Contact(*placed) for placed in instant])
    assert [touch.status for touch in answer.touches.values()] == ["inside the core", "pulling"]
    assert np.isfinite(answer.displacement).all() and not answer.trust.in_range
    unit = mesh.tissue.youngs_modulus * mesh.thickness.max() ** 2
    assert 0 < answer.touches[instant[0].tool.name].force < 1e6 * unit
