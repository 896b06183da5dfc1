# SPDX-License-Identifier: Apache-2.0
"""The final track: a robust MAP estimate of the whole dive, from the best of its first guesses."""

from typing import NamedTuple

import numpy as np

from abyssnav.estimation.cause_mixture import Cause, ConstantPriors, Mixture, weigh_causes
from abyssnav.estimation.dead_reckoning import DeadReckoning
from abyssnav.estimation.dive_problem import (
    DiveInputs,
    ErrorPriors,
    Problem,
    motion_variance,
    pose_problem,
    prior_noise,
    states_along,
)
from abyssnav.estimation.dive_states import (
    CURRENT_EAST,
    CURRENT_NORTH,
    FORWARD,
    HEADING,
    SCALE,
    SOUND,
    SOUND_SCALE,
    STARBOARD,
    DiveStates,
    NoiseModel,
)
from abyssnav.estimation.map_estimator import (
    STATED_NOISE,
    MapEstimate,
    Schedule,
    Setting,
    estimate_map,
)
from abyssnav.estimation.moved_beacon import LOG_PRIOR, is_suspicious, move_beacon
from abyssnav.estimation.normal_equations import Factored, solve_constants
from abyssnav.geometry import blend, pairs, plane
from abyssnav.tables import Bool, Fixes, Float, Int

#: Shorter dives tell too little of what is wrong with beacons, clocks and lever arm.
_SHORT_S = 1200.0
#: Another beginning is tried where the estimate refuses more than this share of the replies,
_REFUSED = 0.5
#: or lies farther from the consistent fixes than so many times their scatter and so many metres.
_APART, _APART_M = 3.0, 6.0
#: Process noise of a track that follows the fixes wherever dead reckoning leads.
_FOLLOWING_M2_PER_S = 0.5
#: Learned sigmas that differ from the prior's by less are not weighed against it.
_NOTABLE = 1.5
#: What comes to rest within so many steps has not left the summit that it began at.
_NEAR_STEPS = 5
#: A suspicion is tried for so many steps, and taken to its end unless so many nats behind.
_TRIED_STEPS, _PROMISING = 10, 5.0
#: μ of the first steps under a suspicion.
_AGAIN = (10.0, 3.0, 1.0)
#: A slow error is suspected where its learned sigma exceeds the prior's by this factor.
_WORSE = 2.5
#: Group of slow errors, its sigma (rad, m/s, m/s) and time (s): compass, DVL and water, twice each.
_SUSPICIONS = (
    (0, 0.09, 600.0),
    (0, 0.05, 60.0),
    (1, 0.05, 600.0),
    (1, 0.02, 120.0),
    (2, 0.15, 7200.0),
    (2, 0.15, 600.0),
)
#: Replies of a beacon whose residuals are summed to see whether its times err slowly, as in one
#: dive of twenty.
_SUM_OF = 10
_SLOW_LOG_PRIOR = -3.0
#: Covariances of a posterior of which places alone are asked.
_NONE = np.empty(0)


class FirstGuess(NamedTuple):
    """A first guess of the track."""

    t_s: Float
    position_m: Float  #: (n, 2)


class Posterior(NamedTuple):
    """The dive by all its evidence: states at the nodes and covariances of their errors."""

    problem: Problem
    states: DiveStates
    noise: NoiseModel
    node_cov: Float  #: (n, s, s) of s states
    constant_cov: Float  #: (m, m)


class SmootherResult(NamedTuple):
    """What the smoother made of a dive."""

    posterior: Posterior
    estimate: MapEstimate  #: before the causes were weighed
    setting: Setting
    causes: tuple[Cause, ...]  #: hypotheses of what is wrong with their weights; none when short
    residual_s: Float  #: (n,) of every usable reply
    sigma_s: Float  #: (n,) of every reply's time
    taking_part: Bool  #: (n,) not one of several replies of a beacon to a ping
    weight: Float  #: (n,) probability that a reply is no outlier
    by_position_spm: Float  #: (n, 2) ∂T/∂p of every reply
    unmoved: tuple[Setting, MapEstimate]  #: those by which no beacon was moved during the dive

    def position_residuals(self) -> tuple[Float, float]:
        """Residuals (p, 2) of positions over their sigma, and the factor learned on the sigmas."""
        rows = self.estimate.residual[self.setting.problem.n_times :].reshape(-1, 2)
        return rows, float(self.posterior.noise.observation_sigma[-1])


