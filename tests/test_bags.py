"""Recordings: what was written comes back, other readers agree, and damage costs only what it touches."""

from __future__ import annotations

import re
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from bags.provenance import layer_from_bytes, layer_to_bytes, write_provenance
from bags.reader import Bag
from bags.records import bag_file
from bags.recover import recover
from bags.schema import find_schema, typestore_of
from bags.wire import contact_from, layer_from, pose_from, wrench_from
from bags.writer import FILE, BagWriter, Offered, offered, qos_yaml
from stmpl_core import Tool
from stmpl_core.errors import BagError, FrameError, InvalidInput
from stmpl_core.layer import layer_id
from tests.bag_scene import START, STORE, ball, cdr, header, message, pose, tube, wrench

HEADER = "std_msgs/msg/Header"
KNOWN = ("stmpl_msgs/msg/ContactMesh", "stmpl_msgs/msg/SkinDisplacement", "stmpl_msgs/msg/SkinTopology",
         "stmpl_msgs/msg/SkinDeformed", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/WrenchStamped",
         "visualization_msgs/msg/Marker", "diagnostic_msgs/msg/DiagnosticArray")  # fmt: skip


def write_headers(path: Path, chunks: int = 5, each: int = 20) -> Path:
    """A bag of numbered headers, `each` to a chunk."""
    with BagWriter(path, chunk_seconds=1e9) as bag:
        channel = bag.add_channel("/count", HEADER, qos_yaml())
        bag.add_metadata("note", {"what": "headers"})
        for k in range(chunks * each):
            bag.write(channel, cdr(header(f"{k}", START + k)), START + k, START + k)
            if k % each == each - 1:
                bag.flush()
        bag.attach("end.bin", "application/octet-stream", bytes(range(256)))
    return bag.path


def numbers(path: Path) -> list[int]:
    """The numbers of the headers in a bag, as read back."""
    return [int(recorded.message.frame_id) for recorded in Bag(path).messages()]


def middle_of_chunk(path: Path, number: int) -> int:
    """Where in the file the middle of a chunk lies [bytes]."""
    with open(path, "rb") as stream:
        summary = make_reader(stream).get_summary()
    chunk = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)[number]
    return chunk.chunk_start_offset + chunk.chunk_length // 2


def flip(path: Path, at: int) -> None:
    """Turns one bit of a file."""
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def test_what_was_written_comes_back(tmp_path):
    path = write_headers(tmp_path / "run")
    bag = Bag(tmp_path / "run")
    assert bag.finished and not bag.damage
    assert numbers(path) == list(range(100))
    assert bag.attachments["end.bin"] == bytes(range(256))
    assert bag.metadata["note"] == {"what": "headers"}
    assert bag.topics["/count"].messages == 100 and bag.topics["/count"].type_name == HEADER


def test_a_topic_of_several_channels_counts_the_messages_of_all(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        for k in range(4):  # the last one is never written to
            channel = bag.add_channel("/count", HEADER, qos_yaml(depth=1 + k))
            for stamp in [START + 10 * k + i for i in range(k + 1)] * (k < 3):
                bag.write(channel, cdr(header("", stamp)), stamp, stamp)
    assert Bag(tmp_path / "run").topics["/count"] == ("/count", HEADER, 6, START, START + 22)


def test_rosbags_and_mcap_read_every_message_and_schema(tmp_path):
    path = write_headers(tmp_path / "run")
    with Reader(tmp_path / "run") as reader:
        read = [STORE.deserialize_cdr(data, connection.msgtype) for connection, _, data in reader.messages()]
        assert [int(one.frame_id) for one in read] == list(range(100))
        assert reader.connections[0].digest == find_schema(HEADER).type_hash
        assert reader.connections[0].ext.offered_qos_profiles[0].depth == 10
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert sum(1 for schema, channel, _ in reader.iter_messages() if schema and channel.topic == "/count") == 100
        summary = reader.get_summary()
        assert summary and summary.statistics and summary.statistics.message_count == 100


@pytest.mark.parametrize("name", KNOWN)
def test_a_schema_stands_on_its_own_and_has_the_hash_of_its_text(name):
    schema = find_schema(name)
    store = typestore_of([(schema.name, schema.text)])
    assert store.hash_rihs01(name) == schema.type_hash
    assert schema.text.count("MSG: ") == schema.text.count("=" * 80)


@pytest.mark.parametrize("offer", [Offered(), Offered(3, False, True, 0.25), Offered(depth=7, lease=1.0)], ids=str)
def test_a_quality_of_service_comes_back(offer):
    written = qos_yaml(**vars(offer))
    assert offered(written) == offer
    assert ("9223372036" in written.split("liveliness_lease_duration")[1]) == (not offer.lease)


def test_rosbag2_may_index_a_recording_again_by_its_name(tmp_path):
    path = write_headers(tmp_path / "run")
    assert re.fullmatch(r".+_(\d+)\.([a-zA-Z0-9])+", path.name)  # what rosbag2's Reindexer looks for
    assert bag_file(tmp_path / "run") == path and bag_file(path) == path
    path.rename(path.with_name("run.mcap"))  # the name in older recordings
    assert bag_file(tmp_path / "run").name == "run.mcap" and numbers(tmp_path / "run") == list(range(100))


def test_an_unknown_type_or_channel_is_refused(tmp_path):
    with BagWriter(tmp_path) as bag:
        with pytest.raises(BagError, match="no_msgs/msg/Nothing is not installed"):
            bag.add_channel("/x", "no_msgs/msg/Nothing")
        with pytest.raises(BagError, match="no channel 7"):
            bag.write(7, b"", 0, 0)
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path)


