"""Laws of the finite-element truth of a stack under a skin: derivatives, closed forms, limits, and a press."""

import numpy as np
import pytest

from fem_tools import IndenterFem, PatchFem, Press
from fem_tools.indenter import Walk
from fem_tools.krylov import conjugate_gradients, multiply
from fem_tools.membrane import SkinMembrane
from fem_tools.mesh import ELEMENTS, WedgeMesh, level_depths
from fem_tools.newton import solve
from fem_tools.patch import mirror_projectors
from fem_tools.plies import THINNEST_SHARE, confined, materials, wedge_ends, wedge_materials
from fem_tools.skin_loads import FollowerPressure
from fem_tools.system import System
from stmpl_core import Load, Membrane, Ply, Tissue
from stmpl_core.bones import Bone, to_bone
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


def test_the_reference_through_the_depth_is_the_closed_form_of_one_layer():
    """Johnson's closed form, which the linear response is made of (stmpl_core.response), at k t = 0.3, 1, 3."""
    nu, k = 0.4, np.array([0.3, 1.0, 3.0])
    denominator = (3 - 4 * nu) * np.cosh(2 * k) + 2 * k * k + 5 - 12 * nu + 8 * nu * nu
    down = (1 - nu) * ((3 - 4 * nu) * np.sinh(2 * k) - 2 * k)
    along = k * k - (1 - 2 * nu) * (3 - 4 * nu) * np.sinh(k) ** 2
    expected = np.stack([down, along], axis=1) * (2 * (1 + nu) / (k * denominator))[:, None]
    found = compliance(Tissue(1e3, nu), THICKNESS, k / THICKNESS) * 1e3 / THICKNESS
    np.testing.assert_allclose(found, expected, rtol=1e-5)


FAT_ON_MUSCLE = (Ply(6e-3, 15e3, 0.4),)
STACKS = {
    "two materials": Tissue(3e3, 0.4, deeper=FAT_ON_MUSCLE),
    "muscle on fat": Tissue(15e3, 0.4, deeper=(Ply(6e-3, 3e3, 0.4),)),
    "a skin": Tissue(3e3, 0.4, skin=Membrane(2e5, 1.5e-3)),
    "a skin as stiff as can be": Tissue(3e3, 0.4, skin=Membrane(6e5, 1.5e-3)),
    "a taut skin": Tissue(3e3, 0.4, skin=SKIN),
    "tension alone": Tissue(3e3, 0.4, skin=Membrane(100.0, 1e-4, 20.0)),
    "a taut skin on two materials": Tissue(3e3, 0.4, skin=SKIN, deeper=FAT_ON_MUSCLE),
}
SOLID = {
    "nearly incompressible": Tissue(3e3, 0.45, skin=SKIN, deeper=(Ply(6e-3, 15e3, 0.45),)),
    "a solid skin": Tissue(2e5, 0.45, deeper=(Ply(1.5e-3, 3e3, 0.45),)),
}
WIDE = 12e-3  # thickness of the plates [m]


def off(tissue: Tissue, edge: float, width: float = 8e-3, size: float = 0.12, **options) -> tuple[float, float]:
    """Errors at the peak and anywhere of an answer to a weak Gaussian pressure [shares of the peak]."""
    layer = plate(size, edge, WIDE, crossed=True).with_(tissue=tissue)
    softest = min(one.youngs_modulus for one in materials(tissue))
    away, peak = np.linalg.norm(layer.vertices[:, :2], axis=1), 1e-3 * softest
    load = Load.pressure(np.where(away < 4 * width, peak * np.exp(-0.5 * (away / width) ** 2), 0.0))
    answer = PatchFem(border="mirror", reach=9, check_stability=False, **options).prepare(layer).solve(load)
    assert answer.trust.converged
    known = under_a_gaussian(tissue, WIDE, peak, width, away)
    outwards = layer.vertices[:, :2] / np.maximum(away, 1e-12)[:, None]
    error = answer.displacement + np.column_stack([-known[:, 1, None] * outwards, known[:, 0]])
    middle, largest = away.argmin(), known[:, 0].max()
    return float(error[middle, 2]) / largest, float(np.linalg.norm(error, axis=1).max()) / largest


@pytest.mark.parametrize("tissue", STACKS.values(), ids=STACKS)
def test_a_weak_pressure_moves_a_stack_as_its_closed_form_says(tissue):
    at_peak, anywhere = off(tissue, 2e-3)
    assert abs(at_peak) < 0.01 and anywhere < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("tissue", SOLID.values(), ids=SOLID)
def test_nearly_incompressible_and_solid_skins_move_as_their_closed_form_says(tissue):
    """Quadratic in plane; a solid skin bends, and wants no more than one wedge of its own."""
    at_peak, anywhere = off(tissue, 3e-3, 12e-3, element="P2xP2", layers=1 if tissue.skin is None else 2)
    assert abs(at_peak) < 0.015 and anywhere < 0.015


