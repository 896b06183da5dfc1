# SPDX-License-Identifier: Apache-2.0
"""What lies inside a chunk: bytes unpacked within bounds, and where each message begins."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.mcap_records import (
    CHANNEL,
    INDEX_ENTRY,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    PREFIX,
    SCHEMA,
    DamagedError,
    Fields,
    checksum,
)
from pipeline.formats.ragged import runs
from pipeline.tables import Int

#: A chunk that says it is larger is refused; recorders write 1 MB, cameras some tens.
MAX_CHUNK_BYTES = 1 << 28
_MAX_ZSTD_WINDOW = 1 << 27


@dataclass
class Chunk:
    """A chunk as it lies in the file."""

    start: int  #: of the record, for findings
    size: int  #: declared, uncompressed
    crc: int  #: of the uncompressed bytes, 0: none
    compression: str
    packed: memoryview
    cut: bool = False  #: the file ends inside it
    padding: int = 0  #: bytes of the record behind the known fields
    #: Entries of its message indexes, by channel.
    index: dict[int, list[memoryview]] = field(default_factory=dict)

    @classmethod
    def parse(cls, start: int, body: memoryview, cut: bool) -> "Chunk":
        """Read a chunk's head; `cut` allows its records to end with the file."""
        fields = Fields(body)
        _, _, size, crc = fields.numbers("QQQI")
        compression = fields.text()
        length = fields.number("Q")
        if cut := cut and length > len(body) - fields.at:
            length = len(body) - fields.at
        packed = fields.raw(length)
        padding = len(body) - fields.at
        if padding and not length:
            raise DamagedError(f"declares no records, but holds {padding} bytes more")
        return cls(start, size, crc, compression, packed, cut, padding)


@dataclass(frozen=True, eq=False)
class Rows:
    """Messages of one channel."""

    starts: Int  #: of their payloads
    lengths: Int
    log_time_ns: Int
    shortest: int  #: of the lengths
    longest: int


