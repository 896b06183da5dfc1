# SPDX-License-Identifier: Apache-2.0
"""MCAP files to bytes by channel: no loop over messages, nothing of a file believed.

The chunks are found by walking over the file's records; the summary only adds what its own CRC
vouches for.  A chunk is unpacked on another thread, its message index says where the messages
begin, and one index into overlapping records copies a channel's bytes.  Damage costs what it
touches and leaves a `Finding`.
"""

import mmap
import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ReadError
from pipeline.formats.mcap_chunks import (
    Chunk,
    Contents,
    locate,
    runs,
    unpack,
    walk,
)
from pipeline.formats.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FOOTER_FIELDS,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    PREFIX,
    SCHEMA,
    STATISTICS,
    DamagedError,
    Fields,
)
from pipeline.formats.ragged import Ragged, concat, cumulative, spread
from pipeline.tables import Finding, Int

_AHEAD = 3  #: chunks that are unpacked before they are needed


@dataclass(frozen=True)
class Channel:
    """A channel with its schema."""

    id: int
    topic: str
    message_encoding: str
    type: str = ""
    schema_encoding: str = ""
    definition: bytes = b""


#: Bytes of a payload that are wanted, told from a channel's first payload.
Extent = Callable[[NDArray[np.uint8]], int]
#: Whether and how much of a channel is wanted.
Select = Callable[[Channel], Extent | None]


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
        file = _File(path.name, buffer, select)
        file.read_summary()
        file.find_chunks()
        for contents in file.contents():
            file.gather(contents)
        file.compare_with_statistics()
        return file.recording()


@contextmanager
def mapped(path: Path) -> Iterator[memoryview]:
    """Bytes of an MCAP file, read as they are touched."""
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
            if start != MAGIC:
                raise ReadError(f"{path}: not MCAP: it begins with {start!r}, not {MAGIC!r}")
            # not closed: it goes with the last array that looks into it
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        yield data
    except OSError as error:
        raise ReadError(f"{path}: cannot be read: {error.strerror}") from None


@dataclass
class _Gathered:
    """A channel's messages so far."""

    extent: Extent | None
    width: int = -1  #: bytes wanted of each payload
    times: list[Int] = field(default_factory=list)
    payloads: list[Ragged] = field(default_factory=list)
    count: Count = Count(0, 0, 0)


