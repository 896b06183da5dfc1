# SPDX-License-Identifier: Apache-2.0
"""MCAP files made record by record from the specification, and what our reader makes of a file."""

import itertools
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.formats.gathering import PAYLOADS
from pipeline.formats.mcap import Recording, read_mcap
from pipeline.formats.ragged import Ragged

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
    summary: list[bytes] = []
    attachments = metadata = b""
    if base == "OneAttachment":
        body = struct.pack("<QQ", 2, 1) + text("myFile") + text("application/octet-stream")
        body += struct.pack("<Q", 3) + b"\1\2\3"
        attachments = record(9, body + struct.pack("<I", zlib.crc32(body)))
        index = struct.pack("<QQQQQ", len(out), len(attachments), 2, 1, 3)
        index += text("myFile") + text("application/octet-stream")
    if base == "OneMetadata":
        pairs = text("testKey") + text("testValue")
        metadata = record(12, text("myMetadata") + struct.pack("<I", len(pairs)) + pairs, pad)
        index = struct.pack("<QQ", len(out), len(metadata)) + text("myMetadata")
    out += attachments + metadata
    times = [log for _, log, _ in messages]
    chunk_index = b""
    if messages:
        inside = pad and "ch" not in features  # records in chunks are not padded
        definitions = schema_record(inside) if schema_id else b""
        definitions += channel_record(schema_id, inside)
        body, offsets = definitions, []
        for message in messages:
            offsets.append((message[1], len(body)))
            body += message_record(*message)
        if "ch" in features:
            begin, chunk = len(out), chunk_record(body, min(times), max(times))
            pairs = b"".join(struct.pack("<QQ", *pair) for pair in offsets)
            index_record = record(7, struct.pack("<HI", 1, len(pairs)) + pairs, pad)
            index_record = index_record if "mx" in features else b""
            places = struct.pack("<HQ", 1, begin + len(chunk)) if index_record else b""
            chunk_index = struct.pack("<QQQQ", min(times), max(times), begin, len(chunk))
            chunk_index += struct.pack("<I", len(places)) + places
            chunk_index += struct.pack("<Q", len(index_record)) + text("")
            chunk_index += struct.pack("<QQ", len(body), len(body))
            body = chunk + index_record
        out += body
    out += record(15, struct.pack("<I", zlib.crc32(out)), pad)
    if messages and schema_id and "rsh" in features:
        summary.append(schema_record(pad))
    if messages and "rch" in features:
        summary.append(channel_record(schema_id, pad))
    if "st" in features:
        n, span = len(messages), (min(times, default=0), max(times, default=0))
        numbers = (n, bool(messages and schema_id), bool(messages), bool(attachments),
                   bool(metadata), bool(chunk_index), *span)  # fmt: skip
        counts = struct.pack("<HQ", 1, n) if messages else b""
        body = struct.pack("<QHIIIIQQ", *numbers) + struct.pack("<I", len(counts)) + counts
        summary.append(record(11, body, pad))
    if "ax" in features:
        summary.append(record(10, index, pad))
    if "mdx" in features:
        summary.append(record(13, index, pad))
    if "chx" in features:
        summary.append(record(8, chunk_index, pad))
    return out + end_of_file(len(out), summary, "sum" in features, pad)


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
