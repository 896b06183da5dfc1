# SPDX-License-Identifier: Apache-2.0
"""Many dives' least squares against dense equations, finite differences and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from voyages import evidence, voyage

from abyssnav.calibrate.adjustment import (
    Normal,
    begin,
    learned_priors,
    log_evidence,
    solve,
    sum_dives,
)
from abyssnav.calibrate.clock_offsets import directions, shifted_cells, shifted_observations
from abyssnav.calibrate.evidence import DiveEvidence, DiveIterate, moved, reduce_dive
from abyssnav.calibrate.unknowns import BEACON, Group, Layout, Unknown, make_layout, stated_places
from abyssnav.estimation.dive_states import N_NODE
from abyssnav.estimation.normal_equations import motion_columns
from abyssnav.estimation.observations import observe
from abyssnav.estimation.preintegration import preintegrate
from abyssnav.tables import Origin


@pytest.fixture(scope="module")
def dives() -> list[DiveEvidence]:
    """Two dives of a quarter of an hour, turning all the while, one with position fixes."""
    simulations = voyage(
        {"duration_s": 900.0, "vehicle.pattern": "circle", "vehicle.radius_m": 60.0},
        [{"position.usbl_period_s": 60.0}, {}],
        seed=3,
    )
    return [evidence(s, f"dive_{i}") for i, s in enumerate(simulations)]


@pytest.fixture
def iterates(dives: list[DiveEvidence]) -> list[DiveIterate]:
    """Away from where each dive would rest, with time offsets."""
    generator = np.random.default_rng(8)
    result = []
    for iterate in begin(dives):
        constant = iterate.states.constant
        constant = constant + 0.01 * generator.normal(size=len(constant))
        states = iterate.states._replace(constant=constant)
        result.append(iterate._replace(states=states, further=np.array([0.4, -0.3])))
    return result


def dense(dive: DiveEvidence, terms):
    """Whitened Jacobian and residuals of a dive: its nodes, then its constants."""
    problem = dive.setting.problem
    n, m = len(problem.t_node_s), len(terms.constant)
    J, r = [], []

    def add(blocks, columns, by_constant, residual, variance):
        row = np.zeros(N_NODE * n + m)
        for node, values in blocks:
            row[N_NODE * node : N_NODE * (node + 1)] += values
        row[N_NODE * n + columns] = by_constant
        J.append(row / np.sqrt(variance))
        r.append(residual / np.sqrt(variance))

    observations, every = problem.observations, np.arange(m)
    nodes = np.concatenate([observations.times.node, np.repeat(observations.positions.node, 2)])
    for i in np.flatnonzero(terms.information > 0):
        add([(nodes[i], terms.rows.by_node[i])], every, terms.rows.by_constant[i],
            terms.rows.residual[i], 1 / terms.information[i])  # fmt: skip
    motion, drift = terms.motion, terms.drift
    columns = motion_columns(motion.step, m)
    for i in range(n - 1):
        for axis in (0, 1):
            unit = np.eye(N_NODE)[axis]
            blocks = [
                (i, motion.step.by_first[i, axis] + unit),
                (i + 1, motion.step.by_second[i, axis] - unit),
            ]
            add(blocks, columns, motion.step.by_constant[i, axis], motion.miss_m[i, axis],
                motion.variance_m2[i])  # fmt: skip
    for i in range(n):
        for place in range(6):
            unit = np.eye(N_NODE)[2 + place]
            blocks = [(i, -unit)] + ([(i - 1, drift.factor[i, place] * unit)] if i else [])
            add(blocks, every[:0], [], drift.miss[i, place], drift.variance[i, place])
        for axis in (0, 1):
            add([(i, np.eye(N_NODE)[axis])], every[:0], [], 0.0, 1e10)
    return np.array(J), np.array(r)


def test_the_shared_unknowns_are_those_of_one_dense_solve_of_all(
    dives: list[DiveEvidence], iterates: list[DiveIterate]
) -> None:
    layout = make_layout(dives, frozenset([Group("place", 2)]))
    reduced = [reduce_dive(*pair, 5.0) for pair in zip(dives, iterates, strict=True)]
    value, cov = solve(sum_dives(layout, reduced), layout.sigma)

    sizes = [N_NODE * len(dive.setting.problem.t_node_s) for dive in dives]
    total = sum(sizes) + len(value)
    J, r = [], []
    for d, (dive, part) in enumerate(zip(dives, reduced, strict=True)):
        own_J, own_r = dense(dive, part.terms)
        spread = np.zeros((len(own_J), total))
        spread[:, sum(sizes[:d]) : sum(sizes[: d + 1])] = own_J[:, : sizes[d]]
        by_constant = own_J[:, sizes[d] :]
        spread[:, sum(sizes) + layout.columns[d]] = by_constant
        # J (x + offset - x₀) = r: the step is counted from the dive's own iterate.
        J.append(spread)
        r.append(own_r + by_constant @ (part.terms.constant - layout.offset[d]))
    J.append(np.hstack([np.zeros((len(value), sum(sizes))), np.diag(1 / layout.sigma)]))
    r.append(np.zeros(len(value)))
    J, r = np.vstack(J), np.concatenate(r)
    scale = np.sqrt(np.sum(J**2, axis=0))
    expected = (np.linalg.lstsq(J / scale, r, rcond=None)[0] / scale)[sum(sizes) :]
    whole = np.linalg.inv((J / scale).T @ (J / scale)) / np.outer(scale, scale)
    sigma = layout.sigma
    np.testing.assert_allclose(value / sigma, expected / sigma, atol=1e-4)
    np.testing.assert_allclose(
        cov / np.outer(sigma, sigma),
        whole[sum(sizes) :, sum(sizes) :] / np.outer(sigma, sigma),
        atol=1e-4,
    )


@pytest.mark.parametrize("which", [0, 1])
def test_the_derivatives_by_time_offsets_are_central_differences(
    dives: list[DiveEvidence], iterates: list[DiveIterate], which: int
) -> None:
    dive, (states, further, _) = dives[0], iterates[0]
    problem, rates = dive.setting.problem, dive.rates

    def rows(offsets):
        return observe(shifted_observations(problem.observations, rates, offsets), states)

    def displacement(offsets):
        return preintegrate(shifted_cells(problem.cells, rates, offsets), states).displacement

    step = 1e-4 * np.eye(2)[which]
    unit = 2e-4
    shifted = shifted_observations(problem.observations, rates, further)
    by = observe(
        shifted, states, directions(problem.observations, rates, states, further)
    ).by_constant[:, which - 2]
    numeric = -(rows(further + step).residual - rows(further - step).residual) / unit
    assert np.abs(numeric).max() > 1e-5
    np.testing.assert_allclose(by, numeric, atol=1e-6 * np.abs(numeric).max())
    cell_turn = np.column_stack([-rates.cell_turn_rad_per_s, 0 * rates.cell_turn_rad_per_s])
    run = preintegrate(shifted_cells(problem.cells, rates, further), states, cell_turn)
    numeric = (displacement(further + step) - displacement(further - step)) / unit
    largest = max(np.abs(numeric).max(), 1e-9)
    np.testing.assert_allclose(
        run.by_constant[:, 0, which - 2] + 1j * run.by_constant[:, 1, which - 2],
        numeric, atol=1e-6 * largest,
    )  # fmt: skip


def test_the_nodes_go_with_the_constants(
    dives: list[DiveEvidence], iterates: list[DiveIterate]
) -> None:
    dive, iterate = dives[1], iterates[1]
    reduced = reduce_dive(dive, iterate, 5.0)
    J, r = dense(dive, reduced.terms)
    n = N_NODE * len(dive.setting.problem.t_node_s)
    constant = reduced.terms.constant + 1e-3
    left = r - J[:, n:] @ (constant - reduced.terms.constant)
    scale = np.sqrt(np.sum(J[:, :n] ** 2, axis=0))
    step = np.linalg.lstsq(J[:, :n] / scale, left, rcond=None)[0] / scale
    after = moved(iterate, reduced, constant)
    found = after.states.node - iterate.states.node
    np.testing.assert_allclose(found[:, :2], step.reshape(-1, N_NODE)[:, :2], atol=1e-3)
    np.testing.assert_array_equal(np.append(after.states.constant, after.further), constant)


def small_layout(sigma: float, own: bool) -> Layout:
    """One unknown of two dives, theirs or each one's own; the second's table is 1 m less."""
    columns = (np.array([0]), np.array([1 if own else 0]))
    unknowns = tuple(Unknown(BEACON[0], 1, f"dive_{d}" if own else None) for d in range(1 + own))
    return Layout(
        unknowns,
        columns,
        (np.zeros(1), np.ones(1)),
        *2 * (np.full(1 + own, sigma),),
        frozenset(),
        {},
        {},
    )


def test_two_dives_of_one_unknown_give_the_weighted_mean() -> None:
    # x seen as 3 ± 0.5 by one dive; by the other as 3.2 ± 1 from a table that is 1 m less: 2.2.
    seen = [Normal(np.array([[w]]), np.array([w * at])) for w, at in ((4.0, 3.0), (1.0, 3.2))]
    value, cov = solve(sum_dives(small_layout(2.0, own=False), seen), np.array([2.0]))
    total = 4.0 + 1.0 + 0.25
    assert value[0] == pytest.approx((4.0 * 3.0 + 1.0 * 2.2) / total)
    assert cov[0, 0] == pytest.approx(1 / total)


def test_the_evidence_is_that_of_the_normal_distribution() -> None:
    seen = [Normal(np.array([[w]]), np.array([w * at])) for w, at in ((4.0, 3.0), (1.0, 9.0))]

    def log_density(values, variances, prior):
        cov = np.diag(variances) + prior
        return -0.5 * values @ np.linalg.solve(cov, values) - 0.5 * np.linalg.slogdet(cov)[1]

    measured, variances = np.array([3.0, 8.0]), np.array([0.25, 1.0])
    shared = sum_dives(small_layout(2.0, own=False), seen), np.array([2.0])
    own = sum_dives(small_layout(2.0, own=True), seen), np.array([2.0, 2.0])
    gain = log_evidence(*own) - log_evidence(*shared)
    expected = log_density(measured, variances, 4.0 * np.eye(2))
    expected -= log_density(measured, variances, 4.0 * np.ones((2, 2)))
    assert gain == pytest.approx(expected)


def test_a_prior_grows_where_the_unknowns_say_so_and_never_shrinks() -> None:
    layout = small_layout(1.0, own=True)
    now = np.array([1.0, 1.0])
    cov = np.diag([0.01, 0.01])
    grown = learned_priors(layout, np.array([8.0, 0.1]), cov, now)
    assert grown[0] == pytest.approx(2.0)  # no faster
    for _ in range(6):
        grown = learned_priors(layout, np.array([8.0, 0.1]), cov, grown)
    assert grown[0] == pytest.approx(np.sqrt((64 + 3) / (1 - 0.01 / grown[0] ** 2 + 3)), rel=1e-3)
    assert grown[1] == 1.0


def test_beacons_of_dives_with_other_origins_are_brought_into_one_frame(
    dives: list[DiveEvidence],
) -> None:
    dive = dives[0]
    assert dive.origin is not None
    north = Origin(dive.origin.latitude_deg + 0.001, dive.origin.longitude_deg)
    other = replace(dive, origin=north, name="other")
    places = stated_places([dive, other])
    shift = (places[1] - places[0])[:, :2]
    # 0.001° of latitude is 110.6 m here, at the surface; less at depth.
    np.testing.assert_allclose(shift[:, 1], 110.5, atol=0.3)
    np.testing.assert_allclose(shift[:, 0], 0.0, atol=0.1)
