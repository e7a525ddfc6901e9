"""SoftLayer: a skin mesh, the thickness of the soft tissue under it, and the Tissue that it is made of."""

from __future__ import annotations

import hashlib
import logging
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from stmpl_core.arrays import Faces, PerVertex, Points, VertexVectors, check_kind, finite
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.seams import border_edges, edge_table
from stmpl_core.tissue import Tissue

if TYPE_CHECKING:
    from stmpl_core.rig import Rig

log = logging.getLogger(__name__)

HOLLOW = 0.02  # volume over area^1.5 from which an open skin encloses one: half of that of a limb that is long and thin
AS_TOLD = 1e-3  # difference of the median ply_scale from 1 below which materials begin as deep as the tissue says
MAX_EXTENT = 4.0  # largest extent of a skin [m]; that of a mesh in millimetres is larger
STEEPEST = 0.35  # cosine between the normal and a column to the core, below which the column's length counts
MOST_OUTSIDE = 0.01  # share of the skin whose core may lie on its other side, as where joints fold it
MAX_THICKNESS = 0.1  # largest thickness of soft tissue [m]; that of a thickness in millimetres is larger
LOOSE = 2.0  # vertices over faces, from which triangles are not joined; a closed surface has half as many


class SoftLayer:
    """Skin over a rigid core, with a soft layer of given thickness between them.

    Args:
        vertices: positions of the skin at rest, (V, 3) [m].
        faces: vertex numbers, (F, 3), counter-clockwise seen from outside.
        thickness: thickness of the layer, measured inwards along the vertex normal, (V,) or one number [m]; None with
            a core, which says it.
        core: points of the rigid core at which the tissue's columns end, (V, 3) [m]; None: straight below each vertex.
        tissue: what lies between skin and core.
        ply_scale: factor on the depths at which deeper materials begin below each vertex, (V,) [-], > 0; None: 1.
        bony: mask of vertices under which bone is nearer than the layer knows (stmpl_core.bony), (V,); None: of none.
        chart: UV chart of the skin, if it has one (see stmpl_core.chart).
        rig: bones and joints that the skin hangs on, for Simulator.pose; None: it does not move.

    Raises:
        MeshError: empty, non-manifold, inside-out or degenerate surface, or one that looks like millimetres.
        InvalidInput: numbers that are not finite, wrong shapes, a thickness or factor not above 0, or a
            core outside of the skin.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        thickness: ArrayLike | None = None,
        *,
        core: ArrayLike | None = None,
        tissue: Tissue | None = None,
        ply_scale: ArrayLike | None = None,
        bony: ArrayLike | None = None,
        chart: Any = None,
        rig: Rig | None = None,
    ) -> None:
        self.vertices: Points = finite("vertices", vertices, (None, 3))
        self.faces: Faces = check_faces(faces, len(self.vertices))
        self.core: Points | None = None if core is None else finite("core", core, self.vertices.shape)
        if (thickness is None) == (core is None):
            raise InvalidInput("a layer wants a thickness or a core, one of them.")
        thickness = self._depth_of_core() if thickness is None else thickness
        spread = np.broadcast_to(finite("thickness", np.atleast_1d(thickness), (None,)), len(self.vertices)) \
            if np.size(thickness) == 1 else finite("thickness", thickness, (len(self.vertices),))
        self.thickness: PerVertex = np.array(spread)
        if (thickest := float(self.thickness.max(initial=0.0))) > MAX_THICKNESS:
            raise InvalidInput(f"thickness is {thickest:g} m; at most {MAX_THICKNESS:g} m is accepted. Is it in "
                               "millimetres? Scale it by 1e-3.")
        if (self.thickness <= 0).any():
            worst = int(self.thickness.argmin())
            raise InvalidInput(f"thickness is {self.thickness[worst]:g} m at vertex {worst}; it must be above 0.")
        check_kind("tissue", tissue, (Tissue, type(None)))
        self.tissue = tissue or Tissue()
        self.ply_scale: PerVertex | None = None
        if ply_scale is not None:
            self.ply_scale = finite("ply_scale", ply_scale, (len(self.vertices),))
            if (self.ply_scale <= 0).any():
                raise InvalidInput(f"ply_scale is {self.ply_scale.min():g} at its least; it must be above 0.")
        self.bony: np.ndarray | None = None if bony is None else np.array(bony, bool)
        if self.bony is not None and self.bony.shape != (len(self.vertices),):
            raise InvalidInput(f"bony has shape {self.bony.shape}, the skin has {len(self.vertices)} vertices.")
        self.chart, self.rig = chart, rig
        middle = 1.0 if self.ply_scale is None else float(np.median(self.ply_scale))
        self._middle = 1.0 if abs(middle - 1) < AS_TOLD else middle
        self._typical: SoftLayer | None = None
        if rig is not None and not hasattr(rig, "weights"):
            raise InvalidInput(f"rig is {rig!r:.40}; Rig or None is needed.")
        if rig is not None and len(rig.weights) != len(self.vertices):
            raise InvalidInput(f"the rig has weights of {len(rig.weights)} vertices, the skin has "
                               f"{len(self.vertices)}.")  # fmt: skip
        _check_surface(self)
        if self.core is not None:
            out = np.einsum("vx,vx->v", self.core - self.vertices, self.normals) > 0
            if (share := self.vertex_areas[out].sum() / self.vertex_areas.sum()) > MOST_OUTSIDE:
                raise InvalidInput(f"the core lies outside of the skin under {100 * share:.2g} % of it, first at "
                                   f"vertex {int(out.argmax())}. Inside out, or vertices and core exchanged?")

    def with_(self, **changes: Any) -> SoftLayer:
        """A copy with other vertices, thickness or core, tissue (or its fields), ply_scale, bony, chart or rig.

        Raises:
            InvalidInput: vertices without a core, where the layer has one.
        """
        if self.core is not None and "vertices" in changes and not {"core", "thickness"} & set(changes):
            raise InvalidInput("this layer's columns run to a core: changed vertices want a core, too.")
        below = self.below
        if {"core", "thickness"} & set(changes):
            below = {"ply_scale": self.ply_scale}
        material = {k: changes.pop(k) for k in ("youngs_modulus", "poisson_ratio", "density", "skin", "deeper")
                    if k in changes}
        given = {"vertices": self.vertices, "faces": self.faces, "tissue": self.tissue, "chart": self.chart}
        given |= {"rig": self.rig, "bony": self.bony}
        given |= below | changes
        check_kind("tissue", given["tissue"], Tissue)
        given["tissue"] = replace(given["tissue"], **material)
        return SoftLayer(**given)

    def moved(self, vertices: Points, core: Points | None, vertex_area_vectors: VertexVectors, vertex_areas: PerVertex,
              normals: VertexVectors) -> SoftLayer:  # fmt: skip
        """The same layer whose skin is elsewhere now, as joints take it: nothing is checked, nothing found again.

        Faces, edges, their median length, border and tissue stay. So does the thickness, where no core says it.

        Args:
            vertices: positions of the skin, (V, 3) [m].
            core: likewise of the core; None where there is none.
            vertex_area_vectors, vertex_areas, normals: see the properties.
        """
        out = copy(self)
        for name in ("inner_vertices", "face_area_vectors"):
            out.__dict__.pop(name, None)
        out.__dict__ |= {"edges": self.edges, "edge_length": self.edge_length, "border": self.border,
                         "vertex_area_vectors": vertex_area_vectors, "vertex_areas": vertex_areas,
                         "normals": normals}  # fmt: skip
        out.vertices, out.core, out.chart, out.rig = vertices, core, None, None  # a rig knows the rest alone
        out._typical = None
        if core is not None:
            out.thickness = out._depth_of_core()
        return out

    @property
    def stacked(self) -> bool:
        """Whether it is more than one material straight below the skin: a skin, deeper materials, or a core."""
        return not self.tissue.single or self.core is not None

    @property
    def typical(self) -> SoftLayer:
        """The same layer with depths of deeper materials as they are in the median: `ply_scale` about 1. Made once."""
        if self._middle == 1:
            return self
        if self._typical is None:
            deeper = tuple(replace(ply, depth=self._middle * ply.depth) for ply in self.tissue.deeper)
            out = self._typical = copy(self)
            out.tissue, out._middle = replace(self.tissue, deeper=deeper), 1.0
            out.ply_scale = np.asarray(self.ply_scale) / self._middle
        return self._typical

    @property
    def below(self) -> dict[str, np.ndarray]:
        """The arguments that say how deep layer and materials are, by name: thickness or core [m], ply_scale if any."""
        depth = {"thickness": self.thickness} if self.core is None else {"core": self.core}
        return depth if self.ply_scale is None else depth | {"ply_scale": self.ply_scale}

    def _depth_of_core(self) -> PerVertex:
        """Depth of the core below the skin, along its normal, but no less than a third of the column, (V,) [m]."""
        columns = self.vertices - self.core
        return np.maximum(np.einsum("ij,ij->i", columns, self.normals),
                          STEEPEST * np.linalg.norm(columns, axis=1))  # fmt: skip

    @cached_property
    def face_area_vectors(self) -> Points:
        """Area times outward normal of each face, shape (F, 3) [m2]."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def vertex_area_vectors(self) -> VertexVectors:
        """A third of the area vectors of the faces around each vertex, shape (V, 3) [m2].

        A pressure p_v at the vertices, interpolated linearly, presses with sum_v p_v A_v in total.
        """
        vectors = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(vectors, self.faces[:, corner], self.face_area_vectors / 3)
        return vectors

    @cached_property
    def vertex_areas(self) -> PerVertex:
        """A third of the areas of the faces around each vertex, shape (V,) [m2]."""
        areas = np.linalg.norm(self.face_area_vectors, axis=1) / 3
        return np.bincount(self.faces.ravel(), weights=np.repeat(areas, 3), minlength=len(self.vertices))

    @cached_property
    def normals(self) -> VertexVectors:
        """Outward unit normals at the vertices, area-weighted, shape (V, 3) [-]."""
        length = np.linalg.norm(self.vertex_area_vectors, axis=1, keepdims=True)
        return self.vertex_area_vectors / np.where(length > 0, length, 1.0)

    @cached_property
    def inner_vertices(self) -> Points:
        """Points where the layer is bonded to its core, (V, 3) [m]: the core, or vertices - thickness * normals."""
        return self.core if self.core is not None else self.vertices - self.thickness[:, None] * self.normals

    @cached_property
    def edges(self) -> np.ndarray:
        """Undirected edges, each once with its lower vertex first, shape (E, 2)."""
        return edge_table(self.faces)[0]

    @cached_property
    def edge_length(self) -> float:
        """Median edge length [m]."""
        return float(np.median(np.linalg.norm(np.diff(self.vertices[self.edges], axis=1)[:, 0], axis=1)))

    @cached_property
    def border(self) -> np.ndarray:
        """Numbers of the vertices on an open edge of the surface, sorted."""
        return np.unique(border_edges(self.faces))

    def __repr__(self) -> str:
        t, more = self.thickness * 1e3, ", relaxing" if self.tissue.relaxes else ""
        return (f"SoftLayer({len(self.vertices)} vertices, {len(self.faces)} faces, "
                f"thickness {t.min():.1f}..{t.max():.1f} mm, "
                f"E {self.tissue.youngs_modulus:g} Pa, nu {self.tissue.poisson_ratio:g}{more})")


