# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from oracles_best import (
    JUDGE,
    MODEL,
    SIGMA_S,
    SMALL,
    cached,
    derivative,
    moved,
    random_world,
    simulated,
    step_noise,
    transition,
)

from abyssnav.estimation.model import N_STATES, observe
from abyssnav.estimation.smoother import between, final_states, one_a_ping, smooth, turned
from abyssnav.estimation.tracker import track
from abyssnav.estimation.two_state import ACCEPTED
from abyssnav.tables import Start


def tracked(heard, given=None, model=MODEL):
    trail, start = track(heard.beacon, heard.ping, heard.legs, heard.steps, model, JUDGE, given)
    assert start is not None
    return trail


def final(heard, trail, model=MODEL):
    return final_states(trail, heard.beacon, heard.ping, heard.steps, heard.legs, model, JUDGE)


def error_m(heard, x):
    return np.hypot(*(x[:, :2] - heard.true_m(heard.steps.t_s)).T)


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def test_smoothing_is_the_joint_solution_of_the_linearised_dive():
    """One dense normal equation of all states at all replies, linearised where the filter was."""
    heard = cached()
    trail = tracked(heard)
    first = int(np.argmax(trail.segment == 0))
    rows = np.arange(first, first + 60)
    cut = dataclasses.replace(trail)[: rows[-1] + 1]
    assert cut.segment.max() == 0
    smoothed = smooth(cut, heard.steps[: len(cut)], heard.legs[: len(cut)], SIGMA_S)

    n = len(rows)
    A, b = np.zeros((n * N_STATES, n * N_STATES)), np.zeros(n * N_STATES)

    def add(J, cov, z, places):
        """Least squares of z - J x, x being the states at the places one after the other."""
        columns = np.concatenate([np.arange(p * N_STATES, (p + 1) * N_STATES) for p in places])
        weight = np.linalg.inv(cov)
        A[np.ix_(columns, columns)] += J.T @ weight @ J
        b[columns] += J.T @ weight @ z

    unit = np.sqrt(MODEL.prior_variance())  # states in their prior's standard deviations
    add(np.eye(N_STATES), trail.P[first] / np.outer(unit, unit), trail.x[first] / unit, [0])
    for place, i in enumerate(rows[1:], start=1):
        step = derivative(
            lambda y, i=i: transition(y, heard.steps, i, MODEL), trail.x[i - 1], SMALL
        )
        F = step * unit / unit[:, None]
        Q = step_noise(heard.steps, i, MODEL)
        Q = Q / np.outer(unit, unit) + 1e-11 * np.eye(N_STATES)
        constant = trail.x_prior[i] / unit - F @ (trail.x[i - 1] / unit)
        add(np.hstack([-F, np.eye(N_STATES)]), Q, constant, [place - 1, place])
        if trail.decision[i] == ACCEPTED:
            _, H = observe(trail.x_prior[i : i + 1], heard.steps[i : i + 1], heard.legs[i : i + 1])
            z = trail.innovation_s[i] + H @ trail.x_prior[i]
            add(H * unit, np.array([[SIGMA_S**2]]), z, [place])
    joint = np.linalg.solve(A, b).reshape(n, N_STATES) * unit
    np.testing.assert_allclose(smoothed[rows, :2], joint[:, :2], atol=2e-3)
    np.testing.assert_allclose(smoothed[rows] / unit, joint / unit, atol=2e-3)


def test_states_without_variance_stay_what_they_are():
    heard = cached()
    none = MODEL._replace(dvl_scale_sigma=0.0, deviation_sigma_rad=(0.0, 0.0), held_sigma_mps=0.0)
    x = smooth(tracked(heard, model=none), heard.steps, heard.legs, SIGMA_S)
    assert not x[:, [3, 5, 6, 7, 8, 9, 10]].any()
    assert rms(error_m(heard, x)) < 1.2


