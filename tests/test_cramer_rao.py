# SPDX-License-Identifier: Apache-2.0
"""The Cramér-Rao bound against closed forms, finite differences and one joint solve."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as with_settings

from abyssnav.geometry import body_to_enu, interpolate
from abyssnav.simulate import beacon_errors, bound, error_model, load_scenario, simulate
from abyssnav.simulate import cramer_rao as module
from abyssnav.simulate.cramer_rao import (
    BeaconErrors,
    Current,
    ErrorModel,
    TruePositions,
    TrueReplies,
    TrueTrack,
    posterior_bound,
)
from abyssnav.simulate.scenario import draw, with_key

PERFECT = ErrorModel(start_m=10.0)
BEACONS = np.array(
    [[1800.0, 300, -30], [-900, 1700, -60], [-1500, -1400, 20], [700, -1900, 10], [50, 2100, 5]]
)
FULL = ErrorModel(
    start_m=10.0,
    heading_bias_rad=0.026,
    harmonics_rad=(0.017, 0.017, 0.007, 0.007),
    heading_jump_rad=0.1,
    heading_jump_at_s=150.0,
    heading_slow_rad=0.005,
    velocity_scale=0.004,
    mount_rad=0.005,
    velocity_slow_mps=0.004,
    white_m2_per_s=1e-3,
    heading_clock_s=0.3,
    velocity_clock_s=0.2,
    travel_time_clock_s=0.1,
    sound_speed_scale=1 / 1550,
    sound_speed_slow=2e-4,
    gradient_per_s=0.004,
    gradient_depth_m=20.0,
    depth_m=0.5,
    lever_m=(1.0, 2.0, 0.5),
    turn_around_s=1e-3,
    currents=(Current(100.0, 200.0, 0.1), Current(200.0, 260.0, 0.2)),
    beacons=BeaconErrors(np.full((5, 3), 3.0), np.full(5, 3e-4), np.full(5, 1e-3)),
)
STATES = (
    *module._STATES,
    *(f"current_{axis}_{k}" for k in (1, 2) for axis in ("east", "north")),
    *(f"beacon_{b}_{what}" for b in range(1, 6) for what in ("e", "n", "u", "turn", "slow")),
)


def at_rest(duration_s=600.0):
    t_s = np.arange(0.0, duration_s + 0.05, 0.1)
    still = np.zeros((len(t_s), 3))
    nothing = np.zeros_like(t_s)
    return TrueTrack(t_s, still, nothing, nothing, nothing)


def winding(duration_s=600.0):
    """A track that turns, so that no state hides behind another."""
    t_s = np.arange(0.0, duration_s + 0.05, 0.1)
    heading = 0.5 + 0.008 * t_s + 0.6 * np.sin(t_s / 40)
    velocity = 1.2 * np.column_stack([np.sin(heading), np.cos(heading), 0 * heading])
    steps = 0.05 * (velocity[1:] + velocity[:-1])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    unknown_mps = np.where(np.abs(t_s - 250) < 60, 0.2, 0.0)
    return TrueTrack(t_s, position, heading, np.zeros_like(t_s), unknown_mps)


def asked(t_reply_s, places, flight_s=2.7, sigma_s=0.002):
    """Replies from the beacons at `places` in turn, each to a ping `flight_s` earlier."""
    t_reply_s = np.asarray(t_reply_s, dtype=float)
    n = len(t_reply_s)
    return TrueReplies(
        t_reply_s - flight_s,
        t_reply_s,
        np.resize(np.arange(len(places)), n),
        np.resize(np.asarray(places, dtype=float), (n, 3)),
        np.full(n, 1500.0),
        np.full(n, sigma_s),
    )


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
    track = TrueTrack(t_s, north, *np.zeros((3, len(t_s))))
    model = replace(PERFECT, heading_bias_rad=0.02, velocity_scale=0.01, white_m2_per_s=1e-3)
    result = posterior_bound(track, asked([], [[0.0, 0.0, 0.0]]), model)
    way = 1.2 * result.t_s
    variance = 2 * (10.0**2 + 1e-3 * result.t_s) + (0.02 * way) ** 2 + (0.01 * way) ** 2
    np.testing.assert_allclose(result.filter_m, np.sqrt(variance), rtol=1e-9)
    np.testing.assert_allclose(result.smoother_m, result.filter_m, rtol=1e-6)


def test_a_loss_of_bottom_lock_adds_its_own_variance():
    track = at_rest()
    growing = np.clip(track.t_s - 200, 0, 50)
    lost = replace(track, gap_variance_m2=growing)
    result = posterior_bound(lost, asked([], [[0.0, 0.0, 0.0]]), PERFECT)
    np.testing.assert_allclose(
        result.filter_m**2, 2 * (100 + np.clip(result.t_s - 200, 0, 50)), rtol=1e-9
    )


def test_before_the_first_lock_the_position_is_lost_as_fast_as_a_velocity_may_be():
    """As a constant of 1 m/s, for 50 s, where it does not fade."""
    track = at_rest()
    unknown = replace(track, unknown_mps=np.where(track.t_s < 50, 1.0, 0.0))
    model = replace(PERFECT, unknown_time_s=1e9)
    result = posterior_bound(unknown, asked([], [[0.0, 0.0, 0.0]]), model)
    way_m = np.clip(result.t_s, 0, 50)
    np.testing.assert_allclose(result.filter_m**2, 2 * (100 + way_m**2), rtol=3e-3)


def value(error, name):
    """Of a state in its own unit, from the vector in units of its prior."""
    place = STATES.index(name)
    return error[place] * (1.0 if place < 2 else module._prior(FULL)[place])


def reckoned(track, error):
    """Displacement (n, 2) that dead reckoning makes of readings, corrected by what is wrong.

    The readings are the true ones; the state says what is wrong with them and takes it out.
    """

    def wrong(name):
        return value(error, name)

    middle_s = 0.5 * (track.t_s[1:] + track.t_s[:-1])
    step = np.diff(track.t_s)
    heading = 0.5 * (track.heading_rad[1:] + track.heading_rad[:-1])
    turn_rate = np.diff(track.heading_rad) / step
    moved = np.diff(track.position_enu_m[:, :2], axis=0) / step[:, None]
    acceleration = np.diff(moved, axis=0, prepend=moved[:1]) / step[:, None]
    moved = moved + wrong("velocity_clock") * acceleration
    shapes = {"sin": np.sin(heading), "cos": np.cos(heading)}
    shapes |= {"sin2": np.sin(2 * heading), "cos2": np.cos(2 * heading)}
    turn = wrong("heading_bias") + wrong("heading_slow") + wrong("mount")
    turn = turn + sum(wrong(name) * shape for name, shape in shapes.items())
    turn = turn + wrong("heading_jump") * (middle_s >= FULL.heading_jump_at_s)
    turn = turn - wrong("heading_clock") * turn_rate
    forward = moved[:, 0] * np.sin(heading) + moved[:, 1] * np.cos(heading)
    starboard = moved[:, 0] * np.cos(heading) - moved[:, 1] * np.sin(heading)
    unknown = 0.5 * (track.unknown_mps[1:] + track.unknown_mps[:-1])
    forward = forward - wrong("slow_forward") - unknown * wrong("unknown_forward")
    starboard = starboard - wrong("slow_starboard") - unknown * wrong("unknown_starboard")
    course = heading - turn
    velocity = np.column_stack(
        [
            starboard * np.cos(course) + forward * np.sin(course),
            forward * np.cos(course) - starboard * np.sin(course),
        ]
    ) / (1 + wrong("scale"))
    for k, current in enumerate(FULL.currents, start=1):
        inside = (middle_s >= current.from_s) & (middle_s < current.until_s)
        velocity += inside[:, None] * [wrong(f"current_east_{k}"), wrong(f"current_north_{k}")]
    rows = np.concatenate([np.zeros((1, 2)), np.cumsum(velocity * step[:, None], axis=0)])
    return rows + track.position_enu_m[0, :2]


@pytest.mark.parametrize("state", range(2, 30), ids=STATES[2:30])
def test_displacement_partials_are_finite_differences(state):
    track = winding()
    partials = module._displacement_partials(track, FULL)
    step = np.zeros(len(STATES))
    step[state] = 1e-3
    difference = (reckoned(track, step) - reckoned(track, -step)) / 2e-3
    np.testing.assert_allclose(partials[:, :, state], difference, rtol=1e-6, atol=1e-6)


def leg_ends(track, replies, error, clock_s):
    """Transducer (n, 3) at ping and reply, as the state has it."""
    sums = reckoned(track, error)
    moved = np.column_stack([sums, np.zeros(len(sums))])
    ends = []
    velocity = np.gradient(track.position_enu_m, track.t_s, axis=0)
    now = interpolate(replies.t_reply_s, track.t_s, moved)
    true_now = interpolate(replies.t_reply_s, track.t_s, track.position_enu_m)
    for t_s in (replies.t_ping_s, replies.t_reply_s):
        place = true_now + interpolate(t_s, track.t_s, moved) - now
        place += np.array([error[0], error[1], -value(error, "depth")])
        place = place + clock_s * interpolate(t_s, track.t_s, velocity)
        heading = interpolate(t_s, track.t_s, track.heading_rad)
        level = np.zeros(len(heading))
        names = ("lever_forward", "lever_starboard", "lever_down")
        lever = np.array([value(error, name) for name in names])
        ends.append(place + body_to_enu(lever, level, level, heading))
    return ends


def times(track, replies, error):
    """Two-way times as the state has them."""
    own = np.reshape([value(error, name) for name in STATES[30:]], (5, 5))[replies.beacon]
    beacon = replies.beacon_enu_m + own[:, :3]
    k = value(error, "sound") + value(error, "sound_slow")
    total = value(error, "turn_around") + own[:, 3] + own[:, 4]
    # the mean depth of a leg hardly moves with the states
    for place, still in zip(
        leg_ends(track, replies, error, value(error, "travel_time_clock")),
        leg_ends(track, replies, np.zeros(len(STATES)), 0.0),
        strict=True,
    ):
        depth = -0.5 * (still + replies.beacon_enu_m)[:, 2] - FULL.gradient_depth_m
        slower = 1 + k + value(error, "gradient") * depth / 1500.0
        total = total + slower * np.linalg.norm(place - beacon, axis=1) / 1500.0
    return total


@pytest.mark.parametrize("state", range(len(STATES)), ids=STATES)
def test_reply_rows_are_finite_differences_of_the_travel_time(state):
    """With five beacons; the position at the ping is that at the reply less the displacement."""
    track = winding()
    replies = asked(np.arange(50.0, 590.0, 7.3), BEACONS)
    rows = module._sensitivity(track, replies, FULL)
    step = np.zeros(len(STATES))
    step[state] = 1e-2
    difference = (times(track, replies, step) - times(track, replies, -step)) / 2e-2
    assert np.abs(difference).max() > 0
    scale = np.abs(rows[:, state]).max()
    np.testing.assert_allclose(rows[:, state], difference, rtol=1e-4, atol=1e-4 * scale)


def test_the_recursions_are_one_joint_solve():
    """Information of all instants at once, inverted: its blocks are the smoother's."""
    track = winding(300.0)
    replies = asked(np.arange(21.3, 295.0, 17.0), BEACONS)
    result = posterior_bound(track, replies, FULL, step_s=50.0)

    t_s = np.sort(np.concatenate([result.t_s, replies.t_reply_s]))
    transition, noise = module._steps(t_s, track, FULL, module._correlation_times(FULL))
    rows = module._sensitivity(track, replies, FULL)
    n, m = len(STATES), len(t_s)
    information = np.zeros((m * n, m * n))
    information[:n, :n] += np.diag([0.01, 0.01] + [1.0] * (n - 2))
    for j in range(1, m):
        # constants carry a trace of noise here, so that Q can be inverted
        weight = np.diag(1 / np.maximum(noise[j], 1e-9))
        link = np.hstack([-transition[j], np.eye(n)])
        block = slice((j - 1) * n, (j + 1) * n)
        information[block, block] += link.T @ weight @ link
    for row, t in zip(rows, replies.t_reply_s, strict=True):
        block = slice(np.searchsorted(t_s, t) * n, np.searchsorted(t_s, t) * n + n)
        information[block, block] += np.outer(row, row) / 0.002**2
    joint = np.linalg.inv(information)
    variance = np.diag(joint).reshape(m, n)[np.isin(t_s, result.t_s)]
    np.testing.assert_allclose(result.smoother_m, np.sqrt(variance[:, :2].sum(axis=1)), rtol=1e-4)
    assert result.filter_m[-1] == pytest.approx(result.smoother_m[-1], rel=1e-9)