def one_thickness(value: float) -> float:
    """A thickness [m]. Raises InvalidInput: no number, or not above 0 and at most MAX_THICKNESS."""
    thickness = float(finite("thickness", np.atleast_1d(value), (1,))[0])
    if not 0 < thickness <= MAX_THICKNESS:
        raise InvalidInput(f"thickness is {thickness:g} m; above 0, and at most {MAX_THICKNESS:g} m is accepted.")
    return thickness


def single(layer: SoftLayer, who: str, *, straight: bool = True, instead: str = " PatchFem knows these.") -> SoftLayer:
    """The layer, for those who know one material only, and columns straight below the skin unless `straight` is False.

    Raises:
        InvalidInput: a layer with a skin, deeper materials or a core.
    """
    tissue, more = layer.tissue, []
    if tissue.skin:
        more.append("a skin")
    if not replace(tissue, skin=None).single:
        more.append(f"{len(tissue.deeper)} deeper material{'s' * (len(tissue.deeper) > 1)}")
    if straight and layer.core is not None:
        more.append("columns that run to a core of their own")
    if more:
        raise InvalidInput(f"{who} knows one soft material{' straight below the skin' * straight}; this layer has "
                           f"{', '.join(more)}.{instead}")
    return layer


def thicker(layer: SoftLayer, by: float) -> SoftLayer:
    """The layer with all depths below its surface times a factor: columns, and where deeper materials begin.

    The surface stays, and so do the skin's own thickness and tension.

    Args:
        layer: soft layer.
        by: factor [-], > 0.

    Raises:
        InvalidInput: a factor that is not above 0, or tissue that gets thicker than is accepted.
    """
    if not 0 < by < np.inf:
        raise InvalidInput(f"the factor on the thickness is {by}; it must be finite and above 0.")
    deeper = tuple(replace(ply, depth=by * ply.depth) for ply in layer.tissue.deeper)
    if layer.core is None:
        return layer.with_(thickness=by * layer.thickness, deeper=deeper)
    return layer.with_(core=layer.vertices + by * (layer.core - layer.vertices), deeper=deeper)


