"""SkinMembrane: the energy of a stretched skin on the surface of a patch, with its forces and its tangent.

A thin sheet of the compressible Neo-Hookean solid in plane stress, under a tension at rest. With C = F^T F of the
surface (2 x 2), j = sqrt(det C) and c = l^2, l the stretch across the sheet that leaves no stress there,

    W = h [mu/2 (tr C + c - 3) - mu ln(j l) + mu/2 (1 - c) ln(j l)] + T (j - 1) - f_0 . u
    (1 - 2 nu) (c - 1) + 2 nu ln j + nu ln c = 0

(Bonet & Wood, 2nd ed., eq. 6.28, with lambda ln(j l) = mu (1 - c) from the second line; nu = 0.5 gives c = 1 / j^2).
Its stress is S = h mu (I - c C^-1) + T j C^-1. The tension is a constant energy of T an area, as that of a film of
liquid (Gurtin & Murdoch, Arch. Ration. Mech. Anal. 57, 1975), so that E_s h stays the stiffness against small
stretches: T adds T k^2 against a wave k across the skin, and nothing along it. A limb at rest has its shape *under* the
tension: something balances it there, and goes on with the same forces f_0, the gradient of the other terms at u = 0,
which are therefore subtracted. Its stiffness stays.
"""

from __future__ import annotations

from math import exp, expm1, log1p

import numpy as np
from numba import njit

from fem_tools.mesh import WedgeMesh, reference_skin
from fem_tools.neo_hookean import FAST
from stmpl_core.tissue import Membrane


class SkinMembrane:
    """A membrane on the skin of a mesh: linear or quadratic in plane as the wedges are, on their straight faces.

    Args:
        mesh: wedges that carry it.
        skin: its numbers.
    """

    def __init__(self, mesh: WedgeMesh, skin: Membrane) -> None:
        self.mesh, self.nu = mesh, skin.poisson_ratio
        self.shear = skin.stiffness / (2 * (1 + skin.poisson_ratio))  # mu h [N/m]
        self.tension, self.scale = skin.tension, 1.0  # share of mu that acts (see fem_tools.relaxation)
        self.gradients, self.axes, self.areas = _rest(mesh)
        self.balanced = np.zeros((mesh.n_columns, 3))  # f_0 [N]
        self.balanced -= self.forces(np.zeros((mesh.n_columns, 3)))[0]

    def _arguments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, float, float]:
        return self.mesh.columns, self.gradients, self.axes, self.areas, self.scale * self.shear, self.nu, self.tension

    def energy(self, u: np.ndarray) -> float:
        """Energy at a displacement of the skin columns (C, 3) [m], in J; infinite where a face has no area."""
        return membrane_energy(u, *self._arguments()) + float(np.vdot(self.balanced, u))

    def forces(self, u: np.ndarray) -> tuple[np.ndarray, float]:
        """Gradient of the energy on the skin columns, (C, 3) [N], and the smallest j [-]; at (C, 3) [m]."""
        out = self.balanced.copy()
        smallest = membrane_forces(u, *self._arguments(), out)
        return out, smallest

    def elastic_stress(self, u: np.ndarray) -> np.ndarray:
        """h mu (I - c C^-1) in the body's axes, (T, Q, 6) as xx, yy, zz, yz, zx, xy [N/m]; at (C, 3) [m]."""
        flat = np.empty((*self.areas.shape, 2, 2))
        membrane_stress(u, self.mesh.columns, self.gradients, self.axes, self.shear, self.nu, flat)
        full = np.einsum("tai,tqab,tbj->tqij", self.axes, flat, self.axes)
        return full[..., (0, 1, 2, 1, 2, 0), (0, 1, 2, 2, 0, 1)]

    def add_tangent(self, u: np.ndarray, data: np.ndarray, *, convex: float = 0.0) -> None:
        """Adds the second derivative of the energy to the skin level of the tangent's blocks [N/m].

        `convex`: share, 0 to 1, of what may be negative that is left out (see neo_hookean.tangent).
        """
        membrane_tangent(u, *self._arguments(), self.mesh.blocks, convex, data)


