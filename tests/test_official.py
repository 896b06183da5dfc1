# SPDX-License-Identifier: Apache-2.0
"""What the official library lists, and its second opinion."""

import io
import struct
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_files import CONTENTS, conformance_file, conformance_variants
from test_mcap import WRITERS, example_channels, officially_written

from abyssnav.errors import ReadError
from abyssnav.formats.mcap import official
from abyssnav.formats.mcap.official import Attachment, Metadata, compare_with_library, list_extras


def file_with_extras() -> bytes:
    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    writer.add_metadata("vehicle", {"name": "Sentry", "dive": "601"})
    writer.add_attachment(5, 7, "cal.xml", "text/xml", b"<a/>" * 100)
    schema = writer.register_schema("a/msg/B", "ros2msg", b"uint8 x")
    channel = writer.register_channel("/a", "cdr", schema)
    for time in range(300):
        writer.add_message(channel, time, bytes([0, 1, 0, 0, time % 256]), time)
    writer.add_metadata("end", {})
    writer.finish()
    return file.getvalue()


def test_metadata_and_attachments_are_listed_with_their_sizes(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(file_with_extras())
    extras = list_extras(tmp_path / "a.mcap")
    assert extras.metadata == (
        Metadata("vehicle", {"name": "Sentry", "dive": "601"}), Metadata("end", {})
    )  # fmt: skip
    assert extras.attachments == (Attachment("cal.xml", "text/xml", 400, 7),)
    assert extras.findings == ()


def test_a_sound_files_list_comes_from_its_summary_and_is_the_walks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.mcap").write_bytes(file_with_extras())
    (tmp_path / "b.mcap").write_bytes(officially_written(example_channels()))
    monkeypatch.setattr(official, "_records", None)  # a walk would fail
    quick = [list_extras(tmp_path / f"{name}.mcap") for name in "ab"]
    monkeypatch.undo()
    monkeypatch.setattr(official, "_list_by_summary", lambda _: None)
    assert quick == [list_extras(tmp_path / f"{name}.mcap") for name in "ab"]


def test_an_index_that_leads_elsewhere_than_to_metadata_is_not_followed(tmp_path: Path) -> None:
    data = file_with_extras()
    with io.BytesIO(data) as file:
        summary = make_reader(file).get_summary()
    assert summary
    first, chunk = summary.metadata_indexes[0].offset, summary.chunk_indexes[0].chunk_start_offset
    place = data.rindex(struct.pack("<QQ", first, summary.metadata_indexes[0].length))
    for lie in (chunk, 1 << 62):
        lying = data[:place] + struct.pack("<Q", lie) + data[place + 8 :]
        (tmp_path / "a.mcap").write_bytes(lying)
        assert [one.name for one in list_extras(tmp_path / "a.mcap").metadata] == ["vehicle", "end"]


def test_a_cut_file_lists_what_lies_before_the_cut_and_says_so(tmp_path: Path) -> None:
    data = file_with_extras()
    for length in range(8, len(data) - 8, 7):
        (tmp_path / "a.mcap").write_bytes(data[:length])
        extras = list_extras(tmp_path / "a.mcap")
        assert extras.metadata in ((), extras.metadata[:1], extras.metadata[:2])
        (finding,) = extras.findings
        assert finding.what == "not read by the official library"
    (tmp_path / "a.mcap").write_bytes(b"#ROSBAG")
    with pytest.raises(ReadError, match="not MCAP"):
        list_extras(tmp_path / "a.mcap")


@pytest.mark.parametrize("options", WRITERS.values(), ids=WRITERS)
def test_both_readers_agree_on_sound_files(options: dict[str, object], tmp_path: Path) -> None:
    channels = example_channels()
    (tmp_path / "a.mcap").write_bytes(officially_written(channels, **options))
    opinion = compare_with_library(tmp_path / "a.mcap")
    assert opinion.differences == ()
    assert opinion.messages == sum(len(channel.log_time_ns) for channel in channels)
    assert opinion.library.startswith("mcap 1.")


def test_both_readers_agree_on_the_conformance_files(tmp_path: Path) -> None:
    for base, features in conformance_variants():
        (tmp_path / "a.mcap").write_bytes(conformance_file(base, features))
        opinion = compare_with_library(tmp_path / "a.mcap")
        assert opinion.differences == (), (base, sorted(features))
        assert opinion.messages == len(CONTENTS[base])


@pytest.mark.parametrize(
    ("what", "change", "detail"),
    [
        ("data", lambda data: data[:-1] + b"?", "other bytes in its messages than ours"),
        ("data", lambda data: data + b"?", "other bytes in its messages than ours"),
        ("log_time", lambda time: time + 1, "other log times than ours"),
        ("topic", lambda topic: topic + "?", "its topic, encoding, type or definition differs"),
    ],
)
def test_where_the_readers_differ_the_topic_is_named(
    what: str, change: object, detail: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.mcap").write_bytes(file_with_extras())
    read = official._records

    def lying(*options: object, **named: object) -> object:
        for record in read(*options, **named):  # type: ignore[arg-type]
            ninth = getattr(record, "log_time", None) == 9
            if ninth if what != "topic" else what in vars(record):
                setattr(record, what, change(getattr(record, what)))  # type: ignore[operator]
            yield record

    monkeypatch.setattr(official, "_records", lying)
    (difference,) = compare_with_library(tmp_path / "a.mcap").differences
    assert (difference.what, difference.detail) == ("readers differ", detail)
    assert "topic '/a" in difference.where


def test_messages_that_one_reader_lacks_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.mcap").write_bytes(file_with_extras())
    read = official._records

    def lossy(*options: object, **named: object) -> object:
        for record in read(*options, **named):  # type: ignore[arg-type]
            if getattr(record, "sequence", 1) is None or getattr(record, "log_time", 0) != 9:
                yield record

    monkeypatch.setattr(official, "_records", lossy)
    (difference,) = compare_with_library(tmp_path / "a.mcap").differences
    assert difference.detail == "299 messages, where we read 300"


def test_a_damaged_file_is_not_given_to_the_library(tmp_path: Path) -> None:
    data = bytearray(file_with_extras())
    (tmp_path / "a.mcap").write_bytes(data[:-100])
    opinion = compare_with_library(tmp_path / "a.mcap")
    (difference,) = opinion.differences
    assert (difference.what, opinion.messages) == ("not compared", 0)
