"""Laws of time: tissue that relaxes, answered step by step from a state that is a value."""

import pickle

import numpy as np
import pytest

from stmpl_core import Contact, Membrane, Ply, Prony, Simulator, SoftLayer, State, Tissue, Touch
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Winkler
from stmpl_core.relaxation import depth_left, fades_under, series_of
from stmpl_core.stack import ball as pressed_ball
from stmpl_core.state import UNKNOWN, VERSION, Scalars, fresh
from stmpl_core.touch import APART, BY_POSE, MOVED, TOUCHING
from tests.scenes import at, ball, plate, turn

SERIES = Prony((0.225, 0.225), (0.5, 5.0))
RADIUS, DEPTH = 8e-3, 3e-3
BALL = ball(RADIUS)
MIDDLE = (3e-4, 2e-4)  # off the mesh's vertices


def relaxing(series: Prony | None = SERIES) -> SoftLayer:
    return plate(0.09).with_(tissue=Tissue(2e4, 0.4, relaxation=series))


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator(relaxing(), Winkler())


@pytest.fixture(scope="module")
def elastic(sim: Simulator) -> Simulator:
    return Simulator(relaxing(None), Winkler(), sim.tools)


def pressed(depth: float, wrench: tuple[float, ...] | None = None, x: float = 0.0) -> Contact:
    pose = at(MIDDLE[0] + x, MIDDLE[1], RADIUS - depth)
    return Contact(BALL, pose, None if wrench is None else np.array([*wrench, 0.0, 0.0, 0.0]))


def played(sim: Simulator, times: np.ndarray, depths: np.ndarray) -> tuple[list[Touch], State]:
    """Touches at depths [m], one at each time [s]."""
    state, touches, before = State(), [], times[0]
    for time, depth in zip(times, depths, strict=True):
        (touch,), state = sim.touch([pressed(depth)], state, time - before)
        touches.append(touch)
        before = time
    return touches, state


def forces(sim: Simulator, times: np.ndarray, depths: np.ndarray) -> np.ndarray:
    return np.array([touch.force for touch in played(sim, times, depths)[0]])


def test_elastic_tissue_answers_bit_for_bit_as_without_a_state(elastic: Simulator) -> None:
    depths = np.array([-1e-3, 0.5e-3, 2e-3, 4e-3, 3e-3, 1e-3, -1e-3])
    for touch, depth in zip(played(elastic, 0.1 * np.arange(7), depths)[0], depths, strict=True):
        (plain,) = elastic.touch([pressed(depth)])
        assert touch.wrench.tobytes() == plain.wrench.tobytes() and touch.status == plain.status
        assert (touch.pressure is None) == (plain.pressure is None)
        if touch.pressure is not None and plain.pressure is not None:
            assert touch.pressure.tobytes() == plain.pressure.tobytes()
        assert sim_motion(elastic, touch).tobytes() == sim_motion(elastic, plain).tobytes()


def sim_motion(sim: Simulator, touch: Touch) -> np.ndarray:
    return sim.answer([touch]).displacement


def test_a_quick_press_is_elastic_and_a_slow_one_relaxed(sim: Simulator, elastic: Simulator) -> None:
    depths = np.linspace(-1e-4, DEPTH, 20)
    stiff = forces(elastic, np.zeros(20), depths)
    np.testing.assert_allclose(forces(sim, np.zeros(20), depths), stiff, rtol=1e-12)
    np.testing.assert_allclose(forces(sim, 1e4 * np.arange(20.0), depths)[2:], SERIES.relaxed * stiff[2:], rtol=1e-3)


def test_a_held_press_relaxes_as_the_series_says(sim: Simulator, elastic: Simulator) -> None:
    times = np.concatenate([np.zeros(10), np.geomspace(0.01, 60, 30)])
    depths = np.concatenate([np.linspace(-1e-4, DEPTH, 10), np.full(30, DEPTH)])
    hold = elastic.touch([pressed(DEPTH)])[0].force * SERIES.left(times[10:])
    np.testing.assert_allclose(forces(sim, times, depths)[10:], hold, rtol=1e-9)


def test_the_force_is_the_convolution_until_the_skin_is_free(sim: Simulator, elastic: Simulator) -> None:
    """1 Hz massage with lift-off, against the integral over the elastic force at rest on a fine grid of time."""
    times = np.linspace(0, 3, 601)
    depths = 0.5 * DEPTH * (1 - 1.4 * np.cos(2 * np.pi * times))
    found = forces(sim, times, depths)
    plain = forces(elastic, times, depths)
    stretch = 1 - np.maximum(depths, 0) / sim.layer.thickness[0]
    history, free, straight = np.zeros(2), 0.0, []
    gone = np.exp(-0.005 / np.array(SERIES.times))
    for one, long in zip(plain, stretch, strict=True):  # forward Euler in the force at rest of skin, free or held
        owed = float(np.array(SERIES.shares) @ (gone * history + (1 - gone) * free))
        free = max(one / long, owed)
        history = gone * history + (1 - gone) * free
        straight.append(max(one - long * float(np.array(SERIES.shares) @ history), 0.0))
    assert np.abs(found - straight).max() < 0.02 * plain.max()
    assert (found == 0).mean() > (plain == 0).mean() + 0.05  # skin lags: the tool leaves it early


