"""stmpl_sim: soft skin in a rigid-body simulator: what it exerts is what the contact law says, on both, once."""

import copy
import pickle
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from stmpl_core import Contact, Simulator, SoftLayer, State, Tool, Touch
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import MomentNet, Winkler
from stmpl_core.regions import HELD_SKIN
from stmpl_core.touch import APART
from stmpl_sim import Memory, Poses, Reaction, SoftBody, SoftContact, exchange
from stmpl_sim.energy import EnergyBook
from tests.scenes import RADIUS as LIMB_RADIUS
from tests.scenes import ball, box, limb, plate, tool

mujoco = pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")

RADIUS, MASS, GRAVITY = 0.012, 0.3, 9.81  # m, kg, m/s2
CORE = '<geom name="core" type="box" size=".05 .05 .001" pos="0 0 -.009" mass="1"/>'
SHAPES = {  # attributes of a geom: its volume [m3]
    'type="sphere" size=".012"': 4 / 3 * np.pi * 0.012**3,
    'type="capsule" size=".008 .01"': np.pi * 0.008**2 * 0.02 + 4 / 3 * np.pi * 0.008**3,
    'type="capsule" size=".004 .05"': np.pi * 0.004**2 * 0.1 + 4 / 3 * np.pi * 0.004**3,
    'type="cylinder" size=".01 .015"': np.pi * 0.01**2 * 0.03,
    'type="box" size=".01 .012 .014"': 8 * 0.01 * 0.012 * 0.014,
    'type="ellipsoid" size=".01 .012 .014"': 4 / 3 * np.pi * 0.01 * 0.012 * 0.014,
}


@pytest.fixture(scope="module")
def slab() -> SoftLayer:
    return plate(0.09, youngs_modulus=20e3)


@pytest.fixture(scope="module")
def simulator(slab: SoftLayer) -> Simulator:
    return Simulator(slab, Winkler())


def model(tool: str = '<geom name="ball" type="sphere" size=".012" mass=".3"/>', slab: str = CORE, joint: str = "",
          exclude: bool = True, timestep: float = 1e-3, at: str = "0 0 .0115") -> Any:  # fmt: skip
    """A slab of soft tissue with something free over it."""
    kept = '<contact><exclude body1="slab" body2="bob"/></contact>' if exclude else ""
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{timestep}" gravity="0 0 -{GRAVITY}"/><worldbody><body name="slab">{joint}{slab}'
        f'</body><body name="bob" pos="{at}"><freejoint/>{tool}</body></worldbody>{kept}</mujoco>')  # fmt: skip


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: Rotation | None = None) -> np.ndarray:
    out = np.eye(4)
    out[:3, 3] = x, y, z
    if turn is not None:
        out[:3, :3] = turn.as_matrix()
    return out


def step(m: Any, d: Any, *skins: SoftBody) -> None:
    mujoco.mj_step1(m, d)
    for skin in skins:
        skin.apply(d)
    mujoco.mj_step2(m, d)


def test_the_stiffness_of_a_contact_is_how_its_force_changes(simulator: Simulator) -> None:
    m = model()
    m.body("slab").quat[:] = Rotation.from_euler("xyz", [0.4, -0.3, 0.2]).as_quat(scalar_first=True)
    d, step_m, rows = mujoco.MjData(m), 2e-5, []
    skin = SoftBody(m, simulator, body="slab", tools=["ball"])
    assert not skin.stiffness(d, "ball").any()
    mujoco.mj_kinematics(m, d)
    turn = d.body("slab").xmat.reshape(3, 3)
    start = turn @ [0.003, -0.002, RADIUS - 0.002]
    for way in np.vstack([np.zeros(3), np.eye(3), -np.eye(3)]):
        d.qpos[:3] = start + step_m * way
        skin.apply(d)
        rows.append(skin.reaction.tools["ball"][:3].copy())  # type: ignore[union-attr]
        if not way.any():
            found = skin.stiffness(d, "ball")
    expected = -(np.array(rows[1:4]) - rows[4:7]).T / (2 * step_m)
    np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max())
    d.qpos[:3] = turn @ [0, 0, 0.1]
    skin.apply(d)
    assert not skin.stiffness(d, "ball").any()


# The step: poses in, wrenches out


def test_the_wrench_is_that_of_the_contact_law_and_the_body_feels_the_opposite(simulator: Simulator) -> None:
    tool = ball(RADIUS)
    contact = SoftContact(simulator, [tool])
    at = pose(0.01, -0.005, RADIUS - 0.002)
    reaction = contact.step(Poses(np.eye(4), {"probe": at}))
    touch = simulator.touch([Contact(tool, at)])[0]
    np.testing.assert_allclose(reaction.tools["probe"], -touch.wrench, atol=1e-15)
    about_origin = -reaction.tools["probe"]
    about_origin[3:] += np.cross(at[:3, 3], about_origin[:3])
    np.testing.assert_allclose(reaction.body, about_origin, atol=1e-12)


def test_turning_the_scene_turns_the_wrenches(simulator: Simulator) -> None:
    tool, turn = ball(RADIUS), pose(0.3, -1.0, 0.7, Rotation.from_rotvec([0.4, -1.1, 2.0]))
    at = pose(0.01, 0.0, RADIUS - 0.002)
    straight = SoftContact(simulator, [tool]).step(Poses(np.eye(4), {"probe": at}))
    turned = SoftContact(simulator, [tool]).step(Poses(turn, {"probe": turn @ at}))
    for before, after in ((straight.tools["probe"], turned.tools["probe"]), (straight.body, turned.body)):
        np.testing.assert_allclose(after[:3], turn[:3, :3] @ before[:3], atol=1e-9)
        np.testing.assert_allclose(after[3:], turn[:3, :3] @ before[3:], atol=1e-9)


def test_a_layer_with_axes_of_its_own_feels_the_same(simulator: Simulator) -> None:
    tool, shift = ball(RADIUS), pose(0.2, 0.1, 0.0, Rotation.from_rotvec([0, 0, 1.0]))
    at = pose(0.01, 0.0, RADIUS - 0.002)
    there = SoftContact(simulator, [tool], pose_body_from_layer=shift).step(Poses(np.eye(4), {"probe": shift @ at}))
    here = SoftContact(simulator, [tool]).step(Poses(np.eye(4), {"probe": at}))
    np.testing.assert_allclose(there.tools["probe"][:3], shift[:3, :3] @ here.tools["probe"][:3], atol=1e-9)


def test_a_tool_that_is_not_asked_about_would_have_been_apart() -> None:
    simulator = Simulator(limb(5e-3), Winkler())
    tool, random = ball(0.008), np.random.default_rng(1)
    contact, far = SoftContact(simulator, [tool]), 0
    for _ in range(150):
        at = pose(*random.uniform([-0.07, -0.07, 0.0], [0.07, 0.07, 0.16]))
        touch, law = contact.step(Poses(np.eye(4), {"probe": at})).touches["probe"], None
        law = simulator.touch([Contact(tool, at)])[0]
        assert touch.status == law.status
        np.testing.assert_array_equal(touch.wrench, law.wrench)
        far += contact._free("probe", at, Memory()) > 0
    assert 30 < far < 140  # both happened


