# SPDX-License-Identifier: Apache-2.0
"""Messages of one layout: the bytes by which they are known, and where their fields lie.

What a message's fields lie behind are lengths: of text, of arrays, of other messages.  Messages
whose lengths agree with those of one that was walked have their fields where it has them, so that
a topic is one comparison of a few bytes and one strided view a field.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.formats.columns import Column, decode_texts, gather_fixed
from abyssnav.tables import Bool, Int

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

    @cached_property
    def is_dense(self) -> bool:
        """Whether the fields are so much of the bytes that these may as well be kept."""
        return self.width <= 4 * sum(part.width for part in self.slices.values())

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
        words, offset = [], 0
        while offset < self.width:
            if not bits[offset]:
                offset += 1
                continue
            need = int(np.flatnonzero(bits[offset : offset + 8])[-1]) + 1
            size = max(size for size in (1, 2, 4, 8) if size <= self.width and size < 2 * need)
            begin = min(offset, self.width - size)
            kind = np.dtype(f"u{size}")
            mask, value = (a[begin : begin + size].view(kind)[0] for a in (bits, values))
            all_bits = bits[begin : begin + size].min() == 0xFF
            words.append((begin, kind, None if all_bits else mask, value))
            offset = begin + size
        return words


def decode_equal_length_texts(raw: NDArray[np.uint8], n_nul: int = 0) -> NDArray[Any]:
    """Texts of one length, `nul` bytes behind each, in (n, width); often all are the same."""
    raw = raw[:, : max(0, raw.shape[1] - n_nul)]
    if len(raw) and (raw == raw[0]).all():
        return np.repeat(decode_texts([raw[0].tobytes()]), len(raw))
    return decode_texts([row.tobytes() for row in raw])
