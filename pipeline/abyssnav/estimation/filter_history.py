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
    SOUND,
    SOUND_SCALE,
    deviation_shapes,
)
from abyssnav.estimation.filter_bank import N_MOVING, displace
from abyssnav.estimation.filter_events import MotionSums, SumsMaker
from abyssnav.estimation.hypotheses import BankPriors
from abyssnav.estimation.two_state import BEFORE_START
from abyssnav.geometry import pairs
from abyssnav.tables import Float, Int, Table

#: States of which the mixture's covariance is kept: those that move the position, sound scale.
N_KEPT = N_MOVING + 1
_BLOCK = 1 << 12
_MIXED = 256  #: events of which the filters are mixed at once


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


class FilterHistoryBuilder:
    """A history while it is written; the filters are mixed some hundred events at a time."""

    def __init__(self, shape: tuple[int, int], replies: int, positions: int) -> None:
        h, n = shape
        self._t_s, self._segment, self._evidence = list[float](), [0], [0.0]
        self._x = np.empty((_MIXED, h, n))
        self._P = np.empty((_MIXED, h, N_KEPT, N_KEPT))
        self._score = np.empty((_MIXED, h))
        self._mixed: list[tuple[Float, Float, Float]] = []
        self.times = np.full((replies, 4), np.nan)
        self.time_decision = np.full(replies, BEFORE_START)
        self.position_m = np.full((positions, 2), np.nan)
        self.position_cov_m2 = np.full((positions, 2, 2), np.nan)
        self.position_noise_m2 = np.full((positions, 2, 2), np.nan)
        self.position_decision = np.full(positions, BEFORE_START)

    def add(self, t_s: float, x: Float, P: Float, score: Float) -> None:
        """Take in the filters after an event, with the log probability of each."""
        place = len(self._t_s) % _MIXED
        if place == 0 and self._t_s:
            self._mix(_MIXED)
        self._t_s.append(t_s)
        self._x[place], self._P[place], self._score[place] = x, P[:, :N_KEPT, :N_KEPT], score

    def annotate(self, segment: int, evidence: float) -> None:
        """Of the event that was added: recoveries so far, and its log likelihood."""
        self._segment.append(segment)
        self._evidence.append(evidence)

    def _mix(self, n: int) -> None:
        weight, x = weights(self._score[:n]), self._x[:n]
        mean = np.einsum("mh,mhi->mi", weight, x)
        apart = x[:, :, :N_KEPT] - mean[:, None, :N_KEPT]
        cov = np.einsum("mh,mhij->mij", weight, self._P[:n])
        cov += (apart * weight[:, :, None]).swapaxes(1, 2) @ apart
        self._mixed.append((mean, cov, weight))

    def history(self) -> FilterHistory:
        """What was written."""
        self._mix((len(self._t_s) - 1) % _MIXED + 1)
        mean, cov, weight = (np.concatenate(column) for column in zip(*self._mixed, strict=True))
        return FilterHistory(
            Nodes(
                np.array(self._t_s), mean, cov, weight, np.array(self._segment),
                np.array(self._evidence),
            ),
            TimeInnovations(
                self.times[:, 0], self.times[:, 1], self.times[:, 2], self.times[:, 3],
                self.time_decision,
            ),
            PositionUpdates(
                self.position_m, self.position_cov_m2, self.position_noise_m2,
                self.position_decision,
            ),
        )  # fmt: skip


def weights(score: Float) -> Float:
    """Probabilities (..., h) of the filters from their logarithms, but for a constant."""
    weight = np.exp(score - score.max(axis=-1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


class LiveStates(NamedTuple):
    """What is known at given instants by all events before them."""

    position_m: Float  #: (m, 2)
    position_cov_m2: Float  #: (m, 2, 2)
    heading_error_rad: Float  #: (m,) that the compass reads too much
    x: Float  #: (m, N) states at the event before


def propagate(
    nodes: Nodes, sums: SumsMaker, priors: BankPriors, instants: tuple[Float, Float]
) -> LiveStates:
    """Positions and covariances at any instants by dead reckoning from the event before each.

    Parameters
    ----------
    instants : (m,) s, none before the first node, and the compass' heading (m,) rad there
    """
    t_s, heading_rad = instants
    at_nodes = sums.interpolate(nodes.t_s)
    parts = [
        _propagate(
            nodes, (at_nodes, sums.interpolate(block_s)), sums.held_sigma(block_s, priors), priors
        )
        for block_s in np.split(t_s, range(_BLOCK, len(t_s), _BLOCK))
    ]
    position_m, cov_m2, last = (np.concatenate(column) for column in zip(*parts, strict=True))
    x = nodes.x[last]
    constant = x[:, N_NODE:]
    error_rad = x[:, HEADING] + constant[:, OFFSET]
    error_rad += np.sum(deviation_shapes(heading_rad) * constant[:, DEVIATION], axis=1)
    return LiveStates(position_m, cov_m2, error_rad, x)


def _propagate(
    nodes: Nodes, sums: tuple[MotionSums, MotionSums], held_mps: Float, priors: BankPriors
) -> tuple[Float, Float, Int]:
    """Of instants (m,), by the sums at the nodes and there; rows of the nodes before."""
    at_nodes, now = sums
    last = np.searchsorted(nodes.t_s, now.t_s, side="right") - 1
    x, stretch = nodes.x[last], now.since(at_nodes[last])
    d, by = displace(x, stretch, (1.0, 1.0, stretch.duration_s))
    by[:, 0], by[:, 1] = 1.0, 1j
    J = pairs(by).swapaxes(1, 2)
    cov_m2 = J @ nodes.P[last, :N_MOVING, :N_MOVING] @ J.swapaxes(1, 2)
    dt_s, weight = stretch.duration_s, nodes.weight[last]
    speed_mps = np.abs(stretch.displacement) / np.maximum(dt_s, 1e-9)
    sigma, time_s = priors.drift_sigma[:, :3], priors.drift_time_s[:, :3]
    variance, diffusion = weight @ sigma**2, weight @ (2 * sigma**2 / time_s)
    scale = np.column_stack([speed_mps, np.ones(len(dt_s)), np.ones(len(dt_s))]) ** 2
    walk = np.minimum(diffusion * dt_s[:, None] / 3, variance)  # of the mean over the stretch
    grown_m2 = np.sum(scale * walk, axis=1) * dt_s**2
    grown_m2 += (weight @ priors.position_m2_per_s) * dt_s
    grown_m2 += (held_mps * stretch.held_s) ** 2
    cov_m2[:, [0, 1], [0, 1]] += grown_m2[:, None]
    position = x[:, 0] + 1j * x[:, 1] + d
    return pairs(position), cov_m2, last


def sound_scale(x: Float) -> Float:
    """Slow and constant part of k (...)."""
    return np.asarray(x[..., SOUND] + x[..., N_NODE + SOUND_SCALE])
