# SPDX-License-Identifier: Apache-2.0
"""The Cramér-Rao bound against closed forms, finite differences and one joint solve."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as with_settings

from abyssnav.geometry import interpolate
from abyssnav.simulate import bound, error_model, load_scenario, simulate
from abyssnav.simulate import cramer_rao as module
from abyssnav.simulate.cramer_rao import ErrorModel, TrueReplies, TrueTrack, posterior_bound

PERFECT = ErrorModel(
    travel_time_s=0.002,
    start_m=10.0,
    heading_bias_rad=0.0,
    harmonics_rad=(0.0, 0.0, 0.0, 0.0),
    heading_slow_rad=0.0,
    heading_slow_time_s=300.0,
    velocity_scale=0.0,
    misalignment_rad=0.0,
    velocity_slow_mps=0.0,
    velocity_slow_time_s=300.0,
    white_m2_per_s=0.0,
    sound_speed_scale=0.0,
)
FULL = replace(
    PERFECT,
    heading_bias_rad=0.026,
    harmonics_rad=(0.017, 0.017, 0.007, 0.007),
    heading_slow_rad=0.005,
    velocity_scale=0.004,
    misalignment_rad=0.005,
    velocity_slow_mps=0.004,
    white_m2_per_s=1e-3,
    sound_speed_scale=1 / 1550,
)
STATES = (
    "east", "north", "bias", "sin", "cos", "sin2", "cos2", "slow heading", "scale",
    "misalignment", "slow forward", "slow starboard", "sound",
)  # fmt: skip


def at_rest(duration_s=600.0):
    t_s = np.arange(0.0, duration_s + 0.05, 0.1)
    still = np.zeros((len(t_s), 3))
    return TrueTrack(t_s, still, np.zeros_like(t_s), np.zeros_like(t_s))


def winding(duration_s=600.0):
    """A track that turns, so that no state hides behind another."""
    t_s = np.arange(0.0, duration_s + 0.05, 0.1)
    heading = 0.5 + 0.008 * t_s + 0.6 * np.sin(t_s / 40)
    velocity = 1.2 * np.column_stack([np.sin(heading), np.cos(heading), 0 * heading])
    steps = 0.05 * (velocity[1:] + velocity[:-1])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return TrueTrack(t_s, position, heading, np.zeros_like(t_s))


def asked(t_reply_s, places, flight_s=2.7):
    """Replies from the beacons at `places` in turn, each to a ping `flight_s` earlier."""
    t_reply_s = np.asarray(t_reply_s, dtype=float)
    beacon = np.resize(np.asarray(places, dtype=float), (len(t_reply_s), 3))
    return TrueReplies(t_reply_s - flight_s, t_reply_s, beacon, np.full(len(t_reply_s), 1500.0))


def test_at_rest_information_adds_up_and_the_smoother_knows_it_from_the_beginning():
    """Two beacons square to each other: 1/P = 1/P₀ + n (2/c)²/σ², an axis."""
    times = np.repeat(np.arange(24.0, 600.0, 24.0), 2)
    result = posterior_bound(at_rest(), asked(times, [[2000, 0, 0], [0, 2000, 0]]), PERFECT)
    heard = (times[None, ::2] <= result.t_s[:, None]).sum(axis=1)
    information = 1 / 10.0**2 + heard * (2 / 1500 / 0.002) ** 2
    # a reply that falls on a row's instant comes after it
    between = ~np.isin(result.t_s, times)
    np.testing.assert_allclose(
        result.filter_m[between], np.sqrt(2 / information)[between], rtol=1e-9
    )
    np.testing.assert_allclose(result.smoother_m, np.sqrt(2 / information[-1]), rtol=1e-9)


def test_a_random_walk_settles_where_riccati_says():
    """P⁻ = (Q + √(Q² + 4 Q R)) / 2 with Q = q T and R = (σ c / 2)²."""
    times = np.repeat(np.arange(24.0, 2400.0, 24.0), 2)
    model = replace(PERFECT, white_m2_per_s=0.05)
    replies = asked(times, [[1e7, 0, 0], [0, 1e7, 0]])
    result = posterior_bound(at_rest(2400.0), replies, model, step_s=24.0)
    q, r = 0.05 * 24, (0.002 * 1500 / 2) ** 2
    before_reply = (q + np.sqrt(q**2 + 4 * q * r)) / 2
    assert result.filter_m[-2] == pytest.approx(np.sqrt(2 * before_reply), rel=1e-6)


def test_without_replies_the_error_grows_as_dead_reckoning_does():
    """Straight north at 1.2 m/s: bias and scale act on the whole way, white noise on its root."""
    t_s = np.arange(0.0, 600.05, 0.1)
    north = np.column_stack([0 * t_s, 1.2 * t_s, 0 * t_s])
    track = TrueTrack(t_s, north, np.zeros_like(t_s), np.zeros_like(t_s))
    model = replace(PERFECT, heading_bias_rad=0.02, velocity_scale=0.01, white_m2_per_s=1e-3)
    result = posterior_bound(track, asked([], [[0.0, 0.0, 0.0]]), model)
    way = 1.2 * result.t_s
    variance = 2 * (10.0**2 + 1e-3 * result.t_s) + (0.02 * way) ** 2 + (0.01 * way) ** 2
    np.testing.assert_allclose(result.filter_m, np.sqrt(variance), rtol=1e-9)
    np.testing.assert_allclose(result.smoother_m, result.filter_m, rtol=1e-6)


def test_a_loss_of_bottom_lock_adds_its_own_variance():
    track = at_rest()
    growing = TrueTrack(
        track.t_s, track.position_enu_m, track.heading_rad, np.clip(track.t_s - 200, 0, 50)
    )
    result = posterior_bound(growing, asked([], [[0.0, 0.0, 0.0]]), PERFECT)
    np.testing.assert_allclose(
        result.filter_m**2, 2 * (100 + np.clip(result.t_s - 200, 0, 50)), rtol=1e-9
    )


def reckoned(track, error):
    """Displacement that dead reckoning makes of readings which are wrong by `error`, corrected.

    The readings are the true ones; the state says what is wrong with them and takes it out.
    """
    step = np.diff(track.t_s)
    heading = 0.5 * (track.heading_rad[1:] + track.heading_rad[:-1])
    moved = np.diff(track.position_enu_m[:, :2], axis=0) / step[:, None]
    forward = moved[:, 0] * np.sin(heading) + moved[:, 1] * np.cos(heading)
    starboard = moved[:, 0] * np.cos(heading) - moved[:, 1] * np.sin(heading)
    shapes = [np.sin(heading), np.cos(heading), np.sin(2 * heading), np.cos(2 * heading)]
    turn = error[2] + error[7] + sum(a * s for a, s in zip(error[3:7], shapes, strict=True))
    forward, starboard = forward - error[10], starboard - error[11]
    forward, starboard = (
        forward * np.cos(error[9]) + starboard * np.sin(error[9]),
        starboard * np.cos(error[9]) - forward * np.sin(error[9]),
    )
    true_heading = heading - turn
    velocity = np.column_stack(
        [
            starboard * np.cos(true_heading) + forward * np.sin(true_heading),
            forward * np.cos(true_heading) - starboard * np.sin(true_heading),
        ]
    ) / (1 + error[8])
    rows = np.concatenate([np.zeros((1, 2)), np.cumsum(velocity * step[:, None], axis=0)])
    return rows + track.position_enu_m[0, :2]


@pytest.mark.parametrize("state", range(2, 12), ids=STATES[2:12])
def test_displacement_partials_are_finite_differences(state):
    track = winding()
    partials = module._displacement_partials(track, np.ones(13))
    step = np.zeros(13)
    step[state] = 1e-5
    difference = (reckoned(track, step) - reckoned(track, -step)) / 2e-5
    np.testing.assert_allclose(partials[:, :, state], difference, atol=1e-6 * 720)


@pytest.mark.parametrize("state", range(13), ids=STATES)
def test_reply_rows_are_finite_differences_of_the_travel_time(state):
    """With four beacons; the position at the ping is that at the reply less the displacement."""
    track = winding()
    places = [[1800, 300, -30], [-900, 1700, -60], [-1500, -1400, 20], [700, -1900, 10]]
    replies = asked(np.arange(50.0, 590.0, 7.3), places)
    rows = module._sensitivity(track, replies, ErrorModel(**ones()))

    def times(error):
        sums = reckoned(track, error)
        at_reply = interpolate(replies.t_reply_s, track.t_s, track.position_enu_m)[:, :2]
        at_reply = at_reply + error[:2]
        during = interpolate(replies.t_reply_s, track.t_s, sums) - interpolate(
            replies.t_ping_s, track.t_s, sums
        )
        flat, up = replies.beacon_enu_m[:, :2], replies.beacon_enu_m[:, 2]
        out = np.hypot(np.linalg.norm(at_reply - during - flat, axis=1), up)
        back = np.hypot(np.linalg.norm(at_reply - flat, axis=1), up)
        return (1 + error[12]) * (out + back) / 1500.0

    step = np.zeros(13)
    step[state] = 1e-3 if state < 2 else 1e-5
    difference = (times(step) - times(-step)) / (2 * step[state])
    np.testing.assert_allclose(rows[:, state], difference, rtol=1e-5, atol=1e-8)


def ones():
    return {
        "travel_time_s": 1.0,
        "start_m": 1.0,
        "heading_bias_rad": 1.0,
        "harmonics_rad": (1.0, 1.0, 1.0, 1.0),
        "heading_slow_rad": 1.0,
        "heading_slow_time_s": 300.0,
        "velocity_scale": 1.0,
        "misalignment_rad": 1.0,
        "velocity_slow_mps": 1.0,
        "velocity_slow_time_s": 300.0,
        "white_m2_per_s": 1.0,
        "sound_speed_scale": 1.0,
    }


def test_the_recursions_are_one_joint_solve():
    """Information of all instants at once, inverted: the last block is the filter's."""
    track = winding(300.0)
    places = [[1800, 300, -30], [-900, 1700, -60], [-1500, -1400, 20], [700, -1900, 10]]
    replies = asked(np.arange(21.3, 295.0, 11.0), places)
    step_s = 25.0
    result = posterior_bound(track, replies, FULL, step_s=step_s)

    t_s = np.sort(np.concatenate([result.t_s, replies.t_reply_s]))
    transition, noise = module._steps(t_s, track, FULL)
    rows = module._sensitivity(track, replies, FULL)
    n, m = 13, len(t_s)
    information = np.zeros((m * n, m * n))
    information[:n, :n] += np.diag(1 / np.array([100.0, 100.0] + [1.0] * 11))
    for j in range(1, m):
        # constants carry a trace of noise here, so that Q can be inverted
        weight = np.diag(1 / np.maximum(noise[j], 1e-9))
        link = np.hstack([-transition[j], np.eye(n)])
        block = slice((j - 1) * n, (j + 1) * n)
        information[block, block] += link.T @ weight @ link
    for row, t in zip(rows, replies.t_reply_s, strict=True):
        at = slice(np.searchsorted(t_s, t) * n, np.searchsorted(t_s, t) * n + n)
        information[at, at] += np.outer(row, row) / FULL.travel_time_s**2
    joint = np.linalg.inv(information)
    variance = np.diag(joint).reshape(m, n)[np.isin(t_s, result.t_s)]
    np.testing.assert_allclose(result.smoother_m, np.sqrt(variance[:, :2].sum(axis=1)), rtol=1e-4)
    assert result.filter_m[-1] == pytest.approx(result.smoother_m[-1], rel=1e-9)


