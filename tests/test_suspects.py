# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of the smoother in words: each says how much, and its line puts it right."""

import re
import tomllib
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from abyssnav.align import align
from abyssnav.config import Config
from abyssnav.diagnose.cause import Cause
from abyssnav.diagnose.motion_causes import Case
from abyssnav.diagnose.parameters import Suspicion
from abyssnav.diagnose.suspects import (
    left_out_cause,
    suspected_cause,
    with_errors_estimated,
    with_sound_estimated,
)
from abyssnav.navigate import navigate
from abyssnav.simulate import load_scenario, simulate, to_log
from abyssnav.tables import Solution

CONFIG = Config()
#: Of the beacon that is given elsewhere.
ROW, SHIFT_M = 1, np.array([8.0, -3.0, 0.0])


@pytest.fixture(scope="module")
def solution() -> Solution:
    scenario = msgspec.structs.replace(load_scenario("clean"), duration_s=1200.0)
    return navigate(align(to_log(simulate(scenario)), CONFIG), CONFIG)


@pytest.fixture(scope="module")
def given_elsewhere(solution: Solution) -> Solution:
    """The sound tracks, beside one beacon that is given 8 m east and 3 m south of where it is."""
    dive = solution.dive
    given_m = dive.beacons.position_enu_m.copy()
    given_m[ROW] += SHIFT_M
    its = (dive.replies.beacon == ROW)[:, None]
    replies = replace(dive.replies, beacon_enu_m=dive.replies.beacon_enu_m + its * SHIFT_M)
    beacons = replace(dive.beacons, position_enu_m=given_m)
    return replace(solution, dive=replace(dive, beacons=beacons, replies=replies))


def with_learned(solution: Solution, **values: float) -> Solution:
    learned = tuple(replace(p, value=values.get(p.name, p.value)) for p in solution.learned)
    return replace(solution, learned=learned)


def cause_of(
    solution: Solution, name: str, *beacon_ids: int, rivals: tuple[str, ...] = ()
) -> Cause:
    suspicion = Suspicion(name, beacon_ids, 0.97, 4.0, rivals)
    return suspected_cause(solution, suspicion, Case(solution.dive, CONFIG))


def test_a_lever_arm_is_told_as_learned_and_its_line_gives_it(solution: Solution) -> None:
    other = with_learned(solution, lever_arm_forward=5.0, lever_arm_starboard=-1.0)
    cause = cause_of(other, "lever_arm")
    assert cause.name == "lever_arm"
    assert tomllib.loads(cause.mend.line) == {"transducer_offset_m": [5.0, -1.0, 0.0]}
    assert "5.0 m ahead" in cause.seen
    assert "1.0 m to port" in cause.seen


def test_an_arm_longer_than_a_vehicle_is_replies_stamped_late(solution: Solution) -> None:
    speed_mps = np.median(solution.dive.velocity.velocity_body_mps[:, 0])
    other = with_learned(solution, lever_arm_forward=-8.0 * speed_mps, lever_arm_starboard=0.5)
    cause = cause_of(other, "lever_arm")
    assert cause.name == "clock_offset"
    settings = tomllib.loads(cause.mend.line)
    assert settings["latency_s"]["travel_time"] == pytest.approx(8.0, abs=0.2)
    aside = with_learned(solution, lever_arm_forward=-8.0, lever_arm_starboard=8.0)
    assert cause_of(aside, "lever_arm").name == "lever_arm"


def test_replies_take_the_arm_as_estimated_turned_with_the_vehicle(solution: Solution) -> None:
    dive, (forward_m, starboard_m) = solution.dive, (5.0, -2.0)
    armed = with_learned(solution, lever_arm_forward=forward_m, lever_arm_starboard=starboard_m)
    moved_m = with_errors_estimated(armed).replies.lever_ping_enu_m - dive.replies.lever_ping_enu_m
    heading = np.interp(
        dive.replies.t_ping_s, dive.heading.t_s, np.unwrap(dive.heading.heading_rad)
    )
    to_north = np.exp(1j * heading) * (moved_m[:, 1] + 1j * moved_m[:, 0]).conj()
    np.testing.assert_allclose(to_north.real, forward_m, rtol=0, atol=1e-9)
    np.testing.assert_allclose(to_north.imag, -starboard_m, rtol=0, atol=1e-9)
    far = with_learned(solution, lever_arm_forward=16.0)
    assert with_errors_estimated(far) is dive


