"""History: what time, friction and the balance of energy make of elastic touches, step by step.

A step asks the contact law for elastic touches without friction, by poses as they are and by wrenches as large as an
elastic skin would have to carry now. Then, tool by tool, the force relaxes (`stmpl_core.relaxation`), friction follows
the tool's way (`stmpl_core.slip`), and a contact that would give more energy than was put in is weakened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from stmpl_core import wake
from stmpl_core.arrays import Transform
from stmpl_core.columns import shifted
from stmpl_core.contact import Contact
from stmpl_core.dragged import MIN_OFFSET
from stmpl_core.errors import InvalidInput
from stmpl_core.footing import carried_tangent, in_plane, in_space, patch_of, twist_between, way_along, way_of_tool
from stmpl_core.friction import Friction, coefficients
from stmpl_core.relaxation import series_of, weights
from stmpl_core.sideways import Sideways
from stmpl_core.slip import drag, ploughing
from stmpl_core.state import Memory, Scalars, State, fresh
from stmpl_core.touch import APART, MIN_ONE_WAY_SHARE, Pressed, Slip, Touch
from stmpl_core.toucher import Toucher

ROUGH = 0.12  # error of the relaxed force, over what has relaxed: 5.4 of 45 % in trials where only the shear relaxes
HELD_OFF = 0.01  # relative error of the elastic force by wrench, from which it is asked for again
GIVEN_BACK = 0.7  # share of what an elastic contact gives back that must be covered by what was put in
KEPT = 1.5  # work beyond what elastic skin could hold that is forgotten: what was lost before pays for nothing now
NOTHING = np.zeros(3)


class _Asked(NamedTuple):
    """What a step knows of a tool before the contact law is asked.

    Args:
        contact: what the law is asked.
        stated: what was stated.
        before: memory of the step before.
        known: whether that memory is of this tool's way until now.
        twist: its way, (6,) [m, rad].
        kept: what has relaxed, less what follows from this step's force (see relaxation.weights), (P,) [N].
        gain: what follows, over that force, (P,) [-].
    """

    contact: Contact
    stated: Contact
    before: Memory
    known: bool
    twist: np.ndarray
    kept: np.ndarray
    gain: np.ndarray


class _Law(NamedTuple):
    """What a tool does before the balance of energy.

    Args:
        touch: touch with the forces of relaxed skin and friction.
        memory: what is remembered, less work.
        stored: energy that the contact could give back [J].
        whole: energy that it could hold [J].
    """

    touch: Touch
    memory: Memory
    stored: float
    whole: float


class History:
    """Touches with a memory, on one layer.

    Args:
        toucher: contact law of elastic skin.
        friction: coefficient of friction, or name of a pair in stmpl_core.friction: of all tools, or by tool's name.

    Attributes:
        series: relaxation of the layer's force.

    Raises:
        InvalidInput: friction that is none.
    """

    def __init__(self, toucher: Toucher, friction: Friction | Mapping[str, Friction] = None) -> None:
        self.toucher, layer = toucher, toucher.layer
        self._friction = coefficients(friction)
        self.series = series_of(layer.tissue, float(np.median(layer.thickness)))

    @cached_property
    def sideways(self) -> Sideways:
        """Stiffness of the layer to what sticks to it."""
        return Sideways(self.toucher.layer)

    def moved(self, toucher: Toucher) -> History:
        """The same history where joints take the skin."""
        out = copy(self)
        out.toucher = toucher
        return out

    def friction(self, name: str) -> float:
        """Coefficient of friction of a tool [-]."""
        every, some = self._friction
        return some.get(name, every)

    def step(self, contacts: Sequence[Contact], state: State, dt: float) -> tuple[list[Touch], State]:
        """Touches of contacts with names of their own, dt [s] after a state; and the state then.

        Raises:
            InvalidInput: a state of skin that relaxes in another number of times.
        """
        for name, memory in state.tools.items():
            if len(memory.relaxed) != len(self.series.times):
                raise InvalidInput(f"the state of {name} is of skin with {len(memory.relaxed)} times of relaxation; "
                                   f"this layer has {len(self.series.times)}. Try an empty State().")  # fmt: skip
        asked = [self._asked(contact, state.tools.get(contact.name), dt) for contact in contacts]
        touches = self.toucher.touch_all([one.contact for one in asked], alone=False)
        again = [self._again(one, touch) for one, touch in zip(asked, touches, strict=True)]
        if any(again):
            asked = [new or one for one, new in zip(asked, again, strict=True)]
            touches = self.toucher.touch_all([one.contact for one in asked], alone=False)
        laws = [self._law(one, touch, dt) for one, touch in zip(asked, touches, strict=True)]
        out, memories = _balanced(asked, laws)
        for name, memory in state.tools.items():
            if name not in memories:
                left = self._left(memory, dt)
                if left.scalars.sunk or left.trail.any():
                    memories[name] = left
        return out, State(memories)

    def _relaxed(self, before: Memory, dt: float, gone: float) -> tuple[np.ndarray, np.ndarray]:
        kept, gain = np.empty(len(self.series.times)), np.empty(len(self.series.times))
        weights(self.series.times, dt, gone, before.scalars.elastic, before.relaxed, kept, gain)
        return kept, gain

    def _asked(self, contact: Contact, before: Memory | None, dt: float) -> _Asked:
        """What the contact law is asked for a contact."""
        pose = contact.pose_body_from_tool
        memory = before or fresh(pose, len(self.series.times))
        known = before is not None and memory.scalars.pressing >= 0
        twist, gone = np.zeros(6), 0.0
        if known:
            twist = twist_between(memory.pose, pose)
        if memory.scalars.radius > 0:
            held = memory.scalars.pressing > 0
            start = memory.pose if held else memory.imprint
            over = way_along(twist_between(start, pose), memory.contact, start)
            gone = (memory.scalars.share if held else 1.0) * over / memory.scalars.radius
        kept, gain = self._relaxed(memory, dt, gone)
        asked = contact
        if contact.wrench is not None and len(kept):
            force = contact.wrench[:3]
            normal = memory.contact[1] if memory.scalars.radius > 0 else force / max(np.linalg.norm(force), 1e-300)
            wanted = float(force @ normal) / memory.scalars.net
            owed, now = self.series.balance(kept, gain)
            if wanted > 0:
                asked = replace(contact, wrench=contact.wrench * ((wanted + owed) / (wanted * now)))
        return _Asked(asked, contact, memory, known, twist, kept, gain)

    def _whole(self, touch: Touch) -> float:
        """Sum of the sizes of the forces that a touch presses with [N]."""
        return 0.0 if touch.pressure is None else float(touch.pressure @ self.toucher.layer.vertex_areas)

    def _needed(self, one: _Asked, touch: Touch) -> tuple[float, float]:
        """Elastic force that a stated wrench takes, as a sum of sizes, and the one that the touch has [N]."""
        assert one.stated.wrench is not None
        whole = self._whole(touch)
        wanted = float(one.stated.wrench[:3] @ touch.push) / touch.force * whole / touch.force
        owed, now = self.series.balance(one.kept, one.gain)
        return (wanted + owed) / now, whole

    def _again(self, one: _Asked, touch: Touch) -> _Asked | None:
        """The same with a wrench that fits where the contact's normal turned out to be; None where it does."""
        if one.contact is one.stated or not (touch.presses and touch.force > 0) or one.contact.wrench is None:
            return None
        needed, has = self._needed(one, touch)
        carried = float(one.contact.wrench[:3] @ touch.push) / touch.force
        if touch.force < (1 - 1e-6) * carried or not needed > 0 or abs(needed / has - 1) < HELD_OFF:
            return None
        return one._replace(contact=replace(one.contact, wrench=one.contact.wrench * (needed / has)))

    def _law(self, one: _Asked, touch: Touch, dt: float) -> _Law:
        """What a tool does, from what elastic skin does."""
        shares, before = self.series.shares, one.before.scalars
        owed, now = self.series.balance(one.kept, one.gain)
        presses = touch.presses and touch.pressed is not None and touch.force > 0
        elastic = self._whole(touch) if presses else 0.0
        force = now * elastic - owed
        if presses and one.contact is not one.stated:
            needed, _ = self._needed(one, touch)
            if abs(needed / elastic - 1) < 2 * HELD_OFF:
                elastic, force = needed, now * needed - owed
        if not (presses and force > 0):
            return self._free(one, touch, max(owed / now, 0.0), dt)
        push, pressed, size = touch.push, touch.pressed, touch.force
        assert pressed is not None and pressed.forces is not None
        normal, net = push / size, min(size / elastic, 1.0)
        nodes = pressed.squeeze.nodes
        depth = nodes.sinking if len(nodes.sinking) else nodes.strain * nodes.thickness
        middle, radius, lever, thickness, whole = patch_of(
            nodes.points, nodes.area, nodes.thickness, depth, pressed.forces, normal)  # fmt: skip
        contact = np.stack([middle, normal, carried_tangent(one.before.contact, normal, before.pressing > 0)])
        scalars = Scalars(1.0, elastic, max(elastic, before.largest), net, radius, touch.depth, elastic, pressed.power,
                          work=before.work)  # fmt: skip
        relaxed = one.kept + one.gain * elastic
        memory = Memory(one.stated.pose_body_from_tool, touch.wrench, scalars, relaxed, contact,
                        touch.pose_body_from_tool, np.zeros(3), one.before.springs, one.before.springs_relaxed,
                        one.before.trail)  # fmt: skip
        if len(memory.trail):
            passing = wake.Pass(memory.imprint, middle, normal, relaxed, elastic, touch.depth, pressed.power, radius)
            memory = memory._replace(trail=wake.after(memory.trail, self.series, dt, passing))
            touch = replace(touch, wake=wake.grooves(memory.trail, self.series))
        done = _scaled(touch, force / elastic, ROUGH * float(shares @ relaxed))
        whole *= 0.5 + 0.5 / pressed.factor  # what draws a tool back from the core is steep: it stores less
        stored = whole * _left_over(float(shares @ relaxed) / elastic, pressed.power)
        if self.friction(touch.name) > 0 and net > MIN_ONE_WAY_SHARE:
            done, memory, bent = self._dragged(one, done, memory, force, lever, thickness, dt)
            stored, whole = stored + bent, whole + 2 * bent
        return _Law(self._said(one, done), memory._replace(wrench=done.wrench), stored, whole)

    def _free(self, one: _Asked, touch: Touch, elastic: float, dt: float) -> _Law:
        """Skin that the tool does not hold comes back by itself."""
        before = one.before.scalars
        if touch.presses and touch.pressed is not None:
            touch = replace(touch, status=APART, wrench=np.zeros(6), force_bound=0.0, pressure=None, pressed=None)
        scalars = before._replace(pressing=0.0, elastic=elastic, share=1.0, passive=1.0)
        trail = wake.after(one.before.trail, self.series, dt, None)
        memory = _let_go(one.before._replace(pose=one.stated.pose_body_from_tool, wrench=touch.wrench, scalars=scalars,
                                             relaxed=one.kept + one.gain * elastic, trail=trail))  # fmt: skip
        touch = replace(touch, wake=wake.grooves(trail, self.series))
        if scalars.sunk:
            touch = replace(touch, imprint=_imprint(memory))
        depth = before.depth * (elastic / before.imprint_force) ** (1 / before.power) if elastic > 0 else 0.0
        return _Law(self._said(one, touch), memory, 0.0, elastic * depth / (before.power + 1))

    def _left(self, memory: Memory, dt: float) -> Memory:
        """The memory of a tool that is not told of any more: the skin comes back."""
        kept, gain = self._relaxed(memory, dt, 0.0)
        owed, now = self.series.balance(kept, gain)
        elastic = max(owed / now, 0.0)
        scalars = memory.scalars._replace(pressing=-1.0, elastic=elastic, share=1.0, work=0.0, passive=1.0)
        return _let_go(memory._replace(scalars=scalars, relaxed=kept + gain * elastic, wrench=np.zeros(6),
                                       trail=wake.after(memory.trail, self.series, dt, None)))  # fmt: skip

    def _dragged(self, one: _Asked, touch: Touch, memory: Memory, force: float, lever: float, thickness: float,
                 dt: float) -> tuple[Touch, Memory, float]:  # fmt: skip
        """The touch with friction, its memory, and the energy that the bent skin stores [J]."""
        before, now, radius = one.before, memory.scalars, memory.scalars.radius
        patch, origin = self.sideways.at(radius, thickness), touch.pose_body_from_tool[:3, 3]
        mu = self.friction(touch.name)
        stiffer, cap = ploughing(now.depth, radius, force, patch.along, mu)
        along = patch.secant(mu * force)
        stiffness = stiffer * np.array([along, along, patch.turn / (lever * lever)])
        stated, wanted = one.stated.wrench, NOTHING
        if stated is not None:
            wanted = in_plane(stated - touch.wrench, memory.contact, origin, lever)
        way, rolled = way_of_tool(one.twist, one.known, before.contact, before.scalars.pressing > 0, memory.contact,
                                  origin, now.depth, radius, lever)  # fmt: skip
        springs, relaxed, carried, share, stored = drag(
            before.springs, before.springs_relaxed, *self.series, dt, rolled, stiffness, before.stiffness, cap, way,
            wanted, stated is not None)  # fmt: skip
        wrench, offset, turn = in_space(carried, springs, stiffness, memory.contact, origin, lever)
        slip = Slip(wrench, share, offset, turn, memory.contact[0])
        memory = memory._replace(scalars=now._replace(share=share, limit=cap), stiffness=stiffness, springs=springs,
                                 springs_relaxed=relaxed)  # fmt: skip
        return replace(touch, wrench=touch.wrench + wrench, slip=slip), memory, stored

    def _said(self, one: _Asked, touch: Touch) -> Touch:
        """The touch with what of the stated wrench is missing, and what that says of it."""
        stated = one.stated.wrench
        if stated is None:
            return touch
        touch = replace(touch, missing=stated - touch.wrench)
        return replace(touch, trust=self.toucher.unmet(touch.trust, touch, stated))

    def elastic(self, touches: Sequence[Touch]) -> list[Touch]:
        """The touches of elastic skin without friction that move the skin as these do, but for what is dragged along.

        Skin that a tool does not hold is where an imprint says; skin that is dragged along was pressed by a tool that
        stands where the skin came from.
        """
        out, asked = [], []
        for touch in touches:
            pose = touch.imprint
            if pose is None and touch.slip is not None and np.linalg.norm(touch.slip.offset) > MIN_OFFSET:
                pose = shifted(touch.pose_body_from_tool, -touch.slip.offset)
            if pose is None or touch.name not in self.toucher.tools:
                out.append(touch)
            else:
                asked.append(Contact(self.toucher.tools[touch.name], pose))
        return [*out, *self.toucher.touch_all(asked)]


