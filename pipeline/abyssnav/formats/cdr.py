# SPDX-License-Identifier: Apache-2.0
"""ROS messages: a whole topic's payloads seen as columns, no loop over messages.

ROS 2 (CDR): 4 bytes that name the byte order, then the fields in order, each aligned to its own
size, counted from behind those 4 bytes.  Text is a length with its NUL, the bytes, the NUL; a
variable array is a length and its items.  ROS 1 is the same, little-endian, with neither the 4
bytes nor alignment nor NUL.

All messages are walked at the same time, down their definition.  A cursor is one number while
everything before it has the same length in all of them, and then a field is a strided view; behind
a text or array of varying length it is one number a message, and then a field is one gather.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.columns import (
    MAX_MASKS,
    ByteMask,
    Column,
    DecodeError,
    FieldSlice,
    Ragged,
    WireLayout,
    decode_equal_length_texts,
    decode_texts,
    gather_fixed,
    ragged_indices,
    row_offsets,
    scatter_rows,
)
from abyssnav.formats.schema import (
    DURATION,
    PRIMITIVES,
    SEQUENCE,
    TIMES,
    Definition,
    Field,
    Want,
    wanted,
)
from abyssnav.tables import Bool, Int

ENCAPSULATION: Final = 4  #: bytes before the first field of CDR; alignment counts from behind them
_BIG, _LITTLE = 0, 1  #: plain CDR; higher ones are parameter lists and XCDR2, which differ
_WIDEST: Final = 8  #: bytes of the widest primitive, to which layouts repeat
#: Arrays as long as the longest, up to which their elements are stepped over one by one: a step of
#: all messages together takes as long as so many of one.
_FEW_MESSAGES: Final = 64
Cursor = int | Int
Reader = Callable[[NDArray[np.uint8]], Column]


@dataclass(frozen=True)
class WireRules:
    """What differs between the ROS encodings."""

    head: int  #: bytes before the first field
    is_aligned: bool  #: whether each primitive begins at a multiple of its size
    n_nul: int  #: bytes behind each text that its length counts
    time_types: dict[str, str]  #: of the seconds and nanoseconds of a time, of a duration


CDR: Final = WireRules(ENCAPSULATION, True, 1, dict.fromkeys(TIMES, "i4 u4"))
ROS1: Final = WireRules(0, False, 0, {TIMES[0]: "u4 u4", DURATION: "i4 i4"})


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
    tree: Definition,
    payloads: Ragged,
    fields: Sequence[str] | None = None,
    rules: WireRules = CDR,
) -> tuple[dict[str, Column], Bool]:
    """As `decode`, but payloads that do not fit are left out: columns of the rest, and which."""
    want = wanted(tree, fields)
    kept = np.zeros(len(payloads), bool)
    order = _byte_orders(payloads, rules)
    parts: list[tuple[Int, dict[str, Column]]] = []
    for big in (False, True):
        rows = np.flatnonzero(order == (_BIG if big else _LITTLE))
        while len(rows) or not (big or parts):
            decoder = CdrDecoder.over(payloads, rows, tree, rules, big)
            try:
                decoder.fields(tree.root, want, 0, "", True)
            except DecodeError as unfit:
                rows = rows[~unfit.rows]
                continue
            parts.append((rows, decoder.columns))
            kept[rows] = True
            break
    if len(parts) == 1:
        return parts[0][1], kept
    return scatter_rows(parts), kept


def find_layout(
    tree: Definition, payload: NDArray[np.uint8], fields: Sequence[str], rules: WireRules = CDR
) -> WireLayout | None:
    """Layout of messages like `payload`; None when it does not fit, or when a field has no place.

    What lies inside arrays of messages, or of texts, has none.

    Raises
    ------
    ReadError
        A field that the definition does not have.
    """
    order = _byte_orders(one := Ragged.regular(payload[None, :]), rules)[0]
    decoder = CdrDecoder.over(one, np.arange(1), tree, rules, bool(order == _BIG))
    head = [(k, 0xFF, int(payload[k])) for k in range(min(2, rules.head, len(payload)))]
    decoder.trace = trace = LayoutTrace(head)
    try:
        decoder.fields(tree.root, wanted(tree, fields), 0, "", True)
    except DecodeError:
        return None
    all_have_slices = trace.slices.keys() == decoder.columns.keys()
    if order < 0 or not all_have_slices or len(trace.masks) > MAX_MASKS:
        return None
    return WireLayout(rules.head + decoder.reach, trace.masks, trace.slices)


def _byte_orders(payloads: Ragged, rules: WireRules) -> Int:
    """Byte order of each payload, -1 where it is too short or no plain CDR."""
    if not rules.head:
        return np.full(len(payloads), _LITTLE, np.int64)
    content, width = np.asarray(payloads.content), payloads.width
    if width and width >= ENCAPSULATION:
        first = content.reshape(-1, width)[:, :2].copy().view(">u2")[:, 0]
        return np.where(first <= _LITTLE, first.astype(np.int64), -1)
    rows = np.flatnonzero(payloads.lengths >= ENCAPSULATION)
    first = gather_fixed(content, payloads.offsets[rows], 2).view(">u2")[:, 0]
    order = np.full(len(payloads), -1, np.int64)
    order[rows] = np.where(first <= _LITTLE, first.astype(np.int64), -1)
    return order


@dataclass
class LayoutTrace:
    """What a walk over one message finds of its layout."""

    masks: list[ByteMask]
    slices: dict[str, FieldSlice] = field(default_factory=dict)


@dataclass
class CdrDecoder:
    """One pass down a definition over many messages of one byte order."""

    bytes: NDArray[np.uint8]
    starts: Int  #: (n,) of the first field's byte
    sizes: Int  #: (n,) bytes from there on
    tree: Definition
    rules: WireRules
    byte_order: str
    matrix: NDArray[np.uint8] | None  #: the payloads as (n, width), where they are that regular
    columns: dict[str, Column] = field(default_factory=dict)
    reach: int = 0  #: end of the last field that was wanted
    trace: LayoutTrace | None = None

    def __post_init__(self) -> None:
        self.least = int(self.sizes.min(initial=1 << 62))

    @classmethod
    def over(
        cls, payloads: Ragged, rows: Int, tree: Definition, rules: WireRules, big: bool
    ) -> "CdrDecoder":
        """Walk over some of the payloads, all of one byte order."""
        content, starts, sizes = np.asarray(payloads.content), payloads.offsets, payloads.lengths
        matrix = None
        if len(rows) < len(payloads):
            starts, sizes = starts[rows], sizes[rows]
        else:
            starts = starts[:-1]
            if payloads.width:
                matrix = content.reshape(-1, payloads.width)[:, rules.head :]
        starts, sizes = starts + rules.head, sizes - rules.head
        return cls(content, starts, sizes, tree, rules, ">" if big else "<", matrix)

    def on(self, rows: Int) -> "CdrDecoder":
        """Return a walk over some of the rows, or over rows repeated."""
        starts, sizes = self.starts[rows], self.sizes[rows]
        inner = CdrDecoder(self.bytes, starts, sizes, self.tree, self.rules, self.byte_order, None)
        inner.trace = self.trace and LayoutTrace(self.trace.masks)  # in arrays: no fixed places
        return inner

    def fields(
        self, kind: str, want: Want | None, cursor: Cursor, prefix: str, is_tail: bool
    ) -> Cursor:
        """Walk over a message; where nothing behind it matters (`is_tail`) it may stop early."""
        members = self.tree.types[kind]
        if is_tail and want:
            members = members[: 1 + max(i for i, f in enumerate(members) if f.name in want)]
        for member in members:
            inside = None if want is None else want.get(member.name) if want else {}
            path = f"{prefix}{member.name}"
            if member.count is None:
                is_last = is_tail and member is members[-1]
                cursor = self._one(member.type, inside, cursor, path, is_last)
            else:
                cursor = self._array(member, inside, cursor, path)
        return cursor

    def _one(
        self, kind: str, want: Want | None, cursor: Cursor, path: str, is_tail: bool
    ) -> Cursor:
        if kind in PRIMITIVES:
            return self._numbers(kind, (), want, cursor, path)
        if kind == "string":
            return self._text(want, cursor, path)
        if kind in TIMES and not want:
            return self._time(kind, want, cursor, path)
        if kind not in self.tree.types:
            raise ReadError(f"{self.tree.root}: {path} is a {kind}, which is not read")
        return self.fields(kind, want, cursor, f"{path}.", is_tail)

    def _numbers(
        self, kind: str, shape: tuple[int, ...], want: Want | None, cursor: Cursor, path: str
    ) -> Cursor:
        dtype = np.dtype(self.byte_order + PRIMITIVES[kind])
        width = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        cursor = self._align(cursor, dtype.itemsize) if width else cursor
        if want is not None:
            read = partial(_numbers, dtype, kind, shape)
            self.columns[path] = read(self._bytes(cursor, width))
            self._trace_slice(path, cursor, width, read)
        return cursor + width

    def _time(self, kind: str, want: Want | None, cursor: Cursor, path: str) -> Cursor:
        cursor = self._align(cursor, 4)
        if want is not None:
            seconds, nanos = self.rules.time_types[kind].split()
            read = partial(_times, self.byte_order + seconds, self.byte_order + nanos)
            self.columns[path] = read(self._bytes(cursor, 8))
            self._trace_slice(path, cursor, 8, read)
        return cursor + 8

    def _text(self, want: Want | None, cursor: Cursor, path: str) -> Cursor:
        cursor, lengths = self._count(cursor)
        self._check(cursor + lengths)
        if want is not None:
            n_nul = self.rules.n_nul
            begins = self.starts + cursor
            rows = Ragged(self.bytes[ragged_indices(begins, lengths)], row_offsets(lengths))
            self.columns[path] = decode_texts([row[: len(row) - n_nul] for row in rows.row_bytes()])
            self.reach = max(self.reach, int(np.max(cursor + lengths, initial=0)))
            read = partial(decode_equal_length_texts, n_nul=n_nul)
            self._trace_slice(path, _collapse(cursor), lengths, read)
        return _collapse(cursor + lengths)

    def _array(self, member: Field, want: Want | None, cursor: Cursor, path: str) -> Cursor:
        is_fixed = member.count != SEQUENCE
        if is_fixed and member.type in PRIMITIVES:
            return self._numbers(member.type, (member.count or 0,), want, cursor, path)
        counts = np.full(len(self.starts), member.count, np.int64)
        if not is_fixed:
            cursor, counts = self._count(cursor)
        if member.type in PRIMITIVES:
            return self._sequence(member.type, counts, want, cursor, path)
        least = self.tree.least_bytes.get(member.type, 4)
        if not least:  # of which a message could hold any number
            raise ReadError(f"{self.tree.root}: {path} is an array of messages without fields")
        self._check(cursor + counts * least)  # before taking memory
        end, columns = self._elements(member.type, counts, want, cursor, path)
        offsets = row_offsets(counts)
        for name, column in columns.items():
            if is_fixed and not isinstance(column, Ragged):
                self.columns[name] = column.reshape(-1, member.count or 0, *column.shape[1:])
            else:
                self.columns[name] = Ragged(column, offsets)
        return end

    def _sequence(
        self, kind: str, counts: Int, want: Want | None, cursor: Cursor, path: str
    ) -> Cursor:
        dtype = np.dtype(self.byte_order + PRIMITIVES[kind])
        cursor = _collapse(np.where(counts > 0, self._align(cursor, dtype.itemsize), cursor))
        end = cursor + counts * dtype.itemsize
        self._check(end)
        if want is not None:
            indices = ragged_indices(self.starts + cursor, counts * dtype.itemsize)
            values = _numbers(dtype, kind, (), self.bytes[indices])
            self.columns[path] = Ragged(values, row_offsets(counts))
            self.reach = max(self.reach, int(np.max(end, initial=0)))
            read = partial(_arrays, dtype, kind)
            self._trace_slice(path, cursor, counts * dtype.itemsize, read)
        return _collapse(end)

    def _elements(
        self, kind: str, counts: Int, want: Want | None, cursor: Cursor, path: str
    ) -> tuple[Cursor, dict[str, Column]]:
        """Walk over an array of messages or text: all together where their places are known.

        Else first elements together, then the second ..., as each says where the next begins.
        """
        cursors = np.broadcast_to(cursor, counts.shape).astype(np.int64)
        begins = self._begins(kind, cursors, counts)
        if begins is not None and len(begins):
            rows = np.repeat(np.arange(len(counts)), counts)
            ends, columns = self._step(kind, want, (rows, begins), path)
            last = np.cumsum(counts)[counts > 0] - 1
            cursors[counts > 0] = np.broadcast_to(ends, begins.shape)[last]
            return _collapse(cursors), columns
        offsets = row_offsets(counts)
        parts: list[tuple[Int, dict[str, Column]]] = []
        for k in range(max(1, int(counts.max(initial=0)))):
            rows = np.flatnonzero(counts > k)
            cursors[rows], columns = self._step(kind, want, (rows, cursors[rows]), path)
            parts.append((offsets[rows] + k, columns))
        return _collapse(cursors), scatter_rows(parts)

    def _step(
        self, kind: str, want: Want | None, elements: tuple[Int, Int], path: str
    ) -> tuple[Cursor, dict[str, Column]]:
        """Walk over one element each of some rows, or of rows repeated; where each ends."""
        rows, cursors = elements
        inner = self.on(rows)
        try:
            end = inner._one(kind, want, _collapse(cursors), path, False)
        except DecodeError as unfit:
            bad = np.zeros(len(self.starts), bool)
            bad[rows[unfit.rows]] = True
            raise DecodeError(bad) from None
        self.reach = max(self.reach, inner.reach)
        return end, inner.columns

    def _begins(self, kind: str, cursors: Int, counts: Int) -> Int | None:
        """Where every element begins, (counts.sum(),); None where each has to be asked."""
        sizes = _element_sizes(self.tree, kind, self.rules.is_aligned)
        longest = int(counts.max(initial=0))
        if not longest:
            return None
        if sizes is None:
            if counts.sum() > _FEW_MESSAGES * longest:
                return None
            rows = np.stack([self.starts, self.sizes, cursors, counts], axis=-1).tolist()
            return np.concatenate([self._begins_one_by_one(kind, *row) for row in rows])
        phase = cursors % _WIDEST
        within = np.arange(counts.sum()) - np.repeat(row_offsets(counts)[:-1], counts)
        begins = np.repeat(cursors, counts)
        each_phase = np.repeat(phase, counts)
        for p in np.unique(phase).tolist():
            rows = each_phase == p
            begins[rows] += _repeated_starts(sizes, p, longest)[within[rows]]
        return np.asarray(begins)

    def _begins_one_by_one(self, kind: str, start: int, size: int, cursor: int, count: int) -> Int:
        """Where the elements of one message's array begin; those beyond its end begin there."""
        skip = _Skipper(self.bytes[start : start + size].tobytes(), self)
        begins = np.full(count, size, np.int64)
        for k in range(count):
            begins[k] = cursor
            cursor = skip.one(kind, cursor)
            if cursor > size:
                break
        return begins

    def _count(self, cursor: Cursor) -> tuple[Cursor, Int]:
        cursor = self._align(cursor, 4)
        raw = self._bytes(cursor, 4)
        if self.trace:  # of one message, or of each element of its array
            firsts = self.rules.head + np.broadcast_to(cursor, len(raw))
            places = firsts[:, None] + np.arange(4)
            masked = zip(places.ravel().tolist(), raw.ravel().tolist(), strict=True)
            self.trace.masks += [(place, 0xFF, value) for place, value in masked]
        counts = _numbers(np.dtype(self.byte_order + "u4"), "", (), raw).astype(np.int64)
        return cursor + 4, counts

    def _align(self, cursor: Cursor, size: int) -> Cursor:
        return cursor + -cursor % size if self.rules.is_aligned else cursor

    def _check(self, end: Cursor) -> None:
        if isinstance(end, int) and end <= self.least:
            return
        bad = np.broadcast_to(end > self.sizes, self.sizes.shape)
        if bad.any():
            raise DecodeError(bad)

    def _bytes(self, cursor: Cursor, width: int) -> NDArray[np.uint8]:
        """Bytes of every message at the cursor, (n, width)."""
        self._check(cursor + width)
        if width == 0 or len(self.starts) == 0:  # of an empty array no byte is needed
            return np.zeros((len(self.starts), width), np.uint8)
        self.reach = max(self.reach, int(np.max(cursor)) + width)
        if self.matrix is not None and isinstance(cursor, int):
            return self.matrix[:, cursor : cursor + width]
        return gather_fixed(self.bytes, self.starts + cursor, width)

    def _trace_slice(self, path: str, cursor: Cursor, width: Cursor, read: Reader) -> None:
        if self.trace and len(self.starts) and isinstance(cursor, int):
            offset = self.rules.head + cursor
            self.trace.slices[path] = FieldSlice(offset, int(np.max(width)), read)


