"""Memory: what skin and tools of many scenes remember, and what time, friction and energy make of their touches.

The law is that of stmpl_core.history, tool by tool by the same compiled functions, for contacts by pose, and on the
processor's cores beside the GPU: it takes some numbers of each contact as a whole, and no node. What is left out is the
trail of grooves (stmpl_core.wake), which moves skin and changes no force.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numba
import numpy as np

from stmpl_core.balance import MUCH, UNSURE, settled, work_of
from stmpl_core.errors import InvalidInput
from stmpl_core.footing import aged, borne, part_of_way
from stmpl_core.friction import Friction, coefficients
from stmpl_core.green import Green
from stmpl_core.history import LOST, MOST_DRAGGED, PILED, ROUND, RUBBED, STRAYED
from stmpl_core.relaxation import depth_left, fading, let_go, series_of, stretch
from stmpl_core.sideways import Sideways, _interpolated
from stmpl_core.skin import Skin
from stmpl_core.slip import MOST_GROWN, rub
from stmpl_core.state import FORGOTTEN, Memory, Scalars, State, fresh
from stmpl_core.tool import Tool
from stmpl_core.touch import MIN_ONE_WAY_SHARE
from stmpl_core.wake import untouched

# Rows of what a kernel tells of each contact (stmpl_core.gpu.bears): wrench 0 to 5, bound, in range, status, depth;
# sum of the forces [N], middle 11 to 13 [m], radius, lever, thickness, energy, see footing.patch_of; power of the
# depth, share that skin carries along itself, radius of all that presses [m]; how it gives, 21 to 29 [m/N], how skin
# bends there, 30 to 38 [1/m]; turn and place of its pose, 39 to 50.
PATCH = 51
FEW = 64  # scenes that are not shared among threads
NONE, NO_PLACE = np.zeros(6), np.zeros(3)
_part_of_way = numba.njit(cache=True, error_model="numpy")(part_of_way)
(PRESSING, ELASTIC, LARGEST, NET, RADIUS, DEPTH, IMPRINT_FORCE, POWER, SHARE, WORK, PASSIVE, LIMIT, STRETCH, SURFACE,
 SLID, STRAYS, HELD, ROLLED, _, _, PASSED, _, _, DOUBTED) = range(len(Scalars._fields))  # fmt: skip


class Memories(NamedTuple):
    """What every tool of every scene remembers: see Memory, but for the trail. P: most times of relaxation.

    Args:
        told: whether the tool was told of before, (n, K).
        pose, wrench, scalars, relaxed, contact, imprint, stiffness, springs, springs_relaxed: (n, K, .) each.
    """

    told: np.ndarray
    pose: np.ndarray
    wrench: np.ndarray
    scalars: np.ndarray
    relaxed: np.ndarray
    contact: np.ndarray
    imprint: np.ndarray
    stiffness: np.ndarray
    springs: np.ndarray
    springs_relaxed: np.ndarray

    @classmethod
    def fresh(cls, n: int, tools: int, terms: int) -> Memories:
        """Of n scenes in which nothing was touched yet."""
        one = fresh(np.eye(4), terms)
        parts = [np.broadcast_to(np.asarray(getattr(one, name), float), (n, tools, *np.shape(getattr(one, name))))
                 for name in cls._fields[1:]]  # fmt: skip
        return cls(np.zeros((n, tools), np.bool_), *(part.copy() for part in parts))


class WarpStates:
    """Memory of each scene of a WarpBatch after a step, as a value: what goes into the next. On the CPU.

    Args:
        memories: the numbers.
        steps: the batch's.
    """

    def __init__(self, memories: Memories, steps: Steps) -> None:
        self.memories, self._steps = memories, steps

    def __len__(self) -> int:
        return len(self.memories.told)

    def reset(self, scenes: Any) -> WarpStates:
        """The same, of which some scenes begin anew.

        Args:
            scenes: their numbers, or a mask (n,); arrays of numpy, torch and Warp on any device, too.

        Raises:
            InvalidInput: numbers that there are not.
        """
        here = scenes.cpu() if type(scenes).__module__.startswith("torch") else scenes
        which, n = np.asarray(here.numpy() if hasattr(here, "numpy") else list(here)), len(self)
        if which.dtype == np.bool_ and which.shape == (n,):
            which = np.flatnonzero(which)
        if len(which) and (which.dtype.kind not in "iu" or which.min() < 0 or which.max() >= n):
            raise InvalidInput(f"scenes to reset are {which!r:.60}; numbers from 0 to {n - 1}, or a mask, are needed.")
        out = Memories(*(part.copy() for part in self.memories))
        new = Memories.fresh(1, out.told.shape[1], out.relaxed.shape[2])
        for part, begins in zip(out, new, strict=True):
            part[which.astype(int)] = begins
        return WarpStates(out, self._steps)

    def to_states(self) -> list[State]:
        """The memory of each scene as Batch and Simulator take it, without grooves."""
        return [self._steps.state(self.memories, i) for i in range(len(self))]


class Steps:
    """Time, friction and balance of energy in the scenes of a WarpBatch.

    Args:
        skins: skins, each once.
        of: number of the skin of each scene, (n,).
        tools: tools.
        friction: as of a Simulator.

    Attributes:
        gives, bends: by vertex of all skins, as they come, how a contact gives there [m/N] and skin bends [1/m],
            (., 3, 3); none where nothing rubs.
    """

    def __init__(self, skins: Sequence[Skin], of: np.ndarray, tools: Sequence[Tool],
                 friction: Friction | Mapping[str, Friction]) -> None:  # fmt: skip
        every, some = coefficients(friction)
        self.tools, self._of = list(tools), of
        self._threads = len(os.sched_getaffinity(0))
        self._pool = ThreadPoolExecutor(self._threads)
        self._mu = np.array([some.get(tool.name, every) for tool in tools])
        self._numbers = np.array([float(tool.number) for tool in tools])
        middle = [float(np.median(skin.layer.thickness)) for skin in skins]
        series = [series_of(skin.layer.tissue, t) for skin, t in zip(skins, middle, strict=True)]
        self._terms = np.array([len(one.times) for one in series])
        self.most = int(self._terms.max())
        shares, times = np.zeros((len(skins), self.most)), np.ones((len(skins), self.most))
        for k, one in enumerate(series):
            shares[k, : len(one.times)], times[k, : len(one.times)] = one
        fades = np.array([fading(skin.layer.tissue, t) for skin, t in zip(skins, middle, strict=True)])
        self._series = shares, times, fades
        self._skins = np.array([float(skin.layer.tissue.skin is not None) for skin in skins])
        rubs = bool((self._mu > 0).any())
        self.gives, self.bends = _along_skin(skins) if rubs else (np.empty((0, 3, 3)), np.empty((0, 3, 3)))
        aside = [Sideways(skin.layer) for skin in skins] if rubs else []
        wide = max((len(one._table) for one in aside), default=1)
        self._tables = np.zeros((len(skins), wide, len(aside[0]._logs) if rubs else 1, 3))
        self._logs, self._sizes = np.zeros((len(skins), wide + self._tables.shape[2])), np.zeros((len(skins), 3))
        for k, one in enumerate(aside):
            many = len(one._table)
            self._tables[k, :many] = one._table
            self._logs[k, :many], self._logs[k, wide:] = one._log_thickness, one._logs
            self._sizes[k] = one._modulus, one._slack, many

    def states(self, given: Sequence[State | None] | None = None) -> WarpStates:
        """Memory of all scenes: of none of them, or as Batch tells it.

        Raises:
            InvalidInput: states of another number, or of skin that relaxes otherwise or stood elsewhere.
        """
        n, out = len(self._of), Memories.fresh(len(self._of), len(self.tools), self.most)
        if given is not None and len(given) != n:
            raise InvalidInput(f"{len(given)} states do not fit {n} scenes.")
        for i, state in enumerate(given or ()):
            if state is not None and state.joints not in ((), None):
                raise InvalidInput(f"state {i} is of skin that joints have moved, which WarpBatch does not serve.")
            for k, tool in enumerate(self.tools):
                memory = None if state is None else state.tools.get(tool.name)
                if memory is None or memory.scalars.surface not in (0.0, self._numbers[k]):
                    continue
                if len(memory.relaxed) != self._terms[self._of[i]]:
                    raise InvalidInput(f"state {i} is of skin with {len(memory.relaxed)} times of relaxation; its has "
                                       f"{self._terms[self._of[i]]}. Try None.")  # fmt: skip
                out.told[i, k], p = True, len(memory.relaxed)
                for name in Memories._fields[1:]:
                    to, value = getattr(out, name)[i, k], np.asarray(getattr(memory, name))
                    (to[:p] if name.endswith("relaxed") else to)[...] = value
        return WarpStates(out, self)

    def state(self, memories: Memories, i: int) -> State:
        """The memory of one scene."""
        p, found = int(self._terms[self._of[i]]), {}
        for k, tool in enumerate(self.tools):
            if memories.told[i, k]:
                parts = {name: getattr(memories, name)[i, k].copy() for name in Memories._fields[1:]}
                parts |= {name: parts[name][:p] for name in ("relaxed", "springs_relaxed")}
                found[tool.name] = Memory(**parts | {"scalars": Scalars(*parts["scalars"].tolist()),
                                                     "trail": untouched(p)})  # fmt: skip
        return State(found)

    def step(self, patches: np.ndarray, states: WarpStates, dt: float, by_pose: int, apart: int, lost: int
             ) -> tuple[np.ndarray, WarpStates]:  # fmt: skip
        """Touches a step after some states: rows of PATCH up to the depth, (n, K, 10), and the states then.

        Args:
            patches: what contacts are, of elastic skin without friction, (n, K, PATCH).
            states: memory of the step before, which stays as it is.
            dt: time since then [s].
            by_pose, apart, lost: statuses: a tool presses, is off, and the first with which it is not served.

        Raises:
            InvalidInput: states of another batch.
        """
        before = states.memories
        if before.scalars.shape[:2] != patches.shape[:2] or before.relaxed.shape[2] != self.most:
            raise InvalidInput(f"states of {len(states)} scenes and {before.scalars.shape[1]} tools do not fit; "
                               "begin with those of this batch's at_rest().")  # fmt: skip
        out, after = patches[:, :, :10].copy(), Memories(*(part.copy() for part in before))
        what = (patches, before, after, self._of, self._terms, *self._series, self._mu, self._numbers, self._skins,
                self._tables, self._logs, self._sizes, dt, by_pose, apart, lost, out)  # fmt: skip
        n, step = len(patches), max(FEW, -(-len(patches) // self._threads))
        if n > step:
            list(self._pool.map(lambda at: _step_some(at, min(at + step, n), *what), range(0, n, step)))
        else:
            _step_some(0, n, *what)
        return out, WarpStates(after, self)


def _along_skin(skins: Sequence[Skin]) -> tuple[np.ndarray, np.ndarray]:
    """See Steps.gives and Steps.bends."""
    gives, bends = [], []
    for skin in skins:
        layer, near, every = skin.layer, skin.near, np.arange(len(skin.layer.vertices))
        green = Green.of(layer)
        give = np.zeros((len(every), 3, 3)) if green.drag is None else green._give / layer.tissue.youngs_modulus
        gives.append(give)
        bends.append(near.bent_at(every)[:, :9].reshape(-1, 3, 3) / near.thickness[:, None, None])
    return np.concatenate(gives), np.concatenate(bends)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step_some(first, end, patches, before, after, of, terms, shares, times, fades, mu, numbers, skins, tables, logs,
               sizes, dt, by_pose, apart, lost, out):  # fmt: skip
    """See Steps.step: some of the scenes."""
    for s in range(first, end):
        served = True
        for k in range(patches.shape[1]):
            served = served and patches[s, k, 8] < lost
        if served:
            i = of[s]
            p, wide, many = terms[i], tables.shape[1], int(sizes[i, 2])
            _step(patches[s], before, after, s, shares[i, :p], times[i, :p], fades[i], mu, numbers, skins[i] > 0,
                  tables[i, :many], logs[i, :many], logs[i, wide:], sizes[i, 0], sizes[i, 1], dt, by_pose, apart,
                  out[s])  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gone(before, after, point):
    """Way of a tool's point, that is at `point` (3,) before, between poses (4, 4), (3,) [m]: history._gone."""
    out = np.empty(3)
    for x in range(3):
        out[x] = after[x, 3] - point[x]
        for y in range(3):
            inside = 0.0
            for z in range(3):
                inside += before[z, y] * (point[z] - before[z, 3])
            out[x] += after[x, y] * inside
    return out


