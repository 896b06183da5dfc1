# SPDX-License-Identifier: Apache-2.0
"""Robust batch estimate of the whole dive: an M-estimate."""

from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import Legs
from abyssnav.estimation.model import ErrorModel, Steps, displacement, observe
from abyssnav.estimation.normal_equations import (
    NODE,
    SHARED,
    TINY,
    TINY_M2,
    Problem,
    Solved,
    drifting,
    marginals,
    normal_equations,
    solve,
)
from abyssnav.tables import Bool, Float, Int

_GEMAN_MCCLURE = 9.0
#: How wide the weight's μ begins and ends; it stops early once no position moves by `_STILL_M`.
GRADUATION = (10.0, 3.0, *(1.0,) * 8)
_STILL_M = 0.1


class Batch(NamedTuple):
    """The estimate at every reply."""

    x: Float  #: (n, 11)
    node_cov: Float  #: (n, 5, 5) of position, heading error and held velocity
    shared_cov: Float  #: (6, 6) of scales and deviation
    sigma_s: Float  #: (n,) of each time
    residual: Float  #: (n,) measured minus predicted over it

    @property
    def position_cov_m2(self) -> Float:
        """East and north (n, 2, 2)."""
        return self.node_cov[:, :2, :2]

    @property
    def heading_variance_rad2(self) -> Float:
        """Of the slowly drifting heading error (n,)."""
        return self.node_cov[:, 2, 2]


def estimate(
    x: Float,
    steps: Steps,
    legs: Legs,
    model: ErrorModel,
    sigma_s: Float | float,
    taking_part: Bool,
    graduation: tuple[float, ...] = GRADUATION,
) -> Batch:
    """Most likely states of a dive whose times may be wrong, from a good first guess.

        min Σ ρ((T - h(x_i)) / σ_t) + Σ |p_{k+1} - p_k - d_k|² / Q_k + Σ (ε_{k+1} - a ε_k)² / N_k
            + priors of ε₀, s, k and the deviation

    ρ is Geman-McClure's, of weight (μ c² / (μ c² + r²))² with c² = 9, made sharper step by step
    (μ from 10 to 1) so that a reply wrongly accepted or rejected by a gate is judged again.  Nodes
    are the replies, those of a ping in one; a step costs time in proportion to their number.

    Parameters
    ----------
    x : (n, 11) first guess, for all usable replies
    taking_part : (n,) replies that may count; a second reply of one beacon to a ping may not
    graduation : μ of each iteration; a guess that needs no new judgement takes none
    """
    of = Problem.of(steps, legs, model, sigma_s)
    x = x[of.begins]
    x[:, SHARED] = x[-1, SHARED]  # stretches smoothed apart bring each its own
    late_s, H = of.observe(x)
    for mu in graduation:
        weight = _weight(late_s, sigma_s, mu) * taking_part
        x, moved_m = _moved(x, solve(normal_equations(of, x, late_s, H, weight)))
        late_s, H = of.observe(x)
        if mu == 1.0 and moved_m < _STILL_M:
            break
    weight = _weight(late_s, sigma_s, 1.0) * taking_part
    x, _ = _moved(x, solve(normal_equations(of, x, late_s, H, weight)))
    late_s, H = of.observe(x)
    solved = solve(normal_equations(of, x, late_s, H, _told(late_s, sigma_s) * taking_part))
    states, by_state = of.at_replies(x)
    carried = np.repeat(np.eye(len(NODE))[None], len(states), axis=0)
    carried[:, :2, 2:] = by_state[:, :, NODE[2:]]
    cov = carried @ marginals(solved)[of.node] @ np.swapaxes(carried, 1, 2)
    every_s = np.broadcast_to(sigma_s, len(late_s))
    return Batch(states, cov, solved.shared_cov, every_s, late_s / every_s)


def left_out(
    of_all: Batch, steps: Steps, legs: Legs, model: ErrorModel, taking_part: Bool, group: Int
) -> tuple[Float, Float]:
    """What each group's times miss of an estimate made without the group; the variance expected.

    One Gauss-Newton step from the estimate of all, for each group that is left out.

    Parameters
    ----------
    taking_part : (n,) replies that counted in the estimate of all
    group : (n,) such as the row of the beacon

    Returns
    -------
    late_s, variance_s2 : (n,) s and s², of every reply
    """
    of = Problem.of(steps, legs, model, of_all.sigma_s)
    x = of_all.x[of.begins]
    late_s, H = of.observe(x)
    missed_s, variance_s2 = late_s.copy(), of_all.sigma_s**2
    weight = _told(late_s, of_all.sigma_s) * taking_part
    for each in np.unique(group):
        own = group == each
        solved = solve(normal_equations(of, x, late_s, H, weight * ~own))
        node, by_node = of.node[own], H[own][:, NODE]
        missed_s[own] -= (
            np.sum(by_node * solved.node[node], axis=1) + H[own][:, SHARED] @ solved.shared
        )
        cov = marginals(solved)[node]
        variance_s2[own] += np.sum((by_node[:, None] @ cov)[:, 0] * by_node, axis=1)
    return missed_s, variance_s2


def robust_cost(
    x: Float, steps: Steps, legs: Legs, model: ErrorModel, sigma_s: Float | float, taking_part: Bool
) -> float:
    """What `estimate` makes least, at μ = 1: of several estimates the least is the likeliest."""
    predicted_s, _ = observe(x, steps, legs)
    r2 = (((legs.flight_time_s - predicted_s) / sigma_s) ** 2)[taking_part]
    cost = float(np.sum(_GEMAN_MCCLURE * r2 / (_GEMAN_MCCLURE + r2)))
    dt_s = np.diff(steps.t_s)
    d_m, _ = displacement(x[:-1], np.diff(steps.run_m, axis=0), np.diff(steps.linear_m, axis=0))
    miss_m = x[1:, :2] - x[:-1, :2] - d_m
    cost += float(np.sum(miss_m**2 / (model.position_m2_per_s * dt_s + TINY_M2)[:, None]))
    prior = np.maximum(model.prior_variance(), 1e-20)
    cost += float(np.sum(x[0, SHARED] ** 2 / prior[SHARED]))
    for state, time_s in drifting(model):
        a = np.exp(-dt_s / time_s)
        drift = x[1:, state] - a * x[:-1, state]
        cost += float(x[0, state] ** 2 / prior[state])
        cost += float(np.sum(drift**2 / (prior[state] * (1 - a * a) + TINY)))
    return cost


def _moved(x: Float, by: Solved) -> tuple[Float, float]:
    """States after a step, and the largest move of a position."""
    x = x.copy()
    x[:, NODE] += by.node
    x[:, SHARED] += by.shared
    return x, float(np.abs(by.node[:, :2]).max())


def _weight(late_s: Float, sigma_s: Float | float, mu: float) -> Float:
    r2 = (late_s / sigma_s) ** 2
    return np.asarray((mu * _GEMAN_MCCLURE / (mu * _GEMAN_MCCLURE + r2)) ** 2)


def _told(late_s: Float, sigma_s: Float | float) -> Float:
    """What a time told (n,), for the covariance.

    Over normal residuals the mean of the weight's root is 0.91, the estimate's efficiency, that of
    the weight itself 0.84.
    """
    return np.asarray(np.sqrt(_weight(late_s, sigma_s, 1.0)))