def test_a_tool_that_was_apart_a_step_ago_is_asked_about_where_it_may_touch() -> None:
    """Steps of 2 mm and 3 degrees, or a leap: each as if there had been none before."""
    simulator, random = Simulator(limb(5e-3), Winkler()), np.random.default_rng(3)
    tool, touching, left = box(0.02, 0.008, 0.008), 0, 0
    contact, memory = SoftContact(simulator, [tool]), Memory()
    at = pose(0.09, 0.0, 0.08)
    for n in range(400):
        way = np.array([LIMB_RADIUS + 0.005, 0.0, 0.08]) - at[:3, 3]
        turn = Rotation.from_rotvec(0.05 * random.normal(size=3))
        at = pose(*(at[:3, 3] + 2e-4 * random.normal(size=3) + 2e-3 * way / np.linalg.norm(way)),
                  turn * Rotation.from_matrix(at[:3, :3]))  # fmt: skip
        if n % 40 == 39:
            at = pose(*random.uniform([0.06, -0.05, 0.03], [0.1, 0.05, 0.13]))
        made = contact.step(Poses(np.eye(4), {tool.name: at}), memory, 1e-3)
        alone = contact.step(Poses(np.eye(4), {tool.name: at}))
        touch, fresh = made.touches[tool.name], alone.touches[tool.name]
        assert touch.status == fresh.status
        np.testing.assert_allclose(touch.wrench, fresh.wrench, atol=1e-9)
        memory = Memory(State(), made.memory.at, made.memory.speed, made.memory.free)
        touching += touch.presses
        left += memory.free.get(tool.name, 0.0) > 0
    assert touching > 50 and left > 100  # both happened


@pytest.mark.parametrize("way_m", [0.004, 0.011, 0.03, 0.07, 0.105])
def test_a_tool_that_flew_through_the_limb_is_flagged_until_it_is_apart(way_m: float) -> None:
    contact, found = SoftContact(Simulator(limb(5e-3), Winkler()), [ball(0.012)]), 0
    for start in np.linspace(0.0, 1.0, 5):
        memory, flagged = Memory(), []
        for x in np.arange(0.051 + way_m * start, -0.07, -way_m):
            reaction = contact.step(Poses(np.eye(4), {"probe": pose(x, 0.004, 0.08)}), memory, 1e-3)
            touch, memory = reaction.touches["probe"], reaction.memory
            if touch.force > 0 and abs(x) > 0.02:
                flagged.append((touch.push[0] > 0, "went through" in touch.trust.why))  # pushed in from the far side
            assert touch.trust.ok or abs(x) < 0.06
        assert all(far == told for far, told in flagged)
        found += sum(far for far, _ in flagged)
        for x in (-0.08, -0.05):  # apart, and back from where it is now
            reaction = contact.step(Poses(np.eye(4), {"probe": pose(x, 0.004, 0.08)}), memory, 1e-3)
            memory = reaction.memory
        assert reaction.touches["probe"].force > 0 and reaction.touches["probe"].trust.ok
    assert found > 0


def test_what_goes_in_and_out_or_holds_from_two_sides_did_not_go_through() -> None:
    simulator = Simulator(limb(5e-3), Winkler())
    round_it = tool(trimesh.creation.annulus(LIMB_RADIUS + 0.001, LIMB_RADIUS + 0.012, 0.02), name="ring")
    for one, ways in ((ball(0.012), LIMB_RADIUS + 0.012 - np.array([0, 6, 1, 7, 9, 2, -1, 9, 4, -5, 8, 0]) * 1e-3),
                      (round_it, 1e-3 * np.array([0, 3, -3, 5, -5, 6, 0, -6, 4]))):
        contact, memory, sides = SoftContact(simulator, [one]), Memory(), set()
        for x in ways:
            reaction = contact.step(Poses(np.eye(4), {one.name: pose(x, 0.0, 0.08)}), memory, 1e-3)
            touch, memory = reaction.touches[one.name], reaction.memory
            assert "went through" not in touch.trust.why
            sides |= {np.sign(touch.push[0])} if touch.force > 0 else set()
        assert len(sides) == 1 + (one is round_it)  # a ring presses from either side


def test_poses_that_cannot_be_used_are_one_sentence(simulator: Simulator) -> None:
    contact = SoftContact(simulator, [ball(RADIUS)])
    with pytest.raises(InvalidInput, match=r"no pose of probe; given: finger"):
        contact.step(Poses(np.eye(4), {"finger": np.eye(4)}))
    with pytest.raises(InvalidInput, match=r"pose of probe holds 1 values that are not finite.*shorter timestep"):
        contact.step(Poses(np.eye(4), {"probe": pose(np.nan)}))
    with pytest.raises(InvalidInput, match=r"names of their own; got probe, probe"):
        SoftContact(simulator, [ball(RADIUS), ball(RADIUS)])
    with pytest.raises(InvalidInput, match=r"damping is -1"):
        SoftContact(simulator, [ball(RADIUS)], damping=-1.0)
    with pytest.raises(InvalidInput, match=r"needs the mobility"):
        SoftContact(simulator, [ball(RADIUS)], implicit=True).step(Poses(np.eye(4), {"probe": pose(z=0.011)}))


def test_a_step_has_no_memory_but_what_it_is_given(simulator: Simulator) -> None:
    contact = SoftContact(simulator, [ball(RADIUS)], damping=10.0)
    first = Poses(np.eye(4), {"probe": pose(z=RADIUS - 1e-3)})
    second = Poses(np.eye(4), {"probe": pose(z=RADIUS - 1.1e-3)})
    memory = contact.step(first, Memory(), 1e-3).memory
    one, two = (contact.step(second, memory, 1e-3).tools["probe"] for _ in range(2))
    np.testing.assert_array_equal(one, two)
    elastic = contact.step(second, Memory(), 1e-3).tools["probe"]
    np.testing.assert_allclose(one, (1 + 10.0 * 0.1) * elastic, rtol=1e-6)  # 0.1 m/s into the skin
    away = contact.step(first, contact.step(second, memory, 1e-4).memory, 1e-4).tools["probe"]
    assert not away.any()  # 1 m/s out: damped to nothing, never pulling


class MassOnASpring:
    """A ball on a spring over a slab, integrated by hand: the smallest world there is."""

    def __init__(self, stiffness: float = 200.0, rest: float = RADIUS - 0.01) -> None:
        self.height, self.speed, self.push_ = RADIUS + 1e-3, 0.0, 0.0
        self.stiffness, self.rest = stiffness, rest

    def poses(self) -> Poses:
        return Poses(np.eye(4), {"probe": pose(z=self.height)})

    def push(self, reaction: Reaction) -> None:
        self.push_ = float(reaction.tools["probe"][2])

    def step(self, dt: float) -> None:
        self.speed += dt * (self.push_ + self.stiffness * (self.rest - self.height) - 4.0 * self.speed) / MASS
        self.height += dt * self.speed


