# SPDX-License-Identifier: Apache-2.0
"""MCAP files to bytes by channel: no loop over messages, nothing of a file believed.

A chunk is unpacked on another thread, its message index says where the messages begin, and one
index into overlapping records copies a channel's bytes.  Damage costs what it touches and leaves a
`Finding`.
"""

import mmap
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.mcap_chunks import Chunk, Contents, locate, unpack
from pipeline.formats.mcap_layout import Channel, Layout, find_layout
from pipeline.formats.mcap_records import MAGIC, MESSAGE_FIELDS, MESSAGE_HEAD, DamagedError
from pipeline.formats.ragged import Column, Growing, Ragged, concat, cumulative, runs, spread
from pipeline.tables import Bool, Finding, Int

_LOG_TIME = ""  #: name beside dotted paths
_AHEAD = 3  #: chunks that are unpacked before they are needed

_BATCH = 1 << 14  #: messages that are decoded together, while their bytes are in the cache
_LEAST = MESSAGE_HEAD.itemsize  #: bytes that a message takes at least


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


@dataclass(frozen=True, eq=False)
class Recording:
    """What one file holds."""

    channels: tuple[Channel, ...]
    counts: dict[int, Count]  #: by channel, of all channels with messages
    messages: tuple[Messages, ...]  #: of the channels selected
    findings: tuple[Finding, ...]


def read_mcap(path: Path, select: Callable[[Channel], Take | None]) -> Recording:
    """Messages of the channels that `select` wants, and what else the file holds.

    Raises
    ------
    ReadError
        The file cannot be opened, or does not begin as MCAP does.
    """
    with mapped(path) as buffer:
        reader = _Reader(find_layout(path.name, buffer), select)
        reader.read()
    return reader.recording()


@contextmanager
def mapped(path: Path) -> Iterator[memoryview]:
    """Bytes of an MCAP file, read as they are touched.

    Raises
    ------
    ReadError
        The file cannot be opened, or does not begin as MCAP does.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
            if start != MAGIC:
                raise ReadError(f"{path}: not MCAP: it begins with {start!r}, not {MAGIC!r}")
            # not closed: it goes with the last array that looks into it
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise ReadError(f"{path}: cannot be read: {error.strerror}") from None
    yield data


@dataclass
class _Gathered:
    """A channel's messages so far: columns, and payloads that wait for more."""

    take: Take | None
    hint: int
    count: Count = Count(0, 0, 0)
    width: int = -1  #: bytes wanted of each payload
    waiting: list[Ragged] = field(default_factory=list)
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
        times = heads["log_time"].astype(np.int64)
        self.add_times(times)
        if self.take is None:
            return
        starts = offsets + MESSAGE_HEAD.itemsize
        lengths = heads["length"].astype(np.int64) - MESSAGE_FIELDS
        if self.width < 0:
            try:
                self.width = self.take.extent(content[starts[0] : starts[0] + lengths[0]])
            except ReadError as error:
                self.problem, self.width = error, 0
        self.complete &= int(lengths.max()) <= self.width
        self.times.append(times)
        self.waiting.append(_payloads(content, starts, np.minimum(lengths, self.width)))
        self.n_waiting += len(times)
        if self.n_waiting >= _BATCH:
            self.decode()

    def decode(self) -> None:
        """Turn what waits into columns; of a channel with a problem, only times."""
        if self.take is None or not self.waiting:
            return
        payloads, times = concat(self.waiting), np.concatenate(self.times)
        self.waiting, self.times, self.n_waiting = [], [], 0
        assert isinstance(payloads, Ragged)
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
        self.decode()
        columns = self.grown.columns()
        times = np.asarray(columns.pop(_LOG_TIME))
        columns = {} if self.problem else columns
        return Messages(channel, times, columns, self.lost, self.complete, self.problem)


