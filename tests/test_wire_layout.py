# SPDX-License-Identifier: Apache-2.0
"""Layouts: what is read by them equals what a walk over every message finds."""

from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from hypothesis import given, settings
from hypothesis import strategies as st
from messages_any import ROOT, Example, examples, same
from protobuf_any import proto_examples
from test_cdr import serialized
from test_decoding import same_or_nan

from abyssnav.formats import cdr, protobuf
from abyssnav.formats.cdr_encoder import encode
from abyssnav.formats.columns import FieldSlice, Ragged, WireLayout
from abyssnav.formats.decoding import decode_payloads, field_decoder
from abyssnav.formats.mcap.accumulator import ChannelAccumulator, Messages
from abyssnav.formats.mcap.chunks import Contents
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.mcap.records import MESSAGE, MESSAGE_FIELDS, MESSAGE_HEAD
from abyssnav.formats.protobuf import parse_descriptor_set
from abyssnav.formats.schema import leaves, message_definition, our_definition, parse_ros2msg

IMU = our_definition("sensor_msgs/msg/Imu")
IMU_CHANNEL = Channel(
    1, "/imu", "cdr", "sensor_msgs/msg/Imu", "ros2msg",
    message_definition("sensor_msgs/msg/Imu").encode(),
)  # fmt: skip


def agrees(pattern: WireLayout, payloads: Ragged, columns: dict[str, Any], equal: Any) -> None:
    """Assert that messages which a pattern says it fits have its columns."""
    fits = np.flatnonzero(pattern.may_fit(payloads.lengths))
    found = pattern.rows(np.asarray(payloads.content), payloads.offsets[:-1][fits])
    alike = pattern.fits(found)
    assert pattern.fits_all(found) == alike.all()
    ours = pattern.columns(found[alike])
    for name in ours:
        assert equal(ours[name], columns[name][fits[alike]]), name


@settings(max_examples=150, deadline=None)
@given(examples(), st.booleans(), st.data())
def test_what_a_cdr_layout_places_is_what_the_walk_finds(
    example: Example, little_endian: bool, data: st.DataObject
) -> None:
    rows = serialized(example, little_endian)
    if not rows:
        return
    definition, payloads = parse_ros2msg(example.text, ROOT), Ragged.from_bytes(rows)
    columns = cdr.decode(definition, payloads)
    payload = np.frombuffer(data.draw(st.sampled_from(rows)), np.uint8)
    for path, column in columns.items():
        pattern = cdr.find_layout(definition, payload, [path])
        if pattern is not None:
            assert pattern.fits(pattern.rows(payload, np.zeros(1, int))).all()
            agrees(pattern, payloads, columns, same)
        else:  # inside arrays
            assert isinstance(column, Ragged) or column.ndim > 1


def test_an_empty_array_needs_no_byte_behind_the_message() -> None:
    head = "any_msgs/Branch[] before\nbool last\n" + "=" * 80
    text = head + "\nMSG: any_msgs/Branch\nbool one\nbool[] more\n"
    payload = np.zeros(4 + 4 + 1, np.uint8)
    layout = cdr.find_layout(parse_ros2msg(text, ROOT), payload, ["last"])
    assert layout is not None
    assert layout.width == len(payload)


@settings(max_examples=200, deadline=None)
@given(proto_examples(), st.data())
def test_what_a_protobuf_layout_places_is_what_the_walk_finds(
    example: tuple[bytes, list[Any]], data: st.DataObject
) -> None:
    descriptor_set, messages = example
    rows = [message.SerializeToString() for message in messages]
    if not rows:
        return
    tree, payloads = parse_descriptor_set(descriptor_set, "any.Root"), Ragged.from_bytes(rows)
    columns, _ = protobuf.decode_rows(tree, payloads)
    payload = np.frombuffer(data.draw(st.sampled_from(rows)), np.uint8)
    for path, column in columns.items():
        pattern = protobuf.find_layout(tree, payload, [path])
        if pattern is not None:
            assert pattern.fits(pattern.rows(payload, np.zeros(1, int))).all()
            agrees(pattern, payloads, columns, same_or_nan)
        else:  # repeated, or beside text that only Google's decoder can judge
            assert isinstance(column, Ragged) or not payload.tobytes().isascii()


