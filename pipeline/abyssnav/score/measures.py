# SPDX-License-Identifier: Apache-2.0
"""A track's errors, what it claimed of them, and how near the best possible it is."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from abyssnav.align import reference
from abyssnav.compare import describe
from abyssnav.config import schemas
from abyssnav.errors import ReadError
from abyssnav.geometry import CHI2_95_OF_2, interpolate
from abyssnav.profile import load_profile
from abyssnav.read import read_optional
from abyssnav.score.given_track import GivenTrack, load_decisions, load_track
from abyssnav.score.truth_files import gate_shares, load_bound
from abyssnav.tables import Bool, Float, Int, Log, Reference

#: A hole in the reference or the track: so many of its usual steps, and at least so long.
_STEPS, _HOLE_S = 5.0, 5.0
#: Off on the whole by more than this, or by this and five times its scatter: another frame.
_OTHER_FRAME_M, _SHIFTED_M, _OVER_SCATTER = 1000.0, 30.0, 5.0
#: Axes exchanged or reversed are said where that leaves so little of an error so large.
_AXES_SHARE, _AXES_M = 0.1, 30.0
#: Late times are said from so many seconds on, where they explain so much of the squared error.
_LATE_S, _LATE_SHARE = 2.0, 0.8
_AXES = {
    "east and north exchanged": (1, 0, 1, 1),
    "east reversed": (0, 1, -1, 1),
    "north reversed": (0, 1, 1, -1),
    "both axes reversed": (0, 1, -1, -1),
}


@dataclass(frozen=True)
class Options:
    """What of a track is scored."""

    method: str | None = None  #: of a file that holds several
    from_s: float = 0.0  #: since the reference's first instant: what comes before is not counted


@dataclass(frozen=True)
class TrackScore:
    """Horizontal errors of a track, and what it claimed of them; None where nothing says it."""

    n: int  #: positions that could be compared
    mean_m: float
    std_m: float
    rms_m: float
    median_m: float
    p95_m: float
    max_m: float
    start_s: float  #: from the reference's first instant to the track's first position
    coverage: float  #: share of the reference's time that the track covers
    nees: float | None  #: mean of eᵀ P⁻¹ e, 2 when exact
    inside_95: float | None  #: share within their own 95 % ellipse
    radius_95_m: float | None  #: median radius of the circle as large as that ellipse
    sharpness: float | None  #: that over the 95th percentile of the errors; 1 is as it should be
    x_filter: float | None  #: RMS over the bound of all filters
    x_smoother: float | None  #: RMS over the bound of all smoothers
    outliers_accepted: float | None  #: share of the grossly wrong replies that the gate let in
    good_rejected: float | None  #: share of the others that it threw out
    remarks: tuple[str, ...]  #: what was left out, and what looks odd

    def plain(self) -> dict[str, Any]:
        """The score for JSON; what there is no number for is left out."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        known = {name: value for name, value in values.items() if _is_known(value)}
        return known | {"remarks": list(self.remarks)}


def _is_known(value: Any) -> bool:
    return value is not None and not (isinstance(value, float) and np.isnan(value))


def score(log_path: Path, track_path: Path, options: Options | None = None) -> TrackScore:
    """Score a track at its own instants against the log's reference, interpolated there.

    Where a benchmark left its truth beside the log (`truth_files`), the bound and the gate are
    judged too.

    Parameters
    ----------
    track_path : CSV or Parquet with the columns of `tracks.parquet` (`time` and `east_m`,
        `north_m`, or `latitude_deg`, `longitude_deg`; a covariance where it has one), or TUM

    Raises
    ------
    ReadError
        A log without reference, a file that is no track, or one without any instant that the
        reference covers.
    """
    options = options or Options()
    log, truth = _with_reference(log_path)
    track, remarks, method = load_track(track_path, log, options.method)
    measured, instants_ns = _errors(track, truth, remarks, (track_path.name, options.from_s))
    bound = load_bound(log_path)
    bounds_m = (None, None) if bound is None else bound.rms_m(instants_ns)
    x = [None if bound_m is None else measured["rms_m"] / bound_m for bound_m in bounds_m]
    decisions = load_decisions(track_path, method)
    shares = None if decisions is None else gate_shares(log_path, decisions)
    return TrackScore(
        **measured,
        start_s=float(track.time_ns[0] - truth.time_ns[0]) / 1e9,
        x_filter=x[0],
        x_smoother=x[1],
        outliers_accepted=shares and shares[0],
        good_rejected=shares and shares[1],
        remarks=tuple(remarks),
    )


