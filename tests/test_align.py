# SPDX-License-Identifier: Apache-2.0
import dataclasses
import re

import gsw
import msgspec
import numpy as np
import pytest
from oracles import rotation_enu_body
from small_logs import (
    PLACES,
    START_NS,
    TOPICS,
    beacon_rows,
    check,
    rows_of,
    same,
    small_log,
    stamps,
    without,
)

from abyssnav.align import align, reference
from abyssnav.config import (
    Acoustics,
    BeaconSetting,
    Config,
    OriginSetting,
    SoundSpeedSetting,
    Vehicle,
)
from abyssnav.errors import ClockError, ConfigError, SolveError
from abyssnav.geometry import enu_to_geodetic
from abyssnav.tables import Finding

# --- one clock ---------------------------------------------------------------------------------


def sound(**keys):
    return msgspec.structs.replace(Config(), acoustics=Acoustics(**keys))


def test_time_is_seconds_since_the_first_stamp_of_any_required_role():
    dive = align(small_log(), Config())
    assert dive.start_ns == START_NS
    assert dive.heading.t_s[0] == 0.0
    assert dive.velocity.t_s[0] == 0.07
    np.testing.assert_allclose(dive.replies.t_ping_s[::3], 5.0 + 24.0 * np.arange(4), atol=1e-9)
    assert [c.name for c in dive.checks if not c.ok] == ["sound_speed_assumed"]


@pytest.mark.parametrize("role", ["heading", "velocity", "depth", "travel_time"])
def test_disorder_changes_nothing_and_is_told(role):
    log = small_log()
    rng = np.random.default_rng(0)
    shuffled = rows_of(log, role, rng.permutation(len(log.roles[role]["time_ns"])))
    dive, straight = align(shuffled, Config()), align(log, Config())
    for table in ("heading", "velocity", "depth", "replies"):
        assert same(getattr(dive, table), getattr(straight, table)), table
    late = check(dive, f"{role}_out_of_order")
    assert not late.ok
    assert late.value > 0
    assert TOPICS[role] in late.detail


@pytest.mark.parametrize("role", ["heading", "velocity", "depth"])
def test_of_messages_with_one_stamp_the_first_is_kept(role):
    log = small_log()
    n = len(log.roles[role]["time_ns"])
    doubled = rows_of(log, role, np.sort(np.concatenate([np.arange(n), [7, 8, 8]])))
    dive = align(doubled, Config())
    assert check(dive, f"{role}_repeated_stamps").value == 3
    assert np.all(np.diff(getattr(dive, role).t_s) > 0)


def test_replies_of_one_instant_are_all_kept():
    log = rows_of(small_log(), "travel_time", np.array([0, 0, 1, 2]))
    assert len(align(log, Config()).replies) == 4


@pytest.mark.parametrize("role", ["heading", "velocity", "depth", "travel_time"])
def test_stamps_of_1970_are_left_out_and_told(role):
    log = small_log()
    time_ns = log.roles[role]["time_ns"].copy()
    time_ns[[0, 5]] = [0, 17]
    dive = align(small_log(**{role: {"time_ns": time_ns}}), Config())
    found = check(dive, f"{role}_foreign_stamps")
    assert (found.value, found.ok) == (2, False)
    assert dive.start_ns - START_NS < 1e9


def test_a_role_with_foreign_stamps_only_is_refused_by_name():
    log = small_log()
    depth = {"time_ns": log.roles["depth"]["time_ns"] - START_NS}
    with pytest.raises(ClockError, match=r"small: every stamp on /depth lies more than a day"):
        align(small_log(depth=depth), Config())


@pytest.mark.parametrize("role", ["heading", "velocity", "depth"])
@pytest.mark.parametrize("hours", [-9600.0, -48.0, -1.0, 0.05, 1.0, 72.0])
def test_one_stamp_minutes_to_days_off_does_not_stretch_the_dive(role, hours):
    time_ns = small_log().roles[role]["time_ns"].copy()
    time_ns[50] += int(hours * 3600) * 10**9
    dive = align(small_log(**{role: {"time_ns": time_ns}}), Config())
    assert check(dive, f"{role}_foreign_stamps").value == 1
    assert dive.start_ns == START_NS
    assert getattr(dive, role).t_s[-1] < 101