class _Skipper:
    """Steps over one message after the other, for arrays too long to walk over side by side."""

    def __init__(self, message: bytes, decoder: CdrDecoder) -> None:
        self.message, self.types = message, decoder.tree.types
        self.is_aligned = decoder.rules.is_aligned
        self.order: Literal["big", "little"] = "big" if decoder.byte_order == ">" else "little"

    def one(self, kind: str, cursor: int) -> int:
        """Where what begins at the cursor ends; somewhere behind the message's end if it does."""
        if kind in PRIMITIVES:
            size = int(PRIMITIVES[kind][1:])
            return cursor + size + (-cursor % size if self.is_aligned else 0)
        if kind not in self.types:  # text, or what is refused when it is read
            count, cursor = self._count(cursor)
            return cursor + count
        for member in self.types[kind]:
            count = 1 if member.count is None else member.count
            if member.count == SEQUENCE:
                count, cursor = self._count(cursor)
            if count > len(self.message):
                return len(self.message) + 1
            if member.type in PRIMITIVES and count:
                cursor = self.one(member.type, cursor)
                cursor += (count - 1) * int(PRIMITIVES[member.type][1:])
                continue
            for _ in range(count):
                if cursor > len(self.message):
                    return cursor
                cursor = self.one(member.type, cursor)
        return cursor

    def _count(self, cursor: int) -> tuple[int, int]:
        if self.is_aligned:
            cursor += -cursor % 4
        return int.from_bytes(self.message[cursor : cursor + 4], self.order), cursor + 4