def test_halving_the_steps_changes_the_force_by_less_than_one_percent(sim: Simulator) -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.005, 0.04, 60))
    knots = np.array([-0.1, 1, 0.3, 0.9, -0.2, 0.7, 0.7])
    depths = np.interp(times, np.linspace(times[0], times[-1], 7), DEPTH * knots)
    fine = np.interp(np.arange(119) / 2, np.arange(60), times)
    coarse, finer = forces(sim, times, depths), forces(sim, fine, np.interp(fine, times, depths))[::2]
    assert np.abs(coarse - finer).max() < 0.01 * coarse.max()


def test_a_step_without_time_or_motion_changes_nothing(sim: Simulator) -> None:
    touches, state = played(sim, np.array([0.0, 0.1, 0.3]), np.array([-1e-4, 2e-3, 2e-3]))
    (again,), same = sim.touch([pressed(2e-3)], state, 0.0)
    np.testing.assert_allclose(again.wrench, touches[-1].wrench, rtol=1e-12)
    np.testing.assert_allclose(same.tools["probe"].relaxed, state.tools["probe"].relaxed, rtol=1e-12)


def test_a_held_force_creeps_to_the_depth_of_relaxed_tissue(sim: Simulator) -> None:
    push, state, depths = (0.0, 0.0, -0.5), State(), []
    for dt in [0.0, *[0.05] * 4, 0.5, 2.0, 10.0, 100.0]:
        (touch,), state = sim.touch([pressed(2e-3, push)], state, dt)
        assert touch.wrench[2] == pytest.approx(-0.5, rel=1e-9) and np.abs(touch.missing[:3]).max() < 1e-9
        depths.append(touch.depth)
    assert (np.diff(depths) > -1e-6).all()
    relaxed = sim.touch([pressed(2e-3, (0.0, 0.0, -0.5 / SERIES.relaxed))])[0]
    assert depths[-1] == pytest.approx(relaxed.depth, rel=0.02)
    assert depths[0] == pytest.approx(sim.touch([pressed(2e-3, push)])[0].depth, rel=1e-6)


def test_a_held_force_creeps_alike_wherever_the_tool_is_said_to_be(sim: Simulator) -> None:
    """The search for the depth begins where the tool was: the answer is that of a search from the stated pose."""
    push, times = (0.0, 0.0, -0.5), [0.0, *[0.05] * 10, 1.0, 5.0]
    found: list[list[Touch]] = []
    for depth in (2e-3, 3.5e-3, -0.8e-3):
        state, touches = State(), []
        for dt in times:
            (touch,), state = sim.touch([pressed(depth, push)], state, dt)
            touches.append(touch)
        found.append(touches)
    for here, deep, off in zip(*found, strict=True):
        assert here.depth == pytest.approx(deep.depth, rel=0.01) and here.depth == pytest.approx(off.depth, rel=0.01)
        assert (here.status, deep.status, off.status) == (TOUCHING, TOUCHING, MOVED)


def test_a_tool_that_jumps_is_found_again(sim: Simulator) -> None:
    """A pose far from where the tool was said to be before is searched anew."""
    push, state = (0.0, 0.0, -0.5), State()
    (_,), state = sim.touch([pressed(2e-3, push)], state, 0.1)
    for depth in (-2.5e-3, 6e-3, 2e-3):
        (touch,), state = sim.touch([pressed(depth, push)], state, 0.01)
        assert touch.presses and touch.wrench[2] == pytest.approx(-0.5, rel=0.02)


def test_free_skin_comes_back_alike_in_one_step_or_many(sim: Simulator) -> None:
    """Not told of, and told of as lifted off, over the same place and beside it."""
    _, start = played(sim, np.array([0, 0.1, 4.0]), np.array([-1e-4, DEPTH, DEPTH]))
    (_,), lifted = sim.touch([pressed(-1e-3)], start, 1e-6)
    for contacts, state in (([], start), ([pressed(-1e-3)], lifted), ([pressed(-1e-3, x=0.02)], lifted)):
        _, once = sim.touch(contacts, state, 2.0)
        many = state
        for _ in range(200):
            _, many = sim.touch(contacts, many, 0.01)
        one, other = once.tools["probe"], many.tools["probe"]
        assert one.scalars.elastic == pytest.approx(other.scalars.elastic, rel=0.01)
        np.testing.assert_allclose(one.relaxed, other.relaxed, rtol=0.01)
        np.testing.assert_allclose(one.trail, other.trail, rtol=0.01, atol=1e-12)
        assert 0.05 * start.tools["probe"].scalars.elastic < one.scalars.elastic


