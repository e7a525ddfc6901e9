"""Contact: a tool's mesh, its pose and the wrench it exerts, as one frozen record."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import Faces, Points, Transform, Wrench, finite
from stmpl_core.errors import InvalidInput

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ToolMesh:
    """A triangle mesh in the tool's own frame.

    Args:
        vertices: positions (N, 3) [m].
        faces: vertex numbers (M, 3).
        mendings: sentences that tell what was mended.
    """

    vertices: Points
    faces: Faces
    mendings: tuple[str, ...] = ()

    @classmethod
    def of(cls, vertices: ArrayLike, faces: ArrayLike) -> ToolMesh:
        """Checks and keeps a mesh, mended where it needs it. Raises MeshError or InvalidInput (see `mended`)."""
        from stmpl_core.mending import mended  # brings numba, which a program without tools does not need

        mesh = mended(vertices, faces)
        for sentence in mesh.said:
            log.warning("the tool's mesh was mended: %s", sentence)
        return cls(mesh.vertices, mesh.faces, mesh.said)


@dataclass(frozen=True, eq=False)
class Contact:
    """One tool at one instant.

    Args:
        name: name of the tool; answers and log lines use it.
        mesh: surface in the tool's frame.
        pose_body_from_tool: rigid transform, (4, 4), taking tool coordinates to the layer's frame.
        wrench: force [N] and torque about the tool's origin [N m] that the tool exerts *on the body*,
            in the layer's axes, (6,); None when there is no force sensor.
    """

    name: str
    mesh: ToolMesh
    pose_body_from_tool: Transform
    wrench: Wrench | None = None

    def __post_init__(self) -> None:
        pose = finite(f"pose of {self.name}", self.pose_body_from_tool, (4, 4))
        rotation = pose[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
            raise InvalidInput(f"pose of {self.name} is not rigid: its rotation part is\n{rotation}.")
        object.__setattr__(self, "pose_body_from_tool", pose)
        if self.wrench is not None:
            object.__setattr__(self, "wrench", finite(f"wrench of {self.name}", self.wrench, (6,)))
