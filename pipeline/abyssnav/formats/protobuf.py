# SPDX-License-Identifier: Apache-2.0
"""Protobuf: descriptor sets to field trees, and a topic's payloads to columns.

A log's messages differ in numbers more than in layout: a stamp's nanoseconds take four or five
bytes, a number that is exactly zero is left out.  A few wire layouts hold nearly all of a topic;
what fits none of them goes through Google's own decoder, one message after the other.

A number that is not there is zero where the schema gives it no presence, else NaN (integers: 0), as
are those of a message that is not there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import chain
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.columns import (
    MAX_MASKS,
    ByteMask,
    Column,
    FieldSlice,
    Ragged,
    WireLayout,
    decode_equal_length_texts,
    row_offsets,
)
from abyssnav.formats.schema import MAX_DEPTH, SEQUENCE, Definition, Field, wanted
from abyssnav.tables import Bool, Int

#: One int64 nanosecond column to us.
TIMES: Final = ("google.protobuf.Timestamp", "google.protobuf.Duration")
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  #: wire types that a layout can have
#: Field type of the descriptor -> (its name with us, NumPy type of its column or '', wire type).
_SCALARS: Final = {
    1: ("float64", "f8", _FIXED64), 2: ("float32", "f4", _FIXED32), 3: ("int64", "i8", _VARINT),
    4: ("uint64", "u8", _VARINT), 5: ("int32", "i4", _VARINT), 6: ("uint64", "u8", _FIXED64),
    7: ("uint32", "u4", _FIXED32), 8: ("bool", "?", _VARINT), 9: ("string", "", _BYTES),
    12: ("bytes", "", _BYTES), 13: ("uint32", "u4", _VARINT), 14: ("int32", "i4", _VARINT),
    15: ("int32", "i4", _FIXED32), 16: ("int64", "i8", _FIXED64), 17: ("int32", "i4", _VARINT),
    18: ("int64", "i8", _VARINT),
}  # fmt: skip
_MESSAGE, _ZIGZAG, _REPEATED = 11, (17, 18), 3
_WIDTHS: Final = {_FIXED64: 8, _FIXED32: 4}
_CONTINUED: Final = 0x80  #: bit of a varint's byte that has another behind it


@dataclass(frozen=True)
class ProtoField(Field):
    """A field of a Protobuf message."""

    number: int = 0
    kind: int = 0  #: type by number, as in the descriptor
    has_presence: bool = False  #: whether absence can be told from zero


@dataclass(frozen=True)
class ProtoDefinition(Definition):
    """A message type, and Google's class that decodes it."""

    decoder: Any = None

    def members(self, kind: str) -> list[ProtoField]:
        """Return the fields of one of its types."""
        return [member for member in self.types[kind] if isinstance(member, ProtoField)]


@cache
def parse_descriptor_set(data: bytes, type_name: str) -> ProtoDefinition:
    """Fields of `type_name` and of all messages in it; Timestamp and Duration may be left out.

    Raises
    ------
    ReadError
        The descriptor set cannot be read, or lacks a type.
    """
    from google.protobuf import descriptor_pb2, message_factory
    from google.protobuf.message import DecodeError as ProtobufError

    root = type_name.lstrip(".")
    types: dict[str, tuple[Field, ...]] = {}
    try:
        files = {f.name: f for f in descriptor_pb2.FileDescriptorSet.FromString(data).file}
        files = _well_known_files() | files
        for file in files.values():
            for message in file.message_type:
                _add_message(message, file.package, file.syntax == "proto3", types)
        if root in types:
            descriptor = _pool(files).FindMessageTypeByName(root)
            return ProtoDefinition(root, types, message_factory.GetMessageClass(descriptor))
    except (ProtobufError, TypeError, ValueError, LookupError, RecursionError) as error:
        detail = f"{error}".partition("\n")[0]
        raise ReadError(f"the descriptor set of {type_name} cannot be read: {detail}") from None
    known = ", ".join(sorted(types.keys() - TIMES)[:8]) or "none"
    raise ReadError(f"the descriptor set has no message {type_name}; it has: {known}")


