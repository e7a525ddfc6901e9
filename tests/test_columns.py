"""Laws of squeezed columns and contact nodes: geometry and Winkler's law under a tool, no jump while it slides."""

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.living_limbs import site
from stmpl_core import Tool
from stmpl_core.body import Body
from stmpl_core.columns import Columns, Squeeze, grid_of
from stmpl_core.living import living
from stmpl_core.methods.winkler import column_pressure
from stmpl_core.nodes import NODES
from stmpl_core.rays import MAX_COLUMN_STRAIN, MOST_PASSED, NOT_SUNK, PASSED, UNSAID, inside_most, sunk_under
from stmpl_core.sdf import SignedDistance
from tests.scenes import (
    LENGTH,
    RADIUS,
    STACK,
    at,
    ball,
    box,
    capsule,
    enlarged,
    limb,
    placed,
    plate,
    punch,
    scaled,
    turn,
)  # fmt: skip

LIMB, PLATE = limb(), plate()
MARGIN = 5e-3  # m


def field_of(mesh: Tool) -> SignedDistance:
    return SignedDistance.of(mesh, margin=MARGIN)


BALL, PUNCH = field_of(ball(subdivisions=4)), field_of(punch())
SLAB = field_of(box(0.03, 0.03, 0.004))


@pytest.fixture(scope="module")
def flat() -> Columns:
    return Columns(PLATE)


@pytest.fixture(scope="module")
def round_limb() -> Columns:
    return Columns(LIMB)


def winkler(columns: Columns, squeeze: Squeeze) -> np.ndarray:
    """Winkler's pressure over E at the nodes, gathered at the vertices, (V,) [-]."""
    tissue, nodes, out = columns.layer.tissue, squeeze.nodes, np.zeros(len(columns.points))
    there = column_pressure(1 - nodes.strain, tissue) / tissue.youngs_modulus
    vertices, pressure = nodes.at_vertices(there, columns.layer.vertex_areas)
    out[vertices] = pressure
    return out


def force(columns: Columns, squeeze: Squeeze) -> np.ndarray:
    """Of Winkler's pressure over E, [m2]."""
    return -(winkler(columns, squeeze) @ columns.layer.vertex_area_vectors)


def test_a_tool_that_is_apart_squeezes_nothing(flat: Columns, round_limb: Columns) -> None:
    for columns, pose in ((flat, at(0, 0, 0.012)), (flat, at(0, 0, 0.015)), (round_limb, at(1, 1, 1))):
        assert not len(columns.squeezed(BALL, pose).nodes.area)
    assert not len(round_limb.near(BALL, at(1, 1, 1), 0.02))


@pytest.mark.parametrize("nu", [0.3, 0.4, 0.45])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.7, 0.97])
def test_under_a_flat_tool_every_column_has_its_depth_and_the_law_of_columns(nu: float, share: float) -> None:
    columns = Columns(PLATE.with_(poisson_ratio=nu))
    depth = share * PLATE.thickness[0]
    squeeze = columns.squeezed(SLAB, at(0, 0, 0.002 - depth))
    inside = (np.abs(PLATE.vertices[squeeze.vertices, :2]) < 0.011).all(axis=1)
    assert inside.sum() > 40
    strain = min(share, MAX_COLUMN_STRAIN)
    np.testing.assert_allclose(squeeze.depth[inside], depth, rtol=1e-3, atol=1e-6)  # the field is off by 0.5 um
    under = (np.abs(squeeze.nodes.points[:, :2]) < 0.013).all(axis=1)
    np.testing.assert_allclose(squeeze.nodes.strain[under], strain, rtol=5e-3)
    assert squeeze.nodes.area.sum() == pytest.approx(0.03**2, rel=0.05)


@pytest.mark.parametrize("depth", [1e-3, 3e-3])
def test_a_ball_presses_as_the_integral_over_its_cap(flat: Columns, depth: float) -> None:
    """Winkler's pressure integrated over a true ball's cap, in closed quadrature."""
    radius, tissue = 0.012, PLATE.tissue
    r = (np.arange(4000) + 0.5) / 4000 * np.sqrt(radius**2 - (radius - depth) ** 2)
    deep = np.sqrt(radius**2 - r**2) - (radius - depth)
    pressure = column_pressure(1 - deep / PLATE.thickness[0], tissue) / tissue.youngs_modulus
    expected = float((2 * np.pi * r * pressure).sum() * (r[1] - r[0]))
    for x, y in ((0.0, 0.0), (0.0011, 0.0004), (0.0015, 0.0015)):
        squeeze = flat.squeezed(BALL, at(x, y, radius - depth))
        assert -force(flat, squeeze)[2] == pytest.approx(expected, rel=0.03)


