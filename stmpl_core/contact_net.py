"""ContactNet: the pressure with which a layer holds a rigid tool: of a linear layer, then corrected by a network."""

from __future__ import annotations

import math
from copy import copy
from functools import cached_property
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import float32, float64, int64

from stmpl_core.columns import pushed
from stmpl_core.green import Green, compile_matrix
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.moment_net import think_few
from stmpl_core.moments import Surroundings
from stmpl_core.networks import ARRAYS, NODE, PRESSURE, STACK_NODE, Weights, shipped
from stmpl_core.nodes import Nodes
from stmpl_core.obstacle import (
    ONE_THREAD,
    RINGS,
    columns_of,
    moments_of,
    nearer,
    pairs,
    powers_of,
    rates_of,
    response,
    rings_of,
    solve,
)
from stmpl_core.rays import column_pressure
from stmpl_core.twins import crowded

MAX_LOG_RATIO = 2.5  # largest |log| of pressure over that of the linear layer [-]
AT, SAY, NODES_SEE = NODE.at, PRESSURE.at, NODE.size  # first columns, constants to numba
ON_STACK, STACKS_SEE, SEEN_ALIKE = STACK_NODE.at, STACK_NODE.size, STACK_NODE.at.log_thickness
LINEAR_TO = 0.6  # strain to which contact is solved; beyond it the columns' barrier takes over
STACK_LINEAR_TO = 0.85  # likewise, on a stack
DEEP_GIVES = 0.6  # share that a stack's hardening loses per strain: a tool that goes deep has shoved tissue aside
ROUND_GIVES = 1.5  # share that it loses per thickness over the limb's radius, on whose sides tissue makes room
ROUNDEST = 0.45  # thickness over radius up to which it does
HARDENING = 0.75  # power of the columns' pressure with which it does
FADE, FADE_RING = 0.03, 2  # strain at and around a node at which half of the correction is left: a touch begins linear
AMONG = 3.0  # distance over the thickness up to which a node knows how the limb is shaped under what presses
TURNED_FROM = 3e-3  # turn of normals from which it counts
ROUND_FROM = 0.05  # overlap over the thickness to which curvature is compared at the least
SMALL_STEP = 5e-3  # of the largest force, in which the network's part of a slope is found: far above float32's noise
APART = 1e-3  # depth, relative, that skin may miss beside other tools and still be off a tool that does not press
FAR_OUTSIDE = 0.3  # standard deviations beyond the training contacts, from which a node is all outside
LITTLE = 0.1  # share of its correction up to which a network says next to nothing, and need not know what it sees
THIN_NEAR, THIN_FAR = (-1.4, -1.5), (-4.3, -4.0)  # log of the share of the nearest and third ring that is pressed
THIN_FELT, THIN_DEEP = (0.02, 0.04), (0.12, 0.2)  # strains from which that widens the bound, and is flagged
THIN_DOUBT = 17.0  # factor on the doubt that it adds, of which the bound grows with the square root
DOMED, TOO_DOMED = (0.1, 0.24), (0.17, 0.2)  # curvature over 1 / thickness both ways from which skin that is round like
DOMED_DOUBT = 16.0  # a ball widens the bound, by this factor at the second; and from which it is flagged
PLATE, PLATE_DEEP = (-5.2, -5.6), (0.1, 0.65)  # what the network reads of the turn of normals where they turn by 4 and
# by 2 degrees, from which a stack is less and more a plate; and
PLATE_DOUBT, PLATE_KAPPA, PLATE_ANYHOW = 24.0, (1.8, 0.0), 0.15  # strain of columns, and log of kappa, between which
# its bound grows; and the share of that of any kappa
STACK_FADE = 0.1  # the same on a stack, whose linear response alone is good to some percent up to there
FAR_TOOLS = 1.0, 2.0  # distance of two tools' middles over their radii of gyration and the thickness under both, up to
# which one's work counts in full with the other's, and from which not at all


