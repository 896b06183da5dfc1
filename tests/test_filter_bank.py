# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest
from oracles_best import (
    GATE,
    NO_ERRORS,
    PRIORS,
    SIGMA_S,
    cached,
    derivative,
    flight_time,
    moved,
    posed,
    random_states,
    run,
    simulated,
    small_steps,
    true_start,
)

from abyssnav.estimation.dive_states import CLOCK, N_COMMON, DiveStates
from abyssnav.estimation.filter_bank import N_MOVING, displace, move, observe_times, refer_to_first
from abyssnav.estimation.filter_events import _LOST, _REGAINED, Held, steps, sums_maker
from abyssnav.estimation.filter_history import propagate
from abyssnav.estimation.hypotheses import HYPOTHESES, bank_priors
from abyssnav.estimation.kalman import predict
from abyssnav.estimation.observations import LegTable, Observations, Offsets, PositionTable, observe
from abyssnav.estimation.observations import TimeTable as BatchTimes
from abyssnav.estimation.tracker import track
from abyssnav.estimation.two_state import ACCEPTED, EkfConfig, TravelTimes, filter_travel_times
from abyssnav.tables import DECISIONS

BASE = HYPOTHESES[:1]


def locked(n, hypotheses=HYPOTHESES):
    return Held(np.zeros(n, dtype=int), np.full((n, len(hypotheses)), 0.1))


@pytest.fixture(scope="module", params=[2, 5])
def dive(request):
    """A dive with a number of beacons that is not three."""
    return simulated(2, 1200.0, beacons={"count": request.param})


def test_a_displacement_and_its_derivatives_by_every_state_are_those_of_the_equation(dive):
    problem = posed(dive)
    sums = problem.sums.interpolate(problem.times.t_s)
    stretch = sums[1:].since(sums[:-1])
    x = random_states(17, len(dive.dive.beacons), seed=1)
    small = small_steps(x.shape[1])[:N_MOVING]
    for i in (0, 7, 30):
        row = stretch.row(i)
        d, by = displace(x, row, (1.0, 1.0, row.duration_s))
        for k in range(len(x)):
            assert d[k] == pytest.approx(moved(x[k], row), abs=1e-9)
            expected = derivative(lambda y, row=row: moved(y, row), x[k, :N_MOVING], small)
            np.testing.assert_allclose(by[k], expected, rtol=1e-6, atol=1e-6)


def test_a_predicted_time_and_its_gradient_by_every_state_are_those_of_both_legs(dive):
    times = posed(dive).times
    x = random_states(17, len(dive.dive.beacons), seed=2)
    small = small_steps(x.shape[1])
    rows = np.array([0, 11, 40])
    prediction = observe_times(np.repeat(x[:, None], 3, axis=1), times.row(rows))
    for j, i in enumerate(rows):
        for k in range(len(x)):
            assert prediction.time_s[k, j] == pytest.approx(flight_time(x[k], times, i), abs=1e-12)
            expected = derivative(lambda y, i=i: flight_time(y, times, i), x[k], small)
            np.testing.assert_allclose(prediction.H[k, j], expected, rtol=1e-6, atol=1e-10)


