# SPDX-License-Identifier: Apache-2.0
"""The models of the filter bank: which sensor error each supposes, and its priors."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_problem import ErrorPriors
from abyssnav.estimation.dive_states import (
    CLOCK,
    DEVIATION,
    GRADIENT,
    LEVER,
    N_BEACON,
    N_COMMON,
    OFFSET,
    SCALE,
    SOUND_SCALE,
)
from abyssnav.tables import Float


@dataclass(frozen=True)
class Hypothesis:
    """What one filter of the bank believes beyond the priors: each sigma is the larger of both."""

    name: str
    log_prior: float = 0.0
    position_m2_per_s: float = 0.0
    heading_deg: float = 0.0  #: slow heading error, with `heading_time_s`
    heading_time_s: float = 0.0
    offset_deg: float = 0.0
    deviation_deg: float = 0.0  #: of the first harmonic; the second has 0.4 of it
    velocity_mps: float = 0.0  #: slow, of the DVL, with `velocity_time_s`
    velocity_time_s: float = 0.0
    held_mps: float = 0.0  #: error of a velocity that is held, with `held_time_s`
    held_time_s: float = 3000.0
    current_mps: float = 0.0  #: in the earth frame, with `current_time_s`
    current_time_s: float = 0.0
    dvl_scale: float = 0.0
    time_noise: float = 1.0  #: factor on the sigma of travel times
    lever_m: float = 0.0
    beacon_m: float = 0.0
    clock_s: float = 0.0  #: common to all times


#: Magnitudes that field dives have. An arm or beacons of metres are seldom, and take evidence to be
#: believed; a common error of the turn-arounds no reply contradicts while the vehicle is far away.
HYPOTHESES = (
    Hypothesis("base"),
    Hypothesis("heading_drift", heading_deg=5.0, heading_time_s=600.0),
    Hypothesis(
        "heading_wander",
        heading_deg=10.0,
        heading_time_s=2000.0,
        offset_deg=10.0,
        deviation_deg=3.0,
    ),
    Hypothesis("deviation", deviation_deg=4.0),
    Hypothesis("velocity_fast", velocity_mps=0.02, velocity_time_s=120.0, held_time_s=300.0),
    Hypothesis(
        "velocity_slow",
        velocity_mps=0.05,
        velocity_time_s=600.0,
        held_mps=0.3,
        held_time_s=300.0,
    ),
    Hypothesis("current", current_mps=0.15, current_time_s=7200.0),
    Hypothesis("current_changing", current_mps=0.15, current_time_s=600.0, held_time_s=300.0),
    Hypothesis("offset", offset_deg=30.0),
    Hypothesis("scale", dvl_scale=0.10),
    Hypothesis("noisy_times", time_noise=2.0),
    Hypothesis("quiet_times", time_noise=0.4),
    Hypothesis(
        "desperate",
        position_m2_per_s=0.3,
        heading_deg=8.0,
        heading_time_s=600.0,
        offset_deg=30.0,
        dvl_scale=0.05,
        held_mps=0.7,
        held_time_s=300.0,
    ),
    Hypothesis("clock", clock_s=0.005),
    Hypothesis("lever_arm", log_prior=-3.0, lever_m=4.0),
    Hypothesis("beacons", log_prior=-3.0, beacon_m=4.0),
)


class BankPriors(NamedTuple):
    """Priors of h filters side by side, in the order of the states."""

    log_prior: Float  #: (h,)
    position_m2_per_s: Float  #: (h,)
    drift_sigma: Float  #: (h, 4) of slow heading, DVL velocity, current, sound scale
    drift_time_s: Float  #: (h, 4)
    constant_sigma: Float  #: (h, 12 + 4 b)
    time_noise_s: Float  #: (h,)
    held_sigma_mps: Float  #: (h,) of the DVL's error where the velocity is held
    held_time_s: Float  #: (h,)


def bank_priors(
    priors: ErrorPriors,
    beacon_sigma_m: Float,
    speed_mps: float,
    hypotheses: tuple[Hypothesis, ...] = HYPOTHESES,
) -> BankPriors:
    """Priors of every filter of a bank.

    Parameters
    ----------
    beacon_sigma_m : (b,) as stated; 0 or not finite where not stated
    speed_mps : sound speed that turns errors of it into a scale
    """
    stated = (beacon_sigma_m > 0) & np.isfinite(beacon_sigma_m)
    beacon_m = np.where(stated, beacon_sigma_m, priors.beacon_m)
    rows = [_row(priors, one, beacon_m, speed_mps) for one in hypotheses]
    drift_sigma, drift_time_s, constant_sigma = (np.array(c) for c in zip(*rows, strict=True))
    q = np.array([max(one.position_m2_per_s, priors.position_m2_per_s) for one in hypotheses])
    return BankPriors(
        np.array([one.log_prior for one in hypotheses]),
        q,
        drift_sigma,
        drift_time_s,
        constant_sigma,
        priors.travel_time_s * np.array([one.time_noise for one in hypotheses]),
        np.array([max(one.held_mps, priors.gap_velocity_mps) for one in hypotheses]),
        np.array([one.held_time_s for one in hypotheses]),
    )


def _row(
    priors: ErrorPriors, one: Hypothesis, beacon_m: Float, speed_mps: float
) -> tuple[list[float], list[float], Float]:
    """Sigmas and times of the drifting states, sigmas of the constants, under one hypothesis."""
    first, second = priors.deviation_rad
    deviation = float(np.radians(one.deviation_deg))
    constant = np.zeros(N_COMMON + N_BEACON * len(beacon_m))
    constant[OFFSET] = max(priors.offset_rad, float(np.radians(one.offset_deg)))
    constant[DEVIATION] = [max(first, deviation)] * 2 + [max(second, 0.4 * deviation)] * 2
    constant[SCALE] = max(priors.dvl_scale, one.dvl_scale)
    constant[SOUND_SCALE] = priors.sound_mps / speed_mps
    constant[GRADIENT], constant[CLOCK] = priors.gradient_per_s, max(priors.clock_s, one.clock_s)
    constant[LEVER] = max(priors.lever_m, one.lever_m)
    beacon = constant[N_COMMON:].reshape(-1, N_BEACON)
    beacon[:, :3] = np.maximum(beacon_m, one.beacon_m)[:, None]
    beacon[:, 3] = priors.turn_around_s
    drifts = (
        (float(np.radians(one.heading_deg)), one.heading_time_s,
         priors.heading_rad, priors.heading_time_s),
        (one.velocity_mps, one.velocity_time_s, priors.velocity_mps, priors.velocity_time_s),
        (one.current_mps, one.current_time_s, priors.current_mps, priors.current_time_s),
        (0.0, 0.0, priors.sound_slow_mps / speed_mps, priors.sound_slow_time_s),
    )  # fmt: skip
    larger = [
        (own, own_s) if own > sigma else (sigma, time_s) for own, own_s, sigma, time_s in drifts
    ]
    return [sigma for sigma, _ in larger], [time_s for _, time_s in larger], constant
