"""Recorded runs: a replay repeats them bit for bit, and a comparison measures what was put in."""

from __future__ import annotations

import html
import json
from dataclasses import replace

import numpy as np
import pytest

from bags import records
from bags.compare import compare_bags, compare_run, headline, sample
from bags.provenance import LAYER, OTHER_PROCESSOR, layer_to_bytes, write_provenance
from bags.reader import Bag
from bags.replay import Replayed, replay_run
from bags.report import write_report
from bags.run import Run
from bags.survey import survey
from bags.whole import differences
from bags.writer import BagWriter, qos_yaml
from stmpl_core.errors import BagError, InvalidInput
from stmpl_core.layer import layer_id
from stmpl_core.methods import Winkler
from stmpl_core.provenance import processor
from stmpl_core.touch import Answer
from stmpl_core.trust import Displacement, Trust
from stmpl_ros.view.recording import Recording
from tests import bag_scene
from tests.bag_scene import START, cdr, header, stmpl, tube, write_run

LOST, SKIPPED, DELAY = (5, 6, 20), (10, 11), 0.003


class Stiffer:
    """Winkler's answer times a factor: a method with a known error."""

    name = "stiffer"

    def __init__(self, factor: float, converged: bool = True) -> None:
        self.factor, self.converged, self._winkler = factor, converged, Winkler()

    def prepare(self, layer):
        """Prepares Winkler."""
        self._winkler.prepare(layer)
        return self

    def solve(self, load):
        """Winkler's displacement, scaled."""
        answer = self._winkler.solve(load)
        return Displacement(self.factor * answer.displacement, Trust(converged=self.converged), self.name)


class Refusing(Stiffer):
    """A method that solves nothing."""

    def solve(self, load):
        """Raises what a method may raise."""
        raise InvalidInput(f"a load of {load.values.max():.3g} is refused")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "bag"
    return write_run(folder, Winkler(), frames=24, lose=LOST, skip=SKIPPED, delay=DELAY)


def test_a_replay_repeats_the_run_bit_for_bit(run):
    replayed = replay_run(run, Winkler())
    assert replayed.frames == replayed.identical == 24 - len(LOST) - len(SKIPPED)
    assert "every one bit for bit" in str(replayed)


def test_poses_in_a_frame_that_moves_are_replayed_where_tf_was_recorded_around_their_stamps(tmp_path, capsys):
    last = START + 240 * 10**6
    whole = write_run(tmp_path / "whole", Winkler(), frames=24, frame="base", tf=(START - 10**7, last + 10**8))
    replayed = replay_run(whole, Winkler())
    assert replayed.frames == 24 and replayed.worst < 1e-10 and replayed.passed
    assert "/tf placed its poses ('base')" in str(replayed)
    comparison = compare_run(whole, Winkler(), method=Winkler(), frames=4)
    assert not comparison.failed and comparison.worst_under_contact < 1e-9
    code, said = stmpl(capsys, "replay", write_run(tmp_path / "part", Winkler(), frames=24, frame="base",
                                                   tf=(START, START + 10**8)))  # fmt: skip
    assert code == 1 and "/tf does not say where 'base' was at" in said
    assert f"'base' was told from {START * 1e-9:.3f} to {START * 1e-9 + 0.099:.3f} s" in said


def test_poses_in_a_frame_that_the_recording_carries_are_replayed_and_of_an_unknown_one_refused(tmp_path, capsys):
    told = write_run(tmp_path / "told", Winkler(), frames=6, frame="base")
    assert replay_run(told, Winkler()).identical == 6
    by_tf = write_run(tmp_path / "by_tf", Winkler(), frames=6, frame="base", table=False)
    code, said = stmpl(capsys, "replay", by_tf)
    assert code == 1
    assert "cannot be repeated offline: /tf does not say where 'base' was at" in said
    assert "nothing joins it to 'body'" in said
    assert "stmpl replay --publish" in said and "Traceback" not in said
    comparison = compare_run(by_tf, Winkler(), method=Winkler(), frames=2)
    assert not comparison.judged and all("'base'" in why for why in comparison.failed.values())
    assert len(Recording.of(by_tf, frames=6).snapshots) == 6, "what was answered is shown all the same"


