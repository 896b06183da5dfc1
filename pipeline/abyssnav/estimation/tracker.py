# SPDX-License-Identifier: Apache-2.0
"""Real-time multiple-model filter: a bank of EKFs, started and recovered by MSAC consensus."""

from collections import deque
from dataclasses import dataclass, field
from math import exp, hypot, inf, log, pi, sqrt
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_states import (
    DRIFT_GROUP,
    DRIFTS,
    FORWARD,
    N_BEACON,
    N_COMMON,
    N_NODE,
    SOUND_SCALE,
    STARBOARD,
)
from abyssnav.estimation.filter_bank import observe_time, predict
from abyssnav.estimation.filter_events import (
    Held,
    held_over,
    transitions,
)
from abyssnav.estimation.filter_history import (
    FilterHistory,
    FilterHistoryBuilder,
    weights,
)
from abyssnav.estimation.filter_problem import KnownStart, Problem
from abyssnav.estimation.kalman import update_pair, update_scalar
from abyssnav.estimation.start_search import Beginning, find_beginnings, recovery
from abyssnav.estimation.two_state import ACCEPTED, DUPLICATE, GATED
from abyssnav.tables import Bool, Float, Int, Start

#: Transition matrices of so many steps are made at once: what a cache holds.
_CHUNK = 256
#: What was seen long ago weighs less on which filter is right: an error may begin at any time.
_FORGET_S = 1800.0
#: A filter this far behind in likelihood (nats), and so many sigma away, takes the leader's state.
_BEHIND, _AWAY = 25.0, 3.0
#: Share of wrong replies, and the density of their times (1/s) and of wrong fixes (1/m²): what
#: explains a reply that a filter's gate refuses.
_WRONG, _WRONG_PER_S, _WRONG_PER_M2 = 0.1, 5.0, 1e-3
#: A start is sought anew when the leader refused so many of the last replies, not too soon again.
_RECENT, _REFUSED, _PATIENCE = 10, 5, 8
#: Two mirrored starts are told apart by this ratio of the replies' likelihoods.
SIDES_RATIO = 1e6
#: Accepted replies over which a beacon's noise is averaged; and when that counts (Noise below).
_MEMORY, _NOTABLE, _MOST = 40, 1.5, 25.0
_HUBER_PASSES = 6


class Tracked(NamedTuple):
    """What the bank made of a dive."""

    history: FilterHistory | None  #: None without a start
    start: Start | None
    sides: tuple[Start, ...] = ()  #: the two mirrored starts, where two beacons leave both open
    log_ratio: float = 0.0  #: of their likelihoods, nats


class _EventOrder(NamedTuple):
    """Events of both kinds in the order of time."""

    t_s: Float  #: (m,)
    is_position: Bool
    row: Int  #: of `Problem.times` or `Problem.positions`


@dataclass
class _Bank:
    """The filters and all that they remember."""

    x: Float  #: (h, N)
    P: Float  #: (h, N, N)
    evidence: Float  #: (h,) log likelihood, forgotten over `_FORGET_S`
    noise_ratio: Float  #: (h, b + 1) variance of each beacon's times over the stated; of fixes
    taken: dict[tuple[int, int], Bool] = field(default_factory=dict)  #: (ping, beacon) -> (h,)
    latest: deque[bool] = field(default_factory=lambda: deque(maxlen=_RECENT))
    since_reset: int = 0
    segment: int = 0


def track(problem: Problem, known: KnownStart | None = None) -> Tracked:
    """Run a bank of filters over all travel times and position fixes, in the order heard.

    It starts at a known start, at a confirmed position fix or where consensus of single travel
    times is accepted, whichever comes first.  Each of the filters has priors and a gate of its own;
    what they know is mixed by the likelihood of their innovations (static multiple-model
    estimation after D. Magill, IEEE Trans. Automatic Control 10 (1965), with forgetting).  When
    the likeliest one refuses half of the last ten replies, consensus is asked again; positions are
    then set anew while what was learned of the sensors is kept.

    Two beacons leave a start and its mirror in their line; both are followed, and the track begins
    where the replies' likelihood ratio exceeds a million.
    """
    order = _in_order(problem)
    beginnings = find_beginnings(problem, known)
    if not beginnings:
        return Tracked(None, None)
    histories = [_run(problem, order, beginning) for beginning in beginnings]
    if len(histories) == 1:
        return Tracked(histories[0], beginnings[0].start)
    return _likelier_side(histories, [beginning.start for beginning in beginnings])


