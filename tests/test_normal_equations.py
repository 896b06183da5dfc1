# SPDX-License-Identifier: Apache-2.0
"""Banded equations against dense ones that are put together row by row."""

import numpy as np
import pytest
from dives import case, posed, wrong_states
from oracles_best import simulated

from abyssnav.estimation import map_estimator
from abyssnav.estimation.block_tridiagonal import invert_chain
from abyssnav.estimation.map_estimator import _linearise, weighted_terms
from abyssnav.estimation.normal_equations import (
    eliminate_nodes,
    make_slots,
    node_step,
    normal_equations,
    solve_constants,
)


def dense(problem, terms):
    """Whitened Jacobian and residuals of everything but the constants' priors."""
    n, m, s = len(problem.t_node_s), len(terms.constant), terms.rows.by_node.shape[1]
    node_of_row = np.concatenate(
        [problem.observations.times.node, np.repeat(problem.observations.positions.node, 2)]
    )
    J, r = [], []

    def add(blocks, by_constant, residual, variance):
        row = np.zeros(s * n + m)
        for node, values in blocks:
            row[s * node : s * node + s] += values
        row[s * n : s * n + len(by_constant)] = by_constant
        J.append(row / np.sqrt(variance))
        r.append(residual / np.sqrt(variance))

    for i, information in enumerate(terms.information):
        if information > 0:
            add([(node_of_row[i], terms.rows.by_node[i])], terms.rows.by_constant[i],
                terms.rows.residual[i], 1 / information)  # fmt: skip
    motion, drift = terms.motion, terms.drift
    for i in range(n - 1):
        for axis in (0, 1):
            unit = np.eye(s)[axis]
            blocks = [
                (i, motion.step.by_first[i, axis] + unit),
                (i + 1, motion.step.by_second[i, axis] - unit),
            ]
            add(blocks, motion.step.by_constant[i, axis], motion.miss_m[i, axis],
                motion.variance_m2[i])  # fmt: skip
    for i in range(n):
        for place in range(s - 2):
            unit = np.eye(s)[2 + place]
            blocks = [(i, -unit)]
            if i:
                blocks.append((i - 1, drift.factor[i, place] * unit))
            add(blocks, [], drift.miss[i, place], drift.variance[i, place])
    for i in range(n):
        for axis in (0, 1):
            add([(i, np.eye(s)[axis])], [], 0.0, 1e10)
    return np.array(J), np.array(r)


@pytest.fixture(params=[(4, False), (5, False), (4, True)])
def equations(request):
    count, slow_times = request.param
    world = case(duration_s=900.0, count=count)
    setting = world.setting
    states = wrong_states(world.problem, 3, size=0.02)
    states = states._replace(node=states.node + world.true_states().node)
    states = states.with_slow_times() if slow_times else states
    terms, _, _ = weighted_terms(setting, _linearise(setting, states), setting.prior, 30.0)
    return world, terms, normal_equations(terms, world.problem.slots)


def test_the_step_is_that_of_dense_least_squares(equations):
    world, terms, normal = equations
    n, s, m = normal.border.shape
    J, r = dense(world.problem, terms)
    sigma = np.sqrt(terms.constant_variance)
    prior = np.hstack([np.zeros((m, s * n)), np.diag(1 / sigma)])
    J, r = np.vstack([J, prior]), np.concatenate([r, -terms.constant / sigma])
    scale = np.sqrt(np.sum(J**2, axis=0))
    expected = np.linalg.lstsq(J / scale, r, rcond=None)[0] / scale
    factored = eliminate_nodes(normal)
    step = solve_constants(factored, terms.constant, terms.constant_variance)
    np.testing.assert_allclose(step.step / sigma, expected[s * n :] / sigma, atol=1e-4)
    found = node_step(factored, step.step)
    np.testing.assert_allclose(found[:, :2], expected[: s * n].reshape(n, s)[:, :2], atol=1e-3)


