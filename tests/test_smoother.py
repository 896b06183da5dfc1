# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from dives import case, inputs_of
from oracles_best import cached, only, simulated

from abyssnav.config import Config
from abyssnav.estimation.consistency import widest_covariance
from abyssnav.estimation.dive_problem import Anchor, ErrorPriors
from abyssnav.estimation.smoother import (
    FirstGuess,
    heading_error,
    interpolate_posterior,
    positions,
    smooth,
)
from abyssnav.navigate import navigate
from abyssnav.tables import Fixes, Positions

PRIORS = ErrorPriors()


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def along_truth(heard, off_m=(0.0, 0.0)):
    t_s = np.arange(heard.motion.t_s[0], heard.motion.t_s[-1], 60.0)
    return FirstGuess(t_s, heard.true_m(t_s) + off_m)


def smoothed(heard, beginning=None, fixes=None, priors=PRIORS, **more):
    beginning = along_truth(heard) if beginning is None else beginning
    return smooth(inputs_of(heard, **more), heard.ping, priors, beginning, fixes)


def fixes_along(heard, off_m=2.0, every_s=48.0, seed=1):
    """Consistent fixes scattered around the truth."""
    t_s = np.arange(heard.motion.t_s[0] + 60, heard.motion.t_s[-1] - 60, every_s)
    scatter_m = np.random.default_rng(seed).normal(0, off_m, (len(t_s), 2))
    places = np.column_stack([heard.true_m(t_s) + scatter_m, np.full(len(t_s), -4900.0)])
    n, whole = len(t_s), np.arange(len(t_s))
    cov = np.repeat(np.eye(2)[None], n, axis=0)
    return Fixes(t_s, t_s, whole, whole, places, cov, whole * 0 + 3, whole * 0.0, whole >= 0)


def error_m(heard, result, t_s):
    return np.hypot(*(positions(result.posterior, t_s) - heard.true_m(t_s)).T)


def test_the_track_passes_through_the_nodes():
    result = smoothed(cached())
    t_s = result.posterior.problem.t_node_s
    found_m, cov_m2 = interpolate_posterior(result.posterior, t_s)
    np.testing.assert_allclose(found_m, result.posterior.states.node[:, :2], atol=1e-6)
    np.testing.assert_allclose(cov_m2, result.posterior.node_cov[:, :2, :2], atol=1e-9)


def test_between_the_nodes_it_follows_the_vehicle_through_its_turns():
    heard = simulated(3, 3600.0, "clean")
    result = smoothed(heard)
    t_s = np.arange(400.0, 3300.0, 1.0)
    at_nodes = error_m(heard, result, result.posterior.problem.t_node_s[20:-10])
    assert rms(error_m(heard, result, t_s)) < 1.15 * rms(at_nodes) + 0.05


def test_places_do_not_depend_on_which_others_are_asked_for():
    posterior = smoothed(cached()).posterior
    t_s = np.arange(100.0, 200.0, 1.0)
    np.testing.assert_array_equal(positions(posterior, t_s)[::7], positions(posterior, t_s[::7]))


def test_it_covers_the_whole_dive_and_one_heading_error_at_every_instant():
    heard = cached()
    posterior = smoothed(heard).posterior
    t_s = heard.motion.t_s
    assert posterior.problem.t_node_s[0] == t_s[0]
    assert posterior.problem.t_node_s[-1] >= t_s[-1]
    error_rad = heading_error(posterior, t_s, heard.motion.heading_rad)
    assert np.all(np.abs(np.degrees(error_rad)) < 8.0)


def test_forty_minutes_without_replies_are_bridged_with_an_honest_covariance():
    """Replies of the middle 40 minutes taken out: error over sigma stays that of a normal one."""
    ratios = []
    for seed in (4, 5, 6, 7):
        heard = simulated(seed, 5400.0, acoustics={"detection": 0.8})
        kept = (heard.t_s < 1500) | (heard.t_s > 3900)
        fewer = only(heard, kept)
        t_s = np.arange(1600.0, 3900.0, 100.0)
        position_m, cov_m2 = interpolate_posterior(smoothed(fewer).posterior, t_s)
        error = position_m - heard.true_m(t_s)
        ratios.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov_m2), error))
    assert 0.2 < np.mean(ratios) < 4.0


@pytest.mark.parametrize("off_m", [(400.0, -200.0), (-1500.0, 900.0)])
def test_a_beginning_that_is_lost_is_found_again_by_the_fixes(off_m):
    heard = cached()
    lost = along_truth(heard, off_m)
    result = smoothed(heard, lost, fixes_along(heard))
    assert rms(error_m(heard, result, np.arange(400.0, 3300.0, 5.0))) < 2.0


def test_replies_that_agree_on_a_place_out_of_reach_are_not_followed_there():
    """Nine of ten replies of ten minutes: 300 m away from one ping to the next, and back again."""
    from_s, for_s, offset_m = 1000.0, 600.0, np.array([280.0, 100.0])
    decoy = {"from_s": from_s, "for_s": for_s, "share": 0.9, "offset_m": tuple(offset_m)}
    heard = simulated(5, 3000.0, "voyage_1", acoustics={"detection": 0.8}, decoy=decoy)
    there = along_truth(heard)
    misled = (there.t_s >= from_s) & (there.t_s < from_s + for_s)
    beginning = there._replace(position_m=there.position_m + misled[:, None] * offset_m)
    result = smoothed(heard, beginning)
    assert error_m(heard, result, there.t_s).max() < 20.0