def test_a_world_of_numpy_comes_to_rest_where_spring_and_skin_agree(simulator: Simulator) -> None:
    world, contact, memory = MassOnASpring(), SoftContact(simulator, [ball(RADIUS)]), Memory()
    for _ in range(1500):
        memory = exchange(contact, world, memory, 1e-3).memory
        world.step(1e-3)
    law = simulator.touch([Contact(ball(RADIUS), pose(z=world.height))])[0]
    assert law.force == pytest.approx(world.stiffness * (world.height - world.rest), rel=1e-4)
    assert law.force > 0.2


# MuJoCo


def test_a_ball_lies_where_the_skin_carries_its_weight_and_the_slab_carries_both(simulator: Simulator) -> None:
    m = model(joint='<joint name="up" type="slide" axis="0 0 1" stiffness="3000" damping="60"/>')
    d = mujoco.MjData(m)
    skin = SoftBody(m, simulator, body="slab", tools=["ball"], damping=20.0)
    for _ in range(2500):
        step(m, d, skin)
    touch = skin.apply(d)["ball"]
    assert touch.force == pytest.approx(MASS * GRAVITY, rel=2e-3)
    assert 3000 * -d.joint("up").qpos[0] == pytest.approx((MASS + 1.0) * GRAVITY, rel=2e-3)
    assert skin.answer().magnitude.max() == pytest.approx(touch.depth, rel=0.2)
    world = skin.skin_points(d, skin.answer())
    assert world[:, 2].min() < d.body("slab").xpos[2] - 0.5 * touch.depth


def test_momentum_is_kept_between_two_free_bodies(simulator: Simulator) -> None:
    m = model(slab='<geom name="core" size=".03" mass="1"/>', joint="<freejoint/>", at="0.004 -.003 .0115")
    m.opt.gravity[:] = 0
    d = mujoco.MjData(m)
    d.qvel[6:9] = 0, 0, -0.2  # the ball flies at the slab
    skin = SoftBody(m, simulator, body="slab", tools=["ball"])
    mujoco.mj_forward(m, d)
    mass = m.body_mass[[1, 2]]

    def momenta() -> tuple[np.ndarray, np.ndarray]:
        mujoco.mj_forward(m, d)
        mujoco.mj_subtreeVel(m, d)
        linear = mass @ d.subtree_linvel[[1, 2]]
        spins = d.subtree_angmom[[1, 2]].sum(axis=0)
        return linear, spins + np.cross(d.xipos[[1, 2]], mass[:, None] * d.subtree_linvel[[1, 2]]).sum(axis=0)

    before = momenta()
    for _ in range(80):
        step(m, d, skin)
    after = momenta()
    assert np.linalg.norm(d.qvel[:3]) > 0.02  # it was hit
    np.testing.assert_allclose(after[0], before[0], atol=1e-12)
    np.testing.assert_allclose(after[1], before[1], atol=1e-5)  # the integrator turns bodies to first order


def test_an_elastic_bounce_gives_back_what_it_took(simulator: Simulator) -> None:
    m = model(at="0 0 .0121")
    m.opt.gravity[:] = 0
    for damping, least, most in ((0.0, 0.99, 1.01), (10.0, 0.0, 0.6)):
        d = mujoco.MjData(m)
        d.qvel[2] = -0.2
        skin, book = SoftBody(m, simulator, body="slab", tools=["ball"], damping=damping), EnergyBook()
        for _ in range(120):
            step(m, d, skin)
            assert skin.reaction is not None
            book.add(skin.memory.at["ball"], skin.reaction.tools["ball"])
        kept = (d.qvel[2] / 0.2) ** 2
        assert least < kept < most
        assert book.held == pytest.approx(0.5 * MASS * 0.2**2 * (1 - kept), abs=1e-6)  # the books are exact
        assert book.most == pytest.approx(0.5 * MASS * 0.2**2, rel=0.02)


def test_wrenches_of_others_stay_and_ours_do_not_pile_up(simulator: Simulator) -> None:
    m = model()
    d = mujoco.MjData(m)
    skin, other = (SoftBody(m, simulator, body="slab", tools=["ball"]) for _ in range(2))
    skin.apply(d)
    alone = d.xfrc_applied.copy()
    assert alone.any()
    d.xfrc_applied[2, 0] = 3.0
    for _ in range(5):
        skin.apply(d)
        d.xfrc_applied[2, 0] = 3.0  # set anew at each step, as most programs do
    skin.apply(d)
    np.testing.assert_allclose(d.xfrc_applied[2] - alone[2], [3, 0, 0, 0, 0, 0], atol=1e-12)
    other.apply(d)
    skin.apply(d)
    np.testing.assert_allclose(d.xfrc_applied[1], 2 * alone[1], atol=1e-12)
    d.xfrc_applied[:] = 0  # as many programs do at each step
    skin.apply(d)
    np.testing.assert_allclose(d.xfrc_applied, alone, atol=1e-12)
    other.apply(d)
    other.reset(d)
    skin.reset(d)
    assert not d.xfrc_applied.any()


def test_a_copy_or_a_restored_state_keeps_no_wrench_of_ours(simulator: Simulator) -> None:
    m = model()
    d = mujoco.MjData(m)
    skin = SoftBody(m, simulator, body="slab", tools=["ball"])
    d.xfrc_applied[2, 1] = 2.0
    skin.apply(d)
    everything = mujoco.mjtState.mjSTATE_INTEGRATION
    kept = np.empty(mujoco.mj_stateSize(m, everything))
    mujoco.mj_getState(m, d, kept, everything)
    other = copy.copy(d)
    for _ in range(30):
        step(m, d, skin)
    mujoco.mj_setState(m, d, kept, everything)
    for data in (other, d):
        assert data.xfrc_applied[1].any()
        data.qpos[2] += 1.0  # away from the skin
        skin.apply(data)
        np.testing.assert_array_equal(data.xfrc_applied[1:3], [[0] * 6, [0, 2, 0, 0, 0, 0]])
    other = SoftBody(m, simulator, body="slab", tools=["ball"])
    d.qpos[2] -= 1.0
    other.apply(d)
    del other  # and what it exerted goes with it
    d.qpos[2] += 1.0
    skin.apply(d)
    np.testing.assert_array_equal(d.xfrc_applied[1:3], [[0] * 6, [0, 2, 0, 0, 0, 0]])


def moved_ball(limb_of: SoftLayer | Simulator, **how: Any) -> tuple[Any, SoftBody]:
    """A model of the slab with a ball that is led, and a skin of it."""
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="1e-3"/><worldbody><body name="slab">{CORE}</body><body name="hand" mocap="true" '
        'pos="0 0 .0095"><geom name="ball" type="sphere" size=".012" contype="0" conaffinity="0"/></body></worldbody>'
        "</mujoco>")  # fmt: skip
    return m, SoftBody(m, limb_of, body="slab", tools=["ball"], **how)


