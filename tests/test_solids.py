"""Balls, capsules, thin cylinders and boxes are told from other surfaces, and their distance is exact."""

import numpy as np
import pytest
import trimesh

from stmpl_core import Tool
from stmpl_core.gradients import _sized_field
from stmpl_core.sdf import SignedDistance
from stmpl_core.solids import BOX, CAPSULE, CYLINDER
from tests.scenes import ball, box, capsule, scaled, tool, turn

TURNED = turn((1.0, 2.0, -0.5), 1.1, (0.02, -0.05, 0.3))
THERE = np.random.default_rng(1).uniform(-1, 1, (4000, 3))


def placed(mesh: Tool, pose: np.ndarray) -> Tool:
    return Tool(mesh.name, mesh.vertices @ pose[:3, :3].T + pose[:3, 3], mesh.faces)


def of_capsule(points: np.ndarray, half: float, radius: float) -> np.ndarray:
    return np.linalg.norm(points - np.clip(points[:, 2:], -half, half) * [0, 0, 1], axis=1) - radius


def of_cylinder(points: np.ndarray, half: float, radius: float) -> np.ndarray:
    q = np.column_stack([np.linalg.norm(points[:, :2], axis=1) - radius, np.abs(points[:, 2]) - half])
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def of_box(points: np.ndarray, sides: tuple[float, ...]) -> np.ndarray:
    q = np.abs(points) - 0.5 * np.array(sides)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


STICK = tool(trimesh.creation.cylinder(2e-3, 0.6, sections=64))
DISC = tool(trimesh.creation.cylinder(0.3, 0.01, sections=96))
FINE_TABLE = tool(trimesh.creation.box((1.0, 0.7, 0.02)).subdivide().subdivide())
SOLIDS = {
    "ball": (ball(0.012, 4), CAPSULE, lambda p: of_capsule(p, 0.0, 0.012), 0.03, 1.2e-5),
    "capsule": (capsule(0.03, 0.008, 64), CAPSULE, lambda p: of_capsule(p, 0.015, 0.008), 0.04, 1.5e-5),
    "short capsule": (capsule(1e-3, 0.008, 64), CAPSULE, lambda p: of_capsule(p, 5e-4, 0.008), 0.03, 1.5e-5),
    "stick": (STICK, CYLINDER, lambda p: of_cylinder(p, 0.3, 2e-3), 0.4, 3e-6),
    "disc": (DISC, CYLINDER, lambda p: of_cylinder(p, 5e-3, 0.3), 0.4, 2e-4),
    "table": (box(1.0, 0.7, 0.02), BOX, lambda p: of_box(p, (1.0, 0.7, 0.02)), 0.7, 1e-12),
    "cube": (box(0.06, 0.06, 0.06), BOX, lambda p: of_box(p, (0.06, 0.06, 0.06)), 0.1, 1e-12),
    "fine table": (FINE_TABLE, BOX, lambda p: of_box(p, (1.0, 0.7, 0.02)), 0.7, 1e-12),
}


@pytest.mark.parametrize("pose", [np.eye(4), TURNED], ids=["along axes", "turned"])
@pytest.mark.parametrize("name", SOLIDS)
def test_a_solid_is_known_and_its_distance_is_exact(name: str, pose: np.ndarray) -> None:
    mesh, kind, exact, wide, off = SOLIDS[name]
    field = SignedDistance.of(placed(mesh, pose))
    assert field.coefficients.shape[:2] == (1, kind)
    points = wide * THERE
    there = points @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(field.distance(there), exact(points), rtol=0, atol=off)
    assert field.surface_error < 2 * off + 1e-12

    d, gradient = field.distance_gradient(there)
    np.testing.assert_allclose(d, field.distance(there), rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1, atol=1e-9)
    step = 1e-6 * np.eye(3)
    slopes = np.column_stack([(field.distance(there + e) - field.distance(there - e)) / 2e-6 for e in step])
    smooth = np.abs(slopes - gradient).max(axis=1) < 1e-4  # but for the edges inside
    assert smooth.mean() > 0.99
    value, again, bend = field.distance_gradient_hessian(there)
    np.testing.assert_array_equal(value, d)
    np.testing.assert_array_equal(again, gradient)
    along = np.abs(np.einsum("nxy,ny->nx", bend, gradient)).max(axis=1)
    assert np.quantile(along, 0.98) < 1e-4 * np.abs(bend).max() + 1e-6  # but for seams, across which it steps


def test_the_hessian_of_a_ball_is_its_curvature() -> None:
    points = 0.03 * THERE[:100]
    _, gradient, bend = SignedDistance.of(ball(0.012, 4)).distance_gradient_hessian(points)
    r = np.linalg.norm(points, axis=1)[:, None, None]
    np.testing.assert_allclose(bend, (np.eye(3) - gradient[:, :, None] * gradient[:, None]) / r, rtol=0, atol=0.1)


@pytest.mark.parametrize("mesh", [
    tool(trimesh.creation.icosphere(4, 0.012).apply_scale([1, 1, 1.01])),                       # an ellipsoid
    tool(trimesh.creation.icosphere(4, 0.012).slice_plane([0, 0, 0], [0, 0, 1], cap=True)),     # half a ball
    ball(0.012, 2),                                                                             # facets to be felt
    box(0.02, 0.015, 0.015), tool(trimesh.creation.cylinder(7e-3, 0.02, sections=64)),          # a grid knows them
    tool(trimesh.util.concatenate([trimesh.creation.box((1, 0.7, 0.02)), trimesh.creation.box((0.1, 0.1, 0.06))])),
    tool(trimesh.creation.cone(0.3, 0.01, sections=96)), tool(trimesh.creation.annulus(0.2, 0.3, 0.01)),
    tool(trimesh.creation.box((1, 0.7, 0.02)).apply_transform(np.eye(4) + 0.1 * np.eye(4, k=1))),
], ids=["ellipsoid", "half", "coarse ball", "box", "cylinder", "two boxes", "cone", "ring", "sheared"])  # fmt: skip
def test_what_is_no_solid_has_a_grid(mesh: Tool) -> None:
    assert SignedDistance.of(mesh).coefficients.shape[0] > 1


def test_a_tool_with_a_hole_is_no_solid() -> None:
    mesh = ball(0.012, 4)
    assert SignedDistance.of(Tool("probe", mesh.vertices, mesh.faces[1:])).coefficients.shape[0] > 1


def test_who_asks_for_a_grid_or_rounded_edges_gets_a_grid() -> None:
    assert SignedDistance.of(ball(0.012, 4), spacing=1e-3).coefficients.shape[0] > 1
    assert SignedDistance.of(ball(0.012, 4), rounding=1e-3).coefficients.shape[0] > 1


def test_a_solid_grows_with_its_tool() -> None:
    for name in ("capsule", "stick", "table"):
        mesh = placed(SOLIDS[name][0], TURNED)
        small, large = SignedDistance.of(mesh), SignedDistance.of(scaled(mesh, 1.5))
        points = 0.02 * THERE + mesh.vertices[0]
        np.testing.assert_allclose(_sized_field(small, 1.5).distance(1.5 * points), large.distance(1.5 * points),
                                   rtol=0, atol=1e-9)  # fmt: skip
    inside_out = SignedDistance.of(Tool("probe", mesh.vertices, mesh.faces[:, ::-1]))
    assert inside_out.flipped and (inside_out.coefficients == small.coefficients).all()
