# SPDX-License-Identifier: Apache-2.0
"""MCAP files to bytes by channel: no loop over messages, nothing of a file believed.

A chunk is unpacked on another thread, its message index says where the messages begin, and one
index into overlapping records copies a channel's bytes.  Damage costs what it touches and leaves a
`Finding`.
"""

import mmap
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.mcap_chunks import Chunk, Contents, locate, runs, unpack
from pipeline.formats.mcap_layout import Channel, Layout, find_layout
from pipeline.formats.mcap_records import MAGIC, MESSAGE_FIELDS, MESSAGE_HEAD, DamagedError
from pipeline.formats.ragged import Ragged, concat, cumulative, spread
from pipeline.tables import Finding, Int

_AHEAD = 3  #: chunks that are unpacked before they are needed

#: Bytes of a payload that are wanted, told from a channel's first payload.
Extent = Callable[[NDArray[np.uint8]], int]
#: Whether and how much of a channel is wanted.
Select = Callable[[Channel], Extent | None]


def whole(_: NDArray[np.uint8]) -> int:
    """Extent of channels that are wanted to their last byte."""
    return 1 << 62


@dataclass(frozen=True, eq=False)
class Messages:
    """What was wanted of a channel, in the file's order."""

    channel: Channel
    log_time_ns: Int
    payloads: Ragged
    complete: bool  #: False: payloads may have been cut to the extent asked for


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


def read_mcap(path: Path, select: Select) -> Recording:
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
    """A channel's messages so far."""

    extent: Extent | None
    width: int = -1  #: bytes wanted of each payload
    times: list[Int] = field(default_factory=list)
    payloads: list[Ragged] = field(default_factory=list)
    count: Count = Count(0, 0, 0)

    def add(self, log_time_ns: Int) -> None:
        """Count messages; keep their times when they are wanted."""
        if not len(log_time_ns):
            return
        first, last = int(log_time_ns.min()), int(log_time_ns.max())
        if self.count.messages:
            first, last = min(first, self.count.first_ns), max(last, self.count.last_ns)
        self.count = Count(self.count.messages + len(log_time_ns), first, last)
        if self.extent:
            self.times.append(log_time_ns.copy())

    def messages(self, channel: Channel) -> Messages:
        """Return what was gathered."""
        payloads = concat(self.payloads)
        assert isinstance(payloads, Ragged)
        complete = int(payloads.lengths.max(initial=0)) < self.width
        return Messages(channel, np.concatenate(self.times), payloads, complete)


class _Reader:
    """One pass over the chunks of a file."""

    def __init__(self, layout: Layout, select: Select) -> None:
        self.layout, self.select = layout, select
        self.gathered: dict[int, _Gathered] = {}
        self.nameless: dict[int, int] = {}  #: messages of channels that no record names

    def read(self) -> None:
        """Unpack chunks, some ahead on another thread, and copy what is wanted of each."""
        with ThreadPoolExecutor(max_workers=1) as pool:
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
        found = [(c, self.gathered[c.id]) for c in channels if c.id in self.gathered]
        return Recording(
            tuple(channels),
            {channel.id: mine.count for channel, mine in found},
            tuple(mine.messages(channel) for channel, mine in found if mine.extent),
            tuple(self.layout.findings),
        )

    def _skip(self, chunk: Chunk) -> bool:
        """Count a chunk's messages by its index when none is wanted and none can be hidden."""
        counted = {number: np.concatenate(parts) for number, parts in chunk.index.items()}
        mine = [self._gathered(number) for number in counted]
        if not (self.layout.expected and mine and all(m and m.extent is None for m in mine)):
            return False
        for number, entries in counted.items():
            self.gathered[number].add(entries["log_time"].view(np.int64))
        return True

    def _take(self, item: Chunk | Contents, job: "Future[NDArray[np.uint8]]") -> None:
        if isinstance(item, Contents):
            self._gather(item)
            return
        where = f"chunk at byte {item.start}"
        try:
            found = locate(item, job.result(), set(self.layout.channels))
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
            self.gathered[number] = _Gathered(self.select(channel))
        return self.gathered[number]

    def _gather(self, contents: Contents) -> None:
        """Copy the bytes wanted of every channel."""
        for number, offsets in contents.offsets.items():
            mine = self._gathered(number)
            if mine is None:
                self.nameless[number] = self.nameless.get(number, 0) + len(offsets)
                continue
            heads = contents.heads(number)
            mine.add(heads["log_time"].view(np.int64))
            if mine.extent is None:
                continue
            lengths = heads["length"].view(np.int64) - MESSAGE_FIELDS
            starts = offsets + MESSAGE_HEAD.itemsize
            if mine.width < 0:
                mine.width = mine.extent(contents.bytes[starts[0] : starts[0] + lengths[0]])
            mine.payloads.append(_payloads(contents.bytes, starts, lengths, mine.width))

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


def _payloads(content: NDArray[np.uint8], starts: Int, lengths: Int, width: int) -> Ragged:
    """At most `width` bytes of each payload."""
    lengths = np.minimum(lengths, width)
    if (lengths == lengths[0]).all():
        found = runs(content, starts, int(lengths[0]))
        return Ragged.regular(found.view(np.uint8).reshape(len(starts), int(lengths[0])))
    return Ragged(content[spread(starts, lengths)], cumulative(lengths))