def test_what_is_assumed_of_a_transducer_that_nobody_placed_is_said():
    assumed = check(align(small_log(), Config()), "lever_arm_assumed")
    assert (assumed.value, assumed.ok) == (1.0, True)
    assert "[vehicle]" in assumed.detail
    stated = Config(vehicle=Vehicle(transducer_offset_m=(0.0, 0.0, 0.0)))
    names = [one.name for one in align(small_log(), stated).checks]
    assert "lever_arm_assumed" not in names


def test_stamps_that_come_late_together_are_all_kept():
    """A stretch delivered minutes later, as by a modem: recorded anywhere, its stamps are good."""
    rows = np.concatenate([np.arange(100), np.arange(700, 800), np.arange(100, 700)])
    log = rows_of(small_log(800.0), "depth", rows)
    assert check(align(log, Config()), "depth_foreign_stamps").ok


def test_a_reply_whose_ping_has_no_time_is_left_out_and_does_not_stretch_the_dive_to_1970():
    ping_time_ns = small_log().roles["travel_time"]["ping_time_ns"].copy()
    ping_time_ns[4] = 0
    dive = align(small_log(travel_time={"ping_time_ns": ping_time_ns}), Config())
    assert len(dive.replies) == 11
    assert check(dive, "travel_time_foreign_stamps").value == 1
    assert dive.replies.t_ping_s.min() >= 0
    none = {"ping_time_ns": np.zeros(12, dtype=np.int64)}
    with pytest.raises(ClockError, match="every stamp on /lbl/travel_time"):
        align(small_log(travel_time=none), Config())


@pytest.mark.parametrize("role", ["heading", "velocity", "depth"])
def test_a_gap_is_told_with_its_length_and_place(role):
    log = small_log()
    t_s = (log.roles[role]["time_ns"] - START_NS) / 1e9
    dive = align(rows_of(log, role, (t_s < 40) | (t_s > 70)), Config())
    gap = check(dive, f"{role}_largest_gap")
    assert not gap.ok
    assert gap.value == pytest.approx(30.0, abs=1.2)
    assert re.search(r"39\.\d s after its first message", gap.detail)


def test_what_the_reader_found_goes_on_as_checks():
    log = dataclasses.replace(small_log(), findings=(Finding("cut_short", "a.mcap", "at byte 9"),))
    found = check(align(log, Config()), "cut_short")
    assert (found.stage, found.ok, found.detail) == ("read", False, "a.mcap: at byte 9")


# --- sensors -----------------------------------------------------------------------------------


def test_heading_is_unwrapped_across_north_and_brought_to_the_velocitys_times():
    dive = align(small_log(), Config())
    assert np.abs(np.diff(dive.heading.heading_rad)).max() < 0.01
    expected = 6.2 + 0.01 * dive.velocity.t_s
    np.testing.assert_allclose(dive.velocity.heading_rad[:-1], expected[:-1], atol=1e-9)
    roll = 0.1 * np.sin(dive.velocity.t_s)
    np.testing.assert_allclose(dive.velocity.roll_rad[:-1], roll[:-1], atol=1e-3)


def test_depth_is_that_of_the_ping_and_of_the_reply():
    replies = align(small_log(), Config()).replies
    np.testing.assert_allclose(replies.depth_ping_m, 4900.0 + 0.5 * replies.t_ping_s, atol=1e-9)
    np.testing.assert_allclose(replies.depth_reply_m, 4900.0 + 0.5 * replies.t_reply_s, atol=1e-9)
    assert np.all(replies.depth_reply_m > replies.depth_ping_m)


def test_the_lever_arm_is_turned_by_the_attitude_of_its_own_instant():
    offset_m = (2.0, -3.0, 1.5)
    config = msgspec.structs.replace(Config(), vehicle=Vehicle(transducer_offset_m=offset_m))
    dive = align(small_log(), config)
    knots = dive.heading
    for t_s, lever_m in (
        (dive.replies.t_ping_s, dive.replies.lever_ping_enu_m),
        (dive.replies.t_reply_s, dive.replies.lever_reply_enu_m),
    ):
        for t, lever in zip(t_s, lever_m, strict=True):
            angles = [
                np.interp(t, knots.t_s, column)
                for column in (knots.roll_rad, knots.pitch_rad, knots.heading_rad)
            ]
            np.testing.assert_allclose(lever, rotation_enu_body(*angles) @ offset_m, atol=1e-12)
    assert not np.allclose(dive.replies.lever_ping_enu_m, dive.replies.lever_reply_enu_m)


