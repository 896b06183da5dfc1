# SPDX-License-Identifier: Apache-2.0
"""What the smoother learned besides the track, each with its prior beside it."""

from math import degrees

import numpy as np

from abyssnav.estimation.dive_states import (
    CLOCK,
    DRIFT_NAMES,
    GRADIENT,
    LEVER,
    N_BEACON,
    N_COMMON,
    OFFSET,
    SCALE,
    SOUND_SCALE,
    drift_groups,
)
from abyssnav.estimation.smoother import SmootherResult
from abyssnav.tables import BeaconEstimates, Beacons, CauseWeight, Float, Int, Learned

#: Name, unit and factor to the unit of each constant before the beacons'.
_CONSTANTS = (
    (OFFSET, "heading_offset", "deg", degrees(1)),
    (1, "deviation_sin_1", "deg", degrees(1)),
    (2, "deviation_cos_1", "deg", degrees(1)),
    (3, "deviation_sin_2", "deg", degrees(1)),
    (4, "deviation_cos_2", "deg", degrees(1)),
    (SCALE, "dvl_scale", "", 1.0),
    (SOUND_SCALE, "sound_speed_scale", "", 1.0),
    (GRADIENT, "sound_speed_gradient", "1/s", 1.0),
    (CLOCK, "clock", "s", 1.0),
    (LEVER.start, "lever_arm_forward", "m", 1.0),
    (LEVER.start + 1, "lever_arm_starboard", "m", 1.0),
    (LEVER.start + 2, "lever_arm_down", "m", 1.0),
)
_BEACON = (
    ("beacon_east", "m"), ("beacon_north", "m"), ("beacon_up", "m"), ("beacon_turn_around", "s"),
)  # fmt: skip
#: Unit, and factor to it, of each group of slow errors.
_DRIFT_UNITS = (("deg", degrees(1)), ("m/s", 1.0), ("m/s", 1.0), ("", 1.0), ("s", 1.0))


def learned_parameters(
    result: SmootherResult, beacon_id: Int, gradient_known: bool
) -> tuple[Learned, ...]:
    """Constants of the dive, the noise of each beacon's times, and slow errors with their times.

    A constant's prior is zero with its stated sigma.  Of a noise the value is a sigma σ, whose own
    uncertainty is σ / √(2 n), that of a sigma by n residuals; of a slow error n is the number of
    time constants τ in its window.  The uncertainty of τ is τ √(2 / n), that of a long
    Gauss-Markov process which is seen without noise.

    Parameters
    ----------
    beacon_id : (b,) of the dive's beacons
    """
    return (
        *_constants(result, gradient_known),
        *_of_beacons(result, beacon_id),
        *_noise(result, beacon_id),
        *_drifts(result),
    )


def beacon_estimates(result: SmootherResult, beacons: Beacons) -> BeaconEstimates:
    """Beacons as the smoother leaves them."""
    b = len(beacons)  # one that was moved comes after them: where it was first is what counts
    offset = result.posterior.states.beacon[:b]
    sigma = _sigma(result)[N_COMMON:].reshape(-1, N_BEACON)[:b]
    return BeaconEstimates(
        beacons.id,
        beacons.position_enu_m + offset[:, :3],
        sigma[:, :3],
        beacons.turn_around_s + offset[:, 3],
        sigma[:, 3],
    )


def cause_weights(result: SmootherResult, beacon_id: Int) -> tuple[CauseWeight, ...]:
    """Hypotheses of what is wrong, the likeliest first.

    Parameters
    ----------
    beacon_id : (b,) of the dive's beacons
    """
    ranked = sorted(result.causes, key=lambda cause: -cause.weight)
    return tuple(
        CauseWeight(
            cause.name,
            int(beacon_id[cause.beacon]) if cause.beacon >= 0 else None,
            cause.weight,
            cause.log_gain,
            cause.since_s,
        )
        for cause in ranked
    )


def _sigma(result: SmootherResult) -> Float:
    return np.sqrt(np.diagonal(result.posterior.constant_cov))


def _constants(result: SmootherResult, gradient_known: bool) -> list[Learned]:
    value, sigma = result.posterior.states.constant, _sigma(result)
    prior = result.setting.prior.constant_sigma
    return [
        Learned(
            name, factor * float(value[row]), factor * float(sigma[row]), 0.0,
            factor * float(prior[row]), unit,
        )
        for row, name, unit, factor in _CONSTANTS
        if row != GRADIENT or not gradient_known
    ]  # fmt: skip


def _of_beacons(result: SmootherResult, beacon_id: Int) -> list[Learned]:
    value = result.posterior.states.beacon
    sigma = _sigma(result)[N_COMMON:].reshape(-1, N_BEACON)
    prior = result.setting.prior.constant_sigma[N_COMMON:].reshape(-1, N_BEACON)
    return [
        Learned(
            name, float(value[row, column]), float(sigma[row, column]), 0.0,
            float(prior[row, column]), unit, int(number),
        )
        for row, number in enumerate(beacon_id)
        for column, (name, unit) in enumerate(_BEACON)
    ]  # fmt: skip


def _noise(result: SmootherResult, beacon_id: Int) -> list[Learned]:
    group, weight = result.setting.problem.group, result.estimate.weight
    count = np.bincount(group, weight, minlength=len(beacon_id) + 1)
    learned = result.estimate.noise.observation_sigma
    prior = result.setting.prior.observation_sigma
    return [
        Learned(
            "travel_time_sigma", float(learned[row]),
            float(learned[row] / np.sqrt(2 * max(count[row], 1.0))), float(prior[row]),
            float(prior[row]) / np.sqrt(20.0), "s", int(number),
        )
        for row, number in enumerate(beacon_id)
    ]  # fmt: skip


def _drifts(result: SmootherResult) -> list[Learned]:
    """Largest of the windows' sigmas of each slow error, its time there, and the process noise."""
    noise, prior = result.estimate.noise, result.setting.prior
    span_s = float(np.ptp(result.setting.problem.t_node_s))
    groups = drift_groups(result.posterior.states.node.shape[1])
    rows = []
    for group, (name, (unit, factor)) in enumerate(zip(DRIFT_NAMES, _DRIFT_UNITS, strict=True)):
        if group not in groups:
            continue
        window = int(np.argmax(noise.drift_sigma[:, group]))
        value = factor * float(noise.drift_sigma[window, group])
        count = max(span_s / len(noise.drift_sigma) / noise.drift_time_s[window, group], 1.0)
        expected = factor * float(prior.drift_sigma[window, group])
        rows.append(
            Learned(
                f"{name}_sigma", value, value / np.sqrt(2 * count), expected,
                expected / np.sqrt(6.0), unit,
            )
        )  # fmt: skip
        rows.append(
            Learned(
                f"{name}_time", float(noise.drift_time_s[window, group]),
                float(noise.drift_time_s[window, group]) * np.sqrt(2 / count),
                float(prior.drift_time_s[window, group]),
                float(prior.drift_time_s[window, group]), "s",
            )
        )  # fmt: skip
    # A variance that counts for ten: relative sigma √(2 / 10), where that of a sigma is half of it.
    q, stated = float(noise.position_m2_per_s.max()), float(prior.position_m2_per_s[0])
    rows.append(
        Learned("process_noise", q, q / np.sqrt(5.0), stated, stated / np.sqrt(5.0), "m2/s")
    )
    return rows