def layer_id(layer: SoftLayer) -> str:
    """Sixteen hex digits that name a layer: SHA-256 of its vertices, faces, thickness and tissue, all as published.

    One that hangs on a rig is named by that, too, and at rest: Skin.layer_id does so wherever its joints are.

    Vertices and thickness count as float32, so a layer that went through SkinTopology keeps its name.
    """
    tissue = layer.tissue
    material = np.array([tissue.youngs_modulus, tissue.poisson_ratio, tissue.density])
    digest = hashlib.sha256()
    for values, kind in ((layer.vertices, "<f4"), (layer.faces, "<u4"), (layer.thickness, "<f4"), (material, "<f8")):
        digest.update(np.ascontiguousarray(values, dtype=kind).tobytes())
    if layer.core is not None:
        digest.update(np.ascontiguousarray(layer.core, dtype="<f4").tobytes())
    if tissue.relaxes:
        series = [one and one.relaxation for one in (tissue, tissue.skin, *tissue.deeper)]
        digest.update(repr([one and (one.shares, one.times) for one in series]).encode())
    if tissue.skin or tissue.deeper:
        digest.update(np.array(tissue.stacked, dtype="<f8").tobytes())
    if layer.ply_scale is not None:
        digest.update(np.ascontiguousarray(layer.ply_scale, dtype="<f4").tobytes())
    if layer.bony is not None:
        digest.update(np.flatnonzero(layer.bony).astype("<u4").tobytes())
    if layer.rig is not None:
        digest.update(layer.rig.digest.encode())
    return digest.hexdigest()[:16]