def test_a_delay_of_all_goes_to_every_turn_around(solution: Solution) -> None:
    cause = cause_of(with_learned(solution, clock=5e-3), "turn_around")
    beacons = solution.dive.beacons
    lines = tomllib.loads(cause.mend.line)["beacon"]
    assert [line["id"] for line in lines] == beacons.id.tolist()
    np.testing.assert_allclose(
        [line["turn_around_s"] for line in lines], beacons.turn_around_s + 5e-3, rtol=0, atol=1e-4
    )


def test_a_beacon_is_put_where_its_replies_come_from(given_elsewhere: Solution) -> None:
    number = int(given_elsewhere.dive.beacons.id[ROW])
    suspected = cause_of(given_elsewhere, "beacon_moved", number, rivals=("turn_around",))
    for cause in (suspected, left_out_cause(given_elsewhere, ROW, "Its replies do not fit.")):
        position_m = tomllib.loads(cause.mend.line)["position_m"]
        true_m = given_elsewhere.dive.beacons.position_enu_m[ROW] - SHIFT_M
        said = re.search(r"give or take ([\d.]+) m", cause.seen)
        assert said is not None
        assert np.hypot(*(position_m - true_m)[:2]) < 3 * float(said[1]) < np.hypot(*SHIFT_M[:2])
    assert suspected.doubt.endswith("a turn-around time: the data cannot tell.")


def test_of_a_beacon_moved_during_the_dive_no_place_is_given(given_elsewhere: Solution) -> None:
    number = int(given_elsewhere.dive.beacons.id[ROW])
    suspicion = Suspicion("beacon_moved", (number,), 1.0, 40.0, (), since_s=1800.0)
    cause = suspected_cause(given_elsewhere, suspicion, Case(given_elsewhere.dive, CONFIG))
    assert f"From 30 min into the dive on, the replies of beacon {number}" in cause.seen
    assert not cause.mend.line


def test_several_beacons_get_a_sigma_as_large_as_they_are_off(solution: Solution) -> None:
    assert solution.beacons is not None
    off_m = solution.dive.beacons.position_enu_m + np.array([3.0, 0.0, 0.0])
    estimated = replace(solution, beacons=replace(solution.beacons, position_enu_m=off_m))
    cause = cause_of(estimated, "beacon_moved")
    assert tomllib.loads(cause.mend.line) == {"beacon_sigma_m": 3}


def test_where_one_of_three_may_be_wrong_none_is_accused(solution: Solution) -> None:
    cause = cause_of(solution, "beacon_moved", 1, 2, 3)
    assert cause.mend.line == ""
    assert "one of beacons 1, 2 and 3" in cause.doubt


def test_replies_take_beacons_and_delay_as_estimated_but_not_beyond_a_survey(
    solution: Solution,
) -> None:
    estimate = solution.beacons
    assert estimate is not None
    dive, delayed = solution.dive, with_learned(solution, clock=4e-3)
    other = with_errors_estimated(delayed).replies
    row = dive.replies.beacon
    np.testing.assert_allclose(other.beacon_enu_m, estimate.position_enu_m[row], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        other.turn_around_s, estimate.turn_around_s[row] + 4e-3, rtol=0, atol=1e-12
    )
    far = replace(estimate, position_enu_m=estimate.position_enu_m + 20.0)
    assert with_errors_estimated(replace(delayed, beacons=far)) is dive
    assert with_errors_estimated(replace(delayed, beacons=None)) is dive


def test_travel_times_are_those_of_the_sound_speed_learned(solution: Solution) -> None:
    dive, learned = solution.dive, solution.estimates["smoother"]

    def by_scale(scale: float) -> Solution:
        other = replace(learned, sound_speed_scale=np.full(len(learned), scale))
        return replace(solution, estimates={**solution.estimates, "smoother": other})

    replies, wait_s = with_sound_estimated(by_scale(0.002)).replies, dive.replies.turn_around_s
    flight_s = dive.replies.travel_time_s - wait_s
    np.testing.assert_allclose(1.002 * (replies.travel_time_s - wait_s), flight_s, atol=1e-12)
    assert with_sound_estimated(by_scale(0.006)) is dive
    assert with_sound_estimated(replace(solution, estimates={})) is dive
