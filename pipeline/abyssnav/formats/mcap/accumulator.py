# SPDX-License-Identifier: Apache-2.0
"""What is wanted of a channel, and its messages as they come out of one stretch after the other."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.columns import (
    Column,
    ColumnBuilder,
    Ragged,
    WireLayout,
    concatenate,
    gather_fixed,
    ragged_indices,
    row_offsets,
    scatter_rows,
)
from abyssnav.formats.mcap.chunks import Rows
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.tables import Bool, Int

#: Messages, or bytes of them, that are decoded together where no layout places their fields.
_BATCH, _BATCH_BYTES = 1 << 14, 1 << 24
_MAX_LAYOUTS = 12  #: what shows more of them is decoded without
Columns = dict[str, Column]
#: Columns, and which payloads could be decoded.
Decoded = tuple[Columns, Bool]


@dataclass(frozen=True)
class ChannelDecoder:
    """What is wanted of a channel."""

    #: Payloads to columns, and which of them could be decoded.
    decode: Callable[[Ragged], Decoded]
    #: The layout of payloads like this one; None where its fields have no fixed places.
    layout: Callable[[NDArray[np.uint8]], WireLayout | None] = lambda _: None


#: The payloads themselves, as the column `payload`.
PAYLOADS = ChannelDecoder(lambda payloads: ({"payload": payloads}, np.ones(len(payloads), bool)))
#: Log times only.
TIMES = ChannelDecoder(
    lambda payloads: ({}, np.ones(len(payloads), bool)), lambda _: WireLayout(0, (), {})
)


@dataclass(frozen=True, eq=False)
class Messages:
    """What was wanted of a channel, in the file's order."""

    channel: Channel
    log_time_ns: Int  #: of the messages that could be decoded
    columns: Mapping[str, Column]
    lost: int  #: messages that could not be
    problem: ReadError | None = None  #: why no message of this channel can be decoded


@dataclass(frozen=True)
class Count:
    """How much a channel holds."""

    messages: int
    first_ns: int
    last_ns: int


@dataclass
class ChannelAccumulator:
    """A channel's messages so far: columns, and payloads that wait for more."""

    decoder: ChannelDecoder | None
    hint: int  #: how many messages there may be
    room: int  #: bytes that they can take at most
    times: list[Int] = field(default_factory=list)  #: log times of all messages
    kept: list[Bool] = field(default_factory=list)  #: which of them have columns
    layouts: list[WireLayout] = field(default_factory=list)  #: layouts that the messages have shown
    waiting: list[Ragged] = field(default_factory=list)
    problem: ReadError | None = None

    def __post_init__(self) -> None:
        self.builder = ColumnBuilder(self.hint, self.room)

    def add(self, content: NDArray[np.uint8], rows: Rows) -> None:
        """Copy what is wanted of messages in `content` that come behind all others."""
        self.times.append(rows.log_time_ns)
        if self.decoder is None or self.problem:
            return
        try:
            if not self._add_uniform(content, rows):
                self._add_mixed(content, rows, self.decoder)
        except ReadError as error:
            self.problem = error

    def _add_uniform(self, content: NDArray[np.uint8], rows: Rows) -> bool:
        """Add messages that are all of one layout known; False when they are not."""
        for layout in self.layouts:
            if layout.may_fit(np.array([rows.shortest, rows.longest])).all():
                rows_found = layout.rows(content, rows.starts)
                if layout.fits_all(rows_found):
                    self._add_rows(layout, rows_found)
                    return True
        return False

    def _add_rows(self, layout: WireLayout, rows_found: NDArray[np.uint8]) -> None:
        self._add_columns(layout.columns(rows_found), np.ones(len(rows_found), bool))

    def _add_mixed(self, content: NDArray[np.uint8], rows: Rows, decoder: ChannelDecoder) -> None:
        """Add messages of several layouts, or of new ones; those of none are decoded one by one."""
        parts: list[tuple[Int, Columns]] = []
        left, tried = np.arange(len(rows.starts)), 0
        while len(left) and self._knows(tried, content, rows, int(left[0]), decoder):
            layout = self.layouts[tried]
            tried += 1
            fits = layout.may_fit(rows.lengths[left])
            rows_found = layout.rows(content, rows.starts[left[fits]])
            if not (is_uniform := layout.fits(rows_found)).all():
                rows_found, fits[fits] = rows_found[is_uniform], is_uniform
            if len(rows_found) == len(rows.starts):
                self._add_rows(layout, rows_found)
                return
            if len(rows_found):
                parts.append((left[fits], layout.columns(rows_found)))
                left = left[~fits]
        if parts:
            kept = np.ones(len(rows.starts), bool)
            if len(left):
                columns, kept[left] = decoder.decode(_payloads(content, rows, left))
                parts.append((left[kept[left]], columns))
            self._add_columns(scatter_rows(parts), kept)
        else:
            self._wait(_payloads(content, rows, left))

    def _knows(
        self, tried: int, content: NDArray[np.uint8], rows: Rows, row: int, decoder: ChannelDecoder
    ) -> bool:
        """Whether there is a layout yet to be tried; if not, that of one message becomes known."""
        if tried == len(self.layouts) < _MAX_LAYOUTS:
            start, length = int(rows.starts[row]), int(rows.lengths[row])
            layout = decoder.layout(content[start : start + length])
            self.layouts += [layout] if layout else []
        return tried < len(self.layouts)

    def _wait(self, payloads: Ragged) -> None:
        self.waiting.append(payloads)
        if (
            sum(map(len, self.waiting)) >= _BATCH
            or sum(payloads.offsets[-1] for payloads in self.waiting) >= _BATCH_BYTES
        ):
            self.decode()

    def decode(self) -> None:
        """Turn what waits into columns."""
        if self.waiting and self.decoder and not self.problem:
            payloads, self.waiting = concatenate(self.waiting), []
            assert isinstance(payloads, Ragged)
            try:
                self._add_columns(*self.decoder.decode(payloads))
            except ReadError as error:
                self.problem = error

    def _add_columns(self, columns: Columns, kept: Bool) -> None:
        self.decode()
        self.kept.append(kept)
        self.builder.add(columns, int(np.count_nonzero(kept)))

    @cached_property  # asked for when all has been added
    def log_time_ns(self) -> Int:
        """Return the log times of all messages."""
        return np.concatenate(self.times) if self.times else np.zeros(0, np.int64)

    def count(self) -> Count:
        """Return how many messages there were, one at least."""
        times = self.log_time_ns
        return Count(len(times), int(times.min()), int(times.max()))

    def messages(self, channel: Channel) -> Messages | None:
        """Return what was gathered; of a channel with a problem, only times; None if unwanted."""
        times = self.log_time_ns
        if self.decoder is None:
            return None
        if self.problem:
            return Messages(channel, times, {}, 0, self.problem)
        kept = np.concatenate(self.kept)
        lost = len(kept) - int(np.count_nonzero(kept))
        try:
            return Messages(channel, times[kept] if lost else times, self.builder.columns(), lost)
        except ReadError as error:  # an item that no array has
            return Messages(channel, times, {}, 0, error)


def _payloads(content: NDArray[np.uint8], rows: Rows, which: Int) -> Ragged:
    """Whole payloads of some messages."""
    starts, lengths = rows.starts[which], rows.lengths[which]
    if len(which) == 0 or (lengths != lengths[0]).any():
        return Ragged(content[ragged_indices(starts, lengths)], row_offsets(lengths))
    width = int(lengths[0])
    return Ragged.regular(gather_fixed(content, starts, width))
