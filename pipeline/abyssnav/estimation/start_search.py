# SPDX-License-Identifier: Apache-2.0
"""Initialization and recovery of the filter: a known start, position fixes or MSAC consensus."""

from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import NOMINAL_MPS
from abyssnav.estimation.dive_states import N_BEACON, N_COMMON, N_NODE, SOUND, SOUND_SCALE
from abyssnav.estimation.filter_bank import displace
from abyssnav.estimation.filter_history import sound_scale
from abyssnav.estimation.filter_problem import KnownStart, Problem
from abyssnav.estimation.initialization import (
    MsacResult,
    ReplyWindow,
    msac_localize,
    reply_window,
    scale_offsets,
)
from abyssnav.geometry import pairs
from abyssnav.tables import Float, Int, Start

_WINDOW = 24  #: replies that a consensus looks back on
#: Pings that a consensus looks back on, at the start and in a running filter.
_START_CYCLES, _RECOVERY_CYCLES = 10, 20
_LEARNED_ERROR = 0.02  #: dead reckoning's, as a share of the distance run, in a running filter
#: So many replies in the window that come early, by no more than this, say that the place is wrong
#: though most fit it: sound may take a longer way, but none that is shorter than the straight one.
_TOO_EARLY, _EARLY_S = 3, 0.2
#: A consensus so many sigmas of a start away is elsewhere, however little the filter knows.
_FARTHEST_REACH = 5.0
#: A position fix starts the filter once one of so many before it agrees within so many sigmas and
#: this share of what was run between; two consensuses agree within as large a share of it.
_CONFIRMING, _AGREEING, _RECKONING_ERROR = 4, 3.0, 0.05
#: A beacon with less than this share of the replies is not counted on.
_SELDOM = 0.02
#: Beacons lie in a line when none is farther from it than this share of their extent.
_IN_LINE = 0.05


class Beginning(NamedTuple):
    """A place from which a filter starts."""

    t_s: float
    start: Start
    x: Float  #: (2,) east, north; or (3,) with the sound-speed scale
    cov: Float  #: of these
    of_replies: bool = False  #: replies up to then are used up in it
    fresh: bool = False  #: what was learned until then is forgotten
    #: Dead reckoning since the middle of the replies that agree on it, m: an error of the heading
    #: turns the place about that middle.
    run: complex = 0.0


def find_beginnings(problem: Problem, known: KnownStart | None) -> list[Beginning]:
    """Where the filter begins: one place, two where beacons in a line leave its mirror, or none."""
    if known is not None:
        return [_known_beginning(known)]
    candidates = [_by_positions(problem), _by_consensus(problem)]
    begun = [candidate for candidate in candidates if candidate is not None]
    if begun:
        return [min(begun, key=lambda candidate: candidate.t_s)]
    return _mirrored(problem)


def _known_beginning(known: KnownStart) -> Beginning:
    start = known.start
    cov = known.sigma_m**2 * np.eye(2)
    x = np.array([start.east_m, start.north_m])
    return Beginning(start.t_s, start, x, cov, of_replies=start.how == "m_of_n")


def _by_positions(problem: Problem) -> Beginning | None:
    """First position fix with which one of the four before it agrees."""
    table = problem.positions
    if not len(table.t_s):
        return None
    run = problem.sums.interpolate(table.t_s).displacement
    away = table.position - run
    variance_m2 = np.trace(table.cov_m2, axis1=1, axis2=2)
    for i in range(1, len(table.t_s)):
        before = slice(max(0, i - _CONFIRMING), i)
        reach_m = _AGREEING * np.sqrt(variance_m2[before] + variance_m2[i])
        reach_m += _RECKONING_ERROR * np.abs(run[i] - run[before])
        if np.any(np.abs(away[i] - away[before]) < reach_m):
            e, n = float(table.position[i].real), float(table.position[i].imag)
            start = Start(float(table.t_s[i]), e, n, i + 1, "position")
            return Beginning(start.t_s, start, np.array([e, n]), table.cov_m2[i])
    return None


