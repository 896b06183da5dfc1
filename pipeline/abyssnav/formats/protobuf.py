# SPDX-License-Identifier: Apache-2.0
"""Protobuf messages: a whole topic's payloads to columns, no loop over messages.

All messages are walked at the same time, a field a step: the tags at the cursors are read
together, and the messages that show the same tag take the same step.  A topic whose messages have
the same fields in the same order takes as many steps as one message has fields.

The encoding: each field is a varint (number · 8 + wire type) and its value; a varint holds 7 bits a
byte, lowest first; text, messages and packed arrays have their length before them.  Where a field
comes twice, the last counts; in proto3 a number that is not there is zero.  Numbers of a message
that is not there, or that are known not to be there, are NaN, integers zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.definitions import MAX_DEPTH, SEQUENCE, Definition, wanted
from abyssnav.formats.descriptors import (
    BYTES,
    FIXED32,
    FIXED64,
    MESSAGE,
    TYPES,
    VARINT,
    ZIGZAG,
    ProtoField,
)
from abyssnav.formats.ragged import Column, Ragged, UnfitError, cumulative, runs, spread, texts
from abyssnav.tables import Bool, Int

#: One int64 nanosecond column to us.
TIMES = ("google.protobuf.Timestamp", "google.protobuf.Duration")


def decode_rows(
    tree: Definition, payloads: Ragged, fields: Sequence[str] | None = None
) -> tuple[dict[str, Column], Bool]:
    """Columns by dotted path of all `fields`, and which payloads fit the definition.

    As `cdr.decode_rows`: repeated fields are `Ragged`, text is a string array, bytes are `Ragged`.

    Raises
    ------
    ReadError
        A field that the definition does not have.
    """
    want = wanted(tree, fields)
    content = np.asarray(payloads.content)
    rows = np.arange(len(payloads))
    while True:
        starts, ends = payloads.offsets[:-1][rows], payloads.offsets[1:][rows]
        try:
            columns = _Message(content, tree).columns(tree.root, want, starts, ends)
        except UnfitError as unfit:
            rows = rows[~unfit.rows]
            continue
        kept = np.zeros(len(payloads), bool)
        kept[rows] = True
        return columns, kept


@dataclass(frozen=True, eq=False)
class _Seen:
    """A field as one step found it: in which messages, its number, its bytes."""

    wire: int
    rows: Int
    numbers: NDArray[np.uint64]
    begins: Int
    ends: Int


@dataclass
class _Message:
    """Messages that lie anywhere in `bytes`."""

    bytes: NDArray[np.uint8]
    tree: Definition
    depth: int = 0

    def columns(self, kind: str, want: Any, starts: Int, ends: Int) -> dict[str, Column]:
        """Return columns of the messages in bytes `starts` to `ends`, one row each."""
        if self.depth > MAX_DEPTH:
            raise ReadError(f"{self.tree.root}: {kind} contains itself")
        members = {m.number: m for m in self._members(kind) if not want or m.name in want}
        seen = self._walk(members, starts, ends)
        columns: dict[str, Column] = {}
        for number, member in members.items():
            inside = want.get(member.name, {}) if want else {}
            columns |= self._column(member, inside, seen.get(number, []), len(starts))
        return columns

    def _members(self, kind: str) -> list[ProtoField]:
        if kind not in self.tree.types:
            raise ReadError(f"{self.tree.root}: the descriptor set has no message {kind}")
        return [member for member in self.tree.types[kind] if isinstance(member, ProtoField)]

    def _walk(
        self, members: dict[int, ProtoField], starts: Int, ends: Int
    ) -> dict[int, list[_Seen]]:
        """Step over all fields; where those in `members` are, by number, in their order."""
        seen: dict[int, list[_Seen]] = {}
        cursor, rows = starts.copy(), np.flatnonzero(starts < ends)
        while len(rows):
            tags, cursor[rows] = self._varints(cursor, ends, rows)
            for tag in np.unique(tags).tolist():
                mine = rows[tags == tag]
                number, wire = tag >> 3, tag & 7
                value, begin = self._step(wire, mine, cursor, ends)
                if number in members:
                    found = _Seen(wire, mine, value, begin, cursor[mine])
                    seen.setdefault(number, []).append(found)
            rows = rows[cursor[rows] < ends[rows]]
        return seen

    def _step(self, wire: int, rows: Int, cursor: Int, ends: Int) -> tuple[NDArray[np.uint64], Int]:
        """Move the cursors behind a value; return it and where it begins."""
        if wire == VARINT:
            value, cursor[rows] = self._varints(cursor, ends, rows)
            return value, cursor[rows]
        if wire == BYTES:
            value, begin = self._varints(cursor, ends, rows)
            room = (ends[rows] - begin).astype(np.uint64)
            self._require(value <= room, rows, len(cursor))
            cursor[rows] = begin + value.astype(np.int64)
            return value, begin
        width = {FIXED64: 8, FIXED32: 4}.get(wire, 0)
        begin = cursor[rows]
        self._require((begin + width <= ends[rows]) & (width > 0), rows, len(cursor))
        cursor[rows] = begin + width
        return runs(self.bytes, begin, width).view(f"<u{width}").astype(np.uint64), begin

    def _varints(self, cursor: Int, ends: Int, rows: Int) -> tuple[NDArray[np.uint64], Int]:
        """Varints at the cursors of `rows`, and where they end."""
        at, stop = cursor[rows], ends[rows]
        value = np.zeros(len(rows), np.uint64)
        going = np.arange(len(rows))
        for shift in range(0, 70, 7):
            fits = np.ones(len(rows), bool)
            fits[going] = at[going] < stop[going]
            self._require(fits, rows, len(cursor))
            byte = self.bytes[at[going]]
            value[going] |= (byte & 0x7F).astype(np.uint64) << np.uint64(shift)
            at[going] += 1
            going = going[byte >= 0x80]
            if not len(going):
                return value, at
        fits[going] = False
        self._require(fits, rows, len(cursor))
        return value, at

    @staticmethod
    def _require(fits: Bool, rows: Int, n: int) -> None:
        if not fits.all():
            bad = np.zeros(n, bool)
            bad[rows[~fits]] = True
            raise UnfitError(bad)

    # --- from what was seen to a column -----------------------------------------------------------

    def _column(
        self, member: ProtoField, want: Any, seen: list[_Seen], n: int
    ) -> dict[str, Column]:
        if member.kind != MESSAGE and member.kind not in TYPES:
            raise ReadError(
                f"{self.tree.root}: {member.name} is a {member.type}, which is not read"
            )
        if member.kind != MESSAGE and TYPES[member.kind][2] != BYTES:
            return {member.name: self._numbers(member, seen, n)}
        found = [step for step in seen if step.wire == BYTES]
        rows, begins, ends = _in_order(
            [step.rows for step in found],
            [step.begins for step in found],
            [step.ends for step in found],
        )
        if member.count != SEQUENCE:
            last = np.append(rows[1:] != rows[:-1], [True])[: len(rows)]
            rows, begins, ends = rows[last], begins[last], ends[last]
        try:
            columns = self._inside(member, want, begins, ends)
        except UnfitError as unfit:
            bad = np.zeros(n, bool)
            bad[rows[unfit.rows]] = True
            raise UnfitError(bad) from None
        if member.count == SEQUENCE:
            offsets = cumulative(np.bincount(rows, minlength=n))
            return {name: Ragged(column, offsets) for name, column in columns.items()}
        return {name: _filled(column, rows, n) for name, column in columns.items()}

    def _inside(self, member: ProtoField, want: Any, begins: Int, ends: Int) -> dict[str, Column]:
        """Columns of text, bytes or messages that lie between `begins` and `ends`."""
        if member.kind == MESSAGE and member.type in TIMES and not want:
            parts = _Message(self.bytes, self.tree).columns(member.type, {}, begins, ends)
            if not parts.keys() >= {"seconds", "nanos"}:
                raise ReadError(f"{self.tree.root}: its {member.type} is no time")
            seconds, nanos = np.asarray(parts["seconds"]), np.asarray(parts["nanos"])
            return {member.name: seconds * 1_000_000_000 + nanos}
        if member.kind == MESSAGE:
            inner = _Message(self.bytes, self.tree, self.depth + 1)
            columns = inner.columns(member.type, want, begins, ends)
            return {f"{member.name}.{name}": column for name, column in columns.items()}
        lengths = ends - begins
        content = Ragged(self.bytes[spread(begins, lengths)], cumulative(lengths))
        if member.type == "bytes":
            return {member.name: content}
        return {member.name: texts(content.row_bytes())}

    def _numbers(self, member: ProtoField, seen: list[_Seen], n: int) -> Column:
        _, dtype, wire = TYPES[member.kind]
        rows, numbers = [], []
        for step in seen:
            if step.wire == wire:
                rows.append(step.rows)
                numbers.append(step.numbers)
            elif step.wire == BYTES and member.count == SEQUENCE:
                try:
                    which, packed = self._packed(wire, step.begins, step.ends)
                except UnfitError as unfit:
                    bad = np.zeros(n, bool)
                    bad[step.rows[unfit.rows]] = True
                    raise UnfitError(bad) from None
                rows.append(step.rows[which])
                numbers.append(packed)
        every, raw = _in_order(rows, numbers)
        values = typed(raw.astype(np.uint64), member.kind, dtype)
        if member.count == SEQUENCE:
            return Ragged(values, cumulative(np.bincount(every, minlength=n)))
        column = np.full(n, _absent(values.dtype) if member.has_presence else 0, values.dtype)
        column[every] = values
        return column

    def _packed(self, wire: int, begins: Int, ends: Int) -> tuple[Int, NDArray[np.uint64]]:
        """Numbers of packed arrays, and which array each is of."""
        lengths = ends - begins
        if wire in (FIXED32, FIXED64):
            width = 4 if wire == FIXED32 else 8
            if (lengths % width).any():
                raise UnfitError(lengths % width != 0)
            content = self.bytes[spread(begins, lengths)]
            which = np.repeat(np.arange(len(begins)), lengths // width)
            return which, content.view(f"<u{width}").astype(np.uint64)
        places = spread(begins, lengths)
        is_end = self.bytes[places] < 0x80
        which = np.repeat(np.arange(len(begins)), lengths)
        open_end = np.zeros(len(begins), bool)
        some = lengths > 0
        open_end[some] = self.bytes[ends[some] - 1] >= 0x80
        if open_end.any():
            raise UnfitError(open_end)
        first = np.append([True], is_end[:-1])[: len(is_end)]
        starts, of = places[first], which[first]
        try:
            numbers, _ = self._varints(starts, ends[of], np.arange(len(starts)))
        except UnfitError as unfit:
            raise UnfitError(np.bincount(of[unfit.rows], minlength=len(begins)) > 0) from None
        return of, numbers


def _in_order(rows: list[Int], *values: list[NDArray[Any]]) -> tuple[NDArray[Any], ...]:
    """Put what several steps found together by row, within a row in the order of the steps."""
    if not rows:
        return tuple(np.zeros(0, np.int64) for _ in range(1 + len(values)))
    every = np.concatenate(rows)
    order = np.argsort(every, kind="stable")
    return (every[order], *(np.concatenate(parts)[order] for parts in values))


def typed(raw: NDArray[np.uint64], kind: int, dtype: str) -> NDArray[Any]:
    """Numbers as the field's type has them."""
    if dtype == "?":
        return np.asarray(raw != 0)
    if kind in ZIGZAG:
        raw = (raw >> np.uint64(1)) ^ (~(raw & np.uint64(1)) + np.uint64(1))
    size = np.dtype(dtype).itemsize
    return raw.astype(f"u{size}").view(dtype)


def _absent(dtype: np.dtype[Any]) -> Any:
    return {"f": np.nan, "T": ""}.get(dtype.kind, 0)


def _filled(column: Column, rows: Int, n: int) -> Column:
    """Put what some of `n` messages have on its rows; the others have nothing."""
    if isinstance(column, Ragged):
        lengths = np.zeros(n, np.int64)
        lengths[rows] = column.lengths
        return Ragged(column.content, cumulative(lengths))
    whole = np.full((n, *column.shape[1:]), _absent(column.dtype), column.dtype)
    whole[rows] = column
    return whole
