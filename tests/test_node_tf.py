"""Laws of frames that move: poses and wrenches wait for /tf at their stamp, a dead /tf is told, tools are frames."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TransformStamped, WrenchStamped
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from stmpl_msgs.msg import ContactMesh, SkinDisplacement

from bags.moving import MovingFrames
from bags.wire import (
    NANO,
    header,
    pose_message,
    rigid,
    stamp_ns,
    tool_message,
    wrench_from,
    wrench_message,
)
from stmpl_core.errors import FrameError, InvalidInput
from stmpl_ros.diagnosis import Tally
from stmpl_ros.domain import DOMAINS
from stmpl_ros.followed import Followed
from stmpl_ros.frames import Frames
from stmpl_ros.gate import Gate
from stmpl_ros.hearing import Hearing
from stmpl_ros.node import SkinNode
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.ticks import Ticks
from stmpl_ros.topics import KEPT, STREAM
from tests import tf2_stand_in
from tests.bus import in_process
from tests.node_bus import HERE, skin
from tests.scenes import ball

MS = 1_000_000
SPEED = np.array([0.0, 0.0, 0.126])  # of the frame "base" in the body's [m/s]
begun = [0]  # stamp at which "base" is at the body's origin [ns]


class Scene(NamedTuple):
    """A node in this process, and who tells it of frames, poses and wrenches."""

    node: SkinNode
    heard: list[SkinDisplacement]
    health: list[DiagnosticStatus]
    poses: list[PoseStamped]
    pose: Callable[[int], None]
    wrench: Callable[[int], None]
    move: Callable[[int], None]
    wait: Callable[[Callable[[], object]], None]

    def now(self) -> int:
        return self.node.get_clock().now().nanoseconds


@pytest.fixture(autouse=True)
def tf2(monkeypatch) -> None:
    """tf2_ros itself where it is installed."""
    if find_spec("tf2_ros") is None:
        monkeypatch.setitem(sys.modules, "tf2_ros", tf2_stand_in)
        monkeypatch.setattr(tf2_stand_in, "__spec__", SimpleNamespace(name="tf2_ros"), raising=False)


def base_at(stamp: int) -> np.ndarray:
    """pose_body_from_base (4, 4) at a stamp [ns]: it moves along the limb."""
    place = np.eye(4)
    place[:3, 3] = SPEED * ((stamp - begun[0]) / NANO)
    return place


def told(parent: str, child: str, place: np.ndarray, stamp: int) -> TransformStamped:
    pose = pose_message(place, parent, stamp).pose
    message = TransformStamped(header=header(parent, stamp), child_frame_id=child)
    message.transform.translation.x, message.transform.translation.y = pose.position.x, pose.position.y
    message.transform.translation.z, message.transform.rotation = pose.position.z, pose.orientation
    return message


@pytest.fixture
def scene(request) -> Iterator[Scene]:
    begun[0] = time.time_ns()
    config = NodeConfig(**getattr(request, "param", {}))
    with in_process(lambda context: SkinNode(config, skin, context=context)) as (node, other, wait):
        heard, health, poses = list[SkinDisplacement](), list[DiagnosticStatus](), list[PoseStamped]()
        other.create_subscription(SkinDisplacement, "skin/displacement", heard.append, STREAM)
        other.create_subscription(DiagnosticArray, "/diagnostics", lambda m: health.append(m.status[0]), STREAM)
        other.create_subscription(PoseStamped, "tools/finger/pose", poses.append, STREAM)
        mesh = other.create_publisher(ContactMesh, "contact_mesh", KEPT)
        pose = other.create_publisher(PoseStamped, "tools/finger/pose", STREAM)
        wrench = other.create_publisher(WrenchStamped, "tools/finger/wrench", STREAM)

        def send(stamp: int) -> None:
            pose.publish(pose_message(np.linalg.inv(base_at(stamp)) @ HERE, "base", stamp))

        def push(stamp: int) -> None:
            wrench.publish(wrench_message(np.array([-0.03, 0, 0, 0, 0, 0]), "base", stamp))

        def move(stamp: int) -> None:
            node.hearing.frames._buffer.set_transform(told("body", "base", base_at(stamp), stamp), "test")

        node.trigger_configure()
        node.trigger_activate()
        mesh.publish(tool_message(ball().named("finger"), 0))
        wait(lambda: "finger" in node.hearing.tools)
        yield Scene(node, heard, health, poses, send, push, move, wait)


def test_a_pose_in_a_moving_frame_is_where_that_was_at_its_stamp(scene):
    first = scene.now()
    scene.wait(lambda: scene.pose(first) or scene.node.hearing._patience._streams)  # before /tf says where base is
    assert scene.node.hearing.inbox.pose_of("finger") is None
    for k in range(5):
        scene.move(first - 20 * MS + 33 * k * MS)  # at 30 Hz; the pose's stamp lies between two of them
    scene.wait(lambda: scene.node.hearing.inbox.pose_of("finger") is not None)
    np.testing.assert_allclose(scene.node.hearing.inbox.pose_of("finger"), HERE, atol=1e-7)
    assert scene.node.tally.refused == 0


def test_a_replay_finds_frames_where_a_node_does():
    """A tree of moving frames, one beside the other and one on the other, and one that stands still."""
    rng, hears, plays = np.random.default_rng(5), tf2_stand_in.Buffer(), MovingFrames()
    if find_spec("tf2_ros"):
        from tf2_ros import Buffer

        hears = Buffer()
    for parent, child, stamps in (("world", "body", range(0, 900, 90)), ("world", "arm", range(5, 900, 31)),
                                  ("arm", "hand", range(0, 900, 45)), ("hand", "camera", [0])):  # fmt: skip
        for stamp in stamps:
            place = np.eye(4)
            place[:3, :3], place[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
            sent, still = told(parent, child, place, NANO + stamp * MS), child == "camera"
            (hears.set_transform_static if still else hears.set_transform)(sent, "test")
            plays.hear(SimpleNamespace(transforms=[sent]), still=still)
    for body, frame in (("body", "camera"), ("world", "hand"), ("camera", "arm"), ("hand", "camera")):
        for stamp in NANO + MS * np.array([90, 222, 333, 500, 801]):
            found = hears.lookup_transform(body, frame, Time(nanoseconds=int(stamp))).transform
            t, q = found.translation, found.rotation
            np.testing.assert_allclose(plays.place(body, frame, int(stamp)),
                                       rigid((t.x, t.y, t.z), (q.x, q.y, q.z, q.w)), atol=1e-9)  # fmt: skip
    with pytest.raises(FrameError, match=r"'camera' was at 1\.950 s: 'hand' was told from 1\.000 to 1\.855 s"):
        plays.place("world", "camera", NANO + 950 * MS)
    with pytest.raises(FrameError, match="nothing joins it to 'body'"):
        plays.place("body", "elsewhere", NANO + 100 * MS)


def test_a_replay_places_a_frame_that_stood_still_then_moved_and_stood_still_again():
    plays = MovingFrames()

    def tell(x: float, stamp: int, *, still: bool) -> None:
        place = np.eye(4)
        place[0, 3] = x
        plays.hear(SimpleNamespace(transforms=[told("body", "arm", place, stamp)]), still=still)

    tell(7.0, 0, still=True)
    for k in range(5):
        tell(float(k), NANO + k * NANO, still=False)
    tell(9.0, 0, still=True)
    asked = np.array([0.5, 1.0, 2.5, 5.0, 5.5])
    assert [plays.place("body", "arm", int(t * NANO))[0, 3] for t in asked] == [7.0, 0.0, 1.5, 4.0, 9.0]


@pytest.mark.parametrize("turn", [(np.nan, 0, 0, 1), (0, 0, 0, 0), (0, 0, 0, 1.5), (0, 0, 0, 1)])
def test_a_replay_passes_over_transforms_that_tf2_does_not_take(turn):
    plays = MovingFrames()
    for x, stamp in ((0.0, NANO), (1.0, 2 * NANO), (np.nan if turn[3] == 1 else 9.0, 3 * NANO // 2)):
        place = np.eye(4)
        place[0, 3] = 0 if stamp == 3 * NANO // 2 else x
        sent = told("body", "arm", place, stamp)
        if stamp == 3 * NANO // 2:
            sent.transform.translation.x, q = x, sent.transform.rotation
            q.x, q.y, q.z, q.w = map(float, turn)
        plays.hear(SimpleNamespace(transforms=[sent]), still=False)
    assert plays.place("body", "arm", 3 * NANO // 2)[0, 3] == 0.5


def test_a_dead_tf_is_told_within_a_fifth_of_a_second_and_its_poses_are_not_answered(scene):
    def going() -> None:
        scene.move(scene.now())
        scene.pose(scene.now() - 2 * MS)

    scene.wait(lambda: going() or len(scene.heard) > 3)
    died = scene.now()
    answered = [stamp_ns(one) for one in scene.heard]
    scene.wait(lambda: scene.pose(scene.now()) or scene.node.tally.refused)
    assert scene.now() - died < 1000 * MS  # 100 ms of patience, and whatever else this machine is at
    assert "/tf did not say within 0.1 s" in scene.node.tally.last_refusal
    assert "'base'" in scene.node.tally.last_refusal and "finger" in scene.node.tally.last_refusal
    scene.wait(lambda: scene.pose(scene.now()) or (scene.health and scene.health[-1].level == DiagnosticStatus.ERROR))
    assert "nothing that came could be used" in scene.health[-1].message
    assert all(stamp_ns(one) <= died for one in scene.heard if one.touches and one.fade == 1), answered
    scene.wait(lambda: going() or scene.health[-1].level == DiagnosticStatus.OK)  # and it recovers


@pytest.mark.parametrize("scene", [{"tf_wait": 10.0, "max_age": 0.0}], indirect=True)
def test_of_poses_that_waited_together_the_newest_is_answered(scene):
    first, streams = scene.now(), scene.node.hearing._patience._streams
    stamps = [first + k * MS for k in range(4)]
    for k, stamp in enumerate(stamps):
        scene.pose(stamp)
        scene.wait(lambda k=k: len(streams.get("pose of finger", ((),))[0]) > k)
    scene.move(first - NANO // 50)
    scene.move(stamps[2])  # the last one's instant is not known yet
    scene.wait(lambda: scene.heard)
    assert scene.node.hearing.inbox.inputs["finger"].pose.stamp == stamps[2] and scene.node.tally.refused == 0
    scene.move(stamps[3])
    scene.wait(lambda: scene.node.hearing.inbox.inputs["finger"].pose.stamp == stamps[3])


def test_a_wrench_in_a_moving_frame_waits_too_and_its_torque_is_taken_to_the_tool(scene):
    def going() -> None:
        now = scene.now()
        scene.pose(now)
        scene.wrench(now)
        scene.move(now + MS)

    scene.wait(lambda: going() or any(one.touches and one.touches[0].force_bound for one in scene.heard))
    assert scene.node.hearing.inbox.inputs["finger"].wrench.value is not None and scene.node.tally.refused == 0


@pytest.mark.parametrize("scene", [{"tf_tools": ("finger=tool0",), "tf_rate": 200.0}], indirect=True)
def test_a_tool_may_be_a_frame_of_tf_and_what_it_is_taken_for_is_sent_for_a_recorder(scene):
    in_base = np.eye(4)
    in_base[:3, 3] = 0.01, 0.02, -0.03

    def going() -> None:
        now = scene.now()
        buffer = scene.node.hearing.frames._buffer
        scene.move(now)
        buffer.set_transform(told("base", "tool0", np.linalg.inv(base_at(now)) @ HERE, now), "test")

    scene.wait(lambda: going() or (scene.heard and scene.poses))
    np.testing.assert_allclose(scene.node.hearing.inbox.pose_of("finger"), HERE, atol=1e-7)
    assert scene.poses[-1].header.frame_id == "body"
    answer = next(one for one in reversed(scene.heard) if one.touches and one.touches[0].pose_stamp.sec)
    stamp = answer.touches[0].pose_stamp.sec * NANO + answer.touches[0].pose_stamp.nanosec
    scene.wait(lambda: any(stamp_ns(one) == stamp for one in scene.poses))  # the answer names a pose that was sent


@pytest.mark.parametrize("scene", [{"tf_tools": ("finger=tool0",)}], indirect=True)
def test_a_tool_of_tf_is_told_of_when_tf_never_knew_it_and_when_it_dies(scene):
    """A part of its chain dies while the rest goes on."""

    def going(table: bool) -> None:
        now, buffer = scene.now(), scene.node.hearing.frames._buffer
        if table:
            scene.move(now)
        buffer.set_transform(told("base", "tool0", np.linalg.inv(base_at(now)) @ HERE, now), "test")

    def lost() -> bool:
        newest = scene.health[-1] if scene.health else DiagnosticStatus()
        said = "/tf has not said for" in newest.message and "frame 'tool0' is, which is finger" in newest.message
        return said and newest.level == DiagnosticStatus.STALE

    def well() -> bool:
        return scene.health[-1].level == DiagnosticStatus.WARN and "/tf" not in scene.health[-1].message  # two senders

    scene.wait(lost)
    scene.wait(lambda: going(True) or (scene.heard and well()))
    lines, said = list[str](), scene.node.hearing.gate.say
    scene.node.hearing._followed._say = lambda kind, text: (lines.append(text), said(kind, text))
    died = time.monotonic()
    scene.wait(lambda: going(False) or lines)
    assert time.monotonic() - died < 1.0 and "'tool0'" in lines[0]  # 100 ms of patience, and what else is going on
    scene.wait(lambda: going(False) or lost())
    scene.wait(lambda: going(True) or well())


def test_where_tf_has_just_begun_a_tool_of_it_waits_until_its_whole_chain_was_told():
    """The newest time of both frames lies before the arm's first."""
    frames, heard = Frames("body", {}, SimpleNamespace()), list[PoseStamped]()
    clock = SimpleNamespace(create_publisher=lambda *_: SimpleNamespace(publish=lambda message: None),
                            create_timer=lambda *_, **__: None)  # fmt: skip
    config = NodeConfig(tf_tools=("finger=tool0",))
    followed = Followed(clock, frames, lambda: config, time.monotonic_ns, lambda kind, said: None,  # type: ignore[arg-type]
                        lambda tool, pose: heard.append(pose))  # fmt: skip
    followed.follow("finger")
    frames._buffer.set_transform(told("body", "base", np.eye(4), NANO), "test")
    frames._buffer.set_transform(told("base", "tool0", HERE, NANO + 30 * MS), "test")
    followed._look()
    assert not heard
    frames._buffer.set_transform(told("body", "base", np.eye(4), NANO + 33 * MS), "test")
    followed._look()
    assert [stamp_ns(pose) for pose in heard] == [NANO + 30 * MS]


