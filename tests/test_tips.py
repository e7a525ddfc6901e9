"""Laws of tips: needles and cones narrower than the places at which skin is looked at press, or it is told."""

import itertools
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from stmpl_core import Contact, Simulator, SoftLayer, Tool
from stmpl_core.arrays import Transform
from stmpl_core.batch import Batch
from stmpl_core.body import Body
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from stmpl_core.sdf import SignedDistance
from stmpl_core.skin import Skin
from tests.scenes import LENGTH, STACK, ball, limb, plate, press
from tests.scenes import tool as named

layered = cache(lambda: limb(6e-3, 0.02, 0.05, LENGTH).with_(tissue=STACK))
LAYERS = {
    "one material": lambda: limb(6e-3),
    "stack": cache(lambda: living(Body.anny(), "left_forearm", edge_length=6e-3)),
}
NEEDLE = trimesh.creation.cylinder(3e-4, 0.05, sections=16)
NEEDLE.vertices[:, 2] += 0.025


def cone(radius: float, height: float) -> trimesh.Trimesh:
    """A cone whose tip is at the origin and points against z."""
    mesh = trimesh.creation.cone(radius, height, sections=24)
    mesh.vertices[:, 2] = height - mesh.vertices[:, 2]
    mesh.invert()
    return mesh


TIPS = {"needle": named(NEEDLE), "pencil": named(cone(3.5e-3, 0.02))}


@pytest.fixture(scope="module", params=LAYERS)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return Simulator(LAYERS[request.param](), MomentNet())