def _with_reference(log_path: Path) -> tuple[Log, Reference]:
    """A log's roles and its reference: by the default profile, else by a shipped one's topic."""
    shipped = sorted(path.name.removesuffix(".toml") for path in (schemas() / "profiles").iterdir())
    tried = set()
    for name in ("default", *shipped):
        profile = load_profile(name)
        spec = profile.roles().get("reference")
        if spec is None or spec.where in tried:
            continue
        tried.add(spec.where)
        log = read_optional([log_path], profile, ("reference", "beacons"))
        truth = reference(log)
        if truth is not None:
            return log, truth
    raise ReadError(f"{log_path.name}: no reference to score against")


def _errors(
    track: GivenTrack, truth: Reference, remarks: list[str], name_and_from: tuple[str, float]
) -> tuple[dict[str, Any], Int]:
    """Statistics of what the reference covers, and the instants that count."""
    name, from_s = name_and_from
    start_ns = int(truth.time_ns[0])
    t_s, truth_s = (track.time_ns - start_ns) / 1e9, (truth.time_ns - start_ns) / 1e9
    covered = _is_covered(t_s, truth_s)
    if not covered.any():
        raise _no_common_time(name, track.time_ns, truth.time_ns)
    if not covered.all():
        n_outside = int(np.sum(~covered))
        remarks.append(f"{n_outside} of {len(track)} positions where no reference is: left out")
    covered &= t_s >= from_s
    if not covered.any():
        raise ReadError(f"{name}: no position from {from_s:g} s on; it ends after {t_s[-1]:.0f} s")
    counted, t_s = track[covered], t_s[covered]
    error_m = counted.position_enu_m - interpolate(t_s, truth_s, truth.position_enu_m[:, :2])
    coverage = _coverage(t_s, truth_s[truth_s >= from_s])
    if coverage < 0.995:
        remarks.append(f"covers {100 * coverage:.0f} % of the reference's time")
    remarks += _oddities(error_m, interpolate(t_s, truth_s, truth.position_enu_m[:, :2]), t_s)
    distance_m = np.hypot(*error_m.T)
    claimed = _claims(error_m, counted.position_cov_m2, distance_m, remarks)
    measured = {"n": len(counted), **describe(distance_m), "coverage": coverage, **claimed}
    return measured, counted.time_ns


def _no_common_time(name: str, time_ns: Int, truth_ns: Int) -> ReadError:
    ends = [np.datetime64(int(ns), "ns").astype("M8[s]") for ns in time_ns[[0, -1]]]
    known = [np.datetime64(int(ns), "ns").astype("M8[s]") for ns in truth_ns[[0, -1]]]
    return ReadError(
        f"{name}: no position between {known[0]} and {known[1]}, where the reference is; "
        f"the track runs from {ends[0]} to {ends[1]}"
    )


def _is_covered(t_s: Float, truth_s: Float) -> Bool:
    """Whether the reference is known at each instant: within it, and in none of its holes."""
    right = np.clip(np.searchsorted(truth_s, t_s), 1, max(len(truth_s) - 1, 1))
    if len(truth_s) == 1:
        return np.asarray(t_s == truth_s[0])
    hole = np.diff(truth_s)[right - 1] > _longest_step(truth_s)
    exact = np.isin(t_s, truth_s)
    within = (t_s >= truth_s[0]) & (t_s <= truth_s[-1])
    return np.asarray(within & (exact | ~hole))


