# SPDX-License-Identifier: Apache-2.0
"""Dead reckoning between nodes, integrated anew with the present errors, and its Jacobians."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dead_reckoning import DeadReckoning
from abyssnav.estimation.dive_states import (
    CURRENT_EAST,
    CURRENT_NORTH,
    DEVIATION,
    FORWARD,
    HEADING,
    OFFSET,
    SCALE,
    STARBOARD,
    DiveStates,
    deviation_shapes,
)
from abyssnav.geometry import Plane, blend, bracket, pairs, plane
from abyssnav.tables import Float, Int, Table

#: Cells of this length stand for the samples in them: the errors change over minutes.
_CELL_S = 2.0


@dataclass(frozen=True, eq=False)
class Cells(Table):
    """Short stretches of dead reckoning, each within one interval between nodes."""

    interval: Int  #: node before
    share: Float  #: where the middle lies between the nodes, 0 to 1
    duration_s: Float
    displacement: Plane  #: as logged, east + i north, m
    ahead: Plane  #: ∫ (sin ψ + i cos ψ) dt, s
    shapes: Float  #: (m, 4) harmonics of the heading in its middle


class Preintegrated(NamedTuple):
    """True displacement between n neighbouring nodes and its derivatives."""

    displacement: Plane  #: (n - 1,) m
    by_first: Float  #: (n - 1, 2, s) by the s states of the node before
    by_second: Float  #: (n - 1, 2, s) by those of the node after
    #: (n - 1, 2, 6 + x) by heading offset, deviation, scale, and by further turning constants
    by_constant: Float


def make_cells(motion: DeadReckoning, t_node_s: Float) -> Cells:
    """Cut what lies between the nodes (n,) s into cells of some two seconds."""
    n_cells = np.maximum(np.ceil(np.diff(t_node_s) / _CELL_S).astype(int), 1)
    interval = np.repeat(np.arange(len(n_cells)), n_cells)
    within = np.arange(len(interval)) - np.repeat(np.cumsum(n_cells) - n_cells, n_cells)
    length_s = (np.diff(t_node_s) / n_cells)[interval]
    edge_s = np.append(t_node_s[interval] + within * length_s, t_node_s[-1])
    edge = bracket(edge_s, motion.t_s)
    heading_rad = blend(motion.heading_rad, *edge)
    return Cells(
        interval=interval,
        share=(within + 0.5) / n_cells[interval],
        duration_s=np.diff(edge_s),
        displacement=np.diff(blend(plane(motion.displacement_m), *edge)),
        ahead=np.diff(blend(motion.ahead_s, *edge)),
        shapes=deviation_shapes(0.5 * (heading_rad[1:] + heading_rad[:-1])),
    )


def preintegrate(cells: Cells, states: DiveStates, further: Float | None = None) -> Preintegrated:
    """True displacement between nodes by the log and the present errors.

        d = Σ_cells e^{iδ} (ΔC - (w_f - i w_s) A) / (1 + s) + c Δt
        δ = offset + deviation(ψ) + ε

    with ΔC the logged displacement, A the integral of the direction ahead, w the slow error of the
    DVL, c the slow velocity in the earth frame; ε, w and c are linear between nodes.  After C.
    Forster et al., "On-Manifold Preintegration", IEEE Trans. Robotics 33 (2017), but integrated
    anew at every step, which costs little and is right for errors of any size.

    Parameters
    ----------
    further : (m, x) shapes of further turning constants, whose part is already in the cells
    """
    shapes = cells.shapes if further is None else np.column_stack([cells.shapes, further])
    first, second = states.node[cells.interval], states.node[cells.interval + 1]
    drift = first + cells.share[:, None] * (second - first)
    scale = 1 + states.constant[SCALE]
    error_rad = drift[:, HEADING] + states.constant[OFFSET]
    error_rad = error_rad + cells.shapes @ states.constant[DEVIATION]
    turn = np.exp(1j * error_rad) / scale
    ahead = turn * cells.ahead
    moved = turn * cells.displacement - (drift[:, FORWARD] - 1j * drift[:, STARBOARD]) * ahead
    current = drift[:, CURRENT_EAST] + 1j * drift[:, CURRENT_NORTH]
    begins = np.flatnonzero(np.diff(cells.interval, prepend=-1))
    rows = [
        moved + current * cells.duration_s,
        moved,
        cells.share * moved,
        ahead,
        cells.share * ahead,
        cells.duration_s,
        cells.share * cells.duration_s,
        *(moved * shapes.T),
    ]
    # "late" sums weight each cell by its share: the part that the second node's states act on.
    sums = np.add.reduceat(np.stack(rows), begins, axis=1)
    total, whole, late, ahead_whole, ahead_late, time_whole, time_late = sums[:7]
    turned, n_states = 1j * sums[7:], states.node.shape[1]
    by_constant = np.concatenate([[1j * whole], turned[:4], [-whole / scale], turned[4:]])
    return Preintegrated(
        total,
        _by_node(n_states, whole - late, ahead_whole - ahead_late, time_whole - time_late),
        _by_node(n_states, late, ahead_late, time_late),
        pairs(by_constant.T).swapaxes(1, 2),
    )


def _by_node(n_states: int, moved: Plane, ahead: Plane, time_s: Plane) -> Float:
    """Derivatives (n, 2, s) of displacements by the fading states of a node."""
    by = np.zeros((len(moved), n_states), dtype=complex)
    by[:, HEADING] = 1j * moved
    by[:, FORWARD], by[:, STARBOARD] = -ahead, 1j * ahead
    by[:, CURRENT_EAST], by[:, CURRENT_NORTH] = time_s, 1j * time_s
    return pairs(by).swapaxes(1, 2)
