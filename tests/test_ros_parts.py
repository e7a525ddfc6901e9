"""Laws of what the ROS side is made of: conversions, instants, scripts, the marker's bytes. No process is started."""

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from time import monotonic
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from numba.core.event import install_listener
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from stmpl_msgs.action import SetBody
from stmpl_msgs.msg import LocalContact as LocalContactMessage
from stmpl_msgs.msg import SkinDisplacement
from visualization_msgs.msg import Marker

from bags.wire import (
    MOST_TOLD,
    displacement_message,
    floats,
    frame_from,
    layer_from,
    local_contact_from,
    local_contact_message,
    pose_from,
    pose_message,
    pose_of_tool,
    quaternion_from,
    tool_from,
    tool_message,
    topology_message,
    wrench_from,
    wrench_message,
)
from stmpl_core import Answer, Contact, Membrane, Ply, Prony, State, Tissue, Tools, Touch
from stmpl_core.body import Body
from stmpl_core.bones import Bone, to_bone
from stmpl_core.compiling import Compiling
from stmpl_core.errors import FrameError, InvalidInput, MeshError
from stmpl_core.layer import MAX_EXTENT, layer_id
from stmpl_core.living import living
from stmpl_core.local_contact import Grip, LocalContact
from stmpl_core.skin import published
from stmpl_core.state import fresh
from stmpl_core.touch import BY_POSE, PULLING, STALE, TOUCHING, Slip
from stmpl_core.trust import Trust
from stmpl_ros.body_action import BodyAction
from stmpl_ros.calibration import Calibration, strokes_of
from stmpl_ros.diagnosis import Tally
from stmpl_ros.gate import OFTEN, QUIET, SAY_EVERY, Gate
from stmpl_ros.hearing import Hearing
from stmpl_ros.inbox import PATIENCE, Inbox
from stmpl_ros.parameters import NodeConfig
from stmpl_ros.recorder import RecorderNode
from stmpl_ros.scripts import DEEPEST, ON_LIMBS, ON_ONE_LAYER, PRESS, Device, Keyframe, Motion, scripts_for
from stmpl_ros.show import SkinMarker
from stmpl_ros.spinning import ros
from stmpl_ros.waiting import Aside
from tests.scenes import at, ball, limb, scaled

MS = 1_000_000
unit = st.floats(-1, 1).filter(lambda x: abs(x) > 1e-3)


@given(st.tuples(unit, unit, unit, unit))
def test_rotation_to_quaternion_and_back_is_the_same_rotation(q):
    rotation = Rotation.from_quat(q).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    np.testing.assert_allclose(pose_from(pose_message(pose, "body", 0).pose), pose, atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(quaternion_from(rotation)).as_matrix(), rotation, atol=1e-12)


def test_wrench_in_tool_axes_is_the_same_wrench_in_body_axes():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", (0.3, -0.7, 1.1)).as_matrix()
    in_body = np.arange(1.0, 7.0)
    in_tool = np.concatenate([pose[:3, :3].T @ in_body[:3], pose[:3, :3].T @ in_body[3:]])
    frames = {"body": in_body, "probe": in_tool}
    for frame, values in frames.items():
        message = wrench_message(values, frame, 0)
        read = wrench_from(message, body_frame="body", tool="probe", pose_body_from_tool=pose)
        np.testing.assert_allclose(read, in_body, atol=1e-12)


def test_a_layer_keeps_its_id_and_every_bit_through_a_message():
    layer = published(limb(6e-3))
    message = topology_message(layer, "body", 5)
    back = layer_from(message)
    assert back.vertices.tobytes() == layer.vertices.tobytes()
    assert layer_id(back) == layer_id(layer) == message.layer_id
    assert layer_id(layer.with_(youngs_modulus=2e3)) != message.layer_id


def test_a_stack_and_its_core_go_through_a_message():
    tissue = Tissue(3e3, 0.45, skin=Membrane(2e5, 1.5e-3, 20.0), deeper=(Ply(6e-3, 15e3, name="muscle"),))
    layer = published(to_bone(limb(6e-3), [Bone(np.zeros(3), np.array([0, 0, 0.2]), 0.01)]).with_(tissue=tissue))
    message = topology_message(layer, "body", 5)
    back = layer_from(message)
    assert back.tissue == tissue and back.core.tobytes() == layer.core.tobytes()
    assert layer_id(back) == layer_id(layer) == message.layer_id
    message.stack = '{"skin": 3}'
    with pytest.raises(InvalidInput, match="stack of a SkinTopology"):
        layer_from(message)


