"""A small data set for tests of what learns from one: two arms and a calf, made once a session."""

from pathlib import Path

import pytest

from fem_tools.generate import generate
from fem_tools.sampling import OTHER_LIMBS, PAPER_BODIES, PRESETS

SMALL = PRESETS["tiny"].model_copy(
    update=dict.fromkeys(["ellipses", "seams", "fields", "indenters", "hands", "bands"], 0)
    | {"preset": "small", "bodies": (*PAPER_BODIES[1:3], OTHER_LIMBS[0]), "discs": 8, "letters": 2, "loads": 2}
)


def small_data(factory: pytest.TempPathFactory) -> Path:
    """The folder of the data set; whoever asks first makes it."""
    out = factory.getbasetemp() / "small"
    generate(SMALL, out, workers=2)
    return out
