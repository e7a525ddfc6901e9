"""The signed distance field against exact shapes, its derivatives, and what it refuses."""

import igl
import numpy as np
import pytest
import trimesh

from stmpl_core import Tool
from stmpl_core.decimation import MAX_NODES
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.sdf import SignedDistance
from stmpl_core.winding import winding_numbers
from tests.scenes import ball, box, capsule, scaled, tool

POINTS = np.random.default_rng(1).uniform(-0.02, 0.02, (20_000, 3))


@pytest.fixture(scope="module")
def sphere() -> SignedDistance:
    return SignedDistance.of(ball(0.01, 4), spacing=4.3e-4)


def test_distance_to_a_sphere_is_exact_but_for_its_facets(sphere: SignedDistance) -> None:
    exact = np.linalg.norm(POINTS, axis=1) - 0.01
    error = np.abs(sphere.distance(POINTS) - exact)
    sagitta = 0.01 * (1 - np.cos(0.075 / 2)) * 4  # of a facet with edges of 0.075 radians, at its middle, generously
    assert error[np.abs(exact) < 4e-3].max() < sagitta + 3e-5
    assert sphere.surface_error < 2e-5


def test_distance_to_a_box_is_exact_but_for_rounded_edges() -> None:
    half = np.array([0.01, 0.0125, 0.006])
    field = SignedDistance.of(box(*2 * half), spacing=5e-4)
    q = np.abs(POINTS) - half
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    error = np.abs(field.distance(POINTS) - exact)
    near = np.abs(exact) < 1e-3
    away_from_edges = np.sort(np.abs(q), axis=1)[:, 1] > 3e-3
    assert error[near].max() < 0.3 * field.spacing
    assert error[near & away_from_edges].max() < 0.01 * field.spacing


def test_distance_to_a_capsule() -> None:
    field = SignedDistance.of(capsule(0.03, 0.008, 48), spacing=5e-4)
    assert field.watertight
    middle = np.clip(POINTS[:, 2], -0.015, 0.015)[:, None] * [0, 0, 1]
    exact = np.linalg.norm(POINTS - middle, axis=1) - 0.008
    assert np.abs(field.distance(POINTS) - exact)[np.abs(exact) < 2e-3].max() < 6e-5


def test_field_converges_with_its_spacing() -> None:
    """An edge is rounded over a width that shrinks with the spacing, by a share of it: the mean error falls as h^2."""
    half = np.array([0.0097, 0.0108, 0.0091])
    q = np.abs(POINTS) - half
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    near = np.abs(exact) < 1e-3
    mesh = box(*2 * half)
    errors = [np.abs(SignedDistance.of(mesh, spacing=h).distance(POINTS[near]) - exact[near]).mean()
              for h in (2e-3, 1e-3, 5e-4)]
    assert np.log2(errors[0] / errors[1]) > 1.5 and np.log2(errors[1] / errors[2]) > 1.5


def test_gradient_and_hessian_are_those_of_the_distance(sphere: SignedDistance) -> None:
    points = 1.6 * POINTS[:300]  # some outside the grid
    low, high = sphere.bounds
    points = points[(np.minimum(np.abs(points - low), np.abs(points - high)) > 1e-5).all(axis=1)]
    assert ((points < low) | (points > high)).any(axis=1).sum() > 50
    _, gradient, hessian = sphere.distance_gradient_hessian(points)
    step = 1e-6 * np.eye(3)
    slope = np.stack([(sphere.distance(points + e) - sphere.distance(points - e)) / 2e-6 for e in step], axis=1)
    bend = np.stack([(sphere.distance_gradient(points + e)[1] - sphere.distance_gradient(points - e)[1]) / 2e-6
                     for e in step], axis=2)
    np.testing.assert_allclose(gradient, slope, atol=1e-6)
    np.testing.assert_allclose(hessian, bend, atol=2e-4 * np.abs(hessian).max())


def test_gradient_is_continuous_across_cells(sphere: SignedDistance) -> None:
    low, _ = sphere.bounds
    edge = low + sphere.spacing * np.arange(3, 60)[:, None]
    _, left, bend_left = sphere.distance_gradient_hessian(edge - 1e-9)
    _, right, bend_right = sphere.distance_gradient_hessian(edge + 1e-9)
    np.testing.assert_allclose(left, right, atol=1e-5)
    np.testing.assert_allclose(bend_left, bend_right, atol=1e-4 * np.abs(bend_left).max())


def test_outside_the_grid_the_distance_is_a_continuous_lower_bound(sphere: SignedDistance) -> None:
    far = 10 * POINTS
    exact = np.linalg.norm(far, axis=1) - 0.01
    outside = ((far < sphere.bounds[0]) | (far > sphere.bounds[1])).any(axis=1)
    answer = sphere.distance(far)[outside]
    assert (answer <= exact[outside] + 2e-5).all() and (answer > 0.4 * exact[outside]).all()
    high = np.diag(sphere.bounds[1])
    np.testing.assert_allclose(sphere.distance(high * (1 + 1e-9)), sphere.distance(high * (1 - 1e-9)), atol=1e-9)


