"""Simulator: contacts in; the reaction, then the deformed skin out. Node, robot simulator, replay and test call it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import overload

import numba
import numpy as np

from stmpl_core.arrays import PerVertex, check_dt, check_kind
from stmpl_core.bounds import beside_walls, motion_bound
from stmpl_core.carrying import carried
from stmpl_core.conform import Conformed, conform, kept_out, laid_on, no_further
from stmpl_core.contact import Contact
from stmpl_core.dragged import dragged_motion
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction
from stmpl_core.green import Green
from stmpl_core.history import History
from stmpl_core.layer import SoftLayer
from stmpl_core.load import Load
from stmpl_core.methods.base import Method
from stmpl_core.skin import Skin
from stmpl_core.state import State
from stmpl_core.stick import stuck_motion
from stmpl_core.tools import Tools
from stmpl_core.touch import Answer, Pressed, Touch
from stmpl_core.toucher import Toucher
from stmpl_core.trust import Displacement, Trust
from stmpl_core.twins import going_together
from stmpl_core.wake import sunk

LEAST_HELD = 0.02, 0.08  # motion held back, over the peak, from which it is flagged: without, with a bound beside it
MOST_MOVED = 0.95  # motion over the thickness from which it is held back
ELSEWHERE = 1e-3  # distance of a touch's skin from where it is now, over the thickness, from which it is another's
FEW_NODES, MANY_NODES = 160, 240  # nodes up to which skin goes with its tools node by node, and from which by vertices
MAX_ENTERED_SHARE = 0.02  # depth of skin inside a tool over the thickness, which is not yet said


class Simulator:
    """One skin, one method, any number of tools. The same contacts give the same answer, bit for bit on one machine.

    Args:
        layer: soft layer at rest, or a Skin, which is prepared already.
        method: method that solves for the motion, prepared here; None: that of the Skin.
        tools: tools with their distance fields; None: an empty store, to which contacts add theirs.
        friction: coefficient of friction, or the name of a pair in stmpl_core.friction, of all tools or by tool's name;
            it is felt where touches have a state. None: none.

    Attributes:
        toucher: contact law on this layer.
        history: what time, friction and the balance of energy make of it.
        remembers: flag of a skin that is not elastic: friction is told, or its tissue relaxes.

    Raises:
        InvalidInput: a layer without a method, or friction that is none.
    """

    def __init__(self, layer: SoftLayer | Skin, method: Method | None = None, tools: Tools | None = None, *,
                 friction: Friction | Mapping[str, Friction] = None) -> None:  # fmt: skip
        check_kind("tools", tools, (Tools, type(None)))
        if isinstance(layer, Skin):
            skin = layer
        elif method is None:
            raise InvalidInput("a simulator needs a method. Try Simulator(layer, MomentNet()).")
        else:
            skin = Skin.of(layer, method)
        self._stand_on(skin.rest or skin)
        self.toucher = Toucher(self.layer, self.skin.near, tools)
        self.history = History(self.toucher, friction)
        self.remembers = friction is not None or self.layer.tissue.relaxes
        if friction is not None:  # what a slide needs is made now, not when the first one begins
            _ = self.history.sideways, Green.of(self.layer).drag
        if self._green is None and getattr(self.method, "sticks", False):  # likewise what the first touch needs
            _ = Green.of(self.layer)
        if skin.rest is not None:
            self.move_to(skin)

    def _stand_on(self, skin: Skin) -> None:
        self.skin, self.layer, self.method, self._green = skin, skin.layer, skin.method, skin.green

    @overload
    def pose(self, joints: Mapping[str, float]) -> None: ...

    @overload
    def pose(self, joints: Mapping[str, float], state: State) -> State: ...

    def pose(self, joints: Mapping[str, float], state: State | None = None) -> State | None:
        """Takes the skin to where its joints are now, in milliseconds; what comes next is answered there.

        Args:
            joints: angle by the joint's name [rad]; those that are not given are at rest.
            state: memory of the tissue; what is returned has gone along with the skin.

        Raises:
            InvalidInput: a skin without joints, an unknown one, an angle that is not finite or beyond its limits, or a
                state of other joints.
        """
        return self.move_to(self.skin.posed(joints), state)

    @overload
    def move_to(self, skin: Skin) -> None: ...

    @overload
    def move_to(self, skin: Skin, state: State) -> State: ...

    @overload
    def move_to(self, skin: Skin, state: State | None) -> State | None: ...

    def move_to(self, skin: Skin, state: State | None = None) -> State | None:
        """As `pose`, to this skin as it is posed elsewhere; another simulator of it may be there already.

        Raises:
            InvalidInput: another skin, or a state of other joints.
        """
        before = self.skin
        if (skin.rest or skin) is not (before.rest or before):
            raise InvalidInput("this is another skin, not this one where its joints took it. Try Simulator(skin).")
        after = None if state is None else carried(state, before, skin)
        if skin is before:
            return after
        self._stand_on(skin)
        tools = self.tools
        self.toucher = self.toucher.moved(skin)
        self.toucher.tools = tools
        self.history = self.history.moved(self.toucher)
        return after

    @property
    def tools(self) -> Tools:
        """Tools that may touch this skin."""
        return self.toucher.tools

    @overload
    def touch(self, contacts: Sequence[Contact]) -> list[Touch]: ...

    @overload
    def touch(self, contacts: Sequence[Contact], state: State, dt: float) -> tuple[list[Touch], State]: ...

    def touch(
        self, contacts: Sequence[Contact], state: State | None = None, dt: float = 0.0
    ) -> list[Touch] | tuple[list[Touch], State]:
        """Finds the reaction: touch of each contact, fast; `answer` finds the displacement.

        Args:
            contacts: tools at one instant, each once. A tool of the state that is not among them was taken away, in a
                step with time; without time nothing happens to it.
            state: memory of the steps before, empty at the beginning, which goes along with the skin if its joints were
                elsewhere; None: elastic skin without friction, as if nothing had been before, and no state is returned.
            dt: time since that state [s].

        Raises:
            InvalidInput: two contacts of one name, a dt below 0 or not finite, or a state of other skin or joints.
            MeshError: a tool's surface that cannot be used.
        """
        try:
            contacts = list(contacts)
            names = [contact.name for contact in contacts]
        except (AttributeError, TypeError):
            raise InvalidInput(f"contacts are {contacts!r:.60}; a list of Contacts is needed.") from None
        if len(set(names)) < len(names):
            raise InvalidInput(f"contacts must have names of their own; got {', '.join(names)}.")
        check_dt(dt)
        if state is None:
            return self.toucher.touch_all(contacts)
        return self.history.step(contacts, carried(state, self.skin, self.skin), dt)

    def answer(self, touches: Sequence[Touch], state: State | None = None) -> Answer:
        """Finds the displacement of the skin under touches of this simulator, made where its joints are now.

        Args:
            touches: touches of one instant.
            state: memory that came with them, where another simulator of this skin found them: by it skin is told of
                that a tool left sunk which is not among them. None: that of the last `touch`, if it found these.

        Raises:
            InvalidInput: touches of another skin, or made where its joints were elsewhere.
        """
        # Sum: pressures of several tools add.
        try:
            touches = list(touches)
            pressing = [touch.pressure for touch in touches if touch.pressure is not None]
        except (AttributeError, TypeError):
            raise InvalidInput(f"touches are {touches!r:.60}; a list of Touches is needed.") from None
        if len({touch.name for touch in touches}) < len(touches):
            raise InvalidInput("touches must be of tools of their own; got "
                               f"{', '.join(touch.name for touch in touches)}.")  # fmt: skip
        for touch in touches:
            self._check(touch)
        check_kind("state", state, (State, type(None)))
        left_out = self.history.left_out(touches, state)
        pressure = sum(pressing[1:], pressing[0]) if pressing else np.zeros(len(self.layer.vertices))
        moves = self.history.elastic(touches)

        # Solve: the method moves the skin, and what is touched lies on its tool; where nothing presses, nothing moves.
        solved, fitted, by_vertices = self._moved(moves)
        fitted = self._dragged(fitted, touches)
        for touch, share in self.history.left_behind(touches):
            behind, there, _ = self._moved([touch])
            solved = replace(solved, trust=_lower(solved.trust, behind.trust))
            fitted = _deeper(fitted, share, there, -self.layer.normals)
            moves.append(touch.with_(depth=share * touch.depth))

        fitted, left = self._sunk(fitted, touches)

        # Say what may be believed: what the method says, and what was found of each contact.
        trust = _joined(solved.trust, touches, fitted)
        for touch in touches:
            if touch.name not in self.tools and (touch.imprint is not None or (touch.wake and touch.wake.grooves())):
                trust = trust.also(f"{touch.name} was taken away: the skin that it left sunk is shown at rest",
                                   in_range=False)  # fmt: skip
        if left_out:
            trust = trust.also(f"{', '.join(left_out)} was left out of the contacts: skin that it pressed is not back "
                               "yet, and is shown at rest. Keep a tool among them until it is", in_range=False)
        if fitted.entered > MAX_ENTERED_SHARE * float(self.skin.near.thickness.min()):
            trust = trust.also(f"skin is {fitted.entered * 1e3:.2f} mm inside a tool", in_range=False)
        displacement, peak, held = _within(fitted.displacement, self.layer.thickness)
        known = getattr(self.method, "contact_bound" if by_vertices else "stick_bound", None)
        if not held <= LEAST_HELD[known is not None] * peak:
            trust = trust.also(f"skin would move {held * 1e3:.3g} mm further than there is any: held back",
                               in_range=False)  # fmt: skip
        if trust.in_range:
            bound = motion_bound(known, touches, moves, peak, left)
            if bound is not None:
                bound = max(bound, beside_walls(self.layer, moves, displacement)) + held
            trust = replace(trust, error_bound=bound)
        return Answer(displacement, trust, solved.method, pressure, {touch.name: touch for touch in touches})

    def _check(self, touch: Touch) -> None:
        """Refuses a touch of another skin; see `answer`."""
        many = len(self.layer.vertices)
        if touch.pressure is not None and len(touch.pressure) != many:
            raise InvalidInput(f"the touch of {touch.name} is of skin with {len(touch.pressure)} vertices; this one "
                               f"has {many}.")  # fmt: skip
        if touch.pressed is None or not len((nodes := touch.pressed.squeeze.nodes).area):
            return
        here = nodes.shares[0] @ self.layer.vertices[nodes.corners[0]]
        if math.dist(here.tolist(), nodes.points[0].tolist()) > ELSEWHERE * float(nodes.thickness[0]):
            raise InvalidInput(f"the touch of {touch.name} is of skin that is elsewhere now: its joints have moved, or "
                               "it is another skin. Try Simulator.touch there.")  # fmt: skip

    def _moved(self, touches: Sequence[Touch]) -> tuple[Displacement, Conformed, bool]:
        """What the method says of elastic touches, the same with what is touched on its tools, whether by vertices.

        Skin that sticks goes with its tools node by node where the method knows that (`sticks`), and on stacks. This
        costs the square of the nodes: under many, vertices are fine enough, and one way fades into the other.
        """
        touches = sorted(going_together(touches), key=lambda one: one.name)  # to the last bit in any order
        pressed = [(touch.pressure, touch.pressed) for touch in touches
                   if touch.pressure is not None and touch.pressed is not None]  # fmt: skip
        if not pressed:
            solved = Displacement(np.zeros_like(self.layer.vertices), Trust(), self.method.name)
            return solved, Conformed(solved.displacement, 0.0, 0.0), False
        share = 1.0 if self._green is not None else 0.0
        if not share and getattr(self.method, "sticks", False):
            nodes = sum(len(one.squeeze.nodes.area) for _, one in pressed)
            share = min(max((MANY_NODES - nodes) / (MANY_NODES - FEW_NODES), 0.0), 1.0)
        if not share:
            return *self._by_vertices(touches, _summed(pressed)), True
        if self._green is None:
            moving = _summed(pressed)
            motion = stuck_motion(Green.of(self.layer), touches, np.flatnonzero(moving))
        else:  # under thick tissue nodes lie far apart, and a mesh may be finer
            motion = stuck_motion(self._green, touches)
            near, layer = self.skin.near, self.layer
            moving = _summed([(near.spread_on(layer, values, one.squeeze.nodes), one) for values, one in pressed])
        solved = self.method.solve(Load.contact(moving, motion))
        if self._green is None:
            fitted = laid_on(self.layer, solved.displacement, touches)
        else:
            fitted = kept_out(self.layer, no_further(self.layer, motion, solved.displacement, touches), touches)
        if share == 1:
            return solved, fitted, False
        other, rest = self._by_vertices(touches, moving)
        both = share * fitted.displacement + (1 - share) * rest.displacement
        fitted = Conformed(both, max(fitted.corrected, rest.corrected), max(fitted.entered, rest.entered))
        return replace(solved, trust=_lower(solved.trust, other.trust)), fitted, True

    def _by_vertices(self, touches: Sequence[Touch], pressure: np.ndarray) -> tuple[Displacement, Conformed]:
        """What the method says of the pressure alone, and the same with the touched vertices on their tools."""
        solved = self.method.solve(Load.contact(pressure))
        return solved, conform(self.layer, self.skin.near, solved.displacement, touches)

    def _dragged(self, fitted: Conformed, touches: Sequence[Touch]) -> Conformed:
        """The answer with the skin that is dragged along, and out of the tools."""
        slides = [touch for touch in touches if touch.slip is not None]
        more = [one for one in (dragged_motion(Green.of(self.layer), touch) for touch in slides) if one is not None]
        if not more:
            return fitted
        out = kept_out(self.layer, fitted.displacement + sum(more[1:], more[0]), touches)
        return out._replace(corrected=max(fitted.corrected, out.corrected))

    def _sunk(self, fitted: Conformed, touches: Sequence[Touch]) -> tuple[Conformed, float]:
        """The answer with grooves that are left, and the largest motion that these add [m]."""
        before = after = fitted.displacement
        for touch in touches:
            left = () if touch.wake is None else touch.wake.grooves()
            if left and touch.name in self.tools:
                after = sunk(self.layer, self.tools.field(self.tools[touch.name]), left, after)
        most = 0.0 if after is before else float(np.linalg.norm(after - before, axis=1).max())
        return fitted._replace(displacement=after), most

    def step(self, contacts: Sequence[Contact]) -> Answer:
        """`touch`, then `answer`. Raises what `touch` raises."""
        return self.answer(self.touch(contacts))


def _summed(pressed: Sequence[tuple[PerVertex, Pressed]]) -> PerVertex:
    """Pressure of all tools that moves skin, (V,) [Pa]."""
    first, *others = (values if one.factor == 1 else values / one.factor for values, one in pressed)
    return sum(others, first)


def _lower(trust: Trust, other: Trust) -> Trust:
    """The trust in two answers at once, with the figures of the first."""
    if other.why or not other.ok:
        return trust.also(other.why, in_range=other.in_range, converged=other.converged)
    return trust


def _deeper(fitted: Conformed, share: float, there: Conformed, inward: np.ndarray) -> Conformed:
    """The answer with a share of another motion, where that goes further in."""
    one, other = fitted.displacement, share * there.displacement
    further = np.einsum("ni,ni->n", other - one, inward) > 0
    if one.any():
        other = np.where(further[:, None], other, one)
    return Conformed(other, max(fitted.corrected, there.corrected), max(fitted.entered, share * there.entered))


def _within(displacement: np.ndarray, thickness: np.ndarray) -> tuple[np.ndarray, float, float]:
    """The displacement, no longer than the layer is thick anywhere, its peak, and the most that one is held back [m].

    A motion's far end may reach skin a tenth of a millimetre thick, as in the folds of an armpit: that changes nothing.
    """
    peak, many = _peak(displacement, thickness)
    if not many:
        return displacement, peak, 0.0
    length = np.linalg.norm(displacement, axis=1)
    long = np.flatnonzero(length > MOST_MOVED * thickness)
    over = (length[long] / thickness[long] - MOST_MOVED) / (1 - MOST_MOVED)
    held = thickness[long] * (MOST_MOVED + (1 - MOST_MOVED) * np.tanh(over))  # smooth, and never further
    out = displacement.copy()
    out[long] *= (held / length[long])[:, None]
    most = float((length[long] - held).max(initial=0.0))
    length[long] = held
    return out, float(length.max()), most


@numba.njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
def _peak(displacement, thickness):
    """Largest motion [m], and how many go too far."""
    peak, many = 0.0, 0
    for v in range(len(displacement)):
        square = displacement[v, 0] ** 2 + displacement[v, 1] ** 2 + displacement[v, 2] ** 2
        peak = max(peak, square)
        many += square > (MOST_MOVED * thickness[v]) ** 2
    return np.sqrt(peak), many


def _joined(trust: Trust, touches: Sequence[Touch], fitted: Conformed) -> Trust:
    """The method's trust, lowered by that of the contacts.

    The method's error bound is for the pressure that it was given, so it becomes a figure.
    """
    figures = dict(trust.figures)
    if touches:
        figures |= {"conformed_m": fitted.corrected, "entered_m": fitted.entered}
    if touches and trust.error_bound is not None:
        figures["bound_given_pressure_m"] = trust.error_bound
    for touch in touches:
        if touch.trust.why:
            trust = trust.also(touch.trust.why, in_range=touch.trust.in_range, converged=touch.trust.converged)
    return Trust(trust.converged, trust.in_range, None if touches else trust.error_bound, trust.why, figures)