def test_an_answer_is_replayed_with_the_surface_that_its_tool_had(tmp_path):
    changed = Run(write_run(tmp_path / "changed", Winkler(), frames=24, grow=12))
    replayed = replay_run(changed, Winkler())
    assert replayed.passed and replayed.identical == replayed.frames == 24
    first, last = (changed.contacts(frame)[0].tool for frame in (next(changed.frames([2])), next(changed.frames([20]))))
    assert np.ptp(last.vertices) == pytest.approx(1.3 * np.ptp(first.vertices), rel=1e-6)
    assert changed.tools["ball"] is last


def test_answers_to_what_was_not_recorded_are_left_out_of_a_replay_and_told(tmp_path, capsys):
    late = write_run(tmp_path / "late", Winkler(), frames=12, unheard=(0, 1, 2))
    replayed = replay_run(late, Winkler())
    assert (replayed.frames, replayed.identical, replayed.left_out, replayed.passed) == (9, 9, 3, True)
    code, said = stmpl(capsys, "replay", late, "--method", "winkler")
    assert code == 0 and "3 more were left out: an answer to tool ball" in said and "no pose and no wrench" in said
    torn = replay_run(write_run(tmp_path / "torn", Winkler(), frames=12, unheard=(5,)), Winkler())
    assert (torn.frames, torn.left_out, torn.passed, torn.first_difference) == (11, 1, False, None)
    nothing = write_run(tmp_path / "nothing", Winkler(), frames=6, unheard=tuple(range(6)))
    with pytest.raises(BagError, match="no pose and no wrench"):
        replay_run(nothing, Winkler())
    compared = compare_run(late, Winkler(), method=Winkler(), frames=100, tolerance=0.0)
    assert compared.passed and len(compared.pairs) == 9 and "The first 3 answers were left out" in compared.verdict
    same = compare_bags(late, late, frames=100)
    assert same.passed and len(same.pairs) == 9 and same.left_out == 3
    torn = compare_run(tmp_path / "torn", Winkler(), method=Winkler(), frames=100)
    assert len(torn.failed) == 1 and not torn.passed and not torn.left_out, "one in the middle fails"
    with pytest.raises(InvalidInput, match="frames is 0"):
        compare_run(late, Winkler(), method=Winkler(), frames=0)


def test_a_recording_names_the_processor_and_another_one_may_differ_in_the_last_bit(run, monkeypatch):
    assert Bag(run).provenance.processor == processor() and replay_run(run, Winkler()).tolerance == 0
    nearly = replay_run(run, Stiffer(1 + 1e-6))
    assert nearly.identical < nearly.frames and 0 < nearly.worst < OTHER_PROCESSOR and not nearly.passed
    assert "held to every bit, since the same processor recorded it; number" in str(nearly)
    assert replay_run(run, Stiffer(1 + 1e-6), tolerance=OTHER_PROCESSOR).passed

    recorded = processor()
    monkeypatch.setattr("stmpl_core.provenance.processor", lambda: "another make")
    nearly, off = replay_run(run, Stiffer(1 + 1e-6)), replay_run(run, Stiffer(1.25))
    assert nearly.passed and nearly.identical < nearly.frames and nearly.tolerance == OTHER_PROCESSOR
    assert str(nearly).endswith(f"held to 0.0001 mm, since another processor ({recorded}) recorded it.")
    assert f"number {off.first_difference} is the first past it. Changed since: processor" in str(off)
    assert not off.passed
    assert not replay_run(run, Stiffer(1 + 1e-6), tolerance=0.0).passed


def test_an_answer_that_is_no_number_passes_no_tolerance(run):
    frame = next(Bag(run).frames())
    replayed = Replayed(frame, Answer(np.full(frame.displacement.shape, np.nan), Trust(), "none"))
    assert not replayed.identical and replayed.difference == float("inf")


