"""Laws of the softness of a limb's places: one number that says what the flat stack there answers."""

import numpy as np
import pytest

from stmpl_core.green import Green, bank, tables
from stmpl_core.layer import SoftLayer
from stmpl_core.softness import BANK, Softness
from stmpl_core.stack import compliance
from stmpl_core.tissue import Membrane, Ply, Tissue
from tests.test_remesh import tube

STACK = Tissue(3e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0), deeper=(Ply(6e-3, 15e3, 0.45),))
THICK = 20e-3
NEAR = slice(2, 16)  # rows of the tables, up to 0.05 t
SPREAD = 8  # row of forces spread over 0.08 t


def limb(scale: np.ndarray | None = None, thickness: float | np.ndarray = THICK) -> SoftLayer:
    vertices, faces, _ = tube(30, 24)
    return SoftLayer(vertices, faces, thickness, tissue=STACK, ply_scale=scale)


def round_about() -> np.ndarray:
    vertices, _, _ = tube(30, 24)
    return 1 + 0.45 * np.sin(np.arctan2(vertices[:, 1], vertices[:, 0]))


def at_place(layer: SoftLayer, vertex: int) -> np.ndarray:
    """Tables at a vertex, between those of the bank."""
    softness = Softness.of(layer, THICK)
    banked, soft = bank(STACK, THICK, softness), float(softness.at(layer, THICK)[vertex])
    return banked[int(soft)] + (soft % 1) * (banked[int(soft) + 1] - banked[int(soft)])


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_where_fat_is_thin_or_thick_the_response_is_that_of_the_stack_there(share):
    scale = round_about()
    vertex = int(np.abs(scale - np.quantile(scale, share)).argmin())
    there = tables(Tissue(3e3, 0.45, skin=STACK.skin, deeper=(Ply(6e-3 * scale[vertex], 15e3, 0.45),)), THICK)[0]
    found, median = at_place(limb(scale), vertex), tables(STACK, THICK)[0]
    for kind in (0, 2):  # sinking, and motion along: what presses and what drags
        true = there[kind, SPREAD, NEAR]
        assert np.abs(found[kind, SPREAD, NEAR] / true - 1).max() < 0.02
        assert np.abs(median[kind, SPREAD, NEAR] / true - 1).min() > 0.03


@pytest.mark.parametrize("share", [0.02, 0.3, 0.98])
def test_where_tissue_is_a_quarter_as_thick_as_in_the_middle_and_half_of_it_is_not_fat_it_answers_so_too(share):
    """A shin's inner face, the thin side of a forearm: of two hundredths of the places one softness knew too little."""
    vertices, _, _ = tube(30, 24)
    round_it = np.cos(np.arctan2(vertices[:, 1], vertices[:, 0]))
    thick, scale = THICK * np.exp(0.55 * round_it - 0.75 * (round_it < 0) * round_it**2), 1 + 0.25 * round_it
    layer = limb(scale, thick)
    vertex = int(np.abs(thick - np.quantile(thick, share)).argmin())
    softness, by = Softness.of(layer, THICK), thick[vertex] / THICK
    deeper = (Ply(6e-3 * scale[vertex], 15e3, 0.45),)
    k = np.geomspace(2.5, 12.0, 20)
    true = by * compliance(Tissue(3e3, 0.45, skin=STACK.skin, deeper=deeper), by * THICK, by * k).sinking
    factors, soft = softness.factors(k)[:, 0], float(softness.at(layer, THICK)[vertex])
    found = (1 - soft % 1) * factors[int(soft)] + soft % 1 * factors[int(soft) + 1]
    assert np.abs(found * compliance(STACK, THICK, k).sinking / true - 1).max() < 0.05


def test_tissue_as_thick_everywhere_is_the_median_everywhere():
    green = Green(limb(), None)
    assert not green.soft.any() and len(green.tables) == BANK
    assert all((one == green.tables[0]).all() for one in green.tables)
    np.testing.assert_array_equal(green.tables[0], tables(STACK, THICK)[0])


def test_a_softer_place_has_a_larger_number_and_strange_ones_stay_on_the_scale():
    scale = round_about()
    scale[7] = 40.0
    layer = limb(scale, THICK * np.where(np.arange(len(scale)) == 9, 0.01, 1.0))
    soft = Softness.of(layer, THICK).at(layer, THICK)
    some = np.argsort(scale)[:-1:60]
    assert (np.diff(soft[some]) >= 0).all() and soft[some[-1]] - soft[some[0]] > 2
    assert soft.min() >= 0 and soft.max() < BANK - 1