class _File:
    """One pass over a file."""

    def __init__(self, name: str, buffer: memoryview, select: Select) -> None:
        self.name, self.buffer, self.select = name, buffer, select
        self.findings: list[Finding] = []
        self.schemas: dict[int, tuple[str, str, bytes]] = {}
        self.channels: dict[int, tuple[int, str, str]] = {}
        self.plan: list[Chunk | Contents] = []
        self.chunk_starts: list[int] = []  #: as the summary has them
        self.expected: dict[int, int] | None = None  #: messages by channel, from the statistics
        self.gathered: dict[int, _Gathered] = {}

    def find(self, what: str, where: str, detail: str) -> None:
        self.findings.append(Finding(what, f"{self.name} {where}".strip(), detail))

    # --- structure ----------------------------------------------------------------------------

    def read_summary(self) -> None:
        """Take channels, chunk places and statistics from a summary whose CRC is right."""
        size, tail = len(self.buffer), PREFIX.size + FOOTER_FIELDS.size + len(MAGIC)
        foot = size - tail
        if foot < len(MAGIC) or bytes(self.buffer[size - len(MAGIC) :]) != MAGIC:
            self.find("cut short", f"at byte {size}", "the file has no end; read to its last byte")
            return
        opcode, _ = PREFIX.unpack_from(self.buffer, foot)
        start, _, crc = FOOTER_FIELDS.unpack_from(self.buffer, foot + PREFIX.size)
        if opcode != FOOTER or start > foot:
            self.find("damaged footer", f"at byte {foot}", "read without the summary")
        elif start and crc and zlib.crc32(self.buffer[start : size - len(MAGIC) - 4]) != crc:
            self.find("damaged summary", f"at byte {start}", "CRC is wrong; read without it")
        elif start:
            self._take_records(start, foot)

    def _take_records(self, at: int, end: int) -> None:
        try:
            for opcode, start, stop in walk(self.buffer, at, end):
                self.take(opcode, start, self.buffer[start + PREFIX.size : stop])
        except DamagedError as error:
            self.find("damaged summary", f"at byte {at}", str(error))

    def take(self, opcode: int, start: int, body: memoryview) -> None:
        """Take one record that is neither message nor chunk."""
        fields = Fields(body)
        try:
            if opcode == SCHEMA:
                number = fields.number("H")
                schema = (fields.text(), fields.text(), bytes(fields.block()))
                self._keep("schema", number, self.schemas.setdefault(number, schema) == schema)
            elif opcode == CHANNEL:
                number, schema_id = fields.numbers("HH")
                channel = (schema_id, fields.text(), fields.text())
                self._keep("channel", number, self.channels.setdefault(number, channel) == channel)
            elif opcode == STATISTICS:
                fields.raw(struct.calcsize("<QHIIIIQQ"))
                pairs = Fields(fields.block())
                self.expected = {}
                while pairs.at < len(pairs.body):
                    number, count = pairs.numbers("HQ")
                    self.expected[number] = count
            elif opcode == CHUNK_INDEX:
                self.chunk_starts.append(fields.numbers("QQQ")[2])
        except DamagedError as error:
            self.find("damaged record", f"at byte {start}", f"opcode {opcode}: {error}")

    def _keep(self, kind: str, number: int, same: bool) -> None:
        if not same:
            self.find(f"conflicting {kind}", f"{kind} {number}", "two records; the first is used")

    def find_chunks(self) -> None:
        """List chunks and messages outside chunks, in the file's order."""
        seen: set[int] = set()
        self._find_chunks_from(len(MAGIC), seen)
        for start in sorted(set(self.chunk_starts) - seen):
            if start not in seen and start < len(self.buffer):
                self.find("lost and found", f"at byte {start}", "chunk reached by the summary only")
                self._find_chunks_from(start, seen)

    def _find_chunks_from(self, at: int, seen: set[int]) -> None:
        size = len(self.buffer)
        end = size - len(MAGIC) if bytes(self.buffer[size - len(MAGIC) :]) == MAGIC else size
        loose: dict[int, list[int]] = {}
        stop = at
        try:
            for opcode, start, stop in walk(self.buffer, at, end):
                if opcode == MESSAGE:
                    self._loose(loose, start, stop)
                elif opcode == CHUNK:
                    if start in seen:
                        break
                    seen.add(start)
                    self._flush(loose)
                    self._chunk(start, self.buffer[start + PREFIX.size : stop])
                elif opcode == MESSAGE_INDEX:
                    self._message_index(start, self.buffer[start + PREFIX.size : stop])
                elif opcode == DATA_END:
                    self._flush(loose)
                    break
                elif opcode in (SCHEMA, CHANNEL):
                    self.take(opcode, start, self.buffer[start + PREFIX.size : stop])
        except DamagedError as error:
            self._flush(loose)
            self.find("cut short", f"at byte {stop}", f"{error}; {size - stop} bytes lost")
            if stop + PREFIX.size <= size and self.buffer[stop] == CHUNK:
                self._chunk(stop, self.buffer[stop + PREFIX.size :], cut=True)
        self._flush(loose)

    def _loose(self, loose: dict[int, list[int]], start: int, stop: int) -> None:
        if stop - start < MESSAGE_HEAD.itemsize:
            self.find("damaged record", f"at byte {start}", f"a message of {stop - start} bytes")
            return
        channel = self.buffer[start + PREFIX.size] | self.buffer[start + PREFIX.size + 1] << 8
        loose.setdefault(channel, []).append(start)

    def _flush(self, loose: dict[int, list[int]]) -> None:
        """Put messages that lie outside chunks into the plan."""
        if loose:
            offsets = {channel: np.array(starts) for channel, starts in loose.items()}
            self.plan.append(Contents(np.frombuffer(self.buffer, np.uint8), offsets))
            loose.clear()

    def _chunk(self, start: int, body: memoryview, cut: bool = False) -> None:
        try:
            self.plan.append(Chunk.parse(start, body, cut))
        except DamagedError as error:
            self.find("chunk left out", f"at byte {start}", str(error))

    def _message_index(self, start: int, body: memoryview) -> None:
        last = self.plan[-1] if self.plan else None
        try:
            fields = Fields(body)
            channel = fields.number("H")
            entries = np.frombuffer(fields.block(), np.uint8)
            if isinstance(last, Chunk) and len(entries) % INDEX_ENTRY.itemsize == 0:
                last.index.setdefault(channel, []).append(entries.view(INDEX_ENTRY))
        except DamagedError as error:
            self.find("damaged index", f"at byte {start}", f"{error}; the chunk is walked")

    # --- contents -----------------------------------------------------------------------------

    def contents(self) -> Iterator[Contents]:
        """Unpack the plan, some chunks ahead of whoever asks."""
        with ThreadPoolExecutor(max_workers=1) as pool:
            waiting: deque[tuple[Chunk | Contents, Future[NDArray[np.uint8]] | None]] = deque()
            plan = iter(self.plan)
            while True:
                for item in plan:
                    job = pool.submit(unpack, item) if isinstance(item, Chunk) else None
                    waiting.append((item, job))
                    if len(waiting) > _AHEAD:
                        break
                if not waiting:
                    return
                item, job = waiting.popleft()
                if isinstance(item, Contents):
                    yield item
                elif job is not None:
                    contents = self._unpacked(item, job)
                    if contents is not None:
                        yield contents

    def _unpacked(self, chunk: Chunk, job: "Future[NDArray[np.uint8]]") -> Contents | None:
        where = f"chunk at byte {chunk.start}"
        try:
            found = locate(chunk, job.result(), set(self.channels))
        except DamagedError as error:
            self.find("chunk left out", where, str(error))
            return None
        for opcode, body in found.records:
            self.take(opcode, chunk.start, body)
        if found.damage and not chunk.cut:
            self.find("damaged chunk", where, f"{found.damage}; read up to there")
        return found

    def gather(self, contents: Contents) -> None:
        """Copy the bytes wanted of every channel in `contents`."""
        for number, offsets in contents.offsets.items():
            heads = contents.heads(number)
            times = heads["log_time"].view(np.int64)
            channel = self._channel(number)
            mine = self.gathered.get(number)
            if mine is None:
                mine = _Gathered(self.select(channel) if channel else None)
                self.gathered[number] = mine
            first, last = int(times.min()), int(times.max())
            if mine.count.messages:
                first, last = min(first, mine.count.first_ns), max(last, mine.count.last_ns)
            mine.count = Count(mine.count.messages + len(times), first, last)
            if mine.extent is None:
                continue
            lengths = heads["length"].view(np.int64) - MESSAGE_FIELDS
            starts = offsets + MESSAGE_HEAD.itemsize
            if mine.width < 0:
                first_payload = contents.bytes[starts[0] : starts[0] + lengths[0]]
                mine.width = mine.extent(first_payload)
            mine.times.append(times.copy())
            mine.payloads.append(_payloads(contents.bytes, starts, lengths, mine.width))

    def _channel(self, number: int) -> Channel | None:
        if number not in self.channels:
            return None
        schema_id, topic, encoding = self.channels[number]
        return Channel(number, topic, encoding, *self.schemas.get(schema_id, ()))

    # --- results ------------------------------------------------------------------------------

    def compare_with_statistics(self) -> None:
        """Say which channels hold another number of messages than the summary promises."""
        for number, count in sorted((self.expected or {}).items()):
            found = self.gathered[number].count.messages if number in self.gathered else 0
            if found != count:
                topic = self.channels[number][1] if number in self.channels else f"channel {number}"
                self.find("messages missing", topic, f"{found} of {count} were found")
        for number in sorted(set(self.gathered) - set(self.channels)):
            lost = self.gathered[number].count.messages
            self.find("unknown channel", f"channel {number}", f"{lost} messages no record names")

    def recording(self) -> Recording:
        """All of it, with the map let go."""
        numbers = sorted(self.channels)
        channels = tuple(c for c in map(self._channel, numbers) if c is not None)
        messages = []
        for channel in channels:
            mine = self.gathered.get(channel.id)
            if mine is None or mine.extent is None:
                continue
            payloads = concat(mine.payloads)
            assert isinstance(payloads, Ragged)
            complete = payloads.width is None or payloads.width < mine.width
            messages.append(Messages(channel, np.concatenate(mine.times), payloads, complete))
        counts = {n: self.gathered[n].count for n in numbers if n in self.gathered}
        return Recording(channels, counts, tuple(messages), tuple(self.findings))


def _payloads(content: NDArray[np.uint8], starts: Int, lengths: Int, width: int) -> Ragged:
    """At most `width` bytes of each payload."""
    lengths = np.minimum(lengths, width)
    if (lengths == lengths[0]).all():
        found = runs(content, starts, int(lengths[0]))
        return Ragged.regular(found.view(np.uint8).reshape(len(starts), int(lengths[0])))
    return Ragged(content[spread(starts, lengths)], cumulative(lengths))
