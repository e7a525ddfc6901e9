"""Laws of haptics: local models that hold where they say, and a device loop that gives out no energy."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh

from benchmarks.device import found
from benchmarks.haptic_device import QUIET, Device, Felt, Hand, Spot, arm_spot, play
from benchmarks.haptics import HARD, forces_along, paths, settings_for, slide, worst_jump
from benchmarks.tools import ball, block_letter, fingertip, flat
from stmpl_core import Contact, Prony, SoftLayer, State, Tool, Touch
from stmpl_core.body import Body
from stmpl_core.errors import InvalidInput
from stmpl_core.haptics import DeviceLoop, LoopSettings
from stmpl_core.history import History
from stmpl_core.living import living
from stmpl_core.local_contact import DEEPER, Grip, LocalContact, local_contact, local_contacts
from stmpl_core.passive import PassiveContact
from stmpl_core.sdf import SignedDistance
from stmpl_core.touch import APART, IN_CORE
from stmpl_core.toucher import Toucher
from tests.scenes import at, contact_of, placed, plate, tool, turn

DEEP = 2e-3  # m
STILL = np.zeros(3)


def side_by_side(one: Tool, apart: float) -> Tool:
    """Two of a tool in one piece, so far apart [m]."""
    both = trimesh.util.concatenate([trimesh.Trimesh(one.vertices + [0, s * apart / 2, 0], one.faces) for s in (-1, 1)])
    return Tool("two", both.vertices, both.faces)


SHAPES = {"ball": ball(12), "fingertip": fingertip(8, 12), "capsule": fingertip(8, 60), "disc": flat(10, 2),
          "letter": block_letter("R", 30), "two": side_by_side(fingertip(8, 12), 0.02)}  # fmt: skip


def standing(layer: SoftLayer, vertex: int, depth: float) -> np.ndarray:
    """Pose of a tool that stands on z = 0, so deep in the skin at a vertex, turned about its normal."""
    out = layer.normals[vertex]
    pose = np.eye(4)
    pose[:3, :3] = turn(tuple(np.cross([0, 0, 1], out)), float(np.arccos(out[2])))[:3, :3]
    pose = pose @ turn((0, 0, 1), 0.3)
    pose[:3, 3] = layer.vertices[vertex] - depth * out
    return pose


@pytest.fixture(scope="module")
def spot() -> Spot:
    return arm_spot()


@pytest.fixture(scope="module")
def model(spot: Spot) -> LocalContact:
    return spot.model(spot.centre(-DEEP))


@pytest.fixture(scope="module")
def block() -> tuple[Toucher, Contact]:
    """A blunt box on a plate, off its own centre and tilted: every rotation matters."""
    blunt = tool(trimesh.creation.box((0.03, 0.024, 0.02), transform=at(0.004, 0.002, 0.003)), name="block")
    pose, toucher = at(0.001, 0.0007, 0.005) @ turn((0.3, 1, 0.2), 0.04), Toucher(plate())
    toucher.tools.add(blunt, SignedDistance.of(blunt, rounding=2e-3))
    return toucher, Contact(blunt, pose)


@pytest.fixture(scope="module")
def tilted(block: tuple[Toucher, Contact]) -> LocalContact:
    return local_contact(*block)


def off(truth: np.ndarray, said: np.ndarray, lever: float) -> float:
    """Largest error of force and of torque over the tool's reach, over the force."""
    force, torque = np.linalg.norm((truth - said).reshape(2, 3), axis=1)
    return float(max(force, torque / lever) / np.linalg.norm(truth[:3]))


def turned(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(twist[3:]))
    moved = turn(tuple(twist[3:] / angle), angle) @ pose if angle else pose.copy()
    moved[:3, 3] = pose[:3, 3] + twist[:3]
    return moved


def differences(wrench_at: Callable[[np.ndarray], np.ndarray], pose: np.ndarray, lever: float) -> np.ndarray:
    """d wrench / d twist by central differences, the mean over steps that the law's kinks are finer than, (6, 6)."""
    out = np.zeros((6, 6))
    for step in (4e-4, 2e-4, 1e-4, 5e-5):
        for k, twist in enumerate(np.diag(np.repeat([step, step / lever], 3))):
            out[:, k] += (wrench_at(turned(pose, twist)) - wrench_at(turned(pose, -twist))) / (8 * twist[k])
    return out


