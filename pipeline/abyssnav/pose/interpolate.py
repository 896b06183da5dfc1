# SPDX-License-Identifier: Apache-2.0
"""Poses between the rows of a track: its positions, and between them its velocities' shape."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from abyssnav.errors import ReadError, nearest_hint
from abyssnav.geometry import body_to_enu, bracket, enu_to_geodetic, interpolate, wrap_angle
from abyssnav.results import ResultTable, read_table
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

_NEEDED: Final = (
    "method", "time", "east_m", "north_m", "depth_m", "sigma_east_m", "sigma_north_m",
    "cov_east_north_m2", "heading_rad", "roll_rad", "pitch_rad", "forward_mps", "starboard_mps",
    "altitude_m",
)  # fmt: skip


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
    return _poses(*_knots(tracks, method), time_ns, mounting)


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
    name = _chosen(method, present, solution.dive.name)
    track = solution.tracks[name]
    knots = {
        column.name: getattr(track, field) if column.value is None
        else column.value(getattr(track, field))
        for field, column in stored_columns(Track)
        if column.kind != "time"
    }  # fmt: skip
    knots["time_ns"] = to_utc_ns(solution.dive.start_ns, track.t_s)
    return _poses(knots, solution.dive.origin, name, time_ns, mounting)


def _poses(
    knots: dict[str, Any], origin: Origin | None, method: str, time_ns: Int, mounting: Mounting
) -> Poses:
    start_ns = int(knots["time_ns"][0])
    t_s, knots_s = (time_ns - start_ns) / 1e9, (knots["time_ns"] - start_ns) / 1e9
    inside = (time_ns >= start_ns) & (time_ns <= int(knots["time_ns"][-1]))
    track = _interpolated(knots, knots_s, t_s)
    if mounting != IN_LINE:
        track = _at_sensor(track, knots, knots_s, mounting)
    hidden = {
        name: np.where(inside.reshape(-1, *[1] * (column.ndim - 1)), column, np.nan)
        for name, column in track.columns().items()
        if name != "t_s"
    }
    return Poses(Track(t_s=t_s, **hidden), time_ns, inside, method, origin)


def _knots(tracks: Path, method: str | None) -> tuple[dict[str, Any], Origin | None, str]:
    """Columns of one method's track, the origin, and the method's name."""
    table: ResultTable = read_table(tracks, _NEEDED)
    name = _chosen(method, in_order(set(table.columns["method"].tolist())), str(tracks))
    rows = table.columns["method"] == name
    return {k: v[rows] for k, v in table.columns.items()}, table.origin, name


def _chosen(method: str | None, present: list[str], where: str) -> str:
    """The method that is asked for, or the best that there is."""
    if not present:
        raise ReadError(f"{where}: no track in it")
    name = method or present[-1]
    if name not in present:
        raise ReadError(f"{where}: no track by {name!r}{nearest_hint(name, present)}")
    return name


def _interpolated(knots: dict[str, Any], knots_s: Float, t_s: Float) -> Track:
    before, after, share = bracket(t_s, knots_s)
    step_s = knots_s[after] - knots_s[before]
    velocity_mps = _velocity_enu(knots)

    def linear(name: str) -> Float:
        values = knots[name]
        low, high = values[before], values[after]
        between = (1 - share) * low + share * high
        return np.asarray(np.where(share == 0.0, low, np.where(share == 1.0, high, between)))

    def reckoned(name: str, axis: int) -> Float:
        bend_mps = velocity_mps[after, axis] - velocity_mps[before, axis]
        return np.asarray(linear(name) + 0.5 * step_s * (share**2 - share) * bend_mps)

    def smooth(values: Float) -> Float:
        slope = np.gradient(values, knots_s) if len(values) > 1 else np.zeros(len(values))
        square, cube = share**2, share**3
        ends = (2 * cube - 3 * square + 1) * values[before] + (3 * square - 2 * cube) * values[
            after
        ]
        slopes = (cube - 2 * square + share) * slope[before] + (cube - square) * slope[after]
        return np.asarray(ends + step_s * slopes)

    cov_m2 = np.empty((len(t_s), 2, 2))
    for axis, name in enumerate(("sigma_east_m", "sigma_north_m")):
        low, high = knots[name][before] ** 2, knots[name][after] ** 2
        cov_m2[:, axis, axis] = (1 - share) * low + share * high
    cov_m2[:, 0, 1] = cov_m2[:, 1, 0] = linear("cov_east_north_m2")
    return Track(
        t_s=t_s,
        position_enu_m=np.column_stack(
            [
                reckoned("east_m", 0),
                reckoned("north_m", 1),
                -smooth(knots["depth_m"]),
            ]
        ),
        position_cov_m2=cov_m2,
        heading_rad=smooth(np.unwrap(knots["heading_rad"])) % (2 * np.pi),
        **{name: smooth(knots[name]) for name in ("roll_rad", "pitch_rad")},
        **{name: linear(name) for name in ("forward_mps", "starboard_mps", "altitude_m")},
    )


def _velocity_enu(knots: dict[str, Any]) -> Float:
    """East and north (n, 2) m/s at the rows."""
    sin, cos = np.sin(knots["heading_rad"]), np.cos(knots["heading_rad"])
    forward, starboard = knots["forward_mps"], knots["starboard_mps"]
    return np.column_stack([forward * sin + starboard * cos, forward * cos - starboard * sin])


def _at_sensor(track: Track, knots: dict[str, Any], knots_s: Float, mounting: Mounting) -> Track:
    """The same poses, of a sensor's place and axes."""
    offset_m = np.array(mounting.offset_m)
    attitude = (knots["roll_rad"], knots["pitch_rad"], knots["heading_rad"])
    at_knots_m = body_to_enu(offset_m, *attitude)
    speed_mps = np.gradient(at_knots_m, knots_s, axis=0) if len(knots_s) > 1 else 0 * at_knots_m
    lever_mps = interpolate(track.t_s, knots_s, speed_mps)
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
