# SPDX-License-Identifier: Apache-2.0
"""The layout of Protobuf messages like one: its tags, lengths and how long its varints are.

A log's messages differ in numbers more than in layout: a stamp's nanoseconds take four or five
bytes, a number that is exactly zero is left out.  A few layouts hold nearly all of a topic.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.formats.definitions import SEQUENCE, Definition, wanted
from abyssnav.formats.descriptors import (
    BYTES,
    FIXED32,
    FIXED64,
    MESSAGE,
    TYPES,
    VARINT,
    ProtoField,
)
from abyssnav.formats.patterns import Mark, Pattern, Place, alike_texts
from abyssnav.formats.protobuf import TIMES, decode_rows, typed
from abyssnav.formats.ragged import Column, Ragged
from abyssnav.tables import Int

_WIDTHS = {FIXED64: 8, FIXED32: 4}
_MORE = 0x80  #: bit of a varint's byte that has another behind it
_MOST_MARKS = 400


def pattern(tree: Definition, payload: NDArray[np.uint8], fields: Sequence[str]) -> Pattern | None:
    """Layout of messages like `payload`; None when it does not fit, or when a field has no place.

    What is repeated has none, but for packed numbers of a fixed width.  What `payload`
    lacks, all messages of its layout lack: they have the same value in its place.

    Raises
    ------
    ReadError
        A field that the definition does not have.
    """
    columns, kept = decode_rows(tree, Ragged.regular(payload[None, :]), fields)
    walk = _Walk(payload.tobytes(), tree)
    try:
        walk.message(tree.root, wanted(tree, fields), 0, len(payload), "")
    except _NoPatternError:
        return None
    if not kept.all() or len(walk.marks) > _MOST_MARKS:
        return None
    places = {
        name: walk.places.get(name) or Place(0, 0, partial(_repeated, column))
        for name, column in columns.items()
    }
    return Pattern(len(payload), walk.marks, places, whole=True)


class _NoPatternError(Exception):
    """A field that is there, wanted, and has no fixed place."""


@dataclass
class _Walk:
    """One pass over a message."""

    bytes: bytes
    tree: Definition
    marks: list[Mark] = field(default_factory=list)
    places: dict[str, Place] = field(default_factory=dict)

    def message(self, kind: str, want: Any, at: int, end: int, prefix: str) -> None:
        """Walk over the message in bytes `at` to `end`; all of it is wanted where `want` is {}."""
        known = [member for member in self.tree.types[kind] if isinstance(member, ProtoField)]
        members = {m.number: m for m in known if not want or m.name in want}
        seen: set[int] = set()
        while at < end:
            tag, at = self._varint(at, end, 0xFF)
            member, wire = members.get(tag >> 3), tag & 7
            begin, at = self._value(wire, at, end)
            if member is None:
                continue
            if member.number in seen:
                raise _NoPatternError
            seen.add(member.number)
            inside = want.get(member.name, {}) if want else {}
            self._field(member, wire, inside, begin, at, f"{prefix}{member.name}")

    def _varint(self, at: int, end: int, bits: int) -> tuple[int, int]:
        """Value of a varint and where it ends; `bits` of its bytes are the layout's."""
        value = shift = 0
        while at < end and shift < 70:
            byte = self.bytes[at]
            self.marks.append((at, bits, byte & bits))
            value |= (byte & 0x7F) << shift
            at, shift = at + 1, shift + 7
            if not byte & _MORE:
                return value, at
        raise _NoPatternError

    def _value(self, wire: int, at: int, end: int) -> tuple[int, int]:
        """Begin and end of a value."""
        if wire == VARINT:
            return at, self._varint(at, end, _MORE)[1]
        length = _WIDTHS.get(wire, end)
        if wire == BYTES:
            length, at = self._varint(at, end, 0xFF)
        if length > end - at or (wire not in _WIDTHS and wire != BYTES):
            raise _NoPatternError
        return at, at + length

    def _field(
        self, member: ProtoField, wire: int, want: Any, begin: int, end: int, path: str
    ) -> None:
        if member.kind == MESSAGE and wire == BYTES and member.count != SEQUENCE:
            if member.type in TIMES and not want:
                self._time(member.type, begin, end, path)
            else:
                self.message(member.type, want, begin, end, f"{path}.")
            return
        _, dtype, own = TYPES.get(member.kind, ("", "", BYTES))
        packed = wire == BYTES and own in _WIDTHS
        if member.count == SEQUENCE and not packed:
            raise _NoPatternError
        if member.count == SEQUENCE:
            if (end - begin) % _WIDTHS[own]:
                raise _NoPatternError
            self.places[path] = Place(begin, end - begin, partial(_packed, np.dtype(f"<{dtype}")))
        elif wire == own == BYTES:
            read = _bytes if member.type == "bytes" else alike_texts
            self.places[path] = Place(begin, end - begin, read)
        elif wire == own:
            self.places[path] = Place(begin, end - begin, partial(_number, member.kind, dtype))

    def _time(self, kind: str, begin: int, end: int, path: str) -> None:
        """Walk over a time, a message of two numbers of which each may be missing."""
        inner = _Walk(self.bytes, self.tree, self.marks)
        inner.message(kind, {}, begin, end, "")
        parts = {
            name: Place(place.at - begin, place.width, place.read)
            for name, place in inner.places.items()
        }
        self.places[path] = Place(begin, end - begin, partial(_nanoseconds, parts))


def _number(kind: int, dtype: str, raw: NDArray[np.uint8]) -> NDArray[Any]:
    """Numbers (n,) in bytes (n, width), fixed or varints of one length."""
    if TYPES[kind][2] in _WIDTHS:
        return raw.view(f"<{dtype}")[:, 0]
    value = np.zeros(len(raw), np.uint64)
    for place in range(raw.shape[1]):
        value |= (raw[:, place] & 0x7F).astype(np.uint64) << np.uint64(7 * place)
    return typed(value, kind, dtype)


def _bytes(raw: NDArray[np.uint8]) -> Ragged:
    return Ragged.regular(raw.copy())


def _packed(dtype: np.dtype[Any], raw: NDArray[np.uint8]) -> Ragged:
    count = raw.shape[1] // dtype.itemsize
    values = np.ascontiguousarray(raw).view(dtype) if count else np.zeros((len(raw), 0), dtype)
    return Ragged.regular(values)


def _nanoseconds(parts: dict[str, Place], raw: NDArray[np.uint8]) -> Int:
    seconds, nanos = (
        np.asarray(part.read(raw[:, part.at : part.at + part.width]), np.int64)
        if (part := parts.get(name))
        else np.zeros(len(raw), np.int64)
        for name in ("seconds", "nanos")
    )
    return np.asarray(seconds * 1_000_000_000 + nanos)


def _repeated(one: Column, raw: NDArray[np.uint8]) -> Column:
    """The value of one message for all: a number, text, or an array without items."""
    if isinstance(one, Ragged):
        return Ragged(one.content, np.zeros(len(raw) + 1, np.int64))
    return np.repeat(one, len(raw))
