# SPDX-License-Identifier: Apache-2.0
"""Columns to ROS 2 messages (CDR): the walk of `abyssnav.formats.cdr`, the other way.

Where messages differ in numbers alone, one is walked for all: a day of a topic is one payload and
its columns, and the bytes are made when they are written, a chunk at a time, in memory that the
processor still holds.  Else the cursor is one number a message; every field leaves the places its
bytes go to, and when the walk is over, the lengths are known and all is laid down, field by field.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from abyssnav.formats.cdr import ENCAPSULATION
from abyssnav.formats.columns import (
    Ragged,
    concatenate,
    overlapping_windows,
    ragged_indices,
    row_offsets,
)
from abyssnav.formats.schema import (
    PRIMITIVES,
    SEQUENCE,
    TIMES,
    Definition,
    Field,
    leaves,
)
from abyssnav.tables import Int

_ELEMENT: Final = re.compile(r"(.+)\[(\d+)\]")
#: Where a number lies in a payload, its type there, and how many where it is an array.
NumberSlot = tuple[int, np.dtype[Any], tuple[int, ...]]


@dataclass(frozen=True, eq=False)
class PayloadTemplate:
    """One layout: a payload, and the columns that make others of it."""

    payload: NDArray[np.uint8]  #: payload, with what is the same in each
    #: byte of the payload, type there, and the topic's whole column (n,) or (n, k)
    numbers: Sequence[tuple[int, np.dtype[Any], NDArray[Any]]]

    def rows(self, rows: Any, n: int) -> NDArray[np.uint8]:
        """Return the bytes of `n` of the topic's messages, one row each."""
        whole = np.empty((n, len(self.payload)), np.uint8)
        whole[:] = self.payload
        fields = whole.view(self._layout)[:, 0]
        for (_, _, column), name in zip(self.numbers, self._layout.names or (), strict=True):
            fields[name] = column[rows]
        return whole

    @cached_property
    def _layout(self) -> np.dtype[Any]:
        return np.dtype(
            {
                "names": [f"{k}" for k in range(len(self.numbers))],
                "formats": [(dtype, column.shape[1:]) for _, dtype, column in self.numbers],
                "offsets": [position for position, _, _ in self.numbers],
                "itemsize": len(self.payload),
            }
        )


@dataclass(frozen=True, eq=False)
class PayloadTemplates:
    """Payloads of a topic that are not laid down yet; `templates[rows]` are some of them."""

    templates: Sequence[PayloadTemplate]
    template: Int  #: (n,) which of the templates each message has

    def __len__(self) -> int:
        return len(self.template)

    @cached_property
    def lengths(self) -> Int:
        """Return the bytes of each payload, (n,)."""
        return np.array([len(template.payload) for template in self.templates], np.int64)[
            self.template
        ]

    def __getitem__(self, rows: Any) -> Ragged:
        """Lay down the payloads that a mask, slice or index array selects."""
        if isinstance(rows, slice) and len(self.templates) == 1:  # columns are seen, not gathered
            n = len(range(*rows.indices(len(self))))
            return Ragged.regular(self.templates[0].rows(rows, n))
        chosen = isinstance(rows, np.ndarray) and rows.dtype != np.bool_
        wanted = rows if chosen else np.arange(len(self))[rows]
        if len(self.templates) == 1:
            return Ragged.regular(self.templates[0].rows(wanted, len(wanted)))
        offsets = row_offsets(self.lengths[wanted])
        content = np.zeros(offsets[-1], np.uint8)
        for number in np.unique(self.template[wanted]).tolist():
            matches, template = (
                np.flatnonzero(self.template[wanted] == number),
                self.templates[number],
            )
            width = len(template.payload)
            blocks = template.rows(wanted[matches], len(matches)).view(f"V{width}")[:, 0]
            overlapping_windows(content, width)[offsets[matches]] = blocks
        return Ragged(content, offsets)

    def row_bytes(self) -> list[bytes]:
        """Return every payload as a byte string."""
        return self[:].row_bytes()


def make_template(
    payload: NDArray[np.uint8], slots: Mapping[str, NumberSlot], columns: Mapping[str, Any], n: int
) -> PayloadTemplate | None:
    """Template of `n` messages from one payload and their numbers; None where one has no place.

    Parameters
    ----------
    columns : path, or `path[k]` for one element of an array, to a column (n, ...) or to one value
        for all; columns are kept, not copied

    Raises
    ------
    ValueError
        A column of another shape than its place.
    """
    payload, numbers = payload.copy(), []
    for path, value in sorted(columns.items()):  # a whole array before its elements
        slot = _slot(slots, path)
        if slot is None:
            return None
        position, dtype, shape = slot
        column = np.asarray(0 if value is None else value)
        if column.shape == (n, 1) and not shape:  # of an array with one element
            column = column[:, 0]
        if column.ndim > len(shape):
            if column.shape != (n, *shape):
                raise ValueError(f"{path}: shape {column.shape} where {(n, *shape)} was expected")
            numbers.append((position, dtype, column))
        else:
            one = np.broadcast_to(column, shape).astype(dtype).ravel()
            payload[position : position + one.nbytes] = one.view(np.uint8)
    return PayloadTemplate(payload, numbers)


