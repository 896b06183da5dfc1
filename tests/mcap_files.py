# SPDX-License-Identifier: Apache-2.0
"""MCAP files made record by record from the specification, and what our reader makes of a file."""

import itertools
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from abyssnav.formats.columns import Ragged
from abyssnav.formats.mcap.accumulator import PAYLOADS
from abyssnav.formats.mcap.reader import Recording, read_mcap

MAGIC = b"\x89MCAP0\r\n"
Message = tuple[str, int, bytes]  # topic, log time, payload

#: What the published conformance files hold: schema, channel, messages (sequence, log, publish).
TEN = [(i, t, t) for i, t in enumerate((0, 2, 1, 3, 3, 5, 4, 7, 8, 9))]
CONTENTS = {
    "NoData": [],
    "OneAttachment": [],
    "OneMetadata": [],
    "OneMessage": [(10, 2, 1)],
    "OneSchemalessMessage": [(10, 2, 1)],
    "TenMessages": TEN,
}
FEATURES = ("ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad")


def conformance_variants() -> Iterator[tuple[str, frozenset[str]]]:
    """All 416 combinations of contents and features that make sense together."""
    for base, messages in CONTENTS.items():
        possible = {"st", "sum", "pad"}
        possible |= {"ch", "mx", "chx", "rch", "rsh"} if messages else set()
        possible -= {"rsh"} if base == "OneSchemalessMessage" else set()
        possible |= {"OneAttachment": {"ax"}, "OneMetadata": {"mdx"}}.get(base, set())
        ordered = [feature for feature in FEATURES if feature in possible]
        for flags in itertools.product((False, True), repeat=len(ordered)):
            chosen = frozenset(itertools.compress(ordered, flags))
            in_summary = chosen & {"st", "rsh", "rch", "ax", "mdx", "chx"}
            if "ch" not in chosen and chosen & {"mx", "chx"}:
                continue
            if "sum" in chosen and not in_summary:
                continue
            yield base, chosen


def text(value: str) -> bytes:
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw


def record(opcode: int, body: bytes, pad: bool = False) -> bytes:
    body += b"\x01\xff\xff" if pad else b""
    return struct.pack("<BQ", opcode, len(body)) + body


def schema_record(pad: bool = False) -> bytes:
    return record(3, struct.pack("<H", 1) + text("Example") + text("c") + b"\3\0\0\0\4\5\6", pad)


def channel_record(schema_id: int = 1, pad: bool = False) -> bytes:
    encoding, pairs = ("a", text("foo") + text("bar")) if schema_id else ("text", b"")
    body = struct.pack("<HH", 1, schema_id) + text("example") + text(encoding)
    return record(4, body + struct.pack("<I", len(pairs)) + pairs, pad)


def message_record(sequence: int, log: int, publish: int, payload: bytes = b"\1\2\3") -> bytes:
    return record(5, struct.pack("<HIQQ", 1, sequence, log, publish) + payload)


def chunk_record(plain: bytes, first: int, last: int, crc: int | None = None) -> bytes:
    crc = zlib.crc32(plain) if crc is None else crc
    head = struct.pack("<QQQI", first, last, len(plain), crc) + text("")
    return record(6, head + struct.pack("<Q", len(plain)) + plain)


def conformance_file(base: str, features: frozenset[str]) -> bytes:
    """One file of the conformance suite, from its published description."""
    messages, pad = CONTENTS[base], "pad" in features
    schema_id = 0 if base == "OneSchemalessMessage" else 1
    out = MAGIC + record(1, text("") + text(""), pad)
    extra, extra_index = extra_record(base, len(out), pad)
    out += extra
    chunk_index = b""
    if messages:
        data, chunk_index = message_data(base, features, len(out))
        out += data
    out += record(15, struct.pack("<I", zlib.crc32(out)), pad)
    in_order = {
        "rsh": schema_record(pad) if messages and schema_id else b"",
        "rch": channel_record(schema_id, pad) if messages else b"",
        "st": statistics_record(base, features),
        "ax": record(10, extra_index, pad),
        "mdx": record(13, extra_index, pad),
        "chx": record(8, chunk_index, pad),
    }
    summary = [made for feature, made in in_order.items() if feature in features and made]
    return out + end_of_file(len(out), summary, "sum" in features, pad)


