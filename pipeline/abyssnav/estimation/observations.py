# SPDX-License-Identifier: Apache-2.0
"""Travel times and positions as the nodes of a dive predict them, with all derivatives."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_states import (
    CLOCK,
    CURRENT_EAST,
    CURRENT_NORTH,
    DEVIATION,
    EAST,
    FORWARD,
    GRADIENT,
    HEADING,
    LEVER,
    N_BEACON,
    N_MOTION,
    N_NODE,
    NORTH,
    OFFSET,
    SCALE,
    SOUND,
    SOUND_SCALE,
    STARBOARD,
    DiveStates,
    beacon_columns,
)
from abyssnav.geometry import Plane, pairs
from abyssnav.tables import Float, Int, Table


@dataclass(frozen=True, eq=False)
class Offsets(Table):
    """Where the vehicle is at an instant, seen from the node before: dead reckoning as logged."""

    displacement: Plane  #: (n,) since the node, east + i north, m
    ahead: Plane  #: (n,) ∫ (sin ψ + i cos ψ) dt since the node, s
    duration_s: Float  #: (n,) since the node
    shapes: Float  #: (n, 4) harmonics of the heading
    body_level: Plane  #: (n, 3) horizontal parts of the body's axes, east + i north
    body_up: Float  #: (n, 3) upward parts of the body's axes


@dataclass(frozen=True, eq=False)
class LegTable(Table):
    """One acoustic leg of every reply: at the ping, or at the reply."""

    virtual_beacon: Plane  #: (n,) beacon less the lever arm as stated, east + i north, m
    height_m: Float  #: transducer above the beacon
    speed_mps: Float  #: slant range over travel time
    below_reference_m: Float  #: leg's mean depth below the depth that the stated speed is for


@dataclass(frozen=True, eq=False)
class TimeTable(Table):
    """The travel times of a dive."""

    node: Int  #: (n,) from which the vehicle's place at ping and reply is reckoned
    beacon: Int  #: (n,) row of the beacon
    flight_time_s: Float  #: (n,) measured, less the turn-around as stated


@dataclass(frozen=True, eq=False)
class PositionTable(Table):
    """Positions measured by other means, as the antenna or transponder has them."""

    node: Int
    position: Plane  #: less the lever arm, east + i north, m
    whitening: Float  #: (n, 2, 2) W with Wᵀ W the inverse covariance


class Observations(NamedTuple):
    """All that says where the vehicle was."""

    times: TimeTable
    ping: Offsets
    reply: Offsets
    leg_ping: LegTable
    leg_reply: LegTable
    positions: PositionTable
    position_offsets: Offsets


class Rows(NamedTuple):
    """Linearised observations: first the times, then east and north of every position."""

    residual: Float  #: (r,) measured less predicted; s, or sigmas as stated
    by_node: Float  #: (r, s) by the s states of its node
    by_constant: Float  #: (r, m)


class Directions(NamedTuple):
    """Where further constants, x of them, move the vehicle at an instant, east + i north."""

    ping: Plane  #: (n, x)
    reply: Plane  #: (n, x)
    position: Plane  #: (p, x)


def observe(
    observations: Observations, states: DiveStates, further: Directions | None = None
) -> Rows:
    """What times and positions lack of the predicted, and their derivatives (Eq. 3).

        T = (1 + k) Σ (1 - g z / c) ρ / c + τ_clock + τ_beacon     over both legs, ping and reply
        ρ² = |p + d + R l - b|² + height²

    with k the constant and the slow sound-speed scale together, g the error of the sound speed's
    gradient, z how far the leg's mean depth lies below the reference, p the node, d the
    displacement since, l the error of the lever arm, R from the body to the earth frame, b the
    beacon.

    Parameters
    ----------
    further : of constants whose part is already in the offsets; their columns come last
    """
    if further is None:
        n, p = len(observations.times), len(observations.positions)
        further = Directions(*(np.zeros((rows, 0), dtype=complex) for rows in (n, n, p)))
    rows = [_observe_times(observations, states, further)]
    if len(observations.positions):
        rows.append(_observe_positions(observations, states, further.position))
    return Rows(*(np.concatenate(columns) for columns in zip(*rows, strict=True)))


class _Place(NamedTuple):
    """Vehicle at an instant and the derivatives of its position, east + i north."""

    position: Plane  #: (n,)
    by_node: Plane  #: (n, s)
    by_motion: Plane  #: (n, 6)


def _place(offsets: Offsets, node: Float, states: DiveStates) -> _Place:
    """Position by dead reckoning since the node (n, s), with the node's errors."""
    scale = 1 + states.constant[SCALE]
    error_rad = node[:, HEADING] + states.constant[OFFSET]
    error_rad = error_rad + offsets.shapes @ states.constant[DEVIATION]
    turn = np.exp(1j * error_rad) / scale
    ahead = turn * offsets.ahead
    slow = node[:, FORWARD] - 1j * node[:, STARBOARD]
    moved = turn * offsets.displacement - slow * ahead
    current = node[:, CURRENT_EAST] + 1j * node[:, CURRENT_NORTH]
    by_node = np.zeros(node.shape, dtype=complex)
    by_node[:, EAST], by_node[:, NORTH], by_node[:, HEADING] = 1, 1j, 1j * moved
    by_node[:, FORWARD], by_node[:, STARBOARD] = -ahead, 1j * ahead
    by_node[:, CURRENT_EAST] = offsets.duration_s
    by_node[:, CURRENT_NORTH] = 1j * offsets.duration_s
    by_motion = np.column_stack([1j * moved, 1j * moved[:, None] * offsets.shapes, -moved / scale])
    position = node[:, EAST] + 1j * node[:, NORTH] + moved + current * offsets.duration_s
    return _Place(position, by_node, by_motion)