@pytest.mark.parametrize("away", [0.0, 1e-3, 0.05])
def test_a_lift_in_one_long_step_lets_the_skin_go_when_the_tool_does(sim: Simulator, away: float) -> None:
    """One step of 1 s from the greatest depth to where a tool just leaves, or is away, or hundreds of them."""
    _, start = played(sim, np.array([0, 0.1, 4.0]), np.array([-1e-4, DEPTH, DEPTH]))
    (_,), once = sim.touch([pressed(-away)], start, 1.0)
    many = start
    for depth in np.linspace(DEPTH, -away, 401)[1:]:
        (_,), many = sim.touch([pressed(depth)], many, 1 / 400)
    one, other = (state.tools["probe"].scalars for state in (once, many))
    assert one.elastic == pytest.approx(other.elastic, rel=0.05)  # a force of d^p, taken as straight in time


@pytest.mark.parametrize("takes", [0.1, 3.0])
@pytest.mark.parametrize("away", [1e-3, 5e-3, 0.05])
def test_skin_that_a_tool_comes_to_in_one_long_step_relaxes_from_when_it_is_met(
    sim: Simulator, away: float, takes: float
) -> None:
    def force(steps: int) -> float:
        share = np.linspace(0, 1, steps + 1)
        return forces(sim, takes * share, -away + share * (away + DEPTH))[-1]

    assert force(1) == pytest.approx(force(300), rel=0.03)


def test_skin_that_a_slow_lift_left_is_in_range_and_stays_so(sim: Simulator) -> None:
    """Where the tool leaves its groove elastic skin would be met by a sliver of it, which is like nothing learnt."""
    _, state = played(sim, np.array([0, 0.2, 5.0]), np.array([-1e-4, DEPTH, DEPTH]))
    for depth in np.linspace(DEPTH, -1e-3, 201)[1:]:
        (touch,), state = sim.touch([pressed(depth)], state, 0.1)
        assert touch.trust.ok, touch.trust.why
    (touch,), state = sim.touch([pressed(-0.05)], state, 3600.0)
    assert touch.trust.ok


def test_a_quick_lift_after_a_hold_unloads_steeper_than_elastic_skin(sim: Simulator, elastic: Simulator) -> None:
    """What relaxed pulls with the stretch of the column: F = F_e - (1 - d / t) A."""
    thickness, back = float(sim.layer.thickness[0]), 0.9 * DEPTH
    found = forces(sim, np.array([0, 0, 3.0, 3.0]), np.array([-1e-4, DEPTH, DEPTH, back]))
    plain = forces(elastic, np.zeros(3), np.array([-1e-4, DEPTH, back]))
    relaxed = (plain[1] - found[2]) / (1 - DEPTH / thickness)
    assert found[3] == pytest.approx(plain[2] - (1 - back / thickness) * relaxed, rel=1e-3)
    assert found[2] - found[3] > 1.02 * (plain[1] - plain[2])


def test_skin_that_comes_back_goes_through_one_shape(sim: Simulator) -> None:
    """What is left of a load that fades is the same motion, smaller; it begins where the tool let go."""
    touches, _ = played(sim, np.array([0, 0.1, 5.0, 5.01, 5.3, 7.0]), np.array([-1e-4, *[DEPTH] * 2, *[-1e-3] * 3]))
    first, *later = (sim.answer([touch]).displacement for touch in touches[3:])
    for one in later:
        share = np.vdot(one, first) / np.vdot(first, first)
        assert 0.1 < share < 0.95
        np.testing.assert_allclose(one, share * first, atol=1e-3 * DEPTH)


@pytest.mark.parametrize("strain", [0.0, 0.3, 0.6, 0.85])
@pytest.mark.parametrize("power", [0.8, 1.0, 1.6, 3.0])
def test_the_depth_that_is_left_holds_its_law_at_any_strain(power: float, strain: float) -> None:
    for share in np.geomspace(1e-6, 1, 40):
        x = depth_left(share, power, strain)
        assert x**power * (1 - strain) == pytest.approx(share * (1 - x * strain), rel=1e-6) and 0 < x <= 1
    assert depth_left(0.0, power, strain) == 0


def test_skin_that_was_pressed_deep_comes_back_ever_shallower(sim: Simulator) -> None:
    thickness = float(sim.layer.thickness.mean())
    state, left = State(), []
    for _ in range(10):
        _, state = sim.touch([pressed(0.8 * thickness)], state, 0.5)
    for _ in range(40):
        touches, state = sim.touch([pressed(-5 * thickness)], state, 0.02)
        assert state.finite and touches[0].imprint is not None
        left.append(touches[0].imprint.depth / thickness)
    assert 0.8 > left[0] > left[-1] > 0 and (np.diff(left) < 0).all()


