# SPDX-License-Identifier: Apache-2.0
"""Poses between the rows of a track: its positions, and between them its velocities' shape."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from abyssnav.geometry import body_to_enu, bracket, enu_to_geodetic, interpolate, wrap_angle
from abyssnav.results import ResultTable, chosen_methods, read_arrow, read_table
from abyssnav.tables import (
    Bool,
    Float,
    Int,
    Origin,
    Solution,
    Track,
    in_order,
    stored_columns,
    to_utc_ns,
)
from abyssnav.workers import cores

_NEEDED: Final = (
    "method", "time", "east_m", "north_m", "depth_m", "sigma_east_m", "sigma_north_m",
    "cov_east_north_m2", "heading_rad", "roll_rad", "pitch_rad", "forward_mps", "starboard_mps",
    "altitude_m",
)  # fmt: skip
#: What goes through its neighbours (Catmull-Rom).
_SMOOTH: Final = ("depth_m", "heading_rad", "roll_rad", "pitch_rad")
_TOGETHER: Final = 1 << 15  #: instants at a time: their columns stay in the processor's cache


@dataclass(frozen=True)
class Mounting:
    """How a sensor sits in the vehicle."""

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: forward, starboard, down
    #: Roll, pitch, yaw: Rz(yaw) Ry(pitch) Rx(roll) takes the sensor's vectors to the vehicle's.
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)


#: At the navigated point, in line with the vehicle.
IN_LINE: Final = Mounting()


@dataclass(frozen=True, eq=False)
class Poses:
    """A track at given instants; NaN where it does not reach."""

    track: Track
    time_ns: Int
    inside: Bool
    method: str
    origin: Origin | None


def poses_at(
    tracks: Path, time_ns: Int, method: str | None = None, mounting: Mounting = IN_LINE
) -> Poses:
    """Poses at any instants from a `tracks.parquet`.

    Between two rows k and k+1, a time h apart, with s the share of it:

        p(s) = (1-s) p_k + s p_k+1 + (s²-s) h (v_k+1 - v_k) / 2

    with v the method's own velocity over ground: what dead reckoning runs between the two, what it
    misses at the end spread evenly, so that a filter's leap at a reply swings nothing.  Depth and
    angles go through their neighbours (cubic, Catmull-Rom).  Speeds and covariance are linear.  At
    the track's own instants the rows come back as they are.

    A sensor at `offset_m` lies at p + R_enu_body offset and points by R_enu_body R_mount; the
    covariance is that of the navigated point.

    Raises
    ------
    ReadError
        An older version made the file, or it has no such method.
    """
    methods = read_arrow(tracks, ["method"])["method"].unique().to_pylist()
    (name,) = chosen_methods(in_order(methods), [method] if method else [], str(tracks))
    table: ResultTable = read_table(tracks, _NEEDED, [("method", "==", name)])
    columns = {k: v for k, v in table.columns.items() if k != "method"}
    return _poses(_prepared(columns), table.origin, name, time_ns, mounting)


def poses_of_solution(
    solution: Solution, time_ns: Int, method: str | None = None, mounting: Mounting = IN_LINE
) -> Poses:
    """The same from tracks that were not written.

    Raises
    ------
    ReadError
        The solution has no such method, or no track at all.
    """
    present = in_order(name for name, track in solution.tracks.items() if len(track))
    (name,) = chosen_methods(present, [method] if method else [], solution.dive.name)
    track = solution.tracks[name]
    columns = {
        column.name: getattr(track, field) if column.value is None
        else column.value(getattr(track, field))
        for field, column in stored_columns(Track)
        if column.kind != "time"
    }  # fmt: skip
    columns["time_ns"] = to_utc_ns(solution.dive.start_ns, track.t_s)
    return _poses(_prepared(columns), solution.dive.origin, name, time_ns, mounting)


def _poses(
    knots: "_Knots", origin: Origin | None, method: str, time_ns: Int, mounting: Mounting
) -> Poses:
    start_ns = int(knots.time_ns[0])
    t_s = (time_ns - start_ns) / 1e9
    inside = (time_ns >= start_ns) & (time_ns <= int(knots.time_ns[-1]))
    pieces = [t_s[k : k + _TOGETHER] for k in range(0, max(len(t_s), 1), _TOGETHER)]
    with ThreadPoolExecutor(cores()) as threads:
        track = _joined(list(threads.map(partial(_interpolated, knots), pieces)))
    if mounting != IN_LINE:
        track = _at_sensor(track, knots, mounting)
    if not inside.all():
        hidden = {
            name: np.where(inside.reshape(-1, *[1] * (column.ndim - 1)), column, np.nan)
            for name, column in track.columns().items()
            if name != "t_s"
        }
        track = Track(t_s=t_s, **hidden)
    return Poses(track, time_ns, inside, method, origin)


@dataclass(frozen=True, eq=False)
class _Knots:
    """Rows of a track, and what is interpolated between them."""

    time_ns: Int
    t_s: Float
    columns: dict[str, Float]  #: of the file; the heading without its leaps
    slopes: dict[str, Float]  #: a second, of the columns that go through their neighbours
    velocity_enu_mps: Float  #: (n, 2)


def _prepared(columns: dict[str, Any]) -> _Knots:
    """Knots of the columns of a track."""
    time_ns = columns.pop("time_ns")
    t_s = (time_ns - time_ns[0]) / 1e9
    columns["heading_rad"] = np.unwrap(columns["heading_rad"])
    slopes = {name: _slope(columns[name], t_s) for name in _SMOOTH}
    return _Knots(time_ns, t_s, columns, slopes, _velocity_enu(columns))


def _slope(values: Float, t_s: Float) -> Float:
    return np.asarray(np.gradient(values, t_s, axis=0)) if len(t_s) > 1 else 0 * values


def _joined(parts: list[Track]) -> Track:
    if len(parts) == 1:
        return parts[0]
    columns = [part.columns() for part in parts]
    return Track(**{name: np.concatenate([c[name] for c in columns]) for name in columns[0]})


def _interpolated(knots: _Knots, t_s: Float) -> Track:
    before, after, share = bracket(t_s, knots.t_s)
    step_s = knots.t_s[after] - knots.t_s[before]
    rest, square = 1 - share, share**2
    cube, bend_s = square * share, 0.5 * step_s * (square - share)
    end = 3 * square - 2 * cube
    begin, slopes_s = 1 - end, (step_s * (cube - 2 * square + share), step_s * (cube - square))

    def linear(values: Float) -> Float:
        low, high = values[before], values[after]
        between = rest * low + share * high
        if np.isnan(between).any():  # what is unknown beside it must not hide a row's own value
            return np.where(share == 0.0, low, np.where(share == 1.0, high, between))
        return np.asarray(between)

    def reckoned(name: str, axis: int) -> Float:
        velocity_mps = knots.velocity_enu_mps[:, axis]
        bend_mps = velocity_mps[after] - velocity_mps[before]
        return np.asarray(linear(columns[name]) + bend_s * bend_mps)

    def smooth(name: str) -> Float:
        values, slope = columns[name], knots.slopes[name]
        ends = begin * values[before] + end * values[after]
        return np.asarray(ends + slopes_s[0] * slope[before] + slopes_s[1] * slope[after])

    columns = knots.columns
    cov_m2 = np.empty((len(t_s), 2, 2))
    for axis, name in enumerate(("sigma_east_m", "sigma_north_m")):
        cov_m2[:, axis, axis] = linear(columns[name] ** 2)
    cov_m2[:, 0, 1] = cov_m2[:, 1, 0] = linear(columns["cov_east_north_m2"])
    enu_m = (reckoned("east_m", 0), reckoned("north_m", 1), -smooth("depth_m"))
    return Track(
        t_s=t_s,
        position_enu_m=np.column_stack(enu_m),
        position_cov_m2=cov_m2,
        heading_rad=smooth("heading_rad") % (2 * np.pi),
        **{name: smooth(name) for name in ("roll_rad", "pitch_rad")},
        **{name: linear(columns[name]) for name in ("forward_mps", "starboard_mps", "altitude_m")},
    )


def _velocity_enu(columns: dict[str, Float]) -> Float:
    """East and north (n, 2) m/s at the rows."""
    sin, cos = np.sin(columns["heading_rad"]), np.cos(columns["heading_rad"])
    forward, starboard = columns["forward_mps"], columns["starboard_mps"]
    return np.column_stack([forward * sin + starboard * cos, forward * cos - starboard * sin])


def _at_sensor(track: Track, knots: _Knots, mounting: Mounting) -> Track:
    """The same poses, of a sensor's place and axes."""
    offset_m = np.array(mounting.offset_m)
    attitude = (knots.columns[f"{name}_rad"] for name in ("roll", "pitch", "heading"))
    speed_mps = _slope(body_to_enu(offset_m, *attitude), knots.t_s)
    lever_mps = interpolate(track.t_s, knots.t_s, speed_mps)
    lever_m = body_to_enu(offset_m, track.roll_rad, track.pitch_rad, track.heading_rad)
    sin, cos = np.sin(track.heading_rad), np.cos(track.heading_rad)
    forward_mps = track.forward_mps + lever_mps[:, 0] * sin + lever_mps[:, 1] * cos
    starboard_mps = track.starboard_mps + lever_mps[:, 0] * cos - lever_mps[:, 1] * sin
    roll_rad, pitch_rad, heading_rad = _turned(track, np.radians(mounting.rpy_deg))
    turn = np.exp(1j * wrap_angle(heading_rad - track.heading_rad))
    level_mps = (forward_mps + 1j * starboard_mps) * np.conj(turn)
    return Track(
        t_s=track.t_s,
        position_enu_m=track.position_enu_m + lever_m,
        position_cov_m2=track.position_cov_m2,
        heading_rad=heading_rad % (2 * np.pi),
        roll_rad=roll_rad,
        pitch_rad=pitch_rad,
        forward_mps=level_mps.real,
        starboard_mps=level_mps.imag,
        altitude_m=track.altitude_m + lever_m[:, 2],
    )


