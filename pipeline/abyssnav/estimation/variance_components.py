# SPDX-License-Identifier: Apache-2.0
"""Noise and priors learned with the states: variance components."""

from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_problem import Problem
from abyssnav.estimation.dive_states import (
    CLOCK,
    DRIFT_NAMES,
    DRIFTS,
    FORWARD,
    GRADIENT,
    LEVER,
    N_BEACON,
    N_COMMON,
    OFFSET,
    SCALE,
    SOUND_SCALE,
    STARBOARD,
    NoiseModel,
    drift_groups,
)
from abyssnav.estimation.normal_equations import Slots, Solved, motion_columns
from abyssnav.tables import Bool, Float, Int

#: Observations that a prior variance counts for: noise of times and dead reckoning; all else.
_NU_NOISE, _NU = 10.0, 3.0
#: Of each group of fading states where it grows: a slow error of the sound that may do so easily
#: takes up what is wrong elsewhere.
_NU_GROWING = np.array([_NU, _NU, _NU, 10.0, _NU])
#: No sigma, q or time constant moves by more than this factor in one step.
_FACTOR = 2.0
#: Time noise stays within these shares of the stated one.
_TIME_NOISE = (0.1, 6.0)
#: Largest sigma of each constant before the beacons': heading offset and deviation in rad, scales
#: of the DVL and the sound speed, gradient in 1/s, clock in s, lever arm in m.
_MOST = np.array(
    [
        np.pi, *np.radians([6.0, 6.0, 6.0, 6.0]), 0.3, 0.1, 0.1, 0.1, 15.0, 15.0, 15.0,
    ]
)  # fmt: skip
#: A time constant is learned once its sigma exceeds the prior's by this factor.
_TIME_FROM = 1.5
_SHORTEST_S = 30.0
#: What each beacon's times err by for longer than half an hour is a turn-around.
_LONGEST_S = np.array([14400.0, 14400.0, 14400.0, 14400.0, 1800.0])
#: Places of the DVL's slow error, forward and starboard, among the fading states.
_DVL = slice(FORWARD - DRIFTS.start, STARBOARD - DRIFTS.start + 1)
#: rad, m/s, m/s, share of the sound speed, s
_LARGEST_DRIFT = np.array([0.5, 1.0, 2.0, 0.02, 0.02])


class Share(NamedTuple):
    """Sum of squares over a variance, and the redundancy behind it."""

    squares: Float
    redundancy: Float


class _Moments(NamedTuple):
    """Expected second moments of the fading states, summed by window and group (w, 5)."""

    lagged: Float  #: Σ x_{i+1} x_i
    square: Float  #: Σ x_i²


def learn_noise(
    problem: Problem, solved: Solved, prior: NoiseModel, noise: NoiseModel, stated: Bool
) -> NoiseModel:
    """Variances that explain what a step left over, each between its prior and the data.

        σ² <- (Σ r² + ν σ₀²) / (Σ γ + ν),     γ = 1 - aᵀ Σ a

    for each group of whitened rows a with posterior covariance Σ: γ is the redundancy that a row
    keeps.  W. Förstner, "Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten" (1979);
    K.-R. Koch, "Parameter Estimation and Hypothesis Testing in Linear Models", sec. 3.6.  The prior
    counts for ν observations.

    Parameters
    ----------
    prior, noise : before anything was learned, and as used in the step
    stated : (b,) beacons whose sigma somebody stated: that is learned only upwards
    """
    return learn_random(problem, solved, prior, noise)._replace(
        constant_sigma=_learn_constants(solved, prior, noise, stated)
    )


def learn_random(
    problem: Problem, solved: Solved, prior: NoiseModel, noise: NoiseModel
) -> NoiseModel:
    """The same for all but the priors of the constants, which stay."""
    root = constant_root(solved)
    return NoiseModel(
        _learn_times(problem, solved, prior, noise, root),
        _learn_motion(problem, solved, prior, noise, root),
        *_learn_drift(problem, solved, prior, noise, root),
        noise.constant_sigma,
    )


def _update(share: Share, now: Float, prior: Float, nu: Float | float) -> Float:
    """New variances (Σ r² + ν σ₀²) / (Σ γ + ν), no sigma moved by more than the factor."""
    wanted = (now * share.squares + nu * prior) / (np.maximum(share.redundancy, 0.0) + nu)
    return np.clip(wanted, now / _FACTOR**2, now * _FACTOR**2)


