# SPDX-License-Identifier: Apache-2.0
"""Dives of one vehicle over one field of beacons, for what is calibrated from several."""

from collections.abc import Mapping, Sequence
from datetime import timedelta
from typing import Any

import msgspec
import numpy as np

from abyssnav.calibrate.evidence import DiveEvidence, evidence_of_log
from abyssnav.config import Config
from abyssnav.estimation.dive_states import deviation_shapes
from abyssnav.simulate import Simulation, load_scenario, simulate, stated_settings, to_log
from abyssnav.simulate.scenario import with_keys


def voyage(
    keys: Mapping[str, Any],
    by_dive: Sequence[Mapping[str, Any]],
    seed: int = 1,
    scenario: str = "nominal",
) -> list[Simulation]:
    """A dive for each of `by_dive`, half a day apart; constant errors and beacons are the same."""
    dives = []
    for number, own in enumerate(by_dive):
        part = with_keys(load_scenario(scenario), {**keys, **own})
        part = msgspec.structs.replace(
            part,
            seed=1000 * seed + number,
            voyage_seed=seed if part.voyage_seed is None else part.voyage_seed,
            start=part.start + timedelta(hours=12 * number),
        )
        dives.append(simulate(part))
    return dives


def evidence(dive: Simulation, name: str, config: Config | None = None) -> DiveEvidence:
    """What a simulated dive says, read with the settings that its scenario states."""
    config = stated_settings(dive) if config is None else config
    return evidence_of_log(to_log(dive, name), config, name)


def compass_as_read(dive: Simulation) -> list[float]:
    """Bias and harmonics (5,) deg of what a dive's compass reads too much, at what it reads.

    The simulator's are those at the true heading; the DVL's mounting counts with the bias.
    """
    truth, heading_rad = dive.truth, np.linspace(-np.pi, np.pi, 720, endpoint=False)
    shapes = deviation_shapes(heading_rad)
    error_rad = truth.compass.bias_rad + shapes @ truth.compass.harmonics_rad
    read = np.column_stack([np.ones(len(heading_rad)), deviation_shapes(heading_rad + error_rad)])
    fitted_rad = np.linalg.lstsq(read, error_rad, rcond=None)[0]
    fitted_rad[0] += truth.dvl.misalignment_rad
    return np.degrees(fitted_rad).tolist()


def right_values(dive: Simulation, config: Config) -> dict[tuple[str, int | None], float]:
    """Corrections that would be right, by name and beacon, in the units of the estimates."""
    t, late = dive.truth, dive.scenario.clocks
    bias_deg, *harmonics_deg = compass_as_read(dive)
    values: dict[tuple[str, int | None], float] = {
        ("heading_bias", None): bias_deg,
        ("dvl_scale", None): t.dvl.scale,
        ("sound_speed_scale", None): t.water.scale,
        ("clock", None): 0.0,
        ("latency_heading", None): late.heading_s - late.velocity_s,
        ("latency_travel_time", None): late.travel_time_s - late.velocity_s,
    }
    names = ("sin_1", "cos_1", "sin_2", "cos_2")
    for name, value in zip(names, harmonics_deg, strict=True):
        values["deviation_" + name, None] = value
    axes = ("forward", "starboard", "down")
    true_m, stated_m = dive.scenario.vehicle.transducer_offset_m, config.vehicle.lever_arm_m
    for name, value, stated in zip(axes, true_m, stated_m, strict=True):
        values["lever_arm_" + name, None] = value - stated
    for row, number in enumerate(dive.beacons.id.tolist()):
        off_m = t.beacons.position_enu_m[row] - dive.beacons.position_enu_m[row]
        for name, value in zip(("east", "north", "up"), off_m.tolist(), strict=True):
            values["beacon_" + name, number] = value
        late_s = t.beacons.turn_around_s[row] - dive.beacons.turn_around_s[row]
        values["beacon_turn_around", number] = float(late_s)
    return values
