# SPDX-License-Identifier: Apache-2.0
"""Real-time multiple-model filter: a bank of EKFs, started and recovered by MSAC consensus."""

from collections import deque
from dataclasses import dataclass, field
from math import hypot, inf, log, pi
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_states import (
    DRIFT_GROUP,
    DRIFTS,
    FORWARD,
    HEADING,
    N_BEACON,
    N_COMMON,
    N_NODE,
    OFFSET,
    SOUND_SCALE,
    STARBOARD,
)
from abyssnav.estimation.filter_bank import Motion, move, observe_times, refer_to_first
from abyssnav.estimation.filter_events import StepsMaker
from abyssnav.estimation.filter_history import (
    N_KEPT,
    Annotations,
    Block,
    FilterHistory,
    FilterHistoryBuilder,
    Filters,
    mixed_covariance,
    state_after,
    weights,
)
from abyssnav.estimation.filter_problem import KnownStart, Problem
from abyssnav.estimation.kalman import (
    associated,
    condition,
    correct,
    corrections,
    inverse_of_pairs,
    joint_innovations,
    predict,
    update,
    update_pair,
)
from abyssnav.estimation.start_search import Beginning, find_beginnings, recovery
from abyssnav.estimation.two_state import ACCEPTED, DUPLICATE, GATED
from abyssnav.tables import Bool, Float, Int, Start

#: Replies are linearised anew where one moves or turns the leader so far.
_FAR_M, _FAR_RAD = 3.0, 0.05
#: Old evidence weighs less on which filter is right: an error may begin at any time.
_FORGET_S = 1800.0
#: No filter counts as further behind the leader than this (nats), so that it leads soon after the
#: onset of what it supposes: one in a thousand, which costs a dive without errors nothing.
_IN_PLAY = 7.0
#: A filter this far behind in likelihood (nats), and so many sigma away, takes the leader's state.
_BEHIND, _AWAY = 25.0, 3.0
#: Share of wrong replies at first, and the density of their times (1/s) and of wrong fixes (1/m²):
#: the other explanation of each, by which it is right with a probability only.  Echoes are late:
#: what comes earlier than the straight way allows says rather that the place is wrong.
_WRONG, _LATE_PER_S, _EARLY_PER_S, _WRONG_PER_M2 = 0.1, 5.0, 1.0, 1e-3
#: A start is sought anew when the leader refused so many of the last replies, not too soon again.
_RECENT, _REFUSED, _PATIENCE = 10, 5, 8
#: Two mirrored starts are told apart by this ratio of the replies' likelihoods.
SIDES_RATIO = 1e6
#: Replies of a beacon over which the share of wrong ones is averaged, and accepted ones over which
#: its noise is; the variance ratio from which on that counts, and the largest one.
_WRONG_MEMORY, _MEMORY, _NOTABLE, _MOST = 15, 40, 1.5, 25.0
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
    evidence: Float  #: (h,) log likelihood, forgotten over `_FORGET_S`; none is far behind
    raised: Float  #: (h,) of that, what keeps a filter in play
    noise_ratio: Float  #: (h, b + 1) variance of each beacon's times over the stated; of fixes
    wrong: Float  #: (h, b) share of each beacon's times that are wrong
    taken: dict[tuple[int, int], Bool] = field(default_factory=dict)  #: (ping, beacon) -> (h,)
    latest: deque[bool] = field(default_factory=lambda: deque(maxlen=_RECENT))
    since_reset: int = 0
    segment: int = 0


def track(problem: Problem, known: KnownStart | None = None) -> Tracked:
    """Run a bank of filters over all travel times and position fixes, in the order heard.

    It starts at a known start, at a confirmed position fix or where consensus of single travel
    times is accepted, whichever comes first.  Each of the filters has priors and a gate of its own;
    what they know is mixed by the likelihood of their innovations (static multiple-model
    estimation after D. Magill, IEEE Trans. Automatic Control 10 (1965), with forgetting), and none
    ever counts for nothing, for which one is right may change (M. Herbster and M. Warmuth,
    "Tracking the best expert", Machine Learning 32, 1998).  When the likeliest one refuses half of
    the last ten replies, consensus is asked again; positions are then set anew while what was
    learned of the sensors is kept.

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


class _Run(NamedTuple):
    """A bank on its way through a dive's events."""

    problem: Problem
    bank: _Bank
    history: FilterHistoryBuilder
    steps: StepsMaker  #: to each of the m events
    events: _EventOrder  #: those after the beginning
    stated_s2: Float  #: (h,) variance of a travel time, by each filter's prior
    remembered: list[float]  #: factor on the evidence, to each event from the one before


