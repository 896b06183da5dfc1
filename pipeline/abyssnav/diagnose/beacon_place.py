# SPDX-License-Identifier: Apache-2.0
"""Where a beacon lies by its own replies, and whether it is its place or its turn-around time."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import (
    RayGeometry,
    is_physical,
    predict_travel_time,
    ray_geometry,
)
from abyssnav.geometry import interpolate
from abyssnav.tables import Dive, Fixes, Float, Track

#: Fewer replies do not tell a place.
_LEAST_REPLIES = 12
#: Ranges miss by so much, and those that miss more weigh less.
_SCALE_M = 3.0
#: Displacements from which it is sought, and directions.
_RINGS_M, _DIRECTIONS = (0.0, 8.0, 25.0, 60.0, 120.0, 250.0, 500.0), 16
_STEPS = 12
#: A fix tells where the vehicle is for this long; farther from it nothing is known here.
_NEAR_FIX_S = 20.0


class BeaconPlace(NamedTuple):
    """Where a beacon lies beside where it is given, or how late it answers instead."""

    moved_m: Float  #: (2,) east, north
    sigma_m: float  #: of either, root mean square
    late_s: float  #: of the two-way time, with the beacon where it is given
    place_gain: float  #: log likelihood of another place over a late answer, one parameter paid
    n_replies: int


#: Places (n, 2) of the acoustic point at instants; NaN where they are not known.
Positions = Callable[[Float], Float]


def along(track: Track) -> Positions:
    """Places by a track; NaN outside it."""

    def places(t_s: Float) -> Float:
        known = (t_s >= track.t_s[0]) & (t_s <= track.t_s[-1])
        place_m = interpolate(t_s, track.t_s, track.position_enu_m[:, :2])
        return np.where(known[:, None], place_m, np.nan)

    return places


def by_fixes(fixes: Fixes) -> Positions:
    """Places between consistent fixes that are not far apart; NaN elsewhere."""
    fixes = fixes[fixes.consistent]

    def places(t_s: Float) -> Float:
        if len(fixes) < 2:
            return np.full((len(t_s), 2), np.nan)
        after = np.clip(np.searchsorted(fixes.t_mid_s, t_s), 1, len(fixes) - 1)
        nearest_s = np.minimum(
            np.abs(t_s - fixes.t_mid_s[after - 1]), np.abs(t_s - fixes.t_mid_s[after])
        )
        place_m = interpolate(t_s, fixes.t_mid_s, fixes.position_enu_m[:, :2])
        return np.where((nearest_s < _NEAR_FIX_S)[:, None], place_m, np.nan)

    return places


def locate(dive: Dive, row: int, places: Positions) -> BeaconPlace | None:
    """Least squares for a beacon's place, robust, from many displacements; None: too few replies.

        min over d of  Σ ρ(½ c (T - h(p - d))),   ρ(r) = r² / (1 + (r / 3 m)²)

    with p the vehicle's places at ping and reply, moved the other way instead of the beacon.
    """
    replies = dive.replies[dive.replies.beacon == row]
    if len(replies) < _LEAST_REPLIES:
        return None
    geometry = ray_geometry(replies, dive.sound_speed)
    ping_m, reply_m = places(replies.t_ping_s), places(replies.t_reply_s)
    usable = is_physical(geometry, replies.travel_time_s, 0.01)
    usable &= np.isfinite(ping_m).all(axis=1) & np.isfinite(reply_m).all(axis=1)
    if usable.sum() < _LEAST_REPLIES:
        return None
    return _located(geometry[usable], ping_m[usable], reply_m[usable])


def _located(geometry: RayGeometry, ping_m: Float, reply_m: Float) -> BeaconPlace:
    half_mps = 0.5 * geometry.speed_ping_mps

    def missed(moved_m: Float) -> tuple[Float, Float]:
        """Miss (n,) m of the ranges, and its gradient (n, 2) by the beacon's place."""
        model = predict_travel_time(ping_m - moved_m, reply_m - moved_m, geometry)
        gradient = model.gradient_ping_spm + model.gradient_reply_spm
        late_s = geometry.flight_time_s - model.time_s
        return half_mps * late_s, half_mps[:, None] * gradient

    best_m = min(_displacements(), key=lambda moved_m: _cost(missed(moved_m)[0]))
    for _ in range(_STEPS):
        left_m, gradient = missed(best_m)
        weighted = gradient * _weight(left_m)[:, None]
        information = weighted.T @ gradient + 1e-6 * np.eye(2)
        best_m = best_m - np.linalg.solve(information, weighted.T @ left_m)
    left_m, gradient = missed(best_m)
    near = np.abs(left_m) < 2 * _SCALE_M
    scatter_m = 1.4826 * float(np.median(np.abs(left_m[near]))) if near.any() else _SCALE_M
    weighted = gradient * _weight(left_m)[:, None]
    cov_m2 = scatter_m**2 * np.linalg.inv(weighted.T @ gradient + 1e-6 * np.eye(2))
    late_m, cost_of_late = _late(missed(np.zeros(2))[0])
    gain = (cost_of_late - _cost(left_m)) / (2 * max(scatter_m, 0.1) ** 2)
    return BeaconPlace(
        best_m,
        float(np.sqrt(0.5 * np.trace(cov_m2))),
        late_m / float(np.mean(half_mps)),
        gain - 0.5 * float(np.log(len(geometry))),
        len(geometry),
    )


def _displacements() -> list[Float]:
    angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    ring = np.column_stack([np.sin(angle), np.cos(angle)])
    return [np.zeros(2), *np.concatenate([r * ring for r in _RINGS_M[1:]])]


def _weight(left_m: Float) -> Float:
    return np.asarray(1 / (1 + (left_m / _SCALE_M) ** 2) ** 2)


def _cost(left_m: Float) -> float:
    return float(np.sum(left_m**2 / (1 + (left_m / _SCALE_M) ** 2)))


def _late(left_m: Float) -> tuple[float, float]:
    """One lateness (m) that all replies share, and the robust sum of squares that it leaves."""
    tried_m = np.quantile(left_m, np.linspace(0.05, 0.95, 37))
    best_m = float(min(tried_m, key=lambda late_m: _cost(left_m - late_m)))
    for _ in range(_STEPS):
        weight = _weight(left_m - best_m)
        best_m = float(np.sum(weight * left_m) / np.sum(weight))
    return best_m, _cost(left_m - best_m)
