# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a whole dive: block-tridiagonal in the nodes, with a border of constants."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.block_tridiagonal import (
    Inverse,
    Level,
    eliminate,
    invert_chain,
    solve_chain,
)
from abyssnav.estimation.dive_states import DRIFTS, N_MOTION
from abyssnav.estimation.observations import Rows
from abyssnav.estimation.preintegration import Preintegrated
from abyssnav.tables import Float, Int

_SLOT_ROWS = 8  #: observations that are summed as one small matrix
#: Information on every position (1/m²): keeps a dive without any good reply solvable.
_NOWHERE = 1e-10


class Slots(NamedTuple):
    """Observations dealt out to slots of equal size, so that products are made in batches."""

    rows: Int  #: (s, 8) row of the observations; one past the last is none
    node: Int  #: (s,)
    begins: Int  #: first slot of each node that has one
    nodes: Int  #: those nodes

    def deal(self, values: Float) -> Float:
        """Values (s, 8, ...) from those (r, ...) of the observations; zero where there is none."""
        none = np.zeros((1, *values.shape[1:]))
        return np.asarray(np.concatenate([values, none])[self.rows])

    def collect(self, dealt: Float, n_rows: int) -> Float:
        """Values (r,) of the observations from those (s, 8) of the slots."""
        values = np.empty(n_rows + 1)
        values[self.rows] = dealt
        return values[:-1]


