# SPDX-License-Identifier: Apache-2.0
"""The verdict: from what replies and fixes say of a track, never from what its method claims.

Every finding can lower the level, none raises it.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from abyssnav.config import Config
from abyssnav.diagnose import reasons
from abyssnav.diagnose.acoustics import fixes_anew
from abyssnav.diagnose.cause import Cause
from abyssnav.diagnose.causes import dead_reckoned, find_causes, plainly_wrong
from abyssnav.diagnose.clocks import (
    ahead_of_recorder_cause,
    beyond_cause,
    replies_beyond,
    sensor_losses,
)
from abyssnav.diagnose.evidence import (
    EXPLAINED_M,
    Misfit,
    Stretches,
    explained_by_beacon,
    misfit,
    positioned_track,
    stretches,
)
from abyssnav.diagnose.motion_causes import Case
from abyssnav.diagnose.parameters import (
    Stated,
    Suspicion,
    learned_causes,
    needs_detective,
    overruled,
    suspicion,
    without_dead_reckoning,
)
from abyssnav.diagnose.suspects import (
    left_out_cause,
    row_of_beacon,
    suspected_cause,
    with_errors_estimated,
    with_sound_estimated,
)
from abyssnav.tables import (
    LEVELS,
    Bool,
    Dive,
    Fixes,
    Float,
    LegAccuracy,
    Reason,
    Solution,
    Track,
    Verdict,
)

#: A track is wrong where fixes lie this many times their scatter, and these metres, from it.
_FAR_SCATTERS, _FAR_M = 4.0, 8.0
#: Fewer fixes in a stretch say nothing; each is made of so many replies at least.
_LEAST_FIXES, _REPLIES_OF_FIX = 3, 3
#: Explained replies are not believed to hold a track better than with beacons of this HDOP.
_LEAST_DILUTION = 2.0
#: Fewer replies of a stretch explained than this share contradict the track.
_LEAST_EXPLAINED, _LEAST_REPLIES = 0.2, 6
#: Beacons that must have an explained reply in a stretch for it to be positioned.
_LEAST_BEACONS = 2
#: Shares of the dive in which the track is contradicted, or nothing supports it.
_WRONG_UNUSABLE, _BLIND_CHECK, _BLIND_UNUSABLE = 0.1, 0.1, 0.5

#: A beacon with so many replies, of which the track explains this share at most though it explains
#: that of the others at least, is not where it is given; a named cause of such a gain goes before.
_LEAST_OF_BEACON, _REFUSED_SHARE, _OTHERS_SHARE, _GROSS_GAIN = 15, 0.3, 0.55, 300.0
#: Its weight where nothing else is named.
_OF_LEFT_OUT = 100.0
#: So many beacons leave the mirror image of a track in the line between them.
_MIRRORED_BEACONS = 2
#: Fewer of the fixes consistent: the times may be read wrongly.
_LEAST_CONSISTENT = 0.2
#: Probability beyond which the smoother's hypotheses are sure that something is wrong.
_SURE = 0.95
#: Dilution of precision beyond which the beacons lie in one direction, and its share of the dive.
_WEAK_DILUTION, _WEAK_SHARE = 8.0, 0.4
#: Replies stamped so far off, in metres of way, place the vehicle where it is not.
_OFF_BY_CLOCK_M = 20.0
#: Beyond it no recorder stops its sensors before its acoustics.
_PLAINLY_LATE_S = 60.0
#: Weight of what stands in the stamps themselves.
_CERTAIN = 1e5
#: Beside it, what a lost sensor or another clock does to the track looks like more faults.
_MAY_FOLLOW = "Mend the first reason and run again before this one, which may follow from it."
#: Causes beside which small errors are no news.
_GROSS = {
    "heading_constant", "heading_sense", "heading_reference", "heading_unit", "heading_offset",
    "dvl_mount", "dvl_frame", "dvl_sign", "dvl_unit", "zeros_when_lost", "time_one_way",
    "turn_around_removed", "time_unit", "beacon_ids", "depth", "clock_offset", "sound_speed",
}  # fmt: skip


class Finding(NamedTuple):
    """One thing that lowers the verdict to `level`; the heaviest is told first."""

    level: str
    weight: float
    reason: Reason


def with_verdict(solution: Solution, config: Config) -> Solution:
    """The solution with its verdict; without radii where no track is to be relied on."""
    verdict = judge(solution, config)
    accuracy = solution.accuracy
    if verdict.level == "unusable" and accuracy is not None:
        unknown_m = np.full(len(accuracy), np.nan)
        accuracy = replace(accuracy, uncertainty_95_m=unknown_m)
    elif accuracy is not None and verdict.level != LEVELS[0]:
        accuracy = replace(accuracy, uncertainty_95_m=_widened(solution, accuracy, config))
    return replace(solution, verdict=verdict, accuracy=accuracy)


def _widened(solution: Solution, accuracy: LegAccuracy, config: Config) -> Float:
    """Radius (n,) of each leg, no smaller than what contradicts the track on it."""
    best = positioned_track(solution)
    if best is None:
        return accuracy.uncertainty_95_m
    case = Case(solution.dive, config)
    table = _support(solution, case, best[1], _suspected(solution, case))
    table = table[contradicted(table)]
    overlap = table.t_begin_s < accuracy.t_end_s[:, None]
    overlap &= table.t_end_s > accuracy.t_begin_s[:, None]
    far_m = np.where(overlap, np.nan_to_num(table.fix_distance_m), 0.0)
    return np.asarray(np.hypot(accuracy.uncertainty_95_m, np.max(far_m, axis=1, initial=0.0)))


def judge(solution: Solution, config: Config) -> Verdict:
    """Level of a dive and the reasons for it, the likeliest cause first."""
    clocks = _of_stamps(solution)
    if not len(solution.dive.replies) and positioned_track(solution) is not None:
        return _verdict(clocks)  # fixes of another kind: no reply contradicts them
    case = Case(solution.dive, config)
    suspected = _suspected(solution, case)
    best = positioned_track(solution)
    rows = None if best is None else misfit(solution.dive, best[1])
    positioning = _of_positioning(solution, case, suspected, rows)
    causes = _causes(solution, case, doubtful=bool(positioning))
    if any(cause.name == "clock_offset" and cause.role == "travel_time" for cause in causes):
        # What fixes measure is the whole of it; the ends of the records say how much at least.
        clocks = [finding for finding in clocks if finding.reason.name != "clock_offset"]
    left_out = _left_out_beacon(solution, causes, rows)
    if suspected is not None and suspected.since_s is not None:
        left_out = None  # one that was moved during the dive says what it is by itself
        causes = _without_beacon(
            solution, case, row_of_beacon(solution.dive, suspected.beacon_ids[0])
        )
    elif left_out is not None:
        exchanged = [cause for cause in causes if cause.name == "beacon_ids"]
        causes = exchanged + _without_beacon(solution, case, left_out.row)
        suspected = None  # it was weighed with that beacon's replies
    explained = [Finding(_level(solution, cause), cause.gain, cause.reason()) for cause in causes]
    if any(finding.weight > _CERTAIN and finding.level == "unusable" for finding in explained):
        clocks = []  # what a clock in another zone explains is not lost
    explained += _of_suspicion(solution, case, suspected, causes)
    explained += _of_left_out_beacon(solution, causes, left_out)
    explained += _of_learned(solution, case, causes)
    if explained and positioning:
        positioning = _explained_by(positioning, explained)
    return _verdict([*clocks, *explained, *positioning])


def _suspected(solution: Solution, case: Case) -> Suspicion | None:
    """What is likeliest wrong; two beacons leave nothing over by which they could be checked."""
    if _n_answering(solution.dive) <= _MIRRORED_BEACONS:
        return None
    return suspicion(solution.causes, Stated.of_dive(solution.dive, case.config))


def _of_stamps(solution: Solution) -> list[Finding]:
    """Sensors that lack a part of the replies' time, or replies stamped by another clock."""
    dive = solution.dive
    ahead, beyond = ahead_of_recorder_cause(dive), replies_beyond(dive)
    findings = []
    if ahead is not None:
        findings.append(Finding(_level(solution, ahead), _CERTAIN, ahead.reason()))
    if beyond is None:
        losses = sensor_losses(dive)
        lacking = [
            Finding("check", _CERTAIN + loss.length_s, reasons.sensor_lost(loss)) for loss in losses
        ]
        return findings + lacking
    plainly = beyond.both_ends and abs(beyond.late_s) > _PLAINLY_LATE_S
    level = "unusable" if plainly else "check"
    return [*findings, Finding(level, _CERTAIN + abs(beyond.late_s), beyond_cause(beyond).reason())]


