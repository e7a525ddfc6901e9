"""Laws of tools in one place: one that is announced twice, a pad and its cover, a fingertip inside a palm."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from stmpl_core import Contact, Membrane, Ply, Simulator, SoftLayer, Tissue, Tool
from stmpl_core.contact_net import Held
from stmpl_core.green import Green
from stmpl_core.methods import MomentNet
from stmpl_core.nodes import Nodes
from stmpl_core.toucher import Toucher
from stmpl_core.twins import Twins, covered, twins
from tests.scenes import RADIUS, at, ball, box, limb, tool

THICK, LONG = 0.0125, 0.24
ONE = Tissue(2e4, 0.4)
LAYERED = Tissue(5e3, 0.45, skin=Membrane(8e4, 1.2e-3, 10.0), deeper=(Ply(6e-3, 2e4, 0.45),))
BALL, TWIN, THIRD = (ball(0.008).named(name) for name in ("ball", "twin", "third"))
PALM, TIP = ball(0.02).named("palm"), ball(0.008).named("tip")


@pytest.fixture(scope="module", params=[ONE, LAYERED], ids=["one", "layered"])
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return Simulator(limb(4e-3, THICK, length=LONG).with_(tissue=request.param), MomentNet())


def on(depth: float, aside: float = 0.0, radius: float = 0.008) -> np.ndarray:
    """So deep in the limb's side, and so far around it [m]."""
    out = at(RADIUS + radius - depth, 0, LONG / 2)
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0, 0, aside / RADIUS]).as_matrix()
    return turned @ out


@pytest.mark.parametrize("shape", [ball(0.008), box(0.016, 0.02, 0.016)], ids=["ball", "box"])
def test_tools_in_one_place_press_together_as_one_does(simulator: Simulator, shape: Tool) -> None:
    (alone,) = simulator.touch([Contact(shape, on(6e-3))])
    for many in (2, 3):
        touches = simulator.touch([Contact(shape.named(f"{k}"), on(6e-3)) for k in range(many)])
        forces = [touch.force for touch in touches]
        assert sum(forces) == pytest.approx(alone.force, rel=1e-4)
        assert forces == pytest.approx(many * [alone.force / many], rel=1e-4)
    for gap in (1e-7, 1e-6, 1e-5, 1e-4):  # beside it
        touches = simulator.touch([Contact(shape.named("one"), on(6e-3)), Contact(shape.named("two"), on(6e-3, gap))])
        assert sum(touch.force for touch in touches) == pytest.approx(alone.force, rel=0.02)


def test_tools_that_cover_no_place_together_are_seen_as_they_are(simulator: Simulator) -> None:
    touches = simulator.touch([Contact(BALL, on(2e-3)), Contact(TWIN, on(2e-3, 0.016))])
    nodes = simulator.toucher.joined([(touch.pressed.field, touch.pose_body_from_tool, touch.pressed.squeeze)
                                      for touch in touches if touch.pressed])  # fmt: skip
    assert len(nodes.beside) == len(nodes.area) and (nodes.beside <= 0).all()
    held, plain = (simulator.toucher.net.hold(one) for one in (nodes, nodes._replace(beside=np.empty((0, 0)))))
    np.testing.assert_array_equal(held.pressure, plain.pressure)


@pytest.mark.parametrize("gap", [1e-6, 2.8e-6, 1e-5, 1e-4])
def test_two_tools_in_one_place_move_the_skin_as_one_does(simulator: Simulator, gap: float) -> None:
    alone = simulator.step([Contact(BALL, on(3e-3))])
    both = simulator.step([Contact(BALL, on(3e-3)), Contact(TWIN, on(3e-3, gap))])
    three = simulator.step([Contact(BALL, on(3e-3)), Contact(TWIN, on(3e-3, gap)), Contact(THIRD, on(3e-3, -gap))])
    for answer, most in ((both, 0.01 + 250 * gap), (three, 0.1)):  # 240 nodes of one material: by vertices
        off = np.linalg.norm(answer.displacement - alone.displacement, axis=1).max()
        assert off < most * alone.magnitude.max()
    assert both.trust.error_bound == pytest.approx(alone.trust.error_bound, rel=0.1)


