# SPDX-License-Identifier: Apache-2.0
"""The columnar reader on its own: tables equal what the official libraries decode, one by one."""

import doctest
import io
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from mcap.reader import make_reader
from messages_any import ROOT, Example, columns_by_the_book, examples
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_cdr import serialized
from test_mcap import example_channels, fields_of, officially_written
from test_ros1 import serialized as serialized_ros1
from test_vehicles import twins

from abyssnav.errors import ReadError
from abyssnav.formats import mcap
from abyssnav.formats.columns import Column, Ragged
from abyssnav.formats.mcap.writer import Channel, write_mcap


def plain(column: Column) -> list[Any]:
    """A column as lists of Python's own numbers and texts."""
    if isinstance(column, Ragged):
        inner, ends = plain(column.content), column.offsets.tolist()
        return [inner[a:b] for a, b in pairwise(ends)]
    return column.tolist()  # type: ignore[no-any-return]


def file_of(path: Path, rows: list[bytes], kind: str, encoding: str, schema: bytes) -> None:
    times = np.arange(len(rows), dtype=np.int64)
    message_encoding = {"ros2msg": "cdr", "ros1msg": "ros1"}.get(encoding, encoding)
    payloads = Ragged.from_bytes(rows)
    channel = Channel("/any", kind, times, payloads, schema, message_encoding, encoding)
    write_mcap(path, [channel])


@pytest.mark.parametrize("encoding", ["ros2msg", "ros1msg"])
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(example=examples())
def test_tables_of_ros_messages_equal_what_rosbags_wrote(
    encoding: str, tmp_path: Path, example: Example
) -> None:
    rows = serialized_ros1(example) if encoding == "ros1msg" else serialized(example, True)
    file_of(tmp_path / "a.mcap", rows, ROOT, encoding, example.text.encode())
    tables = mcap.read(tmp_path / "a.mcap")
    expected = columns_by_the_book(example.tree, example.messages)
    if not rows:
        assert tables == {}
        return
    assert set(tables["/any"].column_names) == {"log_time", *expected}
    for name, column in expected.items():
        assert tables["/any"][name].to_pylist() == plain(column)