def test_before_the_start_the_track_is_carried_back_by_dead_reckoning():
    heard = cached()
    trail = tracked(heard)
    first = int(np.argmax(trail.segment == 0))
    assert first > 3
    x = smooth(trail, heard.steps, heard.legs, SIGMA_S)
    for i in range(first):
        run_m = heard.steps.run_m[first] - heard.steps.run_m[i]
        linear_m = heard.steps.linear_m[first] - heard.steps.linear_m[i]
        expected = x[first, :2] - moved(x[first], run_m, linear_m)
        np.testing.assert_allclose(x[i, :2], expected, atol=1e-9)


def wrong_start(heard, east_m=250.0, north_m=-160.0, row=12):
    e, n = heard.true_m(heard.steps.t_s[[row]])[0]
    return row, Start(float(heard.steps.t_s[row]), e + east_m, n + north_m, 1, "m_of_n")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_stretch_before_a_recovery_is_repaired(seed):
    heard = simulated(seed, 1800.0, "voyage_2")
    trail = tracked(heard, wrong_start(heard))
    assert trail.segment.max() >= 1
    lost = (trail.segment == 0) & (np.arange(len(trail)) > 12)
    assert error_m(heard, trail.x)[lost].max() > 200.0
    batch, _ = final(heard, trail)
    assert error_m(heard, batch.x).max() < 6.0


@pytest.mark.parametrize("from_s", [0.0, 2000.0, 3000.0], ids=["begin", "middle", "end"])
def test_a_captured_stretch_is_repaired_wherever_it_lies(from_s):
    """Four hundred seconds and more in which most replies agree on a place 224 m away."""
    heard = simulated(
        2, 3600.0, acoustics={"detection": 0.8, "gross": 0.1},
        decoy={"from_s": from_s, "for_s": 600.0 if from_s else 400.0, "share": 0.75},
    )  # fmt: skip
    trail = tracked(heard)
    assert trail.segment.max() >= 1
    assert np.nanmax(error_m(heard, trail.x)) > 100.0
    batch, _ = final(heard, trail)
    assert error_m(heard, batch.x).max() < 6.0


def test_the_final_states_are_no_worse_than_the_filters_and_cover_the_dive():
    heard = cached(2, 3600.0, "voyage_2")
    trail = tracked(heard)
    batch, part = final(heard, trail)
    known = trail.segment >= 0
    assert rms(error_m(heard, batch.x)[known]) < rms(error_m(heard, trail.x)[known])
    assert np.isfinite(batch.x).all()
    assert part.dtype == bool
    pairs = np.stack([heard.ping, heard.beacon])
    assert len(np.unique(pairs[:, part], axis=1).T) == part.sum()
    assert len(np.unique(pairs, axis=1).T) == part.sum()


def test_of_a_beacons_replies_to_one_ping_the_best_fitting_takes_part():
    prepared, paths, _, _ = random_world(4, 6, seed=1)
    x = np.zeros((6, N_STATES))
    predicted_s, _ = observe(x, prepared, paths)
    late_s = np.array([0.004, -0.001, 0.5, 0.2, -0.3, 0.0])
    paths = dataclasses.replace(paths, flight_time_s=predicted_s + late_s)
    ping, beacon = np.array([0, 0, 0, 1, 0, 1]), np.array([2, 2, 1, 2, 1, 2])
    part = one_a_ping(x, ping, beacon, prepared, paths)
    assert part.tolist() == [False, True, False, False, True, True]


def test_turned_round_every_step_is_the_same_way_back():
    prepared, _, _, _ = random_world(4, 10, seed=2)
    back = turned(prepared)
    assert np.all(np.diff(back.t_s) > 0)
    np.testing.assert_allclose(np.diff(back.run_m, axis=0), -np.diff(prepared.run_m, axis=0)[::-1])
    np.testing.assert_array_equal(back.since_ping_m, prepared.since_ping_m[::-1])
    x = np.zeros(N_STATES)
    for i in range(1, 10):
        there = transition(x, prepared, i, MODEL)
        again = transition(there, back, 10 - i, MODEL)
        np.testing.assert_allclose(again[:2], x[:2], atol=1e-9)


