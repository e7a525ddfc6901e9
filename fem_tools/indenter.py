"""IndenterFem: rigid tools pressed into the soft layer, step by step, by finite elements with node-to-surface contact.

The tools are smooth signed-distance fields phi. A skin column c of area A_c that sinks into one (phi < 0) is pushed
back by A_c p_c grad phi, p_c = max(0, lambda_c - epsilon phi), where lambda_c is updated to p_c until the tool is
entered by less than a stated depth: the augmented Lagrangian method (Wriggers, "Computational Contact Mechanics",
2nd ed., ch. 5.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from fem_tools.mesh import WedgeMesh
from fem_tools.newton import NewtonResult, System, is_positive_definite, newton
from fem_tools.patch import Patch, PatchFem, discretisation_error, truncation_error
from stmpl_core.arrays import PerVertex, Points, Transform, VertexVectors, Wrench, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.sdf import SignedDistance
from stmpl_core.trust import Trust

NORMAL_PENALTY = 100.0  # confined moduli over the thickness
STICK_PENALTY = 100.0  # likewise: what sticking points still creep costs 0.3 % of the force (at 10: 2 %, and a snap)
FRICTION_PENALTY = 10.0  # likewise under Coulomb's limit, which Newton does not pass where this is stiffer
MAX_ENTERED = 20e-6  # m; the augmented Lagrangian goes on until nodes are less deep in a tool
MAX_FACES_ENTERED = 0.01  # thicknesses
SPREAD = 0.15  # thicknesses that skin is pushed aside before it is touched
SHARE_FOR_STRETCH = 0.4  # of that, planned for at rest: edges grow by up to 1.7 where the skin wraps around a fillet
MAX_UPDATES = 4
MIN_J = 0.1  # below it an answer is not believed
INDENTER_LAYERS = 2  # wedges through the thickness: one is 5 % off in force and 10 % in pressure, two 0.7 % in both
# The stated bound: shares of the estimates and of the peak, fitted on 30 answers of one wedge deep against two deep on
# half the edges; the peak's share was 0.011 until 12 held-out answers asked for more (docs/ground_truth.md).
DISCRETISATION_SHARE, TRUNCATION_SHARE, PEAK_SHARE = 1.3, 0.35, 0.015

_ON_FACE = np.array([(i, j, 8 - i - j) for i in range(9) for j in range(9 - i)]) / 8  # barycentric, (45, 3)

Friction = Literal["stick", "none"] | float


@dataclass(frozen=True, eq=False)
class Tool:
    """A rigid tool and the way it goes.

    Args:
        field: its signed distance.
        pose_body_from_tool: where it stands at travel 0, rigid, (4, 4).
        direction: unit vector of its travel in the layer's frame, (3,).
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

    def at(self, travel: float) -> Tool:
        """The same tool, moved on by `travel` [m]."""
        return self.shifted(travel * self.direction)

    def shifted(self, by: np.ndarray) -> Tool:
        """The same tool, moved by a vector of the layer's frame, (3,) [m]."""
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

    def touching(self, layer: SoftLayer) -> Tool | None:
        """The tool where it first touches the faces, or None: found with the vertices, then on the faces near."""
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


