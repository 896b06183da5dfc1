# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from dives import case, posed, wrong_states
from oracles_best import simulated

from abyssnav.estimation.dive_states import DiveStates
from abyssnav.estimation.map_estimator import Schedule, estimate_map, noise_change, robust_weight
from abyssnav.geometry import interpolate


def errors_m(world, estimate):
    t_s = world.problem.t_node_s
    return estimate.states.node[:, :2] - world.heard.true_m(t_s)


def nees(world, estimate):
    """Mean over the nodes of eᵀ P⁻¹ e, two where the covariance is right."""
    error, cov = errors_m(world, estimate), estimate.node_cov()[:, :2, :2]
    return float(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)))


def test_the_final_weight_is_half_at_the_gate():
    assert robust_weight(np.array([9.21]), None) == pytest.approx(0.5)
    assert robust_weight(np.array([0.0]), None) == pytest.approx(0.99, abs=0.002)
    assert robust_weight(np.array([1e9]), None) < 1e-9


def test_a_wide_weight_takes_in_what_a_narrow_one_does_not():
    square = np.array([0.0, 9.0, 90.0])
    np.testing.assert_allclose(robust_weight(square, 1.0), (9 / (9 + square)) ** 2)
    assert np.all(robust_weight(square, 30.0) >= robust_weight(square, 1.0))


def test_wherever_it_begins_it_ends_in_the_same_place():
    world = case(seed=2, count=4)
    start = world.true_states()
    away = DiveStates(start.node + np.array([25.0, -20.0, 0, 0, 0, 0, 0, 0]), start.constant)
    one, other = (estimate_map(world.setting, s) for s in (start, away))
    np.testing.assert_allclose(one.states.node[:, :2], other.states.node[:, :2], atol=0.1)


def test_the_estimate_is_where_no_small_change_is_likelier():
    """Without outliers the cost by the book is least: its slope is none in any direction."""
    world = posed(simulated(5, 900.0, "clean"))
    found = estimate_map(world.setting, world.true_states(), schedule=Schedule(learn=False))
    step = wrong_states(world.problem, 1, size=1e-3)

    def likelihood(share):
        moved = found.states.moved(share * step.node, share * step.constant)
        return estimate_map(
            world.setting, moved, schedule=Schedule(learn=False, most_steps=0)
        ).log_likelihood

    up, middle, down = (likelihood(s) for s in (1.0, 0.0, -1.0))
    assert up < middle
    assert down < middle
    assert abs(up - down) < 0.05 * (2 * middle - up - down)


def test_a_reply_20_ms_late_is_refused_and_moves_nothing():
    heard = simulated(4, 1800.0, "clean")
    world = posed(heard)
    clean = estimate_map(world.setting, world.true_states())
    late = heard.geometry.flight_time_s.copy()
    late[100] += 0.020
    other = posed(heard._replace(geometry=dataclasses.replace(heard.geometry, flight_time_s=late)))
    wrong = estimate_map(other.setting, other.true_states())
    assert wrong.weight[100] < 0.01
    assert np.abs(wrong.states.node[:, :2] - clean.states.node[:, :2]).max() < 0.5


def test_a_second_reply_of_a_beacon_to_a_ping_counts_once():
    world = case(seed=1)
    found = estimate_map(world.setting, world.true_states())
    n = world.problem.n_times
    key = world.heard.ping * 100 + world.heard.beacon
    for one in np.unique(key):
        assert found.taking_part[:n][key == one].sum() == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"compass": {"bias_deg": 25.0}},
        {"dvl": {"scale": 0.15}},
        {"compass": {"slow_sigma_deg": 5.0, "slow_time_s": 600.0}},
    ],
)
def test_gross_errors_of_compass_and_dvl_need_no_special_case(changes):
    world = posed(simulated(1, 3600.0, "voyage_1", **changes))
    found = estimate_map(world.setting, world.true_states())
    assert np.sqrt(np.mean(np.sum(errors_m(world, found) ** 2, axis=1))) < 1.5


def test_covariances_are_consistent_over_many_dives():
    values = [
        nees(world, estimate_map(world.setting, world.true_states()))
        for world in (posed(simulated(seed, 2400.0, "voyage_1")) for seed in range(20, 32))
    ]
    assert 0.7 < np.mean(values) < 2.4


def test_nothing_changed_is_no_change_of_noise():
    world = case()
    prior = world.setting.prior
    assert noise_change(prior, prior) == 0.0
    louder = prior._replace(observation_sigma=2 * prior.observation_sigma)
    assert noise_change(prior, louder) == pytest.approx(np.log(2))


def test_a_dive_without_any_reply_is_dead_reckoning_with_its_uncertainty():
    heard = simulated(1, 900.0)
    none = slice(0, 0)
    world = posed(
        heard._replace(
            rows=heard.rows[none], replies=heard.replies[none], ping=heard.ping[none],
            geometry=heard.geometry[none],
        )
    )  # fmt: skip
    start = world.true_states()
    found = estimate_map(world.setting, start)
    t_s = world.problem.t_node_s
    reckoned = interpolate(t_s, world.inputs.motion.t_s, world.inputs.motion.displacement_m)
    run = np.diff(found.states.node[:, :2], axis=0)
    np.testing.assert_allclose(run, np.diff(reckoned, axis=0), atol=0.5)
    assert np.all(found.node_cov()[:, 0, 0] > 1e4)