WRITER = """
import struct
from bags.writer import BagWriter
bag = BagWriter({folder!r}, chunk_seconds=0.02)
channel, k = bag.add_channel("/count", "std_msgs/msg/Header"), 0
while True:
    text = str(k).encode() + b"\\0"
    bag.write(channel, b"\\0\\1\\0\\0" + struct.pack("<iII", 0, 0, len(text)) + text, k, k)
    k += 1
    print(bag.safe_messages, flush=True)
"""


def test_a_killed_recording_gives_back_every_whole_chunk(tmp_path):
    script, root = WRITER.format(folder=str(tmp_path / "run")), Path(__file__).parent.parent
    child = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, cwd=root)
    assert child.stdout
    safe = 0
    while safe < 200:
        safe = int(child.stdout.readline())
    child.send_signal(signal.SIGKILL)
    safe = max([safe, *(int(line) for line in child.stdout.read().split("\n")[:-1])])
    child.wait()

    with pytest.raises(Exception, match=r"(?i)magic|footer|end"), Reader(tmp_path / "run" / FILE) as reader:
        list(reader.messages())  # a reader that seeks cannot open it
    recovery = recover(tmp_path / "run", tmp_path / "back")
    back = numbers(tmp_path / "back")
    assert back == list(range(len(back))) and len(back) >= safe
    assert not recovery.finished and "had not flushed" in str(recovery)
    with Reader(tmp_path / "back") as reader:
        assert reader.message_count == recovery.messages == len(back)


@pytest.mark.parametrize("whole", [1, 10, 19])
def test_a_truncated_recording_gives_back_what_is_whole(tmp_path, whole):
    path = write_headers(tmp_path / "run", chunks=20)
    path.write_bytes(path.read_bytes()[: middle_of_chunk(path, whole)])
    recovery = recover(path, tmp_path / "back")
    back = numbers(tmp_path / "back")
    assert back == list(range(20 * whole))
    assert not recovery.complete and len(back) == recovery.messages
    assert numbers(path) == back  # reading the damaged file itself gives the same


def test_a_recording_that_lost_only_its_index_is_complete(tmp_path):
    path = write_headers(tmp_path / "run")
    path.write_bytes(path.read_bytes()[:-50])
    assert recover(path, tmp_path / "back").complete
    assert numbers(tmp_path / "back") == list(range(100))