@pytest.mark.parametrize("how", [{"damping": 5.0}, {"friction": "dry"}, {"every": 3}], ids=str)
def test_each_data_of_a_model_has_a_memory_of_its_own(slab: SoftLayer, simulator: Simulator, how: dict[str, Any]
                                                      ) -> None:  # fmt: skip
    """Two scenes in turn, a ball at rest in each: one that jumped from scene to scene would be dragged, and damped."""
    m, skin = moved_ball(slab if "friction" in how else simulator, **how)
    scenes = [mujoco.MjData(m) for _ in range(2)]
    alone, found = [], []
    for d, x in zip(scenes, (0.0, 6e-3), strict=True):
        d.mocap_pos[0, 0] = x
    for d in scenes:
        d2 = copy.copy(d)
        for _ in range(6):
            step(m, d2, skin)
        alone.append(d2.xfrc_applied.copy())
        skin.reset(d2)
    for _ in range(6):
        for d in scenes:
            step(m, d, skin)
    found = [d.xfrc_applied for d in scenes]
    np.testing.assert_array_equal(found, alone)
    skin.reset(scenes[0])
    assert not scenes[0].xfrc_applied.any() and scenes[1].xfrc_applied.any()
    step(m, scenes[1], skin)
    np.testing.assert_array_equal(scenes[1].xfrc_applied, alone[1])


def test_a_copy_that_a_skins_wrenches_stand_in_goes_on_with_its_memory(slab: SoftLayer) -> None:
    m, skin = moved_ball(slab, friction="dry")
    d = mujoco.MjData(m)

    def led(data: Any, way: float) -> None:
        for _ in range(5):
            data.mocap_pos[0, 0] += way / 5
            step(m, data, skin)

    led(d, 0.0)
    led(d, 5e-4)
    planned, there = copy.copy(d), mujoco.MjData(m)
    led(there, 0.0)  # something else in between
    led(d, 5e-4)
    led(planned, 5e-4)
    np.testing.assert_array_equal(planned.xfrc_applied, d.xfrc_applied)
    mujoco.mj_copyData(there, m, d)
    led(d, -2e-4)
    led(there, -2e-4)
    np.testing.assert_array_equal(there.xfrc_applied, d.xfrc_applied)
    assert abs(d.xfrc_applied[:, 0]).max() > 0.01 * abs(d.xfrc_applied[:, 2]).max()


@pytest.mark.parametrize("body", ["hand", "slab"])
def test_a_copy_is_known_where_the_tool_stood_still_since_and_where_somebody_pushes(slab: SoftLayer, body: str) -> None:
    m, skin = moved_ball(slab, friction="dry")
    d, row = mujoco.MjData(m), m.body(body).id

    def led(data: Any, way: float, push: float = 0.0) -> None:
        for _ in range(5):
            data.mocap_pos[0, 0] += way / 5
            mujoco.mj_step1(m, data)
            skin.apply(data)
            if push:
                data.xfrc_applied[row, 3] = push
            mujoco.mj_step2(m, data)

    for push in (0.0, 0.25):
        led(d, 5e-4, push)
        assert skin.reaction is not None
        dragged = skin.reaction.touches["ball"].wrench[0]
        kept = copy.copy(d)
        led(d, 0.0, push)
        led(d, 0.0, push)
        for data in (copy.copy(kept), d):
            if data is d:
                mujoco.mj_copyData(d, m, kept)
            led(data, 0.0, push)
            assert skin.reaction.touches["ball"].wrench[0] == pytest.approx(dragged, rel=1e-6)
            assert abs(dragged) > 0.05 * skin.reaction.touches["ball"].force
        skin.reset(d)
        d = mujoco.MjData(m)


def test_two_skins_that_feel_one_tool_both_know_a_copy(slab: SoftLayer) -> None:
    limbs = "".join(f'<body name="slab{k}" pos="{0.05 * k} 0 0">{CORE.replace("core", f"core{k}")}</body>'
                    for k in (0, 1))  # fmt: skip
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="1e-3"/><worldbody>{limbs}<body name="hand" mocap="true" pos="0.025 0 .0095"><geom '
        'name="ball" type="sphere" size=".012" contype="0" conaffinity="0"/></body></worldbody></mujoco>')  # fmt: skip
    skins = [SoftBody(m, slab, body=f"slab{k}", tools=["ball"], friction="dry") for k in (0, 1)]
    d, found = mujoco.MjData(m), []
    for _ in range(5):
        d.mocap_pos[0, 0] += 1e-4
        mujoco.mj_step1(m, d)
        for skin in skins:
            skin.apply(d)
        mujoco.mj_step2(m, d)
    for data in (d, copy.copy(d)):
        for _ in range(3):
            mujoco.mj_step1(m, data)
            found.append([skin.apply(data)["ball"].wrench[0] for skin in skins])
            mujoco.mj_step2(m, data)
    np.testing.assert_allclose(found[:3], found[3:], rtol=1e-9)
    assert np.abs(found).min() > 0.01


@pytest.mark.parametrize("what", ["kind of geom", "body between"])
def test_geoms_that_became_others_are_refused(slab: SoftLayer, what: str) -> None:
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="slab">{CORE}</body><body name="hand" mocap="true" pos="0 0 .0095"><body '
        'name="mid"><body name="tip"><geom name="ball" type="sphere" size=".012" contype="0" conaffinity="0"/></body>'
        "</body></body></worldbody></mujoco>")  # fmt: skip
    skin, d = SoftBody(m, slab, body="slab", tools=["hand"]), mujoco.MjData(m)
    assert skin.apply(d)["hand"].force > 0
    if what == "body between":
        m.body("mid").pos[2] = 0.02
    else:
        m.geom("ball").type = mujoco.mjtGeom.mjGEOM_BOX
    with pytest.raises(InvalidInput, match="not as they were"):
        skin.apply(d)


@pytest.mark.parametrize("how", [{"damping": 5.0}, {"implicit": True}, {"friction": "dry"}], ids=str)
def test_an_instant_that_is_asked_about_again_has_the_same_answer(slab: SoftLayer, simulator: Simulator,
                                                                  how: dict[str, Any]) -> None:  # fmt: skip
    ends = []
    for times in (1, 2):
        m = model()
        skin = SoftBody(m, slab if "friction" in how else simulator, body="slab", tools=["ball"], **how)
        d = mujoco.MjData(m)
        d.qvel[:3] = 0.02, 0.0, -0.05
        for _ in range(12):
            mujoco.mj_step1(m, d)
            for _ in range(times):
                skin.apply(d)
            mujoco.mj_step2(m, d)
        ends.append(np.concatenate([d.qpos, d.xfrc_applied.ravel()]))
    np.testing.assert_array_equal(*ends)


