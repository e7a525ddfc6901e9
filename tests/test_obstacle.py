"""Laws of the linear contact problem: what holds a tool off a bonded layer, and where."""

from typing import NamedTuple

import numpy as np
import pytest

from stmpl_core import Tissue
from stmpl_core.obstacle import moments_of, pairs, powers_of, response, rings_of, solve

NU = 0.4


class Linear(NamedTuple):
    """Forces over areas, what nodes see, and the power of the depth."""

    pressure: np.ndarray
    moments: np.ndarray
    vectors: np.ndarray
    power: float


def lattice(spacing: float, radius: float) -> np.ndarray:
    """A lattice of triangles in a disc, (N, 3)."""
    n = int(radius / spacing) + 2
    x, y = np.meshgrid(np.arange(-n, n + 1.0), np.arange(-n, n + 1.0))
    points = spacing * np.column_stack([(x + 0.5 * (y % 2)).ravel(), 0.5 * np.sqrt(3) * y.ravel(), 0 * x.ravel()])
    return points[np.linalg.norm(points, axis=1) < radius]


def solved(points: np.ndarray, spacing: float, strain: np.ndarray, nu: float = NU, group: np.ndarray | None = None,
           thickness: float = 1.0) -> Linear:  # fmt: skip
    n = len(points)
    area = np.full(n, 0.5 * np.sqrt(3) * spacing**2)
    group = np.zeros(n, np.int64) if group is None else group
    inward, table, thick = np.tile([0.0, 0.0, -1.0], (n, 1)), response(nu), np.full(n, thickness)
    matrix, rings = pairs(points, inward, thick, area, group, thickness, *table)
    force, missed = solve(matrix, strain)
    assert missed < 1e-4
    pressure = force * thickness**2 / area
    moments, vectors = (one[0] for one in moments_of(rings, points, thick, area, pressure[None], strain[None]))
    powers = powers_of(matrix, force, strain, np.zeros(len(force), np.int64), 1)
    return Linear(pressure, moments, vectors, float(powers[0]))


@pytest.mark.parametrize("nu", [0.3, 0.4, 0.45])
def test_a_light_ball_presses_as_hertz_says(nu: float) -> None:
    """A layer is a half-space to a contact that is small beside it: F = 4/3 E / (1 - nu^2) sqrt(R) d^1.5."""
    radius, depth = 1.0, 4e-4
    spacing = np.sqrt(radius * depth) / 6
    points = lattice(spacing, 1.5 * np.sqrt(radius * depth))
    strain = depth - (points**2).sum(axis=1) / (2 * radius)
    force = 0.5 * np.sqrt(3) * spacing**2 * solved(points, spacing, strain, nu).pressure.sum()
    assert force == pytest.approx(4 / 3 / (1 - nu**2) * np.sqrt(radius) * depth**1.5, rel=0.05)


def test_it_says_how_far_what_has_no_solution_is_missed() -> None:
    """Two nodes that sink each other more than themselves, and a third whose skin rises under force."""
    matrix = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    assert solve(matrix, np.array([1.0, 0.9, 0.5]))[1] > 0.02
    assert solve(np.eye(3), np.array([1.0, 0.9, -0.5]))[1] < 1e-6


def test_a_wide_flat_tool_presses_in_its_middle_as_a_confined_column() -> None:
    points = lattice(0.3, 7.0)
    pressure = solved(points, 0.3, np.full(len(points), 0.01)).pressure
    middle = np.linalg.norm(points, axis=1) < 3
    tissue = Tissue(1e3, NU)
    expected = 0.01 * tissue.confined_modulus / tissue.youngs_modulus
    np.testing.assert_allclose(pressure[middle], expected, rtol=0.03)


def test_pressure_is_never_below_zero_and_the_skin_is_never_inside_the_tool() -> None:
    """Where it presses the skin lies on the tool: more nodes beyond the contact change nothing."""
    points = lattice(0.05, 0.8)
    strain = 0.05 - (points**2).sum(axis=1) / 2
    found = solved(points, 0.05, strain).pressure
    presses = found > 0
    assert (found >= 0).all() and 20 < presses.sum() < (strain > 0).sum()
    some = solved(points[presses], 0.05, strain[presses]).pressure
    np.testing.assert_allclose(some, found[presses], rtol=1e-3, atol=1e-4 * found.max())


def test_it_is_linear_while_the_contact_stays_and_grows_with_depth() -> None:
    points = lattice(0.1, 0.8)
    flat = np.full(len(points), 0.02)
    one, two = (solved(points, 0.1, k * flat).pressure for k in (1, 2))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-4)
    forces = [solved(points, 0.1, d - (points**2).sum(axis=1) / 2).pressure.sum() for d in np.linspace(0.01, 0.3, 12)]
    assert (np.diff(forces) > 0).all()


def test_nodes_of_other_groups_are_not_felt() -> None:
    left = lattice(0.1, 0.5)
    both = np.concatenate([left, left + [1.2, 0, 0]])
    strain, group = np.full(len(both), 0.02), np.repeat([0, 1], len(left))
    apart, near = solved(both, 0.1, strain, group=group), solved(both, 0.1, strain)
    alone = solved(left, 0.1, strain[: len(left)]).pressure
    np.testing.assert_allclose(apart.pressure[: len(left)], alone, rtol=1e-4)
    assert np.abs(near.pressure[: len(left)] - alone).max() > 0.01 * alone.max()


def test_the_same_at_any_scale() -> None:
    points = lattice(0.1, 0.8)
    strain = 0.05 - (points**2).sum(axis=1) / 2
    here, there = solved(points, 0.1, strain), solved(7e-3 * points, 7e-4, strain, thickness=7e-3)
    np.testing.assert_allclose(there.pressure, here.pressure, rtol=1e-5)
    np.testing.assert_allclose(there.moments, here.moments, rtol=1e-4)


def test_rings_alone_are_those_of_the_whole_response() -> None:
    points, table = lattice(0.2, 3.0), response(NU)
    n = len(points)
    inward, group = np.tile([0.0, 0.0, -1.0], (n, 1)), np.arange(n) % 2
    _, rings = pairs(points, inward, np.full(n, 0.7), np.full(n, 0.03), group, 0.7, *table)
    alone = rings_of(points, inward, 0.7, group, table.rows)
    np.testing.assert_allclose(alone, rings, rtol=1e-5, atol=1e-6 * rings.max())
    assert rings.any()