def test_two_recordings_of_one_method_are_held_to_what_their_processors_allow(run, tmp_path, monkeypatch):
    same = compare_bags(run, run)
    assert same.tolerance == 0 and same.passed and "the same processor recorded it" in same.verdict
    monkeypatch.setattr("stmpl_core.provenance.processor", lambda: "another make")
    elsewhere = write_run(tmp_path / "elsewhere", Winkler(), frames=24)
    assert compare_bags(run, elsewhere).tolerance == OTHER_PROCESSOR and compare_bags(run, elsewhere).passed
    assert "another processor (another make) recorded it" in compare_bags(run, elsewhere).verdict
    stiffer = write_run(tmp_path / "stiffer", Stiffer(1.25), frames=24)
    assert compare_bags(run, stiffer).tolerance is None and compare_bags(run, stiffer).passed


def test_a_replay_by_another_method_says_where_it_differs(run):
    replayed = replay_run(run, Stiffer(0.9))
    assert 0 < replayed.identical < replayed.frames  # the first frame is at rest
    peak = max(frame.peak for frame in Bag(run).frames())
    assert 1e-3 * peak < replayed.worst < 0.5 * peak, "both lie on the tool: what is left is around it"
    assert "differ" in str(replayed)


def test_a_run_compared_with_itself_has_zero_error(run):
    comparison = compare_bags(run, run)
    assert comparison.worst_under_contact == 0 and comparison.passed
    assert all(pair.score.mee == 0 and pair.score.peak_error == 0 for pair in comparison.pairs)
    same = compare_run(run, Winkler(), method=Winkler(), tolerance=0.0)
    assert same.passed and same.worst_under_contact == 0


def test_frames_are_judged_by_several_processes_as_by_one(run):
    alone, together = (compare_run(run, Stiffer(1.25), frames=5, workers=workers) for workers in (1, 2))
    assert len(alone.pairs) == len(together.pairs) == 5
    for one, other in zip(alone.pairs, together.pairs, strict=True):
        assert one.number == other.number
        np.testing.assert_array_equal(one.reference.displacement, other.reference.displacement)
    refused = [compare_run(run, Refusing(1.0), frames=2, workers=workers).failed for workers in (1, 2)]
    assert refused[0] == refused[1] and len(refused[0]) == 2


def test_the_comparison_measures_the_error_that_was_put_in(run):
    comparison = compare_run(run, Stiffer(1.25), method=Winkler(), frames=6, tolerance=1e-6)
    assert len(comparison.pairs) == 6 and not comparison.passed and "failed" in comparison.verdict
    for pair in comparison.pairs:
        assert pair.score.peak_share == pytest.approx(-0.2, abs=1e-4)
        assert pair.score.contact == pytest.approx(0.25 * pair.ours.magnitude[pair.frame.pressure > 0].mean(), rel=1e-4)


def test_the_sample_holds_the_heaviest_frame_and_both_tools_and_spreads(run):
    moments = survey(run).moments
    for count in (2, 5, 12, 1000):
        picks = sample(moments, count)
        assert len(picks) == min(count, sum(moment.load > 0 for moment in moments))
        assert max(moments, key=lambda moment: moment.load) in picks
        assert any(len(moment.tools) > 1 for moment in picks)
    (first, *_) = next(moment.tools for moment in moments if len(moment.tools) == 1)
    only = compare_run(run, Winkler(), method=Winkler(), frames=3, tool=first)
    assert all([name for name, touch in pair.frame.touches.items() if touch.presses] == [first] for pair in only.pairs)
    alone = [replace(moment, load=0.0) for moment in moments]
    with pytest.raises(BagError, match="nothing pressed"):
        sample(alone, 5)


