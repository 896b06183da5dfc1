# SPDX-License-Identifier: Apache-2.0
"""One walk down a definition over many CDR messages at the same time.

A cursor is one number while everything before it has the same length in all of them, and then a
field is a strided view; behind a text or array of varying length it is one number a message, and
then a field is one gather.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.definitions import PRIMITIVES, SEQUENCE, TIMES, Definition, Field, Want
from abyssnav.formats.patterns import Mark, Place, alike_texts
from abyssnav.formats.ragged import (
    Column,
    Ragged,
    UnfitError,
    cumulative,
    placed,
    runs,
    spread,
    texts,
)
from abyssnav.tables import Int

ENCAPSULATION = 4  #: bytes before the first field; alignment counts from behind them
Cursor = int | Int
Reader = Callable[[NDArray[np.uint8]], Column]


@dataclass
class Trace:
    """What a walk over one message finds of its layout."""

    marks: list[Mark]
    places: dict[str, Place] = field(default_factory=dict)


@dataclass
class Walk:
    """One pass down a definition over many messages of one byte order."""

    bytes: NDArray[np.uint8]
    starts: Int  #: (n,) of the first field's byte
    sizes: Int  #: (n,) bytes from there on
    tree: Definition
    byte_order: str
    matrix: NDArray[np.uint8] | None  #: the payloads as (n, width), where they are that regular
    columns: dict[str, Column] = field(default_factory=dict)
    reach: int = 0  #: end of the last field that was wanted
    trace: Trace | None = None

    def __post_init__(self) -> None:
        self.least = int(self.sizes.min(initial=1 << 62))

    @classmethod
    def over(cls, payloads: Ragged, rows: Int, tree: Definition, big: bool) -> "Walk":
        """Walk over some of the payloads, all of one byte order."""
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

    def on(self, rows: Int) -> "Walk":
        """Return a walk over some of the rows, or over rows repeated."""
        starts, sizes = self.starts[rows], self.sizes[rows]
        walk = Walk(self.bytes, starts, sizes, self.tree, self.byte_order, None)
        walk.trace = self.trace and Trace(self.trace.marks)  # inside an array fields have no place
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
            rows = Ragged(self.bytes[spread(runs, lengths)], cumulative(lengths))
            self.columns[path] = texts([row[:-1] for row in rows.row_bytes()])
            self.reach = max(self.reach, int(np.max(at + lengths, initial=0)))
            self._traced(path, _collapse(at), lengths, partial(alike_texts, nul=1))
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
        self._check(at + counts * self.tree.least_bytes.get(member.type, 4))  # before taking memory
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
            self._traced(path, at, counts * dtype.itemsize, partial(_arrays, dtype, kind))
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
        return _collapse(cursor), placed(parts)

    def _count(self, at: Cursor) -> tuple[Cursor, Int]:
        at = _align(at, 4)
        raw = self._bytes(at, 4)
        if self.trace:
            places = range(ENCAPSULATION + int(np.max(at)), ENCAPSULATION + int(np.max(at)) + 4)
            self.trace.marks += [(k, 0xFF, int(v)) for k, v in zip(places, raw.flat, strict=False)]
        return at + 4, _numbers(np.dtype(self.byte_order + "u4"), "", (), raw).astype(np.int64)

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

    def _traced(self, path: str, at: Cursor, width: Cursor, read: Reader) -> None:
        if self.trace and len(self.starts) and isinstance(at, int):
            self.trace.places[path] = Place(ENCAPSULATION + at, int(np.max(width)), read)


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


def _arrays(dtype: np.dtype[Any], kind: str, raw: NDArray[np.uint8]) -> Ragged:
    """Arrays of one length that lie in bytes (n, width)."""
    return Ragged.regular(_numbers(dtype, kind, (raw.shape[1] // dtype.itemsize,), raw))


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