class Held(NamedTuple):
    """Pressure that holds the skin against a tool, and its doubt.

    Args:
        pressure: pressure over E at the nodes, (N,) [-].
        doubt: error to expect of it, over E, (N,) [-].
        outside: degree to which the nodes see what no training contact had, from 0 to 1, (N,) [-]; 0 in a first touch.
        shells: share of the linear work by which a limb is stiffer than its flat stack, (N,) [-]; stiff skin around it
            stands up like a shell, until it is dented. Empty of one material.
        powers: power of the depth with which the force of each node's tool grows, about, (N,) [-].
        missed: how far the linear problem is from solved, over the depth [-]: see obstacle.solve.
    """

    pressure: np.ndarray
    doubt: np.ndarray
    outside: np.ndarray
    shells: np.ndarray
    powers: np.ndarray
    missed: float = 0.0

    def some(self, start: int, end: int) -> Held:
        """Of the nodes from `start` on, up to `end`."""
        return Held(self.pressure[start:end], self.doubt[start:end], self.outside[start:end], self.shells[start:end],
                    self.powers[start:end], self.missed)  # fmt: skip

    @property
    def shell(self) -> float:
        """Of one tool, see above."""
        return float(self.shells[0]) if len(self.shells) else 0.0

    @property
    def power(self) -> float:
        """Of one tool, see above."""
        return float(self.powers[0]) if len(self.powers) else 1.0


NO_NODES = np.empty(0)
NOTHING = Held(NO_NODES, NO_NODES, NO_NODES, NO_NODES, NO_NODES)


class Look(NamedTuple):
    """What is known of contact nodes before the network.

    Args:
        pressure: pressure over E of the linear layer, with the barrier, (N,) [-].
        inputs: what the network reads, (N, NODE.size) float32; or STACK_NODE.size, of which old networks read less.
        fade: share of the network's correction, (N,) [-].
        powers: power of the depth with which the force of each node's tool grows on the linear layer, (N,) [-].
        missed: see Held.
    """

    pressure: np.ndarray
    inputs: np.ndarray
    fade: np.ndarray
    powers: np.ndarray
    missed: float


class Solved(NamedTuple):
    """The linear problem at contact nodes, as a touch leaves it to its model.

    Args:
        matrix, rings: those of stmpl_core.obstacle.pairs, or a stack's.
        force: forces over E that solve it, (N,).
        times, over: see `crowded`, (N,).
        given_way: see `_given_way`, (N,); none of one material.
        weights, what: see `_among`; None of one material.
    """

    matrix: np.ndarray
    rings: np.ndarray
    force: np.ndarray
    times: np.ndarray
    over: np.ndarray
    given_way: np.ndarray = np.empty(0)
    weights: np.ndarray | None = None
    what: np.ndarray | None = None


