# SPDX-License-Identifier: Apache-2.0
"""Which role a topic may play, by the names and values in one of its messages."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, Final, Literal, TypeVar

import msgspec

from abyssnav.errors import ReadError
from abyssnav.formats.decoding import decode_payloads, definition_of
from abyssnav.formats.definitions import TIMES, leaves
from abyssnav.formats.mcap.layout import Channel
from abyssnav.formats.ragged import Ragged
from abyssnav.profile import (
    DepthRole,
    HeadingRole,
    Quantity,
    ReferenceRole,
    Role,
    TimeField,
    TravelTimeRole,
    Value,
    VelocityRole,
)

Frame = TypeVar("Frame", bound=str)

_UNITS_OF_TIME = ("s", "ms", "us", "ns")
_TIME = r"(^|[._])(t|time|stamp|timestamp|ts|utc)(_?(s|sec|ms|us|ns))?$"
_ANGLE = r"(heading|yaw|hdg|azimuth)(_?(deg|rad))?$"
_DEPTH = r"(^|[._])depth(_?(m|cm|mm|ft))?$"
_PRESSURE = r"(^|[._]|pressure_?|press_?)(pressure|press|k?pa|hpa|[dm]?bar|psi)$"
_PRESSURE_UNITS = ("kPa", "hPa", "dbar", "mbar", "bar", "psi", "Pa")
#: Names of three components, and the frame that they speak for.
_BODY: Final[Mapping[tuple[str, str, str], Literal["flu", "frd"]]] = {
    ("x", "y", "z"): "flu", ("vx", "vy", "vz"): "flu", ("u", "v", "w"): "frd",
    ("surge", "sway", "heave"): "frd", ("forward", "starboard", "down"): "frd",
    ("[0]", "[1]", "[2]"): "flu",
}  # fmt: skip
_LOCAL: Final[Mapping[tuple[str, str, str], Literal["enu", "ned"]]] = {
    ("x", "y", "z"): "enu", ("[0]", "[1]", "[2]"): "enu", ("east", "north", "up"): "enu",
    ("e", "n", "u"): "enu", ("north", "east", "down"): "ned", ("n", "e", "d"): "ned",
}  # fmt: skip
_SPEED = r"vel|linear|speed|twist|(^|[._])(vx|surge|forward)(_|$)"
#: How names end that tell a speed's or a length's unit.
_SUFFIXES = {
    "": "", "_mms": "mm/s", "_mmps": "mm/s", "_cms": "cm/s", "_cmps": "cm/s", "_mps": "", "_ms": "",
    "_m": "", "_cm": "cm", "_mm": "mm",
}  # fmt: skip
_TRAVEL = r"twt|tof|travel|flight|two_?way|round_?trip"
_BEACON = r"beacon|transponder|addr|target|remote|responder|source|src"
_SENT = r"ping|tx|sent|asked|emit|transmit|interrog"
_HEARD = r"rx|heard|recei|reply|arriv"
_COUNTED = r"ping|seq|cycle|interrog|count"
_MOST_FIELDS = 256
_LONGEST_ARRAY = 4  #: whose items are looked at one by one
_EARLIEST_S, _LATEST_S = 6e8, 1e10  #: what may be seconds since 1970


class Stamp(int):
    """A time that the encoding knows as one, in nanoseconds."""


@dataclass(frozen=True)
class Example:
    """A channel with one of its messages."""

    channel: Channel
    payload: bytes

    @cached_property
    def values(self) -> Mapping[str, Any]:
        """Return its numbers, times and texts by dotted path; none if it cannot be read."""
        try:
            if self.channel.message_encoding == "json":
                found = dict(_json_leaves("", msgspec.json.decode(self.payload)))
            else:
                found = dict(self._decoded())
        except (ReadError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return {}
        return _with_stamps(found)

    def _decoded(self) -> Iterator[tuple[str, Any]]:
        kinds = dict(islice(leaves(definition_of(self.channel)), _MOST_FIELDS))
        one = Ragged.of_bytes([self.payload])
        columns, kept = decode_payloads(self.channel, one, list(kinds))
        for path, column in columns.items() if kept.all() else ():
            inner = column.content if isinstance(column, Ragged) else column
            if isinstance(inner, Ragged) or ("." in path and isinstance(column, Ragged)):
                yield path, []  # in an array of messages
                continue
            items = inner.ravel().tolist()
            if kinds[path] in TIMES and len(items) == 1:
                yield path, Stamp(items[0])
            else:
                array = isinstance(column, Ragged) or column.ndim > 1
                yield from _items(path, items, array)

    def numbers(self) -> list[str]:
        """Return the paths of its numbers."""
        return [p for p, v in self.values.items() if isinstance(v, int | float)]

    def has(self, paths: Sequence[str]) -> bool:
        """Whether it holds all of these fields, and items of their arrays."""
        there, asked = (
            {re.sub(r"\[\d+\]", "", path) for path in of} for of in (self.values, paths)
        )
        return asked <= there

    def when(self, paths: Sequence[str]) -> str | TimeField | None:
        """Return the first that can be a time since 1970, with its unit."""
        for path in paths:
            value = self.values[path]
            if isinstance(value, Stamp):
                return path
            number = int(value) if str(value).isdecimal() else value
            for k, unit in enumerate(_UNITS_OF_TIME if isinstance(number, int | float) else ()):
                if _EARLIEST_S <= number / 10 ** (3 * k) < _LATEST_S:
                    return TimeField(path, unit)
        return None

    def named(self, pattern: str) -> list[str]:
        """Return the paths that a pattern is found in, with letters of any case."""
        return [path for path in self.values if re.search(pattern, path, re.IGNORECASE)]

    def triple(
        self, names: Mapping[tuple[str, str, str], Frame], within: str
    ) -> tuple[tuple[Value, Value, Value], Frame] | None:
        """Return three components below a path in which `within` is found, and their frame."""
        numbers = set(self.numbers())
        for (first, *others), frame in names.items():
            for suffix, unit in _SUFFIXES.items():
                for path in self.named(rf"(^|[._]|(?=\[)){re.escape(first + suffix)}$"):
                    before = path[: len(path) - len(first + suffix)]
                    three = [path, *(before + name + suffix for name in others)]
                    if numbers.issuperset(three) and re.search(within, path, re.IGNORECASE):
                        x, y, z = (Quantity(name, unit) if unit else name for name in three)
                        return (x, y, z), frame
        return None


def _items(path: str, items: list[Any], array: bool) -> Iterator[tuple[str, Any]]:
    if not array:
        yield path, items[0]
    elif len(items) <= _LONGEST_ARRAY:
        yield from ((f"{path}[{k}]", item) for k, item in enumerate(items))
    else:
        yield path, []


def _json_leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _json_leaves(f"{path}.{name}" if path else name, inner)
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        inner = (name for item in value[:1] for name, _ in _json_leaves(path, item))
        yield from ((name.partition("[")[0], []) for name in inner)
    elif isinstance(value, list):
        yield from _items(path, value, True)
    elif path:
        yield path, value


def _with_stamps(values: dict[str, Any]) -> dict[str, Any]:
    """The same, seconds and nanoseconds of one time put together."""
    for whole, rest in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos")):
        for path in [path for path in values if path.endswith(f".{rest}")]:
            before = path.removesuffix(f".{rest}")
            if f"{before}.{whole}" in values:
                del values[path], values[f"{before}.{whole}"]
                values[before] = Stamp(0)
    return values


def by_fields(role: str, example: Example, hinted: bool) -> Role | None:
    """Role from the names in a message; `hinted`: the topic's name speaks for it."""
    guess = {
        "heading": _heading,
        "velocity": _velocity,
        "depth": _depth,
        "travel_time": _travel_time,
        "reference": _reference,
    }.get(role)
    return guess(example, hinted) if guess else None


