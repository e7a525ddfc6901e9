"""Ladder: takes the cheapest method that is good and fast enough, says so, and is honest where none is."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest

from fem_tools import PatchFem, WarmPatchFem
from fem_tools.few_steps import FewSteps
from fem_tools.ladder import default_rungs, ladder, measured, times_file
from fem_tools.sampling import BodyPlan
from stmpl_core.errors import InvalidInput, NotPrepared
from stmpl_core.load import Load
from stmpl_core.methods import Linear, MomentNet, Winkler
from stmpl_core.methods.coarse import Coarse
from stmpl_core.methods.ladder import SHIPPED, Known, Ladder, Measured, SceneFigures, SceneReader
from stmpl_core.tissue import Tissue
from stmpl_core.trust import Displacement, Trust
from studies.calibrate import MARGIN, Trial, coverage, fit, gather
from tests.scenes import dented, limb
from tests.scenes import disc as scenes_disc

WIDE = {"strain": [1e-4, 1.0], "nu": [0.0, 0.5], "width": [0.01, 10.0], "slope": [0.0, 1.0],
        "outline": [0.001, 100.0], "jump": [0.0, 1.0]}


@pytest.fixture(scope="module")
def layer():
    return limb(5e-3)


def disc(layer, ratio=0.5, radius=0.014):
    """A smooth disc in the middle of the limb."""
    middle = layer.vertices[np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin()]
    away = np.linalg.norm(layer.vertices - middle, axis=1) / radius
    return Load.pressure(ratio * layer.tissue.youngs_modulus * np.clip(2 - 2 * away, 0, 1))


class Rung:
    """Answers after a while, with what it is told to say of itself."""

    def __init__(self, name: str, *, seconds: float = 0.0, ok: bool = True) -> None:
        self.name, self.seconds, self.ok, self.asked = name, seconds, ok, 0

    def prepare(self, layer):
        self.layer = layer
        return self

    def solve(self, load: Load) -> Displacement:
        self.asked += 1
        time.sleep(self.seconds)
        return Displacement(np.ones_like(self.layer.vertices), Trust(in_range=self.ok), self.name)


def known(share: float, seconds: float) -> Known:
    """Off by this share of the columns' motion, after so many seconds."""
    return Known({"pressure": [float(np.log(share)), *[0.0] * 9]}, {"pressure": 1.0}, [seconds, *[0.0] * 4], 1.0)


def three(layer, accuracy, deadline=None, *, ok=(True, True, True), seconds=(1e-4, 1e-3, 1e-2), took=(0.0, 0.0, 0.0)):
    rungs = [Rung(name, ok=good, seconds=s) for name, good, s in zip("abc", ok, took, strict=True)]
    shares = {"a": 0.3, "b": 0.03, "c": 0.003}
    chart = Measured({n: known(shares[n], s) for n, s in zip("abc", seconds, strict=True)}, {"pressure": WIDE})
    return Ladder(rungs, chart, accuracy=accuracy, deadline=deadline).prepare(layer), rungs


def unit(layer, load):
    reader = SceneReader(layer)
    scene = reader.figures(load)
    assert scene is not None
    return reader.unit(scene)


@pytest.mark.parametrize(("share", "named"), [(0.5, "a"), (0.05, "b"), (0.005, "c")])
def test_the_cheapest_that_is_accurate_enough_answers_and_is_named_with_its_bound(layer, share, named):
    load = disc(layer)
    method, _ = three(layer, share * unit(layer, load))
    answer = method.solve(load)
    assert answer.method == named and answer.trust.ok
    assert answer.trust.error_bound is not None and answer.trust.error_bound <= method.accuracy
    assert answer.trust.why.startswith("chosen for")


def test_a_deadline_takes_the_most_accurate_that_is_fast_enough_and_flags_what_misses_the_wish(layer):
    load = disc(layer)
    method, _ = three(layer, 0.005 * unit(layer, load), deadline=5.0, seconds=(0.1, 1, 10))
    answer = method.solve(load)
    assert answer.method == "b" and not answer.trust.in_range
    assert "nothing meets the wish" in answer.trust.why


def test_where_nothing_is_fast_enough_the_fastest_answers_and_is_flagged(layer):
    load = disc(layer)
    method, _ = three(layer, 1.0, deadline=1e-5)
    answer = method.solve(load)
    assert answer.method == "a" and not answer.trust.in_range and "fast enough" in answer.trust.why


