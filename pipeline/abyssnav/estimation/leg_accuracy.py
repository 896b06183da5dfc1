# SPDX-License-Identifier: Apache-2.0
"""95 % radius of each leg of the smoothed track, judged without truth."""

from dataclasses import replace
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import RayGeometry
from abyssnav.estimation.consistency import forward_backward, widest_covariance
from abyssnav.estimation.left_out import leave_beacons_out
from abyssnav.estimation.smoother import SmootherResult, positions, sound_scale
from abyssnav.estimation.two_state import ACCEPTED
from abyssnav.geometry import interpolate, wrap_angle
from abyssnav.tables import (
    Fixes,
    Float,
    Heading,
    Int,
    LegAccuracy,
    Replies,
    Track,
    Velocity,
)

_TURN_RAD = np.radians(30.0)  #: change of course over a minute that ends a leg
_SHORTEST_LEG_S, _LONGEST_LEG_S = 120.0, 1800.0
#: Variance of what a left-out beacon's replies miss, in units of σ_b²: 1 by its own error, and that
#: of the track made without it, which for two coordinates by three other beacons is 2 / 3.
_LEFT_OUT_GAIN = 5 / 3
_SILENCE_S = 60.0  #: without a compass, over which nobody knows where the vehicle went
_CROSSING_STEP_S, _CROSSING_REACH_S = 60.0, 60.0
#: What fixes may differ from a good track by: they take the vehicle for one at rest.
_FIX_BIAS_M = 2.0


class LegEvidence(NamedTuple):
    """The usable replies, what the smoother made of them, and the fixes."""

    replies: Replies
    geometry: RayGeometry
    decision: Int
    result: SmootherResult
    fixes: Fixes


def without_compass(legs: LegAccuracy, heading: Heading, velocity: Velocity) -> LegAccuracy:
    """The same legs, with what no filter can know of a minute or more without a compass.

    The DVL's last velocity is held in the body's frame, and the heading between the stamps before
    and after the silence is a guess: between two known places, the vehicle may be off by half of
    what it runs in that time, v T / 2, which is added to the radius in quadrature.
    """
    begin_s, end_s = heading.t_s[:-1], heading.t_s[1:]
    silent = end_s - begin_s > _SILENCE_S
    if not silent.any():
        return legs
    speed_mps = np.linalg.norm(velocity.velocity_body_mps[velocity.valid, :2], axis=1)
    reach_m = 0.5 * float(np.median(speed_mps)) * (end_s - begin_s)[silent]
    overlap = (begin_s[silent] < legs.t_end_s[:, None]) & (end_s[silent] > legs.t_begin_s[:, None])
    lost_m = np.max(np.where(overlap, reach_m, 0.0), axis=1)
    return replace(legs, uncertainty_95_m=np.hypot(legs.uncertainty_95_m, lost_m))


def beside_filter(legs: LegAccuracy, smoothed: Track, real_time: Track) -> LegAccuracy:
    """The same legs, with the rms distance of the real-time track from the final one.

    Parameters
    ----------
    smoothed, real_time : tracks of the same instants; the second begins later
    """
    apart_m = _apart(smoothed, real_time, legs.t_begin_s, legs.t_end_s)
    return replace(legs, filter_smoother_m=apart_m)


