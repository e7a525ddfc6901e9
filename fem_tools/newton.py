"""Inexact Newton: Krylov solvers preconditioned by columns, kept in J > 0 by a line search, continued in load."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fem_tools.krylov import bicgstab, conjugate_gradients, dot, precondition
from fem_tools.system import System
from stmpl_core.errors import InvalidInput

MAX_WORK = 3e11  # multiplications of one solve or press: some ten minutes of one core
TANGENT_COST = 30  # products with a tangent that its assembly, its preconditioner and a line search cost together
CONVEX = (0.1, 0.3, 1.0)  # shares of the skew part that are left out of an indefinite tangent, tried in turn


@dataclass(frozen=True)
class NewtonSettings:
    """Where Newton stops.

    Args:
        tolerance: residual over load, both in the norm of the column preconditioner [-].
        max_iterations: most Newton steps a load step.
        max_halvings: most halvings of a load step before giving up.
        min_j: smallest det F that the line search accepts [-].
        linear_iterations: most steps of the linear solver a Newton step.
        forcing: largest residual that the linear solver may leave of a Newton step's [-].
        max_work: multiplications after which a solve stops, whatever it has reached. It is counted, not timed, so that
            every machine stops at the same place.
    """

    tolerance: float = 1e-5
    max_iterations: int = 25
    max_halvings: int = 4
    min_j: float = 0.02
    linear_iterations: int = 300
    forcing: float = 0.1
    max_work: float = MAX_WORK

    def __post_init__(self) -> None:
        if not self.max_work > 0:
            raise InvalidInput(f"max_work is {self.max_work}; it must be above 0 multiplications.")


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
    work: float = 0.0  # multiplications that it took, about
    scale: float = 0.0  # what the residual was measured by [sqrt(J)]


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
    iterations, linear, work = tried.iterations, tried.linear_iterations, tried.work
    best = NewtonResult(system.zeros(), True, 0.0, 1.0, 0, 0, 0.0)
    step, halvings = 0.5, 0
    while best.load_factor < 1.0 and halvings <= settings.max_halvings and work < settings.max_work:
        target = min(1.0, best.load_factor + step)
        for start in _starts(best, target, guess):
            tried = newton(system, start, target, replace(settings, max_work=max(settings.max_work - work, 1.0)))
            iterations, linear = iterations + tried.iterations, linear + tried.linear_iterations
            work += tried.work
            if tried.converged:
                best = tried
                break
        else:
            step, halvings = step / 2, halvings + 1
    return replace(best, converged=best.load_factor >= 1.0, iterations=iterations, linear_iterations=linear, work=work)


def work_spent(work: float, limit: float) -> str:
    """Sentence on a limit of work that was reached [multiplications]; empty if it was not."""
    if work < limit:
        return ""
    return (f"its limit of work is spent, {work:.1e} of {limit:.1e} multiplications. "
            "Try a coarser mesh, fewer splits, a smaller reach, or a higher max_work")  # fmt: skip


def _starts(best: NewtonResult, target: float, guess: Callable[[float], np.ndarray] | None) -> list[np.ndarray]:
    """Where to start a load step: stretched from the last one, or as it is; from the guess at first."""
    if best.load_factor == 0.0:
        return [guess(target)] if guess else [best.u]
    return [best.u * (target / best.load_factor), best.u]


def newton(system: System, u: np.ndarray, factor: float, settings: NewtonSettings) -> NewtonResult:
    """Newton from `u` at one share of the loads; energy descent where they are conservative."""
    m = system.mesh
    linear, tangents, history = 0, 1, []
    r, min_j = system.residual(u, factor)
    if not min_j > settings.min_j:
        u = system.zeros()
        r, min_j = system.residual(u, factor)
    data = system.tangent(u, factor)
    product = float(data.size)  # multiplications
    inverse = system.preconditioner(data)
    best = (np.inf, u, min_j)
    for iteration in range(settings.max_iterations + 1):
        # in the last tangent's norm: a new one costs a step
        relative, scale = relative_residual(system, inverse, r, u, factor)
        work = product * (linear + TANGENT_COST * tangents)
        if relative < best[0]:
            best = (relative, u, min_j)
        if relative <= settings.tolerance:
            return NewtonResult(u, True, relative, min_j, iteration, linear, factor, work, scale)
        history.append(relative)
        stalled = len(history) > 5 and history[-1] > 0.3 * history[-6] and not system.conservative
        if iteration == settings.max_iterations or not np.isfinite(relative) or stalled or work >= settings.max_work:
            break
        if iteration:
            tangents += 1
            data = system.tangent(u, factor)
            inverse = system.preconditioner(data)
        most = int(min(settings.linear_iterations, max(1.0, (settings.max_work - work) / product)))
        forcing = float(np.clip(0.5 * relative**0.5, 0.5 * settings.tolerance / relative, settings.forcing))
        if system.conservative:
            du, n, _, negative = conjugate_gradients(
                m.indptr, m.indices, data, inverse, -r, forcing, most
            )
            for convex in CONVEX:  # no minimum in sight along this tangent: as little of a convex one as it takes
                if not negative:
                    break
                linear, tangents = linear + n, tangents + 1
                data = system.tangent(u, factor, convex=convex)
                inverse = system.preconditioner(data)
                du, n, _, negative = conjugate_gradients(
                    m.indptr, m.indices, data, inverse, -r, forcing, most
                )
            stepped = _descend(system, u, du, r, factor, settings)
        else:
            du, n, _ = bicgstab(m.indptr, m.indices, data, inverse, -r, forcing, most)
            stepped = line_search(system, u, du, r, inverse, factor, settings)
        linear += n
        if stepped is None:
            break
        u, r, min_j = stepped
    work = product * (linear + TANGENT_COST * tangents)
    return NewtonResult(best[1], False, best[0], best[2], iteration, linear, factor, work)


def relative_residual(
    system: System, inverse: np.ndarray, r: np.ndarray, u: np.ndarray, factor: float
) -> tuple[float, float]:
    """The residual over the load, or over the internal forces where they are larger [-]; and that scale [sqrt(J)]."""
    load = _load_vector(system, u, factor)
    scale = max(_norm(inverse, load), _norm(inverse, r + load), system.least)
    return (_norm(inverse, r) / scale if scale > 0 else 0.0), scale


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


def line_search(
    system: System, u: np.ndarray, du: np.ndarray, r: np.ndarray, inverse: np.ndarray, factor: float,
    settings: NewtonSettings,
) -> tuple[np.ndarray, np.ndarray, float] | None:  # fmt: skip
    """Halves a step (C, 3 m) until det F stays positive and the residual does not grow; None if nothing helps."""
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
    precondition(inverse, r, z)
    return float(max(dot(r, z), 0.0)) ** 0.5


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
