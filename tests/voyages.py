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
