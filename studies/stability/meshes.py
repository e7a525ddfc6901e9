"""Skins to test on: a round limb with a seam, and bad triangles put into a good mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stmpl_core.layer import Tissue
from studies.stability.trial import Mesh


def limb(edge_length: float, radius: float, length: float, thickness: float) -> Mesh:
    """An open cylinder along +z of nearly equilateral triangles, facing outwards.

    Its chart is cut along the line y = 0, x > 0, in whose plane the mesh is its own mirror image. Lengths in m.
    """
    around, along = round(2 * np.pi * radius / edge_length), 2 * round(length / (edge_length * 3**0.5))
    ring, place = np.meshgrid(np.arange(along + 1), np.arange(around), indexing="ij")
    angle = 2 * np.pi * (place + 0.5 * (ring % 2)) / around
    x, y, z = radius * np.cos(angle), radius * np.sin(angle), ring * length / along
    k, i = (part.ravel() for part in np.meshgrid(np.arange(along), np.arange(around), indexing="ij"))
    # corners as (ring, place), places counted on past the seam so that each face has its own side of it
    corner = {"a": (k, i), "b": (k, i + 1), "c": (k + 1, i), "d": (k + 1, i + 1)}
    even = (k % 2 == 0)[:, None, None]
    wanted = [("abc", "abd"), ("bdc", "adc")]
    faces = [np.where(even, *(np.stack([np.stack(corner[n], axis=-1) for n in names], axis=1) for names in pair))
             for pair in wanted]  # fmt: skip
    rings, places = np.moveaxis(np.concatenate(faces), -1, 0)
    turned = (places + 0.5 * (rings % 2)) / around
    scale = 0.9 / max(2.2 * np.pi * radius, length)
    uv = scale * np.stack([2 * np.pi * radius * turned, rings * length / along], axis=-1)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return Mesh(points, (rings * around + places % around).astype(np.int32), np.full(len(points), thickness),
                Tissue(), uv)  # fmt: skip


def inserted(mesh: Mesh, chosen: np.ndarray, share: tuple[float, float, float]) -> Mesh:
    """The mesh with a vertex put into each chosen face at these barycentric coordinates: the same skin, in three."""
    weights, faces, uv = np.array(share), mesh.faces[chosen], mesh.uv[chosen]
    n = len(mesh.vertices)
    number, middle = n + np.arange(len(chosen)), np.einsum("k,fki->fi", weights, uv)
    thirds, thirds_uv = [], []
    for corner in range(3):
        third, third_uv = faces.copy(), uv.copy()
        third[:, corner], third_uv[:, corner] = number, middle
        thirds.append(third)
        thirds_uv.append(third_uv)
    points = np.einsum("k,fki->fi", weights, mesh.vertices[faces])
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, points]),
        faces=np.concatenate([np.delete(mesh.faces, chosen, axis=0), *thirds]),
        uv=np.concatenate([np.delete(mesh.uv, chosen, axis=0), *thirds_uv]),
        thickness=np.concatenate([mesh.thickness, np.einsum("k,fk->f", weights, mesh.thickness[faces])]),
    )
