"""Laws of gradients: each agrees with differences of the law, made on skins, tools and poses of their own."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh

from stmpl_core import Contact, Membrane, Simulator, SoftLayer, Tissue, Tool
from stmpl_core.body import Body
from stmpl_core.columns import shifted
from stmpl_core.errors import InvalidInput
from stmpl_core.footing import twist_between
from stmpl_core.gradients import Gradients, WrenchGradient, twisted
from stmpl_core.layer import thicker
from stmpl_core.living import living
from stmpl_core.methods import MomentNet
from tests.scenes import LENGTH, RADIUS, at, limb, plate, tool, turn

LEVER = 0.01  # m, with which torques and turns are weighed beside forces and ways
SKINS = ["one material", "forearm"]


def on_its_face(mesh: trimesh.Trimesh, name: str) -> Tool:
    """A tool whose lowest point is its origin."""
    return tool(mesh.apply_translation([0, 0, -mesh.bounds[0, 2]]), name=name)


BALL = on_its_face(trimesh.creation.icosphere(4, 0.012), "ball")
PUNCH = on_its_face(trimesh.creation.cylinder(0.01, 0.02, sections=48), "punch")


def made(layer: SoftLayer) -> Gradients:
    return Gradients(Simulator(layer, MomentNet()))


@cache
def forearm() -> Simulator:
    return Simulator(living(Body.anny(), "left_forearm", edge_length=6e-3), MomentNet())


@pytest.fixture(scope="module", params=SKINS)
def gradients(request: pytest.FixtureRequest) -> Gradients:
    return made(limb()) if request.param == SKINS[0] else Gradients(forearm())


def standing(simulator: Simulator, one: Tool, share: float, aside: float = 0.0) -> Contact:
    """A tool a share of the thickness deep in the middle of the skin, tilted a little, or so far along it [m]."""
    layer = simulator.layer
    middle = layer.vertices.mean(axis=0) + [0, 0, aside]
    vertex = int(np.linalg.norm(layer.vertices - middle - 0.04 * np.array([1.0, 0, 0]), axis=1).argmin())
    out = layer.normals[vertex]
    pose = turn(tuple(np.cross([0, 0, 1], out)), float(np.arccos(out[2])))
    pose = pose @ turn((1, 0.6, 0), 0.03) @ turn((0, 0, 1), 0.4)
    pose[:3, 3] = layer.vertices[vertex] - share * layer.thickness[vertex] * out
    return Contact(one, pose)


def wrench_of(simulator: Simulator, contacts: list[Contact], name: str) -> np.ndarray:
    return next(one.wrench for one in simulator.touch(contacts) if one.name == name)


def differences(ask: Callable[[np.ndarray], np.ndarray], pose: np.ndarray, steps: tuple[float, ...]) -> np.ndarray:
    """Mean over some steps [m] of the central differences by twist, the last axis."""
    found = []
    for step in steps:
        for k in range(6):
            twist = np.zeros(6)
            twist[k] = step if k < 3 else step / LEVER
            found.append((ask(twisted(pose, twist)) - ask(twisted(pose, -twist))) / (2 * twist[k]))
    return np.moveaxis(np.array(found).reshape(len(steps), 6, *found[0].shape).mean(axis=0), 0, -1)


def off(found: np.ndarray, expected: np.ndarray, size: float | None = None) -> float:
    """Largest error over the largest force, or over `size` [N]; torques by LEVER, turns likewise."""
    scale = np.repeat([1, 1 / LEVER], 3)
    if found.ndim == 2:
        scale = np.outer(scale, scale)[:, : found.shape[1]]
    return float(np.abs(scale * (found - expected)).max() / (np.abs(scale * expected).max() if size is None else size))


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_a_balls_wrench_changes_with_its_pose_as_differences_say(gradients: Gradients, share: float) -> None:
    simulator, contact = gradients.simulator, standing(gradients.simulator, BALL, share)
    found = gradients.wrench([contact])[0]
    expected = differences(lambda at: wrench_of(simulator, [replace(contact, pose_body_from_tool=at)], "ball"),
                           contact.pose_body_from_tool, (1e-4,))  # fmt: skip
    np.testing.assert_array_equal(found.wrench, wrench_of(simulator, [contact], "ball"))
    assert off(found.pose, expected) < 0.05


@pytest.mark.parametrize("radius", [0.01, 0.015])
@pytest.mark.parametrize("share", [0.2, 0.4])
def test_a_slender_cone_is_as_stiff_as_touches_a_little_deeper_and_less_deep_say(radius: float, share: float) -> None:
    """A limb's columns lead out of its wall, and what goes on with it sinks as it does: a half was missing."""
    simulator = forearm()
    mesh = trimesh.creation.cone(radius, 0.03, sections=64).apply_transform(turn((1, 0, 0), np.pi))
    contact = standing(simulator, on_its_face(mesh, "cone"), share)
    pose, way = contact.pose_body_from_tool, contact.pose_body_from_tool[:3, 2]
    found = way @ Gradients(simulator).wrench([contact])[0].pose[:3, :3] @ way
    expected = []
    for step in (2e-4, 8e-4):
        more, less = (wrench_of(simulator, [replace(contact, pose_body_from_tool=shifted(pose, by * way))], "cone")
                      for by in (step, -step))  # fmt: skip
        expected.append(way @ (more - less)[:3] / (2 * step))
    assert found == pytest.approx(np.mean(expected), rel=0.15)  # 0.125 was found


