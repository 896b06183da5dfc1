# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from dives import SMALL_NODE, case, derivative, posed, small_steps, travel_time_s, wrong_states
from oracles_best import simulated

from abyssnav.estimation.dive_states import DiveStates
from abyssnav.estimation.observations import observe
from abyssnav.tables import Positions


@pytest.mark.parametrize("count", [4, 5, 7])
def test_times_are_those_of_the_book(count):
    world = case(count=count)
    states = wrong_states(world.problem, seed=count, size=0.5)
    rows = observe(world.problem.observations, states)
    times = world.problem.observations.times
    for row in range(0, len(times), 7):
        predicted_s = times.flight_time_s[row] - rows.residual[row]
        expected_s = travel_time_s(world, row, states.node[times.node[row]], states.constant)
        assert predicted_s == pytest.approx(expected_s, abs=2e-5)  # the turns in between


@pytest.mark.parametrize(("count", "slow_times"), [(4, False), (5, True), (7, False)])
def test_derivatives_are_those_by_differences(count, slow_times):
    world = case(count=count)
    observations, states = world.problem.observations, wrong_states(world.problem, seed=count)
    states = states.with_slow_times() if slow_times else states
    steps = np.append(SMALL_NODE, np.full(states.node.shape[1] - 8, 1e-5))
    rows = observe(observations, states)

    def by_node(change):
        return -observe(observations, states._replace(node=states.node + change)).residual

    def by_constant(constant):
        return -observe(observations, states._replace(constant=constant)).residual

    expected = derivative(by_node, np.zeros(len(steps)), steps)
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(rows.by_node / scale, expected / scale, atol=1e-6)
    expected = derivative(by_constant, states.constant, small_steps(world.problem))
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(rows.by_constant / scale, expected / scale, atol=1e-6)


def test_a_position_is_seen_in_its_own_sigmas():
    heard = simulated(2, 900.0)
    t_s = np.array([100.0, 333.0, 700.0])
    cov_m2 = np.array([[[4.0, 1.0], [1.0, 9.0]]] * 3)
    off_m = np.array([[1.0, -2.0], [3.0, 0.5], [0.0, 4.0]])
    table = Positions(t_s, heard.true_m(t_s) + off_m, cov_m2, np.zeros((3, 3)))
    world = posed(heard, positions=table)
    rows = observe(world.problem.observations, world.true_states())
    whitened = rows.residual[world.problem.n_times :].reshape(3, 2)
    expected = np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(cov_m2), off_m)
    np.testing.assert_allclose(np.sum(whitened**2, axis=1), expected, rtol=0.15)


def test_derivatives_of_positions_are_those_by_differences():
    heard = simulated(2, 900.0)
    t_s = np.array([100.0, 333.0, 700.0])
    table = Positions(t_s, heard.true_m(t_s), np.array([[[4.0, 1], [1, 9]]] * 3), np.zeros((3, 3)))
    world = posed(heard, positions=table)
    observations, states = world.problem.observations, wrong_states(world.problem, 3)
    rows, first = observe(observations, states), world.problem.n_times

    def by_node(change):
        moved = DiveStates(states.node + change, states.constant)
        return -observe(observations, moved).residual[first:]

    expected = derivative(by_node, np.zeros(8), SMALL_NODE)
    np.testing.assert_allclose(rows.by_node[first:], expected, rtol=1e-5, atol=1e-6)
