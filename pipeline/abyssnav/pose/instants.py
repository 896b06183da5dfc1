# SPDX-License-Identifier: Apache-2.0
"""Instants from a table with a column of times, or from the stamps of a topic of an MCAP file."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from abyssnav.errors import ReadError, nearest_hint, printable
from abyssnav.formats.decoding import field_decoder
from abyssnav.formats.mcap.container import ZSTD_MAGIC
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.mcap.reader import read_mcap
from abyssnav.formats.mcap.records import MAGIC
from abyssnav.tables import Int

if TYPE_CHECKING:
    import pyarrow as pa

#: Names that a column of times has in people's tables, the surest first.
_TIME_NAMES: Final = (
    "time", "timestamp", "stamp", "datetime", "date_time", "utc", "time_utc", "time_ns", "time_us",
    "time_ms", "time_s", "unix", "epoch", "t",
)  # fmt: skip
_LABEL_NAMES: Final = ("label", "file", "filename", "image", "name", "photo")
#: A number of time since 1970 by its size today: from, unit, nanoseconds of one.
_UNITS: Final = (
    (1e17, "ns", 1),
    (1e14, "us", 1_000),
    (1e11, "ms", 1_000_000),
    (0.0, "s", 1_000_000_000),
)
#: Where messages keep their own stamp, and of which encodings.
_STAMPS: Final = ("header.stamp", "timestamp", "stamp")


@dataclass(frozen=True, eq=False)
class Instants:
    """Instants in the order of the file."""

    time_ns: Int
    labels: tuple[str, ...]  #: what the file calls each; empty: nothing
    source: str  #: which column or topic, and how it was read, for people

    def __len__(self) -> int:
        return len(self.time_ns)


def read_instants(path: Path, topic: str | None = None, time_column: str | None = None) -> Instants:
    """Instants of a CSV or Parquet file's column of times, or of an MCAP file's topic.

    A column holds ISO 8601 (UTC if it does not say otherwise) or Unix time in s, ms, us or ns,
    recognised by its size.  Of a topic, the stamps in the messages' own headers count; the log's
    where messages have none.

    Raises
    ------
    ReadError
        No such file, column or topic, several to choose from, or a value that is no time.
    """
    if not path.is_file():
        raise ReadError(f"{path}: no such file; one at a URL has to be copied first")
    with path.open("rb") as file:
        start = file.read(len(MAGIC))
    if start == MAGIC or start.startswith(ZSTD_MAGIC):
        return _of_topic(path, topic)
    if topic is not None:
        raise ReadError(f"{path}: not MCAP, so it has no topic {topic!r}")
    table = _read_parquet(path) if start[:4] == b"PAR1" else _read_csv(path)
    name = _time_column(path, table.column_names, time_column)
    labels = [n for n in table.column_names if n.strip().lower() in _LABEL_NAMES and n != name]
    texts = tuple(map(str, table[labels[0]].to_pylist())) if labels else ()
    time_ns, how = _times(table[name], f"{path}: column {name!r}")
    return Instants(time_ns, texts, f"column {printable(name)}: {how}")


# --- MCAP -------------------------------------------------------------------------------------


def _of_topic(path: Path, topic: str | None) -> Instants:
    topic = topic or _only_topic(path)

    def select(channel: Channel) -> Any:
        if channel.topic != topic:
            return None
        for field in _STAMPS:
            try:
                return field_decoder(channel, [field])
            except ReadError:
                continue
        return field_decoder(channel, [])

    recording = read_mcap(path, select)
    known = {channel.topic for channel in recording.channels}
    messages = [part for part in recording.messages if part.channel.topic == topic]
    if not messages:
        reason = f"no message on {topic!r}" if topic in known else f"no topic {topic!r}"
        raise ReadError(f"{path}: {reason}{nearest_hint(topic, sorted(known))}")
    times, sources = [], set[str]()
    for part in messages:
        stamps = [np.asarray(part.columns[f]) for f in _STAMPS if f in part.columns]
        is_stamp = bool(stamps) and stamps[0].dtype.kind == "i" and bool(np.any(stamps[0]))
        times.append(stamps[0].astype(np.int64) if is_stamp else part.log_time_ns)
        sources.add("the messages' own stamps" if is_stamp else "log times, as it has no stamps")
    return Instants(
        np.concatenate(times), (), f"topic {printable(topic)}: {' and '.join(sorted(sources))}"
    )


def _only_topic(path: Path) -> str:
    topics = sorted({channel.topic for channel in read_mcap(path, lambda _: None).channels})
    if len(topics) != 1:
        names = ", ".join(map(printable, topics)) or "none"
        raise ReadError(f"{path}: which topic?  Give --topic; there are {names}")
    return topics[0]


# --- tables -----------------------------------------------------------------------------------


def _read_parquet(path: Path) -> "pa.Table":
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise ReadError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None


def _read_csv(path: Path) -> "pa.Table":
    """All columns as text: a float would lose what a Unix time in nanoseconds has."""
    import pyarrow as pa
    from pyarrow import csv

    try:
        with path.open(encoding="utf-8-sig") as file:
            head = file.readline()
        separator = max(",;\t", key=head.count)
        names = [n.strip().strip('"') for n in head.lstrip("# ").rstrip("\r\n").split(separator)]
        return csv.read_csv(
            path,
            csv.ReadOptions(column_names=names, skip_rows=1),
            csv.ParseOptions(delimiter=separator),
            csv.ConvertOptions(column_types=dict.fromkeys(names, pa.string())),
        )
    except (OSError, UnicodeDecodeError, pa.ArrowInvalid, pa.ArrowKeyError) as error:
        raise ReadError(f"{path}: no table: {str(error).splitlines()[0]}") from None


def _time_column(path: Path, names: Iterable[str], wanted: str | None) -> str:
    names = list(names)
    if wanted is not None:
        if wanted not in names:
            raise ReadError(f"{path}: no column {wanted!r}{nearest_hint(wanted, names)}")
        return wanted
    by_name = {name.strip().lower(): name for name in reversed(names)}
    known = [by_name[name] for name in _TIME_NAMES if name in by_name]
    if not known and len(names) != 1:
        raise ReadError(
            f"{path}: no column of times; give --time-column; there are {', '.join(names)}"
        )
    return known[0] if known else names[0]


def _times(column: "pa.ChunkedArray", where: str) -> tuple[Int, str]:
    """UTC in nanoseconds, and how the column was understood."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if column.null_count or not len(column):
        row = pc.index(pc.is_null(column), True).as_py() if len(column) else 0
        raise ReadError(f"{where}: nothing in row {row + 1}")
    if pa.types.is_timestamp(column.type):
        return column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy(), "timestamps, UTC"
    if pa.types.is_string(column.type):
        text = pc.utf8_trim_whitespace(column)
        if ":" in text[0].as_py() or text[0].as_py().count("-") == 2:
            return _iso(text, where), "ISO 8601, UTC"
        column = _converted(text, pa.decimal128(38, 9), where)
    unit, size_ns = _unit(column, where)
    if pa.types.is_floating(column.type):
        seconds = column.to_numpy()
        whole = np.floor(seconds).astype(np.int64)  # a product of floats would lose the last bits
        return whole * size_ns + np.rint((seconds - whole) * size_ns).astype(np.int64), unit
    if pa.types.is_decimal(column.type):
        digits = len(str(size_ns)) - 1
        exact = column.cast(pa.decimal128(38, digits), safe=False).combine_chunks()
        # a decimal is a whole number of its last digit, here of nanoseconds, in 16 bytes
        whole = np.frombuffer(exact.buffers()[1], "<i8")[2 * exact.offset :: 2]
        return whole[: len(exact)], unit
    return column.cast(pa.int64()).to_numpy() * size_ns, unit