def test_the_answer_of_a_stack_comes_to_the_closed_form_as_the_mesh_is_refined():
    """At least with the mesh width to the power 1.6: what a linear pressure and linear wedges leave is its square."""
    coarse, fine = (off(STACKS["a taut skin on two materials"], edge, 12e-3, 0.16) for edge in (5e-3, 2.5e-3))
    assert (np.log2(np.divide(coarse, fine)) > 1.6).all()


def test_equal_materials_without_a_skin_answer_as_one():
    layer = limb(5e-3)
    same = layer.with_(deeper=(Ply(THICKNESS * level_depths(2)[2], layer.tissue.youngs_modulus, 0.4),))
    load = disc(layer, 0.6, layer.vertices[len(layer.vertices) // 2], 0.01)
    one, two = (PatchFem(reach=3, layers=n).prepare(x).solve(load) for n, x in ((2, layer), (1, same)))
    assert two.trust.converged and two.trust.figures["newton_iterations"] == one.trust.figures["newton_iterations"]
    np.testing.assert_allclose(two.displacement, one.displacement, atol=1e-12 + 1e-9 * one.magnitude.max())


def test_a_stiff_skin_on_a_fine_mesh_takes_few_newton_steps():
    """kappa 30, edges of a tenth of the thickness, p / E = 1."""
    layer = plate(0.1, 2e-3, 0.02, crossed=True).with_(skin=Membrane(3e5, 2e-3))
    answer = PatchFem(reach=2, check_stability=False).prepare(layer).solve(disc(layer, 1.0, np.zeros(3), 0.015))
    assert answer.trust.converged and answer.trust.figures["newton_iterations"] < 20


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("ratio", [0.2, 1.0, 3.0])
def test_a_confined_stack_is_the_sum_of_its_columns(element, ratio):
    """A skin that does not stretch changes nothing; from rest, so that Newton has work to do."""
    tissue = Tissue(1e3, 0.3, skin=SKIN, deeper=(Ply(2e-3, 5e3, 0.4), Ply(6e-3, 2e3, 0.1)))
    flat = plate(4 * THICKNESS, THICKNESS, crossed=True).with_(tissue=tissue)
    mesh = WedgeMesh.of(flat.vertices, flat.inner_vertices, flat.faces, element,
                        ends=wedge_ends(tissue, flat.thickness, 1))  # fmt: skip
    load = FollowerPressure(mesh, np.full(mesh.n_columns, ratio * 1e3))
    system = System(mesh, tissue, [load], np.zeros(mesh.n_columns, bool), mirror_projectors(mesh))
    result = solve(system, system.zeros())
    assert result.converged and result.iterations > 1
    guess = confined(mesh, tissue, np.full(mesh.n_columns, ratio * 1e3))
    np.testing.assert_allclose(result.u, guess, atol=1e-5 * np.abs(guess).max())
    depth = mesh.rest_positions()[0, :, 2] / -THICKNESS * 7.5
    for k, one in enumerate(materials(tissue)):
        bounds = np.searchsorted(depth, np.array([0, 2, 6, 7.5])[k : k + 2] - 1e-9)
        stretch = 1 + np.diff(guess[0, bounds, 2])[0] / np.diff(-1e-3 * depth[bounds])[0]
        assert column_pressure([stretch], one)[0] == pytest.approx(ratio * 1e3, rel=1e-9)


def test_wedges_end_where_materials_begin_and_no_column_loses_one():
    tissue = Tissue(deeper=(Ply(4e-3, 5e3), Ply(10e-3, 2e4)))
    length = np.array([3e-3, 4.01e-3, 8e-3, 12e-3, 60e-3])
    ends = wedge_ends(tissue, length, 2)
    many = [2, 1, 2]  # 4 to 10 mm: not thrice as deep; 10 to 60 mm: six times
    assert ends.shape == (5, 6) and (np.diff(ends, axis=1) > 0.5 * THINNEST_SHARE).all()
    at = np.cumsum(many)[:2]
    np.testing.assert_allclose((ends * length[:, None])[3:, at], np.tile([4e-3, 10e-3], (2, 1)))
    np.testing.assert_allclose(ends[2, at[0]] * 8e-3, 4e-3)
    np.testing.assert_array_equal(wedge_ends(tissue, length[:1], 2), level_depths(2)[None, ::2])


def test_a_material_is_only_where_columns_reach_it():
    flat = plate(6e-3, 3e-3)
    thick = np.where(flat.vertices[:, 0] < 0.5e-3, 3e-3, 12e-3)
    layer = flat.with_(thickness=thick, deeper=(Ply(4e-3, 5e3),))
    ends = wedge_ends(layer.tissue, layer.thickness, 1)
    mesh = WedgeMesh.of(layer.vertices, layer.inner_vertices, layer.faces, ends=ends)
    mu = wedge_materials(mesh, layer.tissue)[0].reshape(len(mesh.triangles), mesh.layers)
    soft, stiff = (one.shear_modulus for one in materials(layer.tissue))
    assert (mu[:, 0] == soft).all()
    thin = (thick[layer.faces] < 4e-3).all(axis=1)
    assert thin.any() and (mu[thin] == soft).all() and (mu[(thick[layer.faces] > 4e-3).all(axis=1), -1] == stiff).all()


def test_a_taut_limb_at_rest_stays_as_it_is_and_is_harder_to_press():
    loose, taut = (limb(4e-3).with_(skin=Membrane(1e4, 1e-3, tension)) for tension in (0.0, 10.0))
    fem = PatchFem(reach=3).prepare(taut)
    system = fem.system(fem.patch_around(np.array([0])), Load.zero(taut))
    assert np.abs(system.residual(system.zeros(), 1.0)[0]).max() < 1e-15
    load = disc(taut, 0.4, taut.vertices[len(taut.vertices) // 2], 0.01)
    soft, hard = (PatchFem(reach=4).prepare(x).solve(load) for x in (loose, taut))
    assert soft.trust.ok and hard.trust.ok, (soft.trust.why, hard.trust.why)
    assert hard.magnitude.max() < 0.8 * soft.magnitude.max()


# A ball of 20 mm into skin, fat and muscle


def into_the_limb(depths, tissue: Tissue = LIMB, **options) -> tuple[Walk, list]:
    """A walk on a plate of 30 mm, and what it says at each depth."""
    layer = plate(0.14, 1e-2, 30e-3, crossed=True).with_(tissue=tissue)
    fem = PatchFem(element="P1xP2", refine=2, reach=2, layers=2)
    tool = Press(SignedDistance.of(scenes.ball(20e-3, 4)), at(0, 0, 0.021), np.array([0, 0, -1.0]))
    walk = Walk(IndenterFem(fem, **options).prepare(layer), layer, [tool], np.array(depths))
    return walk, [walk.to(depth) for depth in depths]


def test_a_ball_goes_a_millimetre_into_a_limb_and_the_core_bears_its_force():
    walk, (answer,) = into_the_limb([1e-3])
    assert answer.trust.ok, answer.trust.why
    reaction = walk.system.internal(walk.state.u)[0]
    held = reaction[:, -1].sum(axis=0) + reaction[walk.patch.fixed, :-1].sum(axis=(0, 1))
    np.testing.assert_allclose(held, -answer.wrenches[0][:3], atol=2e-3 * answer.force)
    assert 0.05 < answer.force < 0.2


def test_the_work_of_a_ball_without_friction_is_the_energy_that_a_limb_stores():
    walk, answers = into_the_limb([1.6e-3, 1.8e-3], friction="none")
    first, forces = stored(walk), [answer.force for answer in answers]
    forces += [walk.to(depth).force for depth in (2.0e-3,)]
    work = 0.2e-3 * (forces[1] + forces[2]) / 2
    assert stored(walk) - first == pytest.approx(work, rel=0.01)


def stored(walk: Walk) -> float:
    """Energy of wedges and membrane at the present state [J]."""
    loads, walk.system.loads = walk.system.loads, []
    energy = walk.system.energy(walk.state.u, 1.0)
    walk.system.loads = loads
    return energy


@pytest.mark.slow
@pytest.mark.parametrize("tissue", [LIMB, Tissue(3e3, 0.45, skin=Membrane(1e6, 2.7e-3, 20.0))])
def test_a_ball_reaches_ten_newtons(tissue):
    """In a limb's stack, and in one material under a skin with E_s h = 30 E t."""
    _, answers = into_the_limb([4e-3, 8e-3, 12e-3, 16e-3], tissue, step=0.08)
    forces = [answer.force for answer in answers]
    assert all(answer.trust.ok for answer in answers), [answer.trust.why for answer in answers]
    assert np.all(np.diff(forces) > 0) and forces[-1] > 10


def test_a_wrench_is_carried_where_the_tissue_is_thick_however_thin_it_is_elsewhere():
    round_limb = limb(7e-3, 10e-3, 0.035, 0.16).with_(tissue=LIMB)
    layer = to_bone(round_limb, [Bone(np.array([0.012, 0, -1]), np.array([0.012, 0, 1]), 0.02)])
    tool = Press(SignedDistance.of(scenes.ball()), at(-0.035 - 0.012, 0, 0.08), np.array([1.0, 0, 0]))
    fem = IndenterFem(PatchFem(element="P1xP2", reach=9, layers=1, check_stability=False), step=0.2).prepare(layer)
    answer = fem.press_with([tool], 1.5, tolerance=0.02)
    assert answer.force == pytest.approx(1.5, rel=0.02) and answer.depth > 0.9 * layer.thickness.min()
