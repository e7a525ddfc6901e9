"""Contact of a rigid tool with skin columns: pressure by the augmented Lagrangian, friction by anchors.

The tools are smooth signed-distance fields phi. A skin column c of area A_c that sinks into one (phi < 0) is pushed
back by A_c p_c grad phi, p_c = max(0, lambda_c - epsilon phi), where lambda_c is updated to p_c until the tool is
entered by less than a stated depth: the augmented Lagrangian method (Wriggers, "Computational Contact Mechanics",
2nd ed., ch. 5.3).

A column that touches sticks to a point of the tool, its anchor, by a spring of tangential penalty up to Coulomb's limit
mu p_c, and drags the anchor along beyond it (return mapping; ibid., ch. 5.4). Within one solve the limit is that of the
last update of the pressure, so that friction has a potential too; updates go on until the limit has settled.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from fem_tools.mesh import WedgeMesh
from fem_tools.plies import confined_modulus
from fem_tools.press import Press
from stmpl_core.arrays import Points
from stmpl_core.tissue import Tissue

NORMAL_PENALTY = 100.0  # penalty of entering [confined moduli over the thickness]
STICK_PENALTY = 100.0  # that of sliding: what sticking points still creep costs 0.3 % of the force (at 10: 2 %, a snap)
FRICTION_PENALTY = 30.0  # that of sliding under Coulomb's limit; at 100 Newton takes more steps, for 0.5 % in force
SLIP_KEPT = 0.02  # share of the secant that the tangent keeps along a slip, where it has none: Newton then finds back
AVERAGED = 0.2  # width of the Gaussian by which the pressure is averaged for Coulomb's limit [radii of the contact]
SETTLED = 0.01  # change of the friction's limit from one update to the next that is let be, over the limit [-]

Friction = Literal["stick", "none"] | float


def penalties(friction: Friction, tissue: Tissue, thickness: float) -> tuple[float, float]:
    """Normal and tangential penalty of contact on a layer this thick [m], [Pa/m].

    Skin holds against sliding with E_s h, which may be many times what E t of the tissue holds: the tangential penalty
    grows with it, or springs would give way where the skin should slide or stick.
    """
    modulus = confined_modulus(tissue, thickness) / thickness
    kappa = tissue.skin.stiffness / (tissue.youngs_modulus * thickness) if tissue.skin else 0.0
    tangential = {"stick": STICK_PENALTY, "none": 0.0}.get(str(friction), FRICTION_PENALTY) * modulus * (1 + kappa)
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
        fresh: mask of columns that did not touch when the step began, and are anchored where they were then, (n,).
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
        fresh: np.ndarray | None = None,
    ) -> None:
        self.tool, self.near, self.area, self.diagonal = tool, near, area[near], diagonal[near]
        self.normal, self.tangent = stiffness
        self.multiplier, self.limit = multiplier, limit
        self.held = np.isfinite(anchor).all(axis=1)
        pose = tool.pose_body_from_tool
        self.anchor = np.where(self.held[:, None], anchor, 0.0) @ pose[:3, :3].T + pose[:3, 3]
        self.fresh = np.zeros(len(near), dtype=bool) if fresh is None else fresh
        self._project: np.ndarray | None = None

    def pressed(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Energy [J/m2], pressure [Pa] and stiffness [Pa/m] of the near columns at signed distances `phi`, (n,) [m]."""
        pressure = np.maximum(0.0, self.multiplier - self.normal * phi)
        return pressure**2 / (2 * self.normal), pressure, np.where(pressure > 0, self.normal, 0.0)

    def pressure(self, skin: np.ndarray) -> np.ndarray:
        """Contact pressure of the near columns, (n,) [Pa]."""
        return self.pressed(self.tool.distance(skin[self.near]))[1]

    def _plane(self) -> np.ndarray:
        """Projectors on the tool's tangent planes, at the anchors until they are updated, (n, 3, 3)."""
        if self._project is None:
            self._project = self._planes_at(self.anchor)
        return self._project

    def _planes_at(self, points: Points) -> np.ndarray:
        n = self.tool.jet(points)[1]
        n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
        return (np.eye(3) - n[:, :, None] * n[:, None, :]) * self.held[:, None, None]

    def update(self, skin: np.ndarray, friction: Friction) -> None:
        """Takes the present pressure for the multiplier and for Coulomb's limit, and the planes of slips from here."""
        self.multiplier = self.pressure(skin)
        self.limit = self._limit(friction, self.multiplier, skin)
        if not isinstance(friction, str):
            at = skin[self.near[self.fresh]]  # they touched halfway, about
            self.anchor[self.fresh] = (self.anchor[self.fresh] + at) / 2
            self.fresh = np.zeros_like(self.fresh)
            self._project = self._planes_at(skin[self.near])

    def _limit(self, friction: Friction, pressure: np.ndarray, skin: np.ndarray) -> np.ndarray:
        """Largest tangential traction under a pressure (n,) [Pa], as an average over AVERAGED contact radii, (n,) [Pa].

        Coulomb's law point by point is ill-posed for mu > 1: short waves grow without bound (Renardy, J. Elasticity 27,
        1992). Under an average of the pressure it is not (Oden & Pires, J. Appl. Mech. 50, 1983). The sum is kept.
        """
        limit = friction_limit(friction, pressure)
        if isinstance(friction, str) or not (touching := pressure > 0).any():
            return limit
        load, at = self.area[touching] * pressure[touching], skin[self.near[touching]]
        width = AVERAGED * np.sqrt(self.area[touching].sum() / np.pi)
        weight = np.exp(-((at[:, None] - at) ** 2).sum(axis=2) / (2 * width**2))
        mean = (weight @ load) / (weight @ self.area[touching])
        limit[touching] = friction * mean * (load.sum() / (mean @ self.area[touching]))
        return limit

    def unsettled(self, skin: np.ndarray, friction: Friction) -> float:
        """How far Coulomb's limit is from that of the present pressure, both summed over the columns [-]."""
        if isinstance(friction, str):
            return 0.0
        wanted = self._limit(friction, self.pressure(skin), skin)
        total = float(self.area @ wanted)
        return float(self.area @ np.abs(wanted - self.limit)) / total if total > 0 else 0.0

    def slipping(self, skin: np.ndarray) -> float:
        """Share of the normal load under which the skin slips along the tool [-]; 0 without a load."""
        pressure, (_, secant) = self.pressure(skin), self.slip(skin)
        load = self.area * pressure
        return float(load[secant < self.tangent].sum() / load.sum()) if load.any() else 0.0

    def friction_forces(self, skin: np.ndarray) -> Points:
        """Part of the nodal forces that friction exerts, (n, 3) [N]."""
        offset, secant = self.slip(skin)
        return -(self.area * secant)[:, None] * offset

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
        """See SkinLoad; the tool's curvature softens, and is left out where Newton asks for a convex one.

        The tangent of a traction of fixed size along the offset s is limit / |s| (I - s s / |s|^2).
        """
        phi, gradient, hessian = self.tool.jet(skin[self.near])
        _, p, slope = self.pressed(phi)
        stiff = slope[:, None, None] * gradient[:, :, None] * gradient[:, None, :]
        stiff -= (1 - convex) * p[:, None, None] * hessian
        offset, secant = self.slip(skin)
        stiff += secant[:, None, None] * self._plane()
        if (capped := (secant < self.tangent) & (secant > 0)).any():
            along = offset[capped] / np.linalg.norm(offset[capped], axis=1, keepdims=True)
            spared = (1 - SLIP_KEPT) * secant[capped]
            stiff[capped] -= spared[:, None, None] * along[:, :, None] * along[:, None, :]
        data[self.diagonal, :3, :3] += self.area[:, None, None] * stiff


def column_areas(mesh: WedgeMesh) -> np.ndarray:
    """Skin area of each column at rest, (C,) [m2]: a third of each triangle, or 1/12 and 1/4 where quadratic."""
    a, b, c = (mesh.outer[mesh.triangles[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = np.full(3, 1 / 3) if not len(mesh.edges) else np.repeat([1 / 12, 1 / 4], 3)
    out = np.zeros(mesh.n_columns)
    np.add.at(out, mesh.columns, area[:, None] * share)
    return out
