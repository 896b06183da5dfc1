# SPDX-License-Identifier: Apache-2.0
"""MSAC localization: the position that most single travel times agree on, without a fix."""

from collections import Counter
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import RayGeometry, slant_range
from abyssnav.estimation.fixes import circle_intersections, horizontal_radius
from abyssnav.tables import Bool, Float, Int

#: Squared residuals, over their variance, count no more than this: three standard deviations.
_SATURATION = 9.0
#: Dead reckoning's error as a share of the distance run, before compass and DVL are known.
_RECKONING_ERROR = 0.05
#: Gauss-Newton ends after so many steps, or with one so short.
_REFINEMENTS, _STILL_M = 6, 0.01
#: Step of the search for an unknown sound-speed scale k.
_SCALE_STEP = 0.003
#: Replies whose circles give the candidates: the newest, where dead reckoning has lost least.
_SEARCHED = 12
#: A place this far away is another one.
_ELSEWHERE_M = 30.0


class ReplyWindow(NamedTuple):
    """The last replies, as circles around the place where the vehicle is now."""

    ping: Int
    beacon: Int
    #: (n, 2) where the beacon would lie, had the vehicle been at the ping where it is now
    center_ping_m: Float
    center_reply_m: Float  #: (n, 2) the same at the reply
    run_m: Float  #: (n,) from mid-flight to now
    lost_m: Float  #: (n,) sigma of what a velocity that was held has lost until now
    geometry: RayGeometry

    def widened_sigma_s(self, sigma_s: float, reckoning_error: float = _RECKONING_ERROR) -> Float:
        """Standard deviation of each time, widened by what dead reckoning may have lost since (n,).

            s² = σ_t² + (2 / c)² ((0.05 run)² + lost²)

        with 0.05 the `reckoning_error`, run the distance from mid-flight to now.
        """
        lost_m = np.hypot(reckoning_error * self.run_m, self.lost_m)
        return np.asarray(np.hypot(sigma_s, 2 * lost_m / self.geometry.speed_reply_mps))

    def time_s(self, position_m: Float) -> Float:
        """Flight times (..., n) of a vehicle that is now at (..., 2)."""
        place_m, geometry = position_m[..., None, :], self.geometry
        return np.asarray(
            slant_range(place_m - self.center_ping_m, geometry.height_ping_m)
            / geometry.speed_ping_mps
            + slant_range(place_m - self.center_reply_m, geometry.height_reply_m)
            / geometry.speed_reply_mps
        )

    def residual_s(self, position_m: Float, sound_scale: Float | float) -> Float:
        """T - h (..., n) of every reply for positions (..., 2) now and scales (...)."""
        slower = 1 + np.asarray(sound_scale)[..., None]
        return np.asarray(self.geometry.flight_time_s - slower * self.time_s(position_m))


def reply_window(
    keys: tuple[Int, Int], from_now_m: tuple[Float, Float], lost_m: Float, geometry: RayGeometry
) -> ReplyWindow:
    """Window from ping and beacon of every reply, and positions (n, 2) relative to now.

    Parameters
    ----------
    keys : running number of the ping, row of the beacon
    from_now_m : at the ping, at the reply
    """
    from_now_ping_m, from_now_reply_m = from_now_m
    middle_m = 0.5 * (from_now_ping_m + from_now_reply_m)
    return ReplyWindow(
        *keys,
        geometry.virtual_beacon_ping_m - from_now_ping_m,
        geometry.virtual_beacon_reply_m - from_now_reply_m,
        np.hypot(middle_m[:, 0], middle_m[:, 1]),
        lost_m,
        geometry,
    )


@dataclass(frozen=True, eq=False)
class MsacResult:
    """Where the replies agree, and how well."""

    position_m: Float  #: (2,) east, north, now
    sound_scale: float  #: k
    cov: Float  #: (3, 3) of east, north, k
    n_agreeing: int  #: different pings or beacons
    n_beacons: int
    n_repeated: int  #: beacons that agree at two pings at least
    n_rival: int  #: as `n_agreeing`, for the best place elsewhere
    n_replies: int