def test_rate_latency_and_losses_are_those_that_were_put_in(run):
    timing = survey(run).timing
    assert timing.lost == len(LOST) and timing.answers == 24 - len(LOST) - len(SKIPPED)
    assert timing.skipped == len(SKIPPED) and timing.kept == 1 - len(SKIPPED) / 24
    assert timing.latency(50) == pytest.approx(DELAY, abs=1e-6) and timing.latency(99) == pytest.approx(DELAY, abs=1e-6)
    assert timing.instants == 24 and timing.instant_rate == pytest.approx(100.0)


def test_a_reference_that_does_not_converge_does_not_judge(run):
    comparison = compare_run(run, Stiffer(1.0, converged=False), frames=4)
    assert not comparison.judged and not comparison.passed and "4 frames could not be judged" in comparison.verdict


def test_bags_of_different_skins_are_not_compared(run, tmp_path):
    other = write_run(tmp_path / "other", Winkler(), layer=tube(edge=9e-3), frames=3)
    with pytest.raises(BagError, match="one skin only"):
        compare_bags(run, other)


@pytest.fixture(scope="module")
def two_skins(tmp_path_factory):
    """A run whose skin was changed on the way, as by ~/set_body: another stiffness, then another mesh as well."""
    folder = tmp_path_factory.mktemp("skins")
    skins = (tube(), tube().with_(youngs_modulus=2e4), tube(edge=9e-3))
    parts = [write_run(folder / f"part{k}", Winkler(), layer=skin, frames=8) for k, skin in enumerate(skins)]
    return joined(parts, folder / "run", after=10**9), skins


def joined(parts, folder, order=None, attached=None, after=1):
    """Several runs as one, one after the other, or in another order of (part, topic, data, log time); a layer last.

    Each comes `after` the one before it [ns].
    """
    with BagWriter(folder) as writer:
        write_provenance(writer, None, method="winkler")
        channels = {}
        bags = [Bag(path) for path in parts]
        told = [(part, *raw) for part, bag in enumerate(bags) for raw in bag.raw(lambda topic: True)]
        for part, topic, data, log_time in sorted(told, key=order) if order else told:
            if topic not in channels:
                channels[topic] = writer.add_channel(topic, bags[part].topics[topic].type_name)
            writer.write(channels[topic], data, log_time + part * after, log_time)
        if attached:
            writer.attach(LAYER, "application/x-npz", layer_to_bytes(attached))
    return folder


def test_a_run_whose_skin_was_changed_is_replayed_each_answer_on_its_own(two_skins):
    run, skins = two_skins
    bag = Bag(run)
    assert list(bag.layers) == [layer_id(skin) for skin in skins] and bag.layer_id == layer_id(skins[0])
    replayed = replay_run(run, Winkler())
    assert replayed.frames == replayed.identical == 24
    loads = [moment.load for moment in survey(run).moments]
    assert loads[:8] == pytest.approx(loads[8:16], rel=0.02), "the same wrenches on either skin"


def test_a_run_whose_skin_was_changed_is_compared_and_shown_each_answer_on_its_own(two_skins, tmp_path):
    run, skins = two_skins
    comparison = compare_run(run, Winkler(), method=Winkler(), frames=100, tolerance=0.0)
    assert comparison.passed and len(comparison.pairs) == 21, "each run begins at rest"
    assert {layer_id(pair.layer) for pair in comparison.pairs} == {layer_id(skin) for skin in skins}
    assert all(len(pair.ours.displacement) == len(pair.layer.vertices) for pair in comparison.pairs)
    page = write_report(comparison, tmp_path / "report.html").read_text()
    assert all(repr(skin) in html.unescape(page) for skin in skins)
    recording = Recording.of(run, frames=24)
    assert {layer_id(layer) for layer in recording.layers} == {layer_id(skin) for skin in skins}
    for snapshot, layer in zip(recording.snapshots, recording.layers, strict=True):
        assert len(snapshot.answer.displacement) == len(layer.vertices)