def test_a_punchs_wrench_changes_with_its_pose_as_differences_over_half_its_nodes_spacing_say(
    gradients: Gradients,
) -> None:
    """Its rim makes the law rough: nodes come in one by one."""
    simulator, contact = gradients.simulator, standing(gradients.simulator, PUNCH, 0.3)
    expected = differences(lambda at: wrench_of(simulator, [replace(contact, pose_body_from_tool=at)], "punch"),
                           contact.pose_body_from_tool, (3e-4, 4e-4, 6e-4, 7e-4))  # fmt: skip
    wide = Gradients(simulator, pose_step=5e-4)
    wide._made = gradients.prepare()._made
    told = wide.wrench([contact])[0]
    assert off(told.pose, expected) < 0.1
    analytic = gradients.wrench([contact])[0]
    assert off(analytic.pose[:, :3], expected[:, :3]) < 0.15
    np.testing.assert_array_equal(told.thickness, analytic.thickness)


@pytest.mark.parametrize("one, most", [(BALL, 0.02), (PUNCH, 0.2)])
def test_a_wrench_changes_with_the_thickness_as_touches_on_thinner_and_thicker_skin_say(
    gradients: Gradients, one: Tool, most: float
) -> None:
    contact = standing(gradients.simulator, one, 0.35)
    found = gradients.wrench([contact])[0]
    thin, thick = (wrench_of(Simulator(thicker(gradients.simulator.layer, by), MomentNet()), [contact], one.name)
                   for by in (0.96, 1.04))  # fmt: skip
    expected = (thick - thin) / 0.08
    assert expected[:3] @ found.wrench[:3] < -0.5 * found.wrench[:3] @ found.wrench[:3]  # thicker tissue gives way
    assert off(found.thickness, expected) < most


@pytest.mark.parametrize("one, most", [(BALL, 0.06), (PUNCH, 0.2)])
def test_a_wrench_changes_with_the_tools_size_as_smaller_and_larger_tools_say(
    gradients: Gradients, one: Tool, most: float
) -> None:
    contact = standing(gradients.simulator, one, 0.35)
    found = gradients.wrench([contact])[0]
    low, high = (wrench_of(gradients.simulator, [replace(contact, tool=Tool(one.name, by * one.vertices, one.faces))],
                           one.name) for by in (0.97, 1.03))  # fmt: skip
    expected = (high - low) / 0.06
    assert expected[:3] @ found.wrench[:3] > 0.3 * found.wrench[:3] @ found.wrench[:3]  # a larger tool presses more
    assert off(found.tool_scale, expected) < most


