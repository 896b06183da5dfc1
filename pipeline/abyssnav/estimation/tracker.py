# SPDX-License-Identifier: Apache-2.0
"""The real-time best: augmented filter, started and recovered by consensus, never left lost."""

from collections import deque
from dataclasses import dataclass
from math import nan, sqrt
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import Legs
from abyssnav.estimation.adaptive_noise import Noise
from abyssnav.estimation.initialization import Agreement, Recent, agree, scale_offsets
from abyssnav.estimation.model import N_STATES, SOUND, ErrorModel, Steps, reckoned
from abyssnav.estimation.two_state import ACCEPTED, BEFORE_START, DUPLICATE, GATED
from abyssnav.estimation.update import Judge, advance, correct, rows
from abyssnav.tables import Float, Int, Start, Table

_EAST_NORTH_SOUND = [0, 1, SOUND]
_WINDOW = 24  #: replies that a consensus looks back on
_START_CYCLES, _RECOVERY_CYCLES = 10, 20
_LEARNED_ERROR = 0.02  #: dead reckoning's, as a share of the distance run, in a running filter
#: So many replies in the window that come early, by no more than this, say that the place is wrong
#: though most fit it: sound may take a longer way, but none that is shorter than the straight one.
_TOO_EARLY, _EARLY_S = 3, 0.2
_RECENT = 10  #: replies by which the gate is judged to reject too much


@dataclass(frozen=True, eq=False)
class Trail(Table):
    """The filter's memory of every usable reply; NaN before the start."""

    x_prior: Float  #: (n, 11)
    P_prior: Float  #: (n, 11, 11)
    x: Float
    P: Float
    FP: Float  #: (n, 11, 11) F P of the row before: covariance of its states with these
    predicted_s: Float  #: flight time
    variance_s2: Float
    innovation_s: Float
    noise_s2: Float  #: R, of what the variance holds
    decision: Int
    segment: Int  #: -1 before the start; one more after each recovery


def track(
    beacon: Int,
    ping: Int,
    legs: Legs,
    steps: Steps,
    model: ErrorModel,
    judge: Judge,
    given: tuple[int, Start] | None = None,
    *,
    recover: bool = True,
) -> tuple[Trail, Start | None]:
    """Run the augmented filter over all usable replies, in the order heard.

    It starts where consensus is accepted (or at a given start) and, when the gate rejects half of
    the last ten replies, asks consensus again; position and its covariance are then set anew while
    what was learned of heading, scales and deviation is kept.

    Parameters
    ----------
    beacon, ping : (n,) row of the beacon; running number of the ping
    legs, steps : n rows
    given : row after which a start found elsewhere holds, and that start
    recover : whether consensus may set the position anew

    Returns
    -------
    trail : n rows
    start : None when none was ever accepted
    """
    trail = _Tape.of(len(beacon))
    if given is None:
        first, begin, start = _consensus_start(beacon, ping, legs, steps, model, judge)
    else:
        first, begin, start = _given_start(given, model)
    if begin is None:
        return trail.trail(), None
    x, P = begin
    trail.x[first], trail.P[first], trail.segment[first] = x, P, 0
    of, keys = rows(steps, legs, model), list(zip(ping.tolist(), beacon.tolist(), strict=True))
    heard = set(keys[: first + 1])  # the start was made of these
    noise, segment, since_reset = Noise(int(beacon.max()) + 1, judge.sigma_s), 0, 0
    latest = deque[int]([], _RECENT)
    for i in range(first + 1, len(keys)):
        x, P, FP = advance(of, i, x, P)
        trail.x_prior[i], trail.P_prior[i], trail.FP[i] = x, P, FP
        key = keys[i]
        noise_s2 = noise.variance_s2(key[1])
        seen = correct(of, i, x, P, judge, noise_s2)
        trail.noise_s2[i] = noise_s2
        trail.told[i] = seen.predicted_s, seen.variance_s2, seen.innovation_s
        decision = DUPLICATE if key in heard else ACCEPTED if seen.inside else GATED
        if decision == ACCEPTED:
            x, P = seen.x, seen.P
            heard.add(key)
            noise.learn(key[1], seen.innovation_s, seen.variance_s2)
        latest.append(decision)
        since_reset += 1
        asked = recover and since_reset >= 8 and key[0] != keys[i - 1][0]
        if asked and _rejects_too_much(latest):
            found = _recovery(i, x, P, beacon, ping, legs, steps, model, judge)
            if found is not None:
                x, P = _reset(x, P, found, model)
                segment, since_reset = segment + 1, 0
        trail.decision[i], trail.segment[i] = decision, segment
        trail.x[i], trail.P[i] = x, P
    return trail.trail(), start


