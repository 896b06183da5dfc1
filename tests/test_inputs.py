# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from solutions import make_solution

from abyssnav.config import Config
from abyssnav.navigate.inputs import LevelTrack, place_track, prepare, vehicle_state
from abyssnav.tables import Depth, Heading, Velocity


def turning(t_s):
    """Roll, pitch and heading of a vehicle that rolls and turns."""
    t = np.asarray(t_s, float)
    return 0.05 * np.sin(0.7 * t), 0.03 * np.cos(0.4 * t), 1.0 + 0.01 * t


def turning_dive(valid=True, keep=slice(None)):
    t_s = np.arange(0.0, 600.05, 0.2)
    body_mps = np.column_stack([1.2 + 0.1 * np.sin(t_s / 9), 0.1 * np.cos(t_s / 7), 0.0 * t_s])
    valid = np.broadcast_to(np.asarray(valid), len(t_s)).copy()
    velocity = Velocity(t_s, np.where(valid[:, None], body_mps, np.nan), valid, *turning(t_s))
    fast_s = np.arange(0.0, 601.0, 0.05)
    dive = make_solution(duration_s=600.0)[0].dive
    heading = Heading(fast_s, *turning(fast_s))
    return dataclasses.replace(dive, heading=heading, velocity=velocity[keep])


def test_the_velocity_of_a_track_is_the_one_that_dead_reckoning_integrates():
    inputs = prepare(turning_dive(), Config())
    grid, vehicle = inputs.grid, inputs.vehicle
    rot = np.exp(1j * (0.5 * np.pi - grid.heading_rad))  # east + i north of the bow
    velocity_mps = (vehicle.forward_mps - 1j * vehicle.starboard_mps) * rot
    run_m = 0.5 * (velocity_mps[1:] + velocity_mps[:-1]) * np.diff(grid.t_s)
    sums_m = np.diff(grid.displacement_m[:, 0] + 1j * grid.displacement_m[:, 1])
    np.testing.assert_allclose(run_m, sums_m, atol=2e-3)  # a second's bend of the velocity


def test_roll_and_pitch_are_those_of_the_compass_between_its_stamps():
    t_s = np.arange(3.03, 500.0, 7.7)
    state = vehicle_state(turning_dive(), t_s, 1.0)
    np.testing.assert_allclose(state.roll_rad, turning(t_s)[0], atol=1e-4)
    np.testing.assert_allclose(state.pitch_rad, turning(t_s)[1], atol=1e-4)


@pytest.mark.parametrize("lost", ["invalid", "silent"])
def test_without_bottom_lock_the_last_good_velocity_is_held(lost):
    times_s = np.arange(0.0, 600.05, 0.2)
    good = (times_s < 100.0) | (times_s > 200.0)
    dive = turning_dive(valid=good) if lost == "invalid" else turning_dive(keep=good)
    t_s = np.array([99.8, 120.0, 150.0, 199.9])
    state = vehicle_state(dive, t_s, 1.0)
    held = vehicle_state(turning_dive(), np.array([99.8]), 1.0)
    # the body's velocity is held, so roll and pitch may still tilt it
    np.testing.assert_allclose(state.forward_mps, held.forward_mps[0], atol=5e-3)
    np.testing.assert_allclose(state.starboard_mps, held.starboard_mps[0], atol=5e-3)


def test_altitude_is_floor_less_depth_and_unknown_far_from_an_echo():
    dive = turning_dive()
    floor_s = np.append(np.arange(0.0, 300.0, 2.0), 500.0)
    dive = dataclasses.replace(dive, floor=Depth(floor_s, np.full(len(floor_s), 4960.0)))
    state = vehicle_state(dive, np.array([100.3, 400.0]), 1.0)
    np.testing.assert_allclose(state.altitude_m, [60.0, np.nan])


def test_a_method_that_estimates_the_dvls_scale_says_so_in_its_speed():
    inputs = prepare(turning_dive(), Config())
    t_s = inputs.grid.t_s
    still, cov_m2 = np.zeros((len(t_s), 2)), np.tile(np.eye(2), (len(t_s), 1, 1))
    plain = place_track(inputs, LevelTrack(t_s, still, cov_m2, 0.0 * t_s))
    scaled = place_track(inputs, LevelTrack(t_s, still, cov_m2, 0.0 * t_s, 1 / 1.01))
    np.testing.assert_allclose(plain.forward_mps, 1.01 * scaled.forward_mps)
    np.testing.assert_array_equal(plain.forward_mps, inputs.vehicle.forward_mps)
    np.testing.assert_array_equal(plain.altitude_m, inputs.vehicle.altitude_m)


@pytest.mark.parametrize(
    ("late_s", "begins_s", "ends_s"), [(3600.0, 0.0, 600.0), (0.5, 0.0, 600.5)]
)
def test_depths_alone_carry_no_track_on(late_s, begins_s, ends_s):
    """Stamped an hour late, they span an hour in which nothing tells the way made."""
    dive = turning_dive()
    t_s = np.arange(0.0, 600.05, 1.0)
    depth = Depth(t_s + late_s, np.full(len(t_s), 50.0))
    motion = prepare(dataclasses.replace(dive, depth=depth), Config()).motion
    assert (motion.t_s[0], motion.t_s[-1]) == pytest.approx((begins_s, ends_s), abs=0.01)
