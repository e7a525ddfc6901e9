"""Memory: what skin and tools of many scenes remember, and what time, friction and energy make of their touches.

The law is that of stmpl_core.history, tool by tool by the same compiled functions, for contacts by pose, and on the
processor's cores beside the GPU: it takes some numbers of each contact as a whole, and no node. What is left out is the
trail of grooves (stmpl_core.wake), which moves skin and changes no force.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np

from stmpl_core.batch import numbers_of
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction, coefficients
from stmpl_core.green import Green
from stmpl_core.history import ALONE, has_other_shape, is_of_other, number_of, shape_of
from stmpl_core.relaxation import RADII, fading, series_of
from stmpl_core.sideways import Sideways, beside, fading_aside
from stmpl_core.skin import Skin
from stmpl_core.state import FORGOTTEN, NEVER, Memory, State, fresh, size_of
from stmpl_core.stepped import FRICTION, HOLDS, NUMBER, OUT, SAYS, doubted, step
from stmpl_core.tool import Tool

FEW = 64  # scenes that are not shared among threads
LOST = 4  # number of the first status (warp_batch.STATUSES) with which a scene is not served: refused; then time stands


class WarpStates:
    """Memory of each scene of a WarpBatch after a step, as a value: what goes into the next. On the CPU.

    Args:
        rows: what every tool of every scene remembers, but for its trail: rows of Memory, (n, K, .), as long as those
            of the skin with most times of relaxation.
        missed: share of what a step that was not served may have left of each tool's touch that is still there, (n, K);
            a scene that has any is out of range.
        steps: the batch's.
    """

    def __init__(self, rows: np.ndarray, missed: np.ndarray, steps: Steps) -> None:
        self.rows, self.missed, self._steps = rows, missed, steps

    def __len__(self) -> int:
        return len(self.rows)

    def reset(self, scenes: Any) -> WarpStates:
        """A copy, of which some scenes begin anew; these states stay as they are.

        Args:
            scenes: their numbers, or a mask (n,); arrays of numpy, torch and Warp on any device, too.

        Raises:
            InvalidInput: numbers that there are not, a mask of another length, or neither.
        """
        which = numbers_of("scenes to reset are", scenes, len(self))
        out, missed = self.rows.copy(), self.missed.copy()
        out[which], missed[which] = self._steps.fresh[which], 0.0
        return WarpStates(out, missed, self._steps)

    def to_states(self) -> list[State]:
        """The memory of each scene as Batch and Simulator take it, without grooves.

        What skin remembers in a scene that missed a step is told as of a touch out of range; that tools which rub
        missed it is not told.
        """
        return [self._steps.state(self, i) for i in range(len(self))]


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
        fresh: rows of scenes in which nothing was touched yet, see WarpStates.
        made_of: by name, what states of this batch are of.
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
        series = [series_of(skin.layer.typical.tissue, t) for skin, t in zip(skins, middle, strict=True)]
        self._terms = np.array([len(one.times) for one in series])
        most = int(self._terms.max())
        self.fresh = np.zeros((len(of), len(tools), size_of(most, trail=False)))
        begun = [fresh(np.eye(4), terms).numbers[: size_of(terms, trail=False)] for terms in self._terms]
        for row, k in zip(self.fresh, of.tolist(), strict=True):
            row[:, : len(begun[k])] = begun[k]
        shares, times = np.zeros((len(skins), most)), np.ones((len(skins), most))
        for k, one in enumerate(series):
            shares[k, : len(one.times)], times[k, : len(one.times)] = one
        fades = np.zeros((len(skins), 2 + most, RADII[-1]))
        rubs = bool((self._mu > 0).any())
        for skin, t, rows, terms in zip(skins, middle, fades, self._terms, strict=True):
            rows[:2] = fading(skin.layer.typical.tissue, t)
            if rubs:
                rows[2 : 2 + terms] = fading_aside(skin.layer.typical.tissue, t)
        self._tissues = [number_of(skin.layer.tissue) for skin in skins]
        self._shapes = [shape_of(skin.layer) for skin in skins]
        kinds, scenes = (np.array(one)[of].tolist() for one in (self._tissues, self._shapes))
        self.made_of = {"scenes": len(of), "tools": [(tool.name, tool.number) for tool in tools], "skins": scenes,
                        "tissue": kinds}  # fmt: skip
        self._series = shares, times, fades
        self._skins = np.array([float(skin.layer.tissue.skin is not None) for skin in skins])
        self.gives, self.bends = _along_skin(skins) if rubs else (np.empty((0, 3, 3)), np.empty((0, 3, 3)))
        aside = [Sideways(skin.layer.typical) for skin in skins] if rubs else []
        near = rubs and len(tools) > 1
        self._beside = np.array([beside(skin.layer.typical.tissue, t) if near else ALONE
                                 for skin, t in zip(skins, middle, strict=True)])  # fmt: skip
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
            InvalidInput: states of another number, or of skin that relaxes otherwise, is another or stood elsewhere.
        """
        n, out = len(self._of), self.fresh.copy()
        if given is not None and len(given) != n:
            raise InvalidInput(f"{len(given)} states do not fit {n} scenes.")
        for i, state in enumerate(given or ()):
            if state is not None and state.joints not in ((), None):
                raise InvalidInput(f"state {i} is of skin that joints have moved, which WarpBatch does not serve.")
            for k, tool in enumerate(self.tools):
                memory = None if state is None else state.tools.get(tool.name)
                if memory is None or memory.surface not in (0.0, self._numbers[k]):
                    continue
                if memory.terms != self._terms[self._of[i]]:
                    raise InvalidInput(f"state {i} is of skin with {memory.terms} times of relaxation; its has "
                                       f"{self._terms[self._of[i]]}. Try None.")  # fmt: skip
                size = size_of(memory.terms, trail=False)
                out[i, k, :size] = memory.numbers[:size]
            if state is not None and has_other_shape(state, self._shapes[self._of[i]]):
                raise InvalidInput(f"state {i} is of skin of another shape than its. Try None.")
            if state is not None and is_of_other(state, self._tissues[self._of[i]]):
                raise InvalidInput(f"state {i} is of other tissue than its skin. Try None.")
        return WarpStates(out, np.zeros(out.shape[:2]), self)

    def state(self, states: WarpStates, i: int) -> State:
        """The memory of one scene, of all."""
        terms, found = int(self._terms[self._of[i]]), {}
        for tool, row, missed in zip(self.tools, states.rows[i], states.missed[i], strict=True):
            numbers, size = np.zeros(size_of(terms)), size_of(terms, trail=False)
            numbers[:size] = row[:size]
            if (memory := Memory(numbers)).scalars.pressing > NEVER:
                if missed > 0 and terms:
                    relaxed = float(self._series[0][self._of[i], :terms] @ memory.relaxed)
                    memory = memory.with_(scalars=memory.scalars._replace(strayed=max(relaxed, 0.0), doubted=1.0))
                found[tool.name] = memory
        return State(found, skin=self._shapes[self._of[i]], tissue=self._tissues[self._of[i]])

    def step(self, patches: np.ndarray, states: WarpStates, dt: float) -> tuple[np.ndarray, WarpStates]:
        """Touches a step after some states: rows of PATCH up to the depth, (n, K, OUT), and the states then.

        Args:
            patches: what contacts are, of elastic skin without friction, (n, K, PATCH); friction is written there.
            states: memory of the step before, which stays as it is.
            dt: time since then [s].

        Raises:
            InvalidInput: states of another batch.
        """
        before, of = states.rows, states._steps
        if of is not self and (other := [name for name, one in self.made_of.items() if of.made_of[name] != one]):
            raise InvalidInput(f"states of another batch do not fit: its {' and '.join(other)} are other. Begin with "
                               "those of this batch's at_rest().")  # fmt: skip
        out, after, missed = patches[:, :, :OUT].copy(), before.copy(), states.missed.copy()
        what = (patches, before, after, missed, self._of, self._terms, *self._series, self._mu, self._numbers,
                self._skins, self._tables, self._logs, self._sizes, self._beside, dt, out)  # fmt: skip
        n, part = len(patches), max(FEW, -(-len(patches) // self._threads))
        if n > part:
            list(self._pool.map(lambda at: _step_some(at, min(at + part, n), *what), range(0, n, part)))
        else:
            _step_some(0, n, *what)
        return out, WarpStates(after, missed, self)


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
def _step_some(first, end, patches, before, after, missed, of, terms, shares, times, fades, mu, numbers, skins, tables,
               logs, sizes, beside, dt, out):  # fmt: skip
    """See Steps.step: some of the scenes. Writes what is `missed` after it, see WarpStates, over that before."""
    says = np.zeros((patches.shape[1], SAYS))
    for s in range(first, end):
        served = True
        for k in range(patches.shape[1]):
            served = served and patches[s, k, 8] < LOST
        if served:
            i, says[:] = of[s], 0.0
            p, wide, many = terms[i], tables.shape[1], int(sizes[i, 2])
            for k in range(patches.shape[1]):
                patches[s, k, FRICTION], patches[s, k, NUMBER] = mu[k], numbers[k]
            step(patches[s], before[s], after[s], False, shares[i, :p], times[i, :p], fades[i], skins[i] > 0,
                 tables[i, :many], logs[i, :many], logs[i, wide:], sizes[i, 0], sizes[i, 1], beside[i], dt,
                 out[s], says)  # fmt: skip
            if p:
                doubted(before[s], after[s], shares[i, :p], times[i, :p], dt, out[s, :, 6].copy(), out[s], says)
            if _still_missed(missed[s], out[s], mu, shares[i, :p], times[i, :p], dt):
                out[s, :, 7] = 0.0
        else:
            for k in range(patches.shape[1]):  # of a scene that is refused time stands
                if patches[s, k, 8] > LOST and (terms[of[s]] or mu.max() > 0):
                    missed[s, :] = 1.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _still_missed(missed, out, mu, shares, times, dt):
    """Whether anything is left of a step that a scene missed, after one that is served; writes what of each tool's.

    Args:
        missed: see WarpStates, (K,).
        out: rows of OUT, (K, .).
        mu: coefficients of friction, (K,).
        shares, times: series of the relaxation, (P,) each.
        dt: time of the step [s].
    """
    fade = 0.0 if len(times) == 0 else np.exp(-dt * (1 - shares.sum()) / times[len(times) - 1])  # skin that is free
    for k in range(len(missed)):
        if not (mu[k] > 0 and out[k, 8] == HOLDS):  # what is dragged stays until the tool lets go
            missed[k] *= fade
        if missed[k] < FORGOTTEN:
            missed[k] = 0.0
    return missed.max() > 0
