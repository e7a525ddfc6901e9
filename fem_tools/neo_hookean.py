"""Fused kernels of the compressible Neo-Hookean solid on wedges: residual, tangent and follower pressure.

psi = mu/2 (I_C - 3) - mu ln J + lambda/2 (ln J)^2 (Bonet & Wood, 2nd ed., eq. 6.28), so that
P = mu (F - F^-T) + lambda ln J F^-T and, with g_a = F^-T grad N_a,
K_ab = mu (grad N_a . grad N_b) I + (mu - lambda ln J) g_b (x) g_a + lambda g_a (x) g_b.
"""

from __future__ import annotations

from math import log

import numpy as np
from numba import njit

FAST = {"contract", "reassoc", "nsz", "arcp"}  # not nnan: a folded element must show


def energy_density(F: np.ndarray, mu: float, lam: float) -> float:
    """psi at one deformation gradient (3, 3) [J/m3]; the definition that the kernels are tested against."""
    J = np.linalg.det(F)
    return float(0.5 * mu * ((F * F).sum() - 3) - mu * np.log(J) + 0.5 * lam * np.log(J) ** 2)


@njit(cache=True, fastmath=FAST)
def _deformation(u, gradients, F):
    """F = I + sum_a u_a (x) grad N_a."""
    for i in range(3):
        for j in range(3):
            F[i, j] = 1.0 if i == j else 0.0
    for a in range(u.shape[0]):
        for i in range(3):
            for j in range(3):
                F[i, j] += u[a, i] * gradients[a, j]


@njit(cache=True, fastmath=FAST)
def invert(F, inv):
    """Writes the inverse of a 3 x 3 matrix and returns its determinant; zeros where that is 0."""
    c00 = F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1]
    c01 = F[1, 2] * F[2, 0] - F[1, 0] * F[2, 2]
    c02 = F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0]
    det = F[0, 0] * c00 + F[0, 1] * c01 + F[0, 2] * c02
    s = 1.0 / det if det != 0.0 else 0.0
    inv[0, 0], inv[1, 0], inv[2, 0] = c00 * s, c01 * s, c02 * s
    inv[0, 1] = (F[0, 2] * F[2, 1] - F[0, 1] * F[2, 2]) * s
    inv[1, 1] = (F[0, 0] * F[2, 2] - F[0, 2] * F[2, 0]) * s
    inv[2, 1] = (F[0, 1] * F[2, 0] - F[0, 0] * F[2, 1]) * s
    inv[0, 2] = (F[0, 1] * F[1, 2] - F[0, 2] * F[1, 1]) * s
    inv[1, 2] = (F[0, 2] * F[1, 0] - F[0, 0] * F[1, 2]) * s
    inv[2, 2] = (F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]) * s
    return det


