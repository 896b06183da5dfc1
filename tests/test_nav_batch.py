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
    moved,
    random_states,
    random_world,
    transition,
)

from abyssnav.estimation import normal_equations as equations
from abyssnav.estimation.map_estimator import estimate, left_out, robust_cost
from abyssnav.estimation.model import observe
from abyssnav.estimation.normal_equations import NODE, SHARED, Problem, normal_equations
from abyssnav.estimation.smoother import one_a_ping, smooth
from abyssnav.estimation.tracker import track


def begun(heard, n):
    """The first n replies, their smoothed states and who may take part."""
    steps, legs = heard.steps[:n], heard.legs[:n]
    trail, _ = track(heard.beacon[:n], heard.ping[:n], legs, steps, MODEL, JUDGE)
    x = smooth(trail, steps, legs, SIGMA_S)
    x[:, SHARED] = x[-1, SHARED]
    return x, steps, legs, one_a_ping(x, heard.ping[:n], heard.beacon[:n], steps, legs)


@pytest.fixture
def each_alone(monkeypatch):
    """Every reply is a node, so that matrices by the book are easy to write down."""
    monkeypatch.setattr(equations, "_NODE_S", 0.0)


def unpacked(y, n):
    """States (n, 11) from the n nodes of five and the six shared ones behind."""
    x = np.empty((n, 11))
    x[:, NODE] = y[: 5 * n].reshape(n, 5)
    x[:, SHARED] = y[5 * n :]
    return x


def packed(x):
    return np.concatenate([x[:, NODE].ravel(), x[0, SHARED]])


def misfits(y, steps, legs, part, weight):
    """Every term of the cost over its standard deviation, one long vector, reply by reply."""
    n = len(steps)
    x, sigma = unpacked(y, n), np.sqrt(MODEL.prior_variance())
    terms = []
    for i in range(n):
        if part[i]:
            late_s = legs.flight_time_s[i] - flight_time(x[i], steps, legs, i)
            terms.append(math.sqrt(weight[i]) * late_s / SIGMA_S)
    for i in range(1, n):
        dt_s = steps.t_s[i] - steps.t_s[i - 1]
        q = np.full(5, MODEL.position_m2_per_s * dt_s + 1e-6)
        for place, time_s in (
            (2, MODEL.heading_time_s),
            (3, MODEL.held_time_s),
            (4, MODEL.held_time_s),
        ):
            q[place] = sigma[NODE[place]] ** 2 * (1 - math.exp(-2 * dt_s / time_s)) + 1e-12
        terms += list((x[i] - transition(x[i - 1], steps, i, MODEL))[NODE] / np.sqrt(q))
    terms += list(x[0, NODE[2:]] / sigma[NODE[2:]])
    terms += list(x[0, SHARED] / sigma[SHARED])
    return np.array(terms)


def jacobian(y, n, *world):
    size = np.concatenate([np.tile(SMALL[NODE], n), SMALL[SHARED]])
    return derivative(lambda z: misfits(z, *world), y, size)


def dense_solution(x, steps, legs, part, weight, rounds=6):
    """Gauss-Newton with the whole Jacobian at once; states and covariance."""
    n, y = len(x), packed(x)
    for _ in range(rounds):
        J = jacobian(y, n, steps, legs, part, weight)
        y = y - np.linalg.lstsq(J, misfits(y, steps, legs, part, weight), rcond=None)[0]
    J = jacobian(y, n, steps, legs, part, weight)
    return unpacked(y, n), np.linalg.inv(J.T @ J)


