# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""Our smoother beside GTSAM's robust batch on the same simulated dives: `python tests/rivals.py`.

Both get the same replies, motion, error model and first guess (our RTS track), and minimise the
same cost: Geman-McClure on the two-leg travel times, Gaussian on motion and priors.  GTSAM has no
factor for such times; its factors are written in Python here, so its time is told twice: whole, and
its own part alone (elimination and back-substitution of the linear systems it solved), which is
what it would cost if its factors were free.
"""

import argparse
import math
import time
from dataclasses import dataclass

import gtsam
import numpy as np
from oracles_best import JUDGE, MODEL, SIGMA_S, Heard, simulated

from abyssnav.estimation.map_estimator import estimate, robust_cost
from abyssnav.estimation.model import displacement, observe
from abyssnav.estimation.normal_equations import NODE, SHARED
from abyssnav.estimation.smoother import one_a_ping, smooth
from abyssnav.estimation.tracker import track

CASES = {
    "voyage_1": ("voyage_1", {}),
    "voyage_2": ("voyage_2", {}),
    "outliers 40 %": ("clean", {"acoustics": {"detection": 0.8, "gross": 0.4}}),
}
_SHARED_KEY = gtsam.symbol("s", 0)
_ROBUST = gtsam.noiseModel.Robust.Create(
    gtsam.noiseModel.mEstimator.GemanMcClure.Create(3.0),
    gtsam.noiseModel.Isotropic.Sigma(1, SIGMA_S),
)


@dataclass(frozen=True)
class Compared:
    """One dive, both estimators."""

    ours_m: float
    theirs_m: float
    apart_m: float  #: largest distance between the two tracks
    ours_cost: float
    theirs_cost: float
    ours_s: float
    theirs_s: float
    solver_s: float  #: GTSAM's linear algebra alone
    replies: int


def node_key(i: int) -> int:
    return int(gtsam.symbol("x", i))


def state_of(values: gtsam.Values, i: int) -> np.ndarray:
    x = np.empty(11)
    x[NODE] = values.atVector(node_key(i))
    x[SHARED] = values.atVector(_SHARED_KEY)
    return x


def reply_factor(heard: Heard, i: int) -> gtsam.CustomFactor:
    """Eq. 3 with its derivatives by the node's and the shared states."""
    steps, legs = heard.steps[i : i + 1], heard.legs[i : i + 1]

    def error(_: object, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        predicted_s, H = observe(state_of(values, i)[None], steps, legs)
        if jacobians is not None:
            jacobians[0], jacobians[1] = H[:, NODE], H[:, SHARED]
        return predicted_s - legs.flight_time_s

    return gtsam.CustomFactor(_ROBUST, [node_key(i), _SHARED_KEY], error)


def motion_factor(heard: Heard, i: int) -> gtsam.CustomFactor:
    """From reply i to the next: displacement, fading heading error and held velocity."""
    steps = heard.steps
    run_m, linear_m = steps.run_m[i + 1] - steps.run_m[i], steps.linear_m[i + 1] - steps.linear_m[i]
    dt_s = steps.t_s[i + 1] - steps.t_s[i]
    times_s = (MODEL.heading_time_s, MODEL.held_time_s, MODEL.held_time_s)
    fade = np.exp(-dt_s / np.array(times_s))
    prior = MODEL.prior_variance()[NODE[2:]]
    q = np.full(5, MODEL.position_m2_per_s * dt_s + 1e-6)
    q[2:] = prior * (1 - fade**2) + 1e-12

    def error(_: object, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        x, after = state_of(values, i), values.atVector(node_key(i + 1))
        d_m, by_state = displacement(x, run_m, linear_m)
        if jacobians is not None:
            from_node = np.zeros((5, 5))
            from_node[:2] = -by_state[:, NODE]
            from_node[[0, 1], [0, 1]] -= 1.0
            from_node[[2, 3, 4], [2, 3, 4]] = -fade
            by_shared = np.zeros((5, 6))
            by_shared[:2] = -by_state[:, SHARED]
            jacobians[0], jacobians[1], jacobians[2] = from_node, np.eye(5), by_shared
        return after - np.concatenate([x[:2] + d_m, fade * x[NODE[2:]]])

    noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(q))
    return gtsam.CustomFactor(noise, [node_key(i), node_key(i + 1), _SHARED_KEY], error)


def prior_factor(key: int, places: list[int], sigma: np.ndarray, size: int) -> gtsam.CustomFactor:
    """Zero, give or take sigma, for some places of a vector."""
    J = np.eye(size)[places]

    def error(_: object, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        if jacobians is not None:
            jacobians[0] = J
        return J @ values.atVector(key)

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(sigma), [key], error)


def their_graph(heard: Heard, part: np.ndarray) -> gtsam.NonlinearFactorGraph:
    graph, sigma = gtsam.NonlinearFactorGraph(), np.sqrt(MODEL.prior_variance())
    graph.add(prior_factor(_SHARED_KEY, list(range(6)), sigma[SHARED], 6))
    graph.add(prior_factor(node_key(0), [2, 3, 4], sigma[NODE[2:]], 5))
    for i in np.flatnonzero(part).tolist():
        graph.add(reply_factor(heard, i))
    for i in range(len(heard.ping) - 1):
        graph.add(motion_factor(heard, i))
    return graph


def their_estimate(
    heard: Heard, guess: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """States by GTSAM's Levenberg-Marquardt; time whole, and that of its linear algebra alone."""
    graph, values = their_graph(heard, part), gtsam.Values()
    values.insert(_SHARED_KEY, guess[-1, SHARED])
    for i, x in enumerate(guess):
        values.insert(node_key(i), x[NODE])
    # the shared states last: the order that keeps the rest a chain
    ordering = gtsam.Ordering()
    for i in range(len(guess)):
        ordering.push_back(node_key(i))
    ordering.push_back(_SHARED_KEY)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrdering(ordering)
    parameters.setMaxIterations(50)
    parameters.setRelativeErrorTol(1e-8)
    parameters.setAbsoluteErrorTol(1e-6)
    begin = time.process_time()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    values = optimizer.optimize()
    whole_s = time.process_time() - begin
    linear = graph.linearize(values)
    begin = time.process_time()
    linear.optimize(ordering)
    solver_s = (time.process_time() - begin) * optimizer.iterations()
    return np.array([state_of(values, i) for i in range(len(guess))]), whole_s, solver_s


def compare(case: str, seed: int, duration_s: float) -> Compared:
    base, changes = CASES[case]
    heard = simulated(seed, duration_s, base, **changes)
    trail, _ = track(heard.beacon, heard.ping, heard.legs, heard.steps, MODEL, JUDGE)
    guess = smooth(trail, heard.steps, heard.legs, SIGMA_S)
    guess[:, SHARED] = guess[-1, SHARED]
    part = one_a_ping(guess, heard.ping, heard.beacon, heard.steps, heard.legs)
    args = heard.steps, heard.legs, MODEL, SIGMA_S, part
    estimate(guess, *args)  # imports done
    begin = time.process_time()
    ours = estimate(guess, *args).x
    ours_s = time.process_time() - begin
    theirs, theirs_s, solver_s = their_estimate(heard, guess, part)
    true_m = heard.true_m(heard.steps.t_s)

    def rms_m(x: np.ndarray) -> float:
        return math.sqrt(np.mean(np.sum((x[:, :2] - true_m) ** 2, axis=1)))

    return Compared(
        rms_m(ours),
        rms_m(theirs),
        float(np.hypot(*(ours[:, :2] - theirs[:, :2]).T).max()),
        robust_cost(ours, *args),
        robust_cost(theirs, *args),
        ours_s,
        theirs_s,
        solver_s,
        len(heard.ping),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--hours", type=float, default=1.0)
    arguments = parser.parse_args()
    print(
        f"{'case':14} {'seed':>4} {'replies':>7} {'ours m':>7} {'gtsam m':>7} {'apart m':>7} "
        f"{'ours cost':>10} {'gtsam cost':>10} {'x slower':>8} {'solver x':>8}"
    )
    for case in CASES:
        for seed in range(1, 1 + arguments.seeds):
            r = compare(case, seed, 3600.0 * arguments.hours)
            print(
                f"{case:14} {seed:4d} {r.replies:7d} {r.ours_m:7.3f} {r.theirs_m:7.3f} "
                f"{r.apart_m:7.3f} {r.ours_cost:10.2f} {r.theirs_cost:10.2f} "
                f"{r.theirs_s / r.ours_s:8.1f} {r.solver_s / r.ours_s:8.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