def test_values_that_are_not_finite_are_left_out_or_not_valid():
    base = small_log().roles
    heading = base["heading"]["heading_rad"].copy()
    heading[3:6] = np.nan
    depth = base["depth"]["depth_m"].copy()
    depth[2] = np.inf
    velocity = base["velocity"]["velocity_body_mps"].copy()
    velocity[10:20, 1] = np.nan
    dive = align(small_log(heading={"heading_rad": heading}, depth={"depth_m": depth},
                           velocity={"velocity_body_mps": velocity}), Config())  # fmt: skip
    assert check(dive, "heading_not_finite").value == 3
    assert check(dive, "depth_not_finite").value == 1
    assert np.sum(~dive.velocity.valid) == 10
    for table in (dive.heading, dive.depth, dive.velocity):
        assert all(np.all(np.isfinite(c)) for c in table.columns().values())
    assert check(dive, "velocity_longest_loss").value == pytest.approx(2.2)


@pytest.mark.parametrize("value", [1e9, -50.0, np.inf, np.nan])
def test_a_velocity_that_no_vehicle_has_is_not_valid(value):
    velocity = small_log().roles["velocity"]["velocity_body_mps"].copy()
    velocity[[7, 300], 0] = value
    dive = align(small_log(velocity={"velocity_body_mps": velocity}), Config())
    assert np.flatnonzero(~dive.velocity.valid).tolist() == [7, 300]
    assert np.abs(dive.velocity.velocity_body_mps).max() < 2


def test_a_bare_compass_is_taken_as_level():
    nothing = np.full(1000, np.nan)
    dive = align(small_log(heading={"roll_rad": nothing, "pitch_rad": nothing}), Config())
    assert np.all(dive.velocity.roll_rad == 0)
    assert np.all(dive.velocity.pitch_rad == 0)


@pytest.mark.parametrize(
    ("role", "column", "message"),
    [
        ("heading", "heading_rad", "no finite heading_rad on /imu"),
        ("depth", "depth_m", "no finite depth_m on /depth"),
        ("velocity", "velocity_body_mps", "no valid velocity on /dvl"),
    ],
)
def test_a_sensor_without_a_number_is_refused(role, column, message):
    values = np.full_like(small_log().roles[role][column], np.nan)
    with pytest.raises(SolveError, match=message):
        align(small_log(**{role: {column: values}}), Config())


def test_velocity_that_is_never_valid_is_refused():
    with pytest.raises(SolveError, match="no valid velocity on /dvl"):
        align(small_log(velocity={"valid": np.full(500, False)}), Config())


@pytest.mark.parametrize("role", ["heading", "velocity", "depth", "travel_time"])
def test_a_role_without_messages_is_refused_by_its_topic(role):
    for log in (rows_of(small_log(), role, slice(0, 0)), without(small_log(), role)):
        with pytest.raises(SolveError, match=rf"small: no messages on {TOPICS[role]} \({role}\)"):
            align(log, Config())


# --- replies -----------------------------------------------------------------------------------


def test_each_reply_knows_its_beacons_row_and_strangers_are_minus_one():
    ids = np.tile([3, 1, 77], 4)
    dive = align(small_log(travel_time={"beacon_id": ids}), Config())
    known = dive.replies.beacon >= 0
    np.testing.assert_array_equal(
        dive.beacons.id[dive.replies.beacon[known]], dive.replies.beacon_id[known]
    )
    assert set(dive.replies.beacon_id[~known]) == {77}
    assert check(dive, "replies_of_unknown_beacons").value == 4


def test_replies_of_strangers_only_are_refused_with_what_was_heard():
    ids = np.tile([7, 8, 9], 4)
    with pytest.raises(SolveError, match="from a known beacon: heard 7, 8, 9; known 1, 2, 3"):
        align(small_log(travel_time={"beacon_id": ids}), Config())