def test_one_reply_for_all_filters_is_what_whole_columns_of_the_batch_predict(dive):
    """The one measurement model twice: by columns of replies, and fast for one reply."""
    times, n = posed(dive).times, len(dive.ping)
    x = random_states(1, len(dive.dive.beacons), seed=3)
    back = times.since_ping
    nothing = np.zeros(n)
    shapes = np.zeros((n, 4))
    legs = [
        LegTable(times.virtual_beacon[:, k], times.height_m[:, k], times.speed_mps[:, k],
                 times.below_reference_m[:, k])
        for k in (0, 1)
    ]  # fmt: skip
    x[:, 9:13] = 0.0  # the batch takes the deviation at an instant, the filter its integral
    rows = observe(
        Observations(  # type: ignore[call-arg]
            BatchTimes(np.zeros(n, dtype=int), times.beacon, times.flight_time_s),
            Offsets(-back.displacement, -back.ahead, -back.duration_s, shapes, times.lever[:, 0],
                    times.lever_up[:, 0]),
            Offsets(0j * nothing, 0j * nothing, nothing, shapes, times.lever[:, 1],
                    times.lever_up[:, 1]),
            *legs,
            PositionTable(np.empty(0, dtype=int), np.empty(0, dtype=complex), np.empty((0, 2, 2))),
            Offsets(*(column[:0] for column in (0j * nothing, 0j * nothing, nothing, shapes,
                                                times.lever[:, 0], times.lever_up[:, 0]))),
        ),
        DiveStates(x[:, :8], x[0, 8:]),
    )  # fmt: skip
    compared = [*range(9), *range(13, x.shape[1])]
    for i in (0, 9, 33):
        prediction = observe_times(x[:, None], times.row(slice(i, i + 1)))
        late_s = times.flight_time_s[i] - prediction.time_s[0, 0]
        assert late_s == pytest.approx(rows.residual[i], abs=1e-12)
        gradient = np.concatenate([rows.by_node[i], rows.by_constant[i]])
        np.testing.assert_allclose(prediction.H[0, 0][compared], gradient[compared], atol=1e-12)


def noise_in_matrices(noise, i, n):
    """Q of one step, of every filter."""
    Q = np.zeros((len(noise), n, n))
    Q[:, :8, :8] = noise[:, i]
    return Q


def step_in_matrices(x, stretch, step, i):
    """State after step i, F and Q of every filter, as the textbook writes them."""
    h, n = x.shape
    mean = step.heading[:, i], step.ahead[:, i], step.current_s[:, i]
    d, by = displace(x, stretch.row(i), mean)
    F = np.tile(np.eye(n), (h, 1, 1))
    F[:, range(2, 8), range(2, 8)] = step.fade[:, i]
    F[:, 0, 2:N_MOVING], F[:, 1, 2:N_MOVING] = by[:, 2:].real, by[:, 2:].imag
    after = x.copy()
    after[:, 2:8] *= step.fade[:, i]
    after[:, 0] += d.real
    after[:, 1] += d.imag
    return after, F, noise_in_matrices(step.noise, i, n)


def test_steps_of_a_block_are_the_textbooks_in_matrices_one_after_the_other(dive):
    """States, and errors in terms of the first event: F_j⁻¹ (F P Fᵀ + Q) F_j⁻ᵀ is P + N_j."""
    problem = posed(dive)
    sums = problem.sums.interpolate(problem.times.t_s)
    rows = slice(9, 15)
    stretch = sums[1:].since(sums[:-1]).row(rows)
    step = steps(stretch, locked(6), problem.priors)
    h, n = len(HYPOTHESES), 8 + N_COMMON + 4 * len(dive.dive.beacons)
    x = random_states(h, len(dive.dive.beacons), seed=4, size=0.1)
    root = np.random.default_rng(5).normal(0, 1, (h, n, n))
    P = root @ root.swapaxes(1, 2)
    motion, first = move(x, stretch, step), P.copy()
    predict(first, motion.to_first)
    first[:, :8, :8] += motion.first_noise
    before, cov = x, P
    for i in range(6):
        before, F, Q = step_in_matrices(before, stretch, step, i)
        cov = F @ cov @ F.swapaxes(1, 2) + Q
        np.testing.assert_allclose(motion.x[:, i], before, rtol=1e-9, atol=1e-9)
        block = first.copy()
        block[:, :8, :8] += motion.noise[:, i]
        predict(block, motion.transition.row(i))
        np.testing.assert_allclose(block, cov, rtol=1e-8, atol=1e-8)


