# SPDX-License-Identifier: Apache-2.0
"""How well a simulated dive can be navigated at all: its Cramér-Rao bound."""

import math

import numpy as np

from abyssnav.geometry import interpolate
from abyssnav.simulate.cramer_rao import (
    BeaconErrors,
    Bound,
    Current,
    ErrorModel,
    TruePositions,
    TrueReplies,
    TrueTrack,
    posterior_bound,
)
from abyssnav.simulate.dive import Simulation, holds_profile
from abyssnav.simulate.replies import LABELS
from abyssnav.simulate.scenario import Scenario
from abyssnav.simulate.sound import MISFIT_M, NOMINAL_MPS
from abyssnav.tables import Float

#: How far the true velocity is from the one held while bottom lock is lost: the navigator's own
#: default; and what a vehicle may do of which no velocity is known yet.
GAP_SIGMA_MPS, _UNKNOWN_SIGMA_MPS = 0.1, 1.0
_START_SIGMA_M = 10.0
#: How much the deep water's gradient varies, where no profile says it.
_GRADIENT_SIGMA_PER_S = 0.004
#: Rows of the true motion that the bound takes: every so many tenths of a second.
_EVERY = 5
#: Fisher information of the location times the variance, by the noise's shape: Laplace's 1 / b²,
#: Student's (ν + 1) / (ν + 3) / s², the gamma's 1 / (θ² (k - 2)).
_INFORMATION = {"normal": 1.0, "laplace": 2.0, "student": 10 / 7, "skewed": 2.0}


def bound(simulation: Simulation) -> Bound:
    """Posterior Cramér-Rao bound of a dive, from its truth and its truly direct replies."""
    truth, replies, acoustics = simulation.truth, simulation.replies, simulation.scenario.acoustics
    motion = truth.motion[::_EVERY]
    direct = replies[replies.label == LABELS.index("direct")]
    t_reply_s = direct.t_ping_s + direct.travel_time_s
    place = truth.beacon_motion.place(t_reply_s, direct.beacon)
    vehicle = simulation.position_at(t_reply_s)
    slowness = truth.water.mean_slowness(-vehicle[:, 2], -place[:, 2])
    range_m = np.linalg.norm(vehicle - place, axis=-1)
    sigma_s = np.hypot(acoustics.sigma_s, acoustics.range_sigma_s_per_km * range_m / 1000)
    gap_m2 = interpolate(motion.t_s, simulation.velocity.t_s, _gap_variance(simulation))
    unknown_mps = np.where(motion.t_s < _first_lock(simulation), _UNKNOWN_SIGMA_MPS, 0.0)
    fixes = simulation.positions.values()
    positions = TruePositions(
        np.concatenate([np.zeros(0), *(kind.t_s for kind in fixes)]),
        np.concatenate([np.zeros(0), *(kind.sigma_m for kind in fixes)]),
    )
    return posterior_bound(
        TrueTrack(motion.t_s, motion.position_enu_m, motion.heading_rad, gap_m2, unknown_mps),
        TrueReplies(
            direct.t_ping_s, t_reply_s, direct.beacon, place, 1 / slowness,
            sigma_s / math.sqrt(_INFORMATION[acoustics.noise]),
        ),
        error_model(simulation.scenario, beacon_errors(simulation), _working_depth(simulation)),
        positions,
    )  # fmt: skip


def error_model(scenario: Scenario, beacons: BeaconErrors, working_depth_m: float) -> ErrorModel:
    """Error model of dives: standard deviations, and sizes of what is wrong for certain.

    Who navigates knows neither: an error of one size in all dives, 15 % of scale say, is one of
    unknown sign and of that standard deviation here; one out of a range has the range's.

    Parameters
    ----------
    working_depth_m : about which an unknown gradient of the sound speed turns
    """
    compass, dvl, sound, clocks = scenario.compass, scenario.dvl, scenario.sound, scenario.clocks
    first, second = np.radians(compass.deviation_sigma_deg).tolist()
    return ErrorModel(
        start_m=_START_SIGMA_M,
        heading_bias_rad=math.radians(_size(scenario, "compass.bias_deg", compass.bias_sigma_deg)),
        harmonics_rad=(first, first, second, second),
        heading_jump_rad=math.radians(_size(scenario, "compass.jump_deg")),
        heading_jump_at_s=compass.jump_at_s,
        heading_slow_rad=math.radians(compass.slow_sigma_deg),
        heading_slow_time_s=compass.slow_time_s,
        velocity_scale=_size(scenario, "dvl.scale", dvl.scale_sigma),
        mount_rad=math.radians(_size(scenario, "dvl.mount_deg", dvl.misalignment_sigma_deg)),
        velocity_slow_mps=dvl.slow_sigma_mps,
        velocity_slow_time_s=dvl.slow_time_s,
        white_m2_per_s=_white(scenario),
        heading_clock_s=abs(clocks.heading_s),
        velocity_clock_s=abs(clocks.velocity_s),
        travel_time_clock_s=abs(clocks.travel_time_s),
        sound_speed_scale=_size(
            scenario, "sound.error_mps", math.hypot(sound.error_sigma_mps, sound.shape_sigma_mps)
        )
        / NOMINAL_MPS,
        sound_speed_slow=sound.slow_sigma_mps / NOMINAL_MPS,
        sound_speed_slow_time_s=sound.slow_time_s,
        gradient_per_s=_gradient(scenario),
        gradient_depth_m=working_depth_m,
        depth_m=_size(scenario, "depth.bias_m", scenario.depth.bias_sigma_m),
        lever_m=_lever(scenario),
        turn_around_s=_size(
            scenario, "beacons.turn_around_error_s", scenario.beacons.turn_around_common_sigma_s
        ),
        range_slow_time_s=scenario.acoustics.slow_time_s,
        currents=_currents(scenario),
        beacons=beacons,
    )


