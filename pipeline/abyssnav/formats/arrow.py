# SPDX-License-Identifier: Apache-2.0
"""A whole MCAP file as Arrow tables, one a topic: the columnar reader on its own."""

import json as standard_json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from abyssnav.errors import ReadError, nearest_names
from abyssnav.formats import protobuf
from abyssnav.formats.columns import Column, Ragged
from abyssnav.formats.decoding import decode_payloads, definition_of, field_decoder
from abyssnav.formats.mcap.accumulator import PAYLOADS, ChannelDecoder, Decoded, Messages
from abyssnav.formats.mcap.file_index import Channel
from abyssnav.formats.mcap.reader import read_mcap
from abyssnav.formats.schema import DURATION, TIMES, leaves
from abyssnav.tables import Finding

if TYPE_CHECKING:
    import pyarrow as pa

_TIMES: Final = (*TIMES, *protobuf.TIMES)
_DURATIONS: Final = (DURATION, protobuf.TIMES[1])
_PAYLOAD: Final = "payload"
_MOST_FIELDS: Final = 1 << 12  #: of a message; of types that hold one another there is no end


def read_tables(path: Path, topics: Sequence[str] | None = None) -> "dict[str, pa.Table]":
    """Read topics of an MCAP file (default: all with messages) as Arrow tables, by log time.

    As `abyssnav.formats.mcap.read`, which documents the columns.
    """
    kinds: dict[int, _Kinds] = {}

    def select(channel: Channel) -> ChannelDecoder | None:
        if topics is not None and channel.topic not in topics:
            return None
        kinds[channel.id] = _kinds_of(channel)
        return kinds[channel.id].decoder(channel)

    recording = read_mcap(path, select)
    known = sorted({channel.topic for channel in recording.channels})
    for topic in topics or ():
        if topic not in known:
            nearest = nearest_names(topic, known, cutoff=0.6)
            hint = f"; nearest: {nearest[0]!r}" if nearest else ""
            raise ReadError(f"{path}: no topic {topic!r}{hint}")
    tables: dict[str, list[pa.Table]] = {}
    for messages in recording.messages:
        table = _table(messages, kinds[messages.channel.id], recording.findings)
        tables.setdefault(messages.channel.topic, []).append(table)
    return {topic: _joined(path, topic, parts) for topic, parts in sorted(tables.items())}


@dataclass
class _Kinds:
    """Fields of a channel's messages by dotted path, and their types where these are known."""

    kinds: Mapping[str, str] | None  #: None where only the messages say it: JSON
    problem: str = ""  #: why messages cannot be decoded; they are given as they are

    def decoder(self, channel: Channel) -> ChannelDecoder:
        if self.problem:
            return PAYLOADS
        if self.kinds is None:
            return ChannelDecoder(lambda payloads: _decode_json(channel, payloads))
        return field_decoder(channel, list(self.kinds))


def _kinds_of(channel: Channel) -> _Kinds:
    if channel.message_encoding == "json":
        return _Kinds(None)
    try:
        tree = definition_of(channel)
        kinds = dict(islice(leaves(tree, _TIMES), _MOST_FIELDS))
        for path, kind in kinds.items():
            if kind == "wstring" or kind.startswith("group "):
                return _Kinds({}, f"{path} is a {kind}, which is not read")
        return _Kinds(kinds)
    except ReadError as error:
        return _Kinds({}, str(error))


def _decode_json(channel: Channel, payloads: Ragged) -> Decoded:
    """All that objects hold, by the paths that any of them shows."""
    paths: dict[str, None] = {}
    for row in payloads.row_bytes():
        try:
            paths |= dict.fromkeys(_json_paths("", msgspec.json.decode(row)))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            continue
    return decode_payloads(channel, payloads, list(paths))


def _json_paths(prefix: str, value: Any) -> Iterator[str]:
    times = ({"sec", "nanosec"}, {"sec", "nsec"}, {"seconds", "nanos"})
    if isinstance(value, dict) and not (prefix and set(value) in times):
        for name, inner in value.items():
            if "." not in name:
                yield from _json_paths(f"{prefix}.{name}" if prefix else name, inner)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for item in value:
            yield from _json_paths(prefix, item)
    elif prefix:
        yield prefix


def _table(messages: Messages, kinds: _Kinds, findings: Sequence[Finding]) -> "pa.Table":
    import pyarrow as pa

    channel, problem = messages.channel, kinds.problem or str(messages.problem or "")
    time_ns, columns = messages.log_time_ns, dict(messages.columns)
    if (np.diff(time_ns) < 0).any():
        order = np.argsort(time_ns, kind="stable")
        time_ns, columns = time_ns[order], {name: c[order] for name, c in columns.items()}
    arrays = {"log_time": _timestamps(time_ns)}
    for name in kinds.kinds or columns if columns else ():
        column = columns[name]
        if name == _PAYLOAD and kinds.problem and isinstance(column, Ragged):
            arrays[name] = pa.array(column.row_bytes(), pa.large_binary())
        else:
            arrays[name] = _array(column, (kinds.kinds or {}).get(name, ""))
    said = [{"what": f.what, "where": f.where, "detail": f.detail} for f in findings]
    metadata = {"type": channel.type, "encoding": channel.message_encoding, "problem": problem,
                "lost": str(messages.lost), "findings": standard_json.dumps(said)}  # fmt: skip
    return pa.table(arrays, metadata=metadata)


def _timestamps(time_ns: Any) -> Any:
    import pyarrow as pa

    return pa.array(np.ascontiguousarray(time_ns, np.int64)).view(pa.timestamp("ns", "UTC"))


def _array(column: Column, kind: str) -> Any:
    import pyarrow as pa

    if isinstance(column, Ragged):
        values = _array(column.content, kind)
        return pa.LargeListArray.from_arrays(pa.array(column.offsets), values)
    if column.ndim > 1:
        size = column.shape[1]
        values = _array(np.ascontiguousarray(column).reshape(-1, *column.shape[2:]), kind)
        return pa.FixedSizeListArray.from_arrays(values, size)
    if kind in _TIMES:
        whole = pa.array(np.ascontiguousarray(column, np.int64))
        return whole.view(pa.duration("ns") if kind in _DURATIONS else pa.timestamp("ns", "UTC"))
    if column.dtype.kind == "T":
        return pa.array(column.tolist(), pa.large_string())
    return pa.array(np.ascontiguousarray(column))


def _joined(path: Path, topic: str, parts: "list[pa.Table]") -> "pa.Table":
    """One table of a topic's channels; a field that one lacks is null there."""
    import pyarrow as pa

    if len(parts) == 1:
        return parts[0]
    try:
        table = pa.concat_tables(parts, promote_options="default")
    except (pa.ArrowTypeError, pa.ArrowInvalid):
        detail = "fields differ in kind between its channels"
        raise ReadError(f"{path}: topic {topic!r}: {detail}") from None
    return table.take(pa.compute.sort_indices(table, [("log_time", "ascending")]))
