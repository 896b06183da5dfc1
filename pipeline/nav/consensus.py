# SPDX-License-Identifier: Apache-2.0
"""The position that most single travel times agree on; no complete fix is needed."""

from dataclasses import dataclass

import numpy as np

from pipeline.nav.acoustics import Legs, flight
from pipeline.nav.fixes import circle_intersections, horizontal_radius
from pipeline.tables import Bool, Float, Int, Table

#: Residuals beyond three standard deviations say no more than that they disagree.
_SATURATION = 9.0
#: Dead reckoning's error as a share of the distance run, before compass and DVL are known.
_RECKONING_ERROR = 0.05
_REFINEMENTS = 6
#: Step of the search for an unknown sound-speed scale: at its middle two standard deviations.
_SCALE_STEP = 0.003
#: Replies whose circles give the candidates: the newest, where dead reckoning has lost least.
_SEARCHED = 12
#: A place this far away is another one.
_ELSEWHERE_M = 30.0


@dataclass(frozen=True, eq=False)
class Recent(Table):
    """The last replies, their positions at ping and reply told relative to now."""

    ping_id: Int
    beacon: Int
    from_now_ping_m: Float  #: (n, 2) position at the ping minus position now
    from_now_reply_m: Float  #: (n, 2)


@dataclass(frozen=True, eq=False)
class Agreement:
    """Where the replies agree, and how well."""

    position_m: Float  #: (2,) east, north, now
    sound_scale: float  #: k
    cov: Float  #: (3, 3) of east, north, k
    n_agreeing: int  #: different pings or beacons
    n_beacons: int
    n_repeated: int  #: beacons that agree at two pings at least
    n_rival: int  #: as `n_agreeing`, for the best place elsewhere
    n_replies: int


def spread(
    recent: Recent, legs: Legs, sigma_s: float, reckoning_error: float = _RECKONING_ERROR
) -> Float:
    """Standard deviation of each time, widened by what dead reckoning may have lost since (n,) s.

    s² = σ_t² + (2 · 0.05 · |½ (o_p + o_r)| / c)²
    """
    run_m = np.linalg.norm(0.5 * (recent.from_now_ping_m + recent.from_now_reply_m), axis=1)
    return np.asarray(
        np.sqrt(sigma_s**2 + (2 * reckoning_error * run_m / legs.speed_reply_mps) ** 2)
    )


def residuals(
    position_m: Float,
    sound_scale: Float | float,
    recent: Recent,
    legs: Legs,
    sigma_s: float,
    reckoning_error: float = _RECKONING_ERROR,
) -> Float:
    """(T - h) / s of every reply (..., n) for positions (..., 2) now and scales (...)."""
    at = position_m[..., None, :]
    time_s = flight(at + recent.from_now_ping_m, at + recent.from_now_reply_m, legs).time_s
    late_s = legs.flight_time_s - (1 + np.asarray(sound_scale)[..., None]) * time_s
    return np.asarray(late_s / spread(recent, legs, sigma_s, reckoning_error))


def agree(
    recent: Recent, legs: Legs, sigma_s: float, sound_scale: float, sound_scale_sigma: float
) -> Agreement | None:
    """Position that most of the replies agree on.

    Every pair of different beacons, the newest replies with all, gives up to two circle
    intersections; each is judged by Σ min(r², 9) over all replies, the best refined by
    Gauss-Newton with Geman-McClure weights
    (9 / (9 + r²))² on east, north and k, and those with |r| < 3 agree.  Where k is hardly known,
    it is searched over three standard deviations, the best three values are refined.

    Parameters
    ----------
    recent, legs : the same replies, at most a few dozen
    sound_scale, sound_scale_sigma : what is known of k, mean and standard deviation

    Returns
    -------
    agreement : None with fewer than two beacons
    """
    scales = sound_scale + scale_offsets(sound_scale_sigma)
    first, second = np.triu_indices(len(recent), k=1)
    different = recent.beacon[first] != recent.beacon[second]
    different &= first >= len(recent) - _SEARCHED
    first, second = first[different], second[different]
    if not len(first):
        return None
    candidates = [_best_candidate(recent, legs, sigma_s, k, first, second) for k in scales.tolist()]
    refined = [
        (_refine(place, recent, legs, sigma_s, sound_scale, sound_scale_sigma), rival)
        for _, place, rival in sorted(candidates, key=lambda found: found[0])[:3]
    ]
    r = [residuals(x[:2], x[2], recent, legs, sigma_s) for (x, _), _ in refined]
    best = int(np.argmin([np.minimum(each**2, _SATURATION).sum() for each in r]))
    (x, cov), rival = refined[best]
    again, _ = _refine(rival, recent, legs, sigma_s, sound_scale, sound_scale_sigma)
    elsewhere = np.linalg.norm(again[:2] - x[:2]) > _ELSEWHERE_M
    r_again = residuals(again[:2], again[2], recent, legs, sigma_s)
    agreeing = _different(recent, np.abs(r[best]) < 3)
    times = np.unique(agreeing[1], return_counts=True)[1]
    return Agreement(
        position_m=x[:2],
        sound_scale=float(x[2]),
        cov=cov,
        n_agreeing=agreeing.shape[1],
        n_beacons=len(times),
        n_repeated=int(np.sum(times > 1)),
        n_rival=_different(recent, np.abs(r_again) < 3).shape[1] if elsewhere else 0,
        n_replies=len(recent),
    )


