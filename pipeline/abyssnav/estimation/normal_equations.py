# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a whole dive: block-tridiagonal in the nodes, with a border of constants."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from abyssnav.estimation.dive_states import N_MOTION, N_NODE
from abyssnav.estimation.observations import Rows
from abyssnav.estimation.preintegration import Preintegrated
from abyssnav.tables import Float, Int

#: The recursion of the marginals runs in stretches of so many nodes, all stretches side by side. Of
#: n nodes that are 2 s + n / s products in series, fewest at s = √(n / 2): for half a day's dive.
_STRETCH = 48
_BAND = 2 * N_NODE - 1  #: a node's states couple to the next one's
_SLOT_ROWS = 8  #: observations that are summed as one small matrix
#: Information on every position (1/m²): keeps a dive without any good reply solvable.
_NOWHERE = 1e-10


class Slots(NamedTuple):
    """Observations dealt out to slots of equal size, so that products are made in batches."""

    rows: Int  #: (s, 8) row of the observations; one past the last is none
    begins: Int  #: first slot of each node that has one
    nodes: Int  #: those nodes


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
    return Slots(rows, begins, nodes)


class MotionTerms(NamedTuple):
    """Linearised dead reckoning between neighbouring nodes."""

    miss_m: Float  #: (n - 1, 2) next position less the reckoned
    step: Preintegrated
    variance_m2: Float  #: (n - 1,) Q, of each axis