def test_what_covers_a_tool_by_less_than_it_is_deep_moves_the_skin_as_the_deeper_one(simulator: Simulator) -> None:
    alone = simulator.step([Contact(BALL, on(3e-3))])
    for less in (1e-6, 2e-5, 1e-4):
        both = simulator.step([Contact(BALL, on(3e-3)), Contact(TWIN, on(3e-3 - less, 3e-6))])
        off = np.linalg.norm(both.displacement - alone.displacement, axis=1).max()
        assert off < 0.02 * alone.magnitude.max()


def test_nothing_jumps_while_tools_part(simulator: Simulator) -> None:
    """By 50 um at a time from one place on; a ball alone that goes so far changes 2 % of the peak."""
    before = None
    for gap in np.arange(0, 1.2e-3, 5e-5):
        answer = simulator.step([Contact(BALL, on(2e-3)), Contact(TWIN, on(2e-3, gap))])
        if before is not None:
            assert np.linalg.norm(answer.displacement - before, axis=1).max() < 0.03 * answer.magnitude.max()
        before = answer.displacement


def test_tools_apart_and_a_tool_alone_know_nothing_of_it(simulator: Simulator,
                                                         monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    scenes = [[Contact(BALL, on(3e-3))], [Contact(BALL, on(3e-3)), Contact(TWIN, on(2e-3, 0.03))]]
    found = [simulator.step(contacts).displacement for contacts in scenes]
    monkeypatch.setattr("stmpl_core.simulator.going_together", lambda touches: touches)
    monkeypatch.setattr("stmpl_core.stick.twins", lambda *_: (np.empty((0, 2), np.int64), np.empty(0)))
    for contacts, displacement in zip(scenes, found, strict=True):
        np.testing.assert_array_equal(simulator.step(contacts).displacement, displacement)


def test_twins_go_their_mean_way_whatever_they_differ_by(simulator: Simulator) -> None:
    (touch,) = simulator.touch([Contact(BALL, on(3e-3))])
    assert touch.pressed and touch.pressed.forces is not None
    green, nodes = Green.of(simulator.layer), touch.pressed.squeeze.nodes.some(touch.pressed.forces > 0)
    both = Nodes.joined([nodes, nodes._replace(points=nodes.points + [0, 1e-6, 0])])
    group, of = np.zeros(len(both.area), np.int64), np.repeat([0, 1], len(nodes.area))
    same = Twins(*twins(both.points, both.inward, both.area, group, of))
    gone, aside = nodes.depths[:, None] * nodes.inward, nodes.depths[:, None] * [0, 0.1, 0]
    guess = np.zeros_like(both.points)
    one = green.stuck(nodes, group[: len(gone)], gone, np.zeros_like(gone))
    for differ in (0, aside):
        forces = green.stuck(both, group, np.concatenate([gone - differ, gone + differ]), guess, same)
        left, right = np.split(forces, 2)
        assert np.abs(left + right - one).max() < 0.01 * np.abs(one).max()
        assert np.abs(left - right).max() < 2 * np.abs(one).max()


def test_pairs_and_what_is_covered_are_told_tool_by_tool(simulator: Simulator) -> None:
    (touch,) = simulator.touch([Contact(BALL, on(3e-3))])
    assert touch.pressed
    nodes = touch.pressed.squeeze.nodes
    count, group = len(nodes.area), np.zeros(2 * len(nodes.area), np.int64)
    of = np.repeat([0, 1], count)
    both = Nodes.joined([nodes, nodes])
    pairs, share = twins(both.points, both.inward, both.area, group, of)
    assert len(pairs) == count and (np.diff(pairs, axis=1) == -count).all()
    np.testing.assert_allclose(share, 1.0)
    assert not len(twins(both.points, both.inward, both.area, of, of)[1])
    whole = covered(both.points, both.inward, both.area, both.strain, of, 2)
    np.testing.assert_allclose(whole, [[0, 1], [1, 0]])
    far = np.concatenate([nodes.points, nodes.points + [0, 0, 0.03]])
    assert not covered(far, both.inward, both.area, both.strain, of, 2).any()


@pytest.mark.parametrize("depth", [0.0, 1e-3, 2e-3, 3e-3])
def test_a_tool_that_another_one_covers_presses_nothing_and_is_no_broken_mesh(simulator: Simulator,
                                                                              depth: float) -> None:  # fmt: skip
    answer = simulator.step([Contact(PALM, on(4e-3, radius=0.02)), Contact(TIP, on(depth, 0.004))])
    tip = answer.touches["tip"]
    assert tip.force < 0.1 and tip.trust.ok and answer.trust.ok, answer.trust.why


@pytest.mark.parametrize("aside", [0.03, 0.004, None])
def test_a_tool_that_presses_nothing_is_flagged_alone_and_beside_others_that_do_not_cover_it(
    simulator: Simulator, monkeypatch: pytest.MonkeyPatch, aside: float | None
) -> None:
    """Even under another one where it would not press alone."""
    (alone,) = simulator.touch([Contact(TIP, on(1e-3, aside or 0.0))])
    assert alone.pressed
    count, hold = len(alone.pressed.squeeze.nodes.area), simulator.toucher.net.hold

    def broken(nodes: Nodes) -> Held:
        held = hold(nodes)
        return held._replace(pressure=np.r_[held.pressure[:-count], np.zeros(count)])

    monkeypatch.setattr(simulator.toucher.net, "hold", broken)
    others = [] if aside is None else [Contact(PALM, on(4e-3 if aside < 0.01 else 1e-3, radius=0.02))]
    *_, tip = simulator.touch([*others, Contact(TIP, on(1e-3, aside or 0.0))])
    assert tip.force == 0 and not tip.trust.in_range and "check its mesh" in tip.trust.why


def test_the_skin_is_off_a_tool_only_where_others_hold_it_further_in(simulator: Simulator) -> None:
    toucher: Toucher = simulator.toucher
    palm, tip = (simulator.touch([Contact(PALM, on(4e-3, radius=0.02))])[0],
                 simulator.touch([Contact(TIP, on(2e-3, 0.004))])[0])  # fmt: skip
    assert palm.pressed and tip.pressed
    nodes = Nodes.joined([palm.pressed.squeeze.nodes, tip.pressed.squeeze.nodes])
    apart = toucher.net.apart(nodes)[len(palm.pressed.squeeze.nodes.area) :]
    assert apart.all()
    assert not toucher.net.apart(tip.pressed.squeeze.nodes).all()


def test_three_tools_that_cross_press_as_they_did_a_nanometre_ago():
    """Their problem takes more steps than others; cut short, the capsule's force was anything within 2 %."""
    side = np.linspace(-0.04, 0.04, 28)
    corner = (28 * np.arange(27)[:, None] + np.arange(27)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 29], corner[:, None] + [0, 29, 28]])
    skin = SoftLayer(np.array([(x, y, 0.0) for y in side for x in side]), faces, thickness=7.5e-3, tissue=ONE)
    simulator = Simulator(skin, MomentNet())
    pill = trimesh.creation.capsule(0.03, 0.008)
    pill.apply_translation(-pill.center_mass)
    tools = [ball(0.012).named("ball"), tool(pill).named("capsule"),
             tool(trimesh.creation.cone(0.012, 0.02)).named("cone")]  # fmt: skip
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = np.array([[-1.48148148, -16.2962963, 6.85656453], [-10.3703704, -4.44444444, 14.2857608],
                                [-1.48148148, -7.40740741, 14.6147251]]) * 1e-3  # fmt: skip
    poses[:, :3, :3] = Rotation.from_rotvec([
        [-1.75346245, -2.31714896, 0.581784109], [-0.804960822, -0.143039679, 0.453985622],
        [0.366539166, -2.55888787, -0.701740073]]).as_matrix()  # fmt: skip
    rng, forces = np.random.default_rng(1), []
    for _ in range(8):
        moved = poses.copy()
        moved[:, :3, 3] += 1e-9 * rng.normal(size=(3, 3))
        forces.append([touch.force for touch in simulator.touch(list(map(Contact, tools, moved)))])
    assert (np.ptp(forces, axis=0) < 2e-3 * np.mean(forces, axis=0)).all()
