"""Contact of a rigid tool with skin columns: pressure by the augmented Lagrangian, friction by anchors.

The tools are smooth signed-distance fields phi. A skin column c of area A_c that sinks into one (phi < 0) is pushed
back by A_c p_c grad phi, p_c = max(0, lambda_c - epsilon phi), where lambda_c is updated to p_c until the tool is
entered by less than a stated depth: the augmented Lagrangian method (Wriggers, "Computational Contact Mechanics",
2nd ed., ch. 5.3).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from fem_tools.mesh import WedgeMesh
from fem_tools.press import Press
from stmpl_core.arrays import Points

NORMAL_PENALTY = 100.0  # penalty of entering [confined moduli over the thickness]
STICK_PENALTY = 100.0  # that of sliding: what sticking points still creep costs 0.3 % of the force (at 10: 2 %, a snap)
FRICTION_PENALTY = 10.0  # that of sliding under Coulomb's limit, which Newton does not pass where this is stiffer

Friction = Literal["stick", "none"] | float


def penalties(friction: Friction, modulus: float) -> tuple[float, float]:
    """Normal and tangential penalty [Pa/m]; `modulus`: confined modulus over the thickness [Pa/m]."""
    tangential = {"stick": STICK_PENALTY, "none": 0.0}.get(str(friction), FRICTION_PENALTY) * modulus
    return NORMAL_PENALTY * modulus, tangential


def friction_limit(friction: Friction, multiplier: np.ndarray) -> np.ndarray:
    """Largest tangential traction of columns under a pressure `multiplier` [Pa]; infinite where no law limits it."""
    return np.full(len(multiplier), np.inf) if isinstance(friction, str) else friction * multiplier


class PressLoad:
    """A tool against the skin columns near it, at a fixed pose: a conservative SkinLoad.

    Args:
        tool: tool at this step's pose.
        area: areas of all columns, (C,) [m2].
        near: numbers of the columns that may touch, (n,).
        diagonal: number of each column's own block in the tangent, (C,).
        stiffness: normal and tangential penalty [Pa/m].
        multiplier: lambda of the near columns, (n,) [Pa].
        anchor: point of the tool's frame at which each near column sticks, (n, 3) [m]; NaN where it does not.
        limit: largest tangential traction, (n,) [Pa]; infinite for sticking.
    """

    conservative = True

    def __init__(
        self,
        tool: Press,
        area: np.ndarray,
        near: np.ndarray,
        diagonal: np.ndarray,
        stiffness: tuple[float, float],
        multiplier: np.ndarray,
        anchor: Points,
        limit: np.ndarray,
    ) -> None:
        self.tool, self.near, self.area, self.diagonal = tool, near, area[near], diagonal[near]
        self.normal, self.tangent = stiffness
        self.multiplier, self.limit = multiplier, limit
        self.held = np.isfinite(anchor).all(axis=1)
        pose = tool.pose_body_from_tool
        self.anchor = np.where(self.held[:, None], anchor, 0.0) @ pose[:3, :3].T + pose[:3, 3]
        self._project: np.ndarray | None = None

    def pressed(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Energy [J/m2], pressure [Pa] and stiffness [Pa/m] of the near columns at signed distances `phi`, (n,) [m]."""
        pressure = np.maximum(0.0, self.multiplier - self.normal * phi)
        return pressure**2 / (2 * self.normal), pressure, np.where(pressure > 0, self.normal, 0.0)

    def pressure(self, skin: np.ndarray) -> np.ndarray:
        """Contact pressure of the near columns, (n,) [Pa]."""
        return self.pressed(self.tool.distance(skin[self.near]))[1]

    def _plane(self) -> np.ndarray:
        """Projectors on the tool's tangent planes at the anchors, kept for the whole step, (n, 3, 3)."""
        if self._project is None:
            n = self.tool.jet(self.anchor)[1]
            n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
            self._project = (np.eye(3) - n[:, :, None] * n[:, None, :]) * self.held[:, None, None]
        return self._project

    def slip(self, skin: np.ndarray) -> tuple[Points, np.ndarray]:
        """Tangential offset from the anchors (n, 3) [m], and its secant stiffness [Pa/m] under the friction limit."""
        offset = np.einsum("nij,nj->ni", self._plane(), skin[self.near] - self.anchor)
        length = np.linalg.norm(offset, axis=1)
        return offset, np.minimum(self.tangent, self.limit / np.maximum(length, 1e-12))

    def potential(self, skin: np.ndarray, factor: float) -> float:
        """Energy of the normal pressure plus the work of the tangential tractions [J]."""
        offset, secant = self.slip(skin)
        length = np.linalg.norm(offset, axis=1)
        capped = secant < self.tangent
        limit = np.where(capped, self.limit, 0.0)  # Huber's function: quadratic, then linear
        capped_energy = limit * length - 0.5 * limit**2 / max(self.tangent, 1e-300)
        tangential = np.where(capped, capped_energy, 0.5 * self.tangent * length**2)
        return float(np.sum(self.area * (self.pressed(self.tool.distance(skin[self.near]))[0] + tangential)))

    def nodal_forces(self, skin: np.ndarray) -> Points:
        """Forces of the tool on the near columns, (n, 3) [N]."""
        phi, gradient, _ = self.tool.jet(skin[self.near])
        p = self.pressed(phi)[1]
        offset, secant = self.slip(skin)
        return self.area[:, None] * (p[:, None] * gradient - secant[:, None] * offset)

    def add_forces(self, skin: np.ndarray, factor: float, forces: np.ndarray) -> None:
        """See SkinLoad."""
        forces[self.near] += self.nodal_forces(skin)

    def add_tangent(
        self, skin: np.ndarray, factor: float, data: np.ndarray, *, symmetric: bool, convex: float = 0.0
    ) -> None:
        """See SkinLoad; the tool's curvature softens, and is left out where Newton asks for a convex one."""
        phi, gradient, hessian = self.tool.jet(skin[self.near])
        _, p, slope = self.pressed(phi)
        stiff = slope[:, None, None] * gradient[:, :, None] * gradient[:, None, :]
        stiff -= (1 - convex) * p[:, None, None] * hessian
        _, secant = self.slip(skin)
        stiff += secant[:, None, None] * self._plane()
        data[self.diagonal, :3, :3] += self.area[:, None, None] * stiff


def column_areas(mesh: WedgeMesh) -> np.ndarray:
    """Skin area of each column at rest, (C,) [m2]: a third of each triangle, or 1/12 and 1/4 where quadratic."""
    a, b, c = (mesh.outer[mesh.triangles[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = np.full(3, 1 / 3) if not len(mesh.edges) else np.repeat([1 / 12, 1 / 4], 3)
    out = np.zeros(mesh.n_columns)
    np.add.at(out, mesh.columns, area[:, None] * share)
    return out
