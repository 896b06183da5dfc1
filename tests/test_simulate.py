# SPDX-License-Identifier: Apache-2.0
"""Simulated dives against closed forms, image sources, and their own settings."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from abyssnav.errors import ConfigError, SolveError
from abyssnav.geometry import body_to_enu, interpolate
from abyssnav.simulate import LABELS, Scenario, load_scenario, simulate, stated_settings
from abyssnav.simulate import scenario as settings
from abyssnav.simulate.dive import roles
from abyssnav.simulate.scenario import draw, with_key
from abyssnav.simulate.sensors import velocity_body
from abyssnav.simulate.sound import BOTTOM, DIRECT, SURFACE, Water, leg_time, two_way_time

STILL_WATER = Water("constant", 1500.0)
MUNK = Water("munk", 1500.0)
BEACON = np.array([[0.0, 0.0, -4950.0]])
FLOOR = np.array([[5000.0, 5000.0]])


def scenario(**parts):
    return replace(Scenario(duration_s=1800.0), **parts)


def one_leg(vehicle, path, water=STILL_WATER):
    return leg_time(np.array([vehicle]), BEACON, np.array([path]), FLOOR, water)[0]


def heard_by(position, turn_around_s=0.3, water=STILL_WATER):
    """Two-way time of a ping at 100 s from a vehicle that moves as `position` says."""

    def leg(vehicle_enu_m, _):
        return leg_time(vehicle_enu_m, BEACON, np.array([DIRECT]), FLOOR, water)

    return two_way_time(position, np.array([100.0]), np.array([turn_around_s]), leg)[0]


# --- travel times -----------------------------------------------------------------------------


def test_a_vehicle_at_rest_hears_twice_the_distance_and_the_turn_around():
    heard = heard_by(lambda t: np.full((len(t), 3), [1200.0, 1600.0, -4950.0]))
    assert heard == pytest.approx(2 * 2000 / 1500 + 0.3, abs=1e-12)


def test_a_closing_vehicle_hears_an_earlier_reply():
    speed = 1.5

    def closing(t):
        east = 2000.0 - speed * (t - 100.0)
        return np.column_stack([east, np.zeros_like(t), np.full_like(t, -4950.0)])

    # d/c + τ + (d - v T)/c = T
    assert heard_by(closing) == pytest.approx(
        (2 * 2000 / 1500 + 0.3) / (1 + speed / 1500), abs=1e-12
    )


def test_a_vehicle_faster_than_sound_is_named():
    def fleeing(t):
        return np.column_stack([2000.0 + 3000.0 * (t - 100.0), 0 * t, 0 * t - 4950.0])

    with pytest.raises(SolveError, match="outruns sound"):
        heard_by(fleeing)


@pytest.mark.parametrize(("path", "image_z"), [(BOTTOM, -5050.0), (SURFACE, 4950.0)])
def test_a_bounce_is_the_direct_path_to_the_mirror_image(path, image_z):
    vehicle = np.array([1500.0, -800.0, -4920.0])
    image = np.linalg.norm(vehicle - [0.0, 0.0, image_z])
    assert one_leg(vehicle, path) == pytest.approx(image / 1500, abs=1e-12)


def test_a_bottom_bounce_is_milliseconds_late_and_a_surface_bounce_seconds():
    vehicle = [2000.0, 0.0, -4920.0]
    direct = one_leg(vehicle, DIRECT)
    assert 1500 * (one_leg(vehicle, BOTTOM) - direct) == pytest.approx(2 * 80 * 50 / 2000, rel=0.01)
    assert 5.0 < one_leg(vehicle, SURFACE) - direct < 6.0


def test_over_a_sloping_floor_the_bounce_takes_the_shortest_way_by_the_floor():
    vehicle, floor = np.array([[2000.0, 0.0, -4920.0]]), np.array([[5030.0, 5000.0]])
    time = leg_time(vehicle, BEACON, np.array([BOTTOM]), floor, STILL_WATER)[0]
    east = np.linspace(0.0, 2000.0, 200_001)
    place = np.column_stack([east, 0 * east, -5000.0 - 30.0 * east / 2000.0])
    ways = np.linalg.norm(place - BEACON, axis=1) + np.linalg.norm(place - vehicle, axis=1)
    # Heights are taken upright and not square to the slope of 0.015: some 2e-4 of 7 m.
    assert time * 1500 == pytest.approx(ways.min(), abs=2e-3)


@pytest.mark.parametrize(("shallow_m", "deep_m"), [(4900.0, 4951.0), (0.0, 5000.0), (700.0, 700.0)])
def test_the_mean_slowness_is_that_of_a_thousand_thin_layers(shallow_m, deep_m):
    edges = np.linspace(shallow_m, deep_m, 100_001)
    layers = (1 / MUNK.true_mps(0.5 * (edges[1:] + edges[:-1]))).mean()
    mean = MUNK.mean_slowness(np.array([shallow_m]), np.array([deep_m]))[0]
    assert 1 / mean == pytest.approx(1 / layers, abs=1e-5)


@pytest.mark.parametrize(("level_m", "depth_m"), [(2000.0, 4920.0), (8000.0, 4900.0)])
def test_a_direct_path_is_bent_and_sooner_than_the_straight_one(level_m, depth_m):
    """Near the floor Munk's gradient hardly changes: the ray is a circle's arc."""
    c = MUNK.true_mps(np.array([depth_m, 4950.0]))
    g, chord_m = (c[1] - c[0]) / (4950.0 - depth_m), np.hypot(level_m, 4950.0 - depth_m)
    time_s = one_leg([level_m, 0.0, -depth_m], DIRECT, MUNK)
    assert time_s == pytest.approx(
        2 / g * np.arcsinh(g * chord_m / 2 / np.sqrt(c.prod())), abs=2e-6
    )
    saved_s = chord_m * MUNK.mean_slowness(np.array([depth_m]), np.array([4950.0]))[0] - time_s
    assert saved_s == pytest.approx((g * level_m / c[0]) ** 2 / 24 * time_s, rel=0.05)


def test_munk_is_slowest_at_the_sound_channel():
    depth = np.arange(0.0, 6000.0, 10.0)
    speed = MUNK.shape_mps(depth)
    assert depth[np.argmin(speed)] == 1300.0
    assert speed.min() == pytest.approx(1500.0, abs=1e-9)


def test_a_recorded_profile_that_is_fast_makes_the_true_sound_slow():
    dive = simulate(scenario(sound=settings.Sound(error_mps=5.0, error_sigma_mps=0.0)))
    water = dive.truth.water
    bottom = np.array([4500.0])  # where Munk's profile is near its nominal 1550 m/s
    assert water.recorded_mps(bottom) - water.true_mps(bottom) == pytest.approx(5.0, abs=0.1)


def test_the_transducer_hears_from_its_own_place():
    offset = (0.0, 0.0, 24.0)
    quiet = settings.Acoustics(sigma_s=0.0)
    still = settings.Sound(profile="constant", error_sigma_mps=0.0)
    flat = settings.Floor(relief_m=0.0)
    dive = simulate(
        scenario(
            acoustics=quiet,
            sound=still,
            floor=flat,
            vehicle=settings.Vehicle(transducer_offset_m=offset),
        )
    )
    replies, motion = dive.replies, dive.truth.motion

    def place(t_s):
        attitude = np.column_stack([motion.roll_rad, motion.pitch_rad, motion.heading_rad])
        lever = body_to_enu(np.array(offset), *interpolate(t_s, motion.t_s, attitude).T)
        return dive.position_at(t_s) + lever

    beacon = dive.truth.beacons.position_enu_m[replies.beacon]
    out = np.linalg.norm(place(replies.t_ping_s) - beacon, axis=1)
    back = np.linalg.norm(place(replies.t_ping_s + replies.travel_time_s) - beacon, axis=1)
    expected = (out + back) / 1500 + dive.beacons.turn_around_s[replies.beacon]
    np.testing.assert_allclose(replies.travel_time_s, expected, atol=1e-9)


# --- replies ----------------------------------------------------------------------------------


def shares(**acoustics):
    """Replies of 3,600 pings, one a second, by straight paths."""
    dense = settings.Acoustics(ping_period_s=1.0, first_ping_s=0.5, **acoustics)
    still = settings.Sound(profile="constant")
    return simulate(scenario(duration_s=3600.0, acoustics=dense, sound=still)).replies


@pytest.fixture(scope="module")
def everyone():
    """Replies of all beacons to nearly every ping, with noise of 2 ms."""
    return shares(half_range_m=1e6, sigma_s=0.002)


def within_binomial(count, n, p):
    """Four standard deviations: one false alarm in 16,000 runs, were the seed not fixed."""
    return abs(count - n * p) <= 4 * np.sqrt(n * p * (1 - p))


def test_wrong_replies_come_in_the_shares_that_were_asked_for():
    replies = shares(gross=0.3, duplicates=0.05, listening_s=12.0)
    first = replies[replies.label != LABELS.index("duplicate")]
    n = len(first)
    mix = {"bottom": 0.1, "surface": 0.1, "late": 0.35, "uniform": 0.3, "wrong_beacon": 0.15}
    for kind, weight in mix.items():
        assert within_binomial((first.label == LABELS.index(kind)).sum(), n, 0.3 * weight), kind
    assert within_binomial(len(replies) - n, n, 0.05)


def test_half_the_replies_are_missing_when_half_are_detected():
    n = 3600 * 4
    heard = len(shares(detection=0.5, half_range_m=1e6))
    assert within_binomial(heard, n, 0.5)


def test_far_beacons_are_heard_less(everyone):
    replies = shares(half_range_m=2000.0, fall_off_m=400.0)
    range_m = 750 * replies.direct_s
    near, far = [
        ((range_m > a) & (range_m < b)).sum()
        / ((750 * everyone.direct_s > a) & (750 * everyone.direct_s < b)).sum()
        for a, b in [(0.0, 1700.0), (2500.0, 9999.0)]
    ]
    assert near > 2 * far > 0


def test_bad_periods_come_in_clusters_of_pings():
    """With wrong replies in bad periods only, pings with one follow each other in long runs."""
    replies = shares(bad_share=0.35, bad_pings=8.0, bad_gross=1.0)
    bad = np.zeros(3602)
    bad[replies.ping_id[replies.label != 0]] = 1
    starts = (np.diff(bad) > 0).sum()
    assert 0.25 < bad.mean() < 0.45
    assert 6.0 < bad.sum() / starts < 10.0


def test_a_direct_reply_is_wrong_by_the_noise_only(everyone):
    error = everyone.travel_time_s - everyone.direct_s
    assert error.std() == pytest.approx(0.002, rel=0.05)
    assert abs(error.mean()) < 4 * 0.002 / np.sqrt(len(error))


def test_a_wrong_beacons_reply_takes_another_beacons_time():
    acoustics = settings.Acoustics(sigma_s=0.0, gross=0.2, mix=settings.GrossMix(0, 0, 0, 0, 1))
    replies = simulate(scenario(acoustics=acoustics)).replies
    direct = replies[replies.label == 0]
    for reply in np.flatnonzero(replies.label == LABELS.index("wrong_beacon")):
        others = direct[
            (direct.ping_id == replies.ping_id[reply]) & (direct.beacon != replies.beacon[reply])
        ]
        if len(others) == 3:
            difference = np.abs(others.travel_time_s - replies.travel_time_s[reply])
            assert difference.min() < 1e-12


def test_a_duplicate_follows_a_reply_of_the_same_ping_and_beacon():
    replies = simulate(scenario(acoustics=settings.Acoustics(duplicates=0.2))).replies
    copies = replies[replies.label == LABELS.index("duplicate")]
    assert len(copies) > 20
    for copy in range(len(copies)):
        same = (replies.ping_id == copies.ping_id[copy]) & (replies.beacon == copies.beacon[copy])
        assert replies.travel_time_s[same].min() < copies.travel_time_s[copy] - 0.019


def test_decoys_agree_on_a_place_where_the_vehicle_is_not():
    decoy = settings.Decoy(from_s=600.0, for_s=600.0, share=1.0, offset_m=(300.0, 0.0))
    quiet = settings.Acoustics(sigma_s=0.0)
    still = settings.Sound(profile="constant", error_sigma_mps=0.0)
    dive = simulate(scenario(acoustics=quiet, decoy=decoy, sound=still))
    replies = dive.replies
    misled = replies.label == LABELS.index("decoy")
    assert set(np.flatnonzero(misled)) == set(
        np.flatnonzero((replies.t_ping_s >= 600) & (replies.t_ping_s < 1200))
    )
    beacon = dive.truth.beacons.position_enu_m[replies.beacon]
    ends = [replies.t_ping_s, replies.t_ping_s + replies.travel_time_s]
    offset = np.array([300.0, 0.0, 0.0])
    legs = [np.linalg.norm(dive.position_at(t) + offset - beacon, axis=1) for t in ends]
    flight = replies.travel_time_s - dive.beacons.turn_around_s[replies.beacon]
    np.testing.assert_allclose(flight[misled], sum(legs)[misled] / 1500, atol=1e-7)
    assert np.abs(flight - sum(legs) / 1500)[~misled].min() > 1e-3


def test_replies_are_in_the_order_heard_and_end_with_the_dive():
    dive = simulate(load_scenario("voyage_2"))
    heard = dive.replies.t_ping_s + dive.replies.travel_time_s
    assert (np.diff(heard) >= 0).all()
    assert heard[-1] <= dive.truth.motion.t_s[-1]


# --- the vehicle ------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["lawn_mower", "transit", "circle"])
def test_every_pattern_keeps_speed_turn_rate_and_altitude(pattern):
    vehicle = settings.Vehicle(pattern=pattern, speed_mps=(1.0, 1.6))
    dive = simulate(scenario(vehicle=vehicle, duration_s=7200.0))
    motion = dive.truth.motion
    speed = np.linalg.norm(motion.velocity_enu_mps[:, :2], axis=1)
    assert 1.0 - 1e-9 <= speed.min() < speed.max() <= 1.6 + 1e-9
    assert np.abs(np.diff(speed)).max() / 0.1 < 0.2  # m/s²: a change of speed takes seconds
    course = np.unwrap(np.arctan2(motion.velocity_enu_mps[:, 0], motion.velocity_enu_mps[:, 1]))
    assert np.degrees(np.abs(np.diff(course)).max()) / 0.1 < 3.0 + 1e-6


@pytest.mark.parametrize("pattern", ["lawn_mower", "transit", "circle"])
def test_depth_follows_the_floor_and_never_goes_through(pattern):
    vehicle = settings.Vehicle(pattern=pattern)
    dive = simulate(scenario(vehicle=vehicle, duration_s=7200.0))
    depth = -dive.truth.motion.position_enu_m[:, 2]
    assert depth.max() <= 5000.0 + 70.0 - 80.0
    assert depth.min() >= 5000.0 - 70.0 - 80.0
    assert np.ptp(depth) > 5.0
    assert (-dive.truth.beacons.position_enu_m[:, 2] < 5070.0 - 30.0).all()


def test_the_position_is_the_sum_of_the_velocity():
    motion = simulate(scenario()).truth.motion
    steps = 0.05 * (motion.velocity_enu_mps[1:] + motion.velocity_enu_mps[:-1])
    moved = np.cumsum(steps, axis=0)
    np.testing.assert_allclose(
        moved[:, :2], (motion.position_enu_m[1:] - motion.position_enu_m[0])[:, :2], atol=1e-6
    )
    np.testing.assert_allclose(
        moved[:, 2], motion.position_enu_m[1:, 2] - motion.position_enu_m[0, 2], atol=1e-2
    )


def test_the_body_velocity_turns_back_into_the_velocity_over_ground():
    motion = simulate(scenario()).truth.motion
    back = body_to_enu(velocity_body(motion), motion.roll_rad, motion.pitch_rad, motion.heading_rad)
    np.testing.assert_allclose(back, motion.velocity_enu_mps, atol=1e-12)


def test_in_a_current_the_bow_points_off_the_course():
    vehicle = settings.Vehicle(pattern="transit", transit_turn_deg=0.0, current_mps=(0.3, 0.2))
    motion = simulate(scenario(vehicle=vehicle)).truth.motion
    starboard = velocity_body(motion)[:, 1]
    current = 0.3 * np.cos(motion.heading_rad) - 0.2 * np.sin(motion.heading_rad)
    np.testing.assert_allclose(starboard, current, atol=0.01)  # the bank of turns aside


# --- sensors ----------------------------------------------------------------------------------


def test_the_compass_is_wrong_by_bias_deviation_drift_and_noise():
    compass = settings.Compass(bias_deg=10.0, bias_sigma_deg=0.0)
    dive = simulate(scenario(compass=compass, duration_s=7200.0))
    truth = dive.truth
    true = interpolate(dive.heading.t_s, truth.motion.t_s, truth.motion.heading_rad)
    white = dive.heading.heading_rad - true - truth.compass.error_rad
    assert np.degrees(white.std()) == pytest.approx(np.hypot(0.3, 0.1 / np.sqrt(12)), rel=0.03)
    shapes = np.stack([f(k * true) for k in (1, 2) for f in (np.sin, np.cos)])
    slow = truth.compass.error_rad - np.radians(10.0) - truth.compass.harmonics_rad @ shapes
    assert 0.1 < np.degrees(slow.std()) < 0.5
    assert np.degrees(np.abs(np.diff(slow)).max()) < 0.05


def test_readings_come_in_the_steps_of_the_instruments():
    dive = simulate(scenario())
    for values, step in [
        (np.degrees(dive.heading.heading_rad), 0.1),
        (np.degrees(dive.heading.roll_rad), 0.1),
        (dive.velocity.velocity_body_mps[dive.velocity.valid], 0.001),
        (dive.depth.depth_m, 0.01),
    ]:
        assert np.abs(values / step - np.round(values / step)).max() < 1e-6


def test_the_dvl_is_wrong_by_scale_misalignment_and_noise():
    dvl = settings.Dvl(scale=0.02, scale_sigma=0.0, gaps_per_hour=0.0)
    dive = simulate(scenario(dvl=dvl, duration_s=7200.0))
    motion = dive.truth.motion
    true = interpolate(dive.velocity.t_s, motion.t_s, velocity_body(motion))
    measured = dive.velocity.velocity_body_mps
    forward = (measured[:, 0] * true[:, 0]).sum() / (true[:, 0] ** 2).sum()
    turned = np.arctan2(
        (measured[:, 1] * true[:, 0] - measured[:, 0] * true[:, 1]).sum(),
        (measured[:, :2] * true[:, :2]).sum(),
    )
    assert forward == pytest.approx(1.02, abs=0.002)
    assert turned == pytest.approx(dive.truth.dvl.misalignment_rad, abs=0.003)
    residual = measured - true * 1.02
    assert np.diff(residual[:, 2]).std() / np.sqrt(2) == pytest.approx(0.015, rel=0.05)


def test_bottom_lock_is_lost_where_it_was_asked_for():
    dvl = settings.Dvl(gaps_per_hour=0.0, lost_from_s=600.0, lost_for_s=600.0)
    velocity = simulate(scenario(dvl=dvl)).velocity
    lost = (velocity.t_s >= 600) & (velocity.t_s < 1200)
    assert (velocity.valid == ~lost).all()
    assert np.isnan(velocity.velocity_body_mps[lost]).all()
    assert np.isfinite(velocity.velocity_body_mps[~lost]).all()


def test_depth_is_wrong_by_a_bias_and_noise():
    dive = simulate(scenario())
    error = dive.depth.depth_m + dive.position_at(dive.depth.t_s)[:, 2]
    assert error.mean() == pytest.approx(dive.truth.depth_bias_m, abs=0.02)
    assert error.std() == pytest.approx(0.1, rel=0.1)


def test_misplaced_beacons_are_recorded_elsewhere_and_say_how_far():
    dive = simulate(scenario(beacons=settings.Beacons(count=8, survey_sigma_m=3.0)))
    error = dive.beacons.position_enu_m - dive.truth.beacons.position_enu_m
    assert 1.5 < error.std() < 4.5
    assert (dive.beacons.sigma_m == 3.0).all()
    assert len(dive.beacons) == 8


# --- errors that real dives have ----------------------------------------------------------------


def dive_of(**keys):
    """Dive of half an hour with the keys given by their path, `__` for a dot."""
    changed = scenario()
    for path, value in keys.items():
        changed = with_key(changed, path.replace("__", "."), value)
    return simulate(changed)


def test_on_water_track_the_velocity_is_that_through_the_water():
    stretch = {"from_s": 600.0, "for_s": 300.0, "current_mps": 0.3, "direction_deg": 90.0}
    quiet = {"dvl__white_sigma_mps": 0.0, "dvl__slow_sigma_mps": 0.0, "dvl__scale_sigma": 0.0}
    quiet |= {"dvl__misalignment_sigma_deg": 0.0, "dvl__gaps_per_hour": 0.0}
    dive = dive_of(dvl__water_track=(stretch,), **quiet)
    motion, velocity = dive.truth.motion, dive.velocity
    attitude = np.column_stack([motion.roll_rad, motion.pitch_rad, motion.heading_rad])
    enu = body_to_enu(
        velocity.velocity_body_mps, *interpolate(velocity.t_s, motion.t_s, attitude).T
    )
    lacking = enu - interpolate(velocity.t_s, motion.t_s, motion.velocity_enu_mps)
    on_water = (velocity.t_s > 600.2) & (velocity.t_s < 899.8)
    np.testing.assert_allclose(lacking[on_water], [[-0.3, 0.0, 0.0]] * on_water.sum(), atol=2e-3)
    off = (velocity.t_s < 600) | (velocity.t_s > 900)
    np.testing.assert_allclose(lacking[off], 0.0, atol=2e-3)
    assert velocity.valid.all()


def test_a_current_that_is_not_given_is_the_vehicles_own_and_its_direction_the_seeds():
    own = dive_of(dvl__water_track=({"for_s": 1800.0},)).truth.water_mps[0]
    np.testing.assert_allclose(own, [0.04, -0.03, 0.0])
    drawn = [
        simulate(
            with_key(scenario(), "dvl.water_track", ({"for_s": 60.0, "current_mps": 0.2},)), seed
        ).truth.water_mps[0]
        for seed in (1, 2)
    ]
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 0.2)
    assert np.linalg.norm(drawn[0] - drawn[1]) > 0.01


def test_a_dvl_is_turned_on_its_mount():
    assert np.degrees(dive_of(dvl__mount_deg=25.0).truth.dvl.misalignment_rad) == pytest.approx(
        25.0, abs=1.5
    )


def test_a_compass_jumps_and_sticks():
    jumped = dive_of(compass__jump_deg=15.0, compass__jump_at_s=900.0)
    before = dive_of()
    turn = np.degrees(jumped.heading.heading_rad - before.heading.heading_rad)
    late = jumped.heading.t_s >= 900.0
    np.testing.assert_allclose(turn[~late], 0.0, atol=1e-9)
    np.testing.assert_allclose(turn[late], 15.0, atol=0.11)
    stuck = dive_of(compass__stuck_from_s=600.0).heading
    assert np.ptp(stuck.heading_rad[stuck.t_s >= 600]) == 0.0
    assert np.ptp(stuck.heading_rad[stuck.t_s < 600]) > 0.01


def test_beacons_are_displaced_by_more_than_the_log_says():
    dive = dive_of(beacons__survey_sigma_m=3.0, beacons__stated_sigma_m=0.0, beacons__count=8)
    error = dive.beacons.position_enu_m - dive.truth.beacons.position_enu_m
    assert 1.5 < error.std() < 4.5
    assert (dive.beacons.sigma_m == 0.0).all()


def test_by_default_beacons_are_as_good_as_the_log_says():
    dive = dive_of(beacons__count=8)
    error = dive.beacons.position_enu_m - dive.truth.beacons.position_enu_m
    assert 0.1 < error.std() < 0.3
    assert (dive.beacons.sigma_m == 0.2).all()


def test_one_beacon_is_displaced_to_a_side_and_the_others_are_not():
    dive = dive_of(beacons__one_displaced_m=5.0, beacons__survey_sigma_m=0.0)
    error = np.linalg.norm(dive.beacons.position_enu_m - dive.truth.beacons.position_enu_m, axis=1)
    assert np.sort(error) == pytest.approx([0, 0, 0, 5.0], abs=1e-9)
    assert np.argmax(error) == dive.truth.odd_beacon


def test_one_beacon_moves_during_the_dive():
    keys = {"beacons__one_moved_m": 30.0, "beacons__one_moved_at_s": 900.0}
    moved, still = dive_of(**keys), dive_of()
    # the reply of a beacon that moved may overtake another's
    after, before = (
        dive.replies[np.lexsort((dive.replies.beacon, dive.replies.ping_id))]
        for dive in (moved, still)
    )
    change = after.direct_s - before.direct_s
    odd, t_answer_s = after.beacon == moved.truth.odd_beacon, after.t_ping_s + after.direct_s / 2
    assert np.abs(change[~odd | (t_answer_s < 899.0)]).max() < 1e-12
    assert np.abs(change[odd & (t_answer_s > 901.0)]).max() > 1e-3
    assert (still.beacons.position_enu_m == moved.beacons.position_enu_m).all()


def test_turn_arounds_are_wrong_together_and_one_by_one():
    common = dive_of(beacons__turn_around_error_s=0.005)
    wrong = common.truth.beacons.turn_around_s - common.beacons.turn_around_s
    np.testing.assert_allclose(wrong, 0.005, atol=1e-12)
    apart = dive_of(beacons__turn_around_sigma_s=0.001, beacons__count=12)
    wrong = apart.truth.beacons.turn_around_s - apart.beacons.turn_around_s
    assert 4e-4 < wrong.std() < 2e-3
    one = dive_of(beacons__one_turn_around_error_s=0.004)
    wrong = one.truth.beacons.turn_around_s - one.beacons.turn_around_s
    assert np.sort(np.abs(wrong)) == pytest.approx([0, 0, 0, 0.004], abs=1e-12)


@pytest.mark.parametrize(
    ("noise", "skewness", "excess"),
    [("normal", 0.0, 0.0), ("laplace", 0.0, 3.0), ("student", 0.0, None), ("skewed", 1.0, 1.5)],
)
def test_every_shape_of_noise_has_the_sigma_that_is_asked_for(noise, skewness, excess):
    dense = {"acoustics__ping_period_s": 1.0, "acoustics__half_range_m": 1e6}
    replies = dive_of(acoustics__noise=noise, **dense).replies
    error = (replies.travel_time_s - replies.direct_s) / 0.002
    assert error.std() == pytest.approx(1.0, rel=0.05)
    assert abs(error.mean()) < 0.06
    if excess is not None:
        assert np.mean(error**3) == pytest.approx(skewness, abs=0.3)
        assert np.mean(error**4) - 3 == pytest.approx(excess, abs=0.9)


def test_noise_grows_with_range():
    keys = {"acoustics__ping_period_s": 1.0, "acoustics__half_range_m": 1e6}
    replies = dive_of(acoustics__sigma_s=0.0, acoustics__range_sigma_s_per_km=0.001, **keys).replies
    range_km = 1.55 * (replies.direct_s - 0.2 - 0.06 * replies.beacon) / 2
    sigma = (replies.travel_time_s - replies.direct_s) / range_km
    assert sigma.std() == pytest.approx(0.001, rel=0.05)


def test_a_slow_bias_is_a_beacons_own_and_changes_slowly():
    keys = {"acoustics__sigma_s": 0.0, "acoustics__slow_sigma_s": 0.003}
    replies = dive_of(acoustics__slow_time_s=3600.0, **keys).replies
    error = replies.travel_time_s - replies.direct_s
    own = [error[replies.beacon == b] for b in range(4)]
    assert max(np.abs(np.diff(e)).max() for e in own) < 0.0015
    assert np.std([e.mean() for e in own]) > 5e-4


def test_in_a_window_only_its_beacons_are_heard():
    windows = (
        {"from_s": 300.0, "for_s": 300.0, "beacons": (1, 3)},
        {"from_s": 900.0, "for_s": 300.0},
    )
    dive = dive_of(acoustics__window=windows)
    replies = dive.replies
    inside = (replies.t_ping_s >= 300) & (replies.t_ping_s < 600)
    assert set(dive.beacons.id[replies.beacon[inside]]) == {1, 3}
    assert not ((replies.t_ping_s >= 900) & (replies.t_ping_s < 1200)).any()
    assert set(dive.beacons.id[replies.beacon[~inside]]) == {1, 2, 3, 4}


def test_a_profile_that_is_not_logged_leaves_one_speed_right_where_the_vehicle_works():
    dive = dive_of(sound__logged=False, sound__error_sigma_mps=0.0)
    assert dive.sound_speed is None
    assert "sound_speed" not in roles(dive)
    deep_mps = dive.truth.water.true_mps(np.array([4850.0, 5000.0]))
    assert deep_mps[0] < stated_settings(dive).acoustics.sound_speed_mps < deep_mps[1]
    given = dive_of(sound__logged=False, sound__stated_speed_mps=1500.0)
    assert stated_settings(given).acoustics.sound_speed_mps == 1500.0


def test_a_profile_of_the_wrong_shape_is_off_by_another_amount_at_every_depth():
    depth = np.arange(0.0, 6000.0, 10.0)
    water = dive_of(sound__shape_sigma_mps=2.0, sound__error_sigma_mps=0.0).truth.water
    off = water.recorded_mps(depth) - water.true_mps(depth)
    assert 0.3 < off.std() < 5.0
    assert abs(np.diff(off)).max() < 0.2


def test_one_gradient_is_one_gradient():
    water = dive_of(sound__profile="linear", sound__error_sigma_mps=0.0).truth.water
    np.testing.assert_allclose(np.diff(water.true_mps(np.arange(0.0, 6000, 1000))), 16.5)
    assert water.true_mps(np.array([5000.0]))[0] == 1500.0


def test_the_sound_speed_drifts_slowly():
    drift = dive_of(sound__slow_sigma_mps=0.5).truth.slowness_drift * 1550
    assert 0.05 < np.ptp(drift) < 3.0
    assert np.abs(np.diff(drift)).max() < 0.05


def test_clocks_that_differ_shift_the_stamps_and_nothing_else():
    late = {"heading_s": 0.5, "velocity_s": -0.2, "depth_s": 2.0, "travel_time_s": 0.25}
    ours, theirs = roles(dive_of()), roles(dive_of(clocks=late))
    for role, key in (("heading", "heading_s"), ("velocity", "velocity_s"), ("depth", "depth_s")):
        shift = theirs[role]["time_ns"] - ours[role]["time_ns"]
        assert (shift == round(late[key] * 1e9)).all()
    for stamp in ("time_ns", "ping_time_ns"):
        shift = theirs["travel_time"][stamp] - ours["travel_time"][stamp]
        assert (shift == 250_000_000).all()
    assert (theirs["travel_time"]["travel_time_s"] == ours["travel_time"]["travel_time_s"]).all()


def test_the_stated_lever_arm_need_not_be_the_true_one():
    keys = {"vehicle__transducer_offset_m": (5.0, 0.0, 1.0)}
    assert stated_settings(dive_of(**keys)).vehicle.lever_arm_m == (5.0, 0.0, 1.0)
    keys["vehicle__stated_offset_m"] = (0.0, 0.0, 0.0)
    assert stated_settings(dive_of(**keys)).vehicle.lever_arm_m == (0.0, 0.0, 0.0)
    keys["vehicle__offset_stated"] = False
    assert stated_settings(dive_of(**keys)).vehicle.transducer_offset_m is None


def test_a_dive_goes_down_in_a_spiral_and_has_no_bottom_lock_on_the_way():
    down = {"vehicle__descent_s": 1200.0, "vehicle__ascent_s": 300.0, "vehicle__surface_s": 60.0}
    dive = dive_of(floor__depth_m=1000.0, vehicle__spiral_m=80.0, **down)
    motion, depth = dive.truth.motion, -dive.truth.motion.position_enu_m[:, 2]
    assert (depth[:300] < 1.0).all()
    assert (np.diff(depth[600:12000]) >= 0).all()
    assert depth[-1] < 30.0
    assert np.ptp(motion.position_enu_m[1000:11000, 0]) < 250.0
    assert not dive.velocity.valid[dive.velocity.t_s < 900].any()
    assert dive.velocity.valid[(dive.velocity.t_s > 1200) & (dive.velocity.t_s < 1450)].any()
    assert (dive.replies.t_ping_s < 900).any()


def test_hovering_stays_on_its_spot_and_a_meander_does_not():
    spot = dive_of(vehicle__pattern="hover", vehicle__centre_m=(500.0, 0.0))
    position = spot.truth.motion.position_enu_m[:, :2]
    assert np.ptp(position, axis=0).max() < 10.0
    np.testing.assert_allclose(position.mean(axis=0), [500.0, 0.0], atol=5.0)
    path = dive_of(vehicle__pattern="meander").truth.motion
    assert np.ptp(path.position_enu_m[:, :2], axis=0).max() > 200.0
    course = np.unwrap(np.arctan2(*path.velocity_enu_mps[:, :2].T))
    assert np.ptp(course) > 0.5


def test_beacons_stand_in_a_line_or_a_cluster():
    line = dive_of(beacons__layout="line", beacons__count=6).truth.beacons.position_enu_m[:, :2]
    spread = np.linalg.svd(line - line.mean(axis=0))[1]
    assert spread[1] < 0.1 * spread[0]
    cluster = dive_of(beacons__layout="cluster").truth.beacons.position_enu_m[:, :2]
    middle = cluster.mean(axis=0)
    assert np.linalg.norm(cluster - middle, axis=1).max() < 500.0
    assert 1500 < np.linalg.norm(middle) < 2500


def test_buoys_drift_and_the_log_holds_where_gnss_says_they_are():
    dive = dive_of(
        buoys__drift_mps=0.4, floor__depth_m=300.0, floor__relief_m=10.0, beacons__distance_m=600.0
    )
    columns = roles(dive)["beacons"]
    messages = columns["message"].max() + 1
    assert messages == 60
    places = columns["position_enu_m"].reshape(messages, 4, 3)
    way = np.linalg.norm((places[-1] - places[0])[:, :2], axis=1)
    assert 0.2 * 1770 < way.mean() < 0.7 * 1770
    t_s = (columns["time_ns"].reshape(messages, 4)[:, 0] - dive.start_ns) / 1e9
    for row in range(4):
        true = dive.truth.beacon_motion.place(t_s, np.full(len(t_s), row))
        assert (places[:, row] - true).std() == pytest.approx(1.5, rel=0.25)
    assert (columns["sigma_m"] == 1.5).all()


def test_a_drifting_buoy_is_ranged_where_it_is_when_it_answers():
    keys = {"buoys__drift_mps": 2.0, "sound__profile": "constant", "sound__error_sigma_mps": 0.0}
    dive = dive_of(floor__depth_m=300.0, floor__relief_m=10.0, acoustics__sigma_s=0.0, **keys)
    replies = dive.replies
    t_answer = replies.t_ping_s + replies.travel_time_s / 2
    buoy = dive.truth.beacon_motion.place(t_answer, replies.beacon)
    legs = [
        np.linalg.norm(dive.position_at(t) - buoy, axis=1)
        for t in (replies.t_ping_s, replies.t_ping_s + replies.travel_time_s)
    ]
    expected = sum(legs) / 1500 + dive.truth.beacons.turn_around_s[replies.beacon]
    # half a turn-around at 2 m/s, twice
    np.testing.assert_allclose(replies.travel_time_s, expected, atol=2e-3)


def test_gnss_is_received_at_the_surface_and_usbl_everywhere():
    keys = {"position__gnss_period_s": 1.0, "position__usbl_period_s": 30.0}
    keys |= {"position__gnss_sigma_m": 3.0, "position__usbl_gross": 0.2}
    dive = dive_of(vehicle__descent_s=900.0, vehicle__surface_s=300.0, floor__depth_m=800.0, **keys)
    gnss, usbl = dive.positions["gnss"], dive.positions["usbl"]
    assert 250 < len(gnss) < 320
    assert gnss.t_s.max() < 330
    error = gnss.position_enu_m - dive.position_at(gnss.t_s)
    assert error.std() == pytest.approx(3.0, rel=0.1)
    assert len(usbl) == 60
    off_m = np.linalg.norm(usbl.position_enu_m - dive.position_at(usbl.t_s), axis=1)
    assert 4 <= (off_m > 30).sum() <= 22
    assert dive_of(position__gnss_period_s=1.0).positions == {}


def test_drivers_count_the_heading_the_other_way_and_send_zeros():
    reversed_, right = dive_of(faults__heading_reversed=True), dive_of()
    turned = roles(reversed_)["heading"]["heading_rad"] + roles(right)["heading"]["heading_rad"]
    np.testing.assert_allclose(np.sin(turned), 0.0, atol=1e-9)
    zeros = roles(dive_of(faults__zeros_when_lost=True))["velocity"]
    lost = ~right.velocity.valid
    assert lost.any()
    assert zeros["valid"].all()
    assert (zeros["velocity_body_mps"][lost] == 0.0).all()


# --- numbers out of ranges ----------------------------------------------------------------------


def test_a_varied_key_is_drawn_by_the_seed_out_of_its_range_and_moves_no_other():
    one = scenario(vary={"compass.bias_deg": (-3.0, 3.0)})
    both = scenario(vary={"compass.bias_deg": (-3.0, 3.0), "dvl.scale": (0.1, 0.2)})
    drawn = [draw(replace(one, seed=seed)).compass.bias_deg for seed in range(40)]
    assert -3 <= min(drawn) < -2 < 2 < max(drawn) <= 3
    assert draw(both).compass.bias_deg == draw(one).compass.bias_deg
    assert 0.1 <= draw(both).dvl.scale <= 0.2


def test_a_chosen_key_takes_every_one_of_its_values():
    chosen = scenario(choose={"acoustics.noise": ("laplace", "student")})
    taken = {draw(replace(chosen, seed=seed)).acoustics.noise for seed in range(20)}
    assert taken == {"laplace", "student"}


def test_another_seed_can_be_given_with_the_scenario():
    assert same(roles(simulate(scenario(), 7)), roles(simulate(scenario(seed=7))))


# --- the same again ---------------------------------------------------------------------------


def same(a, b):
    return all(
        np.array_equal(a[role][name], b[role][name], equal_nan=a[role][name].dtype.kind == "f")
        for role in a
        for name in a[role]
    )


def test_the_same_scenario_gives_the_same_numbers_and_another_seed_others():
    assert same(roles(simulate(scenario())), roles(simulate(scenario())))
    assert not same(roles(simulate(scenario())), roles(simulate(scenario(seed=2))))


def test_worse_acoustics_move_neither_track_nor_sensors():
    good = simulate(scenario())
    bad = simulate(scenario(acoustics=settings.Acoustics(gross=0.5, detection=0.3)))
    ours, theirs = roles(good), roles(bad)
    assert len(good.replies) != len(bad.replies)
    kept = [role for role in ours if role != "travel_time"]
    assert same({role: ours[role] for role in kept}, theirs)


# --- scenarios --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["voyage_1", "voyage_2", "clean", "nominal", "foreign"])
def test_every_shipped_scenario_loads_and_runs(name):
    assert len(simulate(load_scenario(name)).replies) > 100


def test_the_voyages_are_the_papers():
    for name, come, gross in [("voyage_1", 0.5, 0.05), ("voyage_2", 0.9, 0.2)]:
        dive = simulate(load_scenario(name))
        first = dive.replies[dive.replies.label != LABELS.index("duplicate")]
        pings = len(np.unique(first.ping_id))
        wrong = np.abs(first.travel_time_s - first.direct_s) > 5 * 0.002
        assert len(first) / (150 * len(dive.beacons)) == pytest.approx(come, abs=0.03)
        assert wrong.mean() == pytest.approx(gross, abs=0.03)
        assert pings > 130


def refused(tmp_path: Path, text: str) -> str:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_scenario(path)
    return str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[acoustics]\ngros = 0.1", "unknown key [acoustics] gros; nearest: gross"),
        ("[acoustics.mix]\nlatte = 0.1", "unknown key [acoustics.mix] latte; nearest: late"),
        ("sead = 4", "unknown key sead; nearest: seed"),
        ("[acoustics]\ngross = 1.5", "at most 1"),
        ("[beacons]\ncount = 0", "at least 1"),
        ('[vehicle]\npattern = "spiral"', "spiral"),
        ("[vehicle]\nspeed_mps = [1.6, 1.0]", "speed_mps must not fall"),
        ("[vehicle]\nleg_m = [1600.0, 900.0]", "leg_m must not fall"),
        ("[beacons]\nmooring_m = [80.0, 30.0]", "mooring_m must not fall"),
        ("[floor]\ndepth_m = 100.0", "too shallow"),
        ("[floor]\ndepth_m = 6000.0\nrelief_m = 200.0", "below the profile"),
        (
            "[acoustics.mix]\nbottom=0\nsurface=0\nlate=0\nuniform=0\nwrong_beacon=0",
            "needs a weight",
        ),
        ("[vehicle]\ndescent_s = 9000.0\nascent_s = 9000.0", "longer than the dive"),
        ("[vehicle]\ndescent_s = 60.0\nsurface_s = 60.0", "surface_s: longer than"),
        ('[vary]\n"compass.bias" = [0.0, 1.0]', "unknown key compass.bias; nearest: bias_deg"),
        ('[vary]\n"compas.bias_deg" = [0.0, 1.0]', "nearest: compass"),
        ('[vary]\n"seed.bias_deg" = [0.0, 1.0]', "unknown key seed.bias_deg: seed has none"),
        ('[choose]\n"acoustics.noise" = ["pink"]', "acoustics.noise: Invalid enum value 'pink'"),
        ('[vary]\n"acoustics.gross" = [2.0, 3.0]', "acoustics.gross: Expected `float` <= 1.0"),
        ("start = 2013-06-05T02:00:00", "timezone"),
        ("seed = ", "not TOML"),
    ],
)
def test_what_no_dive_can_be_made_of_is_refused_by_name(tmp_path, text, said):
    message = refused(tmp_path, text)
    assert said in message
    assert "mine.toml" in message
    assert "\n" not in message


def test_an_unknown_scenario_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match="no scenario 'voyage1'; nearest: voyage_1"):
        load_scenario("voyage1")


def test_a_scenario_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read"):
        load_scenario(tmp_path / "none.toml")
