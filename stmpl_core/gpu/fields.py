"""Fields: the motion of the skin in scenes that WarpBatch has answered, where it is asked for: Simulator.answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from stmpl_core.conform import PASSES
from stmpl_core.errors import InvalidInput
from stmpl_core.gpu import conforms, field_packs, motion, sticks, twins
from stmpl_core.gpu.blocks import threads
from stmpl_core.gpu.field_packs import FieldRoom
from stmpl_core.skin import Skin

UNDER, HOLDING = 256, 64  # room for vertices under the tools of a scene, and nodes, at first; it grows with need


class Fields:
    """What moves the skins of a batch.

    Args:
        skins: skins, each once, in the order in which they are packed for touches.
        tools: number of tools of a scene.
        lanes: threads that share the work of a scene.
        memory: scratch space [bytes].
        device: Warp's device.

    Attributes:
        vertices: number of vertices of the largest skin.

    Raises:
        InvalidInput: skins that no one MomentNet moves.
    """

    def __init__(self, skins: Sequence[Skin], tools: int, lanes: int, memory: int, device: Any) -> None:
        self._net, self._more = field_packs.motion_net(skins, device), field_packs.pack(skins, device)
        self.vertices = max(len(skin.layer.vertices) for skin in skins)
        coarse = max(len(green.coarse.gathered) if (green := skin.green) and green.coarse else 0 for skin in skins)
        self._room = FieldRoom(self.vertices, UNDER, tools, lanes, HOLDING, coarse)
        self._memory, self._device, self._stacked = memory, device, coarse > 0
        self._block = threads(lanes, device)
        self._scratch: Any = None

    def move(self, scenes: np.ndarray, rows: np.ndarray, skins: Any, touched: Any, out: Any) -> None:
        """Writes the motion of some scenes.

        Args:
            scenes: their numbers in the scratch space of touches, (F,).
            rows: rows of `out` that take them, (F,).
            skins, touched: skins and that scratch space.
            out: motion, (., V, 3) [m].

        Raises:
            InvalidInput: one scene needs more scratch space than there is.
        """
        done = 0
        while done < len(scenes):
            some = slice(done, done + self._fit(len(scenes) - done))
            pick, to = (wp.array(values[some], dtype=wp.int32, device=self._device) for values in (scenes, rows))
            if self._list(pick, skins, touched):
                self._answer(pick, to, skins, touched, out)
                done = some.stop

    def _fit(self, wanted: int) -> int:
        """How many of these scenes there is scratch space for, which is made."""
        room = self._room.bytes_of()
        if room > self._memory:
            raise InvalidInput(f"the field of one scene needs {room} bytes of scratch space; {self._memory} are "
                               "allowed. Raise WarpBatch's memory.")  # fmt: skip
        many = min(wanted, self._memory // room)
        if self._scratch is None or len(self._scratch.many) < many:
            self._scratch = self._room.scratch(many, self._device)
        return many

    def _list(self, pick: Any, skins: Any, touched: Any) -> bool:
        """Lists the vertices under the tools, and nodes; False: there was no room for them, and now there is."""
        field, tools, lanes, most = self._scratch, self._room.tools, self._room.lanes, {}
        field.most.zero_()
        self._run(motion.list_under, len(pick), pick, tools, skins, touched, field)
        if self._stacked:
            shared = len(pick), lanes
            self._run(motion.forget, shared, pick, lanes, tools, 1, skins, touched, field)
            self._run(sticks.find_reach, len(pick) * tools, pick, tools, touched, field)
            self._run(sticks.mark_beside, shared, pick, lanes, tools, skins, self._more, touched, field)
            self._run(sticks.list_beside, (len(pick), self._block), pick, tools, skins, touched, field)
            most["under"] = int(field.most.numpy()[0])
            field.most.zero_()
            self._run(sticks.list_holding, len(pick), pick, tools, touched, field)
            most["nodes"] = int(field.most.numpy()[0])
        else:
            most["under"] = int(field.most.numpy()[0])
        more = {name: 32 * -(-(one + one // 4) // 32) for name, one in most.items()
                if one > getattr(self._room, name)}  # fmt: skip
        if more:
            self._room, self._scratch = self._room._replace(**more), None
        return not more

    def _run(self, kernel: Any, dim: int | tuple[int, int], *inputs: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(inputs), device=self._device, block_dim=self._block)

    def _answer(self, pick: Any, to: Any, skins: Any, touched: Any, out: Any) -> None:
        field, lanes, tools, more = self._scratch, self._room.lanes, self._room.tools, self._more
        scenes, shared = len(pick), (len(pick), lanes)

        def run(kernel: Any, *inputs: Any, dim: Any = shared) -> None:
            self._run(kernel, dim, pick, lanes, tools, *inputs)

        self._run(conforms.find_way, scenes * tools, pick, tools, skins, touched, field)
        if tools > 1:
            self._run(twins.cover, (scenes * tools, tools), pick, tools, touched, field)
            self._run(twins.go_together, scenes * tools, tools, field)
        run(motion.press, skins, touched, field)
        if self._stacked:
            self._stick(pick, skins, touched)

        # What the method says.
        run(motion.forget, int(not self._stacked), skins, touched, field)
        self._run(motion.fold, scenes, pick, tools, 0, skins, touched, field)
        run(motion.mark, 0, skins, more, touched, field)
        run(motion.ask, skins, more, touched, field)
        if self._stacked:
            self._run(sticks.find_peak, (scenes, self._block), pick, tools, skins, touched, field)
        run(motion.move, skins, more, touched, field, self._net)
        self._run(motion.gain, scenes, lanes, field)
        run(motion.fill, 2 if self._stacked else 0, skins, more, touched, field)

        if self._stacked:
            self._run(sticks.hold_back, scenes, pick, tools, skins, touched, field)
            run(sticks.mix, skins, touched, field)
        else:
            self._lay(pick, skins, touched)
        run(conforms.push_out, skins, touched, field)
        other: Any = wp.float64 if out.dtype is wp.float32 else wp.float32
        none = wp.empty((0, 0, 0), dtype=other, device=self._device)
        both = (out, none) if out.dtype is wp.float32 else (none, out)
        self._run(conforms.hand_out, shared, pick, to, lanes, tools, skins, more, touched, field, *both)

    def _stick(self, pick: Any, skins: Any, touched: Any) -> None:
        """The linear motion of skin that sticks, and the pressures that the method adds to it."""
        field, lanes, tools, more = self._scratch, self._room.lanes, self._room.tools, self._more
        scenes, shared = len(pick), (len(pick), lanes)

        def run(kernel: Any, *inputs: Any, dim: Any = shared) -> None:
            self._run(kernel, dim, pick, lanes, tools, *inputs)

        run(sticks.go, skins, touched, field)
        run(sticks.fill_blocks, skins, more, touched, field)
        if tools > 1:
            self._run(twins.trace, shared, lanes, field)
            self._run(twins.give_way, shared, pick, lanes, touched, field)
        self._run(sticks.solve, (scenes, self._block), field)
        run(motion.forget, 1, skins, touched, field)
        run(sticks.mark, skins, more, touched, field)
        run(motion.ask, skins, more, touched, field)
        run(sticks.move, skins, more, touched, field)
        run(motion.fill, 1, skins, more, touched, field)
        self._run(sticks.hand, shared, pick, lanes, touched, field)
        run(sticks.move_limb, skins, touched, field)
        run(sticks.add_limb, skins, touched, field)
        run(sticks.share_out, skins, touched, field, dim=(scenes * tools, lanes))
        run(sticks.spread, skins, touched, field)

    def _lay(self, pick: Any, skins: Any, touched: Any) -> None:
        """What is touched lies on its tool, and the rest comes along."""
        field, lanes, tools, more = self._scratch, self._room.lanes, self._room.tools, self._more
        scenes, shared = len(pick), (len(pick), lanes)

        def run(kernel: Any, *inputs: Any, dim: Any = shared) -> None:
            self._run(kernel, dim, pick, lanes, tools, *inputs)

        run(conforms.lie, skins, touched, field, dim=(scenes * tools, lanes))
        self._run(motion.fold, scenes, pick, tools, 1, skins, touched, field)
        run(conforms.begin, skins, more, touched, field)
        for _ in range(PASSES):
            run(conforms.want, skins, touched, field)
            self._correct(scenes)
        run(motion.forget, 0, skins, touched, field)
        run(motion.mark, 1, skins, more, touched, field)
        run(motion.ask, skins, more, touched, field)
        run(conforms.spread, skins, more, touched, field)
        run(motion.fill, 1, skins, more, touched, field)

    def _correct(self, scenes: int) -> None:
        """Moves the vertices under tools as they should still move."""
        field, lanes = self._scratch, self._room.lanes
        self._run(conforms.list_wanted, scenes, field)
        self._run(conforms.set_up, (scenes, lanes), lanes, field)
        self._run(conforms.solve, (scenes, self._block), field)
        self._run(conforms.follow, (scenes, lanes), lanes, field)
