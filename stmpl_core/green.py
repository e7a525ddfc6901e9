"""Green: what forces on a limb's skin do to it, in a linear response that knows stack, skin and the limb's own shape.

One material straight below the skin is a flat layer, as thick at each place as it is there. Where tissue is no longer
thin beside a limb's radius it flows and sways round the bone, which no flat layer knows; but that is smooth. So with
G the response of a flat stack of one thickness, K the limb's linear stiffness on a coarse mesh of its skin, C the
interpolation from there and R the way there (forces keep their sum),

    u = G f + C (K^-1 - G_coarse) R f

the sharp part is the closed form's, the wide part the finite elements' (fem_tools.limb). G is of one thickness, but
knows how soft the stack is at each place (stmpl_core.softness): under small tools the coarse part feels little of fat
that is thin here and thick there. Between places of flat, even skin there is no coarse part (fem_tools.limb.flatness).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from copy import copy
from functools import cache, cached_property, lru_cache
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numba
import numpy as np
from numba import float32, float64, int64
from scipy.special import j0, j1

from stmpl_core import nodewise
from stmpl_core.coarse_response import CoarseDrag, CoarseResponse
from stmpl_core.errors import StmplError
from stmpl_core.layer import SoftLayer
from stmpl_core.moments import Surroundings
from stmpl_core.nodes import Nodes
from stmpl_core.nodewise import FIRST_LOG, REACH, SPREADS, STEP_LOG, Packed
from stmpl_core.obstacle import columns_of
from stmpl_core.response import FAST, SPREAD
from stmpl_core.softness import BANK, Softness
from stmpl_core.stack import Effective, along, compliance, effective, hardening, stiffening
from stmpl_core.tissue import Tissue
from stmpl_core.twins import NO_TWINS, Twins, give_way

ROWS = 64  # rows of the tables over the root of the distance
TABLED = np.geomspace(1e-5, 10 / SPREADS[0], 3000)  # wave numbers at which a stack's response is known [1/t]
ROUND = float(np.sqrt(2 / np.pi))  # of a Gaussian that is as wide, 1 / r in its middle is 1 / (ROUND s)
FARTHEST = float(np.sqrt(REACH * 0.9999)) * ROWS  # place in the tables of the largest distance
AREAS = 33  # logarithms of the widths of a tool's nodes
FAR = 16.0  # distance over the spread, from which a force may be spread wider without a difference (0.2 %)
AROUND = 0.5  # cosine between normals below which the flat response fades: what is round the limb is the coarse part's
COLUMNS, STRAINS = 12, 64  # thicknesses and strains of the table of confined columns
GAUSS = np.polynomial.legendre.leggauss(4)  # points and weights on each panel of wave numbers
RIDGE = 1e-6  # of the matrix that sticks, over its largest number: two nodes in one place are no error
LEAST_KAPPA, LEAST_PULL = 0.05, 0.02  # kappa and pull that are none, in logarithms
NEXT = np.uint64(1)  # no index that may count from the end
LEAST_FIRM = 1e-3  # at which a node that is hardly held counts
ONE_WAY = 0.3  # least cosine between a tool's way and the skin's inward normal at a node
ANY_MODULUS = 1e4  # of one material, whose response over E is found once for all stiffnesses, to the bit [Pa]
FLAT = 0.05  # thickness over a radius of the skin up to which what is dragged gives as on a flat layer
TAKEN_BACK = 0.5  # most that the limb takes back of what a node does to itself in the flat response


AS_AT_REST = np.empty((0, 3, 3))  # turns of vertices that did not turn
NO_COARSE = (np.empty((0, 3), np.int64), np.empty((0, 3)), np.empty(0), np.empty((0, 3, 0), np.float32),
             AS_AT_REST)
_KEPT: WeakKeyDictionary[SoftLayer, Green | Callable[[], Green]] = WeakKeyDictionary()  # entries die with their layers


class _OfOne(NamedTuple):
    """A layer of one material as the kernels of stmpl_core.nodewise take it.

    Args:
        origin: what is taken off all places, (3,) [m].
        points: the vertices, less that, (V, 3) float32 [m].
        inward: unit vectors into the skin, (V, 3) float32.
        roots: 1 / sqrt(t) of the thickness t, (V,) float32.
        rows, scales: see Packed, the rows one after the other.
    """

    origin: np.ndarray
    points: np.ndarray
    inward: np.ndarray
    roots: np.ndarray
    rows: np.ndarray
    scales: np.ndarray


class _AtRest[T](cached_property[T]):
    """What a skin has as it is at rest, wherever joints take it: made there, when somebody first wants it."""

    def __get__(self, instance: Any, owner: type | None = None) -> T:
        return super().__get__(instance and (instance._at_rest or instance), owner)


class Green:
    """Linear response of a layer to forces at contact nodes: prepared once, then microseconds a node.

    Args:
        layer: soft layer at rest.
        coarse: wide part of its response; None: that of flat layers, each place as thick as it is.

    Attributes:
        thickness: thickness of the flat stack, the median of the layer's [m].
        effective: single layer under the same skin that is nearest to the stack.
        near: neighbours of the layer's vertices, with the flat stack's response.
        tables: responses of the flat stack by softness, (BANK, 4, spread, root of the distance); see `tables`.
        soft: softness of each vertex, its place among them, (V,).
    """

    def __init__(self, layer: SoftLayer, coarse: CoarseResponse | None) -> None:
        self.layer, self.coarse = copy(layer), coarse  # the layer itself would never be let go by _KEPT
        self.thickness = float(np.median(layer.thickness))
        self.near = Surroundings.of(layer)
        if layer.stacked:
            softness = Softness.of(layer, self.thickness)
            self.tables, self.soft = bank(layer.tissue, self.thickness, softness), softness.at(layer, self.thickness)
        else:
            self.tables, self.soft = _of_one(layer.tissue.poisson_ratio), np.zeros(len(layer.vertices))
        self._skin_turns = AS_AT_REST
        self._at_rest: Green | None = None
        self._last: tuple[np.ndarray, tuple[np.ndarray, np.ndarray]] | None = None

    @classmethod
    def of(cls, layer: SoftLayer) -> Green:
        """The response of a layer, made or read on the first call (a stack: seconds), kept as long as the layer is.

        Raises:
            InvalidInput, MeshError: the skin cannot be meshed coarsely.
        """
        layer = layer.typical
        kept = _KEPT.get(layer)
        if not isinstance(kept, Green):
            kept = _KEPT[layer] = kept() if kept else cls(layer, CoarseResponse.of(layer) if layer.stacked else None)
        return kept

    @staticmethod
    def kept(layer: SoftLayer) -> Green | None:
        """The response of a layer, if it was made."""
        kept = _KEPT.get(layer.typical)
        return kept if isinstance(kept, Green) else None

    @staticmethod
    def keep_for(layer: SoftLayer, make: Callable[[], Green]) -> None:
        """Lets `of` make the response of a layer so, when it is wanted; `make` must not hold the layer itself."""
        _KEPT[layer.typical] = make

    def keep(self, layer: SoftLayer) -> None:
        """Lets `of` give this one for another layer, of the same shape and the same ratios of moduli."""
        _KEPT[layer.typical] = self

    def stiffened(self, layer: SoftLayer, near: Surroundings) -> Green:
        """The same response of a layer that differs in E alone, with its neighbours."""
        out = copy(self)
        out.layer, out.near, out._last = copy(layer), near, None
        return out

    def moved(self, layer: SoftLayer, near: Surroundings, turns: np.ndarray) -> Green:
        """The same response where joints take the skin; the wide part's motion turns with the skin that it moves.

        Args:
            layer: layer there.
            near: its neighbours.
            turns: rotation of each vertex from rest, (V, 3, 3).
        """
        out = self.stiffened(layer, near)
        for name in ("_of_one", "_turns"):
            vars(out).pop(name, None)
        out._skin_turns, out._at_rest = turns, self._at_rest or self
        if self.coarse is not None or "drag" in vars(out._at_rest):  # what nobody wanted so far is not made for a pose
            _ = out._turns
        return out

    @cached_property
    def _turns(self) -> np.ndarray:
        """Rotation of each coarse vertex from rest, (C, 3, 3); none at rest, or where there is no coarse part."""
        mesh = self.coarse or self.drag if len(self._skin_turns) else None
        if mesh is None:
            return AS_AT_REST
        return _turns_of_coarse(mesh.corners, mesh.shares, self._skin_turns, len(mesh.gathered))

    @_AtRest
    def drag(self) -> CoarseDrag | None:
        """The wide part where skin is dragged along, made or read on the first call; None: as flat skin.

        Raises:
            InvalidInput, MeshError: a stack's skin cannot be meshed coarsely.
        """
        if self.coarse is not None:
            return CoarseDrag.of(self.layer)
        if np.median(np.abs(self.near.curvature[:, ::2]).max(axis=1)) > FLAT:
            with suppress(StmplError):  # of one material flat skin is an answer, too
                return CoarseDrag.of(self.layer.with_(tissue=Tissue(ANY_MODULUS, self.layer.tissue.poisson_ratio)))
        return None

    @_AtRest
    def _give(self) -> np.ndarray:
        """CoarseDrag.give at each vertex of the skin, (V, 3, 3) [1/m]."""
        assert self.drag is not None
        return np.einsum("va,vaxy->vxy", self.drag.shares, self.drag.give[self.drag.corners])

    @property
    def gives(self) -> tuple[np.ndarray, np.ndarray]:
        """`_give`, none where a contact gives as on a flat stack, and how the skin turned; see `give_at`."""
        return (AS_AT_REST if self.drag is None else self._give), self._skin_turns

    def give(self, nodes: Nodes, forces: np.ndarray) -> np.ndarray:
        """How a contact as a whole gives where it is dragged along, beyond a flat stack, (3, 3) [1/m].

        Args:
            nodes: nodes that press.
            forces: forces that press them, (N,) [N].
        """
        return give_at(nodes.corners, nodes.shares, forces, *self.gives)

    @property
    def _coarse(self) -> tuple[np.ndarray, ...]:
        """What kernels take of the coarse part; all empty if there is none."""
        return (*self.coarse[:4], self._turns) if self.coarse is not None else NO_COARSE

    @_AtRest
    def _by_source(self) -> np.ndarray:
        """Motion of coarse vertices by where the pressure is, (C, 3 C) float32 [m]."""
        assert self.coarse is not None
        count = len(self.coarse.gathered)
        return np.ascontiguousarray(self.coarse.motion.reshape(3 * count, count).T)

    def unit_at(self, nodes: Nodes) -> np.ndarray:
        """Thickness of the flat layer at nodes, (N,) [m]."""
        return np.full(len(nodes.area), self.thickness) if self.layer.stacked else nodes.thickness

    def soft_at(self, nodes: Nodes) -> np.ndarray:
        """Softness at nodes, (N,)."""
        return (self.soft[nodes.corners] * nodes.shares).sum(axis=1)

    @_AtRest
    def effective(self) -> Effective:
        """See the class."""
        return effective(self.layer.tissue, self.thickness)

    @_AtRest
    def numbers(self) -> np.ndarray:
        """What networks read of the stack, (4,): logarithms of t over that of the flat stack, kappa, T / (E t), and E.

        Those of the effective layer, the last as the first material's modulus over it.
        """
        one = self.effective
        return np.log([one.thickness / self.thickness, one.kappa + LEAST_KAPPA, one.pull + LEAST_PULL,
                       self.layer.tissue.youngs_modulus / one.youngs_modulus])  # fmt: skip

    @_AtRest
    def hardening(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How columns harden, of tissue whose materials begin as deep as it says.

        A column whose materials begin elsewhere (`ply_scale`) hardens as one as much thinner or thicker.

        Returns:
            logs: logarithms of thicknesses, (T,).
            table: stmpl_core.stack.hardening there, at even strains from 0 to below 1, (T, S).
            alike: thickness of the column that each vertex' hardens as [m], and stmpl_core.stack.stiffening, (V, 3).
        """
        layer = self.layer
        alike = layer.thickness if layer.ply_scale is None else layer.thickness / layer.ply_scale
        logs = np.linspace(np.log(alike.min()), np.log(alike.max()) + 1e-6, COLUMNS)
        strain = np.linspace(0, 1, STRAINS, endpoint=False)
        return (logs, np.array([hardening(layer.tissue, t, strain) for t in np.exp(logs)]),
                np.column_stack([alike, stiffening(layer.tissue, alike)]))  # fmt: skip

    def matrix(self, nodes: Nodes, group: np.ndarray) -> np.ndarray:
        """Depth at each node under a force E at each along the normals, symmetric, (N, N) [1/m]; see `matrices`."""
        return self.matrices(nodes, group)[0]

    def matrices(self, nodes: Nodes, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth at each node under a force E at each along the normals, and the coarse part of it, (N, N) each [1/m].

        Args:
            nodes: contact nodes.
            group: numbers of groups of nodes that do not feel each other, (N,).
        """
        last = self._last
        if last is None or not np.array_equal(last[0], nodes.points):  # a touch, then its answer
            made = _matrix(nodes.points, nodes.inward, nodes.area, nodes.corners, nodes.shares, group,
                           self.unit_at(nodes), self.soft_at(nodes), self.tables[:, 0], *self._coarse)  # fmt: skip
            last = self._last = nodes.points, made
        return last[1]

    def stuck(self, nodes: Nodes, group: np.ndarray, gone: np.ndarray, guess: np.ndarray | None = None,
              twins: Twins = NO_TWINS, firm: np.ndarray | None = None) -> np.ndarray:  # fmt: skip
        """Forces over E with which nodes that stick are held where they have gone, (N, 3) [m2].

        Args:
            nodes: nodes that press.
            group: numbers of groups of nodes that do not feel each other, (N,).
            gone: their motion, (N, 3) [m].
            guess: about these forces, (N, 3) [m2]: without a coarse part some steps lead from there.
            twins: nodes of two tools in one place, which need not go to two places at once.
            firm: how firmly each is held, from 0, hardly, to 1, (N,); None: all are.
        """
        firm = np.ones(len(gone)) if firm is None else firm
        if self.layer.stacked or guess is None:
            blocks = self._blocks(nodes, group)
            if len(twins.share):
                give_way(blocks.reshape(len(gone), 3, len(gone), 3).transpose(0, 1, 3, 2), *twins)
            return _held(blocks, gone, firm)
        blocks = nodewise.blocks(self._by_node(nodes), group, self._of_one.rows, self._of_one.scales)
        if len(twins.share):
            give_way(blocks.reshape(len(blocks), 3, 3, -1), *twins)
        eased, own = _eased(firm)[:, None], np.arange(len(firm))
        blocks[own, ::4, own] += (1 / eased - 1) * blocks[own, ::4, own].mean(axis=1, keepdims=True)
        return nodewise.approached(blocks, gone, eased * guess)

    def _by_node(self, nodes: Nodes) -> np.ndarray:
        """Nodes as the kernels of stmpl_core.nodewise take them."""
        return nodewise.by_node(nodes.points, nodes.inward, nodes.thickness, nodes.area, self._of_one.origin)

    @cached_property
    def _of_one(self) -> _OfOne:
        layer, origin, float32 = self.layer, self.layer.vertices.mean(axis=0), np.float32
        rows, scales = _packed(layer.tissue.poisson_ratio)
        return _OfOne(origin, (layer.vertices - origin).astype(float32), -layer.normals.astype(float32),
                      (layer.thickness**-0.5).astype(float32), rows.ravel(), scales)  # fmt: skip

    def rubbed(self, nodes: Nodes, group: np.ndarray, sticks: np.ndarray | None, slides: np.ndarray,
               pressing: np.ndarray) -> np.ndarray:  # fmt: skip
        """Forces over E with which nodes are dragged along, as what sticks and as what slides, (N, 3) [m2].

        What sticks goes its way, all of it. What slides is dragged with a traction mu p, so the more the harder it is
        pressed, and goes its way in the mean, weighed with what presses.

        Args:
            nodes, group: see `stuck`.
            sticks, slides: parts of their ways along the tool, (N, 3) [m]; None: nothing sticks.
            pressing: forces that press them, (N,) [N].
        """
        blocks, rubs = self._blocks(nodes, group), pressing[:, None] * slides
        if self.drag is not None:
            blocks += np.tile(self.give(nodes, pressing), (len(slides), len(slides)))
        out = np.zeros_like(slides) if sticks is None else _held(blocks, sticks, np.ones(len(sticks)))
        work = float(rubs.ravel() @ (blocks @ rubs.ravel()))
        if work > 0:  # else nothing presses, or nothing goes along the skin
            out += float(np.vdot(rubs, slides)) / work * rubs
        return out

    def _blocks(self, nodes: Nodes, group: np.ndarray) -> np.ndarray:
        """Motion of each node under a force E at each, (3 N, 3 N) [1/m]."""
        return _blocks(nodes.points, nodes.inward, nodes.area, nodes.corners, nodes.shares, group, self.unit_at(nodes),
                       self.soft_at(nodes), self.tables, *self._coarse)  # fmt: skip

    def motion(self, nodes: Nodes, forces: np.ndarray, dragged: bool = False,
               loaded: np.ndarray | None = None) -> np.ndarray:  # fmt: skip
        """Motion of all vertices under forces over E at nodes (N, 3) [m2], (V, 3) [m].

        Args:
            nodes, forces: nodes, and what acts at them.
            dragged: whether the limb gives along the skin too, as it does to what `rubbed` says.
            loaded: vertices about the nodes, under which others are asked soon; None: those around each.
        """
        layer = self.layer
        asked = self.near.asked_again(np.unique(nodes.corners) if loaded is None else loaded)
        group, flat = self.near.groups(nodes.corners[:, 0]), self._flat_of_stack if layer.stacked else self._flat_of_one
        felt = [(np.ones(len(group), bool), np.arange(len(asked.vertices)))]
        if group.any():
            felt = [(of, self.near.reached_among(np.unique(nodes.corners[of]), asked.vertices, alone=False))
                    for of in (group == one for one in np.unique(group))]  # fmt: skip
        by = flat(nodes, forces, asked.vertices, felt)
        out = np.zeros_like(layer.vertices)
        asked.fill(by, out)
        if self.coarse is not None:
            source = _handed(nodes.inward, nodes.corners, nodes.shares, forces, *self.coarse[:3])
            if source.any():
                self._add_coarse(self.coarse, _of_coarse(source, self._by_source), out)
        if dragged and (drag := self.drag) is not None:
            for ways, by_source in zip(drag.tangents, drag.by_source, strict=True):
                along = ways if not len(self._turns) else np.einsum("cxy,cy->cx", self._turns, ways)
                source = _handed_along(along, nodes.corners, nodes.shares, forces, *drag[:3])
                self._add_coarse(drag, _of_coarse(source, by_source), out)
        return out

    def _flat_of_stack(self, nodes: Nodes, forces: np.ndarray, vertices: np.ndarray,
                       felt: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:  # fmt: skip
        """Flat motion of vertices (N,) under forces at nodes; felt: masks of these, and which vertices feel them."""
        out, unit, soft = np.zeros((len(vertices), 3)), self.unit_at(nodes), self.soft_at(nodes)
        points, inward = self.layer.vertices[vertices], -self.layer.normals[vertices]
        for of, there in felt:
            add_motion(out, there, points, inward, self.near.thickness[vertices], nodes.points[of], nodes.inward[of],
                       nodes.area[of], unit[of], soft[of], forces[of], self.tables)  # fmt: skip
        return out

    def _flat_of_one(self, nodes: Nodes, forces: np.ndarray, vertices: np.ndarray,
                     felt: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:  # fmt: skip
        """The same on one material."""
        one, out = self._of_one, np.zeros((len(vertices), 3), np.float32)
        points, inward, roots = one.points[vertices], one.inward[vertices], one.roots[vertices]
        for of, there in felt:
            by = self._by_node(nodes if of.all() else nodes.some(of))
            nodewise.add_motion(out, there, points, inward, roots, by, forces[of], one.rows, one.scales)
        return out

    def _add_coarse(self, mesh: CoarseResponse | CoarseDrag, motion: np.ndarray, out: np.ndarray) -> None:
        """Adds motion of coarse vertices as at rest, (3 C,) [m], to that of all vertices, (V, 3)."""
        motion = motion.reshape(-1, 3)
        if len(self._turns):
            motion = np.einsum("cxy,cy->cx", self._turns, motion)
        _add_between(mesh.corners, mesh.shares, motion, out)

    def linear(self, source: np.ndarray) -> np.ndarray:
        """Motion of all vertices under a pressure over E at each (V,) [-], (V, 3) [m]."""
        layer, loaded = self.layer, np.flatnonzero(source)
        if not len(loaded):
            return np.zeros_like(layer.vertices)
        inward, area = -layer.normals[loaded], layer.vertex_areas[loaded]
        one = np.eye(3)[[0]].repeat(len(loaded), axis=0)  # a node at each vertex, all of it the first corner's
        corners = np.tile(loaded[:, None], 3)
        nodes = Nodes(layer.vertices[loaded], inward, layer.thickness[loaded], area, area, corners, one)
        return self.motion(nodes, (source[loaded] * area)[:, None] * inward)


@cache
def _of_one(poisson_ratio: float) -> np.ndarray:
    """Tables of one material, whose thickness does not matter."""
    return bank(Tissue(poisson_ratio=poisson_ratio), 1.0, None)


@cache
def _packed(poisson_ratio: float) -> Packed:
    return Packed.of(_of_one(poisson_ratio)[0], ROWS)


@lru_cache(maxsize=4)  # coarse elements and their layer ask for the same
def _bank(tissue: Tissue, thickness: float, factors: bytes) -> np.ndarray:
    found = tables(tissue, thickness, np.frombuffer(factors).reshape(BANK, 4, -1) if factors else None)
    return found if factors else np.repeat(found, BANK, axis=0)


def bank(tissue: Tissue, thickness: float, softness: Softness | None) -> np.ndarray:
    """`tables` of BANK stacks that are softer from one to the next; None, or places that are all alike: the same."""
    return _bank(tissue, thickness, softness.factors(TABLED).tobytes() if softness and softness.step else b"")


def tables(tissue: Tissue, thickness: float, factors: np.ndarray | None = None) -> np.ndarray:
    """Responses of flat stacks with E = t = 1 to a force spread as a Gaussian, (B, 4, spread, root of the distance).

    In order: motion inwards and outwards from a force inwards; of one along the skin the even part of the motion and
    the part that goes with the direction. With A, B of stmpl_core.stack.compliance and L, C of `along`,

        int A J0, int B J1, int (L + C) / 2 J0, -int (L - C) J2, each times exp(-(k s)^2 / 2) k dk / (2 pi)

    and times sqrt(r^2 + (ROUND s)^2), which takes out how steep it is.

    Args:
        tissue: materials, and the skin on them.
        thickness: thickness of the stack [m].
        factors: what A, B, L and C are to be multiplied by at TABLED, (B, 4, K); None: by 1, once.
    """
    responses = np.array([*compliance(tissue, thickness, TABLED), *along(tissue, thickness, TABLED)])
    each = responses[None] if factors is None else responses * factors
    lengthwise, crosswise = each[:, 2], each[:, 3]
    curves = np.stack([each[:, 0], each[:, 1], 0.5 * (lengthwise + crosswise), crosswise - lengthwise], axis=1)
    radii = (np.arange(int(np.sqrt(REACH) * ROWS) + 2) / ROWS) ** 2
    out = np.empty((len(each), 4, len(SPREADS), len(radii)))
    for row, radius in enumerate(radii):
        for n, spread in enumerate(np.maximum(SPREADS, radius / FAR)):
            if n and spread > SPREADS[n]:
                out[:, :, n, row] = out[:, :, n - 1, row] if spread == radius / FAR and radius / FAR > SPREADS[n - 1] \
                    else _transforms(curves, radius, spread)  # fmt: skip
            else:
                out[:, :, n, row] = _transforms(curves, radius, spread)
    fade = np.clip((REACH - radii) / 1.5, 0, 1)
    return out * np.sqrt(radii**2 + (ROUND * SPREADS[:, None]) ** 2) * fade * fade * (3 - 2 * fade)


def _transforms(curves: np.ndarray, radius: float, spread: float) -> np.ndarray:
    """The four transforms of curves at TABLED (B, 4, K), at a radius and a spread, (B, 4), on fine panels."""
    edges = _panels(radius, 6 / spread)
    x, w = GAUSS
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    k, weight = (middle[:, None] + half[:, None] * x).ravel(), (half[:, None] * w).ravel()
    weight = weight * np.exp(-0.5 * (k * spread) ** 2) * k / (2 * np.pi)
    f = k * radius
    first, zeroth = j1(f), j0(f)
    second = np.where(f > 1e-4, 2 * first / np.maximum(f, 1e-4) - zeroth, f * f / 8)
    place = np.clip(np.log(k / TABLED[0]) / np.log(TABLED[1] / TABLED[0]), 0, len(TABLED) - 1.001)
    low = place.astype(int)
    values = curves[..., low] + (place - low) * (curves[..., low + 1] - curves[..., low])
    return np.einsum("bcw,cw->bc", values, weight * np.array([zeroth, first, zeroth, second]))


def _panels(radius: float, end: float) -> np.ndarray:
    edges = [1e-4]
    while edges[-1] < end:
        edges.append(edges[-1] + min(0.15 * edges[-1] + 0.05, 1.5 / max(radius, 1e-9)))
    return np.array(edges)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _place(radius, spread):
    """Place in a table: rows of the root of the distance and of the spread, and what is left, both over t."""
    f = np.sqrt(min(radius, REACH * 0.9999)) * ROWS
    h = _row_of(np.log(spread))
    return int(f), f - int(f), int(h), h - int(h)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _row_of(log_spread):
    """Place of a spread over t among SPREADS, from its logarithm."""
    return min(max((log_spread - FIRST_LOG) / STEP_LOG, 0.0), len(SPREADS) - 1.001)


@numba.njit(cache=True, inline="always")
def _share(facing):
    """Share of the flat response that two places with this cosine between their normals feel of each other."""
    x = min(max(facing / AROUND, 0.0), 1.0)
    return x * x * (3 - 2 * x)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _at(table, k, f, g, h):
    """Value of one table at a place."""
    low = (1 - f) * table[g, k] + f * table[g, k + 1]
    return (1 - h) * low + h * ((1 - f) * table[g + 1, k] + f * table[g + 1, k + 1])


@numba.njit(cache=True, error_model="numpy", inline="always")
def _softly(banked, soft, k, f, g, h):
    """Value of one table of each softness (BANK, spread, root of the distance), at a place."""
    b = int(soft)
    value = _at(banked[b], k, f, g, h)
    return value + (soft - b) * (_at(banked[b + 1], k, f, g, h) - value) if soft > b else value


@numba.njit(cache=True, nogil=True)
def _corners_of(corners, shares, skin_corners, skin_shares):
    """The coarse vertices around nodes, their weights, (N, 9) each, and how many there are, (N,)."""
    count = len(corners) if len(skin_corners) else 0
    index, weight, many = np.zeros((count, 9), np.int64), np.zeros((count, 9)), np.zeros(count, np.int64)
    for n in range(count):
        for a in range(3):
            for b in range(3):
                c = skin_corners[corners[n, a], b]
                k = 0
                while k < many[n] and index[n, k] != c:
                    k += 1
                if k == many[n]:
                    index[n, k] = c
                    many[n] += 1
                weight[n, k] += shares[n, a] * skin_shares[corners[n, a], b]
    return index, weight, many


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _between_coarse(index, many, motion, turns):
    """Motion of coarse vertices under a pressure at others, (S, 3, S), and the place of each node's in it, (N, 9)."""
    slot = np.full(len(motion), -1)
    for n in range(len(index)):
        for a in range(many[n]):
            slot[index[n, a]] = 0
    some = np.flatnonzero(slot == 0)
    for c in range(len(some)):
        slot[some[c]] = c
    place, felt = np.zeros(index.shape, np.int64), np.zeros((len(some), 3, len(some)))
    for n in range(len(index)):
        for a in range(many[n]):
            place[n, a] = slot[index[n, a]]
    for c in range(len(some)):
        v = some[c]
        for x in range(3):
            if not len(turns):
                for d in range(len(some)):
                    felt[c, x, d] = motion[v, x, some[d]]
                continue
            for y in range(3):
                for d in range(len(some)):
                    felt[c, x, d] += turns[v, x, y] * motion[v, y, some[d]]
    return felt, place


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _wide(index, weight, many, gathered, motion, turns, out):
    """Adds the coarse motion of each node under a force E inwards at each, (N, 3, N) [1/m]."""
    if not len(gathered):
        return
    felt, place = _between_coarse(index, many, motion, turns)
    row = np.empty((3, len(felt)))
    for n in range(len(index)):
        row[:] = 0.0
        for a in range(many[n]):
            for x in range(3):
                for d in range(len(felt)):
                    row[x, d] += weight[n, a] * felt[place[n, a], x, d]
        for j in range(len(index)):
            for a in range(many[j]):
                d, share = place[j, a], weight[j, a] / gathered[index[j, a]]
                for x in range(3):
                    out[n, x, j] += share * row[x, d]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inwards(index, weight, many, group, gathered, motion, turns, inward, out):
    """Adds what `_wide` moves each node inwards under those of its group, (N, N) [1/m]."""
    for one in np.unique(group) if len(gathered) else group[:0]:
        of = np.flatnonzero(group == one)
        at, share, last = index[of], weight[of], many[of]
        felt, place = _between_coarse(at, last, motion, turns)
        rows, spread = np.zeros((len(of), len(felt))), np.zeros((len(felt), len(of)))
        for n in range(len(of)):
            row, down = rows[n], inward[of[n]]
            for a in range(last[n]):
                spread[place[n, a], n] = share[n, a] / gathered[at[n, a]]
                there = felt[place[n, a]]
                s0, s1, s2 = share[n, a] * down[0], share[n, a] * down[1], share[n, a] * down[2]
                for d in range(len(felt)):  # one loop: the row stays in registers
                    row[d] = row[d] + s0 * there[0, d] + s1 * there[1, d] + s2 * there[2, d]
        moved = _product(rows.T.copy(), spread)
        for j in range(len(of)):
            for n in range(len(of)):
                out[of[n], of[j]] += moved[j, n]


@numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _product(columns, spread):
    """Transposed product of rows, given as columns (S, N), and a matrix (S, N) most of which is 0, (N, N).

    To the bit that of BLAS, which takes many times as long for the zeros.
    """
    out = np.zeros((spread.shape[1], columns.shape[1]))
    for d in range(len(spread)):
        column = columns[d]
        for j in range(len(out)):
            per, row = spread[d, j], out[j]
            if per != 0:
                for n in range(len(row)):
                    row[n] += per * column[n]
    return out


def compile_matrix() -> None:
    """Compiles what finds Green.matrices."""
    numbers, table = float64[::1], float64[:, ::1]
    _matrix.compile((table, table, numbers, int64[:, ::1], table, int64[::1], numbers, numbers, float64[:, :, :],
                     int64[:, ::1], table, numbers, float32[:, :, ::1], float64[:, :, ::1]))  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _matrix(points, inward, area, corners, shares, group, unit, soft, banked, skin_corners, skin_shares, gathered,
            motion, turns):  # fmt: skip
    """See Green.matrix."""
    count = len(points)
    index, weight, many = _corners_of(corners, shares, skin_corners, skin_shares)
    wide, out = np.zeros((count, count)), np.zeros((count, count))
    _inwards(index, weight, many, group, gathered, motion, turns, inward, wide)
    least, steps, logs = area.min(), (AREAS - 1) / max(np.ptp(area), 1e-9 * area.max()), np.empty(AREAS)
    for k in range(AREAS):  # of spreads in metres: one for each pair would take as long as all else
        logs[k] = np.log(SPREAD * np.sqrt(least + k / steps))
    roots, own, by = np.sqrt(unit), 0.5 * np.log(unit), columns_of(points, inward)
    facing, place, spot, away = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        p0, p1, p2, n0, n1, n2 = by[0, i], by[1, i], by[2, i], by[3, i], by[4, i], by[5, i]
        its, root, first, end = area[i], roots[i], np.uint64(0), np.uint64(i + 1)
        while group[first] != group[i]:
            first += NEXT
        for j in range(first, end):  # what runs in vector registers
            facing[j] = n0 * by[3, j] + n1 * by[4, j] + n2 * by[5, j]
            x, y, z, mean = p0 - by[0, j], p1 - by[1, j], p2 - by[2, j], 0.5 * (its + area[j])
            square = x * x + y * y + z * z
            place[j] = np.sqrt(np.sqrt(square) / (root * roots[j])) * ROWS
            spot[j] = min((mean - least) * steps, AREAS - 1.001)
            away[j] = np.sqrt(square + mean * (ROUND * SPREAD) ** 2)
        for j in range(first, end):
            if group[i] != group[j]:
                continue
            both, f = 0.5 * (wide[i, j] + wide[j, i]), place[j]
            if facing[j] > 0 and f < FARTHEST:
                k, a = int(f), int(spot[j])
                h = _row_of(logs[a] + (spot[j] - a) * (logs[a + 1] - logs[a]) - own[i] - own[j])
                value = _softly(banked, 0.5 * (soft[i] + soft[j]), k, f - k, int(h), h - int(h))
                both += _share(facing[j]) * value / away[j]
            out[i, j] = out[j, i] = both
    _temper(out, wide)
    return out, wide


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _temper(matrix, wide):
    """Lets a limb's part take back no more than TAKEN_BACK of what a node does to itself in the flat response.

    Beside an open border, which is held, its coarse mesh says more; then no forces are a solution. Elsewhere it is a
    tenth.
    """
    count, kept = len(wide), np.ones(len(wide))
    for i in range(count):
        most = TAKEN_BACK * (matrix[i, i] - wide[i, i])
        if -wide[i, i] > most:
            kept[i] = np.sqrt(max(most, 0.0) / -wide[i, i])
    if kept.min() == 1.0:
        return
    for i in range(count):
        for j in range(i + 1):
            share = kept[i] * kept[j]
            less = 0.5 * (share - 1) * (wide[i, j] + wide[j, i])
            matrix[i, j] += less
            wide[i, j] *= share
            if i != j:
                matrix[j, i] += less
                wide[j, i] *= share


@numba.njit(cache=True, error_model="numpy", inline="always")
def _of_force(n0, n1, n2, s0, s1, s2, d0, d1, d2, size, g0, g1, even, along, f0, f1, f2):
    """Flat motion of a point under a force f, three numbers, given the four responses there.

    The point's inward normal is n, the source's is s; d leads from the source to the point.
    """
    m0, m1, m2 = n0 + s0, n1 + s1, n2 + s2
    root = 1 / np.sqrt(max(m0 * m0 + m1 * m1 + m2 * m2, 1e-12))
    m0, m1, m2 = m0 * root, m1 * root, m2 * root
    up = d0 * m0 + d1 * m1 + d2 * m2
    d0, d1, d2 = d0 - up * m0, d1 - up * m1, d2 - up * m2
    length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    root = 1 / length if length > 1e-6 * size else 0.0
    d0, d1, d2 = d0 * root, d1 * root, d2 * root
    down, over = f0 * s0 + f1 * s1 + f2 * s2, f0 * m0 + f1 * m1 + f2 * m2
    t0, t1, t2 = f0 - over * m0, f1 - over * m1, f2 - over * m2
    radial = t0 * d0 + t1 * d1 + t2 * d2
    sink, away, rest = g0 * down - g1 * radial, g1 * down + along * radial, even - 0.5 * along
    return sink * n0 + away * d0 + rest * t0, sink * n1 + away * d1 + rest * t1, sink * n2 + away * d2 + rest * t2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _blocks(points, inward, area, corners, shares, group, unit, soft, tables, skin_corners, skin_shares, gathered,
            motion, turns):  # fmt: skip
    """Motion of each node under a force E at each, (3 N, 3 N) [1/m]; the coarse part only under what goes inwards."""
    count = len(points)
    index, weight, many = _corners_of(corners, shares, skin_corners, skin_shares)
    wide, out = np.zeros((count, 3, count)), np.zeros((count, 3, count, 3))
    _wide(index, weight, many, gathered, motion, turns, wide)
    force, moved = np.zeros(3), np.empty(3)
    for i in range(count):
        for j in range(count):
            for x in range(3):
                for y in range(3):
                    out[i, x, j, y] = wide[i, x, j] * inward[j, y] if group[i] == group[j] else 0.0
    for i in range(count):
        for j in range(i + 1):
            if group[i] != group[j]:
                continue
            square = facing = 0.0
            for x in range(3):
                square += (points[i, x] - points[j, x]) ** 2
                facing += inward[i, x] * inward[j, x]
            t = np.sqrt(unit[i] * unit[j])
            r = np.sqrt(square) / t
            if facing <= 0 or r >= REACH:
                continue
            s = SPREAD * np.sqrt(0.5 * (area[i] + area[j])) / t
            k, f, g, h = _place(r, s)
            per = _share(facing) / (np.sqrt(r * r + (ROUND * s) ** 2) * t)
            c = 0.5 * (soft[i] + soft[j])
            g0, g1 = per * _softly(tables[:, 0], c, k, f, g, h), per * _softly(tables[:, 1], c, k, f, g, h)
            even, along = per * _softly(tables[:, 2], c, k, f, g, h), per * _softly(tables[:, 3], c, k, f, g, h)
            for y in range(3):
                force[:] = 0.0
                force[y] = 1.0
                moved[0], moved[1], moved[2] = _of_force(
                    inward[i, 0], inward[i, 1], inward[i, 2], inward[j, 0], inward[j, 1], inward[j, 2],
                    points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2], t,
                    g0, g1, even, along, force[0], force[1], force[2])  # fmt: skip
                for x in range(3):
                    out[i, x, j, y] += moved[x]
                    if i != j:
                        out[j, y, i, x] += moved[x]
    return out.reshape(3 * count, 3 * count)


