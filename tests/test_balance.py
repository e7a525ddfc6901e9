"""Laws of the balance of energy of several tools that share the skin."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stmpl_core import Contact, Simulator, State, Tissue, Tool, Touch
from stmpl_core.balance import KEPT, settled
from stmpl_core.methods import MomentNet
from tests.scenes import LENGTH, RADIUS, at, ball, capsule, limb, plate, turn
from tests.test_layered_strokes import works as works_of

LYING = turn((0, 1, 0), np.pi / 2)  # a capsule's axis along x
energies = st.lists(st.tuples(*[st.floats(-1, 1)] * 2, st.floats(0, 0.1), st.floats(0, 1)), min_size=1, max_size=4)


def led(
    simulator: Simulator, tools: list[Tool], poses: list[list[np.ndarray]], state: State | None
) -> list[list[Touch]]:
    """Touches of each tool along its poses; without a state each step is the first."""
    out: list[list[Touch]] = [[] for _ in tools]
    for places in zip(*poses, strict=True):
        contacts = [Contact(tool, pose) for tool, pose in zip(tools, places, strict=True)]
        if state is None:
            touches = simulator.touch(contacts)
        else:
            touches, state = simulator.touch(contacts, state, 0.02)
        for one, touch in zip(out, touches, strict=True):
            one.append(touch)
    return out


@pytest.mark.parametrize("friction", [None, 0.5])
@pytest.mark.parametrize(
    ("first", "second", "height", "depths"),
    [(ball(0.06, 4).named("first"), capsule(0.048, 0.006).named("second"), 0.06, (2e-3, 2.5e-3)),
     (capsule(0.048, 0.006).named("first"), capsule(0.048, 0.006).named("second"), 0.006, (2e-3, 2e-3))],
    ids=["under a large ball", "crossing"],
)  # fmt: skip
def test_what_one_tool_puts_in_another_may_take_out(first, second, height, depths, friction):
    """The one pressed, the other pressed over it, the one lifted, the other lifted: nothing is lost but by the law."""
    skin, there, apart = plate(0.08).with_(tissue=Tissue(2e4, 0.4)), np.linspace(0, 1, 30), 5e-4
    down = [np.concatenate([there, np.ones(30), 1 - there, np.zeros(30)]),
            np.concatenate([np.zeros(30), there, np.ones(30), 1 - there])]  # fmt: skip
    heights = [height + apart - (apart + depths[0]) * down[0], 0.006 + apart - (apart + depths[1]) * down[1]]
    first_lies = LYING if height == 0.006 else np.eye(4)
    poses = [[at(0, 0, z) @ first_lies for z in heights[0]],
             [at(3e-4, 2e-4, z) @ turn((0, 0, 1), np.pi / 2) @ LYING for z in heights[1]]]  # fmt: skip
    simulator = Simulator(skin, MomentNet(), friction=friction)
    remembered = led(simulator, [first, second], poses, State())
    works, once = (np.array([works_of(path) for path in paths])
                   for paths in (remembered, led(simulator, [first, second], poses, None)))  # fmt: skip
    put = works[works > 0].sum()
    assert min(touch.passive for path in remembered for touch in path) == 1
    assert -0.005 * put < works.sum() and abs(works.sum() - once.sum()) < 0.01 * put


def test_what_a_tool_took_from_another_the_other_does_not_have():
    """A large ball that turns gives more than it got, by itself; beside a capsule it took that from the capsule."""
    skin = limb(4e-3, 7.5e-3).with_(tissue=Tissue(2e4, 0.4))
    simulator = Simulator(skin, MomentNet(), friction=1e-3)
    k = np.linspace(0, 1, 181)
    share = np.clip(2 * np.sin(np.pi * k) ** 2, 0, 1)
    large = [at(RADIUS + 0.09 + 1e-3 - 2e-3 * s, 0.004 * np.sin(2 * np.pi * p), LENGTH / 2 - 0.01)
             @ turn((0.3, 0.5, 0.8), 1.5 * np.sin(2 * np.pi * p)) for s, p in zip(share, k, strict=True)]  # fmt: skip
    late = np.clip(2 * np.sin(np.pi * np.clip(2 * k - 0.8, 0, 1)) ** 2, 0, 1)
    other = [at(RADIUS + 0.008 + 1e-3 - 3.5e-3 * s, 0.0, LENGTH / 2 + 0.012) for s in late]
    tools = [ball(0.09, 4).named("large"), capsule(0.03, 0.008).named("other")]
    works = np.array([works_of(path) for path in led(simulator, tools, [large, other], State())])
    assert works.sum() > -0.005 * works[works > 0].sum()


@given(energies)
def test_no_balance_ends_with_more_than_there_was(parts):
    works, givens, spares, stored = np.array(parts).T.copy()
    stored[stored < 0.2], whole, before = 0.0, 1.2 * stored, works.copy()
    factors = settled(works, givens, spares, stored, whole)
    assert ((factors > 0) & (factors <= 1)).all()
    there = before - (1 - factors) * givens
    assert works.sum() <= max(there.sum(), 0.0 if (stored == 0).any() else there.sum()) + 1e-12
    assert works[stored > 0].sum() <= KEPT * whole.sum() + np.maximum(there, 0)[stored == 0].sum() + 1e-12
    if works.min() < 0:
        assert works.max() <= 0, "a debt is paid as far as anybody can"
