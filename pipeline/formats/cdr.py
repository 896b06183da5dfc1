# SPDX-License-Identifier: Apache-2.0
"""ROS 2 messages (CDR): a whole topic's payloads seen as columns, no loop over messages.

A cursor walks down the definition once for all messages at the same time.  It is one number while
everything before it has the same length in all of them, and then a field is a strided view; behind
a text or array of varying length it is one number a message, and then a field is one gather.

The encoding: 4 bytes that name the byte order, then the fields in order, each aligned to its own
size, counted from behind those 4 bytes.  Text is a length with its NUL, the bytes, the NUL; a
variable array is a length and its items.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.definitions import (
    PRIMITIVES,
    SEQUENCE,
    TIMES,
    Definition,
    Field,
    Want,
    wanted,
)
from pipeline.formats.patterns import Mark, Pattern, Place
from pipeline.formats.ragged import Column, Ragged, UnfitError, cumulative, place, runs, spread
from pipeline.tables import Bool, Int

ENCAPSULATION = 4  #: bytes before the first field; alignment counts from behind them
_LITTLE, _BIG = 1, 0  #: plain CDR; higher ones are parameter lists and XCDR2, which differ
_MOST_MARKS = 400  #: a layout told by more bytes is one of long lists, which seldom comes again
Cursor = int | Int


def decode(
    definition: Definition, payloads: Ragged, fields: Sequence[str] | None = None
) -> dict[str, Column]:
    """Columns by dotted path of all `fields` (default: of every field).

    Scalars are (n,), fixed arrays (n, k), times int64 nanoseconds, text a string array, variable
    arrays `Ragged`; the members of an array of messages are one column each.

    Raises
    ------
    ReadError
        A field that the definition does not have, or a payload that does not fit the definition.
    """
    columns, kept = decode_rows(definition, payloads, fields)
    if not kept.all():
        raise ReadError(f"message {int(np.argmin(kept))} does not fit its definition")
    return columns


def decode_rows(
    tree: Definition, payloads: Ragged, fields: Sequence[str] | None = None
) -> tuple[dict[str, Column], Bool]:
    """As `decode`, but payloads that do not fit are left out: columns of the rest, and which."""
    want = wanted(tree, fields)
    kept = np.zeros(len(payloads), bool)
    order = _byte_orders(payloads)
    parts: list[tuple[Int, dict[str, Column]]] = []
    for big in (False, True):
        rows = np.flatnonzero(order == (_BIG if big else _LITTLE))
        while len(rows) or not (big or parts):
            walk = _Walk.over(payloads, rows, tree, big)
            try:
                walk.fields(tree.root, want, 0, "", True)
            except UnfitError as unfit:
                rows = rows[~unfit.rows]
                continue
            parts.append((rows, walk.columns))
            kept[rows] = True
            break
    if len(parts) == 1:
        return parts[0][1], kept
    rank = np.cumsum(kept) - 1
    where = [rank[rows] for rows, _ in parts]
    names = parts[0][1]
    both = {
        name: place(int(kept.sum()), [(w, c[name]) for w, (_, c) in zip(where, parts, strict=True)])
        for name in names
    }
    return both, kept


def pattern(
    tree: Definition, payload: NDArray[np.uint8], fields: Sequence[str]
) -> Pattern | None:
    """Layout of messages like `payload`; None when it does not fit, or when a field has no place.

    Text and variable arrays have none, nor what lies inside arrays of messages.

    Raises
    ------
    ReadError
        A field that the definition does not have.
    """
    order = _byte_orders(one := Ragged.regular(payload[None, :]))[0]
    walk = _Walk.over(one, np.arange(1), tree, bool(order == _BIG))
    walk.trace = trace = _Trace([(k, 0xFF, int(payload[k])) for k in range(min(2, len(payload)))])
    try:
        walk.fields(tree.root, wanted(tree, fields), 0, "", True)
    except UnfitError:
        return None
    placed = trace.places.keys() == walk.columns.keys()
    if order < 0 or not placed or len(trace.marks) > _MOST_MARKS:
        return None
    return Pattern(ENCAPSULATION + walk.reach, trace.marks, trace.places)


@dataclass
class _Trace:
    """What a walk over one message finds of its layout."""

    marks: list[Mark]
    places: dict[str, Place] = field(default_factory=dict)


@dataclass
class _Walk:
    """One pass down a definition over many messages of one byte order."""

    bytes: NDArray[np.uint8]
    starts: Int  #: (n,) of the first field's byte
    sizes: Int  #: (n,) bytes from there on
    tree: Definition
    byte_order: str
    matrix: NDArray[np.uint8] | None  #: the payloads as (n, width), where they are that regular
    columns: dict[str, Column] = field(default_factory=dict)
    reach: int = 0  #: end of the last field that was wanted
    trace: _Trace | None = None

    def __post_init__(self) -> None:
        self.least = int(self.sizes.min(initial=1 << 62))

    @classmethod
    def over(cls, payloads: Ragged, rows: Int, tree: Definition, big: bool) -> "_Walk":
        content, starts, sizes = np.asarray(payloads.content), payloads.offsets, payloads.lengths
        matrix = None
        if len(rows) < len(payloads):
            starts, sizes = starts[rows], sizes[rows]
        else:
            starts = starts[:-1]
            if payloads.width:
                matrix = content.reshape(-1, payloads.width)[:, ENCAPSULATION:]
        starts, sizes = starts + ENCAPSULATION, sizes - ENCAPSULATION
        return cls(content, starts, sizes, tree, ">" if big else "<", matrix)

    def on(self, rows: Int) -> "_Walk":
        """Return a walk over some of the rows, or over rows repeated."""
        starts, sizes = self.starts[rows], self.sizes[rows]
        walk = _Walk(self.bytes, starts, sizes, self.tree, self.byte_order, None)
        walk.trace = self.trace and _Trace(self.trace.marks)  # inside an array fields have no place
        return walk

    def fields(self, kind: str, want: Want | None, at: Cursor, prefix: str, tail: bool) -> Cursor:
        """Walk over a message; `tail` says that nothing behind it matters, so it may stop early."""
        members = self.tree.types[kind]
        if tail and want:
            members = members[: 1 + max(i for i, f in enumerate(members) if f.name in want)]
        for member in members:
            inside = None if want is None else want.get(member.name) if want else {}
            path = f"{prefix}{member.name}"
            if member.count is None:
                at = self._one(member.type, inside, at, path, tail and member is members[-1])
            else:
                at = self._array(member, inside, at, path)
        return at

    def _one(self, kind: str, want: Want | None, at: Cursor, path: str, tail: bool) -> Cursor:
        if kind in PRIMITIVES:
            return self._numbers(kind, (), want, at, path)
        if kind == "string":
            return self._text(want, at, path)
        if kind in TIMES and not want:
            return self._time(want, at, path)
        if kind not in self.tree.types:
            raise ReadError(f"{self.tree.root}: {path} is a {kind}, which is not read")
        return self.fields(kind, want, at, f"{path}.", tail)

    def _numbers(
        self, kind: str, shape: tuple[int, ...], want: Want | None, at: Cursor, path: str
    ) -> Cursor:
        dtype = np.dtype(self.byte_order + PRIMITIVES[kind])
        width = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        at = _align(at, dtype.itemsize) if width else at
        if want is not None:
            read = partial(_numbers, dtype, kind, shape)
            self.columns[path] = read(self._bytes(at, width))
            self._traced(path, at, width, read)
        return at + width

    def _time(self, want: Want | None, at: Cursor, path: str) -> Cursor:
        at = _align(at, 4)
        if want is not None:
            read = partial(_times, self.byte_order)
            self.columns[path] = read(self._bytes(at, 8))
            self._traced(path, at, 8, read)
        return at + 8

    def _text(self, want: Want | None, at: Cursor, path: str) -> Cursor:
        at, lengths = self._count(at)
        self._check(at + lengths)
        if want is not None:
            runs = self.starts + at
            rows = Ragged(self.bytes[spread(runs, lengths)], cumulative(lengths)).row_bytes()
            text = [row[:-1].decode("utf-8", "replace") for row in rows]
            self.columns[path] = np.array(text, np.dtypes.StringDType())
            self.reach = max(self.reach, int(np.max(at + lengths, initial=0)))
        return _collapse(at + lengths)

    def _array(self, member: Field, want: Want | None, at: Cursor, path: str) -> Cursor:
        fixed = member.count != SEQUENCE
        if fixed and member.type in PRIMITIVES:
            return self._numbers(member.type, (member.count or 0,), want, at, path)
        counts = np.full(len(self.starts), member.count, np.int64)
        if not fixed:
            at, counts = self._count(at)
        if member.type in PRIMITIVES:
            return self._sequence(member.type, counts, want, at, path)
        self._check(at + counts * self._least(member.type))
        end, columns = self._elements(member.type, counts, want, at, path)
        offsets = cumulative(counts)
        for name, column in columns.items():
            if fixed and not isinstance(column, Ragged):
                self.columns[name] = column.reshape(-1, member.count or 0, *column.shape[1:])
            else:
                self.columns[name] = Ragged(column, offsets)
        return end

    def _sequence(self, kind: str, counts: Int, want: Want | None, at: Cursor, path: str) -> Cursor:
        dtype = np.dtype(self.byte_order + PRIMITIVES[kind])
        at = _collapse(np.where(counts > 0, _align(at, dtype.itemsize), at))
        end = at + counts * dtype.itemsize
        self._check(end)
        if want is not None:
            runs = self.bytes[spread(self.starts + at, counts * dtype.itemsize)]
            self.columns[path] = Ragged(_numbers(dtype, kind, (), runs), cumulative(counts))
            self.reach = max(self.reach, int(np.max(end, initial=0)))
        return _collapse(end)

    def _elements(
        self, kind: str, counts: Int, want: Want | None, at: Cursor, path: str
    ) -> tuple[Cursor, dict[str, Column]]:
        """Walk over an array of messages or text: first elements together, then the second ..."""
        cursor = np.broadcast_to(at, counts.shape).astype(np.int64)
        offsets = cumulative(counts)
        parts: list[tuple[Int, dict[str, Column]]] = []
        for k in range(max(1, int(counts.max(initial=0)))):
            rows = np.flatnonzero(counts > k)
            walk = self.on(rows)
            try:
                cursor[rows] = walk._one(kind, want, _collapse(cursor[rows]), path, False)
            except UnfitError as unfit:
                bad = np.zeros(len(counts), bool)
                bad[rows[unfit.rows]] = True
                raise UnfitError(bad) from None
            parts.append((offsets[rows] + k, walk.columns))
            self.reach = max(self.reach, walk.reach)
        columns = {
            name: place(int(offsets[-1]), [(where, part[name]) for where, part in parts])
            for name in parts[0][1]
        }
        return _collapse(cursor), columns

    def _count(self, at: Cursor) -> tuple[Cursor, Int]:
        at = _align(at, 4)
        raw = self._bytes(at, 4)
        if self.trace:
            places = range(ENCAPSULATION + int(np.max(at)), ENCAPSULATION + int(np.max(at)) + 4)
            self.trace.marks += [(k, 0xFF, int(v)) for k, v in zip(places, raw.flat, strict=False)]
        return at + 4, _numbers(np.dtype(self.byte_order + "u4"), "", (), raw).astype(np.int64)

    def _least(self, kind: str) -> int:
        """Fewest bytes that one `kind` takes: bounds an array before memory is taken for it."""
        if kind in PRIMITIVES:
            return int(PRIMITIVES[kind][1])
        if kind not in self.tree.types:
            return 4
        return sum(
            4 if f.count == SEQUENCE else (1 if f.count is None else f.count) * self._least(f.type)
            for f in self.tree.types[kind]
        )

    def _check(self, end: Cursor) -> None:
        if isinstance(end, int) and end <= self.least:
            return
        bad = np.broadcast_to(end > self.sizes, self.sizes.shape)
        if bad.any():
            raise UnfitError(bad)

    def _bytes(self, at: Cursor, width: int) -> NDArray[np.uint8]:
        """Bytes of every message at the cursor, (n, width)."""
        self._check(at + width)
        self.reach = max(self.reach, int(np.max(at, initial=0)) + width)
        if width == 0 or len(self.starts) == 0:
            return np.zeros((len(self.starts), width), np.uint8)
        if self.matrix is not None and isinstance(at, int):
            return self.matrix[:, at : at + width]
        return runs(self.bytes, self.starts + at, width).view(np.uint8).reshape(-1, width)

    def _traced(self, path: str, at: Cursor, width: int, read: Any) -> None:
        if self.trace and isinstance(at, int):
            self.trace.places[path] = Place(ENCAPSULATION + at, width, read)


def _numbers(
    dtype: np.dtype[Any], kind: str, shape: tuple[int, ...], raw: NDArray[np.uint8]
) -> NDArray[Any]:
    """Numbers or arrays (n, *shape) that lie in bytes (n, width)."""
    if raw.size == 0:
        return np.zeros((len(raw), *shape), bool if kind == "bool" else dtype.newbyteorder("="))
    values = raw.view(dtype).reshape(-1, *shape)
    if kind == "bool":
        return np.asarray(values != 0)
    return values if values.dtype.isnative else values.astype(values.dtype.newbyteorder("="))


def _times(byte_order: str, raw: NDArray[np.uint8]) -> Int:
    """Integer nanoseconds from seconds (i4) and nanoseconds (u4), (n, 8) bytes."""
    seconds = raw[:, :4].view(np.dtype(byte_order + "i4"))[:, 0].astype(np.int64)
    seconds *= 1_000_000_000
    seconds += raw[:, 4:].view(np.dtype(byte_order + "u4"))[:, 0]
    return seconds


def _align(at: Cursor, size: int) -> Cursor:
    return at + -at % size


def _collapse(at: Cursor) -> Cursor:
    """Return one number for all messages where it is the same in all."""
    if isinstance(at, int):
        return at
    if len(at) == 0:
        return 0
    return int(at[0]) if bool((at == at[0]).all()) else at


def _byte_orders(payloads: Ragged) -> Int:
    """Byte order of each payload, -1 where it is too short or no plain CDR."""
    content, width = np.asarray(payloads.content), payloads.width
    if width and width >= ENCAPSULATION:
        first = content.reshape(-1, width)[:, :2].copy().view(">u2")[:, 0]
        return np.where(first <= _LITTLE, first.astype(np.int64), -1)
    rows = np.flatnonzero(payloads.lengths >= ENCAPSULATION)
    first = runs(content, payloads.offsets[rows], 2).view(">u2")
    order = np.full(len(payloads), -1, np.int64)
    order[rows] = np.where(first <= _LITTLE, first.astype(np.int64), -1)
    return order