def _longest_step(t_s: Float) -> float:
    return max(_STEPS * float(np.median(np.diff(t_s))), _HOLE_S)


def _coverage(t_s: Float, truth_s: Float) -> float:
    """Share of the reference's time that the track covers; holes of either are not covered."""
    spans = []
    for instants_s in (t_s, truth_s):
        step_s = np.diff(instants_s)
        longest_s = _longest_step(instants_s) if len(step_s) else 0.0
        spans.append(float(np.sum(step_s[step_s <= longest_s])))
    return min(spans[0] / spans[1], 1.0) if spans[1] > 0 else 1.0


def _oddities(error_m: Float, true_m: Float, t_s: Float) -> list[str]:
    """Which other frame, axes or clock would explain most of the errors, in words."""
    rms_m = float(np.sqrt(np.mean(np.sum(error_m**2, axis=1))))
    given_m, middle_m = true_m + error_m, np.median(error_m, axis=0)
    for words, (first, second, east, north) in _AXES.items():
        other_m = given_m[:, [first, second]] * [east, north] - true_m
        if rms_m > _AXES_M and np.sqrt(np.mean(np.sum(other_m**2, axis=1))) < _AXES_SHARE * rms_m:
            return [f"fits the reference with {words}: another frame?"]
    late_s, share = _lateness(error_m, true_m, t_s)
    if abs(late_s) >= _LATE_S and share > _LATE_SHARE:
        return [f"as if its times were {abs(late_s):.1f} s {'late' if late_s > 0 else 'early'}"]
    scatter_m = float(np.sqrt(np.mean(np.sum((error_m - middle_m) ** 2, axis=1))))
    off_m = float(np.hypot(*middle_m))
    if off_m < max(_SHIFTED_M, min(_OVER_SCATTER * scatter_m, _OTHER_FRAME_M)):
        return []
    return [
        f"{middle_m[0]:+,.0f} m east and {middle_m[1]:+,.0f} m north of the reference on the "
        "whole: another frame or origin?"
    ]


def _lateness(error_m: Float, true_m: Float, t_s: Float) -> tuple[float, float]:
    """By how much later stamps explain the errors, e = -v Δt, and which share of their square."""
    if len(t_s) < 3 or np.any(np.diff(t_s) <= 0):
        return 0.0, 0.0
    velocity_mps = np.gradient(true_m, t_s, axis=0)
    squared = float(np.sum(velocity_mps**2))
    if squared == 0 or not np.any(error_m):
        return 0.0, 0.0
    late_s = -float(np.sum(error_m * velocity_mps)) / squared
    left_m = error_m + velocity_mps * late_s
    return late_s, 1 - float(np.sum(left_m**2) / np.sum(error_m**2))


def _claims(
    error_m: Float, cov_m2: Float, distance_m: Float, remarks: list[str]
) -> Mapping[str, float | None]:
    """What the covariances are worth, where there are any."""
    variance = np.diagonal(cov_m2, axis1=1, axis2=2)
    determinant = variance[:, 0] * variance[:, 1] - cov_m2[:, 0, 1] ** 2
    with np.errstate(invalid="ignore"):
        usable = np.all(variance > 0, axis=1) & (determinant > 0)
    n_without = int(np.sum(~usable))
    if not usable.any():
        remarks.append("no covariance")
        return dict.fromkeys(("nees", "inside_95", "radius_95_m", "sharpness"))
    if n_without:
        remarks.append(f"{n_without} positions without a covariance")
    weighted = np.linalg.solve(cov_m2[usable], error_m[usable, :, None])[..., 0]
    squared = np.sum(error_m[usable] * weighted, axis=1)
    radius_m = float(np.median(np.sqrt(CHI2_95_OF_2 * np.sqrt(determinant[usable]))))
    p95_m = float(np.percentile(distance_m[usable], 95))
    return {
        "nees": float(squared.mean()),
        "inside_95": float(np.mean(squared <= CHI2_95_OF_2)),
        "radius_95_m": radius_m,
        "sharpness": radius_m / p95_m if p95_m > 0 else None,
    }
