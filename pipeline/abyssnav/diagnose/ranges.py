# SPDX-License-Identifier: Apache-2.0
"""Small errors by single replies: a beacon displaced, turn-around, water, lever arm, clock."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import is_physical, predict_travel_time, ray_geometry
from abyssnav.diagnose.course import Course, lost_variance
from abyssnav.diagnose.motion import SOUND, Scored, error_columns, predicted
from abyssnav.diagnose.regression import (
    Prepared,
    Regression,
    prepare,
    prior_sigmas,
    robust_inflation,
)
from abyssnav.geometry import pairs
from abyssnav.tables import Dive, Float, Int, Replies

#: Replies spread over the dive that are enough.
_MOST_REPLIES = 450
_LEAST_REPLIES = 20
#: Replies farther than this from the track that fixes and dead reckoning make are other paths.
_REACH_M = 80.0
#: Noise of a one-way range, and random walk of dead reckoning beside its errors.
_NOISE_M, _WALK_M2_PER_S = 1.6, 0.003
#: Sigma of each kind of error of a sound survey: m, ms, share.
_SURVEYED: Mapping[str, float] = {"beacon": 0.5, "wait": 0.3, "common_wait": 0.6, "sound": 0.0015}


@dataclass(frozen=True)
class Suspect:
    """An error that is wide under it, the others as of sound instruments."""

    name: str
    beacon: int  #: row of the beacon, -1: none
    wide: Mapping[str, float]
    penalty: float = 0.0  #: how much less likely it is before any data, nats


@dataclass(frozen=True, eq=False)
class Suspected:
    """A suspect with its evidence, and the parameters by name."""

    suspect: Suspect
    log_likelihood: float
    value: Mapping[str, Float]


def suspects(n_beacons: int, wide: Mapping[str, float]) -> list[Suspect]:
    """All that are tried; `wide` is what the reading of compass and DVL has wide anyway."""
    trials = [
        Suspect("", -1, wide),
        Suspect("turn_around", -1, {**wide, "common_wait": 15.0}, 1.0),
        Suspect("sound_speed", -1, {**wide, "sound": 0.03}),
        Suspect("lever_arm", -1, {**wide, "lever": 5.0}),
        Suspect("clock_offset", -1, {**wide, "clock": 10.0}, 5.0),
        Suspect("heading", -1, {**wide, "turn": 0.3}),
        Suspect("dvl_scale", -1, {**wide, "scale": 0.1}),
        Suspect("water_track", -1, {**wide, "current": 0.1, "slow_current": 0.05}),
        Suspect("water_track", -1, {**wide, "slow_current": 0.15}),
        Suspect("slow_velocity", -1, {**wide, "slow_bow": 0.04}, 15.0),
        Suspect("slow_heading", -1, {**wide, "slow_turn": 0.1}, 8.0),
        Suspect("deviation", -1, {**wide, "deviation_1": 0.1, "deviation_2": 0.04}),
        Suspect("beacons", -1, {**wide, **{f"beacon_{k}": 5.0 for k in range(n_beacons)}}, 1.0),
    ]
    for k in range(n_beacons):
        trials += [
            Suspect("beacon_moved", k, {**wide, f"beacon_{k}": size_m}, 2.0)
            for size_m in (5.0, 40.0)
        ]
        trials.append(Suspect("turn_around", k, {**wide, f"wait_{k}": 8.0}, 2.0))
    return trials


def score_suspects(dive: Dive, replies: Replies, course: Course, motion: Scored) -> list[Suspected]:
    """Every small error by its evidence, the likeliest first; none: too few replies.

    Each reply's range is compared with the track that the fixes and dead reckoning make, once
    linear in every error:

        ½ c (T - h(p̂)) = -u · (p - p̂) - u · d_beacon + ½ c τ + ρ k + noise
    """
    rows = _rows(dive, replies, course, motion)
    if rows is None:
        return []
    problem, sound = rows
    trial = suspects(len(dive.beacons), motion.reading.wide)
    inflation = np.zeros(len(problem.y))
    for _ in range(2):
        best = _scored(trial, problem, sound, inflation)[0].suspect
        sigma = prior_sigmas(problem.names, {**sound, **best.wide})
        inflation = robust_inflation(problem, sigma)
    return _scored(trial, problem, sound, inflation)


def _scored(
    trial: list[Suspect], problem: Regression, sound: Mapping[str, float], inflation: Float
) -> list[Suspected]:
    base = prepare(problem, prior_sigmas(problem.names, sound), inflation)
    result = [_suspected(suspect, base, problem.names, sound) for suspect in trial]
    return sorted(result, key=lambda s: -s.log_likelihood)


def _suspected(
    suspect: Suspect, base: Prepared, names: tuple[str, ...], sound: Mapping[str, float]
) -> Suspected:
    result = base.fit(prior_sigmas(names, {**sound, **suspect.wide}))
    groups = np.array(names)
    value = {name: result.value[groups == name] for name in dict.fromkeys(names)}
    return Suspected(suspect, result.log_likelihood - suspect.penalty, value)


def _rows(
    dive: Dive, replies: Replies, course: Course, motion: Scored
) -> tuple[Regression, dict[str, float]] | None:
    """The regression of all single replies, and the sigmas of sound instruments."""
    geometry = ray_geometry(replies, dive.sound_speed)
    physical = is_physical(geometry, replies.travel_time_s, 0.01)
    t_s = 0.5 * (replies.t_ping_s + replies.t_reply_s)
    physical &= (t_s >= motion.span_s[0] - 120) & (t_s <= motion.span_s[1] + 120)
    replies, geometry, t_s = replies[physical], geometry[physical], t_s[physical]
    if len(replies) < _LEAST_REPLIES:
        return None
    ping_m, reply_m = (
        pairs(predicted(motion, course, t, motion.span_s))
        for t in (replies.t_ping_s, replies.t_reply_s)
    )
    model = predict_travel_time(ping_m, reply_m, geometry)
    half_mps = 0.5 * geometry.speed_ping_mps
    missed_m = half_mps * (geometry.flight_time_s - model.time_s)
    near = np.flatnonzero(np.abs(missed_m) < _REACH_M)
    if len(near) < _LEAST_REPLIES:
        return None
    near = near[np.unique(np.linspace(0, len(near) - 1, _MOST_REPLIES).astype(int))]
    near = near[np.argsort(t_s[near], kind="stable")]
    gradient = (model.gradient_ping_spm + model.gradient_reply_spm)[near] * half_mps[near, None]
    columns, names = error_columns(course, t_s[near], motion.span_s)
    value = np.concatenate([motion.value[name] for name in dict.fromkeys(names)])
    along = gradient[:, :1] * columns.real + gradient[:, 1:] * columns.imag
    height = 0.5 * (geometry.height_ping_m + geometry.height_reply_m)[near]
    range_m = (half_mps * model.time_s)[near]
    of_range = _RangeErrors(
        replies.beacon[near],
        np.column_stack([-gradient, -height / range_m]),
        1e-3 * half_mps[near],
        range_m,
    )
    acoustic, kinds = _acoustic_columns(of_range, len(dive.beacons))
    lost_m2 = lost_variance(dive, t_s[near])
    grown = _WALK_M2_PER_S * (t_s[near] - t_s[near][0]) + lost_m2 - lost_m2[0]
    cosines = gradient @ gradient.T
    noise = cosines * np.minimum.outer(grown, grown) + np.diag(np.full(len(near), _NOISE_M**2))
    problem = Regression(
        missed_m[near] + along @ value,
        noise,
        np.column_stack([along, acoustic]),
        (*names, *kinds),
    )
    return problem, _sound(dive)


def _sound(dive: Dive) -> dict[str, float]:
    """Sigma of every error of sound instruments, the beacons' as stated."""
    sound = {**SOUND, "common_wait": _SURVEYED["common_wait"], "sound": _SURVEYED["sound"]}
    for row, stated_m in enumerate(dive.beacons.sigma_m.tolist()):
        sound[f"beacon_{row}"] = max(stated_m or _SURVEYED["beacon"], 0.3)
        sound[f"wait_{row}"] = _SURVEYED["wait"]
    return sound


class _RangeErrors(NamedTuple):
    """What changes each reply's range."""

    beacon: Int  #: (n,) that answered
    by_place: Float  #: (n, 3) by its place east, north, up
    by_wait: Float  #: (n,) m by 1 ms of its turn-around
    by_sound: Float  #: (n,) m by the relative error of the sound speed


def _acoustic_columns(of_range: _RangeErrors, n_beacons: int) -> tuple[Float, list[str]]:
    """Range (m) by each beacon's place (east, north, up) in m, waits in ms, and sound speed."""
    columns, names = list[Float](), list[str]()
    for row in range(n_beacons):
        own = of_range.beacon == row
        columns += [*np.where(own, of_range.by_place.T, 0.0), np.where(own, of_range.by_wait, 0.0)]
        names += [*[f"beacon_{row}"] * 3, f"wait_{row}"]
    columns += [of_range.by_wait, of_range.by_sound]
    return np.column_stack(columns), [*names, "common_wait", "sound"]
