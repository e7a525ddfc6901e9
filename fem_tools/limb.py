"""Limb: the wide part of a limb's linear response, by coarse elements (see stmpl_core.green)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from threadpoolctl import threadpool_limits

from fem_tools.mesh import ElementName, WedgeMesh, folding, reference_wedge, rest_gradients
from fem_tools.plies import wedge_ends
from fem_tools.slabs import Slabs, slabs_of
from fem_tools.system import System
from stmpl_core.bones import shortened, unfolded
from stmpl_core.coarse_response import CoarseDrag, CoarseResponse
from stmpl_core.errors import MeshError
from stmpl_core.green import add_motion, bank
from stmpl_core.layer import SoftLayer
from stmpl_core.methods.coarse import nearest_corners
from stmpl_core.moments import Surroundings
from stmpl_core.neighbours import Edges, neighbours
from stmpl_core.nodewise import REACH
from stmpl_core.softness import Softness

VERTICES = 900  # vertices of the coarse skin, about: its operator has 3 times their square numbers
FINEST = 1.1  # edges of the coarse mesh over the layer's own, below which the layer's own is taken
ELEMENT: ElementName = "P1xP2"
PASSES, SHORTER, TURNED = 40, 0.85, 0.25  # columns of the coarse mesh whose wedges fold: passes, and what each does
RING = 0.5, 2.4  # distances of vertices whose motion is that of a whole contact, over the edges
FLAT_AROUND = 2.5  # distance within which skin must be flat and its tissue even [thicknesses]
TURNS, UNEVEN = (0.05, 0.12), (0.04, 0.12)  # root mean square turn of its normals [rad], and |log| of its thickness,
# up to which it is flat, and from which not at all; and
BORDERS = (0.4, 1.0)  # distances from the open border up to which it is not, and from which it is [thicknesses]
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
    wide = _Elements.of(coarse).pressed()
    _less_flat(wide, layer, coarse, -coarse.normals)
    _forget_flat(wide, flatness(layer, coarse))
    corners, shares, gathered = _spread(layer, coarse)
    motion = np.ascontiguousarray(wide.reshape(-1, 3, len(coarse.vertices)))
    return CoarseResponse(corners, shares, gathered, motion, coarse.edge_length)


def coarse_drag(layer: SoftLayer, vertices: int = VERTICES) -> CoarseDrag:
    """The same where skin is dragged along: solved for each coarse vertex, along two tangents of the skin.

    Args, Raises: see `coarse_response`.
    """
    coarse = _coarse(layer, vertices)
    elements, count = _Elements.of(coarse), len(coarse.vertices)
    tangents, flat, give = _tangents(coarse.normals), flatness(layer, coarse), np.zeros((count, 3, 3))
    by_source = np.empty((2, count, 3 * count), np.float32)
    apart = np.linalg.norm(coarse.vertices[:, None] - coarse.vertices, axis=2) / coarse.edge_length
    ring = (apart > RING[0]) & (apart < RING[1])
    ring = ring / np.maximum(ring.sum(axis=0), 1) / coarse.vertex_areas
    for k, along in enumerate(tangents):
        wide = elements.dragged(along)
        _less_flat(wide, layer, coarse, along)
        _forget_flat(wide, flat)
        by_source[k] = wide.T
        give += np.einsum("vxs,vs,sy->sxy", wide.reshape(count, 3, count), ring, along)
    corners, shares, gathered = _spread(layer, coarse)
    return CoarseDrag(corners, shares, gathered, tangents, by_source, 0.5 * (give + give.transpose(0, 2, 1)))


def _less_flat(wide: np.ndarray, layer: SoftLayer, coarse: SoftLayer, ways: np.ndarray) -> None:
    """Takes the flat stack's motion from that of all coarse vertices under a traction E along a way at each (V, 3)."""
    thickness = float(np.median(layer.thickness))
    softness, every = Softness.of(layer, thickness), np.arange(len(coarse.vertices))
    banked, soft = bank(layer.tissue, thickness, softness), softness.at(coarse, thickness)
    inward, area, unit = -coarse.normals, coarse.vertex_areas, np.full(len(every), thickness)
    felt = _along_skin(coarse, thickness) if Surroundings.of(layer).folded else [every] * len(every)
    for v, there in zip(every, felt, strict=True):
        flat, one = np.zeros_like(coarse.vertices), slice(v, v + 1)
        add_motion(flat, there, coarse.vertices, inward, unit, coarse.vertices[one], inward[one], area[one], unit[one],
                   soft[one], area[v] * ways[one], banked)  # fmt: skip
        wide[:, v] -= flat.ravel()


def _forget_flat(wide: np.ndarray, flat: np.ndarray) -> None:
    """Takes away what flat skin does to flat skin: the closed form knows it, and what is left are the elements' errors.

    They made plates of little fat, or without a skin, up to 29 % too stiff. `wide` (3 C, C) is changed in place; flat:
    see `flatness`.
    """
    for v in np.flatnonzero(flat):
        wide[:, v] *= np.repeat(1 - flat * flat[v], 3)