def _well_known_files() -> dict[str, Any]:
    from google.protobuf import descriptor_pb2, duration_pb2, timestamp_pb2

    files = {}
    for module in (timestamp_pb2, duration_pb2):
        file = descriptor_pb2.FileDescriptorProto.FromString(module.DESCRIPTOR.serialized_pb)
        files[file.name] = file
    return files


def _pool(files: Mapping[str, Any]) -> Any:
    """All files in one pool, each behind those that it imports; imports that lack are ignored."""
    from google.protobuf import descriptor_pool

    pool, added = descriptor_pool.DescriptorPool(), set[str]()

    def add(name: str) -> None:
        added.add(name)
        file = files[name]
        known = [dependency for dependency in file.dependency if dependency in files]
        for dependency in known:
            if dependency not in added:
                add(dependency)
        if len(known) < len(file.dependency):  # whether one of its types is needed shows now
            file.ClearField("dependency")
            file.ClearField("public_dependency")
            file.ClearField("weak_dependency")
            file.dependency.extend(known)
        pool.AddSerializedFile(file.SerializeToString())

    for name in files:
        if name not in added:
            add(name)
    return pool


def _add_message(
    message: Any, above: str, implicit: bool, types: dict[str, tuple[Field, ...]]
) -> None:
    name = f"{above}.{message.name}" if above else message.name
    types[name] = tuple(_field(member, implicit) for member in message.field)
    for inner in message.nested_type:
        _add_message(inner, name, implicit, types)


def _field(member: Any, implicit: bool) -> ProtoField:
    type_name, is_repeated = f"group {member.name}", member.label == _REPEATED
    if member.type == _MESSAGE:
        type_name = member.type_name.lstrip(".")
    elif member.type in _SCALARS:
        type_name = _SCALARS[member.type][0]
    is_explicit = member.type == _MESSAGE or member.HasField("oneof_index") or not implicit
    count = SEQUENCE if is_repeated else None
    presence = is_explicit and not is_repeated
    return ProtoField(member.name, type_name, count, member.number, member.type, presence)


# --- message by message ---------------------------------------------------------------------------


def decode_rows(
    tree: ProtoDefinition, payloads: Ragged, fields: Sequence[str] | None = None
) -> tuple[dict[str, Column], Bool]:
    """Columns by dotted path of all `fields`, and which payloads Google's decoder accepts.

    As `cdr.decode_rows`: repeated fields are `Ragged`, text is a string array, bytes are `Ragged`.

    Raises
    ------
    ReadError
        A field that the definition does not have.
    """
    from google.protobuf.message import DecodeError as ProtobufError

    want = wanted(tree, fields)
    decode, messages = tree.decoder.FromString, []
    kept = np.ones(len(payloads), bool)
    for row, payload in enumerate(payloads.row_bytes()):
        try:
            messages.append(decode(payload))
        except ProtobufError:
            kept[row] = False
    return _message_columns(tree, tree.root, want, messages, 0), kept


def _message_columns(
    tree: ProtoDefinition, kind: str, want: Any, messages: Sequence[Any], depth: int
) -> dict[str, Column]:
    """Columns of messages, None where there is none; all fields where `want` is {}."""
    if depth > MAX_DEPTH:
        raise ReadError(f"{tree.root}: {kind} contains itself")
    columns: dict[str, Column] = {}
    for member in tree.members(kind):
        if want and member.name not in want:
            continue
        inside = want.get(member.name, {}) if want else {}
        name = member.name
        if member.count == SEQUENCE:
            lists = [() if m is None else getattr(m, name) for m in messages]
            offsets = row_offsets(list(map(len, lists)))
            items = list(chain.from_iterable(lists))
            inner = _field_columns(tree, member, inside, items, depth)
            columns |= {path: Ragged(column, offsets) for path, column in inner.items()}
        else:
            if member.has_presence:
                values = [getattr(m, name) if m is not None and m.HasField(name) else None
                          for m in messages]  # fmt: skip
            else:
                values = [None if m is None else getattr(m, name) for m in messages]
            columns |= _field_columns(tree, member, inside, values, depth)
    return columns


