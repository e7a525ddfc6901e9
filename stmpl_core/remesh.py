"""Even remeshing of a skin to an asked edge length, over a curved surface, keeping its UV seams."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import igl as libigl
import mmgpy
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from stmpl_core.arrays import Faces, PerVertex, Points, finite, is_number
from stmpl_core.chart import doubled_area
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.layer import check_faces
from stmpl_core.seams import border_edges, corner_fans, edge_table, halved, pieces, seam_edges, within

log = logging.getLogger(__name__)
igl: Any = libigl  # its stubs call every array an ArrayLike

MAX_LEVELS = 4  # levels of subdivision: 256 faces for one
SEAM, OUTSIDE = 7, 2  # MMG's references: ours for seam edges, its own for triangles beyond a level set
MAX_SNAP_SHARE = 0.35  # share of an edge within which a cut passes through the vertex itself: no sliver beside it
MIN_ISLAND_SHARE = 0.03  # share of a part below which a UV island is the edge of a neighbour's
RELAXATION = 5  # passes of relaxation; more changed no figure of quality by over 2 %


@dataclass(frozen=True, eq=False)
class Remeshed:
    """An even mesh of a skin, and where each of its vertices comes from.

    Args:
        vertices: positions, (V, 3) [m].
        faces: vertex numbers, (F, 3), oriented as the source is.
        uv: texture coordinates of each corner, (F, 3, 2) [-], each face on one side of a seam; None if the source has
            none.
        transfer: sparse matrix, (V, V_source), rows sum to 1: `vertices == transfer @ source_vertices`.
        source_face: number of the source's face under each vertex, (V,).
        barycentric: coordinates in that face, (V, 3) [-].
        distance: distance of each vertex from the source's flat faces, (V,) [m].
    """

    vertices: Points
    faces: Faces
    uv: np.ndarray | None
    transfer: sp.csr_matrix
    source_face: np.ndarray
    barycentric: Points
    distance: PerVertex


@dataclass(frozen=True, eq=False)
class _Dense:
    """The source, subdivided: vertices (N, 3), faces, and for each face its parent and its corners in it."""

    vertices: Points
    faces: Faces
    matrix: sp.csr_matrix  # transfer, (N, V_source)
    parent: np.ndarray  # source's face of each face, (faces,)
    corners: np.ndarray  # barycentric coordinates of the corners in the parent, (faces, 3, 3)


def remesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    edge_length: float,
    *,
    uv: ArrayLike | None = None,
    inside: ArrayLike | None = None,
    smooth: bool = True,
) -> Remeshed:
    """Remeshes a surface to even triangles with edges of `edge_length`.

    A coarse mesh is subdivided first: its flat faces are no skin. Loop's scheme (Loop 1987) alone shrinks a limb, so
    its control points are corrected twice, c <- c + (v - S c), towards a surface through the given vertices
    (progressive interpolation, Cheng et al. 2009). MMG (Dapogny et al. 2014) then makes even triangles, with the UV
    seams as reference curves that no triangle crosses; a few passes of tangential relaxation (Botsch & Kobbelt 2004)
    even them out, and each vertex ends on the subdivided surface.

    Args:
        vertices: positions, (V, 3) [m].
        faces: vertex numbers, (F, 3).
        edge_length: length that the new edges should have [m].
        uv: texture coordinates of each corner, (F, 3, 2).
        inside: level at each vertex, (V,); the skin is cut along its zero line and kept where it is positive, without
            scraps of UV islands that it only brushes.
        smooth: subdivision to a curved surface; False keeps the flat faces, for a mesh whose creases are meant.

    Raises:
        MeshError: a surface that is no manifold, nothing inside, or MMG fails.
        InvalidInput: wrong shapes, not finite, or an edge length out of proportion to the surface.
    """
    points = finite("vertices", vertices, (None, 3))
    triangles = check_faces(faces, len(points))
    _check_edge_length(points, triangles, edge_length)
    corner_uv = None if uv is None else finite("uv", uv, (len(triangles), 3, 2))
    seam = np.empty((0, 2), int) if corner_uv is None else seam_edges(triangles, corner_uv)
    dense, seam = _subdivided(points, triangles, seam, edge_length, smooth)
    surface, kept_seam = (dense.vertices, dense.faces), seam
    if inside is not None:
        surface, kept_seam = _cut(dense, seam, dense.matrix @ finite("inside", inside, (len(points),)))
    even, even_faces, even_seam = _mmg(*surface, kept_seam, hsiz=edge_length)
    even = _relaxed(even, even_faces, even_seam, dense, seam, border_edges(surface[1]), surface[0])
    return _traced(even, even_faces, even_seam, dense, (points, triangles), corner_uv)


def _check_edge_length(points: Points, faces: Faces, edge_length: float) -> None:
    shared = np.bincount(edge_table(faces)[1].ravel())
    if (shared > 2).any():
        raise MeshError(f"{int((shared > 2).sum())} edges have more than two faces: the surface is not a manifold. "
                        "Repair it first, for instance with trimesh.")
    if not is_number(edge_length):
        raise InvalidInput(f"edge_length is {edge_length!r:.40}; a number is needed.")
    extent = float(np.ptp(points, axis=0).max())
    if not (np.isfinite(edge_length) and 1e-3 * extent < edge_length < 0.5 * extent):
        raise InvalidInput(f"edge_length is {edge_length} m on a surface {extent:.3g} m wide; allowed is "
                           f"{1e-3 * extent:.2g}..{0.5 * extent:.2g} m. Is one of them in millimetres?")


def _subdivided(
    points: Points, faces: Faces, seam: np.ndarray, edge_length: float, smooth: bool
) -> tuple[_Dense, np.ndarray]:
    """The curved surface through `points`, with edges of about `edge_length`, and the seam edges on it."""
    edges, _ = edge_table(faces)
    longest = float(np.percentile(np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1), 50))
    levels = int(np.clip(np.ceil(np.log2(longest / (1.5 * edge_length))), 0, MAX_LEVELS))
    matrix = sp.csr_matrix(sp.identity(len(points)))
    parent, corners = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3))
    for _ in range(levels):
        step, finer = (igl.loop_matrix if smooth else igl.upsample_matrix)(faces.astype(np.int64))
        halves = _first_order(faces, finer)
        corners = np.einsum("fkc,fcp->fkp", halves, np.repeat(corners, 4, axis=0))
        seam = halved(seam, faces, finer)
        parent, faces, matrix = np.repeat(parent, 4), finer, sp.csr_matrix(step @ matrix)
    if smooth and levels:
        matrix = _interpolating(matrix)
    return _Dense(np.ascontiguousarray(matrix @ points), faces, matrix, parent, np.ascontiguousarray(corners)), seam


def _first_order(faces: Faces, finer: Faces) -> np.ndarray:
    """Barycentric coordinates of the corners of the four children of each face in it, (4F, 3, 3)."""
    ab, bc, ca = np.array([[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]])
    a, b, c = np.eye(3)
    if not ((finer[0::4, 0] == faces[:, 0]).all() and (finer[3::4, 1] == faces[:, 2]).all()):
        raise MeshError("libigl numbers the children of a face in another order than expected; use libigl 2.6.")
    child = np.array([[a, ab, ca], [b, bc, ab], [ab, bc, ca], [bc, c, ca]])
    return np.tile(child, (len(faces), 1, 1))


def _interpolating(matrix: Any) -> sp.csr_matrix:
    """S with its control points corrected twice, c <- c + (v - S c), as one matrix."""
    n = matrix.shape[1]
    identity = sp.csr_matrix(sp.identity(n))
    controls = identity
    for _ in range(2):
        controls = controls + identity - matrix[:n] @ controls
    return sp.csr_matrix(matrix @ controls)


def _cut(dense: _Dense, seam: np.ndarray, level: PerVertex) -> tuple[tuple[Points, Faces], np.ndarray]:
    """The part of the surface where `level` > 0, and the seam edges on it."""
    if not (level > 0).any():
        raise MeshError("nothing of the skin lies inside: the level is nowhere above 0.")
    if (level > 0).all():
        return (dense.vertices, dense.faces), seam
    edges, _ = edge_table(dense.faces)
    a, b = level[edges[:, 0]], level[edges[:, 1]]
    crossing = a * b < 0
    share = a[crossing] / (a[crossing] - b[crossing])
    level = level.copy()
    level[edges[crossing, 0][share < MAX_SNAP_SHARE]] = 0
    level[edges[crossing, 1][share > 1 - MAX_SNAP_SHARE]] = 0
    vertices, faces, seam, reference = _mmg_raw(
        dense.vertices, dense.faces, seam, level=-level, nomove=1, noswap=1, noinsert=1
    )
    faces = faces[reference != OUTSIDE]
    faces = faces[_without_scraps(vertices, faces, seam)]
    (vertices, faces), renumber = _compact(vertices, faces)
    seam = renumber[seam]
    seam = seam[(seam >= 0).all(axis=1)]
    return (vertices, faces), within(faces, seam)


def _without_scraps(vertices: Points, faces: Faces, seam: np.ndarray) -> np.ndarray:
    """Which faces to keep: not the scraps of neighbouring UV islands, and of what is left the largest piece."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    island = pieces(faces, seam)
    share = np.bincount(island, area) / area.sum()
    keep = share[island] > MIN_ISLAND_SHARE
    piece = np.full(len(faces), -1)
    piece[keep] = pieces(faces[keep], np.empty((0, 2), int))
    largest = np.bincount(piece[keep], area[keep]).argmax()
    if (piece != largest).any():
        log.info("left out %.1f %% of the part: scraps beyond a UV seam, or separate pieces",
                 100 * area[piece != largest].sum() / area.sum())
    return piece == largest


