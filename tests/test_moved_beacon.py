# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from oracles_best import simulated
from test_smoother import error_m, rms, smoothed

from abyssnav.estimation.learned import beacon_estimates, learned_parameters
from abyssnav.estimation.smoother import interpolate_posterior

AT_S, FAR_M = 1800.0, 15.0


def dive(seed, far_m=FAR_M):
    moved = {"one_moved_m": far_m, "one_moved_at_s": AT_S}
    return simulated(seed, 3600.0, "voyage_1", beacons=moved)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_beacon_moved_during_the_dive_is_another_one_from_then_on(seed):
    heard, sound = dive(seed), dive(seed, 0.0)
    result, other = smoothed(heard), smoothed(sound)
    assert {c.name for c in other.causes} != {"beacon_moved"}
    t_s = result.posterior.problem.t_node_s
    assert rms(error_m(heard, result, t_s)) < 1.2 * rms(error_m(sound, other, t_s)) + 0.1
    (cause,) = result.causes
    assert (cause.name, cause.beacon) == ("beacon_moved", heard.simulation.truth.odd_beacon)
    assert cause.since_s == pytest.approx(AT_S, abs=120.0)
    assert np.hypot(*result.posterior.states.beacon[-1, :2]) == pytest.approx(FAR_M, abs=3.0)
    beacons = heard.dive.beacons
    assert len(beacon_estimates(result, beacons)) == len(beacons)
    told = [p.beacon_id for p in learned_parameters(result, beacons.id, gradient_known=True)]
    assert {number for number in told if number is not None} == set(beacons.id.tolist())


def test_what_is_wrong_all_along_is_not_taken_for_a_beacon_that_was_moved():
    result = smoothed(simulated(5406, 3600.0, "nominal", beacons={"one_displaced_m": 5.0}))
    assert len(result.posterior.states.beacon) == 4
    assert all(cause.since_s is None for cause in result.causes)


@pytest.mark.parametrize("seed", [5415, 5403])
def test_times_that_err_slowly_are_taken_for_that_and_the_covariance_holds_them(seed):
    """By 3 ms in ten minutes, each beacon's by itself; NEES is 2 where a covariance is right."""
    heard = simulated(seed, 3600.0, "nominal", acoustics={"slow_sigma_s": 0.003})
    result = smoothed(heard)
    assert len(result.posterior.states.beacon) == 4
    rows = learned_parameters(result, heard.dive.beacons.id, gradient_known=True)
    (slow,) = [row for row in rows if row.name == "slow_travel_time_sigma"]
    assert 0.0015 < slow.value < 0.006
    t_s = np.arange(300.0, 3300.0, 10.0)
    place_m, cov_m2 = interpolate_posterior(result.posterior, t_s)
    off_m = place_m - heard.true_m(t_s)
    assert np.mean(np.sum(off_m * np.linalg.solve(cov_m2, off_m[..., None])[..., 0], axis=1)) < 4.0
