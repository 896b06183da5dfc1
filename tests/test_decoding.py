# SPDX-License-Identifier: Apache-2.0
"""Protobuf and JSON: the same columns as their official decoders give, message by message."""

import json
import math
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from hypothesis import given, settings
from hypothesis import strategies as st
from protobuf_any import proto_columns, proto_examples

from abyssnav.errors import ReadError
from abyssnav.formats import json as json_columns
from abyssnav.formats import protobuf
from abyssnav.formats.columns import Ragged
from abyssnav.formats.decoding import field_decoder
from abyssnav.formats.mcap import file_index
from abyssnav.formats.mcap.accumulator import ChannelAccumulator
from abyssnav.formats.mcap.chunks import Rows
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.mcap.writer import ros2_channel
from abyssnav.formats.protobuf import parse_descriptor_set


def root_descriptor(descriptor_set: bytes) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptor_set).file:
        pool.Add(file)
    return pool.FindMessageTypeByName("any.Root")


@settings(max_examples=200, deadline=None)
@given(proto_examples())
def test_columns_of_any_protobuf_type_equal_the_official_decoder(
    example: tuple[bytes, list[Any]],
) -> None:
    descriptor_set, messages = example
    tree = parse_descriptor_set(descriptor_set, "any.Root")
    payloads = Ragged.from_bytes([message.SerializeToString() for message in messages])
    columns, kept = protobuf.decode_rows(tree, payloads)
    expected = proto_columns(root_descriptor(descriptor_set), messages)
    assert kept.all()
    assert columns.keys() == expected.keys()
    for name, column in expected.items():
        assert same_or_nan(columns[name], column), name


def same_or_nan(ours: Any, theirs: Any) -> bool:
    if isinstance(ours, Ragged) and isinstance(theirs, Ragged):
        right = np.array_equal(ours.offsets, theirs.offsets)
        return right and same_or_nan(ours.content, theirs.content)
    nan = ours.dtype.kind == "f"
    return ours.dtype == theirs.dtype and np.array_equal(ours, theirs, equal_nan=nan)


@settings(max_examples=100, deadline=None)
@given(proto_examples(), st.data())
def test_cut_protobuf_messages_are_left_out_or_read_as_the_official_decoder_does(
    example: tuple[bytes, list[Any]], data: st.DataObject
) -> None:
    descriptor_set, messages = example
    tree = parse_descriptor_set(descriptor_set, "any.Root")
    kind = message_factory.GetMessageClass(root_descriptor(descriptor_set))
    rows, readable = [], []
    for message in messages:
        whole = message.SerializeToString()
        row = whole[: data.draw(st.integers(0, len(whole)))]
        rows.append(row)
        try:
            readable.append(kind.FromString(row))
        except Exception:  # the official decoder has its own error
            readable.append(None)
    columns, kept = protobuf.decode_rows(tree, Ragged.from_bytes(rows))
    # ours does not judge text that is no UTF-8
    assert all(there for there, message in zip(kept, readable, strict=True) if message is not None)
    if kept.tolist() == [message is not None for message in readable]:
        good = [message for message in readable if message is not None]
        expected = proto_columns(kind.DESCRIPTOR, good)
        assert all(same_or_nan(columns[name], column) for name, column in expected.items())