def error(found: np.ndarray, expected: np.ndarray, lever: float) -> float:
    """Difference of stiffnesses over their size, turns and torques taken at a lever [m]."""
    scale = np.outer(*2 * [np.repeat([1, 1 / lever], 3)])
    return float(np.linalg.norm(scale * (found - expected)) / np.linalg.norm(scale * expected))


@pytest.fixture(scope="module")
def forearm() -> Toucher:
    return Toucher(living(Body.anny(), "left_forearm", edge_length=4e-3))


@pytest.mark.parametrize("name, most", [("ball", 0.06), ("fingertip", 0.06), ("capsule", 0.06), ("disc", 0.08),
                                        ("two", 0.06)])  # fmt: skip
@pytest.mark.parametrize("tissue", ["paper", "living"])
def test_the_stiffness_is_that_of_differences(spot: Spot, forearm: Toucher, tissue: str, name: str,
                                              most: float) -> None:  # fmt: skip
    toucher = spot.toucher if tissue == "paper" else forearm
    place = 2443 if tissue == "living" else int(np.linalg.norm(toucher.layer.vertices - spot.place, axis=1).argmin())
    pose = standing(toucher.layer, place, 2.5e-3 if tissue == "paper" else 6e-3)
    one = SHAPES[name]
    found = local_contact(toucher, Contact(one, pose))
    expected = differences(lambda at: toucher.touch(Contact(one, at)).wrench, pose, 0.02)
    assert error(found.stiffness, expected, 0.02) < most
    along = found.normal @ expected[:3, :3] @ found.normal
    assert found.normal @ found.stiffness[:3, :3] @ found.normal == pytest.approx(along, rel=min(most, 0.1))


def test_a_letter_is_about_as_stiff_as_differences_say(spot: Spot) -> None:
    """Its sharp strokes are as wide as the nodes are apart: the law itself is rough there."""
    toucher, letter = spot.toucher, block_letter("R", 30)
    place = int(np.linalg.norm(toucher.layer.vertices - spot.place, axis=1).argmin())
    pose = standing(toucher.layer, place, 2.5e-3)
    found = local_contact(toucher, Contact(letter, pose))
    expected = differences(lambda at: toucher.touch(Contact(letter, at)).wrench, pose, 0.02)
    along = [found.normal @ one[:3, :3] @ found.normal for one in (found.stiffness, expected)]
    assert along[0] == pytest.approx(along[1], rel=0.2)


@pytest.mark.parametrize("depth", [8e-3, 11e-3, 13e-3])
def test_a_ball_that_has_sunk_under_the_skin_is_about_as_stiff_as_differences_say(depth: float) -> None:
    """Columns beside it enter it from below, whose depth is not that at the skin."""
    toucher, small = Toucher(plate(0.09, thickness=0.03)), ball(6)
    model = local_contact(toucher, Contact(small, at(0, 0, -depth)))
    step = 2e-4
    ahead, behind = (toucher.touch(Contact(small, at(0, 0, -depth + s * step))).force for s in (-1, 1))
    along = model.normal @ model.stiffness[:3, :3] @ model.normal
    assert along == pytest.approx((ahead - behind) / (2 * step), rel=0.35)


def test_a_tool_gives_way_to_the_one_beside_it(spot: Spot) -> None:
    toucher, pose = spot.toucher, spot.pose(spot.centre(-DEEP))
    places = {"left": spot.pose(spot.centre(-DEEP, -5e-3)), "right": spot.pose(spot.centre(-DEEP, 5e-3))}

    def wrenches(moved: str, at: np.ndarray) -> dict[str, np.ndarray]:
        contacts = [Contact(spot.tool.named(n), at if n == moved else p) for n, p in places.items()]
        return {touch.name: touch.wrench for touch in toucher.touch_all(contacts)}

    history = History(toucher)
    touches = toucher.touch_all([Contact(spot.tool.named(n), p) for n, p in places.items()])
    found = dict(zip(places, local_contacts(history, touches), strict=True))
    for own in places:
        expected = differences(lambda at, o=own: wrenches(o, at)[o], places[own], 0.02)
        assert error(found[own].stiffness, expected, 0.02) < 0.05
    alone = local_contact(toucher, Contact(spot.tool, pose))
    assert np.linalg.norm(alone.stiffness) > 1.05 * np.linalg.norm(found["left"].stiffness)