def smooth(
    inputs: DiveInputs,
    ping: Int,
    priors: ErrorPriors,
    first_guess: FirstGuess | None,
    fixes: Fixes | None = None,
) -> SmootherResult | None:
    """Robust batch estimate of the whole dive; None without anything to begin from.

    It begins at the first guess.  Where the estimate then refuses most replies, or lies farther
    from the consistent fixes than they scatter, it begins again from the fixes,
    once believing dead reckoning and once following the fixes; the likeliest of all is taken.
    Noise and priors learned from the dive are kept only where they explain it better than the
    stated ones; that times err slowly, or that a beacon was moved during the dive, where that is
    likelier.

    Parameters
    ----------
    ping : (n,) number of each reply's ping (`ping_numbers`)
    """
    problem = pose_problem(inputs, priors)
    stated = np.isfinite(inputs.beacons.sigma_m) & (inputs.beacons.sigma_m > 0)
    setting = Setting(
        problem, ping, prior_noise(inputs, priors, problem), stated, priors.unstated_lever_m
    )
    by_fixes = _by_fixes(fixes)
    estimates = []
    if first_guess is not None:
        estimates.append(estimate_map(setting, _states_along(inputs, problem, first_guess)))
    if by_fixes is not None and not (
        estimates and _agrees(estimates[0], problem, inputs.motion, by_fixes)
    ):
        start = _states_along(inputs, problem, by_fixes)
        following = setting.prior._replace(
            position_m2_per_s=np.full(problem.n_windows, _FOLLOWING_M2_PER_S)
        )
        noises = (following,) if _is_same(first_guess, by_fixes) else (None, following)
        estimates += [estimate_map(setting, start, noise) for noise in noises]
    if not estimates:
        return None
    likeliest = _likeliest(setting, max(estimates, key=_likelihood))
    return _average_over_causes(_weighed(setting, likeliest), (setting, likeliest))


class _Weighed(NamedTuple):
    setting: Setting
    estimate: MapEstimate
    mixture: Mixture

    def log_evidence(self) -> float:
        return self.estimate.log_likelihood + self.mixture.log_gain


def _weighed(setting: Setting, estimate: MapEstimate) -> _Weighed:
    """The likeliest of an estimate, that with slow times, and that with a moved beacon.

    Each with its causes; the others are tried where the residuals speak for them.
    """
    plain = _Weighed(setting, estimate, _weigh(setting, estimate))
    suspicious = is_suspicious(setting, estimate)
    if _is_short(setting) or not (suspicious or _err_slowly(setting, estimate)):
        return plain
    still, evidence = plain, plain.log_evidence()
    slow = _with_slow_times(setting, estimate)
    if slow.log_evidence() + _SLOW_LOG_PRIOR > evidence:
        still, evidence = slow, slow.log_evidence() + _SLOW_LOG_PRIOR
    moved = move_beacon(setting, estimate) if suspicious else None
    if moved is None:
        return still
    other = _Weighed(moved.setting, moved.estimate, _weigh(moved.setting, moved.estimate))
    gain = other.log_evidence() + LOG_PRIOR - evidence
    if gain <= 0:
        return still
    causes = (Cause("beacon_moved", moved.beacon, 1.0, gain, moved.since_s),)
    return other._replace(mixture=other.mixture._replace(causes=causes))


