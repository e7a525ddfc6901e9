"""Laws of what data keep of a tool's force."""

import numpy as np
import pytest

from fem_tools import IndenterFem, PatchFem, Press
from stmpl_core.layer import SoftLayer
from stmpl_core.sdf import SignedDistance
from studies.pressed import kept_by_normals
from tests.scenes import ball, limb, plate

RADIUS, THICKNESS = 0.015, 0.015  # m, of the ball and of the layer
pytestmark = pytest.mark.usefixtures("one_thread")


def pressed(layer: SoftLayer, vertex: int) -> tuple[float, float]:
    """Share of the force that pressures along normals at rest make: of finite elements, and as it is reckoned."""
    pose = np.eye(4)
    pose[:3, 3] = layer.vertices[vertex] + (RADIUS + 5e-3) * layer.normals[vertex]
    press = Press(SignedDistance.of(ball(RADIUS)), pose, -layer.normals[vertex])
    fem = IndenterFem(PatchFem(element="P1xP2", layers=1, reach=2.5, check_stability=False), step=0.15).prepare(layer)
    answer = fem.press([press], 0.45 * THICKNESS)
    kept = -(answer.pressure @ layer.vertex_area_vectors) @ press.direction / answer.force
    return float(kept), kept_by_normals(layer, answer.tools[0], answer.pressure, answer.displacement)


def test_on_a_round_limb_pressures_along_normals_are_not_all_of_the_force_and_it_is_known_how_much() -> None:
    layer = limb(5e-3, thickness=THICKNESS, radius=0.03, length=0.14, poisson_ratio=0.4)
    true, reckoned = pressed(layer, len(layer.vertices) // 2)
    assert true < 0.95
    assert reckoned == pytest.approx(true, abs=0.03)


def test_on_a_plate_they_are_all_of_it() -> None:
    layer = plate(0.14, 5e-3, THICKNESS, crossed=True, poisson_ratio=0.4)
    true, reckoned = pressed(layer, int(np.linalg.norm(layer.vertices, axis=1).argmin()))
    assert true == pytest.approx(1.0, abs=2e-3)
    assert reckoned == pytest.approx(1.0, abs=2e-3)
