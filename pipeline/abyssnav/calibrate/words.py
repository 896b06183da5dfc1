# SPDX-License-Identifier: Apache-2.0
"""A calibration in words: what was odd about the dives, what they determine, and what would."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from abyssnav.calibrate.campaign import CalibrationResult
from abyssnav.calibrate.evidence import DiveEvidence
from abyssnav.calibrate.settings_file import mounting_deg
from abyssnav.calibrate.unknowns import Group, stated_places
from abyssnav.calibrate.verdicts import DETERMINED, NOT_DETERMINED, WEAK, Estimate, label
from abyssnav.errors import printable
from abyssnav.outputs.presentation import Column, TextTable, number

#: Colour of each verdict, as the verdict of a dive has it.
LEVELS = {DETERMINED: "good", WEAK: "check", NOT_DETERMINED: "unusable"}
#: A dive of a shorter way, or of which more leads one way, moves too little.
_WAY_M, _STRAIGHT = 300.0, 0.9
#: A beacon's table has changed where it says places so far apart.
_CHANGED_M = 3.0
#: Sensors of which a vehicle has one each.
_VEHICLE = ("compass", "DVL", "lever arm")


def headline(result: CalibrationResult) -> str:
    """How many dives, and how much they determine, in a sentence."""
    count = dict.fromkeys(LEVELS, 0)
    for estimate in result.estimates:
        count[estimate.verdict] += 1
    one = len(result.dives) == 1
    dives = "one dive determines" if one else f"{len(result.dives)} dives determine"
    return (
        f"Of {len(result.estimates)} unknowns {dives} {count[DETERMINED]}, "
        f"{count[WEAK]} weakly; {count[NOT_DETERMINED]} stay as settings and tables have them."
    )


def remarks(result: CalibrationResult) -> list[str]:
    """What a person should know of the dives, one sentence or two each."""
    return [
        *_left_out(result),
        *_not_shared(result),
        *_contradicted(result),
        *_turned(result),
        *_apart(result),
        *_changed(result),
        *_still(result),
        *_unfit(result),
        *(f"{printable(d.name)}: {printable(note)}" for d in result.dives for note in d.notes),
    ]


def _left_out(result: CalibrationResult) -> Iterator[str]:
    for dive in result.left_out:
        yield f"{printable(dive.dive)} is left out: {dive.reason}"


def _not_shared(result: CalibrationResult) -> Iterator[str]:
    """Beacons that moved, sensors that changed, vehicles that are two."""
    own = result.adjustment.layout.own
    for group in sorted(own, key=lambda group: (group.name, group.beacon_id or 0)):
        if group.beacon_id is not None:
            what = "stands elsewhere" if group.name == "place" else "answers after another time"
            span = _between(result, group.name, group.beacon_id)
            yield (
                f"Beacon {group.beacon_id} {what} in different dives ({span}): each dive has its "
                "own."
            )
        elif group.name == "sound speed":
            yield (
                "The sound speed differs between the dives: each has its own, and none is written."
            )
    differing = [name for name in _VEHICLE if any(group.name == name for group in own)]
    if len(differing) > 1:
        yield (
            f"Two vehicles, it seems: {' and '.join(differing)} differ between the dives. Only the "
            "beacons are common; calibrate each vehicle's dives by themselves for its sensors."
        )
    elif differing:
        span = _between(result, differing[0], None)
        yield (
            f"The {differing[0]} differs between the dives ({span}): it was changed or is not "
            "constant, and is not written."
        )


def _between(result: CalibrationResult, group: str, beacon_id: int | None) -> str:
    """What differs most between dives, in numbers."""
    values: dict[str, list[Estimate]] = {}
    for e in result.estimates:
        if e.kind.group == group and e.unknown.beacon_id == beacon_id and e.unknown.dive:
            values.setdefault(e.kind.name, []).append(e)
    if group == "place":
        east, north = (values.get(f"beacon_{axis}", []) for axis in ("east", "north"))
        stated_m = result.adjustment.layout.place_m
        places = np.array([[e.value for e in axis] for axis in (east, north)])
        places += np.array([stated_m[e.unknown.beacon_id or 0, e.unknown.dive][:2] for e in east]).T
        far_m = np.max(np.hypot(*(places[:, :, None] - places[:, None])))
        return f"by up to {far_m:.1f} m"
    spans = [
        (np.ptp([e.value for e in group_of_one]) / group_of_one[0].kind.limit, group_of_one)
        for group_of_one in values.values()
    ]
    if not spans:
        return ""
    _, widest = max(spans, key=lambda span: float(span[0]))
    kind = widest[0].kind
    span = float(np.ptp([e.value for e in widest]))
    return f"{kind.name.replace('_', ' ')} by {number(span)} {kind.unit}".strip()


def _contradicted(result: CalibrationResult) -> Iterator[str]:
    """Beacons whose tables are wrong."""
    own = {group.beacon_id for group in result.adjustment.layout.own if group.name == "place"}
    place: dict[int, dict[str, Estimate]] = {}
    for e in result.estimates:
        if e.kind.group == "place" and e.unknown.beacon_id is not None:
            place.setdefault(e.unknown.beacon_id, {})[e.kind.name] = e
    for beacon, axes in place.items():
        east, north = axes["beacon_east"], axes["beacon_north"]
        miss_m = float(np.hypot(east.value, north.value))
        if beacon not in own and miss_m > 3 * max(east.prior_sigma, east.sigma):
            yield (
                f"Beacon {beacon} stands {miss_m:.1f} m from where its table has it (east "
                f"{east.value:+.1f}, north {north.value:+.1f} m, to {east.sigma:.1f} m)."
            )


def _turned(result: CalibrationResult) -> Iterator[str]:
    """Compass and DVL that point different ways."""
    turned = mounting_deg(result)
    if turned:
        yield (
            f"Compass and DVL are {abs(turned):.1f}° apart: taken for the DVL's mounting, as no "
            "compass is so far off. If it is the compass, move it from mount_rpy_deg to "
            "heading_bias_deg, with the other sign."
        )


def _apart(result: CalibrationResult) -> Iterator[str]:
    """Dives that no beacon ties together."""
    groups: list[set[int]] = []
    for dives in _dives_of_beacons(result.dives):
        joined = dives.union(*(group for group in groups if group & dives))
        groups = [group for group in groups if not group & joined] + [joined]
    if len(groups) > 1:
        named = "; ".join(
            ", ".join(printable(result.dives[row].name) for row in sorted(group))
            for group in groups
        )
        yield (
            f"No beacon answered in both of these: {named}. What is said of a beacon rests on its "
            "own dives; the vehicle's sensors are still common to all."
        )


def _dives_of_beacons(dives: Sequence[DiveEvidence]) -> Iterable[set[int]]:
    """For each beacon that answered, the dives in which it did."""
    result: dict[int, set[int]] = {}
    for place, dive in enumerate(dives):
        answered = np.unique(dive.setting.problem.observations.times.beacon)
        for beacon in dive.beacons.id[answered].tolist():
            result.setdefault(beacon, set()).add(place)
    return result.values()


def _changed(result: CalibrationResult) -> Iterator[str]:
    """Tables that differ from dive to dive."""
    first: dict[int, tuple[DiveEvidence, np.ndarray]] = {}
    for dive, places in zip(result.dives, stated_places(result.dives), strict=True):
        for row, beacon in enumerate(dive.beacons.id.tolist()):
            before, place_m = first.setdefault(beacon, (dive, places[row]))
            far_m = float(np.linalg.norm(places[row] - place_m))
            if far_m > max(_CHANGED_M, 3 * float(dive.beacons.sigma_m[row])):
                own = Group("place", beacon) in result.adjustment.layout.own
                since = "each dive's from its own" if own else "values count from the first"
                yield (
                    f"The tables of {printable(before.name)} and {printable(dive.name)} have "
                    f"beacon {beacon} {far_m:.1f} m apart: {since}."
                )


def _still(result: CalibrationResult) -> Iterator[str]:
    """Dives that move too little."""
    for dive in result.dives:
        way_m, straight = way(dive), straightness(dive)
        if way_m < _WAY_M or straight > _STRAIGHT:
            how = "hardly moves" if way_m < _WAY_M else "runs one way only"
            yield (
                f"{printable(dive.name)} {how} ({way_m:.0f} m). It holds beacons and sound speed "
                "at best; compass, DVL and lever arm need legs on several headings."
            )


def straightness(dive: DiveEvidence) -> float:
    """How much of a dive's way leads one way: distance made good over length."""
    displacement = dive.setting.problem.cells.displacement
    return float(np.abs(displacement.sum()) / max(np.abs(displacement).sum(), 1e-9))