def test_a_wrench_grows_with_all_moduli_and_the_motion_does_not(gradients: Gradients) -> None:
    contact, layer = standing(gradients.simulator, BALL, 0.35), gradients.simulator.layer
    tissue = layer.tissue.softened(1.2)
    if tissue.skin is not None:
        tissue = replace(tissue, skin=replace(tissue.skin, tension=1.2 * tissue.skin.tension))
    stiffer = Simulator(layer.with_(tissue=tissue), MomentNet())
    found, before = gradients.wrench([contact])[0], layer.tissue.youngs_modulus
    expected = (wrench_of(stiffer, [contact], "ball") - found.wrench) / (0.2 * before)
    assert off(found.modulus, expected) < 1e-3
    field = gradients.field([contact])
    moved = stiffer.step([contact]).displacement - field.displacement
    assert np.abs(moved).max() < 0.01 * np.abs(field.displacement).max()  # coarse elements in single precision
    assert not field.modulus.any()


def by_pose_of(simulator: Simulator, contacts: list[Contact], mover: int, feeler: int) -> np.ndarray:
    """Differences of one tool's wrench by the twist of one, (6, 6)."""
    def ask(pose: np.ndarray) -> np.ndarray:
        moved = [replace(one, pose_body_from_tool=pose) if k == mover else one for k, one in enumerate(contacts)]
        return wrench_of(simulator, moved, contacts[feeler].name)

    return differences(ask, contacts[mover].pose_body_from_tool, (5e-4,))


def test_tools_side_by_side_feel_each_others_poses(gradients: Gradients) -> None:
    simulator = gradients.simulator
    two = [standing(simulator, BALL, 0.35), standing(simulator, PUNCH, 0.25, aside=0.024)]
    found = gradients.wrench(two)
    alone = gradients.wrench(two[:1])[0]
    assert set(found[0].across) == {"punch"} and not alone.across
    for mover, feeler in ((0, 1), (1, 0)):
        told = found[feeler].across[two[mover].name]
        expected = by_pose_of(simulator, two, mover, feeler)
        push = found[mover].wrench[:3] / np.linalg.norm(found[mover].wrench[:3])
        assert np.linalg.norm(expected[:3, :3] @ push) > 5e-3 * np.linalg.norm(found[feeler].pose[:3, :3])  # it matters
        assert off(told[:, :3] @ push, expected[:, :3] @ push) < 0.35
        known = 0.2 if simulator.layer.tissue.skin is None else 0.5  # along a forearm it is 1 % of what they feel alone
        assert off(told[:, :3], expected[:, :3]) < known
    thin, thick = (wrench_of(Simulator(thicker(simulator.layer, by), MomentNet()), two, "ball") for by in (0.96, 1.04))
    assert off(found[0].thickness, (thick - thin) / 0.08) < 0.06


def test_tools_that_come_nearer_give_way_as_each_sinks_the_skin_beside_it() -> None:
    """Moving along the skin beside another was 6 to 8 % off by the tool itself, and 26 to 45 % by the other.

    A punch whose edge is not rounded by a grid is 6.5 and 33 % off.
    """
    simulator = Simulator(living(Body.anny(), "left_thigh", edge_length=6e-3), MomentNet())
    for aside in (0.02, 0.024):
        two = [standing(simulator, BALL, 0.15), standing(simulator, PUNCH, 0.1, aside=aside)]
        found = Gradients(simulator).wrench(two, ())
        for mover, name in enumerate(("ball", "punch")):
            for feeler, one in enumerate(found):
                expected = by_pose_of(simulator, two, mover, feeler)[:, :3]
                told, limit = (one.pose, 0.07) if mover == feeler else (one.across[name], 0.35)
                assert off(told[:, :3], expected) < limit