@pytest.mark.parametrize("friction", [None, 0.5])
def test_a_model_with_a_state_is_that_of_the_instant(spot: Spot, friction: float | None) -> None:
    """Skin that has relaxed by a third is as stiff at once as it was; a patch that sticks resists along the skin."""
    remembers = spot.with_memory(Prony((0.2, 0.2), (0.02, 0.3)), friction)
    history, state = History(remembers.toucher, friction), State()

    def step(pose: np.ndarray, dt: float) -> tuple[Touch, State]:
        touches, after = history.step([Contact(spot.tool, pose)], state, dt)
        return touches[0], after

    for k in range(60):
        pose = spot.pose(spot.centre(-DEEP * min(k, 30) / 30, 2e-4 * min(max(k - 30, 0), 6)))
        touch, state = step(pose, 0.01)
    model = local_contacts(history, [touch], state)[0]
    np.testing.assert_allclose(model.wrench_at(pose).wrench, touch.wrench, rtol=1e-6, atol=1e-9)
    expected = np.empty((6, 6))
    for k in range(6):
        twist = 5e-5 * np.eye(6)[k] / (1 if k < 3 else 0.02)
        expected[:, k] = (step(turned(pose, twist), 0.0)[0].wrench - step(turned(pose, -twist), 0.0)[0].wrench) / \
            (2 * twist[k])  # fmt: skip
    assert error(model.stiffness, expected, 0.02) < (0.05 if friction is None else 0.12)  # the patch creeps a little
    assert (model.grip is None) == (friction is None)


def test_what_presses_knows_of_no_friction(spot: Spot) -> None:
    """Friction goes along with the contact: its arm about the tool's origin stays. A push that grew is stiffer so."""
    remembers = spot.with_memory(None, 0.5)
    history, state = History(remembers.toucher, 0.5), State()
    for k in range(12):
        pose = spot.pose(spot.centre(-DEEP, 4e-4 * k))
        (touch,), state = history.step([Contact(spot.tool, pose)], state, 0.01)
    assert touch.slip is not None and np.linalg.norm(touch.slip.wrench[:3]) > 0.1 * touch.force
    rubbed = local_contacts(history, [touch], state)[0]
    straight = local_contact(remembers.toucher, Contact(spot.tool, pose))
    assert 1 < touch.slip.grown < 1.05
    expected = touch.slip.grown * straight.stiffness
    np.testing.assert_allclose(rubbed.push_stiffness, expected, atol=1e-6 * np.abs(expected).max())


def test_a_tool_at_the_core_is_as_stiff_as_differences_say(spot: Spot) -> None:
    deep = spot.pose(spot.centre(-9e-3))
    model = local_contact(spot.toucher, Contact(spot.tool, deep))
    assert model.status == IN_CORE
    step = 1e-4 * spot.out
    ahead, behind = (spot.toucher.touch(Contact(spot.tool, spot.pose(deep[:3, 3] + s * step))).force for s in (-1, 1))
    along = -model.normal @ model.stiffness[:3, :3] @ spot.out
    assert along == pytest.approx((ahead - behind) / 2e-4, rel=0.15)


def test_friction_of_a_model_keeps_to_its_cone_and_nothing_grows_without_bound(spot: Spot) -> None:
    rubbing = spot.with_memory(None, 0.5)
    history = History(rubbing.toucher, 0.5)
    touches, state = history.step([Contact(spot.tool, spot.pose(spot.centre(-1e-3)))], State(), 0.0)
    touches, state = history.step([Contact(spot.tool, spot.pose(spot.centre(-DEEP, 5e-4)))], state, 0.01)
    model = local_contacts(history, touches, state)[0]
    assert model.grip is not None and np.linalg.norm(model.grip.wrench[:3]) > 0.1 * touches[0].force
    plain = replace(model, wrench=model.push, stiffness=model.push_stiffness, grip=None)
    rng, most = np.random.default_rng(0), float(np.linalg.norm(model.push_stiffness[:3, :3], 2)) * model.valid_m
    turns, force = float(np.linalg.norm(model.push_stiffness[:3, 3:], 2)) * model.valid_rad, touches[0].force
    depth = model.power * force / (model.normal @ model.push_stiffness[:3, :3] @ model.normal)
    grown = force * (1 + max(1.0, DEEPER / depth)) ** model.power
    for size in (1e-4, 1e-3, 1e-2, 1.0):
        for twist in size * rng.normal(size=(50, 6)) * np.repeat([1, 30], 3):
            pose = turned(model.pose_body_from_tool, twist)
            push, both = plain.wrench_at(pose).wrench, model.wrench_at(pose).wrench
            pressing = float(model.normal @ push[:3])
            assert pressing >= 0
            assert pressing <= 1.001 * grown
            assert np.linalg.norm(push[:3]) <= 1.001 * grown * (1 + (most + turns) / force)
            drag = (both - push)[:3]
            assert abs(drag @ model.normal) < 0.05 * model.grip.limit * pressing + 1e-9
            assert np.linalg.norm(drag) <= 1.001 * model.grip.limit * pressing


