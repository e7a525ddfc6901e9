"""History: what time, friction and the balance of energy make of elastic touches, step by step.

A step asks the contact law for elastic touches without friction, by poses as they are and by wrenches as large as an
elastic skin would have to carry now. Then, tool by tool, the force relaxes (`stmpl_core.relaxation`), friction follows
the tool's way (`stmpl_core.slip`), and a contact that would give more energy than was put in is weakened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any
from zlib import crc32

import numpy as np

from stmpl_core import stepped
from stmpl_core.columns import shifted
from stmpl_core.contact import Contact
from stmpl_core.dragged import MIN_OFFSET
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction, coefficients
from stmpl_core.green import AS_AT_REST, Green
from stmpl_core.layer import SoftLayer
from stmpl_core.relaxation import fading, series_of
from stmpl_core.sideways import Sideways, beside, fading_aside
from stmpl_core.slip import MOST_GROWN
from stmpl_core.state import Memory, State, fresh
from stmpl_core.stepped import MOST_DRAGGED, OUT, PATCH, SAYS
from stmpl_core.tissue import Tissue
from stmpl_core.touch import APART, Imprint, Slip, Touch
from stmpl_core.toucher import STIFFENING, Toucher
from stmpl_core.trust import Trust
from stmpl_core.wake import Wake

ELSEWHERE = 3.0  # thicknesses around a skin within which a contact on it lies, whatever presses
FLAT = np.zeros((1, 1, 3)), np.zeros(1), np.zeros(1), 0.0, 0.0  # in place of a Sideways where nothing rubs
ALONE = np.zeros((1, 1, 2))  # in place of a table of sideways.beside where a tool is alone, or nothing rubs
NO_GIVES = AS_AT_REST, AS_AT_REST  # in place of Green.gives


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
        self.toucher = toucher
        layer = toucher.layer
        self._rest = layer.typical
        self.frictions = coefficients(friction)
        thickness = float(np.median(layer.thickness))
        self.series = series_of(self._rest.tissue, thickness)
        self._last: State | None = None  # state of the last step, which is one of this skin
        self._told_last: list[Touch] = []  # what that step returned
        self._skin = shape_of(layer)
        self._tissue = number_of(layer.tissue)

    @cached_property
    def sideways(self) -> Sideways:
        """Stiffness of the layer at rest to what sticks to it."""
        return Sideways(self._rest)

    @property
    def _fades(self) -> np.ndarray:
        """Rows of relaxation.fading, and below them, where anything rubs, of sideways.fading_aside, (2 + P, R)."""
        return self._fades_aside if self.rubs else self._fades_alone

    @cached_property
    def _fades_alone(self) -> np.ndarray:
        rows = fading(self._rest.tissue, float(np.median(self._rest.thickness)))
        return np.vstack([rows, np.zeros((len(self.series.times), rows.shape[1]))])

    @cached_property
    def _fades_aside(self) -> np.ndarray:
        tissue, thickness = self._rest.tissue, float(np.median(self._rest.thickness))
        return np.vstack([fading(tissue, thickness), fading_aside(tissue, thickness)])

    def moved(self, toucher: Toucher) -> History:
        """The same history where joints take the skin."""
        out = copy(self)
        out.toucher, out._last, out._told_last = toucher, None, []
        for name in ("_box", "_gives"):
            out.__dict__.pop(name, None)
        return out

    @cached_property
    def _box(self) -> list[float]:
        """The lowest and the highest corner of a box that holds every contact on this skin, (6,) [m]."""
        layer = self.toucher.layer
        around = ELSEWHERE * float(layer.thickness.max())
        return [*(layer.vertices.min(axis=0) - around).tolist(), *(layer.vertices.max(axis=0) + around).tolist()]

    @property
    def rubs(self) -> bool:
        """Whether any tool rubs."""
        every, some = self.frictions
        return bool(every) or any(some.values())

    @cached_property
    def _aside(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, float]:
        """See Sideways.numbers; any numbers where nothing rubs."""
        return self.sideways.numbers if self.rubs else FLAT

    @cached_property
    def _beside(self) -> np.ndarray:
        return beside(self._rest.tissue, float(np.median(self._rest.thickness)))

    @cached_property
    def _gives(self) -> tuple[np.ndarray, np.ndarray]:
        """See Green.gives."""
        return Green.of(self.toucher.layer).gives

    def friction(self, name: str) -> float:
        """Coefficient of friction of a tool [-]."""
        every, some = self.frictions
        return some.get(name, every)

    def step(self, contacts: Sequence[Contact], state: State, dt: float) -> tuple[list[Touch], State]:
        """Touches of contacts with names of their own, dt [s] after a state; and the state then.

        Raises:
            InvalidInput: a state of another skin, one that relaxes in another number of times, or whose joints were
                elsewhere.
        """
        if state is not self._last:
            self._check(state)
        here, terms, many = self.toucher.joints, len(self.series.times), len(contacts)
        if not contacts and not state.tools:
            return [], State({}, here)
        memories, names = dict(state.tools), [contact.name for contact in contacts]
        told = [_own(memories, contact, terms) for contact in contacts]
        names += memories
        before = np.array([memory.numbers for memory in (*told, *memories.values())])
        asked, touches = self._elastic(contacts, before, dt)
        rows = zip(contacts, asked, touches, strict=True)
        patches, after = np.zeros((many, PATCH)), np.empty_like(before)
        for patch, (stated, one, touch) in zip(patches, rows, strict=True):
            self._tell(patch, stated, one is not stated, touch)
        out, says = np.empty((many, OUT)), np.zeros((many, SAYS))
        near = self._beside if self.rubs and len(before) > 1 else ALONE
        plain = stepped.step(patches, before, after, True, *self.series, self._fades,
                             self.toucher.layer.tissue.skin is not None, *self._aside, near, dt, out, says)  # fmt: skip
        memories = {name: Memory(row) for name, row in zip(names, after, strict=True)}
        touches = [self._told(*one) for one in zip(contacts, touches, memories.values(), out, says, strict=False)]
        if terms and not (plain and all(touch.trust.in_range for touch in touches)):
            out[:, 7] = [touch.trust.in_range for touch in touches]
            bounds = out[:, 6].copy()
            stepped.doubted(before, after, *self.series, dt, _possible(contacts, touches, bounds), out, says)
            touches = [self._doubted(touch, bound, row) for touch, bound, row in zip(touches, bounds, out, strict=True)]
        for name in names[many:] if dt > 0 else ():
            if not (memories[name].sunk or memories[name].trail.any()):
                del memories[name]
        self._last, self._told_last = State(memories, here, self._skin, self._tissue), touches
        return touches, self._last

    def left_out(self, touches: Sequence[Touch], state: State | None = None) -> list[str]:
        """Tools whose skin is not back yet and that were not among the contacts, by the state that came with the
        touches; None: by that of the last step, if it returned these.
        """
        if state is None and len(touches) == len(self._told_last) and \
                all(one is told for one, told in zip(touches, self._told_last, strict=True)):
            state = self._last
        if state is None or not len(self.series.times):
            return []
        names = {touch.name for touch in touches}
        return [name for name, memory in state.tools.items() if name not in names and memory.sunk]

    def _check(self, state: State) -> None:
        """Refuses a state of another skin; see `step`."""
        here = self.toucher.joints
        state.check_finite()
        if state.tools and state.joints != here:
            raise InvalidInput(f"the skin's joints are at {here} rad, the state was told at {state.joints}. Try "
                               "Simulator.touch, which takes it along.")  # fmt: skip
        for name, memory in state.tools.items():
            if memory.terms != len(self.series.times):
                raise InvalidInput(f"the state of {name} is of skin with {memory.terms} times of relaxation; "
                                   f"this layer has {len(self.series.times)}. Try an empty State().")  # fmt: skip
        if has_other_shape(state, self._skin):
            raise InvalidInput(f"the state of {', '.join(state.tools)} is of skin of another shape. Try an empty "
                               "State().")  # fmt: skip
        if is_of_other(state, self._tissue):
            raise InvalidInput(f"the state of {', '.join(state.tools)} is of other tissue, which relaxed or was "
                               "dragged otherwise. Try an empty State().")  # fmt: skip
        for name, memory in state.tools.items():
            if memory.scalars.radius > 0:
                (x, y, z), (a, b, c, d, e, f) = memory.contact[0].tolist(), self._box
                if not (a <= x <= d and b <= y <= e and c <= z <= f):
                    raise InvalidInput(f"the state of {name} is of a contact at {x:.3f}, {y:.3f}, {z:.3f} m, where "
                                       "this skin is not. Is it of another skin? Try an empty State().")  # fmt: skip

    def _elastic(self, contacts: Sequence[Contact], before: np.ndarray, dt: float
                 ) -> tuple[list[Contact], list[Touch]]:  # fmt: skip
        """What the contact law is asked, and its touches: where skin creeps under a wrench, of as large a one as it had
        to bear now if it were elastic.

        Args:
            contacts: contacts that are stated.
            before: what is remembered of each, rows of Memory.
            dt: time since then [s].
        """
        asked, tried = list(contacts), {}
        shares, times, fades = *self.series, self._fades
        for k, one in enumerate(contacts):
            if one.wrench is not None:
                by, moved = stepped.asked_for(before[k], one.pose_body_from_tool, one.wrench, shares, times, fades, dt)
                asked[k] = one.scaled(by) if by else one
                if moved == moved:
                    tried[one.name] = moved
        touches = self.toucher.touch_all(asked, alone=False, tried=tried)
        fits = True
        for k, (stated, one, touch) in enumerate(zip(contacts, asked, touches, strict=True)):
            pressed = touch.pressed
            if one is not stated and touch.presses and pressed is not None and pressed.forces is not None:
                nodes = pressed.squeeze.nodes
                by = stepped.asked_again(
                    before[k], stated.pose_body_from_tool, stated.wrench, one.wrench, touch.push, pressed.forces,
                    nodes.points, nodes.area, nodes.thickness, touch.depth, shares, times, fades, dt)  # fmt: skip
                if by:
                    asked[k], fits = one.scaled(by), False
        if fits:
            return asked, touches
        tried |= {touch.name: touch.moved for touch in touches if touch.name in tried}
        return asked, self.toucher.touch_all(asked, alone=False, tried=tried)

    def _tell(self, out: np.ndarray, stated: Contact, creeps: bool, touch: Touch) -> None:
        """Writes what a touch is as a whole to a PATCH; creeps: whether another wrench than the stated was asked."""
        pressed, wrench, toucher, mu = touch.pressed, stated.wrench, self.toucher, self.friction(touch.name)
        stepped.tell(touch.wrench, touch.force_bound, touch.trust.in_range, touch.depth, touch.pose_body_from_tool,
                     touch.wrench if wrench is None else wrench, stated.pose_body_from_tool, wrench is not None, creeps,
                     mu, stated.tool.number, out)  # fmt: skip
        if touch.presses and pressed is not None:
            nodes, near, rubs, way = pressed.squeeze.nodes, toucher.near, mu > 0, 0.0
            if pressed.factor > 1:
                way = (pressed.factor - 1) / STIFFENING * float(toucher.layer.thickness.max())
            forces = stepped.NO_FORCE if pressed.forces is None else pressed.forces
            stepped.whole_of(
                nodes.points, nodes.area, nodes.thickness, nodes.depths, forces, nodes.corners, nodes.shares,
                pressed.power, pressed.along, pressed.factor, way, rubs, near.frames, near.curvature, near.thickness,
                *(self._gives if rubs else NO_GIVES), toucher.layer.tissue.youngs_modulus, out)  # fmt: skip

    def _told(self, contact: Contact, touch: Touch, memory: Memory, out: np.ndarray, says: np.ndarray) -> Touch:
        """The touch as a step made it.

        Args:
            contact: contact that is stated.
            touch: its elastic touch.
            memory: what is remembered after the step.
            out, says: see stepped.step.
        """
        told = says.tolist()
        factor, passive, much, rubs, depth_left = *told[:4], told[27]
        trust, pressed = touch.trust, touch.pressed
        changed: dict[str, Any] = {"wrench": out[:6].copy()}
        if self.series.times.size:
            changed["wake"] = Wake(memory.trail, self.series.shares)
        if out[8] != stepped.HOLDS:
            if touch.presses and pressed is not None:
                changed |= {"status": APART, "force_bound": 0.0, "pressure": None, "pressed": None, "trust": Trust()}
            if memory.sunk:
                changed["imprint"] = Imprint(memory.imprint.copy(), depth_left)
        else:
            assert pressed is not None and pressed.forces is not None and touch.pressure is not None
            changed |= {"force_bound": float(out[6]), "passive": passive}
            if factor != 1:
                changed["pressure"] = touch.pressure * factor
                changed["pressed"] = pressed._replace(factor=pressed.factor * factor, forces=pressed.forces * factor)
            if rubs:
                share, turn, grown, slid_turn, dragged = told[10], told[14], told[18], told[22], told[26]
                own = says.copy()
                changed["slip"] = Slip(own[4:10], share, own[11:14], turn, own[23:26], own[15:18], grown, own[19:22],
                                       slid_turn, own[stepped.TAKEN :])  # fmt: skip
                if grown >= MOST_GROWN and contact.wrench is None:
                    trust = trust.also(
                        f"{touch.name} drags skin around the limb, which would press {grown - 1:.0%} harder than "
                        "pressed straight, or more; that was not tried", in_range=False)  # fmt: skip
                if dragged > MOST_DRAGGED:
                    trust = trust.also(f"{touch.name} drags skin along by {dragged:.2g} of its thickness; tried is "
                                       f"{MOST_DRAGGED:g}", in_range=False)  # fmt: skip
            if contact.name not in self.frictions[1] and self.frictions[1]:
                trust = trust.also(f"{touch.name} slides freely: friction is told of "
                                   f"{', '.join(sorted(self.frictions[1]))}")  # fmt: skip
            if much:
                trust = trust.also(f"{touch.name} came to where it is with less work than it could give back: "
                                   f"weakened to {passive:.0%}", in_range=False)  # fmt: skip
            changed["trust"] = trust
        if contact.wrench is None:
            return touch.with_(**changed)
        touch = touch.with_(**changed, missing=contact.wrench - changed["wrench"])
        trust = self.toucher.unmet(touch.trust, touch, contact.wrench)
        return touch if trust is touch.trust else touch.with_(trust=trust)

    def _doubted(self, touch: Touch, bound: float, row: np.ndarray) -> Touch:
        """The touch as stepped.doubted, which wrote the row, leaves it; bound: that before [N]."""
        if row[6] > bound:
            touch = touch.with_(force_bound=float(row[6]))
        if touch.trust.in_range and not row[7]:
            return touch.with_(trust=touch.trust.also(
                f"{touch.name} meets skin that still relaxes from a touch out of range", in_range=False))  # fmt: skip
        return touch

    def elastic(self, touches: Sequence[Touch]) -> list[Touch]:
        """The touches of elastic skin without friction that move the skin as these do, but for what is dragged along.

        Skin that is dragged along was pressed by a tool that stands where the skin came from. Skin that no tool holds
        is another matter: see `left_behind`.
        """
        out, asked = [], []
        for touch in touches:
            if touch.imprint is not None:
                continue
            way = np.zeros(3) if touch.slip is None else touch.slip.offset + touch.slip.taken
            if np.linalg.norm(way) <= MIN_OFFSET or touch.name not in self.toucher.tools:
                out.append(touch)
            else:
                pose = shifted(touch.pose_body_from_tool, -way)
                asked.append(Contact(self.toucher.tools[touch.name], pose))
        return [*out, *self.toucher.touch_all(asked)]

    def left_behind(self, touches: Sequence[Touch]) -> list[tuple[Touch, float]]:
        """Elastic touches whose motion was left behind by a tool, and the share of it that is still there [-]."""
        some = [touch for touch in touches if touch.imprint is not None and touch.name in self.toucher.tools]
        found = [(self.toucher.touch(Contact(self.toucher.tools[one.name], one.imprint.pose)), one.imprint.depth)
                 for one in some if one.imprint is not None]  # fmt: skip
        return [(touch, min(depth / touch.depth, 1.0)) for touch, depth in found if touch.presses]


def number_of(tissue: Tissue) -> int:
    """Number by which a tissue is known again; see State.tissue."""
    return crc32(tissue.numbers.tobytes())


def shape_of(layer: SoftLayer) -> int:
    """Number by which the shape of a skin is known again; see State.skin."""
    return crc32(layer.thickness.tobytes(), crc32(layer.faces.tobytes(), crc32(layer.vertices.tobytes())))


def has_other_shape(state: State, shape: int) -> bool:
    """Whether a state that remembers anything is of skin of another shape than this number's."""
    return bool(state.tools) and state.skin not in (None, shape)