def _likelier_side(histories: list[FilterHistory], starts: list[Start]) -> Tracked:
    """The side that the replies choose, from the instant on at which they have."""
    one, other = (history.nodes.evidence for history in histories)
    ratio = np.cumsum(one - other)
    decided = np.flatnonzero(np.abs(ratio) > log(SIDES_RATIO))
    if not len(decided):
        return Tracked(None, None, tuple(starts), float(ratio[-1]))
    row = int(decided[0])
    side = 0 if ratio[row] > 0 else 1
    history = histories[side]
    chosen = history._replace(nodes=history.nodes[row:])
    return Tracked(chosen, starts[side], tuple(starts), float(ratio[row]))


def _in_order(problem: Problem) -> _EventOrder:
    n, k = len(problem.times.t_s), len(problem.positions.t_s)
    t_s = np.concatenate([problem.times.t_s, problem.positions.t_s])
    order = np.argsort(t_s, kind="stable")
    rows = np.concatenate([np.arange(n), np.arange(k)])[order]
    return _EventOrder(t_s[order], order >= n, rows)


def _run(problem: Problem, order: _EventOrder, beginning: Beginning) -> FilterHistory:
    """The bank from one beginning to the dive's end."""
    bank = _begin(problem, beginning)
    shape = bank.x.shape[0], bank.x.shape[1]
    builder = FilterHistoryBuilder(shape, len(problem.times.t_s), len(problem.positions.t_s))
    first = int(np.searchsorted(order.t_s, beginning.t_s, side="right"))
    before = order.row[:first][~order.is_position[:first]]
    if beginning.of_replies:
        times = problem.times
        for key in zip(times.ping[before].tolist(), times.beacon[before].tolist(), strict=True):
            bank.taken[key] = np.ones(len(bank.x), dtype=bool)
    knots_s = np.append(beginning.t_s, order.t_s[first:])
    sums, held = problem.sums.interpolate(knots_s), held_over(problem.sums, knots_s, problem.priors)
    stretch = sums[1:].since(sums[:-1])
    builder.add(beginning.t_s, bank.x, bank.P, _score(problem, bank))
    row, is_position = order.row[first:].tolist(), order.is_position[first:].tolist()
    step = None
    for i in range(len(row)):
        if step is None or i % _CHUNK == 0:
            rows = slice(i, i + _CHUNK)
            lost = Held(held.code[rows], held.sigma_mps[rows])
            step = transitions(stretch.row(rows), lost, problem.priors)
        predict(bank.x, bank.P, stretch.row(i), step.row(i % _CHUNK))
        bank.evidence *= exp(-stretch.duration_s[i] / _FORGET_S)
        if is_position[i]:
            evidence = _update_by_position(problem, bank, builder, row[i])
        else:
            evidence = _update_by_time(problem, bank, builder, row[i])
        builder.add(float(knots_s[i + 1]), bank.x, bank.P, _score(problem, bank))
        builder.annotate(bank.segment, evidence)
    return builder.history()


def _begin(problem: Problem, beginning: Beginning) -> _Bank:
    """States and covariances at a beginning, under every hypothesis."""
    priors = problem.priors
    h, n_constants = priors.constant_sigma.shape
    n = N_NODE + n_constants
    x, P = np.zeros((h, n)), np.zeros((h, n, n))
    variance = np.zeros((h, n))
    variance[:, DRIFTS] = priors.drift_sigma[:, DRIFT_GROUP] ** 2
    variance[:, N_NODE:] = priors.constant_sigma**2
    t_s = np.array([beginning.t_s])
    if problem.sums.is_held(t_s)[0]:
        slow = slice(FORWARD, STARBOARD + 1)
        held_mps = problem.sums.held_sigma(t_s, priors)[0]
        variance[:, slow] = np.maximum(variance[:, slow], held_mps**2)
    P[:, range(n), range(n)] = variance
    known = [0, 1, N_NODE + SOUND_SCALE][: len(beginning.x)]
    x[:, known] = beginning.x
    P[:, np.array(known)[:, None], known] = beginning.cov
    n_beacons = (n_constants - N_COMMON) // N_BEACON
    return _Bank(x, P, np.zeros(h), np.ones((h, n_beacons + 1)))


