"""The paper's tables: their arithmetic, their rows, and who is judged on what."""

import json
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from fem_tools.dataset import Dataset
from stmpl_core import Load, SoftLayer
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Naive, Winkler
from stmpl_core.methods.zero import Zero
from stmpl_core.metrics import mean_and_deviation, score
from studies.evaluate import THREE_BODY_ROW, Row, Tables, evaluate, spread
from tests.learning_data import small_data


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_data(tmp_path_factory)


class ArmsOnly(Winkler):
    """Refuses what is not an arm, as a method with charts of its own would."""

    def prepare(self, layer: SoftLayer) -> Self:
        if layer.vertices[:, 2].max() < 0:
            raise InvalidInput("this is no arm")
        return super().prepare(layer)


@pytest.fixture(scope="module")
def tables(data: Path) -> Tables:
    return evaluate(data, {THREE_BODY_ROW: Winkler, "arms": ArmsOnly})


def row(tables: Tables, title: str, name: str) -> Row:
    table = next(t for t in tables.tables if title in t.title)
    return next(r for r in table.rows if r.name == name)


def test_a_row_is_the_mean_over_the_samples_of_its_split_and_kind(data: Path, tables: Tables) -> None:
    samples = list(Dataset.open(data).split("test", kind="pressure"))
    scores = [score(Winkler().prepare(s.layer).solve(s.load).displacement, s.displacement, s.layer, s.load)
              for s in samples]  # fmt: skip
    mean, deviation = mean_and_deviation(scores)
    ours = row(tables, "Table 1, in distribution: follower", "winkler")
    assert ours.samples == len(samples)
    for got, wanted in ((ours.mean, mean), (ours.deviation, deviation)):
        assert got.row() == pytest.approx(wanted.row())


def test_zero_is_wrong_by_all_that_moves(tables: Tables) -> None:
    for title in ("Table 1", "Table 2", "Limbs"):
        zero = row(tables, title, "zero")
        assert zero.mean.peak_error == -zero.mean.peak and zero.mean.leak == 0
        assert zero.mean.mee < zero.mean.much < zero.mean.contact < zero.mean.peak


def test_naive_is_fitted_on_the_training_samples_of_the_same_kind(data: Path, tables: Tables) -> None:
    dataset = Dataset.open(data)
    for kind, rule in (("nodal", "dead"), ("pressure", "follower")):
        naive = Naive.fit(s[:3] for s in dataset.split("train", kind=kind))
        samples = list(dataset.split("ood", kind=kind))
        errors = [score(naive.prepare(s.layer).solve(s.load).displacement, s.displacement, s.layer, s.load).mee
                  for s in samples]  # fmt: skip
        assert row(tables, f"Table 2, out of distribution: {rule}", "naive").mean.mee == pytest.approx(np.mean(errors))


def test_table_3_parts_the_same_samples_by_thickness_seen(tables: Tables) -> None:
    seen = row(tables, "Table 3", "in distribution, seen thickness")
    unseen = row(tables, "Table 3", "in distribution, unseen thickness")
    whole = row(tables, "Table 1", THREE_BODY_ROW)
    assert seen.samples and unseen.samples and seen.samples + unseen.samples == whole.samples
    joined = (seen.samples * seen.mean.mee + unseen.samples * unseen.mean.mee) / whole.samples
    assert joined == pytest.approx(whole.mean.mee)


def test_the_papers_rows_stand_beside_ours_as_printed(tables: Tables) -> None:
    text = tables.text()
    assert "0.0196±0.0098 / 0.0321±0.0251 / 0.0339±0.0269" in text  # Table 1, STMPL
    assert "0.1775±0.1527" in text and "37.90 / 48.37 / 57.71 / 69.85 / 96.11" in text  # Table 2, Naive
    assert "0.0282 / 0.0578 / 0.0678" in text  # Table 3, out of distribution, unseen
    stmpl = row(tables, "Table 2", "STMPL (paper, printed)")
    assert stmpl.mean.mee_share == pytest.approx(0.0557, abs=5e-5) and stmpl.samples is None


def test_a_method_that_refuses_a_body_is_named_and_the_others_go_on(tables: Tables) -> None:
    assert tables.refusals == {"arms on calf": "this is no arm"}
    limbs = next(t for t in tables.tables if t.title.startswith("Limbs"))
    assert [r.name for r in limbs.rows] == ["zero", "naive", "winkler", THREE_BODY_ROW]
    assert "arms on calf: refused, this is no arm" in tables.text()


def test_markdown_and_json_tell_the_same(data: Path, tables: Tables) -> None:
    told = json.loads(tables.as_json())
    assert [t["title"] for t in told["tables"]] == [t.title for t in tables.tables]
    assert told["tables"][0]["rows"][0]["mean"]["leak"] is None  # the paper has no such figure
    for table in tables.tables:
        for line in table.rows:
            assert f"| {line.name} |" in tables.markdown()
    assert told["about"]["data"]["samples"] == len(Dataset.open(data)) and told["about"]["limit"] is None


def test_columns_stand_under_their_headings(tables: Tables) -> None:
    for block in tables.text().split("\n\n")[: len(tables.tables)]:
        assert len({len(line) for line in block.splitlines()[1:]}) == 1


def test_a_limit_spreads_over_the_whole_split() -> None:
    chosen = spread(1000, 10, 0)
    assert [k // 100 for k in chosen] == list(range(10)) and chosen == spread(1000, 10, 0) != spread(1000, 10, 1)
    assert spread(5, 10, 0) == spread(5, None, 0) == [0, 1, 2, 3, 4]


def test_a_limit_is_kept_and_progress_counts_to_the_end(data: Path) -> None:
    steps: list[tuple[int, int]] = []
    few = evaluate(data, {}, kinds=["pressure"], limit=2, on_progress=lambda *step: steps.append(step))
    assert {r.samples for t in few.tables for r in t.rows} == {None, 2}
    assert [done for done, _ in steps] == list(range(1, steps[-1][1] + 1)) and len(steps) == 3 * 2
    with pytest.raises(InvalidInput, match="limit is 0"):
        evaluate(data, {}, limit=0)


def test_zero_is_trusted_only_where_nothing_presses() -> None:
    layer = SoftLayer([[0, 0, 0], [1e-2, 0, 0], [0, 1e-2, 0]], [[0, 1, 2]], 5e-3)
    method = Zero().prepare(layer)
    assert method.solve(Load.zero(layer)).trust.ok
    answer = method.solve(Load.pressure([100.0, 0, 0]))
    assert not answer.displacement.any() and not answer.trust.in_range