class ContactNet:
    """Signorini's problem on the linear layer, corrected at every node by a network that sees the pressure around it.

    The linear problem finds the area and most of the force (stmpl_core.obstacle). What is left is not linear: by
    dimensional analysis a ratio of pressures that depends on the pressure around a node in units of the thickness, on
    nu and on the skin's curvature; so one network serves every stiffness, thickness, pose and limb. It was trained on
    tools that stick, pressed in along a line (studies.train_contact).

    A stack, and columns that run to bone, have a linear response of their own (stmpl_core.green), and a network of
    their own that also reads kappa, T / (E t) and how thick the tissue is; its units are those of the effective layer.

    Beyond LINEAR_TO of the thickness the problem is solved there, and each node's pressure rises as its confined
    column's to the power HARDENING: it never falls as the tool goes deeper. A stack's pressure is that of the linear
    problem times its confined column's hardening to the power (1 - DEEP_GIVES strain) (1 - ROUND_GIVES curvature), up
    to STACK_LINEAR_TO: fitted to finite elements' forces on limbs and flat stacks; it is within 3 % of the mean at
    every depth, of limbs that it was not fitted to as well, before the network says anything.

    Args:
        layer: soft layer at rest.
        weights: trained network; None: the one that comes with the package.
        near: neighbours of its vertices; None: found here.

    Attributes:
        network: name of the network that belongs to the layer.
        unit: modulus in which its range of pressures is counted [Pa].
    """

    def __init__(self, layer: SoftLayer, weights: Weights | None = None, near: Surroundings | None = None) -> None:
        self.near = near or Surroundings.of(layer)
        self._weights = weights
        tissue = layer.tissue
        self._nu = tissue.poisson_ratio
        self._moduli = np.array([tissue.shear_modulus, tissue.lame_lambda]) / tissue.youngs_modulus
        self._table = response(self._nu)
        self.network, self.unit, self._green = "contact_net", tissue.youngs_modulus, None
        self._last: tuple[Nodes, Solved] | None = None
        if layer.stacked:
            self._green = Green.of(layer)
            one = self._green.effective
            self.network, self.unit = "stack_contact_net", one.youngs_modulus

    def moved(self, near: Surroundings, green: Green | None) -> ContactNet:
        """The same law where joints take the skin."""
        out = copy(self)
        out.near, out._green, out._last = near, green, None
        return out

    @property
    def weights(self) -> Weights:
        """The trained network; only `hold` needs it."""
        if self._weights is None:
            self._weights = shipped(self.network)
        return self._weights

    @cached_property
    def _network(self) -> tuple[np.ndarray, ...]:
        return tuple(self.weights.arrays[name] for name in ARRAYS["pressure"])

    def unlike(self, thickness: float) -> float:
        """|log| of the tissue's mean thickness under a contact [m], over the limb's median; 0 of one material."""
        return abs(self.thicker(thickness))

    def thicker(self, thickness: float) -> float:
        """Logarithm of the same; 0 of one material."""
        return 0.0 if self._green is None else math.log(thickness / self._green.thickness)

    def look(self, nodes: Nodes) -> Look:
        """Solves the linear problem at the nodes, at least one, and gathers what the network reads."""
        return self._looked(nodes)[0]

    def _looked(self, nodes: Nodes) -> tuple[Look, Solved]:
        """See `look` and `_solved`."""
        group, bent = self.near.groups(nodes.corners[:, 0]), self.near.bent_at(nodes.corners)
        found: tuple[Any, ...]
        if self._green is None:
            found = _look(*nodes[:7], nodes.beside, group, bent, *self._table, self._moduli, self._nu)
        else:
            matrices = self._green.matrices(nodes, group)
            found = _look_on_stack(*nodes, group, bent, self._table.rows, self._nu, *matrices,
                                   self._green.effective.thickness, self._green.numbers,
                                   *self._green.hardening)  # fmt: skip
        seen, solved = Look(*found[:5]), Solved(*found[5:])
        self._last = nodes, solved
        return seen, solved

    def _solved(self, nodes: Nodes) -> Solved:
        """The linear problem at the nodes, known after a touch."""
        last = self._last  # another thread may write it
        if last is None or not all(np.array_equal(getattr(last[0], one), getattr(nodes, one))
                                   for one in ("points", "strain", "sinking")):  # fmt: skip
            return self._looked(nodes)[1]
        return last[1]

    def hold(self, nodes: Nodes) -> Held:
        """Pressure at contact nodes."""
        if not len(nodes.area):
            return NOTHING
        look, solved = self._looked(nodes)
        pressure, doubt, outside = _correct(*look[:3], *self._network)
        if self._green is None:
            _unlike(look.inputs, doubt, outside)
        else:
            _on_plates(look.inputs, doubt)
        return Held(pressure / solved.times, doubt / solved.times, outside, -solved.given_way, look.powers, look.missed)

    def apart(self, nodes: Nodes) -> np.ndarray:
        """Mask of contact nodes at which the skin lies further in than their tool's surface, (N,)."""
        solved = self._solved(nodes)
        most = STACK_LINEAR_TO if self._green is not None else LINEAR_TO
        depth = nodes.depths * np.minimum(most / nodes.strain, 1.0)
        sunk = solved.matrix @ solved.force * (1.0 if self._green is not None else nodes.thickness.mean())
        return (solved.force == 0) & (sunk > (1 - APART) * depth)

    def slopes(self, nodes: Nodes, strain_rates: np.ndarray, sinking_rates: np.ndarray, gone: np.ndarray,
               ends: np.ndarray) -> np.ndarray:  # fmt: skip
        """Rates of the pressures that `hold` gives, as depths change at nodes that go with their tools, (K, N).

        The linear problem's follow from its active set A: G_AA df_A = dd_A. The network's part is a difference over a
        small step along that.

        Args:
            nodes: contact nodes, at least one.
            strain_rates: rates of their strains in each of K ways, (K, N).
            sinking_rates: rates of their depths [m], or on a stack of `sinking`, likewise.
            gone: rates of their places, (K, N, 3) [m].
            ends: where the nodes of each of M tools begin, and N, (M + 1,).
        """
        bent, solved = self.near.bent_at(nodes.corners), self._solved(nodes)
        rates = strain_rates, sinking_rates, nearer(solved.matrix, solved.force, nodes.points, nodes.inward, gone, ends)
        if self._green is None:
            return _slopes(*nodes[:7], bent, *solved[:5], self._moduli, self._nu, *rates, *self._network)
        return _slopes_on_stack(*nodes[:8], bent, *solved, self._nu, self._green.effective.thickness,
                                self._green.numbers, *self._green.hardening, *rates, *self._network)  # fmt: skip