@pytest.mark.parametrize("scene", [{"tf_tools": ("finger=tool0",), "tf_rate": 200.0, "max_age": 0.0}], indirect=True)
def test_a_simulation_that_begins_anew_is_not_placed_by_the_tf_of_its_last_run(scene):
    hearing, buffer = scene.node.hearing, scene.node.hearing.frames._buffer
    buffer.set_transform_static(told("body", "table", np.eye(4), 0), "test")
    off = HERE.copy()
    off[2, 3] += 0.02
    buffer.set_transform(told("table", "tool0", off, scene.now() + 8 * NANO), "test")
    scene.wait(lambda: hearing.inbox.pose_of("finger") is not None)
    hearing.now.on_back()
    scene.wait(lambda: buffer.set_transform(told("table", "tool0", HERE, scene.now()), "test")
               or hearing.inbox.pose_of("finger") is not None)  # fmt: skip
    np.testing.assert_allclose(hearing.inbox.pose_of("finger"), HERE, atol=1e-7)


def test_tools_of_tf_are_refused_where_nobody_listens_to_it(monkeypatch):
    monkeypatch.setattr("stmpl_ros.frames.find_spec", lambda name: None)
    context = rclpy.Context()
    context.init(domain_id=int(os.environ["ROS_DOMAIN_ID"]) + DOMAINS)
    try:
        with pytest.raises(InvalidInput, match="tf_tools needs the package tf2_ros"):
            SkinNode(NodeConfig(tf_tools=("finger=tool0",)), skin, context=context)
    finally:
        context.try_shutdown()
        context.destroy()


