"""History: what time, friction and the balance of energy make of elastic touches, step by step.

A step asks the contact law for elastic touches without friction, by poses as they are and by wrenches as large as an
elastic skin would have to carry now. Then, tool by tool, the force relaxes (`stmpl_core.relaxation`), friction follows
the tool's way (`stmpl_core.slip`), and a contact that would give more energy than was put in is weakened.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np

from stmpl_core import wake
from stmpl_core.arrays import Transform, inverted
from stmpl_core.balance import Asked, Law, balanced, scaled
from stmpl_core.columns import shifted
from stmpl_core.contact import Contact
from stmpl_core.dragged import MIN_OFFSET
from stmpl_core.errors import InvalidInput
from stmpl_core.footing import HELD_OFF, aged, bearing, needed, part_of_way
from stmpl_core.friction import Friction, coefficients
from stmpl_core.relaxation import depth_left, faded, fading, let_go, series_of, stretch
from stmpl_core.sideways import Sideways
from stmpl_core.slip import MOST_GROWN, rub
from stmpl_core.state import Memory, Scalars, State, fresh
from stmpl_core.touch import APART, MIN_ONE_WAY_SHARE, Imprint, Pressed, Slip, Touch
from stmpl_core.toucher import Toucher
from stmpl_core.trust import Trust

RUBBED = 0.1  # of the force: what skin that gives way beneath a dry tool is off, as the law was learnt from what sticks
PILED = 0.5  # of drag^2 / force: error of skin that piles up; 0.7 of it on a back, where the elastic bound was 0.45
LOST = 0.5  # of what skin carries along itself: what is gone once all of it slides; 0.4 to 0.6 by slides on a forearm
ROUND = 0.5  # of a drag and the thickness over the radius it goes around: its error on one material; 0.4 by one tube
MOST_DRAGGED = 0.9  # way by which sticking skin is dragged along, over the thickness, up to which it was tried
ELSEWHERE = 3.0  # thicknesses around a skin within which a contact on it lies, whatever presses
STRAYED = 0.03  # of the elastic force: part of the memory from touches out of range, beyond which an answer is, too
NONE, NO_ROOM = np.zeros(6), np.zeros(3)


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
        thickness = float(np.median(layer.thickness))
        self.series = series_of(layer.tissue, thickness)
        self._fades = fading(layer.tissue, thickness)

    @cached_property
    def sideways(self) -> Sideways:
        """Stiffness of the layer to what sticks to it."""
        return Sideways(self.toucher.layer)

    def moved(self, toucher: Toucher) -> History:
        """The same history where joints take the skin."""
        out = copy(self)
        out.toucher = toucher
        out.__dict__.pop("_box", None)
        return out

    @cached_property
    def _box(self) -> list[float]:
        """The lowest and the highest corner of a box that holds every contact on this skin, (6,) [m]."""
        layer = self.toucher.layer
        around = ELSEWHERE * float(layer.thickness.max())
        return [*(layer.vertices.min(axis=0) - around).tolist(), *(layer.vertices.max(axis=0) + around).tolist()]

    def friction(self, name: str) -> float:
        """Coefficient of friction of a tool [-]."""
        every, some = self._friction
        return some.get(name, every)

    def step(self, contacts: Sequence[Contact], state: State, dt: float) -> tuple[list[Touch], State]:
        """Touches of contacts with names of their own, dt [s] after a state; and the state then.

        Raises:
            InvalidInput: a state of skin that relaxes in another number of times, or whose joints were elsewhere.
        """
        here = self.toucher.joints
        if state.tools and state.joints != here:
            raise InvalidInput(f"the skin's joints are at {here} rad, the state was told at {state.joints}. Try "
                               "Simulator.touch, which takes it along.")  # fmt: skip
        for name, memory in state.tools.items():
            if len(memory.relaxed) != len(self.series.times):
                raise InvalidInput(f"the state of {name} is of skin with {len(memory.relaxed)} times of relaxation; "
                                   f"this layer has {len(self.series.times)}. Try an empty State().")  # fmt: skip
            if memory.scalars.radius > 0:
                (x, y, z), (a, b, c, d, e, f) = memory.contact[0].tolist(), self._box
                if not (a <= x <= d and b <= y <= e and c <= z <= f):
                    raise InvalidInput(f"the state of {name} is of a contact at {x:.3f}, {y:.3f}, {z:.3f} m, where "
                                       "this skin is not. Is it of another skin? Try an empty State().")  # fmt: skip
        asked = [self._asked(contact, state.tools.get(contact.name), dt) for contact in contacts]
        tried = {one.stated.name: one.moved for one in asked if one.moved is not None}
        touches = self.toucher.touch_all([one.contact for one in asked], alone=False, tried=tried)
        again = [self._again(one, touch) for one, touch in zip(asked, touches, strict=True)]
        if any(again):
            asked = [new or one for one, new in zip(asked, again, strict=True)]
            tried |= {touch.name: touch.moved for touch in touches if touch.name in tried}
            touches = self.toucher.touch_all([one.contact for one in asked], alone=False, tried=tried)
        asked = [self._late(one, touch, dt) for one, touch in zip(asked, touches, strict=True)]
        laws = [self._law(one, touch, dt) for one, touch in zip(asked, touches, strict=True)]
        out, memories = balanced(asked, laws, self.series.shares)
        out = [self._doubted(one, touch, memories, dt) for one, touch in zip(asked, out, strict=True)]
        for name, memory in state.tools.items():
            if name not in memories:
                left = self._left(memory, dt)
                if left.scalars.sunk or left.trail.any():
                    memories[name] = left
        return [self._after_others(touch, memories) for touch in out], State(memories, here)

    def _after_others(self, touch: Touch, memories: Mapping[str, Memory]) -> Touch:
        """The touch with a bound that counts what others have made relax where it presses, which it does not feel."""
        own = memories.get(touch.name)
        if not touch.presses or own is None or not len(own.relaxed) or len(memories) < 2:
            return touch
        owed, reach = 0.0, own.scalars.radius
        for name, other in memories.items():
            if name != touch.name and not other.scalars.pressing > 0 and other.scalars.sunk:
                away = other.contact[0] - own.contact[0]
                apart = math.sqrt(away @ away) / (reach + other.scalars.radius)
                owed += max(1 - apart, 0.0) * float(self.series.shares @ other.relaxed)
        bound = touch.force_bound + owed * own.scalars.stretch * own.scalars.net
        return touch.with_(force_bound=bound) if owed > 0 else touch

    def _doubted(self, one: Asked, touch: Touch, memories: dict[str, Memory], dt: float) -> Touch:
        """The touch, out of range where its skin's memory rests on one that was; the memory learns how far it does."""
        memory = memories.get(touch.name)
        if memory is None or not len(memory.relaxed):
            return touch
        scalars, relaxed = memory.scalars, max(float(self.series.shares @ memory.relaxed), 0.0)
        strayed, doubted = self._strayed(one.before, memory, dt, one.gone), not touch.trust.in_range
        if doubted or one.before.scalars.doubted:  # what this step may have added rests on one of its ends
            most = max(scalars.elastic, one.before.scalars.elastic)
            strayed = min(strayed + most * float(self.series.shares @ -np.expm1(-dt / self.series.times)), relaxed)
        if (strayed, doubted) != (scalars.strayed, scalars.doubted):
            memories[touch.name] = memory._replace(scalars=scalars._replace(strayed=strayed, doubted=float(doubted)))
        if touch.trust.in_range and (scalars.pressing > 0 or scalars.sunk) and strayed > STRAYED * scalars.elastic > 0:
            return touch.with_(trust=touch.trust.also(
                f"{touch.name} meets skin that still relaxes from a touch out of range", in_range=False))  # fmt: skip
        return touch

    def _asked(self, contact: Contact, before: Memory | None, dt: float) -> Asked:
        """What the contact law is asked for a contact."""
        pose = contact.pose_body_from_tool
        if before is not None and before.scalars.surface not in (0.0, contact.tool.number):
            before = None
        memory = before or fresh(pose, len(self.series.times))
        known = before is not None and memory.scalars.pressing >= 0
        scalars = memory.scalars
        twist, gone, kept, gain, owed, now, passed = self._aged(memory, known, pose, dt)
        asked, moved = contact, None
        if contact.wrench is not None and (len(kept) or memory.slid < 1):
            force = contact.wrench[:3]
            size = math.sqrt(force @ force)
            normal = memory.contact[1] if scalars.radius > 0 else force / max(size, 1e-300)
            wanted = float(force @ normal) / (scalars.net * memory.slid)
            if wanted > 0:
                asked = contact.scaled((wanted + scalars.stretch * owed) / (wanted * now * memory.slid))
                if scalars.pressing > 0:
                    moved = float((memory.imprint[:3, 3] - memory.pose[:3, 3]) @ force) / size
        return Asked(asked, contact, memory, known, twist, gone, kept, gain, owed, now, passed, moved)

    def _aged(self, memory: Memory, known: bool, pose: Transform, dt: float, part: float = 1.0) -> tuple[Any, ...]:
        """See footing.aged: of a tool that is at a pose (4, 4) now, and held its skin for a part of the step."""
        scalars = memory.scalars
        goes = scalars.limit / memory.stiffness[0] if memory.stiffness[0] > 0 else 0.0
        at = np.array((scalars.passed_first, scalars.passed_second, scalars.passed))
        return aged(memory.pose, pose, memory.imprint, memory.contact, known, scalars.pressing > 0, scalars.share, goes,
                    scalars.radius, at, part, *self.series, self._fades, dt, scalars.elastic,
                    memory.relaxed)  # fmt: skip

    def _late(self, one: Asked, touch: Touch, dt: float) -> Asked:
        """The same where a tool came to the skin late in the step: from then on it relaxes."""
        pressed = touch.pressed
        if one.stated.wrench is not None or not one.known or one.before.scalars.pressing > 0 or not len(one.kept) or \
                not touch.presses or pressed is None or pressed.forces is None or not touch.force > 0:  # fmt: skip
            return one
        pose = one.stated.pose_body_from_tool
        middle = pressed.forces @ pressed.squeeze.nodes.points / pressed.forces.sum()
        way = -_gone(pose, one.before.pose, middle)
        part = part_of_way(way, touch.push / touch.force, touch.depth, _radius(pressed), pressed.power)
        _, gone, kept, gain, owed, now, passed = self._aged(one.before, one.known, pose, dt, part)
        return one._replace(gone=gone, kept=kept, gain=gain, owed=owed, now=now, passed=passed)

    def _again(self, one: Asked, touch: Touch) -> Asked | None:
        """The same with a wrench that fits where the contact's normal turned out to be; None where it does."""
        pressed = touch.pressed
        if one.contact is one.stated or not touch.presses or one.contact.wrench is None or pressed is None or \
                pressed.forces is None:  # fmt: skip
            return None
        push, has = touch.push, float(pressed.forces.sum())
        force = math.sqrt(push @ push)
        if not force > 0:
            return None
        fades = faded(self._fades, _radius(pressed))
        now, long = 1 - fades * float(self.series.shares @ one.gain), stretch(touch.depth, mean_thickness(pressed))
        takes = needed(one.stated.wrench, push, force, has, long, one.owed, now, one.before.slid)
        carried = float(one.contact.wrench[:3] @ push) / force
        if force < (1 - 1e-6) * carried or not takes > 0 or abs(takes / has - 1) < HELD_OFF:
            return None
        return one._replace(contact=one.contact.scaled(takes / has))

    def _law(self, one: Asked, touch: Touch, dt: float) -> Law:
        """What a tool does, from what elastic skin does."""
        shares, before, push, pressed = self.series.shares, one.before.scalars, touch.push, touch.pressed
        if not (touch.presses and pressed is not None and pressed.forces is not None and push @ push > 0):
            return self._free(one, touch, 0.0, dt)
        nodes, stated, pose = pressed.squeeze.nodes, one.stated.wrench, touch.pose_body_from_tool
        (force, elastic, at_rest, net, radius, long, lever, thickness, contact, relaxed, stored, whole,
         doubt) = bearing(
            push, nodes.points, nodes.area, nodes.thickness, nodes.depths, pressed.forces, touch.depth, pressed.power,
            pressed.factor, one.before.contact, before.pressing > 0, self._fades, one.kept, one.gain, one.owed, shares,
            NONE if stated is None else stated, one.contact is not one.stated, one.before.slid)  # fmt: skip
        if not force > 0:
            return self._free(one, touch, at_rest, dt)
        by, trail = force / elastic, one.before.trail
        changed: dict[str, Any] = {}
        if len(trail):
            came = one.before.contact[0] if before.pressing > 0 else contact[0]
            passing = wake.Pass(pose, contact[0], contact[1], relaxed, at_rest, touch.depth, pressed.power, 1 - long,
                                radius, came)  # fmt: skip
            trail = wake.after(trail, self.series, dt, passing)
            changed["wake"] = wake.Wake(trail, shares)
        share, limit, slid, held, room, passed = 1.0, 0.0, 1.0, 0.0, NO_ROOM, one.passed
        stiffness, springs, eased = NO_ROOM, one.before.springs, one.before.springs_relaxed
        mu = self.friction(touch.name)
        if mu > 0 and net > MIN_ONE_WAY_SHARE:
            give, bend = self.toucher.give(nodes, pressed.forces), self.toucher.curvature(nodes, pressed.forces)
            (wrench, rubs, share, offset, turn, lean, grown, slid_offset, slid_turn, limit, stiffness, springs, eased,
             bent, slid, held, room, passed, contact, besides) = rub(
                by * touch.wrench, NONE if stated is None else stated, stated is not None, contact, pose[:3, 3],
                bend, give, mu,
                LOST * pressed.along, force, lever, at_rest, touch.depth, radius, pressed.power,
                *self.sideways.at(radius, thickness), one.twist, one.known, before.pressing > 0, one.before.contact,
                before.elastic, one.before.slid, before.held,
                np.array((before.rolled_first, before.rolled_second, before.rolled)), one.passed, one.before.springs,
                one.before.springs_relaxed, one.before.stiffness, *self.series, dt)  # fmt: skip
            changed |= scaled(touch, grown * by, grown * doubt)
            if self.toucher.layer.tissue.skin is not None:
                pressing = math.sqrt(wrench[:3] @ wrench[:3])
                besides += RUBBED * pressing + PILED * float(rubs[:3] @ rubs[:3]) / pressing
            elif (drag := float(rubs[:3] @ rubs[:3])) > 0:
                besides += ROUND * thickness * max(float(rubs[:3] @ bend @ rubs[:3]), 0.0) / math.sqrt(drag)
            if grown >= MOST_GROWN and stated is None:
                touch = touch.with_(trust=touch.trust.also(
                    f"{touch.name} drags skin around the limb, which would press {grown - 1:.0%} harder than pressed "
                    "straight, or more; that was not tried", in_range=False))  # fmt: skip
            if (dragged := math.sqrt(offset @ offset) / thickness) > MOST_DRAGGED:
                touch = touch.with_(trust=touch.trust.also(
                    f"{touch.name} drags skin along by {dragged:.2g} of its thickness; tried is {MOST_DRAGGED:g}",
                    in_range=False))  # fmt: skip
            if besides > 0:
                changed["force_bound"] = changed.get("force_bound", touch.force_bound) + besides
            wrench = wrench + rubs
            slip = Slip(rubs, share, offset, turn, contact[0], lean, grown, slid_offset, slid_turn)
            changed |= {"wrench": wrench, "slip": slip}
            stored, whole = stored + bent, whole + 2 * bent
        else:
            wrench = by * touch.wrench
            changed |= scaled(touch, by, doubt)
        scalars = Scalars(1.0, at_rest, max(at_rest, before.largest), net, radius, touch.depth, at_rest, pressed.power,
                          share, before.work, 1.0, limit, long, one.stated.tool.number, slid, 0.0, held, *room.tolist(),
                          *passed.tolist())  # fmt: skip
        memory = Memory(one.stated.pose_body_from_tool, wrench, scalars, relaxed, contact, pose, stiffness, springs,
                        eased, trail)  # fmt: skip
        return Law(self._said(one, touch, changed), memory, stored, whole)

    def _free(self, one: Asked, touch: Touch, asked: float, dt: float) -> Law:
        """Skin that the tool does not hold comes back by itself; asked: force at rest that the tool asks for [N]."""
        before = one.before.scalars
        if touch.presses and touch.pressed is not None:
            touch = touch.with_(status=APART, wrench=np.zeros(6), force_bound=0.0, pressure=None, pressed=None,
                                trust=Trust())  # fmt: skip
        part = 1.0
        if asked == 0 and before.radius > 0 and before.pressing > 0:
            middle, normal = one.before.contact[:2]
            way = _gone(one.before.pose, one.stated.pose_body_from_tool, middle)
            part = part_of_way(way, -normal, before.depth, before.radius, before.power)
        memory = self._back(one.before, dt, one.gone, asked, part)
        memory = memory._replace(pose=one.stated.pose_body_from_tool, wrench=touch.wrench,
                                 scalars=memory.scalars._replace(pressing=0.0))  # fmt: skip
        scalars, left = memory.scalars, wake.Wake(memory.trail, self.series.shares) if len(memory.trail) else None
        depth = _depth(scalars)
        imprint = Imprint(memory.imprint, depth) if scalars.sunk else None
        touch = self._said(one, touch, {"wake": left, "imprint": imprint})
        long = stretch(depth, scalars.depth / (1 - scalars.stretch)) if scalars.stretch < 1 else 1.0
        return Law(touch, memory, 0.0, scalars.elastic * long * depth / (before.power + 1))

    def _left(self, memory: Memory, dt: float) -> Memory:
        """The memory of a tool that is not told of any more: the skin comes back."""
        after = self._back(memory, dt, 0.0, None, 1.0)
        scalars = after.scalars._replace(pressing=-1.0, work=0.0, strayed=self._strayed(memory, after, dt, 0.0))
        return after._replace(scalars=scalars, wrench=np.zeros(6))

    def _strayed(self, before: Memory, after: Memory, dt: float, gone: float) -> float:
        """What is left of `Scalars.strayed` after a step in range, at most [N]; gone: see Asked."""
        if not before.scalars.strayed > 0:
            return 0.0
        had, has = (float(self.series.shares @ memory.relaxed) for memory in (before, after))
        if after.scalars.pressing > 0:  # what is new is in range
            return max(min(before.scalars.strayed * math.exp(-dt / self.series.times[-1] - gone), has), 0.0)
        return before.scalars.strayed * max(has, 0.0) / max(had, 1e-300)

    def _back(self, memory: Memory, dt: float, gone: float, asked: float | None, part: float) -> Memory:
        """The memory of skin that comes back by itself.

        Where the tool lets it go it is as deep as the tool, from there on it comes back as its force does: what is left
        of a load that fades is the same motion, smaller.

        Args:
            memory: memory before.
            dt, gone: see relaxation.let_go.
            asked: force at rest that the tool asks for at the end of the step [N]; None: it was taken away before.
            part: share of the step until it asks for that [-].
        """
        before, shares = memory.scalars, self.series.shares
        held = before.elastic if before.pressing > 0 and asked is not None else 0.0
        relaxed, least = let_go(*self.series, dt, gone, part, held, asked or 0.0, memory.relaxed)
        if before.pressing > 0 and before.imprint_force > 0:
            depth = before.depth * depth_left(min(least / before.imprint_force, 1.0), before.power, 1 - before.stretch)
            before = before._replace(depth=depth, imprint_force=max(least, 1e-300), power=1.0,
                                     stretch=1 - (1 - before.stretch) * depth / before.depth)  # fmt: skip
        scalars = before._replace(elastic=max(float(shares @ relaxed), 0.0), share=1.0, passive=1.0)
        return _let_go(memory._replace(scalars=scalars, relaxed=relaxed,
                                       trail=wake.after(memory.trail, self.series, dt, None)))  # fmt: skip

    def _said(self, one: Asked, touch: Touch, changed: dict[str, Any]) -> Touch:
        """The touch with what changed, with what of the stated wrench is missing, and what that says of it."""
        stated = one.stated.wrench
        if stated is None:
            return touch.with_(**changed) if changed else touch
        touch = touch.with_(**changed, missing=stated - changed.get("wrench", touch.wrench))
        trust = self.toucher.unmet(touch.trust, touch, stated)
        return touch if trust is touch.trust else touch.with_(trust=trust)

    def elastic(self, touches: Sequence[Touch]) -> list[Touch]:
        """The touches of elastic skin without friction that move the skin as these do, but for what is dragged along.

        Skin that is dragged along was pressed by a tool that stands where the skin came from. Skin that no tool holds
        is another matter: see `left_behind`.
        """
        out, asked = [], []
        for touch in touches:
            if touch.imprint is not None:
                continue
            if touch.slip is None or np.linalg.norm(touch.slip.offset) <= MIN_OFFSET or \
                    touch.name not in self.toucher.tools:  # fmt: skip
                out.append(touch)
            else:
                pose = shifted(touch.pose_body_from_tool, -touch.slip.offset)
                asked.append(Contact(self.toucher.tools[touch.name], pose))
        return [*out, *self.toucher.touch_all(asked)]

    def left_behind(self, touches: Sequence[Touch]) -> list[tuple[Touch, float]]:
        """Elastic touches whose motion was left behind by a tool, and the share of it that is still there [-]."""
        some = [touch for touch in touches if touch.imprint is not None and touch.name in self.toucher.tools]
        found = [(self.toucher.touch(Contact(self.toucher.tools[one.name], one.imprint.pose)), one.imprint.depth)
                 for one in some if one.imprint is not None]  # fmt: skip
        return [(touch, min(depth / touch.depth, 1.0)) for touch, depth in found if touch.presses]


