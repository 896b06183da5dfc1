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
from abyssnav.estimation.filter_bank import N_MOVING, displace, observe_time, predict
from abyssnav.estimation.filter_events import Held, SumsMaker, transitions
from abyssnav.estimation.filter_history import propagate
from abyssnav.estimation.hypotheses import HYPOTHESES, bank_priors
from abyssnav.estimation.observations import LegTable, Observations, Offsets, PositionTable, observe
from abyssnav.estimation.observations import TimeTable as BatchTimes
from abyssnav.estimation.tracker import track
from abyssnav.estimation.two_state import ACCEPTED, EkfConfig, filter_travel_times
from abyssnav.tables import DECISIONS

BASE = HYPOTHESES[:1]


def locked(n):
    return Held(np.zeros(n, dtype=int), np.full(n, 0.1))


@pytest.fixture(scope="module", params=[2, 5])
def dive(request):
    """A dive with a number of beacons that is not three."""
    return simulated(2, 1200.0, beacons={"count": request.param})


def test_a_displacement_and_its_derivatives_by_every_state_are_those_of_the_equation(dive):
    problem = posed(dive)
    sums = problem.sums.interpolate(problem.times.t_s)
    stretch = sums[1:].since(sums[:-1])
    x = random_states(17, len(dive.dive.beacons), seed=1)
    steps = small_steps(x.shape[1])[:N_MOVING]
    for i in (0, 7, 30):
        row = stretch.row(i)
        d, by = displace(x, row, (1.0, 1.0, row.duration_s))
        for k in range(len(x)):
            assert d[k] == pytest.approx(moved(x[k], row), abs=1e-9)
            expected = derivative(lambda y, row=row: moved(y, row), x[k, :N_MOVING], steps)
            np.testing.assert_allclose(by[k], expected, rtol=1e-6, atol=1e-6)


def test_a_predicted_time_and_its_gradient_by_every_state_are_those_of_both_legs(dive):
    times = posed(dive).times
    x = random_states(17, len(dive.dive.beacons), seed=2)
    steps = small_steps(x.shape[1])
    for i in (0, 11, 40):
        prediction = observe_time(x, times, i)
        for k in range(len(x)):
            assert prediction.time_s[k] == pytest.approx(flight_time(x[k], times, i), abs=1e-12)
            expected = derivative(lambda y, i=i: flight_time(y, times, i), x[k], steps)
            np.testing.assert_allclose(prediction.H[k], expected, rtol=1e-6, atol=1e-10)