def test_covariances_are_blocks_of_the_dense_inverse(equations):
    world, terms, normal = equations
    n, s, m = normal.border.shape
    J, _ = dense(world.problem, terms)
    unit = np.sqrt(terms.constant_variance)
    J = np.vstack([J, np.hstack([np.zeros((m, s * n)), np.diag(1 / unit)])])
    scale = np.sqrt(np.sum(J**2, axis=0))
    cov = np.linalg.inv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    factored = eliminate_nodes(normal)
    known = invert_chain(factored.levels)
    step = solve_constants(factored, terms.constant, terms.constant_variance)
    V, C = factored.spread, step.covariance
    np.testing.assert_allclose(
        C / np.outer(unit, unit), cov[s * n :, s * n :] / np.outer(unit, unit), atol=1e-4
    )
    for k in (0, 3, n // 2, n - 1):
        block = cov[s * k : s * k + s, s * k : s * k + s]
        sigma = np.sqrt(np.diag(block))
        found = known.own[k] + V[k] @ C @ V[k].T
        np.testing.assert_allclose(
            found / np.outer(sigma, sigma), block / np.outer(sigma, sigma), atol=1e-4
        )
    for k in (0, n // 2, n - 2):
        block = cov[s * k + s : s * k + 2 * s, s * k : s * k + s]
        sigma = np.sqrt(
            np.outer(np.diag(cov)[s * k + s : s * k + 2 * s], np.diag(cov)[s * k : s * k + s])
        )
        found = known.next[k] + V[k + 1] @ C @ V[k].T
        np.testing.assert_allclose(found / sigma, block / sigma, atol=1e-4)


def test_the_evidence_of_a_prior_is_the_integral_by_the_book(equations):
    """ln ∫ N(b; 0, Λ⁻¹) exp(-½ |r - J x|²) over all: its difference between two priors."""
    world, terms, normal = equations
    n, s, m = normal.border.shape
    J, r = dense(world.problem, terms)
    factored = eliminate_nodes(normal)
    found, expected = [], []
    for times in (1.0, 3.0):
        sigma = times * np.sqrt(terms.constant_variance)
        found.append(solve_constants(factored, terms.constant, sigma**2).log_evidence)
        prior = np.hstack([np.zeros((m, s * n)), np.diag(1 / sigma)])
        whole, rest = np.vstack([J, prior]), np.concatenate([r, -terms.constant / sigma])
        scale = np.sqrt(np.sum(whole**2, axis=0))
        x = np.linalg.lstsq(whole / scale, rest, rcond=None)[0]
        misfit = np.sum((rest - whole / scale @ x) ** 2)
        log_det = (
            np.linalg.slogdet((whole / scale).T @ (whole / scale))[1] + 2 * np.log(scale).sum()
        )
        expected.append(-0.5 * misfit - 0.5 * log_det - np.log(sigma).sum())
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], abs=1e-3)


def test_slots_hold_every_row_once():
    node = np.random.default_rng(1).integers(0, 20, 300)
    slots = make_slots(node)
    held = slots.rows[slots.rows < 300]
    assert np.array_equal(np.sort(held), np.arange(300))
    ends = np.append(slots.begins[1:], len(slots.rows))
    for begin, end, number in zip(slots.begins, ends, slots.nodes, strict=True):
        rows = slots.rows[begin:end]
        assert np.all(node[rows[rows < 300]] == number)


def test_a_linear_dive_without_outliers_is_solved_in_one_step():
    """The second step moves nothing: what is left is the curvature of ranges."""
    world = posed(simulated(3, 900.0, "clean"))
    at = map_estimator.estimate_map(
        world.setting, world.true_states(), schedule=map_estimator.Schedule(False, (), 4)
    )
    again = map_estimator.estimate_map(
        world.setting, at.states, schedule=map_estimator.Schedule(False, (), 1)
    )
    assert np.abs(again.states.node[:, :2] - at.states.node[:, :2]).max() < 1e-2