def _observe_times(observations: Observations, states: DiveStates, further: Directions) -> Rows:
    times = observations.times
    n, beacon = len(times), states.beacon[times.beacon]
    node = states.node[times.node]
    slower = 1 + states.constant[SOUND_SCALE] + node[:, SOUND]
    by_node, by_constant = np.zeros(node.shape), np.zeros((n, len(states.constant)))
    by_beacon = np.zeros((n, N_BEACON))
    by_further = np.zeros(further.ping.shape)
    time_s, by_gradient = np.zeros(n), np.zeros(n)
    for offsets, leg, directions in (
        (observations.ping, observations.leg_ping, further.ping),
        (observations.reply, observations.leg_reply, further.reply),
    ):
        place = _place(offsets, node, states)
        transducer = place.position + offsets.body_level @ states.constant[LEVER]
        away = transducer - leg.virtual_beacon - (beacon[:, 0] + 1j * beacon[:, 1])
        height_m = leg.height_m + offsets.body_up @ states.constant[LEVER] - beacon[:, 2]
        range_m = np.maximum(np.sqrt(away.real**2 + away.imag**2 + height_m**2), 1e-9)
        gradient = states.constant[GRADIENT] * leg.below_reference_m / leg.speed_mps
        leg_s = range_m / leg.speed_mps * (1 - gradient)
        time_s += leg_s
        by_gradient -= range_m / leg.speed_mps**2 * leg.below_reference_m
        factor = slower * (1 - gradient) / (range_m * leg.speed_mps)
        slope, climb = np.conj(away) * factor, height_m * factor
        by_node += (slope[:, None] * place.by_node).real
        by_constant[:, :N_MOTION] += (slope[:, None] * place.by_motion).real
        by_further += (slope[:, None] * directions).real
        by_constant[:, LEVER] += (slope[:, None] * offsets.body_level).real
        by_constant[:, LEVER] += climb[:, None] * offsets.body_up
        by_beacon[:, :3] -= np.column_stack([slope.real, -slope.imag, climb])
    by_node[:, SOUND] = by_constant[:, SOUND_SCALE] = time_s
    by_constant[:, GRADIENT] = slower * by_gradient
    by_constant[:, CLOCK] = by_beacon[:, 3] = 1.0
    np.put_along_axis(by_constant, beacon_columns(times.beacon), by_beacon, axis=1)
    predicted_s = slower * time_s + states.constant[CLOCK] + beacon[:, 3]
    if node.shape[1] > N_NODE:
        row, slow = np.arange(n), N_NODE + times.beacon
        by_node[row, slow] = 1.0
        predicted_s += node[row, slow]
    by_constant = np.concatenate([by_constant, by_further], axis=1)
    return Rows(times.flight_time_s - predicted_s, by_node, by_constant)


def _observe_positions(observations: Observations, states: DiveStates, further: Plane) -> Rows:
    """Rows in units of the sigmas as stated, east and north one after the other."""
    table, offsets = observations.positions, observations.position_offsets
    place = _place(offsets, states.node[table.node], states)
    residual = pairs(table.position - place.position)
    by_node = pairs(place.by_node).swapaxes(1, 2)
    by_constant = np.zeros((len(table), 2, len(states.constant)))
    by_constant[:, :, :N_MOTION] = pairs(place.by_motion).swapaxes(1, 2)
    by_constant = np.concatenate([by_constant, pairs(further).swapaxes(1, 2)], axis=2)
    return Rows(
        (table.whitening @ residual[:, :, None]).reshape(-1),
        (table.whitening @ by_node).reshape(-1, by_node.shape[2]),
        (table.whitening @ by_constant).reshape(-1, by_constant.shape[2]),
    )
