# SPDX-License-Identifier: Apache-2.0
"""How far each leg of the smoothed track can be trusted, judged without truth."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import Legs, flight
from abyssnav.estimation.map_estimator import Batch, left_out
from abyssnav.estimation.model import N_STATES, ErrorModel, Steps, displacement, observe
from abyssnav.estimation.smoother import turned
from abyssnav.estimation.two_state import ACCEPTED
from abyssnav.estimation.update import Judge, drift
from abyssnav.geometry import interpolate, wrap_angle
from abyssnav.tables import (
    Beacons,
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
#: A beacon's own error and that of the track made without it, in units of the beacon's variance.
_LEFT_OUT_GAIN = 5 / 3
_SILENCE_S = 60.0  #: without a compass, over which nobody knows where the vehicle went
_CROSSING_STEP_S, _CROSSING_REACH_S = 60.0, 60.0
_DIAGONAL = slice(None, None, N_STATES + 1)  #: of a matrix laid out in a row


class Hindsight(NamedTuple):
    """The usable replies, and what the smoother made of them (n rows each)."""

    replies: Replies
    ping: Int
    legs: Legs
    steps: Steps
    batch: Batch
    decision: Int
    model: ErrorModel
    judge: Judge


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


def leg_accuracy(of: Hindsight, beacons: Beacons, smoothed: Track, real_time: Track) -> LegAccuracy:
    """A 95 % horizontal radius for each leg, from what the dive itself contradicts.

    The smoother's covariance Σ knows noise, not a misplaced beacon or a wrong profile.  These show
    when a beacon's replies are predicted from a track made without that beacon.  What these miss
    beyond the expected, e² = left_out² - expected², is taken for beacon errors of variance
    σ_b² = e² / (1 + 2/3), or those stated if larger, which move a position by σ_b² (Uᵀ U)⁻¹ with U
    the directions to the beacons; estimated from few beacons, σ_b² is taken larger by F(2, ν) over
    F(2, ∞) at 95 %, ν = 2 n_beacons - 3.  Then

        radius = K₉₅(inflation² Σ + σ_b² (Uᵀ U)⁻¹)

    where the inflation is the largest of one and the ratio by which the forward and the backward
    filter, which share no past, differ against their own claims.

    Parameters
    ----------
    smoothed, real_time : tracks of the same instants, every few seconds; the second begins later
    """
    begin_s, end_s = _legs(smoothed)
    left_out_m, expected_m = _left_out(of)
    backward_m, claimed_m = _backward(of)
    speed_mps = float(np.mean(of.legs.speed_reply_mps))
    t_s, accepted = of.replies.t_reply_s, of.decision == ACCEPTED
    rows = _within(smoothed.t_s, begin_s, end_s)
    heard = [r.start + np.flatnonzero(accepted[r]) for r in _within(t_s, begin_s, end_s)]
    formal_m2 = np.array([smoothed.position_cov_m2[r].mean(axis=0) for r in rows])
    whole = (_rms(left_out_m[accepted]), _rms(expected_m[accepted]))
    out_m = np.array([_rms(left_out_m[h]) for h in heard])
    out_expected_m = np.array([_rms(expected_m[h]) for h in heard])
    excess_m2 = np.fmax(out_m**2 - out_expected_m**2, whole[0] ** 2 - whole[1] ** 2)
    stated_m2 = float(np.mean(beacons.sigma_m**2))
    inferred_m2 = np.nan_to_num(excess_m2) / _LEFT_OUT_GAIN * _few(2 * len(beacons) - 3)
    beacon_m2 = np.fmax(inferred_m2, stated_m2)
    inflation2 = max(1.0, (_rms(backward_m[accepted]) / _rms(claimed_m[accepted])) ** 2)
    spread = _dilution(of, speed_mps)
    cov_m2 = inflation2 * formal_m2 + beacon_m2[:, None, None] * np.array(
        [np.nanmean(spread[h], axis=0) if len(h) else np.eye(2) for h in heard]
    )
    steps_m = np.array([np.diff(smoothed.position_enu_m[r, :2], axis=0).sum(axis=0) for r in rows])
    return LegAccuracy(
        t_begin_s=begin_s,
        t_end_s=end_s,
        course_rad=np.arctan2(steps_m[:, 0], steps_m[:, 1]) % (2 * np.pi),
        length_m=np.array([_run(smoothed.position_enu_m[r, :2]) for r in rows]),
        n_replies=np.array([len(h) for h in heard]),
        formal_95_m=radius_95(formal_m2),
        left_out_m=out_m,
        left_out_expected_m=out_expected_m,
        filter_smoother_m=_apart(smoothed, real_time, begin_s, end_s),
        forward_backward_m=np.array([_rms(backward_m[h]) for h in heard]),
        crossing_m=_crossings(of, smoothed, begin_s, end_s, 0.5 * speed_mps),
        uncertainty_95_m=radius_95(cov_m2),
    )


def radius_95(cov_m2: Float) -> Float:
    """Radius (n,) that holds 95 % of a horizontal Gaussian of covariance (n, 2, 2).

    K(C) σ_max with C = σ_min / σ_max; the cubic is within 0.1 % of the exact quantile.
    """
    largest, smallest = _eigenvalues(cov_m2)
    ratio = np.sqrt(np.maximum(smallest, 0) / np.maximum(largest, 1e-300))
    factor = 1.960790 + ratio * (0.004071 + ratio * (0.114276 + ratio * 0.371625))
    return np.asarray(factor * np.sqrt(largest))


def _few(freedom: int) -> float:
    """F(2, ν) / F(2, ∞) at 95 %: how much larger a variance from ν degrees of freedom must count.

    F_p(2, ν) = ν / 2 · ((1 - p)^(-2 / ν) - 1),    F_p(2, ∞) = -ln(1 - p)
    """
    return float(0.5 * freedom * (0.05 ** (-2 / freedom) - 1) / -np.log(0.05))


def _eigenvalues(cov: Float) -> tuple[Float, Float]:
    middle = 0.5 * (cov[:, 0, 0] + cov[:, 1, 1])
    apart = np.hypot(0.5 * (cov[:, 0, 0] - cov[:, 1, 1]), cov[:, 0, 1])
    return middle + apart, middle - apart


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


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


def _left_out(of: Hindsight) -> tuple[Float, Float]:
    """One-way misfit of each reply to the track made without its beacon, and the expected (m)."""
    missed_s, variance_s2 = left_out(
        of.batch,
        of.steps,
        of.legs,
        of.model,
        of.decision == ACCEPTED,
        of.replies.beacon,
    )
    half_mps = 0.5 * of.legs.speed_reply_mps
    return half_mps * missed_s, half_mps * np.sqrt(variance_s2)


def _backward(of: Hindsight) -> tuple[Float, Float]:
    """Distance of a filter run backwards from the smoothed track, and what it claims (n,) m.

    On the accepted replies in the opposite order, from the smoothed end: reversed running sums make
    every displacement negative, and the state still lives at the reply.  NaN for the others.
    """
    rows = np.flatnonzero(of.decision == ACCEPTED)[::-1]
    apart_m, claimed_m = np.full((2, len(of.ping)), np.nan)
    if len(rows):
        back = turned(of.steps[rows[::-1]])
        x, P = linear_filter(
            of.batch.x[rows], back, of.legs[rows], of.batch.sigma_s[rows], of.model
        )
        apart_m[rows] = np.hypot(*x[:, :2].T)
        claimed_m[rows] = np.sqrt(np.trace(P, axis1=1, axis2=2))
    return apart_m, claimed_m


def linear_filter(
    x: Float, steps: Steps, legs: Legs, sigma_s: Float, model: ErrorModel
) -> tuple[Float, Float]:
    """The augmented filter over replies that are all believed, linearised at known states.

        δ_k = F δ_{k-1} + f(x_{k-1}) - x_k,     δ_k += K (T - h(x_k) - H δ_k)

    It begins at the first position with everything else unknown.  With nothing to be judged, all
    derivatives are made at once, and a reply costs a fifth of what it costs the real-time filter.

    Parameters
    ----------
    x : (n, 11) states at the replies
    steps, legs, sigma_s : n rows

    Returns
    -------
    apart, position_cov_m2 : (n, 11) the filter's states minus x, and (n, 2, 2)
    """
    fade, noise = drift(steps, model)
    run_m, linear_m = np.diff(steps.run_m, axis=0), np.diff(steps.linear_m, axis=0)
    d_m, by_state = displacement(x[:-1], run_m, linear_m)
    F = fade[1:, None, :] * np.eye(N_STATES)
    F[:, :2] += by_state
    missed = fade[1:] * x[:-1] - x[1:]
    missed[:, :2] += d_m
    predicted_s, H = observe(x, steps, legs)
    late_s, R = (legs.flight_time_s - predicted_s).tolist(), (sigma_s**2).tolist()
    apart, cov_m2 = np.empty_like(x), np.empty((len(x), 2, 2))
    delta, P = -x[0], np.diag(model.prior_variance())
    delta[:2] = 0.0
    apart[0], cov_m2[0] = delta, P[:2, :2]
    for k in range(1, len(x)):
        step, h = F[k - 1], H[k]
        delta = step.dot(delta) + missed[k - 1]
        P = step.dot(P).dot(step.T)
        P.ravel()[_DIAGONAL] += noise[k]
        PH = P.dot(h)
        S = h.dot(PH).item() + R[k]
        delta += PH * ((late_s[k] - h.dot(delta).item()) / S)
        P -= PH[:, None] * (PH / S)
        apart[k], cov_m2[k] = delta, P[:2, :2]
    return apart, cov_m2


def _dilution(of: Hindsight, speed_mps: float) -> Float:
    """(Uᵀ U)⁻¹ (n, 2, 2) of the directions to the beacons heard around each reply."""
    here = flight(of.batch.x[:, :2], of.batch.x[:, :2], of.legs)
    unit = 0.5 * speed_mps * (here.gradient_ping_spm + here.gradient_reply_spm)
    product = unit[:, :, None] * unit[:, None, :]
    n_beacons = len(np.unique(of.replies.beacon))
    width = max(8 * n_beacons, 16)
    summed = np.cumsum(np.concatenate([np.zeros((1, 2, 2)), product]), axis=0)
    high = np.minimum(np.arange(len(unit)) + width // 2, len(unit))
    low = np.maximum(np.arange(len(unit)) - width // 2, 0)
    mean = (summed[high] - summed[low]) / (high - low)[:, None, None]
    return np.linalg.inv(mean * n_beacons + 1e-9 * np.eye(2))


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
    of: Hindsight, smoothed: Track, begin_s: Float, end_s: Float, half_speed_mps: float
) -> Float:
    """Rms difference of a beacon's residuals between both passes of each crossing, by leg (m)."""
    once_s, again_s = crossing_times(smoothed)
    found: list[list[float]] = [[] for _ in begin_s]
    late_m = half_speed_mps * of.batch.sigma_s * of.batch.residual
    for beacon in np.unique(of.replies.beacon):
        rows = np.flatnonzero((of.decision == ACCEPTED) & (of.replies.beacon == beacon))
        t_s = of.replies.t_reply_s[rows]
        if not len(rows):
            continue
        first, second = _nearest(t_s, once_s), _nearest(t_s, again_s)
        near = np.abs(t_s[first] - once_s) < _CROSSING_REACH_S
        near &= np.abs(t_s[second] - again_s) < _CROSSING_REACH_S
        apart_m = late_m[rows[first]] - late_m[rows[second]]
        for leg, (b, e) in enumerate(zip(begin_s, end_s, strict=True)):
            here = ((once_s >= b) & (once_s <= e)) | ((again_s >= b) & (again_s <= e))
            found[leg] += apart_m[near & here].tolist()
    return np.array([_rms(np.array(values)) for values in found])


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
