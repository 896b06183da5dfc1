# SPDX-License-Identifier: Apache-2.0
"""The model that the peers share: one state, one travel time, by the textbook.

    x = [east, north, heading offset, DVL scale error, relative error of slowness]
    position += R(offset) Δrun / (1 + scale)
    T = (|p(t_ping) - b| + |p(t_reply) - b|) / c · (1 + x₅) + turn-around

The vehicle's way between ping and reply is dead reckoning's.
"""

from typing import Any

import numpy as np
from dive_reader import DiveData
from peer_settings import (
    DVL_SCALE_SIGMA,
    HEADING_SIGMA_RAD,
    HEADING_WALK_RAD2_PER_S,
)

EAST, NORTH, HEADING, SCALE, SLOWNESS = range(5)


def turned(run_m: Any, x: Any) -> Any:
    """A displacement by dead reckoning, corrected for what the state says of the sensors."""
    cos, sin = np.cos(x[HEADING]), np.sin(x[HEADING])
    return np.array([[cos, -sin], [sin, cos]]) @ run_m / (1.0 + x[SCALE])


def start_of(dive: DiveData) -> tuple[float, Any, Any]:
    """Instant, state and covariance where the filters begin."""
    assert dive.start is not None
    t_s, place, sigma_m = dive.start
    x = np.array([*place, 0.0, 0.0, 0.0])
    speed = dive.mean_speed(0.0, next(iter(dive.beacons.values()))[0][2])
    sigma = [sigma_m, sigma_m, HEADING_SIGMA_RAD, DVL_SCALE_SIGMA, dive.sound_sigma_mps / speed]
    return t_s, x, np.diag(np.square(sigma))


def motion(dive: DiveData, from_s: float, to_s: float, x: Any) -> tuple[Any, Any, Any]:
    """Displacement, its F = ∂x'/∂x, and Q, between two instants."""
    first, last = (dive.interpolated(t, dive.run_m) for t in (from_s, to_s))
    moved = turned(last - first, x)
    F = np.eye(5)
    F[:2, HEADING] = [-moved[1], moved[0]]
    F[:2, SCALE] = -moved / (1.0 + x[SCALE])
    seconds = to_s - from_s
    gap_m2 = [dive.interpolated(t, dive.gap_m2)[0] for t in (from_s, to_s)]
    Q = np.zeros((5, 5))
    Q[EAST, EAST] = Q[NORTH, NORTH] = dive.walk_m2_per_s * seconds + gap_m2[1] - gap_m2[0]
    Q[HEADING, HEADING] = HEADING_WALK_RAD2_PER_S * seconds
    return moved, F, Q


class TravelTime:
    """One reply: its predicted time and derivative at a state of the instant `t_node`."""

    def __init__(self, dive: DiveData, reply: Any, t_node: float) -> None:
        self.beacon_m, self.turn_around_s, beacon_sigma_m = dive.beacons[int(reply.beacon_id)]
        node = dive.interpolated(t_node, dive.run_m)
        self.ways = []
        for t in (reply.t_ping, reply.t_reply):
            place = dive.place(t)
            speed = dive.mean_speed(place[2], self.beacon_m[2])
            lever = dive.interpolated(t, dive.lever_m)
            run = dive.interpolated(t, dive.run_m) - node
            self.ways.append((run, lever[:2], place[2], speed))
        speed = self.ways[0][3]
        self.variance_s2 = dive.travel_time_sigma_s**2 + (2.0 * beacon_sigma_m / speed) ** 2

    def predict(self, x: Any) -> tuple[float, Any]:
        """Two-way time and its derivative (5,)."""
        total, H = 0.0, np.zeros(5)
        for run, lever, up_m, speed in self.ways:
            moved = turned(run, x)
            away = np.array([*(x[:2] + moved + lever), up_m]) - self.beacon_m
            range_m = np.linalg.norm(away)
            total += range_m / speed
            slope = away[:2] / (range_m * speed) * (1.0 + x[SLOWNESS])
            H[:2] += slope
            H[HEADING] += slope @ [-moved[1], moved[0]]
            H[SCALE] -= slope @ moved / (1.0 + x[SCALE])
        H[SLOWNESS] = total
        return total * (1.0 + x[SLOWNESS]) + self.turn_around_s, H