def _head(example: Example) -> dict[str, Any]:
    time = example.when(example.named(r"stamp$") + example.named(_TIME)) or "log_time"
    return {"topic": example.channel.topic, "type": example.channel.type, "time": time}


def _heading(example: Example, _: bool) -> Role | None:
    head, turn = _head(example), next(iter(example.named(r"orientation\.x$")), "")
    if turn:
        x, y, z, w = (turn[:-1] + axis for axis in "xyzw")
        return HeadingRole(**head, orientation_xyzw=(x, y, z, w))
    angle = next((path for path in example.named(_ANGLE) if path in example.numbers()), "")
    if not angle:
        return None
    unit = "rad" if angle.lower().endswith("rad") else "deg"
    roll, pitch = (
        Quantity(path, unit) if path in example.values else None
        for path in (re.sub(_ANGLE, rf"{name}\2", angle, flags=re.I) for name in ("roll", "pitch"))
    )
    return HeadingRole(**head, heading=Quantity(angle, unit), roll=roll, pitch=pitch)


def _velocity(example: Example, hinted: bool) -> Role | None:
    found = example.triple(_BODY, "" if hinted else _SPEED)
    return found and VelocityRole(**_head(example), velocity=found[0], frame=found[1])


def _depth(example: Example, hinted: bool) -> Role | None:
    depths, pressures = (
        [path for path in example.named(pattern) if path in example.numbers()]
        for pattern in (_DEPTH, _PRESSURE)
    )
    if depths:
        unit = re.search(r"_(cm|mm|ft)$", depths[0])
        depth = Quantity(depths[0], unit[1]) if unit else depths[0]
        return DepthRole(**_head(example), depth=depth)
    if not pressures or not hinted:
        return None
    units = (unit for unit in _PRESSURE_UNITS if pressures[0].lower().endswith(unit.lower()))
    return DepthRole(**_head(example), depth=Quantity(pressures[0], next(units, "Pa")))


def _travel_time(example: Example, _: bool) -> Role | None:
    """A reply needs three: how long it took, whose it is, and when it was asked for."""
    travels = [path for path in example.named(_TRAVEL) if path in example.numbers()]
    beacons = [path for path in example.named(_BEACON) if path not in travels]
    sent = example.when([path for path in example.named(_SENT) if path not in travels])
    if not (travels and beacons and sent):
        return None
    taken = {*travels, *beacons, sent.field if isinstance(sent, TimeField) else sent}
    counts = [path for path in example.named(_COUNTED) if path not in taken]
    counts = [path for path in counts if isinstance(example.values[path], int)]
    counts = [path for path in counts if not example.when([path])]
    suffix = re.search(r"_?(us|ms|ns)$", travels[0], re.IGNORECASE)
    travel = Quantity(travels[0], suffix[1].lower()) if suffix else travels[0]
    head = _head(example)
    heard = example.when([path for path in example.named(_HEARD) if path not in taken])
    return TravelTimeRole(
        **head | {"time": heard or head["time"]},
        ping_time=sent,
        ping_id=counts[0] if counts else "",
        beacon_id=beacons[0],
        travel_time=travel,
    )


def _reference(example: Example, hinted: bool) -> Role | None:
    found = example.triple(_LOCAL, "") if hinted else None
    return found and ReferenceRole(**_head(example), position=found[0], frame=found[1])
