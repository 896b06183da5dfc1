# SPDX-License-Identifier: Apache-2.0
"""What the report's plots draw: columns thinned for the eye, packed as base64.

A track keeps its corners, a curve its extremes, an innovation plot every reply that was not
accepted.  The Parquet files hold all rows.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from abyssnav.errors import printable
from abyssnav.geometry import ellipse_95
from abyssnav.outputs.html.plan import TRACK_POINTS, plan_data
from abyssnav.outputs.html.thinning import keep_corners, keep_extremes, packed
from abyssnav.outputs.palette import (
    ACCEPTED,
    BEACON,
    BOUND,
    DEPTH,
    INCONSISTENT_FIX,
    POSITION,
    REFERENCE,
    REFUSED_POSITION,
    REJECTED,
    SEQUENTIAL,
    beacon_colour,
    method_colour,
)
from abyssnav.outputs.presentation import (
    beacon_names,
    best_method,
    is_positioned,
    median_radius_m,
    position_fixes,
)
from abyssnav.tables import (
    ARRIVALS,
    DECISIONS,
    EXPLANATIONS,
    VERDICTS,
    Dive,
    Errors,
    Float,
    GateIntegrity,
    Innovations,
    Int,
    Reference,
    SensorEstimates,
    Solution,
    Track,
    in_order,
)

CURVE_POINTS: Final = 4000
ACCEPTED_POINTS: Final = 1200  #: of one beacon and method; and of positions of another kind
SIGMA_POINTS: Final = 1000  #: of a covariance over time, which is smooth
_NIS_EDGES: Final = np.arange(0.0, 12.5, 0.5)
_W_EDGES: Final = np.arange(-6.0, 6.25, 0.25)
_ENOUGH: Final = 8000  #: rows for a quantile, and for a covariance over a dive
_SHARES: Final = np.linspace(0.0, 1.0, 201)


def plot_data(
    solution: Solution,
    errors: Mapping[tuple[str, str], Errors],
    reference: Reference | None,
) -> dict[str, Any]:
    """All that the page's script draws, in plain values and base64 of little-endian columns."""
    dive = solution.dive
    methods = in_order(solution.tracks)
    drawn = {m: _drawn(solution.tracks[m]) for m in methods}
    return {
        "start_ms": dive.start_ns / 1e6,
        "decisions": DECISIONS,
        "arrivals": ARRIVALS,
        "explanations": [name.replace("_", " ") for name in EXPLANATIONS],
        "verdicts": VERDICTS,
        "colours": _colours([*methods, "fix"]),
        "gamma": solution.gamma if math.isfinite(solution.gamma) else None,
        "plan": plan_data(solution),
        "beacons": _beacons(dive) if is_positioned(solution) else [],
        "tracks": [{"method": m, **_track(dive, drawn[m])} for m in methods],
        "shades": _shades(drawn, best_method(solution), errors),
        "reference": _reference(dive, reference) if is_positioned(solution) else None,
        "fixes": _fixes(solution),
        "positions": _positions(solution),
        "errors": [
            {"method": method, "reference": name, **_error(e)}
            for (method, name), e in errors.items()
            if len(e)
        ],
        "sigma": [
            {"method": m, **_sigma(solution.tracks[m])} for m in methods if len(solution.tracks[m])
        ],
        "radius": _radius(solution),
        "w_edges": _W_EDGES.tolist(),
        "w": {m: _w_counts(i) for m, i in solution.innovations.items()},
        "innovations": {
            m: _innovations(dive, i, m, solution.gamma) for m, i in solution.innovations.items()
        },
        "watch": {m: _watch(w) for m, w in solution.watch.items()},
        "nis": {m: _nis_counts(i) for m, i in solution.innovations.items()},
        "nis_expected": _chi_squared_shares(_NIS_EDGES),
        "nis_edges": _NIS_EDGES.tolist(),
        "estimates": {m: _estimates(e) for m, e in solution.estimates.items() if len(e)},
        "profile": _profile(solution),
    }


