"""ContactNet: the pressure with which a layer holds a rigid tool: of a linear layer, then corrected by a network."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from stmpl_core.layer import SoftLayer
from stmpl_core.methods.moment_net import think_few
from stmpl_core.moments import Surroundings
from stmpl_core.networks import NODE, PRESSURE, Weights, shipped
from stmpl_core.nodes import Nodes
from stmpl_core.obstacle import RINGS, held_off
from stmpl_core.rays import column_pressure

MAX_LOG_RATIO = 2.5  # largest |log| of pressure over that of the linear layer [-]
AT = NODE.at  # first columns, constants to numba
LINEAR_TO = 0.6  # strain to which contact is solved; beyond it the columns' barrier takes over
HARDENING = 0.75  # power of the columns' pressure with which it does
FADE, FADE_RING = 0.03, 2  # strain at and around a node at which half of the correction is left: a touch begins linear


class Held(NamedTuple):
    """Pressure that holds the skin against a tool, and its doubt.

    Args:
        pressure: pressure over E at the nodes, (N,) [-].
        doubt: error to expect of it, over E, (N,) [-].
        outside: mask of the nodes that see what no training contact had, (N,).
    """

    pressure: np.ndarray
    doubt: np.ndarray
    outside: np.ndarray


NOTHING = Held(np.empty(0), np.empty(0), np.empty(0, np.bool_))


class Look(NamedTuple):
    """What is known of contact nodes before the network.

    Args:
        pressure: pressure over E of the linear layer, with the barrier, (N,) [-].
        inputs: what the network reads, (N, NODE.size) float32.
        fade: share of the network's correction, (N,) [-].
    """

    pressure: np.ndarray
    inputs: np.ndarray
    fade: np.ndarray


class ContactNet:
    """Signorini's problem on the linear layer, corrected at every node by a network that sees the pressure around it.

    The linear problem finds the area and most of the force (stmpl_core.obstacle). What is left is not linear: by
    dimensional analysis a ratio of pressures that depends on the pressure around a node in units of the thickness, on
    nu and on the skin's curvature; so one network serves every stiffness, thickness, pose and limb. It was trained on
    tools that stick, pressed in along a line (studies.train_contact).

    Beyond LINEAR_TO of the thickness the problem is solved there, and each node's pressure rises as its confined
    column's to the power HARDENING: it never falls as the tool goes deeper.

    Args:
        layer: soft layer at rest.
        weights: trained network; None: the one that comes with the package.
        near: neighbours of its vertices; None: found here.
    """

    def __init__(self, layer: SoftLayer, weights: Weights | None = None, near: Surroundings | None = None) -> None:
        self.near = near or Surroundings.of(layer)
        self._weights = weights
        tissue = layer.tissue
        self._nu = tissue.poisson_ratio
        self._moduli = np.array([tissue.shear_modulus, tissue.lame_lambda]) / tissue.youngs_modulus
        self._top = column_pressure(self._moduli, LINEAR_TO)

    @property
    def weights(self) -> Weights:
        """The trained network; only `hold` needs it."""
        if self._weights is None:
            self._weights = shipped("contact_net")
        return self._weights

    def look(self, nodes: Nodes) -> Look:
        """Solves the linear problem at the nodes, at least one, and gathers what the network reads."""
        group = self.near.groups(nodes.corners[:, 0])
        linear = held_off(nodes.points, nodes.inward, nodes.thickness, nodes.area, nodes.strain, LINEAR_TO, self._nu,
                          group)  # fmt: skip
        deep = np.maximum(nodes.strain, LINEAR_TO)
        rise = (column_pressure(self._moduli, deep) / self._top) ** HARDENING
        bent = np.einsum("nc,ncx->nx", nodes.shares, self.near.bent[nodes.corners])
        inputs = np.empty((len(deep), NODE.size), np.float32)
        _inputs(*linear, nodes.strain, nodes.inward, bent, self._nu, inputs)
        around = nodes.strain + linear.moments[:, 1, FADE_RING]
        return Look(linear.pressure * rise, inputs, around / (around + FADE))

    def hold(self, nodes: Nodes) -> Held:
        """Pressure at contact nodes."""
        many = len(nodes.area)
        if not many:
            return NOTHING
        a, look = self.weights.arrays, self.look(nodes)
        kept = np.clip(look.inputs, a["low"], a["high"])
        outside = (kept != look.inputs).any(axis=1)
        outputs = np.empty((many, PRESSURE.size), np.float32)
        think_few((kept - a["mean"]) * a["scale"], a["w1"], a["b1"], a["w2"], a["b2"], a["w3"], a["b3"], a["w4"],
                  a["b4"], outputs)  # fmt: skip
        log_ratio = np.clip(outputs[:, PRESSURE.at.log_ratio].astype(float), -MAX_LOG_RATIO, MAX_LOG_RATIO)
        held = look.pressure * np.exp(look.fade * log_ratio)
        return Held(held, held * np.exp(np.minimum(outputs[:, PRESSURE.at.log_error], 1.0)), outside)


@numba.njit(cache=True, error_model="numpy")
def _inputs(pressure, moments, vectors, strain, inward, bent, nu, out):
    """Rows of NODE: numbers that do not turn with the scene."""
    for n in range(len(out)):
        row = out[n]
        row[AT.log_pressure], row[AT.pressure] = np.log(pressure[n] + 1e-3), pressure[n]
        row[AT.log_strain], row[AT.strain] = np.log(strain[n] + 1e-3), strain[n]
        for s in range(2):
            for m in range(RINGS):
                row[AT.log_moments + s * RINGS + m] = np.log(moments[n, s, m] + 1e-4)
        n0, n1, n2 = inward[n, 0], inward[n, 1], inward[n, 2]
        together = 0.0
        for s in range(2):
            v = vectors[n, s]
            up = v[0] * n0 + v[1] * n1 + v[2] * n2
            for x in range(3):
                v[x] = (v[x] - up * inward[n, x]) / (moments[n, s, 1] + 1e-4)
            row[AT.vector_sizes + s] = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        v, square = vectors[n, 0], 1e-6
        for x in range(3):
            together += v[x] * vectors[n, 1, x]
            square += v[x] * v[x]
        row[AT.vectors_together] = together
        trace = bent[n, 0] + bent[n, 4] + bent[n, 8]
        whole = along = slope = slopes = 0.0
        for x in range(3):
            slope += bent[n, 9 + x] * v[x]
            slopes += bent[n, 9 + x] ** 2
            for y in range(3):
                whole += bent[n, 3 * x + y] ** 2
                along += v[x] * bent[n, 3 * x + y] * v[y]
        row[AT.mean_curvature], row[AT.squared_bend] = 0.5 * trace, 0.5 * whole - 0.25 * trace * trace
        row[AT.curvature_along_vector] = along / square - 0.5 * trace
        row[AT.slope_along_vector], row[AT.squared_slope] = slope / np.sqrt(square), slopes
        row[AT.poisson_ratio], row[AT.volumetric] = nu, 1 / (1.02 - 2 * nu)
