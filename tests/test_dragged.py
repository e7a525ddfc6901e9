"""Skin that is dragged along moves on as it did where a tool that slid stops or turns back."""

import numpy as np
import pytest

from stmpl_core import Answer, Contact, Prony, Simulator, State, Tissue, Tool, Touch
from stmpl_core.methods import MomentNet
from stmpl_core.slip import _FORCE, _YIELD, LIMIT, SLID, STIFFNESS
from stmpl_core.tissue import Membrane, Ply
from tests.scenes import at, ball, plate

RADIUS, DEPTH, WAY = 12e-3, 4e-3, 0.01
BALL = ball(RADIUS)
ONE = Tissue(2e4, 0.4)
STACK = Tissue(5e3, 0.45, skin=Membrane(8e4, 1.2e-3, 10.0), deeper=(Ply(6e-3, 2e4, 0.45),))
FADING = Tissue(2e4, 0.4, relaxation=Prony((0.2,), (0.5,)))


class Stroke:
    """A ball that is pressed in and led along skin."""

    def __init__(self, tissue: Tissue, friction: float, tool: Tool = BALL) -> None:
        layer = plate(0.09, 4.5e-3, 12.5e-3, crossed=True).with_(tissue=tissue)
        self.simulator, self.tool, self.state = Simulator(layer, MomentNet(), friction=friction), tool, State()
        self.touches: list[Touch] = []
        for depth in np.linspace(1e-3, DEPTH, 7):
            self.to(0.0, depth)

    def to(self, along: float, depth: float = DEPTH, dt: float = 5e-3) -> Touch:
        pose = at(along, 0.3 * along, RADIUS - depth)
        self.touches, self.state = self.simulator.touch([Contact(self.tool, pose)], self.state, dt)
        return self.touches[0]

    def answer(self) -> Answer:
        return self.simulator.answer(self.touches)


def apart(one: Answer, other: Answer) -> float:
    """Largest difference of two motions over the peak of the first."""
    return float(np.linalg.norm(one.displacement - other.displacement, axis=1).max() / one.magnitude.max())


@pytest.mark.parametrize("friction", [0.3, 1.0])
@pytest.mark.parametrize("tissue", [ONE, STACK, FADING], ids=["one", "stack", "fading"])
def test_a_stroke_that_stops_or_turns_back_by_next_to_nothing_leaves_the_skin_where_it_is(
        tissue: Tissue, friction: float) -> None:  # fmt: skip
    stroke = Stroke(tissue, friction)
    for along in np.arange(1, 21) / 20 * WAY:
        touch = stroke.to(along)
    assert touch.slip is not None and touch.slip.kind == "slide"
    before = stroke.answer()
    for along in (WAY, WAY - 1e-7, WAY - 2e-7, WAY, WAY + 1e-7):
        touch = stroke.to(along, dt=1e-5)
        assert touch.slip is not None
        after = stroke.answer()
        assert apart(before, after) < 5e-3
        before = after


def test_skin_moves_evenly_as_friction_grows_and_as_it_is_let_go() -> None:
    """Nothing jumps from first stick to slide, nor on the way back through no friction to a slide the other way."""
    stroke, before, most = Stroke(ONE, 0.6), None, 0.0
    for along in np.concatenate([np.arange(0, 40), np.arange(40, -40, -1)]) * 1e-4:
        stroke.to(along)
        after = stroke.answer()
        if before is not None:
            moved = np.linalg.norm(after.displacement - before.displacement, axis=1).max()
            most = max(most, float(moved))
        before = after
    assert most < 2.5 * 1e-4 * np.hypot(1, 0.3)


def test_what_sticks_moves_as_one_and_what_slides_as_friction_drags_it() -> None:
    stroke = Stroke(ONE, 0.6)
    sticks = stroke.to(2e-5).slip
    for along in np.arange(1, 21) / 20 * WAY:
        slides = stroke.to(along).slip
    back = stroke.to(WAY - 2e-5).slip
    assert sticks is not None and slides is not None and back is not None
    assert np.linalg.norm(sticks.offset) > 1e-5
    assert np.linalg.norm(sticks.slid_offset) < 1e-12
    np.testing.assert_allclose(slides.slid_offset, slides.offset, atol=1e-12)
    assert abs(slides.slid_turn - slides.turn) < 1e-9
    assert np.linalg.norm(back.offset) < np.linalg.norm(slides.offset) - 1e-5  # sticks: it goes along with the tool
    np.testing.assert_allclose(back.slid_offset, slides.slid_offset, rtol=1e-3)


def test_the_part_of_the_way_that_slides_is_the_friction_over_its_limit() -> None:
    """On first loading, where springs begin to slide; and the first of them alone says that nothing did."""
    for way, force in zip(_YIELD[1:], _FORCE[1:], strict=True):
        springs = np.minimum(STIFFNESS * way, LIMIT)
        assert springs.sum() == pytest.approx(force)
        assert SLID @ springs == pytest.approx(force**2 if way > _YIELD[1] else 0.0, abs=1e-12)
