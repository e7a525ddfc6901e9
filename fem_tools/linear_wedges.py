"""The kernels of neo_hookean for wedges that are linear in plane, twice as quick: sums are split over depth and plane.

A shape function is N_kl = L_k(xi, eta) phi_l(zeta). In plane a displacement is linear, so u,xi and u,eta are the same
at all points of one depth, and F = I + sum_K u,K (x) G_K with G_K the gradients of xi, eta and zeta at rest: three
products instead of nine (sum factorisation; Orszag, J. Comput. Phys. 37, 1980). The tangent is summed over the plane as
derivatives by xi, eta and zeta, S_KM, and only then spread to the nodes. Small arrays are tuples, which stay in
registers.
"""

from __future__ import annotations

from math import log

import numpy as np
from numba import njit

from fem_tools.neo_hookean import FAST


@njit(cache=True, fastmath=FAST)
def _at_depth(u, corners, level, p, s):
    """u,xi and u,eta, and u,zeta at the three corners, at the depth with shape functions `p` and slopes `s`."""
    a, b, c = corners[0], corners[1], corners[2]
    m, n = level + 1, level + 2
    a0 = p[0] * u[a, level, 0] + p[1] * u[a, m, 0] + p[2] * u[a, n, 0]
    a1 = p[0] * u[a, level, 1] + p[1] * u[a, m, 1] + p[2] * u[a, n, 1]
    a2 = p[0] * u[a, level, 2] + p[1] * u[a, m, 2] + p[2] * u[a, n, 2]
    xi = (
        p[0] * u[b, level, 0] + p[1] * u[b, m, 0] + p[2] * u[b, n, 0] - a0,
        p[0] * u[b, level, 1] + p[1] * u[b, m, 1] + p[2] * u[b, n, 1] - a1,
        p[0] * u[b, level, 2] + p[1] * u[b, m, 2] + p[2] * u[b, n, 2] - a2,
    )
    eta = (
        p[0] * u[c, level, 0] + p[1] * u[c, m, 0] + p[2] * u[c, n, 0] - a0,
        p[0] * u[c, level, 1] + p[1] * u[c, m, 1] + p[2] * u[c, n, 1] - a1,
        p[0] * u[c, level, 2] + p[1] * u[c, m, 2] + p[2] * u[c, n, 2] - a2,
    )
    return xi, eta, _down(u, a, level, s), _down(u, b, level, s), _down(u, c, level, s)


@njit(cache=True, fastmath=FAST)
def _down(u, c, level, s):
    """u,zeta of one column."""
    return (
        s[0] * u[c, level, 0] + s[1] * u[c, level + 1, 0] + s[2] * u[c, level + 2, 0],
        s[0] * u[c, level, 1] + s[1] * u[c, level + 1, 1] + s[2] * u[c, level + 2, 1],
        s[0] * u[c, level, 2] + s[1] * u[c, level + 1, 2] + s[2] * u[c, level + 2, 2],
    )


@njit(cache=True, fastmath=FAST)
def _row(i, along, share, G):
    """Row i of F without the unit matrix."""
    xi, eta = along[0][i], along[1][i]
    zeta = share[0] * along[2][i] + share[1] * along[3][i] + share[2] * along[4][i]
    return (
        xi * G[0, 0] + eta * G[1, 0] + zeta * G[2, 0],
        xi * G[0, 1] + eta * G[1, 1] + zeta * G[2, 1],
        xi * G[0, 2] + eta * G[1, 2] + zeta * G[2, 2],
    )


@njit(cache=True, fastmath=FAST)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, fastmath=FAST)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, fastmath=FAST)
def _deformation(along, share, G):
    """Rows of F, of its cofactors F^-T det F, and det F."""
    a, b, c = _row(0, along, share, G), _row(1, along, share, G), _row(2, along, share, G)
    f0, f1, f2 = (a[0] + 1.0, a[1], a[2]), (b[0], b[1] + 1.0, b[2]), (c[0], c[1], c[2] + 1.0)
    c0 = _cross(f1, f2)
    return (f0, f1, f2), (c0, _cross(f2, f0), _cross(f0, f1)), _dot(f0, c0)


