"""Laws of `stmpl foxglove`, by a client that asks as Foxglove does; skipped where its SDK is not installed."""

import json
import re
import signal
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from stmpl_msgs.msg import SkinDisplacement, SkinTopology
from visualization_msgs.msg import Marker

from bags.schema import typestore_of
from tests.bus import ROOT, end, start
from tests.node_bus import HERE, PUSH, Bus, Hand

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
client = pytest.importorskip("websockets.sync.client")

STMPL = ("-m", "stmpl_ros.cli")
DATA = struct.Struct("<BIQ")  # of a message: kind 1, number of the subscription, time [ns]


class Viewer:
    """A client of the websocket: knows the channels, and keeps what comes on those that it asked for."""

    def __init__(self, url: str) -> None:
        self.socket = client.connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None)
        self.channels: dict[str, dict[str, Any]] = {}
        self.got: dict[str, list[bytes]] = {}

    def ask(self, *topics: str) -> None:
        wanted = [{"id": self.channels[topic]["id"], "channelId": self.channels[topic]["id"]} for topic in topics]
        self.got |= {topic: [] for topic in topics}
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def wait(self, bus: Bus, done: Callable[[], object], what: str) -> None:
        bus.wait(lambda: self.take() or done(), what)

    def take(self) -> None:
        """What came by now."""
        try:
            while True:
                self._take(self.socket.recv(timeout=0.01))
        except TimeoutError:
            pass

    def _take(self, one: str | bytes) -> None:
        if isinstance(one, str):
            told = json.loads(one)
            for channel in told.get("channels", []) if told["op"] == "advertise" else []:
                self.channels[channel["topic"]] = channel
            return
        kind, number, _ = DATA.unpack_from(one)
        if kind == 1:
            topic = next(name for name, channel in self.channels.items() if channel["id"] == number)
            self.got[topic].append(one[DATA.size :])


@pytest.fixture(scope="module")
def url(bus):
    process = start(*STMPL, "foxglove", "--port", "0")
    lines = []
    while not lines or "ws://" not in lines[-1]:
        lines.append(process.stdout.readline())
        assert lines[-1], "".join(lines)
    yield re.search(r"ws://[\d.]+:\d+", lines[-1])[0]
    code, said = end(process, signal.SIGINT)
    assert code == 0, said


def see(bus: Bus, hand: Hand, viewer: Viewer, topics: list[str]) -> None:
    """Looks at the topics, and sees the skin on each."""
    viewer.wait(bus, lambda: viewer.channels.keys() >= set(topics), "the channels")
    viewer.ask(*topics)
    viewer.wait(bus, lambda: hand.send(HERE, PUSH) and all(viewer.got.values()), "a message of each topic")
    told = viewer.channels[topics[0]]
    assert told["encoding"] == "cdr" and told["schemaName"] == "stmpl_msgs/msg/SkinTopology"
    assert told["schemaEncoding"] == "ros2msg" and typestore_of([(told["schemaName"], told["schema"])])
    topology = deserialize_message(viewer.got[topics[0]][0], SkinTopology)
    assert topology.layer_id == bus.got["skin/topology"][-1].layer_id
    marker = deserialize_message(viewer.got[topics[2]][-1], Marker)
    assert len(marker.points) == len(topology.triangles) == len(marker.colors)


def test_a_viewer_gets_the_skin_at_rest_the_answers_their_colours_and_wrenches_byte_for_byte(bus, hand, url):
    topics = ["skin/topology", "skin/displacement", "skin/marker", "tools/probe/pose", "tools/probe/contact_wrench"]
    topics = [f"/robot/{name}" for name in topics]
    first, late = viewers = Viewer(url), Viewer(url)
    see(bus, hand, first, topics)
    see(bus, hand, late, topics)  # what was sent once comes again
    answers = {one.sequence: one for one in bus.got["skin/displacement"]}
    seen = [deserialize_message(one, SkinDisplacement) for one in first.got[topics[1]]]
    assert any(np.frombuffer(one.displacement, np.float32).any() for one in seen)
    assert all(one == answers[one.sequence] for one in seen if one.sequence in answers)
    for viewer in viewers:
        viewer.socket.close()
    bus.wait(lambda: not bus.node.get_subscriptions_info_by_topic("/robot/skin/marker"), "that nobody looks any more")


def test_an_address_in_use_is_told_in_one_sentence(url, capsys):
    port = url.rpartition(":")[2]
    code, said = end(start(*STMPL, "foxglove", "--port", port))
    assert code == 1 and f"cannot listen at 127.0.0.1:{port}" in said and "Traceback" not in said


def test_the_layout_names_topics_that_are_forwarded():
    from stmpl_ros.forwarder import WANTED

    layout = (ROOT / "stmpl_ros/foxglove/stmpl.json").read_text()
    topics = {f"/{name}" for name in re.findall(r'"/((?:skin|tools|diagnostics)[\w/]*)', layout)}
    assert len(topics) > 5 and all(re.fullmatch(WANTED, topic) for topic in {*topics, "/tools/panda/tool0/pose"})