def _n_answering(dive: Dive) -> int:
    return len(np.unique(dive.replies.beacon[dive.replies.beacon >= 0]))


def _verdict(findings: list[Finding]) -> Verdict:
    level = max((f.level for f in findings), key=LEVELS.index, default="good")
    ranked = sorted(findings, key=lambda f: -f.weight)
    ordered = _once(f.reason for f in ranked)
    if ranked and ranked[0].weight >= _CERTAIN:
        ordered[1:] = [
            replace(reason, advice=f"{_MAY_FOLLOW} {reason.advice}") for reason in ordered[1:]
        ]
    return Verdict(level, tuple(ordered))


def _causes(solution: Solution, case: Case, *, doubtful: bool) -> list[Cause]:
    """What the detective names, where anything is unusual or written in the log's own numbers."""
    dive, fixes = solution.dive, solution.fixes
    stated = Stated.of_dive(dive, case.config)
    if not (doubtful or needs_detective(solution, stated) or plainly_wrong(dive)):
        return []
    few = len(fixes) == 0 or float(np.mean(fixes.consistent)) < _LEAST_CONSISTENT
    return _named_causes(solution, case, None if doubtful or few else fixes)


def _named_causes(solution: Solution, case: Case, fixes: Fixes | None = None) -> list[Cause]:
    """What the detective names by a dive's replies, unless the smoother contradicts it."""
    causes = find_causes(case.dive, case.config, fixes)
    return [cause for cause in causes if not overruled(solution, cause)]