def _learn_times(
    problem: Problem, solved: Solved, prior: NoiseModel, noise: NoiseModel, root: Float
) -> Float:
    rows, information = solved.terms.rows, solved.terms.information
    left = rows.residual - np.sum(rows.by_node * solved.node_step[_row_nodes(problem)], axis=1)
    left -= rows.by_constant @ solved.constant_step
    leverage = information * predicted_variance(solved, problem.slots, root)
    n, weight = (
        len(noise.observation_sigma),
        information * noise.observation_sigma[problem.group] ** 2,
    )
    share = Share(
        _sums(problem.group, information * left**2, n),
        _sums(problem.group, weight * (1 - np.minimum(leverage, 1.0)), n),
    )
    variance = _update(share, noise.observation_sigma**2, prior.observation_sigma**2, _NU_NOISE)
    low, high = _TIME_NOISE
    return np.clip(np.sqrt(variance), low * prior.observation_sigma, high * prior.observation_sigma)


def constant_root(solved: Solved) -> Float:
    """V √C (n, s, m): what errors of the constants, each of unit variance, do to the nodes."""
    return np.asarray(solved.factored.spread @ np.linalg.cholesky(solved.constant_cov))


def predicted_variance(solved: Solved, slots: Slots, root: Float) -> Float:
    """Variance (r,) of what the states predict: h_n Z h_nᵀ + |h_c √C - h_n V √C|².

    Parameters
    ----------
    root : `constant_root`
    """
    rows = solved.terms.rows
    by_node = slots.deal(rows.by_node)
    rest = slots.deal(rows.by_constant @ np.linalg.cholesky(solved.constant_cov))
    rest -= by_node @ root[slots.node]
    variance = np.sum((by_node @ solved.marginals.own[slots.node]) * by_node, axis=2)
    return slots.collect(variance + np.sum(rest**2, axis=2), len(rows.residual))


def _row_nodes(problem: Problem) -> np.ndarray:
    observations = problem.observations
    return np.concatenate([observations.times.node, np.repeat(observations.positions.node, 2)])


def _learn_motion(
    problem: Problem, solved: Solved, prior: NoiseModel, noise: NoiseModel, root: Float
) -> Float:
    motion, step = solved.terms.motion, solved.node_step
    first, second = motion.step.by_first.copy(), motion.step.by_second.copy()
    for axis in (0, 1):
        first[:, axis, axis] += 1.0
        second[:, axis, axis] -= 1.0
    by_constant = motion.step.by_constant
    left = motion.miss_m - (first @ step[:-1, :, None] + second @ step[1:, :, None])[:, :, 0]
    columns = motion_columns(motion.step, len(solved.constant_step))
    left -= by_constant @ solved.constant_step[columns]
    own, following = solved.marginals
    variance = np.sum((first @ own[:-1]) * first, axis=(1, 2))
    variance += np.sum((second @ own[1:]) * second, axis=(1, 2))
    variance += 2 * np.sum((second @ following) * first, axis=(1, 2))
    lower = np.linalg.cholesky(solved.constant_cov)[columns]
    rest = by_constant @ lower - first @ root[:-1] - second @ root[1:]
    variance += np.sum(rest**2, axis=(1, 2))
    window = problem.window[:-1]
    white = noise.position_m2_per_s[window] * np.diff(problem.t_node_s) / motion.variance_m2
    squares = np.sum(left**2, axis=1) / motion.variance_m2
    redundancy = 2 - np.minimum(variance / motion.variance_m2, 2.0)
    n = problem.n_windows
    share = Share(
        _sums(window, white * squares, n),
        _sums(window, white * redundancy, n),
    )
    q, nu = noise.position_m2_per_s, _NU_NOISE
    wanted = (q * share.squares + nu * prior.position_m2_per_s) / (share.redundancy + nu)
    return np.clip(wanted, q / _FACTOR, q * _FACTOR)


def _learn_drift(
    problem: Problem, solved: Solved, prior: NoiseModel, noise: NoiseModel, root: Float
) -> tuple[Float, Float]:
    drift, own = solved.terms.drift, solved.marginals.own
    step = solved.node_step[:, DRIFTS.start :]
    before = np.concatenate([step[:1], step[:-1]])
    left = drift.miss + step - drift.factor * before
    faded = slice(DRIFTS.start, None)
    variance = np.diagonal(own, axis1=1, axis2=2)[:, faded] + np.sum(root[:, faded] ** 2, axis=2)
    joint = np.diagonal(solved.marginals.next, axis1=1, axis2=2)[:, faded]
    joint = joint + np.sum(root[1:, faded] * root[:-1, faded], axis=2)
    left_variance = variance.copy()
    a = drift.factor[1:]
    left_variance[1:] += a**2 * variance[:-1] - 2 * a * joint
    redundancy = 1 - np.clip(left_variance / drift.variance, 0.0, 1.0)
    free = np.ones_like(left)
    free[problem.held_sigma_mps > 0, _DVL] = 0.0  # a held velocity tells nothing of the DVL
    share = Share(
        _by_window(problem, free * left**2 / drift.variance),
        _by_window(problem, free * redundancy),
    )
    now, stated = noise.drift_sigma**2, prior.drift_sigma**2
    grows = now * share.squares > stated * share.redundancy
    sigma2 = _update(share, now, stated, np.where(grows, _NU_GROWING, _NU))
    sigma = np.minimum(np.sqrt(sigma2), np.maximum(_LARGEST_DRIFT, prior.drift_sigma))
    values = drift.state + step
    moments = _Moments(
        _by_window(
            problem,
            np.concatenate([values[1:] * values[:-1] + joint, np.zeros((1, step.shape[1]))]),
        ),
        _by_window(
            problem,
            np.concatenate([values[:-1] ** 2 + variance[:-1], np.zeros((1, step.shape[1]))]),
        ),
    )
    return sigma, _learn_time_constants(problem, moments, prior, noise, sigma)


