# SPDX-License-Identifier: Apache-2.0
import dataclasses
from typing import NamedTuple

import numpy as np
import pytest

from abyssnav.acoustics.travel_time import RayGeometry, predict_travel_time
from abyssnav.estimation.initialization import msac_localize, reply_window, scale_offsets

SIGMA_S = 0.002
TRUE_M = np.array([350.0, -120.0])


class Heard(NamedTuple):
    """What was heard, relative to the place now."""

    ping: np.ndarray
    beacon: np.ndarray
    from_now_ping_m: np.ndarray
    from_now_reply_m: np.ndarray

    def only(self, rows):
        return Heard(*(column[rows] for column in self))


def window(of, paths, lost_m=0.0):
    lost_m = np.full(len(of.ping), lost_m)
    from_now_m = of.from_now_ping_m, of.from_now_reply_m
    return reply_window((of.ping, of.beacon), from_now_m, lost_m, paths)


def agreed(of, paths, sound_scale, sound_scale_sigma, at_least=0):
    return msac_localize(window(of, paths), SIGMA_S, sound_scale, sound_scale_sigma, at_least)


def heard(n_pings, n_beacons, rng, gross=0.0, in_line=False, sound_scale=0.0):
    """Replies of a vehicle that runs east at 1.2 m/s and is now at `TRUE_M`."""
    angle = 0.3 + 2 * np.pi * np.arange(n_beacons) / n_beacons
    beacons_m = 2000.0 * np.column_stack([np.sin(angle), np.cos(angle)])
    if in_line:
        beacons_m = np.column_stack(
            [np.linspace(-2000, 2000, n_beacons), np.full(n_beacons, 900.0)]
        )
    ping, beacon = np.divmod(np.arange(n_pings * n_beacons), n_beacons)
    n = len(ping)
    ago_s = 24.0 * (n_pings - 1 - ping)
    from_now_reply_m = np.column_stack([-1.2 * ago_s, np.zeros(n)])
    from_now_ping_m = from_now_reply_m - [4.0, 0.0]
    paths = RayGeometry(
        flight_time_s=np.zeros(n),
        virtual_beacon_ping_m=beacons_m[beacon],
        virtual_beacon_reply_m=beacons_m[beacon],
        height_ping_m=np.full(n, 40.0),
        height_reply_m=np.full(n, 40.0),
        speed_ping_mps=np.full(n, 1530.0),
        speed_reply_mps=np.full(n, 1530.0),
    )
    recent = Heard(ping, beacon, from_now_ping_m, from_now_reply_m)
    true_s = predict_travel_time(TRUE_M + from_now_ping_m, TRUE_M + from_now_reply_m, paths).time_s
    time_s = (1 + sound_scale) * true_s + rng.normal(0, SIGMA_S, n)
    wrong = rng.permutation(n) < round(gross * n)
    time_s[wrong] += rng.uniform(0.02, 8.0, int(wrong.sum()))
    return recent, dataclasses.replace(paths, flight_time_s=time_s), wrong


def off_m(found):
    return float(np.hypot(*(found.position_m - TRUE_M)))


@pytest.mark.parametrize("seed", range(8))
def test_half_of_the_times_may_be_wrong(seed):
    recent, paths, wrong = heard(6, 4, np.random.default_rng(seed), gross=0.5)
    found = agreed(recent, paths, 0.0, 1 / 1500)
    assert off_m(found) < 8.0
    assert int(np.sum(~wrong)) - 1 <= found.n_agreeing <= int(np.sum(~wrong)) + 1
    assert found.n_replies == 24


def test_no_complete_fix_is_needed():
    """One beacon a ping, four beacons in turn."""
    recent, paths, _ = heard(8, 4, np.random.default_rng(1))
    rows = np.arange(8) * 4 + np.arange(8) % 4
    found = agreed(recent.only(rows), paths[rows], 0.0, 1 / 1500)
    assert off_m(found) < 6.0
    assert (found.n_agreeing, found.n_beacons, found.n_repeated) == (8, 4, 4)


def test_a_reply_heard_again_and_again_counts_once():
    recent, paths, _ = heard(2, 3, np.random.default_rng(2))
    rows = np.array([0, 1, 2, 3, 4, 5, 5, 5, 5, 5, 5, 5])
    found = agreed(recent.only(rows), paths[rows], 0.0, 1 / 1500)
    assert (found.n_agreeing, found.n_beacons, found.n_replies) == (6, 3, 12)


def test_beacons_that_answer_twice_in_one_ping_are_not_repeated():
    recent, paths, _ = heard(1, 4, np.random.default_rng(2))
    rows = np.array([0, 1, 2, 3, 3])
    found = agreed(recent.only(rows), paths[rows], 0.0, 1 / 1500)
    assert (found.n_agreeing, found.n_repeated) == (4, 0)


def test_fewer_than_asked_for_are_no_agreement():
    recent, paths, _ = heard(2, 4, np.random.default_rng(10))
    assert agreed(recent, paths, 0.0, 1 / 1500, at_least=8).n_agreeing == 8
    assert agreed(recent, paths, 0.0, 1 / 1500, at_least=9) is None


def test_one_beacon_alone_says_nothing():
    recent, paths, _ = heard(8, 4, np.random.default_rng(3))
    alone = recent.beacon == 1
    assert agreed(recent.only(alone), paths[alone], 0.0, 1 / 1500) is None
    nobody = np.zeros(len(recent.ping), dtype=bool)
    assert agreed(recent.only(nobody), paths[nobody], 0.0, 1 / 1500) is None


