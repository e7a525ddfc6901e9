"""Edges of a triangle mesh: its border, the seams of its UVs, and what these divide."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from stmpl_core.arrays import Faces


def edge_table(faces: Faces) -> tuple[np.ndarray, np.ndarray]:
    """Undirected edges, (E, 2), and for each of the faces' three edges (ab, bc, ca) its number, (F, 3)."""
    directed = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    width = int(faces.max(initial=0)) + 1
    key, number = np.unique(directed.astype(np.int64) @ [width, 1], return_inverse=True)
    return np.stack(np.divmod(key, width), axis=1).astype(faces.dtype), number.reshape(-1, 3)


def seam_edges(faces: Faces, uv: np.ndarray) -> np.ndarray:
    """Edges whose two faces disagree about their UVs, (S, 2)."""
    edges, number = edge_table(faces)
    order = np.argsort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    ends = np.take_along_axis(uv[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2, 2), order[:, :, None], axis=1)
    low = np.full((len(edges), 2, 2), np.inf)
    high = np.full((len(edges), 2, 2), -np.inf)
    np.minimum.at(low, number.ravel(), ends)
    np.maximum.at(high, number.ravel(), ends)
    return edges[(high - low).max(axis=(1, 2)) > 1e-9]


def border_edges(faces: Faces) -> np.ndarray:
    """Edges with one face only, (B, 2)."""
    edges, number = edge_table(faces)
    return edges[np.bincount(number.ravel(), minlength=len(edges)) == 1]


def halved(seam: np.ndarray, faces: Faces, finer: Faces) -> np.ndarray:
    """Seam edges of `faces`, each as its two halves in `finer`, (2S, 2)."""
    edges, number = edge_table(faces)
    middle = np.empty(len(edges), int)
    middle[number] = finer[2::4]  # the inner child joins the middles of ab, bc, ca
    mids = middle[rows_of(edges, seam)]
    return np.concatenate([np.column_stack([seam[:, 0], mids]), np.column_stack([mids, seam[:, 1]])])


def rows_of(table: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Row numbers of those undirected `pairs` that a sorted edge `table` holds."""
    width = int(table.max()) + 1
    wanted = np.sort(pairs[(pairs < width).all(axis=1)], axis=1).astype(np.int64) @ [width, 1]
    keys = table.astype(np.int64) @ [width, 1]
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return rows[keys[rows] == wanted]


def pieces(faces: Faces, seam: np.ndarray) -> np.ndarray:
    """Numbers the pieces of the surface that hang together by edges not in `seam`, (F,)."""
    edges, number = edge_table(faces)
    wall = np.zeros(len(edges), bool)
    wall[rows_of(edges, seam)] = True
    order = np.argsort(number.ravel(), kind="stable")
    along, face = number.ravel()[order], order // 3
    same = (along[1:] == along[:-1]) & ~wall[along[1:]]
    graph = sp.coo_matrix((np.ones(same.sum()), (face[:-1][same], face[1:][same])), (len(faces), len(faces)))
    return connected_components(graph, directed=False)[1]


def within(faces: Faces, pairs: np.ndarray) -> np.ndarray:
    """Undirected `pairs` that are edges between two faces."""
    edges, number = edge_table(faces)
    inner = edges[np.bincount(number.ravel()) == 2]
    return inner[rows_of(inner, pairs)] if len(inner) else np.empty((0, 2), int)


def corner_fans(faces: Faces, seam: np.ndarray) -> np.ndarray:
    """Numbers the fans of corners around each vertex that no seam edge separates, (F, 3)."""
    edges, number = edge_table(faces)
    cut = np.zeros(len(edges), bool)
    cut[rows_of(edges, seam)] = True
    corner = np.arange(faces.size).reshape(-1, 3)
    table = np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1)  # each edge's two corners: ab, bc, ca
    turned = faces > np.roll(faces, -1, axis=1)
    table[turned] = table[turned][:, ::-1]  # lower vertex first
    order = np.argsort(number.ravel(), kind="stable")
    sorted_number, sorted_corners = number.ravel()[order], table.reshape(-1, 2)[order]
    same = (sorted_number[1:] == sorted_number[:-1]) & ~cut[sorted_number[1:]]
    links = np.concatenate([np.column_stack([sorted_corners[:-1][same][:, k], sorted_corners[1:][same][:, k]])
                            for k in range(2)])
    graph = sp.coo_matrix((np.ones(len(links)), links.T), (faces.size, faces.size))
    return connected_components(graph, directed=False)[1].reshape(-1, 3)
