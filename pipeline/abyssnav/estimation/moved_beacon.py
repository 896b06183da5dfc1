# SPDX-License-Identifier: Apache-2.0
"""A beacon that was moved during the dive: from an instant on it is another one, elsewhere."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_problem import Problem
from abyssnav.estimation.dive_states import DRIFT_NAMES, N_BEACON, N_COMMON, DiveStates
from abyssnav.estimation.left_out import leave_beacons_out
from abyssnav.estimation.map_estimator import (
    GATE,
    STATED_NOISE,
    MapEstimate,
    Setting,
    estimate_map,
)
from abyssnav.estimation.observations import Observations, observe
from abyssnav.tables import Float, Int

#: Sigma of each axis of how far a beacon was moved.
_MOVED_M = 30.0
#: Replies before and after that tell a move.
_LEAST_REPLIES = 8
#: A step is suspected where a beacon's residuals have one of so many nats, or where the estimate
#: had to take beacons or sound for so many times worse than stated,
_STEP, _WORSE_BEACONS, _WORSE_SOUND = 6.0, 2.0, 1.5
_SOUND = DRIFT_NAMES.index("slow_sound_scale")
#: and tried where the track made without the beacon shows one, of so many nats.
_STEP_LEFT_OUT = 15.0
#: Instants at which a step is looked for, first over the dive, then about the best of them.
_INSTANTS = 40
#: Beacons that are tried, the largest step first.
_TRIED = 2
#: One dive in four hundred has a beacon moved, at any of so many instants.
LOG_PRIOR = -6.0 - float(np.log(2 * _INSTANTS))
#: Estimates at most, each with the beacon moved from where the one before fits its replies best.
_SEARCHES = 3


class Moved(NamedTuple):
    """An estimate in which the replies of one beacon, from one instant on, are another's."""

    setting: Setting  #: its last beacon is the moved one
    estimate: MapEstimate
    beacon: int  #: row of the beacon
    since_s: float  #: its first reply from the other place


class _Step(NamedTuple):
    gain: float
    beacon: int
    reply: int  #: row of the first reply after it


def move_beacon(setting: Setting, estimate: MapEstimate) -> Moved | None:
    """The likeliest estimate with one beacon moved, where anything speaks for that.

    All replies of a beacon together tell a place that is wrong, and learned noise hides it; a step
    in time they tell only where the others make the track. So each beacon is left out, and where
    its replies then have a step, those after it are given to a beacon of their own, whose place is
    anywhere within tens of metres. The marginal likelihood pays for the new constants, and nothing
    suspicious may be left: times that err slowly have steps too.
    """
    plain = estimate_map(setting, estimate.states, schedule=STATED_NOISE)
    missed_s, sigma_s = leave_beacons_out(setting, plain)
    steps = [_largest_step(setting, plain, missed_s / sigma_s, k) for k in _beacons(setting)]
    likeliest = sorted(steps, reverse=True)[:_TRIED]
    tried = [
        _moved(setting, plain.states, step) for step in likeliest if step.gain > _STEP_LEFT_OUT
    ]
    explained = [moved for moved in tried if not is_suspicious(moved.setting, moved.estimate)]
    return max(explained, key=lambda moved: moved.estimate.log_likelihood, default=None)


def _beacons(setting: Setting) -> range:
    return range(setting.problem.n_beacons)


def is_suspicious(setting: Setting, estimate: MapEstimate) -> bool:
    """Whether beacons or sound were learned to be bad, or a beacon's residuals have a step."""
    noise, prior = estimate.noise, setting.prior
    worse = noise.constant_sigma[N_COMMON:] / prior.constant_sigma[N_COMMON:]
    sound = noise.drift_sigma[:, _SOUND] / prior.drift_sigma[:, _SOUND]
    if worse.max(initial=1.0) > _WORSE_BEACONS or sound.max() > _WORSE_SOUND:
        return True
    return any(_step_of_kept(setting, estimate, k) > _STEP for k in _beacons(setting))


def _step_of_kept(setting: Setting, estimate: MapEstimate, beacon: int) -> float:
    """Largest gain n₁ n₂ / 2 n (m₁ - m₂)² of two means over one, over all instants."""
    n = setting.problem.n_times
    kept = (setting.problem.group[:n] == beacon) & (estimate.weight[:n] > 0.5)
    residual = estimate.residual[:n][kept]
    if len(residual) < 2 * _LEAST_REPLIES:
        return 0.0
    before = np.arange(_LEAST_REPLIES, len(residual) - _LEAST_REPLIES + 1)
    excess = np.cumsum(residual - residual.mean())[before - 1]
    return float(np.max(0.5 * excess**2 * len(residual) / (before * (len(residual) - before))))