class Drift(NamedTuple):
    """Gauss-Markov rows of the fading states: x_{i+1} - a x_i; the first node's is its prior."""

    miss: Float  #: (n, 6) x_{i+1} - a x_i at present states
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

    D and its right side are without the priors of the constants.
    """

    diagonal: Float  #: (n, 8, 8) A_kk
    below: Float  #: (n - 1, 8, 8) A_{k+1, k}
    border: Float  #: (n, 8, m) B
    corner: Float  #: (m, m) D
    right: Float  #: (n, 8)
    right_constant: Float  #: (m,)


def normal_equations(terms: Linearised, slots: Slots) -> Normal:
    """Jᵀ W J and Jᵀ W r of observations, dead reckoning and fading states."""
    n, m = len(terms.motion.miss_m) + 1, len(terms.constant)
    normal = Normal(
        np.zeros((n, N_NODE, N_NODE)), np.zeros((n - 1, N_NODE, N_NODE)), np.zeros((n, N_NODE, m)),
        np.zeros((m, m)), np.zeros((n, N_NODE)), np.zeros(m),
    )  # fmt: skip
    _add_rows(normal, terms, slots)
    _add_motion(normal, terms.motion)
    _add_drift(normal, terms.drift)
    normal.diagonal[:, [0, 1], [0, 1]] += _NOWHERE
    return normal


def _add_rows(normal: Normal, terms: Linearised, slots: Slots) -> None:
    """Σ w (z - h)²: each observation ties its node and the constants."""
    rows, m = terms.rows, len(terms.constant)
    whitened = np.zeros((len(rows.residual) + 1, N_NODE + m + 1))
    np.concatenate(
        [rows.by_node, rows.by_constant, rows.residual[:, None]], axis=1, out=whitened[:-1]
    )
    whitened[:-1] *= np.sqrt(terms.information)[:, None]
    dealt = whitened[slots.rows]
    product = dealt[:, :, :N_NODE].swapaxes(1, 2) @ dealt
    if len(product) != len(slots.nodes):
        product = np.add.reduceat(product, slots.begins)
    normal.diagonal[slots.nodes] += product[:, :, :N_NODE]
    normal.border[slots.nodes] += product[:, :, N_NODE:-1]
    normal.right[slots.nodes] += product[:, :, -1]
    corner = whitened[:, N_NODE:].T @ whitened[:, N_NODE:]
    normal.corner[:] += corner[:-1, :-1]
    normal.right_constant[:] += corner[:-1, -1]


def _add_motion(normal: Normal, motion: MotionTerms) -> None:
    """Σ |p_{i+1} - p_i - d_i|² / Q_i: dead reckoning ties each node to the next.

    The miss is m = p_{i+1} - p_i - d; `jacobian` is -∂m/∂x, since the residual is 0 - m.
    """
    jacobian = np.concatenate(
        [
            motion.step.by_first, motion.step.by_second,
            motion.step.by_constant, motion.miss_m[:, :, None],
        ],
        axis=2,
    )  # fmt: skip
    for axis in (0, 1):
        jacobian[:, axis, axis] += 1.0
        jacobian[:, axis, N_NODE + axis] -= 1.0
    jacobian /= np.sqrt(motion.variance_m2)[:, None, None]
    product = jacobian.swapaxes(1, 2) @ jacobian
    one, two = slice(0, N_NODE), slice(N_NODE, 2 * N_NODE)
    shared = slice(2 * N_NODE, -1)
    normal.diagonal[:-1] += product[:, one, one]
    normal.diagonal[1:] += product[:, two, two]
    normal.below[:] += product[:, two, one]
    columns = motion_columns(motion.step, normal.border.shape[2])
    normal.border[:-1, :, columns] += product[:, one, shared]
    normal.border[1:, :, columns] += product[:, two, shared]
    normal.right[:-1] += product[:, one, -1]
    normal.right[1:] += product[:, two, -1]
    corner = product[:, shared, 2 * N_NODE :].sum(axis=0)
    normal.corner[np.ix_(columns, columns)] += corner[:, :-1]
    normal.right_constant[columns] += corner[:, -1]


def motion_columns(step: Preintegrated, n_constants: int) -> Int:
    """Those of the constants that dead reckoning depends on: the first six, and the last."""
    n_further = step.by_constant.shape[2] - N_MOTION
    return np.asarray(np.r_[:N_MOTION, n_constants - n_further : n_constants], dtype=np.int64)


def _add_drift(normal: Normal, drift: Drift) -> None:
    """Σ (x_{i+1} - a x_i)² / N_i of the fading states, and their priors at the first node."""
    weight, first = 1 / drift.variance, N_NODE - drift.miss.shape[1]
    for place in range(drift.miss.shape[1]):
        state, w, a = first + place, weight[:, place], drift.factor[1:, place]
        normal.diagonal[:, state, state] += w
        normal.diagonal[:-1, state, state] += a * a * w[1:]
        normal.below[:, state, state] -= a * w[1:]
        normal.right[:, state] -= w * drift.miss[:, place]
        normal.right[:-1, state] += a * w[1:] * drift.miss[1:, place]


class Factored(NamedTuple):
    """Nodes eliminated: what remains are equations of the constants alone."""

    lower: Float  #: (16, 8 n) lower diagonals of L, A = L Lᵀ
    node: Float  #: (n, 8) A⁻¹ right
    spread: Float  #: (n, 8, m) V = A⁻¹ B
    information: Float  #: (m, m) S = D - Bᵀ V, priors of the constants not in it
    right: Float  #: (m,)
    log_determinant: float  #: ln |A|


def eliminate_nodes(normal: Normal) -> Factored:
    """Banded Cholesky of the nodes and Schur complement of the constants."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    n, _, m = normal.border.shape
    lower = cholesky_banded(
        _banded(normal.diagonal, normal.below), lower=True, overwrite_ab=True, check_finite=False
    )
    border = normal.border.reshape(-1, m)
    right = np.column_stack([normal.right.ravel(), border])
    solved = cho_solve_banded((lower, True), right, overwrite_b=True, check_finite=False)
    reduced = border.T @ solved
    return Factored(
        lower,
        solved[:, 0].reshape(n, N_NODE),
        solved[:, 1:].reshape(n, N_NODE, m),
        normal.corner - 0.5 * (reduced[:, 1:] + reduced[:, 1:].T),
        normal.right_constant - reduced[:, 0],
        2.0 * float(np.log(lower[0]).sum()),
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
    """Change (n, 8) of the nodes that goes with a change of the constants.

    Parameters
    ----------
    constant_step : (m,) each in its unit: rad, s, m, or a share
    """
    return factored.node - factored.spread @ constant_step


class Marginals(NamedTuple):
    """Blocks of A⁻¹: covariance of the nodes for known constants."""

    own: Float  #: (n, 8, 8)
    next: Float  #: (n - 1, 8, 8) of node k + 1 with node k


def marginals(factored: Factored) -> Marginals:
    """Diagonal and neighbouring blocks of the inverse, by one recursion backwards.

    With A = L Lᵀ, C = (L_kk L_kkᵀ)⁻¹ and G = L_kk⁻ᵀ L_{k+1,k}ᵀ,
        Z_k = C_k + G_k Z_{k+1} G_kᵀ,    Z_{k+1,k} = -Z_{k+1} G_kᵀ
    (K. Takahashi et al., 1973; for a linear dive this is the recursion of the RTS smoother:
    H. Rauch, F. Tung and C. Striebel, AIAA Journal 3, 1965).
    """
    lower, coupling = _blocks(factored.lower)
    inverse = np.linalg.inv(lower)
    gain = np.ascontiguousarray((coupling @ inverse[:-1]).swapaxes(1, 2))
    own = _recur_backwards(inverse.swapaxes(1, 2) @ inverse, gain)
    return Marginals(own, -own[1:] @ gain.swapaxes(1, 2))


class Solved(NamedTuple):
    """One step of the estimate, with what is known of its uncertainty."""

    terms: Linearised
    factored: Factored
    marginals: Marginals
    constant_cov: Float  #: (m, m)
    node_step: Float  #: (n, 8)
    constant_step: Float  #: (m,)


def solve(terms: Linearised, slots: Slots) -> Solved:
    """One Gauss-Newton step: nodes eliminated, constants solved for, nodes after them."""
    factored = eliminate_nodes(normal_equations(terms, slots))
    step = solve_constants(factored, terms.constant, terms.constant_variance)
    return Solved(
        terms, factored, marginals(factored), step.covariance,
        node_step(factored, step.step), step.step,
    )  # fmt: skip


def _recur_backwards(C: Float, G: Float) -> Float:
    """Z_k = C_k + G_k Z_{k+1} G_kᵀ (n, 8, 8), by stretches of nodes side by side.

    Each stretch is first walked without what comes after it, Z_first = B + A Z_after Aᵀ; then
    again with that, which the stretches tell one another.
    """
    n = len(C)
    stretches = -(-n // _STRETCH)
    padded = np.zeros((2, stretches * _STRETCH, N_NODE, N_NODE))
    padded[0, :n], padded[1, : n - 1] = C, G
    by_step = padded.reshape(2, stretches, _STRETCH, N_NODE, N_NODE).swapaxes(1, 2)
    Z, G = np.ascontiguousarray(by_step)
    A, B = np.broadcast_to(np.eye(N_NODE), Z[0].shape), np.zeros_like(Z[0])
    for k in range(_STRETCH - 1, -1, -1):
        A, B = G[k] @ A, Z[k] + G[k] @ B @ G[k].swapaxes(1, 2)
    after = np.zeros_like(B)
    for s in range(stretches - 1, 0, -1):
        after[s - 1] = B[s] + A[s] @ after[s] @ A[s].T
    for k in range(_STRETCH - 1, -1, -1):
        Z[k] += G[k] @ after @ G[k].swapaxes(1, 2)
        after = Z[k]
    return np.asarray(Z.swapaxes(0, 1).reshape(-1, N_NODE, N_NODE)[:n])


def eliminate_forward(normal: Normal) -> tuple[Float, Float]:
    """Information (n, 8, 8) and right side (n, 8) of each node, those before it eliminated.

    S_k = A_kk - A_{k,k-1} S_{k-1}⁻¹ A_{k-1,k} = L_kk L_kkᵀ,    y_k = L_kk (L⁻¹ g)_k
    """
    from scipy.linalg import cholesky_banded
    from scipy.linalg.lapack import dtbtrs

    band = cholesky_banded(_banded(normal.diagonal, normal.below), lower=True, check_finite=False)
    lower, _ = _blocks(band)
    solved, _ = dtbtrs(band, normal.right.reshape(-1, 1), uplo="L")
    right = lower @ solved.reshape(-1, N_NODE, 1)
    return lower @ lower.swapaxes(1, 2), right[:, :, 0]


def _blocks(band: Float) -> tuple[Float, Float]:
    """L_kk (n, 8, 8) and L_{k+1,k} (n - 1, 8, 8) of a banded Cholesky factor."""
    bands = band.reshape(_BAND + 1, -1, N_NODE)
    n = bands.shape[1]
    lower, coupling = np.zeros((n, N_NODE, N_NODE)), np.zeros((n - 1, N_NODE, N_NODE))
    for column in range(N_NODE):
        for row in range(N_NODE):
            if row >= column:
                lower[:, row, column] = bands[row - column, :, column]
            coupling[:, row, column] = bands[N_NODE + row - column, :-1, column]
    return lower, coupling


def _banded(diagonal: Float, below: Float) -> Float:
    """Lower diagonals of a block-tridiagonal matrix of square blocks, for LAPACK."""
    n = len(diagonal)
    band = np.zeros((_BAND + 1, n, N_NODE))
    for column in range(N_NODE):
        for row in range(N_NODE):
            if row >= column:
                band[row - column, :, column] = diagonal[:, row, column]
            band[N_NODE + row - column, :-1, column] = below[:, row, column]
    return band.reshape(_BAND + 1, N_NODE * n)
