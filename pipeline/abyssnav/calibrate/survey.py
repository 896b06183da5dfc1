# SPDX-License-Identifier: Apache-2.0
"""Beacons surveyed from a ship that knows where it is (box-in): a first place for each of them."""

from typing import NamedTuple

import numpy as np

from abyssnav.config import BeaconSetting
from abyssnav.estimation.map_estimator import robust_weight
from abyssnav.geometry import interpolate
from abyssnav.tables import Beacons, Bool, Dive, Float, Replies

#: A survey has a position fix this near to nearly all of its pings.
_NEAR_S, _NEARLY_ALL = 30.0, 0.8
#: Beacons may be so far from where their tables have them.
_UNKNOWN_M = 1000.0
#: Farther away, and by more of its stated sigmas, a beacon is taken from the ranges.
_ELSEWHERE_M, _ELSEWHERE_SIGMAS = 20.0, 5.0
#: Residuals that count half, from first to last, as metres of one-way range.
_SCALES_M = (300.0, 100.0, 30.0, 10.0, 5.0, 5.0, 5.0, 5.0)
#: Fewer replies give a beacon no place.
_FEWEST = 8
_STARTS_M = (0.0, -300.0, 300.0)


class _Ranges(NamedTuple):
    """One beacon's half round trips, in metres, from a transducer whose places are known."""

    ping_m: Float  #: (n, 3) ENU
    reply_m: Float  #: (n, 3)
    range_m: Float  #: (n,)


def is_survey(dive: Dive) -> bool:
    """Whether position fixes go along with the acoustics: a ship with GNSS, not a vehicle."""
    table, pings_s = dive.positions, dive.replies.t_ping_s
    if table is None or len(table) < _FEWEST or len(pings_s) < _FEWEST:
        return False
    after = np.clip(np.searchsorted(table.t_s, pings_s), 1, len(table) - 1)
    away_s = np.minimum(np.abs(pings_s - table.t_s[after - 1]), np.abs(pings_s - table.t_s[after]))
    return bool(np.mean(away_s < _NEAR_S) > _NEARLY_ALL)


def box_in(dive: Dive) -> Float:
    """Places (b, 3) ENU of all beacons by ranges from known places, robust against wrong ones.

        T = (|p(t_p) - b| + |p(t_r) - b|) / c + τ

    c the mean speed of the profile down to the beacon's table, τ as stated: good to some metres,
    enough to linearise the smoother's equations.  A beacon without enough replies stays where its
    table has it.
    """
    places = dive.beacons.position_enu_m.copy()
    for row in range(len(places)):
        rows = np.flatnonzero(dive.replies.beacon == row)
        if len(rows) < _FEWEST:
            continue
        ranges = _ranges(dive, dive.replies[rows], places[row])
        tried = [
            _trilaterated(ranges, places[row] + np.array([east_m, north_m, 0.0]))
            for east_m in _STARTS_M
            for north_m in _STARTS_M
        ]
        places[row] = min(tried, key=lambda place: _cost(ranges, place))
    return places


def _ranges(dive: Dive, replies: Replies, stated_m: Float) -> _Ranges:
    profile = dive.sound_speed
    depth_m = np.linspace(float(np.median(replies.depth_ping_m)), -float(stated_m[2]), 200)
    slowness = 1 / np.interp(depth_m, profile.depth_m, profile.sound_speed_mps)
    flight_s = replies.travel_time_s - replies.turn_around_s
    return _Ranges(
        _transducer(dive, replies.t_ping_s, replies.lever_ping_enu_m, replies.depth_ping_m),
        _transducer(dive, replies.t_reply_s, replies.lever_reply_enu_m, replies.depth_reply_m),
        0.5 * flight_s / float(np.mean(slowness)),
    )


def _transducer(dive: Dive, t_s: Float, lever_enu_m: Float, depth_m: Float) -> Float:
    """Places (n, 3) of the transducer, linear between the position fixes."""
    table = dive.positions
    assert table is not None
    level_m = interpolate(t_s, table.t_s, table.vehicle_enu_m)
    return np.column_stack([level_m, -depth_m]) + lever_enu_m


def _residual(ranges: _Ranges, place_m: Float) -> tuple[Float, Float]:
    """Measured less predicted range (n,), and the predicted's derivatives (n, 3)."""
    away = [transducer_m - place_m for transducer_m in (ranges.ping_m, ranges.reply_m)]
    lengths = [np.linalg.norm(vector, axis=1) for vector in away]
    slope = sum(-0.5 * v / length[:, None] for v, length in zip(away, lengths, strict=True))
    return ranges.range_m - 0.5 * (lengths[0] + lengths[1]), np.asarray(slope)


def _trilaterated(ranges: _Ranges, place_m: Float) -> Float:
    """Place by Gauss-Newton steps, wrong ranges losing weight step by step."""
    for scale_m in _SCALES_M:
        for _ in range(3):
            residual_m, slope = _residual(ranges, place_m)
            weight = robust_weight((residual_m / scale_m) ** 2, 1.0)
            normal = slope.T @ (weight[:, None] * slope) + 1e-6 * np.eye(3)
            step_m = np.linalg.solve(normal, slope.T @ (weight * residual_m))
            place_m = place_m + step_m / max(1.0, float(np.linalg.norm(step_m)) / 500.0)
    return place_m


def _cost(ranges: _Ranges, place_m: Float) -> float:
    residual_m, _ = _residual(ranges, place_m)
    return float(np.sum(np.minimum((residual_m / _SCALES_M[-1]) ** 2, 9.0)))


def elsewhere(beacons: Beacons, places_m: Float) -> Bool:
    """Beacons (b,) so far from their tables that the dive cannot be navigated by those."""
    stated_m = np.nan_to_num(beacons.sigma_m)
    away_m = np.hypot(*(places_m - beacons.position_enu_m)[:, :2].T)
    return np.asarray(away_m > np.maximum(_ELSEWHERE_M, _ELSEWHERE_SIGMAS * stated_m))


def settings_of(beacons: Beacons, places_m: Float, off: Bool) -> tuple[BeaconSetting, ...]:
    """Beacons as settings that replace the log's; of those that are off hardly a place is known."""
    stated = np.where(np.nan_to_num(beacons.sigma_m) > 0, beacons.sigma_m, 0.0)
    sigma_m = np.where(off, _UNKNOWN_M, stated)
    return tuple(
        BeaconSetting(
            id=number, name=name, position_m=(east, north, up), turn_around_s=turn_around_s,
            sigma_m=sigma,
        )
        for number, name, (east, north, up), turn_around_s, sigma in zip(
            beacons.id.tolist(), beacons.name.tolist(), places_m.tolist(),
            beacons.turn_around_s.tolist(), sigma_m.tolist(), strict=True,
        )
    )  # fmt: skip