def test_an_answer_that_is_not_to_be_believed_is_handed_to_the_next_better_method(layer):
    load = disc(layer)
    method, rungs = three(layer, 0.5 * unit(layer, load), ok=(False, True, True))
    answer = method.solve(load)
    assert answer.method != "a" and answer.trust.ok and rungs[0].asked == 1
    assert answer.trust.figures["tries"] == 2


def test_an_answer_that_turns_out_worse_than_wished_is_handed_on_once(layer):
    class States(Rung):
        def solve(self, load):
            answer = super().solve(load)
            return Displacement(answer.displacement, replace(answer.trust, error_bound=1.0), self.name)  # 1 m

    load = disc(layer)
    one = replace(known(0.3, 1e-4), after={"pressure": [*[0.0] * 10, 1.0]}, after_factor={"pressure": 1.0})
    rungs = [States("a"), Rung("b")]
    chart = Measured({"a": one, "b": known(0.03, 1e-3)}, {"pressure": WIDE})
    answer = Ladder(rungs, chart, accuracy=0.5 * unit(layer, load)).prepare(layer).solve(load)
    assert answer.method == "b" and answer.trust.ok and rungs[0].asked == rungs[1].asked == 1
    alone = Ladder(rungs[:1], chart, accuracy=0.5 * unit(layer, load)).prepare(layer).solve(load)
    assert alone.method == "a" and not alone.trust.in_range and alone.trust.error_bound == pytest.approx(1.0)


def test_where_no_method_believes_itself_the_best_guess_comes_flagged_and_without_a_bound(layer):
    method, rungs = three(layer, 0.1, ok=(False, False, False))
    answer = method.solve(disc(layer))
    assert answer.method == "c" and not answer.trust.in_range and answer.trust.error_bound is None
    assert all(rung.asked == 1 for rung in rungs)


def test_no_time_is_left_for_a_second_try(layer):
    method, rungs = three(layer, 0.1, deadline=5e-3, ok=(False, True, True), took=(6e-3, 0.0, 0.0))
    answer = method.solve(disc(layer))
    assert answer.method == "a" and not answer.trust.in_range and rungs[1].asked == 0


def test_a_busy_machine_is_noticed(layer):
    load = disc(layer)
    method, _ = three(layer, 0.05 * unit(layer, load), deadline=2e-2, seconds=(1e-4, 1e-3, 1.0), took=(0.0, 0.1, 0.0))
    named = [method.solve(load).method for _ in range(4)]
    assert named[0] == "b" and named[-1] == "a"


def outside(layer, ok=(True, True, True), deadline=None, seconds=(1e-4, 1e-3, 1e-2), took=(0.0, 0.0, 0.0)):
    """Three rungs whose chart ends at 1 % of strain, and has their errors upside down."""
    rungs = [Rung(name, ok=good, seconds=s) for name, good, s in zip("abc", ok, took, strict=True)]
    methods = {n: known(e, s) for n, e, s in zip("abc", (1e-4, 1e-3, 1e-2), seconds, strict=True)}
    chart = Measured(methods, {"pressure": {**WIDE, "strain": [1e-4, 0.01]}})
    return Ladder(rungs, chart, accuracy=1.0, deadline=deadline).prepare(layer), rungs


def test_outside_of_what_was_measured_the_most_accurate_answers_flagged_and_without_a_bound(layer):
    method, rungs = outside(layer)
    answer = method.solve(disc(layer, 1.0))
    assert answer.method == "c" and [rung.asked for rung in rungs] == [0, 0, 1]
    assert not answer.trust.in_range and answer.trust.error_bound is None and "strain" in answer.trust.why
    within = outside(layer)[0].solve(disc(layer, 0.003))
    assert within.method == "a" and within.trust.ok


def test_outside_of_what_was_measured_time_and_the_methods_own_ranges_decide(layer):
    load = disc(layer, 1.0)
    assert outside(layer, deadline=5.0, seconds=(0.1, 1, 10))[0].solve(load).method == "b"
    assert outside(layer, deadline=5e-5)[0].solve(load).method == "a"
    assert outside(layer, ok=(True, True, False))[0].solve(load).method == "b"
    assert outside(layer, ok=(False, False, False))[0].solve(load).method == "c"
    late, rungs = outside(layer, ok=(True, True, False), deadline=3e-2, took=(0.0, 0.0, 4e-2))
    assert late.solve(load).method == "c" and rungs[1].asked == 0, "no time is left to ask another"


def test_no_load_moves_nothing(layer):
    answer = three(layer, 1e-4)[0].solve(Load.zero(layer))
    assert not answer.displacement.any() and answer.trust.ok and answer.trust.error_bound == 0