def _slot(slots: Mapping[str, NumberSlot], path: str) -> NumberSlot | None:
    element = _ELEMENT.fullmatch(path)
    if element is None:
        return slots.get(path)
    position, dtype, shape = slots.get(element[1], (0, np.dtype("u1"), ()))
    k = int(element[2])
    return (position + k * dtype.itemsize, dtype, ()) if len(shape) == 1 and k < shape[0] else None


#: Combinations of texts in one topic; where there are more, each message is walked.
_MAX_TEMPLATES: Final = 64
#: Elements of an array from which on it pays to look whether they are alike.
_MANY: Final = 8


def encode(definition: Definition, columns: Mapping[str, Any], n: int) -> Ragged:
    """`n` little-endian payloads from columns by dotted path; what is not given is zero or empty.

    Scalars are (n,) or one value for all, fixed arrays (n, k) or (k,), times int64 nanoseconds,
    text one string, n of them or (places (n,), words), variable arrays `Ragged`, (n, k) or a list
    of n lists; the members of an array of messages are one column each.

    Raises
    ------
    ValueError
        A path that the definition does not have, or a column of the wrong length.
    """
    return encode_lazily(definition, columns, n)[:]


def encode_lazily(
    definition: Definition, columns: Mapping[str, Any], n: int
) -> Ragged | PayloadTemplates:
    """`encode`, but messages that differ in numbers and a few texts alone are not laid down yet.

    Of those, `path[k]` may be the column of one element of a fixed array.

    Raises
    ------
    ValueError
        As of `encode`.
    """
    templates = _templates(definition, columns, n)
    if templates is not None:
        return templates
    columns = {
        path: [value[1][place] for place in value[0]] if _is_places(value) else value
        for path, value in columns.items()
    }
    writer = _Writer(definition, np.zeros(n, np.int64))
    writer.message(definition.root, np.arange(n), columns, "")
    unknown = sorted(set(columns) - writer.used)
    if unknown:
        raise ValueError(f"{definition.root} has no field {', '.join(unknown)}")
    return writer.lay_down()


def _templates(
    definition: Definition, columns: Mapping[str, Any], n: int
) -> PayloadTemplates | None:
    """A template for each combination of texts; None where other things move the fields."""
    texts = {path: _places(value) for path, value in columns.items() if _is_text(value)}
    words = {path: value for path, value in columns.items() if isinstance(value, str)}
    numbers = {path: v for path, v in columns.items() if path not in texts and path not in words}
    for path in [path for path, kind in leaves(definition) if kind in TIMES and path in numbers]:
        seconds, rest = np.divmod(np.asarray(numbers.pop(path)), 1_000_000_000)
        numbers |= {f"{path}.sec": seconds, f"{path}.nanosec": rest}
    # arrays with one element in all messages have their fields where that element has them
    arrays = {path: v for path, v in numbers.items() if isinstance(v, np.ndarray)}
    one = {path: np.zeros((1, 1)) for path, v in arrays.items() if v.shape == (n, 1)}
    first, number = _alike(list(texts.values()), n)
    templates = []
    for row in first.tolist():
        stated = words | {p: known[place[row]] if n else "" for p, (place, known) in texts.items()}
        writer = _Writer(definition, np.zeros(1, np.int64))
        writer.message(definition.root, np.zeros(1, np.int64), one | stated, "")
        shared = np.asarray(writer.lay_down().content)
        template = make_template(shared, writer.slots, numbers, n)
        if template is None or not stated.keys() <= writer.used:
            return None
        templates.append(template)
    return PayloadTemplates(templates, number) if templates else None


def _is_text(value: Any) -> bool:
    """Whether this is a text a row."""
    if isinstance(value, np.ndarray):
        return value.ndim == 1 and value.dtype.kind in "UT"
    is_list = isinstance(value, list) and bool(value) and isinstance(value[0], str)
    return is_list or _is_places(value)


def _is_places(value: Any) -> bool:
    """Whether this is a text a row, as places in a list of words."""
    return isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], np.ndarray)


def _places(texts: Any) -> tuple[Int, Sequence[str]]:
    """A text a row as places in a list of words."""
    if _is_places(texts):
        return texts[0], texts[1]
    known, place = np.unique(np.asarray(texts), return_inverse=True)
    return place, [str(word) for word in known]


