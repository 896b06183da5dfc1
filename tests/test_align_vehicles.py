# SPDX-License-Identifier: Apache-2.0
"""What any vehicle's log asks of align: beacons that move, times to be completed, other frames."""

import dataclasses
from datetime import UTC, datetime, timedelta

import msgspec
import numpy as np
import pytest
from oracles import rotation_enu_body
from small_logs import PLACES, START_NS, beacon_rows, check, small_log, stamps, without

from abyssnav.align import align, reference
from abyssnav.align.sensors import angular_rate
from abyssnav.config import BeaconSetting, Config, OriginSetting
from abyssnav.errors import ConfigError, SolveError
from abyssnav.geometry import body_to_enu, enu_to_body, enu_to_geodetic
from abyssnav.tables import Heading

# --- beacons that move --------------------------------------------------------------------------


def drifting_rows(t_s, rate_mps, sigma_m=0.0, noise_m=0.0):
    """Beacon 1 drifts east, the others stay; a message at each time."""
    rng = np.random.default_rng(5)
    parts = []
    for k, t in enumerate(t_s):
        places = PLACES.copy()
        places[0, 0] += rate_mps * t
        places[:1] += rng.normal(0, noise_m, (1, 3)) * [1, 1, 0]
        parts.append(beacon_rows([1, 2, 3], places, message=k, t_s=t))
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return rows | {"sigma_m": np.where(rows["id"] == 1, sigma_m, 0.0)}


def test_a_drifting_beacon_is_where_it_answered():
    dive = align(small_log(beacons=drifting_rows(np.arange(0.0, 101.0, 5.0), 0.3)), Config())
    mine = dive.replies.beacon_id == 1
    answered_s = 0.5 * (dive.replies.t_ping_s + dive.replies.t_reply_s)[mine]
    np.testing.assert_allclose(dive.replies.beacon_enu_m[mine, 0], 0.3 * answered_s, atol=1e-9)
    assert dive.beacons.moving.tolist() == [True, False, False]
    first_s = float(dive.replies.t_reply_s.min())
    assert dive.beacons.position_enu_m[0, 0] == pytest.approx(0.3 * first_s, abs=1e-9)
    assert "B1 over 30 m, 21 places" in check(dive, "beacons_moving").detail
    others = dive.replies.beacon_enu_m[dive.replies.beacon_id == 2]
    np.testing.assert_array_equal(others, np.tile(PLACES[1], (len(others), 1)))


@pytest.mark.parametrize(("stated_m", "expected_m"), [(1.0, 1.0), (0.0, 0.7)])
def test_an_interpolated_place_has_the_sigma_of_both_that_it_is_between(stated_m, expected_m):
    """Half way between two places of one sigma it is sigma / sqrt 2; unstated, it is measured."""
    rows = drifting_rows(np.arange(0.0, 101.0, 1.0), 1.0, stated_m, 0.7)
    dive = align(small_log(beacons=rows), Config())
    mine = dive.replies.beacon_id == 1
    share = (0.5 * (dive.replies.t_ping_s + dive.replies.t_reply_s)[mine]) % 1.0
    weight = np.sqrt(share**2 + (1 - share) ** 2)
    np.testing.assert_allclose(
        dive.replies.beacon_sigma_m[mine], expected_m * weight, rtol=1e-9 if stated_m else 0.25
    )
    assert np.all(dive.replies.beacon_sigma_m[~mine] == 0)


def test_noise_within_its_sigma_is_no_motion():
    rows = drifting_rows(np.arange(0.0, 101.0, 1.0), 0.0, 2.0, 1.0)
    dive = align(small_log(beacons=rows), Config())
    assert not dive.beacons.moving.any()
    assert not any(c.name == "beacons_moving" for c in dive.checks)


def test_two_places_are_a_correction_and_the_later_one_counts_for_all():
    moved = PLACES.copy()
    moved[2] += [0.0, 40.0, 0.0]
    parts = [beacon_rows([1, 2, 3], PLACES), beacon_rows([1, 2, 3], moved, message=1, t_s=60.0)]
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    dive = align(small_log(beacons=rows), Config())
    np.testing.assert_array_equal(dive.beacons.position_enu_m, moved)
    told = check(dive, "beacons_corrected")
    assert not told.ok
    assert told.detail == "beacon 3 by 40.0 m: the later place is taken for the whole dive"
    assert not dive.beacons.moving.any()


