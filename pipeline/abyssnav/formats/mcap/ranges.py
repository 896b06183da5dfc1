# SPDX-License-Identifier: Apache-2.0
"""Which bytes of an MCAP file are needed for some topics, from its end alone."""

import struct
import zlib
from collections.abc import Container
from dataclasses import dataclass, field
from typing import Final

from abyssnav.formats.mcap.records import (
    CHANNEL,
    CHUNK_INDEX,
    FOOTER,
    FOOTER_FIELDS,
    MAGIC,
    PREFIX,
    SCHEMA,
    STATISTICS,
    DamagedError,
    Fields,
)

_ATTACHMENT_INDEX: Final = 0x0A
#: Prefix and fixed fields of a chunk, its compression's name not counted.
_CHUNK_HEAD: Final = PREFIX.size + struct.calcsize("<QQQIIQ")
_ATTACHMENT_HEAD: Final = PREFIX.size + 64
_FOOT: Final = PREFIX.size + FOOTER_FIELDS.size + len(MAGIC)

Range = tuple[int, int]


def summary_start(tail: bytes, size: int) -> int | None:
    """Where the summary of a file begins, from its last bytes; None when it has none.

    Parameters
    ----------
    tail : the file's last bytes, 37 or more
    size : of the whole file
    """
    if len(tail) < _FOOT or not tail.endswith(MAGIC):
        return None
    opcode, length = PREFIX.unpack_from(tail, len(tail) - _FOOT)
    start, _, _ = FOOTER_FIELDS.unpack_from(tail, len(tail) - _FOOT + PREFIX.size)
    whole = opcode == FOOTER and length == FOOTER_FIELDS.size and len(MAGIC) < start < size
    return start if whole else None


def dispensable(summary: bytes, start: int, topics: Container[str]) -> list[Range]:
    """Bytes that hold nothing of `topics`: bodies of chunks without them, and of attachments.

    Parameters
    ----------
    summary : the file from `start`, where its summary begins, to its end

    Returns
    -------
    ranges : rising, from the first byte to the one after the last; none when in doubt
    """
    found = _Found(topics)
    body = memoryview(summary)[: len(summary) - _FOOT]
    _, _, crc = FOOTER_FIELDS.unpack_from(summary, len(summary) - _FOOT + PREFIX.size)
    if crc and zlib.crc32(summary[: len(summary) - len(MAGIC) - 4]) != crc:
        return []
    try:
        at = 0
        while at < len(body):
            opcode, length = Fields(body[at:]).numbers("BQ")
            fields = Fields(body[at + PREFIX.size :])
            found.take(opcode, Fields(fields.raw(length)))
            at += PREFIX.size + length
    except DamagedError:
        return []
    return [(low, high) for low, high in found.ranges() if low < high <= start]


@dataclass
class _Found:
    """Channels wanted, and places of chunks and attachments."""

    topics: Container[str]
    wanted: set[int] = field(default_factory=set)
    channels: dict[int, int] = field(default_factory=dict)  #: and their schemas
    schemas: set[int] = field(default_factory=lambda: {0})
    chunks: list[tuple[Range, set[int]]] = field(default_factory=list)
    attachments: list[Range] = field(default_factory=list)
    counted: bool = False

    def take(self, opcode: int, fields: Fields) -> None:
        if opcode == CHANNEL:
            number, schema = fields.numbers("HH")
            self.channels[number] = schema
            if fields.text() in self.topics:
                self.wanted.add(number)
        elif opcode == SCHEMA:
            self.schemas.add(fields.number("H"))
        elif opcode == CHUNK_INDEX:
            _, _, start, length = fields.numbers("QQQQ")
            offsets = Fields(fields.block())
            channels = set()
            while offsets.at < len(offsets.body):
                channels.add(offsets.numbers("HQ")[0])
            fields.number("Q")
            head = _CHUNK_HEAD + len(fields.block())
            self.chunks.append(((start + head, start + length), channels))
        elif opcode == STATISTICS:
            self.counted = True
        elif opcode == _ATTACHMENT_INDEX:
            start, length = fields.numbers("QQ")
            self.attachments.append((start + _ATTACHMENT_HEAD, start + length))

    def ranges(self) -> list[Range]:
        if not (self.counted and self.chunks):
            return []  # messages may lie outside chunks
        held = set[int]().union(*(channels for _, channels in self.chunks))
        if not (held <= self.channels.keys() and self.schemas.issuperset(self.channels.values())):
            return []  # a chunk may hold what names the topics
        # A chunk without a message index may hold anything.
        chunks = [place for place, held in self.chunks if held and not held & self.wanted]
        return sorted(chunks + self.attachments)