def leg_accuracy(evidence: LegEvidence, smoothed: Track) -> LegAccuracy:
    """A 95 % horizontal radius for each leg, widened by what the dive itself contradicts.

    The smoother's covariance Σ = Σ_n + Σ_c, of the nodes with known constants and by the constants,
    holds what is stated and learned; in Σ_n no noise is below the stated.  Three comparisons may
    widen it:

    - each beacon's replies with the track made without that beacon: what they miss beyond the
      expected, e² = left_out² - χ² expected², is taken for beacon errors of variance
      σ_b² = e² / (1 + 2/3), which move a position by σ_b² (Uᵀ U)⁻¹ with U the directions to the
      beacons; χ² is the 95 % bound of a mean of as many squares as there are beacons;
    - the filter run forward with the one run backward, which share the constants and the compass
      but no reply: the rms of their distance over what both claim inflates that part of Σ which the
      constants do not explain, where above one;
    - the consistent fixes of the leg: the distance b by which their median misses the track, less
      what the sound speed learned since moves them by, their scatter's share and two metres, is
      added as b bᵀ.

        radius = K₉₅(inflation² Σ_n + Σ_c + σ_b² (Uᵀ U)⁻¹ + b bᵀ)

    Parameters
    ----------
    smoothed : every few seconds
    """
    result, speed_mps = evidence.result, evidence.geometry.mean_speed_mps
    begin_s, end_s = _legs(smoothed)
    accepted = evidence.decision == ACCEPTED
    rows = _within(smoothed.t_s, begin_s, end_s)
    used = _within(evidence.replies.t_reply_s, begin_s, end_s)
    leg_rows = [r.start + np.flatnonzero(accepted[r]) for r in used]
    left_out_m, expected_m = (
        0.5 * evidence.geometry.speed_reply_mps * values_s
        for values_s in leave_beacons_out(result.setting, result.estimate)
    )
    out_m = np.array([_rms(left_out_m[h]) for h in leg_rows])
    out_expected_m = np.array([_rms(expected_m[h]) for h in leg_rows])
    apart_m, claimed_m = forward_backward(result)
    nodes = _within(result.posterior.problem.t_node_s, begin_s, end_s)
    inflation = float(np.fmax(1.0, _rms(apart_m / claimed_m)))
    excess_m2 = _excess(
        out_m,
        out_expected_m,
        (_rms(left_out_m[accepted]), _rms(expected_m[accepted])),
        len(np.unique(evidence.replies.beacon[accepted])),
    )
    cov_m2 = _widest(result, smoothed, rows, inflation) + _fix_bias(evidence, begin_s, end_s, used)
    cov_m2 += excess_m2[:, None, None] / _LEFT_OUT_GAIN * _dilution(evidence, speed_mps, leg_rows)
    steps_m = np.array([np.diff(smoothed.position_enu_m[r, :2], axis=0).sum(axis=0) for r in rows])
    return LegAccuracy(
        t_begin_s=begin_s,
        t_end_s=end_s,
        course_rad=np.arctan2(steps_m[:, 0], steps_m[:, 1]) % (2 * np.pi),
        length_m=np.array([_run(smoothed.position_enu_m[r, :2]) for r in rows]),
        n_replies=np.array([len(h) for h in leg_rows]),
        formal_95_m=radius_95(_means(smoothed.position_cov_m2, rows)),
        left_out_m=out_m,
        left_out_expected_m=out_expected_m,
        filter_smoother_m=np.full(len(begin_s), np.nan),  # see `beside_filter`
        forward_backward_m=np.array([_rms(apart_m[n]) for n in nodes]),
        crossing_m=_crossings(evidence, smoothed, begin_s, end_s, 0.5 * speed_mps),
        uncertainty_95_m=radius_95(cov_m2),
    )


def radius_95(cov_m2: Float) -> Float:
    """Radius (n,) that holds 95 % of a horizontal Gaussian of covariance (n, 2, 2).

    K(C) σ_max with C = σ_min / σ_max; the cubic is within 0.2 % of the exact quantile
    (P. Leenhouts, "On the Computation of Bi-Normal Radial Error", Navigation 32, 1985).
    """
    largest, smallest = _eigenvalues(cov_m2)
    ratio = np.sqrt(np.maximum(smallest, 0) / np.maximum(largest, 1e-300))
    factor = 1.960790 + ratio * (0.004071 + ratio * (0.114276 + ratio * 0.371625))
    return np.asarray(factor * np.sqrt(largest))


def _widest(result: SmootherResult, smoothed: Track, rows: list[slice], inflation: float) -> Float:
    """Mean covariance (n, 2, 2) of each leg: the track's, or the larger one of stated noise."""
    t_node_s = result.posterior.problem.t_node_s
    stated_m2 = interpolate(smoothed.t_s, t_node_s, widest_covariance(result, inflation))
    larger = np.trace(stated_m2, axis1=1, axis2=2) > np.trace(
        smoothed.position_cov_m2, axis1=1, axis2=2
    )
    return _means(np.where(larger[:, None, None], stated_m2, smoothed.position_cov_m2), rows)


def _means(values: Float, rows: list[slice]) -> Float:
    """Mean of the values (m, ...) over each stretch."""
    return np.array([values[r].mean(axis=0) for r in rows])


def _excess(out_m: Float, expected_m: Float, whole_m: tuple[float, float], n_beacons: int) -> Float:
    """Variance (n,) m² by which left-out beacons miss more than chance lets them, by leg."""
    bound = _chi2_mean_95(max(n_beacons, 1))
    by_leg = out_m**2 - bound * expected_m**2
    whole = whole_m[0] ** 2 - bound * whole_m[1] ** 2
    return np.nan_to_num(np.fmax(np.fmax(by_leg, whole), 0.0))


