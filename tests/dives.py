# SPDX-License-Identifier: Apache-2.0
"""Dives for the tests of the batch estimate, and its mathematics by the book.

Predictions in plain numbers, dead reckoning step by step, dense matrices and derivatives by
differences: slow, and written from the equations, not from the package.
"""

import cmath
import math
from functools import cache
from typing import NamedTuple

import numpy as np
from oracles_best import Heard, simulated

from abyssnav.estimation.dive_problem import (
    DiveInputs,
    ErrorPriors,
    Problem,
    pose_problem,
    prior_noise,
    states_along,
)
from abyssnav.estimation.dive_states import DiveStates
from abyssnav.estimation.map_estimator import Setting
from abyssnav.geometry import interpolate

#: Steps for central differences of the nodes' states and of the constants.
SMALL_NODE = np.array([1e-2, 1e-2, 1e-5, 1e-4, 1e-4, 1e-4, 1e-4, 1e-6])
SMALL_COMMON = np.array([*[1e-5] * 5, 1e-5, 1e-6, 1e-4, 1e-6, 1e-2, 1e-2, 1e-2])
SMALL_BEACON = np.array([1e-2, 1e-2, 1e-2, 1e-6])


class Case(NamedTuple):
    """A simulated dive posed as a problem."""

    heard: Heard
    inputs: DiveInputs
    priors: ErrorPriors
    setting: Setting

    @property
    def problem(self) -> Problem:
        return self.setting.problem

    def true_states(self):
        """States of no error along the truth."""
        t_s = self.problem.t_node_s
        return states_along(self.problem, self.inputs.motion, t_s, self.heard.true_m(t_s))


def inputs_of(heard, **more):
    dive = heard.dive
    replies = dive.replies[heard.rows]
    return DiveInputs(heard.motion, dive.heading, replies, heard.geometry, dive.beacons, **more)


def posed(heard, priors=None, **more):
    """The problem of a dive."""
    priors = priors or ErrorPriors()
    inputs = inputs_of(heard, **more)
    problem = pose_problem(inputs, priors)
    sigma_m = heard.dive.beacons.sigma_m
    setting = Setting(problem, heard.ping, prior_noise(inputs, priors, problem), sigma_m > 0)
    return Case(heard, inputs, priors, setting)


@cache
def case(seed=1, duration_s=1800.0, scenario="voyage_1", count=5):
    """A dive with a number of beacons that is not three."""
    return posed(simulated(seed, duration_s, scenario, beacons={"count": count}))


def wrong_states(problem, seed, size=1.0):
    """States with errors of everything, several priors large."""
    rng = np.random.default_rng(seed)
    n, b = len(problem.t_node_s), problem.n_beacons
    node = rng.normal(0, 1, (n, 8)) * [300, 300, 0.02, 0.02, 0.02, 0.02, 0.02, 1e-3]
    common = rng.normal(0, 1, 12) * [0.2, 0.05, 0.05, 0.03, 0.03, 0.05, 1e-3, 5e-3, 2e-3, 2, 2, 2]
    beacon = rng.normal(0, 1, (b, 4)) * [5, 5, 5, 2e-3]
    return DiveStates(size * node, size * np.concatenate([common, beacon.ravel()]))


def small_steps(problem):
    return np.concatenate([SMALL_COMMON, np.tile(SMALL_BEACON, problem.n_beacons)])


def derivative(function, x, steps):
    """Central differences of `function` at x."""
    columns = []
    for j, h in enumerate(steps):
        ahead, behind = x.copy(), x.copy()
        ahead[j] += h
        behind[j] -= h
        rise = np.asarray(function(ahead)) - np.asarray(function(behind))
        columns.append(rise / (ahead[j] - behind[j]))
    return np.stack(columns, axis=-1)


def heading_error_rad(constant, slow_rad, heading_rad):
    """Offset + deviation + slow error."""
    a1, b1, a2, b2 = constant[1:5]
    return (
        constant[0]
        + a1 * math.sin(heading_rad)
        + b1 * math.cos(heading_rad)
        + a2 * math.sin(2 * heading_rad)
        + b2 * math.cos(2 * heading_rad)
        + slow_rad
    )


def travel_time_s(case, row, node, constant):
    """Time of one reply by Eq. 3, from the states of its node."""
    problem, inputs = case.problem, case.inputs
    times = problem.observations.times
    number, beacon = int(times.node[row]), int(times.beacon[row])
    offset = constant[12 + 4 * beacon : 16 + 4 * beacon]
    motion, geometry = inputs.motion, inputs.geometry
    total = 0.0
    for t_s, aim_m, height_m, speed_mps, below_m in (
        (
            inputs.replies.t_ping_s[row],
            geometry.virtual_beacon_ping_m[row],
            geometry.height_ping_m[row],
            geometry.speed_ping_mps[row],
            problem.observations.leg_ping.below_reference_m[row],
        ),
        (
            inputs.replies.t_reply_s[row],
            geometry.virtual_beacon_reply_m[row],
            geometry.height_reply_m[row],
            geometry.speed_reply_mps[row],
            problem.observations.leg_reply.below_reference_m[row],
        ),
    ):
        ends = motion.interpolate(np.array([problem.t_node_s[number], t_s]))
        run = complex(*(ends.displacement_m[1] - ends.displacement_m[0]))
        duration_s = t_s - problem.t_node_s[number]
        # The heading hardly turns between node and ping: the direction ahead by its mean.
        fine = motion.interpolate(np.linspace(problem.t_node_s[number], t_s, 200))
        ahead = np.mean(np.sin(fine.heading_rad) + 1j * np.cos(fine.heading_rad)) * duration_s
        middle_rad = 0.5 * (ends.heading_rad[0] + ends.heading_rad[1])
        turn = cmath.exp(1j * heading_error_rad(constant, node[2], middle_rad)) / (1 + constant[5])
        place = complex(node[0], node[1])
        place += turn * (run - (node[3] - 1j * node[4]) * ahead)
        place += (node[5] + 1j * node[6]) * duration_s
        table = inputs.heading
        roll, pitch, heading = (
            float(interpolate(np.array([t_s]), table.t_s, angle)[0])
            for angle in (table.roll_rad, table.pitch_rad, table.heading_rad)
        )
        level, up = _turned(constant[9:12], roll, pitch, heading)
        away = place + level - complex(*aim_m) - complex(offset[0], offset[1])
        range_m = math.hypot(away.real, away.imag, height_m + up - offset[2])
        total += range_m / speed_mps * (1 - constant[7] * below_m / speed_mps)
    return (1 + constant[6] + node[7]) * total + constant[8] + offset[3]


def _turned(body, roll, pitch, heading):
    """A body vector (forward, starboard, down) as east + i north, and up: R = Rz Ry Rx."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    ch, sh = math.cos(heading), math.sin(heading)
    ry_rx = np.array([[cp, sp * sr, sp * cr], [0, cr, -sr], [-sp, cp * sr, cp * cr]])
    rz = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    north, east, down = rz @ ry_rx @ body
    return complex(east, north), -down
