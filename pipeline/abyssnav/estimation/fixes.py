# SPDX-License-Identifier: Apache-2.0
"""Least-squares fixes of a cycle, and the confirmation of the start by M of N of them."""

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import RayGeometry, predict_travel_time
from abyssnav.estimation.dead_reckoning import DeadReckoning
from abyssnav.tables import Bool, Fixes, Float, Int, Replies, Start

#: Pairs of circles whose intersections, both, least squares starts from.
_N_PAIRS = 2
_MAX_ITERATIONS = 30
#: Least squares ends where a step is shorter.
_STEP_M = 1e-5
#: A fix is ambiguous when a place this far from it explains its times as well.
_AMBIGUOUS_M = 30.0


def cycles(replies: Replies, usable: Bool, max_cycle_s: float) -> Int:
    """Running number of the cycle that each reply belongs to.

    A cycle is one ping's replies; where a ping asks one beacon only, the replies of consecutive
    pings until a beacon would come twice, at most `max_cycle_s` from the first ping.  A beacon
    asked several times running has one turn: some surveys ask 4 4 1 1 2 2 3 3.

    Parameters
    ----------
    replies : all, in the order heard
    usable : (n,) of a known beacon and physical; the others take no part in splitting
    """
    ping = ping_numbers(replies)
    if not _one_beacon_a_ping(ping[usable], replies.beacon[usable]):
        return ping
    first_ping_s = np.full(ping.max() + 1, np.inf)
    np.minimum.at(first_ping_s, ping, replies.t_ping_s)
    beacons_of_ping: list[set[int]] = [set() for _ in first_ping_s]
    for number, beacon in zip(ping[usable], replies.beacon[usable], strict=True):
        beacons_of_ping[number].add(int(beacon))
    cycle_of_ping = np.zeros(len(first_ping_s), dtype=np.int64)
    begin_s, answered, last, cycle = first_ping_s[0], set[int](), set[int](), 0
    for number, asked in enumerate(beacons_of_ping):
        if (answered - last) & asked or first_ping_s[number] - begin_s > max_cycle_s:
            begin_s, answered, cycle = first_ping_s[number], set(), cycle + 1
        answered, last = answered | asked, asked or last
        cycle_of_ping[number] = cycle
    return np.asarray(cycle_of_ping[ping])


def ping_numbers(replies: Replies) -> Int:
    """Running number (n,) of each reply's ping, counted by the instant of the ping.

    A new ping begins where the id changes or its instant is more than a second later, so that ids
    may be unset or start anew, and a driver's instants may jitter.
    """
    order = np.lexsort((replies.ping_id, replies.t_ping_s))
    new = np.diff(replies.ping_id[order]) != 0
    new |= np.diff(replies.t_ping_s[order]) > 1.0
    number = np.empty(len(replies), dtype=np.int64)
    number[order] = np.concatenate([[0], np.cumsum(new)])[: len(replies)]
    return number


def repeated(replies: Replies) -> Bool:
    """Replies (n,) that were recorded before: same ping, beacon and travel time, to 1 µs.

    Copies of a message are no second measurement; a later arrival of the same beacon is one.
    """
    time_us = np.round(
        np.nan_to_num(replies.travel_time_s, posinf=0, neginf=0).clip(-1e9, 1e9) * 1e6
    )
    ping = ping_numbers(replies)
    order = np.lexsort((np.arange(len(ping)), time_us, replies.beacon_id, ping))
    same = np.ones(len(ping), dtype=bool)
    for column in (ping, replies.beacon_id, time_us):
        ordered = column[order]
        same[1:] &= ordered[1:] == ordered[:-1]
    same[:1] = False
    again = np.zeros(len(ping), dtype=bool)
    again[order] = same
    return again & np.isfinite(replies.travel_time_s)


