# SPDX-License-Identifier: Apache-2.0
"""States, covariances and innovations of the filter bank after every event, and its track."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_states import (
    DEVIATION,
    HEADING,
    N_NODE,
    OFFSET,
    SCALE,
    SOUND,
    SOUND_SCALE,
    deviation_shapes,
)
from abyssnav.estimation.filter_bank import N_MOVING, displace
from abyssnav.estimation.filter_events import MotionSums, SumsMaker
from abyssnav.estimation.hypotheses import BankPriors
from abyssnav.estimation.kalman import Transition, correct, predict, running_sums
from abyssnav.estimation.two_state import BEFORE_START
from abyssnav.geometry import pairs
from abyssnav.tables import Bool, Float, Int, Table

#: States of which the mixture's covariance is kept: those that move the position, sound scale.
N_KEPT = N_MOVING + 1
#: Instants that are propagated at once: that bounds the memory.
_BLOCK = 1 << 12
#: Filters of less weight do not count in the mixture's covariance, except for where they are.
_COUNTED = 5e-4


@dataclass(frozen=True, eq=False)
class Nodes(Table):
    """Mixture of the bank's filters after every event from the start on."""

    t_s: Float
    x: Float  #: (n, N) mean
    P: Float  #: (n, 15, 15) covariance, the spread of the means included
    weight: Float  #: (n, h) of each filter
    segment: Int  #: one more after each recovery
    evidence: Float  #: natural logarithm of the event's likelihood before it was taken in


@dataclass(frozen=True, eq=False)
class TimeInnovations(Table):
    """Every travel time as the likeliest filter met it; NaN before the start."""

    predicted_s: Float  #: flight time
    variance_s2: Float
    innovation_s: Float
    noise_s2: Float  #: R, of what the variance holds
    decision: Int


@dataclass(frozen=True, eq=False)
class PositionUpdates(Table):
    """Every position fix as the likeliest filter met it; NaN before the start."""

    innovation_m: Float  #: (k, 2) east, north
    innovation_cov_m2: Float  #: (k, 2, 2)
    noise_m2: Float  #: (k, 2, 2) R, of what that holds
    decision: Int


class FilterHistory(NamedTuple):
    """The filter's memory of a dive."""

    nodes: Nodes
    times: TimeInnovations
    positions: PositionUpdates


class Filters(NamedTuple):
    """The filters after each of k events, of which the first n are judged."""

    x: Float  #: (h, k, N)
    weight: Float  #: (k, h) probability of each filter


class Annotations(NamedTuple):
    """Of n events: when they were, recoveries so far, log likelihood of each."""

    t_s: Float
    segment: Int
    evidence: Float


class FilterHistoryBuilder:
    """A history while it is written; the filters are mixed as they come."""

    def __init__(self, n_replies: int, n_positions: int) -> None:
        self._n, self._most = 0, 1 + n_replies + n_positions  # the first is the beginning
        self._nodes: list[np.ndarray] = []  # columns of `Nodes`, of which n rows are written
        #: Predicted flight time, S, innovation, R: the columns of `TimeInnovations`.
        self.times = np.full((n_replies, 4), np.nan)
        self.time_decision = np.full(n_replies, BEFORE_START)
        self.position_m = np.full((n_positions, 2), np.nan)
        self.position_cov_m2 = np.full((n_positions, 2, 2), np.nan)
        self.position_noise_m2 = np.full((n_positions, 2, 2), np.nan)
        self.position_decision = np.full(n_positions, BEFORE_START)

    def add(self, filters: Filters, within: Float, events: Annotations) -> None:
        """Take in the mixture of the filters after each of the n events.

        Parameters
        ----------
        within : (k, 15, 15) weighted mean of the filters' covariances
        """
        weight, first = filters.weight, self._n
        x, rows = filters.x.swapaxes(0, 1), slice(first, first + len(events.t_s))
        mean = (weight[:, None] @ x)[:, 0]
        apart = x[:, :, :N_KEPT] - mean[:, None, :N_KEPT]
        cov = within + (apart * weight[:, :, None]).swapaxes(1, 2) @ apart
        mixed = (events.t_s, mean, cov, weight, events.segment, events.evidence)
        if not first:
            self._nodes = [np.empty((self._most, *c.shape[1:]), dtype=c.dtype) for c in mixed]
        for column, values in zip(self._nodes, mixed, strict=True):
            column[rows] = values[: len(events.t_s)]
        self._n = rows.stop

    def history(self) -> FilterHistory:
        """What was written."""
        return FilterHistory(
            Nodes(*(column[: self._n] for column in self._nodes)),
            TimeInnovations(
                self.times[:, 0], self.times[:, 1], self.times[:, 2], self.times[:, 3],
                self.time_decision,
            ),
            PositionUpdates(
                self.position_m, self.position_cov_m2, self.position_noise_m2,
                self.position_decision,
            ),
        )  # fmt: skip