def _held(blocks: np.ndarray, gone: np.ndarray, firm: np.ndarray) -> np.ndarray:
    """Forces (N, 3) under which nodes go where they have gone, (N, 3), by `_blocks`; firm: see Green.stuck."""
    held, own = blocks.copy(), np.diag(blocks)
    more = (1 / _eased(firm) - 1) * own.reshape(-1, 3).mean(axis=1)
    np.fill_diagonal(held, own + np.repeat(more, 3) + RIDGE * np.abs(blocks).max())
    return np.linalg.solve(held, gone.ravel()).reshape(-1, 3)


def _eased(firm: np.ndarray) -> np.ndarray:
    """What nodes that are held so firmly, (N,), give to their own forces is what skin gives in the mean over this."""
    return np.maximum(firm, LEAST_FIRM) ** 2


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def add_motion(out, there, points, inward, unit, sources, source_inward, area, source_unit, soft, forces, tables):
    """Adds to rows `there` of out (M, 3) [m] the flat motion of points under forces over E at sources (N, 3) [m2].

    Args:
        out: motion of the points, (M, 3) [m].
        there: numbers of the points that feel the sources.
        points, inward, unit: points, unit vectors into the skin, (M, 3), and thickness of the flat layer there, (M,).
        sources, source_inward: the same of the sources, (N, 3).
        area: area that each source stands for, (N,) [m2].
        source_unit: thickness of the flat layer there, (N,) [m].
        soft: softness there, (N,).
        forces: forces over E, (N, 3) [m2].
        tables: see `bank`.
    """
    wide = tables.shape[3]
    rows, first, kinds = np.empty((len(sources), 4, wide)), np.empty(len(sources), np.int32), 0
    by = np.empty((11, len(sources)))  # of each source: place, inward normal, force, root of the thickness, spread
    for j in range(len(sources)):  # nodes of one tool are about as wide: few tables serve all
        spread = SPREAD * np.sqrt(area[j]) / source_unit[j]
        by[9, j], by[10, j] = np.sqrt(source_unit[j]), (ROUND * spread) ** 2
        for x in range(3):
            by[x, j], by[3 + x, j], by[6 + x, j] = sources[j, x], source_inward[j, x], forces[j, x]
        _, _, g, h = _place(0.0, spread)
        at, one, k = int(16 * (g + h)), int(32 * soft[j] + 0.5), 0
        while k < kinds and (rows[k, 0, -1] != at or rows[k, 1, -1] != one):
            k += 1
        if k == kinds:
            g, h, b, w = at // 16, (at % 16 + 0.5) / 16, one // 32, (one % 32) / 32
            for m in range(4):
                for c in range(wide):
                    value = (1 - h) * tables[b, m, g, c] + h * tables[b, m, g + 1, c]
                    if w > 0:
                        value += w * ((1 - h) * tables[b + 1, m, g, c] + h * tables[b + 1, m, g + 1, c] - value)
                    rows[k, m, c] = value
            rows[k, 0, -1], rows[k, 1, -1] = at, one
            kinds += 1
        first[j] = 4 * wide * k
    flat = rows.ravel()
    for n in range(len(there)):
        i = there[n]
        p0, p1, p2, n0, n1, n2 = points[i, 0], points[i, 1], points[i, 2], inward[i, 0], inward[i, 1], inward[i, 2]
        root, u, v, w = np.sqrt(unit[i]), 0.0, 0.0, 0.0
        for j in range(len(sources)):  # without branches or stores, so that it runs in vector registers
            d0, d1, d2, t = p0 - by[0, j], p1 - by[1, j], p2 - by[2, j], root * by[9, j]
            facing = n0 * by[3, j] + n1 * by[4, j] + n2 * by[5, j]
            r = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2) / t
            per = _share(facing) / (np.sqrt(r * r + by[10, j]) * t)
            per = per if r < 0.98 * REACH else 0.0
            f = min(np.sqrt(r) * ROWS, FARTHEST)
            k = np.int32(f)
            f, a = f - k, np.uint64(first[j] + k)
            b, c, d = a + np.uint64(wide), a + np.uint64(2 * wide), a + np.uint64(3 * wide)
            g0, g1 = (1 - f) * flat[a] + f * flat[a + NEXT], (1 - f) * flat[b] + f * flat[b + NEXT]
            even, along = (1 - f) * flat[c] + f * flat[c + NEXT], (1 - f) * flat[d] + f * flat[d + NEXT]
            x, y, z = _of_force(n0, n1, n2, by[3, j], by[4, j], by[5, j], d0, d1, d2, t, per * g0, per * g1, per * even,
                                per * along, by[6, j], by[7, j], by[8, j])  # fmt: skip
            u, v, w = u + x, v + y, w + z
        out[i, 0], out[i, 1], out[i, 2] = out[i, 0] + u, out[i, 1] + v, out[i, 2] + w


