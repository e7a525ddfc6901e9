"""What is given in the wrong kind (text for a number, nothing for a layer) is told in one sentence, at the door."""

import numpy as np
import pytest

from stmpl_core import Contact, Simulator, SoftLayer
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput
from stmpl_core.gradients import Gradients
from stmpl_core.living import held_skin, laid, living
from stmpl_core.methods import Winkler
from stmpl_core.sdf import SignedDistance
from stmpl_core.skin import Skin
from stmpl_core.tissue import Tissue
from tests.scenes import plate

ODD = (None, "x", -1, float("nan"), [], object(), {"a": 1}, 3.7, True, (1, 2))
LAYER = plate(0.09)
SIMULATOR = Simulator(LAYER, Winkler())


def body() -> Body:
    return Body.anny()


@pytest.mark.parametrize(
    "make",
    [
        lambda x: Contact(x, np.eye(4)),
        lambda x: Simulator(x, Winkler()),
        lambda x: Simulator(LAYER, x),
        lambda x: SIMULATOR.step(x or [3]),
        lambda x: SIMULATOR.answer(x or [3]),
        lambda x: Skin.of(x, Winkler()),
        lambda x: Skin.of(LAYER, x),
        lambda x: SoftLayer(LAYER.vertices, LAYER.faces, 0.01, tissue=x or "x"),
        lambda x: SignedDistance.of(x),
        lambda x: Gradients(x),
        lambda x: Gradients(SIMULATOR).wrench(x or [3]),
        lambda x: living(x, "left_forearm"),
        lambda x: living(body(), x),
        lambda x: living(body(), "left_forearm", edge_length=x),
        lambda x: laid(x, "left_forearm", Tissue(), 0.01),
        lambda x: held_skin(x),
        lambda x: body().part(x),
        lambda x: Body.anny(weight=x),
    ],
)
def test_every_kind_that_is_none_of_these_is_one_sentence(make) -> None:
    for odd in ODD:
        with pytest.raises(InvalidInput, match=r"needed|needs|must|allowed|Available"):
            make(odd)
