# SPDX-License-Identifier: Apache-2.0
"""The plan: the track framed, its 95 % band, marks of time; and small drawings without a script."""

import math
from collections.abc import Sequence
from html import escape
from typing import Any, Final

import numpy as np

from abyssnav.errors import printable
from abyssnav.geometry import CHI2_95_OF_2
from abyssnav.outputs.html.thinning import keep_corners, packed
from abyssnav.outputs.palette import BEACON, method_colour
from abyssnav.outputs.presentation import beacon_names, best_method, is_positioned
from abyssnav.tables import Float, Solution, Track

TRACK_POINTS: Final = 3000
_DRAWING_POINTS: Final = 400
_MARK_STEPS_S: Final = (60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600)
_MOST_MARKS: Final = 14


def plan_data(solution: Solution) -> dict[str, Any]:
    """Frame, band and marks of the track that stands for the dive."""
    best = best_method(solution)
    track = solution.tracks.get(best)
    if track is None or not len(track):
        return {
            "best": "",
            "positioned": is_positioned(solution),
            "frame": _frame(solution.dive.beacons.position_enu_m[:, :2]),
            "band": None,
            "marks": None,
        }
    return {
        "best": best,
        "positioned": is_positioned(solution),
        "frame": _frame(track.position_enu_m[:, :2]),
        "band": _band(solution, track) if is_positioned(solution) else None,
        "marks": _marks(solution, track),
    }


def _frame(enu_m: Float) -> list[float]:
    """West, east, south, north of the points, with a margin; a square of 100 m about nothing."""
    if not len(enu_m):
        return [-50.0, 50.0, -50.0, 50.0]
    low_m, high_m = enu_m.min(axis=0), enu_m.max(axis=0)
    margin_m = 0.06 * max(float((high_m - low_m).max()), 20.0)
    west, south = (low_m - margin_m).tolist()
    east, north = (high_m + margin_m).tolist()
    return [west, east, south, north]


def band_half_width_m(solution: Solution, track: Track) -> Float | None:
    """Half width of the 95 % band at each row of a track; None where no radius is to be shown.

    The radius of the leg, where the dive's legs were judged; else the extent of the 95 % error
    ellipse across the course, √(χ² nᵀ C n).
    """
    if solution.verdict.level == "unusable":
        return None
    legs = solution.accuracy
    if legs is not None and len(legs):
        leg = np.searchsorted(legs.t_begin_s, track.t_s, side="right") - 1
        return legs.uncertainty_95_m[np.clip(leg, 0, len(legs) - 1)]
    across = _across(track)
    variance_m2 = np.einsum("ni,nij,nj->n", across, track.position_cov_m2, across)
    half_m: Float = np.sqrt(CHI2_95_OF_2 * np.maximum(variance_m2, 0.0))
    return half_m


def _across(track: Track) -> Float:
    """Unit vectors (n, 2) to starboard of the course made good."""
    if len(track) < 2:
        return np.tile([1.0, 0.0], (len(track), 1))
    along_m = np.gradient(track.position_enu_m[:, :2], axis=0)
    length_m = np.maximum(np.hypot(*along_m.T), 1e-9)
    across: Float = np.column_stack([along_m[:, 1], -along_m[:, 0]]) / length_m[:, None]
    return across


def _band(solution: Solution, track: Track) -> dict[str, str] | None:
    half_m = band_half_width_m(solution, track)
    if half_m is None or not np.isfinite(half_m).any():
        return None
    kept = keep_corners(track.position_enu_m, TRACK_POINTS)
    kept = kept[np.isfinite(half_m[kept])]
    offset_m = _across(track)[kept] * half_m[kept, None]
    middle_m = track.position_enu_m[kept, :2]
    outline_m = np.concatenate([middle_m + offset_m, (middle_m - offset_m)[::-1]])
    return {"x": packed(outline_m[:, 0], "f4"), "y": packed(outline_m[:, 1], "f4")}


