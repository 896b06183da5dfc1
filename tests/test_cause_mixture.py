# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from dives import posed
from oracles_best import simulated

from abyssnav.estimation.cause_mixture import ConstantPriors, weigh_causes
from abyssnav.estimation.map_estimator import estimate_map


def mixture(world):
    found = estimate_map(world.setting, world.true_states())
    priors = ConstantPriors(
        found.noise.constant_sigma, world.setting.prior.constant_sigma, world.setting.stated
    )
    return found, weigh_causes(found.factored, found.states.constant, priors)


def likeliest(mix):
    return max(mix.causes, key=lambda cause: cause.weight)


def late(heard, by_s, beacon=None):
    """The same dive with turn-arounds that are longer than stated."""
    times_s = heard.geometry.flight_time_s + by_s * (
        True if beacon is None else heard.beacon == beacon
    )
    return heard._replace(geometry=dataclasses.replace(heard.geometry, flight_time_s=times_s))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_where_nothing_is_wrong_nothing_is_blamed(seed):
    found, mix = mixture(posed(simulated(seed, 3600.0, "voyage_1")))
    assert likeliest(mix).name == ""
    assert sum(c.weight for c in mix.causes) == pytest.approx(1.0)
    sigma = np.sqrt(np.diag(mix.constant_cov))
    assert np.all(np.abs(mix.constant_step) < 2 * np.sqrt(np.diag(found.constant_cov)) + sigma)


@pytest.mark.parametrize("beacon", [0, 2])
def test_one_turn_around_that_is_wrong_is_named(beacon):
    heard = late(simulated(1, 3600.0, "voyage_1"), 0.006, beacon)
    _, mix = mixture(posed(heard))
    blamed = [c for c in mix.causes if c.beacon == beacon and c.log_gain > 0]
    assert {c.name for c in blamed} & {"turn_around", "beacon_moved"}
    by_beacon = [sum(c.weight for c in mix.causes if c.beacon == b) for b in range(4)]
    assert np.argmax(by_beacon) == beacon


def test_a_lever_arm_that_nobody_told_is_named_and_measured():
    heard = simulated(1, 3600.0, "voyage_1", vehicle={"transducer_offset_m": (5.0, 0.0, 0.0)})
    found, mix = mixture(posed(heard))
    assert likeliest(mix).name == "lever_arm"
    assert (found.states.constant + mix.constant_step)[9] == pytest.approx(5.0, abs=0.7)


def test_the_spread_between_causes_is_in_the_covariance():
    _, mix = mixture(posed(late(simulated(1, 3600.0, "voyage_1"), 0.002, 1)))
    sigma = np.sqrt(np.diag(mix.constant_cov))
    assert np.all(np.linalg.eigvalsh(mix.constant_cov / np.outer(sigma, sigma)) > 1e-9)


def test_what_all_turn_arounds_have_in_common_stays_in_the_covariance_far_from_the_beacons():
    vehicle = {"centre_m": (3000.0, 0.0)}
    world = posed(late(simulated(2, 3600.0, "voyage_1", vehicle=vehicle), 0.005))
    estimate, mix = mixture(world)
    spread = estimate.factored.spread
    node_m = (estimate.states.node - spread @ mix.constant_step)[:, :2]
    cov_m2 = (estimate.marginals.own + spread @ mix.constant_cov @ spread.swapaxes(1, 2))[:, :2, :2]
    error_m = node_m - world.heard.true_m(world.problem.t_node_s)
    assert np.mean(np.hypot(*error_m.T)) > 1.0  # no reply tells
    nees = np.einsum("ni,nij,nj->n", error_m, np.linalg.inv(cov_m2), error_m)
    assert np.mean(nees) < 4.0