@pytest.mark.parametrize("number", [0, 1], ids=["protobuf", "json"])
def test_tables_of_other_encodings_equal_what_the_official_libraries_decode(
    number: int, tmp_path: Path, short_log: Path
) -> None:
    from bench_read import written

    wanted = [c for c in written(short_log) if c.topic in ("/depth", "/lbl/beacons")]
    write_mcap(tmp_path / "a.mcap", [twins(channel)[number] for channel in wanted])
    tables = mcap.read(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        rows = [(s, c, m) for s, c, m in make_reader(file).iter_messages(topics=["/depth"])]
    assert tables["/depth"]["log_time"].cast(pa.int64()).to_pylist() == [
        m.log_time for *_, m in rows
    ]
    if number:
        decoded = [json.loads(m.data) for *_, m in rows]
        expected = [row["depth"] for row in decoded]
        stamps = [
            s["sec"] * 10**9 + s["nanosec"] for row in decoded for s in [row["header"]["stamp"]]
        ]
    else:
        schema = rows[0][0]
        assert schema is not None
        pool = descriptor_pool.DescriptorPool()
        for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
            pool.Add(one)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
        messages = [kind.FromString(m.data) for *_, m in rows]
        expected = [message.depth for message in messages]
        stamps = [message.header.stamp.ToNanoseconds() for message in messages]
    assert tables["/depth"]["depth"].to_pylist() == expected
    assert tables["/depth"]["header.stamp"].cast(pa.int64()).to_pylist() == stamps
    beacons = tables["/lbl/beacons"]
    assert [len(names) for names in beacons["beacons.name"].to_pylist()] == [
        len(ids) for ids in beacons["beacons.id"].to_pylist()
    ]


def test_real_stamps_and_arrays_have_their_arrow_types(dive_log: Path) -> None:
    tables = mcap.read(str(dive_log), "/imu")
    (table,) = tables.values()
    types = {name: str(table.schema.field(name).type) for name in table.column_names}
    assert types["log_time"] == types["header.stamp"] == "timestamp[ns, tz=UTC]"
    assert types["header.frame_id"] == "large_string"
    assert types["orientation_covariance"] == "fixed_size_list<item: double>[9]"
    store = get_typestore(Stores.EMPTY)
    with dive_log.open("rb") as file:
        (schema, _, message), *_ = make_reader(file).iter_messages(topics=["/imu"])
    assert schema is not None
    store.register(get_types_from_msg(schema.data.decode(), schema.name))
    first = store.deserialize_cdr(message.data, schema.name)
    assert table["orientation.w"][0].as_py() == first.orientation.w  # type: ignore[attr-defined]


def test_rows_are_by_log_time_whatever_their_order_in_the_file(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", example_channels())
    (tmp_path / "b.mcap").write_bytes(officially_written(example_channels(), use_chunking=False))
    for name in "ab":
        table = mcap.read(tmp_path / f"{name}.mcap")["/text"]
        times = table["log_time"].cast(pa.int64()).to_pylist()
        assert times == sorted(times)
        assert len(times) == 167
    found = json.loads(table.schema.metadata[b"findings"])
    assert [finding["what"] for finding in found] == ["no checksums"]


def test_messages_that_cannot_be_decoded_are_given_as_they_are(tmp_path: Path) -> None:
    file_of(tmp_path / "a.mcap", [b"abc", b""], "a/B", "flatbuffer", b"")
    table = mcap.read(tmp_path / "a.mcap")["/any"]
    assert table["payload"].to_pylist() == [b"abc", b""]
    assert b"'flatbuffer'" in table.schema.metadata[b"problem"]


def test_messages_that_do_not_fit_are_left_out_and_counted(tmp_path: Path) -> None:
    file_of(
        tmp_path / "a.mcap", [b"\0\1\0\0\5", b"\0\1", b"\0\1\0\0\6"], "a/B", "ros2msg", b"uint8 x"
    )
    table = mcap.read(tmp_path / "a.mcap")["/any"]
    assert table["x"].to_pylist() == [5, 6]
    assert table.schema.metadata[b"lost"] == b"1"


def test_two_definitions_of_one_topic_are_one_table(tmp_path: Path) -> None:
    rows = [Ragged.from_bytes([b"\0\1\0\0\5"]), Ragged.from_bytes([b"\0\1\0\0\6\7"])]
    channels = [
        Channel("/a", "a/B", np.array([5 - k]), payloads, text)
        for k, (payloads, text) in enumerate(
            zip(rows, (b"uint8 x", b"uint8 x\nuint8 y"), strict=True)
        )
    ]
    write_mcap(tmp_path / "a.mcap", channels)
    table = mcap.read(tmp_path / "a.mcap")["/a"]
    assert table.select(["x", "y"]).to_pydict() == {"x": [6, 5], "y": [7, None]}
    (tmp_path / "b.mcap").write_bytes((tmp_path / "a.mcap").read_bytes())
    assert len(fields_of(tmp_path / "b.mcap", {"/a": ["x"]}).messages) == 2


def test_a_topic_that_is_not_there_is_refused_with_the_nearest(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", example_channels())
    with pytest.raises(ReadError, match=r"a\.mcap: no topic '/dept'; nearest: '/depth'"):
        mcap.read(tmp_path / "a.mcap", "/dept")
    (tmp_path / "a.mcap").write_bytes(b"no")
    with pytest.raises(ReadError, match="not MCAP"):
        mcap.read(tmp_path / "a.mcap")


def test_the_example_of_the_page_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parent.parent)
    out = io.StringIO()
    example = doctest.DocTestFinder().find(mcap.read, globs={})
    failed = [doctest.DocTestRunner().run(one, out=out.write).failed for one in example]
    assert failed == [0], out.getvalue()
