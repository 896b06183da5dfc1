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

from abyssnav.formats.ragged import Column, runs, texts
from abyssnav.tables import Bool, Int

#: Byte of the message, the bits that count there, and what they are.
Mark = tuple[int, int, int]


@dataclass(frozen=True)
class Place:
    """A field: its first byte, how many, and what they say, (n, width) uint8 to a column."""

    at: int
    width: int
    read: Callable[[NDArray[np.uint8]], Column]

    def then(self, further: Callable[[Column], Column]) -> "Place":
        """Return the same bytes, of which something else is made."""
        return replace(self, read=lambda raw: further(self.read(raw)))


@dataclass(frozen=True)
class Pattern:
    """One layout."""

    width: int  #: bytes that tell the layout and hold the fields
    marks: Sequence[Mark]
    places: Mapping[str, Place]  #: by the field's path
    whole: bool = False  #: whether a message must end there

    @cached_property
    def is_dense(self) -> bool:
        """Whether the fields are so much of the bytes that these may as well be kept."""
        return self.width <= 4 * sum(place.width for place in self.places.values())

    def may_fit(self, lengths: Int) -> Bool:
        """Return which messages have the length for it."""
        return lengths == self.width if self.whole else lengths >= self.width

    def rows(self, content: NDArray[np.uint8], starts: Int) -> NDArray[np.uint8]:
        """Copy the bytes of messages, (n, width)."""
        return runs(content, starts, self.width).view(np.uint8).reshape(len(starts), self.width)

    def fits(self, rows: NDArray[np.uint8]) -> Bool:
        """Return which messages are of this layout."""
        good = np.ones(len(rows), bool)
        for agreed in self._agreed(rows):
            good &= agreed
        return good

    def fits_all(self, rows: NDArray[np.uint8]) -> bool:
        """Whether all messages are."""
        return all(agreed.all() for agreed in self._agreed(rows))

    def _agreed(self, rows: NDArray[np.uint8]) -> Iterator[Bool]:
        for at, kind, bits, value in self._words:
            word = rows[:, at : at + kind.itemsize].view(kind)[:, 0]
            yield (word if bits is None else word & bits) == value

    def columns(self, rows: NDArray[np.uint8]) -> dict[str, Column]:
        """Return the fields of messages that fit."""
        return {
            path: place.read(rows[:, place.at : place.at + place.width])
            for path, place in self.places.items()
        }

    @cached_property
    def _words(self) -> list[tuple[int, np.dtype[np.uint64], np.uint64 | None, np.uint64]]:
        """Marks that lie in the same eight bytes, or fewer, together."""
        bits, values = np.zeros((2, self.width + 8), np.uint8)
        for at, mask, value in self.marks:
            bits[at], values[at] = mask, value & mask
        words, at = [], 0
        while at < self.width:
            if not bits[at]:
                at += 1
                continue
            need = int(np.flatnonzero(bits[at : at + 8])[-1]) + 1
            size = max(size for size in (1, 2, 4, 8) if size <= self.width and size < 2 * need)
            begin = min(at, self.width - size)
            kind = np.dtype(f"u{size}")
            mask, value = (a[begin : begin + size].view(kind)[0] for a in (bits, values))
            every = bits[begin : begin + size].min() == 0xFF
            words.append((begin, kind, None if every else mask, value))
            at = begin + size
        return words


def alike_texts(raw: NDArray[np.uint8], nul: int = 0) -> NDArray[Any]:
    """Texts of one length, `nul` bytes behind each, in (n, width); often all are the same."""
    raw = raw[:, : max(0, raw.shape[1] - nul)]
    if len(raw) and (raw == raw[0]).all():
        return np.repeat(texts([raw[0].tobytes()]), len(raw))
    return texts([row.tobytes() for row in raw])
