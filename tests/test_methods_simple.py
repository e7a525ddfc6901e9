"""Winkler and Naive: laws of the column, and of the baseline."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from stmpl_core import Load, Tissue
from stmpl_core.errors import InvalidInput, NotPrepared
from stmpl_core.methods import Naive, Winkler
from stmpl_core.methods.winkler import column_pressure, column_stretch, least_width
from tests.scenes import limb, plate, turn

SKIN = plate(0.06)
TISSUES = [Tissue(poisson_ratio=nu) for nu in (0.0, 0.3, 0.4, 0.49)]


@pytest.mark.parametrize("tissue", TISSUES)
def test_column_stretch_is_the_root_of_the_energy_derivative(tissue: Tissue) -> None:
    """Independent of the code's own formula: minimise psi(l) + p l, psi with I_C = 2 + l^2 and J = l."""
    mu, lam = tissue.shear_modulus, tissue.lame_lambda
    for ratio in (1e-6, 0.1, 1.0, 5.0, 50.0, 1e4):
        p = ratio * tissue.youngs_modulus
        slope = lambda x, p=p: mu * x - mu / x + lam * np.log(x) / x + p  # noqa: E731
        root = brentq(slope, 1e-9, 1.0, xtol=1e-16, rtol=1e-14)
        assert column_stretch([p], tissue)[0] == pytest.approx(root, rel=1e-11)


def test_work_of_the_pressure_is_the_stored_energy() -> None:
    tissue = Tissue()
    mu, lam = tissue.shear_modulus, tissue.lame_lambda
    end = 0.35
    work, _ = quad(lambda x: column_pressure([x], tissue)[0], end, 1.0, epsabs=1e-10)
    stored = mu / 2 * (end**2 - 1) - mu * np.log(end) + lam / 2 * np.log(end) ** 2
    assert work == pytest.approx(stored, rel=1e-10)


@pytest.mark.parametrize("tissue", TISSUES)
def test_pressure_and_stretch_are_inverse(tissue: Tissue) -> None:
    stretch = np.linspace(0.05, 1.4, 200)
    np.testing.assert_allclose(column_stretch(column_pressure(stretch, tissue), tissue), stretch, rtol=1e-10)


def test_more_pressure_is_more_depth_and_never_all_of_it() -> None:
    stretch = column_stretch(np.linspace(0, 1e5, 2000), Tissue())
    assert stretch[0] == 1.0 and (np.diff(stretch) < 0).all() and stretch[-1] > 0


def test_only_pressure_over_modulus_matters() -> None:
    p = np.linspace(10, 5e3, 50)
    np.testing.assert_allclose(column_stretch(p, Tissue()), column_stretch(37 * p, Tissue(37e3)), rtol=1e-13)


def test_a_light_press_is_linear() -> None:
    tissue = Tissue()
    assert 1 - column_stretch([1e-3], tissue)[0] == pytest.approx(1e-3 / tissue.confined_modulus, rel=1e-5)


def test_winkler_presses_along_the_normal_in_proportion_to_thickness() -> None:
    layer = limb().with_(thickness=np.linspace(2e-3, 9e-3, len(limb().vertices)))
    answer = Winkler().prepare(layer).solve(Load.pressure(np.full(len(layer.vertices), 500.0)))
    depth = (1 - column_stretch([500.0], layer.tissue)[0]) * layer.thickness
    np.testing.assert_allclose(answer.displacement, -depth[:, None] * layer.normals, atol=1e-15)


def test_winkler_takes_nodal_forces_as_the_pressure_that_they_are() -> None:
    p = np.linspace(0, 300, len(SKIN.vertices))
    method = Winkler().prepare(SKIN)
    nodal = Load.nodal(p * SKIN.vertex_areas)
    by_force, by_pressure = method.solve(nodal), method.solve(Load.pressure(p))
    np.testing.assert_allclose(by_force.displacement, by_pressure.displacement, atol=1e-15)


@pytest.mark.parametrize("method", [Winkler(), Naive()])
def test_zero_load_moves_nothing(method: Winkler | Naive) -> None:
    assert not method.prepare(SKIN).solve(Load.zero(SKIN)).displacement.any()


