# SPDX-License-Identifier: Apache-2.0
"""One role's messages by field: conversions, times, validity; arrays as one row an element."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.columns import Column, Ragged
from abyssnav.profile import (
    UNITS,
    BeaconsRole,
    Condition,
    PositionRole,
    Role,
    SoundSpeedRole,
    TimeField,
    TravelTimeRole,
    conditions,
    quantities,
)
from abyssnav.tables import Bool, Finding, Float, Int

_LATEST_NS, _MOST = 1 << 62, 1 << 53
#: Roles whose messages may hold several rows that share the message's time.
_HOLD_ARRAYS = (BeaconsRole, SoundSpeedRole, TravelTimeRole, PositionRole)


class RoleFields:
    """One role's messages by field, with the conversions that its profile asks for.

    Where a field is an array, or lies in an array of messages, every element is a row, and fields
    that stand beside the array are repeated.
    """

    def __init__(self, role: Role, columns: Mapping[str, Column], log_time_ns: Int) -> None:
        self.role, self.columns, self.log_time_ns = role, columns, log_time_ns
        self.quantities = quantities(role)
        self.findings: list[Finding] = []  #: what was odd about the values
        self._lengths = self._elements()

    @property
    def holds_arrays(self) -> bool:
        """Whether a message has a row an element."""
        return self._lengths is not None

    @property
    def message(self) -> Int:
        """Which message each row is of."""
        every = np.arange(len(self.log_time_ns))
        return every if self._lengths is None else np.repeat(every, self._lengths)

    @property
    def _time(self) -> str:
        time = self.role.time
        return time.field if isinstance(time, TimeField) else time

    def _elements(self) -> Int | None:
        """Number of elements a message (n,); None where no field is an array.

        Raises
        ------
        ReadError
            Arrays of different lengths, arrays in arrays, or an array without times of its own in a
            role of which a message holds one value.
        """
        covariance = getattr(self.role, "covariance", None)
        arrays = {p: c for p, c in self.columns.items() if p != covariance and _is_array(c)}
        if not arrays:
            return None
        if not isinstance(self.role, _HOLD_ARRAYS) and self._time not in arrays:
            path = next(iter(arrays))
            raise ReadError(
                f"{path} of {self.role.where} is an array; {path}[k] is one of its items"
            )
        first, lengths = "", np.zeros(0, np.int64)
        for path, column in arrays.items():
            own = _lengths_of(column)
            if first and not np.array_equal(lengths, own):
                counts = f"{int(lengths.sum())} {first}, {int(own.sum())} {path}"
                raise ReadError(f"{self.role.where}: arrays differ in length: {counts}")
            first, lengths = first or path, own
        return lengths

    def values(self, name: str) -> Float:
        """Return a quantity in our unit, a row a message or element; NaN where unknown."""
        quantity = self.quantities[name]
        raw = self.items(quantity.field)
        if raw.dtype.kind not in "iufb":
            raise ReadError(f"{quantity.field} of {self.role.where} is no number")
        values: Float = raw.astype(np.float64, copy=quantity.sentinel is not None)
        if quantity.sentinel is not None:
            same = raw.dtype.type if raw.dtype.kind == "f" else float  # a float32 has its own -9.9
            values[values == same(quantity.sentinel)] = np.nan
        unit = UNITS[quantity.unit][1]
        if name in ("latitude", "longitude") and quantity.unit:
            unit /= UNITS["deg"][1]
        if quantity.scale * unit == 1 and quantity.offset == 0:
            return values
        ours: Float = (values * quantity.scale + quantity.offset) * unit
        return ours

    def items(self, field: str) -> NDArray[Any]:
        """Return a field, a row a message; where messages hold arrays, a row an element."""
        column = self.columns[field]
        if _is_array(column):
            flat = column.content if isinstance(column, Ragged) else column.reshape(-1)
            return np.asarray(flat)
        assert not isinstance(column, Ragged)
        return column if self._lengths is None else np.repeat(column, self._lengths)

    def triple(self, name: str) -> Float:
        """Return three quantities as (n, 3)."""
        return np.stack([self.values(f"{name}[{i}]") for i in range(3)], axis=-1)

    def integers(self, name: str) -> Int:
        """Return a number that counts or names, -1 where unknown; of text, the number in it."""
        field = self.quantities[name].field
        raw = self.items(field)
        if raw.dtype.kind == "T":
            return self._numbers_in(raw, field)
        if raw.dtype.kind == "f":
            known = np.isfinite(raw)
            if (np.rint(raw[known]) != raw[known]).any():
                raise ReadError(f"{field} of {self.role.where} is no whole number")
            raw = np.where(known & (np.abs(raw) < _MOST), raw, -1)
        whole: Int = raw.astype(np.int64)
        return whole

    def _numbers_in(self, texts: NDArray[Any], field: str) -> Int:
        """Return the one number in each text; different texts must have different ones."""
        names, rows = np.unique(texts, return_inverse=True)
        digits = [re.findall(r"\d{1,18}", name) for name in names.tolist()]
        numbers = [int(one[0]) if len(one) == 1 else -1 for one in digits]
        odd = next((k for k, n in enumerate(numbers) if n < 0 or n in numbers[:k]), None)
        if odd is not None and names[odd]:
            problem = "has not one number in it" if numbers[odd] < 0 else "is another's number too"
            raise ReadError(f"{field} of {self.role.where}: {names[odd]!r} {problem}")
        return np.array(numbers, np.int64)[rows]

    def texts(self, field: str | None) -> NDArray[np.str_]:
        """Return a field of text, empty where it is none or not given."""
        raw = self.items(field) if field else np.zeros(len(self.message))
        if raw.dtype.kind != "T":
            return np.full(len(raw), "", np.str_)
        return np.array([str(text) for text in raw.tolist()], np.str_)

    def time_ns(self) -> Int:
        """Return each row's time, latency taken off."""
        return self.stamps(self.role.time) - round(self.role.latency_s * 1e9)

    def has_own_times(self) -> bool:
        """Whether each element of the messages' arrays has a time of its own."""
        return self._time != "log_time" and _is_array(self.columns[self._time])

    def stamps(self, time: str | TimeField) -> Int:
        """Return a time field as integer nanoseconds a row, 0 where unknown."""
        if time == "log_time":
            return self.log_time_ns[self.message] if self.holds_arrays else self.log_time_ns
        field, unit = (time.field, time.unit) if isinstance(time, TimeField) else (time, "ns")
        raw, factor = self.items(field), round(UNITS[unit][1] * 1e9)
        if raw.dtype.kind not in "iuf":
            raise ReadError(f"{field} of {self.role.where} is no time")
        if raw.dtype.kind in "iu" and raw.max(initial=0) > _LATEST_NS // factor:
            factor = 1  # the encoding knows it as a time, which is in nanoseconds always
        known = (raw >= 0) & (raw <= _LATEST_NS // factor)  # one from before 1970 was never set
        if raw.dtype.kind != "f":
            return np.asarray(np.where(known, raw, 0).astype(np.int64) * factor)
        if not known.any() and len(raw):
            raise ReadError(
                f"{field} of {self.role.where} is unknown in every message; "
                'time = "log_time" in the profile takes the recorder\'s time'
            )
        whole = np.floor(np.where(known, raw, 0))  # of Unix seconds no nanosecond is lost twice
        part = np.rint((np.where(known, raw, 0) - whole) * factor)
        return np.asarray(whole.astype(np.int64) * factor + part.astype(np.int64))

    def valid(self) -> Bool:
        """Return for which rows the profile's conditions hold."""
        return self.holds(conditions(self.role.valid))

    def holds(self, all_of: tuple[Condition, ...]) -> Bool:
        """Return for which rows all conditions hold."""
        good = np.ones(len(self.message), bool)
        for condition in all_of:
            good &= self._holds(condition)
        return good

    def _holds(self, condition: Condition) -> Bool:
        values = self.items(condition.field)
        compared = (condition.equals, condition.differs_from, condition.at_least)
        is_text = values.dtype.kind == "T"
        if any(isinstance(with_, str) != is_text for with_ in compared if with_ is not None):
            kind = "text" if is_text else "no text"
            raise ReadError(f"{condition.field} of {self.role.where} is {kind}: see its condition")
        return holding(condition, values)

    def matrix(self, path: str) -> Float:
        """Return an array field as square matrices (n, k, k) of its first two rows and columns.

        Raises
        ------
        ReadError
            It is no array of 4, 9 or 36 numbers in every message.
        """
        column = self.columns[path]
        flat = np.asarray(column.content) if isinstance(column, Ragged) else column
        n = len(self.log_time_ns)
        side = round(np.sqrt(flat.size / max(n, 1)))
        alike = not isinstance(column, Ragged) or np.all(column.lengths == side * side)
        if flat.dtype.kind not in "iuf" or side not in (2, 3, 6) or not alike:
            raise ReadError(f"{path} of {self.role.where} is no matrix of 2 x 2, 3 x 3 or 6 x 6")
        block = flat.reshape(n, side, side)[:, :2, :2].astype(np.float64)
        return np.asarray(block[self.message])


def holding(condition: Condition, values: NDArray[Any]) -> Bool:
    """For which values (n,) of its field a condition holds."""
    good = np.ones(len(values), bool)
    if condition.equals is not None:
        good &= values == condition.equals
    if condition.differs_from is not None:
        good &= values != condition.differs_from
    if condition.at_least is not None:
        good &= values >= condition.at_least
    return good


def _is_array(column: Column) -> bool:
    return isinstance(column, Ragged) or column.ndim > 1


def _lengths_of(column: Column) -> Int:
    """Number of elements a message; ReadError where they are arrays themselves."""
    if isinstance(column, Ragged):
        if isinstance(column.content, Ragged) or column.content.ndim > 1:
            raise ReadError("an array lies in an array of messages: [k] picks one of its items")
        return column.lengths
    return np.full(len(column), column.size // max(1, len(column)))
