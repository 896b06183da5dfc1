# SPDX-License-Identifier: Apache-2.0
import dataclasses

import msgspec
import numpy as np
import pytest
from oracles import rotation_enu_body, step_by_step

from abyssnav.diagnose.course import Course, with_heading, with_velocity
from abyssnav.diagnose.motion import error_columns
from abyssnav.estimation.dead_reckoning import DeadReckoning, dead_reckon
from abyssnav.geometry import interpolate
from abyssnav.simulate import load_scenario, simulate
from abyssnav.tables import Heading, Velocity

GAP_SIGMA_MPS, MAX_GAP_S = 0.1, 1.0


def turning(t_s, turn_radps=0.01):
    """Attitude of a vehicle that rolls, pitches and turns."""
    t = np.asarray(t_s, float)
    return 0.05 * np.sin(0.7 * t), 0.03 * np.cos(0.4 * t), 1.0 + turn_radps * t


def compass(duration_s, turn_radps=0.01):
    t_s = np.arange(0.0, duration_s + 0.05, 0.1)
    return Heading(t_s, *turning(t_s, turn_radps))


def dvl(t_s, body_mps=(1.2, 0.1, -0.05), valid=True, turn_radps=0.01):
    t_s = np.asarray(t_s, float)
    body = np.broadcast_to(np.asarray(body_mps, float), (len(t_s), 3)).copy()
    valid = np.broadcast_to(np.asarray(valid), len(t_s)).copy()
    body[~valid] = 0.0
    return Velocity(t_s, body, valid, *turning(t_s, turn_radps))


def reckon(velocity, heading, span_s=None):
    span_s = span_s or (float(velocity.t_s[0]), float(velocity.t_s[-1]))
    return dead_reckon(velocity, heading, span_s, GAP_SIGMA_MPS, MAX_GAP_S)


def rough_dive(seed=0, duration_s=120.0):
    """Irregular stamps, noise, lost bottom lock, a silence, and a late first good sample."""
    rng = np.random.default_rng(seed)
    t_s = np.cumsum(rng.uniform(0.1, 0.3, int(duration_s / 0.2)))
    t_s = t_s[(t_s < 70) | (t_s > 82.3)]
    valid = rng.random(len(t_s)) > 0.1
    valid[:9] = False
    valid[(t_s > 30) & (t_s < 47)] = False
    valid[-12:] = False
    body = rng.normal([1.2, 0.0, 0.0], 0.3, (len(t_s), 3))
    return dvl(t_s, body, valid, 0.05), compass(duration_s + 10, 0.05)


@pytest.mark.parametrize("seed", range(4))
def test_the_running_sums_are_step_by_step_reckoning_in_mean_and_gap_variance(seed):
    velocity, heading = rough_dive(seed)
    motion = reckon(velocity, heading, (-3.3, float(velocity.t_s[-1]) + 5.5))
    assert set(velocity.t_s) <= set(motion.t_s)
    place_m, variance_m2 = step_by_step(velocity, heading, motion.t_s, GAP_SIGMA_MPS, MAX_GAP_S)
    np.testing.assert_allclose(motion.displacement_m, place_m, atol=1e-10)
    np.testing.assert_allclose(motion.gap_variance_m2, variance_m2, atol=1e-10)
    assert np.all(np.diff(motion.t_s) <= MAX_GAP_S + 1e-6)


def test_a_straight_run_at_constant_speed_is_speed_times_time():
    t_s = np.arange(0.0, 100.1, 0.2)
    still, east = np.zeros(len(t_s)), np.full(len(t_s), np.pi / 2)
    body_mps = np.tile([1.5, 0.5, 0.0], (len(t_s), 1))
    level = Velocity(t_s, body_mps, np.full(len(t_s), True), still, still, east)
    heading = Heading(t_s, still, still, east)
    motion = reckon(level, heading)
    np.testing.assert_allclose(motion.displacement_m[-1], [150.0, -50.0], atol=1e-9)
    assert motion.gap_variance_m2[-1] == 0.0


def test_in_a_gap_the_last_good_body_velocity_is_held_and_turned_by_the_compass():
    """A full circle while bottom lock is lost: the vehicle comes back, it does not stand still."""
    turn_radps = 2 * np.pi / 60
    t_s = np.arange(0.0, 90.0, 0.2)
    lost = (t_s > 10) & (t_s < 70.5)
    motion = reckon(dvl(t_s, (1.0, 0.0, 0.0), ~lost, turn_radps), compass(90.0, turn_radps))
    whole = reckon(dvl(t_s, (1.0, 0.0, 0.0), True, turn_radps), compass(90.0, turn_radps))
    np.testing.assert_allclose(motion.displacement_m, whole.displacement_m, atol=1e-9)
    half_m = (
        motion.interpolate(np.array([40.0])).displacement_m
        - motion.interpolate(np.array([10.0])).displacement_m
    )
    assert np.linalg.norm(half_m) == pytest.approx(60 / np.pi, abs=0.1)