def way(dive: DiveEvidence) -> float:
    """Length m of a dive's track."""
    return float(np.abs(dive.setting.problem.cells.displacement).sum())


def _unfit(result: CalibrationResult) -> Iterator[str]:
    for dive, share in zip(result.dives, result.explained, strict=True):
        if share < dive.explained - 0.1:
            yield (
                f"{printable(dive.name)} does not agree with the others: alone it explains "
                f"{100 * dive.explained:.0f} % of its replies, with common unknowns "
                f"{100 * share:.0f} %."
            )


def estimate_table(result: CalibrationResult) -> TextTable:
    """Every unknown: value, sigma, prior, what goes with it, verdict."""
    columns = (
        Column("unknown", "text"), Column("verdict", "text"), Column("value"), Column("sigma"),
        Column("prior sigma"), Column("limit"), Column("unit", "text"),
        Column("goes with", "text"), Column("what would determine it", "text"),
    )  # fmt: skip
    return TextTable(
        "estimates", "What is wrong, and how well that is known", columns,
        tuple(_row(e) for e in result.estimates),
    )  # fmt: skip


def _row(e: Estimate) -> tuple[str, ...]:
    unit, factor = (e.kind.unit, 1.0) if e.kind.unit != "s" else ("ms", 1000.0)
    if e.kind.unit == "":
        unit, factor = "%", 100.0
    digits = 4 if e.kind.unit in ("1/s", "") else 2
    figures = [f"{factor * e.value:+.{digits}f}"]
    figures += [f"{factor * v:.{digits}f}" for v in (e.sigma, e.prior_sigma, e.kind.limit)]
    goes_with = ", ".join(f"{name} {value:+.2f}" for name, value in e.correlated)
    motion = "" if e.verdict == DETERMINED else e.kind.motion
    return (label(e.unknown), e.verdict, *figures, unit, goes_with, motion)


