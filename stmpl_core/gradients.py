"""Gradients: how wrenches and the skin's motion change with the tools' poses and sizes, and with the tissue.

For who plans a press (pose), or finds out what a limb is like from presses (modulus, thickness). By dimensional
analysis a wrench at a pose is W = E L^2 w(lengths / L, nu, ratios of moduli), and the motion u = L v of the same: so
dW/dE = W / E and du/dE = 0. By pose dW is analytic (stmpl_core.tangent). The limb's shape does not scale with its
tissue, so what is by thickness follows from no other derivative: it is a central difference of the law, on two skins
that are made once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from typing import Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import Transform, VertexVectors, Wrench, check_kind, finite, is_number
from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import thicker
from stmpl_core.methods.base import Method
from stmpl_core.nodes import Nodes
from stmpl_core.sdf import SignedDistance
from stmpl_core.simulator import Simulator
from stmpl_core.tangent import Tangent, groups_that_press, tangents
from stmpl_core.tool import Tool
from stmpl_core.touch import Touch
from stmpl_core.toucher import STIFFENING
from stmpl_core.trust import Trust
from stmpl_core.wrenches import unit_wrenches

By = Literal["pose", "modulus", "thickness", "tool_scale"]
EVERY: tuple[By, ...] = get_args(By)

THICKNESS_STEP = 0.03  # difference of the thickness either way: wrenches keep 1.5 %, fields rise over their jumps
TOOL_STEP = 0.04  # of a tool's size, at most: a sharp rim goes on by half a spacing of the contact's nodes
FIELD_STEP = 0.02  # of a tool's way over the thickness, at most: vertices jump by some 1 % of the peak as they let go
SHALLOW = 0.1  # of any way of the tool's surface over the depth of its touch
DRAWN = 1 + 1e-9  # factor from which a touch was drawn back from the core


@dataclass(frozen=True, eq=False)
class WrenchGradient:
    """Wrench of a tool by its pose, and what that changes by: zeros where the tool does not press.

    Args:
        name: name of the tool.
        wrench: force [N] and torque about the tool's origin [N m] that the tool exerts on the body, layer axes, (6,).
        pose: d wrench / d twist of the tool, (6, 6) [N/m, N/rad; N m/m, N m/rad]; the twist, by columns, is
            (translation of the tool's origin, rotation vector), in layer axes: see `twisted`.
        modulus: d wrench / d E, all moduli and the skin's tension in proportion, (6,) [N/Pa, N m/Pa].
        thickness: d wrench / d factor of `stmpl_core.layer.thicker`, at 1, (6,) [N, N m]; None: not asked for.
        tool_scale: d wrench / d factor on the tool's size about its own origin, at 1, likewise.
        across: d wrench / d twist of each other tool that it feels through the skin, by that tool's name, (6, 6) each.
        trust: verdict on the touch, and so on its gradient.
    """

    name: str
    wrench: Wrench
    pose: np.ndarray
    modulus: Wrench
    thickness: Wrench | None
    tool_scale: Wrench | None
    across: Mapping[str, np.ndarray]
    trust: Trust


@dataclass(frozen=True, eq=False)
class FieldGradient:
    """Displacement of the skin under tools, and what it changes by: zeros by a tool that does not press.

    Args:
        displacement: displacement of each vertex, (V, 3) [m].
        pose: d displacement / d twist of each tool, by its name, (V, 3, 6) each [-, m/rad]; empty: not asked for.
        modulus: d displacement / d E, all moduli and the skin's tension in proportion, (V, 3) [m/Pa]: zeros.
        thickness: d displacement / d factor of `stmpl_core.layer.thicker`, at 1, (V, 3) [m]; None: not asked for.
        tool_scale: d displacement / d factor on the size of each tool, by its name, (V, 3) each [m]; empty: likewise.
        trust: verdict on the answer, and so on its gradient.
    """

    displacement: VertexVectors
    pose: Mapping[str, np.ndarray]
    modulus: VertexVectors
    thickness: VertexVectors | None
    tool_scale: Mapping[str, VertexVectors]
    trust: Trust


class Gradients:
    """Derivatives of what a simulator says of elastic skin without friction, at contacts by their poses.

    A contact's wrench is not used: ask at the pose that its touch was answered for. What is by thickness and tool
    scale, and all of the field, is by central differences of the law itself. Those of the wrench by thickness keep the
    contact's nodes where they are, so nothing of their lattice is in them. Vertices come into touch and let go at
    once, by 1 % of the peak motion: a derivative of the field is that of its trend over the step.

    Beyond 90 % of the thickness the law draws a tool back, and states how much harder it presses (docs/contact.md): the
    gradient is that law's, and out of range.

    Args:
        simulator: simulator that is asked; where its joints are now.
        pose_step: way of a tool's surface over which wrenches are differenced by pose, either way [m]: for sharp rims,
            whose nodes come in one by one, half their spacing (0.5 mm) finds the trend; None: analytic.

    Raises:
        InvalidInput: no Simulator, or a step that is not above 0.
    """

    def __init__(self, simulator: Simulator, *, pose_step: float | None = None) -> None:
        check_kind("simulator", simulator, Simulator)
        if pose_step is not None and not (is_number(pose_step) and 0 < pose_step < np.inf):
            raise InvalidInput(f"pose_step is {pose_step!r:.40} m; it must be finite and above 0. Try 5e-4.")
        self.simulator, self.pose_step = simulator, pose_step
        self._made: tuple[Simulator, Simulator] | None = None

    def prepare(self) -> Self:
        """Makes the thinner and the thicker skin, each as long as the skin itself took; else the first use does."""
        self._ends()
        return self

    def wrench(self, contacts: Sequence[Contact], by: Collection[By] = EVERY) -> list[WrenchGradient]:
        """Wrench of each contact and its derivatives.

        By pose and modulus it takes two touches of time, by thickness two more, by tool scale three more for each tool.

        Args:
            contacts: tools at one instant, each once.
            by: what to differentiate by; pose and modulus always come along.

        Raises:
            InvalidInput, MeshError: what `Simulator.touch` raises, or an unknown `by`.
        """
        bare = _asked(contacts, by)
        touches = self.simulator.touch(bare)
        known, zero = tangents(self.simulator.toucher, touches), np.zeros(6)
        by_thickness = self._forces_by_thickness(touches) if "thickness" in by else None
        out = []
        for k, (touch, tangent) in enumerate(zip(touches, known, strict=True)):
            thickness, size = zero if by_thickness else None, zero if "tool_scale" in by else None
            pose, across, trust = np.zeros((6, 6)), {}, touch.trust
            if tangent is not None and touch.pressed is not None:
                pose, across = tangent.stiffness, tangent.across
                if touch.pressed.factor > DRAWN:
                    pose = pose + np.outer(*self._drawn(touch, tangent))
                    why = f"{touch.name} was drawn back from the core: its gradient is that of a stated law"
                    trust = trust.also(why, in_range=False)
                if by_thickness:
                    thickness = self._by_thickness(touch, tangent, by_thickness[k])
                if "tool_scale" in by:
                    size = self._by_size(bare, touch)
            out.append(WrenchGradient(touch.name, touch.wrench, pose, touch.wrench / self._modulus, thickness, size,
                                      across, trust))  # fmt: skip
        return out if self.pose_step is None else self._by_way(bare, touches, out, self.pose_step)

    def field(self, contacts: Sequence[Contact], by: Collection[By] = EVERY) -> FieldGradient:
        """Displacement under contacts and its derivatives.

        By pose it takes twelve answers of time for each tool, by thickness two, by tool scale two for each tool.

        Args:
            contacts: tools at one instant, each once.
            by: what to differentiate by.

        Raises:
            InvalidInput, MeshError: what `Simulator.touch` raises, or an unknown `by`.
        """
        bare = _asked(contacts, by)
        touches = self.simulator.touch(bare)
        answer, pressing = self.simulator.answer(touches), [one for one in touches if _presses(one)]
        zero = np.zeros_like(answer.displacement)
        pose = {one.name: np.zeros((*zero.shape, 6)) for one in bare if "pose" in by}
        size, thickness = {one.name: zero for one in bare if "tool_scale" in by}, zero if "thickness" in by else None
        for touch in pressing:
            if "pose" in by:
                for column, (low, high, step) in enumerate(_ways(bare, touch, _field_step(touch))):
                    pose[touch.name][:, :, column] = self._between(low, high) / step
            if "tool_scale" in by:
                (one, low), (other, high), step = self._resized(bare, touch)
                size[touch.name] = (other.step(high).displacement - one.step(low).displacement) / step
        if pressing and "thickness" in by:
            thin, thick = (end.step(bare).displacement for end in self._ends())
            thickness = (thick - thin) / (2 * THICKNESS_STEP)
        return FieldGradient(answer.displacement, pose, zero, thickness, size, answer.trust)

    def field_along(self, contacts: Sequence[Contact], twists: Mapping[str, ArrayLike]) -> VertexVectors:
        """Rate of the displacement as tools move, (V, 3) [m/s]: a directional derivative, for two answers of time.

        Args:
            contacts: tools at one instant, each once.
            twists: twist of each tool that moves, by its name, (6,) [m/s, rad/s]; the others rest.

        Raises:
            InvalidInput: a twist that is not six finite numbers, of a tool that is not there, or what
                `Simulator.touch` raises.
            MeshError: what `Simulator.touch` raises.
        """
        bare = _asked(contacts, ())
        check_kind("twists", twists, Mapping)
        ways = {name: finite(f"twist of {name}", twist, (6,)) for name, twist in twists.items()}
        if strange := set(ways) - {one.name for one in bare}:
            raise InvalidInput(f"there is no contact of {', '.join(sorted(strange))}. Available: "
                               f"{', '.join(one.name for one in bare) or 'none'}.")  # fmt: skip
        touches = [one for one in self.simulator.touch(bare) if one.name in ways and _presses(one)]
        pace = max((_pace(one, ways[one.name]) / _field_step(one) for one in touches), default=0.0)
        if pace == 0:
            return np.zeros_like(self.simulator.layer.vertices)
        low, high = ([replace(one, pose_body_from_tool=twisted(one.pose_body_from_tool, by * ways[one.name] / pace))
                      if one.name in ways else one for one in bare] for by in (-1, 1))  # fmt: skip
        return self._between(low, high) * pace / 2

    @property
    def _modulus(self) -> float:
        return self.simulator.layer.tissue.youngs_modulus

    def _between(self, low: list[Contact], high: list[Contact]) -> np.ndarray:
        """Displacement under some contacts, less that under others, (V, 3) [m]."""
        return self.simulator.step(high).displacement - self.simulator.step(low).displacement

    def _ends(self) -> tuple[Simulator, Simulator]:
        """Simulators of the thinner and the thicker skin, where the joints are now."""
        skin = self.simulator.skin
        if self._made is None:
            thin, thick = (Simulator(thicker((skin.rest or skin).layer, by), _fresh(skin.method))
                           for by in (1 - THICKNESS_STEP, 1 + THICKNESS_STEP))  # fmt: skip
            self._made = thin, thick
        for end in self._made:
            end.toucher.tools = self.simulator.tools
            end.move_to(end.skin.at_angles(skin.angles))
        return self._made

    def _forces_by_thickness(self, touches: Sequence[Touch]) -> list[np.ndarray]:
        """d force / d factor of the thickness at each touch's nodes, which stay where they are, (N,) [N]."""
        out = [np.empty(0)] * len(touches)
        for group in groups_that_press(self.simulator.toucher, touches):
            parts = [one for k in group if (one := touches[k].pressed) is not None]
            every = [one.squeeze.nodes for one in parts]
            joined = self.simulator.toucher.joined([(one.field, touches[k].pose_body_from_tool, one.squeeze)
                                                    for k, one in zip(group, parts, strict=True)])  # fmt: skip
            thin, thick = (end.toucher.net.hold(_below(joined, by)).pressure
                           for end, by in zip(self._ends(), (1 - THICKNESS_STEP, 1 + THICKNESS_STEP), strict=True))
            rates = (thick - thin) * joined.area * self._modulus / (2 * THICKNESS_STEP)
            ends = np.cumsum([len(nodes.area) for nodes in every])[:-1]
            for k, one, some in zip(group, parts, np.split(rates, ends), strict=True):
                out[k] = one.factor * some
        return out

    def _by_thickness(self, touch: Touch, tangent: Tangent, forces: np.ndarray) -> Wrench:
        """d wrench / d factor of the thickness, of d force at the touch's nodes (N,) [N], (6,) [N, N m]."""
        assert touch.pressed is not None
        layer, nodes, factor = self.simulator.layer, touch.pressed.squeeze.nodes, touch.pressed.factor
        unit = unit_wrenches(layer.vertices, layer.vertex_area_vectors, layer.vertex_areas,
                             touch.pose_body_from_tool[:3, 3], nodes.corners, touch.pressed.stuck)  # fmt: skip
        out = np.einsum("n,nc,ncx->x", forces, nodes.shares, unit)
        if factor > DRAWN:
            deepest = float((nodes.strain * nodes.thickness)[nodes.strain.argmax()])
            out -= deepest * self._drawn(touch, tangent)[0] + (factor - 1) / factor * touch.wrench
        return out

    def _drawn(self, touch: Touch, tangent: Tangent) -> tuple[Wrench, np.ndarray]:
        """d wrench / d way that a tool is drawn back, (6,), and d that way / d twist, (6,).

        It is drawn back by r to where its largest strain s is held. With W = f(r) V, f = 1 + STIFFENING r / T and n
        inwards, dW = dW at a given r + (f' V - dW/dn) dr. The way of the deepest point of the tool's surface along n
        is dr, less s t of its column as t grows.
        """
        assert touch.pressed is not None
        nodes, normal = touch.pressed.squeeze.nodes, touch.push / touch.force
        stiffening = STIFFENING / float(self.simulator.layer.thickness.max()) / touch.pressed.factor
        deepest = int(nodes.strain.argmax())
        depth = nodes.strain[deepest] * nodes.thickness[deepest]
        arm = nodes.points[deepest] + depth * nodes.inward[deepest] - touch.pose_body_from_tool[:3, 3]
        rise = stiffening * touch.wrench - tangent.stiffness[:, :3] @ normal
        return rise, np.concatenate([normal, np.cross(arm, normal)])

    def _resized(self, contacts: list[Contact], touch: Touch
                 ) -> tuple[tuple[Simulator, list[Contact]], tuple[Simulator, list[Contact]], float]:  # fmt: skip
        """Simulators and contacts with the tool of a touch smaller and larger, and the difference of the factors."""
        assert touch.pressed is not None
        nodes, simulator = touch.pressed.squeeze.nodes, self.simulator
        rise = np.abs(np.einsum("nx,nx->n", nodes.points - touch.pose_body_from_tool[:3, 3], nodes.inward)).max()
        step, out = min(TOOL_STEP, SHALLOW * touch.depth / max(float(rise), 1e-9)), []
        for by in (1 - step, 1 + step):
            tool, other = _sized(simulator.tools[touch.name], by), copy(simulator)
            other.toucher, tools = copy(simulator.toucher), simulator.tools.copy()
            tools.add(tool, _sized_field(touch.pressed.field, by))
            other.toucher.tools, other.history = tools, simulator.history.moved(other.toucher)
            out.append((other, [replace(one, tool=tool) if one.name == touch.name else one for one in contacts]))
        return out[0], out[1], 2 * step

    def _by_size(self, contacts: list[Contact], touch: Touch) -> Wrench:
        """d wrench / d factor on the size of a touch's tool, (6,) [N, N m]."""
        (one, low), (other, high), step = self._resized(contacts, touch)
        k = [each.name for each in contacts].index(touch.name)
        return (other.touch(high)[k].wrench - one.touch(low)[k].wrench) / step

    def _by_way(self, contacts: list[Contact], touches: list[Touch], known: list[WrenchGradient], way: float
                ) -> list[WrenchGradient]:  # fmt: skip
        """The gradients with differences over a way [m] for what is by pose."""
        found = {one.name: np.zeros((len(touches), 6, 6)) for one in touches}
        for touch in filter(_presses, touches):
            for column, (low, high, step) in enumerate(_ways(contacts, touch, way)):
                before, after = self.simulator.touch(low), self.simulator.touch(high)
                found[touch.name][:, :, column] = [(b.wrench - a.wrench) / step
                                                   for a, b in zip(before, after, strict=True)]  # fmt: skip
        return [replace(one, pose=found[one.name][m], across={name: found[name][m] for name in one.across})
                for m, one in enumerate(known)]  # fmt: skip


def twisted(pose_body_from_tool: ArrayLike, twist: ArrayLike) -> Transform:
    """Pose of a tool after a twist, (4, 4): its origin moves, then it turns about its origin.

    Args:
        pose_body_from_tool: pose, (4, 4).
        twist: translation of the origin [m] and rotation vector [rad], in the layer's axes, (6,).

    Raises:
        InvalidInput: a pose or twist of other shape, or not finite.
    """
    from scipy.spatial.transform import Rotation

    pose, way = finite("pose", pose_body_from_tool, (4, 4)).copy(), finite("twist", twist, (6,))
    pose[:3, 3] += way[:3]
    pose[:3, :3] = Rotation.from_rotvec(way[3:]).as_matrix() @ pose[:3, :3]
    return pose


def _asked(contacts: Sequence[Contact], by: Collection[str]) -> list[Contact]:
    """The contacts by their poses alone, once it is known what is asked for."""
    check_kind("by", by, Collection)
    if strange := {str(one) for one in ([by] if isinstance(by, str) else by)} - set(EVERY):
        raise InvalidInput(f"there is no gradient by {', '.join(sorted(strange))}. Available: {', '.join(EVERY)}.")
    check_kind("contacts", contacts, Sequence)
    for one in contacts:
        check_kind("a contact", one, Contact)
    return [replace(one, wrench=None) for one in contacts]


def _presses(touch: Touch) -> bool:
    return touch.pressed is not None and touch.force > 0


def _field_step(touch: Touch) -> float:
    """Way of a tool over which the field is differenced [m]."""
    assert touch.pressed is not None
    return min(FIELD_STEP * float(touch.pressed.squeeze.nodes.thickness.mean()), SHALLOW * touch.depth)


def _lever(touch: Touch) -> float:
    """Distance of the contact's farthest node from the tool's origin [m]."""
    assert touch.pressed is not None
    away = touch.pressed.squeeze.nodes.points - touch.pose_body_from_tool[:3, 3]
    return float(np.linalg.norm(away, axis=1).max())


def _pace(touch: Touch, twist: np.ndarray) -> float:
    """Largest speed of a tool's surface where it presses, at a twist (6,) [m/s]."""
    return float(np.linalg.norm(twist[:3]) + _lever(touch) * np.linalg.norm(twist[3:]))


def _ways(contacts: list[Contact], touch: Touch, way: float) -> Iterator[tuple[list[Contact], list[Contact], float]]:
    """Contacts with the tool of a touch at either end of each of six twists, and the difference of the twists."""
    lever = _lever(touch)
    for column in range(6):
        twist = np.zeros(6)
        twist[column] = way if column < 3 else way / lever
        low, high = ([replace(one, pose_body_from_tool=twisted(one.pose_body_from_tool, by * twist))
                      if one.name == touch.name else one for one in contacts] for by in (-1, 1))  # fmt: skip
        yield low, high, 2 * float(twist[column])


def _below(nodes: Nodes, by: float) -> Nodes:
    """The nodes on a layer so many times as thick: depths stay."""
    return nodes._replace(thickness=by * nodes.thickness, strain=nodes.strain / by)


def _fresh(method: Method) -> Method:
    """Another method like this one, to be prepared for other skin."""
    out = copy(method)
    if getattr(out, "fallback", None) is not None:  # which is prepared in place
        out.fallback = deepcopy(out.fallback)  # type: ignore[attr-defined]
    return out


def _sized(tool: Tool, by: float) -> Tool:
    """The tool so many times as large; its surface is mended already."""
    out = copy(tool)
    out.__dict__.update(vertices=by * tool.vertices)
    for name in ("digest", "number"):
        out.__dict__.pop(name, None)
    return out


def _sized_field(field: SignedDistance, by: float) -> SignedDistance:
    """The distance field of a tool so many times as large: s d(x / s), exactly."""
    low, high = field.tool_bounds
    return replace(field, coefficients=by * field.coefficients, origin=by * field.origin, spacing=by * field.spacing,
                   surface_error=by * field.surface_error, tool_bounds=(by * low, by * high),
                   half_thickness=by * field.half_thickness, checks=by * field.checks,
                   openings=by * field.openings, tips=by * field.tips, corners=by * field.corners)  # fmt: skip