def _run(problem: Problem, order: _EventOrder, beginning: Beginning) -> FilterHistory:
    """The bank from one beginning to the dive's end."""
    bank = _begin(problem, beginning)
    builder = FilterHistoryBuilder(len(problem.times.t_s), len(problem.positions.t_s))
    first = int(np.searchsorted(order.t_s, beginning.t_s, side="right"))
    before = order.row[:first][~order.is_position[:first]]
    if beginning.of_replies:
        times = problem.times
        for key in zip(times.ping[before].tolist(), times.beacon[before].tolist(), strict=True):
            bank.taken[key] = np.ones(len(bank.x), dtype=bool)
    begin_s = np.array([beginning.t_s])
    now = Annotations(begin_s, np.zeros(1, dtype=int), np.zeros(1))
    builder.add(*_present(problem, bank), now)
    events = _EventOrder(order.t_s[first:], order.is_position[first:], order.row[first:])
    if len(events.t_s):
        steps = StepsMaker(problem.sums, np.concatenate([begin_s, events.t_s]), problem.priors)
        stated_s2 = problem.priors.time_noise_s**2
        since_s = np.diff(events.t_s, prepend=events.t_s[0])
        remembered = np.exp(-since_s / _FORGET_S).tolist()
        _take_all(_Run(problem, bank, builder, steps, events, stated_s2, remembered))
    return builder.history()


def _take_all(run: _Run) -> None:
    """Every position fix alone, travel times in blocks, as far as they do not change much."""
    is_position, m = run.events.is_position, len(run.events.t_s)
    alone = run.steps.begins_anew() | is_position
    alone[1:] |= is_position[:-1]
    ends = np.append(np.flatnonzero(alone), m)
    late_s = run.events.t_s + run.steps.longest_s
    reach = np.minimum(np.arange(m) + run.problem.block, np.searchsorted(run.events.t_s, late_s))
    ends = np.minimum(reach, ends[np.searchsorted(ends, np.arange(m), side="right")])
    i = 0
    while i < m:
        if is_position[i]:
            _take_position(run, i)
            i += 1
        else:
            i += _take_times(run, slice(i, int(ends[i])))


def _step_to(run: _Run, i: int, k: int) -> Motion:
    """The bank at event i, and what it predicts of the k - 1 after it."""
    bank = run.bank
    _recover_lost_filters(run.problem, bank)
    motion = move(bank.x, *run.steps.rows(i, k))
    predict(bank.P, motion.to_first)
    bank.P[:, :N_NODE, :N_NODE] += motion.first_noise
    bank.x = motion.x[:, 0].copy()
    return motion


def _take_times(run: _Run, rows: slice) -> int:
    """Travel times of some events, linearised together, one after the other; how many were taken.

    Fewer than all where a filter has moved so far that they should be linearised anew.
    """
    problem, first = run.problem, int(run.events.row[rows.start])
    k = rows.stop - rows.start
    motion = _step_to(run, rows.start, k)
    events = problem.times.row(slice(first, first + k))
    prediction = observe_times(motion.x, events)
    H = refer_to_first(prediction, motion.transition)
    late_s = events.flight_time_s - prediction.time_s
    joint = joint_innovations(run.bank.P, H, motion.noise, late_s)
    weight = weights(_score(problem, run.bank))
    share = np.zeros(late_s.shape)
    block = Block(run.bank.P, motion.noise, joint, share, motion.transition, weight)
    judged = _judge(run, motion.x, block, rows)
    _update_bank(run, motion.x, block, judged, rows)
    return judged.n


class _Judged(NamedTuple):
    """What became of the n first travel times of a block of k."""

    n: int
    score: Float  #: (k, h)
    evidence: Float  #: (n,) log likelihood beforehand
    beginning: Beginning | None  #: where the replies agree, if the last one shows that elsewhere


