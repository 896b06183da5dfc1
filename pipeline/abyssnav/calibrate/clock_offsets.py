# SPDX-License-Identifier: Apache-2.0
"""Time offsets between compass, DVL and acoustics, as further constants of a dive's equations."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dead_reckoning import DeadReckoning
from abyssnav.estimation.dive_problem import Problem
from abyssnav.estimation.dive_states import DEVIATION, HEADING, OFFSET, SCALE, DiveStates
from abyssnav.estimation.observations import Directions, Observations, Offsets
from abyssnav.estimation.preintegration import Cells
from abyssnav.geometry import Plane, interpolate, plane
from abyssnav.tables import Float, Replies, Table

#: The further constants: how late the compass's and the acoustics' stamps are against the DVL's, s.
HEADING_LATENCY, TRAVEL_LATENCY = 0, 1
N_FURTHER = 2
#: The velocity at an instant is that over so long about it.
_ABOUT_S = 0.5


@dataclass(frozen=True, eq=False)
class InstantRates(Table):
    """What a time offset changes at instants."""

    turn_rad_per_s: Float  #: mean since the node
    velocity: Plane  #: as logged, east + i north, m/s; none where the offset does not count


class RateTables(NamedTuple):
    """What time offsets change in a dive."""

    cell_turn_rad_per_s: Float  #: (m,) of each cell of dead reckoning
    ping: InstantRates
    reply: InstantRates
    position: InstantRates


def rate_tables(
    problem: Problem, motion: DeadReckoning, replies: Replies, t_position_s: Float
) -> RateTables:
    """Turn rates and velocities of a dive.

    Parameters
    ----------
    replies : the usable ones
    t_position_s : (p,) of the positions of other means
    """
    cells = problem.cells
    edge_s = problem.t_node_s[0] + np.concatenate([[0.0], np.cumsum(cells.duration_s)])
    heading_rad = interpolate(edge_s, motion.t_s, motion.heading_rad)
    observations = problem.observations

    def at_instants(t_s: Float, node: np.ndarray, offsets: Offsets, counts: bool) -> InstantRates:
        duration_s = offsets.duration_s
        turned_rad = interpolate(t_s, motion.t_s, motion.heading_rad) - problem.heading_rad[node]
        away = np.abs(duration_s) > 1e-3
        rate = np.where(away, turned_rad / np.where(away, duration_s, 1.0), 0.0)
        return InstantRates(rate, _velocity(motion, t_s) * counts)

    node = observations.times.node
    return RateTables(
        np.diff(heading_rad) / cells.duration_s,
        at_instants(replies.t_ping_s, node, observations.ping, True),
        at_instants(replies.t_reply_s, node, observations.reply, True),
        at_instants(
            t_position_s, observations.positions.node, observations.position_offsets, False
        ),
    )


def _velocity(motion: DeadReckoning, t_s: Float) -> Plane:
    ends = [
        plane(interpolate(t_s + half_s, motion.t_s, motion.displacement_m))
        for half_s in (-_ABOUT_S, _ABOUT_S)
    ]
    return np.asarray((ends[1] - ends[0]) / (2 * _ABOUT_S))


def shifted_cells(cells: Cells, rates: RateTables, further: Float) -> Cells:
    """Dead reckoning as it would be with the compass's stamps moved.

        ψ(t) = ψ_read(t + δ) ≈ ψ_read(t) + δ ψ'

    so the reading is too much by -δ ψ', which turns each cell's displacement.
    """
    turn = np.exp(-1j * further[HEADING_LATENCY] * rates.cell_turn_rad_per_s)
    return replace(cells, displacement=cells.displacement * turn, ahead=cells.ahead * turn)


def shifted_observations(
    observations: Observations, rates: RateTables, further: Float
) -> Observations:
    """Where the vehicle was at pings and replies with the stamps moved: δ v back along its way."""
    return observations._replace(
        ping=_shifted(observations.ping, rates.ping, further),
        reply=_shifted(observations.reply, rates.reply, further),
        position_offsets=_shifted(observations.position_offsets, rates.position, further),
    )


def _shifted(offsets: Offsets, rates: InstantRates, further: Float) -> Offsets:
    turn = np.exp(-1j * further[HEADING_LATENCY] * rates.turn_rad_per_s)
    moved = offsets.displacement * turn - further[TRAVEL_LATENCY] * rates.velocity
    return replace(offsets, displacement=moved)


def directions(
    observations: Observations, rates: RateTables, states: DiveStates, further: Float
) -> Directions:
    """Where the offsets move the vehicle at every instant, by the states.

    Parameters
    ----------
    observations : not shifted
    """

    def at_instants(offsets: Offsets, instant: InstantRates, node: np.ndarray) -> Plane:
        constant = states.constant
        error_rad = states.node[node, HEADING] + constant[OFFSET]
        error_rad = error_rad + offsets.shapes @ constant[DEVIATION]
        turn = np.exp(1j * error_rad) / (1 + constant[SCALE])
        late = np.exp(-1j * further[HEADING_LATENCY] * instant.turn_rad_per_s)
        by_heading = -1j * instant.turn_rad_per_s * offsets.displacement * late
        return np.column_stack([turn * by_heading, -turn * instant.velocity])

    node, at_position = observations.times.node, observations.positions.node
    return Directions(
        at_instants(observations.ping, rates.ping, node),
        at_instants(observations.reply, rates.reply, node),
        at_instants(observations.position_offsets, rates.position, at_position),
    )
