"""Packs: skins, tools and scratch space as arrays that kernels read: all skins in one, all distance fields in one."""

# pyright: reportInvalidTypeForm=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from stmpl_core.columns import BLOCK, HOLE_RADIUS, Columns
from stmpl_core.deep import FIRST, LOOKED_AT, where_inside
from stmpl_core.gpu.rays import Grid, mat33, real, vec3
from stmpl_core.green import COLUMNS, STRAINS
from stmpl_core.layer import SoftLayer
from stmpl_core.networks import ARRAYS, NODE, PRESSURE, STACK_NODE, shipped
from stmpl_core.nodes import CHARTS, MOST, NODES, WIDEST
from stmpl_core.obstacle import response
from stmpl_core.sdf import CORNERS, MOST_CHECKS, TIPS, SignedDistance
from stmpl_core.skin import Skin
from stmpl_core.tool import Tool
from stmpl_core.tools import Tools
from stmpl_core.toucher import margin_on, soft_depth, thicker_than_most, tissue_doubt, unlearnt

STEEP_BIT, LONG_BIT, BORDER_BIT, EDGE_BIT, BONY_BIT = 1, 2, 4, 8, 16  # what is to be said of a vertex, see Soundness
MOST_PLACES = 8192  # places of a lattice: nodes.MOST_LOOKED_AT and a margin around them
LEAST_PARTS = 800  # parts of few triangles: of 199 in 4
MARGIN = 1.3  # room for columns over the most that were counted
HIDDEN = 32  # units of a hidden layer; a smaller network's are filled up with units that say nothing


@wp.struct
class OneSkin:
    """Numbers of a skin: where its vertices and balls lie among all, its lengths [m], and its tissue's."""

    first: wp.int32
    end: wp.int32
    first_ball: wp.int32
    end_ball: wp.int32
    table: wp.int32
    learnt: wp.int32
    doubt: real
    hole: real
    thickest: real
    edge: real
    modulus: real
    mu: real
    lam: real
    nu: real
    half_space: real
    low: vec3
    high: vec3
    folded: wp.int32
    stacked: wp.int32
    coarse: wp.int32
    first_coarse: wp.int32
    first_motion: wp.int32
    flat: real
    thicker: vec3
    effective: real
    softness: real
    soft: real
    log_kappa: real
    log_pull: real


@wp.struct
class Lattice:
    """A lattice on one side of a limb: spacings and start [m], rows and columns, axes; see stmpl_core.nodes._lay."""

    spacing: real
    rise: real
    start: wp.vec2d
    blur: real
    cell: real
    low: wp.int32
    left: wp.int32
    rows: wp.int32
    wide: wp.int32
    first: vec3
    second: vec3
    way: vec3

FAR_AWAY = np.tile([1e9, 1e9, 1e9, 0.0], (MOST_CHECKS, 1))  # places that fill up those at which a field was checked


def struct_of(name: str, doc: str, fields: dict[str, tuple[Any, str]]) -> Any:
    """A struct of arrays, by their names: type of their elements, and a letter for each axis."""
    hints = {key: wp.array(dtype=dtype, ndim=len(axes)) for key, (dtype, axes) in fields.items()}
    return wp.struct(type(name, (), {"__annotations__": hints, "__module__": __name__, "__doc__": doc}))