def _one_beacon_a_ping(ping: Int, beacon: Int) -> bool:
    """True when fewer than one ping in twenty was answered by more than one beacon."""
    pairs = np.unique(np.stack([ping, beacon]), axis=1)
    n_beacons = np.unique(pairs[0], return_counts=True)[1]
    return len(n_beacons) > 0 and float(np.mean(n_beacons > 1)) < 0.05


@dataclass(frozen=True, eq=False)
class _Stack:
    """Replies of many cycles side by side: rows are cycles, columns replies, some of them empty."""

    row: Int  #: (m, r) row of the reply in the table of usable replies
    present: Bool  #: (m, r)
    geometry: RayGeometry  #: m · r rows, the virtual beacons shifted to the cycle's last reply
    shape: tuple[int, int]

    def take(self, cycles: Int) -> "_Stack":
        """Rows for these cycles, any of them as often as it is asked for."""
        r = self.shape[1]
        geometry = self.geometry[(cycles[:, None] * r + np.arange(r)).ravel()]
        return _Stack(self.row[cycles], self.present[cycles], geometry, (len(cycles), r))

    def residual(self, position_m: Float) -> tuple[Float, Float]:
        """Predicted minus measured (m, k, r) s and its gradient (m, k, r, 2) at (m, k, 2)."""
        m, r = self.shape
        folded = RayGeometry(
            **{n: c.reshape(m, 1, r, *c.shape[1:]) for n, c in self.geometry.columns().items()}
        )
        predicted = predict_travel_time(
            position_m[:, :, None, :], position_m[:, :, None, :], folded
        )
        gradient = predicted.gradient_ping_spm + predicted.gradient_reply_spm
        present = self.present[:, None, :]
        residual = np.where(present, predicted.time_s - folded.flight_time_s, 0.0)
        return residual, np.where(present[..., None], gradient, 0.0)


def fix_positions(
    replies: Replies, geometry: RayGeometry, cycle: Int, motion: DeadReckoning, sigma_s: float
) -> Fixes:
    """Position of the vehicle at each cycle with three beacons or more, by least squares.

        min over p of  Σ_i (2 |p - b_i| / c_i - (T_i - τ_i))²

    The vehicle is taken as being at rest within a ping, at the ping's depth (the paper's
    definition); between the pings of a cycle it is shifted by dead reckoning from mid-flight to
    mid-flight.  Levenberg-Marquardt from both intersections of the best circles, so that it does
    not fall for the mirror position across a base line.  A fix is consistent when the residuals'
    rms is below 3 σ and no second position explains the same times as well.  Rows come in the
    order in which their last replies were heard.

    Parameters
    ----------
    replies, geometry, cycle : (n,) usable replies only, in the order heard
    motion : for the shift between the pings of a cycle
    sigma_s : standard deviation of a two-way time
    """
    stack, last_row, numbers = _stack(replies, geometry, cycle, motion)
    if not len(numbers):
        return _no_fixes()
    position_m, cost = _least_squares(stack, _best_starts(stack))
    best = np.argmin(cost, axis=1)
    chosen = np.arange(len(best))
    n_replies = stack.present.sum(axis=1)
    rms_s = np.sqrt(cost / n_replies[:, None])
    apart_m = np.linalg.norm(position_m - position_m[chosen, best][:, None, :], axis=-1)
    mirrored = np.any((apart_m > _AMBIGUOUS_M) & (rms_s < 3 * sigma_s), axis=1)
    _, gradient = stack.residual(position_m[chosen, best][:, None, :])
    cov_m2 = sigma_s**2 * _inverse_2x2(np.einsum("mkri,mkrj->mij", gradient, gradient))
    vague = np.linalg.eigvalsh(cov_m2)[:, 1] > _AMBIGUOUS_M**2
    depth_m = _in_turn(np.where(stack.present, replies.depth_ping_m[stack.row], 0)) / n_replies
    ping = ping_numbers(replies)
    same_ping = stack.present & (ping[stack.row] == ping[last_row][:, None])
    middle_s = _in_turn(np.where(same_ping, _middle_s(replies)[stack.row], 0))
    return Fixes(
        t_s=replies.t_reply_s[last_row],
        t_mid_s=middle_s / same_ping.sum(axis=1),
        ping_id=replies.ping_id[last_row],
        cycle=numbers,
        position_enu_m=np.column_stack([position_m[chosen, best], -depth_m]),
        position_cov_m2=cov_m2,
        n_replies=n_replies,
        rms_s=rms_s[chosen, best],
        consistent=(rms_s[chosen, best] < 3 * sigma_s) & ~mirrored & ~vague,
    )[np.argsort(last_row)]