def test_a_scene_that_is_reset_twice_before_a_step_drags_nothing(slab: SoftLayer) -> None:
    m, skin = moved_ball(slab, friction="dry")
    d = mujoco.MjData(m)
    for x in (0.0, 6e-3):
        mujoco.mj_resetData(m, d)
        d.mocap_pos[0, 0] = x
        mujoco.mj_forward(m, d)
        touch = skin.apply(d)["ball"]
    assert touch.slip is not None and np.abs(touch.slip.wrench[:3]).max() < 1e-9 * touch.force


def test_geoms_that_were_changed_after_the_skin_was_made_are_told_of(simulator: Simulator) -> None:
    m, skin = moved_ball(simulator)
    d, size = mujoco.MjData(m), m.geom("ball").size.copy()
    step(m, d, skin)
    m.geom("ball").size[0] = 8e-3
    with pytest.raises(InvalidInput, match="geoms of the tool 'ball' are not as they were"):
        skin.apply(d)
    small = SoftBody(m, skin.simulator, body="slab", tools=["ball"])
    assert small.apply(d)["ball"].force < 0.5 * skin.reaction.touches["ball"].force  # type: ignore[union-attr]
    m.geom("ball").size[:] = size
    assert skin.apply(d)["ball"].force > 0
    whole = SoftBody(m, simulator, body="slab", tools=["hand"])
    m.geom("ball").pos[0] = 0.5
    with pytest.raises(InvalidInput, match="geoms of the tool 'hand' are not as they were"):
        whole.apply(d)


def test_an_integrator_that_gives_energy_is_refused(simulator: Simulator) -> None:
    m = model()
    m.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    with pytest.raises(InvalidInput, match="RK4"):
        SoftBody(m, simulator, body="slab", tools=["ball"])


def test_reset_begins_the_same_run_again(simulator: Simulator) -> None:
    m = model()
    d = mujoco.MjData(m)
    skin = SoftBody(m, simulator, body="slab", tools=["ball"], damping=20.0)
    ends = []
    for _ in range(2):
        mujoco.mj_resetData(m, d)
        for _ in range(60):
            step(m, d, skin)
        ends.append(d.qpos.copy())
    np.testing.assert_array_equal(*ends)


def test_an_implicit_contact_is_stable_where_an_explicit_one_is_not_and_rests_at_the_same_force() -> None:
    """A tool of 6 g on a contact of some 1.5 kN/m: 2 sqrt(m / k) is 4 ms."""
    stiff = Simulator(plate(0.06, youngs_modulus=60e3), Winkler())
    still = {}
    for implicit in (False, True):
        m = model('<geom name="ball" type="sphere" size=".012" mass=".006"/>', timestep=5e-3, at="0 0 .0108")
        d = mujoco.MjData(m)
        skin = SoftBody(m, stiff, body="slab", tools=["ball"], implicit=implicit, damping=0.1)
        d.xfrc_applied[2, 2] = -1.0
        forces = []
        for _ in range(300):
            step(m, d, skin)
            assert skin.reaction is not None
            forces.append(skin.reaction.tools["ball"][2])
        still[implicit] = np.ptp(forces[-50:]), np.mean(forces[-50:])
    right = 1 + 0.006 * GRAVITY
    assert still[True][0] < 5e-3 and still[True][1] == pytest.approx(right, rel=1e-3)
    assert still[False][0] > 0.5 or still[False][1] != pytest.approx(right, rel=0.1)  # it rattles, or was thrown off


@pytest.mark.parametrize("attributes", SHAPES)
def test_the_surface_of_a_geom_has_its_volume(attributes: str) -> None:
    import trimesh

    from stmpl_sim.shapes import geom_surface

    m = model(f'<geom name="ball" {attributes} mass="1"/>')
    mesh = trimesh.Trimesh(*geom_surface(m, m.geom("ball").id))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(SHAPES[attributes], rel=0.006)
    np.testing.assert_allclose(mesh.center_mass, 0, atol=1e-9)


def test_a_mesh_and_a_body_of_several_geoms_are_tools(slab: SoftLayer) -> None:
    import trimesh

    from stmpl_sim.shapes import body_surface

    corners = " ".join(f"{x} {y} {z}" for x in (0, 0.02) for y in (0, 0.03) for z in (0, 0.04))
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><mesh name="brick" vertex="{corners}"/></asset><worldbody><body name="slab">{CORE}</body>'
        '<body name="hammer" pos="0 0 .05"><freejoint/><geom type="mesh" mesh="brick" pos="0 0 -.02" mass=".1"/>'
        '<geom type="sphere" size=".012" pos="0 0 -.02" mass=".1"/></body></worldbody>'
        '<contact><exclude body1="slab" body2="hammer"/></contact></mujoco>')  # fmt: skip
    union = trimesh.Trimesh(*body_surface(m, [1, 2], 2))
    sphere, brick = 4 / 3 * np.pi * 0.012**3, 0.02 * 0.03 * 0.04
    assert union.is_watertight
    assert union.volume == pytest.approx(brick + 7 / 8 * sphere, rel=2e-3)  # an eighth of the ball is in the brick
    skin = SoftBody(m, slab, body="slab", tools=["hammer"], method=Winkler())
    d = mujoco.MjData(m)
    d.qpos[2] = 0.031
    assert skin.apply(d)["hammer"].depth == pytest.approx(1e-3, abs=2e-4)


def test_a_tip_is_as_hard_on_a_long_stem_as_alone(slab: SoftLayer) -> None:
    def pressed(geoms: str) -> float:
        m = mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody><body name="slab">{CORE}</body><body name="hand" mocap="true" pos="0 0 .004">{geoms}'
            '</body></worldbody></mujoco>')  # fmt: skip
        touches = SoftBody(m, slab, body="slab", tools=["hand"], method=Winkler()).apply(mujoco.MjData(m))
        assert touches["hand"].trust.ok
        return touches["hand"].force

    tip, stem = ('<geom type="sphere" size=".006" contype="0" conaffinity="0"/>',
                 '<geom type="box" size=".003 .003 .3" pos="0 0 .3" contype="0" conaffinity="0"/>')  # fmt: skip
    assert pressed(tip + stem) == pytest.approx(pressed(tip), rel=0.01)