def _size(scenario: Scenario, path: str, sigma: float = 0.0) -> float:
    """Standard deviation of an error with that mean: its size, or its range's root mean square."""
    part, key = path.split(".")
    value = abs(getattr(getattr(scenario, part), key))
    if path in scenario.vary:
        low, high = scenario.vary[path]
        value = math.sqrt((low * low + low * high + high * high) / 3)
    return math.hypot(sigma, value)


def _white(scenario: Scenario) -> float:
    """Growth of each axis' variance [m²/s] by white noise of DVL and compass."""
    compass, dvl = scenario.compass, scenario.dvl
    sideways_mps = float(np.mean(scenario.vehicle.speed_mps)) * math.radians(
        compass.white_sigma_deg
    )
    return dvl.white_sigma_mps**2 / dvl.rate_hz + sideways_mps**2 / (2 * compass.rate_hz)


def _working_depth(simulation: Simulation) -> float:
    """Mean depth of the beacons."""
    return float(-simulation.truth.beacons.position_enu_m[:, 2].mean())


def _gradient(scenario: Scenario) -> float:
    """Of the sound speed between vehicle and beacons: unknown, or misshapen as recorded."""
    if not holds_profile(scenario):
        return _GRADIENT_SIGMA_PER_S
    # three waves of equal variance, the first two MISFIT_M long
    steepness = np.pi / MISFIT_M * math.sqrt((1 + 4 + 9) / 3)
    return scenario.sound.shape_sigma_mps * steepness


def _lever(scenario: Scenario) -> tuple[float, float, float]:
    """How far off the stated lever arm is, each axis."""
    vehicle = scenario.vehicle
    stated = (0.0, 0.0, 0.0)
    if vehicle.offset_stated:
        stated = vehicle.stated_offset_m or vehicle.transducer_offset_m
    forward, starboard, down = np.abs(np.subtract(vehicle.transducer_offset_m, stated)).tolist()
    return forward, starboard, down


def _currents(scenario: Scenario) -> tuple[Current, ...]:
    """Stretches of water track, each with the speed of its water over both axes."""
    own_mps = math.hypot(*scenario.vehicle.current_mps)
    return tuple(
        Current(
            stretch.from_s,
            stretch.from_s + stretch.for_s,
            (own_mps if stretch.current_mps is None else stretch.current_mps) / math.sqrt(2),
        )
        for stretch in scenario.dvl.water_track
    )


def beacon_errors(simulation: Simulation) -> BeaconErrors:
    """What may be wrong with each beacon; most with the odd one, where one is."""
    part, count = simulation.scenario.beacons, len(simulation.beacons)
    place_m = np.full((count, 3), part.survey_sigma_m)
    turn_around_s = np.full(count, part.turn_around_sigma_s)
    odd = simulation.truth.odd_beacon
    sideways_m = math.hypot(part.one_displaced_m, part.one_moved_m) / math.sqrt(2)
    place_m[odd, :2] = np.hypot(place_m[odd, :2], sideways_m)
    turn_around_s[odd] = math.hypot(turn_around_s[odd], part.one_turn_around_error_s)
    slow_s = np.full(count, simulation.scenario.acoustics.slow_sigma_s)
    return BeaconErrors(place_m, turn_around_s, slow_s)


def _first_lock(simulation: Simulation) -> float:
    """Instant of the first velocity."""
    velocity = simulation.velocity
    return float(velocity.t_s[np.argmax(velocity.valid)]) if velocity.valid.any() else np.inf


def _gap_variance(simulation: Simulation) -> Float:
    """Running sum of (σ_gap age)² over the losses of bottom lock, at the DVL's stamps [m²]."""
    velocity = simulation.velocity
    t_s, rows = velocity.t_s, np.arange(len(velocity))
    last = np.maximum.accumulate(np.where(velocity.valid, rows, -1))
    age_s = np.where(last < 0, 0.0, t_s - t_s[last])
    growth = np.diff((GAP_SIGMA_MPS * age_s) ** 2, prepend=0.0)
    return np.asarray(np.cumsum(np.maximum(growth, 0.0)))
