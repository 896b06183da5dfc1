# SPDX-License-Identifier: Apache-2.0
"""The position that most single travel times agree on; no complete fix is needed."""

from dataclasses import dataclass

import numpy as np

from pipeline.nav.acoustics import Legs, flight
from pipeline.nav.fixes import circle_intersections, horizontal_radius
from pipeline.tables import Float, Int, Table

#: Residuals beyond three standard deviations say no more than that they disagree.
_SATURATION = 9.0
#: Dead reckoning's error as a share of the distance run.
_RECKONING_ERROR = 0.05
_REFINEMENTS = 6


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
    n_replies: int


def spread(recent: Recent, legs: Legs, sigma_s: float) -> Float:
    """Standard deviation of each time, widened by what dead reckoning may have lost since (n,) s.

    s² = σ_t² + (2 · 0.05 · |½ (o_p + o_r)| / c)²
    """
    run_m = np.linalg.norm(0.5 * (recent.from_now_ping_m + recent.from_now_reply_m), axis=1)
    return np.asarray(
        np.sqrt(sigma_s**2 + (2 * _RECKONING_ERROR * run_m / legs.speed_reply_mps) ** 2)
    )


def residuals(
    position_m: Float, sound_scale: Float, recent: Recent, legs: Legs, sigma_s: float
) -> Float:
    """(T - h) / s of every reply (..., n) for positions (..., 2) now and scales (...)."""
    at = position_m[..., None, :]
    time_s = flight(at + recent.from_now_ping_m, at + recent.from_now_reply_m, legs).time_s
    late_s = legs.flight_time_s - (1 + np.asarray(sound_scale)[..., None]) * time_s
    return np.asarray(late_s / spread(recent, legs, sigma_s))


def agree(
    recent: Recent, legs: Legs, sigma_s: float, sound_scale: Float, sound_scale_sigma: float
) -> Agreement | None:
    """Position that most of the replies agree on.

    Every pair of replies of different beacons gives up to two circle intersections; each is judged
    by Σ min(r², 9) over all replies, the best refined by Gauss-Newton with Geman-McClure weights
    (9 / (9 + r²))² on east, north and k, and those with |r| < 3 agree.

    Parameters
    ----------
    recent, legs : the same replies, at most a few dozen
    sound_scale : (m,) values of k to try; one where it is known
    sound_scale_sigma : prior standard deviation of k about the value tried

    Returns
    -------
    agreement : None with fewer than two beacons
    """
    first, second = np.triu_indices(len(recent), k=1)
    different = recent.beacon[first] != recent.beacon[second]
    first, second = first[different], second[different]
    if not len(first):
        return None
    best = min(
        (_best_candidate(recent, legs, sigma_s, k, first, second) for k in sound_scale.tolist()),
        key=lambda found: found[0],
    )
    x, cov = _refine(best[1], best[2], recent, legs, sigma_s, sound_scale_sigma)
    agreeing = np.abs(residuals(x[:2], x[2], recent, legs, sigma_s)) < 3
    pings = np.unique(np.stack([recent.ping_id, recent.beacon])[:, agreeing], axis=1)
    n_beacons = len(np.unique(pings[1]))
    return Agreement(x[:2], float(x[2]), cov, pings.shape[1], n_beacons, len(recent))


def _best_candidate(
    recent: Recent, legs: Legs, sigma_s: float, sound_scale: float, first: Int, second: Int
) -> tuple[float, Float, float]:
    """Least saturated misfit over all circle intersections, its position and scale."""
    middle_m = 0.5 * (recent.from_now_ping_m + recent.from_now_reply_m)
    center_m = 0.5 * (legs.aim_ping_m + legs.aim_reply_m) - middle_m
    radius_m = horizontal_radius(legs, sound_scale)
    candidates_m = circle_intersections(
        center_m[first], radius_m[first], center_m[second], radius_m[second]
    ).reshape(-1, 2)
    r = residuals(candidates_m, np.full(len(candidates_m), sound_scale), recent, legs, sigma_s)
    misfit = np.minimum(r**2, _SATURATION).sum(axis=1)
    best = int(np.argmin(misfit))
    return float(misfit[best]), candidates_m[best], sound_scale


def _refine(
    position_m: Float,
    sound_scale: float,
    recent: Recent,
    legs: Legs,
    sigma_s: float,
    sound_scale_sigma: float,
) -> tuple[Float, Float]:
    """Robust Gauss-Newton on (east, north, k); the estimate and its covariance (3, 3)."""
    x = np.array([*position_m, sound_scale])
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
