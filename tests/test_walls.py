"""Tools of bodies that overlap: only what is outside of them all is their surface."""

import numpy as np
import pytest
import trimesh

from stmpl_core import Simulator, Tool
from stmpl_core.methods import MomentNet
from stmpl_core.sdf import SignedDistance
from stmpl_core.walls import outer_walls
from tests.scenes import at, plate, press, tool, touch_of

FINE = 6e-4  # m, spacing of the fields that are compared


def block(x: float, y: float, z: float, middle: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box([x, y, z], trimesh.transformations.translation_matrix(middle))


def together(*bodies: trimesh.Trimesh) -> Tool:
    return tool(trimesh.util.concatenate(bodies))


def to_block(points: np.ndarray, half: tuple[float, float, float], middle: tuple[float, float, float]) -> np.ndarray:
    q = np.abs(points - np.array(middle)) - half
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def profile(*corners: tuple[float, float]) -> trimesh.Trimesh:
    """A prism over a closed line in the plane, which may cross itself, 0.016 m high."""
    n, line = len(corners), np.array(corners)
    ends = [np.column_stack([line, np.full(n, z)]) for z in (-0.008, 0.008)]
    middle = np.append(line.mean(axis=0), 0.0)
    a, b = np.arange(n), np.roll(np.arange(n), -1)
    faces = np.vstack([np.column_stack([a, b, b + n]), np.column_stack([a, b + n, a + n]),
                       np.column_stack([b, a, 0 * a + 2 * n]), np.column_stack([a + n, b + n, 0 * a + 2 * n + 1])])
    points = np.vstack([*ends, middle - [0, 0, 0.008], middle + [0, 0, 0.008]])
    return trimesh.Trimesh(points, faces, process=False)


@pytest.mark.parametrize("overlap", [0.0, 1e-5, 5e-4, 4e-3, 0.019])
def test_blocks_in_a_row_are_one_long_block(overlap: float) -> None:
    """Abutting ones too, whose wall between them has other triangles on each side."""
    left = block(0.02, 0.014, 0.012, (-0.01, 0, 0)).subdivide()
    right = block(0.02 + overlap, 0.014, 0.012, (0.01 - overlap / 2, 0, 0))
    whole = SignedDistance.of(tool(block(0.04, 0.014, 0.012)), spacing=FINE)
    field = SignedDistance.of(together(left, right), spacing=FINE)
    points = np.random.default_rng(1).uniform([-0.023, -0.01, -0.009], [0.023, 0.01, 0.009], (20_000, 3))
    assert np.abs(field.distance(points) - whole.distance(points)).max() < 0.15 * FINE
    assert field.surface_error < whole.surface_error + 0.02 * FINE
    assert field.half_thickness == pytest.approx(whole.half_thickness, rel=0.1)


def test_distance_to_crossed_bars_is_that_to_the_nearer_one_also_where_their_meshes_are_coarse() -> None:
    bars = ((0.02, 0.005, 0.008), (0, 0, 0)), ((0.005, 0.02, 0.008), (0.001, 0, 5e-4))
    field = SignedDistance.of(together(*(block(*2 * np.array(half), middle) for half, middle in bars)), spacing=FINE)
    points = np.random.default_rng(2).uniform(-0.024, 0.024, (60_000, 3))
    exact = np.min([to_block(points, *bar) for bar in bars], axis=0)
    outside, error = exact > 0, np.abs(field.distance(points) - exact)
    assert error[outside & (exact < 2e-3)].max() < 0.35 * FINE
    assert ((field.distance(points) < 0) != (exact < 0))[np.abs(exact) > 0.2 * FINE].sum() == 0
    middle = field.distance([[0.0, 0, 0]])[0]
    assert middle == pytest.approx(-np.hypot(0.004, 0.005), abs=4e-4)  # inner walls are nearer


def test_overlapping_blocks_press_as_one_block_does() -> None:
    simulator, pose = Simulator(plate(), MomentNet()), at(0, 0, 0.008 - 2e-3)
    halves = together(*(block(0.015, 0.02, 0.016, (x, 0, 0)).subdivide() for x in (-0.0025, 0.0025)))
    two = simulator.step([press(halves, pose, None)])
    one = simulator.step([press(tool(block(0.02, 0.02, 0.016)), pose, None)])
    assert touch_of(two).force == pytest.approx(touch_of(one).force, abs=0.2 * touch_of(one).force_bound)
    assert two.trust.ok and one.trust.error_bound
    off = np.linalg.norm(two.displacement - one.displacement, axis=1).max()
    assert off < 0.3 * one.trust.error_bound
    assert not any("distance field" in why for why in (two.trust.why, touch_of(two).trust.why))


def test_a_surface_that_passes_through_itself_is_what_is_outside_of_it() -> None:
    """A line that goes round a square, on inside it, and round a part of it once more."""
    line = (-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.004, 0.01), (-0.004, -0.006), (0.004, -0.006), \
        (0.004, 0.004), (-0.01, 0.004)  # fmt: skip
    mesh = profile(*line)
    walls = outer_walls(np.array(mesh.vertices), np.array(mesh.faces), FINE)
    field = SignedDistance.of(tool(mesh), spacing=FINE)
    assert walls is not None and field.watertight
    assert field.distance([[0.0, -0.003, 0]])[0] == pytest.approx(-0.007, abs=3e-4)  # inner walls are 3 mm away


def unlike(mesh: Tool) -> bool:
    return outer_walls(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64), 5e-4) is not None