def test_between_the_replies_the_track_passes_through_them_and_follows_the_reckoned_shape():
    heard = cached()
    batch, _ = final(heard, tracked(heard))
    t_s = heard.steps.t_s
    new = np.flatnonzero(np.diff(t_s, prepend=-1) > 0.05)
    position_m, cov_m2, _ = between(heard.steps, batch, heard.motion.at(t_s[new]), MODEL)
    np.testing.assert_allclose(position_m, batch.x[new, :2], atol=1e-9)
    np.testing.assert_allclose(cov_m2, batch.position_cov_m2[new], rtol=1e-6)
    i = int(new[40])
    j = int(new[41])
    middle_s = np.array([0.3 * t_s[j - 1] + 0.7 * t_s[j]])
    found_m, _, _ = between(heard.steps, batch, heard.motion.at(middle_s), MODEL)
    at = heard.motion.at(np.array([t_s[j - 1], middle_s[0], t_s[j]]))
    x = batch.x[j - 1]
    sums = at.linear_m
    part = moved(x, at.displacement_m[1] - at.displacement_m[0], sums[1] - sums[0])
    whole = moved(x, at.displacement_m[2] - at.displacement_m[0], sums[2] - sums[0])
    miss = batch.x[j, :2] - x[:2] - whole
    np.testing.assert_allclose(found_m[0], x[:2] + part + 0.7 * miss, atol=1e-9)
    assert i < j


def test_where_no_reply_was_heard_the_covariance_knows_what_compass_and_dvl_may_do():
    """Ten minutes past the last reply: the last covariance through every state's derivative."""
    heard = cached()
    batch, _ = final(heard, tracked(heard))
    rows = np.arange(100)
    cut = batch._replace(
        x=batch.x[rows], node_cov=batch.node_cov[rows], residual=batch.residual[rows]
    )
    t_end = heard.steps.t_s[99]
    t_s = np.array([t_end + 600.0])
    position_m, cov_m2, _ = between(heard.steps[rows], cut, heard.motion.at(t_s), MODEL)
    at = heard.motion.at(np.array([t_end, t_s[0]]))
    run_m, linear_m = np.diff(at.displacement_m, axis=0)[0], np.diff(at.linear_m, axis=0)[0]

    def place(y):
        return y[:2] + moved(y, run_m, linear_m)

    x = batch.x[99]
    C = np.zeros((N_STATES, N_STATES))
    C[np.ix_([3, 4, 5, 6, 7, 8], [3, 4, 5, 6, 7, 8])] = batch.shared_cov
    C[np.ix_([2, 9, 10], [2, 9, 10])] = batch.node_cov[99, 2:, 2:]
    C[:2, :2] = batch.node_cov[99, :2, :2]
    J = derivative(place, x, SMALL)
    expected = J @ C @ J.T + MODEL.position_m2_per_s * 600.0 * np.eye(2)
    np.testing.assert_allclose(position_m[0], place(x), atol=1e-9)
    np.testing.assert_allclose(cov_m2[0], expected, rtol=1e-5)
    assert np.trace(cov_m2[0]) > 2 * (np.trace(batch.position_cov_m2[99]) + 2.4)


def test_forty_minutes_without_replies_is_bridged_with_an_honest_covariance():
    """Replies of the middle 40 minutes taken out: error over sigma stays that of a normal one."""
    ratios = []
    for seed in (4, 5, 6, 7):
        heard = simulated(seed, 5400.0, acoustics={"detection": 0.8})
        kept = (heard.steps.t_s < 1500) | (heard.steps.t_s > 3900)
        some = heard._replace(
            beacon=heard.beacon[kept], ping=heard.ping[kept],
            steps=heard.steps[kept], legs=heard.legs[kept],
        )  # fmt: skip
        batch, _ = final(some, tracked(some))
        t_s = np.arange(1600.0, 3900.0, 100.0)
        position_m, cov_m2, _ = between(some.steps, batch, heard.motion.at(t_s), MODEL)
        error = position_m - heard.true_m(t_s)
        ratios.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov_m2), error))
    assert 0.2 < np.mean(ratios) < 4.0  # 2 is expected; the bridge takes no correlation off


def test_the_last_state_is_the_filters():
    heard = cached()
    trail = tracked(heard)
    x = smooth(trail, heard.steps, heard.legs, SIGMA_S)
    np.testing.assert_array_equal(x[-1], trail.x[-1])
