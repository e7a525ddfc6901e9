"""Laws of the linear response and of what a vertex feels: closed forms, superposition, and FEM at small loads."""

import gc
import pickle
import weakref
from functools import cache

import numpy as np
import pytest

from fem_tools import PatchFem
from stmpl_core import Load, Skin, SoftLayer, Tissue
from stmpl_core.errors import InvalidInput, NotPrepared
from stmpl_core.methods import Linear, MomentNet
from stmpl_core.metrics import score
from stmpl_core.moments import Surroundings
from stmpl_core.response import FINER, NEAR, REACH, SPREADS, STEPS, response_table, ring_table
from tests import scenes
from tests.scenes import limb, plate, turn

T = 6e-3


@cache
def sheet(nu: float = 0.4) -> SoftLayer:
    return plate(0.144, 3e-3, T, poisson_ratio=nu)


@cache
def arm(h: float = 3e-3) -> SoftLayer:
    return limb(h, T)


def disc(layer: SoftLayer, centre: list[float], ratio: float, radius: float = 0.011) -> Load:
    return scenes.disc(layer, ratio, centre, radius)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.4, 0.49])
def test_a_unit_force_sinks_as_much_in_all_as_a_uniform_pressure_sinks_a_confined_column(nu: float) -> None:
    """The integral of the response over the plane is t / M."""
    radius = np.arange(int(REACH * STEPS) + 2) / STEPS
    for level in (4, 9):
        whole = response_table(Tissue(poisson_ratio=nu))[level, :, 0] @ (2 * np.pi * radius) / STEPS
        assert whole == pytest.approx((1 + nu) * (1 - 2 * nu) / (1 - nu), rel=1e-4)


def test_a_force_on_a_thick_layer_sinks_it_as_boussinesq_says() -> None:
    """Close to a force the rigid floor is not felt: u = (1 - nu^2) / (pi E r)."""
    nu, step = 0.3, 1 / STEPS
    r = np.arange(round(5 * SPREADS[0] / step), round(0.4 / step)) * step
    floor = response_table(Tissue(poisson_ratio=nu))[0, np.round(r / step).astype(int), 0] - (1 - nu**2) / (np.pi * r)
    assert np.ptp(floor) < 0.01 * (1 - nu**2) / (np.pi * r[0])  # what the floor takes away is nearly constant there


def test_rings_weigh_one_over_the_plane_and_end_where_they_should() -> None:
    step = 1 / (STEPS * FINER)
    radius = np.arange(int(NEAR / step) + 2) * step
    rings = ring_table()
    np.testing.assert_allclose((2 * np.pi * radius[:, None] * rings[:, :8]).sum(axis=0) * step, 1.0, atol=1e-4)
    assert not rings[radius >= NEAR].any()


@pytest.mark.parametrize("nu", [0.3, 0.4, 0.45])
def test_linear_is_fem_at_small_loads_on_a_flat_layer(nu: float) -> None:
    layer = sheet(nu)
    load = disc(layer, [0, 0, 0], 0.01)
    truth = PatchFem(element="P2xP2", reach=7).prepare(layer).solve(load)
    judged = score(Linear().prepare(layer).solve(load).displacement, truth.displacement, layer, load)
    assert judged.mee_share < 0.015 and abs(judged.peak_share) < 0.05


def test_linear_on_a_limb_is_off_by_its_curvature_only_a_little() -> None:
    layer = arm()
    load = disc(layer, [0.04, 0, 0.08], 0.01)
    truth = PatchFem(reach=7).prepare(layer).solve(load)
    judged = score(Linear().prepare(layer).solve(load).displacement, truth.displacement, layer, load)
    assert judged.mee_share < 0.035 and abs(judged.peak_share) < 0.03


def test_no_load_moves_nothing_and_two_loads_move_what_each_moves() -> None:
    layer = arm()
    method = Linear().prepare(layer)
    a, b = disc(layer, [0.04, 0, 0.07], 0.05), disc(layer, [0.035, 0.02, 0.09], 0.03)
    assert not method.solve(Load.zero(layer)).displacement.any()
    both = method.solve(Load.pressure(a.values + b.values)).displacement
    apart = method.solve(a).displacement + method.solve(b).displacement
    np.testing.assert_allclose(both, apart, atol=5e-3 * np.abs(both).max())  # each is thinned for itself


def test_beyond_its_reach_nothing_moves() -> None:
    layer = arm()
    load = disc(layer, [0.04, 0, 0.08], 0.05)
    moved = Linear().prepare(layer).solve(load).magnitude > 0
    away = np.linalg.norm(layer.vertices[:, None] - layer.vertices[load.loaded][None], axis=2).min(axis=1)
    assert moved.any() and not moved[away > REACH * T].any()


def test_turning_the_scene_turns_the_answer() -> None:
    layer, load = arm(), disc(arm(), [0.04, 0, 0.08], 0.05)
    rotation = turn((1, 2, 3), 1.1)[:3, :3]
    turned = layer.with_(vertices=layer.vertices @ rotation.T + [0.3, -0.1, 0.2])
    straight = Linear().prepare(layer).solve(load).displacement
    np.testing.assert_allclose(Linear().prepare(turned).solve(load).displacement, straight @ rotation.T, atol=2e-8)


def test_curvature_of_a_cylinder_and_slope_of_a_wedge_are_found() -> None:
    limb = arm()
    inner = np.abs(limb.vertices[:, 2] - 0.08) < 0.04
    bent = Surroundings(limb).curvature[inner]
    mean, deviator = (bent[:, 0] + bent[:, 2]) / 2, np.hypot((bent[:, 0] - bent[:, 2]) / 2, bent[:, 1])
    np.testing.assert_allclose(mean, T / 0.04 / 2, rtol=0.05)
    np.testing.assert_allclose(deviator, T / 0.04 / 2, rtol=0.05)
    flat = sheet()
    wedge = flat.with_(thickness=T + 0.05 * flat.vertices[:, 0])
    near = Surroundings(wedge)
    inner = np.linalg.norm(flat.vertices, axis=1) < 0.03
    along = np.einsum("vi,vij->vj", near.slope[inner], near.frames[inner, :2])
    np.testing.assert_allclose(along, np.tile([0.05, 0, 0], (inner.sum(), 1)), atol=5e-3)


def test_out_of_range_is_said_and_misuse_refused() -> None:
    layer = arm()
    with pytest.raises(NotPrepared):
        Linear().solve(Load.zero(layer))
    method = Linear().prepare(layer)
    with pytest.raises(InvalidInput):
        method.solve(Load.pressure(np.zeros(3)))
    assert method.solve(disc(layer, [0.04, 0, 0.08], 0.05)).trust.ok
    assert not method.solve(disc(layer, [0.04, 0, 0.08], 0.5)).trust.in_range


def test_what_was_made_of_a_layer_goes_with_it() -> None:
    layer = limb(8e-3, T)
    near = Surroundings.of(layer)
    assert Surroundings.of(layer) is near
    assert not [name for name, value in vars(layer).items() if value is near], "nothing is planted on a layer"
    skin = pickle.loads(pickle.dumps(Skin.of(layer, MomentNet())))
    assert skin.near is not near and np.array_equal(skin.layer.vertices, layer.vertices)
    assert skin.method.solve(Load.zero(skin.layer)).trust.ok
    gone = weakref.ref(layer)
    del layer, near
    gc.collect()
    assert gone() is None