def test_loads_and_times_are_those_of_the_answer_where_a_node_was_started_again(two_skins):
    comparison = compare_run(two_skins[0], Winkler(), frames=100)
    for pair in comparison.pairs:
        assert pair.load == pytest.approx(float(pair.frame.pressure @ pair.layer.vertex_areas), rel=1e-6)
        assert comparison.run.moments[pair.number].stamp_ns == pair.frame.stamp_ns


def test_a_file_in_any_order_gives_the_same(run, tmp_path):
    last = ("displacement", "pose", "wrench", "contact_mesh", "topology")
    backwards = joined([run], tmp_path / "run", order=lambda told: (last.index(told[1].split("/")[-1]), told[3]))
    assert next(Bag(backwards).raw(lambda topic: True)).topic == "/stmpl/skin/displacement"
    ours, theirs = survey(backwards), survey(run)
    for moment, expected in zip(ours.moments, theirs.moments, strict=True):
        assert vars(moment) == vars(expected)
    assert replay_run(backwards, Winkler()).identical == len(ours.moments)
    assert compare_run(backwards, Winkler(), method=Winkler(), tolerance=0.0).passed


def test_a_topic_of_another_type_is_left_out_of_a_replay_with_a_line(run, tmp_path, caplog):
    odd = tmp_path / "odd"
    with BagWriter(odd) as bag:
        for topic in ("/stmpl/tools/gripper/pose", "/right/skin/displacement", "/tf"):
            number = bag.add_channel(topic, "std_msgs/msg/Header", qos_yaml())
            bag.write(number, cdr(header("body", START)), START, START)
    mixed = joined([odd, run], tmp_path / "run", order=lambda told: told[3])
    replayed = replay_run(mixed, Winkler())
    assert replayed.frames == replayed.identical == Bag(run).answers and Bag(mixed).namespaces == ["/stmpl"]
    assert ("/stmpl/tools/gripper/pose is left out: it carries std_msgs/msg/Header, and a run's carries "
            "geometry_msgs/msg/PoseStamped") in caplog.text  # fmt: skip