def _scaled(touch: Touch, by: float, doubt: float) -> Touch:
    """The touch with other pressures on skin that is moved as before; doubt: error of the force that comes in [N]."""
    if by == 1.0 and not doubt:
        return touch
    assert touch.pressure is not None and touch.pressed is not None
    forces = touch.pressed.forces
    pressed: Pressed = touch.pressed._replace(factor=touch.pressed.factor * by,
                                              forces=None if forces is None else forces * by)  # fmt: skip
    return replace(touch, wrench=touch.wrench * by, pressure=touch.pressure * by, pressed=pressed,
                   force_bound=touch.force_bound * by + doubt)  # fmt: skip


def _left_over(relaxed: float, power: float) -> float:
    """What skin gives back when it is let go at once, over the energy of elastic skin, of which a share has relaxed.

    The integral of depth^power - relaxed from where that is 0 to 1, times power + 1.
    """
    free = min(relaxed, 1.0) ** (1 / power)
    return max(1 - free ** (power + 1) - (power + 1) * relaxed * (1 - free), 1e-12)


def _let_go(memory: Memory) -> Memory:
    """The memory without springs of friction."""
    return memory._replace(stiffness=np.zeros(3), springs=np.zeros_like(memory.springs),
                           springs_relaxed=np.zeros_like(memory.springs_relaxed))  # fmt: skip


