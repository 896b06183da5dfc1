# SPDX-License-Identifier: Apache-2.0
"""What people read of a dive, as rows of text: terminal, report and recording only render it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from abyssnav.errors import printable
from abyssnav.geometry import enu_to_geodetic
from abyssnav.outputs.palette import colour_name
from abyssnav.tables import (
    ARRIVALS,
    DECISIONS,
    EXPLANATIONS,
    VERDICTS,
    Check,
    Comparison,
    Dive,
    Float,
    PositionInnovations,
    Solution,
    in_order,
)

#: Whose track stands for the dive, best first.
BEST: Final = ("smoother", "ekf", "ekf_gated", "kf_fix", "ekf_ungated", "dead_reckoning")
#: Method -> what it is, in a sentence.
METHOD_NOTES: Final = {
    "dead_reckoning": "compass and Doppler log alone",
    "fix": "least squares over the replies of a cycle, the vehicle taken as at rest (the paper)",
    "kf_fix": "Kalman filter on the fixes (the paper)",
    "ekf_ungated": "extended Kalman filter on single travel times, without a gate (the paper)",
    "ekf_gated": "the same with the paper's gate: replies too far off are left out",
    "ekf": "real-time filter that also estimates errors of compass, Doppler log and sound speed",
    "smoother": "the same over the whole dive, from data before and after: use this one",
    "ekf_huber": "real-time filter in which doubtful replies count less instead of not at all",
}
PAPER: Final = (
    "Deep Sea AUV Navigation Using Multiple Acoustic Beacons, on the trials of the AUV Qianlong 1 "
    "in March and June 2013."
)
#: Level -> the word in which a verdict is given, and what it means.
LEVEL_WORDS: Final = {
    "good": ("GOOD", "The track can be relied on."),
    "check": ("CHECK", "The track can be used, with the reasons below in mind."),
    "unusable": ("UNUSABLE", "No track of this dive is to be relied on."),
}
#: Words of a state column that ask for nothing.
CALM: Final = frozenset({"ok", "healthy", "silent", "no gate", "inside", "below", ""})
MISSING: Final = "–"


@dataclass(frozen=True)
class Column:
    """Heading of a column, and how its cells are to be set.

    `kind` is `number` (right), `text` (left), `method` (left, in the method's colour) or `state`
    (left, stands out unless the word is in `CALM`).
    """

    title: str
    kind: str = "number"


@dataclass(frozen=True)
class TextTable:
    """A table for people: plain text, without markup, every character of it visible."""

    name: str  #: identifies the table within a page
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        shown = tuple(tuple(printable(str(cell)) for cell in row) for row in self.rows)
        object.__setattr__(self, "rows", shown)


# --- the dive in a few lines ------------------------------------------------------------------


@dataclass(frozen=True)
class Headline:
    """The verdict for people."""

    level: str  #: one of `LEVELS`
    word: str
    sentence: str
    radius: str  #: 95 % radius in words; empty where there is none


def headline(solution: Solution) -> Headline:
    """Verdict, what it means, and the radius, which an unusable dive does not have."""
    level = solution.verdict.level
    word, sentence = LEVEL_WORDS[level]
    if not has_acoustic_track(solution):
        start = "its first fix" if is_positioned(solution) else "an arbitrary point"
        sentence = f"No acoustic track: dead reckoning only, from {start}. {sentence}"
    return Headline(level, word, sentence, radius_words(solution))


def has_acoustic_track(solution: Solution) -> bool:
    """Whether any method made a track from replies."""
    return any(method != "dead_reckoning" for method in solution.tracks)


def is_positioned(solution: Solution) -> bool:
    """Whether the tracks lie where the vehicle was; else dead reckoning began anywhere."""
    return has_acoustic_track(solution) or bool(len(solution.fixes) or solution.starts)


def median_radius_m(solution: Solution) -> float | None:
    """Median over the legs of the 95 % radius; None where there is none to rely on."""
    legs = solution.accuracy
    if solution.verdict.level == "unusable" or legs is None:
        return None
    radius_m = legs.uncertainty_95_m[np.isfinite(legs.uncertainty_95_m)]
    return float(np.median(radius_m)) if len(radius_m) else None


def radius_words(solution: Solution) -> str:
    """95 % radius over the legs, without truth; empty where there is none to rely on."""
    median_m, legs = median_radius_m(solution), solution.accuracy
    if median_m is None or legs is None:
        return ""
    return f"95 % within {median_m:.1f} m, worst leg {np.nanmax(legs.uncertainty_95_m):.1f} m"


def best_method(solution: Solution) -> str:
    """Method whose track stands for the dive; empty without any."""
    return next((method for method in BEST if method in solution.tracks), "")


def lost_methods(solution: Solution) -> tuple[str, ...]:
    """Methods whose track would set the extent of any picture: those that ran away.

    More than one point in twenty lies outside half as much again of what the beacons and the best
    track take up.
    """
    best = best_method(solution)
    if not best:
        return ()
    parts = [solution.dive.beacons.position_enu_m, solution.tracks[best].position_enu_m]
    points = np.concatenate(parts)[:, :2]
    if not len(points):
        return ()
    low, high = points.min(axis=0), points.max(axis=0)
    middle_m, reach_m = 0.5 * (low + high), 0.75 * max(float((high - low).max()), 100.0)
    outside = {  # a few thousand points of each tell it as well as all
        method: np.abs(track.position_enu_m[:: 1 + len(track) // 4000, :2] - middle_m) > reach_m
        for method, track in solution.tracks.items()
        if len(track)
    }
    return tuple(m for m, far in outside.items() if far.any(axis=1).mean() > 0.05)


def position_fixes(solution: Solution) -> PositionInnovations | None:
    """Fixes of another kind as the best method met them; None without any.

    Where no method met them, none is accepted.
    """
    method = next((m for m in BEST if m in solution.positions), "")
    table = solution.dive.positions
    if method or table is None or not len(table):
        return solution.positions.get(method)
    unknown = np.full((len(table), 2), np.nan)
    return PositionInnovations(
        table.t_s,
        table.vehicle_enu_m,
        np.sqrt(np.diagonal(table.position_cov_m2, axis1=1, axis2=2)),
        unknown,
        unknown[:, 0],
        np.full(len(table), DECISIONS.index("before_start")),
    )


def facts(solution: Solution, comparison: Comparison, duration_s: float) -> list[tuple[str, str]]:
    """When, how long, how far, how many replies, how well: (name, value)."""
    dive, best = solution.dive, best_method(solution)
    pairs = [
        ("Begins, UTC", utc(dive.start_ns)),
        ("Duration", duration(duration_s)),
        ("Distance run", f"{_distance_m(solution) / 1000:.2f} km"),
        ("Depth", _range(dive.depth.depth_m, "m")),
        ("Replies", f"{len(dive.replies):,} of {len(dive.beacons)} beacons"),
    ]
    user = next((m for m in ("smoother", "ekf", "ekf_gated") if m in solution.innovations), "")
    if user and len(dive.replies):
        used = (solution.innovations[user].decision == DECISIONS.index("accepted")).mean()
        pairs.append((f"Used by {user}", f"{100 * used:.0f} %"))
    if len(solution.fixes):
        consistent = int(solution.fixes.consistent.sum())
        pairs.append(("Fixes", f"{len(solution.fixes):,}, {consistent:,} consistent"))
    for name, title in (("truth", "RMS to truth"), ("fix", "RMS to fixes")):
        row = comparison[(comparison.method == best) & (comparison.reference == name)]
        if len(row):
            pairs.append((f"{best}, {title}", f"{metres(float(row.rms_m[0]))} m"))
            break
    return [(name, printable(value)) for name, value in pairs]


def reading_guide(solution: Solution) -> str:
    """One paragraph: how to read the recording."""
    best = best_method(solution)
    legend = ", ".join(f"{method} {colour_name(method)}" for method in solution.tracks)
    positions = ""
    if position_fixes(solution) is not None:
        positions = "positions of another kind (GNSS, USBL) turquoise, those not accepted pale, "
    plots = (
        "The plots on the right have the whole dive: innovations (measured less predicted travel "
        "time, ms) between the grey lines of the gate, arrows at the edge for what lies beyond; "
        "errors and depth. Drag the time line to move."
    )
    if not is_positioned(solution):
        return (
            "Dead reckoning began at an arbitrary point: the plan shows the shape of the way, not "
            f"where it lies, and no beacons. {plots}"
        )
    return (
        f"The plan is seen from above, north up, framed on the track of `{best}`; beside it stand "
        "scale, start and end. Large dot with an arrow: the vehicle at the cursor's time, with its "
        "95 % ellipse and the last quarter of an hour of its way. Circles: the ranges of the last "
        "replies about their beacons, blue where the filter took the reply, orange where it did "
        f"not; where blue circles meet, the vehicle was. {plots} Tracks: {legend}; fixes magenta, "
        f"{positions}reference light grey, beacons yellow. The tab Map fetches tiles from "
        "OpenStreetMap over the network when it is opened; nothing else leaves this machine."
    )


# --- tables -----------------------------------------------------------------------------------


def comparison_tables(comparison: Comparison) -> list[TextTable]:
    """Distances to truth, and to the fixes as in the paper's Tables 1 and 2."""
    titles = {
        "truth": "Error against truth, horizontal [m]",
        "fix": "Distance to the fix computation, as in the paper's Tables 1 and 2 [m]",
    }
    columns = _columns("method|method", "n", "mean", "std", "rms", "median", "95 %", "max")
    tables = []
    for name, title in titles.items():
        part = comparison[comparison.reference == name]
        figures = (part.mean_m, part.std_m, part.rms_m, part.median_m, part.p95_m, part.max_m)
        rows = [
            (str(method), f"{n:,}", *(f"{x:.3f}" for x in row))
            for method, n, *row in zip(part.method, part.n, *figures, strict=True)
        ]
        tables.append(TextTable(f"comparison-{name}", title, columns, tuple(rows)))
    return [table for table in tables if table.rows]


def result_table(solution: Solution, comparison: Comparison) -> TextTable:
    """One row a method: replies accepted, error to the fixes and to truth; for a narrow screen."""
    rows = {
        (str(comparison.method[i]), str(comparison.reference[i])): comparison[[i]]
        for i in range(len(comparison))
    }
    figures = [("fix", "mean_m"), ("fix", "std_m")]
    if any(reference == "truth" for _, reference in rows):
        figures += [("truth", f"{name}_m") for name in ("mean", "std", "rms", "p95", "max")]
    titles = [f"{reference}: {name.removesuffix('_m')}" for reference, name in figures]
    body = []
    for method in in_order({method for method, _ in rows}):
        known = {name: rows[method, name] for name in ("fix", "truth") if (method, name) in rows}
        cells = (
            metres(float(getattr(known[reference], name)[0])) if reference in known else ""
            for reference, name in figures
        )
        body.append((method, _accepted_share(solution, method), *cells))
    columns = _columns("method|method", "accepted", *titles)
    return TextTable(
        "result", "horizontal distance in metres, to fix and to truth", columns, tuple(body)
    )


def _accepted_share(solution: Solution, method: str) -> str:
    gate = solution.statistics.get(method)
    if gate is None or not gate.replies.sum():
        return ""
    return f"{100 * gate.accepted.sum() / gate.replies.sum():.0f} %"


def pooled_table(columns: Sequence[str], records: Sequence[Mapping[str, Any]]) -> TextTable:
    """Statistics over many dives, a row as the table has it; names before figures."""
    bounds = ("mean_low_m", "mean_high_m")
    names = [name for name in columns if not name.endswith("_m")]
    figures = [name for name in columns if name.endswith("_m") and name not in bounds]
    pooled = bounds[0] in columns and any(metres(record[bounds[0]]) for record in records)
    interval = ["mean, 95 %"] if pooled else []  # below three dives there is none
    kinds = {"method": "method", "n": "number", "dives": "number"}
    heads = [f"{name.replace('reference', 'to')}|{kinds.get(name, 'text')}" for name in names]
    rows = []
    for record in records:
        numbers = [metres(record[name]) for name in figures]
        low, high = (metres(record[name]) if interval else "" for name in bounds)
        within = [f"{low} - {high}" if low else ""] if interval else []
        rows.append((*(str(record[name]) for name in names), *numbers, *within))
    titles = _columns(*heads, *(name.removesuffix("_m") for name in figures), *interval)
    return TextTable("pooled", "horizontal distances in metres", titles, tuple(rows))


def pooled_gate_table(records: Sequence[Mapping[str, Any]]) -> TextTable:
    """What the gates did, pooled by beacon and method."""
    rows = []
    for record in records:
        low, high = (100 * record[name] for name in ("accepted_low", "accepted_high"))
        rows.append(
            (
                str(record["beacon_id"]),
                str(record["dives"]),
                str(record["method"]),
                f"{record['replies']:,}",
                f"{100 * record['accepted']:.1f} %",
                "" if math.isnan(low) else f"{low:.1f} - {high:.1f}",
                metres(record["mean_nis"]),
                metres(record["smallest_visible_outlier_m"]),
            )
        )
    titles = ("beacon|text", "dives", "method|method", "replies", "accepted", "95 %")
    columns = _columns(*titles, "unit variance", "MDB, m")
    note = "MDB: minimal detectable bias of a one-way range; unit variance: mean NIS"
    return TextTable("gates", note, columns, tuple(rows))


def score_table(records: Sequence[Mapping[str, Any]]) -> TextTable:
    """Tracks of a benchmark's dives, a row a kind of dive."""

    def share(value: float | None) -> str:
        return "" if value is None else f"{100 * value:.1f}"

    rows = []
    for record in records:
        x = [record.get(name) for name in ("x_filter", "x_smoother")]
        rows.append(
            (
                str(record["kind"]),
                f"{record['scored']}/{record['dives']}",
                metres(record.get("rms_m")),
                metres(record.get("max_m")),
                " ".join("" if value is None else f"{value:.2f}" for value in x).strip(),
                metres(record.get("nees")),
                share(record.get("inside_95")),
                metres(record.get("sharpness")),
                f"{share(record.get('outliers_accepted'))} {share(record.get('good_rejected'))}",
                "" if "start_s" not in record else f"{record['start_s']:.0f}",
                "" if "seconds" not in record else f"{record['seconds']:.1f}",
                "" if "memory_mb" not in record else f"{record['memory_mb']:.0f}",
            )
        )
    columns = _columns(
        "kind|text", "dives", "rms m", "max m", "x", "NEES", "in 95", "sharp", "gate %", "start",
        "s", "MB",
    )  # fmt: skip
    note = (
        "Medians; max: worst.  x: over the filters' and the smoothers' bound; sharp: 95 % radius "
        "over 95th percentile; gate: wrong replies let in, others thrown out; start: seconds"
    )
    return TextTable("scores", note, columns, tuple(rows))


def method_table(solution: Solution) -> TextTable:
    """What each method is."""
    methods = [m for m in METHOD_NOTES if m in solution.tracks or m == "fix"]
    rows = tuple((method, METHOD_NOTES[method]) for method in methods)
    return TextTable("methods", "Methods", _columns("method|method", "what it is|text"), rows)


def gate_tables(solution: Solution) -> list[TextTable]:
    """What each method's gate did, by beacon, in the terms of survey quality control."""
    columns = _columns(
        "beacon|text", "replies", *DECISIONS_WORDS,
        "unit variance", "F-test 95 %|state", "inside 95 %",
        "minimal detectable bias [m]", "external reliability [m]", "gate|state",
    )  # fmt: skip
    names, tables = beacon_names(solution.dive), []
    for method, table in solution.statistics.items():
        gamma = math.inf if method == "ekf_ungated" else solution.gamma
        rows = []
        for row in (table[[k]] for k in range(len(table))):
            n, unit_variance = int(row.accepted[0]), float(row.mean_nis[0])
            watch = VERDICTS[row.verdict[0]] if method != "ekf_ungated" else "no gate"
            rows.append(
                (
                    names.get(int(row.beacon_id[0]), str(row.beacon_id[0])),
                    *(f"{getattr(row, k)[0]:,}" for k in ("replies", *DECISIONS)),
                    metres(unit_variance) or MISSING,
                    f_test(unit_variance, n, gamma),
                    number(row.nis_inside_95[0], 3),
                    number(row.smallest_visible_outlier_m[0], 1),
                    number(row.largest_unseen_step_m[0], 1),
                    watch,
                )
            )
        tables.append(TextTable(f"gate-{method}", f"Gate of {method}", columns, tuple(rows)))
    return [table for table in tables if table.rows]


def position_table(solution: Solution) -> TextTable:
    """Fixes of another kind, GNSS or USBL, and how many of them each method accepted."""
    rows = []
    for method, fixes in solution.positions.items():
        accepted = int((fixes.decision == DECISIONS.index("accepted")).sum())
        rows.append((method, f"{len(fixes):,}", f"{accepted:,}", f"{len(fixes) - accepted:,}"))
    columns = _columns("method|method", "positions", "accepted", "not accepted")
    return TextTable("positions", "Positions of another kind (GNSS, USBL)", columns, tuple(rows))


#: Headings of what became of the replies, in the order of `DECISIONS`.
DECISIONS_WORDS: Final = (
    "accepted", "w-test", "duplicate", "unknown", "before start", "not physical",
)  # fmt: skip


def f_test(unit_variance: float, n: int, gamma: float) -> str:
    """`inside`, `below` or `above` the 95 % bounds of the unit variance of `n` innovations.

    The squares of standard normal values, those above γ cut off, have the mean
        1 - 2 √γ φ(√γ) / P(|z| ≤ √γ),
    and n times the mean of n of them, over that, is near enough χ² with n degrees of freedom,
    whose bounds are Wilson and Hilferty's (1931).  `below` says that the noise was taken too
    large: the radius is on the safe side.
    """
    if n < 2 or not math.isfinite(unit_variance):
        return MISSING
    root = math.sqrt(gamma)
    cut = 0.0
    if math.isfinite(root):
        cut = 2 * root * math.exp(-gamma / 2) / math.sqrt(2 * math.pi) / math.erf(root / 2**0.5)
    low, high = (
        (1.0 - cut) * (1.0 - 2.0 / (9 * n) + z * math.sqrt(2.0 / (9 * n))) ** 3
        for z in (-1.96, 1.96)
    )
    return "below" if unit_variance < low else "above" if unit_variance > high else "inside"


def arrival_table(solution: Solution) -> TextTable:
    """How the replies came, by beacon, as the best method judged them, and what explains it."""
    method = next((m for m in ("smoother", "ekf", "ekf_gated") if m in solution.innovations), "")
    explained = [k for k, name in enumerate(EXPLANATIONS) if name not in ("", "direct")]
    rows = []
    names = beacon_names(solution.dive)
    if method:
        replies = solution.innovations[method]
        for beacon_id in np.unique(replies.beacon_id).tolist():
            own = replies[replies.beacon_id == beacon_id]
            classes = np.bincount(own.arrival, minlength=len(ARRIVALS))
            why = np.bincount(own.explanation, minlength=len(EXPLANATIONS))[explained]
            counts = (f"{n:,}" for n in (*classes, *why))
            rows.append((names.get(beacon_id, str(beacon_id)), *counts))
    columns = _columns("beacon|text", *ARRIVALS, *(spaced(EXPLANATIONS[k]) for k in explained))
    title = f"Arrivals, as {method} judged them, and what explains them"
    return TextTable("arrivals", title, columns, tuple(rows))


#: Heading -> column of `LegAccuracy`, of the distances beside the radius to rely on.
LEG_EVIDENCE: Final = {
    "by covariance alone": "formal_95_m",
    "beacon left out": "left_out_m",
    "expected": "left_out_expected_m",
    "ekf to smoother": "filter_smoother_m",
    "ekf run backwards": "forward_backward_m",
    "at crossings": "crossing_m",
}


def accuracy_table(solution: Solution) -> TextTable:
    """How far each leg of the smoothed track can be trusted, judged without truth."""
    legs = solution.accuracy
    columns = _columns(
        "from, dive time|text", "to|text", "course [°]", "length [m]", "replies",
        "95 % radius [m]", *LEG_EVIDENCE,
    )  # fmt: skip
    title, rows = "Accuracy of the smoothed track, leg by leg, without truth [m]", []
    if legs is None:
        return TextTable("accuracy", title, columns, ())
    for k in range(len(legs)):
        radius_m = math.nan if solution.verdict.level == "unusable" else legs.uncertainty_95_m[k]
        rows.append(
            (
                duration(legs.t_begin_s[k]),
                duration(legs.t_end_s[k]),
                f"{math.degrees(legs.course_rad[k]) % 360:.0f}",
                f"{legs.length_m[k]:,.0f}",
                f"{legs.n_replies[k]:,}",
                number(radius_m, 2),
                *(number(getattr(legs, name)[k], 2) for name in LEG_EVIDENCE.values()),
            )
        )
    return TextTable("accuracy", title, columns, tuple(rows))


def learned_table(solution: Solution) -> TextTable:
    """Parameters estimated with the track, with what was believed before beside them."""
    names = beacon_names(solution.dive)
    columns = _columns(
        "parameter|text", "beacon|text", "value", "±", "before", "±", "unit|text", "change, σ"
    )
    rows = []
    for item in solution.learned:
        change = (item.value - item.prior) / item.prior_sigma if item.prior_sigma > 0 else math.nan
        beacon = "" if item.beacon_id is None else names.get(item.beacon_id, str(item.beacon_id))
        figures = (number(x) for x in (item.value, item.sigma, item.prior, item.prior_sigma))
        rows.append((spaced(item.name), beacon, *figures, item.unit, number(change, 1)))
    return TextTable("learned", "Learned with the track", columns, tuple(rows))


def beacon_table(dive: Dive) -> TextTable:
    """Positions and turn-around times as used; latitude and longitude where there is an origin."""
    beacons, origin = dive.beacons, dive.origin
    titles = ["beacon|text", "id", "east [m]", "north [m]", "depth [m]", "turn-around [s]"]
    titles += ["sigma [m]"]
    cells = [
        [str(name) for name in beacons.name],
        [str(k) for k in beacons.id],
        *([f"{x:,.2f}" for x in column] for column in (beacons.position_enu_m * [1, 1, -1]).T),
        [f"{tau_s:.4f}" for tau_s in beacons.turn_around_s],
        [number(sigma_m) if sigma_m > 0 else "not stated" for sigma_m in beacons.sigma_m],
    ]
    if origin is not None:
        place = (origin.latitude_deg, origin.longitude_deg)
        latitude_deg, longitude_deg, _ = enu_to_geodetic(*place, beacons.position_enu_m)
        titles += ["latitude [°]", "longitude [°]"]
        cells += [[f"{x:.7f}" for x in column] for column in (latitude_deg, longitude_deg)]
    rows = tuple(zip(*cells, strict=True))
    return TextTable("beacons", "Beacons as used", _columns(*titles), rows)


def beacon_estimate_table(solution: Solution) -> TextTable:
    """How far the smoother moved each beacon, and its turn-around, from what was told."""
    columns = _columns(
        "beacon|text", "east [m]", "±", "north [m]", "±", "depth [m]", "±", "turn-around [ms]", "±"
    )
    estimates, beacons = solution.beacons, solution.dive.beacons
    rows = []
    for k in range(0 if estimates is None else len(estimates)):
        assert estimates is not None
        moved_m = (estimates.position_enu_m[k] - beacons.position_enu_m[k]) * [1, 1, -1]
        longer_ms = 1e3 * (estimates.turn_around_s[k] - beacons.turn_around_s[k])
        pairs = [*zip(moved_m, estimates.sigma_enu_m[k], strict=True)]
        pairs.append((longer_ms, 1e3 * estimates.turn_around_sigma_s[k]))
        figures = [number(x, 2, plus=x == value) for value, s in pairs for x in (value, s)]
        rows.append((beacon_names(solution.dive)[int(estimates.id[k])], *figures))
    title = "Beacons as estimated: change from the position and turn-around used"
    return TextTable("beacon-estimates", title, columns, tuple(rows))


def water_words(dive: Dive) -> str:
    """Origin and sound speed in a sentence each."""
    where = "There is no origin: positions are local only."
    if dive.origin is not None:
        place = f"{dive.origin.latitude_deg:.7f}°, {dive.origin.longitude_deg:.7f}°"
        where = f"Origin of east and north: {place} (WGS 84)."
    speed_mps, depth_m = dive.sound_speed.sound_speed_mps, dive.sound_speed.depth_m
    source = "".join(c.detail for c in dive.checks if c.name == "sound_speed_mean")
    speed = f"{speed_mps[0]:.1f} m/s at all depths"
    if np.ptp(speed_mps):
        speed = (
            f"{speed_mps.min():.1f} to {speed_mps.max():.1f} m/s in {len(depth_m)} levels, "
            f"{depth_m[0]:,.0f} to {depth_m[-1]:,.0f} m deep"
        )
    return printable(f"{where} Sound speed: {speed}{f', of {source}' if source else ''}.")


def sensor_table(solution: Solution) -> TextTable:
    """Messages, rates and gaps of each sensor."""
    dive, rows = solution.dive, []
    columns = {
        "heading": dive.heading.t_s,
        "velocity": dive.velocity.t_s,
        "depth": dive.depth.t_s,
        "replies": dive.replies.t_reply_s,
    }
    if dive.positions is not None:
        columns["positions"] = dive.positions.t_s
    for name, t_s in columns.items():
        step_s = np.diff(t_s).round(6) if len(t_s) > 1 else np.array([np.nan])
        span_s = float(step_s.sum())
        rate_hz = len(step_s) / span_s if span_s > 0 else math.nan
        begins = duration(float(t_s[int(step_s.argmax())])) if len(t_s) > 1 else ""
        rows.append((name, f"{len(t_s):,}", number(rate_hz, 2), number(step_s.max(), 2), begins))
    titles = ("sensor|text", "messages", "rate [Hz]", "longest gap [s]", "at dive time")
    return TextTable("sensors", "Sensors", _columns(*titles), tuple(rows))


def check_table(checks: Iterable[Check]) -> TextTable:
    """All checks, those that ask for a look first; a limit says whether it is the least or most."""
    rows = tuple(
        (
            "ok" if check.ok else "look",
            check.stage,
            spaced(check.name),
            f"{number(check.value)} {check.unit}".strip(),
            limit_words(check),
            check.detail,
        )
        for check in sorted(checks, key=lambda check: check.ok)
    )
    titles = ("|state", "stage|text", "check|text", "value|text", "limit|text", "where|text")
    return TextTable("checks", "Checks", _columns(*titles), rows)


def limit_words(check: Check) -> str:
    """`at least` or `at most` a value."""
    return f"at {'least' if check.bound == 'min' else 'most'} {number(check.limit)}"


def event_table(solution: Solution) -> TextTable:
    """What happened during the dive."""
    events = sorted(solution.events, key=lambda event: event.t_s)
    rows = tuple((duration(event.t_s), event.method, event.what) for event in events)
    titles = ("dive time|text", "method|method", "what|text")
    return TextTable("events", "Events", _columns(*titles), rows)


def finding_table(summary: Mapping[str, Any]) -> TextTable:
    """What the reader met in the files: damage, and what it left out."""
    rows = tuple(tuple(f[key] for key in ("what", "where", "detail")) for f in summary["findings"])
    titles = ("what|text", "where|text", "detail|text")
    return TextTable("findings", "Met in the files", _columns(*titles), rows)


def start_table(summary: Mapping[str, Any]) -> TextTable:
    """Where, when and by which rule each method began."""
    rows = tuple(
        (
            method,
            start["time"][:19].replace("T", " "),
            f"{start['east_m']:.1f}",
            f"{start['north_m']:.1f}",
            str(start["cycles"]),
            start["how"],
        )
        for method, start in summary["starts"].items()
    )
    titles = ("method|method", "UTC|text", "east [m]", "north [m]", "cycles", "by|text")
    return TextTable("starts", "Starts", _columns(*titles), rows)


def input_table(summary: Mapping[str, Any]) -> TextTable:
    """Files that went in, with their checksums."""
    rows = tuple((i["name"], f"{i['bytes']:,}", i["sha256"]) for i in summary["inputs"])
    titles = ("file|text", "bytes", "SHA-256|text")
    return TextTable("inputs", "Inputs", _columns(*titles), rows)


def setting_table(summary: Mapping[str, Any]) -> TextTable:
    """Every setting in force; what nobody gave and has no default is left out."""
    given = [(k, value) for k, value in _flat(summary["settings"]) if value not in (None, "", [])]
    rows = tuple((k, str(value)) for k, value in given)
    columns = _columns("key|text", "value|text")
    return TextTable("settings", "Settings in force", columns, rows)


# --- words and figures ------------------------------------------------------------------------


def beacon_names(dive: Dive) -> dict[int, str]:
    """Beacon id -> name, or the id where there is none."""
    beacons = dive.beacons
    return {int(k): str(name) or str(k) for k, name in zip(beacons.id, beacons.name, strict=True)}


def utc(time_ns: int) -> str:
    """UTC to the second."""
    return str(np.datetime64(time_ns, "ns").astype("M8[s]")).replace("T", " ")


def duration(seconds: float) -> str:
    """Hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60:02d} min {rest:02d} s"


def number(value: float, digits: int | None = None, plus: bool = False) -> str:
    """Number for a person, with its sign where `plus`; a dash for what does not exist."""
    if math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    sign = "+" if plus else ""
    return f"{value:{sign}.{digits}f}" if digits is not None else f"{value:{sign}.4g}"


def metres(value: float | None) -> str:
    """Distance for a person: two decimals below 100 m, none above; empty where there is none."""
    if value is None or math.isnan(value):
        return ""
    return f"{value:,.2f}" if value < 100 else f"{value:,.0f}"


def spaced(name: str) -> str:
    """Name of an identifier in words."""
    return name.replace("_", " ")


def failed_checks(solution: Solution) -> list[Check]:
    """Checks that ask a person to look."""
    return [check for check in (*solution.dive.checks, *solution.checks) if not check.ok]


def _columns(*titles: str) -> tuple[Column, ...]:
    """Columns of `title` or `title|kind`."""
    pairs = (title.partition("|") for title in titles)
    return tuple(Column(title, kind or "number") for title, _, kind in pairs)


def _distance_m(solution: Solution) -> float:
    """Way through the water plan: horizontal speed over time, lost bottom lock left out."""
    velocity = solution.dive.velocity
    speed_mps = np.hypot(velocity.velocity_body_mps[:, 0], velocity.velocity_body_mps[:, 1])
    good = velocity.valid & np.isfinite(speed_mps)
    if good.sum() < 2:
        return 0.0
    return float(np.trapezoid(speed_mps[good], velocity.t_s[good]))


def _range(values: Float, unit: str) -> str:
    return f"{values.min():,.0f} to {values.max():,.0f} {unit}" if len(values) else MISSING


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Sequence[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in settings.items():
        inner = isinstance(value, dict)
        rows += _flat(value, f"{prefix}{key}.") if inner else [(f"{prefix}{key}", value)]
    return rows
