# SPDX-License-Identifier: Apache-2.0
"""Rows of varying length as two arrays, never an object a row; messages of one layout as columns.

What a message's fields lie behind are lengths: of text, of arrays, of other messages.  Messages
whose lengths agree with those of one that was walked have their fields where it has them, so that
a topic is one comparison of a few bytes and one strided view a field.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.tables import Bool, Int


@dataclass(frozen=True, eq=False)
class Ragged:
    """Row i is `content[offsets[i]:offsets[i + 1]]`.

    A topic's payloads are a `Ragged` of uint8; a variable array in every message is one of numbers
    or text, and of `Ragged` where such arrays nest.
    """

    content: "NDArray[Any] | Ragged"
    offsets: Int  #: (n + 1,), from 0, never falling

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, rows: Any) -> "Ragged":
        """Return the rows that a mask, slice or index array selects."""
        width = self.width
        if width and not isinstance(self.content, Ragged):
            even = self.content.reshape(len(self), width, *self.content.shape[1:])
            return Ragged.regular(even[rows])
        starts, lengths = self.offsets[:-1][rows], self.lengths[rows]
        return Ragged(self.content[ragged_indices(starts, lengths)], row_offsets(lengths))

    @cached_property  # asked for again with every chunk written
    def lengths(self) -> Int:
        """Return the items of each row, (n,)."""
        return np.diff(self.offsets)

    @cached_property
    def width(self) -> int | None:
        """Return the length that all rows share, None when they differ or there are none."""
        lengths = self.lengths
        same = len(lengths) > 0 and bool((lengths == lengths[0]).all())
        return int(lengths[0]) if same else None

    @classmethod
    def regular(cls, rows: NDArray[Any]) -> "Ragged":
        """Rows of one length from an (n, k, ...) array."""
        n, k = rows.shape[:2]
        table = cls(rows.reshape(n * k, *rows.shape[2:]), np.arange(n + 1, dtype=np.int64) * k)
        if n:
            vars(table)["width"] = k  # need not be asked of the lengths
        return table

    @classmethod
    def from_bytes(cls, rows: Sequence[bytes]) -> "Ragged":
        """Rows of uint8 from byte strings."""
        return cls(np.frombuffer(b"".join(rows), np.uint8), row_offsets([len(row) for row in rows]))

    def row_bytes(self) -> list[bytes]:
        """Return every row as a byte string, for the few topics that are read one by one."""
        whole, ends = np.asarray(self.content).tobytes(), self.offsets.tolist()
        return [whole[a:b] for a, b in pairwise(ends)]


Column = NDArray[Any] | Ragged


class DecodeError(Exception):
    """Rows whose bytes do not fit their definition; never leaves `formats`."""

    def __init__(self, rows: Bool) -> None:
        self.rows = rows


def row_offsets(lengths: Any) -> Int:
    """Offsets (n + 1,) of rows with these `lengths` (n,)."""
    offsets = np.zeros(len(lengths) + 1, np.int64)
    np.cumsum(lengths, out=offsets[1:])
    return offsets


def ragged_indices(starts: Int, lengths: Int) -> Int:
    """Index of every item of runs of `lengths` that begin at `starts`."""
    offsets = row_offsets(lengths)
    return np.repeat(starts - offsets[:-1], lengths) + np.arange(offsets[-1])


def concatenate(parts: Sequence[Column]) -> Column:
    """Put columns of one kind under each other."""
    if len(parts) == 1:
        return parts[0]
    ragged = [part for part in parts if isinstance(part, Ragged)]
    if len(ragged) < len(parts):
        return np.concatenate([np.asarray(part) for part in parts])
    lengths = np.concatenate([part.lengths for part in ragged])
    return Ragged(concatenate([part.content for part in ragged]), row_offsets(lengths))


class ColumnBuilder:
    """Columns that batches are added to; room for `hint` rows is made at once and never copied.

    Parameters
    ----------
    hint : rows that may come
    room : bytes that all of them can take at most
    """

    def __init__(self, hint: int, room: int) -> None:
        self.hint, self.room, self.rows = hint, room, 0
        self.arrays: dict[str, NDArray[Any]] = {}
        #: Text and arrays, each batch with its first row.
        self.parts: dict[str, list[tuple[int, Column]]] = {}

    def add(self, columns: Mapping[str, Column], rows: int) -> None:
        """Add a batch of `rows` rows.

        Raises
        ------
        ReadError
            A field that is text or an array in some messages and a number in others.
        """
        for name, column in columns.items():
            if isinstance(column, Ragged) or column.dtype.kind == "T":
                self.parts.setdefault(name, []).append((self.rows, column))
            else:
                self._room(name, column, rows)[self.rows : self.rows + rows] = column
        self.rows += rows

    def _room(self, name: str, column: NDArray[Any], rows: int) -> NDArray[Any]:
        have, need = self.arrays.get(name), self.rows + rows
        if have is None:
            size = max(need, min(self.hint, self.room // (column[:1].nbytes or 1)))
            self.arrays[name] = np.empty((size, *column.shape[1:]), column.dtype)
        elif len(have) < need or have.dtype != column.dtype:
            size = max(need, 2 * len(have) if len(have) < need else len(have))
            dtype = np.result_type(have, column)
            self.arrays[name] = np.empty((size, *column.shape[1:]), dtype)
            self.arrays[name][: self.rows] = have[: self.rows]
        return self.arrays[name]

    def columns(self) -> dict[str, Column]:
        """Return all that was added; numbers that are all unknown can be text or arrays as well.

        Raises
        ------
        ReadError
            As `add`.
        """
        whole: dict[str, Column] = {n: array[: self.rows] for n, array in self.arrays.items()}
        for name, parts in self.parts.items():
            whole[name] = _concat(name, self._without_gaps(name, parts))
        return whole

    def _without_gaps(self, name: str, parts: list[tuple[int, Column]]) -> list[Column]:
        """Batches of text or arrays, and blanks where batches of unknown numbers were."""
        numbers, like = self.arrays.get(name), parts[0][1]
        whole, position = list[Column](), 0
        for begin, part in [*parts, (self.rows, like[:0])]:
            if begin > position:
                if numbers is None or not np.isnan(numbers[position:begin]).all():
                    raise _mixed(name)
                whole.append(_blank(like, begin - position))
            whole.append(part)
            position = begin + len(part)
        return whole


def _blank(like: Column, rows: int) -> Column:
    if isinstance(like, Ragged):
        return Ragged(like.content[:0], np.zeros(rows + 1, np.int64))
    return np.full(rows, "", like.dtype)


def _mixed(name: str) -> ReadError:
    return ReadError(f"{name} is text or an array in some messages, and not in others")


def _concat(name: str, parts: Sequence[Column]) -> Column:
    """As `concat`; ReadError where their kinds differ."""
    try:
        return concatenate(parts)
    except (TypeError, ValueError):
        raise _mixed(name) from None


def pick_item(column: Column, index: int, innermost: bool) -> Column:
    """Item `index` of the innermost or the outermost array of each row, NaN where it is shorter.

    Raises
    ------
    TypeError
        Rows are no arrays.
    IndexError
        None has so many items.
    """
    if not isinstance(column, Ragged):
        if column.ndim < 2:
            if column.dtype.kind == "f" and np.isnan(column).all():
                return column  # JSON's null, of which nobody knows what it would be
            raise TypeError("no array")
        return column[..., index] if innermost else column[:, index]
    inner = column.content
    if innermost and (isinstance(inner, Ragged) or inner.ndim > 1):
        return Ragged(pick_item(inner, index, innermost), column.offsets)
    content, has_item = np.asarray(inner), column.lengths > index
    blank = "" if content.dtype.kind == "T" else np.nan
    picked = np.full(len(column), blank, content.dtype if blank == "" else np.float64)
    picked[has_item] = content[column.offsets[:-1][has_item] + index]
    return picked


def scatter_rows(parts: Sequence[tuple[Int, Mapping[str, Column]]]) -> dict[str, Column]:
    """Put columns back on the rows that they came from, each row of one part."""
    order = np.argsort(np.concatenate([rows for rows, _ in parts]), kind="stable")
    return {
        name: concatenate([columns[name] for _, columns in parts])[order] for name in parts[0][1]
    }


def overlapping_windows(content: NDArray[np.uint8], width: int) -> NDArray[Any]:
    """Every run of `width` bytes as one item, overlapping: (len(content) - width + 1,)."""
    return np.ndarray((len(content) - width + 1,), f"V{width}", content, 0, (1,))


def gather_fixed(content: NDArray[np.uint8], starts: Int, width: int) -> NDArray[np.uint8]:
    """`width` bytes from each start, (n, width), copied by one index into overlapping items."""
    if width == 0 or len(starts) == 0:
        return np.zeros((len(starts), width), np.uint8)
    items = np.asarray(overlapping_windows(content, width)[starts])
    return items.view(np.uint8).reshape(len(starts), width)


def decode_texts(rows: Sequence[bytes]) -> NDArray[Any]:
    """Text column (n,) of UTF-8; bytes that are none are marked, not refused."""
    return np.array([row.decode("utf-8", "replace") for row in rows], np.dtypes.StringDType())


# --- wire layouts ---------------------------------------------------------------------------------

#: A layout known by more bytes is one of long lists, which seldom comes again.
MAX_MASKS = 400
#: Byte of the message, the bits that count there, and what they are.
ByteMask = tuple[int, int, int]


@dataclass(frozen=True)
class FieldSlice:
    """A field: its first byte, how many, and what they say, (n, width) uint8 to a column."""

    offset: int
    width: int
    read: Callable[[NDArray[np.uint8]], Column]

    def bytes_in(self, rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the field's bytes of whole messages, (n, width)."""
        return rows[:, self.offset : self.offset + self.width]

    def then(self, further: Callable[[Column], Column]) -> "FieldSlice":
        """Return the same bytes, of which something else is made."""
        return replace(self, read=lambda raw: further(self.read(raw)))