def test_a_recording_that_ends_inside_its_first_chunk_gives_nothing_and_leaves_nothing(tmp_path):
    path = write_headers(tmp_path / "run")
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(BagError, match="no sound message"):
        recover(path, tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_a_flipped_bit_costs_its_chunk_only(tmp_path):
    path = write_headers(tmp_path / "run")
    flip(path, middle_of_chunk(path, 2))
    recovery = recover(path, tmp_path / "back")
    assert numbers(tmp_path / "back") == [k for k in range(100) if not 40 <= k < 60]
    assert len(recovery.damage) == 1 and "CRC" in recovery.damage[0].what
    assert Bag(tmp_path / "back").attachments["end.bin"] == bytes(range(256))


def test_any_flipped_bit_leaves_a_readable_bag_without_a_wrong_message(tmp_path):
    path = write_headers(tmp_path / "run", chunks=4, each=10)
    whole = path.read_bytes()
    generator = np.random.default_rng(0)
    for trial, at in enumerate(generator.integers(8, len(whole), 60)):
        data = bytearray(whole)
        data[at] ^= 1 << generator.integers(8)
        path.write_bytes(data)
        recover(path, tmp_path / f"back{trial}")
        back = numbers(tmp_path / f"back{trial}")
        assert back == sorted(set(back)) and set(back) <= set(range(40)) and len(back) >= 30


def test_a_broken_first_chunk_does_not_take_the_schemas_along(tmp_path):
    path = write_headers(tmp_path / "run")
    flip(path, middle_of_chunk(path, 0))
    recover(path, tmp_path / "back")
    assert numbers(tmp_path / "back") == list(range(20, 100))  # the index at the end still knows them


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "text.mcap").write_text("this is no recording at all")
    with pytest.raises(BagError, match="no MCAP file"):
        Bag(tmp_path / "text.mcap")
    (tmp_path / "text.mcap").write_bytes(b"")
    with pytest.raises(BagError):
        Bag(tmp_path / "text.mcap")
    (tmp_path / "text.mcap").unlink()
    with pytest.raises(BagError, match=r"expected one \.mcap file, found none"):
        Bag(tmp_path)
    with pytest.raises(BagError, match="nowhere does not exist"):
        Bag(tmp_path / "nowhere")


@contextmanager
def full_disk():
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_recovery_on_a_full_disk_leaves_nothing_and_names_its_source(tmp_path):
    random = np.random.default_rng(0)

    def record(name: str) -> None:
        with BagWriter(tmp_path / name, chunk_seconds=60.0) as bag:
            channel = bag.add_channel("/count", HEADER)
            for k in range(2000):
                bag.write(channel, cdr(header(random.bytes(50).hex(), START + k)), START + k, START + k)

    record("run")
    source, target = tmp_path / "run" / "run_0.mcap", tmp_path / "back" / "run_0.mcap"
    with full_disk():
        with pytest.raises(BagError, match="None of 2000 messages is safe"):
            record("none")
        with pytest.raises(BagError, match=f"stmpl recover {source} --target {target}"):
            recover(tmp_path / "run", tmp_path / "back")
    assert not target.exists()
    assert recover(tmp_path / "run", tmp_path / "back").messages == 2000


def test_a_full_disk_says_what_is_safe(tmp_path):
    with full_disk(), pytest.raises(BagError, match=r"Safe on disk are the first \d+ of \d+ messages") as caught:
        with BagWriter(tmp_path / "run", chunk_seconds=0.0) as bag:
            channel = bag.add_channel("/count", HEADER)
            for k in range(10_000):
                bag.write(channel, cdr(header(f"{k}", START + k)), START + k, START + k)
    safe = int(str(caught.value).split("the first ")[1].split()[0])
    recover(tmp_path / "run", tmp_path / "back")
    assert safe > 0 and numbers(tmp_path / "back")[:safe] == list(range(safe))


def test_a_layer_comes_back_bit_for_bit(tmp_path):
    layer = tube(edge=12e-3).with_(youngs_modulus=1234.5, poisson_ratio=0.43)
    layer = layer.with_(vertices=layer.vertices + np.random.default_rng(1).normal(0, 1e-4, layer.vertices.shape))
    back = layer_from_bytes(layer_to_bytes(layer))
    for name in ("vertices", "faces", "thickness"):
        assert getattr(back, name).tobytes() == getattr(layer, name).tobytes()
    assert back.tissue == layer.tissue and layer_id(back) == layer_id(layer)
    assert layer_id(layer.with_(youngs_modulus=1234.6)) != layer_id(layer)
    with pytest.raises(BagError, match="cannot be read"):
        layer_from_bytes(b"not a layer")


def test_provenance_comes_back(tmp_path):
    layer = tube(edge=12e-3)
    with BagWriter(tmp_path) as bag:
        write_provenance(bag, layer, method="winkler", body="tube", config={"edge_length": 0.012})
    bag = Bag(tmp_path)
    assert bag.provenance.method == "winkler" and bag.provenance.config == {"edge_length": 0.012}
    assert "numpy" in bag.provenance.versions
    assert bag.layer.vertices.tobytes() == layer.vertices.tobytes()