def test_all_lengths_together_scale_a_wrench_by_their_square_and_cube() -> None:
    """On a plane, which has no length of its own: thickness, tool and its place are all there are."""
    gradients, errors = made(plate()), []
    for depth in (1.5e-3, 1.9e-3, 2e-3, 2.1e-3, 2.5e-3):  # at one the law's own roughness may be more
        contact = Contact(BALL, at(0.001, 0.0007, -depth) @ turn((0.3, 1, 0.2), 0.04))
        one = gradients.wrench([contact])[0]
        whole = one.thickness + one.tool_scale + one.pose[:, :3] @ contact.pose_body_from_tool[:3, 3]
        errors.append(off(whole, one.wrench * np.repeat([2, 3], 3), float(np.linalg.norm(one.wrench[:3]))))
    assert np.mean(errors) < 0.02


@pytest.mark.parametrize("one, depth", [(BALL, 1e-3), (BALL, 2.5e-3), (PUNCH, 1.5e-3)])
def test_the_field_changes_with_the_pose_as_a_longer_way_says(one: Tool, depth: float) -> None:
    gradients = made(limb())
    pose = at(RADIUS - depth, 0, LENGTH / 2) @ turn((0, 1, 0), np.pi / 2)
    found = gradients.field([Contact(one, pose)])
    assert found.trust.ok
    way, step = np.array([-1.0, 0, 0, 0, 0, 0]), 0.15 * depth  # inwards
    far, near = (gradients.simulator.step([Contact(one, twisted(pose, by * way))]).displacement for by in (step, -step))
    expected, told = (far - near) / (2 * step), found.pose[one.name] @ way
    assert np.linalg.norm(told - expected) < 0.25 * np.linalg.norm(expected)  # vertices let go one by one
    np.testing.assert_allclose(gradients.field_along([Contact(one, pose)], {one.name: 3 * way}), 3 * told, atol=1e-9)
    middle = np.abs(gradients.simulator.layer.vertices - [RADIUS, 0, LENGTH / 2]).sum(axis=1) < 4e-3
    np.testing.assert_allclose(told[middle] @ way[:3], 1.0, atol=0.1)  # what is touched goes along


def test_the_field_changes_with_thickness_and_size_as_differences_say() -> None:
    gradients, depth = made(limb()), 2e-3
    contact = Contact(BALL, at(RADIUS - depth, 0, LENGTH / 2) @ turn((0, 1, 0), np.pi / 2))
    found, simulator = gradients.field([contact]), gradients.simulator
    thin, thick = (Simulator(thicker(simulator.layer, by), MomentNet()).step([contact]).displacement
                   for by in (0.92, 1.08))  # fmt: skip
    small, large = (simulator.step([replace(contact, tool=Tool("ball", by * BALL.vertices, BALL.faces))]).displacement
                    for by in (0.94, 1.06))  # fmt: skip
    by_thickness, by_size = (thick - thin) / 0.16, (large - small) / 0.12
    for told, expected in ((found.thickness, by_thickness), (found.tool_scale["ball"], by_size)):
        assert np.linalg.norm(told - expected) < 0.4 * np.linalg.norm(expected)  # vertices let go one by one
        assert np.abs(told).max() > 1e-4


def test_a_ball_that_turns_about_its_middle_changes_nothing() -> None:
    gradients, middle = made(limb()), tool(trimesh.creation.icosphere(4, 0.012), name="ball")
    contact = Contact(middle, at(RADIUS + 0.012 - 2e-3, 0, LENGTH / 2))
    wrench, field = gradients.wrench([contact])[0].pose, gradients.field([contact]).pose["ball"]
    assert np.abs(wrench[:3, 3:]).max() < 0.02 * LEVER * np.abs(wrench[:3, :3]).max()
    assert np.linalg.norm(field[..., 3:]) < 0.1 * LEVER * np.linalg.norm(field[..., :3])


def every_number(one: WrenchGradient) -> np.ndarray:
    parts = [one.wrench, one.pose, one.modulus, one.thickness, one.tool_scale, *one.across.values()]
    return np.concatenate([np.ravel(part) for part in parts])


