# SPDX-License-Identifier: Apache-2.0
"""What lies inside a chunk: bytes unpacked within bounds, and where each message begins."""

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
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
    index: dict[int, list[NDArray[np.void]]] = field(default_factory=dict)

    @classmethod
    def parse(cls, start: int, body: memoryview, cut: bool) -> "Chunk":
        """Read a chunk's head; `cut` allows its records to end with the file."""
        fields = Fields(body)
        _, _, size, crc = fields.numbers("QQQI")
        compression = fields.text()
        length = fields.number("Q")
        if cut := cut and length > len(body) - fields.at:
            length = len(body) - fields.at
        return cls(start, size, crc, compression, fields.raw(length), cut)


@dataclass
class Contents:
    """Bytes with message records in them."""

    bytes: NDArray[np.uint8]
    #: By channel: where its messages begin, and their heads.
    messages: dict[int, tuple[Int, NDArray[np.void]]] = field(default_factory=dict)
    records: list[tuple[int, memoryview]] = field(default_factory=list)  #: schemas, channels
    damage: str = ""

    @classmethod
    def of(cls, content: NDArray[np.uint8], starts: Mapping[int, list[int]]) -> "Contents":
        """Messages that a walk has found."""
        offsets = {channel: np.array(rows) for channel, rows in starts.items()}
        heads = {
            c: runs(content, o, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
            for c, o in offsets.items()
        }
        return cls(content, {c: (o, heads[c]) for c, o in offsets.items()})


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
    if chunk.crc and checksum(data) != chunk.crc:
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


def locate(chunk: Chunk, content: NDArray[np.uint8], known: Container[int]) -> Contents:
    """Where each channel's messages begin: by the message index when it holds, else by walking.

    A chunk with other records in it, a channel not known yet, or without a true index is walked.
    """
    if not chunk.cut and chunk.index and all(channel in known for channel in chunk.index):
        found = _by_index(chunk, content)
        if found is not None:
            return found
    return _by_walking(content)


def _by_index(chunk: Chunk, content: NDArray[np.uint8]) -> Contents | None:
    """Messages by index, if they rise, are of their channels, and fill the chunk to its last byte.

    The check is one pass over the heads of all messages of all channels together.
    """
    size, channels = len(content), list(chunk.index)
    counts = [sum(map(len, chunk.index[channel])) for channel in channels]
    offsets = np.concatenate([part for c in channels for part in chunk.index[c]])["offset"]
    if sum(counts) == 0 or offsets.max() > size - MESSAGE_HEAD.itemsize:
        return None
    offsets = offsets.astype(np.int64)
    heads = runs(content, offsets, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
    lengths = heads["length"].astype(np.int64)
    ends = offsets + lengths + PREFIX.size
    cuts = np.cumsum(counts)
    rises = np.diff(offsets) > 0
    rises[cuts[:-1] - 1] = True  # between channels
    if (
        (heads["opcode"] != MESSAGE).any()
        or (heads["channel"] != np.repeat(channels, counts)).any()
        or lengths.min() < MESSAGE_FIELDS
        or ends.max() > size
        or int(lengths.sum()) + PREFIX.size * len(lengths) != size
        or not rises.all()
    ):
        return None
    slices = [slice(cut - count, cut) for cut, count in zip(cuts, counts, strict=True) if count]
    used = [channel for channel, count in zip(channels, counts, strict=True) if count]
    return Contents(content, {c: (offsets[s], heads[s]) for c, s in zip(used, slices, strict=True)})


def _by_walking(content: NDArray[np.uint8]) -> Contents:
    """Every record in turn, up to the first that cannot be."""
    buffer, damage = content.data, ""
    starts: dict[int, list[int]] = {}
    records: list[tuple[int, memoryview]] = []
    try:
        for opcode, at, stop in walk(buffer, 0, len(buffer)):
            if opcode == MESSAGE:
                if stop - at < MESSAGE_HEAD.itemsize:
                    raise DamagedError(f"a message of {stop - at} bytes")
                starts.setdefault(buffer[at + 9] | buffer[at + 10] << 8, []).append(at)
            elif opcode in (SCHEMA, CHANNEL):
                records.append((opcode, buffer[at + PREFIX.size : stop]))
    except DamagedError as error:
        damage = str(error)
    found = Contents.of(content, starts)
    return replace(found, records=records, damage=damage)
