"""Laws of a bonded stack's linear response, and of the single layer nearest to it."""

from itertools import pairwise

import numpy as np
import pytest

from stmpl_core import Membrane, Ply, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.stack import along, ball, ball_force, compliance, effective, stiffening

K = np.geomspace(0.02, 400, 300)
SKIN = Membrane(2e5, 1.5e-3, 20.0)
LIMB = Tissue(3e3, 0.45, skin=SKIN, deeper=(Ply(10e-3, 10e3, 0.45),))


def closed_form(nu, k):
    """A and B of stmpl_core.response.response_table's docstring [t/E]."""
    s, mu_k = np.sinh(k), k / (2 * (1 + nu))
    d = mu_k * ((3 - 4 * nu) * np.cosh(2 * k) + 2 * k * k + 5 - 12 * nu + 8 * nu * nu)
    return (1 - nu) * ((3 - 4 * nu) * np.sinh(2 * k) - 2 * k) / d, (k * k - (1 - 2 * nu) * (3 - 4 * nu) * s * s) / d


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45, 0.49])
def test_one_material_gives_the_closed_form(nu):
    k = np.geomspace(0.02, 300, 300)
    sinking, along = closed_form(nu, k)
    found = compliance(Tissue(1e3, nu), 0.03, k)
    np.testing.assert_allclose(found.sinking, sinking, rtol=1e-12)
    np.testing.assert_allclose(found.along, along, atol=1e-12 * sinking.min(), rtol=1e-11)


@pytest.mark.parametrize("nu", [0.0, 0.45, 0.499])
def test_equal_materials_are_one_material(nu):
    hardly_other = np.nextafter(1e3, 2e3)  # or the closed form would be asked
    alike = Tissue(1e3, nu, deeper=tuple(Ply(depth, hardly_other, nu) for depth in (1e-3, 2e-3, 1e-2, 2.9e-2)))
    assert not alike.single
    whole, cut = compliance(Tissue(1e3, nu), 0.03, K), compliance(alike, 0.03, K)
    np.testing.assert_allclose(cut.sinking, whole.sinking, rtol=1e-11)
    np.testing.assert_allclose(cut.along, whole.along, atol=1e-11 * whole.sinking.max())


