"""Walk: rigid tools under way through a soft layer, step by step, in node-to-surface contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fem_tools.estimates import discretisation_error, truncation_error
from fem_tools.mesh import WedgeMesh
from fem_tools.newton import NewtonResult, is_positive_definite, newton, work_spent
from fem_tools.patch import Patch
from fem_tools.press import Press
from fem_tools.relaxation import Body, Memories
from fem_tools.stroke import Stroke
from fem_tools.system import System
from fem_tools.tool_contact import SETTLED, PressLoad, column_areas, friction_limit, penalties
from fem_tools.way import PressWay, StrokeWay, Way
from stmpl_core.arrays import PerVertex, VertexVectors, Wrench
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.trust import Trust

if TYPE_CHECKING:
    from fem_tools.indenter import IndenterFem

MAX_ENTERED = 20e-6  # m; the augmented Lagrangian goes on until nodes are less deep in a tool
MAX_UPDATES = 4
MAX_FRICTION_UPDATES = 12  # updates under Coulomb's law, whose limit follows the pressure
LEAST_LOAD = 0.01  # share of a path's largest load by which residuals are measured where there is less [-]
MAX_UNSETTLED = 0.05  # share of the limit by which friction may differ from that of the pressure [-]
STRAIGHT = 0.9  # cosine between two steps of a tool, above which the skin is taken to go on as it did [-]
TIGHT = 1e-4  # residual over load of a solve [-]
LOOSE = 3e-3  # residual over load of a solve whose friction has still to settle [-]
MIN_J = 0.1  # smallest det F of an answer that is believed [-]
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
        depth: way of the tools beyond first touch [m]; on a path of poses how deep they are in the skin at rest.
        tools: tools at the poses where they stand.
        trust: what may be believed of it; `figures` hold the entered depth at nodes and faces, the latter also over how
            deep the tools go at their deepest, the share of the load under which skin slips, min det F, stability.
        frictions: share of each wrench that friction exerts.
        time: time on the way [s]; 0 where it has none.
    """

    displacement: VertexVectors
    pressure: PerVertex
    traction: VertexVectors
    wrenches: tuple[Wrench, ...]
    depth: float
    tools: tuple[Press, ...]
    trust: Trust
    frictions: tuple[Wrench, ...] = ()
    time: float = 0.0

    @property
    def force(self) -> float:
        """Sum over the tools of the force along each tool's travel [N]."""
        return float(sum(w[:3] @ t.direction for w, t in zip(self.wrenches, self.tools, strict=True)))


@dataclass(frozen=True, eq=False)
class _State:
    """What a press carries from step to step."""

    u: np.ndarray
    previous: np.ndarray | None
    travel: float  # place on the way, see Way
    before: float  # place of `previous`
    multipliers: list[np.ndarray]  # per tool, for all columns
    anchors: list[np.ndarray]  # per tool, for all columns, in the tool's frame; NaN: free
    result: NewtonResult
    loads: list[PressLoad]
    memories: Memories = (None, None)
    body: Body | None = None  # of the last step