def test_a_reply_before_its_ping_or_with_another_time_than_its_stamps_is_told():
    base = small_log().roles["travel_time"]
    ping_time_ns = base["ping_time_ns"].copy()
    ping_time_ns[0] = base["time_ns"][0] + 10**9
    time_s = base["travel_time_s"].copy()
    time_s[[5, 6]] = [np.nan, 9.0]
    dive = align(
        small_log(travel_time={"ping_time_ns": ping_time_ns, "travel_time_s": time_s}), Config()
    )
    assert check(dive, "replies_heard_before_their_ping").value == 1
    assert check(dive, "replies_whose_stamp_is_not_ping_plus_travel_time").value == 2


# --- beacons, origin, sound speed ---------------------------------------------------------------


def settings(*beacons, origin=None):
    return msgspec.structs.replace(Config(), beacon=beacons, origin=origin)


def test_beacons_of_the_settings_go_before_the_logs():
    ours = [
        BeaconSetting(id=i, turn_around_s=0.7, position_m=(100.0 * i, 0.0, -4000.0))
        for i in (1, 2, 3)
    ]
    dive = align(small_log(), settings(*ours))
    assert dive.beacons.position_enu_m[:, 0].tolist() == [100.0, 200.0, 300.0]
    assert dive.beacons.turn_around_s.tolist() == [0.7] * 3
    assert dive.beacons.name.tolist() == ["1", "2", "3"]


def test_beacons_by_latitude_and_longitude_are_those_by_position():
    latitude, longitude, _ = enu_to_geodetic(-23.5, 179.999, PLACES)
    ours = [
        BeaconSetting(id=i, turn_around_s=0.1, latitude_deg=float(a), longitude_deg=float(o),
                      depth_m=float(-place[2]))
        for i, a, o, place in zip((1, 2, 3), latitude, longitude, PLACES, strict=True)
    ]  # fmt: skip
    dive = align(small_log(), settings(*ours, origin=OriginSetting(-23.5, 179.999)))
    assert dive.origin is not None
    # the frame is a plane: at 2 km the sea lies 0.3 m below it, and depth is what is measured
    np.testing.assert_allclose(dive.beacons.position_enu_m, PLACES, atol=1e-3)


def test_the_origin_is_the_settings_then_the_logs_then_the_first_geodetic_beacon():
    geodetic = [
        BeaconSetting(id=i, turn_around_s=0.1, latitude_deg=10.0 + 0.01 * i, longitude_deg=20.0,
                      depth_m=4000.0)
        for i in (1, 2, 3)
    ]  # fmt: skip
    log = small_log(beacons=beacon_rows([1, 2, 3], PLACES, origin=(30.0, 40.0)))
    given = OriginSetting(50.0, 60.0)
    origins = [
        align(log, settings(origin=given)).origin,
        align(log, settings(*geodetic)).origin,
        align(without(log, "beacons"), settings(*geodetic)).origin,
        align(small_log(), Config()).origin,
    ]
    found = [None if o is None else (o.latitude_deg, o.longitude_deg) for o in origins]
    assert found == [(50.0, 60.0), (30.0, 40.0), (10.01, 20.0), None]


def test_the_last_beacon_message_before_the_first_reply_counts():
    moved = [beacon_rows([1, 2, 3], PLACES + k, message=k, t_s=t) for k, t in
             enumerate([-5.0, 1.0, 4.0, 50.0])]  # fmt: skip
    for order in ([0, 1, 2, 3], [3, 1, 2, 0]):
        rows = {n: np.concatenate([moved[k][n] for k in order]) for n in moved[0]}
        dive = align(small_log(beacons=rows), Config())
        assert dive.beacons.position_enu_m[0, 0] == 2.0
    late = beacon_rows([1, 2, 3], PLACES + 9, t_s=60.0)
    assert align(small_log(beacons=late), Config()).beacons.position_enu_m[0, 0] == 9.0


@pytest.mark.parametrize(
    ("ids", "places", "message"),
    [
        ([1], PLACES[:1], "1 beacon; a position needs 3"),
        ([1, 2, 1], PLACES, "beacon 1 is there 2 times"),
        ([1, 2, 3], PLACES * [[1], [np.nan], [1]], "beacon 2 has no finite position"),
    ],
)
def test_beacons_that_no_position_follows_from_are_refused(ids, places, message):
    with pytest.raises(SolveError, match=message):
        align(small_log(beacons=beacon_rows(ids, places)), Config())