@pytest.mark.parametrize("method", [Winkler(), Naive()])
def test_a_method_without_a_layer_or_with_another_load_says_so(method: Winkler | Naive) -> None:
    with pytest.raises(NotPrepared, match="prepare"):
        type(method)().solve(Load.zero(SKIN))
    with pytest.raises(InvalidInput, match="3 values"):
        method.prepare(SKIN).solve(Load.pressure([1.0, 2.0, 3.0]))
    with pytest.raises(InvalidInput, match="stretch is 0"):
        column_pressure([0.0], Tissue())


def test_winkler_knows_where_columns_end() -> None:
    method = Winkler().prepare(SKIN)
    everywhere = np.full(len(SKIN.vertices), 100.0)
    spot = everywhere * (np.linalg.norm(SKIN.vertices, axis=1) < 0.01)
    assert not method.solve(Load.pressure(spot)).trust.in_range
    assert "wide" in method.solve(Load.pressure(spot)).trust.why
    thin = Winkler().prepare(SKIN.with_(thickness=2e-3))
    assert thin.solve(Load.pressure(everywhere)).trust.ok
    assert not thin.solve(Load.pressure(100 * everywhere)).trust.in_range
    assert not thin.solve(Load.pressure(-everywhere)).trust.in_range


def test_least_width_is_where_a_linear_layer_leaves_the_columns() -> None:
    """Hankel transform of a bonded linear layer under p0 (1 - r^2/a^2), against the expansion that the code uses."""
    from scipy.special import jv

    for nu in (0.35, 0.4, 0.45):
        a = least_width(nu) / 2  # in thicknesses
        k = np.linspace(1e-4, 300 / a, 200_001)
        x = np.minimum(k, 300.0)
        below = (3 - 4 * nu) * np.cosh(2 * x) + 2 * x**2 + 5 - 12 * nu + 8 * nu**2
        layer = ((3 - 4 * nu) * np.sinh(2 * x) - 2 * x) / below
        depth = np.trapezoid(2 * jv(2, k * a) / k**2 * 2 * (1 - nu**2) / k * layer * k, k)
        column = (1 + nu) * (1 - 2 * nu) / (1 - nu)
        assert depth / column - 1 == pytest.approx(0.1, abs=0.035)


def test_naive_learns_the_least_squares_numbers_back() -> None:
    layer = limb(edge=6e-3)
    rng = np.random.default_rng(3)
    alpha = np.array([2.0, 0.5, 1.25])
    samples, inside = [], np.abs(layer.vertices[:, 2] - 0.08) < 0.06  # at its ends the cylinder's facets lean
    for _ in range(3):
        load = Load.nodal(rng.uniform(0, 0.01, len(layer.vertices)) * inside)
        samples.append((layer, load, Naive(alpha).prepare(layer).solve(load).displacement))
    tilted = layer.with_(vertices=layer.vertices @ turn((1, 0, 0), 0.6)[:3, :3].T)
    with pytest.raises(InvalidInput, match="along z"):
        Naive.fit(samples)
    load = samples[0][1]
    samples.append((tilted, load, Naive(alpha).prepare(tilted).solve(load).displacement))
    np.testing.assert_allclose(Naive.fit(samples).alpha, alpha, rtol=1e-12)  # type: ignore[arg-type]


def test_naive_fit_is_a_minimum() -> None:
    layer = plate(0.06).with_(vertices=plate(0.06).vertices @ turn((1, 2, 3), 0.7)[:3, :3].T)
    load = Load.pressure(400 * np.exp(-(np.linalg.norm(layer.vertices, axis=1) / 0.01) ** 2))
    truth = Winkler().prepare(layer).solve(load).displacement
    best = Naive.fit([(layer, load, truth)])

    def loss(alpha: np.ndarray) -> float:
        return float(((Naive(alpha).prepare(layer).solve(load).displacement - truth) ** 2).sum())

    assert best.alpha is not None
    for axis in range(3):
        for step in (-1e-3, 1e-3):
            assert loss(best.alpha * (1 + step * np.eye(3)[axis])) > loss(best.alpha)


def test_naive_by_default_is_a_light_column() -> None:
    load = Load.pressure(np.full(len(SKIN.vertices), 1.0))
    inside = np.abs(SKIN.vertices[:, :2]).max(axis=1) < 0.025
    naive, column = (m.prepare(SKIN).solve(load) for m in (Naive(), Winkler()))
    np.testing.assert_allclose(naive.displacement[inside], column.displacement[inside], rtol=0.12)
    assert not naive.trust.in_range