def test_a_gradient_by_the_first_events_state_is_that_of_moving_there_and_observing(dive):
    problem = posed(dive)
    sums = problem.sums.interpolate(problem.times.t_s)
    rows = slice(9, 13)
    stretch, events = sums[1:].since(sums[:-1]).row(rows), problem.times.row(slice(10, 14))
    step = steps(stretch, locked(4), problem.priors)
    x = random_states(len(HYPOTHESES), len(dive.dive.beacons), seed=6, size=0.1)
    motion = move(x, stretch, step)
    H = refer_to_first(observe_times(motion.x, events), motion.transition)
    small = small_steps(x.shape[1])

    def predicted(first, j):
        y = np.tile(first, (len(HYPOTHESES), 1))
        for i in range(1, j + 1):
            y, _, _ = step_in_matrices(y, stretch, step, i)
        return flight_time(y[5], events, j)

    for j in range(4):
        expected = derivative(lambda y, j=j: predicted(y, j), motion.x[5, 0], small)
        np.testing.assert_allclose(H[5, j], expected, rtol=1e-5, atol=1e-9)


def test_one_long_step_is_many_short_ones_for_a_straight_run():
    """The integrated Gauss-Markov process: mean and covariance do not hang on how it is cut."""
    heard = simulated(1, 600.0, vehicle={"pattern": "transit"})
    problem = posed(heard)
    t_s = np.linspace(100.0, 130.0, 31)
    sums = problem.sums.interpolate(t_s)
    whole, parts = sums[-1:].since(sums[:1]), sums[1:].since(sums[:-1])
    h = len(HYPOTHESES)
    n = 8 + N_COMMON + 4 * len(heard.dive.beacons)
    x = np.zeros((h, n))
    x[:, 2:8] = [0.02, 0.01, -0.02, 0.03, 0.02, 1e-4]
    variance = np.concatenate(
        [np.ones((h, 2)), problem.priors.drift_sigma[:, [0, 1, 1, 2, 2, 3]] ** 2,
         problem.priors.constant_sigma**2], axis=1
    )  # fmt: skip
    P = variance[:, :, None] * np.eye(n)
    lock = locked(1)
    one, F, Q = step_in_matrices(x, whole, steps(whole, lock, problem.priors), 0)
    one_cov = F @ P @ F.swapaxes(1, 2) + Q
    step, many, many_cov = steps(parts, locked(30), problem.priors), x, P
    for i in range(30):
        many, F, Q = step_in_matrices(many, parts, step, i)
        many_cov = F @ many_cov @ F.swapaxes(1, 2) + Q
    np.testing.assert_allclose(one[:, :2], many[:, :2], atol=0.05)
    sigma = np.maximum(np.sqrt(np.diagonal(many_cov, axis1=1, axis2=2)), 1e-9)
    unit = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(one_cov / unit, many_cov / unit, atol=0.03)


def test_the_error_of_a_held_velocity_counts_for_as_long_as_it_is_held():
    """At the loss of lock it moves the position by what is a state from then on; at the end of it
    that state counts for the held part of the step, and nothing on top."""
    problem = posed(simulated(1, 600.0, vehicle={"pattern": "transit"}))
    sums = problem.sums.interpolate(np.array([100.0, 124.0]))
    stretch = sums[1:].since(sums[:1])._replace(held_s=np.array([10.0]))
    lost, regained = (
        steps(stretch, Held(np.array([code]), np.full((1, len(HYPOTHESES)), 0.5)), problem.priors)
        for code in (_LOST, _REGAINED)
    )
    noise, found_again = lost.noise[0, 0], regained.noise[0, 0]
    direction = stretch.ahead[0] / 24.0
    moved_m2 = 0.5**2 * 10.0 * np.array([direction.real, direction.imag])
    np.testing.assert_allclose(noise[:2, 3], -moved_m2, rtol=1e-6)
    np.testing.assert_array_equal(noise, noise.T)
    assert noise[0, 0] == pytest.approx((0.5 * 10.0) ** 2, rel=0.02)
    assert noise[3, 3] == pytest.approx(0.5**2)
    np.testing.assert_allclose(regained.ahead[:, 0] * 24.0, 10.0, rtol=0.05)
    assert found_again[0, 0] < 0.2 * (0.5 * 10.0) ** 2
    assert found_again[3, 3] == pytest.approx(problem.priors.drift_sigma[0, 1] ** 2)


