# SPDX-License-Identifier: Apache-2.0
"""Where in an MCAP file the chunks and messages lie, and which channels there are.

The file's records are walked from the front; the summary only adds what its CRC vouches for, and
leads to chunks behind a damaged record.  Without it, the next chunk is searched for.
"""

import struct
from dataclasses import dataclass, field

import numpy as np

from abyssnav.formats.mcap.chunks import Chunk, Contents, walk
from abyssnav.formats.mcap.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FOOTER_FIELDS,
    HEADER,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    METADATA,
    PREFIX,
    SCHEMA,
    STATISTICS,
    DamagedError,
    Fields,
    checksum,
)
from abyssnav.formats.mcap.recovery import next_chunk
from abyssnav.tables import Finding

_IN_DATA = (HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END)
_DATA_END_BYTES = 64  #: a checksum, and some padding; a longer one is no end but damage
_INDEX_HEAD = struct.Struct("<HI")  #: of a message index: channel, bytes of entries
_OFFSET_BYTES = struct.calcsize("<HQ")  #: of a message index's place in a chunk index
#: What may not come behind the end of the data.
_DATA_ONLY = (MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA)
_PRIVATE = 0x80  #: opcodes from here on belong to others and are skipped


@dataclass(frozen=True)
class Channel:
    """A channel with its schema."""

    id: int
    topic: str
    message_encoding: str
    type: str = ""
    schema_encoding: str = ""
    definition: bytes = b""


