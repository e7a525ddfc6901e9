"""Laws of a node whose skin relaxes and rubs: what it remembers is in its recording, whole in every frame."""

import itertools
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import rclpy
from std_srvs.srv import Trigger
from stmpl_msgs.msg import LocalContact, Touch
from stmpl_msgs.srv import SetBody

from bags.frame import Frame
from bags.replay import Replayed, replay, replay_run
from bags.run import Run
from bags.wire import local_contact_from, stamp_ns
from stmpl_core import State
from stmpl_core.methods import MomentNet
from stmpl_core.touch import STALE
from stmpl_ros.topics import STREAM
from tests.bag_scene import stmpl
from tests.bus import end, start
from tests.node_bus import Bus, Hand
from tests.scenes import LENGTH, RADIUS, at

NODE = """
import sys
from stmpl_ros.node import run
from stmpl_ros.parameters import NodeConfig
from tests.node_bus import skin
config = NodeConfig(tissue="paper", rest_after=0.4, fade=0.8, friction="probe: dry, finger: 0.1", relaxing=True)
sys.exit(run(config, sys.argv[1:], build=skin))
"""
EMPTY = State().pack()


class Recorded(NamedTuple):
    """A recording, and the stamps of the first answers after what has the node forget [ns], by what it was."""

    folder: Path
    firsts: dict[str, int]
    refused: set[int]


def slid(way: float, depth: float = 2e-3) -> np.ndarray:
    return at(RADIUS + 0.012 - depth, 0, LENGTH / 2 - 0.015 + way)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recorded]:
    """A slide with all that may happen to it; the node ends by Ctrl-C in the midst of one."""
    folder = tmp_path_factory.mktemp("memory") / "run"
    node, recorder = start("-c", NODE), start("-m", "stmpl_ros.cli", "record", "--path", str(folder))
    rclpy.init()
    bus, rng, firsts, refused = Bus(), np.random.default_rng(2), {}, set()
    bus.partner = node

    def slide(hand: Hand, ways: np.ndarray, name: str = "") -> None:
        """Some are waited for, some come in bursts, some cannot be used; gaps are uneven."""
        for k, way in enumerate(ways):
            bus.spin(float(rng.choice([0.0, 0.002, 0.01, 0.06])))
            if k % 6 == 5:
                refused.add(hand.send(at(float("nan"), 0, 0)))
            elif k % 3 and name:
                hand.send(slid(way))
            else:
                answer = hand.ask(slid(way))
                firsts.setdefault(name, answer.header.stamp.sec * 10**9 + answer.header.stamp.nanosec)

    try:
        bus.wait(lambda: bus.got["skin/topology"], "skin/topology")
        hand = bus.tool("probe")
        bus.wait(lambda: bus.node.count_subscribers("skin/displacement") == 2, "the recorder")
        bus.wait(lambda: hand.pose.get_subscription_count() == 2, "the node and the recorder")
        bus.spin(0.5)
        slide(hand, np.linspace(0, 0.012, 25), "begun")
        slide(hand, np.linspace(0.012, 0.006, 12), "and back")
        bus.spin(0.7)  # the answer begins to fade
        slide(hand, np.linspace(0.006, 0.009, 8), "after a pause")
        finger = bus.tool("finger")
        bus.wait(lambda: finger.pose.get_subscription_count() == 2, "the node and the recorder")

        def two_at_a_time() -> bool:
            finger.send(at(-RADIUS - 0.011, 0, LENGTH / 2 + 2e-5 * len(bus.got["skin/displacement"])))
            hand.send(slid(0.009))
            bus.spin(0.01)
            return sum(len(one.touches) == 2 for one in bus.got["skin/displacement"]) > 5

        bus.wait(two_at_a_time, "answers to both")
        slide(hand, np.full(60, 0.009), "without the finger")
        hand.take_away()
        bus.wait(lambda: bus.said("'probe' is taken away"), "word of it")
        bus.still()
        hand = bus.tool("probe").ready()
        slide(hand, np.linspace(0.0, 0.01, 12), "returned")
        assert bus.call(SetBody, "set_body", youngs_modulus=1300.0).success
        slide(hand, np.linspace(0.01, 0.02, 12), "another body")
        assert bus.call(Trigger, "reset").success
        slide(hand, np.linspace(0.02, 0.01, 12), "reset")
        bus.still()
        slide(hand, np.linspace(0.01, 0.0, 12), "rested")
        hand.send(slid(0.001))
        hand.send(slid(0.002))
        code, said = end(node, signal.SIGINT)
        assert code == 0 and "Traceback" not in said, said
        bus.partner = None
        bus.spin(0.5)
    finally:
        node.kill()
        code, said = end(recorder, signal.SIGINT)
        bus.node.destroy_node()
        rclpy.shutdown()
    assert code == 0, said
    yield Recorded(folder, firsts, refused)


@pytest.fixture(scope="module")
def frames(recorded: Recorded) -> list[Frame]:
    return list(Run(recorded.folder).frames())


def fresh(frame: Frame) -> bool:
    return bool(frame.touches) and all(touch.status != STALE for touch in frame.touches.values())


def test_every_answer_replays_bit_for_bit_from_whichever_frame(recorded: Recorded, frames: list[Frame]) -> None:
    summary = replay_run(recorded.folder, MomentNet())
    assert summary.identical == summary.frames == len(frames) > 80, str(summary)
    assert summary.remembering == sum(bool(frame.state) for frame in frames) > 70
    late = [one for one in replay(recorded.folder, MomentNet(), every=7)][3:]
    assert len(late) > 5 and all(one.identical for one in late)
    for one in late:  # and what a touch says of friction
        for name, touch in one.answer.touches.items():
            told = one.frame.touches[name]
            if told.status != STALE:
                assert (told.slip is None) == (touch.slip is None) and told.passive == touch.passive
                np.testing.assert_array_equal(told.wrench, touch.wrench)
                assert told.slip is None or touch.slip is None or told.slip.share == touch.slip.share


