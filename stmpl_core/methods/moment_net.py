"""MomentNet: the learned simulator: what presses around a vertex, through a small network, to how that vertex moves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numba
import numpy as np

from stmpl_core.errors import InvalidInput
from stmpl_core.green import Green
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import Method, prepared
from stmpl_core.methods.limb_linear import LimbLinear, linear_motion
from stmpl_core.methods.winkler import column_stretch
from stmpl_core.moments import Surroundings
from stmpl_core.networks import DIRECTIONS, INPUTS, MIXED_TENSORS, MIXED_VECTORS, MOTION, Kind, Weights, shipped
from stmpl_core.response import FAST, SCALARS, TENSORS, VECTORS
from stmpl_core.thinning import Asked
from stmpl_core.tissue import Tissue
from stmpl_core.trust import Displacement, Trust

IN, OUT, INPUTS_END = INPUTS.at, MOTION.at, INPUTS.size  # first columns, constants to numba
AMPLITUDE = 0.3  # largest addition of the network to the linear response, over t
SURROUNDED = 1e-7  # size of the moments below which nothing is added
FADE, RING = 1.5, 8.0  # size of the moments over the linear response, about 10 near a load: below, the answer fades
# into a multiple of the linear response, and up to where that multiple is measured: at 3 to 4 t from a load
GAINS = (0.5, 4.0)  # range of that multiple
EDGE_OVER_ROOT_AREA = 1.075  # ratio at a vertex of six equilateral triangles: sqrt(2 / sqrt(3))
COARSER = 1.2  # edges over those trained to which stacks are answered: 3 to 5 % of the peak off a fine mesh's answer
EVEN = 1.2  # widths of vertices over the median, at the tenth and the ninetieth percentile of an even mesh
OUTSIDE_SHARE = 0.3  # share of the moving vertices whose inputs may be unlike the training data (docs/networks.md)

BLOCK = 32  # vertices in one matrix product; OpenBLAS takes one thread for up to 2^18 multiplications


class MomentNet:
    """Linear response, corrected at every vertex by a network that sees the moments of the load around it.

    By dimensional analysis u / t = f(p / E around the vertex in units of t, nu, t times the curvature): so one network
    serves every stiffness exactly, and any thickness, pose and limb. The inputs are invariants of moments up to second
    order (as atomic descriptors are: Bartok et al., Phys. Rev. B 87, 184115, 2013), the outputs multiply the normal
    and the moments' own directions: turning the scene turns the answer. There is no chart, and so no seam. Where
    nothing presses within stmpl_core.response.NEAR thicknesses the answer is a multiple of the linear response, the one
    that the network says at that distance; it ends at REACH: no load gives exactly no motion.

    Args:
        weights: path of a .safetensors file made by `stmpl train`; None: those that come with the package.
        contact: weights for what rigid tools press with (Load.contact), given likewise.
        stick: weights for that where the load knows the linear motion of what sticks to the tools, given likewise.
        stack: weights for that on a stack, or on columns that run to bone, given likewise. Other loads on these are
            answered by LimbLinear.
        sticks: choice of a simulator: it tells that linear motion under contacts of few nodes. False: it never does on
            one material; fields take 0.8 to 1.1 of the time and are nearly twice as far off.
        fallback: method that answers loads outside the range that the network was trained on; None: the network's
            answer is given, and flagged.
        threads: number of threads of the kernels. Two are nearly twice as fast where two cores are idle, and stall for
            milliseconds where they are not.

    Raises:
        InvalidInput: weights that are missing, or threads below 1.
    """

    name = "moment_net"

    def __init__(
        self,
        weights: str | Path | Weights | None = None,
        *,
        contact: str | Path | Weights | None = None,
        stick: str | Path | Weights | None = None,
        stack: str | Path | Weights | None = None,
        sticks: bool = True,
        fallback: Method | None = None,
        threads: int = 1,
    ) -> None:
        if threads < 1:
            raise InvalidInput(f"threads is {threads}; at least 1 is needed.")
        self.threads = min(threads, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        self.weights, self.contact = _weights(weights, "moment_net"), _weights(contact, "moment_net_contact")
        self.stick, self.sticks = _weights(stick, "moment_net_stick"), sticks
        self._on_stack = stack
        self.fallback = fallback
        self._green: Green | None = None
        self._layer: SoftLayer | None = None
        self._near: Surroundings | None = None

    @property
    def contact_bound(self) -> Mapping[str, float] | None:
        """Figures of a bound on the motion under tools, see studies.judge_contact; None: not known."""
        return (self.contact if self._green is None else self.stack).card.get("contact_bound")

    @property
    def stick_bound(self) -> Mapping[str, float] | None:
        """The same where skin goes with its tools node by node."""
        return (self.stick if self._green is None else self.stack).card.get("contact_bound")

    @property
    def stack(self) -> Weights:
        """The network for stacks, read when one is met."""
        if not isinstance(self._on_stack, Weights):
            self._on_stack = _weights(self._on_stack, "stack_moment_net", "stack_motion")
        return self._on_stack

    def prepare(self, layer: SoftLayer) -> Self:
        """Finds each vertex's neighbours (half a second for a limb), and a stack's linear response (seconds).

        Raises:
            InvalidInput, MeshError: a stack's skin that cannot be meshed coarsely.
        """
        self._near = near = Surroundings.of(layer)
        many = len(near.thickness)
        self._shape, self._frames = np.empty((many, 5), np.float32), np.empty((many, 3, 3), np.float32)
        self._width = np.empty(many)
        _take_shape(near.curvature, near.slope, near.frames, near.thickness, layer.vertex_areas, self._shape,
                    self._frames, self._width)  # fmt: skip
        self._layer, self._green, self._unit = layer, None, layer.tissue
        if layer.stacked:
            self._green = Green.of(layer)
            self._unit = unit_of(self._green)
            self._linear = LimbLinear().prepare(layer)
        if self.fallback is not None:
            self.fallback.prepare(layer)
        return self

    def solve(self, load: Load) -> Displacement:
        """The displacement under `load`.

        Raises:
            NotPrepared: a call before `prepare`.
            InvalidInput: the load does not fit the layer.
        """
        layer = prepared(self._layer, self)
        assert self._near is not None
        if self._green is not None and load.kind != "contact":
            return self._linear.solve(load)
        pressure = load.check(layer).pressure_on(layer)
        before = numba.get_num_threads()
        numba.set_num_threads(self.threads)
        try:
            return self._solve(layer, self._near, load, pressure)
        finally:
            numba.set_num_threads(before)

    def _solve(self, layer: SoftLayer, near: Surroundings, load: Load, pressure: np.ndarray) -> Displacement:
        loaded = load.loaded
        sources, asked = source_fields(pressure, self._unit, loaded), near.asked_again(loaded)
        felt = near.felt(sources, asked, linear=load.motion is None and self._green is None)
        vertices, figures = felt.vertices, felt.figures
        weights = self.contact if load.kind == "contact" else self.weights
        more = np.empty((len(vertices), 0), np.float32)
        if self._green is not None:
            weights, displacement = self.stack, linear_motion(self._green, load)
            more = of_stack(self._green, vertices, take_linear(figures, near, vertices, displacement))
        elif load.motion is not None:
            weights, displacement = self.stick, load.motion.copy()
            take_linear(figures, near, vertices, displacement)
        else:
            displacement = np.zeros_like(layer.vertices)
        a, constants = weights.arrays, np.array([layer.tissue.poisson_ratio, load.kind == "nodal"], np.float32)

        # What is around each vertex becomes numbers that do not turn with the scene; far vertices need none.
        some = _surrounded(figures)
        inputs = np.empty((len(some), INPUTS.size + more.shape[1]), dtype=np.float32)
        outside = np.zeros(len(vertices), dtype=np.bool_)
        invariants(some, figures, vertices, self._shape, sources, constants, more, a["mix_vectors"], a["mix_tensors"],
                   a["least"], a["most"], a["low"], a["high"], a["mean"], a["scale"], inputs, outside)  # fmt: skip

        # Three hidden layers.
        outputs = np.empty((len(some), MOTION.size), dtype=np.float32)
        through = think if self.threads > 1 else think_few
        through(inputs, a["w1"], a["b1"], a["w2"], a["b2"], a["w3"], a["b3"], a["w4"], a["b4"], outputs)

        # Each vertex moves along its normal and along the directions of what is around it.
        moved, error = np.empty((len(vertices), 3)), np.zeros(len(vertices), dtype=np.float32)
        _move(some, figures, vertices, self._shape, sources, outputs, a["mix_vectors"], a["mix_tensors"], self._frames,
              moved, error)  # fmt: skip
        asked.fill(moved, displacement)
        trust = self._trust(weights.card, load, pressure, asked, moved, outside, error)
        if not trust.in_range and self.fallback is not None:
            answer = self.fallback.solve(load)
            because = answer.trust.also(f"answered by {answer.method}: {trust.why}")
            return Displacement(answer.displacement, because, answer.method, answer.pressure)
        return Displacement(displacement, trust, self.name, pressure)

    def _trust(self, card: Mapping[str, Any], load: Load, pressure: np.ndarray, asked: Asked,
               moved: np.ndarray, outside: np.ndarray, doubt: np.ndarray) -> Trust:  # fmt: skip
        layer = prepared(self._layer, self)
        loaded = asked.loaded
        if not len(loaded):
            return Trust(error_bound=0.0)
        assert self._near is not None
        sound, pressed = self._near.sound, pressure[loaded]
        width = np.empty(len(moved))
        many, error, share, steep, long = _shares(
            moved, asked.vertices, asked.stand_for, outside, sound.steep, sound.long, doubt, self._near.thickness,
            self._width, width)  # fmt: skip
        if not many:  # a load so small that numbers cannot tell
            return Trust(error_bound=0.0)
        ratio = float(pressed.max()) / self._unit.youngs_modulus
        nu = layer.tissue.poisson_ratio
        fine, coarse = _tenths(width[:many])
        trust = Trust(figures={"peak_ratio": ratio, "outside_share": share, "expected_error_m": error})
        ranges = card["ranges"]
        for what, low, high in (
            (f"p_over_e_{load.kind}", min(ratio, 0.0), ratio),
            ("poisson_ratio", nu, nu),
            ("edge_over_thickness", EVEN * fine, coarse / EVEN),
        ):
            least, most = ranges[what]
            if self._green is not None and what == "edge_over_thickness":
                least, most = 0.0, COARSER * most  # forces come from nodes, whatever the mesh: finer is only better
            if low < least - 1e-3 * abs(least) or high > most + 1e-3 * abs(most):
                worst = high if high > most else low
                trust = trust.also(f"{what} is {worst:.3g}, trained is {least:.3g} to {most:.3g}", in_range=False)
        if pressed.min() < 0:
            trust = trust.also("the load pulls, the network was trained under pressure only", in_range=False)
        if share > OUTSIDE_SHARE:
            why = f"{share:.0%} of the vertices that move see what no training load had"
            trust = trust.also(why, in_range=False)
        for why in (*sound.of_mesh(steep, long, "the vertices that move"),
                    *sound.of_load(loaded, np.abs(pressed) * layer.vertex_areas[loaded])):  # fmt: skip
            trust = trust.also(why, in_range=False)
        bound = float(card["bound"]["factor"]) * error
        return Trust(trust.converged, trust.in_range, bound if trust.in_range else None, trust.why, trust.figures)


def _weights(given: str | Path | Weights | None, default: str, kind: Kind = "motion") -> Weights:
    return given if isinstance(given, Weights) else Weights.load(given, kind) if given else shipped(default)


def _tenths(values: np.ndarray) -> tuple[float, float]:
    """What a tenth of the values is below, and what a tenth is above."""
    last = len(values) - 1
    low, high = last // 10, last - last // 10
    ordered = np.partition(values, (low, high))
    return float(ordered[low]), float(ordered[high])


def unit_of(green: Green) -> Tissue:
    """The material of a stack's effective layer."""
    return Tissue(green.effective.youngs_modulus, green.layer.tissue.poisson_ratio)