def _rest(mesh: WedgeMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients along the face's own axes (T, Q, n, 2) [1/m], those axes (T, 2, 3) and areas of points (T, Q) [m2]."""
    reference = reference_skin(mesh.element, 1 if mesh.element == "P1xP2" else 2)
    a, b, c = (mesh.outer[mesh.triangles[:, k]] for k in range(3))
    first = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    normal = np.cross(b - a, c - a)
    double = np.linalg.norm(normal, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal / double, first)], axis=1)
    jacobian = np.stack([np.einsum("txi,ti->tx", axes, b - a), np.einsum("txi,ti->tx", axes, c - a)], axis=2)
    gradients = np.einsum("qnk,tkx->tqnx", reference.slope, np.linalg.inv(jacobian))
    return np.ascontiguousarray(gradients), axes, double * reference.weight


@njit(cache=True, fastmath=FAST)
def _surface(local, G, axes, F, inverse):
    """Writes F (3, 2) and C^-1 (2, 2) = (xx, xy, yy) of a face's point; returns tr C - 2 and ln j (-inf: no area).

    C - I is summed from the displacement's gradient, so that small stretches lose no digits.
    """
    xx = xy = yy = 0.0
    for i in range(3):
        h0 = h1 = 0.0
        for a in range(local.shape[0]):
            h0 += local[a, i] * G[a, 0]
            h1 += local[a, i] * G[a, 1]
        xx += (2 * axes[0, i] + h0) * h0
        yy += (2 * axes[1, i] + h1) * h1
        xy += axes[0, i] * h1 + h0 * axes[1, i] + h0 * h1
        F[i, 0], F[i, 1] = axes[0, i] + h0, axes[1, i] + h1
    growth = xx + yy + xx * yy - xy * xy  # det C - 1
    if not growth > -1.0:
        return 0.0, -np.inf
    inverse[0], inverse[1], inverse[2] = (1 + yy) / (1 + growth), -xy / (1 + growth), (1 + xx) / (1 + growth)
    return xx + yy, 0.5 * log1p(growth)


@njit(cache=True, fastmath=FAST)
def _thinning(log_j, nu):
    """ln c, the root of (1 - 2 nu) (c - 1) + nu ln c = -2 nu ln j; Newton on a convex function comes from above."""
    if nu == 0.0:
        return 0.0
    q = -2 * nu * log_j / (1 - nu)  # the root for small stretches
    for _ in range(50):
        step = ((1 - 2 * nu) * expm1(q) + nu * q + 2 * nu * log_j) / ((1 - 2 * nu) * exp(q) + nu)
        q -= step
        if abs(step) < 1e-14 * (1e-3 + abs(q)):
            break
    return q


@njit(cache=True, fastmath=FAST)
def _gather(u, columns, local):
    for a in range(len(columns)):
        for i in range(3):
            local[a, i] = u[columns[a], i]


@njit(cache=True, fastmath=FAST)
def membrane_energy(u, columns, gradients, axes, areas, shear, nu, tension):
    """Energy of the sheet [J] at a displacement of the skin columns (C, 3) [m], without the part of f_0."""
    local, F, inverse, total = np.empty((gradients.shape[2], 3)), np.empty((3, 2)), np.empty(3), 0.0
    for t in range(gradients.shape[0]):
        _gather(u, columns[t], local)
        for k in range(gradients.shape[1]):
            grown, log_j = _surface(local, gradients[t, k], axes[t], F, inverse)
            if not log_j > -np.inf:
                return np.inf
            q = _thinning(log_j, nu)
            volume, thick = log_j + 0.5 * q, expm1(q)  # ln of the volume's ratio, and c - 1
            elastic = 0.5 * (grown + thick) - volume - 0.5 * thick * volume
            total += areas[t, k] * (shear * elastic + tension * expm1(log_j))
    return total


@njit(cache=True, fastmath=FAST)
def membrane_forces(u, columns, gradients, axes, areas, shear, nu, tension, forces):
    """Adds the gradient of that energy to `forces` (C, 3) [N]; returns the smallest j [-], 0 where it stops."""
    local, F, inverse, smallest = np.empty((gradients.shape[2], 3)), np.empty((3, 2)), np.empty(3), np.inf
    for t in range(gradients.shape[0]):
        _gather(u, columns[t], local)
        for k in range(gradients.shape[1]):
            G = gradients[t, k]
            _, log_j = _surface(local, G, axes[t], F, inverse)
            if not log_j > -np.inf:
                return 0.0
            j = exp(log_j)
            smallest = min(smallest, j)
            spread = shear * exp(_thinning(log_j, nu)) - tension * j  # S = mu h I - spread C^-1
            xx, xy = areas[t, k] * (shear - spread * inverse[0]), -areas[t, k] * spread * inverse[1]
            yy = areas[t, k] * (shear - spread * inverse[2])
            for a in range(len(local)):
                x, y = xx * G[a, 0] + xy * G[a, 1], xy * G[a, 0] + yy * G[a, 1]
                for i in range(3):
                    forces[columns[t, a], i] += F[i, 0] * x + F[i, 1] * y
    return smallest