def test_the_model_is_the_reaction_at_its_own_pose(spot: Spot, model: LocalContact) -> None:
    rendered = model.wrench_at(model.pose_body_from_tool)
    np.testing.assert_allclose(rendered.wrench, model.wrench, atol=1e-12)
    np.testing.assert_allclose(rendered.wrench[:3], spot.force(spot.centre(-DEEP)), atol=1e-12)
    assert rendered.inside and model.normal @ spot.out < -0.9


def test_a_stylus_turns_about_a_far_grip_only_as_far_as_its_tip_may_go_aside(spot: Spot) -> None:
    """Told about a grip 0.1 m above its tip it claimed some 19 degrees, at which the tip had gone 33 mm aside."""
    mesh = trimesh.creation.capsule(0.14, 0.005)
    mesh.apply_translation([0, 0, -0.1 - mesh.bounds[0, 2]])
    stylus, first = tool(mesh), np.cross(spot.out, np.eye(3)[np.abs(spot.out).argmin()])
    first /= np.linalg.norm(first)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([first, np.cross(spot.out, first), spot.out])
    pose[:3, 3] = spot.place + (0.1 - DEEP) * spot.out
    model = local_contact(spot.toucher, Contact(stylus, pose))
    assert np.radians(0.05) < model.valid_rad < np.radians(1)
    for axis in (first, pose[:3, 1]):
        there = turned(pose, np.concatenate([np.zeros(3), 0.99 * model.valid_rad * axis]))
        truth, rendered = spot.toucher.touch(Contact(stylus, there)), model.wrench_at(there)
        assert rendered.inside
        assert np.linalg.norm(rendered.wrench[:3] - truth.wrench[:3]) < 0.1 * truth.force


@pytest.mark.parametrize("seed", range(3))
def test_the_model_holds_where_it_says(
    block: tuple[Toucher, Contact], tilted: LocalContact, seed: int
) -> None:
    """The neighbourhood is argued, not measured: a corner of the box that comes in may take a little more."""
    toucher, contact = block
    assert tilted.valid_m > 5e-5 and tilted.valid_rad > 2e-3
    lever, rng = 0.03, np.random.default_rng(seed)
    for scale in (np.array([1, 1, 1, 0, 0, 0]), np.array([0, 0, 0, 1, 1, 1])):
        twist = scale * rng.normal(size=6)
        twist *= 0.99 * (tilted.valid_m if scale[0] else tilted.valid_rad) / np.linalg.norm(twist)
        pose = turned(contact.pose_body_from_tool, twist)
        truth = toucher.touch(contact_of(contact.tool, pose, name="block")).wrench
        rendered = tilted.wrench_at(pose)
        assert rendered.inside
        assert off(truth, rendered.wrench, lever) < 0.15
        beyond = tilted.wrench_at(turned(contact.pose_body_from_tool, 1.1 * twist))
        assert not beyond.inside


def test_the_neighbourhood_is_not_far_too_small(
    block: tuple[Toucher, Contact], tilted: LocalContact
) -> None:
    toucher, contact = block
    worst = 0.0
    for axis in np.eye(6)[:3]:
        for sign in (1, -1):
            pose = turned(contact.pose_body_from_tool, 3 * sign * tilted.valid_m * axis)
            truth = toucher.touch(contact_of(contact.tool, pose, name="block")).wrench
            worst = max(worst, off(truth, tilted.wrench + 3 * sign * tilted.valid_m * tilted.stiffness @ axis, 0.03))
    assert worst > 0.1


def test_turning_a_ball_about_its_centre_changes_nothing(spot: Spot) -> None:
    contact = contact_of(spot.tool, spot.pose(spot.centre(-DEEP)), name="ball")
    model = local_contact(spot.toucher, contact)
    assert np.linalg.norm(model.stiffness[:3, 3:]) < 0.02 * np.linalg.norm(model.wrench[:3])


