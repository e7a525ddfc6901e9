"""Synthetic skins, tools and poses that the tests of contact and methods share."""

import numpy as np
import trimesh

from stmpl_core import Contact, SoftLayer, ToolMesh

RADIUS, LENGTH = 0.04, 0.16  # m, of the limb


def limb(edge: float = 3e-3, thickness: float = 7.5e-3) -> SoftLayer:
    """A cylinder along z with open ends, near-equilateral triangles."""
    around, rings = round(2 * np.pi * RADIUS / edge), round(LENGTH / (edge * 3**0.5 / 2))
    column, row = np.meshgrid(np.arange(around), np.arange(rings + 1))
    angle = 2 * np.pi * (column + 0.5 * (row % 2)) / around
    vertices = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), row * LENGTH / rings], axis=-1).reshape(-1, 3)
    a, below = np.arange(around), np.arange(rings)[:, None] * around
    p, q = below + a, below + (a + 1) % around
    u, w = p + around, q + around
    even = np.stack([p, q, u, q, w, u], axis=-1).reshape(rings, -1, 3)
    odd = np.stack([p, q, w, p, w, u], axis=-1).reshape(rings, -1, 3)
    faces = np.where((np.arange(rings) % 2 == 0)[:, None, None], even, odd).reshape(-1, 3)
    return SoftLayer(vertices, faces, thickness)


def plate(size: float = 0.12, edge: float = 3e-3, thickness: float = 7.5e-3) -> SoftLayer:
    """A flat square patch in the plane z = 0, centred at the origin, facing +z."""
    n = round(size / edge)
    x, y = np.meshgrid(np.linspace(-size / 2, size / 2, n + 1), np.linspace(-size / 2, size / 2, n + 1))
    vertices = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    p = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([p, p + 1, p + n + 2], axis=1), np.stack([p, p + n + 2, p + n + 1], axis=1)])
    return SoftLayer(vertices, faces, thickness)


def tool(mesh: trimesh.Trimesh) -> ToolMesh:
    return ToolMesh.of(mesh.vertices, mesh.faces)


def ball(radius: float = 0.012, subdivisions: int = 3) -> ToolMesh:
    return tool(trimesh.creation.icosphere(subdivisions, radius))


def punch(radius: float = 0.01, height: float = 0.03) -> ToolMesh:
    """A flat, sharp-edged cylinder along z, centred at its own origin."""
    return tool(trimesh.creation.cylinder(radius, height, sections=48))


def capsule(height: float, radius: float, count: int = 32) -> ToolMesh:
    """Along z, centred. Made in millimetres: trimesh drops triangles under 1e-8 of whatever unit."""
    mesh = trimesh.creation.capsule(1e3 * height, 1e3 * radius, count=[count, count])
    return ToolMesh.of(1e-3 * mesh.vertices, mesh.faces)


def turn(axis: tuple[float, float, float], angle: float, move: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """A rigid transform, (4, 4)."""
    pose = trimesh.transformations.rotation_matrix(angle, axis)
    pose[:3, 3] = move
    return pose


def at(x: float, y: float, z: float) -> np.ndarray:
    return turn((0, 0, 1), 0.0, (x, y, z))


def press(mesh: ToolMesh, pose: np.ndarray, force: tuple[float, float, float] | None, name: str = "probe") -> Contact:
    return Contact(name, mesh, pose, None if force is None else np.array([*force, 0.0, 0.0, 0.0]))
