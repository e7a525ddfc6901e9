"""Shapes of tools that benchmarks press with; each stands or lies on z = 0."""

import numpy as np
import shapely
import trimesh

from fem_tools.scenes import extruded, letter
from stmpl_core.tool import Tool


def ball(radius: float) -> Tool:
    """A ball of a radius [mm] that stands on z = 0."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.apply_translation([0, 0, radius])
    return _in_metres("ball", mesh)


def flat(radius: float, fillet: float) -> Tool:
    """A flat-ended cylinder with a filleted rim [mm] that stands on z = 0."""
    angle = np.linspace(0, np.pi / 2, 12)
    rim = np.stack([radius - fillet + fillet * np.sin(angle), fillet - fillet * np.cos(angle)], axis=1)
    outline = np.vstack([[[0, 0]], rim, [[radius, fillet + 12], [0, fillet + 12]]])
    return _in_metres("flat", trimesh.creation.revolve(outline, sections=96))


def fingertip(radius: float, length: float) -> Tool:
    """A capsule on its side [mm] that lies on z = 0."""
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[48, 48])
    mesh.apply_translation([0, 0, -length / 2])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    mesh.apply_translation([0, 0, radius])
    return _in_metres("fingertip", mesh)


def block_letter(character: str, height: float) -> Tool:
    """A block letter of a height [mm], 12 mm thick, that stands on z = 0."""
    return extruded(letter(character, 1e-3 * height), 0.0, 12e-3)


def roller(middle: float, end: float, length: float) -> Tool:
    """A roller [mm] that lies on z = 0, hollow towards its middle: a saddle."""
    x = np.linspace(-length / 2, length / 2, 41)
    round_end = 1.5 * (1 - np.sqrt(np.clip(1 - (np.clip(np.abs(x) - length / 2 + 1.5, 0, None) / 1.5) ** 2, 0, 1)))
    radius = middle + (end - middle) * (2 * x / length) ** 2 - round_end
    return _lying("roller", np.column_stack([radius, x]))


def peanut(radius: float, apart: float) -> Tool:
    """Two balls [mm] with a waist, in one piece, that lie on z = 0."""
    x = np.linspace(-apart / 2 - radius, apart / 2 + radius, 81)
    away = np.minimum(np.abs(np.abs(x) - apart / 2), radius)
    bodies = np.where(np.abs(x) < apart / 2, np.sqrt(radius**2 - np.minimum(apart / 2 - np.abs(x), 0.8 * radius) ** 2),
                      np.sqrt(np.maximum(radius**2 - away**2, 0)))  # fmt: skip
    return _lying("peanut", np.column_stack([bodies, x]))


def star(points: int, outer: float, inner: float) -> Tool:
    """A prism over a star [mm], 12 mm thick, that stands on z = 0."""
    angle = np.arange(2 * points) * np.pi / points
    radius = np.where(np.arange(2 * points) % 2, inner, outer)
    outline = 1e-3 * np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    return extruded(shapely.Polygon(outline), 0.0, 12e-3)


def cup(radius: float, wall: float) -> Tool:
    """A cup upside down [mm], its rounded rim on z = 0."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 13)
    rim = np.column_stack([radius - wall / 2 + wall / 2 * np.sin(angle), wall / 2 * (1 - np.cos(angle))])
    outline = np.vstack([[[0, 10]], [[radius - wall, 10]], rim, [[radius, 14], [0, 14]]])
    return _in_metres("cup", trimesh.creation.revolve(outline, sections=96))


def _lying(name: str, outline: np.ndarray) -> Tool:
    """What an outline (radius, x) [mm] makes when it turns about x, lying on z = 0."""
    closed = np.vstack([[[0, outline[0, 1]]], outline, [[0, outline[-1, 1]]]])
    mesh = trimesh.creation.revolve(closed, sections=72)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    mesh.apply_translation([0, 0, -mesh.vertices[:, 2].min()])
    return _in_metres(name, mesh)


def _in_metres(name: str, mesh: trimesh.Trimesh) -> Tool:
    return Tool(name, 1e-3 * np.asarray(mesh.vertices), np.asarray(mesh.faces))
