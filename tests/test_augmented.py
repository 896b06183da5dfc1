# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from oracles_best import (
    MODEL,
    SMALL,
    cached,
    derivative,
    flight_time,
    moved,
    random_states,
    random_world,
)

from abyssnav.estimation.model import (
    HEADING,
    N_STATES,
    carry_states,
    deviation,
    displacement,
    fading,
    observe,
    steps,
)


def closeness(found, expected):
    """Largest difference of a Jacobian's column over that column's largest entry."""
    size = np.max(np.abs(expected), axis=tuple(range(expected.ndim - 1)))
    return np.max(np.abs(found - expected) / np.where(size > 0, size, 1.0))


@pytest.mark.parametrize("n_beacons", [4, 5, 7])
def test_the_displacement_and_its_derivatives_by_every_state_are_those_of_the_equation(n_beacons):
    prepared, _, _, _ = random_world(n_beacons, 60, seed=n_beacons)
    x = random_states(60, seed=n_beacons)
    run_m, linear_m = prepared.since_ping_m, prepared.linear_since_ping_m
    d_m, by_state = displacement(x, run_m, linear_m)
    expected_m = [moved(*row) for row in zip(x, run_m, linear_m, strict=True)]
    np.testing.assert_allclose(d_m, expected_m, atol=1e-12)
    expected = [
        derivative(lambda y, i=i: moved(y, run_m[i], linear_m[i]), x[i], SMALL) for i in range(60)
    ]
    assert by_state.shape == (60, 2, N_STATES)
    assert closeness(by_state, np.array(expected)) < 1e-8


@pytest.mark.parametrize("n_beacons", [4, 5, 7])
def test_the_predicted_time_and_its_gradient_by_every_state_are_those_of_both_legs(n_beacons):
    prepared, paths, _, _ = random_world(n_beacons, 60, seed=10 + n_beacons)
    x = random_states(60, seed=n_beacons)
    predicted_s, H = observe(x, prepared, paths)
    expected_s = [flight_time(x[i], prepared, paths, i) for i in range(60)]
    np.testing.assert_allclose(predicted_s, expected_s, rtol=1e-14)
    expected = [
        derivative(lambda y, i=i: flight_time(y, prepared, paths, i), x[i], SMALL)
        for i in range(60)
    ]
    assert closeness(H, np.array(expected)) < 1e-6


def test_a_compass_and_dvl_that_are_wrong_by_known_amounts_are_put_right_exactly():
    """Ten degrees and five per cent: the true way comes back, and no small angle is assumed."""
    rng = np.random.default_rng(3)
    true_m, heading = rng.normal(0, 100, (5, 2)), np.radians(10.0)
    # a compass that reads 10 degrees too much turns the way clockwise
    c, s = np.cos(heading), np.sin(heading)
    clockwise = np.array([[c, s], [-s, c]])
    x = np.zeros((5, N_STATES))
    x[:, HEADING], x[:, 3] = heading, 0.05
    d_m, _ = displacement(x, 1.05 * true_m @ clockwise.T, np.zeros((5, 6, 2)))
    np.testing.assert_allclose(d_m, true_m, atol=1e-12)


def test_the_sums_of_the_deviation_are_derivatives_of_the_dead_reckoned_way():
    """A compass deviating by a₁ sin ψ ... put right in the readings, or by the linear states."""
    import dataclasses

    from abyssnav.estimation.dead_reckoning import dead_reckon

    heard = cached()
    dive, a = heard.dive, np.radians([0.05, -0.03, 0.02, 0.04])
    reading = dive.heading.heading_rad
    shapes = np.stack([f(k * reading) for k in (1, 2) for f in (np.sin, np.cos)], axis=-1)
    heading = dataclasses.replace(dive.heading, heading_rad=reading - shapes @ a)
    own = dive.velocity.heading_rad
    shapes = np.stack([f(k * own) for k in (1, 2) for f in (np.sin, np.cos)], axis=-1)
    velocity = dataclasses.replace(dive.velocity, heading_rad=own - shapes @ a)
    span_s = (heard.motion.t_s[0], heard.motion.t_s[-1])
    right = dead_reckon(velocity, heading, span_s, 0.1, 1.0)
    x = np.zeros((len(heard.motion), N_STATES))
    x[:, 5:9] = a
    d_m, _ = displacement(x, heard.motion.displacement_m, heard.motion.linear_m)
    far_m = np.abs(right.displacement_m - heard.motion.displacement_m).max()
    assert far_m > 0.5  # second order in the deviation is left
    np.testing.assert_allclose(d_m, right.displacement_m, atol=5e-3)


