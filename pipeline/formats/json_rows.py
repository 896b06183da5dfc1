# SPDX-License-Identifier: Apache-2.0
"""JSON messages to columns: one after the other, as nothing else is possible.

null and absent mean unknown: NaN among numbers, empty text, an empty array, a time of 0.  NaN and
infinities, which strict JSON has not, and 64-bit integers may come as text.
"""

import re
from collections.abc import Sequence
from itertools import chain
from typing import Any

import msgspec
import numpy as np

from pipeline.errors import ReadError
from pipeline.formats.ragged import Column, Ragged, cumulative
from pipeline.tables import Bool

#: Members of a time, as ROS 2, ROS 1 and Protobuf have them; one int64 nanosecond column to us.
_TIMES = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"))
_ODD_NUMBERS = {"NaN": np.nan, "Infinity": np.inf, "-Infinity": -np.inf}
_INTEGER = re.compile(r"-?\d{1,20}")


def decode_rows(payloads: Ragged, fields: Sequence[str]) -> tuple[dict[str, Column], Bool]:
    """Columns by dotted path of all `fields`, and which payloads are JSON objects.

    Raises
    ------
    ReadError
        A field whose values cannot be one column.
    """
    rows = payloads.row_bytes()
    try:
        found = msgspec.json.decode(b"[" + b",".join(rows) + b"]")
        fits = len(found) == len(rows)
    except (msgspec.DecodeError, UnicodeDecodeError):
        fits = False
    found = found if fits else [_object(row) for row in rows]
    kept = np.array([isinstance(row, dict) for row in found], bool)
    found = [row for row in found if isinstance(row, dict)]
    inside: dict[str, list[Any]] = {"": found}  #: objects by path, as many fields share them
    return {path: _column(_values(path, inside), path) for path in fields}, kept


def _values(path: str, inside: dict[str, list[Any]]) -> list[Any]:
    """Return what is at a path in each object of `inside[""]`."""
    above, _, name = path.rpartition(".")
    if above not in inside:
        inside[above] = _values(above, inside)
    return [
        value.get(name) if type(value) is dict else _member(value, name) for value in inside[above]
    ]


def _object(row: bytes) -> Any:
    try:
        return msgspec.json.decode(row)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None


def _member(value: Any, name: str) -> Any:
    """Return a member of an object, or of each object in an array."""
    if isinstance(value, dict):
        return value.get(name)
    return [_member(item, name) for item in value] if isinstance(value, list) else None


def _column(values: list[Any], path: str) -> Column:
    kinds = {type(value) for value in values} - {type(None)}
    if list in kinds:
        if kinds != {list}:
            raise ReadError(f"{path} is an array in some messages and none in others")
        lengths = [len(value) if value else 0 for value in values]
        inner = _column(list(chain.from_iterable(value for value in values if value)), path)
        return Ragged(inner, cumulative(lengths))
    if dict in kinds:
        return np.array([_time_ns(value, path) for value in values], np.int64)
    if str in kinds:
        return _from_text(values)
    if kinds == {bool}:
        return np.array([value is True for value in values], bool)
    if kinds == {int} and None not in values:
        return _integers(values)
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _from_text(values: list[Any]) -> Column:
    """Numbers that came as text, or text."""
    if all(type(v) is int or (isinstance(v, str) and _INTEGER.fullmatch(v)) for v in values):
        return _integers([int(value) for value in values])
    if all(not isinstance(value, str) or value in _ODD_NUMBERS for value in values):
        known = [_ODD_NUMBERS.get(v, v) if isinstance(v, str) else v for v in values]
        return np.array([np.nan if v is None else v for v in known], np.float64)
    texts = ["" if value is None else str(value) for value in values]
    return np.array(texts, np.dtypes.StringDType())


def _integers(values: list[int]) -> Column:
    try:
        return np.array(values, np.int64)
    except OverflowError:
        return np.array(values, np.float64)


def _time_ns(value: Any, path: str) -> int:
    for seconds, nanoseconds in _TIMES:
        if isinstance(value, dict) and value.keys() == {seconds, nanoseconds}:
            return int(value[seconds]) * 1_000_000_000 + int(value[nanoseconds])
    if value is None:
        return 0
    members = ", ".join(value) if isinstance(value, dict) else value
    raise ReadError(f"{path} is no number, text or time; it has: {members}")
