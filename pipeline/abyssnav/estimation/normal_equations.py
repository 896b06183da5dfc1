# SPDX-License-Identifier: Apache-2.0
"""Banded normal equations of a whole dive: replies, dead reckoning and priors, linearised."""

from bisect import bisect_right
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.acoustics.travel_time import Legs
from abyssnav.estimation.model import HEADING, ErrorModel, Steps, displacement, observe
from abyssnav.tables import Float, Int

NODE = [0, 1, HEADING, 9, 10]  #: states of every node: position, heading error, held velocity
SHARED = [3, 4, 5, 6, 7, 8]  #: states of the dive: scales and deviation
TINY_M2, TINY = 1e-6, 1e-12  #: variances of a step that takes no time: position, others
_N = len(NODE)
_BAND = 2 * _N - 1  #: a node's states couple to the next one's
#: Replies heard within this time share a node.  What dead reckoning may lose in it, 0.1 m, is
#: nothing to what a time tells, and a ping's replies need one block of equations, not four.
_NODE_S = 10.0


class Problem(NamedTuple):
    """The n replies of a dive, the m nodes that they share, and what is known beforehand."""

    begins: Int  #: (m,) first reply of each node
    node: Int  #: (n,) node of each reply
    nodes: Steps  #: (m,) at each node's first reply
    from_node_m: Float  #: (n, 2) ΔC from the node to the reply
    linear_from_node_m: Float  #: (n, 6, 2)
    replies: Steps
    legs: Legs
    model: ErrorModel
    sigma_s: Float | float

    @classmethod
    def of(cls, steps: Steps, legs: Legs, model: ErrorModel, sigma_s: Float | float) -> "Problem":
        """Give each node the replies of `_NODE_S` from its first."""
        t_s, first = steps.t_s.tolist(), [0]
        while (after := bisect_right(t_s, t_s[first[-1]] + _NODE_S)) < len(t_s):
            first.append(after)
        begins = np.array(first)
        node = np.repeat(np.arange(len(begins)), np.diff(begins, append=len(t_s)))
        nodes = steps[begins]
        run_m, linear_m = steps.run_m - nodes.run_m[node], steps.linear_m - nodes.linear_m[node]
        return cls(begins, node, nodes, run_m, linear_m, steps, legs, model, sigma_s)

    def at_replies(self, x: Float) -> tuple[Float, Float]:
        """States (n, 11) that nodes (m, 11) mean for the replies, ∂position/∂states (n, 2, 11)."""
        states = x[self.node]
        d_m, by_state = displacement(states, self.from_node_m, self.linear_from_node_m)
        states[:, :2] += d_m
        return states, by_state

    def observe(self, x: Float) -> tuple[Float, Float]:
        """Lateness of every reply (n,) s, and the derivatives (n, 11) of its time by its node."""
        states, by_state = self.at_replies(x)
        predicted_s, H = observe(states, self.replies, self.legs)
        H = H + np.einsum("ni,nij->nj", H[:, :2], by_state)
        return self.legs.flight_time_s - predicted_s, H


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations [A B; Bᵀ D] of nodes (banded A) and shared states, with right-hand sides."""

    band: Float  #: (10, 5 m) lower diagonals of A
    border: Float  #: (5 m, 6) B
    shared: Float  #: (6, 6) D
    right_node: Float  #: (5 m,)
    right_shared: Float  #: (6,)


class _Sums(NamedTuple):
    """Normal equations as they grow: every term adds to these arrays in place."""

    diagonal: Float  #: (m, 5, 5) A_kk
    below: Float  #: (m - 1, 5, 5) A_{k+1, k}
    border: Float  #: (m, 5, 6) B
    shared: Float  #: (6, 6) D
    right: Float  #: (m, 5)
    right_shared: Float  #: (6,)


def normal_equations(of: Problem, x: Float, late_s: Float, H: Float, weight: Float) -> Normal:
    """Jᵀ W J and -Jᵀ W r of replies, dead reckoning between nodes, fading errors and priors.

    Parameters
    ----------
    x : (m, 11) nodes
    late_s, H : (n,) s and (n, 11), as `Problem.observe` tells them at x
    weight : (n,) of each reply
    """
    n, shared = len(x), len(SHARED)
    sums = _Sums(
        np.zeros((n, _N, _N)), np.zeros((n - 1, _N, _N)), np.zeros((n, _N, shared)),
        np.zeros((shared, shared)), np.zeros((n, _N)), np.zeros(shared),
    )  # fmt: skip
    _add_replies(sums, of.begins, late_s, H, weight / of.sigma_s**2)
    _add_motion(sums, x, of.nodes, of.model)
    _add_fading(sums, x, of.nodes, of.model)
    sums.diagonal[:, [0, 1], [0, 1]] += 1e-12  # keeps a dive without any good reply solvable
    prior = np.maximum(of.model.prior_variance()[SHARED], 1e-20)
    sums.shared[np.diag_indices(shared)] += 1 / prior
    sums.right_shared[:] -= x[0, SHARED] / prior
    return Normal(
        _banded(sums.diagonal, sums.below),
        sums.border.reshape(-1, shared),
        sums.shared,
        sums.right.ravel(),
        sums.right_shared,
    )


def _add_replies(sums: _Sums, begins: Int, late_s: Float, H: Float, information: Float) -> None:
    """Σ w (T - h)²: each reply ties its node and the shared states."""
    node, shared = H[:, NODE], H[:, SHARED]
    scaled, late = node * information[:, None], late_s * information
    sums.diagonal[:] += np.add.reduceat(scaled[:, :, None] * node[:, None, :], begins)
    sums.border[:] += np.add.reduceat(scaled[:, :, None] * shared[:, None, :], begins)
    sums.shared[:] += (shared * information[:, None]).T @ shared
    sums.right[:] += np.add.reduceat(node * late[:, None], begins)
    sums.right_shared[:] += shared.T @ late


def _add_motion(sums: _Sums, x: Float, steps: Steps, model: ErrorModel) -> None:
    """Σ |p_{i+1} - p_i - d_i|² / Q_i: dead reckoning ties each node to the next."""
    d_m, by_state = displacement(
        x[:-1], np.diff(steps.run_m, axis=0), np.diff(steps.linear_m, axis=0)
    )
    by_state[:, 0, 0] = by_state[:, 1, 1] = 1.0  # p_{i+1} = p_i + d: the node's own position
    J, J_shared = by_state[:, :, NODE], by_state[:, :, SHARED]
    w = 1 / (model.position_m2_per_s * np.diff(steps.t_s) + TINY_M2)
    miss_m = x[1:, :2] - x[:-1, :2] - d_m
    wJ, wJ_shared = J * w[:, None, None], J_shared * w[:, None, None]
    sums.diagonal[:-1] += np.einsum("nki,nkj->nij", wJ, J)
    sums.diagonal[1:, [0, 1], [0, 1]] += w[:, None]
    sums.below[:, :2] -= wJ
    sums.border[:-1] += np.einsum("nki,nkj->nij", wJ, J_shared)
    sums.border[1:, :2] -= wJ_shared
    sums.shared[:] += np.einsum("nki,nkj->ij", wJ_shared, J_shared)
    sums.right[:-1] += np.einsum("nki,nk->ni", wJ, miss_m)
    sums.right[1:, :2] -= miss_m * w[:, None]
    sums.right_shared[:] += np.einsum("nki,nk->i", wJ_shared, miss_m)


def _add_fading(sums: _Sums, x: Float, steps: Steps, model: ErrorModel) -> None:
    """Σ (ε_{i+1} - a ε_i)² / N_i and the prior of ε₀; the same for the held velocity."""
    prior = np.maximum(model.prior_variance(), 1e-20)
    for place, (state, time_s) in enumerate(drifting(model), start=2):
        a = np.exp(-np.diff(steps.t_s) / time_s)
        v = 1 / (prior[state] * (1 - a * a) + TINY)
        drift = x[1:, state] - a * x[:-1, state]
        sums.diagonal[:-1, place, place] += a * a * v
        sums.diagonal[1:, place, place] += v
        sums.below[:, place, place] -= a * v
        sums.right[:-1, place] += a * v * drift
        sums.right[1:, place] -= v * drift
        sums.diagonal[0, place, place] += 1 / prior[state]
        sums.right[0, place] -= x[0, state] / prior[state]


def _banded(diagonal: Float, below: Float) -> Float:
    """Lower diagonals of a block-tridiagonal matrix of square blocks, for LAPACK."""
    n = len(diagonal)
    band = np.zeros((_BAND + 1, n, _N))
    for column in range(_N):
        for row in range(_N):
            if row >= column:
                band[row - column, :, column] = diagonal[:, row, column]
            band[_N + row - column, :-1, column] = below[:, row, column]
    return band.reshape(_BAND + 1, _N * n)


def drifting(model: ErrorModel) -> list[tuple[int, float]]:
    """Gauss-Markov states and their times."""
    times_s = (model.heading_time_s, model.held_time_s, model.held_time_s)
    return list(zip(NODE[2:], times_s, strict=True))


class Solved(NamedTuple):
    """Solution of normal equations, and what the covariances are made of."""

    node: Float  #: (m, 5)
    shared: Float  #: (6,)
    factor: Float  #: (10, 5 m) lower diagonals of L, A = L Lᵀ
    spread: Float  #: (5 m, 6) A⁻¹ B
    shared_cov: Float  #: (6, 6) (D - Bᵀ A⁻¹ B)⁻¹


def solve(normal: Normal) -> Solved:
    """The step that makes the sum of squares least, by banded Cholesky and a Schur complement."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    factor = cholesky_banded(normal.band, lower=True, check_finite=False)
    right = np.column_stack([normal.right_node, normal.border])
    solved = cho_solve_banded((factor, True), right, overwrite_b=True, check_finite=False)
    spread = solved[:, 1:]
    shared_cov = np.linalg.inv(normal.shared - normal.border.T @ spread)
    shared = shared_cov @ (normal.right_shared - normal.border.T @ solved[:, 0])
    node = (solved[:, 0] - spread @ shared).reshape(-1, _N)
    return Solved(node, shared, factor, spread, shared_cov)