def _of_suspicion(
    solution: Solution, case: Case, suspected: Suspicion | None, causes: list[Cause]
) -> list[Finding]:
    """What the smoother's hypotheses of beacons, clock and lever arm say, if the causes do not.

    They weigh small errors with all replies at once, so they go before other small ones.
    """
    named = {cause.name for cause in causes}
    if suspected is None or suspected.name in named or _GROSS & named:
        return []
    cause = suspected_cause(solution, suspected, case)
    first = max((one.gain for one in causes), default=0.0) + 1.0
    weight = max(cause.gain, first if suspected.probability > _SURE else 0.0)
    return [Finding("check", weight, cause.reason())]


class LeftOut(NamedTuple):
    """A beacon whose replies the track never explains, though it explains those of the others."""

    row: int
    share: float  #: of its replies, explained
    others: float  #: median of the others' shares


def _left_out_beacon(
    solution: Solution, causes: list[Cause], rows: Misfit | None
) -> LeftOut | None:
    if rows is None or _GROSS & {cause.name for cause in causes if cause.gain > _GROSS_GAIN}:
        return None
    n, share = explained_by_beacon(solution.dive, rows)
    frequent = np.flatnonzero(n >= _LEAST_OF_BEACON)
    if len(frequent) < _MIRRORED_BEACONS + 1:
        return None
    worst = int(frequent[np.argmin(share[frequent])])
    others = float(np.median(share[frequent[frequent != worst]]))
    if share[worst] > _REFUSED_SHARE or others < _OTHERS_SHARE:
        return None
    return LeftOut(worst, float(share[worst]), others)