def flatness(layer: SoftLayer, coarse: SoftLayer) -> np.ndarray:
    """How flat and even a layer is around the vertices of a coarse mesh of it, from 0, not, to 1, (C,).

    Args:
        layer: layer whose median thickness is the unit.
        coarse: the coarse mesh, or the layer itself.
    """
    t = float(np.median(layer.thickness))
    scale = 1.0 if coarse.ply_scale is None else coarse.ply_scale
    uneven = np.abs(np.log(np.column_stack([coarse.thickness / t, np.broadcast_to(scale, coarse.thickness.shape)])))
    border = coarse.vertices[coarse.border]
    out = np.zeros(len(coarse.vertices))
    for v, here in enumerate(coarse.vertices):
        near = np.linalg.norm(coarse.vertices - here, axis=1) < FLAT_AROUND * t
        to_border = np.linalg.norm(border - here, axis=1).min(initial=np.inf) / t
        area, normals = coarse.vertex_areas[near], coarse.normals[near]
        mean = area @ normals / area.sum()
        turn = float(np.sqrt(area @ ((normals - mean) ** 2).sum(axis=1) / area.sum()))
        bumps = float(np.sqrt((area @ uneven[near] ** 2 / area.sum()).max()))
        even = np.interp(turn, TURNS, (1, 0)) * np.interp(bumps, UNEVEN, (1, 0))
        out[v] = even * np.interp(to_border, BORDERS, (0, 1))
    return out


def _along_skin(coarse: SoftLayer, thickness: float) -> list[np.ndarray]:
    """Vertices that feel each one on skin with folds: those in reach of it along the skin, not through the air."""
    count = len(coarse.vertices)
    rows = np.column_stack([coarse.vertices, coarse.normals, np.full(count, thickness)])
    start, index = neighbours(rows, REACH, Edges.of(coarse.faces, count))
    return [index[a:b] for a, b in pairwise(start)]


def _spread(layer: SoftLayer, coarse: SoftLayer) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coarse vertices around each of the skin's, (V, 3), their shares, (V, 3), and the area that comes to each (C,)."""
    corners, shares = nearest_corners(coarse, layer.vertices)
    gathered = np.bincount(corners.ravel(), (shares * layer.vertex_areas[:, None]).ravel(), len(coarse.vertices))
    return corners, shares, np.maximum(gathered, 1e-12)


def _tangents(normals: np.ndarray) -> np.ndarray:
    """Two unit vectors along the skin at each vertex, at right angles, (2, V, 3)."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)])


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


class _Elements(NamedTuple):
    """Coarse elements of a layer, eliminated once for many loads.

    Args:
        layer: layer whose edges are held.
        width: unknowns of a column.
        free: mask of the unknowns that are not held.
        column: numbers of the columns that are not held.
        slabs: their stiffness [N/m].
    """

    layer: SoftLayer
    width: int
    free: np.ndarray
    column: np.ndarray
    slabs: Slabs

    @classmethod
    def of(cls, layer: SoftLayer) -> _Elements:
        """Meshes and eliminates."""
        deep = np.linalg.norm(layer.inner_vertices - layer.vertices, axis=1)
        ends, faces = wedge_ends(layer.tissue, deep, 1, layer.ply_scale), layer.faces.astype(np.int64)
        mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, faces, ELEMENT, ends=ends, ply_scale=layer.ply_scale)
        system = System(mesh, layer.tissue, [], mesh.border_columns())
        blocks: Any = system.tangent(system.zeros(), 1.0)
        count, width = len(layer.vertices), blocks.shape[1]
        free, column = np.repeat(~system.fixed, width), np.flatnonzero(~system.fixed)
        if not len(column):
            raise MeshError("every vertex of the skin is on its open border, which is held. Refine it, for instance by "
                            "stmpl_core.remesh.")  # fmt: skip
        whole = sp.bsr_matrix((blocks, mesh.indices, mesh.indptr), shape=(count * width,) * 2).tocsr()
        touch = sp.csr_matrix((np.ones(len(mesh.indices)), mesh.indices, mesh.indptr), shape=(count, count))
        slabs = [(width * one[:, None] + np.arange(width)).ravel() for one in slabs_of(touch[column][:, column])]
        with threadpool_limits(1, user_api="blas"):  # where a core is busy, OpenBLAS' two take 0.2 s for one's 5 ms
            return cls(layer, width, free, column, Slabs.of(whole[free][:, free], slabs))

    def pressed(self) -> np.ndarray:
        """Motion of every vertex under a pressure E at each, (3 V, V) [m]."""
        return self._moved(-np.einsum("ij,fx->fxij", HAT, self.layer.face_area_vectors))

    def dragged(self, ways: np.ndarray) -> np.ndarray:
        """Motion of every vertex under a traction E at each, along a way at each (V, 3), (3 V, V) [m]."""
        area = np.linalg.norm(self.layer.face_area_vectors, axis=1)
        return self._moved(np.einsum("ij,f,fjx->fxij", HAT, area, ways[self.layer.faces]))

    def _moved(self, forces: np.ndarray) -> np.ndarray:
        """The same under forces of each face on its corners i by a load at its corners j, (F, 3, i, j) [m2]."""
        count, faces = len(self.layer.vertices), self.layer.faces.astype(np.int64)
        rows = faces[:, None, :, None] * self.width + np.arange(3)[None, :, None, None]
        columns = np.broadcast_to(faces[:, None, None, :], forces.shape)
        loads = sp.csc_matrix((forces.ravel(), (np.broadcast_to(rows, forces.shape).ravel(), columns.ravel())),
                              shape=(count * self.width, count))[self.free]  # fmt: skip
        at_skin = (self.width * np.arange(len(self.column))[:, None] + np.arange(3)).ravel()
        with threadpool_limits(1, user_api="blas"):
            moved = self.slabs.solve(loads, at_skin)
        out = np.zeros((count, 3, count), np.float32)
        out[self.column] = moved.reshape(-1, 3, count) * self.layer.tissue.youngs_modulus
        return out.reshape(3 * count, count)
