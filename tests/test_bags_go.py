"""Recordings read by Foxglove's Go library: every message, schema, attachment and table of ours, byte for byte."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Attachment, Channel, Message, Metadata

from bags.reader import Bag
from bags.records import summary, walk
from bags.recover import recover
from bags.writer import BagWriter, qos_yaml
from tests.bag_scene import START, cdr, header

SOURCE = Path(__file__).parent / "go_reader"
SAMPLE = Path(__file__).parent.parent / "bags" / "sample"


@pytest.fixture(scope="module")
def go_reader(tmp_path_factory) -> Path:
    """The Go program, built."""
    if not shutil.which("go"):
        pytest.skip("no Go toolchain here: the Go library reads no bag")
    program = tmp_path_factory.mktemp("go") / "reader"
    build = ["go", "build", "-buildvcs=false", "-o", program, "."]
    built = subprocess.run(build, cwd=SOURCE, capture_output=True, text=True)
    missing = ("proxy.golang.org", "dial tcp", "no such host", "Forbidden", "module lookup disabled", "i/o timeout")
    if built.returncode and any(word in built.stderr for word in missing):
        pytest.skip(f"no Go module proxy here: {built.stderr.strip().splitlines()[-1]}")
    assert built.returncode == 0, built.stderr
    return program


def by_go(program: Path, bag: Path) -> dict:
    """What the Go library finds in a bag."""
    read = subprocess.run([program, bag], capture_output=True, text=True)
    assert read.returncode == 0, read.stderr
    return json.loads(read.stdout)


def by_us(bag: Path) -> dict:
    """The same figures by our own walk."""
    channels = dict(summary(bag).channels)
    digests, counts, attached, noted = defaultdict(hashlib.sha256), defaultdict(int), {}, {}
    for record in walk(bag):
        match record:
            case Channel():
                channels[record.id] = record
            case Message():
                topic = channels[record.channel_id].topic
                digests[topic].update(record.data)
                counts[topic] += 1
            case Attachment():
                attached[record.name] = hashlib.sha256(record.data).hexdigest()
            case Metadata():
                noted[record.name] = record.metadata
    types = {topic.name: topic.type_name for topic in Bag(bag).topics.values()}
    topics = {t: {"type": types[t], "encoding": "ros2msg", "messages": counts[t], "digest": digests[t].hexdigest()}
              for t in counts}  # fmt: skip
    return {"messages": sum(counts.values()), "topics": topics, "attachments": attached, "metadata": noted}


def agrees(program: Path, bag: Path) -> dict:
    """Asserts that the Go library reads what we read; returns it."""
    found = by_go(program, bag)
    assert found["profile"] == "ros2"
    assert {name: found[name] for name in ("messages", "topics", "attachments", "metadata")} == by_us(bag)
    return found


def write(folder: Path) -> Path:
    """A bag of two topics with an attachment and a table, in many chunks."""
    generator = np.random.default_rng(0)
    with BagWriter(folder, chunk_seconds=1e9) as bag:
        topics = [bag.add_channel(f"/{name}", "std_msgs/msg/Header", qos_yaml()) for name in ("one", "two")]
        bag.add_metadata("note", {"what": "headers", "Umlaut": "äöü"})
        for k in range(300):
            text = generator.bytes(int(generator.integers(1, 50))).hex()
            bag.write(topics[k % 2], cdr(header(text, START + k)), START + k, START + k)
            if k % 25 == 24:
                bag.flush()
        bag.attach("noise.bin", "application/octet-stream", generator.bytes(5000))
    return bag.path


def test_the_go_library_reads_what_we_write(go_reader, tmp_path):
    found = agrees(go_reader, write(tmp_path / "run"))
    assert found["messages"] == 300 and set(found["topics"]) == {"/one", "/two"}


def test_the_go_library_reads_what_was_recovered(go_reader, tmp_path):
    path = write(tmp_path / "run")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refused = subprocess.run([go_reader, path], capture_output=True, text=True)
    assert refused.returncode == 1  # it cannot open the torn file
    recovery = recover(path, tmp_path / "back")
    found = agrees(go_reader, recovery.target)
    assert 0 < found["messages"] == recovery.messages < 300


def test_the_go_library_reads_the_sample(go_reader):
    found = agrees(go_reader, SAMPLE / "run_0.mcap")
    assert {"/skin/topology", "/skin/displacement", "/contact_mesh", "/tools/probe/pose"} <= set(found["topics"])
