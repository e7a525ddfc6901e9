"""What is read of the bytes of poses and wrenches, and written, is what rclpy reads and writes."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from bags.wire import header, pose_from, stamp_ns, wrench_message
from stmpl_core.errors import InvalidInput
from stmpl_ros.cdr import WrenchBytes, read_pose, read_wrench

FRAMES = st.text(st.characters(blacklist_characters="\0", blacklist_categories=["Cs"]), max_size=20)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
SIX = st.lists(st.floats(allow_nan=False), min_size=6, max_size=6)


@given(FRAMES, STAMPS, st.lists(st.floats(allow_nan=False), min_size=7, max_size=7))
def test_a_pose_is_read_as_rclpy_reads_it(frame: str, stamp: int, values: list[float]) -> None:
    message = PoseStamped(header=header(frame, stamp))
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z, q.x, q.y, q.z, q.w = values
    read = read_pose(serialize_message(message))
    assert (read.header.frame_id, stamp_ns(read)) == (frame, stamp)
    assert [*read.pose.position, *read.pose.orientation] == values


@given(FRAMES, STAMPS, SIX)
def test_a_wrench_is_read_and_written_as_by_rclpy(frame: str, stamp: int, values: list[float]) -> None:
    data = serialize_message(wrench_message(np.array(values), frame, stamp))
    read = read_wrench(data)
    assert (read.header.frame_id, stamp_ns(read)) == (frame, stamp)
    assert [*read.wrench.force, *read.wrench.torque] == values
    written = WrenchBytes(frame).of(np.array(values), stamp)
    assert deserialize_message(written, WrenchStamped) == deserialize_message(data, WrenchStamped)


def test_bytes_of_the_other_order_are_read_too() -> None:
    stamp_and_frame = b"\x00\x00\x00\x07" + bytes(4) + b"\x00\x00\x00\x01" + bytes(4)  # 7 s, and an empty text
    swapped = bytes(4) + stamp_and_frame + bytes(6 * 8) + b"\x3f\xf0" + bytes(6)  # w is 1
    read = read_pose(swapped)
    assert read.header.stamp.sec == 7
    assert np.array_equal(pose_from(read.pose), np.eye(4))


@pytest.mark.parametrize("read", [read_pose, read_wrench])
def test_bytes_that_are_no_message_are_refused(read) -> None:
    data = serialize_message(PoseStamped(header=header("body", 5)))
    for cut in (4, 12, 18, 30):
        with pytest.raises(InvalidInput, match="no message"):
            read(data[:cut])
    assert read(b"\x00\x03" + data[2:]).header.frame_id == "body", "a list of parameters, which rclpy reads"
    for odd in (b"\x07\x01" + data[2:], b"\x00\x03" + data[2:18], b""):
        with pytest.raises(InvalidInput, match=r"no message of this kind: they begin with .*, where plain CDR"):
            read(odd)
