# SPDX-License-Identifier: Apache-2.0
"""JSON messages to columns: one after the other, as nothing else is possible.

null and absent mean unknown: NaN among numbers, empty text, an empty array, a time of 0.  NaN and
infinities, which strict JSON has not, may stand bare or as text, 64-bit integers as text.
"""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter
from types import GenericAlias
from typing import Any

import msgspec
import numpy as np

from abyssnav.errors import ReadError
from abyssnav.formats.columns import Column, Ragged, row_offsets
from abyssnav.tables import Bool

#: Members of a time, as ROS 2, ROS 1 and Protobuf have them; one int64 nanosecond column to us.
_TIMES = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"))
_ODD_NUMBERS = {"NaN": np.nan, "Infinity": np.inf, "-Infinity": -np.inf}
_HALF = rb"\ud"  #: begins half a letter, which may lack the other half
_DEEPEST = 32  #: arrays in arrays
_INTEGER = re.compile(r"-?\d{1,20}")
#: What the decoder says of bytes that are none; the last, of arrays a thousand deep.
_NO_JSON = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def decode_rows(payloads: Ragged, fields: Sequence[str]) -> tuple[dict[str, Column], Bool]:
    """Columns by dotted path of all `fields`, and which payloads are JSON objects.

    Raises
    ------
    ReadError
        A field whose values cannot be one column.
    """
    rows = payloads.row_bytes()
    shape = _ObjectShape.from_fields(fields)
    try:
        values = list(map(msgspec.json.Decoder(shape.type).decode, rows))
    except _NO_JSON:  # or a field that is an object in some only
        objects = [_object(row) for row in rows]
    else:
        columns = {path: _column(shape.values(path, values), path) for path in fields}
        return columns, np.ones(len(rows), bool)
    kept = np.array([isinstance(row, dict) for row in objects], bool)
    objects = [row for row in objects if isinstance(row, dict)]
    return {path: _column(_values(path, objects), path) for path in fields}, kept


@dataclass(frozen=True)
class _ObjectShape:
    """Objects with what is wanted of them alone: the rest is passed over, not made."""

    type: Any  #: of the object
    names: dict[str, str]  #: attribute by member
    inside: "dict[str, _ObjectShape]"  #: of the members that are objects, or arrays of them

    @classmethod
    def from_fields(cls, fields: Sequence[str]) -> "_ObjectShape":
        """Shape of an object with these dotted paths in it."""
        below: dict[str, list[str]] = {}
        whole = {path for path in fields if "." not in path}
        for path in fields:
            name, _, rest = path.partition(".")
            below.setdefault(name, []).extend([rest] if rest and name not in whole else [])
        inside = {name: cls.from_fields(paths) for name, paths in below.items() if paths}
        names = {name: f"member_{place}" for place, name in enumerate(below)}
        kinds = [
            (own, _object_or_objects(inside.get(name)), msgspec.field(name=name, default=None))
            for name, own in names.items()
        ]
        return cls(msgspec.defstruct("Wanted", kinds, gc=False), names, inside)

    def values(self, path: str, objects: Sequence[Any]) -> list[Any]:
        """Return what is at a path in each object, each array of objects or each None."""
        name, _, rest = path.partition(".")
        get = attrgetter(self.names[name])
        plain = self.type
        values = [get(o) if type(o) is plain else _below(o, get) for o in objects]
        if not rest:
            return values
        if name in self.inside:
            return self.inside[name].values(rest, values)
        return _values(rest, values)


def _below(value: Any, get: Callable[[Any], Any]) -> Any:
    """Return what `get` takes out of each object in an array; None where there is none."""
    if type(value) is list:
        return [_below(item, get) for item in value]
    return None if value is None else get(value)


def _object_or_objects(shape: _ObjectShape | None) -> Any:
    if shape is None:
        return Any
    return shape.type | GenericAlias(list, (shape.type | None,)) | None


def _values(path: str, objects: Sequence[Any]) -> list[Any]:
    """Return what is at a path in each object that was read whole."""
    values = list(objects)
    for name in path.split("."):
        values = [_member(value, name) for value in values]
    return values


def _object(row: bytes) -> Any:
    try:
        return msgspec.json.decode(row)
    except _NO_JSON:
        pass
    if _HALF in row.lower() or not (b"NaN" in row or b"Infinity" in row):
        return None
    try:  # as Python's own library writes them
        return json.loads(row)
    except (ValueError, RecursionError):
        return None


def _member(value: Any, name: str) -> Any:
    """Return a member of an object, or of each object in an array."""
    if isinstance(value, dict):
        return value.get(name)
    return [_member(item, name) for item in value] if isinstance(value, list) else None


def _column(values: list[Any], path: str, depth: int = 0) -> Column:
    kinds = {type(value) for value in values} - {type(None)}
    if list in kinds:
        if kinds != {list}:
            raise ReadError(f"{path} is an array in some messages and none in others")
        if depth == _DEEPEST:
            raise ReadError(f"{path} is an array of arrays of arrays, {depth} and more, too deep")
        lengths = [len(value) if value else 0 for value in values]
        inner = _column(
            list(chain.from_iterable(value for value in values if value)), path, depth + 1
        )
        return Ragged(inner, row_offsets(lengths))
    try:
        if dict in kinds:
            return np.array([_time_ns(value, path) for value in values], np.int64)
        if str in kinds:
            return _from_text(values)
        if kinds == {bool}:
            return np.array([value is True for value in values], bool)
        if kinds == {int} and None not in values:
            return _integers(values)
        return np.array([np.nan if value is None else value for value in values], np.float64)
    except OverflowError:
        raise ReadError(f"{path} is a number that 64 bits do not hold") from None


def _from_text(values: list[Any]) -> Column:
    """Numbers that came as text, or text."""
    known = [value for value in values if value is not None]
    if all(type(v) is int or (isinstance(v, str) and _INTEGER.fullmatch(v)) for v in known):
        if len(known) == len(values):
            return _integers([int(value) for value in values])
        return np.array([np.nan if v is None else float(v) for v in values], np.float64)
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
    if value is None:
        return 0
    if not isinstance(value, dict):
        raise ReadError(f"{path} is a time in some messages, and {value!r:.40} in others")
    for seconds, nanoseconds in _TIMES:
        if len(value) == 2 and seconds in value and nanoseconds in value:
            whole, rest = value[seconds], value[nanoseconds]
            if type(whole) is type(rest) is int:
                return whole * 1_000_000_000 + rest
            parts = [str(part) for part in (whole, rest)]  # Protobuf's 64-bit integers are text
            if all(map(_INTEGER.fullmatch, parts)):
                return int(parts[0]) * 1_000_000_000 + int(parts[1])
            raise ReadError(f"{path} is no time: {value!r:.80}")
    raise ReadError(f"{path} is no number, text or time; it has: {', '.join(value)}")