class _Tape(NamedTuple):
    """A trail while it is written."""

    x_prior: Float
    P_prior: Float
    x: Float
    P: Float
    FP: Float
    told: Float  #: (n, 3) predicted, variance, innovation
    noise_s2: Float
    decision: Int
    segment: Int

    @classmethod
    def of(cls, n: int) -> "_Tape":
        """Nothing but NaN, before the start."""

        def unknown(*shape: int) -> Float:
            return np.full((n, *shape), nan)

        return cls(
            x_prior=unknown(N_STATES),
            P_prior=unknown(N_STATES, N_STATES),
            x=unknown(N_STATES),
            P=unknown(N_STATES, N_STATES),
            FP=unknown(N_STATES, N_STATES),
            told=unknown(3),
            noise_s2=unknown(),
            decision=np.full(n, BEFORE_START),
            segment=np.full(n, -1),
        )

    def trail(self) -> Trail:
        """What was written."""
        predicted_s, variance_s2, innovation_s = self.told.T
        states = self.x_prior, self.P_prior, self.x, self.P, self.FP
        told = predicted_s, variance_s2, innovation_s
        return Trail(*states, *told, self.noise_s2, self.decision, self.segment)


def _window(i: int, ping: Int, n_cycles: int) -> slice:
    """The last replies of the last pings, up to row i."""
    newest = np.maximum.accumulate(ping[max(0, i + 1 - 2 * _WINDOW) : i + 1])
    first_ping = i + 1 - len(newest) + int(np.searchsorted(newest, newest[-1] - n_cycles + 1))
    return slice(max(first_ping, i + 1 - _WINDOW), i + 1)


def _recent(rows: slice, x: Float, beacon: Int, ping: Int, steps: Steps, legs: Legs) -> Recent:
    """The window's replies around its last, with the errors that x knows."""
    now = rows.stop - 1
    to_reply_m = reckoned(
        x, steps.run_m[rows] - steps.run_m[now], steps.linear_m[rows] - steps.linear_m[now]
    )
    since_ping_m = reckoned(x, steps.since_ping_m[rows], steps.linear_since_ping_m[rows])
    return Recent.of(ping[rows], beacon[rows], to_reply_m - since_ping_m, to_reply_m, legs[rows])


def _consensus_start(
    beacon: Int, ping: Int, legs: Legs, steps: Steps, model: ErrorModel, judge: Judge
) -> tuple[int, tuple[Float, Float] | None, Start | None]:
    """First reply after which seven agree, or six at two pings running.

    An unknown sound speed is a third unknown, which the replies of three beacons to one ping
    always fit: then three beacons must agree with themselves too, and it takes two pings.
    """
    x0, scale_sigma = np.zeros(N_STATES), model.sound_scale_sigma
    unknown = len(scale_offsets(scale_sigma)) > 1
    pending: tuple[int, Agreement] | None = None
    for i in range(len(beacon)):
        rows = _window(i, ping, _START_CYCLES)
        if rows.stop - rows.start < 6:
            continue
        recent = _recent(rows, x0, beacon, ping, steps, legs)
        found = agree(recent, judge.sigma_s, 0.0, scale_sigma, 6)
        if found is None or not _convinces(found, 6, 0.5) or (unknown and found.n_repeated < 3):
            continue
        confirmed = (
            pending is not None
            and 1 <= ping[i] - ping[pending[0]] <= 2
            and _same_place(pending[1], found, steps.run_m[i] - steps.run_m[pending[0]])
        )
        if (found.n_agreeing >= 7 and not unknown) or confirmed:
            e, n = found.position_m.tolist()
            cycles = int(ping[i] - ping[0]) + 1
            return i, _begin(found, model), Start(float(steps.t_s[i]), e, n, cycles, "consensus")
        if pending is None or ping[i] > ping[pending[0]]:
            pending = (i, found)
    return 0, None, None


def _same_place(before: Agreement, now: Agreement, run_m: Float) -> bool:
    """Whether two agreements differ by what was run between them, and hardly in sound speed."""
    apart_m = float(np.linalg.norm(now.position_m - before.position_m - run_m))
    variance = np.diagonal(before.cov) + np.diagonal(now.cov)
    reach_m = 3 * sqrt(float(variance[0] + variance[1])) + 0.05 * float(np.linalg.norm(run_m))
    scale_apart = abs(now.sound_scale - before.sound_scale)
    return apart_m < reach_m and scale_apart < 3 * sqrt(float(variance[2]))


