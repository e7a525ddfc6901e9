"""Batch: many scenes at once, each some tools on a skin: poses in, wrenches out, on all cores; fields where asked for.

For learning and for search, where a simulator is asked about thousands of scenes that do not know of each other. Each
scene gets just what Simulator.touch gives it alone, to the bit, however many threads there are.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stmpl_core.arrays import check_count, check_dt, check_places, real
from stmpl_core.contact import Contact
from stmpl_core.errors import InvalidInput, StmplError
from stmpl_core.friction import Friction, check_tools
from stmpl_core.simulator import Simulator
from stmpl_core.skin import Skin
from stmpl_core.state import State
from stmpl_core.tool import Tool
from stmpl_core.tools import Tools

REFUSED = "refused"  # status of tools in a scene that raised an error: no force, and its sentence in `why`
SHARES = 4  # parts, for each thread, that the scenes are cut into: one slow scene holds up few others


@dataclass(frozen=True, eq=False)
class BatchTouches:
    """What tools do in n scenes. K: number of tools.

    Args:
        wrenches: force [N] and torque about each tool's origin [N m] that it exerts on its body, (n, K, 6).
        depths: depth of the deepest column under each [m]; negative when apart, NaN when far or not known, (n, K).
        force_bounds: bound on the error of each force [N]; NaN where it is not known, (n, K).
        in_range: whether each touch is one that the simulator may be trusted in, (n, K).
        statuses: see stmpl_core.touch, and REFUSED, (n, K).
        why: by scene and tool, what else is to be said of the touch.
        states: memory of each scene after this step; None: none was asked for.
        fields: motion of all vertices (V, 3) [m], by the number of each scene that was asked for it; NaN of one that is
            refused.
    """

    wrenches: np.ndarray
    depths: np.ndarray
    force_bounds: np.ndarray
    in_range: np.ndarray
    statuses: np.ndarray
    why: Mapping[tuple[int, int], str]
    states: list[State] | None
    fields: Mapping[int, np.ndarray]


class Batch:
    """n scenes on one skin or on many, with the same tools.

    Args:
        skins: a prepared skin for all scenes, or one for each (the same one may stand for several).
        tools: tools, each with a name of its own.
        n: number of scenes; None: that of the skins.
        friction: as of a Simulator.
        threads: threads that work; None: one a core. The interpreter itself is busy for about a tenth of a touch, so
            more than some eight do not help: then take several processes.

    Attributes:
        skins: skin of each scene, (n,).
        tools: tools.

    Raises:
        InvalidInput: numbers that do not fit, or what Simulator raises.
        MeshError: a tool's surface that cannot be used.
    """

    def __init__(self, skins: Skin | Sequence[Skin], tools: Sequence[Tool], n: int | None = None, *,
                 friction: Friction | Mapping[str, Friction] = None, threads: int | None = None) -> None:  # fmt: skip
        self.skins, self.tools = scenes_of(skins, tools, n)
        check_tools(friction, [tool.name for tool in self.tools])
        many = len(os.sched_getaffinity(0)) if threads is None else threads
        check_count("threads", many)
        self._friction, self._threads, self._own = friction, many, threading.local()
        self._stores: dict[int, Tools] = {}
        for skin in self.skins:  # what is slow to make is made here, once
            if id(skin) not in self._stores:
                simulator = self._make(skin)
                for tool in self.tools:
                    simulator.tools.add(tool)
                self._stores[id(skin)] = simulator.tools
        self._pool = ThreadPoolExecutor(many) if many > 1 else None

    def __len__(self) -> int:
        return len(self.skins)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled it is what it was made of, and made anew where it is read, with threads of its own."""
        return partial(type(self), friction=self._friction, threads=self._threads), (self.skins, self.tools)

    def touch(
        self, poses: Any, states: Sequence[State | None] | None = None, dt: float = 0.0, *, fields: Any = (),
        out: Any = None,
    ) -> BatchTouches:  # fmt: skip
        """What all tools do in all scenes.

        Args:
            poses: pose_body_from_tool of each tool in each scene: place [m] and unit quaternion x, y, z, w, (n, K, 7),
                or matrices, (n, K, 4, 4). Arrays of numpy, and of torch or Warp on a CPU, which are not copied. A tool
                whose pose is not finite, and all others of its scene, are REFUSED.
            states: memory of each scene from the step before, None where a scene begins; None: elastic skin without
                friction, as if nothing had been before.
            dt: time since those states [s].
            fields: numbers of the scenes whose skin's motion is wanted too, or a mask (n,); arrays, too.
            out: array that takes the wrenches, (n, K, 6), likewise; None: a new one.

        Raises:
            InvalidInput: shapes, states or numbers of scenes that do not fit, or a dt below 0 or not finite.
        """
        n, many = len(self.skins), len(self.tools)
        wanted = set(numbers_of("fields are asked for scenes", fields, n).tolist())
        matrices = _matrices(poses, n, many)
        if states is not None and not (isinstance(states, Iterable) and hasattr(states, "__len__")):
            raise InvalidInput(f"states are {states!r:.40}; a list of one State or None for each scene is needed. Of a "
                               "WarpBatch's take to_states().")  # fmt: skip
        if states is not None and len(states) != n:
            raise InvalidInput(f"{len(states)} states do not fit {n} scenes.")
        check_dt(dt)
        try:
            wrenches = np.zeros((n, many, 6)) if out is None else np.asarray(out)
        except (TypeError, ValueError, RuntimeError) as error:  # torch: on a GPU, or with a gradient
            raise InvalidInput(f"out takes no numbers: {error}.") from error
        if wrenches.shape != (n, many, 6) or (out is not None and not np.shares_memory(wrenches, np.asarray(out))):
            raise InvalidInput(f"out has shape {wrenches.shape}; ({n}, {many}, 6) is needed, on a CPU.")
        if wrenches.dtype.kind != "f" or not wrenches.flags.writeable:
            raise InvalidInput(f"out is an array of {wrenches.dtype}; floating-point numbers that may be written are "
                               "needed.")  # fmt: skip
        check_places("out", wrenches)
        depths, bounds = np.full((n, many), np.nan), np.full((n, many), np.nan)
        in_range, statuses = np.zeros((n, many), bool), np.full((n, many), REFUSED, dtype=object)
        why: dict[tuple[int, int], str] = {}
        moved: dict[int, np.ndarray] = {}
        after = None if states is None else [state or State() for state in states]

        def work(some: range) -> None:
            for i in some:
                wrenches[i] = 0.0
                try:
                    simulator = self._simulator(self.skins[i])
                    contacts = [Contact(tool, pose) for tool, pose in zip(self.tools, matrices[i], strict=True)]
                    if after is None:
                        touches = simulator.touch(contacts)
                    else:
                        touches, after[i] = simulator.touch(contacts, after[i], dt)
                    for k, touch in enumerate(touches):
                        wrenches[i, k], depths[i, k], bounds[i, k] = touch.wrench, touch.depth, touch.force_bound
                        in_range[i, k], statuses[i, k] = touch.trust.in_range, touch.status
                        if touch.trust.why:
                            why[i, k] = touch.trust.why
                    if i in wanted:
                        moved[i] = simulator.answer(touches).displacement
                except (StmplError, np.linalg.LinAlgError) as error:
                    wrenches[i], in_range[i], statuses[i] = 0.0, False, REFUSED
                    why.update({(i, k): str(error) for k in range(many)})
                    if i in wanted:
                        moved[i] = np.full((len(self.skins[i].layer.vertices), 3), np.nan)

        if self._pool is None:
            work(range(n))
        else:
            step = max(1, -(-n // (SHARES * self._threads)))
            list(self._pool.map(work, [range(i, min(i + step, n)) for i in range(0, n, step)]))
        return BatchTouches(wrenches, depths, bounds, in_range, statuses.astype(str), why, after, moved)

    def _simulator(self, skin: Skin) -> Simulator:
        """This thread's simulator of a skin: touches write to scratch space of their own."""
        own: dict[int, Simulator] | None = getattr(self._own, "simulators", None)
        if own is None:
            own = self._own.simulators = {}
        if id(skin) not in own:
            own[id(skin)] = self._make(skin)
        return own[id(skin)]

    def _make(self, skin: Skin) -> Simulator:
        return Simulator(skin, tools=self._stores.get(id(skin)), friction=self._friction)


def scenes_of(skins: Skin | Sequence[Skin], tools: Sequence[Tool], n: int | None) -> tuple[list[Skin], list[Tool]]:
    """The skin of each of n scenes, and the tools of all. Raises InvalidInput: see Batch."""
    each = list(skins) if isinstance(skins, Sequence) else [skins]
    check_count("n", len(each) if n is None else n)
    if not all(isinstance(skin, Skin) for skin in each):
        raise InvalidInput("a batch needs prepared skins. Try Skin.of(layer, MomentNet()).")
    each = each if isinstance(skins, Sequence) else each * (n or 1)
    if n is not None and len(each) != n:
        raise InvalidInput(f"{len(each)} skins do not fit {n} scenes: give one, or one for each.")
    every = list(tools) if isinstance(tools, Iterable) else []
    if not isinstance(tools, Iterable) or not all(isinstance(tool, Tool) for tool in every):
        raise InvalidInput(f"tools are {tools!r:.40}; a list of Tool is needed.")
    if not every or len({tool.name for tool in every}) < len(every):
        raise InvalidInput("a batch needs tools, each with a name of its own. Try tool.named('left').")
    return each, every


def numbers_of(what: str, scenes: Any, n: int) -> np.ndarray:
    """Numbers of some of n scenes, as they come.

    Args:
        what: what is asked of them, for the message.
        scenes: their numbers, or a mask (n,); arrays of numpy, torch and Warp on any device, too.

    Raises:
        InvalidInput: numbers that there are not, a mask of another length, or neither.
    """
    try:
        here = scenes.cpu() if type(scenes).__module__.startswith("torch") else scenes
        here = here.numpy() if hasattr(here, "numpy") else here
        found = np.asarray(here if isinstance(here, np.ndarray) else list(here))
    except (TypeError, ValueError, RuntimeError):  # of no list, of lists of unequal length, of a torch without numbers
        found = np.array("")
    if found.dtype == np.bool_ and found.shape == (n,):
        found = np.flatnonzero(found)
    elif found.shape == (0,):
        found = found.astype(np.int64)
    if found.ndim != 1 or found.dtype.kind not in "iu" or ((found < 0) | (found >= n)).any():
        raise InvalidInput(f"{what} {scenes!r:.60}; there are {n}: a list of numbers of scenes, or a mask of as many, "
                           "is needed.")  # fmt: skip
    return found.astype(np.int64)


def _matrices(poses: Any, n: int, many: int) -> np.ndarray:
    """Poses as matrices, (n, K, 4, 4); those that are not finite stay so."""
    try:
        given = np.asarray(real(poses), dtype=float)
    except (TypeError, ValueError, RuntimeError) as error:  # torch: on a GPU, or with a gradient
        raise InvalidInput(f"poses are no array of numbers: {error}.") from error
    if given.shape == (n, many, 4, 4):
        return given
    if given.shape != (n, many, 7):
        raise InvalidInput(f"poses have shape {given.shape}; ({n}, {many}, 7) or ({n}, {many}, 4, 4) is needed.")
    flat = given.reshape(-1, 7)
    size = np.linalg.norm(flat[:, 3:], axis=1)
    sound = np.isfinite(flat).all(axis=1) & (np.abs(size - 1) < 1e-3)
    out = np.full((n * many, 4, 4), np.nan)
    out[:, 3] = (0.0, 0.0, 0.0, 1.0)
    out[sound, :3, :3] = Rotation.from_quat(flat[sound, 3:]).as_matrix()
    out[:, :3, 3] = flat[:, :3]
    out[np.isfinite(flat).all(axis=1) & ~sound, :3, :3] = 0.0  # no unit quaternion: refused as not rigid
    return out.reshape(n, many, 4, 4)