def test_a_ball_covers_the_cap_that_geometry_says(flat: Columns) -> None:
    """What is squeezed between vertices is carried by the corners of its triangle, not further."""
    depth, radius = 3e-3, 0.012
    squeeze = flat.squeezed(BALL, at(0, 0, radius - depth))
    r, cap = np.linalg.norm(PLATE.vertices[:, :2], axis=1), np.sqrt(radius**2 - (radius - depth) ** 2)
    carries = winkler(flat, squeeze) > 0
    longest = float(np.linalg.norm(np.diff(PLATE.vertices[PLATE.edges], axis=1), axis=2).max())
    assert carries[r < cap - 1e-3].all() and not carries[r > cap + longest].any()
    here = r[squeeze.vertices]
    covered = here < cap - 2e-4
    np.testing.assert_allclose(squeeze.depth[covered], np.sqrt(radius**2 - here[covered] ** 2) - radius + depth,
                               atol=1e-4)  # fmt: skip
    assert not squeeze.depth[here > cap + 2e-4].any()


def test_no_column_is_deeper_than_the_layer(flat: Columns) -> None:
    squeeze = flat.squeezed(BALL, at(0, 0, 0))  # 4.5 mm into the core
    assert squeeze.depth.max() == pytest.approx(PLATE.thickness[0])
    assert squeeze.nodes.strain.max() == MAX_COLUMN_STRAIN


def test_a_thin_plate_below_the_skin_squeezes_as_one_on_it(flat: Columns) -> None:
    thick = field_of(box(0.03, 0.03, 0.02))
    below = flat.squeezed(SLAB, at(0, 0, 0.002 - 5e-3))  # its top is 1 mm under the skin at rest
    whole = flat.squeezed(thick, at(0, 0, 0.010 - 5e-3))
    assert force(flat, below)[2] == pytest.approx(force(flat, whole)[2], rel=0.1)


def test_the_far_side_of_the_limb_is_free(round_limb: Columns) -> None:
    long = field_of(capsule(0.06, 0.008))
    lying = at(RADIUS + 0.008 - 0.006, 0, LENGTH / 2) @ turn((0, 1, 0), np.pi / 2)
    through = at(RADIUS + 0.008 - 0.006 + 0.03, 0, LENGTH / 2) @ turn((0, 1, 0), np.pi / 2)
    for pose in (lying, through):
        squeeze = round_limb.squeezed(long, pose)
        assert len(squeeze.vertices) and (LIMB.vertices[squeeze.vertices, 0] > 0).all()


def test_a_needle_is_felt_wherever_it_comes_down(flat: Columns) -> None:
    """Finer than the mesh, and than the samples of a triangle: a fifth of the layer deep it is felt everywhere."""
    needle = SignedDistance.of(capsule(0.012, 0.0008, 16), margin=2e-3)
    x, y = np.meshgrid(np.linspace(0, 3e-3, 6), np.linspace(0, 3e-3, 6))
    for spot in np.column_stack([x.ravel(), y.ravel()]):
        squeeze = flat.squeezed(needle, at(*spot, 0.0068 - 1.5e-3))
        assert force(flat, squeeze)[2] < 0


def test_turning_and_moving_the_scene_leaves_the_squeeze(round_limb: Columns) -> None:
    scene = turn((0.3, -0.5, 0.8), 1.1, (0.4, -0.2, 0.9))
    turned = Columns(placed(LIMB, scene))
    pose = at(RADIUS + 0.009, 0.001, LENGTH / 2)
    here, there = round_limb.squeezed(BALL, pose), turned.squeezed(BALL, scene @ pose)
    np.testing.assert_array_equal(here.vertices, there.vertices)
    for one, other in zip(here[1:3], there[1:3], strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-3, atol=1e-6)
    forces = [float(np.linalg.norm(force(*pair))) for pair in ((turned, there), (round_limb, here))]
    assert forces[0] == pytest.approx(forces[1], rel=1e-3)


def test_a_scene_twice_as_large_is_squeezed_alike(flat: Columns) -> None:
    large = Columns(enlarged(PLATE, 2))
    mesh = ball()
    here = flat.squeezed(field_of(mesh), at(0.0004, 0, 0.009))
    there = large.squeezed(SignedDistance.of(scaled(mesh, 2), margin=2 * MARGIN),
                           at(0.0008, 0, 0.018))  # fmt: skip
    assert -force(large, there)[2] == pytest.approx(-4 * force(flat, here)[2], rel=5e-3)


