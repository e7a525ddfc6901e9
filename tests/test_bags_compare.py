"""Recorded runs: a replay repeats them bit for bit, and a comparison measures what was put in."""

from __future__ import annotations

import html
from dataclasses import replace

import numpy as np
import pytest

from bags.compare import compare_bags, compare_run, headline, sample
from bags.messages import layer_id
from bags.provenance import write_provenance
from bags.reader import Bag
from bags.replay import replay_run
from bags.report import write_report
from bags.survey import survey
from bags.writer import BagWriter
from stmpl_core.errors import BagError
from stmpl_core.methods import Winkler
from stmpl_core.trust import Displacement, Trust
from stmpl_ros.view.recording import Recording
from tests.bag_scene import tube, write_run

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


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "bag"
    return write_run(folder, Winkler(), frames=24, lose=LOST, skip=SKIPPED, delay=DELAY)


def test_a_replay_repeats_the_run_bit_for_bit(run):
    replayed = replay_run(run, Winkler())
    assert replayed.frames == replayed.identical == 24 - len(LOST) - len(SKIPPED)
    assert "every one bit for bit" in str(replayed)


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
        assert any(moment.pressing > 1 for moment in picks)
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
    return joined(parts, folder / "run"), skins


def joined(parts, folder):
    """Several runs as one, one after the other."""
    with BagWriter(folder) as writer:
        write_provenance(writer, None, method="winkler")
        for part, path in enumerate(parts):
            bag, channels = Bag(path), {}
            for raw in bag.raw(lambda topic: True):
                if raw.topic not in channels:
                    channels[raw.topic] = writer.add_channel(raw.topic, bag.topics[raw.topic].type_name)
                writer.write(channels[raw.topic], raw.data, raw.log_time_ns + part, raw.log_time_ns)
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


def test_the_report_shows_what_was_measured_and_needs_no_other_file(run, tmp_path):
    comparison = compare_run(run, Stiffer(1.25), frames=2)
    page = write_report(comparison, tmp_path / "report.html", replay=replay_run(run, Winkler())).read_text()
    assert page.count("data:image/png;base64,") == page.count("<img ") >= 4
    assert "http://" not in page and "https://" not in page and "src='data:" in page
    for name, value in headline(comparison):
        assert html.escape(name) in page and value in page
    assert "bit for bit" in page and np.isfinite(comparison.worst_under_contact)
