# SPDX-License-Identifier: Apache-2.0
"""MCAP, read and written: every valid file, and what becomes of broken ones."""

import dataclasses
import io
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_files import (
    CONTENTS,
    MAGIC,
    Message,
    channel_record,
    chunk_record,
    conformance_file,
    conformance_variants,
    end_of_file,
    message_record,
    record,
    recording_of,
    schema_record,
    text,
)
from rosbags.highlevel import AnyReader

from abyssnav.errors import ReadError
from abyssnav.formats.columns import FieldSlice, Ragged, WireLayout
from abyssnav.formats.decoding import field_decoder
from abyssnav.formats.mcap import chunks
from abyssnav.formats.mcap.accumulator import PAYLOADS, ChannelDecoder
from abyssnav.formats.mcap.reader import Recording, read_mcap
from abyssnav.formats.mcap.writer import Channel, ros2_channel, write_mcap

VARIANTS = list(conformance_variants())
#: Enough features for each part of a file to be there, and to be missing.
BROKEN = [
    ("TenMessages", frozenset({"ch", "mx", "st", "rsh", "rch", "chx", "sum", "pad"})),
    ("TenMessages", frozenset({"ch", "mx"})),
    ("TenMessages", frozenset({"ch", "pad"})),
    ("TenMessages", frozenset({"st", "rsh", "rch", "sum", "pad"})),
    ("TenMessages", frozenset()),
]
NAMES = ["-".join(sorted(features)) or "plain" for _, features in BROKEN]


def expected(base: str) -> list[Message]:
    times = sorted(log for _, log, _ in CONTENTS[base])
    return [("example", time, b"\1\2\3") for time in times]


def crcs(data: bytes) -> tuple[int, int]:
    """Data and summary CRC as the official library finds them in a file."""
    records = {
        type(r).__name__: r for r in StreamReader(io.BytesIO(data), emit_chunks=True).records
    }
    return records["DataEnd"].data_section_crc, records["Footer"].summary_crc  # type: ignore[attr-defined]


def test_the_suite_has_416_files_with_the_published_checksums() -> None:
    assert len(VARIANTS) == len(set(VARIANTS)) == 416
    full = frozenset({"ch", "mx", "st", "rsh", "rch", "chx", "sum", "pad"})
    assert crcs(conformance_file("TenMessages", full)) == (3282868494, 829723996)
    bare = conformance_file("OneSchemalessMessage", full - {"rsh"})
    assert crcs(bare) == (3715123221, 239768738)


@pytest.mark.parametrize("base", CONTENTS)
def test_every_conformance_file_gives_its_messages_and_no_finding(
    base: str, tmp_path: Path
) -> None:
    for features in (features for name, features in VARIANTS if name == base):
        data = conformance_file(base, features)
        found, recording = recording_of(tmp_path / "a.mcap", data)
        assert found == expected(base), sorted(features)
        assert recording.findings == (), sorted(features)
        counted = sum(count.messages for count in recording.counts.values())
        assert counted == len(CONTENTS[base])


@pytest.mark.parametrize(("base", "features"), BROKEN, ids=NAMES)
def test_a_file_cut_anywhere_gives_all_before_the_cut_and_says_so(
    base: str, features: frozenset[str], tmp_path: Path
) -> None:
    data, path = conformance_file(base, features), tmp_path / "cut.mcap"
    payload_ends = [i + 3 for i in range(len(data)) if data[i : i + 3] == b"\1\2\3"]
    in_data = data.index(b"\x0f\x04\0\0\0\0\0\0\0") if not features & {"pad"} else len(data)
    for length in range(8, len(data)):
        found, recording = recording_of(path, data[:length])
        before = sum(end <= length for end in payload_ends)
        assert any(f.what == "cut short" for f in recording.findings), length
        assert set(found) <= set(expected(base))
        if not features & {"pad"}:  # padding looks like payload
            assert len(found) == min(before, len(expected(base))) or length > in_data, length
    for length in range(8):
        path.write_bytes(data[:length])
        with pytest.raises(ReadError, match="not MCAP"):
            read_mcap(path, lambda _: None)