@dataclass
class Contents:
    """Bytes with message records in them."""

    content: NDArray[np.uint8]
    messages: dict[int, Rows] = field(default_factory=dict)  #: by channel, in their order
    records: list[tuple[int, bytes]] = field(default_factory=list)  #: schemas, channels
    damage: str = ""

    @classmethod
    def of(cls, content: NDArray[np.uint8], starts: Mapping[int, list[int]]) -> "Contents":
        """Messages that a walk has found."""
        offsets = np.array([at for rows in starts.values() for at in rows], np.int64)
        heads = runs(content, offsets, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
        return cls(content, _by_channel(offsets, heads, list(starts), [*map(len, starts.values())]))


def _by_channel(
    offsets: Int, heads: NDArray[np.void], channels: Sequence[int], counts: Sequence[int]
) -> dict[int, Rows]:
    """Messages that lie in order of `channels`, `counts` of each, all more than 0."""
    starts = offsets + MESSAGE_HEAD.itemsize
    lengths = heads["length"].astype(np.int64) - MESSAGE_FIELDS
    log_time_ns = heads["log_time"].astype(np.int64)
    cuts = list(accumulate(counts, initial=0))
    shortest = np.minimum.reduceat(lengths, cuts[:-1]).tolist() if channels else []
    longest = np.maximum.reduceat(lengths, cuts[:-1]).tolist() if channels else []
    return {
        channel: Rows(starts[a:b], lengths[a:b], log_time_ns[a:b], least, most)
        for channel, (a, b), least, most in zip(
            channels, pairwise(cuts), shortest, longest, strict=True
        )
    }


def walk(buffer: memoryview, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of each record.

    Raises
    ------
    DamagedError
        A record reaches beyond `end`, or has the opcode 0; its text says where.
    """
    unpack, head = PREFIX.unpack_from, PREFIX.size
    while at < end:
        if at + head > end:
            raise DamagedError(f"{end - at} bytes where a record of at least {head} begins")
        opcode, length = unpack(buffer, at)
        stop = at + head + length
        if stop > end or opcode == 0:
            raise DamagedError(f"a record of {length} bytes, opcode {opcode}, with {end - at} left")
        yield opcode, at, stop
        at = stop


def room_for(chunk: Chunk) -> int:
    """Bytes that `unpack` needs; none when it will refuse the chunk."""
    return chunk.size + 1 if chunk.size <= MAX_CHUNK_BYTES else 0


def unpack(chunk: Chunk, room: memoryview) -> int:
    """Uncompressed bytes of a chunk into `room`, never more than it declares; how many.

    Parameters
    ----------
    room : `room_for(chunk)` bytes or more

    Raises
    ------
    DamagedError
        Larger than any chunk should be, another size than declared, or a wrong CRC.
    """
    if chunk.size > MAX_CHUNK_BYTES:
        raise DamagedError(f"declares {chunk.size} bytes; at most {MAX_CHUNK_BYTES} are read")
    size = _decompress(chunk, room[: chunk.size + 1])
    if not chunk.cut and size != chunk.size:
        more = "more" if size > chunk.size else f"{size}"
        raise DamagedError(f"declares {chunk.size} bytes, unpacks to {more}")
    if chunk.crc and size == chunk.size and checksum(room[:size]) != chunk.crc:
        raise DamagedError("CRC is wrong")
    return size


def _decompress(chunk: Chunk, room: memoryview) -> int:
    if chunk.compression == "zstd":
        import zstandard

        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_ZSTD_WINDOW)
        try:
            return decompressor.stream_reader(chunk.packed).readinto(room)
        except zstandard.ZstdError as error:
            raise DamagedError(f"zstd: {error}") from None
    data: bytes | memoryview = chunk.packed
    if chunk.compression == "lz4":
        import lz4.frame

        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=len(room))
        except RuntimeError as error:
            raise DamagedError(f"lz4: {error}") from None
    elif chunk.compression:
        raise DamagedError(f"compression {chunk.compression!r} is not known; zstd, lz4 or none are")
    size = min(len(data), len(room))
    room[:size] = data[:size]
    return size


def locate(chunk: Chunk, content: NDArray[np.uint8]) -> Contents:
    """Where each channel's messages begin: by the message index when it holds, else by walking."""
    found = _by_index(chunk, content) if chunk.index and not chunk.cut else None
    return _by_walking(content) if found is None else found


def _by_index(chunk: Chunk, content: NDArray[np.uint8]) -> Contents | None:
    """Messages by index, if they rise, are of their channels, and fill the chunk without a gap.

    The check is one pass over the heads of all messages of all channels together.
    """
    size = len(content)
    entries = {channel: b"".join(parts) for channel, parts in chunk.index.items()}
    channels = [channel for channel, part in entries.items() if part]
    if not channels:
        return None
    counts = [len(entries[channel]) // INDEX_ENTRY.itemsize for channel in channels]
    offsets = np.frombuffer(b"".join(entries.values()), INDEX_ENTRY)["offset"]
    if offsets.max() > size - MESSAGE_HEAD.itemsize:
        return None
    offsets = offsets.astype(np.int64)
    heads = runs(content, offsets, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
    ends = offsets + heads["length"].astype(np.int64) + PREFIX.size
    rises = offsets[1:] > offsets[:-1]
    rises[np.cumsum(counts)[:-1] - 1] = True  # between channels
    if (
        (heads["opcode"] != MESSAGE).any()
        or (heads["channel"] != np.repeat(channels, counts)).any()
        or not rises.all()
        or not _fill(offsets, ends, size)
    ):
        return None
    found = _by_channel(offsets, heads, channels, counts)
    return Contents(content, found) if all(rows.shortest >= 0 for rows in found.values()) else None


def _fill(starts: Int, ends: Int, size: int) -> bool:
    """Whether messages lie end to end from 0 to `size`.

    They do if one begins at 0, and every other where one ends: who goes on from one to the next
    comes to `size`, and there are no more messages than steps.
    """
    starts, ends = np.sort(starts, kind="stable"), np.sort(ends, kind="stable")
    return bool(starts[0] == 0 and ends[-1] == size and (starts[1:] == ends[:-1]).all())


def _by_walking(content: NDArray[np.uint8]) -> Contents:
    """Every record in turn, up to the first that cannot be."""
    buffer, damage = content.data, ""
    starts: dict[int, list[int]] = {}
    records: list[tuple[int, bytes]] = []
    try:
        for opcode, at, stop in walk(buffer, 0, len(buffer)):
            if opcode == MESSAGE:
                if stop - at < MESSAGE_HEAD.itemsize:
                    raise DamagedError(f"a message of {stop - at} bytes")
                starts.setdefault(buffer[at + 9] | buffer[at + 10] << 8, []).append(at)
            elif opcode in (SCHEMA, CHANNEL):
                records.append((opcode, bytes(buffer[at + PREFIX.size : stop])))
    except DamagedError as error:
        damage = str(error)
    found = Contents.of(content, starts)
    return replace(found, records=records, damage=damage)