@njit(cache=True, fastmath=FAST)
def internal_forces(u, columns, layers, natural, volumes, mus, lams, phi, slope, plane, forces):
    """As neo_hookean.internal_forces, with `natural` (T L, Q, 3, 3) [1/m] and the tables of mesh.linear_tables."""
    flux = np.empty((5, 3))  # stress along xi and eta; along zeta, at each corner
    smallest = np.inf
    for e in range(natural.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        mu, lam, corners = mus[e], lams[e], columns[t]
        for z in range(phi.shape[0]):
            p, s = (phi[z, 0], phi[z, 1], phi[z, 2]), (slope[z, 0], slope[z, 1], slope[z, 2])
            along = _at_depth(u, corners, level, p, s)
            flux[:] = 0.0
            for q in range(plane.shape[0]):
                point = q * phi.shape[0] + z
                G, w = natural[e, point], volumes[e, point]
                share = (plane[q, 0], plane[q, 1], plane[q, 2])
                F, C, J = _deformation(along, share, G)
                smallest = min(smallest, J)
                if not J > 0.0:
                    return J
                direct, factor = w * mu, w * (lam * log(J) - mu) / J
                xi, eta, zeta = (G[0, 0], G[0, 1], G[0, 2]), (G[1, 0], G[1, 1], G[1, 2]), (G[2, 0], G[2, 1], G[2, 2])
                for i in range(3):
                    f, c = F[i], C[i]
                    P = (direct * f[0] + factor * c[0], direct * f[1] + factor * c[1], direct * f[2] + factor * c[2])
                    down = _dot(P, zeta)
                    flux[0, i] += _dot(P, xi)
                    flux[1, i] += _dot(P, eta)
                    flux[2, i] += share[0] * down
                    flux[3, i] += share[1] * down
                    flux[4, i] += share[2] * down
            for a in range(3):
                value, rise, at = phi[z, a], slope[z, a], level + a
                for i in range(3):
                    xi_, eta_ = value * flux[0, i], value * flux[1, i]
                    forces[corners[0], at, i] += rise * flux[2, i] - xi_ - eta_
                    forces[corners[1], at, i] += rise * flux[3, i] + xi_
                    forces[corners[2], at, i] += rise * flux[4, i] + eta_
    return smallest


@njit(cache=True, fastmath=FAST)
def _add(sums, share, S):
    """sums + share S, nine numbers each."""
    return (
        sums[0] + share * S[0], sums[1] + share * S[1], sums[2] + share * S[2],
        sums[3] + share * S[3], sums[4] + share * S[4], sums[5] + share * S[5],
        sums[6] + share * S[6], sums[7] + share * S[7], sums[8] + share * S[8],
    )  # fmt: skip


@njit(cache=True, fastmath=FAST)
def _transposed(S):
    return S[0], S[3], S[6], S[1], S[4], S[7], S[2], S[5], S[8]


@njit(cache=True, fastmath=FAST)
def _stiffness(g, h, a, b, factors):
    """S_ab = (mu G_a . G_b) I + (mu - lambda ln J) h_b (x) h_a + lambda h_a (x) h_b, with h = F^-T G; row by row."""
    w_mu, w_skew, w_cross, w_lam = factors
    d = w_mu * _dot(g[a], g[b]) + w_skew * _dot(h[a], h[b])
    x, y = h[a], h[b]
    c = (w_cross * y[0], w_cross * y[1], w_cross * y[2])
    e = (w_lam * x[0], w_lam * x[1], w_lam * x[2])
    return (
        c[0] * x[0] + e[0] * y[0] + d, c[0] * x[1] + e[0] * y[1], c[0] * x[2] + e[0] * y[2],
        c[1] * x[0] + e[1] * y[0], c[1] * x[1] + e[1] * y[1] + d, c[1] * x[2] + e[1] * y[2],
        c[2] * x[0] + e[2] * y[0], c[2] * x[1] + e[2] * y[1], c[2] * x[2] + e[2] * y[2] + d,
    )  # fmt: skip


@njit(cache=True, fastmath=FAST)
def _times(C, s, v):
    """s C v."""
    return s * _dot(C[0], v), s * _dot(C[1], v), s * _dot(C[2], v)


NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@njit(cache=True, fastmath=FAST)
def tangent(u, columns, blocks, layers, natural, volumes, mus, lams, phi, slope, plane, convex, data):
    """As neo_hookean.tangent, with `natural` (T L, Q, 3, 3) [1/m] and the tables of mesh.linear_tables."""
    free = 2 * layers
    K = np.empty((3, 3, 54))  # level, level; pairs of corners 00, 01, 02, 11, 12, 22, nine numbers each
    parts = np.empty((4, 54))  # of those pairs: both derivatives in plane; only the first, the second; none
    for e in range(natural.shape[0]):
        t, level = e // layers, 2 * (e % layers)
        mu, lam, corners = mus[e], lams[e], columns[t]
        levels = min(3, free - level)
        K[:] = 0.0
        for z in range(phi.shape[0]):
            p, s = (phi[z, 0], phi[z, 1], phi[z, 2]), (slope[z, 0], slope[z, 1], slope[z, 2])
            along = _at_depth(u, corners, level, p, s)
            xx = xy = yy = x0 = x1 = x2 = y0 = y1 = y2 = d00 = d01 = d02 = d11 = d12 = d22 = NOTHING
            for q in range(plane.shape[0]):
                point = q * phi.shape[0] + z
                G, w = natural[e, point], volumes[e, point]
                share = (plane[q, 0], plane[q, 1], plane[q, 2])
                _, C, J = _deformation(along, share, G)
                w_cross = w * (mu - lam * log(J)) if J > 0.0 else w * mu
                w_skew = 0.5 * convex * max(w_cross, 0.0)
                factors = (w * mu, w_skew, w_cross - w_skew, w * lam)
                g = ((G[0, 0], G[0, 1], G[0, 2]), (G[1, 0], G[1, 1], G[1, 2]), (G[2, 0], G[2, 1], G[2, 2]))
                r = 1.0 / J if J != 0.0 else 0.0
                h = (_times(C, r, g[0]), _times(C, r, g[1]), _times(C, r, g[2]))
                xx = _add(xx, 1.0, _stiffness(g, h, 0, 0, factors))
                xy = _add(xy, 1.0, _stiffness(g, h, 0, 1, factors))
                yy = _add(yy, 1.0, _stiffness(g, h, 1, 1, factors))
                S = _stiffness(g, h, 0, 2, factors)
                x0, x1, x2 = _add(x0, share[0], S), _add(x1, share[1], S), _add(x2, share[2], S)
                S = _stiffness(g, h, 1, 2, factors)
                y0, y1, y2 = _add(y0, share[0], S), _add(y1, share[1], S), _add(y2, share[2], S)
                S = _stiffness(g, h, 2, 2, factors)
                d00, d01 = _add(d00, share[0] * share[0], S), _add(d01, share[0] * share[1], S)
                d02, d11 = _add(d02, share[0] * share[2], S), _add(d11, share[1] * share[1], S)
                d12, d22 = _add(d12, share[1] * share[2], S), _add(d22, share[2] * share[2], S)
            yx = _transposed(xy)
            o0, o1, o2 = _minus(x0, y0), _minus(x1, y1), _minus(x2, y2)  # of corner 0, whose L is 1 - xi - eta
            _put(parts, 0, _sum(_sum(xx, xy), _sum(yx, yy)), o0, _transposed(o0), d00)
            _put(parts, 9, _minus(xx, yx), o1, _transposed(x0), d01)
            _put(parts, 18, _minus(xy, yy), o2, _transposed(y0), d02)
            _put(parts, 27, xx, x1, _transposed(x1), d11)
            _put(parts, 36, xy, x2, _transposed(y1), d12)
            _put(parts, 45, yy, y2, _transposed(y2), d22)
            for a in range(levels):
                for n in range(levels):
                    _spread(K[a, n], p[a] * p[n], p[a] * s[n], s[a] * p[n], s[a] * s[n], parts)
        pair = 0
        for k in range(3):
            for m in range(k, 3):
                upper, lower = data[blocks[t, k, m]], data[blocks[t, m, k]]
                for a in range(levels):
                    for n in range(levels):
                        row, col, tile = 3 * (level + a), 3 * (level + n), K[a, n, pair : pair + 9]
                        for i in range(3):
                            for j in range(3):
                                upper[row + i, col + j] += tile[3 * i + j]
                        if k != m:
                            for i in range(3):
                                for j in range(3):
                                    lower[col + j, row + i] += tile[3 * i + j]
                pair += 9


@njit(cache=True, fastmath=FAST)
def _sum(a, b):
    return _add(a, 1.0, b)


@njit(cache=True, fastmath=FAST)
def _minus(a, b):
    """-a - b, nine numbers each."""
    return _add(_add(NOTHING, -1.0, a), -1.0, b)


@njit(cache=True, fastmath=FAST)
def _put(parts, at, across, mixed, mixed_back, down):
    _write(parts[0], at, across)
    _write(parts[1], at, mixed)
    _write(parts[2], at, mixed_back)
    _write(parts[3], at, down)


@njit(cache=True, fastmath=FAST)
def _write(row, at, S):
    row[at], row[at + 1], row[at + 2] = S[0], S[1], S[2]
    row[at + 3], row[at + 4], row[at + 5] = S[3], S[4], S[5]
    row[at + 6], row[at + 7], row[at + 8] = S[6], S[7], S[8]


@njit(cache=True, fastmath=FAST)
def _spread(to, flat, first, second, steep, parts):
    """Adds one depth's stiffness between two levels, all pairs of corners at once."""
    for i in range(54):
        to[i] += flat * parts[0, i] + first * parts[1, i] + second * parts[2, i] + steep * parts[3, i]