def _compact(vertices: Points, faces: Faces) -> tuple[tuple[Points, Faces], np.ndarray]:
    """The mesh without unused vertices, and the new number of each old vertex, or -1."""
    used = np.unique(faces)
    renumber = np.full(len(vertices), -1)
    renumber[used] = np.arange(len(used))
    return (vertices[used], renumber[faces]), renumber


def _mmg(vertices: Points, faces: Faces, seam: np.ndarray, *, hsiz: float) -> tuple[Points, Faces, np.ndarray]:
    vertices, faces, seam, _ = _mmg_raw(vertices, faces, seam, hsiz=hsiz)
    return vertices, faces, seam


def _mmg_raw(
    vertices: Points, faces: Faces, seam: np.ndarray, *, level: PerVertex | None = None, **options: Any
) -> tuple[Points, Faces, np.ndarray, np.ndarray]:
    """One run of MMG: vertices, faces, seam edges and the faces' references.

    hausd is loose because the result is projected onto the surface afterwards; tight, it breaks up the even edges.
    """
    mesh = mmgpy.MmgMeshS()
    mesh.set_mesh_size(vertices=len(vertices), triangles=len(faces), edges=len(seam))
    mesh.set_vertices(np.ascontiguousarray(vertices))
    mesh.set_triangles(np.ascontiguousarray(faces, dtype=np.int32))
    if len(seam):
        mesh.set_edges(np.ascontiguousarray(seam, dtype=np.int32), np.full(len(seam), SEAM, np.int64))
    quiet = {"verbose": -1, "angle": 0, "hgrad": -1.0, "hausd": 1e-3} | options
    try:
        with _signals_kept():
            if level is None:
                mesh.remesh(**quiet)
            else:
                mesh.remesh_levelset(np.ascontiguousarray(level[:, None]), **quiet)
    except RuntimeError as error:
        raise MeshError(f"MMG could not remesh this surface ({len(vertices)} vertices): {error}. "
                        "Look for folds and self-intersections, or ask for another edge length.") from error
    triangles, reference = mesh.get_triangles_with_refs()
    edges, edge_reference = mesh.get_edges_with_refs() if len(seam) else (np.empty((0, 2), int), np.empty(0, int))
    return mesh.get_vertices(), triangles.astype(np.int64), edges[edge_reference == SEAM].astype(np.int64), reference


