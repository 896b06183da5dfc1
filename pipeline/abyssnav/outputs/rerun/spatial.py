# SPDX-License-Identifier: Apache-2.0
"""What is somewhere: beacons, fixes, tracks, the vehicle, its ellipse, the ranges of a ping."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from abyssnav.acoustics.travel_time import mean_sound_speed
from abyssnav.geometry import enu_to_geodetic
from abyssnav.outputs.palette import (
    ACCEPTED_RANGE,
    BEACON,
    INCONSISTENT_FIX,
    REJECTED_RANGE,
    method_colour,
    rgb,
)
from abyssnav.outputs.rerun.logger import Sender
from abyssnav.tables import DECISIONS, Beacons, Dive, Fixes, Float, Innovations, Origin, Track

_STRIP: Final = 1000
#: Rows of a method's position, and of its heading and ellipse: 12 h and 5 h at 1 Hz.
_MOST_POSITIONS, _MOST_ELLIPSES = 43_200, 18_000
_ELLIPSE_EVERY_S: Final = 30.0
_CHI2_95_OF_2: Final = 5.991  # P(χ²₂ ≤ 5.991) = 0.95
_RING_CORNERS: Final = 64
_HEADING_M: Final = 60.0


def log_beacons(log: Sender, beacons: Beacons) -> None:
    """Beacons with name and position sigma."""
    import rerun as rr

    names = [name or f"beacon {k}" for name, k in zip(beacons.name, beacons.id, strict=True)]
    labels = [
        f"{name} ±{sigma:g} m" if sigma > 0 else str(name)
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


def log_fixes(log: Sender, fixes: Fixes) -> None:
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


def log_track(log: Sender, method: str, track: Track, followed: bool) -> None:
    """Line, position over time, heading and 95 % ellipse of a method.

    The last two are thinned to one in 30 s, but for the method that the views follow.  A long
    dive's rows are thinned to what keeps a day of every method below 60 MB; its line is whole.
    """
    import rerun as rr

    colour = method_colour(method)
    log_line(log, f"dive/{method}", track.position_enu_m, colour)
    seen = _at_most(track, _MOST_POSITIONS)
    log.columns(
        f"dive/{method}/vehicle",
        seen.t_s,
        lambda rows: rr.Points3D.columns(positions=seen.position_enu_m[rows]),
    )
    look = rr.Points3D.from_fields(colors=[rgb(colour)], radii=rr.Radius.ui_points(3.0))
    log.static(f"dive/{method}/vehicle", look)
    some = _at_most(track, _MOST_ELLIPSES) if followed else _thinned(track, _ELLIPSE_EVERY_S)
    _log_heading(log, method, some)
    _log_ellipse(log, method, some)


def log_line(log: Sender, path: str, enu_m: Float, colour: str) -> None:
    """Static line (n, 3) in strips that share their end points."""
    import rerun as rr

    strips = [enu_m[k : k + _STRIP + 1] for k in range(0, max(len(enu_m) - 1, 1), _STRIP)]
    lines = rr.LineStrips3D(strips, colors=[rgb(colour)], radii=rr.Radius.ui_points(1.25))
    log.static(path, lines)


def log_map(log: Sender, origin: Origin, method: str, track: Track) -> None:
    """The track on the map, one point in 10 s: enough for the eye."""
    import rerun as rr

    some = _thinned(track, 10.0).position_enu_m
    latitude_deg, longitude_deg, _ = enu_to_geodetic(
        origin.latitude_deg, origin.longitude_deg, some
    )
    lines = rr.GeoLineStrings(
        lat_lon=[np.column_stack([latitude_deg, longitude_deg])],
        colors=[rgb(method_colour(method))],
        radii=rr.Radius.ui_points(1.5),
    )
    log.static(f"geo/{method}", lines)


def log_ranges(log: Sender, parts: Mapping[int, str], dive: Dive, innovations: Innovations) -> None:
    """Circle of each reply about its beacon, at the vehicle's depth, in the colour of its verdict.

    The radius is that of a vehicle at rest: (c_h (T - τ) / 2)² - Δz², squared; the vehicle lies on
    the circle but for its motion during the ping.
    """
    import rerun as rr

    known = (dive.replies.beacon >= 0) & np.isfinite(innovations.innovation_s)
    replies, verdict = dive.replies[known], innovations.decision[known]
    centre_m, below_m = replies.beacon_enu_m, -replies.beacon_enu_m[:, 2]
    speed_mps = mean_sound_speed(dive.sound_speed, replies.depth_reply_m, below_m)
    slant_m = 0.5 * speed_mps * (replies.travel_time_s - replies.turn_around_s)
    radius_m = np.sqrt(np.maximum(slant_m**2 - (below_m - replies.depth_reply_m) ** 2, 0.0))
    angle_rad = np.linspace(0.0, 2.0 * np.pi, _RING_CORNERS + 1)
    circle = np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    colours = np.where(
        verdict == DECISIONS.index("accepted"), _packed(ACCEPTED_RANGE), _packed(REJECTED_RANGE)
    ).astype(np.uint32)
    for beacon_id, part in parts.items():
        mine = replies.beacon_id == beacon_id
        own_m = np.empty((int(mine.sum()), len(angle_rad), 3), np.float32)
        own_m[:, :, :2] = centre_m[mine, None, :2] + radius_m[mine, None, None] * circle
        own_m[:, :, 2] = -replies.depth_reply_m[mine, None]
        own_colours = colours[mine]
        log.columns(
            f"dive/ranges/{part}",
            replies.t_reply_s[mine],
            lambda rows, m=own_m, c=own_colours: rr.LineStrips3D.columns(  # type: ignore[misc]
                strips=m[rows], colors=c[rows]
            ),
        )
        look = rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(0.6))
        log.static(f"dive/ranges/{part}", look)


def _at_most(track: Track, n: int) -> Track:
    return track[:: max(1, -(-len(track) // n))]


def _thinned(track: Track, period_s: float) -> Track:
    step_s = np.median(np.diff(track.t_s)) if len(track) > 1 else 1.0
    return track[:: max(1, round(period_s / step_s))]


def _log_heading(log: Sender, method: str, track: Track) -> None:
    import rerun as rr

    flat = np.zeros(len(track))
    ahead_m = _HEADING_M * np.column_stack(
        [np.sin(track.heading_rad), np.cos(track.heading_rad), flat]
    )
    log.columns(
        f"dive/{method}/heading",
        track.t_s,
        lambda rows: rr.Arrows3D.columns(vectors=ahead_m[rows], origins=track.position_enu_m[rows]),
    )
    look = rr.Arrows3D.from_fields(
        colors=[rgb(method_colour(method))], radii=rr.Radius.ui_points(2.0)
    )
    log.static(f"dive/{method}/heading", look)


def _log_ellipse(log: Sender, method: str, track: Track) -> None:
    import rerun as rr

    variance_m2, axes = np.linalg.eigh(track.position_cov_m2)
    half_m = np.sqrt(_CHI2_95_OF_2 * np.maximum(variance_m2, 0.0))
    half_turn_rad = 0.5 * np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
    flat = np.zeros(len(track))
    quat_xyzw = np.column_stack([flat, flat, np.sin(half_turn_rad), np.cos(half_turn_rad)])
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
