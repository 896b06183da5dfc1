# SPDX-License-Identifier: Apache-2.0
"""What every guess needs: the time of a topic, units by names, sentinels, validity."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import msgspec
import numpy as np

from abyssnav.errors import ReadError
from abyssnav.formats.decoding import decode_payloads
from abyssnav.profile import Condition, Quantity, Role, Value, paths_of
from abyssnav.read.fields import RoleFields
from abyssnav.read.roles import role_columns
from abyssnav.read.samples import TopicSample
from abyssnav.tables import Columns, Float

Frame = TypeVar("Frame", bound=str)
_TIME = r"(^|[._])(t|time|stamp|timestamp|ts|utc|unix|epoch)(_?(s|sec|ms|us|ns|usec|msec|nsec))?$"
#: How names end that say a unit, by what is measured; what follows is our name for it.
_SUFFIXES: Final[Mapping[str, tuple[tuple[str, str], ...]]] = {
    "speed": (
        (r"mm_?p?_?s(ec)?", "mm/s"), (r"cm_?p?_?s(ec)?", "cm/s"), (r"km_?p?_?h", "km/h"),
        (r"(knots?|kts?|kn)", "kn"), (r"m_?p?_?s(ec)?", ""),
    ),
    "length": ((r"mm", "mm"), (r"cm", "cm"), (r"km", "km"), (r"ft", "ft"), (r"m", "")),
    "time": ((r"m(illi)?s(ec)?s?", "ms"), (r"u(s|sec)", "us"), (r"n(s|sec)", "ns"),
             (r"s(ec|econds)?", "")),
    "angle": ((r"deg(rees)?", "deg"), (r"rad(ians)?", "rad")),
    "pressure": tuple((unit.lower(), unit) for unit in
                      ("kPa", "hPa", "dbar", "mbar", "bar", "psi", "Pa")),
}  # fmt: skip
#: Numbers that drivers write for "no value".
_SENTINELS = (-32768.0, -32.768, -3276.8, 32767.0, -999.0, -9999.0, -99.0, -99999.0)


@dataclass(frozen=True)
class Guess:
    """A role that a topic may play, on what that rests, and how likely it is."""

    spec: Role
    why: tuple[str, ...]
    score: float


def head_of(sample: TopicSample) -> dict[str, Any]:
    """Topic, type and time of a role; the log's own time where the messages have none."""
    time = sample.when(sample.named(r"stamp$") + sample.named(_TIME)) or "log_time"
    return {"topic": sample.topic, "type": sample.channel.type, "time": time}


def unit_of_name(path: str, measure: str) -> str | None:
    """The unit that a field's name ends with, or its parents' do; None where none says one."""
    for part in reversed(re.sub(r"\[\d+\]", "", path).split(".")):
        for suffix, unit in _SUFFIXES[measure]:
            if re.search(rf"(_|(?<=[a-z])(?=[A-Z])){suffix}$", part, re.IGNORECASE):
                return unit
            if measure == "pressure" and part.lower().endswith(suffix):
                return unit
    return None


def sentinel_in(values: Float) -> float | None:
    """The number that stands for no value: one of those in use, far from all others."""
    for sentinel in _SENTINELS:
        same = np.isclose(values, sentinel, rtol=1e-6, atol=0)
        if same.any() and not same.all():
            return float(values[same][0])
    return None


def quantity(path: str, unit: str = "", **more: Any) -> Value:
    """A field with its conversion, or its path alone where there is none."""
    whole = Quantity(path, unit, **{name: v for name, v in more.items() if v is not None})
    return path if whole == Quantity(path) else whole


def triple(
    sample: TopicSample, names: Mapping[tuple[str, str, str], Frame], within: str, without: str
) -> Iterator[tuple[tuple[str, str, str], Frame]]:
    """Three numbers below one path in which `within` is conditions, and their frame."""
    numbers = set(sample.numbers())
    for (first, *others), frame in names.items():
        for path in sample.named(rf"(^|[._]|(?=\[)){re.escape(first)}(_[a-z]+)*$"):
            place = [m.start() for m in re.finditer(re.escape(first), path, re.IGNORECASE)]
            for offset in reversed(place):
                before, after = path[:offset], path[offset + len(first) :]
                three = (path, *(before + name + after for name in others))
                if (
                    numbers.issuperset(three)
                    and re.search(within, path, re.IGNORECASE)
                    and not re.search(without, path, re.IGNORECASE)
                ):
                    yield (three[0], three[1], three[2]), frame
                    break


