"""Score: the STMPL paper's metrics of a displacement against the truth, and those that the paper lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from stmpl_core.arrays import finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load

MOVING = 1e-6  # true displacement from which the paper counts a vertex [m]
MOVING_MUCH = 0.1  # displacement over the largest, from which a vertex moves much
FAR = 8.0  # distance from the load, over t, beyond which the truth moves by less than 0.1 % of the peak
LIMITS = (1e-4, 1.25e-4, 1.5e-4, 2e-4, 5e-4)  # errors that the paper's tables count up to [m]


@dataclass(frozen=True)
class Score:
    """Errors of a displacement against the truth; lengths in metres, shares from 0 to 1, nan where nothing counts.

    Args:
        mae_x, mae_y, mae_z: mean absolute error along each axis over the moving vertices [m] (paper).
        mee: mean Euclidean error over the moving vertices [m] (paper).
        within: shares of the moving vertices with a Euclidean error of at most each of LIMITS (paper).
        mee_share: mee over the largest true displacement [-].
        much: mean Euclidean error over the vertices that move more than a tenth of the largest displacement [m].
        contact: mean Euclidean error over the loaded vertices [m].
        peak: largest true displacement [m].
        peak_error: length of the answer minus length of the truth, where the truth is largest [m]; signed.
        peak_share: peak_error over peak [-].
        leak: largest displacement of the answer beyond FAR thicknesses from the load [m].
        moving: number of vertices that move.
    """

    mae_x: float
    mae_y: float
    mae_z: float
    mee: float
    within: tuple[float, ...]
    mee_share: float
    much: float
    contact: float
    peak: float
    peak_error: float
    peak_share: float
    leak: float
    moving: float

    def row(self) -> dict[str, float]:
        """The figures as a table shows them: millimetres and per cent, by their heading."""
        limits = {f"<={limit * 1e3:g} mm %": 100 * share for limit, share in zip(LIMITS, self.within, strict=True)}
        return {
            "MAE x mm": 1e3 * self.mae_x, "MAE y mm": 1e3 * self.mae_y, "MAE z mm": 1e3 * self.mae_z,
            "MEE mm": 1e3 * self.mee, **limits, "MEE / peak %": 100 * self.mee_share,
            "where it moves mm": 1e3 * self.much, "under contact mm": 1e3 * self.contact, "peak mm": 1e3 * self.peak,
            "at peak mm": 1e3 * self.peak_error, "at peak %": 100 * self.peak_share, "leak mm": 1e3 * self.leak,
        }


def score(answer: ArrayLike, truth: ArrayLike, layer: SoftLayer, load: Load) -> Score:
    """Compares an answer with the truth, under one load.

    Args:
        answer: displacement to judge, (V, 3) [m].
        truth: displacement to judge it by, (V, 3) [m].
        layer: layer of these vertices.
        load: load that tells the pressed vertices.

    Raises:
        InvalidInput: shapes that do not fit the layer, or values that are not finite.
    """
    shape = layer.vertices.shape
    answer, truth = finite("answer", answer, shape), finite("truth", truth, shape)
    error, moved, loaded = answer - truth, np.linalg.norm(truth, axis=1), load.check(layer).loaded
    length = np.linalg.norm(error, axis=1)
    moving, top = moved > MOVING, int(moved.argmax())
    peak = float(moved[top])
    peak_error = float(np.linalg.norm(answer[top])) - peak
    mae_x, mae_y, mae_z = (_mean(np.abs(error[moving, axis])) for axis in range(3))
    mee = _mean(length[moving])
    return Score(
        mae_x=mae_x, mae_y=mae_y, mae_z=mae_z, mee=mee,
        within=tuple(_mean(length[moving] <= limit) for limit in LIMITS), mee_share=_share(mee, peak),
        much=_mean(length[moving & (moved > MOVING_MUCH * peak)]), contact=_mean(length[loaded]),
        peak=peak, peak_error=peak_error, peak_share=_share(peak_error, peak),
        leak=_leak(answer, layer, loaded), moving=float(moving.sum()),
    )


def mean_and_deviation(scores: Sequence[Score]) -> tuple[Score, Score]:
    """Mean and standard deviation over samples, figure by figure, as the paper's tables give them; nans do not count.

    Raises:
        InvalidInput: an empty list of scores.
    """
    if not scores:
        raise InvalidInput("there are no scores to average.")
    table = np.array([_flat(one) for one in scores])
    known = [column[np.isfinite(column)] for column in table.T]
    deviation = [float(column.std()) if len(column) else float("nan") for column in known]
    return _unflat([_mean(column) for column in known]), _unflat(deviation)


def _flat(one: Score) -> list[float]:
    values = [getattr(one, field.name) for field in fields(Score)]
    return [x for value in values for x in (value if isinstance(value, tuple) else (value,))]


def _unflat(values: list[float]) -> Score:
    left = iter(values)
    named: dict[str, Any] = {field.name: tuple(next(left) for _ in LIMITS) if field.name == "within" else next(left)
                             for field in fields(Score)}
    return Score(**named)


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _share(part: float, whole: float) -> float:
    return part / whole if whole > 0 else float("nan")


def _leak(answer: np.ndarray, layer: SoftLayer, loaded: np.ndarray) -> float:
    """Largest |answer| farther than FAR thicknesses from every loaded vertex [m]; 0 where there is no such vertex."""
    moved = np.linalg.norm(answer, axis=1)
    if not len(loaded):
        return float(moved.max())
    away, _ = KDTree(layer.vertices[loaded]).query(layer.vertices)
    return float(moved[away > FAR * layer.thickness[loaded].max()].max(initial=0.0))