def _judge(run: _Run, x: Float, block: Block, rows: slice) -> _Judged:
    """Judge travel times one by one, each with what those before it told; fills in the shares.

    Parameters
    ----------
    x : (h, k, N) states as predicted from those before the block
    """
    problem, bank, joint, share = run.problem, run.bank, block.joint, block.share
    (h, k), first = share.shape, int(run.events.row[rows.start])
    score, beginning = np.zeros((k, h)), None
    before, likelihood = np.zeros((k, h)), np.ones((k, h))
    n = 0
    for j, row in enumerate(range(first, first + k)):
        _forget(run, rows.start + j)
        before[j] = _score(problem, bank)
        leader = int(before[j].argmax())
        met = _Met(row, leader, joint[:, j, -1], joint[:, j, j])
        share[:, j], joint[:, j, -1], likelihood[j] = _judge_time(run, met)
        score[j] = _keep_in_play(problem, bank)
        n = j + 1
        if n < k:
            condition(joint, j, share[:, j])
        if _asks(run, row):
            beginning = recovery(problem, *state_after(block, x, int(score[j].argmax()), j), row)
        if beginning is not None or _moves_far(joint[leader, j, k:], share[leader, j]):
            break
    evidence = np.log((weights(before) * likelihood).sum(axis=1))
    return _Judged(n, score, evidence[:n], beginning)


def _moves_far(row: Float, share: float) -> bool:
    """Whether a filter is moved or turned so far that what follows is to be linearised anew."""
    gain = float(share * row[-1])
    turned = abs((row[HEADING] + row[N_NODE + OFFSET]) * gain)
    return bool(hypot(row[0], row[1]) * abs(gain) > _FAR_M or turned > _FAR_RAD)


def _update_bank(run: _Run, x: Float, block: Block, judged: _Judged, rows: slice) -> None:
    """The bank after the judged times of a block, and its history of them."""
    bank, last, step = run.bank, judged.n - 1, block.transition
    weight = weights(judged.score)
    within = mixed_covariance(block, weight)
    correct(x, step, corrections(block.joint, block.share))
    update(bank.P, block.joint, block.share)
    bank.P[:, :N_NODE, :N_NODE] += block.noise[:, last]
    predict(bank.P, step.row(last))
    bank.x = x[:, last].copy()
    segment = np.full(judged.n, bank.segment)
    if judged.beginning is not None:
        _reset(run.problem, bank, judged.beginning)
        now, within[last] = _present(run.problem, bank)
        x[:, last], weight[last] = now.x[:, 0], now.weight[0]
        segment[last] = bank.segment
    t_s = run.events.t_s[rows.start : rows.start + judged.n]
    filters = Filters(x, weight)
    run.history.add(filters, within, Annotations(t_s, segment, judged.evidence))


def _present(problem: Problem, bank: _Bank) -> tuple[Filters, Float]:
    """The filters as they are, and the mean (1, 15, 15) of their covariances."""
    weight = weights(_score(problem, bank)[None])
    flat = bank.P[:, :N_KEPT, :N_KEPT].reshape(len(bank.P), -1)
    mean = (weight @ flat).reshape(1, N_KEPT, N_KEPT)
    return Filters(bank.x[:, None], weight), mean


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
        variance[:, slow] = np.maximum(variance[:, slow], held_mps[:, None] ** 2)
    P[:, range(n), range(n)] = variance
    known = [0, 1, N_NODE + SOUND_SCALE][: len(beginning.x)]
    x[:, known] = beginning.x
    P[:, np.array(known)[:, None], known] = beginning.cov
    _turn_about(P, beginning.run, N_NODE + OFFSET)
    n_beacons = (n_constants - N_COMMON) // N_BEACON
    return _Bank(
        x, P, np.zeros(h), np.zeros(h), np.ones((h, n_beacons + 1)), np.full((h, n_beacons), _WRONG)
    )


def _turn_about(P: Float, run: complex, offset: int) -> None:
    """Add what the heading offset does to a place that lies at the end of some dead reckoning.

    p = middle + e^{iδ} run:    ∂p/∂δ = i run
    """
    J, variance = np.array([-run.imag, run.real]), P[:, offset, offset]
    P[:, :2, :2] += variance[:, None, None] * np.outer(J, J)
    P[:, :2, offset] += variance[:, None] * J
    P[:, offset, :2] += variance[:, None] * J


def _forget(run: _Run, i: int) -> None:
    """Let the evidence from before event i weigh less."""
    run.bank.evidence *= run.remembered[i]
    run.bank.raised *= run.remembered[i]


def _score(problem: Problem, bank: _Bank) -> Float:
    """Log probability (h,) of each filter, but for a constant."""
    return problem.priors.log_prior + bank.evidence


