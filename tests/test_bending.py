"""Laws of the joints that a node hears of: what is not known of them is said. Driven without a bus."""

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from bags.wire import header, joints_from
from stmpl_core import Joint, Rig, Skin, SoftLayer
from stmpl_core.errors import InvalidInput
from stmpl_core.methods import Winkler
from stmpl_ros import bending as module
from stmpl_ros.bending import Bending
from stmpl_ros.parameters import NodeConfig
from tests.scenes import LENGTH, limb
from tests.test_posing import hinged


class Ear:
    """Stands for a node's Hearing: it keeps what was refused and hands on what the test sends."""

    def __init__(self) -> None:
        self.active, self.refused, self.said = True, [], []
        self.now: Any = SimpleNamespace(simulated=False)
        self.events: Any = SimpleNamespace(subscribe=lambda *_: None)
        self.gate: Any = SimpleNamespace(refuse=lambda kind, why: self.refused.append(why), fresh=lambda *_: True,
                                         say=lambda kind, text: self.said.append(text))  # fmt: skip


def with_two_hinges(layer: SoftLayer) -> Rig:
    z = layer.vertices[:, 2] / LENGTH
    weights = np.stack([z < 0.3, (z >= 0.3) & (z < 0.7), z >= 0.7], axis=1).astype(float)
    heads = np.array([[0.0, 0, 0], [0, 0, 0.3 * LENGTH], [0, 0, 0.7 * LENGTH]])
    joints = Joint("first", "middle", (0, 1, 0)), Joint("second", "end", (0, 1, 0), -0.5, 0.5)
    return Rig(("root", "middle", "end"), (-1, 0, 1), heads, weights, joints)


@pytest.fixture(scope="module")
def layer() -> SoftLayer:
    return limb(8e-3)


@pytest.fixture
def bent(layer, monkeypatch):
    """A Bending that listens, on a limb with two hinges, and its ear; no machine is so slow that it finds a silence."""
    monkeypatch.setattr(module, "SILENT_S", 1e3)
    ear = Ear()
    config = NodeConfig(tissue="paper", joint_states="joints")
    hears = Bending(SimpleNamespace(destroy_subscription=lambda _: None), ear, lambda: config)  # type: ignore[arg-type]
    hears.move_to(Skin.of(layer.with_(rig=with_two_hinges(layer)), Winkler()))
    hears.open()
    yield hears, ear
    hears.close()


def tell(hears: Bending, stamp: int, **angles: float) -> None:
    hears._on_joints(JointState(header=header("", stamp), name=list(angles), position=list(angles.values())))


def settle(hears: Bending) -> None:
    assert hears._thread is not None and hears._thread.wait(60.0)


def test_a_joint_that_was_never_heard_of_is_named(bent):
    hears, _ = bent
    assert "no joint states of the limb on joints yet" in hears.doubt
    tell(hears, 1, first=0.1)
    settle(hears)
    assert "no joint states of second on joints yet" in hears.doubt
    tell(hears, 1, second=0.2)  # another sensor, at the same instant
    settle(hears)
    assert hears.doubt == "" and hears.newest is not None and hears.newest.angles == (0.1, 0.2)


def test_a_joint_that_falls_silent_beside_one_that_speaks_is_named(bent, monkeypatch):
    hears, _ = bent
    tell(hears, 1, first=0.1, second=0.2)
    settle(hears)
    now = time.monotonic()
    monkeypatch.setattr(module.time, "monotonic", lambda: now + 3e3)
    tell(hears, 2, first=0.15)
    settle(hears)
    assert "no joint states of second for 3000 s" in hears.doubt


def test_time_in_which_the_node_could_not_listen_is_no_silence(bent, monkeypatch):
    hears, _ = bent
    tell(hears, 1, first=0.1, second=0.2)
    settle(hears)
    now = time.monotonic()
    monkeypatch.setattr(module.time, "monotonic", lambda: now + 3e3)
    assert "no joint states for 3000 s" in hears.doubt
    hears.held_up(2.5e3)
    assert hears.doubt == ""
    monkeypatch.setattr(module.time, "monotonic", lambda: now + 5e3)
    assert "no joint states for 2500 s" in hears.doubt