def _err_slowly(setting: Setting, estimate: MapEstimate) -> bool:
    """Whether times of a beacon err the same way for long.

    A sum of k residuals has k times the variance of one where they are white; less in truth, since
    the fit takes up some of what is slow.
    """
    n, squares, expected = setting.problem.n_times, 0.0, 0.0
    kept = estimate.taking_part[:n] & (estimate.weight[:n] > 0.5)
    for beacon in range(setting.problem.n_beacons):
        residual = estimate.residual[:n][kept & (setting.problem.group[:n] == beacon)]
        if len(residual) > _SUM_OF:
            total = np.cumsum(np.append(0.0, residual))
            sums = total[_SUM_OF:] - total[:-_SUM_OF]
            squares += float(sums @ sums)
            expected += _SUM_OF * len(sums) * float(np.mean(residual**2))
    return squares > expected


def _with_slow_times(setting: Setting, estimate: MapEstimate) -> _Weighed:
    """The same dive where each beacon's times may err slowly: a further state of every node."""
    states = estimate.states.with_slow_times()
    slow = estimate_map(setting, states, schedule=Schedule(graduation=_AGAIN))
    return _Weighed(setting, slow, _weigh(setting, slow))


def _is_same(one: FirstGuess | None, other: FirstGuess) -> bool:
    return one is not None and all(map(np.array_equal, one, other))


def _states_along(inputs: DiveInputs, problem: Problem, first_guess: FirstGuess) -> DiveStates:
    return states_along(problem, inputs.motion, first_guess.t_s, first_guess.position_m)


def _likelihood(estimate: MapEstimate) -> float:
    return estimate.log_likelihood


def _likeliest(setting: Setting, learned: MapEstimate) -> MapEstimate:
    """The estimate, or one with other noise that is likelier.

    Learning climbs to the nearest summit.  Where that differs from the stated noise, it must be
    likelier than that; and than the summit to which that leads, where that is another one.  Where
    it blames compass, DVL or water for much more than the priors do, it begins again under each of
    the suspicions, and the likeliest is taken to its end.
    """
    ratios = [
        np.abs(np.log(after / before)).max()
        for after, before in zip(learned.noise, setting.prior, strict=True)
    ]
    if max(ratios) < np.log(_NOTABLE):
        return learned
    plain = estimate_map(setting, learned.states, schedule=STATED_NOISE)
    if plain.steps > _NEAR_STEPS:
        other = estimate_map(setting, plain.states, schedule=Schedule(graduation=()))
        learned = max(learned, other, key=_likelihood)
    if _suspicious(learned.noise, setting.prior):
        tried = [
            estimate_map(setting, learned.states, noise, Schedule(True, _AGAIN, _TRIED_STEPS))
            for noise in _suspicions(setting.prior)
        ]
        other = max(tried, key=_likelihood)
        if other.log_likelihood > learned.log_likelihood - _PROMISING:
            other = estimate_map(setting, other.states, other.noise, Schedule(graduation=()))
        learned = max(learned, other, key=_likelihood)
    return max(learned, plain, key=_likelihood)


def _suspicious(noise: NoiseModel, prior: NoiseModel) -> bool:
    """Whether dead reckoning was learned to be much worse than it should be."""
    drifts = np.max(noise.drift_sigma / prior.drift_sigma)
    return bool(max(drifts, np.max(noise.position_m2_per_s / prior.position_m2_per_s)) > _WORSE)


def _suspicions(prior: NoiseModel) -> list[NoiseModel]:
    """Noise to begin from when one group of the slow errors is large and no other is."""
    noises = []
    for group, sigma, time_s in _SUSPICIONS:
        drift_sigma, drift_time_s = prior.drift_sigma.copy(), prior.drift_time_s.copy()
        drift_sigma[:, group], drift_time_s[:, group] = sigma, time_s
        noises.append(prior._replace(drift_sigma=drift_sigma, drift_time_s=drift_time_s))
    return noises


