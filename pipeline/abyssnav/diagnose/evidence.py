# SPDX-License-Identifier: Apache-2.0
"""How well a track agrees with replies and fixes, whatever its method says of itself."""

from dataclasses import dataclass

import numpy as np

from abyssnav.acoustics.travel_time import is_physical, predict_travel_time, ray_geometry
from abyssnav.config import Config
from abyssnav.geometry import interpolate
from abyssnav.tables import Dive, Fixes, Float, Int, Solution, Table, Track

#: Methods that replies position, the best first.
POSITIONED = ("smoother", "ekf", "ekf_gated", "kf_fix", "ekf_ungated")
#: A reply is explained by a position this near to its range (two-way: twice that), m.
EXPLAINED_M = 12.0
#: Length of the stretches that are judged one by one.
STRETCH_S = 300.0


@dataclass(frozen=True, eq=False)
class Misfit(Table):
    """Physical replies against a track, one row a reply inside the track's span."""

    t_s: Float
    beacon: Int  #: row of the dive's beacons
    misfit_m: Float  #: one-way: ½ c (T - h(track))
    direction: Float  #: (n, 2) change of the range by the vehicle's place, east and north


@dataclass(frozen=True, eq=False)
class Stretches(Table):
    """What a track has to show for itself in each stretch of the dive."""

    t_begin_s: Float
    t_end_s: Float
    replies: Int  #: physical ones of known beacons
    explained: Int  #: of which the track explains so many
    beacons: Int  #: that have an explained reply
    fixes: Int  #: believable ones
    fix_distance_m: Float  #: median of theirs from the track; NaN without
    fix_scatter_m: Float  #: median of what their times and the beacons' places let expect
    dilution: Float  #: HDOP of the beacons with an explained reply; NaN below two of them


def positioned_track(solution: Solution) -> tuple[str, Track] | None:
    """Name and track of the best method that replies position; None when there is none."""
    for method in POSITIONED:
        track = solution.tracks.get(method)
        if track is not None and len(track):
            return method, track
    return None


def misfit(dive: Dive, track: Track) -> Misfit:
    """One-way misfit of every physical reply to a track, with the recorded beacons and water."""
    replies = dive.replies[dive.replies.beacon >= 0]
    geometry = ray_geometry(replies, dive.sound_speed)
    usable = is_physical(geometry, replies.travel_time_s, 0.01)
    usable &= (replies.t_ping_s >= track.t_s[0]) & (replies.t_reply_s <= track.t_s[-1])
    replies, geometry = replies[usable], geometry[usable]
    ping_m, reply_m = (
        interpolate(t_s, track.t_s, track.position_enu_m[:, :2])
        for t_s in (replies.t_ping_s, replies.t_reply_s)
    )
    model = predict_travel_time(ping_m, reply_m, geometry)
    half_mps = 0.5 * geometry.speed_ping_mps
    gradient_spm = model.gradient_ping_spm + model.gradient_reply_spm
    return Misfit(
        replies.t_reply_s,
        replies.beacon,
        half_mps * (geometry.flight_time_s - model.time_s),
        half_mps[:, None] * gradient_spm,
    )


def explained_by_beacon(dive: Dive, rows: Misfit) -> tuple[Int, Float]:
    """Physical replies (b,) of each beacon, and the share that the track explains; NaN without."""
    good = np.abs(rows.misfit_m) < EXPLAINED_M
    n = np.bincount(rows.beacon, minlength=len(dive.beacons))
    n_good = np.bincount(rows.beacon[good], minlength=len(dive.beacons))
    return n, np.where(n > 0, n_good / np.maximum(n, 1), np.nan)


def believable(fixes: Fixes) -> Fixes:
    """Consistent fixes that lie within a vehicle's reach of one before or after."""
    fixes = fixes[fixes.consistent]
    if len(fixes) < 2:
        return fixes
    step_m = np.linalg.norm(np.diff(fixes.position_enu_m[:, :2], axis=0), axis=1)
    within = step_m <= 5.0 * np.diff(fixes.t_s) + 20.0
    reached = np.zeros(len(fixes), dtype=bool)
    reached[1:] |= within
    reached[:-1] |= within
    return fixes[reached]