def test_a_decoy_of_few_is_outvoted():
    recent, paths, _ = heard(6, 4, np.random.default_rng(4))
    decoy_m = TRUE_M + np.array([200.0, 100.0])
    decoyed = np.arange(24) % 5 < 2
    at_decoy = predict_travel_time(
        decoy_m + recent.from_now_ping_m, decoy_m + recent.from_now_reply_m, paths
    )
    time_s = np.where(decoyed, at_decoy.time_s, paths.flight_time_s)
    lured = dataclasses.replace(paths, flight_time_s=time_s)
    found = agreed(recent, lured, 0.0, 1 / 1500)
    assert off_m(found) < 6.0
    assert found.n_agreeing <= int(np.sum(~decoyed)) + 1


def test_the_covariance_is_that_of_the_errors_or_wider():
    """Standing still nothing is widened: χ² of (e, n, k) has mean 3 over 200 draws."""
    rng = np.random.default_rng(5)
    recent, paths, _ = heard(1, 7, rng)
    k_sigma, nees = 0.002, []
    still = recent._replace(from_now_ping_m=np.zeros((7, 2)), from_now_reply_m=np.zeros((7, 2)))
    for _ in range(200):
        k = rng.normal(0, k_sigma)
        true_s = (1 + k) * predict_travel_time(TRUE_M, TRUE_M, paths).time_s
        times = dataclasses.replace(paths, flight_time_s=true_s + rng.normal(0, SIGMA_S, 7))
        found = agreed(still, times, 0.0, k_sigma)
        error = np.array([*(found.position_m - TRUE_M), found.sound_scale - k])
        nees.append(error @ np.linalg.solve(found.cov, error))
    assert 2.2 < np.mean(nees) < 3.6  # Geman-McClure takes a little weight off every time


@pytest.mark.parametrize("sound_scale", [-0.08, -0.03, 0.0, 0.02, 0.08])
@pytest.mark.parametrize("gross", [0.0, 0.4])
def test_an_unknown_sound_speed_is_searched_and_found(sound_scale, gross):
    rng = np.random.default_rng(6)
    recent, paths, _ = heard(6, 4, rng, gross, sound_scale=sound_scale)
    found = agreed(recent, paths, 0.0, 100 / 1500)
    assert abs(found.sound_scale - sound_scale) < 4 * np.sqrt(found.cov[2, 2]) < 0.01
    assert off_m(found) < 12.0
    assert found.n_repeated >= 3


def test_a_well_known_sound_speed_is_not_searched():
    assert scale_offsets(1 / 1500).tolist() == [0.0]
    assert scale_offsets(0.0).tolist() == [0.0]
    wide = scale_offsets(0.05)
    assert wide[0] <= -0.15
    assert wide[-1] >= 0.15
    assert np.all(np.diff(wide) < 0.0031)


def test_times_are_widened_by_a_twentieth_of_the_distance_run():
    recent, paths, _ = heard(3, 4, np.random.default_rng(7))
    run_m = np.abs(0.5 * (recent.from_now_ping_m + recent.from_now_reply_m)[:, 0])
    expected = np.sqrt(SIGMA_S**2 + (2 * 0.05 * run_m / 1530.0) ** 2)
    found = window(recent, paths).widened_sigma_s(SIGMA_S)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_times_are_widened_by_what_a_held_velocity_has_lost():
    recent, paths, _ = heard(1, 4, np.random.default_rng(7))
    plain_s = window(recent, paths).widened_sigma_s(SIGMA_S)
    lost_s = window(recent, paths, 30.0).widened_sigma_s(SIGMA_S)
    np.testing.assert_allclose(lost_s**2 - plain_s**2, (60.0 / 1530.0) ** 2, rtol=1e-9)


def test_how_late_a_reply_is_for_any_place_and_scale():
    recent, paths, _ = heard(3, 4, np.random.default_rng(8))
    places_m, scales = TRUE_M + np.array([[0, 0], [50, 0], [0, 80]]), np.array([0.0, 0.01, -0.02])
    found = window(recent, paths).residual_s(places_m, scales)
    for row, (place_m, k) in enumerate(zip(places_m, scales, strict=True)):
        for i in range(12):
            out = place_m + recent.from_now_ping_m[i] - paths.virtual_beacon_ping_m[i]
            back = place_m + recent.from_now_reply_m[i] - paths.virtual_beacon_reply_m[i]
            time_s = (np.hypot(np.hypot(*out), 40.0) + np.hypot(np.hypot(*back), 40.0)) / 1530.0
            late_s = paths.flight_time_s[i] - (1 + k) * time_s
            assert found[row, i] == pytest.approx(late_s, abs=1e-12)


def test_around_the_vehicle_beacons_leave_one_place():
    recent, paths, _ = heard(3, 3, np.random.default_rng(9))
    found = agreed(recent, paths, 0.0, 1 / 1500)
    assert (found.n_agreeing, off_m(found) < 8.0) == (9, True)
    assert found.n_rival <= 6  # two of the beacons, mirrored across their line


def test_beacons_in_a_line_leave_two_places_and_either_agrees_as_well():
    recent, paths, _ = heard(3, 3, np.random.default_rng(9), in_line=True)
    found = agreed(recent, paths, 0.0, 1 / 1500)
    assert found.n_rival >= found.n_agreeing - 1
    mirrored_m = TRUE_M * [1, -1] + np.array([0, 1800.0])
    assert min(off_m(found), float(np.hypot(*(found.position_m - mirrored_m)))) < 8.0
