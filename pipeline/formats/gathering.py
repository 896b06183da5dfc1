# SPDX-License-Identifier: Apache-2.0
"""What is wanted of a channel, and its messages as they come out of one chunk after the other."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.mcap_layout import Channel
from pipeline.formats.mcap_records import MESSAGE_FIELDS, MESSAGE_HEAD
from pipeline.formats.ragged import Column, Growing, Ragged, concat, cumulative, runs, spread
from pipeline.tables import Bool, Int

_BATCH = 1 << 14  #: messages that are decoded together, while their bytes are in the cache
_LOG_TIME = ""  #: name beside dotted paths


@dataclass(frozen=True)
class Take:
    """What is wanted of a channel."""

    #: Bytes of each payload that are needed, told from the channel's first.
    extent: Callable[[NDArray[np.uint8]], int]
    #: Payloads, cut to the extent, to columns; and which of them could be decoded.
    decode: Callable[[Ragged], tuple[dict[str, Column], Bool]]


def _as_they_are(payloads: Ragged) -> tuple[dict[str, Column], Bool]:
    return {"payload": payloads}, np.ones(len(payloads), bool)


#: The payloads themselves, as the column `payload`.
PAYLOADS = Take(lambda _: 1 << 62, _as_they_are)
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
class Gathered:
    """A channel's messages so far: columns, and payloads that wait for more."""

    take: Take | None
    hint: int
    count: Count = Count(0, 0, 0)
    width: int = -1  #: bytes wanted of each payload
    waiting: list[NDArray[np.uint8] | Ragged] = field(default_factory=list)
    times: list[Int] = field(default_factory=list)
    n_waiting: int = 0
    lost: int = 0
    complete: bool = True
    problem: ReadError | None = None

    def __post_init__(self) -> None:
        self.grown = Growing(self.hint)

    def add_times(self, log_time_ns: Int) -> None:
        """Count messages."""
        if len(log_time_ns):
            first, last = int(log_time_ns.min()), int(log_time_ns.max())
            if self.count.messages:
                first, last = min(first, self.count.first_ns), max(last, self.count.last_ns)
            self.count = Count(self.count.messages + len(log_time_ns), first, last)

    def add(self, content: NDArray[np.uint8], offsets: Int, heads: NDArray[np.void]) -> None:
        """Copy what is wanted of each payload; decode when enough wait."""
        self.times.append(heads["log_time"].astype(np.int64))
        self.n_waiting += len(heads)
        if self.take is not None:
            starts = offsets + MESSAGE_HEAD.itemsize
            lengths = heads["length"].astype(np.int64) - MESSAGE_FIELDS
            if self.width < 0:
                try:
                    self.width = self.take.extent(content[starts[0] : starts[0] + lengths[0]])
                except ReadError as error:
                    self.problem, self.width = error, 0
            self.waiting.append(self._payloads(content, starts, lengths))
        if self.n_waiting >= _BATCH:
            self.decode()

    def _payloads(
        self, content: NDArray[np.uint8], starts: Int, lengths: Int
    ) -> NDArray[np.uint8] | Ragged:
        """Payloads cut to the extent: a row of bytes each, or ragged where they differ."""
        shortest, longest = int(lengths.min()), int(lengths.max())
        self.complete &= longest <= self.width
        if shortest == longest or shortest >= self.width:
            width = min(self.width, shortest)
            return runs(content, starts, width).view(np.uint8).reshape(len(starts), width)
        lengths = np.minimum(lengths, self.width)
        return Ragged(content[spread(starts, lengths)], cumulative(lengths))

    def decode(self) -> None:
        """Turn what waits into columns; of a channel with a problem, only times."""
        if not self.times:
            return
        times, payloads = np.concatenate(self.times), _together(self.waiting)
        self.waiting, self.times, self.n_waiting = [], [], 0
        self.add_times(times)
        if self.take is None:
            return
        columns: dict[str, Column] = {}
        if self.problem is None:
            try:
                columns, kept = self.take.decode(payloads)
                times = times[kept]
                self.lost += int((~kept).sum())
            except ReadError as error:
                self.problem, self.width = error, 0
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
