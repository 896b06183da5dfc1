# SPDX-License-Identifier: Apache-2.0
"""The detective: what is likely wrong with a dive's conventions, clocks, beacons and sensors."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from abyssnav.config import Config
from abyssnav.diagnose.acoustics import ScoredAssumption, score_assumptions
from abyssnav.diagnose.beacon_place import by_fixes, locate
from abyssnav.diagnose.cause import Cause
from abyssnav.diagnose.clocks import apart_cause, without_overlap, zone_cause
from abyssnav.diagnose.course import recorded
from abyssnav.diagnose.motion import Scored, score_readings
from abyssnav.diagnose.motion_causes import Case, motion_cause
from abyssnav.diagnose.ranges import score_suspects
from abyssnav.diagnose.sensors import compass_stands_still, zeros_for_lost_lock
from abyssnav.diagnose.times_causes import acoustic_cause, range_cause, with_place
from abyssnav.diagnose.zones import offset_between, zone_shift
from abyssnav.estimation.dead_reckoning import DeadReckoning, dead_reckon
from abyssnav.tables import Bool, Dive, Fixes, Replies

#: A cause must be so much likelier than everything being as given, nats.
_GROSS_GAIN, _SMALL_GAIN = 12.0, 7.0
#: What the filters take into account anyway is told only where it is plain.
_WANDERING_GAIN = 20.0
#: Where the best reading beats what is given by so much, another time zone is tried too.
_LOST_GAIN = 100.0


class Examination(NamedTuple):
    """What is likely wrong, the heaviest first, and the fixes that judge compass and DVL."""

    causes: list[Cause]
    fixes: Fixes | None  #: None: too few, or recorded at another time than the velocities


def find_causes(dive: Dive, config: Config, fixes: Fixes | None = None) -> list[Cause]:
    """All that is likely wrong, the heaviest first.

    Parameters
    ----------
    fixes : those of the dive where its travel times are known to be read rightly; without them
        every reading of the times is tried first
    """
    return examine(dive, config, fixes).causes


def examine(dive: Dive, config: Config, fixes: Fixes | None = None) -> Examination:
    """What `find_causes` finds, with the fixes that it was found by."""
    zeros = zeros_for_lost_lock(dive)
    still = compass_stands_still(dive)
    candidates = [cause for cause in (zeros.cause, still) if cause is not None]
    case = Case(_without(dive, zeros.rows), config)
    replies = dive.replies[dive.replies.beacon >= 0]
    if fixes is None:
        by_times = _by_times(case)
        fixes, replies = by_times.fixes, by_times.change(replies)
        candidates += by_times.causes
    apart = without_overlap(case.dive)
    if apart is not None:
        offset_s = apart.offset_s
        if fixes is not None:
            offset_s = offset_between(case.dive, fixes, offset_s)
        return Examination([apart_cause(apart, offset_s), *_ranked(candidates)], None)
    if fixes is None or still is not None:
        return Examination(candidates, None)
    return Examination(_ranked(candidates + _by_way(case, fixes, replies, candidates)), fixes)


def _by_way(case: Case, fixes: Fixes, replies: Replies, known: list[Cause]) -> list[Cause]:
    """What the fixes say of compass and DVL, and then single ranges of small errors."""
    readings = score_readings(case.dive, fixes)
    if not readings:
        return []
    cause, reading = _by_motion(case, fixes, readings)
    causes = [] if cause is None else [cause]
    if any(one.role == "travel_time" for one in [*known, *causes]):
        return causes
    course = reading.reading.change(recorded(case.dive))
    cause = range_cause(case, score_suspects(case.dive, replies, course, reading))
    if cause is not None and cause.gain > _SMALL_GAIN:
        causes.append(cause)
    return causes


def plainly_wrong(dive: Dive) -> bool:
    """Whether something is wrong by the log's own numbers, without any statistics."""
    return (
        zeros_for_lost_lock(dive).cause is not None
        or compass_stands_still(dive) is not None
        or without_overlap(dive) is not None
    )


class _ByTimes(NamedTuple):
    """What the readings of the times say, and the fixes under the one that is believed."""

    causes: list[Cause]
    fixes: Fixes | None
    change: Callable[[Replies], Replies]


def _by_times(case: Case) -> _ByTimes:
    scored = score_assumptions(case.dive, dead_reckoned(case))
    cause = acoustic_cause(case, scored)
    if cause is not None and cause.name == "beacon_moved":
        cause = _placed(case, scored[0], cause)
    named = cause is not None and cause.gain > _GROSS_GAIN
    causes = [cause] if cause is not None and named else []
    if scored and (cause is None or named):
        return _ByTimes(causes, scored[0].fixes, scored[0].assumption.change)
    return _ByTimes(causes, _as_given(scored), lambda replies: replies)


def _placed(case: Case, best: ScoredAssumption, cause: Cause) -> Cause:
    """A beacon without which the others agree, with its place by the fixes that they make."""
    place = locate(case.dive, best.assumption.beacon, by_fixes(best.fixes))
    if place is None:
        return cause
    return with_place(case.dive, best.assumption.beacon, place, cause)


def _by_motion(case: Case, fixes: Fixes, readings: list[Scored]) -> tuple[Cause | None, Scored]:
    """What the readings of compass and DVL say, and the one that is believed."""
    cause = motion_cause(case, readings)
    if cause is not None and cause.gain > _LOST_GAIN:
        shift = zone_shift(case.dive, fixes, readings[0].log_likelihood)
        cause = cause if shift is None else zone_cause(shift.offset_s)
    if cause is not None and cause.gain > (
        _WANDERING_GAIN if cause.name == "noise" else _SMALL_GAIN
    ):
        return cause, readings[0]
    return None, next(one for one in readings if not one.reading.name)


def _ranked(candidates: list[Cause]) -> list[Cause]:
    """One of each name, by the evidence for it; what stands in the log's own numbers leads."""
    by_name = {cause.name: cause for cause in sorted(candidates, key=lambda c: c.gain)}
    return sorted(by_name.values(), key=lambda c: -c.gain)


def _as_given(scored: list[ScoredAssumption]) -> Fixes | None:
    return next((one.fixes for one in scored if not one.assumption.name), None)


def _without(dive: Dive, rows: Bool) -> Dive:
    """The dive with some velocities taken as lost."""
    if not rows.any():
        return dive
    return replace(dive, velocity=replace(dive.velocity, valid=dive.velocity.valid & ~rows))


def dead_reckoned(case: Case) -> DeadReckoning:
    """Dead reckoning over the time of the replies."""
    dive, process = case.dive, case.config.process
    span_s = (float(dive.replies.t_ping_s.min()), float(dive.replies.t_reply_s.max()))
    return dead_reckon(
        dive.velocity, dive.heading, span_s, process.gap_sigma_mps, process.max_gap_s
    )