def test_a_sensors_torque_is_moved_to_the_tools_origin():
    sensor = np.eye(4)
    sensor[:3, 3] = 0.0, 0.0, 0.1
    tool = np.eye(4)
    tool[:3, 3] = 0.0, 0.0, 0.03
    wrench = wrench_message(np.array([2.0, 0, 0, 0, 0.5, 0]), "sensor", 0)
    found = wrench_from(wrench, body_frame="body", tool="ball", pose_body_from_tool=tool,
                        frames=Frames("body", {"sensor": sensor}).at(0))  # fmt: skip
    np.testing.assert_allclose(found, [2, 0, 0, 0, 0.5 + 0.07 * 2, 0], atol=1e-15)


class Simulation(NamedTuple):
    """A node on a simulated clock, and who says that."""

    node: Any
    ticks: Ticks
    say: Callable[[float], None]
    leave: Callable[[], None]


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    simulated = [Parameter("use_sim_time", value=True)]

    def make(context: rclpy.Context) -> Any:
        return rclpy.create_node("sim", context=context, parameter_overrides=simulated)

    with in_process(make) as (node, other, wait):
        clock = other.create_publisher(Clock, "/clock", 10)

        def say(seconds: float) -> None:
            told = Clock(clock=TimeMessage(sec=int(seconds), nanosec=round(seconds % 1 * 1e9)))
            wait(lambda: node.get_clock().now().nanoseconds == round(seconds * 1e9), lambda: clock.publish(told))

        def leave() -> None:
            other.destroy_publisher(clock)
            wait(lambda: not node.count_publishers("/clock"))

        yield Simulation(node, Ticks(node), say, leave)


