# SPDX-License-Identifier: Apache-2.0
"""How good one track is, how honest, and whether its radius holds: by its truth."""

from dataclasses import dataclass

import numpy as np

from abyssnav.geometry import interpolate
from abyssnav.tables import Float, LegAccuracy, Reference, Solution, Track

#: From so long after a method's start on errors count: it has settled by then.
SETTLED_S = 300.0


@dataclass(frozen=True)
class Score:
    """Horizontal errors of one track, and what it claimed of them."""

    rms_m: float
    max_m: float
    p95_m: float
    lost: float  #: share of the time above 20 m
    nees: float  #: mean of eᵀ P⁻¹ e by the track's own covariance; 2 is exact


@dataclass(frozen=True)
class Radius:
    """What the 95 % radius of the legs was worth."""

    held: float  #: share of the track within its leg's radius
    median_m: float  #: of the legs; NaN where there is none
    over_p95: float  #: median over the legs of radius / 95th percentile of the leg's errors


def reference_truth(reference: Reference, start_ns: int) -> tuple[Float, Float]:
    """Instants [s] and positions (n, 3) of a recorded reference."""
    return (reference.time_ns - start_ns) / 1e9, reference.position_enu_m


def score(track: Track, truth: tuple[Float, Float], from_s: float, until_s: float) -> Score:
    """Score of a track between two instants."""
    counted = track[(track.t_s >= from_s) & (track.t_s <= until_s)]
    error_m = (counted.position_enu_m - interpolate(counted.t_s, *truth))[:, :2]
    distance_m = np.hypot(*error_m.T)
    weighted = np.linalg.solve(counted.position_cov_m2, error_m[:, :, None])[:, :, 0]
    return Score(
        rms_m=float(np.sqrt(np.mean(distance_m**2))),
        max_m=float(distance_m.max()),
        p95_m=float(np.percentile(distance_m, 95)),
        lost=float(np.mean(distance_m > 20.0)),
        nees=float(np.mean(np.sum(error_m * weighted, axis=1))),
    )


def radius(solution: Solution, truth: tuple[Float, Float], until_s: float = np.inf) -> Radius:
    """Judge the legs' radius over the smoother's track; NaN where it claims none."""
    legs, track = solution.accuracy, solution.tracks.get("smoother")
    if legs is None or track is None or np.isnan(legs.uncertainty_95_m).all():
        return Radius(np.nan, np.nan, np.nan)
    track = track[track.t_s <= until_s]
    off_m = np.hypot(*(track.position_enu_m - interpolate(track.t_s, *truth))[:, :2].T)
    leg = np.clip(np.searchsorted(legs.t_begin_s, track.t_s, side="right") - 1, 0, None)
    return Radius(
        held=float(np.mean(off_m <= legs.uncertainty_95_m[leg])),
        median_m=float(np.nanmedian(legs.uncertainty_95_m)),
        over_p95=_sharpness(legs, leg, off_m),
    )


def _sharpness(legs: LegAccuracy, leg: Float, off_m: Float) -> float:
    ratios = [
        legs.uncertainty_95_m[row] / np.percentile(off_m[leg == row], 95) for row in np.unique(leg)
    ]
    return float(np.nanmedian(ratios))