def test_a_tool_that_does_not_press_changes_nothing(gradients: Gradients) -> None:
    simulator = gradients.simulator
    for share in (-0.1, -5.0):
        away = standing(simulator, BALL, share)
        fresh = Gradients(simulator)
        found, field = fresh.wrench([away])[0], fresh.field([away])
        assert not every_number(found).any() and found.trust.ok
        assert not field.pose["ball"].any() and not field.thickness.any() and not field.tool_scale["ball"].any()
        assert not fresh.field_along([away], {"ball": np.ones(6)}).any()
        assert fresh._made is None  # no skin is made for nothing
    both = gradients.wrench([standing(simulator, PUNCH, -0.1, aside=0.03), standing(simulator, BALL, 0.3)])
    assert not every_number(both[0]).any() and every_number(both[1]).all()
    assert gradients.wrench([]) == []


@pytest.mark.parametrize("share", [1.05, 1.3])
def test_a_tool_that_is_drawn_back_from_the_core_says_so_and_how_steep_the_law_is(
    gradients: Gradients, share: float
) -> None:
    simulator, contact = gradients.simulator, standing(gradients.simulator, BALL, share)
    found = gradients.wrench([contact])[0]
    assert not found.trust.ok and "drawn back" in found.trust.why
    assert np.isfinite(every_number(found)).all()
    push = found.wrench[:3] / np.linalg.norm(found.wrench[:3])
    low, high = (wrench_of(simulator, [replace(contact, pose_body_from_tool=twisted(contact.pose_body_from_tool,
                                                                                   [*(by * push), 0, 0, 0]))], "ball")
                 for by in (-5e-4, 5e-4))  # fmt: skip
    assert push @ found.pose[:3, :3] @ push == pytest.approx(push @ (high - low)[:3] / 1e-3, rel=0.1)
    if not simulator.layer.stacked:  # which deeper than all training says nothing of worth
        thin, thick = (wrench_of(Simulator(thicker(simulator.layer, by), MomentNet()), [contact], "ball")
                       for by in (0.98, 1.02))  # fmt: skip
        assert push @ found.thickness[:3] == pytest.approx(push @ (thick - thin)[:3] / 0.04, rel=0.2)
    assert np.isfinite(gradients.field_along([contact], {"ball": [*push, 0, 0, 0]})).all()


def test_only_what_is_asked_for_is_found() -> None:
    gradients = made(limb())
    contact = standing(gradients.simulator, BALL, 0.3)
    wrench, field = gradients.wrench([contact], by=("pose",))[0], gradients.field([contact], by=("modulus",))
    assert wrench.thickness is None and wrench.tool_scale is None and wrench.pose.any()
    assert field.thickness is None and not field.pose and not field.tool_scale
    assert gradients._made is None  # no other skin was made


def test_a_wrench_that_is_told_is_not_used(gradients: Gradients) -> None:
    contact = standing(gradients.simulator, BALL, 0.3)
    told = replace(contact, wrench=np.array([1.0, 0, 0, 0, 0, 0]))
    np.testing.assert_array_equal(*(every_number(gradients.wrench([one])[0]) for one in (contact, told)))


def test_gradients_are_those_where_the_joints_are() -> None:
    from stmpl_core import Rig

    body = Body.anny()
    layer = body.part("left_arm", edge_length=8e-3)
    simulator = Simulator(layer.with_(rig=Rig.of(body, "left_arm", layer)), MomentNet())
    gradients = Gradients(simulator).prepare()
    simulator.pose({"left_elbow": 0.6})
    vertices = simulator.layer.vertices
    vertex = int(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).argmin())
    contact = Contact(tool(trimesh.creation.icosphere(3, 0.012), name="ball"), np.eye(4))
    contact.pose_body_from_tool[:3, 3] = vertices[vertex] + 0.01 * simulator.layer.normals[vertex]
    found = gradients.wrench([contact])[0]
    thin, thick = (Simulator(thicker(simulator.skin.rest.layer, by), MomentNet()) for by in (0.97, 1.03))
    for one in (thin, thick):
        one.pose({"left_elbow": 0.6})
    assert np.linalg.norm(found.wrench) > 0
    expected = (wrench_of(thick, [contact], "ball") - wrench_of(thin, [contact], "ball")) / 0.06
    assert off(found.thickness, expected) < 0.05
    field = gradients.field([contact], by=("thickness",)).thickness
    moved = (thick.step([contact]).displacement - thin.step([contact]).displacement) / 0.06
    np.testing.assert_allclose(field, moved, atol=1e-3 * np.abs(moved).max())


