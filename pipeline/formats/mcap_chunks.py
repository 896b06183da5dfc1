# SPDX-License-Identifier: Apache-2.0
"""What lies inside a chunk: bytes unpacked within bounds, and where each message begins."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from pipeline.formats.mcap_records import (
    CHANNEL,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    PREFIX,
    SCHEMA,
    DamagedError,
    Fields,
)
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
    index: dict[int, list[NDArray[np.void]]] = field(default_factory=dict)

    @classmethod
    def parse(cls, start: int, body: memoryview, cut: bool) -> "Chunk":
        """Read a chunk's head; `cut` allows its records to end early."""
        fields = Fields(body)
        _, _, size, crc = fields.numbers("QQQI")
        compression = fields.text()
        length = fields.number("Q")
        left = len(body) - fields.at
        return cls(start, size, crc, compression, fields.raw(min(length, left) if cut else length),
                   cut)  # fmt: skip


@dataclass
class Contents:
    """Bytes with message records in them, and where each begins."""

    bytes: NDArray[np.uint8]
    offsets: dict[int, Int] = field(default_factory=dict)  #: by channel
    records: list[tuple[int, memoryview]] = field(default_factory=list)  #: schemas, channels
    damage: str = ""

    def heads(self, channel: int) -> NDArray[np.void]:
        """Return the heads of a channel's messages, (n,)."""
        return runs(self.bytes, self.offsets[channel], MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)


def runs(content: NDArray[np.uint8], starts: Int, width: int) -> NDArray[np.void]:
    """`width` bytes from each start, (n,): one index into overlapping records of that size."""
    if width == 0 or len(starts) == 0:
        return np.zeros(len(starts), f"V{width}")
    shape = (len(content) - width + 1,)
    found: NDArray[np.void] = as_strided(content[:width].view(f"V{width}"), shape, (1,))[starts]
    return found


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


def unpack(chunk: Chunk) -> NDArray[np.uint8]:
    """Uncompressed bytes of a chunk, never more than it declares.

    Raises
    ------
    DamagedError
        Larger than any chunk should be, another size than declared, or a wrong CRC.
    """
    if chunk.size > MAX_CHUNK_BYTES:
        raise DamagedError(f"declares {chunk.size} bytes; at most {MAX_CHUNK_BYTES} are read")
    data = _decompress(chunk)
    if chunk.cut:
        return np.frombuffer(data, np.uint8)
    if len(data) != chunk.size:
        more = "more" if len(data) > chunk.size else f"{len(data)}"
        raise DamagedError(f"declares {chunk.size} bytes, unpacks to {more}")
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise DamagedError("CRC is wrong")
    return np.frombuffer(data, np.uint8)


def _decompress(chunk: Chunk) -> bytes | memoryview:
    if chunk.compression == "":
        return chunk.packed
    if chunk.compression == "zstd":
        import zstandard

        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_ZSTD_WINDOW)
        try:
            return decompressor.stream_reader(chunk.packed).read(chunk.size + 1)
        except zstandard.ZstdError as error:
            raise DamagedError(f"zstd: {error}") from None
    if chunk.compression == "lz4":
        import lz4.frame

        try:
            return lz4.frame.LZ4FrameDecompressor().decompress(  # type: ignore[no-any-return]
                chunk.packed, max_length=chunk.size + 1
            )
        except RuntimeError as error:
            raise DamagedError(f"lz4: {error}") from None
    raise DamagedError(f"compression {chunk.compression!r} is not known; zstd, lz4 or none are")


def locate(chunk: Chunk, content: NDArray[np.uint8], known: set[int]) -> Contents:
    """Where each channel's messages begin: by the message index when it holds, else by walking.

    The index holds when its offsets are messages of its channels, rise, and together fill the chunk
    to the last byte.  A chunk with other records in it, a channel not known yet, or without a true
    index is walked.
    """
    offsets = {
        channel: np.concatenate(parts)["offset"].view(np.int64)
        for channel, parts in chunk.index.items()
        if sum(map(len, parts))
    }
    found = Contents(content, offsets)
    if not chunk.cut and offsets and known.issuperset(offsets) and _fills(found):
        return found
    return contents_by_walking(content)


def _fills(found: Contents) -> bool:
    size, filled = len(found.bytes), 0
    for channel, offsets in found.offsets.items():
        if offsets.min() < 0 or offsets.max() > size - MESSAGE_HEAD.itemsize:
            return False
        heads = found.heads(channel)
        right = (heads["opcode"] == MESSAGE) & (heads["channel"] == channel)
        lengths = heads["length"]
        if not right.all() or lengths.min() < MESSAGE_FIELDS or lengths.max() > size:
            return False
        ends = offsets + (lengths.view(np.int64) + PREFIX.size)
        if ends.max() > size or (np.diff(offsets) <= 0).any():
            return False
        filled += int((ends - offsets).sum())
    return filled == size


def contents_by_walking(content: NDArray[np.uint8]) -> Contents:
    """Every record in turn, up to the first that cannot be."""
    found, buffer = Contents(content), memoryview(content.data)
    starts: dict[int, list[int]] = {}
    try:
        for opcode, at, stop in walk(buffer, 0, len(buffer)):
            if opcode == MESSAGE:
                if stop - at < MESSAGE_HEAD.itemsize:
                    raise DamagedError(f"a message of {stop - at} bytes")
                starts.setdefault(buffer[at + 9] | buffer[at + 10] << 8, []).append(at)
            elif opcode in (SCHEMA, CHANNEL):
                found.records.append((opcode, buffer[at + PREFIX.size : stop]))
    except DamagedError as error:
        found.damage = str(error)
    found.offsets = {channel: np.array(rows) for channel, rows in starts.items()}
    return found
