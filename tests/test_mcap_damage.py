# SPDX-License-Identifier: Apache-2.0
"""Damage in the middle of a file without a summary costs what it hits, and is told."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from mcap_files import (
    MAGIC,
    Message,
    channel_record,
    chunk_record,
    end_of_file,
    message_record,
    record,
    recording_of,
    schema_record,
    text,
)
from test_mcap import WRITERS, example_channels, officially_written, rows_of

from abyssnav.formats.mcap import recovery

CHANNELS = example_channels(200)
ROWS = rows_of(CHANNELS)
FILES = {
    name: officially_written(CHANNELS, **{**WRITERS["no summary"], "compression": kind})
    for name, kind in (
        ("zstd", CompressionType.ZSTD),
        ("lz4", CompressionType.LZ4),
        ("none", CompressionType.NONE),
    )
}
HEAD = 9  # opcode and length


def spans(data: bytes) -> list[tuple[int, int]]:
    """Where the chunks begin and end."""
    found, at = [], len(MAGIC)
    while at < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == 6:
            found.append((at, at + HEAD + length))
        at += HEAD + length
    return found


def rows_by_chunk(data: bytes, folder: Path) -> list[set[Message]]:
    """Messages of each chunk: what is in the file up to its end, and was not before."""
    sets: list[set[Message]] = []
    for _, end in spans(data):
        found, _ = recording_of(folder / "part.mcap", data[:end])
        sets.append(set(found) - set().union(*sets))
    assert set().union(*sets) == set(ROWS)
    return sets


DAMAGE: dict[str, Callable[[bytes, int], bytes]] = {
    "flipped": lambda data, at: data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :],
    "zeroed": lambda data, at: data[:at] + bytes(60) + data[at + 60 :],
    "deleted": lambda data, at: data[:at] + data[at + 7 :],
    "inserted": lambda data, at: data[:at] + b"\x06\x01\x04\0\0\0zstd!" + data[at:],
}
REACH = {"flipped": 1, "zeroed": 60, "deleted": 7, "inserted": 0}


@pytest.mark.parametrize("compression", FILES)
@pytest.mark.parametrize("kind", DAMAGE)
def test_all_chunks_but_those_hit_come_back(kind: str, compression: str, tmp_path: Path) -> None:
    data = FILES[compression]
    chunks, sets = spans(data), rows_by_chunk(data, tmp_path)
    assert len(chunks) > 5
    begin, end = chunks[2][0] - 30, chunks[3][1] + 5
    heads = [at + k for at, _ in chunks[2:4] for k in range(0, 60, 4)]
    for at in sorted({*np.linspace(begin, end, 40).astype(int).tolist(), *heads}):
        found, recording = recording_of(tmp_path / "a.mcap", DAMAGE[kind](data, at))
        until = at + REACH[kind]
        safe = [
            rows
            for rows, (first, last) in zip(sets, chunks, strict=True)
            if until <= first or at >= last
        ]
        assert set(found) <= set(ROWS), at
        assert set().union(*safe) <= set(found), at
        assert len(found) == len(set(found)), at
        assert len(found) == len(ROWS) or recording.findings, at


def test_what_was_lost_is_told_from_byte_to_byte(tmp_path: Path) -> None:
    data = FILES["zstd"]
    chunks = spans(data)
    (lost, _), (found_again, _) = chunks[3:5]
    broken = data[:lost] + bytes(200) + data[lost + 200 :]
    found, recording = recording_of(tmp_path / "a.mcap", broken)
    assert set(found) < set(ROWS)
    (finding,) = recording.findings
    assert (finding.what, finding.where) == ("damaged record", f"a.mcap at byte {lost}")
    assert finding.detail == (
        f"a record of 0 bytes, opcode 0, with {len(data) - 8 - lost} left; "
        f"bytes {lost} to {found_again} left out, up to the next chunk"
    )


def test_a_length_that_hides_chunks_hides_none(tmp_path: Path) -> None:
    data = bytearray(FILES["zstd"])
    (at, _), (begin, end) = spans(data)[2:4]
    struct.pack_into("<Q", data, at + 1, (begin + end) // 2 - at - HEAD)
    found, recording = recording_of(tmp_path / "a.mcap", bytes(data))
    assert sorted(found) == sorted(ROWS)
    assert "read again from the chunk at byte" in recording.findings[0].detail


def bare_file(*records: bytes) -> bytes:
    data = MAGIC + record(1, text("") + text("")) + b"".join(records) + record(15, bytes(4))
    return data + end_of_file(len(data), [], False)


def chunk_of(times: range, crc: int | None = None) -> bytes:
    plain = b"".join(message_record(time, time, time) for time in times)
    return chunk_record(plain, times[0], times[-1], crc)


FIRST = chunk_record(schema_record() + channel_record() + message_record(0, 0, 0), 0, 0)


@pytest.mark.parametrize(
    ("name", "decoy"),
    {
        "wrong checksum": chunk_of(range(1, 9), crc=7),
        "no checksum and no message": chunk_record(b"\x7f" * 80, 1, 9, crc=0),
        "times run back": chunk_record(message_record(1, 9, 9), 9, 1),
        "of no known compression": chunk_of(range(1, 9)).replace(bytes(4), b"\4\0\0\0gzip", 1),
    }.items(),
)
def test_what_only_looks_like_a_chunk_is_not_taken(name: str, decoy: bytes, tmp_path: Path) -> None:
    data = bare_file(FIRST, b"\0" * 20, decoy, chunk_of(range(20, 30)))
    found, _ = recording_of(tmp_path / "a.mcap", data)
    assert [time for _, time, _ in found] == [0, *range(20, 30)], name


def test_a_chunk_without_checksum_is_taken_when_it_holds_messages_to_its_end(
    tmp_path: Path,
) -> None:
    data = bare_file(FIRST, b"\0" * 20, chunk_of(range(20, 30), crc=0))
    found, _ = recording_of(tmp_path / "a.mcap", data)
    assert [time for _, time, _ in found] == [0, *range(20, 30)]


def test_the_search_is_given_up_when_too_much_looks_like_a_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoys = chunk_of(range(1, 9), crc=7) * 50
    data = bare_file(FIRST, b"\0" * 20, decoys, chunk_of(range(20, 30)))
    assert len(recording_of(tmp_path / "a.mcap", data)[0]) == 11
    monkeypatch.setattr(recovery, "_MOST_TRIED", 40 * 4096)
    found, recording = recording_of(tmp_path / "a.mcap", data)
    assert [time for _, time, _ in found] == [0]
    assert "read up to there" in recording.findings[0].detail


def test_a_cut_file_tells_only_that_it_is_cut(tmp_path: Path) -> None:
    data = FILES["zstd"]
    begin, end = spans(data)[4]
    _, recording = recording_of(tmp_path / "a.mcap", data[: (begin + end) // 2])
    assert [finding.what for finding in recording.findings] == ["cut short"]


def test_a_last_chunk_whose_end_is_there_must_keep_its_checksum(tmp_path: Path) -> None:
    data = bytearray(FILES["none"])
    begin, end = spans(data)[-1]
    struct.pack_into("<Q", data, begin + 1, 1 << 40)  # beyond the file: as if it were cut
    data[end - 5] ^= 1
    found, _ = recording_of(tmp_path / "a.mcap", bytes(data))
    assert set(found) <= set(ROWS)


def test_a_byte_that_makes_the_header_an_end_of_the_data_is_told(tmp_path: Path) -> None:
    data = FILES["lz4"]
    found, recording = recording_of(tmp_path / "a.mcap", data[:8] + b"\x0f" + data[8:])
    assert set(found) <= set(ROWS)
    assert "an end of the data where" in recording.findings[0].detail


def test_a_message_index_marked_as_a_message_is_none(tmp_path: Path) -> None:
    data = bytearray(officially_written(CHANNELS))
    end = spans(bytes(data))[0][1]
    assert data[end] == 7
    data[end] = 5
    found, recording = recording_of(tmp_path / "a.mcap", bytes(data))
    assert sorted(found) == sorted(ROWS)
    assert [finding.what for finding in recording.findings] == ["damaged index"]


edits = st.lists(
    st.tuples(
        st.sampled_from(["flip", "zero", "delete", "insert", "copy"]),
        st.floats(0, 1),
        st.integers(1, 400),
        st.integers(0, 2**32),
    ),
    min_size=1,
    max_size=4,
)


def damaged(data: bytes, changes: list[tuple[str, float, int, int]]) -> bytes:
    """A file with its middle changed: all but the magic and the last chunk's end."""
    for kind, where, size, seed in changes:
        at = 8 + int(where * (len(data) - 1500 - 8))
        noise = np.random.default_rng(seed).bytes(size)
        if kind == "flip":
            data = data[:at] + bytes([data[at] ^ (1 << size % 8)]) + data[at + 1 :]
        elif kind == "zero":
            data = data[:at] + bytes(size) + data[at + size :]
        elif kind == "delete":
            data = data[:at] + data[at + size :]
        elif kind == "insert":
            data = data[:at] + noise + data[at:]
        else:
            data = data[:at] + data[at // 2 : at // 2 + 3 * size] + data[at:]
    return data


@pytest.mark.parametrize("name", [*FILES, "usual"])
@settings(
    max_examples=120,
    deadline=None,
    derandomize=True,  # what a byte may do without a checksum to tell has no end
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(changes=edits, cut=st.floats(0, 1))
def test_no_damage_makes_a_message_that_was_not_recorded(
    name: str, tmp_path: Path, changes: list[tuple[str, float, int, int]], cut: float
) -> None:
    whole = FILES.get(name) or officially_written(CHANNELS)
    data = damaged(whole, changes)
    found, recording = recording_of(tmp_path / "a.mcap", data)
    assert set(found) <= set(ROWS)
    assert len(found) >= len(ROWS) or recording.findings
    first_chunk = spans(whole)[0][1]
    shortened = whole[: first_chunk + int(cut * (len(whole) - first_chunk))]
    found, recording = recording_of(tmp_path / "a.mcap", shortened)
    assert set(found) <= set(ROWS)
    assert len(found) == len(set(found))
