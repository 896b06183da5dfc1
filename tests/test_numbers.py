# SPDX-License-Identifier: Apache-2.0
"""What a computer's arithmetic does to a long dive, and geometry that no position follows from."""

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from abyssnav.align import align, reference
from abyssnav.config import Config
from abyssnav.diagnose import with_verdict
from abyssnav.errors import SolveError
from abyssnav.estimation.dive_states import DRIFT_GROUP, DRIFTS, N_NODE
from abyssnav.estimation.filter_bank import move, observe_times, refer_to_first
from abyssnav.estimation.filter_events import StepsMaker
from abyssnav.estimation.kalman import condition, joint_innovations, predict, update
from abyssnav.navigate import navigate
from abyssnav.navigate.augmented import pose_problem
from abyssnav.navigate.inputs import prepare
from abyssnav.simulate import load_scenario, simulate, to_log
from abyssnav.tables import Float, Log, Solution


@pytest.mark.parametrize("updates", [3000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_covariances_stay_symmetric_and_positive_over_any_number_of_updates(updates: int) -> None:
    """The replies of an hour again and again; what is learned of the constants is never lost.

    That is the hardest case: variances fall for ever, by differences of nearly equal numbers.
    """
    scenario = msgspec.structs.replace(load_scenario("voyage_1"), duration_s=3600.0)
    config = Config()
    problem = pose_problem(prepare(align(to_log(simulate(scenario)), config), config), config,
                           huber=True)  # fmt: skip
    times, priors, k = problem.times, problem.priors, problem.block
    steps = StepsMaker(problem.sums, times.t_s, priors)
    variance = np.zeros(N_NODE + priors.constant_sigma.shape[1])
    variance[:2], variance[DRIFTS] = 1e6, priors.drift_sigma[0, DRIFT_GROUP] ** 2
    variance[N_NODE:] = priors.constant_sigma[0] ** 2
    P, nothing = np.diag(variance)[None].copy(), np.zeros((1, k))
    for block in range(updates // k + 1):
        i = block * k % (len(times.t_s) - k)
        motion = move(np.zeros((1, len(variance))), *steps.rows(i, k))
        predict(P, motion.to_first)
        P[:, :N_NODE, :N_NODE] += motion.first_noise
        prediction = observe_times(motion.x, times.row(np.arange(i + 1, i + 1 + k)))
        H = refer_to_first(prediction, motion.transition)
        joint, share = joint_innovations(P, H, motion.noise, nothing), nothing.copy()
        for j in range(k):
            share[:, j] = 1 / (joint[:, j, j] + priors.time_noise_s**2)
            condition(joint, j, share[:, j])
        update(P, joint, share)
        P[:, :N_NODE, :N_NODE] += motion.noise[:, -1]
        predict(P, motion.transition.row(k - 1))
        if block % 100 == 0 or block == updates // k:
            assert least_share(P[0]) > 1e-7


def least_share(cov: Float) -> float:
    """Least eigenvalue of the correlations, of those states that are not known exactly."""
    variance = np.diag(cov)
    assert (variance >= 0).all()
    free = variance > 0
    sigma = np.sqrt(variance[free])
    correlation = cov[np.ix_(free, free)] / sigma[:, None] / sigma
    np.testing.assert_allclose(correlation, correlation.T, rtol=0, atol=1e-9)
    return float(np.linalg.eigvalsh(correlation)[0])


# --- geometry -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def logged() -> Log:
    scenario = msgspec.structs.replace(load_scenario("clean"), duration_s=900.0)
    return to_log(simulate(scenario))


def with_beacons(log: Log, place: Callable[[Float], Float]) -> Log:
    """The same dive among beacons elsewhere, by straight rays in water of 1500 m/s."""
    beacons, replies, truth = (log.roles[r] for r in ("beacons", "travel_time", "reference"))
    position_m = place(beacons["position_enu_m"].copy())
    row = np.searchsorted(beacons["id"], replies["beacon_id"])
    turn_around_s = beacons["turn_around_s"][row]

    def range_m(time_ns: Float) -> Float:
        vehicle_m = [np.interp(time_ns, truth["time_ns"], axis)
                     for axis in truth["position_enu_m"].T]  # fmt: skip
        return np.asarray(np.linalg.norm(np.column_stack(vehicle_m) - position_m[row], axis=1))

    asked_ns = replies["ping_time_ns"]
    two_way_s = 2 * range_m(asked_ns) / 1500 + turn_around_s
    for _ in range(4):
        heard_ns = asked_ns + two_way_s * 1e9
        two_way_s = (range_m(asked_ns) + range_m(heard_ns)) / 1500 + turn_around_s
    heard_ns = asked_ns + np.round(two_way_s * 1e9).astype(np.int64)
    replies = {**replies, "travel_time_s": two_way_s, "time_ns": heard_ns}
    order = np.argsort(heard_ns, kind="stable")
    roles = {role: columns for role, columns in log.roles.items() if role != "sound_speed"}
    roles |= {
        "travel_time": {name: column[order] for name, column in replies.items()},
        "beacons": {**beacons, "position_enu_m": position_m},
    }
    return replace(log, roles=roles)


def navigated(log: Log) -> Solution:
    config = Config()
    return with_verdict(navigate(align(log, config), config), config)


def errors_m(solution: Solution, log: Log) -> Float:
    """Distance of the smoother from the truth, at each of its instants."""
    truth, track = reference(log), solution.tracks["smoother"]
    assert truth is not None
    t_s = (truth.time_ns - solution.dive.start_ns) / 1e9
    apart_m = [np.interp(track.t_s, t_s, truth.position_enu_m[:, k]) - track.position_enu_m[:, k]
               for k in range(2)]  # fmt: skip
    return np.hypot(*apart_m)


def rising(position_m: Float) -> Float:
    """One above the other: every position round their mooring is as good."""
    position_m[:, :2] = position_m[0, :2]
    position_m[:, 2] -= 50.0 * np.arange(len(position_m))
    return position_m


def clustered(position_m: Float) -> Float:
    return np.asarray(position_m[0] + np.arange(len(position_m))[:, None] * [1.0, 0.5, 0.0])


def in_line(position_m: Float) -> Float:
    position_m[:, :2] = position_m[0, :2] + np.arange(len(position_m))[:, None] * [700.0, 0.0]
    return position_m


def remote(position_m: Float) -> Float:
    return position_m + np.array([4e5, 0.0, 0.0])


@pytest.mark.parametrize("place", [rising, clustered, in_line, remote])
def test_of_beacons_that_hardly_give_a_position_no_track_claims_more_than_it_has(
    logged: Log, place: Callable[[Float], Float]
) -> None:
    """Errors are within the stated 95 % of their legs, or there is no track; said either way."""
    log = with_beacons(logged, place)
    solution = navigated(log)
    said = [check.name for check in solution.checks if not check.ok]
    assert {"start_confirmed", "travel_times_agree"} & set(said)
    assert solution.accuracy is not None
    radius_m = float(np.median(solution.accuracy.uncertainty_95_m))
    if np.isfinite(radius_m):
        assert np.median(errors_m(solution, log)) < radius_m
    else:
        assert solution.verdict.level == "unusable"


def test_beacons_in_one_place_are_refused_in_words(logged: Log) -> None:
    log = with_beacons(logged, lambda position_m: np.tile(position_m[:1], (len(position_m), 1)))
    with pytest.raises(SolveError, match="all 4 beacons lie in 1 places"):
        navigated(log)
