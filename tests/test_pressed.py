"""Laws of what of a tool's force is across the skin at rest, and of what sticking skin carries along itself."""

from functools import cache

import numpy as np
import pytest

from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.walk import Indentation
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance
from stmpl_core.wrenches import unit_wrenches, wrench_of
from studies.pressed import kept_by_normals
from tests import test_simulator_stack as stack
from tests.scenes import at, ball, limb, plate

RADIUS, THICKNESS = 0.015, 0.015  # m, of the ball and of the layer
pytestmark = pytest.mark.usefixtures("one_thread")


@cache
def on_layers() -> Indentation:
    """A ball on a round limb of layers, by finite elements."""
    pose = at(-stack.RADIUS - stack.BALL - 5e-3, 0, stack.HALF)
    start = Press(SignedDistance.of(ball(stack.BALL), margin=0.03), pose, np.array([1.0, 0, 0])).touching(stack.LIMB)
    assert start is not None
    fem = IndenterFem(PatchFem(element="P1xP2", reach=6, refine=3, layers=1), step=0.15).prepare(stack.LIMB)
    (answer,) = fem.path([start], [0.3 * float(stack.LIMB.thickness.mean())])
    return answer


def across(layer: SoftLayer, answer: Indentation) -> tuple[float, float]:
    """Share of the force that pressures along normals at rest make: of finite elements, and as it is reckoned."""
    press = answer.tools[0]
    kept = -(answer.pressure @ layer.vertex_area_vectors) @ press.direction / answer.force
    return float(kept), kept_by_normals(layer, press, answer.pressure, answer.displacement)


def test_on_a_round_limb_pressures_along_normals_are_not_all_of_the_force_and_it_is_known_how_much() -> None:
    true, reckoned = across(stack.LIMB, on_layers())
    assert true < 0.98
    assert reckoned == pytest.approx(true, abs=0.01)


def test_on_layers_the_force_is_that_of_the_pressures_and_what_skin_carries_along_itself() -> None:
    answer, every = on_layers(), np.arange(len(stack.LIMB.vertices))
    skin = stack.LIMB.vertices, stack.LIMB.vertex_area_vectors
    (alone, _, _), (whole, _, _) = (wrench_of(answer.pressure, every, *skin, np.zeros(3), on) for on in (False, True))
    assert abs(whole[0] - answer.force) < 0.5 * (answer.force - alone[0])


def test_on_a_plate_they_are_all_of_it() -> None:
    layer, middle = plate(0.14, 5e-3, THICKNESS, crossed=True, poisson_ratio=0.4), at(0, 0, RADIUS + 5e-3)
    press = Press(SignedDistance.of(ball(RADIUS)), middle, np.array([0, 0, -1.0]))
    fem = IndenterFem(PatchFem(element="P1xP2", layers=1, reach=2.5, check_stability=False), step=0.15).prepare(layer)
    true, reckoned = across(layer, fem.press([press], 0.45 * THICKNESS))
    assert true == pytest.approx(1.0, abs=2e-3)
    assert reckoned == pytest.approx(1.0, abs=2e-3)


def test_what_presses_on_all_sides_carries_nothing_along_itself_and_parts_add_up_to_the_whole() -> None:
    layer = limb(8e-3, thickness=THICKNESS, radius=0.03, length=0.1, poisson_ratio=0.4)
    skin, origin = (layer.vertices, layer.vertex_area_vectors), np.array([0.0, 0.01, 0.02])
    every = np.arange(len(layer.vertices))
    squeezed, way, carried = wrench_of(np.full(len(every), 100.0), every, *skin, origin, True)
    assert carried == 0 and not way.any() and np.linalg.norm(squeezed[:3]) < 0.1 * 100 * layer.vertex_areas.sum()
    pressure = 1e3 * np.maximum(layer.normals @ [-0.9, 0.3, 0.3], 0)
    whole, way, carried = wrench_of(pressure, every, *skin, origin, True)
    assert carried > 0.1 * np.linalg.norm(whole[:3])
    corners = np.repeat(every[:, None], 3, axis=1)
    units = unit_wrenches(*skin, layer.vertex_areas, origin, corners, way)[:, 0]
    np.testing.assert_allclose((pressure * layer.vertex_areas) @ units, whole, rtol=1e-9, atol=1e-12)
