"""Skins to test on: a round limb with a seam, and bad triangles put into a good mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stmpl_core.tissue import Tissue
from studies.stability.scene import Mesh


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


def plate(steps_x: np.ndarray, steps_y: np.ndarray, thickness: float, tissue: Tissue | None = None) -> Mesh:
    """A flat skin in the plane z = 0, facing +z, with vertices at these places along x and y [m]."""
    x, y = (part.ravel() for part in np.meshgrid(steps_x, steps_y))
    number = np.arange(len(x)).reshape(len(steps_y), len(steps_x))
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return flat(np.column_stack([x, y, 0 * x]), faces, thickness, tissue)


def flat(points: np.ndarray, faces: np.ndarray, thickness: float, tissue: Tissue | None = None) -> Mesh:
    """A skin with a chart that is its own shadow on the plane z = 0."""
    low = points[:, :2].min(axis=0)
    uv = 0.05 + 0.9 * (points[:, :2] - low) / np.ptp(points[:, :2], axis=0).max()
    return Mesh(points, faces.astype(np.int32), np.full(len(points), thickness), tissue or Tissue(), uv[faces])


def even_plate(size: float, edge_length: float, thickness: float, tissue: Tissue | None = None) -> Mesh:
    """A square plate around the origin."""
    steps = np.linspace(-size / 2, size / 2, round(size / edge_length) + 1)
    return plate(steps, steps, thickness, tissue)


def slanted_plate(size: float, edge_length: float, thickness: float) -> Mesh:
    """A rhomb around the origin, of triangles with equal sides."""
    mesh = even_plate(size, edge_length, thickness)
    return replace(mesh, vertices=mesh.vertices @ np.array([[1.0, 0, 0], [-0.5, 0.75**0.5, 0], [0, 0, 1]]))


def saddle(edge_length: float, size: float, radius: float, thickness: float) -> Mesh:
    """A square patch that is curved by 1 / radius along x and by as much the other way along y."""
    mesh = even_plate(size, edge_length, thickness)
    x, y, _ = mesh.vertices.T
    return replace(mesh, vertices=np.column_stack([x, y, (y * y - x * x) / (2 * radius)]))


def fingers(gap: float, edge_length: float, length: float, thickness: float) -> Mesh:
    """Two flat fingers along y, this far apart [m], that meet at their root beyond `length`."""
    side = edge_length * np.arange(9)
    columns = np.concatenate([-gap / 2 - side[::-1], gap / 2 + side])
    mesh = plate(columns, np.arange(0, length + 10 * edge_length, edge_length), thickness)
    x, y, _ = np.moveaxis(mesh.vertices[mesh.faces], -1, 0)
    between = (x.min(axis=1) < 0) & (x.max(axis=1) > 0) & (y.min(axis=1) < length)
    return replace(mesh, faces=mesh.faces[~between], uv=mesh.uv[~between])


def irregular(mesh: Mesh, share: float, seed: int = 0) -> Mesh:
    """A round limb along z, or a plate, whose vertices are shifted along it by up to this share of an edge.

    Those of its border stay.
    """
    rng, edge = np.random.default_rng(seed), mesh.layer.edge_length
    x, y, z = mesh.vertices.T
    free = np.ones(len(x))
    free[mesh.layer.border] = 0
    aside, along = free * share * edge * rng.uniform(-1, 1, (2, len(x)))
    if not np.ptp(z):
        return replace(mesh, vertices=np.column_stack([x + aside, y + along, z]))
    radius = np.hypot(x, y)
    angle = np.arctan2(y, x) + aside / radius
    return replace(mesh, vertices=np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z + along]))
