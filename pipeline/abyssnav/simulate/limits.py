# SPDX-License-Identifier: Apache-2.0
"""How well a simulated dive can be navigated at all: its Cramér-Rao bound."""

import numpy as np

from abyssnav.geometry import interpolate
from abyssnav.simulate.cramer_rao import Bound, ErrorModel, TrueReplies, TrueTrack, posterior_bound
from abyssnav.simulate.dive import Simulation
from abyssnav.simulate.replies import LABELS
from abyssnav.simulate.scenario import Scenario
from abyssnav.simulate.sound import NOMINAL_MPS
from abyssnav.tables import Float

# What the true velocity may do while bottom lock is lost: the navigator's own default.
_GAP_SIGMA_MPS = 0.1
_START_SIGMA_M = 10.0


def bound(simulation: Simulation) -> Bound:
    """Posterior Cramér-Rao bound of a dive, from its truth and its truly direct replies."""
    motion, replies = simulation.truth.motion, simulation.replies
    direct = replies[replies.label == LABELS.index("direct")]
    place = simulation.truth.beacons.position_enu_m[direct.beacon]
    t_reply_s = direct.t_ping_s + direct.travel_time_s
    depth = -simulation.position_at(t_reply_s)[:, 2]
    slowness = simulation.truth.water.mean_slowness(depth, -place[:, 2])
    return posterior_bound(
        TrueTrack(
            motion.t_s,
            motion.position_enu_m,
            motion.heading_rad,
            interpolate(motion.t_s, simulation.velocity.t_s, _gap_variance(simulation)),
        ),
        TrueReplies(direct.t_ping_s, t_reply_s, place, 1 / slowness),
        error_model(simulation.scenario),
    )


def error_model(scenario: Scenario) -> ErrorModel:
    """The scenario's standard deviations; what it adds beyond them (a bias given) is no secret."""
    compass, dvl = scenario.compass, scenario.dvl
    speed_mps = float(np.mean(scenario.vehicle.speed_mps))
    heading_white_m2_per_s = (speed_mps * np.radians(compass.white_sigma_deg)) ** 2 / (
        2 * compass.rate_hz
    )
    first, second = np.radians(compass.deviation_sigma_deg)
    return ErrorModel(
        travel_time_s=scenario.acoustics.sigma_s,
        start_m=_START_SIGMA_M,
        heading_bias_rad=float(np.radians(compass.bias_sigma_deg)),
        harmonics_rad=(first, first, second, second),
        heading_slow_rad=float(np.radians(compass.slow_sigma_deg)),
        heading_slow_time_s=compass.slow_time_s,
        velocity_scale=dvl.scale_sigma,
        misalignment_rad=float(np.radians(dvl.misalignment_sigma_deg)),
        velocity_slow_mps=dvl.slow_sigma_mps,
        velocity_slow_time_s=dvl.slow_time_s,
        white_m2_per_s=dvl.white_sigma_mps**2 / dvl.rate_hz + heading_white_m2_per_s,
        sound_speed_scale=scenario.sound.error_sigma_mps / NOMINAL_MPS,
    )


def _gap_variance(simulation: Simulation) -> Float:
    """Running sum of (σ_gap age)² over the losses of bottom lock, at the DVL's stamps [m²]."""
    velocity = simulation.velocity
    t_s = velocity.t_s
    last = np.maximum.accumulate(np.where(velocity.valid, np.arange(len(t_s)), 0))
    grown = (_GAP_SIGMA_MPS * (t_s - t_s[last])) ** 2
    growth = np.diff(grown, prepend=grown[:1])
    return np.asarray(np.cumsum(np.maximum(growth, 0.0)))