@pytest.mark.parametrize("wish", [{"accuracy": 0.0}, {"accuracy": float("nan")}, {"deadline": -1.0}])
def test_wishes_that_are_none_are_refused(wish):
    with pytest.raises(InvalidInput, match="positive"):
        Ladder([Rung("a")], Measured({"a": known(1, 1)}, {}), **wish)


def test_methods_that_were_not_measured_and_kinds_of_load_that_were_not_are_refused(layer):
    with pytest.raises(InvalidInput, match="none of the methods"):
        Ladder([Rung("new")], Measured({"a": known(1, 1)}, {}))
    method, _ = three(layer, 1e-4)
    with pytest.raises(InvalidInput, match="'nodal'"):
        method.solve(Load.nodal(np.ones(len(layer.vertices))))
    with pytest.raises(NotPrepared):
        Ladder([Rung("a")], Measured({"a": known(1, 1)}, {})).solve(disc(layer))


def test_a_method_that_refuses_the_layer_is_left_out(layer):
    class Refuses(Rung):
        def prepare(self, layer):
            raise InvalidInput("not this one")

    chart = Measured({n: known(0.1, 1e-3) for n in "ab"}, {"pressure": WIDE})
    method = Ladder([Refuses("a"), Rung("b"), Rung("new")], chart).prepare(layer)
    answer = method.solve(disc(layer))
    assert answer.method == "b" and "without new and a" in answer.trust.why
    assert "not this one" in method.left_out["a"] and "chart" in method.left_out["new"]
    assert "without" not in Ladder([Rung("b")], chart).prepare(layer).solve(disc(layer)).trust.why
    with pytest.raises(InvalidInput, match="not this one"):
        Ladder([Refuses("a")], chart).prepare(layer)


def test_a_method_that_refuses_a_load_is_passed_over_and_said(layer):
    class Refuses(Rung):
        def solve(self, load):
            raise InvalidInput("not that one")

    load = disc(layer)
    chart = Measured({n: known(share, 1e-3) for n, share in zip("abc", (0.3, 0.03, 0.003), strict=True)},
                     {"pressure": WIDE})  # fmt: skip
    rungs = [Rung("a"), Refuses("b"), Rung("c")]
    answer = Ladder(rungs, chart, accuracy=0.05 * unit(layer, load)).prepare(layer).solve(load)
    assert answer.method == "c" and "without b" in answer.trust.why and answer.trust.ok
    with pytest.raises(InvalidInput, match="not that one"):
        Ladder([Refuses("b")], chart).prepare(layer).solve(load)


