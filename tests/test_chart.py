"""Laws of charts: texels and vertices agree both ways, on both sides of a seam."""

import numpy as np
import pytest

from stmpl_core.chart import UvChart
from stmpl_core.errors import InvalidInput, MeshError
from tests.test_remesh import LENGTH, RADIUS, tube


@pytest.fixture(scope="module")
def chart() -> UvChart:
    """A cylinder of 251 x 200 mm, unrolled, 3 mm edges; UVs keep its proportions."""
    vertices, faces, uv = tube(84, 66)
    return UvChart(vertices, faces, uv * [1, LENGTH / (2 * np.pi * RADIUS)], resolution=512)


def per_vertex(chart: UvChart, corner_values: np.ndarray) -> np.ndarray:
    result = np.empty((len(chart.vertices), corner_values.shape[-1]))
    result[chart.faces] = corner_values
    return result


def test_linear_functions_of_the_skin_survive_the_round_trip(chart: UvChart) -> None:
    height = chart.vertices[:, 2:]  # linear in uv, and the same on both sides of the seam
    assert np.abs(chart.to_vertices(chart.to_texels(height)) - height).max() < 1e-6 * LENGTH


def test_a_linear_function_of_uv_is_exact_at_texels_and_away_from_the_seam(chart: UvChart) -> None:
    value = per_vertex(chart, chart.uv @ np.array([[2.0], [-3.0]]))
    inside = np.ones(len(chart.vertices), bool)
    inside[np.unique(chart.faces[np.isin(chart.faces, chart.seam_vertices).any(axis=1)])] = False
    back = chart.to_vertices(chart.to_texels(value))
    assert np.abs(back - value)[inside].max() < 1e-5
    row, column = np.nonzero(chart.mask)
    u = chart.origin[0] + (column + 0.5) * chart.texel
    away = (u > 0.05) & (u < 0.95)
    wanted = 2 * u - 3 * (chart.origin[1] - (row + 0.5) * chart.texel)
    assert np.abs(chart.to_texels(value)[row, column, 0] - wanted)[away].max() < 1e-5


def test_smooth_functions_survive_nearly_and_both_sides_of_a_seam_agree(chart: UvChart) -> None:
    x, y, z = chart.vertices.T / RADIUS
    value = np.column_stack([x * y, np.sin(2 * x) + z, np.cos(y * z)])
    image = chart.to_texels(value)
    assert np.abs(chart.to_vertices(image) - value).max() < 0.01
    assert len(chart.seam_vertices) == 67
    assert chart.seam_gap(image).max() < 0.01


def test_a_jump_across_the_seam_is_measured_and_averaged(chart: UvChart) -> None:
    _, width = chart.shape
    image = np.zeros((*chart.shape, 2))
    image[:, : width // 2] = [3.0, 4.0]
    assert chart.seam_gap(image) == pytest.approx(np.full(67, 5.0))
    assert chart.to_vertices(image)[chart.seam_vertices] == pytest.approx(np.full((67, 2), [1.5, 2.0]))


def test_constants_stay_constants_at_every_vertex(chart: UvChart) -> None:
    ones = np.ones((len(chart.vertices), 1))
    image = chart.to_texels(ones)
    assert image[chart.mask] == pytest.approx(1.0, abs=1e-5)
    assert chart.to_vertices(image) == pytest.approx(ones, abs=1e-5)


def test_the_image_is_the_island_and_lies_the_right_way_up(chart: UvChart) -> None:
    height, width = chart.shape
    assert max(height, width) == 512 and height % 16 == 0 and width % 16 == 0
    assert chart.mask.mean() > 0.9
    image = chart.to_texels(chart.vertices[:, 2])
    assert image[10:20].mean() > 0.8 * LENGTH > 0.2 * LENGTH > image[-20:-10].mean()
    assert chart.at(512, (0.0, 0.0, 1.0, 1.0)).shape == (512, 512)


def test_texels_know_their_size_on_the_skin(chart: UvChart) -> None:
    exact = 2 * np.pi * RADIUS * chart.texel * 1e3
    assert chart.mm_per_texel == pytest.approx((exact,) * 3, rel=2e-3)
    assert chart.stretch * 1e3 == pytest.approx(np.full((len(chart.faces), 2), exact), rel=2e-3)
    area = chart.texel_area.mean() * chart.mask.sum()
    assert area == pytest.approx(2 * np.pi * RADIUS * LENGTH, rel=0.01)


def test_a_stretched_map_says_by_how_much() -> None:
    vertices, faces, uv = tube(84, 66)
    stretched = UvChart(vertices, faces, uv * [1, 2 * LENGTH / (2 * np.pi * RADIUS)])
    assert stretched.stretch[:, 0] / stretched.stretch[:, 1] == pytest.approx(np.full(len(faces), 2), rel=2e-3)


def test_single_precision_in_is_single_precision_out(chart: UvChart) -> None:
    image = chart.to_texels(chart.vertices.astype(np.float32))
    assert image.dtype == np.float32 and chart.to_vertices(image).dtype == np.float32


def test_what_is_no_chart_is_refused(chart: UvChart) -> None:
    vertices, faces, uv = tube()
    with pytest.raises(MeshError, match="no area in UV"):
        UvChart(vertices, faces, np.zeros_like(uv))
    twice = np.concatenate([uv[: len(uv) // 2]] * 2)
    with pytest.raises(MeshError, match="UVs overlap"):
        UvChart(vertices, faces, twice).to_texels(vertices)
    with pytest.raises(InvalidInput, match="outside the bounds"):
        UvChart(vertices, faces, uv, bounds=(0.0, 0.0, 0.5, 0.5))
    with pytest.raises(InvalidInput, match="values have shape"):
        chart.to_texels(np.zeros((3, 3)))
    with pytest.raises(InvalidInput, match="image has shape"):
        chart.to_vertices(np.zeros((8, 8, 3)))
    with pytest.raises(InvalidInput, match="not finite"):
        UvChart(vertices, faces, np.full_like(uv, np.nan))
