"""Laws of the axisymmetric finite elements of another make, and what they say of IndenterFem at finite depth."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.axisymmetric import PLATE, RADIUS, Plate, forces, ground_truth, membrane, neo_hookean
from stmpl_core.stack import ball_force
from stmpl_core.tissue import Membrane, Tissue

ROUGH = replace(PLATE, fine=0.5)
T = PLATE.thickness


def test_a_small_depth_is_as_the_closed_form_says():
    depth = 0.02 * T
    (force,) = forces(replace(PLATE, fine=0.7), RADIUS, [depth])
    assert force == pytest.approx(ball_force(PLATE.tissue, T, RADIUS, depth), rel=0.06)


def test_stresses_at_rest_are_none_but_for_the_tension():
    rest = np.array([1.0, 0, 0, 1, 1])[:, None]
    np.testing.assert_allclose(neo_hookean(3e3, 0.45)(rest)[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(membrane(Membrane(2e5, 1.5e-3, 20.0))(rest)[:, 0], [20, 0, 0, 0, 20], atol=1e-6)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_a_pulled_sheet_is_as_stiff_as_its_modulus(nu):
    """One direction pulled, the other held: E h / (1 - nu^2)."""
    law, strain = membrane(Membrane(1e5, 1e-3, 0.0, nu)), 1e-6
    pulled = law(np.array([1 + strain, 0, 0, 1, 1.0])[:, None])[:, 0]
    assert pulled[0] == pytest.approx(1e5 * 1e-3 / (1 - nu**2) * strain, rel=1e-3)
    assert pulled[4] == pytest.approx(nu * pulled[0], rel=1e-3, abs=1e-9)


def test_indenter_fem_agrees_at_three_and_five_tenths_of_the_thickness():
    depths = [0.3 * T, 0.5 * T]
    ours, others = ground_truth(PLATE, RADIUS, depths, 6e-3, 1), forces(ROUGH, RADIUS, depths)
    np.testing.assert_allclose(ours, others, rtol=0.03)


def test_a_solid_skin_bends_where_a_membrane_does_not():
    """It bears more under a light touch, and no more than a few per cent else deep down."""
    depths = [0.05 * T, 0.4 * T]
    solid, sheet = (np.array(forces(replace(ROUGH, solid_skin=one), RADIUS, depths)) for one in (True, False))
    shallow, deep = solid / sheet - 1
    assert shallow > 0.1 and abs(deep) < 0.03


def test_a_single_layer_has_no_skin_to_be_solid():
    bare = Plate(Tissue(3e3, 0.45), T, fine=0.5)
    assert forces(bare, RADIUS, [0.1 * T]) == forces(replace(bare, solid_skin=True), RADIUS, [0.1 * T])
