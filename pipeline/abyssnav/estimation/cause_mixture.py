# SPDX-License-Identifier: Apache-2.0
"""What may be wrong with beacons, clocks and lever arm, each weighed by the evidence."""

from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_states import CLOCK, LEVER, N_BEACON, N_COMMON
from abyssnav.estimation.normal_equations import Factored, solve_constants
from abyssnav.tables import Bool, Float, Int

#: Sigmas of what is wrong under each hypothesis: the lever arm, an error common to all
#: turn-arounds, one beacon's place and turn-around, and those of all beacons together.
_LEVER_M, _CLOCK_S = 5.0, 0.005
_BEACON_M, _TURN_AROUND_S = 6.0, 0.005
_ALL_M, _ALL_S = 4.0, 0.002
#: Sigmas of beacons that nobody stated may be these multiples of the default, all as likely as the
#: default; from the last figure on, it is the beacons that are wrong.
_UNSTATED, _UNSTATED_WRONG = (0.3, 0.7, 1.5, 3.3, 7.0, 15.0), 3.0
#: A lever arm that nobody gave is none, or in e of e + 1 cases of so many times the sigma of the
#: settings.  Where nothing tells it, both together have 2 √(e / (e + 1)) = 1.7 times that sigma;
#: where turns tell, they do.
_UNSTATED_LEVER, _MOSTLY = 2.0, 1.0
#: Log prior that a beacon is wrong, or all are, or the lever arm: one in twenty.  Of an arm that
#: somebody gave it is the square of that.
_RARE = -3.0
#: Of an error common to all turn-arounds: as likely as none. Far from the beacons hardly a reply
#: contradicts one of some milliseconds, so its share of the covariance is its prior; where the
#: vehicle stays between them, replies from all sides refute it and the prior is of no account.
_COMMON = 0.0


class ConstantPriors(NamedTuple):
    """Sigmas of the constants: what hypotheses of what is wrong start from."""

    learned: Float  #: (m,) after learning
    stated: Float  #: (m,) before
    beacon_stated: Bool  #: (b,) beacons whose sigma is stated
    lever_stated: bool = True  #: whether somebody gave the lever arm
    unstated_lever_m: float = 0.0  #: of one that nobody gave, where it counts


class Cause(NamedTuple):
    """A hypothesis of what is wrong, and its weight in the mixture."""

    name: str  #: one of the contract's causes; "" where nothing is wrong
    beacon: int  #: row of the beacon, -1 for all or none
    weight: float  #: probability after the data; all add up to one
    #: Log evidence, one in twenty being wrong, over that of the likeliest with nothing wrong:
    #: what it takes to name a cause is the same for all of them.
    log_gain: float
    since_s: float | None = None  #: from when on, where not from the beginning


class Mixture(NamedTuple):
    """Constants as the mean over the causes, their covariance with the spread between causes."""

    constant_step: Float  #: (m,) from the estimate's constants
    constant_cov: Float  #: (m, m)
    causes: tuple[Cause, ...]
    log_gain: float  #: log evidence of all hypotheses together over that of the learned priors


class _Hypothesis(NamedTuple):
    name: str
    beacon: int
    sigma: Float  #: (m,)
    log_prior: float


def weigh_causes(factored: Factored, constant: Float, priors: ConstantPriors) -> Mixture:
    """Mean and covariance of the constants over the hypotheses of what is wrong.

    The nodes are eliminated, so a hypothesis costs one small system of equations; its weight is
    the marginal likelihood times the prior (Bayesian model averaging: J. Hoeting et al.,
    Statistical Science 14, 1999).  What compass, DVL and sound have been learned to do stays;
    beacons, clock and lever arm go back to their priors under each hypothesis.

    Parameters
    ----------
    constant : (m,) at which the equations were linearised
    """
    hypotheses = _hypotheses(priors)
    steps = [solve_constants(factored, constant, h.sigma**2) for h in hypotheses]
    likelihood = np.array([s.log_evidence for s in steps])
    evidence = likelihood + np.array([h.log_prior for h in hypotheses])
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    step = np.array([s.step for s in steps])
    mean = weight @ step
    apart = step - mean
    cov = np.einsum("h,hij->ij", weight, np.array([s.covariance for s in steps]))
    cov += (apart * weight[:, None]).T @ apart
    wrong = np.array([h.name != "" for h in hypotheses])
    gains = likelihood + np.where(wrong, _RARE, 0.0) - likelihood[~wrong].max()
    causes = tuple(
        Cause(h.name, h.beacon, w, gain)
        for h, w, gain in zip(hypotheses, weight.tolist(), gains.tolist(), strict=True)
    )
    learned = solve_constants(factored, constant, priors.learned**2).log_evidence
    together = np.logaddexp.reduce(evidence)
    together -= np.logaddexp.reduce([h.log_prior for h in hypotheses])
    return Mixture(mean, cov, causes, float(together) - learned)


def _hypotheses(priors: ConstantPriors) -> list[_Hypothesis]:
    base, prior = priors.learned.copy(), priors.stated
    base[CLOCK], base[LEVER], base[N_COMMON:] = prior[CLOCK], prior[LEVER], prior[N_COMMON:]
    beacons = N_COMMON + np.arange(len(base) - N_COMMON).reshape(-1, N_BEACON)
    result = [_Hypothesis("", -1, base, 0.0)]

    def suppose(
        name: str, beacon: int, columns: Int, sigma: Float | float, log_prior: float = _RARE
    ) -> None:
        changed = base.copy()
        changed[columns] = np.maximum(sigma, base[columns])
        result.append(_Hypothesis(name, beacon, changed, log_prior))

    lever = np.arange(LEVER.start, LEVER.stop)
    suppose("lever_arm", -1, lever, _LEVER_M, _RARE * (2 if priors.lever_stated else 1))
    if priors.unstated_lever_m > 0:
        suppose("", -1, lever[:2], _UNSTATED_LEVER * priors.unstated_lever_m, _MOSTLY)
    suppose("turn_around", -1, np.array([CLOCK]), _CLOCK_S, _COMMON)
    for beacon, columns in enumerate(beacons):
        suppose("beacon_moved", beacon, columns[:3], _BEACON_M)
        suppose("turn_around", beacon, columns[3:], _TURN_AROUND_S)
    every = np.tile([_ALL_M, _ALL_M, _ALL_M, _ALL_S], len(beacons))
    suppose("beacon_moved", -1, beacons.ravel(), every)
    unstated = beacons[~priors.beacon_stated, :3].ravel()
    for factor in _UNSTATED if len(unstated) else ():
        changed = base.copy()
        changed[unstated] = factor * prior[unstated]
        name = "beacon_moved" if factor > _UNSTATED_WRONG else ""
        result.append(_Hypothesis(name, -1, changed, 0.0))
    return result
