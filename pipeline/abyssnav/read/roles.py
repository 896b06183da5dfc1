# SPDX-License-Identifier: Apache-2.0
"""Fields of a vehicle's messages to our columns: names, units, frames; nothing judged."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abyssnav.errors import ReadError
from abyssnav.geometry import body_to_body, depth_of_pressure
from abyssnav.profile import (
    UNITS,
    AltitudeRole,
    BeaconsRole,
    DepthRole,
    HeadingRole,
    PositionRole,
    Quantity,
    ReferenceRole,
    Role,
    SoundSpeedRole,
    TravelTimeRole,
    VelocityRole,
    conditions,
    slots,
)
from abyssnav.read.fields import RoleFields
from abyssnav.tables import Finding, Float

#: Headings beyond two turns, and what share of them, are no radians.
_TURNS_RAD, _MANY = 4 * np.pi, 0.1
_SLICE = 1 << 14  #: rows whose attitude is computed at once, in the cache
#: Standard deviation of a position fix of which nothing is stated.
_POSITION_SIGMA_M = 5.0
Columns = dict[str, NDArray[Any]]


def role_columns(role: Role, fields: RoleFields) -> Columns:
    """Columns of a role as `abyssnav.tables.Log` documents them, the rows' times among them.

    Raises
    ------
    ReadError
        A field of another kind than its role needs.
    """
    convert: dict[type[Role], Callable[[Any, RoleFields], Columns]] = {
        HeadingRole: _heading,
        VelocityRole: _velocity,
        DepthRole: _depth,
        TravelTimeRole: _travel_time,
        BeaconsRole: _beacons,
        SoundSpeedRole: _sound_speed,
        PositionRole: _position,
        AltitudeRole: _altitude,
        ReferenceRole: _reference,
    }
    with np.errstate(over="ignore", invalid="ignore"):  # wild values are judged later
        columns = convert[type(role)](role, fields)
    return columns if "time_ns" in columns else {**columns, "time_ns": fields.time_ns()}


def _velocity(role: VelocityRole, fields: RoleFields) -> Columns:
    velocity, columns = fields.triple("velocity"), Columns()
    if role.per is not None:
        interval_s = fields.values("per")
        interval_s = np.where(interval_s > 0, interval_s, np.nan)
        velocity /= interval_s[:, None]
        half_ns = np.rint(np.nan_to_num(interval_s) * 5e8).astype(np.int64)
        columns["time_ns"] = fields.time_ns() - half_ns  # the mean is that of the middle
    frame = "velocity_enu_mps" if role.frame in ("enu", "ned") else "velocity_body_mps"
    if role.frame == "flu":
        velocity[:, 1:] *= -1.0
    elif role.frame == "ned":
        velocity = velocity[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])
    if any(role.mount_rpy_deg):
        velocity = body_to_body(velocity, *np.radians(role.mount_rpy_deg))
    first, second, third = np.isfinite(velocity).T
    columns |= {frame: velocity, "valid": fields.valid() & first & second & third}
    if role.bottom_track != ():
        columns["water_track"] = ~fields.holds(conditions(role.bottom_track)) & columns["valid"]
        columns["valid"] = columns["valid"] & ~columns["water_track"]
    if any(role.offset_m):
        columns["offset_m"] = np.broadcast_to(np.array(role.offset_m), velocity.shape)
    if role.altitude is not None:
        columns["altitude_m"] = _height(fields)
    return columns


def _height(fields: RoleFields) -> Float:
    """Altitude above the floor (n,), NaN where it is not valid."""
    altitude_m = fields.values("altitude")
    return np.where(fields.valid() & (altitude_m > 0), altitude_m, np.nan)


def _altitude(_: AltitudeRole, fields: RoleFields) -> Columns:
    return {"altitude_m": _height(fields)}


def _travel_time(role: TravelTimeRole, fields: RoleFields) -> Columns:
    """Replies, what is missing for two-way times and stamps left to the stage align.

    `without_turn_around` marks times to which the turn-around is to be added; `derived` says which
    stamp follows from the other and the time.
    """
    n_slots = slots(role)
    measured = "range" if role.range is not None else "travel_time"
    if n_slots:
        each_s = np.stack([fields.values(f"{measured}[{k}]") for k in range(n_slots)], axis=1)
        travel_time_s, row = each_s.ravel(), np.repeat(np.arange(len(each_s)), n_slots)
        beacon_id = np.tile(np.array(role.beacon_id, np.int64), len(each_s))
    else:
        travel_time_s = fields.values(measured)
        row, beacon_id = np.arange(len(travel_time_s)), fields.integers("beacon_id")
    if role.range is not None:
        speed = role.range_sound_speed
        known = isinstance(speed, float | int)
        speed_mps = float(speed) if known else fields.values("range_sound_speed")[row]  # type: ignore[arg-type]
        travel_time_s = 2 * travel_time_s / np.where(np.asarray(speed_mps) > 0, speed_mps, np.nan)
    elif role.one_way:
        travel_time_s = 2 * travel_time_s
    columns: Columns = {
        **_ping_columns(role, fields),
        "snr_db": fields.values("snr") if role.snr else np.full(len(fields.message), np.nan),
    }
    if role.turn_around_field is not None:
        columns["turn_around_s"] = fields.values("turn_around_field")
    columns = {name: column[row] for name, column in columns.items()}
    columns |= {"beacon_id": beacon_id, "travel_time_s": travel_time_s}
    if role.range is not None or role.one_way or role.turn_around == "removed":
        columns["without_turn_around"] = np.ones(len(row), bool)
    return _replies(role, fields, columns, row)


#: Which stamp of a reply follows from the other one and its two-way time.
PING_DERIVED, REPLY_DERIVED = 1, 2


def _ping_columns(role: TravelTimeRole, fields: RoleFields) -> Columns:
    """Times and numbers of the pings, a row a message or element."""
    several = bool(slots(role)) or (fields.holds_arrays and not fields.has_own_times())
    time_ns = fields.time_ns()
    if role.ping_time == "" and several:
        raise ReadError(f"{role.where}: several replies a message need ping_time")
    ping_time_ns = fields.stamps(role.ping_time) if role.ping_time else time_ns
    columns: Columns = {
        "ping_time_ns": ping_time_ns,
        "time_ns": ping_time_ns if several else time_ns,
        "ping_id": fields.integers("ping_id")
        if role.ping_id
        else np.unique(ping_time_ns, return_inverse=True)[1].astype(np.int64),
    }
    if several or not role.ping_time:
        which = REPLY_DERIVED if several else PING_DERIVED
        columns["derived"] = np.full(len(time_ns), which, np.int8)
        columns["counted"] = np.full(len(time_ns), bool(role.ping_id))
    return columns


def _replies(
    role: TravelTimeRole, fields: RoleFields, columns: Columns, row: NDArray[np.int64]
) -> Columns:
    """Leave out slots without a reply, and replies that the profile's `valid` refuses, aloud."""
    valid = fields.valid()[row]
    if not valid.all():
        detail = f"{int((~valid).sum())} of {len(valid)} replies are not valid: left out"
        fields.findings.append(Finding("replies not valid", role.where, detail))
    sentinels = [q.sentinel for n, q in fields.quantities.items() if n.startswith(("tr", "range"))]
    if slots(role) or (fields.holds_arrays and any(s is not None for s in sentinels)):
        valid &= np.isfinite(columns["travel_time_s"])
    return columns if valid.all() else {name: c[valid] for name, c in columns.items()}


