# SPDX-License-Identifier: Apache-2.0
"""MCAP files to bytes by channel: no loop over messages, nothing of a file believed.

A few chunks at a time are unpacked on another thread, their message indexes say where the messages
begin, and one index into overlapping records copies a channel's bytes.  Damage costs what it touches
and leaves a `Finding`.
"""

import mmap
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.gathering import PAYLOADS, Count, Gathered, Messages, Piece, Source, Take
from pipeline.formats.mcap_chunks import Chunk, Contents, locate, room_for, unpack
from pipeline.formats.mcap_layout import Channel, Layout, find_layout
from pipeline.formats.mcap_records import INDEX_ENTRY, MAGIC, MESSAGE_HEAD, DamagedError
from pipeline.tables import Finding

_AHEAD = 2  #: stretches that are opened before they are needed
_STRETCH_BYTES = 1 << 22  #: more of them cost more each, larger ones leave the processor's cache
_Stretch = list[Chunk] | Contents

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
        """Open stretches of the file, some ahead on other threads, and collect what they hold."""
        rooms: list[NDArray[np.uint8]] = []
        self._meet_channels()
        with ThreadPoolExecutor(max_workers=2) as pool:
            waiting: deque[Future[_Opened]] = deque()
            for stretch in self._stretches():
                sources = {number: mine.source for number, mine in self.gathered.items()}
                waiting.append(pool.submit(_open, stretch, sources, rooms))
                if len(waiting) > _AHEAD:
                    self._collect(waiting.popleft().result())
            while waiting:
                self._collect(waiting.popleft().result())
        for mine in self.gathered.values():
            mine.decode()
        self._compare_with_statistics()

    def _stretches(self) -> Iterator[_Stretch]:
        """Chunks that are wanted, some together, as each stretch has its own costs."""
        chunks: list[Chunk] = []
        room = 0
        for item in self.layout.plan:
            if isinstance(item, Chunk) and self._skip(item):
                continue
            full = not isinstance(item, Chunk) or room + room_for(item) > _STRETCH_BYTES
            if chunks and full:
                yield chunks
                chunks, room = [], 0
            if isinstance(item, Chunk):
                chunks.append(item)
                room += room_for(item)
            else:
                yield item
        if chunks:
            yield chunks

    def recording(self) -> Recording:
        """Return all that was gathered."""
        channels = [c for c in map(self.layout.channel, sorted(self.layout.channels)) if c]
        found = [
            (channel, self.gathered[channel.id])
            for channel in channels
            if channel.id in self.gathered and len(self.gathered[channel.id].log_time_ns)
        ]
        return Recording(
            tuple(channels),
            {channel.id: mine.count() for channel, mine in found},
            tuple(mine.messages(channel) for channel, mine in found if mine.source.take),
            tuple(self.layout.findings),
        )

    def _skip(self, chunk: Chunk) -> bool:
        """Count a chunk's messages by its index when none is wanted and none can be hidden."""
        mine = [self.gathered.get(number) for number in chunk.index]
        if not (self.layout.expected and mine and all(m and m.source.take is None for m in mine)):
            return False
        for number, parts in chunk.index.items():
            entries = np.frombuffer(b"".join(parts), INDEX_ENTRY)
            self.gathered[number].times.append(entries["log_time"].astype(np.int64))
        return True

    def _collect(self, opened: "_Opened") -> None:
        for opcode, start, body in opened.records:
            self.layout.take(opcode, start, memoryview(body))
        self._meet_channels()
        for what, start, detail in opened.damage:
            self.layout.find(what, f"chunk at byte {start}", detail)
        for number, piece in opened.pieces:
            if number in self.gathered:
                self.gathered[number].add(piece)
            else:
                lost = len(piece.log_time_ns)
                self.nameless[number] = self.nameless.get(number, 0) + lost

    def _meet_channels(self) -> None:
        """Ask what is wanted of channels that have become known."""
        for number in self.layout.channels:
            channel = self.layout.channel(number)
            if channel and number not in self.gathered:
                hint = min(self.layout.expected.get(number, 0), self.room // _LEAST, _MOST)
                self.gathered[number] = Gathered(Source(self.select(channel)), hint)

    def _compare_with_statistics(self) -> None:
        """Say which channels hold another number of messages than the summary promises."""
        for number, promised in sorted(self.layout.expected.items()):
            mine, channel = self.gathered.get(number), self.layout.channel(number)
            found = len(mine.log_time_ns) if mine else 0
            if found != promised and channel:
                self.layout.find("messages missing", channel.topic, f"{found} of {promised} found")
        for number, lost in sorted(self.nameless.items()):
            self.layout.find("unknown channel", f"channel {number}", f"{lost} messages left out")


@dataclass
class _Opened:
    """What a stretch holds, in memory of its own."""

    pieces: list[tuple[int, Piece]] = field(default_factory=list)  #: by channel
    records: list[tuple[int, int, bytes]] = field(default_factory=list)  #: opcode, place, body
    damage: list[tuple[str, int, str]] = field(default_factory=list)  #: what, place, detail


def _open(
    stretch: _Stretch, sources: Mapping[int, Source], rooms: list[NDArray[np.uint8]]
) -> _Opened:
    """Unpack chunks, and copy what is wanted while their bytes are in this core's cache.

    Chunks are unpacked into memory that `rooms` lends: new memory costs as much as unpacking.
    Damage is returned, not raised, as the others are still good.
    """
    opened = _Opened()
    if isinstance(stretch, Contents):
        found, room = stretch, None
    else:
        room = _room(rooms, sum(map(room_for, stretch)))
        found = _unpacked(stretch, room, opened)
    for number, rows in found.messages:
        source = sources.get(number) or Source(PAYLOADS)
        opened.pieces.append((number, source.piece(found.content, rows)))
    if room is not None:
        rooms.append(room)
    return opened


def _room(rooms: list[NDArray[np.uint8]], need: int) -> NDArray[np.uint8]:
    try:
        room = rooms.pop()
    except IndexError:  # all are lent; to look first would be a race
        return np.empty(need, np.uint8)
    return room if len(room) >= need else np.empty(need, np.uint8)


def _unpacked(chunks: list[Chunk], room: NDArray[np.uint8], opened: _Opened) -> Contents:
    """Unpack chunks one behind the other and find their messages; the rest goes to `opened`."""
    good: list[Chunk] = []
    ends: list[int] = []
    at = 0
    for chunk in chunks:
        try:
            at += unpack(chunk, room[at:].data)
        except DamagedError as error:
            opened.damage.append(("chunk left out", chunk.start, str(error)))
            continue
        good.append(chunk)
        ends.append(at)
    if not good:
        return Contents(room[:0])
    found = locate(good, ends, room[:at])
    starts = [good[bisect_right(ends, place)].start for _, place, _ in found.records]
    opened.records += [(o, start, body) for (o, _, body), start in zip(found.records, starts)]
    for number, damage in found.damage:
        if not good[number].cut:
            detail = f"{damage}; read up to there"
            opened.damage.append(("damaged chunk", good[number].start, detail))
    return found
