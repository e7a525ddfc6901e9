"""Recorder and player as processes over the real middleware: any topics, byte for byte; killed, and on a full disk."""

import itertools
import resource
import signal
import time
from random import Random

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool, Header, String
from stmpl_msgs.msg import SkinTopology

from bags.reader import Bag
from bags.recover import recover
from bags.writer import FILE
from stmpl_core.errors import InvalidInput
from stmpl_ros import recorder
from stmpl_ros.parameters import RecordConfig
from stmpl_ros.topics import NOW, STREAM
from tests.bag_scene import stmpl
from tests.bus import PATIENCE, Robot, end, start

STMPL = ("-m", "stmpl_ros.cli")
SOME = 40


class Talker(Robot):
    """Publishes on two topics that are none of ours."""

    def __init__(self) -> None:
        super().__init__("talker")
        self.words = self.node.create_publisher(String, "any/words", STREAM)
        self.heads = self.node.create_publisher(Header, "other/heads", STREAM)

    def say(self, number: int) -> None:
        self.words.publish(String(data=f"word {number}"))
        self.heads.publish(Header(frame_id=f"head {number}"))
        rclpy.spin_once(self.node, timeout_sec=0.005)

    def wait_for_recorder(self, *publishers) -> None:
        self.wait(lambda: all(p.get_subscription_count() == 1 for p in publishers), "the recorder")


@pytest.mark.parametrize(("topics", "says"), [((), "no answers and no contacts were heard in namespace /"),
                                              (("/nothing",), "nothing was heard on --topics")])  # fmt: skip
def test_a_recorder_that_hears_nothing_says_so_and_ends_with_1(tmp_path, monkeypatch, caplog, topics, says):
    monkeypatch.setattr(recorder, "spin", lambda executor, stop: None)
    assert recorder.run(RecordConfig(path=tmp_path / "run"), topics=topics) == 1 and says in caplog.text


@pytest.mark.parametrize("text", ["[1, 2]", '{"node": null}', '{"node": {"method": 3}}', "{bad", "\xff"])
def test_a_run_file_that_holds_no_settings_is_refused_in_a_sentence(tmp_path, text):
    (tmp_path / "run.json").write_text(text, encoding="latin-1")
    with pytest.raises(InvalidInput, match=r"run file .*run\.json"):
        recorder.run(RecordConfig(path=tmp_path / "run", run=tmp_path / "run.json"))
    assert not (tmp_path / "run").exists()


def test_what_ros_refuses_of_a_recorder_leaves_no_empty_recording(tmp_path):
    with pytest.raises(InvalidInput, match="use_sim_time"):
        recorder.run(RecordConfig(path=tmp_path / "run"), ["--ros-args", "-p", "use_sim_time:=1"])
    assert not (tmp_path / "run").exists()


@pytest.fixture(scope="module")
def talker():
    rclpy.init()
    made = Talker()
    yield made
    made.node.destroy_node()
    rclpy.shutdown()


def test_a_recorder_tells_of_poses_that_only_a_node_that_hears_tf_can_place(talker, tmp_path):
    skin = talker.node.create_publisher(SkinTopology, "skin/topology", NOW)
    poses = {name: talker.node.create_publisher(PoseStamped, f"tools/{name}/pose", STREAM)
             for name in ("one/tools/a", "other/tools/b")}  # fmt: skip
    skin.publish(SkinTopology(header=Header(frame_id="body")))
    (tmp_path / "frames.yaml").write_text("table: {position: [0, 0, 0.1]}\n")
    arguments = ("record", "--path", str(tmp_path / "run"), "--frames", str(tmp_path / "frames.yaml"))
    recorder = start(*STMPL, *arguments)
    try:
        talker.wait_for_recorder(*poses.values())
        talker.wait(lambda: skin.get_subscription_count() == 2, "the recorder beside the talker's own ear")
        for name, frame in (("one/tools/a", "table"), ("one/tools/a", "one/tools/a"), ("other/tools/b", "moving_base")):
            poses[name].publish(PoseStamped(header=Header(frame_id=frame)))
        talker.spin(0.5)
    finally:
        code, said = end(recorder, signal.SIGINT)
        for publisher in (skin, *poses.values()):
            talker.node.destroy_publisher(publisher)
    assert code == 0
    assert "/tools/other/tools/b/pose came in frame 'moving_base', which is neither 'body' nor in --frames" in said
    assert said.count(" came in frame ") == 1
    assert "no answers were heard in namespace /, so this cannot be replayed" in said