def test_relaxation_of_one_material_goes_through_a_message():
    layer = published(limb(6e-3)).with_(tissue=Tissue(2e4, 0.4, relaxation=Prony((0.1, 0.37), (1 / 3, 8.79), "here")))
    back = layer_from(topology_message(layer, "body", 5))
    assert back.tissue == layer.tissue and layer_id(back) == layer_id(layer)
    assert layer_id(layer.with_(tissue=Tissue(2e4, 0.4))) != layer_id(layer)


def test_a_message_from_before_stacks_is_one_material():
    message = topology_message(published(limb(6e-3)), "body", 5)
    old = SimpleNamespace(**{name: getattr(message, name) for name in message.get_fields_and_field_types()
                             if name not in ("core", "stack")})  # fmt: skip
    assert layer_id(layer_from(old)) == message.layer_id


def test_a_tool_keeps_its_mesh_through_a_message():
    tool = ball()
    back = tool_from(tool_message(tool, 0))
    assert back.name == tool.name == "probe"
    np.testing.assert_allclose(back.vertices, tool.vertices, atol=1e-9)
    np.testing.assert_array_equal(back.faces, tool.faces)


def test_flat_arrays_hold_float32_in_the_order_of_the_rows():
    rows = np.arange(12.0).reshape(4, 3)
    assert floats(rows).typecode == "f"
    np.testing.assert_array_equal(np.frombuffer(floats(rows), np.float32), rows.ravel())


def _moved(x: float, **quaternion: float) -> PoseStamped:
    message = pose_message(np.eye(4), "body", 0)
    message.pose.position.x = x
    for axis, value in quaternion.items():
        setattr(message.pose.orientation, axis, value)
    return message


@pytest.mark.parametrize(
    ("message", "error", "says"),
    [
        (pose_message(np.eye(4), "map", 0), FrameError, "frame 'map'; known are 'body'"),
        (_moved(float("nan")), InvalidInput, "not finite"),
        (_moved(float("inf")), InvalidInput, "not finite"),
        (_moved(120.0), InvalidInput, "120.0 m .* millimetres"),
        (_moved(1e300), InvalidInput, r"1e\+300 m .* millimetres"),
        (_moved(0.1, w=0.0), InvalidInput, "length 0"),
        (_moved(0.1, w=float("nan")), InvalidInput, "nan"),
    ],
)
def test_a_pose_that_cannot_be_meant_is_refused_and_told_why(message, error, says):
    with pytest.raises(error, match=says):
        pose_of_tool(message, "probe", "body")


def test_a_wrench_that_cannot_be_meant_is_refused_and_told_why():
    here = {"body_frame": "body", "tool": "probe", "pose_body_from_tool": np.eye(4)}
    with pytest.raises(FrameError, match="'map'; known are 'body', 'probe'"):
        wrench_from(wrench_message(np.zeros(6), "map", 0), **here)
    with pytest.raises(InvalidInput, match="not finite"):
        wrench_from(wrench_message(np.full(6, np.nan), "body", 0), **here)
    with pytest.raises(InvalidInput, match=r"holds a number beyond 1e\+94"):
        wrench_from(wrench_message(np.full(6, 1e95), "body", 0), **here)
    here["pose_body_from_tool"] = at(MAX_EXTENT, 0, 0)
    read = wrench_from(wrench_message(np.full(6, MOST_TOLD), "table", 0), frames={"table": np.eye(4)}, **here)
    assert Contact(ball(), np.eye(4), read).wrench is not None, "what is let in can be answered"


class Moving(Mapping):
    """Frames that are found when they are asked for, and not listed: as /tf's are."""

    def __getitem__(self, frame: str) -> np.ndarray:
        return {"camera": np.diag([-1.0, -1.0, 1.0, 1.0])}[frame]

    def __iter__(self):
        return iter(())

    def __len__(self) -> int:
        return 0


def test_poses_and_wrenches_in_a_frame_that_only_tf_knows_are_turned_into_the_bodys():
    pose = pose_of_tool(pose_message(np.eye(4), "camera", 0), "probe", "body", Moving())
    np.testing.assert_array_equal(pose, np.diag([-1, -1, 1, 1]))
    wrench = wrench_message(np.arange(1.0, 7.0), "camera", 0)
    found = wrench_from(wrench, body_frame="body", tool="probe", pose_body_from_tool=np.eye(4), frames=Moving())
    np.testing.assert_array_equal(found, [-1, -2, 3, -4, -5, 6])


