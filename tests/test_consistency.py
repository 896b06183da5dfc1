# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from dives import posed
from oracles_best import cached, simulated
from test_smoother import smoothed

from abyssnav.estimation.consistency import forward_backward, widest_covariance
from abyssnav.estimation.dive_problem import row_sigma, states_along
from abyssnav.estimation.left_out import leave_beacons_out
from abyssnav.estimation.map_estimator import Schedule, estimate_map
from abyssnav.estimation.normal_equations import eliminate_nodes, normal_equations


@pytest.fixture(scope="module")
def result():
    return smoothed(cached())


def test_what_is_left_out_is_missed_as_by_an_estimate_that_never_heard_it(result):
    heard = cached()
    missed_s, sigma_s = leave_beacons_out(result.setting, result.estimate)
    for beacon in range(4):
        own = heard.beacon == beacon
        fewer = heard._replace(
            replies=heard.replies[~own], ping=heard.ping[~own], rows=heard.rows[~own],
            geometry=heard.geometry[~own],
        )  # fmt: skip
        world = posed(fewer)
        noise = result.estimate.noise
        without = estimate_map(
            world.setting, world.true_states(), noise, schedule=Schedule(False, (), 8)
        )
        whole = posed(heard)
        states = states_along(
            whole.problem,
            whole.inputs.motion,
            world.problem.t_node_s,
            without.states.node[:, :2],
        )
        states = states._replace(constant=without.states.constant)
        seen = estimate_map(whole.setting, states, noise, Schedule(learn=False, most_steps=0))
        sigma = row_sigma(whole.problem, noise)
        late_s = seen.residual * sigma
        good = own & (result.weight > 0.5)
        assert rms((late_s - missed_s)[good] / sigma_s[good]) < 0.3


def test_left_out_beacons_are_missed_as_expected_where_nothing_is_wrong():
    ratios = []
    for seed in range(1, 7):
        whole = smoothed(simulated(seed, 3600.0, "voyage_1"))
        missed_s, sigma_s = leave_beacons_out(whole.setting, whole.estimate)
        good = whole.weight > 0.5
        ratios.append(np.mean((missed_s / sigma_s)[good] ** 2))
    assert 0.4 < np.mean(ratios) < 1.6


def test_a_beacon_that_is_not_where_the_log_says_is_missed_by_more():
    heard = simulated(1, 3600.0, "voyage_1")
    aim = heard.geometry.virtual_beacon_ping_m.copy(), heard.geometry.virtual_beacon_reply_m.copy()
    for leg in aim:
        leg[heard.beacon == 1] += [9.0, -6.0]
    geometry = dataclasses.replace(
        heard.geometry, virtual_beacon_ping_m=aim[0], virtual_beacon_reply_m=aim[1]
    )
    result = smoothed(heard._replace(geometry=geometry))
    missed_s, sigma_s = leave_beacons_out(result.setting, result.estimate)
    ratio = [
        rms((missed_s / sigma_s)[(heard.beacon == b) & (np.abs(missed_s) < 0.05)]) for b in range(4)
    ]
    assert max(ratio) > 1.7


def test_past_and_future_of_a_node_are_what_is_left_of_the_equations(result):
    """Information of the past on a node: the equations of a dive that ends there."""
    apart_m, _ = forward_backward(result)
    terms, slots = result.estimate.terms, result.setting.problem.slots
    n = len(apart_m)
    for k in (n // 3, n // 2):
        past = _without(terms, result.setting.problem, k, after=True)
        future = _without(terms, result.setting.problem, k, after=False)
        ends = [eliminate_nodes(normal_equations(part, slots)) for part in (past, future)]
        x = [f.node[k, :2] for f in ends]
        assert np.hypot(*(x[0] - x[1])) == pytest.approx(apart_m[k], rel=0.02, abs=0.02)


def _without(terms, problem, k, *, after):
    """The terms with everything after (or up to) node k of no weight."""
    node_of_row = problem.observations.times.node
    rows = node_of_row > k if after else node_of_row <= k
    ties = (
        np.arange(len(terms.motion.miss_m)) >= k
        if after
        else np.arange(len(terms.motion.miss_m)) < k
    )
    drift_rows = (
        np.arange(len(terms.drift.miss)) > k if after else np.arange(len(terms.drift.miss)) <= k
    )
    huge = 1e12
    return terms._replace(
        information=np.where(rows, 0.0, terms.information),
        motion=terms.motion._replace(variance_m2=np.where(ties, huge, terms.motion.variance_m2)),
        drift=terms.drift._replace(
            variance=np.where(drift_rows[:, None], huge, terms.drift.variance)
        ),
    )


def test_forward_and_backward_agree_with_their_claims_where_nothing_is_wrong():
    ratios = []
    for seed in range(1, 6):
        apart_m, claimed_m = forward_backward(smoothed(simulated(seed, 3600.0, "voyage_1")))
        known = np.isfinite(apart_m)
        ratios.append(rms(apart_m[known]) / rms(claimed_m[known]))
    assert 0.5 < np.mean(ratios) < 1.2


def test_the_widest_covariance_is_never_less_than_the_tracks(result):
    wide = widest_covariance(result)
    own = result.posterior.node_cov[:, :2, :2]
    assert np.all(np.trace(wide, axis1=1, axis2=2) > 0.98 * np.trace(own, axis1=1, axis2=2))


def test_times_that_are_quieter_than_stated_narrow_no_radius():
    quiet = {"sigma_s": 0.0002, "stated_sigma_s": 0.002}
    result = smoothed(simulated(3, 3600.0, "voyage_1", acoustics=quiet))
    assert result.sigma_s.max() < 0.001
    unlearned = estimate_map(
        result.setting, result.estimate.states, schedule=Schedule(False, (), 3)
    ).node_cov()[:, :2, :2]
    wide = np.trace(widest_covariance(result), axis1=1, axis2=2)
    assert np.all(wide > 0.98 * np.trace(unlearned, axis1=1, axis2=2))


def rms(values):
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))
