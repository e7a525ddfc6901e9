"""Damaged recordings: whatever happens to a file costs only what it touches, is told, and never ends in a traceback."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import Reader

from bags.reader import Bag
from bags.records import CHUNK, Damage, End, Record, summary, walk
from bags.recover import recover
from bags.replay import replay_run
from bags.run import Run
from bags.writer import BagWriter
from stmpl_core import Joint, Rig
from stmpl_core.errors import BagError
from stmpl_core.methods import Linear, MomentNet, Winkler
from tests.bag_scene import START, cdr, header, stmpl, tube, write_run

SAMPLE = Path(__file__).parent.parent / "bags" / "sample"
BEFORE = Path(__file__).with_name("recording_before")  # the first 3.4 s of a sample from before stmpl_msgs/Touch
HEADER = "std_msgs/msg/Header"
CHUNKS, EACH = 4, 5
NUMBERS = list(range(CHUNKS * EACH))
BYTES = bytes(range(200))


@pytest.fixture
def bag(tmp_path) -> Path:
    """A bag with metadata, numbered messages in four chunks, and an attachment between the second and the third."""
    with BagWriter(tmp_path / "run", chunk_seconds=1e9) as writer:
        writer.add_metadata("note", {"what": "headers"})
        channel = writer.add_channel("/count", HEADER)
        for k in NUMBERS:
            writer.write(channel, cdr(header(f"{k}", START + k)), START + k, START + k)
            if k % EACH == EACH - 1:
                writer.flush()
            if k == 2 * EACH - 1:
                writer.attach("bytes.bin", "application/octet-stream", BYTES)
    return writer.path


def numbers(records: Iterable[Record]) -> list[int]:
    """The numbers that the messages were written with, from their log times."""
    return [record.log_time - START for record in records if isinstance(record, Message)]


def whole(records: list[Record]) -> bool:
    """All that was written is there, as it was."""
    attached = [record.data for record in records if isinstance(record, Attachment)]
    noted = [record.metadata for record in records if isinstance(record, Metadata) if record.name == "note"]
    return numbers(records) == NUMBERS and attached == [BYTES] and noted == [{"what": "headers"}]


def told(records: list[Record]) -> bool:
    """The walk says that something is missing."""
    return any(isinstance(record, Damage) for record in records) or not any(isinstance(r, End) for r in records)


def flipped(path: Path, into: Path, at: int, bit: int) -> list[Record]:
    """What a walk finds after one bit was turned."""
    data = bytearray(path.read_bytes())
    data[at] ^= 1 << bit
    into.write_bytes(data)
    return list(walk(into))


def test_a_bit_flipped_anywhere_costs_one_record_at_most_and_is_told(bag, tmp_path):
    generator, size = np.random.default_rng(0), bag.stat().st_size
    for at in range(8, size):
        records = flipped(bag, tmp_path / "flipped.mcap", at, int(generator.integers(8)))
        back = numbers(records)
        assert set(back) <= set(NUMBERS) and back == sorted(set(back)), at
        assert len(back) >= len(NUMBERS) - EACH, at
        assert whole(records) or told(records), at


def test_a_frame_with_any_flipped_bit_loses_no_message(bag, tmp_path):
    for place, kind, _ in summary(bag).places:
        for at in range(place, place + 9):
            for bit in range(8):
                records = flipped(bag, tmp_path / "flipped.mcap", at, bit)
                assert kind != CHUNK or whole(records), (place, at, bit)
                assert numbers(records) == NUMBERS


def test_a_killed_and_flipped_recording_keeps_every_other_chunk(bag, tmp_path):
    places = [place for place, kind, _ in summary(bag).places if kind == CHUNK]
    data = bag.read_bytes()[: summary(bag).data_end]  # as a killed writer leaves it: without index
    (tmp_path / "killed.mcap").write_bytes(data)
    for place in places[1:]:  # the first one holds the only description of the topic
        for at in (place, place + 3, place + 60):
            records = flipped(tmp_path / "killed.mcap", tmp_path / "flipped.mcap", at, 1)
            back = numbers(records)
            assert len(back) >= len(NUMBERS) - EACH and set(back) <= set(NUMBERS)
            assert not any(isinstance(record, End) for record in records)


def test_a_recording_cut_at_any_length_gives_every_whole_chunk(bag, tmp_path):
    data, places = bag.read_bytes(), summary(bag).places
    ends = [end for _, kind, end in places if kind == CHUNK]
    for length in {*range(8, len(data), 3), *ends, *(end - 1 for end in ends)}:
        (tmp_path / "cut.mcap").write_bytes(data[:length])
        records = list(walk(tmp_path / "cut.mcap"))
        assert numbers(records) == NUMBERS[: EACH * sum(end <= length for end in ends)], length
        assert whole(records) or told(records), length


def test_noise_over_a_stretch_costs_what_it_covers(bag, tmp_path):
    generator, data = np.random.default_rng(1), bag.read_bytes()
    chunks = [(start, end) for start, kind, end in summary(bag).places if kind == CHUNK]
    for _ in range(200):
        start, length = int(generator.integers(8, len(data))), int(generator.integers(1, 400))
        noisy = data[:start] + generator.bytes(length) + data[start + length :]
        (tmp_path / "noisy.mcap").write_bytes(noisy)
        records = list(walk(tmp_path / "noisy.mcap"))
        kept = [n for n, (a, b) in enumerate(chunks) if b <= start or start + length <= a]
        assert set(numbers(records)) >= {EACH * n + k for n in kept for k in range(EACH)}, (start, length)
        assert whole(records) or told(records), (start, length)


def test_recover_and_info_refuse_or_answer_but_never_crash(bag, tmp_path):
    generator, data = np.random.default_rng(2), bag.read_bytes()
    for trial in range(60):
        broken = bytearray(data[: generator.integers(0, len(data) + 1)])
        for at in generator.integers(0, max(len(broken), 1), 4 if broken else 0):
            broken[at] = generator.integers(256)
        path = tmp_path / f"broken{trial}.mcap"
        path.write_bytes(broken)
        try:
            opened = Bag(path)
            assert {int(one.message.frame_id) for one in opened.messages()} <= set(NUMBERS)
            recovery = recover(path, tmp_path / f"back{trial}")
            assert recovery.complete == ("nothing is missing" in str(recovery))
            assert Bag(recovery.target).finished and not Bag(recovery.target).damage
        except BagError as refusal:
            assert str(path) in str(refusal) or "schema" in str(refusal)


def foreign(path: Path, **options) -> Path:
    """A file by another recorder: one topic in JSON without a schema, one in CDR."""
    with open(path, "wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2")
        schema = writer.register_schema(HEADER, "ros2idl", b"module std_msgs {};")
        plain = writer.register_channel("/plain", "json", 0, {"by": "hand"})
        typed = writer.register_channel("/typed", "cdr", schema, {"offered_qos_profiles": "[]"})
        for k in range(20):
            writer.add_message((plain, typed)[k % 2], START + k, b"{}" + bytes([k]), START + k)
        writer.finish()
    return path


FOREIGN = [{"compression": CompressionType.LZ4}, {"compression": CompressionType.NONE, "chunk_size": 100},
           {"use_chunking": False}, {"enable_crcs": False}]  # fmt: skip


@pytest.mark.parametrize("options", FOREIGN, ids=str)
def test_what_other_recorders_write_is_recovered_as_it_was(tmp_path, options):
    path = foreign(tmp_path / "foreign.mcap", **options)
    recovery = recover(path, tmp_path / "back")
    assert recovery.complete and recovery.messages == 20
    was, back = list(walk(path)), list(walk(recovery.target))
    for kind, name in ((Message, "data"), (Channel, "message_encoding"), (Channel, "metadata"), (Schema, "encoding"),
                       (Schema, "data")):  # fmt: skip
        assert [getattr(r, name) for r in back if isinstance(r, kind)] == [
            getattr(r, name) for r in was if isinstance(r, kind)
        ]
    with pytest.raises(BagError, match=r"/plain|encoded as"):
        list(Bag(path).messages())


@pytest.mark.parametrize("options", FOREIGN, ids=str)
def test_broken_files_of_other_recorders_do_not_crash(tmp_path, options):
    data = foreign(tmp_path / "foreign.mcap", **options).read_bytes()
    generator = np.random.default_rng(3)
    for trial in range(150):
        broken = bytearray(data[: generator.integers(8, len(data) + 1)])
        broken[generator.integers(8, max(len(broken), 9)) - 1] ^= 1 << generator.integers(8)
        (tmp_path / "broken.mcap").write_bytes(broken)
        try:
            list(walk(tmp_path / "broken.mcap"))
        except BagError as refusal:
            assert "no MCAP file" in str(refusal), trial


def test_the_command_says_what_is_missing_and_exits_with_1(bag, tmp_path, capsys):
    assert stmpl(capsys, "info", bag)[0] == 0
    places = [place for place, kind, _ in summary(bag).places if kind == CHUNK]
    data = bytearray(bag.read_bytes())
    data[places[1] + 60] ^= 1
    bag.write_bytes(data)
    code, said = stmpl(capsys, "info", bag)
    assert code == 1 and f"{len(NUMBERS) - EACH} of {len(NUMBERS)} messages are sound" in said
    code, said = stmpl(capsys, "recover", bag, "--target", tmp_path / "back")
    assert code == 0 and "a chunk's CRC is wrong" in said and f"at byte {places[1]} (" in said
    bag.write_bytes(data[: places[2]])
    code, said = stmpl(capsys, "info", bag)
    assert code == 1 and "not finished" in said
    for refused in (tmp_path / "nowhere", bag.with_name("metadata.yaml")):
        assert stmpl(capsys, "info", refused)[0] == stmpl(capsys, "recover", refused)[0] == 1


def test_a_recording_without_one_sound_message_is_refused_and_leaves_nothing(bag, tmp_path, capsys):
    data = bag.read_bytes()
    first = next(place for place, kind, _ in summary(bag).places if kind == CHUNK)
    for length in (0, 1, 8, 20, first - 1, first, first + 50):
        broken = tmp_path / "broken.mcap"
        broken.write_bytes(data[:length])
        code, said = stmpl(capsys, "recover", broken, "--target", tmp_path / "back")
        assert code == 1 and said.startswith("stmpl: ") and "\n" not in said, (length, said)
        assert not (tmp_path / "back").exists() and broken.read_bytes() == data[:length]
    with BagWriter(tmp_path / "empty"):
        pass
    code, said = stmpl(capsys, "recover", tmp_path / "empty")
    assert code == 0 and said.startswith("0 messages") and "nothing is missing" in said


def test_another_recording_beside_a_recovered_one_keeps_its_metadata(bag, tmp_path, capsys):
    beside = bag.with_name("metadata.yaml")
    before = beside.read_text()
    assert stmpl(capsys, "recover", bag, "--target", bag.with_name("sound.mcap"))[0] == 0
    assert beside.read_text() == before and whole(list(walk(bag.with_name("sound.mcap"))))
    (bag.parent / "broken.mcap").write_bytes(bag.read_bytes()[:60])
    assert stmpl(capsys, "recover", bag.parent / "broken.mcap", "--target", bag.with_name("none.mcap"))[0] == 1
    assert beside.read_text() == before and {file.name for file in bag.parent.iterdir()} == {
        bag.name, "metadata.yaml", "sound.mcap", "broken.mcap"}  # fmt: skip
    bag.unlink()
    with BagWriter(bag):
        pass
    assert "message_count: 0" in beside.read_text(), "its own is written anew"


def test_a_recording_is_recovered_from_within_its_folder(bag, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(bag.parent)
    code, said = stmpl(capsys, "recover", bag.name)
    assert code == 0, said
    assert whole(list(walk(bag.parent.with_name("run-recovered"))))


def test_a_recovery_that_is_interrupted_leaves_nothing_that_looks_whole(bag, tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(BagWriter, "attach", interrupted)
    with pytest.raises(KeyboardInterrupt):
        recover(bag, tmp_path / "back")
    assert not (tmp_path / "back").exists()


@pytest.mark.parametrize("junk", [b"x", b"\0" * 400, None], ids=["a byte", "noughts", "another"])
def test_what_stands_behind_the_end_of_a_recording_is_told_and_nothing_is_lost(tmp_path, capsys, caplog, junk):
    run = write_run(tmp_path / "run", Winkler(), layer=tube(edge=9e-3), frames=8)
    file = Bag(run).file
    whole, more = file.read_bytes(), write_run(tmp_path / "other", Winkler(), frames=4) if junk is None else None
    behind = Bag(more).file.read_bytes() if more else junk
    file.write_bytes(whole + behind)
    told = ("another recording" if more else "what is of no recording") + " stands behind the end, and is not read,"
    told += f" at byte {len(whole)} ({len(behind)} bytes)"
    code, said = stmpl(capsys, "info", run)
    assert code == 1 and "finished, 1 places damaged" in said and told in caplog.text
    caplog.clear()
    assert stmpl(capsys, "replay", run)[0] == 0 and told in caplog.text, "the recording itself is whole"
    code, said = stmpl(capsys, "recover", run, "--target", tmp_path / "back")
    assert code == 0 and told in said
    assert Bag(tmp_path / "back").answers == 8 and not Bag(tmp_path / "back").damage


def test_compare_exits_with_1_past_its_tolerance_only(tmp_path, capsys):
    layer = tube(edge=9e-3)
    ours, same, other = (write_run(tmp_path / name, method, layer=layer, frames=8) for name, method in
                         (("ours", Winkler()), ("same", Winkler()), ("other", Linear())))  # fmt: skip
    assert stmpl(capsys, "compare", ours, "--with", same, "--tolerance-mm", 0)[0] == 0
    assert stmpl(capsys, "compare", ours, "--with", other, "--tolerance-mm", 0)[0] == 1
    assert stmpl(capsys, "compare", ours, "--with", other, "--tolerance-mm", 1000)[0] == 0
    assert stmpl(capsys, "compare", ours, "--reference", "winkler", "--tolerance-mm", 1e-3)[0] == 0
    assert stmpl(capsys, "compare", ours, "--reference", "linear", "--tolerance-mm", 0)[0] == 1
    code, said = stmpl(capsys, "compare", ours, "--with", same, "--tolerance-mm", -1)
    assert code == 1 and "give 0 or more" in said


def test_replay_exits_with_1_unless_the_recorded_method_repeats_itself(tmp_path, capsys):
    ours = write_run(tmp_path / "ours", Winkler(), layer=tube(edge=9e-3), frames=8)
    assert stmpl(capsys, "replay", ours)[0] == 0
    assert stmpl(capsys, "replay", ours, "--method", "linear")[0] == 0
    code, said = stmpl(capsys, "replay", ours, "--every", 0)
    assert code == 1 and "takes no frame" in said


def test_the_sample_is_small_whole_and_read_by_rosbags():
    bag = Bag(SAMPLE)
    assert bag.finished and not bag.damage and bag.file.stat().st_size < 2.5e6
    assert {"weights/moment_net", "weights/contact_net", "numpy"} <= set(bag.provenance.versions)
    with Reader(SAMPLE) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    assert counts == {topic.name: topic.messages for topic in bag.topics.values()}


def test_the_sample_replays_as_recorded():
    summary = replay_run(SAMPLE, MomentNet(), every=50)
    assert summary.frames > 5
    assert summary.passed, f"{summary} If it was meant to change, docs/bags.md says how to record it again."


def test_the_answers_of_a_recording_from_before_touches_are_read_and_say_what_they_knew():
    """Its messages name tools, statuses and stamps alone: pose, wrench, depth and bound are not a number."""
    bag = Bag(BEFORE)
    schemas = [record for record in walk(bag.file) if isinstance(record, Schema)]
    (told,) = {schema.data for schema in schemas if schema.name.endswith("SkinDisplacement")}
    assert b"string[] statuses" in told and b"Touch" not in told, "it is of today's form: give an older one"
    frames, sent = list(bag.frames()), (one.message for one in bag.messages(lambda topic: "displacement" in topic))
    assert len(frames) == bag.answers > 100 and any(frame.touches for frame in frames)
    for frame, message in zip(frames, sent, strict=True):
        assert {name: touch.status for name, touch in frame.touches.items()} == dict(
            zip(message.tools, message.statuses, strict=True)
        )
        for touch in frame.touches.values():
            assert frame.inputs[touch.name][0] > 0 and touch.pressure is None
            assert np.isnan([touch.depth, touch.force_bound, *touch.wrench, *touch.pose_body_from_tool.ravel()]).all()
    pressed = next(frame for frame in frames if any(touch.presses for touch in frame.touches.values()))
    assert [contact.name for contact in Run(BEFORE).contacts(pressed)] == list(pressed.touches)


@pytest.mark.parametrize(("joints", "hinges"), [((0.3,), False), ((0.3, 0.1), True), ((float("nan"),), True)])
def test_angles_that_the_layers_joints_cannot_have_are_told(tmp_path, joints, hinges):
    run = Run(write_run(tmp_path / "run", Winkler(), frames=3))
    frame, layer = next(iter(run.frames())), tube()
    if hinges:
        weights = np.tile([0.0, 1.0], (len(layer.vertices), 1))
        rig = Rig(("root", "arm"), (-1, 0), np.zeros((2, 3)), weights, (Joint("shoulder", "arm", (0, 0, 1)),))
        run.layers[frame.layer_id] = layer.with_(rig=rig)
    told = "has joints at .* rad; its layer has " + ("shoulder" if hinges else "no joints")
    for read in (run.rest_of, run.layer_of):
        with pytest.raises(BagError, match=told):
            read(replace(frame, joints=joints))


@pytest.mark.parametrize("field", ["geometry_msgs/Pose pose", "string layer_id", "float32[] vertices", "Header header"])
def test_a_recording_whose_messages_are_defined_otherwise_is_refused_in_a_sentence(tmp_path, capsys, field):
    path = tmp_path / "other.mcap"
    with SAMPLE.joinpath("run_0.mcap").open("rb") as stream, path.open("wb") as target:
        writer, channels = Writer(target), {}
        writer.start()
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic not in channels:
                text = schema.data.replace(field.encode(), field.encode() + b"_2")
                number = writer.register_schema(schema.name, schema.encoding, text)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            if message.sequence < 5:
                writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    code, said = stmpl(capsys, "replay", path)
    assert code == 1 and "cannot be read: the file defines" in said and f"without a field '{field.split()[1]}'" in said
