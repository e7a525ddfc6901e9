"""Softness: in what the flat stack at each place of a limb differs from that of its median, in one number a place."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from stmpl_core.layer import SoftLayer
from stmpl_core.stack import along, compliance
from stmpl_core.tissue import Tissue

BANK = 5  # softnesses whose responses are tabled
SEEN = 150, 60  # places of a limb that say in what its stacks differ: of all its skin, and evenly from thin to thick
LEAST, MOST = 0.3, 3.0  # thicknesses over the median that are told from each other
ENDS = 0.01, 0.99  # quantiles of the places seen, between which softnesses are tabled
SMOOTH = 0.3  # weight of second differences along the bank, beside that of a place
ALIKE = 0.02  # logarithm of the compliance below which all places are alike
FELT = (2.5, 15.0)  # wave numbers that decide [1/t]: longer waves are the coarse elements'
WAVES = np.geomspace(1e-2, 60.0, 90)  # wave numbers at which stacks are compared [1/t]
GRID = 9, 7  # thicknesses, and depths of deeper materials, at which softness is found


class Softness(NamedTuple):
    """How the response of the flat stack follows one number c: r(k; c) = r(k) by a factor, linear between BANK of them.

    Tissue is thinner here and thicker there, and its fat ends less or more deep. Of what that does to a flat stack's
    responses 93 to 99 % of the variance goes with one number, on limbs as measured.

    Args:
        least, step: c of the first of BANK, and from one to the next; step 0: all places are alike.
        bank: factors on A, B, L and C (stmpl_core.stack), at WAVES, (BANK, 4, K).
        axes: logarithms of thickness over the median and of `ply_scale`, each even.
        table: c there.
    """

    least: float
    step: float
    bank: np.ndarray
    axes: tuple[np.ndarray, np.ndarray]
    table: np.ndarray

    @classmethod
    def of(cls, layer: SoftLayer, thickness: float) -> Softness:
        """What a limb's places differ in. The median's thickness is in m."""
        tissue, (log_t, log_scale) = layer.tissue, _logs(layer, thickness)
        axes = _even(log_t, GRID[0]), _even(log_scale, GRID[1])
        median = _responses(tissue, thickness, 0.0, 0.0)
        by_t, evenly = np.argsort(log_t, kind="stable"), np.linspace(log_t.min(), log_t.max(), SEEN[1])
        some = np.union1d(np.linspace(0, len(log_t) - 1, SEEN[0]).astype(int),
                          by_t[np.searchsorted(log_t, evenly, sorter=by_t)])  # fmt: skip
        there = np.array([_responses(tissue, thickness, float(log_t[v]), float(log_scale[v])) for v in some])
        felt = (WAVES > FELT[0]) & (WAVES < FELT[1])
        differs = np.log(there[:, 0, felt] / median[0, felt])
        _, _, ways = np.linalg.svd(differs, full_matrices=False)
        way = ways[0] / max(np.abs(ways[0]).max(), 1e-12) * (np.sign(ways[0].sum()) or 1.0)
        way = way / (way @ way)

        def found(responses: np.ndarray) -> np.ndarray:
            return np.log(responses[..., 0, felt] / median[0, felt]) @ way

        c = found(there)
        least, most = (float(end) for end in np.quantile(c, ENDS))
        least, most = min(least, 0.0), max(most, 0.0)
        table = np.array([[found(_responses(tissue, thickness, a, b)) for b in axes[1]] for a in axes[0]])
        if most - least < ALIKE:
            return cls(0.0, 0.0, np.ones((BANK, *median.shape)), axes, 0.0 * table)
        step = (most - least) / (BANK - 1)
        at, ratios = np.clip((c - least) / step, 0, BANK - 1), (there / median).reshape(len(c), -1)
        hats = np.maximum(1 - np.abs(at[:, None] - np.arange(BANK)), 0)
        bends = SMOOTH * np.diff(np.eye(BANK), 2, axis=0)
        wanted = np.vstack([ratios, np.zeros((len(bends), ratios.shape[1]))])
        fitted = np.linalg.lstsq(np.vstack([hats, bends]), wanted, rcond=None)[0]
        return cls(least, step, fitted.reshape(BANK, *median.shape), axes, table)

    def at(self, layer: SoftLayer, thickness: float) -> np.ndarray:
        """Place of each vertex among the BANK, (V,), from 0 to BANK - 1. The median's thickness is in m."""
        if not self.step:
            return np.zeros(len(layer.vertices))
        c = _between(self.table, self.axes, _logs(layer, thickness))
        return np.clip((c - self.least) / self.step, 0.0, BANK - 1.001)

    def factors(self, waves: np.ndarray) -> np.ndarray:
        """What the responses of the median are to be multiplied by, (BANK, 4, K), at wave numbers (K,) [1/t]."""
        place, known = np.log(waves), np.log(WAVES)
        return np.array([[np.interp(place, known, one) for one in each] for each in self.bank])


def _logs(layer: SoftLayer, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of thickness over the median and of how deep materials begin over what the tissue says, (V,) each."""
    t = np.log(np.clip(layer.thickness / thickness, LEAST, MOST))
    return t, np.zeros(len(t)) if layer.ply_scale is None or not layer.tissue.deeper else np.log(layer.ply_scale)


def _responses(tissue: Tissue, thickness: float, log_t: float, log_scale: float) -> np.ndarray:
    """A, B, L and C of the stack at a place, at WAVES over the median's thickness, (4, K) [t/E of the median]."""
    there = _deeper(tissue, float(np.exp(log_scale)))
    stretch = float(np.exp(log_t))
    k = WAVES * stretch
    return stretch * np.array([*compliance(there, thickness * stretch, k), *along(there, thickness * stretch, k)])


def _deeper(tissue: Tissue, scale: float) -> Tissue:
    return replace(tissue, deeper=tuple(replace(ply, depth=scale * ply.depth) for ply in tissue.deeper))


def _even(values: np.ndarray, many: int) -> np.ndarray:
    return np.linspace(values.min(), values.max() + 1e-6, many)


def _between(table: np.ndarray, axes: tuple[np.ndarray, np.ndarray], at: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Values of a table (A, B) at places (V,) between those of its axes."""
    (i, f), (j, g) = (_place(axis, x) for axis, x in zip(axes, at, strict=True))
    upper, lower = ((1 - g) * table[row, j] + g * table[row, j + 1] for row in (i, i + 1))
    return (1 - f) * upper + f * lower


def _place(axis: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    place = np.clip((x - axis[0]) / (axis[1] - axis[0]), 0, len(axis) - 1.001)
    return place.astype(int), place % 1