def _middle_s(replies: Replies) -> Float:
    """Mid-flight, where a vehicle that moves comes nearest to the one at rest of a fix."""
    return np.asarray(0.5 * (replies.t_ping_s + replies.t_reply_s))


def _no_fixes() -> Fixes:
    empty, whole = np.zeros(0), np.zeros(0, dtype=np.int64)
    return Fixes(
        empty, empty, whole, whole, np.zeros((0, 3)), np.zeros((0, 2, 2)), whole, empty,
        np.zeros(0, dtype=bool),
    )  # fmt: skip


def _stack(
    replies: Replies, geometry: RayGeometry, cycle: Int, motion: DeadReckoning
) -> tuple[_Stack, Int, Int]:
    """Cycles with at least three beacons, the first reply of each beacon, side by side."""
    key = np.stack([cycle, replies.beacon])
    _, first = np.unique(key, axis=1, return_index=True)
    first = np.sort(first)[np.argsort(cycle[np.sort(first)], kind="stable")]
    numbers, begin, count = np.unique(cycle[first], return_index=True, return_counts=True)
    enough = count >= 3
    numbers, begin, count = numbers[enough], begin[enough], count[enough]
    width = int(count.max(initial=0))
    place = np.arange(width)
    present = place < count[:, None]
    row = first[np.minimum(begin[:, None] + place, max(len(first) - 1, 0))] if width else begin
    row = np.where(present, row, first[begin][:, None]) if width else row[:, None]
    last_row = first[begin + count - 1] if width else begin
    run_m, ping = motion.interpolate(_middle_s(replies)).displacement_m, ping_numbers(replies)
    new_ping = ping[row] != ping[last_row][:, None]
    shift_m = np.where(new_ping[..., None], run_m[row] - run_m[last_row][:, None, :], 0.0)
    chosen = geometry[row.ravel()]
    shifted = RayGeometry(
        **{
            **chosen.columns(),
            "virtual_beacon_ping_m": chosen.virtual_beacon_ping_m - shift_m.reshape(-1, 2),
            "virtual_beacon_reply_m": chosen.virtual_beacon_reply_m - shift_m.reshape(-1, 2),
        }
    )
    return _Stack(row, present, shifted, (len(numbers), width)), last_row, numbers


def circle_intersections(
    center_m: Float, radius_m: Float, other_center_m: Float, other_radius_m: Float
) -> Float:
    """Both intersections of two circles; the first's point nearest to the other where they miss.

    With D the distance of the centres and u along them, the foot lies a = (r₁² - r₂² + D²) / 2D
    along u and the intersections √(r₁² - a²) to either side.

    Parameters
    ----------
    center_m, other_center_m : (..., 2);  radius_m, other_radius_m : (...)

    Returns
    -------
    position_m : (..., 2 intersections, 2)
    """
    between_m = other_center_m - center_m
    distance_m = np.maximum(np.hypot(between_m[..., 0], between_m[..., 1]), 1e-9)
    along = between_m / distance_m[..., None]
    foot_m = (radius_m**2 - other_radius_m**2 + distance_m**2) / (2 * distance_m)
    foot_m = np.minimum(np.maximum(foot_m, -radius_m), radius_m)
    side_m = np.sqrt(np.maximum(radius_m**2 - foot_m**2, 0.0))
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    foot = center_m + foot_m[..., None] * along
    return np.stack([foot + side_m[..., None] * across, foot - side_m[..., None] * across], axis=-2)