def test_a_position_fix_is_worth_its_own_variance():
    """1/P = 1/P₀ + n/σ², an axis, for a vehicle at rest."""
    fixes = TruePositions(np.array([100.0, 200.0, 300.0]), np.full(3, 5.0))
    result = posterior_bound(at_rest(), asked([], BEACONS), PERFECT, fixes)
    after = 1 / (1 / 100 + 3 / 25)
    assert result.filter_m[-1] == pytest.approx(np.sqrt(2 * after), rel=1e-9)
    np.testing.assert_allclose(result.smoother_m, np.sqrt(2 * after), rtol=1e-9)


def test_beacons_that_may_be_anywhere_leave_the_track_as_uncertain_as_they_are():
    """With perfect times and many pings, the mean of what is wrong with all beacons is left."""
    times_s = np.repeat(np.arange(24.0, 600.0, 24.0), 2)
    far = [[1e6, 0, 0], [0, 1e6, 0]]
    wrong = BeaconErrors(np.full((2, 3), 3.0), np.zeros(2), np.zeros(2))
    model = ErrorModel(start_m=1e3, beacons=wrong)
    result = posterior_bound(at_rest(), asked(times_s, far, sigma_s=1e-6), model)
    assert result.filter_m[-1] == pytest.approx(3.0 * np.sqrt(2), rel=1e-3)


