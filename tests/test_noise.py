# SPDX-License-Identifier: Apache-2.0
"""Noise that is larger than stated is learned by beacon; stated noise stays what it is."""

import numpy as np
import pytest
from oracles_best import SIGMA_S, run, simulated

from abyssnav.config import Config
from abyssnav.estimation.two_state import ACCEPTED
from abyssnav.navigate import navigate

R = SIGMA_S**2


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_dive_noisier_than_stated_is_tracked_and_its_covariance_says_so(seed):
    """5 ms where 2 are stated; the gate of stated noise alone would turn away every sixth."""
    acoustics = {"detection": 0.8, "gross": 0.1, "sigma_s": 0.005}
    heard = simulated(seed, 7200.0, "clean", acoustics=acoustics)
    trail, start = run(heard)
    late = heard.t_s > start.t_s + 2400
    good = np.isin(heard.rows, np.flatnonzero(heard.simulation.replies.label == 0))
    assert np.mean(trail.decision[late & good] == ACCEPTED) > 0.95
    assert 3.0 < np.median(trail.noise_s2[late]) / R < 9.0
    e = (trail.x[:, :2] - heard.true_m(heard.t_s))[late]
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
    trail, _ = run(heard)
    told = np.isfinite(trail.noise_s2)
    assert np.median(trail.noise_s2[told]) == R
    assert np.all(trail.noise_s2[told] < 7 * R)