def extra_record(base: str, begin: int, pad: bool) -> tuple[bytes, bytes]:
    """An attachment or metadata, and the body of its index."""
    if base == "OneAttachment":
        body = struct.pack("<QQ", 2, 1) + text("myFile") + text("application/octet-stream")
        body += struct.pack("<Q", 3) + b"\1\2\3"
        made = record(9, body + struct.pack("<I", zlib.crc32(body)))
        index = struct.pack("<QQQQQ", begin, len(made), 2, 1, 3)
        return made, index + text("myFile") + text("application/octet-stream")
    if base == "OneMetadata":
        pairs = text("testKey") + text("testValue")
        made = record(12, text("myMetadata") + struct.pack("<I", len(pairs)) + pairs, pad)
        return made, struct.pack("<QQ", begin, len(made)) + text("myMetadata")
    return b"", b""


def message_data(base: str, features: frozenset[str], begin: int) -> tuple[bytes, bytes]:
    """Definitions and messages, in a chunk or not, and the body of the chunk's index."""
    chunked, schema_id = "ch" in features, base != "OneSchemalessMessage"
    pad = "pad" in features and not chunked  # records in chunks are not padded
    body = schema_record(pad) if schema_id else b""
    body += channel_record(int(schema_id), pad)
    times, offsets = [log for _, log, _ in CONTENTS[base]], []
    for message in CONTENTS[base]:
        offsets.append((message[1], len(body)))
        body += message_record(*message)
    if not chunked:
        return body, b""
    chunk = chunk_record(body, min(times), max(times))
    pairs = b"".join(struct.pack("<QQ", *pair) for pair in offsets)
    index = record(7, struct.pack("<HI", 1, len(pairs)) + pairs, "pad" in features)
    index = index if "mx" in features else b""
    places = struct.pack("<HQ", 1, begin + len(chunk)) if index else b""
    chunk_index = struct.pack("<QQQQ", min(times), max(times), begin, len(chunk))
    chunk_index += struct.pack("<I", len(places)) + places
    chunk_index += struct.pack("<Q", len(index)) + text("")
    return chunk + index, chunk_index + struct.pack("<QQ", len(body), len(body))


def statistics_record(base: str, features: frozenset[str]) -> bytes:
    times = [log for _, log, _ in CONTENTS[base]]
    n, span = len(times), (min(times, default=0), max(times, default=0))
    with_schema = n > 0 and base != "OneSchemalessMessage"
    numbers = (n, with_schema, n > 0, base == "OneAttachment", base == "OneMetadata",
               "ch" in features, *span)  # fmt: skip
    counts = struct.pack("<HQ", 1, n) if n else b""
    body = struct.pack("<QHIIIIQQ", *numbers) + struct.pack("<I", len(counts)) + counts
    return record(11, body, "pad" in features)


def end_of_file(start: int, summary: list[bytes], with_offsets: bool, pad: bool = False) -> bytes:
    """Summary, its offsets, footer and magic."""
    offsets, at = b"", start
    for group in summary:
        offsets += record(14, struct.pack("<BQQ", group[0], at, len(group)), pad)
        at += len(group)
    offsets = offsets if with_offsets else b""
    whole = b"".join(summary) + offsets
    foot = struct.pack("<BQQQ", 2, 20, start if whole else 0, at if offsets else 0)
    return whole + foot + struct.pack("<I", zlib.crc32(whole + foot)) + MAGIC


def recording_of(path: Path, data: bytes) -> tuple[list[Message], Recording]:
    """Write the bytes to `path` and read them: messages by log time, and what was found."""
    path.write_bytes(data)
    recording = read_mcap(path, lambda _: PAYLOADS)
    found: list[Message] = []
    for part in recording.messages:
        payloads = part.columns["payload"]
        assert isinstance(payloads, Ragged)
        rows = zip(part.log_time_ns.tolist(), payloads.row_bytes(), strict=True)
        found += [(part.channel.topic, time, row) for time, row in rows]
    order = np.argsort([time for _, time, _ in found], kind="stable")
    return [found[i] for i in order], recording
