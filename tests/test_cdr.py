# SPDX-License-Identifier: Apache-2.0
"""CDR: columns equal what others decode message by message."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from messages_any import ROOT, Example, columns_by_the_book, examples, same
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from abyssnav.errors import ReadError
from abyssnav.formats import cdr
from abyssnav.formats.cdr import CdrDecoder, decode, decode_rows, find_layout
from abyssnav.formats.cdr_encoder import PayloadTemplates, encode, encode_lazily
from abyssnav.formats.columns import Ragged
from abyssnav.formats.schema import (
    leaves,
    message_definition,
    our_definition,
    parse_ros2idl,
    parse_ros2msg,
)

IMU = our_definition("sensor_msgs/msg/Imu")


def as_messages(types: Any, example: Example, name: str, value: dict[str, Any]) -> Any:
    """A message object of rosbags from nested dictionaries."""
    filled = {}
    for field, kind, count in example.tree[name]:
        item = value[field]
        if kind in example.tree:
            item = (
                as_messages(types, example, kind, item)
                if count is None
                else [as_messages(types, example, kind, part) for part in item]
            )
        elif count is not None and kind != "string":
            item = np.array(item, np.dtype(kind))
        filled[field] = item
    return types[f"any_msgs/msg/{name}"](**filled)


def serialized(example: Example, little_endian: bool) -> list[bytes]:
    """Payloads as rosbags writes them."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(example.text, ROOT))
    messages = [as_messages(store.types, example, "Root", row) for row in example.messages]
    return [bytes(store.serialize_cdr(m, ROOT, little_endian=little_endian)) for m in messages]


@pytest.mark.parametrize("few", [0, 64], ids=["side by side", "one by one"])
@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(example=examples())
def test_columns_of_any_type_equal_what_rosbags_wrote_in_both_byte_orders(
    few: int, monkeypatch: pytest.MonkeyPatch, example: Example
) -> None:
    monkeypatch.setattr(cdr, "_FEW_MESSAGES", few)
    definition = parse_ros2msg(example.text, ROOT)
    expected = columns_by_the_book(example.tree, example.messages)
    for little_endian in (True, False):
        payloads = Ragged.from_bytes(serialized(example, little_endian))
        columns = decode(definition, payloads)
        assert columns.keys() == expected.keys()
        assert all(same(columns[name], expected[name]) for name in expected)


@settings(max_examples=150, deadline=None)
@given(examples())
def test_columns_of_any_type_are_encoded_byte_by_byte_as_rosbags_does(example: Example) -> None:
    columns = columns_by_the_book(example.tree, example.messages)
    payloads = encode(parse_ros2msg(example.text, ROOT), columns, len(example.messages))
    assert payloads.row_bytes() == serialized(example, little_endian=True)


@settings(max_examples=60, deadline=None)
@given(examples())
def test_the_official_decoder_reads_what_we_encode(example: Example) -> None:
    columns = columns_by_the_book(example.tree, example.messages)
    payloads = encode(parse_ros2msg(example.text, ROOT), columns, len(example.messages))
    official = generate_dynamic("any_msgs/Root", example.text)["any_msgs/Root"]
    again = serialize_dynamic("any_msgs/Root", example.text)["any_msgs/Root"]
    for payload in payloads.row_bytes():
        assert bytes(again(official(payload))) == payload


@settings(max_examples=60, deadline=None)
@given(examples())
def test_any_one_field_alone_equals_the_same_among_all(example: Example) -> None:
    definition = parse_ros2msg(example.text, ROOT)
    payloads = Ragged.from_bytes(serialized(example, little_endian=True))
    everything = decode(definition, payloads)
    for path, column in everything.items():
        assert same(decode(definition, payloads, [path])[path], column)


@settings(max_examples=60, deadline=None)
@given(examples())
def test_a_definition_in_idl_is_the_same_as_in_msg(example: Example) -> None:
    as_msg, as_idl = parse_ros2msg(example.text, ROOT), parse_ros2idl(example.idl, ROOT)
    assert as_idl.root == as_msg.root
    assert {name: as_idl.types[name] for name in as_msg.types} == as_msg.types


