"""Plies: how the wedges of a column share out the materials of a stack, and how a confined column of them gives way."""

from __future__ import annotations

import math

import numpy as np

from fem_tools.mesh import WedgeMesh, level_depths
from stmpl_core.methods.winkler import column_stretch
from stmpl_core.tissue import Tissue

GROWTH = 10.0  # depth at which a wedge below the first material may end over that at which it begins, at one wedge [-]
THINNEST_SHARE = 0.01  # least share of a column that a wedge keeps where its material is not there


def materials(tissue: Tissue) -> list[Tissue]:
    """Each material of a stack as a tissue of its own, from the skin inwards."""
    deeper = [Tissue(ply.youngs_modulus, ply.poisson_ratio) for ply in tissue.deeper]
    return [Tissue(tissue.youngs_modulus, tissue.poisson_ratio), *deeper]


def largest_poisson_ratio(tissue: Tissue) -> float:
    """nu of the least compressible material [-]."""
    return max(one.poisson_ratio for one in materials(tissue))


def confined_modulus(tissue: Tissue, thickness: float) -> float:
    """M of a confined column of this thickness [Pa]: the materials one after the other, 1 / M = sum (t_i / t) / M_i."""
    if not tissue.deeper:
        return tissue.confined_modulus
    shares = np.diff(_bounds(tissue, np.array([thickness]))[0]) / thickness
    return 1 / sum(share / one.confined_modulus for share, one in zip(shares, materials(tissue), strict=True))


def wedge_ends(tissue: Tissue, length: np.ndarray, layers: int, scale: np.ndarray | None = None) -> np.ndarray:
    """Depths at which the wedges of each column end, as shares of its length, (N, L + 1) or (1, L + 1) [-].

    The first material has `layers` wedges, graded as those of a single one. Each below it has as many as let the last
    end no deeper than GROWTH^(1 / layers) times where it begins, at least one: what a load does fades with depth, and
    grows as wide. Where a column does not reach a material, its wedges keep THINNEST_SHARE of it each, and are made of
    what is there (see wedge_materials).

    Args:
        tissue: stack.
        length: lengths of the columns, (N,) [m].
        layers: wedges of the first material.
        scale: factor on the depths at which materials begin below each column, (N,) [-]; None: 1.
    """
    factor = np.ones(1) if scale is None else scale
    starts = [ply.depth for ply in tissue.deeper if (ply.depth * factor < length).any()]
    if not starts:
        return level_depths(layers)[None, ::2]
    lows, highs = starts, [*starts[1:], float(length.max())]
    shares = [level_depths(layers)[::2]]
    for low, high in zip(lows, highs, strict=True):
        ratio = high / low
        many = max(1, math.ceil(layers * math.log(ratio) / math.log(GROWTH) - 1e-9))
        step = np.arange(many + 1) / many
        shares.append((ratio**step - 1) / (ratio - 1))
    below = np.cumsum([len(share) - 1 for share in shares][:0:-1])[::-1]  # wedges from each deeper material on
    most = 1 - THINNEST_SHARE * below
    bounds = np.minimum(np.array(starts) * (factor / length)[:, None], most)
    bounds = np.hstack([np.zeros((len(length), 1)), bounds, np.ones((len(length), 1))])
    ends = [bounds[:, k, None] + (bounds[:, k + 1] - bounds[:, k])[:, None] * share[:-1]
            for k, share in enumerate(shares)]  # fmt: skip
    return np.hstack([*ends, np.ones((len(length), 1))])


def wedge_plies(mesh: WedgeMesh, tissue: Tissue) -> np.ndarray:
    """Number of the material at the depth of each wedge's middle, (T L,)."""
    if not tissue.deeper:
        return np.zeros(len(mesh.triangles) * mesh.layers, dtype=np.int64)
    length = np.linalg.norm(mesh.inner - mesh.outer, axis=1) / (1.0 if mesh.ply_scale is None else mesh.ply_scale)
    middle = (mesh.ends[:, :-1] + mesh.ends[:, 1:]) / 2 * length[:, None]
    return np.searchsorted([ply.depth for ply in tissue.deeper], middle[mesh.triangles].mean(axis=1).ravel())


def wedge_materials(mesh: WedgeMesh, tissue: Tissue) -> tuple[np.ndarray, np.ndarray]:
    """mu and lambda of each wedge, (T L,) each [Pa]: those of the material at the depth of its middle."""
    count = len(mesh.triangles) * mesh.layers
    if not tissue.deeper:
        return np.full(count, tissue.shear_modulus), np.full(count, tissue.lame_lambda)
    moduli = np.array([(one.shear_modulus, one.lame_lambda) for one in materials(tissue)])[wedge_plies(mesh, tissue)]
    return np.ascontiguousarray(moduli[:, 0]), np.ascontiguousarray(moduli[:, 1])


def confined(mesh: WedgeMesh, tissue: Tissue, pressure: np.ndarray) -> np.ndarray:
    """Motion of every node, (C, levels, 3) [m], if each column is confined and bears a pressure (C,) [Pa] of its own.

    Every material keeps one stretch through its depth; what the materials give adds up from the core.
    """
    outer, inner = mesh.column_ends()
    depth = mesh.depths()[:, :, None]
    if not tissue.deeper:
        stretch = column_stretch(pressure, tissue)
        return (1 - stretch)[:, None, None] * (inner - outer)[:, None] * (1 - depth)
    length = np.linalg.norm(inner - outer, axis=1)
    scale = None if mesh.ply_scale is None else mesh.on_columns(mesh.ply_scale)
    bounds = _bounds(tissue, length, scale)
    given = np.zeros(depth.shape[:2])
    for k, one in enumerate(materials(tissue)):
        below = np.maximum(bounds[:, k + 1, None] - np.maximum(bounds[:, k, None], depth[..., 0] * length[:, None]), 0)
        given += (1 - column_stretch(pressure, one))[:, None] * below
    return given[..., None] * ((inner - outer) / length[:, None])[:, None]


def _bounds(tissue: Tissue, length: np.ndarray, scale: np.ndarray | None = None) -> np.ndarray:
    """Depths at which the materials of columns of a length (N,) begin, and the last one ends, (N, M + 1) [m]."""
    starts = np.array([0.0, *(ply.depth for ply in tissue.deeper), np.inf])
    return np.minimum(starts * (1.0 if scale is None else scale[:, None]), length[:, None])