@dataclass
class Layout:
    """What was found in a file so far."""

    name: str
    plan: list[Chunk | Contents] = field(default_factory=list)  #: in the file's order
    expected: dict[int, int] = field(default_factory=dict)  #: messages by channel, as promised
    noted: dict[Finding, None] = field(default_factory=dict)  #: findings, each once
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    channels: dict[int, tuple[int, str, str]] = field(default_factory=dict)
    #: Chunks and the channels in them, as the summary has them.
    chunks: dict[int, frozenset[int]] = field(default_factory=dict)
    data_end: int | None = None  #: first byte behind the data, as the footer has it
    strangers: dict[int, list[int]] = field(default_factory=dict)  #: other records, by opcode

    def find(self, what: str, where: str, detail: str) -> None:
        """Add a finding, once."""
        self.noted[Finding(what, f"{self.name} {where}", detail)] = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what was found, in the order in which it was."""
        return tuple(self.noted)

    def is_named(self, number: int) -> bool:
        """Whether a channel is known, and its schema."""
        schema = self.channels.get(number, (-1,))[0]
        return schema == 0 or schema in self.schemas

    def channel(self, number: int) -> Channel | None:
        """Return a channel with its schema, None when no record names it."""
        if number not in self.channels:
            return None
        schema_id, topic, encoding = self.channels[number]
        return Channel(number, topic, encoding, *self.schemas.get(schema_id, ()))

    def take(self, opcode: int, start: int, body: memoryview) -> None:
        """Take one record that is neither message nor chunk; of two that differ, the first."""
        fields = Fields(body)
        try:
            if opcode == SCHEMA:
                number = fields.number("H")
                schema = (fields.text(), fields.text(), bytes(fields.block()))
                same = self.schemas.setdefault(number, schema) == schema
            elif opcode == CHANNEL:
                number, schema_id = fields.numbers("HH")
                channel = (schema_id, fields.text(), fields.text())
                fields.block()  # metadata
                if not channel[1]:
                    raise DamagedError("a channel without a topic")
                same = self.channels.setdefault(number, channel) == channel
            else:
                self._take_index(opcode, fields)
                return
        except DamagedError as error:
            self.find("damaged record", f"at byte {start}", f"opcode {opcode}: {error}")
            return
        if not same:
            kind = "schema" if opcode == SCHEMA else "channel"
            self.find(f"conflicting {kind}", f"at byte {start}", f"{kind} {number}; first is used")

    def _take_index(self, opcode: int, fields: Fields) -> None:
        if opcode == STATISTICS:
            fields.raw(struct.calcsize("<QHIIIIQQ"))
            pairs = Fields(fields.block())
            while pairs.at < len(pairs.body):
                number, count = pairs.numbers("HQ")
                self.expected[number] = count
        elif opcode == CHUNK_INDEX:
            start = fields.numbers("QQQQ")[2]
            offsets = Fields(fields.block())
            self.chunks[start] = frozenset(
                offsets.numbers("HQ")[0] for _ in range(len(offsets.body) // _OFFSET_BYTES)
            )


def find_layout(name: str, buffer: memoryview) -> Layout:
    """Walk over a file that begins with the magic; whatever is wrong becomes a finding."""
    layout = Layout(name)
    _read_summary(layout, buffer)
    seen: set[int] = set()
    going_on: int | None = len(MAGIC)
    while going_on is not None:
        going_on = _Walker(layout, buffer, seen).walk(going_on)
    for start in sorted(layout.chunks):
        if start not in seen and start < len(buffer) and buffer[start] == CHUNK:
            layout.find("skipped to a chunk", f"at byte {start}", "only the summary leads to it")
            _Walker(layout, buffer, seen).walk(start)
    for opcode, places in sorted(layout.strangers.items()):
        whose = "private" if opcode >= _PRIVATE else "misplaced or unknown"
        detail = f"{len(places)} {whose} records of opcode {opcode}: skipped"
        layout.find("unknown records", f"from byte {places[0]}", detail)
    if not _ends_well(buffer) and not any(f.what == "cut short" for f in layout.findings):
        layout.find("cut short", f"at byte {len(buffer)}", "the end of the file is missing")
    return layout


def _ends_well(buffer: memoryview) -> bool:
    return len(buffer) >= 2 * len(MAGIC) and bytes(buffer[-len(MAGIC) :]) == MAGIC


def _read_summary(layout: Layout, buffer: memoryview) -> None:
    """Take channels, chunk places and statistics from a summary whose CRC is right."""
    size = len(buffer)
    foot = size - PREFIX.size - FOOTER_FIELDS.size - len(MAGIC)
    if foot < len(MAGIC) or not _ends_well(buffer):
        return
    opcode, length = PREFIX.unpack_from(buffer, foot)
    start, _, crc = FOOTER_FIELDS.unpack_from(buffer, foot + PREFIX.size)
    if opcode != FOOTER or length != FOOTER_FIELDS.size or not (start == 0 or 8 <= start <= foot):
        layout.find("damaged footer", f"at byte {foot}", "read without the summary")
        return
    layout.data_end = start or foot
    if start and crc and checksum(buffer[start : size - len(MAGIC) - 4]) != crc:
        layout.find("damaged summary", f"at byte {start}", "CRC is wrong; read without it")
    elif start:
        try:
            for opcode, at, stop in walk(buffer, start, foot):
                layout.take(opcode, at, buffer[at + PREFIX.size : stop])
        except DamagedError as error:
            layout.find("damaged summary", f"at byte {start}", str(error))


def _is_index(body: memoryview) -> bool:
    """Whether a record behind a chunk is one of its message indexes, whatever it is marked as."""
    size = _INDEX_HEAD.unpack_from(body)[1] if len(body) >= _INDEX_HEAD.size else -1
    return size == len(body) - _INDEX_HEAD.size and size % INDEX_ENTRY.itemsize == 0


class _Walker:
    """One walk over records of the data section."""

    def __init__(self, layout: Layout, buffer: memoryview, seen: set[int]) -> None:
        self.layout, self.buffer, self.seen = layout, buffer, seen
        self.chunk: Chunk | None = None  #: to which message indexes belong
        self.proven = 0  #: up to here no chunk can be hidden
        self.loose: list[int] = []  #: messages outside chunks

    def walk(self, start: int) -> int | None:
        """Take records up to the end of the data, a chunk seen before, or damage.

        Returns the chunk to go on with behind the damage, which only a search has led to.
        """
        size = len(self.buffer)
        end = size - len(MAGIC) if _ends_well(self.buffer) else size
        self.proven, reached = start, start
        try:
            for opcode, at, stop in walk(self.buffer, start, end, self.loose):
                reached = at
                if at in self.seen:
                    break
                if opcode == DATA_END and at not in self.layout.chunks:
                    self._data_end(at, stop)
                    break
                self._record(opcode, at, stop)
        except DamagedError as error:
            self._flush()
            at = reached if error.at is None else error.at
            return self._damaged(at, str(error), cut=end == size)
        self._flush()
        return None

    def _damaged(self, at: int, error: str, cut: bool) -> int | None:
        """Say what could not be read from `at` on; return where reading can go on.

        A record since the last whole chunk may have a wrong length, so chunks are looked for from
        there on.
        """
        found = None
        if not self.layout.chunks:
            found = next_chunk(self.buffer, self.proven)
        if found is None:
            detail, until = f"{error}; read up to there", len(self.buffer)
        elif found > at:
            detail = f"{error}; bytes {at} to {found} left out, up to the next chunk"
            until, cut = found, False
        else:
            detail, until, cut = f"{error}; read again from the chunk at byte {found}", at, False
        self.layout.find("cut short" if cut else "damaged record", f"at byte {at}", detail)
        if at + PREFIX.size <= until and self.buffer[at] == CHUNK and at not in self.seen:
            self.seen.add(at)
            self._chunk(at, self.buffer[at + PREFIX.size : until], cut)
        return found

    def _record(self, opcode: int, at: int, stop: int) -> None:
        if opcode != CHUNK and at in self.layout.chunks:
            told = f"opcode {opcode} where the summary has a chunk: read as one"
            self.layout.find("damaged record", f"at byte {at}", told)
            opcode = CHUNK
        if opcode == MESSAGE_INDEX:
            if stop - at >= PREFIX.size + _INDEX_HEAD.size:
                self._message_index(at, stop)
            return
        body = self.buffer[at + PREFIX.size : stop]
        if opcode == MESSAGE and self.chunk and _is_index(body):
            self.layout.find("damaged index", f"message index at byte {at}", "marked as a message")
            return
        self.chunk = None
        if opcode == MESSAGE:
            if stop - at < MESSAGE_HEAD.itemsize:
                raise DamagedError(f"a message of {stop - at} bytes")
            self.loose.append(at)
        elif opcode == CHUNK:
            self.seen.add(at)
            self._flush()
            self._chunk(at, body)
        elif opcode in (SCHEMA, CHANNEL):
            self.layout.take(opcode, at, body)
        elif opcode not in _IN_DATA:
            self.layout.strangers.setdefault(opcode, []).append(at)

    def _flush(self) -> None:
        """Put messages that lie outside chunks into the plan."""
        if self.loose:
            content = np.frombuffer(self.buffer, np.uint8)
            self.layout.plan.append(Contents.of(content, np.array(self.loose, np.int64)))
            self.loose = []

    def _chunk(self, at: int, body: memoryview, cut: bool = False) -> None:
        try:
            self.chunk = Chunk.parse(at, body, cut)
            self.layout.plan.append(self.chunk)
            self.proven = at + 1 if self.chunk.padding else at + PREFIX.size + len(body)
        except DamagedError as error:
            self.chunk = None
            self.layout.find("chunk left out", f"chunk at byte {at}", str(error))

    def _message_index(self, at: int, stop: int) -> None:
        start = at + PREFIX.size + _INDEX_HEAD.size
        channel, size = _INDEX_HEAD.unpack_from(self.buffer, start - _INDEX_HEAD.size)
        if self.chunk is None or size % INDEX_ENTRY.itemsize or start + size > stop:
            where = f"message index at byte {at}"
            self.layout.find("damaged index", where, "no chunk before it, or another length")
        else:
            self.chunk.index.setdefault(channel, []).append(self.buffer[start : start + size])

    def _data_end(self, at: int, stop: int) -> None:
        """Check the data section's CRC where messages lie outside chunks, which have none.

        Raises
        ------
        DamagedError
            This is not where the data end.
        """
        behind = self.buffer[stop] if stop < len(self.buffer) else 0
        if (
            stop - at > _DATA_END_BYTES
            or behind in _DATA_ONLY
            or stop != (self.layout.data_end or stop)
        ):
            raise DamagedError("an end of the data where there is more of them", at)
        outside = self.loose or any(isinstance(item, Contents) for item in self.layout.plan)
        if not outside or stop - at < PREFIX.size + 4:
            return
        crc = int.from_bytes(self.buffer[at + PREFIX.size : at + PREFIX.size + 4], "little")
        if crc and checksum(self.buffer[:at]) != crc:
            detail = "CRC of the data section is wrong; messages outside chunks may be damaged"
            self.layout.find("damaged data", f"up to byte {at}", detail)