def _average_over_causes(weighed: _Weighed, unmoved: tuple[Setting, MapEstimate]) -> SmootherResult:
    """The estimate with its constants as the mean over the causes."""
    setting, estimate, (step, constant_cov, causes, _) = weighed
    problem, spread = setting.problem, estimate.factored.spread
    n = problem.n_times
    states = estimate.states.moved(-(spread @ step), step)
    node_cov = estimate.marginals.own + spread @ constant_cov @ spread.swapaxes(1, 2)
    sigma_s = estimate.noise.observation_sigma[problem.group[:n]]
    return SmootherResult(
        posterior=Posterior(problem, states, estimate.noise, node_cov, constant_cov),
        estimate=estimate,
        setting=setting,
        causes=causes,
        residual_s=estimate.residual[:n] * sigma_s,
        sigma_s=sigma_s,
        taking_part=estimate.taking_part[:n],
        weight=estimate.weight[:n],
        by_position_spm=estimate.terms.rows.by_node[:n, :2],
        unmoved=unmoved,
    )


def _is_short(setting: Setting) -> bool:
    t_s = setting.problem.t_node_s
    return bool(t_s[-1] - t_s[0] < _SHORT_S)


def _weigh(setting: Setting, estimate: MapEstimate) -> Mixture:
    return weigh(setting, estimate.factored, estimate.states.constant, estimate.noise)


def weigh(
    setting: Setting,
    factored: Factored,
    constant: Float,
    noise: NoiseModel,
    unstated_lever_m: float = 0.0,
) -> Mixture:
    """Mixture over the causes; the estimate itself where the dive is too short to weigh them.

    Parameters
    ----------
    constant : (m,) at which the equations were linearised
    unstated_lever_m : sigma of a lever arm that nobody gave
    """
    learned = noise.constant_sigma
    if _is_short(setting):
        covariance = solve_constants(factored, constant, learned**2).covariance
        return Mixture(np.zeros_like(constant), covariance, (), 0.0)
    lever_stated = setting.unstated_lever_m == 0
    stated = setting.prior.constant_sigma
    priors = ConstantPriors(learned, stated, setting.stated, lever_stated, unstated_lever_m)
    return weigh_causes(factored, constant, priors)


def _by_fixes(fixes: Fixes | None) -> FirstGuess | None:
    """The consistent fixes, where there are three or more."""
    if fixes is None or fixes.consistent.sum() < 3:
        return None
    good = fixes[fixes.consistent]
    return FirstGuess(good.t_mid_s, good.position_enu_m[:, :2])