def test_process_noise_adds_its_variance_a_second_to_each_axis(dive):
    problem = posed(dive)
    sums = problem.sums.interpolate(problem.times.t_s)
    stretch = sums[1:].since(sums[:-1]).row(slice(9, 15))
    quiet = problem.priors
    loud = quiet._replace(position_m2_per_s=quiet.position_m2_per_s + 0.3)
    noise = [steps(stretch, locked(6), priors).noise[:, :, :2, :2] for priors in (quiet, loud)]
    added_m2 = 0.3 * np.asarray(stretch.duration_s)[None, :, None, None] * np.eye(2)
    expected = np.broadcast_to(added_m2, noise[0].shape)
    np.testing.assert_allclose(noise[1] - noise[0], expected, rtol=1e-9, atol=1e-9)


def test_where_lock_is_lost_the_slow_velocity_is_that_of_a_held_one():
    heard = simulated(1, 1800.0, dvl={"lost_from_s": 600.0, "lost_for_s": 600.0})
    trail, _ = run(heard, hypotheses=BASE)
    inside = (heard.t_s > 700.0) & (heard.t_s < 1190.0)
    sigma_mps = np.sqrt(trail.P[:, 3, 3])
    assert np.all(sigma_mps[inside] > 0.01)
    assert np.all(sigma_mps[heard.t_s > 1260.0] < 0.0045)


def test_without_errors_to_learn_it_is_the_papers_two_state_filter():
    heard = cached()
    beacons = dataclasses.replace(heard.dive.beacons, sigma_m=np.zeros(4))
    heard = heard._replace(dive=dataclasses.replace(heard.dive, beacons=beacons))
    start = true_start(heard, 8)
    hard = GATE._replace(huber=1e9)  # all that the gate lets in counts whole
    trail, _ = run(heard, NO_ERRORS, start, hypotheses=BASE, recover=False, block=1, gate=hard)
    usable = np.zeros(len(heard.dive.replies), dtype=bool)
    usable[heard.rows] = True
    motion = dataclasses.replace(heard.motion, gap_variance_m2=np.zeros(len(heard.motion)))
    nodes, expected = filter_travel_times(
        TravelTimes(heard.dive.replies, usable, heard.geometry),
        motion,
        start,
        EkfConfig(10.0, 0.3, SIGMA_S, 9.21),
    )
    counted = np.arange(len(heard.ping)) > 8
    loud = counted & (trail.noise_s2 != SIGMA_S**2)
    assert not loud.any(), "a learned noise would part them"
    assert [DECISIONS[d] for d in expected.decision[heard.rows][counted]] == [
        DECISIONS[d] for d in trail.decision[counted]
    ]
    accepted = trail.decision == ACCEPTED
    np.testing.assert_allclose(trail.x[accepted, :2], nodes.position_m[1:], atol=1e-9)
    np.testing.assert_allclose(trail.P[accepted, :2, :2], nodes.position_cov_m2[1:], atol=1e-9)
    assert not trail.x[8:, 2:].any()


def test_linearising_some_replies_together_costs_centimetres():
    heard = cached(3, 3600.0, "voyage_2")
    one, _ = run(heard, block=1)
    eight, _ = run(heard, block=8)
    known = one.segment >= 0
    np.testing.assert_array_equal(one.decision, eight.decision)
    apart_m = np.hypot(*(one.x[known, :2] - eight.x[known, :2]).T)
    sigma_m = np.sqrt(np.trace(one.P[known, :2, :2], axis1=1, axis2=2))
    assert np.median(apart_m) < 0.02
    assert np.all(apart_m < 0.1 * sigma_m)
    others = np.sqrt(np.trace(eight.P[known, :2, :2], axis1=1, axis2=2))
    np.testing.assert_allclose(others, sigma_m, rtol=0.05)


