# SPDX-License-Identifier: Apache-2.0
"""Behind damage that no summary leads around: the next chunk, told by what a chunk must be."""

from collections.abc import Iterator

import numpy as np

from abyssnav.formats.columns import gather_fixed
from abyssnav.formats.mcap.chunks import MAX_CHUNK_BYTES, Chunk, room_for, unpack, walk
from abyssnav.formats.mcap.records import (
    CHANNEL,
    CHUNK,
    MESSAGE,
    PREFIX,
    SCHEMA,
    CorruptRecordError,
)
from abyssnav.tables import Int

#: A chunk record up to the name of its compression.
_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("first", "<u8"),
        ("last", "<u8"),
        ("size", "<u8"),
        ("crc", "<u4"),
        ("name", "<u4"),
    ]
)
_LONGEST_NAME = len("zstd")
_INSIDE = {SCHEMA, CHANNEL, MESSAGE}  #: records of a chunk
_BLOCK = 1 << 22  #: bytes looked through at once
#: Bytes unpacked in vain, until the search is given up; a try costs something in any case.
_MOST_TRIED, _TRY = 1 << 30, 1 << 12


def next_chunk(buffer: memoryview, start: int) -> int | None:
    """Where the first chunk at or behind `start` begins; None when there is none.

    Its head must make sense, and it must unpack to the size that it declares with the right CRC,
    or, where it has none, to messages from end to end.  The time taken is bounded: it grows with
    the bytes behind `start`, plus a second or so for what only looks like a chunk.
    """
    tried = 0
    for pos in _candidates(buffer, start):
        chunk = _parsed(buffer, pos)
        if chunk is None:
            tried += _TRY
        elif _holds(chunk):
            return pos
        else:
            tried += _TRY + chunk.size
        if tried > _MOST_TRIED:
            break
    return None


def _candidates(buffer: memoryview, start: int) -> Iterator[int]:
    """Places where a chunk's head could be."""
    content = np.frombuffer(buffer, np.uint8)
    for block in range(start, len(content), _BLOCK):
        pos: Int = block + np.flatnonzero(content[block : block + _BLOCK] == CHUNK)
        pos = pos[pos <= len(content) - _HEAD.itemsize]
        heads = gather_fixed(content, pos, _HEAD.itemsize).view(_HEAD)[:, 0]
        room = (len(content) - PREFIX.size - pos).astype(np.uint64)
        likely = (
            (heads["length"] <= room)
            & (heads["first"] <= heads["last"])
            & (heads["size"] <= MAX_CHUNK_BYTES)
            & (heads["name"] <= _LONGEST_NAME)
        )
        yield from pos[likely].tolist()


def _parsed(buffer: memoryview, pos: int) -> Chunk | None:
    _, length = PREFIX.unpack_from(buffer, pos)
    try:
        return Chunk.parse(pos, buffer[pos + PREFIX.size : pos + PREFIX.size + length], cut=False)
    except CorruptRecordError:
        return None


def _holds(chunk: Chunk) -> bool:
    room = np.empty(room_for(chunk), np.uint8)
    try:
        size = unpack(chunk, room.data)
        return chunk.crc != 0 or {opcode for opcode, _, _ in walk(room.data, 0, size)} <= _INSIDE
    except CorruptRecordError:
        return False
