# SPDX-License-Identifier: Apache-2.0
"""Each beacon's replies beside the track that is made without that beacon."""

import numpy as np

from abyssnav.estimation.map_estimator import MapEstimate, Setting
from abyssnav.estimation.normal_equations import solve
from abyssnav.estimation.variance_components import constant_root, predicted_variance
from abyssnav.tables import Float


def leave_beacons_out(setting: Setting, estimate: MapEstimate) -> tuple[Float, Float]:
    """What each reply misses of a track made without its beacon, and the sigma expected of that.

    One Gauss-Newton step from the estimate of all, for each beacon that is left out; its place and
    turn-around are then the stated ones again, with the sigma of their prior as learned.

    Returns
    -------
    missed_s, sigma_s : (n,) s, of every usable reply
    """
    problem, terms, n = setting.problem, estimate.terms, setting.problem.n_times
    node = problem.observations.times.node
    missed_s = terms.rows.residual[:n].copy()
    variance_s2 = estimate.noise.observation_sigma[problem.group[:n]] ** 2
    for beacon in range(problem.n_beacons):
        own = np.flatnonzero(problem.group[:n] == beacon)
        without = terms._replace(information=terms.information * (problem.group != beacon))
        solved = solve(without, problem.slots)
        by_node, by_constant = terms.rows.by_node[own], terms.rows.by_constant[own]
        missed_s[own] -= np.sum(by_node * solved.node_step[node[own]], axis=1)
        missed_s[own] -= by_constant @ solved.constant_step
        variance_s2[own] += predicted_variance(solved, problem.slots, constant_root(solved))[own]
    return missed_s, np.sqrt(variance_s2)