def test_the_track_between_events_has_the_covariance_that_a_prediction_has():
    heard = cached()
    problem = posed(heard, hypotheses=BASE)
    nodes = track(problem).history.nodes
    k = 60 + int(np.argmax(np.diff(nodes.t_s)[60:] > 6.0))
    t_s = np.array([nodes.t_s[k] + 5.0])
    live = propagate(nodes, problem.sums, problem.priors, (t_s, np.zeros(1)))
    sums = problem.sums.interpolate(np.array([nodes.t_s[k], t_s[0]]))
    stretch = sums[1:].since(sums[:1])
    step = steps(stretch, locked(1, BASE), problem.priors)
    x, F, Q = step_in_matrices(nodes.x[k : k + 1], stretch, step, 0)
    P = F[0, :15, :15] @ nodes.P[k] @ F[0, :15, :15].T + Q[0, :15, :15]
    np.testing.assert_allclose(live.position_m[0], x[0, :2], atol=1e-3)
    np.testing.assert_allclose(live.position_cov_m2[0], P[:2, :2], rtol=1e-3)


def test_priors_are_the_larger_of_the_nominal_and_the_hypothesis():
    priors = bank_priors(PRIORS, np.array([3.0, 0.0, np.nan]), 1500.0)
    beacon = priors.constant_sigma[:, N_COMMON:].reshape(len(HYPOTHESES), 3, 4)
    np.testing.assert_allclose(beacon[0, :, 0], [3.0, 0.5, 0.5])
    np.testing.assert_allclose(beacon[-1, :, 0], [4.0, 4.0, 4.0])
    names = [one.name for one in HYPOTHESES]
    offset = priors.constant_sigma[names.index("offset"), 0]
    assert offset == pytest.approx(np.radians(30.0))
    assert priors.constant_sigma[names.index("clock"), CLOCK] == 0.005
    assert priors.drift_time_s[names.index("velocity_fast"), 1] == 120.0
    assert priors.drift_sigma[0, 0] == pytest.approx(PRIORS.heading_rad)


def test_mirrored_or_moved_hypotheses_leave_no_covariance_without_symmetry():
    trail, _ = run(cached())
    known = trail.segment >= 0
    np.testing.assert_allclose(trail.P[known], trail.P[known].swapaxes(1, 2), atol=1e-9)
    assert np.all(np.linalg.eigvalsh(trail.P[known][-1]) > 0)


def test_huber_weighs_what_the_gate_would_refuse():
    heard = simulated(2, 1800.0, acoustics={"detection": 0.8, "gross": 0.1})
    problem = posed(heard, hypotheses=BASE, gate=GATE._replace(gamma=25.0, huber=1.345))
    tracked = track(problem)
    nodes = tracked.history.nodes
    late = nodes.t_s > nodes.t_s[0] + 300
    off_m = np.hypot(*(nodes.x[late, :2] - heard.true_m(nodes.t_s[late])).T)
    assert np.sqrt(np.mean(off_m**2)) < 3.0


def test_sums_are_to_be_had_at_any_instant():
    heard = cached()
    sums = sums_maker(heard.motion)
    t_s = np.array([10.0, 500.5, 1000.25])
    np.testing.assert_allclose(
        sums.interpolate(t_s).displacement.real, heard.motion.interpolate(t_s).displacement_m[:, 0]
    )


def test_sums_thinned_to_the_instants_that_are_asked_for_are_the_same_to_the_bit():
    sums = sums_maker(cached().motion)
    t_s = np.array([10.0, 500.5, 1000.25, 3599.9])
    thin, whole = sums.thinned(t_s).interpolate(t_s), sums.interpolate(t_s)
    for name, column in whole.columns().items():
        np.testing.assert_array_equal(getattr(thin, name), column, err_msg=name)
    np.testing.assert_array_equal(sums.thinned(t_s).is_held(t_s), sums.is_held(t_s))