def vehicle_file() -> Any:
    """A descriptor file with a time stamp, a nested message and an enumeration."""
    file = descriptor_pb2.FileDescriptorProto(name="v.proto", package="v", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    message = file.message_type.add(name="Fix")
    field = descriptor_pb2.FieldDescriptorProto
    message.field.add(name="stamp", number=1, type=field.TYPE_MESSAGE, label=1,
                      type_name=".google.protobuf.Timestamp")  # fmt: skip
    message.field.add(name="x", number=2, type=field.TYPE_DOUBLE, label=1)
    message.field.add(name="self", number=3, type=field.TYPE_MESSAGE, label=1, type_name=".v.Fix")
    return file


def test_a_protobuf_stamp_is_nanoseconds_and_a_type_in_itself_is_read_as_asked() -> None:
    files = [descriptor_pb2.FileDescriptorProto(), vehicle_file()]
    timestamp_pb2.DESCRIPTOR.CopyToProto(files[0])
    pool = descriptor_pool.DescriptorPool()
    for file in files:
        pool.Add(file)
    fix = message_factory.GetMessageClass(pool.FindMessageTypeByName("v.Fix"))
    rows = [fix(x=2.0), fix()]
    rows[0].stamp.FromNanoseconds(1_700_000_000_123_456_789)
    rows[1].self.x = 5.0
    tree = parse_descriptor_set(
        descriptor_pb2.FileDescriptorSet(file=files).SerializeToString(), "v.Fix"
    )
    payloads = Ragged.from_bytes([row.SerializeToString() for row in rows])
    columns, _ = protobuf.decode_rows(tree, payloads, ["stamp", "x", "self.x", "stamp.nanos"])
    assert np.asarray(columns["x"]).tolist() == [2.0, 0.0]
    assert np.isnan(np.asarray(columns["self.x"])[0])
    assert np.asarray(columns["self.x"])[1] == 5.0
    columns, _ = protobuf.decode_rows(tree, payloads, ["stamp"])
    assert np.asarray(columns["stamp"]).tolist() == [1_700_000_000_123_456_789, 0]
    with pytest.raises(ReadError, match=r"v\.Fix contains itself"):
        protobuf.decode_rows(tree, payloads)


def test_a_descriptor_set_that_cannot_be_read_or_lacks_the_type_is_refused() -> None:
    good = descriptor_pb2.FileDescriptorSet(file=[vehicle_file()]).SerializeToString()
    with pytest.raises(ReadError, match=r"no message v\.Fox; it has: v\.Fix"):
        parse_descriptor_set(good, "v.Fox")
    for length in range(1, len(good)):
        with pytest.raises(ReadError, match="descriptor set"):
            parse_descriptor_set(good[:length], "v.Fix")
    tree = parse_descriptor_set(good, "v.Fix")
    with pytest.raises(ReadError, match=r"no field 'y' in v\.Fix; v\.Fix has: stamp, x, self"):
        protobuf.decode_rows(tree, Ragged.from_bytes([]), ["y"])
    columns, _ = protobuf.decode_rows(tree, Ragged.from_bytes([b""]), ["stamp"])
    assert np.asarray(columns["stamp"]).tolist() == [0]  # Google's own types need not be there
    file = vehicle_file()
    file.message_type[0].field[2].type_name = ".v.Gone"
    lacking = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    with pytest.raises(ReadError, match=r"descriptor set of v\.Fix cannot be read: .*v\.Gone"):
        parse_descriptor_set(lacking, "v.Fix")


def test_of_a_field_that_comes_twice_the_last_counts() -> None:
    tree = parse_descriptor_set(
        descriptor_pb2.FileDescriptorSet(file=[vehicle_file()]).SerializeToString(), "v.Fix"
    )
    x = [b"\x11" + np.array([value], "<f8").tobytes() for value in (1.0, 2.0, 3.0)]
    unknown = b"\x98\x06\x01" + b"\xaa\x06\x03abc"  # fields 99 and 101 of later versions
    payloads = Ragged.from_bytes([x[0] + x[1], unknown + x[2] + unknown, x[1] + x[0]])
    columns, kept = protobuf.decode_rows(tree, payloads, ["x"])
    assert kept.all()
    assert np.asarray(columns["x"]).tolist() == [2.0, 3.0, 1.0]


# --- JSON ---------------------------------------------------------------------------------------

#: Fields by what their column holds.
OBJECTS = st.lists(
    st.fixed_dictionaries(
        {
            "f": st.floats(allow_nan=False, allow_infinity=False),
            "i": st.integers(-(2**63), 2**63 - 1),
            "s": st.text(st.characters(codec="utf-8"), min_size=1).map(lambda t: "t" + t),
            "b": st.booleans(),
            "v": st.lists(st.integers(0, 9), max_size=4),
            "o": st.fixed_dictionaries({"f": st.floats(-9, 9)}),
            "a": st.lists(st.fixed_dictionaries({"f": st.floats(-9, 9)}), max_size=3),
        },
        optional={"n": st.none() | st.floats(-9, 9)},
    ),
    min_size=1,
    max_size=6,
)


@settings(max_examples=150, deadline=None)
@given(OBJECTS)
def test_columns_of_any_json_equal_what_the_standard_library_decodes(rows: list[Any]) -> None:
    payloads = Ragged.from_bytes([json.dumps(row).encode() for row in rows])
    columns, kept = json_columns.decode_rows(payloads, ["f", "i", "s", "b", "n", "v", "o.f", "a.f"])
    assert kept.all()
    assert np.asarray(columns["f"]).tolist() == [row["f"] for row in rows]
    assert np.asarray(columns["i"]).tolist() == [row["i"] for row in rows]
    assert np.asarray(columns["s"]).tolist() == [row["s"] for row in rows]
    assert np.asarray(columns["b"]).tolist() == [row["b"] for row in rows]
    unknown = np.array([row.get("n") for row in rows], np.float64)
    assert np.array_equal(np.asarray(columns["n"]), unknown, equal_nan=True)
    assert np.asarray(columns["o.f"]).tolist() == [row["o"]["f"] for row in rows]
    for name, lists in (("v", [r["v"] for r in rows]),
                        ("a.f", [[i["f"] for i in r["a"]] for r in rows])):  # fmt: skip
        column = columns[name]
        assert isinstance(column, Ragged)
        assert [part.tolist() for part in np.split(column.content, column.offsets[1:-1])] == lists


ANYTHING = st.recursive(
    st.none() | st.integers(-9, 9) | st.sampled_from(["", "a", "7", "NaN"]),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abc"), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.dictionaries(st.sampled_from("ab"), ANYTHING), min_size=1, max_size=4),
    st.lists(st.sampled_from(["a", "b", "a.b", "a.b.c", "a.c", "b.a"]), min_size=1, unique=True),
)
def test_json_read_as_far_as_it_is_wanted_is_as_if_read_whole(
    rows: list[Any], fields: list[str]
) -> None:
    told = [json.dumps(row).encode() for row in rows]
    found = []
    for odd in ([], [b"3"]):  # what is no object has the others read whole
        try:
            columns, kept = json_columns.decode_rows(Ragged.from_bytes(told + odd), fields)
        except ReadError as error:
            found.append(str(error))
            continue
        assert kept.tolist() == [True] * len(told) + [False] * len(odd)
        found.append({name: plain(column) for name, column in columns.items()})
    assert repr(found[0]) == repr(found[1])  # as nan is not nan


def plain(column: Any) -> Any:
    if isinstance(column, Ragged):
        return column.offsets.tolist(), plain(column.content)
    return column.dtype, column.tolist()


def column_of(*values: str) -> Any:
    rows = [b'{"x": %s}' % value.encode() for value in values]
    return json_columns.decode_rows(Ragged.from_bytes(rows), ["x"])[0]["x"]


def test_numbers_and_times_come_in_their_json_clothes() -> None:
    assert column_of('"9007199254740993"', "4").tolist() == [9007199254740993, 4]
    assert np.isnan(column_of("null", "2.5")).tolist() == [True, False]
    assert str(column_of('"NaN"', '"-Infinity"', "1").tolist()) == "[nan, -inf, 1.0]"
    assert column_of('{"sec": 5, "nanosec": 7}', "null").tolist() == [5_000_000_007, 0]
    assert column_of('{"nsec": 7, "sec": 5}').tolist() == [5_000_000_007]
    assert column_of("true", "null").tolist() == [True, False]
    assert column_of('"a"', "null").tolist() == ["a", ""]
    assert column_of(str(2**70)).tolist() == [2.0**70]


def test_what_is_no_json_object_is_left_out_and_what_is_no_column_refused() -> None:
    rows = [b'{"x": 1}', b'{"x": 2', b"3", b'\xff{"x": 4}', b'{"x": 5}, {"x": 6}', b'{"x": 7}']
    columns, kept = json_columns.decode_rows(Ragged.from_bytes(rows), ["x"])
    assert kept.tolist() == [True, False, False, False, False, True]
    assert np.asarray(columns["x"]).tolist() == [1, 7]
    with pytest.raises(ReadError, match="x is an array in some messages and none in others"):
        column_of("[1]", "2")
    with pytest.raises(ReadError, match="x is no number, text or time; it has: a, b"):
        column_of('{"a": 1, "b": 2}')


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (['{"sec": null, "nanosec": 1}'], "x is no time: {'sec': None"),
        (['{"sec": 1.5, "nanosec": 1}'], "x is no time: {'sec': 1.5"),
        (['{"seconds": "NaN", "nanos": 1}'], "x is no time: {'seconds': 'NaN'"),
        (['{"sec": 1, "nanosec": 1}', "3"], "x is a time in some messages, and 3 in others"),
        (['{"sec": 9300000000, "nanosec": 1}'], "x is a number that 64 bits do not hold"),
        (["9" * 400, "1.5"], "x is a number that 64 bits do not hold"),
        (["[" * 900 + "]" * 900], "x is an array of arrays .* too deep"),
    ],
)
def test_json_that_no_column_holds_is_refused_by_name(values: list[str], told: str) -> None:
    with pytest.raises(ReadError, match=told):
        column_of(*values)


