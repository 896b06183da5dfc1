# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from oracles import harmonic_sound_speed, two_way_time

from abyssnav.acoustics.travel_time import (
    RayGeometry,
    is_physical,
    mean_sound_speed,
    predict_travel_time,
    ray_geometry,
)
from abyssnav.tables import Beacons, Replies, SoundSpeed


def profile(depth_m, speed_mps):
    return SoundSpeed(np.array(depth_m, float), np.array(speed_mps, float))


MUNK_DEPTH_M = np.linspace(0, 6000, 61)
_SCALED = 2 * (MUNK_DEPTH_M - 1300) / 1300
MUNK = profile(MUNK_DEPTH_M, 1500 * (1 + 0.00737 * (_SCALED - 1 + np.exp(-_SCALED))))
ISOVELOCITY = profile([0, 12_000], [1500, 1500])


def beacons_around(count, distance_m=2000.0, depth_m=4950.0):
    angle = 0.3 + 2 * np.pi * np.arange(count) / count
    place = np.column_stack(
        [distance_m * np.sin(angle), distance_m * np.cos(angle), 30.0 * np.arange(count) - depth_m]
    )
    return Beacons(
        id=np.arange(1, count + 1),
        name=np.array([f"B{i}" for i in range(count)]),
        position_enu_m=place,
        turn_around_s=0.1 + 0.05 * np.arange(count),
        sigma_m=np.zeros(count),
    )


def replies_to(beacons, travel_time_s, *, t_ping_s=0.0, depth_m=4900.0, lever_m=(0.0, 0.0, 0.0)):
    n = len(beacons)
    depth = np.broadcast_to(np.asarray(depth_m, float), (2, n))
    lever = np.broadcast_to(np.asarray(lever_m, float), (2, n, 3))
    time = np.broadcast_to(np.asarray(travel_time_s, float), n)
    return Replies(
        ping_id=np.ones(n, dtype=np.int64),
        beacon_id=beacons.id,
        beacon=np.arange(n),
        t_ping_s=np.full(n, t_ping_s),
        t_reply_s=t_ping_s + time,
        travel_time_s=time,
        snr_db=np.zeros(n),
        depth_ping_m=depth[0],
        depth_reply_m=depth[1],
        lever_ping_enu_m=lever[0],
        lever_reply_enu_m=lever[1],
        beacon_enu_m=beacons.position_enu_m,
        turn_around_s=beacons.turn_around_s,
        beacon_sigma_m=np.zeros(n),
    )


# --- flight -----------------------------------------------------------------------------------


def test_at_rest_the_flight_is_the_round_trip_over_the_sound_speed():
    beacons = beacons_around(4)
    of = ray_geometry(replies_to(beacons, 5.0), ISOVELOCITY)
    here = np.array([300.0, -120.0])
    expected = [
        two_way_time(lambda _: (*here, -4900.0), beacon, 1500.0, 0.0, 0.0)
        for beacon in beacons.position_enu_m
    ]
    np.testing.assert_allclose(predict_travel_time(here, here, of).time_s, expected, atol=1e-12)
    np.testing.assert_allclose(of.flight_time_s, 5.0 - beacons.turn_around_s, rtol=1e-15)


@pytest.mark.parametrize("speed_mps", [2.0, -2.0])
def test_closing_shortens_and_receding_lengthens_the_way_back(speed_mps):
    """Level with a beacon 1500 m ahead: T = τ + r / c + (r + v T) / c, v the range's growth."""
    tau_s, range_m, c = 0.5, 1500.0, 1500.0
    away = -speed_mps  # range grows at this rate
    closed_s = (2 * range_m / c + tau_s) / (1 - away / c)
    path = lambda t: (0.0, speed_mps * t, -100.0)  # noqa: E731
    assert two_way_time(path, (0.0, range_m, -100.0), c, 0.0, tau_s) == pytest.approx(closed_s)
    beacon = dataclasses.replace(
        beacons_around(1),
        position_enu_m=np.array([[0.0, range_m, -100.0]]),
        turn_around_s=np.array([tau_s]),
    )
    of = ray_geometry(replies_to(beacon, closed_s, depth_m=100.0), ISOVELOCITY)
    at_reply = np.array([[0.0, speed_mps * closed_s]])
    predicted = predict_travel_time(np.zeros((1, 2)), at_reply, of).time_s
    assert predicted[0] == pytest.approx(of.flight_time_s[0], abs=1e-12)
    assert (closed_s > 2 * range_m / c + tau_s) == (speed_mps < 0)


