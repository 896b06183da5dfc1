# SPDX-License-Identifier: Apache-2.0
"""What is wanted of a channel, and its messages as they come out of one stretch after the other."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.mcap_chunks import Rows
from pipeline.formats.mcap_layout import Channel
from pipeline.formats.patterns import Pattern
from pipeline.formats.ragged import Column, Growing, Ragged, concat, cumulative, place, runs, spread
from pipeline.tables import Bool, Int

#: Messages, or bytes of them, that are decoded together where no pattern places their fields.
_BATCH, _BATCH_BYTES = 1 << 14, 1 << 24
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


@dataclass(frozen=True, eq=False)
class Piece:
    """A channel's messages out of one stretch: columns, or payloads that wait for more."""

    log_time_ns: Int
    decoded: Decoded | None = None
    payloads: Ragged | None = None


@dataclass
class Source:
    """What is wanted of a channel, and the layouts that its messages have shown.

    Several threads take pieces of one source.  A pattern that two find at a time stands twice,
    which changes no column.
    """

    take: Take | None
    patterns: list[Pattern] = field(default_factory=list)
    problem: ReadError | None = None

    def piece(self, content: NDArray[np.uint8], rows: Rows) -> Piece:
        """Copy what is wanted of messages in `content`, by the layouts known."""
        if self.take is None or self.problem:
            return Piece(rows.log_time_ns)
        for pattern in self.patterns:
            if pattern.may_fit(np.array([rows.shortest, rows.longest])).all():
                found = pattern.rows(content, rows.starts)
                if pattern.fits_all(found):
                    every = np.ones(len(found), bool)
                    return Piece(rows.log_time_ns, (pattern.columns(found), every))
        try:
            return self._mixed(content, rows, self.take)
        except ReadError as error:
            self.problem = error
            return Piece(rows.log_time_ns)

    def _mixed(self, content: NDArray[np.uint8], rows: Rows, take: Take) -> Piece:
        """Messages of several layouts, or of new ones; those of none are decoded by themselves."""
        parts: list[tuple[Int, Columns]] = []
        left, tried = np.arange(len(rows.starts)), 0
        while len(left) and (tried < len(self.patterns) or self._learn(content, rows, left, take)):
            pattern = self.patterns[tried]
            tried += 1
            here = left[pattern.may_fit(rows.lengths[left])]
            found = pattern.rows(content, rows.starts[here])
            if not (fits := pattern.fits(found)).all():
                here, found = here[fits], found[fits]
            if len(here):
                parts.append((here, pattern.columns(found)))
                left = np.setdiff1d(left, here, assume_unique=True)
        if not parts:
            return Piece(rows.log_time_ns, payloads=_payloads(content, rows, left))
        kept = np.ones(len(rows.starts), bool)
        if len(left):
            columns, kept[left] = take.decode(_payloads(content, rows, left))
            parts.append((left[kept[left]], columns))
        rank = np.cumsum(kept) - 1
        columns = {
            name: place(int(kept.sum()), [(rank[where], part[name]) for where, part in parts])
            for name in parts[0][1]
        }
        return Piece(rows.log_time_ns, (columns, kept))

    def _learn(self, content: NDArray[np.uint8], rows: Rows, left: Int, take: Take) -> bool:
        """Add the layout of the first message left; False when it has none, or there are many."""
        if len(self.patterns) >= _MOST_PATTERNS:
            return False
        start, length = int(rows.starts[left[0]]), int(rows.lengths[left[0]])
        pattern = take.pattern(content[start : start + length])
        if pattern is not None:
            self.patterns.append(pattern)
        return pattern is not None


def _payloads(content: NDArray[np.uint8], rows: Rows, which: Int) -> Ragged:
    """Whole payloads of some messages."""
    starts, lengths = rows.starts[which], rows.lengths[which]
    if len(which) == 0 or (lengths != lengths[0]).any():
        return Ragged(content[spread(starts, lengths)], cumulative(lengths))
    width = int(lengths[0])
    return Ragged.regular(runs(content, starts, width).view(np.uint8).reshape(len(starts), width))


@dataclass
class Gathered:
    """A channel's messages so far: columns, and payloads that wait for more."""

    source: Source
    hint: int
    times: list[Int] = field(default_factory=list)  #: log times of all messages
    kept: list[Bool] = field(default_factory=list)  #: which of them have columns
    waiting: list[Ragged] = field(default_factory=list)

    @cached_property
    def grown(self) -> Growing:
        """Return the columns so far."""
        return Growing(self.hint)

    def add(self, piece: Piece) -> None:
        """Add messages that come behind all others; payloads wait until there are enough."""
        self.times.append(piece.log_time_ns)
        if self.source.take is None:
            return
        if piece.payloads is not None:
            self.waiting.append(piece.payloads)
            if (
                sum(map(len, self.waiting)) >= _BATCH
                or sum(payloads.offsets[-1] for payloads in self.waiting) >= _BATCH_BYTES
            ):
                self.decode()
        elif piece.decoded is not None:
            self.decode()
            self._keep(*piece.decoded)

    def decode(self) -> None:
        """Turn what waits into columns."""
        if not self.waiting or self.source.take is None or self.source.problem:
            return
        payloads = concat(self.waiting)
        self.waiting = []
        try:
            assert isinstance(payloads, Ragged)
            self._keep(*self.source.take.decode(payloads))
        except ReadError as error:
            self.source.problem = error

    def _keep(self, columns: Columns, kept: Bool) -> None:
        self.kept.append(kept)
        self.grown.add(columns, int(np.count_nonzero(kept)))

    @cached_property  # asked for when all has been added
    def log_time_ns(self) -> Int:
        """Return the log times of all messages."""
        return np.concatenate(self.times) if self.times else np.zeros(0, np.int64)

    def count(self) -> Count:
        """Return how many messages there were, one at least."""
        times = self.log_time_ns
        return Count(len(times), int(times.min()), int(times.max()))

    def messages(self, channel: Channel) -> Messages:
        """Return what was gathered; of a channel with a problem, only times."""
        times = self.log_time_ns
        if self.source.problem:
            return Messages(channel, times, {}, 0, self.source.problem)
        kept = np.concatenate(self.kept)
        lost = len(kept) - int(np.count_nonzero(kept))
        return Messages(channel, times[kept] if lost else times, self.grown.columns(), lost)
