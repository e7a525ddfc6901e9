"""Shapes of the rigid tools that are drawn: rounded ones, and all kinds of the set "tool"."""

from __future__ import annotations

import string
from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from fem_tools.scenes import extruded, letter
from stmpl_core.tool import Tool

FILLETS = (1.5e-3, 4e-3)  # m, of their edges


def any_tool(drawn: Mapping[str, Any]) -> tuple[Tool, float]:
    """The tool of the set "tool" that these figures describe, z up and tilted, about its middle; and its rounding [m].

    Args:
        drawn: figures by name: tool, one of TOOLS; size, half its width [m]; shape, eight numbers in [0, 1]; tilt
            about x, y [rad].
    """
    r, shape = 1e3 * float(drawn["size"]), np.asarray(drawn["shape"])  # mm: trimesh drops small triangles
    fillet = 1e3 * (FILLETS[0] + (FILLETS[1] - FILLETS[0]) * float(shape[0]))
    name, rounding = drawn["tool"], 0.0
    if name in ("sphere", "ellipsoid"):
        mesh = trimesh.creation.icosphere(4, r)
        if name == "ellipsoid":
            mesh.apply_scale([1.0, 0.4 + 0.6 * shape[1], 0.3 + 1.2 * shape[2]])
    elif name == "capsule":
        long = r * (0.5 + 3.5 * shape[1])
        mesh = trimesh.creation.capsule(long, 0.6 * r, count=[48, 48])
        mesh.apply_translation([0, 0, -long / 2])
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    elif name == "cylinder":
        mesh = _hull(_circle(r), fillet, 24.0)
    elif name == "box":
        x, y = r, r * (0.3 + 0.7 * shape[1])
        mesh = _hull(np.array([[x, y], [x, -y], [-x, -y], [-x, y]]), fillet, 24.0)
    elif name == "hull":  # of balls at random places: smooth, convex, like nothing else
        rng = np.random.default_rng((1e4 * shape).astype(np.int64))
        radii, centres = r * rng.uniform(0.2, 0.6, 5), r * rng.uniform(-0.7, 0.7, (5, 3))
        mesh = _balls(centres, radii)
    elif name == "torus":  # a ring that lies flat, or a tyre that stands
        mesh = trimesh.creation.torus(r, r * (0.2 + 0.25 * shape[1]), 64, 32)
        if shape[2] < 0.5:
            mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    elif name == "pin":
        thick = 1.2 + 1.8 * float(shape[1])
        mesh = _balls(np.array([[0, 0, -12.0], [0, 0, 12.0]]), np.array([thick, thick]))
    elif name in ("edge", "corner"):  # the rounded ridge of a roof, the rounded top of a pyramid, upside down
        steep, long = np.tan(np.radians(25 + 35 * shape[1])), r * (0.5 + shape[2]) if name == "edge" else 0.0
        high = 8.0 + r
        top = [[x * (long + high / steep * (name == "corner")), y * high / steep, high / 2]
               for x in (-1, 1) for y in (-1, 1)]  # fmt: skip
        centres = np.array([[-long, 0, -high / 2], [long, 0, -high / 2], *top])
        mesh = _balls(centres, np.full(6, 0.4 * fillet))
    elif name == "plate":  # wider than a limb
        wide = 15.0 + 10.0 * shape[1:3]
        mesh = _hull(np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * wide, fillet, 12.0)
    else:
        made = extruded(letter(string.ascii_uppercase[int(25.99 * shape[1])], 2e-3 * max(r, 10.0)), -10e-3, 10e-3)
        mesh, rounding = trimesh.Trimesh(1e3 * made.vertices, made.faces, process=False), min(1e-3 * fillet, 2.5e-3)
    tilt = Rotation.from_euler("xy", drawn["tilt"]).as_matrix()
    return Tool(name, 1e-3 * np.asarray(mesh.vertices) @ tilt.T, np.asarray(mesh.faces)), rounding


def _balls(centres: np.ndarray, radii: np.ndarray) -> trimesh.Trimesh:
    """The convex hull of balls about centres (N, 3) of radii (N,)."""
    ball = trimesh.creation.icosphere(3, 1.0).vertices
    return trimesh.convex.convex_hull((radii[:, None, None] * ball + centres[:, None]).reshape(-1, 3))


def _circle(radius: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _hull(outline: np.ndarray, fillet: float, height: float) -> trimesh.Trimesh:
    """A convex prism over an outline (N, 2) with all edges rounded: the hull of balls at its corners."""
    reach = np.linalg.norm(outline, axis=1)
    inner = outline * (1 - np.minimum(fillet / reach, 0.9))[:, None]
    radius = min(fillet, 0.9 * float(reach.min()))
    low, high = -height / 2 + fillet, height / 2 - fillet
    centres = np.concatenate([np.column_stack([inner, np.full(len(inner), z)]) for z in (low, high)])
    return _balls(centres, np.full(len(centres), radius))


def rounded_tool(name: str, radius: float) -> Tool:
    """A sphere, a capsule lying down, or an upright cylinder with a filleted rim, of a radius [m], about its middle."""
    r = 1e3 * radius  # trimesh drops triangles that are small in metres
    if name == "sphere":
        mesh = trimesh.creation.icosphere(4, r)
    elif name == "capsule":
        mesh = trimesh.creation.capsule(2 * r, 0.6 * r, count=[48, 48])
        mesh.apply_translation([0, 0, -r])
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    else:
        fillet, bend = 0.3 * r, np.linspace(0, np.pi / 2, 9)
        rim = np.column_stack([r - fillet + fillet * np.sin(bend), -r + fillet - fillet * np.cos(bend)])
        mesh = trimesh.creation.revolve(np.vstack([[0, -r], rim, [r, r], [0, r]]), sections=64)
    return Tool(name, 1e-3 * np.asarray(mesh.vertices), np.asarray(mesh.faces))
