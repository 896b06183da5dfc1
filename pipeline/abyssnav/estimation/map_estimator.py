# SPDX-License-Identifier: Apache-2.0
"""Robust batch estimate of a whole dive: the most likely states, noise learned with them."""

from typing import NamedTuple

import numpy as np

from abyssnav.estimation.block_tridiagonal import Inverse, log_determinant
from abyssnav.estimation.dive_problem import (
    Problem,
    best_reply_per_beacon,
    drift_terms,
    motion_terms,
    row_sigma,
)
from abyssnav.estimation.dive_states import DiveStates, NoiseModel
from abyssnav.estimation.normal_equations import Factored, Linearised, solve
from abyssnav.estimation.observations import Rows, observe
from abyssnav.estimation.preintegration import Preintegrated, preintegrate
from abyssnav.estimation.variance_components import learn_noise
from abyssnav.tables import Bool, Float, Int

#: c² of the Geman-McClure weight: three sigma.
_GEMAN_MCCLURE = 9.0
#: Squared residual that has half weight in the final estimate: χ² bound of 99 % for the two degrees
#: of freedom of a position, three sigma of a time.
GATE = 9.21
#: μ of the weight in the first steps, from wide to sharp.
GRADUATION = (30.0, 10.0, 5.0, 3.0, 2.0, 1.0)
_MOST_STEPS = 40
#: Done once no position moves by more (m) and no learned sigma by more than this share.
_STILL_M, _STILL_NOISE = 0.02, 0.03


class Setting(NamedTuple):
    """The problem with its prior noise model, which every estimate starts from."""

    problem: Problem
    ping: Int  #: running number of the ping of every time
    prior: NoiseModel
    stated: Bool  #: (b,) beacons whose sigma is stated
    unstated_lever_m: float = 0.0  #: sigma of an arm that nobody gave, for the radius


class Schedule(NamedTuple):
    """How the estimate goes about its Gauss-Newton steps."""

    learn: bool = True  #: noise and priors, after every step
    graduation: tuple[float, ...] = GRADUATION  #: μ of the first steps
    most_steps: int = _MOST_STEPS


_TO_THE_END = Schedule()
#: From near the summit, with the stated noise: what an estimate with learned noise is held against.
STATED_NOISE = Schedule(learn=False, graduation=())


class MapEstimate(NamedTuple):
    """Most likely states and what is known of their errors."""

    states: DiveStates
    noise: NoiseModel
    residual: Float  #: (r,) over its sigma
    weight: Float  #: (r,) of each observation, 0 to 1
    taking_part: Bool  #: (r,) not one of several replies of a beacon to a ping
    terms: Linearised  #: at the states
    factored: Factored
    marginals: Inverse  #: of the nodes' equations: covariance for known constants
    constant_cov: Float  #: (m, m)
    log_likelihood: float  #: marginal: of the data given the noise
    steps: int

    def node_cov(self) -> Float:
        """Covariance (n, s, s) of each node, constants unknown."""
        spread = self.factored.spread
        return self.marginals.own + spread @ self.constant_cov @ spread.swapaxes(1, 2)


class Predicted(NamedTuple):
    """What the states of an iterate make of the observations and of dead reckoning."""

    states: DiveStates
    rows: Rows
    step: Preintegrated
    part: Bool  #: (r,) as `taking_part` has it


def estimate_map(
    setting: Setting,
    start: DiveStates,
    noise: NoiseModel | None = None,
    schedule: Schedule = _TO_THE_END,
) -> MapEstimate:
    """Most likely states of a dive whose times may be wrong, by Gauss-Newton steps.

        min Σ ρ(r / σ) + Σ |p_{i+1} - p_i - d_i|² / Q_i + Σ (x_{i+1} - a x_i)² / N_i + priors

    ρ is Geman-McClure's (1987), of weight (μ c² / (μ c² + r²))² with c² = 9, made sharper step by
    step (graduated non-convexity: H. Yang et al., IEEE RA-L 5, 2020), so that a reply wrongly
    accepted or rejected by a gate is judged again; in the end the weight is the probability that a
    reply is no outlier, 1 / (1 + exp((r² - 9.21) / 2)), which does not inflate the covariance.
    After every step noise and priors are learned, where asked.
    """
    noise = setting.prior if noise is None else noise
    predicted = _linearise(setting, start)
    n_steps, graduation = 0, schedule.graduation
    while n_steps < schedule.most_steps:
        mu = graduation[n_steps] if n_steps < len(graduation) else None
        terms, _, _ = weighted_terms(setting, predicted, noise, mu)
        solved = solve(terms, setting.problem.slots)
        moved_m = float(np.abs(solved.node_step[:, :2]).max())
        before = noise
        if schedule.learn:
            noise = learn_noise(setting.problem, solved, setting.prior, noise, setting.stated)
        states = predicted.states.moved(solved.node_step, solved.constant_step)
        predicted = _linearise(setting, states)
        n_steps += 1
        if mu is None and moved_m < _STILL_M and noise_change(before, noise) < _STILL_NOISE:
            break
    return _finish(setting, predicted, noise, n_steps)