@dataclass(frozen=True)
class WireLayout:
    """One layout."""

    width: int  #: bytes that tell the layout and hold the fields
    masks: Sequence[ByteMask]
    slices: Mapping[str, FieldSlice]  #: by the field's path
    is_whole: bool = False  #: whether a message must end there

    def may_fit(self, lengths: Int) -> Bool:
        """Return which messages have the length for it."""
        return lengths == self.width if self.is_whole else lengths >= self.width

    def rows(self, content: NDArray[np.uint8], starts: Int) -> NDArray[np.uint8]:
        """Copy the bytes of messages, (n, width)."""
        return gather_fixed(content, starts, self.width)

    def fits(self, rows: NDArray[np.uint8]) -> Bool:
        """Return which messages are of this layout."""
        fit = np.ones(len(rows), bool)
        for agree in self._agreements(rows):
            fit &= agree
        return fit

    def fits_all(self, rows: NDArray[np.uint8]) -> bool:
        """Whether all messages are."""
        return all(agree.all() for agree in self._agreements(rows))

    def _agreements(self, rows: NDArray[np.uint8]) -> Iterator[Bool]:
        for offset, kind, bits, value in self._words:
            word = rows[:, offset : offset + kind.itemsize].view(kind)[:, 0]
            yield (word if bits is None else word & bits) == value

    def columns(self, rows: NDArray[np.uint8]) -> dict[str, Column]:
        """Return the fields of messages that fit."""
        return {path: part.read(part.bytes_in(rows)) for path, part in self.slices.items()}

    @cached_property
    def _words(self) -> list[tuple[int, np.dtype[np.uint64], np.uint64 | None, np.uint64]]:
        """Marks that lie in the same eight bytes, or fewer, together."""
        bits, values = np.zeros((2, self.width + 8), np.uint8)
        for offset, mask, value in self.masks:
            bits[offset], values[offset] = mask, value & mask
        words, end = [], 0
        for offset in np.flatnonzero(bits).tolist():  # few, however wide the message
            if offset < end:
                continue
            need = int(np.flatnonzero(bits[offset : offset + 8])[-1]) + 1
            size = max(size for size in (1, 2, 4, 8) if size <= self.width and size < 2 * need)
            begin = min(offset, self.width - size)
            kind = np.dtype(f"u{size}")
            mask, value = (a[begin : begin + size].view(kind)[0] for a in (bits, values))
            all_bits = bits[begin : begin + size].min() == 0xFF
            words.append((begin, kind, None if all_bits else mask, value))
            end = begin + size
        return words


def decode_equal_length_texts(raw: NDArray[np.uint8], n_nul: int = 0) -> NDArray[Any]:
    """Texts of one length, `nul` bytes behind each, in (n, width); often all are the same."""
    raw = raw[:, : max(0, raw.shape[1] - n_nul)]
    if len(raw) and (raw == raw[0]).all():
        return np.repeat(decode_texts([raw[0].tobytes()]), len(raw))
    return decode_texts([row.tobytes() for row in raw])
