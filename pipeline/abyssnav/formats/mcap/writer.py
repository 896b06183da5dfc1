# SPDX-License-Identifier: Apache-2.0
"""MCAP written from columns: records, chunks, indexes and CRCs from arrays, no loop over messages.

All messages of all topics lie in the file by log time, so that a reader which plays in order holds
one chunk; the same input gives the same bytes.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.formats.cdr_encoder import PayloadTemplates, encode_lazily
from abyssnav.formats.columns import Ragged, overlapping_windows, ragged_indices
from abyssnav.formats.mcap.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE,
    MESSAGE_FIELDS,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    SCHEMA,
    STATISTICS,
    SUMMARY_OFFSET,
    checksum,
    record,
    text,
)
from abyssnav.formats.schema import message_definition, our_definition
from abyssnav.tables import Int
from abyssnav.version import __version__

#: As large as the `mcap` command's own: each topic costs a little in each chunk.
CHUNK_BYTES = 1 << 22
_PACKED_AHEAD = 2


@dataclass(frozen=True, eq=False)
class Channel:
    """A topic with all its messages; `log_time_ns` (n,) need not be sorted."""

    topic: str
    type: str
    log_time_ns: Int
    payloads: Ragged | PayloadTemplates
    definition: bytes = b""
    message_encoding: str = "cdr"
    schema_encoding: str = "ros2msg"
    metadata: Mapping[str, str] = field(default_factory=dict)


def ros2_channel(
    topic: str, type_name: str, log_time_ns: Int, columns: Mapping[str, Any]
) -> Channel:
    """Messages of a type in `schemas/msg` from columns by dotted path (`encode_lazily`).

    The key `offered_qos_profiles`, empty, is what the `ros2` profile of MCAP wants of a channel.
    """
    payloads = encode_lazily(our_definition(type_name), columns, len(log_time_ns))
    definition = message_definition(type_name).encode()
    qos = {"offered_qos_profiles": ""}
    return Channel(topic, type_name, log_time_ns, payloads, definition, metadata=qos)


def write_mcap(
    path: Path,
    channels: Sequence[Channel],
    compression: str = "zstd",
    chunk_bytes: int = CHUNK_BYTES,
    level: int = 3,
) -> None:
    """Write a chunked, indexed file with CRCs and statistics; `compression` zstd, lz4 or ''.

    Parameters
    ----------
    level : of zstd; 3 is its own default, -1 packs twice as fast and hardly worse

    Raises
    ------
    ValueError
        Another compression, or a channel with more times than payloads.
    """
    for channel in channels:
        times, payloads = len(channel.log_time_ns), len(channel.payloads)
        if times != payloads:
            raise ValueError(f"{channel.topic}: {times} times for {payloads} payloads")
    compress = _compressor(compression, level)
    profile = "ros2" if all(channel.message_encoding == "cdr" for channel in channels) else ""
    schemas, records = _schemas_and_channels(channels)
    with path.open("wb") as file:
        out = _Out(file)
        out.write(MAGIC + record(HEADER, text(profile) + text(f"abyssnav {__version__}")))
        out.write(schemas + records)
        chunk_indexes = [
            _write_chunk(out, chunk, compression)
            for chunk in _packed(_chunks(channels, chunk_bytes), channels, compress)
        ]
        out.write(record(DATA_END, struct.pack("<I", out.crc)))
        statistics = _statistics(channels, len(chunk_indexes))
        _write_summary(out, [schemas, records, statistics, b"".join(chunk_indexes)])


class _Out:
    """An open file that knows its length and CRC."""

    def __init__(self, file: BufferedWriter) -> None:
        self.file, self.size, self.crc = file, 0, 0

    def write(self, data: bytes) -> None:
        self.file.write(data)
        self.size += len(data)
        self.crc = checksum(data, self.crc)


@dataclass(frozen=True, eq=False)
class _Part:
    """Which messages a chunk holds, in order, one row a message."""

    channel: NDArray[np.uint16]  #: place in the list of channels
    message: NDArray[np.uint32]  #: row in its channel
    length: Int  #: bytes of the payload
    log_time_ns: Int

    @cached_property
    def by_channel(self) -> list[tuple[int, Int]]:
        """Return the rows of each channel that the chunk holds messages of."""
        order = np.argsort(self.channel, kind="stable")
        numbers, first = np.unique(self.channel[order], return_index=True)
        return list(zip(numbers.tolist(), np.split(order, first[1:]), strict=True))


def _chunks(channels: Sequence[Channel], chunk_bytes: int) -> Iterator[_Part]:
    counts = [len(c.payloads) for c in channels]
    if not sum(counts):
        return
    channel = np.repeat(np.arange(len(channels), dtype=np.uint16), counts)
    message = np.concatenate([np.arange(count, dtype=np.uint32) for count in counts])
    time = np.concatenate([np.asarray(c.log_time_ns, np.int64) for c in channels])
    length = np.concatenate([c.payloads.lengths for c in channels])
    order = np.argsort(time, kind="stable")
    for rows in np.split(order, _chunk_begins(length[order], chunk_bytes)):
        yield _Part(channel[rows], message[rows], length[rows], time[rows])


def _chunk_begins(length: Int, chunk_bytes: int) -> Int:
    """Messages, of all in order, with which a new chunk begins."""
    ends = np.cumsum(MESSAGE_HEAD.itemsize + length)
    number = np.append(0, ends[:-1]) // chunk_bytes
    return np.flatnonzero(np.diff(number)) + 1


@dataclass(frozen=True, eq=False)
class _Packed:
    """A chunk ready to be written."""

    part: _Part
    starts: Int  #: byte at which each record begins, unpacked
    size: int  #: bytes, unpacked
    crc: int
    packed: bytes


def _packed(
    parts: Iterable[_Part], channels: Sequence[Channel], compress: Callable[[memoryview], bytes]
) -> Iterator[_Packed]:
    """Chunks in order; while some are packed, the next is laid out."""

    def pack(part: _Part, starts: Int, content: NDArray[np.uint8]) -> _Packed:
        plain = content.data
        return _Packed(part, starts, len(plain), checksum(plain), compress(plain))

    waiting = deque[Future[_Packed]]()
    with ThreadPoolExecutor(1) as packer:  # one, as a compressor is not for two at a time
        for part in parts:
            waiting.append(packer.submit(pack, part, *_records(part, channels)))
            if len(waiting) > _PACKED_AHEAD:
                yield waiting.popleft().result()
        for chunk in waiting:
            yield chunk.result()


def _write_chunk(out: _Out, chunk: _Packed, compression: str) -> bytes:
    """Write a chunk and its message indexes; return its chunk index record."""
    part, packed = chunk.part, chunk.packed
    span = struct.pack("<QQ", int(part.log_time_ns.min()), int(part.log_time_ns.max()))
    begin = out.size
    head = span + struct.pack("<QI", chunk.size, chunk.crc) + text(compression)
    out.write(record(CHUNK, head + struct.pack("<Q", len(packed)) + packed))
    chunk_size, index_begin, places = out.size - begin, out.size, b""
    for number, rows in part.by_channel:
        entries = np.empty(len(rows), INDEX_ENTRY)
        entries["log_time"], entries["offset"] = part.log_time_ns[rows], chunk.starts[rows]
        places += struct.pack("<HQ", number + 1, out.size)
        out.write(record(MESSAGE_INDEX, struct.pack("<H", number + 1) + text(entries.tobytes())))
    sizes = struct.pack("<Q", out.size - index_begin) + text(compression)
    sizes += struct.pack("<QQ", len(packed), chunk.size)
    return record(CHUNK_INDEX, span + struct.pack("<QQ", begin, chunk_size) + text(places) + sizes)


def _records(part: _Part, channels: Sequence[Channel]) -> tuple[Int, NDArray[np.uint8]]:
    """Whole message records of a chunk: where each begins, and the bytes."""
    size = MESSAGE_HEAD.itemsize + part.length
    starts = np.cumsum(size) - size
    content = np.empty(int(size.sum()), np.uint8)
    head = np.zeros(len(size), MESSAGE_HEAD)
    head["opcode"] = MESSAGE
    head["length"] = MESSAGE_FIELDS + part.length
    head["channel"] = part.channel + 1
    head["sequence"] = part.message
    head["log_time"] = head["publish_time"] = part.log_time_ns
    _scatter(content, starts, head.view(np.uint8).reshape(len(head), -1))
    for number, rows in part.by_channel:
        bodies = channels[number].payloads[_as_slice(part.message[rows])]
        places = starts[rows] + MESSAGE_HEAD.itemsize
        if bodies.width:
            _scatter(content, places, np.asarray(bodies.content).reshape(-1, bodies.width))
        else:
            content[ragged_indices(places, bodies.lengths)] = np.asarray(bodies.content)
    return starts, content


def _as_slice(rows: NDArray[np.uint32]) -> NDArray[np.uint32] | slice:
    """Rows that follow each other as a slice: those of sorted times do."""
    first, last = int(rows[0]), int(rows[-1])
    if last - first + 1 == len(rows) and bool(np.all(rows[1:] > rows[:-1])):
        return slice(first, last + 1)
    return rows


def _scatter(content: NDArray[np.uint8], starts: Int, rows: NDArray[np.uint8]) -> None:
    """Lay each row of bytes down at its start."""
    width = rows.shape[1]
    overlapping_windows(content, width)[starts] = np.ascontiguousarray(rows).view(f"V{width}")[:, 0]


def _schemas_and_channels(channels: Sequence[Channel]) -> tuple[bytes, bytes]:
    """Return schema records, each once, and channel records; a channel without schema has 0."""
    known: dict[tuple[str, str, bytes], int] = {}
    schemas = records = b""
    for number, channel in enumerate(channels, start=1):
        key = (channel.type, channel.schema_encoding, channel.definition)
        if channel.schema_encoding and key not in known:
            known[key] = len(known) + 1
            body = struct.pack("<H", known[key]) + text(channel.type)
            schemas += record(SCHEMA, body + text(channel.schema_encoding) + text(key[2]))
        metadata = b"".join(text(k) + text(v) for k, v in sorted(channel.metadata.items()))
        body = struct.pack("<HH", number, known.get(key, 0)) + text(channel.topic)
        records += record(CHANNEL, body + text(channel.message_encoding) + text(metadata))
    return schemas, records


def _statistics(channels: Sequence[Channel], n_chunks: int) -> bytes:
    counts = [len(c.log_time_ns) for c in channels]
    times = [c.log_time_ns for c in channels if len(c.log_time_ns)]
    first = min((int(t.min()) for t in times), default=0)
    last = max((int(t.max()) for t in times), default=0)
    known = {(c.type, c.schema_encoding, c.definition) for c in channels if c.schema_encoding}
    numbers = (sum(counts), len(known), len(channels), 0, 0, n_chunks, first, last)
    by_channel = b"".join(struct.pack("<HQ", i, n) for i, n in enumerate(counts, start=1))
    return record(STATISTICS, struct.pack("<QHIIIIQQ", *numbers) + text(by_channel))


def _write_summary(out: _Out, groups: Sequence[bytes]) -> None:
    """Write the summary, where each kind of record begins in it, and the footer."""
    start, offsets = out.size, b""
    summary = b"".join(groups)
    position = start
    for group in groups:
        if group:
            offsets += record(SUMMARY_OFFSET, struct.pack("<BQQ", group[0], position, len(group)))
        position += len(group)
    summary_start = start if summary else 0
    foot = struct.pack("<QQ", summary_start, start + len(summary) if offsets else 0)
    head = record(FOOTER, foot + b"\0\0\0\0")[:-4]
    crc = checksum(summary + offsets + head)
    out.write(summary + offsets + head + struct.pack("<I", crc) + MAGIC)


def _compressor(compression: str, level: int) -> Callable[[memoryview], bytes]:
    if compression == "zstd":
        import zstandard

        return zstandard.ZstdCompressor(level=level).compress
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.compress  # type: ignore[no-any-return]
    if compression == "":
        return bytes
    raise ValueError(f"compression {compression!r}; zstd, lz4 or '' expected")