def test_a_mesh_that_cannot_be_meant_is_refused_and_told_why():
    good = ball()
    with pytest.raises(MeshError, match="millimetres"):
        tool_from(tool_message(scaled(good, 1e3), 0))
    nameless = tool_message(good, 0)
    nameless.header.frame_id = ""
    with pytest.raises(FrameError, match="frame_id"):
        tool_from(nameless)
    empty = tool_message(good, 0)
    empty.triangles = []
    with pytest.raises(MeshError, match="F > 0"):
        tool_from(empty)
    torn = tool_message(good, 0)
    torn.vertices = torn.vertices[:-1]
    with pytest.raises(InvalidInput, match="three"):
        tool_from(torn)


def _inbox(*tools: str) -> Inbox:
    known = Tools()
    for name in tools:
        known.add(ball().named(name))
    return Inbox(known, "body", 250 * MS)


def _push(force: float, stamp: int):
    return wrench_message(np.array([force, 0, 0, 0, 0, 0]), "body", stamp)


@pytest.mark.parametrize("order", ["pose first", "wrench first"])
def test_pose_and_wrench_of_one_stamp_are_answered_together_in_either_order(order):
    inbox = _inbox("probe")
    inbox.put_pose("probe", np.eye(4), 1 * MS, 0)
    inbox.put_wrench("probe", _push(1, 1 * MS), 1 * MS, 0)
    assert inbox.take(0) is not None
    puts = [
        lambda: inbox.put_pose("probe", np.eye(4), 2 * MS, 5),
        lambda: inbox.put_wrench("probe", _push(2, 2 * MS), 2 * MS, 5),
    ]
    for put in puts if order == "pose first" else puts[::-1]:
        assert inbox.take(5) is None
        put()
    instant = inbox.take(5)
    assert instant is not None and instant.stamp == 2 * MS and instant.skew == 0
    assert instant.contacts[0].wrench is not None and instant.contacts[0].wrench[0] == 2


def test_each_instant_is_answered_once():
    inbox = _inbox("probe")
    inbox.put_pose("probe", np.eye(4), 1 * MS, 0)
    assert inbox.take(0) is not None
    assert inbox.take(0) is None


def test_messages_out_of_order_or_repeated_are_dropped_and_counted():
    inbox = _inbox("probe")
    assert inbox.put_pose("probe", np.eye(4), 5 * MS, 0)
    assert not inbox.put_pose("probe", np.eye(4), 5 * MS, 1)
    assert not inbox.put_pose("probe", np.eye(4), 4 * MS, 2)
    assert inbox.out_of_order == 2
    assert inbox.put_pose("probe", np.eye(4), 4 * MS, 300 * MS), "a device that was silent may start its clock again"


@pytest.mark.parametrize("stamp", [0, 5 * MS])
def test_a_stamp_that_is_sent_for_ever_is_no_news_after_any_silence_until_it_is_forgotten(stamp):
    inbox = _inbox("probe")
    inbox.put_wrench("probe", _push(1, stamp), stamp, 0)
    assert inbox.put_pose("probe", np.eye(4), stamp, 0) and inbox.take(0) is not None
    for now in range(10 * MS, 2000 * MS, 10 * MS):
        assert not inbox.put_pose("probe", np.eye(4), stamp, now)
        assert not inbox.put_wrench("probe", _push(1, stamp), stamp, now)
        assert inbox.take(now) is None and bool(inbox.live(now)) == (now <= 250 * MS)
    inbox.forget()
    assert inbox.put_pose("probe", np.eye(4), stamp, 2000 * MS)


def test_a_message_that_is_sent_again_while_the_clock_stands_still_is_known():
    inbox = _inbox("probe")
    assert not inbox.repeats("pose", "probe", 0, 0), "the first one is none"
    inbox.put_pose("probe", np.eye(4), 5 * MS, 10 * MS)
    assert inbox.repeats("pose", "probe", 5 * MS, 20 * MS) and not inbox.repeats("wrench", "probe", 5 * MS, 20 * MS)
    assert not inbox.repeats("pose", "probe", 6 * MS, 20 * MS)
    assert not inbox.repeats("pose", "probe", 5 * MS, 120 * MS), "the clock goes on, and a sender that does not is told"