def test_turning_the_scene_turns_the_model(
    block: tuple[Toucher, Contact], tilted: LocalContact
) -> None:
    toucher, contact = block
    scene = turn((0.3, -0.5, 0.8), 1.1, (0.4, -0.2, 0.9))
    rotation = np.kron(np.eye(2), scene[:3, :3])
    moved, there = Contact(contact.tool, scene @ contact.pose_body_from_tool), Toucher(placed(toucher.layer, scene))
    there.tools.add(contact.tool, toucher.tools.field(contact.tool))
    after = local_contact(there, moved)
    np.testing.assert_allclose(after.wrench, rotation @ tilted.wrench, atol=1e-6 * np.linalg.norm(tilted.wrench[:3]))
    size = np.abs(tilted.stiffness[:3, :3]).max()
    np.testing.assert_allclose(after.stiffness[:3, :3], (rotation @ tilted.stiffness @ rotation.T)[:3, :3],
                               atol=0.02 * size)  # the tangents differ, and with them the kinks that are met


def test_a_model_never_pulls_and_lets_go_without_a_jump(spot: Spot, model: LocalContact) -> None:
    heights = np.linspace(0, 3e-3, 3001)
    wrenches = np.array([model.wrench_at(spot.pose(spot.centre(-DEEP + h))).wrench for h in heights])
    along = wrenches[:, :3] @ model.normal
    assert (along >= 0).all() and along[0] > 0 and not wrenches[-1].any()
    assert np.abs(np.diff(wrenches[:, :3], axis=0)).max() < 0.01 * along[0]
    assert not model.wrench_at(spot.pose(spot.centre(1e-3))).inside


def test_far_from_the_skin_there_is_nothing_to_feel(spot: Spot) -> None:
    model = spot.model(spot.centre(0.05))
    assert model.status == APART and not model.wrench.any() and not model.stiffness.any()
    assert model.valid_m >= 1e-3 and not model.normal.any()
    loop = DeviceLoop()
    loop.update(model)
    assert not loop.step(spot.centre(0.05), STILL, 1e-3).any()


def test_bad_input_is_refused_or_gives_no_force(spot: Spot, model: LocalContact) -> None:
    with pytest.raises(InvalidInput, match="pose holds"):
        model.wrench_at(np.full((4, 4), np.nan))
    with pytest.raises(InvalidInput, match="coupling_stiffness is -1"):
        LoopSettings(coupling_stiffness=-1)
    with pytest.raises(InvalidInput, match="delay_steps is 300"):
        LoopSettings(delay_steps=300)
    loop, deep = DeviceLoop(), spot.centre(-3e-3)
    loop.update(model)
    pressed = [loop.step(deep, STILL, 1e-3).copy() for _ in range(50)][-1]
    assert np.linalg.norm(pressed) > 0.01
    assert not loop.step(deep * np.nan, STILL, 1e-3).any() and not loop.step(deep, STILL, 0.0).any()
    assert loop.refused == 2
    np.testing.assert_allclose(loop.step(deep, STILL, 1e-3), pressed, rtol=0.05)
    for wrong in ((deep[:2], STILL, 1e-3), (1e-3, STILL, 1e-3), (deep, None, 1e-3), (deep, STILL, "1"),
                  (["x", 0, 0], STILL, 1e-3)):  # fmt: skip
        with pytest.raises(InvalidInput, match=r"numbers"):
            loop.step(*wrong)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"delay_steps is 1\.5"):
        LoopSettings(delay_steps=1.5)  # type: ignore[arg-type]


@pytest.mark.parametrize("spoilt", [{"wrench": np.full(6, np.nan)}, {"wrench": np.full(6, 1e200)}, {"valid_m": np.nan},
                                    {"stiffness": np.full((6, 6), np.inf)}, {"valid_rad": -1.0}, {"eased": np.nan},
                                    {"eased": -1.0}, {"power": 0.0}, {"power": np.inf},
                                    {"grip": Grip(np.zeros((3, 6)), np.zeros(3), np.zeros(3), 0.4)},
                                    {"grip": Grip(np.zeros((3, 6)), np.zeros(3), np.ones(3), np.nan)}])  # fmt: skip
