# SPDX-License-Identifier: Apache-2.0
"""MCAP files to bytes by channel: no loop over messages, nothing of a file believed.

A few chunks at a time are unpacked, their message indexes say where the messages begin, and one
index into overlapping records copies a channel's bytes.  Damage costs what it touches and leaves a
`Finding`.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Container, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import printable
from abyssnav.formats.mcap.accumulator import ChannelAccumulator, ChannelDecoder, Count, Messages
from abyssnav.formats.mcap.chunks import Chunk, Contents, locate, room_for, unpack
from abyssnav.formats.mcap.container import mapped
from abyssnav.formats.mcap.file_index import Channel, FileIndex, index_file
from abyssnav.formats.mcap.records import INDEX_ENTRY, MESSAGE_HEAD, CorruptRecordError
from abyssnav.tables import Finding

_THREADS = 2  #: that unpack; more would wait for each other
_AHEAD = 3  #: stretches that are given to them before they are needed
_STRETCH_BYTES = 1 << 22  #: more of them cost more each, larger ones leave the processor's cache
_Stretch = list[Chunk] | Contents
#: What is wanted of a channel; None: nothing but its number of messages.
Select = Callable[[Channel], ChannelDecoder | None]

_LEAST = MESSAGE_HEAD.itemsize  #: bytes that a message takes at least
_MOST = 1 << 22  #: messages for which room is made on the summary's word


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
    damage: list[str] = []
    with mapped(path, damage) as buffer:
        index = index_file(printable(path.name), buffer)
        for detail in damage:
            index.add_finding("damaged packing", "as a whole", detail)
        return _Reader(index, select).read()


class _Reader:
    """One pass over the chunks of a file."""

    def __init__(
        self, index: FileIndex, select: Callable[[Channel], ChannelDecoder | None]
    ) -> None:
        self.index, self.select = index, select
        self.room = sum(
            item.size if isinstance(item, Chunk) else len(item.content) for item in index.plan
        )
        self.accumulators: dict[int, ChannelAccumulator] = {}
        self.nameless: dict[int, int] = {}  #: messages of channels that no record names
        #: To unpack into, lent: new memory costs as much as unpacking.
        self.rooms: list[NDArray[np.uint8]] = []

    def read(self) -> Recording:
        """Take one stretch of the file after the other, unpacked side by side."""
        self._add_channels()
        waiting: deque[Future[None]] = deque()
        with ThreadPoolExecutor(max_workers=_THREADS) as pool:
            for stretch in self._stretches():
                before = waiting[-1] if waiting else None
                waiting.append(pool.submit(self._work, stretch, before))
                if len(waiting) > _AHEAD:
                    waiting.popleft().result()
            while waiting:
                waiting.popleft().result()
            for accumulator in self.accumulators.values():
                accumulator.decode()
            self._compare_with_statistics()
            self.index.note_missing_checksums()
            channels = [c for c in map(self.index.channel, sorted(self.index.channels)) if c]
            contents = [
                (channel, self.accumulators[channel.id])
                for channel in channels
                if channel.id in self.accumulators
                and len(self.accumulators[channel.id].log_time_ns)
            ]
            messages = pool.map(lambda pair: pair[1].messages(pair[0]), contents)
            return Recording(
                tuple(channels),
                {channel.id: accumulator.count() for channel, accumulator in contents},
                tuple(part for part in messages if part),
                self.index.findings,
            )

    def _work(self, stretch: _Stretch, before: Future[None] | None) -> None:
        """Unpack a stretch, and take it when the one before is taken.

        Who has unpacked takes, as the bytes are in that core's cache; and one at a time, as NumPy's
        small steps on two threads spend more on Python's lock than they gain.
        """
        try:
            room = self.rooms.pop()
        except IndexError:  # all are lent; to look first would be a race
            room = np.empty(0, np.uint8)
        opened = _open(stretch, room)
        if before:
            before.result()
        self._take(opened)
        self.rooms.append(opened.room)

    def _stretches(self) -> Iterator[_Stretch]:
        """Chunks that are wanted, some together, as each stretch has its own costs."""
        chunks: list[Chunk] = []
        room = 0
        for item in self.index.plan:
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

    def _skip(self, chunk: Chunk) -> bool:
        """Count a chunk's messages by its index when none is wanted and none can be hidden.

        Nor may it name a channel that is still nameless.
        """
        inside = [self.accumulators.get(number) for number in chunk.index]
        numbers = self.index.channels.keys() | self.index.expected.keys()
        in_summary = self.index.chunks.get(chunk.start)
        if (
            not (self.index.expected and inside and all(a and a.decoder is None for a in inside))
            or (in_summary and in_summary.channels) != chunk.index.keys()
            or not numbers <= self.accumulators.keys()
        ):
            return False
        for number, parts in chunk.index.items():
            entries = np.frombuffer(b"".join(parts), INDEX_ENTRY)
            self.accumulators[number].times.append(entries["log_time"].astype(np.int64))
        return True

    def _take(self, opened: "_Opened") -> None:
        """Take records first, as they name the channels of messages."""
        contents = opened.contents()
        for opcode, start, body in contents.records:
            self.index.add_record(opcode, opened.chunk_at(start), memoryview(body))
        self._add_channels({number for number, _ in contents.messages})
        for start, detail in opened.left_out:
            self.index.add_finding("chunk left out", f"chunk at byte {start}", detail)
        for number, damage in contents.damage:
            chunk = opened.chunks[number]
            if not chunk.cut:
                where = f"chunk at byte {chunk.start}"
                self.index.add_finding("damaged chunk", where, f"{damage}; read up to there")
        for number, rows in contents.messages:
            if number in self.accumulators:
                self.accumulators[number].add(contents.content, rows)
            else:
                lost = len(rows.starts)
                self.nameless[number] = self.nameless.get(number, 0) + lost

    def _add_channels(self, with_messages: Container[int] = ()) -> None:
        """Ask what is wanted of channels that have become known, with their schemas or messages."""
        for number in self.index.channels.keys() - self.accumulators.keys():
            channel = self.index.channel(number)
            if channel and (self.index.is_named(number) or number in with_messages):
                hint = min(self.index.expected.get(number, 0), self.room // _LEAST, _MOST)
                self.accumulators[number] = ChannelAccumulator(
                    self.select(channel), hint, self.room
                )

    def _compare_with_statistics(self) -> None:
        """Say which channels hold another number of messages than the summary promises."""
        for number, promised in sorted(self.index.expected.items()):
            accumulator, channel = self.accumulators.get(number), self.index.channel(number)
            contents = len(accumulator.log_time_ns) if accumulator else 0
            if contents != promised and channel:
                self.index.add_finding(
                    "messages missing", channel.topic, f"{contents} of {promised} found"
                )
        for number, lost in sorted(self.nameless.items()):
            self.index.add_finding(
                "unknown channel", f"channel {number}", f"{lost} messages left out"
            )


@dataclass
class _Opened:
    """Chunks one behind the other in lent memory, or bytes that needed no unpacking."""

    room: NDArray[np.uint8]
    loose: Contents | None = None
    chunks: list[Chunk] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    left_out: list[tuple[int, str]] = field(default_factory=list)  #: chunks: place, why

    def contents(self) -> Contents:
        """Return where the messages are."""
        if self.loose:
            return self.loose
        content = self.room[: self.ends[-1]] if self.ends else self.room[:0]
        return locate(self.chunks, self.ends, content) if self.chunks else Contents(content)

    def chunk_at(self, place: int) -> int:
        """Return where in the file the chunk lies that a place in the content is of."""
        return self.chunks[bisect_right(self.ends, place)].start


def _open(stretch: _Stretch, room: NDArray[np.uint8]) -> _Opened:
    """Unpack chunks; damage is returned, not raised, as the others are still good."""
    if isinstance(stretch, Contents):
        return _Opened(room, stretch)
    need = sum(map(room_for, stretch))
    opened = _Opened(room if len(room) >= need else np.empty(need, np.uint8))
    position = 0
    for chunk in stretch:
        try:
            position += unpack(chunk, opened.room[position:].data)
        except CorruptRecordError as error:
            opened.left_out.append((chunk.start, str(error)))
            continue
        opened.chunks.append(chunk)
        opened.ends.append(position)
    return opened