@pytest.mark.parametrize(("base", "features"), BROKEN, ids=NAMES)
def test_a_flipped_bit_never_changes_messages_without_a_finding(
    base: str, features: frozenset[str], tmp_path: Path
) -> None:
    data, path = conformance_file(base, features), tmp_path / "flip.mcap"
    for place in range(8, len(data)):
        broken = bytearray(data)
        broken[place] ^= 1 << (place * 5) % 8  # another bit in each byte
        found, recording = recording_of(path, bytes(broken))
        assert found == expected(base) or recording.findings, place
        guarded = "chx" in features and 28 <= place < 28 + 470
        assert not guarded or set(found) <= set(expected(base)), place


def test_what_does_not_begin_as_mcap_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(ReadError, match=r"a\.mcap: not MCAP: it begins with b'#ROSBAG ', not"):
        read_mcap(path, lambda _: None)
    with pytest.raises(ReadError, match=r"none\.mcap: cannot be read: No such file"):
        read_mcap(tmp_path / "none.mcap", lambda _: None)


# --- written by us ------------------------------------------------------------------------------


def example_channels(n: int = 500) -> list[Channel]:
    """Three topics whose times interleave, tie and are out of order; one of them empty."""
    times = 10**18 + np.arange(n) * 10**7
    late = times[::3] + np.where(np.arange(len(times[::3])) % 7 == 0, 10**9, 0)
    names = [f"beacon {i}" for i in range(len(late))]
    innovation = "abyssnav_msgs/msg/TravelTimeInnovation"
    return [
        ros2_channel("/depth", "abyssnav_msgs/msg/Depth", times, {"depth": np.arange(n) / 7}),
        ros2_channel("/text", innovation, late, {"decision": names, "nis": np.arange(len(late))}),
        ros2_channel("/none", "abyssnav_msgs/msg/Depth", times[:0], {}),
    ]


def rows_of(channels: list[Channel]) -> list[Message]:
    rows = [
        (c.topic, time, payload)
        for c in channels
        for time, payload in zip(c.log_time_ns.tolist(), c.payloads.row_bytes(), strict=True)
    ]
    return sorted(rows, key=lambda row: row[1])


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_what_we_write_the_official_library_rosbags_and_we_read_back(
    compression: str, tmp_path: Path
) -> None:
    path, channels = tmp_path / "a.mcap", example_channels()
    write_mcap(path, channels, compression, chunk_bytes=5000)
    rows = sorted(rows_of(channels))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        official = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        summary = reader.get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) > 5
        for chunk in summary.chunk_indexes:  # a record each, of the length that its index says
            file.seek(chunk.chunk_start_offset)
            kind, length = struct.unpack("<BQ", file.read(9))
            assert (kind, length) == (6, chunk.chunk_length - 9)
        assert reader.get_header().profile == "ros2"
        assert {c.topic: c.metadata for c in summary.channels.values()} == {
            topic: {"offered_qos_profiles": ""} for topic in ("/depth", "/text", "/none")
        }
    assert [time for _, time, _ in official] == sorted(time for _, time, _ in rows)
    assert sorted(official) == rows
    with path.open("rb") as file:
        streamed = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        assert sorted((c.topic, m.log_time, m.data) for _, c, m in streamed) == rows
    with AnyReader([path]) as bags:
        assert sorted((c.topic, t, bytes(raw)) for c, t, raw in bags.messages()) == rows
        values = [
            bags.deserialize(raw, c.msgtype).depth for c, _, raw in bags.messages()  # type: ignore[attr-defined]
            if c.topic == "/depth"
        ]  # fmt: skip
    assert values == (np.arange(500) / 7).tolist()
    found, recording = recording_of(tmp_path / "b.mcap", path.read_bytes())
    assert sorted(found) == rows
    assert recording.findings == ()
    assert [c.topic for c in recording.channels] == ["/depth", "/text", "/none"]