def _different(recent: Recent, rows: Bool) -> Int:
    """Ping and beacon (2, m) of these replies, a reply heard again left out."""
    return np.unique(np.stack([recent.ping_id, recent.beacon])[:, rows], axis=1)


def scale_offsets(sigma: float) -> Float:
    """Steps to try about the mean of k: none where it is known to two of them."""
    reach = 3 * sigma
    n = int(np.ceil(reach / _SCALE_STEP)) if reach > 2 * _SCALE_STEP else 0
    return np.asarray(_SCALE_STEP * np.arange(-n, n + 1))


def _best_candidate(
    recent: Recent, legs: Legs, sigma_s: float, sound_scale: float, first: Int, second: Int
) -> tuple[float, Float, Float]:
    """Least saturated misfit over all circle intersections; (e, n, k) of it and of the rival."""
    middle_m = 0.5 * (recent.from_now_ping_m + recent.from_now_reply_m)
    center_m = 0.5 * (legs.aim_ping_m + legs.aim_reply_m) - middle_m
    radius_m = horizontal_radius(legs, sound_scale)
    candidates_m = circle_intersections(
        center_m[first], radius_m[first], center_m[second], radius_m[second]
    ).reshape(-1, 2)
    r = residuals(candidates_m, np.full(len(candidates_m), sound_scale), recent, legs, sigma_s)
    misfit = np.minimum(r**2, _SATURATION).sum(axis=1)
    best = int(np.argmin(misfit))
    away_m = np.linalg.norm(candidates_m - candidates_m[best], axis=1)
    rival = int(np.argmin(np.where(away_m > _ELSEWHERE_M, misfit, np.inf)))
    place, elsewhere = (np.array([*candidates_m[i], sound_scale]) for i in (best, rival))
    return float(misfit[best]), place, elsewhere


def _refine(
    x: Float,
    recent: Recent,
    legs: Legs,
    sigma_s: float,
    sound_scale: float,
    sound_scale_sigma: float,
) -> tuple[Float, Float]:
    """Robust Gauss-Newton on (east, north, k); the estimate and its covariance (3, 3)."""
    s = spread(recent, legs, sigma_s)
    prior = np.diag([1e-8, 1e-8, 1 / max(sound_scale_sigma, 1e-9) ** 2])
    normal = prior
    for _ in range(_REFINEMENTS):
        here = flight(x[:2] + recent.from_now_ping_m, x[:2] + recent.from_now_reply_m, legs)
        r = (legs.flight_time_s - (1 + x[2]) * here.time_s) / s
        gradient = (1 + x[2]) * (here.gradient_ping_spm + here.gradient_reply_spm)
        J = np.column_stack([gradient, here.time_s]) / s[:, None]
        weight = (_SATURATION / (_SATURATION + r**2)) ** 2
        normal = (J * weight[:, None]).T @ J + prior
        pull = np.array([0.0, 0.0, (sound_scale - x[2]) * prior[2, 2]])
        x = x + np.linalg.solve(normal, (J * weight[:, None]).T @ r + pull)
    return x, np.linalg.inv(normal)
