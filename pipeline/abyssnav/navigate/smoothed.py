# SPDX-License-Identifier: Apache-2.0
"""The method `smoother`: the final track by all evidence, and what it says of replies and legs."""

from dataclasses import replace

import numpy as np

from abyssnav.config import Config
from abyssnav.estimation.arrivals import Environment, Places, Received, classify, previous_pings
from abyssnav.estimation.dive_problem import Anchor, DiveInputs, ErrorPriors
from abyssnav.estimation.dive_states import (
    DEVIATION,
    HEADING,
    OFFSET,
    SCALE,
    SOUND,
    SOUND_SCALE,
    deviation_shapes,
)
from abyssnav.estimation.filter_problem import KnownStart
from abyssnav.estimation.fixes import ping_numbers
from abyssnav.estimation.learned import beacon_estimates, cause_weights, learned_parameters
from abyssnav.estimation.leg_accuracy import LegEvidence
from abyssnav.estimation.smoother import (
    FirstGuess,
    SmootherResult,
    heading_error,
    interpolate_posterior,
    positions,
    smooth,
    sound_scale,
)
from abyssnav.estimation.two_state import ACCEPTED, DUPLICATE, GATED
from abyssnav.geometry import bracket, interpolate
from abyssnav.navigate.augmented import Tracking
from abyssnav.navigate.inputs import (
    FLOOR_KNOWN_S,
    LevelTrack,
    MethodResult,
    NavigationInputs,
    error_priors,
    innovations_of_usable,
    place_track,
    rows_of_all,
)
from abyssnav.tables import (
    Dive,
    Fixes,
    Float,
    Int,
    PositionInnovations,
    SensorEstimates,
    Track,
)

_JUDGED_EVERY_S = 5.0
#: Share of the filter's process noise that is left where every step is linearised anew.
_RELINEARISED = 0.3
#: The smoother may begin at the fixes where these are so many, and no gap between them is longer
#: than this, or than this share of the dive.
_ENOUGH_FIXES, _LONGEST_WITHOUT_S, _LONGEST_SHARE = 20, 900.0, 0.05


def run_smoother(
    inputs: NavigationInputs,
    known: KnownStart | None,
    first_guess: FirstGuess | None,
    fixes: Fixes,
    config: Config,
) -> SmootherResult | None:
    """What all replies together say; None without anything to begin from."""
    dive = inputs.dive
    dive_inputs = DiveInputs(
        inputs.motion,
        dive.heading,
        inputs.usable_replies,
        inputs.geometry,
        dive.beacons,
        dive.positions,
        _anchor(known),
    )
    ping = ping_numbers(inputs.usable_replies)
    return smooth(dive_inputs, ping, _batch_priors(dive, config), first_guess, fixes)


def explains_most(result: SmootherResult) -> bool:
    """Whether half of the replies or more are no outliers."""
    return bool(np.mean(result.weight[result.taking_part] > 0.5) >= 0.5)


def _batch_priors(dive: Dive, config: Config) -> ErrorPriors:
    """The settings' sigmas; the filter's process noise also covers linearising once."""
    priors = error_priors(dive, config)
    return replace(priors, position_m2_per_s=_RELINEARISED * priors.position_m2_per_s)


def guess_by_fixes(inputs: NavigationInputs, fixes: Fixes) -> FirstGuess | None:
    """The consistent fixes, where they are many and leave no long part of the dive out."""
    good, heard_s = fixes[fixes.consistent], inputs.usable_replies.t_reply_s
    if len(good) < _ENOUGH_FIXES:
        return None
    silence_s = np.diff(np.concatenate([heard_s[:1], good.t_mid_s, heard_s[-1:]]))
    span_s = float(heard_s[-1] - heard_s[0])
    if silence_s.max() > max(_LONGEST_WITHOUT_S, _LONGEST_SHARE * span_s):
        return None
    return FirstGuess(good.t_mid_s, good.position_enu_m[:, :2])


def guess_by_filter(dive: Dive, tracking: Tracking) -> FirstGuess | None:
    """The real-time filter's track; without one, the positions of other means."""
    if tracking.start is not None:
        nodes = tracking.nodes()
        return FirstGuess(nodes.t_s, nodes.x[:, :2])
    table = dive.positions
    if table is None or not len(table):
        return None
    return FirstGuess(table.t_s, table.vehicle_enu_m)


def _anchor(known: KnownStart | None) -> Anchor | None:
    """The start that the settings know: evidence like any other."""
    if known is None or known.start.how != "settings":
        return None
    return Anchor(known.start.t_s, (known.start.east_m, known.start.north_m), known.sigma_m)


def smoothed(inputs: NavigationInputs, result: SmootherResult, config: Config) -> MethodResult:
    """The final track over the whole dive; its innovations are residuals, their sigma the noise."""
    predicted_s = inputs.geometry.flight_time_s - result.residual_s
    values = np.column_stack([predicted_s, result.sigma_s**2, result.residual_s])
    dive = inputs.dive
    gradient_known = dive.water.gradient_sigma_per_s == 0.0
    gamma = config.gate.threshold
    return MethodResult(
        final_track(inputs, result, inputs.grid.t_s),
        innovations_of_usable(inputs, decisions(result, gamma), values),
        gamma,
        estimates=_estimates(result),
        noise_s=rows_of_all(inputs, result.sigma_s),
        learned=learned_parameters(result, dive.beacons.id, gradient_known=gradient_known),
        beacons=beacon_estimates(result, dive.beacons),
        causes=cause_weights(result, dive.beacons.id),
        positions=position_innovations(inputs, result, gamma),
    )