def test_it_is_the_dense_joint_solution_with_its_weights_and_its_covariance(each_alone):
    x, steps, legs, part = begun(cached(), 30)
    found = estimate(x, steps, legs, MODEL, SIGMA_S, part, (1.0,) * 40)
    weight = (9.0 / (9.0 + found.residual**2)) ** 2
    assert weight.min() < 0.1
    assert weight.max() > 0.9
    expected, _ = dense_solution(found.x, steps, legs, part, weight, rounds=3)
    _, cov = dense_solution(found.x, steps, legs, part, np.sqrt(weight), rounds=0)
    sigma = np.sqrt(MODEL.prior_variance())
    np.testing.assert_allclose(found.x[:, :2], expected[:, :2], atol=2e-3)
    np.testing.assert_allclose(found.x / sigma, expected / sigma, atol=2e-3)
    unit = sigma[NODE]
    for i in range(30):
        block = cov[5 * i : 5 * i + 5, 5 * i : 5 * i + 5] / np.outer(unit, unit)
        np.testing.assert_allclose(found.node_cov[i] / np.outer(unit, unit), block, atol=2e-3)
        np.testing.assert_allclose(
            found.position_cov_m2[i],
            cov[5 * i : 5 * i + 2, 5 * i : 5 * i + 2],
            rtol=5e-3,
            atol=1e-3,
        )
    unit = np.outer(sigma[SHARED], sigma[SHARED])
    np.testing.assert_allclose(found.shared_cov / unit, cov[150:, 150:] / unit, atol=2e-3)
    np.testing.assert_array_equal(found.heading_variance_rad2, found.node_cov[:, 2, 2])


def test_on_a_robust_loss_it_is_scipys_least_squares(each_alone):
    """Geman-McClure's loss written down for an optimiser that knows nothing of weights."""
    from scipy.optimize import least_squares

    x, steps, legs, part = begun(cached(), 30)
    found = estimate(x, steps, legs, MODEL, SIGMA_S, part, (10.0, 5.0, 2.5, 1.25, *(1.0,) * 60))
    weight = np.ones(30)

    def robust(y):
        r = misfits(y, steps, legs, part, weight)
        m = int(part.sum())
        r[:m] = r[:m] * np.sqrt(9.0 / (9.0 + r[:m] ** 2))  # squared: ρ(r) = c² r² / (c² + r²)
        return r

    def slope(y):
        J = jacobian(y, 30, steps, legs, part, weight)
        r, m = misfits(y, steps, legs, part, weight), int(part.sum())
        J[:m] *= ((9.0 / (9.0 + r[:m] ** 2)) ** 1.5)[:, None]
        return J

    begin = packed(found.x)
    best = least_squares(robust, begin, jac=slope, x_scale="jac", xtol=1e-12, ftol=1e-12)
    cost = robust_cost(found.x, steps, legs, MODEL, SIGMA_S, part)
    assert cost == pytest.approx(2 * best.cost, rel=1e-4)
    np.testing.assert_allclose(found.x[:, :2], unpacked(best.x, 30)[:, :2], atol=0.02)


def test_the_cost_is_the_sum_of_all_squared_misfits():
    x, steps, legs, part = begun(cached(), 30)
    x = x + np.random.default_rng(2).normal(0, 1, x.shape) * 0.1 * np.sqrt(MODEL.prior_variance())
    x[:, SHARED] = x[0, SHARED]
    terms, m = misfits(packed(x), steps, legs, part, np.ones(30)), int(part.sum())
    robust = 9.0 * terms[:m] ** 2 / (9.0 + terms[:m] ** 2)
    expected = robust.sum() + np.sum(terms[m:] ** 2)
    assert robust_cost(x, steps, legs, MODEL, SIGMA_S, part) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("n_beacons", [4, 5, 7])
