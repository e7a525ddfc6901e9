"""Laws of a tissue: what its numbers are, what cannot be, and that nobody ignores a part of it in silence."""

from dataclasses import replace

import pytest

from stmpl_core import Membrane, Ply, Prony, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.layer import layer_id
from stmpl_core.methods import Linear, Naive, Winkler
from studies.tets import TetFem
from tests.scenes import plate

SKIN = Membrane(2e5, 1.5e-3, 20.0)
MUSCLE = Ply(10e-3, 15e3)


def test_kappa_and_pull_are_the_skin_s_numbers_over_those_of_the_material_under_it():
    tissue = Tissue(3e3, skin=SKIN)
    assert tissue.kappa(0.025) == pytest.approx(2e5 * 1.5e-3 / (3e3 * 0.025))
    assert tissue.pull(0.025) == pytest.approx(20 / (3e3 * 0.025))
    assert Tissue().single and Tissue().kappa(0.01) == Tissue().pull(0.01) == 0


@pytest.mark.parametrize(
    "make, says",
    [
        (lambda: Membrane(200.0, 1.5), "1.5 m thick.*millimetres"),
        (lambda: Membrane(2e5, 1e-3, -1.0), "tension is -1 N/m"),
        (lambda: Membrane(20.0, 1e-3), "kilopascals"),
        (lambda: Ply(0.0, 1e4), "begins 0 m deep"),
        (lambda: Ply(6, 12e3), "Is it in millimetres"),
        (lambda: Tissue(deeper=(Ply(2e-2, 1e4), Ply(1e-2, 1e4))), "each must begin below"),
        (lambda: Tissue("soft"), "youngs_modulus is 'soft'; a number is needed"),
        (lambda: Tissue(poisson_ratio=None), "poisson_ratio is None; a finite number"),
        (lambda: Tissue(density="heavy"), "density is 'heavy'"),
        (lambda: Tissue(skin=2e-3), "skin is 0.002; Membrane or None is needed"),
        (lambda: Tissue(deeper=MUSCLE), r"deeper is Ply\(.*tuple or list is needed"),
        (lambda: Tissue(deeper=(15e3,)), "a deeper material is 15000.0; Ply is needed"),
        (lambda: Tissue(relaxation=0.3), "relaxation is 0.3; Prony or None is needed"),
        (lambda: Membrane(2e5, "thin"), "the skin's thickness is 'thin'"),
        (lambda: Ply(None, 1e4), "the depth of a material is None"),
        (lambda: Ply(1e-2, 1e4, relaxation=0.3), "the relaxation of a material is 0.3; Prony or None"),
        (lambda: Prony(0.3, 1.0), "shares of a Prony series are 0.3; numbers are needed"),
        (lambda: Prony((0.3,), ("soon",)), "times of a Prony series are .*'soon'"),
        (lambda: plate().with_(tissue="soft"), "tissue is 'soft'; Tissue is needed"),
    ],
)
def test_numbers_that_cannot_be_are_refused_with_what_is_wrong(make, says):
    with pytest.raises(InvalidInput, match=says):
        make()


def test_a_skin_a_deeper_material_and_a_stress_that_fades_give_a_layer_another_name():
    layer = plate()
    fading = layer.with_(tissue=replace(layer.tissue, relaxation=Prony((0.3,), (1.0,))))
    names = {layer_id(one) for one in (layer, fading, layer.with_(skin=SKIN), layer.with_(deeper=(MUSCLE,)))}
    assert len(names) == 4


@pytest.mark.parametrize("method", [Naive, Winkler, Linear, TetFem])
@pytest.mark.parametrize("more", [{"skin": SKIN}, {"deeper": (MUSCLE,)}])
def test_who_knows_one_material_refuses_a_stack(method, more):
    with pytest.raises(InvalidInput, match="knows one soft material"):
        method().prepare(plate().with_(**more))