def test_distance_alone_is_that_which_comes_with_its_derivatives(sphere: SignedDistance) -> None:
    low, high = sphere.bounds
    points = np.random.default_rng(3).uniform(low - 5e-3, high + 5e-3, (500, 3))
    alone = sphere.distance(points)
    np.testing.assert_allclose(alone, sphere.distance_gradient_hessian(points)[0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(alone, sphere.distance_gradient(points)[0], rtol=0, atol=1e-15)


def test_a_thin_stick_may_lie_askew_in_its_own_frame() -> None:
    """Its box is large beside it: the grid that is chosen fits all the same."""
    for angle in (0.6, 0.8, 1.0):
        stick = trimesh.creation.cylinder(radius=2e-3, height=0.6, sections=16)  # too coarse to be round
        stick.apply_transform(trimesh.transformations.rotation_matrix(angle, [0, 1, 0]))
        assert SignedDistance.of(tool(stick)).coefficients.size <= MAX_NODES


def test_an_open_shell_still_has_an_inside() -> None:
    shell = trimesh.creation.icosphere(4, 0.01)
    shell.update_faces(shell.triangles_center[:, 2] < 0.008)
    field = SignedDistance.of(tool(shell))
    assert not field.watertight
    assert field.distance([[0, 0, 0], [0, 0, -0.009]]).max() < 0 < field.distance([[0, 0, -0.011]])[0]


def test_a_mesh_inside_out_is_turned_and_says_so() -> None:
    mesh = ball()
    field = SignedDistance.of(Tool("probe", mesh.vertices, mesh.faces[:, ::-1]))
    assert field.flipped and field.watertight
    assert field.distance([[0, 0, 0]])[0] < 0


def test_how_often_a_surface_goes_round_a_node_is_a_whole_number() -> None:
    """Nodes on faces, edges and corners too: of a box that is in line with the grid, and of two that overlap."""
    nodes = np.stack(np.meshgrid(*(np.arange(12),) * 3, indexing="ij"), axis=-1)
    bodies = [trimesh.creation.box(bounds=[[1, 1, 1], [7, 7, 7]]), trimesh.creation.box(bounds=[[4, 4, 4], [10, 9, 8]])]
    numbers = winding_numbers(np.concatenate([body.triangles for body in bodies]), np.zeros(3), 1.0, np.full(3, 12))
    inside = [(nodes > body.bounds[0]) & (nodes < body.bounds[1]) for body in bodies]
    beyond = [(nodes < body.bounds[0]) | (nodes > body.bounds[1]) for body in bodies]
    clear = np.logical_and(*(a.all(axis=-1) | b.any(axis=-1) for a, b in zip(inside, beyond, strict=True)))
    assert (numbers == sum(a.all(axis=-1).astype(int) for a in inside))[clear].all() and numbers.max() == 2
    assert (numbers[..., -1] == 0).all() and (numbers >= 0).all()

    turned = trimesh.creation.torus(0.01, 0.004, major_sections=24, minor_sections=12)
    turned.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))
    numbers = winding_numbers(turned.vertices[turned.faces], np.full(3, -0.016), 0.0029, np.full(3, 12))
    points = 0.0029 * nodes.reshape(-1, 3) - 0.016
    exact = np.asarray(igl.winding_number(np.array(turned.vertices), np.array(turned.faces), points))
    np.testing.assert_allclose(numbers.ravel(), exact, atol=1e-9)
    assert (numbers == 1).sum() > 20


def test_unmerged_vertices_are_no_holes() -> None:
    mesh = ball(subdivisions=2)
    soup = Tool("probe", mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))
    assert SignedDistance.of(soup, spacing=1e-3).watertight


def test_what_cannot_be_a_tool_is_refused_with_a_reason() -> None:
    mesh = ball(subdivisions=1)
    with pytest.raises(MeshError, match=r"24\.0 m wide.*millimetres"):
        SignedDistance.of(scaled(mesh, 1000))
    with pytest.raises(MeshError, match="metres"):
        SignedDistance.of(scaled(mesh, 1e-3))
    with pytest.raises(MeshError, match="no surface"):
        SignedDistance.of(Tool("probe", mesh.vertices * [1, 0, 0], mesh.faces))
    with pytest.raises(MeshError, match="F > 0"):
        Tool("probe", mesh.vertices, np.empty((0, 3), int))
    with pytest.raises(InvalidInput, match="not finite"):
        Tool("probe", np.where(mesh.vertices == mesh.vertices[0, 0], np.nan, mesh.vertices), mesh.faces)
    with pytest.raises(InvalidInput, match="nodes"):
        SignedDistance.of(mesh, spacing=1e-5)
    with pytest.raises(InvalidInput, match="not finite"):
        SignedDistance.of(mesh, spacing=1e-3).distance([[0, 0, np.nan]])