def _begin(found: Agreement, model: ErrorModel) -> tuple[Float, Float]:
    """States and covariance at an accepted consensus."""
    x, P = np.zeros(N_STATES), np.diag(model.prior_variance())
    x[_EAST_NORTH_SOUND] = [*found.position_m, found.sound_scale]
    P[np.ix_(_EAST_NORTH_SOUND, _EAST_NORTH_SOUND)] = found.cov
    P[0, 0] += model.start_sigma_m**2
    P[1, 1] += model.start_sigma_m**2
    return x, P


def _given_start(
    given: tuple[int, Start], model: ErrorModel
) -> tuple[int, tuple[Float, Float], Start]:
    """States at the last reply not after a start that was found elsewhere."""
    row, start = given
    x = np.zeros(N_STATES)
    x[:2] = start.east_m, start.north_m
    return row, (x, np.diag(model.prior_variance())), start


def _convinces(found: Agreement, n_agreeing: int, share: float) -> bool:
    return (
        found.n_agreeing >= n_agreeing
        and found.n_beacons >= 3
        and found.n_agreeing >= share * found.n_replies
        and found.n_agreeing >= found.n_rival + 3
    )


def _rejects_too_much(latest: deque[int]) -> bool:
    return latest.count(GATED) >= _RECENT // 2


def _recovery(
    i: int,
    x: Float,
    P: Float,
    beacon: Int,
    ping: Int,
    legs: Legs,
    steps: Steps,
    model: ErrorModel,
    judge: Judge,
) -> Agreement | None:
    """A position on which clearly more replies agree than on the present one, and far from it.

    More of them also when dead reckoning is trusted as far as a running filter deserves: over some
    hundred metres a wide tolerance finds agreement among bounces.  Not asked where half of the
    replies fit and hardly any comes too early.  In the sound speed that was learned; or, where
    little was known of it and it may have been learned wrongly, in any.
    """
    rows = _window(i, ping, _RECOVERY_CYCLES)
    recent = _recent(rows, x, beacon, ping, steps, legs)
    loosely_s = recent.spread_s(judge.sigma_s)
    closely_s = recent.spread_s(judge.sigma_s, _LEARNED_ERROR)
    scale, sigma = x.item(SOUND), sqrt(P.item(SOUND, SOUND))
    late_s = recent.late_s(x[:2], scale)
    early = int(np.count_nonzero((late_s < -3 * loosely_s) & (late_s > -_EARLY_S)))
    late_s = np.abs(late_s)
    present = int(np.count_nonzero(late_s < 3 * loosely_s))
    if 2 * present >= len(late_s) and early < _TOO_EARLY:
        return None
    closely = int(np.count_nonzero(late_s < 3 * closely_s))
    reach_m = 3 * sqrt(P.item(0, 0) + P.item(1, 1))

    def better(found: Agreement, n_agreeing: int, share: float, far_m: float) -> bool:
        late_s = np.abs(recent.late_s(found.position_m, found.sound_scale))
        return (
            _convinces(found, n_agreeing, share)
            and int(np.count_nonzero(late_s < 3 * closely_s)) >= closely + 3
            and float(np.linalg.norm(found.position_m - x[:2])) > far_m
        )

    found = agree(recent, judge.sigma_s, scale, sigma, max(6, present + 3))
    if found is not None and better(found, max(6, present + 3), 0.4, reach_m):
        return found
    if len(scale_offsets(model.sound_scale_sigma)) == 1:
        return None
    found = agree(recent, judge.sigma_s, 0.0, model.sound_scale_sigma, max(8, 2 * present))
    if found is None or found.n_repeated < 3 or abs(found.sound_scale - scale) < 3 * sigma:
        return None
    far_m = max(reach_m, model.start_sigma_m)
    return found if better(found, max(8, 2 * present), 0.5, far_m) else None


def _reset(x: Float, P: Float, found: Agreement, model: ErrorModel) -> tuple[Float, Float]:
    """Position set anew; what was learned of the sensors is kept, but for a refuted sound speed."""
    x, P = x.copy(), P.copy()
    again = [0, 1]
    if abs(found.sound_scale - x[SOUND]) > 3 * sqrt(float(P[SOUND, SOUND])):
        again = _EAST_NORTH_SOUND
        x[SOUND] = found.sound_scale
    x[:2] = found.position_m
    P[again, :], P[:, again] = 0.0, 0.0
    P[np.ix_(again, again)] = found.cov[: len(again), : len(again)]
    P[0, 0] += model.start_sigma_m**2
    P[1, 1] += model.start_sigma_m**2
    return x, P