def _marks(solution: Solution, track: Track) -> dict[str, Any]:
    """Places at round minutes of UTC, with the clock."""
    span_s = float(track.t_s[-1] - track.t_s[0])
    step_s = next((s for s in _MARK_STEPS_S if span_s / s <= _MOST_MARKS), 86400)
    begin_s = solution.dive.start_ns / 1e9
    first = math.ceil((begin_s + track.t_s[0]) / step_s)
    utc_s = np.arange(first, (begin_s + track.t_s[-1]) // step_s + 1) * step_s
    t_s = utc_s - begin_s
    labels = [f"{int(s // 3600) % 24:02d}:{int(s // 60) % 60:02d}" for s in utc_s]
    return {
        "step_s": step_s,
        "x": np.interp(t_s, track.t_s, track.position_enu_m[:, 0]).round(2).tolist(),
        "y": np.interp(t_s, track.t_s, track.position_enu_m[:, 1]).round(2).tolist(),
        "label": labels,
    }


# --- drawings ---------------------------------------------------------------------------------


def overview(solution: Solution, size_px: int = 230) -> str:
    """Beacons, named, and the track among them, with a scale; the inset of the plan."""
    best = best_method(solution)
    track = solution.tracks.get(best)
    enu_m = np.zeros((0, 2)) if track is None else track.position_enu_m[:, :2]
    positioned = is_positioned(solution)
    beacons_m = solution.dive.beacons.position_enu_m[:, :2] if positioned else enu_m[:0]
    names = list(beacon_names(solution.dive).values()) if positioned else []
    return drawing(enu_m, best, size_px, (beacons_m, names))


def drawing(
    enu_m: Float,
    method: str,
    size_px: int,
    beacons: tuple[Float, Sequence[str]] = (np.zeros((0, 2)), ()),
) -> str:
    """A track (n, 2) as SVG, north up: start marked, scale bar, beacons with their names."""
    beacons_m, names = beacons
    points_m = np.concatenate([enu_m, beacons_m])
    if not len(points_m):
        return ""
    low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
    scale = (size_px - (64 if len(beacons_m) else 16)) / max(float((high_m - low_m).max()), 1.0)

    def place(where_m: Float) -> Float:
        middle = [size_px / 2, size_px / 2 - 6]
        return np.asarray((where_m - 0.5 * (low_m + high_m)) * [scale, -scale] + middle)

    parts = []
    if len(enu_m):
        on_paper = place(enu_m[keep_corners(enu_m, _DRAWING_POINTS)])
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in on_paper)
        x, y = on_paper[0]
        parts.append(
            f'<polyline points="{line}" fill="none" stroke="{method_colour(method)}" '
            f'stroke-width="1.3"/><circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="currentColor"/>'
        )
    for (x, y), name in zip(place(beacons_m), names, strict=True):
        side = "end" if x > 0.75 * size_px else "start" if x < 0.25 * size_px else "middle"
        parts.append(
            f'<path d="M{x:.1f} {y - 5:.1f} l5 9 h-10 z" fill="{BEACON}" stroke="currentColor" '
            f'stroke-width="0.7"/><text x="{x:.1f}" y="{y - 8:.1f}" text-anchor="{side}">'
            f"{escape(printable(name))}</text>"
        )
    return (
        f'<svg viewBox="0 0 {size_px} {size_px}" width="{size_px}" height="{size_px}" role="img" '
        f'aria-label="plan, north up">{"".join(parts)}{_scale_bar(scale, size_px)}</svg>'
    )


def _scale_bar(scale: float, size_px: int) -> str:
    """A bar of 1, 2 or 5 times a power of ten, at most a third of the drawing wide."""
    most_m = size_px / 3.0 / scale
    decade = 10.0 ** math.floor(math.log10(most_m))
    bar_m = next(k * decade for k in (5.0, 2.0, 1.0) if k * decade <= most_m)
    words = f"{bar_m:g} m" if bar_m < 1000 else f"{bar_m / 1000:g} km"
    return (
        f'<path d="M4 {size_px - 9} v5 h{bar_m * scale:.1f} v-5" fill="none" '
        f'stroke="currentColor"/><text x="{8 + bar_m * scale:.1f}" y="{size_px - 3}">{words}</text>'
    )