def test_skin_comes_back_by_itself_after_a_quick_lift(sim: Simulator) -> None:
    touches, state = played(sim, np.array([0, 0.1, 5.0, 5.0, 5.2, 6.0, 15.0]),
                            np.array([-1e-4, DEPTH, DEPTH, -1e-3, -1e-3, -1e-3, -1e-3]))  # fmt: skip
    sunk = [sim.answer([touch]).magnitude.max() for touch in touches[3:]]
    assert all(touch.status == APART and touch.force == 0 for touch in touches[3:])
    assert DEPTH > sunk[0] > sunk[1] > sunk[2] > sunk[3] > 0
    _, state = sim.touch([], state, 1.0)
    assert list(state.tools) == ["probe"]
    assert not sim.touch([], state, 1e3)[1].tools


def test_a_second_press_is_softer_until_the_skin_has_come_back(sim: Simulator) -> None:
    for wait, less in ((0.05, True), (200.0, False)):
        times = np.array([0, 0, 3, 3, 3 + wait, 3 + wait])
        found = forces(sim, times, np.array([-1e-4, DEPTH, DEPTH, -1e-3, -1e-3, DEPTH]))
        assert (found[-1] < 0.9 * found[1]) == less


def test_fresh_skin_is_met_where_a_tool_slides_to(sim: Simulator) -> None:
    _, state = played(sim, np.array([0, 0, 30.0]), np.array([-1e-4, DEPTH, DEPTH]))
    fresh = sim.touch([pressed(DEPTH, x=0.03)], State(), 0.0)[0][0].force
    stays = sim.touch([pressed(DEPTH)], state, 0.1)[0][0].force
    found = []
    for k in range(60):
        (touch,), state = sim.touch([pressed(DEPTH, x=5e-4 * (k + 1))], state, 1e-3)
        found.append(touch.force)
    assert stays < 0.6 * fresh and found[-1] > 0.98 * fresh and (np.diff(found) > -0.02 * fresh).all()


@pytest.mark.parametrize("friction", [0.05, 0.5])
def test_skin_that_a_tool_slides_to_is_fresh_however_long_the_step(sim: Simulator, friction: float) -> None:
    """Before the step it stuck; one step is as good as forty."""
    rubbing = Simulator(sim.layer, sim.method, sim.tools, friction=friction)
    for way in (3e-3, 5e-3, 0.02):
        ends = []
        for steps in (1, 2, 40):
            _, state = rubbing.touch([pressed(DEPTH)], State(), 0.01)
            (held,), state = rubbing.touch([pressed(DEPTH)], state, 60.0)
            for k in range(steps):
                (touch,), state = rubbing.touch([pressed(DEPTH, x=way * (k + 1) / steps)], state, 0.1 / steps)
            ends.append(touch.force)
        assert held.force < 0.9 * ends[2] and ends[:2] == pytest.approx([ends[2]] * 2, rel=0.08)


def test_noise_of_the_pose_undoes_no_relaxation(sim: Simulator) -> None:
    """Skin that a contact has been over is not fresh: without friction 10 um at 100 Hz had put back a third."""
    rng, state, held = np.random.default_rng(0), State(), []
    for noise in (0.0, 1e-5):
        state = played(sim, np.array([0.0, 0.1]), np.array([-1e-4, DEPTH]))[1]
        for _ in range(500):
            pose = pressed(DEPTH).pose_body_from_tool.copy()
            pose[:2, 3] += noise * rng.normal(size=2)
            (touch,), state = sim.touch([Contact(BALL, pose)], state, 0.01)
        held.append(touch.force)
    assert held[1] == pytest.approx(held[0], rel=5e-3)


def test_what_rests_on_a_touch_out_of_range_is_until_that_has_faded(sim: Simulator) -> None:
    _, state = played(sim, 0.1 * np.arange(3), np.array([0.0, 2e-3, 2e-3]))
    assert all(touch.trust.in_range for touch in sim.touch([pressed(2e-3)], state, 0.1)[0])
    (deep,), after = sim.touch([pressed(8e-3)], state, 0.02)
    assert not deep.trust.in_range
    waits = []
    for _ in range(60):
        (touch,), after = sim.touch([pressed(2e-3)], after, 0.5)
        assert touch.trust.in_range or "relaxes from a touch out of range" in touch.trust.why
        waits.append(touch.trust.in_range)
    (plain,), _ = sim.touch([pressed(2e-3)], state, 30.02)
    assert not waits[0] and waits[-1] and touch.force == pytest.approx(plain.force, rel=0.02)
    assert np.all(np.diff(np.array(waits, int)) >= 0)  # once
    (fresh,), _ = sim.touch([pressed(2e-3, x=0.02)], after, 0.02)
    assert fresh.trust.in_range


@pytest.mark.parametrize("share, doubted", [(0.02, False), (20.0, True)])
def test_a_wrench_that_finds_no_skin_leaves_as_much_doubt_as_it_may_have_pressed(
    sim: Simulator, share: float, doubted: bool,
) -> None:  # fmt: skip
    """Noise of a sensor in the air, told once, had all flagged for half a minute."""
    touches, state = played(sim, 0.1 * np.arange(4), np.array([0.0, 2e-3, 2e-3, -0.03]))
    away, newton = pressed(-0.03), share * touches[2].force
    noise = Contact(away.tool, away.pose_body_from_tool, np.array([0, 0, -newton, 0, 0, 0]))
    (lost,), state = sim.touch([noise], state, 0.1)
    assert not lost.trust.in_range
    (touch,), _ = sim.touch([away], state, 0.1)
    assert touch.trust.in_range != doubted


