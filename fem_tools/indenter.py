"""IndenterFem: rigid tools pressed into the soft layer, step by step, in node-to-surface contact."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fem_tools.estimates import discretisation_error, truncation_error
from fem_tools.mesh import WedgeMesh
from fem_tools.newton import MAX_WORK, NewtonResult, is_positive_definite, newton, work_spent
from fem_tools.patch import Patch, PatchFem
from fem_tools.plies import confined_modulus
from fem_tools.press import MAX_FACES_ENTERED, Press, above_core, edge_for_curvature, edge_for_first_contact
from fem_tools.system import System
from fem_tools.tool_contact import Friction, PressLoad, column_areas, friction_limit, penalties
from stmpl_core.arrays import PerVertex, VertexVectors, Wrench, finite
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import prepared
from stmpl_core.trust import Trust

MAX_ENTERED = 20e-6  # m; the augmented Lagrangian goes on until nodes are less deep in a tool
SPREAD = 0.15  # way that skin is pushed aside before it is touched [thicknesses]
MAX_UPDATES = 4
MIN_J = 0.1  # smallest det F of an answer that is believed [-]
INDENTER_LAYERS = 2  # wedges through the thickness: one is 5 % off in force and 10 % in pressure, two 0.7 % in both
# The stated bound: shares of the estimates and of the peak, fitted on 30 answers of one wedge deep against two deep on
# half the edges; the peak's share was 0.011 until 12 held-out answers asked for more (docs/ground_truth.md).
DISCRETISATION_SHARE, TRUNCATION_SHARE, PEAK_SHARE = 1.3, 0.35, 0.015


@dataclass(frozen=True, eq=False)
class Indentation:
    """One step of a walk.

    Args:
        displacement: displacement of the layer's vertices, (V, 3) [m].
        pressure: contact force over rest area at the layer's vertices, (V,) [Pa].
        traction: contact force vectors over rest area, (V, 3) [Pa].
        wrenches: force [N] and torque about the tool's origin [N m] of each tool *on the body*, in the layer's axes.
        depth: way of the tools beyond first touch [m].
        tools: tools at the poses where they stand.
        trust: what may be believed of it; `figures` hold the entered depth at nodes and faces, min det F, stability.
    """

    displacement: VertexVectors
    pressure: PerVertex
    traction: VertexVectors
    wrenches: tuple[Wrench, ...]
    depth: float
    tools: tuple[Press, ...]
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
    loads: list[PressLoad]


class IndenterFem:
    """Presses rigid tools into a soft layer.

    Args:
        fem: solver that meshes the patch; None: two wedges deep, up to three refinements where the tool's
            curvature asks.
        friction: law of friction: "stick" (a touching point stays where it touched, until it is let go), "none", or
            Coulomb's coefficient with the limit taken from the last update of the pressure.
        step: longest step of the tools [thicknesses]; what touches first within a step sticks from its end on.
        max_work: multiplications after which a press or a path stops, whatever it has reached (see NewtonSettings).
    """

    def __init__(self, fem: PatchFem | None = None, *, friction: Friction = "stick", step: float = 0.04,
                 max_work: float = MAX_WORK) -> None:  # fmt: skip
        if not (friction in ("stick", "none") or (isinstance(friction, int | float) and 0 <= friction < 10)):
            raise InvalidInput(f'friction is {friction!r}; allowed are "stick", "none" or a coefficient in [0, 10).')
        self.fem = fem or PatchFem(refine=3, layers=INDENTER_LAYERS)
        if not 0 < step <= 0.5:
            raise InvalidInput(f"step is {step} thicknesses; allowed is 0 < step <= 0.5.")
        self.friction: Friction = friction
        if not max_work > 0:
            raise InvalidInput(f"max_work is {max_work}; it must be above 0 multiplications.")
        self.step, self.max_work = step, max_work
        self._layer: SoftLayer | None = None

    def prepare(self, layer: SoftLayer) -> Self:
        """See PatchFem.prepare. A tool near a fold of the layer is refused when it is pressed (MeshError)."""
        self.fem.prepare(layer)
        self._layer = layer
        return self

    def path(self, tools: Sequence[Press], depths: Sequence[float] | np.ndarray) -> Iterator[Indentation]:
        """Presses all tools together, and gives an answer at each depth beyond first touch.

        Args:
            tools: tools anywhere along their ways; each is first brought to where it just touches.
            depths: depths beyond first touch, increasing, > 0 [m].

        Yields:
            One Indentation a depth. After a step that fails the last believed one is flagged, and the path ends.

        Raises:
            InvalidInput: no tools, depths that do not increase, a tool that never meets the skin, or one whose way
                ends in the core.
        """
        walk = Walk(self, prepared(self._layer, self), tools, finite("depths", depths, (None,)))
        for depth in depths:
            answer = walk.to(float(depth))
            yield answer
            if not answer.trust.converged:
                return

    def press(self, tools: Sequence[Press], depth: float) -> Indentation:
        """The answer at one depth [m]. See `path`."""
        return list(self.path(tools, [depth]))[-1]

    def press_with(self, tools: Sequence[Press], force: float, *, deepest: float | None = None,
                   tolerance: float = 1e-3) -> Indentation:  # fmt: skip
        """The answer where the tools' forces along their ways sum to `force` [N].

        Args:
            tools: tools, see `path`.
            force: force that is wanted, > 0 [N].
            deepest: depth at which to give up [m]; None: 0.9 of the layer's smallest thickness, or of what lies
                below the tools where the layer has a core.
            tolerance: relative error of the force that is allowed [-].

        Raises:
            InvalidInput: as `path`, or a force that is not above 0.
        """
        layer = prepared(self._layer, self)
        if not (np.isfinite(force) and force > 0):
            raise InvalidInput(f"the force is {force} N; it must be finite and above 0.")
        limit = deepest or 0.9 * self._least_below(layer, tools)
        walk = Walk(self, layer, tools, np.array([limit]))
        below, above = (0.0, 0.0, walk.state), None  # depth, force, state
        while above is None:
            depth = min(below[0] + self.step * walk.thickness, limit)
            if not walk.walk(depth):
                return walk.answer()
            if walk.force() >= force:
                above = (depth, walk.force())
            elif depth >= limit:
                answer = walk.answer()
                why = f"{answer.force:.3g} N at the deepest allowed {limit * 1e3:.2f} mm; {force:.3g} N was asked"
                return replace(answer, trust=answer.trust.also(why, in_range=False))
            else:
                below = (depth, walk.force(), walk.state)
        for _ in range(20):  # regula falsi, always from the state below, so that the path stays the same
            depth = below[0] + (force - below[1]) / (above[1] - below[1]) * (above[0] - below[0])
            walk.state = below[2]
            if not walk.walk(depth) or abs(walk.force() - force) <= tolerance * force:
                break
            above = (depth, walk.force()) if walk.force() > force else above
            below = below if walk.force() > force else (depth, walk.force(), walk.state)
        else:
            walk.stopped = f"the force is {walk.force():.4g} N after 20 trials; {force:.4g} N was asked"
        return walk.answer()


    @staticmethod
    def _least_below(layer: SoftLayer, tools: Sequence[Press]) -> float:
        """Thickness that tools may go through [m]."""
        if layer.core is None:
            return float(layer.thickness.min())
        touching = [there for tool in tools if (there := tool.touching(layer)) is not None]
        return max(float(np.min(above_core(layer, touching)[1])), 1e-6) if touching else float(layer.thickness.min())


class Walk:
    """Tools under way from depth to depth: the patch, the equations and the present state.

    Args:
        solver: settings of the walk.
        layer: soft layer.
        tools: tools anywhere along their ways.
        depths: depths that will be asked for, increasing, > 0 [m]; the mesh is made for them.

    Raises:
        InvalidInput: see IndenterFem.path.
    """

    def __init__(self, solver: IndenterFem, layer: SoftLayer, tools: Sequence[Press], depths: np.ndarray) -> None:
        if not len(tools):
            raise InvalidInput("there is no tool to press with.")
        if not len(depths) or depths[0] <= 0 or (np.diff(depths) <= 0).any():
            raise InvalidInput(f"depths must be above 0 and increase; got {depths}.")
        self.solver, self.layer, self.fem = solver, layer, solver.fem
        self.tools: list[Press] = []
        for number, tool in enumerate(tools):
            if (touching := tool.touching(layer)) is None:
                raise InvalidInput(f"tool {number} never meets the skin along its way {tool.direction}.")
            self.tools.append(touching)
        deepest = float(depths[-1])
        footprint, clearances = above_core(layer, [tool.at(deepest) for tool in self.tools])
        for number, clear in enumerate(clearances):
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
        self.stiffness = penalties(solver.friction, confined_modulus(layer.tissue, thickness) / thickness)
        n = self.mesh.n_columns
        u = self.system.zeros()
        self.state = _State(u, None, 0.0, [np.zeros(n) for _ in tools], [np.full((n, 3), np.nan) for _ in tools],
                            NewtonResult(u, True, 0.0, 1.0, 0, 0, 1.0), [])  # fmt: skip
        self.state = replace(self.state, loads=self._loads(0.0))
        self.last: Indentation | None = None
        self.stopped, self.work = "", 0.0

    def to(self, depth: float) -> Indentation:
        """Walks to `depth` and says what is there."""
        self.walk(depth)
        self.last = self.answer()
        return self.last

    def walk(self, depth: float) -> bool:
        """Moves the state to `depth` in short steps, halved where Newton fails; False if it stops on the way.

        It stops where Newton fails in the shortest step, and where the work is spent.
        """
        step, self.stopped = self.solver.step * self.thickness, ""
        while abs(depth - self.state.travel) > 1e-12:
            travel = self.state.travel + float(np.clip(depth - self.state.travel, -step, step))
            result, loads = self._step(travel)
            if result.converged:
                self.state = self._next(result, loads, travel)
            elif step > self.solver.step * self.thickness / 8 and self.work < self.solver.max_work:
                step /= 2
            else:
                spent = work_spent(self.work, self.solver.max_work)
                self.stopped = (
                    f"Newton stopped at {travel * 1e3:.2f} mm (residual {result.residual:.1e}): "
                    f"the answer is that of {self.state.travel * 1e3:.2f} mm{'; ' * bool(spent)}{spent}"
                )
                return False
        return True

    def force(self) -> float:
        """Sum over the tools of the force along each one's travel [N], at the present state."""
        skin = self.system.rest[:, 0] + self.state.u[:, 0]
        return sum(float(x.nodal_forces(skin).sum(axis=0) @ x.tool.direction) for x in self.state.loads)

    def _loads(self, travel: float) -> list[PressLoad]:
        skin, loads = self.system.rest[:, 0] + self.state.u[:, 0], []
        for k, start in enumerate(self.tools):
            tool = start.at(travel)
            near = np.flatnonzero((tool.distance(skin) < 0.5 * self.thickness) & ~self.patch.fixed)
            multiplier = self.state.multipliers[k][near]
            limit = friction_limit(self.solver.friction, multiplier)
            loads.append(PressLoad(tool, self.area, near, self.system.diagonal, self.stiffness, multiplier,
                                   self.state.anchors[k][near], limit))  # fmt: skip
        return loads

    def _step(self, travel: float) -> tuple[NewtonResult, list[PressLoad]]:
        state, loads = self.state, self._loads(travel)
        self.system.loads = loads
        guess = state.u if state.previous is None else 2 * state.u - state.previous
        if not self.system.internal(guess)[1] > 0.5 * MIN_J:
            guess = state.u
        result = self._newton(guess)
        for update in range(MAX_UPDATES + 1):
            skin = self.system.rest[:, 0] + result.u[:, 0]
            entered = max(float(-load.tool.distance(skin[load.near]).min(initial=0.0)) for load in loads)
            if not result.converged or entered < MAX_ENTERED or update == MAX_UPDATES:
                break
            for load in loads:
                load.multiplier = load.pressure(skin)
                load.limit = friction_limit(self.solver.friction, load.multiplier)
            result = self._newton(result.u)
        return result, loads

    def _newton(self, start: np.ndarray) -> NewtonResult:
        """Newton from here with the work that is left."""
        left = max(self.solver.max_work - self.work, 1.0)
        settings = replace(self.fem.settings, tolerance=1e-4, max_iterations=40, max_work=left)
        result = newton(self.system, start, 1.0, settings)
        self.work += result.work
        return result

    def _next(self, result: NewtonResult, loads: list[PressLoad], travel: float) -> _State:
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

    def _trust(self, result: NewtonResult, loads: list[PressLoad], skin: np.ndarray) -> Trust:
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