SKINS: dict[str, tuple[Any, str]] = {
    "one": (OneSkin, "S"),
    "points": (vec3, "V"), "inward": (vec3, "V"), "thickness": (real, "V"), "area": (real, "V"),
    "area_vectors": (vec3, "V"), "bent": (real, "Vx"), "facets": (real, "V"), "doubts": (wp.int32, "V"),
    "faces": (wp.vec3i, "F"),
    "start": (wp.int32, "V"), "around": (wp.int32, "F"), "balls": (wp.vec4d, "B"),
    "grids": (Grid, "G"), "coefficients": (real, "N"), "holes": (wp.int32, "K"),
    "checks": (wp.vec4d, "Gx"), "tips": (wp.vec4d, "Gx"), "tip_many": (wp.int32, "G"),
    "corners": (wp.vec3d, "Gx"), "corner_many": (wp.int32, "G"),
    "looked_at": (vec3, "Kx"), "look_many": (wp.int32, "Kx"),
    "rows": (real, "Tx"), "linked": (wp.uint32, "Vb"),
    "green": (real, "SbgR"), "soft": (real, "V"), "alike": (vec3, "V"), "coarse_corner": (wp.vec3i, "V"),
    "coarse_share": (vec3, "V"),
    "gathered": (real, "c"), "motion": (wp.float32, "m"), "hard_logs": (real, "St"), "hard": (real, "Sts"),
}  # fmt: skip
# C: scene and tool, S: scene, M: columns, B: blocks of columns, F: triangles, P: their parts, L: lattice, N: nodes,
# W: words of a bit for each node, Q, K: nodes and coarse vertices of stacks
SCRATCH: dict[str, tuple[Any, str]] = {
    "skin": (wp.int32, "C"), "grid": (wp.int32, "C"), "status": (wp.int32, "C"), "busy": (wp.int32, "1"),
    "pose": (mat33, "C"), "place": (vec3, "C"), "centre": (vec3, "C"), "wide": (wp.int32, "C"),
    "near": (wp.uint32, "CB"), "covered": (wp.uint32, "CB"), "seen": (wp.uint32, "CB"),
    "columns": (wp.int32, "CM"), "count": (wp.int32, "C"), "least": (real, "CM"), "above": (real, "CM"),
    "under": (real, "CM"), "nearest": (real, "C"), "misses": (wp.int32, "C"), "around": (real, "C"), "top": (vec3, "C"),
    "found": (wp.int32, "CF"), "many": (wp.int32, "C"), "split": (wp.int32, "C"), "deep": (real, "C"),
    "depths": (real, "CP"), "middles": (vec3, "CP"), "ways": (vec3, "CF"), "sizes": (real, "CF"),
    "chart": (wp.int32, "CF"), "sides": (wp.int32, "C"), "axes": (mat33, "C6"), "deepest": (real, "C"),
    "covers": (real, "C"), "height": (real, "C"), "sees": (real, "C"), "also": (real, "C"), "lattice": (Lattice, "C"),
    "owner": (wp.int32, "CL"), "value": (real, "CL"),
    "nodes": (wp.int32, "S"), "wants": (wp.int32, "1"), "begin": (wp.int32, "S"),
    "tool": (wp.int32, "SN"), "cell": (wp.int32, "SN"), "face": (wp.int32, "SN"), "shares": (vec3, "SN"),
    "point": (vec3, "SN"), "inward": (vec3, "SN"), "thick": (real, "SN"), "area": (real, "SN"), "strain": (real, "SN"),
    "fold": (wp.int32, "SN"), "queue": (wp.int32, "SN"), "mean": (vec3, "C"), "middle": (wp.vec4d, "C"),
    "pushed": (real, "C"), "way": (vec3, "C"), "as_one": (real, "CT"), "near_tools": (real, "CT"),
    "tissue": (real, "C"), "least_area": (real, "C"), "most_area": (real, "C"),
    "sinking": (real, "SQ"), "soft": (real, "SQ"), "slot": (wp.int32, "SK"),
    "met": (wp.int32, "SK"), "meets": (wp.int32, "S"), "slots": (wp.int32, "SQ9"), "weights": (real, "SQ9"),
    "parts": (real, "SQ9"), "around_node": (wp.int32, "SQ"), "rows": (real, "SQK"),
    "wide_part": (real, "SQQ"), "kept": (real, "SQ"), "given_way": (real, "C"),
    "matrix": (real, "SNN"), "force": (real, "SN"), "gap": (real, "SN"), "move": (real, "SN"), "along": (real, "SN"),
    "wanted": (real, "SN"), "beside": (wp.uint32, "SNW"), "reached": (wp.uint32, "CW"),
    "found_power": (real, "SN"), "left": (real, "SN"), "group": (wp.int32, "C"),
    "times": (real, "SN"), "over": (real, "SN"),
    "pressure": (real, "SN"), "fade": (real, "SN"), "strange": (real, "SN"), "error": (real, "SN"),
    "inputs": (wp.float32, "SNI"), "one": (wp.float32, "SNH"), "two": (wp.float32, "SNH"), "highest": (real, "SN"),
}  # fmt: skip
NET: dict[str, tuple[Any, str]] = {
    name: (wp.float32, "io" if name.startswith("w") else "o") for name in ARRAYS["pressure"]
}
Skins = struct_of("Skins", "Skins and the distance fields of the tools, one after the other.", SKINS)
Scratch = struct_of("Scratch", "What kernels leave for each other.", SCRATCH)
Net = struct_of("Net", "Weights of a ContactNet.", NET)


