"""Relaxation: quasi-linear viscoelasticity at finite strain: what the wedges and the skin of a patch remember.

The second Piola-Kirchhoff stress is the convolution of its elastic value S_e with a Prony series (Fung,
"Biomechanics", 2nd ed., ch. 7.6), and lives in the rest state, so that turning the body does not turn it:

    S(t) = (1 - sum g_i) S_e(t) + sum g_i h_i(t),     h_i(t) = int_0^t exp(-(t - s) / tau_i) dS_e/ds ds

With x = dt / tau_i and a = (1 - exp(-x)) / x a step is exact where S_e changes evenly in it (Simo & Hughes,
"Computational Inelasticity", ch. 10.3.3):

    h_i(t + dt) = exp(-x) h_i(t) + a (S_e(t + dt) - S_e(t))

so that S(t + dt) = c S_e(t + dt) + H with c = 1 - sum g_i (1 - a) and H = sum g_i (exp(-x) h_i(t) - a S_e(t)), which is
known. Within a step the body is therefore elastic, with c of its moduli and the energy H : E, E = (F^T F - I) / 2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import log
from typing import Literal

import numpy as np
from numba import njit

from fem_tools.membrane import SkinMembrane
from fem_tools.mesh import WedgeMesh
from fem_tools.neo_hookean import FAST, invert
from fem_tools.plies import wedge_plies
from stmpl_core.tissue import Prony, Tissue

Fading = Literal["stress", "shear"]  # what fades: all stress, or only that of mu


@dataclass(frozen=True, eq=False)
class Step:
    """A body within one step: elastic with `scale` of its moduli, and a stress H of the rest state that is held.

    Args:
        scale: c of each element, (E,) [-].
        held: H at each point, (E, Q, 6) as xx, yy, zz, yz, zx, xy [Pa].
    """

    scale: np.ndarray
    held: np.ndarray

    def positive(self) -> np.ndarray:
        """What is added to H where it presses so that it presses nowhere, (E, Q, 6) [Pa]."""
        values, vectors = np.linalg.eigh(_matrices(self.held))
        pressing = np.einsum("eqik,eqk,eqjk->eqij", vectors, np.maximum(-values, 0.0), vectors)
        return pressing[..., (0, 1, 2, 1, 2, 0), (0, 1, 2, 2, 0, 1)]


@dataclass(frozen=True, eq=False)
class Memory:
    """What elements with Prony series remember at one time.

    Args:
        shares, times: g_i [-] and tau_i [s] of each element, (E, N) each; where it has fewer terms, 0 and 1.
        elastic: S_e, (E, Q, 6) [Pa].
        faded: h_i, (N, E, Q, 6) [Pa].
    """

    shares: np.ndarray
    times: np.ndarray
    elastic: np.ndarray
    faded: np.ndarray

    @classmethod
    def of(cls, series: Sequence[Prony | None], which: np.ndarray, points: int) -> Memory | None:
        """No memories yet of elements at rest; None where no series is.

        Args:
            series: series of each material.
            which: number of each element's material, (E,).
            points: quadrature points of an element.
        """
        terms = max((len(one.shares) for one in series if one), default=0)
        if not terms:
            return None
        shares, times = np.zeros((len(series), terms)), np.ones((len(series), terms))
        for k, one in enumerate(series):
            if one:
                shares[k, : len(one.shares)], times[k, : len(one.times)] = one.shares, one.times
        zero = np.zeros((len(which), points, 6))
        return cls(shares[which], times[which], zero, np.zeros((terms, *zero.shape)))

    def step(self, dt: float) -> Step:
        """The body within a step of `dt` >= 0 [s]."""
        decay, mean = self._factors(dt)
        scale = 1 - (self.shares * (1 - mean)).sum(axis=1)
        held = np.einsum("en,en,neqi->eqi", self.shares, decay, self.faded)
        return Step(scale, held - (self.shares * mean).sum(axis=1)[:, None, None] * self.elastic)

    def after(self, dt: float, elastic: np.ndarray) -> Memory:
        """The memories after a step of `dt` [s] that ends at S_e = `elastic`, (E, Q, 6) [Pa]."""
        decay, mean = (x.T[:, :, None, None] for x in self._factors(dt))
        return Memory(self.shares, self.times, elastic, decay * self.faded + mean * (elastic - self.elastic))

    def _factors(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """exp(-x) and (1 - exp(-x)) / x of each element's terms, (E, N) each [-]."""
        x = dt / self.times
        return np.exp(-x), np.where(x > 1e-12, -np.expm1(-x) / np.maximum(x, 1e-300), 1.0)