def test_a_replay_from_any_frame_is_bit_for_bit(sim: Simulator) -> None:
    times, depths = np.linspace(0, 2, 21), DEPTH * np.sin(np.linspace(-0.1, 6, 21))
    all_of, last = played(sim, times, depths)
    _, middle = played(sim, times[:9], depths[:9])
    for kept in (State.unpack(middle.pack()), pickle.loads(pickle.dumps(middle))):
        state = kept
        for k in range(9, 21):
            (touch,), state = sim.touch([pressed(depths[k])], state, times[k] - times[k - 1])
            assert touch.wrench.tobytes() == all_of[k].wrench.tobytes()
        assert state.pack() == last.pack()


def test_a_state_of_the_versions_before_is_read(sim: Simulator) -> None:
    """They lack the last scalars: what a slide took, what rests on touches out of range, where the contact has been."""
    state = played(sim, np.array([0.0, 0.1, 0.3]), np.array([-1e-4, 2e-3, 2e-3]))[1]
    head, _, rest = state.pack().partition(b"\n")
    last = 16 + 6 + len(Scalars._fields)
    for version, lacks in UNKNOWN.items():
        numbers = np.delete(np.frombuffer(rest), slice(last - lacks, last))
        old = head.replace(f'"version": {VERSION}'.encode(), f'"version": {version}'.encode()) + b"\n"
        assert State.unpack(old + numbers.tobytes(), joints=()).pack() == state.pack()


def test_bytes_of_another_kind_are_no_state() -> None:
    assert not State.unpack(State().pack()).tools
    for wrong in (b"", b"{}\n", b'{"version": 1, "terms": 0, "tools": ["a"]}\n1234', b'{"version": 9}\n',
                  b'{"version": 2, "terms": -1, "tools": []}\n', b'{"version": 2, "terms": 1e400, "tools": []}\n'):
        with pytest.raises(InvalidInput):
            State.unpack(wrong)
    for wrong in (None, "abc", 3):
        with pytest.raises(InvalidInput, match="bytes are needed"):
            State.unpack(wrong)  # type: ignore[arg-type]
    broken = fresh(np.eye(4), 0)
    broken.numbers[-1] = np.nan
    with pytest.raises(InvalidInput, match="not finite"):
        State.unpack(State({"ball": broken}).pack())


def test_a_state_is_a_value_whatever_becomes_of_pose_and_touch(sim: Simulator) -> None:
    contact = pressed(2e-3)
    pose = contact.pose_body_from_tool.copy()
    (touch,), state = sim.touch([Contact(contact.tool, pose)], State(), 0.1)
    before = state.pack()
    pose[:] = np.eye(4)
    touch.pose_body_from_tool[:] = np.eye(4)
    touch.wrench[:] = 0.0
    assert state.pack() == before


def test_a_state_of_other_skin_is_refused(sim: Simulator, elastic: Simulator) -> None:
    _, state = elastic.touch([pressed(2e-3)], State(), 0.1)
    with pytest.raises(InvalidInput, match="times of relaxation"):
        sim.touch([pressed(2e-3)], state, 0.1)
    _, state = sim.touch([pressed(2e-3)], State(), 0.1)
    far = {name: one.with_(contact=one.contact + [[0.5, 0, 0], [0, 0, 0], [0, 0, 0]])
           for name, one in state.tools.items()}  # fmt: skip
    with pytest.raises(InvalidInput, match="where this skin is not"):
        sim.touch([pressed(2e-3)], State(far), 0.1)


def test_a_state_of_elastic_skin_of_another_shape_is_refused(elastic: Simulator) -> None:
    """It answered 0 N, and said that the tool had come with too little work."""
    _, state = elastic.touch([pressed(2e-3)], State(), 0.1)
    layer = elastic.layer.with_(thickness=2 * elastic.layer.thickness)
    with pytest.raises(InvalidInput, match=f"state of {BALL.name} is of skin of another shape"):
        Simulator(layer, Winkler()).touch([pressed(2e-3)], state, 0.1)
    for again in (state, pickle.loads(pickle.dumps(state)), State.unpack(state.pack())):
        (same,), _ = Simulator(elastic.layer.with_(youngs_modulus=2e4), Winkler()).touch([pressed(2e-3)], again, 0.1)
        assert same.trust.ok and same.force > 0