def _largest_step(setting: Setting, plain: MapEstimate, missed: Float, beacon: int) -> _Step:
    """The instant at which a beacon's misses (n,), over their sigma, have their largest step."""
    n = setting.problem.n_times
    rows = np.flatnonzero((setting.problem.group[:n] == beacon) & plain.taking_part[:n])
    missed = missed[rows]
    least, most = _LEAST_REPLIES, len(rows) - _LEAST_REPLIES
    best = _Step(0.0, beacon, 0)
    if most <= least:
        return best
    whole = _spread(missed)
    for _ in range(2):
        instants = np.unique(np.linspace(least, most, _INSTANTS).astype(int)).tolist()
        gains = [0.5 * (whole - _spread(missed[:i]) - _spread(missed[i:])) for i in instants]
        first = int(np.argmax(gains))
        best = max(best, _Step(gains[first], beacon, int(rows[instants[first]])))
        least, most = instants[max(first - 1, 0)], instants[min(first + 1, len(instants) - 1)]
    return best


def _spread(missed: Float) -> float:
    """Sum of squares about the median, of each no more than what has half weight."""
    return float(np.minimum((missed - np.median(missed)) ** 2, GATE).sum())


def _moved(setting: Setting, start: DiveStates, step: _Step) -> Moved:
    """The estimate with a beacon moved, from where on that fits its replies best."""
    reply = step.reply
    for _ in range(_SEARCHES):
        parted = _parted(setting, step.beacon, reply)
        constant = np.zeros(len(parted.prior.constant_sigma))
        estimate = estimate_map(parted, start._replace(constant=constant))
        before, reply = reply, _best_instant(parted, estimate, step.beacon)
        if reply == before:
            break
    return Moved(parted, estimate, step.beacon, _reply_time(parted.problem, before))


def _best_instant(parted: Setting, estimate: MapEstimate, beacon: int) -> int:
    """First reply of a beacon that its other place fits better, all those after it together."""
    problem, n = parted.problem, parted.problem.n_times
    last = problem.n_beacons - 1
    rows = np.flatnonzero(np.isin(problem.group[:n], (beacon, last)))
    first, second = (
        np.minimum((_residual(problem, k, estimate.states)[rows] / sigma) ** 2, GATE)
        for k, sigma in ((k, estimate.noise.observation_sigma[k]) for k in (beacon, last))
    )
    before = np.arange(_LEAST_REPLIES, len(rows) - _LEAST_REPLIES + 1)
    return int(rows[before[np.argmin(np.cumsum(first - second)[before - 1])]])


def _residual(problem: Problem, beacon: int, states: DiveStates) -> Float:
    """Residuals (n,) s of all times as if one beacon had sent them."""
    every = np.full(problem.n_times, beacon)
    return observe(_sent_by(problem, every), states).residual[: problem.n_times]


def _sent_by(problem: Problem, beacon: Int) -> Observations:
    """The dive's observations, its times (n,) given to other beacons."""
    observations = problem.observations
    return observations._replace(times=replace(observations.times, beacon=beacon))


def _reply_time(problem: Problem, reply: int) -> float:
    node = problem.observations.times.node[reply]
    return float(problem.t_node_s[node] + problem.observations.reply.duration_s[reply])


def _parted(setting: Setting, beacon: int, reply: int) -> Setting:
    """The same dive with a beacon's replies from one on given to a further beacon."""
    problem, prior = setting.problem, setting.prior
    n, last = problem.n_times, problem.n_beacons
    group = np.where(problem.group == last, last + 1, problem.group)
    group[reply:n][group[reply:n] == beacon] = last
    own = N_COMMON + N_BEACON * beacon
    constants = np.append(np.full(3, _MOVED_M), prior.constant_sigma[own + 3])
    return setting._replace(
        problem=problem._replace(
            observations=_sent_by(problem, group[:n]), group=group, n_beacons=last + 1
        ),
        prior=prior._replace(
            observation_sigma=np.insert(
                prior.observation_sigma, last, prior.observation_sigma[beacon]
            ),
            constant_sigma=np.append(prior.constant_sigma, constants),
        ),
        stated=np.append(setting.stated, False),
    )