def last_ping(dive: Dive, t_s: Float) -> Int:
    """Last answered ping sent by each time; 0 before the first."""
    order = np.argsort(dive.replies.t_ping_s, kind="stable")
    number = np.append(0, dive.replies.ping_id[order])
    return number[np.searchsorted(dive.replies.t_ping_s[order], t_s, side="right")]


def _colours(methods: Sequence[str]) -> dict[str, Any]:
    return {
        "method": {method: method_colour(method) for method in methods},
        "beacon": BEACON,
        "fix": method_colour("fix"),
        "poor_fix": INCONSISTENT_FIX,
        "position": POSITION,
        "refused_position": REFUSED_POSITION,
        "reference": REFERENCE,
        "accepted": ACCEPTED,
        "rejected": REJECTED,
        "bound": BOUND,
        "depth": DEPTH,
        "sequential": SEQUENTIAL,
    }


def _beacons(dive: Dive) -> list[dict[str, Any]]:
    beacons = dive.beacons
    names = [printable(name) for name in beacon_names(dive).values()]
    return [
        {"id": int(k), "name": name, "x": x, "y": y, "z": z, "colour": beacon_colour(place)}
        for place, (k, name, (x, y, z)) in enumerate(
            zip(beacons.id, names, beacons.position_enu_m.tolist(), strict=True)
        )
    ]


def _drawn(track: Track) -> Track:
    """Those rows that the plan draws."""
    return track[keep_corners(track.position_enu_m, TRACK_POINTS)]


def _track(dive: Dive, thin: Track) -> dict[str, str]:
    return {
        "t": packed(thin.t_s, "f4"),
        "x": packed(thin.position_enu_m[:, 0], "f4"),
        "y": packed(thin.position_enu_m[:, 1], "f4"),
        "depth": packed(-thin.position_enu_m[:, 2], "f4"),
        "ping": packed(last_ping(dive, thin.t_s), "i4"),
    }


def _shades(
    drawn: Mapping[str, Track], best: str, errors: Mapping[tuple[str, str], Errors]
) -> list[dict[str, str]]:
    """By what the best track can be coloured, at the points that the plan has of it."""
    thin = drawn.get(best)
    if thin is None:
        return []
    shades = {
        ("95 % by covariance", "m"): ellipse_95(thin.position_cov_m2)[0][:, 0],
        ("depth", "m"): -thin.position_enu_m[:, 2],
        ("speed", "m/s"): np.hypot(thin.forward_mps, thin.starboard_mps),
    }
    error = errors.get((best, "truth"))
    if error is not None and len(error):
        distance_m = np.interp(thin.t_s, error.t_s, error.distance_m, np.nan, np.nan)
        shades = {("error", "m"): distance_m, **shades}
    return [
        {"name": name, "unit": unit, "v": packed(values, "f4")}
        for (name, unit), values in shades.items()
        if np.isfinite(values).any()
    ]


def _reference(dive: Dive, reference: Reference | None) -> dict[str, str] | None:
    if reference is None or not len(reference):
        return None
    thin = reference[keep_corners(reference.position_enu_m, TRACK_POINTS)]
    t_s = (thin.time_ns - dive.start_ns) / 1e9
    return {
        "t": packed(t_s, "f4"),
        "x": packed(thin.position_enu_m[:, 0], "f4"),
        "y": packed(thin.position_enu_m[:, 1], "f4"),
        "depth": packed(-thin.position_enu_m[:, 2], "f4"),
        "ping": packed(last_ping(dive, t_s), "i4"),
    }


def _fixes(solution: Solution) -> dict[str, str]:
    fixes = solution.fixes
    return {
        "t": packed(fixes.t_s, "f4"),
        "x": packed(fixes.position_enu_m[:, 0], "f4"),
        "y": packed(fixes.position_enu_m[:, 1], "f4"),
        "depth": packed(-fixes.position_enu_m[:, 2], "f4"),
        "ping": packed(fixes.ping_id, "i4"),
        "n": packed(fixes.n_replies, "u1"),
        "rms_ms": packed(1e3 * fixes.rms_s, "f4"),
        "consistent": packed(fixes.consistent, "u1"),
    }


