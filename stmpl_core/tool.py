"""Tool: a rigid surface with a name, in its own frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stmpl_core.arrays import Faces, Points, finite
from stmpl_core.layer import check_faces


@dataclass(frozen=True, eq=False)
class Tool:
    """A tool: its surface does not change, where it is says a Contact.

    Args:
        name: name in answers, messages and log lines.
        vertices: surface in the tool's own frame, (N, 3) [m].
        faces: triangles, (M, 3), counter-clockwise seen from outside.

    Raises:
        MeshError, InvalidInput: not finite, empty, or faces that name no vertex.
    """

    name: str
    vertices: Points
    faces: Faces

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", finite(f"vertices of {self.name}", self.vertices, (None, 3)))
        object.__setattr__(self, "faces", check_faces(self.faces, len(self.vertices)))

    @cached_property
    def digest(self) -> str:
        """Sixteen hex digits that name the surface: tools of one surface share a distance field."""
        found = hashlib.sha256(np.ascontiguousarray(self.vertices, "<f8").tobytes())
        found.update(np.ascontiguousarray(self.faces, "<i4").tobytes())
        return found.hexdigest()[:16]

    def named(self, name: str) -> Tool:
        """The same surface under another name."""
        return Tool(name, self.vertices, self.faces)