def test_replies_far_from_any_logged_place_of_a_moving_beacon_are_told():
    rows = drifting_rows(np.arange(0.0, 12.0, 1.0), 1.0)
    late = align(small_log(beacons=rows), Config())
    unseen = check(late, "moving_beacons_unseen")
    last_s = float(late.replies.t_reply_s[late.replies.beacon_id == 1].max())
    assert unseen.value == pytest.approx(last_s - 11.0, abs=3.0)
    assert not unseen.ok


def test_beacons_with_every_reply_are_put_together():
    """A message each: nobody's array holds them all."""
    order, times = [3, 1, 2, 3, 1, 2], [8.0, 8.1, 8.2, 32.0, 32.1, 32.2]
    parts = [
        beacon_rows([i], PLACES[[i - 1]], message=k, t_s=t)
        for k, (i, t) in enumerate(zip(order, times, strict=True))
    ]
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    dive = align(small_log(beacons=rows), Config())
    assert dive.beacons.id.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(dive.beacons.position_enu_m, PLACES)


def test_logged_latitude_longitude_and_depth_are_places_and_the_first_the_origin():
    latitude, longitude, _ = enu_to_geodetic(-23.5, 179.999, PLACES)
    rows = beacon_rows([1, 2, 3], PLACES)
    del rows["position_enu_m"]
    rows |= {"latitude_deg": latitude, "longitude_deg": longitude, "depth_m": -PLACES[:, 2]}
    log = small_log()
    log = dataclasses.replace(log, roles={**log.roles, "beacons": rows})
    with_origin = msgspec.structs.replace(Config(), origin=OriginSetting(-23.5, 179.999))
    dive = align(log, with_origin)
    np.testing.assert_allclose(dive.beacons.position_enu_m, PLACES, atol=1e-3)
    alone = align(log, Config())
    np.testing.assert_allclose(alone.beacons.position_enu_m[0, :2], 0.0, atol=1e-6)
    assert alone.origin.source == "beacon"
    assert check(alone, "origin").detail.endswith("of the beacon")


def test_a_beacon_of_the_settings_stands_where_its_from_and_until_say():
    start = datetime.fromtimestamp(START_NS / 1e9, UTC)
    ours = [
        BeaconSetting(id=i, turn_around_s=0.1, position_m=tuple(PLACES[i - 1].tolist()))
        for i in (2, 3)
    ]
    ours += [
        BeaconSetting(id=1, turn_around_s=0.1, position_m=(0.0, 0.0, -10.0)),
        BeaconSetting(
            id=1, turn_around_s=0.4, position_m=(5.0, 0.0, -10.0),
            from_=start + timedelta(seconds=50),
        ),
    ]  # fmt: skip
    dive = align(small_log(), msgspec.structs.replace(Config(), beacon=tuple(ours)))
    mine = dive.replies.beacon_id == 1
    late = dive.replies.t_ping_s[mine] > 50
    np.testing.assert_array_equal(dive.replies.beacon_enu_m[mine, 0], np.where(late, 5.0, 0.0))
    np.testing.assert_array_equal(dive.replies.turn_around_s[mine], np.where(late, 0.4, 0.1))
    assert len(dive.beacons) == 3
    gone = msgspec.structs.replace(ours[2], until=start + timedelta(seconds=20))
    dive = align(small_log(), msgspec.structs.replace(Config(), beacon=(*ours[:2], gone)))
    mine = dive.replies.beacon_id == 1
    np.testing.assert_array_equal(dive.replies.beacon[mine] >= 0, dive.replies.t_ping_s[mine] < 20)
    assert not dive.beacons.moving.any()
    with pytest.raises(ConfigError, match=r"\[\[beacon\]\] 2 is there 2 times; with from"):
        align(small_log(), msgspec.structs.replace(Config(), beacon=(*ours[:1], *ours[:2])))


