# SPDX-License-Identifier: Apache-2.0
"""Velocities of every frame, lever arms, sensors that are lost."""

import dataclasses

import numpy as np
import pytest
from oracles import rotation_enu_body
from small_logs import check, small_log, stamps

from abyssnav.align import align, reference
from abyssnav.align.sensors import angular_rate
from abyssnav.config import Config
from abyssnav.geometry import body_to_enu, enu_to_body
from abyssnav.tables import Heading

# --- velocity ---


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


# --- losses and what does not count ---


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