def _positions(solution: Solution) -> dict[str, str] | None:
    """Fixes of another kind: all that were not accepted, and every k-th accepted."""
    dive, fixes = solution.dive, position_fixes(solution)
    if fixes is None or not len(dive.depth):
        return None
    accepted = fixes.decision == DECISIONS.index("accepted")
    kept = ~accepted
    kept[_every_kth(np.flatnonzero(accepted))] = True
    thin = fixes[kept]
    return {
        "t": packed(thin.t_s, "f4"),
        "x": packed(thin.position_enu_m[:, 0], "f4"),
        "y": packed(thin.position_enu_m[:, 1], "f4"),
        "depth": packed(np.interp(thin.t_s, dive.depth.t_s, dive.depth.depth_m), "f4"),
        "ping": packed(last_ping(dive, thin.t_s), "i4"),
        "sigma_m": packed(np.sqrt((thin.sigma_enu_m**2).mean(axis=1)), "f4"),
        "decision": packed(thin.decision, "u1"),
    }


def _every_kth(rows: Int) -> Int:
    return rows[:: max(1, math.ceil(len(rows) / ACCEPTED_POINTS))]


def _curve(t_s: Float, values: Float, n_points: int = CURVE_POINTS) -> dict[str, str]:
    kept = keep_extremes(values, n_points)
    return {"t": packed(t_s[kept], "f4"), "y": packed(values[kept], "f4")}