def _field_columns(
    tree: ProtoDefinition, member: ProtoField, want: Any, values: list[Any], depth: int
) -> dict[str, Column]:
    """Columns of one field's values; None is what is not there."""
    name = member.name
    if member.kind == _MESSAGE and member.type in TIMES and not want:
        parts = _message_columns(tree, member.type, {}, values, depth)
        if not parts.keys() >= {"seconds", "nanos"}:
            raise ReadError(f"{tree.root}: its {member.type} is no time")
        seconds, nanos = (np.asarray(parts[part], np.int64) for part in ("seconds", "nanos"))
        return {name: seconds * 1_000_000_000 + nanos}
    if member.kind == _MESSAGE:
        columns = _message_columns(tree, member.type, want, values, depth + 1)
        return {f"{name}.{path}": column for path, column in columns.items()}
    if member.kind not in _SCALARS:
        raise ReadError(f"{tree.root}: {name} is a {member.type}, which is not read")
    _, dtype, _ = _SCALARS[member.kind]
    if member.type == "bytes":
        return {name: Ragged.from_bytes([value or b"" for value in values])}
    if member.type == "string":
        return {name: np.array([value or "" for value in values], np.dtypes.StringDType())}
    absent = np.nan if dtype.startswith("f") else 0
    return {name: np.array([absent if v is None else v for v in values], dtype)}


# --- by wire layout -------------------------------------------------------------------------------


def find_layout(
    tree: ProtoDefinition, payload: NDArray[np.uint8], fields: Sequence[str]
) -> WireLayout | None:
    """Layout of messages like `payload`; None when it does not fit, or when a field has no place.

    What is repeated has none, but for packed numbers of a fixed width.  What `payload`
    lacks, all messages of its layout lack: they have the same value in its place.  Only what
    Google's decoder accepts makes a layout, so that tags are as it wants them.

    Raises
    ------
    ReadError
        A field that the definition does not have.
    """
    columns, kept = decode_rows(tree, Ragged.regular(payload[None, :]), fields)
    if not kept.all():
        return None
    walk = _LayoutWalk(payload.tobytes(), tree)
    try:
        walk.message(tree.root, wanted(tree, fields), 0, len(payload), "")
    except _NoLayoutError:
        return None
    if len(walk.masks) > MAX_MASKS:
        return None
    slices = {
        name: walk.slices.get(name) or FieldSlice(0, 0, partial(_repeat, column))
        for name, column in columns.items()
    }
    return WireLayout(len(payload), walk.masks, slices, is_whole=True)


class _NoLayoutError(Exception):
    """A field that is there, wanted, and has no fixed place."""