def test_the_banded_equations_are_the_dense_ones(each_alone, n_beacons):
    """A, B and D against Jᵀ J by differences, the right-hand sides against -Jᵀ r."""
    steps, legs, _, _ = random_world(n_beacons, 12, seed=n_beacons)
    rng = np.random.default_rng(n_beacons)
    sigma = np.sqrt(MODEL.prior_variance())
    x = rng.normal(0, 1, (12, 11)) * sigma
    x[:, SHARED] = x[0, SHARED]
    weight = rng.uniform(0.1, 1.0, 12)
    of = Problem.of(steps, legs, MODEL, SIGMA_S)
    normal = normal_equations(of, x, *of.observe(x), weight)
    A = np.zeros((60, 60))
    for below, diagonal in enumerate(normal.band):
        length = 60 - below
        A[np.arange(below, 60), np.arange(length)] = diagonal[:length]
        A[np.arange(length), np.arange(below, 60)] = diagonal[:length]
    found = np.block([[A, normal.border], [normal.border.T, normal.shared]])
    world = (steps, legs, np.ones(12, dtype=bool), weight)
    J, r = jacobian(packed(x), 12, *world), misfits(packed(x), *world)
    size = np.sqrt(np.diag(J.T @ J))
    np.testing.assert_allclose(
        found / np.outer(size, size), (J.T @ J) / np.outer(size, size), atol=1e-5
    )
    right = np.concatenate([normal.right_node, normal.right_shared])
    np.testing.assert_allclose(right / size, -J.T @ r / size, rtol=1e-4, atol=1e-2)


