"""Laws of contact: wrench in, load on the skin, displacement out."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh

from stmpl_core import Contact, Load, SoftLayer
from stmpl_core.errors import InvalidInput, MeshError
from stmpl_core.methods import Naive, Winkler
from stmpl_core.simulator import Simulator
from stmpl_core.touch import (
    APART,
    BY_POSE,
    MOVED,
    NO_FORCE,
    NO_TOUCH,
    PULLING,
    TOUCHING,
    WRAPPED,
    Toucher,
)
from tests.touch_scenes import LENGTH, RADIUS, at, ball, capsule, limb, plate, press, punch, tool, turn

LIMB, PLATE, BALL, PUNCH = limb(), plate(), ball(), punch()
MIDDLE = LENGTH / 2


def on_limb(depth: float = 2e-3, radius: float = 0.012) -> np.ndarray:
    return at(RADIUS + radius - depth, 0, MIDDLE)


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator(LIMB, Winkler())


@pytest.fixture(scope="module")
def flat() -> Simulator:
    return Simulator(PLATE, Winkler())


def total(layer: SoftLayer, pressure: np.ndarray | None) -> np.ndarray:
    assert pressure is not None
    return Load.pressure(pressure).forces_on(layer).sum(axis=0)


def test_no_contact_moves_nothing(sim: Simulator) -> None:
    assert not sim.step([]).displacement.any()


@pytest.mark.parametrize("depth", [-0.05, -1e-3, 0.0, 2e-3, 5e-3])
def test_zero_wrench_moves_nothing_at_any_pose(sim: Simulator, depth: float) -> None:
    answer = sim.step([press(BALL, on_limb(depth), (0, 0, 0))])
    assert not answer.displacement.any()
    assert answer.statuses["probe"] == (NO_FORCE if depth > 0 else APART)


@pytest.mark.parametrize("force", [(-0.3, 0, 0), (-0.2, 0.1, 0.05), (-2.0, -0.4, 0.3)])
@pytest.mark.parametrize("mesh, x", [(BALL, RADIUS + 0.010), (PUNCH, RADIUS + 0.008)])
def test_load_sums_to_the_normal_component_of_the_wrench(
    sim: Simulator, mesh: object, x: float, force: tuple[float, float, float]
) -> None:
    answer = sim.step([press(mesh, at(x, 0.001, MIDDLE + 0.0007), force)])  # type: ignore[arg-type]
    carried = total(LIMB, answer.pressure)
    normal = carried / np.linalg.norm(carried)
    np.testing.assert_allclose(carried, (np.array(force) @ normal) * normal, rtol=1e-12, atol=1e-14)
    figures = answer.trust.figures
    assert figures["probe.normal_n"] == pytest.approx(np.array(force) @ normal, rel=1e-12)
    assert np.hypot(figures["probe.normal_n"], figures["probe.tangential_n"]) == pytest.approx(np.linalg.norm(force))


def test_load_is_linear_in_the_wrench(sim: Simulator) -> None:
    one, three = (sim.step([press(BALL, on_limb(), (-f, 0, 0))]).pressure for f in (0.1, 0.3))
    np.testing.assert_allclose(three, 3 * np.asarray(one), rtol=1e-13)


def test_torque_is_balanced_by_a_centred_press_and_reported_otherwise(flat: Simulator) -> None:
    centred = flat.step([press(BALL, at(0, 0, 0.010), (0, 0, -0.2))]).trust.figures
    assert centred["probe.torque_nm"] < 1e-5
    twisted = flat.step([Contact("probe", BALL, at(0, 0, 0.010), np.array([0, 0, -0.2, 0, 0, 0.05]))]).trust.figures
    assert twisted["probe.torque_nm"] == pytest.approx(0.05, rel=1e-3)


def test_pressure_never_pulls(sim: Simulator) -> None:
    for mesh, x in ((BALL, RADIUS + 0.010), (PUNCH, RADIUS + 0.008)):
        assert (sim.step([press(mesh, at(x, 0, MIDDLE), (-0.3, 0.1, 0))]).pressure >= 0).all()  # type: ignore[operator]


SCENE = turn((0.3, -0.5, 0.8), 1.1, (0.4, -0.2, 0.9))


@pytest.fixture(scope="module", params=[Winkler, Naive])
def turned_pair(request: pytest.FixtureRequest) -> tuple[Simulator, Simulator]:
    layer = LIMB.with_(vertices=LIMB.vertices @ SCENE[:3, :3].T + SCENE[:3, 3])
    return Simulator(LIMB, request.param()), Simulator(layer, request.param())


@pytest.mark.parametrize("force", [(-0.25, 0.05, 0.02), None])
def test_turning_and_moving_the_scene_turns_the_answer(turned_pair: tuple, force: tuple | None) -> None:
    still, turned = turned_pair
    rotation, pose = SCENE[:3, :3], on_limb()
    before = still.step([press(BALL, pose, force)])
    after = turned.step([press(BALL, SCENE @ pose, None if force is None else tuple(rotation @ force))])
    assert before.magnitude.max() > 5e-4
    np.testing.assert_allclose(after.displacement, before.displacement @ rotation.T, atol=1e-9)


def test_replay_is_bit_identical() -> None:
    pose = at(-RADIUS - 0.009, 0, 0.04)
    contacts = [press(BALL, on_limb(), (-0.3, 0.1, 0)), press(PUNCH, pose, (0.2, 0, 0), "other")]
    first, second = (Simulator(LIMB, Winkler()).step(contacts).displacement for _ in range(2))
    assert first.tobytes() == second.tobytes()


@pytest.mark.parametrize("mesh, height", [(BALL, 0.0105), (PUNCH, 0.0135)])
@pytest.mark.parametrize("force", [(0, 0, -0.1), None])
def test_load_changes_continuously_while_the_tool_slides(
    flat: Simulator, mesh: object, height: float, force: tuple | None
) -> None:
    """Sliding across edges, faces and vertices no pressure jumps: a quarter of the slide, a quarter of it."""

    def worst_change(step: float) -> float:
        slide = np.arange(0, 4e-3, step)
        pressures = [flat.step([press(mesh, at(s, 0.37 * s, height), force)]).pressure for s in slide]  # type: ignore
        return max(np.abs(np.subtract(b, a)).sum() / np.sum(a) for a, b in pairwise(pressures))

    coarse, fine = worst_change(1e-4), worst_change(2.5e-5)
    assert coarse < 0.1
    assert fine < 0.4 * coarse


@pytest.mark.parametrize("mesh, half", [(BALL, 0.012), (PUNCH, 0.015)])
def test_load_changes_continuously_while_the_tool_comes_down(flat: Simulator, mesh: object, half: float) -> None:
    depths = np.arange(-2.9e-3, 4e-3, 5e-5)
    pressures = [flat.step([press(mesh, at(0.0004, 0.0002, half - d), (0, 0, -0.1))]).pressure  # type: ignore[arg-type]
                 for d in depths]
    change = [np.abs(np.subtract(b, a)).sum() / np.sum(a) for a, b in pairwise(pressures)]
    assert max(change) < 0.1


def test_a_ball_covers_the_cap_that_geometry_says(flat: Simulator) -> None:
    depth, radius = 3e-3, 0.012
    pressure = flat.step([press(BALL, at(0, 0, radius - depth), None)]).pressure
    r = np.linalg.norm(PLATE.vertices[:, :2], axis=1)
    cap = np.sqrt(radius**2 - (radius - depth) ** 2)
    loaded = np.asarray(pressure) > 0
    assert loaded[r < cap - 2e-4].all() and not loaded[r > cap + 2e-4].any()


def test_pose_alone_presses_columns_to_the_tool(flat: Simulator) -> None:
    answer = flat.step([press(BALL, at(0, 0, 0.009), None)])
    assert answer.statuses["probe"] == BY_POSE
    r = np.linalg.norm(PLATE.vertices[:, :2], axis=1)
    inner = r < 6e-3
    surface = 0.009 - np.sqrt(0.012**2 - r[inner] ** 2)
    np.testing.assert_allclose(answer.displacement[inner, 2], surface, atol=1.5e-4)  # the ball's facets: 0.1 mm


def test_a_thin_plate_under_the_rest_position_of_the_skin_still_presses(flat: Simulator) -> None:
    slab = tool(trimesh.creation.box((0.03, 0.03, 0.004)))
    answer = flat.step([press(slab, at(0, 0, -0.0035), (0, 0, -0.3))])  # from 1.5 to 5.5 mm below the skin
    assert answer.statuses["probe"] == TOUCHING
    assert total(PLATE, answer.pressure)[2] == pytest.approx(-0.3)


def test_the_far_side_of_the_limb_stays_free(sim: Simulator) -> None:
    answer = sim.step([press(BALL, on_limb(depth=6e-3), (-0.3, 0, 0))])
    assert not answer.displacement[LIMB.vertices[:, 0] < 0.02].any()


def test_a_tool_finer_than_the_mesh_does_not_slip_between_vertices(flat: Simulator) -> None:
    needle = capsule(0.012, 0.0006, 12)
    for spot in PLATE.vertices[PLATE.faces[1200:1210]].mean(axis=1):
        answer = flat.step([press(needle, at(spot[0], spot[1], 0.0056), (0, 0, -0.001))])
        assert total(PLATE, answer.pressure)[2] == pytest.approx(-0.001)


def test_a_pose_that_is_off_is_moved_along_the_push(sim: Simulator) -> None:
    answer = sim.step([press(BALL, on_limb(-2.5e-3), (-0.2, 0, 0))])
    assert answer.statuses["probe"] == MOVED
    assert answer.trust.figures["probe.moved_m"] == pytest.approx(2.5e-3, abs=2.5e-4)  # the nearest vertex is met
    assert total(LIMB, answer.pressure)[0] == pytest.approx(-0.2, rel=1e-3)
    at_touch = sim.step([press(BALL, on_limb(-1e-6), (-0.2, 0, 0))])
    np.testing.assert_allclose(answer.displacement, at_touch.displacement, atol=1e-5)


def test_a_wrench_without_touch_loads_nothing_and_is_out_of_range(sim: Simulator) -> None:
    for pose, force in ((on_limb(-4e-3), (-1, 0, 0)), (on_limb(-1e-3), (0, 0, -1)), (at(1, 1, 1), (-1, 0, 0))):
        answer = sim.step([press(BALL, pose, force)])
        assert answer.statuses["probe"] == NO_TOUCH
        assert not answer.displacement.any() and not answer.trust.in_range and "within 3 mm" in answer.trust.why


def test_pulling_loads_nothing(sim: Simulator) -> None:
    answer = sim.step([press(BALL, on_limb(), (1, 0, 0))])
    assert answer.statuses["probe"] == PULLING and not answer.displacement.any()


def test_a_closed_band_has_no_direction(sim: Simulator) -> None:
    band = tool(trimesh.creation.annulus(RADIUS - 0.002, RADIUS + 0.01, 0.02, sections=96))
    answer = sim.step([press(band, at(0, 0, MIDDLE), (-1, 0, 0))])
    assert answer.statuses["probe"] == WRAPPED and not answer.displacement.any() and not answer.trust.in_range
    squeezed = sim.step([press(band, at(0, 0, MIDDLE), None)])
    assert squeezed.statuses["probe"] == BY_POSE
    ring = np.abs(LIMB.vertices[:, 2] - MIDDLE) < 0.008
    np.testing.assert_allclose(squeezed.magnitude[ring], 0.002, atol=1.5e-4)


def test_two_fingers_add(sim: Simulator) -> None:
    left = press(BALL, on_limb(), (-0.3, 0, 0), "left")
    right = press(BALL, at(-RADIUS - 0.010, 0, MIDDLE), (0.3, 0, 0), "right")
    both = sim.step([left, right])
    np.testing.assert_array_equal(both.pressure, np.add(sim.step([left]).pressure, sim.step([right]).pressure))
    assert set(both.statuses) == {"left", "right"}
    assert "right.normal_n" in both.trust.figures


def test_pressure_beyond_what_was_validated_is_flagged_and_not_clipped(sim: Simulator) -> None:
    answer = sim.step([press(BALL, on_limb(), (-5, 0, 0))])
    assert not answer.trust.in_range and "p/E" in answer.trust.why
    assert total(LIMB, answer.pressure)[0] == pytest.approx(-5, rel=1e-3)


def test_bad_input_is_refused_with_a_reason(sim: Simulator) -> None:
    with pytest.raises(InvalidInput, match="wrench of probe holds 1"):
        press(BALL, on_limb(), (np.nan, 0, 0))
    with pytest.raises(InvalidInput, match="pose of probe is not rigid"):
        press(BALL, np.diag([1.0, 1.0, 2.0, 1.0]), (1, 0, 0))
    with pytest.raises(InvalidInput, match="names of their own"):
        sim.step([press(BALL, on_limb(), None), press(BALL, on_limb(), None)])
    with pytest.raises(MeshError, match="millimetres"):
        sim.step([press(ball(12.0), on_limb(), (-1, 0, 0))])


def test_a_tool_is_measured_once(sim: Simulator) -> None:
    assert sim.prepare_tool(BALL) is sim.prepare_tool(BALL)


def test_reach_is_the_callers(sim: Simulator) -> None:
    contact = press(BALL, on_limb(-4e-3), (-0.2, 0, 0))
    assert Toucher(LIMB, reach=5e-3).touch(contact, sim.prepare_tool(BALL)).status == MOVED
