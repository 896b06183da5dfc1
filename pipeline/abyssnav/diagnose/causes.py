# SPDX-License-Identifier: Apache-2.0
"""The detective: what is likely wrong with a dive's conventions, clocks, beacons and sensors."""

from dataclasses import replace

from abyssnav.config import Config
from abyssnav.diagnose.acoustics import ScoredAssumption, score_assumptions
from abyssnav.diagnose.cause import Cause
from abyssnav.diagnose.clocks import without_overlap
from abyssnav.diagnose.course import recorded
from abyssnav.diagnose.motion import score_readings
from abyssnav.diagnose.named import (
    acoustic_cause,
    apart_cause,
    clock_cause,
    motion_cause,
    range_cause,
)
from abyssnav.diagnose.ranges import score_suspects
from abyssnav.diagnose.sensors import compass_stands_still, zeros_for_lost_lock
from abyssnav.diagnose.zones import offset_between, zone_shift
from abyssnav.estimation.dead_reckoning import DeadReckoning, dead_reckon
from abyssnav.tables import Bool, Dive, Fixes

#: A cause must be so much likelier than everything being as given, nats.
_GROSS_GAIN, _SMALL_GAIN = 12.0, 7.0
#: What the filters take into account anyway is told only where it is plain.
_WANDERING_GAIN = 20.0
#: Where the best reading beats what is given by so much, another time zone is tried too.
_LOST_GAIN = 100.0


def find_causes(dive: Dive, config: Config, fixes: Fixes | None = None) -> list[Cause]:
    """All that is likely wrong, the heaviest first.

    Parameters
    ----------
    fixes : those of the dive where its travel times are known to be read rightly; without them
        every reading of the times is tried first
    """
    zeros = zeros_for_lost_lock(dive)
    still = compass_stands_still(dive)
    candidates = [cause for cause in (zeros.cause, still) if cause is not None]
    dive = _without(dive, zeros.rows)
    replies = dive.replies[dive.replies.beacon >= 0]
    if fixes is None:
        scored = score_assumptions(dive, _motion(dive, config))
        cause = acoustic_cause(scored)
        if cause is not None and cause.gain > _GROSS_GAIN:
            candidates.append(cause)
        if scored and (cause is None or cause.gain > _GROSS_GAIN):
            fixes, replies = scored[0].fixes, scored[0].assumption.change(replies)
        else:
            fixes = _as_given(scored)
    apart = without_overlap(dive)
    if apart is not None:
        offset_s = apart.offset_s if fixes is None else offset_between(dive, fixes, apart.offset_s)
        return [apart_cause(apart, offset_s), *_ranked(candidates)]
    if fixes is None or still is not None:
        return candidates
    readings = score_readings(dive, fixes)
    if not readings:
        return candidates
    cause = motion_cause(dive, readings)
    if cause is not None and cause.gain > _LOST_GAIN:
        shift = zone_shift(dive, fixes, readings[0].log_likelihood)
        cause = cause if shift is None else clock_cause(shift.offset_s)
    reading = readings[0]
    if cause is not None and cause.gain > (
        _WANDERING_GAIN if cause.name == "noise" else _SMALL_GAIN
    ):
        candidates.append(cause)
    else:
        reading = next(one for one in readings if not one.reading.name)
    if not any(one.role == "travel_time" for one in candidates):
        course = reading.reading.change(recorded(dive))
        suspects = score_suspects(dive, replies, course, reading)
        cause = range_cause(dive, suspects)
        if cause is not None and cause.gain > _SMALL_GAIN:
            candidates.append(cause)
    return _ranked(candidates)


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


def _motion(dive: Dive, config: Config) -> DeadReckoning:
    t_s = dive.replies.t_reply_s
    span_s = (float(dive.replies.t_ping_s.min()), float(t_s.max()))
    process = config.process
    return dead_reckon(
        dive.velocity, dive.heading, span_s, process.gap_sigma_mps, process.max_gap_s
    )