def make_slots(node_of_row: Int) -> Slots:
    """Slots for observations (r,) of nodes, in any order."""
    order = np.argsort(node_of_row, kind="stable")
    nodes, first, count = np.unique(node_of_row[order], return_index=True, return_counts=True)
    n_slots = -(-count // _SLOT_ROWS)
    begins = np.cumsum(n_slots) - n_slots
    rows = np.full((int(n_slots.sum()), _SLOT_ROWS), len(node_of_row))
    within = np.arange(len(order)) - np.repeat(first, count)
    slot = np.repeat(begins, count) + within // _SLOT_ROWS
    rows[slot, within % _SLOT_ROWS] = order
    return Slots(rows, np.repeat(nodes, n_slots), begins, nodes)


class MotionTerms(NamedTuple):
    """Linearised dead reckoning between neighbouring nodes."""

    miss_m: Float  #: (n - 1, 2) next position less the reckoned
    step: Preintegrated
    variance_m2: Float  #: (n - 1,) Q, of each axis


class Drift(NamedTuple):
    """Gauss-Markov rows of the fading states: x_{i+1} - a x_i; the first node's is its prior."""

    state: Float  #: (n, 6) x at present
    miss: Float  #: (n, 6) x_{i+1} - a x_i
    factor: Float  #: (n, 6) a, zero for the first node
    variance: Float  #: (n, 6) N, of the miss


class Linearised(NamedTuple):
    """All terms of the sum of squares at present states."""

    rows: Rows
    information: Float  #: (r,) weight over variance of each observation
    motion: MotionTerms
    drift: Drift
    constant: Float  #: (m,) present constants, whose prior means are zero
    constant_variance: Float  #: (m,)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations [A B; Bᵀ D] of nodes (block-tridiagonal A) and constants, and their right.

    Of n nodes with s states each: 8, or one more a beacon where its times err slowly.

    D and its right side are without the priors of the constants.
    """

    diagonal: Float  #: (n, s, s) A_kk
    below: Float  #: (n - 1, s, s) A_{k+1, k}
    border: Float  #: (n, s, m) B
    corner: Float  #: (m, m) D
    right: Float  #: (n, s)
    right_constant: Float  #: (m,)


def normal_equations(terms: Linearised, slots: Slots) -> Normal:
    """Jᵀ W J and Jᵀ W r of observations, dead reckoning and fading states."""
    n, m, s = len(terms.motion.miss_m) + 1, len(terms.constant), terms.rows.by_node.shape[1]
    normal = Normal(
        np.zeros((n, s, s)), np.zeros((n - 1, s, s)), np.zeros((n, s, m)),
        np.zeros((m, m)), np.zeros((n, s)), np.zeros(m),
    )  # fmt: skip
    _add_rows(normal, terms, slots)
    _add_motion(normal, terms.motion)
    _add_drift(normal, terms.drift)
    normal.diagonal[:, [0, 1], [0, 1]] += _NOWHERE
    return normal


def _add_rows(normal: Normal, terms: Linearised, slots: Slots) -> None:
    """Σ w (z - h)²: each observation ties its node and the constants."""
    rows, s = terms.rows, terms.rows.by_node.shape[1]
    whitened = np.concatenate([rows.by_node, rows.by_constant, rows.residual[:, None]], axis=1)
    whitened *= np.sqrt(terms.information)[:, None]
    dealt = slots.deal(whitened)
    product = dealt[:, :, :s].swapaxes(1, 2) @ dealt
    if len(product) != len(slots.nodes):
        product = np.add.reduceat(product, slots.begins)
    normal.diagonal[slots.nodes] += product[:, :, :s]
    normal.border[slots.nodes] += product[:, :, s:-1]
    normal.right[slots.nodes] += product[:, :, -1]
    corner = whitened[:, s:].T @ whitened[:, s:]
    normal.corner[:] += corner[:-1, :-1]
    normal.right_constant[:] += corner[:-1, -1]


def _add_motion(normal: Normal, motion: MotionTerms) -> None:
    """Σ |p_{i+1} - p_i - d_i|² / Q_i: dead reckoning ties each node to the next.

    The miss is m = p_{i+1} - p_i - d; `jacobian` is -∂m/∂x, since the residual is 0 - m.
    """
    step, whitening = motion.step, 1 / np.sqrt(motion.variance_m2)[:, None, None]
    by_nodes, s = np.concatenate([step.by_first, step.by_second], axis=2), step.by_first.shape[2]
    for axis in (0, 1):
        by_nodes[:, axis, axis] += 1.0
        by_nodes[:, axis, s + axis] -= 1.0
    by_nodes *= whitening
    rest = np.concatenate([step.by_constant, motion.miss_m[:, :, None]], axis=2) * whitening
    ties, pull = (by_nodes.swapaxes(1, 2) @ columns for columns in (by_nodes, rest))
    normal.diagonal[:-1] += ties[:, :s, :s]
    normal.diagonal[1:] += ties[:, s:, s:]
    normal.below[:] += ties[:, s:, :s]
    columns = motion_columns(step, normal.border.shape[2])
    normal.border[:-1, :, columns] += pull[:, :s, :-1]
    normal.border[1:, :, columns] += pull[:, s:, :-1]
    normal.right[:-1] += pull[:, :s, -1]
    normal.right[1:] += pull[:, s:, -1]
    rest = rest.reshape(-1, rest.shape[2])
    corner = rest[:, :-1].T @ rest
    normal.corner[np.ix_(columns, columns)] += corner[:, :-1]
    normal.right_constant[columns] += corner[:, -1]


def motion_columns(step: Preintegrated, n_constants: int) -> Int:
    """Those of the constants that dead reckoning depends on: the first six, and the last."""
    n_further = step.by_constant.shape[2] - N_MOTION
    return np.asarray(np.r_[:N_MOTION, n_constants - n_further : n_constants], dtype=np.int64)


def _add_drift(normal: Normal, drift: Drift) -> None:
    """Σ (x_{i+1} - a x_i)² / N_i of the fading states, and their priors at the first node."""
    weight, first = 1 / drift.variance, DRIFTS.start
    for place in range(drift.miss.shape[1]):
        state, w, a = first + place, weight[:, place], drift.factor[1:, place]
        normal.diagonal[:, state, state] += w
        normal.diagonal[:-1, state, state] += a * a * w[1:]
        normal.below[:, state, state] -= a * w[1:]
        normal.right[:, state] -= w * drift.miss[:, place]
        normal.right[:-1, state] += a * w[1:] * drift.miss[1:, place]


class Factored(NamedTuple):
    """Nodes eliminated: what remains are equations of the constants alone."""

    levels: tuple[Level, ...]  #: A, as it was eliminated
    node: Float  #: (n, s) A⁻¹ right
    spread: Float  #: (n, s, m) V = A⁻¹ B
    information: Float  #: (m, m) S = D - Bᵀ V, priors of the constants not in it
    right: Float  #: (m,)


def eliminate_nodes(normal: Normal) -> Factored:
    """Schur complement of the constants."""
    m = normal.border.shape[2]
    right = np.concatenate([normal.border, normal.right[:, :, None]], axis=2)
    levels = eliminate(normal.diagonal, normal.below, right)
    solved = solve_chain(levels)
    reduced = normal.border.reshape(-1, m).T @ solved.reshape(-1, m + 1)
    return Factored(
        levels,
        solved[:, :, m],
        solved[:, :, :m],
        normal.corner - 0.5 * (reduced[:, :m] + reduced[:, :m].T),
        normal.right_constant - reduced[:, m],
    )


class ConstantStep(NamedTuple):
    """Change of the constants, their posterior covariance, and the log marginal likelihood."""

    step: Float  #: (m,)
    covariance: Float  #: (m, m)
    log_evidence: float  #: of their prior, up to a term that is the same for every prior


def solve_constants(factored: Factored, constant: Float, variance: Float) -> ConstantStep:
    """Constants under a prior: δ = (S + Λ)⁻¹ (g - Λ b), Λ the inverse variances.

    The prior's evidence is gᵀ δ - ½ δᵀ S δ - ½ (b + δ)ᵀ Λ (b + δ) + ½ ln |Λ| - ½ ln |S + Λ|.
    All is done in units of the prior's sigmas, so that seconds and metres do not meet.
    """
    sigma = np.sqrt(variance)
    S = factored.information * sigma * sigma[:, None]
    g, b = factored.right * sigma, constant / sigma
    lower = np.linalg.cholesky(S + np.eye(len(b)))
    inverse = np.linalg.inv(lower)
    covariance = inverse.T @ inverse
    step = covariance @ (g - b)
    after = b + step
    evidence = g @ step - 0.5 * step @ S @ step - 0.5 * after @ after
    evidence -= np.log(np.diagonal(lower)).sum()
    return ConstantStep(step * sigma, covariance * sigma * sigma[:, None], float(evidence))


def node_step(factored: Factored, constant_step: Float) -> Float:
    """Change (n, s) of the nodes that goes with a change of the constants.

    Parameters
    ----------
    constant_step : (m,) each in its unit: rad, s, m, or a share
    """
    return factored.node - factored.spread @ constant_step


class Solved(NamedTuple):
    """One step of the estimate, with what is known of its uncertainty."""

    terms: Linearised
    factored: Factored
    marginals: Inverse  #: blocks of A⁻¹: covariance of the nodes for known constants
    constant_cov: Float  #: (m, m)
    node_step: Float  #: (n, s)
    constant_step: Float  #: (m,)


def solve(terms: Linearised, slots: Slots) -> Solved:
    """One Gauss-Newton step: nodes eliminated, constants solved for, nodes after them."""
    factored = eliminate_nodes(normal_equations(terms, slots))
    step = solve_constants(factored, terms.constant, terms.constant_variance)
    return Solved(
        terms, factored, invert_chain(factored.levels), step.covariance,
        node_step(factored, step.step), step.step,
    )  # fmt: skip
