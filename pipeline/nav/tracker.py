# SPDX-License-Identifier: Apache-2.0
"""The real-time best: augmented filter, started and recovered by consensus, never left lost."""

from collections import deque
from dataclasses import dataclass
from math import nan, sqrt

import numpy as np

from pipeline.nav.acoustics import Legs
from pipeline.nav.augmented import N_STATES, SOUND, ErrorModel, Steps, displacement
from pipeline.nav.consensus import Agreement, Recent, agree, residuals, scale_offsets
from pipeline.nav.estimation import ACCEPTED, BEFORE_START, DUPLICATE, GATED
from pipeline.nav.update import Judge, advance, correct, rows
from pipeline.tables import Float, Int, Start, Table

_EAST_NORTH_SOUND = [0, 1, SOUND]
_WINDOW = 24  #: replies that a consensus looks back on
_START_CYCLES, _RECOVERY_CYCLES = 10, 20
_LEARNED_ERROR = 0.02  #: dead reckoning's, as a share of the distance run, in a running filter
_RECENT = 10  #: replies by which the gate is judged to reject too much


@dataclass(frozen=True, eq=False)
class Trail(Table):
    """The filter's memory of every usable reply; NaN before the start."""

    x_prior: Float  #: (n, 11)
    P_prior: Float  #: (n, 11, 11)
    x: Float
    P: Float
    F: Float  #: (n, 11, 11) from the row before
    predicted_s: Float  #: flight time
    variance_s2: Float
    innovation_s: Float
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
    n = len(beacon)
    trail = _empty_trail(n)
    if given is None:
        first, begin, start = _consensus_start(beacon, ping, legs, steps, model, judge)
    else:
        first, begin, start = _given_start(given, model)
    if begin is None:
        return Trail(**trail), None
    x, P = begin
    trail["x"][first], trail["P"][first], trail["segment"][first] = x, P, 0
    of = rows(steps, legs)
    # the start was made of these
    heard = set(zip(ping[: first + 1].tolist(), beacon[: first + 1].tolist(), strict=True))
    segment, since_reset = 0, 0
    latest = deque[int]([], _RECENT)
    for i in range(first + 1, n):
        x, P, trail["F"][i] = advance(of, i, x, P, model)
        trail["x_prior"][i], trail["P_prior"][i] = x, P
        seen, key = correct(of, i, x, P, judge), (int(ping[i]), int(beacon[i]))
        trail["predicted_s"][i] = seen.predicted_s
        trail["variance_s2"][i] = seen.variance_s2
        trail["innovation_s"][i] = seen.innovation_s
        if key in heard:
            trail["decision"][i] = DUPLICATE
        elif not seen.inside:
            trail["decision"][i] = GATED
        else:
            trail["decision"][i] = ACCEPTED
            x, P = seen.x, seen.P
            heard.add(key)
        since_reset += 1
        latest.append(int(trail["decision"][i]))
        asked = recover and since_reset >= 8 and ping[i] != ping[i - 1]
        if asked and _rejects_too_much(latest):
            found = _recovery(i, x, P, beacon, ping, legs, steps, model, judge)
            if found is not None:
                x, P = _reset(x, P, found, model)
                segment, since_reset = segment + 1, 0
        trail["x"][i], trail["P"][i], trail["segment"][i] = x, P, segment
    return Trail(**trail), start


def _empty_trail(n: int) -> dict[str, np.ndarray]:
    vector, matrix, scalar = (n, N_STATES), (n, N_STATES, N_STATES), (n,)
    shapes = {
        "x_prior": vector, "P_prior": matrix, "x": vector, "P": matrix, "F": matrix,
        "predicted_s": scalar, "variance_s2": scalar, "innovation_s": scalar,
    }  # fmt: skip
    trail = {name: np.full(shape, nan) for name, shape in shapes.items()}
    return trail | {"decision": np.full(n, BEFORE_START), "segment": np.full(n, -1)}


def _window(i: int, ping: Int, n_cycles: int) -> slice:
    """The last replies of the last pings, up to row i."""
    newest = np.maximum.accumulate(ping[max(0, i + 1 - 2 * _WINDOW) : i + 1])
    first_ping = i + 1 - len(newest) + int(np.searchsorted(newest, newest[-1] - n_cycles + 1))
    return slice(max(first_ping, i + 1 - _WINDOW), i + 1)


def _recent(rows: slice, x: Float, beacon: Int, ping: Int, steps: Steps) -> Recent:
    """Positions of the window's replies relative to its last, with the errors that x knows."""
    now = rows.stop - 1
    to_reply, _ = displacement(
        x, steps.run_m[rows] - steps.run_m[now], steps.linear_m[rows] - steps.linear_m[now]
    )
    since_ping, _ = displacement(x, steps.since_ping_m[rows], steps.linear_since_ping_m[rows])
    return Recent(ping[rows], beacon[rows], to_reply - since_ping, to_reply)


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
        recent = _recent(rows, x0, beacon, ping, steps)
        found = agree(recent, legs[rows], judge.sigma_s, 0.0, scale_sigma)
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
    hundred metres a wide tolerance finds agreement among bounces.  In the sound speed that was
    learned; or, where little was known of it and it may have been learned wrongly, in any.
    """
    rows = _window(i, ping, _RECOVERY_CYCLES)
    recent, seen = _recent(rows, x, beacon, ping, steps), legs[rows]

    def fitting(position_m: Float, scale: float, reckoning_error: float) -> int:
        r = residuals(position_m, scale, recent, seen, judge.sigma_s, reckoning_error)
        return int(np.sum(np.abs(r) < 3))

    scale, sigma = float(x[SOUND]), sqrt(float(P[SOUND, SOUND]))
    present, closely = (fitting(x[:2], scale, share) for share in (0.05, _LEARNED_ERROR))
    if 2 * present >= len(recent):
        return None
    reach_m = 3 * sqrt(float(P[0, 0] + P[1, 1]))

    def better(found: Agreement, n_agreeing: int, share: float, far_m: float) -> bool:
        return (
            _convinces(found, n_agreeing, share)
            and fitting(found.position_m, found.sound_scale, _LEARNED_ERROR) >= closely + 3
            and float(np.linalg.norm(found.position_m - x[:2])) > far_m
        )

    found = agree(recent, seen, judge.sigma_s, scale, sigma)
    if found is None or better(found, max(6, present + 3), 0.4, reach_m):
        return found
    if len(scale_offsets(model.sound_scale_sigma)) == 1:
        return None
    found = agree(recent, seen, judge.sigma_s, 0.0, model.sound_scale_sigma)
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
