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
from pipeline.formats.gathering import UNKNOWN, Batch, Count, Gathered, Messages, Take
from pipeline.formats.mcap_chunks import Chunk, Contents, locate, room_for, unpack
from pipeline.formats.mcap_layout import Channel, Layout, find_layout
from pipeline.formats.mcap_records import INDEX_ENTRY, MAGIC, MESSAGE_HEAD, DamagedError
from pipeline.tables import Finding

_AHEAD = 2  #: groups of chunks that are unpacked before they are needed
_GROUP_BYTES = 1 << 24
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
            item.size if isinstance(item, Chunk) else len(item.content) for item in layout.plan
        )
        self.gathered: dict[int, Gathered] = {}
        self.nameless: dict[int, int] = {}  #: messages of channels that no record names

    def read(self) -> None:
        """Open groups of chunks, some ahead on other threads, and collect what they hold."""
        rooms: list[NDArray[np.uint8]] = []
        self._meet_channels()
        with ThreadPoolExecutor(max_workers=2) as pool:
            waiting: deque[Future[_Opened]] = deque()
            for items in self._groups():
                wanted = {number: (mine.take, mine.width) for number, mine in self.gathered.items()}
                waiting.append(pool.submit(_open, items, wanted, rooms))
                if len(waiting) > _AHEAD:
                    self._collect(waiting.popleft().result())
            while waiting:
                self._collect(waiting.popleft().result())
        for mine in self.gathered.values():
            mine.decode()
        self._compare_with_statistics()

    def _groups(self) -> Iterator[_Items]:
        """Chunks that are wanted, some megabytes together: each group has its own costs."""
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
        mine = [self.gathered.get(number) for number in chunk.index]
        if not (self.layout.expected and mine and all(m and m.take is None for m in mine)):
            return False
        for number, parts in chunk.index.items():
            entries = np.frombuffer(b"".join(parts), INDEX_ENTRY)
            self.gathered[number].add_times(entries["log_time"].astype(np.int64))
        return True

    def _collect(self, opened: "_Opened") -> None:
        for opcode, start, body in opened.records:
            self.layout.take(opcode, start, memoryview(body))
        self._meet_channels()
        for what, start, detail in opened.damage:
            self.layout.find(what, f"chunk at byte {start}", detail)
        for number, batch in opened.batches.items():
            if number in self.gathered:
                self.gathered[number].add(batch)
            else:
                lost = sum(map(len, batch.times))
                self.nameless[number] = self.nameless.get(number, 0) + lost

    def _meet_channels(self) -> None:
        """Ask what is wanted of channels that have become known."""
        for number in self.layout.channels:
            channel = self.layout.channel(number)
            if channel and number not in self.gathered:
                hint = min(self.layout.expected.get(number, 0), self.room // _LEAST, _MOST)
                self.gathered[number] = Gathered(self.select(channel), hint)

    def _compare_with_statistics(self) -> None:
        """Say which channels hold another number of messages than the summary promises."""
        for number, promised in sorted(self.layout.expected.items()):
            mine, channel = self.gathered.get(number), self.layout.channel(number)
            found = mine.count.messages if mine else 0
            if found != promised and channel:
                self.layout.find("messages missing", channel.topic, f"{found} of {promised} found")
        for number, lost in sorted(self.nameless.items()):
            self.layout.find("unknown channel", f"channel {number}", f"{lost} messages left out")


@dataclass
class _Opened:
    """What a group of chunks holds, in memory of its own."""

    batches: dict[int, Batch] = field(default_factory=dict)  #: by channel
    records: list[tuple[int, int, bytes]] = field(default_factory=list)  #: opcode, place, body
    damage: list[tuple[str, int, str]] = field(default_factory=list)  #: what, place, detail


def _open(
    items: _Items,
    wanted: Mapping[int, tuple[Take | None, int | None]],
    rooms: list[NDArray[np.uint8]],
) -> _Opened:
    """Unpack each chunk, and copy what is wanted while its bytes are in this core's cache.

    Chunks are unpacked into memory that `rooms` lends: new memory costs as much as unpacking.
    Damage is returned, not raised, as the others are still good.
    """
    opened = _Opened()
    need = max((room_for(item) for item in items if isinstance(item, Chunk)), default=0)
    try:
        room = rooms.pop()
    except IndexError:  # all are lent; to look first would be a race
        room = np.empty(need, np.uint8)
    if len(room) < need:
        room = np.empty(need, np.uint8)
    for item in items:
        found = _opened_chunk(item, room, opened) if isinstance(item, Chunk) else item
        for number, rows in found.messages.items():
            if number not in opened.batches:
                opened.batches[number] = Batch(*wanted.get(number, (UNKNOWN, None)))
            opened.batches[number].add(found.content, rows)
    rooms.append(room)
    for batch in opened.batches.values():
        if batch.take and batch.take.typed:
            batch.decode()
    return opened


def _opened_chunk(chunk: Chunk, room: NDArray[np.uint8], opened: _Opened) -> Contents:
    """Unpack a chunk, and find its messages; other records and damage go to `opened`."""
    try:
        found = locate(chunk, room[: unpack(chunk, room.data)])
    except DamagedError as error:
        opened.damage.append(("chunk left out", chunk.start, str(error)))
        return Contents(room[:0])
    opened.records += [(opcode, chunk.start, body) for opcode, body in found.records]
    if found.damage and not chunk.cut:
        detail = f"{found.damage}; read up to there"
        opened.damage.append(("damaged chunk", chunk.start, detail))
    return found