def test_a_state_of_skin_that_relaxes_or_is_dragged_otherwise_is_refused(sim: Simulator) -> None:
    """Of tissue ten times as stiff 0 N were answered where 0.7 were right, without a word."""
    _, state = sim.touch([pressed(2e-3)], State(), 0.1)
    stiff = Simulator(sim.layer.with_(youngs_modulus=10 * sim.layer.tissue.youngs_modulus), Winkler())
    for again in (state, pickle.loads(pickle.dumps(state))):
        with pytest.raises(InvalidInput, match=f"state of {BALL.name} is of other tissue"):
            stiff.touch([pressed(2e-3)], again, 0.1)
    skins = [Tissue(2e4, 0.4, skin=Membrane(2e5, 1e-3, 5.0, relaxation=one), relaxation=other).numbers
             for one, other in ((SERIES, None), (None, SERIES))]  # fmt: skip
    assert not np.array_equal(*skins)
    assert stiff.touch([pressed(2e-3)], State.unpack(state.pack()), 0.1)[1].finite  # of which nobody knows
    (_,), state = Simulator(sim.layer, Winkler()).touch([pressed(2e-3)], State(), 0.1)
    assert Simulator(sim.layer, Winkler()).touch([pressed(2e-3)], state, 0.1)[0][0].trust.ok


def test_a_step_without_time_takes_no_tool_away(sim: Simulator) -> None:
    rubs = Simulator(sim.layer, Winkler(), friction=0.5)
    _, state = played(rubs, np.array([0, 0.1, 0.2]), np.array([-1e-4, 2e-3, 2e-3]))
    dragged = pressed(2e-3, x=1e-3)
    (touch,), state = rubs.touch((one for one in [dragged]), state, 0.01)
    assert touch.slip is not None and np.abs(touch.slip.wrench[:3]).max() > 0.02 * touch.force
    _, same = rubs.touch([], state, 0.0)
    assert same.pack() == state.pack()
    (again,), _ = rubs.touch([dragged], same, 0.0)
    np.testing.assert_allclose(again.wrench, touch.wrench, rtol=1e-6)
    _, gone = rubs.touch([], state, 0.01)
    assert np.abs(rubs.touch([dragged], gone, 0.01)[0][0].slip.wrench).max() < 1e-9  # type: ignore[union-attr]
    assert np.array_equal(rubs.answer(one for one in [touch]).displacement, rubs.answer([touch]).displacement)


def test_time_without_end_is_refused(sim: Simulator) -> None:
    _, state = sim.touch([pressed(2e-3)], State(), 0.1)
    assert sim.touch([pressed(2e-3)], state, 1e9)[1].finite
    for dt in (np.inf, np.nan, -1.0):
        with pytest.raises(InvalidInput):
            sim.touch([pressed(2e-3)], state, dt)


def test_a_tool_that_was_not_told_of_for_a_while_presses_again(sim: Simulator) -> None:
    touches, state = played(sim, np.array([0, 0.1, 0.2]), np.array([-1e-4, 2e-3, 2e-3]))
    _, state = sim.touch([], state, 0.05)
    (touch,), _ = sim.touch([pressed(2e-3)], state, 0.05)
    assert touch.status == BY_POSE and touch.force == pytest.approx(touches[-1].force, rel=0.1)


def test_another_surface_under_the_same_name_remembers_nothing(sim: Simulator) -> None:
    _, state = played(sim, np.array([0, 0.1, 5.0]), np.array([-1e-4, DEPTH, DEPTH]))
    other = ball(6e-3).named(BALL.name)
    here = Contact(other, at(MIDDLE[0], MIDDLE[1], 6e-3 - 2e-3))
    simulator = Simulator(sim.layer, Winkler())
    (fresh,), clean = simulator.touch([here], State(), 0.1)
    (touch,), after = simulator.touch([here], state, 0.1)
    assert touch.wrench.tobytes() == fresh.wrench.tobytes()
    assert State({other.name: after.tools[other.name]}).pack() == clean.pack()
    (same,), _ = sim.touch([pressed(DEPTH)], State.unpack(state.pack()), 0.1)
    assert same.force < 0.8 * sim.touch([pressed(DEPTH)])[0].force


def test_what_another_surface_of_a_name_made_relax_is_in_the_bound_until_it_is_back(sim: Simulator) -> None:
    _, state = played(sim, np.array([0, 0.1, 5.0]), np.array([-1e-4, DEPTH, DEPTH]))
    here = at(MIDDLE[0], MIDDLE[1], RADIUS - DEPTH)
    (held,), _ = sim.touch([Contact(BALL, here)], state, 0.01)
    swap = ball(RADIUS * 1.01)
    swapped = [sim.touch([Contact(swap.named(name), here)], state, 0.01) for name in (BALL.name, "other")]
    (same, other), (later, _) = ([touch for (touch,), _ in swapped], [state for _, state in swapped])
    assert same.force == other.force and same.force_bound == other.force_bound
    assert same.force - held.force < same.force_bound
    for _ in range(3):
        (touch,), later = sim.touch([Contact(swap.named(BALL.name), here)], later, 0.01)
        assert touch.force_bound > held.force_bound + 0.5 * (same.force - held.force)
    _, later = sim.touch([], later, 1e4)
    assert not later.tools