def _unit(column: "pa.ChunkedArray", where: str) -> tuple[str, int]:
    import pyarrow as pa
    import pyarrow.compute as pc

    if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
            or pa.types.is_decimal(column.type)):  # fmt: skip
        raise ReadError(f"{where}: {column.type} is no time")
    values = column.cast(pa.float64(), safe=False)
    if not pc.all(pc.is_finite(values)).as_py():
        raise ReadError(f"{where}: a value that is no number")
    middle = float(np.median(np.abs(values.to_numpy())))
    name, size_ns = next((name, size) for least, name, size in _UNITS if middle >= least)
    return f"Unix time in {name}", size_ns


def _iso(text: "pa.ChunkedArray", where: str) -> Int:
    """Nanoseconds of ISO 8601, with or without a zone; without one it is UTC."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if not pc.all(pc.ends_with(text, "Z")).as_py():
        zoned = pc.match_substring_regex(text, r"(Z|[+-]\d\d:?\d\d)$")
        zoned = pc.and_(zoned, pc.match_substring(text, ":"))
        text = pc.if_else(zoned, text, pc.binary_join_element_wise(text, "Z", ""))
    column = _converted(text, pa.timestamp("ns", "UTC"), where)
    return np.asarray(column.cast(pa.int64()).to_numpy())


def _converted(text: "pa.ChunkedArray", kind: "pa.DataType", where: str) -> "pa.ChunkedArray":
    """The texts as another type; the first that is none is named with its row."""
    import pyarrow as pa

    try:
        return text.cast(kind)
    except pa.ArrowInvalid:
        for row, value in enumerate(text.to_pylist(), start=1):
            try:
                pa.array([value]).cast(kind)
            except pa.ArrowInvalid:
                raise ReadError(
                    f"{where}, row {row}: {value.removesuffix('Z')!r} is no time"
                ) from None
        raise