@numba.njit(inline="always", error_model="numpy")
def _step(patch, before, after, s, shares, times, fades, mu, numbers, has_skin, table, log_thickness, logs, modulus,
          slack, dt, by_pose, apart, out):  # fmt: skip
    """One scene: tool by tool, then what all together have of energy, and what of it may be believed."""
    tools, p = len(patch), len(times)
    stored, whole, goings = np.zeros(tools), np.zeros(tools), np.zeros(tools)
    works, givens, doubts, rubs = np.zeros(tools), np.zeros(tools), np.zeros(tools), np.zeros((tools, 3))
    for k in range(tools):
        stored[k], whole[k], goings[k], works[k], doubts[k], givens[k] = _one(
            patch[k], before, after, s, k, shares, times, fades, mu[k], numbers[k], has_skin, table, log_thickness,
            logs, modulus, slack, dt, by_pose, apart, rubs[k], out[k])  # fmt: skip
    # balance.balanced
    spares = np.zeros(tools)
    for k in range(tools):
        new = not (before.told[s, k] and before.scalars[s, k, PRESSING] >= 0)
        work = works[k] + before.scalars[s, k, WORK]
        works[k] = max(work, stored[k] if new else min(stored[k], work + doubts[k]))
        spares[k] = UNSURE * after.scalars[s, k, LARGEST] * after.scalars[s, k, DEPTH]
    factors = settled(works, givens, spares, stored, whole)
    for k in range(tools):
        new, passive = after.scalars[s, k], factors[k]
        if passive < 1:
            square = 0.0
            for x in range(3):
                square += (out[k, x] - rubs[k, x]) ** 2
            less = (1 - passive) * np.sqrt(square)
            out[k, 6] = out[k, 6] * passive + less
            for x in range(6):
                out[k, x] *= passive
                after.wrench[s, k, x] = out[k, x]
            if less > MUCH * new[LARGEST]:
                out[k, 7] = 0.0
        new[WORK], new[PASSIVE] = works[k], passive
    # history._doubted, then _after_others
    for k in range(tools):
        if p:
            new, old = after.scalars[s, k], before.scalars[s, k]
            has, had = 0.0, 0.0
            for i in range(p):
                has += shares[i] * after.relaxed[s, k, i]
                had += shares[i] * before.relaxed[s, k, i] if before.told[s, k] else 0.0
            relaxed, doubted = max(has, 0.0), not out[k, 7] > 0
            strayed = 0.0
            if old[STRAYS] > 0:
                if new[PRESSING] > 0:
                    strayed = max(min(old[STRAYS] * np.exp(-dt / times[p - 1] - goings[k]), has), 0.0)
                else:
                    strayed = old[STRAYS] * max(has, 0.0) / max(had, 1e-300)
            if doubted or old[DOUBTED] > 0:
                more = 0.0
                for i in range(p):
                    more -= shares[i] * np.expm1(-dt / times[i])
                strayed = min(strayed + max(new[ELASTIC], old[ELASTIC]) * more, relaxed)
            new[STRAYS], new[DOUBTED] = strayed, 1.0 if doubted else 0.0
            sunk = new[ELASTIC] > FORGOTTEN * new[LARGEST]
            if (new[PRESSING] > 0 or sunk) and strayed > STRAYED * new[ELASTIC] > 0:
                out[k, 7] = 0.0
    for k in range(tools):
        if p and tools > 1 and out[k, 8] == by_pose:
            new, owed = after.scalars[s, k], 0.0
            for other in range(tools):
                its = after.scalars[s, other]
                if other != k and not its[PRESSING] > 0 and its[ELASTIC] > FORGOTTEN * its[LARGEST]:
                    far = 0.0
                    for x in range(3):
                        far += (after.contact[s, other, 0, x] - after.contact[s, k, 0, x]) ** 2
                    near = max(1 - np.sqrt(far) / (new[RADIUS] + its[RADIUS]), 0.0)
                    for i in range(p):
                        owed += near * shares[i] * after.relaxed[s, other, i]
            out[k, 6] += max(owed, 0.0) * new[STRETCH] * new[NET]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _put(values, out):
    """Writes values (N,) to the first of another array: assignments of slices compile for seconds each."""
    for i in range(len(values)):
        out[i] = values[i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _one(patch, before, after, s, k, shares, times, fades, mu, number, has_skin, table, log_thickness, logs, modulus,
         slack, dt, by_pose, apart, rubs, out):  # fmt: skip
    """One tool, as History asks and answers it: `_asked`, `_late`, `_law` and `_free`. Writes its memory and its row.

    Returns:
        stored, whole: see Law (stmpl_core.balance) [J].
        gone: see Asked (stmpl_core.balance) [-].
        work, doubt, given: see balance.work_of [J].
    """
    p, pose, told, old = len(times), np.eye(4), before.told[s, k], before.scalars[s, k].copy()
    for x in range(3):
        pose[x, 3] = patch[48 + x]
        for y in range(3):
            pose[x, y] = patch[39 + 3 * x + y]
    was, imprint = (before.pose[s, k], before.imprint[s, k]) if told else (pose, pose)
    contact, relaxed, stiffness = before.contact[s, k], before.relaxed[s, k, :p], before.stiffness[s, k]
    known, held, radius = told and old[PRESSING] >= 0, old[PRESSING] > 0, old[RADIUS]
    at = old[PASSED : PASSED + 3]
    goes = old[LIMIT] / stiffness[0] if stiffness[0] > 0 else 0.0
    twist, gone, kept, gain, owed, _, passed = aged(
        was, pose, imprint, contact, known, held, old[SHARE], goes, radius, at, 1.0, shares, times, fades, dt,
        old[ELASTIC], relaxed)  # fmt: skip
    push, size = patch[:3].copy(), np.sqrt(patch[0] ** 2 + patch[1] ** 2 + patch[2] ** 2)
    presses, depth, power = patch[8] == by_pose and patch[10] > 0 and size > 0, patch[9], patch[18]
    if presses and known and not held and p:
        way = -_gone(pose, was, patch[11:14])
        part = _part_of_way(way, push / size, depth, patch[20], power)
        _, gone, kept, gain, owed, _, passed = aged(
            was, pose, imprint, contact, known, held, old[SHARE], goes, radius, at, part, shares, times, fades, dt,
            old[ELASTIC], relaxed)  # fmt: skip
    asked = 0.0
    if presses:
        slid_before = old[SLID] if held else 1.0
        force, elastic, at_rest, net, long, there, eased, stored, whole, doubt = borne(
            push, patch[11:14], patch[14], patch[16], patch[17], patch[10], depth, power, 1.0, contact, held, fades,
            kept, gain, owed, shares, NONE, False, slid_before)  # fmt: skip
        asked = at_rest
        if force > 0:
            by = force / elastic
            new, changed = after.scalars[s, k], by
            share, limit, slid, held_at, room = 1.0, 0.0, 1.0, 0.0, NO_PLACE
            springs, springs_relaxed = before.springs[s, k], before.springs_relaxed[s, k, :p]
            after.stiffness[s, k, :] = 0.0
            wrench = by * patch[:6]
            if mu > 0 and net > MIN_ONE_WAY_SHARE:
                bend, give = patch[30:39].copy().reshape(3, 3), patch[21:30].copy().reshape(3, 3)
                along, turn, bare = _interpolated(table, log_thickness, logs, patch[14], patch[16])
                unit = modulus * patch[14]
                (wrench, rub_at, share, offset, _, _, grown, _, _, limit, stiff, springs, springs_relaxed, bent, slid,
                 held_at, room, passed, there, besides) = rub(
                    wrench, NONE, False, there, pose[:3, 3].copy(), bend, give, mu, LOST * patch[19], force, patch[15],
                    at_rest, depth, patch[14], power, along * unit, turn * unit * patch[14] ** 2, bare * unit,
                    slack * patch[14], twist, known, held, contact, old[ELASTIC], slid_before, old[HELD],
                    old[ROLLED : ROLLED + 3].copy(), passed, springs, springs_relaxed, stiffness, shares, times,
                    dt)  # fmt: skip
                changed, doubt = grown * by, grown * doubt
                drag = rub_at[0] ** 2 + rub_at[1] ** 2 + rub_at[2] ** 2
                pressing = np.sqrt(wrench[0] ** 2 + wrench[1] ** 2 + wrench[2] ** 2)
                if has_skin:
                    besides += RUBBED * pressing + PILED * drag / pressing
                elif drag > 0:
                    around = 0.0
                    for x in range(3):
                        for y in range(3):
                            around += rub_at[x] * bend[x, y] * rub_at[y]
                    besides += ROUND * patch[16] * max(around, 0.0) / np.sqrt(drag)
                if grown >= MOST_GROWN or np.sqrt(np.sum(offset**2)) / patch[16] > MOST_DRAGGED:
                    out[7] = 0.0
                _put(rub_at[:3], rubs)
                wrench = wrench + rub_at
                stored, whole = stored + bent, whole + 2 * bent
                _put(stiff, after.stiffness[s, k])
                out[6] = (out[6] * changed + doubt if changed != 1 or doubt else out[6]) + max(besides, 0.0)
            elif changed != 1 or doubt:
                out[6] = out[6] * changed + doubt
            _put(wrench, out)
            new[:] = 0.0
            new[PRESSING], new[PASSIVE], new[WORK], new[SURFACE] = 1.0, 1.0, old[WORK], number
            new[ELASTIC], new[IMPRINT_FORCE], new[LARGEST] = at_rest, at_rest, max(at_rest, old[LARGEST])
            new[NET], new[RADIUS], new[DEPTH], new[POWER], new[STRETCH] = net, patch[14], depth, power, long
            new[SHARE], new[LIMIT], new[SLID], new[HELD] = share, limit, slid, held_at
            for x in range(3):
                new[ROLLED + x], new[PASSED + x] = room[x], passed[x]
            after.told[s, k] = True
            _put(wrench, after.wrench[s, k])
            _put(eased, after.relaxed[s, k])
            for x in range(4):
                _put(pose[x], after.pose[s, k, x])
                _put(pose[x], after.imprint[s, k, x])
            for x in range(3):
                _put(there[x], after.contact[s, k, x])
            for x in range(len(springs)):
                _put(springs[x], after.springs[s, k, x])
                for i in range(p):
                    _put(springs_relaxed[i, x], after.springs_relaxed[s, k, i, x])
            work, unsure, given = work_of(
                twist, before.wrench[s, k], wrench, contact, there, pose[:3, 3].copy(), held, True,
                old[NET] * old[PASSIVE] * old[STRETCH], net * long, relaxed, eased, shares, old[DEPTH], depth, power,
                patch[14])  # fmt: skip
            return stored, whole, gone, work, unsure, given
    if patch[8] == by_pose:
        out[:7] = 0.0
        out[7], out[8] = 1.0, apart
    return _free(pose, was, before, after, s, k, old, shares, times, dt, gone, asked, twist, out)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _free(pose, was, before, after, s, k, old, shares, times, dt, gone, asked, twist, out):
    """The same of a tool that does not hold its skin: History._free and _back; asked: force at rest it asks for [N]."""
    p, held, part, new = len(times), old[PRESSING] > 0, 1.0, after.scalars[s, k]
    contact, relaxed = before.contact[s, k], before.relaxed[s, k, :p]
    if asked == 0 and held and old[RADIUS] > 0:
        part = _part_of_way(_gone(was, pose, contact[0]), -contact[1], old[DEPTH], old[RADIUS], old[POWER])
    left, least = let_go(shares, times, dt, gone, part, old[ELASTIC] if held else 0.0, asked, relaxed)
    if held and old[IMPRINT_FORCE] > 0:
        depth = old[DEPTH] * depth_left(min(least / old[IMPRINT_FORCE], 1.0), old[POWER], 1 - old[STRETCH])
        new[STRETCH] = 1 - (1 - old[STRETCH]) * depth / old[DEPTH]
        new[DEPTH], new[IMPRINT_FORCE], new[POWER] = depth, max(least, 1e-300), 1.0
    elastic = 0.0
    for i in range(p):
        elastic += shares[i] * left[i]
    new[ELASTIC], new[SHARE], new[PASSIVE], new[PRESSING], new[HELD] = max(elastic, 0.0), 1.0, 1.0, 0.0, 0.0
    for x in range(ROLLED, PASSED + 3):
        new[x] = 0.0
    _put(left, after.relaxed[s, k])
    after.stiffness[s, k, :] = 0.0
    after.springs[s, k, :, :] = 0.0
    after.springs_relaxed[s, k, :, :, :] = 0.0
    after.told[s, k] = True
    _put(out[:6], after.wrench[s, k])
    for x in range(4):
        _put(pose[x], after.pose[s, k, x])
        if not before.told[s, k]:
            _put(pose[x], after.imprint[s, k, x])
    share = new[ELASTIC] / new[IMPRINT_FORCE] if new[ELASTIC] > 0 else 0.0
    depth = new[DEPTH] * depth_left(share, new[POWER], 1 - new[STRETCH])
    long = stretch(depth, new[DEPTH] / (1 - new[STRETCH])) if new[STRETCH] < 1 else 1.0
    work, unsure, given = work_of(
        twist, before.wrench[s, k], out[:6], contact, contact, pose[:3, 3].copy(), held, False,
        old[NET] * old[PASSIVE] * old[STRETCH], new[NET] * new[STRETCH], relaxed, left, shares, old[DEPTH], new[DEPTH],
        new[POWER], new[RADIUS])  # fmt: skip
    return 0.0, new[ELASTIC] * long * depth / (new[POWER] + 1), gone, work, unsure, given
