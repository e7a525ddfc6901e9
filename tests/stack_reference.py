"""The linear response of a flat bonded stack under a stretched skin, by fine elements through the depth alone."""

from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded
from scipy.special import j0, j1

from stmpl_core.tissue import Tissue

_GAUSS, _WEIGHT = np.polynomial.legendre.leggauss(3)
_BAND = 6  # diagonals: the unknowns of an element


def compliance(tissue: Tissue, thickness: float, wave: np.ndarray) -> np.ndarray:
    """Motion of the surface under a unit pressure cos(k x): sinking over cos(k x), along x over sin(k x).

    In plane strain u_x = U(z) sin(k x), u_z = W(z) cos(k x), z inwards, minimise

        int lambda (k U + W')^2 + 2 mu (k^2 U^2 + W'^2) + mu (U' - k W)^2 dz + (E_s h / (1 - nu_s^2)) k^2 U_0^2
        + T k^2 W_0^2 - 2 W_0

    over quadratic elements, forty to each material. `wave`: k, (K,) [1/m]. Returns (K, 2) [m/Pa].
    """
    starts = [0.0, *(ply.depth for ply in tissue.deeper if ply.depth < thickness), thickness]
    ends = np.unique(np.concatenate([a + (b - a) * np.linspace(0, 1, 41) ** 1.5 for a, b in pairwise(starts)]))
    materials = [(tissue.youngs_modulus, tissue.poisson_ratio)]
    materials += [(ply.youngs_modulus, ply.poisson_ratio) for ply in tissue.deeper]
    n = 4 * (len(ends) - 1)  # U and W, node after node; those of the core are held
    parts = np.zeros((3, _BAND, n + 2))  # of k^0, k^1, k^2, lower diagonals
    for e, (a, b) in enumerate(pairwise(ends)):
        modulus, nu = materials[int(np.searchsorted(starts[1:-1], (a + b) / 2))]
        mu, lam = modulus / (2 * (1 + nu)), modulus * nu / ((1 + nu) * (1 - 2 * nu))
        for s, weight in zip(_GAUSS, 0.5 * (b - a) * _WEIGHT, strict=True):
            u, w, du, dw = np.zeros((4, 6))
            u[::2] = w[1::2] = [s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2]
            du[::2] = dw[1::2] = np.array([s - 0.5, -2 * s, s + 0.5]) * 2 / (b - a)
            both = lam * np.outer(u, dw) - mu * np.outer(du, w)
            forms = ((lam + 2 * mu) * np.outer(dw, dw) + mu * np.outer(du, du), both + both.T,
                     (lam + 2 * mu) * np.outer(u, u) + mu * np.outer(w, w))  # fmt: skip
            for part, form in zip(parts, forms, strict=True):
                for i in range(6):
                    part[: 6 - i, 4 * e + i] += weight * form[i:, i]
    if (skin := tissue.skin) is not None:
        parts[2, 0, :2] += [skin.stiffness / (1 - skin.poisson_ratio**2), skin.tension]
    load = np.eye(n)[1]
    return np.array([solveh_banded((parts[0] + k * parts[1] + k * k * parts[2])[:, :n], load, lower=True)[[1, 0]]
                     for k in wave])  # fmt: skip


def under_a_gaussian(tissue: Tissue, thickness: float, peak: float, width: float, radius: np.ndarray) -> np.ndarray:
    """Sinking and motion outwards, (R, 2) [m], under a pressure peak exp(-r^2 / (2 width^2)) at `radius` (R,) [m].

    Hankel transforms of order 0 and 1 of the response to plane waves (Sneddon, "Fourier Transforms", 1951, sec. 7).
    """
    wave = (np.arange(150) + 0.5) * 6 / width / 150
    weight = peak * width**2 * np.exp(-0.5 * (wave * width) ** 2) * wave * (wave[1] - wave[0])
    response, phase = weight[:, None] * compliance(tissue, thickness, wave), np.outer(radius, wave)
    return np.stack([j0(phase) @ response[:, 0], j1(phase) @ response[:, 1]], axis=-1)
