"""State: what a simulation remembers from step to step, as a value."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.errors import InvalidInput
from stmpl_core.slip import SPRINGS
from stmpl_core.wake import FIXED, PLACES

VERSION = 7  # of packed states; 6 knows no Scalars.held and what follows, 5 no strayed, 4 no slid, 3 no joints
OLDEST, UNKNOWN = 3, {3: 10, 4: 10, 5: 9, 6: 8}  # version that is still read; how many of the last Scalars one lacks
FIRST_OF_TERMS = 46  # number in a Memory behind its pose, wrench and scalars
NEVER = -2.0  # Scalars.pressing of a tool that nobody told of yet
FORGOTTEN = 1e-3  # elastic force of skin that comes back, over its largest, below which it is forgotten


class Memory:
    """What skin and tool remember of each other after a step. P: number of times of relaxation.

    Args:
        numbers: all that follows, in this order, (N,).

    Attributes:
        pose: pose of the tool, (4, 4).
        wrench: wrench that it exerted, (6,) [N, N m].
        scalars: see Scalars, in that order.
        relaxed: elastic force that has relaxed in each time, (P,) [N].
        contact: middle of the last contact, as deep as its forces sink the skin [m], its inward normal, and a tangent
            that goes with it, (3, 3).
        imprint: pose of the tool when it pressed last, (4, 4).
        stiffness: stiffness of the patch to the ways of `springs`, (3,) [N/m]; 0: no friction yet.
        springs: forces of the springs of friction without relaxation, (SPRINGS, 3) [N].
        springs_relaxed: what of them has relaxed, (P, SPRINGS, 3) [N].
        trail: places along the tool's way where the skin is not back yet (stmpl_core.wake), (PLACES, FIXED + P).
    """

    __slots__ = ("numbers",)

    def __init__(self, numbers: np.ndarray) -> None:
        self.numbers = numbers

    @property
    def terms(self) -> int:
        """P."""
        return max(len(self.numbers) - size_of(0) - PLACES * FIXED, 0) // (1 + 3 * SPRINGS + PLACES)

    def _part(self, k: int) -> np.ndarray:
        return parts_of.py_func(self.numbers, self.terms)[k]

    def _scalar(self, name: str) -> float:
        """One of the scalars, without unpacking all."""
        return float(self.numbers[22 + Scalars._fields.index(name)])

    @property
    def surface(self) -> float:
        """Scalars.surface."""
        return self._scalar("surface")

    @property
    def sunk(self) -> bool:
        """Whether the skin is not back yet."""
        return self._scalar("elastic") > FORGOTTEN * self._scalar("largest")

    pose = property(lambda self: self._part(0))
    wrench = property(lambda self: self._part(1))
    scalars = property(lambda self: Scalars(*self._part(2).tolist()))
    relaxed = property(lambda self: self._part(3))
    contact = property(lambda self: self._part(4))
    imprint = property(lambda self: self._part(5))
    stiffness = property(lambda self: self._part(6))
    springs = property(lambda self: self._part(7))
    springs_relaxed = property(lambda self: self._part(8))
    trail = property(lambda self: trail_of.py_func(self.numbers, self.terms))

    def with_(self, **parts: ArrayLike) -> Memory:
        """The same with other values of some parts."""
        out = Memory(self.numbers.copy())
        for name, values in parts.items():
            (out._part(2) if name == "scalars" else getattr(out, name))[...] = values
        return out


def size_of(terms: int, trail: bool = True) -> int:
    """How many numbers a Memory has; trail: with it."""
    places = PLACES if trail and terms else 0
    return FIRST_OF_TERMS + 28 + 3 * SPRINGS + terms * (1 + 3 * SPRINGS) + places * (FIXED + terms)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def parts_of(numbers, terms):
    """Views of the numbers of a Memory, in its order up to `springs_relaxed`."""
    at = FIRST_OF_TERMS + terms
    springs, last = at + 28, at + 28 + 3 * SPRINGS
    return (numbers[:16].reshape(4, 4), numbers[16:22], numbers[22:FIRST_OF_TERMS], numbers[FIRST_OF_TERMS:at],
            numbers[at : at + 9].reshape(3, 3), numbers[at + 9 : at + 25].reshape(4, 4), numbers[at + 25 : springs],
            numbers[springs:last].reshape(SPRINGS, 3),
            numbers[last : last + terms * 3 * SPRINGS].reshape(terms, SPRINGS, 3))  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def trail_of(numbers, terms):
    """View of the trail of a Memory that has one."""
    first, places = FIRST_OF_TERMS + 28 + 3 * SPRINGS + terms * (1 + 3 * SPRINGS), PLACES if terms else 0
    return numbers[first : first + places * (FIXED + terms)].reshape(places, FIXED + terms)


class Scalars(NamedTuple):
    """The numbers of a Memory.

    Args:
        pressing: 1 where the tool pressed, 0 where it did not, -1 where nobody told of it, NEVER before anybody did.
        elastic: force at rest of elastic skin (stmpl_core.relaxation) [N]; of skin that is free, that of the depth to
            which it has come back.
        largest: largest of it so far [N].
        net: size of the force over the sum of its parts' sizes [-].
        radius: radius of the last contact [m].
        depth: depth of the last contact [m].
        imprint_force: force at rest there [N].
        power: power of the depth with which the elastic force grows there [-].
        share: share of the contact that slid [-].
        work: work that was put into the contact and not given back [J].
        passive: factor on the wrench that kept it above 0 [-].
        limit: tangential force at which all of it slides [N]; 0 without friction.
        stretch: stretch of the column under the last contact [-].
        surface: number of the tool's surface (Tool.number): what another of its name pressed is as another tool's.
        slid: factor on the push of skin that has slid, by what it no longer carries along itself [-].
        strayed: part of what has relaxed that rests on touches out of range, at most [N].
        held: stiffness of the patch along the skin at which the springs' forces are held: the least that it had under
            them, weighed with what came when [N/m]; 0: as it is.
        rolled_first, rolled_second, rolled: where the contact is in the room that it has rolled over, by the tangents,
            and the radius of that (footing.beyond) [m].
        passed_first, passed_second, passed: the same of the room that it has slid over [m].
        doubted: 1 where the last touch was out of range.
    """

    pressing: float = NEVER
    elastic: float = 0.0
    largest: float = 0.0
    net: float = 1.0
    radius: float = 0.0
    depth: float = 0.0
    imprint_force: float = 0.0
    power: float = 1.5
    share: float = 1.0
    work: float = 0.0
    passive: float = 1.0
    limit: float = 0.0
    stretch: float = 1.0
    surface: float = 0.0
    slid: float = 1.0
    strayed: float = 0.0
    held: float = 0.0
    rolled_first: float = 0.0
    rolled_second: float = 0.0
    rolled: float = 0.0
    passed_first: float = 0.0
    passed_second: float = 0.0
    passed: float = 0.0
    doubted: float = 0.0


def fresh(pose: np.ndarray, terms: int) -> Memory:
    """Memory of a tool at a pose (4, 4) that has not touched, for skin with so many times of relaxation."""
    return Memory(np.zeros(size_of(terms))).with_(pose=pose, scalars=Scalars(), contact=np.eye(3), imprint=pose)


@dataclass(frozen=True, eq=False)
class State:
    """Memory of the tissue: goes into a step and comes out of it. Empty: nothing was touched yet.

    It can be pickled; `pack` and `unpack` are for files. Two states are the same where their `pack` is.

    Args:
        tools: memory of each tool that touches or has touched, by name.
        joints: angle of each joint of the skin's rig at which it is told [rad], in whose axes it is; empty: at rest;
            None: nobody said, which only a skin without joints may read.
        skin: number of the shape of the skin that it is of, which is not packed; None: not known.
        tissue: likewise of its tissue.
    """

    tools: Mapping[str, Memory] = field(default_factory=dict)
    joints: tuple[float, ...] | None = ()
    skin: int | None = None
    tissue: int | None = None

    @property
    def finite(self) -> bool:
        """Whether every number of it is finite."""
        return all(np.isfinite(memory.numbers).all() for memory in self.tools.values())

    def check_finite(self) -> None:
        """Raises InvalidInput where a number of it is not finite."""
        if not self.finite:
            raise InvalidInput(f"the state of {', '.join(self.tools)} has numbers that are not finite. Try an empty "
                               "State().")  # fmt: skip

    def without(self, name: str) -> State:
        """The state without what it remembers of a tool: the skin that it pressed is at rest."""
        return replace(self, tools={other: memory for other, memory in self.tools.items() if other != name})

    def pack(self) -> bytes:
        """The state as bytes, exact: a line of JSON, then float64 numbers, the least byte first."""
        names = sorted(self.tools)
        terms = max((self.tools[name].terms for name in names), default=0)
        head = json.dumps({"version": VERSION, "terms": terms, "tools": names, "joints": self.joints}) + "\n"
        numbers = [self.tools[name].numbers for name in names]
        return head.encode() + np.concatenate([*numbers, np.empty(0)]).astype("<f8").tobytes()

    @classmethod
    def unpack(cls, packed: bytes, joints: Sequence[float] | None = None) -> State:
        """The state of such bytes.

        Args:
            packed: what `pack` gave, also of older versions.
            joints: angle of each joint [rad] at which a state of version 3 was told; None: not known.

        Raises:
            InvalidInput: bytes of another kind.
        """
        if not isinstance(packed, bytes | bytearray | memoryview | np.ndarray):
            raise InvalidInput(f"a packed state is {packed!r:.40}; bytes are needed, as State.pack gives them.")
        head, _, rest = bytes(packed).partition(b"\n")
        try:
            told = json.loads(head)
            names, terms, version = list(told["tools"]), int(told["terms"]), told["version"]
            if version != OLDEST:
                joints = told["joints"]
            where = None if joints is None else tuple(map(float, joints)) if any(joints) else ()
            numbers = np.frombuffer(rest, "<f8").astype(float)
            if not 0 <= terms <= len(numbers):
                raise ValueError(f"{terms} times of relaxation in {len(numbers)} numbers")
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise InvalidInput(f"{len(packed)} bytes are not what State.pack gives, or only a part of it "
                               f"({type(error).__name__}: {error}). Try State() to begin anew.") from error  # fmt: skip
        lacks = UNKNOWN.get(version, 0)
        size = size_of(terms) - lacks
        if version not in range(OLDEST, VERSION + 1) or len(numbers) != size * len(names):
            raise InvalidInput(f"a state of version {version} with {len(numbers)} numbers cannot be read; expected are "
                               f"versions {OLDEST} to {VERSION} and {size * len(names)} numbers of {len(names)} "
                               "tools. Older ones need the release that recorded them.")  # fmt: skip
        if not np.isfinite(numbers).all():
            raise InvalidInput("a packed state holds numbers that are not finite: begin anew, with State().")
        rows = numbers.reshape(len(names), size)
        if lacks:
            rows = np.insert(rows, [FIRST_OF_TERMS - lacks] * lacks, Scalars()[-lacks:], axis=1)
        return cls({name: Memory(row) for name, row in zip(names, rows, strict=True)}, where)