def places(simulator: Simulator, depth: float, count: int = 6) -> list[Transform]:
    """Poses of a tool whose tip is at its origin, so deep in the skin [m]: over vertices, beside these, and between."""
    layer, out = simulator.layer, []
    middle = np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argsort()
    for v in middle[: 7 * count : 7]:
        n = layer.normals[v]
        across = np.cross(n, [0.0, 1.0, 0.0] if abs(n[1]) < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        for beside in (0.0, 2e-4, 5e-4, 2e-3):
            pose = np.eye(4)
            pose[:3, :3] = np.column_stack([across, np.cross(n, across), n])
            pose[:3, 3] = layer.vertices[v] + beside * across - depth * n
            out.append(pose)
    return out


def forces(simulator: Simulator, tip: Tool, depth: float) -> np.ndarray:
    return np.array([simulator.touch([Contact(tip, pose)])[0].force for pose in places(simulator, depth)])


@pytest.mark.parametrize("tip", TIPS)
def test_a_tip_presses_wherever_it_comes_and_the_harder_the_deeper_it_is(simulator, tip):
    """Where it came over a vertex, or missed all that was looked at, it was apart and trusted at any depth."""
    by_depth = np.array([forces(simulator, TIPS[tip], depth) for depth in (1e-3, 2e-3, 4e-3)])
    assert (by_depth > 0).all()
    assert (np.diff(by_depth, axis=0) > 0).all()
    assert by_depth[1].max() < 1.7 * by_depth[1].min()


def test_a_tip_that_the_distance_field_does_not_tell_is_flagged(simulator):
    thin = named(cone(1e-3, 0.03))
    touches = [simulator.touch([Contact(thin, pose)])[0] for pose in places(simulator, 1e-3)]
    unfelt = [touch for touch in touches if not touch.force]
    assert unfelt and not any(touch.trust.ok for touch in unfelt)
    assert all("a tip of probe is 1 mm in the skin" in touch.trust.why for touch in unfelt)
    assert simulator.touch([Contact(thin, places(simulator, -1e-3)[0])])[0].trust.ok, "it is off"


def chisel(length: float) -> Tool:
    """A chisel of 20 mm, its edge of 20 degrees across y, at the origin; so long [m]."""
    high = 5e-3 / np.tan(np.radians(20))
    corners = [[x, y, z] for y in (-0.01, 0.01) for x, z in ((0, 0), (5e-3, high), (5e-3, length), (0, length))]
    return named(trimesh.convex.convex_hull(np.array(corners)))


def test_an_edge_that_a_long_tools_distance_field_loses_is_in_the_bound_or_flagged():
    """Of the same edge a longer handle makes the field coarser: 0.38 N became 0.008 N, with a third of it stated."""
    simulator = Simulator(plate(0.16, 4e-3, 20e-3, crossed=True, youngs_modulus=1e4), MomentNet())
    flagged = []
    for depth in (2e-3, 4e-3, 6e-3, 9e-3):
        pose = np.eye(4)
        pose[2, 3] = -depth
        touches = [simulator.touch([Contact(chisel(length), pose)])[0] for length in (0.02, 0.045, 0.1, 0.15)]
        most = max(touch.force for touch in touches)
        for touch in touches:
            assert touch.force + touch.force_bound > most or not touch.trust.ok
            flagged.append(not touch.trust.ok)
    assert any(flagged) and not all(flagged)


def test_edges_are_known_however_triangles_share_their_corners():
    """As a file of triangles has them, each with corners of its own, and of bodies that overlap."""
    whole = chisel(0.1)
    loose = Tool("loose", whole.vertices[whole.faces].reshape(-1, 3), np.arange(whole.faces.size).reshape(-1, 3))
    one, other = SignedDistance.of(whole).tips, SignedDistance.of(loose).tips
    assert len(one) == len(other) > 0 and one[0, 3] == pytest.approx(other[0, 3])
    handle = trimesh.creation.box([0.02, 0.03, 0.01], trimesh.transformations.translation_matrix([0.0, 0.0, 0.095]))
    both = trimesh.util.concatenate([trimesh.Trimesh(whole.vertices, whole.faces), handle])
    hammer = SignedDistance.of(named(both)).tips
    assert hammer[hammer[:, 2] < 2e-3, 3].max() == pytest.approx(one[0, 3], rel=0.3)


def test_a_blunt_tool_lacks_no_edge():
    """Neither a box that lies flat or on its edge, nor a ball of facets: nothing is flagged, and no bound is wider."""
    simulator = Simulator(plate(0.16, 4e-3, 20e-3, crossed=True, youngs_modulus=1e4), MomentNet())
    for mesh in (trimesh.creation.box([0.03, 0.02, 0.02]), trimesh.creation.icosphere(2, 0.015)):
        tool, turn = named(mesh), np.eye(4)
        for angle in (0.0, 10.0, 45.0):
            turn[:3, :3] = Rotation.from_euler("y", angle, degrees=True).as_matrix()
            low = (mesh.vertices @ turn[:3, :3].T)[:, 2].min()
            for depth in (1e-3, 4e-3):
                turn[2, 3] = -low - depth
                assert simulator.touch([Contact(tool, turn.copy())])[0].trust.ok, (angle, depth)


def test_a_blade_across_a_limb_is_told():
    """Its corners are off the limb; the middle of its edge is 2 mm in the skin."""
    simulator = Simulator(limb(4e-3), MomentNet())
    layer = simulator.layer
    v = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    along = np.ptp(layer.vertices, axis=0).argmax()
    axis = np.eye(3)[along]
    across = np.cross(layer.normals[v], axis)
    blade = trimesh.convex.convex_hull(np.array([[x, y, z] for y in (-0.02, 0.02) for x, z in
                                                 ((0, 0), (1.75e-3, 0.02), (-1.75e-3, 0.02))]))  # fmt: skip
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([np.cross(across, layer.normals[v]), across, layer.normals[v]])
    pose[:3, 3] = layer.vertices[v] - 2e-3 * layer.normals[v]
    touch = simulator.touch([Contact(named(blade), pose)])[0]
    assert touch.force > 0.0 or not touch.trust.ok


@cache
def calf() -> Simulator:
    return Simulator(living(Body.anny(), "left_calf", edge_length=6e-3), MomentNet())


def pressed_to(layer: SoftLayer, vertex: int, depth: float, height: float) -> np.ndarray:
    """Pose of a tool of some height about its middle, upright, by a depth over the thickness at a vertex."""
    normal = layer.normals[vertex]
    across = np.cross(normal, [0.3, 1.0, 0.2])
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([across, np.cross(normal, across), normal])
    pose[:3, 3] = layer.vertices[vertex] + (0.5 * height - depth * layer.thickness[vertex]) * normal
    return pose


@pytest.mark.parametrize("height", [0.015, 0.2])
def test_a_thin_wall_presses_the_harder_the_deeper_where_columns_leave_it(height: float) -> None:
    """A card on edge 29 mm deep in a calf pressed with half of what it did 5 mm higher."""
    layer, card = calf().layer, trimesh.creation.box([1e-3, 0.04, height])
    middle = np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argsort()
    for v in middle[:200:20]:
        forces = [calf().touch([Contact(named(card), pressed_to(layer, v, depth, height))])[0].force
                  for depth in (0.2, 0.3, 0.4, 0.5, 0.6, 0.7)]  # fmt: skip
        assert (np.diff(forces) > 0).all() and forces[-1] > 4 * forces[0], v


@pytest.mark.parametrize("turned", [1.0, 2.0])
def test_a_board_that_leans_is_in_range_from_its_first_touch(turned: float) -> None:
    """It was flagged up to a fiftieth of the thickness, as thin, and not from there on."""
    simulator, board = Simulator(layered(), MomentNet()), trimesh.creation.box([0.03, 0.03, 0.004])
    layer = simulator.layer
    v = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    pose = pressed_to(layer, v, 0.0, 0.0)
    pose[:3, :3] @= Rotation.from_rotvec([0.3 * np.cos(turned), 0.3 * np.sin(turned), 0.0]).as_matrix()
    normal, tool = layer.normals[v], named(board)

    low, touched = float((board.vertices @ pose[:3, :3].T @ normal).min()), []
    for depth in np.linspace(-0.3, 0.5, 161):
        there = pose.copy()
        there[:3, 3] = layer.vertices[v] - (low + depth * layer.thickness[v]) * normal
        touch = simulator.touch([Contact(tool, there)])[0]
        if touch.depth > 0.01 * layer.thickness[v]:
            touched.append(there)
            assert touch.trust.in_range, touch.trust.why
    assert len(touched) > 60
    pytest.importorskip("warp")
    from stmpl_core.gpu.warp_batch import WarpBatch

    poses = np.array(touched[:8])[:, None]
    there = WarpBatch(Skin.of(layer, MomentNet()), [tool], len(poses), device="cpu").touch(poses)
    assert np.asarray(there.in_range).all()


@pytest.mark.parametrize("cut", ["blade", "ring", "pin"])
def test_a_tool_that_is_less_high_than_it_is_deep_presses_as_a_taller_one(cut: str) -> None:
    """Rings 25 mm high and blades of 15 mm pressed 30 to 55 % less 30 mm deep in a calf than taller ones, trusted."""
    make = {"blade": lambda height: trimesh.creation.box([0.05, 0.006, height]),
            "ring": lambda height: trimesh.creation.annulus(0.010, 0.014, height, sections=64),
            "pin": lambda height: trimesh.creation.cylinder(0.006, height, sections=48)}[cut]  # fmt: skip
    layer, tall, off = calf().layer, named(make(0.12), name="tall"), []
    middle = np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argsort()
    for v, height in itertools.product(middle[:120:40], (0.008, 0.015, 0.025)):
        short = named(make(height), name=f"{height:g}")
        for depth in (0.3, 0.45, 0.6):
            one, other = (calf().touch([Contact(tool, pressed_to(layer, v, depth, high))])[0]
                          for tool, high in ((short, height), (tall, 0.12)))  # fmt: skip
            if one.trust.ok and other.trust.ok:
                off.append(one.force / other.force - 1)
                assert abs(one.force - other.force) < one.force_bound
    assert len(off) > 12 and np.abs(off).max() < 0.2 and np.abs(off).mean() < 0.05


def test_a_batch_on_a_gpu_s_kernels_presses_likewise_or_flags():
    pytest.importorskip("warp")
    from stmpl_core.gpu.warp_batch import WarpBatch

    skin = Skin.of(LAYERS["stack"](), MomentNet())
    poses = np.array(places(Simulator(skin), 2e-3))[:, None]
    for tip in (*TIPS.values(), chisel(0.1)):
        ours, there = (
            Batch(skin, [tip], len(poses)).touch(poses),
            WarpBatch(skin, [tip], len(poses), device="cpu").touch(poses),
        )
        wrenches, in_range = np.asarray(there.wrenches), np.asarray(there.in_range)
        served = wrenches[:, 0, :3].any(axis=1)
        assert not in_range[~served].any()
        np.testing.assert_allclose(wrenches[served], ours.wrenches[served], atol=1e-6)
        bounds = np.asarray(there.force_bounds)
        np.testing.assert_allclose(bounds[served], ours.force_bounds[served], rtol=1e-3, atol=1e-6)
        assert not (in_range[served] & ~ours.in_range[served]).any()


def test_a_batch_on_a_gpu_s_kernels_flags_the_corners_of_plain_tools():
    """Of a hexagonal cylinder and an L-bar that stand on a corner between vertices."""
    pytest.importorskip("warp")
    from stmpl_core.gpu.warp_batch import WarpBatch

    skin, random, missed = Skin.of(LAYERS["stack"](), MomentNet()), np.random.default_rng(0), 0
    bar = trimesh.util.concatenate([trimesh.creation.box(bounds=[[0, 0, 0], [x, y, 0.012]])
                                    for x, y in ((0.03, 0.01), (0.01, 0.03))])  # fmt: skip
    layer, inside = skin.layer, np.flatnonzero(skin.near.sound.border > 1.5)
    for tool in (named(trimesh.creation.cylinder(0.011, 0.018, sections=6)), named(bar)):
        poses = np.tile(np.eye(4), (200, 1, 1, 1))
        for k, v in enumerate(random.choice(inside, 200)):
            turn, n = Rotation.random(random_state=k).as_matrix(), layer.normals[v]
            reach = float(-(tool.vertices @ turn.T @ n).min())
            poses[k, 0, :3, :3], poses[k, 0, :3, 3] = turn, layer.vertices[v] + (reach - random.uniform(0, 3e-3)) * n
        ours, there = Batch(skin, [tool], 200).touch(poses), WarpBatch(skin, [tool], 200, device="cpu").touch(poses)
        unfelt = np.array(["presses nothing" in ours.why.get((k, 0), "") for k in range(200)])
        missed += int(unfelt.sum())
        assert not np.asarray(there.in_range)[unfelt].any()
        off = ours.statuses[:, 0] == "apart"
        assert np.array_equal(np.asarray(there.in_range)[off], ours.in_range[off])
    assert missed


def test_a_tool_whose_skin_others_pushed_away_says_that_it_does_not_press_as_asked():
    simulator = Simulator(LAYERS["stack"](), MomentNet())
    layer = simulator.layer
    v = int(np.linalg.norm(layer.vertices - layer.vertices.mean(axis=0), axis=1).argmin())
    across = np.cross(layer.normals[v], [0.0, 1.0, 0.0])
    beside = layer.vertices[v] + 0.018 * across / np.linalg.norm(across)
    u = int(np.linalg.norm(layer.vertices - beside, axis=1).argmin())

    def pressed(name: str, radius: float, vertex: int, force: float) -> Contact:
        pose = np.eye(4)
        pose[:3, 3] = layer.vertices[vertex] + radius * layer.normals[vertex]
        return press(ball(radius), pose, tuple(-force * layer.normals[vertex]), name)

    _, small = simulator.touch([pressed("big", 0.02, v, 3.5), pressed("small", 0.008, u, 0.04)])
    assert small.force == 0 and small.force_bound == pytest.approx(0.04, rel=0.02)
    assert not small.trust.ok and "100% off" in small.trust.why