def _gone(before: Transform, after: Transform, point: np.ndarray) -> np.ndarray:
    """Way of a tool's point, that is at `point` (3,) before, between poses (4, 4), (3,) [m]."""
    motion = after @ inverted(before)
    return motion[:3, :3] @ point + motion[:3, 3] - point


def _radius(pressed: Pressed) -> float:
    """Radius of a circle as large as what presses [m]."""
    assert pressed.forces is not None
    return math.sqrt(float(pressed.squeeze.nodes.area[pressed.forces > 0].sum()) / math.pi)


def mean_thickness(pressed: Pressed) -> float:
    """Thickness under a contact, weighed with its forces [m]."""
    assert pressed.forces is not None
    return float(pressed.forces @ pressed.squeeze.nodes.thickness) / float(pressed.forces.sum())


def _let_go(memory: Memory) -> Memory:
    """The memory without springs of friction."""
    scalars = memory.scalars._replace(held=0.0, rolled_first=0.0, rolled_second=0.0, rolled=0.0, passed_first=0.0,
                                      passed_second=0.0, passed=0.0)  # fmt: skip
    return memory._replace(scalars=scalars, stiffness=np.zeros(3), springs=np.zeros_like(memory.springs),
                           springs_relaxed=np.zeros_like(memory.springs_relaxed))  # fmt: skip


def _depth(scalars: Scalars) -> float:
    """Depth to which skin that is free has come back [m]."""
    share = scalars.elastic / scalars.imprint_force if scalars.elastic > 0 else 0.0
    return scalars.depth * depth_left(share, scalars.power, 1 - scalars.stretch)