def test_idl_of_a_real_message_reads_as_its_msg_does() -> None:
    text = """module nav_msgs { module msg {
      typedef double double__36[3 ];
      enum Quality { GOOD, @value(3) BAD };
      struct Fix {
        std_msgs::msg::Header header;
        @unit(value="m") double x, y;  // two at once
        /* a typedef'd array */ double__36 covariance;
        sequence<double, 5> bounded; string<12> short_name; wstring wide; Quality quality;
      }; }; };
    ================================================================================
    IDL: std_msgs/msg/Header
    module std_msgs { module msg { struct Header {
      builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
    """
    definition = parse_ros2idl(text, "nav_msgs/msg/Fix")
    assert [(f.name, f.type, f.count) for f in definition.types["nav_msgs/Fix"]] == [
        ("header", "std_msgs/Header", None), ("x", "float64", None), ("y", "float64", None),
        ("covariance", "float64", 3), ("bounded", "float64", -1), ("short_name", "string", None),
        ("wide", "wstring", None), ("quality", "uint32", None),
    ]  # fmt: skip
    with pytest.raises(ValueError, match="wide is a wstring, which is not written"):
        encode(definition, {}, 1)
    narrow = parse_ros2idl(text.replace("wstring wide;", ""), "nav_msgs/msg/Fix")
    payload = encode(narrow, {"header.stamp": 7, "x": 2.5}, 1)
    assert decode(definition, payload, ["header.stamp", "x"]) == {"header.stamp": 7, "x": 2.5}
    with pytest.raises(ReadError, match="wide is a wstring, which is not read"):
        decode(definition, payload, ["quality"])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("module a { module msg { struct B {", "the IDL ends too early"),
        ("union U switch(long) {};", "'union' is not read in IDL"),
        ("module a { module msg { struct C { long x; }; }; };", "no such struct; there are: a/C"),
        ("module a { struct B { long x[N]; }; };", "'N' is no size known in the IDL"),
        ("module a { struct B { long x long y; }; };", "';' expected in the IDL, not 'long'"),
        ("module a { struct B { b::msg::C x; }; };", "B.x has the unknown type 'b/C'"),
        ("module a { typedef sequence<octet> S; struct B { S x[2]; }; };", "arrays of sequences"),
        ("module a { @bit_bound(8) enum E { X }; struct B { E x; }; };", "@bit_bound is not read"),
        ("module a { struct B { octet x[999999999999]; }; };", "no size known in the IDL"),
        ("module a { struct B { unsigned", "the IDL ends too early"),
    ],
)
def test_idl_that_is_not_read_is_refused(text: str, problem: str) -> None:
    with pytest.raises(ReadError, match=problem):
        parse_ros2idl(text, "a/msg/B")


def test_idl_keeps_packages_apart_arrays_whole_and_text_as_it_is() -> None:
    text = """module q { module msg { enum Status { X, Y }; }; };
    module p { module msg {
      module A_Constants { const string URL = "http://example.org/*x"; const int32 N = 2; };
      struct Status { uint8 v; };
      typedef uint8 Three[3];
      struct A { p::msg::Status s; q::msg::Status e; Three t[N]; };
    }; };"""
    definition = parse_ros2idl(text, "p/msg/A")
    assert [(f.name, f.type, f.count) for f in definition.types["p/A"]] == [
        ("s", "p/Status", None), ("e", "uint32", None), ("t", "uint8", 6),
    ]  # fmt: skip


def test_a_package_may_have_a_header_of_its_own_and_odd_ends_of_lines_in_comments() -> None:
    text = "Header h  # a\x85b\u2028c\x0cd\n====\nMSG: a/Header\nuint8 x\n"
    assert parse_ros2msg(text, "a/msg/B").types["a/B"][0].type == "a/Header"
    with pytest.raises(ReadError, match="unknown type 'std_msgs/Header'"):
        parse_ros2msg("Header h\n", "a/msg/B")


