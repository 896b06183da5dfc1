# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import numpy as np
import pytest
from oracles_best import (
    JUDGE,
    MODEL,
    SIGMA_S,
    SMALL,
    cached,
    derivative,
    flight_time,
    random_states,
    random_world,
    step_noise,
    textbook_filter,
    transition,
)

from abyssnav.estimation.model import N_STATES, observe
from abyssnav.estimation.tracker import track
from abyssnav.estimation.two_state import ACCEPTED, TwoStates, filter_travel_times
from abyssnav.estimation.update import Judge, advance, correct, predict, rows
from abyssnav.tables import DECISIONS, Start


def some_covariance(seed):
    rng = np.random.default_rng(seed)
    sigma = np.array([8.0, 8.0, 0.03, 0.004, 0.001, 0.02, 0.02, 0.01, 0.01, 0.1, 0.1])
    root = rng.normal(0, 1, (N_STATES, N_STATES)) / math.sqrt(N_STATES)
    return sigma[:, None] * (root @ root.T) * sigma


@pytest.mark.parametrize("n_beacons", [4, 5, 7])
def test_a_step_is_the_textbooks_with_derivatives_by_differences(n_beacons):
    prepared, paths, _, _ = random_world(n_beacons, 30, seed=n_beacons)
    x, of = random_states(30, seed=1), rows(prepared, paths, MODEL)
    for i in range(1, 30):
        P = some_covariance(i)
        after, P_after, FP = advance(of, i, x[i], P)
        expected_F = derivative(lambda y, i=i: transition(y, prepared, i, MODEL), x[i], SMALL)
        np.testing.assert_allclose(after, transition(x[i], prepared, i, MODEL), atol=1e-10)
        np.testing.assert_allclose(FP @ np.linalg.inv(P), expected_F, atol=1e-6, rtol=1e-5)
        expected = expected_F @ P @ expected_F.T + step_noise(prepared, i, MODEL)
        np.testing.assert_allclose(P_after, expected, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("n_beacons", [4, 5, 7])
def test_one_reply_at_a_time_predicts_what_whole_columns_do(n_beacons):
    prepared, paths, _, _ = random_world(n_beacons, 50, seed=20 + n_beacons)
    x, of = random_states(50, seed=2), rows(prepared, paths, MODEL)
    times_s, gradients = observe(x, prepared, paths)
    for i in range(50):
        predicted_s, H = predict(of, i, x[i])
        assert predicted_s == pytest.approx(times_s[i], rel=1e-14)
        np.testing.assert_allclose(H, gradients[i], rtol=1e-9, atol=1e-13)
        expected = derivative(lambda y, i=i: flight_time(y, prepared, paths, i), x[i], SMALL)
        np.testing.assert_allclose(H, expected, rtol=1e-5, atol=1e-7)


def test_a_correction_is_the_matrix_update_in_josephs_form_and_in_the_information_form():
    prepared, paths, _, _ = random_world(5, 40, seed=3)
    of = rows(prepared, paths, MODEL)
    for i, x in enumerate(random_states(40, seed=4)):
        P = some_covariance(i)
        seen = correct(of, i, x, P, Judge(SIGMA_S, np.inf))
        H = derivative(lambda y, i=i: [flight_time(y, prepared, paths, i)], x, SMALL)
        nu = paths.flight_time_s[i] - flight_time(x, prepared, paths, i)
        S = (H @ P @ H.T)[0, 0] + SIGMA_S**2
        K = P @ H.T / S
        A = np.eye(N_STATES) - K @ H
        joseph = A @ P @ A.T + SIGMA_S**2 * K @ K.T
        sigma = np.sqrt(np.diag(P))
        assert seen.inside
        assert seen.innovation_s == pytest.approx(nu, rel=1e-12)
        assert seen.variance_s2 == pytest.approx(S, rel=1e-5)
        np.testing.assert_allclose((seen.x - x) / sigma, K[:, 0] * nu / sigma, rtol=1e-4, atol=1e-4)
        unit = np.outer(sigma, sigma)
        np.testing.assert_allclose(seen.P / unit, joseph / unit, atol=1e-5)
        information = np.linalg.inv(P / unit) + unit * (H.T @ H) / SIGMA_S**2
        np.testing.assert_allclose(seen.P / unit, np.linalg.inv(information), atol=1e-4)
        np.testing.assert_allclose(seen.P / unit, seen.P.T / unit, atol=1e-14)


def test_a_reply_outside_the_gate_moves_nothing_and_one_just_inside_counts():
    prepared, paths, _, _ = random_world(4, 4, seed=5)
    x, P = random_states(1, seed=6)[0], some_covariance(1)
    seen = correct(rows(prepared, paths, MODEL), 0, x, P, Judge(SIGMA_S, np.inf))
    reach_s = math.sqrt(9.21 * seen.variance_s2)
    for share, inside in ((0.999, True), (1.001, False), (-0.999, True), (-1.001, False)):
        late = paths.flight_time_s.copy()
        late[0] = seen.predicted_s + share * reach_s
        of = rows(prepared, dataclasses.replace(paths, flight_time_s=late), MODEL)
        again = correct(of, 0, x, P, Judge(SIGMA_S, 9.21))
        assert again.inside is inside
        assert np.array_equal(again.x, x) is not inside
        assert np.array_equal(again.P, P) is not inside


def huber_cost(x, prior, P, prepared, paths, i, kappa):
    r = abs(paths.flight_time_s[i] - flight_time(x, prepared, paths, i)) / SIGMA_S
    loss = r**2 if r <= kappa else 2 * kappa * r - kappa**2
    return (x - prior) @ np.linalg.solve(P, x - prior) + loss


@pytest.mark.parametrize("late_sigmas", [0.3, 4.0, 50.0, 1000.0])
def test_a_huber_update_is_the_least_of_hubers_cost(late_sigmas):
    prepared, paths, _, _ = random_world(4, 4, seed=7)
    x, P = random_states(1, seed=8)[0], some_covariance(2) * 1e-2
    late = paths.flight_time_s.copy()
    late[0] = predict(rows(prepared, paths, MODEL), 0, x)[0] + late_sigmas * SIGMA_S
    paths = dataclasses.replace(paths, flight_time_s=late)
    seen = correct(rows(prepared, paths, MODEL), 0, x, P, Judge(SIGMA_S, np.inf, huber=1.345))
    least = huber_cost(seen.x, x, P, prepared, paths, 0, 1.345)
    rng, root = np.random.default_rng(9), np.linalg.cholesky(P)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(100):
            aside = seen.x + size * root @ rng.normal(0, 1, N_STATES)
            assert huber_cost(aside, x, P, prepared, paths, 0, 1.345) > least - 1e-9 * (1 + least)
    assert np.all(np.linalg.eigvalsh(seen.P / np.outer(*[np.sqrt(np.diag(P))] * 2)) > 0)


def start_of(heard, row):
    """The true place at a reply, as a start that somebody else found."""
    e, n = heard.true_m(heard.steps.t_s[[row]])[0]
    return row, Start(float(heard.steps.t_s[row]), float(e), float(n), 1, "m_of_n")


def test_the_filter_over_a_dive_is_the_textbooks_in_matrices():
    heard = cached()
    given = start_of(heard, 8)
    trail, _ = track(heard.beacon, heard.ping, heard.legs, heard.steps, MODEL, JUDGE, given)
    free = np.flatnonzero(np.isin(trail.decision, (ACCEPTED, 1)))[:120]
    assert np.all(np.diff(free) == 1), "no duplicate among the first"
    expected = textbook_filter(trail.x[8], trail.P[8], heard.steps, heard.legs, free, MODEL, JUDGE)
    for i, (x, P, accepted, nu, S) in zip(free, expected, strict=True):
        assert bool(trail.decision[i] == ACCEPTED) is bool(accepted)
        sigma = np.sqrt(np.diag(P))
        unit = np.outer(sigma, sigma)
        np.testing.assert_allclose((trail.x[i] - x) / sigma, 0, atol=1e-4)
        np.testing.assert_allclose(trail.P[i] / unit, P / unit, atol=1e-4)
        assert trail.innovation_s[i] == pytest.approx(nu, abs=1e-8)
        assert trail.variance_s2[i] == pytest.approx(S, rel=1e-4)


def test_without_errors_to_learn_it_is_the_papers_two_state_filter():
    heard = cached()
    row, start = start_of(heard, 8)
    none = MODEL._replace(
        position_m2_per_s=0.3, heading_sigma_rad=0.0, dvl_scale_sigma=0.0, sound_scale_sigma=0.0,
        deviation_sigma_rad=(0.0, 0.0), held_sigma_mps=0.0,
    )  # fmt: skip
    trail, _ = track(heard.beacon, heard.ping, heard.legs, heard.steps, none, JUDGE, (row, start))
    assert trail.segment.max() == 0, "a recovery would part them"
    usable = np.zeros(len(heard.dive.replies), dtype=bool)
    usable[heard.rows] = True
    motion = dataclasses.replace(heard.motion, gap_variance_m2=np.zeros(len(heard.motion)))
    nodes, found = filter_travel_times(
        heard.dive.replies, usable, heard.legs, motion, start, TwoStates(10.0, 0.3, SIGMA_S, 9.21)
    )
    assert [DECISIONS[d] for d in found.decision[heard.rows][row + 1 :]] == [
        DECISIONS[d] for d in trail.decision[row + 1 :]
    ]
    accepted = trail.decision == ACCEPTED
    np.testing.assert_allclose(trail.x[accepted, :2], nodes.position_m[1:], atol=1e-6)
    np.testing.assert_allclose(trail.P[accepted, :2, :2], nodes.position_cov_m2[1:], atol=1e-6)
    assert not trail.x[row:, 2:].any()


def test_with_beacons_far_away_it_is_the_linear_kalman_filter():
    """Straight wave fronts: h is linear, and the joint normal distribution has the same answer."""
    prepared, paths, _, _ = random_world(5, 40, seed=11, spread_m=1e8)
    none = MODEL._replace(
        heading_sigma_rad=0.0, dvl_scale_sigma=0.0, sound_scale_sigma=0.0,
        deviation_sigma_rad=(0.0, 0.0), held_sigma_mps=0.0, start_sigma_m=100.0,
    )  # fmt: skip
    x0 = np.zeros(N_STATES)
    away_m = np.hypot(*paths.aim_reply_m.T), np.hypot(*paths.aim_ping_m.T)
    H = -paths.aim_reply_m / (away_m[0] * paths.speed_reply_mps)[:, None]
    H = H - paths.aim_ping_m / (away_m[1] * paths.speed_ping_mps)[:, None]
    run_m = prepared.run_m - prepared.run_m[0]
    at_run = np.zeros((40, N_STATES))
    at_run[:, :2] = run_m
    predicted_s, _ = observe(at_run, prepared, paths)
    rng = np.random.default_rng(12)
    drift_m = np.concatenate([[[0, 0]], np.cumsum(rng.normal(0, 0.3, (39, 2)), axis=0)])
    z = np.einsum("ni,ni->n", H, drift_m + np.array([30.0, -20.0])) + rng.normal(0, SIGMA_S, 40)
    paths = dataclasses.replace(paths, flight_time_s=predicted_s + z)
    # the joint distribution of all deviations from the run and all times, conditioned at once
    t_s = prepared.t_s - prepared.t_s[0]
    over_time = 100.0**2 + none.position_m2_per_s * np.minimum.outer(t_s, t_s)
    cov = np.kron(over_time, np.eye(2))
    G = np.zeros((40, 80))
    for i in range(40):
        G[i, 2 * i : 2 * i + 2] = H[i]
    of, x, P = rows(prepared, paths, none), x0, np.diag(none.prior_variance())
    for i in range(40):
        if i:
            x, P, _ = advance(of, i, x, P)
        seen = correct(of, i, x, P, Judge(SIGMA_S, np.inf))
        x, P = seen.x, seen.P
        g, last = G[: i + 1], slice(2 * i, 2 * i + 2)
        gain = cov[last] @ g.T @ np.linalg.inv(g @ cov @ g.T + SIGMA_S**2 * np.eye(i + 1))
        np.testing.assert_allclose(x[:2], run_m[i] + gain @ z[: i + 1], atol=2e-2)
        np.testing.assert_allclose(P[:2, :2], cov[last, last] - gain @ g @ cov[:, last], atol=1e-3)
