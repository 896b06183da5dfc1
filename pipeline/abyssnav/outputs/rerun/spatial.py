# SPDX-License-Identifier: Apache-2.0
"""What is somewhere: beacons, fixes, positions, tracks, vehicle, its ellipse, a ping's ranges."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from abyssnav.acoustics.travel_time import mean_sound_speed
from abyssnav.geometry import ellipse_95, enu_to_geodetic, quaternion_xyzw
from abyssnav.outputs.palette import (
    ACCEPTED_RANGE,
    BEACON,
    END,
    INCONSISTENT_FIX,
    POSITION,
    REFUSED_POSITION,
    REJECTED_RANGE,
    SCALE,
    START,
    method_colour,
    rgb,
)
from abyssnav.outputs.presentation import position_fixes
from abyssnav.outputs.rerun.logger import RerunLogger, drawable
from abyssnav.tables import (
    DECISIONS,
    Beacons,
    Dive,
    Fixes,
    Float,
    Innovations,
    Int,
    Origin,
    Replies,
    Solution,
    Track,
    usual_step_s,
)

_STRIP: Final = 1000
#: Rows of a method's position, and of its heading and ellipse: 12 h and 5 h at 1 Hz.
_MOST_POSITIONS, _MOST_ELLIPSES = 43_200, 18_000
_MOST_FIXES: Final = 20_000  #: of another kind, accepted and not accepted each
_ELLIPSE_EVERY_S: Final = 30.0
_RING_CORNERS: Final = 64
#: Methods that give a pose as well as a place, besides the one that the views follow.
_POSED: Final = ("ekf", "smoother")
_MAP_EVERY_S: Final = 10.0


def log_beacons(log: RerunLogger, beacons: Beacons) -> None:
    """Beacons with name and position sigma."""
    import rerun as rr

    names = [
        drawable(name or f"beacon {k}") for name, k in zip(beacons.name, beacons.id, strict=True)
    ]
    labels = [
        f"{name} ±{sigma:g} m" if sigma > 0 else name
        for name, sigma in zip(names, beacons.sigma_m, strict=True)
    ]
    points = rr.Points3D(
        beacons.position_enu_m,
        labels=labels,
        show_labels=True,
        colors=[rgb(BEACON)],
        radii=rr.Radius.ui_points(7.0),
    )
    log.static("dive/beacons", points)


def log_fixes(log: RerunLogger, fixes: Fixes) -> None:
    """Fixes, small and pale where their own residuals refute them."""
    import rerun as rr

    fine, poor = _packed(method_colour("fix")), _packed(INCONSISTENT_FIX)
    colours = np.where(fixes.consistent, fine, poor).astype(np.uint32)
    radii = np.where(fixes.consistent, -2.5, -1.5).astype(np.float32)  # below 0: screen points
    log.columns(
        "dive/fixes",
        fixes.t_s,
        lambda rows: rr.Points3D.columns(
            positions=fixes.position_enu_m[rows], colors=colours[rows], radii=radii[rows]
        ),
    )


def log_positions(log: RerunLogger, solution: Solution) -> None:
    """Fixes of another kind at the depth of their instant, small and pale where not accepted.

    Of many the accepted ones are thinned, as a receiver may give ten a second for a day.
    """
    import rerun as rr

    fixes, depth = position_fixes(solution), solution.dive.depth
    if fixes is None or not len(depth):
        return
    taken = np.flatnonzero(fixes.decision == DECISIONS.index("accepted"))
    others = np.flatnonzero(fixes.decision != DECISIONS.index("accepted"))
    fixes = fixes[np.sort(np.concatenate([_thin_rows(taken), _thin_rows(others)]))]
    accepted = fixes.decision == DECISIONS.index("accepted")
    up_m = -np.interp(fixes.t_s, depth.t_s, depth.depth_m)
    points = rr.Points3D(
        np.column_stack([fixes.position_enu_m, up_m]),
        colors=np.where(accepted, _packed(POSITION), _packed(REFUSED_POSITION)).astype(np.uint32),
        radii=np.where(accepted, -2.5, -1.5).astype(np.float32),  # below 0: screen points
    )
    log.static("dive/positions", points)


def log_track(log: RerunLogger, method: str, track: Track, followed: bool, arrow_m: float) -> None:
    """Line, position over time, attitude and 95 % ellipse of a method.

    `/dive/<method>/vehicle` has the positions in ENU, for the trail, and a `Transform3D` for what
    is logged below it: body axes forward, port, up (REP-103), so that a camera hangs on it by its
    path.  Its own points are kept out of that transform by naming the frame of `/dive`.

    The ellipse is thinned to one in 30 s, but for the method that the views follow.  A long dive's
    rows are thinned to what keeps a day of every method small; its line is whole.
    """
    import rerun as rr

    colour, path = method_colour(method), f"dive/{method}/vehicle"
    log_line(log, f"dive/{method}", track.position_enu_m, colour)
    kept = _at_most(track, _MOST_POSITIONS)
    posed = method in _POSED or followed
    attitude = (kept.roll_rad, kept.pitch_rad, kept.heading_rad)
    quat_xyzw = quaternion_xyzw(*attitude).astype(np.float32) if posed else np.empty((0, 4))

    def columns(rows: slice) -> list[Any]:  # in one row: a time has a position and an attitude
        place_m = kept.position_enu_m[rows]
        points = rr.Points3D.columns(positions=place_m)
        pose = rr.Transform3D.columns(translation=place_m, quaternion=quat_xyzw[rows])
        return [*points, *(pose if posed else ())]

    log.columns(path, kept.t_s, columns)
    look = rr.Points3D.from_fields(colors=[rgb(colour)], radii=rr.Radius.ui_points(3.0))
    log.static(path, look)
    log.static(path, rr.CoordinateFrame("tf#/dive"))
    if posed:
        _log_marker(log, path, colour, arrow_m)
    few = _at_most(track, _MOST_ELLIPSES) if followed else _thinned(track, _ELLIPSE_EVERY_S)
    _log_ellipse(log, method, few)


def _log_marker(log: RerunLogger, path: str, colour: str, length_m: float) -> None:
    """Dot and arrow ahead, below the pose of a vehicle, that move and turn with it."""
    import rerun as rr

    dot = rr.Points3D([[0.0, 0.0, 0.0]], colors=[rgb(SCALE)], radii=rr.Radius.ui_points(8.0))
    log.static(f"{path}/centre", dot)

    ahead = rr.Arrows3D(
        vectors=[[length_m, 0.0, 0.0]], colors=[rgb(colour)], radii=rr.Radius.ui_points(4.0)
    )
    log.static(f"{path}/ahead", ahead)


def log_ends_and_scale(
    log: RerunLogger, track: Track, corner_enu_m: Float, extent_m: float
) -> None:
    """Where the track starts and ends, and a scale bar at a corner of the frame."""
    import rerun as rr

    ends = rr.Points3D(
        track.position_enu_m[[0, -1]],
        labels=["start", "end"],
        show_labels=True,
        colors=[rgb(START), rgb(END)],
        radii=rr.Radius.ui_points(6.0),
    )
    log.static("dive/ends", ends)
    bar_m = round_length(extent_m / 4.0)
    tick_m = 0.04 * bar_m
    bar = np.array([[0, tick_m, 0], [0, 0, 0], [bar_m, 0, 0], [bar_m, tick_m, 0]])
    words = f"{bar_m:g} m" if bar_m < 1000 else f"{bar_m / 1000:g} km"
    scale = rr.LineStrips3D(
        [corner_enu_m + bar],
        labels=[words],
        show_labels=True,
        colors=[rgb(SCALE)],
        radii=rr.Radius.ui_points(1.5),
    )
    log.static("dive/scale", scale)


def round_length(most_m: float) -> float:
    """1, 2 or 5 times a power of ten, at or below `most_m`."""
    decade = 10.0 ** np.floor(np.log10(max(most_m, 1e-3)))
    return float(next(k * decade for k in (5.0, 2.0, 1.0) if k * decade <= max(most_m, 1e-3)))


def log_line(log: RerunLogger, path: str, enu_m: Float, colour: str) -> None:
    """Static line (n, 3) in strips that share their end points."""
    import rerun as rr

    strips = [enu_m[k : k + _STRIP + 1] for k in range(0, max(len(enu_m) - 1, 1), _STRIP)]
    lines = rr.LineStrips3D(strips, colors=[rgb(colour)], radii=rr.Radius.ui_points(1.25))
    log.static(path, lines)


def log_map(log: RerunLogger, origin: Origin, method: str, track: Track) -> None:
    """The track on the map, one point in 10 s: enough for the eye."""
    import rerun as rr

    few = _thinned(track, _MAP_EVERY_S)
    lines = rr.GeoLineStrings(
        lat_lon=[_lat_lon_deg(origin, few.position_enu_m)],
        colors=[rgb(method_colour(method))],
        radii=rr.Radius.ui_points(1.5),
    )
    log.static(f"geo/{method}", lines)


def log_map_points(
    log: RerunLogger, origin: Origin, beacons: Beacons, method: str, track: Track
) -> None:
    """Beacons on the map, and the vehicle as it moves."""
    import rerun as rr

    if len(beacons):
        places = rr.GeoPoints(
            lat_lon=_lat_lon_deg(origin, beacons.position_enu_m),
            colors=[rgb(BEACON)],
            radii=rr.Radius.ui_points(7.0),
        )
        log.static("geo/beacons", places)
    few = _thinned(track, _MAP_EVERY_S)
    lat_lon_deg = _lat_lon_deg(origin, few.position_enu_m)
    log.columns(
        "geo/vehicle", few.t_s, lambda rows: rr.GeoPoints.columns(positions=lat_lon_deg[rows])
    )
    look = rr.GeoPoints.from_fields(
        colors=[rgb(method_colour(method))], radii=rr.Radius.ui_points(9.0)
    )
    log.static("geo/vehicle", look)


def _lat_lon_deg(origin: Origin, enu_m: Float) -> Float:
    return np.column_stack(enu_to_geodetic(origin.latitude_deg, origin.longitude_deg, enu_m)[:2])


def log_ranges(
    log: RerunLogger, parts: Mapping[int, str], dive: Dive, innovations: Innovations
) -> None:
    """Circle of each reply about its beacon, at the vehicle's depth, blue where it was accepted.

    The radius is that of a vehicle at rest: (c_h (T - τ) / 2)² - Δz², squared; the vehicle lies on
    the circle but for its motion during the ping.  Rejected ones have entities of their own
    (`rejected`), which show nothing from the beacon's next reply on: at any instant the blue
    circles are the last that were accepted, and meet where the vehicle is.
    """
    known = (dive.replies.beacon >= 0) & np.isfinite(innovations.innovation_s)
    replies, accepted = dive.replies[known], innovations.decision[known] == 0
    circles_m = _circles(dive, replies)
    for beacon_id, part in parts.items():
        own = np.flatnonzero(replies.beacon_id == beacon_id)
        taken = own[accepted[own]]
        _log_circles(
            log, f"dive/ranges/{part}", replies.t_reply_s[taken], circles_m[taken], ACCEPTED_RANGE
        )
        refused = np.flatnonzero(~accepted[own])
        ends = np.setdiff1d(refused + 1, refused)
        ends = own[ends[ends < len(own)]]
        path, times_s = f"dive/ranges/{part}/rejected", replies.t_reply_s
        _log_circles(log, path, times_s[own[refused]], circles_m[own[refused]], REJECTED_RANGE)
        _log_circles(log, path, times_s[ends], circles_m[ends][:, :0], REJECTED_RANGE)


def _circles(dive: Dive, replies: Replies) -> NDArray[np.float32]:
    """Corners (n, 65, 3) of the circle on which each reply places a vehicle at rest."""
    centre_m, below_m = replies.beacon_enu_m, -replies.beacon_enu_m[:, 2]
    speed_mps = mean_sound_speed(dive.sound_speed, replies.depth_reply_m, below_m)
    slant_m = 0.5 * speed_mps * (replies.travel_time_s - replies.turn_around_s)
    radius_m = np.sqrt(np.maximum(slant_m**2 - (below_m - replies.depth_reply_m) ** 2, 0.0))
    angle_rad = np.linspace(0.0, 2.0 * np.pi, _RING_CORNERS + 1)
    circle = np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    corners_m = np.empty((len(replies), len(angle_rad), 3), np.float32)
    corners_m[:, :, :2] = centre_m[:, None, :2] + radius_m[:, None, None] * circle
    corners_m[:, :, 2] = -replies.depth_reply_m[:, None]
    return corners_m


def _log_circles(
    log: RerunLogger, path: str, t_s: Float, corners_m: NDArray[np.float32], colour: str
) -> None:
    """Circles in one colour, one a row; rows of no corners show nothing."""
    import rerun as rr

    if not len(t_s):
        return
    if corners_m.shape[1]:
        log.columns(path, t_s, lambda rows: rr.LineStrips3D.columns(strips=corners_m[rows]))
    else:
        nothing = np.zeros(len(t_s), dtype=int)
        log.columns(
            path,
            t_s,
            lambda rows: rr.LineStrips3D.columns(strips=[]).partition(nothing[rows]),
        )
    look = rr.LineStrips3D.from_fields(colors=[rgb(colour)], radii=rr.Radius.ui_points(0.8))
    log.static(path, look)


def _thin_rows(rows: Int) -> Int:
    return rows[:: max(1, -(-len(rows) // _MOST_FIXES))]


def _at_most(track: Track, n: int) -> Track:
    return track[:: max(1, -(-len(track) // n))]


def _thinned(track: Track, period_s: float) -> Track:
    return track[:: max(1, round(period_s / usual_step_s(track.t_s)))] if len(track) > 1 else track


def _log_ellipse(log: RerunLogger, method: str, track: Track) -> None:
    import rerun as rr

    half_m, turn_rad = ellipse_95(track.position_cov_m2)
    flat = np.zeros(len(track))
    quat_xyzw = np.column_stack([flat, flat, np.sin(0.5 * turn_rad), np.cos(0.5 * turn_rad)])
    log.columns(
        f"dive/{method}/uncertainty",
        track.t_s,
        lambda rows: rr.Ellipsoids3D.columns(
            centers=track.position_enu_m[rows],
            half_sizes=np.column_stack([half_m, flat + 0.01])[rows],
            quaternions=quat_xyzw[rows],
        ),
    )
    look = rr.Ellipsoids3D.from_fields(
        colors=[rgb(method_colour(method))],
        line_radii=rr.Radius.ui_points(1.0),
        fill_mode=rr.components.FillMode.MajorWireframe,
    )
    log.static(f"dive/{method}/uncertainty", look)


def _packed(colour: str) -> int:
    """RGBA in one number, opaque."""
    red, green, blue = rgb(colour)
    return red << 24 | green << 16 | blue << 8 | 0xFF
