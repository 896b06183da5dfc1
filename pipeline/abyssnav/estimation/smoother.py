# SPDX-License-Identifier: Apache-2.0
"""Fixed-interval smoother of the augmented filter, over the whole dive."""

import dataclasses

import numpy as np

from abyssnav.acoustics.travel_time import Legs
from abyssnav.estimation.adaptive_noise import louder
from abyssnav.estimation.dead_reckoning import Motion
from abyssnav.estimation.map_estimator import Batch, estimate, robust_cost
from abyssnav.estimation.model import ErrorModel, Steps, deviation, displacement, in_blocks, observe
from abyssnav.estimation.normal_equations import NODE, SHARED
from abyssnav.estimation.tracker import Trail, track
from abyssnav.estimation.update import Judge
from abyssnav.tables import Bool, Float, Int

_SATURATION = 9.0
#: How often the noise of beacons may be raised: times that a gate left out speak only afterwards.
_LOUDER_ROUNDS = 4


def final_states(
    trail: Trail,
    beacon: Int,
    ping: Int,
    steps: Steps,
    legs: Legs,
    model: ErrorModel,
    judge: Judge,
) -> tuple[Batch, Bool]:
    """Robust batch estimate of the whole dive, and the replies that may count in it.

    It begins at the smoothed trail.  Where that was lost and recovered, a stretch of it may lie so
    far off that no iteration finds back; then a filter that never asks for recovery, run forward
    and run backward, gives two more beginnings, and of the three estimates the likeliest is taken.
    Where the residuals say that a beacon's times are noisier than stated, it is made anew.

    Parameters
    ----------
    trail : with at least one row after the start
    beacon, ping, steps, legs : n rows, as the filter had them
    """
    guesses = [smooth(trail, steps, legs, judge.sigma_s)]
    if trail.segment.max() > 0:
        guesses += _unrecovered(beacon, ping, steps, legs, model, judge)
        back = turned(steps), legs[::-1]
        backward = _unrecovered(beacon[::-1], ping.max() - ping[::-1], *back, model, judge)
        guesses += [x[::-1] for x in backward]
    found = []
    sigma_s = np.sqrt(np.fmax(trail.noise_s2, judge.sigma_s**2))
    for x in guesses:
        part = one_a_ping(x, ping, beacon, steps, legs)
        batch = estimate(x, steps, legs, model, sigma_s, part)
        cost = robust_cost(batch.x, steps, legs, model, sigma_s, part)
        found.append((cost, batch, part))
    _, batch, part = min(found, key=lambda each: each[0])
    for _ in range(_LOUDER_ROUNDS):
        believed = part & (batch.residual**2 <= judge.gamma)
        sigma_s = louder(batch.sigma_s, batch.residual, believed, beacon, judge.sigma_s)
        if np.allclose(sigma_s, batch.sigma_s, rtol=0.02, atol=0):
            break
        batch = estimate(batch.x, steps, legs, model, sigma_s, part)
    return batch, part


def turned(steps: Steps) -> Steps:
    """The dive backwards: every displacement becomes negative, states still live at the reply."""
    backward = steps[::-1]
    return dataclasses.replace(backward, t_s=-backward.t_s)


def _unrecovered(
    beacon: Int, ping: Int, steps: Steps, legs: Legs, model: ErrorModel, judge: Judge
) -> list[Float]:
    """Smoothed states of a filter that is started but never recovered; none without a start."""
    trail, start = track(beacon, ping, legs, steps, model, judge, recover=False)
    return [] if start is None else [smooth(trail, steps, legs, judge.sigma_s)]


def smooth(trail: Trail, steps: Steps, legs: Legs, sigma_s: float) -> Float:
    """States at every reply from all of the dive's replies: RTS by stretches, then joined.

        G = P_k Fᵀ (P⁻_{k+1})⁻¹,    x^s_k = x_k + G (x^s_{k+1} - x⁻_{k+1})

    A recovery breaks the chain of positions, so every stretch is smoothed by itself; the later one
    then reaches back over those replies of the earlier that it explains better.  In the same way
    the first reaches back to the dive's beginning, before the start was confirmed.

    Parameters
    ----------
    trail : with at least one row after the start

    Returns
    -------
    x : (n, 11) for all usable replies
    """
    x = np.full_like(trail.x, np.nan)
    gain = _gains(trail)
    n_segments = int(trail.segment.max()) + 1
    first_of = [int(np.argmax(trail.segment == s)) for s in range(n_segments)]
    for first, end in zip(first_of, [*first_of[1:], len(trail)], strict=True):
        x[end - 1] = trail.x[end - 1]
        for k in range(end - 2, first - 1, -1):
            x[k] = trail.x[k] + gain[k + 1] @ (x[k + 1] - trail.x_prior[k + 1])
    x[: first_of[0]] = _carried_back(x[first_of[0]], first_of[0], slice(0, first_of[0]), steps)
    for first, before in zip(first_of[1:], [0, *first_of[1:]][:-1], strict=True):
        rows = slice(before, first)
        reached = _carried_back(x[first], first, rows, steps)
        later_from = before + _best_split(
            _misfit(x[rows], steps[rows], legs[rows], sigma_s),
            _misfit(reached, steps[rows], legs[rows], sigma_s),
        )
        x[later_from:first] = reached[later_from - before :]
    return x