def test_what_cannot_be_wrong_is_no_state():
    replies = asked(np.arange(24.0, 600.0, 24.0), [[2000, 500, 0], [-300, 2000, 0]])
    without = posterior_bound(winding(), replies, replace(FULL, mount_rad=0.0))
    hardly = posterior_bound(winding(), replies, replace(FULL, mount_rad=1e-9))
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


def modelled(dive):
    return error_model(dive.scenario, beacon_errors(dive), 4950.0)


def model_of(**keys):
    scenario = with_settings(load_scenario("voyage_1"), duration_s=300.0)
    for path, key in keys.items():
        scenario = with_key(scenario, path.replace("__", "."), key)
    return modelled(simulate(scenario))


def test_the_scenarios_errors_are_the_models():
    model = model_of()
    assert np.degrees(model.heading_bias_rad) == pytest.approx(1.5)
    assert np.degrees(model.harmonics_rad) == pytest.approx([1.0, 1.0, 0.4, 0.4])
    assert model.sound_speed_scale == pytest.approx(1 / 1550)
    assert model.gradient_per_s == 0.0


def test_an_error_that_is_certain_is_of_unknown_sign_to_who_navigates():
    model = model_of(dvl__scale=0.15, vehicle__transducer_offset_m=(5.0, 0.0, -2.0))
    assert model.velocity_scale == pytest.approx(np.hypot(0.15, 0.004))
    assert model.lever_m == (0.0, 0.0, 0.0)
    stated = {"vehicle__stated_offset_m": (0.0, 0.0, 0.0)}
    model = model_of(vehicle__transducer_offset_m=(5.0, 0.0, -2.0), **stated)
    assert model.lever_m == (5.0, 0.0, 2.0)
    silent = {"vehicle__offset_stated": False, "vehicle__transducer_offset_m": (5.0, 0.0, -2.0)}
    assert model_of(**silent).lever_m == (5.0, 0.0, 2.0)