def _error(errors: Errors) -> dict[str, str]:
    """Distance over time, and below which distance each share of the dive lies."""
    few_m = errors.distance_m[:: max(1, len(errors) // _ENOUGH)]
    quantiles = packed(np.quantile(few_m, _SHARES), "f4")
    return {**_curve(errors.t_s, errors.distance_m), "quantiles": quantiles}


def _sigma(track: Track) -> dict[str, str]:
    """Larger half axis of the 95 % ellipse over time."""
    few = track[:: max(1, len(track) // _ENOUGH)]
    return _curve(few.t_s, ellipse_95(few.position_cov_m2)[0][:, 0], SIGMA_POINTS)


def _radius(solution: Solution) -> dict[str, str] | None:
    """95 % radius to rely on, leg by leg."""
    legs = solution.accuracy
    if legs is None or median_radius_m(solution) is None:
        return None
    return {
        "begin": packed(legs.t_begin_s, "f4"),
        "end": packed(legs.t_end_s, "f4"),
        "y": packed(legs.uncertainty_95_m, "f4"),
    }


def _profile(solution: Solution) -> dict[str, Any]:
    """Depth, height above the floor, heading and speed over the dive."""
    dive, curves = solution.dive, {}
    curves["depth"] = _curve(dive.depth.t_s, dive.depth.depth_m)
    track = solution.tracks.get(best_method(solution))
    if track is not None:
        speed_mps = np.hypot(track.forward_mps, track.starboard_mps)
        known, moving = np.isfinite(track.altitude_m), np.isfinite(speed_mps)
        curves["altitude"] = _curve(track.t_s[known], track.altitude_m[known])
        curves["heading"] = _curve(track.t_s, np.degrees(track.heading_rad) % 360.0)
        curves["speed"] = _curve(track.t_s[moving], speed_mps[moving])
    return {name: curve for name, curve in curves.items() if curve["t"]}


def _innovations(
    dive: Dive, innovations: Innovations, method: str, gamma: float
) -> dict[str, str | bool]:
    kept = _thinned_innovations(innovations)
    depth_m = np.interp(kept.t_reply_s, dive.depth.t_s, dive.depth.depth_m)
    gate = gamma if math.isfinite(gamma) else np.nan
    return {
        "gated": method != "ekf_ungated",
        "t": packed(kept.t_reply_s, "f4"),
        "ms": packed(1e3 * kept.innovation_s, "f4"),
        "bound_ms": packed(1e3 * np.sqrt(gate) * kept.innovation_sigma_s, "f4"),
        "nis": packed(np.minimum(kept.nis, 1e30), "f4"),
        "ping": packed(kept.ping_id, "i4"),
        "beacon": packed(kept.beacon_id, "i4"),
        "decision": packed(kept.decision, "u1"),
        "arrival": packed(kept.arrival, "u1"),
        "explanation": packed(kept.explanation, "u1"),
        "depth": packed(depth_m, "f4"),
    }


def _thinned_innovations(innovations: Innovations) -> Innovations:
    """Rows with a prediction: all that were not accepted, and every k-th accepted of a beacon."""
    known = innovations[np.isfinite(innovations.innovation_s)]
    accepted = known.decision == DECISIONS.index("accepted")
    kept = ~accepted
    for beacon_id in np.unique(known.beacon_id):
        kept[_every_kth(np.flatnonzero(accepted & (known.beacon_id == beacon_id)))] = True
    return known[kept]


def _watch(watch: GateIntegrity) -> dict[str, str]:
    return {
        "begin": packed(watch.t_begin_s, "f4"),
        "end": packed(watch.t_end_s, "f4"),
        "beacon": packed(watch.beacon_id, "i4"),
        "smallest_m": packed(watch.smallest_visible_outlier_m, "f4"),
        "unseen_m": packed(watch.largest_unseen_step_m, "f4"),
        "verdict": packed(watch.verdict, "u1"),
    }


def _nis_counts(innovations: Innovations) -> dict[str, Any]:
    """Share of the accepted replies by NIS; what lies beyond the last edge apart."""
    accepted = innovations.decision == DECISIONS.index("accepted")
    nis = innovations.nis[accepted & np.isfinite(innovations.nis)]
    counts, _ = np.histogram(nis, _NIS_EDGES)
    n = max(1, len(nis))
    return {
        "n": len(nis),
        "share": (counts / n).tolist(),
        "beyond": float((nis > _NIS_EDGES[-1]).sum() / n),
    }


def _w_counts(innovations: Innovations) -> dict[str, Any]:
    """Replies of each beacon by w, the innovation over its sigma: accepted and rejected.

    What lies beyond the outer edges counts in the outer stretches.
    """
    known = innovations[np.isfinite(innovations.innovation_s)]
    w = np.clip(known.innovation_s / known.innovation_sigma_s, _W_EDGES[0], _W_EDGES[-1])
    accepted = known.decision == DECISIONS.index("accepted")
    return {
        str(k): [
            np.histogram(w[rows & (known.beacon_id == k)], _W_EDGES)[0].tolist()
            for rows in (accepted, ~accepted)
        ]
        for k in np.unique(known.beacon_id)
    }


def _chi_squared_shares(edges: Float) -> list[float]:
    """P(a < χ²₁ < b) = erf √(b/2) - erf √(a/2) between neighbouring edges."""
    below = [math.erf(math.sqrt(edge / 2.0)) for edge in edges]
    return np.diff(below).tolist()


def _estimates(e: SensorEstimates) -> dict[str, str]:
    e = e[np.unique(np.linspace(0, len(e) - 1, min(len(e), CURVE_POINTS)).astype(int))]
    return {
        "t": packed(e.t_s, "f4"),
        "heading_deg": packed(np.degrees(e.heading_error_rad), "f4"),
        "heading_sigma_deg": packed(np.degrees(e.heading_error_sigma_rad), "f4"),
        "scale_percent": packed(100 * e.dvl_scale, "f4"),
        "scale_sigma_percent": packed(100 * e.dvl_scale_sigma, "f4"),
        "sound_percent": packed(100 * e.sound_speed_scale, "f4"),
        "sound_sigma_percent": packed(100 * e.sound_speed_scale_sigma, "f4"),
    }