def _without_beacon(solution: Solution, case: Case, row: int) -> list[Cause]:
    """What the detective names by the other beacons' replies: its own would make up causes."""
    return _named_causes(solution, case._replace(dive=_other_beacons(case.dive, row)))


def _other_beacons(dive: Dive, row: int) -> Dive:
    return replace(dive, replies=dive.replies[dive.replies.beacon != row])


def _of_left_out_beacon(
    solution: Solution, causes: list[Cause], left_out: LeftOut | None
) -> list[Finding]:
    """The beacon that the track leaves out, before all else."""
    if left_out is None:
        return []
    first = max((cause.gain for cause in causes), default=_OF_LEFT_OUT) + 2.0
    number = int(solution.dive.beacons.id[left_out.row])
    observed = (
        f"The track explains {reasons.percent(left_out.share)} of the replies of beacon "
        f"{number}, and {reasons.percent(left_out.others)} of those of the others."
    )
    return [Finding("check", first, left_out_cause(solution, left_out.row, observed).reason())]


def _of_learned(solution: Solution, case: Case, causes: list[Cause]) -> list[Finding]:
    """What the smoother had to learn of sensors of which the detective says nothing."""
    named = {cause.name for cause in causes}
    if named & (_GROSS | {"zeros_when_lost"}):
        return []
    roles = {cause.role for cause in causes}
    return [
        Finding("check", cause.gain, cause.reason())
        for cause in learned_causes(solution, case.config)
        if cause.role not in roles
    ]


def _explained_by(positioning: list[Finding], explained: list[Finding]) -> list[Finding]:
    """What is wrong with the track, told in the first cause's name."""
    first = max(explained, key=lambda f: f.weight)
    worst = max(positioning, key=lambda f: (LEVELS.index(f.level), f.weight))
    observed = f"{worst.reason.seen} {first.reason.seen}"
    return [Finding(worst.level, first.weight + 1.0, replace(first.reason, seen=observed))]


def _once(findings: Iterable[Reason]) -> list[Reason]:
    """The first reason of each name."""
    return list({reason.name: reason for reason in reversed(list(findings))}.values())[::-1]


def _level(solution: Solution, cause: Cause) -> str:
    """Where replies and vehicle are not on one clock, no track is where the vehicle was."""
    if cause.name == "no_overlap":
        return "unusable"
    if cause.name != "clock_offset" or cause.role != "travel_time":
        return "check"
    speed_mps = np.hypot(*solution.dive.velocity.velocity_body_mps[:, :2].T)
    off_m = abs(float(cause.value.split()[0])) * float(np.median(speed_mps))
    return "unusable" if off_m > _OFF_BY_CLOCK_M else "check"


def _of_positioning(
    solution: Solution, case: Case, suspected: Suspicion | None, rows: Misfit | None
) -> list[Finding]:
    """What replies and fixes say of the best track."""
    dive = solution.dive
    best = positioned_track(solution)
    n_answering = _n_answering(dive)
    if best is None or rows is None:
        sides = next((c.detail for c in solution.checks if c.name == "mirrored_starts"), "")
        return [Finding("unusable", 10.0, reasons.no_track(dive, n_answering, sides))]
    method, track = best
    table = _support(solution, case, track, suspected)
    findings = _of_stretches(method, table)
    if n_answering <= _MIRRORED_BEACONS:
        findings.append(Finding("check", 1.0, reasons.mirrored(dive, n_answering)))
    lost = without_dead_reckoning(solution)
    if lost:
        findings.append(Finding("unusable", 1.0, reasons.without_dead_reckoning(lost)))
    return findings


