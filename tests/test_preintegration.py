# SPDX-License-Identifier: Apache-2.0
import cmath

import numpy as np
from dives import SMALL_NODE, case, derivative, heading_error_rad, wrong_states

from abyssnav.estimation.preintegration import preintegrate


def test_between_nodes_it_is_the_step_by_step_sum_with_every_error():
    world = case()
    problem, motion = world.problem, world.inputs.motion
    states = wrong_states(problem, seed=1, size=0.3)
    found = preintegrate(problem.cells, states).displacement
    for i in range(0, len(found), 9):
        t_s = np.linspace(*problem.t_node_s[i : i + 2], 400)
        fine, total = motion.interpolate(t_s), 0j
        for k in range(399):
            share = (k + 0.5) / 399
            x = (1 - share) * states.node[i] + share * states.node[i + 1]
            heading = 0.5 * (fine.heading_rad[k] + fine.heading_rad[k + 1])
            error = heading_error_rad(states.constant, x[2], heading)
            run = complex(*(fine.displacement_m[k + 1] - fine.displacement_m[k]))
            dt_s = t_s[k + 1] - t_s[k]
            ahead = (np.sin(heading) + 1j * np.cos(heading)) * dt_s
            total += (
                cmath.exp(1j * error)
                / (1 + states.constant[5])
                * (run - (x[3] - 1j * x[4]) * ahead)
                + (x[5] + 1j * x[6]) * dt_s
            )
        assert abs(found[i] - total) < 5e-3


def test_derivatives_are_those_by_differences():
    world = case(count=4)
    problem, states = world.problem, wrong_states(world.problem, seed=2)
    step = preintegrate(problem.cells, states)
    for side, expected_from in ((slice(0, None, 2), 0), (slice(1, None, 2), 1)):
        # Change every other node: each interval then feels one end only.
        def displaced(change, side=side):
            node = states.node.copy()
            node[side] += change
            d = preintegrate(problem.cells, states._replace(node=node)).displacement
            return np.column_stack([d.real, d.imag])

        expected = derivative(displaced, np.zeros(8), SMALL_NODE)
        first, second = expected[expected_from::2], expected[1 - expected_from :: 2]
        np.testing.assert_allclose(step.by_first[expected_from::2], first, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(
            step.by_second[1 - expected_from :: 2], second, rtol=1e-5, atol=1e-5
        )

    def by_constant(constant):
        d = preintegrate(problem.cells, states._replace(constant=constant)).displacement
        return np.column_stack([d.real, d.imag])

    expected = derivative(by_constant, states.constant, np.full(len(states.constant), 1e-5))
    np.testing.assert_allclose(step.by_constant, expected[:, :, :6], rtol=1e-5, atol=1e-4)
    assert np.abs(expected[:, :, 6:]).max() == 0