@dataclass(frozen=True, eq=False)
class Body:
    """Wedges and skin within one step, see Relaxing.begin; the skin's part is None where it is elastic."""

    mu: np.ndarray
    lam: np.ndarray
    solid: Step | None
    skin: Step | None


Points = tuple[np.ndarray, np.ndarray]  # gradients and volumes of quadrature points
Memories = tuple[Memory | None, Memory | None]  # of the wedges and of the skin


class Relaxing:
    """The fading stress of a patch: the equations of one step, and what is remembered after it.

    Args:
        mesh: wedges.
        tissue: materials and their series.
        moduli: mu and lambda of each wedge, (T L,) each [Pa].
        membrane: skin of the patch.
        fading: what fades: "stress", all of it, so that nu stays as it is; or "shear", that of mu alone.
    """

    def __init__(self, mesh: WedgeMesh, tissue: Tissue, moduli: tuple[np.ndarray, np.ndarray],
                 membrane: SkinMembrane | None, fading: Fading = "stress") -> None:  # fmt: skip
        self.mesh, self.membrane, self.fading = mesh, membrane, fading
        self.mu, self.lam = moduli
        series = [tissue.relaxation, *(ply.relaxation for ply in tissue.deeper)]
        solid, skin = Memory.of(series, wedge_plies(mesh, tissue), mesh.volumes.shape[1]), None
        if membrane and tissue.skin and tissue.skin.relaxation:
            self._along = np.ascontiguousarray(np.einsum("tqnx,txi->tqni", membrane.gradients, membrane.axes))
            faces, points = membrane.areas.shape
            skin = Memory.of([tissue.skin.relaxation], np.zeros(faces, dtype=np.int64), points)
        self.start: Memories = solid, skin
        self.body = self.begin(self.start, 0.0)

    def begin(self, memories: Memories, dt: float) -> Body:
        """Makes the equations those of a step of `dt` [s] from what is remembered."""
        solid, skin = (one.step(dt) if one else None for one in memories)
        mu, lam = self.mu, self.lam
        if solid:
            mu, lam = mu * solid.scale, lam * solid.scale if self.fading == "stress" else lam
        self.resume(Body(mu, lam, solid, skin))
        return self.body

    def resume(self, body: Body) -> None:
        """Makes the equations those of a step that was begun before."""
        self.body = body
        if self.membrane:
            self.membrane.scale = float(body.skin.scale[0]) if body.skin else 1.0

    def after(self, memories: Memories, dt: float, u: np.ndarray) -> Memories:
        """What is remembered after a step of `dt` [s] that ends at u (C, levels, 3) [m]."""
        solid, skin = memories
        if solid:
            lam = self.lam if self.fading == "stress" else np.zeros_like(self.lam)
            solid = solid.after(dt, solid_stress(self.mesh, u, self.mu, lam))
        if skin and self.membrane:
            skin = skin.after(dt, self.membrane.elastic_stress(u[:, 0]))
        return solid, skin

    def energy(self, u: np.ndarray) -> float:
        """Energy of the held stresses at u (C, levels, 3) [m], in J."""
        return sum(held_energy(u, *topology, *points, held) for topology, _, points, held, _ in self._parts())

    def add_forces(self, u: np.ndarray, forces: np.ndarray) -> None:
        """Adds the gradient of that energy to `forces` (C, levels, 3) [N]."""
        for topology, _, points, held, _ in self._parts():
            held_forces(u, *topology, *points, held, forces)

    def add_tangent(self, data: np.ndarray, convex: float) -> None:
        """Adds its second derivative to the tangent's blocks [N/m]; `convex`: share left out of what presses."""
        for (columns, layers, per), blocks, points, held, step in self._parts():
            held = held + convex * step.positive() if convex > 0 else held
            held_tangent(columns, blocks, layers, per, self.mesh.levels - 1, *points, held, data)

    def _parts(self) -> Iterator[tuple[tuple[np.ndarray, int, int], np.ndarray, Points, np.ndarray, Step]]:
        """What the kernels need of the wedges and of the skin."""
        mesh = self.mesh
        if step := self.body.solid:
            yield (mesh.columns, mesh.layers, 3), mesh.blocks, (mesh.gradients, mesh.volumes), step.held, step
        if (step := self.body.skin) and self.membrane:
            yield (mesh.columns, 1, 1), mesh.blocks, (self._along, self.membrane.areas), step.held, step