def _offsets(first_guess: FirstGuess, motion: DeadReckoning) -> Float:
    """Places (n, 2) less dead reckoning, each the median of five neighbours."""
    reckoned_m = motion.interpolate(first_guess.t_s).displacement_m
    offset_m = first_guess.position_m - reckoned_m
    padded = np.pad(offset_m, ((2, 2), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0)
    return np.asarray(np.median(windows, axis=-1))


def _agrees(
    estimate: MapEstimate, problem: Problem, motion: DeadReckoning, fixes: FirstGuess
) -> bool:
    """Whether an estimate explains most replies and lies where the consistent fixes do."""
    n = problem.n_times
    explained = estimate.weight[:n][estimate.taking_part[:n]] > 0.5
    smooth_m = motion.interpolate(fixes.t_s).displacement_m + _offsets(fixes, motion)
    scatter_m = float(np.median(np.hypot(*(fixes.position_m - smooth_m).T)))
    track_m = positions(
        Posterior(problem, estimate.states, estimate.noise, _NONE, _NONE), fixes.t_s
    )
    apart_m = np.hypot(*(fixes.position_m - track_m).T)
    far = np.percentile(apart_m, 75) > _APART * scatter_m + _APART_M
    return bool(np.mean(explained) >= 1 - _REFUSED and not far)


def positions(posterior: Posterior, t_s: Float) -> Float:
    """Places (m, 2) at any instants of the dive; see `interpolate_posterior`."""
    node, share = _bracket(posterior, t_s)
    return _place(posterior, t_s, node, share)


def interpolate_posterior(posterior: Posterior, t_s: Float) -> tuple[Float, Float]:
    """Places and covariances at any instants, from the nodes on either side.

    Dead reckoning from the node before, with the errors of both, misses the node after by little;
    the miss is spread over the interval in proportion to time, f.  The covariance is the bound
    (1 - f) P_i + f P_{i+1} + f (1 - f) Q: a bridge between its ends has less by f (1 - f) times the
    covariance of p_{i+1} - p_i.

    Returns
    -------
    position_m, position_cov_m2 : (m, 2), (m, 2, 2)
    """
    node, share = _bracket(posterior, t_s)
    q_m2 = motion_variance(posterior.problem, posterior.noise)[node]
    f = share[:, None, None]
    own = posterior.node_cov[:, :2, :2]
    cov_m2 = (1 - f) * own[node] + f * own[node + 1]
    cov_m2 += (f * (1 - f)) * q_m2[:, None, None] * np.eye(2)
    return _place(posterior, t_s, node, share), cov_m2


def heading_error(posterior: Posterior, t_s: Float, heading_rad: Float) -> Float:
    """What the compass reads too much (m,) rad, at instants and what it reads then."""
    node, share = _bracket(posterior, t_s)
    slow_rad = _between(posterior, HEADING, node, share)
    return np.asarray(slow_rad + posterior.states.deviation(heading_rad))


def sound_scale(posterior: Posterior, t_s: Float) -> Float:
    """Sound speed used over the true one, less one (m,)."""
    node, share = _bracket(posterior, t_s)
    slow = _between(posterior, SOUND, node, share)
    return np.asarray(slow + posterior.states.constant[SOUND_SCALE])


def _bracket(posterior: Posterior, t_s: Float) -> tuple[Int, Float]:
    """Node before each instant and the share of the interval since."""
    knots_s = posterior.problem.t_node_s
    node = np.clip(np.searchsorted(knots_s, t_s, side="right") - 1, 0, len(knots_s) - 2)
    share = (t_s - knots_s[node]) / (knots_s[node + 1] - knots_s[node])
    return node, np.clip(share, 0.0, 1.0)


def _between(posterior: Posterior, state: int, node: Int, share: Float) -> Float:
    return blend(posterior.states.node[:, state], node, node + 1, share)


def _place(posterior: Posterior, t_s: Float, node: Int, share: Float) -> Float:
    """Dead reckoning since the node, its miss of the next node spread over the interval."""
    problem, states = posterior.problem, posterior.states
    knots_s, n = problem.t_node_s, len(problem.t_node_s) - 1
    whole = _reckoned(posterior, knots_s[1:], np.arange(n), np.ones(n))
    position = plane(states.node[:, :2])
    miss = position[1:] - position[:-1] - whole
    place = position[node] + _reckoned(posterior, t_s, node, share) + share * miss[node]
    return pairs(place)


def _reckoned(posterior: Posterior, t_s: Float, node: Int, share: Float) -> np.ndarray:
    """Displacement (m,) since the node before, its errors those of half the way."""
    problem, constant = posterior.problem, posterior.states.constant
    run = problem.offsets.since(t_s, node)
    half = 0.5 * share
    error_rad = _between(posterior, HEADING, node, half)
    error_rad = error_rad + posterior.states.deviation(run.heading_rad)
    forward, starboard, east, north = (
        _between(posterior, state, node, half)
        for state in (FORWARD, STARBOARD, CURRENT_EAST, CURRENT_NORTH)
    )
    # In real numbers: a complex product's last bit depends on how many there are.
    ahead_e, ahead_n = run.ahead.real, run.ahead.imag
    run_e = run.displacement.real - (forward * ahead_e + starboard * ahead_n)
    run_n = run.displacement.imag - (forward * ahead_n - starboard * ahead_e)
    cos, sin = np.cos(error_rad), np.sin(error_rad)
    scale = 1 + constant[SCALE]
    moved_e = (cos * run_e - sin * run_n) / scale + east * run.duration_s
    moved_n = (sin * run_e + cos * run_n) / scale + north * run.duration_s
    return np.asarray(moved_e + 1j * moved_n)
