"""stmpl_sim with time and friction: damping and implicit steps of what presses, imprints; what MuJoCo must know."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stmpl_core import Prony, Simulator, SoftLayer, Tissue
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Winkler
from stmpl_sim import Memory, Poses, SoftBody, SoftContact, exchange
from stmpl_sim.protocol import Reaction
from tests.scenes import LENGTH, THICKNESS, ball, limb, plate
from tests.scenes import RADIUS as LIMB_RADIUS
from tests.test_sim import CORE, MASS, RADIUS, MassOnASpring, model, pose, step

mujoco = pytest.importorskip("mujoco", reason="pip install 'stmpl[sim]'")

TIMES = Prony((0.3, 0.3), (0.02, 0.2))


@pytest.fixture(scope="module")
def slab() -> SoftLayer:
    return plate(0.09, youngs_modulus=20e3)


@pytest.fixture(scope="module")
def slow(slab: SoftLayer) -> Simulator:
    """A slab whose stress fades."""
    return Simulator(slab.with_(tissue=Tissue(20e3, relaxation=TIMES)), Winkler())


class Free(MassOnASpring):
    """It says how easily the ball is moved, and is braked, so that it does not bounce."""

    def step(self, dt: float) -> None:
        self.push_ -= 40.0 * self.speed
        super().step(dt)

    def mobility(self, _name: str, _at: np.ndarray, _along: np.ndarray) -> float:
        return 1 / MASS


def test_an_implicit_contact_feels_tissue_relax_as_an_explicit_one_does(slow: Simulator) -> None:
    forces = {}
    for implicit in (False, True):
        world, memory = Free(1000.0), Memory()
        contact = SoftContact(slow, [ball(RADIUS)], implicit=implicit)
        forces[implicit] = []
        for _ in range(300):
            memory = exchange(contact, world, memory, 1e-3).memory
            forces[implicit].append(world.push_)
            world.step(1e-3)
    explicit, taken = (np.array(forces[k]) for k in (False, True))
    assert explicit[100] > 0.3 and np.abs(np.diff(explicit)).max() > 0.01
    np.testing.assert_allclose(taken, explicit, atol=0.05 * explicit.max())


def taken_share(reaction: Reaction, name: str) -> float:
    """Force that is exerted, over the one that the tissue carries."""
    return float(np.linalg.norm(reaction.tools[name][:3])) / reaction.touches[name].force


def test_an_implicit_contact_takes_its_stiffness_from_the_touch(slab: SoftLayer) -> None:
    """Two balls pressed into one dent: no further touch is asked for, and each shares its load with the other."""
    tools = [ball(RADIUS).named("left"), ball(RADIUS).named("right")]
    simulator, asked = Simulator(slab, Winkler()), []
    touch = simulator.touch
    contact = SoftContact(simulator, tools, implicit=True)
    places = {"left": pose(-3e-3, z=RADIUS - 2e-3), "right": pose(3e-3, z=RADIUS - 2e-3)}

    def told(contacts: Any, *more: Any) -> Any:
        asked.append(sorted(one.name for one in contacts))
        return touch(contacts, *more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator, "touch", told)
        reaction = contact.step(Poses(np.eye(4), places), Memory(), 1e-3, lambda *_: 1e4)
    assert asked == [["left", "right"]]
    alone = SoftContact(simulator, tools[:1], implicit=True).step(Poses(np.eye(4), places), Memory(), 1e-3,
                                                                  lambda *_: 1e4)  # fmt: skip
    shares = {len(one.touches): taken_share(one, "left") for one in (reaction, alone)}
    assert shares[2] > 1.02 * shares[1]  # softer beside the other: less is taken off


def test_damping_of_what_slides_and_spins_but_goes_no_deeper_is_none(slab: SoftLayer) -> None:
    plain, damped = (SoftContact(slab, [ball(RADIUS)], Winkler(), friction=0.5, damping=c) for c in (0.0, 20.0))
    way = [pose(z=RADIUS - 2e-3)]
    way += [pose(0.2e-3 * k, z=RADIUS - 2e-3, turn=Rotation.from_rotvec([0, -0.02 * k, 0])) for k in range(1, 30)]
    memory = Memory()
    for k, at in enumerate(way):
        poses = Poses(np.eye(4), {"probe": at})
        one, two = (contact.step(poses, memory, 1e-3 * (k > 0)) for contact in (plain, damped))
        touch = one.touches["probe"]
        assert touch.slip is not None
        if k == 0:
            continue
        memory = two.memory
        np.testing.assert_allclose(two.tools["probe"], one.tools["probe"], rtol=0.02, atol=2e-4)
    assert abs(touch.slip.wrench[0]) > 0.3 * touch.force  # it did slide


def test_damping_of_what_goes_deeper_leaves_friction_as_it_is(slab: SoftLayer) -> None:
    contact = SoftContact(slab, [ball(RADIUS)], Winkler(), friction=0.5, damping=10.0)
    memory = Memory()
    for k in range(20):
        at = pose(0.2e-3 * k, z=RADIUS - 1e-3 - 0.1e-3 * k)
        reaction = contact.step(Poses(np.eye(4), {"probe": at}), memory, 1e-3 * (k > 0))
        memory = reaction.memory
    touch = reaction.touches["probe"]
    assert touch.slip is not None and abs(touch.slip.wrench[0]) > 0.1 * touch.force
    pressing = touch.wrench - touch.slip.wrench
    wanted = 2 * pressing + touch.slip.wrench  # 0.1 m/s into the skin
    np.testing.assert_allclose(-reaction.tools["probe"], wanted, atol=0.01 * touch.force)


def test_the_imprint_of_a_tool_that_left_at_once_comes_back(slow: Simulator) -> None:
    contact, memory = SoftContact(slow, [ball(RADIUS)]), Memory()
    for k in range(60):
        memory = contact.step(Poses(np.eye(4), {"probe": pose(z=RADIUS - 3e-3)}), memory, 5e-3 * (k > 0)).memory
    away, depths = Poses(np.eye(4), {"probe": pose(z=0.5)}), []
    assert contact._free("probe", away.tools["probe"], Memory()) > 0
    for _ in range(20):
        reaction = contact.step(away, memory, 20e-3)
        memory = reaction.memory
        assert not reaction.tools["probe"].any()
        depths.append(contact.answer(reaction).magnitude.max())
    assert depths[0] > 0.5e-3 and (np.diff(depths) < 0).all()
    for _ in range(200):
        memory = contact.step(away, memory, 20e-3).memory
    assert not memory.tissue.tools  # forgotten, and so not asked about any more


# MuJoCo


def test_an_implicit_contact_needs_no_step_of_mujoco_before_it(slab: SoftLayer) -> None:
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="slab">{CORE}</body><body name="arm" pos="0 0 .0105"><joint axis="0 1 0" '
        'pos=".2 0 0"/><geom name="ball" type="sphere" size=".012" mass=".3"/></body></worldbody>'
        '<contact><exclude body1="slab" body2="arm"/></contact></mujoco>')  # fmt: skip
    simulator, found = Simulator(slab, Winkler()), []
    for ready in (False, True):
        d = mujoco.MjData(m)
        skin = SoftBody(m, simulator, body="slab", tools=["ball"], implicit=True)
        for k in range(2):
            d.time, d.qpos[0] = 1e-3 * k, -2e-4 * k
            if ready:
                mujoco.mj_forward(m, d)
            skin.apply(d)
        found.append(d.xfrc_applied.copy())
    assert found[0].any()
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)


def test_a_rigid_contact_with_what_is_welded_to_the_limb_is_seen(slab: SoftLayer) -> None:
    splint = '<body name="splint"><geom name="rod" size=".01"/></body>'
    simulator = Simulator(slab, Winkler())
    for joint in ("", "<freejoint/>"):
        with pytest.raises(InvalidInput, match=r"geom 'rod' of 'splint'.*<exclude body1=\"splint\" body2=\"bob\"/>"):
            SoftBody(model(slab=CORE + splint, joint=joint), simulator, body="slab", tools=["ball"])
    hinged = splint.replace("<geom", "<joint/><geom")
    SoftBody(model(slab=CORE + hinged), simulator, body="slab", tools=["ball"])
    beside = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" pos="0 0 -.1"/><body name="slab">{CORE}'
        '</body><body name="table"><geom size=".01" pos=".2 0 0"/></body><body name="bob" pos="0 0 .0115"><freejoint/>'
        '<geom name="ball" size=".012"/></body></worldbody><contact><exclude body1="slab" body2="bob"/></contact>'
        '</mujoco>')  # fmt: skip
    d = mujoco.MjData(beside)
    skin = SoftBody(beside, simulator, body="slab", tools=["ball"])  # floor and table stand still, as the slab does
    step(beside, d, skin)


def lifted(friction: str) -> np.ndarray:
    """A limb of 0.2 kg that two fingers squeeze with 6 N each and, from 0.2 s to 0.5 s, lift by 30 mm.

    Returns:
        Height above the floor [m] and force that each finger presses with [N], a row a millisecond, (800, 3).
    """
    fingers = "".join(f'<body name="{name}" pos="{side * (LIMB_RADIUS + RADIUS + 1e-3)} 0 0"><joint name="{name}" '
                      f'type="slide" axis="{-side} 0 0" damping="5"/><geom name="{name}" size="{RADIUS}" mass=".1" '
                      'contype="0" conaffinity="0"/></body>'
                      for name, side in (("left", -1), ("right", 1)))  # fmt: skip
    m = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="1e-3"/><worldbody><geom type="plane" size="1 1 .1"/><body name="limb"><freejoint/>'
        f'<geom type="cylinder" size="{LIMB_RADIUS - THICKNESS} {LENGTH / 2}" pos="0 0 {LENGTH / 2}" mass=".2"/></body>'
        f'<body name="hand" mocap="true" pos="0 0 .09">{fingers}</body></worldbody>'
        '<actuator><motor joint="left"/><motor joint="right"/></actuator></mujoco>')  # fmt: skip
    d = mujoco.MjData(m)
    skin = SoftBody(m, limb(youngs_modulus=20e3), body="limb", tools=["left", "right"], method=Winkler(),
                    damping=5.0, friction=friction)  # fmt: skip
    d.ctrl[:] = 6.0
    rows = []
    for k in range(800):
        d.mocap_pos[0, 2] = 0.09 + 1e-4 * min(max(k - 200, 0), 300)
        step(m, d, skin)
        assert skin.reaction is not None
        rows.append((d.body("limb").xpos[2], *(skin.reaction.touches[name].force for name in ("left", "right"))))
    return np.array(rows)


def test_two_fingers_lift_a_limb_that_friction_can_hold_and_leave_one_that_it_cannot() -> None:
    height, *forces = lifted("dry").T
    assert np.abs(height[:200]).max() < 1e-3
    np.testing.assert_allclose(height[500:], 0.03, atol=6e-3)  # in the air, hung on skin that bends
    for force in forces:
        np.testing.assert_allclose(force[200:], 6.0, atol=0.2)
    assert np.abs(lifted("oiled")[:, 0]).max() < 1e-3  # 2 x 0.1 x 6 N carry less than its weight