class _Met(NamedTuple):
    """A travel time as the h filters meet it."""

    row: int
    leader: int  #: the likeliest filter
    innovation_s: Float  #: (h,)
    track_s2: Float  #: (h,) variance of the innovation, without the time's own


def _judge_time(run: _Run, met: _Met) -> tuple[Float, Float, Float | float]:
    """Judge one travel time: share and innovation (h,) that count, and its likelihood (h,).

    It counts as far as it is probably right, also where the gate refuses it: one that is refused
    for certain, after a wrong one was let in by chance, would keep a filter where it is.
    """
    problem, bank, gate = run.problem, run.bank, run.problem.gate
    row, leader, innovation_s, track_s2 = met
    beacon, ping = int(problem.times.beacon[row]), int(problem.times.ping[row])
    noise_s2 = _noise(bank, beacon) * run.stated_s2
    variance_s2, square_s2 = track_s2 + noise_s2, innovation_s**2
    nis = square_s2 / variance_s2
    inside, taken = nis <= gate.gamma, bank.taken.get((ping, beacon))
    duplicate = taken is not None and bool(taken[leader])
    use = inside if taken is None else inside & ~taken
    bank.taken[ping, beacon] = use if taken is None else taken | use
    wrong = bank.wrong[:, beacon]
    wrong_per_s = np.where(innovation_s < 0.0, _EARLY_PER_S, _LATE_PER_S)
    likelihood, right = _belief(nis, 2 * pi * variance_s2, (wrong, wrong_per_s))
    if not duplicate:
        bank.evidence += np.log(likelihood)
        wrong += (1 - right - wrong) / _WRONG_MEMORY
    if gate.huber < inf:
        huber_s2 = _huber_noise(innovation_s, track_s2, noise_s2, gate.huber)
        share, counted_s = use / (track_s2 + huber_s2), innovation_s
    else:
        right = right if taken is None else np.where(taken, 0.0, right)
        share, counted_s = associated(right, nis, (innovation_s, variance_s2))
    # Average of (ν² - H P Hᵀ) / R over the accepted; not while H P Hᵀ exceeds R.
    _learn_ratio(bank, beacon, (square_s2 - track_s2) / run.stated_s2, use & (track_s2 <= noise_s2))
    decision = DUPLICATE if duplicate else ACCEPTED if inside[leader] else GATED
    late_s = float(innovation_s[leader])
    run.history.times[row] = (
        problem.times.flight_time_s[row] - late_s, variance_s2[leader], late_s, noise_s2[leader]
    )  # fmt: skip
    run.history.time_decision[row] = decision
    bank.latest.append(decision == GATED)
    bank.since_reset += 1
    return share, counted_s, 1.0 if duplicate else likelihood


def _take_position(run: _Run, i: int) -> None:
    """Judge one position fix, take it in where it is believed."""
    _step_to(run, i, 1)
    problem, bank, history = run.problem, run.bank, run.history
    _forget(run, i)
    evidence = _update_by_position(problem, bank, history, int(run.events.row[i]))
    _keep_in_play(problem, bank)
    now = Annotations(run.events.t_s[i : i + 1], np.array([bank.segment]), np.array([evidence]))
    history.add(*_present(problem, bank), now)


def _update_by_position(
    problem: Problem, bank: _Bank, builder: FilterHistoryBuilder, row: int
) -> float:
    """Judge one position fix, take it in where it is believed; log likelihood beforehand."""
    ratio = _noise(bank, -1)
    measured = problem.positions.position[row]
    innovation_m = np.column_stack([measured.real - bank.x[:, 0], measured.imag - bank.x[:, 1]])
    noise_m2 = ratio[:, None, None] * problem.positions.cov_m2[row]
    cov_m2 = bank.P[:, :2, :2] + noise_m2
    inverse, determinant = inverse_of_pairs(cov_m2)
    nis = (innovation_m * (inverse @ innovation_m[:, :, None])[:, :, 0]).sum(axis=1)
    use = nis <= problem.gate.position_gamma
    weight = weights(_score(problem, bank))
    leader = int(np.argmax(weight))
    likelihood, right = _belief(nis, (2 * pi) ** 2 * determinant, (_WRONG, _WRONG_PER_M2))
    bank.evidence += np.log(likelihood)
    builder.position_m[row], builder.position_cov_m2[row] = innovation_m[leader], cov_m2[leader]
    builder.position_noise_m2[row] = noise_m2[leader]
    builder.position_decision[row] = ACCEPTED if use[leader] else GATED
    update_pair(bank.x, bank.P, inverse, innovation_m, right)
    stated = np.trace(problem.positions.cov_m2[row])
    track_m2 = np.trace(cov_m2 - noise_m2, axis1=1, axis2=2)
    square_m2 = (innovation_m**2).sum(axis=1)
    _learn_ratio(bank, -1, (square_m2 - track_m2) / stated, use & (track_m2 < ratio * stated))
    return log(float(weight @ likelihood))