def test_a_simulation_slower_than_its_clock_is_not_silent_and_one_that_is_gone_is(simulation):
    node, ticks, say, leave = simulation
    backs = []
    ticks.on_back = lambda: backs.append(1)
    gate = Gate(node, Tally())
    assert not gate.fresh(3 * 10**9, 1.0) and "nothing was heard on /clock" in gate.dropped
    say(10.0)
    assert not gate.fresh(3 * 10**9, 1.0) and "7.00 s before now" in gate.dropped
    ticks.look()
    before = ticks()
    time.sleep(0.05)
    assert ticks() == before, "a paused simulation is not silent"
    ticks.look()
    assert ticks.simulated and ticks.paused
    say(10.5)
    ticks.look()
    assert not ticks.paused
    assert ticks() - before == NANO // 2
    say(3.0)
    assert backs and ticks() - before == NANO // 2, "the count never goes back"
    say(3.25)
    assert ticks() - before == 3 * NANO // 4
    leave()
    ticks.look()
    gone = ticks()
    assert 0 <= gone - before - 3 * NANO // 4 < NANO, "it goes on from where it was"
    time.sleep(0.02)
    assert ticks() - gone >= 20 * MS, "by the wall's clock"
    assert ticks.doubt.startswith("use_sim_time is set and /clock stands still at 3.25 s, and nobody sends it")


