# SPDX-License-Identifier: Apache-2.0
"""Columns to ROS 2 messages (CDR): the walk of `pipeline.formats.cdr`, the other way.

The cursor is one number a message.  Every field leaves the places its bytes go to; when the walk is
over, the lengths are known and all is laid down, field by field.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.cdr import ENCAPSULATION
from pipeline.formats.definitions import (
    PRIMITIVES,
    SEQUENCE,
    TIMES,
    Definition,
    Field,
)
from pipeline.formats.ragged import Ragged, concat, cumulative, spread, windows
from pipeline.tables import Int


def encode(definition: Definition, columns: Mapping[str, Any], n: int) -> Ragged:
    """`n` little-endian payloads from columns by dotted path; what is not given is zero or empty.

    Scalars are (n,) or one value for all, fixed arrays (n, k) or (k,), times int64 nanoseconds,
    text one string or n of them, variable arrays `Ragged`, (n, k) or a list of n lists; the members
    of an array of messages are one column each.

    Raises
    ------
    ValueError
        A path that the definition does not have, or a column of the wrong length.
    """
    writer = _Writer(definition, np.zeros(n, np.int64))
    writer.message(definition.root, np.arange(n), columns, "")
    unknown = sorted(set(columns) - writer.used)
    if unknown:
        raise ValueError(f"{definition.root} has no field {', '.join(unknown)}")
    return writer.lay_down()


@dataclass
class _Writer:
    """Where every byte goes: `ends` is the cursor of each message, behind the encapsulation."""

    tree: Definition
    ends: Int
    used: set[str] = field(default_factory=set)
    writes: list[tuple[Int, Int, Ragged]] = field(default_factory=list)

    def lay_down(self) -> Ragged:
        """All that was written, as payloads."""
        offsets = cumulative(self.ends + ENCAPSULATION)
        content = np.zeros(offsets[-1], np.uint8)
        content[offsets[:-1] + 1] = 1  # little-endian
        starts = offsets[:-1] + ENCAPSULATION
        even = len(self.ends) and bool((self.ends == self.ends[0]).all())
        matrix = content.reshape(len(self.ends), -1)[:, ENCAPSULATION:] if even else None
        for rows, at, items in self.writes:
            width = items.width
            if width == 0 or len(items) == 0:
                continue
            same_place = bool((at == at[0]).all()) and len(rows) == len(self.ends)
            if width and matrix is not None and same_place:
                start = int(at[0])
                matrix[:, start : start + width] = np.asarray(items.content).reshape(-1, width)
            elif width:
                blocks = np.asarray(items.content).view(f"V{width}")
                windows(content, width)[starts[rows] + at] = blocks
            else:
                content[spread(starts[rows] + at, items.lengths)] = items.content
        return Ragged(content, offsets)

    def message(self, kind: str, rows: Int, columns: Mapping[str, Any], prefix: str) -> None:
        """Lay out one `kind` a row; `rows` says in which payload each lies."""
        for member in self.tree.types[kind]:
            path = f"{prefix}{member.name}"
            if member.count is None:
                self._one(member.type, rows, columns, path)
            elif member.type in PRIMITIVES:
                self._numbers_array(member, rows, columns, path)
            else:
                self._elements(member, rows, columns, path)

    def _one(self, kind: str, rows: Int, columns: Mapping[str, Any], path: str) -> None:
        if kind in PRIMITIVES:
            dtype = np.dtype("<" + PRIMITIVES[kind])
            values = _filled(self._take(columns, path), (len(rows),), dtype, path)
            self._put(rows, dtype.itemsize, Ragged.regular(values[:, None]))
        elif kind == "string":
            self._text(rows, self._take(columns, path), path)
        elif kind in TIMES and path in columns:
            ns = _filled(self._take(columns, path), (len(rows),), np.dtype(np.int64), path)
            both = np.stack(np.divmod(ns, 1_000_000_000), axis=-1).astype("<u4")
            self._put(rows, 4, Ragged.regular(both))
        elif kind in self.tree.types:
            self.message(kind, rows, columns, f"{path}.")
        else:
            raise ValueError(f"{path} is a {kind}, which is not written")

    def _text(self, rows: Int, value: Any, path: str) -> None:
        if isinstance(value, str | None):
            one = np.frombuffer((value or "").encode() + b"\0", np.uint8)
            items = Ragged.regular(np.broadcast_to(one, (len(rows), len(one))))
        elif len(value) != len(rows):
            raise ValueError(f"{path}: {len(value)} texts for {len(rows)} rows")
        else:
            items = Ragged.of_bytes([str(text).encode() + b"\0" for text in value])
        self._put(rows, 4, Ragged.regular(items.lengths[:, None].astype("<u4")))
        self._put(rows, 1, items)

    def _numbers_array(
        self, member: Field, rows: Int, columns: Mapping[str, Any], path: str
    ) -> None:
        dtype = np.dtype("<" + PRIMITIVES[member.type])
        value = self._take(columns, path)
        if member.count != SEQUENCE:
            shape = (len(rows), member.count or 0)
            items = Ragged.regular(_filled(value, shape, dtype, path))
        else:
            items = _ragged(value, len(rows), path)
            self._put(rows, 4, Ragged.regular(items.lengths[:, None].astype("<u4")))
            items = Ragged(np.asarray(items.content).astype(dtype), items.offsets)
        some = np.flatnonzero(items.lengths)  # nothing is aligned for an empty array
        self._put(rows[some], dtype.itemsize, items[some] if len(some) < len(items) else items)

    def _elements(self, member: Field, rows: Int, columns: Mapping[str, Any], path: str) -> None:
        """Lay out an array of messages or text: first elements together, then the second ..."""
        fixed = None if member.count == SEQUENCE else member.count
        inside = {
            name: value if np.isscalar(value) else _ragged(value, len(rows), name, fixed)
            for name, value in columns.items()
            if name == path or name.startswith(f"{path}.")
        }
        self.used.update(inside)
        given = [value.lengths for value in inside.values() if isinstance(value, Ragged)]
        counts = given[0] if given else np.full(len(rows), fixed or 0)
        if any((other != counts).any() for other in given):
            raise ValueError(f"{path}: its columns differ in length")
        if fixed is None:
            self._put(rows, 4, Ragged.regular(counts[:, None].astype("<u4")))
        elif (counts != fixed).any():
            raise ValueError(f"{path}: {fixed} in each row expected")
        starts = cumulative(counts)[:-1]
        for k in range(int(counts.max(initial=0))):
            some = np.flatnonzero(counts > k)
            part = {
                name: value.content[starts[some] + k] if isinstance(value, Ragged) else value
                for name, value in inside.items()
            }
            self._one(member.type, rows[some], part, path)

    def _take(self, columns: Mapping[str, Any], path: str) -> Any:
        self.used.add(path)
        return columns.get(path)

    def _put(self, rows: Int, size: int, items: Ragged) -> None:
        """Write one run of items a row, aligned to their `size` in bytes."""
        at = self.ends[rows]
        at += -at % size
        content = np.ascontiguousarray(items.content).view(np.uint8)
        item_bytes = len(content) // max(1, len(np.asarray(items.content)))
        as_bytes = Ragged(content, items.offsets * item_bytes)
        self.writes.append((rows, at, as_bytes))
        self.ends[rows] = at + as_bytes.lengths


def _filled(value: Any, shape: tuple[int, ...], dtype: np.dtype[Any], path: str) -> NDArray[Any]:
    """Numbers of `shape`, from as many, from one for all, or zeros for None."""
    numbers = np.asarray(0 if value is None else value)
    if numbers.ndim > len(shape) or (numbers.ndim == len(shape) and numbers.shape != shape):
        raise ValueError(f"{path}: shape {numbers.shape} where {shape} was expected")
    return np.ascontiguousarray(np.broadcast_to(numbers, shape).astype(dtype))


def _ragged(value: Any, n: int, path: str, fixed: int | None = None) -> Ragged:
    """An array a row, from `Ragged`, (n, k), a list of n lists, or (k,) where k is fixed."""
    if value is None:
        return Ragged(np.zeros(0), np.zeros(n + 1, np.int64))
    if isinstance(value, list | tuple) and value and isinstance(value[0], Sequence | np.ndarray):
        lists = [np.asarray(row) for row in value]
        value = Ragged(np.asarray(concat(lists)), cumulative([len(row) for row in lists]))
    if not isinstance(value, Ragged):
        array = np.asarray(value)
        if fixed is not None and array.shape == (fixed,):
            array = np.broadcast_to(array, (n, fixed))
        if array.ndim < 2:
            raise ValueError(f"{path}: one array a row expected, got shape {array.shape}")
        value = Ragged.regular(array)
    rows: Ragged = value
    if len(rows) != n:
        raise ValueError(f"{path}: {len(rows)} rows where {n} were expected")
    return rows