def test_a_ball_that_rolls_comes_to_fresh_skin_and_one_that_spins_without_friction_or_turns_in_the_air_does_not(sim):
    """Whatever place of the tool is at the contact: without friction a ball does not feel how it is turned."""

    def after(way: float, angle: float, lift: float = 0.0) -> float:
        deep, state = DEPTH, State()
        (_, state), steps = sim.touch([pressed(deep)], state, 0.0), 20
        _, state = sim.touch([pressed(deep)], state, 100.0)
        if lift:
            _, state = sim.touch([pressed(-lift)], state, 0.01)
        for k in range(1, steps + 1):
            pose = turn((0, 1, 0), angle * k / steps, (MIDDLE[0] + way * k / steps, MIDDLE[1], RADIUS - deep + lift))
            (touch,), state = sim.touch([Contact(BALL, pose)], state, 0.01)
        if lift:
            pose = turn((0, 1, 0), angle, (MIDDLE[0] + way, MIDDLE[1], RADIUS - deep))
            (touch,), _ = sim.touch([Contact(BALL, pose)], state, 0.01)
        return touch.force

    still, slides, back = after(0.0, 0.0), after(0.02, 0.0), after(0.0, 0.0, 1e-3)
    assert slides > 1.4 * still
    assert after(0.02, 0.02 / RADIUS) == pytest.approx(slides, rel=0.02)
    assert after(0.0, 1.5) == pytest.approx(still, rel=0.02)
    assert after(0.0, 1.5, 1e-3) == pytest.approx(back, rel=0.02)


@pytest.mark.parametrize("friction", [None, "dry"])
def test_by_wrench_a_contact_that_goes_over_the_skin_is_fresh_however_the_tool_does_and_the_way_is_cut(
        sim: Simulator, friction: str | None) -> None:  # fmt: skip
    """A friction of nothing is told, so skin goes along with no tool, not even with one of dry steel."""
    rubbed = Simulator(sim.layer, Winkler(), sim.tools, friction=friction)

    def after(way: float, angle: float, steps: int) -> float:
        (touch,), state = rubbed.touch([pressed(DEPTH, (0, 0, -0.5))], State(), 0.0)
        (touch,), state = rubbed.touch([pressed(DEPTH, (0, 0, -0.5))], state, 20.0)
        for k in range(1, steps + 1):
            pose = turn((0, 1, 0), angle * k / steps, (MIDDLE[0] + way * k / steps, MIDDLE[1], RADIUS - DEPTH))
            (touch,), state = rubbed.touch([Contact(BALL, pose, np.array([0, 0, -0.5, 0, 0, 0]))], state, 1.0 / steps)
        return touch.depth

    still, slides = after(0.0, 0.0, 20), after(0.03, 0.0, 1)
    assert still > 1.05 * slides
    for steps in (4, 40):
        assert after(0.03, 0.0, steps) == pytest.approx(slides, rel=0.01)
        assert after(0.03, 0.03 / RADIUS, steps) == pytest.approx(slides, rel=0.015)
        assert after(0.0, 1.5, steps) == pytest.approx(still, rel=0.01)


def test_by_wrench_skin_goes_along_with_a_tool_as_far_as_its_friction_drags_it(sim: Simulator) -> None:
    """A ball that pulls at its skin, and goes as far as that gives, stays on the skin that has relaxed."""
    rubbed, way, depths = Simulator(sim.layer, Winkler(), sim.tools, friction=1.0), 0.0, []
    for pull in (0.0, 0.2):
        (touch,), state = rubbed.touch([pressed(DEPTH, (0, 0, -0.5))], State(), 0.0)
        (touch,), state = rubbed.touch([pressed(DEPTH, (0, 0, -0.5))], state, 20.0)
        for k in range(1, 21):
            wrench = np.array([pull * k / 20, 0, -0.5, 0, -pull * k / 20 * (RADIUS - DEPTH), 0])
            (touch,), state = rubbed.touch([Contact(BALL, at(MIDDLE[0] + way, MIDDLE[1], RADIUS - DEPTH), wrench)],
                                           state, 0.05)  # fmt: skip
            assert touch.slip is not None
            way = float(touch.slip.offset[0])
        depths.append(touch.depth)
    assert way > 2e-4 and depths[1] == pytest.approx(depths[0], rel=0.01)


def test_a_state_that_is_none_or_not_finite_is_refused(sim: Simulator) -> None:
    _, state = sim.touch([pressed(DEPTH)], State(), 0.1)
    memory = state.tools[BALL.name]
    broken = memory.with_(pose=np.full((4, 4), np.nan))
    for one, why in ((3, "is 3; a Memory is needed"), (broken, "has numbers that are not finite")):
        with pytest.raises(InvalidInput, match=f"state of {BALL.name} {why}"):
            sim.touch([pressed(DEPTH)], State({BALL.name: one}), 0.1)  # type: ignore[dict-item]


