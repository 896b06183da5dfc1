# SPDX-License-Identifier: Apache-2.0
"""ROS 1 messages: columns equal what rosbags serialises, message by message."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from messages_any import ROOT, Example, columns_by_the_book, examples, same
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_cdr import as_messages

from abyssnav.errors import ReadError
from abyssnav.formats.cdr import ROS1, decode_rows, find_layout
from abyssnav.formats.columns import Ragged
from abyssnav.formats.decoding import definition_of, field_decoder
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.schema import parse_ros1msg


def serialized(example: Example) -> list[bytes]:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(example.text, ROOT))
    messages = [as_messages(store.types, example, "Root", row) for row in example.messages]
    return [bytes(store.serialize_ros1(message, ROOT)) for message in messages]


@settings(max_examples=200, deadline=None)
@given(examples())
def test_columns_of_any_type_equal_what_rosbags_serialised(example: Example) -> None:
    expected = columns_by_the_book(example.tree, example.messages)
    payloads = Ragged.from_bytes(serialized(example))
    columns, kept = decode_rows(parse_ros1msg(example.text, ROOT), payloads, rules=ROS1)
    assert kept.all()
    assert columns.keys() == expected.keys()
    assert all(same(columns[name], expected[name]) for name in expected)


@settings(max_examples=100, deadline=None)
@given(examples(), st.data())
def test_a_cut_message_is_left_out_and_the_others_are_read(
    example: Example, data: st.DataObject
) -> None:
    rows = serialized(example)
    if not rows:
        return
    cut = data.draw(st.integers(0, max(0, len(rows[0]) - 1)))
    columns, kept = decode_rows(
        parse_ros1msg(example.text, ROOT), Ragged.from_bytes([rows[0][:cut], *rows[1:]]), rules=ROS1
    )
    expected = columns_by_the_book(example.tree, example.messages[1:])
    if len(rows[0]):
        assert kept.tolist() == [False] + [True] * (len(rows) - 1)
        assert all(same(columns[name], expected[name]) for name in expected)


@settings(max_examples=100, deadline=None)
@given(examples(), st.data())
def test_a_layout_places_fields_where_the_walk_finds_them(
    example: Example, data: st.DataObject
) -> None:
    definition = parse_ros1msg(example.text, ROOT)
    payloads = Ragged.from_bytes(serialized(example))
    columns, _ = decode_rows(definition, payloads, rules=ROS1)
    for path, column in columns.items():
        for row, payload in enumerate(payloads.row_bytes()):
            raw = np.frombuffer(payload, np.uint8)
            layout = find_layout(definition, raw, [path], ROS1)
            if layout is None:
                continue
            one = layout.columns(raw[None, : layout.width])[path]
            assert same(one, column[np.array([row])])


TIMES = """std_msgs/Header header
time t
duration d
byte b
char c
====
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""


def test_times_and_durations_are_nanoseconds_and_bytes_are_signed() -> None:
    payload = np.array([7, 4_000_000_000, 5, 1], "<u4").tobytes() + b"x"
    payload += np.array([1, 2], "<u4").tobytes() + np.array([-3, 4], "<i4").tobytes() + b"\xff\xff"
    tree = parse_ros1msg(TIMES, "a/B")
    columns, kept = decode_rows(tree, Ragged.from_bytes([payload]), rules=ROS1)
    assert kept.all()
    assert {name: column[0] for name, column in columns.items()} == {
        "header.seq": 7, "header.stamp": 4_000_000_000_000_000_005, "header.frame_id": "x",
        "t": 1_000_000_002, "d": -2_999_999_996, "b": -1, "c": 255,
    }  # fmt: skip


def test_the_official_times_of_ros_1_are_ours() -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    message = header(seq=3, stamp=time(sec=12, nanosec=34), frame_id="map")
    payload = bytes(store.serialize_ros1(message, "std_msgs/msg/Header"))
    text = "uint32 seq\ntime stamp\nstring frame_id\n"
    channel = Channel(1, "/h", "ros1", "std_msgs/Header", "ros1msg", text.encode())
    columns, kept = field_decoder(channel, ["stamp", "frame_id", "seq"]).decode(
        Ragged.from_bytes([payload])
    )
    assert kept.all()
    assert [columns[name][0] for name in ("stamp", "frame_id", "seq")] == [12_000_000_034, "map", 3]


def test_an_empty_message_takes_no_byte_and_an_array_of_them_is_refused() -> None:
    text = "any_msgs/E e\nuint8 x\n====\nMSG: any_msgs/E\n"
    tree = parse_ros1msg(text, ROOT)
    columns, kept = decode_rows(tree, Ragged.from_bytes([b"\5"]), ["x"], ROS1)
    assert kept.all()
    assert columns["x"].tolist() == [5]
    many = parse_ros1msg(text.replace("E e", "E[] e"), ROOT)
    payload = np.array([2**31], "<u4").tobytes() + b"\5"
    with pytest.raises(ReadError, match="e is an array of messages without fields"):
        decode_rows(many, Ragged.from_bytes([payload]), ["x"], ROS1)


def test_a_definition_recorded_empty_is_ours_where_we_ship_the_type() -> None:
    for kind, encoding in (("cdr", "ros2msg"), ("cdr", "ros2idl"), ("ros1", "ros1msg")):
        channel = Channel(1, "/imu", kind, "sensor_msgs/msg/Imu", encoding, b" \n")
        names = [field.name for field in definition_of(channel).types["sensor_msgs/Imu"]]
        assert names[:2] == ["header", "orientation"]
        header = [field.name for field in definition_of(channel).types["std_msgs/Header"]]
        assert header == ["seq", "stamp", "frame_id"][encoding != "ros1msg" :]
    other: dict[str, Any] = {"schema_encoding": "ros2msg", "definition": b""}
    empty = definition_of(Channel(1, "/a", "cdr", "std_msgs/msg/Empty", **other))
    assert [field.name for field in empty.types["std_msgs/Empty"]] == [
        "structure_needs_at_least_one_member"
    ]