def test_a_silent_tool_is_no_longer_in_contact():
    inbox = _inbox("probe", "thumb")
    inbox.put_pose("probe", np.eye(4), 1 * MS, 0)
    inbox.put_pose("thumb", np.eye(4), 400 * MS, 400 * MS)
    instant = inbox.take(400 * MS)
    assert instant is not None and [contact.name for contact in instant.contacts] == ["thumb"]
    assert inbox.take(900 * MS) is None and not inbox.live(900 * MS)


def test_streams_that_fall_silent_are_named():
    inbox = _inbox("probe", "thumb")
    inbox.put_wrench("probe", _push(1, 1 * MS), 1 * MS, 0)
    for name in ("probe", "thumb"):
        inbox.put_pose(name, np.eye(4), 1 * MS, 0)
    both = inbox.take(0)
    assert both is not None and both.lost == () and inbox.silence(100 * MS) == 100 * MS
    inbox.put_pose("probe", np.eye(4), 400 * MS, 400 * MS)
    alone = inbox.take(400 * MS)
    assert alone is not None and alone.lost == ("pose of thumb", "wrench of probe")
    assert inbox.dumb(400 * MS) == ["probe"] and not inbox.dumb(100 * MS)
    assert alone.contacts[0].wrench is None
    inbox.put_pose("probe", np.eye(4), 1600 * MS, 1600 * MS)
    later = inbox.take(1600 * MS)
    assert later is not None and later.lost == ("wrench of probe",), "a tool put away is not spoken of for ever"


def test_wrenches_that_are_refused_are_told_of_until_one_can_be_used_or_none_comes():
    inbox = _inbox("probe")

    def told(now: int):
        inbox.put_pose("probe", np.eye(4), now * MS, now * MS)
        instant = inbox.take(now * MS)
        assert instant is not None
        return instant.lost, dict(instant.refused)

    inbox.refuse_wrench("probe", "not finite", 0)
    refused = {"probe": "the wrenches of probe are refused: not finite"}
    assert told(1) == ((), refused)
    inbox.put_wrench("probe", _push(1, 2 * MS), 2 * MS, 2 * MS)
    inbox.refuse_wrench("probe", "not finite", 200 * MS)
    assert told(2) == ((), {}), "one among others is passed over"
    assert told(300) == ((), refused), "that is why there is none"
    assert told(900) == (("wrench of probe",), {})


def test_one_line_of_a_kind_comes_through_and_tells_how_many_did_not(monkeypatch):
    said, now = [], [0.0]
    logger = SimpleNamespace(warning=said.append)
    gate = Gate(SimpleNamespace(get_logger=lambda: logger), Tally())  # type: ignore[arg-type]
    monkeypatch.setattr("stmpl_ros.gate.time.monotonic", lambda: now[0])

    def line(kind: str, text: str, time: float) -> str | None:
        before, now[0] = len(said), time * SAY_EVERY
        gate.say(kind, text)
        return said[-1] if len(said) > before else None

    assert line("nan", "not finite", 0.0) == "not finite"
    assert line("frame", "wrong frame", 0.1) == "wrong frame", "another kind is not held back"
    assert [line("nan", "not finite", t) for t in (0.2, 0.9)] == [None, None]
    assert line("nan", "infinite", 1.0) == "infinite (2 more of its kind before)", "of this or another text"
    assert line("nan", "not finite", 2.5) == "not finite"

    # what goes on and on is told rarely, until it was over
    lines = [bool(line("lost", "no wrench", 10 + 0.5 * k)) for k in range(140)]
    assert sum(lines[:10]) == OFTEN and sum(lines[10:]) == 2
    assert line("lost", "no wrench", 80.0 + QUIET) and line("lost", "no wrench", 81.0 + QUIET)


def test_kernels_are_told_of_as_they_are_compiled():
    said: list[str] = []
    with install_listener("numba:compile", Compiling(said.append)):
        twice = njit(lambda x: 2 * x)
        assert twice(2) == 4 == twice(2) and twice(1.5) == 3, "two kernels, and one of them again"
    assert [one[:29] for one in said] == ["compiling kernels, number 1; "], "a line is enough for a while"
    with install_listener("numba:compile", Compiling(said.append, after=60.0)):
        assert njit(lambda x: 3 * x)(2) == 6
    assert len(said) == 1, "a moment is not told of"


