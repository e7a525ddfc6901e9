"""Stroke: a rigid tool on a path of poses: pressed, slid, turned, lifted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fem_tools.press import Press
from stmpl_core.arrays import Transform, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance


@dataclass(frozen=True, eq=False)
class Stroke:
    """A rigid tool and the poses that it goes through.

    Between two poses its origin goes straight, and it turns about one axis at an even rate.

    Args:
        field: tool's signed distance.
        poses: rigid poses of the tool in the layer's frame, (N, 4, 4), N >= 2; the first is outside the skin.
        direction: vector along which `Indentation.force` is counted, in the layer's frame, of any length, (3,) [-];
            None: from the first pose's origin to the next that differs.
    """

    field: SignedDistance
    poses: np.ndarray
    direction: np.ndarray | None = None

    def __post_init__(self) -> None:
        poses = finite("poses", self.poses, (None, 4, 4))
        if len(poses) < 2:
            raise InvalidInput(f"a path has {len(poses)} pose; at least 2 are needed.")
        turns = poses[:, :3, :3]
        if not np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-6) or (np.linalg.det(turns) < 0).any():
            raise InvalidInput("a path has poses that are not rigid: their upper left (3, 3) must be rotations.")
        object.__setattr__(self, "poses", poses)
        way = poses[:, :3, 3] - poses[0, :3, 3]
        moved = np.flatnonzero(np.linalg.norm(way, axis=1) > 0)
        given = self.direction
        if given is None:
            given = way[moved[0]] if len(moved) else np.array([0, 0, -1.0])
        object.__setattr__(self, "direction", finite("direction", given, (3,)))

    def pose(self, at: float) -> Transform:
        """The pose at a place on the path, 0 at the first pose, 1 at the second, (4, 4)."""
        k = int(np.clip(np.floor(at), 0, len(self.poses) - 2))
        share, (first, last) = at - k, self.poses[k : k + 2]
        if share in (0.0, 1.0):
            return (last if share else first).copy()
        out = first + share * (last - first)
        turn = Rotation.from_matrix(first[:3, :3].T @ last[:3, :3]).as_rotvec()
        out[:3, :3] = first[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
        return out

    def at(self, at: float) -> Press:
        """The tool at a place on the path, 0 at the first pose, 1 at the second."""
        assert self.direction is not None
        return Press(self.field, self.pose(at), self.direction)

    def lengths(self) -> np.ndarray:
        """Longest way that a corner of the tool's box makes from each pose to the next, (N - 1,) [m]."""
        low, high = self.field.tool_bounds
        corners = np.array(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij")).reshape(3, -1)
        places = self.poses[:, :3, :3] @ corners + self.poses[:, :3, 3:]
        return np.linalg.norm(np.diff(places, axis=0), axis=1).max(axis=1)

    def sampled(self, spacing: float) -> list[Press]:
        """The tool at places no further apart than `spacing` [m], both ends included."""
        places = [np.zeros(1)]
        for k, length in enumerate(self.lengths()):
            many = int(np.ceil(length / spacing))
            places.append(k + np.arange(1, many + 1) / max(many, 1))
        return [self.at(float(place)) for place in np.concatenate(places)]


def gap_at_rest(tool: Press, layer: SoftLayer) -> float:
    """Smallest signed distance of the skin's vertices at rest from a tool [m]."""
    return float(tool.distance(layer.vertices).min())


def checked_strokes(strokes: Sequence[Stroke], layer: SoftLayer) -> int:
    """Number of poses of strokes that go together.

    Raises:
        InvalidInput: no strokes, unequal numbers of poses, or a first pose inside the skin.
    """
    if not strokes:
        raise InvalidInput("there is no tool to press with.")
    counts = {len(stroke.poses) for stroke in strokes}
    if len(counts) > 1:
        raise InvalidInput(f"the tools have {sorted(counts)} poses; each tool needs as many as the others.")
    for number, stroke in enumerate(strokes):
        if (gap := gap_at_rest(stroke.at(0.0), layer)) < -1e-5:
            raise InvalidInput(f"tool {number} is {-gap * 1e3:.2f} mm in the skin at its first pose; begin outside.")
    return counts.pop()
