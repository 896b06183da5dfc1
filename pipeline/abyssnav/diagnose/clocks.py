# SPDX-License-Identifier: Apache-2.0
"""The time doctor: which sensors were running while replies came."""

from typing import NamedTuple

import numpy as np

from abyssnav.diagnose.cause import CERTAIN, REPLIES_CLOCK, Cause, Mend, length
from abyssnav.tables import REPLIES_AHEAD, Dive, Float

#: A sensor that stops so long before the last reply, or begins so long after the first, is lost.
_LOST_S = 30.0
#: ... and so many of its own periods.
_LOST_PERIODS = 10.0
#: A loss of bottom lock at either end, of this share of the dive, is one like any other.
_ONE_LOSS = 0.1
#: Replies are heard some seconds after their pings; farther outside the record of all sensors they
#: are stamped by another clock.  Begin and end may tell lengths that differ by this share.
_BEYOND_S, _ALIKE = 10.0, 0.1
#: Share of the replies' time that velocity must cover.
_LEAST_OVERLAP = 0.5


class Loss(NamedTuple):
    """Time for which a sensor said nothing while replies came, at the begin or the end."""

    sensor: str
    length_s: float
    share: float  #: of the time in which replies came
    at_end: bool
    t_s: float  #: when it stopped or began


class Apart(NamedTuple):
    """Spans of replies and velocity that overlap little."""

    overlap: float  #: share of the replies' time
    replies_s: tuple[float, float]
    velocity_s: tuple[float, float]
    offset_s: float  #: to be added to the replies' stamps, by the begin of both


def spans(dive: Dive) -> dict[str, tuple[float, float]]:
    """First and last instant of each sensor's values, and of the replies."""
    outside_s = dive.replies.t_reply_s
    if not len(outside_s) and dive.positions is not None:  # fixes stand for replies
        outside_s = dive.positions.t_s
    times: dict[str, Float] = {
        "compass": dive.heading.t_s,
        "velocity": dive.velocity.t_s[dive.velocity.valid],
        "depth": dive.depth.t_s,
        "replies": outside_s,
    }
    return {name: (float(t_s.min()), float(t_s.max())) for name, t_s in times.items()}


def without_overlap(dive: Dive) -> Apart | None:
    """Replies and velocity that were hardly recorded at the same time; None when they were."""
    span = spans(dive)
    replies_s, velocity_s = span["replies"], span["velocity"]
    common_s = min(replies_s[1], velocity_s[1]) - max(replies_s[0], velocity_s[0])
    overlap = max(common_s, 0.0) / max(replies_s[1] - replies_s[0], 1.0)
    lasts_alike = velocity_s[1] - velocity_s[0] > _LEAST_OVERLAP * (replies_s[1] - replies_s[0])
    if overlap >= _LEAST_OVERLAP or not lasts_alike:
        return None
    return Apart(overlap, replies_s, velocity_s, velocity_s[0] - replies_s[0])


class Beyond(NamedTuple):
    """Replies after all sensors had ended, or before any began: their stamps are off."""

    late_s: float  #: by so much at least; negative: early
    both_ends: bool  #: whether begin and end of the record say the same


def replies_beyond(dive: Dive) -> Beyond | None:
    """By how much replies were stamped outside the time in which compass, DVL and depth ran.

    One sensor that ends early is lost; all of them end when the recording does.
    """
    sensors = (dive.heading.t_s, dive.velocity.t_s, dive.depth.t_s)
    begin_s, end_s = min(t_s[0] for t_s in sensors), max(t_s[-1] for t_s in sensors)
    heard_s = dive.replies.t_reply_s
    if not len(heard_s):
        return None
    at_begin_s, at_end_s = float(heard_s.min() - begin_s), float(heard_s.max() - end_s)
    late_s = at_end_s if at_end_s > -at_begin_s else at_begin_s
    if max(at_end_s, -at_begin_s) < _BEYOND_S:
        return None
    both_ends = abs(at_end_s - at_begin_s) < _LOST_S + _ALIKE * abs(late_s)
    return Beyond(late_s, both_ends)