class Walk:
    """Tools under way: the patch, the equations and the present state.

    Args:
        solver: settings of the walk.
        layer: soft layer.
        tools: presses anywhere along their ways, or strokes.
        depths: depths that will be asked for of presses, increasing, > 0 [m]; the mesh is made for them.
        times: times at the depths, or at the poses, increasing [s]; None: no time.

    Raises:
        InvalidInput: see IndenterFem.path and IndenterFem.follow.
    """

    def __init__(self, solver: IndenterFem, layer: SoftLayer, tools: Sequence[Press] | Sequence[Stroke],
                 depths: np.ndarray | None = None,
                 times: Sequence[float] | np.ndarray | None = None) -> None:  # fmt: skip
        self.solver, self.layer, self.fem = solver, layer, solver.fem
        self.coulomb = not isinstance(solver.friction, str)
        self.way: Way
        if depths is not None:
            self.way = PressWay(layer, [tool for tool in tools if isinstance(tool, Press)], depths, times)
        else:
            mu = solver.friction if not isinstance(solver.friction, str) else float(solver.friction == "stick")
            self.way = StrokeWay(layer, [tool for tool in tools if isinstance(tool, Stroke)], times, mu)
        self.thickness = self.way.thickness
        self.patch: Patch = self.fem.patch_around(self.way.footprint, self.way.edge_length)
        self.mesh: WedgeMesh = self.patch.mesh
        self.system: System = self.fem.system(self.patch, Load.zero(layer))
        self.area = column_areas(self.mesh)
        self.stiffness = penalties(solver.friction, layer.tissue, self.thickness)
        n, count = self.mesh.n_columns, len(self.way.tools(0.0))
        u = self.system.zeros()
        self.state = _State(u, None, 0.0, 0.0, [np.zeros(n)] * count, [np.full((n, 3), np.nan)] * count,
                            NewtonResult(u, True, 0.0, 1.0, 0, 0, 1.0), [])  # fmt: skip
        self.state = replace(self.state, loads=self._loads(0.0))
        self.relaxing = self.system.relax(solver.fading) if self.way.timed and layer.tissue.relaxes else None
        if self.relaxing:
            self.state = replace(self.state, memories=self.relaxing.start, body=self.relaxing.body)
        self.last: Indentation | None = None
        self.stopped, self.work = "", 0.0
        self._share = 1.0  # of the longest step, that is tried next

    def to(self, depth: float) -> Indentation:
        """Walks to `depth` and says what is there."""
        self.walk(depth)
        self.last = self.answer()
        return self.last

    def walk(self, place: float) -> bool:
        """Moves the state to a place in short steps, halved where Newton fails; False if it stops on the way.

        It stops where Newton fails in the shortest step, and where the work is spent.
        """
        longest, self.stopped = self.solver.step * self.thickness, ""
        stroke = isinstance(self.way, StrokeWay)
        self._share = self._share if stroke else 1.0
        while abs(place - self.state.travel) > 1e-12:
            travel = self.way.next(self.state.travel, place, self._share * longest)
            result, loads = self._step(travel)
            if result.converged:
                self.state = self._next(result, loads, travel)
                self._share = min(1.0, 1.5 * self._share) if stroke else self._share
            elif self._share > self.way.smallest and self.work < self.solver.max_work:
                self._share /= 2
            else:
                spent = work_spent(self.work, self.solver.max_work)
                at, reached = (f"pose {x:.2f}" if stroke else f"{x * 1e3:.2f} mm" for x in (travel, self.state.travel))
                self.stopped = (
                    f"Newton stopped at {at} (residual {result.residual:.1e}): "
                    f"the answer is that of {reached}{'; ' * bool(spent)}{spent}"
                )
                return False
        return True

    def force(self) -> float:
        """Sum over the tools of the force along each one's travel [N], at the present state."""
        skin = self.system.rest[:, 0] + self.state.u[:, 0]
        return sum(float(x.nodal_forces(skin).sum(axis=0) @ x.tool.direction) for x in self.state.loads)

    def _loads(self, travel: float) -> list[PressLoad]:
        skin, loads = self.system.rest[:, 0] + self.state.u[:, 0], []
        for k, tool in enumerate(self.way.tools(travel)):
            near = np.flatnonzero((tool.distance(skin) < 0.5 * self.thickness) & ~self.patch.fixed)
            multiplier, anchor = self.state.multipliers[k][near], self.state.anchors[k][near]
            fresh = np.isnan(anchor).any(axis=1)
            if self.coulomb and self.state.loads:
                anchor = np.where(fresh[:, None], self.state.loads[k].tool.to_tool(skin[near]), anchor)
            limit = friction_limit(self.solver.friction, multiplier)
            loads.append(PressLoad(tool, self.area, near, self.system.diagonal, self.stiffness, multiplier, anchor,
                                   limit, fresh))  # fmt: skip
        return loads

    def _step(self, travel: float) -> tuple[NewtonResult, list[PressLoad]]:
        state, loads = self.state, self._loads(travel)
        self.system.loads = loads
        if self.relaxing:
            self.relaxing.begin(state.memories, self.way.time(travel) - self.way.time(state.travel))
        guess = state.u if state.previous is None else 2 * state.u - state.previous
        if isinstance(self.way, StrokeWay):
            guess = self._ahead(travel)
        if not self.system.internal(guess)[1] > 0.5 * MIN_J:
            guess = state.u
        result = self._newton(guess, LOOSE if self.coulomb else TIGHT)
        most = MAX_FRICTION_UPDATES if self.coulomb else MAX_UPDATES
        for update in range(most + 1):
            skin = self.system.rest[:, 0] + result.u[:, 0]
            entered = max(float(-load.tool.distance(skin[load.near]).min(initial=0.0)) for load in loads)
            settled = all(load.unsettled(skin, self.solver.friction) < SETTLED for load in loads)
            if not result.converged or (entered < MAX_ENTERED and settled) or update == most:
                break
            for load in loads:
                load.update(skin, self.solver.friction)
            result = self._newton(result.u, LOOSE if self.coulomb else TIGHT)
        if self.coulomb and result.converged:
            result = self._newton(result.u, TIGHT)
        return result, loads

    def _ahead(self, travel: float) -> np.ndarray:
        """The last two displacements carried on in a straight line, (C, levels, 3) [m]; the last where tools turn."""
        state, share = self.state, 0.0
        if state.previous is None:
            return state.u
        places, size = (state.before, state.travel, travel), self.way.deepest
        at = [np.stack([tool.pose_body_from_tool for tool in self.way.tools(place)]) for place in places]
        for before, here, there in zip(*at, strict=True):
            moved = here - before, there - here
            last, coming = (np.append(size * x[:3, :3], x[:3, 3]) for x in moved)
            if not last @ coming > STRAIGHT * np.linalg.norm(last) * np.linalg.norm(coming):
                return state.u
            share = max(share, float(np.linalg.norm(coming) / np.linalg.norm(last)))
        return state.u + min(share, 2.0) * (state.u - state.previous)

    def _newton(self, start: np.ndarray, tolerance: float) -> NewtonResult:
        """Newton from here with the work that is left."""
        left = max(self.solver.max_work - self.work, 1.0)
        settings = replace(self.fem.settings, tolerance=tolerance, max_iterations=40, max_work=left)
        result = newton(self.system, start, 1.0, settings)
        self.work += result.work
        if isinstance(self.way, StrokeWay):
            self.system.least = max(self.system.least, LEAST_LOAD * result.scale)
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
        memories, body = self.state.memories, None
        if self.relaxing:
            dt = self.way.time(travel) - self.way.time(self.state.travel)
            memories, body = self.relaxing.after(memories, dt, result.u), self.relaxing.body
        before = self.state.travel
        return _State(result.u, previous, travel, before, multipliers, anchors, result, loads, memories, body)

    def answer(self) -> Indentation:
        """What is known at the present state."""
        layer, patch, result, loads = self.layer, self.patch, self.state.result, self.state.loads
        self.system.loads = loads
        if self.relaxing and self.state.body:
            self.relaxing.resume(self.state.body)
        displacement, traction = np.zeros_like(layer.vertices), np.zeros_like(layer.vertices)
        n = len(patch.vertices)
        displacement[patch.vertices] = result.u[:n, 0]
        skin, forces = self.system.rest[:, 0] + result.u[:, 0], np.zeros((self.mesh.n_columns, 3))
        wrenches, rubs = [], []
        for load in loads:
            nodal = load.nodal_forces(skin)
            forces[load.near] += nodal
            arm = skin[load.near] - load.tool.pose_body_from_tool[:3, 3]
            wrenches.append(_wrench(arm, nodal))
            rubs.append(_wrench(arm, load.friction_forces(skin)))
        corner = self.mesh.to_corners(forces)
        traction[patch.vertices] = patch.gather(corner) / layer.vertex_areas[patch.vertices, None]
        pressure = np.maximum(0.0, -np.einsum("vi,vi->v", traction, layer.normals))
        return Indentation(
            displacement,
            pressure,
            traction,
            tuple(wrenches),
            self.way.depth(self.state.travel),
            tuple(load.tool for load in loads),
            self._trust(result, loads, skin),
            tuple(rubs),
            self.way.time(self.state.travel),
        )

    def _trust(self, result: NewtonResult, loads: list[PressLoad], skin: np.ndarray) -> Trust:
        faces = skin[self.mesh.triangles].mean(axis=1)
        nodes_in = max(float(-load.tool.distance(skin[load.near]).min(initial=0.0)) for load in loads)
        faces_in = max(float(-load.tool.distance(faces).min(initial=0.0)) for load in loads)
        stable = not self.fem.check_stability or is_positive_definite(self.system, result.u)
        discretisation = discretisation_error(self.system, result.u)
        truncation = truncation_error(self.patch, result.u)
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
                "faces_entered_over_depth": faces_in / self.way.deepest,
                "slipping": sum(load.slipping(skin) for load in loads) / len(loads),
                "friction_unsettled": max(load.unsettled(skin, self.solver.friction) for load in loads),
                "discretisation_m": discretisation,
                "truncation_m": truncation,
                "mean_pressure_over_modulus": mean / self.layer.tissue.youngs_modulus,
                "contact_area_m2": area,
                "columns": self.mesh.n_columns,
            },
        )
        if faces_in > self.way.allowed:
            trust = trust.also(
                f"faces enter the tool by {faces_in * 1e3:.3f} mm, more than 1 % of the thickness: "
                "refine the patch (PatchFem(refine=...))",
                in_range=False,
            )
        unsettled = trust.figures["friction_unsettled"]
        if unsettled > MAX_UNSETTLED:
            why = f"friction is {unsettled:.0%} from that of the pressure: shorten the steps, or refine the patch"
            trust = trust.also(why, in_range=False)
        if isinstance(self.way, StrokeWay):  # nobody fitted one
            trust = replace(trust, error_bound=None)
        if result.min_j < MIN_J:
            trust = trust.also(f"an element is crushed to {result.min_j:.2f} of its volume", in_range=False)
        if not stable:
            trust = trust.also("the tangent is not positive definite: the equilibrium is unstable", in_range=False)
        if isinstance(self.way, PressWay) and self.force() < 0:
            trust = trust.also(f"the skin pulls at the tool with {-self.force():.3g} N", in_range=False)
        if self.last is not None and self.last.depth < self.state.travel and isinstance(self.way, PressWay):
            if self.force() < self.last.force:
                trust = trust.also(f"the force fell from {self.last.force:.3g} to {self.force():.3g} N", in_range=False)
        if self.stopped:
            trust = trust.also(self.stopped, converged=False, in_range=False)
        return trust if trust.ok else replace(trust, error_bound=None)


def error_bound(discretisation: float, truncation: float, peak: float) -> float:
    """The largest error to expect of a displacement at any vertex, from both estimates and the largest motion [m]."""
    return DISCRETISATION_SHARE * discretisation + TRUNCATION_SHARE * truncation + PEAK_SHARE * peak


def _wrench(arm: np.ndarray, forces: np.ndarray) -> Wrench:
    """Sum of forces (n, 3) [N], and of their torques at arms (n, 3) [m] about the tool's origin, (6,)."""
    return np.concatenate([forces.sum(axis=0), np.cross(arm, forces).sum(axis=0)])