def test_an_error_out_of_a_range_has_the_ranges_mean_square():
    scenario = with_settings(
        load_scenario("voyage_1"), duration_s=300.0, vary={"compass.bias_deg": (-6.0, 6.0)}
    )
    model = modelled(simulate(scenario))
    assert np.degrees(model.heading_bias_rad) == pytest.approx(np.hypot(1.5, 6 / np.sqrt(3)))


def test_without_a_profile_the_gradient_is_unknown_and_with_a_misshapen_one_too():
    assert model_of(sound__logged=False).gradient_per_s == pytest.approx(0.004)
    assert model_of(sound__shape_sigma_mps=2.0).gradient_per_s == pytest.approx(
        2 * np.pi / 3000 * np.sqrt(14 / 3)
    )


def test_one_beacon_that_is_off_is_the_one_that_is_uncertain():
    beacons = model_of(beacons__survey_sigma_m=0.2, beacons__one_displaced_m=5.0).beacons
    sideways = np.sort(beacons.position_sigma_m[:, 0])
    assert sideways[:3] == pytest.approx([0.2] * 3)
    assert sideways[3] == pytest.approx(np.hypot(0.2, 5 / np.sqrt(2)))


@pytest.mark.parametrize(("noise", "worth"), [("laplace", 2.0), ("student", 10 / 7)])
def test_noise_with_a_peak_is_worth_its_fisher_information(noise, worth):
    scenario = with_settings(load_scenario("voyage_1"), duration_s=1800.0)
    sharp = with_key(scenario, "acoustics.sigma_s", 0.002 / float(np.sqrt(worth)))
    peaked = simulate(with_key(scenario, "acoustics.noise", noise))
    # the same replies with as much information in normal noise
    same = replace(peaked, scenario=draw(sharp))
    assert bound(peaked).rms_m(300.0) == pytest.approx(bound(same).rms_m(300.0), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "filter_m", "smoother_m"), [("voyage_1", 1.24, 0.71), ("voyage_2", 1.04, 0.60)]
)
def test_the_voyages_bounds_are_near_those_of_the_design_study(name, filter_m, smoother_m):
    """Medians of 3 h dives elsewhere simulated; other beacons and floors make a tenth."""
    scenario = with_settings(load_scenario(name), duration_s=10800.0)
    rms_m = [bound(simulate(scenario, seed)).rms_m(300.0) for seed in range(5, 10)]
    filtered, smoothed = np.median(rms_m, axis=0)
    assert filtered == pytest.approx(filter_m, rel=0.12)
    assert smoothed == pytest.approx(smoother_m, rel=0.12)


def test_wrong_replies_carry_no_information():
    scenario = with_settings(load_scenario("voyage_2"), duration_s=1800.0)
    clean = with_settings(
        scenario, acoustics=with_settings(scenario.acoustics, gross=0.0, bad_gross=0.0)
    )
    dive, better = simulate(scenario), simulate(clean)
    assert bound(better).rms_m(300.0)[0] < bound(dive).rms_m(300.0)[0]
