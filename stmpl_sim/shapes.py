"""Shapes: surfaces of MuJoCo's geoms as triangles, for tools and for pictures."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from stmpl_core.arrays import Faces, Points, Transform
from stmpl_core.errors import InvalidInput
from stmpl_sim.engine import mujoco

BALL_SPLITS = 4  # times that the icosahedron of a ball is split: 2,562 corners, radius met to 0.05 %
ROUND = 64  # corners around a cylinder or a capsule
CELLS, NODES = 6, 3e6  # of a grid across the thinnest part of a union with open parts, and in all
OFF_NODES = 0.37  # cells by which the nodes of a union's grid are off its faces: on them marching cubes leaves gaps
KINDS = "sphere, capsule, ellipsoid, cylinder, box and mesh"


class Surface(NamedTuple):
    """Triangles: vertices (N, 3) [m], and faces (M, 3), counter-clockwise seen from outside."""

    vertices: Points
    faces: Faces


def geom_surface(model: Any, geom: int) -> Surface:
    """Surface of a geom in its own frame, (data.geom_xpos, data.geom_xmat) in the world.

    Raises:
        InvalidInput: a plane, a height field or a signed distance field, which no tool can be.
    """
    import trimesh

    kind, size = int(model.geom_type[geom]), np.array(model.geom_size[geom])
    kinds = mujoco.mjtGeom
    if kind == kinds.mjGEOM_SPHERE:
        mesh = trimesh.creation.icosphere(BALL_SPLITS, size[0])
    elif kind == kinds.mjGEOM_ELLIPSOID:
        mesh = trimesh.creation.icosphere(BALL_SPLITS, 1.0)
        mesh.apply_scale(size)
    elif kind == kinds.mjGEOM_CAPSULE:
        arc = np.linspace(-np.pi / 2, np.pi / 2, ROUND // 2 + 2)
        shift = np.where(arc < 0, -size[1], size[1])
        outline = np.stack([size[0] * np.cos(arc), size[0] * np.sin(arc) + shift], axis=1)
        outline[[0, -1], 0] = 0.0
        mesh = trimesh.creation.revolve(1e3 * outline, sections=ROUND)  # in metres it drops the triangles at the ends
        mesh.apply_scale(1e-3)
    elif kind == kinds.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=ROUND)
    elif kind == kinds.mjGEOM_BOX:
        mesh = trimesh.creation.box(extents=2 * size)
    elif kind == kinds.mjGEOM_MESH:
        return _mesh_surface(model, int(model.geom_dataid[geom]))
    else:
        name = kinds(kind).name.removeprefix("mjGEOM_").lower()
        raise InvalidInput(f"geom '{model.geom(geom).name or geom}' is a {name}; a tool can be a {KINDS}.")
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int32))


def _mesh_surface(model: Any, mesh: int) -> Surface:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    at, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return Surface(model.mesh_vert[first : first + count].astype(float), model.mesh_face[at : at + faces].copy())


def body_surface(model: Any, geoms: list[int], body: int) -> Surface:
    """Surface of several geoms of one body together, and of bodies welded to it from below, in the body's frame: of
    their union, without inner walls."""
    parts = []
    for geom in geoms:
        surface, pose, on = geom_surface(model, geom), geom_in_body(model, geom), int(model.geom_bodyid[geom])
        while on != body:
            pose, on = _placed(model.body_pos[on], model.body_quat[on]) @ pose, int(model.body_parentid[on])
        parts.append(Surface(surface.vertices @ pose[:3, :3].T + pose[:3, 3], surface.faces))
    return parts[0] if len(parts) == 1 else _union(parts)


def geom_in_body(model: Any, geom: int) -> Transform:
    """pose_body_from_geom, (4, 4)."""
    return _placed(model.geom_pos[geom], model.geom_quat[geom])


def _placed(position: np.ndarray, quaternion: np.ndarray) -> Transform:
    """Pose of a position (3,) [m] and a quaternion (4,), scalar first, (4, 4)."""
    turn, pose = np.empty(9), np.eye(4)
    mujoco.mju_quat2Mat(turn, quaternion)
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), position
    return pose


def _union(parts: list[Surface]) -> Surface:
    """Surface around all parts: exact where they are closed, else by a grid (`_union_on_grid`)."""
    import trimesh

    meshes = [trimesh.Trimesh(part.vertices, part.faces, process=True) for part in parts]
    for mesh in meshes:
        mesh.update_faces(mesh.nondegenerate_faces())
    if not all(mesh.is_volume for mesh in meshes):
        return _union_on_grid(parts)
    whole = trimesh.boolean.union(meshes, engine="manifold")
    return Surface(np.asarray(whole.vertices), np.asarray(whole.faces, dtype=np.int32))


def _union_on_grid(parts: list[Surface]) -> Surface:
    """Zero of the least of the parts' distances, by marching cubes: corners are rounded by about a cell.

    Raises:
        InvalidInput: parts so thin that a grid with CELLS across them has more than NODES nodes.
    """
    import igl

    points = np.concatenate([part.vertices for part in parts])
    low, high = points.min(axis=0), points.max(axis=0)
    thinnest = min(float(np.ptp(part.vertices, axis=0).min()) for part in parts)
    spacing = min(float((high - low).max()) / 72, thinnest / CELLS)
    if not np.prod((high - low) / max(spacing, 1e-300) + 5) < NODES:
        raise InvalidInput(f"geoms of one body that is a tool are {1e3 * thinnest:.2g} mm thin and "
                           f"{1e3 * (high - low).max():.3g} mm long together, and one of their meshes is open. Close "
                           "it, or name the geom that touches as the tool.")  # fmt: skip
    axes = [np.arange(a - (2 + OFF_NODES) * spacing, b + 3 * spacing, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    nodes = np.ascontiguousarray(grid.transpose(2, 1, 0, 3).reshape(-1, 3))  # x runs fastest, as igl counts
    least = np.full(len(nodes), np.inf)
    for part in parts:
        distance = igl.signed_distance(nodes, part.vertices, part.faces.astype(np.int64),
                                       sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER)[0]  # fmt: skip
        least = np.minimum(least, distance)
    across, along, up = grid.shape[:3]
    vertices, faces = igl.marching_cubes(least, nodes, across, along, up, 0.0)[:2]
    return Surface(np.asarray(vertices), np.asarray(faces, dtype=np.int32))