def test_a_memory_that_is_put_back_with_a_state_goes_on_as_before(slab: SoftLayer) -> None:
    m = model()
    skin = SoftBody(m, Simulator(slab.with_(tissue=slab.tissue.relaxing(HELD_SKIN)), Winkler(), friction=0.5),
                    body="slab", tools=["ball"])  # fmt: skip
    d, whole = mujoco.MjData(m), mujoco.mjtState.mjSTATE_INTEGRATION
    d.qvel[0] = 0.05
    for _ in range(60):
        step(m, d, skin)
    state, memory = np.empty(mujoco.mj_stateSize(m, whole)), skin.memory
    mujoco.mj_getState(m, d, state, whole)
    ways = []
    for _ in range(2):
        mujoco.mj_setState(m, d, state, whole)
        skin.memory = memory
        wrenches = []
        for _ in range(20):
            step(m, d, skin)
            wrenches.append(skin.reaction.tools["ball"].copy())  # type: ignore[union-attr]
        ways.append(np.array(wrenches))
    assert np.abs(ways[0][:, 0]).max() > 1e-3
    np.testing.assert_array_equal(*ways)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_state_that_is_put_back_late_or_elsewhere_with_its_memories_keeps_no_wrench_of_ours(
        simulator: Simulator, monkeypatch: pytest.MonkeyPatch, elsewhere: bool) -> None:  # fmt: skip
    """Two skins and somebody's push; what was left in between is forgotten, or never was known in that process."""
    monkeypatch.setattr("stmpl_sim.mujoco_skin.KNOWN", 4)
    whole = mujoco.mjtState.mjSTATE_INTEGRATION

    def made() -> tuple[Any, Any, list[SoftBody]]:
        m = model()
        return m, mujoco.MjData(m), [SoftBody(m, simulator, body="slab", tools=["ball"]) for _ in range(2)]

    def walked(m: Any, d: Any, skins: list[SoftBody], steps: int) -> np.ndarray:
        for _ in range(steps):
            mujoco.mj_step1(m, d)
            for skin in skins:
                skin.apply(d)
            mujoco.mj_step2(m, d)
        return d.qpos.copy()

    m, d, skins = made()
    d.xfrc_applied[2, 1], d.qvel[0] = 0.2, 0.05
    walked(m, d, skins, 20)
    state = np.empty(mujoco.mj_stateSize(m, whole))
    mujoco.mj_getState(m, d, state, whole)
    kept = pickle.dumps([skin.memory for skin in skins])
    went = walked(m, d, skins, 20)
    if elsewhere:
        before = skins  # alive, and another's
        m, d, skins = made()
        assert before[0].memory.exerted and before[0].memory.exerted.rows
    mujoco.mj_setState(m, d, state, whole)
    for skin, memory in zip(skins, pickle.loads(kept), strict=True):
        skin.memory = memory
    np.testing.assert_array_equal(walked(m, d, skins, 20), went)
    mujoco.mj_setState(m, d, state, whole)
    for skin, memory in zip(skins, pickle.loads(kept), strict=True):
        skin.memory = memory
    d.xfrc_applied[2, 0] = 3.0  # set by somebody, after the state
    d.qpos[2] += 1.0  # away from the skin
    walked(m, d, skins, 1)
    np.testing.assert_allclose(d.xfrc_applied[1:3], [[0] * 6, [3, 0.2, 0, 0, 0, 0]], atol=1e-12)


def test_a_memory_that_others_were_given_too_leaves_no_wrench_of_theirs(simulator: Simulator) -> None:
    """As a planner does, whose workers begin where another is, and which then goes on itself."""
    m, whole = model(), mujoco.mjtState.mjSTATE_INTEGRATION
    d, first = mujoco.MjData(m), SoftBody(m, simulator, body="slab", tools=["ball"])
    d.qvel[:3] = 0.02, 0.0, -0.02
    for _ in range(30):
        step(m, d, first)
    state, memory = np.empty(mujoco.mj_stateSize(m, whole)), first.memory
    mujoco.mj_getState(m, d, state, whole)
    assert first.reaction is not None and first.reaction.tools["ball"][2] > 0.01
    others = [SoftBody(m, simulator, body="slab", tools=["ball"]) for _ in range(2)]
    went = []
    for skin, data in ((others[0], mujoco.MjData(m)), (others[1], mujoco.MjData(m)), (first, d)):
        mujoco.mj_setState(m, data, state, whole)
        skin.memory = memory
        for _ in range(20):
            step(m, data, skin)
        assert skin.reaction is not None
        np.testing.assert_allclose(data.xfrc_applied[2, :3], skin.reaction.tools["ball"][:3], rtol=1e-9, atol=1e-12)
        went.append(data.qpos.copy())
    np.testing.assert_array_equal(went, went[:1] * 3)


def test_memories_that_are_put_before_any_skin_steps_leave_no_wrench(simulator: Simulator) -> None:
    m, whole = model(), mujoco.mjtState.mjSTATE_INTEGRATION
    d, first = mujoco.MjData(m), SoftBody(m, simulator, body="slab", tools=["ball"])
    for _ in range(30):
        step(m, d, first)
    state, memory = np.empty(mujoco.mj_stateSize(m, whole)), first.memory
    mujoco.mj_getState(m, d, state, whole)
    others = [(SoftBody(m, simulator, body="slab", tools=["ball"]), mujoco.MjData(m)) for _ in range(3)]
    for skin, data in others:
        mujoco.mj_setState(m, data, state, whole)
        skin.memory = memory
    for skin, data in others:
        for _ in range(5):
            step(m, data, skin)
        assert skin.reaction is not None
        np.testing.assert_allclose(data.xfrc_applied[2, :3], skin.reaction.tools["ball"][:3], rtol=1e-9, atol=1e-12)


def test_a_body_that_is_a_tool_has_what_is_welded_to_it(slab: SoftLayer) -> None:
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="slab">{CORE}</body><body name="hand" pos="0 0 .1"><freejoint/>'
        '<geom size=".01" mass=".1" contype="0" conaffinity="0"/><body pos="0 0 -.05" euler="0 90 0"><body name="tip" '
        'pos=".02 0 0"><geom size=".012" mass=".1" contype="0" conaffinity="0"/></body></body></body></worldbody>'
        '</mujoco>')  # fmt: skip
    skin, d = SoftBody(m, slab, body="slab", tools=["hand"], method=Winkler()), mujoco.MjData(m)
    d.qpos[2] = 0.07 + 0.012 - 2e-3
    assert skin.apply(d)["hand"].depth == pytest.approx(2e-3, abs=1e-4)
    apart = SoftBody(m, slab, body="slab", tools=["hand", "tip"], method=Winkler()).apply(d)
    assert apart["hand"].status == APART and apart["tip"].depth == pytest.approx(2e-3, abs=1e-4)


def test_what_is_not_of_this_contact_is_refused(simulator: Simulator) -> None:
    one = ball(RADIUS)
    other = Tool("other", one.vertices, one.faces)
    contact = SoftContact(simulator, (tool for tool in [one]))
    memory = contact.step(Poses(np.eye(4), {one.name: pose(z=RADIUS - 2e-3).tolist()})).memory
    with pytest.raises(InvalidInput, match=r"the memory is of a contact with .*; this one has other"):
        SoftContact(simulator, [other]).step(Poses(np.eye(4), {"other": pose(z=RADIUS - 2e-3)}), memory)


def test_a_memory_of_before_its_rows_is_still_taken(simulator: Simulator) -> None:
    m = model()
    d, skin = mujoco.MjData(m), SoftBody(m, simulator, body="slab", tools=["ball"])
    skin.apply(d)
    old = skin.memory
    del old.__dict__["exerted"]
    skin.memory = pickle.loads(pickle.dumps(old))
    assert skin.apply(d)["ball"].force > 0