def test_a_clock_that_stands_still_while_stamps_go_on_is_gone_and_no_paused_simulation(simulation):
    _, ticks, say, _ = simulation
    say(10.0)
    ticks.look(9 * NANO)
    ticks.look(10 * NANO + 10 * MS)
    assert ticks.paused and not ticks.doubt, "a message that came before its clock"
    before = ticks()
    ticks.look(11 * NANO)
    assert not ticks.simulated and not ticks.paused
    assert ticks.doubt.startswith("use_sim_time is set and /clock stands still at 10.00 s, while stamps go on")
    assert 0 <= ticks() - before < NANO, "it goes on from where it was"
    time.sleep(0.02)
    assert ticks() - before >= 20 * MS, "what is sent no more is silent"
    ticks.look(11 * NANO)
    assert ticks.doubt, "also once the stamps stand still too"
    say(11.0)
    ticks.look(11 * NANO)
    assert ticks.simulated and not ticks.doubt


def test_a_node_says_that_its_clock_is_gone_where_it_refuses_what_comes(simulation):
    node, ticks, say, _ = simulation
    say(10.0)
    hearing = SimpleNamespace(gate=Gate(node, Tally()), now=ticks)
    Hearing.look(hearing)
    assert not hearing.gate.fresh(12 * NANO, 1.0) and "Are the clocks in step" in hearing.gate.dropped
    for _ in range(2):
        assert Hearing.look(hearing) == ticks.doubt != ""
    assert not hearing.gate.fresh(13 * NANO, 1.0)
    assert hearing.gate.dropped == (f"a message stamped 3.00 s after now was dropped; allowed is 1.0 s: {ticks.doubt}. "
                                    "max_age:=0 accepts any age.")  # fmt: skip
    say(13.0)
    assert Hearing.look(hearing) == "" and hearing.gate.fresh(13 * NANO, 1.0)