@contextmanager
def _signals_kept() -> Iterator[None]:
    """MMG sets SIGINT and SIGTERM back to the system's default; this gives Python's handlers back their place."""
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.getsignal(number) or signal.SIG_DFL)


def _relaxed(
    x: Points, faces: Faces, seam: np.ndarray, dense: _Dense, dense_seam: np.ndarray, border: np.ndarray, cut: Points
) -> Points:
    """Moves vertices towards the centroids of the faces around them, along the surface, the seam or the border."""
    edges_border = border_edges(faces)
    curves = np.concatenate([edges_border, seam])
    ways = np.bincount(curves.ravel(), minlength=len(x))
    on_border, on_seam = np.zeros((2, len(x)), bool)
    on_border[edges_border], on_seam[seam] = True, True
    fixed = (on_border & on_seam) | ((ways > 0) & (ways != 2))
    along = sp.csr_matrix((np.ones(len(curves)), curves.T), (len(x), len(x)))
    along = along + along.T
    groups = [(~(on_border | on_seam), dense.vertices, dense.faces), (on_border & ~fixed, cut, border),
              (on_seam & ~fixed, dense.vertices, dense_seam)]
    for _ in range(RELAXATION):
        moved = x + 0.7 * _towards_centroids(x, faces)
        curve = (ways > 0) & ~fixed
        moved[curve] = 0.5 * x[curve] + 0.25 * (along @ x)[curve]
        moved[fixed] = x[fixed]
        for here, points, simplices in groups:
            if here.any():
                moved[here] = igl.point_mesh_squared_distance(moved[here], points, simplices.astype(np.int64))[2]
        x = moved
    return x


