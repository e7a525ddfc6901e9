"""The tools that a person can pick, their own mesh file among them, and where a tool stands at first."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from fem_tools.scenes import extruded, frame, letter
from fem_tools.tool_shapes import rounded_tool
from stmpl_core.arrays import Points, Transform
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.tool import Tool
from stmpl_ros.scripts import SkinPath, capsule

LETTER_HEIGHT, LETTER_LENGTH = 30e-3, 15e-3  # m
PLACE = 0.6  # place along the limb, 0 to 1
TOOLS: dict[str, Callable[[], Tool]] = {
    "ball": lambda: rounded_tool("sphere", 15e-3),
    "fingertip": lambda: capsule(8e-3),
    "cylinder": lambda: rounded_tool("cylinder", 12e-3),
    "letter A": lambda: letter_tool("A"),
}


def letter_tool(character: str) -> Tool:
    """A stamp in the shape of a capital letter or digit, 30 mm high. Raises InvalidInput."""
    return extruded(letter(character, LETTER_HEIGHT), 0.0, LETTER_LENGTH)


def tool_named(name: str) -> Tool:
    """The mesh of one of TOOLS, of a single letter, or of a mesh file in metres.

    Raises:
        InvalidInput: a name that is neither a tool nor a file, or a file without a mesh.
    """
    if name in TOOLS:
        return TOOLS[name]()
    if len(name) == 1:
        return letter_tool(name.upper())
    if not Path(name).is_file():
        raise InvalidInput(f"no tool and no file is called '{name}'. Tools: {', '.join(TOOLS)}, a letter, a mesh file.")
    return tool_from_bytes(name, Path(name).read_bytes())


def tool_from_bytes(name: str, content: bytes) -> Tool:
    """The mesh in a file (STL, OBJ, PLY, GLB, ...) of this name, in metres. Raises InvalidInput or MeshError."""
    try:
        mesh: Any = trimesh.load_mesh(BytesIO(content), file_type=Path(name).suffix.lstrip(".").lower())
        mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    except Exception as error:  # each format's reader raises what it likes
        raise InvalidInput(f"'{name}' is no mesh: {error}. Try STL, OBJ, PLY or GLB, in metres.") from error
    if not len(faces):
        raise InvalidInput(f"'{name}' is no mesh: there are no triangles in it. Try STL, OBJ, PLY or GLB, in metres.")
    return Tool(Path(name).stem, vertices, faces)


def place_on(layer: SoftLayer, vertices: Points, gap: float = 5e-3) -> Transform:
    """pose_body_from_tool that holds a tool's vertices (N, 3) `gap` [m] off the skin, its z axis along the normal."""
    size = float(np.ptp(vertices[:, :2], axis=0).max())
    point, normal = SkinPath(layer, 0.0, size / 2).at(PLACE)
    lowest = float(vertices[:, 2].min())
    axis = np.linalg.svd(layer.vertices - layer.vertices.mean(axis=0), full_matrices=False)[2][0]
    return frame(point + (gap - lowest) * normal, normal, axis, 0.0)