class _Reader:
    """One pass over the chunks of a file."""

    def __init__(self, layout: Layout, select: Callable[[Channel], Take | None]) -> None:
        self.layout, self.select = layout, select
        self.room = sum(
            item.size if isinstance(item, Chunk) else len(item.bytes) for item in layout.plan
        )
        self.gathered: dict[int, _Gathered] = {}
        self.nameless: dict[int, int] = {}  #: messages of channels that no record names

    def read(self) -> None:
        """Unpack chunks, some ahead on another thread, and copy what is wanted of each."""
        with ThreadPoolExecutor(max_workers=2) as pool:
            waiting: deque[tuple[Chunk | Contents, Future[NDArray[np.uint8]]]] = deque()
            for item in self.layout.plan:
                if isinstance(item, Chunk) and self._skip(item):
                    continue
                waiting.append((item, pool.submit(_bytes_of, item)))
                if len(waiting) > _AHEAD:
                    self._take(*waiting.popleft())
            while waiting:
                self._take(*waiting.popleft())
        self._compare_with_statistics()

    def recording(self) -> Recording:
        """Return all that was gathered."""
        channels = [c for c in map(self.layout.channel, sorted(self.layout.channels)) if c]
        found = [
            (channel, self.gathered[channel.id])
            for channel in channels
            if channel.id in self.gathered and self.gathered[channel.id].count.messages
        ]
        return Recording(
            tuple(channels),
            {channel.id: mine.count for channel, mine in found},
            tuple(mine.messages(channel) for channel, mine in found if mine.take),
            tuple(self.layout.findings),
        )

    def _skip(self, chunk: Chunk) -> bool:
        """Count a chunk's messages by its index when none is wanted and none can be hidden."""
        mine = [self._gathered(number) for number in chunk.index]
        if not (self.layout.expected and mine and all(m and m.take is None for m in mine)):
            return False
        for number, parts in chunk.index.items():
            for entries in parts:
                self.gathered[number].add_times(entries["log_time"].view(np.int64))
        return True

    def _take(self, item: Chunk | Contents, job: "Future[NDArray[np.uint8]]") -> None:
        if isinstance(item, Contents):
            self._gather(item)
            return
        where = f"chunk at byte {item.start}"
        try:
            found = locate(item, job.result(), self.layout.channels)
        except DamagedError as error:
            self.layout.find("chunk left out", where, str(error))
            return
        for opcode, body in found.records:
            self.layout.take(opcode, item.start, body)
        if found.damage and not item.cut:
            self.layout.find("damaged chunk", where, f"{found.damage}; read up to there")
        self._gather(found)

    def _gathered(self, number: int) -> "_Gathered | None":
        if number not in self.gathered:
            channel = self.layout.channel(number)
            if channel is None:
                return None
            hint = min(self.layout.expected.get(number, 0), self.room // _LEAST)
            self.gathered[number] = _Gathered(self.select(channel), hint)
        return self.gathered[number]

    def _gather(self, contents: Contents) -> None:
        """Copy the bytes wanted of every channel."""
        for number, (offsets, heads) in contents.messages.items():
            mine = self._gathered(number)
            if mine is None:
                self.nameless[number] = self.nameless.get(number, 0) + len(offsets)
                continue
            mine.add(contents.bytes, offsets, heads)

    def _compare_with_statistics(self) -> None:
        """Say which channels hold another number of messages than the summary promises."""
        for number, promised in sorted(self.layout.expected.items()):
            mine, channel = self.gathered.get(number), self.layout.channel(number)
            found = mine.count.messages if mine else 0
            if found != promised and channel:
                self.layout.find("messages missing", channel.topic, f"{found} of {promised} found")
        for number, lost in sorted(self.nameless.items()):
            self.layout.find("unknown channel", f"channel {number}", f"{lost} messages left out")


def _bytes_of(item: Chunk | Contents) -> NDArray[np.uint8]:
    return unpack(item) if isinstance(item, Chunk) else item.bytes


def _payloads(content: NDArray[np.uint8], starts: Int, lengths: Int) -> Ragged:
    if (lengths == lengths[0]).all():
        found = runs(content, starts, int(lengths[0]))
        return Ragged.regular(found.view(np.uint8).reshape(len(starts), int(lengths[0])))
    return Ragged(content[spread(starts, lengths)], cumulative(lengths))
