"""State: what a simulation remembers from step to step, as a value."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from stmpl_core.errors import InvalidInput
from stmpl_core.slip import SPRINGS
from stmpl_core.wake import untouched

VERSION = 7  # of packed states; 6 knows no Scalars.held and what follows, 5 no strayed, 4 no slid, 3 no joints
OLDEST, UNKNOWN = 3, {3: 10, 4: 10, 5: 9, 6: 8}  # version that is still read; how many of the last Scalars one lacks
FORGOTTEN = 1e-3  # elastic force of skin that comes back, over its largest, below which it is forgotten


class Memory(NamedTuple):
    """What skin and tool remember of each other after a step. P: number of times of relaxation.

    Args:
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
        trail: places along the tool's way where the skin is not back yet (stmpl_core.wake).
    """

    pose: np.ndarray
    wrench: np.ndarray
    scalars: Scalars
    relaxed: np.ndarray
    contact: np.ndarray
    imprint: np.ndarray
    stiffness: np.ndarray
    springs: np.ndarray
    springs_relaxed: np.ndarray
    trail: np.ndarray

    @property
    def slid(self) -> float:
        """The factor on the push of skin that has slid and is held still [-]."""
        return self.scalars.slid if self.scalars.pressing > 0 else 1.0


class Scalars(NamedTuple):
    """The numbers of a Memory.

    Args:
        pressing: 1 where the tool pressed, 0 where it did not, -1 where nobody told of it.
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
        surface: number of the tool's surface (Tool.number): what another surface of that name pressed is forgotten.
        slid: factor on the push of skin that has slid, by what it no longer carries along itself [-].
        strayed: part of what has relaxed that rests on touches out of range, at most [N].
        held: stiffness of the patch along the skin at which the springs' forces are held: the least that it had under
            them, weighed with what came when [N/m]; 0: as it is.
        rolled_first, rolled_second, rolled: where the contact is in the room that it has rolled over, by the tangents,
            and the radius of that (footing.beyond) [m].
        passed_first, passed_second, passed: the same of the room that it has slid over [m].
        doubted: 1 where the last touch was out of range.
    """

    pressing: float = 0.0
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

    @property
    def sunk(self) -> bool:
        """Whether the skin is not back yet."""
        return self.elastic > FORGOTTEN * self.largest


def fresh(pose: np.ndarray, terms: int) -> Memory:
    """Memory of a tool at a pose (4, 4) that has not touched, for skin with so many times of relaxation."""
    return Memory(pose, np.zeros(6), Scalars(), np.zeros(terms), np.eye(3), pose, np.zeros(3), np.zeros((SPRINGS, 3)),
                  np.zeros((terms, SPRINGS, 3)), untouched(terms))  # fmt: skip


@dataclass(frozen=True, eq=False)
class State:
    """Memory of the tissue: goes into a step and comes out of it. Empty: nothing was touched yet.

    It can be pickled; `pack` and `unpack` are for files. Two states are the same where their `pack` is.

    Args:
        tools: memory of each tool that touches or has touched, by name.
        joints: angle of each joint of the skin's rig at which it is told [rad], in whose axes it is; empty: at rest;
            None: nobody said, which only a skin without joints may read.
    """

    tools: Mapping[str, Memory] = field(default_factory=dict)
    joints: tuple[float, ...] | None = ()

    @property
    def finite(self) -> bool:
        """Whether every number of it is finite."""
        return all(np.isfinite(part).all() for memory in self.tools.values() for part in memory)

    def without(self, name: str) -> State:
        """The state without what it remembers of a tool: the skin that it pressed is at rest."""
        return replace(self, tools={other: memory for other, memory in self.tools.items() if other != name})

    def pack(self) -> bytes:
        """The state as bytes, exact: a line of JSON, then float64 numbers, the least byte first."""
        names = sorted(self.tools)
        terms = max((len(self.tools[name].relaxed) for name in names), default=0)
        head = json.dumps({"version": VERSION, "terms": terms, "tools": names, "joints": self.joints}) + "\n"
        numbers = [np.ravel(one) for name in names for one in self.tools[name]]
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
            raise InvalidInput(f"{len(packed)} bytes are no state: {error}.") from error
        shapes = [one.shape for one in map(np.asarray, fresh(np.eye(4), terms))]
        shapes[Memory._fields.index("scalars")] = (len(Scalars._fields) - UNKNOWN.get(version, 0),)
        size = sum(int(np.prod(shape)) for shape in shapes)
        if version not in range(OLDEST, VERSION + 1) or len(numbers) != size * len(names):
            raise InvalidInput(f"a state of version {version} with {len(numbers)} numbers cannot be read; expected are "
                               f"versions {OLDEST} to {VERSION} and {size * len(names)} numbers of {len(names)} "
                               "tools. Older ones need the release that recorded them.")  # fmt: skip
        return cls({name: _memory(part, shapes) for name, part in
                    zip(names, numbers.reshape(len(names), size), strict=True)}, where)  # fmt: skip


def _memory(numbers: np.ndarray, shapes: list[tuple[int, ...]]) -> Memory:
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]
    parts = [part.reshape(shape) for part, shape in zip(np.split(numbers, ends), shapes, strict=True)]
    pose, wrench, scalars, *rest = parts
    return Memory._make([pose, wrench, Scalars(*map(float, scalars)), *rest])
