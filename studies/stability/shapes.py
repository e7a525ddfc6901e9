"""Tools to press with: solids of revolution and boxes of any size, each made once."""

from __future__ import annotations

from functools import cache

import numpy as np

from stmpl_core.tool import Tool

AROUND = 32  # corners around an axis
ARC = 24  # edges of half a circle


@cache
def ball(radius: float, name: str = "ball") -> Tool:
    """A ball around the origin. Radius in m, here and below."""
    return revolved(name, _arc(radius, 0.0, -90, 90, ARC))


@cache
def capsule(radius: float, length: float, name: str = "capsule") -> Tool:
    """A cylinder of this length along z with round ends."""
    ends = _arc(radius, -length / 2, -90, 0, ARC // 2), _arc(radius, length / 2, 0, 90, ARC // 2)
    return revolved(name, np.concatenate(ends))


@cache
def punch(radius: float, height: float, name: str = "punch", fillet: float = 0.0) -> Tool:
    """A cylinder along z, its edges sharp or rounded to a fillet."""
    half, inner = height / 2, radius - fillet
    if not fillet:
        return revolved(name, np.array([[0, -half], [radius, -half], [radius, half], [0, half]]))
    arcs = [_arc(fillet, side * (half - fillet), start, start + 90, 8) for side, start in ((-1, -90), (1, 0))]
    return revolved(name, np.concatenate([[[0, -half]], *(arc + [inner, 0] for arc in arcs), [[0, half]]]))


@cache
def ring(radius: float, thick: float, name: str = "ring") -> Tool:
    """A torus around z: radius of its middle line and of its tube."""
    angle = 2 * np.pi * np.arange(ARC) / ARC
    return revolved(name, np.stack([radius + thick * np.cos(angle), thick * np.sin(angle)], axis=1), closed=True)


@cache
def box(x: float, y: float, z: float, name: str = "box") -> Tool:
    """A box with these sides around the origin."""
    corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]) * (x, y, z)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Tool(name, corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]))


@cache
def cup(inner: float, outer: float, height: float, name: str = "cup") -> Tool:
    """A cylinder with a hollow of 3/4 of its height, rim down, the rim's middle at the origin."""
    profile = [[0, 0.75 * height], [inner, 0.75 * height], [inner, 0], [outer, 0], [outer, height], [0, height]]
    return revolved(name, np.array(profile))


@cache
def needle(width: float, name: str = "needle") -> Tool:
    """A flat-ended cylinder of this width and 40 mm along z, its end around the origin."""
    return revolved(name, np.array([[0, 0], [width / 2, 0], [width / 2, 0.04], [0, 0.04]]))


@cache
def pencil(width: float, name: str = "pencil") -> Tool:
    """A cone of 7 mm and 20 mm along z, cut off at this width, its end around the origin."""
    return revolved(name, np.array([[0, 0], [width / 2, 0], [3.5e-3 + width / 2, 0.02], [0, 0.02]]))


def revolved(name: str, profile: np.ndarray, closed: bool = False) -> Tool:
    """A tool of a profile, (N, 2) radius and height [m], turned about z; `closed`: the profile is a loop."""
    n = len(profile)
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    radius, height = profile[:, :1], np.repeat(profile[:, 1:], AROUND, axis=1)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1).reshape(-1, 3)
    number = np.arange(n * AROUND).reshape(n, AROUND)
    if not closed:  # the ends lie on the axis: one point each
        number[0], number[-1] = number[0, 0], number[-1, 0]
    lower, upper = (number, np.roll(number, -1, axis=0)) if closed else (number[:-1], number[1:])
    a, b, c, d = lower, np.roll(lower, -1, axis=1), np.roll(upper, -1, axis=1), upper
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    sound = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    used, faces = np.unique(faces[sound], return_inverse=True)
    return Tool(name, points[used], faces.reshape(-1, 3))


def _arc(radius: float, height: float, start: float, end: float, count: int) -> np.ndarray:
    """Points of an arc around (0, height), from one angle to another [degrees], (count + 1, 2)."""
    angle = np.radians(np.linspace(start, end, count + 1))
    points = np.stack([radius * np.cos(angle), height + radius * np.sin(angle)], axis=1)
    points[np.abs(points[:, 0]) < 1e-9 * radius, 0] = 0.0
    return points
