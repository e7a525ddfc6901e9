"""Laws of remeshing: even triangles, nothing across a seam, nothing far from the source, nothing silent."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.remesh import Remeshed, doubled_area, remesh, seam_edges

RADIUS, LENGTH = 0.04, 0.2


def tube(around: int = 15, along: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A coarse open cylinder along z with an unrolled UV map, whose seam runs along it at y = 0, x > 0."""
    angle, height = np.meshgrid(np.arange(around + 1) / around, np.arange(along + 1) / along)
    grid = np.arange((around + 1) * (along + 1)).reshape(along + 1, around + 1)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    corners = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    uv = np.column_stack([angle.ravel(), height.ravel()])[corners]
    once = (grid % (around + 1) % around) + (grid // (around + 1)) * around
    turn = 2 * np.pi * angle[:, :-1].ravel()
    vertices = np.column_stack([RADIUS * np.cos(turn), RADIUS * np.sin(turn), LENGTH * height[:, :-1].ravel()])
    return vertices, once.ravel()[corners], uv


def edge_lengths(mesh: Remeshed) -> np.ndarray:
    ends = mesh.vertices[mesh.faces]
    return np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).ravel()


def smallest_angle(mesh: Remeshed) -> float:
    corners = mesh.vertices[mesh.faces]
    a, b = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    cosine = (a * b).sum(axis=2) / np.linalg.norm(a, axis=2) / np.linalg.norm(b, axis=2)
    return float(np.degrees(np.arccos(cosine.max())))


def areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


@pytest.fixture(scope="module")
def even() -> Remeshed:
    vertices, faces, uv = tube()
    return remesh(vertices, faces, 4e-3, uv=uv)


@pytest.mark.parametrize("edge_length", [3e-3, 5e-3, 8e-3])
def test_edges_have_the_asked_length_and_triangles_are_no_slivers(edge_length: float) -> None:
    vertices, faces, uv = tube()
    mesh = remesh(vertices, faces, edge_length, uv=uv)
    lengths = edge_lengths(mesh) / edge_length
    assert np.median(lengths) == pytest.approx(1, abs=0.1)  # a grid's edges are all just within MMG's range, or none
    assert 0.6 < np.percentile(lengths, 5) and np.percentile(lengths, 95) < 1.5
    assert smallest_angle(mesh) > 25


def test_a_coarse_cylinder_is_made_round_and_keeps_its_girth(even: Remeshed) -> None:
    radius = np.linalg.norm(even.vertices[:, :2], axis=1)
    middle = np.abs(even.vertices[:, 2] - LENGTH / 2) < LENGTH / 4
    facets = RADIUS * (1 - np.cos(np.pi / 15))  # 0.87 mm: what the flat faces miss
    assert np.abs(radius[middle] - RADIUS).max() < 0.2 * facets
    assert radius[middle].mean() == pytest.approx(RADIUS, rel=2e-3)


def test_the_flat_faces_stay_when_asked() -> None:
    vertices, faces, _ = tube()
    mesh = remesh(vertices, faces, 4e-3, smooth=False)
    assert mesh.distance.max() < 1e-9
    assert areas(mesh.vertices, mesh.faces).sum() == pytest.approx(areas(vertices, faces).sum(), rel=0.01)


