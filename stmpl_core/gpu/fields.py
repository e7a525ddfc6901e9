"""Fields: the motion of the skin in scenes that WarpBatch has answered, where it is asked for: Simulator.answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from stmpl_core.conform import PASSES
from stmpl_core.errors import InvalidInput
from stmpl_core.gpu import conforms, field_packs, motion
from stmpl_core.gpu.field_packs import FieldRoom
from stmpl_core.skin import Skin

UNDER = 256  # room for vertices under the tools of a scene at first; it grows where more are met


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
        if any(skin.layer.stacked for skin in skins):
            raise InvalidInput("fields of stacks (living limbs) are not served by WarpBatch yet, only what tools do to "
                               "them. Try Batch.")  # fmt: skip
        self._net, self._more = field_packs.motion_net(skins, device), field_packs.pack(skins, device)
        self.vertices = max(len(skin.layer.vertices) for skin in skins)
        self._room = FieldRoom(self.vertices, UNDER, tools, lanes)
        self._memory, self._device = memory, device
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
        """Lists the vertices under the tools; False: there was no room for them, and now there is."""
        self._scratch.most.zero_()
        self._run(motion.list_under, len(pick), pick, self._room.tools, skins, touched, self._scratch)
        most = int(self._scratch.most.numpy()[0])
        if most <= self._room.under:
            return True
        self._room, self._scratch = self._room._replace(under=32 * -(-(most + most // 4) // 32)), None
        return False

    def _run(self, kernel: Any, dim: int | tuple[int, int], *inputs: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(inputs), device=self._device)

    def _answer(self, pick: Any, to: Any, skins: Any, touched: Any, out: Any) -> None:
        field, lanes, tools, more = self._scratch, self._room.lanes, self._room.tools, self._more
        scenes, shared = len(pick), (len(pick), lanes)

        def run(kernel: Any, *inputs: Any, dim: Any = shared) -> None:
            self._run(kernel, dim, pick, lanes, tools, *inputs)

        self._run(conforms.find_way, scenes * tools, pick, tools, skins, touched, field)
        run(motion.press, skins, touched, field)

        # What the method says.
        run(motion.forget, 1, skins, touched, field)
        self._run(motion.fold, scenes, pick, tools, 0, skins, touched, field)
        run(motion.mark, 0, skins, more, touched, field)
        run(motion.ask, skins, more, touched, field)
        run(motion.move, skins, more, touched, field, self._net)
        self._run(motion.gain, scenes, lanes, field)
        run(motion.fill, 0, skins, more, touched, field)

        # What is touched lies on its tool, and the rest comes along.
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
        run(conforms.push_out, skins, touched, field)
        other: Any = wp.float64 if out.dtype is wp.float32 else wp.float32
        none = wp.empty((0, 0, 0), dtype=other, device=self._device)
        both = (out, none) if out.dtype is wp.float32 else (none, out)
        self._run(conforms.hand_out, shared, pick, to, lanes, tools, skins, more, touched, field, *both)

    def _correct(self, scenes: int) -> None:
        """Moves the vertices under tools as they should still move."""
        field, lanes, end = self._scratch, self._room.lanes, self._room.under
        field.most.zero_()
        self._run(conforms.list_wanted, scenes, field)
        self._run(conforms.set_up, (scenes, lanes), lanes, field)
        pivots = [(0, end)] if lanes == 1 else [(k, k + 1) for k in range(int(field.most.numpy()[0]))]
        for pivot in pivots:
            self._run(conforms.eliminate, (scenes, lanes), lanes, *pivot, field)
        self._run(conforms.substitute, scenes, field)
        self._run(conforms.follow, (scenes, lanes), lanes, field)
