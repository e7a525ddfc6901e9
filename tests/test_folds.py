"""Laws of skin that is near itself: what is near through the air is not felt."""

import numpy as np
import pytest

from stmpl_core import Contact, Load, Membrane, Ply, SoftLayer, Tissue
from stmpl_core.methods import LimbLinear, Linear, MomentNet
from stmpl_core.simulator import Simulator
from stmpl_core.thinning import SPACINGS, ZONES, Thinning
from tests.scenes import at, ball, limb, plate

GAP, LONG, THICKNESS = 1.5e-3, 0.06, 4e-3  # m
METHODS = [MomentNet, Linear]


def fingers() -> SoftLayer:
    """Two flat fingers side by side, 1.5 mm apart, which meet at their root."""
    h = 2e-3
    columns = np.concatenate([-GAP / 2 - h * np.arange(8)[::-1], GAP / 2 + h * np.arange(8)])
    x, y = np.meshgrid(columns, np.arange(0, LONG + 0.02, h))
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    between = np.broadcast_to(np.arange(x.shape[1] - 1) == 7, a.shape) & (y[:-1, :-1] < LONG)
    faces = np.concatenate([np.stack(t, axis=-1)[~between] for t in ((a, b, c), (a, c, d))])
    return SoftLayer(np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), faces, THICKNESS)


FINGERS = fingers()
LAYERED = FINGERS.with_(tissue=Tissue(3e3, 0.45, skin=Membrane(1.3e5, 1.2e-3, 11.0), deeper=(Ply(2e-3, 15e3, 0.45),)))
LEFT = FINGERS.vertices[:, 0] < 0
SPOT = np.array([-0.004, 0.02, 0.0])  # on the left one, far from the root


def around(spot: np.ndarray, radius: float) -> np.ndarray:
    return np.clip(1 - (np.linalg.norm(FINGERS.vertices - spot, axis=1) / radius) ** 2, 0, 1)


@pytest.mark.parametrize("method", METHODS)
def test_pressing_one_finger_does_not_move_the_other(method: type) -> None:
    answer = method().prepare(FINGERS).solve(Load.pressure(400 * around(SPOT, 6e-3) * LEFT))
    root = FINGERS.vertices[:, 1] > LONG - 8 * THICKNESS
    assert answer.magnitude[LEFT].max() > 5e-4
    assert not answer.magnitude[~LEFT & ~root].any()


@pytest.mark.parametrize("method", METHODS)
def test_two_fingers_pressed_at_once_move_as_each_alone(method: type) -> None:
    prepared = method().prepare(FINGERS)
    left = 400 * around(SPOT, 6e-3) * LEFT
    right = 300 * around(SPOT * [-1, 1, 1], 6e-3) * ~LEFT
    both, one, other = (prepared.solve(Load.pressure(p)).displacement for p in (left + right, left, right))
    np.testing.assert_allclose(both, one + other, atol=5e-7)  # of 2 mm; at the root they do feel each other


def test_tools_on_two_fingers_press_as_each_alone() -> None:
    simulator, tip = Simulator(FINGERS, MomentNet()), ball(0.005)
    poses = [at(side * 0.006, 0.02, 0.005 - 1e-3) for side in (-1, 1)]
    contacts = [Contact(tip.named(name), pose) for name, pose in zip("ab", poses, strict=True)]
    together = simulator.step(contacts)
    alone = [simulator.step([contact]) for contact in contacts]
    for name, one in zip("ab", alone, strict=True):
        np.testing.assert_allclose(together.touches[name].wrench, one.touches[name].wrench, rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(together.displacement, alone[0].displacement + alone[1].displacement, atol=2e-6)


def test_a_finger_with_layers_does_not_move_the_other_either() -> None:
    """The coarse part takes off what the flat stack says only where that is felt: not on the other finger."""
    simulator, tip = Simulator(LAYERED, MomentNet()), ball(4e-3)
    by_hand = LimbLinear().prepare(LAYERED).solve(Load.pressure(400 * around(SPOT, 6e-3) * LEFT))
    pressed = simulator.step([Contact(tip, at(-0.003, 0.02, 3e-3))])
    root = FINGERS.vertices[:, 1] > LONG - 8 * THICKNESS
    for answer in (by_hand, pressed):
        assert answer.magnitude[~LEFT & ~root].max() < 1e-3 * answer.magnitude[LEFT].max()


def test_where_skin_is_near_itself_is_known_and_plain_limbs_are_not_held_up() -> None:
    frames = np.broadcast_to(np.eye(3), (len(FINGERS.vertices), 3, 3))
    assert Thinning(FINGERS, frames, 8.0).folded
    for layer in (limb(4e-3), plate()):
        assert not Thinning(layer, np.broadcast_to(np.eye(3), (len(layer.vertices), 3, 3)), 8.0).folded


def test_all_that_is_in_reach_along_the_skin_is_a_neighbour() -> None:
    layer = limb(4e-3)
    thinning = Thinning(layer, np.broadcast_to(np.eye(3), (len(layer.vertices), 3, 3)), 8.0)
    assert len(thinning.levels[1].stands) < len(layer.vertices)
    farther = 8.0 + 2 * SPACINGS[0]  # what stands for others around may be so much farther
    for level, reach in zip(thinning.levels, (ZONES[0], farther), strict=True):
        at, normals = level.rows[:, :3], level.rows[:, 3:6]
        for v in range(0, len(at), 97):
            away = np.linalg.norm(at - at[v], axis=1) / layer.thickness[0]
            expected = np.flatnonzero((away < reach) & (normals @ normals[v] > 0))
            found = level.index[level.start[v] : level.start[v + 1]]
            np.testing.assert_array_equal(np.sort(found), expected)


def test_one_contact_is_one_group_however_many_nodes_share_a_vertex() -> None:
    """A finger beside another presses as hard as the same finger alone, whose skin has no fold."""
    alone = FINGERS.vertices[:, 0] < 0
    number = np.cumsum(alone) - 1
    single = SoftLayer(FINGERS.vertices[alone], number[FINGERS.faces[alone[FINGERS.faces].all(axis=1)]], THICKNESS)
    tip, pose = ball(0.005), at(-0.008, 0.03, 0.005 - 1e-3)
    beside, one = (Simulator(layer, MomentNet()).touch([Contact(tip, pose)])[0].force for layer in (FINGERS, single))
    assert beside == pytest.approx(one, rel=1e-3)