@pytest.mark.parametrize("asked", [(), ("--topics", ".*")])
def test_a_message_of_another_type_on_a_tools_topic_ends_no_recording(talker, tmp_path, asked):
    odd, pose = (talker.node.create_publisher(*one, STREAM) for one in ((Bool, "tools/odd/pose"),
                                                                        (PoseStamped, "tools/tip/pose")))  # fmt: skip
    recorder = start(*STMPL, "record", "--path", str(tmp_path / "run"), *asked)
    try:
        talker.wait_for_recorder(pose, *[odd] * bool(asked))
        odd.publish(Bool(data=True))
        talker.spin(0.3)
        pose.publish(PoseStamped(header=Header(frame_id="body")))
        talker.spin(0.3)
    finally:
        code, said = end(recorder, signal.SIGINT)
        for publisher in (odd, pose):
            talker.node.destroy_publisher(publisher)
    assert code == 0 and "Traceback" not in said, said
    assert Bag(tmp_path / "run").topics["/tools/tip/pose"].messages == 1
    assert asked or ("/tools/odd/pose is not recorded: it carries std_msgs/msg/Bool, and a run's carries "
                     "geometry_msgs/msg/PoseStamped") in said  # fmt: skip


def test_a_recorder_reads_no_frame_from_a_message_that_is_cut():
    whole = serialize_message(PoseStamped(header=Header(frame_id="body")))
    assert [recorder.frame_of(whole[:size]) for size in (0, 3, 15, len(whole))] == ["", "", "", "body"]


@pytest.fixture(scope="module")
def run(talker, tmp_path_factory):
    """A recording of both topics, and of nothing else."""
    folder = tmp_path_factory.mktemp("record") / "run"
    recorder = start(*STMPL, "record", "--path", str(folder), "--topics", "/any/.*", "/other/heads", "/nothing")
    try:
        talker.wait_for_recorder(talker.words, talker.heads)
        for number in range(SOME):
            talker.say(number)
    finally:
        code, said = end(recorder, signal.SIGINT)
    assert code == 0, said
    return folder


def test_a_recording_whose_terminal_was_closed_is_finished(talker, tmp_path):
    heard = {"preexec_fn": lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL)}  # as nohup of the tests would not
    recorder = start(*STMPL, "record", "--path", str(tmp_path / "run"), "--topics", "/any/words", **heard)
    try:
        talker.wait_for_recorder(talker.words)
        talker.say(1)
        talker.spin(0.3)
    finally:
        code, said = end(recorder, signal.SIGHUP)
    assert code == 0, said
    assert Bag(tmp_path / "run").finished and Bag(tmp_path / "run").topics["/any/words"].messages == 1


def test_any_topics_are_recorded_as_they_came(run):
    bag = Bag(run)
    assert bag.finished and set(bag.topics) == {"/any/words", "/other/heads"}
    words = [one.message.data for one in bag.messages() if one.topic == "/any/words"]
    heads = [one.message.frame_id for one in bag.messages() if one.topic == "/other/heads"]
    assert words == [f"word {k}" for k in range(SOME)] and heads == [f"head {k}" for k in range(SOME)]


