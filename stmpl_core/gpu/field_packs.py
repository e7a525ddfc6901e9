"""Packs of what the motion of skin takes: neighbours, responses, a network; and scratch space for it."""

# pyright: reportInvalidTypeForm=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from stmpl_core.columns import Columns
from stmpl_core.errors import InvalidInput
from stmpl_core.gpu.packs import bytes_of, filled, struct_of, wider
from stmpl_core.gpu.rays import mat33, real, vec3
from stmpl_core.methods.moment_net import MomentNet
from stmpl_core.networks import INPUTS, MOTION, STACK_INPUTS, Weights
from stmpl_core.response import _RINGS
from stmpl_core.skin import Skin

vec8 = wp.types.vector(length=8, dtype=wp.float32)
HIDDEN = 96  # units of a hidden layer; a smaller network's are filled up, for loops of a known length run twice as fast

# V: vertices of all skins, Z: zones and vertices, N: neighbours, z: zones, R: rows of tables; H: vertices that stand
# for others, and M: those others, H after H
SKIN_FIELDS: dict[str, tuple[Any, str]] = {
    "reach": (wp.vec2i, "Z"), "index": (wp.int32, "N"), "heads": (wp.int32, "H"), "member": (wp.int32, "M"),
    "stands": (wp.uint8, "zV"), "corners": (wp.int32, "zVc"), "weights": (wp.float32, "zVc"), "at": (wp.vec3f, "V"),
    "site": (wp.vec4f, "V"), "normal": (wp.vec3f, "V"), "frame": (wp.mat33f, "V"), "shape": (wp.float32, "Vs"),
    "original": (wp.int32, "V"),
    "sink": (wp.float32, "SgR"), "away": (wp.float32, "SgR"), "rings": (vec8, "Rk"), "greens": (real, "b4gR"),
}  # fmt: skip
# F: scene whose field is asked, C: scene and tool, V: vertices of a skin, W: vertices under its tools, R: lanes;
# T: tools, U: W on one material, 1 on stacks; of stacks, else 1, N: nodes that press, K: coarse vertices, L: V
FIELD_SCRATCH: dict[str, tuple[Any, str]] = {
    "many": (wp.int32, "F"), "under": (wp.int32, "FW"), "of": (wp.int32, "FW"), "source": (wp.vec2f, "FW"),
    "press": (real, "CW"), "lies": (real, "CW"), "gone": (vec3, "CW"), "way": (vec3, "C"), "one_way": (wp.int32, "C"),
    "mark": (wp.int32, "FV"), "ask": (wp.int32, "FV"), "here": (wp.vec2f, "FV"), "fixed": (wp.vec3f, "FV"),
    "scaled": (wp.vec3f, "FV"), "told": (wp.vec2d, "FR"), "gain": (real, "F"), "motion": (vec3, "FV"),
    "sinking": (wp.float32, "FUU"), "left": (real, "FUU"), "right": (vec3, "FW"), "wanted": (vec3, "FW"),
    "weight": (real, "FW"), "moved": (vec3, "FW"), "pulls": (vec3, "FW"), "act": (wp.int32, "FW"),
    "acts": (wp.int32, "F"), "own": (real, "F"), "spread": (vec3, "FV"), "most": (wp.int32, "1"),
    "folds": (wp.int32, "F"), "fold": (wp.int32, "FW"), "queue": (wp.int32, "FW"), "feels": (wp.uint32, "FV"),
    "hold": (wp.int32, "FN"), "holds": (wp.int32, "F"), "parted": (wp.int32, "F"),
    "firm": (real, "FN"), "light": (real, "F"), "pull": (vec3, "FN"), "with_limb": (vec3, "FNK"),
    "block": (mat33, "FNN"), "handed": (real, "FK"), "limb": (vec3, "FK"), "linear": (vec3, "FL"), "far": (real, "C"),
    "covers": (real, "CT"), "push": (vec3, "C"), "own_way": (real, "FN"), "row": (vec3, "FN"),
    "peak": (real, "F"),
}  # fmt: skip
MOTION_NET: dict[str, tuple[Any, str]] = {
    name: (wp.float32, "io" if name[0] == "w" or name.startswith("mix") else "o")
    for name in ("mix_vectors", "mix_tensors", "low", "high", "mean", "scale", "w1", "b1", "w2", "b2", "w3", "b3",
                 "w4", "b4")
}  # fmt: skip
SkinFields = struct_of("SkinFields", "What a field takes of the skins.", SKIN_FIELDS)
FieldScratch = struct_of("FieldScratch", "What kernels of fields leave for each other.", FIELD_SCRATCH)
MotionNet = struct_of("MotionNet", "Weights of a MomentNet for what tools press with.", MOTION_NET)


