"""The groove that a tool leaves behind where it slid over skin that relaxes."""

import numpy as np
import pytest
import trimesh

from stmpl_core import Contact, Prony, Simulator, SoftLayer, State, Tissue, Tool
from stmpl_core.methods import Winkler
from stmpl_core.sideways import patch
from stmpl_core.tissue import Membrane
from tests.scenes import plate

DEPTH, RADIUS = 4e-3, 0.02
SERIES = Prony((0.2,), (0.5,))


@pytest.fixture(scope="module")
def ball() -> Tool:
    mesh = trimesh.creation.icosphere(3, 1e3 * RADIUS)
    return Tool("ball", 1e-3 * np.asarray(mesh.vertices), np.asarray(mesh.faces))


def slab(series: Prony | None) -> SoftLayer:
    return plate(0.16, 5e-3, 15e-3, crossed=True).with_(tissue=Tissue(5e3, 0.45, relaxation=series))


def slid(layer: SoftLayer, ball: Tool, step: float = 1e-3, lift: bool = False, wait: float = 0.0):
    """A ball led over 60 mm in 1.2 s; what is answered at the end, and the state."""
    simulator, state = Simulator(layer, Winkler(), friction=0.1), State()
    touches = []
    for along in np.arange(-0.03, 0.03 + step / 2, step):
        pose = np.eye(4)
        pose[:3, 3] = along, 0.0, RADIUS - DEPTH
        touches, state = simulator.touch([Contact(ball, pose)], state, dt=step / 0.05)
    if lift or wait:
        pose[2, 3] = RADIUS + 0.02
        touches, state = simulator.touch([Contact(ball, pose)], state, dt=1e-3)
        touches, state = simulator.touch([Contact(ball, pose)], state, dt=wait)
    return simulator.answer(touches), state, simulator


def groove(layer: SoftLayer, answer) -> np.ndarray:
    """Depth of the skin along the way, behind the tool [m]."""
    x, y, _ = layer.vertices.T
    behind = (x > -0.031) & (x < 0.0) & (np.abs(y) < 2e-3)
    return -answer.displacement[behind, 2]


def test_skin_that_relaxes_stays_sunk_behind_a_tool_and_elastic_skin_does_not(ball: Tool) -> None:
    relaxing, elastic = slab(SERIES), slab(None)
    left = groove(relaxing, slid(relaxing, ball)[0])
    assert 0.1 * DEPTH < np.median(left) < 0.5 * DEPTH
    assert left.min() > 0
    assert np.abs(groove(elastic, slid(elastic, ball)[0])).max() < 0.05 * DEPTH


def test_a_groove_is_as_deep_as_what_has_relaxed_there_presses(ball: Tool) -> None:
    """Skin under a ball for 2 a / v keeps g (1 - exp(-2 a / (v tau))) of its force; where it is let go d ~ F^(1/power),
    and from there on d ~ F ~ exp(-(1 - g) t / tau)."""
    layer = slab(SERIES)
    answer, state, _ = slid(layer, ball)
    memory = state.tools["ball"].scalars
    time = 2 * memory.radius / 0.05
    passed = (0.03 - memory.radius + 0.015) / 0.05  # time since the rim left the middle of what is looked at
    relaxed = 0.2 * (1 - np.exp(-time / 0.5))
    expected = memory.depth * relaxed ** (1 / memory.power) * np.exp(-0.8 * passed / 0.5)
    assert np.median(groove(layer, answer)) == pytest.approx(expected, rel=0.25)


def test_a_groove_begins_where_the_tool_came_down_however_slowly_it_goes_on(ball: Tool) -> None:
    """Each step is far shorter than two places are apart, and presses a little deeper."""
    simulator, state, touches = Simulator(slab(SERIES), Winkler(), friction=0.1), State(), []
    for k in range(101):
        pose = np.eye(4)
        pose[:3, 3] = 2e-4 * k, 0.0, RADIUS - DEPTH - 1e-6 * k
        touches, state = simulator.touch([Contact(ball, pose)], state, dt=0.01)
    left = touches[0].wake
    assert left is not None
    places = sorted(groove.pose[0, 3] for groove in left.grooves())
    assert places[0] < 2e-3 and len(places) > 3


def test_a_groove_comes_back_and_is_forgotten(ball: Tool) -> None:
    layer = slab(SERIES)
    soon, _, _ = slid(layer, ball, lift=True)
    later, state, _ = slid(layer, ball, wait=0.5)
    at_last, empty, _ = slid(layer, ball, wait=20.0)
    assert 0.2 * np.median(groove(layer, soon)) < np.median(groove(layer, later)) < 0.9 * np.median(groove(layer, soon))
    assert not at_last.displacement.any()
    assert state.tools["ball"].trail.any()
    assert not empty.tools["ball"].trail.any()


def test_a_groove_hardly_depends_on_how_the_path_is_cut(ball: Tool) -> None:
    """Its places lie on the tool's way, not where its steps ended."""
    layer = slab(SERIES)
    coarse, fine = (slid(layer, ball, step)[0].displacement for step in (3e-3, 0.25e-3))
    assert np.abs(coarse - fine).max() < 0.015 * np.abs(fine).max()
    coarse, fine = (np.median(groove(layer, slid(layer, ball, step)[0])) for step in (2e-3, 0.5e-3))
    assert coarse == pytest.approx(fine, rel=0.06)


def test_a_groove_is_in_the_packed_state(ball: Tool) -> None:
    layer = slab(SERIES)
    _, state, simulator = slid(layer, ball)
    pose = np.eye(4)
    pose[:3, 3] = 0.031, 0.0, RADIUS - DEPTH
    one, two = (simulator.touch([Contact(ball, pose)], s, 0.02) for s in (state, State.unpack(state.pack())))
    assert one[0][0].wake
    assert np.array_equal(simulator.answer(one[0]).displacement, simulator.answer(two[0]).displacement)
    assert one[1].pack() == two[1].pack()


def test_skin_that_lost_its_tension_ahead_pushes_no_more() -> None:
    tissue = Tissue(3e3, 0.45, skin=Membrane(2e5, 1.5e-3, 15.0))
    one = patch(tissue, 20e-3, 10e-3)
    assert one.slack == pytest.approx(2 * np.pi * 15.0 * 10e-3)
    assert one.bare == pytest.approx(patch(Tissue(3e3, 0.45), 20e-3, 10e-3).along)
    of_skin = one.along - one.bare
    begins = one.slack * one.along / of_skin
    assert one.secant(begins) == one.along > one.secant(1.1 * begins) > one.along - 0.02 * of_skin
    assert one.secant(1e6) == pytest.approx(one.along - 0.25 * of_skin, rel=1e-4)
    single = patch(Tissue(3e3, 0.45), 20e-3, 10e-3)
    assert single.secant(10.0) == pytest.approx(single.along)