@pytest.mark.parametrize("speed", ["0", "1"])
def test_a_recording_is_published_byte_for_byte_in_order(talker, run, speed):
    got: list[bytes] = []
    ear = talker.node.create_subscription(String, "any/words", got.append, QoSProfile(depth=10 * SOME), raw=True)
    player = start(*STMPL, "replay", str(run), "--publish", "--speed", speed, "--topics", "/any/words")
    try:
        talker.wait(lambda: len(got) == SOME, "all messages")
    finally:
        code, said = end(player)
        talker.node.destroy_subscription(ear)
    assert code == 0, said
    assert f"{SOME} messages published on 1 topics" in said
    assert [bytes(one) for one in got] == [raw.data for raw in Bag(run).raw(lambda topic: topic == "/any/words")]


@pytest.mark.parametrize(("given", "says"), [
    (("--publish", "--every", "3", "--method", "linear"), "--every and --method have no meaning with --publish"),
    (("--publish", "--tolerance-mm", "0"), "--tolerance-mm has no meaning with --publish"),
    (("--speed", "0", "--topics", "/any/words"), "--speed and --topics have no meaning without --publish"),
])  # fmt: skip
def test_a_replay_names_flags_that_count_for_nothing(run, capsys, given, says):
    code, said = stmpl(capsys, "replay", run, *given)
    assert code == 1 and says in said


def test_what_cannot_be_published_is_refused(run):
    code, said = end(start(*STMPL, "replay", str(run), "--publish", "--topics", "/nothing"))
    assert code == 1 and "nothing to publish on" in said and "Traceback" not in said
    code, said = end(start(*STMPL, "replay", str(run), "--publish", "--topics", "("))
    assert code == 1 and "no regular expressions" in said and "Traceback" not in said


def test_a_killed_recorder_loses_what_it_had_not_flushed_only(talker, tmp_path):
    recorder = start(*STMPL, "record", "--path", str(tmp_path / "run"), "--topics", "/any/words")
    file, sizes = tmp_path / "run" / FILE, set()
    try:
        talker.wait_for_recorder(talker.words)
        for number in itertools.count():
            talker.say(number)
            sizes.add(file.stat().st_size)
            if len(sizes) > 4:  # several chunks have been handed to the operating system
                break
            assert number < 60_000, "the recorder flushes nothing"
    finally:
        code, said = end(recorder, signal.SIGKILL)
    assert code == -signal.SIGKILL, said
    recovery = recover(tmp_path / "run", tmp_path / "back")
    words = [one.message.data for one in Bag(tmp_path / "back").messages()]
    assert words == [f"word {k}" for k in range(len(words))] and words
    assert not recovery.finished and "had not flushed" in str(recovery) and not recovery.damage


def test_a_recorder_on_a_full_disk_stops_and_says_what_is_safe(talker, tmp_path):
    def small() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))

    recorder = start(*STMPL, "record", "--path", str(tmp_path / "run"), "--topics", "/any/words", preexec_fn=small)
    talker.wait_for_recorder(talker.words)
    generator = Random(0)
    until = time.monotonic() + PATIENCE
    while recorder.poll() is None and time.monotonic() < until:
        talker.words.publish(String(data=generator.randbytes(100).hex()))
        rclpy.spin_once(talker.node, timeout_sec=0.01)
    code, said = end(recorder)
    assert code == 1 and "Safe on disk are the first" in said and "stmpl recover" in said and "Traceback" not in said
    safe = int(said.split("the first ")[1].split()[0])
    assert recover(tmp_path / "run", tmp_path / "back").messages >= safe


WAITING = """
import os, signal, sys
from stmpl_ros import probe
from stmpl_ros.parameters import ProbeConfig

class Node(probe.ProbeNode):
    def wait_for_skin(self, stop):
        os.kill(os.getpid(), signal.SIGTERM)
        return super().wait_for_skin(stop)

probe.ProbeNode = Node
sys.exit(probe.run(ProbeConfig()))
"""


def test_a_probe_that_is_interrupted_as_it_waits_says_so():
    code, said = end(start("-c", WAITING))
    assert code == 1 and "interrupted as it waited for skin/topology" in said and "within" not in said