def stretches(dive: Dive, track: Track, fixes: Fixes, rows: Misfit, config: Config) -> Stretches:
    """Evidence for a track in stretches of a few minutes, while the vehicle moves or listens.

    A fix's covariance is of its times alone, C = σ² (Gᵀ G)⁻¹.  Beacons σ_b off move it by
    (2 σ_b / c)² (Gᵀ G)⁻¹ besides, all fixes of a stretch alike.
    """
    moving_s = dive.velocity.t_s[dive.velocity.valid]
    first_s = max(track.t_s[0], min(moving_s[0], dive.replies.t_reply_s.min()))
    last_s = min(track.t_s[-1], max(moving_s[-1], dive.replies.t_reply_s.max()))
    begin_s = np.arange(first_s, last_s, STRETCH_S)
    rows = rows[(rows.t_s >= first_s) & (rows.t_s <= last_s)]
    good = np.abs(rows.misfit_m) < EXPLAINED_M
    place = np.searchsorted(begin_s, rows.t_s, side="right") - 1
    n = len(begin_s)
    answered = np.zeros((n, len(dive.beacons)), dtype=bool)
    answered[place[good], rows.beacon[good]] = True
    fixes = believable(fixes)
    inside = (fixes.t_mid_s >= first_s) & (fixes.t_mid_s <= last_s)
    fixes = fixes[inside]
    where_m = interpolate(fixes.t_mid_s, track.t_s, track.position_enu_m[:, :2])
    distance_m = np.hypot(*(fixes.position_enu_m[:, :2] - where_m).T)
    scatter_m = np.sqrt(np.trace(fixes.position_cov_m2, axis1=1, axis2=2))
    scatter_m *= np.hypot(1.0, _beacons_to_times(dive, config))
    cell = np.searchsorted(begin_s, fixes.t_mid_s, side="right") - 1
    return Stretches(
        t_begin_s=begin_s,
        t_end_s=np.append(begin_s[1:], last_s),
        replies=np.bincount(place, minlength=n),
        explained=np.bincount(place[good], minlength=n),
        beacons=answered.sum(axis=1),
        fixes=np.bincount(cell, minlength=n),
        fix_distance_m=median_by(cell, distance_m, n),
        fix_scatter_m=median_by(cell, scatter_m, n),
        dilution=_dilution(place[good], rows[good], (n, len(dive.beacons))),
    )


def _beacons_to_times(dive: Dive, config: Config) -> float:
    """Standard deviation of a range by the beacons' places over that by its time, 2 σ_b / c σ.

    Of the beacons that answer: one that never does has no part in any fix.
    """
    stated_m = dive.beacons.sigma_m
    sigma_m = np.where(stated_m > 0, stated_m, config.errors.beacon_sigma_m)
    sigma_m = sigma_m[np.isin(np.arange(len(sigma_m)), dive.replies.beacon)]
    half_mps = 0.5 * float(np.mean(dive.sound_speed.sound_speed_mps))
    range_sigma_m = half_mps * config.acoustics.travel_time_sigma_s
    return float(np.sqrt(np.sum(sigma_m**2) / max(len(sigma_m), 1))) / range_sigma_m


def _dilution(cell: Int, rows: Misfit, shape: tuple[int, int]) -> Float:
    """Horizontal dilution of precision (n,), √ tr (Σ u uᵀ)⁻¹ over each cell's beacons."""
    direction, count = np.zeros((*shape, 2)), np.zeros(shape)
    np.add.at(direction, (cell, rows.beacon), rows.direction)
    np.add.at(count, (cell, rows.beacon), 1.0)
    direction /= np.maximum(count, 1.0)[:, :, None]
    normal = np.einsum("cbi,cbj->cij", direction, direction)
    trace, determinant = np.trace(normal, axis1=1, axis2=2), np.linalg.det(normal)
    known = (count > 0).sum(axis=1) >= 2
    return np.where(known, np.sqrt(trace / np.maximum(determinant, 1e-9)), np.nan)


def median_by(cell: Int, values: Float, n: int) -> Float:
    """Median (n,) of the values of each cell; NaN for an empty one."""
    order = np.argsort(cell, kind="stable")
    parts = np.split(values[order], np.cumsum(np.bincount(cell, minlength=n))[:-1])
    return np.array([np.median(part) if len(part) else np.nan for part in parts])