def take_linear(figures: np.ndarray, near: Surroundings, vertices: np.ndarray, motion: np.ndarray) -> float:
    """Writes a linear response (V, 3) [m] into figures (N, S, WIDTH) of vertices (N,), and says its peak [m]."""
    return _take_linear(figures, near.frames, near.thickness, vertices, motion)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _take_shape(curvature, slope, frames, thickness, areas, shape, lengths, width):
    """Curvature and slope, (V, 5); frames times the thickness, (V, 3, 3); edges over it, (V,): of a skin's vertices."""
    for v in range(len(thickness)):
        for x in range(3):
            shape[v, x] = curvature[v, x]
            for y in range(3):
                lengths[v, x, y] = np.float32(frames[v, x, y]) * np.float32(thickness[v])
        shape[v, 3], shape[v, 4] = slope[v, 0], slope[v, 1]
        width[v] = EDGE_OVER_ROOT_AREA * np.sqrt(areas[v]) / thickness[v]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _take_linear(figures, frames, thickness, vertices, motion):
    most = 0.0
    for n in range(len(vertices)):
        v = vertices[n]
        most = max(most, motion[v, 0] ** 2 + motion[v, 1] ** 2 + motion[v, 2] ** 2)
        for k in range(3):
            along = frames[v, k, 0] * motion[v, 0] + frames[v, k, 1] * motion[v, 1] + frames[v, k, 2] * motion[v, 2]
            figures[n, :, k] = along / thickness[v]
    return np.sqrt(most)


