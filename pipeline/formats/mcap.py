# SPDX-License-Identifier: Apache-2.0
"""MCAP files to bytes by channel: no loop over messages, nothing of a file believed.

A chunk is unpacked on another thread, its message index says where the messages begin, and one
index into overlapping records copies a channel's bytes.  Damage costs what it touches and leaves a
`Finding`.
"""

import mmap
from collections import deque
from collections.abc import Callable, Container, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import ReadError
from pipeline.formats.gathering import Count, Gathered, Messages, Take
from pipeline.formats.mcap_chunks import Chunk, Contents, locate, unpack
from pipeline.formats.mcap_layout import Channel, Layout, find_layout
from pipeline.formats.mcap_records import MAGIC, MESSAGE_HEAD, DamagedError
from pipeline.tables import Finding

_AHEAD = 2  #: groups of chunks that are unpacked before they are needed
_GROUP_BYTES = 1 << 22
_Items = list[Chunk | Contents]

_LEAST = MESSAGE_HEAD.itemsize  #: bytes that a message takes at least
_MOST = 1 << 22  #: messages for which room is made on the summary's word


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


class _Reader:
    """One pass over the chunks of a file."""

    def __init__(self, layout: Layout, select: Callable[[Channel], Take | None]) -> None:
        self.layout, self.select = layout, select
        self.room = sum(
            item.size if isinstance(item, Chunk) else len(item.bytes) for item in layout.plan
        )
        self.gathered: dict[int, Gathered] = {}
        self.nameless: dict[int, int] = {}  #: messages of channels that no record names

    def read(self) -> None:
        """Unpack chunks, some ahead on other threads, and copy what is wanted of each."""
        with ThreadPoolExecutor(max_workers=2) as pool:
            waiting: deque[tuple[_Items, Future[list[Contents | DamagedError]]]] = deque()
            for items in self._groups():
                waiting.append((items, pool.submit(_opened, items, self.layout.channels)))
                if len(waiting) > _AHEAD:
                    self._take(*waiting.popleft())
            while waiting:
                self._take(*waiting.popleft())
        for mine in self.gathered.values():
            mine.decode()
        self._compare_with_statistics()

    def _groups(self) -> Iterator[_Items]:
        """Chunks that are wanted, some megabytes together: handing work over costs too."""
        group: _Items = []
        room = 0
        for item in self.layout.plan:
            if isinstance(item, Chunk):
                if self._skip(item):
                    continue
                room += item.size
            group.append(item)
            if room >= _GROUP_BYTES:
                yield group
                group, room = [], 0
        yield group

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

    def _take(self, items: _Items, job: Future[list[Contents | DamagedError]]) -> None:
        for item, found in zip(items, job.result(), strict=True):
            if isinstance(item, Contents):
                self._gather(item)
            elif isinstance(found, DamagedError):
                self.layout.find("chunk left out", f"chunk at byte {item.start}", str(found))
            else:
                self._take_chunk(item, found)

    def _take_chunk(self, chunk: Chunk, found: Contents) -> None:
        for opcode, body in found.records:
            self.layout.take(opcode, chunk.start, body)
        if found.damage and not chunk.cut:
            where = f"chunk at byte {chunk.start}"
            self.layout.find("damaged chunk", where, f"{found.damage}; read up to there")
        self._gather(found)

    def _gathered(self, number: int) -> Gathered | None:
        if number not in self.gathered:
            channel = self.layout.channel(number)
            if channel is None:
                return None
            hint = min(self.layout.expected.get(number, 0), self.room // _LEAST, _MOST)
            self.gathered[number] = Gathered(self.select(channel), hint)
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


def _opened(items: _Items, known: Container[int]) -> list[Contents | DamagedError]:
    """Unpack each chunk and find its messages, while its bytes are in this thread's cache.

    Damage is returned, not raised, as the others are still good.
    """
    found: list[Contents | DamagedError] = []
    for item in items:
        try:
            if isinstance(item, Chunk):
                found.append(locate(item, unpack(item), known))
            else:
                found.append(item)
        except DamagedError as error:
            found.append(error)
    return found