def test_what_has_no_inner_walls_stays_as_it_is() -> None:
    ball, cavity = trimesh.creation.icosphere(3, 0.01), trimesh.creation.icosphere(3, 0.006)
    cavity.invert()
    pins = [trimesh.creation.cylinder(0.001, 0.02, sections=16).apply_translation([0.004 * n, 0, 0]) for n in range(9)]
    slant = trimesh.transformations.rotation_matrix(0.3, [1, 0.3, 0])
    ring = trimesh.creation.torus(0.012, 0.003, 48, 24)
    slanted, rod = [pin.copy().apply_transform(slant) for pin in pins], trimesh.creation.cylinder(0.005, 0.02)
    for mesh in (together(ball, cavity), together(*pins), together(*slanted), together(ring, rod), tool(ball)):
        assert not unlike(mesh)
    shell = ball.copy()
    shell.update_faces(shell.triangles_center[:, 2] < 0.006)
    assert not unlike(tool(shell))
    field = SignedDistance.of(together(ball, cavity), spacing=FINE)
    np.testing.assert_allclose(field.distance([[0, 0, 0.008], [0, 0, 0.001]]), [-0.002, 0.005], atol=4e-4)  # facets


def test_a_cavity_that_a_body_fills_is_none_and_the_rest_of_it_stays_one() -> None:
    ball, cavity = trimesh.creation.icosphere(3, 0.01), trimesh.creation.icosphere(3, 0.006)
    cavity.invert()
    rod = trimesh.creation.cylinder(0.002, 0.03, sections=24)
    field = SignedDistance.of(together(ball, cavity, rod), spacing=FINE)
    found = field.distance([[0, 0, 0.0], [0, 0, 0.008], [0.004, 0, 0], [0, 0, 0.014]])
    np.testing.assert_allclose(found, [-0.002, -np.hypot(0.002, 0.0018), 0.002, -0.001], atol=4e-4)


def test_a_body_that_comes_twice_with_other_triangles_is_one() -> None:
    once, points = block(0.02, 0.02, 0.016), np.random.default_rng(3).uniform(-0.013, 0.013, (20_000, 3))
    twice = SignedDistance.of(together(once, once.subdivide().subdivide()), spacing=FINE)
    off = twice.distance(points) - SignedDistance.of(tool(once), spacing=FINE).distance(points)
    assert np.abs(off).max() < 0.1 * FINE


def test_a_body_inside_another_one_is_not_felt_and_where_the_tool_lies_does_not_matter() -> None:
    outer, inner = block(0.02, 0.02, 0.016).subdivide(), block(0.01, 0.01, 0.01, (0.001, 0, 0))
    points = np.random.default_rng(4).uniform(-0.013, 0.013, (20_000, 3))
    alone = SignedDistance.of(tool(outer), spacing=FINE).distance(points)
    far = trimesh.util.concatenate([outer, inner]).apply_translation([1, 1, 1])
    assert np.abs(SignedDistance.of(together(outer, inner), spacing=FINE).distance(points) - alone).max() < 0.1 * FINE
    assert np.abs(SignedDistance.of(tool(far), spacing=FINE).distance(points + 1) - alone).max() < 0.1 * FINE