def _support(
    solution: Solution, case: Case, track: Track, suspected: Suspicion | None
) -> Stretches:
    """What fixes and replies say of a track; with what it puts right where they contradict it.

    The fixes of before rest on beacons, lever arm and sound speed as they are given: beside a track
    that has one of them put right they say nothing.
    """
    dive, fixes = solution.dive, solution.fixes
    table = stretches(dive, track, fixes, misfit(dive, track), case.config)
    if not contradicted(table).any():
        return table
    dive = _as_estimated(solution, case, suspected)
    fixes = fixes_anew(dive, dead_reckoned(case))
    return stretches(dive, track, fixes, misfit(dive, track), case.config)


def _is_estimated(suspected: Suspicion) -> bool:
    """Whether the smoother's track has it put right: one beacon, the delay of all, or the arm."""
    return bool(suspected.beacon_ids) or suspected.name in ("turn_around", "lever_arm")


def _as_estimated(solution: Solution, case: Case, suspected: Suspicion | None) -> Dive:
    """The dive with what is suspected as the smoother has it, or else the sound speed."""
    if suspected is None or not _is_estimated(suspected):
        return with_sound_estimated(solution)
    if suspected.beacon_ids:
        return _other_beacons(case.dive, row_of_beacon(case.dive, suspected.beacon_ids[0]))
    return with_errors_estimated(solution)


def _of_stretches(method: str, table: Stretches) -> list[Finding]:
    """What the stretches of a track lack: agreement, replies, or beacons on more than one side."""
    length_s = table.t_end_s - table.t_begin_s
    total_s = float(length_s.sum())
    off, blind = contradicted(table), unsupported(table)
    vague = (table.dilution > _WEAK_DILUTION) & ~off & ~blind
    findings = []
    if off.any():
        share = float(length_s[off].sum()) / total_s
        level = "unusable" if share > _WRONG_UNUSABLE else "check"
        findings.append(Finding(level, share, reasons.contradicted(method, table[off], share)))
    share = float(length_s[blind & ~off].sum()) / total_s
    if share > _BLIND_CHECK:
        level = "unusable" if share > _BLIND_UNUSABLE else "check"
        findings.append(Finding(level, share, reasons.unsupported(share)))
    share = float(length_s[vague].sum()) / total_s
    if share > _WEAK_SHARE:
        worst = float(np.median(table.dilution[vague]))
        findings.append(Finding("check", 0.5 * share, reasons.weak_geometry(worst, share)))
    return findings


def contradicted(table: Stretches) -> Bool:
    """Stretches in which fixes lie far from the track, or most replies cannot be explained."""
    far = table.fix_distance_m > np.maximum(_FAR_M, _FAR_SCATTERS * table.fix_scatter_m)
    enough = table.fixes >= _LEAST_FIXES
    far &= enough & ~_outvoted(table)
    # In bad acoustics most replies are wrong: fixes near the track speak for it.
    refused = (table.explained < _LEAST_EXPLAINED * table.replies) & ~(enough & ~far)
    return np.asarray(far | (refused & (table.replies >= _LEAST_REPLIES)))


def _outvoted(table: Stretches) -> Bool:
    """Stretches in which more replies support the track than the fixes, and both cannot be right.

    The track explains replies of three beacons or more to 12 m; where that holds it to less than
    the fixes are off, these are made of wrong replies.
    """
    more = table.explained > _REPLIES_OF_FIX * table.fixes
    held_m = EXPLAINED_M * np.maximum(np.nan_to_num(table.dilution, nan=np.inf), _LEAST_DILUTION)
    return np.asarray(more & (table.beacons > _MIRRORED_BEACONS) & (table.fix_distance_m > held_m))


def unsupported(table: Stretches) -> Bool:
    """Stretches in which fewer than two beacons are heard as the track has it."""
    return np.asarray(table.beacons < _LEAST_BEACONS)