def test_one_reply_for_all_filters_is_what_whole_columns_of_the_batch_predict(dive):
    """The one measurement model twice: by columns of replies, and fast for one reply."""
    times, n = posed(dive).times, len(dive.ping)
    x = random_states(1, len(dive.dive.beacons), seed=3)
    back = times.since_ping
    nothing = np.zeros(n)
    shapes = np.zeros((n, 4))
    legs = [
        LegTable(times.virtual_beacon[:, k], times.height_m[:, k], times.speed_mps[:, k],
                 times.above_reference_m[:, k])
        for k in (0, 1)
    ]  # fmt: skip
    x[:, 9:13] = 0.0  # the batch takes the deviation at an instant, the filter its integral
    rows = observe(
        Observations(
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
        prediction = observe_time(x, times, i)
        late_s = times.flight_time_s[i] - prediction.time_s[0]
        assert late_s == pytest.approx(rows.residual[i], abs=1e-12)
        gradient = np.concatenate([rows.by_node[i], rows.by_constant[i]])
        np.testing.assert_allclose(prediction.H[0][compared], gradient[compared], atol=1e-12)


def test_a_step_is_the_textbooks_in_matrices(dive):
    problem = posed(dive)
    sums = problem.sums.interpolate(problem.times.t_s)
    stretch = sums[1:].since(sums[:-1])
    priors = problem.priors
    step = transitions(stretch, locked(len(stretch.displacement)), priors)
    h, n = len(HYPOTHESES), 8 + N_COMMON + 4 * len(dive.dive.beacons)
    x = random_states(h, len(dive.dive.beacons), seed=4, size=0.1)
    rng = np.random.default_rng(5)
    root = rng.normal(0, 1, (h, n, n))
    P = root @ root.swapaxes(1, 2)
    i = 9
    after, cov = x.copy(), P.copy()
    predict(after, cov, stretch.row(i), step.row(i))
    row = step.row(i)
    for k in range(h):
        _, by = displace(
            x[k : k + 1], stretch.row(i),
            (row.heading[k : k + 1], row.ahead[k : k + 1], row.current_s[k : k + 1]),
        )  # fmt: skip
        F = np.eye(n)
        F[range(2, 8), range(2, 8)] = row.fade[k]
        F[0, 2:N_MOVING], F[1, 2:N_MOVING] = by[0, 2:].real, by[0, 2:].imag
        Q = np.zeros((n, n))
        Q[:8, :8] = row.noise[k]
        np.testing.assert_allclose(cov[k], F @ P[k] @ F.T + Q, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(after[k, 2:8], x[k, 2:8] * row.fade[k])
        np.testing.assert_array_equal(after[k, 8:], x[k, 8:])


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
    one, one_cov, many, many_cov = x.copy(), P.copy(), x.copy(), P.copy()
    lock = locked(1)
    predict(one, one_cov, whole.row(0), transitions(whole, lock, problem.priors).row(0))
    step = transitions(parts, locked(30), problem.priors)
    for i in range(30):
        predict(many, many_cov, parts.row(i), step.row(i))
    np.testing.assert_allclose(one[:, :2], many[:, :2], atol=0.05)
    sigma = np.maximum(np.sqrt(np.diagonal(many_cov, axis1=1, axis2=2)), 1e-9)
    unit = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(one_cov / unit, many_cov / unit, atol=0.03)


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
    trail, _ = run(heard, NO_ERRORS, start, hypotheses=BASE, recover=False)
    usable = np.zeros(len(heard.dive.replies), dtype=bool)
    usable[heard.rows] = True
    motion = dataclasses.replace(heard.motion, gap_variance_m2=np.zeros(len(heard.motion)))
    nodes, expected = filter_travel_times(
        heard.dive.replies,
        usable,
        heard.geometry,
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


def test_the_track_between_events_has_the_covariance_that_a_prediction_has():
    heard = cached()
    problem = posed(heard, hypotheses=BASE)
    nodes = track(problem).history.nodes
    k = 60 + int(np.argmax(np.diff(nodes.t_s)[60:] > 6.0))
    t_s = np.array([nodes.t_s[k] + 5.0])
    live = propagate(nodes, problem.sums, problem.priors, (t_s, np.zeros(1)))
    sums = problem.sums.interpolate(np.array([nodes.t_s[k], t_s[0]]))
    stretch = sums[1:].since(sums[:1])
    step = transitions(stretch, locked(1), problem.priors)
    n = nodes.x.shape[1]
    x, P = nodes.x[k : k + 1].copy(), np.zeros((1, n, n))
    P[0, :15, :15] = nodes.P[k]
    predict(x, P, stretch.row(0), step.row(0))
    np.testing.assert_allclose(live.position_m[0], x[0, :2], atol=1e-3)
    np.testing.assert_allclose(live.position_cov_m2[0], P[0, :2, :2], rtol=1e-3)


def test_priors_are_the_larger_of_the_nominal_and_the_hypothesis():
    priors = bank_priors(PRIORS, np.array([3.0, 0.0, np.nan]), 1500.0)
    beacon = priors.constant_sigma[:, N_COMMON:].reshape(len(HYPOTHESES), 3, 4)
    np.testing.assert_allclose(beacon[0, :, 0], [3.0, 0.5, 0.5])
    np.testing.assert_allclose(beacon[-1, :, 0], [4.0, 4.0, 4.0])
    names = [one.name for one in HYPOTHESES]
    offset = priors.constant_sigma[names.index("offset"), 0]
    assert offset == pytest.approx(np.radians(30.0))
    assert priors.constant_sigma[names.index("clock"), CLOCK] == 0.005
    assert priors.drift_time_s[names.index("heading_fast"), 0] == 60.0
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
    sums = SumsMaker(heard.motion)
    t_s = np.array([10.0, 500.5, 1000.25])
    np.testing.assert_allclose(
        sums.interpolate(t_s).displacement.real, heard.motion.interpolate(t_s).displacement_m[:, 0]
    )