def msac_localize(
    recent: ReplyWindow,
    sigma_s: float,
    sound_scale: float,
    sound_scale_sigma: float,
    at_least: int = 0,
) -> MsacResult | None:
    """Position that most of the replies agree on.

    Every pair of different beacons among the newest twelve replies gives up to two circle
    intersections; each is judged by the MSAC cost Σ min(r², 9) over all replies (P. Torr and
    A. Zisserman, "MLESAC", Computer Vision and Image Understanding 78, 2000), the best refined by
    Gauss-Newton with Geman-McClure weights (9 / (9 + r²))² on east, north and k, and those with
    |r| < 3 agree.  Where k is hardly known, it is searched over three standard deviations, and the
    best three values are refined.

    Parameters
    ----------
    recent : at most a few dozen replies
    sound_scale, sound_scale_sigma : what is known of k, mean and standard deviation
    at_least : replies that must agree

    Returns
    -------
    agreement : None with fewer than two beacons, or when too few agree
    """
    widened_s = recent.widened_sigma_s(sigma_s)
    first, second = _pairs(recent.beacon)
    if not len(first):
        return None
    prior = sound_scale, sound_scale_sigma
    candidates = [
        _best_candidate(recent, widened_s, k, first, second)
        for k in (sound_scale + scale_offsets(sound_scale_sigma)).tolist()
    ]
    refined = [
        (*_refine(place, recent, widened_s, *prior), rival)
        for _, place, rival in sorted(candidates, key=lambda candidate: candidate[0])[:3]
    ]
    misfit = [np.minimum(r**2, _SATURATION).sum() for _, _, r, _ in refined]
    x, cov, r, rival = refined[int(np.argmin(misfit))]
    agreeing = _different(recent, np.abs(r) < 3)
    if len(agreeing) < at_least:
        return None
    again, _, r_again = _refine(rival, recent, widened_s, *prior)
    elsewhere = np.linalg.norm(again[:2] - x[:2]) > _ELSEWHERE_M
    times = Counter(beacon for _, beacon in agreeing)
    return MsacResult(
        position_m=x[:2],
        sound_scale=float(x[2]),
        cov=cov,
        n_agreeing=len(agreeing),
        n_beacons=len(times),
        n_repeated=sum(count > 1 for count in times.values()),
        n_rival=len(_different(recent, np.abs(r_again) < 3)) if elsewhere else 0,
        n_replies=len(recent.ping),
    )


def _different(recent: ReplyWindow, rows: Bool) -> set[tuple[int, int]]:
    """Ping and beacon of these replies: one heard again counts once."""
    return set(zip(recent.ping[rows].tolist(), recent.beacon[rows].tolist(), strict=True))


def _pairs(beacon: Int) -> tuple[Int, Int]:
    """Rows of every two replies of different beacons, both among the newest."""
    first, second = _every_two(len(beacon))
    wanted = (beacon[first] != beacon[second]) & (first >= len(beacon) - _SEARCHED)
    return first[wanted], second[wanted]


@cache
def _every_two(n: int) -> tuple[Int, Int]:
    """Rows of every two of n replies."""
    return np.triu_indices(n, k=1)


def scale_offsets(sigma: float) -> Float:
    """Steps to try about the mean of k: the mean alone where three sigma are within two steps."""
    reach = 3 * sigma
    n = int(np.ceil(reach / _SCALE_STEP)) if reach > 2 * _SCALE_STEP else 0
    return np.asarray(_SCALE_STEP * np.arange(-n, n + 1))


def _best_candidate(
    recent: ReplyWindow, widened_s: Float, sound_scale: float, first: Int, second: Int
) -> tuple[float, Float, Float]:
    """Least saturated misfit over all circle intersections; (e, n, k) of it and of the rival."""
    center_m = 0.5 * (recent.center_ping_m + recent.center_reply_m)
    radius_m = horizontal_radius(recent.geometry, sound_scale)
    candidates_m = circle_intersections(
        center_m[first], radius_m[first], center_m[second], radius_m[second]
    ).reshape(-1, 2)
    r = recent.residual_s(candidates_m, np.full(len(candidates_m), sound_scale)) / widened_s
    misfit = np.minimum(r**2, _SATURATION).sum(axis=1)
    best = int(np.argmin(misfit))
    away_m = np.linalg.norm(candidates_m - candidates_m[best], axis=1)
    rival = int(np.argmin(np.where(away_m > _ELSEWHERE_M, misfit, np.inf)))
    place, elsewhere = (np.array([*candidates_m[i], sound_scale]) for i in (best, rival))
    return float(misfit[best]), place, elsewhere


def _refine(
    x: Float, recent: ReplyWindow, widened_s: Float, sound_scale: float, sound_scale_sigma: float
) -> tuple[Float, Float, Float]:
    """Robust Gauss-Newton on (east, north, k): estimate, covariance (3, 3), residuals over s."""
    geometry = recent.geometry
    prior = np.diag([1e-8, 1e-8, 1 / max(sound_scale_sigma, 1e-9) ** 2])
    J, normal = np.empty((len(widened_s), 3)), prior
    for _ in range(_REFINEMENTS):
        from_ping_m, from_reply_m = x[:2] - recent.center_ping_m, x[:2] - recent.center_reply_m
        ping_m = slant_range(from_ping_m, geometry.height_ping_m)
        reply_m = slant_range(from_reply_m, geometry.height_reply_m)
        time_s = ping_m / geometry.speed_ping_mps + reply_m / geometry.speed_reply_mps
        slower = (1 + float(x[2])) / widened_s
        J[:, :2] = from_ping_m * (slower / (ping_m * geometry.speed_ping_mps))[:, None]
        J[:, :2] += from_reply_m * (slower / (reply_m * geometry.speed_reply_mps))[:, None]
        J[:, 2] = time_s / widened_s
        r = geometry.flight_time_s / widened_s - slower * time_s
        weighted = J.T * (_SATURATION / (_SATURATION + r**2)) ** 2
        normal = weighted @ J + prior
        pull = weighted @ r
        pull[2] += (sound_scale - float(x[2])) * prior[2, 2]
        step = np.linalg.solve(normal, pull)
        x = x + step
        if abs(step[0]) + abs(step[1]) < _STILL_M:
            break
    return x, np.linalg.inv(normal), recent.residual_s(x[:2], x[2]) / widened_s