def validity(sample: TopicSample, prefix: str) -> tuple[Condition, ...]:
    """Conditions that the fields beside a value suggest: beams, flags, status letters, covariance.

    Parameters
    ----------
    prefix : how the value's field begins; a status letter must share it
    """
    conditions = [*_flags(sample), *_beams(sample), *_status(sample, prefix), *_covariance(sample)]
    return tuple(condition for condition in conditions if sample.holds(condition).any())


def _flags(sample: TopicSample) -> Iterator[Condition]:
    pattern = r"(^|[._])((vel\w*|bottom\w*|track\w*)_?)?(valid|lock(ed)?|locked|ok)$"
    for path in sample.named(pattern):
        field = sample.fields[path]
        if field.values.dtype.kind == "b" or (field.is_number and set(field.numbers) <= {0, 1}):
            yield Condition(path, differs_from=0)


def _beams(sample: TopicSample) -> Iterator[Condition]:
    path = sample.first_number(r"good_?beams|beams_?(good|valid)|(n|num)_?beams")
    if path and sample.fields[path].numbers.max(initial=0) >= 3:
        yield Condition(path, at_least=3)


def _status(sample: TopicSample, prefix: str) -> Iterator[Condition]:
    for path in sample.named(r"status$"):
        values = sample.fields[path].values
        letters = set(values.tolist()) if values.dtype.kind == "T" else set()
        if path.startswith(prefix) and "A" in letters and letters <= {"A", "V", "N", ""}:
            yield Condition(path, equals="A")


def _covariance(sample: TopicSample) -> Iterator[Condition]:
    for path in sample.named(r"covar\w*\[0\]$"):
        if np.any(sample.fields[path].values == -1):
            yield Condition(path, differs_from=-1.0)


def conditions_as_valid(conditions: Sequence[Condition]) -> Any:
    """Conditions in the shortest form that a profile knows."""
    if len(conditions) == 1:
        plain = conditions[0] == Condition(conditions[0].field, differs_from=0)
        return conditions[0].field if plain else conditions[0]
    return tuple(conditions)


#: Columns that show whether a role has a value in any of the messages looked at.
_VALUES = {
    "heading": ("heading_rad",), "depth": ("depth_m", "pressure_dbar"), "altitude": ("altitude_m",),
    "travel_time": ("travel_time_s",), "sound_speed": ("sound_speed_mps",),
}  # fmt: skip


def columns_of(spec: Role, sample: TopicSample) -> Columns | None:
    """A role's columns of the messages looked at; None where it cannot be read."""
    try:
        decoded, kept = decode_payloads(sample.channel, sample.payloads, paths_of(spec))
        return role_columns(spec, RoleFields(spec, decoded, sample.log_time_ns[kept]))
    except (ReadError, ValueError, IndexError, msgspec.DecodeError, UnicodeDecodeError):
        return None


def has_values(role: str, spec: Role, sample: TopicSample) -> bool:
    """Whether a role has a value in any of the messages looked at: no dead topic is proposed."""
    columns = columns_of(spec, sample)
    if columns is None or not len(columns["time_ns"]):
        return False
    if role == "velocity":
        return bool(columns["valid"].any())
    names = [name for name in _VALUES.get(role, ()) if name in columns]
    if role == "heading" and _is_unset(columns):
        return False
    return all(bool(np.isfinite(columns[name]).any()) for name in names)


def _is_unset(columns: Columns) -> bool:
    """Whether an attitude is no rotation in every message: what drivers leave in place."""
    if len(columns["time_ns"]) < 10:
        return False
    level = not np.any(columns["roll_rad"]) and not np.any(columns["pitch_rad"])
    return level and bool(np.ptp(columns["heading_rad"]) == 0)