def _sums(cell: Int, values: Float, n: int) -> Float:
    """Sums (n,) of the values in each cell."""
    return np.asarray(np.bincount(cell, values, minlength=n), dtype=float)


def _by_window(problem: Problem, values: Float) -> Float:
    """Sums (w, 5) over windows and groups of fading states of values (n, 6 or more)."""
    n_groups, groups = len(DRIFT_NAMES), drift_groups(DRIFTS.start + values.shape[1])
    cell = problem.window[:, None] * n_groups + groups
    sums = _sums(cell.ravel(), values.ravel(), problem.n_windows * n_groups)
    return sums.reshape(problem.n_windows, n_groups)


def _learn_time_constants(
    problem: Problem, moments: _Moments, prior: NoiseModel, noise: NoiseModel, sigma: Float
) -> Float:
    """E-folding times where a sigma says that the prior is wrong."""
    wanted = fading_time(moments.lagged, moments.square, problem.t_node_s)
    now = noise.drift_time_s
    wanted = np.clip(np.nan_to_num(wanted, nan=1.0), _SHORTEST_S, _LONGEST_S)
    wanted = np.clip(wanted, now / _FACTOR, now * _FACTOR)
    return np.where(sigma > _TIME_FROM * prior.drift_sigma, wanted, prior.drift_time_s)


def fading_time(lagged: Float, square: Float, t_s: Float) -> Float:
    """E-folding time (...) of a Gauss-Markov state from sums over its instants.

        τ = -Δt / ln r,     r = Σ x_{i+1} x_i / Σ x_i²,     Δt the mean step

    For steps short beside τ each has 1 - Δt / τ, so of uneven ones the mean tells.

    Parameters
    ----------
    lagged, square : (...) Σ x_{i+1} x_i and Σ x_i²
    t_s : (n,) the instants
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.clip(lagged / square, 1e-6, 1 - 1e-6)
    return np.asarray(-np.mean(np.diff(t_s)) / np.log(correlation))


def constant_groups(n_beacons: int) -> list[np.ndarray]:
    """Columns of the constants that share a prior sigma, up to the stated differences."""
    beacons = N_COMMON + np.arange(n_beacons * N_BEACON).reshape(-1, N_BEACON)
    return [
        np.array([OFFSET]), np.array([1, 2]), np.array([3, 4]), np.array([SCALE]),
        np.array([SOUND_SCALE]), np.array([GRADIENT]), np.array([CLOCK]),
        np.arange(LEVER.start, LEVER.stop), beacons[:, :3].ravel(), beacons[:, 3],
    ]  # fmt: skip


def _learn_constants(solved: Solved, prior: NoiseModel, noise: NoiseModel, stated: Bool) -> Float:
    value = solved.terms.constant + solved.constant_step
    sigma = noise.constant_sigma.copy()
    n_beacons = (len(sigma) - N_COMMON) // N_BEACON
    ratio2 = (value / prior.constant_sigma) ** 2
    variance = np.diagonal(solved.constant_cov) / sigma**2
    for columns in constant_groups(n_beacons):
        if not len(columns):
            continue
        scale2 = float((sigma[columns[0]] / prior.constant_sigma[columns[0]]) ** 2)
        redundancy = float(np.sum(1 - np.minimum(variance[columns], 1.0)))
        wanted = (float(ratio2[columns].sum()) + _NU) / (redundancy + _NU)
        wanted = float(np.clip(wanted, scale2 / _FACTOR**2, scale2 * _FACTOR**2))
        sigma[columns] = np.sqrt(wanted) * prior.constant_sigma[columns]
    beacons = slice(N_COMMON, None)
    least = np.repeat(stated, N_BEACON) * prior.constant_sigma[beacons]
    sigma[beacons] = np.maximum(sigma[beacons], least)
    sigma[:N_COMMON] = np.minimum(
        sigma[:N_COMMON], np.maximum(_MOST, prior.constant_sigma[:N_COMMON])
    )
    return sigma
