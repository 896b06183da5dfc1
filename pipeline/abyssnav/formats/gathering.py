# SPDX-License-Identifier: Apache-2.0
"""What is wanted of a channel, and its messages as they come out of one stretch after the other."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.mcap.chunks import Rows
from abyssnav.formats.mcap.layout import Channel
from abyssnav.formats.patterns import Pattern
from abyssnav.formats.ragged import (
    Column,
    Growing,
    Ragged,
    concat,
    cumulative,
    placed,
    runs,
    spread,
)
from abyssnav.tables import Bool, Int

#: Messages, or bytes of them, that are decoded together where no pattern places their fields.
_BATCH, _BATCH_BYTES = 1 << 14, 1 << 24
_BYTES = ""  #: name beside dotted paths
_MOST_PATTERNS = 12  #: what shows more of them is decoded without
Columns = dict[str, Column]
#: Columns, and which payloads could be decoded.
Decoded = tuple[Columns, Bool]


@dataclass(frozen=True)
class Take:
    """What is wanted of a channel."""

    #: Payloads to columns, and which of them could be decoded.
    decode: Callable[[Ragged], Decoded]
    #: The layout of payloads like this one; None where its fields have no fixed places.
    pattern: Callable[[NDArray[np.uint8]], Pattern | None] = lambda _: None


#: The payloads themselves, as the column `payload`.
PAYLOADS = Take(lambda payloads: ({"payload": payloads}, np.ones(len(payloads), bool)))
#: Log times only.
TIMES = Take(lambda payloads: ({}, np.ones(len(payloads), bool)), lambda _: Pattern(0, (), {}))


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
class Gathered:
    """A channel's messages so far: bytes of one layout, or columns; payloads that wait for more.

    While all messages are of one layout, their bytes are put under each other, and only at the end
    a view of them for each field.
    """

    take: Take | None
    hint: int  #: how many messages there may be
    room: int  #: bytes that they can take at most
    times: list[Int] = field(default_factory=list)  #: log times of all messages
    kept: list[Bool] = field(default_factory=list)  #: which of them have columns
    patterns: list[Pattern] = field(default_factory=list)  #: layouts that the messages have shown
    alike: bool = True  #: whether all messages are of the first
    waiting: list[Ragged] = field(default_factory=list)
    problem: ReadError | None = None

    def __post_init__(self) -> None:
        self.grown = Growing(self.hint, self.room)  #: columns, or bytes of the first pattern

    def add(self, content: NDArray[np.uint8], rows: Rows) -> None:
        """Copy what is wanted of messages in `content` that come behind all others."""
        self.times.append(rows.log_time_ns)
        if self.take is None or self.problem:
            return
        try:
            if not self._add_alike(content, rows):
                self._add_mixed(content, rows, self.take)
        except ReadError as error:
            self.problem = error

    def _add_alike(self, content: NDArray[np.uint8], rows: Rows) -> bool:
        """Add messages that are all of one layout known; False when they are not."""
        for pattern in self.patterns:
            if pattern.may_fit(np.array([rows.shortest, rows.longest])).all():
                found = pattern.rows(content, rows.starts)
                if pattern.fits_all(found):
                    self._add_rows(pattern, found)
                    return True
        return False

    def _add_rows(self, pattern: Pattern, found: NDArray[np.uint8]) -> None:
        every = np.ones(len(found), bool)
        if self.alike and pattern is self.patterns[0] and pattern.is_dense:
            self.kept.append(every)
            self.grown.add({_BYTES: found}, len(found))
        else:
            self._add_columns(pattern.columns(found), every)

    def _add_mixed(self, content: NDArray[np.uint8], rows: Rows, take: Take) -> None:
        """Add messages of several layouts, or of new ones; those of none are decoded one by one."""
        parts: list[tuple[Int, Columns]] = []
        left, tried = np.arange(len(rows.starts)), 0
        while len(left) and self._knows(tried, content, rows, int(left[0]), take):
            pattern = self.patterns[tried]
            tried += 1
            fits = pattern.may_fit(rows.lengths[left])
            found = pattern.rows(content, rows.starts[left[fits]])
            if not (alike := pattern.fits(found)).all():
                found, fits[fits] = found[alike], alike
            if len(found) == len(rows.starts):
                self._add_rows(pattern, found)
                return
            if len(found):
                parts.append((left[fits], pattern.columns(found)))
                left = left[~fits]
        if parts:
            kept = np.ones(len(rows.starts), bool)
            if len(left):
                columns, kept[left] = take.decode(_payloads(content, rows, left))
                parts.append((left[kept[left]], columns))
            self._add_columns(placed(parts), kept)
        else:
            self._wait(_payloads(content, rows, left))

    def _knows(
        self, tried: int, content: NDArray[np.uint8], rows: Rows, row: int, take: Take
    ) -> bool:
        """Whether there is a layout yet to be tried; if not, that of one message becomes known."""
        if tried == len(self.patterns) < _MOST_PATTERNS:
            start, length = int(rows.starts[row]), int(rows.lengths[row])
            pattern = take.pattern(content[start : start + length])
            self.patterns += [pattern] if pattern else []
        return tried < len(self.patterns)

    def _wait(self, payloads: Ragged) -> None:
        self._give_up_alike()
        self.waiting.append(payloads)
        if (
            sum(map(len, self.waiting)) >= _BATCH
            or sum(payloads.offsets[-1] for payloads in self.waiting) >= _BATCH_BYTES
        ):
            self.decode()

    def decode(self) -> None:
        """Turn what waits into columns."""
        if self.waiting and self.take and not self.problem:
            payloads, self.waiting = concat(self.waiting), []
            assert isinstance(payloads, Ragged)
            try:
                self._add_columns(*self.take.decode(payloads))
            except ReadError as error:
                self.problem = error

    def _add_columns(self, columns: Columns, kept: Bool) -> None:
        self.decode()
        self._give_up_alike()
        self.kept.append(kept)
        self.grown.add(columns, int(np.count_nonzero(kept)))

    def _give_up_alike(self) -> None:
        if self.alike and self.grown.rows:
            columns, n = self.columns(), self.grown.rows
            self.grown = Growing(self.hint, self.room)
            self.grown.add(columns, n)
        self.alike = False

    def columns(self) -> Mapping[str, Column]:
        """Return the fields of all messages that could be decoded."""
        columns = self.grown.columns()
        if self.alike and self.patterns:
            return self.patterns[0].columns(np.asarray(columns[_BYTES]))
        return columns

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
        if self.take is None:
            return None
        if self.problem:
            return Messages(channel, times, {}, 0, self.problem)
        kept = np.concatenate(self.kept)
        lost = len(kept) - int(np.count_nonzero(kept))
        try:
            return Messages(channel, times[kept] if lost else times, self.columns(), lost)
        except ReadError as error:  # an item that no array has
            return Messages(channel, times, {}, 0, error)


def _payloads(content: NDArray[np.uint8], rows: Rows, which: Int) -> Ragged:
    """Whole payloads of some messages."""
    starts, lengths = rows.starts[which], rows.lengths[which]
    if len(which) == 0 or (lengths != lengths[0]).any():
        return Ragged(content[spread(starts, lengths)], cumulative(lengths))
    width = int(lengths[0])
    return Ragged.regular(runs(content, starts, width).view(np.uint8).reshape(len(starts), width))