def test_the_same_channels_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        write_mcap(tmp_path / name, example_channels())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_wrong_arguments_to_the_writer_are_refused(tmp_path: Path) -> None:
    channel = example_channels(3)[0]
    with pytest.raises(ValueError, match="compression 'gzip'; zstd, lz4 or '' expected"):
        write_mcap(tmp_path / "a.mcap", [channel], "gzip")
    short = dataclasses.replace(channel, log_time_ns=channel.log_time_ns[:2])
    with pytest.raises(ValueError, match="/depth: 2 times for 3 payloads"):
        write_mcap(tmp_path / "a.mcap", [short])


# --- written by others --------------------------------------------------------------------------

WRITERS = {
    "usual": {},
    "unchunked": {"use_chunking": False},
    "no index": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.ALL & ~IndexType.MESSAGE},
    "no summary": {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False,
                   "use_summary_offsets": False, "index_types": IndexType.MESSAGE},
    "names in chunks only": {"repeat_channels": False, "repeat_schemas": False},
    "schemas in chunks only": {"repeat_schemas": False},
    "lz4": {"compression": CompressionType.LZ4},
    "no compression": {"compression": CompressionType.NONE},
    "no CRC": {"enable_crcs": False},
    "CRC of the data": {"enable_data_crcs": True, "use_chunking": False},
}  # fmt: skip


#: Of these there is one finding: that nobody can tell a changed byte.
UNCHECKED = ("unchunked", "no CRC")


def officially_written(channels: list[Channel], **options: Any) -> bytes:
    """The same messages by the official writer."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=4000, **options)
    writer.start(profile="ros2", library="test")
    ids = {}
    for channel in channels:
        schema = writer.register_schema(channel.type, "ros2msg", channel.definition)
        ids[channel.topic] = writer.register_channel(channel.topic, "cdr", schema)
    for topic, time, payload in rows_of(channels):
        writer.add_message(ids[topic], time, payload, time)
    writer.finish()
    return file.getvalue()


@pytest.mark.parametrize("name", WRITERS)
def test_files_of_the_official_writer_are_read_whole(name: str, tmp_path: Path) -> None:
    channels = example_channels()
    data = officially_written(channels, **WRITERS[name])
    found, recording = recording_of(tmp_path / "a.mcap", data)
    assert sorted(found) == sorted(rows_of(channels))
    assert [f.what for f in recording.findings] == ["no checksums"] * (name in UNCHECKED)


@pytest.mark.parametrize(
    ("name", "detail"),
    [
        ("no CRC", "{n} of {n} chunks have none: a changed byte in them cannot be told"),
        ("unchunked", "messages outside chunks have none: a changed byte in them cannot be told"),
    ],
)
def test_a_file_without_checksums_is_named_once(name: str, detail: str, tmp_path: Path) -> None:
    data = officially_written(example_channels(), **WRITERS[name])
    _, recording = recording_of(tmp_path / "a.mcap", data)
    (finding,) = recording.findings
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary
    n = len(summary.chunk_indexes)
    assert (finding.what, finding.where) == ("no checksums", "a.mcap")
    assert finding.detail == detail.format(n=n)


def fields_of(path: Path, wanted: dict[str, list[str]]) -> Recording:
    """What is read of a file's topics by their fields, as a dive is."""
    return read_mcap(
        path, lambda c: field_decoder(c, wanted[c.topic]) if c.topic in wanted else None
    )


@pytest.mark.parametrize("options", WRITERS.values(), ids=WRITERS)
def test_fields_are_found_wherever_the_writer_names_their_types(
    options: dict[str, Any], tmp_path: Path
) -> None:
    channels = example_channels()
    (tmp_path / "a.mcap").write_bytes(officially_written(channels, **options))
    (depth,) = fields_of(tmp_path / "a.mcap", {"/depth": ["depth"]}).messages
    assert depth.problem is None
    assert np.array_equal(depth.columns["depth"], np.arange(500) / 7)