def records(payloads: list[bytes]) -> Contents:
    """Message records of one channel, one behind the other."""
    heads = np.zeros(len(payloads), MESSAGE_HEAD)
    heads["opcode"], heads["channel"] = MESSAGE, 1
    heads["length"] = [MESSAGE_FIELDS + len(payload) for payload in payloads]
    heads["log_time"] = np.arange(len(payloads))
    rows = [head.tobytes() + payload for head, payload in zip(heads, payloads, strict=True)]
    begins = np.cumsum([0, *map(len, rows)])[:-1]
    return Contents.from_begins(np.frombuffer(b"".join(rows), np.uint8), begins)


def gathered(channel: Channel, fields: list[str], *stretches: list[bytes]) -> Messages:
    """What is gathered of one channel out of some stretches of a file."""
    mine = ChannelAccumulator(field_decoder(channel, fields), 0, 0)
    for stretch in stretches:
        found = records(stretch)
        for _, rows in found.messages:
            mine.add(found.content, rows)
    mine.decode()
    messages = mine.messages(channel)
    assert messages is not None
    return messages


@settings(max_examples=100, deadline=None)
@given(examples(), st.data())
def test_any_order_of_any_cdr_layouts_is_gathered_as_it_is_decoded(
    example: Example, data: st.DataObject
) -> None:
    rows = serialized(example, True) + serialized(example, False)
    channel = Channel(1, "/any", "cdr", ROOT, "ros2msg", example.text.encode())
    gathers_like_it_decodes(channel, parse_ros2msg(example.text, ROOT), rows, data, same)


@settings(max_examples=100, deadline=None)
@given(proto_examples(), st.data())
def test_any_order_of_any_protobuf_layouts_is_gathered_as_it_is_decoded(
    example: tuple[bytes, list[Any]], data: st.DataObject
) -> None:
    descriptor_set, messages = example
    channel = Channel(1, "/any", "protobuf", "any.Root", "protobuf", descriptor_set)
    rows = [message.SerializeToString() for message in messages]
    tree = parse_descriptor_set(descriptor_set, "any.Root")
    gathers_like_it_decodes(channel, tree, rows, data, same_or_nan)


def gathers_like_it_decodes(
    channel: Channel, tree: Any, rows: list[bytes], data: st.DataObject, equal: Any
) -> None:
    """Assert that messages in any order, some cut, come out as one decoding of them all."""
    if not rows:
        return
    fields = data.draw(st.lists(st.sampled_from([path for path, _ in leaves(tree)]), min_size=1))
    drawn = data.draw(st.lists(st.sampled_from(rows), min_size=1, max_size=12))
    if data.draw(st.booleans()):
        place = data.draw(st.integers(0, len(drawn) - 1))
        drawn[place] = drawn[place][: data.draw(st.integers(0, len(drawn[place])))]
    at = data.draw(st.integers(0, len(drawn)))
    messages = gathered(channel, fields, drawn[:at], drawn[at:])
    columns, kept = decode_payloads(channel, Ragged.from_bytes(drawn), fields)
    assert messages.problem is None
    assert messages.lost == np.count_nonzero(~kept)
    assert messages.log_time_ns.tolist() == [
        *np.flatnonzero(kept[:at]).tolist(),
        *np.flatnonzero(kept[at:]).tolist(),
    ]
    if kept.any():
        assert all(equal(messages.columns[name], columns[name]) for name in columns)


def imus(n: int, frame: str) -> list[bytes]:
    stamps = np.arange(n) * 10**8
    columns = {"header.stamp": stamps, "header.frame_id": frame, "orientation.w": np.arange(n)}
    return encode(IMU, columns, n).row_bytes()


def test_messages_of_one_layout_are_never_walked_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    walked = []
    whole = cdr.decode_rows
    monkeypatch.setattr(cdr, "decode_rows", lambda *given: walked.append(given) or whole(*given))
    stretches = [imus(5, "imu"), imus(4, "imu")]
    fields = ["header.stamp", "orientation.w"]
    messages = gathered(IMU_CHANNEL, fields, *stretches)
    assert np.asarray(messages.columns["orientation.w"]).tolist() == [0, 1, 2, 3, 4, 0, 1, 2, 3]
    assert walked == []
    monkeypatch.undo()
    stretches += [imus(2, "imt"), imus(1, "imv") + imus(1, "imw")]  # as long, but not the same
    messages = gathered(IMU_CHANNEL, ["header.frame_id"], *stretches)
    told = ["imu"] * 9 + ["imt", "imt", "imv", "imw"]
    assert np.asarray(messages.columns["header.frame_id"]).tolist() == told