def test_a_time_is_told_by_its_node_as_by_its_own_states():
    """Several replies a node: prediction and derivatives by differences, carried by the book."""
    steps, legs, _, _ = random_world(5, 40, seed=3)
    steps = dataclasses.replace(steps, t_s=np.sort(np.random.default_rng(3).uniform(0, 100, 40)))
    of = Problem.of(steps, legs, MODEL, SIGMA_S)
    assert 6 < len(of.begins) < 12
    assert np.all(steps.t_s - steps.t_s[of.begins][of.node] <= 10.0)
    x = random_states(len(of.begins), seed=4)
    late_s, H = of.observe(x)

    def told(y, i, first):
        there = y.copy()
        there[:2] += moved(
            y, steps.run_m[i] - steps.run_m[first], steps.linear_m[i] - steps.linear_m[first]
        )
        return flight_time(there, steps, legs, i)

    for i in range(40):
        first, y = of.begins[of.node[i]], x[of.node[i]]
        assert late_s[i] == pytest.approx(legs.flight_time_s[i] - told(y, i, first), abs=1e-12)
        expected = derivative(lambda z, i=i, first=first: told(z, i, first), y, SMALL)
        np.testing.assert_allclose(H[i], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("scenario", ["voyage_1", "voyage_2"])
def test_a_node_for_several_replies_says_what_one_for_each_does(monkeypatch, scenario):
    x, steps, legs, part = begun(cached(scenario=scenario), 400)
    shared = estimate(x, steps, legs, MODEL, SIGMA_S, part)
    monkeypatch.setattr(equations, "_NODE_S", 0.0)
    alone = estimate(x, steps, legs, MODEL, SIGMA_S, part)
    sigma_m = np.sqrt(np.trace(alone.position_cov_m2, axis1=1, axis2=2))
    apart_m = np.hypot(*(shared.x[:, :2] - alone.x[:, :2]).T)
    assert 0 < apart_m.max() < 0.15 * sigma_m.min()
    np.testing.assert_allclose(
        np.trace(shared.position_cov_m2, axis1=1, axis2=2), sigma_m**2, rtol=0.1
    )


def test_the_weight_in_the_covariance_is_the_efficiency_of_the_estimate():
    """Variance of a Geman-McClure estimate over that of a mean, by its influence function."""
    r = np.linspace(-10, 10, 200_001)
    share = np.exp(-(r**2) / 2) / np.sqrt(2 * np.pi) * (r[1] - r[0])
    root = 9 / (9 + r**2)
    slope = root**2 - 4 / 9 * r**2 * root**3
    variance = np.sum(share * (r * root**2) ** 2) / np.sum(share * slope) ** 2
    assert np.sum(share * root) == pytest.approx(1 / variance, abs=0.01)


def test_stretches_that_brought_their_own_scales_end_with_the_same_ones():
    x, steps, legs, part = begun(cached(), 120)
    apart = x.copy()
    apart[:50, SHARED] += 2 * np.sqrt(MODEL.prior_variance()[SHARED])
    found = estimate(apart, steps, legs, MODEL, SIGMA_S, part)
    same = estimate(x, steps, legs, MODEL, SIGMA_S, part)
    assert np.ptp(found.x[:, SHARED], axis=0).max() == 0.0
    np.testing.assert_allclose(found.x[:, :2], same.x[:, :2], atol=0.05)


def test_a_reply_that_takes_no_part_moves_nothing():
    x, steps, legs, part = begun(cached(), 80)
    part = part.copy()
    part[40] = False
    late = legs.flight_time_s.copy()
    late[40] += 0.001
    with_it = estimate(x, steps, legs, MODEL, SIGMA_S, part)
    moved = estimate(x, steps, dataclasses.replace(legs, flight_time_s=late), MODEL, SIGMA_S, part)
    np.testing.assert_array_equal(with_it.x, moved.x)
    assert moved.residual[40] - with_it.residual[40] == pytest.approx(0.5, rel=1e-6)


def test_a_gate_that_was_wrong_is_overruled():
    """A bounce 4 ms late that a filter took in, and a good reply that it left out."""
    heard = cached()
    x, steps, legs, part = begun(heard, 200)
    clean = estimate(x, steps, legs, MODEL, SIGMA_S, part)
    late = legs.flight_time_s.copy()
    late[100] += 0.020
    wrong = estimate(x, steps, dataclasses.replace(legs, flight_time_s=late), MODEL, SIGMA_S, part)
    assert abs(wrong.residual[100]) > 7
    assert np.abs(wrong.x[:, :2] - clean.x[:, :2]).max() < 0.3


@pytest.mark.parametrize("scenario", ["voyage_1", "voyage_2"])
def test_what_is_left_out_is_missed_as_by_an_estimate_that_never_heard_it(scenario):
    heard = cached(scenario=scenario)
    x, steps, legs, part = begun(heard, 400)
    whole = estimate(x, steps, legs, MODEL, SIGMA_S, part)
    part = part & (np.abs(whole.residual) < 3)
    late_s, variance_s2 = left_out(whole, steps, legs, MODEL, part, heard.beacon[:400])
    for beacon in np.unique(heard.beacon[:400]):
        own = heard.beacon[:400] == beacon
        without = estimate(whole.x, steps, legs, MODEL, SIGMA_S, part & ~own)
        sigma_s = np.sqrt(variance_s2[own])
        apart = (without.residual[own] * SIGMA_S - late_s[own]) / sigma_s
        assert np.sqrt(np.mean(apart**2)) < 0.2
        _, H = observe(without.x[own], steps[own], legs[own])
        cov = without.node_cov[own]
        told_s2 = np.einsum("ni,nij,nj->n", H[:, NODE], cov, H[:, NODE]) + SIGMA_S**2
        np.testing.assert_allclose(sigma_s, np.sqrt(told_s2), rtol=0.1)


def test_one_reply_alone_is_solved_too():
    x, steps, legs, part = begun(cached(), 30)
    one = estimate(x[20:21], steps[20:21], legs[20:21], MODEL, SIGMA_S, part[20:21])
    assert np.isfinite(one.x).all()
    assert one.node_cov.shape == (1, 5, 5)


def test_many_replies_at_one_instant_are_solved_too():
    x, steps, legs, part = begun(cached(), 60)
    t_s = steps.t_s.copy()
    t_s[30:34] = t_s[30]
    again = dataclasses.replace(steps, t_s=t_s)
    found = estimate(x, again, legs, MODEL, SIGMA_S, part)
    assert np.isfinite(found.x).all()
    assert np.abs(found.x[:, :2] - x[:, :2]).max() < 5.0