def check_faces(faces: ArrayLike, n_vertices: int) -> Faces:
    """Returns `faces` as (F, 3) int32 after checking that they name existing, distinct vertices.

    Raises:
        MeshError: empty, wrong shape, or a vertex number that does not exist or is repeated in a face.
    """
    array = face_numbers(faces, n_vertices)
    repeated = (array[:, 0] == array[:, 1]) | (array[:, 1] == array[:, 2]) | (array[:, 2] == array[:, 0])
    if repeated.any():
        raise MeshError(f"{int(repeated.sum())} faces use a vertex twice, the first is face {int(repeated.argmax())}.")
    return array


def face_numbers(faces: ArrayLike, n_vertices: int) -> Faces:
    """Returns `faces` as (F, 3) int32 after checking that they name existing vertices.

    Raises:
        MeshError: empty, wrong shape, or a vertex number that does not exist.
    """
    array = np.asarray(faces)
    if array.ndim != 2 or array.shape[1] != 3 or not len(array) or not np.issubdtype(array.dtype, np.integer):
        raise MeshError(f"faces must be integers of shape (F, 3) with F > 0; got {array.dtype} {array.shape}.")
    if array.min() < 0 or array.max() >= n_vertices:
        raise MeshError(f"faces name vertices {array.min()}..{array.max()}; the mesh has 0..{n_vertices - 1}.")
    return np.ascontiguousarray(array, dtype=np.int32)


def _check_surface(layer: SoftLayer) -> None:
    extent = float(np.ptp(layer.vertices, axis=0).max())
    if extent > MAX_EXTENT:
        raise MeshError(f"the skin is {extent:.1f} m wide; at most {MAX_EXTENT} m is accepted. "
                        "Is it in millimetres? Scale it by 1e-3.")
    area = np.linalg.norm(layer.face_area_vectors, axis=1)
    if (area <= 1e-9 * area.max()).any():
        raise MeshError(f"{int((area <= 1e-9 * area.max()).sum())} faces have no area, the first is face "
                        f"{int(area.argmin())}. Clean or remesh the skin (stmpl_core.remesh).")
    if len(layer.vertices) >= LOOSE * len(layer.faces) > 3 * LOOSE:
        raise MeshError(f"{len(layer.vertices)} vertices for {len(layer.faces)} faces: the triangles are not joined, "
                        "as in an STL file. Merge their corners, for instance by trimesh.Trimesh.merge_vertices().")
    directed = layer.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    key = directed[:, 0] * len(layer.vertices) + directed[:, 1]
    if len(np.unique(key)) != len(key):
        values, count = np.unique(key, return_counts=True)
        a, b = divmod(int(values[count > 1][0]), len(layer.vertices))
        raise MeshError(f"edge {a}->{b} is used by several faces in the same direction: the surface is non-manifold "
                        "or its faces are not oriented alike. Repair it, for instance with trimesh.repair.fix_normals.")
    middle = np.average(layer.vertices[layer.faces].mean(axis=1), axis=0, weights=area)
    volume = float(np.einsum("ij,ij->", layer.vertices[layer.faces[:, 0]] - middle, layer.face_area_vectors)) / 3
    if not len(layer.border) and volume < 0:
        raise MeshError(f"the closed skin is inside out (volume {volume:.3g} m3). "
                        "Reverse its faces: faces[:, ::-1].")
    if volume < -HOLLOW * area.sum() ** 1.5:
        log.warning("the skin faces the hollow that it encloses, and its tissue lies outside; if that is wrong, "
                    "reverse its faces: faces[:, ::-1]")  # fmt: skip