def test_a_model_that_cannot_be_rendered_is_counted_and_the_last_one_goes_on(
        spot: Spot, model: LocalContact, spoilt: dict[str, Any]) -> None:  # fmt: skip
    bad, deep, pose = replace(model, **spoilt), spot.centre(-3e-3), at(*spot.centre(-3e-3))
    with pytest.raises(InvalidInput, match="the local model's"):
        bad.check()
    loop, robot = DeviceLoop(), PassiveContact()
    for one in (loop, robot):
        one.update(model)
    before = [loop.step(deep, STILL, 1e-3).copy() for _ in range(50)][-1], robot.step(pose, 1e-3).copy()
    for one in (loop, robot):
        one.update(bad)
        assert one.refused == 1
    assert np.linalg.norm(before[0]) > 0.01 and np.linalg.norm(before[1]) > 0.01
    for _ in range(2):
        np.testing.assert_allclose(loop.step(deep, STILL, 1e-3), before[0], rtol=0.05)
        np.testing.assert_allclose(robot.step(pose, 1e-3), before[1], rtol=1e-9)
        loop.update(model)


def test_no_number_of_a_model_that_is_accepted_makes_one_that_is_not_finite(spot: Spot, model: LocalContact) -> None:
    slight, firm = 1e-90 * model.wrench, 1e12 * model.stiffness
    for one in (replace(model, wrench=slight, power=10.0), replace(model, wrench=slight, stiffness=firm, power=2.5),
                replace(model, wrench=1e-10 * slight), replace(model, eased=1e15, power=1.0)):  # fmt: skip
        one.check()
        for depth in (3e-3, 0.0, -3e-3, -20e-3):
            assert np.isfinite([*(found := one.wrench_at(at(*spot.centre(depth)))).wrench, found.stored]).all()


@pytest.mark.parametrize("off", [5e-3, 0.1, 1e200])
def test_a_wrong_sample_is_left_out_and_a_new_place_is_believed(spot: Spot, model: LocalContact, off: float) -> None:
    loop, calm, out = DeviceLoop(), DeviceLoop(), np.array([0, 0, 1.0])
    for k in range(300):
        depth, speed = 3e-3 + 1e-3 * np.sin(0.02 * k), -0.02 * np.cos(0.02 * k)
        for one in (loop, calm):
            if k % 10 == 0:
                one.update(model)
            place = spot.centre(-depth) + off * out * (one is loop and k == 100)
            force = one.step(place, speed * out, 1e-3).copy()
            if one is loop:
                wrong = force
        if k > 110:
            np.testing.assert_allclose(wrong, force, atol=0.02 * np.linalg.norm(force))
    assert loop.refused == 1 and np.isfinite(loop.balance)
    for _ in range(50):
        loop.step(spot.centre(-2e-3) + [0.3, 0, 0], STILL, 1e-3)
    assert loop.refused == 6


def test_at_rest_spring_proxy_and_contact_balance(spot: Spot, model: LocalContact) -> None:
    settings, deep = LoopSettings(controller=False), spot.centre(-2.3e-3)
    loop = DeviceLoop(settings)
    loop.update(model)
    force = [loop.step(deep, STILL, 1e-3) for _ in range(90)][-1]
    np.testing.assert_allclose(force, -settings.coupling_stiffness * (deep - loop.proxy), rtol=1e-6, atol=1e-9)
    contact = model.wrench_at(spot.pose(loop.proxy)).wrench[:3]
    assert np.linalg.norm(force + contact) < 0.05 * np.linalg.norm(contact)
    assert force @ spot.out > 0 and not loop.outside


def test_the_force_is_limited(spot: Spot) -> None:
    loop = DeviceLoop(LoopSettings(force_limit=0.5))
    loop.update(spot.with_modulus(HARD).model(spot.centre(-DEEP)))
    forces = np.array([loop.step(spot.centre(-4e-3), STILL, 1e-3).copy() for _ in range(50)])
    assert np.linalg.norm(forces, axis=1).max() == pytest.approx(0.5)


def test_a_stale_model_fades(spot: Spot, model: LocalContact) -> None:
    settings, deep = LoopSettings(), spot.centre(-3e-3)
    loop = DeviceLoop(settings)
    loop.update(model)
    size = np.array([np.linalg.norm(loop.step(deep, STILL, 1e-3)) for _ in range(500)])
    assert size[98] == pytest.approx(size[60], rel=1e-3) and size[60] > 0.01
    assert (np.diff(size[101:]) < 0).all() and size[-1] < 0.01 * size[98]
    assert loop.age == pytest.approx(0.5)


