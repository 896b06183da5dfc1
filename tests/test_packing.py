# SPDX-License-Identifier: Apache-2.0
"""rosbag2's two ways of packing: whole files, and messages one by one."""

import dataclasses
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import zstandard
from test_mcap import example_channels, fields_of, rows_of

from abyssnav.errors import ReadError
from abyssnav.formats.columns import Ragged
from abyssnav.formats.decoding import unpack_messages
from abyssnav.formats.mcap import container
from abyssnav.formats.mcap.reader import read_mcap
from abyssnav.formats.mcap.writer import write_mcap


def packed_file(folder: Path, suffix: str = ".mcap.zstd", **options: object) -> Path:
    write_mcap(folder / "a.mcap", example_channels(), chunk_bytes=5000)
    packed = zstandard.ZstdCompressor(**options).compress((folder / "a.mcap").read_bytes())
    (folder / f"b{suffix}").write_bytes(packed)
    return folder / f"b{suffix}"


@pytest.mark.parametrize("suffix", [".mcap.zst", ".mcap.zstd", ".mcap"])
def test_a_packed_file_reads_like_what_is_in_it(suffix: str, tmp_path: Path) -> None:
    path = packed_file(tmp_path, suffix, write_checksum=True)
    recording = fields_of(path, {"/depth": ["depth"]})
    assert recording.findings == ()
    assert np.array_equal(recording.messages[0].columns["depth"], np.arange(500) / 7)


def test_a_packed_file_of_several_frames_is_read_whole(tmp_path: Path) -> None:
    path = packed_file(tmp_path)
    data, pack = (tmp_path / "a.mcap").read_bytes(), zstandard.ZstdCompressor().compress
    path.write_bytes(b"".join(pack(data[at : at + 999]) for at in range(0, len(data), 999)))
    recording = fields_of(path, {"/depth": ["depth"]})
    assert recording.findings == ()
    assert len(recording.messages[0].log_time_ns) == 500


def test_a_packed_file_cut_or_damaged_anywhere_loses_nothing_in_silence(tmp_path: Path) -> None:
    path = packed_file(tmp_path, write_checksum=True)
    data, rows = path.read_bytes(), {time for _, time, _ in rows_of(example_channels())}
    for at in np.linspace(12, len(data) - 5, 60).astype(int).tolist():
        for broken in (data[:at], data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :]):
            path.write_bytes(broken)
            try:
                recording = read_mcap(path, lambda _: None)
            except ReadError:  # nothing at all could be unpacked
                continue
            counted = sum(count.messages for count in recording.counts.values())
            assert counted <= len(rows) * 2
            assert recording.findings, at


def test_what_was_packed_and_is_no_mcap_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap.zst"
    path.write_bytes(zstandard.ZstdCompressor().compress(b"SQLite format 3\0" * 9))
    with pytest.raises(ReadError, match="not MCAP: it begins with b'SQLite f'"):
        read_mcap(path, lambda _: None)
    path.write_bytes(container.ZSTD_MAGIC + b"nonsense")
    with pytest.raises(ReadError, match=r"not MCAP: zstd: .*"):
        read_mcap(path, lambda _: None)


def test_a_packed_file_that_is_a_bomb_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(container, "_LEAST_LIMIT_BYTES", 1 << 20)
    path = tmp_path / "a.mcap.zst"
    path.write_bytes(zstandard.ZstdCompressor().compress(container.MAGIC + bytes(1 << 25)))
    tracemalloc.start()
    with pytest.raises(ReadError, match=r"a\.mcap\.zst: unpacks to more than 1048576 bytes"):
        read_mcap(path, lambda _: None)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * (1 << 22)


def test_messages_packed_one_by_one_read_like_those_that_are_not(tmp_path: Path) -> None:
    channels = example_channels()
    pack = zstandard.ZstdCompressor().compress
    for every in (1, 3):  # all, or some in between
        packed = [
            dataclasses.replace(
                channel,
                payloads=Ragged.from_bytes(
                    [pack(row) if k % every == 0 else row
                     for k, row in enumerate(channel.payloads[:].row_bytes())]
                ),
            )
            for channel in channels
        ]  # fmt: skip
        write_mcap(tmp_path / "packed.mcap", packed)
        write_mcap(tmp_path / "plain.mcap", channels)
        wanted = {"/depth": ["depth", "header.stamp"], "/text": ["decision", "nis"]}
        both = [fields_of(tmp_path / f"{n}.mcap", wanted).messages for n in ("packed", "plain")]
        for ours, plain in zip(*both, strict=True):
            assert (ours.lost, ours.problem) == (0, None)
            for path in wanted[plain.channel.topic]:
                assert np.array_equal(ours.columns[path], plain.columns[path])


def test_packed_messages_that_are_damaged_or_bombs_are_empty() -> None:
    pack = zstandard.ZstdCompressor().compress
    good, bomb = pack(b"\0\1\0\0abcd"), pack(bytes(300_000_000))
    rows = [good, good[:-2], bomb, good, b"\0\1\0\0plain", container.ZSTD_MAGIC + b"\xff" * 9, b""]
    tracemalloc.start()
    unpacked = unpack_messages(Ragged.from_bytes(rows)).row_bytes()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    whole = b"\0\1\0\0abcd"
    assert unpacked == [whole, b"", b"", whole, b"\0\1\0\0plain", b"", b""]
    assert peak < 1 << 29