class Block(NamedTuple):
    """What a block of k measurements did to the filters, with errors in terms of its beginning."""

    P: Float  #: (h, N, N) at the beginning
    noise: Float  #: (h, k, 8, 8)
    joint: Float  #: (h, k, k + N + 1), as `condition` left it
    share: Float  #: (h, k)
    transition: Transition
    weight: Float  #: (h,) at the beginning


def mixed_covariance(block: Block, weight: Float) -> Float:
    """Mean (k, 15, 15) of the filters' covariances after each event, weighted (k, h).

        Σ_h w_h F (P + N_j - Σ_{l<=j} S_l K_l K_lᵀ) Fᵀ

    over the filters that have a weight worth counting at the beginning.
    """
    counted = np.flatnonzero(block.weight > _COUNTED)
    f, k = len(counted), block.share.shape[1]
    gain = block.joint[counted, :, k : k + N_KEPT]
    gain *= np.sqrt(block.share[counted])[:, :, None]
    cov = running_sums(gain[:, :, :, None] * -gain[:, :, None, :])
    cov += block.P[counted, None, :N_KEPT, :N_KEPT]
    cov[:, :, :N_NODE, :N_NODE] += block.noise[counted]
    step = Transition(*(rows[counted].reshape(f * k, *rows.shape[2:]) for rows in block.transition))
    predict(cov.reshape(f * k, N_KEPT, N_KEPT), step)
    share = weight[:, counted] / weight[:, counted].sum(axis=1, keepdims=True)
    mean = share[:, None] @ cov.reshape(f, k, -1).swapaxes(0, 1)
    return np.asarray(mean.reshape(k, N_KEPT, N_KEPT))


def state_after(block: Block, x: Float, one: int, j: int) -> tuple[Float, Float]:
    """State (N,) and covariance (15, 15) of one filter after measurement j of a block.

    Parameters
    ----------
    x : (h, k, N) as predicted from those before the block
    """
    k = block.share.shape[1]
    share, joint = block.share[one, : j + 1], block.joint[one, : j + 1, k:]
    step = Transition(*(rows[one : one + 1, j] for rows in block.transition))
    state = x[one : one + 1, j].copy()
    correct(state, step, ((share * joint[:, -1]) @ joint[:, :-1])[None])
    gain = joint[:, :N_KEPT]
    cov = block.P[one : one + 1, :N_KEPT, :N_KEPT] - (gain.T * share) @ gain
    cov[:, :N_NODE, :N_NODE] += block.noise[one, j]
    predict(cov, step)
    return state[0], cov[0]