def one_a_ping(x: Float, ping: Int, beacon: Int, steps: Steps, legs: Legs) -> Bool:
    """Of several replies of one beacon to one ping, the one that fits the states x (n, 11) best."""
    predicted_s, _ = observe(x, steps, legs)
    order = np.lexsort((np.abs(legs.flight_time_s - predicted_s), beacon, ping))
    another = np.diff(ping[order], prepend=-1) != 0
    another |= np.diff(beacon[order], prepend=-1) != 0
    chosen = np.zeros(len(x), dtype=bool)
    chosen[order[another]] = True
    return chosen


def _gains(trail: Trail) -> Float:
    """G of every row that has one before it; states without variance take no part."""
    gain = np.zeros_like(trail.P)
    first = int(np.argmax(trail.segment == 0)) + 1
    if first < len(trail):
        constant = np.diagonal(trail.P_prior[first]) == 0
        invertible = trail.P_prior[first:] + np.diag(constant.astype(float))
        gain[first:] = np.swapaxes(np.linalg.solve(invertible, trail.FP[first:]), 1, 2)
    return gain


def _carried_back(x: Float, row: int, rows: slice, steps: Steps) -> Float:
    """States of earlier replies by dead reckoning backwards from the states x at `row`."""
    d_m, _ = displacement(
        x, steps.run_m[row] - steps.run_m[rows], steps.linear_m[row] - steps.linear_m[rows]
    )
    earlier = np.repeat(x[None], len(d_m), axis=0)
    earlier[:, :2] -= d_m
    return earlier


def _misfit(x: Float, steps: Steps, legs: Legs, sigma_s: float) -> Float:
    """Squared residual of each reply over its variance, no more than the saturation."""
    predicted_s, _ = observe(x, steps, legs)
    return np.asarray(np.minimum(((legs.flight_time_s - predicted_s) / sigma_s) ** 2, _SATURATION))


def _best_split(earlier: Float, later: Float) -> int:
    """Row from which on the later stretch explains the replies better than the earlier one."""
    cost = np.concatenate([[0.0], np.cumsum(earlier - later)])
    return int(np.argmin(cost))


def between(
    steps: Steps, batch: Batch, here: Motion, model: ErrorModel
) -> tuple[Float, Float, Float]:
    """Positions, covariances and true headings at any times, from the nodes on either side.

    Forward dead reckoning from the node before misses the node after; the miss is spread over the
    stretch in proportion to time, f.  With J the derivatives of the displacement by heading error,
    scales, deviation and held velocity, C their covariance, the covariance is that of a bridge
    between its ends, no cross-covariance taken off:

        (1 - f) P_i + f P_{i+1} + f (1 - f) Q + (J(t) - f J_i) C (J(t) - f J_i)ᵀ

    Before the first and after the last node, where f = 0, it grows like a prediction.

    Parameters
    ----------
    steps, batch : n rows
    here : m rows of dead reckoning at those times

    Returns
    -------
    position_m, position_cov_m2, heading_rad : (m, 2), (m, 2, 2), (m,)
    """
    return in_blocks(lambda some: _between(steps, batch, some, model), here)


def _between(
    steps: Steps, batch: Batch, here: Motion, model: ErrorModel
) -> tuple[Float, Float, Float]:
    t_s, last = here.t_s, len(steps) - 1
    i = np.clip(np.searchsorted(steps.t_s, t_s, side="right") - 1, 0, last)
    j = np.minimum(i + 1, last)
    x = batch.x[i]
    whole_m, by_whole = displacement(
        x, steps.run_m[j] - steps.run_m[i], steps.linear_m[j] - steps.linear_m[i]
    )
    part_m, by_part = displacement(
        x, here.displacement_m - steps.run_m[i], here.linear_m - steps.linear_m[i]
    )

    q_whole = model.position_m2_per_s * (steps.t_s[j] - steps.t_s[i])
    q_part = model.position_m2_per_s * np.abs(t_s - steps.t_s[i])
    inside = (t_s >= steps.t_s[i]) & (j > i) & (q_whole > 0)
    f = np.where(inside, q_part / np.where(q_whole > 0, q_whole, 1.0), 0.0)
    miss_m = batch.x[j, :2] - x[:, :2] - whole_m
    position_m = x[:, :2] + part_m + f[:, None] * miss_m
    f = f[:, None, None]
    bridge_m2 = np.where(inside, q_part * (1 - f[:, 0, 0]), q_part)
    cov_m2 = (1 - f) * batch.position_cov_m2[i] + f * batch.position_cov_m2[j]
    cov_m2 = cov_m2 + bridge_m2[:, None, None] * np.eye(2)
    J = by_part - f * by_whole
    for states, cov in ((NODE[2:], batch.node_cov[i, 2:, 2:]), (SHARED, batch.shared_cov)):
        cov_m2 = cov_m2 + J[..., states] @ cov @ np.swapaxes(J[..., states], 1, 2)
    return position_m, cov_m2, here.heading_rad - deviation(x, here.heading_rad)