@pytest.mark.parametrize("count", [4, 5, 7])
def test_both_gradients_of_the_flight_agree_with_central_differences(count):
    beacons = beacons_around(count)
    rng = np.random.default_rng(count)
    replies = replies_to(
        beacons,
        5.0,
        depth_m=rng.uniform(4500, 5000, (2, count)),
        lever_m=rng.uniform(-20, 20, (2, count, 3)),
    )
    of = ray_geometry(replies, MUNK)
    ping, reply = rng.uniform(-1500, 1500, (2, count, 2))
    at = predict_travel_time(ping, reply, of)
    step = 0.05  # m; its square over the range's is the error of the difference
    for axis in (0, 1):
        move = step * np.eye(2)[axis]
        for gradient, ahead, behind in (
            (
                at.gradient_ping_spm,
                predict_travel_time(ping + move, reply, of),
                predict_travel_time(ping - move, reply, of),
            ),
            (
                at.gradient_reply_spm,
                predict_travel_time(ping, reply + move, of),
                predict_travel_time(ping, reply - move, of),
            ),
        ):
            difference = (ahead.time_s - behind.time_s) / (2 * step)
            np.testing.assert_allclose(gradient[:, axis], difference, rtol=1e-7, atol=1e-12)


def test_flight_broadcasts_positions_against_replies():
    beacons = beacons_around(5)
    of = ray_geometry(replies_to(beacons, 5.0), MUNK)
    places = np.random.default_rng(0).uniform(-900, 900, (6, 1, 2))
    all_at_once = predict_travel_time(places, places, of)
    assert all_at_once.time_s.shape == (6, 5)
    one = predict_travel_time(places[3], places[3], of)
    np.testing.assert_array_equal(all_at_once.time_s[3], one.time_s)
    np.testing.assert_array_equal(all_at_once.gradient_reply_spm[3], one.gradient_reply_spm)


def test_the_lever_arm_of_each_instant_moves_the_transducer_and_not_the_vehicle():
    beacons = beacons_around(4)
    lever_m = np.array([[3.0, -24.0, 7.0], [-20.0, 5.0, -6.0]])
    replies = replies_to(beacons, 5.0, depth_m=[[4900.0] * 4, [4910.0] * 4],
                         lever_m=np.repeat(lever_m[:, None], 4, axis=1))  # fmt: skip
    at_ping, at_reply = np.array([100.0, 200.0]), np.array([103.0, 204.0])
    found = predict_travel_time(at_ping, at_reply, ray_geometry(replies, ISOVELOCITY)).time_s
    transducers = [[*at_ping, -4900.0] + lever_m[0], [*at_reply, -4910.0] + lever_m[1]]
    for time_s, beacon_m in zip(found, beacons.position_enu_m, strict=True):
        ranges = [np.linalg.norm(transducer - beacon_m) for transducer in transducers]
        assert time_s == pytest.approx(sum(ranges) / 1500.0, abs=1e-12)


def test_right_at_a_beacon_nothing_is_divided_by_zero():
    beacons = beacons_around(4, depth_m=4900.0)
    here = beacons.position_enu_m[0, :2]
    at = predict_travel_time(here, here, ray_geometry(replies_to(beacons, 1.0), ISOVELOCITY))
    assert at.time_s[0] == pytest.approx(0.0, abs=1e-9)
    assert np.all(np.isfinite(at.gradient_ping_spm))


# --- physical ---------------------------------------------------------------------------------

SIGMA_S = 0.002


@pytest.mark.parametrize(
    ("travel_time_s", "physical"),
    [
        (np.nan, False),
        (np.inf, False),
        (0.0, False),
        (-3.0, False),
        (0.1, False),  # the turn-around alone
        (0.1 + 2 * 50 / 1500 - 5.1 * SIGMA_S, False),  # shorter than the depth difference
        (0.1 + 2 * 50 / 1500 - 4.9 * SIGMA_S, True),
        (2.0, True),
        (1e9, True),  # no upper bound
    ],
)
def test_only_what_no_position_explains_is_not_physical(travel_time_s, physical):
    beacon = beacons_around(1)
    of = ray_geometry(replies_to(beacon, travel_time_s, depth_m=4900.0), ISOVELOCITY)
    found = is_physical(of, np.array([travel_time_s]), SIGMA_S)
    assert found.tolist() == [physical]


def test_a_time_of_an_advanced_turn_around_must_still_be_above_zero():
    beacon = dataclasses.replace(beacons_around(1), turn_around_s=np.array([-1.0]))
    of = ray_geometry(replies_to(beacon, -0.5, depth_m=4950.0), ISOVELOCITY)
    assert not is_physical(of, np.array([-0.5]), SIGMA_S)[0]


# --- sound speed ------------------------------------------------------------------------------


def test_the_mean_speed_of_a_constant_profile_is_the_constant():
    depths = np.array([-50.0, 0.0, 100.0, 13_000.0])
    for other in (-20.0, 4000.0, 20_000.0):
        found = mean_sound_speed(ISOVELOCITY, depths, np.full(4, other))
        np.testing.assert_allclose(found, 1500.0, atol=1e-9)


def test_in_one_linear_layer_the_mean_is_the_logarithmic_one():
    c1, c2 = 1480.0, 1550.0
    found = mean_sound_speed(profile([0, 5000], [c1, c2]), np.array([0.0]), np.array([5000.0]))
    assert found[0] == pytest.approx((c2 - c1) / np.log(c2 / c1), abs=1e-9)