def test_answers_before_and_after_a_reset_are_those_to_what_came_in_their_own_run(tmp_path, monkeypatch):
    """The same stamps come again, of other poses in a frame that stands elsewhere."""
    parts, second, layer, going = [], 10**9, tube(edge=9e-3), bag_scene.going
    for k, frames in enumerate((8, 12)):
        monkeypatch.setattr(bag_scene, "going", lambda stamp, k=k: going(stamp + k * second // 5))
        parts.append(write_run(tmp_path / f"part{k}", Winkler(), layer=layer, frames=frames, frame="base", delay=DELAY,
                               unheard=(2,) * (k == 0), tf=(START - second // 10, START + second)))  # fmt: skip
    run = joined(parts, tmp_path / "run", after=2 * second)
    replayed = replay_run(run, Winkler())
    assert (replayed.frames, replayed.left_out) == (19, 1) and replayed.worst < 1e-7  # unheard in the first run only
    surveyed = survey(run)
    timing = surveyed.timing
    assert (timing.instants, timing.skipped, timing.lost) == (19, 0, 0)
    np.testing.assert_allclose(timing.latencies[[0, 1, *range(3, 20)]], DELAY)
    assert timing.answer_rate == pytest.approx(19 / 0.18)
    assert compare_bags(surveyed, survey(run), frames=20).worst_under_contact == 0
    assert compare_run(surveyed, Winkler(), method=Winkler(), frames=20).failed.keys() == {2}


def test_an_exact_layer_that_comes_last_counts_for_every_answer(run, tmp_path):
    layer = Bag(run).layer
    exact = layer.with_(vertices=layer.vertices * (1 + 1e-9))  # the same to float32
    assert layer_id(exact) == layer_id(layer)
    late = survey(joined([run], tmp_path / "late", attached=exact))
    frames = list(late.bag.frames())
    assert late.bag.layer.vertices.tobytes() == exact.vertices.tobytes()
    for moment, frame in zip(late.moments, frames, strict=True):
        assert moment.load == float(np.sum(frame.pressure * exact.vertex_areas))


def test_a_comparison_walks_the_file_once(run, monkeypatch):
    walks = []
    walk = records._walk
    monkeypatch.setattr(records, "_walk", lambda *given: walks.append(1) or walk(*given))
    compare_run(run, Winkler(), method=Winkler(), frames=4)
    assert len(walks) == 1
    replay_run(run, Winkler())
    assert len(walks) == 2


def changed(run, folder, change, wanted=lambda topic, time: True):
    """The run with what `change` made of each of its messages; it gets their topics, too. Without those, by topic and
    time since its start [s], that are not `wanted`."""
    with BagWriter(folder) as writer:
        write_provenance(writer, None, method="winkler")
        channels = {}
        for topic, message, log_time in Bag(run).messages():
            if topic not in channels:
                channels[topic] = writer.add_channel(topic, message.__msgtype__)
            change(topic, message)
            if wanted(topic, (log_time - START) * 1e-9):
                writer.write(channels[topic], cdr(message), log_time, log_time)
    return folder


def far_off(answer):
    """Moves the vertex that moved least by 5 mm."""
    moved = answer.displacement = np.array(answer.displacement)
    moved[3 * np.linalg.norm(moved.reshape(-1, 3), axis=1).argmin()] += 5e-3


def pressed_twice(answer):
    answer.pressure = 2 * np.array(answer.pressure)


def pushed(answer):
    for touch in answer.touches:
        touch.wrench.force.z += 1.0


def elsewhere(answer):
    for touch in answer.touches:
        touch.pose.position.x += 1e-6


def flagged(answer):
    answer.in_range = not answer.in_range


def bounded(answer):
    for touch in answer.touches:
        touch.force_bound *= 2


@pytest.mark.parametrize(("change", "part"), [
    (far_off, "displacement, by up to 5 mm at a vertex"), (pressed_twice, "pressure"), (pushed, "wrench"),
    (elsewhere, "pose"), (flagged, "trust"), (bounded, "bound on force"),
])  # fmt: skip
def test_an_answer_that_differs_in_any_part_is_told_by_replay_and_compare(run, tmp_path, capsys, change, part):
    theirs = changed(run, tmp_path / "theirs", lambda topic, answer: topic.endswith("displacement") and change(answer))
    summary = replay_run(theirs, Winkler())
    assert not summary.passed and f"differ in {part}; held to every bit" in str(summary)
    for given in ((), ("--tolerance-mm", 0)):
        code, said = stmpl(capsys, "compare", theirs, "--with", run, *given)
        assert code == 1 and f"differ in {part}; number" in said.replace("│", "")


def test_a_bound_that_was_told_is_held_and_a_node_may_doubt_more_than_a_replay_if_it_says_why(run, tmp_path):
    frame = replace(list(Bag(run).frames())[5], trust=Trust())
    now, other = (replace(frame, trust=Trust(error_bound=bound)) for bound in (1e-5, 2e-5))
    assert differences(now, other) == {"bound": pytest.approx(1e-5)}
    assert not differences(now, frame), "none was told"
    doubted = replace(frame, trust=frame.trust.also("no joint states", in_range=False))
    assert not differences(frame, doubted, replayed=True) and differences(doubted, frame, replayed=True)
    assert differences(frame, replace(frame, trust=replace(frame.trust, in_range=False)), replayed=True)
    assert differences(frame, doubted), "two recordings say the same"


def test_answers_without_a_counterpart_are_counted(run, tmp_path, capsys):
    half = without(run, tmp_path / "half", lambda topic, time: "displacement" not in topic or time < 0.1)
    code, said = stmpl(capsys, "compare", half, "--with", run)
    ours, theirs = Bag(half).answers, Bag(run).answers
    assert code == 0 and f"{ours} answers are in both, 0 and {theirs - ours} have no counterpart" in said
    _, said = stmpl(capsys, "compare", run, "--with", half)
    assert f"{ours} answers are in both, {theirs - ours} and 0 have no counterpart" in said


@pytest.mark.parametrize("first", [0, 6])
def test_answers_are_paired_in_the_order_in_which_they_were_received(run, tmp_path, first):
    """Two of them changed places in the file, and all after them are off."""
    place = iter(range(1000))

    def order(told):
        number = next(place) if told[1].endswith("displacement") else -1
        return told[3] + {first: 10**8, first + 1: -(10**8)}.get(number, 0) // 5

    swapped = joined([run], tmp_path / "swapped", order=order)
    assert [frame.sequence for frame in Bag(swapped).frames()] == [frame.sequence for frame in Bag(run).frames()]
    same = compare_bags(swapped, run)
    assert same.passed and same.whole.common == Bag(run).answers and same.whole.alone == (0, 0)
    assert survey(swapped).timing.lost == len(LOST)


def without(run, folder, wanted, resting=()):
    """The run without the messages that are not `wanted` (see `changed`); answers to nothing among `resting`."""

    def rest(topic, message):
        if topic.endswith("displacement") and message.sequence in resting:
            message.touches, message.displacement = [], np.zeros_like(message.displacement)
            message.pressure = np.zeros_like(message.pressure)

    return changed(run, folder, rest, wanted)


@pytest.mark.parametrize("kind", ["pose", "wrench", "mesh"])
def test_a_replay_of_answers_to_what_is_not_there_fails_also_where_a_rest_is_repeated(run, tmp_path, capsys, kind):
    for name, resting in (("last", (21,)), ("first", (0,))):
        part = without(run, tmp_path / name, lambda topic, _: not topic.endswith(kind), resting)
        code, said = stmpl(capsys, "replay", part)
        assert code == 1 and "1 frames replayed" in said and f"no {kind}" in said
        assert "left out, not only at its beginning" in said and "No answer with a tool is among those replayed" in said
    code, said = stmpl(capsys, "replay", part, "--method", "winkler")
    assert code == 0 and "No answer with a tool" in said, "held to nothing, and told"


def test_answers_are_excused_at_the_beginning_of_a_recording_only(tmp_path):
    slow = write_run(tmp_path / "slow", Winkler(), layer=tube(edge=9e-3), frames=12, rate=2.0)
    for until, passes in ((1.6, True), (2.9, False)):
        part = without(slow, tmp_path / f"{until}", lambda one, time, until=until: "pose" not in one or time > until)
        replayed = replay_run(part, Winkler())
        assert replayed.frames == replayed.identical == 12 - replayed.left_out and replayed.passed == passes
        compared = compare_run(part, Winkler(), method=Winkler(), frames=100)
        assert compared.passed == passes, "a comparison excuses no more"


def test_a_replay_that_takes_no_answer_with_a_tool_says_so_and_fails(run, tmp_path, capsys):
    part = without(run, tmp_path / "part", lambda *_: True, resting=(0,))
    code, said = stmpl(capsys, "replay", part, "--every", 1000)
    assert code == 1 and said.endswith("No answer with a tool is among those replayed, and the recording has some.")
    rest = without(run, tmp_path / "rest", lambda *_: True, resting=range(24))
    assert stmpl(capsys, "replay", rest)[0] == 0, "nothing else was recorded"
    nothing = without(run, tmp_path / "nothing", lambda topic, _: "displacement" not in topic)
    code, said = stmpl(capsys, "replay", nothing)
    assert code == 1 and "holds no answers" in said


@pytest.fixture(scope="module")
def two_robots(tmp_path_factory):
    """Two robots in one recording: skins, tools of the same names, answers; and a topic that is of neither."""
    folder = tmp_path_factory.mktemp("robots")
    skins = {"/left": tube(edge=9e-3), "/right/arm": tube(edge=9e-3).with_(youngs_modulus=2e4)}
    parts = [write_run(folder / name[1:5], Winkler(), layer=skin, frames=8, namespace=name)
             for name, skin in skins.items()]  # fmt: skip
    return joined(parts, folder / "run", order=lambda told: told[3]), parts, skins


def test_a_recording_of_two_robots_is_read_by_namespace(two_robots):
    run, parts, skins = two_robots
    assert Bag(run).namespaces == ["/left", "/right/arm"] and len(Bag(run).topics) == 14
    for name, part in zip(skins, parts, strict=True):
        bag = Bag(run, name)
        assert set(bag.topics) == set(Bag(part).topics) and list(bag.layers) == [layer_id(skins[name])]
        replayed = replay_run(Run(run, name.strip("/")), Winkler())
        assert replayed.frames == replayed.identical == 8
        ours, alone = survey(run, name), survey(part)
        assert [moment.load for moment in ours.moments] == [moment.load for moment in alone.moments]
        assert compare_run(ours, Winkler(), method=Winkler(), tolerance=0.0).passed
        assert Recording.of(ours, frames=4).layer.tissue == skins[name].tissue


@pytest.mark.parametrize("namespace", ["", "/tools/left", "/lab_1/tools"])
def test_tools_with_slashes_in_their_names_are_read_and_replayed(tmp_path, monkeypatch, namespace):
    names, script = {"ball": "arm/tools/tip", "finger": "skin/_tip"}, bag_scene.script
    monkeypatch.setattr(bag_scene, "ANGLES", {names[tool]: angle for tool, angle in bag_scene.ANGLES.items()})
    monkeypatch.setattr(bag_scene, "script", lambda share: {names[tool]: n for tool, n in script(share).items()})
    run = write_run(tmp_path / "run", Winkler(), layer=tube(edge=9e-3), frames=8, namespace=namespace)
    replayed = replay_run(Run(run, namespace), Winkler())
    assert replayed.frames == replayed.identical == 8 and Bag(run).namespaces == [namespace or "/"]
    assert compare_run(survey(run), Winkler(), method=Winkler(), tolerance=0.0).passed


@pytest.mark.parametrize("read", [survey, Run, lambda run: Bag(run).layers, lambda run: list(Bag(run).frames())])
def test_which_robot_is_asked_for_where_there_are_two(two_robots, read):
    with pytest.raises(BagError, match=r"holds 2 robots, of the namespaces /left, /right/arm. Name one .*--namespace"):
        read(two_robots[0])
    with pytest.raises(BagError, match="no robot of the namespace /middle; there: /left, /right/arm"):
        Bag(two_robots[0], "/middle")


def test_the_command_takes_a_namespace_and_info_lists_them(two_robots, capsys):
    run = two_robots[0]
    code, said = stmpl(capsys, "info", run)
    assert code == 0 and "2 robots: /left, /right/arm" in said and said.count("skin ") == 2
    assert json.loads(stmpl(capsys, "info", run, "--json")[1])["namespaces"] == ["/left", "/right/arm"]
    code, said = stmpl(capsys, "replay", run)
    assert code == 1 and "--namespace" in said
    assert stmpl(capsys, "replay", run, "--namespace", "/left")[0] == 0
    assert stmpl(capsys, "replay", run, "--namespace", "/left", "--method", "linear", "--tolerance-mm", 0)[0] == 1
    compared = "compare", run, "--reference", "winkler", "--tolerance-mm", 1e-3, "--namespace"
    assert stmpl(capsys, *compared, "/right/arm")[0] == 0
    assert stmpl(capsys, *compared, "/middle")[0] == 1


def test_the_report_shows_what_was_measured_and_needs_no_other_file(run, tmp_path):
    comparison = compare_run(run, Stiffer(1.25), frames=2)
    page = write_report(comparison, tmp_path / "report.html", replay=replay_run(run, Winkler())).read_text()
    assert page.count("data:image/png;base64,") == page.count("<img ") >= 4
    assert "http://" not in page and "https://" not in page and "src='data:" in page
    for name, value in headline(comparison):
        assert html.escape(name) in page and value in page
    assert "bit for bit" in page and np.isfinite(comparison.worst_under_contact)