def horizontal_radius(geometry: RayGeometry, sound_scale: float = 0.0) -> Float:
    """Radius of the circle about the beacon on which a vehicle at rest lies: half the way, level.

    r² = ((T - τ) c / (2 (1 + k)))² - h²
    """
    speed_mps = 2 / (1 / geometry.speed_ping_mps + 1 / geometry.speed_reply_mps) / (1 + sound_scale)
    height_m = 0.5 * (geometry.height_ping_m + geometry.height_reply_m)
    return np.sqrt(np.maximum((0.5 * geometry.flight_time_s * speed_mps) ** 2 - height_m**2, 0.0))


def _best_starts(stack: _Stack) -> Float:
    """Both intersections (m, k, 2) of those pairs of circles that fit each cycle best."""
    m, r = stack.shape
    center_m = 0.5 * (
        stack.geometry.virtual_beacon_ping_m + stack.geometry.virtual_beacon_reply_m
    ).reshape(m, r, 2)
    radius_m = horizontal_radius(stack.geometry).reshape(m, r)
    first, second = np.triu_indices(r, k=1)
    both_m = circle_intersections(
        center_m[:, first], radius_m[:, first], center_m[:, second], radius_m[:, second]
    )
    residual, _ = stack.residual(both_m.reshape(m, -1, 2))
    misfit_s = _in_turn(np.abs(residual)).reshape(m, -1, 2).min(axis=-1)
    present = stack.present[:, first] & stack.present[:, second]
    # Stable, and empty places last: how wide other cycles are moves no fix by a bit.
    chosen = np.argsort(np.where(present, misfit_s, np.inf), axis=1, kind="stable")[:, :_N_PAIRS]
    return np.take_along_axis(both_m, chosen[..., None, None], axis=1).reshape(m, -1, 2)


