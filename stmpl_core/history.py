"""History: what time, friction and the balance of energy make of elastic touches, step by step.

A step asks the contact law for elastic touches without friction, by poses as they are and by wrenches as large as an
elastic skin would have to carry now. Then, tool by tool, the force relaxes (`stmpl_core.relaxation`), friction follows
the tool's way (`stmpl_core.slip`), and a contact that would give more energy than was put in is weakened.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from stmpl_core import wake
from stmpl_core.arrays import Wrench
from stmpl_core.balance import Asked, Law, balanced, scaled
from stmpl_core.columns import shifted
from stmpl_core.contact import Contact
from stmpl_core.dragged import MIN_OFFSET
from stmpl_core.errors import InvalidInput
from stmpl_core.footing import (
    aged,
    carried_more,
    carried_tangent,
    faced,
    given_way,
    in_plane,
    in_space,
    leaned,
    patch_of,
    way_of_tool,
    wrench_at,
)
from stmpl_core.friction import Friction, coefficients
from stmpl_core.relaxation import depth_left, fading, left_over, let_go, series_of, stretch
from stmpl_core.sideways import Sideways
from stmpl_core.slip import drag, ploughing
from stmpl_core.state import Memory, Scalars, State, fresh
from stmpl_core.touch import APART, MIN_ONE_WAY_SHARE, Imprint, Pressed, Slip, Touch
from stmpl_core.toucher import Toucher

ROUGH = 0.12  # error of the relaxed force, over what has relaxed: 5.4 of 45 % in trials where only the shear relaxes
RUBBED = 0.1  # of the force: what skin that gives way beneath a dry tool is off, as the law was learnt from what sticks
PILED = 0.5  # of drag^2 / force: error of skin that piles up; 0.7 of it on a back, where the elastic bound was 0.45
MOST_LEAN = 0.5  # turn of the normal under skin that is dragged along, of which a push takes note [rad]
LEAST_GROWN = 0.5  # depth over the tool's that counts at least, where skin came from a hollow
MOST_PASSES, SETTLED = 4, 1e-3  # turn of the normal [rad] at which push and friction agree
LOST = 0.5  # of what skin carries along itself: what is gone once all of it slides; 0.4 to 0.6 by slides on a forearm
STRAYED = 0.03  # of the elastic force: part of the memory from touches out of range, beyond which an answer is, too
HELD_OFF = 0.01  # relative error of the elastic force by wrench, from which it is asked for again
NOTHING = np.zeros(3)


class _Dragged(NamedTuple):
    """Friction of a contact.

    Args:
        slip: what it carries.
        limit: tangential force at which all of it slides [N].
        stiffness: of the patch, (3,) [N/m]; see Memory, as springs and relaxed.
        stored: energy that the bent skin stores [J].
        slid, held: see Scalars.
        rolled: where the contact is in the room that it has rolled over (footing.beyond), (3,) [m].
    """

    slip: Slip
    limit: float
    stiffness: np.ndarray
    springs: np.ndarray
    relaxed: np.ndarray
    stored: float
    slid: float
    held: float
    rolled: np.ndarray


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
        self._fading = fading(layer.tissue, thickness)

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
        asked = [self._asked(contact, state.tools.get(contact.name), dt) for contact in contacts]
        tried = {one.stated.name: one.moved for one in asked if one.moved is not None}
        touches = self.toucher.touch_all([one.contact for one in asked], alone=False, tried=tried)
        again = [self._again(one, touch) for one, touch in zip(asked, touches, strict=True)]
        if any(again):
            asked = [new or one for one, new in zip(asked, again, strict=True)]
            tried |= {touch.name: touch.moved for touch in touches if touch.name in tried}
            touches = self.toucher.touch_all([one.contact for one in asked], alone=False, tried=tried)
        laws = [self._law(one, touch, dt) for one, touch in zip(asked, touches, strict=True)]
        out, memories = balanced(asked, laws, self.series.shares)
        out = [self._doubted(one, touch, memories, dt) for one, touch in zip(asked, out, strict=True)]
        for name, memory in state.tools.items():
            if name not in memories:
                left = self._left(memory, dt)
                if left.scalars.sunk or left.trail.any():
                    memories[name] = left
        return out, State(memories, here)

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
        memories[touch.name] = memory._replace(scalars=scalars._replace(strayed=strayed, doubted=float(doubted)))
        if touch.trust.in_range and strayed > STRAYED * scalars.elastic > 0:
            return replace(touch, trust=touch.trust.also(
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
        goes = scalars.limit / memory.stiffness[0] if memory.stiffness[0] > 0 else 0.0
        fades, at = self._fades(scalars.radius), np.array((scalars.passed_first, scalars.passed_second, scalars.passed))
        twist, gone, kept, gain, owed, now, passed = aged(
            memory.pose, pose, memory.imprint, memory.contact, known, scalars.pressing > 0, scalars.share, goes,
            scalars.radius, at, *self.series, dt, fades * scalars.elastic, memory.relaxed)  # fmt: skip
        now = 1 - fades * (1 - now)
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

    def _fades(self, radius: float) -> float:
        """Factor on the force that relaxes under a contact of a radius [m]; see relaxation.fading."""
        logs, factors = self._fading
        return float(np.interp(math.log(radius), logs, factors)) if radius > 0 else 1.0

    def _whole(self, touch: Touch) -> float:
        """Sum of the sizes of the forces that a touch presses with [N]."""
        return 0.0 if touch.pressure is None else float(touch.pressure @ self.toucher.layer.vertex_areas)

    def _needed(self, one: Asked, push: np.ndarray, force: float, whole: float, stretch: float) -> float:
        """Elastic force that a stated wrench takes, as a sum of sizes [N].

        Args:
            one: what is asked.
            push: force of the touch, (3,) [N].
            force: its size [N].
            whole: sum of the sizes of its parts [N].
            stretch: stretch of the column under the tool [-].
        """
        assert one.stated.wrench is not None
        wanted = float(one.stated.wrench[:3] @ push) / force * whole / force / one.before.slid
        return (wanted + stretch * one.owed) / one.now

    def _again(self, one: Asked, touch: Touch) -> Asked | None:
        """The same with a wrench that fits where the contact's normal turned out to be; None where it does."""
        pressed = touch.pressed
        if one.contact is one.stated or not touch.presses or one.contact.wrench is None or pressed is None or \
                pressed.forces is None:  # fmt: skip
            return None
        push, has = touch.push, self._whole(touch)
        force = math.sqrt(push @ push)
        if not force > 0:
            return None
        fades = self._fades(math.sqrt(float(pressed.squeeze.nodes.area[pressed.forces > 0].sum()) / math.pi))
        eased = one._replace(now=1 - fades * float(self.series.shares @ one.gain))
        needed = self._needed(eased, push, force, has, stretch(touch.depth, mean_thickness(pressed)))
        carried = float(one.contact.wrench[:3] @ push) / force
        if force < (1 - 1e-6) * carried or not needed > 0 or abs(needed / has - 1) < HELD_OFF:
            return None
        return one._replace(contact=one.contact.scaled(needed / has))

    def _law(self, one: Asked, touch: Touch, dt: float) -> Law:
        """What a tool does, from what elastic skin does."""
        shares, before, push, pressed = self.series.shares, one.before.scalars, touch.push, touch.pressed
        size = math.sqrt(push @ push)
        if not (touch.presses and pressed is not None and pressed.forces is not None and size > 0):
            return self._free(one, touch, 0.0, dt)
        normal, nodes, elastic = push / size, pressed.squeeze.nodes, self._whole(touch)
        depth = nodes.sinking if len(nodes.sinking) else nodes.strain * nodes.thickness
        middle, radius, lever, thickness, whole = patch_of(
            nodes.points, nodes.area, nodes.thickness, depth, pressed.forces, normal)  # fmt: skip
        net, long, fades = min(size / elastic, 1.0), stretch(touch.depth, thickness), self._fades(radius)
        one = one._replace(now=1 - fades * float(shares @ one.gain))
        force, at_rest = one.now * elastic - long * one.owed, elastic / long
        if one.contact is not one.stated:
            needed = self._needed(one, push, size, elastic, long)
            if abs(needed / elastic - 1) < 2 * HELD_OFF:
                force, at_rest = one.now * needed - long * one.owed, needed / long
        if not force > 0:
            return self._free(one, touch, at_rest, dt)
        pose = touch.pose_body_from_tool
        middle = middle + 2 * whole / float(pressed.forces.sum()) * normal
        contact = np.array((middle, normal, carried_tangent(one.before.contact, normal, before.pressing > 0)))
        relaxed = one.kept + fades * one.gain * at_rest
        faded = float(shares @ relaxed)
        by, doubt, trail, left = force / elastic, ROUGH * long * faded, one.before.trail, None
        if len(trail):
            passing = wake.Pass(pose, middle, normal, relaxed, at_rest, touch.depth, pressed.power, 1 - long, radius)
            trail = wake.after(trail, self.series, dt, passing)
            left = wake.Wake(trail, shares)
        whole *= 0.5 + 0.5 / pressed.factor  # what draws a tool back from the core is steep: it stores less
        stored = whole * left_over(faded / at_rest, pressed.power, 1 - long)
        wrench = by * touch.wrench
        scalars = Scalars(1.0, at_rest, max(at_rest, before.largest), net, radius, touch.depth, at_rest, pressed.power,
                          work=before.work, stretch=long, surface=one.stated.tool.number,
                          passed_first=one.passed[0], passed_second=one.passed[1], passed=one.passed[2])  # fmt: skip
        springs = NOTHING, one.before.springs, one.before.springs_relaxed
        if self.friction(touch.name) > 0 and net > MIN_ONE_WAY_SHARE:
            give, bend = self.toucher.give(nodes, pressed.forces), self.toucher.curvature(nodes, pressed.forces)
            dragged = self._dragged(one, wrench, contact, pose[:3, 3], scalars, force, lever, thickness, give, bend, dt,
                                    LOST * pressed.along)
            lean, grown = dragged.slip.lean, dragged.slip.grown
            changed = scaled(touch, grown * by, grown * doubt)
            wrench = grown * dragged.slid * wrench + wrench_at(lean, middle - pose[:3, 3])
            if self.toucher.layer.tissue.skin is not None:
                rubs = dragged.slip.wrench[:3]
                pressing = math.sqrt(wrench[:3] @ wrench[:3])
                besides = RUBBED * pressing + PILED * float(rubs @ rubs) / pressing
                changed["force_bound"] = changed.get("force_bound", touch.force_bound) + besides
            wrench = wrench + dragged.slip.wrench
            changed |= {"wrench": wrench, "slip": dragged.slip}
            stored, whole = stored + dragged.stored, whole + 2 * dragged.stored
            first, second, rolled = dragged.rolled
            scalars = scalars._replace(share=dragged.slip.share, limit=dragged.limit, slid=dragged.slid,
                                       held=dragged.held, rolled_first=first, rolled_second=second,
                                       rolled=rolled)  # fmt: skip
            springs = dragged.stiffness, dragged.springs, dragged.relaxed
        else:
            changed = scaled(touch, by, doubt)
        if left is not None:
            changed["wake"] = left
        memory = Memory(one.stated.pose_body_from_tool, wrench, scalars, relaxed, contact, pose, *springs, trail)
        return Law(self._said(one, touch, changed), memory, stored, whole)

    def _free(self, one: Asked, touch: Touch, asked: float, dt: float) -> Law:
        """Skin that the tool does not hold comes back by itself; asked: force at rest that the tool asks for [N]."""
        before = one.before.scalars
        if touch.presses and touch.pressed is not None:
            touch = replace(touch, status=APART, wrench=np.zeros(6), force_bound=0.0, pressure=None, pressed=None)
        memory = self._back(one.before, dt, one.gone, asked)
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
        after = self._back(memory, dt, 0.0, None)
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

    def _back(self, memory: Memory, dt: float, gone: float, asked: float | None) -> Memory:
        """The memory of skin that comes back by itself.

        Where the tool lets it go it is as deep as the tool, from there on it comes back as its force does: what is left
        of a load that fades is the same motion, smaller.

        Args:
            memory: memory before.
            dt, gone: see relaxation.let_go.
            asked: force at rest that the tool asks for at the end of the step [N]; None: it was taken away before.
        """
        before, shares = memory.scalars, self.series.shares
        held = before.elastic if before.pressing > 0 and asked is not None else 0.0
        relaxed, least = let_go(*self.series, dt, gone, held, asked or 0.0, memory.relaxed)
        if before.pressing > 0 and before.imprint_force > 0:
            depth = before.depth * depth_left(min(least / before.imprint_force, 1.0), before.power, 1 - before.stretch)
            before = before._replace(depth=depth, imprint_force=max(least, 1e-300), power=1.0,
                                     stretch=1 - (1 - before.stretch) * depth / before.depth)  # fmt: skip
        scalars = before._replace(elastic=max(float(shares @ relaxed), 0.0), share=1.0, passive=1.0)
        return _let_go(memory._replace(scalars=scalars, relaxed=relaxed,
                                       trail=wake.after(memory.trail, self.series, dt, None)))  # fmt: skip

    def _dragged(self, one: Asked, wrench: Wrench, contact: np.ndarray, origin: np.ndarray, scalars: Scalars,
                 force: float, lever: float, thickness: float, give: np.ndarray | None, bend: np.ndarray, dt: float,
                 along_itself: float) -> _Dragged:  # fmt: skip
        """Friction of a contact that presses with a wrench (6,), as the scalars say, without friction.

        Friction turns the way that the push faces, and the push bounds friction: both are asked until they agree.
        What skin carried along itself while it stuck (stmpl_core.wrenches) a drag takes from it, as far as it is used
        up. When it turns back that does not come back, but where the tool presses on.
        """
        before, radius, depth = one.before, scalars.radius, scalars.depth
        patch, mu = self.sideways.at(radius, thickness), self.friction(one.stated.name)
        stated, wanted, turned, out, held, slid = one.stated.wrench, NOTHING, NOTHING, 0.0, 1.0, before.slid
        if before.stiffness[0] > 0:
            turned, out = faced(before.springs, before.stiffness, contact, bend, MOST_LEAN)
        had = before.scalars
        way, rolled, room = way_of_tool(
            one.twist, one.known, before.contact, had.pressing > 0, contact, origin, depth, radius, lever,
            np.array((had.rolled_first, had.rolled_second, had.rolled)))  # fmt: skip
        was = float(before.stiffness[0])
        last_held = had.held or was
        held_at = before.stiffness * (last_held / was) if was > 0 else before.stiffness
        size, lost = math.sqrt(wrench[:3] @ wrench[:3]), (1 - before.slid) * before.scalars.elastic / scalars.elastic
        for _ in range(MOST_PASSES):
            if stated is None:
                grown = max(1 + out / depth, LEAST_GROWN) ** scalars.power
            else:
                held, lean = carried_more(stated, contact[1], turned) * before.slid, size * turned
                grown, push = held / slid, held * (wrench + wrench_at(lean, contact[0] - origin))
                wanted = in_plane(stated - push, leaned(contact, turned), origin, lever)
            stiffer, cap = ploughing(depth, radius, grown * force, patch.along, patch.bare, mu)
            alone = along = stiffer * patch.secant(mu * grown * force)
            if give is not None:
                aim = wanted if stated is not None else before.springs.sum(axis=0) + along * way
                along = given_way(along, give, aim, contact)
            if out > 0:  # skin leans before the tool once: as it turns about the bone, or as it is ploughed
                by_turn = max(1 - along / alone, 0.0) * math.sqrt(turned @ turned)
                cap -= min(by_turn * grown * force, cap - mu * grown * force)
            stiffness = np.array((along, along, stiffer * patch.turn / (lever * lever)))
            springs, relaxed, carried, share, stored = drag(
                before.springs, before.springs_relaxed, *self.series, dt, rolled, stiffness, held_at, cap, way,
                wanted, stated is not None)  # fmt: skip
            last, (turned, out) = turned, faced(springs, stiffness, contact, bend, MOST_LEAN)
            took = along_itself * min(math.sqrt(carried @ carried) / cap, 1.0)
            before_slid, slid = slid, 1 - max(took, min(lost, along_itself))
            if abs(turned - last).max() + abs(slid - before_slid) < SETTLED:
                break
        grown = grown if stated is None else held / slid
        rubs, offset, turn = in_space(carried, springs, stiffness, leaned(contact, turned), contact, origin, lever)
        stored += max(0.5 * (1 + grown * slid) * size * out, 0.0)
        slip = Slip(rubs, share, offset, turn, contact[0], grown * slid * size * turned, grown)
        old, new = last_held and min(along, last_held), math.sqrt(float((springs.sum(axis=0) ** 2).sum()))
        kept = old and old / last_held * math.exp(-rolled) * math.sqrt(float((before.springs.sum(axis=0) ** 2).sum()))
        share_old = min(kept / new, 1.0) if new > 0 else 0.0  # what is new is held at what the patch is now
        return _Dragged(slip, cap, stiffness, springs, relaxed, stored, slid, share_old * old + (1 - share_old) * along,
                        room)  # fmt: skip

    def _said(self, one: Asked, touch: Touch, changed: dict[str, Any]) -> Touch:
        """The touch with what changed, with what of the stated wrench is missing, and what that says of it."""
        stated = one.stated.wrench
        if stated is None:
            return replace(touch, **changed) if changed else touch
        touch = replace(touch, **changed, missing=stated - changed.get("wrench", touch.wrench))
        trust = self.toucher.unmet(touch.trust, touch, stated)
        return touch if trust is touch.trust else replace(touch, trust=trust)

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
