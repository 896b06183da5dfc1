# SPDX-License-Identifier: Apache-2.0
"""Known errors of the sensors, taken out before the navigation."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from abyssnav.align import align
from abyssnav.align.calibration import apply_calibration
from abyssnav.config import Calibration, Config, Latency
from abyssnav.simulate import Simulation, load_scenario, simulate, to_log
from abyssnav.simulate.scenario import with_key

_WRONG = {
    "duration_s": 900.0,
    "vehicle.pattern": "circle",
    "vehicle.current_mps": (0.3, -0.1),
    "compass.bias_deg": 3.0,
    "compass.bias_sigma_deg": 0.0,
    "compass.deviation_sigma_deg": (2.0, 1.0),
    "compass.slow_sigma_deg": 0.0,
    "compass.white_sigma_deg": 0.0,
    "compass.step_deg": 0.0,
    "compass.tilt_sigma_deg": 0.0,
    "dvl.scale": 0.02,
    "dvl.scale_sigma": 0.0,
    "dvl.mount_deg": 4.0,
    "dvl.misalignment_sigma_deg": 0.0,
    "dvl.slow_sigma_mps": 0.0,
    "dvl.white_sigma_mps": 0.0,
    "dvl.step_mps": 0.0,
    "dvl.gaps_per_hour": 0.0,
    "clocks.heading_s": 0.4,
    "clocks.velocity_s": -0.2,
    "clocks.travel_time_s": 0.7,
}


@pytest.fixture(scope="module")
def dive() -> Simulation:
    scenario = load_scenario("clean")
    for key, value in _WRONG.items():
        scenario = with_key(scenario, key, value)
    return simulate(scenario, seed=5)


@pytest.fixture(scope="module")
def calibration(dive: Simulation) -> Calibration:
    amplitudes = np.degrees(dive.truth.compass.harmonics_rad).tolist()
    return Calibration(
        heading_bias_deg=3.0,
        deviation_deg=tuple(amplitudes),
        dvl_scale=0.02,
        mount_rpy_deg=(0.0, 0.0, -4.0),
        latency_s=Latency(heading=0.4, velocity=-0.2, travel_time=0.7),
    )


def test_every_known_error_is_taken_out(dive: Simulation, calibration: Calibration) -> None:
    aligned = align(to_log(dive, "dive"), Config(calibration=calibration))
    motion, from_start_s = dive.truth.motion, (aligned.start_ns - dive.start_ns) / 1e9
    t_s = aligned.heading.t_s + from_start_s
    true_rad = np.interp(t_s, motion.t_s, motion.heading_rad)
    inside = (t_s > 1) & (t_s < 898)
    # The deviation is a function of the true heading, and is taken out by the one that was read.
    wrong = np.degrees(np.angle(np.exp(1j * (aligned.heading.heading_rad - true_rad))))[inside]
    assert np.abs(wrong).max() < 0.25
    velocity = aligned.velocity
    t_s = velocity.t_s + from_start_s
    east_mps = np.interp(t_s, motion.t_s, motion.velocity_enu_mps[:, 0])
    bow, starboard, _ = velocity.velocity_body_mps.T
    heading_rad = np.interp(t_s, motion.t_s, motion.heading_rad)
    reckoned_mps = bow * np.sin(heading_rad) + starboard * np.cos(heading_rad)
    inside = (t_s > 1) & (t_s < 898)
    assert np.abs(reckoned_mps - east_mps)[inside].max() < 0.03
    assert aligned.replies.t_ping_s + from_start_s == pytest.approx(dive.replies.t_ping_s, abs=1e-6)
    assert "calibration_applied" in {check.name for check in aligned.checks}


def test_none_leaves_the_log_as_it_is(dive: Simulation) -> None:
    log = to_log(dive, "dive")
    assert apply_calibration(log, Calibration()) == (log, [])


def test_a_velocity_of_the_earths_frame_is_stretched_only(
    dive: Simulation, calibration: Calibration
) -> None:
    log = to_log(dive, "dive")
    velocity = dict(log.roles["velocity"])
    velocity["velocity_enu_mps"] = velocity.pop("velocity_body_mps")
    log = replace(log, roles={**log.roles, "velocity": velocity})
    applied, _ = apply_calibration(log, calibration)
    after = applied.roles["velocity"]["velocity_enu_mps"]
    assert after == pytest.approx(velocity["velocity_enu_mps"] / 1.02, nan_ok=True)


def test_the_sound_speed_is_stretched(dive: Simulation) -> None:
    log = to_log(dive, "dive")
    scaled = Config(calibration=msgspec.structs.replace(Calibration(), sound_speed_scale=0.01))
    speeds = [align(log, config).sound_speed.sound_speed_mps for config in (Config(), scaled)]
    assert speeds[1] == pytest.approx(speeds[0] / 1.01)