class Room(NamedTuple):
    """Capacities for one scene and tool: columns, blocks of columns, triangles, their parts, nodes of all its tools."""

    columns: int
    blocks: int
    nodes: int
    coarse: int  # coarse vertices of a stack; 0: one material

    def sizes(self, scenes: int, tools: int) -> dict[str, int]:
        """Length of each axis of SCRATCH."""
        faces = 2 * self.columns + 64
        return {"C": scenes * tools, "S": scenes, "T": tools, "M": self.columns, "B": self.blocks, "F": faces,
                "6": CHARTS, "P": max(faces, LEAST_PARTS), "L": MOST_PLACES, "N": self.nodes, "W": self.nodes // 32,
                "I": max(NODE.size, STACK_NODE.size), "H": HIDDEN, "1": 1, "K": max(1, self.coarse), "9": 9,
                "Q": self.nodes if self.coarse else 1}  # fmt: skip

    def bytes_of(self, tools: int) -> int:
        """Memory for one scene [bytes]."""
        return bytes_of(SCRATCH, self.sizes(1, tools))


def bytes_of(fields: dict[str, tuple[Any, str]], sizes: dict[str, int]) -> int:
    """Memory that arrays take, given the lengths of their axes [bytes]."""
    return sum(int(np.prod([sizes[axis] for axis in axes])) * _bytes(dtype) for dtype, axes in fields.values())


def filled(out: Any, fields: dict[str, tuple[Any, str]], sizes: dict[str, int], device: Any) -> Any:
    """A struct with its arrays, all zero."""
    for name, (dtype, axes) in fields.items():
        setattr(out, name, wp.zeros(tuple(sizes[axis] for axis in axes), dtype=dtype, device=device))
    return out


def _bytes(dtype: Any) -> int:
    return dtype.native_type.__sizeof__(dtype.native_type()) if hasattr(dtype, "native_type") else \
        wp.types.type_size_in_bytes(dtype)  # fmt: skip


def scratch(room: Room, scenes: int, tools: int, device: Any) -> Any:
    """Scratch space for so many scenes."""
    return filled(Scratch(), SCRATCH, room.sizes(scenes, tools), device)


def net(network: str, device: Any) -> Any:
    """A network of contact nodes, by its name."""
    out, arrays = Net(), shipped(network).arrays
    assert arrays["w1"].shape[1] == arrays["w3"].shape[1] <= HIDDEN and arrays["w4"].shape[1] == PRESSURE.size
    for name in NET:
        setattr(out, name, wp.array(wider(name, arrays[name], HIDDEN), dtype=wp.float32, device=device))
    return out


def wider(name: str, values: np.ndarray, hidden: int) -> np.ndarray:
    """An array of a network by its name, as if hidden layers had so many units: those that are added say nothing."""
    if name[0] not in "wb":
        return values
    rows = (0, hidden - len(values)) if name in ("w2", "w3", "w4") else (0, 0)
    wide = (0, hidden - values.shape[-1]) if name[1] != "4" else (0, 0)
    return np.pad(values, (rows, wide) if name[0] == "w" else wide)