def test_a_stamp_that_is_sent_for_ever_is_a_silence_and_of_a_paused_simulation_none(bent, monkeypatch):
    hears, ear = bent
    tell(hears, 5, first=0.1, second=0.2)
    settle(hears)
    now = time.monotonic()
    monkeypatch.setattr(module.time, "monotonic", lambda: now + 3e3)
    tell(hears, 5, first=0.1, second=0.2)
    assert "no joint states for 3000 s" in hears.doubt and "not after the last one's" in ear.said[-1]
    ear.now.simulated = True
    tell(hears, 5, first=0.1, second=0.2)
    settle(hears)
    assert hears.doubt == ""
    monkeypatch.setattr(module.time, "monotonic", lambda: now + 6e3)
    ear.now.simulated = False
    tell(hears, 4, first=0.1, second=0.2)
    settle(hears)
    assert hears.doubt == "", "a sensor that was silent may start its clock again"


def test_until_the_skin_is_bent_as_was_told_answers_are_in_doubt(bent, layer):
    hears, _ = bent
    tell(hears, 1, first=0.1, second=0.2)
    settle(hears)
    assert hears.doubt == ""
    rest = Skin.of(layer.with_(rig=with_two_hinges(layer), youngs_modulus=9e3), Winkler())
    held, hears._thread.put = hears._thread.put, lambda item: None  # the thread is busy
    hears.move_to(rest)
    assert hears.newest is rest and "not bent as the joint states say yet" in hears.doubt
    hears._thread.put = held
    tell(hears, 2, first=0.1, second=0.2)
    settle(hears)
    assert hears.doubt == "" and hears.newest.angles == (0.1, 0.2)


def test_another_limb_takes_over_with_joints_of_its_own(bent, layer):
    hears, ear = bent
    tell(hears, 1, first=0.1, second=0.2)
    other = Skin.of(layer.with_(rig=hinged(layer)), Winkler())
    hears.move_to(other)
    tell(hears, 2, elbow=0.3)
    settle(hears)
    assert not ear.refused and hears.doubt == "" and hears.newest is not None and hears.newest.angles == (0.3,)


def test_an_angle_beyond_the_limits_of_the_limb_that_takes_over_is_refused_and_said(bent, layer):
    hears, ear = bent
    tell(hears, 1, first=0.1, second=0.4)
    rig = with_two_hinges(layer)
    second = Joint("second", "end", (0, 1, 0), -0.2, 0.2)
    narrow = Rig(rig.bones, rig.parents, rig.heads, rig.weights, (rig.joints[0], second))
    hears.move_to(Skin.of(layer.with_(rig=narrow), Winkler()))
    assert "second is 0.4 rad; it goes from -0.2 to 0.2" in ear.refused[-1] and "no joint states" in hears.doubt


def test_who_tells_of_other_joints_may_leave_positions_out():
    names = {"elbow": "elbow_2"}
    assert joints_from(JointState(name=["gripper"], effort=[1.0]), names) == {}
    with pytest.raises(InvalidInput, match="0 positions for 1 names"):
        joints_from(JointState(name=["elbow_2"], effort=[1.0]), names)


def test_a_joint_that_is_told_twice_in_one_message_is_refused_and_one_of_no_rig_is_not():
    names = {"elbow": "elbow_2"}
    with pytest.raises(InvalidInput, match="joint elbow_2 is there 2 times"):
        joints_from(JointState(name=["elbow_2", "elbow_2"], position=[0.1, 0.9]), names)
    twice = JointState(name=["elbow_2", "gripper", "gripper"], position=[0.1, 0.0, 0.0])
    assert joints_from(twice, names) == {"elbow": 0.1}
