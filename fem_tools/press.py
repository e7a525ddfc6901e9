"""Press: a rigid tool, where it stands, which way it goes, and how fine a mesh its shape asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stmpl_core.arrays import Points, Transform, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance

MAX_FACES_ENTERED = 0.01  # depth of faces in a tool that an answer may have [thicknesses]
SHARE_FOR_STRETCH = 0.4  # share of it planned for at rest: edges grow by up to 1.7 where the skin wraps around a fillet

_ON_FACE = np.array([(i, j, 8 - i - j) for i in range(9) for j in range(9 - i)]) / 8  # barycentric, (45, 3)


@dataclass(frozen=True, eq=False)
class Press:
    """A rigid tool and the way it goes into the skin.

    Args:
        field: tool's signed distance.
        pose_body_from_tool: tool's pose at travel 0, rigid, (4, 4).
        direction: vector of the tool's travel in the layer's frame, of any length, (3,) [-].
    """

    field: SignedDistance
    pose_body_from_tool: Transform
    direction: np.ndarray

    def __post_init__(self) -> None:
        direction = finite("direction", self.direction, (3,))
        if not (length := float(np.linalg.norm(direction))) > 0:
            raise InvalidInput("the direction of a tool's travel has no length.")
        object.__setattr__(self, "direction", direction / length)
        object.__setattr__(self, "pose_body_from_tool", finite("pose", self.pose_body_from_tool, (4, 4)))

    def at(self, travel: float) -> Press:
        """The same press, moved on by `travel` [m]."""
        return self.shifted(travel * self.direction)

    def shifted(self, by: np.ndarray) -> Press:
        """The same press, moved by a vector of the layer's frame, (3,) [m]."""
        pose = self.pose_body_from_tool.copy()
        pose[:3, 3] += by
        return replace(self, pose_body_from_tool=pose)

    def sideways(self, size: float) -> Points:
        """No shift, and four of `size` [m] across the travel, (5, 3)."""
        across = np.linalg.svd(self.direction[None])[2][1:]
        return size * np.concatenate([np.zeros((1, 3)), across, -across])

    def to_tool(self, points: Points) -> Points:
        """Points of the layer's frame in the tool's, (N, 3) [m]."""
        return (points - self.pose_body_from_tool[:3, 3]) @ self.pose_body_from_tool[:3, :3]

    def distance(self, points: Points) -> np.ndarray:
        """Signed distance of points of the layer's frame, (N,) [m]."""
        return self.field.distance(self.to_tool(points))

    def jet(self, points: Points) -> tuple[np.ndarray, Points, np.ndarray]:
        """Signed distance (N,) [m], gradient (N, 3) and Hessian (N, 3, 3) [1/m] in the layer's frame."""
        turn = self.pose_body_from_tool[:3, :3]
        phi, gradient, hessian = self.field.distance_gradient_hessian(self.to_tool(points))
        return phi, gradient @ turn.T, turn @ hessian @ turn.T

    def touching(self, layer: SoftLayer) -> Press | None:
        """The press where it first touches the faces, or None: found with the vertices, then on the faces near."""
        travel = self.travel_to_touch(layer.vertices)
        if travel is not None:
            close = self.at(travel).distance(layer.vertices) < 1.2 * layer.edge_length
            corners = layer.vertices[layer.faces[close[layer.faces].any(axis=1)]]
            travel = self.travel_to_touch(np.einsum("pk,fkx->fpx", _ON_FACE, corners).reshape(-1, 3))
        return None if travel is None else self.at(travel)

    def travel_to_touch(self, points: Points, *, furthest: float = 0.2) -> float | None:
        """How far the tool goes until it first touches one of `points` [m] (negative: it must come back), or None.

        Sphere tracing: the smallest distance can always be travelled safely (Hart 1996).
        """
        travel = 0.0
        for _ in range(300):
            gap = float(self.at(travel).distance(points).min())
            if abs(gap) < 1e-7:
                return travel
            travel += gap
            if abs(travel) > furthest:
                return None
        return travel if abs(gap) < 1e-5 else None


def above_core(layer: SoftLayer, tools: Sequence[Press]) -> tuple[np.ndarray, list[float]]:
    """Numbers of the vertices that tools cover where they stand, and each tool's distance from the core there [m]."""
    reached = np.min([tool.distance(layer.vertices) for tool in tools], axis=0)
    footprint = np.flatnonzero(reached <= max(0.0, float(reached.min())))
    return footprint, [float(tool.distance(layer.inner_vertices[footprint]).min()) for tool in tools]


def edge_for_curvature(press: Press, points: np.ndarray, thickness: float) -> np.ndarray:
    """The longest edge of a triangle whose middle may sink into the tool by no more than allowed, (T,) [m].

    Where the corners of a triangle with edges h lie on a surface of curvature k, its middle is k h^2 / 6 inside.

    Args:
        press: tool at the pose to be followed.
        points: points of each triangle, (T, k, 3) [m].
        thickness: thickness of the layer [m].
    """
    curvature = _curvature_touched(press, points)
    return np.sqrt(6 * SHARE_FOR_STRETCH * MAX_FACES_ENTERED * thickness / np.maximum(curvature, 1e-9))


def edge_for_first_contact(press: Press, points: np.ndarray, depth: float) -> np.ndarray:
    """A third of the contact's radius sqrt(depth / k) where a tool of curvature k has sunk in by `depth`, (T,) [m]."""
    return np.sqrt(depth / np.maximum(_curvature_touched(press, points), 1e-9)) / 3


def _curvature_touched(press: Press, points: np.ndarray) -> np.ndarray:
    """Largest curvature of the tool where each triangle meets it, (T,) [1/m]; 0 where it does not."""
    flat = points.reshape(-1, 3)
    phi, gradient, _ = press.jet(flat)
    size = np.linalg.norm(points[:, 0] - points[:, -1], axis=1)
    touching = (phi.reshape(points.shape[:2]) < 0.3 * size[:, None]).any(axis=1)
    curvature = np.zeros(len(points))
    if touching.any():
        at = (flat - phi[:, None] * gradient).reshape(points.shape)[touching]
        hessian = press.jet(at.reshape(-1, 3))[2]
        curvature[touching] = np.linalg.norm(hessian, ord=2, axis=(1, 2)).reshape(at.shape[:2]).max(axis=1)
    return curvature