def test_skin_that_a_tool_left_sunk_is_told_of_where_that_is_left_out_of_the_contacts(sim: Simulator) -> None:
    deep, apart = (Contact(BALL, at(0, 0, RADIUS - depth)) for depth in (DEPTH, -1e-3))
    state = State()
    for _ in range(8):
        _, state = sim.touch([deep], state, 0.5)
    away, after = sim.touch([apart], state, 0.05)

    def told(touches: list[Touch], by: Simulator = sim, state: State | None = None) -> bool:
        return "probe was left out of the contacts" in by.answer(touches, state).trust.why

    assert not told(away) and sim.answer(away).displacement.any()
    for dt in (0.0, 0.05):
        none, _ = sim.touch([], state, dt)
        assert told(none) and told(list(none)) and not sim.answer(none).trust.in_range
    other = Simulator(sim.skin, tools=sim.tools)  # as a node's, which finds fields beside the reactions
    assert told([], other, after) and not told([], other) and not told(away, other, after)
    for _ in range(40):
        _, after = sim.touch([apart], after, 60.0)
    assert not told(sim.touch([], after, 0.05)[0]), "it is back"


def test_an_imprint_whose_tool_was_taken_away_is_told_of(sim: Simulator) -> None:
    simulator = Simulator(sim.layer, Winkler())
    touches, _ = played(simulator, np.array([0, 0.1, 5.0, 5.01]), np.array([-1e-4, DEPTH, DEPTH, -1e-3]))
    assert simulator.answer(touches[-1:]).displacement.any()
    simulator.tools.remove(BALL.name)
    answer = simulator.answer(touches[-1:])
    assert not answer.displacement.any() and "taken away" in answer.trust.why and not answer.trust.in_range


def test_two_tools_by_wrench_keep_a_state_each(sim: Simulator) -> None:
    state, other, push = State(), BALL.named("other"), np.array([0, 0, -0.4, 0, 0, 0.0])
    for dt in (0.0, 0.1, 1.0, 10.0):
        pair = [Contact(BALL, at(-0.012, 0, RADIUS - 2e-3), push), Contact(other, at(0.012, 0, RADIUS - 2e-3), push)]
        touches, state = sim.touch(pair, state, dt)
        assert [touch.name for touch in touches] == ["probe", "other"] and set(state.tools) == {"probe", "other"}
        assert all(touch.wrench[2] == pytest.approx(-0.4, rel=0.02) for touch in touches)
    one, two = (state.tools[name].scalars.elastic for name in ("probe", "other"))
    assert one == pytest.approx(two, rel=0.05) and one > 0.6


def test_materials_share_a_stacks_relaxation() -> None:
    stack = Tissue(3e3, 0.45, skin=Membrane(2e5, 1.5e-3, 15.0), deeper=(Ply(1e-2, 1.5e4),))
    assert not len(series_of(stack, 0.04).times)
    fat = series_of(Tissue(3e3, 0.45, skin=stack.skin, deeper=stack.deeper, relaxation=SERIES), 0.04)
    muscle = series_of(Tissue(3e3, 0.45, skin=stack.skin, deeper=(Ply(1e-2, 1.5e4, relaxation=SERIES),)), 0.04)
    assert fat.times.tolist() == muscle.times.tolist() == list(SERIES.times)
    assert 0 < muscle.shares.sum() < fat.shares.sum() and fat.shares.sum() + muscle.shares.sum() < 0.45
    np.testing.assert_allclose(series_of(Tissue(3e3, 0.45, relaxation=SERIES), 0.04).shares, SERIES.shares)


@pytest.mark.parametrize("radius, left", [(12e-3, 0.662), (30e-3, 0.571)])
def test_of_materials_that_fade_apart_as_much_is_left_as_of_relaxed_moduli(radius: float, left: float) -> None:
    """Share by axisymmetric finite elements of a ball 4 mm deep, where the muscle alone fades by 80 %."""
    muscle = Ply(8e-3, 2e4, 0.42, relaxation=Prony((0.8,), (1.0,)))
    tissue = Tissue(3e3, 0.42, skin=Membrane(1.3e5, 1.5e-3, tension=11.0), deeper=(muscle,))
    contact = pressed_ball(tissue, 20e-3, radius, depth=4e-3).contact_radius
    fades = float(series_of(tissue, 20e-3).shares.sum()) * fades_under(tissue, 20e-3, contact)
    assert 1 - fades == pytest.approx(left, rel=0.06)


def test_the_bound_counts_what_another_tool_made_relax(sim: Simulator) -> None:
    """Relaxation is remembered by tool, so another meets skin that is answered as fresh."""
    found = []
    for name in ("first", "second"):
        state, touch = State(), None
        press = (("first", DEPTH, 0.0), ("first", DEPTH, 10.0), ("first", -1e-3, 1e-3))
        for tool, depth, dt in (*press, (name, DEPTH, 1e-3)):
            contact = Contact(BALL.named(tool), pressed(depth).pose_body_from_tool)
            (touch,), state = sim.touch([contact], state, dt)
        assert touch is not None
        found.append(touch)
    same, other = found
    assert other.force > 1.3 * same.force
    assert other.force - same.force < other.force_bound < other.force
