# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: T201
"""Our smoother beside GTSAM with the same states: `python tests/peers/gtsam_same_states.py`.

Both get the same replies, nodes, error states, priors and first guess (the truth, 20 m aside).
GTSAM minimises Geman-McClure on the two-leg travel times and Gaussian on motion and priors, with
the stated noise: it learns none.  It has no factor for such times; its factors are written in
Python here, so its time is given twice: whole, and its own part alone (elimination and
back-substitution of the linear systems it solved), which is what it would cost if its factors and
its linearisation were free.  Ours is whole: linearisation, learning and covariance with it.
"""

import argparse
import dataclasses
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
from dives import Case, posed
from oracles_best import simulated

from abyssnav.estimation.dive_problem import drift_terms, motion_variance, row_sigma
from abyssnav.estimation.dive_states import DRIFTS, N_MOTION, DiveStates
from abyssnav.estimation.map_estimator import Schedule, estimate_map
from abyssnav.estimation.observations import Observations, observe
from abyssnav.estimation.preintegration import preintegrate

CASES = {
    "nominal": ("nominal", {}),
    "voyage_2": ("voyage_2", {}),
    "outliers 40 %": ("clean", {"acoustics": {"detection": 0.8, "gross": 0.4}}),
    "DVL 2 cm/s off": ("clean", {"dvl": {"slow_sigma_mps": 0.02, "slow_time_s": 120.0}}),
}
_CONSTANT = gtsam.symbol("c", 0)


@dataclass(frozen=True)
class Compared:
    """One dive, both estimators."""

    ours_m: float
    theirs_m: float
    ours_nees: float
    theirs_nees: float
    ours_s: float
    theirs_s: float
    solver_s: float  #: GTSAM's linear algebra alone
    replies: int


def node_key(i: int) -> int:
    return int(gtsam.symbol("x", i))