def test_a_dive_without_beacons_is_refused():
    with pytest.raises(SolveError, match="no beacons, neither in the log nor in the settings"):
        align(without(small_log(), "beacons"), Config())


def test_a_beacon_of_the_settings_without_a_place_is_refused():
    half = BeaconSetting(id=4, turn_around_s=0.1, latitude_deg=10.0)
    with pytest.raises(ConfigError, match=r"\[\[beacon\]\] 4: give position_m, or latitude_deg"):
        align(small_log(), settings(half, half, half))


def profile_rows(depth_m, speed_mps):
    n = len(depth_m)
    return {"time_ns": np.full(n, START_NS), "message": np.zeros(n, dtype=np.int64),
            "depth_m": np.array(depth_m, float),
            "sound_speed_mps": np.array(speed_mps, float)}  # fmt: skip


def test_the_profile_is_the_settings_then_the_logs_then_the_constant():
    log = small_log(sound_speed=profile_rows([10, 0, 5000, 10], [1490, 1500, 1540, 1]))
    ours = SoundSpeedSetting((0.0, 6000.0), (1480.0, 1550.0))
    own = align(log, msgspec.structs.replace(Config(), sound_speed_profile=ours)).sound_speed
    assert own.sound_speed_mps.tolist() == [1480.0, 1550.0]
    logged = align(log, Config()).sound_speed
    assert logged.depth_m.tolist() == [0.0, 10.0, 5000.0]  # by depth, the first of two
    assert logged.sound_speed_mps.tolist() == [1500.0, 1490.0, 1540.0]
    constant = sound(sound_speed_gradient_per_s=0.0)
    assert align(small_log(), constant).sound_speed.sound_speed_mps.tolist() == [1500.0] * 2


def test_a_speed_without_a_profile_has_deep_waters_gradient_about_its_depth():
    """And is hardly known where nobody states it: 1500 that is given is given."""
    dive = align(small_log(), Config())
    water, profile = dive.water, dive.sound_speed
    middle_m = 0.5 * (np.median(dive.depth.depth_m) - np.mean(dive.beacons.position_enu_m[:, 2]))
    assert water.depth_m == pytest.approx(middle_m)
    assert np.interp(middle_m, profile.depth_m, profile.sound_speed_mps) == pytest.approx(1500.0)
    slope = np.diff(profile.sound_speed_mps) / np.diff(profile.depth_m)
    assert slope.tolist() == pytest.approx([0.0165])
    assert (water.sigma_mps, water.gradient_sigma_per_s) == (15.0, 0.004)
    assumed = check(dive, "sound_speed_assumed")
    assert not assumed.ok
    assert "1500.0 m/s" in assumed.detail
    given = align(small_log(), sound(sound_speed_mps=1500.0))
    assert given.water.sigma_mps == 1.0
    assert check(given, "sound_speed_assumed").ok
    deep = sound(sound_speed_mps=1500.0, sound_speed_depth_m=100.0)
    profile = align(small_log(), deep).sound_speed
    assert np.interp(100.0, profile.depth_m, profile.sound_speed_mps) == pytest.approx(1500.0)
    logged = align(small_log(sound_speed=profile_rows([0, 5000], [1500, 1540])), Config())
    assert (logged.water.depth_m, logged.water.gradient_sigma_per_s) == (None, 0.0)


def test_levels_without_a_value_are_left_out_and_a_profile_of_them_is_refused():
    rows = profile_rows([0, 100, np.nan, 4000, 5000, 1e9], [1500, np.nan, 1490, -1, 1e-300, 1500])
    dive = align(small_log(sound_speed=rows), Config())
    assert np.mean(dive.sound_speed.sound_speed_mps) > 1400.0
    assert check(dive, "sound_speed_levels_without_value").value == 5
    with pytest.raises(SolveError, match="no level of /sound_speed/profile holds"):
        align(small_log(sound_speed=profile_rows([0, 1], [np.nan, 0])), Config())