def dive_table(result: CalibrationResult) -> TextTable:
    """The dives that take part."""
    columns = (
        Column("dive", "text"), Column("hours"), Column("way km"),
        Column("replies"), Column("explained alone %"), Column("explained together %"),
    )  # fmt: skip
    rows = tuple(
        (
            printable(dive.name), f"{(dive.end_ns - dive.begin_ns) / 3.6e12:.1f}",
            f"{way(dive) / 1000:.1f}", str(dive.n_replies),
            f"{100 * dive.explained:.1f}", f"{100 * share:.1f}",
        )
        for dive, share in zip(result.dives, result.explained, strict=True)
    )  # fmt: skip
    return TextTable("dives", "Dives", columns, rows)


def correlation_table(result: CalibrationResult) -> TextTable:
    """Correlation of every two of the vehicle's unknowns and the beacons' common ones."""
    rows = [
        row
        for row, unknown in enumerate(result.adjustment.layout.unknowns)
        if unknown.beacon_id is None and unknown in {e.unknown for e in result.estimates}
    ]
    _, cov = result.adjustment.solution
    sigma = np.sqrt(np.diagonal(cov))
    correlation = cov / np.outer(sigma, sigma)
    names = [label(result.adjustment.layout.unknowns[row]) for row in rows]
    columns = (Column("", "text"), *(Column(name) for name in names))
    body = tuple(
        (name, *(f"{correlation[row, other]:+.2f}" for other in rows))
        for name, row in zip(names, rows, strict=True)
    )
    return TextTable("correlation", "Correlations of the vehicle's unknowns", columns, body)


def short_table(estimates: Sequence[Estimate]) -> TextTable:
    """For a terminal: unknown, value with sigma, verdict."""
    columns = (
        Column("unknown", "text"), Column("verdict", "text"), Column("value"), Column("sigma"),
        Column("prior sigma"), Column("unit", "text"),
    )  # fmt: skip
    rows = tuple((*_row(e)[:5], _row(e)[6]) for e in estimates)
    return TextTable("estimates", "", columns, rows)