def marginals(of: Solved) -> Float:
    """Marginal covariance of each node (m, 5, 5): the diagonal blocks of the inverse.

    One recursion backwards: with A = L Lᵀ, C = (L_kk L_kkᵀ)⁻¹ and G = L_kk⁻ᵀ L_{k+1,k}ᵀ, the blocks
    of A⁻¹ are
        Z_k = C_k + G_k Z_{k+1} G_kᵀ
    and the shared states add (A⁻¹ B) S⁻¹ (A⁻¹ B)ᵀ with S = D - Bᵀ A⁻¹ B.
    """
    bands = of.factor.reshape(_BAND + 1, -1, _N)
    n = bands.shape[1]
    lower, coupling = np.zeros((n, _N, _N)), np.zeros((n - 1, _N, _N))
    for column in range(_N):
        for row in range(_N):
            if row >= column:
                lower[:, row, column] = bands[row - column, :, column]
            coupling[:, row, column] = bands[_N + row - column, :-1, column]
    inverse = np.linalg.inv(lower)
    Z = np.swapaxes(inverse, 1, 2) @ inverse
    gain = np.swapaxes(coupling @ inverse[:-1], 1, 2)
    for k in range(n - 2, -1, -1):
        Z[k] += gain[k].dot(Z[k + 1]).dot(gain[k].T)
    spread = of.spread.reshape(n, _N, len(SHARED))
    return np.asarray(Z + spread @ of.shared_cov @ np.swapaxes(spread, 1, 2))
