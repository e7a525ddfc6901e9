"""Small skins and loads that several tests press on."""

import numpy as np


def plate(n: int, h: float) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of n x n vertices, h apart [m], facing +z, with its diagonals turned about."""
    x = np.arange(n) * h
    vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((n, n))], axis=-1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij"))
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
    even = ((i + j) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(even, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return vertices, np.vstack([first, second])


def limb(h: float, radius: float = 0.04, length: float = 0.16) -> tuple[np.ndarray, np.ndarray]:
    """An open cylinder along +z of nearly equilateral triangles with edges h [m], facing outwards."""
    around, along = round(2 * np.pi * radius / h), round(length / (h * 0.866))
    ring, turn = np.meshgrid(np.arange(along + 1), np.arange(around), indexing="ij")
    angle = 2 * np.pi * (turn + 0.5 * (ring % 2)) / around
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), ring * length / along], axis=-1).reshape(-1, 3)
    k, i = (x.ravel() for x in np.meshgrid(np.arange(along), np.arange(around), indexing="ij"))
    a, b = k * around + i, k * around + (i + 1) % around
    c, d = a + around, b + around
    even = (k % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(even, np.stack([b, d, c], axis=1), np.stack([a, d, c], axis=1))
    return vertices, np.vstack([first, second])


def smooth_disc(vertices: np.ndarray, centre: np.ndarray, radius: float, edge: float) -> np.ndarray:
    """1 within `radius` of `centre`, falling to 0 over `edge` by a smoothstep centred on the rim, (V,)."""
    x = np.clip((radius - np.linalg.norm(vertices - centre, axis=1)) / edge + 0.5, 0, 1)
    return x * x * (3 - 2 * x)