def test_a_fold_far_away_leaves_the_ladder_its_finite_elements_and_one_near_takes_them():
    layer = dented()
    middle = layer.vertices[len(layer.vertices) // 2]
    far = layer.vertices[np.linalg.norm(layer.vertices - middle - [0, 0, 0.06], axis=1).argmin()]
    method = ladder(accuracy=1e-6).prepare(layer)
    away, near = (method.solve(scenes_disc(layer, 0.3, at, 0.01)) for at in (far, middle))
    assert not method.left_out and "fem" in away.method and "without" not in away.trust.why
    assert "fem" not in near.method and "without" in near.trust.why and "patch_fem" in near.trust.why


def test_a_chart_is_kept_and_takes_over_the_times_of_another_machine(tmp_path):
    chart = Measured({"a": known(0.1, 1e-3)}, {"pressure": WIDE}, {"machine": "one"})
    chart.save(tmp_path / "chart.json")
    assert Measured.load(tmp_path / "chart.json") == chart
    other = Measured({"a": known(0.9, 5e-3), "z": known(1, 1)}, {}, {"machine": "two"})
    mixed = chart.timed_by(other)
    assert mixed.methods["a"].seconds == other.methods["a"].seconds
    assert mixed.methods["a"].error == chart.methods["a"].error
    assert set(mixed.methods) == {"a"} and mixed.about["times"]["machine"] == "two"
    older = Measured({"a": replace(known(0.9, 5e-3), seconds=[5e-3, 0.0])}, {})
    assert chart.timed_by(older).methods["a"].seconds == chart.methods["a"].seconds, "times in other terms are not used"
    (tmp_path / "broken.json").write_text('{"methods": 3}')
    for file in ("broken.json", "none.json"):
        with pytest.raises(InvalidInput, match="stmpl calibrate"):
            Measured.load(tmp_path / file)


def test_figures_of_a_disc_are_what_they_are_called(layer):
    scene = SceneReader(layer).figures(disc(layer, 0.3, radius=0.02))
    assert scene is not None
    assert scene.ratio == pytest.approx(0.3) and scene.nu == 0.4 and scene.slope < 1e-12
    assert 2 * 7.5e-3 / 0.02 < scene.outline < 2 * 7.5e-3 / 0.012, "its pressure falls between 10 and 20 mm"
    assert 0.2 < scene.jump < 0.6
    assert scene.width == pytest.approx(layer.edge_length / 7.5e-3, rel=1e-6) and scene.moved > scene.pressed


# What it climbs


def test_one_newton_step_leaves_a_part_of_the_networks_error_and_three_next_to_nothing(layer):
    load = disc(layer, 0.6)
    truth = PatchFem(reach=5, check_stability=False).prepare(layer).solve(load)

    def off(method):
        answer = method.prepare(layer).solve(load)
        return float(np.linalg.norm(answer.displacement - truth.displacement, axis=1).max()), answer

    network, one, three = off(MomentNet())[0], off(FewSteps.from_network(1))[0], off(FewSteps.from_network(3))
    assert one < 0.6 * network and three[0] < 0.02 * network and three[1].trust.converged


def test_too_few_steps_are_told_of(layer):
    answer = FewSteps(1, Winkler()).prepare(layer).solve(disc(layer, 1.9))
    assert not answer.trust.converged and "balance" in answer.trust.why
    absurd = disc(layer, 20.0)
    lost = FewSteps.from_network(1).prepare(layer).solve(absurd)
    network = MomentNet().prepare(layer).solve(absurd)
    assert not lost.trust.ok and np.array_equal(lost.displacement, network.displacement), "no worse than its start"
    with pytest.raises(InvalidInput, match="at least 1"):
        FewSteps(0, Winkler())


def test_a_load_at_the_open_border_is_told_of_by_few_steps_as_by_many(layer):
    at = layer.vertices[layer.border[0]]
    near = Load.pressure(300 * (np.linalg.norm(layer.vertices - at, axis=1) < 0.014))
    for method in (FewSteps(3, Winkler()), PatchFem()):
        trust = method.prepare(layer).solve(near).trust
        assert not trust.in_range and "border" in trust.why and trust.error_bound is None


def test_a_coarse_mesh_gets_the_same_force_and_answers_nearly_as_well(layer):
    load, asked = disc(layer, 0.1, radius=0.025), []

    class Spy(Linear):
        def solve(self, load):
            asked.append(load)
            return super().solve(load)

    coarse = Coarse(Spy(), 1.5).prepare(layer)
    answer, fine = coarse.solve(load), Linear().prepare(layer).solve(load)
    assert asked[0].values @ coarse.coarse.vertex_areas == pytest.approx(load.values @ layer.vertex_areas, rel=0.01)
    off = np.linalg.norm(answer.displacement - fine.displacement, axis=1)
    assert 0 < off.max() < 0.2 * fine.magnitude.max() and answer.trust.error_bound is None
    assert not coarse.solve(Load.zero(layer)).displacement.any()
    with pytest.raises(InvalidInput, match="coarsening"):
        Coarse(Linear(), 1.0)


# What it was measured with


def made_up(spread: float, seed: int = 0) -> list[Trial]:
    rng, out = np.random.default_rng(seed), []
    for k in range(600):
        scene = SceneFigures(
            float(np.exp(rng.uniform(-4, -0.5))), 0.4,
            float(rng.uniform(0.3, 0.9)), 0.0, float(np.exp(rng.uniform(-1, 1))), 0.3,
            0.5, float(rng.integers(20, 800)),
            float(rng.integers(900, 4000)),
        )  # fmt: skip
        error = 0.2 * scene.strain**0.7 * scene.outline**0.5 * float(np.exp(spread * rng.normal()))
        seconds = (1e-3 + 2e-9 * scene.pressed * scene.moved) * float(np.exp(0.05 * rng.normal()))
        use = "fit" if k % 2 else "test"
        out.append(Trial(f"body {k % 5}", use, "disc", "pressure", "m", scene, 1e-3, 1e-3 * error, 2e-3, 0.0, seconds,
                         True, float("nan")))  # fmt: skip
    return out


def test_the_fit_finds_the_law_and_its_bounds_hold_as_often_as_they_say():
    trials = made_up(0.3)
    chart = fit(trials)
    (row,) = coverage(trials, chart)
    assert 0.9 < row.covered < 0.99 and row.tight < 2.2
    scene = trials[0].scene
    seconds = float(scene.for_time() @ np.array(chart.methods["m"].seconds))
    assert seconds == pytest.approx(1e-3 + 2e-9 * scene.pressed * scene.moved, rel=0.1)
    assert 1.0 < chart.methods["m"].slow < 1.3
    exact = fit(made_up(0.0))
    assert exact.methods["m"].factor["pressure"] == pytest.approx(MARGIN, abs=0.1)


@pytest.mark.slow
def test_the_shipped_bounds_hold_on_a_limb_and_shapes_that_were_not_fitted_and_are_not_loose(tmp_path, monkeypatch):
    monkeypatch.setenv("STMPL_CACHE_DIR", str(tmp_path))
    limb = BodyPlan(name="unseen", weight=0.6, thickness=6.5e-3, edge_length=4.5e-3, part="right_forearm")
    trials = gather(tmp_path / "trials", bodies=[limb], scenes={"fit": 0, "test": 2, "shapes": 2}, seed=7)
    rows = coverage(trials, measured())
    answers = sum(row.answers for row in rows)
    assert answers > 60 and {row.use for row in rows} == {"test", "shapes"}
    assert sum(row.covered * row.answers for row in rows) / answers > 0.95
    assert np.median(np.repeat([row.tight for row in rows], [row.answers for row in rows])) < 3
    assert gather(tmp_path / "trials", bodies=[limb], seed=7) == trials, "what was measured is not measured again"


def test_the_shipped_chart_knows_every_default_method_and_its_bounds_hold(layer, tmp_path, monkeypatch):
    monkeypatch.setenv("STMPL_CACHE_DIR", str(tmp_path))
    chart = Measured.load(SHIPPED)
    assert {rung.name for rung in default_rungs()} == set(chart.methods)
    other = layer.with_(tissue=Tissue(5e3, 0.35))
    for one in (layer, other):
        load = disc(one, 0.4, radius=0.02)
        truth = PatchFem(refine=1, layers=2, check_stability=False).prepare(one).solve(load)
        named = []
        for accuracy in (1e-2, 2e-4, 1e-5):
            answer = ladder(accuracy=accuracy).prepare(one).solve(load)
            off = float(np.linalg.norm(answer.displacement - truth.displacement, axis=1).max())
            assert answer.trust.error_bound is not None and answer.trust.error_bound >= off
            named.append(answer.method)
        assert named[0] == "moment_net, 1.5 x coarser" and "fem" in named[-1]
    slow = {n: replace(k, seconds=[9.0, 0.0, 0.0, 0.0, 0.0]) for n, k in chart.methods.items() if n != "winkler"}
    Measured({**slow, "winkler": chart.methods["winkler"]}, chart.ranges).save(times_file())
    answer = ladder(accuracy=1e-6, deadline=0.1).prepare(layer).solve(disc(layer))
    assert answer.method == "winkler", "this machine's times count"
    assert json.loads(times_file().read_text())["methods"]


def test_a_load_near_the_last_one_is_given_to_finite_elements_that_start_from_it(layer):
    rungs = default_rungs(warm=True)
    shares, warm = [], rungs[-1]
    assert isinstance(warm, WarmPatchFem)
    method = Ladder(rungs, measured(), accuracy=1e-6).prepare(layer)
    cold = PatchFem(reach=4.75, check_stability=False).prepare(layer)
    for ratio in (0.5, 0.52, 0.54, 1.2):
        load = disc(layer, ratio)
        shares.append(warm.share_of_time(load))
        answer, true = method.solve(load), cold.solve(load)
        off = np.linalg.norm(answer.displacement - true.displacement, axis=1).max()
        assert answer.method == "warm_patch_fem" and off < 0.01 * true.magnitude.max()
    assert shares[0] == shares[3] == 1.0 and shares[1] == shares[2] < 0.5


def test_under_a_deadline_finite_elements_are_taken_where_they_are_warm(layer):
    rungs, load = default_rungs(warm=True)[-1:], disc(layer)
    fast, rough = rungs[0], Rung("a")
    chart = Measured({"patch_fem": known(0.003, 1.0), "a": known(0.3, 1e-4)}, {"pressure": WIDE})
    method = Ladder([rough, fast], chart, accuracy=0.01 * unit(layer, load), deadline=0.5).prepare(layer)
    assert method.solve(load).method == "a"
    fast.solve(load)
    assert method.solve(load).method == "warm_patch_fem"
