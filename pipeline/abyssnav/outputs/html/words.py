# SPDX-License-Identifier: Apache-2.0
"""The report's headline, tables and settings as HTML, every text from the log escaped."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final

import numpy as np

from abyssnav.outputs.palette import method_colour
from abyssnav.tables import (
    ARRIVALS,
    DECISIONS,
    EXPLANATIONS,
    VERDICTS,
    Comparison,
    Float,
    GateStatistics,
    Solution,
)

BEST = ("smoother", "ekf", "ekf_gated", "kf_fix", "dead_reckoning")


def headline(solution: Solution, comparison: Comparison, duration_s: float) -> str:
    """Tiles: when, how long, how far, how many replies, how well."""
    dive = solution.dive
    best = next((m for m in BEST if m in solution.tracks), None)
    tiles = [
        ("Begins, UTC", utc(dive.start_ns)),
        ("Duration", duration(duration_s)),
        ("Distance run", f"{_distance_m(solution) / 1000:.2f} km"),
        ("Depth", _range(dive.depth.depth_m, "m")),
        ("Replies", f"{len(dive.replies):,} of {len(dive.beacons)} beacons"),
    ]
    for method in [m for m in ("ekf", "ekf_gated") if m in solution.innovations][:1]:
        taken = (solution.innovations[method].decision == 0).mean() if len(dive.replies) else 0.0
        tiles.append((f"Accepted by {method}", f"{100 * taken:.0f} %"))
    if (
        solution.accuracy is not None
        and solution.verdict.level != "unusable"
        and len(solution.accuracy)
    ):
        radius_m = solution.accuracy.uncertainty_95_m
        worst = f"{np.nanmedian(radius_m):.1f} m, worst leg {np.nanmax(radius_m):.1f} m"
        tiles.append(("95 % radius, without truth", worst))
    for name in ("truth", "fix"):
        row = comparison[(comparison.method == best) & (comparison.reference == name)]
        if len(row):
            tiles.append((f"{best}, RMS to {name}", f"{row.rms_m[0]:.2f} m"))
            break
    return "".join(
        f'<div class="tile"><span>{escape(name)}</span><b>{escape(value)}</b></div>'
        for name, value in tiles
    )


def verdict(solution: Solution) -> str:
    """What a person should look at, or that there is nothing."""
    checks = (*solution.dive.checks, *solution.checks)
    bad = [c for c in checks if not c.ok]
    if not bad:
        return f'<p class="verdict good"><b>Good.</b> All {len(checks)} checks passed.</p>'
    reasons = "".join(
        f"<li><b>{escape(_spaced(c.name))}</b>: {f'{number(c.value)} {escape(c.unit)}'.strip()}, "
        f"limit {number(c.limit)}{'; ' + escape(c.detail) if c.detail else ''}</li>"
        for c in bad
    )
    return (
        f'<div class="verdict look"><b>Look.</b> {len(bad)} of {len(checks)} checks '
        f"ask for it: <ul>{reasons}</ul></div>"
    )


def comparison_tables(comparison: Comparison) -> str:
    """Distances to the fixes, as in the paper's Tables 1-2, and to truth."""
    captions = {
        "truth": "Error against truth, horizontal, in metres",
        "fix": "Distance to the fix computation (the paper's Tables 1 and 2), in metres",
    }
    head = ("method", "n", "mean", "std", "rms", "median", "95 %", "max")
    tables = []
    for name, caption in captions.items():
        rows = comparison[comparison.reference == name]
        numbers = (rows.mean_m, rows.std_m, rows.rms_m, rows.median_m, rows.p95_m, rows.max_m)
        cells = [
            (_swatch(method), f"{n:,}", *(f"{x:.3f}" for x in row))
            for method, n, *row in zip(rows.method, rows.n, *numbers, strict=True)
        ]
        tables.append(table(caption, head, cells, f"comparison-{name}"))
    return "".join(tables)