class ToolLoad:
    """A tool against the skin columns near it, at a fixed pose: a conservative SkinLoad.

    Args:
        tool: at this step's pose.
        area: of all columns, (C,) [m2].
        near: numbers of the columns that may touch.
        diagonal: number of each column's own block in the tangent, (C,).
        stiffness: normal and tangential penalty [Pa/m].
        multiplier: lambda of the columns in `near` [Pa].
        anchor: where each near column sticks, in the tool's frame, (n, 3); NaN where it does not.
        limit: largest tangential traction [Pa], (n,); infinite for sticking.
    """

    conservative = True

    def __init__(
        self,
        tool: Tool,
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


@dataclass(frozen=True, eq=False)
class Indentation:
    """One step of a press.

    Args:
        displacement: of the layer's vertices, (V, 3) [m].
        pressure: contact force over rest area at the layer's vertices, (V,) [Pa].
        traction: contact force vectors over rest area, (V, 3) [Pa].
        wrenches: force [N] and torque about the tool's origin [N m] of each tool *on the body*, in the layer's axes.
        depth: how far the tools went beyond first touch [m].
        tools: where the tools stand.
        trust: what may be believed of it; `figures` hold the entered depth at nodes and faces, min det F, stability.
    """

    displacement: VertexVectors
    pressure: PerVertex
    traction: VertexVectors
    wrenches: tuple[Wrench, ...]
    depth: float
    tools: tuple[Tool, ...]
    trust: Trust

    @property
    def force(self) -> float:
        """Sum over the tools of the force along each tool's travel [N]."""
        return float(sum(w[:3] @ t.direction for w, t in zip(self.wrenches, self.tools, strict=True)))


@dataclass(frozen=True, eq=False)
class _State:
    """What a press carries from step to step."""

    u: np.ndarray
    previous: np.ndarray | None
    travel: float
    multipliers: list[np.ndarray]  # per tool, for all columns
    anchors: list[np.ndarray]  # per tool, for all columns, in the tool's frame; NaN: free
    result: NewtonResult
    loads: list[ToolLoad]


class IndenterFem:
    """Presses rigid tools into a soft layer.

    Args:
        fem: how the patch is meshed and solved; None: two wedges deep, up to three refinements where the tool's
            curvature asks.
        friction: "stick" (a touching point stays where it touched, until it is let go), "none", or Coulomb's
            coefficient with the limit taken from the last update of the pressure.
        step: longest step of the tools [thicknesses]; what touches first within a step sticks from its end on.
    """

    def __init__(self, fem: PatchFem | None = None, *, friction: Friction = "stick", step: float = 0.04) -> None:
        if not (friction in ("stick", "none") or (isinstance(friction, int | float) and 0 <= friction < 10)):
            raise InvalidInput(f'friction is {friction!r}; allowed are "stick", "none" or a coefficient in [0, 10).')
        self.fem = fem or PatchFem(refine=3, layers=INDENTER_LAYERS)
        if not 0 < step <= 0.5:
            raise InvalidInput(f"step is {step} thicknesses; allowed is 0 < step <= 0.5.")
        self.friction: Friction = friction
        self.step = step
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """See PatchFem.prepare."""
        self.fem.prepare(layer)
        self._layer = layer
        return self

    def path(self, tools: Sequence[Tool], depths: Sequence[float] | np.ndarray) -> Iterator[Indentation]:
        """Presses all tools together, and gives an answer at each depth beyond first touch.

        Args:
            tools: anywhere along their ways; each is first brought to where it just touches.
            depths: increasing, > 0 [m].

        Yields:
            One Indentation a depth. After a step that fails the last believed one is flagged, and the path ends.

        Raises:
            InvalidInput: no tools, depths that do not increase, a tool that never meets the skin, or one whose way
                ends in the core.
        """
        press = _Press(self, prepared(self._layer, self), tools, finite("depths", depths, (None,)))
        for depth in depths:
            answer = press.to(float(depth))
            yield answer
            if not answer.trust.converged:
                return

    def press(self, tools: Sequence[Tool], depth: float) -> Indentation:
        """The answer at one depth [m]. See `path`."""
        return list(self.path(tools, [depth]))[-1]

    def press_with(self, tools: Sequence[Tool], force: float, *, deepest: float | None = None,
                   tolerance: float = 1e-3) -> Indentation:  # fmt: skip
        """The answer where the tools' forces along their ways sum to `force` [N].

        Args:
            tools: see `path`.
            force: > 0 [N].
            deepest: where to give up [m]; None: 0.9 of the layer's smallest thickness.
            tolerance: of the force [-].

        Raises:
            InvalidInput: as `path`, or a force that is not above 0.
        """
        layer = prepared(self._layer, self)
        if not (np.isfinite(force) and force > 0):
            raise InvalidInput(f"the force is {force} N; it must be finite and above 0.")
        limit = deepest or 0.9 * float(layer.thickness.min())
        press = _Press(self, layer, tools, np.array([limit]))
        below, above = (0.0, 0.0, press.state), None  # depth, force, state
        while above is None:
            depth = min(below[0] + self.step * press.thickness, limit)
            if not press.walk(depth):
                return press.answer()
            if press.force() >= force:
                above = (depth, press.force())
            elif depth >= limit:
                answer = press.answer()
                why = f"{answer.force:.3g} N at the deepest allowed {limit * 1e3:.2f} mm; {force:.3g} N was asked"
                return replace(answer, trust=answer.trust.also(why, in_range=False))
            else:
                below = (depth, press.force(), press.state)
        for _ in range(20):  # regula falsi, always from the state below, so that the path stays the same
            depth = below[0] + (force - below[1]) / (above[1] - below[1]) * (above[0] - below[0])
            press.state = below[2]
            if not press.walk(depth) or abs(press.force() - force) <= tolerance * force:
                break
            above = (depth, press.force()) if press.force() > force else above
            below = below if press.force() > force else (depth, press.force(), press.state)
        else:
            press.stopped = f"the force is {press.force():.4g} N after 20 trials; {force:.4g} N was asked"
        return press.answer()


class _Press:
    """One press under way: the patch, the state and the walk from depth to depth."""

    def __init__(self, solver: IndenterFem, layer: SoftLayer, tools: Sequence[Tool], depths: np.ndarray) -> None:
        if not len(tools):
            raise InvalidInput("there is no tool to press with.")
        if not len(depths) or depths[0] <= 0 or (np.diff(depths) <= 0).any():
            raise InvalidInput(f"depths must be above 0 and increase; got {depths}.")
        self.solver, self.layer, self.fem = solver, layer, solver.fem
        self.tools: list[Tool] = []
        for number, tool in enumerate(tools):
            if (touching := tool.touching(layer)) is None:
                raise InvalidInput(f"tool {number} never meets the skin along its way {tool.direction}.")
            self.tools.append(touching)
        deepest = float(depths[-1])
        reached = [tool.at(deepest).distance(layer.vertices) for tool in self.tools]
        footprint = np.flatnonzero(np.min(reached, axis=0) <= max(0.0, float(np.min(reached))))
        for number, tool in enumerate(self.tools):
            clear = float(tool.at(deepest).distance(layer.inner_vertices[footprint]).min())
            if clear <= 0:
                thin = float(layer.thickness[footprint].min())
                raise InvalidInput(
                    f"tool {number} would be {-clear * 1e3:.2f} mm inside the core at {deepest * 1e3:.2f} mm; "
                    f"the layer is {thin * 1e3:.2f} mm thick there. Press less deep.")  # fmt: skip
        thickness = float(layer.thickness[footprint].min())
        shallow, deep = float(depths[0]), [float(depths[-1]) * share for share in np.linspace(0.15, 1, 6)]

        def edge_length(points: np.ndarray) -> np.ndarray:
            wanted = [
                edge_for_curvature(tool.at(depth).shifted(aside), points, thickness)
                for tool in self.tools
                for depth in deep
                for aside in tool.sideways(SPREAD * thickness)
            ]
            wanted += [edge_for_first_contact(tool.at(shallow), points, shallow) for tool in self.tools]
            return np.min(wanted, axis=0)

        self.patch: Patch = self.fem.patch_around(footprint, edge_length)
        self.mesh: WedgeMesh = self.patch.mesh
        self.thickness = thickness
        self.system: System = self.fem.system(self.patch, Load.zero(layer))
        self.area = column_areas(self.mesh)
        modulus = layer.tissue.confined_modulus / self.thickness
        tangential = {"stick": STICK_PENALTY, "none": 0.0}.get(str(solver.friction), FRICTION_PENALTY) * modulus
        self.stiffness = (NORMAL_PENALTY * modulus, tangential)
        n = self.mesh.n_columns
        u, multipliers = self.system.zeros(), [np.zeros(n) for _ in tools]
        self.state = _State(
            u,
            None,
            0.0,
            multipliers,
            [np.full((n, 3), np.nan) for _ in tools],
            NewtonResult(u, True, 0.0, 1.0, 0, 0, 1.0),
            [],
        )
        self.state = replace(self.state, loads=self._loads(0.0))
        self.last: Indentation | None = None
        self.stopped = ""

    def to(self, depth: float) -> Indentation:
        """Walks to `depth` and says what is there."""
        self.walk(depth)
        self.last = self.answer()
        return self.last

    def walk(self, depth: float) -> bool:
        """Moves the state to `depth` in short steps, halved where Newton fails; False if it stops on the way."""
        step, self.stopped = self.solver.step * self.thickness, ""
        while abs(depth - self.state.travel) > 1e-12:
            travel = self.state.travel + float(np.clip(depth - self.state.travel, -step, step))
            result, loads = self._step(travel)
            if result.converged:
                self.state = self._next(result, loads, travel)
            elif step > self.solver.step * self.thickness / 8:
                step /= 2
            else:
                self.stopped = (
                    f"Newton stopped at {travel * 1e3:.2f} mm (residual {result.residual:.1e}): "
                    f"the answer is that of {self.state.travel * 1e3:.2f} mm"
                )
                return False
        return True

    def force(self) -> float:
        """Sum over the tools of the force along each one's travel [N], at the present state."""
        skin = self.system.rest[:, 0] + self.state.u[:, 0]
        return sum(float(x.nodal_forces(skin).sum(axis=0) @ x.tool.direction) for x in self.state.loads)

    def _loads(self, travel: float) -> list[ToolLoad]:
        skin, loads = self.system.rest[:, 0] + self.state.u[:, 0], []
        for k, start in enumerate(self.tools):
            tool = start.at(travel)
            near = np.flatnonzero((tool.distance(skin) < 0.5 * self.thickness) & ~self.patch.fixed)
            multiplier = self.state.multipliers[k][near]
            limit = self._friction_limit(multiplier)
            load = ToolLoad(
                tool,
                self.area,
                near,
                self.system.diagonal,
                self.stiffness,
                multiplier,
                self.state.anchors[k][near],
                limit,
            )
            loads.append(load)
        return loads

    def _friction_limit(self, multiplier: np.ndarray) -> np.ndarray:
        friction = self.solver.friction
        return np.full(len(multiplier), np.inf) if isinstance(friction, str) else friction * multiplier

    def _step(self, travel: float) -> tuple[NewtonResult, list[ToolLoad]]:
        state, loads = self.state, self._loads(travel)
        self.system.loads = loads
        guess = state.u if state.previous is None else 2 * state.u - state.previous
        if not self.system.internal(guess)[1] > 0.5 * MIN_J:
            guess = state.u
        settings = replace(self.fem.settings, tolerance=1e-4, max_iterations=40)
        result = newton(self.system, guess, 1.0, settings)
        for update in range(MAX_UPDATES + 1):
            skin = self.system.rest[:, 0] + result.u[:, 0]
            entered = max(float(-load.tool.distance(skin[load.near]).min(initial=0.0)) for load in loads)
            if not result.converged or entered < MAX_ENTERED or update == MAX_UPDATES:
                break
            for load in loads:
                load.multiplier = load.pressure(skin)
                load.limit = self._friction_limit(load.multiplier)
            result = newton(self.system, result.u, 1.0, settings)
        return result, loads

    def _next(self, result: NewtonResult, loads: list[ToolLoad], travel: float) -> _State:
        """The state after a step: multipliers kept, touching points anchored, anchors dragged where they slip."""
        n, skin = self.mesh.n_columns, self.system.rest[:, 0] + result.u[:, 0]
        multipliers, anchors = [], []
        for load in loads:
            multiplier, anchor = np.zeros(n), np.full((n, 3), np.nan)
            multiplier[load.near] = load.pressure(skin)
            if load.tangent > 0:
                touching = multiplier[load.near] > 0
                offset, secant = load.slip(skin)
                at = skin[load.near] - offset * (secant / load.tangent)[:, None]
                anchor[load.near[touching]] = load.tool.to_tool(at[touching])
            multipliers.append(multiplier)
            anchors.append(anchor)
        previous = self.state.u if self.state.travel != 0.0 else None
        return _State(result.u, previous, travel, multipliers, anchors, result, loads)

    def answer(self) -> Indentation:
        """What is known at the present state."""
        layer, patch, result, loads = self.layer, self.patch, self.state.result, self.state.loads
        self.system.loads = loads
        displacement, traction = np.zeros_like(layer.vertices), np.zeros_like(layer.vertices)
        n = len(patch.vertices)
        displacement[patch.vertices] = result.u[:n, 0]
        skin, forces, wrenches = self.system.rest[:, 0] + result.u[:, 0], np.zeros((self.mesh.n_columns, 3)), []
        for load in loads:
            nodal = load.nodal_forces(skin)
            forces[load.near] += nodal
            arm = skin[load.near] - load.tool.pose_body_from_tool[:3, 3]
            wrenches.append(np.concatenate([nodal.sum(axis=0), np.cross(arm, nodal).sum(axis=0)]))
        corner = self.mesh.to_corners(forces)
        traction[patch.vertices] = patch.gather(corner) / layer.vertex_areas[patch.vertices, None]
        pressure = np.maximum(0.0, -np.einsum("vi,vi->v", traction, layer.normals))
        return Indentation(
            displacement,
            pressure,
            traction,
            tuple(wrenches),
            self.state.travel,
            tuple(load.tool for load in loads),
            self._trust(result, loads, skin),
        )

    def _trust(self, result: NewtonResult, loads: list[ToolLoad], skin: np.ndarray) -> Trust:
        faces = skin[self.mesh.triangles].mean(axis=1)
        nodes_in = max(float(-load.tool.distance(skin[load.near]).min(initial=0.0)) for load in loads)
        faces_in = max(float(-load.tool.distance(faces).min(initial=0.0)) for load in loads)
        stable = not self.fem.check_stability or is_positive_definite(self.system, result.u)
        discretisation = discretisation_error(self.system, result.u)
        truncation = truncation_error(self.patch, result.u, self.layer)
        peak = float(np.linalg.norm(result.u[:, 0], axis=1).max(initial=0.0))
        touched = [(load.area, load.pressure(skin)) for load in loads]
        area = sum(float(share[p > 0].sum()) for share, p in touched)
        mean = sum(float(share @ p) for share, p in touched) / area if area > 0 else 0.0
        trust = Trust(
            converged=result.converged,
            error_bound=error_bound(discretisation, truncation, peak),
            figures={
                "min_j": result.min_j,
                "positive_definite": float(stable),
                "residual": result.residual,
                "nodes_entered_m": nodes_in,
                "faces_entered_m": faces_in,
                "discretisation_m": discretisation,
                "truncation_m": truncation,
                "mean_pressure_over_modulus": mean / self.layer.tissue.youngs_modulus,
                "contact_area_m2": area,
                "columns": self.mesh.n_columns,
            },
        )
        if faces_in > MAX_FACES_ENTERED * self.thickness:
            trust = trust.also(
                f"faces enter the tool by {faces_in * 1e3:.3f} mm, more than 1 % of the thickness: "
                "refine the patch (PatchFem(refine=...))",
                in_range=False,
            )
        if result.min_j < MIN_J:
            trust = trust.also(f"an element is crushed to {result.min_j:.2f} of its volume", in_range=False)
        if not stable:
            trust = trust.also("the tangent is not positive definite: the equilibrium is unstable", in_range=False)
        if self.last is not None and self.last.depth < self.state.travel:
            if self.force() < self.last.force:
                trust = trust.also(f"the force fell from {self.last.force:.3g} to {self.force():.3g} N", in_range=False)
        if self.stopped:
            trust = trust.also(self.stopped, converged=False, in_range=False)
        return trust if trust.ok else replace(trust, error_bound=None)


def error_bound(discretisation: float, truncation: float, peak: float) -> float:
    """The largest error to expect of a displacement at any vertex, from both estimates and the largest motion [m]."""
    return DISCRETISATION_SHARE * discretisation + TRUNCATION_SHARE * truncation + PEAK_SHARE * peak


def edge_for_curvature(tool: Tool, points: np.ndarray, thickness: float) -> np.ndarray:
    """The longest edge of a triangle whose middle may sink into the tool by no more than allowed, (T,) [m].

    Where the corners of a triangle with edges h lie on a surface of curvature k, its middle is k h^2 / 6 inside.

    Args:
        tool: at the pose to be followed.
        points: of each triangle, (T, k, 3) [m].
        thickness: of the layer [m].
    """
    curvature = _curvature_touched(tool, points)
    return np.sqrt(6 * SHARE_FOR_STRETCH * MAX_FACES_ENTERED * thickness / np.maximum(curvature, 1e-9))


def edge_for_first_contact(tool: Tool, points: np.ndarray, depth: float) -> np.ndarray:
    """A third of the contact's radius sqrt(depth / k) where a tool of curvature k has sunk in by `depth`, (T,) [m]."""
    return np.sqrt(depth / np.maximum(_curvature_touched(tool, points), 1e-9)) / 3


def _curvature_touched(tool: Tool, points: np.ndarray) -> np.ndarray:
    """Largest curvature of the tool where each triangle meets it, (T,) [1/m]; 0 where it does not."""
    flat = points.reshape(-1, 3)
    phi, gradient, _ = tool.jet(flat)
    size = np.linalg.norm(points[:, 0] - points[:, -1], axis=1)
    touching = (phi.reshape(points.shape[:2]) < 0.3 * size[:, None]).any(axis=1)
    curvature = np.zeros(len(points))
    if touching.any():
        at = (flat - phi[:, None] * gradient).reshape(points.shape)[touching]
        hessian = tool.jet(at.reshape(-1, 3))[2]
        curvature[touching] = np.linalg.norm(hessian, ord=2, axis=(1, 2)).reshape(at.shape[:2]).max(axis=1)
    return curvature


def column_areas(mesh: WedgeMesh) -> np.ndarray:
    """Skin area of each column at rest, (C,) [m2]: a third of each triangle, or 1/12 and 1/4 where quadratic."""
    a, b, c = (mesh.outer[mesh.triangles[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = np.full(3, 1 / 3) if not len(mesh.edges) else np.repeat([1 / 12, 1 / 4], 3)
    out = np.zeros(mesh.n_columns)
    np.add.at(out, mesh.columns, area[:, None] * share)
    return out