@njit(cache=True, fastmath=FAST)
def internal_forces(u, columns, layers, gradients, volumes, mus, lams, forces):
    """Adds the internal forces [N] to `forces` (C, levels, 3) and returns the smallest det F; stops where it is <= 0.

    u: (C, levels, 3) [m]; gradients (T L, Q, 3 n, 3) [1/m]; volumes (T L, Q) [m3]; mus and lams of the wedges,
    (T L,) [Pa].
    """
    n_nodes, n_points = gradients.shape[2], gradients.shape[1]
    local, F, inv, P = np.empty((n_nodes, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    smallest = np.inf
    for e in range(gradients.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        mu, lam = mus[e], lams[e]
        for a in range(n_nodes):
            for i in range(3):
                local[a, i] = u[columns[t, a // 3], level + a % 3, i]
        for q in range(n_points):
            _deformation(local, gradients[e, q], F)
            J = invert(F, inv)
            smallest = min(smallest, J)
            if not J > 0.0:
                return J
            factor = lam * log(J) - mu
            for i in range(3):
                for j in range(3):
                    P[i, j] = (mu * F[i, j] + factor * inv[j, i]) * volumes[e, q]
            for a in range(n_nodes):
                for i in range(3):
                    forces[columns[t, a // 3], level + a % 3, i] += (
                        P[i, 0] * gradients[e, q, a, 0]
                        + P[i, 1] * gradients[e, q, a, 1]
                        + P[i, 2] * gradients[e, q, a, 2]
                    )
    return smallest


@njit(cache=True, fastmath=FAST)
def strain_energy(u, columns, layers, gradients, volumes, mus, lams):
    """The stored energy [J] at u; infinite where an element is folded."""
    n_nodes = gradients.shape[2]
    local, F, inv = np.empty((n_nodes, 3)), np.empty((3, 3)), np.empty((3, 3))
    total = 0.0
    for e in range(gradients.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        mu, lam = mus[e], lams[e]
        for a in range(n_nodes):
            for i in range(3):
                local[a, i] = u[columns[t, a // 3], level + a % 3, i]
        for q in range(gradients.shape[1]):
            _deformation(local, gradients[e, q], F)
            J = invert(F, inv)
            if not J > 0.0:
                return np.inf
            trace = 0.0
            for i in range(3):
                for j in range(3):
                    trace += F[i, j] * F[i, j]
            total += volumes[e, q] * (0.5 * mu * (trace - 3.0) - mu * log(J) + 0.5 * lam * log(J) ** 2)
    return total


@njit(cache=True, fastmath=FAST)
def tangent(u, columns, blocks, layers, gradients, volumes, mus, lams, convex, data):
    """Adds the tangent [N/m] to `data` (n_blocks, 3 m, 3 m), m = 2 L free levels; the bonded level is left out.

    With l = dF F^-1 the second variation is mu |dF|^2 + (mu - lambda ln J) l : l^T + lambda (tr l)^2. Only
    l : l^T = |sym l|^2 - |skw l|^2 can be negative; `convex` is the share of the skew part
    that is left out: 1 is safely positive, 0 the true tangent.
    """
    n_nodes, free = gradients.shape[2], 2 * layers
    local, F, inv = np.empty((n_nodes, 3)), np.empty((3, 3)), np.empty((3, 3))
    g, K = np.empty((n_nodes, 3)), np.empty((n_nodes, n_nodes, 9))
    for e in range(gradients.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        mu, lam = mus[e], lams[e]
        for a in range(n_nodes):
            for i in range(3):
                local[a, i] = u[columns[t, a // 3], level + a % 3, i]
        K[:] = 0.0
        for q in range(gradients.shape[1]):
            G = gradients[e, q]
            _deformation(local, G, F)
            J = invert(F, inv)
            w = volumes[e, q]
            w_mu, w_lam = w * mu, w * lam
            w_cross = w * (mu - lam * log(J)) if J > 0.0 else w_mu
            w_skew = 0.5 * convex * max(w_cross, 0.0)
            w_cross -= w_skew
            for a in range(n_nodes):
                for i in range(3):
                    g[a, i] = inv[0, i] * G[a, 0] + inv[1, i] * G[a, 1] + inv[2, i] * G[a, 2]
            for a in range(n_nodes):
                A0, A1, A2 = w_mu * G[a, 0], w_mu * G[a, 1], w_mu * G[a, 2]
                c0, c1, c2 = w_cross * g[a, 0], w_cross * g[a, 1], w_cross * g[a, 2]
                l0, l1, l2 = w_lam * g[a, 0], w_lam * g[a, 1], w_lam * g[a, 2]
                for b in range(a, n_nodes):
                    b0, b1, b2 = g[b, 0], g[b, 1], g[b, 2]
                    d = A0 * G[b, 0] + A1 * G[b, 1] + A2 * G[b, 2]
                    d += w_skew * (g[a, 0] * b0 + g[a, 1] * b1 + g[a, 2] * b2)
                    k = K[a, b]
                    k[0] += d + (c0 + l0) * b0
                    k[1] += c1 * b0 + l0 * b1
                    k[2] += c2 * b0 + l0 * b2
                    k[3] += c0 * b1 + l1 * b0
                    k[4] += d + (c1 + l1) * b1
                    k[5] += c2 * b1 + l1 * b2
                    k[6] += c0 * b2 + l2 * b0
                    k[7] += c1 * b2 + l2 * b1
                    k[8] += d + (c2 + l2) * b2
        for a in range(n_nodes):
            row = level + a % 3
            if row == free:
                continue
            for b in range(a, n_nodes):
                col = level + b % 3
                if col == free:
                    continue
                upper = data[blocks[t, a // 3, b // 3]]
                for i in range(3):
                    for j in range(3):
                        upper[3 * row + i, 3 * col + j] += K[a, b, 3 * i + j]
                if a != b:
                    lower = data[blocks[t, b // 3, a // 3]]
                    for i in range(3):
                        for j in range(3):
                            lower[3 * col + j, 3 * row + i] += K[a, b, 3 * i + j]


@njit(cache=True, fastmath=FAST)
def _face_tangents(x, columns, slope, s, r):
    """Writes x_xi and x_eta of a deformed face."""
    for i in range(3):
        s[i] = r[i] = 0.0
        for a in range(len(columns)):
            s[i] += slope[a, 0] * x[columns[a], i]
            r[i] += slope[a, 1] * x[columns[a], i]


@njit(cache=True, fastmath=FAST)
def follower_forces(x, columns, pressure, value, slope, linear, weight, forces):
    """Adds the forces of a follower pressure to `forces` (C, 3): -int p N_a (x_xi x x_eta) dxi deta [N].

    x: skin positions (C, 3) [m]; pressure at the triangle corners (T, 3) [Pa]; Bonet & Wood eq. 8.21.
    """
    n = columns.shape[1]
    s, r = np.empty(3), np.empty(3)
    for t in range(columns.shape[0]):
        if pressure[t, 0] == 0.0 and pressure[t, 1] == 0.0 and pressure[t, 2] == 0.0:
            continue
        for q in range(weight.shape[0]):
            p = pressure[t, 0] * linear[q, 0] + pressure[t, 1] * linear[q, 1] + pressure[t, 2] * linear[q, 2]
            _face_tangents(x, columns[t], slope[q], s, r)
            w = p * weight[q]
            n0, n1, n2 = s[1] * r[2] - s[2] * r[1], s[2] * r[0] - s[0] * r[2], s[0] * r[1] - s[1] * r[0]
            for a in range(n):
                f = w * value[q, a]
                forces[columns[t, a], 0] -= f * n0
                forces[columns[t, a], 1] -= f * n1
                forces[columns[t, a], 2] -= f * n2


@njit(cache=True, fastmath=FAST)
def follower_tangent(x, columns, blocks, pressure, value, slope, linear, weight, symmetric, data):
    """Adds the follower pressure's stiffness [N/m] to the skin level of `data`.

    K_ab = int p N_a (N_b,eta [x_xi]x - N_b,xi [x_eta]x) (Bonet & Wood, eq. 8.26). It is symmetric where the pressure is
    uniform; `symmetric` keeps (K + K^T) / 2 elsewhere, which is enough to test stability.
    """
    n = columns.shape[1]
    s, r, v, half = np.empty(3), np.empty(3), np.empty(3), np.empty((n, n, 3))
    for t in range(columns.shape[0]):
        if pressure[t, 0] == 0.0 and pressure[t, 1] == 0.0 and pressure[t, 2] == 0.0:
            continue
        half[:] = 0.0
        for q in range(weight.shape[0]):
            p = pressure[t, 0] * linear[q, 0] + pressure[t, 1] * linear[q, 1] + pressure[t, 2] * linear[q, 2]
            _face_tangents(x, columns[t], slope[q], s, r)
            w = p * weight[q]
            for a in range(n):
                for b in range(n):
                    for i in range(3):
                        half[a, b, i] += w * value[q, a] * (slope[q, b, 1] * s[i] - slope[q, b, 0] * r[i])
        for a in range(n):
            for b in range(n):
                for i in range(3):  # the transpose of [v]x is -[v]x
                    v[i] = 0.5 * (half[a, b, i] - half[b, a, i]) if symmetric else half[a, b, i]
                block = data[blocks[t, a, b]]
                block[0, 1] -= v[2]
                block[0, 2] += v[1]
                block[1, 0] += v[2]
                block[1, 2] -= v[0]
                block[2, 0] -= v[1]
                block[2, 1] += v[0]