def sparse_channels() -> list[Channel]:
    """A topic now and then among messages of another."""
    times = 10**18 + np.arange(400) * 10**7
    kind = "abyssnav_msgs/msg/Depth"
    return [
        ros2_channel("/wanted", kind, times[::20], {"depth": np.arange(20)}),
        ros2_channel("/other", kind, times, {"depth": np.zeros(400)}),
    ]


@pytest.mark.parametrize(("byte", "bit"), [(0, 0x80), (9, 3), (11, 1)])
def test_a_chunk_whose_index_lost_a_channel_is_not_passed_over(
    byte: int, bit: int, tmp_path: Path
) -> None:
    data = bytearray(officially_written(sparse_channels()))
    summary = make_reader(io.BytesIO(bytes(data))).get_summary()
    assert summary
    places = [chunk.message_index_offsets for chunk in summary.chunk_indexes]
    data[next(of for of in places if 1 in of)[1] + byte] ^= bit  # opcode, channel, size
    (tmp_path / "a.mcap").write_bytes(data)
    (wanted,) = fields_of(tmp_path / "a.mcap", {"/wanted": ["depth"]}).messages
    assert np.array_equal(wanted.columns["depth"], np.arange(20))


def test_a_chunk_with_a_wrong_length_is_taken_once(tmp_path: Path) -> None:
    data = bytearray(officially_written(sparse_channels()))
    summary = make_reader(io.BytesIO(bytes(data))).get_summary()
    assert summary
    data[summary.chunk_indexes[1].chunk_start_offset + 5] ^= 1
    found, recording = recording_of(tmp_path / "a.mcap", bytes(data))
    assert sorted(found) == sorted(rows_of(sparse_channels()))
    assert [f.what for f in recording.findings] == ["damaged record", "skipped to a chunk"]


def test_a_chunk_whose_mark_is_damaged_is_read_where_the_summary_has_it(tmp_path: Path) -> None:
    data = bytearray(officially_written(sparse_channels()))
    summary = make_reader(io.BytesIO(bytes(data))).get_summary()
    assert summary
    data[summary.chunk_indexes[1].chunk_start_offset] ^= 1  # a message index, by its mark
    found, recording = recording_of(tmp_path / "a.mcap", bytes(data))
    assert sorted(found) == sorted(rows_of(sparse_channels()))
    assert [f.detail for f in recording.findings] == [
        "opcode 7 where the summary has a chunk: read as one"
    ]


def test_what_is_no_end_of_the_data_does_not_end_them(tmp_path: Path) -> None:
    options = {"use_statistics": False, "index_types": IndexType.MESSAGE}
    data = bytearray(officially_written(sparse_channels(), **options))
    index = struct.pack("<BQH", 7, 2 + 4 + 16, 1)  # of one message of the first channel
    data[data.index(index)] = 15
    found, recording = recording_of(tmp_path / "a.mcap", bytes(data))
    assert sorted(found) == sorted(rows_of(sparse_channels()))
    assert "an end of the data where there is more" in recording.findings[0].detail


def test_room_is_made_for_the_bytes_that_can_come_not_for_the_largest_times_all(
    tmp_path: Path,
) -> None:
    rows = [b"\0" * 5_000_000, *(b"\1" * 4 for _ in range(20_000))]
    channel = Channel("/a", "", 10**18 + np.arange(len(rows)), Ragged.from_bytes(rows))
    write_mcap(tmp_path / "a.mcap", [channel], chunk_bytes=1 << 23)
    everything = ChannelDecoder(PAYLOADS.decode, lambda payload: whole_payload(len(payload)))
    tracemalloc.start()
    (messages,) = read_mcap(tmp_path / "a.mcap", lambda _: everything).messages
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(messages.log_time_ns) == len(rows)
    assert peak < 100e6  # as asked, all would have room for the first: 100 GB


def whole_payload(width: int) -> WireLayout:
    place = FieldSlice(0, width, lambda raw: Ragged.regular(raw.copy()))
    return WireLayout(width, (), {"payload": place}, is_whole=True)