def _chi2_mean_95(freedom: int) -> float:
    """95 % bound of a mean of squares, χ²_ν / ν (E. B. Wilson and M. M. Hilferty, 1931)."""
    spread = 2 / (9 * freedom)
    return float((1 - spread + NormalDist().inv_cdf(0.95) * spread**0.5) ** 3)


def _fix_bias(evidence: LegEvidence, begin_s: Float, end_s: Float, used: list[slice]) -> Float:
    """Products b bᵀ (n, 2, 2) m², b what the consistent fixes of each leg miss the track by.

    Parameters
    ----------
    used : replies of each leg
    """
    good = evidence.fixes[evidence.fixes.consistent]
    off_m = good.position_enu_m[:, :2] - positions(evidence.result.posterior, good.t_mid_s)
    product = np.zeros((len(begin_s), 2, 2))
    for leg, rows in enumerate(_within(good.t_mid_s, begin_s, end_s)):
        if rows.stop - rows.start < 3:
            continue
        there_m = off_m[rows] - _moved_by_sound(evidence, used[leg])
        bias_m = np.median(there_m, axis=0)
        scatter_m = 1.4826 * np.median(np.abs(there_m - bias_m), axis=0)
        chance_m = 3 * float(np.hypot(*scatter_m)) / np.sqrt(rows.stop - rows.start)
        distance_m = float(np.hypot(*bias_m))
        beyond = max(0.0, distance_m - chance_m - _FIX_BIAS_M) / max(distance_m, 1e-9)
        product[leg] = np.outer(bias_m * beyond, bias_m * beyond)
    return product


def _moved_by_sound(evidence: LegEvidence, rows: slice) -> Float:
    """What fixes miss (2,) m for the sound speed that was learned: h δ = k T, h = ∂T/∂p."""
    toward = evidence.result.by_position_spm[rows]
    scale = sound_scale(evidence.result.posterior, evidence.replies.t_reply_s[rows])
    late_s = scale * evidence.geometry.flight_time_s[rows]
    return np.asarray(np.linalg.lstsq(toward, late_s, rcond=None)[0])


def _eigenvalues(cov: Float) -> tuple[Float, Float]:
    middle = 0.5 * (cov[:, 0, 0] + cov[:, 1, 1])
    apart = np.hypot(0.5 * (cov[:, 0, 0] - cov[:, 1, 1]), cov[:, 0, 1])
    return middle + apart, middle - apart