@pytest.mark.parametrize("size", ["0", "999999999999", "9" * 5000])
def test_arrays_of_no_size_or_an_absurd_one_are_refused(size: str) -> None:
    with pytest.raises(ReadError, match=r"an array of .* items: 1 to 268435456 are read"):
        parse_ros2msg(f"uint8[{size}] x\n", "a/msg/B")


def test_a_definition_that_doubles_at_each_level_is_refused_in_no_time() -> None:
    levels = [f"MSG: a/T{k}\na/T{k + 1} x\na/T{k + 1} y\n" for k in range(30)]
    text = "a/T0[] many\n====\n" + "====\n".join([*levels, "MSG: a/T30\nuint8 z\n"])
    with pytest.raises(ReadError, match="a/T17 has too many fields"):
        parse_ros2msg(text, "a/msg/B")
    fine = parse_ros2msg(text.replace("a/T0[] many", "a/T20 one"), "a/msg/B")
    assert (len(list(leaves(fine))), fine.least_bytes["a/T20"]) == (2**10, 2**10)


def imu_payloads(n: int, frame: str = "imu") -> Ragged:
    stamps = np.arange(n) * 10**8
    columns = {"header.stamp": stamps, "header.frame_id": frame, "orientation.w": np.arange(n)}
    return encode(IMU, columns, n)


def test_a_payload_cut_behind_the_last_wanted_field_is_enough() -> None:
    payloads = imu_payloads(5)
    rows = np.asarray(payloads.content).reshape(5, -1)
    found = find_layout(IMU, rows[0], ["orientation.w", "header.stamp"])
    assert found
    width = found.width
    assert width == 4 + 8 + 4 + 4 + 32
    columns = decode(IMU, Ragged.regular(rows[:, :width]), ["orientation.w", "header.stamp"])
    assert columns["orientation.w"].tolist() == [0, 1, 2, 3, 4]
    assert columns["header.stamp"].tolist() == [0, 10**8, 2 * 10**8, 3 * 10**8, 4 * 10**8]


def test_short_and_bent_payloads_are_left_out_and_the_rest_is_read() -> None:
    rows = imu_payloads(6).row_bytes()
    rows[1] = rows[1][:50]  # ends inside the orientation
    rows[2] = rows[2][:12] + b"\xff\xff\xff\x7f" + rows[2][16:]  # 2 GB of frame_id
    rows[3] = b"\0\7" + rows[3][2:]  # XCDR2
    rows[4] = b"\0"
    columns, kept = decode_rows(IMU, Ragged.from_bytes(rows), ["orientation.w"])
    assert kept.tolist() == [True, False, False, False, False, True]
    assert np.asarray(columns["orientation.w"]).tolist() == [0, 5]
    with pytest.raises(ReadError, match="message 1 does not fit"):
        decode(IMU, Ragged.from_bytes(rows))


def test_a_sequence_longer_than_its_message_takes_no_memory() -> None:
    definition = parse_ros2msg(
        "float64[] a\nstring[] b\nany_msgs/E[] c\n====\nMSG: any_msgs/E\n", ROOT
    )
    for at in range(3):
        counts = [0, 0, 0]
        counts[at] = 2**31
        payload = b"\0\1\0\0" + np.array(counts, "<u4").tobytes()
        _, kept = decode_rows(definition, Ragged.from_bytes([payload]))
        assert kept.tolist() == [False]


def test_both_byte_orders_in_one_topic_keep_their_order() -> None:
    little = imu_payloads(2).row_bytes()
    store = get_typestore(Stores.ROS2_HUMBLE)
    message = store.deserialize_cdr(little[1], "sensor_msgs/msg/Imu")
    big = bytes(store.serialize_cdr(message, "sensor_msgs/msg/Imu", little_endian=False))
    columns = decode(IMU, Ragged.from_bytes([little[0], big, little[1], little[0]]))
    assert np.asarray(columns["orientation.w"]).tolist() == [0, 1, 1, 0]
    assert np.asarray(columns["header.frame_id"]).tolist() == ["imu"] * 4


