# SPDX-License-Identifier: Apache-2.0
"""The verdict: from what replies and fixes say of a track, never from what its method claims.

Every finding can lower the level, none raises it.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from abyssnav.diagnose import reasons
from abyssnav.diagnose.clocks import sensor_losses, without_overlap
from abyssnav.diagnose.evidence import Stretches, positioned_track, stretches
from abyssnav.tables import LEVELS, Bool, Reason, Solution, Verdict

#: A track is wrong where fixes lie this many times their scatter, and these metres, from it.
_FAR_SCATTERS, _FAR_M = 4.0, 8.0
#: Fewer fixes in a stretch say nothing.
_LEAST_FIXES = 3
#: Fewer replies of a stretch explained than this share contradict the track.
_LEAST_EXPLAINED, _LEAST_REPLIES = 0.3, 6
#: Beacons that must have an explained reply in a stretch for it to be positioned.
_LEAST_BEACONS = 2
#: Shares of the dive in which the track is contradicted, or nothing supports it.
_WRONG_UNUSABLE, _BLIND_CHECK, _BLIND_UNUSABLE = 0.2, 0.1, 0.5


class Finding(NamedTuple):
    """One thing that lowers the verdict to `level`; the heaviest is told first."""

    level: str
    weight: float
    reason: Reason


def with_verdict(solution: Solution) -> Solution:
    """The solution with its verdict; without radii where no track is to be relied on."""
    verdict = judge(solution)
    accuracy = solution.accuracy
    if verdict.level == "unusable" and accuracy is not None:
        unknown_m = np.full(len(accuracy), np.nan)
        accuracy = replace(accuracy, uncertainty_95_m=unknown_m)
    return replace(solution, verdict=verdict, accuracy=accuracy)


def judge(solution: Solution) -> Verdict:
    """Level of a dive and the reasons for it, the likeliest cause first."""
    findings = [*_of_clocks(solution), *_of_positioning(solution)]
    level = max((f.level for f in findings), key=LEVELS.index, default="good")
    ranked = sorted(findings, key=lambda f: (-LEVELS.index(f.level), -f.weight))
    return Verdict(level, tuple(_once(f.reason for f in ranked)))


def _once(found: Iterable[Reason]) -> list[Reason]:
    """The first reason of each name."""
    return list({reason.name: reason for reason in reversed(list(found))}.values())[::-1]


def _of_clocks(solution: Solution) -> list[Finding]:
    dive = solution.dive
    apart = without_overlap(dive)
    if apart is not None:
        return [Finding("unusable", 100.0, reasons.no_overlap(apart))]
    return [
        Finding("check", loss.length_s, reasons.sensor_lost(loss)) for loss in sensor_losses(dive)
    ]


def _of_positioning(solution: Solution) -> list[Finding]:
    dive = solution.dive
    best = positioned_track(solution)
    if best is None:
        answering = len(np.unique(dive.replies.beacon[dive.replies.beacon >= 0]))
        return [Finding("unusable", 10.0, reasons.no_track(dive, answering))]
    method, track = best
    table = stretches(dive, track, solution.fixes)
    length_s = table.t_end_s - table.t_begin_s
    total_s = float(length_s.sum())
    off, blind = contradicted(table), unsupported(table)
    found = []
    if off.any():
        share = float(length_s[off].sum()) / total_s
        level = "unusable" if share > _WRONG_UNUSABLE else "check"
        found.append(Finding(level, share, reasons.contradicted(method, table[off], share)))
    share = float(length_s[blind & ~off].sum()) / total_s
    if share > _BLIND_CHECK:
        level = "unusable" if share > _BLIND_UNUSABLE else "check"
        found.append(Finding(level, share, reasons.unsupported(share)))
    return found


def contradicted(table: Stretches) -> Bool:
    """Stretches in which fixes lie far from the track, or most replies cannot be explained."""
    far = table.fix_distance_m > np.maximum(_FAR_M, _FAR_SCATTERS * table.fix_scatter_m)
    far &= table.fixes >= _LEAST_FIXES
    refused = table.explained < _LEAST_EXPLAINED * table.replies
    return np.asarray(far | (refused & (table.replies >= _LEAST_REPLIES)))


def unsupported(table: Stretches) -> Bool:
    """Stretches in which fewer than two beacons are heard as the track has it."""
    return np.asarray(table.beacons < _LEAST_BEACONS)
