# SPDX-License-Identifier: Apache-2.0
"""Messages that differ in numbers alone: the bytes they share, and where the numbers go.

A day of one topic is one payload and its columns; the bytes are made when they are written, a
chunk at a time, in memory that the processor still holds.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from abyssnav.formats.columns import Ragged, overlapping_windows, row_offsets
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

    def rows(self, rows: Any) -> NDArray[np.uint8]:
        """Return the bytes of some of the topic's messages, one row each."""
        whole = np.empty((len(rows), len(self.payload)), np.uint8)
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
        chosen = isinstance(rows, np.ndarray) and rows.dtype != np.bool_
        wanted = rows if chosen else np.arange(len(self))[rows]
        if len(self.templates) == 1:
            return Ragged.regular(self.templates[0].rows(wanted))
        offsets = row_offsets(self.lengths[wanted])
        content = np.zeros(offsets[-1], np.uint8)
        for number in np.unique(self.template[wanted]).tolist():
            matches, template = (
                np.flatnonzero(self.template[wanted] == number),
                self.templates[number],
            )
            width = len(template.payload)
            blocks = template.rows(wanted[matches]).view(f"V{width}")[:, 0]
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
