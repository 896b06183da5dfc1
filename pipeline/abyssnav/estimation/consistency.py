# SPDX-License-Identifier: Apache-2.0
"""Self-consistency of a smoothed dive: the covariance by stated noise, past against future."""

import numpy as np

from abyssnav.estimation.block_tridiagonal import invert_chain, one_sided
from abyssnav.estimation.dive_problem import Problem, drift_terms, motion_variance, row_sigma
from abyssnav.estimation.dive_states import DRIFTS, NoiseModel
from abyssnav.estimation.map_estimator import MapEstimate
from abyssnav.estimation.normal_equations import (
    Factored,
    Linearised,
    eliminate_nodes,
    normal_equations,
)
from abyssnav.estimation.smoother import SmootherResult, weigh
from abyssnav.tables import Float

#: An estimate from one side alone that is less certain says nothing.
_UNKNOWN_M = 20.0


def widest_covariance(result: SmootherResult, inflation: float = 1.0) -> Float:
    """Covariance (n, 2, 2) of the nodes' positions with no noise below the stated one.

    Noise that was learned to be less than stated is an estimate too; a radius to rely on does not
    rest on it.  Nor does it on an arm of the transducer being none because nobody gave it: turns
    tell such an arm, a circle or a straight line does not, and a track that reckoned with it would
    follow the noise.

    Parameters
    ----------
    inflation : factor on the sigmas of what the constants (beacons, clock, sound) do not explain
    """
    setting, estimate = result.setting, result.estimate
    noise = NoiseModel(
        *(np.maximum(one, other) for one, other in zip(estimate.noise, setting.prior, strict=True))
    )
    noise = noise._replace(drift_time_s=estimate.noise.drift_time_s)
    factored = _eliminated(setting.problem, estimate, noise)
    constant = estimate.states.constant
    mixture = weigh(setting, factored, constant, noise, setting.unstated_lever_m)
    apart = constant + mixture.constant_step - result.posterior.states.constant
    spread = factored.spread[:, :2]
    constant_cov = mixture.constant_cov + np.outer(apart, apart)
    cov = spread @ constant_cov @ spread.swapaxes(1, 2)
    return np.asarray(inflation**2 * invert_chain(factored.levels).own[:, :2, :2] + cov)


def _eliminated(problem: Problem, estimate: MapEstimate, noise: NoiseModel) -> Factored:
    """The estimate's equations under other noise, nodes eliminated."""
    terms = estimate.terms._replace(
        information=estimate.weight / row_sigma(problem, noise) ** 2,
        motion=estimate.terms.motion._replace(variance_m2=motion_variance(problem, noise)),
        drift=drift_terms(problem, estimate.states, noise),
    )
    return eliminate_nodes(normal_equations(terms, problem.slots))


def forward_backward(result: SmootherResult) -> tuple[Float, Float]:
    """Distance (n,) m at every node of the estimates from the past and from the future alone.

    Both know the constants; D. C. Fraser and J. E. Potter, "The optimum linear smoother as a
    combination of two optimum linear filters" (1969).  Eliminating the nodes before one leaves the
    information of the past on it; those after it, that of the future.

    Returns
    -------
    apart_m, claimed_m : (n,) the distance, and its root mean square by the covariances
    """
    estimate, terms = result.estimate, result.estimate.terms
    normal = normal_equations(terms, result.setting.problem.slots)
    tie, tie_right = _ties_to_next(terms)
    before, behind = one_sided(estimate.marginals, normal.below, estimate.factored.node)
    past, past_right = before.information - tie, before.right - tie_right
    # A node's own replies belong to its past.
    future = behind.information - normal.diagonal + tie
    future_right = behind.right - normal.right + tie_right
    tiny = 1e-9 * np.eye(past.shape[1])
    cov_past, cov_future = np.linalg.inv(past + tiny), np.linalg.inv(future + tiny)
    apart = cov_past @ past_right[:, :, None] - cov_future @ future_right[:, :, None]
    apart_m = np.hypot(apart[:, 0, 0], apart[:, 1, 0])
    claimed_m2 = np.trace((cov_past + cov_future)[:, :2, :2], axis1=1, axis2=2)
    known = (claimed_m2 > 0) & (claimed_m2 < _UNKNOWN_M**2)
    return np.where(known, apart_m, np.nan), np.sqrt(np.where(known, claimed_m2, np.nan))


def _ties_to_next(terms: Linearised) -> tuple[Float, Float]:
    """What the step to the next node adds to each node's own block (n, s, s) and right (n, s)."""
    motion, drift = terms.motion, terms.drift
    n, s = len(drift.miss), motion.step.by_first.shape[2]
    jacobian = motion.step.by_first.copy()
    jacobian[:, [0, 1], [0, 1]] += 1.0
    weighted = jacobian.swapaxes(1, 2) / motion.variance_m2[:, None, None]
    block, right = np.zeros((n, s, s)), np.zeros((n, s))
    block[:-1] = weighted @ jacobian
    right[:-1] = (weighted @ motion.miss_m[:, :, None])[:, :, 0]
    pull = drift.factor[1:] / drift.variance[1:]
    states = np.arange(DRIFTS.start, s)
    block[:-1, states, states] += drift.factor[1:] * pull
    right[:-1, DRIFTS.start :] += pull * drift.miss[1:]
    return block, right