def gate_tables(solution: Solution) -> str:
    """What each gate did, by beacon, and the smallest outlier it could still see."""
    names = beacon_names(solution)
    head = (
        "beacon",
        "replies",
        "accepted",
        "gated",
        "duplicate",
        "unknown",
        "before start",
        "not physical",
        "mean NIS",
        "inside 95 %",
        "smallest outlier seen [m]",
        "largest step unseen [m]",
        "watch",
    )
    tables = []
    for method, s in solution.statistics.items():
        rows = [
            (
                escape(names.get(int(r.beacon_id[0]), str(r.beacon_id[0]))),
                *(f"{getattr(r, k)[0]:,}" for k in ("replies", *DECISIONS)),
                number(r.mean_nis[0], 2),
                number(r.nis_inside_95[0], 3),
                number(r.smallest_visible_outlier_m[0], 1),
                number(r.largest_unseen_step_m[0], 1),
                _watch(method, r),
            )
            for r in (s[[k]] for k in range(len(s)))
        ]
        tables.append(table(f"Gate of {method}", head, rows, f"gate-{method}"))
    return "".join(tables)


def arrival_table(solution: Solution) -> str:
    """How the replies came, by beacon, as the best method judged them, and what explains it."""
    method = next((m for m in ("smoother", "ekf", "ekf_gated") if m in solution.innovations), None)
    if method is None:
        return ""
    i, names = solution.innovations[method], beacon_names(solution)
    reasons = [k for k, name in enumerate(EXPLANATIONS) if name not in ("", "direct")]
    rows = []
    for beacon_id in np.unique(i.beacon_id).tolist():
        mine = i[i.beacon_id == beacon_id]
        classes = np.bincount(mine.arrival, minlength=len(ARRIVALS))
        why = np.bincount(mine.explanation, minlength=len(EXPLANATIONS))[reasons]
        counts = (f"{n:,}" for n in (*classes, *why))
        rows.append((escape(names.get(beacon_id, str(beacon_id))), *counts))
    head = ("beacon", *ARRIVALS, *(_spaced(EXPLANATIONS[k]) for k in reasons))
    return table(
        f"Arrivals, as {method} judged them, and what explains them", head, rows, "arrivals"
    )


#: Heading -> column of `LegAccuracy`, of the distances beside the radius to rely on.
_EVIDENCE: Final = {
    "by covariance alone": "formal_95_m",
    "beacon left out": "left_out_m",
    "expected": "left_out_expected_m",
    "filter to smoother": "filter_smoother_m",
    "odd to even pings": "forward_backward_m",
    "at crossings": "crossing_m",
}


def accuracy_table(solution: Solution) -> str:
    """How far each leg of the smoothed track can be trusted, judged without truth."""
    legs = solution.accuracy
    if legs is None:
        return ""
    head = ("from, dive time", "to", "course [°]", "length [m]", "replies", "95 % radius [m]")
    rows = [
        (
            duration(leg.t_begin_s[0]),
            duration(leg.t_end_s[0]),
            f"{math.degrees(leg.course_rad[0]) % 360:.0f}",
            f"{leg.length_m[0]:,.0f}",
            f"{leg.n_replies[0]:,}",
            f"<b>{number(leg.uncertainty_95_m[0], 2)}</b>",
            *(number(getattr(leg, name)[0], 2) for name in _EVIDENCE.values()),
        )
        for leg in (legs[[k]] for k in range(len(legs)))
    ]
    title = "Accuracy of the smoothed track, leg by leg, without truth"
    return table(title, (*head, *_EVIDENCE), rows, "accuracy")


def sensor_table(solution: Solution) -> str:
    """Messages, rates and gaps of each sensor."""
    dive = solution.dive
    columns = {
        "heading": dive.heading.t_s,
        "velocity": dive.velocity.t_s,
        "depth": dive.depth.t_s,
        "replies": dive.replies.t_reply_s,
    }
    rows = []
    for name, t_s in columns.items():
        step_s = np.diff(t_s).round(6) if len(t_s) > 1 else np.array([np.nan])
        span_s = float(step_s.sum())
        rate_hz = len(step_s) / span_s if span_s > 0 else np.nan
        at = duration(float(t_s[int(step_s.argmax())])) if len(t_s) > 1 else ""
        rows.append(
            (name, f"{len(t_s):,}", number(rate_hz, 2), number(step_s.max(), 2), escape(at))
        )
    head = ("sensor", "messages", "rate [Hz]", "longest gap [s]", "at dive time")
    return table("Sensors", head, rows, "sensors")