def compile_on_stacks() -> None:
    """Compiles what says how a stack holds a tool whose nodes are known: an eighth of what a first start does."""
    numbers, table, layer, rows = float64[::1], float64[:, ::1], float32[::1], float32[:, ::1]
    nodes = table, table, numbers, numbers, numbers, int64[:, ::1], table, numbers, table
    compile_matrix()
    _look_on_stack.compile((*nodes, int64[::1], table, table, float64, table, table, float64, numbers, numbers, table,
                            table))  # fmt: skip
    _correct.compile((numbers, rows, numbers, *4 * [layer], *4 * [rows, layer]))
    _on_plates.compile((rows, numbers))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look(points, inward, thickness, area, strain, corners, shares, beside, group, bent, half_space, rows, moduli, nu):
    """See Look."""
    mean, here = thickness.mean(), _between(corners, shares, bent)
    matrix, rings = pairs(points, inward, thickness, area, group, mean, half_space, rows)
    depth = np.minimum(strain, LINEAR_TO) * thickness / mean
    force, missed = solve(matrix, depth)
    pressure = force * mean**2 / area
    times, over = crowded(points, inward, area, strain, beside, force)
    moments, vectors = moments_of(rings, points, thickness, area, _one(pressure), _one(strain / over))
    seen = _see(moments[0], vectors[0], inward, area, times * pressure, strain, here, moduli, nu)
    powers = powers_of(matrix, force, depth, _tool_of(beside, len(area)), max(beside.shape[1], 1))
    return *seen, powers, missed, matrix, rings, force, times, over


@numba.njit(cache=True, error_model="numpy")
def _one(values):
    """Values (N,) of one case, (1, N)."""
    return values.copy().reshape(1, len(values))


@numba.njit(cache=True, error_model="numpy")
def _see(moments, vectors, inward, area, pressure, strain, bent, moduli, nu):
    """Pressure, inputs and fade of a Look, from pressures over E before they harden, and what nodes see around them."""
    inputs = np.empty((len(area), NODES_SEE), np.float32)
    _inputs(pressure, moments, vectors, strain, inward, bent, nu, inputs)
    _harden(pressure, strain, moduli)
    return pressure, inputs, _faded(strain, moments, FADE)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_on_stack(points, inward, thickness, area, strain, corners, shares, sinking, beside, group, bent, rows, nu,
                   matrix, wide, t, numbers, log_thickness, hardening, alike):  # fmt: skip
    """See Look; t: thickness of the effective layer [m]; numbers and what follows: those of a Green."""
    rings, here = rings_of(points, inward, t, group, rows), _between(corners, shares, bent)
    depth = sinking * np.minimum(STACK_LINEAR_TO / strain, 1.0)
    force, missed = solve(matrix, depth)
    times, over = crowded(points, inward, area, strain, beside, force)
    moments, vectors = moments_of(rings, points, np.full(len(area), t), area,
                                  _one(np.exp(numbers[3]) * (force / area)), _one(sinking / over / t))  # fmt: skip
    of = _tool_of(beside, len(area))
    near = _near_tools(points, inward, thickness, area, strain, of, max(beside.shape[1], 1))
    given_way, among = _given_way(matrix, wide, force, near, of), _among(points, inward, thickness, group, t, force)
    shape = _shape(*among, force)
    seen = _see_on_stack(moments[0], vectors[0], inward, thickness, area, t, times * force, strain, sinking, here, nu,
                         numbers, log_thickness, hardening, _between(corners, shares, alike),
                         given_way, shape)  # fmt: skip
    powers = powers_of(matrix, force, depth, of, len(near))
    return *seen, powers, missed, matrix, rings, force, times, over, given_way, *among