def pack(skins: Sequence[Skin], tools: Sequence[Tool], device: Any) -> tuple[Any, list[list[SignedDistance]]]:
    """Skins, each once, and the fields of the tools that press on each, as kernels read them, and as they are."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in SKINS}
    ones, grids, tables, fields = [], [], [], []
    stores: dict[float, Tools] = {}
    offsets: dict[int, int] = {}
    vertices = faces = balls = coefficients = coarse = motion = 0
    for skin in skins:
        columns = Columns(skin.layer)
        one, arrays = _one_skin(skin, columns, (vertices, faces, balls, len(tables)))
        arrays |= _of_stack(one, skin, columns._order, (coarse, motion))
        coarse, motion = coarse + len(arrays["gathered"]), motion + len(arrays["motion"])
        margin = margin_on(skin.layer)
        store = stores.setdefault(margin, Tools(margin))
        fields.append([store.field(tool) for tool in tools])
        for field in fields[-1]:
            if id(field) not in offsets:
                offsets[id(field)] = coefficients
                parts["coefficients"].append(field.coefficients.ravel())
                coefficients += field.coefficients.size
            grids.append(_grid(field, offsets[id(field)]))
            parts["checks"].append(np.concatenate([field.checks, FAR_AWAY[len(field.checks) :]])[None])
            parts["tips"].append(np.concatenate([field.tips, np.zeros((TIPS - len(field.tips), 4))])[None])
            parts["tip_many"].append(np.array([len(field.tips)]))
            parts["corners"].append(np.concatenate([field.corners, np.zeros((CORNERS - len(field.corners), 3))])[None])
            parts["corner_many"].append(np.array([len(field.corners)]))
        table = response(skin.layer.tissue.poisson_ratio)
        one.half_space = table.half_space
        parts["rows"].append(table.rows)
        tables += [None] * len(table.rows)
        ones.append(one)
        for name, values in arrays.items():
            parts[name].append(values)
        vertices, faces, balls = one.end, faces + len(skin.layer.faces), one.end_ball
    parts["start"].append(np.array([3 * faces]))
    looked = [_looked_at(tool) for tool in tools]
    longest = max(len(points) for points, _ in looked)
    parts["looked_at"] = [np.stack([np.resize(points, (longest, 3)) for points, _ in looked])]
    parts["look_many"] = [np.array([many for _, many in looked])]
    parts["holes"] = [np.array([len(field.openings) for field in fields[0]])]
    out = Skins()
    for name, (dtype, _) in SKINS.items():
        values: Any = {"one": ones, "grids": grids}.get(name)
        if values is None:
            wide = max(each.shape[-1] for each in parts[name])
            values = np.concatenate([np.pad(each, ((0, 0), (0, wide - each.shape[1]))) for each in parts[name]]) \
                if name == "linked" else np.concatenate(parts[name])
        setattr(out, name, wp.array(values, dtype=dtype, device=device))
    return out, fields


def _one_skin(skin: Skin, columns: Columns, at: tuple[int, int, int, int]) -> tuple[Any, dict[str, np.ndarray]]:
    """A skin's numbers and arrays, its vertices in the order of its balls; at: vertices, faces, ... before it."""
    layer, sound, order = skin.layer, skin.near.sound, columns._order
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    start = np.concatenate([[0], np.cumsum(np.diff(columns._start)[order])])
    around = np.concatenate([columns._around[columns._start[v] : columns._start[v + 1]] for v in order])
    edge = np.zeros(len(order), bool)
    edge[layer.border] = True
    doubts = (STEEP_BIT * sound.steep + LONG_BIT * sound.long + EDGE_BIT * edge + BONY_BIT * sound.bony
              + BORDER_BIT * ((sound.border < sound.least_border) | sound.crossed))  # fmt: skip
    arrays = {
        "points": layer.vertices[order], "inward": columns.inward[order], "thickness": layer.thickness[order],
        "area": layer.vertex_areas[order], "area_vectors": layer.vertex_area_vectors[order],
        "bent": skin.near.bent_at(order)[order], "facets": sound.facets[order], "doubts": doubts[order],
        "faces": at[0] + place[columns.faces],
        "start": at[1] * 3 + start[:-1], "around": at[1] + around, "balls": columns._blocks,
    }  # fmt: skip
    one, tissue = OneSkin(), layer.tissue
    one.first, one.end = at[0], at[0] + len(order)
    one.first_ball, one.end_ball, one.table = at[2], at[2] + len(columns._blocks), at[3]
    one.hole, one.thickest, one.edge = HOLE_RADIUS * layer.edge_length, float(layer.thickness.max()), layer.edge_length
    one.modulus, one.nu = tissue.youngs_modulus, tissue.poisson_ratio
    one.mu, one.lam = tissue.shear_modulus / one.modulus, tissue.lame_lambda / one.modulus
    known = shipped(network_of(layer)).card["ranges"]["poisson_ratio"]
    one.learnt, one.soft, one.doubt = int(not unlearnt(layer, *known)), soft_depth(layer), tissue_doubt(layer)
    one.thicker = vec3(*thicker_than_most(layer))
    one.low, one.high = (vec3(*corner) for corner in where_inside(layer))
    return one, arrays


def network_of(layer: SoftLayer) -> str:
    """Name of the network of contact nodes that belongs to a layer."""
    return "stack_contact_net" if layer.stacked else "contact_net"