def _score(problem: Problem, bank: _Bank) -> Float:
    """Log probability (h,) of each filter, but for a constant."""
    return problem.priors.log_prior + bank.evidence


def _update_by_time(
    problem: Problem, bank: _Bank, builder: FilterHistoryBuilder, row: int
) -> float:
    """Judge one travel time, take it in where it is believed; log likelihood of it beforehand."""
    times, gate = problem.times, problem.gate
    beacon, ping = int(times.beacon[row]), int(times.ping[row])
    noise_s2 = _noise(bank, beacon) * problem.priors.time_noise_s**2
    prediction = observe_time(bank.x, times, row)
    innovation_s = times.flight_time_s[row] - prediction.time_s
    PH = (bank.P @ prediction.H[:, :, None])[:, :, 0]
    track_s2 = (prediction.H * PH).sum(axis=1)
    variance_s2 = track_s2 + noise_s2
    nis = innovation_s**2 / variance_s2
    inside, taken = nis <= gate.gamma, bank.taken.get((ping, beacon))
    weight = weights(_score(problem, bank))
    leader = int(np.argmax(weight))
    duplicate = taken is not None and bool(taken[leader])
    use = inside if taken is None else inside & ~taken
    bank.taken[ping, beacon] = use if taken is None else taken | use
    evidence = 0.0
    if not duplicate:
        likelihood = _likelihood(nis, 2 * pi * variance_s2, _WRONG_PER_S)
        evidence = log(float(weight @ likelihood))
        bank.evidence += np.log(likelihood)
    if gate.huber < inf:
        _huber(problem, bank, row, noise_s2, use)
    else:
        update_scalar(bank.x, bank.P, (PH, variance_s2), innovation_s, use)
    _learn_noise(bank, beacon, innovation_s, (track_s2, noise_s2), use)
    decision = DUPLICATE if duplicate else ACCEPTED if inside[leader] else GATED
    builder.times[row] = [
        column[leader] for column in (prediction.time_s, variance_s2, innovation_s, noise_s2)
    ]
    builder.time_decision[row] = decision
    _recover_lost_filters(problem, bank, row, refused=decision == GATED)
    return evidence


def _update_by_position(
    problem: Problem, bank: _Bank, builder: FilterHistoryBuilder, row: int
) -> float:
    """Judge one position fix, take it in where it is believed; log likelihood beforehand."""
    ratio = _noise(bank, bank.noise_ratio.shape[1] - 1)
    measured = problem.positions.position[row]
    innovation_m = np.column_stack([measured.real - bank.x[:, 0], measured.imag - bank.x[:, 1]])
    noise_m2 = ratio[:, None, None] * problem.positions.cov_m2[row]
    cov_m2 = bank.P[:, :2, :2] + noise_m2
    weighted = np.linalg.solve(cov_m2, innovation_m[:, :, None])[:, :, 0]
    nis = (innovation_m * weighted).sum(axis=1)
    use = nis <= problem.gate.position_gamma
    weight = weights(_score(problem, bank))
    leader = int(np.argmax(weight))
    likelihood = _likelihood(nis, (2 * pi) ** 2 * np.linalg.det(cov_m2), _WRONG_PER_M2)
    bank.evidence += np.log(likelihood)
    builder.position_m[row], builder.position_cov_m2[row] = innovation_m[leader], cov_m2[leader]
    builder.position_noise_m2[row] = noise_m2[leader]
    builder.position_decision[row] = ACCEPTED if use[leader] else GATED
    update_pair(bank.x, bank.P, cov_m2, innovation_m, use)
    stated = np.trace(problem.positions.cov_m2[row])
    track_m2 = np.trace(cov_m2 - noise_m2, axis1=1, axis2=2)
    square_m2 = (innovation_m**2).sum(axis=1)
    _learn_ratio(bank, -1, (square_m2 - track_m2) / stated, use & (track_m2 < ratio * stated))
    return log(float(weight @ likelihood))