def test_a_share_of_an_answer_is_smaller_stale_and_not_to_be_trusted():
    touch = Touch("probe", TOUCHING, at(0.1, 0, 0), np.arange(6.0), depth=1e-3, pressure=np.ones(3))
    answer = Answer(np.full((3, 3), 2e-3), Trust(error_bound=1e-4, why="fine"), "any", np.ones(3), {"probe": touch})
    share = answer.faded(0.25, "no pose")
    np.testing.assert_array_equal(share.displacement, 5e-4)
    assert share.pressure is None, "nothing was solved for"
    assert {name: one.status for name, one in share.touches.items()} == {"probe": STALE}
    assert not share.touches["probe"].wrench.any() and share.touches["probe"].pressure is None
    assert not share.trust.in_range and share.trust.error_bound is None
    assert share.trust.why == "fine; no pose"


def test_an_answer_keeps_what_each_tool_does_through_a_message():
    """Figures to the last bit; the pose to what a quaternion rounds."""
    rng, stamps = np.random.default_rng(4), {"finger": (3 * 10**9 + 7, 10**9 + 1), "thumb": (2 * MS, 0)}
    turned = at(0.1, -0.2, 0.3)
    turned[:3, :3] = Rotation.from_euler("xyz", (0.3, -0.7, 1.1)).as_matrix()
    touches = {"finger": Touch("finger", TOUCHING, turned, rng.normal(size=6), depth=1.2345678901e-3,
                               force_bound=0.0123456789, trust=Trust(in_range=False)),
               "thumb": Touch("thumb", BY_POSE, np.eye(4), rng.normal(size=6), missing=rng.normal(size=6), passive=0.7,
                              slip=Slip(rng.normal(size=6), 0.3, np.ones(3), 0.1, np.ones(3)))}  # fmt: skip
    displacement, trust = rng.normal(0, 1e-3, (5, 3)), Trust(True, False, 2e-4, "a word")
    state = State({"thumb": fresh(turned, 2)})
    answer = Answer(displacement, trust, "any", rng.uniform(0, 9, 5), touches)
    message = displacement_message(answer, layer_id="id", body_frame="body", stamp_ns=5 * MS, sequence=8,
                                   solve_seconds=0.25, inputs=stamps, fade=0.5, why="another",
                                   state=state, dt=1 / 3, friction={"thumb": 0.1})  # fmt: skip
    sent = deserialize_message(serialize_message(message), SkinDisplacement)
    back = frame_from(sent, 6 * MS)
    assert (back.stamp_ns, back.log_time_ns, back.sequence, back.layer_id) == (5 * MS, 6 * MS, 8, "id")
    assert (back.fade, back.solve_seconds, back.method, back.inputs) == (0.5, 0.25, "any", stamps)
    assert back.trust == Trust(True, False, float(np.float32(2e-4)), "a word; another")
    assert back.displacement.tobytes() == answer.displacement.astype(np.float32).tobytes()
    assert back.pressure.tobytes() == answer.pressure.astype(np.float32).tobytes()
    assert list(back.touches) == ["finger", "thumb"]
    assert (back.state, back.dt, back.friction) == (state.pack(), 1 / 3, {"finger": 0.0, "thumb": 0.1})
    for name, touch in touches.items():
        found = back.touches[name]
        assert (found.name, found.status, found.trust.in_range) == (name, touch.status, touch.trust.in_range)
        np.testing.assert_array_equal([found.depth, found.force_bound], [touch.depth, touch.force_bound])
        assert found.wrench.tobytes() == touch.wrench.tobytes()
        assert found.missing.tobytes() == touch.missing.tobytes() and found.passive == touch.passive
        assert (found.slip is None) == (touch.slip is None) and found.force == touch.force
        if found.slip and touch.slip:
            assert found.slip.wrench.tobytes() == touch.slip.wrench.tobytes()
            assert (found.slip.share, found.slip.kind) == (touch.slip.share, "creep")
        np.testing.assert_allclose(found.pose_body_from_tool, touch.pose_body_from_tool, atol=1e-12)