def _element_sizes(tree: Definition, kind: str, is_aligned: bool) -> tuple[int, ...] | None:
    """Bytes of a message by the place modulo 8 at which it begins; None when not of fixed size."""
    sizes = [_end_of(tree, kind, phase, is_aligned) for phase in range(_WIDEST)]
    if any(size is None for size in sizes):
        return None
    return tuple(size - phase for phase, size in enumerate(sizes) if size is not None)


def _end_of(tree: Definition, kind: str, position: int, is_aligned: bool) -> int | None:
    """Where a message of fixed size ends that begins at a position."""
    if kind in PRIMITIVES or (kind in TIMES and kind not in tree.types):
        size = int(PRIMITIVES.get(kind, "u4")[1:])
        padding = -position % size if is_aligned else 0
        return position + padding + (size if kind in PRIMITIVES else 8)
    for member in tree.types.get(kind, (Field("", "string", SEQUENCE),)):
        if member.count == SEQUENCE or (member.count or 1) > _WIDEST * _WIDEST:
            return None
        if member.type not in PRIMITIVES and member.type not in tree.types:
            return None
        for _ in range(1 if member.count is None else member.count):
            end = _end_of(tree, member.type, position, is_aligned)
            if end is None:
                return None
            position = end
    return position


def _repeated_starts(sizes: tuple[int, ...], phase: int, n: int) -> Int:
    """Where each of `n` messages begins that follow one another, from the first's begin.

    The places modulo 8 repeat after eight at most, and with them the distances.
    """
    first = [phase]
    for _ in range(min(n, 3 * _WIDEST)):
        first.append(first[-1] + sizes[first[-1] % _WIDEST])
    starts = np.array(first, np.int64)
    known, last = _WIDEST, 2 * _WIDEST
    if n <= last:
        return starts[:n] - phase
    length = next(k for k in range(1, _WIDEST + 1)
                  if (starts[known + k] - starts[known]) % _WIDEST == 0)  # fmt: skip
    k = np.arange(n) - known
    rounds, rest = np.divmod(np.maximum(k, 0), length)
    cycle = starts[known + length] - starts[known]
    whole = starts[known + rest] + rounds * cycle
    whole[:known] = starts[:known]
    return np.asarray(whole - phase)


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


def _times(seconds: str, nanoseconds: str, raw: NDArray[np.uint8]) -> Int:
    """Integer nanoseconds from seconds and nanoseconds, of 4 bytes each."""
    whole = raw[:, :4].view(np.dtype(seconds))[:, 0].astype(np.int64)
    whole *= 1_000_000_000
    whole += raw[:, 4:].view(np.dtype(nanoseconds))[:, 0]
    return whole


def _collapse(cursor: Cursor) -> Cursor:
    """Return one number for all messages where it is the same in all."""
    if isinstance(cursor, int):
        return cursor
    if len(cursor) == 0:
        return 0
    return int(cursor[0]) if bool((cursor == cursor[0]).all()) else cursor