def _least_squares(stack: _Stack, starts_m: Float) -> tuple[Float, Float]:
    """Levenberg-Marquardt from every start of every cycle at once; positions and sums of squares.

    Each stops by itself, so that no fix depends on how long its neighbours take; most stop after
    a few steps, and the rest go on without them.
    """
    found_m, found_cost = starts_m.reshape(-1, 2).copy(), np.zeros(starts_m.size // 2)
    rows = np.arange(len(found_m))
    stack, position_m = stack.take(rows // starts_m.shape[1]), found_m[:, None]
    damping, moving = np.full((len(rows), 1), 1e-3), np.ones((len(rows), 1), dtype=bool)
    residual, gradient = stack.residual(position_m)
    cost = _in_turn(residual**2)
    for _ in range(_MAX_ITERATIONS):
        normal = np.einsum("mkri,mkrj->mkij", gradient, gradient)
        slope = np.einsum("mkri,mkr->mki", gradient, residual)
        damped = normal * (1 + damping[..., None, None] * np.eye(2))
        step_m = -np.einsum("mkij,mkj->mki", _inverse_2x2(damped), slope)
        tried_m = position_m + step_m
        tried_residual, tried_gradient = stack.residual(tried_m)
        tried_cost = _in_turn(tried_residual**2)
        better = moving & (tried_cost < cost)
        position_m = np.where(better[..., None], tried_m, position_m)
        residual = np.where(better[..., None], tried_residual, residual)
        gradient = np.where(better[..., None, None], tried_gradient, gradient)
        cost = np.where(better, tried_cost, cost)
        damping = np.where(better, damping * 0.2, damping * 10.0)
        moving &= np.linalg.norm(step_m, axis=-1) > _STEP_M
        going = np.flatnonzero(moving)
        if len(going) <= 0.8 * len(rows):
            found_m[rows], found_cost[rows] = position_m[:, 0], cost[:, 0]
            rows, stack = rows[going], stack.take(going)
            position_m, residual, gradient = position_m[going], residual[going], gradient[going]
            cost, damping, moving = cost[going], damping[going], moving[going]
        if not len(rows):
            break
    found_m[rows], found_cost[rows] = position_m[:, 0], cost[:, 0]
    return found_m.reshape(starts_m.shape), found_cost.reshape(starts_m.shape[:2])


def _in_turn(values: Float) -> Float:
    """Sum over the last axis from first to last: empty places at its end change no bit of it."""
    return np.asarray(np.cumsum(values, axis=-1)[..., -1])


def _inverse_2x2(matrix: Float) -> Float:
    """Inverses (..., 2, 2) of positive matrices; a singular one becomes huge, not an error."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    floor = np.maximum(1e-14 * (a + d) ** 2, 1e-150)
    determinant = np.maximum(a * d - b * c, floor)
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(adjugate / determinant[..., None, None])


class StartRule(NamedTuple):
    """What fixes must satisfy to confirm a start (Eqs. 4-5)."""

    m: int  #: fixes that agree, at least 3
    n: int  #: running cycles that they are among, at least m
    v_min_mps: float
    v_max_mps: float
    a_max_mps2: float


def confirm_start(fixes: Fixes, rule: StartRule) -> Start | None:
    """The first position that M of the fixes of N running cycles confirm (Eqs. 4-5).

        v_min Δt ≤ |r_j - r_{j-1}| ≤ v_max Δt                                  (4)
        |(r_{j+1} - r_j) / Δt' - (r_j - r_{j-1}) / Δt| ≤ a_max (Δt + Δt') / 2   (5)

    Δt is the true time between two fixes, since cycles without a fix lie between them, and the
    difference of Eq. 5 is a vector's, by its norm.  The window slides by one cycle; where several
    chains qualify (several returns of one cycle), the one with the least sum of accelerations
    starts the track, at its last fix.

    Parameters
    ----------
    fixes : the consistent ones; one that its own travel times contradict confirms nothing

    Returns
    -------
    start : None when nothing is ever confirmed
    """
    m, n, v_min_mps, v_max_mps, a_max_mps2 = rule
    for cycle in np.unique(fixes.cycle):
        newest = np.flatnonzero(fixes.cycle == cycle)
        window = np.flatnonzero((fixes.cycle > cycle - n) & (fixes.cycle < cycle))
        chains = np.array(
            [(*past, last) for past in combinations(window, m - 1) for last in newest], dtype=int
        ).reshape(-1, m)
        chains = chains[
            np.all(np.diff(fixes.cycle[chains], axis=1) > 0, axis=1)
            & np.all(np.diff(fixes.t_s[chains], axis=1) > 0, axis=1)
        ]
        speed_mps, acceleration_mps2 = _chain_motion(fixes, chains)
        kept = np.all((speed_mps >= v_min_mps) & (speed_mps <= v_max_mps), axis=1)
        kept &= np.all(acceleration_mps2 <= a_max_mps2, axis=1)
        if np.any(kept):
            effort = np.where(kept, acceleration_mps2.sum(axis=1), np.inf)
            last = chains[np.argmin(effort), -1]
            east_m, north_m = fixes.position_enu_m[last, :2].tolist()
            return Start(float(fixes.t_s[last]), east_m, north_m, int(cycle) + 1, "m_of_n")
    return None


def _chain_motion(fixes: Fixes, chains: Int) -> tuple[Float, Float]:
    """Speeds (k, m - 1) and accelerations (k, m - 2) along chains of fixes (k, m)."""
    step_s = np.diff(fixes.t_s[chains], axis=1)
    velocity_mps = np.diff(fixes.position_enu_m[chains, :2], axis=1) / step_s[..., None]
    between_s = 0.5 * (step_s[:, 1:] + step_s[:, :-1])
    change_mps = np.linalg.norm(np.diff(velocity_mps, axis=1), axis=-1)
    return np.linalg.norm(velocity_mps, axis=-1), change_mps / between_s