def test_the_same_question_has_the_same_answer_whatever_was_asked_between(flat: Columns) -> None:
    first = flat.squeezed(BALL, at(0, 0, 0.010))
    flat.squeezed(SLAB, at(0.01, 0, -0.002))
    again = flat.squeezed(BALL, at(0, 0, 0.010))
    for one, other in zip((*first[:3], *first.nodes), (*again[:3], *again.nodes), strict=True):
        assert one.tobytes() == other.tobytes()


def worst_change(columns: Columns, field: SignedDistance, half: float, tilt: float, step: float) -> float:
    """Largest change of the pressure in one step of a slide over edges, triangles and vertices, over all of it."""
    before, largest = None, 0.0
    for s in np.arange(0, 3e-3, step):
        squeeze = columns.squeezed(field, at(s, 0.37 * s, half - 1.5e-3) @ turn((0, 1, 0), tilt))
        now = winkler(columns, squeeze)
        if before is not None:
            largest = max(largest, float(np.abs(now - before).sum() / now.sum()))
        before = now
    return largest


@pytest.mark.parametrize("field, half, tilt", [(BALL, 0.012, 0.0), (PUNCH, 0.015, 0.0), (PUNCH, 0.015, 0.2),
                                               (SLAB, 0.002, 0.0)])  # fmt: skip
def test_the_squeeze_has_no_jump_while_the_tool_slides(
    flat: Columns, field: SignedDistance, half: float, tilt: float
) -> None:
    """A quarter of the step, about a quarter of the change."""
    coarse, fine = (worst_change(flat, field, half, tilt, step) for step in (1e-4, 2.5e-5))
    assert coarse < 0.05
    assert fine < 0.45 * coarse


def test_a_thin_plate_goes_under_the_skin_without_a_great_jump(flat: Columns) -> None:
    """One that slants is half on the skin and half under it, and which columns it covers changes as it slides."""
    assert worst_change(flat, SLAB, 0.002, 0.2, 2.5e-5) < 0.12


@pytest.mark.parametrize("field, half", [(BALL, 0.012), (PUNCH, 0.015)])
def test_the_squeeze_has_no_jump_while_the_tool_comes_down(flat: Columns, field: SignedDistance, half: float) -> None:
    def worst(step: float) -> float:
        forces = [-force(flat, flat.squeezed(field, at(4e-4, 2e-4, half - d)))[2] for d in np.arange(-2e-4, 3e-3, step)]
        return float(np.abs(np.diff(forces)).max() / max(forces))

    coarse, fine = worst(1e-4), worst(2.5e-5)
    assert coarse < 0.1
    assert fine < 0.4 * coarse


def test_force_grows_with_depth(flat: Columns) -> None:
    forces = [-force(flat, flat.squeezed(BALL, at(7e-4, 3e-4, 0.012 - d)))[2] for d in np.arange(2e-4, 7e-3, 1e-4)]
    assert all(b > a > 0 for a, b in pairwise(forces))


@pytest.mark.parametrize("field, half", [(BALL, 0.012), (PUNCH, 0.015), (SLAB, 0.002)])
@pytest.mark.parametrize("depth", [5e-5, 1e-4, 1e-3, 4e-3])
def test_there_are_as_many_nodes_under_a_first_touch_as_under_a_deep_one(
    flat: Columns, field: SignedDistance, half: float, depth: float
) -> None:
    count = len(flat.squeezed(field, at(3e-4, 5e-4, half - depth)).nodes.area)
    assert 0.5 * NODES < count < 2.5 * NODES


def test_clearance_is_the_least_distance_along_the_column(round_limb: Columns) -> None:
    pose = at(RADIUS + 0.0135, 0.001, LENGTH / 2)
    near, far = round_limb.near(BALL, pose, 0.01), 0.005
    clearance = round_limb.clearance(BALL, pose, near, far)
    facing = LIMB.vertices[near, 0] > 0.5 * RADIUS
    exact = BALL.distance(LIMB.vertices[near] - pose[:3, 3])
    np.testing.assert_allclose(clearance[2], exact, atol=1e-9)
    known = np.minimum(clearance.least, far)  # outside, the skin is nearest
    np.testing.assert_allclose(known[facing], np.minimum(exact, far)[facing], atol=1e-9)
    assert (clearance.least <= clearance[2] + 1e-12).all()