def test_without_any_beginning_there_is_no_track():
    heard = cached()
    assert smooth(inputs_of(heard), heard.ping, PRIORS, None, None) is None


def test_without_a_filter_it_begins_at_the_fixes():
    heard = cached()
    result = smooth(inputs_of(heard), heard.ping, PRIORS, None, fixes_along(heard))
    assert rms(error_m(heard, result, np.arange(400.0, 3300.0, 5.0))) < 2.0


def test_positions_of_other_means_carry_a_dive_without_beacons():
    heard = simulated(2, 3600.0)
    none = slice(0, 0)
    deaf = only(heard, none)
    t_s = np.arange(30.0, 3570.0, 30.0)
    rng = np.random.default_rng(1)
    measured_m = heard.true_m(t_s) + rng.normal(0, 3.0, (len(t_s), 2))
    measured_m[10] += 300.0  # one that is wrong
    cov_m2 = np.repeat(9.0 * np.eye(2)[None], len(t_s), axis=0)
    table = Positions(t_s, measured_m, cov_m2, np.zeros((len(t_s), 3)))
    result = smoothed(deaf, FirstGuess(t_s, measured_m), positions=table)
    off_m = error_m(heard, result, np.arange(300.0, 3300.0, 5.0))
    assert rms(off_m) < 1.8
    assert result.estimate.weight[2 * 10] < 0.01


def test_a_known_start_holds_the_track():
    heard = simulated(2, 3600.0)
    none = slice(0, 0)
    deaf = only(heard, none)
    place = heard.true_m(np.array([100.0]))[0]
    start = Anchor(100.0, (float(place[0]), float(place[1])), 1.0)
    result = smoothed(deaf, FirstGuess(np.array([100.0]), place[None] + 20.0), start=start)
    assert error_m(heard, result, np.array([100.0]))[0] < 0.5
    _, cov_m2 = interpolate_posterior(result.posterior, np.array([100.0, 3500.0]))
    assert np.sqrt(cov_m2[0, 0, 0]) == pytest.approx(1.0, abs=0.1)
    assert np.sqrt(cov_m2[1, 0, 0]) > 10.0


def test_short_dives_are_not_asked_what_is_wrong():
    assert smoothed(simulated(1, 900.0)).causes == ()
    assert len(smoothed(simulated(1, 1800.0)).causes) > 5


@pytest.mark.parametrize(
    ("pattern", "least_m", "most_m"), [("circle", 1.0, 2.5), ("lawn_mower", 0.0, 0.4)]
)
def test_the_radius_holds_a_lever_arm_that_nobody_gave_where_no_turn_tells_it(
    pattern, least_m, most_m
):
    heard = simulated(1, 2400.0, "voyage_1", vehicle={"pattern": pattern})
    narrow, wide = (
        smoothed(heard, priors=dataclasses.replace(PRIORS, unstated_lever_m=sigma_m))
        for sigma_m in (1e-3, 1.0)
    )
    np.testing.assert_array_equal(wide.posterior.states.node, narrow.posterior.states.node)
    np.testing.assert_array_equal(wide.posterior.constant_cov, narrow.posterior.constant_cov)
    own, other = (np.trace(widest_covariance(r), axis1=1, axis2=2) for r in (narrow, wide))
    assert least_m < np.sqrt(np.median(other - own) / 2) < most_m


def test_water_track_is_learned_as_a_velocity_in_the_earth_frame():
    """A quarter of an hour through a current of 0.2 m/s, the DVL's samples all valid."""
    heard = simulated(2, 5400.0)
    t_s = heard.motion.t_s
    drifted = 0.2 * np.clip(t_s - 2000.0, 0.0, 900.0)
    motion = dataclasses.replace(
        heard.motion,
        displacement_m=heard.motion.displacement_m - np.column_stack([drifted, 0 * drifted]),
    )
    result = smoothed(heard._replace(motion=motion))
    off_m = error_m(heard, result, np.arange(400.0, 5000.0, 5.0))
    assert off_m.max() < 12.0  # where the current begins and ends at once
    assert result.posterior.noise.drift_sigma[0, 2] > 0.02


def test_the_window_of_a_long_dive_has_noise_of_its_own():
    problem = case(duration_s=1800.0).problem
    assert problem.n_windows == 1
    heard = simulated(1, 5 * 3600.0, "voyage_1", acoustics={"detection": 0.3})
    result = smoothed(heard)
    assert result.posterior.problem.n_windows == 3
    assert result.posterior.noise.drift_sigma.shape == (3, 5)


def test_leaving_methods_out_moves_no_estimate():
    dive = cached().dive
    alone = navigate(dive, _methods("smoother")).tracks["smoother"]
    among = navigate(dive, _methods("all")).tracks["smoother"]
    np.testing.assert_array_equal(alone.position_enu_m, among.position_enu_m)
    np.testing.assert_array_equal(alone.position_cov_m2, among.position_cov_m2)


def _methods(*names):
    import msgspec

    config = Config()
    output = msgspec.structs.replace(config.output, methods=names)
    return msgspec.structs.replace(config, output=output)
