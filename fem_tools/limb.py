"""Limb: the wide part of a limb's linear response, by coarse elements (see stmpl_core.green)."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from threadpoolctl import threadpool_limits

from fem_tools.mesh import ElementName, WedgeMesh, folding, reference_wedge, rest_gradients
from fem_tools.plies import wedge_ends
from fem_tools.slabs import Slabs, slabs_of
from fem_tools.system import System
from stmpl_core.bones import shortened, unfolded
from stmpl_core.coarse_response import CoarseResponse
from stmpl_core.green import add_motion, bank
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.coarse import nearest_corners
from stmpl_core.softness import Softness

VERTICES = 900  # vertices of the coarse skin, about: its operator has 3 times their square numbers
FINEST = 1.1  # edges of the coarse mesh over the layer's own, below which the layer's own is taken
ELEMENT: ElementName = "P1xP2"
PASSES, SHORTER, TURNED = 40, 0.85, 0.25  # columns of the coarse mesh whose wedges fold: passes, and what each does
HAT = np.array([[2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [1.0, 1.0, 2.0]]) / 12  # forces of linear pressures on a triangle


def coarse_response(layer: SoftLayer, vertices: int = VERTICES) -> CoarseResponse:
    """The coarse elements' part of a layer's response: its skin meshed coarsely, and solved for each of its vertices.

    Args:
        layer: soft layer at rest.
        vertices: vertices of the coarse skin, about.

    Raises:
        InvalidInput, MeshError: the skin cannot be meshed so coarsely.
    """
    coarse = _coarse(layer, vertices)
    wide, thickness = _compliance(coarse), float(np.median(layer.thickness))
    softness, every = Softness.of(layer, thickness), np.arange(len(coarse.vertices))
    banked, soft = bank(layer.tissue, thickness, softness), softness.at(coarse, thickness)
    inward, area, unit = -coarse.normals, coarse.vertex_areas, np.full(len(every), thickness)
    for v in every:  # less the flat stack's
        flat, one = np.zeros_like(coarse.vertices), slice(v, v + 1)
        add_motion(flat, every, coarse.vertices, inward, unit, coarse.vertices[one], inward[one], area[one], unit[one],
                   soft[one], area[v] * inward[one], banked)  # fmt: skip
        wide[:, v] -= flat.ravel()
    corners, shares = nearest_corners(coarse, layer.vertices)
    gathered = np.bincount(corners.ravel(), (shares * layer.vertex_areas[:, None]).ravel(), len(coarse.vertices))
    motion = np.ascontiguousarray(wide.reshape(-1, 3, len(coarse.vertices)))
    return CoarseResponse(corners, shares, np.maximum(gathered, 1e-12), motion, coarse.edge_length)


def _coarse(layer: SoftLayer, vertices: int) -> SoftLayer:
    edge = float(np.sqrt(layer.vertex_areas.sum() / (vertices * np.sqrt(3) / 2)))
    if edge < FINEST * layer.edge_length:
        return layer
    from stmpl_core.remesh import remesh

    mesh = remesh(layer.vertices, layer.faces, edge)
    scale = None if layer.ply_scale is None else mesh.transfer @ layer.ply_scale
    skin = SoftLayer(mesh.vertices, mesh.faces, mesh.transfer @ layer.thickness, tissue=layer.tissue, ply_scale=scale)
    columns = mesh.transfer @ layer.inner_vertices - skin.vertices
    columns = unfolded(skin.vertices, skin.normals, columns, skin.faces)
    bad = _folding(skin, columns)
    for _ in range(PASSES):  # a stack's wedges may fold where the whole column does not
        if not len(bad):
            break
        columns[bad] = shortened(columns[bad], skin.normals[bad], SHORTER, TURNED)
        bad = _folding(skin, columns)
    whole = skin.with_(core=skin.vertices + columns)
    return whole if not len(bad) else _without(whole, np.isin(skin.faces, bad).all(axis=1))


def _without(layer: SoftLayer, faces: np.ndarray) -> SoftLayer:
    """The layer without some faces, by their mask (F,), and without vertices that are left alone."""
    kept = layer.faces[~faces]
    some, places = np.unique(kept, return_inverse=True)
    scale = None if layer.ply_scale is None else layer.ply_scale[some]
    return SoftLayer(layer.vertices[some], places.reshape(-1, 3), core=layer.inner_vertices[some], tissue=layer.tissue,
                     ply_scale=scale)  # fmt: skip


def _folding(skin: SoftLayer, columns: np.ndarray) -> np.ndarray:
    """Numbers of the vertices around wedges that fold."""
    ends = wedge_ends(skin.tissue, np.linalg.norm(columns, axis=1), 1, skin.ply_scale)
    faces = skin.faces.astype(np.int64)
    layers = ends.shape[1] - 1
    wedge = reference_wedge(ELEMENT)
    _, volumes = rest_gradients(skin.vertices, skin.vertices + columns, faces, wedge, layers, ends)
    return folding(faces, volumes, layers)


def _compliance(layer: SoftLayer) -> np.ndarray:
    """Motion of every vertex under a pressure E at each, its edges held, (3 V, V) [m]."""
    ends = wedge_ends(layer.tissue, np.linalg.norm(layer.inner_vertices - layer.vertices, axis=1), 1, layer.ply_scale)
    faces = layer.faces.astype(np.int64)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, faces, ELEMENT, ends=ends, ply_scale=layer.ply_scale)
    system = System(mesh, layer.tissue, [], mesh.border_columns())
    blocks: Any = system.tangent(system.zeros(), 1.0)
    count, width = len(layer.vertices), blocks.shape[1]
    free = np.repeat(~system.fixed, width)
    stiffness = sp.bsr_matrix((blocks, mesh.indices, mesh.indptr), shape=(count * width,) * 2).tocsr()[free][:, free]
    forces = -np.einsum("ij,fx->fxij", HAT, layer.face_area_vectors)  # on corner i by a pressure at corner j
    rows = faces[:, None, :, None] * width + np.arange(3)[None, :, None, None]
    columns = np.broadcast_to(faces[:, None, None, :], forces.shape)
    loads = sp.csc_matrix((forces.ravel(), (np.broadcast_to(rows, forces.shape).ravel(), columns.ravel())),
                          shape=(count * width, count))[free]  # fmt: skip
    column = np.flatnonzero(~system.fixed)  # of each free column, its number
    touch = sp.csr_matrix((np.ones(len(mesh.indices)), mesh.indices, mesh.indptr), shape=(count, count))
    slabs = [(width * one[:, None] + np.arange(width)).ravel() for one in slabs_of(touch[column][:, column])]
    at_skin = (width * np.arange(len(column))[:, None] + np.arange(3)).ravel()
    with threadpool_limits(1, user_api="blas"):  # where a core is busy, OpenBLAS' two take 0.2 s for one's 5 ms
        moved = Slabs.of(stiffness, slabs).solve(loads, at_skin)
    out = np.zeros((count, 3, count), np.float32)
    out[column] = moved.reshape(-1, 3, count) * layer.tissue.youngs_modulus
    return out.reshape(3 * count, count)