def test_presses_tell_modulus_and_thickness_by_gauss_and_newton() -> None:
    """From 40 and 25 % away, by two balls: a small one feels the modulus more, a large one the bone below."""
    layer, balls = limb(), [on_its_face(trimesh.creation.icosphere(3, r), f"ball of {r} m") for r in (6e-3, 20e-3)]
    person = Simulator(thicker(layer, 1.25).with_(youngs_modulus=1400.0), MomentNet())
    facing = at(RADIUS, 0, LENGTH / 2) @ turn((0, 1, 0), np.pi / 2)
    contacts = [Contact(one, at(-depth, 0, 0) @ facing) for one in balls for depth in (1e-3, 2e-3, 3e-3)]
    forces, found = np.array([-person.touch([one])[0].wrench[0] for one in contacts]), np.array([1000.0, 1.0])
    for _ in range(3):
        told = Gradients(Simulator(thicker(layer, found[1]).with_(youngs_modulus=found[0]), MomentNet()))
        each = [told.wrench([one], by=("modulus", "thickness"))[0] for one in contacts]
        slopes = -np.array([[one.modulus[0], one.thickness[0] / found[1]] for one in each]) / forces[:, None]
        left = (forces + [one.wrench[0] for one in each]) / forces
        found = found + np.linalg.lstsq(slopes, left)[0]
    np.testing.assert_allclose(found, [1400.0, 1.25], rtol=5e-3)


def test_a_thicker_layer_is_deeper_everywhere_and_its_surface_and_skin_stay() -> None:
    layer = living(Body.anny(), "left_forearm", edge_length=8e-3)
    twice = thicker(layer, 1.2)
    np.testing.assert_allclose(twice.thickness, 1.2 * layer.thickness)
    np.testing.assert_array_equal(twice.vertices, layer.vertices)
    assert twice.tissue.skin == layer.tissue.skin
    assert [ply.depth for ply in twice.tissue.deeper] == [1.2 * ply.depth for ply in layer.tissue.deeper]
    straight = limb().with_(tissue=Tissue(2e3, 0.45, skin=Membrane(2e5, 1.5e-3, tension=20.0)))
    np.testing.assert_allclose(thicker(straight, 0.9).thickness, 0.9 * straight.thickness)


def test_a_twist_takes_a_pose_where_twist_between_says() -> None:
    pose, twist = at(0.1, -0.2, 0.3) @ turn((1, 2, 3), 0.7), np.array([0.01, -0.02, 0.03, 0.2, 0.1, -0.4])
    np.testing.assert_allclose(twist_between(pose, twisted(pose, twist)), twist, atol=1e-12)


def test_what_cannot_be_is_refused_in_words(gradients: Gradients) -> None:
    contact = standing(gradients.simulator, BALL, 0.3)
    with pytest.raises(InvalidInput, match="pose_step is 0 m"):
        Gradients(gradients.simulator, pose_step=0)
    with pytest.raises(InvalidInput, match="pose_step is 'a' m"):
        Gradients(gradients.simulator, pose_step="a")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="twists is None; Mapping is needed"):
        gradients.field_along([contact], None)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="no contact of thumb"):
        gradients.field_along([contact], {"thumb": np.zeros(6)})
    with pytest.raises(InvalidInput, match="factor on the thickness"):
        thicker(gradients.simulator.layer, 0.0)
    with pytest.raises(InvalidInput, match="no gradient by colour"):
        gradients.wrench([contact], by=("colour",))  # type: ignore[arg-type]
    assert gradients.wrench([contact], by="thickness")[0].thickness is not None  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"no gradient by colour\. "):
        gradients.wrench([contact], by="colour")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="names of their own"):
        gradients.wrench([contact, contact])
