# SPDX-License-Identifier: Apache-2.0
"""MCAP, read and written: every valid file, and what becomes of broken ones."""

import io
from pathlib import Path

import pytest
from mcap.stream_reader import StreamReader
from mcap_files import (
    CONTENTS,
    Message,
    conformance_file,
    conformance_variants,
    recording_of,
)

from pipeline.errors import ReadError
from pipeline.formats.mcap import read_mcap

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
    return records["DataEnd"].data_section_crc, records["Footer"].summary_crc


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
