# SPDX-License-Identifier: Apache-2.0
"""Sound speed of the vehicle's own samples and of means."""

import dataclasses

import numpy as np
import pytest
from small_logs import check, small_log, stamps

from abyssnav.align import align
from abyssnav.config import Config


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
    dive = align(sound_log(columns), Config())
    beacons_m = -float(np.mean(dive.beacons.position_enu_m[:, 2]))
    middle_m = 0.5 * (float(np.median(dive.depth.depth_m)) + beacons_m)
    water = dive.sound_speed
    found_mps = np.interp(middle_m, water.depth_m, water.sound_speed_mps)
    assert found_mps == pytest.approx(1511.0, abs=1e-6)
