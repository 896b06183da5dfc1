# SPDX-License-Identifier: Apache-2.0
"""The detective for travel times: which reading lets the replies of a ping agree on a place."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from abyssnav.acoustics.travel_time import is_physical, ray_geometry
from abyssnav.estimation.dead_reckoning import DeadReckoning
from abyssnav.estimation.fixes import cycles, fix_positions
from abyssnav.tables import Beacons, Dive, Fixes, Float, Int, Replies

#: Cycles spread over the dive that are enough.
_MOST_CYCLES = 160
#: Pings of one beacon each that make a cycle lie no farther apart.
_MAX_CYCLE_S = 60.0
#: Noise of a two-way time here: a beacon a few metres off is no other convention.
_SIGMA_S = 0.004
#: Share of cycles whose times agree; the others lie anywhere within the times that were logged.
_AGREEING = 0.6
#: Offsets of the depth: 10 m is the air's pressure left in, or taken off twice.
_DEEPER_M = (-100.0, -30.0, -10.0, 10.0, 30.0, 100.0)
#: An offset takes up a little of many other errors, so it must be plain.
_OFFSET_NATS = 25.0
#: All orders of so many beacons are tried, of more only swaps of two.
_MOST_PERMUTED = 4


@dataclass(frozen=True)
class Assumption:
    """A way in which the replies may have to be read."""

    name: str
    value: str
    change: Callable[[Replies], Replies]
    #: Logarithm of the factor by which it stretches times.
    log_stretch: float = 0.0
    beacon: int = -1  #: row of the beacon whose replies it leaves out
    order: tuple[int, ...] = ()  #: (b,) row of the beacon that answers by each one's id
    penalty: float = 0.0  #: how much less likely it is before any data, nats


@dataclass(frozen=True, eq=False)
class ScoredAssumption:
    """An assumption with its log likelihood and the fixes it leads to."""

    assumption: Assumption
    log_likelihood: float
    fixes: Fixes
    share: float  #: of the cycles, that agree


def score_assumptions(dive: Dive, motion: DeadReckoning) -> list[ScoredAssumption]:
    """Every reading of times, ids and depths by its likelihood, the best first; none: no cycles.

    The position is free at every cycle of three beacons or more, so neither start nor filter nor
    compass is needed.  A cycle of n replies has n - 2 degrees of freedom:

        log p = Σ log(0.6 (stretch N(rms; 0, σ))^(n-2) + 0.4 / span^(n-2))

    with the times' own span, so that a density counts in the unit in which they were logged.
    """
    replies = dive.replies[dive.replies.beacon >= 0]
    if not len(replies):
        return []
    cycle = cycles(replies, np.ones(len(replies), dtype=bool), _MAX_CYCLE_S)
    pairs = np.unique(np.stack([cycle, replies.beacon]), axis=1)[0]
    numbers, n_beacons = np.unique(pairs, return_counts=True)
    numbers, n_beacons = numbers[n_beacons >= 3], n_beacons[n_beacons >= 3]
    if not len(numbers):
        return []
    rows = np.linspace(0, len(numbers) - 1, min(len(numbers), _MOST_CYCLES)).astype(int)
    numbers, n_beacons = numbers[np.unique(rows)], n_beacons[np.unique(rows)]
    chosen = np.isin(cycle, numbers)
    replies, cycle = replies[chosen], cycle[chosen]
    log_span = float(np.log(max(2 * np.quantile(replies.travel_time_s, 0.9), 1e-9)))
    scored = [
        _score(assumption, dive, (replies, cycle), (numbers, n_beacons, log_span), motion)
        for assumption in _assumptions(dive.beacons, replies)
    ]
    return sorted(scored, key=lambda s: -s.log_likelihood)


def _score(
    assumption: Assumption,
    dive: Dive,
    rows: tuple[Replies, Int],
    counted: tuple[Int, Int, float],
    motion: DeadReckoning,
) -> ScoredAssumption:
    replies, cycle = assumption.change(rows[0]), rows[1]
    kept = replies.beacon != assumption.beacon
    fixes = _fixes(dive, replies[kept], cycle[kept], motion)
    numbers, n_beacons, log_span = counted
    place = np.searchsorted(numbers, fixes.cycle)
    used, all_of = fixes.n_replies - 2, n_beacons[place] - 2
    chi2 = fixes.n_replies * (fixes.rms_s / _SIGMA_S) ** 2
    density = assumption.log_stretch - np.log(_SIGMA_S * np.sqrt(2 * np.pi))
    log_p = -log_span * (n_beacons - 2.0)  # those that take no part lie anywhere
    log_p[place] = np.logaddexp(
        np.log(_AGREEING) - 0.5 * chi2 + used * density - (all_of - used) * log_span,
        np.log(1 - _AGREEING) - all_of * log_span,
    )
    share = float(np.mean(fixes.consistent)) if len(fixes) else 0.0
    return ScoredAssumption(
        assumption,
        float(log_p.sum()) - assumption.penalty,
        fixes,
        share * len(fixes) / len(numbers),
    )


def _fixes(dive: Dive, replies: Replies, cycle: Int, motion: DeadReckoning) -> Fixes:
    with np.errstate(all="ignore"):
        geometry = ray_geometry(replies, dive.sound_speed, sigma_s=np.inf)
        physical = is_physical(geometry, replies.travel_time_s, _SIGMA_S)
        return fix_positions(
            replies[physical], geometry[physical], cycle[physical], motion, _SIGMA_S
        )


def fixes_anew(dive: Dive, motion: DeadReckoning) -> Fixes:
    """The fixes of a dive whose beacons or replies are others than they were."""
    replies = dive.replies[dive.replies.beacon >= 0]
    cycle = cycles(replies, np.ones(len(replies), dtype=bool), _MAX_CYCLE_S)
    return _fixes(dive, replies, cycle, motion)


def _assumptions(beacons: Beacons, replies: Replies) -> Iterator[Assumption]:
    """All readings that are tried."""
    yield Assumption("", "as given", lambda r: r)
    yield Assumption(
        "time_one_way",
        "one-way times, turn-around taken off",
        _times(lambda t, wait: 2 * t + wait),
        float(np.log(2)),
    )
    yield Assumption("time_one_way", "one-way times", _times(lambda t, _: 2 * t), float(np.log(2)))
    yield Assumption(
        "turn_around_removed", "turn-around taken off", _times(lambda t, wait: t + wait)
    )
    for factor, unit in ((1e-3, "ms"), (1e-6, "us"), (1e-9, "ns"), (1e3, "ks")):
        yield Assumption("time_unit", unit, _scaled(factor), float(np.log(factor)))
    for share in (-0.06, -0.04, -0.03, -0.02, -0.013, 0.013, 0.02, 0.03, 0.04, 0.06):
        yield Assumption("sound_speed", f"{100 * share:+.1f} %", _stretched(1 + share))
    for late_s in (-0.3, -0.1, -0.05, -0.02, 0.02, 0.05, 0.1, 0.3):
        yield Assumption("turn_around", f"{1e3 * late_s:+.0f} ms", _delayed(late_s))
    for factor, words in (
        (-1.0, "positive up"),
        (0.3048, "feet"),
        (1 / 0.3048, "metres given as feet"),
        (10.0, "tens of metres"),
        (0.1, "tenths of metres"),
        (0.01, "centimetres"),
    ):
        yield Assumption("depth", words, _deepened(factor))
    for deeper_m in _DEEPER_M:
        yield Assumption("depth", f"{deeper_m:+.0f} m", _lowered(deeper_m), penalty=_OFFSET_NATS)
    yield from _orders(beacons, replies)
    answering = np.unique(replies.beacon)
    for row in answering.tolist() if len(answering) > 3 else []:
        yield Assumption("beacon_moved", str(beacons.id[row]), lambda r: r, beacon=row)


def _orders(beacons: Beacons, replies: Replies) -> Iterator[Assumption]:
    """Readings with ids exchanged."""
    rows = np.unique(replies.beacon).tolist()
    if len(rows) <= _MOST_PERMUTED:
        orders = [list(order) for order in permutations(rows)][1:]
    else:
        orders = []
        for one, other in combinations(range(len(rows)), 2):
            order = list(rows)
            order[one], order[other] = order[other], order[one]
            orders.append(order)
    for order in orders:
        table = np.arange(len(beacons))
        table[rows] = order
        words = ", ".join(
            f"{beacons.id[a]} is {beacons.id[b]}"
            for a, b in zip(rows, order, strict=True)
            if a != b
        )
        renamed = _renamed(table, beacons)
        yield Assumption("beacon_ids", words, renamed, order=tuple(table.tolist()))


def _times(convert: Callable[[Float, Float], Float]) -> Callable[[Replies], Replies]:
    return lambda r: replace(r, travel_time_s=convert(r.travel_time_s, r.turn_around_s))


def _scaled(factor: float) -> Callable[[Replies], Replies]:
    return lambda r: replace(r, travel_time_s=r.travel_time_s * factor)


def _delayed(late_s: float) -> Callable[[Replies], Replies]:
    return lambda r: replace(r, travel_time_s=r.travel_time_s - late_s)


def _stretched(factor: float) -> Callable[[Replies], Replies]:
    return _times(lambda t, wait: wait + (t - wait) * factor)


def _deepened(factor: float) -> Callable[[Replies], Replies]:
    return lambda r: replace(
        r, depth_ping_m=r.depth_ping_m * factor, depth_reply_m=r.depth_reply_m * factor
    )


def _lowered(deeper_m: float) -> Callable[[Replies], Replies]:
    return lambda r: replace(
        r, depth_ping_m=r.depth_ping_m + deeper_m, depth_reply_m=r.depth_reply_m + deeper_m
    )


def _renamed(table: Int, beacons: Beacons) -> Callable[[Replies], Replies]:
    return lambda r: replace(
        r,
        beacon=table[r.beacon],
        beacon_enu_m=beacons.position_enu_m[table[r.beacon]],
        turn_around_s=beacons.turn_around_s[table[r.beacon]],
    )
