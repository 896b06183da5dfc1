# SPDX-License-Identifier: Apache-2.0
"""A channel's payloads to columns, whatever their encoding."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats import cdr, json, protobuf
from abyssnav.formats.columns import Column, Ragged, WireLayout, gather_fixed, pick_item
from abyssnav.formats.mcap.accumulator import ChannelDecoder, Decoded
from abyssnav.formats.mcap.chunks import MAX_CHUNK_BYTES
from abyssnav.formats.mcap.container import MAX_ZSTD_WINDOW, ZSTD_MAGIC
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.schema import (
    Definition,
    message_definition,
    parse_ros1msg,
    parse_ros2idl,
    parse_ros2msg,
)

_NO_DEFINITION = (LookupError, ValueError, TypeError, OverflowError, RecursionError, StopIteration)
_MOST_UNSTATED = 1 << 24  #: bytes of a packed message that does not state its size
_HEADER = "MSG: std_msgs/Header\n"
_INDEX = re.compile(r"\[(\d+)\]")


@dataclass(frozen=True)
class Encoding:
    """What an encoding of messages needs to become columns."""

    #: Definition (bytes) and type name to a field tree, by the schema's encoding.
    parsers: dict[str, Callable[[bytes, str], Definition]]
    decode_rows: Callable[..., Decoded]
    find_layout: Callable[..., WireLayout | None]


def _text(parse: Callable[[str, str], Definition]) -> Callable[[bytes, str], Definition]:
    def parse_text(definition: bytes, type_name: str) -> Definition:
        text = definition.decode("utf-8", "replace")
        if not text.strip() and (ours := _shipped_definition(type_name)):
            is_ros1 = parse is parse_ros1msg  # whose header has one field more
            return (
                parse(ours.replace(_HEADER, f"{_HEADER}uint32 seq\n"), type_name)
                if is_ros1
                else (parse_ros2msg(ours, type_name))
            )
        return parse(text, type_name)

    return parse_text


@cache
def _shipped_definition(type_name: str) -> str:
    """Our definition of a type that a recorder left empty; none where we have none."""
    try:
        return message_definition(type_name)
    except (ValueError, ReadError):
        return ""


def _json_rows(_: Definition, payloads: Ragged, fields: Sequence[str]) -> Decoded:
    return json.decode_rows(payloads, fields)


_ROS2 = {"ros2msg": _text(parse_ros2msg), "ros2idl": _text(parse_ros2idl)}
_ROS1 = {"ros1msg": _text(parse_ros1msg)}
ENCODINGS: Final = {
    "cdr": Encoding(_ROS2, cdr.decode_rows, cdr.find_layout),
    "ros1": Encoding(
        _ROS1,
        partial(cdr.decode_rows, rules=cdr.ROS1),
        partial(cdr.find_layout, rules=cdr.ROS1),
    ),
    "protobuf": Encoding(
        {"protobuf": protobuf.parse_descriptor_set}, protobuf.decode_rows, protobuf.find_layout
    ),
    "json": Encoding({}, _json_rows, lambda *_: None),
}


def field_decoder(channel: Channel, fields: Sequence[str]) -> ChannelDecoder:
    """What `read_mcap` needs to know to turn a channel's messages into columns of `fields`.

    A field may hold indexes `[k]` that pick from arrays: one at its end from the innermost array,
    another from the outermost; NaN where an array is shorter.  Reading or decoding raises
    `ReadError` on an encoding that is not read, a definition that cannot be, or a field that it
    does not have.
    """

    def decode(payloads: Ragged) -> Decoded:
        return decode_payloads(channel, payloads, fields)

    def layout(payload: NDArray[np.uint8]) -> WireLayout | None:
        return find_layout(channel, payload, fields)

    return ChannelDecoder(decode, layout)


def find_layout(
    channel: Channel, payload: NDArray[np.uint8], fields: Sequence[str]
) -> WireLayout | None:
    """Layout of payloads like this one; None where a field has no fixed place."""
    encoding, definition = _encoding_of(channel)
    if channel.message_encoding == "cdr" and is_packed(payload):
        return None
    layout = encoding.find_layout(definition, payload, _without_indexes(fields))
    if layout is None:
        return None
    slices = {}
    for path in fields:
        if (bare := _INDEX.sub("", path)) not in layout.slices:
            raise _no_column(bare)
        whole = layout.slices[bare]
        slices[path] = whole if path == bare else whole.then(partial(_pick_items, path=path))
    return replace(layout, slices=slices)


def decode_payloads(channel: Channel, payloads: Ragged, fields: Sequence[str]) -> Decoded:
    """Columns of `fields` of all payloads that fit, and which those are."""
    encoding, definition = _encoding_of(channel)
    if channel.message_encoding == "cdr":
        payloads = unpack_messages(payloads)
    columns, kept = encoding.decode_rows(definition, payloads, _without_indexes(fields))
    for path in _without_indexes(fields):
        if path not in columns:
            raise _no_column(path)
    return {path: _pick_items(columns[_INDEX.sub("", path)], path) for path in fields}, kept


def is_packed(payload: NDArray[np.uint8]) -> bool:
    """Whether a message of CDR was packed by rosbag2's message compression.

    Nothing in the file says so.  But a payload of plain CDR begins with 0, and whatever begins with
    the magic of zstd is none.
    """
    return payload[: len(ZSTD_MAGIC)].tobytes() == ZSTD_MAGIC


def unpack_messages(payloads: Ragged) -> Ragged:
    """CDR payloads, those that rosbag2 packed one by one unpacked; one that is damaged is empty.

    Together they never take more than a chunk may: what is beyond it is empty too.
    """
    content, begins = np.asarray(payloads.content), payloads.offsets[:-1]
    candidates = np.flatnonzero(payloads.lengths > len(ZSTD_MAGIC))
    magic = np.frombuffer(ZSTD_MAGIC, np.uint8)
    packed = (gather_fixed(content, begins[candidates], len(magic)) == magic).all(axis=1)
    if not packed.any():
        return payloads
    import zstandard

    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_ZSTD_WINDOW)
    rows, room = payloads.row_bytes(), MAX_CHUNK_BYTES
    for row in candidates[packed].tolist():
        whole = _unpack_message(decompressor, rows[row], room)
        rows[row], room = whole, room - len(whole)
    return Ragged.from_bytes(rows)


def _unpack_message(decompressor: Any, packed: bytes, room: int) -> bytes:
    """One unpacked message; none where it is damaged or larger than `room`."""
    import zstandard

    try:
        size = zstandard.frame_content_size(packed)
        most = min(size if size >= 0 else _MOST_UNSTATED, room)
        with decompressor.stream_reader(packed) as stream:
            whole: bytes = stream.read(most + 1)
    except zstandard.ZstdError:
        return b""
    return whole if len(whole) <= most and size in (len(whole), -1) else b""


def _no_column(path: str) -> ReadError:
    return ReadError(f"{path} is a message, or asked for in whole and in part")


def _without_indexes(fields: Sequence[str]) -> list[str]:
    """Return each field once."""
    return list(dict.fromkeys(_INDEX.sub("", path) for path in fields))


def _pick_items(column: Column, path: str) -> Column:
    for match in _INDEX.finditer(path):
        try:
            column = pick_item(column, int(match[1]), innermost=match.end() == len(path))
        except IndexError:
            raise ReadError(f"no field {path!r}: the array is shorter in every message") from None
        except TypeError:
            raise ReadError(f"no field {path!r}: it is no array") from None
    return column


def definition_of(channel: Channel) -> Definition:
    """Field tree of a channel with a schema; one that is empty, of a type we ship, is ours.

    Raises
    ------
    ReadError
        An encoding that is not read, or a definition that cannot be.
    """
    encoding = ENCODINGS.get(channel.message_encoding)
    parse = encoding and encoding.parsers.get(channel.schema_encoding)
    if not parse:
        raise ReadError(
            f"messages are {channel.message_encoding!r} with a schema in "
            f"{channel.schema_encoding!r}; cdr with ros2msg or ros2idl, ros1 with ros1msg, "
            "protobuf with protobuf, and json are read"
        )
    try:
        return parse(channel.definition, channel.type)
    except _NO_DEFINITION as error:  # what a stranger wrote, or damage made of it, can be anything
        detail = f"{type(error).__name__}: {error}"
        raise ReadError(f"the definition of {channel.type} cannot be read: {detail}") from None


def _encoding_of(channel: Channel) -> tuple[Encoding, Any]:
    """Encoding and definition; JSON needs none, as its messages name their fields."""
    is_json = channel.message_encoding == "json"
    definition = None if is_json else definition_of(channel)
    return ENCODINGS[channel.message_encoding], definition