def weights(score: Float) -> Float:
    """Probabilities (..., h) of the filters from their logarithms, but for a constant."""
    weight = np.exp(score - score.max(axis=-1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


class LiveStates(NamedTuple):
    """What is known at given instants by all events before them."""

    position_m: Float  #: (m, 2)
    position_cov_m2: Float  #: (m, 2, 2)
    heading_error_rad: Float  #: (m,) that the compass reads too much
    dvl_scale: Float  #: (m,) true speed over the DVL's is the inverse of one more than this


def propagate(
    nodes: Nodes, sums: SumsMaker, priors: BankPriors, instants: tuple[Float, Float]
) -> LiveStates:
    """Positions and covariances at any instants by dead reckoning from the event before each.

    Parameters
    ----------
    instants : (m,) s, none before the first node, and the compass' heading (m,) rad there
    """
    t_s, heading_rad = instants
    at_nodes = _AtNodes(
        sums.interpolate(nodes.t_s), sums.is_held(nodes.t_s), sums.held_sigma(nodes.t_s, priors)
    )
    parts = [
        _propagate(nodes, at_nodes, sums.interpolate(block_s), priors)
        for block_s in np.split(t_s, range(_BLOCK, len(t_s), _BLOCK))
    ]
    position_m, cov_m2, last = (np.concatenate(column) for column in zip(*parts, strict=True))
    constant = nodes.x[:, N_NODE:]
    error_rad = (nodes.x[:, HEADING] + constant[:, OFFSET])[last]
    error_rad += np.sum(deviation_shapes(heading_rad) * constant[last, DEVIATION], axis=1)
    return LiveStates(position_m, cov_m2, error_rad, constant[last, SCALE])


class _AtNodes(NamedTuple):
    """Dead reckoning at the nodes, and what it is worth where lock is lost."""

    sums: MotionSums
    is_held: Bool  #: (n,)
    held_mps: Float  #: (n, h) sigma of a velocity that is held from there on


def _propagate(
    nodes: Nodes, at_nodes: _AtNodes, now: MotionSums, priors: BankPriors
) -> tuple[Float, Float, Int]:
    """Of instants (m,), by the sums at the nodes and there; rows of the nodes before.

    What is held already has its error among the states, which drifts and ends with the loss of
    lock; what is held anew errs by σ t.
    """
    last = np.searchsorted(nodes.t_s, now.t_s, side="right") - 1
    x, stretch = nodes.x[last], now.since(at_nodes.sums[last])
    is_held, held_s = at_nodes.is_held[last], stretch.held_s
    dt_s, weight = stretch.duration_s, nodes.weight[last]
    slow = np.where(is_held, held_s / np.maximum(dt_s, 1e-9), 1.0)
    d, by = displace(x, stretch, (1.0, slow, dt_s))
    by[:, 0], by[:, 1] = 1.0, 1j
    J = pairs(by).swapaxes(1, 2)
    cov_m2 = J @ nodes.P[last, :N_MOVING, :N_MOVING] @ J.swapaxes(1, 2)
    speed_mps = np.abs(stretch.displacement) / np.maximum(dt_s, 1e-9)
    sigma, time_s = priors.drift_sigma[:, :3], priors.drift_time_s[:, :3]
    variance, diffusion = weight @ sigma**2, weight @ (2 * sigma**2 / time_s)
    scale = np.column_stack([speed_mps, np.ones(len(dt_s)), np.ones(len(dt_s))]) ** 2
    walk = np.minimum(diffusion * dt_s[:, None] / 3, variance)  # of the mean over the stretch
    grown_m2 = np.sum(scale * walk, axis=1) * dt_s**2
    grown_m2 += (weight @ priors.position_m2_per_s) * dt_s
    drifted = np.minimum(2 * held_s[:, None] / (3 * priors.held_time_s), 1.0)
    share = np.where(is_held[:, None], drifted, 1.0)
    grown_m2 += (weight * share * at_nodes.held_mps[last] ** 2).sum(axis=1) * held_s**2
    cov_m2[:, [0, 1], [0, 1]] += grown_m2[:, None]
    position = x[:, 0] + 1j * x[:, 1] + d
    return pairs(position), cov_m2, last


def sound_scale(x: Float) -> Float:
    """Slow and constant part of k = c_used / c_true - 1 (...).

    Parameters
    ----------
    x : (..., states) of the filter
    """
    return np.asarray(x[..., SOUND] + x[..., N_NODE + SOUND_SCALE])