def test_a_local_contact_keeps_every_bit_through_a_message():
    rng, pose = np.random.default_rng(3), np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", (0.3, -0.7, 1.1)).as_matrix(), (0.1, 0.2, 0.3)
    grip = Grip(rng.normal(size=(3, 6)), rng.normal(size=3), rng.uniform(1, 2, size=3), 0.55)
    model = LocalContact(pose, rng.normal(size=6), rng.normal(size=(6, 6)), 4e-4, 0.02, "found", Trust(in_range=False),
                         grip, 1.7, 0.3)  # fmt: skip
    message = local_contact_message("probe", model, "touching", "body", 5 * MS)
    sent = deserialize_message(serialize_message(message), LocalContactMessage)
    assert (sent.name, sent.header.frame_id, sent.header.stamp.nanosec) == ("probe", "body", 5 * MS)
    back = local_contact_from(sent)
    np.testing.assert_array_equal(back.wrench, model.wrench)
    np.testing.assert_array_equal(back.stiffness, model.stiffness)
    assert back.grip is not None and (back.power, back.eased, back.grip.limit) == (1.7, 0.3, 0.55)
    for told, meant in zip(back.grip, grip, strict=True):
        np.testing.assert_array_equal(told, meant)
    np.testing.assert_allclose(back.pose_body_from_tool, pose, atol=1e-12)
    assert (back.valid_m, back.valid_rad, back.status, back.trust.in_range) == (4e-4, 0.02, "touching", False)
    for name, value in (("power", float("nan")), ("eased", -1.0), ("valid_m", float("inf")), ("friction_limit", -1.0),
                        ("friction_stiffness", [0.0] * 3)):  # fmt: skip
        spoilt = deserialize_message(serialize_message(message), LocalContactMessage)
        setattr(spoilt, name, value)
        with pytest.raises(InvalidInput, match="the local model's"):
            local_contact_from(spoilt)


def test_two_tools_in_step_are_answered_once_an_instant():
    inbox, answered = _inbox("finger", "thumb"), []
    for stamp in range(1, 6):
        for name in ("finger", "thumb"):
            inbox.put_pose(name, np.eye(4), stamp * MS, stamp * MS)
            instant = inbox.take(stamp * MS)
            answered += [(instant.stamp, len(instant.contacts), instant.skew)] if instant else []
    # the first instant comes before the second tool is known to be there
    assert answered[1:] == [(stamp * MS, 2, 0) for stamp in range(1, 6)]


def test_devices_whose_clocks_never_agree_are_answered_after_some_patience_and_flagged():
    inbox, skews = _inbox("probe"), []
    for k in range(1, 20):
        inbox.put_wrench("probe", _push(1, 0), 10 * k * MS - 3 * MS, 10 * k * MS)
        inbox.put_pose("probe", np.eye(4), 10 * k * MS, 10 * k * MS)
        instant = inbox.take(10 * k * MS)
        skews += [instant.skew] if instant else []
    assert len(skews) == 19 - PATIENCE
    assert set(skews) == {3 * MS}


def test_marker_bytes_are_the_marker_that_they_replace():
    layer = limb(8e-3)
    move = np.random.default_rng(0).normal(0, 1e-3, layer.vertices.shape)
    message = deserialize_message(SkinMarker(layer, "body", scale=1e-3).frame(move, 12 * 10**9 + 34), Marker)
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (12, 34, "body")
    points = np.array([(p.x, p.y, p.z) for p in message.points])
    np.testing.assert_array_equal(points, (layer.vertices + move)[layer.faces.ravel()])
    assert len(message.colors) == len(points)
    colors = np.array([(c.r, c.g, c.b, c.a) for c in message.colors])
    assert colors.min() >= 0 and colors.max() <= 1 and (colors[:, 3] == 1).all()


def test_a_device_moves_without_jumps_and_meets_its_keyframes():
    for device in (d for script in (*ON_ONE_LAYER.values(), *ON_LIMBS.values()) for d in script.devices):
        for key in device.keyframes:
            assert device.at(key.time) == pytest.approx((key.depth, key.along))
        depths = np.array([device.at(t)[0] for t in np.arange(0, device.keyframes[-1].time, 1e-3)])
        assert np.abs(np.diff(depths)).max() < 1e-4  # m in a millisecond


def test_a_device_follows_the_skin_and_pushes_along_its_normal():
    layer = limb()
    motion = Motion(PRESS.devices[0], layer)
    for time in np.linspace(0, PRESS.seconds, 17):
        pose, wrench = motion.at(time)
        depth, _ = PRESS.devices[0].at(time)
        assert np.hypot(*pose[:2, 3]) == pytest.approx(0.04 - depth, abs=3e-4)  # the limb is round, 40 mm
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        force = wrench[:3]
        if depth <= 0:
            assert not wrench.any()
        else:
            np.testing.assert_allclose(force / np.linalg.norm(force), -pose[:3, 2], atol=1e-12)
    assert [motion.at(0.731)[0].tobytes()] == [Motion(PRESS.devices[0], layer).at(0.731)[0].tobytes()]