def _belief(
    nis: Float, determinant: Float, wrong: tuple[Float | float, Float | float]
) -> tuple[Float, Float]:
    """Density (h,) of a measurement, normal or else wrong, and how probably it is not wrong.

    Parameters
    ----------
    determinant : (h,) of the covariance of as many times 2 π as there are numbers
    wrong : with which probability it is, and with which density then
    """
    share, wrong_density = wrong
    otherwise = share * wrong_density
    density = (1 - share) * np.exp(-0.5 * nis) / np.sqrt(determinant) + otherwise
    return density, 1 - otherwise / density


def _noise(bank: _Bank, column: int) -> Float:
    """Variance (h,) of a beacon's times, of fixes, over the stated: no less, only where notable."""
    ratio = bank.noise_ratio[:, column]
    return np.where(ratio > _NOTABLE, ratio, 1.0)


def _learn_ratio(bank: _Bank, column: int, square: Float, use: Bool) -> None:
    ratio = bank.noise_ratio[:, column]
    ratio += use * (square - ratio) / _MEMORY
    np.minimum(ratio, _MOST, out=ratio)


def _huber_noise(innovation_s: Float, track_s2: Float, noise_s2: Float, kappa: float) -> Float:
    """Variance (h,) R max(1, |r| / κ√R) with r what the update leaves (P. Huber, 1964)."""
    left_s, widened_s2 = innovation_s, noise_s2
    for _ in range(_HUBER_PASSES):
        widened_s2 = noise_s2 * np.maximum(1.0, np.abs(left_s) / np.sqrt(noise_s2) / kappa)
        left_s = innovation_s * widened_s2 / (track_s2 + widened_s2)
    return widened_s2


def _asks(run: _Run, row: int) -> bool:
    """Whether a start is sought anew, at the first reply of a ping."""
    bank, ping = run.bank, run.problem.times.ping
    if not run.problem.recover or bank.since_reset < _PATIENCE or sum(bank.latest) < _REFUSED:
        return False
    return row > 0 and bool(ping[row] != ping[row - 1])


def _keep_in_play(problem: Problem, bank: _Bank) -> Float:
    """The filters' scores (h,), none so far behind that it could not lead once it is right."""
    score = _score(problem, bank)
    missing = np.maximum((score.max() - _IN_PLAY) - score, 0.0)
    bank.evidence += missing
    bank.raised += missing
    return np.asarray(score + missing)


def _recover_lost_filters(problem: Problem, bank: _Bank) -> None:
    """Give filters that are lost the state of the one that leads now, however short a time."""
    score = _score(problem, bank)
    leader, earned = int(score.argmax()), score - bank.raised
    behind = np.flatnonzero(earned < earned.max() - _BEHIND)
    if len(behind):
        apart_m = bank.x[behind, :2] - bank.x[leader, :2]
        variance_m2 = bank.P[behind, 0, 0] + bank.P[behind, 1, 1]
        lost = behind[(apart_m**2).sum(axis=1) > _AWAY**2 * variance_m2]
        bank.x[lost], bank.P[lost] = bank.x[leader], bank.P[leader]


def _reset(problem: Problem, bank: _Bank, beginning: Beginning) -> None:
    """Set positions anew; what was learned of the sensors stays, but for a refuted sound speed."""
    if beginning.fresh:
        new = _begin(problem, beginning)
        bank.x[:], bank.P[:] = new.x, new.P
    places = [0, 1, N_NODE + SOUND_SCALE][: len(beginning.x)]
    bank.x[:, places] = beginning.x
    bank.P[:, places, :] = 0.0
    bank.P[:, :, places] = 0.0
    bank.P[:, np.array(places)[:, None], places] = beginning.cov
    bank.evidence[:], bank.raised[:] = 0.0, 0.0
    bank.segment, bank.since_reset = bank.segment + 1, 0