def _by_consensus(problem: Problem) -> Beginning | None:
    """After the first reply at which seven agree, or six at two pings running.

    An unknown sound speed is a third unknown, which the replies of three beacons to one ping
    always fit: then three beacons must agree with themselves too, and it takes two pings.
    """
    times, x0 = problem.times, np.zeros((1, problem.priors.constant_sigma.shape[1] + N_NODE))
    scale_sigma = _scale_sigma(problem)
    unknown = len(scale_offsets(scale_sigma)) > 1
    run_m = pairs(problem.sums.interpolate(times.t_s).displacement)
    pending: tuple[int, MsacResult] | None = None
    for i in range(len(times.t_s)):
        rows = _window(i, times.ping, _START_CYCLES)
        if rows.stop - rows.start < 6:
            continue
        (recent,) = _recent(problem, rows, x0)
        result = msac_localize(recent, _sigma_s(problem), 0.0, scale_sigma, 6)
        if result is None or not _is_accepted(result, 6, 0.5):
            continue
        if unknown and result.n_repeated < 3:
            continue
        confirmed = (
            pending is not None
            and 1 <= times.ping[i] - times.ping[pending[0]] <= 2
            and _same_place(pending[1], result, run_m[i] - run_m[pending[0]])
        )
        if (result.n_agreeing >= 7 and not unknown) or confirmed:
            since_m = run_m[i] - run_m[rows].mean(axis=0)
            return _agreed(problem, i, result)._replace(run=complex(*since_m))
        if pending is None or times.ping[i] > times.ping[pending[0]]:
            pending = (i, result)
    return None


def _agreed(problem: Problem, row: int, result: MsacResult) -> Beginning:
    """Beginning at a consensus: its place and sound speed, and the start's sigma."""
    e, n = result.position_m.tolist()
    times = problem.times
    cycles = int(times.ping[row] - times.ping[0]) + 1
    start = Start(float(times.t_s[row]), e, n, cycles, "consensus")
    cov = result.cov.copy()
    cov[[0, 1], [0, 1]] += problem.start_sigma_m**2
    return Beginning(start.t_s, start, np.array([e, n, result.sound_scale]), cov, of_replies=True)


def _mirrored(problem: Problem) -> list[Beginning]:
    """Both places on which the replies of beacons in a line agree; none where they do not."""
    times, x0 = problem.times, np.zeros((1, problem.priors.constant_sigma.shape[1] + N_NODE))
    line = _line(problem)
    if line is None:
        return []
    foot, direction = line
    for i in range(len(times.t_s)):
        rows = _window(i, times.ping, _START_CYCLES)
        if rows.stop - rows.start < 8:
            continue
        (recent,) = _recent(problem, rows, x0)
        result = msac_localize(recent, _sigma_s(problem), 0.0, _scale_sigma(problem), 8)
        if result is None or result.n_beacons < 2 or 2 * result.n_agreeing < result.n_replies:
            continue
        one = _agreed(problem, i, result)
        offset = complex(one.x[0], one.x[1]) - foot
        other = foot + direction * (offset / direction).conjugate()
        x = np.array([other.real, other.imag, *one.x[2:]])
        start = one.start
        mirror = Start(start.t_s, other.real, other.imag, start.cycles, start.how)
        cov = one.cov.copy()
        cov[:2, :2] = float(np.trace(cov[:2, :2])) / 2 * np.eye(2)
        cov[:2, 2:], cov[2:, :2] = 0.0, 0.0
        return [one._replace(cov=cov), one._replace(start=mirror, x=x, cov=cov)]
    return []


def _line(problem: Problem) -> tuple[complex, complex] | None:
    """A point and the direction of the line in which all beacons lie that reply; None without."""
    beacon, virtual_beacon = problem.times.beacon, problem.times.virtual_beacon[:, 0]
    ids, count = np.unique(beacon, return_counts=True)
    ids = ids[count >= max(3, _SELDOM * len(beacon))]
    if len(ids) < 2:
        return None
    places = np.array([np.mean(virtual_beacon[beacon == one]) for one in ids])
    foot = complex(np.mean(places))
    vectors, extent, _ = np.linalg.svd(pairs(places - foot).T, full_matrices=False)
    if extent[0] < 1.0 or extent[1] > _IN_LINE * extent[0]:
        return None
    return foot, complex(vectors[0, 0], vectors[1, 0])