def test_text_of_varying_length_moves_what_follows() -> None:
    frames = ["", "a", "abcdefg", "abcdefgh", "ümlaut"]
    payloads = encode(IMU, {"header.frame_id": frames, "orientation.x": np.arange(5.0)}, 5)
    columns = decode(IMU, payloads, ["header.frame_id", "orientation.x"])
    assert np.asarray(columns["header.frame_id"]).tolist() == frames
    assert np.asarray(columns["orientation.x"]).tolist() == [0, 1, 2, 3, 4]


def test_as_many_texts_as_messages_are_written_like_a_few() -> None:
    stamps, few = np.arange(200) * 10**8, np.array(["a", "bcd"])[np.arange(200) % 2]
    many = np.where(np.arange(200) < 100, few, [f"frame {k}" for k in range(200)])
    for frames in (few, many):
        payloads = encode(IMU, {"header.frame_id": frames, "header.stamp": stamps}, 200)
        one_by_one = [
            encode(IMU, {"header.frame_id": str(frame), "header.stamp": stamp}, 1).row_bytes()[0]
            for frame, stamp in zip(frames, stamps, strict=True)
        ]
        assert payloads.row_bytes() == one_by_one


def test_some_payloads_of_a_topic_are_those_of_the_whole() -> None:
    columns = {"header.frame_id": ["a", "bcd"] * 10, "orientation.x": np.arange(20.0)}
    lazy, whole = encode_lazily(IMU, columns, 20), encode(IMU, columns, 20).row_bytes()
    assert isinstance(lazy, PayloadTemplates)
    for rows in (np.array([3, 2, 17, 3]), slice(4, 9), np.arange(20) > 15, np.arange(0)):
        expected = [whole[k] for k in np.arange(20)[rows]]
        assert lazy[rows].row_bytes() == expected
        assert lazy[rows].lengths.tolist() == [len(row) for row in expected]


def test_texts_may_be_places_in_a_list_of_words() -> None:
    words, places = ("a", "bcd"), np.arange(100) % 2
    other = {"orientation.x": np.arange(100.0)}
    lazy = encode_lazily(IMU, {"header.frame_id": (places, words), **other}, 100)
    assert isinstance(lazy, PayloadTemplates)
    texts = [words[place] for place in places]
    expected = encode(IMU, {"header.frame_id": texts, **other}, 100).row_bytes()
    assert lazy[:].row_bytes() == expected
    many = tuple(f"frame {k}" for k in range(100))  # too many to be laid out beforehand
    walked = encode(IMU, {"header.frame_id": (np.arange(100), many), **other}, 100)
    assert (
        walked.row_bytes() == encode(IMU, {"header.frame_id": list(many), **other}, 100).row_bytes()
    )


def test_arrays_of_one_element_are_not_laid_down_before_they_are_written() -> None:
    tree, n = our_definition("tf2_msgs/msg/TFMessage"), 20
    stamps, x = np.arange(n) * 10**8, np.arange(float(n))
    columns = {
        "transforms.header.frame_id": "map",
        "transforms.header.stamp": stamps[:, None],
        "transforms.transform.translation.x": x[:, None],
    }
    lazy = encode_lazily(tree, columns, n)
    assert isinstance(lazy, PayloadTemplates)
    store = get_typestore(Stores.ROS2_HUMBLE)
    for k, payload in enumerate(lazy[:].row_bytes()):
        message: Any = store.deserialize_cdr(payload, "tf2_msgs/msg/TFMessage")
        (transform,) = message.transforms
        stamp = transform.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == stamps[k]
        assert transform.header.frame_id == "map"
        assert transform.transform.translation.x == x[k]


def test_elements_of_an_array_may_be_columns_over_the_same_rest() -> None:
    name, some = "geometry_msgs/msg/PoseWithCovarianceStamped", np.arange(3.0)
    whole = np.tile(np.linspace(1.0, 2.0, 36), (3, 1))
    columns = {
        "pose.covariance": whole[0],
        "pose.covariance[7]": some,
        "pose.covariance[35]": -some,
    }
    whole[:, 7], whole[:, 35] = some, -some
    expected = encode(our_definition(name), {"pose.covariance": whole}, 3)
    assert encode(our_definition(name), columns, 3).row_bytes() == expected.row_bytes()
    for odd in ("pose.covariance[36]", "pose.pose.position.x[0]", "pose[0]"):
        with pytest.raises(ValueError, match=f"no field {re.escape(odd)}"):
            encode(our_definition(name), {odd: some}, 3)