@pytest.mark.parametrize("least", [-np.inf, -1e-3])
def test_places_along_a_column_that_are_not_looked_at_are_not_the_deepest(least: float) -> None:
    rng, deep = np.random.default_rng(5), 4e-3
    starts, ways = rng.uniform(-0.02, 0.02, (2000, 3)) * (1, 1, 0.3), rng.normal(size=(2000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    step = max(min(0.5 * grid_of(SLAB)[3], deep / PASSED), deep / MOST_PASSED)
    at = starts[:, None] + np.minimum(step * np.arange(MOST_PASSED + 1), deep)[:, None] * ways[:, None]
    inside = -SLAB.distance(at.reshape(-1, 3)).reshape(2000, -1)
    found = [inside_most(grid_of(SLAB), (*start, *way), deep, first, least)[0]
             for start, way, first in zip(starts, ways, inside[:, 0], strict=True)]  # fmt: skip
    assert np.maximum(found, least) == pytest.approx(np.maximum(inside.max(axis=1), least), abs=1e-12)


def test_columns_beside_a_deep_ball_are_not_under_it() -> None:
    """On an arm that is as thick as it is round they lead towards the bone, and into the ball's lower half."""
    layer = living(Body.anny(), "left_upper_arm", edge_length=3e-3)
    vertex, radius = site(layer, "left_upper_arm"), 0.02
    columns, field = Columns(layer), SignedDistance.of(ball(radius), margin=0.04)
    t = float(layer.thickness[vertex])
    for strain in (0.6, 0.7, 0.75):  # its middle is under the skin from 0.52 on
        pose = np.eye(4)
        pose[:3, 3] = layer.vertices[vertex] + (radius - strain * t) * layer.normals[vertex]
        squeeze = columns.squeezed(field, pose)
        assert (squeeze.depth / layer.thickness[squeeze.vertices]).max() < strain + 0.02
        assert strain - 0.02 < squeeze.nodes.strain.max() < strain + 0.02


def test_a_tool_has_sunk_under_columns_that_enter_it_from_above() -> None:
    grid, t, up = grid_of(SignedDistance.of(ball(0.01), margin=0.04)), 0.05, np.array([0.0, 0.0, 1.0])

    def under(x: float, z: float, a: float, c: float, top: np.ndarray = up) -> float:
        return sunk_under(grid, (x, 0.0, z, a, 0.0, c), t, top)

    assert under(0, 0.02, 0, -1) == 1 and under(0.006, 0.02, 0, -1) == 1  # down into its upper half
    assert under(0.03, 0.002, -0.8, -0.6) == 0 and under(0.03, -0.012, -1, 0.1) == 0  # sideways into its lower half
    assert 0 < under(0.03, 0.001, -1, 0) < 1 and under(0.03, 0.0, -1, 0) == pytest.approx(0.0, abs=0.5)
    assert under(0.03, 0.02, 0, -1) == 0  # past it
    assert under(0, 0.02, 0, -1, NOT_SUNK) == 0 and under(0.03, -0.012, -1, 0.1, UNSAID) == 1


def volumes_by_mesh(one: Tool, pose: np.ndarray, depths: np.ndarray, size: float, thickness: float,
                    edges: tuple[float, ...], stacked: bool) -> np.ndarray:  # fmt: skip
    """Volume of skin that a turned tool squeezes [m3], a row each mesh's edge length [m], a column each depth [m]."""
    tip, field, volumes = float((one.vertices @ pose[2, :3]).min()), SignedDistance.of(one, margin=0.02), []
    for edge in edges:
        layer = plate(size, edge, thickness)
        columns = Columns(layer.with_(tissue=STACK) if stacked else layer)
        for depth in depths:
            pose[:3, 3] = 1e-3, 2e-3, -depth - tip
            nodes = columns.squeezed(field, pose).nodes
            volumes.append(float(nodes.area @ (nodes.strain * nodes.thickness)))
    return np.array(volumes).reshape(len(edges), -1)


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize("lean", [0.32, 0.44])
def test_a_leaning_stylus_sinks_under_skin_without_a_step_whatever_the_mesh(lean: float, stacked: bool) -> None:
    """Its vertices are farther apart than the stylus is wide: none may be there where it comes under the skin."""
    by_mesh = volumes_by_mesh(punch(0.003, 0.06), turn((1, 0, 0), lean), np.arange(4e-3, 10e-3, 2e-5), 0.096, 0.02,
                              (4e-3, 6e-3, 8e-3), stacked)  # fmt: skip
    assert np.abs(np.diff(np.log(by_mesh))).max() < 0.02
    assert np.abs(by_mesh / by_mesh[0] - 1).max() < 0.02


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize("lean", [0.5, 0.9, 1.2])
def test_a_thin_sheet_that_leans_between_two_vertices_has_sunk_under_skin(lean: float, stacked: bool) -> None:
    """Columns of vertices miss it: skin was then no deeper than the sheet is thick, however deep it was."""
    by_mesh = volumes_by_mesh(box(0.01, 0.006, 3e-4), turn((0, 1, 0), lean), np.arange(1.5e-3, 6e-3, 2e-4), 0.128,
                              0.012, (2e-3, 4e-3, 8e-3, 16e-3), stacked)  # fmt: skip
    assert (np.diff(by_mesh) > 0).all()
    assert np.abs(by_mesh / by_mesh[0] - 1).max() < 0.1


@pytest.mark.parametrize("stacked", [False, True])
def test_what_only_stands_near_between_two_vertices_has_not_sunk(stacked: bool) -> None:
    """A sheet that stands upright in thin skin or leans over it, and a ball, on edges as long as they are wide."""
    layer = plate(0.16, 16e-3, 4e-3)
    columns = Columns(layer.with_(tissue=STACK) if stacked else layer)
    sheet, small = box(0.01, 0.006, 3e-4), ball(0.012)
    for one, pose, depth in ((sheet, turn((0, 1, 0), np.pi / 2), 1e-3), (sheet, turn((0, 1, 0), 0.9), -2e-4),
                             (small, np.eye(4), 1e-3)):  # fmt: skip
        pose[:3, 3] = 1e-3, 2e-3, -depth - float((one.vertices @ pose[2, :3]).min())
        assert not columns.squeezed(SignedDistance.of(one, margin=0.02), pose).top.any()


def test_skin_under_a_thin_pin_sinks_with_it_where_columns_lead_out_of_its_wall() -> None:
    """On an uneven forearm, where they differ by 20 degrees under a pin of 4 mm."""
    layer, pin = living(Body.anny(), "left_forearm", edge_length=6e-3), punch(0.002, 0.03)
    vertex, columns, field = 1314, Columns(layer), SignedDistance.of(pin, margin=0.02)
    t, z, azimuth = float(layer.thickness[vertex]), layer.normals[vertex], np.radians(335)
    pose = turn((np.cos(azimuth), np.sin(azimuth), 0), 0.26)
    x = np.cross(z, (0.3, 0.5, 0.8)) / np.linalg.norm(np.cross(z, (0.3, 0.5, 0.8)))
    pose[:3, :3] = np.column_stack([x, np.cross(z, x), z]) @ pose[:3, :3]
    heights = pin.vertices @ pose[:3, :3].T @ z
    end = pose[:3, :3] @ pin.vertices[heights < heights.min() + 1e-3].mean(axis=0)
    end += (heights.min() - end @ z) * z
    for depth in np.linspace(0.6, 0.85, 10) * t:
        pose[:3, 3] = layer.vertices[vertex] - depth * z - end
        assert columns.squeezed(field, pose).nodes.depths.max() > 0.7 * depth


@pytest.mark.parametrize("radius", [0.03, 0.04, 0.06, 0.08])
def test_a_tool_as_wide_as_a_limb_presses_from_first_touch_on(round_limb: Columns, radius: float) -> None:
    """Its distance field ends above the core: no column may miss it for that."""
    field, pose = SignedDistance.of(ball(radius, subdivisions=5), margin=MARGIN), np.eye(4)
    vertex = int(np.linalg.norm(LIMB.vertices - (RADIUS, 0, LENGTH / 2), axis=1).argmin())
    pose[:3, :3] = turn((0, 1, 0), 0.7)[:3, :3]  # so that it meets the skin beside its grid's middle
    for depth in (1e-4, 2e-4, 4e-4, 8e-4):
        pose[:3, 3] = LIMB.vertices[vertex] + (radius - depth) * LIMB.normals[vertex]
        squeeze = round_limb.squeezed(field, pose)
        deepest = float(max(squeeze.depth.max(), (squeeze.nodes.strain * squeeze.nodes.thickness).max(initial=0.0)))
        assert deepest == pytest.approx(depth, rel=0.15, abs=2e-5)