def test_the_mean_speed_is_the_quadrature_of_slowness_within_a_nanometre_per_second():
    rng = np.random.default_rng(6)
    ours, other = rng.uniform(-100, 6500, (2, 40))
    found = mean_sound_speed(MUNK, ours, other)
    expected = [
        harmonic_sound_speed(MUNK.depth_m, MUNK.sound_speed_mps, a, b)
        for a, b in zip(ours, other, strict=True)
    ]
    np.testing.assert_allclose(found, expected, atol=1e-9, rtol=0)


def test_up_and_down_take_the_same_time():
    rng = np.random.default_rng(7)
    ours, other = rng.uniform(0, 6000, (2, 50))
    there, back = mean_sound_speed(MUNK, ours, other), mean_sound_speed(MUNK, other, ours)
    np.testing.assert_allclose(there, back, rtol=0, atol=1e-10)


def test_outside_the_profile_its_end_is_held():
    short = profile([1000, 2000], [1485, 1495])
    found = mean_sound_speed(short, np.array([0.0, 3000.0, 0.0]), np.array([900.0, 5000.0, 3000.0]))
    assert found[0] == pytest.approx(1485.0, abs=1e-9)
    assert found[1] == pytest.approx(1495.0, abs=1e-9)
    slowness_s = 1000 / 1485 + 1000 * np.log(1495 / 1485) / 10 + 1000 / 1495
    assert found[2] == pytest.approx(3000 / slowness_s, abs=1e-9)


@pytest.mark.parametrize("thickness_m", [0.0, 1e-9, 1e-6, 0.9e-3, 1.1e-3, 0.01, 0.1, 1.0])
def test_over_a_thin_difference_of_depth_the_mean_goes_to_the_speed_there(thickness_m):
    steep = profile([0, 50, 60, 6000], [1500, 1530, 1490, 1560])  # 4 m/s a metre
    depth = np.array([20.0, 55.0, 3000.0])
    found = mean_sound_speed(steep, depth, depth + thickness_m)
    middle = np.interp(depth + thickness_m / 2, steep.depth_m, steep.sound_speed_mps)
    second_order = (4.0 * thickness_m) ** 2 / 12 / 1490
    np.testing.assert_allclose(found, middle, rtol=0, atol=1e-5 + second_order)


def test_the_straight_ray_at_the_mean_speed_is_the_true_ray_within_the_papers_noise():
    """In one linear gradient the ray is a circle: T = arcosh(1 + g² D² / (2 c₁ c₂)) / g."""
    c1, c2, g = 1490.0, 1545.0, 55.0 / 3500
    mean = mean_sound_speed(profile([0, 3500], [c1, c2]), np.array([0.0]), np.array([3500.0]))[0]
    distance_m = np.hypot(3500.0, 2000.0)
    ray_s = np.arccosh(1 + g**2 * distance_m**2 / (2 * c1 * c2)) / g
    assert distance_m / mean == pytest.approx(ray_s, abs=2e-4)


def test_each_straight_leg_has_the_speed_of_its_own_depths():
    beacons = beacons_around(3, depth_m=3000.0)
    replies = replies_to(beacons, 5.0, depth_m=[[500.0] * 3, [700.0] * 3], lever_m=[0, 0, -4.0])
    of = ray_geometry(replies, MUNK, sigma_s=np.inf)
    depth = -beacons.position_enu_m[:, 2]
    for found, ours_m in ((of.speed_ping_mps, 504.0), (of.speed_reply_mps, 704.0)):
        np.testing.assert_array_equal(found, mean_sound_speed(MUNK, np.full(3, ours_m), depth))


def test_legs_are_one_row_a_reply():
    beacons = beacons_around(6)
    of = ray_geometry(replies_to(beacons, 5.0), MUNK)
    assert isinstance(of, RayGeometry)
    assert len(of) == 6


def test_the_legs_of_a_reply_do_not_change_with_the_other_replies():
    """What is heard later must not move what was predicted by a bit, bent rays included."""
    rng = np.random.default_rng(11)
    n = 1000
    beacons = beacons_around(5)
    one = replies_to(beacons, 5.0)
    rows = rng.integers(0, 5, n)
    many = dataclasses.replace(
        one[rows],
        travel_time_s=rng.uniform(0.5, 20.0, n),
        depth_ping_m=rng.uniform(0, 5500, n),
        depth_reply_m=rng.uniform(0, 5500, n),
    )
    whole = ray_geometry(many, MUNK)
    straight = ray_geometry(many, MUNK, sigma_s=np.inf)
    assert np.mean(whole.speed_ping_mps != straight.speed_ping_mps) > 0.3
    for cut in (1, 40, 999):
        part = ray_geometry(many[:cut], MUNK)
        for name, column in part.columns().items():
            assert np.array_equal(column, getattr(whole, name)[:cut]), (cut, name)
