"""Inexact Newton: Krylov solvers preconditioned by columns, kept in J > 0 by a line search, continued in load."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numba import njit

from fem_tools import neo_hookean as nh
from fem_tools.mesh import WedgeMesh
from stmpl_core.layer import Tissue

log = logging.getLogger(__name__)

CONVEX = (0.1, 0.3, 1.0)  # shares of the skew part that are left out of an indefinite tangent, tried in turn


class SkinLoad(Protocol):
    """Something that presses on the skin; `factor` in [0, 1] is the share of it that acts (load continuation).

    `conservative`: its forces are minus the gradient of `potential`, which then steers the line search.
    """

    conservative: bool

    def potential(self, skin: np.ndarray, factor: float) -> float:
        """Its potential energy [J]; only asked where `conservative`."""
        ...

    def add_forces(self, skin: np.ndarray, factor: float, forces: np.ndarray) -> None:
        """Adds its forces on the skin columns, (C, 3) [N], at the deformed positions `skin` (C, 3) [m]."""
        ...

    def add_tangent(
        self, skin: np.ndarray, factor: float, data: np.ndarray, *, symmetric: bool, convex: float = 0.0
    ) -> None:
        """Adds its stiffness, -d forces / d skin, to the skin level of the tangent's blocks.

        `symmetric`: only the symmetric part; `convex`: the share, 0 to 1, of what may be negative that is left out.
        """
        ...


@dataclass(frozen=True)
class NewtonSettings:
    """Where Newton stops.

    Args:
        tolerance: residual over load, both in the norm of the column preconditioner [-].
        max_iterations: Newton steps a load step.
        max_halvings: how often a load step may be halved before giving up.
        min_j: smallest det F that the line search accepts [-].
        linear_iterations: steps of the linear solver a Newton step.
        forcing: largest residual that the linear solver may leave of a Newton step's [-].
    """

    tolerance: float = 1e-5
    max_iterations: int = 25
    max_halvings: int = 4
    min_j: float = 0.02
    linear_iterations: int = 300
    forcing: float = 0.1


@dataclass(frozen=True)
class NewtonResult:
    """What Newton reached, and what it saw on the way."""

    u: np.ndarray  # (C, levels, 3) [m]
    converged: bool
    residual: float  # relative [-]
    min_j: float
    iterations: int
    linear_iterations: int
    load_factor: float  # share of the load that was reached


class System:
    """Residual, tangent and constraints of one patch under some loads.

    Args:
        mesh: the wedges.
        tissue: of all of them.
        loads: what presses.
        fixed: columns that do not move at all, mask (C,).
        keep: projectors on the motions that each column may make, (C, 3, 3); None: all, but for the fixed ones.
    """

    def __init__(
        self,
        mesh: WedgeMesh,
        tissue: Tissue,
        loads: Sequence[SkinLoad],
        fixed: np.ndarray,
        keep: np.ndarray | None = None,
    ) -> None:
        self.mesh, self.tissue = mesh, tissue
        self.loads: Sequence[SkinLoad] = loads
        self.mu, self.lam = tissue.shear_modulus, tissue.lame_lambda
        self.rest = mesh.rest_positions()
        self.fixed = fixed
        self.keep = keep
        self.free = mesh.levels - 1
        self.diagonal = diagonal_blocks(mesh.indptr, mesh.indices)  # block of each column with itself

    def zeros(self) -> np.ndarray:
        """No displacement, (C, levels, 3)."""
        return np.zeros((self.mesh.n_columns, self.mesh.levels, 3))

    @property
    def conservative(self) -> bool:
        """Whether all loads are: then the tangent is symmetric and an equilibrium is a minimum of the energy."""
        return all(load.conservative for load in self.loads)

    def energy(self, u: np.ndarray, factor: float) -> float:
        """Stored energy plus the loads' potential [J]; infinite where an element is folded."""
        m, skin = self.mesh, self.rest[:, 0] + u[:, 0]
        stored = nh.strain_energy(u, m.columns, m.layers, m.gradients, m.volumes, self.mu, self.lam)
        return stored + sum(load.potential(skin, factor) for load in self.loads)

    def internal(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """Internal forces (C, levels, 3) [N] and the smallest det F."""
        m, forces = self.mesh, np.zeros_like(u)
        smallest = nh.internal_forces(u, m.columns, m.layers, m.gradients, m.volumes, self.mu, self.lam, forces)
        return forces, smallest

    def external(self, u: np.ndarray, factor: float) -> np.ndarray:
        """Forces of the loads on the skin, (C, 3) [N]."""
        skin = self.rest[:, 0] + u[:, 0]
        forces = np.zeros_like(skin)
        for load in self.loads:
            load.add_forces(skin, factor, forces)
        return forces

    def residual(self, u: np.ndarray, factor: float) -> tuple[np.ndarray, float]:
        """Internal minus external forces of the free levels, (C, 3 m) [N], and the smallest det F."""
        forces, smallest = self.internal(u)
        forces[:, 0] -= self.external(u, factor)
        return forces[:, : self.free].reshape(len(u), -1), smallest

    def tangent(self, u: np.ndarray, factor: float, *, symmetric: bool = False, convex: float = 0.0) -> np.ndarray:
        """Blocks of the tangent (or of its symmetric, or of a positive part), (n_blocks, 3 m, 3 m) [N/m]."""
        m, width = self.mesh, 3 * self.free
        data = np.zeros((len(m.indices), width, width))
        nh.tangent(u, m.columns, m.blocks, m.layers, m.gradients, m.volumes, self.mu, self.lam, convex, data)
        skin = self.rest[:, 0] + u[:, 0]
        for load in self.loads:
            load.add_tangent(skin, factor, data, symmetric=symmetric, convex=convex)
        return data

    def preconditioner(self, data: np.ndarray) -> np.ndarray:
        """Inverse of each column's own block, (C, 3 m, 3 m); zero where constrained, which is what constrains CG."""
        diagonal = data[self.diagonal]
        if self.keep is None:
            inverse = _inverse_spd(diagonal)
        else:
            project = np.einsum("mn,cij->cminj", np.eye(self.free), self.keep).reshape(diagonal.shape)
            rest = np.eye(diagonal.shape[1]) - project
            scale = np.trace(diagonal, axis1=1, axis2=2)[:, None, None]
            inverse = project @ _inverse_spd(project @ diagonal @ project + rest * scale) @ project
        inverse[self.fixed] = 0.0
        return inverse


def _inverse_spd(blocks: np.ndarray) -> np.ndarray:
    """Inverse of symmetric blocks; where one is not positive definite its eigenvalues are taken positive."""
    try:
        np.linalg.cholesky(blocks)
        return np.linalg.inv(blocks)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(blocks)
        values = np.maximum(np.abs(values), 1e-3 * np.abs(values).max(axis=1, keepdims=True))
        return np.einsum("cij,cj,ckj->cik", vectors, 1 / values, vectors)


@njit(cache=True)
def diagonal_blocks(indptr, indices):
    out = np.empty(len(indptr) - 1, dtype=np.int64)
    for c in range(len(out)):
        for k in range(indptr[c], indptr[c + 1]):
            if indices[k] == c:
                out[c] = k
    return out


@njit(cache=True, fastmath=nh.FAST)
def multiply(indptr, indices, data, x, y):
    """y = A x for blocks of 3 x 3 tiles; x and y are (C, 3 m)."""
    width = x.shape[1]
    for c in range(len(indptr) - 1):
        y[c] = 0.0
        for k in range(indptr[c], indptr[c + 1]):
            block, v = data[k], x[indices[k]]
            for i in range(0, width, 3):
                s0 = s1 = s2 = 0.0
                for j in range(width):
                    s0 += block[i, j] * v[j]
                    s1 += block[i + 1, j] * v[j]
                    s2 += block[i + 2, j] * v[j]
                y[c, i] += s0
                y[c, i + 1] += s1
                y[c, i + 2] += s2


@njit(cache=True, fastmath=nh.FAST)
def _precondition(inverse, r, z):
    for c in range(r.shape[0]):
        for i in range(r.shape[1]):
            s = 0.0
            for j in range(r.shape[1]):
                s += inverse[c, i, j] * r[c, j]
            z[c, i] = s


@njit(cache=True, fastmath=nh.FAST)
def _dot(a, b):
    s = 0.0
    for c in range(a.shape[0]):
        for i in range(a.shape[1]):
            s += a[c, i] * b[c, i]
    return s


@njit(cache=True, fastmath=nh.FAST)
def conjugate_gradients(indptr, indices, data, inverse, b, tolerance, max_iterations):
    """Truncated preconditioned CG (Nocedal & Wright, 2nd ed., alg. 7.1 without the radius).

    Returns x, iterations, relative residual in the preconditioner's norm, and whether p^T A p <= 0 was met.
    """
    x, r, z, p, q = np.zeros_like(b), b.copy(), np.empty_like(b), np.empty_like(b), np.empty_like(b)
    _precondition(inverse, r, z)
    p[:] = z
    rz = _dot(r, z)
    start = rz
    if not start > 0.0:
        return x, 0, 0.0, False
    for n in range(max_iterations):
        multiply(indptr, indices, data, p, q)
        curvature = _dot(p, q)
        if not curvature > 0.0:
            if n == 0:
                x[:] = p
            return x, n, (rz / start) ** 0.5, True
        alpha = rz / curvature
        for c in range(b.shape[0]):
            for i in range(b.shape[1]):
                x[c, i] += alpha * p[c, i]
                r[c, i] -= alpha * q[c, i]
        _precondition(inverse, r, z)
        new = _dot(r, z)
        if new <= tolerance * tolerance * start:
            return x, n + 1, (new / start) ** 0.5, False
        beta = new / rz
        rz = new
        for c in range(b.shape[0]):
            for i in range(b.shape[1]):
                p[c, i] = z[c, i] + beta * p[c, i]
    return x, max_iterations, (rz / start) ** 0.5, False


@njit(cache=True, fastmath=nh.FAST)
def bicgstab(indptr, indices, data, inverse, b, tolerance, max_iterations):
    """Preconditioned BiCGSTAB for tangents that are not symmetric (van der Vorst, SIAM J. Sci. Stat. Comput. 13, 1992).

    Returns x, iterations and the relative residual in the preconditioner's norm.
    """
    x, r, shadow = np.zeros_like(b), np.empty_like(b), np.empty_like(b)
    p, v, t = np.zeros_like(b), np.zeros_like(b), np.empty_like(b)
    work = np.empty_like(b)
    _precondition(inverse, b, r)  # solves M^-1 A x = M^-1 b
    shadow[:] = r
    start = _dot(r, b)
    norm0 = _dot(r, r)
    if not start > 0.0:
        return x, 0, 0.0
    rho, alpha, omega = 1.0, 1.0, 1.0
    for n in range(max_iterations):
        new = _dot(shadow, r)
        if new == 0.0 or omega == 0.0:
            return x, n, (_dot(r, r) / norm0) ** 0.5
        beta = (new / rho) * (alpha / omega) if n > 0 else 0.0
        rho = new
        for c in range(b.shape[0]):
            for i in range(b.shape[1]):
                p[c, i] = r[c, i] + beta * (p[c, i] - omega * v[c, i])
        multiply(indptr, indices, data, p, work)
        _precondition(inverse, work, v)
        along = _dot(shadow, v)
        if along == 0.0:  # breakdown
            return x, n, (_dot(r, r) / norm0) ** 0.5
        alpha = rho / along
        for c in range(b.shape[0]):
            for i in range(b.shape[1]):
                r[c, i] -= alpha * v[c, i]
        multiply(indptr, indices, data, r, work)
        _precondition(inverse, work, t)
        tt = _dot(t, t)
        omega = _dot(t, r) / tt if tt > 0.0 else 0.0
        for c in range(b.shape[0]):
            for i in range(b.shape[1]):
                x[c, i] += alpha * p[c, i] + omega * r[c, i]
                r[c, i] -= omega * t[c, i]
        now = _dot(r, r)
        if not now < 1e8 * norm0:
            return x, n + 1, 1e4
        if now <= tolerance * tolerance * norm0:
            return x, n + 1, (now / norm0) ** 0.5
    return x, max_iterations, (_dot(r, r) / norm0) ** 0.5


def solve(
    system: System,
    u: np.ndarray | None = None,
    settings: NewtonSettings | None = None,
    guess: Callable[[float], np.ndarray] | None = None,
) -> NewtonResult:
    """Solves residual = 0 at the full load: directly from `u` (or `guess(1)`), else in load steps from rest.

    Never raises for a scene that cannot be solved: the result says how far it came.
    """
    settings = settings or NewtonSettings()
    tried = newton(system, u if u is not None else guess(1.0) if guess else system.zeros(), 1.0, settings)
    if tried.converged:
        return tried
    iterations, linear = tried.iterations, tried.linear_iterations
    best = NewtonResult(system.zeros(), True, 0.0, 1.0, 0, 0, 0.0)
    step, halvings = 0.5, 0
    while best.load_factor < 1.0 and halvings <= settings.max_halvings:
        target = min(1.0, best.load_factor + step)
        for start in _starts(best, target, guess):
            tried = newton(system, start, target, settings)
            iterations, linear = iterations + tried.iterations, linear + tried.linear_iterations
            if tried.converged:
                best = tried
                break
        else:
            step, halvings = step / 2, halvings + 1
    return replace(best, converged=best.load_factor >= 1.0, iterations=iterations, linear_iterations=linear)


def _starts(best: NewtonResult, target: float, guess: Callable[[float], np.ndarray] | None) -> list[np.ndarray]:
    """Where to start a load step: stretched from the last one, or as it is; from the guess at first."""
    if best.load_factor == 0.0:
        return [guess(target)] if guess else [best.u]
    return [best.u * (target / best.load_factor), best.u]


def newton(system: System, u: np.ndarray, factor: float, settings: NewtonSettings) -> NewtonResult:
    """Newton from `u` at one share of the loads; energy descent where they are conservative."""
    m = system.mesh
    linear, history = 0, []
    r, min_j = system.residual(u, factor)
    if not min_j > settings.min_j:
        u = system.zeros()
        r, min_j = system.residual(u, factor)
    data = system.tangent(u, factor)
    inverse = system.preconditioner(data)
    best = (np.inf, u, min_j)
    for iteration in range(settings.max_iterations + 1):
        relative = _relative(system, inverse, r, u, factor)  # in the last tangent's norm: a new one costs as a step
        if relative < best[0]:
            best = (relative, u, min_j)
        if relative <= settings.tolerance:
            return NewtonResult(u, True, relative, min_j, iteration, linear, factor)
        history.append(relative)
        stalled = len(history) > 5 and history[-1] > 0.3 * history[-6] and not system.conservative
        if iteration == settings.max_iterations or not np.isfinite(relative) or stalled:
            break
        if iteration:
            data = system.tangent(u, factor)
            inverse = system.preconditioner(data)
        forcing = float(np.clip(0.5 * relative**0.5, 0.5 * settings.tolerance / relative, settings.forcing))
        if system.conservative:
            du, n, _, negative = conjugate_gradients(
                m.indptr, m.indices, data, inverse, -r, forcing, settings.linear_iterations
            )
            for convex in CONVEX:  # no minimum in sight along this tangent: as little of a convex one as it takes
                if not negative:
                    break
                linear += n
                data = system.tangent(u, factor, convex=convex)
                inverse = system.preconditioner(data)
                du, n, _, negative = conjugate_gradients(
                    m.indptr, m.indices, data, inverse, -r, forcing, settings.linear_iterations
                )
            stepped = _descend(system, u, du, r, factor, settings)
        else:
            du, n, _ = bicgstab(m.indptr, m.indices, data, inverse, -r, forcing, settings.linear_iterations)
            stepped = _line_search(system, u, du, r, inverse, factor, settings)
        linear += n
        if stepped is None:
            break
        u, r, min_j = stepped
    return NewtonResult(best[1], False, best[0], best[2], iteration, linear, factor)


def _relative(system: System, inverse: np.ndarray, r: np.ndarray, u: np.ndarray, factor: float) -> float:
    """The residual over the load, or over the internal forces where they are larger [-]."""
    load = _load_vector(system, u, factor)
    scale = max(_norm(inverse, load), _norm(inverse, r + load))
    return _norm(inverse, r) / scale if scale > 0 else 0.0


def _descend(system: System, u, du, r, factor: float, settings: NewtonSettings):
    """Armijo's rule on the energy, with det F kept positive (Nocedal & Wright, sec. 3.1)."""
    full = np.zeros_like(u)
    full[:, : system.free] = du.reshape(len(u), system.free, 3)
    slope, start, alpha = float(np.vdot(r, du)), system.energy(u, factor), 1.0
    for _ in range(12):
        trial = u + alpha * full
        if system.energy(trial, factor) <= start + 1e-4 * alpha * slope + 1e-12 * abs(start):
            trial_r, trial_j = system.residual(trial, factor)
            if trial_j > settings.min_j:
                return trial, trial_r, trial_j
        alpha *= 0.5
    return None


def _line_search(system: System, u, du, r, inverse, factor: float, settings: NewtonSettings):
    """Halves the step until det F stays positive and the residual does not grow; None if nothing helps."""
    full = np.zeros_like(u)
    full[:, : system.free] = du.reshape(len(u), system.free, 3)
    now, alpha, fallback = _norm(inverse, r), 1.0, None
    for _ in range(8):
        trial = u + alpha * full
        trial_r, trial_j = system.residual(trial, factor)
        if trial_j > settings.min_j:
            norm = _norm(inverse, trial_r)
            if norm <= (1 - 0.1 * alpha) * now:
                return trial, trial_r, trial_j
            if fallback is None or norm < fallback[0]:
                fallback = (norm, trial, trial_r, trial_j)
        alpha *= 0.5
    return fallback[1:] if fallback is not None and fallback[0] < 1.5 * now else None


def _load_vector(system: System, u: np.ndarray, factor: float) -> np.ndarray:
    vector = np.zeros((len(u), system.free, 3))
    vector[:, 0] = system.external(u, factor)
    return vector.reshape(len(u), -1)


def _norm(inverse: np.ndarray, r: np.ndarray) -> float:
    z = np.empty_like(r)
    _precondition(inverse, r, z)
    return float(max(_dot(r, z), 0.0)) ** 0.5


def is_positive_definite(system: System, u: np.ndarray, factor: float = 1.0, *, seed: int = 0) -> bool:
    """Whether the symmetric tangent at `u` is positive definite on the free directions.

    CG on a random right-hand side explores the whole spectrum: on an indefinite matrix it meets p^T A p <= 0
    (Nocedal & Wright, sec. 7.1). Exact up to eigenvalues that the random vector misses by chance.
    """
    m, data = system.mesh, system.tangent(u, factor, symmetric=True)
    inverse = system.preconditioner(data)
    b = np.random.default_rng(seed).standard_normal((m.n_columns, 3 * system.free))
    b *= np.sqrt(np.abs(np.einsum("cii->ci", data[system.diagonal])))
    return not conjugate_gradients(m.indptr, m.indices, data, inverse, b, 1e-6, 1000)[3]