def recovery(problem: Problem, x: Float, P: Float, row: int) -> Beginning | None:
    """A better place than the likeliest filter's; None where there is none.

    Seen with what that filter learned of the sensors; or, where more replies agree so, half of them
    and twice as many as on the present place, for it may have learned nonsense while it was lost,
    with nothing learned: the beginning is a fresh one.

    Parameters
    ----------
    x, P : (N,) and (N, N) of the likeliest filter at reply `row`
    """
    nothing = np.zeros_like(x)
    kept = [0, 1, SOUND, N_NODE + SOUND_SCALE]
    nothing[kept] = x[kept]
    rows = _window(row, problem.times.ping, _RECOVERY_CYCLES)
    windows = _recent(problem, rows, np.stack([x, nothing]))
    learned, unlearned = (_search(problem, x, P, (row, window)) for window in windows)
    unlearned = unlearned._replace(present=max(learned.present, unlearned.present))
    one, other = _better_place(problem, learned), _better_place(problem, unlearned)
    least = max(unlearned.least_elsewhere, one.n_agreeing + 1 if one is not None else 0)
    if other is not None and other.n_agreeing >= least:
        return other.beginning._replace(fresh=True)
    return None if one is None else one.beginning


class _Better(NamedTuple):
    """A place that is better than a filter's, and how many replies agree on it."""

    beginning: Beginning
    n_agreeing: int


class _Search(NamedTuple):
    """The last replies, and the place that a consensus of them must be better than."""

    row: int
    recent: ReplyWindow
    sigma_s: float
    place_m: Float  #: (2,)
    scale: float  #: of the sound speed, k
    scale_sigma: float
    reach_m: float  #: how far away a consensus must be
    present: int  #: replies that fit the place
    early: int  #: replies that come too early for it

    @property
    def share(self) -> float:
        """Of the last replies that fit the place."""
        return self.present / len(self.recent.ping)

    @property
    def least_elsewhere(self) -> float:
        """Replies that must agree on a place which what was learned until then contradicts."""
        return max(8, 2 * self.present, 0.5 * len(self.recent.ping))


def _search(problem: Problem, x: Float, P: Float, last: tuple[int, ReplyWindow]) -> _Search:
    """About the place of a filter (N,) and (N, N), by the last reply's row and its window."""
    sigma_s, place = _sigma_s(problem), N_NODE + SOUND_SCALE
    row, recent = last
    scale = float(sound_scale(x))
    residual_s = recent.residual_s(x[:2], scale)
    loosely_s = 3 * recent.widened_sigma_s(sigma_s)
    return _Search(
        row,
        recent,
        sigma_s,
        x[:2],
        scale,
        sqrt(float(P[place, place])),
        min(3 * sqrt(float(P[0, 0] + P[1, 1])), _FARTHEST_REACH * problem.start_sigma_m),
        int(np.count_nonzero(np.abs(residual_s) < loosely_s)),
        int(np.count_nonzero((residual_s < -loosely_s) & (residual_s > -_EARLY_S))),
    )


def _better_place(problem: Problem, search: _Search) -> _Better | None:
    """A position on which clearly more replies agree than on the present one, and far from it.

    More of them also when dead reckoning is trusted as far as a running filter deserves: over some
    hundred metres a wide tolerance finds agreement among bounces.  Not asked where half of the
    replies fit and hardly any comes too early.  In the sound speed that was learned; or, where
    little was known of it and it may have been learned wrongly, in any.
    """
    if search.share >= 0.5 and search.early < _TOO_EARLY:
        return None
    recent, sigma_s, present = search.recent, search.sigma_s, search.present
    wanted = max(6, present + 3)
    result = msac_localize(recent, sigma_s, search.scale, search.scale_sigma, wanted)
    if result is not None and _is_better(search, result, (wanted, 0.4)):
        return _agreed_again(problem, search.row, result, keep=True)
    if len(scale_offsets(_scale_sigma(problem))) == 1:
        return None
    search = search._replace(reach_m=max(search.reach_m, problem.start_sigma_m))
    wanted = ceil(search.least_elsewhere)
    result = msac_localize(recent, sigma_s, 0.0, _scale_sigma(problem), wanted)
    if (
        result is None
        or not _is_better(search, result, (wanted, 0.5))
        or result.n_repeated < 3
        or abs(result.sound_scale - search.scale) < 3 * search.scale_sigma
    ):
        return None
    return _agreed_again(problem, search.row, result, keep=False)


