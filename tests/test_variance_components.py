# SPDX-License-Identifier: Apache-2.0
"""Sigmas that the simulator knows and the estimate was never told."""

import numpy as np
import pytest
from dives import case, posed
from oracles_best import simulated

from abyssnav.estimation.dive_states import N_COMMON
from abyssnav.estimation.map_estimator import Schedule, estimate_map
from abyssnav.estimation.variance_components import fading_time


def learned(seed=1, duration_s=5400.0, **changes):
    world = posed(simulated(seed, duration_s, "clean", **changes))
    return world, estimate_map(world.setting, world.true_states())


@pytest.mark.parametrize("sigma_s", [0.001, 0.002, 0.005])
def test_the_noise_of_times_is_recovered(sigma_s):
    _, found = learned(acoustics={"sigma_s": sigma_s, "gross": 0.1, "detection": 0.8})
    np.testing.assert_allclose(found.noise.observation_sigma[:4], sigma_s, rtol=0.2)


def test_a_drifting_compass_is_recognised():
    world, found = learned(compass={"slow_sigma_deg": 5.0, "slow_time_s": 600.0})
    heading = np.degrees(found.noise.drift_sigma[:, 0])
    assert 2.0 < heading.max() < 8.0
    assert found.noise.drift_sigma[0, 2] < 5 * world.setting.prior.drift_sigma[0, 2]


def test_a_compass_that_drifts_within_a_minute_has_its_time_learned_towards_it():
    world, found = learned(compass={"slow_sigma_deg": 3.0, "slow_time_s": 60.0})
    prior_s = world.setting.prior.drift_time_s[..., 0].min()
    assert found.noise.drift_time_s[..., 0].min() < 0.5 * prior_s


def test_a_fading_time_is_told_by_uneven_steps():
    rng = np.random.default_rng(5)
    step_s, x = np.tile([24.0, 24.0, 96.0], 20_000), [0.0]
    for fade, kick in zip(np.exp(-step_s / 600.0), rng.normal(size=len(step_s)), strict=True):
        x.append(fade * x[-1] + np.sqrt(1 - fade**2) * kick)
    x, t_s = np.array(x), np.append(0.0, np.cumsum(step_s))
    told_s = fading_time(np.sum(x[1:] * x[:-1]), np.sum(x[:-1] ** 2), t_s)
    assert told_s == pytest.approx(600.0, rel=0.1)


def test_nominal_sensors_keep_their_priors():
    world, found = learned()
    for after, before in zip(found.noise[1:4], world.setting.prior[1:4], strict=True):
        assert np.abs(np.log(after / before)).max() < np.log(3.0)


def test_a_compass_that_deviates_much_is_believed_to():
    world, found = learned(compass={"deviation_sigma_deg": (4.0, 1.5)})
    ratio = found.noise.constant_sigma[1:5] / world.setting.prior.constant_sigma[1:5]
    assert ratio.max() > 1.3


def test_told_sigmas_of_beacons_are_learned_only_upwards():
    world = case()
    setting = world.setting._replace(stated=np.ones(world.problem.n_beacons, dtype=bool))
    found = estimate_map(setting, world.true_states())
    beacons = slice(N_COMMON, None)
    assert np.all(found.noise.constant_sigma[beacons] >= setting.prior.constant_sigma[beacons])


def test_no_sigma_moves_by_more_than_two_in_a_step():
    heard = simulated(1, 3600.0, "clean", compass={"slow_sigma_deg": 8.0, "slow_time_s": 300.0})
    world = posed(heard)
    prior = world.setting.prior
    one = estimate_map(world.setting, world.true_states(), schedule=Schedule(most_steps=1)).noise
    for after, before in zip(one, prior, strict=True):
        assert np.abs(np.log(after / before)).max() <= np.log(2) + 1e-9