def test_steps_are_differences_of_the_running_sums():
    heard = cached()
    t_s = heard.motion.t_s
    ping_s, reply_s = np.array([100.0, 1000.2]), np.array([103.3, 1007.7])
    found = steps(heard.motion, ping_s, reply_s)
    for axis in (0, 1):
        sums = heard.motion.displacement_m[:, axis]
        grown = np.interp(reply_s, t_s, sums) - np.interp(ping_s, t_s, sums)
        np.testing.assert_allclose(found.since_ping_m[:, axis], grown, atol=1e-9)
        for j in range(4):
            sums = heard.motion.linear_m[:, j, axis]
            grown = np.interp(reply_s, t_s, sums) - np.interp(ping_s, t_s, sums)
            np.testing.assert_allclose(found.linear_since_ping_m[:, j, axis], grown, atol=1e-9)


def test_fading_keeps_a_gauss_markov_states_variance():
    for dt_s in (0.0, 3.0, 24.0, 1e4):
        a, noise = fading(dt_s, 0.03, 1000.0)
        assert a**2 * 0.03**2 + noise == pytest.approx(0.03**2, rel=1e-12)
    assert fading(1000.0, 1.0, 1000.0)[0] == pytest.approx(np.exp(-1))


def test_what_the_compass_reads_too_much_is_the_sum_of_drift_and_harmonics():
    x = np.zeros((1, N_STATES))
    x[0, 2], x[0, 5:9] = 0.01, [0.1, 0.2, 0.3, 0.4]
    psi = 0.7
    expected = 0.01 + 0.1 * np.sin(psi) + 0.2 * np.cos(psi) + 0.3 * np.sin(1.4) + 0.4 * np.cos(1.4)
    assert deviation(x, np.array([psi]))[0] == pytest.approx(expected, rel=1e-12)


def test_states_are_carried_to_any_time_with_the_covariance_of_their_errors():
    """Against the equation at each time, derivatives by differences."""
    heard = cached()
    t_nodes_s = heard.steps.t_s[[5, 9, 20]]
    x = random_states(3, seed=5)
    root = np.random.default_rng(6).normal(0, 0.01, (3, N_STATES, N_STATES))
    P = root @ np.swapaxes(root, 1, 2)
    t_s = np.array([t_nodes_s[0], t_nodes_s[0] + 0.5, t_nodes_s[1] - 1e-3, t_nodes_s[2] + 900.0])
    here = heard.motion.at(t_s)
    position_m, cov_m2, heading_rad = carry_states(t_nodes_s, x, P, heard.motion, here, MODEL)
    for row, (t, i) in enumerate(zip(t_s, [0, 0, 0, 2], strict=True)):
        at = heard.motion.at(np.array([t_nodes_s[i], t]))
        run_m = at.displacement_m[1] - at.displacement_m[0]
        linear_m = np.diff(at.linear_m, axis=0)[0]

        def place(y, run_m=run_m, linear_m=linear_m):
            return y[:2] + moved(y, run_m, linear_m)

        J = derivative(place, x[i], SMALL)
        expected = J @ P[i] @ J.T + MODEL.position_m2_per_s * (t - t_nodes_s[i]) * np.eye(2)
        np.testing.assert_allclose(position_m[row], place(x[i]), atol=1e-9)
        np.testing.assert_allclose(cov_m2[row], expected, rtol=1e-6)
        reading = at.heading_rad[1:]
        assert heading_rad[row] == pytest.approx(reading[0] - deviation(x[i : i + 1], reading)[0])
