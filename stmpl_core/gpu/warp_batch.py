"""WarpBatch: Batch on a GPU, by kernels in NVIDIA Warp that also run on a CPU, where tests hold them against numba.

The law is that of stmpl_core.toucher by pose, elastic and without memory: the same lattice of contact nodes, the same
linear complementarity problem on a dense matrix for each scene, the same network. Each stage is one kernel over all
scenes, with LANES threads a scene, which are one block and share out its columns, triangles, places or nodes. What a
scene sums up is summed by one of them or by all in a fixed order (blocks.py): an answer is the same to the bit from run
to run, and the kernels have no line for one kind of device only. A scene's matrix stays in memory: a block's own has
room for 100 to 200 nodes, in float32.

Geometry and the linear problem are float64, the network float32, as in the law that runs on a CPU.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from stmpl_core.arrays import check_count, check_dt, check_places, real
from stmpl_core.batch import numbers_of, scenes_of
from stmpl_core.columns import Columns
from stmpl_core.errors import InvalidInput
from stmpl_core.friction import Friction, check_tools
from stmpl_core.gpu import answers, bears, columns, hold, lattice, looks, packs, places, stacks, sticks, twins
from stmpl_core.gpu.blocks import threads
from stmpl_core.gpu.fields import Fields
from stmpl_core.gpu.memory import Steps, WarpStates
from stmpl_core.gpu.rays import mat33
from stmpl_core.networks import shipped
from stmpl_core.skin import Skin
from stmpl_core.soundness import too_long
from stmpl_core.state import State
from stmpl_core.stepped import PATCH
from stmpl_core.tool import Tool

log = logging.getLogger(__name__)
STATUSES = ("pending", "apart", "pressed by pose", "wrapped around", "refused", "too deep", "no room")
LANES = 128  # threads that share the work of a scene on a GPU
MEMORY = {True: 16 << 30, False: 256 << 20}  # scratch space on a GPU and on a CPU [bytes]


@dataclass(frozen=True, eq=False)
class WarpTouches:
    """What tools do in n scenes, as Warp arrays on the batch's device; `wp.to_torch` shares them with torch.

    Args:
        wrenches: force [N] and torque about each tool's origin [N m] that it exerts on its body, (n, K, 6), of the
            poses' precision. 0 where a scene was refused, NaN where it is not served (see `statuses`).
        depths: depth of the deepest column under each [m]; negative when apart, NaN when far or not known, (n, K).
        force_bounds: bound on the error of each force [N]; NaN where it is not known, (n, K).
        in_range: whether each touch is one that the law may be trusted in, (n, K).
        statuses: numbers of STATUSES, (n, K) int32. "refused": a pose of the scene is not a finite rigid transform;
            "too deep": a tool of the scene is deeper than 0.9 of the thickness or inside the limb, which Batch draws
            back and this does not; "no room": a tool of the scene meets more skin than there is room for (`nodes`).
        fields: motion of the vertices of each scene that was asked for it, in the order asked, (F, V, 3) [m]; NaN where
            the scene was refused or is not served, 0 beyond the vertices of a smaller skin. None: none was asked for.
        states: memory of each scene after this step; None: none was given.
    """

    wrenches: Any
    depths: Any
    force_bounds: Any
    in_range: Any
    statuses: Any
    fields: Any = None
    states: WarpStates | None = None

    @property
    def served(self) -> np.ndarray:
        """Mask of the tools whose wrenches are answers, (n, K), on the CPU."""
        return self.statuses.numpy() < STATUSES.index("refused")


class WarpBatch:
    """n scenes on one skin or on many, with the same tools, on one device.

    Args:
        skins: a prepared skin for all scenes, or one for each (the same one may stand for several). Elastic and
            at rest: all of one material, or all stacks (living limbs, columns that run to bone).
        tools: tools, each with a name of its own.
        n: number of scenes; None: that of the skins.
        device: device as Warp names it: "cuda", "cuda:1", "cpu".
        nodes: room for contact nodes of all tools of a scene together; None: what these tools need, found out as they
            press (the first touch that needs more is answered twice).
        friction: as of a Simulator; it is felt where touches have states.
        memory: scratch space [bytes]; scenes that do not fit go one part after the other; None: 16 GiB on a GPU, but no
            more than a third of what is free, 256 MiB on a CPU, or what one scene needs. Fields take as much again.
        lanes: threads that share the work of a scene, on a GPU whole warps; None: LANES on a GPU, 1 on a CPU.

    Attributes:
        device: Warp's device.
        room: capacities for a scene.

    Raises:
        InvalidInput: numbers that do not fit, no such device, skins of both kinds, or one that joints have moved.
        MeshError: a tool's surface that cannot be used.
    """

    _scratch: Any
    _steps: Steps | None  # made when the first state is asked for
    _along: tuple[Any, ...]
    _graphs: dict[tuple[Any, ...], Any]  # of what was done at least once

    def __init__(self, skins: Skin | Sequence[Skin], tools: Sequence[Tool], n: int | None = None, *,
                 friction: Friction | Mapping[str, Friction] = None, device: str = "cuda", nodes: int | None = None,
                 memory: int | None = None, lanes: int | None = None) -> None:  # fmt: skip
        each, self.tools = scenes_of(skins, tools, n)
        for name, value, least in (("lanes", lanes, 1), ("nodes", nodes, 1), ("memory", memory, 0)):
            check_count(name, least if value is None else value, least)
        check_tools(friction, [tool.name for tool in self.tools])
        self._friction, self._steps, self._along = friction, None, ()
        self.device = _device(device)
        self._unique = unique = list({id(skin): skin for skin in each}.values())
        self._fields: Fields | None = None  # made when the first is asked for
        for skin in unique:
            _check(skin)
        if len({skin.layer.stacked for skin in unique}) > 1:
            raise InvalidInput("stacks and skins of one material do not go into one WarpBatch. Try one for each kind.")
        self._lanes = packs.whole_words(lanes or LANES) if self.device.is_cuda else lanes or 1
        self._block = threads(self._lanes, self.device)
        self._skins, fields = packs.pack(unique, self.tools, self.device)
        self.room = packs.room_for(unique, fields, nodes)
        network = packs.network_of(unique[0].layer)
        self._stacked = unique[0].layer.stacked
        self._net, self._known = packs.net(network, self.device), _known(network)
        number = {id(skin): k for k, skin in enumerate(unique)}
        self._skin_of = np.array([number[id(skin)] for skin in each], np.int32)
        room = self.room.bytes_of(len(self.tools))
        free = self.device.free_memory // 3 if self.device.is_cuda else MEMORY[False]
        self._memory = budget = max(min(MEMORY[self.device.is_cuda], free), room) if memory is None else memory
        self._grows = nodes is None
        if room > budget:
            raise InvalidInput(f"one scene needs {room} bytes of scratch space; {budget} are allowed. Raise memory, or "
                               "leave it out.")  # fmt: skip
        self._recorder = wp.Stream(self.device) if self.device.is_cuda else None
        self._make_room(self.room.nodes)

    def __len__(self) -> int:
        return len(self._skin_of)

    def _make_room(self, nodes: int) -> bool:
        """Makes scratch space with room for so many nodes of a scene; False: one scene does not fit."""
        room = self.room._replace(nodes=nodes)
        each = room.bytes_of(len(self.tools))
        if each > self._memory:
            return False
        self._scratch, self._graphs = None, {}  # given back before as much is taken again
        self.room, self._part = room, min(len(self), self._memory // each)
        self._scratch = packs.scratch(room, self._part, len(self.tools), self.device)
        self._numbers = [self._numbers_of(first) for first in range(0, len(self), self._part)]
        return True

    def at_rest(self) -> WarpStates:
        """Memory of scenes in which nothing was touched yet: what the first step with a memory takes."""
        return self._remembers().states()

    def states(self, states: Sequence[State | None]) -> WarpStates:
        """Memory of each scene as Batch or Simulator tells it, but for grooves; None: that scene begins.

        Raises:
            InvalidInput: states of another number, or of skin that relaxes otherwise or that joints have moved.
        """
        return self._remembers().states(states)

    def _remembers(self) -> Steps:
        if self._steps is None:
            self._steps = steps = Steps(self._unique, self._skin_of, self.tools, self._friction)
            orders = [Columns(skin.layer)._order for skin in self._unique]
            ends = np.cumsum([0, *map(len, orders)])
            order = np.concatenate([first + one for first, one in zip(ends, orders, strict=False)])
            self._along = tuple(wp.array(values[order] if len(values) else values, dtype=mat33, device=self.device)
                                for values in (steps.gives, steps.bends))  # fmt: skip
        return self._steps

    def touch(self, poses: Any, states: WarpStates | None = None, dt: float = 0.0, *, fields: Any = (),
              out: Any = None, fields_out: Any = None) -> WarpTouches:  # fmt: skip
        """What all tools do in all scenes.

        Args:
            poses: pose_body_from_tool of each tool in each scene: place [m] and unit quaternion x, y, z, w, (n, K, 7),
                or matrices, (n, K, 4, 4), float32 or float64. Arrays of Warp (of wp.transform, (n, K), too) and torch
                on this device are not copied; those of numpy are, to a GPU. Gradients are not passed on. A scene with
                a pose that is not finite or not rigid is refused, and no other.
            states: memory of each scene from the step before, `at_rest` at the beginning; None: elastic skin without
                friction, as if nothing had been before. Time and friction are answered on the CPU's cores, from some
                numbers of each contact. A scene that is refused stays as it was. One that is not served does, too, but
                has missed a step: where its skin relaxes or its tools rub, it is out of range from then on, until
                that would be forgotten (skin that was pressed is back, tools that rub have let go), or until it is
                reset.
            dt: time since those states [s].
            fields: numbers of the scenes whose skin's motion is wanted too, or a mask (n,); arrays on any device, too;
                not with states.
            out: array of Warp or torch on this device that takes the wrenches, (n, K, 6), of the poses' precision;
                None: a new one.
            fields_out: array that takes the fields, (F, V, 3), float32 or float64, likewise.

        Raises:
            InvalidInput: shapes, precisions, devices or numbers of scenes that do not fit; states of another batch, or
                a dt below 0 or not finite; fields with states, of skins that are not moved by one MomentNet, or one
                that there is no memory for.
        """
        n, many = len(self), len(self.tools)
        check_dt(dt)
        if states is not None and not isinstance(states, WarpStates):
            raise InvalidInput(f"states are {states!r:.40}; those of at_rest(), states(...) or a step before are "
                               "needed.")  # fmt: skip
        wanted = numbers_of("fields are asked for scenes", fields, n)
        if len(wanted) and states is not None:
            raise InvalidInput("fields of skin with a memory are not served by WarpBatch. Try Batch.")
        given = self._array("poses", poses)
        if given.shape not in ((n, many, 7), (n, many, 4, 4)):
            raise InvalidInput(f"poses have shape {given.shape}; ({n}, {many}, 7) or ({n}, {many}, 4, 4) is needed.")
        real = given.dtype
        wrenches = self._output("out", out, (n, many, 6), (real,))
        motion = None
        if len(wanted):
            self._fields = self._fields or Fields(self._unique, many, self._lanes, self._memory, self.device)
            motion = self._output("fields_out", fields_out, (len(wanted), self._fields.vertices, 3),
                                  (real, wp.float32, wp.float64))  # fmt: skip
        exact: Any = real if states is None else wp.float64
        told = wrenches
        if states is not None:
            steps = self._remembers()
            wrenches = wp.empty((n, many, 6), dtype=exact, device=self.device)
            patches = wp.zeros((n, many, PATCH), dtype=exact, device=self.device)
        depths, bounds = (wp.empty((n, many), dtype=exact, device=self.device) for _ in range(2))
        kinds: tuple[Any, Any] = wp.bool, wp.int32
        in_range, statuses = (wp.empty((n, many), dtype=kind, device=self.device) for kind in kinds)
        first = 0
        with _stream_of(poses, self.device):
            while first < n:
                if not self._answer(first, given, (wrenches, depths, bounds, in_range, statuses)):
                    first = 0  # with more room, in parts of another size
                    continue
                if states is not None:
                    self._run(bears.bear, len(self._scratch.skin), first, many, *self._along, self._skins,
                              self._scratch, wrenches, depths, bounds, in_range, statuses, patches)  # fmt: skip
                rows = np.flatnonzero((wanted >= first) & (wanted < first + self._part))
                if len(rows) and self._fields is not None:
                    if self._stacked:
                        self._play(("stick",), self._stick)
                    self._fields.move(wanted[rows] - first, rows, self._skins, self._scratch, motion)
                first += self._part
            if states is None:
                return WarpTouches(wrenches, depths, bounds, in_range, statuses, motion)
            rows, after = steps.step(patches.numpy(), states, dt)
            for to, part in ((told, rows[..., :6]), (in_range, rows[..., 7]), (statuses, rows[..., 8])):
                to.assign(np.ascontiguousarray(part, wp.dtype_to_numpy(to.dtype)))
            depths, bounds = (wp.array(np.ascontiguousarray(rows[..., at], wp.dtype_to_numpy(real)), dtype=real,
                                       device=self.device) for at in (9, 6))  # fmt: skip
        return WarpTouches(told, depths, bounds, in_range, statuses, states=after)

    def _output(self, name: str, given: Any, shape: tuple[int, ...], reals: tuple[Any, ...]) -> Any:
        """An array that takes an answer, of one of these precisions: the one given, or a new one of the first."""
        if isinstance(given, (np.ndarray, list, tuple)):
            raise InvalidInput(f"{name} is numpy's; an array of Warp or torch is needed. Try wp.from_numpy or "
                               "torch.empty.")  # fmt: skip
        found = wp.empty(shape, dtype=reals[0], device=self.device) if given is None else self._array(name, given)
        if found.shape != shape or found.dtype not in reals:
            raise InvalidInput(f"{name} has shape {found.shape} of {found.dtype.__name__}; {shape} of "
                               f"{' or '.join(real.__name__ for real in reals[-2:])} is needed.")  # fmt: skip
        check_places(name, found)
        return found

    def _array(self, name: str, values: Any) -> Any:
        """Values as a Warp array on this device, not copied but from numpy to a GPU."""
        if isinstance(values, wp.array):
            found = values
            if values.dtype in (wp.transformf, wp.transformd) and values.is_contiguous:
                exact = wp.float32 if values.dtype is wp.transformf else wp.float64
                found = wp.array(ptr=values.ptr, dtype=exact, shape=(*values.shape, 7), device=values.device)
                found._kept = values  # type: ignore[attr-defined]  # the memory is its
        elif type(values).__module__.startswith("torch"):
            try:
                found = wp.from_torch(values.detach())
            except (TypeError, RuntimeError) as error:  # of another kind of device, sparse, complex
                raise InvalidInput(f"{name} is a tensor that Warp cannot take: {error}.") from error
        else:
            try:
                plain = np.asarray(real(values))
                plain = plain if plain.dtype in (np.float32, np.float64) else plain.astype(float)
            except (TypeError, ValueError) as error:
                raise InvalidInput(f"{name} are no array of numbers: {error}.") from error
            found = wp.array(np.ascontiguousarray(plain), dtype=wp.dtype_from_numpy(plain.dtype), ndim=plain.ndim,
                             copy=self.device.is_cuda, device=self.device)  # fmt: skip
        if found.device != self.device:
            raise InvalidInput(f"{name} is on {found.device}; this batch is on {self.device}.")
        if found.dtype not in (wp.float32, wp.float64):
            raise InvalidInput(f"{name} is of {found.dtype}; float32 or float64 is needed.")
        return found

    def _numbers_of(self, first: int) -> tuple[Any, Any]:
        """Skin and distance field of each tool in each scene of a part."""
        skin = np.repeat(self._skin_of[first : first + self._part], len(self.tools)).astype(np.int32)
        field = skin * len(self.tools) + np.tile(np.arange(len(self.tools)), len(skin) // len(self.tools))
        return tuple(wp.array(values, dtype=wp.int32, device=self.device) for values in (skin, field))  # type: ignore

    def _run(self, kernel: Any, dim: int | tuple[int, int], *inputs: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=[*inputs], device=self.device, block_dim=self._block)

    def _play(self, what: tuple[Any, ...], work: Callable[[], None]) -> None:
        """Work that only scratch space takes part in: on a GPU, where a launch costs, from the second time on a graph.

        Not the first time, which loads kernels; nor where scenes go in parts, which are too large to feel a launch.
        """
        if not self.device.is_cuda or what not in self._graphs or self._part < len(self):
            self._graphs.setdefault(what)
            work()
            return
        if self._graphs[what] is None:
            with wp.ScopedStream(self._recorder, sync_enter=False), wp.ScopedCapture(stream=self._recorder) as capture:
                work()
            self._graphs[what] = capture.graph
        wp.capture_launch(self._graphs[what])

    def _answer(self, first: int, poses: Any, out: tuple[Any, ...]) -> bool:
        """Answers the scenes of one part; False: there was no room for the nodes, and now there is."""
        scratch, skins, many = self._scratch, self._skins, len(self.tools)
        scratch.skin, scratch.grid = self._numbers[first // self._part]
        tools = len(scratch.skin)
        read = places.read_quaternions if poses.ndim == 3 else places.read_matrices
        self._run(read, tools, poses, first, many, skins, scratch)
        self._play(("look",), lambda: self._look(tools))
        sides = int(scratch.busy.numpy()[0])  # one, but for tools that close around a limb
        self._play(("lay", sides), lambda: self._lay(tools, sides))
        wants = int(scratch.wants.numpy()[0])
        if wants > self.room.nodes and self._grows and self._make_room(packs.whole_words(wants + wants // 8)):
            return False
        self._play(("hold",), lambda: self._hold(tools))
        self._run(answers.answer, (tools, self._block), first, many, self._known, skins, scratch, *out)
        return True

    def _look(self, tools: int) -> None:
        """Skin that the tools touch, and how much of it they cover."""
        scratch, skins, shared, blocks = self._scratch, self._skins, (tools, self._lanes), (tools, self._block)
        self._meet(tools, 0)
        if self._stacked:
            self._run(columns.find_swept, shared, self._lanes, skins, scratch)
            self._run(columns.list_near, blocks, 2, skins, scratch)
        self._run(columns.list_faces, blocks, skins, scratch)
        self._run(columns.sink, shared, self._lanes, skins, scratch)
        self._run(columns.gather_depth, tools, skins, scratch)
        self._run(columns.widen, tools, skins, scratch)
        self._meet(tools, 1)
        self._run(looks.begin, tools, scratch)
        self._run(looks.look, shared, self._lanes, skins, scratch)
        scratch.busy.zero_()
        self._run(looks.gather_look, blocks, skins, scratch)

    def _meet(self, tools: int, again: int) -> None:
        """Columns near the tools, and their distances."""
        scratch, skins, lanes = self._scratch, self._skins, self._lanes
        self._run(columns.find_near, (tools, lanes), lanes, again, skins, scratch)
        self._run(columns.list_near, (tools, self._block), again, skins, scratch)
        self._run(columns.clear, (tools, lanes), lanes, again, skins, scratch)
        self._run(columns.gather_clearance, tools, again, skins, scratch)

    def _lay(self, tools: int, sides: int) -> None:
        """Contact nodes under the tools. The lattice is laid thrice: first to see the covered area, at two spacings."""
        scratch, skins, lanes, many = self._scratch, self._skins, self._lanes, len(self.tools)
        shared, blocks, scenes = (tools, lanes), (tools, self._block), tools // many
        scratch.nodes.zero_()
        scratch.wants.zero_()
        for what in (lattice.LOOKS, lattice.LOOKS_AGAIN, lattice.LAID):
            for side in range(sides):
                self._run(lattice.lay, blocks, side, what, skins, scratch)
                self._run(lattice.disown, shared, lanes, scratch)
                self._run(lattice.own, shared, lanes, side, skins, scratch)
                self._run(lattice.sample, blocks, what, int(side == sides - 1), skins, scratch)
                if what == lattice.LAID:
                    self._run(lattice.list_nodes, (scenes, self._block), many, side, scratch)
                    self._run(lattice.fill_nodes, (scenes, lanes), lanes, many, skins, scratch)
        self._run(lattice.tell, scenes, many, scratch)
        self._run(looks.search, shared, lanes, skins, scratch)

    def _hold(self, tools: int) -> None:
        """Pressures at the nodes: the linear problem, then the network."""
        scratch, skins, lanes, many, net = self._scratch, self._skins, self._lanes, len(self.tools), self._net
        scenes = tools // many
        shared, blocks = (scenes, lanes), (scenes, self._block)
        self._run(columns.tell_inside, tools, many, skins, scratch)
        self._run(lattice.withdraw, scenes, many, scratch)
        self._run(answers.group, scenes, many, skins, scratch)
        if many > 1:
            self._run(twins.go_on, shared, lanes, many, skins, scratch)
        self._run(stacks.fold, (scenes, self._block), many, skins, scratch)
        if self._stacked:
            self._run(stacks.find_mean, tools, many, skins, scratch)
            self._run(stacks.share_way, scenes, many, scratch)
            self._run(stacks.sink, shared, lanes, many, skins, scratch)
            self._run(stacks.meet, blocks, many, skins, scratch)
            self._run(stacks.give_way, shared, lanes, many, skins, scratch)
        self._run(stacks.respond if self._stacked else hold.respond, shared, lanes, many, skins, scratch)
        if self._stacked:
            self._run(stacks.find_kept, shared, lanes, scratch)
            self._run(stacks.temper, shared, lanes, scratch)
        self._run(hold.solve, blocks, many, 0, skins, scratch)
        self._run(hold.find_power, blocks, scratch)
        if self._stacked:
            self._run(stacks.share_given_way, (tools, self._block), many, scratch)
        self._run(twins.crowd, shared, lanes, many, skins, scratch)
        self._run(stacks.see if self._stacked else hold.see, shared, lanes, many, skins, scratch)
        self._run(hold.judge, shared, lanes, scratch, net)
        self._run(hold.layer, shared, lanes, scratch, scratch.inputs, net.w1, net.b1, scratch.one)
        self._run(hold.layer, shared, lanes, scratch, scratch.one, net.w2, net.b2, scratch.two)
        self._run(hold.layer, shared, lanes, scratch, scratch.two, net.w3, net.b3, scratch.one)
        self._run(hold.correct, shared, lanes, scratch, net)
        self._run(answers.find_highest, shared, lanes, many, skins, scratch)
        self._run(answers.find_beside, shared, lanes, many, scratch)

    def _stick(self) -> None:
        """The same for skin of stacks that sticks: of all tools of a scene together, and not as if it hardened."""
        scratch, skins, lanes, many = self._scratch, self._skins, self._lanes, len(self.tools)
        tools = len(scratch.skin)
        scenes = tools // many
        self._run(sticks.unite, tools, scratch)
        self._run(stacks.fold, (scenes, self._block), many, skins, scratch)
        self._run(stacks.find_mean, tools, many, skins, scratch)
        self._run(stacks.respond, (scenes, lanes), lanes, many, skins, scratch)
        self._run(stacks.find_kept, (scenes, lanes), lanes, scratch)
        self._run(stacks.temper, (scenes, lanes), lanes, scratch)
        self._run(hold.solve, (scenes, self._block), many, 1, skins, scratch)


def _device(name: str) -> Any:
    try:
        return wp.get_device(name)
    except (RuntimeError, ValueError) as error:
        known = ", ".join(str(one) for one in wp.get_devices())
        raise InvalidInput(f"there is no device '{name}'. Available: {known}.") from error


def _check(skin: Skin) -> None:
    """Refuses a skin that the kernels do not serve."""
    if skin.rest is not None:
        raise InvalidInput("a skin that joints have moved is not served by WarpBatch yet; skin at rest is. Try Batch.")
    if many := len(too_long(skin.layer)):
        log.warning("%d triangles of the skin are so long that a tool between their corners is told as apart: remesh "
                    "the skin, or take Batch, which flags it", many)  # fmt: skip


def _known(network: str) -> Any:
    """Figures of a network's card."""
    card, out = shipped(network).card, answers.Known()
    out.scale, out.power = card["bound"]["scale"], card["bound"]["power"]
    out.uneven = card["bound"].get("uneven", 0.0)
    out.pressure, out.depth = card["ranges"]["p_over_e"][1], card["ranges"]["depth_over_thickness"][1]
    return out


def _stream_of(poses: Any, device: Any) -> Any:
    """On a GPU, torch's stream where the poses are torch's: so nothing is read before it is written."""
    if device.is_cuda and type(poses).__module__.startswith("torch"):
        return wp.ScopedStream(wp.stream_from_torch(poses.device))
    return nullcontext()