def check_table(solution: Solution) -> str:
    """All checks, those that ask for a look first."""
    rows = [
        (
            "ok" if c.ok else '<b class="bad">look</b>',
            escape(c.stage),
            escape(_spaced(c.name)),
            number(c.value),
            number(c.limit),
            escape(c.unit),
            escape(c.detail),
        )
        for c in sorted((*solution.dive.checks, *solution.checks), key=lambda c: c.ok)
    ]
    head = ("", "stage", "check", "value", "limit", "unit", "where")
    return table("Checks", head, rows, "checks")


def event_table(solution: Solution) -> str:
    """What happened during the dive."""
    rows = [
        (duration(e.t_s), _swatch(e.method), escape(e.what))
        for e in sorted(solution.events, key=lambda e: e.t_s)
    ]
    return table("Events", ("dive time", "method", "what"), rows, "events")


def finding_table(summary: Mapping[str, Any]) -> str:
    """What the reader met in the files: damage, and what it left out."""
    rows = [
        tuple(escape(f[key]) for key in ("what", "where", "detail")) for f in summary["findings"]
    ]
    return table("Met in the files", ("what", "where", "detail"), rows, "findings")


def provenance(summary: Mapping[str, Any]) -> str:
    """Inputs, starts, versions and every setting in force."""
    inputs = [
        (escape(i["name"]), f"{i['bytes']:,}", f"<code>{escape(i['sha256'])}</code>")
        for i in summary["inputs"]
    ]
    starts = [
        (
            _swatch(method),
            escape(s["time"][:19].replace("T", " ")),
            f"{s['east_m']:.1f}",
            f"{s['north_m']:.1f}",
            str(s["cycles"]),
            escape(s["how"]),
        )
        for method, s in summary["starts"].items()
    ]
    settings = [
        (escape(key), f"<code>{escape(str(value))}</code>")
        for key, value in _flat(summary["settings"])
    ]
    head = ("method", "UTC", "east [m]", "north [m]", "cycles", "by")
    return (
        table("Starts", head, starts, "starts")
        + table("Inputs", ("file", "bytes", "SHA-256"), inputs, "inputs")
        + f"<p>abyssnav {escape(summary['version'])}, profile {escape(str(summary['profile']))}</p>"
        + "<details><summary>Settings in force</summary>"
        + table("", ("key", "value"), settings, "settings")
        + "</details>"
    )


def table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], name: str) -> str:
    """Table of cells that are HTML already; nothing where there is no row."""
    if not rows:
        return ""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return (
        f'<div class="wide"><table id="{escape(name)}">{title}'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def beacon_names(solution: Solution) -> dict[int, str]:
    """Beacon id -> name, or the id where there is none."""
    beacons = solution.dive.beacons
    return {int(k): str(name) or str(k) for k, name in zip(beacons.id, beacons.name, strict=True)}


def utc(time_ns: int) -> str:
    """UTC to the second."""
    return str(np.datetime64(time_ns, "ns").astype("M8[s]")).replace("T", " ")


def duration(seconds: float) -> str:
    """Hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60:02d} min {rest:02d} s"


def number(value: float, digits: int | None = None) -> str:
    """Number for a person; a dash for what does not exist."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.{digits}f}" if digits is not None else f"{value:.4g}"


def _watch(method: str, row: GateStatistics) -> str:
    """Worst of the gate's stretches, in a word."""
    if method == "ekf_ungated":
        return "no gate"
    verdict = VERDICTS[row.verdict[0]]
    return verdict if verdict == "healthy" else f'<b class="bad">{verdict}</b>'


def _distance_m(solution: Solution) -> float:
    """Way through the water plan: horizontal speed over time, lost bottom lock left out."""
    velocity = solution.dive.velocity
    speed_mps = np.hypot(velocity.velocity_body_mps[:, 0], velocity.velocity_body_mps[:, 1])
    good = velocity.valid & np.isfinite(speed_mps)
    if good.sum() < 2:
        return 0.0
    return float(np.trapezoid(speed_mps[good], velocity.t_s[good]))


def _range(values: Float, unit: str) -> str:
    return f"{values.min():,.0f} to {values.max():,.0f} {unit}" if len(values) else "–"


def _swatch(method: str) -> str:
    colour = method_colour(method)
    return f'<i class="swatch" style="background:{colour}"></i>{escape(str(method))}'


def _spaced(name: str) -> str:
    return name.replace("_", " ")


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in settings.items():
        inner = isinstance(value, dict)
        rows += _flat(value, f"{prefix}{key}.") if inner else [(f"{prefix}{key}", value)]
    return rows