def test_poses_and_wrenches_in_a_frame_that_the_recording_carries_count_as_in_the_bodys(tmp_path):
    turn, moved = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.1, -0.2, 0.3])
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = turn, moved / 3
    with BagWriter(tmp_path) as bag:
        write_provenance(bag, None, method="winkler", frames={"table": place})
    frames = Bag(tmp_path).provenance.frames
    assert frames["table"].tobytes() == place.tobytes()
    tool, sent, push = Tool("ball", *ball()), pose(0.3, 0.06, 0.0, START), wrench("ball", 0.2, START)
    sent.header.frame_id = push.header.frame_id = "table"
    contact = contact_from(tool, sent, push, body_frame="body", frames=frames)
    assert np.array_equal(contact.pose_body_from_tool, place @ pose_from(sent.pose))
    assert contact.wrench is not None
    np.testing.assert_allclose(contact.wrench[:3], turn @ [-0.2, 0, 0], atol=1e-16)
    for wrong in ({}, {"chair": place}):
        with pytest.raises(FrameError, match="in frame 'table'; known are 'body"):
            contact_from(tool, sent, push, body_frame="body", frames=wrong)


def test_a_surface_that_a_node_refuses_is_left_out_of_a_recording_and_the_one_before_it_stays(tmp_path, caplog):
    vertices, triangles = ball()
    sent = [("ball", 1.0, triangles), ("ball", 1e3, triangles), ("other", 1.0, triangles),
            ("other", 1.0, triangles[:0])]  # fmt: skip
    with BagWriter(tmp_path) as bag:
        channel = bag.add_channel("/contact_mesh", "stmpl_msgs/msg/ContactMesh")
        for k, (name, scale, faces) in enumerate(sent):
            made = message("mesh", header=header(name, START + k), vertices=scale * vertices.ravel(),
                           triangles=faces.ravel())  # fmt: skip
            bag.write(channel, cdr(made), START + k, START + k)
    tools = Bag(tmp_path).tools
    assert list(tools) == ["ball", "other"] and np.ptp(tools["ball"].vertices) < 0.03
    assert "a surface of 'ball' is left out" in caplog.text and "millimetres" in caplog.text


def test_a_topology_message_says_a_float32_layer_exactly():
    from tests.bag_scene import topology

    layer = tube(edge=12e-3)
    back = layer_from(STORE.deserialize_cdr(cdr(topology(layer)), "stmpl_msgs/msg/SkinTopology"))
    assert layer_id(back) == layer_id(layer) == topology(layer).layer_id
    assert back.vertices.tobytes() == layer.vertices.tobytes() and back.thickness.tobytes() == layer.thickness.tobytes()


def test_a_pose_is_a_rotation_and_turns_a_wrench_given_in_the_tools_frame():
    generator = np.random.default_rng(2)
    for _ in range(20):
        q = generator.normal(size=4)
        x, y, z, w = q / np.linalg.norm(q)
        made = message("geometry_msgs/msg/Pose", position=message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0),
                       orientation=message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w))  # fmt: skip
        pose = pose_from(made)
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-14) and np.linalg.det(pose) > 0
        assert np.allclose(pose[:3, 3], [1, 2, 3])
        vector = message("geometry_msgs/msg/Vector3", x=1.0, y=-2.0, z=0.5)
        sent = message("wrench", header=header("tool", START),
                       wrench=message("geometry_msgs/msg/Wrench", force=vector, torque=vector))  # fmt: skip
        turned = wrench_from(sent, body_frame="body", tool="tool", pose_body_from_tool=pose)
        assert np.allclose(turned, np.tile(pose[:3, :3] @ [1, -2, 0.5], 2))
        with pytest.raises(FrameError, match="in frame 'tool'"):
            wrench_from(sent, body_frame="body", tool="other", pose_body_from_tool=pose)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 0, 2), (np.nan, 0, 0, 1)])
def test_what_is_no_unit_quaternion_is_refused(quaternion):
    x, y, z, w = map(float, quaternion)
    made = message("geometry_msgs/msg/Pose", position=message("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
                   orientation=message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w))  # fmt: skip
    with pytest.raises(InvalidInput, match="quaternion"):
        pose_from(made)
