"""Laws of the finite-element truth of a stack under a skin: derivatives, closed forms, limits, and a press."""

import numpy as np
import pytest

from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.indenter import Walk
from fem_tools.krylov import conjugate_gradients, multiply
from fem_tools.membrane import SkinMembrane
from fem_tools.mesh import ELEMENTS, WedgeMesh, level_depths
from fem_tools.patch import mirror_projectors
from fem_tools.plies import THINNEST_SHARE, wedge_ends, wedge_materials
from fem_tools.skin_loads import FollowerPressure
from fem_tools.system import System
from stmpl_core import Load, Membrane, Ply, SoftLayer, Tissue
from stmpl_core.methods.winkler import column_pressure
from stmpl_core.sdf import SignedDistance
from tests import scenes
from tests.scenes import THICKNESS, at, disc, limb, plate, wavy_layer
from tests.stack_reference import compliance, under_a_gaussian

SKIN = Membrane(2e5, 1.5e-3, 20.0)
LIMB = Tissue(3e3, 0.45, skin=SKIN, deeper=(Ply(10e-3, 15e3, 0.45),))  # fat on muscle, under skin
SKINS = [SKIN, Membrane(2e5, 1.5e-3, 0.0, 0.0), Membrane(1e3, 1e-3, 50.0, 0.5)]


def stacked_system(element, skin=SKIN) -> System:
    """A bumpy patch, 7.5 mm thick, of three materials of 1 to 20 kPa."""
    layer = wavy_layer().with_(skin=skin, deeper=(Ply(2e-3, 2e4, 0.3), Ply(6e-3, 5e3, 0.45)))
    ends = wedge_ends(layer.tissue, layer.thickness, 1)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, element, ends=ends)
    load = FollowerPressure(mesh, 400.0 * (1 + np.sin(200 * layer.vertices[:, 0])))
    return System(mesh, layer.tissue, [load], mesh.border_columns())


def moved(system: System, size: float = 1e-4, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A displacement of all nodes above the core [m], and a direction, both (C, levels, 3)."""
    u, direction = np.random.default_rng(seed).normal(size=(2, *system.zeros().shape))
    u[:, -1] = direction[:, -1] = 0
    return size * u, direction


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("skin", SKINS)
def test_internal_forces_are_the_gradient_of_the_energy(element, skin):
    system = stacked_system(element, skin)
    system.loads = []
    u, direction = moved(system)
    eps = 1e-8
    slope = (system.energy(u + eps * direction, 1.0) - system.energy(u - eps * direction, 1.0)) / (2 * eps)
    assert np.vdot(system.internal(u)[0], direction) == pytest.approx(slope, rel=2e-5)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("skin", SKINS)
def test_tangent_is_the_derivative_of_the_residual(element, skin):
    system = stacked_system(element, skin)
    (u, d), m, eps = moved(system), system.mesh, 1e-8
    product = np.empty((m.n_columns, 3 * system.free))
    multiply(m.indptr, m.indices, system.tangent(u, 1.0), d[:, :-1].reshape(len(u), -1), product)
    difference = (system.residual(u + eps * d, 1.0)[0] - system.residual(u - eps * d, 1.0)[0]) / (2 * eps)
    np.testing.assert_allclose(product, difference, atol=1e-5 * np.abs(difference).max())


def alone(element, skin: Membrane) -> tuple[SkinMembrane, System]:
    """The membrane of a patch, and the equations of the same patch with nothing in it."""
    system = stacked_system(element, skin)
    assert system.membrane is not None
    return system.membrane, system


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_membrane_at_rest_pulls_nowhere_and_turning_it_stores_nothing(element):
    membrane, system = alone(element, Membrane(2e5, 1.5e-3))
    skin = system.rest[:, 0]
    assert not membrane.forces(0 * skin)[0].any()
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    assert abs(membrane.energy(skin @ (turn - np.eye(3)).T)) < 1e-12
    taut = alone(element, SKIN)[0]
    assert np.abs(taut.forces(0 * skin)[0]).max() < 1e-15 and taut.energy(0 * skin) == 0


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
def test_a_membrane_pulled_evenly_bears_the_stress_of_the_thin_block(element, nu):
    """Stretched by 1.3 and 0.9: its energy is the least that the solid stores at any stretch across."""
    flat = plate(12e-3, 3e-3).with_(skin=Membrane(2e5, 1.5e-3, 0.0, nu))
    mesh = WedgeMesh.of(flat.vertices, flat.inner_vertices, flat.faces, element)
    membrane, a, b = SkinMembrane(mesh, flat.tissue.skin), 1.3, 0.9
    energy = membrane.energy(mesh.column_ends()[0] * [a - 1, b - 1, 0])
    mu, across = 2e5 / (2 * (1 + nu)), np.linspace(0.3, 1.7, 200001)
    if nu == 0.5:
        psi = 0.5 * mu * (a * a + b * b + 1 / (a * b) ** 2 - 3)
    else:
        lam, volume = 2e5 * nu / ((1 + nu) * (1 - 2 * nu)), np.log(a * b * across)
        psi = (0.5 * mu * (a * a + b * b + across**2 - 3) - mu * volume + 0.5 * lam * volume**2).min()
    assert energy == pytest.approx(1.5e-3 * psi * 12e-3**2, rel=1e-8)


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_convex_tangent_of_a_crumpled_skin_is_positive_where_the_true_one_is_not(element):
    system = stacked_system(element)
    mesh = system.mesh
    u = system.rest * [-0.15, -0.15, 0.0]
    u[:, -1] = 0
    b, negative = np.random.default_rng(0).normal(size=(mesh.n_columns, 3 * system.free)), []
    system.loads = []
    for convex in (0.0, 1.0):
        data = system.tangent(u, 1.0, convex=convex)
        inverse = system.preconditioner(data)
        negative.append(conjugate_gradients(mesh.indptr, mesh.indices, data, inverse, b, 1e-8, 3000)[3])
    assert negative == [True, False]