@pytest.mark.parametrize("sigma_m", [np.inf, -1.0, 1e9])
def test_a_sigma_of_no_place_is_left_out_and_told(sigma_m):
    rows = beacon_rows([1, 2, 3], PLACES) | {"sigma_m": np.array([0.5, sigma_m, 0.5])}
    dive = align(small_log(beacons=rows), Config())
    assert dive.beacons.sigma_m.tolist() == [0.5, 0.0, 0.5]
    told = check(dive, "beacon_sigma_of_no_place")
    assert (told.ok, told.value) == (False, 1)
    assert "beacon 2: sigma of" in told.detail


def test_two_beacons_are_navigated_with_a_check():
    dive = align(small_log(beacons=beacon_rows([1, 3], PLACES[:2])), Config())
    told = check(dive, "beacons")
    assert (told.ok, told.value) == (False, 2)
    assert check(align(small_log(), Config()), "beacons").ok


# --- times to be completed ----------------------------------------------------------------------


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


# --- velocity -----------------------------------------------------------------------------------


def test_the_body_frame_comes_back_from_the_earths():
    rng = np.random.default_rng(2)
    body, angles = rng.normal(size=(200, 3)), rng.uniform(-3, 3, (3, 200))
    angles[1] *= 0.5
    enu = body_to_enu(body, *angles)
    by_hand = np.array([rotation_enu_body(*a) @ b for a, b in zip(angles.T, body, strict=True)])
    np.testing.assert_allclose(enu, by_hand, atol=1e-12)
    np.testing.assert_allclose(enu_to_body(enu, *angles), body, atol=1e-12)


def test_velocity_of_the_earths_frame_becomes_the_vehicles():
    log = small_log()
    right = align(log, Config()).velocity
    enu = body_to_enu(right.velocity_body_mps, right.roll_rad, right.pitch_rad, right.heading_rad)
    velocity = {**log.roles["velocity"], "velocity_enu_mps": enu}
    del velocity["velocity_body_mps"]
    bent = dataclasses.replace(log, roles={**log.roles, "velocity": velocity})
    found = align(bent, Config()).velocity
    np.testing.assert_allclose(found.velocity_body_mps, right.velocity_body_mps, atol=1e-12)


def test_the_rate_of_turn_is_that_of_the_rotation():
    """ω from R(t)ᵀ dR/dt, by differences of matrices."""
    t_s = np.arange(0.0, 20.0, 0.05)
    heading = Heading(t_s, 0.1 * np.sin(0.2 * t_s), 0.05 * np.cos(0.3 * t_s), 1.0 + 0.1 * t_s)
    at_s, step_s = np.array([3.0, 8.5, 14.2]), 1e-4
    for t, rate in zip(at_s, angular_rate(at_s, heading), strict=True):
        turned = [
            rotation_enu_body(0.1 * np.sin(0.2 * s), 0.05 * np.cos(0.3 * s), 1.0 + 0.1 * s)
            for s in (t - step_s, t + step_s)
        ]
        skew = turned[0].T @ (turned[1] - turned[0]) / (2 * step_s)
        np.testing.assert_allclose(rate, [skew[2, 1], skew[0, 2], skew[1, 0]], atol=2e-3)


def test_the_lever_arm_of_a_turning_dvl_is_taken_off():
    """Turning to starboard at r, an instrument x ahead of the point moves to starboard by r x."""
    log = small_log()
    steady = {"roll_rad": np.zeros(1000), "pitch_rad": np.zeros(1000)}
    offset_m = np.broadcast_to(np.array([2.0, 0.5, 0.0]), (500, 3))
    turning = small_log(heading=steady, velocity={"offset_m": offset_m})
    found = align(turning, Config()).velocity.velocity_body_mps
    measured = log.roles["velocity"]["velocity_body_mps"]
    rate = 0.01  # of small_log's heading
    inside = slice(10, -10)
    np.testing.assert_allclose(found[inside, 1], measured[inside, 1] - rate * 2.0, atol=1e-9)
    np.testing.assert_allclose(found[inside, 0], measured[inside, 0] + rate * 0.5, atol=1e-9)


# --- positions ----------------------------------------------------------------------------------


def position_columns(place_m, t_s, sigma_m=2.0):
    n = len(t_s)
    return {
        "time_ns": stamps(t_s), "position_enu_m": np.array(place_m, float),
        "cov_m2": np.tile(sigma_m**2 * np.eye(2), (n, 1, 1)),
    }  # fmt: skip


