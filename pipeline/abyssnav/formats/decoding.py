# SPDX-License-Identifier: Apache-2.0
"""A channel's payloads to columns, whatever their encoding."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats import cdr, json_rows, protobuf, protobuf_pattern
from abyssnav.formats.definitions import Definition, parse_ros2msg
from abyssnav.formats.descriptors import parse_descriptor_set
from abyssnav.formats.gathering import Take
from abyssnav.formats.idl import parse_ros2idl
from abyssnav.formats.mcap.layout import Channel
from abyssnav.formats.patterns import Pattern
from abyssnav.formats.ragged import Column, Ragged, pick
from abyssnav.tables import Bool

_NO_DEFINITION = (LookupError, ValueError, TypeError, OverflowError, RecursionError, StopIteration)
_INDEX = re.compile(r"\[(\d+)\]")


def take_fields(channel: Channel, fields: Sequence[str]) -> Take:
    """What `read_mcap` needs to know to turn a channel's messages into columns of `fields`.

    A field may hold indexes `[k]` that pick from arrays: one at its end from the innermost array,
    another from the outermost; NaN where an array is shorter.  Reading or decoding raises
    `ReadError` on an encoding that is not read, a definition that cannot be, or a field that it
    does not have.
    """

    def decode(payloads: Ragged) -> tuple[dict[str, Column], Bool]:
        return decode_payloads(channel, payloads, fields)

    def pattern(payload: NDArray[np.uint8]) -> Pattern | None:
        return pattern_of(channel, payload, fields)

    return Take(decode, pattern)


def pattern_of(
    channel: Channel, payload: NDArray[np.uint8], fields: Sequence[str]
) -> Pattern | None:
    """Layout of payloads like this one; None where a field has no fixed place."""
    if channel.message_encoding == "json":
        return None
    of = cdr.pattern if channel.message_encoding == "cdr" else protobuf_pattern.pattern
    pattern = of(definition_of(channel), payload, _bare(fields))
    if pattern is None:
        return None
    places = {}
    for path in fields:
        if (bare := _INDEX.sub("", path)) not in pattern.places:
            raise _no_column(bare)
        whole = pattern.places[bare]
        places[path] = whole if path == bare else whole.then(partial(_picked, path=path))
    return replace(pattern, places=places)


def decode_payloads(
    channel: Channel, payloads: Ragged, fields: Sequence[str]
) -> tuple[dict[str, Column], Bool]:
    """Columns of `fields` of all payloads that fit, and which those are."""
    bare = _bare(fields)
    if channel.message_encoding == "json":
        columns, kept = json_rows.decode_rows(payloads, bare)
    elif channel.message_encoding == "cdr":
        columns, kept = cdr.decode_rows(definition_of(channel), payloads, bare)
    else:
        columns, kept = protobuf.decode_rows(definition_of(channel), payloads, bare)
    for path in _bare(fields):
        if path not in columns:
            raise _no_column(path)
    return {path: _picked(columns[_INDEX.sub("", path)], path) for path in fields}, kept


def _no_column(path: str) -> ReadError:
    return ReadError(f"{path} is a message, or asked for in whole and in part")


def _bare(fields: Sequence[str]) -> list[str]:
    """Return fields without indexes, each once."""
    return list(dict.fromkeys(_INDEX.sub("", path) for path in fields))


def _picked(column: Column, path: str) -> Column:
    for match in _INDEX.finditer(path):
        try:
            column = pick(column, int(match[1]), innermost=match.end() == len(path))
        except IndexError:
            raise ReadError(f"no field {path!r}: the array is shorter in every message") from None
        except TypeError:
            raise ReadError(f"no field {path!r}: it is no array") from None
    return column


def definition_of(channel: Channel) -> Definition:
    """Field tree of a channel with a schema.

    Raises
    ------
    ReadError
        An encoding that is not read, or a definition that cannot be.
    """
    try:
        return _parsed(channel)
    except _NO_DEFINITION as error:  # what a stranger wrote, or damage made of it, can be anything
        told = f"{type(error).__name__}: {error}"
        raise ReadError(f"the definition of {channel.type} cannot be read: {told}") from None


def _parsed(channel: Channel) -> Definition:
    text = channel.definition.decode("utf-8", "replace")
    match channel.message_encoding, channel.schema_encoding:
        case "cdr", "ros2msg":
            return parse_ros2msg(text, channel.type)
        case "cdr", "ros2idl":
            return parse_ros2idl(text, channel.type)
        case "protobuf", "protobuf":
            return parse_descriptor_set(channel.definition, channel.type)
    raise ReadError(
        f"messages are {channel.message_encoding!r} with a schema in {channel.schema_encoding!r}; "
        "cdr with ros2msg or ros2idl, protobuf with protobuf, and json are read"
    )