def _of_stack(one: Any, skin: Skin, order: np.ndarray, at: tuple[int, int]) -> dict[str, np.ndarray]:
    """What a stack has more, and skin with folds; at: coarse vertices, and numbers of their motion, before it."""
    one.folded, one.stacked, one.coarse, one.softness = int(skin.near.folded), 0, 0, 1.0
    one.first_coarse, one.first_motion = at
    out: dict[str, np.ndarray] = {
        "linked": _linked(skin, order) if skin.near.folded else np.zeros((len(order), 1), np.uint32),
        "green": np.zeros((1, 1, 1, 1)), "soft": np.zeros(len(order)), "alike": np.zeros((len(order), 3)),
        "coarse_corner": np.zeros((1, 3), int),
        "coarse_share": np.zeros((1, 3)), "gathered": np.zeros(0), "motion": np.zeros(0),
        "hard_logs": np.zeros((1, COLUMNS)), "hard": np.zeros((1, COLUMNS, STRAINS)),
    }  # fmt: skip
    green = skin.green
    if green is None:
        return out
    assert green.coarse is not None
    corners, shares, gathered, motion, *_ = green.coarse
    logs, hard, alike = green.hardening
    one.stacked, one.coarse = 1, len(gathered)
    one.flat, one.effective = green.thickness, green.effective.thickness
    _, one.log_kappa, one.log_pull, log_softness = (float(x) for x in green.numbers)
    one.softness = float(np.exp(log_softness))
    return out | {
        "green": green.tables[None, :, 0], "soft": green.soft[order], "alike": alike[order],
        "coarse_corner": corners[order], "coarse_share": shares[order], "gathered": gathered, "motion": motion.ravel(),
        "hard_logs": logs[None], "hard": hard[None],
    }  # fmt: skip


def _linked(skin: Skin, order: np.ndarray) -> np.ndarray:
    """Bits that say which vertices are neighbours along the skin, (V, V / 32)."""
    far = skin.near._thinning.levels[-1]
    beside = np.zeros((len(far.stands),) * 2, bool)
    beside[np.repeat(np.arange(len(far.stands)), np.diff(far.start)), far.index] = True
    bits, own = np.zeros((len(order), 32 * -(-len(order) // 32)), bool), far.of[order]
    bits[:, : len(order)] = beside[own][:, own]
    return np.packbits(bits, axis=1, bitorder="little").view(np.uint32)


def _grid(field: SignedDistance, offset: int) -> Any:
    out = Grid()
    out.offset, out.shape, out.spacing = offset, wp.vec3i(*field.coefficients.shape), field.spacing
    out.origin, out.surface_error, out.half = vec3(*field.origin), field.surface_error, field.half_thickness
    out.mostly_off = field.mostly_off
    out.low, out.high = (vec3(*corner) for corner in field.tool_bounds)
    return out


def _looked_at(tool: Tool) -> tuple[np.ndarray, tuple[int, int]]:
    """Points of a tool that Deep.inside looks at, few and then many, and how many these are."""
    few, many = (tool.vertices[:: max(1, len(tool.vertices) // count)] for count in (FIRST, LOOKED_AT))
    return np.concatenate([few, many]), (len(few), len(many))


def whole_words(nodes: int) -> int:
    """A number of nodes, each of which has a bit, filled up."""
    return 32 * -(-nodes // 32)


def room_for(skins: Sequence[Skin], fields: Sequence[Sequence[SignedDistance]], nodes: int | None) -> Room:
    """Capacities for the tools on these skins: what they need however they lie there; of nodes, what most need."""
    columns = blocks = most = 0
    for skin, own in zip(skins, fields, strict=True):
        layer, tree, wanted = skin.layer, KDTree(skin.layer.vertices), 0.0
        some = layer.vertices[:: max(1, len(layer.vertices) // 200)]
        for field in own:
            extent = np.sort(np.subtract(*field.tool_bounds[::-1]))
            reach = 0.5 * float(np.linalg.norm(extent)) + HOLE_RADIUS * layer.edge_length
            reach += 2 * float(layer.thickness.max())
            columns = max(columns, int(np.max(tree.query_ball_point(some, reach, return_length=True))))
            cell = 0.5 * 3**0.5 * (WIDEST * float(np.median(layer.thickness))) ** 2
            wanted += min(1.5 * NODES + extent[1] * extent[2] / cell, 1.2 * MOST)
        most, blocks = max(most, int(wanted)), max(blocks, -(-len(layer.vertices) // BLOCK))
    return Room(min(int(MARGIN * columns) + BLOCK, max(len(s.layer.vertices) for s in skins)), blocks,
                whole_words(most if nodes is None else nodes),
                max(len(skin.green.coarse.gathered) if skin.green and skin.green.coarse else 0 for skin in skins))