@numba.njit(cache=True, nogil=True, error_model="numpy")
def give_at(corners, shares, forces, give, turns):
    """Mean of give (V, 3, 3) at nodes, weighed with forces (N,), turned with the skin by turns (V, 3, 3), (3, 3)."""
    out, total = np.zeros((3, 3)), 0.0
    for n in range(len(corners) if len(give) else 0):
        total += forces[n]
        for a in range(3):
            v, weight = corners[n, a], shares[n, a] * forces[n]
            if not len(turns):
                for x in range(3):
                    for y in range(3):
                        out[x, y] += weight * give[v, x, y]
            elif weight:
                out += weight * (turns[v] @ give[v] @ turns[v].T)
    return out / total if total > 0 else out


@numba.njit(cache=True, nogil=True)
def _handed(inward, corners, shares, forces, skin_corners, skin_shares, gathered):
    """Pressures over E at coarse vertices that forces over E at nodes amount to, inwards, (C,)."""
    index, weight, many = _corners_of(corners, shares, skin_corners, skin_shares)
    out = np.zeros(len(gathered))
    for n in range(len(index)):
        down = inward[n, 0] * forces[n, 0] + inward[n, 1] * forces[n, 1] + inward[n, 2] * forces[n, 2]
        for a in range(many[n]):
            out[index[n, a]] += weight[n, a] * down / gathered[index[n, a]]
    return out