def test_messages_of_arrays_without_end_are_no_json() -> None:
    _, kept = json_columns.decode_rows(
        Ragged.from_bytes([b'{"x":' + b"[" * 100_000, b'{"x": 1}']), ["x"]
    )
    assert kept.tolist() == [False, True]


def test_bare_nan_as_pythons_own_library_writes_it_is_unknown() -> None:
    rows = [json.dumps({"x": math.nan}).encode(), b'{"x": -Infinity}', b'{"x": 1}', b'{"x": NaM}']
    columns, kept = json_columns.decode_rows(Ragged.from_bytes(rows), ["x"])
    assert kept.tolist() == [True, True, True, False]
    assert str(np.asarray(columns["x"]).tolist()) == "[nan, -inf, 1.0]"
    assert np.isnan(np.asarray(column_of('"12"', "null"))).tolist() == [False, True]


JSON = Channel(1, "/a", "json")


def gathered(*batches: list[str], fields: list[str]) -> ChannelAccumulator:
    """What comes of JSON messages decoded in several batches."""
    mine = ChannelAccumulator(field_decoder(JSON, fields), 0, 0)
    for batch in batches:
        payloads = Ragged.from_bytes([value.encode() for value in batch])
        starts, lengths = payloads.offsets[:-1], payloads.lengths
        extremes = int(lengths.min()), int(lengths.max())
        mine.add(np.asarray(payloads.content), Rows(starts, lengths, starts, *extremes))
        mine.decode()
    return mine