def beyond_cause(beyond: Beyond) -> Cause:
    """The acoustic clock is off by what its replies run past the other sensors."""
    late_s = beyond.late_s
    until = "until" if late_s > 0 else "from"
    ran = "after compass, DVL and depth all ended" if late_s > 0 else "before any sensor began"
    return Cause(
        "travel_time", "clock_offset", f"{late_s:+.0f} s", CERTAIN, _replies_moved(-late_s),
        f"Replies are stamped {until} {length(abs(late_s))} {ran}.",
        "If the receiver was merely switched on earlier or off later than the sensors, nothing is "
        "wrong: change nothing.",
    )  # fmt: skip


def ahead_of_recorder_cause(dive: Dive) -> Cause | None:
    """The acoustic clock is ahead where the recorder had replies before their pings' stamps."""
    ahead_s = next((c.value for c in dive.checks if c.name == REPLIES_AHEAD), None)
    if ahead_s is None:
        return None
    return Cause(
        "travel_time", "clock_offset", f"{ahead_s:+.1f} s", CERTAIN, _replies_moved(-ahead_s),
        f"The recorder wrote replies down before the instants at which they say their pings were "
        f"sent; their stamps are {ahead_s:.1f} s later, against the recorder's clock, than those "
        "of compass, DVL and depth.",
    )  # fmt: skip


def sensor_losses(dive: Dive) -> list[Loss]:
    """Sensors that end before the last reply or begin after the first, the longest loss first."""
    span = spans(dive)
    first_s, last_s = span.pop("replies")
    if _hardly_lost(dive, first_s, last_s):
        span["velocity"] = (float(dive.velocity.t_s[0]), float(dive.velocity.t_s[-1]))
    length_s = max(last_s - first_s, 1.0)
    period_s = {
        "compass": _period(dive.heading.t_s),
        "velocity": _period(dive.velocity.t_s),
        "depth": _period(dive.depth.t_s),
    }
    losses = []
    for sensor, (begin_s, end_s) in span.items():
        for lost_s, at_end, t_s in (
            (last_s - end_s, True, end_s),
            (begin_s - first_s, False, begin_s),
        ):
            if lost_s > max(_LOST_S, _LOST_PERIODS * period_s[sensor]):
                within_s = min(lost_s, length_s)
                losses.append(Loss(sensor, within_s, within_s / length_s, at_end, t_s))
    return sorted(losses, key=lambda loss: -loss.length_s)


def _hardly_lost(dive: Dive, first_s: float, last_s: float) -> bool:
    """Whether what lacks of good velocities at either end may be one loss of bottom lock."""
    good_s = dive.velocity.t_s[dive.velocity.valid]
    lost_s = max(last_s - float(good_s[-1]), float(good_s[0]) - first_s)
    return lost_s < _ONE_LOSS * (last_s - first_s)


def _period(t_s: Float) -> float:
    return float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0


def apart_cause(apart: Apart, offset_s: float) -> Cause:
    """Replies and velocities that were not recorded at the same time.

    Parameters
    ----------
    offset_s : to be added to the replies' stamps
    """
    direction = "later" if offset_s < 0 else "earlier"
    return Cause(
        "travel_time", "no_overlap", f"{-offset_s:+.0f} s", CERTAIN, _replies_moved(offset_s),
        f"DVL velocities cover {100 * apart.overlap:.0f} % of the time in which replies came; the "
        f"replies' stamps are {length(abs(offset_s))} {direction}.",
    )  # fmt: skip


def zone_cause(offset_s: float) -> Cause:
    """Replies stamped in another time zone that still share part of the dive's time."""
    direction = "late" if offset_s < 0 else "early"
    return Cause(
        "travel_time", "clock_offset", f"{-offset_s:+.0f} s", CERTAIN, _replies_moved(offset_s),
        f"Fixes and dead reckoning fit each other once the replies' stamps, "
        f"{length(abs(offset_s))} {direction}, are put right.",
    )  # fmt: skip


def _replies_moved(offset_s: float) -> Mend:
    return Mend(f"latency_s.travel_time = {-offset_s:.1f}", REPLIES_CLOCK)