def is_of_other(state: State, tissue: int) -> bool:
    """Whether a state is of other tissue than this number's, where that counts: it relaxes, or was dragged."""
    remembers = any(one.terms or one.scalars.limit > 0 for one in state.tools.values())
    return remembers and state.tissue not in (None, tissue)


def compile_steps() -> None:
    """Compiles what steps with a memory take beyond touches: a quarter of what a first start does, and no more."""
    pose, wrench, none, dt = np.eye(4), np.zeros(6), np.zeros(0), 0.01
    series, fades = (none, none), np.zeros((2, 1))
    before = np.array([fresh(pose, 0).numbers])
    patches, after, out, says = np.zeros((1, PATCH)), np.empty_like(before), np.zeros((1, OUT)), np.zeros((1, SAYS))
    stepped.asked_for(before[0], pose, wrench, *series, fades, dt)
    stepped.tell(wrench, 0.0, True, 0.0, pose, wrench, pose, False, False, 0.0, 0.0, patches[0])
    stepped.step(patches, before, after, True, *series, fades, True, *FLAT, ALONE, dt, out, says)
    stepped.doubted(before, after, *series, dt, np.zeros(1), out, says)


def _possible(contacts: Sequence[Contact], touches: Sequence[Touch], bounds: np.ndarray) -> np.ndarray:
    """Force that each may press with though it is not known to [N], (K,): all of a wrench that found no place."""
    out = bounds.copy()
    for k, (contact, touch) in enumerate(zip(contacts, touches, strict=True)):
        if contact.wrench is not None and not touch.presses and not touch.trust.in_range:
            out[k] = max(out[k], float(np.linalg.norm(contact.wrench[:3])))
    return out


def _own(memories: dict[str, Memory], contact: Contact, terms: int) -> Memory:
    """What is remembered of a contact, taken out; what another surface of its name pressed stays, as another tool's."""
    memory = memories.pop(contact.name, None)
    if memory is not None and memory.surface not in (0.0, contact.tool.number):
        memories[f"{contact.name} of surface {memory.surface:.0f}"] = memory
        memory = None
    return memory or fresh(contact.pose_body_from_tool, terms)