def test_a_device_presses_a_limb_with_newtons_and_not_onto_its_bone():
    layer = living(Body.anny(), "left_forearm", edge_length=6e-3)
    scripts = scripts_for(layer)
    assert scripts.keys() == scripts_for(limb()).keys() and scripts_for(limb()) is ON_ONE_LAYER
    skin = KDTree(layer.vertices)
    for script in scripts.values():
        for motion in (Motion(device, layer) for device in script.devices):
            moments = [motion.at(time) for time in np.linspace(0, script.seconds, 200)]
            force = np.array([np.linalg.norm(wrench[:3]) for _, wrench in moments])
            assert 3 < force.max() < 8 and force[0] == 0 and force[-1] == 0
            pose = moments[int(force.argmax())][0]
            distance, at = skin.query(pose[:3, 3])
            assert distance < (DEEPEST + 0.1) * layer.thickness[at]


def test_keyframes_out_of_order_are_refused():
    with pytest.raises(InvalidInput, match="rising"):
        Device("probe", 0.01, 0.0, (Keyframe(1.0, 0.0, 0.5), Keyframe(0.5, 0.0, 0.5)))


def test_settings_travel_as_ros_arguments():
    arguments = NodeConfig(edge_length=4e-3, part="left_leg").ros_arguments()
    assert arguments[0] == "--ros-args"
    assert "edge_length:=0.004" in arguments and 'part:="left_leg"' in arguments and "autostart:=true" in arguments


def test_strokes_of_no_tool_by_name_are_those_of_the_last_one_also_of_the_same_surface():
    """Two tools of one surface were mixed, and refused as of two."""
    kept = [Contact(ball().named(name), at(0, 0, 0.01 * time), np.ones(6), time=time)
            for time, name in enumerate(["a", "b", "a", "b"])]  # fmt: skip
    kept.append(replace(kept[0], time=5.0))
    for tool, times in (("", [0, 2, 5]), ("a", [0, 2, 5]), ("b", [1, 3]), ("c", [])):
        assert [one.time for one in strokes_of(tool, kept)] == times
    kept.append(Contact(scaled(ball(), 2.0).named("a"), at(0, 0, 0), np.ones(6), time=6.0))
    assert [one.time for one in strokes_of("a", kept)] == [6]


@pytest.mark.parametrize("what", ["", "friction", "relaxation"])
def test_calibrate_says_of_a_tool_that_only_pulled_that_its_force_points_the_wrong_way(what):
    """It said that nothing had pressed, and to press."""
    kept = SimpleNamespace(pulled=set(), strokes=deque(), presses=deque(), _workshop=object)
    contact = Contact(ball().named("probe"), np.eye(4), -np.ones(6))
    pulling = Touch("probe", PULLING, np.eye(4), np.zeros(6))
    Calibration.put(kept, SimpleNamespace(contacts=[contact], stamp=0), {"probe": pulling})
    for tool in ("", "probe"):
        with pytest.raises(InvalidInput, match="no force points into the skin where the poses touch it"):
            Calibration._fit(kept, what, tool)


def test_calibrate_knows_the_presses_of_a_tool_whose_strokes_others_pushed_out():
    """More instants of strokes come than of presses, which must be some way apart."""
    press = Contact(ball().named("a"), np.eye(4), np.ones(6))
    workshop = SimpleNamespace(stiffness=lambda presses: presses)
    kept = SimpleNamespace(pulled=set(), strokes=deque([Contact(ball().named("b"), np.eye(4), np.ones(6))]),
                           presses=deque([press]), _workshop=lambda: workshop)  # fmt: skip
    assert Calibration._fit(kept, "stiffness", "a") == [press]
    with pytest.raises(InvalidInput, match=r"'c' has not pressed .*; a, b has"):
        Calibration._fit(kept, "stiffness", "c")


@pytest.mark.parametrize(("active", "says"), [(True, "answers on it"), (False, "answers on it once it is active")])
def test_the_action_says_whether_the_node_answers_on_the_new_skin(active, says):
    node = SimpleNamespace(executor=SimpleNamespace(create_task=lambda do: do()))
    action = SimpleNamespace(_node=node, _begin=lambda changes, done: done("") or "being made",
                             _layer_id=lambda: "", _active=lambda: active)  # fmt: skip
    goal = SimpleNamespace(request=SetBody.Goal(thickness=0.01), succeed=lambda: None)
    assert BodyAction._execute(action, goal).message == f"the node {says}"


