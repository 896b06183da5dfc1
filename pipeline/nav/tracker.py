# SPDX-License-Identifier: Apache-2.0
"""The real-time best: augmented filter, started and recovered by consensus, never left lost."""

from dataclasses import dataclass
from math import hypot, nan, sqrt

import numpy as np

from pipeline.nav.acoustics import Legs
from pipeline.nav.augmented import N_STATES, SOUND, ErrorModel, Steps, displacement
from pipeline.nav.consensus import Agreement, Recent, agree, residuals
from pipeline.nav.estimation import ACCEPTED, BEFORE_START, DUPLICATE, GATED
from pipeline.nav.update import Judge, advance, correct, rows
from pipeline.tables import Float, Int, Start, Table

_EAST_NORTH_SOUND = [0, 1, SOUND]
_WINDOW = 24  #: replies that a consensus looks back on
_START_CYCLES, _RECOVERY_CYCLES = 10, 20
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
    of, heard = rows(steps, legs), set[tuple[int, int]]()
    segment, since_reset = 0, 0
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
        if since_reset >= 8 and ping[i] != ping[i - 1] and _rejects_too_much(trail, first, i):
            found = _recovery(i, x, P, beacon, ping, legs, steps, judge)
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


def _scales_to_try(model: ErrorModel) -> Float:
    """Values of k to search at the start; only zero where the sound speed is well known."""
    step = 0.002
    reach = 3 * model.sound_scale_sigma
    n = int(np.ceil(reach / step)) if reach > 2 * step else 0
    return np.asarray(step * np.arange(-n, n + 1))


def _consensus_start(
    beacon: Int, ping: Int, legs: Legs, steps: Steps, model: ErrorModel, judge: Judge
) -> tuple[int, tuple[Float, Float] | None, Start | None]:
    """First reply after which seven agree, or six at two pings running."""
    x0, scales = np.zeros(N_STATES), _scales_to_try(model)
    known = len(scales) == 1
    scale_sigma = model.sound_scale_sigma if known else 0.002
    pending: tuple[int, Float, float] | None = None
    for i in range(len(beacon)):
        rows = _window(i, ping, _START_CYCLES)
        if rows.stop - rows.start < 6:
            continue
        recent = _recent(rows, x0, beacon, ping, steps)
        found = agree(recent, legs[rows], judge.sigma_s, scales, scale_sigma)
        if found is None or not _convinces(found, 6, 0.5):
            continue
        reach_m = sqrt(float(np.trace(found.cov[:2, :2])))
        confirmed = False
        if pending is not None and 1 <= ping[i] - ping[pending[0]] <= 2:
            run_m = steps.run_m[i] - steps.run_m[pending[0]]
            apart_m = float(np.linalg.norm(found.position_m - pending[1] - run_m))
            confirmed = apart_m < 3 * hypot(reach_m, pending[2]) + 0.05 * float(
                np.linalg.norm(run_m)
            )
        if (found.n_agreeing >= 7 and known) or confirmed:
            e, n = found.position_m.tolist()
            cycles = int(ping[i] - ping[0]) + 1
            begin = _begin(found, model)
            return i, begin, Start(float(steps.t_s[i]), e, n, cycles, "consensus")
        if pending is None or ping[i] > ping[pending[0]]:
            pending = (i, found.position_m, reach_m)
    return 0, None, None


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
    )


def _rejects_too_much(trail: dict[str, np.ndarray], first: int, i: int) -> bool:
    last = trail["decision"][max(first + 1, i + 1 - _RECENT) : i + 1]
    return int(np.sum(last == GATED)) >= _RECENT // 2


def _recovery(
    i: int, x: Float, P: Float, beacon: Int, ping: Int, legs: Legs, steps: Steps, judge: Judge
) -> Agreement | None:
    """A position on which clearly more replies agree than on the present one, and far from it."""
    rows = _window(i, ping, _RECOVERY_CYCLES)
    recent, seen = _recent(rows, x, beacon, ping, steps), legs[rows]
    now = np.abs(residuals(x[:2], x[SOUND], recent, seen, judge.sigma_s)) < 3
    present = int(np.sum(now))
    if 2 * present >= len(recent):
        return None
    scale_sigma = sqrt(float(P[SOUND, SOUND]))
    found = agree(recent, seen, judge.sigma_s, x[SOUND : SOUND + 1], scale_sigma)
    if found is None or not _convinces(found, max(6, present + 3), 0.4):
        return None
    apart_m = float(np.linalg.norm(found.position_m - x[:2]))
    return found if apart_m > 3 * sqrt(float(P[0, 0] + P[1, 1])) else None


def _reset(x: Float, P: Float, found: Agreement, model: ErrorModel) -> tuple[Float, Float]:
    """Position set anew; what was learned of the sensors is kept."""
    x, P = x.copy(), P.copy()
    x[:2] = found.position_m
    P[:2, :], P[:, :2] = 0.0, 0.0
    P[:2, :2] = model.start_sigma_m**2 * np.eye(2)
    return x, P