def test_more_layouts_than_are_remembered_are_read_all_the_same() -> None:
    frames = ["x" * (k % 23) for k in range(60)]
    rows = [imus(1, frame)[0] for frame in frames]
    mine = ChannelAccumulator(field_decoder(IMU_CHANNEL, ["header.stamp", "orientation.w"]), 0, 0)
    found = records(rows)
    for _, part in found.messages:
        mine.add(found.content, part)
    assert 1 < len(mine.layouts) < 23
    assert np.asarray(mine.builder.columns()["orientation.w"]).tolist() == [0.0] * 60


@pytest.mark.parametrize("width", range(1, 12))
def test_every_byte_of_a_mark_counts_wherever_it_lies(width: int) -> None:
    marks = [(k, 0xF0 if k % 3 else 0xFF, 0xA0 + k) for k in range(width) if k % 5 != 3]
    pattern = WireLayout(width, marks, {"all": FieldSlice(0, width, lambda raw: raw)})
    good = np.zeros((1, width), np.uint8)
    for at, _, value in marks:
        good[0, at] = value
    assert pattern.fits_all(good)
    told = {at: bits for at, bits, _ in marks}
    for at in range(width):
        for bit in range(8):
            bent = good.copy()
            bent[0, at] ^= 1 << bit
            assert pattern.fits_all(bent) == (not told.get(at, 0) >> bit & 1)


EDITS = st.lists(
    st.tuples(
        st.sampled_from(["flip", "insert", "drop"]), st.integers(0, 99), st.binary(max_size=2)
    ),
    max_size=2,
)
#: A tag of field 0, one of more bytes than it needs, one that is too long; a varint that is.
REFUSED = (b"\x00\x01", b"\x88\x80\x80\x80\x80\x00\x01", b"\x08" + b"\xff" * 10 + b"\x01", b"\x0c")


def edited(row: bytes, edits: list[tuple[str, int, bytes]]) -> bytes:
    for kind, place, noise in edits:
        at = place % (len(row) + 1)
        if kind == "flip" and at < len(row):
            row = row[:at] + bytes([row[at] ^ (1 << place % 8)]) + row[at + 1 :]
        elif kind == "insert":
            row = row[:at] + noise + row[at:]
        else:
            row = row[:at] + row[at + len(noise) :]
    return row


@settings(max_examples=300, deadline=None)
@given(proto_examples(), st.data())
def test_protobuf_messages_are_refused_as_googles_decoder_refuses_them(
    example: tuple[bytes, list[Any]], data: st.DataObject
) -> None:
    descriptor_set, messages = example
    if not messages:
        return
    tree = parse_descriptor_set(descriptor_set, "any.Root")
    sound = [message.SerializeToString() for message in messages]
    rows = list(sound)
    for row in sound:  # most have the layout of a message before
        rows.append(edited(row, data.draw(EDITS)))
        rows.append(row + data.draw(st.sampled_from(REFUSED)))
    readable = []
    for row in rows:
        try:
            tree.decoder.FromString(row)
            readable.append(True)
        except Exception:  # the official decoder has its own error
            readable.append(False)
    channel = Channel(1, "/any", "protobuf", "any.Root", "protobuf", descriptor_set)
    fields = data.draw(st.lists(st.sampled_from([path for path, _ in leaves(tree)]), min_size=1))
    found = gathered(channel, fields, rows)
    assert found.log_time_ns.tolist() == np.flatnonzero(readable).tolist()


@pytest.mark.parametrize("refused", REFUSED[:1] + REFUSED[2:])
def test_what_google_refuses_of_a_message_is_refused(refused: bytes) -> None:
    file = descriptor_pb2.FileDescriptorProto(name="a.proto", package="a", syntax="proto3")
    message = file.message_type.add(name="B")
    message.field.add(name="x", number=1, type=13, label=1)
    definition = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    channel = Channel(1, "/any", "protobuf", "a.B", "protobuf", definition)
    found = gathered(channel, ["x"], [b"\x08\x05", refused, b"\x08\x06" + refused, b"\x08\x07"])
    assert found.lost == 2
    assert np.asarray(found.columns["x"]).tolist() == [5, 7]