@pytest.mark.parametrize(
    ("batches", "column"),
    [
        ([['{"x": "a"}'], ['{"x": null}'], ['{"x": "b"}']], ["a", "", "b"]),
        ([['{"x": null}'], ['{"x": "a"}']], ["", "a"]),
        ([['{"x": 1}'], ['{"x": null}', '{"x": 2.5}']], [1.0, math.nan, 2.5]),
    ],
)
def test_unknown_in_one_batch_of_json_and_text_in_another_keep_their_rows(
    batches: list[list[str]], column: list[Any]
) -> None:
    messages = gathered(*batches, fields=["x"]).messages(JSON)
    assert messages is not None
    assert str(np.asarray(messages.columns["x"]).tolist()) == str(column)
    arrays = gathered(['{"x": null}'], ['{"x": [1, 2]}'], fields=["x"]).messages(JSON)
    assert arrays is not None
    assert np.diff(arrays.columns["x"].offsets).tolist() == [0, 2]


def test_text_in_one_batch_of_json_and_numbers_in_another_are_no_column() -> None:
    messages = gathered(['{"x": "a"}'], ['{"x": 1}'], fields=["x"]).messages(JSON)
    assert messages is not None
    assert "x is text or an array in some messages, and not in others" in str(messages.problem)


def test_an_item_is_picked_from_arrays_only() -> None:
    def picked(*rows: str, field: str) -> Any:
        messages = gathered(list(rows), fields=[field]).messages(JSON)
        assert messages is not None
        return messages.problem or messages.columns[field].tolist()

    assert picked('{"x": ["a", "b"]}', '{"x": ["c"]}', field="x[1]") == ["b", ""]
    assert np.isnan(picked('{"x": null}', '{"x": null}', field="x[1]")).all()
    assert "no field 'x[0]': it is no array" in str(picked('{"x": 5}', '{"x": 6}', field="x[0]"))


@pytest.mark.parametrize("fields", [["header"], ["header.stamp", "header.stamp.sec"]])
def test_a_message_is_no_column(fields: list[str]) -> None:
    kind = "abyssnav_msgs/msg/Depth"
    channel = ros2_channel("/depth", kind, np.arange(3), {"depth": [1.0, 2.0, 3.0]})
    mine = file_index.Channel(1, "/depth", "cdr", kind, "ros2msg", channel.definition)
    payloads = channel.payloads[:]
    with pytest.raises(ReadError, match="is a message, or asked for in whole and in part"):
        field_decoder(mine, fields).decode(payloads)
    with pytest.raises(ReadError, match="is a message, or asked for in whole and in part"):
        field_decoder(mine, fields).layout(np.asarray(payloads[:1].content))


def test_a_definition_that_damage_made_is_refused_whatever_it_does_to_the_parser() -> None:
    sound = descriptor_pb2.FileDescriptorSet(file=[vehicle_file()]).SerializeToString()
    refused = 0
    for at in range(len(sound)):
        for bit in (1, 16, 128):
            bad = bytearray(sound)
            bad[at] ^= bit
            channel = Channel(1, "/a", "protobuf", "v.Fix", "protobuf", bytes(bad))
            try:
                field_decoder(channel, ["x"]).decode(Ragged.from_bytes([b""]))
            except ReadError:
                refused += 1
    assert refused > len(sound) // 4