def _sound_speed(role: SoundSpeedRole, fields: RoleFields) -> Columns:
    speed_mps = fields.values("sound_speed")
    if role.kind == "mean":
        return {"sound_speed_mps": np.where(fields.valid(), speed_mps, np.nan)}
    if role.kind == "samples":
        depth_m = fields.values("depth") if role.depth else np.full(len(speed_mps), np.nan)
        return {
            "depth_m": depth_m,
            "sound_speed_mps": np.where(fields.valid(), speed_mps, np.nan),
        }
    if not fields.holds_arrays and len(speed_mps):
        field = fields.quantities["sound_speed"].field
        raise ReadError(
            f'{field} of {role.where} is one number a message, no profile: kind = "samples" makes '
            'a profile of them, kind = "mean" takes their mean'
        )
    return {
        "message": fields.message,
        "depth_m": fields.values("depth"),
        "sound_speed_mps": speed_mps,
    }


def _position(role: PositionRole, fields: RoleFields) -> Columns:
    """Position fixes that are valid and finite; with how many were not as a finding."""
    columns = Columns()
    if role.position is None:
        columns["latitude_deg"] = fields.values("latitude")
        columns["longitude_deg"] = fields.values("longitude")
        place = np.column_stack([columns["latitude_deg"], columns["longitude_deg"]])
    else:
        place = np.column_stack([fields.values(f"position[{k}]") for k in range(2)])
        columns["position_enu_m"] = place[:, ::-1] if role.frame == "ned" else place
    columns["cov_m2"] = _position_cov(role, fields, len(place))
    if any(role.offset_m):
        columns["offset_m"] = np.broadcast_to(np.array(role.offset_m), (len(place), 3))
    columns["time_ns"] = fields.time_ns()
    good = fields.valid() & np.isfinite(place).all(axis=1)
    good &= np.isfinite(columns["cov_m2"]).all(axis=(1, 2))
    if not good.all():
        detail = f"{int((~good).sum())} of {len(good)} fixes without place or sigma: left out"
        fields.findings.append(Finding("no position", role.where, detail))
    return {name: column[good] for name, column in columns.items()}


