# SPDX-License-Identifier: Apache-2.0
"""Beacons: where they stand or drift, and what the log says of them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from abyssnav.geometry import bracket, interpolate
from abyssnav.simulate import scenario as settings
from abyssnav.simulate.vehicle import Relief, gauss_markov
from abyssnav.tables import Beacons, Float, Int, Table

#: Between the rows of drifting buoys' true places.
_BUOY_S = 10.0


@dataclass(frozen=True, eq=False)
class BeaconMotion(Table):
    """Where the beacons really are; one row where none of them moves."""

    t_s: Float
    position_enu_m: Float  #: (n, b, 3)

    def place(self, t_s: Float, beacon: Int) -> Float:
        """Position (m, 3) of one beacon at each instant."""
        left, right, share = bracket(t_s, self.t_s)
        ahead = share[:, None] * self.position_enu_m[right, beacon]
        return np.asarray((1 - share)[:, None] * self.position_enu_m[left, beacon] + ahead)


def place_beacons(scenario: settings.Scenario, relief: Relief, rng: Generator) -> Beacons:
    """True places, give or take 15 %, moored above the floor."""
    beacons, buoys, floor = scenario.beacons, scenario.buoys, scenario.floor
    count = beacons.count
    first = rng.uniform(0, 2 * np.pi)
    angle = first + 2 * np.pi / count * (np.arange(count) + rng.uniform(-0.15, 0.15, count))
    distance = beacons.distance_m * rng.uniform(0.85, 1.15, count)
    horizontal = distance[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    ahead = np.array([np.sin(first), np.cos(first)])
    if beacons.layout == "cluster":
        shrunk = beacons.cluster_m / (1.15 * beacons.distance_m)
        horizontal = horizontal * shrunk + beacons.distance_m * ahead
    elif beacons.layout == "line":
        along = np.linspace(-1, 1, count)[:, None] * ahead + 0.25 * ahead[::-1] * [1, -1]
        horizontal = beacons.distance_m * along + 0.05 * (horizontal - horizontal.mean(axis=0))
    depth = relief.depth_m(floor.depth_m, horizontal) - rng.uniform(*beacons.mooring_m, count)
    if buoys.drift_mps > 0:
        depth = np.full(count, buoys.depth_m)
    return Beacons(
        id=np.arange(1, count + 1),
        name=np.array([f"B{number}" for number in range(1, count + 1)]),
        position_enu_m=np.column_stack([horizontal, -depth]),
        turn_around_s=beacons.turn_around_s
        + beacons.turn_around_step_s * np.arange(count, dtype=np.float64),
        sigma_m=np.zeros(count),
    )


def move_beacons(
    beacons: Beacons, scenario: settings.Scenario, moved: int, rng: Generator
) -> BeaconMotion:
    """Where the beacons really are: at their places, adrift below buoys, or one of them moved.

    Parameters
    ----------
    moved : row of the beacon that moves
    """
    buoys, part = scenario.buoys, scenario.beacons
    at_rest = beacons.position_enu_m
    side = _to_a_side(rng)
    if buoys.drift_mps > 0:
        t_s = np.arange(0.0, scenario.duration_s + _BUOY_S, _BUOY_S)
        course = rng.uniform(0, 2 * np.pi, len(beacons))
        mean = buoys.drift_mps * np.stack([np.sin(course), np.cos(course)], axis=-1)
        wander = [gauss_markov(len(t_s), _BUOY_S, 600.0, rng) for _ in range(2 * len(beacons))]
        gusts = 0.3 * buoys.drift_mps * np.stack(wander, axis=-1).reshape(len(t_s), -1, 2)
        drift = np.zeros((len(t_s), len(beacons), 3))
        drift[1:, :, :2] = np.cumsum(_BUOY_S * (mean + gusts[:-1]), axis=0)
        return BeaconMotion(t_s, at_rest + drift)
    if part.one_moved_m > 0:
        after = at_rest.copy()
        after[moved] += part.one_moved_m * side
        t_s = part.one_moved_at_s + np.array([-1e-3, 0.0])
        return BeaconMotion(t_s, np.stack([at_rest, after]))
    return BeaconMotion(np.zeros(1), at_rest[None])


def record_beacons(
    beacons: Beacons, scenario: settings.Scenario, displaced: int, rng: Mapping[str, Generator]
) -> Beacons:
    """What the log says of the beacons: displaced, and with other turn-arounds.

    Parameters
    ----------
    displaced : row of the beacon that is wrong by more than the others
    """
    part, count = scenario.beacons, len(beacons)
    error_m = part.survey_sigma_m * rng["survey"].normal(size=(count, 3))
    error_m[displaced] += part.one_displaced_m * _to_a_side(rng["one"])
    draws = rng["turn_arounds"].normal(size=count + 1)
    error_s = part.turn_around_error_s + part.turn_around_common_sigma_s * draws[0]
    error_s += part.turn_around_sigma_s * draws[1:]
    error_s[displaced] += part.one_turn_around_error_s
    true_m = scenario.buoys.gnss_sigma_m if scenario.buoys.drift_mps > 0 else part.survey_sigma_m
    stated_m = true_m if part.stated_sigma_m is None else part.stated_sigma_m
    return replace(
        beacons,
        position_enu_m=beacons.position_enu_m + error_m,
        turn_around_s=beacons.turn_around_s - error_s,
        sigma_m=np.full(count, stated_m),
    )


def log_places(
    recorded: Beacons, truth: BeaconMotion, buoys: settings.Buoys, rng: Generator
) -> BeaconMotion:
    """Places as the log holds them: once, or what the buoys' GNSS says from time to time."""
    if buoys.drift_mps == 0:
        return BeaconMotion(np.zeros(1), recorded.position_enu_m[None])
    t_s = np.arange(0.0, truth.t_s[-1], buoys.period_s)
    true = interpolate(t_s, truth.t_s, truth.position_enu_m)
    return BeaconMotion(t_s, true + buoys.gnss_sigma_m * rng.normal(size=true.shape))


def _to_a_side(rng: Generator) -> Float:
    """Horizontal unit vector (3,) of random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.sin(angle), np.cos(angle), 0.0])