def noise_change(before: NoiseModel, after: NoiseModel) -> float:
    """Largest relative change of any sigma."""
    return max(
        float(np.abs(np.log(two / one)).max()) for one, two in zip(before, after, strict=True)
    )


def robust_weight(square: Float, mu: float | None) -> Float:
    """Weight (...) of squared residuals; the final one without μ.

    Parameters
    ----------
    square : (...) over their variance
    """
    if mu is None:
        return 1 / (1 + np.exp(np.minimum(0.5 * (square - GATE), 500.0)))
    return np.asarray((mu * _GEMAN_MCCLURE / (mu * _GEMAN_MCCLURE + square)) ** 2)


def squares(problem: Problem, residual: Float) -> Float:
    """Squared residuals (n,) over variance: of a position both axes together.

    Parameters
    ----------
    residual : (n,) over their standard deviation
    """
    square = np.minimum(residual**2, 1e12)
    pair = square[problem.n_times :].reshape(-1, 2).sum(axis=1)
    square[problem.n_times :] = np.repeat(pair, 2)
    return square


def taking_part(setting: Setting, residual: Float) -> Bool:
    """Observations (r,) but for those replies of a beacon to a ping that another fits better.

    Parameters
    ----------
    residual : (r,) s of times, then m of positions
    """
    n = setting.problem.n_times
    part = np.ones(len(residual), dtype=bool)
    beacon = setting.problem.observations.times.beacon
    part[:n] = best_reply_per_beacon(residual[:n], setting.ping, beacon)
    return part


def _linearise(setting: Setting, states: DiveStates) -> Predicted:
    problem = setting.problem
    rows = observe(problem.observations, states)
    part = taking_part(setting, rows.residual)
    return Predicted(states, rows, preintegrate(problem.cells, states), part)


def weighted_terms(
    setting: Setting, predicted: Predicted, noise: NoiseModel, mu: float | None
) -> tuple[Linearised, Float, Float]:
    """All terms of the sum; the weights (r,); the residuals (r,) over sigma.

    Parameters
    ----------
    mu : of the robust weight; None for the final one
    """
    problem = setting.problem
    sigma = row_sigma(problem, noise)
    residual = predicted.rows.residual / sigma
    weight = robust_weight(squares(problem, residual), mu) * predicted.part
    terms = Linearised(
        predicted.rows,
        weight / sigma**2,
        motion_terms(problem, predicted.states, predicted.step, noise),
        drift_terms(problem, predicted.states, noise),
        predicted.states.constant,
        noise.constant_sigma**2,
    )
    return terms, weight, residual


def _finish(setting: Setting, predicted: Predicted, noise: NoiseModel, n_steps: int) -> MapEstimate:
    terms, weight, residual = weighted_terms(setting, predicted, noise, None)
    solved = solve(terms, setting.problem.slots)
    estimate = MapEstimate(
        states=predicted.states,
        noise=noise,
        residual=residual,
        weight=weight,
        taking_part=predicted.part,
        terms=terms,
        factored=solved.factored,
        marginals=solved.marginals,
        constant_cov=solved.constant_cov,
        log_likelihood=np.nan,
        steps=n_steps,
    )
    return estimate._replace(log_likelihood=_log_likelihood(setting, estimate))


def _log_likelihood(setting: Setting, estimate: MapEstimate) -> float:
    """Log marginal likelihood by Laplace's approximation, up to what no noise model changes.

        L = Σ ln(σ₀/σ e^{-r²/2} + e^{-9.21/2}) + ln priors - ½ ln |H|

    with r over σ, σ₀ the prior's sigma (an outlier's density is the same under every noise model),
    H the weighted normal matrix.  Each of the two rows of a position has half of the pair's r² and
    half of the bound 9.21.
    """
    problem, prior, terms = setting.problem, setting.prior, estimate.terms
    square = squares(problem, estimate.residual)
    square[problem.n_times :] *= 0.5  # both rows of a position carry the pair's square
    louder = np.log(row_sigma(problem, estimate.noise) / row_sigma(problem, prior))
    floor = np.where(np.arange(len(square)) < problem.n_times, 0.5, 0.25) * GATE
    data = np.logaddexp(-0.5 * square - louder, -floor)[estimate.taking_part].sum()
    motion, drift = terms.motion, terms.drift
    ties = (
        np.sum(motion.miss_m**2 / motion.variance_m2[:, None])
        + 2 * np.log(motion.variance_m2).sum()
    )
    ties += np.sum(drift.miss**2 / drift.variance + np.log(drift.variance))
    ties += np.sum(terms.constant**2 / terms.constant_variance + np.log(terms.constant_variance))
    curvature = log_determinant(estimate.factored.levels)
    curvature -= float(np.linalg.slogdet(estimate.constant_cov)[1])
    return float(data - 0.5 * ties - 0.5 * curvature)
