# SPDX-License-Identifier: Apache-2.0
"""Fields of a vehicle's messages to our columns: names, units, frames; nothing judged."""

import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.formats.ragged import Column, Ragged
from abyssnav.geometry import depth_of_pressure
from abyssnav.profile import (
    UNITS,
    BeaconsRole,
    Condition,
    DepthRole,
    HeadingRole,
    ReferenceRole,
    Role,
    SoundSpeedRole,
    TimeField,
    TravelTimeRole,
    VelocityRole,
    quantities,
)
from abyssnav.tables import Bool, Finding, Float, Int

#: Headings beyond two turns, and what share of them, are no radians.
_TURNS_RAD, _MANY = 4 * np.pi, 0.1
_LATEST_NS, _MOST = 1 << 62, 1 << 53
_SLICE = 1 << 14  #: rows whose attitude is computed at once, in the cache


def paths_of(role: Role) -> list[str]:
    """Fields that a role needs, each once."""
    paths = [quantity.field for quantity in quantities(role).values()]
    times = (role.time, getattr(role, "ping_time", "log_time"))
    paths += [time.field if isinstance(time, TimeField) else time for time in times]
    paths += [condition.field for condition in _conditions(role)]
    return list(dict.fromkeys(path for path in paths if path != "log_time"))


