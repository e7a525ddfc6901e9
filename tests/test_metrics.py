"""The paper's metrics, on displacements whose errors are known."""

import numpy as np
import pytest

from stmpl_core import Load
from stmpl_core.errors import InvalidInput
from stmpl_core.metrics import LIMITS, mean_and_deviation, score
from tests.scenes import plate

SKIN = plate(0.2, edge=4e-3)
R = np.linalg.norm(SKIN.vertices, axis=1)
LOAD = Load.pressure(np.where(R < 0.01, 100.0, 0.0))
TRUTH = -2e-3 * np.exp(-((R / 0.02) ** 2))[:, None] * SKIN.normals


def test_the_truth_has_no_error() -> None:
    same = score(TRUTH, TRUTH, SKIN, LOAD)
    assert same.mee == same.mae_x == same.peak_error == same.contact == same.much == 0
    assert same.within == (1.0,) * len(LIMITS)
    assert same.peak == pytest.approx(2e-3)


def test_a_shift_is_measured_as_what_it_is() -> None:
    shift = np.array([3e-5, -4e-5, 12e-5])
    one = score(TRUTH + shift, TRUTH, SKIN, LOAD)
    assert (one.mae_x, one.mae_y, one.mae_z) == pytest.approx((3e-5, 4e-5, 12e-5))
    assert (one.mee, one.contact, one.much) == pytest.approx((13e-5,) * 3)
    assert one.within == (0, 0, 1, 1, 1)
    assert one.mee_share == pytest.approx(13e-5 / 2e-3)
    assert one.leak == pytest.approx(13e-5)


def test_only_moving_vertices_count() -> None:
    answer = TRUTH.copy()
    still = np.linalg.norm(TRUTH, axis=1) < 1e-6
    assert 0 < still.sum() < len(still)
    answer[still] += [1e-3, 0, 0]
    one = score(answer, TRUTH, SKIN, LOAD)
    assert one.mee == 0 and one.leak == pytest.approx(1e-3, rel=1e-2) and one.moving == (~still).sum()


def test_zero_undershoots_the_peak_by_all_of_it() -> None:
    one = score(np.zeros_like(TRUTH), TRUTH, SKIN, LOAD)
    assert one.peak_share == -1 and one.peak_error == -one.peak
    assert one.contact > one.much > one.mee > 0


def test_nothing_moving_is_no_number_rather_than_a_good_one() -> None:
    one = score(TRUTH, np.zeros_like(TRUTH), SKIN, LOAD)
    assert np.isnan(one.mee) and np.isnan(one.peak_share) and one.peak == 0


def test_rows_are_in_millimetres() -> None:
    row = score(TRUTH + [1e-4, 0, 0], TRUTH, SKIN, LOAD).row()
    assert row["MEE mm"] == pytest.approx(0.1) and row["peak mm"] == pytest.approx(2.0)
    assert row["<=0.125 mm %"] == 100


def test_mean_and_deviation_are_those_of_the_samples() -> None:
    scores = [score(TRUTH + [k * 1e-5, 0, 0], TRUTH, SKIN, LOAD) for k in (1, 2, 6)]
    mean, deviation = mean_and_deviation(scores)
    assert mean.mee == pytest.approx(3e-5) and deviation.mee == pytest.approx(np.std([1e-5, 2e-5, 6e-5]))
    assert mean.within == (1.0,) * len(LIMITS)
    nothing = score(TRUTH, np.zeros_like(TRUTH), SKIN, LOAD)
    assert mean_and_deviation([*scores, nothing])[0].mee == pytest.approx(3e-5)
    with pytest.raises(InvalidInput, match="no scores"):
        mean_and_deviation([])


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InvalidInput, match="answer has shape"):
        score(TRUTH[:-1], TRUTH, SKIN, LOAD)