def through_the_depth(tissue, thickness, k, rows):
    """A and B [t/E] by linear finite elements through the depth, of motion U(z) sin(k x), W(z) cos(k x)."""
    cuts = [0.0, *(ply.depth / thickness for ply in tissue.deeper), 1.0]
    moduli = [tissue.youngs_modulus, *(ply.youngs_modulus for ply in tissue.deeper)]
    z = np.concatenate([np.linspace(a, b, rows + 1)[:-1] for a, b in pairwise(cuts)] + [[1.0]])
    stiffness = np.zeros((2 * len(z), 2 * len(z)))
    for n, h in enumerate(np.diff(z)):
        mu = moduli[n // rows] / moduli[0] / (2 * 1.45)
        lam = mu * 2 * 0.45 / 0.1
        hook = np.array([[lam + 2 * mu, lam, 0], [lam, lam + 2 * mu, 0], [0, 0, mu]])
        for at in (0.5 - 3**-0.5 / 2, 0.5 + 3**-0.5 / 2):
            strain = np.array([[k * (1 - at), 0, k * at, 0], [0, -1 / h, 0, 1 / h],
                               [-1 / h, -k * (1 - at), 1 / h, -k * at]])  # fmt: skip
            stiffness[2 * n : 2 * n + 4, 2 * n : 2 * n + 4] += h / 2 * strain.T @ hook @ strain
    if tissue.skin:
        stiffness[0, 0] += tissue.kappa(thickness) / (1 - tissue.skin.poisson_ratio**2) * k * k
        stiffness[1, 1] += tissue.pull(thickness) * k * k
    load = np.zeros(2 * len(z) - 2)
    load[1] = 1
    return np.linalg.solve(stiffness[:-2, :-2], load)[1::-1]


@pytest.mark.parametrize("skin", [None, SKIN])
@pytest.mark.parametrize("k", [0.5, 2.0, 8.0])
def test_finite_elements_through_the_depth_come_to_the_closed_form_with_the_square_of_their_size(k, skin):
    stack = Tissue(3e3, 0.45, skin=skin, deeper=(Ply(8e-3, 1.5e4, 0.45), Ply(2e-2, 1e3, 0.45)))
    exact = np.ravel(compliance(stack, 0.04, k))
    off = [np.abs(through_the_depth(stack, 0.04, k, rows) - exact).max() / exact[0] for rows in (30, 60)]
    assert off[1] < 5e-3 and off[0] / off[1] == pytest.approx(4, rel=0.1)


def test_a_material_below_the_base_is_not_there():
    assert np.array_equal(compliance(LIMB, 8e-3, K).sinking, compliance(Tissue(3e3, 0.45, skin=SKIN), 8e-3, K).sinking)


def test_short_waves_see_a_half_space_of_the_first_material():
    bare = Tissue(3e3, 0.45, deeper=LIMB.deeper)
    found = compliance(bare, 0.04, [200.0, 400.0])
    np.testing.assert_allclose(found.sinking, 2 * (1 - 0.45**2) / np.array([200.0, 400.0]), rtol=1e-12)


def test_a_wide_load_sinks_by_the_sum_of_thickness_over_confined_modulus():
    bare = Tissue(3e3, 0.45, deeper=(Ply(1e-2, 1e4, 0.4), Ply(3e-2, 2e4, 0.3)))
    columns = [(1e-2, bare), (2e-2, Tissue(1e4, 0.4)), (1e-2, Tissue(2e4, 0.3))]
    sinks = sum(t / one.confined_modulus for t, one in columns)  # [m/Pa]
    assert compliance(bare, 0.04, 1e-4).sinking[0] * 0.04 / 3e3 == pytest.approx(sinks, rel=1e-6)


def test_tension_alone_raises_the_normal_stiffness_by_tension_times_k_squared():
    taut = Tissue(3e3, 0.45, skin=Membrane(100.0, 1e-9, 20.0))  # 1e-7 N/m of its own
    slack, tight = compliance(Tissue(3e3, 0.45), 0.02, K), compliance(taut, 0.02, K)
    ratio = tight.along / tight.sinking  # motion along goes with the sinking: only the normal stiffness has changed
    np.testing.assert_allclose(ratio, slack.along / slack.sinking, atol=1e-6)
    np.testing.assert_allclose(1 / tight.sinking - 1 / slack.sinking, taut.pull(0.02) * K**2, rtol=1e-6)


def test_a_skin_that_vanishes_leaves_the_bare_stack():
    bare, k = compliance(Tissue(3e3, 0.45), 0.02, K), np.array([])
    for stiffness in (1e-2, 1e-4):
        skin = Membrane(stiffness / 1e-7, 1e-7)  # so thin that its modulus is one that is accepted
        k = np.append(k, np.abs(compliance(Tissue(3e3, 0.45, skin=skin), 0.02, K).sinking / bare.sinking - 1).max())
    assert k[1] < 1e-4 and k[1] / k[0] == pytest.approx(0.01, rel=0.2)  # linear in kappa


def test_a_thin_stiff_material_on_top_comes_to_be_a_membrane_in_proportion_to_its_thickness():
    k, t, off = np.geomspace(0.1, 3, 20), 0.02, []
    for h in (1e-4, 5e-5):
        sheet = Membrane(30.0 / h, h, 0.0, 0.45)
        solid = Tissue(sheet.youngs_modulus, 0.45, deeper=(Ply(h, 3e3, 0.45),))
        on_top = compliance(solid, t + h, k * (t + h) / t).sinking * (t + h) / sheet.youngs_modulus
        as_sheet = compliance(Tissue(3e3, 0.45, skin=sheet), t, k).sinking * t / 3e3
        off.append(np.abs(on_top / as_sheet - 1).max())
    assert off[0] < 0.01 and off[0] / off[1] == pytest.approx(2, rel=0.2)


def test_a_skin_holds_motion_along_and_sinking_back():
    bare, held = compliance(Tissue(3e3, 0.45), 0.02, K), compliance(Tissue(3e3, 0.45, skin=SKIN), 0.02, K)
    assert (held.sinking < bare.sinking).all() and (np.abs(held.along) <= np.abs(bare.along)).all()


def test_long_waves_push_aside_and_short_waves_of_a_compressible_material_draw_in():
    along = compliance(Tissue(1e3, 0.45), 0.02, [0.5, 50.0]).along
    assert along[0] > 0 > along[1]


def test_nearly_incompressible_stacks_stay_finite_and_positive():
    stack = Tissue(3e3, 0.499, skin=SKIN, deeper=(Ply(5e-3, 3e4, 0.499), Ply(1e-2, 1e6, 0.499)))
    found = compliance(stack, 0.05, np.geomspace(1e-3, 1e5, 500))
    assert np.isfinite(found.sinking).all() and (found.sinking > 0).all() and np.isfinite(found.along).all()


@pytest.mark.parametrize("tissue", [Tissue(3e3, 0.45), Tissue(3e3, 0.45, skin=SKIN)])
def test_one_material_is_its_own_nearest_layer(tissue):
    found = effective(tissue, 0.02)
    assert found.youngs_modulus == pytest.approx(3e3, rel=1e-4) and found.thickness == pytest.approx(0.02, rel=1e-4)
    assert max(found.misfit) < 1e-6
    assert (found.kappa, found.pull) == pytest.approx((tissue.kappa(0.02), tissue.pull(0.02)), rel=1e-3)


def test_the_nearest_layer_of_a_stack_lies_between_its_materials():
    found = effective(LIMB, 0.04)
    assert 3e3 < found.youngs_modulus < 1e4 and 0.01 < found.thickness < 0.04
    assert max(found.misfit) < 0.1 < min(found.bare)


def test_how_much_stiffer_a_column_is_below_is_none_of_one_material_and_fades_as_the_second_leaves_it():
    columns = np.array([0.02, 0.03])
    assert not stiffening(Tissue(3e3, 0.45, skin=SKIN), columns).any()
    assert not stiffening(Tissue(3e3, 0.45, deeper=(Ply(5e-3, 3e3), Ply(3e-2, 9e3))), columns).any()
    far, near = stiffening(Tissue(3e3, 0.45, deeper=(Ply(1e-2, 9e3),)), [0.02, 0.01 + 1e-9])
    assert far == pytest.approx([0.5 * np.log(3), 0.25 * np.log(3)])  # z from 1/2 to 1: its share, and that by 2 z - 1
    assert near == pytest.approx([0, 0], abs=1e-6)


def test_what_is_nearly_bone_counts_as_the_stiffest_that_was_learnt():
    found = [stiffening(Tissue(2e3, 0.45, deeper=(Ply(4e-3, modulus),)), [0.02]) for modulus in (1e5, 2e6, 1e3, 1e2)]
    assert (found[0] == found[1]).all() and (found[2] == found[3]).all() and found[0][0, 0] > 3 > 0 > found[2][0, 0]


def test_how_much_stiffer_a_column_is_below_is_the_mean_of_its_depths():
    stack, t = Tissue(2e3, 0.45, deeper=(Ply(4e-3, 1e3), Ply(1.1e-2, 3e4))), 0.025
    z = (np.arange(100_000) + 0.5) / 100_000
    more = np.log(np.select([z * t < 4e-3, z * t < 1.1e-2], [1.0, 0.5], 15.0))
    assert stiffening(stack, [t])[0] == pytest.approx([more.mean(), (more * (2 * z - 1)).mean()], abs=1e-4)


def test_a_ball_on_deep_tissue_is_held_as_hertz_says():
    hertz = 4 / 3 * 3e3 / (1 - 0.45**2) * np.sqrt(0.01) * 1e-3**1.5
    assert ball_force(Tissue(3e3, 0.45), 5.0, 0.01, 1e-3) == pytest.approx(hertz, rel=1e-4)


def test_a_ball_on_a_thin_layer_is_held_by_columns():
    thin = Tissue(3e3, 0.3)
    columns = np.pi * 0.1 * thin.confined_modulus * 1e-4**2 / 2e-3
    assert ball_force(thin, 2e-3, 0.1, 1e-4) == pytest.approx(columns, rel=0.02)


def test_a_force_puts_a_ball_as_deep_as_that_depth_asks_for_force():
    by_depth = ball(LIMB, 0.04, 0.02, depth=3e-3)
    by_force = ball(LIMB, 0.04, 0.02, force=by_depth.force)
    assert by_force.depth == pytest.approx(3e-3, rel=1e-4)
    k = np.array([1e-3, 1.0])  # long waves see the whole force
    assert 2 * np.pi * by_depth.spectrum(k)[0] == pytest.approx(by_depth.force, rel=1e-6)


def test_skin_and_its_tension_each_make_a_ball_harder_to_press():
    slack, bare = Membrane(2e5, 1.5e-3), Tissue(3e3, 0.45, deeper=LIMB.deeper)
    for depth in (1e-3, 5e-3, 1.2e-2):
        loose = ball_force(Tissue(3e3, 0.45, skin=slack, deeper=LIMB.deeper), 0.04, 0.04, depth)
        assert ball_force(bare, 0.04, 0.04, depth) < loose < ball_force(LIMB, 0.04, 0.04, depth)


@pytest.mark.parametrize(
    "make, says",
    [
        (lambda: compliance(LIMB, 0.0, 1.0), "thickness is 0 m"),
        (lambda: compliance(LIMB, 0.04, [1.0, 0.0]), "wave number is 0"),
        (lambda: effective(LIMB, 0.04, (0.0,)), "radii are .0.0. m"),
        (lambda: ball_force(LIMB, 0.04, 0.01, 0.0), "depth 0 m"),
        (lambda: ball(LIMB, 0.04, 0.01), "one of them"),
        (lambda: ball(LIMB, 0.04, 0.01, force=-1.0), "force -1 N"),
        (lambda: ball(LIMB, 0.04, 0.01, depth="1"), "depth is '1'"),
        (lambda: ball(LIMB, 0.04, None, depth=1e-3), "radius is None"),
        (lambda: effective(LIMB, "0.04"), "thickness is '0.04'"),
        (lambda: effective(LIMB, 0.04, "a"), "radii is not an array of numbers"),
        (lambda: compliance(LIMB, "0.04", 1.0), "thickness is '0.04'"),
        (lambda: along(LIMB, 0.0, 1.0), "thickness is 0 m"),
        (lambda: along(LIMB, 0.04, ["a"]), "wave numbers is not an array of numbers"),
    ],
)
def test_numbers_that_cannot_be_are_refused_with_what_is_wrong(make, says):
    with pytest.raises(InvalidInput, match=says):
        make()