def _imprint(memory: Memory) -> Transform:
    """Pose at which the tool that pressed last would hold the skin where it has come back to."""
    one = memory.scalars
    depth = one.depth * (one.elastic / one.imprint_force) ** (1 / one.power)
    return shifted(memory.imprint, (depth - one.depth) * memory.contact[1])


def _balanced(asked: Sequence[_Asked], laws: Sequence[_Law]) -> tuple[list[Touch], dict[str, Memory]]:
    """The touches, weakened where a contact would give more than was put in, and the memories with their balance.

    Memories share no array with touches, which whoever is handed them may write to.

    Work put in is the trapezoid of the wrench over the tool's way. Tools that feel each other pass energy on, so one is
    weakened only where all together lack it.
    """
    works = []
    for one, law in zip(asked, laws, strict=True):
        new = not one.known or one.stated.wrench is not None
        work = one.before.scalars.work + 0.5 * float((one.before.wrench + law.memory.wrench) @ one.twist)
        work = max(work, law.stored) if new else work
        works.append(work)
    all_stored = sum(law.stored for law in laws)
    together = sum(works) / (GIVEN_BACK * all_stored) if all_stored > 0 else 1.0
    touches, memories = [], {}
    for one, law, work in zip(asked, laws, works, strict=True):
        touch, memory, passive = law.touch, law.memory, 1.0
        if law.stored > 0:
            passive = min(1.0, max(work / (GIVEN_BACK * law.stored), together if len(laws) > 1 else 0.0, 0.0))
            if passive < 1:
                at_rest = one.before.scalars.work + 0.5 * float(one.before.wrench @ one.twist)
                given = 0.5 * float(memory.wrench @ one.twist)
                if len(laws) == 1 and at_rest + passive * given < 0 and given < 0:
                    passive = max(-at_rest / given, 0.0)
                work = at_rest + passive * given
                touch = _weakened(touch, passive)
                memory = memory._replace(wrench=touch.wrench)
        work = min(work if law.stored > 0 else max(work, 0.0), KEPT * law.whole)
        memories[touch.name] = memory._replace(
            scalars=memory.scalars._replace(work=work, passive=passive), pose=memory.pose.copy(),
            wrench=memory.wrench.copy(), contact=memory.contact.copy(), imprint=memory.imprint.copy())  # fmt: skip
        touches.append(touch)
    return touches, memories


def _weakened(touch: Touch, by: float) -> Touch:
    if touch.slip is not None:
        touch = replace(touch, slip=touch.slip._replace(wrench=touch.slip.wrench * by))
    return replace(_scaled(touch, by, 0.0), passive=by)