def test_a_skin_is_not_copied_but_made_anew(simulator: Simulator) -> None:
    m = model()
    skin = SoftBody(m, simulator, body="slab", tools=["ball"])
    for attempt in (lambda: copy.copy(skin), lambda: copy.deepcopy((m, skin)), lambda: pickle.dumps(skin)):
        with pytest.raises(InvalidInput, match="Make another"):
            attempt()


def test_several_tools_feel_each_other_and_each_gets_its_own(simulator: Simulator) -> None:
    two = ('<geom name="left" type="sphere" size=".008" pos="-.01 0 0" mass=".1"/>'
           '<geom name="right" type="sphere" size=".008" pos=".01 0 0" mass=".1"/>')  # fmt: skip
    m = model(two, at="0 0 .007")
    d = mujoco.MjData(m)
    skin = SoftBody(m, simulator, body="slab", tools=["left", "right"])
    touches: Mapping[str, Touch] = skin.apply(d)
    assert touches["left"].force == pytest.approx(touches["right"].force, rel=0.03) and touches["left"].force > 0
    assert d.xfrc_applied[2, 2] == pytest.approx(touches["left"].force + touches["right"].force, rel=0.01)


def test_what_cannot_be_is_one_clear_sentence(simulator: Simulator) -> None:
    m = model()

    def make(**changes: Any) -> SoftBody:
        return SoftBody(changes.pop("model", m), simulator, **{"body": "slab", "tools": ["ball"]} | changes)

    with pytest.raises(InvalidInput, match=r"no body 'arm'. Bodies: bob, slab, world"):
        make(body="arm")
    with pytest.raises(InvalidInput, match=r"no geom or body 'probe' to be a tool. Geoms: ball, core"):
        make(tools=["probe"])
    with pytest.raises(InvalidInput, match=r"names of their own; got ball, ball"):
        make(tools=["ball", "ball"])
    with pytest.raises(InvalidInput, match=r"tools is the text 'ball'"):
        make(tools="ball")
    with pytest.raises(InvalidInput, match=r"tools is None; give a list of names"):
        make(tools=None)
    with pytest.raises(InvalidInput, match=r"'core' is part of 'slab'"):
        make(tools=["core"])
    with pytest.raises(InvalidInput, match=r"is a plane; a tool can be a sphere"):
        make(model=mujoco.MjModel.from_xml_string(
            '<mujoco><worldbody><geom name="ball" type="plane" size="1 1 1"/><body name="slab"><geom size="1" '
            'contype="0" conaffinity="0"/></body></worldbody></mujoco>'))  # fmt: skip
    with pytest.raises(InvalidInput, match=r"also collides rigidly.*<exclude body1=\"slab\" body2=\"bob\"/>"):
        make(model=model(exclude=False))
    with pytest.raises(InvalidInput, match=r"before the first apply"):
        make().answer()
    with pytest.raises(InvalidInput, match=r"model is '<mujoco/>'; MjModel is needed"):
        make(model="<mujoco/>")
    with pytest.raises(InvalidInput, match=r"implicit is 'yes'; True or False"):
        make(implicit="yes")
    with pytest.raises(InvalidInput, match=r"every is True; a whole number"):
        make(every=True)
    with pytest.raises(InvalidInput, match=r"damping is None; a finite number"):
        make(damping=None)
    with pytest.raises(InvalidInput, match=r"this Simulator has its method; leave the other one out"):
        make(method=Winkler())
    with pytest.raises(InvalidInput, match=r"memory is 'x'; Memory is needed"):
        make().memory = "x"  # type: ignore[assignment]
    for some, says in (([RADIUS], "a tool is 0.012; Tool"), (None, "tools is None; a list of Tools")):
        with pytest.raises(InvalidInput, match=says):
            SoftContact(simulator, some)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"layer is 'arm'; SoftLayer or Skin or Simulator"):
        SoftContact("arm", [ball(RADIUS)])  # type: ignore[arg-type]
    for name in ("", None):
        with pytest.raises(InvalidInput, match="a tool's name is"):
            Tool(name, ball().vertices, ball().faces)  # type: ignore[arg-type]


def test_data_of_another_model_are_refused_and_left_as_they_are(simulator: Simulator) -> None:
    m, more = model(), model(joint="<freejoint/>")
    skin, other = SoftBody(m, simulator, body="slab", tools=["ball"]), mujoco.MjData(more)
    other.xfrc_applied[:] = 0.5
    for use in (skin.apply, skin.reset, skin.poses):
        with pytest.raises(InvalidInput, match=r"data of another model.*mujoco.MjData\(model\)"):
            use(other)
    assert (other.xfrc_applied == 0.5).all() and skin.reaction is None
    skin.apply(copy.copy(mujoco.MjData(m)))
    with pytest.raises(InvalidInput, match="data is None; MjData is needed"):
        skin.apply(None)


def test_exclude_does_what_the_sentence_says(simulator: Simulator) -> None:
    from stmpl_sim import exclude

    spec = mujoco.MjSpec.from_string(
        f'<mujoco><worldbody><body name="slab">{CORE}</body><body name="bob"><freejoint/><geom name="ball" '
        'size=".01"/></body></worldbody></mujoco>')  # fmt: skip
    exclude(spec, "slab", ["ball"])
    SoftBody(spec.compile(), simulator, body="slab", tools=["ball"])
    with pytest.raises(InvalidInput, match="no geom or body 'gone'"):
        exclude(spec, "slab", ["gone"])


def test_data_that_is_not_finite_is_one_sentence(simulator: Simulator) -> None:
    m = model()
    d = mujoco.MjData(m)
    d.qpos[0] = np.nan
    with pytest.raises(InvalidInput, match=r"pose of ball holds .* not finite"):
        SoftBody(m, simulator, body="slab", tools=["ball"]).apply(d)


def test_far_tools_are_apart(simulator: Simulator) -> None:
    m = model(at="0 0 1")
    touch = SoftBody(m, simulator, body="slab", tools=["ball"]).apply(mujoco.MjData(m))["ball"]
    assert touch.status == APART and np.isnan(touch.depth) and not touch.wrench.any()


def test_a_box_stays_on_a_slope_that_friction_can_hold_and_slides_off_one_that_it_cannot(slab: SoftLayer) -> None:
    tool = '<geom name="ball" type="box" size=".012 .012 .006" mass=".2"/>'
    ways = {}
    for slope, friction in ((0.2, 0.5), (0.2, None), (0.6, 0.3)):
        m = model(tool, at="0 0 .0058")
        angle = np.arctan(slope)
        m.opt.gravity[:] = GRAVITY * np.sin(angle), 0, -GRAVITY * np.cos(angle)
        d = mujoco.MjData(m)
        skin = SoftBody(m, slab, body="slab", tools=["ball"], method=Winkler(), damping=20.0, friction=friction)
        for _ in range(120):
            step(m, d, skin)
        ways[slope, friction] = float(d.body("bob").xpos[0])
    assert abs(ways[0.2, 0.5]) < 1e-3
    assert ways[0.2, None] > 8e-3 and ways[0.6, 0.3] > 5e-3
    free = 0.5 * GRAVITY * 0.12**2  # m, down a slope of one
    assert ways[0.6, 0.3] == pytest.approx(free * (0.6 - 0.3) / np.hypot(1, 0.6), rel=0.4)