@pytest.mark.parametrize("name", ["sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry",
                                  "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/FluidPressure",
                                  "geometry_msgs/msg/TwistWithCovarianceStamped",
                                  "geometry_msgs/msg/PoseWithCovarianceStamped"])  # fmt: skip
def test_our_standard_definitions_are_those_of_ros(name: str) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    payload = encode(our_definition(name), {"header.frame_id": "x"}, 1).row_bytes()[0]
    message = store.deserialize_cdr(payload, name)
    assert bytes(store.serialize_cdr(message, name)) == payload
    ours = get_types_from_msg(message_definition(name), name)
    assert ours[name][1] == store.fielddefs[name][1]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("float64", "no field in the line"),
        ("Unknown thing", r"Root\.thing has the unknown type 'any_msgs/Unknown'"),
        ("Root again", "any_msgs/Root contains itself"),
        ("float64 x\n====\nNOT: a/B", "'MSG: package/Type' expected, not 'NOT: a/B'"),
    ],
)
def test_a_definition_that_cannot_be_is_refused(text: str, problem: str) -> None:
    with pytest.raises(ReadError, match=problem):
        parse_ros2msg(text, ROOT)


def test_a_field_that_is_not_there_is_named_with_those_that_are() -> None:
    with pytest.raises(ReadError, match=r"no field 'orientation.q' .* has: x, y, z, w"):
        decode(IMU, imu_payloads(1), ["orientation.q"])
    with pytest.raises(ValueError, match=r"no field oreintation\.x"):
        encode(IMU, {"oreintation.x": 1.0}, 1)


def test_columns_of_the_wrong_length_are_refused() -> None:
    with pytest.raises(ValueError, match=r"orientation\.x: shape \(3,\)"):
        encode(IMU, {"orientation.x": np.zeros(3)}, 2)
    beacons = our_definition("abyssnav_msgs/msg/BeaconArray")
    with pytest.raises(ValueError, match="beacons: its columns differ in length"):
        encode(beacons, {"beacons.id": [[1, 2]], "beacons.name": [["a"]]}, 1)


@pytest.mark.parametrize(
    ("text", "element"),
    {
        "structs": ("S[] s\n====\nMSG: a/S\nfloat64 a\nuint8 b\n", b"\0" * 9 + b"\0" * 7),
        "texts": ("string[] s\n", b"\3\0\0\0ab\0\0"),
        "structs of text": ("S[] s\n====\nMSG: a/S\nstring a\n", b"\3\0\0\0ab\0\0"),
        "structs of arrays": (
            "S[] s\n====\nMSG: a/S\nuint8[] a\nT[2] t\n====\nMSG: a/T\nint32[] b\n",
            b"\1\0\0\0\7\0\0\0" + b"\0" * 8,
        ),
    }.values(),
)  # fmt: skip
def test_a_message_of_a_hundred_thousand_elements_takes_no_step_for_each(
    text: str, element: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    n, steps = 100_000, []
    step = CdrDecoder._step
    monkeypatch.setattr(
        CdrDecoder, "_step", lambda self, *words: (steps.append(1), step(self, *words))[1]
    )
    head = np.array([n], "<u4").tobytes() + (b"" if element[0] else b"\0" * 4)
    payload = b"\0\1\0\0" + head + element * n
    columns = decode(parse_ros2msg(text, "a/msg/B"), Ragged.from_bytes([payload]))
    assert all(len(column) == 1 for column in columns.values())
    assert {len(c.content) for c in columns.values() if isinstance(c, Ragged)} == {n}
    assert len(steps) < 10
    _, kept = decode_rows(parse_ros2msg(text, "a/msg/B"), Ragged.from_bytes([payload[:-9]]))
    assert not kept.any()
