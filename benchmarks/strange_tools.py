"""Twenty tools of kinds that no network was trained on, by signed distance functions in millimetres, z up, on z = 0."""

from __future__ import annotations

from collections.abc import Callable

import igl
import numpy as np

from benchmarks.tools import cup, peanut, roller, star
from stmpl_core.tool import Tool

SPACING = 0.6  # mm, of the grid that a shape is meshed on

Distance = Callable[[np.ndarray], np.ndarray]  # points (N, 3) [mm] to distances, about, (N,) [mm]


def strange_tools() -> dict[str, Tool]:
    """The tools by name."""
    shapes: dict[str, Distance] = {
        "three balls": lambda p: _blend([_ball(p, _ring(k, 3, 9), 6) for k in range(3)], 2),
        "knuckles": lambda p: _blend([_ball(p, (13 * k - 19.5, 1.5 * (k % 2), 0), 6.5) for k in range(4)], 3),
        "brush": lambda p: _join([_ball(_tall(p, 8), _ring(k, 6, 7.5) if k < 6 else (0, 0, 0), 2.2) for k in range(7)]),
        "cross": lambda p: _prism(p, _join([_box(p, (13, 3)), _box(p, (3, 13))]), 6, 1.5),
        "ring plate": lambda p: _prism(p, np.abs(np.hypot(p[:, 0], p[:, 1]) - 10) - 3.5, 5, 1.5),
        "crescent": lambda p: _prism(p, np.maximum(_disc(p, 0, 13), 5 - np.hypot(p[:, 0] - 9, p[:, 1])), 5, 1.5),
        "triangle": lambda p: _prism(p, np.max([p[:, :2] @ _ring(k, 3, 1)[:2] for k in range(3)], axis=0) - 6.5, 6, 2),
        "heart": lambda p: _prism(p, _blend([_disc(p, -5, 7), _disc(p, 5, 7), np.hypot(p[:, 0], p[:, 1] + 6) - 4], 4),
                                  5, 1.5),
        "fluted roller": lambda p: _capsule(p, 12) - 9 - 0.8 * np.cos(9 * np.arctan2(p[:, 1], p[:, 2])),
        "egg": lambda p: _ball(p * np.column_stack([0.7 + 0 * p[:, 0], *2 * [1 + 0.012 * p[:, 0]]]), (0, 0, 0), 10),
        "cone": lambda p: _blend([np.hypot(p[:, 0], p[:, 1]) * 0.8 - (p[:, 2] + 9) * 0.6, p[:, 2] - 9], -3) - 1.5,
        "convex probe": lambda p: _prism(p[:, [0, 2, 1]], np.maximum(np.hypot(p[:, 0], p[:, 2] - 32) - 40,
                                                                     np.abs(p[:, 0]) - 20), 6, 3),
        "hook": lambda p: np.hypot(np.hypot(p[:, 0], np.minimum(p[:, 2] - 4, 0)) - 12, p[:, 1]) - 4,
        "wavy plate": lambda p: _prism(p, _box(p, (17, 13)), 5 + 0.9 * np.cos(0.9 * p[:, 0]), 2),
        "soft cube": lambda p: (np.abs(p / [9.0, 9.0, 9.0]) ** 4).sum(axis=1) ** 0.25 * 9 - 9,
        "mushroom": lambda p: _blend([_ball(p, (0, 0, 14), 20), p[:, 2] - 1], -2),
    }  # fmt: skip
    made = {name: _meshed(name, distance) for name, distance in shapes.items()}
    others = [roller(8, 12, 30), peanut(7, 18), star(5, 14, 7), cup(11, 4)]
    return dict(zip(("saddle roller", "peanut", "star", "cup"), others, strict=True)) | made


def _ring(k: int, count: int, radius: float) -> np.ndarray:
    return radius * np.array([np.cos(2 * np.pi * k / count), np.sin(2 * np.pi * k / count), 0])


def _ball(p: np.ndarray, centre: np.ndarray | tuple[float, ...], radius: float) -> np.ndarray:
    return np.linalg.norm(p - centre, axis=1) - radius


def _tall(p: np.ndarray, length: float) -> np.ndarray:
    """Points with a length of z taken out: balls become pegs."""
    return np.column_stack([p[:, :2], np.minimum(p[:, 2], 0) + np.maximum(p[:, 2] - length, 0)])


def _capsule(p: np.ndarray, half: float) -> np.ndarray:
    """Distance from a segment along x."""
    return np.linalg.norm(np.column_stack([np.maximum(np.abs(p[:, 0]) - half, 0), p[:, 1:]]), axis=1)


def _disc(p: np.ndarray, x: float, radius: float) -> np.ndarray:
    return np.hypot(p[:, 0] - x, p[:, 1]) - radius


def _box(p: np.ndarray, half: tuple[float, float]) -> np.ndarray:
    away = np.abs(p[:, :2]) - half
    return np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)


def _prism(p: np.ndarray, outline: np.ndarray, half: float | np.ndarray, fillet: float) -> np.ndarray:
    """An outline's distance made a body about z = 0, its edges rounded."""
    away = np.stack([outline + fillet, np.abs(p[:, 2]) - half + fillet])
    return np.linalg.norm(np.maximum(away, 0), axis=0) + np.minimum(away.max(axis=0), 0) - fillet


def _join(parts: list[np.ndarray]) -> np.ndarray:
    return np.min(parts, axis=0)


def _blend(parts: list[np.ndarray], width: float) -> np.ndarray:
    """Union with a fillet of a width; a width below 0: intersection."""
    return -width * np.log(np.exp(-np.stack(parts) / width).sum(axis=0))


def _meshed(name: str, distance: Distance) -> Tool:
    """The surface of a shape, lowered to z = 0."""
    side = np.arange(-32.17, 32, SPACING)
    grid = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3, order="F")
    inside = np.maximum(distance(grid), np.abs(grid).max(axis=1) - 30)
    vertices, faces, _ = igl.marching_cubes(inside, grid, *(len(side),) * 3, 0.0)
    vertices = 1e-3 * (vertices - [0, 0, vertices[:, 2].min()])
    return Tool(name, vertices, faces)