def _rms(values: Float) -> float:
    """Root mean square of what is known; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def _run(position_m: Float) -> float:
    return float(np.hypot(*np.diff(position_m, axis=0).T).sum())


def _legs(track: Track) -> tuple[Float, Float]:
    """Begin and end of every stretch without a turn, none longer than half an hour."""
    every_s = np.arange(track.t_s[0], track.t_s[-1] + 1e-9, 30.0)
    heading = interpolate(every_s, track.t_s, np.unwrap(track.heading_rad))
    turning = np.zeros(len(every_s), dtype=bool)
    turning[2:] = np.abs(wrap_angle(heading[2:] - heading[:-2])) > _TURN_RAD
    edges, last = [float(every_s[0])], float(track.t_s[-1])
    for t in [*every_s[turning].tolist(), last]:
        while t - edges[-1] > _LONGEST_LEG_S:
            edges.append(edges[-1] + _LONGEST_LEG_S)
        if t - edges[-1] >= _SHORTEST_LEG_S:
            edges.append(float(t))
    edges[-1] = last
    if len(edges) == 1:
        edges.append(last)
    return np.array(edges[:-1]), np.array(edges[1:])


def _dilution(evidence: LegEvidence, speed_mps: float, leg_rows: list[Int]) -> Float:
    """(Uᵀ U)⁻¹ (n, 2, 2) of the directions to the beacons, mean over each leg's replies."""
    unit = 0.5 * speed_mps * evidence.result.by_position_spm
    product = unit[:, :, None] * unit[:, None, :]
    n_beacons = len(np.unique(evidence.replies.beacon))
    width = max(8 * n_beacons, 16)
    summed = np.cumsum(np.concatenate([np.zeros((1, 2, 2)), product]), axis=0)
    high = np.minimum(np.arange(len(unit)) + width // 2, len(unit))
    low = np.maximum(np.arange(len(unit)) - width // 2, 0)
    mean = (summed[high] - summed[low]) / (high - low)[:, None, None]
    spread = np.linalg.inv(mean * n_beacons + 1e-9 * np.eye(2))
    return np.array([spread[rows].mean(axis=0) if len(rows) else np.eye(2) for rows in leg_rows])


def _within(t_s: Float, begin_s: Float, end_s: Float) -> list[slice]:
    """Rows of rising instants inside each stretch."""
    first, end = np.searchsorted(t_s, begin_s), np.searchsorted(t_s, end_s, side="right")
    return [slice(i, j) for i, j in zip(first.tolist(), end.tolist(), strict=True)]


def _apart(smoothed: Track, other: Track, begin_s: Float, end_s: Float) -> Float:
    """Rms distance of another track on each leg; NaN where it is not."""
    best_m = smoothed.position_enu_m[np.searchsorted(smoothed.t_s, other.t_s)]
    apart_m = np.hypot(*(other.position_enu_m - best_m)[:, :2].T)
    return np.array([_rms(apart_m[rows]) for rows in _within(other.t_s, begin_s, end_s)])


def _crossings(
    evidence: LegEvidence, smoothed: Track, begin_s: Float, end_s: Float, half_speed_mps: float
) -> Float:
    """Rms difference of a beacon's residuals between both passes of each crossing, by leg (m)."""
    once_s, again_s = crossing_times(smoothed)
    differences: list[list[float]] = [[] for _ in begin_s]
    late_m = half_speed_mps * evidence.result.residual_s
    for beacon in np.unique(evidence.replies.beacon):
        rows = np.flatnonzero((evidence.decision == ACCEPTED) & (evidence.replies.beacon == beacon))
        t_s = evidence.replies.t_reply_s[rows]
        if not len(rows):
            continue
        first, second = _nearest(t_s, once_s), _nearest(t_s, again_s)
        near = np.abs(t_s[first] - once_s) < _CROSSING_REACH_S
        near &= np.abs(t_s[second] - again_s) < _CROSSING_REACH_S
        apart_m = late_m[rows[first]] - late_m[rows[second]]
        for leg, (b, e) in enumerate(zip(begin_s, end_s, strict=True)):
            inside = ((once_s >= b) & (once_s <= e)) | ((again_s >= b) & (again_s <= e))
            differences[leg] += apart_m[near & inside].tolist()
    return np.array([_rms(np.array(values)) for values in differences])


def _nearest(t_s: Float, wanted_s: Float) -> Int:
    right = np.clip(np.searchsorted(t_s, wanted_s), 1, max(len(t_s) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(t_s) - 1)
    return np.asarray(np.where(wanted_s - t_s[left] <= t_s[right] - wanted_s, left, right))


def crossing_times(track: Track) -> tuple[Float, Float]:
    """Both instants of every crossing of the track with itself, from chords of a minute."""
    every_s = np.arange(track.t_s[0], track.t_s[-1] + 1e-9, _CROSSING_STEP_S)
    p = interpolate(every_s, track.t_s, track.position_enu_m[:, :2])
    d = np.diff(p, axis=0)
    i, j = _near_pairs(p[:-1] + 0.5 * d, float(np.hypot(*d.T).max(initial=0.0)))
    between = p[j] - p[i]

    def cross(a: Float, b: Float) -> Float:
        return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])

    with np.errstate(divide="ignore", invalid="ignore"):
        scale = cross(d[i], d[j])
        s, t = cross(between, d[j]) / scale, cross(between, d[i]) / scale
    hit = (s >= 0) & (s < 1) & (t >= 0) & (t < 1)
    return (
        every_s[i[hit]] + s[hit] * _CROSSING_STEP_S,
        every_s[j[hit]] + t[hit] * _CROSSING_STEP_S,
    )


def _near_pairs(middle_m: Float, reach_m: float) -> tuple[Int, Int]:
    """Pairs i + 1 < j of points (n, 2) no farther apart than `reach_m` on either axis."""
    order = np.argsort(middle_m[:, 0], kind="stable")
    east = middle_m[order, 0]
    place = np.arange(len(order))
    count = np.searchsorted(east, east + reach_m, side="right") - place - 1
    first = np.repeat(place, count)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    one, other = order[first], order[second]
    i, j = np.minimum(one, other), np.maximum(one, other)
    near = (np.abs(middle_m[i, 1] - middle_m[j, 1]) <= reach_m) & (j > i + 1)
    i, j = i[near], j[near]
    in_turn = np.lexsort((j, i))
    return i[in_turn], j[in_turn]