def position_innovations(
    inputs: NavigationInputs, result: SmootherResult, gamma: float
) -> PositionInnovations | None:
    """Positions of other means as the smoother leaves them: their innovations are residuals."""
    table = inputs.dive.positions
    if table is None:
        return None
    n, (rows, factor) = len(table), result.position_residuals()
    measured_m = table.vehicle_enu_m
    left_m = measured_m - positions(result.posterior, table.t_s)
    nis = np.sum(rows[:n] ** 2, axis=1)
    sigma_m = factor * np.sqrt(np.diagonal(table.position_cov_m2, axis1=1, axis2=2))
    decision = np.where(nis <= gamma, ACCEPTED, GATED)
    return PositionInnovations(table.t_s, measured_m, sigma_m, left_m, nis, decision)


def decisions(result: SmootherResult, gamma: float) -> Int:
    """What became of every usable reply (n,)."""
    kept = np.where((result.residual_s / result.sigma_s) ** 2 <= gamma, ACCEPTED, GATED)
    return np.where(result.taking_part, kept, DUPLICATE)


def judged_times(inputs: NavigationInputs) -> Float:
    """Instants every few seconds, whatever the output's rate, by which legs are judged."""
    begin_s, end_s = inputs.motion.t_s[[0, -1]].tolist()
    return np.append(np.arange(begin_s, end_s, _JUDGED_EVERY_S), end_s)


def leg_evidence(
    inputs: NavigationInputs, result: SmootherResult, fixes: Fixes, config: Config
) -> LegEvidence:
    """What the legs' accuracy is judged by."""
    decision = decisions(result, config.gate.threshold)
    return LegEvidence(inputs.usable_replies, inputs.geometry, decision, result, fixes)


def arrivals(inputs: NavigationInputs, result: SmootherResult, config: Config) -> tuple[Int, Int]:
    """Class and explanation of every reply of the dive, usable or not."""
    dive, usable_replies, posterior = inputs.dive, inputs.usable_replies, result.posterior
    reply_m, cov_m2 = interpolate_posterior(posterior, usable_replies.t_reply_s)
    places = Places(
        positions(posterior, usable_replies.t_ping_s),
        reply_m,
        positions(posterior, previous_pings(usable_replies.t_ping_s)),
        cov_m2,
        sound_scale(posterior, usable_replies.t_reply_s),
    )
    floor_depth_m = _floor_depth(inputs, config.acoustics.floor_depth_m)
    classes = classify(
        places,
        Received(usable_replies, inputs.geometry, result.sigma_s),
        Environment(dive.beacons, dive.sound_speed, floor_depth_m),
        config.gate.threshold,
    )
    every = np.zeros((2, len(dive.replies)), dtype=np.int64)
    every[:, inputs.usable] = classes
    return every[0], every[1]


def final_track(inputs: NavigationInputs, result: SmootherResult, t_s: Float) -> Track:
    """The final track at any instants (n,)."""
    position_m, cov_m2 = interpolate_posterior(result.posterior, t_s)
    heading_rad = interpolate(t_s, inputs.motion.t_s, inputs.motion.heading_rad)
    error_rad = heading_error(result.posterior, t_s, heading_rad)
    speed_scale = 1 / (1 + float(result.posterior.states.constant[SCALE]))
    level = LevelTrack(t_s, position_m, cov_m2, heading_rad - error_rad, speed_scale)
    return place_track(inputs, level)


def _floor_depth(inputs: NavigationInputs, given_m: float | None) -> Float:
    """Depth of the floor at every ping: as given, else below the vehicle; NaN without an echo."""
    floor, t_s = inputs.dive.floor, inputs.usable_replies.t_ping_s
    if floor is None or given_m is not None:
        return np.full(len(t_s), np.nan if given_m is None else given_m)
    before, after, _ = bracket(t_s, floor.t_s)
    age_s = np.minimum(np.abs(t_s - floor.t_s[before]), np.abs(t_s - floor.t_s[after]))
    depth_m = interpolate(t_s, floor.t_s, floor.depth_m)
    return np.where(age_s <= FLOOR_KNOWN_S, depth_m, np.nan)


def _estimates(result: SmootherResult) -> SensorEstimates:
    """Errors of compass, DVL and sound at every node."""
    posterior, n = result.posterior, len(result.posterior.states.node)
    constant, node = posterior.states.constant, posterior.states.node
    sigma = np.sqrt(np.diagonal(posterior.constant_cov))
    heading_rad = posterior.problem.heading_rad
    by_constant = np.column_stack([np.ones(n), deviation_shapes(heading_rad)])
    turning = slice(OFFSET, DEVIATION.stop)
    constant_cov = posterior.constant_cov[turning, turning]
    variance = np.sum((by_constant @ constant_cov) * by_constant, axis=1)
    spread = result.estimate.factored.spread[:, HEADING]
    joint = -spread @ posterior.constant_cov[:, turning]  # of the slow error with the constants
    variance += posterior.node_cov[:, HEADING, HEADING] + 2 * np.sum(joint * by_constant, axis=1)
    sound_sigma = np.sqrt(posterior.node_cov[:, SOUND, SOUND] + sigma[SOUND_SCALE] ** 2)
    return SensorEstimates(
        posterior.problem.t_node_s,
        heading_error(posterior, posterior.problem.t_node_s, heading_rad),
        np.sqrt(np.maximum(variance, 0.0)),
        np.full(n, constant[SCALE]),
        np.full(n, sigma[SCALE]),
        node[:, SOUND] + constant[SOUND_SCALE],
        sound_sigma,
    )