def _towards_centroids(x: Points, faces: Faces) -> Points:
    """From each vertex to the area-weighted centroid of the faces around it, without its normal part."""
    corners = x[faces]
    area_vector = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(area_vector, axis=1)
    ring = sp.csr_matrix((np.ones(faces.size), (faces.ravel(), np.repeat(np.arange(len(faces)), 3))),
                         (len(x), len(faces)))
    step = (ring @ (corners.mean(axis=1) * area[:, None])) / (ring @ area)[:, None] - x
    normal = ring @ area_vector
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return step - normal * np.einsum("ij,ij->i", step, normal)[:, None]


def _traced(
    x: Points, faces: Faces, seam: np.ndarray, dense: _Dense, source: tuple[Points, Faces], uv: np.ndarray | None
) -> Remeshed:
    """Puts each vertex on the dense surface, and says where it comes from."""
    face, barycentric = _closest(x, dense)
    rows = np.repeat(np.arange(len(x)), 3)
    onto = sp.csr_matrix((barycentric.ravel(), (rows, dense.faces[face].ravel())), (len(x), len(dense.vertices)))
    transfer = sp.csr_matrix(onto @ dense.matrix)
    vertices = np.ascontiguousarray(transfer @ source[0])
    distance = np.sqrt(igl.point_mesh_squared_distance(vertices, source[0], source[1].astype(np.int64))[0])
    corner_uv = None if uv is None else _corner_uv(vertices, faces, seam, dense, uv, (face, barycentric))
    log.debug("remeshed %d -> %d vertices; distance to the flat faces: mean %.2f mm, largest %.2f mm",
              len(source[0]), len(x), distance.mean() * 1e3, distance.max() * 1e3)
    return Remeshed(vertices, faces.astype(np.int32), corner_uv, transfer, dense.parent[face],
                    np.einsum("vk,vkp->vp", barycentric, dense.corners[face]), distance)


def _closest(x: Points, dense: _Dense) -> tuple[np.ndarray, Points]:
    """The dense face closest to each point, and where in it."""
    _, face, point = igl.point_mesh_squared_distance(np.ascontiguousarray(x), dense.vertices, dense.faces)
    return face, _barycentric(point, dense.vertices[dense.faces[face]])


def _barycentric(points: Points, triangles: np.ndarray) -> Points:
    """Barycentric coordinates of points in the planes of triangles (N, 3, 3); outside of one they extrapolate."""
    e1, e2, d = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0], points - triangles[:, 0]
    a, b, c = (np.einsum("ij,ij->i", p, q) for p, q in ((e1, e1), (e1, e2), (e2, e2)))
    f, g = np.einsum("ij,ij->i", d, e1), np.einsum("ij,ij->i", d, e2)
    det = a * c - b * b
    v, w = (c * f - b * g) / det, (a * g - b * f) / det
    return np.column_stack([1 - v - w, v, w])


def _corner_uv(
    x: Points, faces: Faces, seam: np.ndarray, dense: _Dense, uv: np.ndarray, traced: tuple[np.ndarray, Points]
) -> np.ndarray:
    """UVs of the corners, (F, 3, 2): on a seam each corner looks on its own face's side, then each fan agrees."""
    dense_uv = np.einsum("fkp,fpd->fkd", dense.corners, uv[dense.parent])
    result = np.einsum("vk,vkd->vd", traced[1], dense_uv[traced[0]])[faces]
    unsure = np.zeros(len(x), bool)  # borders too: a part may end at a seam
    unsure[seam], unsure[border_edges(faces)] = True, True
    face, corner = np.nonzero(unsure[faces])
    at = x[faces[face, corner]]
    aside, _ = _closest(at + 0.2 * (x[faces[face]].mean(axis=1) - at), dense)
    there = _barycentric(at, dense.vertices[dense.faces[aside]])
    result[face, corner] = np.einsum("vk,vkd->vd", there, dense_uv[aside])
    fan = corner_fans(faces, seam)
    count = np.bincount(fan.ravel())
    mean = np.column_stack([np.bincount(fan.ravel(), result[..., k].ravel()) / count for k in range(2)])
    return _unturned(mean[fan], x[faces], dense, dense_uv)


def _unturned(uv: np.ndarray, corners: np.ndarray, dense: _Dense, dense_uv: np.ndarray) -> np.ndarray:
    """Faces that the averaging turned over or crushed, as a sliver in a seam's corner may be, look up UVs alone."""
    below, _ = _closest(corners.mean(axis=1), dense)
    there = [_barycentric(corners[:, k], dense.vertices[dense.faces[below]]) for k in range(3)]
    alone = np.stack([np.einsum("fk,fkd->fd", weights, dense_uv[below]) for weights in there], axis=1)
    wrong = ~(doubled_area(uv) / doubled_area(alone) > 0.1)
    if wrong.any():
        log.debug("%d faces look up their UVs alone", int(wrong.sum()))
    return np.where(wrong[:, None, None], alone, uv)