def test_a_silence_is_bridged_as_lost_bottom_lock_is():
    turn_radps = 2 * np.pi / 60
    t_s = np.arange(0.0, 90.0, 0.2)
    silent = (t_s > 10) & (t_s < 70.5)
    whole = reckon(dvl(t_s, (1.0, 0.0, 0.0), True, turn_radps), compass(90.0, turn_radps))
    bridged = reckon(dvl(t_s[~silent], (1.0, 0.0, 0.0), True, turn_radps),
                     compass(90.0, turn_radps))  # fmt: skip
    np.testing.assert_allclose(
        bridged.displacement_m[-1], whole.displacement_m[-1], atol=0.1
    )  # trapezoids of 1 s in a turn of 6 degrees a second
    lost = reckon(dvl(t_s, (1.0, 0.0, 0.0), ~silent, turn_radps), compass(90.0, turn_radps))
    assert bridged.gap_variance_m2[-1] == pytest.approx(lost.gap_variance_m2[-1], abs=1e-9)


def test_a_gap_adds_the_square_of_its_age_and_not_less_when_samples_lie_in_it():
    t_s = np.arange(0.0, 100.0, 0.2)
    motion = reckon(dvl(t_s, valid=~((t_s > 20.01) & (t_s < 49.99))), compass(100.0))
    assert motion.gap_variance_m2[-1] == pytest.approx((GAP_SIGMA_MPS * 30.0) ** 2)
    assert motion.interpolate(np.array([30.0])).gap_variance_m2[0] == pytest.approx(
        (GAP_SIGMA_MPS * 10.0) ** 2
    )


def test_before_the_first_good_sample_that_one_is_held_backwards():
    t_s = np.arange(0.0, 20.0, 0.2)
    late = reckon(dvl(t_s, valid=t_s > 8), compass(20.0))
    whole = reckon(dvl(t_s), compass(20.0))
    np.testing.assert_allclose(late.displacement_m, whole.displacement_m, atol=1e-10)
    first_s = t_s[t_s > 8][0]
    assert late.gap_variance_m2[-1] == pytest.approx((GAP_SIGMA_MPS * first_s) ** 2)


def test_after_the_last_sample_the_sums_go_on_to_the_end_of_the_span():
    motion = reckon(dvl(np.arange(0.0, 10.0, 0.2)), compass(60.0), (-5.0, 60.0))
    assert motion.t_s[0] == -5.0
    assert motion.t_s[-1] == 60.0
    assert np.hypot(*(motion.displacement_m[-1] - motion.displacement_m[0])) > 60.0
    assert motion.gap_variance_m2[-1] == pytest.approx(
        (GAP_SIGMA_MPS * 5.0) ** 2 + (GAP_SIGMA_MPS * (60.0 - 9.8)) ** 2
    )


def test_one_sample_is_enough_to_reckon_with():
    motion = reckon(dvl([4.0]), compass(10.0), (0.0, 10.0))
    assert np.all(np.isfinite(motion.displacement_m))
    assert np.hypot(*motion.displacement_m[-1]) == pytest.approx(12.0, abs=0.2)
    alone = reckon(dvl([4.0]), compass(10.0), (4.0, 4.0))
    assert len(alone) == 1
    assert alone.interpolate(np.array([0.0, 9.0])).displacement_m.tolist() == [[0, 0], [0, 0]]


def test_where_the_compass_is_not_known_its_ends_are_held():
    heading = compass(100.0)
    part = heading[(heading.t_s > 20) & (heading.t_s < 30)]
    motion = reckon(dvl([25.0]), part, (0.0, 60.0))
    assert motion.heading_rad[0] == part.heading_rad[0]
    assert motion.heading_rad[-1] == part.heading_rad[-1]


SHAPES = [np.sin, np.cos, lambda h: np.sin(2 * h), lambda h: np.cos(2 * h)]


@pytest.mark.parametrize("shape", range(4), ids=["sin", "cos", "sin2", "cos2"])
def test_the_sums_over_harmonics_are_the_derivative_of_reckoning_anew(shape):
    """Perturb every heading by an amplitude times its shape, reckon anew, take the difference."""
    velocity, heading = rough_dive(7, 60.0)
    motion = reckon(velocity, heading)
    amplitude = 1e-4
    ahead, behind = (
        step_by_step(velocity, heading, motion.t_s, GAP_SIGMA_MPS, MAX_GAP_S,
                     heading_error=lambda h, a=sign * amplitude: a * SHAPES[shape](h))[0]
        for sign in (1, -1)
    )  # fmt: skip
    difference_m = (ahead - behind) / (2 * amplitude)
    np.testing.assert_allclose(motion.displacement_jacobian[:, shape], difference_m, atol=1e-5)


def test_a_constant_heading_error_turns_every_displacement():
    velocity, heading = rough_dive(3, 60.0)
    motion, error = reckon(velocity, heading), np.radians(10.0)
    turned_m, _ = step_by_step(
        velocity, heading, motion.t_s, GAP_SIGMA_MPS, MAX_GAP_S, heading_error=lambda _: error
    )
    rotation = np.array([[np.cos(error), -np.sin(error)], [np.sin(error), np.cos(error)]])
    np.testing.assert_allclose(motion.displacement_m @ rotation.T, turned_m, atol=1e-10)


