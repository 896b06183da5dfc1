# SPDX-License-Identifier: Apache-2.0
"""MCAP records, as far as reading and writing share them.

A record is an opcode (u8), a length (u64) and as many bytes, all little-endian.  Source: the MCAP
format specification, version 1.0.
"""

import struct
from typing import Final

import numpy as np

try:  # ten times as fast; the checksum is then a tenth of decompression, not half of it
    from zlib_ng.zlib_ng import crc32
except ImportError:  # no wheel for this machine
    from zlib import crc32

MAGIC: Final = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA = range(0x09, 0x0D)
SUMMARY_OFFSET, DATA_END = 0x0E, 0x0F
PREFIX: Final = struct.Struct("<BQ")  #: opcode and length of every record
FOOTER_FIELDS: Final = struct.Struct("<QQI")  #: summary start, offset start, CRC

#: A message record up to its payload.
MESSAGE_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
#: What `length` counts of a message record before the payload.
MESSAGE_FIELDS: Final = MESSAGE_HEAD.itemsize - PREFIX.size
#: One entry of a message index.
INDEX_ENTRY: Final = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


def checksum(data: bytes | memoryview, before: int = 0) -> int:
    """CRC-32 of `data`, going on from that of what came before it."""
    return crc32(data, before)


def record(opcode: int, body: bytes) -> bytes:
    """One whole record."""
    return PREFIX.pack(opcode, len(body)) + body


def text(value: str | bytes) -> bytes:
    """Text or bytes with their length before them."""
    raw = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(raw)) + raw


class CorruptRecordError(Exception):
    """A record that does not hold what its length promises; never leaves `formats`."""

    def __init__(self, message: str, pos: int | None = None) -> None:
        super().__init__(message)
        self.pos = pos  #: where the record begins, if it is known


class Fields:
    """A record's fields, read in order; padding behind the known ones is legal."""

    def __init__(self, body: memoryview) -> None:
        self.body, self.pos = body, 0

    def raw(self, length: int) -> memoryview:
        """Return the next `length` bytes."""
        if length > len(self.body) - self.pos:
            raise CorruptRecordError(f"{length} bytes wanted, {len(self.body) - self.pos} left")
        self.pos += length
        return self.body[self.pos - length : self.pos]

    def numbers(self, layout: str) -> tuple[int, ...]:
        """Return the next numbers, in the letters of `struct`."""
        return struct.unpack("<" + layout, self.raw(struct.calcsize("<" + layout)))

    def number(self, layout: str) -> int:
        """Return the next number."""
        return self.numbers(layout)[0]

    def block(self) -> memoryview:
        """Return the next bytes with their length (u32) before them."""
        return self.raw(self.number("I"))

    def text(self) -> str:
        """Return the next text; bytes that are no UTF-8 are marked, not refused."""
        return bytes(self.block()).decode("utf-8", "replace")