def test_the_state_after_one_answer_is_that_before_the_next(recorded: Recorded, frames: list[Frame]) -> None:
    held, before = 0, None
    for one in replay(recorded.folder, MomentNet()):
        if before is not None and fresh(one.frame) and follows(before, one):
            assert before.after is not None
            assert before.after.pack() == one.frame.state, f"answers {before.frame.sequence} and {one.frame.sequence}"
            held += 1
        if fresh(one.frame):
            before = one
    assert held > 40


def follows(before: Replayed, one: Replayed) -> bool:
    """Whether an answer goes on from another one: nothing was forgotten, and no instant lies between."""
    known = State.unpack(one.frame.state).tools
    then = one.frame.stamp_ns - before.frame.stamp_ns
    return bool(known) and abs(then - one.frame.dt * 1e9) < 1 and "probe" in known and "probe" in before.frame.touches


def test_whatever_has_the_node_forget_leaves_an_empty_state(recorded: Recorded, frames: list[Frame]) -> None:
    states = {frame.stamp_ns: frame.state for frame in frames if fresh(frame)}
    for name in ("begun", "returned", "reset", "rested"):
        assert states[recorded.firsts[name]] == EMPTY, name
    assert states[recorded.firsts["after a pause"]] != EMPTY, "what fades is not at rest yet"
    layers = [frame.layer_id for frame in frames]
    other = next(frame for frame in frames if frame.layer_id != layers[0] and fresh(frame))
    assert other.state == EMPTY and len(set(layers)) == 2
    assert not {frame.stamp_ns for frame in frames} & recorded.refused
    assert all(not frame.state and not frame.touches for frame in frames if not frame.inputs), "rest needs no state"


def test_skin_that_a_silent_tool_left_sunk_is_told_of(recorded: Recorded, frames: list[Frame]) -> None:
    told = {frame.stamp_ns: "finger was left out of the contacts" in frame.trust.why for frame in frames}
    known = {frame.stamp_ns: "finger" in frame.touches for frame in frames}
    alone = [stamp for stamp in told if recorded.firsts["without the finger"] <= stamp < recorded.firsts["returned"]]
    assert sum(told[stamp] for stamp in alone) > 5
    assert not any(told[stamp] for stamp in told if stamp not in alone or known[stamp])


def test_friction_and_its_kind_are_in_the_messages(frames: list[Frame]) -> None:
    slips = [touch.slip for frame in frames for touch in frame.touches.values() if touch.slip is not None]
    assert {"creep", "slide"} <= {slip.kind for slip in slips}
    told = {name: mu for frame in frames for name, mu in frame.friction.items()}
    assert told == {"probe": 0.5, "finger": 0.1}
    sliding = max(slips, key=lambda slip: slip.share)
    assert np.linalg.norm(sliding.wrench[:3]) > 0


def test_info_and_compare_say_that_it_remembers(recorded: Recorded, capsys: pytest.CaptureFixture[str]) -> None:
    code, said = stmpl(capsys, "info", recorded.folder)
    assert code == 0 and "carry a state" in said and "probe 0.5" in said and "relaxing" in said
    code, said = stmpl(capsys, "compare", recorded.folder, "--frames", "1")
    assert code == 0 and "only one side has friction and relaxation" in said, said
    code, said = stmpl(capsys, "compare", recorded.folder, "--frames", "1", "--tolerance-mm", "100")
    assert code == 1, "nothing was judged"
    _, said = stmpl(capsys, "compare", recorded.folder, "--with", recorded.folder)
    assert "moment_net against" in said and "only one side" not in said


def test_local_contacts_of_a_node_that_remembers_carry_friction_and_what_has_relaxed() -> None:
    """The newest is that of the answer of its stamp: its wrench, friction and all."""
    node = start("-c", NODE)
    rclpy.init()
    bus = Bus()
    bus.partner = node
    try:
        bus.wait(lambda: bus.got["skin/topology"], "skin/topology")
        hand = bus.tool("probe")
        heard = bus.listen(LocalContact, "tools/probe/local_contact", STREAM)
        bus.wait(lambda: hand.pose.get_subscription_count() == 1, "the node")
        ways = itertools.cycle(0.005 * (1 - np.cos(np.linspace(0, 2 * np.pi, 200))))

        def pair() -> tuple[LocalContact, Touch] | None:
            hand.send(slid(next(ways)))
            bus.spin(0.02)
            answers = {stamp_ns(one): one for one in bus.got["skin/displacement"]}
            both = [(one, answers[stamp_ns(one)].touches[0]) for one in bus.got["tools/probe/local_contact"]
                    if stamp_ns(one) in answers]  # fmt: skip
            return both[-1] if len(both) > 10 else None

        model, touch = bus.wait(pair, "local contacts of answers")
        bus.node.destroy_subscription(heard)
    finally:
        end(node, signal.SIGINT)
        bus.node.destroy_node()
        rclpy.shutdown()
    assert model.friction_limit > 0.5 and model.eased > 0 and model.power > 1
    told = local_contact_from(model)
    assert told.grip is not None
    for ours, force in ((told.wrench, touch.wrench.force), (told.grip.wrench, touch.friction_wrench.force)):
        np.testing.assert_allclose(ours[:3], (force.x, force.y, force.z), atol=1e-9)
