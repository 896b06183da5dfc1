# SPDX-License-Identifier: Apache-2.0
"""Every parser of foreign bytes under random and half-right input: columns, or a `ReadError`.

`make fuzz` runs the long form; ABYSSNAV_FUZZ is how many examples each parser gets.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from messages_any import ROOT, Example, examples
from protobuf_any import proto_examples
from test_cdr import serialized
from test_mcap import example_channels, officially_written
from test_ros1 import serialized as serialized_ros1

from abyssnav.errors import ReadError
from abyssnav.formats import json, mcap
from abyssnav.formats.columns import Ragged
from abyssnav.formats.decoding import decode_payloads, definition_of, find_layout
from abyssnav.formats.mcap.container import ZSTD_MAGIC
from abyssnav.formats.mcap.file_index import Channel, skippable_ranges, summary_start
from abyssnav.formats.mcap.official import list_extras
from abyssnav.formats.mcap.writer import write_mcap
from abyssnav.formats.protobuf import parse_descriptor_set
from abyssnav.formats.schema import leaves, parse_ros1msg, parse_ros2idl, parse_ros2msg

EXAMPLES = int(os.environ.get("ABYSSNAV_FUZZ", "25"))
#: A parser that takes longer than this for a kilobyte has lost its bounds.
SECONDS = 5
fuzz = settings(
    max_examples=EXAMPLES,
    deadline=SECONDS * 1000,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
EDITS = st.lists(
    st.tuples(st.floats(0, 1), st.integers(0, 3), st.binary(max_size=9)), min_size=1, max_size=4
)


def edited(data: bytes, edits: list[tuple[float, int, bytes]]) -> bytes:
    """Bytes with some replaced, taken out and put in."""
    for where, removed, inserted in edits:
        at = int(where * len(data))
        data = data[:at] + inserted + data[at + removed :]
    return data


def survives(parse: Any, *words: Any) -> Any:
    """What comes out; None when it is refused as it should be."""
    try:
        return parse(*words)
    except ReadError:
        return None


WORDS = st.lists(
    st.sampled_from(
        [
            "uint8",
            "string",
            "x",
            "a/B",
            "[]",
            "[3]",
            "[<=4]",
            "=",
            "7",
            "#",
            "MSG:",
            "time",
            "Header",
            "module",
            "struct",
            "{",
            "}",
            ";",
            "typedef",
            "sequence",
            "<",
            ">",
            "::",
            "enum",
            "const",
            ",",
            '"',
            "'",
            "@unit(",
            ")",
            "/*",
            "*/",
            "//",
            "double",
            "unsigned",
            "long",
            "\n",
            "====\n",
            "\x00",
            "\x85",
        ]
    ),
    max_size=60,
)


@fuzz
@given(WORDS, st.sampled_from(["", " "]), st.sampled_from(["a/msg/B", "a/B", "B", "", "/"]))
def test_definitions_of_random_words(words: list[str], between: str, name: str) -> None:
    text = between.join(words)
    for parse in (parse_ros2msg, parse_ros1msg, parse_ros2idl):
        survives(parse, text, name)


@fuzz
@given(examples(), EDITS)
def test_definitions_with_some_bytes_changed(example: Example, edits: Any) -> None:
    for text, encoding, kind in ((example.text, "ros2msg", "cdr"), (example.idl, "ros2idl", "cdr"),
                                 (example.text, "ros1msg", "ros1")):  # fmt: skip
        broken = edited(text.encode(), edits)
        survives(definition_of, Channel(1, "/a", kind, ROOT, encoding, broken))


@fuzz
@given(examples(), EDITS, st.booleans(), st.binary(max_size=60))
def test_ros_messages_with_some_bytes_changed(
    example: Example, edits: Any, is_ros1: bool, noise: bytes
) -> None:
    rows = serialized_ros1(example) if is_ros1 else serialized(example, little_endian=True)
    encoding, schema = ("ros1", "ros1msg") if is_ros1 else ("cdr", "ros2msg")
    channel = Channel(1, "/a", encoding, ROOT, schema, example.text.encode())
    broken = [edited(row, edits) for row in rows] + [noise, ZSTD_MAGIC + noise]
    fields = [path for path, _ in leaves(definition_of(channel))]
    decoded_or_refused(channel, rows + broken, fields)


@fuzz
@given(proto_examples(), EDITS, st.binary(max_size=60))
def test_protobuf_messages_and_descriptors_with_some_bytes_changed(
    example: tuple[bytes, list[Any]], edits: Any, noise: bytes
) -> None:
    definition, messages = example
    survives(parse_descriptor_set, edited(definition, edits), "any.Root")
    survives(parse_descriptor_set, noise, "any.Root")
    rows = [message.SerializeToString() for message in messages]
    rows += [edited(row, edits) for row in rows] + [noise]
    channel = Channel(1, "/a", "protobuf", "any.Root", "protobuf", definition)
    fields = [path for path, _ in leaves(definition_of(channel))]
    decoded_or_refused(channel, rows, fields)


def decoded_or_refused(channel: Channel, rows: list[bytes], fields: list[str]) -> None:
    """Assert that rows are decoded or left out, and that each has a layout or none."""
    decoded = survives(decode_payloads, channel, Ragged.from_bytes(rows), fields)
    if decoded is not None:
        columns, kept = decoded
        assert len(kept) == len(rows)
        assert all(len(column) == np.count_nonzero(kept) for column in columns.values())
    for row in rows:
        survives(find_layout, channel, np.frombuffer(row, np.uint8), fields)


@fuzz
@given(
    st.lists(st.binary(max_size=40) | st.text(max_size=40).map(str.encode), max_size=4),
    st.lists(st.sampled_from(["a", "a.b", "b", ""]), min_size=1, unique=True),
)
def test_json_of_random_bytes(rows: list[bytes], fields: list[str]) -> None:
    rows += [b'{"a": ' + row + b"}" for row in rows] + [b'{"a": {"b": [' + r + b"]}}" for r in rows]
    survives(json.decode_rows, Ragged.from_bytes(rows), fields)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("sound")
    write_mcap(folder / "a.mcap", example_channels(60), "lz4", chunk_bytes=2000)
    loose = officially_written(example_channels(60), use_chunking=False)
    return [(folder / "a.mcap").read_bytes(), officially_written(example_channels(60)), loose]


@fuzz
@given(st.integers(0, 2), EDITS, st.booleans())
def test_files_with_some_bytes_changed(
    files: list[bytes], tmp_path: Path, which: int, edits: Any, packed: bool
) -> None:
    data = edited(files[which], edits)
    if packed:
        import zstandard

        data = edited(zstandard.ZstdCompressor().compress(files[which]), edits)
    (tmp_path / "a.mcap").write_bytes(data)
    survives(mcap.read, tmp_path / "a.mcap")
    survives(list_extras, tmp_path / "a.mcap")
    start = summary_start(data, len(data))
    if start is not None:
        ranges = skippable_ranges(data[start:], start, ["/depth"])
        assert all(0 <= low < high <= start for low, high in ranges)