def solid_stress(mesh: WedgeMesh, u: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    """S_e = mu (I - C^-1) + lambda ln J C^-1 of the wedges, (T L, Q, 6) [Pa]; u (C, levels, 3) [m]."""
    out = np.empty((*mesh.volumes.shape, 6))
    _solid_stress(u, mesh.columns, mesh.layers, mesh.gradients, mu, lam, out)
    return out


def _matrices(voigt: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., 3, 3) of (..., 6)."""
    return voigt[..., [[0, 5, 4], [5, 1, 3], [4, 3, 2]]]


@njit(cache=True, fastmath=FAST)
def _gradient(u, columns, level, per, gradients, diagonal, out):
    """out = `diagonal` I + du/dX of an element at a point with these gradients (nodes, 3); per: see held_energy."""
    for i in range(3):
        for j in range(3):
            s = diagonal if i == j else 0.0
            for a in range(len(gradients)):
                s += u[columns[a // per], level + a % per, i] * gradients[a, j]
            out[i, j] = s


@njit(cache=True, fastmath=FAST)
def _solid_stress(u, columns, layers, gradients, mus, lams, out):
    F, C, inv = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for e in range(gradients.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        for q in range(gradients.shape[1]):
            _gradient(u, columns[t], level, 3, gradients[e, q], 1.0, F)
            for i in range(3):
                for j in range(3):
                    C[i, j] = F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j]
            factor = 0.5 * lams[e] * log(invert(C, inv)) - mus[e]
            for i in range(3):
                out[e, q, i] = mus[e] + factor * inv[i, i]
            out[e, q, 3] = factor * inv[1, 2]
            out[e, q, 4] = factor * inv[2, 0]
            out[e, q, 5] = factor * inv[0, 1]


@njit(cache=True, fastmath=FAST)
def _pull(H, G, out):
    """out = H G for a symmetric H as (6,)."""
    out[0] = H[0] * G[0] + H[5] * G[1] + H[4] * G[2]
    out[1] = H[5] * G[0] + H[1] * G[1] + H[3] * G[2]
    out[2] = H[4] * G[0] + H[3] * G[1] + H[2] * G[2]


@njit(cache=True, fastmath=FAST)
def held_energy(u, columns, layers, per, gradients, volumes, held):
    """Energy [J] of a held stress H (E, Q, 6) [Pa]: the integral of H : (F^T F - I) / 2.

    per: nodes of a column in an element: 3 in a wedge, 1 in a face of the skin, whose gradients are along it.
    """
    total, row = 0.0, np.empty(3)
    L = np.empty((3, 3))
    for e in range(gradients.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        for q in range(gradients.shape[1]):
            _gradient(u, columns[t], level, per, gradients[e, q], 0.0, L)
            s = 0.0
            for i in range(3):
                _pull(held[e, q], L[i], row)  # H : E = H : (L + L^T L / 2)
                s += row[i] + 0.5 * (row[0] * L[i, 0] + row[1] * L[i, 1] + row[2] * L[i, 2])
            total += volumes[e, q] * s
    return total


@njit(cache=True, fastmath=FAST)
def held_forces(u, columns, layers, per, gradients, volumes, held, forces):
    """Adds the gradient of that energy, F H grad N, to `forces` (C, levels, 3) [N]."""
    v, L = np.empty(3), np.empty((3, 3))
    for e in range(gradients.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        for q in range(gradients.shape[1]):
            _gradient(u, columns[t], level, per, gradients[e, q], 0.0, L)
            for a in range(gradients.shape[2]):
                _pull(held[e, q], gradients[e, q, a], v)
                for i in range(3):
                    forces[columns[t, a // per], level + a % per, i] += volumes[e, q] * (
                        v[i] + L[i, 0] * v[0] + L[i, 1] * v[1] + L[i, 2] * v[2]
                    )


@njit(cache=True, fastmath=FAST)
def held_tangent(columns, blocks, layers, per, free, gradients, volumes, held, data):
    """Adds the second derivative of that energy, (grad N_a . H grad N_b) I, to the free levels of `data` [N/m]."""
    v = np.empty(3)
    for e in range(gradients.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        for a in range(gradients.shape[2]):
            row = level + a % per
            if row >= free:
                continue
            for b in range(gradients.shape[2]):
                col = level + b % per
                if col >= free:
                    continue
                k = 0.0
                for q in range(gradients.shape[1]):
                    G = gradients[e, q, a]
                    _pull(held[e, q], gradients[e, q, b], v)
                    k += volumes[e, q] * (G[0] * v[0] + G[1] * v[1] + G[2] * v[2])
                block = data[blocks[t, a // per, b // per]]
                for i in range(3):
                    block[3 * row + i, 3 * col + i] += k