@numba.njit(cache=True, error_model="numpy")
def _see_on_stack(moments, vectors, inward, thickness, area, t, force, strain, sinking, bent, nu, numbers,
                  log_thickness, hardening, alike_at, given_way, shape):  # fmt: skip
    """Pressure, inputs and fade of a Look under forces (N,) over E [m2], and what nodes see around them."""
    softness, pressure, overlap = np.exp(numbers[3]), force / area, sinking / t
    alike, inputs = np.empty((len(area), NODES_SEE), np.float32), np.empty((len(area), STACKS_SEE), np.float32)
    _inputs(softness * pressure, moments, vectors, overlap, inward, bent, nu, alike)
    for n in range(len(area)):
        row = inputs[n]
        row[:SEEN_ALIKE] = alike[n, :SEEN_ALIKE]
        row[ON_STACK.log_thickness], row[ON_STACK.column_strain] = np.log(thickness[n] / t), strain[n]
        row[ON_STACK.log_kappa], row[ON_STACK.log_pull] = numbers[1], numbers[2]
        as_thick = alike_at[n, 0]
        row[ON_STACK.hardening] = _hardening(log_thickness, hardening, as_thick, sinking[n] / thickness[n])
        row[ON_STACK.curvature] = alike[n, AT.mean_curvature]
        row[ON_STACK.curvature_over_strain] = alike[n, AT.mean_curvature] / (overlap[n] + ROUND_FROM)
        row[ON_STACK.given_way] = given_way[n]
        row[ON_STACK.turned], row[ON_STACK.uneven] = shape[n]
        row[ON_STACK.stiffening], row[ON_STACK.stiffening + 1] = alike_at[n, 1], alike_at[n, 2]
        solved = min(strain[n], STACK_LINEAR_TO)
        top = _hardening(log_thickness, hardening, as_thick, solved)
        pressure[n] *= np.exp(_share(solved, row[ON_STACK.curvature]) * top)
        if strain[n] > solved:
            there = _hardening(log_thickness, hardening, as_thick, strain[n])
            pressure[n] *= (strain[n] / solved * np.exp(there - top)) ** HARDENING
    return pressure, inputs, _faded(overlap, moments, STACK_FADE)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _among(points, inward, thickness, group, t, force):
    """How each node counts what presses around it: weights (N, M) of the M nodes that press under forces (N,), and of
    each its number, the log of its thickness over t, that squared, and its normal, (M, 6)."""
    bears = np.flatnonzero(force > 0)
    by, logs, reach = columns_of(points[bears], inward[bears]), np.log(thickness[bears] / t), 1 / (AMONG * t) ** 2
    weights, what = np.zeros((len(force), len(bears))), np.empty((len(bears), 6))
    what[:, 0], what[:, 1], what[:, 2] = bears, logs, logs * logs
    for x in range(3):
        what[:, 3 + x] = by[3 + x]
    for i in range(len(force)):
        n, at, row = inward[i], points[i], weights[i]
        for j in range(len(bears)):
            if group[bears[j]] == group[i]:
                away = (by[0, j] - at[0]) ** 2 + (by[1, j] - at[1]) ** 2 + (by[2, j] - at[2]) ** 2
                near = max(1 - away * reach, 0.0)
                row[j] = near * near * max(by[3, j] * n[0] + by[4, j] * n[1] + by[5, j] * n[2], 0.0)
    return weights, what


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shape(weights, what, force):
    """How the limb is shaped under forces (N,) around each node, (N, 2) [-]; the first two from `_among`.

    log of how far normals turn from their mean there; and the standard deviation of the log of the thickness.
    """
    sources, out = np.empty_like(what), np.empty((len(force), 2))
    for j in range(len(what)):
        share = force[int(what[j, 0])]
        sources[j] = share * what[j]
        sources[j, 0] = share
    block = max(1, ONE_THREAD // (6 * max(len(what), 1)))
    for start in range(0, len(force), block):
        for i, sums in enumerate(np.dot(weights[start : start + block], sources), start):
            total = sums[0]
            if total > 0:
                mean, way = sums[1] / total, np.sqrt(sums[3] ** 2 + sums[4] ** 2 + sums[5] ** 2)
                out[i, 0] = np.log(max(1 - way / total, 0.0) + TURNED_FROM)
                out[i, 1] = np.sqrt(max(sums[2] / total - mean * mean, 0.0))
            else:
                out[i, 0], out[i, 1] = np.log(TURNED_FROM), 0.0
    return out


@numba.njit(cache=True, error_model="numpy")
def _tool_of(beside, count):
    """Number of the tool of each of so many nodes, (N,); beside: see Nodes."""
    of = np.zeros(count, np.int64)
    for n in range(len(beside)):
        for k in range(beside.shape[1]):
            if beside[n, k] < 0:
                of[n] = k
    return of


@numba.njit(cache=True, error_model="numpy")
def _near_tools(points, inward, thickness, area, strain, of, many):
    """How near tools are to each other, from 0, far, to 1, (K, K).

    Args:
        points, inward, thickness, area, strain: see Nodes.
        of, many: see `_tool_of`, and number of tools.
    """
    out = np.ones((many, many))
    if many == 1:
        return out
    told, reach = np.empty((many, 8)), np.empty(many)
    for k in range(many):
        some = np.flatnonzero(of == k)
        told[k] = pushed(points[some], inward[some], thickness[some], area[some], strain[some])
        reach[k] = told[k, 7] + np.sum(area[some] * strain[some] * thickness[some] ** 2) / max(told[k, 0], 1e-300)
    for k in range(many):
        for m in range(many):
            square = 0.0
            for x in range(3):
                square += (told[k, 4 + x] - told[m, 4 + x]) ** 2
            apart = np.sqrt(square) / max(reach[k] + reach[m], 1e-12)
            share = min(max((FAR_TOOLS[1] - apart) / (FAR_TOOLS[1] - FAR_TOOLS[0]), 0.0), 1.0)
            out[k, m] = share * share * (3 - 2 * share) if k != m else 1.0
    return out


@numba.njit(cache=True, error_model="numpy")
def _given_way(matrix, wide, force, near, of):
    """Share of the work of the forces (N,) of each node's tool, and of tools near it, that the coarse part of their
    response does, (N,) [-].

    Args:
        matrix, wide: response to the forces, and its coarse part, (N, N).
        near, of: see `_near_tools` and `_tool_of`.
    """
    many, out = len(near), np.empty(len(force))
    coarse, whole = np.zeros((many, many)), np.zeros((many, many))
    for i in range(len(force)):
        if force[i] > 0:
            for j in range(len(force)):
                coarse[of[i], of[j]] += force[i] * wide[i, j] * force[j]
                whole[of[i], of[j]] += force[i] * matrix[i, j] * force[j]
    for k in range(many):
        some = every = 0.0
        for a in range(many):
            for b in range(many):
                some += near[k, a] * near[k, b] * coarse[a, b]
                every += near[k, a] * near[k, b] * whole[a, b]
        for i in range(len(force)):
            if of[i] == k:
                out[i] = some / max(every, 1e-300)
    return out


@numba.njit(cache=True, error_model="numpy")
def _reached(sinking, strain, sinking_rates, strain_rates, linear_to):
    """Rates (K, N) of the depths up to a strain [m] for which the linear problem is solved."""
    out = np.empty_like(strain_rates)
    for k in range(len(out)):
        for n in range(len(strain)):
            over = strain[n] > linear_to
            slower = sinking[n] / strain[n] * strain_rates[k, n] if over else 0.0
            out[k, n] = (linear_to / strain[n] if over else 1.0) * (sinking_rates[k, n] - slower)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _slopes(points, inward, thickness, area, strain, corners, shares, bent, matrix, rings, force, times, over, moduli,
            nu, strain_rates, sinking_rates, sunk, low, high, mean, scale, w1, b1, w2, b2, w3, b3, w4, b4):  # fmt: skip
    """See ContactNet.slopes; sunk: what `nearer` gives."""
    unit, here = thickness.mean(), _between(corners, shares, bent)
    reached = _reached(strain * thickness, strain, sinking_rates, strain_rates, LINEAR_TO)
    rates = rates_of(matrix, force, reached / unit - sunk)
    steps = _steps(force, rates, strain, strain_rates)
    pressures, strains = _stepped(force, rates, steps, 0.0) * unit**2 / area, _stepped(strain, strain_rates, steps, 0.0)
    moments, vectors = moments_of(rings, points, thickness, area, pressures, strains / over)
    held = np.empty_like(pressures)
    for k in range(len(held)):
        seen = _see(moments[k], vectors[k], inward, area, times * pressures[k], strains[k], here, moduli, nu)
        held[k] = _correct(*seen, low, high, mean, scale, w1, b1, w2, b2, w3, b3, w4, b4)[0] / times
    return _differences(held, steps)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _slopes_on_stack(points, inward, thickness, area, strain, corners, shares, sinking, bent, matrix, rings, force,
                     times, over, given_way, weights, what, nu, t, numbers, log_thickness, hardening, alike,
                     strain_rates, sinking_rates, sunk, low, high, mean, scale, w1, b1, w2, b2, w3, b3, w4,
                     b4):  # fmt: skip
    """See ContactNet.slopes; sunk: what `nearer` gives."""
    here = _between(corners, shares, bent)
    rates = rates_of(matrix, force, _reached(sinking, strain, sinking_rates, strain_rates, STACK_LINEAR_TO) - sunk)
    alike_at = _between(corners, shares, alike)
    steps = _steps(force, rates, strain, strain_rates)
    forces, strains = _stepped(force, rates, steps, 0.0), _stepped(strain, strain_rates, steps, 1e-9)
    depths = _stepped(sinking, sinking_rates, steps, 0.0)
    moments, vectors = moments_of(rings, points, np.full(len(area), t), area, np.exp(numbers[3]) * (forces / area),
                                  depths / over / t)  # fmt: skip
    held = np.empty_like(forces)
    for k in range(len(held)):
        seen = _see_on_stack(moments[k], vectors[k], inward, thickness, area, t, times * forces[k], strains[k],
                             depths[k], here, nu, numbers, log_thickness, hardening, alike_at,
                             given_way, _shape(weights, what, forces[k]))  # fmt: skip
        held[k] = _correct(*seen, low, high, mean, scale, w1, b1, w2, b2, w3, b3, w4, b4)[0] / times
    return _differences(held, steps)


@numba.njit(cache=True, error_model="numpy")
def _steps(force, rates, strain, strain_rates):
    """Steps of K differences, (K,): neither force nor strain changes by more than SMALL_STEP of its largest."""
    out = np.empty(len(rates))
    for k in range(len(rates)):
        fastest = max(np.abs(rates[k]).max() / force.max(), np.abs(strain_rates[k]).max() / strain.max())
        out[k] = SMALL_STEP / max(fastest, 1e-12)
    return out


@numba.njit(cache=True, error_model="numpy")
def _stepped(values, rates, steps, least):
    """Values (N,) as they are, and after each of K steps at their rates (K, N), not below the least, (K + 1, N)."""
    out = np.empty((len(steps) + 1, len(values)))
    out[0] = values
    for k in range(len(steps)):
        out[k + 1] = np.maximum(values + steps[k] * rates[k], least)
    return out


@numba.njit(cache=True, error_model="numpy")
def _differences(held, steps):
    """Rates (K, N) from values (K + 1, N) as they are and after each step."""
    out = np.empty((len(steps), held.shape[1]))
    for k in range(len(steps)):
        out[k] = (held[k + 1] - held[0]) / steps[k]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _share(strain, curvature):
    """Power of its column's hardening with which a stack's pressure grows up to a strain."""
    return (1 - DEEP_GIVES * strain) * (1 - ROUND_GIVES * min(max(curvature, 0.0), ROUNDEST))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hardening(logs, table, thickness, strain):
    """Value of Green.hardening at a thickness [m] and a strain."""
    a = (np.log(thickness) - logs[0]) / (logs[1] - logs[0])
    b = min(strain, 0.999) * table.shape[1]
    a, b = min(max(a, 0.0), len(logs) - 1.001), min(max(b, 0.0), table.shape[1] - 1.001)
    i, j = int(a), int(b)
    a, b = a - i, b - j
    return (1 - a) * ((1 - b) * table[i, j] + b * table[i, j + 1]) + \
        a * ((1 - b) * table[i + 1, j] + b * table[i + 1, j + 1])  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _between(corners, shares, values):
    """Values of vertices (V, K), interpolated at nodes, (N, K)."""
    out = np.zeros((len(corners), values.shape[1]))
    for n in range(len(corners)):
        for c in range(3):
            for x in range(values.shape[1]):
                out[n, x] += shares[n, c] * values[corners[n, c], x]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _faded(strain, moments, half):
    """Share of the network's correction at each node, (N,)."""
    out = np.empty(len(strain))
    for n in range(len(strain)):
        around = strain[n] + moments[n, 1, FADE_RING]
        out[n] = around / (around + half)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _harden(pressure, strain, moduli):
    """Lets pressures at strains beyond LINEAR_TO rise as those of confined columns."""
    top = column_pressure(moduli, LINEAR_TO)
    for n in range(len(pressure)):
        if strain[n] > LINEAR_TO:
            pressure[n] *= (column_pressure(moduli, strain[n]) / top) ** HARDENING


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _correct(pressure, inputs, fade, low, high, mean, scale, w1, b1, w2, b2, w3, b3, w4, b4):
    """See Held."""
    count = len(pressure)
    held, doubt, outside = np.empty(count), np.empty(count), np.zeros(count)
    kept, outputs = np.empty((count, len(low)), np.float32), np.empty((count, len(b4)), np.float32)
    for n in range(count):
        for m in range(len(low)):
            value = min(max(inputs[n, m], low[m]), high[m])
            if fade[n] > LITTLE:
                outside[n] = max(outside[n], min(abs(inputs[n, m] - value) * scale[m] / FAR_OUTSIDE, 1.0))
            kept[n, m] = (value - mean[m]) * scale[m]
    think_few(kept, w1, b1, w2, b2, w3, b3, w4, b4, outputs)
    for n in range(count):
        log_ratio = min(max(float(outputs[n, SAY.log_ratio]), -MAX_LOG_RATIO), MAX_LOG_RATIO)
        held[n] = pressure[n] * np.exp(fade[n] * log_ratio)
        doubt[n] = held[n] * np.exp(min(float(outputs[n, SAY.log_error]), 1.0))
    return held, doubt, outside


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unlike(inputs, doubt, outside):
    """Widens doubt and outside (N,) of nodes under what is long and thin, and of skin that is as round both ways.

    Training's limbs are round one way. Of balls and discs on skin round as a ball the network takes off up to 29 % too
    much at a curvature of 0.24 over the thickness, 20 at 0.2, 14 at 0.16 (axisymmetric finite elements).
    """
    for n in range(len(inputs)):
        row, around = inputs[n], AT.log_moments + RINGS
        thin = thinness(row[around] - row[AT.log_strain], row[around + 2] - row[AT.log_strain])
        doubt[n] *= 1 + THIN_DOUBT * thin * ramp(row[AT.strain], THIN_FELT)
        outside[n] = max(outside[n], thin * ramp(row[AT.strain], THIN_DEEP))
        both = row[AT.mean_curvature] - np.sqrt(max(row[AT.squared_bend], 0.0))
        doubt[n] *= 1 + DOMED_DOUBT * ramp(both, DOMED)
        outside[n] = max(outside[n], ramp(both, TOO_DOMED))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _on_plates(inputs, doubt):
    """Widens the doubt (N,) of nodes of a stack that is a flat plate.

    Stacks are of more kinds than were learnt, and no limb's shape makes up for that: balls of 10 and 20 mm on 16 stacks
    are 2.4 % off in the median, but up to 15 % at 0.65 of the thickness, on others 23 % (axisymmetric finite elements).
    """
    for n in range(len(inputs)):
        row = inputs[n]
        plate = ramp(row[ON_STACK.turned], PLATE) * ramp(row[ON_STACK.column_strain], PLATE_DEEP)
        share = PLATE_ANYHOW + (1 - PLATE_ANYHOW) * ramp(row[ON_STACK.log_kappa], PLATE_KAPPA)
        doubt[n] *= 1 + PLATE_DOUBT * plate * share


@numba.njit(cache=True, inline="always")
def thinness(near, far):
    """Degree to which what presses is thin and goes on aside, by logarithms of how much of two rings it covers.

    Wires, walls and blades: no training contact of one material had their like. Balls and pins are not there in the
    far ring, and broad tools fill the near one.
    """
    return ramp(near, THIN_NEAR) * ramp(far, THIN_FAR)


@numba.njit(cache=True, inline="always")
def ramp(value, ends):
    """0 at one of two values and before it, 1 at the other and beyond."""
    return min(max((value - ends[0]) / (ends[1] - ends[0]), 0.0), 1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