def _likelihood(nis: Float, determinant: Float, wrong_density: float) -> Float:
    """Density (h,) of a measurement: normal, or wrong in one case of ten."""
    return np.asarray((1 - _WRONG) * np.exp(-0.5 * nis) / np.sqrt(determinant)
                      + _WRONG * wrong_density)  # fmt: skip


def _noise(bank: _Bank, beacon: int) -> Float:
    """Variance (h,) of a beacon's times over the stated one: no less, and only where notable."""
    ratio = bank.noise_ratio[:, beacon]
    return np.where(ratio > _NOTABLE, ratio, 1.0)


def _learn_noise(
    bank: _Bank, beacon: int, innovation_s: Float, variance_s2: tuple[Float, Float], use: Bool
) -> None:
    """Average of (ν² - H P Hᵀ) / R over the accepted; not while the filter knows less than R."""
    track_s2, noise_s2 = variance_s2
    stated_s2 = noise_s2 / _noise(bank, beacon)
    square = (innovation_s**2 - track_s2) / stated_s2
    _learn_ratio(bank, beacon, square, use & (track_s2 <= noise_s2))


def _learn_ratio(bank: _Bank, column: int, square: Float, use: Bool) -> None:
    ratio = bank.noise_ratio[:, column]
    ratio[use] += (square[use] - ratio[use]) / _MEMORY
    np.minimum(ratio, _MOST, out=ratio)


def _huber(problem: Problem, bank: _Bank, row: int, noise_s2: Float, use: Bool) -> None:
    """Iterated update with Huber's weight 1 / max(1, |r| / κ) (P. Huber, 1964)."""
    x, prior = bank.x, bank.x.copy()
    measured_s = problem.times.flight_time_s[row]
    for last in range(1, _HUBER_PASSES + 1):
        prediction = observe_time(x, problem.times, row)
        late_s = measured_s - prediction.time_s
        PH = (bank.P @ prediction.H[:, :, None])[:, :, 0]
        weight = np.maximum(1.0, np.abs(late_s) / np.sqrt(noise_s2) / problem.gate.huber)
        variance_s2 = (prediction.H * PH).sum(axis=1) + noise_s2 * weight
        innovation_s = late_s + (prediction.H * (x - prior)).sum(axis=1)
        if last == _HUBER_PASSES:
            bank.x[:] = prior
            update_scalar(bank.x, bank.P, (PH, variance_s2), innovation_s, use)
        else:
            x = prior + PH * (use * innovation_s / variance_s2)[:, None]


def _recover_lost_filters(problem: Problem, bank: _Bank, row: int, *, refused: bool) -> None:
    """Bring back filters that are lost, at the first reply of every ping."""
    bank.latest.append(refused)
    bank.since_reset += 1
    if row == 0 or problem.times.ping[row] == problem.times.ping[row - 1]:
        return
    score = _score(problem, bank)
    leader = int(np.argmax(score))
    for other in np.flatnonzero(score < score[leader] - _BEHIND).tolist():
        apart = bank.x[other, :2] - bank.x[leader, :2]
        if hypot(*apart) > _AWAY * sqrt(bank.P[other, 0, 0] + bank.P[other, 1, 1]):
            bank.x[other], bank.P[other] = bank.x[leader], bank.P[leader]
    asked = problem.recover and bank.since_reset >= _PATIENCE
    if asked and sum(bank.latest) >= _REFUSED:
        beginning = recovery(problem, bank.x[leader], bank.P[leader], row)
        if beginning is not None:
            _reset(problem, bank, beginning)


def _reset(problem: Problem, bank: _Bank, beginning: Beginning) -> None:
    """Positions set anew; what was learned of the sensors stays, but for a refuted sound speed."""
    if beginning.fresh:
        new = _begin(problem, beginning)
        bank.x[:], bank.P[:] = new.x, new.P
    places = [0, 1, N_NODE + SOUND_SCALE][: len(beginning.x)]
    bank.x[:, places] = beginning.x
    bank.P[:, places, :] = 0.0
    bank.P[:, :, places] = 0.0
    bank.P[:, np.array(places)[:, None], places] = beginning.cov
    bank.evidence[:] = 0.0
    bank.segment, bank.since_reset = bank.segment + 1, 0