class Fields:
    """One role's messages by field, with the conversions that its profile asks for."""

    def __init__(self, role: Role, columns: Mapping[str, Column], log_time_ns: Int) -> None:
        self.role, self.columns, self.log_time_ns = role, columns, log_time_ns
        self.quantities = quantities(role)
        self.findings: list[Finding] = []  #: what was odd about the values

    def values(self, name: str) -> Float:
        """Return a quantity in our unit, a row a message or array item; NaN where unknown."""
        quantity = self.quantities[name]
        raw = self.items(quantity.field)
        if raw.dtype.kind not in "iufb":
            raise ReadError(f"{quantity.field} of {self.role.topic} is no number")
        values: Float = raw.astype(np.float64, copy=quantity.sentinel is not None)
        if quantity.sentinel is not None:
            same = raw.dtype.type if raw.dtype.kind == "f" else float  # a float32 has its own -9.9
            values[values == same(quantity.sentinel)] = np.nan
        unit = UNITS[quantity.unit][1]
        if quantity.scale * unit == 1 and quantity.offset == 0:
            return values
        ours: Float = (values * quantity.scale + quantity.offset) * unit
        return ours

    def items(self, field: str) -> NDArray[Any]:
        """Return a field, a row a message; of roles that hold arrays, a row an item."""
        column, role = self.columns[field], self.role
        if isinstance(role, BeaconsRole | SoundSpeedRole):
            return _flat(column)
        if isinstance(column, Ragged) or column.ndim > 1:
            raise ReadError(f"{field} of {role.topic} is an array; {field}[k] is one of its items")
        return column

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
                raise ReadError(f"{field} of {self.role.topic} is no whole number")
            raw = np.where(known & (np.abs(raw) < _MOST), raw, -1)
        whole: Int = raw.astype(np.int64)
        return whole

    def _numbers_in(self, texts: NDArray[Any], field: str) -> Int:
        """Return the one number in each text; different texts must have different ones."""
        names, rows = np.unique(texts, return_inverse=True)
        found = [re.findall(r"\d{1,18}", name) for name in names.tolist()]
        numbers = [int(of[0]) if len(of) == 1 else -1 for of in found]
        odd = next((k for k, n in enumerate(numbers) if n < 0 or n in numbers[:k]), None)
        if odd is not None and names[odd]:
            told = "has not one number in it" if numbers[odd] < 0 else "is another's number too"
            raise ReadError(f"{field} of {self.role.topic}: {names[odd]!r} {told}")
        return np.array(numbers, np.int64)[rows]

    def time_ns(self) -> Int:
        """Return the messages' own time, latency taken off."""
        stamp = self.stamps(self.role.time)
        return stamp - round(self.role.latency_s * 1e9)

    def stamps(self, time: str | TimeField) -> Int:
        """Return a time field as integer nanoseconds, 0 where unknown."""
        if time == "log_time":
            return self.log_time_ns
        field, unit = (time.field, time.unit) if isinstance(time, TimeField) else (time, "ns")
        raw, factor = np.asarray(self.columns[field]), round(UNITS[unit][1] * 1e9)
        if raw.dtype.kind not in "iuf" or raw.ndim > 1:
            raise ReadError(f"{field} of {self.role.topic} is no time")
        known = (raw >= 0) & (raw <= _LATEST_NS // factor)  # one from before 1970 was never set
        if raw.dtype.kind != "f":
            return np.asarray(np.where(known, raw, 0).astype(np.int64) * factor)
        if not known.any():
            raise ReadError(
                f"{field} of {self.role.topic} is unknown in every message; "
                'time = "log_time" in the profile takes the recorder\'s time'
            )
        whole = np.floor(np.where(known, raw, 0))  # of Unix seconds no nanosecond is lost twice
        part = np.rint((np.where(known, raw, 0) - whole) * factor)
        return np.asarray(whole.astype(np.int64) * factor + part.astype(np.int64))

    def valid(self) -> Bool:
        """Return for which messages the profile's conditions hold."""
        good = np.ones(len(self.log_time_ns), bool)
        for condition in _conditions(self.role):
            good &= self._holds(condition)
        return good

    def _holds(self, condition: Condition) -> Bool:
        values = self.items(condition.field)
        good = np.ones(len(values), bool)
        compared = (condition.equals, condition.differs_from, condition.at_least)
        is_text = values.dtype.kind == "T"
        if any(isinstance(with_, str) != is_text for with_ in compared if with_ is not None):
            kind = "text" if is_text else "no text"
            raise ReadError(f"{condition.field} of {self.role.topic} is {kind}: see its condition")
        if condition.equals is not None:
            good &= values == condition.equals
        if condition.differs_from is not None:
            good &= values != condition.differs_from
        if condition.at_least is not None:
            good &= values >= condition.at_least
        return good


def _conditions(role: Role) -> tuple[Condition, ...]:
    if isinstance(role.valid, str):
        return (Condition(role.valid, differs_from=0),)
    return (role.valid,) if isinstance(role.valid, Condition) else role.valid


def _flat(column: Column) -> NDArray[Any]:
    """Return array items one a row."""
    return np.asarray(column.content) if isinstance(column, Ragged) else column.reshape(-1)


def _message_of(column: Column, n: int) -> Int:
    """Return which message each array item belongs to."""
    if isinstance(column, Ragged):
        return np.repeat(np.arange(n), column.lengths)
    return np.repeat(np.arange(n), column.size // max(1, n))


def role_columns(role: Role, fields: Fields) -> dict[str, NDArray[Any]]:
    """Columns of a role as `abyssnav.tables.Log` documents them, without the time."""
    columns: dict[type[Role], Callable[[Any, Fields], dict[str, NDArray[Any]]]] = {
        HeadingRole: _heading,
        VelocityRole: _velocity,
        DepthRole: _depth,
        TravelTimeRole: _travel_time,
        BeaconsRole: _beacons,
        SoundSpeedRole: _sound_speed,
        ReferenceRole: _reference,
    }
    with np.errstate(over="ignore", invalid="ignore"):  # wild values are judged later
        return columns[type(role)](role, fields)


def _velocity(role: VelocityRole, fields: Fields) -> dict[str, NDArray[Any]]:
    velocity = fields.triple("velocity")
    if role.frame == "flu":
        velocity[:, 1:] *= -1.0
    forward, starboard, down = np.isfinite(velocity).T
    valid = fields.valid() & forward & starboard & down
    columns = {"velocity_body_mps": velocity, "valid": valid}
    if role.altitude is None:
        return columns
    altitude_m = fields.values("altitude")
    return columns | {"altitude_m": np.where(fields.valid() & (altitude_m > 0), altitude_m, np.nan)}


def _travel_time(role: TravelTimeRole, fields: Fields) -> dict[str, NDArray[Any]]:
    travel_time_s = fields.values("travel_time")
    ping_time_ns = fields.stamps(role.ping_time)
    numbered = np.unique(ping_time_ns, return_inverse=True)[1].astype(np.int64)
    unknown = np.full(len(travel_time_s), np.nan)
    return {
        "ping_time_ns": ping_time_ns,
        "ping_id": fields.integers("ping_id") if role.ping_id else numbered,
        "beacon_id": fields.integers("beacon_id"),
        "travel_time_s": travel_time_s,
        "snr_db": fields.values("snr") if role.snr else unknown,
    }


def _sound_speed(role: SoundSpeedRole, fields: Fields) -> dict[str, NDArray[Any]]:
    depths = fields.columns[fields.quantities["depth"].field]
    message, speed = _message_of(depths, len(fields.log_time_ns)), fields.values("sound_speed")
    if len(speed) != len(message):
        raise ReadError(f"{role.topic}: {len(message)} depths, {len(speed)} sound speeds")
    return {"message": message, "depth_m": fields.values("depth"), "sound_speed_mps": speed}


def _reference(role: ReferenceRole, fields: Fields) -> dict[str, NDArray[Any]]:
    position = fields.triple("position")
    if role.frame == "ned":
        position = position[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])
    return {"position_enu_m": position}


def _heading(role: HeadingRole, fields: Fields) -> dict[str, NDArray[Any]]:
    """Roll, pitch and heading, in radians, heading clockwise from true north in [0, 2π)."""
    if role.orientation_xyzw is not None:
        x, y, z, w = (fields.values(f"orientation_xyzw[{i}]") for i in range(4))
        roll, pitch, heading = angles = np.empty((3, len(x)))

        def turn(begin: int) -> None:
            rows = slice(begin, begin + _SLICE)
            angles[:, rows] = euler_of(x[rows], y[rows], z[rows], w[rows], role.frame)

        with ThreadPoolExecutor(max_workers=2) as pool:  # half of it is spent on arctangents
            list(pool.map(turn, range(0, len(x), _SLICE)))
    else:
        heading = fields.values("heading")
        if np.mean(np.abs(heading) > _TURNS_RAD) > _MANY:
            field, most = fields.quantities["heading"].field, float(np.nanmax(np.abs(heading)))
            detail = f'{field} reaches {most:,.0f} rad: does the profile lack unit = "deg"?'
            fields.findings.append(Finding("odd heading", role.topic, detail))
        heading = np.mod(heading, 2 * np.pi)
        roll = fields.values("roll") if role.roll else np.zeros_like(heading)
        pitch = fields.values("pitch") if role.pitch else np.zeros_like(heading)
    heading = np.where(fields.valid(), heading, np.nan)
    return {"roll_rad": roll, "pitch_rad": pitch, "heading_rad": heading}


def euler_of(x: Float, y: Float, z: Float, w: Float, frame: str) -> tuple[Float, Float, Float]:
    """Roll, pitch and heading of a body (forward, starboard, down) against north, east, down.

    With R = Rz(yaw) Ry(p) Rx(r) of the quaternion: in `ned_frd` they are ours.  In `enu_flu` both
    frames differ by a half turn about an axis, so that roll = r, pitch = -p, heading = π/2 - yaw.
    An all-zero quaternion is no orientation: NaN.  The length of the others does not matter.

    Parameters
    ----------
    x, y, z, w : (n,), body to local
    """
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    square = xx + yy + zz + ww
    square[square == 0] = np.nan
    roll = np.arctan2(2 * (w * x + y * z), ww - xx - yy + zz)
    pitch = np.arcsin(np.clip(2 * (w * y - z * x) / square, -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), ww + xx - yy - zz)
    yaw[np.isnan(square)] = np.nan
    if frame == "enu_flu":
        pitch, yaw = -pitch, np.pi / 2 - yaw
    yaw[yaw < 0] += 2 * np.pi
    return roll, pitch, yaw


def _depth(role: DepthRole, fields: Fields) -> dict[str, NDArray[Any]]:
    """Depth in metres, or pressure above the air's where no latitude is given."""
    values = np.where(fields.valid(), fields.values("depth"), np.nan)
    if UNITS[fields.quantities["depth"].unit][0] != "pressure":
        return {"depth_m": values}
    pressure_dbar = (values - role.atmosphere_pa) / 1e4
    if role.latitude_deg is None:
        return {"pressure_dbar": pressure_dbar}
    return {"depth_m": depth_of_pressure(pressure_dbar, role.latitude_deg)}


def _beacons(role: BeaconsRole, fields: Fields) -> dict[str, NDArray[Any]]:
    n = len(fields.log_time_ns)
    message = _message_of(fields.columns[role.id], n)
    ids = fields.integers("id")
    texts = _flat(fields.columns[role.name or role.id]).tolist()
    origin = {
        f"{axis}_deg": _per_message(fields, path)[message] if path else np.full(len(ids), np.nan)
        for axis, path in (
            ("origin_latitude", role.origin_latitude),
            ("origin_longitude", role.origin_longitude),
        )
    }
    sigma = fields.values("position_sigma") if role.position_sigma else np.zeros(len(ids))
    columns = {
        "message": message,
        "id": ids,
        "name": np.array([str(text) for text in texts], np.str_),
        "position_enu_m": fields.triple("position"),
        "turn_around_s": fields.values("turn_around"),
        "sigma_m": sigma,
        **origin,
    }
    for name, column in columns.items():
        if len(column) != len(ids):
            raise ReadError(f"{role.topic}: {len(ids)} beacons, but {len(column)} of {name}")
    return columns


def _per_message(fields: Fields, path: str) -> Float:
    """Return a number that stands beside an array."""
    column = fields.columns[path]
    if isinstance(column, Ragged) or column.ndim > 1 or column.dtype.kind not in "iuf":
        raise ReadError(f"{path} of {fields.role.topic} is no number")
    return column.astype(np.float64)