@njit(cache=True, fastmath=FAST)
def membrane_stress(u, columns, gradients, axes, shear, nu, out):
    """Writes shear (I - c C^-1), the stress without the tension, along the face's axes, (T, Q, 2, 2) [N/m]."""
    local, F, inverse = np.empty((gradients.shape[2], 3)), np.empty((3, 2)), np.empty(3)
    for t in range(gradients.shape[0]):
        _gather(u, columns[t], local)
        for k in range(gradients.shape[1]):
            _, log_j = _surface(local, gradients[t, k], axes[t], F, inverse)
            c = shear * exp(_thinning(log_j, nu))
            out[t, k, 0, 0], out[t, k, 1, 1] = shear - c * inverse[0], shear - c * inverse[2]
            out[t, k, 0, 1] = out[t, k, 1, 0] = -c * inverse[1]


@njit(cache=True, fastmath=FAST)
def membrane_tangent(u, columns, gradients, axes, areas, shear, nu, tension, blocks, convex, data):
    """Adds the second derivative of that energy to the first level of `data` (n_blocks, 3 m, 3 m) [N/m].

    With g_a = F C^-1 grad N_a, n the face's normal and s = h mu c - T j,

        K_ab = h mu (grad N_a . grad N_b) I + (h mu beta c + T j) g_a (x) g_b + s (g_b (x) g_a - (g_a . g_b) n (x) n)

    beta = 2 nu / ((1 - 2 nu) c + nu). What may be negative is the skew part of s g_b (x) g_a and the last term where
    s > 0 (a sheet under pressure buckles), and all of the former where s < 0.
    """
    n_nodes = gradients.shape[2]
    local, F, inverse = np.empty((n_nodes, 3)), np.empty((3, 2)), np.empty(3)
    g, normal = np.empty((n_nodes, 3)), np.empty(3)
    for t in range(gradients.shape[0]):
        _gather(u, columns[t], local)
        for k in range(gradients.shape[1]):
            G, w = gradients[t, k], areas[t, k]
            _, log_j = _surface(local, G, axes[t], F, inverse)
            if not log_j > -np.inf:
                continue
            j, c = exp(log_j), exp(_thinning(log_j, nu))
            normal[0] = (F[1, 0] * F[2, 1] - F[2, 0] * F[1, 1]) / j
            normal[1] = (F[2, 0] * F[0, 1] - F[0, 0] * F[2, 1]) / j
            normal[2] = (F[0, 0] * F[1, 1] - F[1, 0] * F[0, 1]) / j
            straight = w * shear
            spread = w * (shear * c * 2 * nu / ((1 - 2 * nu) * c + nu) + tension * j) if nu > 0 else w * tension * j
            cross = w * (shear * c - tension * j)
            skew = 0.5 * convex * max(cross, 0.0)
            across = cross - convex * max(cross, 0.0) + skew
            cross -= skew if cross > 0.0 else convex * cross
            for a in range(n_nodes):
                x = inverse[0] * G[a, 0] + inverse[1] * G[a, 1]
                y = inverse[1] * G[a, 0] + inverse[2] * G[a, 1]
                for i in range(3):
                    g[a, i] = F[i, 0] * x + F[i, 1] * y
            for a in range(n_nodes):
                for b in range(n_nodes):
                    flat = g[a, 0] * g[b, 0] + g[a, 1] * g[b, 1] + g[a, 2] * g[b, 2]
                    d = straight * (G[a, 0] * G[b, 0] + G[a, 1] * G[b, 1]) + skew * flat
                    block = data[blocks[t, a, b]]
                    for i in range(3):
                        block[i, i] += d
                        for m in range(3):
                            block[i, m] += spread * g[a, i] * g[b, m] + cross * g[b, i] * g[a, m]
                            block[i, m] -= across * flat * normal[i] * normal[m]