def _reference(role: ReferenceRole, fields: RoleFields) -> Columns:
    position = fields.triple("position")
    if role.frame == "ned":
        position = position[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])
    return {"position_enu_m": position}


def _heading(role: HeadingRole, fields: RoleFields) -> Columns:
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
            fields.findings.append(Finding("odd heading", role.where, detail))
        roll = fields.values("roll") if role.roll else np.zeros_like(heading)
        pitch = fields.values("pitch") if role.pitch else np.zeros_like(heading)
    if role.orientation_xyzw is None or role.declination_deg:
        heading = np.mod(heading + np.radians(role.declination_deg), 2 * np.pi)
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


def _depth(role: DepthRole, fields: RoleFields) -> Columns:
    """Depth in metres, or pressure above the air's where no latitude is given."""
    values = np.where(fields.valid(), fields.values("depth"), np.nan)
    if UNITS[fields.quantities["depth"].unit][0] != "pressure":
        return {"depth_m": values}
    pressure_dbar = (values - role.atmosphere_pa) / 1e4
    if role.latitude_deg is None:
        return {"pressure_dbar": pressure_dbar}
    return {"depth_m": depth_of_pressure(pressure_dbar, role.latitude_deg)}


def _position_cov(role: PositionRole, fields: RoleFields, rows: int) -> Float:
    """Covariance (n, 2, 2) m² of east and north; where it is not stated, that of 5 m."""
    if role.covariance:
        cov_m2 = fields.matrix(role.covariance)
        if role.frame == "ned" and role.position is not None:
            cov_m2 = cov_m2[:, ::-1, ::-1]
    else:
        known = isinstance(role.sigma, str | Quantity)
        sigma_m = fields.values("sigma") if known else np.full(rows, role.sigma or 0.0)
        cov_m2 = np.square(sigma_m)[:, None, None] * np.eye(2)
    stated = (cov_m2[:, 0, 0] > 0) & (cov_m2[:, 1, 1] > 0)
    if not stated.all():
        detail = f"{int((~stated).sum())} of {rows} fixes: taken as {_POSITION_SIGMA_M:g} m"
        fields.findings.append(Finding("position without sigma", role.where, detail))
    return np.where(stated[:, None, None], cov_m2, _POSITION_SIGMA_M**2 * np.eye(2))


def _beacons(role: BeaconsRole, fields: RoleFields) -> Columns:
    """Places as they were logged, a row a beacon and message."""
    ids = fields.integers("id")
    unknown = np.full(len(ids), np.nan)
    columns: Columns = {
        "message": fields.message,
        "id": ids,
        "name": fields.texts(role.name or role.id),
        "turn_around_s": np.full(len(ids), float(role.turn_around))
        if isinstance(role.turn_around, float | int)
        else fields.values("turn_around"),
        "sigma_m": fields.values("position_sigma") if role.position_sigma else np.zeros(len(ids)),
        "origin_latitude_deg": _number(fields, role.origin_latitude, unknown),
        "origin_longitude_deg": _number(fields, role.origin_longitude, unknown),
    }
    if role.position is not None:
        columns["position_enu_m"] = fields.triple("position")
    else:
        columns["latitude_deg"] = fields.values("latitude")
        columns["longitude_deg"] = fields.values("longitude")
        columns["depth_m"] = fields.values("depth")
    return columns


def _number(fields: RoleFields, path: str | None, unknown: Float) -> Float:
    """Return a number that stands beside an array, a row an element."""
    if not path:
        return unknown
    column = fields.items(path)
    if column.dtype.kind not in "iuf":
        raise ReadError(f"{path} of {fields.role.where} is no number")
    return column.astype(np.float64)