def test_what_was_summed_up_before_a_cut_does_not_change_by_a_bit():
    velocity, heading = rough_dive(1)
    whole = reckon(velocity, heading, (-2.0, 140.0))
    for cut_s in (3.0, 33.3, 60.0, 75.5, 95.1, 118.0):
        before = velocity[velocity.t_s <= cut_s]
        if not before.valid.any():
            continue
        part = reckon(before, heading[heading.t_s <= cut_s], (-2.0, cut_s))
        # the newest stretch waits for its second sample
        known = part[part.t_s < cut_s - MAX_GAP_S - 0.2].columns()
        for name, column in known.items():
            assert np.array_equal(column, getattr(whole, name)[: len(column)]), (cut_s, name)


def test_on_true_velocities_reckoning_closes_within_a_metre_in_kilometres():
    scenario = msgspec.structs.replace(load_scenario("clean"), duration_s=7200.0)
    truth = simulate(scenario).truth.motion
    body = np.array([
        rotation_enu_body(r, p, h).T @ v
        for r, p, h, v in zip(truth.roll_rad[::10], truth.pitch_rad[::10],
                              truth.heading_rad[::10], truth.velocity_enu_mps[::10], strict=True)
    ])  # fmt: skip
    t_s = truth.t_s[::10]
    angles = (truth.roll_rad, truth.pitch_rad, truth.heading_rad)
    velocity = Velocity(t_s, body, np.full(len(t_s), True), *[a[::10] for a in angles])
    motion = reckon(velocity, Heading(truth.t_s, *angles))
    true_m = truth.position_enu_m[::10, :2] - truth.position_enu_m[0, :2]
    run_m = np.sum(np.linalg.norm(np.diff(true_m, axis=0), axis=1))
    error_m = np.linalg.norm(motion.displacement_m - true_m, axis=1)
    assert run_m > 3000
    assert error_m.max() < 1.0


def test_rows_at_any_times_are_the_lines_between_the_sums():
    velocity, heading = rough_dive(2)
    motion = reckon(velocity, heading)
    t_s = np.linspace(motion.t_s[0], motion.t_s[-1], 313)
    at = motion.interpolate(t_s)
    assert isinstance(at, DeadReckoning)
    assert np.array_equal(at.t_s, t_s)
    for name in ("displacement_m", "displacement_jacobian", "gap_variance_m2", "heading_rad"):
        column = getattr(at, name)
        np.testing.assert_array_equal(column, interpolate(t_s, motion.t_s, getattr(motion, name)))


def test_sums_do_not_touch_what_they_were_made_from():
    velocity, heading = rough_dive(0)
    before = dataclasses.replace(velocity, velocity_body_mps=velocity.velocity_body_mps.copy())
    reckon(velocity, heading)
    np.testing.assert_array_equal(velocity.velocity_body_mps, before.velocity_body_mps)


def swum():
    """A course of changing speed that swims sideways and turns, and instants along it."""
    t_s = np.arange(0.0, 600.0, 0.5)
    bow, starboard = 1.2 + 0.5 * np.sin(t_s / 70), 0.2 * np.cos(t_s / 40)
    still = np.zeros(len(t_s))
    course = Course(t_s, still.astype(complex), bow, starboard, still)
    return with_heading(course, 1.0 + t_s / 90), np.linspace(20.0, 580.0, 15)


@pytest.mark.parametrize(
    ("column", "changed"),
    [
        (("turn", 0), lambda c, e: with_heading(c, c.heading_rad - e)),
        (
            ("deviation_1", 0),
            lambda c, e: with_heading(c, c.heading_rad - e * np.sin(c.heading_rad)),
        ),
        (
            ("deviation_1", 1),
            lambda c, e: with_heading(c, c.heading_rad - e * np.cos(c.heading_rad)),
        ),
        (
            ("deviation_2", 0),
            lambda c, e: with_heading(c, c.heading_rad - e * np.sin(2 * c.heading_rad)),
        ),
        (
            ("deviation_2", 1),
            lambda c, e: with_heading(c, c.heading_rad - e * np.cos(2 * c.heading_rad)),
        ),
        (
            ("scale", 0),
            lambda c, e: with_velocity(c, (1 + e) * c.bow_mps, (1 + e) * c.starboard_mps),
        ),
        (("sway", 0), lambda c, e: with_velocity(c, c.bow_mps, (1 + e) * c.starboard_mps)),
    ],
)
def test_the_columns_of_errors_are_the_derivative_of_a_course_that_has_them(column, changed):
    course, t_s = swum()
    columns, names = error_columns(course, t_s, (0.0, 600.0))
    found = columns[:, names.index(column[0]) + column[1]]
    more, less = (
        other.run(other.velocity_mps, t_s)
        for other in (changed(course, 1e-5), changed(course, -1e-5))
    )
    np.testing.assert_allclose(found, (more - less) / 2e-5, atol=1e-6)