class FieldRoom(NamedTuple):
    """Capacities for one scene: vertices of its skin, vertices under its tools, tools, lanes.

    On stacks also nodes that press, and coarse vertices; 0 of these: one material.
    """

    vertices: int
    under: int
    tools: int
    lanes: int
    nodes: int
    coarse: int

    def sizes(self, scenes: int) -> dict[str, int]:
        """Length of each axis of FIELD_SCRATCH."""
        stacked = self.coarse > 0
        return {"F": scenes, "C": scenes * self.tools, "V": self.vertices, "W": self.under, "R": self.lanes, "1": 1,
                "T": self.tools, "U": 1 if stacked else self.under, "N": self.nodes if stacked else 1,
                "K": max(1, self.coarse), "L": self.vertices if stacked else 1}  # fmt: skip

    def bytes_of(self) -> int:
        """Memory for one scene [bytes]."""
        return bytes_of(FIELD_SCRATCH, self.sizes(1))

    def scratch(self, scenes: int, device: Any) -> Any:
        """Scratch space for so many scenes."""
        return filled(FieldScratch(), FIELD_SCRATCH, self.sizes(scenes), device)


def weights_of(skins: Sequence[Skin]) -> Weights:
    """The one network that moves these skins, on one material by vertices.

    Raises InvalidInput: another method, or several networks.
    """
    methods, stacked = [skin.method for skin in skins], skins[0].layer.stacked
    found = [one.stack if stacked else one.contact for one in methods
             if isinstance(one, MomentNet) and one.fallback is None and (stacked or not one.sticks)]  # fmt: skip
    if len(found) < len(methods) or any(one is not found[0] for one in found):
        names, which = ", ".join(sorted({one.name for one in methods})), "" if stacked else "sticks=False"
        raise InvalidInput(f"fields of WarpBatch come from one MomentNet({which}) without a fallback; the skins "
                           f"have {names}. Try Batch, or Skin.of(layer, MomentNet({which})).")  # fmt: skip
    return found[0]


def motion_net(skins: Sequence[Skin], device: Any) -> Any:
    """The network that says how tools move these skins."""
    arrays, out = weights_of(skins).arrays, MotionNet()
    assert len(arrays["w1"]) in (INPUTS.size, STACK_INPUTS.size) and arrays["w4"].shape[1] == MOTION.size
    for name in MOTION_NET:
        setattr(out, name, wp.array(wider(name, arrays[name], HIDDEN), dtype=wp.float32, device=device))
    return out


def pack(skins: Sequence[Skin], device: Any) -> Any:
    """What fields take of skins, in the order and with the numbers of packs.pack."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in SKIN_FIELDS}
    for skin in skins:
        before = {name: sum(map(len, parts[name])) for name in ("original", "index", "heads", "member")}
        for name, values in _of_one(skin, before).items():
            parts[name].append(values)
    parts["heads"].append(np.array([sum(map(len, parts["member"]))]))
    parts["rings"] = [_RINGS.reshape(-1, 3, 8)]
    out = SkinFields()
    for name, (dtype, axes) in SKIN_FIELDS.items():
        values = np.concatenate(parts[name], axis=axes.index("V") if axes.startswith("z") else 0)
        setattr(out, name, wp.array(values, dtype=dtype, device=device))
    return out


def _of_one(skin: Skin, before: dict[str, int]) -> dict[str, np.ndarray]:
    """What fields take of one skin, after so many vertices and the like of others."""
    near, order = skin.near, Columns(skin.layer)._order
    thin, place, vertices = near._thinning, np.argsort(order), before["original"]
    reach, index, heads, member = [], [], [], []
    lists, stands, members = before["index"], before["heads"], before["member"]
    for level in thin.levels:
        own = level.of[order]
        reach.append(lists + np.stack([level.start[own], level.start[own + 1]], axis=1))
        index.append(stands + level.index)
        heads.append(members + np.searchsorted(np.sort(level.of), np.arange(len(level.stands))))
        member.append(vertices + place[np.argsort(level.of, kind="stable")])
        lists, stands, members = lists + len(level.index), stands + len(level.stands), members + len(order)
    shape, sites = np.concatenate([near.curvature, near.slope], axis=1)[order], near._sites[:, order]
    return {
        "reach": np.stack(reach, axis=1).reshape(-1, 2), "index": np.concatenate(index), "heads": np.concatenate(heads),
        "member": np.concatenate(member), "stands": thin._stands[:, order].astype(np.uint8),
        "corners": vertices + place[thin._corners[:, order]], "weights": thin._weights[:, order],
        "at": sites[:3].T, "site": sites[3:7].T, "normal": sites[7:].T, "frame": near.frames[order],
        "shape": shape, "original": order, "sink": near._response[None, 0], "away": near._response[None, 1],
        "greens": np.zeros((1, 1, 1, 1)) if skin.green is None else skin.green.tables,
    }  # fmt: skip

