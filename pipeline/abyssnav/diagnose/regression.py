# SPDX-License-Identifier: Apache-2.0
"""Which of several error models explains observations best: Gaussian evidence, made robust."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from abyssnav.tables import Float

#: Observations farther than this many of their sigmas from what the others predict lose weight.
_OUTLIER = 3.0
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Regression:
    """Observations y (n,) = Σ columns · parameters + noise, whatever the prior of those."""

    y: Float  #: (n,) metres
    noise_cov: Float  #: (n, n) of the noise that is common to all models, m²
    columns: Float  #: (n, k) of all parameters
    names: tuple[str, ...]  #: (k,) group that each column belongs to


@dataclass(frozen=True, eq=False)
class Fit:
    """What one prior makes of a regression."""

    log_likelihood: float
    value: Float  #: (k,) parameters, posterior mean


@dataclass(frozen=True, eq=False)
class Prepared:
    """A regression under a base prior, from which wider priors follow at little cost."""

    sigma: Float  #: (k,) of the base prior
    log_likelihood: float
    information: Float  #: (k, k) M = Aᵀ K⁻¹ A
    pull: Float  #: (k,) b = Aᵀ K⁻¹ y

    def fit(self, sigma: Float) -> Fit:
        """Evidence and posterior mean where some columns are wider than in the base prior.

        With d the variance added to columns g, C = M_gg and B = (D⁻¹ + C)⁻¹

            log p - log p₀ = ½ b_gᵀ B b_g - ½ log |I + D C|,   x = S (b - M_g B b_g)
        """
        wide = np.flatnonzero(sigma > self.sigma)
        added = sigma[wide] ** 2 - self.sigma[wide] ** 2
        inner = self.information[np.ix_(wide, wide)]
        grown = np.eye(len(wide)) + added[:, None] * inner
        solved = np.linalg.solve(grown, added * self.pull[wide])
        gain = 0.5 * self.pull[wide] @ solved - 0.5 * np.linalg.slogdet(grown)[1]
        value = sigma**2 * (self.pull - self.information[:, wide] @ solved)
        return Fit(self.log_likelihood + float(gain), value)


def prior_sigmas(names: Sequence[str], sigma: Mapping[str, float]) -> Float:
    """Prior sigma (k,) of each column by the name of its group."""
    return np.array([sigma[name] for name in names])


def prepare(problem: Regression, sigma: Float, inflation: Float) -> Prepared:
    """Evidence under a base prior, and what wider ones need.

        y ~ N(0, K),   K = R + A S Aᵀ,   log p = -½ yᵀ K⁻¹ y - ½ log |2π K|

    Parameters
    ----------
    sigma : (k,) prior standard deviations, the roots of S
    inflation : (n,) variance added to each observation, m²
    """
    K = _covariance(problem, sigma, inflation)
    log_det = np.linalg.slogdet(K)[1]
    solved = np.linalg.solve(K, np.column_stack([problem.columns, problem.y]))
    information, pull = problem.columns.T @ solved[:, :-1], problem.columns.T @ solved[:, -1]
    square = problem.y @ solved[:, -1]
    log_p = -0.5 * (square + log_det + len(problem.y) * np.log(2 * np.pi))
    return Prepared(sigma, float(log_p), information, pull)


def _covariance(problem: Regression, sigma: Float, inflation: Float) -> Float:
    """K (n, n); NumPy's solver does for it, and SciPy's takes longer to import than to use."""
    scaled = problem.columns * sigma
    K = problem.noise_cov + scaled @ scaled.T
    K[np.diag_indices_from(K)] += inflation
    return np.asarray(K)


def _missed(problem: Regression, sigma: Float, inflation: Float) -> Float:
    """Distance (n,) of each observation from what all others predict, in sigmas.

    r_i = [K⁻¹ y]_i / √[K⁻¹]_ii
    """
    inverse = np.linalg.inv(_covariance(problem, sigma, inflation))
    return np.asarray(np.abs(inverse @ problem.y) / np.sqrt(np.diag(inverse)))


def robust_inflation(problem: Regression, sigma: Float) -> Float:
    """Variance (n,) by which observations that nothing explains are inflated under one prior."""
    inflation = np.zeros(len(problem.y))
    for _ in range(_ROUNDS):
        missed = _missed(problem, sigma, inflation)
        worst = missed > max(_OUTLIER, 0.4 * float(missed.max()))
        if not worst.any():
            break
        base = np.diag(problem.noise_cov) + inflation
        inflation = inflation + np.where(worst, base * ((missed / 1.5) ** 2), 0.0)
    return inflation