@pytest.mark.parametrize("options", WRITERS.values(), ids=WRITERS)
def test_compressed_files_cut_short_give_what_lies_before_the_cut(
    options: dict[str, Any], tmp_path: Path
) -> None:
    channels = example_channels(200)
    data, rows = officially_written(channels, **options), rows_of(channels)
    counts = []
    for length in np.linspace(9, len(data) - 1, 60).astype(int).tolist():
        found, recording = recording_of(tmp_path / "a.mcap", data[:length])
        assert set(found) <= set(rows)
        assert any(finding.what == "cut short" for finding in recording.findings)
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[-1] == len(rows)
    assert len(set(counts)) > 5


# --- damage -------------------------------------------------------------------------------------


def three_chunks(tmp_path: Path) -> tuple[bytearray, list[Message], list[int]]:
    """A file of three chunks, its rows, and where the chunks begin."""
    channels = [example_channels(300)[0]]
    write_mcap(tmp_path / "w.mcap", channels, "zstd", chunk_bytes=8000)
    data = bytearray((tmp_path / "w.mcap").read_bytes())
    with (tmp_path / "w.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return data, rows_of(channels), [c.chunk_start_offset for c in summary.chunk_indexes]


def test_a_chunk_with_a_wrong_checksum_is_left_out_and_named(tmp_path: Path) -> None:
    data, rows, starts = three_chunks(tmp_path)
    data[starts[1] + 9 + 24] ^= 1  # its CRC
    found, recording = recording_of(tmp_path / "a.mcap", bytes(data))
    assert 0 < len(found) < len(rows)
    assert set(found) < set(rows)
    first = recording.findings[0]
    assert (first.what, first.detail) == ("chunk left out", "CRC is wrong")
    assert first.where == f"a.mcap chunk at byte {starts[1]}"
    missing = recording.findings[1]
    assert (missing.what, missing.where) == ("messages missing", "a.mcap /depth")
    assert missing.detail == f"{len(found)} of {len(rows)} found"


@pytest.mark.parametrize("length", [2**63 - 1, 3 << 30, 0, 5])
def test_a_chunk_of_absurd_length_costs_that_chunk_only(length: int, tmp_path: Path) -> None:
    data, rows, starts = three_chunks(tmp_path)
    struct.pack_into("<Q", data, starts[1] + 1, length)
    found, recording = recording_of(tmp_path / "a.mcap", bytes(data))
    assert set(found) <= set(rows)
    assert found[0] == rows[0]
    assert found[-1] == rows[-1]
    assert len(found) > len(rows) // 2
    assert {"damaged record", "skipped to a chunk"} & {f.what for f in recording.findings}


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_decompression_bomb_takes_no_more_than_it_declares(
    compression: str, tmp_path: Path
) -> None:
    gigabyte = io.BytesIO()
    if compression == "zstd":
        with zstandard.ZstdCompressor().stream_writer(gigabyte, closefd=False) as stream:
            for _ in range(1 << 10):
                stream.write(bytes(1 << 20))
    else:
        with lz4.frame.LZ4FrameFile(gigabyte, "wb") as stream:
            for _ in range(1 << 10):
                stream.write(bytes(1 << 20))
    packed = gigabyte.getvalue()
    for declared, says in ((1000, "unpacks to more"), (1 << 40, "at most 268435456 are read")):
        head = struct.pack("<QQQI", 0, 1, declared, 0) + text(compression)
        chunk = record(6, head + struct.pack("<Q", len(packed)) + packed)
        data = MAGIC + record(1, text("") + text("")) + chunk
        data += record(15, bytes(4))
        tracemalloc.start()
        found, recording = recording_of(
            tmp_path / "a.mcap", data + end_of_file(len(data), [], False)
        )
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert found == []
        assert says in recording.findings[0].detail
        assert peak < 3 * len(packed) + 10_000_000


def test_a_message_index_that_lies_is_not_believed(tmp_path: Path) -> None:
    body = schema_record() + channel_record()
    offsets = []
    for i in range(50):
        offsets.append(len(body))
        body += message_record(i, i, i, bytes([i]) * 40)
    lies = {
        "repeated": [offsets[3]] * 50,
        "beyond": [2**63, *offsets[1:]],
        "shifted": [offset + 1 for offset in offsets],
        "some only": offsets[:7],
        "backwards": offsets[::-1],
        "none": [],
    }
    for name, places in lies.items():
        pairs = b"".join(struct.pack("<QQ", 7, place) for place in places)
        index = record(7, struct.pack("<HI", 1, len(pairs)) + pairs)
        data = MAGIC + record(1, text("") + text("")) + chunk_record(body, 0, 49) + index
        data += record(15, bytes(4))
        summary = [schema_record(), channel_record()]
        found, recording = recording_of(
            tmp_path / "a.mcap", data + end_of_file(len(data), summary, True)
        )
        assert found == [("example", i, bytes([i]) * 40) for i in range(50)], name
        assert recording.findings == ()


def test_an_index_that_names_a_message_inside_another_is_not_believed(tmp_path: Path) -> None:
    inner = message_record(9, 9, 9, b"hidden")
    outer, last = message_record(0, 1, 1, inner), message_record(1, 2, 2, b"openly")
    pairs = [(1, 0), (9, len(outer) - len(inner))]  # together as long as the two that are there
    index = b"".join(struct.pack("<QQ", *pair) for pair in pairs)
    index = record(7, struct.pack("<HI", 1, len(index)) + index)
    data = MAGIC + record(1, text("") + text("")) + chunk_record(outer + last, 1, 2) + index
    data += record(15, bytes(4))
    summary = [schema_record(), channel_record()]
    found, recording = recording_of(
        tmp_path / "a.mcap", data + end_of_file(len(data), summary, True)
    )
    assert found == [("example", 1, inner), ("example", 2, b"openly")]
    assert recording.findings == ()


def test_an_index_without_entries_beside_a_true_one_changes_nothing(tmp_path: Path) -> None:
    pairs = struct.pack("<QQ", 1, 0)
    data = MAGIC + record(1, text("") + text("")) + chunk_record(message_record(0, 1, 1), 1, 1)
    data += record(7, struct.pack("<HI", 1, len(pairs)) + pairs)
    data += record(7, struct.pack("<HI", 2, 0)) + record(15, bytes(4))
    summary = [schema_record(), channel_record()]
    found, recording = recording_of(
        tmp_path / "a.mcap", data + end_of_file(len(data), summary, True)
    )
    assert found == [("example", 1, b"\1\2\3")]
    assert recording.findings == ()


def test_messages_in_and_out_of_chunks_and_records_of_others_are_all_read(tmp_path: Path) -> None:
    loose = [message_record(0, 5, 5, b"first"), message_record(1, 9, 9, b"last")]
    chunk = chunk_record(message_record(2, 7, 7, b"inside") + record(0x90, b"private"), 7, 7)
    data = MAGIC + record(1, text("") + text("")) + schema_record() + channel_record()
    data += loose[0] + record(0xFE, b"private") * 2 + chunk + loose[1]
    data += record(15, struct.pack("<I", zlib.crc32(data)))
    data += end_of_file(len(data), [], False)
    found, recording = recording_of(tmp_path / "a.mcap", data)
    assert [payload for _, _, payload in found] == [b"first", b"inside", b"last"]
    assert [f.detail for f in recording.findings] == ["2 private records of opcode 254: skipped"]


def test_what_two_records_say_of_one_channel_is_settled_aloud(tmp_path: Path) -> None:
    other = record(4, struct.pack("<HH", 1, 1) + text("other") + text("a") + bytes(4))
    data = MAGIC + record(1, text("") + text("")) + schema_record() + channel_record() + other
    data += message_record(0, 1, 1) + record(5, struct.pack("<HIQQ", 9, 0, 2, 2) + b"?")
    data += record(15, bytes(4))
    found, recording = recording_of(tmp_path / "a.mcap", data + end_of_file(len(data), [], False))
    assert found == [("example", 1, b"\1\2\3")]
    assert [(f.what, f.detail) for f in recording.findings] == [
        ("conflicting channel", "channel 1; first is used"),
        ("unknown channel", "1 messages left out"),
        (
            "no checksums",
            "messages outside chunks have none: a changed byte in them cannot be told",
        ),
    ]


def test_chunks_without_a_wanted_channel_are_counted_but_not_unpacked(tmp_path: Path) -> None:
    data, rows, starts = three_chunks(tmp_path)
    for start in starts:
        data[start + 9 + 24] ^= 1  # each CRC: unpacking would find it
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    recording = read_mcap(path, lambda _: None)
    assert [count.messages for count in recording.counts.values()] == [len(rows)]
    assert recording.findings == ()


def test_a_summary_that_promises_too_much_takes_no_memory(tmp_path: Path) -> None:
    for promised in (11, 2**63):
        body = schema_record() + channel_record() + message_record(0, 1, 1)
        data = MAGIC + record(1, text("") + text("")) + chunk_record(body, 0, 1)
        data += record(15, bytes(4))
        counts = struct.pack("<HQ", 1, promised)
        statistics = struct.pack("<QHIIIIQQ", 1, 1, 1, 0, 0, 1, 0, 1)
        summary = [record(11, statistics + struct.pack("<I", len(counts)) + counts)]
        data += end_of_file(len(data), [schema_record(), channel_record(), *summary], True)
        found, recording = recording_of(tmp_path / "a.mcap", data)
        assert len(found) == 1
        assert [f.detail for f in recording.findings] == [f"1 of {promised} found"]


def index_record(offsets: list[int]) -> bytes:
    pairs = b"".join(struct.pack("<QQ", 7, offset) for offset in offsets)
    return record(7, struct.pack("<HI", 1, len(pairs)) + pairs)


def file_of(*chunks: tuple[bytes, list[int]]) -> bytes:
    """A file of one channel, of chunks with a message index each."""
    data = MAGIC + record(1, text("") + text(""))
    for body, offsets in chunks:
        data += chunk_record(body, 0, 99) + index_record(offsets)
    data += record(15, bytes(4))
    return data + end_of_file(len(data), [schema_record(), channel_record()], True)


def test_of_chunks_opened_together_one_index_does_not_reach_into_another(tmp_path: Path) -> None:
    one, two = message_record(0, 1, 1, b"one"), message_record(1, 2, 2, b"two")
    data = file_of((one, [0, len(one)]), (two, [0]))
    found, recording = recording_of(tmp_path / "a.mcap", data)
    assert [payload for _, _, payload in found] == [b"one", b"two"]
    assert recording.findings == ()


def test_an_index_of_a_chunk_too_short_for_a_message_is_not_believed(tmp_path: Path) -> None:
    for size in range(1, 31):
        body = record(0x90, bytes(max(0, size - 9)))[:size]
        found, recording = recording_of(tmp_path / "a.mcap", file_of((body, [0])))
        assert found == []
        assert bool(recording.findings) == (size < 9), size


def test_of_chunks_opened_together_no_message_reaches_into_the_next(tmp_path: Path) -> None:
    naming = schema_record() + channel_record()
    one, two = message_record(0, 1, 1, b"one"), message_record(1, 2, 2, b"two")
    too_long = one[:1] + struct.pack("<Q", len(one) - 9 + len(naming)) + one[9:]
    data = file_of((one + too_long, [0, len(one)]), (naming + two, [len(naming)]))
    found, recording = recording_of(tmp_path / "a.mcap", data)
    assert [payload for _, _, payload in found] == [b"one", b"two"]
    assert [f.what for f in recording.findings] == ["damaged chunk"]


def test_of_chunks_opened_together_a_bad_one_costs_itself_alone(tmp_path: Path) -> None:
    bodies = [b"".join(message_record(i, i, i, bytes([i])) for i in (k, k + 1)) for k in (0, 2, 4)]
    second = len(bodies[0]) // 2
    data = bytearray(file_of(*((body, [0, second]) for body in bodies)))
    place = data.index(bodies[1])
    data[place + 40] ^= 1
    found, recording = recording_of(tmp_path / "a.mcap", bytes(data))
    assert [payload[0] for _, _, payload in found] == [0, 1, 4, 5]
    (finding,) = recording.findings
    assert finding.what == "chunk left out"
    assert finding.detail == "CRC is wrong"


def test_records_between_messages_are_passed_without_a_walk_over_them_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def walked(_: Any) -> None:
        raise AssertionError("walked")

    out = io.BytesIO()
    writer = Writer(out, chunk_size=2000)
    writer.start()
    schema = writer.register_schema("a/msg/B", "ros2msg", b"uint8 x")
    channels = [writer.register_channel(topic, "cdr", schema) for topic in "ab"]
    for i in range(200):  # the first chunk holds schema and channels too
        writer.add_message(channels[i % 2], 200 - i, bytes([i]), i)
    writer.finish()
    expected, _ = recording_of(tmp_path / "a.mcap", out.getvalue())
    monkeypatch.setattr(chunks, "_by_walking", walked)
    found, recording = recording_of(tmp_path / "a.mcap", out.getvalue())
    assert len(found) == 200
    assert found == expected
    assert recording.findings == ()


def test_many_messages_of_one_length_are_found_where_a_walk_finds_them(tmp_path: Path) -> None:
    sizes = [5] * 300 + [7] + [5] * 200 + [0] * 300 + [5] * 70
    rows = [message_record(i, i, i, bytes([i % 256]) * size) for i, size in enumerate(sizes)]
    body = schema_record() + channel_record() + b"".join(rows)
    expected = [("example", i, bytes([i % 256]) * size) for i, size in enumerate(sizes)]
    for damaged in (False, True):
        plain = body + record(0x90, b"private") + rows[0][:-1] * damaged
        data = MAGIC + record(1, text("") + text("")) + chunk_record(plain, 0, len(sizes))
        data += record(15, bytes(4)) + end_of_file(0, [], False)
        found, recording = recording_of(tmp_path / "a.mcap", data)
        assert found == expected
        assert [f.what for f in recording.findings] == ["damaged chunk"] * damaged


def test_messages_between_chunks_are_all_read(tmp_path: Path) -> None:
    rows = [message_record(i, i, i, bytes([i])) for i in range(12)]
    chunks = [chunk_record(rows[i], i, i) for i in (3, 8)]
    data = MAGIC + record(1, text("") + text("")) + schema_record() + channel_record()
    data += b"".join([*rows[:3], chunks[0], *rows[4:8], chunks[1], *rows[9:]])
    data += record(15, bytes(4)) + end_of_file(0, [], False)
    found, recording = recording_of(tmp_path / "a.mcap", data)
    assert [time for _, time, _ in found] == list(range(12))
    assert [f.what for f in recording.findings] == ["no checksums"]


def test_a_million_empty_messages_in_a_few_bytes_take_little_memory(tmp_path: Path) -> None:
    """An empty message is read, and counted, with 100 bytes at most."""
    n = 1_000_000
    one = message_record(0, 1, 1, b"")
    body = one * n
    packed = zstandard.ZstdCompressor().compress(body)
    head = struct.pack("<QQQI", 1, 1, len(body), zlib.crc32(body)) + text("zstd")
    chunk = record(6, head + struct.pack("<Q", len(packed)) + packed)
    data = MAGIC + record(1, text("") + text("")) + schema_record() + channel_record() + chunk
    data += record(15, bytes(4)) + end_of_file(0, [], False)
    (tmp_path / "a.mcap").write_bytes(data)
    tracemalloc.start()
    recording = read_mcap(tmp_path / "a.mcap", lambda _: None)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [count.messages for count in recording.counts.values()] == [n]
    assert peak < 100 * n