def with_positions(columns, log=None):
    log = log or small_log()
    return dataclasses.replace(
        log, roles={**log.roles, "position": columns}, topics={**log.topics, "position": "/usbl"}
    )


def test_position_fixes_have_their_lever_arm_with_the_attitude_of_their_instant():
    columns = position_columns([[1.0, 2.0], [3.0, 4.0]], [10.0, 50.0])
    columns["offset_m"] = np.broadcast_to(np.array([1.0, 2.0, -3.0]), (2, 3))
    dive = align(with_positions(columns), Config())
    fixes = dive.positions
    np.testing.assert_array_equal(fixes.position_enu_m, [[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_allclose(fixes.t_s, [10.0, 50.0])
    heading = dive.heading
    for k, t in enumerate(fixes.t_s):
        angles = [np.interp(t, heading.t_s, c) for c in
                  (heading.roll_rad, heading.pitch_rad, heading.heading_rad)]  # fmt: skip
        np.testing.assert_allclose(
            fixes.lever_enu_m[k], rotation_enu_body(*angles) @ [1.0, 2.0, -3.0], atol=1e-9
        )


def test_geodetic_fixes_need_an_origin_and_are_the_places_from_it():
    place = np.array([[100.0, -50.0, 0.0], [200.0, 30.0, 0.0]])
    latitude, longitude, _ = enu_to_geodetic(35.0, 140.0, place)
    columns = position_columns(place[:, :2], [10.0, 50.0])
    del columns["position_enu_m"]
    columns |= {"latitude_deg": latitude, "longitude_deg": longitude}
    nowhere = align(with_positions(columns), Config())
    assert nowhere.positions is None
    assert not check(nowhere, "positions").ok
    placed = msgspec.structs.replace(Config(), origin=OriginSetting(35.0, 140.0))
    found = align(with_positions(columns), placed).positions
    np.testing.assert_allclose(found.position_enu_m, place[:, :2], atol=1e-6)


def test_a_dive_with_fixes_needs_no_acoustics_and_its_origin_is_the_first_fix():
    place = np.array([[0.0, 0.0, 0.0], [20.0, 30.0, 0.0]])
    latitude, longitude, _ = enu_to_geodetic(35.0, 140.0, place)
    columns = position_columns(place[:, :2], [10.0, 50.0])
    del columns["position_enu_m"]
    columns |= {"latitude_deg": latitude, "longitude_deg": longitude}
    silent = without(without(small_log(), "travel_time"), "beacons")
    dive = align(with_positions(columns, silent), Config())
    assert (len(dive.replies), len(dive.beacons)) == (0, 0)
    assert dive.origin.source == "position"
    np.testing.assert_allclose(dive.positions.position_enu_m, place[:, :2], atol=1e-6)
    with pytest.raises(SolveError, match=r"no messages on /lbl/travel_time \(travel_time\)"):
        align(silent, Config())


def test_a_fix_on_the_other_side_of_the_world_is_left_out_and_told():
    columns = position_columns([[1.0, 2.0], [3e6, 4.0]], [10.0, 50.0])
    dive = align(with_positions(columns), Config())
    assert len(dive.positions) == 1
    assert (check(dive, "positions_far_away").value, check(dive, "positions_far_away").ok) == (
        1,
        False,
    )


# --- water --------------------------------------------------------------------------------------


def samples_of_a_cast(rng, outliers=0):
    """Down to 1,000 m and up again, a sample a second; the water as linear as it never is."""
    t_s = np.arange(0.0, 100.0, 0.05)
    depth_m = 1000.0 - np.abs(t_s - 50.0) * 20.0
    speed_mps = 1500.0 + 0.02 * depth_m + rng.normal(0, 0.05, len(t_s))
    speed_mps[rng.permutation(len(t_s))[:outliers]] += 40.0
    return {"time_ns": stamps(t_s), "depth_m": depth_m, "sound_speed_mps": speed_mps}


def sound_log(columns):
    log = small_log()
    return dataclasses.replace(log, roles={**log.roles, "sound_speed": columns})


def test_the_vehicles_own_samples_become_a_profile_without_outliers():
    columns = samples_of_a_cast(np.random.default_rng(3), outliers=20)
    dive = align(sound_log(columns), Config())
    water = dive.sound_speed
    np.testing.assert_allclose(water.sound_speed_mps, 1500 + 0.02 * water.depth_m, atol=0.1)
    assert len(water) == pytest.approx(100, abs=2)
    assert check(dive, "sound_speed_samples_left_out").value == 20
    assert check(dive, "sound_speed_casts_differ").value < 0.1


def test_casts_that_differ_are_told():
    columns = samples_of_a_cast(np.random.default_rng(3))
    up = np.arange(len(columns["depth_m"])) > np.argmax(columns["depth_m"])
    columns["sound_speed_mps"] = columns["sound_speed_mps"] + 5.0 * up
    told = check(align(sound_log(columns), Config()), "sound_speed_casts_differ")
    assert told.value == pytest.approx(5.0, abs=0.1)
    assert not told.ok


def test_samples_without_a_depth_are_at_the_vehicles():
    columns = samples_of_a_cast(np.random.default_rng(3))
    columns["depth_m"] = np.full_like(columns["depth_m"], np.nan)
    dive = align(sound_log(columns), Config())
    assert dive.sound_speed.depth_m.min() > dive.depth.depth_m.min() - 10
    assert dive.sound_speed.depth_m.max() < dive.depth.depth_m.max() + 10


def test_logged_means_are_one_speed_for_all_the_water():
    columns = {"time_ns": stamps([8.0, 9.0, 10.0]),
               "sound_speed_mps": np.array([1510.0, 1511.0, 1512.0])}  # fmt: skip
    water = align(sound_log(columns), Config()).sound_speed
    assert water.sound_speed_mps.tolist() == [1511.0, 1511.0]


# --- losses and what does not count -------------------------------------------------------------


@pytest.mark.parametrize("role", ["heading", "velocity", "depth"])
@pytest.mark.parametrize("part", [slice(0, 20), slice(-20, None)])
def test_a_sensor_that_is_silent_up_to_the_ends_is_lost(role, part):
    log = small_log(duration_s=400.0)
    ping_s = np.repeat(5.0 + 90.0 * np.arange(4), 3)
    replies = dict(log.roles["travel_time"])
    replies["ping_time_ns"] = stamps(ping_s)
    replies["time_ns"] = stamps(ping_s + replies["travel_time_s"])
    kept = {name: column[part] for name, column in log.roles[role].items()}
    log = dataclasses.replace(log, roles={**log.roles, "travel_time": replies, role: kept})
    dive = align(log, Config())
    told = check(dive, f"{role}_lost")
    assert told.value > 200
    assert not told.ok
    assert "nothing for" in told.detail
    others = {"heading", "velocity", "depth"} - {role}
    assert all(check(dive, f"{other}_lost").ok for other in others)


def test_a_single_wild_depth_is_left_out_and_told_without_a_warning():
    depth_m = small_log().roles["depth"]["depth_m"].copy()
    depth_m[[40, 41]] = [1e77, 50_000.0]
    dive = align(small_log(depth={"depth_m": depth_m}), Config())
    assert check(dive, "depth_not_finite").value == 1
    assert "1 left out" in check(dive, "depth_of_no_sea").detail
    assert dive.depth.depth_m.max() < 5000


def test_a_position_of_the_reference_from_another_planet_is_left_out_and_told():
    place = np.array(
        [[0.0, 0.0, -100.0], [1e200, 0.0, -100.0], [np.nan, 0.0, 0.0], [1.0, 1.0, 1.0]]
    )
    log = small_log(reference={"time_ns": stamps([1.0, 2.0, 3.0, 4.0]), "position_enu_m": place})
    assert len(reference(log)) == 2
    told = check(align(log, Config()), "reference_positions_left_out")
    assert (told.value, told.ok) == (2, False)


def test_a_dive_lasts_from_its_first_to_its_last_message():
    log = small_log()
    velocity = {name: column[:50] for name, column in log.roles["velocity"].items()}
    short = dataclasses.replace(log, roles={**log.roles, "velocity": velocity})
    assert align(short, Config()).duration_s == pytest.approx(99.9, abs=1e-6)