def test_a_goal_of_the_action_that_cannot_be_is_aborted_with_its_reason_and_logged():
    lines, done = [], []
    logger = SimpleNamespace(warning=lines.append)
    node = SimpleNamespace(executor=SimpleNamespace(create_task=lambda do: do()), get_logger=lambda: logger)

    def begin(changes, _):
        raise InvalidInput(f"thickness is {changes['thickness']}")

    action = SimpleNamespace(_node=node, _begin=begin, _layer_id=lambda: "before")
    goal = SimpleNamespace(request=SetBody.Goal(thickness=-1.0), abort=lambda: done.append("aborted"))
    result = BodyAction._execute(action, goal)
    assert (result.success, result.message, result.layer_id) == (False, "thickness is -1.0", "before")
    assert done == ["aborted"] and lines == ["set_body refused: thickness is -1.0"]


def test_a_message_without_a_stamp_is_told_as_such():
    logger = SimpleNamespace(warning=lambda line: None)
    clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=10**18))
    gate = Gate(SimpleNamespace(get_logger=lambda: logger, get_clock=lambda: clock), Tally())
    assert not gate.fresh(0, 1.0) and "without a stamp" in gate.dropped and "clocks in step" not in gate.dropped
    assert not gate.fresh(10**9, 1.0) and "clocks in step" in gate.dropped
    assert gate.fresh(0, 0.0), "any age"


def test_a_time_below_0_on_the_clock_is_passed_over_and_told():
    with ros(["--ros-args", "-p", "use_sim_time:=true"]):
        node, executor, lines = rclpy.create_node("any"), EventsExecutor(), []
        logger = SimpleNamespace(warning=lambda text, **_: lines.append(text))
        node.get_logger = lambda: logger
        executor.add_node(node)
        clock = node.create_publisher(Clock, "/clock", 10)
        for sec in (-1, 7):
            until = monotonic() + 20
            while monotonic() < until and not (lines if sec < 0 else node.get_clock().now().nanoseconds):
                clock.publish(Clock(clock=Time(sec=sec)))
                executor.spin_once(timeout_sec=0.05)
        assert lines[0] == "a time of -1 s on /clock is passed over; it must be 0 or more."
        assert node.get_clock().now().nanoseconds == 7 * 10**9, "and the next one counts"
        executor.shutdown()
        node.destroy_node()


def test_a_remap_of_what_waits_aside_counts():
    with ros(["--ros-args", "-r", "~/ask:=/arm/ask"]):
        node, names = rclpy.create_node("any"), []
        for name in ("ask", "tell"):
            Aside(node, name, lambda hidden, full: names.append(full)).close()
        assert names == ["/arm/ask", "/any/tell"]
        node.destroy_node()


def test_a_clock_that_goes_back_again_and_again_is_told_rarely_and_by_the_diagnostics():
    lines = []
    logger = SimpleNamespace(warning=lines.append)
    node = SimpleNamespace(get_logger=lambda: logger)
    hearing = SimpleNamespace(gate=Gate(node, Tally()), backs=0, frames=SimpleNamespace(forget=lambda: None),
                              forget=lambda: None, on_time_back=lambda: None)  # fmt: skip
    for _ in range(20):
        Hearing._on_time_back(hearing)
    assert len(lines) == 1 and "the simulated clock went back" in lines[0]
    told = Hearing.look_at_clock(hearing)
    assert "went back 20 times" in told and "two simulations" in told
    Hearing._on_time_back(hearing)
    assert not Hearing.look_at_clock(hearing), "a reset is no fault"


def test_a_recorder_takes_no_topology_for_a_contact_in_a_foreign_frame():
    placed = {("/skin/topology", "body"), ("/right/skin/topology", "arm"), ("/right/tools/ball/pose", "arm"),
              ("/tools/ball/pose", "body")}  # fmt: skip
    assert not list(RecorderNode.foreign(SimpleNamespace(_channels={}, _placed=placed), {}))
    placed |= {("/tools/ball/wrench", "arm")}
    (said,) = RecorderNode.foreign(SimpleNamespace(_channels={}, _placed=placed), {})
    assert "/tools/ball/wrench came in frame 'arm', which is neither 'body'" in said