@numba.njit(cache=True, nogil=True)
def _handed_along(ways, corners, shares, forces, skin_corners, skin_shares, gathered):
    """Tractions over E along ways (C, 3) at coarse vertices that forces over E at nodes amount to, (C,)."""
    index, weight, many = _corners_of(corners, shares, skin_corners, skin_shares)
    out = np.zeros(len(gathered))
    for n in range(len(index)):
        for a in range(many[n]):
            c = index[n, a]
            along = ways[c, 0] * forces[n, 0] + ways[c, 1] * forces[n, 1] + ways[c, 2] * forces[n, 2]
            out[c] += weight[n, a] * along / gathered[c]
    return out


@numba.njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _of_coarse(source, by_source):
    """Motion of coarse vertices under pressures at some of them, (3 C,)."""
    out = np.zeros(by_source.shape[1])
    for k in range(len(source)):
        if source[k] != 0:
            for c in range(len(out)):
                out[c] += source[k] * by_source[k, c]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turns_of_coarse(corners, shares, turns, count):
    """Rotation of each coarse vertex, (C, 3, 3): the mean of those of the skin around it, made a rotation."""
    out = np.zeros((count, 3, 3))
    for v in range(len(corners)):
        for a in range(3):
            for x in range(3):
                for y in range(3):
                    out[corners[v, a], x, y] += shares[v, a] * turns[v, x, y]
    for c in range(count):
        if not out[c].any():
            out[c] = np.eye(3)
        u, _, w = np.linalg.svd(out[c])
        out[c] = u @ w
    return out


@numba.njit(cache=True, nogil=True)
def _add_between(corners, shares, motion, out):
    """Adds motion of coarse vertices (C, 3), interpolated, to out (V, 3)."""
    for v in range(len(corners)):
        for a in range(3):
            for x in range(3):
                out[v, x] += shares[v, a] * motion[corners[v, a], x]