def test_orientation_and_borders_survive(even: Remeshed) -> None:
    corners = even.vertices[even.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = corners.mean(axis=1) * [1, 1, 0]
    assert (np.einsum("ij,ij->i", normal, outward) > 0).all()
    assert even.vertices[:, 2].min() == pytest.approx(0, abs=1e-3)
    assert even.vertices[:, 2].max() == pytest.approx(LENGTH, abs=1e-3)


def test_no_face_crosses_the_seam(even: Remeshed) -> None:
    assert even.uv is not None
    assert np.ptp(even.uv[..., 0], axis=1).max() < 0.1  # a face across the seam would span 0.9
    assert (doubled_area(even.uv) > 0).all()
    seam = even.vertices[np.unique(seam_edges(even.faces, even.uv))]
    assert np.abs(seam[:, 1]).max() < 1e-6 and (seam[:, 0] > 0).all()
    assert np.sort(seam[:, 2])[[0, -1]] == pytest.approx([0, LENGTH], abs=1e-3)


def test_uv_says_where_a_corner_is(even: Remeshed) -> None:
    assert even.uv is not None
    corners = even.vertices[even.faces]
    turn = np.arctan2(corners[..., 1], corners[..., 0]) / (2 * np.pi)
    off = (even.uv[..., 0] - turn + 0.5) % 1 - 0.5
    assert np.abs(off).max() < 0.003 and np.abs(even.uv[..., 1] - corners[..., 2] / LENGTH).max() < 0.01
    side = np.sign(corners.mean(axis=1)[:, 1])  # just above the seam u is small, just below it is near one
    near = (np.abs(corners.mean(axis=1)[:, 1]) < 3e-3) & (corners.mean(axis=1)[:, 0] > 0)
    assert ((even.uv[near].mean(axis=1)[:, 0] < 0.5) == (side[near] > 0)).all()


def test_the_transfer_gives_the_vertices_and_carries_any_other_pose(even: Remeshed) -> None:
    vertices, _, _ = tube()
    assert np.abs(even.transfer @ vertices - even.vertices).max() < 1e-12
    assert np.abs(even.transfer @ np.ones(len(vertices)) - 1).max() < 1e-12
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert np.abs(even.transfer @ (vertices @ rotation.T + 0.3) - (even.vertices @ rotation.T + 0.3)).max() < 1e-12


def test_each_vertex_lies_over_its_source_face(even: Remeshed) -> None:
    vertices, faces, _ = tube()
    assert (even.barycentric > -1e-6).all() and np.abs(even.barycentric.sum(axis=1) - 1).max() < 1e-9
    below = np.einsum("vk,vkd->vd", even.barycentric, vertices[faces[even.source_face]])
    assert np.linalg.norm(below - even.vertices, axis=1).max() < 2e-3


def test_a_cut_follows_its_level() -> None:
    vertices, faces, uv = tube()
    mesh = remesh(vertices, faces, 4e-3, uv=uv, inside=0.13 - vertices[:, 2])
    assert mesh.vertices[:, 2].max() == pytest.approx(0.13, abs=2.5e-3)
    assert smallest_angle(mesh) > 20
    whole = areas(vertices, faces).sum()
    assert areas(mesh.vertices, mesh.faces).sum() == pytest.approx(whole * 0.13 / LENGTH, rel=0.03)


def test_the_same_input_gives_the_same_mesh(even: Remeshed) -> None:
    vertices, faces, uv = tube()
    again = remesh(vertices, faces, 4e-3, uv=uv)
    assert np.array_equal(even.faces, again.faces) and np.array_equal(even.vertices, again.vertices)


@settings(max_examples=8, deadline=None)
@given(shift=st.tuples(*[st.floats(-1, 1)] * 3), scale=st.floats(0.5, 2))
def test_it_works_without_uvs_wherever_the_mesh_is(shift: tuple[float, ...], scale: float) -> None:
    vertices, faces, _ = tube()
    mesh = remesh(vertices * scale + shift, faces, 8e-3 * scale)
    assert mesh.uv is None
    assert np.median(edge_lengths(mesh)) == pytest.approx(8e-3 * scale, rel=0.08)


def test_a_finer_mesh_is_coarsened_without_being_smoothed() -> None:
    vertices, faces, _ = tube(60, 48)
    mesh = remesh(vertices, faces, 8e-3)
    assert len(mesh.vertices) < len(vertices) and mesh.distance.max() < 1e-9


@pytest.mark.parametrize("edge_length", [3.0, np.nan, 0.0, -1e-3, 1e-6])
def test_an_edge_length_out_of_proportion_is_refused(edge_length: float) -> None:
    vertices, faces, _ = tube()
    with pytest.raises(InvalidInput, match=r"edge_length is .* allowed is"):
        remesh(vertices, faces, edge_length)


def test_what_is_no_surface_is_refused() -> None:
    vertices, faces, uv = tube()
    with pytest.raises(MeshError, match="F > 0"):
        remesh(vertices, np.empty((0, 3), int), 3e-3)
    with pytest.raises(InvalidInput, match="not finite"):
        remesh(np.where(np.arange(len(vertices))[:, None] == 3, np.nan, vertices), faces, 3e-3)
    with pytest.raises(MeshError, match="not a manifold"):
        remesh(vertices, np.concatenate([faces, faces[:1, ::-1], faces[:1]]), 3e-3)
    with pytest.raises(MeshError, match="nowhere above 0"):
        remesh(vertices, faces, 3e-3, inside=-np.ones(len(vertices)))
    with pytest.raises(InvalidInput, match="uv has shape"):
        remesh(vertices, faces, 3e-3, uv=uv[:-1])
