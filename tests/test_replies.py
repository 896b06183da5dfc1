# SPDX-License-Identifier: Apache-2.0
"""Travel times and stamps made whole."""

import numpy as np
from small_logs import check, small_log

from abyssnav.align import align
from abyssnav.config import Config


def turn_around_s(log):
    return 0.1 * log.roles["travel_time"]["beacon_id"]


def test_a_time_without_turn_around_gets_the_beacons_own():
    log = small_log()
    short_s = log.roles["travel_time"]["travel_time_s"] - turn_around_s(log)
    bent = small_log(
        travel_time={"travel_time_s": short_s, "without_turn_around": np.full(12, True)}
    )
    right, dive = align(log, Config()), align(bent, Config())
    np.testing.assert_allclose(dive.replies.travel_time_s, right.replies.travel_time_s, atol=1e-12)


def test_a_replys_own_turn_around_goes_before_its_beacons():
    own_s = np.where(np.arange(12) % 2, 0.7, np.nan)
    log = small_log(travel_time={"turn_around_s": own_s, "without_turn_around": np.full(12, True)})
    dive, beacons = align(log, Config()).replies, turn_around_s(log)
    expected_s = np.where(np.isfinite(own_s), own_s, beacons)
    np.testing.assert_allclose(dive.turn_around_s, expected_s)
    sent_s = log.roles["travel_time"]["travel_time_s"] + expected_s
    np.testing.assert_allclose(dive.travel_time_s, sent_s)


def test_ping_times_follow_from_replies_and_are_counted_together():
    log = small_log()
    replies = log.roles["travel_time"]
    jitter_ns = np.arange(12) % 3 * 1_000_000
    bent = {
        "ping_time_ns": replies["time_ns"], "time_ns": replies["time_ns"] + jitter_ns,
        "ping_id": np.arange(12), "derived": np.full(12, 1, np.int8), "counted": np.full(12, False),
    }  # fmt: skip
    dive = align(small_log(travel_time=bent), Config())
    np.testing.assert_allclose(
        dive.replies.t_ping_s, align(log, Config()).replies.t_ping_s, atol=3e-3
    )
    np.testing.assert_array_equal(dive.replies.ping_id, np.repeat(np.arange(4), 3))


def test_replies_of_one_message_were_received_at_ping_plus_time():
    log = small_log()
    replies = log.roles["travel_time"]
    order = np.arange(12).reshape(4, 3)[:, ::-1].ravel()  # slots in no order of time
    bent = {name: column[order] for name, column in replies.items()}
    bent |= {"time_ns": bent["ping_time_ns"], "derived": np.full(12, 2, np.int8),
             "counted": np.full(12, True)}  # fmt: skip
    dive, right = align(small_log(travel_time=bent), Config()), align(log, Config())
    for name, column in dive.replies.columns().items():
        np.testing.assert_allclose(column, getattr(right.replies, name), atol=1e-6)
    assert check(dive, "travel_time_out_of_order").ok
