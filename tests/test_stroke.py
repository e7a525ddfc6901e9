"""Laws of a stroke without a mesh: it is what a simulator with a state answers, and closed forms at its ends."""

import numpy as np
import pytest

from stmpl_core import Contact, Prony, Simulator, State, Tissue
from stmpl_core.methods import Winkler
from stmpl_core.relaxation import Series, series_of
from stmpl_core.sideways import patch
from stmpl_core.stack import ball as pressed
from stmpl_core.stroke import Course, Stroke, played, pulled, without_time
from tests.scenes import THICKNESS, at, ball, plate

RADIUS, DEPTH, MU = 8e-3, 1e-3, 0.4
TISSUE = Tissue(2e4, 0.4, relaxation=Prony((0.225, 0.225), (0.5, 5.0)))
SERIES, NONE = series_of(TISSUE, THICKNESS), Series(np.empty(0), np.empty(0))


def stroke(speed=1e-2, stays=0.0, way=0.0) -> Stroke:
    found, half = (pressed(TISSUE, THICKNESS, RADIUS, depth=share * DEPTH) for share in (1.0, 0.5))
    return Stroke(found.force, float(np.log2(found.force / half.force)), DEPTH, found.contact_radius,
                  patch(TISSUE, THICKNESS, found.contact_radius), speed, stays, way)  # fmt: skip


def simulated(one: Stroke, friction: float | None) -> Course:
    """The same stroke by a simulator; its elastic force is that of the same poses without time."""
    simulator, tool = Simulator(plate(0.09).with_(tissue=TISSUE), Winkler(), friction=friction), ball(RADIUS)
    down, along = np.linspace(0, DEPTH, 21), np.linspace(0, one.way, 31)[1:] if one.way else np.empty(0)
    stays = 10 if one.stays else 0
    depth = np.concatenate([down, np.full(stays + len(along), DEPTH), down[::-1][1:]])
    x = np.concatenate([np.zeros(21 + stays), along, np.full(20, one.way)])
    dt = np.hypot(np.diff(depth, prepend=0), np.diff(x, prepend=0)) / one.speed
    dt[21 : 21 + stays] = one.stays / max(stays, 1)
    state, touches = State(), []
    for z, way, time in zip(depth, x, dt, strict=True):
        (touch,), state = simulator.touch([Contact(tool, at(3e-4 + way, 2e-4, RADIUS - z))], state, time)
        touches.append(touch)
    plain = simulator.touch([Contact(tool, at(3e-4, 2e-4, RADIUS - DEPTH))])[0].force
    elastic = plain * (depth / DEPTH) ** 1.5
    force = np.array([touch.force for touch in touches])
    slips = [touch.slip for touch in touches]
    drag = np.array([0.0 if s is None else np.linalg.norm(s.wrench[:3]) for s in slips])
    offset = np.array([0.0 if s is None else np.linalg.norm(s.offset) for s in slips])
    return Course(depth, elastic, force, drag, offset)


@pytest.mark.parametrize("speed, stays", [(1e-2, 0.0), (1e-3, 0.0), (1e-2, 3.0), (1.0, 1.0)])
def test_time_is_that_of_a_simulator(speed: float, stays: float) -> None:
    ours, theirs = played(stroke(speed, stays), SERIES, 0.0), simulated(stroke(speed, stays), None)
    for mine, other in ((80, 20), (110, 30))[: 2 if stays else 1]:  # ends of the press and of the stay
        left = theirs.force[other] / theirs.elastic[other]
        assert ours.force[mine] / ours.elastic[mine] == pytest.approx(left, abs=0.02)
    lifted = [one.depth[np.flatnonzero((one.force <= 0) & (np.arange(len(one.force)) > one.force.argmax()))[0]]
              for one in (ours, theirs)]  # fmt: skip
    assert lifted[0] == pytest.approx(lifted[1], abs=0.08 * DEPTH)


@pytest.mark.parametrize("way", [2e-4, 1e-3, 8e-3])
def test_slip_is_that_of_a_simulator(way: float) -> None:
    ours, theirs = played(stroke(np.inf, way=way), NONE, MU), simulated(stroke(np.inf, way=way), MU)
    share = [float(one.drag.max() / one.force.max()) for one in (ours, theirs)]
    gone = [float(one.offset.max()) for one in (ours, theirs)]
    assert share[0] == pytest.approx(share[1], rel=0.12) and gone[0] == pytest.approx(gone[1], rel=0.25)


def test_skin_that_a_tool_slides_to_is_fresh() -> None:
    held, led = (played(stroke(1e-2, 30.0, way), SERIES, 0.0).force for way in (0.0, 0.05))
    assert held[110] == pytest.approx(led[110]) and led[110] < 0.6 * led[:81].max() and led[190] > 0.9 * led[:81].max()


def test_elastic_tissue_misses_nothing_and_relaxed_tissue_is_its_share() -> None:
    assert without_time([stroke()], NONE, 0.0)[:2] == (0.0, 0.0)
    slow = without_time([stroke(1e-7)], SERIES, 0.0)
    assert slow.share == pytest.approx(0.55, abs=2e-3) and slow.fitted < 0.01 and slow.lag < 0.01
    assert slow.force == pytest.approx(1 / 0.55 - 1, rel=0.01)


def test_a_pull_is_carried_up_to_the_cap() -> None:
    (little, near), (all_of, far) = (pulled(stroke(), MU, share) for share in (0.1, 5.0))
    assert little == pytest.approx(0.1, rel=1e-6) and MU < all_of < 1.5 * MU and far > near > 0