# --- reference ---------------------------------------------------------------------------------


def test_the_reference_is_sorted_and_whole_and_none_where_there_is_none():
    place = np.arange(12.0).reshape(4, 3)
    place[2, 1] = np.nan
    rows = {"time_ns": stamps([3.0, 1.0, 2.0, 1.0]), "position_enu_m": place}
    found = reference(small_log(reference=rows))
    assert found.time_ns.tolist() == stamps([1.0, 3.0]).tolist()
    assert found.position_enu_m[:, 0].tolist() == [3.0, 0.0]
    assert reference(small_log()) is None
    lost = {**rows, "position_enu_m": np.full((4, 3), np.nan)}
    assert reference(small_log(reference=lost)) is None


def test_where_the_sound_speed_came_from_and_how_deep_it_reaches_is_told():
    told = {check.name: check for check in align(small_log(), Config()).checks}
    assert told["sound_speed_mean"].detail
    assert told["beacons_below_sound_speed_profile"].ok
    shallow = SoundSpeedSetting(depth_m=(0.0, 10.0), sound_speed_mps=(1500.0, 1490.0))
    settings = msgspec.structs.replace(Config(), sound_speed_profile=shallow)
    told = {check.name: check for check in align(small_log(), settings).checks}
    assert told["sound_speed_mean"].value == pytest.approx(1495.0)
    assert "settings" in told["sound_speed_mean"].detail
    assert not told["beacons_below_sound_speed_profile"].ok


def check_of(dive, name):
    return next(check for check in dive.checks if check.name == name)


@pytest.mark.parametrize(("factor", "odd"), [(1.0, False), (-1.0, True), (1e4, True)])
def test_depths_that_no_sea_has_are_told(factor, odd):
    depth_m = small_log().roles["depth"]["depth_m"] * factor
    check = check_of(align(small_log(depth={"depth_m": depth_m}), Config()), "depth_of_no_sea")
    assert check.ok != odd
    assert ("are unit and sign right?" in check.detail) == odd


def test_beacons_above_the_surface_are_told():
    beacons = beacon_rows([1, 2, 3], PLACES * [1, 1, -1])
    check = check_of(align(small_log(beacons=beacons), Config()), "beacons_in_no_sea")
    assert (check.ok, check.value) == (False, 3)
    assert check.detail == "beacon 1 lies at +4,950 m, up: are unit and sign right?"
    assert check_of(align(small_log(), Config()), "beacons_in_no_sea").ok


def test_beacons_in_one_place_and_an_origin_off_the_earth_are_refused():
    with pytest.raises(SolveError, match="all 3 beacons lie in 1 places"):
        align(small_log(beacons=beacon_rows([1, 2, 3], PLACES[[0, 0, 0]])), Config())
    with pytest.raises(SolveError, match=r"origin 95(\.0)?, 10(\.0)? is no latitude and longitude"):
        align(small_log(beacons=beacon_rows([1, 2, 3], PLACES, origin=(95, 10))), Config())


@pytest.mark.parametrize(
    ("origin", "latitude_deg", "ok"), [((10, 20), 10, True), (None, 45, False)]
)
def test_pressure_becomes_depth_at_the_origin(origin, latitude_deg, ok):
    log = small_log()
    depth = {**log.roles["depth"], "pressure_dbar": np.full(100, 5000.0)}
    del depth["depth_m"]
    beacons = beacon_rows([1, 2, 3], PLACES, origin=origin or (np.nan, np.nan))
    log = dataclasses.replace(log, roles=log.roles | {"depth": depth, "beacons": beacons})
    dive = align(log, Config())
    assert dive.depth.depth_m == pytest.approx(-gsw.z_from_p(5000.0, latitude_deg), abs=1e-9)
    assert (check_of(dive, "depth_latitude").ok, check_of(dive, "depth_latitude").value) == (
        ok, latitude_deg,
    )  # fmt: skip


def test_velocities_all_beyond_any_vehicle_are_refused_with_how_many():
    fast = np.tile([1200.0, 100.0, 0.0], (500, 1))
    with pytest.raises(SolveError, match="500 are faster than 30 m/s: is the unit right"):
        align(small_log(velocity={"velocity_body_mps": fast}), Config())