def _alike(texts: Sequence[tuple[Int, Sequence[str]]], n: int) -> tuple[Int, Int]:
    """First row of each combination of texts, and each row's combination; no rows if too many."""
    first, number = np.zeros(1, np.int64), np.zeros(n, np.int64)
    if any(len(place) != n for place, _ in texts):
        return first[:0], number
    for place, known in texts if n else ():
        _, first, number = np.unique(
            number * len(known) + place, return_index=True, return_inverse=True
        )
    return first[: len(first) if len(first) <= _MAX_TEMPLATES else 0], number


@dataclass
class _Writer:
    """Where every byte goes: `ends` is the cursor of each message, behind the encapsulation."""

    tree: Definition
    ends: Int
    used: set[str] = field(default_factory=set)
    slots: dict[str, NumberSlot] = field(default_factory=dict)  #: of numbers, in the first message
    writes: list[tuple[Int, Int, Ragged]] = field(default_factory=list)

    def lay_down(self) -> Ragged:
        """All that was written, as payloads."""
        offsets = row_offsets(self.ends + ENCAPSULATION)
        content = np.zeros(offsets[-1], np.uint8)
        content[offsets[:-1] + 1] = 1  # little-endian
        starts = offsets[:-1] + ENCAPSULATION
        for rows, position, items in self.writes:
            width = items.width
            if width == 0 or len(items) == 0:
                continue
            if width:
                blocks = np.asarray(items.content).view(f"V{width}")
                overlapping_windows(content, width)[starts[rows] + position] = blocks
            else:
                content[ragged_indices(starts[rows] + position, items.lengths)] = items.content
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
            position = self._put(rows, dtype.itemsize, Ragged.regular(values[:, None]))
            self.slots[path] = (position, dtype, ())
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
            items = Ragged.from_bytes([str(text).encode() + b"\0" for text in value])
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
        nonempty = np.flatnonzero(items.lengths)  # nothing is aligned for an empty array
        items = items[nonempty] if len(nonempty) < len(items) else items
        position = self._put(rows[nonempty], dtype.itemsize, items)
        if member.count != SEQUENCE:
            self.slots[path] = (position, dtype, (member.count or 0,))

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
        starts, slots = row_offsets(counts)[:-1], dict(self.slots)
        first = self._alike(member.type, inside, path) if len(rows) == 1 else 0
        for k in range(first, int(counts.max(initial=0))):
            nonempty = np.flatnonzero(counts > k)
            part = {
                name: value.content[starts[nonempty] + k] if isinstance(value, Ragged) else value
                for name, value in inside.items()
            }
            self._one(member.type, rows[nonempty], part, path)
        self.slots, laid_down = slots, self.slots
        if (counts == 1).all():  # those of more elements are not one to a path
            self.slots |= {
                name: slot for name, slot in laid_down.items() if name in inside and not slot[2]
            }

    def _alike(self, kind: str, inside: Mapping[str, Any], path: str) -> int:
        """Lay out the one row's elements at once where all are of one length; return how many.

        Behind the first, whose padding may differ, such elements lie a period apart.
        """
        arrays = {name: v.content for name, v in inside.items() if isinstance(v, Ragged)}
        count = len(next(iter(arrays.values()), ()))
        if count < _MANY or any(
            np.asarray(values).dtype.kind in "OSU" for values in arrays.values()
        ):
            return 0
        ends = [int(self.ends[0])]
        for k in range(2):
            part = {
                name: arrays[name][k : k + 1] if name in arrays else inside[name] for name in inside
            }
            self._one(kind, np.zeros(1, np.int64), part, path)
            ends.append(int(self.ends[0]))
        period, rest = ends[2] - ends[1], np.arange(count - 2)
        if period % 8:
            return 2
        others = _Writer(self.tree, ends[2] + period * rest)
        part = {name: arrays[name][2:] if name in arrays else inside[name] for name in inside}
        others._one(kind, rest, part, path)
        zeros = np.zeros_like(rest)
        self.writes += [
            (zeros[: len(positions)], positions, items) for _, positions, items in others.writes
        ]
        self.ends[0] = others.ends[-1]
        return count

    def _take(self, columns: Mapping[str, Any], path: str) -> Any:
        self.used.add(path)
        return columns.get(path)

    def _put(self, rows: Int, size: int, items: Ragged) -> int:
        """Write a run of items a row, aligned to their `size`; return its place in the first."""
        position = self.ends[rows]
        position += -position % size
        content = np.ascontiguousarray(items.content).view(np.uint8)
        item_bytes = len(content) // max(1, len(np.asarray(items.content)))
        if items.width:
            as_bytes = Ragged.regular(content.reshape(len(items), -1))
        else:
            as_bytes = Ragged(content, items.offsets * item_bytes)
        self.writes.append((rows, position, as_bytes))
        self.ends[rows] = position + (as_bytes.width or as_bytes.lengths)
        return ENCAPSULATION + int(position[0]) if len(position) else 0


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
        value = Ragged(np.asarray(concatenate(lists)), row_offsets([len(row) for row in lists]))
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