@dataclass
class _LayoutWalk:
    """One pass over a message."""

    bytes: bytes
    tree: ProtoDefinition
    masks: list[ByteMask] = field(default_factory=list)
    slices: dict[str, FieldSlice] = field(default_factory=dict)

    def message(self, kind: str, want: Any, begin: int, end: int, prefix: str) -> None:
        """Walk over the message in these bytes; all of it is wanted for {}, nothing for None.

        What is not wanted is walked over too, so that what Google's decoder refuses in it has no
        layout either.
        """
        members = {member.number: member for member in self.tree.members(kind)}
        visited: set[int] = set()
        position = begin
        while position < end:
            tag, position = self._varint(position, end, 0xFF)
            member, wire = members.get(tag >> 3), tag & 7
            value, position = self._value(wire, position, end)
            if member is None:
                continue
            inside = want if not want else want.get(member.name)
            if inside is not None and member.number in visited:
                raise _NoLayoutError
            visited.add(member.number)
            self._field(member, wire, inside, (value, position), f"{prefix}{member.name}")

    def _varint(self, position: int, end: int, bits: int) -> tuple[int, int]:
        """Value of a varint and where it ends; `bits` of its bytes are the layout's."""
        value = shift = 0
        while position < end and shift < 70:
            byte = self.bytes[position]
            self.masks.append((position, bits, byte & bits))
            value |= (byte & 0x7F) << shift
            position, shift = position + 1, shift + 7
            if not byte & _CONTINUED:
                return value, position
        raise _NoLayoutError

    def _value(self, wire: int, position: int, end: int) -> tuple[int, int]:
        """Begin and end of a value."""
        if wire == _VARINT:
            return position, self._varint(position, end, _CONTINUED)[1]
        length = _WIDTHS.get(wire, end)
        if wire == _BYTES:
            length, position = self._varint(position, end, 0xFF)
        if length > end - position or (wire not in _WIDTHS and wire != _BYTES):
            raise _NoLayoutError
        return position, position + length

    def _field(
        self, member: ProtoField, wire: int, want: Any, span: tuple[int, int], path: str
    ) -> None:
        begin, end = span
        is_one = want is None or member.count != SEQUENCE
        if member.kind == _MESSAGE and wire == _BYTES and is_one:
            if member.type in TIMES and want == {}:
                self._time(member.type, begin, end, path)
            else:
                self.message(member.type, want, begin, end, f"{path}.")
            return
        _, dtype, own = _SCALARS.get(member.kind, ("", "", _BYTES))
        read: Callable[[NDArray[np.uint8]], Column]
        if member.type == "string" and wire == _BYTES:
            self._ascii(begin, end)
        if member.count == SEQUENCE and own != _BYTES and wire == _BYTES:
            if own == _VARINT and want is None:
                self._varints(begin, end)
                return
            if own == _VARINT or (end - begin) % _WIDTHS[own]:
                raise _NoLayoutError
            read = partial(_packed, np.dtype(f"<{dtype}"))
        elif member.count == SEQUENCE and want is not None:
            raise _NoLayoutError
        elif wire == own == _BYTES:
            read = _bytes if member.type == "bytes" else decode_equal_length_texts
        elif wire == own:
            read = partial(_number, member.kind, dtype)
        else:
            return
        if want is not None:
            self.slices[path] = FieldSlice(begin, end - begin, read)

    def _varints(self, position: int, end: int) -> None:
        while position < end:
            _, position = self._varint(position, end, _CONTINUED)

    def _ascii(self, begin: int, end: int) -> None:
        """Hold a text to be ASCII in all messages, as UTF-8 is more than a layout can tell."""
        if end - begin > MAX_MASKS or not self.bytes[begin:end].isascii():
            raise _NoLayoutError
        self.masks += [(position, _CONTINUED, 0) for position in range(begin, end)]

    def _time(self, kind: str, begin: int, end: int, path: str) -> None:
        """Walk over a time, a message of two numbers of which each may be missing."""
        inner = _LayoutWalk(self.bytes, self.tree, self.masks)
        inner.message(kind, {}, begin, end, "")
        parts = {
            name: FieldSlice(part.offset - begin, part.width, part.read)
            for name, part in inner.slices.items()
        }
        self.slices[path] = FieldSlice(begin, end - begin, partial(_nanoseconds, parts))


def _number(kind: int, dtype: str, raw: NDArray[np.uint8]) -> NDArray[Any]:
    """Numbers (n,) in bytes (n, width), fixed or varints of one length."""
    if _SCALARS[kind][2] in _WIDTHS:
        return raw.view(f"<{dtype}")[:, 0]
    value = np.zeros(len(raw), np.uint64)
    for place in range(raw.shape[1]):
        value |= (raw[:, place] & 0x7F).astype(np.uint64) << np.uint64(7 * place)
    if dtype == "?":
        return np.asarray(value != 0)
    if kind in _ZIGZAG:
        value = (value >> np.uint64(1)) ^ (~(value & np.uint64(1)) + np.uint64(1))
    return value.astype(f"u{np.dtype(dtype).itemsize}").view(dtype)


def _bytes(raw: NDArray[np.uint8]) -> Ragged:
    return Ragged.regular(raw.copy())


def _packed(dtype: np.dtype[Any], raw: NDArray[np.uint8]) -> Ragged:
    count = raw.shape[1] // dtype.itemsize
    values = np.ascontiguousarray(raw).view(dtype) if count else np.zeros((len(raw), 0), dtype)
    return Ragged.regular(values)


def _nanoseconds(parts: dict[str, FieldSlice], raw: NDArray[np.uint8]) -> Int:
    seconds, nanos = (
        np.asarray(part.read(part.bytes_in(raw)), np.int64)
        if (part := parts.get(name))
        else np.zeros(len(raw), np.int64)
        for name in ("seconds", "nanos")
    )
    return np.asarray(seconds * 1_000_000_000 + nanos)


def _repeat(one: Column, raw: NDArray[np.uint8]) -> Column:
    """The value of one message for all: a number, text, or an array without items."""
    if isinstance(one, Ragged):
        return Ragged(one.content, np.zeros(len(raw) + 1, np.int64))
    return np.repeat(one, len(raw))