def _turned(track: Track, rpy_rad: Float) -> tuple[Float, Float, Float]:
    """Roll, pitch and heading of the sensor's axes, from R_enu_body R_mount."""
    still = np.zeros(())
    #: The mount's axes in the vehicle: forward, starboard, down of each sensor axis.
    axes = [
        body_to_enu(axis, rpy_rad[0] + still, rpy_rad[1] + still, rpy_rad[2] + still)
        for axis in np.eye(3)
    ]
    # east, north, up of a "body" at heading yaw is starboard, forward, up of the vehicle
    in_body = [np.array([axis[1], axis[0], -axis[2]]) for axis in axes]
    attitude = (track.roll_rad, track.pitch_rad, track.heading_rad)
    forward, starboard, down = (body_to_enu(axis, *attitude) for axis in in_body)
    heading_rad = np.arctan2(forward[:, 0], forward[:, 1])
    pitch_rad = np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
    roll_rad = np.arctan2(-starboard[:, 2], -down[:, 2])
    return roll_rad, pitch_rad, heading_rad


def geodetic_of(poses: Poses) -> tuple[Float, Float]:
    """Latitude and longitude in degrees; NaN without an origin and outside the track."""
    unknown = np.full(len(poses.time_ns), np.nan)
    if poses.origin is None:
        return unknown, unknown
    place = (poses.origin.latitude_deg, poses.origin.longitude_deg)
    latitude_deg, longitude_deg, _ = enu_to_geodetic(*place, poses.track.position_enu_m)
    return latitude_deg, longitude_deg
