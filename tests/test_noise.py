# SPDX-License-Identifier: Apache-2.0
"""Noise that is larger than stated is learned by beacon; stated noise stays what it is."""

import numpy as np
import pytest
from oracles_best import JUDGE, MODEL, SIGMA_S, simulated

from abyssnav.config import Config
from abyssnav.estimation.adaptive_noise import Noise
from abyssnav.estimation.tracker import track
from abyssnav.estimation.two_state import ACCEPTED
from abyssnav.navigate import navigate

R = SIGMA_S**2


def taught(noise_sigma_s, told_s2=0.25 * R, n=400, seed=1, gamma=9.21):
    """Noise of one beacon after n innovations, those inside the gate learned from."""
    noise, rng = Noise(1, SIGMA_S), np.random.default_rng(seed)
    for nu in rng.normal(0, np.sqrt(told_s2 + noise_sigma_s**2), n).tolist():
        S = told_s2 + noise.variance_s2(0)
        if nu**2 <= gamma * S:
            noise.learn(0, nu, S)
    return noise


@pytest.mark.parametrize("seed", range(5))
def test_times_as_noisy_as_stated_change_nothing(seed):
    assert taught(SIGMA_S, seed=seed).variance_s2(0) == R


def test_quieter_times_than_stated_change_nothing():
    assert taught(0.2 * SIGMA_S).variance_s2(0) == R


@pytest.mark.parametrize("times", [2.0, 3.0, 4.0])
def test_louder_times_are_learned_through_the_gate(times):
    found = [taught(times * SIGMA_S, seed=seed).variance_s2(0) / R for seed in range(9)]
    assert 0.7 * times**2 < np.median(found) < 1.3 * times**2


def test_a_filter_that_knows_less_than_a_time_learns_nothing_from_it():
    assert taught(3 * SIGMA_S, told_s2=50 * R).variance_s2(0) == R


def test_no_beacon_is_believed_to_be_louder_than_five_times():
    noise = Noise(2, SIGMA_S)
    for _ in range(500):
        noise.learn(1, 3 * np.sqrt(noise.variance_s2(1)), noise.variance_s2(1))
    assert noise.variance_s2(1) == pytest.approx(25 * R, rel=1e-3)
    assert noise.variance_s2(0) == R


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_dive_noisier_than_stated_is_tracked_and_its_covariance_says_so(seed):
    """5 ms where 2 are stated; the gate of stated noise alone would turn away every sixth."""
    acoustics = {"detection": 0.8, "gross": 0.1, "sigma_s": 0.005}
    heard = simulated(seed, 7200.0, "clean", acoustics=acoustics)
    trail, start = track(heard.beacon, heard.ping, heard.legs, heard.steps, MODEL, JUDGE)
    late = heard.steps.t_s > start.t_s + 2400
    good = np.isin(heard.rows, np.flatnonzero(heard.simulation.replies.label == 0))
    assert np.mean(trail.decision[late & good] == ACCEPTED) > 0.95
    assert 3.0 < np.median(trail.noise_s2[late]) / R < 9.0
    e = (trail.x[:, :2] - heard.true_m(heard.steps.t_s))[late]
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(trail.P[late, :2, :2]), e)
    assert np.mean(nees) < 4.5


@pytest.mark.parametrize(("sigma_s", "ok"), [(0.002, True), (0.006, False)])
def test_noise_that_had_to_be_learned_is_told(sigma_s, ok):
    acoustics = {"detection": 0.9, "gross": 0.05, "sigma_s": sigma_s}
    solution = navigate(simulated(5, 3600.0, "clean", acoustics=acoustics).dive, Config())
    (check,) = [c for c in solution.checks if c.name == "noise_over_stated"]
    assert check.ok is ok
    if ok:
        assert check.detail == ""
        assert check.value < 1.3
    else:
        assert 2.2 < check.value < 3.8
        assert " ms, not 2.0 ms" in check.detail


def test_a_dive_as_noisy_as_stated_keeps_its_noise():
    heard = simulated(4, 3600.0, "voyage_1")
    trail, _ = track(heard.beacon, heard.ping, heard.legs, heard.steps, MODEL, JUDGE)
    told = np.isfinite(trail.noise_s2)
    assert np.mean(trail.noise_s2[told] == R) > 0.98
