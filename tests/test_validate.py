"""Laws of the judgement by published measurements: what meets, what a spread does, and what a stiffer tissue does."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from stmpl_core import Contact, Membrane, Ply, Prony, Simulator, State, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Winkler
from stmpl_core.regions import Quantity, region
from stmpl_core.relaxation import Series
from stmpl_core.stack import along, compliance
from stmpl_ros.cli import main
from studies.validate import ROWS, as_dict, fading, judge, markdown, met, said
from studies.validate.closed import disc_stiffness
from studies.validate.judge import inputs_of, judge_row, surrogate
from tests.scenes import at, ball, plate

WAYS = ("pressed in", "pulled along")
PRESSED = next(row for row in ROWS if row.name == "forearm, small indenter")
LIMB = region("forearm")


@pytest.fixture(scope="module")
def quick():
    return judge(quick=True)


@pytest.mark.parametrize(("way", "known"), [("pressed in", 2 / (1 - 0.3**2)), ("pulled along", 8 / (2.6 * 1.7))])
def test_a_disc_on_a_half_space_is_as_stiff_as_the_closed_form_says(way, known):
    """Johnson, "Contact Mechanics", 1985: 2 E a / (1 - nu^2) pressed in, 8 G a / (2 - nu) pulled along."""
    assert disc_stiffness(Tissue(1e4, 0.3), 1.0, 1e-3, way) == pytest.approx(known * 1e4 * 1e-3, rel=2e-3)


def test_what_a_stack_does_along_the_wave_is_what_compliance_inverts():
    """Maxwell and Betti: both are columns of one symmetric inverse; on a half-space they are as Johnson says."""
    k, tissue = np.array([0.3, 1.0, 5.0]), Tissue(3e3, 0.4, skin=Membrane(1e5, 1e-3, 10.0), deeper=(Ply(5e-3, 1e4),))
    both, pressed = along(tissue, 0.02, k), compliance(tissue, 0.02, k)
    assert (both.lengthwise * pressed.sinking > pressed.along**2).all()  # the inverse is positive definite
    deep = along(Tissue(1e3, 0.3), 1.0, np.array([50.0]))
    assert deep.lengthwise[0] == pytest.approx(2 * (1 - 0.3**2) / 50) and deep.crosswise[0] == pytest.approx(2.6 / 50)
    with pytest.raises(InvalidInput, match="wave number"):
        along(tissue, 0.02, [0.0])


def test_a_sheared_layer_is_as_stiff_as_its_column():
    """Long waves: t / mu."""
    tissue = Tissue(1e3, 0.3, deeper=(Ply(4e-3, 5e3, 0.3),))
    expected = (4e-3 / 1e3 + 6e-3 / 5e3) * 2.6 * 1e3 / 10e-3
    assert along(tissue, 10e-3, 1e-3).crosswise[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("softer", ["skin", "fat", "muscle"])
def test_a_stiffer_tissue_raises_the_force(way, softer):
    tissue, (muscle,) = LIMB.tissue, LIMB.tissue.deeper
    assert tissue.skin is not None
    stiffer = {
        "skin": replace(tissue, skin=replace(tissue.skin, youngs_modulus=3e5)),
        "fat": replace(tissue, youngs_modulus=4e3),
        "muscle": replace(tissue, deeper=(replace(muscle, youngs_modulus=3e4),)),
    }[softer]
    assert disc_stiffness(stiffer, 0.025, 5e-3, way) > disc_stiffness(tissue, 0.025, 5e-3, way)


@pytest.mark.parametrize("way", WAYS)
def test_a_skin_that_bears_nothing_changes_nothing(way):
    bare = Tissue(3e3, 0.45)
    with_skin = replace(bare, skin=Membrane(100.0, 1e-7, 1e-9))
    assert disc_stiffness(with_skin, 0.02, 3e-3, way) == pytest.approx(disc_stiffness(bare, 0.02, 3e-3, way), rel=0.01)


def test_a_row_whose_interval_contains_the_models_meets():
    judged = judge_row(PRESSED)
    low, value, high = judged.model.low, judged.model.value, judged.model.high
    around = replace(PRESSED, measured=Quantity(value, 0.5 * low, 2 * high, "N", ""))
    assert judge_row(around).inside and judge_row(around).apart == 1
    above = replace(PRESSED, measured=Quantity(9.0, 3 * high, 10.0, "N", ""))
    assert not judge_row(above).inside and judge_row(above).apart == pytest.approx(3)


def test_the_spread_of_the_answer_grows_with_the_spread_of_an_input():
    radius = PRESSED.protocol.radius
    widths = []
    for share in (0.0, 0.2, 0.5):
        wide = replace(radius, low=radius.value * (1 - share), high=radius.value * (1 + share))
        model = judge_row(replace(PRESSED, protocol=replace(PRESSED.protocol, radius=wide))).model
        widths.append((math.log(model.high / model.value), math.log(model.value / model.low)))
    assert np.all(np.diff(widths, axis=0) > 0)


def test_without_spread_there_is_none_and_with_one_input_it_is_its_ends():
    inputs = inputs_of(PRESSED)
    exact = {name: replace(q, low=q.value, high=q.value) for name, q in inputs.items()}
    model = judge_row(PRESSED, exact).model
    assert model.low == model.value == model.high
    tension = inputs["skin_tension"]
    at_high = exact | {"skin_tension": replace(tension, value=tension.high)}
    model = judge_row(PRESSED, exact | {"skin_tension": tension}).model
    assert model.high == pytest.approx(surrogate(PRESSED, at_high))


def test_every_row_says_where_it_comes_from_and_why_it_may_fail(quick):
    assert len(ROWS) >= 10 and len({row.name for row in ROWS}) == len(ROWS)
    for row in ROWS:
        assert row.measured.source and row.protocol.radius.source and row.outside
        assert 0 < row.measured.low <= row.measured.value <= row.measured.high
    assert len(quick) == sum(not row.protocol.ball for row in ROWS)
    page = markdown(quick)
    assert all(one.row.name in page and said(one.model) in page for one in quick)


def test_which_rows_meet(quick):
    """As docs/credibility.md says: pressed lightly and slowly, the model meets people; pulled along and tapped, not."""
    assert {one.row.name for one in quick if one.inside and not one.row.fitted} == {
        "forearm, small indenter", "forearm, air jet, young", "leg, initial modulus", "arm, energy lost",
        "leg, share lost", "leg, time of fading"}  # fmt: skip


def test_a_row_that_a_parameter_was_fitted_on_is_shown_and_not_counted(quick):
    fitted = [one for one in quick if one.row.fitted]
    assert [one.verdict for one in fitted] == ["not judged: HELD_SKIN was fitted on it"]
    assert met(quick) == (6, len(quick) - 1) and as_dict(quick)["of"] == len(quick) - 1
    assert fitted[0].verdict in markdown(quick)


# Time

SERIES = Series(np.array([0.2, 0.3]), np.array([0.5, 8.0]))


def test_a_stay_loses_what_the_series_says_and_what_a_simulator_with_a_state_says():
    found = fading.lost_share(fading.cycles(SERIES, 0.0, 5.0, 1, slack=False))
    assert found == pytest.approx(float(SERIES.shares @ -np.expm1(-5.0 / SERIES.times)), rel=1e-9)
    tissue = Tissue(2e4, 0.4, relaxation=Prony(tuple(SERIES.shares), tuple(SERIES.times)))
    simulator, state, force = Simulator(plate(0.09).with_(tissue=tissue), Winkler()), State(), []
    for dt in (0.0, *[0.1] * 50):
        (touch,), state = simulator.touch([Contact(ball(8e-3), at(0, 0, 5e-3))], state, dt)
        force.append(touch.force)
    assert found == pytest.approx(1 - force[-1] / force[0], rel=1e-6)


def test_a_cycle_loses_nothing_when_it_is_sudden_or_endless_and_most_between():
    lost = [fading.lost_energy(fading.cycles(SERIES, lasts, 0.0, 1, slack=False)) for lasts in (1e-6, 2.0, 1e7)]
    assert abs(lost[0]) < 1e-5 and abs(lost[2]) < 1e-5 and lost[1] > 0.1


def test_slack_skin_gives_nothing_back_on_the_rest_of_its_way():
    tight, slack = (fading.cycles(SERIES, 1.0, 50.0, 2, slack=each) for each in (False, True))
    assert tight.force.min() < -0.1 and slack.force.min() == 0
    assert fading.last_peak(slack) < 1 and fading.lost_energy(slack) < fading.lost_energy(tight)


def test_the_time_of_fading_of_one_term_is_its_own():
    assert fading.fading_time(Series(np.array([0.3]), np.array([2.0]))) == pytest.approx(2.0, rel=1e-3)


def test_the_verb_writes_report_table_and_picture(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["validate", "--quick", "--json", "--out", str(tmp_path)])
    assert ended.value.code == 0
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads((tmp_path / "report.json").read_text()) and told["of"] == len(told["rows"]) - 1
    assert (tmp_path / "table.md").exists() and (tmp_path / "validate.png").stat().st_size > 1e4


@pytest.mark.slow
def test_finite_elements_press_a_ball_as_the_closed_form_says_at_a_small_depth():
    from fem_tools.patch import PatchFem
    from stmpl_core.stack import ball_force as closed
    from studies.validate.finite import ball_force

    tissue, t = replace(LIMB.tissue, skin=None), LIMB.thickness
    fine = PatchFem(element="P1xP2", reach=2, refine=3, layers=2, check_stability=False)
    assert ball_force(tissue, t, 0.02, 2e-3, fine) == pytest.approx(closed(tissue, t, 0.02, 2e-3), rel=0.15)