def test_a_step_keeps_its_memory(spot: Spot, model: LocalContact) -> None:
    loop = DeviceLoop()
    loop.update(model)
    assert loop.step(spot.centre(-3e-3), STILL, 1e-3) is loop.step(spot.centre(-3e-3), STILL, 1e-3)


@pytest.mark.parametrize("late", [0, 5])
def test_the_observer_counts_what_the_device_was_given(spot: Spot, late: int) -> None:
    """With fine encoders and a known delay, samples count the energy of the continuous motion."""
    device = Device(resolution=1e-9, delay_steps=late)
    felt = play(device, Hand(hold=0.3), settings_for(device, 1000.0, True), spot.with_modulus(2e4), node_rate=50.0)
    assert np.ptp(felt.from_loop) > 1e-4
    np.testing.assert_allclose(felt.observed[1:], felt.from_loop[1:], atol=2e-3 * np.ptp(felt.from_loop))


@pytest.mark.parametrize("modulus, late", [(1e3, 0.0), (1e3, 20e-3), (2e4, 20e-3)])
def test_pressing_holding_and_letting_go_is_passive(spot: Spot, modulus: float, late: float) -> None:
    felt = play(Device(), Hand(), settings_for(Device(), 1000.0, True), spot.with_modulus(modulus), node_delay=late)
    assert felt.passive
    assert felt.force_held > 0.1
    assert np.abs(felt.force[-20:]).max() < 1e-3  # free again; what was given out is still being taken back


@pytest.fixture(scope="module")
def too_stiff(spot: Spot) -> dict[bool, Felt]:
    hard = spot.with_modulus(HARD)
    return {on: play(Device(), Hand(), settings_for(Device(), 4000.0, on), hard, node_rate=50.0)
            for on in (False, True)}


def test_too_stiff_a_coupling_gives_out_energy_and_the_observer_sees_it(too_stiff: dict[bool, Felt]) -> None:
    felt = too_stiff[False]
    assert not felt.passive and felt.given_out > 1e-4 and felt.from_loop.max() > 1e-4
    assert felt.balance.min() < -1e-4


def test_the_controller_makes_it_passive(too_stiff: dict[bool, Felt]) -> None:
    felt = too_stiff[True]
    assert felt.passive
    assert felt.balance.min() > 0.3 * too_stiff[False].balance.min()


def test_force_held_between_answers_is_not_passive_where_the_model_is(spot: Spot) -> None:
    """Why a local model: late answers of force alone drive the device even on soft skin."""
    off = settings_for(Device(), 1000.0, False)
    held, linear = (play(Device(), Hand(), off, spot, node_delay=20e-3, held_force=h) for h in (True, False))
    assert held.given_out > 100 * QUIET and not held.passive
    assert linear.passive


@pytest.mark.parametrize("way", ["across the UV seam, 2 mm deep", "over edges along it, 2 mm deep",
                                 "down, 0.5 mm over to 2 mm under"])
def test_the_force_is_continuous(spot: Spot, way: str) -> None:
    """A quarter of the step, a quarter of the change: a jump would not shrink."""
    start, end = paths(spot)[way]
    middle, half = (start + end) / 2, 1.25e-3 * (end - start) / np.linalg.norm(end - start)
    coarse, fine = (worst_jump(forces_along(spot, middle - half, middle + half, s)) for s in (1e-4, 2.5e-5))
    assert coarse > 0
    assert fine < 0.35 * coarse
    assert coarse < 0.1 * 0.1  # N in 0.1 mm: 0.1 N per mm


def test_a_new_model_is_blended_in(spot: Spot) -> None:
    way = paths(spot)["over edges along it, 2 mm deep"]
    sudden, error = slide(spot, way, blend=0.0)
    blended, _ = slide(spot, way, blend=8e-3)
    assert blended < 0.6 * sudden
    assert error < 0.05 * np.linalg.norm(spot.force(spot.centre(-DEEP)))


def test_what_suits_a_device_is_that_of_the_map(spot: Spot) -> None:
    """docs/laboratory/haptics.md: with forces 5 ms late 951 N/m with the controller, 238 without."""
    suits = found(Device(delay_steps=5), spot)
    assert suits.settings is not None and suits.settings.delay_steps == 5
    assert suits.settings.coupling_stiffness == pytest.approx(951, rel=0.45)  # two levels of the map
    assert suits.without == pytest.approx(238, rel=0.45) and suits.bound == pytest.approx(418, rel=0.01)