def test_what_cannot_be_wrong_is_no_state():
    replies = asked(np.arange(24.0, 600.0, 24.0), [[2000, 500, 0], [-300, 2000, 0]])
    without = posterior_bound(winding(), replies, replace(FULL, misalignment_rad=0.0))
    hardly = posterior_bound(winding(), replies, replace(FULL, misalignment_rad=1e-9))
    np.testing.assert_allclose(without.filter_m, hardly.filter_m, rtol=1e-6)
    np.testing.assert_allclose(without.smoother_m, hardly.smoother_m, rtol=1e-6)


def test_hindsight_never_knows_less_and_more_replies_never_hurt():
    places = [[1800, 300, -30], [-900, 1700, -60], [-1500, -1400, 20]]
    many = asked(np.arange(24.0, 600.0, 8.0), places)
    full = posterior_bound(winding(), many, FULL)
    half = posterior_bound(winding(), many[::2], FULL)
    assert (full.smoother_m <= full.filter_m * (1 + 1e-9)).all()
    assert (full.filter_m <= half.filter_m * (1 + 1e-9)).all()
    assert full.smoother_m.max() < half.smoother_m.max()


def test_the_scenarios_errors_are_the_models():
    model = error_model(load_scenario("voyage_1"))
    assert np.degrees(model.heading_bias_rad) == pytest.approx(1.5)
    assert np.degrees(model.harmonics_rad) == pytest.approx([1.0, 1.0, 0.4, 0.4])
    assert model.sound_speed_scale == pytest.approx(1 / 1550)
    assert model.travel_time_s == 0.002


@pytest.mark.parametrize(
    ("name", "filter_m", "smoother_m"), [("voyage_1", 1.24, 0.71), ("voyage_2", 1.04, 0.60)]
)
def test_the_voyages_bounds_are_near_those_of_the_design_study(name, filter_m, smoother_m):
    """Medians of 3 h dives elsewhere simulated; other beacons and floors make a tenth."""
    scenario = with_settings(load_scenario(name), duration_s=7200.0, seed=5)
    filtered, smoothed = bound(simulate(scenario)).rms_m(300.0)
    assert filtered == pytest.approx(filter_m, rel=0.12)
    assert smoothed == pytest.approx(smoother_m, rel=0.12)


def test_wrong_replies_carry_no_information():
    scenario = with_settings(load_scenario("voyage_2"), duration_s=1800.0)
    clean = with_settings(
        scenario, acoustics=with_settings(scenario.acoustics, gross=0.0, bad_gross=0.0)
    )
    dive, better = simulate(scenario), simulate(clean)
    assert bound(better).rms_m(300.0)[0] < bound(dive).rms_m(300.0)[0]
