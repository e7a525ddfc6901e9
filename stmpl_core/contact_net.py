"""ContactNet: from how a rigid tool squeezes the columns of skin under it to the pressure that holds them there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stmpl_core.layer import SoftLayer
from stmpl_core.methods.moment_net import invariants, think_few
from stmpl_core.moments import Surroundings
from stmpl_core.networks import INPUTS, PRESSURE, Weights, shipped

MAX_LOG_RATIO = 2.5  # largest |log| of pressure over Winkler's [-]


class Held(NamedTuple):
    """Pressure that holds the skin against a tool, and its doubt.

    Args:
        pressure: pressure over E, (N,) [-].
        doubt: error to expect of it, over E, (N,) [-].
        outside: mask of the vertices that see what no training contact had, (N,).
    """

    pressure: np.ndarray
    doubt: np.ndarray
    outside: np.ndarray


class ContactNet:
    """Winkler's columns, corrected at every vertex by a network that sees how the columns around it are squeezed.

    A column that is pressed beside free skin is held by less than confined columns are where it is deep (the skin
    gives way sideways) and by more at the rim (its neighbours come along). By dimensional analysis the ratio of both
    is a function of the squeeze around it in units of the thickness, of nu and of the skin's curvature: so one network
    serves every stiffness, thickness, pose and limb. It was trained on tools that stick, pressed in along a line
    (studies.train_contact). The inputs are those of MomentNet. No squeeze gives no pressure, and the pressure is
    never below 0.

    Args:
        layer: soft layer at rest.
        weights: trained network; None: the one that comes with the package.
        near: neighbours of its vertices; None: found here.
    """

    def __init__(self, layer: SoftLayer, weights: Weights | None = None, near: Surroundings | None = None) -> None:
        self.near = near or Surroundings.of(layer)
        self.weights = weights or shipped("contact_net")
        self._shape = np.concatenate([self.near.curvature, self.near.slope], axis=1).astype(np.float32)
        self._constants = np.array([layer.tissue.poisson_ratio, 0.0], np.float32)

    def hold(self, vertices: np.ndarray, pressure: np.ndarray, strain: np.ndarray) -> Held:
        """Pressure that holds squeezed columns.

        Args:
            vertices: numbers of the squeezed vertices, (N,).
            pressure: Winkler's pressure there over E, (N,) [-]; see stmpl_core.columns.Squeeze.
            strain: strain of a confined column there, times its modulus over E, (N,) [-].
        """
        a = self.weights.arrays
        here = np.column_stack([pressure, strain]).astype(np.float32)
        figures = self.near.felt_among(vertices, here).figures
        inputs, outside = np.empty((len(vertices), INPUTS.size), np.float32), np.zeros(len(vertices), np.bool_)
        invariants(figures, self._shape[vertices], here, self._constants, a["mix_vectors"], a["mix_tensors"], a["low"],
                   a["high"], a["mean"], a["scale"], inputs, outside)  # fmt: skip
        outputs = np.empty((len(vertices), PRESSURE.size), np.float32)
        think_few(inputs, a["w1"], a["b1"], a["w2"], a["b2"], a["w3"], a["b3"], a["w4"], a["b4"], outputs)
        held = pressure * np.exp(np.clip(outputs[:, PRESSURE.at.log_ratio], -MAX_LOG_RATIO, MAX_LOG_RATIO))
        return Held(held, held * np.exp(np.minimum(outputs[:, PRESSURE.at.log_error], 1.0)), outside)
