# SPDX-License-Identifier: Apache-2.0
"""Replies that lie outside the time in which other sensors, or one of them, ran."""

from dataclasses import replace

import pytest

from abyssnav.diagnose.clocks import beyond_cause, replies_beyond, sensor_losses
from abyssnav.diagnose.reasons import sensor_lost
from abyssnav.run import Result
from abyssnav.tables import Dive


def shifted(dive: Dive, late_s: float) -> Dive:
    """Its replies stamped later, pings too."""
    replies = dive.replies
    moved = replace(
        replies, t_ping_s=replies.t_ping_s + late_s, t_reply_s=replies.t_reply_s + late_s
    )
    return replace(dive, replies=moved)


def test_replies_of_the_same_clock_lie_within_the_record(result: Result) -> None:
    assert replies_beyond(result.solution.dive) is None


@pytest.mark.parametrize("late_s", [60.0, 900.0, -60.0, -900.0])
def test_replies_stamped_outside_the_record_are_late_or_early(
    result: Result, late_s: float
) -> None:
    dive = result.solution.dive
    beyond = replies_beyond(shifted(dive, late_s))
    assert beyond is not None
    assert 0.3 * abs(late_s) < abs(beyond.late_s) <= abs(late_s)
    assert (beyond.late_s > 0) == (late_s > 0)
    assert beyond.both_ends
    cause = beyond_cause(beyond)
    assert cause.name == "clock_offset"
    assert cause.mend.line == f"latency_s.travel_time = {beyond.late_s:.1f}"


def test_one_sensor_that_ends_early_is_no_matter_of_the_clock(result: Result) -> None:
    dive = result.solution.dive
    early = dive.velocity[dive.velocity.t_s < 0.5 * dive.velocity.t_s[-1]]
    assert replies_beyond(replace(dive, velocity=early)) is None


@pytest.mark.parametrize("at_end", [False, True])
def test_a_sensor_that_lacks_ten_minutes_at_an_end_has_lost_them(
    result: Result, at_end: bool
) -> None:
    dive = result.solution.dive
    first_s, last_s = dive.replies.t_reply_s.min(), dive.replies.t_reply_s.max()
    t_s = dive.depth.t_s
    kept = t_s < last_s - 600.0 if at_end else t_s > first_s + 600.0
    lost_s = last_s - t_s[kept][-1] if at_end else t_s[kept][0] - first_s
    assert 600.0 < lost_s < 605.0
    (loss,) = sensor_losses(replace(dive, depth=dive.depth[kept]))
    assert (loss.sensor, loss.at_end) == ("depth", at_end)
    assert loss.length_s == pytest.approx(lost_s, abs=1e-6)
    assert loss.share == pytest.approx(lost_s / (last_s - first_s), rel=1e-9)
    assert ("stops" if at_end else "begins only") in sensor_lost(loss).seen