def reply_factor(world: Case, row: int, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
    """Eq. 3 with its derivatives by the node's and the constant states."""
    whole = world.problem.observations
    one = slice(row, row + 1)
    times = dataclasses.replace(whole.times[one], node=np.zeros(1, dtype=np.int64))
    part = Observations(
        times, whole.ping[one], whole.reply[one], whole.leg_ping[one], whole.leg_reply[one],
        whole.positions, whole.position_offsets,
    )  # fmt: skip

    def error(_: object, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        node = values.atVector(node_key(int(whole.times.node[row])))
        rows = observe(part, DiveStates(node[None], values.atVector(_CONSTANT)))
        if jacobians is not None:
            jacobians[0], jacobians[1] = rows.by_node, rows.by_constant
        return -rows.residual

    keys = [node_key(int(whole.times.node[row])), _CONSTANT]
    return gtsam.CustomFactor(noise, keys, error)


def motion_factor(world: Case, i: int, variance_m2: float) -> gtsam.CustomFactor:
    """Dead reckoning from a node to the next."""
    cells = world.problem.cells[world.problem.cells.interval == i]
    cells = dataclasses.replace(cells, interval=cells.interval * 0)

    def error(_: object, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        node = np.array([values.atVector(node_key(i)), values.atVector(node_key(i + 1))])
        step = preintegrate(cells, DiveStates(node, values.atVector(_CONSTANT)))
        if jacobians is not None:
            place = np.eye(2, 8)
            by_constant = np.zeros((2, len(values.atVector(_CONSTANT))))
            by_constant[:, :N_MOTION] = step.by_constant[0]
            jacobians[0], jacobians[1] = step.by_first[0] + place, step.by_second[0] - place
            jacobians[2] = by_constant
        d = step.displacement[0]
        return node[0, :2] + [d.real, d.imag] - node[1, :2]

    noise = gtsam.noiseModel.Isotropic.Sigma(2, float(np.sqrt(variance_m2)))
    return gtsam.CustomFactor(noise, [node_key(i), node_key(i + 1), _CONSTANT], error)


def drift_factor(i: int, factor: np.ndarray, variance: np.ndarray) -> gtsam.CustomFactor:
    """Fading states from a node to the next."""
    before, after = np.zeros((6, 8)), np.zeros((6, 8))
    before[:, DRIFTS], after[:, DRIFTS] = -np.diag(factor), np.eye(6)

    def error(_: object, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        if jacobians is not None:
            jacobians[0], jacobians[1] = before, after
        one, two = values.atVector(node_key(i)), values.atVector(node_key(i + 1))
        return before @ one + after @ two

    noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(variance))
    return gtsam.CustomFactor(noise, [node_key(i), node_key(i + 1)], error)


def prior_factor(key: int, sigma: np.ndarray) -> gtsam.PriorFactorVector:
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
    return gtsam.PriorFactorVector(key, np.zeros(len(sigma)), noise)


def their_graph(world: Case, start: DiveStates) -> gtsam.NonlinearFactorGraph:
    graph, problem, noise = gtsam.NonlinearFactorGraph(), world.problem, world.setting.prior
    sigma_s, variance_m2 = row_sigma(problem, noise), motion_variance(problem, noise)
    drift = drift_terms(problem, start, noise)
    part = estimate_map(
        world.setting, start, schedule=Schedule(learn=False, most_steps=0)
    ).taking_part
    graph.add(prior_factor(_CONSTANT, noise.constant_sigma))
    first = np.concatenate([[1e5, 1e5], np.sqrt(drift.variance[0])])
    graph.add(prior_factor(node_key(0), first))
    for row in np.flatnonzero(part).tolist():
        robust = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.GemanMcClure.Create(3.0),
            gtsam.noiseModel.Isotropic.Sigma(1, float(sigma_s[row])),
        )
        graph.add(reply_factor(world, row, robust))
    for i, variance in enumerate(variance_m2.tolist()):
        graph.add(motion_factor(world, i, variance))
        graph.add(drift_factor(i, drift.factor[i + 1], drift.variance[i + 1]))
    return graph


def their_estimate(world: Case, start: DiveStates) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Nodes and their position covariances; time whole, and that of the linear algebra alone."""
    graph, values = their_graph(world, start), gtsam.Values()
    values.insert(_CONSTANT, start.constant)
    ordering = gtsam.Ordering()  # the constants last: the order that keeps the rest a chain
    for i, node in enumerate(start.node):
        values.insert(node_key(i), node)
        ordering.push_back(node_key(i))
    ordering.push_back(_CONSTANT)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrdering(ordering)
    parameters.setMaxIterations(50)
    parameters.setRelativeErrorTol(1e-8)
    begin = time.process_time()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    values = optimizer.optimize()
    whole_s = time.process_time() - begin
    linear = graph.linearize(values)
    begin = time.process_time()
    linear.optimize(ordering)
    solver_s = (time.process_time() - begin) * optimizer.iterations()
    known = gtsam.Marginals(graph, values)
    n = len(start.node)
    nodes = np.array([values.atVector(node_key(i)) for i in range(n)])
    cov = np.array([known.marginalCovariance(node_key(i))[:2, :2] for i in range(n)])
    return nodes, cov, whole_s, solver_s


def scored(world: Case, node: np.ndarray, cov_m2: np.ndarray) -> tuple[float, float]:
    """RMS and NEES of the nodes from five minutes on."""
    t_s = world.problem.t_node_s
    late = t_s > t_s[0] + 300.0
    error = (node[:, :2] - world.heard.true_m(t_s))[late]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov_m2[late]), error)
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))), float(nees.mean())


def compare(case: str, seed: int, duration_s: float) -> Compared:
    base, changes = CASES[case]
    world = posed(simulated(seed, duration_s, base, **changes))
    start = world.true_states()
    start = DiveStates(start.node + np.eye(8)[0] * 20.0, start.constant)
    estimate_map(world.setting, start)  # imports done
    begin = time.process_time()
    ours = estimate_map(world.setting, start)
    ours_s = time.process_time() - begin
    node, cov_m2, theirs_s, solver_s = their_estimate(world, start)
    ours_m, ours_nees = scored(world, ours.states.node, ours.node_cov()[:, :2, :2])
    theirs_m, theirs_nees = scored(world, node, cov_m2)
    return Compared(
        ours_m, theirs_m, ours_nees, theirs_nees, ours_s, theirs_s, solver_s, world.problem.n_times
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--hours", type=float, default=1.0)
    arguments = parser.parse_args()
    print(
        f"{'case':14} {'seed':>4} {'replies':>7} {'ours m':>7} {'gtsam m':>7} {'NEES':>6} "
        f"{'gtsam':>6} {'ours s':>7} {'gtsam s':>8} {'solver s':>8}"
    )
    for case in CASES:
        for seed in range(1, 1 + arguments.seeds):
            r = compare(case, seed, 3600.0 * arguments.hours)
            print(
                f"{case:14} {seed:4d} {r.replies:7d} {r.ours_m:7.3f} {r.theirs_m:7.3f} "
                f"{r.ours_nees:6.2f} {r.theirs_nees:6.2f} {r.ours_s:7.3f} {r.theirs_s:8.2f} "
                f"{r.solver_s:8.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