def _is_better(search: _Search, result: MsacResult, least: tuple[int, float]) -> bool:
    """Whether a consensus is accepted, far enough away, and three replies more agree on it.

    The latter when dead reckoning is trusted closely.
    """
    if not _is_accepted(result, *least):
        return False
    if float(np.linalg.norm(result.position_m - search.place_m)) <= search.reach_m:
        return False
    recent = search.recent
    closely_s = 3 * recent.widened_sigma_s(search.sigma_s, _LEARNED_ERROR)
    now_s = np.abs(recent.residual_s(search.place_m, search.scale))
    then_s = np.abs(recent.residual_s(result.position_m, result.sound_scale))
    return bool(np.sum(then_s < closely_s) >= np.sum(now_s < closely_s) + 3)


def _agreed_again(problem: Problem, row: int, result: MsacResult, *, keep: bool) -> _Better:
    """A consensus in a running filter, which keeps the sound speed or not."""
    beginning = _agreed(problem, row, result)
    if keep:
        beginning = beginning._replace(x=beginning.x[:2], cov=beginning.cov[:2, :2])
    return _Better(beginning, result.n_agreeing)


def _window(i: int, ping: Int, n_cycles: int) -> slice:
    """The last replies of the last pings, up to row i."""
    newest = np.maximum.accumulate(ping[max(0, i + 1 - 2 * _WINDOW) : i + 1])
    first_ping = i + 1 - len(newest) + int(np.searchsorted(newest, newest[-1] - n_cycles + 1))
    return slice(max(first_ping, i + 1 - _WINDOW), i + 1)


def _recent(problem: Problem, rows: slice, x: Float) -> list[ReplyWindow]:
    """The window's replies around its last, with the errors that each state of x (m, N) knows."""
    times, at_reply, x = problem.times, problem.times.at_reply[rows], x[:, None]
    back, since = at_reply.since(at_reply[-1:]), times.since_ping.row(rows)
    to_reply, _ = displace(x, back, (1.0, 1.0, back.duration_s))
    since_ping, _ = displace(x, since, (1.0, 1.0, since.duration_s))
    held_mps = problem.sums.held_sigma(times.t_s[rows], problem.priors)[:, 0]
    lost_m = held_mps * np.abs(back.held_s)
    keys = times.ping[rows], times.beacon[rows]
    from_now_m, geometry = (pairs(to_reply - since_ping), pairs(to_reply)), problem.geometry[rows]
    return [reply_window(keys, one_m, lost_m, geometry) for one_m in zip(*from_now_m, strict=True)]


def _sigma_s(problem: Problem) -> float:
    """Of a travel time, its beacon's place included."""
    base = problem.priors.constant_sigma[0, N_COMMON:]
    beacon_m = float(base[::N_BEACON].max(initial=0.0))
    return float(np.hypot(problem.stated_time_sigma_s, 2 * beacon_m / _speed(problem)))


def _scale_sigma(problem: Problem) -> float:
    return float(problem.priors.constant_sigma[0, SOUND_SCALE])


def _speed(problem: Problem) -> float:
    return float(problem.times.speed_mps[0, 0]) if len(problem.times.t_s) else NOMINAL_MPS


def _same_place(before: MsacResult, now: MsacResult, run_m: Float) -> bool:
    """Whether two agreements differ by what was run between them, and hardly in sound speed."""
    apart_m = float(np.linalg.norm(now.position_m - before.position_m - run_m))
    variance = np.diagonal(before.cov) + np.diagonal(now.cov)
    reach_m = 3 * sqrt(float(variance[0] + variance[1])) + _RECKONING_ERROR * float(
        np.linalg.norm(run_m)
    )
    scale_apart = abs(now.sound_scale - before.sound_scale)
    return apart_m < reach_m and scale_apart < 3 * sqrt(float(variance[2]))


def _is_accepted(result: MsacResult, n_agreeing: int, share: float) -> bool:
    return (
        result.n_agreeing >= n_agreeing
        and result.n_beacons >= 3
        and result.n_agreeing >= share * result.n_replies
        and result.n_agreeing >= result.n_rival + 3
    )