def test_friction_stands_in_one_place(simulator: Simulator, slab: SoftLayer) -> None:
    with pytest.raises(InvalidInput, match=r"this Simulator is without friction. Give it there"):
        SoftContact(simulator, [ball(RADIUS)], friction=0.3)
    with pytest.raises(InvalidInput, match=r"this Simulator has its own friction. Give it there"):
        SoftContact(Simulator(slab, Winkler(), friction=0.5), [ball(RADIUS)], friction=0.3)
    with pytest.raises(InvalidInput, match="there is no friction 'sticky'"):
        SoftContact(slab, [ball(RADIUS)], Winkler(), friction="sticky")


def test_quick_vectors_are_those_of_numpy_and_scipy() -> None:
    from scipy.spatial.transform import Rotation

    from stmpl_core.arrays import cross
    from stmpl_sim.energy import _turned

    random = np.random.default_rng(0)
    for size in (0.0, 1e-9, 1e-3, 1.0, 3.0):
        a, b = random.normal(size=(2, 3))
        np.testing.assert_array_equal(cross(a, b), np.cross(a, b))
        turn = Rotation.from_rotvec(size * a / np.linalg.norm(a))
        np.testing.assert_allclose(_turned(turn.as_matrix()), turn.as_rotvec(), rtol=1e-6, atol=1e-15)


def pressed_and_slid(contact: SoftContact, tool: str, steps: int = 240) -> tuple[np.ndarray, float, list[Memory]]:
    """A tool that goes 2 mm down and 10 mm along: forces (N, 3) [N], work done on the skin [J], and memories."""
    memory, forces, memories, work, before = Memory(), [], [], 0.0, None
    for k in range(steps + 1):
        s = k / steps
        at = pose(0.01 * s, 0.0, RADIUS - 2e-3 * np.sin(np.pi * s), Rotation.from_rotvec([0, 0.2 * s, 0]))
        made = contact.step(Poses(np.eye(4), {tool: at}), memory, 1e-3 * (k > 0))
        memory = made.memory
        forces.append(made.tools[tool][:3])
        memories.append(memory)
        if before is not None:
            work -= 0.5 * (made.tools[tool][:3] + forces[-2]) @ (at[:3, 3] - before)
        before = at[:3, 3]
    return np.array(forces), work, memories


def test_contact_between_two_steps_that_ask_goes_on_to_first_order(slab: SoftLayer) -> None:
    simulator = Simulator(slab, MomentNet(), friction=0.4)
    tool = ball(RADIUS)
    exact, spent, memories = pressed_and_slid(SoftContact(simulator, [tool]), tool.name)
    assert all(memory.asked is None or memory.asked.steps == 0 for memory in memories)
    fast, spent_fast, memories = pressed_and_slid(SoftContact(simulator, [tool], every=4), tool.name)
    steps = np.array([memory.asked.steps for memory in memories if memory.asked is not None])
    assert steps.max() == 3 and (steps > 0).mean() > 0.6
    size = np.linalg.norm(exact, axis=1)
    assert np.linalg.norm(fast - exact, axis=1).max() < 0.02 * size.max()
    assert not np.array_equal(fast, exact)
    assert spent > 0 and abs(spent_fast - spent) < 0.02 * spent


def test_a_step_that_leaves_what_a_model_holds_asks_again(slab: SoftLayer) -> None:
    simulator, tool = Simulator(slab, MomentNet()), ball(RADIUS)
    often, seldom = (SoftContact(simulator, [tool], every=every) for every in (1, 100))
    memory = Memory()
    for k, deep in enumerate((1e-3, 1.05e-3, 3e-3, -0.02, 2e-3)):
        at = Poses(np.eye(4), {tool.name: pose(z=RADIUS - deep)})
        made = seldom.step(at, memory, 1e-3 * (k > 0))
        memory = made.memory
        assert memory.asked is not None and (memory.asked.steps > 0) == (k == 1)
        fresh = often.step(at).tools[tool.name]
        np.testing.assert_allclose(made.tools[tool.name], fresh, rtol=1e-3 if k == 1 else 1e-9, atol=1e-4)
    wrong: list[dict[str, Any]] = [{"every": 2, "damping": 1.0}, {"every": 2, "implicit": True}]
    for options in [*wrong, *({"every": odd} for odd in (0, 2.5, np.nan, "2"))]:
        with pytest.raises(InvalidInput, match="every"):
            SoftContact(simulator, [tool], **options)


def test_what_does_not_fit_a_soft_contact_is_refused(simulator: Simulator) -> None:
    tool = ball(0.01)
    for odd in (1000.0, 2.0, -1.0):
        with pytest.raises(InvalidInput, match="pose_body_from_layer is not rigid"):
            SoftContact(simulator, [tool], pose_body_from_layer=np.diag([1.0, 1.0, odd, 1.0]))
        with pytest.raises(InvalidInput, match="the body is not rigid"):
            SoftContact(simulator, [tool]).step(Poses(np.diag([1.0, 1.0, odd, 1.0]), {tool.name: np.eye(4)}))
    with pytest.raises(InvalidInput, match="friction is told of Ball, which is no tool"):
        SoftContact(simulator.skin, [tool], friction={"Ball": 0.3})


def test_a_geom_of_a_body_that_is_a_tool_is_no_tool_of_its_own(simulator: Simulator) -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body name="limb"/><body name="hand" pos="0 0 .1">
    <freejoint/><geom name="a" size=".01"/><geom name="b" size=".02" contype="0" conaffinity="0"/></body></worldbody>
    </mujoco>""")
    for tools in (["hand", "a"], ["a", "hand"]):
        with pytest.raises(InvalidInput, match="'a' is a geom of tool 'hand': it would press twice"):
            SoftBody(model, simulator, body="limb", tools=tools)
    SoftBody(model, simulator, body="limb", tools=["hand", "b"])  # the body's tool has what collides of it


def test_a_tool_that_hangs_on_the_limb_needs_no_exclude(simulator: Simulator) -> None:
    hung = """<mujoco><worldbody><body name="limb"><freejoint/><geom size=".01" mass="1"/>
    <body name="hand" pos="0 0 .05"><joint type="slide" axis="0 0 1"/><geom name="ball" size=".01" mass=".1"/></body>
    </body></worldbody></mujoco>"""
    SoftBody(mujoco.MjModel.from_xml_string(hung), simulator, body="limb", tools=["ball"])
    spec = mujoco.MjSpec.from_string(hung)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    with pytest.raises(InvalidInput, match="also collides rigidly"):
        SoftBody(spec.compile(), simulator, body="limb", tools=["ball"])