def of_stack(green: Green, vertices: np.ndarray, peak: float) -> np.ndarray:
    """What the network reads of a stack at vertices (N,) under the peak of the linear motion [m]; see ON_STACK.

    Returns:
        (N, 8) float32.
    """
    out = np.empty((len(vertices), 8), np.float32)
    out[:, 0] = np.log(green.layer.thickness[vertices] / green.thickness)
    out[:, 1:5] = green.numbers
    out[:, 5] = np.log(peak / green.thickness + 1e-6)
    out[:, 6:] = green.hardening[2][vertices, 1:]
    return out


def source_fields(pressure: np.ndarray, tissue: Tissue, loaded: np.ndarray) -> np.ndarray:
    """The two fields that a vertex feels: p / E, and the strain of a confined column times M / E, (V, 2) [-].

    Args:
        pressure: pressure at each vertex, (V,) [Pa].
        tissue: material of the columns.
        loaded: numbers of the vertices where it is not 0, (L,).
    """
    sources = np.zeros((len(pressure), 2), dtype=np.float32)
    sources[loaded, 0] = pressure[loaded] / tissue.youngs_modulus
    strain = 1 - column_stretch(pressure[loaded], tissue)
    sources[loaded, 1] = strain * (tissue.confined_modulus / tissue.youngs_modulus)
    return sources


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _amplitude(figures):
    """How much presses around a vertex: the sum of its scalar moments of the second field."""
    g = np.float32(0)
    for m in range(SCALARS):
        g += abs(figures[1, 3 + m])
    return g


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _directions(figures, g, vectors, tensors):
    """The vectors (DIRECTIONS, 2) and tensors (2 TENSORS, 2) around a vertex, over the amplitude."""
    one = np.float32(1) / g
    for s in range(2):
        for m in range(VECTORS):
            vectors[s * VECTORS + m, 0] = figures[s, 3 + SCALARS + m] * one
            vectors[s * VECTORS + m, 1] = figures[s, 3 + SCALARS + VECTORS + m] * one
        vectors[2 * VECTORS + s, 0] = figures[s, 0] * one
        vectors[2 * VECTORS + s, 1] = figures[s, 1] * one
        for m in range(TENSORS):
            tensors[s * TENSORS + m, 0] = figures[s, 3 + SCALARS + 2 * VECTORS + m] * one
            tensors[s * TENSORS + m, 1] = figures[s, 3 + SCALARS + 2 * VECTORS + TENSORS + m] * one


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _mix(weights, vectors, out):
    """out = weights (rows, n) times vectors (n, 2)."""
    for a in range(weights.shape[0]):
        x = y = np.float32(0)
        for m in range(weights.shape[1]):
            x += weights[a, m] * vectors[m, 0]
            y += weights[a, m] * vectors[m, 1]
        out[a, 0], out[a, 1] = x, y


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _surrounded(figures):
    """Places of the vertices that something presses around."""
    out, many = np.empty(len(figures), np.int64), 0
    for n in range(len(figures)):
        if _amplitude(figures[n]) > np.float32(SURROUNDED):
            out[many] = n
            many += 1
    return out[:many]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shares(moved, vertices, stand_for, outside, steep, long, doubt, thickness, width, widths):
    """How many vertices move, the largest doubt [m], and the shares that are outside, steep and long of those.

    Each asked one counts for those that it stands for. Widths of the moving ones are written to `widths`.
    """
    most = error = 0.0
    for n in range(len(moved)):
        most = max(most, moved[n, 0] ** 2 + moved[n, 1] ** 2 + moved[n, 2] ** 2)
    least, many, total, sums = 0.02 * np.sqrt(most), 0, 0.0, np.zeros(3)
    for n in range(len(moved)):
        v = vertices[n]
        error = max(error, doubt[n] * thickness[v])
        if np.sqrt(moved[n, 0] ** 2 + moved[n, 1] ** 2 + moved[n, 2] ** 2) > least:
            widths[many] = width[v]
            many += 1
            total += stand_for[n]
            sums[0] += stand_for[n] if outside[n] else 0.0
            sums[1] += stand_for[n] if steep[v] else 0.0
            sums[2] += stand_for[n] if long[v] else 0.0
    return many, error, sums[0] / total, sums[1] / total, sums[2] / total


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def invariants(some, figures, vertices, shapes, sources, constants, more, mix_vectors, mix_tensors, least, most, low,
               high, mean, scale, out, outside):  # fmt: skip
    """The network's inputs, those of INPUTS and then `more` (N, .): kept from low to high, then centred and scaled.

    Figures (N, 2, WIDTH) and `more` are those of vertices (N,), of which those at places `some` (M,) are asked; shapes
    (V, 5) and sources (V, 2) are of all. Outside (N,) is who has an input that no training load had.
    """
    half, one = np.float32(0.5), np.float32(1)
    vectors, tensors = np.empty((DIRECTIONS, 2), np.float32), np.empty((2 * TENSORS, 2), np.float32)
    v, t = np.empty((MIXED_VECTORS, 2), np.float32), np.empty((MIXED_TENSORS, 2), np.float32)
    for place in range(len(some)):
        n = some[place]
        shape, here = shapes[vertices[n]], sources[vertices[n]]
        g = _amplitude(figures[n])
        _directions(figures[n], g, vectors, tensors)
        _mix(mix_vectors, vectors, v)
        _mix(mix_tensors, tensors, t)
        row, per = out[place], one / g
        for s in range(2):
            for m in range(SCALARS):
                row[IN.scalars + s * SCALARS + m] = figures[n, s, 3 + m] * per
            row[IN.linear_normal + s] = figures[n, s, 2] * per
            row[IN.here + s] = here[s] * per
            row[IN.log_here + s] = np.log(abs(here[s]) + np.float32(0.02))
        row[IN.log_g], row[IN.g], row[IN.root_g] = np.log(g + np.float32(1e-4)), g, np.sqrt(g)
        for m in range(SCALARS):
            row[IN.field_difference + m] = figures[n, 0, 3 + m] - figures[n, 1, 3 + m]
        k = IN.vector_products
        for a in range(MIXED_VECTORS):
            for b in range(a, MIXED_VECTORS):
                row[k] = v[a, 0] * v[b, 0] + v[a, 1] * v[b, 1]
                k += 1
        k = IN.tensor_products
        for a in range(MIXED_TENSORS):
            for b in range(a, MIXED_TENSORS):
                row[k] = t[a, 0] * t[b, 0] + t[a, 1] * t[b, 1]
                k += 1
        turn, bend = half * (shape[0] - shape[2]), shape[1]
        for a in range(MIXED_TENSORS):
            x, y = v[a, 0], v[a, 1]
            row[IN.tensor_along_vector + a] = t[a, 0] * (x * x - y * y) + np.float32(2) * t[a, 1] * x * y
            row[IN.tensor_along_curvature + a] = turn * t[a, 0] + bend * t[a, 1]
        for a in range(MIXED_VECTORS):
            x, y = v[a, 0], v[a, 1]
            row[IN.curvature_along_vector + a] = turn * (x * x - y * y) + np.float32(2) * bend * x * y
            row[IN.slope_along_vector + a] = shape[3] * x + shape[4] * y
        row[IN.mean_curvature] = half * (shape[0] + shape[2])
        row[IN.squared_bend] = turn * turn + bend * bend
        row[IN.constants], row[IN.constants + 1] = constants[0], constants[1]
        row[IN.volumetric] = one / (np.float32(1.02) - np.float32(2) * constants[0])
        row[IN.squared_slope] = shape[3] * shape[3] + shape[4] * shape[4]
        for m in range(more.shape[1]):
            row[INPUTS_END + m] = more[n, m]
        for m in range(len(mean)):
            if not least[m] <= row[m] <= most[m]:
                outside[n] = True
            row[m] = (min(max(row[m], low[m]), high[m]) - mean[m]) * scale[m]


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def think(inputs, w1, b1, w2, b2, w3, b3, w4, b4, outputs):
    """The layers, shared among threads."""
    for block in numba.prange((len(inputs) + BLOCK - 1) // BLOCK):
        _think(inputs, BLOCK * block, w1, b1, w2, b2, w3, b3, w4, b4, outputs)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def think_few(inputs, w1, b1, w2, b2, w3, b3, w4, b4, outputs):
    """The layers, on the caller's thread. Not `think` compiled otherwise: numba would keep both under one name."""
    for block in range((len(inputs) + BLOCK - 1) // BLOCK):
        _think(inputs, BLOCK * block, w1, b1, w2, b2, w3, b3, w4, b4, outputs)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _think(inputs, start, w1, b1, w2, b2, w3, b3, w4, b4, outputs):
    """The layers for a few vertices: they stay in the cache, and BLAS starts no threads for so little."""
    h = np.dot(inputs[start : start + BLOCK], w1)
    _activate(h, b1)
    h = np.dot(h, w2)
    _activate(h, b2)
    h = np.dot(h, w3)
    _activate(h, b3)
    out = np.dot(h, w4)
    for n in range(len(out)):
        for m in range(len(b4)):
            outputs[start + n, m] = out[n, m] + b4[m]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _activate(hidden, bias):
    """x / 2 (1 + x / (1 + |x|)) of hidden + bias, in place: smooth as SiLU, without its exponential."""
    half, one = np.float32(0.5), np.float32(1)
    for n in range(len(hidden)):
        for m in range(len(bias)):
            x = hidden[n, m] + bias[m]
            hidden[n, m] = x * (half + half * x / (one + abs(x)))


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _move(some, figures, vertices, shapes, sources, outputs, mix_vectors, mix_tensors, frames, moved, error):
    """Linear response to the columns' strain plus what the network adds, turned into the layer's frame, (N, 3) [m].

    Where the moments end so does the network, but not what it knows: the linear response is too small far from a load
    that is not small. So it goes on as the multiple of it that the network says on a ring around the load.
    """
    one, told, told_of = np.float32(1), 1e-30, 1e-30
    local, share = np.empty((len(some), 3), np.float32), np.empty(len(some), np.float32)
    vectors, tensors = np.empty((DIRECTIONS, 2), np.float32), np.empty((2 * TENSORS, 2), np.float32)
    v, t = np.empty((MIXED_VECTORS, 2), np.float32), np.empty((MIXED_TENSORS, 2), np.float32)
    for k in range(len(some)):
        n = some[k]
        x, y, z = figures[n, 1, 0], figures[n, 1, 1], figures[n, 1, 2]
        local[k, 0], local[k, 1], local[k, 2] = x, y, z
        g = _amplitude(figures[n])
        _directions(figures[n], g, vectors, tensors)
        _mix(mix_vectors, vectors, v)
        _mix(mix_tensors, tensors, t)
        _add(g, shapes[vertices[n]], outputs[k], vectors, v, t, local[k])
        error[n] = np.float32(AMPLITUDE) * g / (one + g) * np.exp(min(outputs[k, OUT.log_error], np.float32(2)))
        square = x * x + y * y + z * z
        ratio = g / (np.sqrt(square) + np.float32(1e-30))
        share[k] = _smooth(ratio / np.float32(FADE))
        if sources[vertices[n], 0] == 0:
            weight = share[k] * (one - _smooth(ratio / np.float32(RING)))
            told += weight * (x * local[k, 0] + y * local[k, 1] + z * local[k, 2])
            told_of += weight * square
    gain, k = np.float32(min(max(told / told_of, GAINS[0]), GAINS[1])), 0
    for n in range(len(figures)):
        linear, frame = figures[n, 1], frames[vertices[n]]
        x, y, z = gain * linear[0], gain * linear[1], gain * linear[2]
        if k < len(some) and some[k] == n:
            s, rest = share[k], (one - share[k]) * gain
            x, y, z = (s * local[k, 0] + rest * linear[0], s * local[k, 1] + rest * linear[1],
                       s * local[k, 2] + rest * linear[2])  # fmt: skip
            k += 1
        for m in range(3):
            moved[n, m] = x * frame[0, m] + y * frame[1, m] + z * frame[2, m]


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _smooth(x):
    """A step from 0 at 0 to 1 at 1."""
    x = min(max(x, np.float32(0)), np.float32(1))
    return x * x * (np.float32(3) - np.float32(2) * x)


@numba.njit(inline="always", fastmath=FAST, error_model="numpy")
def _add(g, shape, row, vectors, mixed, t, out):
    """Adds what the network says of a vertex to its linear response (3,) over t, in its own frame."""
    x = y = np.float32(0)
    for m in range(DIRECTIONS):
        x += row[OUT.directions + m] * vectors[m, 0]
        y += row[OUT.directions + m] * vectors[m, 1]
    for m in range(MIXED_TENSORS):
        c = row[OUT.turned + m]
        x += c * (t[m, 0] * mixed[m, 0] + t[m, 1] * mixed[m, 1])
        y += c * (t[m, 1] * mixed[m, 0] - t[m, 0] * mixed[m, 1])
    turn, bend = np.float32(0.5) * (shape[0] - shape[2]), shape[1]
    for m in range(MIXED_VECTORS):
        c = row[OUT.curved + m]
        x += c * (turn * mixed[m, 0] + bend * mixed[m, 1])
        y += c * (bend * mixed[m, 0] - turn * mixed[m, 1])
    x += row[OUT.slope] * shape[3]
    y += row[OUT.slope] * shape[4]
    a = np.float32(AMPLITUDE) * g / (np.float32(1) + g)
    out[0] += a * x
    out[1] += a * y
    out[2] += a * row[OUT.normal]
