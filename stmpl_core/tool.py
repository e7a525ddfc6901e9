"""Tool: a rigid surface with a name, in its own frame."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from stmpl_core.arrays import Faces, Points
from stmpl_core.errors import InvalidInput

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Tool:
    """A rigid tool with a name. Its surface does not change; a Contact tells where it is.

    Args:
        name: name in answers, messages and log lines.
        vertices: surface in the tool's own frame, (N, 3) [m].
        faces: triangles, (M, 3), counter-clockwise seen from outside.

    Attributes:
        mendings: sentences that tell what of the surface was mended (see stmpl_core.mending); usually none.

    Raises:
        MeshError, InvalidInput: no name, a surface that is not finite, is empty, names vertices that do not exist, or
            cannot be mended.
    """

    name: str
    vertices: Points
    faces: Faces
    mendings: tuple[str, ...] = field(default=(), init=False)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InvalidInput(f"a tool's name is {self.name!r:.40}; a text of one letter or more is needed.")
        from stmpl_core.mending import mended  # brings numba, which a program without tools does not need

        surface = mended(self.vertices, self.faces)
        for name, value in (("vertices", surface.vertices), ("faces", surface.faces), ("mendings", surface.said)):
            object.__setattr__(self, name, value)
        for sentence in surface.said:
            log.warning("the surface of '%s' was mended: %s", self.name, sentence)

    @cached_property
    def digest(self) -> str:
        """Sixteen hex digits that name the surface: tools of one surface share a distance field."""
        found = hashlib.sha256(np.ascontiguousarray(self.vertices, "<f8").tobytes())
        found.update(np.ascontiguousarray(self.faces, "<i4").tobytes())
        return found.hexdigest()[:16]

    @cached_property
    def number(self) -> float:
        """Twelve of these digits as a number, which float64 holds exactly."""
        return float(int(self.digest[:12], 16))

    def named(self, name: str) -> Tool:
        """The same surface under another name."""
        return Tool(name, self.vertices, self.faces)
