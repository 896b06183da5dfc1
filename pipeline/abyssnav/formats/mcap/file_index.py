# SPDX-License-Identifier: Apache-2.0
"""Where in an MCAP file the chunks and messages lie, and which channels there are.

The file's records are walked from the front; the summary only adds what its CRC vouches for, and
leads to chunks behind a damaged record.  Without it, the next chunk is searched for.
"""

import struct
from array import array
from collections.abc import Container
from dataclasses import dataclass, field

import numpy as np

from abyssnav.formats.mcap.chunks import Chunk, Contents, walk
from abyssnav.formats.mcap.records import (
    ATTACHMENT,
    ATTACHMENT_INDEX,
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
    CorruptRecordError,
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
#: Prefix and fixed fields of a chunk, its compression's name not counted; and of an attachment.
_CHUNK_HEAD = PREFIX.size + struct.calcsize("<QQQIIQ")
_ATTACHMENT_HEAD = PREFIX.size + 64
_FOOT = PREFIX.size + FOOTER_FIELDS.size + len(MAGIC)
_PRIVATE = 0x80  #: opcodes from here on belong to others and are skipped


Range = tuple[int, int]


@dataclass(frozen=True)
class Channel:
    """A channel with its schema."""

    id: int
    topic: str
    message_encoding: str
    type: str = ""
    schema_encoding: str = ""
    definition: bytes = b""


@dataclass(frozen=True)
class SummaryChunk:
    """A chunk as the summary has it."""

    channels: frozenset[int]  #: that it holds messages of, by its message indexes
    body: Range  #: its records, packed


@dataclass
class FileIndex:
    """What was found in a file so far: where its chunks and messages lie, and its channels."""

    name: str
    plan: list[Chunk | Contents] = field(default_factory=list)  #: in the file's order
    expected: dict[int, int] = field(default_factory=dict)  #: messages by channel, as promised
    findings_once: dict[Finding, None] = field(default_factory=dict)  #: findings, each once
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    channels: dict[int, tuple[int, str, str]] = field(default_factory=dict)
    #: Chunks by where they begin, as the summary has them.
    chunks: dict[int, SummaryChunk] = field(default_factory=dict)
    attachments: list[Range] = field(default_factory=list)  #: bodies, as the summary has them
    is_counted: bool = False  #: whether the summary has statistics
    is_unchecked: bool = False  #: whether messages outside chunks have no checksum
    data_end: int | None = None  #: first byte behind the data, as the footer has it
    unknown_records: dict[int, list[int]] = field(default_factory=dict)  #: other records, by opcode

    def add_finding(self, what: str, where: str, detail: str) -> None:
        """Add a finding, once."""
        self.findings_once[Finding(what, f"{self.name} {where}".rstrip(), detail)] = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what was found, in the order in which it was."""
        return tuple(self.findings_once)

    def note_missing_checksums(self) -> None:
        """Say once that damage cannot be told where a writer left the checksums out."""
        chunks = [item for item in self.plan if isinstance(item, Chunk)]
        unchecked = sum(1 for chunk in chunks if chunk.size and not chunk.crc)
        parts = [f"{unchecked} of {len(chunks)} chunks"] if unchecked else []
        parts += ["messages outside chunks"] if self.is_unchecked else []
        if parts:
            detail = f"{' and '.join(parts)} have none: a changed byte in them cannot be told"
            self.add_finding("no checksums", "", detail)

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

    def add_record(self, opcode: int, start: int, body: memoryview) -> None:
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
                    raise CorruptRecordError("a channel without a topic")
                same = self.channels.setdefault(number, channel) == channel
            else:
                self._add_index(opcode, fields)
                return
        except CorruptRecordError as error:
            self.add_finding("damaged record", f"at byte {start}", f"opcode {opcode}: {error}")
            return
        if not same:
            kind = "schema" if opcode == SCHEMA else "channel"
            self.add_finding(
                f"conflicting {kind}", f"at byte {start}", f"{kind} {number}; first is used"
            )

    def _add_index(self, opcode: int, fields: Fields) -> None:
        if opcode == STATISTICS:
            self.is_counted = True
            fields.raw(struct.calcsize("<QHIIIIQQ"))
            pairs = Fields(fields.block())
            while pairs.pos < len(pairs.body):
                number, count = pairs.numbers("HQ")
                self.expected[number] = count
        elif opcode == CHUNK_INDEX:
            _, _, start, length = fields.numbers("QQQQ")
            offsets = Fields(fields.block())
            channels = [offsets.numbers("HQ")[0] for _ in range(len(offsets.body) // _OFFSET_BYTES)]
            fields.number("Q")
            head = _CHUNK_HEAD + len(fields.block())
            self.chunks[start] = SummaryChunk(frozenset(channels), (start + head, start + length))
        elif opcode == ATTACHMENT_INDEX:
            start, length = fields.numbers("QQ")
            self.attachments.append((start + _ATTACHMENT_HEAD, start + length))


def index_file(name: str, buffer: memoryview) -> FileIndex:
    """Walk over a file that begins with the magic; whatever is wrong becomes a finding."""
    index = FileIndex(name)
    _add_summary(index, buffer)
    visited: set[int] = set()
    going_on: int | None = len(MAGIC)
    while going_on is not None:
        going_on = _Walker(index, buffer, visited).walk(going_on)
    for start in sorted(index.chunks):
        if start not in visited and start < len(buffer) and buffer[start] == CHUNK:
            index.add_finding(
                "skipped to a chunk", f"at byte {start}", "only the summary leads to it"
            )
            _Walker(index, buffer, visited).walk(start)
    for opcode, places in sorted(index.unknown_records.items()):
        whose = "private" if opcode >= _PRIVATE else "misplaced or unknown"
        detail = f"{len(places)} {whose} records of opcode {opcode}: skipped"
        index.add_finding("unknown records", f"from byte {places[0]}", detail)
    if not _ends_well(buffer) and not any(f.what == "cut short" for f in index.findings):
        index.add_finding("cut short", f"at byte {len(buffer)}", "the end of the file is missing")
    return index


def _ends_well(buffer: memoryview) -> bool:
    return len(buffer) >= 2 * len(MAGIC) and bytes(buffer[-len(MAGIC) :]) == MAGIC


def _add_summary(index: FileIndex, tail: memoryview, base: int = 0) -> None:
    """Take channels, chunk places and statistics from a summary whose CRC is right.

    Parameters
    ----------
    tail : the file from byte `base` to its end
    """
    foot = len(tail) - _FOOT
    if base + foot < len(MAGIC) or not _ends_well(tail):
        return
    opcode, length = PREFIX.unpack_from(tail, foot)
    start, _, crc = FOOTER_FIELDS.unpack_from(tail, foot + PREFIX.size)
    whole = opcode == FOOTER and length == FOOTER_FIELDS.size
    if not whole or not (start == 0 or len(MAGIC) <= start <= base + foot):
        where = f"at byte {base + foot}"
        index.add_finding("damaged footer", where, "read without the summary")
        return
    index.data_end = start or base + foot
    if start < max(base, 1):  # there is none, or it begins before these bytes
        return
    summary = tail[start - base :]
    if crc and checksum(summary[: -len(MAGIC) - 4]) != crc:
        index.add_finding("damaged summary", f"at byte {start}", "CRC is wrong; read without it")
        return
    try:
        for opcode, pos, stop in walk(summary, 0, len(summary) - _FOOT):
            index.add_record(opcode, start + pos, summary[pos + PREFIX.size : stop])
    except CorruptRecordError as error:
        index.add_finding("damaged summary", f"at byte {start}", str(error))


def summary_start(tail: bytes, size: int) -> int | None:
    """Where the summary of a file begins, from its last bytes; None when it has none.

    Parameters
    ----------
    tail : the file's last bytes, 37 or more
    size : of the whole file
    """
    index = FileIndex("")
    _add_summary(index, memoryview(tail[-_FOOT:]), size - len(tail[-_FOOT:]))
    start = index.data_end
    return start if start is not None and len(MAGIC) < start < size - _FOOT else None


def skippable_ranges(summary: bytes, start: int, topics: Container[str]) -> list[Range]:
    """Bytes that hold nothing of `topics`: bodies of chunks without them, and of attachments.

    Parameters
    ----------
    summary : the file from `start`, where its summary begins, to its end

    Returns
    -------
    ranges : rising, from the first byte to the one after the last; none when in doubt
    """
    index = FileIndex("")
    _add_summary(index, memoryview(summary), start)
    if index.findings or not (index.is_counted and index.chunks):
        return []  # or messages may lie outside chunks
    chunks = index.chunks.values()
    held = set[int]().union(*(chunk.channels for chunk in chunks))
    if not (held <= index.channels.keys() and all(map(index.is_named, index.channels))):
        return []  # a chunk may hold what names the topics
    wanted = {number for number, channel in index.channels.items() if channel[1] in topics}
    # A chunk without a message index may hold anything.
    bodies = [c.body for c in chunks if c.channels and not c.channels & wanted]
    ranges = sorted(bodies + index.attachments)
    return [(low, high) for low, high in ranges if low < high <= start]


def _is_index(body: memoryview) -> bool:
    """Whether a record behind a chunk is one of its message indexes, whatever it is marked as."""
    size = _INDEX_HEAD.unpack_from(body)[1] if len(body) >= _INDEX_HEAD.size else -1
    return size == len(body) - _INDEX_HEAD.size and size % INDEX_ENTRY.itemsize == 0


class _Walker:
    """One walk over records of the data section."""

    def __init__(self, index: FileIndex, buffer: memoryview, visited: set[int]) -> None:
        self.index, self.buffer, self.visited = index, buffer, visited
        self.chunk: Chunk | None = None  #: to which message indexes belong
        self.proven = 0  #: up to here no chunk can be hidden
        self.loose = array("q")  #: messages outside chunks

    def walk(self, start: int) -> int | None:
        """Take records up to the end of the data, a chunk seen before, or damage.

        Returns the chunk to go on with behind the damage, which only a search has led to.
        """
        size = len(self.buffer)
        end = size - len(MAGIC) if _ends_well(self.buffer) else size
        self.proven, reached = start, start
        try:
            for opcode, pos, stop in walk(self.buffer, start, end, self.loose):
                reached = pos
                if pos in self.visited:
                    break
                if opcode == DATA_END and pos not in self.index.chunks:
                    self._data_end(pos, stop)
                    break
                self._record(opcode, pos, stop)
        except CorruptRecordError as error:
            self._flush()
            pos = reached if error.pos is None else error.pos
            return self._damaged(pos, str(error), cut=end == size)
        self._flush()
        return None

    def _damaged(self, pos: int, error: str, cut: bool) -> int | None:
        """Say what could not be read from `at` on; return where reading can go on.

        A record since the last whole chunk may have a wrong length, so chunks are looked for from
        there on.
        """
        resume = None
        if not self.index.chunks:
            resume = next_chunk(self.buffer, self.proven)
        if resume is None:
            detail, until = f"{error}; read up to there", len(self.buffer)
        elif resume > pos:
            detail = f"{error}; bytes {pos} to {resume} left out, up to the next chunk"
            until, cut = resume, False
        else:
            detail, until, cut = (
                f"{error}; read again from the chunk at byte {resume}",
                pos,
                False,
            )
        self.index.add_finding("cut short" if cut else "damaged record", f"at byte {pos}", detail)
        if pos + PREFIX.size <= until and self.buffer[pos] == CHUNK and pos not in self.visited:
            self.visited.add(pos)
            self._chunk(pos, self.buffer[pos + PREFIX.size : until], cut)
        return resume

    def _record(self, opcode: int, pos: int, stop: int) -> None:
        if opcode != CHUNK and pos in self.index.chunks:
            detail = f"opcode {opcode} where the summary has a chunk: read as one"
            self.index.add_finding("damaged record", f"at byte {pos}", detail)
            opcode = CHUNK
        if opcode == MESSAGE_INDEX:
            if stop - pos >= PREFIX.size + _INDEX_HEAD.size:
                self._message_index(pos, stop)
            return
        body = self.buffer[pos + PREFIX.size : stop]
        if opcode == MESSAGE and self.chunk and _is_index(body):
            self.index.add_finding(
                "damaged index", f"message index at byte {pos}", "marked as a message"
            )
            return
        self.chunk = None
        if opcode == MESSAGE:
            if stop - pos < MESSAGE_HEAD.itemsize:
                raise CorruptRecordError(f"a message of {stop - pos} bytes")
            self.loose.append(pos)
        elif opcode == CHUNK:
            self.visited.add(pos)
            self._flush()
            self._chunk(pos, body)
        elif opcode in (SCHEMA, CHANNEL):
            self.index.add_record(opcode, pos, body)
        elif opcode not in _IN_DATA:
            self.index.unknown_records.setdefault(opcode, []).append(pos)

    def _flush(self) -> None:
        """Put messages that lie outside chunks into the plan."""
        if self.loose:
            content = np.frombuffer(self.buffer, np.uint8)
            self.index.plan.append(Contents.from_begins(content, np.array(self.loose, np.int64)))
            del self.loose[:]  # the walk goes on adding to it

    def _chunk(self, pos: int, body: memoryview, cut: bool = False) -> None:
        try:
            self.chunk = Chunk.parse(pos, body, cut)
            self.index.plan.append(self.chunk)
            self.proven = pos + 1 if self.chunk.padding else pos + PREFIX.size + len(body)
        except CorruptRecordError as error:
            self.chunk = None
            self.index.add_finding("chunk left out", f"chunk at byte {pos}", str(error))

    def _message_index(self, pos: int, stop: int) -> None:
        start = pos + PREFIX.size + _INDEX_HEAD.size
        channel, size = _INDEX_HEAD.unpack_from(self.buffer, start - _INDEX_HEAD.size)
        if self.chunk is None or size % INDEX_ENTRY.itemsize or start + size > stop:
            where = f"message index at byte {pos}"
            self.index.add_finding("damaged index", where, "no chunk before it, or another length")
        else:
            self.chunk.index.setdefault(channel, []).append(self.buffer[start : start + size])

    def _data_end(self, pos: int, stop: int) -> None:
        """Check the data section's CRC where messages lie outside chunks, which have none.

        Raises
        ------
        CorruptRecordError
            This is not where the data end.
        """
        behind = self.buffer[stop] if stop < len(self.buffer) else 0
        if (
            stop - pos > _DATA_END_BYTES
            or behind in _DATA_ONLY
            or stop != (self.index.data_end or stop)
        ):
            raise CorruptRecordError("an end of the data where there is more of them", pos)
        outside = self.loose or any(isinstance(item, Contents) for item in self.index.plan)
        if not outside or stop - pos < PREFIX.size + 4:
            return
        crc = int.from_bytes(self.buffer[pos + PREFIX.size : pos + PREFIX.size + 4], "little")
        self.index.is_unchecked = not crc
        if crc and checksum(self.buffer[:pos]) != crc:
            detail = "CRC of the data section is wrong; messages outside chunks may be damaged"
            self.index.add_finding("damaged data", f"up to byte {pos}", detail)
