# SPDX-License-Identifier: Apache-2.0
"""Protobuf schemas: a serialized FileDescriptorSet to the fields of its messages.

Only what decoding needs is read.  Field numbers are those of `google/protobuf/descriptor.proto`.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from abyssnav.errors import ReadError
from abyssnav.formats.definitions import SEQUENCE, Definition, Field

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  #: wire types that are read
#: Field type -> (its name with us, NumPy type of its column or '', wire type).
TYPES = {
    1: ("float64", "f8", FIXED64), 2: ("float32", "f4", FIXED32), 3: ("int64", "i8", VARINT),
    4: ("uint64", "u8", VARINT), 5: ("int32", "i4", VARINT), 6: ("uint64", "u8", FIXED64),
    7: ("uint32", "u4", FIXED32), 8: ("bool", "?", VARINT), 9: ("string", "", BYTES),
    12: ("bytes", "", BYTES), 13: ("uint32", "u4", VARINT), 14: ("int32", "i4", VARINT),
    15: ("int32", "i4", FIXED32), 16: ("int64", "i8", FIXED64), 17: ("int32", "i4", VARINT),
    18: ("int64", "i8", VARINT),
}  # fmt: skip
MESSAGE, ZIGZAG = 11, (17, 18)


@dataclass(frozen=True)
class ProtoField(Field):
    """A field of a Protobuf message."""

    number: int = 0
    kind: int = 0  #: type by number, as in the descriptor
    has_presence: bool = False  #: not being there is told from being zero


@cache
def parse_descriptor_set(data: bytes, type_name: str) -> Definition:
    """Fields of `type_name` and of all messages in it.

    Raises
    ------
    ReadError
        The descriptor set cannot be read, or lacks a type.
    """
    types: dict[str, tuple[Field, ...]] = {}
    try:
        for number, value in _fields(data):
            if number == 1:
                _file(_raw(value), types)
    except (struct.error, LookupError, ValueError, TypeError, StopIteration):
        raise ReadError(f"the descriptor set of {type_name} cannot be read") from None
    root = type_name.lstrip(".")
    if root not in types:
        known = ", ".join(sorted(types)[:8]) or "none"
        raise ReadError(f"the descriptor set has no message {type_name}; it has: {known}")
    return Definition(root, types)


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Number and value of each field of a serialized message."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        wire = tag & 7
        if wire == VARINT:
            value, at = _varint(data, at)
            yield tag >> 3, value
        elif wire == BYTES:
            length, at = _varint(data, at)
            if at + length > len(data):
                raise IndexError
            yield tag >> 3, data[at : at + length]
            at += length
        elif wire in (FIXED64, FIXED32):
            at += 8 if wire == FIXED64 else 4
        else:
            raise IndexError


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
        if shift > 63:
            raise IndexError


def _raw(value: int | bytes) -> bytes:
    if isinstance(value, int):
        raise TypeError
    return value


def _file(data: bytes, types: dict[str, tuple[Field, ...]]) -> None:
    found = list(_fields(data))
    package = next((_raw(v).decode() for n, v in found if n == 2), "")
    syntax = next((_raw(v).decode() for n, v in found if n == 12), "proto2")
    for number, value in found:
        if number == 4:
            _message(_raw(value), package, syntax == "proto3", types)


def _message(data: bytes, above: str, implicit: bool, types: dict[str, tuple[Field, ...]]) -> None:
    found = list(_fields(data))
    own = next(_raw(v).decode() for n, v in found if n == 1)
    name = f"{above}.{own}" if above else own
    types[name] = tuple(_field(_raw(v), implicit) for n, v in found if n == 2)
    for number, value in found:
        if number == 3:
            _message(_raw(value), name, implicit, types)


def _field(data: bytes, implicit: bool) -> ProtoField:
    found = dict(_fields(data))
    name, kind = _raw(found[1]).decode(), int(found.get(5, 0))
    repeated = found.get(4) == 3
    if kind == MESSAGE:
        type_name = _raw(found[6]).decode().lstrip(".")
    elif kind in TYPES:
        type_name = TYPES[kind][0]
    else:
        type_name = f"group {name}"
    presence = not repeated and (kind == MESSAGE or 9 in found or not implicit)
    count = SEQUENCE if repeated else None
    return ProtoField(name, type_name, count, int(found[3]), kind, presence)
