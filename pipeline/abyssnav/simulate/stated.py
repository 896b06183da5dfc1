# SPDX-License-Identifier: Apache-2.0
"""What whoever planned a simulated dive would write into its settings."""

from typing import Any

import msgspec
import numpy as np

from abyssnav.config import Config
from abyssnav.simulate.dive import Simulation

#: For times without noise.
_SIGMA_S = 0.002


def stated_settings(simulation: Simulation) -> Config:
    """Settings of a dive: what its log cannot hold, as the scenario's `stated_` keys have it.

    The transducer's lever arm, also where there is none; the one sound speed, where the log holds
    no profile; and the standard deviation of the times.
    """
    return msgspec.convert(_stated(simulation), Config)


def settings_toml(simulation: Simulation) -> str:
    """The same as TOML; empty where the defaults, and no lever arm, say it all."""
    lines = list[str]()
    for table, keys in _stated(simulation).items():
        default = getattr(Config(), table)
        for key, value in keys.items():
            if value not in (getattr(default, key), (0.0, 0.0, 0.0)):
                lines += [] if f"[{table}]" in lines else [f"[{table}]"]
                lines.append(f"{key} = {list(value) if isinstance(value, tuple) else value}")
    return "".join(f"{line}\n" for line in lines)


def _stated(simulation: Simulation) -> dict[str, dict[str, Any]]:
    """Tables and keys of the settings."""
    scenario = simulation.scenario
    vehicle, acoustics = scenario.vehicle, scenario.acoustics
    offset_m = vehicle.stated_offset_m
    offset_m = vehicle.transducer_offset_m if offset_m is None else offset_m
    sound: dict[str, Any] = {
        "travel_time_sigma_s": acoustics.stated_sigma_s or acoustics.sigma_s or _SIGMA_S
    }
    if simulation.sound_speed is None:
        sound["sound_speed_mps"] = scenario.sound.stated_speed_mps or _working_speed(simulation)
    tables = {"acoustics": sound}
    if vehicle.offset_stated:
        tables["vehicle"] = {"transducer_offset_m": offset_m}
    return tables


def _working_speed(simulation: Simulation) -> float:
    """Recorded speed between the vehicle's median depth and the beacons' mean depth."""
    truth = simulation.truth
    depth_m = -np.median(truth.motion.position_enu_m[:, 2])
    beacons_m = -np.mean(truth.beacons.position_enu_m[:, 2])
    slowness = truth.water.mean_slowness(np.atleast_1d(depth_m), np.atleast_1d(beacons_m))
    return float((1 + truth.water.scale) / slowness[0])
