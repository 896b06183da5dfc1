# SPDX-License-Identifier: Apache-2.0
"""What is wanted of a channel, and its messages as they come out of one chunk after the other."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.mcap_chunks import Rows
from pipeline.formats.mcap_layout import Channel
from pipeline.formats.ragged import Column, Growing, Ragged, concat, cumulative, runs, spread
from pipeline.tables import Bool, Int

_BATCH = 1 << 14  #: messages decoded together where only many show the types of the columns
_LOG_TIME = ""  #: name beside dotted paths
#: Columns, and which payloads could be decoded.
Decoded = tuple[dict[str, Column], Bool]


@dataclass(frozen=True)
class Take:
    """What is wanted of a channel."""

    #: Bytes of each payload that are needed, told from one of the channel.
    extent: Callable[[NDArray[np.uint8]], int]
    #: Payloads, cut to the extent, to columns; and which of them could be decoded.
    decode: Callable[[Ragged], Decoded]
    #: False: the types of the columns show in many messages only.
    typed: bool = True


def _as_they_are(payloads: Ragged) -> Decoded:
    return {"payload": payloads}, np.ones(len(payloads), bool)


#: The payloads themselves, as the column `payload`.
PAYLOADS = Take(lambda _: 1 << 62, _as_they_are)
#: Payloads of a channel that is not known yet.
UNKNOWN = Take(PAYLOADS.extent, _as_they_are, typed=False)
#: Log times only.
TIMES = Take(lambda _: 0, lambda payloads: ({}, np.ones(len(payloads), bool)))


@dataclass(frozen=True, eq=False)
class Messages:
    """What was wanted of a channel, in the file's order."""

    channel: Channel
    log_time_ns: Int  #: of the messages that could be decoded
    columns: Mapping[str, Column]
    lost: int  #: messages that could not be
    complete: bool  #: False: payloads were cut to an extent, which may be why some are lost
    problem: ReadError | None = None  #: why no message of this channel can be decoded


@dataclass(frozen=True)
class Count:
    """How much a channel holds."""

    messages: int
    first_ns: int
    last_ns: int


@dataclass
class Batch:
    """A channel's messages out of some chunks, first as payloads, then decoded."""

    take: Take | None
    width: int | None  #: bytes wanted of each payload, if known from earlier ones
    complete: bool = True  #: no payload was longer
    times: list[Int] = field(default_factory=list)
    payloads: list[NDArray[np.uint8] | Ragged] = field(default_factory=list)
    decoded: Decoded | None = None
    problem: ReadError | None = None

    def add(self, content: NDArray[np.uint8], rows: Rows) -> None:
        """Copy what is wanted of each payload."""
        self.times.append(rows.log_time_ns)
        if self.take is None or self.problem:
            return
        if self.width is None:
            try:
                first = int(rows.starts[0])
                self.width = self.take.extent(content[first : first + int(rows.lengths[0])])
            except ReadError as error:
                self.problem = error
                return
        self.complete &= rows.longest <= self.width
        if rows.shortest == rows.longest or rows.shortest >= self.width:
            width = min(self.width, rows.shortest)
            even = runs(content, rows.starts, width).view(np.uint8).reshape(len(rows.starts), width)
            self.payloads.append(even)
        else:
            lengths = np.minimum(rows.lengths, self.width)
            uneven = Ragged(content[spread(rows.starts, lengths)], cumulative(lengths))
            self.payloads.append(uneven)

    def decode(self) -> None:
        """Turn payloads into columns."""
        if self.take is None or self.problem:
            self.payloads = []
            return
        try:
            self.decoded = self.take.decode(_together(self.payloads))
        except ReadError as error:
            self.problem = error
        self.payloads = []


@dataclass
class Gathered:
    """A channel's messages so far: columns, and payloads that wait for more."""

    take: Take | None
    hint: int
    count: Count = Count(0, 0, 0)
    width: int | None = None  #: bytes wanted of each payload, once known
    lost: int = 0
    complete: bool = True
    problem: ReadError | None = None

    def __post_init__(self) -> None:
        self.grown = Growing(self.hint)
        self.waiting = Batch(self.take, None)

    def add_times(self, log_time_ns: Int) -> None:
        """Count messages."""
        if len(log_time_ns):
            first, last = int(log_time_ns.min()), int(log_time_ns.max())
            if self.count.messages:
                first, last = min(first, self.count.first_ns), max(last, self.count.last_ns)
            self.count = Count(self.count.messages + len(log_time_ns), first, last)

    def add(self, batch: Batch) -> None:
        """Add messages that come behind all others; payloads wait until there are enough."""
        self.add_times(np.concatenate(batch.times))
        if self.take is None:
            return
        if self.width is None and batch.take is self.take:
            self.width = batch.width
        self.complete &= batch.complete
        if batch.payloads:
            self.waiting.times += batch.times
            self.waiting.payloads += batch.payloads
            if sum(map(len, self.waiting.times)) >= _BATCH:
                self.decode()
        else:
            self.decode()
            self._keep(batch)

    def decode(self) -> None:
        """Turn what waits into columns."""
        if self.waiting.times:
            self.waiting.decode()
            self._keep(self.waiting)
            self.waiting = Batch(self.take, None)

    def _keep(self, batch: Batch) -> None:
        """Add columns; of a channel with a problem, only times."""
        times = np.concatenate(batch.times)
        columns: dict[str, Column] = {}
        self.problem = self.problem or batch.problem
        if batch.decoded and not self.problem:
            columns, kept = batch.decoded
            times = times[kept]
            self.lost += len(kept) - len(times)
        self.grown.add(columns | {_LOG_TIME: times}, len(times))

    def messages(self, channel: Channel) -> Messages:
        """Return what was gathered."""
        columns = self.grown.columns()
        times = np.asarray(columns.pop(_LOG_TIME))
        columns = {} if self.problem else columns
        return Messages(channel, times, columns, self.lost, self.complete, self.problem)


def _together(parts: list[NDArray[np.uint8] | Ragged]) -> Ragged:
    """Payloads of several chunks."""
    even = [part for part in parts if not isinstance(part, Ragged)]
    if even and len(even) == len(parts) and len({part.shape[1] for part in even}) == 1:
        return Ragged.regular(np.concatenate(even))
    ragged = [part if isinstance(part, Ragged) else Ragged.regular(part) for part in parts]
    found = concat(ragged) if ragged else Ragged.regular(np.zeros((0, 0), np.uint8))
    assert isinstance(found, Ragged)
    return found
