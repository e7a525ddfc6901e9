"""Shapes of tools that benchmarks press with; each stands or lies on z = 0."""

import numpy as np
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


def _in_metres(name: str, mesh: trimesh.Trimesh) -> Tool:
    return Tool(name, 1e-3 * np.asarray(mesh.vertices), np.asarray(mesh.faces))
